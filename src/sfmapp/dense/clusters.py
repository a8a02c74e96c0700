"""Many views in few bytes: clusters that are densified one after the other, and their patches put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.prepare import DensePlan
from sfmapp.dense.scene import Patches
from sfmapp.geometry import rigid3

# What densification holds at its peak, measured on 20 views of 0.5 and 2 MP, some or all of them in the core: 786 MB at
# 9.6 MP in the core, 643 at half of that with the rest as context, 521 without; with cells of 2 pixels 437.
BASE_MB = 260.0
BYTES_PER_CORE_CELL, BYTES_PER_CELL, BYTES_PER_PIXEL = 32.0, 14.0, 10.0
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
    per_pixel = BYTES_PER_PIXEL + BYTES_PER_CELL / cell_px**2
    expected = BASE_MB + 1e-6 * (BYTES_PER_CORE_CELL / cell_px**2 * core_pixels + per_pixel * all_pixels)
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
    cell of its reference image holds an earlier cluster's patch, trusted in that image, at the same depth, which then
    is trusted by the images of both.

    Args:
        plan: the views.
        cell_px: side of a cell, pixels.
        parts: patches of each cluster (:func:`in_core`), in the order of the clusters.
    """
    rotation, center = rigid3.rotation_matrix(plan.cam_from_world), rigid3.center(plan.cam_from_world)
    cells = _Cells(np.array([canvas.k for canvas in plan.canvases]), rotation, center, cell_px)
    kept, count = [], 0
    known: list[tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]] = []
    same_patch, same_view = [], []
    for part in parts:
        tolerance = SAME_DEPTH_PX * part.size.astype(np.float64)
        patch = np.full(len(part), -1, np.int64)
        if known:
            keys, depths, owners = (np.concatenate(column) for column in zip(*known, strict=True))
            patch = _same_place(keys, depths, owners, *cells.of(part.xyz, part.reference_idx), tolerance)
        is_fresh = patch < 0
        patch[is_fresh] = count + np.arange(is_fresh.sum())
        kept.append(part.subset(is_fresh))
        count += len(kept[-1])
        of_view = np.repeat(patch, part.num_views)
        known.append((*cells.of(np.repeat(part.xyz, part.num_views, axis=0), part.view_idx), of_view))
        is_double = np.repeat(~is_fresh, part.num_views)
        same_patch.append(of_view[is_double])
        same_view.append(part.view_idx[is_double])
    return _trusted_by(join(kept), np.concatenate(same_patch), np.concatenate(same_view))


def _trusted_by(patches: Patches, patch: NDArray[np.int64], view: NDArray[np.int32]) -> Patches:
    """Patches that are trusted by further views: pairs (M,) of a patch and a view, some of them known already."""
    of_view = np.concatenate([np.repeat(np.arange(len(patches)), patches.num_views), patch])
    views = np.concatenate([patches.view_idx, view])
    _, first = np.unique(np.stack([of_view, views], axis=1), axis=0, return_index=True)
    # the reference first, then the others in the order in which they came
    first = first[np.lexsort((first, of_view[first]))]
    counts = np.bincount(of_view[first], minlength=len(patches))
    ptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return replace(patches, view_ptr=ptr, view_idx=np.ascontiguousarray(views[first], np.int32))


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


def _same_place(
    keys: NDArray[np.int64], depths: NDArray[np.float64], patch: NDArray[np.int64],
    own_keys: NDArray[np.int64], own_depths: NDArray[np.float64], tolerance: NDArray[np.float64],
) -> NDArray[np.int64]:  # fmt: skip
    """(N,) the patch of the same cell whose depth is next to the own one, -1 where none is within the tolerance."""
    order = np.lexsort((depths, keys))
    keys, depths, patch = keys[order], depths[order], patch[order]
    first, last = np.searchsorted(keys, own_keys, "left"), np.searchsorted(keys, own_keys, "right")
    nearest, gap = np.full(len(own_keys), -1, np.int64), tolerance.copy()
    idx = np.flatnonzero(first < last)
    at = first[idx]
    while len(idx):
        distance = np.abs(depths[at] - own_depths[idx])
        nearer = distance <= gap[idx]
        nearest[idx[nearer]], gap[idx[nearer]] = patch[at[nearer]], distance[nearer]
        at = at + 1
        more = at < last[idx]
        idx, at = idx[more], at[more]
    return nearest
