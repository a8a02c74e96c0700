"""Joining models: the similarity through a shared image, the union, and what must not be joined."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.stats import binom

from sfmapp.geometry import rigid3, similarity
from sfmapp.mapping import structure
from sfmapp.mapping.merge import binomial_tails, find_merge, merge, num_linking_points
from sfmapp.mapping.options import MappingOptions
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_scene


def part(ground_truth: Reconstruction, images: range, b_from_a: np.ndarray | None = None) -> Reconstruction:
    """The model of some images, with the points that two of them see, carried into another world."""
    model = ground_truth.copy()
    model.cam_from_world[[i for i in range(len(ground_truth.image_names)) if i not in images]] = np.nan
    seen = model.is_registered[model.tracks.obs_image_idx]
    count = np.bincount(model.tracks.obs_track_idx[seen], minlength=model.tracks.num_tracks)
    model.point_xyz[count < 2] = np.nan
    model.obs_is_inlier[:] = seen & (count >= 2)[model.tracks.obs_track_idx]
    if b_from_a is not None:
        model.point_xyz[:] = similarity.apply(b_from_a, model.point_xyz)
        model.cam_from_world[:] = similarity.transform_poses(b_from_a, model.cam_from_world)
    return model


WORLD = np.append(rigid3.from_matrix(rigid3.exp_so3(np.array([0.4, -1.1, 0.3])), [5.0, -2.0, 1.0]), 2.5)


def test_a_shared_image_and_common_points_give_the_similarity():
    ground_truth = make_scene(0, 10, 600, sigma_px=0.0).ground_truth
    target, source = part(ground_truth, range(6)), part(ground_truth, range(5, 10), WORLD)
    found = find_merge(target, source)
    assert found is not None
    target_from_source, votes = found
    assert target_from_source[7] == pytest.approx(1 / 2.5, rel=1e-9)
    there_and_back = similarity.apply(target_from_source, similarity.apply(WORLD, ground_truth.point_xyz))
    np.testing.assert_allclose(there_and_back, ground_truth.point_xyz, atol=1e-9)
    assert votes == (target.is_triangulated & source.is_triangulated).sum() > 30
    union = merge(target, source, target_from_source)
    np.testing.assert_allclose(union.centers, ground_truth.centers, atol=1e-9)
    turns = rigid3.rotation_matrix(union.cam_from_world), rigid3.rotation_matrix(ground_truth.cam_from_world)
    np.testing.assert_allclose(*turns, atol=1e-9)
    known = union.is_triangulated
    np.testing.assert_allclose(union.point_xyz[known], ground_truth.point_xyz[known], atol=1e-9)
    assert known.sum() == (target.is_triangulated | source.is_triangulated).sum()
    assert np.linalg.norm(union.residuals_px()[union.obs_is_inlier], axis=1).max() < 1e-6
    with ThreadPoolExecutor(1) as pool:
        structure.filter_observations(union, MappingOptions(), pool)
    # without noise, every image that sees a point supports it
    sees = np.zeros((10, union.tracks.num_tracks), bool)
    sees[union.tracks.obs_image_idx, union.tracks.obs_track_idx] = True
    old, new = np.arange(10) < 5, np.arange(10) > 5
    linking = sees[old].any(0) & sees[new].any(0) & union.is_triangulated
    assert num_linking_points(union, new, old) == linking.sum() > 100


def test_models_without_a_shared_image_or_common_points_stay_apart():
    ground_truth = make_scene(1, 10, 600, sigma_px=0.0).ground_truth
    assert find_merge(part(ground_truth, range(5)), part(ground_truth, range(5, 10))) is None
    apart = part(ground_truth, range(5, 10))
    target = part(ground_truth, range(6))
    assert find_merge(target, apart) is not None
    apart.point_xyz[target.is_triangulated] = np.nan
    assert find_merge(target, apart) is None


@pytest.mark.parametrize("share", [0.6, 1.0])
def test_points_that_disagree_on_the_scale_do_not_vote(share):
    for seed in range(4):
        ground_truth = make_scene(seed, 10, 600, sigma_px=0.0).ground_truth
        target, source = part(ground_truth, range(6)), part(ground_truth, range(5, 10), WORLD)
        rng = np.random.default_rng(seed)
        astray = rng.random(len(source.point_xyz)) < share
        center = source.centers[5]
        # all of them too far away, so that no mean or median of everything is right
        source.point_xyz[astray] += (source.point_xyz[astray] - center) * rng.uniform(0.2, 4.0, (astray.sum(), 1))
        found, common = find_merge(target, source), target.is_triangulated & source.is_triangulated
        if share < 1.0:
            assert found is not None
            assert found[0][7] == pytest.approx(1 / 2.5, rel=1e-9)
            assert found[1] == (common & ~astray).sum()
        else:  # few agree within a twentieth, and by chance
            assert found is None


def test_points_whose_distances_have_nothing_to_do_with_each_other_join_nothing():
    """An image at one place in one model and at another in the other: its rays are the same, the distances are not."""
    ground_truth = make_scene(5, 10, 1200, sigma_px=0.0).ground_truth
    target, source = part(ground_truth, range(6)), part(ground_truth, range(5, 10), WORLD)
    common = np.flatnonzero(target.is_triangulated & source.is_triangulated)
    center, away = source.centers[5], source.point_xyz[common] - source.centers[5]
    distance = np.linalg.norm(away, axis=1)
    assert len(common) > 60
    by_chance = 0
    for seed in range(50):
        shuffled = np.random.default_rng(seed).permutation(distance)
        source.point_xyz[common] = center + away * (shuffled / distance)[:, None]
        by_chance += find_merge(target, source) is not None
    assert by_chance == 0


@pytest.mark.parametrize("share", [1e-6, 0.05, 0.3, 0.9999, 1.0])
@pytest.mark.parametrize("num", [0, 1, 7, 5000])
def test_binomial_tails_are_those_of_scipy(num: int, share: float) -> None:
    expected = binom.sf(np.arange(num + 1) - 1, num, share)
    found = binomial_tails(num, share)
    can_be_told = expected > 1e-200
    assert found[can_be_told] == pytest.approx(expected[can_be_told], rel=1e-8)
    assert (found[~can_be_told] < 1e-199).all()
