"""How well an adjusted reconstruction is determined: covariances of poses, intrinsics and points.

The information is that of the adjustment at its minimum, undamped: reprojections divided by the variance of the noise,
priors and gtsam factors as they are. What the observations cannot tell, in a free network the seven degrees of a
similarity (six where a rig with a baseline measures lengths), is taken out by inner constraints (Triggs et al. 1999,
section 9): among all equivalent reconstructions the errors are those of the one whose poses lie nearest to the ground
ground truth, in the sum of ``|v|^2 + s^2 |w|^2`` over the poses, where w and v are rotation and translation errors and
s is the rms distance of the centres from their mean. Compare with a known ground truth by :func:`errors_in_gauge`. For
covariances relative
to one image or frame hold that constant: with a baseline nothing is then left open, without one the scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.gauge import moves_into_gauge, similarity_basis
from sfmapp.adjust.kernels import (
    CANON,
    POINT,
    SCRATCH,
    ImageArrays,
    LensArrays,
    PointArrays,
    RobustLoss,
    linearize,
    weigh_observations,
)
from sfmapp.adjust.open_images import eliminated, open_pose_blocks
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import EVERYTHING, Problem, Varying
from sfmapp.adjust.solver import Engine, make_engine
from sfmapp.camera.camera import Camera
from sfmapp.camera.lens import ROW
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.simd.pointers import offset, pointer

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

_DEFAULTS = AdjustOptions()

# A similarity is undetermined where its information is below this share of what it would be, were all else known.
_NULL = 1e-9
# Factors beside the reprojections may hold it, and much more loosely than these hold the rest: the positions of a
# phone, some metres, beside thousands of keypoints that tell a place relative to others within a millimetre are 1e-10
# of what is known. Rounding leaves 1e-15.
_NULL_BESIDE_FACTORS = 1e-13


@dataclass(frozen=True)
class Covariances:
    """Marginal covariances of what varied.

    Attributes:
        image_idx: (n,) images, of a rig's frame all that are registered; poses: (n, 6, 6) over rotation w (radians)
            and translation v of ``x_cam <- exp(w) x_cam + v``; those of a rig's pose at its sensor 0. Infinite for
            images that the observations leave open, in which the gauge has no part.
        camera_idx: (m,) cameras; free_params: m arrays (Q,), positions in ``Camera.params``; intrinsics: m arrays
            (Q, Q) over these.
        track_idx: (p,) points; points: (p, 3, 3) in the world; infinite for a point without depth, or in an image that
            is left open.
        sigma_px: the noise of one coordinate of an observation, estimated or as given.
        num_gauge: degrees of freedom that only the inner constraints hold: 7 in a free network, 6 with a baseline, 1
            (the scale) with one constant image and no baseline.
        is_determined: False if more than that, and single images, is undetermined; all covariances are infinite then.
    """

    image_idx: NDArray[np.int64]
    poses: Array
    camera_idx: NDArray[np.int64]
    free_params: list[NDArray[np.int64]]
    intrinsics: list[Array]
    track_idx: NDArray[np.int64]
    points: Array
    sigma_px: float
    num_gauge: int
    is_determined: bool

    @property
    def is_told(self) -> Mask:
        """(n,) bool: images whose poses are not left open."""
        return np.asarray(np.isfinite(self.poses).all(axis=(1, 2)), np.bool_)

    def of_point(self, track_idx: int) -> Array:
        """(3, 3) of a point, in the world. Raises InputError if it had no part, for want of a place or of inliers."""
        covariance: Array = self.points[_place(self.track_idx, track_idx, "point")]
        return covariance

    def of_image(self, image_idx: int) -> Array:
        """(6, 6) of an image's pose, as ``poses``. Raises InputError if it did not vary."""
        covariance: Array = self.poses[_place(self.image_idx, image_idx, "image")]
        return covariance

    def of_camera(self, camera_idx: int) -> Array:
        """(Q, Q) of a camera's free parameters. Raises InputError if none of them varied."""
        return self.intrinsics[_place(self.camera_idx, camera_idx, "camera")]


