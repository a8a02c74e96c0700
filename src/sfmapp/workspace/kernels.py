"""Compile the numba kernels before they are needed, and say so if it takes long.

The first run on a machine compiles them, tens of CPU seconds; later ones load them from numba's cache. A reconstruction
does so in the background while the first images are read; odometry before its first frame, which must not wait. What is
to be compiled, a child process compiles in part.
"""

from __future__ import annotations

import contextlib
import gc
import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from importlib import import_module
from typing import Any

from sfmapp.children import with_parent
from sfmapp.errors import InterruptedRunError
from sfmapp.events import Events
from sfmapp.kernel_cache import take_turns
from sfmapp.reporting import Usage

STAGE = "kernels"
# in the order in which a run needs them
MODULES = (
    "sfmapp.features.extract",
    "sfmapp.matching.stage",
    "sfmapp.mapping.incremental",
    "sfmapp.mapping.structure",
    "sfmapp.mapping.verified_pairs",
    "sfmapp.mapping.join",
    "sfmapp.mapping.near_views",
    "sfmapp.mapping.repair",
    "sfmapp.adjust.compile",
)
PAIR_MODULES = MODULES[:2]
ODOMETRY_MODULES = (
    "sfmapp.odometry.frontend.small_image",
    "sfmapp.odometry.frontend.twins",
    "sfmapp.odometry.frontend.corners",
    "sfmapp.odometry.frontend.alignment",
    "sfmapp.odometry.frontend.epipolar_search",
    "sfmapp.geometry.epipolar",
    "sfmapp.mapping.structure",
    "sfmapp.adjust.compile",
    "sfmapp.adjust.clustered",
    "sfmapp.adjust.calibration",
    "sfmapp.odometry.loops.relocalize",
    "sfmapp.odometry.loops.pose_graph",
    "sfmapp.odometry.belief.particles",
)
DENSE_MODULES = ("sfmapp.dense.densify",)
INERTIAL_MODULES = ("sfmapp.odometry.inertial.gyroscope", "sfmapp.odometry.inertial.integration")
# How often a child is looked for, and how much longer than us it may take: one that hangs must not hold up a run.
_LOOK_S, _PATIENCE_S = 0.1, 60.0


@contextlib.contextmanager
def kernels_compiling(
    events: Events, usage: dict[str, Usage], modules: tuple[str, ...] = MODULES
) -> Iterator[None]:  # fmt: skip
    """Compile those of a reconstruction, or of some modules, in a thread beside the block; adds what it took to
    ``usage``."""
    thread = threading.Thread(
        target=lambda: usage.update({STAGE: _compile(events, modules)}), name=STAGE, daemon=True
    )  # fmt: skip
    thread.start()
    try:
        yield
    finally:
        thread.join()


def compile_odometry_kernels(events: Events, *, inertial: bool = False) -> Usage:
    """Compile those of odometry, with or without those of inertial measurements; returns what it took.

    Raises:
        InterruptedRunError: ``events`` was asked to stop.
    """
    took = _compile(events, ODOMETRY_MODULES + (INERTIAL_MODULES if inertial else ()))
    events.raise_if_cancelled()
    return took


def compile_dense_kernels(events: Events) -> Usage:
    """Compile those of densification; returns what it took.

    Raises:
        InterruptedRunError: ``events`` was asked to stop.
    """
    took = _compile(events, DENSE_MODULES)
    events.raise_if_cancelled()
    return took


