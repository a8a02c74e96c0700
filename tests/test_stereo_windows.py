"""Window matching: all costs and kinds of windows against plain sums, exact shifts, what cannot be told, checks."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.stereo.checks import beside_steps, fill_holes, without_speckles
from sfmapp.stereo.costs import census
from sfmapp.stereo.match import match_pair
from sfmapp.stereo.options import CostName, StereoOptions, WindowsName
from sfmapp.stereo.result import PixelState, RectifiedPair
from sfmapp.stereo.windows import best_disparities, window_sides

NAN = np.nan
Grey = NDArray[np.uint8]


def texture(height: int, width: int, shift: NDArray[np.float64], seed: int = 1) -> NDArray[np.float64]:
    """(H, W) of a random periodic texture, each row moved to the right by its own number of pixels, exactly."""
    rng = np.random.default_rng(seed)
    frequency = np.fft.rfftfreq(width)
    spectrum = np.fft.rfft(rng.standard_normal((height, width)), axis=1) * np.exp(-((frequency / 0.16) ** 2))
    moved = np.fft.irfft(spectrum * np.exp(-2j * np.pi * frequency * shift[:, None]), width, axis=1)
    return np.asarray(40.0 * moved / moved.std() + 120.0, np.float64)


def eight_bits(values: NDArray[np.float64], noise: float = 0.0, seed: int = 0) -> Grey:
    values = values + noise * np.random.default_rng(seed).standard_normal(values.shape)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def pair_of(left: Grey, right: Grey) -> RectifiedPair:
    shown = np.ones(left.shape, np.bool_)
    return RectifiedPair(left, right, shown, shown)


def plain_costs(left: Grey, right: Grey, d: int, cost: CostName, side: int) -> NDArray[np.float64]:
    """(H, W) mean costs of windows at one disparity, by sums over shifted pictures."""
    height, width = left.shape
    radius, rows = side // 2, np.arange(height)[:, None]
    columns = np.arange(width)[None]
    words = [census(picture) for picture in (left, right)]
    values = [picture.astype(np.float64) for picture in (left, right)]
    parts = []
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            y, x = np.clip(rows + dy, 0, height - 1), np.clip(columns + dx, 0, width - 1)
            there = np.clip(columns + dx - d, 0, width - 1)
            if cost == "census":
                parts.append([np.bitwise_count(words[0][y, x] ^ words[1][y, there])])
            else:
                parts.append([values[0][y, x], values[1][y, there]])
    sums = np.array(parts, np.float64)
    if cost == "census":
        return np.asarray(sums[:, 0].mean(0))
    left_values, right_values = sums[:, 0], sums[:, 1]
    if cost == "zncc":
        covariance = ((left_values - left_values.mean(0)) * (right_values - right_values.mean(0))).mean(0)
        power = (left_values.var(0) + 1 / 12) * (right_values.var(0) + 1 / 12)
        return np.asarray(1.0 - covariance / np.sqrt(power))
    apart = np.abs(left_values - right_values)
    return np.asarray((apart if cost == "sad" else apart**2).mean(0))


def least_moved(costs: NDArray[np.float64], moved: int) -> NDArray[np.float64]:
    height, width = costs.shape
    rows, columns = np.arange(height)[:, None], np.arange(width)[None]
    places = [
        costs[np.clip(rows + dy, 0, height - 1), np.clip(columns + dx, 0, width - 1)]
        for dy in (-moved, 0, moved)
        for dx in (-moved, 0, moved)
    ]
    return np.asarray(np.min(places, axis=0))


@pytest.mark.parametrize(
    ("cost", "windows"),
    [("census", "fixed"), ("zncc", "fixed"), ("sad", "fixed"), ("ssd", "fixed"), ("census", "nested"),
     ("sad", "adaptive"), ("census", "shiftable"), ("zncc", "nested")],
)  # fmt: skip
def test_costs_are_those_of_plain_sums(cost: CostName, windows: WindowsName) -> None:
    rng = np.random.default_rng(5)
    first, num = -3, 9
    left = eight_bits(rng.normal(120, 40, (21, 40)))
    right = eight_bits(np.roll(left, -2, 1) + rng.normal(0, 25, left.shape))
    options = StereoOptions(matcher="window", cost=cost, windows=windows, window=5, left_right_px=1e3)
    sides = window_sides(options)
    volume = np.empty((num, *left.shape))
    for n in range(num):
        each = [plain_costs(left, right, first + n, cost, side) for side in sides]
        volume[n] = np.mean(each, 0) if windows != "adaptive" else np.min(each, 0)
        if windows == "shiftable":
            volume[n] = least_moved(volume[n], sides[0] // 2)
    place = np.arange(left.shape[1]) - np.arange(first, first + num)[:, None]
    volume[np.broadcast_to(((place < 0) | (place >= left.shape[1]))[:, None], volume.shape)] = np.inf
    found = best_disparities(left, right, (first, num), options)
    np.testing.assert_allclose(found.cost, volume.min(0), rtol=1e-3, atol=1e-4)
    best = volume.argmin(0)
    ordered = np.sort(volume, 0)
    clear = ordered[1] - ordered[0] > 1e-3 * ordered[1] + 1e-4
    assert clear.mean() > 0.9
    whole = np.rint(found.disparity + 1e-3 * np.sign(first + best - found.disparity))
    assert (np.abs(found.disparity - first - best)[clear] <= 0.5).all()
    assert (whole == first + best)[clear].mean() > 0.95
    apart = np.abs(np.arange(num)[:, None, None] - best) > 1
    second = np.maximum(np.where(apart, volume, np.inf).min(0), 1e-9)
    np.testing.assert_allclose(found.uniqueness[clear], (1.0 - volume.min(0) / second)[clear], atol=2e-3)


def test_the_census_has_a_bit_for_each_brighter_neighbour() -> None:
    picture = np.random.default_rng(2).integers(0, 256, (12, 15)).astype(np.uint8)
    padded = np.pad(picture, ((3, 3), (4, 4)), mode="edge")
    count = np.zeros(picture.shape, np.int64)
    for dy in range(7):
        for dx in range(9):
            if (dy + dx) % 2 == 0:
                count += padded[dy : dy + 12, dx : dx + 15] > picture
    np.testing.assert_array_equal(np.bitwise_count(census(picture)), count)
    np.testing.assert_array_equal(census(picture // 2), census(picture // 2 + 100))  # light does not matter


@pytest.mark.parametrize("disparity", [-7, 0, 6])
def test_exact_shifts_on_both_sides_of_zero(disparity: int) -> None:
    rows = np.zeros(40)
    left, right = eight_bits(texture(40, 128, rows)), eight_bits(texture(40, 128, rows - disparity))
    found = match_pair(pair_of(left, right), StereoOptions(matcher="window", min_disparity=-16, num_disparities=32))
    inner = found.disparity[:, 30:-30]
    assert np.isfinite(inner).mean() > 0.99
    error = inner[np.isfinite(inner)] - disparity
    assert np.sqrt((error**2).mean()) < 0.02  # what is to the left and to the right of an edge is not alike
    assert np.abs(error).max() < 0.1
    assert found.searched == (-16.0, 15.0)
    # what lies beyond the right picture is not said to be seen there
    place = np.arange(128) + 0.5 - found.disparity
    assert ((place >= 0) & (place <= 128))[np.isfinite(found.disparity)].all()


@pytest.mark.parametrize("cost", ["census", "sad"])
def test_disparities_are_not_drawn_to_whole_pixels(cost: CostName) -> None:
    shift = np.arange(80) / 40.0 + 4.0
    left, right = eight_bits(texture(80, 256, 0 * shift), 1.0, 1), eight_bits(texture(80, 256, -shift), 1.0, 2)
    # rows differ in their disparity, and each is of a texture of its own: windows of one row
    options = StereoOptions(matcher="window", cost=cost, windows="fixed", window=1)
    wide = [np.repeat(picture, 9, axis=0) for picture in (left, right)]
    found = best_disparities(wide[0], wide[1], (0, 16), StereoOptions(**{**vars(options), "window": 9}))
    error = (found.disparity[4::9] - shift[:, None])[:, 20:-20]
    near = np.abs(error) < 0.5
    assert near.mean() > 0.9
    by_fraction = [error[k::40][near[k::40]].mean() for k in range(40)]
    assert np.abs(by_fraction).max() < 0.06
    fractions = np.histogram((found.disparity[4::9][:, 20:-20][near]) % 1.0, 8, (0, 1))[0] / near.sum()
    assert fractions.min() > 0.08
    assert fractions.max() < 0.18


def test_nothing_is_said_of_what_has_no_texture() -> None:
    flat = np.full((48, 96), 120, np.uint8)
    options = StereoOptions(matcher="window", min_disparity=0, num_disparities=32)
    assert match_pair(pair_of(flat, flat), options).density == 0.0
    noisy = [eight_bits(np.full((48, 96), 120.0), 2.0, seed) for seed in (1, 2)]
    assert match_pair(pair_of(noisy[0], noisy[1]), options).density < 0.02


def two_planes() -> tuple[RectifiedPair, NDArray[np.float64]]:
    """A square at disparity 12 before a wall at 4, with the true disparities of the left picture."""
    rng = np.random.default_rng(8)
    wall, square = rng.integers(30, 226, (96, 200)), rng.integers(30, 226, (48, 48))
    left, right = wall[:, 20:180].copy(), wall[:, 24:184].copy()
    truth = np.full(left.shape, 4.0)
    left[24:72, 60:108], truth[24:72, 60:108] = square, 12.0
    right[24:72, 48:96] = square
    return pair_of(left.astype(np.uint8), right.astype(np.uint8)), truth


def test_what_the_square_hides_is_not_matched_but_filled_on_request() -> None:
    pair, truth = two_planes()
    options = StereoOptions(matcher="window", min_disparity=0, num_disparities=32)
    found = match_pair(pair, options)
    hidden = np.zeros(truth.shape, np.bool_)
    hidden[24:72, 52:60] = True  # eight columns of wall beside the square are behind it on the right
    seen = np.isfinite(found.disparity)
    assert seen[hidden].mean() < 0.15
    inner = ~hidden & (np.arange(160) >= 8)
    assert 0.75 < seen[inner].mean() < 0.99
    assert (np.abs(found.disparity - truth)[seen] < 0.5).mean() > 0.99
    assert ((found.state == PixelState.MATCHED) == seen).all()
    full = match_pair(pair, StereoOptions(**{**vars(options), "fill": True}))
    assert np.isfinite(full.disparity).all()
    assert (np.abs(full.disparity - truth) < 0.5).mean() > 0.95
    assert ((full.state == PixelState.FILLED) == ~seen).all()
    np.testing.assert_array_equal(full.disparity[seen], found.disparity[seen])


def test_what_a_photograph_does_not_reach_is_unknown() -> None:
    pair, _ = two_planes()
    left_shown, right_shown = pair.left_shown.copy(), pair.right_shown.copy()
    left_shown[:10], right_shown[:, 150:] = False, False
    options = StereoOptions(matcher="window", min_disparity=0, num_disparities=32, fill=True)
    found = match_pair(RectifiedPair(pair.left, pair.right, left_shown, right_shown), options)
    assert (found.state[:10] == PixelState.UNKNOWN).all()
    assert np.isnan(found.disparity[:10]).all()
    assert (found.state[10:, 155:] == PixelState.FILLED).all()


def test_checks_of_a_map() -> None:
    disparity = np.full((9, 30), 5.0, np.float32)
    disparity[:, 15:] = 9.0
    disparity[4, 4] = NAN
    beside = beside_steps(disparity, 5, 2.0)
    assert beside[:, 13:17].all()
    assert not beside[:, :13].any()
    assert not beside[:, 17:].any()
    disparity[2, 5:8] = 30.0
    cleaned = without_speckles(disparity, 3, 1.0)
    assert np.isnan(cleaned[2, 5:8]).all()
    assert np.isfinite(cleaned).sum() == disparity.size - 4
    assert np.isfinite(without_speckles(disparity, 2, 1.0)[2, 5:8]).all()


def test_holes_are_filled_by_the_farther_neighbour() -> None:
    found = np.array([[NAN, 5, NAN, NAN, 3, NAN], [NAN] * 6], np.float32)
    np.testing.assert_array_equal(fill_holes(found), [[5, 5, 3, 3, 3, 3]] * 2)
