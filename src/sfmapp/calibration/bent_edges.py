"""Where the crossings of a board are in pictures, once a camera is known: freed of the bend of the edges around them.

A crossing is measured as the point that its surroundings are symmetric about (:mod:`sfmapp.calibration.symmetry`).
Where the lens bends the edges, the middle of a chord is beside its edge, so the point moves to the inside of the bend:
by a hundredth of a pixel in most places, by two tenths where a strong barrel distortion is strongest. That is no noise:
all photographs have it in the same places, it passes for distortion, and no residual shows it. With a camera and poses
the edges are projected and the shift follows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.adjustment import TargetView, observations_of, refine
from sfmapp.calibration.start import posed
from sfmapp.calibration.symmetry import WINDOW_DECAY
from sfmapp.camera.camera import Camera, project
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

# places along half of the window, by the midpoint rule, and the step by which directions are measured, in fields
_PLACES, _STEP = (0.125, 0.375, 0.625, 0.875), 0.1


def unbent(views: Sequence[TargetView], camera: Camera, spacing: float, reach: float, largest_px: float) -> list[Array]:
    """Crossings (N, 2) in V photographs, pixels, by a camera that is known and the poses that fit it.

    Args:
        views: with the crossings as they were measured.
        spacing: side of a field, in the unit of the board.
        reach: half of the window along the edges, in fields. largest_px: the same in pixels, at most.

    A crossing whose surroundings the lens does not see keeps what it had.
    """
    placed = refine(posed(camera, views), observations_of(views), hold_camera=True)
    found = []
    for view, pose in zip(views, placed.cam_from_target, strict=True):
        shift = bend_shift(camera, pose, view.xyz, spacing, (reach, largest_px))
        found.append(np.where(np.isfinite(shift), view.xy - shift, view.xy))
    return found


def bend_shift(camera: Camera, cam_from_board: Array, xyz: Array, spacing: float, window: tuple[float, float]) -> Array:
    """(N, 2) by how many pixels crossings are measured beside where they are; NaN where the lens does not see it.

    Each edge moves the point across itself by what the middles of its chords are off, in the mean over the weights of
    the window; both edges together give two equations.

    Args:
        cam_from_board: (7,). xyz: (N, 3) in the plane of the board. window: see :func:`unbent`.
    """
    middle = project(camera, rigid3.apply(cam_from_board, xyz))
    across, off = np.empty((len(xyz), 2, 2)), np.empty((len(xyz), 2))
    weights = np.exp(-WINDOW_DECAY * np.square(_PLACES))
    with np.errstate(all="ignore"):
        for k in range(2):
            side = spacing * np.eye(3)[k]
            ends = [project(camera, rigid3.apply(cam_from_board, xyz + s * _STEP * side)) for s in (1.0, -1.0)]
            along = (ends[0] - ends[1]) / (2.0 * _STEP)
            length = np.linalg.norm(along, axis=1)
            half = np.minimum(window[0], window[1] / length)[:, None] * side
            across[:, k] = np.stack([-along[:, 1], along[:, 0]], 1) / length[:, None]
            chords = np.zeros_like(middle)
            for place, weight in zip(_PLACES, weights / weights.sum(), strict=True):
                both = [project(camera, rigid3.apply(cam_from_board, xyz + s * place * half)) for s in (1.0, -1.0)]
                chords += weight * (0.5 * (both[0] + both[1]) - middle)
            off[:, k] = (across[:, k] * chords).sum(1)
        is_known = np.isfinite(off).all(1) & (np.abs(np.linalg.det(across)) > 1e-3)
    shift = np.full((len(xyz), 2), np.nan)
    shift[is_known] = np.linalg.solve(across[is_known], off[is_known][..., None])[..., 0]
    return shift
