"""A recording that appears whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import rerun as rr

from sfmapp.images.sources import printable


@contextmanager
def recording_file(path: Path, application: str, title: str) -> Iterator[rr.RecordingStream]:
    """A stream into a file beside ``path``; renamed onto it at the end, removed if an exception passes.

    ``title``: of the recording, empty for none.
    """
    beside = path.with_name(f".{path.name}.part")
    recording = rr.RecordingStream(application)
    try:
        recording.save(beside)
        if title:
            recording.send_recording_name(printable(title))
        yield recording
        recording.flush()
        recording.disconnect()
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)
