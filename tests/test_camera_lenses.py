"""Every lens against pycolmap and OpenCV, against itself turned round, and its Jacobians against differences."""

from __future__ import annotations

import cv2
import numba
import numpy as np
import pycolmap
import pytest

from sfmapp.camera import lens
from sfmapp.camera.camera import Camera, pixels_to_normalized, pixels_to_rays, project, simple_camera
from sfmapp.camera.models import PARAM_NAMES, CameraModel, canonical_from_params

WIDTH, HEIGHT = 1000, 800
# a lens of each model that bends as much as real ones do
BENT = {
    "f": 520.0, "fx": 520.0, "fy": 513.0, "cx": 507.0, "cy": 391.0, "w": 1000.0, "h": 800.0,
    "k1": -0.11, "k2": 0.023, "k3": -0.004, "k4": 0.0006, "p1": 0.0011, "p2": -0.0007,
    "k0": -0.05, "k5": 1e-4, "p0": 0.0012, "s0": 0.0004, "s1": -0.0003, "s2": 0.0005, "s3": 0.0002, "s4": -0.0001,
    "sx1": 0.0013, "sy1": -0.0009, "k": -0.21, "omega": 0.93, "alpha": 0.62, "beta": 1.13, "s": 3.7, "k6": 0.002,
}  # fmt: skip
# those that look further than a right angle from their axis
WIDE = [m for m in CameraModel if "FISHEYE" in m.name or "DIVISION" in m.name] + [
    CameraModel.FOV, CameraModel.EUCM, CameraModel.EQUIRECTANGULAR,
]  # fmt: skip


def bent_camera(model: CameraModel) -> Camera:
    values = dict(BENT)
    if model in (CameraModel.FULL_OPENCV, CameraModel.OPENCV_THIN_PRISM):
        values |= {"k3": 0.011, "k4": 0.13, "k5": 0.031}
    if model == CameraModel.RAD_TAN_THIN_PRISM_FISHEYE:
        values |= {"k0": -0.02, "k1": 0.004, "k2": -0.0005, "k3": 1e-4, "k4": -1e-5, "k5": 1e-6}
    elif "RADIAL_FISHEYE" in model.name:
        values["k1"] = -0.05
    return Camera(model, WIDTH, HEIGHT, np.array([values[name] for name in PARAM_NAMES[model]]))


def rays(model: CameraModel, widest_deg: float, number: int = 1000) -> np.ndarray:
    """Random points up to an angle off the axis, at all distances."""
    rng = np.random.default_rng(int(model))
    angle = np.radians(rng.uniform(0.2, widest_deg, number))
    turn = rng.uniform(0, 2 * np.pi, number)
    unit = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], 1)
    return unit * rng.uniform(0.1, 50.0, (number, 1))


def colmaps(camera: Camera) -> pycolmap.Camera:
    return pycolmap.Camera(model=camera.model.name, width=WIDTH, height=HEIGHT, params=camera.params)


def test_the_table_has_all_of_colmaps_models() -> None:
    theirs = {n: int(m) for n, m in pycolmap.CameraModelId.__members__.items() if int(m) >= 0}
    assert theirs == {m.name: int(m) for m in CameraModel if m.is_colmaps}
    for name, number in theirs.items():
        known = pycolmap.Camera.create_from_model_id(0, pycolmap.CameraModelId(number), 500.0, WIDTH, HEIGHT)
        names = known.params_info.replace(" ", "").split(",")
        ours = list(PARAM_NAMES[CameraModel[name]])
        assert [n + "1" if n == "k" and "DIVISION" not in name else n for n in names] == ours
        np.testing.assert_array_equal(simple_camera(CameraModel[name], WIDTH, HEIGHT, 500.0).params, known.params)


@pytest.mark.parametrize("model", [m for m in CameraModel if m.is_colmaps], ids=lambda m: m.name)
def test_pixels_equal_colmaps(model: CameraModel) -> None:
    camera = bent_camera(model)
    xyz = rays(model, 180 if model == CameraModel.EQUIRECTANGULAR else 80 if model in WIDE else 45)
    if model == CameraModel.FOV:  # nearer the axis COLMAP takes the first terms of a series
        xyz = xyz[(xyz[:, :2] ** 2).sum(1) > 1e-4 * xyz[:, 2] ** 2]
    expected = np.array([colmaps(camera).img_from_cam(each) for each in xyz])
    np.testing.assert_allclose(project(camera, xyz), expected, rtol=0, atol=1e-9)