def _place(varied: NDArray[np.integer], wanted: int, what: str) -> int:
    found = np.flatnonzero(varied == wanted)
    if not len(found):
        raise InputError(f"{what} {wanted} has no covariance: it was held constant, or has no observations")
    return int(found[0])


def estimate_covariances(
    reconstruction: Reconstruction,
    options: AdjustOptions = _DEFAULTS,
    *,
    sigma_px: float | None = None,
    varying: Varying = EVERYTHING,
    prior_cameras: Sequence[Camera] | None = None,
    extra_factors: Any = None,
) -> Covariances:
    """Covariances at the minimum that ``adjust_bundle`` found with the same arguments.

    Args:
        sigma_px: noise of one pixel coordinate; None to estimate it from the (robustly weighted) residuals.

    Memory is that of two dense matrices over all unknowns of cameras and poses.
    """
    engine = make_engine(reconstruction, options, varying, prior_cameras=prior_cameras, extra_factors=extra_factors)
    problem, extras = engine.problem, engine.extras
    used = (np.arange(8) < problem.block_dim[:, None]).ravel()
    variance = sigma_px**2 if sigma_px is not None else residual_variance(engine)
    # everything below is in units of that noise, which makes the priors weaker or stronger
    engine.priors.weight *= variance
    if extras is not None:
        extras.weight = variance
    engine.linearize(0.0, map)
    information = reduced_matrix(engine)[np.ix_(used, used)]
    scale = engine.diagonal[used]
    basis, constraint = gauge_of(problem, used, information, scale, has_factors=extras is not None)
    covariance, told = constrained_inverse(information, scale, basis, constraint), used
    if covariance is None:
        covariance, told, basis = _beside_open_images(problem, used, information, scale, extras is not None)
    full = np.zeros((len(used), len(used)))
    full[used], full[:, used] = np.inf, np.inf
    full[~used], full[:, ~used] = 0.0, 0.0
    if covariance is not None:
        full[np.ix_(told, told)] = covariance * variance
    return _collect(engine, reconstruction, full, variance, len(basis), covariance is not None)


def _beside_open_images(
    problem: Problem, used: Mask, information: Array, scale: Array, has_factors: bool
) -> tuple[Array | None, Mask, Array]:
    """As :func:`constrained_inverse` without images that are open by themselves; the unknowns (B * 8,) bool that are
    left, and their open directions (k, M). None where others are open."""
    told = used.copy()
    for block in open_pose_blocks(problem, information, scale, used):
        told[block * 8 : block * 8 + 8] = False
    gone = ~told[used]
    # two images or fewer say nothing of their size
    if not gone.any() or told[problem.pose_block[problem.pose_block >= 0] * 8].sum() < 3:
        return None, used, np.zeros((0, len(scale)))
    information, scale = eliminated(information, scale, gone), scale[~gone]
    basis, constraint = gauge_of(problem, told, information, scale, has_factors=has_factors)
    return constrained_inverse(information, scale, basis, constraint), told, basis


def residual_variance(engine: Engine) -> float:
    """Variance of a pixel coordinate from weighted residuals and degrees of freedom; infinite without redundancy."""
    p, num_redundant = engine.problem, engine.degrees_of_freedom
    total, _, _ = weigh_observations(p.points, p.images(engine.rows), p.lenses, engine.loss, 0.0)
    return total / num_redundant if num_redundant > 0 else np.inf


def reduced_matrix(engine: Engine, is_kept: Mask | None = None) -> Array:
    """The undamped reduced system as a full matrix (N * 8, N * 8) over all blocks, or over those that are kept.

    Args:
        is_kept: (B,) blocks; the others, which each meet few, are eliminated too. LinAlgError where they are open.
    """
    a, b, values = upper_tiles(engine)
    if is_kept is None:
        is_kept = np.ones(engine.problem.num_blocks, bool)
    num, both = int(is_kept.sum()), is_kept[a] & is_kept[b]
    place = np.cumsum(is_kept) - 1
    matrix = np.zeros((num, num, 8, 8))
    matrix[place[a[both]], place[b[both]]] = values[both]
    full = matrix.transpose(0, 2, 1, 3).reshape(num * 8, num * 8)
    above = np.triu(full)
    full = above + np.triu(full, 1).T
    if not is_kept.all():
        full -= _through_others((a[~both], b[~both], values[~both]), is_kept)
    return full


