"""The shell that every command runs in which writes a workspace: lock, log, thread limits, listeners, usage, outcome.

A command opens it with :meth:`Job.opened` and does its work in the block, step by step with :meth:`Job.stage`::

    with Job.opened(CALIBRATE, source, output, options, events=events, watch=watch) as job:
        job.note_inputs({})
        with job.stage("corners", stage_key((__name__,), job.options.images, digest)):
            ...
        job.workspace.save()
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import sfmapp
from sfmapp.errors import InputError, is_full
from sfmapp.events import Events, Listener
from sfmapp.images.addresses import without_credentials
from sfmapp.report.model import RunFacts, RunUsage
from sfmapp.reporting import Usage
from sfmapp.workspace.listeners import DecisionLog, EventLog
from sfmapp.workspace.manifest import recorded_versions
from sfmapp.workspace.options import Options, options_to_dict, with_absolute_paths
from sfmapp.workspace.usage import Stopwatch, added
from sfmapp.workspace.workspace import Workspace, open_workspace

# what the manifest says of a recording
WRITTEN, FAILED, NO_MODEL, NOT_WANTED = "written", "failed", "no model", "not wanted"


@dataclass
class Job:
    """What every command that writes a workspace keeps at hand.

    Attributes:
        source: what the user gave to work on.
        workspace: the results, locked.
        options: with absolute paths.
        events: what happens is told here; subscribe with :meth:`listen`, so that it ends with the job.
        watch: since the run began.
        log: the decisions and warnings so far.
        usage: what each stage took, by name.
    """

    source: str
    workspace: Workspace
    options: Options
    events: Events
    watch: Stopwatch
    log: DecisionLog
    until_end: ExitStack
    usage: dict[str, Usage] = field(default_factory=dict)
    started: datetime = field(default_factory=lambda: datetime.now(UTC))

    @classmethod
    @contextmanager
    def opened(
        cls, command: str, source: str | os.PathLike[str], output: str | os.PathLike[str], options: Options | None, *,
        events: Events | None = None, watch: Stopwatch | None = None, **own: Any,
    ) -> Iterator[Self]:  # fmt: skip
        """Lock and open the workspace of a command until the block ends, log what happens in it, and limit the threads
        of the linear algebra.

        Args:
            command: that writes the workspace, as in :mod:`sfmapp.workspace.layout`.
            source: what the command works on.
            output: folder of the workspace: new, empty, or of an earlier run of the same command.
            options: of all stages; None for the defaults.
            events: told by the stages and asked whether to stop; None: nobody listens from outside.
            watch: started earlier, if more is to be counted than the block.
            own: what a kind of job has beside; see its attributes.

        Raises:
            UsageError: the folder holds something else, or another run is at work in it.
            InputError: it cannot be written.
        """
        from sfmapp.adjust.linear import one_blas_thread

        source, events = os.fspath(source), events or Events()
        with ExitStack() as stack:
            workspace = stack.enter_context(open_workspace(Path(output), command))
            log = DecisionLog()
            events.subscribe(log)
            stack.callback(events.unsubscribe, log)
            lines = stack.enter_context(
                EventLog(workspace.log, events, source=without_credentials(source), version=sfmapp.__version__)
            )
            stack.enter_context(one_blas_thread())
            options = with_absolute_paths(options or Options())
            job = cls(source, workspace, options, events, watch or Stopwatch(), log, stack, **own)
            job.listen(lines)
            yield job

    @property
    def shown(self) -> str:
        """The source as it may be told and written."""
        return without_credentials(self.source)

    @property
    def threads(self) -> int:
        """Workers."""
        return self.options.num_workers

    def listen(self, listener: Listener | None, *, first: bool = False) -> None:
        """Let a listener hear what happens until the end of the job; None is no listener. ``first``: before others."""
        if listener is not None:
            self.events.subscribe(listener, first=first)
            self.until_end.callback(self.events.unsubscribe, listener)

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
        """Measure a step that is done in any case; of one that is done again and again the sum is kept."""
        watch = Stopwatch()
        yield
        self.usage[name] = added(self.usage.get(name), watch.read())

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
        self.workspace.note(recording=FAILED)
        self.events.warned("recording", f"{recording} is deleted: the disk is full, and the results matter more")
        return True

    def took(self, *, is_up_to_date: bool = False) -> RunUsage:
        """What the run has taken so far; ``is_up_to_date``: it found the results of an earlier run to hold."""
        return RunUsage(**self.watch.read(), is_up_to_date=is_up_to_date)

    def facts(self) -> RunFacts:
        """What the report says of the run: how it was called, and what it has taken so far."""
        return RunFacts(
            source=self.shown,
            seed=self.options.seed,
            threads=self.threads,
            options=options_to_dict(self.options),
            versions=self.workspace.manifest.versions,
            started=self.started.isoformat(timespec="seconds"),
            **self.watch.read(),
        )

    def note_inputs(self, inputs: dict[str, str]) -> None:
        """Write down what this run works on and how, before it begins; ``inputs``: digests by name."""
        self.workspace.note(
            # absolute, so that the workspace can be looked at from anywhere; a stream has no place
            source=self.shown if "://" in self.source else os.path.abspath(self.source),
            seed=self.options.seed,
            options=options_to_dict(self.options),
            versions={"sfmapp": sfmapp.__version__, **recorded_versions()},
            inputs=inputs,
        )
        self.workspace.save()
