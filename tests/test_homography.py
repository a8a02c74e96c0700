"""Homographies of planes and rotations against exact scenes and OpenCV."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.geometry import homography, rigid3

K = np.array([[800.0, 0, 500], [0, 800, 400], [0, 0, 1]])


def apply(h: np.ndarray, xy: np.ndarray) -> np.ndarray:
    mapped = np.concatenate([xy, np.ones((len(xy), 1))], 1) @ h.T
    return mapped[:, :2] / mapped[:, 2:]


def test_transfer_error_is_the_larger_of_both_ways() -> None:
    zoom = np.diag([4.0, 4.0, 1.0])
    xy1 = np.array([[10.0, 20.0]])
    errors = homography.transfer_errors(zoom, xy1, np.array([[44.0, 80.0]]))
    np.testing.assert_allclose(errors, [16.0])
    errors = homography.transfer_errors(np.linalg.inv(zoom), np.array([[44.0, 80.0]]), xy1)
    np.testing.assert_allclose(errors, [16.0])


def test_points_beyond_the_horizon_and_singular_maps_never_fit() -> None:
    h = np.array([[1.0, 0, 0], [0, 1, 0], [-0.01, 0, 1]])  # the horizon is x = 100
    errors = homography.transfer_errors(
        h, np.array([[200.0, 0.0], [50.0, 0.0]]), np.array([[-200.0, 0.0], [100.0, 0.0]])
    )
    assert errors[0] == np.inf
    assert errors[1] < 1e-20
    singular = np.outer([1.0, 2, 3], [1.0, 0, 1])
    assert (homography.transfer_errors(singular, np.zeros((2, 2)), np.zeros((2, 2))) == np.inf).all()
    assert (homography.transfer_errors(np.full((3, 3), np.nan), np.zeros((2, 2)), np.zeros((2, 2))) == np.inf).all()


def test_a_plane_gives_back_the_motion() -> None:
    pose = np.concatenate([rigid3.quaternion(rigid3.exp_so3([0.1, 0.2, -0.05])), np.array([0.8, 0.1, 0.59160797])])
    pose[4:] /= np.linalg.norm(pose[4:])
    normal, distance = np.array([0.2, -0.1, 0.97]), 5.0
    normal /= np.linalg.norm(normal)
    h = K @ (rigid3.rotation_matrix(pose) + np.outer(pose[4:], normal) / distance) @ np.linalg.inv(K)
    poses = homography.motions_from_homography(h, K, K).poses
    assert 1 <= len(poses) <= 4
    errors = [
        max(np.abs(rigid3.rotation_matrix(p) - rigid3.rotation_matrix(pose)).max(), np.abs(p[4:] - pose[4:]).max())
        for p in poses
    ]
    assert min(errors) < 1e-6


def test_a_rotation_has_no_translation_to_give() -> None:
    rotation = rigid3.exp_so3([0.05, -0.2, 0.1])
    assert len(homography.motions_from_homography(K @ rotation @ np.linalg.inv(K), K, K).poses) == 0


def test_rotation_from_rays_is_exact_and_proper() -> None:
    rng = np.random.default_rng(1)
    rotation = rigid3.exp_so3([0.1, -0.3, 0.2])
    xn1 = rng.uniform(-0.4, 0.4, (20, 2))
    xn2 = apply(rotation, xn1)
    found = homography.rotation_from_rays(xn1, xn2, np.ones(20))
    np.testing.assert_allclose(found, rotation, atol=1e-12)
    flipped = homography.rotation_from_rays(xn1, xn1 * [1, -1], np.ones(20))
    assert np.linalg.det(flipped) == pytest.approx(1.0)
