"""The command line: what it prints where, its exit codes, and how it is stopped."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import sfmapp
from processes import start
from sfmapp.cli.main import main
from sfmapp.cli.progress import JsonLines, PlainLines
from sfmapp.events import Event, Events

# what takes time and memory to load, and what an ordinary reconstruction does without
NOT_NEEDED = ("distributed", "gtsam", "http.client", "pyproj", "rerun", "scipy.linalg", "scipy.sparse", "scipy.spatial")
MODEL_FILES = ("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin")


def command(*args: object, **kwargs: object) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "sfmapp", *map(str, args)]
    return subprocess.run(line, capture_output=True, text=True, timeout=300, **kwargs)  # type: ignore[call-overload]


@pytest.fixture(scope="module")
def finished(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output of a run by the command itself; not to be changed."""
    output = tmp_path_factory.mktemp("cli") / "out"
    listed = os.environ | {"PYTHONPROFILEIMPORTTIME": "1"}
    done = command("reconstruct", photos, "-o", output, "--no-recording", env=listed)
    assert done.returncode == 0, done.stderr
    loaded = set(re.findall(r"\| +([\w.]+)$", done.stderr, re.MULTILINE))
    assert "sfmapp.mapping.mapper" in loaded
    assert [name for name in NOT_NEEDED if name in loaded] == []
    assert "7 of 7 images registered" in done.stdout
    assert re.search(r"took \d+\.\d s, \d+\.\d CPU s, \d+ MB", done.stdout)
    for stage in ("images:", "features:", "pairs:", "matching:", "mapping:"):
        assert stage in done.stderr
    return output


# ----------------------------------------------------------------------------------------------------- help and usage


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["--version"])
    assert caught.value.code == 0
    assert capsys.readouterr().out == f"sfmapp {sfmapp.__version__}\n"


@pytest.mark.parametrize("name", [[], ["reconstruct"], ["demo"], ["view"], ["validate"], ["export"]])
def test_every_command_has_help(name: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([*name, "--help"])
    assert caught.value.code == 0
    assert "usage: sfmapp" in capsys.readouterr().out


@pytest.mark.parametrize(
    "args",
    [
        [],
        ["nonsense"],
        ["reconstruct"],
        ["reconstruct", "photos"],
        ["reconstruct", "-o", "out"],
        ["reconstruct", "photos", "-o", "out", "-q", "-v"],
        ["export", "out", "--to", "nonsense", "-o", "x"],
        ["export", "out"],
    ],
)
def test_what_cannot_be_parsed_is_usage(args: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as caught:
        main(args)
    assert caught.value.code == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "line", ["odometry walk.mp4 -o out --no-record", "dense out --masks m", "reconstruct p -o out --no-rec"]
)
def test_a_flag_has_one_spelling(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(line.split())
    assert caught.value.code == 2
    assert "unrecognized arguments: --" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (
            ["--set", "features.max_num_feature=3"],
            ["features.max_num_feature", "did you mean features.max_num_features"],
        ),
        (["--set", "features"], ["stage.option=value"]),
        (["--preset", "fsat"], ["fsat", "did you mean fast"]),
        (["--camera-model", "PINHOL"], ["camera_model", "PINHOLE"]),
        (["--threads", "none at all"], ["threads", "whole number"]),
        (["--seed", "-3"], ["seed"]),
        (["--min-registered", "1"], ["min_registered"]),
    ],
)
def test_wrong_options_say_what_is_right_and_touch_nothing(
    flags: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["reconstruct", str(tmp_path), "-o", str(tmp_path / "out"), *flags]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in words)
    assert "Traceback" not in said
    assert not (tmp_path / "out").exists()


def test_options_can_be_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", "--list-options"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"^features\.max_num_features +\d+ +\[int\]$", said, re.M)
    assert main(["reconstruct", "--list-options", "--json"]) == 0
    names = [option["name"] for option in json.loads(capsys.readouterr().out)]
    assert {"seed", "threads", "images.camera_model", "adjust.backend", "mapping.min_pose_inliers"} <= set(names)


