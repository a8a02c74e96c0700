"""Listeners that tell a person, or a program, how far along a run is. All of them write to the error stream."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any, Protocol

from sfmapp.events import Event

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

PLAIN_PERIOD_S = 5.0
# the stage that runs beside the others, and only now and then: a person has to be told
BACKGROUND = "kernels"


class Listener(Protocol):
    """A listener with an end."""

    def __call__(self, event: Event) -> None: ...

    def close(self) -> None: ...


def make_listener(*, quiet: bool, verbose: bool, as_json: bool) -> Listener:
    """The listener that suits the flags and the terminal."""
    if as_json:
        return JsonLines()
    if quiet:
        return PlainLines(is_quiet=True)
    return Bars(verbose) if sys.stderr.isatty() else PlainLines(is_verbose=verbose)


class JsonLines:
    """Every event as one line of JSON."""

    def __call__(self, event: Event) -> None:
        from sfmapp.reporting import to_json
        from sfmapp.workspace.listeners import log_line

        _say(to_json(log_line(event)))

    def close(self) -> None:
        pass


class PlainLines:
    """A line when a stage begins and ends, and every few seconds between, with an estimate of the time left."""

    def __init__(self, *, is_quiet: bool = False, is_verbose: bool = False) -> None:
        self._is_quiet = is_quiet
        self._is_verbose = is_verbose
        self._started: dict[str, float] = {}
        self._spoke = time.monotonic()

    def __call__(self, event: Event) -> None:
        if event.kind == "warned":
            _say(f"warning: {event.message}")
        elif self._is_quiet:
            return
        elif event.kind == "started":
            # a step inside a stage, such as one of many adjustments, is worth a line only to the curious
            if self._is_verbose or self._is_outermost(event.stage):
                _say(f"{event.stage}: {event.message or 'begins'}")
            self._started[event.stage] = event.time_s
        elif event.kind == "advanced":
            self._advance(event)
        elif event.kind == "decided":
            if self._is_verbose:
                _say(f"  {event.message}")
        elif event.kind == "finished":
            took = event.time_s - self._started.pop(event.stage, event.time_s)
            if self._is_verbose or self._is_outermost(event.stage):
                _say(f"{event.stage}: {event.message or 'done'} ({took:.1f} s)")

    def close(self) -> None:
        pass

    def _is_outermost(self, stage: str) -> bool:
        return stage == BACKGROUND or not self._started.keys() - {BACKGROUND}

    def _advance(self, event: Event) -> None:
        now = time.monotonic()
        if now - self._spoke < PLAIN_PERIOD_S:
            return
        self._spoke = now
        took = event.time_s - self._started.get(event.stage, event.time_s)
        left = ""
        # mapping counts what it registers, some of it twice where models are joined: then nobody knows how long
        if event.total and 0 < event.done <= event.total:
            left = f" of {event.total}, about {took / event.done * (event.total - event.done):.0f} s left"
        _say(f"{event.stage}: {event.message if event.total is None and event.message else f'{event.done}{left}'}")


class Bars:
    """Progress bars with an estimate, for a terminal."""

    def __init__(self, is_verbose: bool) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
        from rich.progress import TimeRemainingColumn as Left

        self._is_verbose = is_verbose
        columns = (TextColumn("{task.description:<10}"), BarColumn(30), MofNCompleteColumn(), TimeElapsedColumn())
        texts = (TextColumn("left"), Left(), TextColumn("{task.fields[message]}", style="dim"))
        console = Console(stderr=True)
        self._progress: Progress = Progress(*columns, *texts, console=console, refresh_per_second=4, transient=True)
        self._tasks: dict[str, TaskID] = {}
        self._started: dict[str, float] = {}
        self._progress.start()

    def __call__(self, event: Event) -> None:
        if event.kind == "started":
            self._started[event.stage] = event.time_s
            self._tasks[event.stage] = self._progress.add_task(event.stage, total=event.total, message=event.message)
        elif event.kind == "advanced" and event.stage in self._tasks:
            fields: dict[str, Any] = {"message": event.message} if event.message else {}
            total = None if event.total is None else max(event.total, event.done)
            self._progress.update(self._tasks[event.stage], completed=event.done, total=total, **fields)
        elif event.kind == "warned":
            self._print(f"warning: {event.message}", "yellow")
        elif event.kind == "decided" and self._is_verbose:
            self._print(f"  {event.message}", "dim")
        elif event.kind == "finished" and event.stage in self._tasks:
            self._progress.remove_task(self._tasks.pop(event.stage))
            if self._is_verbose or event.stage == BACKGROUND or not self._tasks.keys() - {BACKGROUND}:
                took = event.time_s - self._started[event.stage]
                self._print(f"{event.stage:<10} {event.message} ({took:.1f} s)")

    def close(self) -> None:
        self._progress.stop()

    def _print(self, text: str, style: str | None = None) -> None:
        self._progress.console.print(text, style=style, markup=False, highlight=False)


def _say(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()
