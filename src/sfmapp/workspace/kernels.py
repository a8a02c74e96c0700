"""Compile the numba kernels before they are needed, and say so if it takes long.

The first run on a machine compiles them, tens of CPU seconds; later ones load them from numba's cache. A reconstruction
does so in the background while the first images are read; odometry before its first frame, which must not wait.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from sfmapp.errors import InterruptedRunError
from sfmapp.events import Events
from sfmapp.reporting import Usage

STAGE = "kernels"
# in the order in which a run needs them
MODULES = ("sfmapp.features.extract", "sfmapp.matching.stage", "sfmapp.mapping.incremental")
PAIR_MODULES = MODULES[:2]
ODOMETRY_MODULES = (
    "sfmapp.odometry.frontend.small_image",
    "sfmapp.odometry.frontend.corners",
    "sfmapp.odometry.frontend.alignment",
    "sfmapp.odometry.frontend.epipolar_search",
    "sfmapp.geometry.epipolar",
    "sfmapp.mapping.structure",
    "sfmapp.adjust.compile",
    "sfmapp.adjust.calibration",
    "sfmapp.odometry.loops.relocalize",
    "sfmapp.odometry.loops.pose_graph",
)
DENSE_MODULES = ("sfmapp.dense.densify",)
INERTIAL_MODULES = ("sfmapp.odometry.inertial.gyroscope", "sfmapp.odometry.inertial.integration")


@contextmanager
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
    listener = _listener(events)
    numba_event.register("numba:compile", listener)
    try:
        for name in modules:
            import_module(name).compile_kernels()
            events.raise_if_cancelled()
    except InterruptedRunError:
        pass  # the run hears of it at its own next step
    except Exception as error:  # whoever calls the kernel next meets the same error, where it belongs
        events.warned(STAGE, f"compiling ahead failed: {type(error).__name__}: {error}")
    finally:
        numba_event.unregister("numba:compile", listener)
    took = Usage(
        wall_s=round(time.monotonic() - wall, 4), cpu_s=round(time.thread_time() - cpu, 4),
        num_compiled=listener.num_compiled,
    )  # fmt: skip
    if listener.num_compiled:
        events.finished(STAGE, f"{listener.num_compiled} kernels compiled, once", **took)
    return took


def _listener(events: Events) -> Any:
    from numba.core.event import Event, Listener

    class Compilations(Listener):  # type: ignore[misc]
        """Tells of compilations; a kernel that comes from the cache is none."""

        num_compiled = 0

        def on_start(self, event: Event) -> None:
            if not self.num_compiled:
                events.started(STAGE, "compiling kernels, once")
            self.num_compiled += 1

        def on_end(self, event: Event) -> None:
            events.advanced(STAGE)

    return Compilations()
