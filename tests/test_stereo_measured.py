"""Errors of disparities, and what is made of a measured pair."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfmapp.formats.glb import write_glb
from sfmapp.report.stereo_pictures import ColorScale, anaglyph, scale_of
from sfmapp.stereo.disparity_error import CUES, RESIDUAL_SHARE, disparity_error, match_cues
from sfmapp.stereo.error_table import ERROR_TABLE
from sfmapp.stereo.filled_error import FILLED_CUES, FILLED_TABLE
from sfmapp.stereo.match import match_pair
from sfmapp.stereo.measured import cloud_of, measure_pair, mesh_of, report_of
from sfmapp.stereo.options import StereoOptions
from sfmapp.stereo.result import DisparityMap, PixelState, RectifiedGeometry, RectifiedPair

WIDTH, HEIGHT = 320, 300
GEOMETRY = RectifiedGeometry(WIDTH, HEIGHT, 400.0, 160.0, 150.0, baseline=0.1, unit="m")


def drawn_pair(noise: float, shift: float = 20.4) -> tuple[RectifiedPair, np.ndarray]:
    """A slanted wall, and the disparities of the left picture."""
    rng = np.random.default_rng(5)
    texture = cv2.GaussianBlur(rng.normal(0.0, 60.0, (HEIGHT, WIDTH + 200)), (0, 0), 1.5).astype(np.float32) * 3 + 128
    x, y = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    disparity = (shift + 0.02 * (y - 150.0)).astype(np.float32)
    # the left picture shows the texture moved: what is at x there is at x - d in the right one
    left = cv2.remap(texture, x + 100.0 - disparity, y, cv2.INTER_CUBIC)
    right = texture[:, 100 : 100 + WIDTH]
    pictures = [
        np.clip(picture + rng.normal(0.0, noise, picture.shape), 0, 255).astype(np.uint8) for picture in (left, right)
    ]
    shown = np.ones(disparity.shape, np.bool_)
    return RectifiedPair(pictures[0], pictures[1], shown, shown, GEOMETRY), disparity


def as_map(disparity: np.ndarray) -> DisparityMap:
    state = np.where(np.isfinite(disparity), PixelState.MATCHED, PixelState.UNKNOWN).astype(np.uint8)
    blank = np.full(disparity.shape, np.nan, np.float32)
    return DisparityMap(disparity.astype(np.float32), state, blank, blank, blank, (0.0, 64.0), {"matcher": "drawn"})


def test_scores_of_the_table_ascend_with_the_errors_that_they_mean() -> None:
    assert (np.diff(ERROR_TABLE.scores) > 0).all()
    assert (np.diff(ERROR_TABLE.sigmas) >= 0).all()
    assert (np.diff(ERROR_TABLE.half_widths_95) >= 0).all()
    assert (np.diff(ERROR_TABLE.confidences) <= 0).all()
    assert (np.array(ERROR_TABLE.half_widths_95) > np.array(ERROR_TABLE.sigmas)).all()
    assert len(ERROR_TABLE.weights) == 1 + len(CUES) * (len(CUES) + 3) // 2


def test_noise_makes_sigma_larger_and_wrong_disparities_lose_confidence() -> None:
    (clear, truth), (noisy, _) = drawn_pair(2.0), drawn_pair(14.0)
    sigma = [np.nanmedian(disparity_error(pair, as_map(truth)).sigma) for pair in (clear, noisy)]
    assert sigma[0] < 0.7 * sigma[1]
    wrong = truth.copy()
    wrong[100:140, 100:140] += 6.0
    confidence = disparity_error(clear, as_map(wrong)).confidence
    assert np.median(confidence[105:135, 105:135]) < 0.6 < 0.95 < np.median(confidence[:80, 80:])


def test_bands_make_no_difference() -> None:
    pair, truth = drawn_pair(3.0)
    holed = np.where(np.random.default_rng(1).random(truth.shape) < 0.1, np.nan, truth)
    found = as_map(holed)  # 300 rows: two bands
    told = disparity_error(pair, found, threads=2)
    cues, known = match_cues(pair, found)
    sigma, _, confidence = ERROR_TABLE.read(cues[:, known])
    np.testing.assert_array_equal(known, np.isfinite(told.sigma))
    # box filters sum along columns in an order that depends on where they begin
    np.testing.assert_allclose(told.sigma[known], np.hypot(sigma, RESIDUAL_SHARE * WIDTH), rtol=1e-4)
    np.testing.assert_allclose(told.confidence[known], confidence, atol=1e-4)
    assert (told.confidence[~known] == 0.0).all()


def test_the_covariance_of_a_calibration_is_in_depth_alone() -> None:
    pair, truth = drawn_pair(3.0)
    covariance = np.diag([0.0, 0.0, 0.3**2])
    known = replace(pair, geometry=replace(GEOMETRY, covariance=covariance))
    with_it, without = measure_pair(known, as_map(truth)), measure_pair(pair, as_map(truth))
    np.testing.assert_array_equal(with_it.error.sigma, without.error.sigma)
    expected = without.depth / truth * np.hypot(without.error.sigma, 0.3)
    np.testing.assert_allclose(with_it.depth_sigma, expected, rtol=1e-4)


def test_filled_pixels_are_less_sure_in_no_cloud_and_not_among_matches() -> None:
    pair, truth = drawn_pair(3.0)
    found = as_map(truth)
    found.state[50:60] = PixelState.FILLED
    told = measure_pair(pair, found)
    assert np.isfinite(told.error.sigma[50:60]).all()
    matched = np.median(told.error.sigma[found.state == PixelState.MATCHED])
    assert np.median(told.error.sigma[50:60]) > 1.3 * matched
    assert report_of(pair, found, told).median_sigma_px == pytest.approx(float(matched))
    assert np.isfinite(told.depth[50:60]).all()
    assert not told.is_solid[50:60].any()


def test_cloud_and_mesh_lie_on_the_wall_and_the_square_is_apart(tmp_path: Path) -> None:
    pair, truth = drawn_pair(3.0)
    truth[100:180, 120:200] += 15.0  # nothing in the pictures says so: confidence is put in by hand
    found = as_map(truth)
    measured = measure_pair(pair, found)
    measured = replace(measured, is_solid=np.isfinite(truth))
    xyz, rgb = cloud_of(pair, measured)
    assert xyz.shape == rgb.shape == (WIDTH * HEIGHT, 3)
    np.testing.assert_allclose(xyz[:, 2], 40.0 / truth.ravel(), rtol=1e-5)
    mesh = mesh_of(pair, found, measured)
    edges = mesh.xyz[mesh.faces]
    assert np.ptp(40.0 / edges[:, :, 2], axis=1).max() < 1.0  # no triangle joins square and wall
    # the cells round the square are open, but for half of those at two of its corners
    assert len(mesh.faces) == 2 * ((HEIGHT - 1) * (WIDTH - 1) - 81 * 81 + 79 * 79) + 2
    assert ((mesh.normal * mesh.xyz).sum(1) < 0).all()  # towards the camera
    np.testing.assert_allclose(mesh.uv[:, 0] * WIDTH, 400.0 * mesh.xyz[:, 0] / mesh.xyz[:, 2] + 160.0, atol=1e-3)
    write_glb(tmp_path / "view.glb", mesh)
    assert (tmp_path / "view.glb").stat().st_size > 1_000_000


def test_depths_of_a_report_go_from_near_to_far() -> None:
    pair, truth = drawn_pair(3.0)
    measured = measure_pair(pair, as_map(truth))
    told = report_of(pair, as_map(truth), measured)
    depths = [at.depth for at in told.depths]
    assert depths == sorted(depths)
    assert told.least_depth == 40.0 / 64.0
    assert told.greatest_depth > told.ten_percent_depth > max(depths)
    assert told.expected_right > 0.95
    for at in told.depths:
        assert at.sigma == pytest.approx(at.depth / at.disparity_px * at.disparity_sigma_px, rel=1e-4)
        assert at.of_calibration == 0.0
    without = replace(pair, geometry=replace(GEOMETRY, baseline=None))
    told = report_of(without, as_map(truth), measure_pair(without, as_map(truth)))
    assert "least_depth" not in told
    assert not told.depths


def test_an_anaglyph_coincides_where_disparity_is_its_shift() -> None:
    pair, _ = drawn_pair(0.0)
    flat = replace(pair, right=np.roll(pair.left, -20, axis=1))
    glasses = anaglyph(flat, 20)
    np.testing.assert_array_equal(glasses[:, 20:, 0], glasses[:, 20:, 1])
    assert not glasses[:, :20].any()
    assert not anaglyph(flat, -400).any()


def test_colours_go_from_end_to_end_and_unknown_is_grey() -> None:
    scale = scale_of(np.array([1.0, 10.0, 100.0, np.nan]), is_log=True)
    assert scale == ColorScale(pytest.approx(1.18), pytest.approx(98.2), True)
    colors = scale.colors(np.array([scale.low, np.sqrt(scale.low * scale.high), scale.high, np.nan]))
    expected = cv2.applyColorMap(np.array([[0, 128, 255]], np.uint8), cv2.COLORMAP_TURBO)[0, :, ::-1]
    np.testing.assert_array_equal(colors[:3], expected)
    assert tuple(colors[3]) == (52, 54, 58)
    reversed_colors = replace(scale, is_reversed=True).colors(np.array([scale.high, scale.low, np.nan]))
    np.testing.assert_array_equal(reversed_colors, colors[[0, 2, 3]])


@pytest.mark.real
@pytest.mark.parametrize("name", ["motorcycle", "cones", "aloe"])
def test_true_errors_are_inside_as_often_as_it_is_told(data_root: Path, name: str) -> None:
    pairs = pytest.importorskip("stereo_pairs", reason="benchmarks/ is not part of an installed package")
    case = next((case for case in pairs.shared_sets(data_root) if case.name == name), None)
    if case is None:
        pytest.skip(f"{name} is not there")
    low, count = case.search
    found = match_pair(case.pair, StereoOptions(min_disparity=low, num_disparities=count))
    # no photograph had a part in the fit; truth is rounded to quarters of a pixel, and to whole ones
    rounding = {"cones": 0.25, "aloe": 1.0}.get(name, 0.0) / 12**0.5
    told = disparity_error(case.pair, found, threads=2)
    error = np.abs(found.disparity - case.truth)
    counted = np.isfinite(error)
    inside_68 = error[counted] <= np.hypot(told.sigma, rounding)[counted]
    inside_95 = error[counted] <= np.hypot(told.half_width_95, 1.96 * rounding)[counted]
    assert 0.60 < inside_68.mean() < 0.76
    assert 0.92 < inside_95.mean() < 0.97
    assert abs(told.confidence[counted].mean() - (error[counted] < 1.0).mean()) < 0.04


def filled_map(first: int, last: int, nearer: float) -> DisparityMap:
    """A wall, and from column ``last`` on something ``nearer``; what is before it was not matched."""
    disparity = np.full((60, 160), 12.0, np.float32)
    disparity[:, last:] += nearer
    found = as_map(disparity)
    found.state[:, first:last] = PixelState.FILLED
    return found


def test_filled_disparities_are_the_less_sure_the_wider_their_hole_and_the_farther_apart_its_ends() -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (60, 160), dtype=np.uint8)
    shown = np.ones(picture.shape, np.bool_)
    pair = RectifiedPair(picture, picture, shown, shown)
    narrow, wide, step = (
        disparity_error(pair, filled_map(*of)) for of in ((77, 80, 0.0), (40, 80, 0.0), (70, 80, 10.0))
    )
    for error, first in ((narrow, 77), (wide, 40), (step, 70)):
        hole = np.s_[:, first:80]
        assert np.isfinite(error.sigma).all()
        assert (error.half_width_95[hole] > error.sigma[hole]).all()
        assert ((error.confidence[hole] > 0.0) & (error.confidence[hole] < 1.0)).all()
    assert narrow.sigma[:, 78].max() < 0.7 * wide.sigma[:, 60].min()
    assert narrow.half_width_95[:, 78].max() < 0.5 * step.half_width_95[:, 78].min()
    # the other side of the step is within the interval
    assert step.half_width_95[:, 78].min() > 5.0
    assert len(FILLED_TABLE.sigma) == 1 + len(FILLED_CUES)
