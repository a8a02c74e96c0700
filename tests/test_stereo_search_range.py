"""Which disparities are searched: keypoints on what is far do not hide what is near."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.stereo.options import StereoOptions
from sfmapp.stereo.result import RectifiedGeometry, RectifiedPair
from sfmapp.stereo.search_range import search_range
from sfmapp.stereo.sparse_matches import PairMatches

SIZE = (200, 640)


def _texture(seed: int) -> NDArray[np.float32]:
    drawn = np.random.default_rng(seed).uniform(-900, 1155, SIZE).astype(np.float32)
    return cv2.GaussianBlur(drawn, (0, 0), 2.5)


def _pair(truth: NDArray[np.float64] | None) -> RectifiedPair:
    """Of a surface with these disparities, or unrelated pictures."""
    right = _texture(1)
    if truth is None:
        left = _texture(2)
    else:
        x, y = np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0]))
        left = cv2.remap(right, (x - truth).astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC)
    everywhere = np.ones(SIZE, bool)
    geometry = RectifiedGeometry(SIZE[1], SIZE[0], 600.0, 320.0, 100.0, 0.0, 0.2, "m")
    pictures = [np.clip(picture, 0, 255).astype(np.uint8) for picture in (left, right)]
    return RectifiedPair(*pictures, everywhere, everywhere, geometry)


def _matches(disparities: NDArray[np.float64]) -> PairMatches:
    left = np.stack([np.full(len(disparities), 300.0), np.linspace(5, 195, len(disparities))], 1)
    return PairMatches(left, left - np.stack([disparities, np.zeros(len(disparities))], 1))


@pytest.mark.parametrize("num_matches", [0, 60])
def test_what_is_near_is_searched_though_no_keypoint_lies_on_it(num_matches: int) -> None:
    x = np.arange(SIZE[1])[None] + np.zeros((SIZE[0], 1))
    truth = 3.0 + 0.2 * x
    (first, count), told_by = search_range(_pair(truth), StereoOptions(), _matches(np.linspace(4, 40, num_matches)))
    visible = truth[x - truth > 0]
    # by keypoints alone 0.38 of it, by the width of the picture 0.61
    assert np.mean((visible >= first) & (visible < first + count)) > 0.99
    assert -2 <= first <= 3
    assert count < 200
    assert "the pair matched when small" in told_by


def test_unrelated_pictures_tell_no_range() -> None:
    told = search_range(_pair(None), StereoOptions(), _matches(np.linspace(10, 30, 50)))
    # a fifth of the range, or eight pixels, on both sides
    assert told == ((2, 36), "50 sparse matches")
    assert search_range(_pair(None), StereoOptions(), _matches(np.zeros(0))) == ((0, 80), "the width of the picture")


def test_options_go_first() -> None:
    options = StereoOptions(min_disparity=-7, num_disparities=33)
    assert search_range(_pair(None), options) == ((-7, 33), "options")
