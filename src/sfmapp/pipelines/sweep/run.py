"""A model and its photographs to a depth map of each, by sweeping planes; maps of several views confirm each other.

Photographs are read when their turn comes, and maps wait in files until their neighbours are there, so that memory does
not grow with the number of photographs, and a call that was stopped goes on from there.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.plane_sweep import NEIGHBORS, Planes, SweptDepth, SweptPlanes, measured, sweep_planes
from sfmapp.carve.sweep_agreement import confirm
from sfmapp.carve.sweep_exchange import exchange_planes
from sfmapp.dense.maps import depth_picture, write_cameras, write_picture
from sfmapp.dense.photographs import find_photographs
from sfmapp.dense.prepare import DensePlan, coarser_plan, load_scene, part_of, plan_views
from sfmapp.dense.report import ViewsReport
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.errors import NoReconstructionError
from sfmapp.events import Events
from sfmapp.formats.atomic import write_array
from sfmapp.formats.colmap import read_model
from sfmapp.pipelines.dense.source import DenseSource, find_source, model_digest
from sfmapp.pipelines.sweep.occupancy import write_occupancy
from sfmapp.pipelines.sweep.recording import write_recording
from sfmapp.report.stereo_pictures import SHOWN_PX
from sfmapp.report.sweep_document import SweepReport, SweptView
from sfmapp.report.sweep_html import MOST_SHOWN, SweptPicture, sweep_page
from sfmapp.reporting import NamedReason
from sfmapp.workspace.job import Job
from sfmapp.workspace.keys import input_key, stage_key
from sfmapp.workspace.layout import PAGE, REPORT, SWEEP
from sfmapp.workspace.options import Options
from sfmapp.workspace.usage import Stopwatch

STAGE = SWEEP
MAPS = "maps"
# where maps wait until others have confirmed them
_UNCONFIRMED = "unconfirmed"
# of a map before others were asked, and after, in the order of SweptDepth
_PLANES = ("plane", "slopes")
_ARRAYS = ("depth", "sigma", "half_width_95", "confidence")
Map = NDArray[np.float32]


@dataclass(frozen=True)
class SweepResult:
    """What was written.

    Attributes:
        output: the folder. report: what is in ``report.json``.
    """

    output: Path
    report: SweepReport


@dataclass(kw_only=True)
class _Job(Job):
    """A sweep under way.

    Attributes:
        plan: the views. swept: of each its planes without the arrays, None where it has none.
        left_out: photographs without a map, and why.
    """

    plan: DensePlan = field(init=False)
    swept: list[SweptPlanes | None] = field(default_factory=list)
    left_out: list[NamedReason] = field(default_factory=list)

    def waiting(self, view: int, what: str) -> Path:
        """File of a map that is not confirmed yet."""
        return self.workspace.folder / _UNCONFIRMED / f"{view}.{what}.npy"


def sweep(
    source: str | os.PathLike[str],
    output: str | os.PathLike[str],
    options: Options | None = None,
    *,
    images: str | os.PathLike[str] | None = None,
    occupancy: int | None = None,
    record: bool = True,
    events: Events | None = None,
    watch: Stopwatch | None = None,
) -> SweepResult:
    """Write a depth map of every photograph of a model, with sigma and confidence.

    ``OUTPUT/maps`` gets ``NAME.depth.npy``, ``NAME.sigma.npy``, ``NAME.half_width_95.npy`` (H, W) float32 in units of
    the world, NaN where nothing is known, ``NAME.confidence.npy``,
    a picture ``NAME.depth.png``, and ``views.json`` with the cameras of the maps.

    Args:
        source: a workspace, or the folder of a COLMAP model.
        output: a new folder, an empty one, or that of an earlier call.
        options: ``dense.level`` and ``dense.ground_sampling`` for the size of the maps, masks, and ``threads``.
        images: folder of the photographs; None: as noted in the workspace, or where COLMAP has them.
        occupancy: write a feature-occupancy volume with so many cells on its longest side, see
            :func:`sfmapp.pipelines.sweep.occupancy.write_occupancy`; None: none.
        record: write ``recording.rrd``, the points of one map after the other.
        events: progress, warnings and cancellation.
        watch: started when the run began.

    Raises:
        UsageError: an output that holds something else.
        InputError: no model, or too few of its photographs are there.
        NoReconstructionError: the photographs have no baseline, or no map has a depth.
        InterruptedRunError: ``events`` was asked to stop.
    """
    where = find_source(source, output, images, options or Options(), SWEEP)
    with _Job.opened(SWEEP, where.images, where.output, where.options, events=events, watch=watch) as job:
        with job.stage("views"):
            views = _plan(job, where)
        job.note_inputs({})
        key = _key(job, where)
        if not job.workspace.has_key(STAGE, key):
            shutil.rmtree(job.workspace.folder / _UNCONFIRMED, ignore_errors=True)
        with job.stage(STAGE, key):
            _sweep_all(job)
            _exchange_all(job)
        with job.stage("agreement"):
            maps = _confirm_all(job)
        shutil.rmtree(job.workspace.folder / _UNCONFIRMED, ignore_errors=True)
        write_cameras(job.workspace.folder / MAPS / "views.json", job.plan)
        volume = None
        if occupancy is not None:
            with job.stage("occupancy"):
                volume = write_occupancy(job.plan, occupancy, job.workspace.folder, job.events)
        report = SweepReport(
            run=job.facts(), views=views, maps=maps, occupancy=volume, left_out=job.left_out, usage=job.usage,
            warnings=job.log.warnings,
        )  # fmt: skip
        write_recording(job, job.plan, report, job.workspace.folder / MAPS, wanted=record)
        job.workspace.write_json(REPORT, report)
        job.workspace.write_text(PAGE, sweep_page(report, _pictures(job, maps)))
        job.workspace.save()
        if not any(each.confirmed > 0.0 for each in maps):
            raise NoReconstructionError(
                f"no photograph of {where.images} has a depth that others confirm",
                "check that the cameras are those of the photographs, and that neighbours show the same thing",
            )
        return SweepResult(job.workspace.folder, report)


def _pictures(job: _Job, maps: list[SweptView]) -> list[SweptPicture]:
    """Of some maps, evenly spread, what the page shows."""
    plan, folder = coarser_plan(job.plan, SHOWN_PX), job.workspace.folder / MAPS
    pictures = []
    for place in np.unique(np.linspace(0, len(maps) - 1, min(len(maps), MOST_SHOWN)).round().astype(int)):
        view = plan.names.index(maps[place].name)
        rgb = load_scene(part_of(plan, np.array([view])), threads=job.threads).views[0].rgb
        depth, sigma = (np.load(folder / f"{maps[place].name}.{what}.npy") for what in ("depth", "sigma"))
        pictures.append(SweptPicture(int(place), rgb, depth, sigma))
    return pictures


def _key(job: _Job, where: DenseSource) -> str:
    """Of what maps follow from: those that an earlier call left behind under it can be used."""
    inputs = [[record.name, record.turn, input_key(record)] for record in job.plan.records]
    return stage_key((__name__,), job.options.dense, model_digest(where.model), inputs)


def _plan(job: _Job, where: DenseSource) -> ViewsReport:
    model, _ = read_model(where.model, job.events)
    photographs = find_photographs(
        model, where.images, job.options.images, is_upright=where.is_upright, threads=job.threads, events=job.events
    )
    job.plan, views = plan_views(model, photographs, job.options.dense, job.events)
    return views


def _others(plan: DensePlan, view: int) -> list[int]:
    return [int(m) for m in plan.neighbors[view] if m >= 0][:NEIGHBORS]


def _sweep_all(job: _Job) -> None:
    """A map of every view, left to wait in files."""
    plan, events = job.plan, job.events
    (job.workspace.folder / _UNCONFIRMED).mkdir(exist_ok=True)
    events.started(STAGE, f"planes through {len(plan.records)} photographs", total=len(plan.records))
    with ThreadPoolExecutor(1) as pool:
        for view in range(len(plan.records)):
            events.raise_if_cancelled()
            try:
                job.swept.append(_earlier(job, view) or _sweep_one(job, view, pool if job.threads > 1 else None))
            except NoReconstructionError as failure:
                job.left_out.append(NamedReason(name=plan.names[view], reason=str(failure)))
                job.swept.append(None)
            finally:
                events.advanced(STAGE)
    events.finished(STAGE, f"{len(plan.records) - len(job.left_out)} maps")
    if job.left_out:
        events.warned(STAGE, f"{len(job.left_out)} photographs have no map: {job.left_out[0].reason}")


def _sweep_one(job: _Job, view: int, pool: ThreadPoolExecutor | None) -> SweptPlanes:
    """The planes of a view, left in files: arrays first, and what says that they are whole last."""
    scene, wanted = _around(job, view)
    found = sweep_planes(scene, int(np.searchsorted(wanted, view)), pool)
    # of slopes three digits are as many as planes a pixel away need
    write_array(job.waiting(view, _PLANES[0]), found.plane)
    write_array(job.waiting(view, _PLANES[1]), found.slopes.astype(np.float16))
    names = [int(wanted[m]) for m in found.neighbors]
    facts = {"first": found.planes.first, "step": found.planes.step, "count": found.planes.count, "neighbors": names}
    job.workspace.write_json(_facts(view), facts)
    return _without_arrays(found.planes, names)


def _around(job: _Job, view: int) -> tuple[DenseScene, NDArray[np.int64]]:
    """A view and those it is swept with, and their numbers, ascending."""
    wanted = np.unique([view, *_others(job.plan, view)])
    # what is read quietly is a part of this step
    return load_scene(part_of(job.plan, wanted), threads=job.threads), wanted


def _earlier(job: _Job, view: int) -> SweptPlanes | None:
    """The planes that an earlier call left when it was stopped; None if there are none."""
    facts = job.workspace.read_json(_facts(view))
    if facts is None or not all(job.waiting(view, what).is_file() for what in _PLANES):
        return None
    return _without_arrays(Planes(facts["first"], facts["step"], facts["count"]), facts["neighbors"])


def _facts(view: int) -> str:
    return f"{_UNCONFIRMED}/{view}.json"


def _without_arrays(planes: Planes, neighbors: Sequence[int]) -> SweptPlanes:
    nothing = np.empty((0, 0), np.float32)
    return SweptPlanes(planes, nothing, nothing, tuple(neighbors))


def _exchange_all(job: _Job) -> None:
    """Try in every map what its neighbours' tell, and leave what is measured of it to wait in files."""
    plan, events = job.plan, job.events
    events.started("exchange", "planes of neighbouring maps", total=len(plan.records))
    with ThreadPoolExecutor(1) as pool:
        for view, swept in enumerate(job.swept):
            events.raise_if_cancelled()
            if swept is not None and not all(job.waiting(view, what).is_file() for what in _ARRAYS):
                _exchange_one(job, view, pool if job.threads > 1 else None)
            events.advanced("exchange")
    events.finished("exchange", f"{sum(swept is not None for swept in job.swept)} maps")


