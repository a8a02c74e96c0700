"""Photographs of an object to its masks: files for other commands and tools, and a page to judge them by."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.silhouettes import Silhouette, find_silhouettes
from sfmapp.carve.views import View
from sfmapp.errors import InputError, UsageError
from sfmapp.events import Events
from sfmapp.formats.atomic import write_bytes
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.images.load import load_images
from sfmapp.images.pixels import read_rgb
from sfmapp.images.rewrite import encode_mask
from sfmapp.pipelines.carve.sources import find_views
from sfmapp.report.masks_html import MaskFilesReport, masks_page
from sfmapp.workspace.job import Job
from sfmapp.workspace.layout import MASKS, PAGE, REPORT
from sfmapp.workspace.options import Options
from sfmapp.workspace.usage import Stopwatch

FilePath = str | os.PathLike[str]


@dataclass(frozen=True)
class MasksInput:
    """Whose masks are found.

    Attributes:
        source: a workspace, a COLMAP model, or photographs with or without their cameras.
        images, poses: see :func:`sfmapp.pipelines.carve.sources.find_views`.
    """

    source: FilePath
    images: FilePath | None = None
    poses: FilePath | None = None


@dataclass(frozen=True)
class MasksResult:
    """What was found and written.

    Attributes:
        output: the folder, with the masks in its folder ``masks``. report: what is in ``report.json``.
        silhouettes: in the order of the photographs.
    """

    output: Path
    report: MaskFilesReport
    silhouettes: Sequence[Silhouette]


def find_masks(
    what: MasksInput, output: FilePath, options: Options | None = None, *,
    events: Events | None = None, watch: Stopwatch | None = None,
) -> MasksResult:  # fmt: skip
    """Write masks of an object in photographs, white where it is, and a page with its outlines.

    Args:
        what: the photographs, and their cameras where these are known: silhouettes are then held against each other.
        output: a new folder, an empty one, or that of an earlier call.
        options: of these ``masks``, ``images`` and ``threads``.
        events: progress, warnings and cancellation. watch: started when the run began.

    Raises:
        UsageError: an output that holds something else.
        InputError: photographs, cameras or masks that cannot be used.
    """
    with Job.opened(MASKS, what.source, output, options, events=events, watch=watch) as job:
        records, views, points, cameras = _photographs(what, job)
        job.note_inputs({record.name: record.digest for record in records})
        with job.stage("masks"):
            silhouettes, masks = find_silhouettes(
                ImageSet(records, ()), views, job.options.masks, job.events, points=points, threads=job.threads
            )
        with job.stage("files"):
            is_usable = [entry.is_usable for entry in masks.masks]
            files = _write(job.workspace.folder / MASKS, records, silhouettes, is_usable)
        report = MaskFilesReport(
            run=job.facts(), cameras=cameras, masks=masks, files=files, usage=job.usage, warnings=job.log.warnings,
            decisions=job.log.decisions,
        )  # fmt: skip
        with job.measured("page"):
            job.workspace.write_text(PAGE, masks_page(report, silhouettes, lambda i: read_rgb(records[i])))
        job.workspace.write_json(REPORT, report)
        job.workspace.save()
        return MasksResult(job.workspace.folder, report, silhouettes)


def _photographs(
    what: MasksInput, job: Job
) -> tuple[tuple[ImageRecord, ...], tuple[View, ...] | None, NDArray[np.float64] | None, str]:
    """Photographs, where they are known their cameras and points (N, 3), and what cameras are in words."""
    with job.stage("views"):
        try:
            found = find_views(what.source, what.images, what.poses, job.options, job.events)
        except UsageError:
            if what.poses is not None:
                raise
        else:
            return found.records, found.views, found.points, found.cameras
        inside = Path(what.source) / "images"
        folder = what.images if what.images is not None else inside if inside.is_dir() else what.source
        images, _ = load_images(folder, job.options.images, job.events, threads=job.threads)
        if not images.images:
            raise InputError(f"{os.fspath(folder)}: expected photographs, found none")
        return images.images, None, None, "no cameras: silhouettes are not held against each other"


def _write(
    folder: Path, records: Sequence[ImageRecord], silhouettes: Sequence[Silhouette], is_usable: Sequence[bool]
) -> list[str]:
    """Masks under the names that COLMAP has for them; what cannot be right is written nowhere."""
    names = []
    for record, silhouette, usable in zip(records, silhouettes, is_usable, strict=True):
        path = folder / f"{record.name}.png"
        if not usable:
            path.unlink(missing_ok=True)
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, encode_mask(silhouette.inside))
        names.append(f"{MASKS}/{record.name}.png")
    return names
