"""How much of each photograph patches cover, and why the rest is bare."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.scene import DenseScene, DenseView, Patches
from sfmapp.geometry import rigid3
from sfmapp.report.model import CoverageReport

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# grey values of a block that vary less, as a standard deviation, are plain to the eye and to correlation
PLAIN = 3.0
REASONS = {
    "out_of_sight": "other photographs do not show it",
    "plain": "plain: nothing there to match",
    "unmatched": "seen but not matched: hidden, glossy or moving, or at too flat an angle",
}
# photographs below are listed with what is missing
GOOD_SHARE = 0.8


def coverage(scene: DenseScene, patches: Patches, *, block_px: int = 4, min_views: int = 3) -> list[CoverageReport]:
    """What share of each photograph's blocks holds a patch that trusts it, and what became of the others.

    Args:
        scene: the views; what their masks leave out does not count.
        patches: of them.
        block_px: side of the square blocks, in pixels of the views: several cells, so that a gap is no accident.
        min_views: photographs that have to show a place.

    Returns:
        A row for each view; its shares ``coverage``, ``out_of_sight``, ``plain`` and ``unmatched`` add up to one.
    """
    trusting = np.repeat(np.arange(len(patches)), patches.num_views)
    trusting = trusting[np.argsort(patches.view_idx, kind="stable")]
    limits = np.concatenate([[0], np.cumsum(np.bincount(patches.view_idx, minlength=len(scene.views)))])
    rows = []
    for v, view in enumerate(scene.views):
        mine = trusting[limits[v] : limits[v + 1]]
        wanted, covered, depth = _blocks(view, patches.xyz[mine], block_px)
        is_plain = _deviation(view, block_px) < PLAIN
        seen_by = 1 + _num_seeing(scene, v, depth, block_px)
        out_of_sight = wanted & ~covered & (seen_by < min_views)
        plain = wanted & ~covered & ~out_of_sight & is_plain
        count = max(1, int(wanted.sum()))
        shares = {
            "coverage": float((wanted & covered).sum() / count),
            "out_of_sight": float(out_of_sight.sum() / count),
            "plain": float(plain.sum() / count),
            "unmatched": float((wanted & ~covered & ~out_of_sight & ~plain).sum() / count),
        }
        rows.append(
            CoverageReport(
                name=view.name,
                num_neighbors=int((scene.neighbors[v] >= 0).sum()),
                num_patches=int((patches.reference_idx == v).sum()),
                num_trusting=len(mine),
                **shares,
                reason=_reason(shares),
            )
        )
    return rows


def _reason(shares: dict[str, float]) -> str:
    if shares["coverage"] >= GOOD_SHARE:
        return ""
    return REASONS[max(REASONS, key=lambda name: shares[name])]


def _blocks(view: DenseView, xyz: Array, block_px: int) -> tuple[Bools, Bools, Array]:
    """Of each block (R, C): whether it counts, whether it is covered, and its depth or that of the nearest covered."""
    import cv2

    shape = (-(-view.height // block_px), -(-view.width // block_px))
    wanted = np.ones(shape, np.bool_) if view.mask is None else _block_means(view.mask, block_px) > 0.5
    pixel, z = view.project(xyz)
    inside = view.shows(pixel)
    column, row = (pixel[inside] / block_px).astype(np.int64).T
    depth = np.full(shape, np.nan)
    depth[row, column] = z[inside]
    covered = np.isfinite(depth)
    if not covered.any():
        return wanted, covered, depth
    # labels number the covered blocks, which are the zeros of the image
    free = (~covered).astype(np.uint8)
    label = cv2.distanceTransformWithLabels(free, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[1]
    of_label = np.zeros(label.max() + 1)
    of_label[label[covered]] = depth[covered]
    return wanted, covered, of_label[label]


def _num_seeing(scene: DenseScene, v: int, depth: Array, block_px: int) -> NDArray[np.int64]:
    """(R, C) neighbours of view v whose pictures the middle of each block falls into, at the depth (R, C) it has."""
    count = np.zeros(depth.shape, np.int64)
    if np.isnan(depth).any():
        return count
    fx, fy, cx, cy = scene.views[v].k
    y, x = (np.indices(depth.shape) + 0.5) * block_px
    place = np.stack([(x - cx) / fx * depth, (y - cy) / fy * depth, depth], axis=-1)
    world = rigid3.apply(rigid3.inverse(scene.views[v].cam_from_world), place.reshape(-1, 3))
    for m in scene.neighbors[v][scene.neighbors[v] >= 0]:
        other = scene.views[m]
        count += other.shows(other.project(world)[0]).reshape(depth.shape)
    return count


def _deviation(view: DenseView, block_px: int) -> Array:
    """(R, C) standard deviation of the grey values in and right around each block."""
    import cv2

    grey = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY).astype(np.float64)
    side = (2 * block_px + 1,) * 2
    mean, square = cv2.blur(grey, side), cv2.blur(grey * grey, side)
    return np.sqrt(np.maximum(_block_means(square - mean * mean, block_px), 0.0))


def _block_means(values: NDArray[Any], block_px: int) -> Array:
    """(R, C) means of an image (H, W) over blocks; those at the right and lower edges may be smaller."""
    rows, columns = (np.arange(0, side, block_px) for side in values.shape)
    total = np.add.reduceat(np.add.reduceat(values.astype(np.float64), rows, axis=0), columns, axis=1)
    sizes = [np.diff(np.append(edge, side)) for edge, side in zip((rows, columns), values.shape, strict=True)]
    return np.asarray(total / np.outer(*sizes))
