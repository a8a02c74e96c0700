"""Focal lengths from F, from turns and from vanishing points, and the motions that tell nothing."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.geometry import epipolar, rigid3
from sfmapp.geometry.fundamental import eight_point
from sfmapp.geometry.self_calibration import (
    combine_focals,
    focal_from_fundamental,
    focal_from_homographies,
    focal_from_vanishing_points,
    focals_from_fundamental,
    focals_from_matches,
    refine_turning_camera,
)

CENTER1, CENTER2, SIZE = np.array([320.0, 240.0]), np.array([310.0, 250.0]), 640.0


def k_matrix(focal: float, center: np.ndarray = CENTER1) -> np.ndarray:
    return np.array([[focal, 0.0, center[0]], [0.0, focal, center[1]], [0.0, 0.0, 1.0]])


def fundamental(focal1: float, focal2: float, turn: list[float], shift: list[float]) -> np.ndarray:
    pose = rigid3.from_matrix(rigid3.exp_so3(np.array(turn)), np.array(shift))
    essential = epipolar.essential_from_pose(pose)
    return epipolar.fundamental_from_essential(essential, k_matrix(focal1), k_matrix(focal2, CENTER2))


def test_focal_lengths_of_two_cameras_from_f() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        f1, f2 = rng.uniform(300, 1500, 2)
        f = fundamental(f1, f2, rng.uniform(-0.5, 0.5, 3).tolist(), rng.uniform(-1, 1, 3).tolist())
        assert focals_from_fundamental(f, CENTER1, CENTER2) == pytest.approx((f1, f2), rel=1e-6)
        f = fundamental(f1, f1, rng.uniform(-0.5, 0.5, 3).tolist(), rng.uniform(-1, 1, 3).tolist())
        found = focal_from_fundamental(f, CENTER1, CENTER2, SIZE)
        assert found is not None
        assert found[0] == pytest.approx(f1, rel=1e-6)
        assert found[1] < 1e-6


def test_motions_from_which_f_tells_no_focal_length() -> None:
    sideways = fundamental(500.0, 700.0, [0.0, 0.0, 0.0], [1.0, 0.2, 0.1])
    assert focals_from_fundamental(sideways, CENTER1, CENTER2) is None
    assert focal_from_fundamental(fundamental(600.0, 600.0, [0, 0, 0], [1.0, 0.2, 0.1]), CENTER1, CENTER2, SIZE) is None
    # both axes meet in (0, 0, 4), at the same distance
    turn = rigid3.exp_so3(np.array([0.0, 0.5, 0.0]))
    shift = (np.array([0.0, 0.0, 4.0]) - turn @ [0.0, 0.0, 4.0]).tolist()
    table = fundamental(600.0, 600.0, [0.0, 0.5, 0.0], shift)
    assert focal_from_fundamental(table, CENTER1, CENTER2, SIZE) is None
    assert focals_from_fundamental(table, CENTER1, CENTER2) is None
    # they meet at other distances: two cameras of their own cannot be told, one that is shared can
    shift = (np.array([0.0, 0.0, 6.0]) - turn @ [0.0, 0.0, 4.0]).tolist()
    apart = fundamental(600.0, 600.0, [0.0, 0.5, 0.0], shift)
    assert focals_from_fundamental(apart, CENTER1, CENTER2) is None
    found = focal_from_fundamental(apart, CENTER1, CENTER2, SIZE)
    assert found is not None
    assert found[0] == pytest.approx(600.0, rel=1e-5)


def test_focal_length_of_a_camera_that_turns() -> None:
    k = k_matrix(520.0)
    turns = [rigid3.exp_so3(np.array(w)) for w in ([0.0, 0.3, 0.0], [0.2, 0.0, 0.1])]
    found = focal_from_homographies([3.3 * k @ turn @ np.linalg.inv(k) for turn in turns], CENTER1)
    assert found == pytest.approx(520.0, rel=1e-9)
    roll = k @ rigid3.exp_so3(np.array([0.0, 0.0, 0.3])) @ np.linalg.inv(k)
    assert focal_from_homographies([roll], CENTER1) is None
    assert focal_from_homographies([np.eye(3)], CENTER1) is None


def test_the_sigma_of_a_turning_camera_is_right() -> None:
    rng = np.random.default_rng(0)
    z = []
    for _ in range(60):
        matches = []
        for w in ([0.0, 0.3, 0.0], [0.2, 0.0, 0.1]):
            xy = rng.uniform(0, [640, 480], (150, 2))
            mapped = np.column_stack([(xy - CENTER1) / 520.0, np.ones(150)]) @ rigid3.exp_so3(np.array(w)).T
            seen = 520.0 * mapped[:, :2] / mapped[:, 2:] + CENTER1 + 0.5 * rng.standard_normal((150, 2))
            seen[:8] += rng.uniform(-50, 50, (8, 2))
            matches.append((xy, seen))
        found = refine_turning_camera(400.0, CENTER1, matches)
        z.append((found.focal - 520.0) / found.sigma)
    assert abs(np.mean(z)) < 0.4
    # wrong matches, which are held for noise in part, make it a little wide
    assert 0.6 < np.std(z) < 1.25


def test_focal_length_from_vanishing_points() -> None:
    directions = rigid3.exp_so3(np.array([0.3, 0.5, -0.2]))
    points = directions * [700.0, 700.0, 1.0]
    found = focal_from_vanishing_points(points, np.roll(points, 1, axis=0))
    assert found == pytest.approx(700.0)
    # one at infinity, and a pair that no focal length brings to a right angle
    first, second = np.array([[1.0, 0.0, 0.0], [5.0, 5.0, 1.0]]), np.array([[0.0, 5.0, 1.0], [9.0, 9.0, 1.0]])
    assert np.isnan(focal_from_vanishing_points(first, second)).all()


def matches(rng: np.random.Generator, focals: tuple[float, float], pose: np.ndarray, num: int = 200) -> tuple:
    """Pixels of points 3 to 9 away, in both pictures."""
    xyz = rng.uniform([-3, -2, 3], [3, 2, 9], (num, 3))
    there = rigid3.apply(pose, xyz)
    return tuple(f * p[:, :2] / p[:, 2:] + CENTER1 for f, p in zip(focals, (xyz, there), strict=True))


@pytest.mark.parametrize("is_shared", [True, False])
def test_the_sigmas_of_focal_lengths_from_matches_are_right(is_shared: bool) -> None:
    rng = np.random.default_rng(3)
    z = []
    for trial in range(60):
        f1, f2 = rng.uniform(400, 900, 2)
        focals = (f1, f1) if is_shared else (f1, f2)
        turn, shift = rng.uniform(-0.4, 0.4, 3), rng.uniform(-1.5, 1.5, 3) * [1, 1, 0.5]
        xy1, xy2 = matches(rng, focals, rigid3.from_matrix(rigid3.exp_so3(turn), shift))
        xy1 = xy1 + 0.4 * rng.standard_normal(xy1.shape)
        xy2 = xy2 + 0.4 * rng.standard_normal(xy2.shape)
        start, num_wrong = eight_point(xy1, xy2)[0], 20 * (trial % 2)
        xy2[:num_wrong] += rng.uniform(-60, 60, (num_wrong, 2))
        found = focals_from_matches(
            xy1, xy2, CENTER1, CENTER1, SIZE, is_shared=is_shared, fundamental=start
        )  # fmt: skip
        if found is None:
            continue
        assert found.noise_px == pytest.approx(0.4, rel=0.3)
        z.append(np.log(found.focals / focals[: len(found.focals)]) / np.sqrt(np.diag(found.covariance)))
    assert len(z) > 54
    assert (np.abs(z) < 3.5).all()
    assert 0.8 < np.std(z) < 1.2


def test_matches_of_motions_that_tell_no_focal_length_tell_none() -> None:
    rng = np.random.default_rng(4)
    turn = rigid3.exp_so3(np.array([0.0, 0.4, 0.0]))
    middle = np.array([0.0, 0.0, 6.0])
    for pose in (
        rigid3.from_matrix(np.eye(3), np.array([1.0, 0.2, 0.1])),  # it did not turn
        rigid3.from_matrix(turn, middle - turn @ middle),  # a turntable
    ):
        for _ in range(5):
            xy1, xy2 = matches(rng, (600.0, 600.0), pose)
            noisy = [xy + 0.5 * rng.standard_normal(xy.shape) for xy in (xy1, xy2)]
            found = focals_from_matches(noisy[0], noisy[1], CENTER1, CENTER1, SIZE)
            assert found is None or found.sigmas[0] > 0.04 * found.focals[0]
    # a camera that only turned leaves F open; what is told all the same is of the turn, and right
    for _ in range(5):
        xy1, xy2 = matches(rng, (600.0, 600.0), rigid3.from_matrix(turn, np.zeros(3)))
        noisy = [xy + 0.5 * rng.standard_normal(xy.shape) for xy in (xy1, xy2)]
        found = focals_from_matches(noisy[0], noisy[1], CENTER1, CENTER1, SIZE)
        assert found is None or abs(found.focals[0] - 600.0) < 4.0 * found.sigmas[0]


def test_pairs_of_one_camera_tell_more_together() -> None:
    rng = np.random.default_rng(5)
    told = []
    for _ in range(12):
        turn, shift = rng.uniform(-0.4, 0.4, 3), rng.uniform(-1.5, 1.5, 3)
        pair = matches(rng, (600.0, 600.0), rigid3.from_matrix(rigid3.exp_so3(turn), shift))
        noisy = [xy + 0.5 * rng.standard_normal(xy.shape) for xy in pair]
        found = focals_from_matches(noisy[0], noisy[1], CENTER1, CENTER1, SIZE)
        told += [] if found is None else [found]
    together = combine_focals(told)
    assert together is not None
    assert together.num_pairs >= 10
    assert abs(together.focal - 600.0) < 3.0 * together.sigma
    assert together.sigma < min(one.sigmas[0] for one in told) * 1.1
    assert combine_focals([]) is None
