"""``sfmapp odometry`` as a command: usage, what it prints where, exit codes, and how it is stopped."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from odometry_fakes import FakeRunner, FakeSequence
from processes import start
from sfmapp.cli.main import main
from sfmapp.pipelines.odometry import track as pipeline
from sfmapp.reporting import Usage

Patch = pytest.MonkeyPatch
Capture = pytest.CaptureFixture[str]


@pytest.fixture
def fake(monkeypatch: Patch) -> Patch:
    """A tracker that finds all of fifty frames."""
    use(monkeypatch, FakeRunner())
    return monkeypatch


def use(monkeypatch: Patch, runner: FakeRunner) -> None:
    monkeypatch.setattr(pipeline, "open_sequence", lambda *_, **__: FakeSequence())
    monkeypatch.setattr(pipeline, "run_odometry", runner)
    monkeypatch.setattr(pipeline, "compile_odometry_kernels", lambda *_, **__: Usage(wall_s=0.0, cpu_s=0.0))


def test_help_names_the_commands_and_their_flags(capsys: Capture) -> None:
    for line in (["--help"], ["odometry", "--help"]):
        with pytest.raises(SystemExit) as caught:
            main(line)
        assert caught.value.code == 0
    said = capsys.readouterr().out
    for flag in (
        "--camera",
        "--mono",
        "--self-calibrate",
        "--ground-truth",
        "--imu",
        "--scale",
        "--view",
        "--no-recording",
    ):
        assert flag in said
    for flag in ("--start", "--stop", "--step", "--reverse", "--fps", "--seed", "--threads", "--set", "--json"):
        assert flag in said


@pytest.mark.parametrize("line", [[], ["frames"], ["-o", "out"], ["frames", "-o", "out", "-q", "-v"]])
def test_what_cannot_be_parsed_is_usage(line: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["odometry", *line])
    assert caught.value.code == 2


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--set", "odometry.max_trakcs=3"], ["odometry.max_trakcs", "odometry.max_tracks"]),
        (["--step", "0"], ["step"]),
        (["--stop", "none at all"], ["sequence.stop", "whole number"]),
        (["--scale", "guess"], ["--scale guess", "camera_height"]),
        (["--fps", "fast"], ["sequence.fps", "number"]),
    ],
)
def test_wrong_options_say_what_is_right_and_touch_nothing(
    flags: list[str], words: list[str], tmp_path: Path, capsys: Capture
) -> None:
    assert main(["odometry", str(tmp_path), "-o", str(tmp_path / "out"), *flags]) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in words)
    assert not (tmp_path / "out").exists()


def test_a_missing_sequence_is_bad_input(tmp_path: Path, capsys: Capture) -> None:
    line = ["odometry", str(tmp_path / "none"), "-o", str(tmp_path / "out"), "--no-recording", "--json"]
    assert main(line) == 3
    assert json.loads(capsys.readouterr().out)["exit_code"] == 3


def test_flags_reach_the_options(tmp_path: Path, fake: Patch) -> None:
    flags = "--camera PINHOLE,1,1,1,1 --mono --start 3 --stop 9 --step 2 --reverse --fps 12.5 --seed 5 --threads 1"
    line = ["odometry", "fake", "-o", str(tmp_path / "out"), "--no-recording", "-q", *flags.split()]
    assert main([*line, "--set", "odometry.max_tracks=321", "--scale", "arbitrary"]) == 0
    options = json.loads((tmp_path / "out" / "run.json").read_text())["options"]
    expected = {
        "camera": "PINHOLE,1,1,1,1",
        "mono": True,
        "start": 3,
        "stop": 9,
        "step": 2,
        "reverse": True,
        "fps": 12.5,
    }
    assert {name: options["sequence"][name] for name in expected} == expected
    assert (options["seed"], options["threads"], options["odometry"]["max_tracks"]) == (5, 1, 321)


def test_a_person_is_told_what_came_of_it(tmp_path: Path, fake: Patch, capsys: Capture) -> None:
    use(fake, FakeRunner(lost=range(20, 25)))
    assert main(["odometry", "fake", "-o", str(tmp_path / "out"), "--no-recording"]) == 0
    said = capsys.readouterr().out
    assert "45 of 50 frames have a pose" in said
    assert "unit: arbitrary" in said
    assert "no pose from frame 20 to 24 (0.6 s)" in said
    assert "against the ground truth: off by 0.0" in said
    assert "CPU ms a frame" in said
    assert "sfmapp view" not in said
    assert main(["odometry", "fake", "-o", str(tmp_path / "out"), "--no-recording", "-q"]) == 0
    assert capsys.readouterr().out == ""


def test_a_program_gets_one_document_and_events_as_lines(tmp_path: Path, fake: Patch, capsys: Capture) -> None:
    assert main(["odometry", "fake", "-o", str(tmp_path / "out"), "--no-recording", "--json"]) == 0
    said = capsys.readouterr()
    result = json.loads(said.out)
    assert result["exit_code"] == 0
    assert Path(result["trajectory"]).is_file()
    assert Path(result["model"]).is_dir()
    assert result["frames"]["num_with_pose"] == 50
    assert result["timing"]["cpu_ms_per_frame"] > 0
    events = [json.loads(line) for line in said.err.splitlines()]
    assert sum(event["kind"] == "advanced" for event in events) == 50
    assert not any("snapshot" in event.get("data", {}) for event in events)


def test_no_map_is_4(tmp_path: Path, fake: Patch, capsys: Capture) -> None:
    use(fake, FakeRunner(finds_nothing=True))
    assert main(["odometry", "fake", "-o", str(tmp_path / "out"), "--no-recording"]) == 4
    assert "no map could be initialized" in capsys.readouterr().err
    assert (tmp_path / "out" / "report.html").is_file()


def test_a_recording_can_be_looked_at(tmp_path: Path, fake: Patch, capsys: Capture) -> None:
    assert main(["odometry", "fake", "-o", str(tmp_path / "out")]) == 0
    assert f"sfmapp view {tmp_path / 'out'}" in capsys.readouterr().out
    assert (tmp_path / "out" / "recording.rrd").stat().st_size > 10_000
    assert json.loads((tmp_path / "out" / "run.json").read_text())["recording"] == "written"


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_writes_what_was_tracked(tmp_path: Path, sign: signal.Signals) -> None:
    script = (
        "import sys; sys.path.insert(0, sys.argv.pop(1))\n"
        "from odometry_fakes import FakeRunner, FakeSequence\n"
        "from sfmapp.pipelines.odometry import track as pipeline\n"
        "pipeline.open_sequence = lambda *_, **__: FakeSequence(pause_s=0.1)\n"
        "pipeline.run_odometry = FakeRunner()\n"
        "pipeline.compile_odometry_kernels = lambda *_, **__: {}\n"
        "from sfmapp.cli.main import main\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    line = [sys.executable, "-c", script, str(Path(__file__).parent), "odometry", "fake", "-o", str(tmp_path / "out")]
    child = start([*line, "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert child.stderr is not None
    for event in child.stderr:
        if json.loads(event).get("done") == 8:
            child.send_signal(sign)
            break
    out, said = child.communicate(timeout=60)
    assert child.returncode == 130, said
    assert json.loads(out)["exit_code"] == 130
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert 8 <= report["frames"]["num_with_pose"] < 50
    assert (tmp_path / "out" / "recording.rrd").is_file()
    poses = (tmp_path / "out" / "trajectory.tum").read_text().splitlines()
    assert len(poses) == 1 + report["frames"]["num_with_pose"]
