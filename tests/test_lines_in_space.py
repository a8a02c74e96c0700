"""Lines in space from two projection planes: exact cases, covariance by trials, and planes that tell none."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.geometry import rigid3
from sfmapp.geometry.lines import DegenerateLinesError, line_of_planes, plane_of_segment, project_line

ENDS = np.array([[0.3, -0.5, 6.0], [0.9, 0.8, 7.0]])
POSES = np.stack([rigid3.IDENTITY, rigid3.from_matrix(rigid3.exp_so3([0.02, -0.1, 0.03]), [-1.0, 0.1, 0.05])])


def seen(sigma=0.0, rng=None, ends=ENDS, poses=POSES):
    planes = []
    for pose in poses:
        rays = rigid3.apply(pose, ends)
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        if rng is not None:
            rays = rays + sigma * rng.standard_normal(rays.shape)
        planes.append(plane_of_segment(*rays, sigma))
    return np.array([p[0] for p in planes]), np.array([p[1] for p in planes])


def test_two_planes_meet_in_the_line() -> None:
    line = line_of_planes(*seen(), POSES)
    np.testing.assert_allclose(line.distance(ENDS), 0.0, atol=1e-12)
    assert abs(line.direction @ line.moment) < 1e-12
    np.testing.assert_allclose(line.distance(line.nearest_point[None]), 0.0, atol=1e-12)
    along = (ENDS[1] - ENDS[0]) / np.linalg.norm(ENDS[1] - ENDS[0])
    assert abs(line.direction @ along) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(np.cross(ENDS[0], line.direction), line.moment, atol=1e-12)
    for pose in POSES:  # and is seen where it was
        np.testing.assert_allclose(rigid3.apply(pose, ENDS) @ project_line(line, pose), 0.0, atol=1e-12)


def test_the_covariance_is_that_of_trials() -> None:
    sigma, rng = 1e-3, np.random.default_rng(3)
    truth = line_of_planes(*seen(), POSES)
    lines = [line_of_planes(*seen(sigma, rng), POSES) for _ in range(2000)]
    off = np.array([np.concatenate([line.direction - truth.direction, line.moment - truth.moment]) for line in lines])
    planes = seen(sigma, None)
    told = line_of_planes(*planes, POSES)
    values, vectors = np.linalg.eigh(told.covariance)
    assert (values[:2] < 1e-6 * values[2]).all()  # a line has four degrees of freedom
    squares = ((off @ vectors[:, 2:]) ** 2 / values[2:]).sum(1)
    assert 3.8 < squares.mean() < 4.2
    middle = ENDS.mean(0)
    across = np.array([line.distance(middle[None])[0] for line in lines])
    assert np.sqrt((across**2).mean() / 2.0) == pytest.approx(told.distance_sigma(middle), rel=0.05)


def test_planes_that_tell_no_line_are_refused() -> None:
    epipolar = np.array([[-3.0, 0.0, 6.0], [3.0, 0.0, 7.0]])  # in one plane with both centres
    side = np.stack([rigid3.IDENTITY, rigid3.from_matrix(np.eye(3), [-1.0, 0.0, 0.0])])
    with pytest.raises(DegenerateLinesError, match="one plane with both cameras"):
        line_of_planes(*seen(1e-3, np.random.default_rng(0), epipolar, side), side)
    with pytest.raises(DegenerateLinesError, match="one plane with both cameras"):
        line_of_planes(*seen(ends=epipolar, poses=side), side)
    turned = np.stack([rigid3.IDENTITY, rigid3.from_matrix(rigid3.exp_so3([0.0, 0.2, 0.0]), np.zeros(3))])
    with pytest.raises(DegenerateLinesError, match="from one place"):
        line_of_planes(*seen(poses=turned), turned)
    with pytest.raises(DegenerateLinesError, match="no direction"):
        plane_of_segment([0.0, 0.0, 1.0], [1e-4, 0.0, 1.0], 1e-3)
    through = line_of_planes(*seen(), POSES)
    with pytest.raises(DegenerateLinesError, match="seen as a point"):
        project_line(through, rigid3.from_matrix(np.eye(3), -through.nearest_point))
