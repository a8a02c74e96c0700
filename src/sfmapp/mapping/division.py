"""The match graph of many images divided into parts that are mapped by themselves, and joined by the images they share.

Images are vertices, and pairs with enough verified matches the edges. A set is cut where fewest matches are lost for
halves of some size: a half grows from one end of the graph by the image that it is most tied to (Karypis and Kumar, "A
fast and high quality multilevel scheme for partitioning irregular graphs", 1998, section 3.2, graph growing), and the
best of all its sizes is improved image by image (Fiduccia and Mattheyses, 1982). The fewest images that all pairs
across have one of (Koenig 1931) are the separator, and belong to both halves, so that no pair is lost: nested
dissection (George 1973), as Ni, Steedly and Dellaert divide a model into submaps ("Out-of-core bundle adjustment for
large-scale 3D reconstruction", 2007).
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]

# Images of a part at most, where the graph can be cut: those of a neighbourhood, which few rounds of adjusting bring to
# rest. Nothing hangs on it closely.
LARGEST_PART = 150
# Fewer verified matches prove no geometry of a pair, and of two images that have others with ten times as many matches
# a pair says nothing that these do not: it is left to the model of all. So is an image in a part of which another part
# has ten times as many matches: with so few it comes to a place by chance, and drags the others along.
_MIN_MATCHES, _MIN_SHARE = 30, 0.1
# The smaller half has this share of the images at least.
_MIN_HALF = 0.3
# A cut is good where the separator is at most so large a share of what each half has to itself: both map it. It has
# so many images at least: with those that are tied to it most: two hold a similarity, each more tells whether it holds.
_MAX_SEPARATOR, _FEWEST_SHARED = 0.75, 6


def divide(num_images: int, pair_image_idx: NDArray[np.integer], num_matches: NDArray[np.integer]) -> list[Ints]:
    """Parts of a match graph, for each the positions of its images, ascending; the parts by their first images.

    Every link (:func:`links`) is inside a part, but for those of an image whose other links another part has, and each
    part is connected by links. Images without any are in no part, as are groups that are too small to be mapped. A set
    that has no good cut is a part as it is, whatever its size.

    Args:
        num_images: I.
        pair_image_idx: (P, 2) positions i < j. num_matches: (P,) verified matches.
    """
    kept = links(num_images, pair_image_idx, num_matches)
    graph = _Graph.of(num_images, np.asarray(pair_image_idx)[kept], np.asarray(num_matches)[kept])
    waiting = [c for c in graph.components(list(range(num_images))) if len(c) > 2]
    parts: list[list[int]] = []
    while waiting:
        members = waiting.pop()
        halves = graph.cut(members) if len(members) > LARGEST_PART else None
        if halves is None:
            parts.append(members)
        else:
            waiting += halves
    return [np.array(part, np.int64) for part in sorted(graph.without_loose(_without_contained(parts)))]


def links(num_images: int, pair_image_idx: NDArray[np.integer], num_matches: NDArray[np.integer]) -> NDArray[np.bool_]:
    """(P,) bool: pairs that hold two images together; arguments as of :func:`divide`."""
    i, j = np.asarray(pair_image_idx, np.int64).reshape(-1, 2).T
    most = np.zeros(num_images, np.int64)
    np.maximum.at(most, i, num_matches)
    np.maximum.at(most, j, num_matches)
    # what is much to one of the two may be all that this one has
    return np.asarray((num_matches >= _MIN_MATCHES) & (num_matches >= _MIN_SHARE * np.minimum(most[i], most[j])))


def _without_contained(parts: list[list[int]]) -> list[list[int]]:
    """The parts without those whose images another one has all."""
    holds: dict[int, set[int]] = {}
    for n, part in enumerate(parts):
        for image in part:
            holds.setdefault(image, set()).add(n)
    kept = []
    for n, part in enumerate(parts):
        others = set.intersection(*(holds[image] for image in part))
        if not any(len(parts[m]) > len(part) or (m < n and len(parts[m]) == len(part)) for m in others - {n}):
            kept.append(part)
    return kept


@dataclass(frozen=True)
class _Graph:
    """Neighbours of each image, and the matches with each."""

    neighbors: list[list[int]]
    weights: list[list[int]]

    @staticmethod
    def of(num_images: int, pairs: NDArray[np.integer], weight: NDArray[np.integer]) -> _Graph:
        both = np.concatenate([pairs, pairs[:, ::-1]]).astype(np.int64)
        order = np.lexsort((both[:, 1], both[:, 0]))
        ends = np.cumsum(np.bincount(both[:, 0], minlength=num_images))[:-1]
        split = (np.split(x[order], ends) for x in (both[:, 1], np.concatenate([weight, weight])))
        return _Graph(*([part.tolist() for part in parts] for parts in split))

    def components(self, members: list[int]) -> list[list[int]]:
        """Connected sets of members, each ascending, the largest first, of equals that with the first image."""
        left, found = set(members), []
        for first in members:
            if first not in left:
                continue
            left.remove(first)
            reached = [first]
            for i in reached:  # grows meanwhile
                new = [j for j in self.neighbors[i] if j in left]
                left.difference_update(new)
                reached += new
            found.append(sorted(reached))
        return sorted(found, key=lambda c: (-len(c), c))

    def cut(self, members: list[int]) -> list[list[int]] | None:
        """Two connected sets of members that share a separator, each ascending; None where there is no good cut."""
        inside = set(members)
        grown = [self._grown(inside, seed) for seed in self._ends(members)]
        _, half = min(grown, key=lambda g: (g[0], sorted(g[1])))
        first = self._improved(inside, half)
        first, second = self._connected(inside, first)
        separator = self._widened(inside, self._separator(first, second))
        own = min(len(first - separator), len(second - separator))
        if min(len(first), len(second)) < _MIN_HALF * len(inside) or len(separator) > _MAX_SEPARATOR * own:
            return None
        return [sorted(side | separator) for side in (first, second)]

    def without_loose(self, parts: list[list[int]]) -> list[list[int]]:
        """The parts without images of which another one has many times the matches, where they hang together so."""
        held = [{i: self._tie(i, set(part)) for i in part} for part in parts]
        most: dict[int, int] = {}
        for ties in held:
            for i, tie in ties.items():
                most[i] = max(most.get(i, 0), tie)
        firm = [[i for i, tie in ties.items() if tie >= _MIN_SHARE * most[i]] for ties in held]
        return [kept if len(self.components(kept)) == 1 else part for kept, part in zip(firm, parts, strict=True)]

    def _tie(self, i: int, inside: set[int]) -> int:
        """Matches of an image with those of a set."""
        return sum(w for j, w in self._edges(i) if j in inside)

    def _ends(self, members: list[int]) -> list[int]:
        """Members at the ends of the graph: two that are far from each other, and one far from both."""
        inside = set(members)
        first = self._distances(inside, members[0])
        u = max(members, key=lambda i: (first[i], -i))
        from_u = self._distances(inside, u)
        v = max(members, key=lambda i: (from_u[i], -i))
        from_v = self._distances(inside, v)
        w = max(members, key=lambda i: (min(from_u[i], from_v[i]), -i))
        return sorted({u, v, w})

    def _distances(self, inside: set[int], source: int) -> dict[int, int]:
        found, reached = {source: 0}, [source]
        for i in reached:  # grows meanwhile
            for j in self.neighbors[i]:
                if j in inside and j not in found:
                    found[j] = found[i] + 1
                    reached.append(j)
        return found

    def _grown(self, inside: set[int], seed: int) -> tuple[float, set[int]]:
        """The best of the halves that grow from a seed by the image that lessens the cut most, and its cost: matches
        across for the product of both sizes (Wei and Cheng 1991, ratio cut)."""
        total, cut, taken = len(inside), 0, set[int]()
        order: list[int] = []
        tied = dict.fromkeys(inside, 0)
        degree = {i: self._tie(i, inside) for i in inside}
        heap = [(degree[seed], seed)]
        best = (np.inf, 0)
        while heap:
            lost, i = heapq.heappop(heap)
            if i in taken or lost != degree[i] - 2 * tied[i]:
                continue
            taken.add(i)
            order.append(i)
            cut += lost
            size = len(order)
            if _MIN_HALF * total <= size <= (1.0 - _MIN_HALF) * total:
                best = min(best, (cut / (size * (total - size)), size))
            for j, w in self._edges(i):
                if j in inside and j not in taken:
                    tied[j] += w
                    heapq.heappush(heap, (degree[j] - 2 * tied[j], j))
        return best[0], set(order[: best[1]])

    def _edges(self, i: int) -> zip[tuple[int, int]]:
        return zip(self.neighbors[i], self.weights[i], strict=True)

    def _improved(self, inside: set[int], half: set[int]) -> set[int]:
        """The half after moves of single images that each lessen the matches across for the product of both sizes."""
        half, total = set(half), len(inside)
        across = {
            i: sum(w if (j in half) != (i in half) else -w for j, w in self._edges(i) if j in inside) for i in inside
        }
        cut = sum(w for i in half for j, w in self._edges(i) if j in inside and j not in half)
        is_moving = True
        while is_moving:
            is_moving = False
            for i in sorted(i for i in inside if across[i] > 0):
                size = len(half) + (-1 if i in half else 1)
                if across[i] <= 0 or not _MIN_HALF * total <= size <= (1.0 - _MIN_HALF) * total:
                    continue
                if (cut - across[i]) * len(half) * (total - len(half)) >= cut * size * (total - size):
                    continue
                cut -= across[i]
                half ^= {i}
                across[i] = -across[i]
                for j, w in self._edges(i):
                    if j in inside:
                        across[j] += -2 * w if (j in half) == (i in half) else 2 * w
                is_moving = True
        return half

    def _connected(self, inside: set[int], half: set[int]) -> tuple[set[int], set[int]]:
        """Both halves as connected sets: what of one is cut off from most of it goes to the other."""
        first, second = set(half), inside - half
        for _ in range(2):
            for part in self.components(sorted(second))[1:]:
                second -= set(part)
                first |= set(part)
            first, second = second, first
        return first, second

    def _widened(self, inside: set[int], separator: set[int]) -> set[int]:
        """A separator with so many images that submaps can be held against each other in them."""
        separator = set(separator)
        while len(separator) < _FEWEST_SHARED:
            tied: dict[int, int] = {}
            for i in separator:
                for j, w in self._edges(i):
                    if j in inside and j not in separator:
                        tied[j] = tied.get(j, 0) + w
            if not tied:
                break
            separator.add(min(tied, key=lambda j: (-tied[j], j)))
        return separator

    def _separator(self, first: set[int], second: set[int]) -> set[int]:
        """The fewest images that all links between two sets have one of, by a largest matching of these (Koenig)."""
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import maximum_bipartite_matching

        rows = sorted(i for i in first if any(j in second for j in self.neighbors[i]))
        columns = sorted({j for i in rows for j in self.neighbors[i] if j in second})
        place = {j: n for n, j in enumerate(columns)}
        met = [[place[j] for j in self.neighbors[i] if j in second] for i in rows]
        ptr = np.cumsum([0, *map(len, met)])
        table = csr_array((np.ones(ptr[-1], np.int8), np.concatenate(met), ptr), shape=(len(rows), len(columns)))
        of_row = maximum_bipartite_matching(table, perm_type="column")
        of_column = {int(c): r for r, c in enumerate(of_row) if c >= 0}
        # what alternating ways from unmatched rows reach: its columns, and all other rows
        reached = [r for r, c in enumerate(of_row) if c < 0]
        seen_rows, seen_columns = set(reached), set[int]()
        for r in reached:  # grows meanwhile
            for c in met[r]:
                if c not in seen_columns:
                    seen_columns.add(c)
                    if of_column[c] not in seen_rows:
                        seen_rows.add(of_column[c])
                        reached.append(of_column[c])
        return {i for r, i in enumerate(rows) if r not in seen_rows} | {columns[c] for c in seen_columns}
