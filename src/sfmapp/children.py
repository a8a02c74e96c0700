"""Child processes that end when this one does, however it ends.

A child is started through this file, run as a script in an interpreter that loads nothing: ``children.py PARENT COMMAND
...``. On Linux it asks the kernel to kill it with its parent and becomes the command, so the command itself is the
child; the kernel watches the thread that started it, which therefore has to wait for it or to be the main one.
Elsewhere it stays, looks now and then whether its parent is still there, and ends the command if not.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence

_PR_SET_PDEATHSIG = 1  # prctl(2)
_LOOK_S = 0.25
NOT_FOUND = 127  # as a shell has it


def with_parent(command: Sequence[str]) -> list[str]:
    """The command line of a child that ends with this process."""
    # -I and -S: nothing from the environment or the working folder is imported
    return [sys.executable, "-I", "-S", __file__, str(os.getpid()), *command]


def main(parent: int, command: list[str]) -> int:
    """Run the command until it or the parent ends; its exit code where this process does not become it."""
    is_asked = sys.platform == "linux" and _ask_the_kernel()
    if os.getppid() != parent:  # it has ended in between
        return 1
    try:
        if is_asked:
            os.execvp(command[0], command)
        return supervise(parent, command)
    except OSError as error:
        sys.stderr.write(f"{command[0]}: {error.strerror}\n")
        return NOT_FOUND


def supervise(parent: int, command: Sequence[str]) -> int:
    """Run the command in a process of its own and end it when the parent, or this process, is told to end."""

    def end(number: int, _: object) -> None:
        sys.exit(128 + number)

    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, end)
    child = subprocess.Popen(command)
    try:
        while child.poll() is None and os.getppid() == parent:
            time.sleep(_LOOK_S)
        return 1 if child.returncode is None else child.returncode % 256
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()


def _ask_the_kernel() -> bool:
    """Have this process killed when its parent ends; False where that cannot be had."""
    try:
        import ctypes

        failed: int = ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        return failed == 0
    except (ImportError, OSError, AttributeError):
        return False


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), sys.argv[2:]))
