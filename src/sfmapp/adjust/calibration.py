"""What the tracks of an adjusted model say of its calibration, once poses and points have followed.

The cost of a model is taken as a quadratic in what the calibration is off by. Points are eliminated track by track,
poses with the system that is left, so that each track keeps a gradient and an information of its own over the
calibration alone (the reduced system of Triggs et al., "Bundle Adjustment: A Modern Synthesis", 1999, section 6, and
its score by track). They add up to those of the model; their spread, taken over tracks whose errors are not independent
of each other, tells how much of that information is real (White, "Maximum likelihood estimation of misspecified
models", 1982); and what some tracks say can be judged by others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.kernels import CANON, LOSS_IDS, POINT, POSE, SCRATCH, RobustLoss, linearize
from sfmapp.adjust.options import Loss
from sfmapp.adjust.problem import pose_rows
from sfmapp.camera.lens import FAMILY, LAST_ON_PLANE, ROW
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.simd.pointers import offset, pointer

Array = NDArray[np.float64]

# Derivatives of an observation by the calibration of its camera: the canonical intrinsics, and a turn exp(w) of it.
RAW = FAMILY + 3
# Share of the diagonal that keeps what nothing determines (the unit of a single camera's map) where it is.
_DAMPING = 1e-9


@dataclass(frozen=True)
class CalibrationSystem:
    """Cost over calibration unknowns (Q,) by cluster of tracks, in units of the noise, halves included.

    Attributes:
        gradient: (C, Q); information: (C, Q, Q), of ``g.x + x.H.x / 2``.
        response: (F, 6, Q) how rotation and translation of each frame's pose, ``x <- exp(w) x + v``, follow a unit of
            each unknown; the first frame stays.
        log_scale: (Q,) how the logarithm of the size of the path follows. scale_variance: its variance if the
            calibration is right and errors are independent; infinite where lengths are not measured.
    """

    gradient: Array
    information: Array
    response: Array
    log_scale: Array
    scale_variance: float


def reduce_to_calibration(
    model: Reconstruction,
    directions: Array,
    sigma_px: float,
    clusters: Callable[[NDArray[np.int64]], NDArray[np.int64]],
    loss: Loss = "cauchy",
    loss_sigmas: float = 2.0,
    fields: Array | None = None,
) -> CalibrationSystem:
    """The cost of a model near its minimum over poses and points, as a function of the calibration.

    Args:
        model: images of one rig, or of single cameras, all registered, frame by frame; camera s is that of sensor s.
        directions: (C, 19, Q) how canonical intrinsics and turn (radians) of each camera change with each unknown.
        sigma_px: noise of one coordinate. loss, loss_sigmas: as of the adjustment.
        clusters: number of the cluster, from 0 on without gaps, of each of the tracks (T,) that have something to say.
        fields: (O, N) what smooth fields of displacement are at each observation. Their amplitudes in pixels follow
            the other unknowns: for each camera N along x, then N along y.
    """
    tracks = model.tracks
    num_sensors = 1 if model.rig is None else len(model.rig.cam_from_rig)
    num_frames = len(model.image_names) // num_sensors
    mounts = rigid3.IDENTITY[None] if model.rig is None else model.rig.cam_from_rig
    canonical = model.canonical_cameras()
    penalty = np.array([float(c.width**2 + c.height**2) for c in model.cameras])
    basis = np.zeros((tracks.num_observations, 0)) if fields is None else np.ascontiguousarray(fields)
    num = directions.shape[2] + 2 * len(model.cameras) * basis.shape[1]
    padded = np.zeros((*directions.shape[:2], num))
    padded[:, :, : directions.shape[2]] = directions
    seen = _Seen(tracks.track_ptr, tracks.obs_image_idx, tracks.obs_xy, model.obs_is_inlier, model.point_xyz)
    cameras = _Cameras(
        pose_rows(model.cam_from_world), num_sensors, _adjoints(mounts), np.ascontiguousarray(canonical), penalty
    )
    unknowns = _Unknowns(padded, basis)
    noise = _Noise(RobustLoss(LOSS_IDS[loss], (loss_sigmas * sigma_px) ** 2), 1.0 / sigma_px)
    rows = _Rows.of_tracks(tracks.track_ptr, num)
    size = 6 * num_frames
    system, cross, said = np.zeros((size, size)), np.zeros((size, num)), np.zeros(tracks.num_tracks, bool)
    _reduce(seen, cameras, unknowns, noise, rows, system, cross, said)
    poses = (np.triu(system) + np.triu(system, 1).T)[6:, 6:]
    poses[np.diag_indices(len(poses))] *= 1 + _DAMPING
    poses[np.diag_indices(len(poses))] += 1e-12 * np.trace(poses) / max(len(poses), 1)
    along = _stretch(model, num_sensors)
    solved = np.linalg.solve(poses, np.column_stack([cross[6:], along[6:]]))
    response = np.zeros((size, num))
    response[6:] = -solved[:, :-1]
    cluster = np.full(tracks.num_tracks, -1, np.int64)
    cluster[said] = clusters(np.flatnonzero(said))
    gradient = np.zeros((int(cluster.max(initial=-1)) + 1, num))
    information = np.zeros((*gradient.shape, num))
    _by_cluster(seen, cameras, unknowns, noise, rows, response, cluster, gradient, information)
    return CalibrationSystem(
        gradient, information, response.reshape(num_frames, 6, -1), along @ response,
        float(along[6:] @ solved[:, -1]) if num_sensors > 1 else np.inf,
    )  # fmt: skip


def _adjoints(mounts: Array) -> Array:
    """(S, 6, 6) motion of each camera for that of the rig, both rotation and translation of ``exp(w) x + v``."""
    rotation, out = rigid3.rotation_matrix(mounts), np.zeros((len(mounts), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = rotation
    out[:, 3:, :3] = rigid3.skew(mounts[:, 4:]) @ rotation
    return out


def _stretch(model: Reconstruction, num_sensors: int) -> Array:
    """(F * 6,) derivative of the logarithm of the rms distance of the frames from their middle, by their poses."""
    poses = model.cam_from_world[::num_sensors]
    centers = rigid3.center(poses)
    away = centers - centers.mean(0)
    out = np.einsum("nij,ni->nj", rigid3.center_jacobian(poses), away) / max(float((away**2).sum()), 1e-300)
    return np.asarray(out.ravel(), np.float64)


class _Seen(NamedTuple):
    """Tracks (T), their observations (O) by images, and their points, NaN where there is none."""

    track_ptr: NDArray[np.int64]
    obs_image: NDArray[np.int32]
    obs_xy: Array
    is_inlier: NDArray[np.bool_]
    xyz: Array


class _Cameras(NamedTuple):
    """Images (I, 12) as rows of their poses, frame by frame; the adjoints (S, 6, 6), canonical rows (S, ROW) and
    squared residuals (S,) behind of the sensors."""

    poses: Array
    num_sensors: int
    adjoints: Array
    canonical: Array
    penalty: Array


class _Unknowns(NamedTuple):
    """Directions (S, RAW, Q) and fields (O, N), see :func:`reduce_to_calibration`."""

    directions: Array
    fields: Array


class _Noise(NamedTuple):
    """The loss in pixels, and how many of a residual's units make a pixel."""

    loss: RobustLoss
    weight: float


