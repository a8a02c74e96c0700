"""Draws an odometry run in a process of its own: ``python -m sfmapp.viewer.live_process RECORDING URL``, messages come
on the standard input (see :mod:`sfmapp.viewer.live`). Either argument may be empty.

The recording appears under its name when it is whole: also when the run has died, with what was seen of it until then.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path


def main(recording: str, url: str) -> None:
    """Draw messages until there are no more."""
    os.nice(5)  # tracking goes first where cores are few
    from sfmapp.viewer.live_rrd import LiveDrawing
    from sfmapp.viewer.messages import read_message

    path = Path(recording) if recording else None
    beside = path.with_name(f".{path.name}.{os.getpid()}.part") if path else None
    try:
        drawing = LiveDrawing(beside, url or None)
        while (message := read_message(sys.stdin.buffer.read)) is not None:
            drawing.draw(message)
        drawing.close()
        if path and beside:
            os.replace(beside, path)
    finally:
        if beside:
            beside.unlink(missing_ok=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
