"""Some frames of a sequence as photographs, decoded when they are asked for."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any

from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.images.sequence import Frame
from sfmapp.images.sequence import Sequence as FrameSequence

# Frames that lie decoded at a time. Whoever asks for them in their order, from fewer threads, has each decoded once.
MAX_HELD = 32


class SequenceSource:
    """An :class:`~sfmapp.images.image_set.ImageSource` of frames of a sequence, of the rig's first camera.

    A sequence is walked through from its start: frames that are passed on the way to another one are held until they
    are asked for, MAX_HELD at most. One that was passed and is not held has the sequence walked through again.

    Attributes:
        num_found: frames that have come so far.
        renamed: (position, name expected, name found) of the first frame that has another name than was expected, for
            the sequence has changed; None while there is none. The pixels of such a frame are refused.
    """

    def __init__(self, sequence: FrameSequence, name_of_frame: Mapping[int, str]) -> None:
        """``name_of_frame``: names of the frames that are wanted, by their position in the sequence."""
        self.renamed: tuple[int, str, str] | None = None
        self._sequence = sequence
        self._name_of_frame = dict(sorted(name_of_frame.items()))
        self._frame_of_name = {name: idx for idx, name in self._name_of_frame.items()}
        self._held: dict[str, NDArray[Any]] = {}
        self._found: set[str] = set()
        self._walk: Iterator[Frame] | None = None
        self._passed: float = -1
        self._lock = threading.Lock()

    @property
    def num_found(self) -> int:
        """See the class."""
        return len(self._found)

    @property
    def names(self) -> Sequence[str]:
        """See :class:`~sfmapp.images.image_set.ImageSource`; in the order of the sequence."""
        return list(self._frame_of_name)

    def pixels(self, name: str) -> NDArray[Any]:
        """See :class:`~sfmapp.images.image_set.ImageSource`.

        Raises:
            InputError: the sequence does not give the frame, or not under this name.
        """
        idx = self._frame_of_name[name]
        with self._lock:
            if idx <= self._passed and name in self._found and name not in self._held:
                self._stop()
            self._walk_past(idx)
            pixels = self._held.pop(name, None)
        if pixels is None:
            raise InputError(f"{self._sequence.source}: expected a frame {name}, found none")
        return pixels

    def mask(self, name: str) -> None:
        """See :class:`~sfmapp.images.image_set.ImageSource`: frames have none."""

    def __enter__(self) -> SequenceSource:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._lock:
            self._stop()
            self._held.clear()

    def _walk_past(self, idx: int) -> None:
        """Go on until a frame has been passed, holding those that are wanted."""
        if self._walk is None:
            self._walk = self._sequence.frames()
        while self._passed < idx:
            frame = next(self._walk, None)
            self._passed = math.inf if frame is None else frame.idx
            expected = None if frame is None else self._name_of_frame.get(frame.idx)
            if frame is None or expected is None:
                continue
            if frame.name != expected:
                self.renamed = self.renamed or (frame.idx, expected, frame.name)
                continue
            self._found.add(expected)
            self._held[expected] = frame.images[0]
            if len(self._held) > MAX_HELD:
                del self._held[next(iter(self._held))]

    def _stop(self) -> None:
        """Walk no further, which ends the thread that decodes ahead; the next walk begins at the start."""
        if self._walk is not None:
            self._walk.close()  # type: ignore[attr-defined]  # a generator
        self._walk, self._passed = None, -1
