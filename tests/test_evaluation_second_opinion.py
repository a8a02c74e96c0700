"""pycolmap in a child process, and the measuring of children."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from sfmapp.errors import InputError, InterruptedRunError, SfmError
from sfmapp.evaluation import second_opinion
from sfmapp.evaluation.measured import high_water_mark_mb, run_measured
from sfmapp.evaluation.second_opinion import CameraGroup, SecondOpinionOptions, ask_second_opinion
from sfmapp.events import Event, Events

DATA = Path(os.environ.get("SFMAPP_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
BULL = DATA / "sfmtool-seoul-bull" / "images"

linux_only = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads /proc")


# ------------------------------------------------------------------------------------------------- measuring a process


def python(code: str) -> list[str]:
    return [sys.executable, "-S", "-c", code]


def test_usage_of_a_child_that_sleeps_and_one_that_works(tmp_path: Path) -> None:
    asleep = run_measured(python("import time; time.sleep(0.5)"), tmp_path / "log")
    assert asleep.exit_code == 0
    assert asleep.wall_s >= 0.5
    assert asleep.cpu_s < 0.4
    busy = run_measured(python("import time\nwhile time.process_time() < 0.6: pass"), tmp_path / "log")
    assert 0.6 <= busy.cpu_s < 1.2
    assert busy.wall_s >= 0.6


def test_work_of_grandchildren_counts(tmp_path: Path) -> None:
    worker = "import time\nwhile time.process_time() < 0.5: pass"
    usage = run_measured(python(f"import subprocess, sys; subprocess.run([sys.executable, '-c', {worker!r}])"),
                         tmp_path / "log")  # fmt: skip
    assert usage.cpu_s >= 0.5


@linux_only
def test_memory_is_the_childs_own(tmp_path: Path) -> None:
    """A parent of 300 MB must not lend its size to a small child, as ru_maxrss alone would have it."""
    ballast = np.ones(300_000_000, np.uint8)
    small = run_measured(python("import time; time.sleep(0.2)"), tmp_path / "log")
    large = run_measured(python("import time; x = b'1' * 150_000_000; time.sleep(0.2)"), tmp_path / "log")
    assert high_water_mark_mb() > 300 > ballast.sum() / 1e9
    assert 2 < small.peak_memory_mb < 100
    assert 150 < large.peak_memory_mb < 250


def test_lines_come_whole_and_in_order(tmp_path: Path) -> None:
    lines: list[str] = []
    code = "import sys, time\nfor i in range(3):\n print('line', i, 'x' * 100000, flush=True)\n time.sleep(0.05)\n"
    run_measured(python(code + "print('trouble', file=sys.stderr)"), tmp_path / "log", on_line=lines.append)
    assert [line[:6] for line in lines] == ["line 0", "line 1", "line 2"]
    assert all(len(line) == 100007 for line in lines)
    assert (tmp_path / "log").read_text() == "trouble\n"


def test_failures_keep_their_code_and_a_stop_kills(tmp_path: Path) -> None:
    assert run_measured(python("raise SystemExit(3)"), tmp_path / "log").exit_code == 3
    assert run_measured(python("import os; os.kill(os.getpid(), 9)"), tmp_path / "log").exit_code == -9
    pids: list[int] = []

    def stop() -> None:
        if pids:
            raise InterruptedRunError("stop")

    code = "import os, time; print(os.getpid(), flush=True); time.sleep(60)"
    with pytest.raises(InterruptedRunError):
        run_measured(python(code), tmp_path / "log", on_line=lambda line: pids.append(int(line)), on_tick=stop)
    with pytest.raises(ProcessLookupError):
        os.kill(pids[0], 0)


# ----------------------------------------------------------------------------------------------------- asking pycolmap


def save_noise(folder: Path, count: int) -> list[str]:
    from PIL import Image

    rng = np.random.default_rng(0)
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{i}.png" for i in range(count)]
    for name in names:
        Image.fromarray(rng.integers(0, 255, (48, 64), np.uint8)).save(folder / name)
    return names


def test_no_reconstruction_is_an_answer_and_is_remembered(tmp_path: Path) -> None:
    names = save_noise(tmp_path / "photos", 2)
    heard: list[Event] = []
    options = SecondOpinionOptions(num_threads=1)
    answer = ask_second_opinion(tmp_path / "photos", names, tmp_path / "out", options, fingerprint="a",
                                events=Events(heard.append))  # fmt: skip
    assert (answer.num_images, answer.num_registered, answer.num_points, answer.num_models) == (2, 0, 0, 0)
    assert answer.model_folder is None
    assert set(answer.phases) == {"import", "extract", "match", "map"}
    assert sum(phase["wall_s"] for phase in answer.phases.values()) <= answer.wall_s
    assert 20 < answer.peak_memory_mb < 2000
    assert [event.kind for event in heard] == ["started", *["advanced"] * 4, "finished"]
    before = len(heard)
    again = ask_second_opinion(tmp_path / "photos", names, tmp_path / "out", options, fingerprint="a",
                               events=Events(heard.append))  # fmt: skip
    assert again == answer
    assert len(heard) == before


def test_an_answer_to_another_question_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The old database would otherwise bring its features along. Strangers' files stay."""
    out = tmp_path / "out"
    (out / "sparse" / "0").mkdir(parents=True)
    for name in ("database.db", "answer.json", "request.json", "mine.txt", "sparse/0/images.bin", "sparse/0/mine.txt"):
        (out / name).write_text("{}")

    def run(command: list[str], log: Path, **_: object) -> None:
        assert sorted(p.name for p in out.rglob("*") if p.is_file()) == ["mine.txt", "mine.txt", "request.json"]
        raise InterruptedRunError("far enough")

    monkeypatch.setattr(second_opinion, "run_measured", run)
    names = save_noise(tmp_path / "photos", 2)
    with pytest.raises(InterruptedRunError):
        ask_second_opinion(tmp_path / "photos", names, out, fingerprint="b")
    request = json.loads((out / "request.json").read_text())
    assert request["image_names"] == names
    assert request["options"]["camera_model"] == "SIMPLE_RADIAL"


