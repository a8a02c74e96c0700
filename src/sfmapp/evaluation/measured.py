"""Run another program and measure it: wall seconds, CPU seconds and peak memory, children included.

The peak is taken with care. ``ru_maxrss`` of a child starts at the resident size of the parent it was forked from
(Linux keeps the larger of the two across ``exec``), so a small child of a large parent would look large. Hence the
child's own high-water mark ``VmHWM``, which starts afresh at ``exec``, is read while it runs, and ``ru_maxrss`` counts
only where it exceeds what the parent itself ever held.
"""

from __future__ import annotations

import os
import resource
import selectors
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from sfmapp.children import with_parent

_TICK_S = 0.02


@dataclass(frozen=True)
class ProcessUsage:
    """What a finished child process took.

    Attributes:
        exit_code: as in :mod:`subprocess`; negative for a signal.
        wall_s: seconds from the start of the process to its end, interpreter start included.
        cpu_s: user plus system seconds of the process and of all its children that it waited for.
        peak_memory_mb: largest resident set of the process (or, if larger, of one of its children), 1e6 bytes.
    """

    exit_code: int
    wall_s: float
    cpu_s: float
    peak_memory_mb: float


def run_measured(
    command: Sequence[str],
    log: Path,
    *,
    env: Mapping[str, str] | None = None,
    on_line: Callable[[str], None] = lambda line: None,
    on_tick: Callable[[], None] = lambda: None,
) -> ProcessUsage:
    """Run a command to its end and measure it. It is killed when this process ends before.

    Args:
        command: program and arguments; no shell is involved.
        log: file that receives the error stream of the child.
        env: environment, None for the parent's own.
        on_line: called with each complete line of the child's output, in this thread.
        on_tick: called about fifty times a second; if it raises, the child is killed and the exception passes on.
    """
    own_peak_mb = _maxrss_mb(resource.getrusage(resource.RUSAGE_SELF))
    with log.open("wb") as errors:
        start = time.perf_counter()
        child = subprocess.Popen(
            with_parent(command), stdout=subprocess.PIPE, stderr=errors, stdin=subprocess.DEVNULL, env=env
        )
        try:
            usage, status, high_water_mb = _watch(child, on_line, on_tick)
        except BaseException:
            child.kill()
            child.wait()
            raise
        wall_s = time.perf_counter() - start
    rusage_mb = _maxrss_mb(usage)
    return ProcessUsage(
        exit_code=os.waitstatus_to_exitcode(status),
        wall_s=wall_s,
        cpu_s=usage.ru_utime + usage.ru_stime,
        peak_memory_mb=max(high_water_mb, rusage_mb) if rusage_mb > own_peak_mb or not high_water_mb else high_water_mb,
    )


def high_water_mark_mb(pid: int | str = "self") -> float:
    """Peak resident set of a running process in MB (1e6 bytes); 0 where the system does not tell (not Linux, ended)."""
    try:
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    except OSError:
        pass
    return 0.0


def _watch(
    child: subprocess.Popen[bytes], on_line: Callable[[str], None], on_tick: Callable[[], None]
) -> tuple[resource.struct_rusage, int, float]:
    """Follow a child until it ends; returns its resource usage, its wait status and its high-water mark in MB."""
    assert child.stdout is not None
    high_water_mb, pending, is_open = 0.0, b"", True
    os.set_blocking(child.stdout.fileno(), False)
    with selectors.DefaultSelector() as selector, child.stdout:
        selector.register(child.stdout, selectors.EVENT_READ)
        while True:
            high_water_mb = max(high_water_mb, high_water_mark_mb(child.pid))
            if is_open and selector.select(_TICK_S):
                is_open, pending = _read_lines(child.stdout, pending, on_line)
            elif not is_open:
                time.sleep(_TICK_S)
            on_tick()
            pid, status, usage = os.wait4(child.pid, os.WNOHANG)
            if pid:
                child.returncode = os.waitstatus_to_exitcode(status)
                _read_lines(child.stdout, pending, on_line)
                return usage, status, high_water_mb


def _read_lines(stream: IO[bytes], pending: bytes, on_line: Callable[[str], None]) -> tuple[bool, bytes]:
    """Hand on all complete lines that wait in a pipe; returns whether it is still open, and the rest."""
    chunk: bytes | None = b""
    while chunk := stream.read(65536):
        pending += chunk
    *lines, pending = pending.split(b"\n")
    for line in lines:
        on_line(line.decode("utf-8", "replace"))
    return chunk is None, pending


def _maxrss_mb(usage: resource.struct_rusage) -> float:
    return usage.ru_maxrss * 1024 / 1e6
