"""Two photographs in the place of a third: report, page and a synthesised photograph."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError, NoReconstructionError, UsageError
from sfmapp.events import Events
from sfmapp.features.extract import extract_features
from sfmapp.formats.atomic import write_bytes
from sfmapp.images.folder import load_images
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.images.pixels import read_rgb
from sfmapp.images.rewrite import encode
from sfmapp.mapping.tracks import build_tracks
from sfmapp.matching.stage import match_images
from sfmapp.report.transfer_html import TransferRunReport, transfer_page
from sfmapp.uncalibrated.new_view import NewView, correlation, synthesise
from sfmapp.uncalibrated.projective_model import sightings_of_tracks
from sfmapp.uncalibrated.three_views import (
    NewViewReport,
    ThreeViews,
    find_three_views,
    tell_transfer,
    transferred_pairs,
)
from sfmapp.viewer.transfer_recording import record_transfer
from sfmapp.workspace.job import FAILED, WRITTEN, Job
from sfmapp.workspace.kernels import PAIR_MODULES, kernels_compiling
from sfmapp.workspace.layout import PAGE, REPORT, TRANSFER
from sfmapp.workspace.options import Options
from sfmapp.workspace.usage import Stopwatch

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

PICTURE = "synthesised.jpg"


@dataclass(frozen=True)
class TransferResult:
    """What was found and written.

    Attributes:
        output: the folder. picture: the synthesised photograph.
        report: what is in ``report.json``.
        views: cameras, tensor and points.
    """

    output: Path
    picture: Path
    report: TransferRunReport
    views: ThreeViews


def transfer_views(
    photographs: Sequence[str | os.PathLike[str]], output: str | os.PathLike[str], options: Options | None = None, *,
    events: Events | None = None, watch: Stopwatch | None = None,
) -> TransferResult:  # fmt: skip
    """Transfer points, and a whole photograph, of two views into a third, with no calibration.

    Args:
        photographs: three files: two that are transferred, and the third.
        output: a new folder, an empty one, or that of an earlier call.
        options: of these images, features, matching and seed.
        events: progress, decisions, warnings and cancellation.
        watch: started when the run began.

    Raises:
        UsageError: not three photographs, one given twice, or an output that holds something else.
        InputError: photographs that are not there or cannot be used.
        NoReconstructionError: too little in common, copies of one picture, a plane, or a camera that only turned.
    """
    given = [os.fspath(one) for one in photographs]
    if len(given) != 3 or len(set(given)) != 3:
        raise UsageError(
            f"expected three different photographs, found {', '.join(given) or 'none'}",
            "give the two to transfer, then the third",
        )
    with Job.opened(TRANSFER, given[2], output, options, events=events, watch=watch) as job:
        with kernels_compiling(job.events, job.usage, PAIR_MODULES):
            image_set, order, table, counts = _matched(job, given)
        return _told(job, image_set, order, table, counts)


def _matched(job: Job, given: Sequence[str]) -> tuple[ImageSet, list[int], Array, tuple[int, int, int]]:
    """The photographs, their positions in the order given, (N, 3, 2) pixels of tracks, and counts of matches."""
    options = job.options
    with job.stage("images"):
        found, _ = load_images(given, options.images, job.events, threads=job.threads)
        if found.skipped:
            name, reason = found.skipped[0]
            raise InputError(f"{name}: expected a photograph, found a file that cannot be used: {reason}")
        digests = [record.digest for record in found.images]
        if len(set(digests)) < 3:
            raise NoReconstructionError(
                "two of the three photographs are the same file", "give photographs from three different places"
            )
        order = [_position(found, path) for path in given]
    with job.stage("features"):
        features, _ = extract_features(found, options.features, threads=job.threads, events=job.events)
    with job.stage("matching"):
        pairs = np.array([[0, 1], [0, 2], [1, 2]], np.int32)
        matches, _ = match_images(
            found, features, pairs, options.matching, seed=options.seed, threads=job.threads, events=job.events
        )
        tracks, _ = build_tracks(matches, features)
        table = sightings_of_tracks(tracks).table(tracks.num_tracks, 3)[:, order]
    by_pair = {tuple(sorted(pair)): int(n) for pair, n in zip(pairs.tolist(), matches.num_inliers, strict=True)}
    counts = [by_pair[tuple(sorted((order[i], order[j])))] for i, j in ((0, 1), (0, 2), (1, 2))]
    return found, order, table, (counts[0], counts[1], counts[2])


def _position(found: ImageSet, path: str) -> int:
    """Of a photograph among those that were loaded, which may stand in another order."""
    for n, record in enumerate(found.images):
        if record.path is not None and record.path.resolve() == Path(path).resolve():
            return n
    raise InputError(f"{path}: expected a photograph, found none under this name")


def _told(
    job: Job, image_set: ImageSet, order: Sequence[int], table: Array, counts: tuple[int, int, int]
) -> TransferResult:
    records = [image_set.images[n] for n in order]
    job.note_inputs({record.name: record.digest for record in records})
    names = tuple(Path(record.name).name for record in records)
    with job.stage("three views"):
        in_all = np.isfinite(table[:, :, 0]).all(1)
        views = find_three_views(table[in_all], events=job.events)
        sizes = tuple((record.width, record.height) for record in records)
        told = tell_transfer(views, (names[0], names[1], names[2]), sizes, counts, table[in_all])
    if told.degenerate:
        job.events.warned("three views", told.degenerate)
    with job.stage("new view"):
        pictures = _pictures(records)
        drawn = _drawn(views, table, pictures)
        view = NewViewReport(
            coverage=float(drawn.is_filled.mean()), num_triangles=drawn.num_triangles,
            correlation=correlation(drawn.pixels, pictures[2], drawn.is_filled),
        )  # fmt: skip
        told = replace(told, new_view=view)
    with job.stage("files"):
        write_bytes(job.workspace.folder / PICTURE, encode(drawn.pixels, "jpeg"))
        recorded = record_transfer(job.workspace.recording, told, views, (*pictures, drawn.pixels))
        job.workspace.note(recording=FAILED if recorded.problem else WRITTEN)
        if recorded.problem:
            job.events.warned("recording", f"no recording: {recorded.problem}")
    report = TransferRunReport(transfer=told, run=job.facts())
    job.workspace.write_json(REPORT, report)
    job.workspace.write_text(PAGE, transfer_page(report, views, pictures, drawn.pixels))
    job.workspace.save()
    return TransferResult(job.workspace.folder, job.workspace.folder / PICTURE, report, views)


def _pictures(records: Sequence[ImageRecord]) -> tuple[Pixels, Pixels, Pixels]:
    with ThreadPoolExecutor(3) as pool:
        first, second, third = pool.map(read_rgb, records)
    return first, second, third


def _drawn(views: ThreeViews, table: Array, pictures: tuple[Pixels, Pixels, Pixels]) -> NewView:
    """The third photograph of what the first two show."""
    matches = table[np.isfinite(table[:, :2, 0]).all(1)][:, :2]
    source, target, depth = transferred_pairs(views, matches)
    height, width = pictures[2].shape[:2]
    return synthesise(pictures[:2], (source[:, 0], source[:, 1]), target, depth, (width, height))
