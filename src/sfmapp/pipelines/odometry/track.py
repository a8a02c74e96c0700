"""A sequence to a trajectory and keyframe maps: the second job, on a page.

:func:`track_sequence` opens the workspace and sees to it that every end is a clean one; :func:`_run` is the job.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InterruptedRunError, NoReconstructionError, UsageError
from sfmapp.events import Events
from sfmapp.images.frame_reader import FileSequence
from sfmapp.images.sequence import Frame, GroundTruth, Imu, Sequence, SequenceKind
from sfmapp.images.video import VideoSequence
from sfmapp.odometry.result import FrameState, OdometryResult
from sfmapp.odometry.run import run_odometry
from sfmapp.pipelines.odometry.filtering import filter_beside, pushes_imu
from sfmapp.pipelines.odometry.known_map import read_known_map
from sfmapp.pipelines.odometry.live import live_counts
from sfmapp.pipelines.odometry.results import write_odometry
from sfmapp.pipelines.odometry.scale import parse_scale, resolve_scale_request, scale_maps, takes_imu
from sfmapp.pipelines.odometry.tracking import Tracking
from sfmapp.report.model import OdometryRunReport
from sfmapp.sequences.open import open_sequence
from sfmapp.viewer.live import Screen
from sfmapp.workspace.kernels import compile_odometry_kernels
from sfmapp.workspace.layout import ODOMETRY
from sfmapp.workspace.options import Options
from sfmapp.workspace.usage import Stopwatch

if TYPE_CHECKING:
    from sfmapp.scene.rig import Rig

NO_MAP_ADVICE = (
    "the camera has to move sideways past something still and textured; OUT/report.html and -v tell what was seen"
)
# What held for this share of the frames is why there is no map.
_MOST_FRAMES = 0.5


class TrackResult(NamedTuple):
    """What the run found, and the report of it as in ``report.json``."""

    odometry: OdometryResult
    report: OdometryRunReport


def track_sequence(
    source: str | os.PathLike[str] | Sequence,
    output: str | os.PathLike[str],
    options: Options | None = None,
    *,
    events: Events | None = None,
    record: bool = True,
    screen: Screen | None = None,
    self_calibrate: bool = False,
    watch: Stopwatch | None = None,
) -> TrackResult:
    """Follow a camera (or a stereo rig) through a sequence.

    Args:
        source: a folder of frames, a video file or stream, a bag, or the folder of a KITTI, TUM or EuRoC sequence; or
            an open sequence, such as one of frames in memory.
        output: folder of the results: new, empty, or of an earlier odometry run, whose results are replaced.
        options: of all stages; ``sequence`` and ``odometry`` count here. See :func:`sfmapp.load_options`.
        events: listens in, and can ask the run to stop: what was tracked until then is written.
        record: write ``recording.rrd``, which replays the run.
        screen: shows the run while it is under way; None: nobody looks.
        self_calibrate: find the intrinsics by a reconstruction from the first minute.
        watch: started earlier, if more is to be counted in the report than this call.

    Raises:
        UsageError: the output folder holds something else, or another run is at work in it.
        InputError: the sequence does not exist or cannot be read, or its camera is not known.
        NoReconstructionError: no map could be made; the report is written.
        InterruptedRunError: ``events`` was asked to stop.
    """
    sequence = None if isinstance(source, str | os.PathLike) else source
    name = os.fspath(source) if isinstance(source, str | os.PathLike) else source.source
    if sequence is not None and self_calibrate:
        raise UsageError(
            "frames in memory come with their camera, which they cannot calibrate: they are read only once"
        )
    if options is not None and options.adjust.backend != "schur":
        raise UsageError(
            "odometry cannot take adjust.backend=gtsam: it adjusts windows while it tracks, and with one factor per "
            "observation each takes ten times as long",
            "leave it out; sfmapp refine --set adjust.backend=gtsam adjusts the finished map so",
        )
    if options is not None and options.odometry.known_map is not None:
        _check_known_map(options.odometry.known_map, output, options.scale.source)
    request = parse_scale(options.scale.source) if options is not None and options.scale.source is not None else None
    with Tracking.opened(
        ODOMETRY, name, output, options, events=events, watch=watch, scale_request=request, sequence=sequence
    ) as run:
        run.listen_in(record, screen)
        return _run(run, self_calibrate)


def _check_known_map(known_map: str, output: str | os.PathLike[str], scale: str | None) -> None:
    """Raises UsageError where the results would replace the map, or a scale contradict its unit of length."""
    if scale is not None:
        raise UsageError(
            f"--scale {scale}: the unit of length is that of the map in {known_map}",
            "leave it out, or give that map its metres",
        )
    if Path(known_map).resolve() == Path(output).resolve():
        raise UsageError(f"{known_map} is the map itself, which the results would replace", "choose another OUT")


def _run(run: Tracking, self_calibrate: bool) -> TrackResult:
    """The job: the sequence, its frames, and what is written of them, also of a run that was cut short."""
    options, events = run.options, run.events
    run.note_inputs({})
    with run.stage("sequence"):
        if self_calibrate:
            from sfmapp.pipelines.odometry.self_calibrate import self_calibrated

            options, calibration = self_calibrated(run.source, options, events)
            run.stages = replace(run.stages, self_calibration=calibration)
        if run.sequence is None:
            run.sequence = open_sequence(run.source, options.sequence, events)
        is_auto = options.scale.source is None and options.odometry.known_map is None
        run.scale_request = resolve_scale_request(run.scale_request, is_auto, run.sequence)
    watched, known = Watched(run.sequence, run), None
    if options.odometry.known_map is not None:
        with run.stage("known map"):
            found = read_known_map(Path(options.odometry.known_map), options, events)
            known, watched.rig = found.known, found.rig_for(run.sequence.rig)
    if run.live is not None:
        run.live.begin(run.sequence)
    with run.stage("kernels"):
        has_imu = run.sequence.imu is not None or pushes_imu(run.sequence)
        compiled = compile_odometry_kernels(events, inertial=has_imu)
        run.stages = replace(run.stages, kernels=compiled)
    run.save_first(lambda: run.workspace.begin(ODOMETRY, ""))
    beside = None
    if options.odometry.filter:
        beside = filter_beside(run.sequence)
        run.listen(beside)
    with run.measured("odometry"):
        result = run_odometry(
            watched,
            options.odometry,
            seed=options.seed,
            threads=run.threads,
            events=events.without_cancellation(),
            markers=None if run.scale_request is None else run.scale_request.detector(),
            with_imu=takes_imu(run.scale_request, is_auto),
            known=known,
        )
        run.threads_cpu.sample()
    run.stages = replace(run.stages, odometry=result.report)
    if run.stages.self_calibration is not None:
        from sfmapp.pipelines.odometry.self_calibrate import widen

        widen(result, run.stages.self_calibration)
    with run.measured("scale"):
        if run.scale_request is not None:
            without_cancellation = events.without_cancellation()
            scaled = scale_maps(result, run.scale_request, without_cancellation)
            run.stages = replace(run.stages, scale=scaled)
    given_s = watched.times_as_given(result)
    if beside is not None and result.maps and (filtered := beside.finish(events.without_cancellation())) is not None:
        result.filtered = filtered[0]
        run.stages = replace(run.stages, filter=filtered[1])
    result = replace(result, timestamps_s=given_s)
    if isinstance(run.sequence, FileSequence | VideoSequence):  # frames in memory are all there
        result = result.with_repeated(run.sequence.repeated)
    failure = None if result.maps else no_map(run, result)
    report = write_odometry(run, result, failure)
    if events.is_cancelled and live_counts(run.sequence) is None:
        where = f"what was tracked so far is in {run.workspace.folder}"
        raise InterruptedRunError("stopped on request", f"{where}; the same command begins again")
    if failure is not None:
        raise failure
    return TrackResult(result, report)


def no_map(run: Tracking, result: OdometryResult) -> NoReconstructionError:
    """Why nothing came of it, as well as it can be told."""
    seen = len(result.frame_idx)
    if seen < 2:
        found = "no frame could be read" if seen == 0 else "only one frame could be read"
        return NoReconstructionError(f"{run.shown}: {found}", "-v names the files and what is wrong with them")
    num_repeated = int((result.frame_state == FrameState.REPEATED).sum())
    if num_repeated == seen - 1:
        return NoReconstructionError(f"{run.source}: all {seen} frames show the same picture", NO_MAP_ADVICE)
    text = f"{run.shown}: {seen} frames were read, but no map could be initialized"
    if (report := result.report) is None:
        return NoReconstructionError(text, NO_MAP_ADVICE)
    for against in report.pairs:
        return NoReconstructionError(f"{text}: {against.message}", against.advice)
    if report.looked_still >= _MOST_FRAMES * (seen - num_repeated):
        text += ": the camera stands still, the picture hardly moves"
    elif report.looked_turned >= _MOST_FRAMES * (seen - num_repeated):
        text += ": the camera turns on the spot, or everything is too far away for how far it moves"
    return NoReconstructionError(text, NO_MAP_ADVICE)


class Watched:
    """A sequence that ends early when the run is asked to stop, and on whose frames the clocks are read.

    Its time is the one that has elapsed since it began, where all its parts know that: where a clock begins has no part
    in the result.
    """

    kind: SequenceKind
    source: str
    rig: Rig
    num_frames: int | None
    frames_per_second: float | None
    imu: Imu | None
    ground_truth: GroundTruth | None
    orientation: int

    def __init__(self, sequence: Sequence, run: Tracking) -> None:
        for name in ("kind", "source", "rig", "num_frames", "frames_per_second", "imu", "ground_truth", "orientation"):
            setattr(self, name, getattr(sequence, name))
        self._sequence, self._run = sequence, run
        self._given_s: dict[int, float] = {}
        self._is_relative = self.imu is None or self.imu.elapsed_s is not None
        if self.imu is not None and self.imu.elapsed_s is not None:
            self.imu = replace(self.imu, timestamps_s=self.imu.elapsed_s, elapsed_s=None)

    def times_as_given(self, result: OdometryResult) -> NDArray[np.float64]:
        """(F,) times of the frames of a result on the sequence's own clock."""
        return np.array([self._given_s[int(idx)] for idx in result.frame_idx], np.float64)

    def frames(self) -> Iterator[Frame]:
        """See :class:`~sfmapp.images.sequence.Sequence`."""
        frames = self._sequence.frames()
        try:
            for frame in frames:
                self._run.threads_cpu.sample()
                if self._run.events.is_cancelled:
                    self._run.events.warned("odometry", f"stopped on request before {frame.name}")
                    return
                self._given_s[frame.idx] = frame.timestamp_s
                elapsed_s = frame.elapsed_s if self._is_relative else None
                yield frame if elapsed_s is None else replace(frame, timestamp_s=elapsed_s, given_s=frame.timestamp_s)
        finally:
            self._run.threads_cpu.frames_ended()  # while the thread that reads ahead is still there
            frames.close()  # type: ignore[attr-defined]  # a generator: ends its thread
