"""Objects before a sheet that is smooth but unevenly lit."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.carve.smooth_backgrounds import cut_from_smooth

HEIGHT, WIDTH = 150, 200
NOISE = 3.0
GAP = np.s_[52:68, 76:94]


def sheet(seed: int) -> NDArray[np.float32]:
    """(H, W) grey levels of a sheet in light that changes over it."""
    light = np.random.default_rng(seed).uniform(100, 160, (4, 4)).astype(np.float32)
    return cv2.resize(light, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def before(background: NDArray[np.float32], seed: int) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A photograph of a striped block with a gap, and what shows it."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    mask = (abs(x - 100) < 45) & (abs(y - 75) < 45) & ~((abs(x - 85) < 12) & (abs(y - 60) < 10))
    color = np.stack([np.where((x // 9) % 2, 200, 60), np.where((y // 7) % 2, 170, 90), np.full_like(x, 60)], axis=-1)
    cover = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.5)[..., None]
    picture = color * cover + background[..., None] * (1.0 - cover)
    picture = picture + np.random.default_rng(seed).normal(0.0, NOISE, picture.shape)
    return np.clip(picture.round(), 0, 255).astype(np.uint8), mask


def agreement(found: NDArray[np.bool_], true: NDArray[np.bool_]) -> float:
    return float((found & true).sum() / (found | true).sum())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_edges_and_gaps_are_told_by_what_is_smooth_around(seed: int) -> None:
    picture, true = before(sheet(seed), seed)
    # a mask that lacks a strip at one side, goes too far at another, and knows no gap
    rough = np.zeros_like(true)
    rough[31:125, 60:145] = True
    assert agreement(rough, true) < 0.87
    found = cut_from_smooth(picture, rough)
    assert agreement(found, true) > 0.985
    assert not found[GAP].any()


def test_before_clutter_a_mask_is_left_alone() -> None:
    drawn = np.random.default_rng(5).uniform(0, 255, (30, 40)).astype(np.float32)
    picture, true = before(cv2.resize(drawn, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR), 5)
    assert np.array_equal(cut_from_smooth(picture, true), true)


def test_a_mask_of_nothing_and_of_all_is_left_alone() -> None:
    picture, true = before(sheet(1), 1)
    for mask in (np.zeros_like(true), np.ones_like(true)):
        assert np.array_equal(cut_from_smooth(picture, mask), mask)
