"""What odometry keeps from frame to frame: its phase, its motion, the frames' places in the maps, and their images."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

import odometry_sequences as played
from sfmapp.camera.camera import CameraModel, simple_camera
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu
from sfmapp.odometry.inertial.markers import MarkerDetector
from sfmapp.odometry.keyframe_images import KeyframeImages
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.motion_model import MotionModel
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.records import FrameRecord
from sfmapp.odometry.result import FrameState
from sfmapp.odometry.run import run_odometry
from sfmapp.odometry.state import Phase, RunState
from sfmapp.scene.rig import Rig

# ------------------------------------------------------------------ phases


def test_a_run_goes_from_map_to_loss_to_another_map() -> None:
    state = RunState()
    assert state.may_begin_map
    assert not state.is_lost
    state.track()
    assert state.phase is Phase.TRACKING
    assert not state.may_begin_map
    state.lose(10.0)
    assert state.is_lost
    assert not state.may_begin_map
    state.wait(10.9, 1.0)
    assert state.phase is Phase.LOST
    state.wait(11.0, 1.0)
    assert state.is_lost
    assert state.may_begin_map
    state.track()
    state.lose(20.0)  # a loss begins anew
    state.wait(20.5, 1.0)
    assert state.phase is Phase.LOST


def test_a_clock_that_began_in_1970_is_not_rounded_against_anybody() -> None:
    for since in (0.1, 1.7e9 + 0.1, 1.7e9 + 0.7):
        state = RunState(Phase.TRACKING)
        state.lose(since)
        state.wait(since + 1.0, 1.0)
        assert state.phase is Phase.STARTING_OVER


@pytest.mark.parametrize("phase", list(Phase))
def test_nothing_else_may_follow(phase: Phase) -> None:
    if phase is Phase.TRACKING:
        with pytest.raises(AssertionError, match="TRACKING cannot follow TRACKING"):
            RunState(phase).track()
    else:
        with pytest.raises(AssertionError, match=f"LOST cannot follow {phase.name}"):
            RunState(phase).lose(0.0)


# ------------------------------------------------------------------ motion


def turned_by(angle: float, forward: float = 0.0) -> np.ndarray:
    return rigid3.from_matrix(rigid3.exp_so3([0.0, angle, 0.0]), [0.0, 0.0, forward])


def test_a_steady_motion_goes_on_for_the_time_that_passes() -> None:
    motion = MotionModel(None)
    np.testing.assert_array_equal(motion.predict([0.0]), rigid3.IDENTITY)
    motion.learn(turned_by(0.1))
    np.testing.assert_array_equal(motion.predict([0.0, 0.1, 0.21]), motion.step)  # a clock may jitter
    np.testing.assert_allclose(motion.predict([0.0, 0.1, 0.3]), turned_by(0.2), atol=1e-12)
    np.testing.assert_allclose(motion.predict([0.0, 0.1, 9.0]), turned_by(0.3), atol=1e-12)  # three steps, no more
    motion.rescale(2.0)
    np.testing.assert_array_equal(motion.step, turned_by(0.1))
    motion.learn(turned_by(0.1, 0.5))
    motion.rescale(2.0)
    np.testing.assert_allclose(motion.step, turned_by(0.1, 1.0))
    motion.stop()
    np.testing.assert_array_equal(motion.predict([0.0, 0.1, 0.2]), rigid3.IDENTITY)


@pytest.mark.parametrize(("sign", "is_right"), [(1.0, True), (-1.0, False)])
def test_a_gyroscope_is_believed_where_it_has_been_better(sign: float, is_right: bool) -> None:
    """Turns that change from frame to frame, which a steady motion never foretells and a right gyroscope does."""
    rate, times = 10.0, np.arange(0.0, 4.0, 1e-3)
    speed = np.sin(7.0 * times)  # rad/s of the body, of which the camera sees the scene turn the other way
    gyro = np.zeros((len(times), 3))
    gyro[:, 1] = sign * speed
    imu = Imu(times, gyro, np.zeros((len(times), 3)), rigid3.IDENTITY, 1e-4, 1e-3, 1e-5, 1e-4)
    angle = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(times))])
    frames = np.arange(0.0, 3.9, 1 / rate)
    turns = -np.diff(np.interp(frames, times, angle))
    motion, errors = MotionModel(imu), []
    for n in range(2, len(frames)):
        predicted = motion.predict(frames[n - 2 : n + 1].tolist())
        errors.append(rigid3.rotation_angle_deg(rigid3.rotation_matrix(rigid3.compose(
            predicted, rigid3.inverse(turned_by(turns[n - 1])))))
        )  # fmt: skip
        motion.learn(turned_by(turns[n - 1]))
    steady = np.degrees(np.abs(np.diff(turns)))[-20:]
    if is_right:
        assert np.max(errors[-20:]) < 0.01
    else:
        np.testing.assert_allclose(errors[-20:], steady, atol=1e-6)  # as if there were none


# ------------------------------------------------------------------ frames in maps


def settled(shift: float = 0.5, is_keyframe: bool = False) -> FrameRecord:
    record = FrameRecord(7, "7.png", 0.7)
    record.settle(FrameState.TRACKED, 2, 3, np.array([0, 0, 0, 1.0, shift, 0, 0]), is_keyframe=is_keyframe)
    record.see(np.array([4, 6]), np.array([[1.0, 2.0], [3.0, 4.0]]))
    return record


def test_a_frame_has_a_pose_once_it_has_a_place() -> None:
    record = FrameRecord(7, "7.png", 0.7)
    assert (record.has_pose, record.map_idx, record.keyframe) == (False, -1, -1)
    record = settled()
    assert (record.has_pose, record.map_idx, record.keyframe, record.is_keyframe) == (True, 2, 3, False)
    assert np.isnan(record.live).all()
    pose = np.arange(7.0)
    record.give_out(pose)
    pose[:] = 0
    assert record.live.tolist() == list(range(7))  # what was given out stays


def test_a_frame_moves_with_its_map() -> None:
    record = settled()
    become = np.arange(20, dtype=np.int32)
    become[16] = 1  # point 6 of the other map is point 1 of this one
    record.move(4.0, become, 10)
    record.join(5, 8)
    assert record.frame_from_keyframe[4] == 2.0
    assert record.point_id.tolist() == [14, 1]
    assert (record.map_idx, record.keyframe) == (5, 8)


def test_only_frames_between_keyframes_take_a_measured_pose() -> None:
    covariance, pose = 2.0 * np.eye(6), np.array([0, 0, 0, 1.0, 9, 0, 0])
    for is_keyframe in (False, True):
        record = settled(is_keyframe=is_keyframe)
        record.measure(covariance, pose)
        assert record.covariance is covariance
        assert record.frame_from_keyframe[4] == (0.5 if is_keyframe else 9.0)


@pytest.mark.parametrize("is_keyframe", [False, True])
def test_a_dropped_keyframe_leaves_its_frames_where_they_are(is_keyframe: bool) -> None:
    record, rng = settled(0.0 if is_keyframe else 0.5, is_keyframe), np.random.default_rng(0)
    before, dropped = rigid3.from_matrix(rigid3.exp_so3(rng.normal(size=(2, 3))), rng.normal(size=(2, 3)))
    at = rigid3.compose(record.frame_from_keyframe, dropped)
    seen = Keyframe(
        7, 0.7, "7.png", dropped, np.array([1, 2, 5]), np.arange(6.0).reshape(3, 1, 2), np.array([[1], [0], [1]], bool)
    )
    record.lose_keyframe(rigid3.compose(dropped, rigid3.inverse(before)), seen)
    assert (record.keyframe, record.is_keyframe) == (2, False)
    np.testing.assert_allclose(rigid3.compose(record.frame_from_keyframe, before), at, atol=1e-12)
    # a frame that was the keyframe keeps what that saw and was right
    assert record.point_id.tolist() == ([1, 5] if is_keyframe else [4, 6])
    assert record.xy.tolist() == ([[0, 1], [4, 5]] if is_keyframe else [[1, 2], [3, 4]])


# ------------------------------------------------------------------ images of keyframes


def test_points_have_the_grey_of_what_they_are_on_whoever_listens() -> None:
    sequence = played.room()
    result = played.run_room()
    heard = run_odometry(sequence, OdometryOptions(), threads=2, events=Events(lambda event: None))  # type: ignore[arg-type]
    model, entry = result.maps[0].reconstruction, result.maps[0]
    np.testing.assert_array_equal(model.point_rgb, heard.maps[0].reconstruction.point_rgb)
    assert (model.point_rgb == model.point_rgb[:, :1]).all()
    tracks, seen = model.tracks, [[] for _ in range(model.tracks.num_tracks)]
    for frame, image_idx in zip(entry.keyframe_frame_idx, entry.keyframe_image_idx, strict=True):
        # a thumbnail of 320 x 240 pixels is blurred by about three of them
        image = cv2.blur(sequence.images[frame][0], (3, 3))
        for obs in tracks.observations_of_image(int(image_idx)):
            x, y = tracks.obs_xy[obs].astype(int)
            seen[tracks.obs_track_idx[obs]].append(int(image[min(y, 239), min(x, 319)]))
    mean = np.array([np.mean(greys) for greys in seen])
    known = model.point_rgb[:, 0] != 128  # seen by the first two views alone: the first had gone by
    assert known.mean() > 0.8
    assert np.corrcoef(mean[known], model.point_rgb[known, 0])[0, 1] > 0.9


def test_a_point_has_the_mean_grey_of_where_it_was_seen() -> None:
    size, images = (640, 480), KeyframeImages()
    keyframes = KeyframeMap(Rig.single(simple_camera(CameraModel.PINHOLE, *size, 500.0)))
    keyframes.point_xyz[keyframes.new_points(3)] = [[-1, 0, 5], [1, 0, 5], [0, 0, 5]]
    for frame, xy in ((0, [[100, 50], [500, 400]]), (4, [[500, 50], [550, 400]])):
        seen = np.array(xy, np.float64)[:, None]
        keyframes.append(
            Keyframe(frame, 0.1 * frame, f"{frame}", rigid3.IDENTITY, np.array([0, 1]), seen, np.ones((2, 1), bool))
        )
        image = np.full(size[::-1], 40, np.uint8)
        image[:, 320:] = 200
        images.look(frame, image)
    keyframes.append(
        Keyframe(8, 0.8, "8", rigid3.IDENTITY, np.array([2]), np.full((1, 1, 2), 9.0), np.ones((1, 1), bool))
    )
    model, _ = keyframes.reconstruction(np.arange(3))
    colors = images.colors(model, np.array([0, 4, 8]), np.arange(3))
    assert colors[:, 0].tolist() == [120, 200, 128]  # the image of frame 8 was never looked at


def test_markers_are_found_while_the_image_is_at_hand() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    marker = cv2.aruco.generateImageMarker(dictionary, 7, 60)
    image = np.full((240, 320), 255, np.uint8)
    image[100:160, 200:260] = marker
    images = KeyframeImages(MarkerDetector("4X4_50"))
    for frame in (2, 9):
        images.look(frame, image)
    found = images.sightings(np.array([2, 5, 9]), np.array([0, 1, 2]))  # frame 5 was never looked at
    assert found.image_idx.tolist() == [0, 2]
    assert found.marker_id.tolist() == [7, 7]
    corners = np.array(list(itertools.product((200.0, 260.0), (100.0, 160.0))))
    for square in found.corners:
        nearest = np.linalg.norm(square[:, None] - corners[None], axis=2).min(1)
        assert nearest.max() < 0.6
