"""Pairs that show nothing in common are named; true ones are not, however noisy, dim or plain."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.stereo.checks import largest_patch
from sfmapp.stereo.match import match_pair
from sfmapp.stereo.options import StereoOptions
from sfmapp.stereo.result import DisparityMap, PixelState, RectifiedPair

HEIGHT, WIDTH, SHIFT = 240, 320, 14
OPTIONS = StereoOptions(min_disparity=0, num_disparities=64)


def texture(seed: int, blur: float) -> NDArray[np.float64]:
    """(H, W + SHIFT) of deviation one."""
    drawn = np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH + SHIFT))
    drawn = cv2.GaussianBlur(drawn, (0, 0), blur) if blur else drawn
    return np.asarray(drawn / drawn.std(), np.float64)


def told(left: NDArray[np.float64], right: NDArray[np.float64], noise: float = 0.0) -> str | None:
    rng, shown = np.random.default_rng(99), np.ones(left.shape, np.bool_)
    pictures = [
        np.clip(np.rint(120.0 + picture + noise * rng.standard_normal(picture.shape)), 0, 255).astype(np.uint8)
        for picture in (left, right)
    ]
    found = match_pair(RectifiedPair(pictures[0], pictures[1], shown, shown), OPTIONS)
    text = found.info.get("chance")
    return None if text is None else str(text)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("blur", [0.0, 1.5, 4.0])
def test_two_pictures_of_noise_do_not_show_the_same(blur: float, seed: int) -> None:
    one, other = (40.0 * texture(2 * seed + side, blur)[:, SHIFT:] for side in (0, 1))
    assert "do not show the same" in (told(one, other) or "")


@pytest.mark.parametrize("noise", [2.0, 20.0, 60.0])
@pytest.mark.parametrize("seed", range(2))
def test_what_noise_hides_is_still_the_same(noise: float, seed: int) -> None:
    drawn = 40.0 * texture(seed, 1.5)
    assert told(drawn[:, :WIDTH], drawn[:, SHIFT:], noise) is None


def test_a_plain_wall_with_a_poster_is_the_same() -> None:
    drawn = 40.0 * texture(5, 1.5)
    drawn[:80], drawn[150:], drawn[:, :100], drawn[:, 190:] = 0.0, 0.0, 0.0, 0.0
    assert told(drawn[:, :WIDTH], drawn[:, SHIFT:], 0.5) is None


@pytest.mark.parametrize("seed", range(2))
def test_edges_that_all_run_up_and_down_are_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    row = np.cumsum(np.where(rng.random(WIDTH + SHIFT) < 0.03, rng.normal(0.0, 40.0, WIDTH + SHIFT), 0.0))
    drawn = np.tile(np.clip(row - row.mean(), -100.0, 100.0), (HEIGHT, 1))
    assert told(drawn[:, :WIDTH], drawn[:, SHIFT:], 1.0) is None


@pytest.mark.parametrize("blur", [0.0, 1.5, 4.0])
def test_a_patch_in_pictures_of_noise_is_the_same(blur: float) -> None:
    own, other, both = (40.0 * texture(seed, blur) for seed in (7, 8, 9))
    place = slice(90, 140), slice(200, 250)  # 3 % of the picture
    own[place] = other[place] = both[place]
    assert told(own[:, :WIDTH], other[:, SHIFT:]) is None


def test_a_fence_shows_the_same_on_its_head() -> None:
    bars = 40.0 * np.sign(np.sin(np.arange(WIDTH + SHIFT) * (2.0 * np.pi / 20.0)))
    drawn = np.tile(bars, (HEIGHT, 1))
    assert told(drawn[:, :WIDTH], drawn[:, SHIFT:], 5.0) is None


def test_the_largest_patch_ends_at_steps_and_holes() -> None:
    disparity = np.full((6, 10), 3.0, np.float32)
    disparity[:, 4:] = 5.0
    disparity[2] = np.nan
    disparity[3:, 4:] += np.arange(6, dtype=np.float32)  # a slope of one is no step
    state = np.where(np.isfinite(disparity), np.uint8(PixelState.MATCHED), np.uint8(PixelState.UNKNOWN))
    state[0] = PixelState.FILLED
    zero = np.zeros_like(disparity)
    found = DisparityMap(disparity, state.astype(np.uint8), zero, zero, zero, (0.0, 16.0))
    # of 3 rows and 6 columns, less the first, which lies on the step
    assert largest_patch(found) == 15
