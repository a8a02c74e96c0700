"""Photographs without their distortion: what a pinhole would have shown, to a thousandth of a pixel."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.camera.camera import Camera, CameraModel, pixels_to_normalized
from sfmapp.dense.undistort import LARGEST_MARGIN, lay_out, make_canvas

Array = np.ndarray

LENSES = [
    Camera(CameraModel.PINHOLE, 320, 240, np.array([300.0, 310.0, 150.0, 125.0])),
    Camera(CameraModel.SIMPLE_RADIAL, 320, 240, np.array([300.0, 160.0, 120.0, -0.08])),
    Camera(CameraModel.RADIAL, 320, 240, np.array([300.0, 165.0, 118.0, 0.1, -0.02])),
    Camera(CameraModel.OPENCV, 320, 240, np.array([300.0, 305.0, 150.0, 125.0, -0.1, 0.02, 0.002, -0.001])),
    Camera(CameraModel.OPENCV_FISHEYE, 320, 240, np.array([180.0, 182.0, 158.0, 121.0, 0.05, -0.01, 0.0, 0.0])),
]


def pattern(x: Array, y: Array) -> Array:
    """Grey, 10 to 245, over the normalised image plane; steep, so that rounding does not swallow small shifts."""
    return 127.5 + 60.0 * np.sin(36.0 * x + 8.0 * y) + 57.0 * np.cos(44.0 * y - 12.0 * x)


def photograph(camera: Camera) -> Array:
    """(H, W, 3) of the pattern, point samples at the pixels' centres."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = pixels_to_normalized(camera, np.stack([x.ravel(), y.ravel()], axis=1))
    grey = np.round(pattern(rays[:, 0], rays[:, 1])).astype(np.uint8)
    return np.dstack([grey.reshape(camera.height, camera.width)] * 3)


def rays_of(k: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """Normalised image points of the pixels' centres of a pinhole."""
    return np.meshgrid((np.arange(shape[1]) + 0.5 - k[2]) / k[0], (np.arange(shape[0]) + 0.5 - k[3]) / k[1])


@pytest.mark.parametrize("shrink", [1.0, 1.5, 2.0, 4.0])
@pytest.mark.parametrize("camera", LENSES, ids=lambda camera: camera.model.name)
def test_the_plane_shows_what_a_pinhole_would(camera: Camera, shrink: float) -> None:
    canvas = make_canvas(camera, shrink)
    rgb, mask = lay_out(canvas, photograph(camera), None)
    assert rgb.shape[1::-1] == canvas.working_size
    x, y = rays_of(canvas.k, rgb.shape)
    expected = pattern(x, y)
    usable = np.ones(expected.shape, bool) if mask is None else mask
    assert usable.mean() > 0.93
    error = (rgb[..., 0] - expected)[usable]
    # a shift along either axis, apart from a change of brightness and of contrast, of which averaging takes some
    parts = [np.gradient(expected, axis=0), np.gradient(expected, axis=1), expected - 127.5, np.ones_like(expected)]
    basis = np.stack([part[usable] for part in parts], axis=1)
    fit = np.linalg.lstsq(basis, error, rcond=None)[0]
    assert np.abs(fit[:2]).max() < 0.0015
    assert abs(fit[2]) < 0.003 * shrink**2
    # rounding twice makes 0.41
    rest = error - basis @ fit
    assert 0.25 < np.sqrt((rest**2).mean()) < (0.55 if shrink == 1.0 else 1.2)


@pytest.mark.parametrize("shrink", [1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("camera", LENSES[1:], ids=lambda camera: camera.model.name)
def test_nothing_from_beyond_the_photograph_gets_into_what_is_usable(camera: Camera, shrink: float) -> None:
    canvas = make_canvas(camera, shrink)
    rgb = np.full((camera.height, camera.width, 3), 200, np.uint8)
    rgb[0, 0] = 0  # what an empty map would fetch
    flat, mask = lay_out(canvas, rgb, None)
    usable = np.ones(flat.shape[:2], bool) if mask is None else mask.copy()
    usable[:8, :8] = False
    assert (flat[usable] == 200).all()


@pytest.mark.parametrize("camera", LENSES, ids=lambda camera: camera.model.name)
def test_masks_are_laid_out_alike(camera: Camera) -> None:
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = pixels_to_normalized(camera, np.stack([x.ravel(), y.ravel()], axis=1)).reshape(*x.shape, 2)
    open_disc = np.hypot(rays[..., 0], rays[..., 1]) < 0.25
    canvas = make_canvas(camera, 2.0)
    _, mask = lay_out(canvas, photograph(camera), open_disc)
    assert mask is not None
    flat_x, flat_y = rays_of(canvas.k, mask.shape)
    radius = np.hypot(flat_x, flat_y)
    # right but for a pixel at the rim
    slack = 1.5 / canvas.k[0]
    assert mask[radius < 0.25 - slack].all()
    assert not mask[radius > 0.25 + slack].any()


def test_a_lens_that_sees_half_a_sphere_is_cut() -> None:
    camera = Camera(CameraModel.OPENCV_FISHEYE, 400, 400, np.array([130.0, 130.0, 200.0, 200.0, 0.0, 0.0, 0.0, 0.0]))
    canvas = make_canvas(camera, 1.0)
    assert max(canvas.width, canvas.height) <= 400 * (1 + 2 * LARGEST_MARGIN)
    flat, mask = lay_out(canvas, np.full((400, 400, 3), 200, np.uint8), None)
    assert (flat[np.ones(flat.shape[:2], bool) if mask is None else mask] == 200).all()


def test_where_the_polynomial_folds_back_nothing_is_shown() -> None:
    # u(r) = r - 0.3 r^3 turns at r = 1.05, inside of the plane that would be laid out
    camera = Camera(CameraModel.SIMPLE_RADIAL, 400, 400, np.array([280.0, 200.0, 200.0, -0.3]))
    canvas = make_canvas(camera, 1.0)
    flat, mask = lay_out(canvas, photograph(camera), None)
    x, y = rays_of(canvas.k, flat.shape)
    usable = np.ones(flat.shape[:2], bool) if mask is None else mask
    assert np.hypot(x, y)[usable].max() < np.sqrt(1 / 0.9) + 1e-3
