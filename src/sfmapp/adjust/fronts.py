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


# What a front costs, in products of two blocks: so many for each that it leaves to the one above, which is written and
# read several times, and for its handling. Measured on fronts of a walk through a town, of poses.
_LEFT, _HANDLING = 12.0, 3000.0


class FrontOrder:
    """In which order blocks are eliminated, and which of them together.

    Attributes:
        blocks: of each front, its blocks, those that it eliminates first. num_own: (F,) how many it eliminates.
        parent: (F,) the front that takes over what each leaves, behind it; -1 for the last ones.
        position: (B,) of each block in the order.
    """

    def __init__(self, num_blocks: int, a: Ints, b: Ints) -> None:
        """a, b: (N,) blocks that meet."""
        order = _least_degree(num_blocks, a, b)
        above, behind = _eliminate(order, a, b)
        fronts, parent = _merged(*_alike(above, behind), behind)
        kept = [f for f in _children_first(parent).tolist() if fronts[f]]
        place = np.full(len(fronts), -1, np.int64)
        place[kept] = np.arange(len(kept))
        self.num_own = np.array([len(fronts[f]) for f in kept], np.int64)
        self.parent = np.where(parent[kept] >= 0, place[parent[kept]], -1)
        rank = np.argsort([i for f in kept for i in fronts[f]])
        self.position = rank[np.argsort(order)]
        self.blocks = [order[[*fronts[f], *sorted(behind[fronts[f][-1]], key=rank.__getitem__)]] for f in kept]

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


def _alike(above: Ints, behind: list[set[int]]) -> tuple[list[list[int]], Ints]:
    """Fronts of positions that leave the same but for themselves, and (F,) which front is above each, -1 for none."""
    fronts: list[list[int]] = []
    front_of = np.full(len(above), -1, np.int64)
    for i in _children_first(above).tolist():
        last = fronts[-1][-1] if fronts else -1
        if last >= 0 and above[last] == i and len(behind[last]) == len(behind[i]) + 1:
            fronts[-1].append(i)
        else:
            fronts.append([i])
        front_of[i] = len(fronts) - 1
    tops = above[[front[-1] for front in fronts]]
    return fronts, np.where(tops >= 0, front_of[tops], -1)


def _merged(fronts: list[list[int]], parent: Ints, behind: list[set[int]]) -> tuple[list[list[int]], Ints]:
    """The same where each front that is quicker as a part of the one above has been made one, with the zeros that come
    by that (Ashcraft and Grimes, "The influence of relaxed supernode partitions on the multifrontal method", 1989): a
    place that is empty is left of it. Parents are behind their children."""
    fronts, into = [list(front) for front in fronts], np.arange(len(fronts))
    left = [len(behind[front[-1]]) for front in fronts]
    for f, p in enumerate(parent.tolist()):
        if p < 0:
            continue
        own, above = len(fronts[f]), len(fronts[p])
        if _cost(own + above, left[p]) <= _cost(own, left[f]) + _cost(above, left[p]):
            fronts[p] = fronts[f] + fronts[p]
            fronts[f], into[f] = [], p
    for f in range(len(fronts) - 1, -1, -1):
        into[f] = into[into[f]]
    return fronts, np.where(parent >= 0, into[parent], -1)


def _cost(own: int, left: int) -> float:
    """Of a front that eliminates so many blocks and leaves others."""
    return own * (0.5 * own * own + left * (own + 0.5 * left)) + _LEFT * left * left + _HANDLING


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
