"""Rendered photographs through wide lenses, from the command line to cameras, patches and undistorted pictures."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from lens_families import LENSES, Lens, behind_percent, lens_error_px, poses_of, straightness, surface_distances
from rendered_worlds.all_round import AllRoundRenderer
from rendered_worlds.rendering import Optics, Renderer
from rendered_worlds.worlds import gallery_world
from sfmapp.camera.camera import Camera, pixels_to_rays
from sfmapp.camera.names import CameraModel
from sfmapp.cli.main import main
from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.formats.colmap import read_model
from sfmapp.geometry import rigid3, similarity

WORLD = gallery_world(3)
QUIET = Optics(noise_sigma=0.0)


def write_photographs(camera: Camera, poses: np.ndarray, folder: Path) -> list[str]:
    folder.mkdir()
    renderer = AllRoundRenderer(WORLD, camera)
    names = [f"{k:03d}.png" for k in range(len(poses))]
    for k, (name, pose) in enumerate(zip(names, poses, strict=True)):
        cv2.imwrite(str(folder / name), renderer.photograph(pose, Optics(), [1, k]))
    return names


def test_through_a_pinhole_both_renderers_see_the_same() -> None:
    camera = Camera(CameraModel.PINHOLE, 160, 120, np.array([110.0, 111.0, 81.0, 58.0]))
    pose = poses_of("at a corner")[3]
    grey, distance = AllRoundRenderer(WORLD, camera).view(pose)
    plain = Renderer(WORLD, camera).view(pose)
    assert np.median(np.abs(grey - plain.grey)) < 1.0
    xy = np.stack(np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5), -1).reshape(-1, 2)
    along = pixels_to_rays(camera, xy)[:, 2].reshape(120, 160)
    # beside edges the nearest pixel of a face may be of another surface
    assert np.quantile(np.abs(distance * along / plain.depth - 1.0), 0.9) < 0.01


def test_a_panorama_shows_the_world_all_round() -> None:
    """Where rays of a panorama end, there are surfaces; black is nowhere."""
    camera = Camera(CameraModel.EQUIRECTANGULAR, 128, 64, np.array([128.0, 64.0]))
    pose = poses_of("round about")[5]
    grey, distance = AllRoundRenderer(WORLD, camera).view(pose)
    xy = np.stack(np.meshgrid(np.arange(128) + 0.5, np.arange(64) + 0.5), -1).reshape(-1, 2)
    ends = rigid3.apply(rigid3.inverse(pose), pixels_to_rays(camera, xy) * distance.reshape(-1, 1))
    assert np.quantile(surface_distances(WORLD, ends), 0.9) < 0.05
    assert grey.min() > 0.0


@pytest.mark.parametrize("name", ["panorama", "fisheye of 230 degrees"])
def test_views_all_round_are_registered_with_points_all_round(name: str, tmp_path: Path) -> None:
    camera = (
        Camera(CameraModel.EQUIRECTANGULAR, 640, 320, np.array([640.0, 320.0]))
        if name == "panorama"
        else Camera(CameraModel.OPENCV_FISHEYE, 440, 440, np.array([110.0, 110.5, 221, 218, -0.01, 0.002, 0, 0]))
    )
    poses = poses_of("round about")[::2]
    names = write_photographs(camera, poses, tmp_path / "images")
    given = camera.with_focal(1.004 * camera.focal)
    text = f"{camera.model.name},{','.join(str(value) for value in given.params)}"
    out = tmp_path / "out"
    command = ["reconstruct", str(tmp_path / "images"), "-o", str(out), "--camera", text, "--no-recording", "-q"]
    assert main(command) == 0
    model = read_model(out / "sparse" / "0")[0]
    assert model.is_registered.all()
    errors = evaluate_poses(model.image_names, model.cam_from_world, names, poses)
    # 0.3 px of 100 px a radian at 2.5 m, over hundreds of points
    assert 1e-5 < np.sqrt(np.mean(errors.center_error**2)) < 5e-3
    assert 20.0 < behind_percent(model) < 60.0
    points = similarity.apply(errors.reference_from_estimate, model.point_xyz[model.is_triangulated])
    assert np.median(surface_distances(WORLD, points)) < 0.02
    if name != "panorama":  # what lies at a right angle was 0.7 px off
        assert lens_error_px(model.cameras[0], camera) < 0.3 * lens_error_px(given, camera)
    report = json.loads((out / "report.json").read_text())
    assert report["images"][0]["name"] == "000.png"


def test_lines_are_straight_in_an_undistorted_picture_and_bent_in_one_that_is_not(tmp_path: Path) -> None:
    lens: Lens = next(lens for lens in LENSES if lens.name == "SIMPLE_RADIAL")
    plane = Camera(CameraModel.PINHOLE, 640, 480, lens.camera.canonical[:4])
    poses = poses_of("at a corner")
    for folder, camera in (("straight", plane), ("bent", lens.camera)):
        (tmp_path / folder).mkdir()
        picture = AllRoundRenderer(WORLD, camera).photograph(poses[0], QUIET, [0])
        cv2.imwrite(str(tmp_path / folder / "000.png"), picture)
    assert straightness(tmp_path / "straight", plane, poses, WORLD)["bend_px"] < 0.2
    assert straightness(tmp_path / "bent", plane, poses, WORLD)["bend_px"] > 0.6
