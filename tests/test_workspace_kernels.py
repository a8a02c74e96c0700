"""Compiling ahead of a run, with a child process that does a part of it, does not, or hangs."""

from __future__ import annotations

import fcntl
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from numba.core import event as numba_event
from numba.core.caching import IndexDataCacheFile

from sfmapp import kernel_cache
from sfmapp.errors import InterruptedRunError
from sfmapp.events import Events
from sfmapp.reporting import Usage
from sfmapp.workspace import kernels

NAMES = ("fake_first", "fake_second", "fake_third")
TIMEOUT_S = 60.0
# a child that puts a file for every module that it was asked for into a folder
ASKED = (
    "import os, sys, time\n"
    "for line in sys.stdin:\n"
    "    open(f'{sys.argv[1]}/{line.strip()}', 'w').write(str(os.getpid()))\n"
)


def wait_for(path: Path) -> None:
    end = time.monotonic() + TIMEOUT_S
    while not path.exists() or not path.read_text():
        assert time.monotonic() < end, path
        time.sleep(0.01)


def compile_beside(
    monkeypatch: pytest.MonkeyPatch, folder: Path, answer: str, meanwhile: Callable[[], None], events: Events
) -> tuple[Usage, list[str]]:
    """What three modules took, of which the first has a kernel to compile, and those that were compiled here."""
    here: list[str] = []

    def compile_first() -> None:
        here.append(NAMES[0])
        with numba_event.trigger_event("numba:compile", data={}):
            meanwhile()

    for name in NAMES:
        module: Any = ModuleType(name)
        module.compile_kernels = compile_first if name == NAMES[0] else lambda name=name: here.append(name)
        monkeypatch.setitem(sys.modules, name, module)
    line = [sys.executable, "-c", f"{ASKED}{answer}", str(folder)]
    monkeypatch.setattr(kernels, "with_parent", lambda _: line)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    return kernels._compile(events, NAMES), here


def test_a_child_begins_with_the_last_module(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    answer = "    print(3, 1.5, flush=True)"
    took, here = compile_beside(monkeypatch, tmp_path, answer, lambda: wait_for(tmp_path / NAMES[1]), Events())
    assert here == [NAMES[0], NAMES[2], NAMES[1]]  # what the child has compiled is loaded
    assert took.num_compiled == 1 + 3 + 3
    assert took.cpu_s >= 3.0


@pytest.mark.parametrize("answer", ["    sys.exit(1)", "    print('nonsense', flush=True)", "    time.sleep(600)"])
def test_a_child_that_fails_or_hangs_leaves_all_to_us(
    answer: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(kernels, "_PATIENCE_S", 0.0)
    took, here = compile_beside(monkeypatch, tmp_path, answer, lambda: wait_for(tmp_path / NAMES[2]), Events())
    assert sorted(here) == sorted(NAMES)
    assert took.num_compiled == 1


def test_a_child_ends_with_a_run_that_is_stopped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    events = Events()

    def meanwhile() -> None:
        wait_for(tmp_path / NAMES[2])
        events.cancel()

    _, here = compile_beside(monkeypatch, tmp_path, "    time.sleep(600)", meanwhile, events)
    assert here == [NAMES[0]]
    with pytest.raises(InterruptedRunError):
        events.raise_if_cancelled()
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / NAMES[2]).read_text()), 0)


def test_without_a_missing_kernel_there_is_no_child(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in NAMES:
        module: Any = ModuleType(name)
        module.compile_kernels = lambda: None
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(kernels, "with_parent", lambda _: pytest.fail("a child"))
    assert kernels._compile(Events(), NAMES).num_compiled == 0


def test_a_child_fills_the_cache_for_us(tmp_path: Path) -> None:
    program = (
        "import json\n"
        "from numba.core import event\n"
        "from sfmapp.events import Events\n"
        "from sfmapp.workspace.kernels import _compile\n"
        "with event.install_recorder('numba:compile') as here:\n"
        "    took = _compile(Events(), ('sfmapp.geometry.epipolar', 'sfmapp.matching.guided'))\n"
        "print(json.dumps([took.num_compiled, sum(found.is_end for _, found in here.buffer)]))"
    )

    def run() -> list[int]:
        shown = subprocess.run(
            [sys.executable, "-c", program], env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        counts: list[int] = json.loads(shown.stdout)
        return counts

    in_all, here = run()
    assert 0 < here <= in_all
    if len(os.sched_getaffinity(0)) > 1:
        assert here < in_all
    assert run() == [0, 0]


def test_what_two_save_at_once_keeps_its_name(tmp_path: Path) -> None:
    kernel_cache.take_turns()
    kernel_cache.take_turns()  # a second time changes nothing

    def save(who: int) -> None:
        files = IndexDataCacheFile(str(tmp_path), "kernel", 0)
        for n in range(30):
            files.save((who, n), [who, n])

    threads = [threading.Thread(target=save, args=(who,)) for who in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    files = IndexDataCacheFile(str(tmp_path), "kernel", 0)
    assert [files.load((who, n)) for who in range(2) for n in range(30)] == [
        [w, n] for w in range(2) for n in range(30)
    ]


def test_where_there_are_no_locks_we_save_and_a_child_does_not(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fails(*_: object) -> None:
        raise OSError("no locks here")

    monkeypatch.setattr(fcntl, "flock", fails)
    work = kernel_cache._in_turn(lambda files: files._cache_path, fcntl.LOCK_EX, False)
    files = IndexDataCacheFile(str(tmp_path), "kernel", 0)
    assert work(files) == str(tmp_path)
    with pytest.raises(OSError, match="no locks"):
        kernel_cache._in_turn(lambda _: None, fcntl.LOCK_EX, True)(files)
