"""Photometric refinement of keypoints: the patches of a track are aligned with each other to a fraction of a pixel.

A detector places each keypoint on its own, to a third of a pixel or so. Once cameras and points are known, a small
patch of the tangent plane at each point can be cut out of every image that sees it, all in one frame; what shift is left between
them is noise of the detector, and Lucas-Kanade takes it out (Baker and Matthews, IJCV 2004; for tracks cf. Furukawa and
Ponce, "Accurate camera calibration from multi-view stereo and bundle adjustment", IJCV 2009, and Lindenberger et al.,
"Pixel-perfect structure-from-motion", ICCV 2021). The mean shift of a track is left alone: it would only move the point.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.features.features import Features
from sfmapp.geometry import rigid3
from sfmapp.geometry.lens import distort
from sfmapp.images.pixels import read_gray
from sfmapp.scene.reconstruction import Reconstruction

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet

# Compared window and cut-out patch, half sides in samples; the margin leaves room for the shift and the interpolation.
WINDOW, PATCH = 6, 9
SIDE = 2 * PATCH + 1
MAX_SHIFT = float(PATCH - WINDOW - 1)
# A sample is this many standard deviations of the detector's Gaussian: the window spans the blob and its surroundings.
SAMPLES_PER_SCALE = 0.6
MAX_LEVEL = 4
# Below this correlation with the others a patch shows something else, or its plane is not the assumed one.
MIN_NCC = 0.7
# Patches held at a time; 400 000 of them take 290 MB.
MAX_PATCHES = 400_000
STAGE = "alignment"


def align_keypoints(
    reconstruction: Reconstruction,
    image_set: ImageSet,
    features: Sequence[Features],
    pool: Executor,
    events: Events,
) -> dict[str, Any]:
    """Move the inlier observations of a reconstruction onto each other, in place; its tracks are replaced.

    Args:
        reconstruction: registered and triangulated; ``tracks.obs_xy`` is refined.
        image_set: where the pixels come from.
        features: whose scales say how large a patch is.
        pool: reads images and aligns tracks.
        events: progress.

    Returns:
        Counts, and the root mean square shift in pixels.
    """
    tracks = reconstruction.tracks
    used = np.flatnonzero(reconstruction.obs_is_inlier)
    obs_xy = tracks.obs_xy.copy()
    scale = np.ones(len(obs_xy))
    for i, feature in enumerate(features):
        obs = tracks.observations_of_image(i)
        scale[obs] = feature.keypoints[tracks.obs_feature_idx[obs], 2]
    jacobians = _patch_jacobians(reconstruction, used, scale[used])
    # blocks end at the ends of tracks, so that a track is never cut in two
    track_of = tracks.obs_track_idx[used]
    starts = np.flatnonzero(np.r_[True, track_of[1:] != track_of[:-1]])
    blocks = _blocks(np.r_[starts, len(used)])
    events.started(STAGE, "aligning keypoints", total=len(blocks) * len(reconstruction.registered_idx))
    shifts = np.zeros((len(used), 2))
    ncc = np.zeros(len(used))
    for first, last in blocks:
        patches = _cut_patches(reconstruction, image_set, used[first:last], jacobians[first:last], pool, events)
        ptr = np.r_[starts[(starts >= first) & (starts < last)], last] - first
        parts = np.array_split(np.arange(len(ptr) - 1), max(1, len(ptr) // 2048))
        list(
            pool.map(
                lambda part, p=patches, q=ptr, a=first, b=last: _align(q, part, p, shifts[a:b], ncc[a:b]), parts
            )
        )
    moved = np.isfinite(shifts[:, 0]) & (ncc >= MIN_NCC)
    delta = np.einsum("nij,nj->ni", jacobians, np.where(moved[:, None], shifts, 0.0))
    obs_xy[used] += delta
    reconstruction.tracks = replace(tracks, obs_xy=obs_xy)
    rms = float(np.sqrt((delta[moved] ** 2).sum(1).mean())) if moved.any() else 0.0
    report = {"num_observations": len(used), "num_aligned": int(moved.sum()), "rms_shift_px": rms}
    events.finished(STAGE, f"{int(moved.sum())} of {len(used)} keypoints aligned, by {rms:.2f} px rms", **report)
    return report


def _blocks(ends: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Ranges of observations that hold whole tracks and at most MAX_PATCHES of them (one track at least)."""
    blocks: list[tuple[int, int]] = []
    first = 0
    while first < ends[-1]:
        fits = int(np.searchsorted(ends, first + MAX_PATCHES, side="right")) - 1
        last = int(max(ends[fits], ends[np.searchsorted(ends, first, side="right")]))
        blocks.append((first, last))
        first = last
    return blocks


