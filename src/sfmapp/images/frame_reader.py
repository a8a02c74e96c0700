"""Frames from image files, decoded ahead of whoever walks through them."""

from __future__ import annotations

import os
import stat
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.events import Events
from sfmapp.images.headers import Header, UnusableImage, read_header
from sfmapp.images.pixels import decode_bytes
from sfmapp.images.sequence import STAGE, Frame, GroundTruth, Imu, RepeatedFrame, SequenceKind
from sfmapp.scene.rig import Rig

Pixels = NDArray[np.uint8]
Item = TypeVar("Item")

# What may lie decoded at a time. Each frame of a stereo pair of 1241x376 takes a megabyte.
_FRAMES_AHEAD = 4
_LARGEST_FILE_BYTES = 1 << 28
LARGEST_FRAME_PX = 100_000_000
"""A frame that claims more pixels is not decoded: four of them lie in memory at a time."""
# Problems told one by one; the summary at the end holds the names of all.
_PROBLEMS_TOLD = 8
REPEATED = "repeats the frame before it"


@dataclass(frozen=True)
class Skipped:
    """A frame that is left out: its name, the reason, a phrase that follows it and a colon, and what it repeats, if it
    is for that."""

    name: str
    reason: str
    repeated: RepeatedFrame | None = None


def skipped_twin(idx: int, name: str, timestamp_s: float, twin_idx: int) -> Skipped:
    """A frame that is left out because it repeats another."""
    return Skipped(name, REPEATED, RepeatedFrame(idx, name, timestamp_s, twin_idx))


def read_ahead(read_next: Callable[[], Item | None]) -> Iterator[Item]:
    """What ``read_next`` returns until None, a few calls ahead of the consumer in one thread of its own.

    The calls are made one after another, so that the order and every result are those of a plain loop. If the consumer
    stops early (or fails), closing the generator waits for the call that is under way and makes no other.
    """
    pool = ThreadPoolExecutor(1, "frames")
    ahead: deque[Future[Item | None]] = deque()
    try:
        for _ in range(_FRAMES_AHEAD):
            ahead.append(pool.submit(read_next))
        while (item := ahead.popleft().result()) is not None:
            ahead.append(pool.submit(read_next))
            yield item
    finally:
        pool.shutdown(cancel_futures=True)


class ProblemReporter:
    """Warns of frames that are left out: once however often the sequence is played.

    Attributes:
        repeated: of the present walk, those that are left out because they repeat the one before them.
    """

    def __init__(self, events: Events) -> None:
        self.repeated: list[RepeatedFrame] = []
        self._events = events
        self._told: set[str] = set()
        self._is_summarised = False

    def frames_without_problems(self, items: Iterator[Frame | Skipped]) -> Iterator[Frame]:
        """The frames among the items; problems are told in the consumer's thread, in the order of the frames."""
        problems: list[Skipped] = []
        num_frames = 0
        self.repeated = []
        try:
            for item in items:
                if isinstance(item, Frame):
                    num_frames += 1
                    yield item
                    continue
                problems.append(item)
                if item.repeated is not None:
                    self.repeated.append(item.repeated)
                if item.reason != REPEATED and item.name not in self._told and len(self._told) < _PROBLEMS_TOLD:
                    self._told.add(item.name)
                    self._events.warned(STAGE, f"skipped {item.name}: {item.reason}", name=item.name)
        finally:
            items.close()  # type: ignore[attr-defined]  # a generator: ends its thread
            if problems and not self._is_summarised:
                self._is_summarised = True
                self._summarise(problems, num_frames + len(problems))

    def _summarise(self, problems: list[Skipped], num_seen: int) -> None:
        repeated = [problem.name for problem in problems if problem.reason == REPEATED]
        broken = [problem.name for problem in problems if problem.reason != REPEATED]
        if broken:
            text = f"{len(broken)} of {num_seen} frames could not be used: {some(broken)}"
            self._events.warned(STAGE, text, names=broken)
        if repeated:
            which = f"{len(repeated)} of {num_seen} frames"
            text = f"{which} repeat the one before them, whose pose they have: {some(repeated)}"
            self._events.warned(STAGE, text, names=repeated)


