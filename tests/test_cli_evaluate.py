"""``sfmapp evaluate``: files of three formats, what is printed, what is drawn, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas import check_schema
from sfmapp.cli.main import main
from sfmapp.errors import InputError, UsageError
from sfmapp.evaluation.trajectory import Trajectory, absolute_error, associate
from sfmapp.formats.trajectory_input import read_trajectory
from sfmapp.geometry import rigid3
from sfmapp.pipelines.evaluate import EvaluateOptions, draw, evaluate, parse_delta
from sfmapp.reporting import plain

Array = NDArray[np.float64]


def loop(count: int = 200, radius: float = 30.0) -> Trajectory:
    """Once around, on a slope, ten poses a second."""
    turn = np.linspace(0, 2 * np.pi, count)
    position = np.stack([radius * np.cos(turn), radius * np.sin(turn), turn], 1)
    rotation = rigid3.exp_so3(np.stack([0 * turn, 0 * turn, turn], 1))
    return Trajectory(position, rotation, 1.5e9 + np.arange(count) / 10)


def worse(ground_truth: Trajectory, scale: float = 1.0, seed: int = 0) -> Trajectory:
    """Of another size, and drifting."""
    drift = np.cumsum(np.random.default_rng(seed).normal(0, 0.02, ground_truth.position.shape), 0)
    return Trajectory(scale * (ground_truth.position + drift), ground_truth.rotation, ground_truth.timestamps_s)


def write_tum(path: Path, trajectory: Trajectory) -> Path:
    times = trajectory.timestamps_s
    assert times is not None
    table = np.concatenate([trajectory.position, rigid3.quaternion(trajectory.rotation)], 1)
    lines = [f"{t:.6f} " + " ".join(f"{v:.9f}" for v in row) for t, row in zip(times, table, strict=True)]
    path.write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n")
    return path


def write_kitti(path: Path, trajectory: Trajectory) -> Path:
    rows = np.concatenate([trajectory.rotation, trajectory.position[:, :, None]], 2).reshape(-1, 12)
    path.write_text("\n".join(" ".join(f"{v:.9e}" for v in row) for row in rows) + "\n")
    return path


def write_euroc(path: Path, trajectory: Trajectory) -> Path:
    quaternion = rigid3.quaternion(trajectory.rotation)[:, [3, 0, 1, 2]]
    times = trajectory.timestamps_s
    assert times is not None
    lines = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_x"]
    for t, p, q in zip(times, trajectory.position, quaternion, strict=True):
        lines.append(f"{round(t * 1e9)}," + ",".join(f"{v:.9f}" for v in [*p, *q, 0, 0, 0]))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    ground_truth = loop()
    return write_tum(tmp_path / "trajectory.tum", worse(ground_truth)), write_tum(
        tmp_path / "groundtruth.txt", ground_truth
    )


# ------------------------------------------------------------------------------------------------------------- formats


@pytest.mark.parametrize("write", [write_tum, write_kitti, write_euroc])
def test_formats_are_told_apart_by_what_is_in_them(tmp_path: Path, write: Any) -> None:
    ground_truth = loop(50)
    found = read_trajectory(write(tmp_path / "without_an_ending", ground_truth))
    assert found.format == write.__name__.removeprefix("write_")
    assert found.trajectory.position == pytest.approx(ground_truth.position, abs=1e-8)
    assert found.trajectory.rotation == pytest.approx(ground_truth.rotation, abs=1e-8)
    if write is write_kitti:
        assert found.trajectory.timestamps_s is None
    else:
        assert found.trajectory.timestamps_s == pytest.approx(ground_truth.timestamps_s, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no line of numbers"),
        ("# only a comment\n", "no line of numbers"),
        ("1 2 3\n", "3 columns"),
        ("1 2 3 4 0 0 0 1\n2 2 3 4 0 0 0\n", ":2: expected 8 columns as above, found 7"),
        ("1 2 3 4 0 0 0 1\n2 2 x 4 0 0 0 1\n", ":2: expected numbers"),
        ("1 2 3 4 0 0 0 2\n", ":1: expected a quaternion of unit length"),
        ("1 2 3 4 0 0 0 0\n", ":1: expected a quaternion of unit length"),
        ("nan 2 3 4 0 0 0 1\n", ":1: expected a timestamp"),
        ("1 0 0 0 0 1 0 0 0 0 2 0\n", ":1: expected a rotation"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", ":1: expected a rotation"),
        ("1.5, 0, 0, 0, 1, 0, 0, 0\n", "whole nanoseconds"),
        ("one two\nthree four\n", ":2: expected numbers"),
    ],
)
def test_what_is_no_trajectory(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "file.txt"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_trajectory(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)


def test_bytes_and_missing_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "image.png").write_bytes(b"\x89PNG\r\n\x1a\n\xff\xfe")
    for name in ("image.png", "missing.txt", "."):
        with pytest.raises(InputError):
            read_trajectory(tmp_path / name)


def test_lines_with_nan_are_gaps(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_text("1 0 0 0 0 0 0 1\n2 nan nan nan nan nan nan nan\n3 1 0 0 0 0 0 1\n")
    assert read_trajectory(tmp_path / "a.tum").trajectory.has_pose.tolist() == [True, False, True]
    (tmp_path / "a.kitti").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" + " ".join(["nan"] * 12) + "\n")
    assert read_trajectory(tmp_path / "a.kitti").trajectory.has_pose.tolist() == [True, False]


def test_quaternions_of_few_digits_are_made_unit(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_text("1 0 0 0 0.71 0 0 0.70\n")
    rotation = read_trajectory(tmp_path / "a.tum").trajectory.rotation[0]
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)


def test_windows_lines_a_byte_order_mark_titles_and_tabs(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes("\ufefftimestamp,x,y,z,w,a,b,c\r\n1000000000,1,2,3,1,0,0,0,\r\n".encode())
    found = read_trajectory(tmp_path / "a.csv")
    assert found.format == "euroc"
    assert found.trajectory.timestamps_s == pytest.approx([1.0])
    (tmp_path / "a.tum").write_bytes(b"1\t1\t2\t3\t0\t0\t0\t1\r\n")
    assert read_trajectory(tmp_path / "a.tum").trajectory.position.tolist() == [[1, 2, 3]]


def test_frames_beside_a_kitti_trajectory_name_its_lines(tmp_path: Path) -> None:
    ground_truth = loop(30)
    kept = np.r_[0:10, 15:28]
    write_kitti(tmp_path / "ground_truth.txt", ground_truth)
    path = write_kitti(tmp_path / "trajectory.kitti", ground_truth[kept])
    with pytest.raises(InputError, match="found 23 and 30"):
        evaluate(path, tmp_path / "ground_truth.txt")
    (tmp_path / "trajectory.kitti.frames").write_text("".join(f"{k}\n" for k in kept))
    result = evaluate(path, tmp_path / "ground_truth.txt")
    assert result.pairs.ground_truth_idx.tolist() == kept.tolist()
    assert result.pairs.coverage == pytest.approx(23 / 30)
    assert result.errors["se3"].absolute.translation_m.max() < 1e-7
    (tmp_path / "trajectory.kitti.frames").write_text("1\n2\n")
    with pytest.raises(InputError, match="23 ascending numbers"):
        evaluate(path, tmp_path / "ground_truth.txt")


def test_times_join_kitti_with_tum(tmp_path: Path) -> None:
    ground_truth = loop(60)
    assert ground_truth.timestamps_s is not None
    ours, theirs = (
        write_tum(tmp_path / "a.tum", ground_truth[20:]),
        write_kitti(tmp_path / "ground_truth.txt", ground_truth),
    )
    with pytest.raises(InputError) as caught:
        evaluate(ours, theirs)
    assert "--times" in str(caught.value.advice)
    (tmp_path / "times.txt").write_text("\n".join(f"{t:.6f}" for t in ground_truth.timestamps_s))
    result = evaluate(ours, theirs, times=tmp_path / "times.txt")
    assert result.pairs.ground_truth_idx.tolist() == list(range(20, 60))
    (tmp_path / "times.txt").write_text("1\n2\n")
    with pytest.raises(InputError, match="a line for each of the 60"):
        evaluate(ours, theirs, times=tmp_path / "times.txt")


def test_euroc_ground_truth_is_said_to_be_of_the_imu(tmp_path: Path) -> None:
    ground_truth = loop(60)
    result = evaluate(write_tum(tmp_path / "a.tum", ground_truth), write_euroc(tmp_path / "data.csv", ground_truth))
    assert result.errors["se3"].absolute.translation_m.max() < 1e-6
    assert any("IMU" in note for note in result.notes)


# ------------------------------------------------------------------------------------------------------------- command


def test_the_table(files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", *map(str, files)]) == 0
    text = capsys.readouterr().out
    pairs = associate(*(read_trajectory(path).trajectory for path in files))
    for how in ("sim3", "se3"):
        error = absolute_error(pairs, how)  # type: ignore[arg-type]
        assert f"{np.sqrt((error.translation_m**2).mean()):.6f}" in text
    for word in ("ATE translation", "RPE 1 frame", "RPE 1 s", "RPE 10 m", "t_rel (%)", "r_rel (deg/100 m)", "coverage"):
        assert word in text
    assert "200 pairs of 200 estimated and 200 true poses" in text
    assert max(map(len, text.splitlines())) <= 100 or str(files[0]) in text
    assert files[0].with_name("trajectory.tum.png").read_bytes().startswith(b"\x89PNG")


def test_json(files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    picture = files[0].with_name("other.png")
    assert (
        main(["evaluate", *map(str, files), "--json", "--plot", str(picture), "--align", "se3", "--delta", "2f"]) == 0
    )
    found = json.loads(capsys.readouterr().out)
    assert found["exit_code"] == 0
    assert list(found["alignments"]) == ["se3"]
    errors = found["alignments"]["se3"]
    assert errors["scale"] == 1
    assert [(entry["delta"], entry["unit"], entry["num"]) for entry in errors["rpe"]] == [(2, "frames", 99)]
    assert set(errors["ate"]["translation_m"]) == {"rmse", "mean", "median", "std", "min", "max"}
    assert errors["kitti"]["r_rel_deg_per_100m"] == pytest.approx(100 * errors["kitti"]["r_rel_deg_per_m"])
    assert found["num_pairs"] == 200
    assert found["coverage"] == 1
    assert found["plot"] == str(picture)
    assert picture.is_file()


def test_no_picture_where_none_is_wanted_or_none_can_be(
    files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", *map(str, files), "--no-plot", "-q"]) == 0
    assert capsys.readouterr().out == ""
    assert not list(files[0].parent.glob("*.png"))
    files[0].with_name("trajectory.tum.png").mkdir()  # in its way
    assert main(["evaluate", *map(str, files)]) == 0
    said = capsys.readouterr()
    assert "ATE" in said.out
    assert "no picture" in said.err
    assert main(["evaluate", *map(str, files), "--plot", str(files[0].with_name("trajectory.tum.png"))]) == 3


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--delta", "1x"], 2, "such as 1f, 0.5s or 10m"),
        (["--delta", "0f"], 2, "delta"),
        (["--delta", "5000m"], 3, "5000 m apart"),
        (["--offset", "1e9"], 3, "no pose of the estimate"),
        (["--max-diff", "-1"], 2, "maximum difference"),
        (["--offset", "nan"], 2, "finite offset"),
        (["--times", "nowhere.txt", "--align", "se3"], 0, ""),  # neither is KITTI's
    ],
)
def test_options_that_cannot_be_obeyed(
    files: tuple[Path, Path], capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, message: str
) -> None:
    assert main(["evaluate", *map(str, files), "--no-plot", *arguments]) == code
    assert message in capsys.readouterr().err


def test_a_folder_of_a_run_is_its_trajectory(files: tuple[Path, Path], tmp_path: Path) -> None:
    ground_truth = loop()
    write_kitti(tmp_path / "trajectory.kitti", ground_truth)
    write_kitti(tmp_path / "poses.txt", ground_truth)
    assert evaluate(tmp_path, files[1]).estimate.path.name == "trajectory.tum"
    assert evaluate(tmp_path, tmp_path / "poses.txt").estimate.path.name == "trajectory.kitti"
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"without trajectory\.tum"):
        evaluate(tmp_path / "empty", files[1])


def test_parts_are_not_sold_as_the_whole(tmp_path: Path) -> None:
    ground_truth = loop()
    ours = write_tum(tmp_path / "a.tum", worse(ground_truth)[np.r_[0:80, 140:200]])
    result = evaluate(ours, write_tum(tmp_path / "b.tum", ground_truth))
    assert result.pairs.coverage == pytest.approx(0.7, abs=0.01)
    assert any("covers 69" in note or "covers 70" in note for note in result.notes)
    assert "1 gap" in result.table()


def test_two_poses_say_nothing_of_a_trajectory(tmp_path: Path) -> None:
    ground_truth = loop()
    true = write_tum(tmp_path / "b.tum", ground_truth)
    for count, said in ((2, True), (3, False)):
        result = evaluate(write_tum(tmp_path / "a.tum", worse(ground_truth)[np.arange(count)]), true)
        assert any("two poses say nothing" in note for note in result.notes) == said


def test_a_straight_path_leaves_the_turn_about_it_open(tmp_path: Path) -> None:
    ground_truth = straight(100, 50.0)
    result = evaluate(write_tum(tmp_path / "a.tum", worse(ground_truth)), write_tum(tmp_path / "b.tum", ground_truth))
    assert any("straight" in note for note in result.notes)
    ground_truth = loop()
    result = evaluate(write_tum(tmp_path / "a.tum", worse(ground_truth)), write_tum(tmp_path / "b.tum", ground_truth))
    assert not any("straight" in note for note in result.notes)


def test_a_sequence_is_its_ground_truth(tmp_path: Path) -> None:
    from PIL import Image

    ground_truth = loop(30)
    for k in range(30):
        (tmp_path / "00" / "image_0").mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((8, 8), k, np.uint8)).save(tmp_path / "00" / "image_0" / f"{k:06d}.png")
    write_kitti(tmp_path / "00" / "poses.txt", ground_truth)
    assert ground_truth.timestamps_s is not None
    (tmp_path / "00" / "times.txt").write_text("\n".join(f"{0.1 * k:.6e}" for k in range(30)))
    played = Trajectory(ground_truth.position, ground_truth.rotation, ground_truth.timestamps_s - 1.5e9)
    ours = write_tum(tmp_path / "a.tum", worse(played))
    assert len(evaluate(ours, tmp_path / "00").pairs) == 30
    (tmp_path / "00" / "poses.txt").unlink()
    with pytest.raises(InputError, match="expected true poses"):
        evaluate(ours, tmp_path / "00")


def test_a_short_path_tells_why_there_is_no_t_rel(tmp_path: Path) -> None:
    ground_truth = loop(radius=3.0)
    result = evaluate(write_tum(tmp_path / "a.tum", worse(ground_truth)), write_tum(tmp_path / "b.tum", ground_truth))
    assert "drift (%)" in result.table()
    assert "t_rel (%)" not in result.table()
    assert any("no t_rel" in note for note in result.notes)
    check_schema("evaluate", plain(result.report()))
    found = result.report()["alignments"]["se3"]
    assert found["kitti"] is None
    assert [entry["length_m"] for entry in found["drift_by_length"]] == pytest.approx(
        [0.1 * k * result.pairs.ground_truth.path_m for k in range(1, 9)]
    )


def test_the_picture_shows_the_alignment_that_tells_most(tmp_path: Path) -> None:
    ground_truth = loop()
    theirs = write_tum(tmp_path / "b.tum", ground_truth)
    for scale, expected in ((1.0, "se3"), (0.97, "se3"), (0.1, "sim3")):
        result = evaluate(write_tum(tmp_path / "a.tum", worse(ground_truth, scale)), theirs)
        assert result.telling_alignment == expected
        assert any("without a scale" in note for note in result.notes) == (expected == "sim3")
    assert evaluate(tmp_path / "a.tum", theirs, EvaluateOptions(("none",))).telling_alignment == "none"


def test_timestamps_out_of_order_are_sorted_and_said(tmp_path: Path) -> None:
    ground_truth = loop()
    theirs = write_tum(tmp_path / "b.tum", ground_truth)
    plain = evaluate(write_tum(tmp_path / "a.tum", worse(ground_truth)), theirs)
    mixed = evaluate(write_tum(tmp_path / "a.tum", worse(ground_truth)[np.r_[100:200, 0:100, 99]]), theirs)
    assert any("do not ascend" in note for note in mixed.notes)
    assert any("timestamp of the one before" in note for note in mixed.notes)
    before, after = (r.errors["se3"].absolute.translation_m for r in (plain, mixed))
    assert np.unique(after) == pytest.approx(np.unique(before), abs=1e-3)


def test_deltas() -> None:
    assert parse_delta("1f") == (1.0, "frames")
    assert parse_delta(" 0.5 s") == (0.5, "s")
    assert parse_delta(".5m") == (0.5, "m")
    for text in ("", "1", "f", "-1f", "0s", "1 km", "1e3m"):
        with pytest.raises(UsageError):
            parse_delta(text)


# ------------------------------------------------------------------------------------------------------------- picture


def pixels(path: Path) -> NDArray[np.uint8]:
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def test_the_picture_shows_both_paths(files: tuple[Path, Path], tmp_path: Path) -> None:
    draw(evaluate(*files), tmp_path / "a.png")
    image = pixels(tmp_path / "a.png")
    assert image.shape == (1240, 2000, 3)
    assert (image[0] == 255).all()  # nothing runs out of the page
    assert (image[-1] == 255).all()
    assert (image[:, [0, -1]] == 255).all()
    grey = (np.abs(image.astype(int) - (190, 197, 206)).max(2) < 4).sum()
    spread = np.ptp(image.astype(int), axis=2)
    assert grey > 5000  # the true path
    assert (spread > 80).sum() > 5000  # the estimate in its colours
    draw(evaluate(*files), tmp_path / "b.png")
    assert (tmp_path / "b.png").read_bytes() == (tmp_path / "a.png").read_bytes()


def straight(count: int, length: float) -> Trajectory:
    position = np.zeros((count, 3))
    position[:, 0] = np.linspace(0, length, count)
    return Trajectory(position, np.tile(np.eye(3), (count, 1, 1)), np.arange(count) / 10)


@pytest.mark.parametrize(
    ("ground_truth", "kept"),
    [
        (straight(2, 1.0), slice(None)),
        (straight(100, 1e5), slice(None)),
        (straight(100, 1e-3), slice(None)),
        (loop(20000), slice(0, None, 2)),
        (loop(1000), np.flatnonzero(np.arange(1000) % 50 < 1)),
        (loop(200), np.r_[50:60, 100:101, 150:160]),
        (Trajectory(loop().position + np.array([4.5e6, 5e6, 300]), loop().rotation, loop().timestamps_s), slice(None)),
    ],
)
def test_pictures_of_odd_trajectories(tmp_path: Path, ground_truth: Trajectory, kept: Any) -> None:
    theirs = write_tum(tmp_path / "b.tum", ground_truth)
    draw(evaluate(write_tum(tmp_path / "a.tum", ground_truth[kept]), theirs), tmp_path / "a.png")
    image = pixels(tmp_path / "a.png")
    assert (image[:, [0, -1]] == 255).all()


def test_a_camera_at_rest(tmp_path: Path) -> None:
    still = straight(30, 0.0)
    ours, theirs = write_tum(tmp_path / "a.tum", still), write_tum(tmp_path / "b.tum", still)
    with pytest.raises(InputError, match="do not determine"):
        evaluate(ours, theirs)
    result = evaluate(ours, theirs, EvaluateOptions(("origin",)))
    assert result.table()
    draw(result, tmp_path / "a.png")