def test_opencv_has_the_same_thin_prism() -> None:
    camera = bent_camera(CameraModel.OPENCV_THIN_PRISM)
    xyz = rays(camera.model, 45)
    c = camera.params
    expected = cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), camera.k_matrix, c[4:16])[0][:, 0]
    np.testing.assert_allclose(project(camera, xyz), expected, rtol=0, atol=1e-9)


def test_a_skewed_pinhole_is_its_matrix() -> None:
    camera = bent_camera(CameraModel.PINHOLE_SKEW)
    fx, fy, cx, cy, s = camera.params
    xyz = rays(camera.model, 60)
    expected = xyz @ np.array([[fx, s, cx], [0, fy, cy], [0, 0, 1]]).T
    np.testing.assert_allclose(project(camera, xyz), expected[:, :2] / expected[:, 2:], rtol=0, atol=1e-9)


def test_the_division_model_turned_round_is_rational() -> None:
    """The image divided by 1 + k r'^2 gives the ideal point; the ideal point divided gives the image."""
    division = Camera(CameraModel.DIVISION, WIDTH, HEIGHT, np.array([500.0, 500, 500, 400, -0.2]))
    xy = rays(division.model, 40)[:, :2]
    ideal = xy / (1 - 0.2 * (xy**2).sum(1, keepdims=True))
    near = (xy**2).sum(1) < 1
    np.testing.assert_allclose(
        pixels_to_normalized(division, 500 * xy[near] + [500, 400]), ideal[near], rtol=1e-12, atol=1e-12
    )
    params = np.array([500.0, 500, 500, 400, 0, 0, 0, 0, 0, -0.2, 0, 0])
    rational = Camera(CameraModel.FULL_OPENCV, WIDTH, HEIGHT, params)
    rays_of = np.concatenate([xy[near], np.ones((near.sum(), 1))], 1)
    np.testing.assert_allclose(project(rational, rays_of), 500 * ideal[near] + [500, 400], rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", list(CameraModel), ids=lambda m: m.name)
def test_there_and_back(model: CameraModel) -> None:
    """Rays and pixels to 1e-9, wide lenses beyond a right angle as well; the plane agrees with the rays."""
    camera = bent_camera(model)
    xyz = rays(model, 179 if model == CameraModel.EQUIRECTANGULAR else 110 if model in WIDE else 45)
    pixels = project(camera, xyz)
    assert np.isfinite(pixels).all()
    back = pixels_to_rays(camera, pixels)
    np.testing.assert_allclose(back, xyz / np.linalg.norm(xyz, axis=1, keepdims=True), rtol=0, atol=1e-9)
    np.testing.assert_allclose(project(camera, back), pixels, rtol=0, atol=1e-9)
    plane, narrow = pixels_to_normalized(camera, pixels), xyz[:, 2] > 0.05 * np.linalg.norm(xyz, axis=1)
    np.testing.assert_allclose(plane[narrow], xyz[narrow, :2] / xyz[narrow, 2:], rtol=1e-8, atol=1e-9)
    assert np.isnan(plane[xyz[:, 2] <= 0]).all()


@pytest.mark.parametrize("model", [m for m in CameraModel if m not in WIDE], ids=lambda m: m.name)
def test_narrow_lenses_see_nothing_behind(model: CameraModel) -> None:
    assert np.isnan(project(bent_camera(model), [[0.1, 0.2, -1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])).all()


@pytest.mark.parametrize("model", list(CameraModel), ids=lambda m: m.name)
def test_the_axis_is_the_principal_point(model: CameraModel) -> None:
    camera = bent_camera(model)
    np.testing.assert_allclose(project(camera, [[0.0, 0.0, 2.0]])[0], camera.canonical[2:4], atol=1e-12)
    np.testing.assert_allclose(pixels_to_rays(camera, [camera.canonical[2:4]])[0], [0, 0, 1], atol=1e-12)
    row = np.zeros(lens.JACOBIAN)
    jacobian_of(camera.canonical, 0.0, 0.0, 2.0, row)
    assert np.isfinite(row).all()


@numba.njit
def jacobian_of(c, x, y, z, row):
    lens.project_jacobian(c, x, y, z, row)


@numba.njit
def pixel_of(c, x, y, z):
    return lens.project(c, x, y, z)


@numba.njit
def inverse_jacobian_of(c, u, v, row, by_pixel, by_params):
    lens.unproject_jacobian(c, u, v, row, by_pixel, by_params)


@numba.njit
def ray_of(c, u, v):
    return lens.unproject(c, u, v)


@pytest.mark.parametrize("model", list(CameraModel), ids=lambda m: m.name)
def test_jacobians_equal_differences(model: CameraModel) -> None:
    """Both ways, by ray or pixel and by every parameter of the model."""
    camera = bent_camera(model)
    c, used = camera.canonical, np.flatnonzero(canonical_from_params(model).any(axis=1))
    if model == CameraModel.EQUIRECTANGULAR:
        used = used[:0]
    widest = 150 if model == CameraModel.EQUIRECTANGULAR else 105 if model in WIDE else 45
    row, by_pixel, by_params = np.zeros(lens.JACOBIAN), np.zeros((3, 2)), np.zeros((3, 16))
    for xyz in rays(model, widest, 40) / 5:
        jacobian_of(c, *xyz, row)
        np.testing.assert_allclose(row[:2], pixel_of(c, *xyz), rtol=0, atol=1e-9)
        step = 1e-5 * np.linalg.norm(xyz)
        of_ray = [richardson(lambda d, x=xyz, e=e: np.array(pixel_of(c, *(x + d * e))), step) for e in np.eye(3)]
        np.testing.assert_allclose(row[2:8].reshape(2, 3).T, of_ray, rtol=1e-6, atol=1e-6 * np.abs(row[2:8]).max())
        uv = row[:2].copy()
        inverse_jacobian_of(c, *uv, np.zeros(lens.JACOBIAN), by_pixel, by_params)
        for k, e in enumerate(np.eye(2)):
            numeric = richardson(lambda d, e=e, uv=uv: np.array(ray_of(c, *(uv + d * e))), 1e-2)
            np.testing.assert_allclose(by_pixel[:, k], numeric, rtol=0, atol=1e-6 * np.abs(by_pixel).max())
        for k in used:
            e = np.eye(lens.ROW)[k]
            step = 1e-3 if k < 4 else 1e-2 if model == CameraModel.PINHOLE_SKEW else 1e-6
            numeric = richardson(lambda d, e=e, x=xyz: np.array(pixel_of(c + d * e, *x)), step)
            np.testing.assert_allclose(row[8 + 2 * k : 10 + 2 * k], numeric, rtol=1e-6, atol=1e-5)
            numeric = richardson(lambda d, e=e, uv=uv: np.array(ray_of(c + d * e, *uv)), step)
            np.testing.assert_allclose(by_params[:, k], numeric, rtol=1e-5, atol=1e-6)


def richardson(f, step):
    """Central differences of fourth order."""
    return (8 * (f(step) - f(-step)) - (f(2 * step) - f(-2 * step))) / (12 * step)


def test_beyond_the_end_of_the_image_there_is_no_ray() -> None:
    far = [[WIDTH * 40.0, HEIGHT * 40.0]]
    for model in (CameraModel.OPENCV_FISHEYE, CameraModel.FOV, CameraModel.EUCM, CameraModel.THIN_PRISM_FISHEYE):
        assert np.isnan(pixels_to_rays(bent_camera(model), far)).all(), model.name


@pytest.mark.parametrize("omega", [0.0, 1e-6, 1e-3, 0.0099])
def test_a_field_of_view_that_vanishes_is_a_pinhole(omega: float) -> None:
    camera = Camera(CameraModel.FOV, WIDTH, HEIGHT, np.array([500.0, 500, 500, 400, omega]))
    pinhole = Camera(CameraModel.PINHOLE, WIDTH, HEIGHT, np.array([500.0, 500, 500, 400]))
    xyz = rays(camera.model, 45)
    np.testing.assert_allclose(project(camera, xyz), project(pinhole, xyz), atol=500 * omega**2)
    unit = xyz / np.linalg.norm(xyz, axis=1, keepdims=True)
    np.testing.assert_allclose(pixels_to_rays(camera, project(camera, xyz)), unit, atol=1e-9)


def test_the_seam_of_a_panorama_is_no_distance() -> None:
    c = bent_camera(CameraModel.EQUIRECTANGULAR).canonical

    @numba.njit
    def short_way(c, du):
        return lens.across_seam(c, du)

    assert short_way(c, 998.0) == pytest.approx(-2.0)
    assert short_way(c, -998.0) == pytest.approx(2.0)
    assert short_way(c, 3.0) == pytest.approx(3.0)
    assert short_way(bent_camera(CameraModel.PINHOLE).canonical, 998.0) == 998.0
