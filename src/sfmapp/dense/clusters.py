"""Many views in few bytes: clusters that are densified one after the other, and their patches put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numba
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
    rotation = rigid3.rotation_matrix(plan.cam_from_world)
    indices = [_ByView.of(part, len(plan.records)) for part in parts]
    owners: list[NDArray[np.int64]] = []  # where each patch of a part, or the one that stands for it, is in the result
    fresh: list[NDArray[np.bool_]] = []
    count = 0
    for n, part in enumerate(parts):
        owner = np.full(len(part), -1, np.int64)
        for v in np.unique(part.reference_idx) if n else ():
            camera = _Camera(plan.canvases[v].k, rotation[v], plan.cam_from_world[v, 4:], cell_px)
            earlier = [indices[j].trusted_in(v) for j in range(n)]
            xyz = np.concatenate([parts[j].xyz[idx] for j, idx in enumerate(earlier)])
            owned = np.concatenate([owners[j][idx] for j, idx in enumerate(earlier)])
            mine = np.flatnonzero(part.reference_idx == v)
            tolerance = SAME_DEPTH_PX * part.size[mine].astype(np.float64)
            owner[mine] = _same_place(*camera.cells(xyz), owned, *camera.cells(part.xyz[mine]), tolerance)
        fresh.append(owner < 0)
        owner[fresh[-1]] = count + np.arange(fresh[-1].sum())
        count += int(fresh[-1].sum())
        owners.append(owner)
    fields = ("xyz", "normal", "rgb", "score", "sigma", "size", "wave")
    values = {
        name: np.concatenate([getattr(part, name)[kept] for part, kept in zip(parts, fresh, strict=True)])
        for name in fields
    }
    ptr, view_idx = _all_views(parts, owners, fresh)
    return Patches(**values, view_ptr=ptr, view_idx=view_idx)


def _all_views(
    parts: Sequence[Patches], owners: Sequence[NDArray[np.int64]], fresh: Sequence[NDArray[np.bool_]]
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Lists of the views that trust each patch of the result: its own, then those of patches that it stands for."""
    pairs = list(zip(parts, fresh, strict=True))
    counts = np.concatenate([part.num_views[kept] for part, kept in pairs]).astype(np.int64)
    views = np.concatenate([part.view_idx[np.repeat(kept, part.num_views)] for part, kept in pairs])
    ptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    found = [np.zeros(0, np.int64)]
    for part, owner, kept in zip(parts, owners, fresh, strict=True):
        of_patch = np.repeat(owner, part.num_views)
        is_new = np.zeros(len(of_patch), np.bool_)
        _find_new_views(ptr, views, np.repeat(~kept, part.num_views), of_patch, part.view_idx, is_new)
        # sorted by patch, then by view; a view for each number below 2^20
        found.append(np.unique((of_patch[is_new] << 20) + part.view_idx[is_new]))
    extra = np.unique(np.concatenate(found))
    patch = extra >> 20
    views = np.insert(views, ptr[patch + 1], (extra & (1 << 20) - 1).astype(np.int32))
    ptr[1:] += np.cumsum(np.bincount(patch, minlength=len(counts)))
    return ptr, views


@numba.njit(cache=True, nogil=True)
def _find_new_views(
    ptr: NDArray[np.int64], views: NDArray[np.int32], asked: NDArray[np.bool_], patch: NDArray[np.int64],
    view: NDArray[np.int32], is_new: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Where it is asked whether a view is not yet among those of a patch, say so."""
    for n in range(patch.shape[0]):
        if asked[n]:
            is_new[n] = True
            for at in range(ptr[patch[n]], ptr[patch[n] + 1]):
                if views[at] == view[n]:
                    is_new[n] = False
                    break


@dataclass(frozen=True)
class _ByView:
    """The patches that each view trusts, of one cluster: those of view v are ``patch[start[v]:start[v + 1]]``."""

    patch: NDArray[np.int32]
    start: NDArray[np.int64]

    @staticmethod
    def of(patches: Patches, num_views: int) -> _ByView:
        order = np.argsort(patches.view_idx, kind="stable")
        patch = np.repeat(np.arange(len(patches), dtype=np.int32), patches.num_views)[order]
        counts = np.bincount(patches.view_idx, minlength=num_views)
        return _ByView(patch, np.concatenate([[0], np.cumsum(counts)]).astype(np.int64))

    def trusted_in(self, v: int) -> NDArray[np.int32]:
        return self.patch[self.start[v] : self.start[v + 1]]


@dataclass(frozen=True)
class _Camera:
    """A view and its cells."""

    k: NDArray[np.float64]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    cell_px: int

    def cells(self, xyz: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """(N,) number of the cell and (N,) depth of places (N, 3)."""
        seen = xyz @ self.rotation.T + self.translation
        cell = np.floor((seen[:, :2] / seen[:, 2:] * self.k[:2] + self.k[2:]) / self.cell_px).astype(np.int64)
        return (cell[:, 1] << 32) + cell[:, 0], seen[:, 2]


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
