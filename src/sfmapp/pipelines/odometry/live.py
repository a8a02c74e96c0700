"""An odometry run while it is under way: poses on their way to the disk, and how old they are when they are known.

A run that is killed leaves ``trajectory_live.tum`` (and ``trajectory_live-1.tum`` of its second map) with every pose
that was given out until then; at the end :func:`~sfmapp.pipelines.odometry.results.write_trajectories` replaces them.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sfmapp.errors import is_full
from sfmapp.events import Event, Events
from sfmapp.formats.trajectory import GrowingTum
from sfmapp.images.live_buffer import LiveCounts
from sfmapp.images.live_sequence import LiveSequence
from sfmapp.images.sequence import Sequence
from sfmapp.images.video import VideoSequence
from sfmapp.odometry.snapshot import FrameSnapshot
from sfmapp.pipelines.odometry.timing import frame_statistics
from sfmapp.report.model import LiveReport

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


class LatencyLog:
    """Listener that keeps how old the pose of each frame of a live source was when it was known."""

    def __init__(self) -> None:
        self._latencies_s = array("f")

    def __call__(self, event: Event) -> None:
        seen = event.data.get("snapshot")
        if isinstance(seen, FrameSnapshot):
            self.note(seen)

    def note(self, frame: FrameSnapshot) -> None:
        """Keep that of a frame; a recorded one has none."""
        if np.isfinite(frame.latency_s):
            self._latencies_s.append(frame.latency_s)

    def report(self, counts: LiveCounts) -> LiveReport:
        """What there is to say of a live source so far."""
        return LiveReport(
            num_arrived=counts.num_arrived, num_dropped=counts.num_dropped, num_tracked=len(self._latencies_s),
            max_waiting=counts.max_waiting, longest_silence_s=round(counts.longest_silence_s, 3), end=counts.end,
            latency_ms=frame_statistics(1e3 * np.array(self._latencies_s, np.float64)),
        )  # fmt: skip


def live_counts(sequence: Sequence | None) -> LiveCounts | None:
    """What has come of a live source; None of a recorded sequence."""
    return sequence.counts if isinstance(sequence, LiveSequence | VideoSequence) else None
