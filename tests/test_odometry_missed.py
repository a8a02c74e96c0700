"""Frames without a pose, followed back from where the map begins or is found again."""

from __future__ import annotations

import numpy as np

import odometry_sequences as played
from rendered_worlds import sequences as rendered
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.odometry.frontend.pyramid import build_pyramid
from sfmapp.odometry.map.local_map import LocalMap
from sfmapp.odometry.missed_frames import MissedFrames
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.records import FrameRecord
from sfmapp.odometry.result import FrameState
from sfmapp.odometry.run import Odometry

BEGIN = 10


def map_of(sequence: played.Played) -> LocalMap:
    """What is mapped of the frames from the tenth to the fortieth."""
    part = sequence.taken(np.arange(BEGIN, 40))
    odometry = Odometry(part, OdometryOptions(), seed=0, threads=1, events=Events())  # type: ignore[arg-type]
    for frame in part.frames():
        odometry.process(frame)
    assert odometry.local is not None
    assert odometry.local.keyframes.keyframes[0].frame_idx == 0
    return odometry.local


def missed_of(sequence: played.Played, frames: range) -> MissedFrames:
    missed = MissedFrames()
    for frame in frames:
        missed.note(FrameRecord(frame, str(frame), frame / 30.0), build_pyramid(sequence.images[frame][0]))
    return missed


def test_frames_before_a_map_are_where_they_were() -> None:
    sequence = played.room()
    local, truth = map_of(sequence), sequence.ground_truth.cam_from_world
    placed = missed_of(sequence, range(BEGIN)).reach_back(local, 0)
    assert [frame.record.frame_idx for frame in placed] == list(range(BEGIN))[::-1]
    last = local.keyframes.keyframes[-1]
    # the unit of the map, by its first and its last keyframe
    true_way = np.linalg.norm(rigid3.center(truth[BEGIN + last.frame_idx]) - rigid3.center(truth[BEGIN]))
    unit = true_way / np.linalg.norm(rigid3.center(last.rig_from_world) - rigid3.center(local.pose(0)))
    for frame in placed:
        ours = rigid3.compose(frame.pose, rigid3.inverse(local.pose(0)))
        true = rigid3.compose(truth[frame.record.frame_idx], rigid3.inverse(truth[BEGIN]))
        assert np.linalg.norm(unit * ours[4:] - true[4:]) < 0.01
        turn = rigid3.rotation_matrix(ours) @ rigid3.rotation_matrix(true).T
        assert rigid3.rotation_angle_deg(turn) < 0.3
        assert not frame.record.has_pose  # who follows notes it, not who finds it


def test_another_place_is_not_followed_into() -> None:
    sequence = played.room()
    elsewhere = played.play(rendered.hall(12, 1, played.OPTICS, sequence.rig))
    assert missed_of(elsewhere, range(12)).reach_back(map_of(sequence), 0) == []


def test_following_ends_with_the_first_frame_that_shows_nothing() -> None:
    sequence = played.room()
    missed = missed_of(sequence, range(4))
    missed.note(FrameRecord(4, "dark", 4 / 30.0), build_pyramid(np.zeros((240, 320), np.uint8)))
    for frame in range(5, BEGIN):
        missed.note(FrameRecord(frame, str(frame), frame / 30.0), build_pyramid(sequence.images[frame][0]))
    placed = missed.reach_back(map_of(sequence), 0)
    assert [frame.record.frame_idx for frame in placed] == [9, 8, 7, 6, 5]
    missed.forget()
    assert missed.reach_back(map_of(sequence), 0) == []


def test_a_camera_that_turns_before_it_walks_has_poses_from_where_the_map_reaches() -> None:
    sequence = played.play(rendered.pan(played.room_walk(60), 0, 24, 70.0))
    result = played.run(sequence)
    has_pose = np.isfinite(result.cam_from_world[:, 0])
    live = np.isfinite(result.live_cam_from_world[:, 0])
    assert has_pose[15:].all()
    assert (result.frame_state[has_pose & ~live] == FrameState.WAITING).all()
    ours, truth = played.centers_and_ground_truth(result, sequence)
    assert played.absolute_error(result, sequence)[0] < 0.01 * np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert len(ours) == has_pose.sum()
