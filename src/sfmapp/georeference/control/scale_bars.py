"""Metres from known lengths: each measured in the model and left out in turn, the contradictory ones named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from sfmapp.georeference.control.points import CLEARLY, FALSE_ALARM
from sfmapp.georeference.control.report import ScaleBarRow, ScaledModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ScaleBar:
    """A known length and what it is in the model.

    Attributes:
        name: as the user gave it.
        metres, sigma_m: as it was measured.
        length, sigma: in the model, and how sure photographs are of that.
    """

    name: str
    metres: float
    sigma_m: float
    length: float
    sigma: float

    @property
    def log_scale(self) -> float:
        """Logarithm of metres per unit, by this bar alone."""
        return float(np.log(self.metres / self.length))

    @property
    def sigma_share(self) -> float:
        """Standard deviation of that."""
        return float(np.hypot(self.sigma_m / self.metres, self.sigma / self.length))


def scale_by_bars(model: int, bars: Sequence[ScaleBar], unmeasured: Sequence[str]) -> ScaledModel:
    """Metres per unit of a model, by the bars that agree.

    Bars are independent of each other. One that all others refute is left aside, where it is clear which; where it is
    not, their sigmas are widened until they agree.

    Args:
        bars: in the unit of the model.
        unmeasured: why other bars could not be measured, a sentence each.
    """
    if not bars:
        return ScaledModel(model=model, reason="; ".join(unmeasured), bars=[], findings=list(unmeasured))
    logs, sigmas = np.array([bar.log_scale for bar in bars]), np.array([bar.sigma_share for bar in bars])
    used, spread = np.ones(len(bars), bool), 1.0
    limit = float(norm.isf(FALSE_ALARM / (2 * len(bars))))
    while used.sum() > 1:
        errors, deviations = np.array([_left_out(logs, sigmas, used, n) for n in range(len(bars))]).T
        inside = np.where(used, np.abs(errors) / deviations, 0.0)
        worst, second = np.sort(inside)[::-1][:2] ** 2
        if inside.max() <= limit:
            break
        if used.sum() == 2 or worst - second < CLEARLY:
            mean, _ = _mean(logs, sigmas, used)
            squares = float((((logs - mean) / sigmas)[used] ** 2).sum())
            spread = max(1.0, float(np.sqrt(squares / (used.sum() - 1))))
            break
        used[int(np.argmax(inside))] = False
    sigmas = spread * sigmas
    mean, sigma = _mean(logs, sigmas, used)
    rows = []
    for n, bar in enumerate(bars):
        row = ScaleBarRow(
            name=bar.name, metres=bar.metres, sigma_m=bar.sigma_m, is_used=bool(used[n]),
            model_m=float(np.exp(mean) * bar.length),
        )  # fmt: skip
        if len(bars) > 1 and (used.sum() > 1 or not used[n]):
            error, expected = _left_out(logs, sigmas, used, n)
            row = ScaleBarRow(**{**row, "left_out_m": -bar.metres * error, "left_out_sigma_m": bar.metres * expected})
        rows.append(row)
    return ScaledModel(
        model=model,
        reason="",
        metres_per_unit=float(np.exp(mean)),
        sigma_share=sigma,
        spread=spread,
        bars=rows,
        findings=[*unmeasured, *_findings(rows, spread)],
    )


def _mean(logs: Array, sigmas: Array, used: NDArray[np.bool_]) -> tuple[float, float]:
    weights = np.where(used, sigmas**-2.0, 0.0)
    return float(weights @ logs / weights.sum()), float(weights.sum() ** -0.5)


def _left_out(logs: Array, sigmas: Array, used: NDArray[np.bool_], n: int) -> tuple[float, float]:
    """Bar minus the mean of the others, and the standard deviation of that."""
    others = used & (np.arange(len(logs)) != n)
    mean, sigma = _mean(logs, sigmas, others)
    return float(logs[n] - mean), float(np.hypot(sigma, sigmas[n]))


def _findings(rows: Sequence[ScaleBarRow], spread: float) -> list[str]:
    found = [
        f"scale bar {row.name}: {row.metres:g} m by its measurement, {row.metres + row.left_out_m:.4g} m by all others "
        f"within {row.left_out_sigma_m:.2g} m; it is left aside: check its length and ends"
        for row in rows
        if not row.is_used and row.left_out_m is not None and row.left_out_sigma_m is not None
    ]
    if spread > 1.0:
        names = ", ".join(row.name for row in rows if row.is_used)
        found.append(
            f"scale bars {names} contradict each other by {spread:.1f} times their sigmas, and none is clearly the "
            "wrong one; the sigma of the scale was widened by as much: check their lengths and ends"
        )
    return found
