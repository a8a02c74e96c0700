"""Rigs whose cameras are turned against each other: seen in the matches, and put right at the end."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, CameraModel, project
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.refinement.final_adjustment import adjust_finally
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]
NOISE_PX = 0.15
TURN = np.radians([0.02, -0.016, 0.023])


def rig_turned_by(turn: Array) -> Rig:
    camera = Camera(CameraModel.PINHOLE, 1200, 400, np.array([700.0, 700.0, 600.0, 200.0]))
    right = rigid3.from_matrix(rigid3.exp_so3(turn), np.array([-0.5, 0.0, 0.0]))
    return Rig((camera, camera), np.stack([rigid3.IDENTITY, right]))


def seen_by(rig: Rig, rig_from_world: Array, xyz: Array, rng: np.random.Generator) -> Array:
    """(N, 2, 2) noisy pixels, NaN outside the images."""
    out = np.empty((len(xyz), 2, 2))
    for s in range(2):
        out[:, s] = project(rig.cameras[s], rigid3.apply(rigid3.compose(rig.cam_from_rig[s], rig_from_world), xyz))
    out += rng.normal(0, NOISE_PX, out.shape)
    out[~((out > 0) & (out < (1200, 400))).all((1, 2))] = np.nan
    return out


@pytest.mark.parametrize("is_turned", [True, False])
def test_the_end_of_a_drive_finds_the_turn_and_with_it_the_scale(is_turned: bool) -> None:
    rng = np.random.default_rng(1)
    ground_truth = rig_turned_by(TURN if is_turned else np.zeros(3))
    poses, xyz = [], rng.uniform([-25, -5, 3], [25, 5, 120], (3000, 3))
    keyframes = KeyframeMap(rig_turned_by(np.zeros(3)))
    keyframes.new_points(len(xyz))
    for k in range(25):
        turn = rigid3.exp_so3(np.array([0.0, 0.02 * k, 0.0]))
        poses.append(rigid3.from_matrix(turn, -turn @ np.array([0.01 * k * k, 0.0, 1.5 * k])))
        xy = seen_by(ground_truth, poses[-1], xyz, rng)
        seen = np.flatnonzero(np.isfinite(xy[:, 0, 0]) & (rigid3.apply(poses[-1], xyz)[:, 2] > 2))
        keyframes.append(Keyframe(k, 0.1 * k, str(k), poses[-1].copy(), seen, xy[seen], np.ones((len(seen), 2), bool)))
    keyframes.point_xyz[: len(xyz)] = xyz
    keyframes.point_xyz[keyframes.num_observations(np.arange(keyframes.num_points)) < 6] = np.nan
    report = adjust_finally(keyframes, OdometryOptions(covariance=False), Events()).report
    assert report["camera"]["is_refined"] is is_turned
    found = rigid3.center(np.array([k.rig_from_world for k in keyframes.keyframes]))
    scale = similarity.umeyama(found, rigid3.center(np.array(poses)))[7]
    assert abs(scale - 1) < 2e-3
    fixed = conclude_with_given_rig(keyframes, poses)
    assert abs(fixed - 1) > 3e-3 if is_turned else abs(fixed - 1) < 2e-3


def conclude_with_given_rig(keyframes: KeyframeMap, poses: list[Array]) -> float:
    """The scale that the same observations get when the calibration is believed."""
    keyframes.rig = rig_turned_by(np.zeros(3))
    adjust_finally(keyframes, OdometryOptions(covariance=False, refine_camera=False), Events())
    found = rigid3.center(np.array([k.rig_from_world for k in keyframes.keyframes]))
    return float(similarity.umeyama(found, rigid3.center(np.array(poses)))[7])
