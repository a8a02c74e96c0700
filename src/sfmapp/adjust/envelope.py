"""The Cholesky factor of large reduced systems inside their envelope, on all threads.

Below the first number of each row a factor has no zeros that last (George and Liu, "Computer Solution of Large Sparse
Positive Definite Systems", 1981, chapter 4): rows are put in an order that keeps them short (reverse Cuthill-McKee),
gathered in panels, and each panel is kept from its first column to its diagonal. Nearly all the work is then products
of panels, which the linear algebra below numpy does at the speed of the machine, and full systems are but those whose
rows all begin with the first. Each product is made whole by one thread, in an order that depends on the system alone:
the bytes are those of one thread.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Unknowns of a panel: wide ones make faster products, narrow ones fit closer around short rows.
_WIDE, _NARROW, _WIDE_ROWS = 192, 96, 1500
# A block that meets more than this share of all is put last: all others would follow it otherwise.
_MEETS_MOST = 0.5
# What rounding leaves of a zero pivot, against the diagonal before.
NO_PIVOT = 1e-14


class EnvelopeOrder:
    """An order of the blocks, and panels of neighbours in it.

    Attributes:
        position: (B,) of each block. offset: (B,) first unknown of the block at each position. panel: (B,) of each
            block. first: (S,) first panel that each panel's rows reach. start: (S + 1,) first unknown of each panel.
        flops: multiplications and additions of the factor.
    """

    def __init__(self, block_dim: Ints, a: Ints, b: Ints) -> None:
        """a, b: (N,) blocks a <= b that meet."""
        best: tuple[float, Any] | None = None
        for order in _orders(len(block_dim), a, b):
            position = np.argsort(order)
            reach = _reach(position, block_dim[order], a, b)
            if best is None or reach.sum() < best[0]:
                best = float(reach.sum()), (order, position, reach)
        assert best is not None
        order, self.position, reach = best[1]
        size = _WIDE if best[0] / len(reach) > _WIDE_ROWS else _NARROW
        dims = block_dim[order]
        self.offset = np.cumsum(dims) - dims
        of_position = np.minimum(self.offset // size, max(0, (int(dims.sum()) - 1) // size))
        _, of_position = np.unique(of_position, return_inverse=True)
        self.panel = of_position[self.position]
        num = int(of_position.max(initial=-1)) + 1
        self.start = np.append(self.offset[np.searchsorted(of_position, np.arange(num))], dims.sum()).astype(np.int64)
        self.first = np.full(num, num, np.int64)
        low, high = np.minimum(self.panel[a], self.panel[b]), np.maximum(self.panel[a], self.panel[b])
        np.minimum.at(self.first, high, low)
        height, begin = np.diff(self.start).astype(np.float64), self.start[self.first]
        self.flops = 0.0
        for k in range(num):
            reaches = np.flatnonzero(self.first[k:] <= k) + k
            inner = np.maximum(0, self.start[k] - np.maximum(begin[reaches], begin[k]))
            self.flops += float(2.0 * height[k] * (height[reaches] * (inner + height[k])).sum())


def _orders(num_blocks: int, a: Ints, b: Ints) -> list[Ints]:
    """The order as it is, and one that keeps rows short; blocks that meet most others last."""
    from scipy import sparse
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    degree = np.bincount(a, minlength=num_blocks) + np.bincount(b, minlength=num_blocks)
    meets_most = degree > _MEETS_MOST * num_blocks
    others, last = np.flatnonzero(~meets_most), np.flatnonzero(meets_most)
    natural = np.concatenate([others, last])
    if len(others) < 2:
        return [natural]
    kept = ~meets_most[a] & ~meets_most[b]
    place = np.cumsum(~meets_most) - 1
    row, column = place[a[kept]], place[b[kept]]
    both = np.concatenate([row, column]), np.concatenate([column, row])
    graph = sparse.csr_matrix((np.ones(2 * len(row), np.int8), both), shape=(len(others), len(others)))
    return [natural, np.concatenate([others[reverse_cuthill_mckee(graph, symmetric_mode=True)], last])]


def _reach(position: Ints, dims: Ints, a: Ints, b: Ints) -> Ints:
    """(B,) unknowns from the first of each row of blocks, in their order, to its diagonal."""
    start = np.cumsum(dims) - dims
    first = start.copy()
    np.minimum.at(first, np.maximum(position[a], position[b]), start[np.minimum(position[a], position[b])])
    return start - first


class EnvelopeSystem:
    """The factor in panels of rows.

    Args of solve as of :class:`~sfmapp.adjust.linear.TileSystem`; keys (N,) a B + b and numbers (N,) say which tiles
    there are, ``run`` maps tasks on threads.
    """

    def __init__(self, block_dim: Ints, keys: Ints, numbers: Ints, order: EnvelopeOrder | None = None) -> None:
        a, b = np.divmod(keys, len(block_dim))
        self._dim = block_dim
        self.order = order = order or EnvelopeOrder(block_dim, a, b)
        self._begin = order.start[order.first]
        self._panels = [
            np.zeros((end - start, end - begin))
            for (start, end), begin in zip(pairwise(order.start), self._begin, strict=True)
        ]
        self._inverse: list[Array] = [np.zeros((0, 0))] * len(self._panels)
        unknown = order.offset[order.position]
        is_turned = order.position[a] <= order.position[b]  # tiles have a before b, panels are lower
        high, low = np.where(is_turned, b, a), np.where(is_turned, a, b)
        panel = order.panel[high]
        sort = np.argsort(panel, kind="stable")
        places = np.stack(
            [
                numbers, unknown[high] - order.start[panel], unknown[low] - self._begin[panel], block_dim[high],
                block_dim[low], is_turned,
            ],
            1,
        )[sort].astype(np.int64)  # fmt: skip
        ends = np.searchsorted(panel[sort], np.arange(len(self._panels) + 1))
        self._places = [places[i:j] for i, j in pairwise(ends)]
        self._at = unknown

    def solve(self, tiles: Array, rhs: Array, run: Callable[..., Any] = map) -> Array | None:
        """Solution (B * 8,) of the damped system in tiles (N * 64,), None where it is not positive definite."""
        return self.substitute(rhs) if self.factor(tiles, run) else None

    def factor(self, tiles: Array, run: Callable[..., Any] = map) -> bool:
        """Factor the system in tiles (N * 64,); False where it is not positive definite."""
        num = len(self._panels)
        list(run(lambda i: gather_panel(tiles, self._places[i], self._panels[i]), range(num)))
        diagonal = [panel[:, -len(panel) :].diagonal().copy() for panel in self._panels]
        for k in range(num):
            below = [i for i in range(k + 1, num) if self.order.first[i] <= k]
            if not self._factor_diagonal(k, diagonal[k]):
                return False
            list(run(lambda i, k=k: self._eliminate(i, k), below))
        return True

    def substitute(self, rhs: Array) -> Array:
        """Solution (B * 8,) for a right-hand side (B * 8,), with the factor."""
        used = np.arange(8) < self._dim[:, None]
        at = (self._at[:, None] + np.arange(8))[used]
        x = np.empty(self.order.start[-1])
        x[at] = rhs.reshape(-1, 8)[used]
        self._substitute_panels(x)
        step = np.zeros((len(self._dim), 8))
        step[used] = x[at]
        return step.ravel()

    def _before(self, i: int, k: int) -> tuple[Array, Array]:
        """The parts of panels i and k that lie above each other, up to the diagonal of k."""
        begin, end = max(self._begin[i], self._begin[k]), self.order.start[k]
        if begin >= end:
            return self._panels[i][:, :0], self._panels[k][:, :0]
        return (
            self._panels[i][:, begin - self._begin[i] : end - self._begin[i]],
            self._panels[k][:, begin - self._begin[k] : end - self._begin[k]],
        )

    def _factor_diagonal(self, k: int, diagonal: Array) -> bool:
        """Factor a block on the diagonal, with (N,) its diagonal before; False where it is not positive definite."""
        from scipy.linalg.lapack import dtrtri

        left, right = self._before(k, k)
        block = self._panels[k][:, -len(self._panels[k]) :]
        if left.shape[1]:
            block -= left @ right.T
        try:
            factor = np.linalg.cholesky(block)
        except np.linalg.LinAlgError:
            return False
        if not (factor.diagonal() ** 2 > NO_PIVOT * diagonal).all():
            return False
        self._inverse[k] = np.ascontiguousarray(dtrtri(factor, lower=1)[0])
        return True

    def _eliminate(self, i: int, k: int) -> None:
        """The columns of panel k in panel i below it."""
        left, right = self._before(i, k)
        at = self.order.start[k] - self._begin[i]
        block = self._panels[i][:, at : at + len(self._panels[k])]
        if left.shape[1]:
            block -= left @ right.T
        block[:] = block @ self._inverse[k].T

    def _substitute_panels(self, x: Array) -> None:
        """Solve L L^T x = b in place."""
        start, num = self.order.start, len(self._panels)
        for i in range(num):
            own, before = slice(start[i], start[i + 1]), slice(self._begin[i], start[i])
            x[own] = self._inverse[i] @ (x[own] - self._panels[i][:, : start[i] - self._begin[i]] @ x[before])
        for i in range(num - 1, -1, -1):
            own, before = slice(start[i], start[i + 1]), slice(self._begin[i], start[i])
            x[own] = self._inverse[i].T @ x[own]
            x[before] -= self._panels[i][:, : start[i] - self._begin[i]].T @ x[own]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def gather_panel(tiles: Array, places: Ints, panel: Array) -> None:
    """Fill a panel from its tiles; places (M, 6) are number of the tile, row and column in the panel, how many of them,
    and whether the tile is turned there."""
    panel[:] = 0.0
    for n in range(places.shape[0]):
        tile, row, column, height, width, is_turned = places[n]
        for j in range(height):
            for k in range(width):
                panel[row + j, column + k] = tiles[tile * 64 + (8 * k + j if is_turned else 8 * j + k)]
