"""Corners: where they are, how many of them, how far apart, and none in noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.odometry.frontend.corners import find_corners
from sfmapp.odometry.frontend.pyramid import build_pyramid

NONE = np.empty((0, 2))


def blobs(centres: NDArray[np.float64], shape: tuple[int, int], height: float = 80.0) -> NDArray[np.uint8]:
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    image = np.full(shape, 90.0)
    for u, v in centres:
        image += height * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * 2.0**2))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def test_blobs_are_found_where_they_are() -> None:
    rng = np.random.default_rng(0)
    centres = np.array([(x, y) for x in range(20, 200, 30) for y in range(20, 130, 30)]) + rng.uniform(-1, 1, (24, 2))
    found = find_corners(blobs(centres, (140, 200)), NONE, 100, min_distance_px=12)
    assert len(found) == 24
    nearest = np.linalg.norm(found[:, None] - centres, axis=2)
    assert nearest.min(axis=1).max() < 0.25
    assert len(np.unique(nearest.argmin(axis=1))) == 24


def test_noise_and_plain_images_have_no_corners() -> None:
    for noise in (0.0, 0.5, 1.0, 2.0):
        image = np.random.default_rng(1).normal(120, noise, (240, 320)) if noise else np.full((240, 320), 120.0)
        found = find_corners(np.rint(image).astype(np.uint8), NONE, 500, min_distance_px=8)
        assert len(found) <= 2, noise  # of 1500 places


def test_edges_are_no_corners() -> None:
    y, x = np.mgrid[:200, :300] + 0.5
    ramp = np.clip(np.rint(120 + 80 * np.tanh((x + 0.3 * y - 150) / 2)), 0, 255).astype(np.uint8)
    corner = np.where((x > 150) & (y > 100), 180, 60).astype(np.uint8)
    assert len(find_corners(corner, NONE, 100, min_distance_px=8)) == 1
    at_corner = find_corners(corner, NONE, 1, min_distance_px=8)[0]
    assert np.abs(at_corner - (150, 100)).max() < 3
    assert len(find_corners(ramp, NONE, 100, min_distance_px=8)) <= 2


def test_weak_texture_gets_corners_before_strong_texture_gets_more() -> None:
    rng = np.random.default_rng(2)
    left = np.array([(x, y) for x in range(20, 150, 14) for y in range(20, 180, 14)], np.float64)
    strong = blobs(left, (200, 320), 120).astype(np.float64)
    weak = blobs(left + np.array([150, 0]), (200, 320), 14).astype(np.float64) - 90
    image = np.clip(np.rint(strong + weak + rng.normal(0, 0.7, strong.shape)), 0, 255).astype(np.uint8)
    found = find_corners(image, NONE, 80, min_distance_px=8)
    assert 0.3 < (found[:, 0] > 155).mean() < 0.7
    # tracks on the left: all new ones go to the right
    tracks = find_corners(image, NONE, 300, min_distance_px=8)
    tracks = tracks[tracks[:, 0] < 150]
    new = find_corners(image, tracks, 30, min_distance_px=8)
    assert (new[:, 0] > 150).mean() > 0.9


def test_distances_masks_numbers_and_borders_are_kept() -> None:
    rng = np.random.default_rng(3)
    image = rng.integers(0, 256, (150, 210), dtype=np.uint8)
    tracks = rng.uniform(-20, 230, (40, 2))
    mask = np.zeros(image.shape, bool)
    mask[30:120, 50:180] = True
    for wanted in (1, 20, 10_000):
        found = find_corners(build_pyramid(image), tracks, wanted, min_distance_px=7.5, mask=mask)
        assert 0 < len(found) <= wanted
        both = np.concatenate([found, tracks])
        apart = np.linalg.norm(found[:, None] - both, axis=2)
        apart[np.arange(len(found)), np.arange(len(found))] = np.inf
        assert apart.min() >= 7.5
        assert mask[found[:, 1].astype(int), found[:, 0].astype(int)].all()
    everywhere = find_corners(image, NONE, 10_000, min_distance_px=2)
    assert everywhere.min() >= 9
    assert (everywhere <= np.array([210, 150]) - 9).all()


@pytest.mark.parametrize("shape", [(1, 1), (10, 200), (20, 21), (21, 22)])
def test_small_images_are_safe(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(4).integers(0, 256, shape, dtype=np.uint8)
    assert find_corners(image, NONE, 10, min_distance_px=5).shape[1] == 2
    assert find_corners(image, NONE, 0, min_distance_px=5).shape == (0, 2)


@pytest.mark.real
def test_real_corners_are_those_of_opencv_and_few_in_the_sky(data_root: Path) -> None:
    import cv2

    path = data_root / "kitti00-200" / "image_0" / "000050.jpg"
    if not path.is_file():
        pytest.skip(f"no {path}")
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    pyramid = build_pyramid(image)
    found = find_corners(pyramid, NONE, 2000, min_distance_px=5)
    theirs = cv2.goodFeaturesToTrack(image, 100, 0.01, 10, blockSize=7)[:, 0] + 0.5
    theirs = theirs[((theirs > 10) & (theirs < (1231, 366))).all(axis=1)]
    assert (np.linalg.norm(theirs[:, None] - found, axis=2).min(axis=1) < 5.5).mean() > 0.95
    sky = (found[:, 0] > 470) & (found[:, 0] < 600) & (found[:, 1] < 60)
    # 290 maxima of noise there exceed what rounding makes, and compression has taken two thirds off its roughness
    assert sky.sum() <= 45
    assert np.array_equal(found, find_corners(pyramid, NONE, 2000, min_distance_px=5))
    assert np.array_equal(found[:100], find_corners(pyramid, NONE, 2000, min_distance_px=5)[:100])
