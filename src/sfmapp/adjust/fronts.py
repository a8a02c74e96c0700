"""In which order the blocks of a sparse system are eliminated, and which of them together.

Blocks are eliminated in an order of least degree; those that meet the same blocks behind them go together, in a front:
a small full matrix over them and what they meet, which takes over what the fronts below it leave (Duff and Reid, "The
multifrontal solution of indefinite sparse symmetric linear systems", 1983). All the work is products of full matrices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class FrontOrder:
    """In which order blocks are eliminated, and which of them together.

    Attributes:
        blocks: of each front, its blocks, those that it eliminates first. num_own: (F,) how many it eliminates.
        parent: (F,) the front that takes over what each leaves, behind it; -1 for the last ones.
        position: (B,) of each block in the order. num_entries: of the factor, in blocks.
    """

    def __init__(self, num_blocks: int, a: Ints, b: Ints) -> None:
        """a, b: (N,) blocks that meet."""
        order = _least_degree(num_blocks, a, b)
        above, behind = _eliminate(order, a, b)
        order = order[_children_first(above)]
        above, behind = _eliminate(order, a, b)
        # a block whose only difference to the next is that one goes with it
        is_next = above[:-1] == np.arange(1, num_blocks)
        sizes = np.array([len(each) for each in behind], np.int64)
        first = np.concatenate([[0], 1 + np.flatnonzero(~(is_next & (sizes[:-1] == sizes[1:] + 1)))]).astype(np.int64)
        end = np.append(first[1:], num_blocks)
        front_of = np.searchsorted(first, np.arange(num_blocks), side="right") - 1
        self.position = np.argsort(order)
        self.num_own = end - first
        self.parent = np.array([front_of[above[e - 1]] if above[e - 1] >= 0 else -1 for e in end], np.int64)
        self.blocks = [
            order[np.concatenate([np.arange(i, e), np.sort(np.fromiter(behind[e - 1], np.int64, len(behind[e - 1])))])]
            for i, e in zip(first, end, strict=True)
        ]
        self.num_entries = int(sizes.sum()) + num_blocks

    def unknowns(self, first: Ints, num: Ints) -> tuple[list[Ints], list[int]]:
        """Of each front, its unknowns and how many it eliminates; those of each block (B,) are so many from the first
        on."""
        found = []
        for blocks in self.blocks:
            count = num[blocks]
            begin = np.cumsum(count) - count
            found.append((np.repeat(first[blocks] - begin, count) + np.arange(int(count.sum()))).astype(np.int64))
        num_own = [int(num[blocks[:own]].sum()) for blocks, own in zip(self.blocks, self.num_own, strict=True)]
        return found, num_own


def _least_degree(num_blocks: int, a: Ints, b: Ints) -> Ints:
    """(B,) blocks in an order of least degree."""
    from scipy import sparse
    from scipy.sparse.linalg import splu

    apart = a != b
    row, column = np.concatenate([a[apart], b[apart]]), np.concatenate([b[apart], a[apart]])
    pattern = sparse.coo_matrix((np.ones(len(row)), (row, column)), shape=(num_blocks, num_blocks)).tocsc()
    pattern.data[:] = 1.0
    heavy = sparse.csc_matrix(pattern + (num_blocks + 1.0) * sparse.eye(num_blocks))
    found = splu(heavy, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.argsort(found.perm_c).astype(np.int64)


def _eliminate(order: Ints, a: Ints, b: Ints) -> tuple[Ints, list[set[int]]]:
    """For each position in the order the first that is met behind it, -1 for none, and all that are."""
    position = np.argsort(order)
    low, high = np.minimum(position[a], position[b]), np.maximum(position[a], position[b])
    behind: list[set[int]] = [set() for _ in order]
    for i, j in zip(low.tolist(), high.tolist(), strict=True):
        if i != j:
            behind[i].add(j)
    above = np.full(len(order), -1, np.int64)
    for i, met in enumerate(behind):
        if met:
            above[i] = min(met)
            behind[above[i]] |= met
            behind[above[i]].discard(int(above[i]))
    return above, behind


def _children_first(above: Ints) -> Ints:
    """Positions such that each comes right behind all that lead to it."""
    children: list[list[int]] = [[] for _ in above]
    for i, parent in enumerate(above.tolist()):
        if parent >= 0:
            children[parent].append(i)
    out: list[int] = []
    stack = np.flatnonzero(above < 0).tolist()
    while stack:  # the last first, in reverse
        i = stack.pop()
        out.append(i)
        stack += children[i]
    return np.array(out[::-1], np.int64)


def substitute(unknowns: list[Ints], num_own: list[int], inverse: list[Array], below: list[Array], x: Array) -> None:
    """Solve in place for right-hand sides x (N, ...) by a factor: of each front its unknowns and how many of them, the
    first, it eliminates, the inverse of the factor over these, and what is below it."""
    fronts = list(zip(unknowns, num_own, inverse, below, strict=True))
    for places, k, upper, rest in fronts:
        own = upper @ x[places[:k]]
        x[places[:k]] = own
        x[places[k:]] -= rest @ own
    for places, k, upper, rest in reversed(fronts):
        x[places[:k]] = upper.T @ (x[places[:k]] - rest.T @ x[places[k:]])
