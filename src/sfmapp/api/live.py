"""Odometry on frames that a program pushes as they come: the pose of each as soon as it is known."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import replace
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from numpy.typing import ArrayLike, NDArray

from sfmapp.api.jobs import TrackResult, options_with, track_sequence
from sfmapp.errors import UsageError
from sfmapp.events import Events
from sfmapp.images.imu_stream import ImuStream
from sfmapp.images.live_sequence import LiveSequence
from sfmapp.workspace.options import Options

if TYPE_CHECKING:
    from sfmapp.camera.camera import Camera
    from sfmapp.images.sequence import Imu
    from sfmapp.odometry.inertial.filtering import FilteredPose
    from sfmapp.odometry.snapshot import FrameSnapshot
    from sfmapp.report.model import LiveReport
    from sfmapp.scene.rig import Rig


class LiveOdometry:
    """A camera, or a stereo rig, that is tracked while its frames come; a context manager that closes itself.

    Pushing never waits. While a frame is tracked the next ones wait, two at most; where another comes, the oldest of
    them is dropped and counted, so that poses stay young and memory stays what it is. Which frames are dropped hangs on
    the machine, and so does the result then.

    Args:
        camera: what takes the frames, or the rig of it.
        output: folder of the results, as of :func:`track_sequence`; poses are in ``trajectory_live.tum`` as soon as
            they are known. None: nothing is written.
        options: of these, ``odometry`` and ``scale``.
        imu: how a sensor is mounted and how noisy it is, whose measurements are pushed (:meth:`push_imu`); its arrays
            may be empty. Poses are filtered with it, as by ``odometry.filter=true``.
        on_filtered: called with each pose at the rate of the sensor, as soon as its sample is there and the first
            seconds have told scale, gravity and biases; in metres, in the world of the live poses at that time. In
            the thread that pushes or the one that tracks, never in both at once. What it raises, these raise.
        on_pose: called with each frame that was tracked, in the thread that tracks, which waits for it:
            ``cam_from_world`` (7,), NaN without a pose, ``timestamp_s``, ``latency_s``, ``state``. What it raises ends
            the run.
        record: write ``recording.rrd``, which replays the run.
        events: told of everything that happens; a wish to stop is one to close.
        threads, seed: as of :func:`track_sequence`.

    Raises:
        UsageError: the output folder holds something else, or another run is at work in it.

    Example:
        >>> with sfmapp.LiveOdometry(camera, "track", on_pose=lambda frame: steer(frame.cam_from_world)) as odometry:
        ...     while (image := device.read()) is not None:
        ...         odometry.push(image, device.time_s)
        >>> odometry.close().odometry.cam_from_world
    """

    def __init__(
        self,
        camera: Camera | Rig,
        output: str | os.PathLike[str] | None = None,
        options: Options | None = None,
        *,
        imu: Imu | None = None,
        on_pose: Callable[[FrameSnapshot], None] | None = None,
        on_filtered: Callable[[FilteredPose], None] | None = None,
        record: bool = True,
        events: Events | None = None,
        threads: int | None = None,
        seed: int | None = None,
    ) -> None:
        from sfmapp.pipelines.odometry.live import LatencyLog

        if imu is None and on_filtered is not None:
            raise UsageError(
                "poses at the rate of a sensor need a sensor", "say with imu= how it is mounted and how noisy"
            )
        self._stream = None if imu is None else ImuStream(imu)
        self._sequence = LiveSequence(camera, events or Events(), imu_stream=self._stream, on_filtered=on_filtered)
        self._latencies = LatencyLog()
        if imu is not None:
            options = options or Options()
            options = replace(options, odometry=replace(options.odometry, filter=True))
        self._on_pose = on_pose
        self._latest: FrameSnapshot | None = None
        self._result: TrackResult | None = None
        self._failure: BaseException | None = None
        # what is asked to stop is the sequence: what was tracked of it is finished
        events = None if events is None else events.without_cancellation()
        arguments = (output, options_with(options, threads, seed), record, events or Events())
        self._thread = threading.Thread(target=self._run, args=arguments, name="odometry", daemon=True)
        self._thread.start()
        while self._thread.is_alive() and not self._sequence.is_walked.wait(0.05):
            pass
        if self._failure is not None:
            raise self._failure

    @property
    def latest(self) -> FrameSnapshot | None:
        """The frame that was tracked last; None before the first."""
        return self._latest

    @property
    def report(self) -> LiveReport:
        """How many frames came and were dropped, and how old poses were, so far."""
        return self._latencies.report(self._sequence.counts)

    def push(self, images: NDArray[Any] | tuple[NDArray[Any], ...], timestamp_s: float | None = None) -> None:
        """Add a frame, from any thread; it is copied.

        Args:
            images: (H, W) grey or (H, W, 3) RGB of uint8 or uint16, or, of a rig, a tuple with one for each camera.
            timestamp_s: when it was taken, seconds, strictly ascending; None: when it is pushed, since the first one.

        Raises:
            InputError: an array of another shape than its camera's, or a time that does not ascend. The frame is left
                out, and the run goes on.
            UsageError: the run has ended. What it has ended with, if it was a failure, is raised instead.
        """
        if not self._thread.is_alive():
            if self._failure is not None:
                raise self._failure
            raise UsageError(f"a frame was pushed into a run that has ended: {self._sequence.counts.end}")
        self._sequence.push(images, timestamp_s)

    def push_imu(self, timestamp_s: float, gyro: ArrayLike, accel: ArrayLike) -> None:
        """Add a sample of the sensor, from any thread; it never waits for a frame.

        Args:
            timestamp_s: on the clock of the frames, seconds, strictly ascending. Frames may come later than samples of
                their time, and are of most use when no sample of theirs is still missing.
            gyro, accel: (3,) rad/s and m/s^2 in the sensor's own frame, gravity included.

        Raises:
            InputError: a time that does not ascend, or numbers that are none. The sample is left out.
            UsageError: no sensor was named, or the run has ended.
        """
        if self._stream is None:
            raise UsageError("a sample of an IMU was pushed, but no IMU was named", "say with imu= how it is mounted")
        if not self._thread.is_alive():
            if self._failure is not None:
                raise self._failure
            raise UsageError(f"a sample was pushed into a run that has ended: {self._sequence.counts.end}")
        self._stream.push(timestamp_s, gyro, accel)

    def close(self) -> TrackResult:
        """No more frames: waits for the closing adjustment, and for what is written.

        Raises:
            NoReconstructionError: no map could be made; the report is written.
        """
        self._sequence.end("closed")
        self._thread.join()
        if self._failure is not None:
            raise self._failure
        assert self._result is not None
        return self._result

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:  # what was tracked is kept, and what has happened is told
            self._sequence.end(f"{type(error).__name__} in the program that pushes")
            self._thread.join()

    def _run(self, output: str | os.PathLike[str] | None, options: Options, record: bool, events: Events) -> None:
        from sfmapp.workspace.kernels import compile_odometry_kernels

        try:
            if output is None:
                compile_odometry_kernels(
                    events, inertial=self._stream is not None
                )  # before frames come, which would be dropped
            self._result = track_sequence(
                self._sequence, output, options, record=record, on_frame=self._note, events=events
            )
        except BaseException as error:
            self._failure = error
        finally:
            self._sequence.end("the run has failed")

    def _note(self, frame: FrameSnapshot) -> None:
        self._latest = frame
        self._latencies.note(frame)
        if self._on_pose is not None:
            self._on_pose(frame)
