"""Frames from a video file, a stream or a camera, read by OpenCV (FFmpeg, or the system's driver for a camera)."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError, UsageError
from sfmapp.events import Events
from sfmapp.images.frame_reader import LARGEST_FRAME_PX, REPEATED, ProblemTeller, Skipped, read_ahead, resampled
from sfmapp.images.sequence import Frame, Imu, SequenceKind, SequenceOptions, Truth
from sfmapp.images.sources import printable
from sfmapp.scene.rig import Rig

_STREAM = re.compile(r"(rtsps?|rtmps?|https?|udp|tcp|srt|rtp)://", re.IGNORECASE)
_DEVICE = re.compile(r"camera:(\d{1,3})|/dev/video(\d{1,3})")
DEFAULT_FPS = 30.0
_OPEN_TIMEOUT_MS, _READ_TIMEOUT_MS = 15_000, 15_000
# A file that ends this much before the number of frames in its header was cut off; headers err by a few.
_CUT_OFF_SHARE = 0.98


def is_stream(source: str) -> bool:
    """Whether a source is a URL or a camera (``camera:0``, ``/dev/video0``), rather than a path."""
    return bool(_STREAM.match(source) or _DEVICE.fullmatch(source))


@dataclass(frozen=True)
class VideoFacts:
    """What a video says of itself: size in pixels once turned upright, rate and number of frames, None for unknown."""

    width: int
    height: int
    fps: float | None
    num_frames: int | None


def _open(source: str) -> Any:
    """An opened ``cv2.VideoCapture``, turned upright as its metadata say. Raises InputError."""
    import cv2

    device = _DEVICE.fullmatch(source)
    if any("\ud800" <= letter <= "\udfff" for letter in source):  # OpenCV would crash
        raise InputError(f"{printable(source)}: expected a name in UTF-8, found other bytes in it", "rename it")
    if device:
        capture = cv2.VideoCapture(int(device[1] or device[2]))
    else:
        # FFmpeg alone: another backend would take a name with a % for a pattern of image files
        timeouts = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _OPEN_TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _READ_TIMEOUT_MS]
        capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, timeouts if is_stream(source) else [])
    if not capture.isOpened():
        capture.release()
        raise InputError(
            f"{printable(source)}: expected a video that OpenCV can read, found none",
            "try to play it, or convert it: ffmpeg -i VIDEO -c:v libx264 video.mp4",
        )
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    width, height = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
    if not 0 < width * height <= LARGEST_FRAME_PX:
        capture.release()
        raise InputError(
            f"{printable(source)}: expected frames of at most {LARGEST_FRAME_PX} pixels, found {width:g}x{height:g}"
        )
    return capture


def read_video_facts(source: str) -> VideoFacts:
    """Size, rate and length of a video; its first frame is decoded to be sure of its size.

    Raises:
        InputError: it cannot be opened, holds no frame, or its size cannot be believed.
    """
    import cv2

    capture = _open(source)
    try:
        is_read, image = capture.read()
        if not is_read or image is None:
            raise InputError(f"{printable(source)}: expected a video with frames, found none that can be decoded")
        fps, count = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
        known_fps = float(fps) if math.isfinite(fps) and 0.01 <= fps <= 1e4 else None
        is_counted = not is_stream(source) and math.isfinite(count) and 1 <= count < 1e9
        return VideoFacts(image.shape[1], image.shape[0], known_fps, int(count) if is_counted else None)
    finally:
        capture.release()


@dataclass
class VideoSequence:
    """A :class:`~sfmapp.images.sequence.Sequence` of a video. A stream or camera can be walked through once.

    Frames are stamped with the time that the file gives them; where that does not advance, with the nominal rate; of a
    stream or camera with the clock, from the first frame on.
    """

    source: str
    rig: Rig
    facts: VideoFacts
    options: SequenceOptions
    events: Events
    sampling: tuple[NDArray[np.float32] | None, ...] = (None,)
    imu: Imu | None = None
    truth: Truth | None = None
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
        self._teller = ProblemTeller(self.events)

    def frames(self) -> Iterator[Frame]:
        """See :class:`~sfmapp.images.sequence.Sequence`."""
        return self._teller.frames_without_problems(self._items())

    def _items(self) -> Iterator[Frame | Skipped]:
        reader = _VideoReader(self)
        try:
            yield from read_ahead(reader)
        finally:
            reader.close()


def _length(options: SequenceOptions) -> int | None:
    return None if options.stop is None else options.stop - options.start


class _VideoReader:
    """One walk through a video; called from the thread that reads ahead."""

    def __init__(self, video: VideoSequence) -> None:
        self._video = video
        self._is_live = is_stream(video.source)
        self._capture: Any = None
        self._position = 0  # of the next frame in the file
        self._idx = 0
        self._last: NDArray[np.uint8] | None = None
        self._last_s = -math.inf
        self._start = 0.0
        self._has_ended = False

    def close(self) -> None:
        """Give the file back."""
        if self._capture is not None:
            self._capture.release()

    def __call__(self) -> Frame | Skipped | None:
        import cv2

        options = self._video.options
        if self._capture is None:
            self._capture = _open(self._video.source)
            self._start = time.monotonic()
        position = options.start + self._idx * options.step
        if self._has_ended or (options.stop is not None and position >= options.stop):
            return None
        while self._position < position:
            if not self._capture.grab():
                return self._end()
            self._position += 1
        is_read, image = self._capture.read()
        if not is_read or image is None:
            return self._end()
        self._position += 1
        idx, name = self._idx, f"{position:06d}"
        self._idx += 1
        stamp = self._timestamp(position, self._capture.get(cv2.CAP_PROP_POS_MSEC))
        gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
        camera = self._video.rig.cameras[0]
        if gray.shape != (camera.height, camera.width) or gray.dtype != np.uint8:
            return Skipped(name, f"{gray.shape[1]}x{gray.shape[0]} pixels, where the video began with other ones")
        if self._last is not None and np.array_equal(gray, self._last):
            return Skipped(name, REPEATED)
        self._last, self._last_s = gray, stamp
        return Frame(idx, name, stamp, (resampled(gray, self._video.sampling[0]),))

    def _timestamp(self, position: int, position_ms: float) -> float:
        fps = self._video.options.fps
        if fps is not None:
            return position / fps
        if self._is_live:
            return max(time.monotonic() - self._start, self._last_s + 1e-6)
        stamp = position_ms / 1000
        if math.isfinite(stamp) and stamp > self._last_s:
            return stamp
        step = 1 / (self._video.facts.fps or DEFAULT_FPS)
        return max(self._last_s + step * self._video.options.step, 0.0)

    def _end(self) -> Skipped | None:
        expected, is_early = self._video.facts.num_frames, False
        if expected is not None and self._video.options.stop is None and not self._has_ended:
            is_early = self._position < _CUT_OFF_SHARE * expected
        self._has_ended = True
        if not is_early:
            return None
        return Skipped(f"{self._position:06d}", f"the video ends here, after {self._position} of {expected} frames")
