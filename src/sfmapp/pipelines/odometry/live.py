"""The poses of an odometry run on their way to the disk while it is under way.

A run that is killed leaves ``trajectory_live.tum`` (and ``trajectory_live-1.tum`` of its second map) with every pose
that was given out until then; at the end :func:`~sfmapp.pipelines.odometry.results.write_trajectories` replaces them.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sfmapp.errors import is_full
from sfmapp.events import Event, Events
from sfmapp.formats.trajectory import GrowingTum
from sfmapp.odometry.snapshot import FrameSnapshot

LIVE = re.compile(r"trajectory_live(-\d+)?\.tum")


def numbered(stem: str, number: int) -> str:
    """Name of the trajectory of a map; the first needs no number."""
    return f"{stem}.tum" if number == 0 else f"{stem}-{number}.tum"


class GrowingTrajectories:
    """Listener that writes the pose of each frame as it is given out. A failure is a warning.

    Args:
        folder: of the workspace.
        events: told of a failure.
        make_room: called where the disk is full; whether there may be more room then.
    """

    def __init__(self, folder: Path, events: Events, make_room: Callable[[], bool]) -> None:
        self._folder, self._events, self._make_room = folder, events, make_room
        self._files: dict[int, GrowingTum] = {}
        self._has_failed = False

    def __call__(self, event: Event) -> None:
        seen = event.data.get("snapshot")
        if self._has_failed or not isinstance(seen, FrameSnapshot) or not np.isfinite(seen.cam_from_world[0]):
            return
        try:
            self._append(seen)
        except OSError as error:
            try:
                if not is_full(error) or not self._make_room():
                    raise
                self._append(seen)
            except OSError as last:
                self._has_failed = True
                self._events.warned("odometry", f"live poses cannot be written: {last.strerror}")

    def close(self) -> None:
        """Close the files, before the final ones take their place."""
        for file in self._files.values():
            file.close()
        self._files.clear()
        self._has_failed = True

    def _append(self, seen: FrameSnapshot) -> None:
        if not self._files:  # the first pose of this run: those of an earlier one would be taken for its own
            for path in self._folder.glob("trajectory_live*.tum"):
                if LIVE.fullmatch(path.name):
                    path.unlink()
        if seen.map_idx not in self._files:
            self._files[seen.map_idx] = GrowingTum(self._folder / numbered("trajectory_live", seen.map_idx))
        self._files[seen.map_idx].append(seen.timestamp_s, seen.cam_from_world)