def _patch_jacobians(
    reconstruction: Reconstruction, used: NDArray[np.int64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N, 2, 2) pixels per patch sample along the two axes of each track's tangent plane.

    The plane faces the mean of the viewing directions. The step between samples is the same for all images of a track: that
    of the image that resolves the point least.
    """
    tracks = reconstruction.tracks
    image, track = tracks.obs_image_idx[used], tracks.obs_track_idx[used]
    point = reconstruction.point_xyz[track]
    toward = reconstruction.centers[image] - point
    distance = np.linalg.norm(toward, axis=1)
    toward /= distance[:, None]
    normal = np.zeros((tracks.num_tracks, 3))
    np.add.at(normal, track, toward)
    normal = normal[track] / np.maximum(np.linalg.norm(normal[track], axis=1, keepdims=True), 1e-12)
    # any axis that is not along the normal gives the same patch up to a turn, as the turn is common to all images
    helper = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    focal = np.array([c.focal for c in reconstruction.cameras])[reconstruction.image_camera_idx[image]]
    step = np.zeros(tracks.num_tracks)
    # never finer than a pixel: there is nothing between the pixels
    np.maximum.at(step, track, distance / focal * np.maximum(1.0, SAMPLES_PER_SCALE * scale))
    axes = np.stack([first, np.cross(normal, first)], 1) * step[track][:, None, None]
    out = np.empty((len(used), 2, 2))
    canonical, fisheye = reconstruction.canonical_cameras()
    _project_axes(
        point, axes, rigid3.rotation_matrix(reconstruction.cam_from_world),
        np.ascontiguousarray(reconstruction.cam_from_world[:, 4:]), image, reconstruction.image_camera_idx, canonical,
        fisheye, out,
    )  # fmt: skip
    return out


@numba.njit(cache=True, nogil=True)
def _project_axes(
    point: NDArray[np.float64],
    axes: NDArray[np.float64],
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
    image: NDArray[np.int32],
    image_camera_idx: NDArray[np.int32],
    canonical: NDArray[np.float64],
    fisheye: NDArray[np.bool_],
    out: NDArray[np.float64],
) -> None:
    """Columns of out are central differences of the projection along the two axes."""
    ends = np.empty((2, 2))
    for n in range(point.shape[0]):
        i = image[n]
        k = image_camera_idx[i]
        for axis in range(2):
            for side in range(2):
                sign = 1.0 - 2.0 * side
                x0 = point[n, 0] + sign * axes[n, axis, 0]
                x1 = point[n, 1] + sign * axes[n, axis, 1]
                x2 = point[n, 2] + sign * axes[n, axis, 2]
                x = rotation[i, 0, 0] * x0 + rotation[i, 0, 1] * x1 + rotation[i, 0, 2] * x2 + translation[i, 0]
                y = rotation[i, 1, 0] * x0 + rotation[i, 1, 1] * x1 + rotation[i, 1, 2] * x2 + translation[i, 1]
                z = rotation[i, 2, 0] * x0 + rotation[i, 2, 1] * x1 + rotation[i, 2, 2] * x2 + translation[i, 2]
                ends[side, 0], ends[side, 1] = distort(fisheye[k], canonical[k], x / z, y / z)
            out[n, 0, axis] = 0.5 * (ends[0, 0] - ends[1, 0])
            out[n, 1, axis] = 0.5 * (ends[0, 1] - ends[1, 1])


def _cut_patches(
    reconstruction: Reconstruction,
    image_set: ImageSet,
    obs: NDArray[np.int64],
    jacobians: NDArray[np.float64],
    pool: Executor,
    events: Events,
) -> NDArray[np.uint16]:
    """(N, SIDE * SIDE) uint16 grey values times 256; zeros where the patch leaves the image."""
    patches = np.zeros((len(obs), SIDE * SIDE), np.uint16)
    image, xy = reconstruction.tracks.obs_image_idx[obs], reconstruction.tracks.obs_xy[obs]

    def cut(i: int) -> None:
        import cv2

        mine = np.flatnonzero(image == i)
        if len(mine) == 0:
            return
        levels = [read_gray(image_set.images[i])]
        # the level on which a sample is between one and two pixels apart
        spacing = np.sqrt(np.abs(np.linalg.det(jacobians[mine])))
        level = np.clip(np.floor(np.log2(np.maximum(spacing, 1.0))), 0, MAX_LEVEL).astype(np.int64)
        for n in range(int(level.max()) + 1):
            if n > 0:
                levels.append(cv2.pyrDown(levels[-1]))
            here = mine[level == n]
            # pyrDown keeps the centre of pixel 0 where it was: level coordinates, centres at integers, are x / 2^n
            _sample(levels[n], (xy[here] - 0.5) / 2**n, jacobians[here] / 2**n, here, patches)

    for _ in pool.map(cut, reconstruction.registered_idx.tolist()):
        events.advanced(STAGE)
    return patches


@numba.njit(cache=True, nogil=True)
def _sample(
    image: NDArray[np.uint8],
    centre: NDArray[np.float64],
    jacobian: NDArray[np.float64],
    rows: NDArray[np.int64],
    out: NDArray[np.uint16],
) -> None:
    """Bilinear samples of affine patches; a patch that leaves the image stays zero."""
    height, width = image.shape
    for n in range(rows.shape[0]):
        a, b, c, d = jacobian[n, 0, 0], jacobian[n, 0, 1], jacobian[n, 1, 0], jacobian[n, 1, 1]
        reach_x, reach_y = PATCH * (abs(a) + abs(b)), PATCH * (abs(c) + abs(d))
        x0, y0 = centre[n, 0], centre[n, 1]
        if not (x0 - reach_x >= 0 and y0 - reach_y >= 0 and x0 + reach_x < width - 1 and y0 + reach_y < height - 1):
            continue
        row = rows[n]
        index = 0
        for j in range(-PATCH, PATCH + 1):
            for i in range(-PATCH, PATCH + 1):
                x, y = x0 + a * i + b * j, y0 + c * i + d * j
                u, v = int(x), int(y)
                s, t = x - u, y - v
                top = (1.0 - s) * image[v, u] + s * image[v, u + 1]
                bottom = (1.0 - s) * image[v + 1, u] + s * image[v + 1, u + 1]
                out[row, index] = int(256.0 * ((1.0 - t) * top + t * bottom) + 0.5)
                index += 1


@numba.njit(cache=True, nogil=True)
def _window(patch: NDArray[np.float64], dx: float, dy: float, out: NDArray[np.float64]) -> bool:
    """The window of a patch shifted by (dx, dy) samples, with zero mean and unit norm; False if it is flat."""
    i0, j0 = math.floor(dx), math.floor(dy)
    s, t = dx - i0, dy - j0
    w00, w01, w10, w11 = (1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t
    mean = 0.0
    index = 0
    for j in range(PATCH - WINDOW + j0, PATCH + WINDOW + 1 + j0):
        for i in range(PATCH - WINDOW + i0, PATCH + WINDOW + 1 + i0):
            k = j * SIDE + i
            value = w00 * patch[k] + w01 * patch[k + 1] + w10 * patch[k + SIDE] + w11 * patch[k + SIDE + 1]
            out[index] = value
            mean += value
            index += 1
    mean /= index
    norm = 0.0
    for k in range(index):
        out[k] -= mean
        norm += out[k] * out[k]
    # a standard deviation of one grey level: less is noise
    if norm < index * 256.0 * 256.0:
        return False
    norm = 1.0 / math.sqrt(norm)
    for k in range(index):
        out[k] *= norm
    return True


@numba.njit(cache=True, nogil=True)
def _align(
    ptr: NDArray[np.int64],
    tracks: NDArray[np.int64],
    patches: NDArray[np.uint16],
    shifts: NDArray[np.float64],
    ncc: NDArray[np.float64],
) -> None:
    """Shift the patches of each track towards their mean, in turns; writes shifts in samples (NaN if unusable) and NCC."""
    size = 2 * WINDOW + 1
    area = size * size
    longest = 1
    for t in tracks:
        longest = max(longest, ptr[t + 1] - ptr[t])
    patch = np.empty((longest, SIDE * SIDE))
    window = np.empty((longest, area))
    template = np.empty(area)
    gx = np.empty(area)
    gy = np.empty(area)
    usable = np.empty(longest, np.bool_)
    for t in tracks:
        first = ptr[t]
        count = ptr[t + 1] - first
        num = 0
        for m in range(count):
            usable[m] = patches[first + m, 0] > 0
            for k in range(SIDE * SIDE):
                patch[m, k] = patches[first + m, k]
            shifts[first + m, 0] = shifts[first + m, 1] = 0.0
            usable[m] = usable[m] and _window(patch[m], 0.0, 0.0, window[m])
            num += usable[m]
        if num >= 2:
            for _ in range(6):
                template[:] = 0.0
                for m in range(count):
                    if usable[m]:
                        for k in range(area):
                            template[k] += window[m, k]
                # gradients of the template: it is the least noisy of all
                h00 = h01 = h11 = 0.0
                norm = 0.0
                for j in range(size):
                    for i in range(size):
                        k = j * size + i
                        norm += template[k] * template[k]
                        gx[k] = gy[k] = 0.0
                        if 0 < i < size - 1 and 0 < j < size - 1:
                            gx[k] = 0.5 * (template[k + 1] - template[k - 1])
                            gy[k] = 0.5 * (template[k + size] - template[k - size])
                            h00 += gx[k] * gx[k]
                            h01 += gx[k] * gy[k]
                            h11 += gy[k] * gy[k]
                det = h00 * h11 - h01 * h01
                # texture in one direction only leaves the shift along it open
                if norm < 1e-12 or det < 0.01 * (h00 + h11) ** 2:
                    for m in range(count):
                        usable[m] = False
                    break
                scale = 1.0 / math.sqrt(norm)
                largest = 0.0
                mean_x = mean_y = 0.0
                num = 0
                for m in range(count):
                    if not usable[m]:
                        continue
                    b0 = b1 = correlation = 0.0
                    for k in range(area):
                        correlation += template[k] * scale * window[m, k]
                    for k in range(area):
                        e = template[k] - window[m, k] / scale * correlation
                        b0 += gx[k] * e
                        b1 += gy[k] * e
                    ncc[first + m] = correlation
                    dx, dy = (h11 * b0 - h01 * b1) / det, (h00 * b1 - h01 * b0) / det
                    shifts[first + m, 0] += dx
                    shifts[first + m, 1] += dy
                    mean_x += shifts[first + m, 0]
                    mean_y += shifts[first + m, 1]
                    num += 1
                    largest = max(largest, abs(dx), abs(dy))
                if num == 0:
                    break
                for m in range(count):
                    if not usable[m]:
                        continue
                    shifts[first + m, 0] -= mean_x / num
                    shifts[first + m, 1] -= mean_y / num
                    sx, sy = shifts[first + m, 0], shifts[first + m, 1]
                    usable[m] = (
                        abs(sx) < MAX_SHIFT and abs(sy) < MAX_SHIFT and _window(patch[m], sx, sy, window[m])
                    )  # fmt: skip
                if largest < 0.01:
                    break
        for m in range(count):
            if not usable[m]:
                shifts[first + m, 0] = shifts[first + m, 1] = math.nan
