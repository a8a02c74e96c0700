"""What an odometry run takes, frame by frame and thread by thread."""

from __future__ import annotations

import threading
import time

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Event
from sfmapp.odometry.result import FrameState, OdometryResult
from sfmapp.odometry.snapshot import FrameSnapshot
from sfmapp.report.model import FrameTimes, TimingReport
from sfmapp.report.odometry_document import FrameTable

# the threads of a run by the beginning of their names, and what the report calls them
READING, BACK_END, DRAWING = "frames", "adjust", "recording"
_PART_OF = {READING: "reading", BACK_END: "back end", "loops": "loops"}


class FrameLog:
    """Listener that keeps a few numbers of each frame; of its arrays nothing."""

    def __init__(self) -> None:
        self._rows: dict[int, tuple[int, int, float, int]] = {}

    def __call__(self, event: Event) -> None:
        seen = event.data.get("snapshot")
        if isinstance(seen, FrameSnapshot):
            # what was tracked before a loss is not tracked any more
            is_lost = seen.state == FrameState.LOST
            counts = (0, 0) if is_lost else (len(seen.xy), int(np.count_nonzero(seen.is_mapped)))
            has_pose = bool(np.isfinite(seen.cam_from_world[0]))
            self._rows[seen.frame_idx] = (*counts, seen.cpu_s, seen.map_idx if has_pose else -1)

    @property
    def tracking_s(self) -> float:
        """CPU seconds of tracking in all."""
        return sum(row[2] for row in self._rows.values())

    def facts(self, result: OdometryResult) -> FrameTable:
        """Of the frames (F,) of a result. What repeats another was not tracked, and has the live map of that one."""
        nothing = (np.nan, np.nan, np.nan, -1)
        seen = result.frame_idx[result.twin_rows]
        table = np.array([self._rows.get(int(idx), nothing) for idx in seen], np.float64).reshape(-1, 4)
        table[result.frame_state == FrameState.REPEATED, :3] = np.nan
        return FrameTable(table[:, 0], table[:, 1], 1e3 * table[:, 2], table[:, 3].astype(np.int64))


class ThreadTimes:
    """CPU time of the process and of its threads by name, from the first sample on; threads that end are remembered."""

    def __init__(self) -> None:
        self._by_thread: dict[tuple[str, int], float] = {}
        self._begin: tuple[float, float] | None = None
        self._end = (0.0, 0.0)
        self._frames_end = 0.0

    def sample(self) -> None:
        """Read the clocks."""
        self._end = (time.process_time(), time.monotonic())
        self._begin = self._begin or self._end
        for thread in threading.enumerate():
            name = thread.name.partition("_")[0]
            if thread.ident is not None and (name in _PART_OF or name == DRAWING):
                try:
                    clock = time.clock_gettime(time.pthread_getcpuclockid(thread.ident))
                except OSError:  # it has ended between the two lines
                    continue
                self._by_thread[name, thread.ident] = clock

    def frames_ended(self) -> None:
        """There are no more frames: what follows is the end of the run."""
        self.sample()
        self._frames_end = self._end[0]

    def total(self, name: str) -> float:
        """CPU seconds of all threads of a name."""
        return sum(seconds for (found, _), seconds in self._by_thread.items() if found == name)

    def timing(
        self, num_frames: int, tracking_s: float, rate: float | None, tracking_ms: FrameTimes | None = None
    ) -> TimingReport | None:
        """Time of a frame: CPU milliseconds in all and of each part, and how that compares with the camera's rate;
        None without a frame."""
        if num_frames == 0 or self._begin is None:
            return None
        cpu_s = self._end[0] - self._begin[0] - self.total(DRAWING)
        wall_s = self._end[1] - self._begin[1]
        parts = {"tracking": tracking_s, **{part: self.total(name) for name, part in _PART_OF.items()}}
        # the last adjustment of everything, and the covariances
        parts["the end"] = self._end[0] - self._frames_end if self._frames_end else 0.0
        # what the listeners do, and all else that no clock of its own was read for
        parts["rest"] = max(0.0, cpu_s - sum(parts.values()))
        per_second = num_frames / wall_s if wall_s > 0 else 0.0
        return TimingReport(
            num_frames=num_frames,
            wall_s=round(wall_s, 3),
            frames_per_second=round(per_second, 2),
            times_real_time=round(per_second / rate, 3) if rate else None,
            cpu_s=round(cpu_s, 3),
            cpu_ms_per_frame=round(1e3 * cpu_s / num_frames, 3),
            parts_cpu_ms={part: round(1e3 * value / num_frames, 3) for part, value in parts.items() if value > 0},
            tracking_ms=tracking_ms,
        )


def frame_statistics(values: NDArray[np.float64]) -> FrameTimes | None:
    """Median, 95th percentile and worst of what was measured."""
    known = values[np.isfinite(values)]
    if not len(known):
        return None
    return FrameTimes(median=float(np.median(known)), p95=float(np.percentile(known, 95)), max=float(known.max()))
