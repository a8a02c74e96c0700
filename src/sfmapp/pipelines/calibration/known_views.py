"""Several photographs of points with known places: the one camera that took them, and where it stood each time."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfmapp.calibration.adjustment import TargetView
from sfmapp.calibration.locate import Location
from sfmapp.calibration.point_reports import (
    POSES,
    FitReport,
    TargetsReport,
    location_report,
    targets_report,
    write_pose,
)
from sfmapp.calibration.result import CameraCalibration
from sfmapp.calibration.targets import calibrate_targets, located_views
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError, UsageError
from sfmapp.events import Events
from sfmapp.formats.known_points import photographs_of
from sfmapp.images.image_set import ImageRecord
from sfmapp.images.pixels import read_rgb
from sfmapp.images.sources import find_images
from sfmapp.pipelines.calibration.known_points import (
    PhotographPoints,
    PointSource,
    check_sigma,
    describe_photograph,
    plane_outline,
    read_points,
)
from sfmapp.pipelines.calibration.results import write_camera, write_recording
from sfmapp.report.point_html import draw_residuals, render_targets_html
from sfmapp.workspace.job import Job
from sfmapp.workspace.layout import CALIBRATE, PAGE, REPORT
from sfmapp.workspace.usage import Stopwatch

# Photographs that the page shows: each takes a fifth of a megabyte.
_MAX_PICTURES = 12


@dataclass(frozen=True)
class TargetsResult:
    """What several photographs have told: the camera, and where it stood in each (None: left aside)."""

    output: Path
    report: TargetsReport
    calibration: CameraCalibration
    locations: tuple[Location | None, ...]


def photographs_in(given: Sequence[Path], tables: Sequence[Path]) -> list[Path]:
    """Photographs as they were given; those of a folder that a table names in its column ``image``, or all in it.

    Raises:
        InputError: a folder without photographs, or without one that the table names.
    """
    if len(given) != 1 or not given[0].is_dir():
        return list(given)
    found = find_images(str(given[0]), None).paths
    named = photographs_of(tables[0]) if len(tables) == 1 else ()
    if named:
        by_name = {path.name: path for path in found} | {path.stem: path for path in found}
        if missing := [name for name in named if name not in by_name]:
            raise InputError(f"{given[0]}: expected the photographs of {tables[0]}, found no {missing[0]}")
        return [by_name[name] for name in named]
    if not found:
        raise InputError(f"{given[0]}: expected photographs, found none")
    return list(found)


def calibrate_from_targets(
    photographs: Sequence[str | os.PathLike[str]], output: str | os.PathLike[str], sources: Sequence[PointSource], *,
    camera_model: CameraModel | None = None, sigma_px: float | None = None, recording: bool = True,
    events: Events | None = None, watch: Stopwatch | None = None,
) -> TargetsResult:  # fmt: skip
    """Calibrate the camera that took several photographs; write ``calibration.json``, ``poses/NAME.json``, files for
    other programs and a report.

    Args:
        photographs: files, of one size. output: a new folder, an empty one, or that of an earlier call.
        sources: of the points of each, or one for all: a table with a column ``image``, or places of markers.
        camera_model, sigma_px: as in :func:`sfmapp.calibration.targets.calibrate_targets`.
        recording: write ``recording.rrd``.

    Raises:
        UsageError: another number of sources, or an output that holds something else.
        InputError: a photograph or points that cannot be read, photographs of several sizes, or points that tell no
            camera.
        NoReconstructionError: no photograph tells a focal length.
    """
    check_sigma(sigma_px)
    if len(sources) not in (1, len(photographs)):
        raise UsageError(
            f"expected one table for all {len(photographs)} photographs or one for each, found {len(sources)}"
        )
    if len(sources) == 1 and sources[0].points is not None and not photographs_of(sources[0].points):
        raise UsageError(
            f"{sources[0].points}: expected a column image, which says whose points these are",
            "or a table for each photograph, in their order: --points a.csv b.csv",
        )
    records = [describe_photograph(photograph) for photograph in photographs]
    size = _common_size(records)
    with Job.opened(CALIBRATE, photographs[0], output, None, events=events, watch=watch) as job:
        job.note_inputs({record.name: record.digest for record in records})
        own = list(sources) * (len(records) if len(sources) == 1 else 1)
        points = [read_points(record, source, job.events) for record, source in zip(records, own, strict=True)]
        views = [TargetView(record.name, one.xyz, one.xy) for record, one in zip(records, points, strict=True)]
        made = calibrate_targets(views, size, camera_model=camera_model, sigma_px=sigma_px)
        locations = located_views(made, views)
        report = _write(job, made, records, points, locations)
        for warning in made.warnings:
            job.events.warned(CALIBRATE, warning)
        if recording:
            everything = np.concatenate([one.xyz for one in points])
            paths = {record.name: str(record.path) for record in records}
            write_recording(job, made, plane_outline(everything), paths, f"{len(records)} photographs")
        job.workspace.save()
        return TargetsResult(job.workspace.folder, report, made, tuple(locations))


def _common_size(records: Sequence[ImageRecord]) -> tuple[int, int]:
    """Raises InputError for photographs of several sizes or one name twice."""
    first = records[0]
    for n, record in enumerate(records):
        if (record.width, record.height) != (first.width, first.height):
            raise InputError(
                f"expected photographs of one size, found {first.name} with {first.width} x {first.height} pixels and "
                f"{record.name} with {record.width} x {record.height}",
                "one camera is calibrated at a time, at one zoom and in one orientation of its files",
            )
        if any(record.name == other.name for other in records[:n]):
            raise InputError(f"expected every photograph once, found the name {record.name} twice")
    return first.width, first.height


def _write(
    job: Job, made: CameraCalibration, records: Sequence[ImageRecord], points: Sequence[PhotographPoints],
    locations: Sequence[Location | None],
) -> TargetsReport:  # fmt: skip
    """Write all files but the recording."""
    folder = job.workspace.folder
    files = write_camera(folder, made)
    (folder / POSES).mkdir(exist_ok=True)
    fits, pictures = list[FitReport](), list[tuple[bytes, float]]()
    for record, one, found in zip(records, points, locations, strict=True):
        if found is None:
            continue
        fit = location_report(found, one.facts, one.xy).fit
        fits.append(fit)
        pose = folder / POSES / f"{Path(record.name).stem}.json"
        write_pose(
            pose, (found.view.camera, found.view.cam_from_world, found.covariance), found.noise.sigma_px, one.facts,
            one.xyz,
        )  # fmt: skip
        if len(pictures) < _MAX_PICTURES:
            pictures.append(draw_residuals(read_rgb(record), record.orientation, fit.points))
    report = targets_report(made, fits, files)
    job.workspace.write_json(REPORT, report)
    job.workspace.write_text(PAGE, render_targets_html(report, pictures))
    return report
