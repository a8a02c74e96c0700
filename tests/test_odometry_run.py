"""Odometry on short rendered sequences with exact ground truth, and on real ones: what is found, and what is not made
up."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import odometry_sequences as played
from odometry_sequences import Played, Told, absolute_error, path_length, run, run_room
from rendered_worlds import sequences as rendered
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.map.atlas import Atlas
from sfmapp.odometry.map.local_map import LocalMap, View
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.recognition import Recognition
from sfmapp.odometry.records import FrameRecord
from sfmapp.odometry.result import FrameState, OdometryResult
from sfmapp.odometry.run import run_odometry

Array = np.ndarray


def digest(result: OdometryResult) -> tuple[bytes, ...]:
    """Everything of a result that is numbers, as bytes, times left out."""
    parts = [result.cam_from_world, result.live_cam_from_world, result.frame_map, result.frame_state]
    for m in result.maps:
        model = m.reconstruction
        parts += [model.cam_from_world, model.point_xyz, model.obs_is_inlier, model.tracks.obs_xy, m.keyframe_frame_idx]
        parts += [] if m.covariance is None else [m.covariance]
    return tuple(np.ascontiguousarray(part).tobytes() for part in parts)


def assert_no_jump(result: OdometryResult, sequence: Played, bound_m: float) -> None:
    """Every pose of every map is where the ground truth says: nothing is made up, nothing joined wrongly."""
    for m in range(len(result.maps)):
        ours, ground_truth = played.centers_and_ground_truth(result, sequence, m)
        if len(ours) < 4:
            continue
        unit = similarity.umeyama(ours, ground_truth)
        assert np.linalg.norm(similarity.apply(unit, ours) - ground_truth, axis=1).max() < bound_m


# ------------------------------------------------------------------ plain walks


@pytest.mark.parametrize("seed", range(3))
def test_one_camera_follows_a_walk(seed: int) -> None:
    sequence, result = played.room(seed=seed), run_room(seed=seed)
    assert len(result.maps) == 1
    assert (result.frame_map == 0).all()  # the frames before the map began have poses as well
    assert np.isfinite(result.cam_from_world).all()
    assert (result.frame_state == FrameState.WAITING).sum() < 30
    error, _ = absolute_error(result, sequence)
    assert 1e-5 < error < 0.01 * path_length(sequence)
    # poses that were given out at the time are causal, and nearly as good
    live = np.isfinite(result.live_cam_from_world[:, 0])
    assert (live == (result.frame_state == FrameState.TRACKED)).all()
    assert absolute_error(replace(result, cam_from_world=result.live_cam_from_world), sequence)[0] < 0.04


@pytest.mark.parametrize("seed", range(2))
def test_two_cameras_know_metres_from_the_first_frame_on(seed: int) -> None:
    sequence, result = played.room(is_stereo=True, seed=seed), run_room(is_stereo=True, seed=seed)
    assert (result.frame_state == FrameState.TRACKED).all()
    error, scale = absolute_error(result, sequence)
    assert 1e-5 < error < 0.01 * path_length(sequence)
    assert scale == pytest.approx(1.0, abs=0.03)
    assert result.maps[0].scale_source == "stereo"
    assert result.maps[0].scale_sigma is not None


def test_keyframes_are_frames_of_the_trajectory() -> None:
    result = run_room()
    for m in result.maps:
        model = m.reconstruction
        np.testing.assert_allclose(
            model.cam_from_world[m.keyframe_image_idx], result.cam_from_world[m.keyframe_frame_idx], atol=1e-12
        )
        assert m.covariance is not None
        assert m.covariance.shape == (len(m.keyframe_frame_idx), 6, 6)
        # frames between are known no better than the keyframes that they hang on
        assert result.covariance is not None
        np.testing.assert_array_equal(result.covariance[m.keyframe_frame_idx], m.covariance)
        about = np.einsum("kii->k", result.covariance[:, :3, :3])
        assert (about[np.isfinite(about)] >= about[m.keyframe_frame_idx].min()).all()
        assert [model.image_names[i] for i in m.keyframe_image_idx] == [
            result.frame_names[f] for f in m.keyframe_frame_idx
        ]


@pytest.mark.parametrize("is_stereo", [False, True], ids=["mono", "stereo"])
def test_covariances_have_the_size_of_the_errors(is_stereo: bool) -> None:
    """Within a factor of three in the median; the noise of real tracks is neither independent nor Gaussian."""
    values = []
    for seed in (0, 1):
        sequence = played.room(is_stereo=is_stereo, seed=seed)
        found = run_room(is_stereo=is_stereo, seed=seed).maps[0]
        assert found.covariance is not None
        ours = found.reconstruction.cam_from_world[found.keyframe_image_idx]
        errors = played.gauge_errors(
            ours, sequence.ground_truth.cam_from_world[found.keyframe_frame_idx], 6 if is_stereo else 7
        )
        values += list(played.normalized_errors(errors, found.covariance))
    assert 0.1 < np.median(values) < 9.0


# ------------------------------------------------------------------ the same again


@pytest.mark.parametrize("is_stereo", [False, True], ids=["mono", "stereo"])
def test_runs_give_the_same_bytes_for_any_number_of_threads_also_beside_a_busy_one(is_stereo: bool) -> None:
    sequence, expected = played.room(is_stereo=is_stereo), digest(run_room(is_stereo=is_stereo))
    assert digest(run(sequence, threads=1)) == expected
    stop = threading.Event()

    def waste() -> None:
        rng = np.random.default_rng(0)
        while not stop.is_set():
            for fill in (np.nan, 1e38, -1e38):
                kept = [np.full(int(rng.integers(16, 20000)), fill, np.float32) for _ in range(64)]
            del kept

    thread = threading.Thread(target=waste)
    thread.start()
    try:
        assert digest(run(sequence)) == expected
    finally:
        stop.set()
        thread.join()


def test_live_poses_know_nothing_of_the_future() -> None:
    sequence = played.room()
    whole, part = run_room(), run(sequence.taken(np.arange(50)))
    np.testing.assert_array_equal(whole.live_cam_from_world[:50], part.live_cam_from_world)
    np.testing.assert_array_equal(whole.frame_state[:50], part.frame_state)


def test_the_frame_at_which_worlds_change_has_its_live_pose_in_the_new_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A closure that moves the whole map into another world and unit, as two maps that are joined: exact to the last
    bit of what was moved, so live poses are steady in the old world before it and in the new one from it on."""
    sequence, after_frame = played.room(50), 25
    shift = similarity.from_parts(rigid3.exp_so3([0.3, -0.8, 1.1]), [20.0, -7.0, 3.0], 1.7)
    seen: list[int] = []

    def remember(self: Recognition, maps: object, local: LocalMap, view: View, *_: object) -> object:
        if seen or view.frame_idx < after_frame:
            return None
        seen.append(view.frame_idx)
        empty = SimpleNamespace(old_map=local.map_idx, new_map=local.map_idx, shift=0.0, rotation_deg=0.0, scale=1.7)
        return SimpleNamespace(**vars(empty), num_inliers=(1,), rms_px=0.1, views=[SimpleNamespace(old_idx=0)])

    def close(self: Recognition, maps: dict[int, LocalMap], records: list[FrameRecord], closure: Any) -> Any:
        local = maps[closure.new_map]
        for keyframe in local.keyframes.keyframes:
            keyframe.rig_from_world = similarity.transform_poses(shift, keyframe.rig_from_world)
        local.keyframes.point_xyz[:] = similarity.apply(shift, local.keyframes.point_xyz)
        for record in records:
            record.move(1.7, np.arange(local.keyframes.num_points, dtype=np.int32))
        return local, 1.7

    monkeypatch.setattr(Recognition, "remember", remember)
    monkeypatch.setattr(Recognition, "close", close)
    result = run(sequence)
    live, final = rigid3.center(result.live_cam_from_world), rigid3.center(result.cam_from_world)
    known, is_new = np.isfinite(live[:, 0]), np.arange(50) >= seen[0]
    live[~is_new] = similarity.apply(shift, live[~is_new])
    assert (known & ~is_new).sum() >= 5
    # 1.7 map units are a few metres of a walk: what an adjustment moves is percents of it, the jump was 20 units
    assert np.linalg.norm(live - final, axis=1)[known].max() < 0.1 * np.linalg.norm(np.ptp(final, axis=0))


