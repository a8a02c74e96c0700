"""Points from rays: two-view and robust multi-view triangulation over flat arrays.

Two rays give the midpoint of their common perpendicular (Hartley and Sturm, "Triangulation", CVIU 1997, section 5.3).
A track is triangulated like COLMAP's (Schoenberger and Frahm, CVPR 2016, section 4.3): hypotheses from pairs of
observations, the one with most inliers wins. The winner is refined on its inliers by minimising the angular error,
reweighted by depth: for the small residuals that are left this is the reprojection error to first order.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.lens import across_seam, project, undistort, unproject
from sfmapp.simd.copying import copy_into

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]
Bools = NDArray[np.bool_]

# A track of 10 observations has 45 pairs; longer ones are sampled with about as many.
MAX_HYPOTHESES = 45
# The same thing is told in two photographs where it is larger in one of them by less than a scale space has octaves
# for, of which ten are 1000. A wrong match whose one ray passes another camera has its point in that camera's centre,
# where it agrees with any pixel.
_NEAREST_SHARE = 1e-3


class Views(NamedTuple):
    """Where images (I) stand and through which lenses (C) they look.

    Attributes:
        rotation, translation: (I, 3, 3), (I, 3) cam_from_world, NaN where unregistered.
        camera_idx: (I,) int32 which lens each has.
        canonical: (C, ROW) their parameters, see ``Camera.canonical``.
    """

    rotation: Array
    translation: Array
    camera_idx: Int32s
    canonical: Array


class Observed(NamedTuple):
    """Tracks (T) and their observations (O): those of track t are ``track_ptr[t] : track_ptr[t + 1]``.

    Attributes:
        track_ptr: (T + 1,) int64. image_idx: (O,) int32. xy: (O, 2) pixels.
    """

    track_ptr: Ints
    image_idx: Int32s
    xy: Array


@numba.njit(cache=True, nogil=True)
def _midpoint(c1: Array, d1: Array, c2: Array, d2: Array, out: Array) -> float:
    """Midpoint of two rays into out (3,); returns the cosine between the rays, 2.0 if the point is behind a camera."""
    b = d1[0] * d2[0] + d1[1] * d2[1] + d1[2] * d2[2]
    w0, w1, w2 = c2[0] - c1[0], c2[1] - c1[1], c2[2] - c1[2]
    p = w0 * d1[0] + w1 * d1[1] + w2 * d1[2]
    q = w0 * d2[0] + w1 * d2[1] + w2 * d2[2]
    det = 1.0 - b * b
    if det < 1e-12:
        return 2.0
    s = (p - b * q) / det
    t = (b * p - q) / det
    if s <= 0.0 or t <= 0.0:
        return 2.0
    for k in range(3):
        out[k] = 0.5 * (c1[k] + s * d1[k] + c2[k] + t * d2[k])
    return b


@numba.njit(cache=True, nogil=True)
def _squared_error(xyz: Array, rotation: Array, translation: Array, c: Array, u: float, v: float) -> float:
    """Squared reprojection error in pixels; infinite where the lens does not look."""
    z = rotation[2, 0] * xyz[0] + rotation[2, 1] * xyz[1] + rotation[2, 2] * xyz[2] + translation[2]
    x = rotation[0, 0] * xyz[0] + rotation[0, 1] * xyz[1] + rotation[0, 2] * xyz[2] + translation[0]
    y = rotation[1, 0] * xyz[0] + rotation[1, 1] * xyz[1] + rotation[1, 2] * xyz[2] + translation[1]
    pu, pv = project(c, x, y, z)
    if math.isnan(pu):
        return math.inf
    du, dv = across_seam(c, pu - u), pv - v
    return du * du + dv * dv


@numba.njit(cache=True, nogil=True)
def _refine(xyz: Array, centers: Array, rays: Array, used: Bools, k: int) -> bool:
    """Three rounds of depth-weighted least squares on the distances to the used rays; False if it fails."""
    for _ in range(3):
        a00 = a01 = a02 = a11 = a12 = a22 = 0.0
        b0 = b1 = b2 = 0.0
        for i in range(k):
            if not used[i]:
                continue
            dx, dy, dz = rays[i, 0], rays[i, 1], rays[i, 2]
            cx, cy, cz = centers[i, 0], centers[i, 1], centers[i, 2]
            depth2 = (xyz[0] - cx) ** 2 + (xyz[1] - cy) ** 2 + (xyz[2] - cz) ** 2
            w = 1.0 / max(depth2, 1e-300)
            m00, m01, m02 = w * (1.0 - dx * dx), -w * dx * dy, -w * dx * dz
            m11, m12, m22 = w * (1.0 - dy * dy), -w * dy * dz, w * (1.0 - dz * dz)
            a00 += m00
            a01 += m01
            a02 += m02
            a11 += m11
            a12 += m12
            a22 += m22
            b0 += m00 * cx + m01 * cy + m02 * cz
            b1 += m01 * cx + m11 * cy + m12 * cz
            b2 += m02 * cx + m12 * cy + m22 * cz
        c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
        det = a00 * c00 + a01 * c01 + a02 * c02
        trace = a00 + a11 + a22
        if not det > 1e-18 * trace * trace * trace:
            return False
        c11, c12, c22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
        xyz[0] = (c00 * b0 + c01 * b1 + c02 * b2) / det
        xyz[1] = (c01 * b0 + c11 * b1 + c12 * b2) / det
        xyz[2] = (c02 * b0 + c12 * b1 + c22 * b2) / det
    return True


@numba.njit(cache=True, nogil=True)
def _min_cosine(xyz: Array, centers: Array, used: Bools, k: int, enough: float) -> float:
    """Cosine of the widest angle under which the used centres see the point; stops once it is below enough."""
    best = 1.0
    for i in range(k):
        if not used[i]:
            continue
        ax, ay, az = centers[i, 0] - xyz[0], centers[i, 1] - xyz[1], centers[i, 2] - xyz[2]
        na = math.sqrt(ax * ax + ay * ay + az * az)
        for j in range(i + 1, k):
            if not used[j]:
                continue
            bx, by, bz = centers[j, 0] - xyz[0], centers[j, 1] - xyz[1], centers[j, 2] - xyz[2]
            nb = math.sqrt(bx * bx + by * by + bz * bz)
            best = min(best, (ax * bx + ay * by + az * bz) / max(na * nb, 1e-300))
            if best <= enough:
                return best
    return best


@numba.njit(cache=True, nogil=True)
def _drop_nearest(xyz: Array, centers: Array, used: Bools, k: int) -> int:
    """Let go of the used centres that are closer to the point than the farthest by a share that no match bridges;
    returns how many are left."""
    farthest = 0.0
    for i in range(k):
        if used[i]:
            farthest = max(farthest, _squared_distance(xyz, centers[i]))
    left = 0
    for i in range(k):
        used[i] = used[i] and _squared_distance(xyz, centers[i]) >= _NEAREST_SHARE**2 * farthest
        left += used[i]
    return left


@numba.njit(cache=True, nogil=True)
def _squared_distance(a: Array, b: Array) -> float:
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return float(x * x + y * y + z * z)


@numba.njit(cache=True, nogil=True)
def _longest(tracks: Ints, track_ptr: Ints) -> int:
    longest = 2
    for t in tracks:
        longest = max(longest, track_ptr[t + 1] - track_ptr[t])
    return longest


@numba.njit(cache=True, nogil=True)
def _center(rotation: Array, translation: Array, out: Array) -> None:
    for a in range(3):
        out[a] = -(rotation[0, a] * translation[0] + rotation[1, a] * translation[1] + rotation[2, a] * translation[2])


@numba.njit(cache=True, nogil=True)
def _gather_rays(
    t: int,
    track_ptr: Ints,
    obs_image_idx: Int32s,
    obs_xy: Array,
    rotation: Array,
    translation: Array,
    image_camera_idx: Int32s,
    canonical: Array,
    obs: Ints,
    centers: Array,
    rays: Array,
) -> int:
    """Observations of a track in registered images, with their centres and unit rays; returns how many."""
    k = 0
    for o in range(track_ptr[t], track_ptr[t + 1]):
        i = obs_image_idx[o]
        if math.isnan(translation[i, 0]):
            continue
        cam = image_camera_idx[i]
        x, y = undistort(canonical[cam], obs_xy[o, 0], obs_xy[o, 1])
        r = rotation[i]
        if math.isnan(x):  # too far off the axis for the plane
            x, y, z = unproject(canonical[cam], obs_xy[o, 0], obs_xy[o, 1])
            if math.isnan(x):
                continue
            for a in range(3):
                rays[k, a] = r[0, a] * x + r[1, a] * y + r[2, a] * z
        else:
            norm = 1.0 / math.sqrt(x * x + y * y + 1.0)
            for a in range(3):
                rays[k, a] = (r[0, a] * x + r[1, a] * y + r[2, a]) * norm
        _center(r, translation[i], centers[k])
        obs[k] = o
        k += 1
    return k


@numba.njit(cache=True, nogil=True)
def _mark_inliers(
    xyz: Array,
    obs: Ints,
    k: int,
    obs_image_idx: Int32s,
    obs_xy: Array,
    rotation: Array,
    translation: Array,
    image_camera_idx: Int32s,
    canonical: Array,
    limit: float,
    used: Bools,
) -> tuple[int, float]:
    """Mark the observations with a squared error up to the limit; their number, and the truncated cost of all."""
    inliers = 0
    cost = 0.0
    for m in range(k):
        o = obs[m]
        i = obs_image_idx[o]
        cam = image_camera_idx[i]
        error = _squared_error(xyz, rotation[i], translation[i], canonical[cam], obs_xy[o, 0], obs_xy[o, 1])
        used[m] = error <= limit
        inliers += used[m]
        cost += min(error, limit)
    return inliers, cost


@numba.njit(cache=True, nogil=True)
def triangulate_tracks(
    tracks: Ints, observed: Observed, views: Views, max_error_px: float, min_angle_rad: float, point_xyz: Array,
    obs_is_inlier: Bools,
) -> int:  # fmt: skip
    """Triangulate tracks robustly from the registered images; returns how many succeeded.

    Args:
        tracks: (K,) int64, the tracks to try.
        max_error_px: largest reprojection error of an inlier.
        min_angle_rad: smallest angle between two rays of an accepted point.
        point_xyz, obs_is_inlier: written for the given tracks only; NaN and False where triangulation fails.
    """
    track_ptr, obs_image_idx, obs_xy = observed
    rotation, translation, image_camera_idx, canonical = views
    longest = _longest(tracks, track_ptr)
    obs = np.empty(longest, np.int64)
    centers, rays = np.empty((longest, 3)), np.empty((longest, 3))
    used, best_used = np.empty(longest, np.bool_), np.empty(longest, np.bool_)
    xyz, best_xyz = np.empty(3), np.empty(3)
    max_cosine, limit = math.cos(min_angle_rad), max_error_px * max_error_px
    count = 0
    for t in tracks:
        obs_is_inlier[track_ptr[t] : track_ptr[t + 1]] = False
        point_xyz[t, :] = math.nan
        k = _gather_rays(
            t, track_ptr, obs_image_idx, obs_xy, rotation, translation, image_camera_idx, canonical,
            obs, centers, rays,
        )  # fmt: skip
        # an odd stride through the pairs of a long track meets all of its observations
        stride = max(1, k * (k - 1) // 2 // MAX_HYPOTHESES) | 1
        best_count, best_cost, index = 1, math.inf, 0
        for i in range(k):
            for j in range(i + 1, k):
                index += 1
                if index % stride != 0 or _midpoint(centers[i], rays[i], centers[j], rays[j], xyz) > max_cosine:
                    continue
                inliers, cost = _mark_inliers(
                    xyz, obs, k, obs_image_idx, obs_xy, rotation, translation, image_camera_idx, canonical,
                    limit, used,
                )  # fmt: skip
                if inliers > best_count or (inliers == best_count > 1 and cost < best_cost):
                    best_count, best_cost = inliers, cost
                    copy_into(best_xyz, xyz)
                    copy_into(best_used, used)
        if best_count < 2 or (k > 2 and not _refine(best_xyz, centers, rays, best_used, k)):
            continue
        _mark_inliers(
            best_xyz, obs, k, obs_image_idx, obs_xy, rotation, translation, image_camera_idx, canonical,
            limit, best_used,
        )  # fmt: skip
        inliers = _drop_nearest(best_xyz, centers, best_used, k)
        if inliers < 2 or _min_cosine(best_xyz, centers, best_used, k, max_cosine) > max_cosine:
            continue
        copy_into(point_xyz[t], best_xyz)
        for m in range(k):
            obs_is_inlier[obs[m]] = best_used[m]
        count += 1
    return count


@numba.njit(cache=True, nogil=True)
def classify_observations(
    tracks: Ints, observed: Observed, views: Views, max_error_px: float, min_angle_rad: float, point_xyz: Array,
    obs_is_inlier: Bools,
) -> int:  # fmt: skip
    """Decide afresh which observations support the given triangulated tracks; returns how many points were dropped.

    Arguments as in :func:`triangulate_tracks`. An observation is an inlier if its image is registered, its
    reprojection error small enough and its camera not next to the point where others are a thousand times as far; a
    point with fewer than two inliers or too small an angle becomes NaN.
    """
    track_ptr, obs_image_idx, obs_xy = observed
    rotation, translation, image_camera_idx, canonical = views
    longest = _longest(tracks, track_ptr)
    centers = np.empty((longest, 3))
    used = np.empty(longest, np.bool_)
    max_cosine = math.cos(min_angle_rad)
    limit = max_error_px * max_error_px
    dropped = 0
    for t in tracks:
        if math.isnan(point_xyz[t, 0]):
            continue
        k: Any = np.int64(0)
        for o in range(track_ptr[t], track_ptr[t + 1]):
            i = obs_image_idx[o]
            cam = image_camera_idx[i]
            error = math.inf
            if not math.isnan(translation[i, 0]):
                error = _squared_error(
                    point_xyz[t], rotation[i], translation[i], canonical[cam], obs_xy[o, 0], obs_xy[o, 1]
                )
            used[k] = error <= limit
            if used[k]:
                _center(rotation[i], translation[i], centers[k])
            k += 1
        inliers = _drop_nearest(point_xyz[t], centers, used, k)
        for m in range(k):
            obs_is_inlier[track_ptr[t] + m] = used[m]
        if inliers >= 2 and _min_cosine(point_xyz[t], centers, used, k, max_cosine) <= max_cosine:
            continue
        dropped += 1
        for a in range(3):
            point_xyz[t, a] = math.nan
        for o in range(track_ptr[t], track_ptr[t + 1]):
            obs_is_inlier[o] = False
    return dropped
