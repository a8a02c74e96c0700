"""Frames that a program pushes as they come, as a sequence: what is late is dropped, and nothing waits for it."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from typing import Any

from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.images.array_sequence import gray_images
from sfmapp.images.imu_stream import ImuStream
from sfmapp.images.live_buffer import LiveBuffer, LiveCounts, taken_from
from sfmapp.images.sequence import Frame, GroundTruth, Imu, SequenceKind
from sfmapp.scene.rig import Rig


class LiveSequence:
    """A :class:`~sfmapp.images.sequence.Sequence` that is filled while it is walked through, once.

    Args:
        camera: what takes the frames, or the rig of them.
        events: a wish to stop ends it.
        imu_stream: what is measured beside the frames. on_filtered: told of each pose that is filtered at the rate of
            these (:class:`~sfmapp.odometry.inertial.filtering.FilteredPose`).
        buffer: where frames wait.
    """

    kind: SequenceKind = "arrays"
    source = "memory://live"
    orientation = 1
    num_frames: int | None = None
    frames_per_second: float | None = None
    imu: Imu | None = None
    ground_truth: GroundTruth | None = None

    def __init__(
        self, camera: Camera | Rig, events: Events, buffer: LiveBuffer | None = None, *,
        imu_stream: ImuStream | None = None, on_filtered: Callable[[Any], None] | None = None,
    ) -> None:  # fmt: skip
        self.rig = camera if isinstance(camera, Rig) else Rig.single(camera)
        self.is_walked = threading.Event()
        self.imu_stream, self.on_filtered = imu_stream, on_filtered
        self._events, self._buffer = events, buffer or LiveBuffer()
        self._lock = threading.Lock()
        self._idx, self._last_s = 0, -math.inf
        self._white = [255] * len(self.rig.cameras)
        self._begin_s: float | None = None

    @property
    def counts(self) -> LiveCounts:
        """What has come so far."""
        return self._buffer.counts

    def push(self, images: NDArray[Any] | tuple[NDArray[Any], ...], timestamp_s: float | None) -> None:
        """Add a frame; see :meth:`sfmapp.LiveOdometry.push`."""
        captured_s = self._buffer.clock()
        with self._lock:
            name = f"{self._idx:06d}"
            if timestamp_s is None and self.imu_stream is not None:
                raise InputError(f"frame {name}: expected its time on the clock of the IMU, found none")
            if timestamp_s is None:
                self._begin_s = captured_s if self._begin_s is None else self._begin_s
                timestamp_s = max(captured_s - self._begin_s, self._last_s + 1e-6)
            if not self._last_s < timestamp_s < math.inf:
                raise InputError(f"frame {name}: expected a time after {self._last_s:g} s, found {timestamp_s:g}")
            pixels = gray_images(name, images, self.rig, self._white)
            self._buffer.put(Frame(self._idx, name, float(timestamp_s), pixels, captured_s=captured_s))
            self._idx, self._last_s = self._idx + 1, timestamp_s

    def end(self, why: str) -> None:
        """No more frames will come."""
        self._buffer.end(why)

    def frames(self) -> Iterator[Frame]:
        """The frames that were not dropped, as they come, until :meth:`end`."""
        self.is_walked.set()
        for item in taken_from(self._buffer, lambda: not self._events.is_cancelled):
            assert isinstance(item, Frame)
            yield item
