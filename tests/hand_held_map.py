"""A map of a hand-held camera with what the frames between its keyframes saw: points and noise, no images."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from sfmapp.camera.camera import Camera, CameraModel, project
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.records import FrameRecord
from sfmapp.odometry.result import FrameState
from sfmapp.scene.rig import Rig

CAMERA = Camera(CameraModel.PINHOLE, 640, 480, np.array([525.0, 525.0, 320.0, 240.0]), is_fixed=True)


class Motion(Protocol):
    """Poses (..., 7) at frames (...), which need not be whole."""

    def __call__(self, frame: ArrayLike) -> np.ndarray: ...


def pose_at(frame: ArrayLike) -> np.ndarray:
    """A hand that moves to and fro and turns: up to a degree a frame."""
    t = np.asarray(frame, np.float64)[..., None] / 30.0
    center = np.array([0.3, 0.2, 0.15]) * np.sin(np.array([2.1, 3.3, 1.7]) * t + np.arange(3))
    turn = np.array([0.12, 0.2, 0.1]) * np.sin(np.array([2.9, 2.3, 3.1]) * t + np.array([0.0, 0.5, 0.0]))
    return posed(rigid3.exp_so3(turn), center)


def trembling(frame: ArrayLike) -> np.ndarray:
    """The same with a hand that trembles by half a degree, faster than frames can tell."""
    steady, t = pose_at(frame), np.asarray(frame, np.float64)[..., None] / 30.0
    turn = rigid3.exp_so3(0.008 * np.sin(2 * np.pi * np.array([6.1, 7.3, 5.2]) * t + np.arange(3)))
    return posed(turn @ rigid3.rotation_matrix(steady), rigid3.center(steady))


def posed(rotation: np.ndarray, center: np.ndarray) -> np.ndarray:
    return rigid3.from_matrix(rotation, -np.einsum("...ij,...j->...i", rotation, center))


def seen(frame: int, xyz: np.ndarray, readout: float, motion: Motion) -> np.ndarray:
    """(N, 2) where a rolling shutter sees points: the row tells the time, which tells the row."""
    xy = project(CAMERA, rigid3.apply(motion(frame), xyz))
    for _ in range(3):
        poses = motion(frame + readout * (xy[:, 1] / CAMERA.height - 0.5))
        xy = project(CAMERA, np.einsum("nij,nj->ni", rigid3.rotation_matrix(poses), xyz) + poses[:, 4:])
    return xy


def make_map(
    readout: float, motion: Motion = pose_at, noise_px: float = 0.15, seed: int = 5, every: int = 3
) -> tuple[KeyframeMap, list[FrameRecord]]:
    """A keyframe each so many of 88 frames, with the poses and points of a global shutter."""
    rng = np.random.default_rng(seed)
    xyz = np.column_stack([rng.uniform(-2, 2, (150, 2)), rng.uniform(2, 5, 150)])
    keyframes, records = KeyframeMap(Rig.single(CAMERA)), []
    ids = keyframes.new_points(len(xyz))
    keyframes.point_xyz[ids] = xyz
    for frame in range(88):
        xy = seen(frame, xyz, readout, motion)
        xy += noise_px * rng.standard_normal(xy.shape)
        inside = np.flatnonzero(((xy > 0) & (xy < (640, 480))).all(1))
        record = FrameRecord(frame, f"{frame}", frame / 30.0, FrameState.TRACKED, 0, frame // every, frame % every == 0)
        if frame % every == 0:
            good = np.ones((len(inside), 1), bool)
            keyframes.append(Keyframe(frame, frame / 30.0, "", motion(frame), ids[inside], xy[inside, None], good))
        else:
            record.point_id, record.xy = ids[inside].astype(np.int32), xy[inside].astype(np.float32)
        keyframe = keyframes.keyframes[frame // every].rig_from_world
        record.frame_from_keyframe = rigid3.compose(motion(frame), rigid3.inverse(keyframe))
        records.append(record)
    return keyframes, records


def error(keyframes: KeyframeMap) -> float:
    """ATE of the keyframes after a similarity, in metres."""
    centers = rigid3.center(np.array([k.rig_from_world for k in keyframes.keyframes]))
    ground_truth = rigid3.center(pose_at([k.frame_idx for k in keyframes.keyframes]))  # where a trembling hand is too
    aligned = similarity.apply(similarity.umeyama(centers, ground_truth), centers)
    return float(np.sqrt(((aligned - ground_truth) ** 2).sum(1).mean()))
