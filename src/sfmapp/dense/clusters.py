"""Many views in few bytes: clusters that are densified one after the other, and their patches put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.prepare import DensePlan
from sfmapp.dense.scene import Patches
from sfmapp.geometry import rigid3

# what densification holds at its peak
BASE_MB = 300.0
CORE_BYTES_PER_PIXEL, CONTEXT_BYTES_PER_PIXEL = 70.0, 20.0
# two patches in one cell are one if their depths differ by less than this many pixels
SAME_DEPTH_PX = 3.0


@dataclass(frozen=True)
class Cluster:
    """Views that are densified together.

    Attributes:
        core: (C,) int64 positions of the views that get patches of their own, ascending; each view is in one core.
        views: (W,) int64 those and the neighbours that they are matched with, ascending.
        memory_mb: what it is expected to take.
    """

    core: NDArray[np.int64]
    views: NDArray[np.int64]
    memory_mb: float


def make_clusters(plan: DensePlan, cell_px: int, max_memory_mb: float) -> list[Cluster]:
    """Split the views, along the line on which their cameras spread most, until every part is expected to fit.

    A part of one view is not split any further, whatever it takes.
    """
    places = rigid3.center(plan.cam_from_world)
    done: list[Cluster] = []
    open_parts = [np.arange(len(plan.records))]
    while open_parts:
        core = open_parts.pop()
        cluster = _cluster(plan, core, cell_px)
        if cluster.memory_mb <= max_memory_mb or len(core) == 1:
            done.append(cluster)
            continue
        spread = places[core] - places[core].mean(axis=0)
        line = np.linalg.svd(spread, full_matrices=False)[2][0]
        line = line * np.sign(line[np.argmax(np.abs(line))])
        order = core[np.argsort(spread @ line, kind="stable")]
        half = len(order) // 2
        open_parts += [np.sort(order[half:]), np.sort(order[:half])]
    return done


def _cluster(plan: DensePlan, core: NDArray[np.int64], cell_px: int) -> Cluster:
    around = plan.neighbors[core].ravel()
    views = np.union1d(core, around[around >= 0]).astype(np.int64)
    core_pixels, all_pixels = int(plan.num_pixels[core].sum()), int(plan.num_pixels[views].sum())
    per_core = CORE_BYTES_PER_PIXEL / cell_px**2
    expected = BASE_MB + 1e-6 * (per_core * core_pixels + CONTEXT_BYTES_PER_PIXEL * all_pixels)
    return Cluster(core, views, expected)


def in_core(patches: Patches, cluster: Cluster) -> Patches:
    """The patches of a cluster whose reference image is in its core, their images counted as in the plan."""
    kept = np.isin(cluster.views[patches.reference_idx], cluster.core)
    mine = patches.subset(kept)
    return replace(mine, view_idx=cluster.views[mine.view_idx].astype(np.int32))


def join(parts: Sequence[Patches]) -> Patches:
    """All patches of several sets, in this order."""
    offsets = np.cumsum([0, *(len(part.view_idx) for part in parts)])
    ends = [part.view_ptr[1:] + offset for part, offset in zip(parts, offsets[:-1], strict=True)]
    fields = ("xyz", "normal", "rgb", "score", "sigma", "size", "wave")
    joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in fields}
    ptr = np.concatenate([np.zeros(1, np.int64), *ends])
    return Patches(**joined, view_ptr=ptr, view_idx=np.concatenate([part.view_idx for part in parts]))


def merge_clusters(plan: DensePlan, cell_px: int, parts: Sequence[Patches]) -> Patches:
    """Patches of clusters, without those that an earlier cluster has already.

    Within a cluster a patch fills the cells of all images that trust it. So it does here: a later patch goes if the
    cell of its reference image holds an earlier cluster's patch, trusted in that image, at the same depth.

    Args:
        plan: the views.
        cell_px: side of a cell, pixels.
        parts: patches of each cluster (:func:`in_core`), in the order of the clusters.
    """
    kept = [parts[0]]
    rotation, center = rigid3.rotation_matrix(plan.cam_from_world), rigid3.center(plan.cam_from_world)
    geometry = _Cells(np.array([canvas.k for canvas in plan.canvases]), rotation, center, cell_px)
    keys, depths = geometry.trusted(parts[0])
    for part in parts[1:]:
        own_keys, own_depths = geometry.of(part.xyz, part.reference_idx)
        tolerance = SAME_DEPTH_PX * part.size.astype(np.float64)
        fresh = part.subset(~_is_taken(keys, depths, own_keys, own_depths, tolerance))
        kept.append(fresh)
        more_keys, more_depths = geometry.trusted(fresh)
        keys, depths = np.concatenate([keys, more_keys]), np.concatenate([depths, more_depths])
    return join(kept)


@dataclass(frozen=True)
class _Cells:
    """Numbers of cells, unique over all views."""

    k: NDArray[np.float64]
    rotation: NDArray[np.float64]
    center: NDArray[np.float64]
    cell_px: int

    def of(self, xyz: NDArray[np.float64], view: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """(N,) cell and (N,) depth of places (N, 3), each in a view."""
        seen = np.einsum("nij,nj->ni", self.rotation[view], xyz - self.center[view])
        k = self.k[view]
        cell = np.floor((seen[:, :2] / seen[:, 2:] * k[:, :2] + k[:, 2:]) / self.cell_px).astype(np.int64)
        return (view.astype(np.int64) << 42) + (cell[:, 1] << 21) + cell[:, 0], seen[:, 2]

    def trusted(self, patches: Patches) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Cells and depths of patches in all images that trust them."""
        return self.of(np.repeat(patches.xyz, patches.num_views, axis=0), patches.view_idx)


def _is_taken(
    keys: NDArray[np.int64], depths: NDArray[np.float64], own_keys: NDArray[np.int64], own_depths: NDArray[np.float64],
    tolerance: NDArray[np.float64],
) -> NDArray[np.bool_]:  # fmt: skip
    """(N,) whether a cell holds a depth that is nearer to the own one than the tolerance."""
    order = np.lexsort((depths, keys))
    keys, depths = keys[order], depths[order]
    first, last = np.searchsorted(keys, own_keys, "left"), np.searchsorted(keys, own_keys, "right")
    taken = np.zeros(len(own_keys), bool)
    open_idx = np.flatnonzero(first < last)
    at = first[open_idx]
    while len(open_idx):
        taken[open_idx] |= np.abs(depths[at] - own_depths[open_idx]) <= tolerance[open_idx]
        at = at + 1
        more = ~taken[open_idx] & (at < last[open_idx])
        open_idx, at = open_idx[more], at[more]
    return taken