def test_a_map_that_was_taken_into_another_leaves_its_number_unused() -> None:
    """Live poses are told apart by the numbers of the worlds they were given out in."""
    rig, atlas = played.room_rig(False), Atlas(OdometryOptions(), None)
    first = atlas.new_map(rig)
    assert atlas.new_map(rig).map_idx == first.map_idx  # one that did not begin is forgotten
    for _ in range(2):
        local = atlas.new_map(rig)
        atlas.begin(local)
    del atlas.maps[local.map_idx]
    assert atlas.new_map(rig).map_idx == local.map_idx + 1


@pytest.mark.parametrize("is_stereo", [False, True], ids=["mono", "stereo"])
def test_every_second_frame_and_backwards(is_stereo: bool) -> None:
    sequence = played.room(is_stereo=is_stereo)
    bound = 0.02 * path_length(sequence)
    for other in (sequence.taken(np.arange(0, 80, 2)), sequence.taken(np.arange(80)[::-1], mirrored=True)):
        result = run(other)
        assert len(result.maps) == 1
        assert np.isfinite(result.cam_from_world[:, 0]).mean() > 0.9
        assert 1e-5 < absolute_error(result, other)[0] < bound


# ------------------------------------------------------------------ what goes wrong


@pytest.mark.parametrize("is_stereo", [False, True], ids=["mono", "stereo"])
def test_a_blackout_is_a_gap_and_then_goes_on(is_stereo: bool) -> None:
    sequence = played.play(rendered.blackout(played.room_walk(80, is_stereo), 40, 20))
    told = Told()
    result = run_odometry(sequence, OdometryOptions(), events=told.events)  # type: ignore[arg-type]
    assert (result.frame_state[41:60] == FrameState.LOST).all()
    assert np.isnan(result.cam_from_world[41:60]).all()
    assert np.isnan(result.live_cam_from_world[41:60]).all()
    assert sum("lost" in message for message in told.messages("warned")) == 1
    assert np.isfinite(result.cam_from_world[62:]).all()
    assert (result.frame_map[62:] == 0).all()  # found again in the same map
    assert result.report["losses"] == 1
    assert_no_jump(result, sequence, 0.05)


