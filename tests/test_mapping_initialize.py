"""The pair that a model starts from: ranked by what it shows, refused by name, and placed as it was seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import epipolar, rigid3
from sfmapp.geometry.fundamental import fundamental_from_points
from sfmapp.geometry.relative_pose import refine_relative_pose
from sfmapp.geometry.turned_views import turn_at_focal
from sfmapp.mapping.initialize import (
    ENOUGH_ANGLE_DEG,
    InitialPair,
    initialize_from_pair,
    rank_initial_pairs,
    single_places,
)
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.tracks import build_tracks
from sfmapp.matching.search import Ransac, best_relative_pose, essentials_of_samples, relative_pose_at_noise
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig
from sfmapp.scene.features import Features
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_scene, true_correspondences

Array = NDArray[np.float64]

SCENE = make_scene(7, 6, 900, sigma_px=0.3)


def ranked(config: dict[int, TwoViewConfig] | None = None, free: list[int] | None = None) -> list[InitialPair]:
    found = true_correspondences(SCENE)
    for pair, kind in (config or {}).items():
        found.config[pair] = kind
    is_free = np.ones(6, bool) if free is None else np.isin(np.arange(6), free)
    return rank_initial_pairs(SCENE.observed, found, is_free, MappingOptions())


def test_the_best_pair_has_many_points_under_wide_angles_and_the_true_pose() -> None:
    pairs, truth = ranked(), SCENE.ground_truth
    scores = [pair.score for pair in pairs]
    assert scores == sorted(scores, reverse=True)
    best = pairs[0]
    assert best.num_points > 0.9 * best.num_matches
    assert best.shortfall(100, 8.0) == ""
    i, j = best.image_idx
    expected = rigid3.compose(truth.cam_from_world[j], rigid3.inverse(truth.cam_from_world[i]))
    turn = rigid3.compose(best.cam2_from_cam1, rigid3.inverse(expected))
    assert rigid3.rotation_angle_deg(rigid3.rotation_matrix(turn)) < 0.1
    cosine = best.cam2_from_cam1[4:] @ expected[4:] / np.linalg.norm(expected[4:])
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 0.5
    assert np.linalg.norm(best.cam2_from_cam1[4:]) == pytest.approx(1.0)


def test_only_free_images_are_used() -> None:
    assert {i for pair in ranked(free=[0, 2, 3]) for i in pair.image_idx} == {0, 2, 3}


def test_a_pair_that_shows_no_depth_comes_last_and_says_why() -> None:
    best = ranked()[0].image_idx
    index = next(p for p, pair in enumerate(true_correspondences(SCENE).pair_image_idx) if tuple(pair.tolist()) == best)
    pairs = ranked({index: TwoViewConfig.PANORAMIC})
    refused = next(pair for pair in pairs if pair.image_idx == best)
    assert refused.score == 0
    assert "panoramic" in refused.reason
    assert pairs[0].image_idx != best


def test_wider_is_better_up_to_what_is_enough() -> None:
    def pair(angle: float) -> InitialPair:
        return InitialPair((0, 1), 200, 200, angle, rigid3.IDENTITY)

    assert pair(8.0).score == pytest.approx(100.0)
    assert pair(ENOUGH_ANGLE_DEG).score == pair(60.0).score == 200.0
    assert "8.00 degrees in the median, 9.00 wanted" in pair(8.0).shortfall(100, 9.0)
    assert "200 points in front of both cameras, 300 wanted" in pair(8.0).shortfall(300, 1.0)


def test_images_that_only_turned_are_one_place() -> None:
    found = true_correspondences(SCENE)
    inside = np.isin(found.pair_image_idx, [0, 1, 2]).all(1)
    found.config[inside] = TwoViewConfig.PANORAMIC
    place = single_places(found, 6)
    assert place[0] == place[1] == place[2] >= 0
    assert (place[3:] == -1).all()
    # a video that moves slowly: neighbours look like turns, those further apart show parallax
    slow = true_correspondences(SCENE)
    near = np.abs(np.diff(slow.pair_image_idx, axis=1)[:, 0]) == 1
    slow.config[near] = TwoViewConfig.PANORAMIC
    assert (single_places(slow, 6) == -1).all()


def test_the_first_image_is_the_origin_and_the_second_a_unit_away() -> None:
    model = Reconstruction.empty(
        SCENE.ground_truth.cameras, SCENE.ground_truth.image_names, SCENE.ground_truth.image_camera_idx,
        SCENE.observed.tracks,
    )  # fmt: skip
    pair = ranked()[0]
    initialize_from_pair(model, pair)
    assert sorted(model.registered_idx) == sorted(pair.image_idx)
    np.testing.assert_array_equal(model.cam_from_world[pair.image_idx[0]], rigid3.IDENTITY)
    assert np.linalg.norm(rigid3.center(model.cam_from_world[pair.image_idx[1]])) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", [0, 2, 4, 7])
def test_a_pose_found_with_a_guessed_focal_length_is_searched_for_anew(seed: int) -> None:
    # The camera moves aside by a tenth of the distance of what it sees, and turns by five degrees. There is a second
    # valley in which it turned more and moved ahead, at right angles to the true baseline.
    rng, focal = np.random.default_rng(seed), 500.0
    camera = Camera(CameraModel.PINHOLE, 640, 360, np.array([focal, focal, 320.0, 180.0]), focal_source="default")
    x1 = rng.uniform([-0.6, -0.34], [0.6, 0.34], (300, 2))
    xyz = np.column_stack([x1, np.ones(300)]) * rng.uniform(3.0, 4.5, (300, 1))
    turn, center = rigid3.exp_so3(np.array([0.0, 0.08, 0.02])), np.array([0.25, 0.05, 0.0])
    there = (xyz - center) @ turn.T
    x2 = there[:, :2] / there[:, 2:]
    x1, x2 = (x + rng.normal(0.0, 0.3 / focal, x.shape) for x in (x1, x2))
    truth = rigid3.from_matrix(turn, -turn @ center / np.linalg.norm(center))
    only_turned = turn_at_focal(x1, x2, 0.1, 0.0)[0]
    ahead = rigid3.from_matrix(only_turned, -only_turned[:, 2])
    for _ in range(6):
        ahead = refine_relative_pose(ahead, x1, x2, 1.0 / focal)
    assert _between_baselines_deg(ahead, truth) > 60.0  # a valley of its own

    found = _one_pair(camera, x1, x2, ahead)
    features = [Features.from_arrays(focal * x + [320.0, 180.0]) for x in (x1, x2)]
    tracks = build_tracks(found, features)[0]
    empty = Reconstruction.empty([camera], ["a", "b"], np.zeros(2, np.int32), tracks)
    pose = rank_initial_pairs(empty, found, np.ones(2, bool), MappingOptions())[0].cam2_from_cam1
    assert _between_baselines_deg(pose, truth) < 3.0
    # one that was found with a known focal length is not doubted
    known = Reconstruction.empty([replace(camera, focal_source="user")], ["a", "b"], np.zeros(2, np.int32), tracks)
    kept = rank_initial_pairs(known, found, np.ones(2, bool), MappingOptions())[0].cam2_from_cam1
    assert _between_baselines_deg(kept, ahead) < 3.0


def _between_baselines_deg(pose: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Whatever their sign, which is that of all depths."""
    a, b = rigid3.center(pose), rigid3.center(other)
    return float(np.degrees(np.arccos(min(abs(a @ b) / np.linalg.norm(a) / np.linalg.norm(b), 1.0))))


