"""How a command is told to stop: Ctrl-C, SIGTERM of a service manager or container, SIGHUP of a closing terminal."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

Handler = Callable[[int, FrameType | None], Any]

# SIGHUP is not known everywhere
STOPPING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
# some that end others send a signal twice at once, to the process and to its group
_SAME_WISH_S = 0.3


@contextlib.contextmanager
def signals_interrupt() -> Iterator[None]:
    """Let every signal to stop do what Ctrl-C does: unwind, so that nothing half-written stays."""

    def interrupt(number: int, _: FrameType | None) -> None:
        raise KeyboardInterrupt

    with _handled(interrupt):
        yield


@contextlib.contextmanager
def signals_stop(stop: Callable[[], None], *, is_talking: bool) -> Iterator[None]:
    """Let the first signal ask a run to end at its next step, and a later one end it at once."""
    asked_s: float | None = None

    def ask(number: int, _: FrameType | None) -> None:
        nonlocal asked_s
        now = time.monotonic()
        if asked_s is None:
            asked_s = now
            stop()
            if is_talking:  # no print: the signal may have come in the middle of one
                with contextlib.suppress(OSError):
                    os.write(2, b"\nstopping at the next step; Ctrl-C again ends at once\n")
        elif now - asked_s > _SAME_WISH_S:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)

    with _handled(ask):
        yield


@contextlib.contextmanager
def _handled(handler: Handler) -> Iterator[None]:
    """Set a handler for a while; signals that are ignored stay so, as nohup wants it. Only the main thread can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in STOPPING}
    kept = {number: old for number, old in before.items() if old is not signal.SIG_IGN and old is not None}
    for number in kept:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in kept.items():
            signal.signal(number, old)