def upper_tiles(engine: Engine) -> tuple[Ints, Ints, Array]:
    """Blocks a <= b (M,) that meet in the undamped reduced system, and their tiles (M, 8, 8), of which upper halves
    count where a block meets itself."""
    tiles = engine.tiles
    if engine.extras is not None:
        engine.extras.add_pairs(tiles, engine.tile_numbers(engine.extras.pairs))
    a, b = np.divmod(engine.tile_keys, engine.problem.num_blocks)
    upper = a <= b
    return a[upper], b[upper], tiles.reshape(-1, 8, 8)[upper]


def _through_others(tiles: tuple[Ints, Ints, Array], is_kept: Mask) -> Array:
    """(N * 8, N * 8) what eliminating the blocks that are not kept takes off the information of the others.

    Args:
        tiles: as of :func:`upper_tiles`, all in which such a block has a part.
    """
    from scipy import sparse
    from scipy.sparse.linalg import splu
    from threadpoolctl import threadpool_limits

    a, b, values = tiles
    on_diagonal = a == b
    # upper halves count
    values[on_diagonal] = np.triu(values[on_diagonal]) + np.triu(values[on_diagonal], 1).transpose(0, 2, 1)
    both = ~is_kept[a] & ~is_kept[b]
    crossed = both & ~on_diagonal
    place = np.where(is_kept, np.cumsum(is_kept) - 1, np.cumsum(~is_kept) - 1)

    def gathered(rows: Ints, columns: Ints, blocks: Array, shape: tuple[int, int]) -> Any:
        at = np.arange(8)
        row = np.broadcast_to(place[rows][:, None, None] * 8 + at[:, None], blocks.shape)
        column = np.broadcast_to(place[columns][:, None, None] * 8 + at, blocks.shape)
        return sparse.csc_matrix((blocks.ravel(), (row.ravel(), column.ravel())), shape=shape)

    num, gone = int(is_kept.sum()) * 8, int((~is_kept).sum()) * 8
    turned = values[crossed].transpose(0, 2, 1)
    own = gathered(a[both], b[both], values[both], (gone, gone))
    own += gathered(b[crossed], a[crossed], turned, (gone, gone))
    first = ~both & is_kept[b]  # the kept one comes second
    cross = gathered(a[first], b[first], values[first], (gone, num))
    second = ~both & ~is_kept[b]
    cross += gathered(b[second], a[second], values[second].transpose(0, 2, 1), (gone, num))
    scaling = sparse.diags(1.0 / np.sqrt(own.diagonal()))
    try:
        factor = splu(
            sparse.csc_matrix(scaling @ own @ scaling), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )  # fmt: skip
    except RuntimeError as error:
        raise np.linalg.LinAlgError("variables are open") from error
    scaled = sparse.csc_matrix(scaling @ cross)
    met = np.flatnonzero(np.diff(scaled.indptr))
    found = np.zeros((num, num))
    with threadpool_limits(1, "blas"):  # of many small products
        found[:, met] = scaled.T @ factor.solve(scaled[:, met].toarray())
    return found


def gauge_of(
    problem: Problem, used: Mask, information: Array, scale: Array, *, has_factors: bool
) -> tuple[Array, Array]:
    """Directions (k, N) that the information leaves open among the similarities, and their constraints (k, N);
    ``has_factors``: others than reprojections and priors of intrinsics had a part in it."""
    basis, constraint = similarities_of(problem, used, scale)
    return open_directions(basis, constraint, basis @ information @ basis.T, has_factors=has_factors)


