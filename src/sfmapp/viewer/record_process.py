"""Draws a recording in a process of its own: ``python -m sfmapp.viewer.record_process FOLDER OUTPUT THREADS``.

rerun takes half a second and a hundred megabytes to load; here they, and whatever may go wrong in it, stay away from
the run.
"""

from __future__ import annotations

import sys
from pathlib import Path


def main(folder: str, output: str, threads: str) -> None:
    """Draw the replay that lies in folder."""
    from sfmapp.viewer.replay import Replay
    from sfmapp.viewer.rrd import write_rrd

    write_rrd(Replay.load(Path(folder)), Path(output), int(threads))


if __name__ == "__main__":
    main(*sys.argv[1:])