def test_failures_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="photographs"):
        ask_second_opinion(tmp_path / "nothing", [], tmp_path / "out")
    names = save_noise(tmp_path / "photos", 2)
    with pytest.raises(SfmError, match="ExistsCameraModelWithName"):
        ask_second_opinion(tmp_path / "photos", names, tmp_path / "out", SecondOpinionOptions("auto", "NO_SUCH_MODEL"))


@pytest.mark.slow
@pytest.mark.real
@pytest.mark.skipif(not BULL.is_dir(), reason="no data: set SFMAPP_DATA")
def test_real_photographs_with_our_cameras(tmp_path: Path) -> None:
    """Seventeen small photographs; intrinsics as given stay as given, and the model on disk is the one described."""
    from sfmapp.formats.colmap import read_model

    names = sorted(path.name for path in BULL.glob("*.jpg"))
    params = (344.0, 135.0, 240.0, 0.0)
    options = SecondOpinionOptions(fix_intrinsics=True, num_threads=2)
    answer = ask_second_opinion(BULL, names, tmp_path, options, camera_groups=[CameraGroup(tuple(names), params)])
    assert answer.num_registered >= 12
    assert answer.model_folder is not None
    model = read_model(answer.model_folder)[0]
    assert [camera.params.tolist() for camera in model.cameras] == [list(params)]
    summary = model.summary()
    assert summary["num_registered"] == answer.num_registered
    assert summary["num_points"] == answer.num_points
    assert summary["num_observations"] == answer.num_observations
    # the same error by our own projection: model, residual and pixel conventions agree
    assert summary["mean_reprojection_error_px"] == pytest.approx(answer.mean_reprojection_error_px, rel=1e-6)
    assert answer.cpu_s > 1
