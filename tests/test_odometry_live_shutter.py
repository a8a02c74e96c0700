"""A rolling shutter that is found while a map grows, and taken off later frames: points and noise, no images."""

from __future__ import annotations

import numpy as np
import pytest

from hand_held_map import CAMERA, error, make_map, pose_at, seen
from sfmapp.camera.camera import project
from sfmapp.geometry import rigid3
from sfmapp.odometry.early_calibration import EarlyCalibration
from sfmapp.odometry.frontend.row_motion import RowMotion
from sfmapp.odometry.live_shutter import LiveShutter
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.map.local_map import LocalMap
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.records import FrameRecord
from sfmapp.odometry.shutter import straighten
from sfmapp.odometry.tracker import _measure_by_rows

READOUT = 0.6


def points() -> np.ndarray:
    rng = np.random.default_rng(1)
    xyz = np.column_stack([rng.uniform(-2, 2, (400, 2)), rng.uniform(2, 5, 400)])
    xy = project(CAMERA, rigid3.apply(pose_at(20), xyz))
    return xyz[((xy > 30) & (xy < (610, 450))).all(1)]


def grown(num_keyframes: int, readout: float) -> tuple[LocalMap, list[FrameRecord], list[FrameRecord]]:
    """The first keyframes of a map, the frames up to the last of them, and those that are yet to come."""
    keyframes, records = make_map(readout)
    while len(keyframes.keyframes) > num_keyframes:
        keyframes.remove(num_keyframes)
    local = LocalMap(keyframes.rig, OdometryOptions(), None, 0)
    local.keyframes = keyframes
    num = 3 * num_keyframes - 2
    return local, records[:num], records[num:]


def off(keyframes: KeyframeMap, xyz: np.ndarray) -> float:
    """Median pixels from where a global shutter would have seen the points, from true poses and points."""
    lengths = []
    for keyframe in keyframes.keyframes:
        there = project(CAMERA, rigid3.apply(pose_at(keyframe.frame_idx), xyz[keyframe.point_id]))
        lengths.append(np.linalg.norm(there - keyframe.straight_xy(0), axis=1))
    return float(np.median(np.concatenate(lengths)))


def test_a_steady_motion_tells_where_rows_were() -> None:
    xyz, before, pose = points(), pose_at(19), pose_at(20)
    xy, middle = seen(20, xyz, READOUT, pose_at), project(CAMERA, rigid3.apply(pose, xyz))
    rows = RowMotion(READOUT, rigid3.compose(pose, rigid3.inverse(before)))
    moved = np.linalg.norm(xy - middle, axis=1)
    left = np.linalg.norm(xy - rows.shift_px(CAMERA, pose, xyz, xy) - middle, axis=1)
    assert np.median(moved) > 0.5
    assert np.median(left) < 0.15 * np.median(moved)  # half a frame's change of the motion is left
    assert not RowMotion().shift_px(CAMERA, pose, xyz, xy).any()


def test_a_pose_is_that_of_the_middle_of_the_readout() -> None:
    xyz = points()
    xy = seen(20, xyz, READOUT, pose_at)
    found = [_measure_by_rows(CAMERA, pose_at(19), pose_at(19), xyz, xy, readout) for readout in (0.0, READOUT)]
    errors = [np.linalg.norm(rigid3.center(f[0]) - rigid3.center(pose_at(20))) for f in found if f is not None]
    assert errors[1] < 0.25 * errors[0]
    assert errors[1] < 0.002


@pytest.mark.parametrize("readout", [READOUT, -0.6])
def test_readout_is_found_early_and_taken_off(readout: float) -> None:
    local, records, coming = grown(8, readout)
    shutter = LiveShutter(True, records)
    calibration, xyz = EarlyCalibration(True, shutter, None), local.keyframes.point_xyz.copy()
    before = off(local.keyframes, xyz)
    assert not calibration.refines(local, 22)
    assert calibration.is_asking
    assert shutter.rows(pose_at(1)).readout == 0.0
    assert "rolling shutter" in calibration.refines(local, 32)
    assert shutter.found.readout == pytest.approx(readout, abs=0.06)
    assert calibration.is_open  # the lens may be wrong as well
    assert off(local.keyframes, xyz) < 0.4 * before
    records.append(coming[0])
    assert shutter.rows().readout == pytest.approx(shutter.found.readout)
    records.append(coming[2])  # a frame is missing: the rows are read as fast as ever
    assert shutter.rows().readout == pytest.approx(shutter.found.readout / 2)


def test_a_global_shutter_is_not_taken_for_another() -> None:
    local, records, _ = grown(8, 0.0)
    shutter = LiveShutter(True, records)
    calibration = EarlyCalibration(True, shutter, None)
    assert not calibration.refines(local, 22)
    assert not calibration.refines(local, 32)
    assert shutter.found.readout == 0.0
    assert all(keyframe.row_shift is None for keyframe in local.keyframes.keyframes)


def test_what_was_found_early_is_where_the_end_begins() -> None:
    ends = []
    for begins in (False, True):
        keyframes, records = make_map(READOUT)
        shutter = LiveShutter(True, records)
        if begins:
            local = LocalMap(keyframes.rig, OdometryOptions(), None, 0)
            local.keyframes = keyframes
            shutter.take(0.5, 1e3, local)
            assert shutter.found.readout == 0.5
        found = straighten(records, keyframes, 0, begun=shutter.found)
        assert all(keyframe.row_shift is None for keyframe in keyframes.keyframes)  # it is in what they saw
        ends.append((found.readout, error(keyframes)))
    assert ends[1][0] == pytest.approx(ends[0][0], abs=0.01)
    assert ends[1][1] < 1.3 * ends[0][1]
