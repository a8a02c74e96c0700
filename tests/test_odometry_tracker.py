"""The pose of a frame from points of the map, when a keyframe is due, and what is made of the records."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.camera.camera import CameraModel, project, simple_camera
from sfmapp.geometry import rigid3
from sfmapp.odometry.keyframe_images import KeyframeImages
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.records import FrameRecord, gather, measure_again
from sfmapp.odometry.refinement.final_adjustment import FinalAdjustment
from sfmapp.odometry.report import AdjustmentReport, CalibrationCheck
from sfmapp.odometry.result import FrameState
from sfmapp.odometry.tracker import MIN_INLIERS, measure_pose
from sfmapp.scene.rig import Rig
from sfmapp.scene.synthetic import synthetic_camera

Array = np.ndarray
CAMERA = synthetic_camera(CameraModel.OPENCV, 640, 480, 500.0)
POSE = rigid3.from_matrix(rigid3.exp_so3([0.1, -0.2, 0.05]), np.array([0.3, -0.1, 0.4]))


def scene(seed: int, num: int, sigma_px: float, outlier_ratio: float = 0.0) -> tuple[Array, Array, Array]:
    """World points (N, 3), where they are seen (N, 2), and which of these are wrong."""
    rng = np.random.default_rng(seed)
    in_camera = rng.uniform([-2, -1.5, 3], [2, 1.5, 9], (4 * num, 3))
    xy = project(CAMERA, in_camera)
    inside = np.flatnonzero((xy > 0).all(1) & (xy < [640, 480]).all(1))[:num]
    seen = xy[inside] + rng.normal(0, sigma_px, (len(inside), 2))
    wrong = rng.random(len(inside)) < outlier_ratio
    seen[wrong] = rng.uniform([0, 0], [640, 480], (wrong.sum(), 2))
    return rigid3.apply(rigid3.inverse(POSE), in_camera[inside]), seen, wrong


def disturbed(seed: int, angle_deg: float, shift: float) -> Array:
    rng = np.random.default_rng(seed)
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    return rigid3.compose(rigid3.from_matrix(rigid3.exp_so3(np.radians(angle_deg) * axis), shift * way), POSE)


def error(pose: Array) -> Array:
    delta = rigid3.compose(pose, rigid3.inverse(POSE))
    return np.concatenate([rigid3.log_so3(rigid3.rotation_matrix(delta)), delta[4:]])


@pytest.mark.parametrize("outlier_ratio", [0.0, 0.3, 0.6])
def test_outliers_do_not_move_the_pose(outlier_ratio: float) -> None:
    for seed in range(5):
        xyz, xy, wrong = scene(seed, 200, 0.3, outlier_ratio)
        measured = measure_pose(CAMERA, disturbed(seed, 2.0, 0.05), xyz, xy)
        assert measured is not None
        pose, _, inlier, sigma = measured
        assert np.degrees(np.linalg.norm(error(pose)[:3])) < 0.1
        assert 1e-5 < np.linalg.norm(error(pose)[3:]) < 0.01
        assert inlier[~wrong].mean() > 0.98
        assert inlier[wrong].sum() <= 1
        assert 0.2 < sigma < 0.4


def test_a_bad_start_is_made_good_by_sampling() -> None:
    xyz, xy, wrong = scene(3, 200, 0.3, 0.3)
    measured = measure_pose(CAMERA, disturbed(3, 40.0, 2.0), xyz, xy)
    assert measured is not None
    assert np.degrees(np.linalg.norm(error(measured[0])[:3])) < 0.1
    assert measured[2][~wrong].mean() > 0.98


def test_errors_are_as_large_as_their_covariance() -> None:
    values = []
    for seed in range(150):
        xyz, xy, _ = scene(seed, 80, 0.4)
        measured = measure_pose(CAMERA, disturbed(seed, 0.3, 0.01), xyz, xy)
        assert measured is not None
        e = error(measured[0])
        values.append(e @ np.linalg.solve(measured[1], e) / 6)
    assert 0.7 < np.mean(values) < 1.4


def test_chance_is_no_pose() -> None:
    rng = np.random.default_rng(0)
    for seed in range(5):
        xyz, xy, _ = scene(seed, 120, 0.3)
        assert measure_pose(CAMERA, POSE, xyz, rng.permutation(xy)) is None
    xyz, xy, _ = scene(9, MIN_INLIERS - 1, 0.3)
    assert measure_pose(CAMERA, POSE, xyz, xy) is None


# ------------------------------------------------------------------ records


def keyframes_along(offset: float) -> KeyframeMap:
    """Two keyframes and points before them."""
    keyframes = KeyframeMap(Rig.single(simple_camera(CameraModel.PINHOLE, 640, 480, 500.0)))
    rng = np.random.default_rng(0)
    ids = keyframes.new_points(60)
    keyframes.point_xyz[ids] = rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (60, 3))
    for k in range(2):
        pose = np.array([0, 0, 0, 1.0, offset - 0.2 * k, 0, 0])
        xy = project(keyframes.rig.cameras[0], rigid3.apply(pose, keyframes.point_xyz[ids]))[:, None]
        keyframes.append(Keyframe(4 * k, 0.4 * k, f"{4 * k}.png", pose, ids, xy, np.isfinite(xy[:, :, 0])))
    return keyframes


def record(frame: int, map_idx: int = -1, keyframe: int = -1, shift: float = 0.0) -> FrameRecord:
    out = FrameRecord(frame, f"{frame}.png", 0.1 * frame)
    out.state = FrameState.LOST
    if map_idx >= 0:
        out.settle(FrameState.TRACKED, map_idx, keyframe, np.array([0, 0, 0, 1.0, shift, 0, 0]))
        out.give_out(np.full(7, float(frame)))
    return out


NO_WORD = FinalAdjustment(None, "", AdjustmentReport(camera=CalibrationCheck(is_refined=False)))


def test_the_map_with_the_most_frames_comes_first_and_gaps_stay_gaps() -> None:
    maps = {3: keyframes_along(0.0), 5: keyframes_along(1.0)}
    records = [record(0, 3, 0), record(1, 3, 0, 0.1), record(2), record(3, 5, 0), record(4, 5, 1), record(5, 5, 1, 0.3)]
    result = gather(records, maps, dict.fromkeys(maps, NO_WORD), KeyframeImages())
    np.testing.assert_array_equal(result.frame_map, [1, 1, -1, 0, 0, 0])
    np.testing.assert_allclose(result.cam_from_world[[0, 1, 3, 4, 5], 4], [0.0, 0.1, 1.0, 0.8, 1.1])
    assert np.isnan(result.cam_from_world[2]).all()
    assert np.isnan(result.live_cam_from_world[2]).all()
    assert result.frame_state[2] == FrameState.LOST
    assert [m.keyframe_frame_idx.tolist() for m in result.maps] == [[0, 4], [0, 4]]
    np.testing.assert_allclose(result.maps[0].reconstruction.cam_from_world[:, 4], [1.0, 0.8])
    assert result.maps[0].scale_source == "none"


def test_no_map_at_all_is_a_result() -> None:
    result = gather([record(0), record(1)], {}, {}, KeyframeImages())
    assert result.maps == []
    np.testing.assert_array_equal(result.frame_map, [-1, -1])
    assert np.isnan(result.cam_from_world).all()


def test_frames_between_keyframes_are_measured_again_where_they_can_be() -> None:
    keyframes = keyframes_along(0.0)
    camera, ids = keyframes.rig.cameras[0], np.arange(60)
    true = np.array([0, 0, 0, 1.0, -0.1, 0, 0])
    seen, blind, key = record(1, 0, 0, -0.07), record(2, 0, 0, -0.07), record(4, 0, 1, 0.05)
    seen.point_id = ids.astype(np.int32)
    seen.xy = project(camera, rigid3.apply(true, keyframes.point_xyz[ids])).astype(np.float32)
    key.is_keyframe = True
    measure_again([seen, blind, key], keyframes, 0)
    np.testing.assert_allclose(seen.frame_from_keyframe, true, atol=1e-5)
    assert blind.frame_from_keyframe[4] == -0.07
    assert key.frame_from_keyframe[4] == 0.05
