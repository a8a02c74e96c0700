"""The frames between the keyframes, adjusted with them."""

from __future__ import annotations

import numpy as np

from hand_held_map import make_map
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.frames_adjustment import adjust_frames
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.records import FrameRecord, measure_again
from sfmapp.odometry.refinement.final_adjustment import adjust_finally

OPTIONS = OdometryOptions(refine_camera=False, covariance=False)


def poses_of(records: list[FrameRecord], keyframes: KeyframeMap) -> np.ndarray:
    """(F, 7) of all frames."""
    on = [keyframes.keyframes[record.keyframe].rig_from_world for record in records]
    return rigid3.compose(np.array([record.frame_from_keyframe for record in records]), np.array(on))


def error(keyframes: KeyframeMap, truth: np.ndarray) -> float:
    """Root mean square error of the points, without the farthest twentieth, after a similarity."""
    xyz = keyframes.point_xyz[: keyframes.num_points]
    known = np.isfinite(xyz[:, 0])
    xyz, truth = xyz[known], truth[known]
    squared = ((similarity.apply(similarity.umeyama(xyz, truth), xyz) - truth) ** 2).sum(1)
    return float(np.sqrt(np.sort(squared)[: int(0.95 * len(squared))].mean()))


def closed_map(seed: int) -> tuple[KeyframeMap, list[FrameRecord]]:
    """A map whose eight keyframes have been adjusted, and whose other eighty frames have been measured."""
    keyframes, records = make_map(0.0, noise_px=0.3, seed=seed, every=11)
    adjust_finally(keyframes, OPTIONS, Events())
    measure_again(records, keyframes, 0)
    return keyframes, records


def test_points_are_as_much_better_as_eleven_times_the_observations_make_them() -> None:
    ratios = []
    for seed in range(6):
        keyframes, records = closed_map(seed)
        truth = make_map(0.0, seed=seed, every=11)[0].point_xyz[: keyframes.num_points]
        before = error(keyframes, truth)
        assert adjust_frames(records, keyframes, 0, Events()) == 80
        ratios.append(error(keyframes, truth) / before)
    # 11 ** -0.5 is 0.30
    assert 0.25 < np.mean(ratios) < 0.4


def test_the_first_keyframe_stays_where_it_is() -> None:
    keyframes, records = closed_map(0)
    before = keyframes.keyframes[0].rig_from_world.copy()
    adjust_frames(records, keyframes, 0, Events())
    np.testing.assert_array_equal(keyframes.keyframes[0].rig_from_world, before)


def test_a_few_frames_between_many_keyframes_change_nothing() -> None:
    keyframes, records = closed_map(1)
    kept = [record for record in records if record.is_keyframe or record.frame_idx % 44 == 1]
    before = poses_of(kept, keyframes)
    assert adjust_frames(kept, keyframes, 0, Events()) == 0
    np.testing.assert_array_equal(poses_of(kept, keyframes), before)


def test_a_twin_counts_once_and_stays_where_the_frame_before_it_is() -> None:
    keyframes, records = closed_map(2)
    frame = records[1]
    twin = FrameRecord(1000, "twin", frame.timestamp_s, frame.state, 0, frame.keyframe)
    twin.frame_from_keyframe = frame.frame_from_keyframe.copy()
    twin.be_twin_of(frame)
    records.insert(2, twin)
    assert adjust_frames(records, keyframes, 0, Events()) == 80
    np.testing.assert_array_equal(twin.frame_from_keyframe, frame.frame_from_keyframe)


def test_a_point_that_a_frame_saw_as_two_counts_once() -> None:
    keyframes, records = closed_map(3)
    frame, plain = records[1], closed_map(3)
    frame.see(np.append(frame.point_id, frame.point_id[:3]), np.concatenate([frame.xy, frame.xy[:3]]))
    adjust_frames(records, keyframes, 0, Events())
    adjust_frames(plain[1], plain[0], 0, Events())
    np.testing.assert_allclose(poses_of(records, keyframes), poses_of(plain[1], plain[0]), atol=1e-9)
