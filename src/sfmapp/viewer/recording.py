"""From the results of a run to ``recording.rrd``."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

from sfmapp.children import with_parent
from sfmapp.errors import InputError
from sfmapp.packages import MissingPackageError, require
from sfmapp.viewer.handover import HandedOver
from sfmapp.viewer.listener import Message, RecordingListener, Step
from sfmapp.viewer.photos import SCREEN_QUALITY, screen_side_px, shrunk_jpeg
from sfmapp.viewer.replay import Replay

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageRecord

Kind = Literal["run", "dense", "calibration", "rig", "pair", "transfer", "lines", "clouds", "stereo", "carve", "sweep"]

__all__ = [
    "Drawer", "Message", "RecordingListener", "RecordingReport", "Step", "record_in_child", "write_recording",
]  # fmt: skip

# a child that draws a run is stopped after so many seconds
_RUN_S = 600.0


@dataclass(frozen=True)
class RecordingReport:
    """What came of a recording.

    Attributes:
        path: where it is, None if it could not be written.
        num_bytes: its size.
        wall_s: seconds that went by.
        problem: why there is none, empty if all went well.
    """

    path: Path | None
    num_bytes: int
    wall_s: float
    problem: str


def write_recording(
    path: Path, replay: Replay, photographs: Sequence[ImageRecord] = (), *, threads: int = 1,
    drawer: Drawer | None = None,
) -> RecordingReport:  # fmt: skip
    """Write a recording that replays a run, in a child process; never raises for what happens there.

    Args:
        path: the file, replaced when the new one is whole.
        replay: what it shows, see :func:`~sfmapp.viewer.replay.make_replay`.
        photographs: I of them, in the order of the replay, if some are no files; none if all are.
        threads: photographs read at a time.
        drawer: has it drawn; None: one that is started now.
    """
    return record_in_child(
        path, "run", lambda folder: _with_files(replay, photographs, folder), threads=threads, timeout_s=_RUN_S,
        drawer=drawer,
    )  # fmt: skip


def record_in_child(
    path: Path,
    kind: Kind,
    make: Callable[[Path], HandedOver],
    *,
    threads: int = 1,
    timeout_s: float = 300.0,
    drawer: Drawer | None = None,
) -> RecordingReport:
    """Write a recording in a child process; never raises for what happens there, or for a disk that is full.

    Args:
        path: the file, replaced when the new one is whole.
        make: what it shows; given the folder that the child reads, and which is then removed.
        timeout_s: the child is stopped after this long.
        drawer: has it drawn; None: one that is started now.
    """
    start = time.monotonic()
    try:
        with Drawer() as own, tempfile.TemporaryDirectory(prefix="recording-", dir=path.parent) as name:
            make(Path(name)).save(Path(name))
            problem = (drawer or own).draw(kind, Path(name), path, threads, timeout_s)
    except OSError as error:
        problem = error.strerror or str(error)
    size = path.stat().st_size if not problem else 0
    return RecordingReport(None if problem else path, size, time.monotonic() - start, problem)


def _with_files(replay: Replay, photographs: Sequence[ImageRecord], folder: Path) -> Replay:
    """Photographs in memory as small files, for a child that cannot look into ours; one that fails is not shown."""
    from sfmapp.images.pixels import read_rgb

    side, paths = screen_side_px(len(photographs)), list(replay.image_paths)
    for i, record in enumerate(photographs):
        if record.source is not None:
            with contextlib.suppress(InputError):
                data, _ = shrunk_jpeg(read_rgb(record)[:, :, ::-1], side, SCREEN_QUALITY)
                path = folder / f"{i:06d}.jpg"
                path.write_bytes(data)
                paths[i] = str(path)
    return replace(replay, image_paths=paths)


class Drawer:
    """A child process that draws one recording; a context manager that ends it.

    rerun takes half a second to load. A child that is started early has done so by the time there is something to draw.
    """

    def __init__(self) -> None:
        self._child: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._child is not None:
            with self._child:
                self._child.kill()

    def get_ready(self) -> str:
        """Start the child, in the thread that will have it draw, if there is none; returns what went wrong, empty for
        nothing."""
        if self._child is not None:
            return ""
        try:
            require("rerun")
        except MissingPackageError as missing:
            return f"{missing}: {missing.advice}"
        command = with_parent([sys.executable, "-P", "-m", "sfmapp.viewer.record_process"])
        try:
            self._child = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
            )
        except OSError as error:
            return f"the process did not start: {error.strerror}"
        return ""

    def draw(self, kind: Kind, folder: Path, path: Path, threads: int, timeout_s: float) -> str:
        """Draw what lies in folder into the file path; returns what went wrong, empty for nothing."""
        if problem := self.get_ready():
            return problem
        assert self._child is not None
        task = json.dumps([kind, str(folder.absolute()), str(path.absolute()), threads])
        try:
            _, said = self._child.communicate(task.encode(), timeout_s)
        except subprocess.TimeoutExpired:
            return f"not finished after {timeout_s:g} s"
        code = self._child.returncode
        if code == 0 and path.is_file():
            return ""
        lines = said.decode(errors="replace").strip().splitlines()
        return f"exit code {code}: {lines[-1] if lines else 'no message'}"
