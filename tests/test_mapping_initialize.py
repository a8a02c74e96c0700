"""The pair that a model starts from: ranked by what it shows, refused by name, and placed as it was seen."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.geometry import rigid3
from sfmapp.mapping.initialize import (
    ENOUGH_ANGLE_DEG,
    InitialPair,
    initialize_from_pair,
    rank_initial_pairs,
    single_places,
)
from sfmapp.mapping.options import MappingOptions
from sfmapp.scene.correspondences import TwoViewConfig
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_scene, true_correspondences

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
