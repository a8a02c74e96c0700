"""What surrounds a run: places that cannot be written, streams that are closed or full, signals, parents that end."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import sfmapp
from processes import start
from sfmapp import children, kernel_cache
from sfmapp.cli import signals
from sfmapp.cli.main import main
from sfmapp.cli.streams import Stream
from sfmapp.errors import InputError, is_full, refusal
from sfmapp.events import Event, Events
from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.trajectory import GrowingTum
from sfmapp.formats.trajectory_input import read_tum
from sfmapp.geometry import rigid3
from sfmapp.workspace.listeners import EventLog
from sfmapp.workspace.manifest import read_manifest

ROOT = os.geteuid() == 0
# Root may write anywhere; without these two capabilities (PR_CAPBSET_DROP is 24) it is held to the modes of files.
AS_ANYBODY = """import ctypes, os, sys
for capability in (1, 2):
    ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)
os.execv(sys.argv[1], sys.argv[1:])"""
Capture = pytest.CaptureFixture[str]


def wait_for(condition: Callable[[], bool], seconds: float = 20.0) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


def is_running(pid: int) -> bool:
    """Not ended, and no zombie that nobody has waited for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


# ------------------------------------------------------------------------------------------------ places for kernels


KERNELS = """import numba
import numpy as np

@numba.njit(cache=True)
def total(values):
    return np.sum(np.sort(values)[1:])

@numba.njit(cache=True)
def twice(values):
    return 2.0 * total(values)
"""
CALL = """import sys
from sfmapp.kernel_cache import load_numba_sparingly
load_numba_sparingly()
import numpy as np, kernels
for name in sys.argv[1:]:
    print(getattr(kernels, name)(np.array([3.0, 1.0, 2.0])))
read = [made.library._shared_module is not None for made in kernels.total.overloads.values()]
print("numba.np.arraymath" in sys.modules, "scipy.linalg" in sys.modules, *read)
"""