def similarities_of(problem: Problem, used: Mask, scale: Array) -> tuple[Array, Array]:
    """What similarities of the world, of which a baseline tells the size, do to the unknowns that are used (k, N), and
    their constraints (k, N), in lengths that a diagonal scale (N,) gives; none where no pose varies."""
    poses = np.flatnonzero(problem.pose_block >= 0)
    poses = poses[used[problem.pose_block[poses] * 8]]
    if len(poses) == 0:
        return np.zeros((0, len(scale))), np.zeros((0, len(scale)))
    place = (problem.pose_block[poses][:, None] * 8 + np.arange(6)).ravel()
    wide, constraint = np.zeros((7, len(used))), np.zeros((7, len(used)))
    wide[:, place], constraint[:, place] = similarity_basis(problem.poses[poses])
    # on a long way a short baseline says so little of the scale that it would pass for nothing
    freedoms = 6 if problem.has_baseline else 7
    basis, constraint = wide[:freedoms, used], constraint[:freedoms, used]
    _add_point_motion(problem, problem.poses[poses], used, basis)
    norm = np.sqrt((basis**2 * scale).sum(1))
    norm[norm == 0] = 1.0
    return basis / norm[:, None], constraint / norm[:, None]


def open_directions(basis: Array, constraint: Array, told: Array, *, has_factors: bool) -> tuple[Array, Array]:
    """Those of a basis (k, N), and their constraints, of which the information tells nothing: told (k, k) is its
    product with the basis from both sides; ``has_factors`` as of :func:`gauge_of`."""
    values, vectors = np.linalg.eigh(told)
    open_ = vectors[:, values < (_NULL_BESIDE_FACTORS if has_factors else _NULL)].T
    return open_ @ basis, open_ @ constraint


def _add_point_motion(problem: Problem, poses: Array, used: Mask, basis: Array) -> None:
    """Add to a basis (k, N) of similarities of poses (n, 7), in place, what they do to points that are blocks."""
    kept = np.flatnonzero(problem.point_block >= 0)
    if not len(kept):
        return
    centers = rigid3.center(poses)
    mean = centers.mean(0)
    size = max(float(np.sqrt(((centers - mean) ** 2).sum(1).mean())), 1e-12)
    away = problem.xyz[kept] - mean
    motion = np.concatenate([rigid3.skew(away), np.broadcast_to(size * np.eye(3), (len(kept), 3, 3)), away[:, None]], 1)
    column = np.cumsum(used) - 1
    for n, p in enumerate(kept):
        basis[:, column[problem.point_block[p] * 8 + np.arange(3)]] = motion[n, : len(basis)]


def constrained_inverse(information: Array, scale: Array, basis: Array, constraint: Array) -> Array | None:
    """Inverse of the information where ``constraint x = 0``, given that ``information basis^T = 0``."""
    root = 1.0 / np.sqrt(scale)
    matrix = information * np.outer(root, root)
    held = constraint * root
    held /= np.linalg.norm(held, axis=1, keepdims=True) + 1e-300
    try:
        factor = np.linalg.inv(np.linalg.cholesky(matrix + held.T @ held))
        inverse = factor.T @ factor
        if len(basis):
            open_ = basis / root
            projection = np.eye(len(scale)) - open_.T @ np.linalg.solve(held @ open_.T, held)
            inverse = projection @ inverse @ projection.T
    except np.linalg.LinAlgError:
        return None
    return inverse * np.outer(root, root)


def constrained_columns(
    information: Array, scale: Array, basis: Array, constraint: Array, wanted: Array
) -> Array | None:
    """Product of the matrix of :func:`constrained_inverse` with wanted (N, M), by one Cholesky factor."""
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    root = 1.0 / np.sqrt(scale)
    held = constraint * root
    held /= np.linalg.norm(held, axis=1, keepdims=True) + 1e-300
    matrix = information * np.outer(root, root) + held.T @ held
    right = wanted * root[:, None]
    try:
        factor = cho_factor(matrix, lower=True, overwrite_a=True)
        if len(basis) == 0:
            return np.asarray(cho_solve(factor, right) * root[:, None], np.float64)
        # P A^-1 P^T with P = 1 - open (held open)^-1 held
        open_ = (basis / root).T
        core = np.linalg.inv(held @ open_)
        found = cho_solve(factor, right - held.T @ (core.T @ (open_.T @ right)))
        found -= open_ @ (core @ (held @ found))
    except LinAlgError:
        return None
    return np.asarray(found * root[:, None], np.float64)


