"""Depth of two views and its error: exact cases, OpenCV, and statistics of drawn noise."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.errors import UsageError
from sfmapp.geometry import rigid3
from sfmapp.stereo.depth import depth_of_disparity, disparity_of_depth, points_of_depth, points_of_rays
from sfmapp.stereo.result import RectifiedGeometry
from sfmapp.stereo.uncertainty import TOLD_SIGMAS, depth_error_terms, depth_interval, depth_limits, depth_sigma

RIG = RectifiedGeometry(640, 480, 500.0, 310.0, 250.0, doffs=12.0, baseline=0.2, unit="m")


def test_depth_is_that_of_opencv() -> None:
    rng = np.random.default_rng(1)
    disparity = rng.uniform(1.0, 100.0, (480, 640)).astype(np.float32)
    # OpenCV's pixels have their centres at whole numbers
    q = np.float64([[1, 0, 0, 0.5 - RIG.cx], [0, 1, 0, 0.5 - RIG.cy], [0, 0, 0, 500.0], [0, 0, 1 / 0.2, 12.0 / 0.2]])
    expected = cv2.reprojectImageTo3D(disparity, q)
    found = points_of_depth(depth_of_disparity(disparity, RIG), RIG)
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


def test_unknown_and_infinite_disparities_have_no_depth() -> None:
    depth = depth_of_disparity([np.nan, -12.0, -13.0, 8.0], RIG)
    assert np.isnan(depth[:3]).all()
    assert depth[3] == np.float32(5.0)
    assert disparity_of_depth(depth[3], RIG) == np.float32(8.0)


def test_depth_needs_a_baseline() -> None:
    with pytest.raises(UsageError, match="baseline"):
        depth_of_disparity([3.0], RectifiedGeometry(640, 480, 500.0, 320.0, 240.0))


@pytest.mark.parametrize("converging_deg", [0.0, 24.0])
def test_points_of_converging_fisheyes_lie_where_they_were(converging_deg: float) -> None:
    rng = np.random.default_rng(2)
    bend = [0.02, -0.01, 0.003, -0.001]
    wide = Camera(CameraModel.OPENCV_FISHEYE, 800, 600, np.array([300.0, 301.0, 402.0, 297.0, *bend]))
    narrow = Camera(CameraModel.OPENCV, 640, 480, np.array([500.0, 502.0, 322.0, 238.0, -0.2, 0.05, 0.001, -0.002]))
    turn = np.array([0.0, np.sin(np.radians(converging_deg) / 2), 0.0, np.cos(np.radians(converging_deg) / 2)])
    pose = rigid3.inverse(np.concatenate([turn * [1, -1, 1, 1], [0.3, 0.01, -0.02]]))
    points = rng.uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 4.0], (500, 3))
    xy = project(wide, points), project(narrow, rigid3.apply(pose, points))
    found, info = points_of_rays((wide, narrow), pose, *xy)
    assert info.is_inlier.all()
    assert np.abs(found - points).max() < 1e-7
    noisy = [pixels + rng.normal(0.0, 0.1, pixels.shape) for pixels in xy]
    # lenses magnify unequally, so the covariance by one focal length is good to some tenths
    found, info = points_of_rays((wide, narrow), pose, noisy[0], noisy[1], noise_px=0.1)
    assert info.covariance is not None
    squared = np.einsum("ni,nij,nj->n", found - points, np.linalg.inv(info.covariance), found - points)
    assert 0.7 * 3 < squared.mean() < 1.7 * 3


def test_three_terms_are_slopes() -> None:
    disparity = np.array([2.0, 30.0, 90.0])
    terms = depth_error_terms(RIG, disparity, baseline_error=1e-6, disparity_error=1e-4, focal_error=1e-3)
    moved = [
        RectifiedGeometry(640, 480, 500.0, 310.0, 250.0, 12.0, 0.2 + 1e-6), RIG,
        RectifiedGeometry(640, 480, 500.0 + 1e-3, 310.0, 250.0, 12.0, 0.2),
    ]  # fmt: skip
    for term, rig, shift in zip(terms, moved, (0.0, -1e-4, 0.0), strict=True):
        d = disparity + 12.0
        change = rig.focal * rig.baseline / (d + shift) - 500.0 * 0.2 / d
        np.testing.assert_allclose(term, change, rtol=1e-4)
    np.testing.assert_allclose(terms.total, sum(terms))


def test_sigma_is_the_spread_of_depths() -> None:
    rng = np.random.default_rng(3)
    covariance = np.array([[4.0, 3e-4, 0.05], [3e-4, 1e-6, 0.0], [0.05, 0.0, 0.04]])
    rig = RectifiedGeometry(640, 480, 500.0, 310.0, 250.0, 12.0, 0.2, "m", covariance)
    focal, baseline, doffs = rng.multivariate_normal([500.0, 0.2, 12.0], covariance, 40_000).T
    drawn = focal * baseline / (30.0 + rng.normal(0.0, 0.3, 40_000) + doffs)
    assert depth_sigma(rig, 30.0, 0.3) == pytest.approx(drawn.std(), rel=0.03)
    assert np.isnan(depth_sigma(rig, np.nan, 0.3))
    assert np.isnan(depth_sigma(rig, -13.0, 0.3))


def test_intervals_and_limits_reach_infinity() -> None:
    near, far = depth_interval(RIG, [8.0, -11.5, np.nan], [2.0, 1.0, 1.0])
    np.testing.assert_allclose(near[:2], [100.0 / 22.0, 100.0 / 1.5], rtol=1e-6)
    assert far[0] == np.float32(100.0 / 18.0)
    assert np.isinf(far[1])
    assert np.isnan(near[2])
    assert np.isnan(far[2])
    limits = depth_limits(RIG, 88.0, 0.25)
    assert limits.least == 1.0
    assert limits.at_ten_percent == pytest.approx(40.0)
    assert depth_interval(RIG, disparity_of_depth(limits.greatest, RIG), TOLD_SIGMAS * 0.25)[1] > 1e5
    assert json.dumps(limits)
