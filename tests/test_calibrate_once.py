"""Calibrate once, use everywhere: photographs of a board to the camera that every other command takes, end to end."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from board_views import board_poses, render_board
from rendered_worlds import sequences as rendered
from schemas import check_schema
from sfmapp.calibration.boards import parse_board
from sfmapp.calibration.file import read_calibration_file
from sfmapp.camera.camera import Camera, pixels_to_normalized, project
from sfmapp.camera.names import CameraModel
from sfmapp.cli.main import main
from sfmapp.formats.colmap import read_model, write_model
from sfmapp.geometry import rigid3, similarity
from sfmapp.mapping import structure

BOARD = parse_board("chessboard:9x6:0.025")
CAMERA = Camera(CameraModel.OPENCV, 320, 240, np.array([262.5, 263.0, 161.0, 119.0, -0.15, 0.03, 0.0, 0.0]))
FPS, NUM_FRAMES, STEP = 30.0, 48, 6


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One camera: ``board`` photographed by it, ``frames`` of a room filmed, ``photos`` some of these, ``truth.npy``
    their poses, and ``cam``, which the board has told."""
    folder = tmp_path_factory.mktemp("world")
    for name in ("board", "frames", "photos"):
        (folder / name).mkdir()
    for n, pose in enumerate(board_poses(np.random.default_rng(3), BOARD, 10, CAMERA, 40.0)):
        cv2.imwrite(str(folder / "board" / f"{n}.png"), render_board(CAMERA, BOARD, pose, noise=2.0, seed=n))
    film = rendered.room(NUM_FRAMES, camera=CAMERA)
    for k in range(NUM_FRAMES):
        picture = Image.fromarray(film.image(k))
        picture.save(folder / "frames" / f"{k / FPS:.6f}.png")
        if k % STEP == 0:
            picture.save(folder / "photos" / f"{k:03d}.png")
    np.save(folder / "truth.npy", film.ground_truth[::STEP])
    command = ["calibrate", "board", str(folder / "board"), "-o", str(folder / "cam"), "--board", BOARD.text()]
    assert main([*command, "--camera-model", "opencv", "-q"]) == 0
    return folder


@pytest.fixture(scope="module")
def reconstructed(world: Path) -> Path:
    output = world / "model"
    flags = ["--camera", str(world / "cam"), "--no-recording", "-q", "--set", "images.fix_intrinsics=true"]
    assert main(["reconstruct", str(world / "photos"), "-o", str(output), *flags]) == 0
    return output


def away(first: Camera, second: Camera) -> float:
    """Farthest that two cameras put the same rays apart, pixels."""
    grid = np.stack(np.meshgrid(np.arange(10.0, 320.0, 20.0), np.arange(10.0, 240.0, 20.0)), -1).reshape(-1, 2)
    rays = np.column_stack([pixels_to_normalized(first, grid), np.ones(len(grid))])
    return float(np.abs(project(second, rays) - grid).max())


