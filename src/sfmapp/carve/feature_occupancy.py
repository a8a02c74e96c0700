"""The feature-occupancy volume of Collins, "A space-sweep approach to true multi-image matching", CVPR 1996.

A plane sweeps through the volume, and each cell of it gets a vote of every photograph that shows an edge where it
shows the cell. Lines of sight to edges also meet by chance. If edges fell anywhere, a photograph in which a share p
of the pixels are edges would vote for a cell of a pixels by chance with 1 - (1 - p)^a, and the number of such votes
is a sum of independent ones. Collins takes it for Poisson's; here it is exact, as the recursion of the Poisson
binomial distribution has it, since a photograph has but one vote and the chances are not small. A cell is taken to
hold a feature if chance would give as many votes to less than ``MOST_BY_CHANCE`` cells of the whole volume
(Desolneux, Moisan and Morel, IJCV 2000, have thresholds of that kind).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from sfmapp.carve.views import View, project_point, project_points
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.simd.pointers import Index

Array = NDArray[np.float64]
Edges = NDArray[np.uint8]

STAGE = "occupancy"
# cells of the volume that chance may fill, in the mean
MOST_BY_CHANCE = 1.0
# photographs that a feature needs: two lines of sight cross wherever their epipolar planes are the same
LEAST_VIEWS = 3


@dataclass(frozen=True)
class FeatureOccupancy:
    """Votes for the cells of a box.

    Attributes:
        low: (3,) world corner of the box. cell: side of a cell, units of the world.
        votes: (Z, Y, X) uint8, photographs that show an edge where they show the cell.
        seen: (Z, Y, X) uint8, photographs that show the cell.
        is_feature: (Z, Y, X) bool.
    """

    low: Array
    cell: float
    votes: NDArray[np.uint8]
    seen: NDArray[np.uint8]
    is_feature: NDArray[np.bool_]

    @property
    def points(self) -> Array:
        """(N, 3) middles of the cells that hold a feature, world."""
        z, y, x = np.nonzero(self.is_feature)
        return self.low + (np.stack([x, y, z], axis=1) + 0.5) * self.cell


def sweep_features(
    views: Sequence[View], edges: Sequence[Edges], low: Array, cell: float, shape: tuple[int, int, int],
    events: Events | None = None,
) -> FeatureOccupancy:  # fmt: skip
    """Sweep a plane through a box, along z, and count in which photographs its cells are edges.

    Args:
        views: cameras of the photographs, 255 at most.
        edges: (H, W) uint8 of each, not 0 where there is an edge.
        low: (3,) world corner of the box. cell: side of a cell.
        shape: cells along z, y and x.
        events: progress and cancellation.

    Raises:
        InputError: fewer photographs than LEAST_VIEWS, or a size that is not its camera's.
        InterruptedRunError: ``events`` was asked to stop.
    """
    if not LEAST_VIEWS <= len(views) <= 255:
        raise InputError(
            f"{len(views)} photographs: {LEAST_VIEWS} to 255 can vote", "two lines of sight cross at wrong places too"
        )
    for view, edge in zip(views, edges, strict=True):
        if edge.shape != (view.height, view.width):
            raise InputError(f"{view.name}: edges of {edge.shape} in a photograph of {(view.height, view.width)}")
    events = events or Events()
    sums, starts = _summed(edges)
    rows = np.array([view.row for view in views])
    sizes = np.array([(view.width, view.height) for view in views], np.int64)
    # the logarithm of a pixel's chance to be none
    high = low + cell * np.array(shape[::-1], np.float64)
    shares = [_share(view, edge, low, high) for view, edge in zip(views, edges, strict=True)]
    rare = np.log1p(-np.clip(shares, 0.0, 1.0 - 1e-9))
    votes, seen = np.zeros((2, *shape), np.uint8)
    chance = np.ones(shape, np.float32)
    events.started(STAGE, f"a plane through {np.prod(shape)} cells", total=shape[0])
    for z in range(shape[0]):
        events.raise_if_cancelled()
        _sweep_plane(
            rows, sizes, rare, sums, starts, low + np.array([0.0, 0.0, z * cell]), cell, votes[z], seen[z], chance[z]
        )
        events.advanced(STAGE)
    is_feature = _told(votes, seen, chance)
    events.finished(STAGE, f"{np.count_nonzero(is_feature)} cells hold a feature")
    return FeatureOccupancy(np.asarray(low, np.float64), cell, votes, seen, is_feature)


def _share(view: View, edge: Edges, low: Array, high: Array) -> float:
    """Of the pixels about what a photograph shows of the box, those that are edges: where the object is there are more
    than elsewhere."""
    corners = np.where(np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)]) > 0, high, low)
    at = np.empty((8, 3))
    project_points(view.row, corners, at)
    if not (np.isfinite(at[:, :2]).all() and (at[:, 2] > 0.0).all()):
        return float((edge > 0).mean())
    (left, top), (right, bottom) = np.floor(at[:, :2].min(axis=0)), np.ceil(at[:, :2].max(axis=0))
    part = edge[max(int(top), 0) : max(int(bottom), 0), max(int(left), 0) : max(int(right), 0)]
    return float((part > 0).mean()) if part.size else 0.0


def _summed(edges: Sequence[Edges]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Summed areas (H + 1, W + 1) of all pictures, one after the other, and where each begins."""
    parts = []
    for edge in edges:
        total = np.zeros((edge.shape[0] + 1, edge.shape[1] + 1), np.int32)
        total[1:, 1:] = (edge > 0).cumsum(axis=0, dtype=np.int32).cumsum(axis=1, dtype=np.int32)
        parts.append(total.ravel())
    return np.concatenate(parts), np.cumsum([0, *(len(part) for part in parts[:-1])])