def _one_pair(
    camera: Camera, x1: NDArray[np.float64], x2: NDArray[np.float64], pose: NDArray[np.float64]
) -> Correspondences:
    """All of (N, 2) normalised points matched: with few of them off a plane, whose F is not asked, and this pose."""
    num, back = len(x1), np.linalg.inv(camera.k_matrix)
    fundamental = back.T @ fundamental_from_points(x1, x2) @ back
    counts = np.array([num], np.int32)
    return Correspondences(
        pair_image_idx=np.array([[0, 1]], np.int32), pair_ptr=np.array([0, num]),
        matches=np.column_stack([np.arange(num)] * 2).astype(np.int32),
        config=np.array([TwoViewConfig.PLANAR], np.int8), fundamental=fundamental[None],
        essential=epipolar.essential_from_pose(pose)[None], homography=np.full((1, 3, 3), np.nan),
        cam2_from_cam1=pose[None],
        median_angle_deg=np.array([5.0]), num_putative=counts, num_inliers_f=counts, num_inliers_e=counts,
        num_inliers_h=np.zeros(1, np.int32),
    )  # fmt: skip


def bent_pose(pose: Array, x1: Array, x2: Array, rms: float) -> Array:
    """A relative pose (7,) whose baseline is turned about the axis and whose rotation makes the best of it, until it is
    off matches by so much."""

    def off(t: Array, w: Array) -> tuple[Array, Array]:
        bent = rigid3.from_matrix(rigid3.exp_so3(w) @ rigid3.rotation_matrix(pose), t)
        lines = np.column_stack([x1, np.ones(len(x1))]) @ epipolar.essential_from_pose(bent).T
        return bent, ((lines[:, :2] * x2).sum(1) + lines[:, 2]) / np.hypot(*lines[:, :2].T)

    w = np.zeros(3)
    for degrees in range(1, 90):
        t = rigid3.exp_so3(np.radians([0.0, 0.0, degrees])) @ pose[4:]
        for _ in range(4):
            now = off(t, w)[1]
            jacobian = np.stack([(off(t, w + step)[1] - now) / 1e-6 for step in 1e-6 * np.eye(3)], 1)
            w -= np.linalg.lstsq(jacobian, now, rcond=None)[0]
        bent, residuals = off(t, w)
        if np.sqrt((residuals**2).mean()) >= rms:
            return bent
    raise AssertionError("nothing bends so far")


