"""Every example does what its first line says, on the bundled sample or a short rendered walk."""

from __future__ import annotations

import json
import re
import runpy
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import sfmapp

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def run(number: int, *arguments: Path | str) -> None:
    (path,) = EXAMPLES.glob(f"{number:02d}_*.py")
    before, sys.argv = sys.argv, [str(path), *map(str, arguments)]
    try:
        runpy.run_path(str(path), run_name="__main__")
    finally:
        sys.argv = before


def numbers(text: str, pattern: str) -> list[float]:
    found = re.search(pattern, text)
    assert found is not None, text
    return [float(value) for value in found.groups()]


@pytest.fixture(scope="module")
def workspace(reconstructed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(reconstructed, tmp_path_factory.mktemp("workspace") / "out"))


def test_there_are_twelve_and_each_is_short_and_says_how_to_run_it() -> None:
    paths = sorted(EXAMPLES.glob("*.py"))
    assert [int(path.name[:2]) for path in paths] == list(range(1, 13))
    for path in paths:
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) < 40, path.name
        assert f"python examples/{path.name} " in text
        assert f"def test_{path.stem[3:]}(" in Path(__file__).read_text(encoding="utf-8")


def test_one_call(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(1, photos, tmp_path / "out")
    count, views, error = numbers(capsys.readouterr().out, r"(\d+) points, seen by ([\d.]+) images, ([\d.]+) px")
    assert count > 500
    assert views > 2.5
    assert error < 0.7
    assert (tmp_path / "out" / "report.html").is_file()


def test_stages(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(2, photos, tmp_path / "model")
    assert "7 of 7 images" in capsys.readouterr().out
    assert sfmapp.load(tmp_path / "model").camera(0).model.name == "RADIAL"


def test_own_features(photos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(3, photos)
    registered, total, points = numbers(capsys.readouterr().out, r"(\d+) of (\d+) images, (\d+) points")
    assert registered == total == 7
    assert points > 300


def test_colmap_model(workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(4, workspace / "sparse" / "0", tmp_path / "refined")
    before, after = numbers(capsys.readouterr().out, r"steps: ([\d.]+) to ([\d.]+)")
    assert after <= before
    source, refined = sfmapp.load(workspace), sfmapp.load(tmp_path / "refined")
    assert np.asarray(refined.images[0].cam_from_world).tolist() == source.cam_from_world[0].tolist()
    assert refined.camera(0).params[1] != source.camera(0).params[1]


def test_new_photograph(photos: Path, sample: Path, capsys: pytest.CaptureFixture[str]) -> None:
    new = sorted(path.name for path in photos.iterdir())[3]
    run(5, photos, new)
    inliers, total = numbers(capsys.readouterr().out, r"(\d+) of (\d+) points agree")
    assert inliers > 100
    assert inliers > 0.8 * total


def test_live_odometry(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from PIL import Image

    from odometry_sequences import PINHOLE, room

    played = room(40)
    for idx, images in enumerate(played.images):
        Image.fromarray(images[0]).save(tmp_path / f"{idx:06d}.png")
    run(6, tmp_path / "%06d.png", PINHOLE.params[0])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 41
    tracked, total = numbers(lines[-1], r"(\d+) of (\d+) frames have a pose")
    assert total == 40
    assert tracked == 40
    assert "nan" not in lines[-2]


def test_covariance(workspace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(7, workspace)
    out = capsys.readouterr().out
    (sigma,) = numbers(out, r"is ([\d.]+) px off")
    assert 0.05 < sigma < 1.0
    sigmas = [float(value) for value in re.findall(r"\]: \+- (\S+), seen", out)]
    assert len(sigmas) == 3
    assert sigmas == sorted(sigmas)


def test_factor_graph(workspace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(11, workspace, "0.35", "0.002")
    out = capsys.readouterr().out
    model = sfmapp.load(workspace / "metric" / "0")
    found = np.linalg.norm(model.images[-1].cam_from_world.center - model.images[0].cam_from_world.center)
    assert found == pytest.approx(0.35, abs=1e-4)
    (residual,) = numbers(out, r"\d+ reprojection: normalised residual ([\d.]+)")
    # the noise is what it takes for residuals to be as they are once poses, points and the focal length have followed
    # it; without a robust loss the adjustment then follows those that are far off a little more
    coordinates = 2 * model.obs_is_inlier.sum()
    unknowns = 6 * len(model.images) - 7 + 3 * model.is_triangulated.sum()
    left = np.sqrt(1.0 - unknowns / coordinates)
    assert 0.8 * left < residual < 1.01 * left
    # the distance is known to 2 mm, and the places of cameras not far better
    (sigma,) = numbers(out, r"is (\S+) m sure")
    assert 1e-4 < sigma < 5e-3


def test_undistorted_for_splatting(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(8, photos, tmp_path / "out", tmp_path / "splat")
    assert "PINHOLE" in capsys.readouterr().out
    model = sfmapp.load(tmp_path / "splat")
    assert all((tmp_path / "splat" / "images" / image.name).is_file() for image in model.images)


def test_two_views(sample: Path, capsys: pytest.CaptureFixture[str]) -> None:
    left, right = sorted((sample / "images").iterdir())[:2]
    run(9, left, right, 704)  # the focal length that the views were rendered with
    out = capsys.readouterr().out
    inliers, total, angle = numbers(out, r"CALIBRATED: (\d+) of (\d+) matches, ([\d.]+) deg")
    assert inliers > 0.4 * total
    assert 1 < angle < 20
    points, depth = numbers(out, r"(\d+) points, ([\d.]+) baselines")
    assert points > 0.5 * inliers
    assert 1 < depth < 50


def test_export_to_nerfstudio(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(10, photos, tmp_path / "nerf")
    assert "s  mapping: 1 model(s)" in capsys.readouterr().out
    frames = json.loads((tmp_path / "nerf" / "transforms.json").read_text())["frames"]
    assert len(frames) == 7
    assert all((tmp_path / "nerf" / frame["file_path"]).is_file() for frame in frames)


def test_calibrated_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import cv2

    from board_views import board_poses, render_board
    from sfmapp.calibration.boards import parse_board

    board = "chessboard:9x6:0.025"
    camera = sfmapp.Camera(sfmapp.CameraModel.SIMPLE_RADIAL, 320, 240, [262.5, 161.0, 119.0, -0.1])
    for half in ("now", "before"):
        (tmp_path / half).mkdir()
    for n, pose in enumerate(board_poses(np.random.default_rng(5), parse_board(board), 12, camera, 40.0)):
        picture = render_board(camera, parse_board(board), pose, noise=2.0, seed=n)
        cv2.imwrite(str(tmp_path / ("now", "before")[n % 2] / f"{n:02d}.png"), picture)
    sfmapp.calibrate_board(tmp_path / "before", tmp_path / "old", board)
    run(12, tmp_path / "now", board, tmp_path / "cam", tmp_path / "old")
    out = capsys.readouterr().out
    middle, corner = numbers(out, r"middle is projected to ([\d.]+) px\s.*corner is projected to ([\d.]+) px")
    assert 0.0 < middle < corner < 3.0
    assert "the same camera" in out