def place_error(model_folder: Path, world: Path) -> float:
    """Largest distance of a camera's centre from the truth, of the extent of all, after a similarity."""
    model = read_model(model_folder)[0]
    truth = np.load(world / "truth.npy")[[int(Path(name).stem) // STEP for name in model.image_names]]
    fit = similarity.align_poses(model.cam_from_world, truth).b_from_a
    off = similarity.apply(fit, rigid3.center(model.cam_from_world)) - rigid3.center(truth)
    return float(np.linalg.norm(off, axis=1).max() / np.linalg.norm(np.ptp(rigid3.center(truth), axis=0)))


def test_reconstruct_and_odometry_have_the_camera_of_the_board(world: Path, reconstructed: Path) -> None:
    made = read_calibration_file(world / "cam").camera
    assert away(CAMERA, made) < 1.0
    model = read_model(reconstructed / "sparse" / "0")[0]
    assert model.is_registered.sum() == NUM_FRAMES // STEP
    np.testing.assert_array_equal(model.cameras[0].params, made.params)
    assert place_error(reconstructed / "sparse" / "0", world) < 0.01
    output = world / "track"
    camera = str(world / "cam" / "calibration.json")
    assert main(["odometry", str(world / "frames"), "-o", str(output), "--camera", camera, "--no-recording", "-q"]) == 0
    report = json.loads((output / "report.json").read_text())
    np.testing.assert_allclose([*report["sequence"]["cameras"][0]["params"].values()], made.params, atol=1e-9)


def test_photographs_alone_become_straight(world: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output, camera = world / "straight", str(world / "cam")
    command = ["undistort", str(world / "board"), "-o", str(output), "--camera", camera, "--json"]
    capsys.readouterr()
    assert main(command) == 0
    told = json.loads(capsys.readouterr().out)
    check_schema("undistort", {name: value for name, value in told.items() if name not in ("exit_code", "output")})
    assert (told["num_images"], told["num_points"]) == (10, 0)
    assert not (output / "sparse").exists()
    # the rows of the board, which the lens bends, are straight
    for name, folder, is_straight in (("straight", output / "images", True), ("bent", world / "board", False)):
        found, corners = cv2.findChessboardCorners(cv2.imread(str(folder / "1.png"), 0), (9, 6))
        assert found, name
        rows = corners.reshape(6, 9, 2).astype(np.float64)
        rows -= rows.mean(1, keepdims=True)
        off = np.linalg.svd(rows, compute_uv=False)[:, 1].max() / 3.0
        assert (off < 0.15) == is_straight, (name, off)
    # what is written beside is the camera of the straight pictures
    again = [str(output / "images"), "-o", str(world / "again"), "--camera", str(output / "cameras.txt"), "--json"]
    assert main(["undistort", *again]) == 0
    assert json.loads(capsys.readouterr().out)["num_copied"] == 10
    assert main(command) == 0
    assert json.loads(capsys.readouterr().out)["run"]["is_up_to_date"]
    # no model, no camera: what is missing is said
    assert main(["undistort", str(world / "board"), "-o", str(world / "none")]) == 3
    assert "--camera" in capsys.readouterr().err


@pytest.fixture(scope="module")
def believed(world: Path, reconstructed: Path) -> Path:
    """The model as another program has it, which believed in a pinhole 2 % too long and has no distortion."""
    model, keypoints = read_model(reconstructed / "sparse" / "0")
    model.cameras = [Camera(CameraModel.PINHOLE, 320, 240, np.array([268.0, 268.0, 160.0, 120.0]))]
    write_model(world / "believed" / "sparse" / "0", model, keypoints)
    return world / "believed"


def test_a_calibration_takes_the_place_of_the_cameras_of_a_model(
    world: Path, believed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = read_model(believed / "sparse" / "0")[0]
    sources = [str(believed), "--images", str(world / "photos"), "--camera", str(world / "cam")]
    output = world / "dense"
    assert main(["dense", *sources, "-o", str(output), "--no-recording", "--set", "dense.level=1"]) == 0
    told = capsys.readouterr().out
    assert "PINHOLE to OPENCV" in told
    assert "CONTRADICTED" not in told
    report = json.loads((output / "report.json").read_text())
    check_schema("dense", report)
    said = report["stages"]["dense"]["calibration"]
    assert said["noise_px"] < 0.5 * said["noise_before_px"]
    assert said["lenses"][0]["sigma_px"] < 0.5 < said["lenses"][0]["max_px"]
    after = read_model(output / "sparse" / "0")[0]
    made = read_calibration_file(world / "cam").camera
    np.testing.assert_array_equal(after.cameras[0].params, made.params)
    assert structure.residual_scale_px(after) == pytest.approx(said["noise_px"], rel=1e-3)
    assert place_error(output / "sparse" / "0", world) < 0.01
    # it lies where it lay
    apart = rigid3.center(after.cam_from_world) - rigid3.center(before.cam_from_world)
    assert np.abs(apart.mean(0)).max() < 1e-6
    # the model is the workspace's own now, for the mesh and whatever follows
    assert json.loads((output / "run.json").read_text())["model"] == str(output / "sparse" / "0")
    assert main(["dense", *sources, "-o", str(output), "--no-recording", "--set", "dense.level=1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["run"]["is_up_to_date"]
    assert main(["undistort", *sources, "-o", str(world / "flat"), "--json"]) == 0
    flat = json.loads(capsys.readouterr().out)
    assert flat["calibration"]["noise_px"] == pytest.approx(said["noise_px"], rel=1e-3)
    assert flat["num_observations"] > 0.8 * after.obs_is_inlier.sum()


def test_a_calibration_of_another_zoom_is_contradicted(
    world: Path, reconstructed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = read_calibration_file(world / "cam").camera
    for stretch, is_contradicted in ((1.0, False), (1.1, True)):
        params = made.params * np.array([stretch, stretch, *[1.0] * 6])
        camera = ",".join(["OPENCV", *map(str, params)])
        output = world / f"zoom{stretch}"
        assert main(["undistort", str(reconstructed), "-o", str(output), "--camera", camera]) == 0
        assert ("CONTRADICTED: with the camera of" in capsys.readouterr().out) == is_contradicted


def test_a_model_in_its_own_workspace_keeps_its_cameras(
    reconstructed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["dense", str(reconstructed), "--camera", "PINHOLE,260,260,160,120"]) == 2
    assert "-o OUT" in capsys.readouterr().err
