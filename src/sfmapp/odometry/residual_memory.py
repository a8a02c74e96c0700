"""How far the errors of neighbouring frames are the same ones.

Neighbouring frames see the same points against the same reference pictures, and what is wrong with a point is wrong in
all of them: their poses err together. How far, their residuals say. They are correlated over points, and only over
those that both frames see: the more points change, the less the poses have in common.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Correlation(NamedTuple):
    """Of the residuals of a frame with those of the frame before it, and of the one before that; and the share of its
    points that the frame before did not see. NaN of none."""

    with_last: float
    with_one_before: float
    renewed: float = float("nan")


NOT_KNOWN = Correlation(float("nan"), float("nan"))


class ResidualMemory:
    """The residuals of the last two frames."""

    def __init__(self) -> None:
        self._before: list[tuple[NDArray[np.integer], Array]] = []

    def forget(self) -> None:
        """What comes next has nothing to do with what was before."""
        self._before.clear()

    def look(self, point_id: NDArray[np.integer], residual: Array) -> Correlation:
        """Remember the residuals (N, 2) of a frame at its points (N,), and compare them with those before."""
        found = [self._correlation(point_id, residual, *before) for before in self._before]
        renewed = float("nan")
        if self._before and len(point_id):
            renewed = 1.0 - len(np.intersect1d(point_id, self._before[0][0])) / len(point_id)
        self._before = [(point_id, residual), *self._before[:1]]
        with_last, with_one_before = [*found, float("nan"), float("nan")][:2]
        return Correlation(with_last, with_one_before, renewed)

    @staticmethod
    def _correlation(
        point_id: NDArray[np.integer], residual: Array, other_id: NDArray[np.integer], other: Array
    ) -> float:
        _, here, there = np.intersect1d(point_id, other_id, assume_unique=True, return_indices=True)
        size = float(np.sqrt((residual**2).sum() * (other**2).sum()))
        return float((residual[here] * other[there]).sum()) / size if size > 0.0 else float("nan")