def some(names: list[str]) -> str:
    """The first few names, and how many more there are."""
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def read_regular_file(path: Path) -> bytes:
    """The bytes of a file. Raises UnusableImage if it is none, too large, or cannot be read."""
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):  # opening a pipe would wait forever
            raise UnusableImage("not a regular file")
        if status.st_size > _LARGEST_FILE_BYTES:
            raise UnusableImage(f"larger than {_LARGEST_FILE_BYTES} bytes")
        return path.read_bytes()
    except FileNotFoundError:
        raise UnusableImage("no such file") from None
    except (OSError, ValueError) as error:
        raise UnusableImage(f"cannot be read: {getattr(error, 'strerror', None) or error}") from error


def decode_gray(data: bytes, header: Header, white: int) -> tuple[Pixels, int]:
    """(H, W) uint8 of an image file's bytes as stored (EXIF's orientation is not obeyed), and the new ``white``.

    Args:
        white: largest value that deeper files of this sequence were found to reach, 255 to begin with. It only grows,
            so that a sequence of 12 bits in 16 does not change its brightness with what is in view.

    Raises:
        UnusableImage: the data are damaged.
    """
    import cv2

    if header.bits <= 8 and header.format != "tiff" and header.kind != "cmyk":
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        try:
            gray = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        except (cv2.error, MemoryError):
            gray = None
    else:
        raw = decode_bytes(data, header)
        if raw is not None and raw.dtype == np.uint16:
            raw, white = scaled_to_8_bits(raw, white)
        gray = raw
        if raw is not None and raw.ndim == 3:
            gray = cv2.cvtColor(raw, cv2.COLOR_RGBA2GRAY if raw.shape[2] == 4 else cv2.COLOR_RGB2GRAY)
    if gray is None or gray.shape != (header.height, header.width):
        raise UnusableImage("cannot be decoded: its data are damaged")
    return gray, white


