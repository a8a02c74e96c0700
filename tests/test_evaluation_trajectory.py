"""Errors of trajectories: cases computed by hand, axioms, and evo's numbers on the same files."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sfmapp.errors import InputError, UsageError
from sfmapp.evaluation.trajectory import (
    Pairs,
    Trajectory,
    absolute_error,
    align,
    associate,
    kitti_drift,
    path_shares_m,
    relative_error,
    statistics,
)
from sfmapp.formats.trajectory_input import read_trajectory
from sfmapp.geometry import rigid3, similarity

Array = NDArray[np.float64]


def straight(x: list[float], times: list[float] | None = None, turn_deg: float = 0.0) -> Trajectory:
    """Along x, turned about z by so many degrees more at each pose."""
    position = np.zeros((len(x), 3))
    position[:, 0] = x
    turn = np.zeros((len(x), 3))
    turn[:, 2] = np.radians(turn_deg) * np.arange(len(x))
    return Trajectory(position, rigid3.exp_so3(turn), None if times is None else np.array(times, np.float64))


def walk(seed: int, count: int = 60) -> Trajectory:
    """A random walk that bends, ten poses a second."""
    rng = np.random.default_rng(seed)
    rotation = rigid3.exp_so3(np.cumsum(rng.normal(0, 0.1, (count, 3)), 0))
    position = np.cumsum(rotation[:, :, 2] + rng.normal(0, 0.2, (count, 3)), 0)
    return Trajectory(position, rotation, np.arange(count) / 10)


def shaken(ground_truth: Trajectory, seed: int, sigma: float = 0.1) -> Trajectory:
    rng = np.random.default_rng([seed, 1])
    turn = rigid3.exp_so3(rng.normal(0, sigma / 10, (len(ground_truth), 3)))
    return Trajectory(
        ground_truth.position + rng.normal(0, sigma, ground_truth.position.shape),
        ground_truth.rotation @ turn,
        ground_truth.timestamps_s,
    )


def moved(trajectory: Trajectory, rotation_vector: Array, translation: Array, scale: float = 1.0) -> Trajectory:
    """The same in another world."""
    rotation = rigid3.exp_so3(rotation_vector)
    position = scale * trajectory.position @ rotation.T + translation
    return Trajectory(position, rotation @ trajectory.rotation, trajectory.timestamps_s)


vectors = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


# --------------------------------------------------------------------------------------------------------- association


@pytest.mark.parametrize(
    ("ours", "theirs", "expected"),
    [
        ([0.0, 1, 2], [0.004, 1.0, 2.0, 3.0], [(0, 0), (1, 1), (2, 2)]),
        ([0.004], [0.0, 0.005, 0.01, 1.0], [(0, 1)]),  # the nearest
        ([0.005], [0.0, 0.01, 1.0], [(0, 0)]),  # the earlier of two
        ([0.0, 0.006, 1.0], [0.003, 1.0, 5.0, 6.0], [(0, 0), (1, 0), (2, 1)]),  # one serves twice
        ([0.003, 1.0, 5.0, 6.0, 7.0], [0.0, 0.006, 1.0], [(0, 0), (0, 1), (1, 2)]),  # the fewer are the true ones
        ([0.0, 0.002, 1.0, 2.0], [0.001, 1.0, 2.0, 3.0], [(0, 0), (1, 0), (2, 1), (3, 2)]),  # as many: of the estimate
        ([0.0, 1.0201], [0.009, 1.01], [(0, 0)]),  # too far
        ([2.0, 0.0, 1.0], [0.0, 1.0, 2.0], [(1, 0), (2, 1), (0, 2)]),  # in the order of time
    ],
)
def test_association(ours: list[float], theirs: list[float], expected: list[tuple[int, int]]) -> None:
    pairs = associate(straight(ours, ours), straight(theirs, theirs))
    assert list(zip(pairs.estimate_idx.tolist(), pairs.ground_truth_idx.tolist(), strict=True)) == expected


def test_the_offset_is_added_to_the_estimate() -> None:
    ours, theirs = straight([0, 1, 2], [10, 11, 12]), straight([0, 1, 2], [0, 1, 2])
    pairs = associate(ours, theirs, offset_s=-10)
    assert pairs.estimate_idx.tolist() == [0, 1, 2]
    with pytest.raises(InputError, match=r"within 0\.01 s") as caught:
        associate(ours, theirs)
    assert "--offset" in str(caught.value.advice)


@pytest.mark.parametrize("scale", [1e9, 1e6])
def test_another_unit_of_time_is_suspected(scale: float) -> None:
    with pytest.raises(InputError) as caught:
        associate(straight([0, 1], [1e6 * scale, 1e6 * scale + 1]), straight([0, 1], [1e6, 1e6 + 1]))
    assert "unit" in str(caught.value.advice)


def test_without_timestamps_equal_numbers_are_pairs() -> None:
    ours = straight([0, np.nan, 2, 3])
    pairs = associate(ours, straight([0, 1, 2, 3]))
    assert pairs.estimate_idx.tolist() == pairs.ground_truth_idx.tolist() == [0, 2, 3]
    assert pairs.coverage == 0.75
    assert pairs.is_gap.tolist() == [False, True, False]
    with pytest.raises(InputError, match="found 4 and 3"):
        associate(ours, straight([0, 1, 2]))
    with pytest.raises(InputError, match="the estimate has no timestamps"):
        associate(ours, straight([0, 1], [0, 1]))


def test_coverage_is_of_the_time_of_the_ground_truth() -> None:
    ground_truth = straight(list(range(1001)), [k / 100 for k in range(1001)])  # ten seconds, a hundred a second
    times = np.arange(0, 101) / 10
    for kept, expected, gaps in (
        (times, 1.0, 0),
        (times[:51], 0.505, 0),  # the last pose stands for half a step more
        (times[25:76], 0.51, 0),
        (times[::2], 1.0, 0),  # every second frame played
        (np.delete(times, [50]), 1.0, 0),  # one frame lost is no gap
        (np.delete(times, np.s_[30:70]), 0.6, 1),  # 4.1 s, of which a step counts
    ):
        pairs = associate(straight([0.0] * len(kept), kept.tolist()), ground_truth)
        assert pairs.coverage == pytest.approx(expected, abs=1e-9), len(kept)
        assert pairs.is_gap.sum() == gaps


def test_poses_that_are_not_there_are_no_pairs() -> None:
    times = [0.0, 1.0, 2.0, 3.0]
    pairs = associate(straight([0, 1, np.nan, 3], times), straight([np.nan, 1, 2, 3], times))
    assert pairs.estimate_idx.tolist() == [1, 3]
    assert (pairs.num_estimate, pairs.num_ground_truth) == (3, 3)


# ------------------------------------------------------------------------------------------------------ absolute error


def test_absolute_error_by_hand() -> None:
    ground_truth = Trajectory(np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]), np.tile(np.eye(3), (4, 1, 1)))
    ours = Trajectory(
        ground_truth.position + np.array([0, 0, 5.0]), rigid3.exp_so3(np.tile([0, 0, np.radians(30)], (4, 1)))
    )
    pairs = associate(ours, ground_truth)
    bare = absolute_error(pairs, "none")
    assert bare.translation_m == pytest.approx([5] * 4)
    assert bare.rotation_deg == pytest.approx([30] * 4)
    rigid = absolute_error(pairs, "se3")
    assert rigid.translation_m == pytest.approx([0] * 4, abs=1e-12)
    assert rigid.rotation_deg == pytest.approx([30] * 4)
    # the first pose on the true one: turned back by 30 degrees about z, the corners move on circles
    first = absolute_error(pairs, "origin")
    chord = 2 * np.sin(np.radians(15))
    assert first.translation_m == pytest.approx([0, 2 * chord, np.sqrt(8) * chord, 2 * chord])
    assert first.rotation_deg == pytest.approx([0] * 4, abs=1e-9)


def test_a_square_that_is_too_small() -> None:
    square = np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    pairs = associate(
        Trajectory(0.5 * square, np.tile(np.eye(3), (4, 1, 1))), Trajectory(square, np.tile(np.eye(3), (4, 1, 1)))
    )
    assert absolute_error(pairs, "sim3").scale == pytest.approx(2)
    assert statistics(absolute_error(pairs, "sim3").translation_m)["max"] == pytest.approx(0, abs=1e-12)  # type: ignore[index]
    assert absolute_error(pairs, "se3").translation_m == pytest.approx([np.sqrt(0.5)] * 4)


def test_statistics_by_hand() -> None:
    values = statistics([1.0, 2.0, 2.0, 7.0])
    assert values == pytest.approx(
        {"rmse": np.sqrt(14.5), "mean": 3.0, "median": 2.0, "std": np.sqrt(5.5), "min": 1.0, "max": 7.0}
    )
    assert statistics([]) is None


@given(st.integers(0, 1000), vectors, vectors, st.floats(0.05, 20))
def test_sim3_does_not_see_a_similarity(seed: int, turn: Array, shift: Array, scale: float) -> None:
    ground_truth = walk(seed)
    ours = shaken(ground_truth, seed)
    before = absolute_error(associate(ours, ground_truth), "sim3")
    after = absolute_error(associate(moved(ours, turn, shift, scale), ground_truth), "sim3")
    assert after.translation_m == pytest.approx(before.translation_m, abs=1e-9)
    assert after.rotation_deg == pytest.approx(before.rotation_deg, abs=1e-8)
    assert after.scale * scale == pytest.approx(before.scale)


@given(st.integers(0, 1000), vectors, vectors)
def test_se3_does_not_see_a_motion_and_is_the_best(seed: int, turn: Array, shift: Array) -> None:
    ground_truth = walk(seed)
    ours = shaken(ground_truth, seed)
    best = absolute_error(associate(ours, ground_truth), "se3")
    pairs = associate(moved(ours, turn, shift), ground_truth)
    after = absolute_error(pairs, "se3")
    assert after.translation_m == pytest.approx(best.translation_m, abs=1e-9)
    assert (best.translation_m**2).sum() <= (absolute_error(pairs, "none").translation_m ** 2).sum() + 1e-9
    scaled = absolute_error(pairs, "sim3")
    assert (scaled.translation_m**2).sum() <= (best.translation_m**2).sum() + 1e-9


def test_a_straight_line_is_closed_by_the_orientations() -> None:
    ground_truth = straight([0, 1, 2, 3, 4])
    ours = moved(ground_truth, np.array([0.3, -0.7, 1.1]), np.array([1.0, 2, 3]), 0.5)
    error = absolute_error(associate(ours, ground_truth), "sim3")
    assert error.translation_m == pytest.approx([0] * 5, abs=1e-9)
    assert error.rotation_deg == pytest.approx([0] * 5, abs=1e-6)


def test_one_place_determines_no_alignment() -> None:
    pairs = associate(straight([1, 1, 1, 1]), straight([0, 1, 2, 3]))
    for how in ("se3", "sim3"):
        with pytest.raises(InputError, match="do not determine") as caught:
            absolute_error(pairs, how)  # type: ignore[arg-type]
        assert caught.value.advice == "--align origin"
    assert absolute_error(pairs, "origin").translation_m == pytest.approx([0, 1, 2, 3])


def test_noise_comes_out_as_it_went_in() -> None:
    ground_truth = walk(3, 2000)
    error = absolute_error(associate(shaken(ground_truth, 3, 0.1), ground_truth), "se3")
    # three axes of 0.1 m; sixteen thousand numbers tell the rmse to one percent
    assert np.sqrt((error.translation_m**2).mean()) == pytest.approx(0.1 * np.sqrt(3), rel=0.03)
    assert np.sqrt((error.rotation_deg**2).mean()) == pytest.approx(np.degrees(0.01) * np.sqrt(3), rel=0.05)


def test_poses_of_the_house_are_taken_as_they_are() -> None:
    ground_truth = walk(5)
    world_from_cam = rigid3.from_matrix(ground_truth.rotation, ground_truth.position)
    same = Trajectory.from_cam_from_world(rigid3.inverse(world_from_cam), ground_truth.timestamps_s)
    assert same.position == pytest.approx(ground_truth.position)
    assert same.rotation == pytest.approx(ground_truth.rotation)
    assert align(associate(same, ground_truth), "sim3") == pytest.approx(similarity.IDENTITY, abs=1e-9)


# ------------------------------------------------------------------------------------------------------ relative error


def pairs_of(x: list[float], factor: float, times: list[float] | None = None, turn_deg: float = 0.0) -> Pairs:
    """True positions along a line, the estimate too long by a factor and turning by so much a frame."""
    return associate(straight([factor * v for v in x], times, turn_deg), straight(x, times))


def test_relative_error_in_frames_by_hand() -> None:
    pairs = pairs_of([0, 1, 2, 3, 4, 5, 6, 7], 1.0, turn_deg=2.0)
    one = relative_error(pairs, 1)
    assert one.last.tolist() == [1, 2, 3, 4, 5, 6, 7]
    assert one.rotation_deg == pytest.approx([2] * 7)
    three = relative_error(pairs, 3)
    assert list(zip(three.first.tolist(), three.last.tolist(), strict=True)) == [(0, 3), (3, 6)]
    assert three.rotation_deg == pytest.approx([6, 6])
    assert relative_error(pairs, 3, is_overlapping=True).last.tolist() == [3, 4, 5, 6, 7]
    longer = relative_error(pairs_of([0, 1, 2, 3], 1.1), 2, is_overlapping=True)
    assert longer.translation_m == pytest.approx([0.2, 0.2])
    assert relative_error(pairs_of([0, 1, 2, 3], 1.1), scale=1 / 1.1).translation_m == pytest.approx([0] * 3)


def test_relative_error_in_metres_by_hand() -> None:
    pairs = pairs_of([0, 0.3, 0.9, 1.0, 1.5, 2.2, 3.0, 3.05, 4.2], 1.2)
    # a motion ends at the first pose that is a metre on
    assert relative_error(pairs, 1, "m").last.tolist() == [3, 5, 8]
    assert relative_error(pairs, 1, "m").translation_m == pytest.approx([0.2, 0.24, 0.4])
    assert relative_error(pairs, 1, "m", is_by_estimate=True).last.tolist() == [2, 5, 7, 8]
    # overlapping ones are a metre long to a tenth
    assert relative_error(pairs, 1, "m", is_overlapping=True).last.tolist() == [3]
    assert relative_error(pairs, 2, "m", is_overlapping=True).last.tolist() == [5, 6, 6, 8]


def test_relative_error_in_seconds_by_hand() -> None:
    times = [0.0, 0.5, 1.0, 1.5, 2.0, 4.0, 4.5, 5.0]  # a gap of two seconds
    pairs = pairs_of([0, 1, 2, 3, 4, 8, 9, 10], 1.1, times)
    second = relative_error(pairs, 1, "s")
    assert list(zip(second.first.tolist(), second.last.tolist(), strict=True)) == [(0, 2), (2, 4), (5, 7)]
    assert second.translation_m == pytest.approx([0.2] * 3)
    assert relative_error(pairs, 1, "s", is_overlapping=True).first.tolist() == [0, 1, 2, 5]
    with pytest.raises(UsageError, match="needs timestamps"):
        relative_error(pairs_of([0, 1, 2], 1), 1, "s")


@pytest.mark.parametrize(("delta", "unit"), [(0.0, "m"), (-1.0, "s"), (1.5, "frames"), (np.nan, "m"), (np.inf, "m")])
def test_deltas_that_are_none(delta: float, unit: str) -> None:
    with pytest.raises(UsageError, match="positive"):
        relative_error(pairs_of([0, 1, 2], 1, [0, 1, 2]), delta, unit)  # type: ignore[arg-type]


def test_a_delta_beyond_the_path() -> None:
    with pytest.raises(InputError, match="3 poses over 2 m are 5 m apart"):
        relative_error(pairs_of([0, 1, 2], 1), 5, "m")
    with pytest.raises(InputError, match="9 frames apart"):
        relative_error(pairs_of([0, 1, 2], 1), 9)


@given(st.integers(0, 1000), vectors, vectors, vectors, vectors)
def test_relative_errors_do_not_see_a_motion(seed: int, turn: Array, shift: Array, other: Array, way: Array) -> None:
    ground_truth = walk(seed)
    ours = shaken(ground_truth, seed)
    before, after = associate(ours, ground_truth), associate(moved(ours, turn, shift), moved(ground_truth, other, way))
    for delta, unit in ((1, "frames"), (0.5, "s"), (5, "m")):
        a, b = (relative_error(pairs, delta, unit) for pairs in (before, after))  # type: ignore[arg-type]
        assert b.first.tolist() == a.first.tolist()
        assert b.translation_m == pytest.approx(a.translation_m, abs=1e-9)
        assert b.rotation_deg == pytest.approx(a.rotation_deg, abs=1e-6)
    lengths = path_shares_m(before)
    a, b = (kitti_drift(pairs, lengths_m=lengths, step=1) for pairs in (before, after))  # type: ignore[assignment]
    assert b.t_rel_percent == pytest.approx(a.t_rel_percent, abs=1e-9)  # type: ignore[attr-defined]


# --------------------------------------------------------------------------------------------------------------- drift


def test_drift_by_hand() -> None:
    # 1,001 m straight on, a pose each metre, 3 % too long, turning by 0.01 degrees a metre
    drift = kitti_drift(pairs_of([float(k) for k in range(1001)], 1.03))
    assert drift.first.tolist() == sorted(drift.first.tolist())
    # a stretch ends at the first pose beyond its length: 101 m count as 100
    chosen = drift.length_m == 100
    assert chosen.sum() == 90  # beginnings 0, 10, ..., 890: 899 + 101 = 1000 is the last pose
    assert drift.translation[chosen] == pytest.approx([0.03 * 101 / 100] * 90)
    assert drift.t_rel_percent == pytest.approx(100 * (0.03 * (drift.length_m + 1) / drift.length_m).mean())
    turning = kitti_drift(pairs_of([float(k) for k in range(1001)], 1.0, turn_deg=0.01))
    assert turning.r_rel_deg_per_m == pytest.approx((0.01 * (turning.length_m + 1) / turning.length_m).mean())


def naive_drift(ground_truth: Trajectory, ours: Trajectory) -> tuple[float, float]:
    """The definition, pose by pose with 4 x 4 matrices; percent and degrees a metre."""

    def matrix(trajectory: Trajectory, k: int) -> Array:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = trajectory.rotation[k], trajectory.position[k]
        return pose

    way = [0.0]
    for k in range(1, len(ground_truth)):
        way.append(way[-1] + float(np.linalg.norm(ground_truth.position[k] - ground_truth.position[k - 1])))
    errors = []
    for first in range(0, len(ground_truth), 10):
        for length in (100, 200, 300, 400, 500, 600, 700, 800):
            last = next((k for k in range(first, len(ground_truth)) if way[k] > way[first] + length), None)
            if last is None:
                continue
            true, found = (np.linalg.inv(matrix(t, first)) @ matrix(t, last) for t in (ground_truth, ours))
            error = np.linalg.inv(found) @ true
            angle = np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))
            errors.append((np.linalg.norm(error[:3, 3]) / length, np.degrees(angle) / length))
    translation, rotation = np.mean(errors, axis=0)
    return 100 * translation, rotation


def test_drift_is_that_of_the_definition() -> None:
    ground_truth = walk(7, 700)
    ours = shaken(ground_truth, 7, 0.3)
    drift = kitti_drift(associate(ours, ground_truth))
    assert (drift.t_rel_percent, drift.r_rel_deg_per_m) == pytest.approx(naive_drift(ground_truth, ours), rel=1e-6)


def test_a_short_path_has_no_stretch() -> None:
    pairs = pairs_of([float(k) for k in range(50)], 1.02)
    assert len(kitti_drift(pairs).first) == 0
    assert np.isnan(kitti_drift(pairs).t_rel_percent)
    assert path_shares_m(pairs) == pytest.approx([4.9 * k for k in range(1, 9)])
    by_share = kitti_drift(pairs, lengths_m=path_shares_m(pairs), step=1)
    assert 2.0 < by_share.t_rel_percent < 2.4  # up to one metre more than the nominal length


# ----------------------------------------------------------------------------------------------------------------- evo


def write_case(folder: Path) -> tuple[Path, Path]:
    """A true trajectory of 400 poses and an estimate of 250 of them with another scale, world, clock and noise."""
    rng = np.random.default_rng(2024)
    rotation = rigid3.exp_so3(np.cumsum(rng.normal(0, 0.03, (400, 3)), 0))
    position = np.cumsum(0.4 * rotation[:, :, 2] + rng.normal(0, 0.02, (400, 3)), 0)
    kept = np.sort(rng.permutation(400)[:250])
    turn = rigid3.exp_so3(np.array([0.4, -1.2, 0.8]))
    noise = np.cumsum(rng.normal(0, 0.02, (400, 3)), 0)
    ours = 0.31 * (position + noise)[kept] @ turn.T + [3.0, -2.0, 7.0]
    our_rotation = turn @ (rotation @ rigid3.exp_so3(rng.normal(0, 0.01, (400, 3))))[kept]
    times = 1.4e9 + np.arange(400) * 0.05
    our_times = times[kept] + rng.uniform(-0.012, 0.012, 250)  # some are too far from all true ones
    paths = folder / "estimate.tum", folder / "ground_truth.tum"
    for path, t, p, r in zip(paths, (our_times, times), (ours, position), (our_rotation, rotation), strict=True):
        table = np.concatenate([p, rigid3.quaternion(r)], 1)
        path.write_text(
            "\n".join(f"{a:.6f} " + " ".join(f"{v:.9f}" for v in row) for a, row in zip(t, table, strict=True))
        )
    return paths


# What evo 1.38.1 (evo_ape and evo_rpe) printed for write_case: computed once with evo, which is not part of this
# project. Rmse, mean, median, standard deviation, least, largest.
EVO_PAIRS = 205
EVO: dict[str, tuple[float, ...]] = {
    "ape none": (66.149241286, 58.178738430, 60.304419365, 31.479461835, 3.856960602, 112.794452223),
    "ape se3": (30.103888154, 26.497282914, 26.458394906, 14.287689811, 3.127502914, 51.677294836),
    "ape sim3": (0.153422391, 0.146030746, 0.147710992, 0.047047328, 0.015283737, 0.256930487),
    "ape origin": (59.809813717, 52.352035057, 53.663831188, 28.921933584, 0.000000000, 101.472917487),
    "ape sim3 angle": (1.127118090, 1.038204913, 0.986727791, 0.438777560, 0.183107453, 2.328548513),
    "rpe 1 frames": (0.651023365, 0.531215769, 0.298932492, 0.376352534, 0.243795448, 2.495635346),
    "rpe 1 frames angle": (1.376617658, 1.277286627, 1.254816849, 0.513434561, 0.101382417, 2.586674744),
    "rpe 7 frames overlapping sim3": (0.143944458, 0.131950600, 0.123325191, 0.057524309, 0.025899739, 0.325529128),
    "rpe 2.5 m": (2.190517538, 2.152431123, 1.947264987, 0.406703017, 1.786140783, 3.840241721),
    "rpe 2.5 m overlapping": (1.681849586, 1.679616092, 1.651486914, 0.086647646, 1.558383883, 1.903610287),
    "rpe 2.5 m sim3 estimate": (0.108754377, 0.100499653, 0.092940376, 0.041561209, 0.032292035, 0.213414546),
    "rpe 2.5 m sim3 estimate angle": (1.310674698, 1.202832499, 1.131054502, 0.520636287, 0.161971783, 2.670119924),
}


# the arguments of evo's programs beside those of our functions
EVO_CASES = {
    "ape none": ("evo_ape", []),
    "ape se3": ("evo_ape", ["-a"]),
    "ape sim3": ("evo_ape", ["-as"]),
    "ape origin": ("evo_ape", ["--align_origin"]),
    "ape sim3 angle": ("evo_ape", ["-as", "-r", "angle_deg"]),
    "rpe 1 frames": ("evo_rpe", []),
    "rpe 1 frames angle": ("evo_rpe", ["-r", "angle_deg"]),
    "rpe 7 frames overlapping sim3": ("evo_rpe", ["-as", "-d", "7", "--all_pairs"]),
    "rpe 2.5 m": ("evo_rpe", ["-d", "2.5", "-u", "m", "--pairs_from_reference"]),
    "rpe 2.5 m overlapping": ("evo_rpe", ["-d", "2.5", "-u", "m", "--all_pairs", "--pairs_from_reference"]),
    "rpe 2.5 m sim3 estimate": ("evo_rpe", ["-as", "-d", "2.5", "-u", "m"]),
    "rpe 2.5 m sim3 estimate angle": ("evo_rpe", ["-as", "-d", "2.5", "-u", "m", "-r", "angle_deg"]),
}


def ours_for(name: str, pairs: Pairs) -> list[float]:
    """Our statistics of a case."""
    words = name.split()
    how = next((word for word in ("none", "se3", "sim3", "origin") if word in words), "none")
    absolute = absolute_error(pairs, how)  # type: ignore[arg-type]
    if words[0] == "ape":
        error: Array = absolute.rotation_deg if "angle" in words else absolute.translation_m
    else:
        relative = relative_error(
            pairs, float(words[1]), words[2], scale=absolute.scale,  # type: ignore[arg-type]
            is_overlapping="overlapping" in words, is_by_estimate="estimate" in words,
        )  # fmt: skip
        error = relative.rotation_deg if "angle" in words else relative.translation_m
    numbers = statistics(error)
    assert numbers is not None
    return [numbers[key] for key in ("rmse", "mean", "median", "std", "min", "max")]


def read_case(folder: Path) -> Pairs:
    estimate, ground_truth = (read_trajectory(path).trajectory for path in write_case(folder))
    return associate(estimate, ground_truth)


@pytest.mark.parametrize("name", EVO_CASES)
def test_equal_to_evo_as_recorded(tmp_path: Path, name: str) -> None:
    pairs = read_case(tmp_path)
    assert len(pairs) == EVO_PAIRS
    assert ours_for(name, pairs) == pytest.approx(EVO[name], abs=1e-6)


@pytest.mark.parametrize("name", ["ape sim3", "rpe 2.5 m"])
def test_equal_to_evo_where_it_is_installed(tmp_path: Path, name: str) -> None:
    program, arguments = EVO_CASES[name]
    found = shutil.which(program, path=os.environ.get("SFMAPP_EVO"))
    if found is None:
        pytest.skip(f"{program} is not installed; SFMAPP_EVO names the folder of evo's programs")
    assert ours_for(name, read_case(tmp_path)) == pytest.approx(run_evo(found, arguments, tmp_path), abs=1e-6)


def run_evo(program: str, arguments: list[str], folder: Path) -> list[float]:
    """Statistics as evo's program saves them."""
    saved = folder / "evo.zip"
    files = [str(folder / "ground_truth.tum"), str(folder / "estimate.tum")]
    command = [program, "tum", *files, *arguments, "--save_results", str(saved), "--silent", "--no_warnings"]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "HOME": str(folder)})
    with zipfile.ZipFile(saved) as results:
        numbers = json.loads(results.read("stats.json"))
    return [numbers[key] for key in ("rmse", "mean", "median", "std", "min", "max")]