def _compile(events: Events, modules: tuple[str, ...]) -> Usage:
    from numba.core import event as numba_event

    wall, cpu = time.monotonic(), time.thread_time()
    helper = _Helper(modules, events)
    listener = _listener(events, helper)
    numba_event.register("numba:compile", listener)
    try:
        take_turns()
        helper.start()
        while name := helper.take():
            import_module(name).compile_kernels()
            events.raise_if_cancelled()
        for name in helper.finish(time.monotonic() - wall):
            import_module(name).compile_kernels()
            events.raise_if_cancelled()
    except InterruptedRunError:
        pass  # the run hears of it at its own next step
    except Exception as error:  # whoever calls the kernel next meets the same error, where it belongs
        events.warned(STAGE, f"compiling ahead failed: {type(error).__name__}: {error}")
    finally:
        if listener.num_compiled:
            gc.unfreeze()
        helper.stop()
        numba_event.unregister("numba:compile", listener)
    num_compiled = listener.num_compiled + helper.num_compiled
    took = Usage(
        wall_s=round(time.monotonic() - wall, 4), cpu_s=round(time.thread_time() - cpu + helper.cpu_s, 4),
        num_compiled=num_compiled,
    )  # fmt: skip
    if num_compiled:
        events.finished(STAGE, f"{num_compiled} kernels compiled, once", **took)
    return took


class _Helper(threading.Thread):
    """Has a child process compile from the last module on, while this one does from the first.

    numba compiles on one thread of a process at a time, but two processes fill one cache. The child is started when the
    first kernel turns out to be missing. Whether there is one, and how far it comes, changes no kernel: this process
    goes through the child's modules as well, and compiles what it does not find.
    """

    def __init__(self, modules: tuple[str, ...], events: Events) -> None:
        super().__init__(name=f"{STAGE} of a child", daemon=True)
        self.num_compiled, self.cpu_s = 0, 0.0
        self._events = events
        self._ahead = deque(modules)
        self._taken: list[str] = []
        self._is_needed = threading.Event()
        self._child: subprocess.Popen[str] | None = None

    def wake(self) -> None:
        """A kernel is missing."""
        self._is_needed.set()

    def take(self, *, last: bool = False) -> str:
        """The first module that nobody has begun with, or the last one; empty if there is none."""
        try:
            return self._ahead.pop() if last else self._ahead.popleft()
        except IndexError:
            return ""

    def finish(self, took_s: float) -> list[str]:
        """Wait for the child to be done, but not for ever; returns its modules. ``took_s`` is what ours took."""
        end = time.monotonic() + took_s + _PATIENCE_S
        self._is_needed.set()
        while self.is_alive() and time.monotonic() < end:
            self.join(_LOOK_S)
            self._events.raise_if_cancelled()
        return self._taken

    def stop(self) -> None:
        """End the child if there still is one."""
        self._ahead.clear()
        self._is_needed.set()
        if self._child is not None:
            self._child.kill()
        if self.is_alive():
            self.join()

    def run(self) -> None:
        # the thread that starts a child has to wait for it, see children.py
        self._is_needed.wait()
        if not self._ahead or len(os.sched_getaffinity(0)) < 2:
            return
        command = with_parent([sys.executable, "-P", "-m", "sfmapp.workspace.kernel_process"])
        # a child that does not start, ends early or is ended leaves its work to us
        with (
            contextlib.suppress(OSError, ValueError, InterruptedRunError),
            subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, bufsize=1
            ) as child,
        ):
            self._child = child
            self._have_compiled(child)
            child.kill()  # what it has answered is in the cache

    def _have_compiled(self, child: subprocess.Popen[str]) -> None:
        assert child.stdin is not None
        assert child.stdout is not None
        while name := self.take(last=True):
            self._taken.append(name)
            child.stdin.write(f"{name}\n")
            num_compiled, cpu_s = child.stdout.readline().split()
            self.num_compiled += int(num_compiled)
            self.cpu_s += float(cpu_s)
            self._events.advanced(STAGE, int(num_compiled))


def _listener(events: Events, helper: _Helper) -> Any:
    from numba.core.event import Event, Listener

    class Compilations(Listener):  # type: ignore[misc]
        """Tells of compilations; a kernel that comes from the cache is none."""

        num_compiled = 0

        def on_start(self, event: Event) -> None:
            if not self.num_compiled:
                # what numba builds and drops has Python look for rubbish among all that there is, again and again
                gc.freeze()
                events.started(STAGE, "compiling kernels, once")
                helper.wake()
            self.num_compiled += 1

        def on_end(self, event: Event) -> None:
            events.advanced(STAGE)

    return Compilations()
