"""The readout of a rolling shutter from a map, and the map without it."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from sfmapp.camera.camera import Camera, CameraModel, project
from sfmapp.geometry import rigid3, similarity
from sfmapp.images.sequence import Imu
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.records import FrameRecord
from sfmapp.odometry.result import FrameState
from sfmapp.odometry.shutter import straighten
from sfmapp.scene.rig import Rig

CAMERA = Camera(CameraModel.PINHOLE, 640, 480, np.array([525.0, 525.0, 320.0, 240.0]), is_fixed=True)


def pose_at(frame: float) -> np.ndarray:
    """A hand that moves to and fro and turns: up to a degree a frame."""
    t = frame / 30.0
    center = np.array([0.3 * np.sin(2.1 * t), 0.2 * np.sin(3.3 * t + 1), 0.15 * np.sin(1.7 * t + 2)])
    rotation = rigid3.exp_so3(np.array([0.12 * np.sin(2.9 * t), 0.2 * np.sin(2.3 * t + 0.5), 0.1 * np.sin(3.1 * t)]))
    return rigid3.from_matrix(rotation, -rotation @ center)


def seen(frame: int, xyz: np.ndarray, readout: float) -> np.ndarray:
    """(N, 2) where a rolling shutter sees points: the row tells the time, which tells the row."""
    xy = project(CAMERA, rigid3.apply(pose_at(frame), xyz))
    for _ in range(3):
        when = frame + readout * (xy[:, 1] / CAMERA.height - 0.5)
        xy = np.array([project(CAMERA, rigid3.apply(pose_at(t), p[None]))[0] for t, p in zip(when, xyz, strict=True)])
    return xy


def make_map(readout: float, noise_px: float = 0.15) -> tuple[KeyframeMap, list[FrameRecord]]:
    """Thirty keyframes, one each three frames, with the poses and points of a global shutter."""
    rng = np.random.default_rng(5)
    xyz = np.column_stack([rng.uniform(-2, 2, (150, 2)), rng.uniform(2, 5, 150)])
    keyframes, records = KeyframeMap(Rig.single(CAMERA)), []
    ids = keyframes.new_points(len(xyz))
    keyframes.point_xyz[ids] = xyz
    for frame in range(88):
        xy = seen(frame, xyz, readout)
        xy += noise_px * rng.standard_normal(xy.shape)
        inside = np.flatnonzero(((xy > 0) & (xy < (640, 480))).all(1))
        record = FrameRecord(frame, f"{frame}", frame / 30.0, FrameState.TRACKED, 0, frame // 3, frame % 3 == 0)
        if frame % 3 == 0:
            good = np.ones((len(inside), 1), bool)
            keyframes.append(Keyframe(frame, frame / 30.0, "", pose_at(frame), ids[inside], xy[inside, None], good))
        else:
            record.point_id, record.xy = ids[inside].astype(np.int32), xy[inside].astype(np.float32)
        keyframe = keyframes.keyframes[frame // 3].rig_from_world
        record.frame_from_keyframe = rigid3.compose(pose_at(frame), rigid3.inverse(keyframe))
        records.append(record)
    return keyframes, records


def error(keyframes: KeyframeMap) -> float:
    """ATE of the keyframes after a similarity, in metres."""
    centers = rigid3.center(np.array([k.rig_from_world for k in keyframes.keyframes]))
    ground_truth = rigid3.center(np.array([pose_at(k.frame_idx) for k in keyframes.keyframes]))
    aligned = similarity.apply(similarity.umeyama(centers, ground_truth), centers)
    return float(np.sqrt(((aligned - ground_truth) ** 2).sum(1).mean()))


@pytest.mark.parametrize("readout", [0.6, -0.3])
def test_readout_is_found_and_undone(readout: float) -> None:
    keyframes, records = make_map(readout)
    found = straighten(records, keyframes, 0)
    assert found["readout"] == pytest.approx(readout, abs=0.04)
    assert found["evidence"] > 5 * found["min_evidence"]
    assert error(keyframes) < 0.003  # noise alone leaves a millimetre
    still = project(CAMERA, rigid3.apply(pose_at(31), keyframes.point_xyz[records[31].point_id]))
    assert np.median(np.linalg.norm(still - records[31].xy, axis=1)) < 2.0  # the frames' own views move along


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


_steady = pose_at


def trembling(frame: float) -> np.ndarray:
    """The same with a hand that trembles by half a degree, faster than frames can tell."""
    pose, t = _steady(frame), frame / 30.0
    turn = rigid3.exp_so3(0.008 * np.sin(2 * np.pi * np.array([6.1, 7.3, 5.2]) * t + np.arange(3)))
    rotation = turn @ rigid3.rotation_matrix(pose)
    return rigid3.from_matrix(rotation, -rotation @ rigid3.center(pose))


def gyroscope(late_s: float = 0.0) -> Imu:
    """On the camera, with a bias and the noise of a small sensor."""
    times, h, rng = np.arange(-0.1, 3.1, 0.005), 1e-3, np.random.default_rng(6)
    rotation = [[rigid3.rotation_matrix(trembling(30 * (t + d))) for t in times] for d in (-h, h)]
    rates = rigid3.log_so3(np.array(rotation[0]) @ np.array(rotation[1]).swapaxes(1, 2)) / (2 * h)
    gyro = rates + [0.01, -0.02, 0.03] + 1.7e-4 * np.sqrt(200) * rng.normal(size=rates.shape)
    return Imu(times + late_s, gyro, np.zeros_like(gyro), rigid3.IDENTITY, 1.7e-4, 2e-3, 1.9e-5, 3e-3)


def test_a_gyroscope_tells_what_a_hand_does_between_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "pose_at", trembling)
    errors, found = [], []
    for imu in (None, gyroscope(), gyroscope(late_s=0.4)):
        keyframes, records = make_map(0.6)
        found.append(straighten(records, keyframes, 0, imu)["readout"])
        errors.append(error(keyframes))
    assert found[1] == pytest.approx(0.6, abs=0.04)
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < 1.05 * errors[0]  # on another clock: not believed
