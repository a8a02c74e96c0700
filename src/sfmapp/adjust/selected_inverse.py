"""Covariances of many images and their cameras: those blocks of the inverse of a sparse system that are wanted.

The reduced system of a survey is sparse, its inverse is full: of a thousand images half a gigabyte, of which the blocks
on the diagonal are a thousandth. Fronts (:mod:`sfmapp.adjust.front_system`) make the entries of the inverse where the
factor has its own, and nothing else. What is open is held by two images alone, each within itself, which keeps the
system as sparse as it is, and the blocks are then moved to the gauge of inner constraints (an S-transformation: Baarda
1973), for which as many columns are solved as there are open directions.
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
    open_directions,
    reduced_matrix,
    residual_variance,
    similarities_of,
    upper_tiles,
)
from sfmapp.adjust.front_system import FrontSystem, flops_of_fronts
from sfmapp.adjust.fronts import FrontOrder
from sfmapp.adjust.linear import is_sparse, one_blas_thread
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import EVERYTHING, Varying
from sfmapp.adjust.solver import Engine, make_engine
from sfmapp.camera.camera import Camera
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Columns that are solved for besides, and how far they may be off: of correct ones rounding leaves 1e-6 where positions
# hold the whole as loosely as those of a phone do.
_NUM_CHECKED, _MAX_OFF = 4, 1e-3
# Multiplications and additions of the factor; its inverse takes twice as many. A walk of 3,000 views through a town
# takes 3.5e10, some seconds; so much as this and more take half a minute, and 1,000 images that all meet all.
_MAX_FLOPS = 2.5e11
# An image holds the open directions in which it moves by more than this share of how it moves in others.
_HOLDS = 1e-6


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
    blocks, beside, num_gauge = found
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
    if engine.solver in ("gtsam", "fronts") or (engine.solver == "envelope" and is_sparse(engine.fill)):
        engine.linearize(0.0, map)
        factor = _factored(engine, *upper_tiles(engine))
        if factor is not None:
            found: Array = rows @ factor.substitute(rows.T)
            return found
    engine.linearize(0.0, map)  # anew: the other way has added to it
    used = (np.arange(8) < engine.problem.block_dim[:, None]).ravel()
    wanted, none = rows[:, used], np.zeros((0, int(used.sum())))
    information = reduced_matrix(engine)[np.ix_(used, used)]
    columns = constrained_columns(information, engine.diagonal[used], none, none, wanted.T)
    return None if columns is None else wanted @ columns


def _inverse_blocks(engine: Engine) -> tuple[Array, Array, int] | None:
    """(B, 8, 8) blocks of the inverse of the undamped reduced system on its diagonal, (B, 8, 8) of each that goes on in
    the one behind it with that, and how many directions only the inner constraints hold."""
    problem, num = engine.problem, engine.problem.num_blocks
    used = (np.arange(8) < problem.block_dim[:, None]).ravel()
    a, b, tiles = upper_tiles(engine)
    own = np.flatnonzero(a == b)
    diagonal = np.einsum("nii->ni", tiles[own]).ravel()
    narrow = similarities_of(problem, used, diagonal[used])
    basis, constraint = (np.zeros((len(rows), num * 8)) for rows in narrow)
    basis[:, used], constraint[:, used] = narrow
    told = _from_both_sides(a, b, tiles, basis)
    basis, constraint = open_directions(basis, constraint, told, has_factors=engine.extras is not None)
    if len(basis):
        _hold(problem.pose_block[problem.pose_block >= 0].astype(np.int64), basis, diagonal, tiles, own)
    factor = _factored(engine, a, b, tiles)
    if factor is None:
        return None
    wide = problem.second_block >= 0
    first = np.concatenate([np.arange(num), problem.camera_block[wide]])
    second = np.concatenate([np.arange(num), problem.second_block[wide]])
    found = factor.inverse_tiles(first, second)
    if not _agrees(factor, found[:num], problem.block_dim):
        return None
    if len(basis):
        found = _in_inner_gauge(found, factor, basis, constraint, first, second)
    beside = np.zeros((num, 8, 8))
    beside[first[num:]] = found[num:]
    return found[:num], beside, len(basis)


def _from_both_sides(a: Ints, b: Ints, tiles: Array, rows: Array) -> Array:
    """(k, k) product of rows (k, B * 8) from both sides with what upper tiles are of, as of :func:`upper_tiles`."""
    from scipy import sparse

    num = rows.shape[1] // 8
    halved = tiles.copy()
    on_diagonal = a == b
    halved[on_diagonal] = np.triu(tiles[on_diagonal]) * (1.0 - 0.5 * np.eye(8))
    pointers = np.searchsorted(a, np.arange(num + 1))
    upper = sparse.bsr_matrix((halved, b, pointers), shape=(num * 8, num * 8))
    product: Array = rows @ (upper @ rows.T)
    return product + product.T


def _factored(engine: Engine, a: Ints, b: Ints, tiles: Array) -> FrontSystem | None:
    """The factor of upper tiles as of :func:`upper_tiles`; None where they are singular, or it would cost too much."""
    dim, num = engine.problem.block_dim, engine.problem.num_blocks
    meets = np.flatnonzero(tiles.any(axis=(1, 2)) | (a == b))
    order = engine.front_order or FrontOrder(num, a[meets], b[meets])
    if flops_of_fronts(order, dim).sum() > _MAX_FLOPS:
        return None
    factor = FrontSystem(dim, a[meets] * num + b[meets], meets, order)
    return factor if factor.factor(tiles.ravel()) else None


def _hold(pose_blocks: Ints, basis: Array, diagonal: Array, tiles: Array, own: Ints) -> None:
    """Let two images hold the open directions (k, B * 8), the one as many as it can alone and the other those that are
    left: add to their own tiles, in place. Which two does not matter but for rounding.

    Args:
        pose_blocks: (n,) blocks of poses. diagonal: (B * 8,) of the system. own: (B,) tiles of blocks with themselves.
    """
    root = np.sqrt(diagonal.reshape(-1, 8)[pose_blocks, :6])
    moves = basis.reshape(len(basis), -1, 8)[:, pose_blocks, :6].transpose(1, 0, 2) * root[:, None]
    left = np.eye(len(basis))
    while len(left):
        turned, sizes, rows = np.linalg.svd(left @ moves, full_matrices=True)
        image = int(np.argmax(sizes[:, -1]))
        num_held = int((sizes[image] > _HOLDS * sizes[image, 0]).sum())
        if sizes[image, 0] == 0.0:
            return
        rows = rows[image, :num_held] * root[image]
        tiles[own[pose_blocks[image]], :6, :6] += rows.T @ rows
        left = turned[image][:, num_held:].T @ left


def _in_inner_gauge(
    blocks: Array, factor: FrontSystem, basis: Array, constraint: Array, first: Ints, second: Ints
) -> Array:
    """Blocks (N, 8, 8), of first and second (N,), of a covariance S with the open directions (k, B * 8) held somehow,
    moved to where the constraints (k, B * 8) vanish: of P S P^T, with P = 1 - basis^T (constraint basis^T)^-1
    constraint."""
    crossed = factor.substitute(constraint.T)
    turned = basis.T @ np.linalg.inv(constraint @ basis.T)
    # P S P^T = S - Y T^T - T Y^T + T W T^T with Y = S C^T, T = B^T (C B^T)^-1, W = C S C^T
    y, t = crossed.reshape(-1, 8, len(basis)), turned.reshape(-1, 8, len(basis))
    y_second, t_second = y[second].transpose(0, 2, 1), t[second].transpose(0, 2, 1)
    moved: Array = blocks - y[first] @ t_second - t[first] @ y_second + t[first] @ (constraint @ crossed) @ t_second
    return moved


def _agrees(factor: FrontSystem, blocks: Array, block_dim: Ints) -> bool:
    """Whether some entries on the diagonal of the inverse, of blocks (B, 8, 8), are those that the factor itself solves
    for."""
    chosen = np.linspace(0, len(blocks) - 1, _NUM_CHECKED).astype(int)
    columns = np.arange(len(chosen))
    right = np.zeros((len(blocks), 8, len(chosen)))
    last = block_dim[chosen] - 1
    right[chosen, last, columns] = 1.0
    solved = factor.substitute(right.reshape(-1, len(chosen))).reshape(right.shape)[chosen, last, columns]
    return bool(np.allclose(solved, blocks[chosen, last, last], rtol=_MAX_OFF))