def _told(votes: NDArray[np.uint8], seen: NDArray[np.uint8], chance: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Cells whose votes chance would give to no more than MOST_BY_CHANCE of all that enough photographs show, and which
    none beside them has more of: edges reach into the footprints of neighbours."""
    judged = seen >= LEAST_VIEWS
    least = MOST_BY_CHANCE / max(int(judged.sum()), 1)
    return np.asarray(judged & (votes >= LEAST_VIEWS) & (chance <= least) & (votes == maximum_filter(votes, 3)))


@numba.njit(cache=True, nogil=True)
def _sweep_plane(
    rows: Array, sizes: NDArray[np.int64], rare: Array, sums: NDArray[np.int32], starts: NDArray[np.int64], low: Array,
    cell: float, votes: NDArray[np.uint8], seen: NDArray[np.uint8],
    chance: NDArray[np.float32],
) -> None:  # fmt: skip
    """Votes (Y, X) of one layer of cells, how many photographs show each, and how often chance gives as many votes."""
    tail = np.empty(rows.shape[0] + 1)
    for y in range(votes.shape[0]):
        for x in range(votes.shape[1]):
            tail[0] = 1.0
            count = shown = 0
            for v in range(rows.shape[0]):
                left, top, right, bottom = _footprint(rows[v], low[0] + x * cell, low[1] + y * cell, low[2], cell)
                if not (left >= 0.0 and top >= 0.0 and right < sizes[v, 0] and bottom < sizes[v, 1]):
                    continue
                a, b, c, d = np.int64(left), np.int64(top), np.int64(right) + 1, np.int64(bottom) + 1
                wide = sizes[v, 0] + 1
                at = starts[v]
                inside = (
                    sums[at + d * wide + c]
                    - sums[at + b * wide + c]
                    - sums[at + d * wide + a]
                    + sums[at + b * wide + a]
                )
                none = np.exp(rare[v] * (c - a) * (d - b))
                # so many votes by chance, with this photograph as well
                tail[shown + 1] = tail[shown] * (1.0 - none)
                for k in range(shown, 0, -1):
                    tail[k] = tail[k] * none + tail[k - 1] * (1.0 - none)
                tail[0] *= none
                shown += 1
                count += inside > 0
            votes[y, x], seen[y, x] = count, shown
            total = 0.0
            for k in range(count, shown + 1):
                total += tail[k]
            chance[y, x] = total


@numba.njit(cache=True, nogil=True)
def _footprint(
    row: Array, x: Index | float, y: Index | float, z: Index | float, cell: float
) -> tuple[float, float, float, float]:
    """Pixels (left, top, right, bottom) about the corners of a cell; NaN where one of them is not seen."""
    left = top = np.inf
    right = bottom = -np.inf
    for corner in range(8):
        u, v, depth = project_point(
            row, x + (corner & 1) * cell, y + (corner >> 1 & 1) * cell, z + (corner >> 2) * cell
        )  # fmt: skip
        if not (depth > 0.0 and u == u and v == v):
            return np.nan, np.nan, np.nan, np.nan
        left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    return left, top, right, bottom
