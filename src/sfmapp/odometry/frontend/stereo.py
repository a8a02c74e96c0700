"""Finding the points of one camera of a rig in the other, through any lenses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import pixels_to_normalized, project
from sfmapp.geometry import rigid3
from sfmapp.odometry.frontend.alignment import align_patches
from sfmapp.odometry.frontend.epipolar_search import search_along_epipolar
from sfmapp.odometry.frontend.pyramid import Pyramid
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]

# The nearest depth that is searched, in baselines: closer things leave one image or the other.
_NEAREST = 2.0
# Distance between the candidates along the line, pixels: half of what the alignment converges over.
_STEP_PX = 2.0
# A match agrees with the epipolar line to that many pixels, and with a forward-backward check.
_MAX_OFF_LINE_PX = 1.5
_MIN_LIKENESS = 0.8


def match_stereo(rig: Rig, pyramids: tuple[Pyramid, ...], xy: Array, depth: Array) -> Array:
    """Where points of the first camera are in the second.

    Args:
        pyramids: of the two images. xy: (N, 2) pixels in the first. depth: (N,) along z in the first camera, in the
            unit of the rig; NaN where it is not known: those are searched for along their epipolar lines.

    Returns:
        (N, 2) pixels in the second, NaN where not found.
    """
    left, right = rig.cameras[0], rig.cameras[1]
    right_from_left = rig.cam_from_rig[1]
    rays = np.column_stack([pixels_to_normalized(left, xy), np.ones(len(xy))])
    out = np.full((len(xy), 2), np.nan)
    known = np.flatnonzero(np.isfinite(depth) & (depth > 0))
    guess = project(right, rigid3.apply(right_from_left, rays[known] * depth[known, None]))
    aligned = align_patches(pyramids[0], xy[known], pyramids[1], np.nan_to_num(guess, nan=-1e6), coarsest_level=1)
    good = aligned.is_converged & (aligned.zncc > _MIN_LIKENESS)
    out[known[good]] = aligned.xy[good]
    lost = np.flatnonzero(np.isnan(out[:, 0]))
    segments, counts = _candidates(rig, rays[lost])
    there, zncc, is_found = search_along_epipolar(pyramids[0], xy[lost], pyramids[1], segments, counts)
    good = is_found & (zncc > _MIN_LIKENESS)
    out[lost[good]] = there[good]
    out[~(_off_line_px(rig, rays, out) <= _MAX_OFF_LINE_PX)] = np.nan
    return out


def _candidates(rig: Rig, rays: Array) -> tuple[Array, NDArray[np.int64]]:
    """(N, P, 2) places along the epipolar curves, evenly spaced in inverse depth, and how many of them to look at."""
    right_from_left, right = rig.cam_from_rig[1], rig.cameras[1]
    baseline = float(np.linalg.norm(rigid3.center(right_from_left)))
    # the image moves by about f b / z: so many steps of so many pixels from infinity to the nearest depth
    num = int(np.ceil(right.focal / (_NEAREST * _STEP_PX))) + 1
    inverse = np.linspace(0, 1 / (_NEAREST * baseline), min(num, int(right.width / _STEP_PX)))
    rotation = rigid3.rotation_matrix(right_from_left)
    places = (rays @ rotation.T)[:, None, :] + inverse[None, :, None] * right_from_left[4:]
    segments = project(right, places.reshape(-1, 3)).reshape(len(rays), len(inverse), 2)
    inside = np.isfinite(segments[:, :, 0]) & (segments[:, :, 0] > 0) & (segments[:, :, 0] < right.width)
    inside &= (segments[:, :, 1] > 0) & (segments[:, :, 1] < right.height)
    # what is left of a curve after its first step out of the image is not looked at
    counts = np.where(inside.all(1), inside.shape[1], np.argmin(inside, 1))
    return np.nan_to_num(segments, nan=-1e6), counts.astype(np.int64)


def _off_line_px(rig: Rig, rays: Array, xy: Array) -> Array:
    """(N,) distance of matches from their epipolar lines, in pixels of the second camera; NaN where there is none."""
    out = np.full(len(xy), np.nan)
    found = np.isfinite(xy[:, 0])
    line, here = _lines(rig, rays[found], xy[found])
    out[found] = rig.cameras[1].focal * np.abs((line * here).sum(1))
    return out


def _lines(rig: Rig, rays: Array, xy: Array) -> tuple[Array, Array]:
    """Epipolar lines (N, 3) with unit normals in the second camera, and the rays (N, 3) of the matches there."""
    right_from_left = rig.cam_from_rig[1]
    line = (rays @ rigid3.rotation_matrix(right_from_left).T) @ rigid3.skew(right_from_left[4:]).T
    here = np.column_stack([pixels_to_normalized(rig.cameras[1], xy), np.ones(len(xy))])
    return line / np.linalg.norm(line[:, :2], axis=1)[:, None], here
