"""The recording of swept maps, from the files that were written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sfmapp.carve.feature_occupancy import FeatureOccupancy
from sfmapp.dense.prepare import DensePlan, coarser_plan, load_scene, part_of
from sfmapp.pipelines.sweep.occupancy import FILES
from sfmapp.report.sweep_document import SweepReport, SweptView
from sfmapp.viewer.sweep_recording import ShownMap, record_sweep
from sfmapp.workspace.job import FAILED, NOT_WANTED, WRITTEN, Job

# the longer side of maps on the screen: smaller where there are many, as all photographs together are
_SIDE_PX, _BUDGET = (200, 640), 60


def write_recording(job: Job, plan: DensePlan, report: SweepReport, folder: Path, *, wanted: bool) -> None:
    """Write ``recording.rrd``; what goes wrong there is told.

    Args:
        plan: of all photographs. report: of this run. folder: of the maps. wanted: False: note that it was not.
    """
    if not wanted or not report.maps:
        job.workspace.note(recording=NOT_WANTED)
        return
    with job.measured("recording"):
        side = int(np.clip(_SIDE_PX[1] * np.sqrt(_BUDGET / len(report.maps)), *_SIDE_PX))
        small = coarser_plan(plan, side)
        volume = None if report.occupancy is None else _volume(job.workspace.folder / FILES[0])
        shown = [_shown(small, each, folder) for each in report.maps]
        recorded = record_sweep(
            job.workspace.recording, f"Depth of {len(shown)} photographs", _story(report), shown, volume
        )
    job.workspace.note(recording=FAILED if recorded.problem else WRITTEN)
    if recorded.problem:
        job.events.warned("recording", f"no recording: {recorded.problem}")


def _shown(small: DensePlan, told: SweptView, folder: Path) -> ShownMap:
    """A map at the pixels of the smaller photograph that are nearest."""
    view = load_scene(part_of(small, np.array([small.names.index(told.name)]))).views[0]
    depth, sigma = (np.load(folder / f"{told.name}.{what}.npy") for what in ("depth", "sigma"))
    rows, columns = (
        ((np.arange(count) + 0.5) * full / count).astype(int)
        for count, full in zip((view.height, view.width), depth.shape, strict=True)
    )
    at = np.ix_(rows, columns)
    return ShownMap(told.name, _text(told), view.rgb, depth[at], sigma[at], view.k, view.cam_from_world)


def _volume(path: Path) -> FeatureOccupancy:
    with np.load(path, allow_pickle=False) as arrays:
        return FeatureOccupancy(
            arrays["low"], float(arrays["cell"]), arrays["votes"], arrays["seen"], arrays["is_feature"]
        )


def _text(told: SweptView) -> str:
    sigma = "" if told.median_sigma is None else f"; sigma {told.median_sigma:.2%} of the depth in the median"
    return (
        f"**{told.name}**: {told.confirmed:.0%} of the pixels confirmed by others ({told.answered:.0%} answered)"
        f"{sigma}\n\n{told.num_planes} planes from {told.near:.3g} to {told.far:.3g}, with {len(told.neighbors)} "
        "photographs"
    )


def _story(report: SweepReport) -> str:
    confirmed: Sequence[float] = [each.confirmed for each in report.maps]
    lines = [
        f"**{len(report.maps)} depth maps**; others confirm {np.median(confirmed):.0%} of the pixels in the median.",
        "Tabs above the scene choose what is drawn; the timeline *map* adds one photograph after the other.",
    ]
    if report.occupancy is not None:
        told, cells = report.occupancy, " x ".join(str(count) for count in report.occupancy.cells)
        lines.append(
            f"Occupancy: {told.num_features:,} of {cells} cells hold a feature, the brighter the larger the share of "
            "the photographs that show an edge there."
            if told.num_features
            else f"Occupancy: no cell of {cells} holds a feature that chance does not explain."
        )
    return "\n\n".join(lines)
