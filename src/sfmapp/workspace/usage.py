"""What a run and its stages take: wall seconds, CPU seconds and memory."""

from __future__ import annotations

import os
import resource
import time
from dataclasses import replace

from sfmapp.reporting import Usage


class Stopwatch:
    """Counts from its making. CPU seconds are user and system, of all threads and of children that have ended."""

    def __init__(self, *, whole_process: bool = False) -> None:
        """``whole_process`` counts from the beginning of the process, imports included."""
        self._wall = time.monotonic() - (_process_age_s() if whole_process else 0.0)
        self._cpu = 0.0 if whole_process else _cpu_s()

    def read(self) -> Usage:
        """What it has counted; the peak of memory is that of the process, or of one of its children where that is
        larger, since the process began."""
        return Usage(
            wall_s=round(time.monotonic() - self._wall, 4),
            cpu_s=round(_cpu_s() - self._cpu, 4),
            peak_memory_mb=round(max(_peak_mb(resource.RUSAGE_SELF), _peak_mb(resource.RUSAGE_CHILDREN)), 1),
        )


def added(before: Usage | None, now: Usage) -> Usage:
    """What a step has taken that is done again; the peak of memory is that of the process anyway."""
    if before is None:
        return now
    return replace(now, wall_s=round(before.wall_s + now.wall_s, 4), cpu_s=round(before.cpu_s + now.cpu_s, 4))


def _process_age_s() -> float:
    """Seconds since the process began, to a hundredth; 0 where the system does not tell (not Linux)."""
    try:
        with open("/proc/self/stat", encoding="utf-8", errors="replace") as file:
            # the name of the program, in brackets, may hold anything; the start time is the 20th field after it
            start = int(file.read().rpartition(")")[2].split()[19]) / os.sysconf("SC_CLK_TCK")
        return time.clock_gettime(time.CLOCK_BOOTTIME) - start
    except (OSError, AttributeError, ValueError, IndexError):
        return 0.0


def _cpu_s() -> float:
    usages = (resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def _peak_mb(who: int) -> float:
    return resource.getrusage(who).ru_maxrss * 1024 / 1e6
