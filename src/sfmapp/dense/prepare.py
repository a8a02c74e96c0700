"""From a model and its photographs to views: what to work on and how finely, then the pixels of some or all of it."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.options import FEWEST_VIEWS, DenseOptions
from sfmapp.dense.photographs import STAGE, Photographs
from sfmapp.dense.report import ViewReport, ViewsReport
from sfmapp.dense.scene import DenseScene, DenseView, Region
from sfmapp.dense.selection import MIN_SHARED, meeting_point, select_neighbors
from sfmapp.dense.undistort import Canvas, lay_out, make_canvas
from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.images.image_set import ImageRecord
from sfmapp.images.pixels import read_on_white
from sfmapp.reporting import NamedReason
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.undistortion import warn_of_sides

# without a level: the largest longer side
LONGER_SIDE_PX = 1600
# views whose centres differ by less than this share of the distance to what they look at have no baseline
LEAST_BASELINE = 0.005


@dataclass(frozen=True)
class DensePlan:
    """Everything about a scene but its pixels.

    Attributes:
        records, canvases: of the views (V).
        cam_from_world: (V, 7).
        neighbors: (V, K) int32, as in :class:`DenseScene`.
        point_xyz, point_ptr, point_view_idx: sparse points, as there.
        region: as there.
    """

    records: tuple[ImageRecord, ...]
    canvases: tuple[Canvas, ...]
    cam_from_world: NDArray[np.float64]
    neighbors: NDArray[np.int32]
    point_xyz: NDArray[np.float64]
    point_ptr: NDArray[np.int64]
    point_view_idx: NDArray[np.int32]
    region: Region | None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(record.name for record in self.records)

    @property
    def num_pixels(self) -> NDArray[np.int64]:
        """(V,) at working resolution."""
        return np.array([math.prod(canvas.working_size) for canvas in self.canvases], np.int64)


def plan_views(
    model: Reconstruction, photographs: Photographs, options: DenseOptions, events: Events | None = None
) -> tuple[DensePlan, ViewsReport]:
    """Decide on the resolution of every view and on its neighbours.

    Returns:
        The plan, and the report.

    Raises:
        InputError: fewer images than have to agree on a patch.
        NoReconstructionError: no baseline between them.
    """
    events = events or Events()
    _check_count(model, photographs, options)
    warn_of_sides(photographs.cameras, STAGE, "sfmapp undistort, then dense on its folder", events)
    poses = model.cam_from_world[photographs.image_idx]
    xyz, ptr, view_idx = points_of_views(model, photographs.image_idx)
    depth = _median_depths(poses, xyz, ptr, view_idx)
    _check_baseline(poses, depth, photographs)
    canvases = tuple(
        make_canvas(camera, working_shrink(options, camera.width, camera.height, camera.focal, float(z)))
        for camera, z in zip(photographs.cameras, depth, strict=True)
    )
    focal = np.array([canvas.k[:2].mean() for canvas in canvases])
    neighbors, chosen = select_neighbors(focal, poses, xyz, ptr, view_idx, options.max_neighbors)
    names = [record.name for record in photographs.records]
    alone = [name for name, row in zip(names, neighbors, strict=True) if row[0] < 0]
    if len(alone) > len(names) - options.views_to_agree(len(names)):
        raise NoReconstructionError(
            f"hardly any of the {len(names)} images has a neighbour that shows the same thing from another place",
            "views need a baseline between them, 1 to 60 degrees as seen from what they show",
        )
    if len(names) == FEWEST_VIEWS and options.min_views is None:
        events.decided(STAGE, "two images: both have to agree on every patch, and no third can contradict them")
    if alone:
        events.warned(STAGE, f"{len(alone)} images have no neighbour to match with, {alone[0]} for one", names=alone)
    region = None if options.region is None else Region(np.array(options.region[:3]), np.array(options.region[3:]))
    plan = DensePlan(photographs.records, canvases, poses, neighbors, xyz, ptr, view_idx, region)
    shrink = np.array([canvas.shrink for canvas in canvases])
    report = ViewsReport(
        num_views=len(names),
        num_points=len(xyz),
        shrink=[float(shrink.min()), float(np.median(shrink)), float(shrink.max())],
        neighbors=chosen,
        views=[_view_report(plan, m) for m in range(len(names))],
        missing=[NamedReason(name=name, reason=reason) for name, reason in photographs.missing],
        copies=list(photographs.copies),
    )
    width, height = canvases[0].working_size
    events.decided(
        STAGE, f"{len(names)} views, the first of {width}x{height} pixels, {len(xyz)} sparse points", **chosen
    )
    return plan, report


def coarser_plan(plan: DensePlan, longer_side_px: int) -> DensePlan:
    """The same plan with no view larger than that, for those who only want to look at it."""
    canvases = tuple(
        replace(canvas, shrink=max(canvas.shrink, max(canvas.width, canvas.height) / longer_side_px))
        for canvas in plan.canvases
    )
    return replace(plan, canvases=canvases)


def part_of(
    plan: DensePlan, view_idx: NDArray[np.integer], core: NDArray[np.integer] | None = None
) -> DensePlan:  # fmt: skip
    """Some views of a plan as a plan of their own, and the sparse points that two of them see.

    Args:
        plan: of all views.
        view_idx: (W,) positions of the views wanted, ascending.
        core: those of them that get neighbours, others only serve as such; None: all.
    """
    wanted = np.asarray(view_idx)
    position = np.full(len(plan.records) + 1, -1, np.int32)  # the last for "none"
    position[wanted] = np.arange(len(wanted))
    neighbors = _compact(position[plan.neighbors[wanted]])
    if core is not None:
        neighbors[~np.isin(wanted, core)] = -1
    ptr, seen = _seen_by(plan.point_ptr, position[plan.point_view_idx])
    kept = np.diff(ptr) >= 2
    ptr, seen = _only(ptr, seen, kept)
    return DensePlan(
        tuple(plan.records[m] for m in wanted), tuple(plan.canvases[m] for m in wanted), plan.cam_from_world[wanted],
        neighbors, plan.point_xyz[kept], ptr, seen, plan.region,
    )  # fmt: skip


def load_scene(plan: DensePlan, *, threads: int = 1, events: Events | None = None) -> DenseScene:
    """Read, undistort and shrink the photographs of a plan.

    Args:
        plan: what to read; see :func:`part_of` for some of it.
        threads: photographs that are worked on at a time.
        events: progress and cancellation.

    Raises:
        InputError: a photograph cannot be read any more.
        InterruptedRunError: ``events`` was asked to stop.
    """
    events = events or Events()
    events.started(STAGE, f"undistorting {len(plan.records)} photographs", total=len(plan.records))

    def load(m: int) -> DenseView:
        events.raise_if_cancelled()
        rgb, mask = lay_out(plan.canvases[m], *read_on_white(plan.records[m]))
        events.advanced(STAGE)
        record = plan.records[m]
        return DenseView(record.name, rgb, mask, plan.canvases[m].k, plan.cam_from_world[m], record.orientation)

    with ThreadPoolExecutor(threads) as pool:
        views = tuple(pool.map(load, range(len(plan.records))))
    events.finished(STAGE, f"{len(views)} views")
    return DenseScene(views, plan.neighbors, plan.point_xyz, plan.point_ptr, plan.point_view_idx, plan.region)


def _compact(rows: NDArray[np.int32]) -> NDArray[np.int32]:
    """Rows with what is not -1 in front, in its order."""
    order = np.argsort(rows < 0, axis=1, kind="stable")
    return np.take_along_axis(rows, order, axis=1)


def _seen_by(ptr: NDArray[np.int64], view_idx: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """The same lists without the views that are -1."""
    before = np.concatenate([[0], np.cumsum(view_idx >= 0)])
    return before[ptr].astype(np.int64), view_idx[view_idx >= 0]


def _only(
    ptr: NDArray[np.int64], view_idx: NDArray[np.int32], kept: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """The lists of the points that are kept."""
    counts = np.diff(ptr)
    return np.concatenate([[0], np.cumsum(counts[kept])]).astype(np.int64), view_idx[np.repeat(kept, counts)]


def points_of_views(
    model: Reconstruction, image_idx: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int32]]:
    """Points seen by two or more of the views, with the views in ascending order, each once.

    What a wide lens sees behind it is not on the plane that its photograph is laid out on.
    """
    view = np.full(len(model.image_names), -1, np.int32)
    view[image_idx] = np.arange(len(image_idx))
    tracks = model.tracks
    seen = view[tracks.obs_image_idx]
    used = model.obs_is_inlier & (seen >= 0) & model.is_triangulated[tracks.obs_track_idx]
    is_wide = np.array([camera.is_wide for camera in model.cameras], bool)[model.image_camera_idx]
    of_wide = np.flatnonzero(used & is_wide[tracks.obs_image_idx])
    poses, xyz = model.cam_from_world[tracks.obs_image_idx[of_wide]], model.point_xyz[tracks.obs_track_idx[of_wide]]
    used[of_wide] = rigid3.apply(poses, xyz)[:, 2] > 0.0
    pairs = np.unique(np.stack([tracks.obs_track_idx[used], seen[used]], axis=1), axis=0)
    count = np.bincount(pairs[:, 0], minlength=tracks.num_tracks)
    ptr = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    kept = count >= 2
    ptr, idx = _only(ptr, pairs[:, 1].astype(np.int32), kept)
    return model.point_xyz[kept], ptr, idx


def _median_depths(
    poses: NDArray[np.float64], xyz: NDArray[np.float64], ptr: NDArray[np.int64], view_idx: NDArray[np.int32]
) -> NDArray[np.float64]:
    """(V,) median depth of the points of each view; of the place where the axes meet for a view with too few."""
    rotation, center = rigid3.rotation_matrix(poses), rigid3.center(poses)
    point_idx = np.repeat(np.arange(len(xyz)), np.diff(ptr))
    target = meeting_point(center, rotation[:, 2])
    depth: NDArray[np.float64] = np.abs(((target - center) * rotation[:, 2]).sum(axis=1))
    for m in range(len(poses)):
        z = (xyz[point_idx[view_idx == m]] - center[m]) @ rotation[m, 2]
        if (z > 0.0).sum() >= MIN_SHARED:
            depth[m] = np.median(z[z > 0.0])
    return depth


def working_shrink(options: DenseOptions, width: int, height: int, focal: float, depth: float) -> float:
    """Pixels at full resolution for one at working resolution, a side; focal length in pixels, depth in units of the
    world."""
    if options.ground_sampling is not None:
        # a smaller image than of this many pixels shows nothing
        return float(np.clip(options.ground_sampling * focal / depth, 1.0, max(min(width, height) / 32.0, 1.0)))
    level = options.level
    if level is None:
        level = max(math.ceil(math.log2(max(width, height) / LONGER_SIDE_PX)), 0)
    return float(2**level)


def _check_count(model: Reconstruction, photographs: Photographs, options: DenseOptions) -> None:
    found, copies = len(photographs.records), len(photographs.copies)
    asked = options.views_to_agree(found)
    if found >= asked:
        return
    text = f"{found} usable images with a pose, {asked} have to agree on every patch"
    if found + copies >= asked:
        raise NoReconstructionError(
            f"{text}: {copies} others are copies in the same place ({photographs.copies[0]}, ...)",
            "give photographs of the same thing from different places",
        )
    in_model = int(model.is_registered.sum())
    if found >= FEWEST_VIEWS:
        advice = f"leave dense.min_views={asked} out, and {found} are enough, or give more photographs"
    else:
        advice = "give at least two photographs from different places; from three on they correct each other"
    raise InputError(f"{text}; the model has {in_model}", advice)


def _check_baseline(poses: NDArray[np.float64], depth: NDArray[np.float64], photographs: Photographs) -> None:
    extent = float(np.linalg.norm(np.ptp(rigid3.center(poses), axis=0)))
    if extent < LEAST_BASELINE * float(np.median(depth)) or extent == 0.0:
        raise NoReconstructionError(
            f"the {len(photographs.records)} images were all taken in one place: no baseline, no depth",
            "give photographs of the same thing from different places",
        )


def _view_report(plan: DensePlan, m: int) -> ViewReport:
    width, height = plan.canvases[m].working_size
    names = [plan.records[s].name for s in plan.neighbors[m] if s >= 0]
    return ViewReport(name=plan.records[m].name, width=width, height=height, neighbors=names)
