"""Pairs of photographs to rectified pictures, disparities and depths, one pair after another."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sfmapp.errors import EpipoleInPictureError, InputError, UsageError
from sfmapp.events import Events
from sfmapp.formats.atomic import write_bytes
from sfmapp.images.rewrite import encode
from sfmapp.images.video import is_video
from sfmapp.pipelines.stereo.model_pairs import is_of_model, pairs_of_model
from sfmapp.pipelines.stereo.outputs import write_cameras, write_maps, write_models, write_sampling, write_sparse
from sfmapp.pipelines.stereo.sources import ChosenPairs, KnownCameras, PairSource, find_pairs
from sfmapp.pipelines.stereo.video_pairs import pairs_of_video
from sfmapp.report.stereo_document import StereoReport
from sfmapp.report.stereo_html import pairs_page, stereo_page
from sfmapp.reporting import NamedReason
from sfmapp.stereo.disparity_error import disparity_error
from sfmapp.stereo.match import match_pair
from sfmapp.stereo.measured import MeasuredPair, measure_pair, report_of
from sfmapp.stereo.polar import on_photograph
from sfmapp.stereo.polar_pair import prepare_polar
from sfmapp.stereo.prepare import PairCameras, PreparedPair, PrepareOptions, prepare_pair, turn_of_rig
from sfmapp.stereo.report import DisparityReport, StereoPairReport
from sfmapp.stereo.result import DisparityMap, PixelState
from sfmapp.stereo.temporal import Moment, compare_moments, film_report
from sfmapp.viewer.stereo_recording import record_stereo
from sfmapp.workspace.job import FAILED, WRITTEN, Job
from sfmapp.workspace.layout import PAGE, REPORT, STEREO
from sfmapp.workspace.options import Options
from sfmapp.workspace.usage import Stopwatch

STAGE = STEREO
_QUANTILES = (0.01, 0.5, 0.99)
# pairs that tell how far their rig has turned, and of a film frames from its beginning: they are read once more for it
_PAIRS_OF_TURN, _FRAMES_OF_TURN = 12, 6


@dataclass(frozen=True)
class MatchedStereo:
    """One pair when it is done: rectified, matched, measured."""

    source: PairSource
    prepared: PreparedPair
    disparity: DisparityMap
    measured: MeasuredPair


@dataclass(frozen=True)
class StereoResult:
    """What was found and written.

    Attributes:
        output: the folder. report: what is in ``report.json``.
        last: the pair that was done last.
    """

    output: Path
    report: StereoReport
    last: MatchedStereo


@dataclass(frozen=True)
class AlsoWritten:
    """Beside the usual files.

    Attributes:
        maps: where each pixel of the rectified pictures comes from. sparse: points of keypoints alone, with their
            covariances.
    """

    maps: bool = False
    sparse: bool = False


def stereo(
    sources: Sequence[str | os.PathLike[str]], output: str | os.PathLike[str] | None = None,
    options: Options | None = None, *,
    known: KnownCameras | None = None, chosen: ChosenPairs | None = None, also: AlsoWritten | None = None,
    events: Events | None = None, watch: Stopwatch | None = None,
) -> StereoResult:  # fmt: skip
    """Rectify and match pairs of photographs.

    Args:
        sources: two photographs; two folders, whose files belong together by name; a folder of KITTI; a video with
            both pictures side by side; or the workspace of a reconstruction, or a COLMAP model.
        output: a new folder, an empty one, or that of an earlier call; of several pairs, each gets a folder in it.
            None, for a workspace alone: its folder ``stereo``.
        options: of these, ``stereo``.
        known: what is known of the cameras; None: nothing.
        chosen: which of many pairs.
        also: what is written beside the usual files; None: nothing.
        events: progress, warnings and cancellation. watch: started when the run began.

    Raises:
        UsageError: sources that are none, or an output that holds something else.
        InputError: photographs or a calibration that cannot be used; of several pairs, all of them.
    """
    target = _target(sources, output)
    named = ", ".join(os.fspath(one) for one in sources)
    with Job.opened(STEREO, named, target, options, events=events, watch=watch) as job:
        pairs, total = _pairs(job, sources, known or KnownCameras(), chosen or ChosenPairs())
        pairs, turns = _turns(job, pairs)
        inputs: dict[str, str] = {}
        job.note_inputs(inputs)
        job.events.started(STAGE, f"{total or 'all'} pairs" if total != 1 else "matching", total=total)
        told: list[StereoPairReport] = []
        failed: list[NamedReason] = []
        last: MatchedStereo | None = None
        before: Moment | None = None
        for number, pair in enumerate(pairs):
            try:
                turn = turns.pop(number, turns.get(None, PrepareOptions()))
                last, report, before = _do_pair(job, pair, turn, also or AlsoWritten(), before)
                told.append(report)
            except InputError as error:
                if total == 1:
                    raise
                failed.append(NamedReason(name=pair.name, reason=str(error)))
                job.events.warned(STAGE, f"{pair.name}: {error}")
            inputs |= pair.digests
            job.events.advanced(STAGE)
        if last is None:
            why = f"none of which can be used: {failed[0].name}: {failed[0].reason}" if failed else "as none is there"
            raise InputError(f"{len(failed)} pairs, {why}")
        job.note_inputs(inputs)
        job.events.finished(STAGE, f"{len(told)} pairs matched")
        document = StereoReport(
            run=job.facts(), pairs=told, failed=failed, usage=job.usage, warnings=job.log.warnings,
            film=film_report((pair.name, pair.consistency) for pair in told if pair.consistency is not None),
        )  # fmt: skip
        job.workspace.write_json(REPORT, document)
        if any(pair.name for pair in told):  # each has a folder and a page of its own
            job.workspace.write_text(PAGE, pairs_page(document))
        job.workspace.save()
        return StereoResult(job.workspace.folder, document, last)


def _target(sources: Sequence[str | os.PathLike[str]], output: str | os.PathLike[str] | None) -> Path:
    """The folder of the results. Raises UsageError if it has to be named."""
    if output is not None:
        return Path(output)
    if len(sources) == 1 and is_of_model(Path(sources[0])):
        return Path(sources[0]) / STEREO
    raise UsageError("disparities and depths need a folder to be written to", "give -o OUT")


def _pairs(
    job: Job, sources: Sequence[str | os.PathLike[str]], known: KnownCameras, chosen: ChosenPairs
) -> tuple[Iterable[PairSource], int | None]:
    """The pairs, and how many there are; None where only their end will tell."""
    first = os.fspath(sources[0])
    if len(sources) == 1 and is_of_model(Path(first)):
        found = pairs_of_model(first, chosen.names, chosen.best, job.options)
        return found, len(found)
    if chosen.names is not None:
        raise UsageError(f"--pair names images of a reconstruction, and {first} is none")
    if len(sources) == 1 and is_video(first):
        return pairs_of_video(first, known, chosen.step), None
    found = list(find_pairs(sources, known))[:: chosen.step]
    return found, len(found)


def _turns(
    job: Job, pairs: Iterable[PairSource]
) -> tuple[Iterable[PairSource], dict[int | None, PrepareOptions]]:  # fmt: skip
    """How far the rig of several pairs has turned, by some of them together: what is known of the pairs at some places,
    and under None of the others; nothing of one pair, or of several rigs. Gives all pairs back."""
    if job.options.stereo.correct_rig == "no":
        return pairs, {}
    if isinstance(pairs, list):
        places = np.unique(np.linspace(0, len(pairs) - 1, _PAIRS_OF_TURN).round().astype(int)).tolist()
        some = [pairs[n] for n in places]
    else:  # a film, whose frames come one after another
        following = iter(pairs)
        some = list(itertools.islice(following, _FRAMES_OF_TURN))
        places, pairs = list(range(len(some))), itertools.chain(some, following)
    if len(some) < 2:
        return pairs, {}
    with job.stage("rectification"):
        try:
            cameras = [one.cameras() for one in some]
            if len({_sizes(one) for one in cameras}) > 1:
                return pairs, {}
            turn = turn_of_rig((one.read() for one in some), cameras[0])
        except InputError:
            return pairs, {}  # named of the pair that has it
    told: dict[int | None, PrepareOptions] = {None: PrepareOptions(turn=turn.found)}
    # none of cameras that the photographs told
    for place, matches, rectified in zip(places, turn.matches, turn.rectified, strict=False):
        told[place] = PrepareOptions(turn=turn.found, matches=matches, rectified=rectified)
    return pairs, told


def _sizes(cameras: PairCameras) -> tuple[tuple[int, int], ...]:
    return () if cameras.rig is None else tuple((one.width, one.height) for one in cameras.rig.cameras)


def _do_pair(
    job: Job, source: PairSource, known: PrepareOptions, also: AlsoWritten, before: Moment | None
) -> tuple[MatchedStereo, StereoPairReport, Moment | None]:
    """The pair, what is told of it, and what is kept of a frame until the next."""
    with job.stage("rectification"):
        left, right = source.read()
        least = job.options.stereo.min_disparity
        how = replace(known, is_cropped=least is not None and least < 0, corrects=job.options.stereo.correct_rig)
        cameras, polar = source.cameras(), None
        try:
            prepared = prepare_pair(left, right, cameras, (source.left, source.right), how)
        except EpipoleInPictureError:
            if cameras.rig is None:
                raise
            prepared, polar = prepare_polar(left, right, cameras)
        for warning in prepared.report.warnings:
            job.events.warned(STAGE, warning)
    with job.stage("matching"):
        disparity = match_pair(prepared.pair, job.options.stereo, matches=prepared.matches)
        if "chance" in disparity.info:
            job.events.warned(STAGE, disparity.info["chance"])
    with job.stage("errors"):
        if polar is None:
            measured = measure_pair(prepared.pair, disparity, threads=job.threads)
        else:
            error = disparity_error(prepared.pair, disparity, threads=job.threads)
            pair, disparity, measured = on_photograph(
                polar, prepared.pair, disparity, error, (left, right), prepared.report.unit,
                has_baseline=cameras.has_baseline,
            )  # fmt: skip
            prepared = replace(prepared, pair=pair)
        done = MatchedStereo(source, prepared, disparity, measured)
        now = _moment(done) if source.is_frame else None
        consistency = None if before is None or now is None else compare_moments(before, now)
    with job.stage("files"):
        files = [
            str(path.relative_to(job.workspace.folder))
            for path in _write(job.workspace.folder / source.name, done, also)
        ]
    report = StereoPairReport(
        name=source.name, left=source.left, right=source.right, rectification=prepared.report,
        disparity=_disparity_report(done), measured=report_of(prepared.pair, disparity, done.measured), files=files,
        consistency=consistency,
    )  # fmt: skip
    with job.stage("page"):
        page = stereo_page(report, prepared.pair, disparity, done.measured)
        write_bytes(job.workspace.folder / source.name / PAGE, page.encode())
    if not source.name:  # of a pair alone; thousands of them would take longer to draw than to match
        _record(job, report, done)
    return done, report, now


def _moment(done: MatchedStereo) -> Moment:
    pair = done.prepared.pair
    return Moment.of(
        done.source.name, pair.left, pair.left_shown, done.disparity, done.measured.error.half_width_95
    )  # fmt: skip


def _record(job: Job, report: StereoPairReport, done: MatchedStereo) -> None:
    title = f"{Path(report.left).name} and {Path(report.right).name}"
    recorded = record_stereo(
        job.workspace.recording, title, done.prepared.pair, done.disparity, done.measured, report.measured
    )
    job.workspace.note(recording=FAILED if recorded.problem else WRITTEN)
    if recorded.problem:
        job.events.warned("recording", f"no recording: {recorded.problem}")


def _disparity_report(done: MatchedStereo) -> DisparityReport:
    found = done.disparity
    known = found.disparity[found.state == PixelState.MATCHED]
    quantiles = np.quantile(known, _QUANTILES).tolist() if known.size else []
    depths: list[float] = []
    depth = done.measured.depth
    if depth is not None and known.size:
        of = depth[np.isfinite(depth)]
        depths = np.quantile(of, _QUANTILES).tolist() if of.size else []
    return DisparityReport(
        matcher=str(found.info.get("matcher", "")), searched=found.searched,
        told_by=str(found.info.get("range_told_by", "")), density=found.density,
        filled=float((found.state == PixelState.FILLED).mean()), quantiles_px=quantiles, depths=depths,
    )  # fmt: skip


def _write(folder: Path, done: MatchedStereo, also: AlsoWritten) -> Iterator[Path]:
    """Write the files of a pair; gives the path of each."""
    pair = done.prepared.pair
    for name, picture in (("left.png", pair.left), ("right.png", pair.right)):
        write_bytes(folder / name, encode(picture, "png"))
        yield folder / name
    yield from write_cameras(folder, done.prepared)
    yield from write_maps(folder, done.disparity, done.measured)
    yield from write_models(folder, pair, done.disparity, done.measured)
    yield from write_sampling(folder, done.prepared, wanted=also.maps)
    yield from write_sparse(folder, pair, wanted=also.sparse and not done.prepared.report.is_polar)
