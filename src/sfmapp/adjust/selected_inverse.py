"""Covariances of the poses of many images: those blocks of the inverse of a sparse system that are wanted, and no more.

The reduced system of a survey is sparse, its inverse is full: of a thousand images half a gigabyte, of which the blocks
on the diagonal are a thousandth. The recursion of Takahashi, Fagan and Chen ("Formation of a sparse bus impedance
matrix", 1973; Golub and Plemmons, "Large-scale geodetic least-squares adjustment", 1980) makes the entries of the
inverse where the factor has its own, from the last column to the first, and nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.covariance import gauge_of, pose_covariances, residual_variance, upper_tiles
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import EVERYTHING
from sfmapp.adjust.solver import Engine, make_engine
from sfmapp.camera.camera import Camera
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Columns that are solved for besides, and how far they may be off: of correct ones rounding leaves 1e-6 where positions
# hold the whole as loosely as those of a phone do.
_NUM_CHECKED, _MAX_OFF = 4, 1e-3
# Entries of a factor: of a survey of 1,000 images two to five million; where all meet all, this many take minutes.
_MAX_ENTRIES = 15_000_000


def estimate_pose_covariances(
    reconstruction: Reconstruction,
    options: AdjustOptions,
    *,
    prior_cameras: Sequence[Camera] | None = None,
    extra_factors: Any = None,
) -> tuple[Ints, Array] | None:
    """Covariances of poses at a minimum where factors beside the reprojections leave nothing open.

    Arguments as of :func:`~sfmapp.adjust.covariance.estimate_covariances`, which has those of everything else too.

    Returns:
        Images (n,) that vary, and (n, 6, 6); None where something is open, or too many images meet too many others.
    """
    engine = make_engine(
        reconstruction, options, EVERYTHING, prior_cameras=prior_cameras, extra_factors=extra_factors, is_closing=True
    )
    variance = residual_variance(engine)
    engine.priors.weight *= variance
    if engine.extras is not None:
        engine.extras.weight = variance
    engine.linearize(0.0, map)
    blocks = _inverse_blocks(engine)
    return None if blocks is None else pose_covariances(reconstruction, engine.problem, variance * blocks)


def _inverse_blocks(engine: Engine) -> Array | None:
    """(B, 8, 8) blocks on the diagonal of the inverse of the undamped reduced system."""
    from scipy.sparse.linalg import splu

    used = (np.arange(8) < engine.problem.block_dim[:, None]).ravel()
    matrix = _sparse_system(engine, used)
    basis, _ = gauge_of(engine.problem, used, matrix, matrix.diagonal(), has_factors=engine.extras is not None)
    if len(basis):
        return None
    root = 1.0 / np.sqrt(matrix.diagonal())
    scaled = matrix.multiply(root[:, None]).multiply(root[None]).tocsc()
    try:
        factor = splu(
            scaled, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True, "Equil": False}
        )
    except RuntimeError:  # singular
        return None
    lower, pivots = factor.L.tocsc(), factor.U.diagonal()
    lower.sort_indices()
    if lower.nnz > _MAX_ENTRIES:
        return None
    if not (pivots > 0).all() or not np.array_equal(factor.perm_r, factor.perm_c):
        return None
    diagonal, entries = np.empty(len(root)), np.zeros(len(lower.data))
    _select(lower.indptr.astype(np.int64), lower.indices.astype(np.int64), lower.data, pivots, diagonal, entries)
    place = np.argsort(factor.perm_c)  # of the columns of the factor among ours
    if not _agrees(factor, diagonal, place):
        return None
    column = np.repeat(np.arange(len(root)), np.diff(lower.indptr))
    blocks = _gathered(place[lower.indices], place[column], entries, place, diagonal, used)
    full_root = np.zeros(len(used))
    full_root[used] = root
    per_block = full_root.reshape(-1, 8)
    return blocks * per_block[:, :, None] * per_block[:, None, :]


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


def _gathered(row: Ints, column: Ints, entries: Array, place: Ints, diagonal: Array, used: NDArray[np.bool_]) -> Array:
    """(B, 8, 8) blocks on the diagonal, of entries of the inverse by their unknowns."""
    number = np.flatnonzero(used)
    blocks = np.zeros((len(used) // 8, 8, 8))
    row, column, own = number[row], number[column], number[place]
    within = row // 8 == column // 8
    i, j, values = row[within], column[within], entries[within]
    blocks[i // 8, i % 8, j % 8] = blocks[i // 8, j % 8, i % 8] = values
    blocks[own // 8, own % 8, own % 8] = diagonal
    return blocks


def _agrees(factor: Any, diagonal: Array, place: Ints) -> bool:
    """Whether some entries are those that the factor itself solves for."""
    chosen = np.linspace(0, len(diagonal) - 1, _NUM_CHECKED).astype(int)
    right = np.zeros((len(diagonal), len(chosen)))
    right[place[chosen], np.arange(len(chosen))] = 1.0
    solved = factor.solve(right)[place[chosen], np.arange(len(chosen))]
    return bool(np.allclose(solved, diagonal[chosen], rtol=_MAX_OFF))


@numba.njit(cache=True, nogil=True)
def _select(indptr: Ints, indices: Ints, lower: Array, pivots: Array, diagonal: Array, entries: Array) -> None:
    """Fill the inverse's diagonal (N,), and its entries (NNZ,) below that where those of the factor L D L^T are; rows
    are sorted in each column, which begins with its diagonal."""
    size = len(pivots)
    place, found = np.full(size, -1), np.zeros(size)
    for j in range(size - 1, -1, -1):
        first, end = indptr[j] + 1, indptr[j + 1]
        for q in range(first, end):
            place[indices[q]] = q
            found[q - first] = 0.0
        for q in range(first, end):
            k = indices[q]
            factor = lower[q]
            total = diagonal[k] * factor
            for p in range(indptr[k] + 1, indptr[k + 1]):
                at = place[indices[p]]
                if at >= 0:
                    found[at - first] += entries[p] * factor
                    total += entries[p] * lower[at]
            found[q - first] += total
        value = 1.0 / pivots[j]
        for q in range(first, end):
            entries[q] = -found[q - first]
            value += found[q - first] * lower[q]
            place[indices[q]] = -1
        diagonal[j] = value
