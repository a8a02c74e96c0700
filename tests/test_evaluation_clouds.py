"""Scores of clouds: exact cases, and an oracle that looks at all pairs."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.evaluation import clouds
from sfmapp.evaluation.clouds import sample_triangles, score_cloud


def lattice(count: int) -> NDArray[np.float64]:
    x, y = np.meshgrid(np.arange(count), np.arange(count))
    return np.stack([x.ravel(), y.ravel(), np.zeros(count * count)], 1).astype(float)


def test_a_cloud_at_a_known_height_is_all_wrong_until_it_is_all_right() -> None:
    ground_truth = lattice(20)
    score = score_cloud(ground_truth + np.array([0, 0, 0.25]), ground_truth, [0.125, 0.25, 0.5])
    assert score.accuracy.tolist() == score.completeness.tolist() == score.f_score.tolist() == [0, 1, 1]
    assert (score.point_distance == 0.25).all()


def test_half_of_a_surface_and_as_many_points_in_the_air() -> None:
    ground_truth = lattice(10)
    cloud = np.concatenate([ground_truth[:50], ground_truth[:25] + np.array([0, 0, 3.0])])
    score = score_cloud(cloud, ground_truth, [0.5])
    assert score.accuracy == [2 / 3]
    assert score.completeness == [0.5]
    assert score.f_score[0] == pytest.approx(2 * (2 / 3) * 0.5 / (2 / 3 + 0.5), abs=1e-15)
    assert np.isinf(score.point_distance[50:]).all()
    summary = score.summary()
    assert (summary["num_points"], summary["num_ground_truth"], summary["median_error"]) == (75, 100, 0.0)


@pytest.mark.parametrize("threads", [1, 2])
def test_all_pairs_agree(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clouds, "_CHUNK_POINTS", 100)
    rng = np.random.default_rng(3)
    cloud, ground_truth = rng.random((730, 3)), rng.random((410, 3))
    pairs = np.linalg.norm(cloud[:, None] - ground_truth[None], axis=2)
    limits = [0.03, 0.06, 0.15]
    score = score_cloud(cloud, ground_truth, limits[::-1], threads=threads)
    assert score.distances.tolist() == limits
    for k, limit in enumerate(limits):
        precision, recall = (pairs.min(1) <= limit).mean(), (pairs.min(0) <= limit).mean()
        assert (score.accuracy[k], score.completeness[k]) == (precision, recall)
        assert score.f_score[k] == pytest.approx(2 / (1 / precision + 1 / recall), abs=1e-14)
    near = pairs.min(1) <= limits[-1]
    np.testing.assert_allclose(score.point_distance[near], pairs.min(1)[near], rtol=0, atol=1e-14)
    assert np.isinf(score.point_distance[~near]).all()


def test_points_that_are_not_finite_or_outside_the_box_do_not_count() -> None:
    ground_truth = lattice(10)
    cloud = np.concatenate([ground_truth, ground_truth + np.array([0, 0, 50.0]), [[np.nan, 0, 0], [0, np.inf, 0]]])
    ground_truth = np.concatenate([ground_truth, [[np.nan] * 3]])
    score = score_cloud(cloud, ground_truth, [0.1], box=([0, 0, -1], [4, 9, 1]))
    assert score.f_score == [1.0]
    assert score.summary()["num_points"] == score.summary()["num_ground_truth"] == 50
    assert np.isnan(score.point_distance[100:]).all()
    assert score_cloud(cloud, ground_truth, [0.1]).accuracy == [0.5]


def test_no_points_score_nothing() -> None:
    for cloud, ground_truth in ((np.zeros((0, 3)), lattice(3)), (lattice(3), np.zeros((0, 3))), ([], [])):
        score = score_cloud(cloud, ground_truth, [1.0, 2.0])
        assert score.accuracy.tolist() == score.completeness.tolist() == score.f_score.tolist() == [0, 0]
    assert score_cloud([], [], [1.0]).summary()["median_error"] is None


@pytest.mark.parametrize("distances", [[], [0.0], [-1.0], [np.nan]])
def test_distances_are_above_zero(distances: list[float]) -> None:
    with pytest.raises(ValueError, match="distances above 0"):
        score_cloud(lattice(2), lattice(2), distances)


def test_samples_lie_on_their_triangles_in_proportion_to_the_area() -> None:
    vertices = np.array([[0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 5], [1, 0, 5], [0, 1, 5.0], [np.nan, 0, 0]])
    triangles = [[0, 1, 2], [3, 4, 5], [0, 1, 6], [0, 0, 1]]
    points = sample_triangles(vertices, triangles, 40_000, seed=4)
    low = points[:, 2] == 0
    np.testing.assert_allclose(points[~low, 2], 5, rtol=1e-14)
    assert low.sum() == pytest.approx(30_000, abs=1)
    x, y = points[low, 0] / 3, points[low, 1]
    assert ((x >= 0) & (y >= 0) & (x + y <= 1 + 1e-12)).all()
    # an even spread over the triangle (0, 0), (1, 0), (0, 1): means 1/3, variances 1/18, covariance -1/36
    sigma = 1 / np.sqrt(18 * len(x))
    assert abs(x.mean() - 1 / 3) < 4 * sigma
    assert abs(y.mean() - 1 / 3) < 4 * sigma
    np.testing.assert_allclose(np.cov(x, y), [[1 / 18, -1 / 36], [-1 / 36, 1 / 18]], atol=0.002)
    np.testing.assert_array_equal(points, sample_triangles(vertices, triangles, 40_000, seed=4))
    assert sample_triangles(vertices, [[0, 0, 1]], 10).shape == (0, 3)
