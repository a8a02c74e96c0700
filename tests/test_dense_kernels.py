"""The photometric kernels of densification against brute force, differences and exact geometry."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from dense_scenes import FOCAL, HEIGHT, WIDTH, scene_of, wall_with_box_and_bars
from rendered_worlds import textures
from sfmapp.dense.arrays import Images, Limits, image_pointers
from sfmapp.dense.patch_kernels import Trial, measure, plane_in_view, refine
from sfmapp.dense.pyramid import frame_of, gray_pyramids, make_images, noise_deviation
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.dense.window import (
    HALF,
    REFERENCE,
    RHOS,
    SPREAD_PX,
    SUMS,
    WEIGHT,
    correlate,
    correlate_with_terms,
    make_scratch,
    read_reference,
    warp,
)
from sfmapp.geometry import rigid3
from sfmapp.simd.bilinear import pack_quads
from sfmapp.simd.pointers import offset, pointer

Array = NDArray[np.float64]
CONTRAST = 25.0
WINDOW = np.array([(x, y) for y in range(-HALF, HALF + 1) for x in range(-HALF, HALF + 1) if math.hypot(x, y) <= HALF])


@numba.njit
def _correlate(ref, ref_width, u, v, src, src_width, place, contrast, work):  # type: ignore[no-untyped-def]
    deviation = read_reference(pointer(ref), ref_width, u, v, contrast, pointer(work))
    x, y, xu, yu, xv, yv = place
    return deviation, correlate(pointer(src), src_width, x, y, xu, yu, xv, yv, pointer(work))


def correlation(ref: Any, u: int, v: int, src: Any, place: tuple[float, ...]) -> tuple[float, float, Any]:
    """Deviation of the window, NCC, scratch."""
    work = make_scratch()
    deviation, rho = _correlate(
        pack_quads(ref).ravel(), np.int32(ref.shape[1]), u, v, pack_quads(src).ravel(), np.int32(src.shape[1]),
        tuple(np.float32(value) for value in place), np.float32(CONTRAST), work,
    )  # fmt: skip
    return float(deviation), float(rho), work


def texture(seed: int, size: int = 64, cells: int = 12) -> NDArray[np.uint8]:
    values = 128 + 100 * textures.noise(np.random.default_rng(seed), size, cells, 2)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


@given(
    seed=st.integers(0, 1000),
    at=st.tuples(st.floats(12.0, 50.0), st.floats(12.0, 50.0)),
    turn=st.floats(-0.6, 0.6),
    zoom=st.floats(0.6, 1.5),
)
def test_ncc_is_that_of_the_weighted_windows(seed: int, at: tuple[float, float], turn: float, zoom: float) -> None:
    reference, source = texture(seed), texture(seed + 1)
    xu, yu, xv, yv = zoom * np.array([math.cos(turn), math.sin(turn), -math.sin(turn), math.cos(turn)])
    deviation, rho, work = correlation(reference, 30, 31, source, (*at, xu, yu, xv, yv))

    values = reference[31 + WINDOW[:, 1], 30 + WINDOW[:, 0]].astype(float)
    weight = np.array(work[WEIGHT : WEIGHT + len(WINDOW)], float)
    # the weights: falling with the distance and with the difference in grey, adding up to one
    difference = values - values[(WINDOW == 0).all(1)][0]
    expected = np.exp(-(WINDOW**2).sum(axis=1) / (2.0 * SPREAD_PX**2)) / (1.0 + (difference / CONTRAST) ** 2) ** 2
    np.testing.assert_allclose(weight, expected / expected.sum(), atol=1e-5)
    places = np.array(at) + WINDOW @ np.array([[xu, yu], [xv, yv]])
    samples = map_coordinates(source.astype(float), [places[:, 1], places[:, 0]], order=1)
    mean, other = weight @ values, weight @ samples
    assert deviation == pytest.approx(math.sqrt(weight @ (values - mean) ** 2), rel=1e-3, abs=0.02)
    spread = weight @ (samples - other) ** 2
    if spread > 1.0:
        expected = weight @ ((values - mean) * (samples - other)) / (deviation * math.sqrt(spread))
        assert rho == pytest.approx(expected, abs=2e-3)


def test_ncc_of_a_window_with_itself_is_one_whatever_the_exposure() -> None:
    image = texture(3)
    darker = np.rint(image * 0.5 + 20.0).astype(np.uint8)
    place = (30.0, 31.0, 1.0, 0.0, 0.0, 1.0)
    assert correlation(image, 30, 31, image, place)[1] == pytest.approx(1.0, abs=1e-5)
    # half the contrast, rounded: a variance of 1/12 beside that of the window
    assert correlation(image, 30, 31, darker, place)[1] > 0.995
    assert correlation(image, 30, 31, 255 - image, place)[1] == pytest.approx(-1.0, abs=1e-4)


def test_a_flat_window_correlates_with_nothing() -> None:
    flat = np.full((64, 64), 90, np.uint8)
    place = (30.0, 31.0, 1.0, 0.0, 0.0, 1.0)
    assert correlation(flat, 30, 31, texture(1), place)[0] == 0.0
    assert correlation(texture(1), 30, 31, flat, place)[1] == 0.0


# ---------------------------------------------------------------------------------------------------- planes and warps


def two_views(seed: int = 0) -> tuple[DenseScene, Images]:
    """Two cameras that look at the middle of the world from about 10 degrees apart."""
    rng = np.random.default_rng(seed)
    views = []
    for m in range(2):
        turn = np.array([0.02, 0.17 * (0.5 - m), 0.01 * m]) + 0.02 * rng.standard_normal(3)
        rotation = rigid3.exp_so3(turn)
        center = np.array([0.4 * (0.5 - m), 0.05 * m, -2.5])
        pose = rigid3.from_matrix(rotation, -rotation @ center)
        rgb = np.repeat(texture(seed + m, 128, 10)[:96, :, None], 3, axis=2)
        views.append(DenseView(str(m), rgb, None, np.array([120.0, 122.0, 64.3, 47.6]), pose))
    scene = DenseScene(
        tuple(views), np.array([[1], [0]], np.int32),
        np.array([[0.0, 0.0, 0.0]]), np.array([0, 2]), np.array([0, 1], np.int32),
    )  # fmt: skip
    return scene, make_images(scene, gray_pyramids(scene.views, 1, 1)[0], frame_of(scene), 1)


@numba.njit
def _plane(images, m, xyz, normal):  # type: ignore[no-untyped-def]
    return plane_in_view(image_pointers(images), m, pointer(xyz), pointer(normal))


@numba.njit
def _warp(images, m, u, v, w0, wx, wy):  # type: ignore[no-untyped-def]
    s = images.neighbors[m, 0]
    return warp(pointer(images.a[m]), pointer(images.b[m]), u, v, w0, wx, wy, images.width[s], images.height[s])


@given(
    seed=st.integers(0, 50),
    tilt=st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)),
    pixel=st.tuples(st.floats(40, 80), st.floats(35, 60)),
)
def test_a_plane_is_linear_in_inverse_depth_and_its_warp_is_the_projection(
    seed: int, tilt: tuple[float, float], pixel: tuple[float, float]
) -> None:
    scene, images = two_views(seed)
    frame = frame_of(scene)
    normal = np.array([*tilt, -1.0]) / np.linalg.norm([*tilt, -1.0])
    place = np.array([0.05, -0.03, 0.1])
    wu, wv, w = _plane(images, 0, ((place - frame.origin) * frame.scale).astype(np.float32), normal.astype(np.float32))

    def through(view: DenseView, index_pixel: Array) -> tuple[Array, float]:
        """Where the ray of a pixel meets the plane, and its depth."""
        ray = np.append((index_pixel + 0.5 - view.k[2:]) / view.k[:2], 1.0)
        rotation, t = rigid3.rotation_matrix(view.cam_from_world), view.cam_from_world[4:]
        depth = normal @ (place + rotation.T @ t) / (normal @ (rotation.T @ ray))
        return rotation.T @ (depth * ray - t), depth

    def seen(view: DenseView, xyz: Array) -> Array:
        camera = rigid3.rotation_matrix(view.cam_from_world) @ xyz + view.cam_from_world[4:]
        return camera[:2] / camera[2] * view.k[:2] + view.k[2:] - 0.5

    uv = np.array(pixel)
    _, depth = through(scene.views[0], uv)
    w0 = wu * uv[0] + wv * uv[1] + w
    assert w0 == pytest.approx(1.0 / (depth * frame.scale), rel=1e-4)

    inside, x, y, xu, yu, xv, yv, ex, ey = _warp(images, 0, *(np.float32(value) for value in (*uv, w0, wu, wv)))
    at, step = seen(scene.views[1], through(scene.views[0], uv)[0]), 0.01
    assert inside
    np.testing.assert_allclose([x, y], at, atol=2e-3)
    along_u = (seen(scene.views[1], through(scene.views[0], uv + np.array([step, 0]))[0]) - at) / step
    along_v = (seen(scene.views[1], through(scene.views[0], uv + np.array([0, step]))[0]) - at) / step
    np.testing.assert_allclose([xu, yu], along_u, atol=5e-3)
    np.testing.assert_allclose([xv, yv], along_v, atol=5e-3)
    ray = np.append((uv + 0.5 - scene.views[0].k[2:]) / scene.views[0].k[:2], 1.0)
    rotation, t = rigid3.rotation_matrix(scene.views[0].cam_from_world), scene.views[0].cam_from_world[4:]
    nearer = seen(scene.views[1], rotation.T @ (ray / ((1.001 * w0) * frame.scale) - t))
    np.testing.assert_allclose([ex * w0 * 0.001, ey * w0 * 0.001], nearer - at, atol=2e-3)


@numba.njit
def _terms(images, u, v, w0, wx, wy, contrast, work):  # type: ignore[no-untyped-def]
    pointers = image_pointers(images)
    scratch = pointer(work)
    read_reference(pointers.quads, pointers.width[0], u, v, contrast, scratch)
    s = np.int64(pointers.neighbors[0])
    uf, vf = np.float32(u), np.float32(v)
    _, x, y, xu, yu, xv, yv, ex, ey = warp(
        pointers.a, pointers.b, uf, vf, w0, wx, wy, pointers.width[s], pointers.height[s]
    )
    quads = offset(pointers.quads, pointers.start[s])
    return correlate_with_terms(quads, pointers.width[s], x, y, xu, yu, xv, yv, ex, ey, scratch)


@numba.njit
def _measured(images, u, v, w0, wx, wy, work):  # type: ignore[no-untyped-def]
    return measure(image_pointers(images), 0, 0, np.float32(u), np.float32(v), w0, wx, wy, pointer(work))


def test_the_right_hand_side_is_the_derivative_of_the_ncc() -> None:
    scene, images = two_views(5)
    work = make_scratch()
    u, v, w0 = 66, 48, np.float32(1.0 / (2.5 * frame_of(scene).scale))
    plane = np.array([w0, 0.001 * w0, -0.002 * w0], np.float32)
    rho = _terms(images, u, v, *plane, np.float32(CONTRAST), work)
    assert _measured(images, u, v, *plane, work) == pytest.approx(rho, abs=1e-5)
    gradient = np.array(work[SUMS + 6 : SUMS + 9], float)
    assert np.abs(gradient * w0).max() > 1.0
    # bilinear samples have kinks: steps within one pixel's square, and a mean over both sides
    for j, step in enumerate(w0 * np.array([2e-4, 1e-4, 1e-4])):
        ahead, behind = plane.copy(), plane.copy()
        ahead[j] += step
        behind[j] -= step
        slope = (_measured(images, u, v, *ahead, work) - _measured(images, u, v, *behind, work)) / (2.0 * step)
        assert gradient[j] == pytest.approx(slope, rel=0.05, abs=0.02 * np.abs(gradient).max())
    n = work[SUMS : SUMS + 6]
    matrix = np.array([[n[0], n[1], n[2]], [n[1], n[3], n[4]], [n[2], n[4], n[5]]])
    assert (np.linalg.eigvalsh(matrix) > 0.0).all()
    assert np.abs(work[REFERENCE : REFERENCE + len(WINDOW)].sum()) < 1e-4


# ---------------------------------------------------------------------------------------------------------- refinement


@numba.njit
def _refine(images, m, u, v, plane, num, limits, contrast, work):  # type: ignore[no-untyped-def]
    pointers = image_pointers(images)
    scratch = pointer(work)
    slot_array = np.arange(num)
    read_reference(offset(pointers.quads, pointers.start[m]), pointers.width[m], u, v, contrast, scratch)
    trial = Trial(pointer(plane), pointer(slot_array), offset(scratch, RHOS), scratch)
    n, sigma = refine(pointers, m, np.float32(u), np.float32(v), trial, num, limits)
    slot_array[0] = 0
    return n, sigma


def refined_wall(noise: float) -> tuple[Array, Array, float]:
    """Errors of inverse depth in pixels of the widest neighbour, the deviations said, and the share that came back."""
    scene, depths, surfaces = scene_of(wall_with_box_and_bars(), 7, noise)
    frame = frame_of(scene)
    images = make_images(scene, gray_pyramids(scene.views, 1, 1)[0], frame, 1)
    limits = Limits(3, 3, 0.7, 0.4, 4)
    errors, said, tried = [], [], 0
    for v in range(20, HEIGHT - 20, 9):
        for u in range(30, WIDTH - 30, 9):
            if len(np.unique(surfaces[3][v - 4 : v + 5, u - 4 : u + 5])) > 1:
                continue
            work = make_scratch()
            w = 1.0 / (float(depths[3][v, u]) * frame.scale)
            # a pixel between neighbours two steps apart is about so much inverse depth
            pixel = w / (FOCAL * 2.0 * math.radians(40.0) / 6.0)
            plane = np.array([w + 0.7 * pixel, 0.0, 0.0], np.float32)
            n, sigma = _refine(images, 3, u, v, plane, 4, limits, np.float32(CONTRAST), work)
            tried += 1
            if n >= 2:
                errors.append((float(plane[0]) - w) / pixel)
                said.append(float(sigma) / pixel)
    return np.array(errors), np.array(said), len(errors) / tried


def test_refinement_finds_the_surface_from_a_pixel_away() -> None:
    errors, _, share = refined_wall(0.0)
    assert share > 0.8
    assert np.median(np.abs(errors)) < 0.05
    assert np.quantile(np.abs(errors), 0.9) < 0.25


def test_the_deviation_that_is_said_is_the_error_that_is_made() -> None:
    errors, said, _ = refined_wall(4.0)
    ratio = errors / said
    # the middle of the distribution: the tails are other minima
    spread = np.subtract(*np.quantile(ratio, [0.84, 0.16])) / 2.0
    assert 0.5 < spread < 2.0


@pytest.mark.parametrize("noise", [1.0, 3.0, 8.0])
def test_noise_is_told_from_texture(noise: float) -> None:
    rng = np.random.default_rng(0)
    image = texture(2, 256, 8).astype(float) * 0.6 + 40.0
    measured = noise_deviation(np.rint(image + noise * rng.standard_normal(image.shape)).astype(np.uint8))
    assert 0.85 * noise < measured < 1.3 * noise
