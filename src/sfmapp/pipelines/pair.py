"""Two photographs to their story: report, page and recording."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfmapp.errors import InputError, UsageError
from sfmapp.events import Events
from sfmapp.features.extract import extract_features
from sfmapp.formats.colmap import read_model
from sfmapp.formats.database import Database
from sfmapp.images.folder import describe_images, load_images
from sfmapp.images.image_set import ImageRecord
from sfmapp.images.pixels import read_rgb
from sfmapp.images.sources import position_of_name
from sfmapp.matching.stage import MatchedPair, split_pairs
from sfmapp.report.pair_html import PairReport, pair_page
from sfmapp.twoview.story import Story, tell_story
from sfmapp.twoview.view import View
from sfmapp.viewer.pair_recording import record_pair
from sfmapp.workspace.job import FAILED, WRITTEN, Job
from sfmapp.workspace.kernels import PAIR_MODULES, kernels_compiling
from sfmapp.workspace.layout import PAGE, PAIR, RECONSTRUCT, REPORT
from sfmapp.workspace.manifest import image_root, missing_photographs, read_manifest
from sfmapp.workspace.options import Options, options_from_dict
from sfmapp.workspace.usage import Stopwatch
from sfmapp.workspace.workspace import Workspace

# in the workspace of a reconstruction, a folder for each pair that was looked at
PAIRS = "pairs"


@dataclass(frozen=True)
class PairResult:
    """What was found and written.

    Attributes:
        output: the folder.
        report: what is in ``report.json``.
        story: what is drawn.
    """

    output: Path
    report: PairReport
    story: Story


@dataclass(frozen=True)
class _Source:
    """Two photographs of a reconstruction, with what it knows of them."""

    records: tuple[ImageRecord, ImageRecord]
    views: tuple[View, View]
    known: MatchedPair | None
    options: Options


def tell_pair(
    sources: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str] | None = None,
    options: Options | None = None,
    *,
    events: Events | None = None,
    watch: Stopwatch | None = None,
) -> PairResult:
    """Tell the story of two photographs, step by step.

    Args:
        sources: two photographs; or the workspace of a reconstruction and the names of two of its images, whose
            features, matches and cameras are then used.
        output: a new folder, an empty one, or that of an earlier call; None: in the workspace, ``pairs/NAME--NAME``.
        options: as of a reconstruction; in a workspace, its own are used.
        events: progress, decisions, warnings and cancellation.
        watch: started when the run began.

    Raises:
        UsageError: another number of sources, no output for photographs, or one that holds something else.
        InputError: photographs or images that are not there or cannot be used, or a lens without a fundamental matrix.
    """
    given = [os.fspath(one) for one in sources]
    if len(given) == 3:
        return _of_workspace(Path(given[0]), (given[1], given[2]), output, events, watch)
    if len(given) != 2:
        raise UsageError(
            f"expected two photographs, or a workspace and the names of two of its images, found {len(given)} arguments"
        )
    if output is None:
        raise UsageError("the story of two photographs needs a folder to be written to", "give -o OUT")
    with Job.opened(PAIR, given[0], output, options, events=events, watch=watch) as job:
        with kernels_compiling(job.events, job.usage, PAIR_MODULES):
            records, views = _views(job, (given[0], given[1]))
        return _tell(job, _Source(records, views, None, job.options))


def _plain_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9._-]", "_", name)


def _views(job: Job, paths: tuple[str, str]) -> tuple[tuple[ImageRecord, ImageRecord], tuple[View, View]]:
    """Both photographs with their features."""
    with job.stage("images"):
        found, _ = load_images(paths, job.options.images, job.events, threads=job.threads)
        if found.skipped:
            name, reason = found.skipped[0]
            raise InputError(f"{name}: expected a photograph, found a file that cannot be used: {reason}")
        first, second = found.images if len(found.images) == 2 else (*found.images, *found.images)
    with job.stage("features"):
        features, _ = extract_features(
            found, job.options.features, threads=job.threads, events=job.events
        )  # fmt: skip
    # as short as tells them apart
    short = [Path(path).name for path in paths]
    names = short if short[0] != short[1] else [one.name for one in found.images]
    views = [View(names[n], found.camera_of(n), features[n]) for n in range(len(found.images))]
    return (first, second), (views[0], views[-1])


def _of_workspace(
    folder: Path, wanted: tuple[str, str], output: str | os.PathLike[str] | None, events: Events | None,
    watch: Stopwatch | None,
) -> PairResult:  # fmt: skip
    manifest = read_manifest(folder, RECONSTRUCT)
    root = image_root(manifest)
    if root is None:
        raise missing_photographs(folder, manifest)
    plain = manifest.options
    options = options_from_dict(
        {name: plain[name] for name in ("images", "matching", "mapping", "seed") if name in plain}
    )
    with Database(folder / "database.db", read_only=True) as database:
        cameras, every, whose = database.read_images()
    i, j = sorted(position_of_name(name, every, f"of {folder}") for name in wanted)
    if i == j:
        raise InputError(f"{wanted[0]} and {wanted[1]} are one image of {folder}", "name two")
    pair = (every[i], every[j])
    target = folder / PAIRS / "--".join(map(_plain_name, pair)) if output is None else Path(output)
    target.parent.mkdir(parents=True, exist_ok=True)
    with Job.opened(PAIR, folder, target, options, events=events, watch=watch) as job:
        with job.stage("features"), Database(folder / "database.db", read_only=True) as database:
            views = [View(every[n], cameras[whose[n]], database.read_features(n)) for n in (i, j)]
            stored = (i, j) in database.pair_keys()
            known = split_pairs(database.read_pairs(np.array([[i, j]], np.int32)))[0] if stored else None
        records, reasons = describe_images(root, pair, job.options.images, threads=job.threads)
        if reasons:
            raise InputError(f"{reasons[0][0]}: expected a photograph in {root}, found: {reasons[0][1]}")
        first, second = (record for record in records if record is not None)
        return _tell(job, _Source((first, second), _with_model(folder, (views[0], views[1])), known, options))


def _with_model(folder: Path, views: tuple[View, View]) -> tuple[View, View]:
    """The cameras as the reconstruction has refined them, where it has."""
    workspace = Workspace(folder, read_manifest(folder, RECONSTRUCT))
    if not (workspace.model() / "cameras.bin").is_file():
        return views
    model, _ = read_model(workspace.model())
    refined = [
        replace(view, camera=model.cameras[model.image_camera_idx[model.image_names.index(view.name)]])
        if view.name in model.image_names
        else view
        for view in views
    ]
    return refined[0], refined[1]


def _tell(job: Job, source: _Source) -> PairResult:
    """The story and its files."""
    job.note_inputs({record.name: record.digest for record in source.records})
    options = source.options
    with job.stage("story"):
        story = tell_story(
            source.views, options.matching, options.mapping, seed=options.seed, events=job.events, known=source.known
        )
    with job.stage("files"):
        with ThreadPoolExecutor(2) as pool:
            first, second = pool.map(read_rgb, source.records)
        told = record_pair(job.workspace.recording, story, (first, second))
        job.workspace.note(recording=FAILED if told.problem else WRITTEN)
        if told.problem:
            job.events.warned("recording", f"no recording: {told.problem}")
    report = PairReport(story=story.report, run=job.facts())
    job.workspace.write_json(REPORT, report)
    job.workspace.write_text(PAGE, pair_page(report, story, (first, second)))
    job.workspace.save()
    return PairResult(job.workspace.folder, report, story)
