"""Listeners to the events of a run that belong to the workspace: the log file and the decision log of the report."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

from sfmapp.events import Event, Events
from sfmapp.report.model import LogLine, ProgressLine
from sfmapp.reporting import to_json

# arrays for the recording travel under this key; they are no text
ARRAYS_KEY = "snapshot"


def log_line(event: Event) -> LogLine:
    """An event for the log; empty fields are left out."""
    data = {key: value for key, value in event.data.items() if key != ARRAYS_KEY}
    time_s, message = round(event.time_s, 3), event.message or None
    if event.kind in ("started", "advanced"):
        return ProgressLine(
            time_s=time_s, kind=event.kind, stage=event.stage, message=message, done=event.done, total=event.total,
            data=data or None,
        )  # fmt: skip
    return LogLine(time_s=time_s, kind=event.kind, stage=event.stage, message=message, data=data or None)


class EventLog:
    """Appends every event to ``log.jsonl``, a line of JSON each; a run begins with a line of its own.

    A log that cannot be written, on a full disk for one, is a warning and ends there.
    """

    def __init__(self, path: Path, events: Events, **facts: Any) -> None:
        self._path, self._events = path, events
        self._file: BinaryIO | None = None
        try:
            self._file = path.open("ab", buffering=0)
        except OSError as error:
            self._give_up(error)
        self._write({"kind": "run", "at": time.strftime("%Y-%m-%dT%H:%M:%S%z"), **facts})

    def __call__(self, event: Event) -> None:
        self._write(log_line(event))

    def __enter__(self) -> EventLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the log; an exception on its way through is noted, a bug with its traceback."""
        if error is not None:
            import traceback

            text = "".join(traceback.format_exception(error))
            self._write({"kind": "raised", "error": type(error).__name__, "message": str(error), "traceback": text})
        if self._file is not None:
            self._file.close()
            self._file = None

    def _write(self, line: Mapping[str, Any]) -> None:
        if self._file is None:
            return
        data = (to_json(line) + "\n").encode()
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        file, self._file = self._file, None  # first, for the warning comes back to this listener
        if file is not None:
            with contextlib.suppress(OSError):
                file.close()
        self._events.warned("log", f"{self._path}: cannot be written: {error.strerror}; the run goes on without it")


class DecisionLog:
    """Keeps what was decided and warned, for the report."""

    def __init__(self) -> None:
        self.decisions: list[LogLine] = []
        self.warnings: list[LogLine] = []

    def __call__(self, event: Event) -> None:
        if event.kind == "decided":
            self.decisions.append(log_line(event))
        elif event.kind == "warned":
            self.warnings.append(log_line(event))