def scaled_to_8_bits(raw: NDArray[np.uint16], white: int) -> tuple[Pixels, int]:
    """uint16 values as uint8, with rounding, and the smallest white of 8, 10, 12, 14 or 16 bits that holds them all."""
    largest = max(white, int(raw.max(initial=0)))
    white = next(value for bits in (8, 10, 12, 14, 16) if largest <= (value := (1 << bits) - 1))
    table = ((np.arange(white + 1, dtype=np.int64) * 510 + white) // (2 * white)).astype(np.uint8)
    return table[raw], white


def resampled(gray: Pixels, sampling: NDArray[np.float32] | None) -> Pixels:
    """The frame (H, W) whose pixels lie at ``sampling`` (H, W, 2) in the file's (OpenCV's pixel rule), bilinearly; the
    frame itself without sampling. It makes the frames of a lens with many coefficients those of a simpler one."""
    if sampling is None:
        return gray
    import cv2

    image: Pixels = cv2.remap(gray, sampling, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return image


class FileReader:
    """One walk over the frames of files; called from the thread that reads ahead. Other containers override how the
    bytes of a frame are had (:meth:`read_bytes`) and what they show (:meth:`decode`)."""

    def __init__(self, sequence: FileSequence) -> None:
        self._sequence = sequence
        self._idx = 0
        self._white = [255] * len(sequence.rig.cameras)
        self._last_bytes: tuple[bytes, ...] = ()
        self._last_images: tuple[Pixels, ...] = ()
        self._last_idx = -1

    def __call__(self) -> Frame | Skipped | None:
        sequence, idx = self._sequence, self._idx
        if idx >= len(sequence.paths):
            return None
        self._idx += 1
        name, timestamp_s = sequence.names[idx], float(sequence.timestamps_s[idx])
        data: list[bytes] = []
        images: list[Pixels] = []
        try:
            data.extend(self.read_bytes(idx))
            if tuple(data) == self._last_bytes:
                return skipped_twin(idx, name, timestamp_s, self._last_idx)
            images.extend(map(self._decode, range(len(data)), data))
        except UnusableImage as reason:
            # what was read so far tells which of the files is at fault
            camera = len(images) if len(data) == len(sequence.paths[idx]) else len(data)
            beside = f"{self.name_of(idx, camera)} of camera {camera}: " if camera else ""
            return Skipped(name, f"{beside}{reason}")
        is_repeated = bool(self._last_images) and all(map(np.array_equal, images, self._last_images))
        self._last_bytes, self._last_images = tuple(data), tuple(images)
        if is_repeated:
            return skipped_twin(idx, name, timestamp_s, self._last_idx)
        self._last_idx = idx
        elapsed_s = None if sequence.elapsed_s is None else float(sequence.elapsed_s[idx])
        return Frame(idx, name, timestamp_s, tuple(images), elapsed_s)

    def name_of(self, idx: int, camera_idx: int) -> str:
        """What an image of a frame is called."""
        return self._sequence.paths[idx][camera_idx].name

    def read_bytes(self, idx: int) -> Iterator[bytes]:
        """Of the images of a frame, one after another. Raises UnusableImage: one cannot be read."""
        return map(read_regular_file, self._sequence.paths[idx])

    def decode(self, camera_idx: int, data: bytes, white: int) -> tuple[Pixels, int]:
        """(H, W) grey of an image's bytes, and the new ``white`` as of :func:`decode_gray`. Raises UnusableImage."""
        return decode_file_of(self._sequence.rig.cameras[camera_idx], data, white)

    def _decode(self, camera_idx: int, data: bytes) -> Pixels:
        gray, self._white[camera_idx] = self.decode(camera_idx, data, self._white[camera_idx])
        return resampled(gray, self._sequence.sampling[camera_idx])


def decode_file_of(camera: Camera, data: bytes, white: int) -> tuple[Pixels, int]:
    """:func:`decode_gray` of an image file that has to have the size of a camera. Raises UnusableImage."""
    header = read_header(data)
    check_size(header.width, header.height, camera)
    return decode_gray(data, header, white)


def check_size(width: int, height: int, camera: Camera) -> None:
    """Raise UnusableImage if an image is not of the size of its camera: before it is decoded."""
    if (width, height) != (camera.width, camera.height):
        raise UnusableImage(f"{width}x{height} pixels, where the camera has {camera.width}x{camera.height}")


@dataclass
class FileSequence:
    """A :class:`~sfmapp.images.sequence.Sequence` of image files.

    Attributes:
        names: N names of frames.
        timestamps_s: (N,) strictly ascending.
        paths: for each frame, one file for each camera of the rig; that of the first alone where the others lack it.
        sampling: for each camera, where the pixels of its frames are found in the files, see :func:`resampled`.
        events: told about frames that are left out.
        elapsed_s: (N,) see :class:`~sfmapp.images.sequence.Frame`.
        orientation: that EXIF gives the first; frames are those of the files all the same.
    """

    kind: SequenceKind
    source: str
    rig: Rig
    names: list[str]
    timestamps_s: NDArray[np.float64]
    paths: list[tuple[Path, ...]]
    sampling: tuple[NDArray[np.float32] | None, ...]
    frames_per_second: float | None
    imu: Imu | None
    ground_truth: GroundTruth | None
    events: Events
    elapsed_s: NDArray[np.float64] | None = None
    orientation: int = 1
    num_frames: int | None = field(init=False)

    def __post_init__(self) -> None:
        self.num_frames = len(self.names)
        self._teller = ProblemReporter(self.events)

    @property
    def repeated(self) -> list[RepeatedFrame]:
        """Frames that the present walk has left out so far, because they repeat the one before them."""
        return self._teller.repeated

    def frames(self) -> Iterator[Frame]:
        """See :class:`~sfmapp.images.sequence.Sequence`."""
        return self._teller.frames_without_problems(read_ahead(FileReader(self)))
