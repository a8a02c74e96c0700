"""Opens a recording: in a window where there is a screen, else for a browser on this machine."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from sfmapp.children import with_parent
from sfmapp.errors import InputError, SfmError
from sfmapp.packages import require

if TYPE_CHECKING:
    from sfmapp.viewer.live import Screen

HOST = "127.0.0.1"
WEB_PORT, DATA_PORT = 9090, 9876

# A viewer that ends sooner than this with an error never opened its window.
_NEVER_OPENED_S = 10.0
# A viewer that was told to end and has not after this long is ended.
_LAST_WORDS_S = 5.0
_STOPPED = 130
_WELL_ENDED = (0, -signal.SIGINT, _STOPPED)


def view(
    recording: Path, *, serve: bool | None = None, web_port: int = WEB_PORT, tell: Callable[[str], None] | None = None
) -> None:
    """Show a recording and wait until the viewer is closed, or the server stopped with Ctrl-C.

    Nothing is reachable from other machines either way. Over ssh: ``ssh -L 9090:127.0.0.1:9090 -L
    9876:127.0.0.1:9876 MACHINE`` there, then the address that is told here.

    Args:
        recording: a ``.rrd`` file.
        serve: for a browser instead of in a window; None: if there is no screen, or no window could be opened on it.
        web_port: where to serve it; another free one is taken if it is in use.
        tell: given a line on how to reach it.

    Raises:
        InputError: the file does not exist, or rerun is not installed.
        SfmError: the viewer failed.
    """
    if not recording.is_file():
        raise InputError(f"{recording} does not exist")
    require("rerun")
    if serve is None:
        serve = not has_screen()
        if not serve and _open_window(recording):
            return
    elif not serve:
        if not _open_window(recording):
            raise SfmError("rerun could not open a window", "look at it in a browser: serve it")
        return
    web_port, data_port = free_port(web_port), free_port(DATA_PORT)
    if tell is not None:
        tell(f"serving {recording} at {server_url(web_port, data_port)} for browsers on this machine; Ctrl-C ends it")
    code = _run(server_command(recording, web_port, data_port))
    if code not in _WELL_ENDED:
        raise SfmError(f"rerun ended with code {code}", f"try: rerun {recording}")


@dataclass
class LiveViewer:
    """A viewer that waits for a run to show.

    Attributes:
        screen: where the run has to send what it shows.
    """

    screen: Screen
    _process: subprocess.Popen[bytes]
    _is_server: bool

    def wait(self) -> None:
        """A window stays by itself; a server until it is stopped with Ctrl-C."""
        if self._is_server:
            try:
                self._process.wait()
            except KeyboardInterrupt:
                self.close()

    def leave(self) -> None:
        """After a run that failed: a window stays with what was shown, a server would run forever."""
        if self._is_server:
            self.close()

    def close(self) -> None:
        """End it, and what it has started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGTERM)
        self._process.wait()


def open_live_viewer(*, tell: Callable[[str], None], serve: bool | None = None) -> LiveViewer:
    """Open a window that shows a run under way, or serve one for a browser where there is no screen.

    Args:
        tell: given a line on how to reach it.
        serve: for a browser in any case (True) or never (False).
    """
    require("rerun")
    from sfmapp.viewer.live import Screen  # loads kernels, which a look at a recording needs none of

    serve = not has_screen() if serve is None else serve
    data_port, web_port = free_port(DATA_PORT), free_port(WEB_PORT)
    command = server_command(None, web_port, data_port) if serve else window_command(None, str(data_port))
    # a session of its own: a Ctrl-C for the run is none for the viewer. A window outlives the run, a server does not
    process = subprocess.Popen(
        with_parent(command) if serve else command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    if serve:
        url = server_url(web_port, data_port)
        tell(f"watch it at {url} in a browser on this machine; when the run is done, Ctrl-C ends it")
    return LiveViewer(Screen(f"rerun+http://{HOST}:{data_port}/proxy"), process, serve)


def has_screen() -> bool:
    """Whether a window can probably be opened."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def window_command(recording: Path | None, port: str = "auto") -> list[str]:
    """The native viewer. It, too, listens for data: on this machine only, on any free port."""
    return [*_rerun(), "--bind", HOST, "--port", port, *([str(recording)] if recording else [])]


def server_command(recording: Path | None, web_port: int, data_port: int) -> list[str]:
    """The web viewer and the data it fetches, each on a port of this machine only."""
    ports = ["--web-viewer-port", str(web_port), "--port", str(data_port)]
    return [*_rerun(), "--serve-web", "--bind", HOST, *ports, *([str(recording)] if recording else [])]


def server_url(web_port: int, data_port: int) -> str:
    """What to open in a browser."""
    return f"http://{HOST}:{web_port}/?url=" + quote(f"rerun+http://{HOST}:{data_port}/proxy", safe="")


def free_port(preferred: int) -> int:
    """The preferred port of this machine if nothing listens there, else any other."""
    for port in (preferred, 0):
        with socket.socket() as probe:
            # as servers do: a port that was in use a moment ago is free
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise SfmError(f"no free port on {HOST}")


def _rerun() -> list[str]:
    """The command of rerun: its program itself where it is found, for the package would start it as a child of its own,
    which stayed when that was ended."""
    package = importlib.util.find_spec("rerun_cli")
    if package is not None and package.origin is not None and "RERUN_CLI_PATH" not in os.environ:
        program = Path(package.origin).with_name("rerun")
        if program.is_file() and os.access(program, os.X_OK):
            return [str(program)]
    return [sys.executable, "-m", "rerun_cli"]


def _open_window(recording: Path) -> bool:
    """Show it in a window until that is closed; False if there was none."""
    start = time.monotonic()
    code = _run(window_command(recording))
    return code in _WELL_ENDED or time.monotonic() - start > _NEVER_OPENED_S


def _run(command: Sequence[str]) -> int:
    """Run to the end, or until this process is told to stop; 130 for the latter."""
    process = subprocess.Popen(with_parent(command), stdin=subprocess.DEVNULL)
    is_stopped = False
    while True:
        try:
            code = process.wait(_LAST_WORDS_S if is_stopped else None)
            return _STOPPED if is_stopped else code
        except KeyboardInterrupt:  # in a terminal it reaches the child as well
            is_stopped = True
            process.terminate()
        except subprocess.TimeoutExpired:
            process.kill()
