"""Sparse stereo: covariances against draws, and errors of a rendered pair against what is said of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfmapp.errors import UsageError
from sfmapp.stereo.result import RectifiedGeometry
from sfmapp.stereo.sparse import match_along_rows, noise_of_rows, points_with_covariance, sparse_points
from sfmapp.stereo.sparse_matches import PairMatches

GEOMETRY = RectifiedGeometry(
    640, 480, 500.0, 323.0, 238.0, 12.0, 0.2, "m", np.array([[4.0, 1e-4, 0.05], [1e-4, 1e-6, 0.0], [0.05, 0.0, 0.01]])
)


def test_covariances_are_those_of_draws() -> None:
    rng = np.random.default_rng(4)
    matches = PairMatches(np.array([[400.0, 100.0], [100.0, 400.0]]), np.array([[372.0, 100.0], [98.0, 400.0]]))
    xyz, covariance = points_with_covariance(GEOMETRY, matches, (0.2, 0.3))
    np.testing.assert_allclose(xyz[0], 0.2 / 40.0 * np.array([77.0, -138.0, 500.0]))
    draws = []
    for f, b, doffs in rng.multivariate_normal([500.0, 0.2, 12.0], np.asarray(GEOMETRY.covariance), 8000):
        left = matches.left + 0.2 * rng.standard_normal((2, 2))
        right = matches.right + 0.2 * rng.standard_normal((2, 2))
        right[:, 0] = left[:, 0] - matches.disparities - 0.3 * rng.standard_normal(2)
        noisy = PairMatches(left, right)
        drawn = replace(GEOMETRY, focal=f, baseline=b, doffs=doffs, covariance=None)
        draws.append(points_with_covariance(drawn, noisy, (0.0, 0.0))[0])
    sampled = np.array(draws)
    for n in range(2):
        np.testing.assert_allclose(np.cov(sampled[:, n].T), covariance[n], rtol=0.08, atol=1e-3 * covariance[n].max())


def test_without_a_baseline_there_are_no_points() -> None:
    matches = PairMatches(np.ones((1, 2)), np.zeros((1, 2)))
    with pytest.raises(UsageError, match="baseline"):
        points_with_covariance(replace(GEOMETRY, baseline=None), matches, (0.2, 0.3))
    assert np.isnan(noise_of_rows(matches)).all()


def test_points_of_a_rendered_pair_are_off_by_what_is_said() -> None:
    pairs = pytest.importorskip("stereo_pairs", reason="benchmarks/ is not part of an installed package")
    case = pairs.rendered_set(pairs.shots()[4])  # disparities on both sides of zero
    matches = match_along_rows(case.pair)
    assert len(matches) > 200
    assert np.abs(matches.row_differences).max() < 1.0
    corner = np.clip(np.floor(matches.left - 0.5).astype(int), 0, np.array(case.truth.shape)[::-1] - 2)
    across, down = (matches.left - 0.5 - corner).T
    square = np.array([[case.truth[corner[:, 1] + j, corner[:, 0] + i] for i in (0, 1)] for j in (0, 1)])
    truth = (1 - down) * ((1 - across) * square[0, 0] + across * square[0, 1])
    truth += down * ((1 - across) * square[1, 0] + across * square[1, 1])
    smooth = np.ptp(square, axis=(0, 1)) < 0.3
    error = matches.disparities - truth
    assert (np.abs(error)[smooth] < 1.0).mean() > 0.95
    points = sparse_points(case.pair, matches)
    kept = smooth & (np.abs(error) < 1.0)
    assert 0.02 < points.noise_px[0] < 0.15
    assert 0.6 < (np.abs(error[kept]) < points.noise_px[1]).mean() < 0.95
    assert 0.85 < (np.abs(error[kept]) < 1.96 * points.noise_px[1]).mean() < 0.995
    geometry = case.pair.geometry
    depth = geometry.focal * geometry.baseline / (truth + geometry.doffs)
    pulls = (points.xyz[:, 2] - depth) / np.sqrt(points.covariance[:, 2, 2])
    assert 0.85 < (np.abs(pulls[kept]) < 1.96).mean() < 0.995
