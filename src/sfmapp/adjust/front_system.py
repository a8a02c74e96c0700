"""The Cholesky factor of large sparse reduced systems by fronts, on all threads.

Where images meet few others, in all directions, as those of a town do, rows have no order that keeps them short: the
envelope of a part of the plane with B blocks costs B^2, fronts B^1.5 (George 1973). The inverse is made from the last
front to the first, each from the one above it, and nowhere else (Takahashi, Fagan and Chen, "Formation of a sparse bus
impedance matrix", 1973; Golub and Plemmons, "Large-scale geodetic least-squares adjustment", 1980). Subtrees of fronts
that cost alike are done by one thread each, in an order that keeps little waiting; the few fronts above them, which are
large, by all threads in rows. Every number is made in an order that depends on the system alone: the bytes are those of
one thread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.blas import (
    divide_columns,
    divide_rows,
    factor_lower,
    invert_lower,
    subtract_product,
    subtract_square,
)
from sfmapp.adjust.envelope import NO_PIVOT, EnvelopeOrder, EnvelopeSystem, gather_panel
from sfmapp.adjust.fronts import FrontOrder
from sfmapp.adjust.linear import may_suit_fronts, prefers_fronts

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Subtrees cost at most this share of all each, and rows and columns of large fronts are taken so many at a time.
_SUBTREE, _ROWS = 1 / 24, 192


class FrontSystem:
    """The factor in fronts.

    Args of solve as of :class:`~sfmapp.adjust.linear.TileSystem`; keys (N,) a B + b and numbers (N,) say which tiles
    there are, ``run`` maps tasks on threads.
    """

    def __init__(self, block_dim: Ints, keys: Ints, numbers: Ints, order: FrontOrder) -> None:
        self._dim, self._order = block_dim, order
        dims = block_dim[np.argsort(order.position)]
        self._at = (np.cumsum(dims) - dims)[order.position]  # first unknown of each block, as they are eliminated
        self._unknowns, self._num_own = order.unknowns(self._at, block_dim)
        self._places = self._places_of_tiles(*np.divmod(keys, len(block_dim)), numbers)
        self._children: list[list[int]] = [[] for _ in order.blocks]
        self._at_parent: list[Ints] = []
        for f, parent in enumerate(order.parent.tolist()):
            left = self._unknowns[f][self._num_own[f] :]
            self._at_parent.append(np.searchsorted(self._unknowns[parent], left) if parent >= 0 else left)
            if parent >= 0:
                self._children[parent].append(f)
        self._subtrees, self._above = _parted(order.parent, flops_of_fronts(order, block_dim))
        self._left: list[Array | None] = [None] * len(order.blocks)
        self._factor = [np.zeros((0, 0))] * len(order.blocks)

    def _places_of_tiles(self, a: Ints, b: Ints, numbers: Ints) -> list[Ints]:
        """Where the tiles (a, b) of each front go in its own columns, as of :func:`gather_panel`."""
        position, dim = self._order.position, self._dim
        is_turned = position[a] <= position[b]  # tiles have a before b, columns are of what is eliminated first
        high, low = np.where(is_turned, b, a), np.where(is_turned, a, b)
        front = np.repeat(np.arange(len(self._num_own)), self._order.num_own)[position[low]]
        sort = np.argsort(front, kind="stable")
        ends = np.searchsorted(front[sort], np.arange(len(self._num_own) + 1))
        out = []
        for f, unknowns in enumerate(self._unknowns):
            here = sort[ends[f] : ends[f + 1]]
            row, column = (np.searchsorted(unknowns, self._at[block[here]]) for block in (high, low))
            places = [numbers[here], row, column, dim[high[here]], dim[low[here]], is_turned[here]]
            out.append(np.stack(places, 1).astype(np.int64))
        return out

    def solve(self, tiles: Array, rhs: Array, run: Callable[..., Any] = map) -> Array | None:
        """Solution (B * 8,) of the damped system in tiles (N * 64,), None where it is not positive definite."""
        return self.substitute(rhs) if self.factor(tiles, run) else None

    def factor(self, tiles: Array, run: Callable[..., Any] = map) -> bool:
        """Factor the system in tiles (N * 64,); False where it is not positive definite."""
        self._left = [None] * len(self._left)

        def subtree(fronts: range) -> bool:
            return all(self._eliminate(f, tiles, map) for f in fronts)

        return all(list(run(subtree, self._subtrees))) and all(self._eliminate(f, tiles, run) for f in self._above)

    def _eliminate(self, f: int, tiles: Array, run: Callable[..., Any]) -> bool:
        """Factor the own columns of a front, and keep what it leaves to the one above; False where there is no
        factor."""
        k, size = self._num_own[f], len(self._unknowns[f])
        own, rest = np.zeros((size, k)), np.zeros((size - k, size - k))
        gather_panel(tiles, self._places[f], own)
        diagonal = own.diagonal().copy()
        for child in self._children[f]:
            left = self._left[child]
            assert left is not None
            _add_left(left, self._at_parent[child], own, rest)
            self._left[child] = None
        if not _factor_columns(own, run):
            return False
        if not (own.diagonal() ** 2 > NO_PIVOT * diagonal).all():
            return False
        below = own[k:]

        def subtracted(i: int) -> None:
            j = min(i + _ROWS, size - k)
            subtract_product(rest[i:j, :i], below[i:j], below[:i])
            subtract_square(rest[i:j, i:j], below[i:j])  # the lower half is all that is used

        list(run(subtracted, range(0, size - k, _ROWS)))
        self._factor[f], self._left[f] = own, rest
        return True

    def substitute(self, rhs: Array) -> Array:
        """Solution (B * 8, ...) for a right-hand side (B * 8, ...), with the factor."""
        used = (np.arange(8) < self._dim[:, None]).ravel()
        at = (self._at[:, None] + np.arange(8)).ravel()[used]
        x = np.empty((len(at), rhs.size // len(rhs)))
        x[at] = rhs[used].reshape(len(at), -1)
        fronts = list(zip(self._unknowns, self._num_own, self._factor, strict=True))
        for unknowns, k, factor in fronts:
            own = x[unknowns[0] : unknowns[0] + k]
            divide_columns(own, factor[:k], is_turned=False)
            x[unknowns[k:]] -= factor[k:] @ own
        for unknowns, k, factor in reversed(fronts):
            own = x[unknowns[0] : unknowns[0] + k]
            own -= factor[k:].T @ x[unknowns[k:]]
            divide_columns(own, factor[:k], is_turned=True)
        step = np.zeros(rhs.shape)
        step[used] = x[at].reshape(len(at), *rhs.shape[1:])
        return step

    def inverse_tiles(self, first: Ints, second: Ints) -> Array:
        """(N, 8, 8) of the inverse of the system, with the factor, of pairs of blocks (N,) that meet; zeros beyond
        their unknowns."""
        out = np.zeros((len(first), 8, 8))
        position = self._order.position
        front = np.repeat(np.arange(len(self._num_own)), self._order.num_own)
        front = front[np.minimum(position[first], position[second])]
        sort = np.argsort(front, kind="stable")
        ends = np.searchsorted(front[sort], np.arange(len(self._num_own) + 1))
        for f, inverse in self._inverses():
            for n in sort[ends[f] : ends[f + 1]]:
                i, j = np.searchsorted(self._unknowns[f], self._at[[first[n], second[n]]])
                height, width = self._dim[first[n]], self._dim[second[n]]
                out[n, :height, :width] = inverse[i : i + height, j : j + width]
        return out

    def _inverses(self) -> Iterator[tuple[int, Array]]:
        """Each front, from the last to the first, and the inverse over its unknowns."""
        num_waiting = [len(children) for children in self._children]
        made: dict[int, Array] = {}
        for f in range(len(self._num_own) - 1, -1, -1):
            k, parent, factor = self._num_own[f], int(self._order.parent[f]), self._factor[f]
            full = np.empty((len(self._unknowns[f]), len(self._unknowns[f])))
            full[:k, :k] = factor[:k]
            invert_lower(full[:k, :k])
            _mirror(full, k)
            if parent >= 0:
                at = self._at_parent[f]
                full[k:, k:] = made[parent][np.ix_(at, at)]
                through = factor[k:].copy()
                divide_rows(through, factor[:k], is_turned=False)
                full[k:, :k] = -full[k:, k:] @ through
                full[:k, k:] = full[k:, :k].T
                full[:k, :k] -= through.T @ full[k:, :k]
                num_waiting[parent] -= 1
                if num_waiting[parent] == 0:
                    del made[parent]
            if num_waiting[f]:
                made[f] = full
            yield f, full


def _factor_columns(own: Array, run: Callable[..., Any]) -> bool:
    """Put the columns (M, K) of a Cholesky factor in the place of those of a matrix, its lower half, some at a time;
    False where it is not positive definite."""
    size, num = own.shape
    for c in range(0, num, _ROWS):
        d = min(c + _ROWS, num)

        def divided(i: int, c: int = c, d: int = d) -> None:
            divide_rows(own[i : i + _ROWS, c:d], own[c:d, c:d], is_turned=True)

        def subtracted(i: int, c: int = c, d: int = d) -> None:
            j = min(i + _ROWS, size)
            subtract_product(own[i:j, d : min(j, num)], own[i:j, c:d], own[d : min(j, num), c:d])

        if not factor_lower(own[c:d, c:d]):
            return False
        list(run(divided, range(d, size, _ROWS)))
        if d < num:
            list(run(subtracted, range(d, size, _ROWS)))
    return True


def _mirror(matrix: Array, num: int) -> None:
    """Put the lower half of the first rows and columns of a matrix into the upper one."""
    lower = np.tril(matrix[:num, :num])
    matrix[:num, :num] = lower + np.tril(lower, -1).T


def best_order(block_dim: Ints, a: Ints, b: Ints, fill: float) -> tuple[EnvelopeOrder | FrontOrder, float]:
    """What factors a large system the quicker, and how many multiplications and additions that takes.

    Args:
        block_dim: (B,) unknowns of each block. a, b: (N,) blocks a <= b that meet. fill: share of all that do.
    """
    envelope = EnvelopeOrder(block_dim, a, b)
    if may_suit_fronts(fill, envelope.flops):
        fronts = FrontOrder(len(block_dim), a, b)
        flops = float(flops_of_fronts(fronts, block_dim).sum())
        if prefers_fronts(flops, envelope.flops):
            return fronts, flops
    return envelope, envelope.flops


def factored_by(
    order: EnvelopeOrder | FrontOrder | None, block_dim: Ints, keys: Ints, numbers: Ints
) -> EnvelopeSystem | FrontSystem:
    """The system that an order of :func:`best_order` is of, or in the best envelope; arguments as of these."""
    if isinstance(order, FrontOrder):
        return FrontSystem(block_dim, keys, numbers, order)
    return EnvelopeSystem(block_dim, keys, numbers, order)


def flops_of_fronts(order: FrontOrder, block_dim: Ints) -> Array:
    """(F,) multiplications and additions of each front."""
    size = np.array([block_dim[blocks].sum() for blocks in order.blocks], np.float64)
    own = np.array([block_dim[blocks[:n]].sum() for blocks, n in zip(order.blocks, order.num_own, strict=True)])
    rest = size - own
    flops: Array = own * (4.0 / 3.0 * own**2 + 2.0 * own * rest + rest**2)
    return flops


def _parted(parent: Ints, flops: Array) -> tuple[list[range], list[int]]:
    """Subtrees of fronts, from the first to the last of each, and the fronts above them all; parents are behind their
    children."""
    total, first = flops.copy(), np.arange(len(parent))
    for f, p in enumerate(parent.tolist()):
        if p >= 0:
            total[p] += total[f]
            first[p] = min(first[p], first[f])
    is_above = total > _SUBTREE * flops.sum()
    roots = [f for f, p in enumerate(parent.tolist()) if not is_above[f] and (p < 0 or is_above[p])]
    return [range(int(first[f]), f + 1) for f in roots], np.flatnonzero(is_above).tolist()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_left(left: Array, at: Ints, own: Array, rest: Array) -> None:
    """Add the lower half of what a front has left to the one above it, in whose unknowns it is at (N,), ascending."""
    k = own.shape[1]
    num_own = int(np.searchsorted(at, k))
    for i in range(left.shape[0]):
        row = at[i]
        for j in range(min(i + 1, num_own)):
            own[row, at[j]] += left[i, j]
        for j in range(num_own, i + 1):
            rest[row - k, at[j] - k] += left[i, j]
