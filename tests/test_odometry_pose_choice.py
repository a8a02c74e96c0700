"""Which relative poses two views show: one where they have depth and parallax, several where they have not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, CameraModel, project
from sfmapp.geometry import rigid3
from sfmapp.odometry.frontend.pose_choice import explaining_poses, is_way_known, tells_apart

CAMERA = Camera(CameraModel.PINHOLE, 640, 480, np.array([525.0, 525.0, 320.0, 240.0]))
NOISE_PX, LIMIT_PX, NUM = 0.2, 1.0, 150


def views(seed: int, way: float, relief: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Pixels in two views of points up to ``relief`` off a slanted plane 2 away, and the true cam2_from_cam1 after a
    way of that length and a small turn."""
    rng = np.random.default_rng([seed, 0x9056])
    rays = np.column_stack([rng.uniform(-0.5, 0.5, NUM), rng.uniform(-0.4, 0.4, NUM), np.ones(NUM)])
    slope = rng.uniform(-0.8, 0.8, 2)
    depth = 2.0 / (1.0 - rays[:, :2] @ slope) + rng.uniform(-relief, relief, NUM)
    xyz = rays * depth[:, None]
    direction = rng.normal(size=3)
    center = way * direction / np.linalg.norm(direction)
    rotation = rigid3.exp_so3(rng.normal(0, 0.03, 3))
    pose = rigid3.from_matrix(rotation, -rotation @ center)
    seen = [project(CAMERA, points) + rng.normal(0, NOISE_PX, (NUM, 2)) for points in (xyz, rigid3.apply(pose, xyz))]
    return seen[0], seen[1], pose


def off_deg(found: NDArray[np.float64], true: NDArray[np.float64]) -> float:
    """Angle between the directions of two ways."""
    a, b = rigid3.center(found), rigid3.center(true)
    return float(np.degrees(np.arccos(np.clip(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), -1, 1))))


@pytest.mark.parametrize("seed", range(8))
def test_depth_and_parallax_leave_one_pose_from_any_start(seed: int) -> None:
    xy1, xy2, true = views(seed, 0.3, 0.7)
    wrong = rigid3.from_matrix(rigid3.exp_so3(np.array([0.1, -0.1, 0.0])), np.array([0.6, -0.7, 0.4]))
    for start in (true, wrong):
        (found,), (cost,) = explaining_poses(CAMERA, xy1, xy2, start, LIMIT_PX)
        assert off_deg(found, true) < 3.0
        assert np.linalg.norm(found[4:]) == pytest.approx(1.0)
        # a Sampson distance has the noise of one of the four coordinates
        assert 0.7 * NOISE_PX**2 < cost / NUM < 1.4 * NOISE_PX**2
        assert is_way_known(CAMERA, found, xy1, xy2, cost)


def test_a_plane_seen_over_a_short_way_shows_several_motions_of_which_one_is_right() -> None:
    numbers, told, among = [], [], []
    for seed in range(30):
        xy1, xy2, true = views(seed, 0.06, 0.0)
        poses, costs = explaining_poses(CAMERA, xy1, xy2, true, LIMIT_PX)
        numbers.append(len(poses))
        among.append(min(off_deg(pose, true) for pose in poses))
        assert (np.diff(costs) >= 0).all()
        if len(poses) == 1 and is_way_known(CAMERA, poses[0], xy1, xy2, costs[0]):
            told.append(off_deg(poses[0], true))
    # the start was the ground truth each time: the other motions were looked for
    assert sum(number > 1 for number in numbers) >= 8
    assert np.median(among) < 10.0
    assert all(off < 20.0 for off in told)


def test_a_mere_turn_shows_no_way() -> None:
    xy1, xy2, true = views(3, 1e-4, 0.5)
    poses, costs = explaining_poses(CAMERA, xy1, xy2, true, LIMIT_PX)
    assert len(poses) > 1 or not is_way_known(CAMERA, poses[0], xy1, xy2, costs[0])


def test_noise_below_what_patches_reach_tells_nothing_apart() -> None:
    assert not tells_apart(1e-9, 1e-6, 100)
    assert tells_apart(1.0, 2.0, 100)
    assert not tells_apart(1.0, 1.4, 100)
    assert tells_apart(1.0, 1.4, 10, 1.1)
