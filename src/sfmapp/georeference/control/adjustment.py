"""A model adjusted with ground control: which points to believe, and what each says of the model that others made.

Every point is left out in turn, in one factorisation (:mod:`sfmapp.georeference.control.points`). A point that is too
far from where the others put it is left aside and named, if the others agree without it and it is clear which one it
is; where it is not, or where more than a third would have to go, the survey is less sure than it says, and its sigmas
are widened until it agrees.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sfmapp.adjust.graph import FactorGraph
from sfmapp.formats.control_points import ControlPoints
from sfmapp.georeference.control.landmarks import LandmarkFactor, Marks, Surveyed
from sfmapp.georeference.control.marks import MarkedPoints
from sfmapp.georeference.control.points import CLEARLY, FALSE_ALARM, LeftOut, Survey, leave_out, left_out_already
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# No more of the points than this may be wrong.
_MAX_WRONG = 1 / 3


@dataclass(frozen=True)
class Adjusting:
    """How the caller adjusts its model.

    Attributes:
        to_optimize: makes the graph that is optimised, in place; to_judge: one of the same variables whose covariances
            hold: without a robust loss, which takes the good observations for less than they are.
        free: for each camera, positions of the parameters that may change.
    """

    to_optimize: Callable[[], FactorGraph]
    to_judge: Callable[[], FactorGraph]
    free: Sequence[NDArray[np.int64]]


@dataclass(frozen=True)
class ControlSolution:
    """What came of an adjustment with control points (P).

    Attributes:
        is_used: (P,) bool: surveys that took part.
        place: (P, 3) adjusted, NaN for points without a place.
        left_out: P, of points as the others put them; None where they do not hold the model, or have no place.
        survey_spread: by how much sigmas of the survey were multiplied, one at least.
    """

    is_used: Mask
    place: Array
    left_out: list[LeftOut | None]
    survey_spread: float


def adjust_to_control(
    model: Reconstruction,
    control: ControlPoints,
    marked: MarkedPoints,
    survey: Survey,
    is_used: Mask,
    adjusting: Adjusting,
) -> ControlSolution:
    """Adjust a model that lies near the survey with those control points that agree.

    Args:
        model: in the frame of the survey; moved.
        is_used: (P,) bool, points to begin with.
    """
    points = _Points(model, control, marked, survey, adjusting)
    start, is_used = is_used.copy(), is_used & marked.is_placed
    most_wrong = int(_MAX_WRONG * marked.is_placed.sum())
    spread, seen = 1.0, {is_used.tobytes()}
    while True:
        solution = points.solve(is_used, spread)
        limit = float(chi2.isf(FALSE_ALARM / max(1, len(is_used)), 3))
        squares = np.array([0.0 if found is None else found.square for found in solution.left_out])
        outside, inside = np.where(is_used, squares, 0.0), np.where(is_used, np.inf, squares)
        inside[[found is None for found in solution.left_out]] = np.inf
        changed = is_used.copy()
        if outside.max(initial=0.0) > limit:
            worst, second = np.sort([*outside, 0.0])[::-1][:2]
            if worst - second < CLEARLY or (marked.is_placed & ~is_used).sum() >= most_wrong or spread > 1.0:
                # who is wrong cannot be told, or too many would be: the survey is poorer than it says
                wider = spread * float(np.sqrt(np.median(squares[squares > 0]) / chi2.median(3)))
                is_used, spread = start & marked.is_placed, max(wider, 1.2 * spread)
                continue
            changed[int(np.argmax(outside))] = False
        elif inside.min(initial=np.inf) <= limit:
            changed[int(np.argmin(inside))] = True
        if np.array_equal(changed, is_used) or changed.tobytes() in seen:
            return solution
        seen.add(changed.tobytes())
        is_used = changed


class _Points:
    """Control points as factors of one model."""

    def __init__(
        self, model: Reconstruction, control: ControlPoints, marked: MarkedPoints, survey: Survey, adjusting: Adjusting
    ) -> None:
        self._model, self._survey, self._adjusting = model, survey, adjusting
        self._placed: list[int] = np.flatnonzero(marked.is_placed).tolist()
        self._marks = []
        for p in self._placed:
            own = control.observations_of(p)
            own = own[marked.is_used[own]]
            sigma = marked.spread * control.obs_sigma_px[own]
            self._marks.append(Marks(control.obs_image_idx[own], control.obs_xy[own], sigma))

    def solve(self, is_used: Mask, spread: float) -> ControlSolution:
        """Adjust the model with the surveys of some points, their sigmas multiplied, and leave each out in turn."""
        surveyed = [
            Surveyed(place, spread**2 * own)
            for place, own in zip(self._survey.place, self._survey.covariance, strict=True)
        ]
        free = self._adjusting.free
        factors = [
            LandmarkFactor(self._model, free, marks, surveyed[p] if is_used[p] else None, surveyed[p].place)
            for p, marks in zip(self._placed, self._marks, strict=True)
        ]
        optimized = self._adjusting.to_optimize()
        for factor in factors:
            optimized.add(factor.gtsam_factor())
        optimized.optimize()
        return self._judge(is_used, spread, surveyed, factors)

    def _judge(
        self, is_used: Mask, spread: float, surveyed: Sequence[Surveyed], factors: Sequence[LandmarkFactor]
    ) -> ControlSolution:
        """Where an adjusted model puts its points, and where it would if each of them had taken no part."""
        judged = self._adjusting.to_judge()
        for factor in factors:
            judged.add(factor.gtsam_factor())
        images = sorted({int(i) for factor in factors for i in factor.marks.image_idx})
        cameras = sorted({c for factor in factors for c in factor.cameras})
        joint = judged.marginal_covariance(images=images, cameras=cameras)
        # gtsam's tangent of world_from_cam is the negative of ours
        sign = np.where(np.arange(len(joint.matrix)) < 6 * len(images), -1.0, 1.0)
        matrix = joint.matrix * np.outer(sign, sign)
        place: Array = np.full((len(is_used), 3), np.nan)
        left_out: list[LeftOut | None] = [None] * len(is_used)
        for p, factor in zip(self._placed, factors, strict=True):
            found = factor.at(self._model)
            if found is None:
                continue
            place[p] = found.place
            if not joint.is_determined:
                continue
            rows = self._rows(factor, images, cameras)
            covariance = factor.covariance(found, matrix[np.ix_(rows, rows)])
            how = leave_out if is_used[p] else left_out_already
            left_out[p] = how(found.place, covariance, surveyed[p].place, surveyed[p].covariance)
        return ControlSolution(is_used, place, left_out, spread)

    def _rows(self, factor: LandmarkFactor, images: list[int], cameras: list[int]) -> NDArray[np.int64]:
        """Where the variables of a factor are among those of all images and cameras."""
        sizes = [len(self._adjusting.free[c]) for c in cameras]
        first = 6 * len(images) + np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        poses = [6 * images.index(int(i)) + np.arange(6) for i in factor.marks.image_idx]
        lenses = [np.arange(first[n], first[n + 1]) for n in (cameras.index(c) for c in factor.cameras)]
        return np.concatenate([*poses, *lenses]).astype(np.int64)