def test_a_reader_that_leaves_early_is_no_failure() -> None:
    line = f"{sys.executable} -m sfmapp reconstruct --list-options | head -n 1"
    done = subprocess.run(["bash", "-o", "pipefail", "-c", line], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


# --------------------------------------------------------------------------------------------------------- exit codes


def test_the_second_run_says_that_there_is_nothing_to_do(photos: Path, finished: Path) -> None:
    done = command("reconstruct", photos, "-o", finished, "--no-recording")
    assert done.returncode == 0
    assert "up to date: nothing to do" in done.stdout
    assert "features" not in done.stderr


def test_json_gives_one_document_and_events_as_lines(photos: Path, finished: Path) -> None:
    done = command("reconstruct", photos, "-o", finished, "--no-recording", "--json")
    result = json.loads(done.stdout)
    assert (result["exit_code"], result["num_registered"], result["not_registered"]) == (0, 7, [])
    assert Path(result["model"]).is_dir()
    assert {"wall_s", "cpu_s", "peak_memory_mb", "is_up_to_date"} <= set(result["run"])
    assert {json.loads(line)["kind"] for line in done.stderr.splitlines()} >= {"started", "finished"}


def test_quiet_says_nothing(photos: Path, finished: Path) -> None:
    done = command("reconstruct", photos, "-o", finished, "--no-recording", "-q")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_bad_input_is_3(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", str(tmp_path / "none"), "-o", str(tmp_path / "out"), "--json"]) == 3
    said = capsys.readouterr()
    result = json.loads(said.out)
    assert result["exit_code"] == 3
    assert str(tmp_path / "none") in result["error"]
    assert main(["view", str(tmp_path)]) == 3
    assert main(["validate", str(tmp_path)]) == 3
    assert main(["export", str(tmp_path), "--to", "ply", "-o", str(tmp_path / "x.ply")]) == 3


def test_no_reconstruction_is_4_with_advice_and_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "photos").mkdir()
    assert main(["reconstruct", str(tmp_path / "photos"), "-o", str(tmp_path / "out")]) == 4
    said = capsys.readouterr().err
    assert "sfmapp: no usable photograph" in said
    assert "at least two photographs" in said
    assert "Traceback" not in said
    assert (tmp_path / "out" / "report.html").is_file()


def test_a_folder_of_the_users_is_refused(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert main(["reconstruct", str(photos), "-o", str(tmp_path)]) == 2
    assert "mine.txt" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_fewer_images_than_asked_for_is_5(photos: Path, finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["reconstruct", str(photos), "-o", str(finished), "--no-recording", "--min-registered"]
    assert main([*line, "8"]) == 5
    assert "7 images are registered, 8 were asked for" in capsys.readouterr().err
    assert main([*line, "7"]) == 0


def test_a_bug_is_1_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def bug(*_: object, **__: object) -> None:
        raise ValueError("two\nlines")

    monkeypatch.setattr("sfmapp.pipelines.sparse.videos.load_images", bug)
    line = ["reconstruct", str(tmp_path), "-o", str(tmp_path / "out")]
    assert main(line) == 1
    said = capsys.readouterr().err
    assert "sfmapp: a bug in sfmapp: ValueError: two lines\n" in said
    assert "Traceback" not in said
    assert "Traceback" in (tmp_path / "out" / "log.jsonl").read_text()
    with pytest.raises(ValueError, match="two"):
        main([*line, "-v"])


# ------------------------------------------------------------------------------------------------------- interruption


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_cleanly_and_the_same_command_resumes(
    photos: Path, finished: Path, tmp_path: Path, sign: signal.Signals
) -> None:
    output = tmp_path / "out"
    line = [sys.executable, "-m", "sfmapp", "reconstruct", str(photos), "-o", str(output), "--no-recording", "--json"]
    child = start(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert child.stderr is not None
    for event in child.stderr:
        if json.loads(event)["kind"] == "advanced" and json.loads(event)["stage"] == "features":
            child.send_signal(sign)
            break
    out, said = child.communicate(timeout=120)
    assert child.returncode == 130
    result = json.loads(out)
    assert result["exit_code"] == 130
    assert result["advice"] == "run the same command again to resume"
    assert "Traceback" not in said
    assert not (output / ".lock").exists()
    done = command("reconstruct", photos, "-o", output, "--no-recording", "--json")
    assert done.returncode == 0, done.stderr
    events = [json.loads(event) for event in done.stderr.splitlines()]
    (extraction,) = [event["data"] for event in events if (event["kind"], event["stage"]) == ("finished", "features")]
    assert extraction["num_known"] >= 1
    for name in MODEL_FILES:
        assert (output / "sparse/0" / name).read_bytes() == (finished / "sparse/0" / name).read_bytes()


def test_a_killed_run_resumes_too(photos: Path, finished: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    line = [sys.executable, "-m", "sfmapp", "reconstruct", str(photos), "-o", str(output), "--no-recording", "--json"]
    child = start(line, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    assert child.stderr is not None
    for event in child.stderr:
        if json.loads(event)["kind"] == "advanced" and json.loads(event)["stage"] == "matching":
            child.kill()
            break
    child.communicate()
    assert command("reconstruct", photos, "-o", output, "--no-recording").returncode == 0
    for name in MODEL_FILES:
        assert (output / "sparse/0" / name).read_bytes() == (finished / "sparse/0" / name).read_bytes()


# ------------------------------------------------------------------------------------------------------------ progress


def some_run(events: Events) -> None:
    events.started("features", "sift on 2 images", total=2)
    events.started("kernels", "compiling kernels, once")
    events.advanced("features", message="a.jpg", snapshot=object())
    events.warned("features", "b.jpg: [bold]no features[/bold]")
    events.advanced("features")
    events.decided("features", "something was decided", number=3)
    events.finished("kernels")
    events.finished("features", "200 keypoints in 2 images")


@pytest.mark.parametrize("is_verbose", [False, True])
def test_plain_lines(is_verbose: bool, capsys: pytest.CaptureFixture[str]) -> None:
    some_run(Events(PlainLines(is_verbose=is_verbose)))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "features: sift on 2 images"
    assert "warning: b.jpg: [bold]no features[/bold]" in lines
    assert ("  something was decided" in lines) == is_verbose
    assert re.fullmatch(r"features: 200 keypoints in 2 images \(\d\.\d s\)", lines[-1])


def test_plain_lines_estimate_the_time_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    listener = PlainLines()
    listener(Event("started", "features", total=4, time_s=1.0))
    listener(Event("advanced", "features", done=1, total=4, time_s=3.0))
    assert "left" not in capsys.readouterr().err  # too soon to say anything again
    monkeypatch.setattr("sfmapp.cli.progress.PLAIN_PERIOD_S", 0.0)
    listener(Event("advanced", "features", done=2, total=4, time_s=5.0))
    assert capsys.readouterr().err == "features: 2 of 4, about 4 s left\n"


def test_quiet_lines_are_warnings_only(capsys: pytest.CaptureFixture[str]) -> None:
    some_run(Events(PlainLines(is_quiet=True)))
    assert capsys.readouterr().err == "warning: b.jpg: [bold]no features[/bold]\n"


def test_json_lines_leave_arrays_out(capsys: pytest.CaptureFixture[str]) -> None:
    some_run(Events(JsonLines()))
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert len(events) == 8
    assert events[2] == {"time_s": events[2]["time_s"], "kind": "advanced", "stage": "features", "message": "a.jpg",
                         "done": 1, "total": 2}  # fmt: skip


def test_bars_on_a_terminal_end_with_a_line_per_stage() -> None:
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); from test_cli import some_run;"
        "from sfmapp.cli.progress import make_listener; from sfmapp.events import Events;"
        "listener = make_listener(quiet=False, verbose=True, as_json=False);"
        "some_run(Events(listener)); listener.close()"
    )
    ours, theirs = os.openpty()
    line = [sys.executable, "-c", code, str(Path(__file__).parent)]
    done = subprocess.run(line, stderr=theirs, stdout=subprocess.PIPE, env={**os.environ, "TERM": "xterm"}, timeout=60)
    os.close(theirs)
    text = os.read(ours, 1 << 16)
    os.close(ours)
    assert done.returncode == 0, text.decode()
    assert b"warning: b.jpg: [bold]no features[/bold]" in text
    assert b"200 keypoints in 2 images" in text


# ---------------------------------------------------------------------------------------------------------- the sample


@pytest.mark.slow
def test_the_demo_prints_its_error_against_the_ground_truth(sample: Path, tmp_path: Path) -> None:
    num_images = len(list((sample / "images").iterdir()))
    done = command("demo", "-o", tmp_path / "demo", "--json", "--min-registered", num_images)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["ground_truth"]["num_common"] == num_images
    # a tenth of a pixel of noise at the sample's distances and 150 points per view and more
    assert result["ground_truth"]["center_error_share"]["max"] < 2e-3
    assert result["ground_truth"]["rotation_error_deg"]["max"] < 0.1
    again = command("demo", "-o", tmp_path / "demo")
    assert again.returncode == 0
    assert "against the ground truth" in again.stdout
    assert "nothing to do" in again.stdout
