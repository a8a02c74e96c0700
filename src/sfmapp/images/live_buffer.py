"""What lies between a camera that does not wait and a tracker that takes its time: a few frames, the newest of all.

A frame that comes while all places are taken pushes the oldest waiting one out: it is dropped, and counted. So memory
is bounded, and so is the age of a frame when it is taken, by the time that the frames before it take.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

from sfmapp.errors import InputError
from sfmapp.images.frame_reader import Skipped
from sfmapp.images.sequence import Frame

# One frame that is next, and one behind it: benchmarks/live.py has what more of them bring and cost.
MAX_WAITING = 2
# Whoever waits for a frame looks that often whether it is still wanted.
_LOOK_S = 0.1
# What a reader that is told to end has time for; one that hangs in a driver is left behind.
_END_S = 2.0


@dataclass(frozen=True)
class LiveCounts:
    """What has come of a live source so far.

    Attributes:
        num_arrived: frames that it gave, whatever became of them.
        num_dropped: of these, those that newer ones pushed out before they could be tracked.
        max_waiting: places for frames that wait.
        longest_silence_s: longest time between two frames, or since the last one when it stalled.
        end: why there are no more: empty while there may be.
    """

    num_arrived: int
    num_dropped: int
    max_waiting: int
    longest_silence_s: float
    end: str


class LiveBuffer:
    """The frames that wait: put in one thread, taken in another.

    Args:
        max_waiting: places. clock: seconds that ascend; frames are stamped with it as they come.
    """

    def __init__(self, max_waiting: int = MAX_WAITING, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self._waiting: deque[Frame | Skipped] = deque()
        self._changed = threading.Condition()
        self._max_waiting = max_waiting
        self._num_arrived = self._num_dropped = 0
        self._last_s: float | None = None
        self._silence_s = 0.0
        self._end: str | None = None
        self._failure: Exception | None = None

    @property
    def counts(self) -> LiveCounts:
        """See :class:`LiveCounts`."""
        with self._changed:
            return LiveCounts(self._num_arrived, self._num_dropped, self._max_waiting, self._silence_s, self._end or "")

    @property
    def is_ended(self) -> bool:
        """Nothing that is put counts any more."""
        return self._end is not None

    def put(self, item: Frame | Skipped) -> None:
        """Add the newest frame; the oldest goes where there is no place. Never waits."""
        with self._changed:
            if self._end is not None:
                return
            self._note_time()
            self._num_arrived += 1
            if len(self._waiting) == self._max_waiting:
                self._waiting.popleft()
                self._num_dropped += 1
            self._waiting.append(item)
            self._changed.notify_all()

    def end(self, why: str, failure: Exception | None = None) -> None:
        """No more will come; what waits can still be taken, and then ``failure`` is raised. The first end counts."""
        with self._changed:
            if self._end is None:
                self._end, self._failure = why, failure
            self._changed.notify_all()

    def take(self, wait_s: float) -> Frame | Skipped | None:
        """The oldest frame that waits; None where none has come for so long, or none will (:attr:`is_ended`)."""
        with self._changed:
            if not self._waiting and self._end is None:
                self._changed.wait(wait_s)
            if self._waiting:
                return self._waiting.popleft()
            if self._failure is not None:
                raise self._failure
            return None

    def silence_s(self) -> float:
        """Seconds since the last frame came, or since this was first asked; with no more to come: 0."""
        with self._changed:
            if self._end is not None:
                return 0.0
            now = self.clock()
            self._last_s = now if self._last_s is None else self._last_s
            self._silence_s = max(self._silence_s, now - self._last_s)
            return now - self._last_s

    def _note_time(self) -> None:
        now = self.clock()
        if self._last_s is not None:
            self._silence_s = max(self._silence_s, now - self._last_s)
        self._last_s = now


def taken_from(
    buffer: LiveBuffer, is_wanted: Callable[[], bool], stall_s: float | None = None
) -> Iterator[Frame | Skipped]:
    """What a buffer gives until it ends, nothing more is wanted, or the source has been silent for ``stall_s``."""
    while is_wanted():
        item = buffer.take(_LOOK_S)
        if item is not None:
            yield item
        elif buffer.is_ended:
            return
        elif stall_s is not None and buffer.silence_s() > stall_s:
            buffer.end(f"no frame came for {stall_s:g} s")
            return
    buffer.end("stopped on request")


class LiveReader(Protocol):
    """A source that gives one frame after another, and None in the end."""

    def __call__(self) -> Frame | Skipped | None: ...

    def close(self) -> None:
        """Give the source back."""


def read_newest(
    reader: LiveReader, buffer: LiveBuffer, is_wanted: Callable[[], bool], stall_s: float
) -> Iterator[Frame | Skipped]:
    """What a reader gives, without what comes faster than it is taken.

    It is called in a thread of its own, again and again, so that nothing ages in the source, and closed there. A call
    that hangs (a cable that was pulled) is not waited for.

    Args:
        is_wanted: asked again and again while nothing comes; no more is taken once it is False.
        stall_s: a source that is silent for so long has ended.
    """

    def read_on() -> None:
        try:
            while not buffer.is_ended and (item := reader()) is not None:
                buffer.put(item)
            buffer.end("the source has ended")
        except InputError as error:  # it cannot be opened: the same as of a source that is read when wanted
            buffer.end("the source cannot be read", error)
        except Exception as error:  # of a driver
            buffer.end(f"the source has failed: {error}")
        finally:
            reader.close()

    thread = threading.Thread(target=read_on, name="frames", daemon=True)
    thread.start()
    try:
        yield from taken_from(buffer, is_wanted, stall_s)
    finally:
        buffer.end("stopped on request")
        thread.join(_END_S)
