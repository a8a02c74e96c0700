"""Semi-global matching: its vectors and paths against numpy, known scenes, real pairs beside OpenCV's StereoSGBM."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.errors import UsageError
from sfmapp.simd import u8x64 as u8
from sfmapp.simd.bits import first_bit
from sfmapp.simd.pointers import pointer
from sfmapp.stereo import Matcher, semiglobal
from sfmapp.stereo import semiglobal_kernels as kernels
from sfmapp.stereo.match import match_pair
from sfmapp.stereo.options import StereoOptions
from sfmapp.stereo.result import DisparityMap, PixelState, RectifiedPair
from sfmapp.stereo.slanted import refine_slanted

Grey = NDArray[np.uint8]


@numba.njit(cache=False, nogil=True)
def _operate(a: Grey, b: Grey, words: Any, out: Grey, costs: Grey, labels: Any) -> tuple[int, int, int]:
    pa, pb, po = pointer(a), pointer(b), pointer(out)
    x, y = u8.load(pa, 0), u8.load(pb, 0)
    u8.store(po, 0, u8.add(x, y))
    u8.store(po, 64, u8.subtract(x, y))
    u8.store(po, 128, u8.minimum(x, y))
    u8.store(po, 192, u8.mean(x, y))
    u8.store(po, 256, u8.shift_up(x))
    u8.store(po, 320, u8.shift_down(x))
    u8.store(po, 384, u8.select_equal(x, u8.splat(a[5]), y, x))
    u8.store(po, 448, u8.hide(x, 0))
    u8.store(po, 512, u8.hide(x, 63))
    u8.store(po, 640, u8.within(x, -3, 9, y))
    u8.store(po, 704, u8.within(x, 60, 99, y))
    u8.store(po, 576, u8.count_differences(words[70], pointer(words), 3))
    u8.keep_lower(x, np.int16(-7), pointer(costs), pointer(labels), 2)
    return u8.lowest(x), first_bit(u8.lanes_equal(x, u8.splat(a[40]))), first_bit(np.uint64(0))


def test_vectors_of_bytes_are_numpys() -> None:
    rng = np.random.default_rng(3)
    a, b = (rng.integers(0, 256, 64).astype(np.uint8) for _ in range(2))
    a[40], b[5] = 17, a[5]
    words = rng.integers(0, 2**63, 71, np.uint64) * np.uint64(2)
    out, costs, labels = np.empty(768, np.uint8), rng.integers(0, 256, 66).astype(np.uint8), np.zeros(66, np.int16)
    before = costs.copy()
    lowest, place, none = _operate(a, b, words, out, costs, labels)
    wide_a, wide_b = a.astype(int), b.astype(int)
    hidden0, hidden63 = a.copy(), a.copy()
    hidden0[:2] = hidden63[62:] = 255
    expected = [
        np.minimum(wide_a + wide_b, 255), np.maximum(wide_a - wide_b, 0), np.minimum(a, b), (wide_a + wide_b + 1) // 2,
        np.r_[255, a[:-1]], np.r_[a[1:], 255], np.where(a == a[5], b, a), hidden0, hidden63,
        [int(words[70] ^ word).bit_count() for word in words[3:67]],
        np.r_[a[:9], b[9:]], np.r_[b[:60], a[60:]],
    ]  # fmt: skip
    assert np.array_equal(out.reshape(12, 64), expected)
    assert (lowest, place, none) == (a.min(), int(np.flatnonzero(a == a[40])[0]), 64)
    lower = a < before[2:]
    assert np.array_equal(costs[2:], np.minimum(a, before[2:]))
    assert np.array_equal(labels[2:], np.where(lower, np.arange(64) - 7, 0))


def _plain_paths(costs: Any, grey: Grey, small: int, large: Any, ways: list[tuple[int, int]]) -> Any:
    """Sum over ways of (equation 13 of the paper minus the minimum), on integers; ways: steps (dy, dx)."""
    height, width = costs.shape[:2]
    total = np.zeros(costs.shape, int)
    for dy, dx in ways:
        path = np.zeros(costs.shape, int)
        ys = range(height) if dy >= 0 else range(height - 1, -1, -1)
        xs = range(width) if dx > 0 or dy > 0 else range(width - 1, -1, -1)
        for y in ys:
            for x in xs if dy == 0 else range(width):
                v, u = y - dy, x - dx
                if not (0 <= v < height and 0 <= u < width):
                    path[y, x] = costs[y, x]
                else:
                    old = path[v, u]
                    step = large[abs(int(grey[y, x]) - int(grey[v, u]))]
                    padded = np.r_[1000, old, 1000]
                    beside = np.minimum(padded[:-2], padded[2:]) + small
                    path[y, x] = costs[y, x] + np.minimum(np.minimum(old, beside), step)
                path[y, x] -= path[y, x].min()
        total += path
    return total


def test_paths_are_those_of_the_paper() -> None:
    rng = np.random.default_rng(5)
    shape = (6, 9)
    level = semiglobal.Level(*shape, (0, 64))
    level.views.grey[:] = rng.integers(0, 60, shape)
    level.rows.costs[:] = rng.integers(0, 49, (*shape, 64))
    kernels.follow_down(level.views, level.penalties, 0, 6, level.down, level.rows)
    kernels.follow_up(level.views, level.penalties, 0, 6, level.up, level.rows)
    for ways, found in (
        ([(0, 1), (1, 1), (1, 0), (1, -1)], level.rows.above),
        ([(0, -1), (-1, -1), (-1, 0), (-1, 1)], level.rows.below),
    ):
        total = _plain_paths(
            level.rows.costs.astype(int), level.views.grey, 16, level.penalties.large.astype(int), ways
        )
        # two means rounded up: from half the sum to one more
        assert np.all(found >= total / 2)
        assert np.all(found <= total / 2 + 1)


def _pair_of(disparity: Any, seed: int = 0, noise: float = 1.0) -> tuple[Grey, Grey]:
    """Two pictures of a surface whose disparity is given in the left one, with the texture of the left one."""
    rng = np.random.default_rng(seed)
    height, width = disparity.shape
    right = cv2.GaussianBlur(rng.uniform(-400, 655, (height, width)).astype(np.float32), (0, 0), 1.2)
    x = (np.arange(width)[None] - disparity).astype(np.float32)
    y = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, 1)
    left = cv2.remap(right, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    noisy = [picture + rng.normal(0, noise, picture.shape) for picture in (left, right)]
    return np.clip(np.rint(noisy[0]), 0, 255).astype(np.uint8), np.clip(np.rint(noisy[1]), 0, 255).astype(np.uint8)


def _match(left: Grey, right: Grey, search: tuple[int, int], threads: int = 1) -> DisparityMap:
    with Matcher(*left.shape[:2], search, threads=threads) as matcher:
        return matcher.match(left, right)


@pytest.mark.parametrize(("first", "count", "start", "slope"), [(-20, 56, -14.3, 0.14), (0, 100, 12.0, 0.25)])
def test_slanted_planes_are_found_to_a_fraction_of_a_pixel(first: int, count: int, start: float, slope: float) -> None:
    x, y = np.meshgrid(np.arange(240), np.arange(120))
    truth = start + slope * x + 0.05 * y
    found = _match(*_pair_of(truth), (first, count))
    inside = (x - truth > 8) & (x - truth < 230)
    matched = inside & (found.state == PixelState.MATCHED)
    assert matched.sum() > 0.95 * inside.sum()
    error = np.abs(found.disparity - truth)[matched]
    assert np.median(error) < 0.2
    assert (error > 1).mean() < 0.01
    assert found.searched == (first, first + count)
    assert np.isfinite(found.cost[matched]).all()
    assert (found.curvature[matched] >= 0).all()
    assert np.isnan(found.disparity[found.state == PixelState.UNKNOWN]).all()


@pytest.mark.parametrize(("slope", "share"), [(0.35, 0.96), (0.5, 0.7), (-0.5, 0.9)])
def test_steep_planes_are_found_where_much_of_the_search_leads_out_of_the_picture(slope: float, share: float) -> None:
    x = np.arange(320)[None] + np.zeros((160, 1))
    truth = 6.3 + slope * x - min(slope, 0.0) * 319
    found = _match(*_pair_of(truth, noise=2.0), (0, int(truth.max()) + 5))
    inside = (x - truth > 8) & (x < 310)
    matched = inside & (found.state == PixelState.MATCHED)
    # before disparities that lead into the picture went first: 0.78, 0.44 and 0.79
    assert matched.sum() > share * inside.sum()
    assert (np.abs(found.disparity - truth)[matched] > 1).mean() < 0.01
    assert found.uniqueness.min() >= 0.0


@pytest.mark.parametrize("seed", [0, 1])
def test_unrelated_pictures_give_no_dense_map_though_few_disparities_are_searched(seed: int) -> None:
    flat = np.full((160, 240), 6.0)
    left, right = _pair_of(flat, seed)
    other, _ = _pair_of(flat, seed + 7)
    # 0.35 to 0.5 where these sixteen are not held against others
    assert _match(other, right, (0, 16)).density < 0.15
    found = _match(left, right, (0, 16))
    assert found.density > 0.85
    assert np.nanmin(found.disparity) >= -0.5
    assert np.nanmax(found.disparity) <= 15.5


def test_what_only_the_left_camera_sees_is_not_matched() -> None:
    truth = np.full((100, 200), 5.0)
    truth[30:70, 80:140] = 25.0
    left, right = _pair_of(np.full((100, 200), 5.0))
    near, _ = _pair_of(np.zeros((100, 200)), seed=9)
    left[30:70, 80:140] = near[30:70, 80:140]
    right[30:70, 55:115] = near[30:70, 80:140]
    found = _match(left, right, (0, 40))
    hidden = np.zeros(truth.shape, bool)
    hidden[32:68, 62:78] = True
    assert (found.state[hidden] == PixelState.MATCHED).mean() < 0.1
    seen = ~cv2.dilate(hidden.astype(np.uint8), np.ones((9, 9))).astype(bool) & (np.arange(200) > 12)
    matched = seen & (found.state == PixelState.MATCHED)
    assert matched.sum() > 0.93 * seen.sum()
    assert (np.abs(found.disparity - truth)[matched] > 1).mean() < 0.02


def test_threads_strips_and_earlier_pairs_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    x, y = np.meshgrid(np.arange(200), np.arange(150))
    left, right = _pair_of(10 + 0.3 * x + 4 * np.sin(y / 9))
    alone = _match(left, right, (0, 90), threads=1)
    with Matcher(150, 200, (0, 90), threads=2) as matcher:
        matcher.match(right, left)
        together = matcher.match(np.stack([left] * 3, 2), right)
        assert matcher.match(left, right).disparity is together.disparity
    for name in ("disparity", "state", "cost", "curvature", "uniqueness"):
        assert np.array_equal(getattr(alone, name), getattr(together, name), equal_nan=True)
    monkeypatch.setattr(semiglobal, "RING_BYTES", 0)
    monkeypatch.setattr(semiglobal, "OVERLAP", 24)
    strips = _match(left, right, (0, 90))
    both = (strips.state == PixelState.MATCHED) & (alone.state == PixelState.MATCHED)
    assert both.sum() > 0.98 * (alone.state == PixelState.MATCHED).sum()
    assert (np.abs(strips.disparity - alone.disparity)[both] > 0.5).mean() < 0.005


def test_noise_is_measured() -> None:
    rng = np.random.default_rng(1)
    ramp = np.tile(np.linspace(40, 200, 300), (200, 1))
    counts = np.empty(kernels.NOISE_BINS, np.int64)
    for sigma in (1.0, 3.0, 8.0):
        picture = np.clip(np.rint(ramp + rng.normal(0, sigma, ramp.shape)), 0, 255).astype(np.uint8)
        told = kernels.noise_of(picture, counts)
        assert told == pytest.approx(np.hypot(sigma, 1 / np.sqrt(12)), rel=0.08)
    assert kernels.noise_of(np.full((50, 50), 7, np.uint8), counts) < 0.1


def test_scatter_is_evened_out_and_planes_and_edges_stay() -> None:
    rng = np.random.default_rng(8)
    x, y = np.meshgrid(np.arange(60), np.arange(40))
    plane = (20 + 0.6 * x - 0.3 * y).astype(np.float32)
    plane[:, 30:] += 9
    plane[10, 10] = np.nan
    exact = plane.copy()
    kernels.even_out(exact, np.empty_like(exact))
    # across the edge a pair is taken for the two surfaces that it is on
    assert np.allclose(exact, plane, atol=1e-4, equal_nan=True)
    noisy = plane + rng.normal(0, 0.2, plane.shape).astype(np.float32)
    evened = noisy.copy()
    kernels.even_out(evened, np.empty_like(evened))
    left = np.nanstd((evened - plane)[4:-4, 4:-4]) / 0.2
    # 5 x 5 equal weights would leave a fifth
    assert 0.2 < left < 0.35


def test_where_nothing_is_to_be_seen_nothing_is_told() -> None:
    x = np.arange(220)[None] + np.zeros((110, 1))
    left, right = _pair_of(10 + 0.02 * x)
    left[20:80, 60:160] = right[20:80, 50:150] = 255
    found = _match(left, right, (0, 40))
    blank = found.state == PixelState.UNKNOWN
    assert blank[33:67, 73:147].mean() > 0.99
    assert blank[:, 20:45].mean() < 0.05


def test_slanted_planes_refine_what_is_textured_and_leave_the_rest() -> None:
    x, y = np.meshgrid(np.arange(200), np.arange(90))
    truth = 12.3 + 0.12 * x + 0.07 * y
    left, right = _pair_of(truth, noise=2.0)
    rng = np.random.default_rng(4)
    start = (truth + rng.normal(0, 0.15, truth.shape)).astype(np.float32)
    start[40, 100] = np.nan
    refined = refine_slanted(left, right, start, 30.0)
    assert np.array_equal(refined, refine_slanted(left, right, start, 30.0, threads=2), equal_nan=True)
    assert np.array_equal(np.isnan(refined), np.isnan(start))
    inside = (x - truth > 10) & (x < 190) & (y > 8) & (y < 80) & ~np.isnan(start)
    errors = [np.sqrt(np.mean((d - truth)[inside] ** 2)) for d in (start, refined)]
    assert errors[0] == pytest.approx(0.15, rel=0.05)
    assert 0.02 < errors[1] < 0.08
    flat = np.full(truth.shape, 80, np.uint8)
    assert np.array_equal(refine_slanted(flat, flat, start, 30.0), start, equal_nan=True)


def test_holes_are_filled_by_what_lies_behind_and_marked() -> None:
    truth = np.full((100, 200), 5.0)
    left, right = _pair_of(truth)
    near, _ = _pair_of(np.zeros((100, 200)), seed=9)
    left[30:70, 80:140] = near[30:70, 80:140]
    right[30:70, 55:115] = near[30:70, 80:140]
    pair = RectifiedPair(left, right, *np.ones((2, 100, 200), bool))
    options = StereoOptions(min_disparity=0, num_disparities=40, refine=True)
    holes = match_pair(pair, options)
    full = match_pair(pair, replace(options, fill=True))
    empty = holes.state == PixelState.UNKNOWN
    assert (full.state[empty] == PixelState.FILLED).all()
    assert np.array_equal(full.disparity[~empty], holes.disparity[~empty])
    hidden = empty & (np.arange(200) > 60) & (np.arange(200) < 80)
    assert hidden.sum() > 500
    assert np.median(np.abs(full.disparity[hidden] - 5)) < 0.2


def test_bad_input_is_named() -> None:
    with pytest.raises(UsageError, match="0 disparities"):
        Matcher(100, 100, (0, 0))
    with pytest.raises(UsageError, match="from 2000 to 2099 px"):
        Matcher(100, 100, (2000, 100))
    with Matcher(60, 80, (0, 16)) as matcher:
        with pytest.raises(UsageError, match="80 x 60"):
            matcher.match(np.zeros((60, 81), np.uint8), np.zeros((60, 81), np.uint8))
        with pytest.raises(UsageError, match="float64"):
            matcher.match(np.zeros((60, 80)), np.zeros((60, 80)))  # type: ignore[arg-type]
        assert Matcher(1, 3, (-5, 700), threads=1).match(*np.zeros((2, 1, 3), np.uint8)).density == 0.0
        flat = matcher.match(np.full((60, 80), 90, np.uint8), np.full((60, 80), 90, np.uint8))
        assert flat.density == 0.0


def test_what_a_photograph_does_not_reach_stays_unknown() -> None:
    left, right = _pair_of(np.full((80, 160), 10.0))
    left_shown, right_shown = np.ones((2, 80, 160), bool)
    left_shown[:10] = False
    right_shown[:, :40] = False
    pair = RectifiedPair(left, right, left_shown, right_shown)
    found = match_pair(pair, StereoOptions(min_disparity=0, num_disparities=32))
    assert (found.state[:10] == PixelState.UNKNOWN).all()
    assert np.isnan(found.disparity[:, :49]).all()
    assert (found.state[12:, 52:] == PixelState.MATCHED).mean() > 0.95
    with pytest.raises(UsageError, match="window"):
        match_pair(pair, StereoOptions(min_disparity=0, num_disparities=32, window=5))


@pytest.mark.real
def test_errs_less_than_stereo_sgbm_and_answers_more(data_root: Path) -> None:
    scores = pytest.importorskip("stereo", reason="benchmarks/ is not part of an installed package").scores
    shared_sets, peers_of = pytest.importorskip("stereo_pairs").shared_sets, pytest.importorskip("stereo_peers").OPENCV
    keys = [
        f"{kind}_{where}" for kind in ("bad1", "bad2", "mean") for where in ("answered_visible", "complete_visible")
    ]
    for case in shared_sets(data_root):
        left, right = case.pair.left, case.pair.right
        with Matcher(*left.shape[:2], case.search) as matcher:
            ours = scores(matcher.match(left, right).disparity, case)
        peers = [scores(run(left, right, case.search), case) for name, run in peers_of.items() if "SGBM" in name]
        assert peers
        for peer in peers:
            assert ours["density_visible"] > peer["density_visible"]
            for key in keys:
                assert ours[key] < peer[key]
