"""Pose chaining against a known motion: the length comes from the few mapped points, and from nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.camera.camera import CameraModel, pixels_to_normalized, project, simple_camera
from sfmapp.geometry import rigid3
from sfmapp.odometry.frontend.active_tracks import ActiveTracks, References
from sfmapp.odometry.frontend.chaining import chain_pose

CAMERA = simple_camera(CameraModel.PINHOLE, 640, 480, 500.0, 1.0, "user")
REFERENCE = rigid3.from_matrix(rigid3.exp_so3(np.array([0.1, -0.2, 0.05])), np.array([1.0, 2.0, -0.5]))
MOTION = rigid3.from_matrix(rigid3.exp_so3(np.array([0.01, 0.03, -0.02])), np.array([-0.4, 0.05, 0.1]))


def seen(num_mapped: int, noise_px: float, seed: int) -> tuple[ActiveTracks, np.ndarray, np.ndarray]:
    """Tracks of 200 points between a reference keyframe and a frame, and the points, known for the first few."""
    rng = np.random.default_rng(seed)
    in_reference = np.column_stack([rng.uniform(-2, 2, 200), rng.uniform(-1.5, 1.5, 200), rng.uniform(3, 8, 200)])
    pose = rigid3.compose(MOTION, REFERENCE)
    world = rigid3.apply(rigid3.inverse(REFERENCE), in_reference)
    xy1 = project(CAMERA, in_reference) + rng.normal(0, noise_px, (200, 2))
    xy2 = project(CAMERA, rigid3.apply(pose, world)) + rng.normal(0, noise_px, (200, 2))
    xyz = np.where((np.arange(200) < num_mapped)[:, None], world, np.nan)
    tracks = ActiveTracks(
        np.arange(200), xy2, np.full(200, 3), xy1, pixels_to_normalized(CAMERA, xy1), np.ones(200),
        np.ones(200, np.float32),
    )  # fmt: skip
    return tracks, xyz, pose


@pytest.mark.parametrize("seed", range(5))
def test_few_points_carry_the_scale(seed: int) -> None:
    tracks, xyz, ground_truth = seen(8, 0.2, seed)
    pose = chain_pose(CAMERA, tracks, References.of(np.array([3]), REFERENCE), xyz)
    assert pose is not None
    # 0.2 px over a baseline of 0.4 at a depth of 5 leaves about 1 % of depth, so of scale
    error = np.linalg.norm(rigid3.center(pose) - rigid3.center(ground_truth)) / 0.41
    assert 1e-5 < error < 0.05
    turn = rigid3.rotation_angle_deg(rigid3.rotation_matrix(pose) @ rigid3.rotation_matrix(ground_truth).T)
    assert turn < 0.2


def test_exact_tracks_give_the_exact_pose() -> None:
    tracks, xyz, ground_truth = seen(6, 0.0, 0)
    pose = chain_pose(CAMERA, tracks, References.of(np.array([3]), REFERENCE), xyz)
    assert pose is not None
    np.testing.assert_allclose(pose, ground_truth, atol=1e-5)


def test_without_points_or_with_contradicting_ones_there_is_no_scale() -> None:
    references = References.of(np.array([3]), REFERENCE)
    tracks, xyz, _ = seen(3, 0.1, 0)
    assert chain_pose(CAMERA, tracks, references, xyz) is None
    tracks, xyz, _ = seen(12, 0.1, 0)
    xyz[:12] = np.random.default_rng(1).uniform(-5, 5, (12, 3))
    assert chain_pose(CAMERA, tracks, references, xyz) is None