def _collect(
    engine: Engine,
    reconstruction: Reconstruction,
    covariance: Array,
    variance: float,
    num_gauge: int,
    determined: bool,
) -> Covariances:
    p = engine.problem
    beside = diagonal_blocks(np.roll(covariance, -8, axis=1))
    found = block_covariances(reconstruction, p, diagonal_blocks(covariance), beside, float(np.sqrt(variance)))
    points = np.full((len(p.xyz), 3, 3), np.inf)
    if determined:
        _point_covariances(
            p.points, p.images(engine.rows), p.lenses, p.block_dim, engine.loss, engine.factor, covariance, variance,
            points,
        )  # fmt: skip
        points[~np.isfinite(points).all(axis=(1, 2))] = np.inf
    for n in np.flatnonzero(p.point_block >= 0):
        at = p.point_block[n] * 8 + np.arange(3)
        points[n] = covariance[np.ix_(at, at)]
    return replace(found, track_idx=p.track_idx, points=points, num_gauge=num_gauge, is_determined=determined)


def block_covariances(
    reconstruction: Reconstruction, problem: Problem, blocks: Array, beside: Array, sigma_px: float
) -> Covariances:
    """Covariances of poses and intrinsics, and of no points, with nothing open.

    Args:
        blocks: (B, 8, 8) of the blocks; beside: (B, 8, 8) of each with the one behind it, where a wide camera goes on.
    """
    image_idx, poses = pose_covariances(reconstruction, problem, blocks)
    cameras = np.flatnonzero(problem.camera_block >= 0)
    intrinsics = []
    for c, b in zip(cameras, problem.camera_block[cameras], strict=True):
        columns = np.unique(problem.free.column[problem.free.ptr[c] : problem.free.ptr[c + 1]])
        behind = blocks[min(b + 1, len(blocks) - 1)]
        both = np.block([[blocks[b], beside[b]], [beside[b].T, behind]])
        intrinsics.append(both[np.ix_(columns, columns)])
    return Covariances(
        image_idx=image_idx,
        poses=poses,
        camera_idx=problem.camera_idx[cameras],
        free_params=[problem.free.params[c] for c in cameras],
        intrinsics=intrinsics,
        track_idx=np.zeros(0, np.int64),
        points=np.zeros((0, 3, 3)),
        sigma_px=sigma_px,
        num_gauge=0,
        is_determined=True,
    )


