"""From the results of a run to ``recording.rrd``."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sfmapp.children import with_parent
from sfmapp.packages import MissingPackageError, require
from sfmapp.viewer.listener import Message, RecordingListener, Step
from sfmapp.viewer.replay import Replay

Kind = Literal["run", "dense"]

__all__ = ["Message", "RecordingListener", "RecordingReport", "Step", "draw_in_child", "write_recording"]


@dataclass(frozen=True)
class RecordingReport:
    """What came of a recording.

    Attributes:
        path: where it is, None if it could not be written.
        num_bytes: its size.
        seconds: wall time.
        problem: why there is none, empty if all went well.
    """

    path: Path | None
    num_bytes: int
    seconds: float
    problem: str


def write_recording(path: Path, replay: Replay, *, threads: int = 1, timeout_s: float = 600.0) -> RecordingReport:
    """Write a recording that replays a run, in a child process; never raises for what happens there.

    Args:
        path: the file, replaced when the new one is whole.
        replay: what it shows, see :func:`~sfmapp.viewer.replay.make_replay`.
        threads: photographs read at a time.
        timeout_s: the child is stopped after this long.
    """
    start = time.monotonic()
    try:
        with tempfile.TemporaryDirectory(prefix="recording-", dir=path.parent) as name:
            replay.save(Path(name))
            problem = draw_in_child("run", Path(name), path, threads, timeout_s)
    except OSError as error:
        problem = error.strerror or str(error)
    size = path.stat().st_size if not problem else 0
    return RecordingReport(None if problem else path, size, time.monotonic() - start, problem)


def draw_in_child(kind: Kind, folder: Path, path: Path, threads: int, timeout_s: float) -> str:
    """Draw what lies in folder into the file path; returns what went wrong, empty for nothing."""
    try:
        require("rerun")
    except MissingPackageError as missing:
        return f"{missing}: {missing.advice}"
    arguments = [kind, str(folder.absolute()), str(path.absolute()), str(threads)]
    command = with_parent([sys.executable, "-P", "-m", "sfmapp.viewer.record_process", *arguments])
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            timeout=timeout_s, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"not finished after {timeout_s:g} s"
    except OSError as error:
        return f"the process did not start: {error.strerror}"
    if done.returncode == 0 and path.is_file():
        return ""
    lines = done.stderr.decode(errors="replace").strip().splitlines()
    return f"exit code {done.returncode}: {lines[-1] if lines else 'no message'}"