@pytest.mark.parametrize(("is_stereo", "at"), [(False, 0), (False, 35), pytest.param(True, 35, marks=pytest.mark.slow)])
def test_standing_still_changes_nothing(is_stereo: bool, at: int) -> None:
    sequence = played.play(rendered.stand(played.room_walk(60, is_stereo), at, 60))
    result = run(sequence)
    assert len(result.maps) == 1
    assert np.isfinite(result.cam_from_world).all()
    assert absolute_error(result, sequence)[0] < 0.015 * path_length(sequence)
    still = rigid3.center(result.cam_from_world[at : at + 61])
    scale = absolute_error(result, sequence)[1]
    assert scale * np.linalg.norm(still - still.mean(0), axis=1).max() < 0.01
    inside = (result.maps[0].keyframe_frame_idx > at + 1) & (result.maps[0].keyframe_frame_idx < at + 60)
    assert inside.sum() <= 2  # no keyframes of nothing new


@pytest.mark.parametrize("is_stereo", [False, True], ids=["mono", "stereo"])
def test_a_fast_pan_is_survived_or_an_honest_gap(is_stereo: bool) -> None:
    sequence = played.play(rendered.pan(played.room_walk(80, is_stereo), 40, 15))
    result = run(sequence)
    assert np.isfinite(result.cam_from_world[:40]).all()
    assert (np.isfinite(result.cam_from_world[:, 0]) == (result.frame_map >= 0)).all()
    assert_no_jump(result, sequence, 0.06)
    if is_stereo:
        # a pair sees depth in one look: whatever was lost is there again before long
        assert np.isfinite(result.cam_from_world[-10:]).all()


@pytest.mark.parametrize("is_stereo", [False, True], ids=["mono", "stereo"])
def test_frames_of_another_place_are_not_taken_for_this_one(is_stereo: bool) -> None:
    walk = played.room_walk(80, is_stereo)
    elsewhere = rendered.hall(70, 0, played.OPTICS, walk.rig)
    sequence = played.play(rendered.splice(walk, elsewhere, 40, 30, 40))
    result = run(sequence)
    foreign, own = result.frame_map[40:70], result.frame_map[:40]
    assert not np.isin(foreign[foreign >= 0], own[own >= 0]).any()
    assert (result.frame_map[72:] == own[-1]).all()  # back in the first map
    assert_no_jump(result, sequence, 0.05)
    assert result.report["loops"] == 0


def test_a_rotation_on_the_spot_never_makes_a_map() -> None:
    walk = played.room_walk(2)
    sequence = played.play(rendered.pan(walk, 0, 40, 30.0))
    result = run(sequence.taken(np.arange(40)))
    assert result.maps == []
    assert np.isnan(result.cam_from_world).all()
    assert (result.frame_state == FrameState.WAITING).all()


