"""Covariances of many images and their cameras: those blocks of the inverse of a sparse system that are wanted.

The reduced system of a survey is sparse, its inverse is full: of a thousand images half a gigabyte, of which the blocks
on the diagonal are a thousandth. Fronts (:mod:`sfmapp.adjust.fronts`) make the entries of the inverse where the factor
has its own, and nothing else. What is open is held by two images alone, which keeps the system sparse, and the blocks
are then moved to the gauge of inner constraints (an S-transformation: Baarda 1973), for which as many columns are
solved as there are open directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.covariance import (
    Covariances,
    block_covariances,
    constrained_columns,
    gauge_of,
    reduced_matrix,
    residual_variance,
    upper_tiles,
)
from sfmapp.adjust.fronts import FrontFactor, order_of
from sfmapp.adjust.linear import is_sparse, one_blas_thread
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import EVERYTHING, Problem, Varying
from sfmapp.adjust.solver import Engine, make_engine
from sfmapp.camera.camera import Camera
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Columns that are solved for besides, and how far they may be off: of correct ones rounding leaves 1e-6 where positions
# hold the whole as loosely as those of a phone do.
_NUM_CHECKED, _MAX_OFF = 4, 1e-3
# Entries of a factor: of a survey of 1,000 images two to five million; where all meet all, this many take minutes.
_MAX_ENTRIES = 15_000_000


def selected_covariances(
    reconstruction: Reconstruction,
    options: AdjustOptions,
    *,
    sigma_px: float | None = None,
    varying: Varying = EVERYTHING,
    prior_cameras: Sequence[Camera] | None = None,
    extra_factors: Any = None,
) -> Covariances | None:
    """Covariances of poses and intrinsics at a minimum, of any number of images.

    Arguments and gauge as of :func:`~sfmapp.adjust.covariance.estimate_covariances`, which has points too, and joint
    ones; these have none.

    Returns:
        None where more than a similarity is open, or too many images meet too many others.
    """
    engine = make_engine(
        reconstruction, options, varying, prior_cameras=prior_cameras, extra_factors=extra_factors, is_closing=True
    )
    variance = sigma_px**2 if sigma_px is not None else residual_variance(engine)
    engine.priors.weight *= variance
    if engine.extras is not None:
        engine.extras.weight = variance
    engine.linearize(0.0, map)
    with one_blas_thread():
        found = _inverse_blocks(engine)
    if found is None:
        return None
    (blocks, beside), num_gauge = found
    covariances = block_covariances(
        reconstruction, engine.problem, variance * blocks, variance * beside, float(np.sqrt(variance))
    )
    return replace(covariances, num_gauge=num_gauge)


def covariance_of_functions(engine: Engine, rows: Array) -> Array | None:
    """Covariance (M, M) of a few linear functions of all unknowns, in the variance of the observations' noise, where
    nothing is open: by one factor, which is sparse where that of the closing adjustment is, and a column for each.

    Args:
        engine: of the closing adjustment, at its minimum. rows: (M, B * 8) how the functions move with the unknowns.

    Returns:
        None where something is open.
    """
    used = (np.arange(8) < engine.problem.block_dim[:, None]).ravel()
    wanted, none = rows[:, used], np.zeros((0, int(used.sum())))
    if engine.solver in ("gtsam", "fronts") or (engine.solver == "envelope" and is_sparse(engine.fill)):
        engine.linearize(0.0, map)
        matrix = _sparse_system(engine, used)
        root = 1.0 / np.sqrt(matrix.diagonal())
        factor = _factored(matrix.multiply(root[:, None]).multiply(root[None]).tocsc(), used)
        if factor is not None:
            found: Array = (wanted * root) @ factor.solve((wanted * root).T)
            return found
    engine.linearize(0.0, map)  # anew: the other way has added to it
    information = reduced_matrix(engine)[np.ix_(used, used)]
    columns = constrained_columns(information, engine.diagonal[used], none, none, wanted.T)
    return None if columns is None else wanted @ columns


def _inverse_blocks(engine: Engine) -> tuple[Array, int] | None:
    """(2, B, 8, 8) blocks of the inverse of the undamped reduced system, on the diagonal and each with the one behind
    it, and how many directions only the inner constraints hold."""
    used = (np.arange(8) < engine.problem.block_dim[:, None]).ravel()
    matrix = _sparse_system(engine, used)
    root = 1.0 / np.sqrt(matrix.diagonal())
    basis, constraint = gauge_of(engine.problem, used, matrix, matrix.diagonal(), has_factors=engine.extras is not None)
    scaled = matrix.multiply(root[:, None]).multiply(root[None])
    if len(basis):
        # in the units of the scaled unknowns; two images that are far apart hold what is open
        basis, constraint = basis / root, constraint * root
        scaled = scaled + _held_by_two(engine.problem, used, basis)
    factor = _factored(scaled.tocsc(), used)
    if factor is None:
        return None
    blocks, diagonal = _gathered(factor, used)
    if not _agrees(factor, diagonal):
        return None
    if len(basis):
        blocks = _in_inner_gauge(blocks, factor, basis, constraint, used)
    full_root = np.zeros(len(used))
    full_root[used] = root
    per_block = full_root.reshape(-1, 8)
    behind = np.roll(per_block, -1, axis=0)
    return blocks * per_block[:, :, None] * np.stack([per_block, behind])[:, :, None, :], len(basis)


def _factored(scaled: Any, used: NDArray[np.bool_]) -> FrontFactor | None:
    """The factor of a symmetric sparse matrix over the unknowns that are used; None where it is singular, or too
    full."""
    _, block_of = np.unique(np.flatnonzero(used) // 8, return_inverse=True)
    order = order_of(scaled, block_of)
    if order.num_entries * (len(block_of) / (block_of[-1] + 1)) ** 2 > _MAX_ENTRIES:
        return None
    try:
        return FrontFactor(scaled, block_of, order)
    except np.linalg.LinAlgError:  # singular
        return None


def _held_by_two(problem: Problem, used: NDArray[np.bool_], basis: Array) -> Any:
    """What is to be added to a system (N, N) for two images to hold the open directions (k, N), as a sparse matrix."""
    from scipy import sparse

    images = np.flatnonzero(problem.pose_block >= 0)
    centers = rigid3.center(problem.poses[images])
    far = int(np.argmax(np.linalg.norm(centers - centers.mean(0), axis=1)))
    other = int(np.argmax(np.linalg.norm(centers - centers[far], axis=1)))
    is_holding = np.zeros(len(used), bool)
    for i in (far, other):
        is_holding[problem.pose_block[images[i]] * 8 + np.arange(6)] = True
    holding = np.flatnonzero(is_holding[used])
    rows, _ = np.linalg.qr(basis[:, holding].T)  # alike in all directions
    row, column = np.meshgrid(holding, holding, indexing="ij")
    size = int(used.sum())
    return sparse.coo_matrix(((rows @ rows.T).ravel(), (row.ravel(), column.ravel())), shape=(size, size))


def _in_inner_gauge(
    blocks: Array, factor: FrontFactor, basis: Array, constraint: Array, used: NDArray[np.bool_]
) -> Array:
    """Blocks (2, B, 8, 8) of a covariance S with the open directions (k, N) held somehow, moved to where the
    constraints (k, N) vanish: of P S P^T, with P = 1 - basis^T (constraint basis^T)^-1 constraint."""
    crossed = factor.solve(constraint.T)
    turned = basis.T @ np.linalg.inv(constraint @ basis.T)
    # P S P^T = S - Y T^T - T Y^T + T W T^T with Y = S C^T, T = B^T (C B^T)^-1, W = C S C^T
    left, right = np.zeros((2, len(used), len(basis)))
    left[used], right[used] = crossed, turned
    y, t = left.reshape(blocks.shape[1], 8, -1), right.reshape(blocks.shape[1], 8, -1)
    y_behind, t_behind = (np.stack([x, np.roll(x, -1, axis=0)]).transpose(0, 1, 3, 2) for x in (y, t))
    moved: Array = blocks - y @ t_behind - t @ y_behind + t @ (constraint @ crossed) @ t_behind
    return moved


def _sparse_system(engine: Engine, used: NDArray[np.bool_]) -> Any:
    """The reduced system over the unknowns that are used, as a symmetric matrix of scipy."""
    from scipy import sparse

    a, b, tiles = upper_tiles(engine)
    on_diagonal = a == b
    tiles[on_diagonal] = np.triu(tiles[on_diagonal])
    at = np.arange(8)
    row = np.broadcast_to(a[:, None, None] * 8 + at[:, None], tiles.shape)
    column = np.broadcast_to(b[:, None, None] * 8 + at, tiles.shape)
    size = len(used)
    kept = used[row] & used[column] & (row <= column)
    upper = sparse.csc_matrix((tiles[kept], (row[kept], column[kept])), shape=(size, size))
    upper = upper[used][:, used]
    return (upper + sparse.triu(upper, 1).T).tocsc()


def _gathered(factor: FrontFactor, used: NDArray[np.bool_]) -> tuple[Array, Array]:
    """(2, B, 8, 8) blocks of the inverse on its diagonal, and each with the one behind it, zeros where the factor has
    none; and the diagonal (N,)."""
    number = np.flatnonzero(used)
    blocks, diagonal = np.zeros((2, len(used) // 8, 8, 8)), np.empty(len(number))
    for unknowns, num_own, inverse in factor.inverse():
        diagonal[unknowns[:num_own]] = inverse.diagonal()[:num_own]
        row, column = number[unknowns], number[unknowns[:num_own]]
        apart = column // 8 - row[:, None] // 8
        for k, turned in ((0, False), (1, False), (1, True)):
            i, j = np.nonzero(apart == (-k if turned else k))
            first, second = (column[j], row[i]) if turned else (row[i], column[j])
            blocks[k, first // 8, first % 8, second % 8] = inverse[i, j]
    return blocks, diagonal


def _agrees(factor: FrontFactor, diagonal: Array) -> bool:
    """Whether some entries are those that the factor itself solves for."""
    chosen = np.linspace(0, len(diagonal) - 1, _NUM_CHECKED).astype(int)
    right = np.zeros((len(diagonal), len(chosen)))
    right[chosen, np.arange(len(chosen))] = 1.0
    solved = factor.solve(right)[chosen, np.arange(len(chosen))]
    return bool(np.allclose(solved, diagonal[chosen], rtol=_MAX_OFF))