def pair_with_a_like(seed: int) -> tuple[Array, Array, Array]:
    """260 matches of a wall and of things before it, 14 of a thing that was taken for its like, which a pose explains
    that is 0.09 px off the others; and the true pose. The focal length is 500, the noise 0.05 px."""
    rng = np.random.default_rng(seed)
    x1 = rng.uniform([-0.2, -0.34], [0.6, 0.34], (260, 2))
    depth = 1.6 + 0.8 * x1[:, 0] - 0.15 * (rng.random(260) < 0.2)
    rotation, center = rigid3.exp_so3(np.array([0.02, 0.5, 0.0])), np.array([-0.06, -0.03, -0.02])
    length = float(np.linalg.norm(center))
    pose = rigid3.from_matrix(rotation, -rotation @ center / length)

    def seen(xy: Array, depth: Array, pose: Array) -> Array:
        xyz = np.column_stack([xy, np.ones(len(xy))]) * depth[:, None] @ rigid3.rotation_matrix(pose).T
        xyz += length * pose[4:]
        out: Array = xyz[:, :2] / xyz[:, 2:]
        return out

    x2 = seen(x1, depth, pose)
    like = rng.uniform([-0.6, 0.15], [-0.5, 0.3], (14, 2))
    x2 = np.concatenate([x2, seen(like, np.full(14, 0.3), bent_pose(pose, x1, x2, 0.09 / 500.0))])
    x1 = np.concatenate([x1, like])
    return x1 + rng.normal(0, 1e-4, x1.shape), x2 + rng.normal(0, 1e-4, x2.shape), pose


def baseline_error_deg(pose: Array, truth: Array) -> float:
    return float(np.degrees(np.arccos(np.clip(rigid3.center(pose) @ rigid3.center(truth), -1.0, 1.0))))


def test_a_thing_taken_for_its_like_bends_no_pose() -> None:
    """Within the tolerance of verification the bent pose explains more of the matches; at their noise it does not."""
    bent, straight, best = [], [], []
    for seed in range(6):
        x1, x2, truth = pair_with_a_like(seed)
        essentials = essentials_of_samples(x1, x2, Ransac(0, 0))
        at_threshold = best_relative_pose(essentials, np.arange(len(x1)), x1, x2, 0.73 / 500.0)
        at_noise = relative_pose_at_noise(essentials, x1, x2, 0.73 / 500.0)
        assert at_threshold is not None
        assert at_noise is not None
        bent.append(baseline_error_deg(at_threshold, truth))
        straight.append(baseline_error_deg(at_noise, truth))
        best.append(baseline_error_deg(refine_relative_pose(truth, x1[:260], x2[:260], 3e-4), truth))
    assert max(bent) > 5.0 * max(best)
    assert max(straight) < 2.0 * max(best)
