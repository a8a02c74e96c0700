"""Camera models against OpenCV and pycolmap, and their inverses."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfmapp.camera.camera import (
    PARAM_NAMES,
    Camera,
    CameraModel,
    pixels_to_normalized,
    project,
    simple_camera,
)

LENS = {"k1": -0.12, "k2": 0.03, "p1": 1e-3, "p2": -2e-3, "k3": 0.01, "k4": -0.002}


def camera_of(model: CameraModel) -> Camera:
    base = {"f": 800.0, "fx": 800.0, "fy": 810.0, "cx": 512.3, "cy": 380.9} | LENS
    return Camera(model, 1024, 768, np.array([base[name] for name in PARAM_NAMES[model]]))


def some_points(n: int = 200) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.c_[rng.uniform(-0.6, 0.6, n), rng.uniform(-0.45, 0.45, n), np.ones(n)] * rng.uniform(1, 5, (n, 1))


@pytest.mark.parametrize("model", list(CameraModel))
def test_projection_equals_pycolmap(model):
    pycolmap = pytest.importorskip("pycolmap")
    camera, xyz = camera_of(model), some_points()
    oracle = pycolmap.Camera(model=model.name, width=1024, height=768, params=camera.params)
    np.testing.assert_allclose(project(camera, xyz), oracle.img_from_cam(xyz), atol=1e-9)
    assert int(oracle.model) == int(model)


@pytest.mark.parametrize("model", [CameraModel.OPENCV, CameraModel.OPENCV_FISHEYE])
def test_projection_equals_opencv_half_a_pixel_away(model):
    camera, xyz = camera_of(model), some_points()
    k = camera.k_matrix.copy()
    k[:2, 2] -= 0.5  # OpenCV's pixel centres are at integers
    if model == CameraModel.OPENCV:
        expected = cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), k, camera.canonical[4:8])[0][:, 0]
    else:
        expected = cv2.fisheye.projectPoints(xyz[:, None], np.zeros(3), np.zeros(3), k, camera.canonical[4:8])[0][:, 0]
    np.testing.assert_allclose(project(camera, xyz), expected + 0.5, atol=1e-9)


@pytest.mark.parametrize("model", list(CameraModel))
@given(x=st.floats(-0.6, 0.6), y=st.floats(-0.45, 0.45), z=st.floats(0.1, 100))
def test_undistortion_inverts_projection(model, x, y, z):
    camera = camera_of(model)
    pixel = project(camera, np.array([[x * z, y * z, z]]))
    np.testing.assert_allclose(pixels_to_normalized(camera, pixel), [[x, y]], atol=1e-10)


def test_points_behind_and_pixels_beyond_the_fold_are_nan():
    camera = simple_camera(CameraModel.SIMPLE_RADIAL, 1000, 1000, 500).with_params([500, 500, 500, -0.5])
    assert np.isnan(project(camera, np.array([[0.1, 0.2, -1.0], [0.0, 0.0, 0.0]]))).all()
    # r (1 - r^2 / 2) is at most 0.544: no ray reaches a pixel at 500 * 0.6 from the centre
    assert np.isnan(pixels_to_normalized(camera, np.array([[800.0, 500.0]]))).all()
    assert np.isfinite(pixels_to_normalized(camera, np.array([[700.0, 500.0]]))).all()


def test_another_focal_keeps_the_aspect_ratio():
    camera = camera_of(CameraModel.OPENCV)
    longer = camera.with_focal(1610.0)
    assert longer.focal == pytest.approx(1610.0)
    np.testing.assert_allclose(longer.params[1] / longer.params[0], camera.params[1] / camera.params[0])
    np.testing.assert_array_equal(longer.params[2:], camera.params[2:])


def test_wrong_number_of_parameters_is_refused():
    with pytest.raises(ValueError, match="PINHOLE has 4 parameters"):
        Camera(CameraModel.PINHOLE, 10, 10, np.ones(3))