class _Rows(NamedTuple):
    """Room for the rows of one track: two for each of its observations.

    Attributes:
        frame: (n,) int64 of each observation.
        pose_part, lens_part, point_part: (2n, 6), (2n, Q), (2n, 3) derivatives by the rig's pose, the unknowns and the
            point, the latter made orthonormal. residual: (2n,). All in units of the noise.
        scratch: (SCRATCH,) of an observation.
    """

    frame: NDArray[np.int64]
    pose_part: Array
    lens_part: Array
    point_part: Array
    residual: Array
    scratch: Array

    @staticmethod
    def of_tracks(track_ptr: NDArray[np.int64], num_unknowns: int) -> _Rows:
        longest = int(np.diff(track_ptr).max(initial=1))
        return _Rows(
            np.zeros(longest, np.int64), np.zeros((2 * longest, 6)), np.zeros((2 * longest, num_unknowns)),
            np.zeros((2 * longest, 3)), np.zeros(2 * longest), np.zeros(SCRATCH),
        )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill_rows(t: int, seen: _Seen, cameras: _Cameras, unknowns: _Unknowns, noise: _Noise, rows: _Rows) -> int:
    """Fill the rows of a track's inliers; returns their number, 0 if there are too few for a point."""
    track_ptr, obs_image, obs_xy, is_inlier, xyz = seen
    poses, num_sensors, adjoints, canonical, penalty = cameras
    directions, fields = unknowns
    loss, weight = noise
    frames, pose_part, lens_part, point_part, residual, J = rows
    scratch, pose, lens = pointer(J), pointer(poses), pointer(canonical)
    n, num = 0, directions.shape[2]
    num_lens = num - 2 * fields.shape[1] * canonical.shape[0]  # the others are amplitudes of fields
    if not np.isfinite(xyz[t, 0] + xyz[t, 1] + xyz[t, 2]):
        return 0
    for o in range(track_ptr[t], track_ptr[t + 1]):
        if not is_inlier[o]:
            continue
        i = obs_image[o]
        s = i % num_sensors
        linearize(
            offset(pose, 12 * i), np.bool_(False), offset(pose, 0), offset(lens, ROW * s),
            (xyz[t, 0], xyz[t, 1], xyz[t, 2]), (obs_xy[o, 0], obs_xy[o, 1]), loss, penalty[s], np.bool_(True), scratch,
        )  # fmt: skip
        used = 8 if canonical[s, FAMILY] <= LAST_ON_PLANE else FAMILY  # the numbers in the row that mean something
        frames[n] = i // num_sensors
        for r in range(2):
            row = 2 * n + r
            residual[row] = weight * J[POINT + 8 * r + 3]
            for k in range(3):
                point_part[row, k] = weight * J[POINT + 8 * r + k]
            for k in range(6):
                total = 0.0
                for m in range(6):
                    total += J[POSE + 8 * r + m] * adjoints[s, m, k]
                pose_part[row, k] = weight * total
            for q in range(num):
                lens_part[row, q] = 0.0
            for k in range(used):  # along rows of memory, for all unknowns at once
                value = weight * J[CANON + 2 * k + r]
                for q in range(num_lens):
                    lens_part[row, q] += value * directions[s, k, q]
            for k in range(3):
                value = weight * J[POSE + 8 * r + k]
                for q in range(num_lens):
                    lens_part[row, q] += value * directions[s, FAMILY + k, q]
            first = num_lens + (2 * s + r) * fields.shape[1]
            for q in range(fields.shape[1]):
                lens_part[row, first + q] = weight * J[CANON + 4] * fields[o, q]
        n += 1
    if n < 2 or not _orthonormalize(point_part, 2 * n):
        return 0
    return n


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _orthonormalize(columns: Array, rows: int) -> bool:
    """Gram and Schmidt over three columns, in place; False where one hangs on the others."""
    for k in range(3):
        before = 0.0
        for r in range(rows):
            before += columns[r, k] * columns[r, k]
        for m in range(k):
            product = 0.0
            for r in range(rows):
                product += columns[r, m] * columns[r, k]
            for r in range(rows):
                columns[r, k] -= product * columns[r, m]
        after = 0.0
        for r in range(rows):
            after += columns[r, k] * columns[r, k]
        if not after > 1e-14 * before:
            return False
        for r in range(rows):
            columns[r, k] /= np.sqrt(after)
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _project(point_part: Array, rows: int, columns: Array) -> None:
    """Take out of columns (rows, N) what a move of the point does, whose derivatives are orthonormal; in place."""
    moved = np.zeros(columns.shape[1])
    for m in range(3):
        moved[:] = 0.0
        for r in range(rows):
            for q in range(columns.shape[1]):
                moved[q] += point_part[r, m] * columns[r, q]
        for r in range(rows):
            for q in range(columns.shape[1]):
                columns[r, q] -= point_part[r, m] * moved[q]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _reduce(
    seen: _Seen, cameras: _Cameras, unknowns: _Unknowns, noise: _Noise, rows: _Rows, system: Array, cross: Array,
    said: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Add the tracks, points eliminated, to the upper half of a system over poses (F * 6), and to cross (F * 6, Q).

    ``said`` (T,) tells which tracks have a point that enough observations hold."""
    num, longest = unknowns.directions.shape[2], rows.frame.shape[0]
    frames, pose_part, lens_part, point_part, _, _ = rows
    place, W = np.zeros(longest, np.int64), np.zeros((3, 6 * longest))
    for t in range(seen.track_ptr.shape[0] - 1):
        n = _fill_rows(t, seen, cameras, unknowns, noise, rows)
        said[t] = n > 0
        _project(point_part, 2 * n, lens_part)
        count, frame = 0, -1
        for o in range(n):  # images are sorted within a track: those of a frame follow each other
            if frames[o] != frame:
                frame = frames[o]
                place[count] = 6 * frame
                W[:, 6 * count : 6 * count + 6] = 0.0
                count += 1
            for r in range(2 * o, 2 * o + 2):
                for k in range(6):
                    value, at = pose_part[r, k], 6 * frame
                    for m in range(3):
                        W[m, 6 * count - 6 + k] += point_part[r, m] * value
                    for m in range(k, 6):
                        system[at + k, at + m] += value * pose_part[r, m]
                    for q in range(num):
                        cross[at + k, q] += value * lens_part[r, q]
        for a in range(count):
            for k in range(6):
                w0, w1, w2 = W[0, 6 * a + k], W[1, 6 * a + k], W[2, 6 * a + k]
                for b in range(a, count):
                    for m in range(6):
                        c = 6 * b + m
                        system[place[a] + k, place[b] + m] -= w0 * W[0, c] + w1 * W[1, c] + w2 * W[2, c]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _by_cluster(
    seen: _Seen, cameras: _Cameras, unknowns: _Unknowns, noise: _Noise, rows: _Rows, response: Array,
    cluster: NDArray[np.int64], gradient: Array, information: Array,
) -> None:  # fmt: skip
    """Gradient (C, Q) and information (C, Q, Q) of clusters of tracks, the poses following with response (F * 6, Q)."""
    num = unknowns.directions.shape[2]
    frames, pose_part, lens_part, point_part, residual, _ = rows
    for t in range(seen.track_ptr.shape[0] - 1):
        c = cluster[t]
        if c < 0:
            continue
        n = _fill_rows(t, seen, cameras, unknowns, noise, rows)
        for r in range(2 * n):
            for k in range(6):
                value, at = pose_part[r, k], 6 * frames[r // 2] + k
                for q in range(num):
                    lens_part[r, q] += value * response[at, q]
        _project(point_part, 2 * n, lens_part)
        for r in range(2 * n):
            for q in range(num):
                value = lens_part[r, q]
                gradient[c, q] += value * residual[r]  # the rows hold nothing of the point any more
                for p in range(q, num):
                    information[c, q, p] += value * lens_part[r, p]
    for c in range(len(information)):
        for q in range(num):
            for p in range(q):
                information[c, q, p] = information[c, p, q]


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    from sfmapp.scene.synthetic import make_scene

    reduce_to_calibration(make_scene(0, 3, 24).observed, np.zeros((1, RAW, 1)), 1.0, np.zeros_like)
