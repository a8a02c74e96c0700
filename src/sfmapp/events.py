"""What happens in a run, told to whoever listens.

Stages call an :class:`Events` object; listeners (progress bar, JSON log, recording) subscribe to it. The same object
carries the wish to stop. Stages run with ``Events()`` and no listener just as well.
"""

from __future__ import annotations

import copy
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from sfmapp.errors import InterruptedRunError

Kind = Literal["started", "advanced", "decided", "warned", "finished"]


@dataclass(frozen=True)
class Event:
    """One thing that happened in a run: a stage began, went on or ended, something was decided or warned of.

    Attributes:
        kind: ``started``, ``advanced``, ``decided``, ``warned`` or ``finished``.
        stage: name of the stage or of a step in it, such as ``features``.
        message: one line for a person; may be empty.
        done, total: steps done so far and expected in all (None where unknown), for ``started`` and ``advanced``.
        data: the numbers behind a decision, or the report of a finished stage. JSON-able, except that ``snapshot``
            may hold arrays for the recording; loggers leave that key out.
        time_s: seconds since the Events object was made.
    """

    kind: Kind
    stage: str
    message: str = ""
    done: int = 0
    total: int | None = None
    data: Mapping[str, Any] = field(default_factory=dict)
    time_s: float = 0.0


Listener = Callable[[Event], None]


class Events:
    """A thread-safe channel from the stages to the listeners, and for the request to stop back to the stages."""

    def __init__(self, *listeners: Listener) -> None:
        self._listeners = list(listeners)
        self._lock = threading.RLock()
        self._cancelled = threading.Event()
        self._progress: dict[str, tuple[int, int | None]] = {}
        self._start = time.monotonic()

    def subscribe(self, listener: Listener, *, first: bool = False) -> None:
        """Add a listener, behind the others or before them. It is called under a lock, in the thread that reports: it
        must be quick."""
        with self._lock:
            self._listeners.insert(0 if first else len(self._listeners), listener)

    def unsubscribe(self, listener: Listener) -> None:
        """Take away a listener that was added; one that was not is no error."""
        with self._lock:
            # a new list would not reach the copies without cancellation
            self._listeners[:] = [other for other in self._listeners if other is not listener]

    def started(self, stage: str, message: str = "", total: int | None = None, **data: Any) -> None:
        """A stage begins; total is its number of steps, None where it cannot be known."""
        with self._lock:
            self._progress[stage] = (0, total)
            self._emit("started", stage, message, 0, total, data)

    def advanced(self, stage: str, steps: int = 1, message: str = "", **data: Any) -> None:
        """Steps were done. Raises InterruptedRunError if a stop was asked for: stages need no other check."""
        with self._lock:
            done, total = self._progress.get(stage, (0, None))
            done += steps
            self._progress[stage] = (done, total)
            self._emit("advanced", stage, message, done, total, data)
        self.raise_if_cancelled()

    def decided(self, stage: str, message: str, **data: Any) -> None:
        """A choice was made; data holds the numbers and thresholds behind it."""
        with self._lock:
            self._emit("decided", stage, message, 0, None, data)

    def warned(self, stage: str, message: str, **data: Any) -> None:
        """Something is wrong that does not stop the run. The message names the file or image."""
        with self._lock:
            self._emit("warned", stage, message, 0, None, data)

    def finished(self, stage: str, message: str = "", **data: Any) -> None:
        """A stage ended; data is its report."""
        with self._lock:
            done, total = self._progress.pop(stage, (0, None))
            self._emit("finished", stage, message, done, total, data)

    def cancel(self) -> None:
        """Ask the stages to stop at their next step. Safe in a signal handler."""
        self._cancelled.set()

    @property
    def is_cancelled(self) -> bool:
        """A stop was asked for."""
        return self._cancelled.is_set()

    @property
    def is_heard(self) -> bool:
        """Somebody listens."""
        return bool(self._listeners)

    def without_cancellation(self) -> Events:
        """The same line to the same listeners without the wish to stop: for a stage that ends by itself, whole, when
        what it works on ends early."""
        other = copy.copy(self)
        other._cancelled = threading.Event()
        return other

    def unheard(self) -> Events:
        """The same wish to stop, and nobody who listens: for a stage that is a step of another."""
        other = copy.copy(self)
        other._listeners, other._progress = [], {}
        return other

    def raise_if_cancelled(self) -> None:
        """Raise InterruptedRunError if :meth:`cancel` was called."""
        if self._cancelled.is_set():
            raise InterruptedRunError("stopped on request", "run the same command again to resume")

    def _emit(
        self, kind: Kind, stage: str, message: str, done: int, total: int | None, data: Mapping[str, Any]
    ) -> None:
        event = Event(kind, stage, message, done, total, data, time.monotonic() - self._start)
        for listener in self._listeners:
            listener(event)
