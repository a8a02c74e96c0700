"""Pairs of which one camera stands in front of the other, on a rendered world with exact depth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from dense_scenes import CAMERA, poses, wall_with_box_and_bars
from rendered_worlds.rendering import Optics, Renderer
from sfmapp.camera_files.rig_writing import write_rig_files
from sfmapp.cli.main import main
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig
from sfmapp.stereo.polar import plan_polar

# of the second camera, 0.45 m ahead and a little aside, and turned by a degree
AHEAD = rigid3.from_matrix(rigid3.exp_so3(np.radians([0.4, -0.9, 1.0])), np.array([0.02, -0.01, -0.45]))


def rig_of(second: np.ndarray) -> Rig:
    return Rig((CAMERA, CAMERA), np.array([rigid3.IDENTITY, second]))


@pytest.mark.parametrize("is_ahead", [True, False])
def test_disparities_of_rays_are_distances(is_ahead: bool) -> None:
    rig = rig_of(AHEAD if is_ahead else rigid3.inverse(AHEAD))
    plan = plan_polar(rig)
    assert plan.is_second_ahead == is_ahead
    rng = np.random.default_rng(0)
    places = np.concatenate([rng.uniform(-2.0, 2.0, (500, 2)), rng.uniform(2.0, 20.0, (500, 1))], 1)
    turn = rigid3.rotation_matrix(rig.cam_from_rig[1])
    left = plan.places(places)
    right = plan.places(rigid3.apply(rig.cam_from_rig[1], places) @ turn)
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-7)
    disparity = left[:, 0] - right[:, 0]
    assert (disparity > 0.0).all()
    distance = np.linalg.norm(places, axis=1)
    rays = places / distance[:, None]
    np.testing.assert_allclose(plan.rays(left[:, 0], left[:, 1]), rays, atol=1e-9)
    found, slope = plan.ranges(rays, disparity)
    np.testing.assert_allclose(found, distance, rtol=1e-6)
    more, _ = plan.ranges(rays, disparity + 1e-4)
    np.testing.assert_allclose((more - found) / 1e-4, slope, rtol=1e-2)
    # beyond infinity
    assert np.isnan(plan.ranges(rays, -disparity)[0]).all()


@pytest.mark.parametrize("is_ahead", [True, False])
def test_a_pair_becomes_depths_with_sigmas(is_ahead: bool, tmp_path: Path) -> None:
    second = AHEAD if is_ahead else rigid3.inverse(AHEAD)
    renderer, first = Renderer(wall_with_box_and_bars(), CAMERA), poses(3)[1]
    for side, pose in enumerate((first, rigid3.compose(second, first))):
        picture = renderer.photograph(pose, Optics(noise_sigma=1.0), [3, side])
        cv2.imwrite(str(tmp_path / f"{side}.png"), picture)
    write_rig_files(tmp_path / "rig", rig_of(second), ("0", "1"))
    out = tmp_path / "out"
    pair = [str(tmp_path / f"{side}.png") for side in (0, 1)]
    assert main(["stereo", *pair, "--camera", str(tmp_path / "rig" / "stereo.yaml"), "-o", str(out), "-q"]) == 0
    (told,) = json.loads((out / "report.json").read_text())["pairs"]
    assert told["rectification"]["is_polar"]
    assert told["rectification"]["rows"]["rms_px"] < 1.0
    assert ("in front of" if is_ahead else "behind") in told["rectification"]["warnings"][0]
    depth, sigma, disparity = (np.load(out / f"{name}.npy") for name in ("depth", "depth_sigma", "disparity"))
    true = renderer.view(first, edge_samples=False).depth
    baseline = float(np.linalg.norm(second[4:]))
    known = np.isfinite(depth)
    np.testing.assert_allclose(depth[known], CAMERA.focal * baseline / disparity[known], rtol=1e-4)
    y, x = np.mgrid[:240, :320] + 0.5
    outside = np.hypot(x - 160.0, y - 120.0) > 60.0
    assert known[outside].mean() > 0.5
    error = np.abs(depth - true)[known & outside]
    assert np.median(error / true[known & outside]) < 0.02
    assert 0.6 < (error < sigma[known & outside]).mean() < 0.97
    assert (error < 2.5 * sigma[known & outside]).mean() > 0.9
    assert (out / "cloud.ply").is_file()
    assert (out / "view.glb").is_file()


def test_cameras_in_one_place_are_refused() -> None:
    with pytest.raises(InputError, match="two places"):
        plan_polar(replace(rig_of(AHEAD), cam_from_rig=np.tile(rigid3.IDENTITY, (2, 1))))
