"""Listeners to the events of a run that belong to the workspace: the log file and the decision log of the report."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from sfmapp.events import Event
from sfmapp.pipelines.workspace import plain_number

# arrays for the recording travel under this key; they are no text
ARRAYS_KEY = "snapshot"


def event_to_dict(event: Event) -> dict[str, Any]:
    """An event as plain values for JSON; empty fields are left out."""
    plain: dict[str, Any] = {"time_s": round(event.time_s, 3), "kind": event.kind, "stage": event.stage}
    if event.message:
        plain["message"] = event.message
    if event.kind in ("started", "advanced"):
        plain |= {"done": event.done, "total": event.total}
    data = without_arrays(event.data)
    return plain | {"data": data} if data else plain


def without_arrays(data: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in data.items() if key != ARRAYS_KEY}


class EventLog:
    """Appends every event to ``log.jsonl``, a line of JSON each; a run begins with a line of its own."""

    def __init__(self, path: Path, **facts: Any) -> None:
        self._file = path.open("a", encoding="utf-8", buffering=1)
        self._write({"kind": "run", "at": time.strftime("%Y-%m-%dT%H:%M:%S%z"), **facts})

    def __call__(self, event: Event) -> None:
        if not self._file.closed:
            self._write(event_to_dict(event))

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
        self._file.close()

    def _write(self, line: dict[str, Any]) -> None:
        self._file.write(json.dumps(line, default=plain_number) + "\n")


class DecisionLog:
    """Keeps what was decided and warned, for the report."""

    def __init__(self) -> None:
        self.decisions: list[dict[str, Any]] = []
        self.warnings: list[dict[str, Any]] = []

    def __call__(self, event: Event) -> None:
        if event.kind == "decided":
            self.decisions.append(event_to_dict(event))
        elif event.kind == "warned":
            self.warnings.append(event_to_dict(event))