def diagonal_blocks(covariance: Array) -> Array:
    """(B, 8, 8) of a covariance over all blocks (B * 8, B * 8)."""
    at = np.arange(len(covariance) // 8)
    blocks: Array = covariance.reshape(len(at), 8, len(at), 8)[at, :, at]
    return blocks


def pose_covariances(
    reconstruction: Reconstruction, problem: Problem, blocks: Array
) -> tuple[NDArray[np.int64], Array]:
    """Images (n,) that vary, all of their frames included, and (n, 6, 6): through the adjoint of its place on the rig
    where an image has not the pose of its block.

    Args:
        blocks: (B, 8, 8) covariances of the blocks.
    """
    rig, moving = reconstruction.rig, problem.image_block >= 0
    block = np.full(len(reconstruction.image_names), -1)
    block[problem.image_idx[moving]] = problem.image_block[moving]
    if rig is not None:
        of_frame = np.full(int(rig.frame_idx.max(initial=-1)) + 2, -1)  # one more, for images on no rig
        np.maximum.at(of_frame, rig.frame_idx, block)
        on_rig = (rig.frame_idx >= 0) & reconstruction.is_registered
        block[on_rig] = of_frame[rig.frame_idx[on_rig]]
    images = np.flatnonzero(block >= 0)
    out: Array = blocks[block[images], :6, :6].copy()
    for n in np.flatnonzero(rig.is_mounted[images]) if rig is not None else ():
        assert rig is not None
        mount = rig.cam_from_rig[rig.sensor_idx[images[n]]]
        rotation, adjoint = rigid3.rotation_matrix(mount), np.zeros((6, 6))
        adjoint[:3, :3] = adjoint[3:, 3:] = rotation
        adjoint[3:, :3] = rigid3.skew(mount[4:]) @ rotation
        # infinities times zeros are no numbers
        out[n] = adjoint @ out[n] @ adjoint.T if np.isfinite(out[n]).all() else np.inf
    return images, out


def errors_in_gauge(
    estimate: Reconstruction, ground_truth: Reconstruction, covariances: Covariances
) -> tuple[Array, list[Array], Array]:
    """Errors of an estimate in the tangents and the gauge of its covariances.

    Where the gauge was free (``num_gauge`` 7 or 6) the ground truth is moved by the similarity, or rigid motion, that
    this module's gauge asks for; otherwise both must be in the same frame.

    Returns:
        poses (n, 6), intrinsics m times (Q,), and points (p, 3).
    """
    images = covariances.image_idx
    wanted = moved_to_gauge(estimate, ground_truth, images[covariances.is_told], covariances.num_gauge)
    intrinsics = [
        (estimate.cameras[c].params - ground_truth.cameras[c].params)[free]
        for c, free in zip(covariances.camera_idx, covariances.free_params, strict=True)
    ]
    points = estimate.point_xyz[covariances.track_idx] - wanted.point_xyz[covariances.track_idx]
    return _pose_errors(estimate.cam_from_world[images], wanted.cam_from_world[images]), intrinsics, points


def pose_errors_in_gauge(
    estimate: Reconstruction, ground_truth: Reconstruction, image_idx: NDArray[np.int64], num_gauge: int
) -> Array:
    """(n, 6) errors of the poses of images (n,) alone, as of :func:`errors_in_gauge`."""
    wanted = moved_to_gauge(estimate, ground_truth, image_idx, num_gauge)
    return _pose_errors(estimate.cam_from_world[image_idx], wanted.cam_from_world[image_idx])


def moved_to_gauge(
    estimate: Reconstruction, ground_truth: Reconstruction, images: NDArray[np.int64], freedoms: int
) -> Reconstruction:
    """The ground truth, moved to where this module's gauge compares it with the estimate."""
    wanted = ground_truth.copy()
    reached = estimate.distinct_poses(images)[0]
    for _ in range(20 if freedoms >= 6 else 0):
        poses = wanted.distinct_poses(images)[0]
        basis, constraint = (rows[:freedoms] for rows in similarity_basis(poses))
        move = np.zeros(7)
        move[:freedoms] = moves_into_gauge(basis, constraint) @ _pose_errors(reached, poses).ravel()
        _apply_similarity(wanted, poses, move)
        if np.abs(move).max() < 1e-14:
            break
    return wanted


def _pose_errors(estimate: Array, ground_truth: Array) -> Array:
    """(n, 6) w and v with ``estimate = (exp(w), v) ground_truth``, poses (n, 7)."""
    delta = rigid3.compose(estimate, rigid3.inverse(ground_truth))
    return np.concatenate([rigid3.log_so3(rigid3.rotation_matrix(delta)), delta[:, 4:]], 1)


def _apply_similarity(model: Reconstruction, poses: Array, move: Array) -> None:
    """Turn, shift and scale a model about the mean centre of the poses, in the units of :func:`similarity_basis`."""
    centers = rigid3.center(poses)
    mean = centers.mean(0)
    size = np.sqrt(((centers - mean) ** 2).sum(1).mean())
    turn, scale, shift = rigid3.exp_so3(move[:3]), np.exp(move[6]), size * move[3:6]
    rotation = rigid3.rotation_matrix(model.cam_from_world) @ turn.T
    moved = scale * (model.centers - mean) @ turn.T + mean + shift
    model.cam_from_world[:] = rigid3.from_matrix(rotation, -np.einsum("nij,nj->ni", rotation, moved))
    model.point_xyz[:] = scale * (model.point_xyz - mean) @ turn.T + mean + shift


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _point_covariances(
    points: PointArrays, images: ImageArrays, lenses: LensArrays, block_dim: NDArray[np.int64], loss: RobustLoss,
    factor: Array, covariance: Array, variance: float, out: Array,
) -> None:  # fmt: skip
    """``V^-1 (variance V + W^T C W) V^-1`` of each point, with V^-1 = L^-T L^-1 from the factor; C in full blocks."""
    point_ptr, obs_image, obs_xy, xyz, is_constant, _ = points
    poses, image_mount, mounts, image_camera, image_block = images
    canonical, penalty, camera_block, second_block, free_ptr, free_slot, free_column = lenses
    J = np.zeros(SCRATCH)
    scratch, pose, mount, lens = pointer(J), pointer(poses), pointer(mounts), pointer(canonical)
    num_blocks = block_dim.shape[0]
    mark = np.full(num_blocks, -1, np.int64)
    W = np.zeros((num_blocks * 8, 3))
    touched = np.zeros(num_blocks, np.int64)
    M, N = np.zeros((3, 3)), np.zeros((3, 3))
    for p in range(xyz.shape[0]):
        if is_constant[p]:
            out[p] = 0.0
            continue
        f = factor[p]
        if f[0] == 0.0:
            continue
        count = 0
        for o in range(point_ptr[p], point_ptr[p + 1]):
            i = obs_image[o]
            c = image_camera[i]
            linearize(
                offset(pose, 12 * i), image_mount[i] >= 0, offset(mount, 12 * image_mount[i]), offset(lens, ROW * c),
                (xyz[p, 0], xyz[p, 1], xyz[p, 2]), (obs_xy[o, 0], obs_xy[o, 1]), loss, penalty[c],
                np.bool_(True), scratch,
            )  # fmt: skip
            for block in (image_block[i], camera_block[c], second_block[c]):
                if block >= 0 and mark[block] != p:
                    mark[block] = p
                    touched[count] = block
                    count += 1
                    W[block * 8 : block * 8 + 8] = 0.0
            for j in range(3):
                if image_block[i] >= 0:
                    for k in range(6):
                        W[image_block[i] * 8 + k, j] += J[k] * J[POINT + j] + J[8 + k] * J[POINT + 8 + j]
                if camera_block[c] >= 0:
                    for n in range(free_ptr[c], free_ptr[c + 1]):
                        k, slot = camera_block[c] * 8 + free_column[n], CANON + 2 * free_slot[n]
                        W[k, j] += J[slot] * J[POINT + j] + J[slot + 1] * J[POINT + 8 + j]
        M[:] = 0.0
        for a in range(count):
            for r in range(touched[a] * 8, touched[a] * 8 + block_dim[touched[a]]):
                c0 = c1 = c2 = 0.0
                for b in range(count):
                    for s in range(touched[b] * 8, touched[b] * 8 + block_dim[touched[b]]):
                        c0 += covariance[r, s] * W[s, 0]
                        c1 += covariance[r, s] * W[s, 1]
                        c2 += covariance[r, s] * W[s, 2]
                for j in range(3):
                    M[j, 0] += W[r, j] * c0
                    M[j, 1] += W[r, j] * c1
                    M[j, 2] += W[r, j] * c2
        # M <- L^-1 M L^-T + variance, then out = L^-T M L^-1
        L = np.array([[f[0], 0.0, 0.0], [f[1], f[2], 0.0], [f[3], f[4], f[5]]])
        N[:] = 0.0
        for j in range(3):
            for k in range(3):
                for m in range(3):
                    for n in range(3):
                        N[j, k] += L[j, m] * M[m, n] * L[k, n]
            N[j, j] += variance
        for j in range(3):
            for k in range(3):
                total = 0.0
                for m in range(3):
                    for n in range(3):
                        total += L[m, j] * N[m, n] * L[n, k]
                out[p, j, k] = total
