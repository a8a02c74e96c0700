"""Child processes that tests send signals to."""

from __future__ import annotations

import signal
import subprocess
from typing import Any


def start(line: list[str], **how: Any) -> subprocess.Popen[str]:
    """A process that takes interruption and hangup as one started by hand does.

    A shell starts what runs in its background with interruption ignored, nohup with hangup, and children inherit that.
    """
    return subprocess.Popen(line, text=True, preexec_fn=_listen, **how)


def _listen() -> None:
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
