"""The readout of a rolling shutter from a map, and the map without it."""

from __future__ import annotations

import numpy as np
import pytest

from hand_held_map import CAMERA, error, make_map, pose_at, trembling
from sfmapp.camera.camera import project
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu
from sfmapp.odometry.shutter import straighten


@pytest.mark.parametrize("readout", [0.6, -0.3])
def test_readout_is_found_and_undone(readout: float) -> None:
    keyframes, records = make_map(readout)
    found = straighten(records, keyframes, 0)
    assert found["readout"] == pytest.approx(readout, abs=0.04)
    assert found["evidence"] > 5 * found["min_evidence"]
    assert error(keyframes) < 0.003  # noise alone leaves a millimetre
    still = project(CAMERA, rigid3.apply(pose_at(31), keyframes.point_xyz[records[31].point_id]))
    assert np.median(np.linalg.norm(still - records[31].xy, axis=1)) < 2.0  # the frames' own views move along


def test_what_was_given_up_for_the_shutter_comes_back() -> None:
    keyframes, records = make_map(0.6)
    for keyframe in keyframes.keyframes:  # as a map does that knows of no shutter: nearly half is off by a pixel
        there = project(CAMERA, rigid3.apply(keyframe.rig_from_world, keyframes.point_xyz[keyframe.point_id]))
        keyframe.is_inlier[:, 0] = np.linalg.norm(there - keyframe.xy[:, 0], axis=1) < 1.0
    assert np.mean(np.concatenate([k.is_inlier for k in keyframes.keyframes])) < 0.6
    found = straighten(records, keyframes, 0)
    assert found["first_readout"] < 0.58  # by what was left
    assert found["readout"] == pytest.approx(0.6, abs=0.02)
    assert np.mean(np.concatenate([k.is_inlier for k in keyframes.keyframes])) > 0.95
    assert error(keyframes) < 0.0008


def test_global_shutter_is_left_alone() -> None:
    keyframes, records = make_map(0.0)
    before = [(k.xy.copy(), k.rig_from_world.copy()) for k in keyframes.keyframes]
    found = straighten(records, keyframes, 0)
    assert found["readout"] == 0.0
    assert found["evidence"] < found["min_evidence"]
    for keyframe, (xy, pose) in zip(keyframes.keyframes, before, strict=True):
        np.testing.assert_array_equal(keyframe.xy, xy)
        np.testing.assert_array_equal(keyframe.rig_from_world, pose)


def test_a_point_behind_its_camera_does_not_decide() -> None:
    keyframes, records = make_map(0.0)
    center = rigid3.center(keyframes.keyframes[0].rig_from_world)
    behind = keyframes.keyframes[0].point_id[3]
    keyframes.point_xyz[behind] = center - 0.1 * (keyframes.point_xyz[behind] - center)
    found = straighten(records, keyframes, 0)
    assert found["readout"] == 0.0
    assert 0.0 <= found["evidence"] < found["min_evidence"]


def test_frames_without_neighbours_say_nothing() -> None:
    keyframes, records = make_map(0.6)
    for record in records:
        record.timestamp_s *= 1.0 + 10.0 * (record.frame_idx % 2)
    for record in records[1:]:
        record.frame_from_keyframe = np.full(7, np.nan)
    assert straighten(records, keyframes, 0)["readout"] == 0.0


def gyroscope(late_s: float = 0.0) -> Imu:
    """On the camera, with a bias and the noise of a small sensor."""
    times, h, rng = np.arange(-0.1, 3.1, 0.005), 1e-3, np.random.default_rng(6)
    before, after = (rigid3.rotation_matrix(trembling(30 * (times + d))) for d in (-h, h))
    rates = rigid3.log_so3(before @ after.swapaxes(1, 2)) / (2 * h)
    gyro = rates + [0.01, -0.02, 0.03] + 1.7e-4 * np.sqrt(200) * rng.normal(size=rates.shape)
    return Imu(times + late_s, gyro, np.zeros_like(gyro), rigid3.IDENTITY, 1.7e-4, 2e-3, 1.9e-5, 3e-3)


def test_a_gyroscope_tells_what_a_hand_does_between_frames() -> None:
    errors, found = [], []
    for imu in (None, gyroscope(), gyroscope(late_s=0.4)):
        keyframes, records = make_map(0.6, trembling)
        found.append(straighten(records, keyframes, 0, imu)["readout"])
        errors.append(error(keyframes))
    assert found[1] == pytest.approx(0.6, abs=0.04)
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < 1.05 * errors[0]  # on another clock: not believed
