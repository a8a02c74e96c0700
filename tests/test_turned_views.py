"""Rotations between two views that only turned, against Kabsch's solution by singular values, at several focals."""

import numpy as np
import pytest

from sfmapp.geometry import homography, rigid3, turned_views


def turned(rng: np.random.Generator, spread: float, wrong: float = 0.2) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A rotation and points before and after it, with noise of a thousandth of their spread, some of them wrong."""
    rotation = rigid3.exp_so3(rng.normal(size=3) * rng.choice([0.01, 0.3, 1.0]))
    a = rng.normal(size=(120, 2)) * spread
    b = homography_of(rotation, a) + rng.normal(size=a.shape) * 1e-3 * spread
    is_wrong = rng.random(len(a)) < wrong
    b[is_wrong] = rng.normal(size=(is_wrong.sum(), 2)) * spread
    return rotation, a, b


def homography_of(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    mapped = np.c_[points, np.ones(len(points))] @ matrix.T
    return mapped[:, :2] / mapped[:, 2:]


def by_singular_values(a: np.ndarray, b: np.ndarray, scale: float, log_focal: float) -> tuple[np.ndarray, np.ndarray]:
    factor, weights = np.exp(-log_focal), np.ones(len(a))
    for _ in range(3):
        rotation = homography.rotation_from_rays(a * factor, b * factor, weights)
        error = homography.transfer_errors(rotation, a * factor, b * factor) / (scale * factor) ** 2
        error = np.minimum(error, 1e12)
        weights = 1.0 / (1.0 + error)
    return rotation, error


@pytest.mark.parametrize("spread", [0.01, 0.3, 1.5])
def test_it_is_kabschs_rotation_at_every_focal(spread: float) -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        _, a, b = turned(rng, spread)
        for log_focal in (-0.5, 0.0, 0.4):
            rotation, error = turned_views.turn_at_focal(a, b, 3e-3 * spread, log_focal)
            expected, expected_error = by_singular_values(a, b, 3e-3 * spread, log_focal)
            # rounding of the quartic over the gap to the next root, the square of the field of view
            np.testing.assert_allclose(rotation, expected, atol=1e-10 / spread**2)
            np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(rotation) > 0.0
            np.testing.assert_allclose(error, expected_error, rtol=1e-3, atol=1e-6)


def test_costs_are_the_truncated_sums_and_least_at_the_true_focal() -> None:
    rng = np.random.default_rng(4)
    a = rng.normal(size=(150, 2)) * 0.4
    b = homography_of(rigid3.exp_so3(np.array([0.1, -0.3, 0.2])), a)
    log_focals = np.linspace(-0.4, 0.4, 9)
    costs = turned_views.turn_costs(a * 1.2214, b * 1.2214, 2e-3, log_focals)  # points of a focal of exp(0.2)
    each = [np.minimum(turned_views.turn_at_focal(a * 1.2214, b * 1.2214, 2e-3, f)[1], 1.0).sum() for f in log_focals]
    np.testing.assert_allclose(costs, each)
    assert log_focals[np.argmin(costs)] == pytest.approx(0.2)
    assert costs.min() < 0.01 * len(a) < np.delete(costs, np.argmin(costs)).min()


def test_a_mirror_image_is_no_turn() -> None:
    points = np.random.default_rng(5).normal(size=(30, 2))
    rotation, _ = turned_views.turn_at_focal(points, points * [1.0, -1.0], 1e-3, 0.0)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
