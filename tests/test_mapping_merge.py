"""Joining models: the similarity through a shared image, the union, and what must not be joined."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from sfmapp.geometry import rigid3, similarity
from sfmapp.mapping import structure
from sfmapp.mapping.merge import find_merge, merge, num_linking_points
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
    assert votes >= 8
    union = merge(target, source, target_from_source)
    np.testing.assert_allclose(union.centers, ground_truth.centers, atol=1e-9)
    known = union.is_triangulated
    np.testing.assert_allclose(union.point_xyz[known], ground_truth.point_xyz[known], atol=1e-9)
    assert known.sum() == (target.is_triangulated | source.is_triangulated).sum()
    assert np.linalg.norm(union.residuals_px()[union.obs_is_inlier], axis=1).max() < 1e-6
    with ThreadPoolExecutor(1) as pool:
        structure.filter_observations(union, MappingOptions(), pool)
    new = union.is_registered & ~target.is_registered
    assert num_linking_points(union, new, target.is_registered & ~source.is_registered) > 0


def test_models_without_a_shared_image_or_common_points_stay_apart():
    ground_truth = make_scene(1, 10, 600, sigma_px=0.0).ground_truth
    assert find_merge(part(ground_truth, range(5)), part(ground_truth, range(5, 10))) is None
    apart = part(ground_truth, range(5, 10))
    target = part(ground_truth, range(6))
    apart.point_xyz[target.is_triangulated] = np.nan
    assert find_merge(target, apart) is None


def test_points_that_disagree_on_the_scale_do_not_vote():
    ground_truth = make_scene(2, 10, 600, sigma_px=0.0).ground_truth
    target, source = part(ground_truth, range(6)), part(ground_truth, range(5, 10), WORLD)
    rng = np.random.default_rng(0)
    center = source.centers[5]
    source.point_xyz[:] = center + (source.point_xyz - center) * rng.uniform(0.2, 5.0, (len(source.point_xyz), 1))
    found = find_merge(target, source)
    assert found is None or found[1] < 0.2 * (target.is_triangulated & source.is_triangulated).sum()
