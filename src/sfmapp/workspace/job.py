"""What the steps of one run share."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime

import sfmapp
from sfmapp.errors import InputError, is_full
from sfmapp.events import Events
from sfmapp.report.model import RunFacts
from sfmapp.reporting import Usage
from sfmapp.workspace.listeners import DecisionLog
from sfmapp.workspace.manifest import recorded_versions
from sfmapp.workspace.options import Options, options_to_dict
from sfmapp.workspace.usage import Stopwatch
from sfmapp.workspace.workspace import Workspace

# what the manifest says of a recording
WRITTEN, FAILED, NO_MODEL, NOT_WANTED = "written", "failed", "no model", "not wanted"


@dataclass
class Job:
    """What every command that writes a workspace keeps at hand.

    Attributes:
        source: what the user gave to work on.
        threads: workers.
        usage: what each stage took, by name.
    """

    source: str
    workspace: Workspace
    options: Options
    events: Events
    watch: Stopwatch
    log: DecisionLog
    threads: int
    usage: dict[str, Usage] = field(default_factory=dict)
    started: datetime = field(default_factory=lambda: datetime.now(UTC))

    @contextmanager
    def stage(self, name: str, key: str | None = None) -> Iterator[None]:
        """Measure a step; with a key, note in the manifest when it begins and ends. Obeys a wish to stop."""
        self.events.raise_if_cancelled()
        with self.measured(name):
            if key is not None:
                self.workspace.begin(name, key)
            yield
        if key is not None:
            self.workspace.finish(name, self.usage[name])

    @contextmanager
    def measured(self, name: str) -> Iterator[None]:
        """Measure a step that is done in any case."""
        watch = Stopwatch()
        yield
        self.usage[name] = watch.read()

    def save_first(self, write: Callable[[], object]) -> None:
        """Write what matters most; where the disk is full, once more without the recording."""
        try:
            write()
        except InputError as error:
            if not is_full(error) or not self.make_room():
                raise
            write()

    def make_room(self) -> bool:
        """Take away the recording, for the disk is full; whether there was one."""
        recording = self.workspace.recording
        if not recording.is_file():
            return False
        recording.unlink()
        self.workspace.manifest["recording"] = FAILED
        self.events.warned("recording", f"{recording} is given up: the disk is full, and the rest matters more")
        return True

    def facts(self) -> RunFacts:
        """What the report says of the run: how it was called, and what it has taken so far."""
        return RunFacts(
            source=self.source,
            seed=self.options.seed,
            threads=self.threads,
            options=options_to_dict(self.options),
            versions=self.workspace.manifest["versions"],
            started=self.started.isoformat(timespec="seconds"),
            is_up_to_date=False,
            **self.watch.read(),
        )

    def note_inputs(self, inputs: dict[str, str]) -> None:
        """Write down what this run works on and how, before it begins; ``inputs``: digests by name."""
        self.workspace.manifest |= {
            # absolute, so that the workspace can be looked at from anywhere; a stream has no place
            "source": self.source if "://" in self.source else os.path.abspath(self.source),
            "seed": self.options.seed,
            "options": options_to_dict(self.options),
            "versions": {"sfmapp": sfmapp.__version__, **recorded_versions()},
            "inputs": inputs,
        }
        self.workspace.save()
