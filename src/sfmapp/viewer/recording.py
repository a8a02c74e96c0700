"""From the results of a run to ``recording.rrd``."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from sfmapp.children import with_parent
from sfmapp.errors import InputError
from sfmapp.packages import MissingPackageError, require
from sfmapp.viewer.listener import Message, RecordingListener, Step
from sfmapp.viewer.photos import SCREEN_QUALITY, screen_side_px, shrunk_jpeg
from sfmapp.viewer.replay import make_replay

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet
    from sfmapp.scene.features import Features
    from sfmapp.scene.reconstruction import Reconstruction

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


def write_recording(
    path: Path, image_set: ImageSet, features: Sequence[Features], reconstructions: Sequence[Reconstruction],
    steps: Sequence[Step] = (), messages: Sequence[Message] = (), *, title: str = "",
    up: NDArray[np.float64] | None = None, threads: int = 1, timeout_s: float = 600.0,
) -> RecordingReport:  # fmt: skip
    """Write a recording that replays a run, in a child process; never raises for what happens there.

    Args:
        path: the file, replaced when the new one is whole.
        image_set, features: the I photographs and their keypoints.
        reconstructions: final models, largest first; may be empty.
        steps, messages: of the :class:`RecordingListener` that watched; without them the final model appears at once.
        title: shown in the viewer, such as the name of the image folder.
        up: (3,) direction in the world that is up (aligned worlds: z); None: judged from the cameras.
        threads: photographs read at a time.
        timeout_s: the child is stopped after this long.
    """
    start = time.monotonic()
    try:
        with tempfile.TemporaryDirectory(prefix="recording-", dir=path.parent) as name:
            shown = _as_files(image_set, Path(name))
            make_replay(shown, features, reconstructions, steps, messages, title=title, up=up).save(Path(name))
            problem = draw_in_child("run", Path(name), path, threads, timeout_s)
    except OSError as error:
        problem = error.strerror or str(error)
    size = path.stat().st_size if not problem else 0
    return RecordingReport(None if problem else path, size, time.monotonic() - start, problem)


def _as_files(image_set: ImageSet, folder: Path) -> ImageSet:
    """Photographs in memory as small files, for a child that cannot look into ours; one that fails is not shown."""
    from sfmapp.images.pixels import read_rgb

    side, records = screen_side_px(len(image_set.images)), list(image_set.images)
    for i, record in enumerate(records):
        if record.source is not None:
            with contextlib.suppress(InputError):
                data, _ = shrunk_jpeg(read_rgb(record)[:, :, ::-1], side, SCREEN_QUALITY)
                path = folder / f"{i:06d}.jpg"
                path.write_bytes(data)
                records[i] = replace(record, path=path)
    return replace(image_set, images=tuple(records))


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