def _exchange_one(job: _Job, view: int, pool: ThreadPoolExecutor | None) -> None:
    scene, wanted = _around(job, view)
    at = int(np.searchsorted(wanted, view))
    told = {place: planes for place, m in enumerate(wanted) if (planes := _planes_of(job, int(m), wanted)) is not None}
    found = measured(scene, at, exchange_planes(scene, at, told, pool))
    arrays = found.depth, found.sigma, found.half_width_95, found.confidence
    for what, values in zip(_ARRAYS, arrays, strict=True):
        write_array(job.waiting(view, what), values)


def _planes_of(job: _Job, view: int, wanted: NDArray[np.int64]) -> SweptPlanes | None:
    """The planes of a view, its neighbours counted among those that are loaded; None if it has none."""
    swept = job.swept[view]
    if swept is None:
        return None
    plane, slopes = (np.load(job.waiting(view, what)) for what in _PLANES)
    near = tuple(int(np.searchsorted(wanted, m)) for m in swept.neighbors if m in wanted)
    return SweptPlanes(swept.planes, plane, slopes.astype(np.float32), near)


def _confirm_all(job: _Job) -> list[SweptView]:
    """Write what others confirm of each map: one at least, and no fewer than contradict."""
    plan, events = job.plan, job.events
    rows = []
    events.started("agreement", "maps against each other", total=len(plan.records))
    for view, swept in enumerate(job.swept):
        events.raise_if_cancelled()
        events.advanced("agreement")
        if swept is None:
            continue
        own = _map(job, view, swept)
        sides = [m for m in plan.neighbors[view] if m >= 0 and job.swept[m] is not None]
        agree, against = confirm(_camera(plan, view), own, [_other(job, int(m)) for m in sides])
        kept = (agree > 0) & (agree >= against)
        depth, sigma, half_width = (
            np.where(kept, values, np.float32(np.nan)) for values in (own.depth, own.sigma, own.half_width_95)
        )
        base = job.workspace.folder / MAPS / plan.names[view]
        confidence = np.where(kept, own.confidence, np.float32(0.0))
        for what, values in zip(_ARRAYS, (depth, sigma, half_width, confidence), strict=True):
            write_array(base.with_name(f"{base.name}.{what}.npy"), values)
        write_picture(base.with_name(f"{base.name}.depth.png"), depth_picture(depth))
        farthest, nearest = swept.planes.depth(np.array([0, swept.planes.count - 1]))
        rows.append(SweptView(
            name=plan.names[view], neighbors=[plan.names[m] for m in swept.neighbors], num_planes=swept.planes.count,
            near=float(nearest), far=float(farthest),
            answered=float(np.isfinite(own.depth).mean()), confirmed=float(kept.mean()),
            median_sigma=float(np.median(sigma[kept] / depth[kept])) if kept.any() else None,
        ))  # fmt: skip
    events.finished("agreement", f"{len(rows)} maps written")
    return rows


def _map(job: _Job, view: int, swept: SweptPlanes) -> SweptDepth:
    depth, sigma, half_width, confidence = (np.load(job.waiting(view, what)) for what in _ARRAYS)
    return SweptDepth(depth, sigma, half_width, confidence, depth, swept.planes, swept.neighbors)


def _other(job: _Job, view: int) -> tuple[DenseView, SweptDepth]:
    swept = job.swept[view]
    assert swept is not None
    depth = np.load(job.waiting(view, "depth"))
    return _camera(job.plan, view), SweptDepth(depth, depth, depth, depth, depth, swept.planes, swept.neighbors)


def _camera(plan: DensePlan, view: int) -> DenseView:
    """The view without its pixels."""
    canvas = plan.canvases[view]
    return DenseView(plan.names[view], np.empty((0, 0, 3), np.uint8), None, canvas.k, plan.cam_from_world[view])
