"""What to photograph next: the views that would make projections surest, by their expected information.

A view that is not taken yet has normal equations all the same: where its points would be follows from the camera, and
how well they would be measured from the noise so far. So views are tried in the mind, one after another, and the one is
taken that lowers the mean variance of projections over the picture most (A-optimal design; Atkinson and Donev, "Optimum
experimental designs", 1992).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.adjustment import Fit, TargetView, normal_at, observations_of
from sfmapp.calibration.boards import Board
from sfmapp.calibration.kernels import Normal
from sfmapp.calibration.result import CameraCalibration
from sfmapp.calibration.uncertainty import image_grid, projection_sigma
from sfmapp.camera.camera import pixels_to_rays, project
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

# where the middle of the board may be, as shares of the picture; how much of its width it fills; and how it is tilted
_PLACES = (0.1, 0.3, 0.5, 0.7, 0.9)
_FILLS = (0.45, 0.8)
_TILTS_DEG = (
    (0.0, 0.0), (50.0, 0.0), (-50.0, 0.0), (0.0, 50.0), (0.0, -50.0),
    (35.0, 35.0), (-35.0, 35.0), (35.0, -35.0), (-35.0, -35.0),
)  # fmt: skip
# the best of these is moved by such steps, then by half of them, as long as that is better, within bounds: place, share
# of the width, tilts in degrees
_STEPS = (0.1, 0.1, 0.15, 10.0, 10.0)
_BOUNDS = ((0.05, 0.95), (0.05, 0.95), (0.3, 1.0), (-55.0, 55.0), (-55.0, 55.0))
# of both together: every finder of boards here sees them at 60 degrees
_LARGEST_TILT_DEG = 55.0
_HALVINGS, _MOVES = 1, 4
# of the points; a board that is further out of the picture is not found
_INSIDE = 0.5
_MARGIN_PX = 4.0
_GRID = (11, 8)


@dataclass(frozen=True)
class NextView:
    """A view that is worth taking.

    Attributes:
        cam_from_target: (7,) where the board would be.
        xy: (N, 2) pixels of its points in the picture.
        hint: how to take it, in words.
        mean_sigma_px: of projections over the picture once it is taken, with those before it.
    """

    cam_from_target: Array
    xy: Array
    hint: str
    mean_sigma_px: float


@dataclass(frozen=True)
class _Sums:
    """What of normal equations the covariance follows from: parameters with the poses eliminated, and the frame."""

    reduced: Array
    coupling: Array
    weight: Array

    def plus(self, other: _Sums) -> _Sums:
        return _Sums(self.reduced + other.reduced, self.coupling + other.coupling, self.weight + other.weight)


def next_views(
    made: CameraCalibration, fit: Fit, views: list[TargetView], board: Board, num: int = 3
) -> list[NextView]:
    """The views to photograph next, the best first; fewer where none is possible.

    Args:
        made: the calibration so far.
        fit, views: that it follows from; the poses are those of the views.
    """
    flat = Fit(fit.camera, fit.cam_from_target, np.zeros(0), 0.0)
    sums = _sums(normal_at(flat, observations_of(views)))
    # a board that fills half of the picture, where the calibration does not say how far its boards were
    half_full = 2.0 * float(np.ptp(board.points[:, 0])) * fit.camera.focal / fit.camera.width
    distance = made.distances[1] if made.distances else half_full
    planner = _Planner(made, board, distance)
    found: list[NextView] = []
    for _ in range(num):
        best = planner.best(sums)
        if best is None:
            break
        sums = sums.plus(best.block)
        found.append(NextView(best.pose, best.view.xy, _hint(best.place), planner.sigma_px(sums)))
    return found


def mean_sigma(made: CameraCalibration, distance: float | None = None) -> float:
    """Root of the mean variance of a projection over the picture, pixels."""
    sigma = projection_sigma(made, image_grid(made.camera, _GRID), distance)
    return float(np.sqrt(np.nanmean(sigma**2)))


def _sums(normal: Normal) -> _Sums:
    is_seen = normal.own[:, 0, 0] > 0
    own, cross = normal.own[is_seen], normal.cross[is_seen]
    reduced = normal.shared - np.einsum("vsi,vij,vtj->st", cross, np.linalg.inv(own), cross)
    return _Sums(reduced, cross.sum(0), own.sum(0))


def _mean_sigma(made: CameraCalibration, sums: _Sums, distance: float) -> float:
    scale = 1.0 / np.sqrt(np.maximum(np.diag(sums.reduced), 1e-300))
    try:
        params = np.linalg.inv(sums.reduced * scale[:, None] * scale) * scale[:, None] * scale * made.noise_px**2
        weight = np.linalg.inv(sums.weight)
    except np.linalg.LinAlgError:
        return float("inf")
    coupling = sums.coupling @ weight
    beside = -params @ coupling
    joint = np.block([[params, beside], [beside.T, made.noise_px**2 * weight + coupling.T @ params @ coupling]])
    if not np.isfinite(joint).all() or (np.diag(joint) < 0).any():
        return float("inf")
    num = len(params)
    expected = CameraCalibration(made.camera, joint[:num, :num], "", made.noise_px, 1, frame_covariance=joint)
    return mean_sigma(expected, distance)


@dataclass(frozen=True)
class _Candidate:
    """A view that might be taken: (u, v, fill, tilt, tilt), where it is, what is seen, and what that tells."""

    place: tuple[float, ...]
    pose: Array
    view: TargetView
    block: _Sums


class _Planner:
    """Views of a board before a camera, and what they would bring."""

    def __init__(self, made: CameraCalibration, board: Board, distance: float) -> None:
        self._made, self._board, self._distance = made, board, distance
        self._middle, self._extent = board.points.mean(0), float(np.ptp(board.points, axis=0).max())
        grid = product(_PLACES, _PLACES, _FILLS, _TILTS_DEG)
        tried = [self._at((u, v, fill, *tilt)) for u, v, fill, tilt in grid]
        self._candidates = [one for one in tried if one is not None]

    def sigma_px(self, sums: _Sums) -> float:
        """Root of the mean variance of a projection once these sums are those of the views."""
        return _mean_sigma(self._made, sums, self._distance)

    def best(self, sums: _Sums) -> _Candidate | None:
        """The view that helps most beside those that make the sums; None where none does."""
        scores = [self.sigma_px(sums.plus(one.block)) for one in self._candidates]
        if not scores or not np.isfinite(min(scores)):
            return None
        best, score = self._candidates[int(np.argmin(scores))], min(scores)
        for halving in range(_HALVINGS + 1):
            for _ in range(_MOVES):
                before = score
                for k, step in enumerate(_STEPS):
                    for sign in (-1.0, 1.0):
                        place = list(best.place)
                        place[k] = float(np.clip(place[k] + sign * step / 2.0**halving, *_BOUNDS[k]))
                        tried = self._at(tuple(place))
                        now = np.inf if tried is None else self.sigma_px(sums.plus(tried.block))
                        if tried is not None and now < score:
                            best, score = tried, now
                if not score < before:
                    break
        return best

    def _at(self, place: tuple[float, ...]) -> _Candidate | None:
        """The view at a place; None where too little of the board is in the picture."""
        u, v, fill, *tilt = place
        if np.hypot(tilt[0], tilt[1]) > _LARGEST_TILT_DEG:
            return None
        camera, board = self._made.camera, self._board
        ray = pixels_to_rays(camera, np.array([[u * camera.width, v * camera.height]]))[0]
        if not np.isfinite(ray).all():
            return None
        # as far as makes the board fill so much of the width where the lens is straight, along the ray
        depth = self._extent * camera.focal / (fill * camera.width)
        rotation = rigid3.exp_so3(np.radians([tilt[0], tilt[1], 0.0]))
        pose = rigid3.from_matrix(rotation, ray * depth - rotation @ self._middle)
        xy = project(camera, rigid3.apply(pose, board.points))
        with np.errstate(invalid="ignore"):
            inside = ((xy > _MARGIN_PX) & (xy < np.array([camera.width, camera.height]) - _MARGIN_PX)).all(1)
        if inside.mean() < _INSIDE:
            return None
        view = TargetView("", board.points[inside], xy[inside])
        block = _sums(normal_at(Fit(camera, pose[None], np.zeros(0), 0.0), observations_of([view])))
        return _Candidate(place, pose, view, block)


def _hint(place: tuple[float, ...]) -> str:
    u, v, fill, *tilt = place
    rows = "top" if v < 0.4 else "bottom" if v > 0.6 else ""
    columns = "left" if u < 0.4 else "right" if u > 0.6 else ""
    where = f"at the {' '.join(part for part in (rows, columns) if part)}" if rows or columns else "in the middle"
    parts = []
    if tilt[0]:
        parts.append(f"{'top' if tilt[0] > 0 else 'bottom'} edge {abs(tilt[0]):.0f} degrees towards the camera")
    if tilt[1]:
        parts.append(f"{'right' if tilt[1] > 0 else 'left'} edge {abs(tilt[1]):.0f} degrees towards the camera")
    turned = " and ".join(parts) or "facing the camera"
    return f"board {where} of the picture, as wide as {fill:.0%} of it, {turned}"
