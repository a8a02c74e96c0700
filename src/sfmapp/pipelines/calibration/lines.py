"""Photographs of a built place to a camera, by the straight lines in them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.line_report import LinesReport
from sfmapp.calibration.lines import LineCalibration, LinePicture, calibrate_from_lines
from sfmapp.calibration.result import CameraCalibration
from sfmapp.dense.undistort import resample
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.formats.atomic import replaced_file
from sfmapp.images.folder import describe_images, load_images
from sfmapp.images.image_set import ImageRecord
from sfmapp.images.pixels import read_gray, read_mask, read_rgb
from sfmapp.pipelines.calibration.results import note_recording, write_camera
from sfmapp.report.lines_html import CalibrateLinesReport, line_picture, lines_page
from sfmapp.reporting import NamedReason
from sfmapp.scene.undistortion import Layout, plan_undistortion
from sfmapp.viewer.lines_recording import record_lines
from sfmapp.workspace.job import Job
from sfmapp.workspace.layout import CALIBRATE, PAGE, REPORT
from sfmapp.workspace.options import Options
from sfmapp.workspace.usage import Stopwatch

Pixels = NDArray[np.uint8]

# folders of pictures in the output
LINES, UNDISTORTED = "lines", "undistorted"
# More photographs than this tell what the first of them tell already: these are spread over all.
MOST_PHOTOGRAPHS = 24


@dataclass(frozen=True)
class LinesResult:
    """What was found and written.

    Attributes:
        output: the folder.
        calibration: the camera.
        report: what is in ``report.json``.
    """

    output: Path
    calibration: CameraCalibration
    report: CalibrateLinesReport


def calibrate_lines(
    sources: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    options: Options | None = None,
    *,
    recording: bool = True,
    events: Events | None = None,
    watch: Stopwatch | None = None,
) -> LinesResult:
    """Calibrate one camera from the straight lines of photographs.

    Args:
        sources: photographs, or one folder, glob pattern or list of them.
        output: a new folder, an empty one, or that of an earlier call.
        options: of these, those of images, the seed and ``threads``.
        recording: write ``recording.rrd``.
        events: progress, decisions, warnings and cancellation.
        watch: started when the run began.

    Raises:
        InputError: nothing to read, photographs of several sizes, or lines that tell nothing.
        UsageError: an output that holds something else.
    """
    if not sources:
        raise InputError("expected photographs to calibrate from, found none")
    with Job.opened(CALIBRATE, os.fspath(sources[0]), output, options, events=events, watch=watch) as job:
        with job.stage("images"):
            records, skipped = _records(job, [os.fspath(one) for one in sources])
        job.note_inputs({record.name: record.digest for record in records})
        with job.stage("calibration"):
            pictures = [LinePicture(one.name, read_gray(one), read_mask(one)) for one in records]
            found = calibrate_from_lines(pictures, job.options.seed)
        for warning in found.report.warnings:
            job.events.warned("calibration", warning)
        with job.stage("files"):
            files = write_camera(job.workspace.folder, found.calibration)
            shown = _write_pictures(job.workspace.folder, records, found)
        lines = LinesReport(**{**found.report, "files": files})
        report = CalibrateLinesReport(lines=lines, skipped=skipped, run=job.facts())
        job.workspace.write_json(REPORT, report)
        job.workspace.write_text(PAGE, lines_page(report, found.calibration, shown))
        if recording:
            with job.stage("recording"):
                paths = {record.name: str(record.path) for record in records}
                shown_files = [(name, paths[name]) for name in found.names]
                camera = found.calibration.camera
                title = found.names[0] if len(found.names) == 1 else f"{len(found.names)} photographs"
                note_recording(job, record_lines(job.workspace.recording, camera, found.photos, shown_files, title))
        job.workspace.save()
        return LinesResult(job.workspace.folder, found.calibration, report)


def _records(job: Job, sources: list[str]) -> tuple[list[ImageRecord], list[NamedReason]]:
    """The photographs, some of them where there are very many, and what was left out."""
    if len(sources) == 1 and not Path(sources[0]).is_file():
        images, _ = load_images(sources[0], job.options.images, job.events, threads=job.threads)
        records, skipped = list(images.images), list(images.skipped)
    else:
        paths = [Path(one).absolute() for one in sources]
        root = Path(os.path.commonpath([path.parent for path in paths]))
        names = [path.relative_to(root).as_posix() for path in paths]
        described, skipped = describe_images(root, names, job.options.images, threads=job.threads)
        records = [one for one in described if one is not None]
    if not records:
        why = f": {skipped[0][0]}: {skipped[0][1]}" if skipped else ""
        raise InputError(f"{sources[0]}: expected photographs, found none that can be read{why}")
    if len(records) > MOST_PHOTOGRAPHS:
        kept = np.unique(np.linspace(0, len(records) - 1, MOST_PHOTOGRAPHS).round().astype(int))
        job.events.decided("images", f"{len(kept)} of {len(records)} photographs are used, spread over all")
        records = [records[k] for k in kept]
    return records, [NamedReason(name=name, reason=reason) for name, reason in skipped]


def _write_pictures(folder: Path, records: Sequence[ImageRecord], found: LineCalibration) -> dict[str, Pixels]:
    """Write each photograph with its lines and without its distortion; the former (H, W, 3) by name."""
    from PIL import Image

    camera = found.calibration.camera
    plan = plan_undistortion(camera, Layout(front_only=True))[0]
    plane, size = plan.camera.canonical[:4], (plan.camera.width, plan.camera.height)
    shown: dict[str, Pixels] = {}
    by_name = {record.name: record for record in records}
    for name, photo in zip(found.names, found.photos, strict=True):
        rgb = read_rgb(by_name[name])
        drawn = line_picture(rgb, photo)
        flat, _ = resample(camera, plane, size, rgb)
        for place, pixels in ((LINES, drawn), (UNDISTORTED, flat)):
            target = folder / place / PurePosixPath(name).with_suffix(".jpg")
            target.parent.mkdir(parents=True, exist_ok=True)
            with replaced_file(target) as beside:
                Image.fromarray(pixels).save(beside, "JPEG", quality=92)
        shown[name] = drawn
    return shown