def test_kernels_of_the_cache_are_loaded_without_what_compiles_others(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS)
    environment = os.environ | {
        kernel_cache.VARIABLE: str(tmp_path / "cache"), "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
    }  # fmt: skip

    def call(*names: str) -> list[str]:
        done = subprocess.run([sys.executable, "-c", CALL, *names], env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    assert call("total") == ["5.0", "True False True"]  # compiled, without BLAS
    assert call("total") == ["5.0", "False False False"]  # from the cache, whose bitcode nobody needs
    # one from the cache, and one that calls it compiled, from its bitcode
    assert call("total", "twice") == ["5.0", "10.0", "True False True"]
    assert call("twice", "total") == ["10.0", "5.0", "False False False"]


def test_a_command_that_ends_looks_for_no_rubbish() -> None:
    code = """import atexit, gc
atexit.register(lambda: print(gc.get_freeze_count() > 1000, gc.isenabled()))  # after what main registers
from sfmapp.cli.main import main
for _ in range(2):
    try:
        main(["--version"])
    except SystemExit:
        print(gc.get_freeze_count())"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stdout.splitlines() if not line.startswith("sfmapp")] == ["0", "0", "True True"]


@pytest.fixture
def locked_package(tmp_path: Path) -> Iterator[Path]:
    """A copy of the package in which nobody may write."""
    package = tmp_path / "packages" / "sfmapp"
    shutil.copytree(Path(sfmapp.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    folders = [package.parent, package, *(path for path in package.rglob("*") if path.is_dir())]
    for folder in folders:
        folder.chmod(0o555)
    yield package.parent
    for folder in folders:
        folder.chmod(0o755)


@pytest.mark.skipif(sys.platform != "linux", reason="capabilities are Linux's")
def test_where_only_the_temporary_folder_can_be_written_kernels_go_there(locked_package: Path, tmp_path: Path) -> None:
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    temporary.chmod(0o1777)
    site = os.pathsep.join(path for path in sys.path if path.endswith("-packages"))
    line = [sys.executable, "-c", "import sfmapp.geometry.epipolar"]
    env = {"PYTHONPATH": f"{locked_package}{os.pathsep}{site}", "HOME": "/dev/null/none", "TMPDIR": str(temporary)}
    done = subprocess.run(
        [sys.executable, "-c", AS_ANYBODY, *line] if ROOT else line,
        env=env | {"PYTHONDONTWRITEBYTECODE": "1"}, cwd=tmp_path, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    private = temporary / f"{kernel_cache.NAME}-{os.geteuid()}"
    assert stat.S_IMODE(private.stat().st_mode) == 0o700
    assert list(private.iterdir())
    assert not list(locked_package.rglob("__pycache__"))


def test_only_a_folder_that_nobody_else_can_change_will_do(tmp_path: Path) -> None:
    name = f"{kernel_cache.NAME}-{os.geteuid()}"
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    assert kernel_cache._private_folder(shared) is None  # others could put their own in its place
    shared.chmod(0o1777)
    assert kernel_cache._private_folder(shared) == shared / name
    assert kernel_cache._private_folder(shared) == shared / name  # and again by the next run
    for mode in (0o777, 0o770, 0o755):  # what lies in it may be of others
        (shared / name).chmod(mode)
        assert kernel_cache._private_folder(shared) is None
    (shared / name).rmdir()
    (tmp_path / "trap").mkdir(mode=0o700)
    (shared / name).symlink_to(tmp_path / "trap")
    assert kernel_cache._private_folder(shared) is None
    assert kernel_cache._private_folder(tmp_path / "missing") is None


@pytest.mark.skipif(not ROOT, reason="only root can give a folder to somebody else")
def test_a_folder_that_somebody_else_has_made_will_not_do(tmp_path: Path) -> None:
    tmp_path.chmod(0o1777)
    folder = tmp_path / f"{kernel_cache.NAME}-{os.geteuid()}"
    folder.mkdir(mode=0o700)
    os.chown(folder, 12345, 12345)
    assert kernel_cache._private_folder(tmp_path) is None
    assert not kernel_cache.is_ours_alone(folder)


def test_a_home_that_others_can_write_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(kernel_cache.VARIABLE, raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(kernel_cache, "_PACKAGE", tmp_path / "package")
    (tmp_path / "package" / "room").mkdir(parents=True)
    (tmp_path / "package" / "room" / "__init__.py").touch()
    (tmp_path / "package" / "room" / "__pycache__").touch()  # a file: no folder can be made there
    home, temporary = tmp_path / "home", tmp_path / "tmp"
    (home / ".cache" / "numba").mkdir(parents=True)
    temporary.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("TMPDIR", str(temporary))
    kernel_cache.provide_kernel_cache()
    assert kernel_cache.VARIABLE not in os.environ  # numba's own will do
    (home / ".cache").chmod(0o777)
    kernel_cache.provide_kernel_cache()
    assert os.environ.pop(kernel_cache.VARIABLE) == str(temporary / f"{kernel_cache.NAME}-{os.geteuid()}")
    import numba

    numba.config.CACHE_DIR = ""


def test_without_any_place_the_advice_is_what_to_set(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    import numba

    def fails(*_: object, **__: object) -> None:
        space: dict[str, object] = {}
        exec(compile("def kernel(): return 1", "<nowhere>", "exec"), space)
        numba.njit(cache=True)(space["kernel"])  # what numba itself says where it finds no place

    monkeypatch.setattr("sfmapp.pipelines.export.export_model", fails)
    assert main(["export", "out", "--to", "ply", "-o", "x"]) == 3
    said = capsys.readouterr().err
    assert kernel_cache.VARIABLE in said
    assert "bug" not in said


# ---------------------------------------------------------------------------------------------------- standard streams


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize(
    ("redirection", "code", "said"),
    [(">&-", 0, ""), (">/dev/full", 3, "No space left"), (">/dev/null 2>/dev/full", 0, ""), (">&- 2>&- <&-", 0, "")],
)
def test_streams_that_are_closed_or_full(redirection: str, code: int, said: str) -> None:
    line = f"{sys.executable} -m sfmapp reconstruct --list-options {redirection}"
    done = subprocess.run(["sh", "-c", line], capture_output=True, text=True, timeout=60)
    assert done.returncode == code, done.stderr
    assert said in done.stderr
    assert "bug" not in done.stderr
    assert "Exception ignored" not in done.stderr


def test_a_stream_that_fails_is_given_up_and_any_name_can_be_printed(tmp_path: Path) -> None:
    with open(tmp_path / "latin.txt", "w", encoding="latin-1") as file:
        stream = Stream(file)
        print("caf\xe9 \u2192 \udcff", file=stream)
        stream.flush()
        assert stream.error is None
    assert (tmp_path / "latin.txt").read_bytes() == b"caf\xe9 \\u2192 \\udcff\n"
    with open("/dev/full", "w", encoding="utf-8") as full:
        stream = Stream(full)
        for _ in range(3):
            print("x", file=stream, flush=True)
        assert isinstance(stream.error, OSError)
        assert stream.has_lost_text


# -------------------------------------------------------------------------------------------------------------- signals


@pytest.mark.parametrize("number", signals.STOPPING)
def test_signals_ask_once_and_one_that_is_ignored_stays_so(number: signal.Signals) -> None:
    asked: list[int] = []
    inherited = signal.signal(number, signal.SIG_DFL)  # a shell's background jobs ignore SIGINT
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with signals.signals_stop(lambda: asked.append(1), is_talking=False):
            os.kill(os.getpid(), number)
            os.kill(os.getpid(), number)  # timeout(1) signals the process and then its group
        assert len(asked) == (0 if number == signal.SIGHUP else 1)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
        signal.signal(signal.SIGHUP, before)
        with pytest.raises(KeyboardInterrupt), signals.signals_interrupt():
            os.kill(os.getpid(), number)
    finally:
        signal.signal(signal.SIGHUP, before)
        signal.signal(number, inherited)


# ------------------------------------------------------------------------------------------------------------- children

STARTS = {
    "kernel": "subprocess.Popen(children.with_parent(['sleep', '60']))",
    "supervised": "subprocess.Popen([sys.executable, '-c', 'import os; from sfmapp import children;"
    ' children.supervise(os.getppid(), ["sleep", "60"])\'])',
}


@pytest.mark.parametrize("how", list(STARTS))
def test_a_child_ends_with_its_parent_however_that_ends(how: str) -> None:
    if how == "kernel" and sys.platform != "linux":
        pytest.skip("the kernel's own way is Linux's")
    script = (
        f"import subprocess, sys, time; from sfmapp import children; {STARTS[how]}; print(flush=True); time.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    parent.stdout.readline()

    def sleeper() -> list[int]:
        found = []
        for path in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                if path.read_bytes() == b"sleep\x0060\x00" and descends(int(path.parent.name), parent.pid):
                    found.append(int(path.parent.name))
            except OSError:
                continue
        return found

    assert wait_for(lambda: len(sleeper()) == 1)
    (child,) = sleeper()
    parent.kill()
    parent.wait()
    assert wait_for(lambda: not is_running(child))


def descends(pid: int, ancestor: int) -> bool:
    while pid > 1:
        if pid == ancestor:
            return True
        pid = int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
    return False


def test_a_child_gives_its_own_exit_code_and_says_when_it_is_not_there() -> None:
    assert subprocess.run(children.with_parent(["sh", "-c", "exit 7"]), check=False).returncode == 7
    done = subprocess.run(children.with_parent(["/nowhere/program"]), capture_output=True, text=True, check=False)
    assert done.returncode == children.NOT_FOUND
    assert "/nowhere/program: No such file" in done.stderr


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_the_server_of_a_view_ends_with_it(number: signal.Signals, tmp_path: Path) -> None:
    rr = pytest.importorskip("rerun")
    path = tmp_path / "recording.rrd"
    with rr.RecordingStream("test") as recording:
        recording.save(path)
        recording.log("a", rr.TextLog("b"))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    line = [sys.executable, "-m", "sfmapp", "view", str(path), "--serve", "--port", str(port)]
    with (tmp_path / "said.txt").open("wb") as said:
        parent = start(line, stdout=said, stderr=said)

    def is_serving() -> bool:
        with socket.socket() as client:
            return client.connect_ex(("127.0.0.1", port)) == 0

    assert wait_for(is_serving, 60.0), (tmp_path / "said.txt").read_text()
    parent.send_signal(number)
    assert parent.wait(20) == (-number if number == signal.SIGKILL else 0)
    assert wait_for(lambda: not is_serving())


# ----------------------------------------------------------------------------------------------- refusals of the system


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EISDIR, errno.EMFILE])
def test_a_refusal_of_the_system_is_no_bug(number: int, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    def fails(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number), "some/file")

    monkeypatch.setattr("sfmapp.pipelines.export.export_model", fails)
    assert main(["export", "out", "--to", "ply", "-o", "x"]) == 3
    first, advice = capsys.readouterr().err.splitlines()
    assert first == f"sfmapp: some/file: {os.strerror(number)}"
    assert advice.strip()


def test_without_a_temporary_folder_the_advice_is_what_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: ["/dev/null/none"])
    with pytest.raises(FileNotFoundError) as caught:
        tempfile.gettempdir()
    failure = refusal(caught.value)
    assert failure is not None
    assert failure.advice is not None
    assert "TMPDIR" in failure.advice


def test_what_only_we_can_have_done_wrong_stays_a_bug() -> None:
    assert refusal(OSError(errno.EBADF, "Bad file descriptor")) is None
    assert refusal(OSError("no number")) is None


def test_a_full_disk_is_known_behind_its_message(tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught, replaced_file(tmp_path / "a"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert is_full(caught.value)
    assert caught.value.advice is not None
    assert not is_full(InputError("something else"))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_log_that_cannot_be_written_is_a_warning(tmp_path: Path) -> None:
    for path in (Path("/dev/full"), tmp_path):  # a full disk, and a folder where the log should be
        told: list[Event] = []
        events = Events(told.append)
        with EventLog(path, events, source="x") as log:
            events.subscribe(log)
            for _ in range(3):
                events.decided("stage", "something")
        assert [event.kind for event in told].count("warned") == 1
        assert len(told) == 4


def test_a_trajectory_holds_whole_lines_when_the_disk_fills(tmp_path: Path) -> None:
    """A limit on the size of files lets the last write end in the middle of its line, as a full disk does."""
    path = tmp_path / "trajectory.tum"
    rng = np.random.default_rng(0)
    poses = rigid3.from_matrix(rigid3.exp_so3(rng.normal(size=(20, 3))), rng.normal(size=(20, 3)))
    growing = GrowingTum(path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    written = 0

    def write_until_full() -> None:
        nonlocal written
        for k, pose in enumerate(poses):
            growing.append(float(k), pose)
            written = k + 1

    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            write_until_full()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    growing.append(99.0, poses[0])  # there is room again
    growing.append(100.0, np.full(7, np.nan))  # no pose, no line
    growing.close()
    names, found = read_tum(path)
    assert 3 < written < 20
    assert [float(name) for name in names] == [*range(written), 99.0]
    np.testing.assert_allclose(found[:written], poses[:written], atol=1e-12)


# ------------------------------------------------------------------------------------- odometry on its way to the disk

FAKE_RUN = """import os, sys
sys.path.insert(0, sys.argv.pop(1))
import odometry_fakes as fakes
fakes.WIDTH, fakes.HEIGHT = 640, 480
from sfmapp.pipelines.odometry import track as pipeline
pipeline.open_sequence = lambda *_, **__: fakes.FakeSequence(pause_s=float(os.environ["PAUSE"]))
pipeline.run_odometry = fakes.FakeRunner()
pipeline.compile_odometry_kernels = lambda *_, **__: {}
from sfmapp.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


def fake_odometry(output: Path, pause_s: float = 0.0) -> tuple[list[str], dict[str, str]]:
    line = [sys.executable, "-c", FAKE_RUN, str(Path(__file__).parent), "odometry", "fake", "-o", str(output), "-q"]
    return line, os.environ | {"PAUSE": str(pause_s)}


def test_a_killed_odometry_leaves_the_poses_it_had(tmp_path: Path, capsys: Capture) -> None:
    from odometry_fakes import path

    output = tmp_path / "out"
    live = output / "trajectory_live.tum"
    output.mkdir()
    line, env = fake_odometry(output, 0.1)
    child = subprocess.Popen([*line, "--no-recording"], env=env)
    assert wait_for(lambda: live.is_file() and len(live.read_bytes().splitlines()) > 8, 60.0)
    child.kill()
    child.wait()
    names, poses = read_tum(live)
    assert len(names) >= 8
    ground_truth = path(50)[: len(names)]  # of which the fake finds the rotations, and half of the translations
    np.testing.assert_allclose([float(name) for name in names], np.arange(len(names)) / 10.0)
    np.testing.assert_allclose(np.abs(np.sum(poses[:, :4] * ground_truth[:, :4], 1)), 1.0, atol=1e-12)
    np.testing.assert_allclose(poses[:, 4:], 0.5 * ground_truth[:, 4:], atol=0.1)
    # what is left is no result, and is not taken for one
    assert main(["evaluate", str(output), str(live), "--no-plot"]) == 3
    assert "trajectory_live.tum" in capsys.readouterr().err
    with pytest.raises(InputError, match="was interrupted"):
        read_manifest(output)  # which refine and export begin with
    line, env = fake_odometry(output)
    assert subprocess.run([*line, "--no-recording"], env=env, check=False, timeout=60).returncode == 0
    assert len(read_tum(live)[0]) == len(read_tum(output / "trajectory.tum")[0]) == 50
    assert main(["evaluate", str(output), str(live), "--no-plot"]) == 0


@pytest.mark.skipif(not ROOT, reason="a small file system has to be mounted, which is root's right")
@pytest.mark.parametrize(("size_kb", "code"), [(600, 0), (64, 3)])
def test_on_a_full_disk_the_recording_goes_first_and_poses_stay(size_kb: int, code: int, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size_kb}k", "tmpfs", disk], check=False).returncode:
        pytest.skip("no file system can be mounted here")
    try:
        line, env = fake_odometry(disk / "out", 0.03)
        done = subprocess.run(line, env=env, capture_output=True, text=True, timeout=100, check=False)
        assert done.returncode == code, done.stderr
        assert "bug" not in done.stderr
        assert not list((disk / "out").glob("*recording.rrd*"))
        assert len(read_tum(disk / "out" / "trajectory_live.tum")[0]) == 50
        assert (disk / "out" / "report.json").is_file() == (code == 0)
        assert ("sfmapp: " in done.stderr) == (code == 3)
        # whoever notices first, the recorder or the run, words it
        assert ("no recording: " in done.stderr) == (code == 0)
    finally:
        subprocess.run(["umount", disk], check=True)
