"""Views with known cameras to patches: match, expand, filter, from coarse to fine (Furukawa and Ponce, PAMI 2010)."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.arrays import Limits, Store
from sfmapp.dense.growth import Growth, inverse_depth_range
from sfmapp.dense.options import DenseOptions
from sfmapp.dense.pyramid import Frame, frame_of, gray_pyramids, make_images
from sfmapp.dense.report import DensifyReport, LevelReport, SeedsReport, WaveReport
from sfmapp.dense.scene import DenseScene, DenseView, Patches
from sfmapp.dense.seeds import corners
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.reporting import Step

STAGE = "dense"
# the longer side of the coarsest level is at least half of this
COARSEST_PX = 256
# a corner for each block of so many pixels
BLOCK_PX = 6
TRUSTED, PROMISING, MAX_REFINED = 0.7, 0.4, 4


def densify(
    scene: DenseScene, options: DenseOptions, *, threads: int = 1, events: Events | None = None
) -> tuple[Patches, DensifyReport]:
    """Reconstruct oriented patches all over the surfaces that the views show.

    Args:
        scene: views, their neighbours and sparse points, which may be none.
        options: cells, views that have to agree.
        threads: workers; the result does not depend on their number.
        events: progress and cancellation.

    Returns:
        The patches, and the report.

    Raises:
        InterruptedRunError: ``events`` was asked to stop.
    """
    events = events or Events()
    longest = max(max(view.width, view.height) for view in scene.views)
    num_levels = 1
    while longest / 2**num_levels >= COARSEST_PX / 2:
        num_levels += 1
    events.started(STAGE, "patches", total=2 * len(scene.views) * sum(4**level for level in range(num_levels)))
    patches, report = _coarse_to_fine(scene, options, num_levels, threads, events)
    events.finished(STAGE, f"{len(patches)} patches", num_patches=len(patches))
    return patches, report


def _coarse_to_fine(
    scene: DenseScene, options: DenseOptions, num_levels: int, threads: int, events: Events
) -> tuple[Patches, DensifyReport]:
    frame = frame_of(scene)
    grays = gray_pyramids(scene.views, num_levels, threads)
    min_views = options.views_to_agree(len(scene.views))
    limits = Limits(min_views, min_views, TRUSTED, PROMISING, MAX_REFINED)
    points, depth_range = _sparse_points(scene, frame), _depth_ranges(scene, frame)
    rows: list[LevelReport] = []
    waves: list[WaveReport] = []
    growth: Growth | None = None
    for level in range(num_levels - 1, -1, -1):
        images = make_images(scene, grays[level], frame, options.cell_px)
        coarser, growth = growth, Growth(images, limits, threads, growth.wave if growth else 0)
        found = [corners(gray, BLOCK_PX, float(images.noise[m])) for m, gray in enumerate(grays[level])]
        steps = 4 ** (num_levels - 1 - level)
        rows.append(_grow(growth, coarser, level, points, found, depth_range, steps, events))
        waves += growth.waves
    assert growth is not None
    store, count = growth.store._asdict(), growth.count
    # the images and their cells take as much room as the patches, which are about to be there twice
    growth.close()
    del growth, coarser, images
    patches = _patches(scene, store, count, frame)
    return patches, _report(rows, waves, len(patches))


def _grow(
    growth: Growth,
    coarser: Growth | None,
    level: int,
    points: Store,
    found: list[NDArray[np.int32]],
    depth_range: NDArray[np.float64],
    steps: int,
    events: Events,
) -> LevelReport:
    """Work on one level, from the patches of the coarser one, sparse points and corners; what came of it.

    ``steps``: of progress that a view of this level is worth.
    """
    wall, cpu = time.monotonic(), time.process_time()
    carried = None
    if coarser is not None:
        carried = growth.refine_coarser(coarser, lambda: events.advanced(STAGE, steps))
        coarser.close()
    from_points = growth.seed_points(points)
    expanded = growth.expand(events, everywhere=True)
    if coarser is not None:
        depth_range = growth.depth_ranges(depth_range)
    from_corners = growth.seed_corners(found, depth_range, everywhere=coarser is None)
    expanded += growth.expand(events, everywhere=False)
    events.advanced(STAGE, steps * growth.num_views * (2 if coarser is None else 1))
    seen_by_few = growth.expand_where_few_see(events)
    accepted = growth.count
    filtered = growth.filter()
    growth.settle()
    return LevelReport(
        level=level, carried=carried, points=from_points, expanded=expanded, corners=from_corners,
        seen_by_few=seen_by_few, accepted=accepted, contradicted=filtered.contradicted,
        without_neighbours=filtered.without_neighbours, in_small_groups=filtered.in_small_groups, patches=growth.count,
        wall_s=round(time.monotonic() - wall, 3), cpu_s=round(time.process_time() - cpu, 3),
    )  # fmt: skip


def _report(rows: list[LevelReport], waves: list[WaveReport], num_patches: int) -> DensifyReport:
    last = rows[-1]
    steps = {
        "accepted": last.accepted,
        "contradicted": last.contradicted,
        "without neighbours": last.without_neighbours,
        "in small groups": last.in_small_groups,
        "patches": num_patches,
    }
    return DensifyReport(
        num_patches=num_patches,
        levels=rows,
        waves=waves,
        seeds=SeedsReport(carried=last.carried or 0, points=last.points, corners=last.corners),
        funnel=[Step(name=name, count=count) for name, count in steps.items()],
    )


def compile_kernels() -> None:
    """Compile, or load from the cache, what densification runs: on three views of a textured wall."""
    import cv2

    # smooth, so that not all of it is taken for noise
    spots = np.random.default_rng(0).integers(0, 255, (28, 40, 3)).astype(np.uint8)
    wall = np.asarray(cv2.resize(spots, (80, 56), interpolation=cv2.INTER_CUBIC), np.uint8)
    views = tuple(
        DenseView(
            str(m), wall[:, 8 * m : 8 * m + 64], None, np.array([64.0, 64.0, 32.0, 28.0]),
            np.array([0.0, 0.0, 0.0, 1.0, -0.125 * m, 0.0, 0.0]),
        )
        for m in range(3)
    )  # fmt: skip
    others = np.array([[1, 2], [0, 2], [1, 0]], np.int32)
    point = np.array([[0.125, 0.0, 1.0]])
    scene = DenseScene(views, others, point, np.array([0, 3]), np.arange(3, dtype=np.int32))
    _coarse_to_fine(scene, DenseOptions(), 2, 1, Events())


def _sparse_points(scene: DenseScene, frame: Frame) -> Store:
    """The sparse points as a store: the views that see each, the one that sees it most from the front first."""
    count = len(scene.point_xyz)
    num_neighbors = scene.neighbors.shape[1]
    points = Store.of_capacity(count, num_neighbors)
    points.views[:] = -1
    points.xyz[:] = (scene.point_xyz - frame.origin) * frame.scale
    centers = scene.centers
    for p in range(count):
        seen = scene.point_view_idx[scene.point_ptr[p] : scene.point_ptr[p + 1]]
        rays = centers[seen] - scene.point_xyz[p]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        order = np.argsort(-(rays @ rays.mean(axis=0)), kind="stable")
        kept = seen[order][: num_neighbors + 1]
        points.views[p, : len(kept)] = kept
        points.num_views[p] = len(kept)
    return points


def _depth_ranges(scene: DenseScene, frame: Frame) -> NDArray[np.float64]:
    """(V, 2) smallest and largest inverse depth to search, from the sparse points of each view; anything without."""
    ranges = np.tile([1e-6, 1e6], (len(scene.views), 1))
    pose = scene.cam_from_world
    rotation = rigid3.rotation_matrix(pose)
    point_idx = np.repeat(np.arange(len(scene.point_xyz)), np.diff(scene.point_ptr))
    for m in range(len(scene.views)):
        mine = point_idx[scene.point_view_idx == m]
        depth = (scene.point_xyz[mine] @ rotation[m, 2] + pose[m, 6]) * frame.scale
        ranges[m] = inverse_depth_range(depth, ranges[m])
    return ranges


def _patches(scene: DenseScene, store: dict[str, NDArray[Any]], n: int, frame: Frame) -> Patches:
    """The first n of a store, back in the world and with colours. Its large arrays are let go of in turn."""
    views, num_views = store.pop("views"), store.pop("num_views")
    reference = views[:n, 0].copy()
    view_ptr = np.zeros(n + 1, np.int64)
    np.cumsum(num_views[:n], out=view_ptr[1:])
    view_idx = views[:n][np.arange(views.shape[1]) < num_views[:n, None]].astype(np.int32)
    del views, num_views
    xyz = store.pop("xyz")[:n].astype(np.float64)
    xyz /= frame.scale
    xyz += frame.origin
    rgb = np.zeros((n, 3), np.uint8)
    for m, view in enumerate(scene.views):
        mine = np.flatnonzero(reference == m)
        x, y = view.project(xyz[mine])[0].astype(np.int64).clip(0, [view.width - 1, view.height - 1]).T
        rgb[mine] = view.rgb[y, x]
    unit = np.float32(frame.scale)
    return Patches(
        xyz, store.pop("normal")[:n].copy(), rgb, store.pop("score")[:n].copy(),
        np.asarray(store.pop("sigma")[:n] / unit, np.float32), np.asarray(store.pop("size")[:n] / unit, np.float32),
        store.pop("wave")[:n].copy(), view_ptr, view_idx,
    )  # fmt: skip