@pytest.mark.parametrize("is_stereo", [False, True], ids=["mono", "stereo"])
def test_darkness_alone_is_no_crash(is_stereo: bool) -> None:
    sequence = played.play(rendered.blackout(played.room_walk(6, is_stereo), 0, 6))
    result = run(sequence)
    assert result.maps == []
    assert np.isnan(result.cam_from_world).all()
    for count in (0, 1):
        assert len(run(sequence.taken(np.arange(count))).frame_names) == count if count else True


def test_a_cancelled_run_stops() -> None:
    from sfmapp.errors import InterruptedRunError

    sequence, events = played.room(), Events()
    events.cancel()
    with pytest.raises(InterruptedRunError):
        run_odometry(sequence, OdometryOptions(), events=events)  # type: ignore[arg-type]


# ------------------------------------------------------------------ longer and real


@pytest.mark.slow
@pytest.mark.parametrize("is_stereo", [False, True], ids=["mono", "stereo"])
def test_a_loop_closes_where_the_sequence_returns(is_stereo: bool) -> None:
    """Once round the room, 840 frames at 30 a second, every second of them, and on over the same way."""
    walk = played.whole_room_walk(900)
    sequence = played.play(replace(walk, rig=played.room_rig(is_stereo))._take(np.arange(0, 900, 2)))
    told = Told()
    result = run_odometry(sequence, OdometryOptions(), events=told.events)  # type: ignore[arg-type]
    assert result.report["loops"] >= 1
    assert any("loop" in message or "joined" in message for message in told.messages("decided"))
    assert (result.frame_map == 0).mean() > 0.9
    assert 1e-4 < absolute_error(result, sequence)[0] < 0.02 * path_length(sequence)


@pytest.mark.slow
def test_inertial_measurements_are_used_where_there_are_some() -> None:
    flight = rendered.hall(60)
    sequence = played.play(flight)
    assert sequence.imu is not None
    with_imu, without = run(sequence), run(replace(sequence, imu=None))
    assert with_imu.cam_from_world.tobytes() != without.cam_from_world.tobytes()
    for result in (with_imu, without):
        assert np.isfinite(result.cam_from_world).all()
        assert absolute_error(result, sequence)[0] < 0.02 * path_length(sequence)
        assert absolute_error(result, sequence)[1] == pytest.approx(1.0, abs=0.03)


@pytest.mark.real
@pytest.mark.slow
def test_kitti_is_followed_to_the_end(data_root: Path) -> None:
    from sfmapp.sequences.open import SequenceOptions, open_sequence

    folder = data_root / "kitti00-200"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    errors = []
    for how in (SequenceOptions(), SequenceOptions(step=2), SequenceOptions(reverse=True)):
        sequence = open_sequence(folder, how, Events())
        assert sequence.ground_truth is not None
        result = run_odometry(sequence, OdometryOptions())
        assert (result.frame_map == 0).sum() >= len(result.frame_names) - 1
        ground_truth = sequence.ground_truth.cam_from_world
        good = result.frame_map == 0
        ours = rigid3.center(result.cam_from_world[good])
        there = rigid3.center(
            ground_truth[np.searchsorted(sequence.ground_truth.timestamps_s, result.timestamps_s[good] - 1e-6)]
        )
        off = similarity.apply(similarity.umeyama(ours, there), ours) - there
        errors.append(float(np.sqrt((off**2).sum(1).mean())))
    # ORB-SLAM3: 0.717 m
    assert 0.05 < errors[0] < 0.7
    assert max(errors[1:]) < 1.5 * 0.7


@pytest.mark.real
def test_a_real_rotation_never_makes_a_map(data_root: Path) -> None:
    import json

    from sfmapp.sequences.open import SequenceOptions, open_sequence

    folder = data_root / "pano-sponza-rot"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    ground_truth = json.loads((folder / "gt.json").read_text())
    k = np.array(ground_truth["K"]) if "K" in ground_truth else np.array(ground_truth["intrinsics"])
    camera = f"PINHOLE,{k[0][0]},{k[1][1]},{k[0][2] + 0.5},{k[1][2] + 0.5}"
    sequence = open_sequence(folder / "images", SequenceOptions(camera=camera), Events())
    result = run_odometry(sequence, OdometryOptions())
    assert result.maps == []
    assert np.isnan(result.cam_from_world).all()
