"""Covariances of poses where the errors of a track's observations are not independent of each other.

A patch that is followed from image to image carries errors along: those of the place it was cut from, of a surface that
is not as flat as the alignment takes it to be, of the edge of something nearer. Residuals show that, and the cluster
robust ("sandwich") covariance ``H^-1 (sum g g^T) H^-1`` asks for nothing else (Liang and Zeger, Biometrika 1986): g is
the gradient that one track, its point eliminated, has on all poses, and tracks are taken to be independent. The
adjustment's robust loss counts as it is: its gradients are bounded, and the information that an observation adds is the
slope of its influence, which is less than its weight (Huber, "Robust Statistics", 1981, section 7.6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.covariance import constrained_inverse, diagonal_blocks, gauge_of, pose_covariances, reduced_matrix
from sfmapp.adjust.kernels import POINT, SCRATCH, ImageArrays, LensArrays, PointArrays, RobustLoss, linearize
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.solver import Engine, make_engine
from sfmapp.camera.lens import ROW
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.simd.pointers import offset, pointer

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ClusteredCovariances:
    """Marginal covariances of poses in a free network, in the gauge of ``sfmapp.adjust.covariance``.

    Attributes:
        image_idx: (n,) images. poses: (n, 6, 6) over ``x_cam <- exp(w) x_cam + v``; infinite where not determined.
        correlation: how many times larger their variance is, on the whole, than if the errors within each track were
            independent: 1 where they are.
        noise_px: standard deviation of a pixel coordinate with which independent errors, under the same loss, would
            leave them as large on the whole; infinite where not determined.
        observations_per_image: mean number of observations in an image.
    """

    image_idx: NDArray[np.int64]
    poses: Array
    correlation: float
    noise_px: float
    observations_per_image: float


def clustered_covariances(reconstruction: Reconstruction, options: AdjustOptions) -> ClusteredCovariances:
    """Covariances at the minimum that ``adjust_bundle`` found with all images free and the cameras constant.

    Memory is that of four dense matrices over the unknowns of all poses.

    Raises:
        ValueError: cameras are not constant.
    """
    if any(options.refine):
        raise ValueError("intrinsics must be constant")
    engine = make_engine(reconstruction, options)
    problem = engine.problem
    engine.linearize(0.0, map)
    used = (np.arange(8) < problem.block_dim[:, None]).ravel()
    information, scale = reduced_matrix(engine)[np.ix_(used, used)], engine.diagonal[used]
    inverse = constrained_inverse(information, scale, *gauge_of(problem, used, information, scale, has_factors=False))
    num, correlation, noise_px = len(scale), 1.0, np.inf
    covariance = np.full((num, num), np.inf)
    num_tracks = int((np.diff(problem.point_ptr) > 1).sum())
    if inverse is not None and num_tracks > num:
        clustered, independent, weight, slope = _scatter(engine, num)
        inflation = (weight / slope) ** 2 * num_tracks / (num_tracks - num)
        covariance = inflation * inverse @ clustered @ inverse
        # rows of the poses' rotations and translations, in one unit of length
        sizes = np.tile(np.repeat([_spread(problem.poses) ** 2, 1.0], 3), num // 6)
        alone = np.einsum("ij,jk,ki,i->", inverse, independent, inverse, sizes, optimize=True)
        together = np.einsum("ij,jk,ki,i->", inverse, clustered, inverse, sizes, optimize=True)
        correlation = float(together / alone) if alone > 0 else 1.0
        noise_px = float(np.sqrt(inflation * together / (np.diag(inverse) @ sizes)))
    full = np.zeros((len(used), len(used)))
    full[np.ix_(used, used)] = covariance
    image_idx, poses = pose_covariances(reconstruction, problem, diagonal_blocks(full))
    per_image = problem.num_observations / len(problem.image_idx)
    return ClusteredCovariances(image_idx, poses, correlation, noise_px, per_image)


def _spread(poses: Array) -> float:
    """Root mean square distance of the centres of poses (n, 7) from their middle."""
    centers = rigid3.center(poses)
    return float(np.sqrt(((centers - centers.mean(0)) ** 2).sum(1).mean()))


def _scatter(engine: Engine, num: int) -> tuple[Array, Array, float, float]:
    """(num, num) sums over the tracks of the squares of their gradients, as they are and as independent observations of
    the track's own noise would give them; sums of the observations' weights and of the slopes of their influence."""
    p = engine.problem
    clustered, independent, sums = np.zeros((num, num)), np.zeros((num, num)), np.zeros(2)
    _add_tracks(p.points, p.images(engine.rows), p.lenses, engine.loss, engine.factor, clustered, independent, sums)
    return clustered, independent, float(sums[0]), float(sums[1])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_tracks(
    points: PointArrays, images: ImageArrays, lenses: LensArrays, loss: RobustLoss, factor: Array, clustered: Array,
    independent: Array, sums: Array,
) -> None:  # fmt: skip
    """See :func:`_scatter`. The point is eliminated with ``V^-1 = L^-T L^-1`` from the factor."""
    point_ptr, obs_image, obs_xy, xyz, _, _ = points
    poses, image_mount, mounts, image_camera, image_block = images
    penalty, J = lenses.penalty, np.zeros(SCRATCH)
    scratch, pose, mount, lens = pointer(J), pointer(poses), pointer(mounts), pointer(lenses.canonical)
    num_blocks = clustered.shape[0] // 6
    mark, touched = np.full(num_blocks, -1, np.int64), np.zeros(num_blocks, np.int64)
    U, Z, g = np.zeros((num_blocks, 6, 6)), np.zeros((num_blocks, 6, 3)), np.zeros((num_blocks, 6))
    b, y = np.zeros(3), np.zeros(3)
    for p in range(xyz.shape[0]):
        f, begin, end = factor[p], point_ptr[p], point_ptr[p + 1]
        if f[0] == 0.0 or end - begin < 2:
            continue
        L = np.array([[f[0], 0.0, 0.0], [f[1], f[2], 0.0], [f[3], f[4], f[5]]])
        count, squares = 0, 0.0
        b[:] = 0.0
        for o in range(begin, end):
            i = obs_image[o]
            c = image_camera[i]
            s = linearize(
                offset(pose, 12 * i), image_mount[i] >= 0, offset(mount, 12 * image_mount[i]), offset(lens, ROW * c),
                (xyz[p, 0], xyz[p, 1], xyz[p, 2]), (obs_xy[o, 0], obs_xy[o, 1]), loss, penalty[c],
                np.bool_(False), scratch,
            )  # fmt: skip
            squared = J[POINT + 3] * J[POINT + 3] + J[POINT + 11] * J[POINT + 11]
            weight = squared / s if s > 0.0 else 1.0
            squares += squared
            sums[0] += weight
            # of Cauchy's loss, on average over directions
            sums[1] += weight - weight * squared / loss.scale2 if loss.kind == 2 else weight
            k = image_block[i]
            if mark[k] != p:
                mark[k] = p
                touched[count] = k
                count += 1
                U[k], Z[k], g[k] = 0.0, 0.0, 0.0
            for m in range(3):
                b[m] += J[POINT + m] * J[POINT + 3] + J[POINT + 8 + m] * J[POINT + 11]
            for r in range(6):
                g[k, r] += J[r] * J[POINT + 3] + J[8 + r] * J[POINT + 11]
                for m in range(6):
                    U[k, r, m] += J[r] * J[m] + J[8 + r] * J[8 + m]
                for m in range(3):
                    for n in range(m + 1):  # Z = W L^-T
                        Z[k, r, m] += (J[r] * J[POINT + n] + J[8 + r] * J[POINT + 8 + n]) * L[m, n]
        for m in range(3):
            y[m] = L[m, 0] * b[0] + L[m, 1] * b[1] + L[m, 2] * b[2]
        noise = squares / (2 * (end - begin) - 3)
        for n in range(count):
            k = touched[n]
            for r in range(6):
                g[k, r] -= Z[k, r, 0] * y[0] + Z[k, r, 1] * y[1] + Z[k, r, 2] * y[2]
                for m in range(6):
                    independent[6 * k + r, 6 * k + m] += noise * U[k, r, m]
        for n in range(count):
            k = touched[n]
            for h in range(count):
                q = touched[h]
                for r in range(6):
                    for m in range(6):
                        meet = Z[k, r, 0] * Z[q, m, 0] + Z[k, r, 1] * Z[q, m, 1] + Z[k, r, 2] * Z[q, m, 2]
                        clustered[6 * k + r, 6 * q + m] += g[k, r] * g[q, m]
                        independent[6 * k + r, 6 * q + m] -= noise * meet


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    from sfmapp.scene.synthetic import make_scene

    fixed = AdjustOptions(refine_focal=False, refine_distortion=False)
    clustered_covariances(make_scene(0, 3, 40).observed, fixed)
