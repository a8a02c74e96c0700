"""Frames from a video file or stream, read by FFmpeg, or from a camera, read by OpenCV with the system's driver."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError, UsageError
from sfmapp.events import Events
from sfmapp.images.containers import (
    Damaged,
    VideoFacts,
    decoded_frames,
    gray_of,
    open_container,
    read_container_facts,
    shown,
)
from sfmapp.images.frame_reader import (
    LARGEST_FRAME_PX,
    ProblemReporter,
    Skipped,
    read_ahead,
    resampled,
    skipped_twin,
)
from sfmapp.images.live_buffer import LiveBuffer, LiveCounts, read_newest
from sfmapp.images.sequence import STAGE, Frame, GroundTruth, Imu, RepeatedFrame, SequenceKind, SequenceOptions
from sfmapp.images.sources import VIDEOS
from sfmapp.scene.rig import Rig

Pixels = NDArray[np.uint8]

_STREAM = re.compile(r"(rtsps?|rtmps?|https?|udp|tcp|srt|rtp)://", re.IGNORECASE)
_DEVICE = re.compile(r"camera:(\d{1,3})|/dev/video(\d{1,3})")
DEFAULT_FPS = 30.0
# A file that ends this much before the end in its header was cut off; headers err by a little.
_CUT_OFF_SHARE = 0.98
# A camera or stream that gives nothing for so long has ended: drivers and FFmpeg give up after 10 to 15 seconds.
STALL_S = 10.0


def is_stream(source: str) -> bool:
    """Whether a source is a URL or a camera (``camera:0``, ``/dev/video0``), rather than a path."""
    return bool(_STREAM.match(source) or _DEVICE.fullmatch(source))


def is_video(source: str) -> bool:
    """Whether a source is a video file, by its ending, or a stream or camera, rather than photographs."""
    return is_stream(source) or PurePath(source).suffix.lower() in VIDEOS


def sharpness(gray: Pixels) -> float:
    """A number that is greater for the sharper one of two frames that show the same."""
    import cv2

    step = max(1, max(gray.shape) // 640)
    return float(cv2.Laplacian(np.ascontiguousarray(gray[::step, ::step]), cv2.CV_32F).var())


def _open_device(source: str) -> Any:
    """An opened ``cv2.VideoCapture`` of a camera. Raises InputError."""
    import cv2

    device = _DEVICE.fullmatch(source)
    assert device is not None
    capture = cv2.VideoCapture(int(device[1] or device[2]))
    if not capture.isOpened():
        capture.release()
        raise InputError(
            f"{source}: expected a camera that can be read, found none", "check whether another program uses it"
        )
    width, height = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
    if not 0 < width * height <= LARGEST_FRAME_PX:
        capture.release()
        raise InputError(f"{source}: expected frames of at most {LARGEST_FRAME_PX} pixels, found {width:g}x{height:g}")
    return capture


def read_video_facts(source: str) -> VideoFacts:
    """Size, rate and length of a video; its first frame is decoded to be sure of its size.

    Raises:
        InputError: it cannot be opened, holds no frame, or its size cannot be believed.
    """
    if _DEVICE.fullmatch(source) is None:
        return read_container_facts(source, is_stream=is_stream(source))
    import cv2

    capture = _open_device(source)
    try:
        is_read, image = capture.read()
        if not is_read or image is None:
            raise InputError(f"{source}: expected a camera that gives frames, found one that gives none")
        fps = capture.get(cv2.CAP_PROP_FPS)
        known_fps = float(fps) if math.isfinite(fps) and 0.01 <= fps <= 1e4 else None
        return VideoFacts(image.shape[1], image.shape[0], known_fps, None)
    finally:
        capture.release()


# Pixels are made where they are wanted alone: (H, W) grey, and the time in seconds that the source gives, or None.
_Walk = Iterator["_Unread | Damaged"]


@dataclass(frozen=True)
class _Unread:
    """A frame of which it is not yet known whether it is wanted; ``captured_s``: of a camera, when it was there."""

    gray: Callable[[], Pixels]
    time_s: Fraction | None
    captured_s: float | None = None


def _walk_through(source: str) -> _Walk:
    """The frames of a source, one after another. Raises InputError: it cannot be opened."""
    if _DEVICE.fullmatch(source) is not None:
        yield from _frames_of_device(source)
        return
    with closing(open_container(source, is_stream=is_stream(source))) as container:
        for item in decoded_frames(container):
            yield item if isinstance(item, Damaged) else _Unread(partial(gray_of, item), item.time_s)


def _frames_of_device(source: str) -> _Walk:
    import cv2

    capture = _open_device(source)
    try:
        while capture.grab():
            captured_s = time.monotonic()
            is_read, image = capture.retrieve()
            if not is_read or image is None:
                return
            gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
            yield _Unread(partial(np.asarray, gray), None, captured_s)
    finally:
        capture.release()


def missing_end(facts: VideoFacts, span_s: tuple[float, float] | None, num_frames: int) -> str:
    """How much there was of a file that ended before the end that its header names; empty if it did not.

    Args:
        facts: of the header. span_s: times of the first and the last frame; None: they have none.
        num_frames: that there were.
    """
    if span_s is not None and facts.end_s is not None:
        first, last = span_s[0], span_s[1] + 1 / (facts.fps or DEFAULT_FPS)
        # of a clock that begins late, headers count from its beginning or from zero
        length = facts.end_s - first if facts.end_s > first else facts.end_s
        if last - first < _CUT_OFF_SHARE * length:
            return f"after {last - first:.1f} of {length:.1f} s"
    elif facts.num_frames is not None and num_frames < _CUT_OFF_SHARE * facts.num_frames:
        return f"after {num_frames} of {facts.num_frames} frames"
    return ""


@dataclass
class VideoSequence:
    """A :class:`~sfmapp.images.sequence.Sequence` of a video. A stream or camera can be walked through once; of its
    frames those are dropped that come faster than they are taken.

    Frames are stamped with the time that the file gives them; where that does not advance, with the nominal rate; of a
    stream or camera with the clock, from the first frame on.
    """

    source: str = field(repr=False)  # it may hold a password
    rig: Rig
    facts: VideoFacts
    options: SequenceOptions
    events: Events
    sampling: tuple[NDArray[np.float32] | None, ...] = (None,)
    imu: Imu | None = None
    ground_truth: GroundTruth | None = None
    kind: SequenceKind = "video"
    orientation: int = 1
    num_frames: int | None = field(init=False)
    frames_per_second: float | None = field(init=False)

    def __post_init__(self) -> None:
        if self.options.reverse:
            raise UsageError("reverse is not possible with a video", "extract its frames to a folder first")
        total = self.facts.num_frames
        played = range(self.options.start, total if total is not None else 0)[: _length(self.options)]
        self.num_frames = len(played[:: self.options.step]) if total is not None else None
        fps = self.options.fps or self.facts.fps
        self.frames_per_second = fps / self.options.step if fps else None
        self._teller = ProblemReporter(self.events)
        self._buffer = LiveBuffer() if is_stream(self.source) else None

    @property
    def counts(self) -> LiveCounts | None:
        """What has come of a stream or camera so far; None of a file."""
        return None if self._buffer is None else self._buffer.counts

    @property
    def repeated(self) -> list[RepeatedFrame]:
        """Frames that the present walk has left out so far, because they repeat the one before them."""
        return self._teller.repeated

    def frames(self) -> Iterator[Frame]:
        """See :class:`~sfmapp.images.sequence.Sequence`."""
        return self._teller.frames_without_problems(self._items())

    def _items(self) -> Iterator[Frame | Skipped]:
        reader = _VideoReader(self)
        if self._buffer is not None:
            yield from read_newest(reader, self._buffer, lambda: not self.events.is_cancelled, STALL_S)
            self.events.decided(STAGE, f"{shown(self.source)}: {self._buffer.counts.end}")
            return
        try:
            ahead: Iterator[Frame | Skipped] = read_ahead(reader)
            yield from ahead
        finally:
            reader.close()


def _length(options: SequenceOptions) -> int | None:
    return None if options.stop is None else options.stop - options.start


class _VideoReader:
    """One walk through a video; called from the thread that reads ahead."""

    def __init__(self, video: VideoSequence) -> None:
        self._video = video
        self._is_live = is_stream(video.source)
        self._walk: _Walk | None = None
        self._position = 0  # of the next frame in the file
        self._idx = 0
        self._last: Pixels | None = None
        self._last_idx = -1
        self._last_s = -math.inf
        self._seen: list[Fraction] = []  # the first and the last time of the file
        self._origin: Fraction | None = None
        self._start = 0.0
        self._has_ended = False

    def close(self) -> None:
        """Give the file back."""
        if self._walk is not None:
            self._walk.close()  # type: ignore[attr-defined]  # a generator

    def __call__(self) -> Frame | Skipped | None:
        options = self._video.options
        if self._walk is None:
            self._walk = _walk_through(self._video.source)
            self._start = time.monotonic()
        position = options.start + self._idx * options.step
        if self._has_ended or (options.stop is not None and position >= options.stop):
            return None
        while True:
            item = next(self._walk, None)
            if item is None:
                return self._end()
            if isinstance(item, _Unread) and item.time_s is not None:
                self._seen[1:] = [item.time_s]
            self._position += 1
            if self._position > position:
                break
        idx, name = self._idx, f"{position:06d}"
        self._idx += 1
        if isinstance(item, Damaged):
            return Skipped(name, "cannot be decoded: its data are damaged")
        captured_s = (item.captured_s or time.monotonic()) if self._is_live else None
        stamp, gray = self._timestamp(position, item.time_s, captured_s), item.gray()
        elapsed_s = self._elapsed(stamp, item.time_s)
        camera = self._video.rig.cameras[0]
        if gray.shape != (camera.height, camera.width):
            return Skipped(name, f"{gray.shape[1]}x{gray.shape[0]} pixels, where the video began with other ones")
        self._last_s = stamp
        if self._last is not None and np.array_equal(gray, self._last):
            return skipped_twin(idx, name, stamp, self._last_idx)
        self._last, self._last_idx = gray, idx
        return Frame(idx, name, stamp, (resampled(gray, self._video.sampling[0]),), elapsed_s, captured_s=captured_s)

    def _timestamp(self, position: int, time_s: Fraction | None, captured_s: float | None) -> float:
        fps = self._video.options.fps
        if fps is not None:
            return position / fps
        if captured_s is not None:
            return max(captured_s - self._start, self._last_s + 1e-6)
        if time_s is not None and float(time_s) > self._last_s:
            return float(time_s)
        step = 1 / (self._video.facts.fps or DEFAULT_FPS)
        return max(self._last_s + step * self._video.options.step, 0.0)

    def _elapsed(self, stamp: float, time_s: Fraction | None) -> float | None:
        """Seconds since the first frame that is played; None where nothing is more exact than the time stamps."""
        if self._is_live or self._video.options.fps is not None:
            return None
        exact = time_s if time_s is not None and float(time_s) == stamp else Fraction(stamp)
        if self._origin is None:
            self._origin = exact
        return float(exact - self._origin)

    def _end(self) -> Skipped | None:
        """What there is to say of a file that ends before the end that its header names."""
        has_ended, self._has_ended = self._has_ended, True
        if self._video.options.stop is not None or has_ended or self._is_live:
            return None
        span = (float(self._seen[0]), float(self._seen[-1])) if self._seen else None
        where = missing_end(self._video.facts, span, self._position)
        return Skipped(f"{self._position:06d}", f"the video ends here, {where}") if where else None
