"""Nearest neighbours among descriptors against brute force in numpy, and guided matching against its definition."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfmapp.geometry import epipolar, rigid3
from sfmapp.matching import guided
from sfmapp.matching.binary import match_binary
from sfmapp.matching.descriptors import match_sift
from sfmapp.matching.products import ProductSearch, background_products, largest_products
from sfmapp.scene.features import Features


def random_sift(num: int, rng: np.random.Generator) -> np.ndarray:
    """RootSIFT times 512: the square root of something that sums to one, a quarter of it in empty bins."""
    histogram = rng.gamma(0.6, size=(num, 128)) * (rng.random((num, 128)) > 0.25)
    return np.minimum(np.rint(512 * np.sqrt(histogram / histogram.sum(1, keepdims=True))), 255).astype(np.uint8)


def changed(descriptors: np.ndarray, amount: float, rng: np.random.Generator) -> np.ndarray:
    noisy = np.abs(descriptors + rng.normal(0, amount, descriptors.shape))
    return np.minimum(np.rint(512 * noisy / np.linalg.norm(noisy, axis=1, keepdims=True)), 255).astype(np.uint8)


def two_largest(products: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if products.shape[1] == 0:
        zero = np.zeros(len(products), np.int64)
        return zero, zero, zero - 1
    padded = np.concatenate([products, np.zeros((len(products), 1), products.dtype)], 1)
    ordered = np.sort(padded, 1)
    arg = np.where(products.max(1) > 0, products.argmax(1), -1)
    return ordered[:, -1], ordered[:, -2], arg


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 70), st.integers(0, 70), st.integers(0, 2**31), st.sampled_from([2, 256]))
def test_products_are_exact_for_every_size_and_the_first_of_equals_wins(n: int, m: int, seed: int, top: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.integers(0, top, (n, 128)).astype(np.uint8), rng.integers(0, top, (m, 128)).astype(np.uint8)
    if n > 3 and m > 3:
        a[2], b[3] = a[1], b[1]
    a[:1] = 0
    products = a.astype(np.int64) @ b.astype(np.int64).T
    expected = (*two_largest(products), *two_largest(products.T))
    rows, columns = largest_products(a, b)
    for found, wanted in zip((*rows, *columns), expected, strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_products_are_exact_across_blocks() -> None:
    rng = np.random.default_rng(0)
    a, b = random_sift(300, rng), random_sift(700, rng)
    products = a.astype(np.int64) @ b.astype(np.int64).T
    expected = (*two_largest(products), *two_largest(products.T))
    rows, columns = largest_products(a, b)
    for found, wanted in zip((*rows, *columns), expected, strict=True):
        np.testing.assert_array_equal(found, wanted)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 200), st.integers(0, 200), st.lists(st.integers(0, 220), max_size=3), st.integers(0, 2**31))
def test_a_search_that_is_carried_on_finds_what_one_at_once_does(n: int, m: int, sizes: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = (rng.integers(0, 2, (num, 128)).astype(np.uint8) for num in (n, m))  # many are equal
    search = ProductSearch(a, b)
    for size in [*sorted(sizes), 220]:
        found = search.among_first(size)
        size = min(-(-size // 32) * 32, 220)
        for side, wanted in zip(found, largest_products(a[:size], b[:size]), strict=True):
            for array, expected in zip(side, wanted, strict=True):
                np.testing.assert_array_equal(array, expected)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 150), st.integers(0, 150), st.lists(st.integers(0, 160), max_size=3), st.integers(0, 2**31))
def test_dark_and_bright_are_searched_apart(n: int, m: int, sizes: list[int], seed: int) -> None:
    """Against all products at once, in which those of a dark and a bright one count for nothing."""
    rng = np.random.default_rng(seed)
    a, b = random_sift(n, rng), random_sift(m, rng)
    is_dark1, is_dark2 = rng.random(n) < rng.random(), rng.random(m) < rng.random()
    search = ProductSearch(a, b, is_dark1, is_dark2)
    for size in sorted(sizes):
        rows, columns = search.among_first(size)
        assert rows.partner.max(initial=-1) < len(columns.first)
        assert columns.partner.max(initial=-1) < len(rows.first)
    products = a.astype(np.int64) @ b.astype(np.int64).T * (is_dark1[:, None] == is_dark2)
    for found, each in zip(search.among_first(160), (products, products.T), strict=True):
        wanted = np.sort(np.hstack([np.zeros((len(each), 2), np.int64), each]), axis=1)[:, :-3:-1]
        num = len(found.first)  # what comes after is compared with nothing
        np.testing.assert_array_equal(wanted[num:], 0)
        np.testing.assert_array_equal(np.column_stack([found.first, found.second]), wanted[:num])
        has_one = found.partner >= 0
        np.testing.assert_array_equal(has_one, found.first > 0)
        np.testing.assert_array_equal(each[:num][has_one, found.partner[has_one]], found.first[has_one])


def test_matches_are_mutual_and_pass_the_ratio_from_both_sides() -> None:
    rng = np.random.default_rng(1)
    a = random_sift(400, rng)
    b = changed(a, 8, rng)[rng.permutation(400)[:300]]
    matches = match_sift(a, b, 0.8, 0.7)
    distance = np.sqrt(np.maximum(2 - 2 * (a.astype(np.int64) @ b.astype(np.int64).T) / 512**2, 0))
    expected = []
    for i in range(len(a)):
        j = int(distance[i].argmin())
        rest1, rest2 = np.delete(distance[i], j).min(), np.delete(distance[:, j], i).min()
        if distance[:, j].argmin() == i and distance[i, j] < 0.8 * min(rest1, rest2) and distance[i, j] <= 0.7:
            expected.append((i, j))
    assert len(expected) > 200
    np.testing.assert_array_equal(matches, expected)
    assert match_sift(b, a, 0.8, 0.7).shape == matches.shape


def test_equal_descriptors_match_nothing() -> None:
    same = np.tile(random_sift(1, np.random.default_rng(2)), (50, 1))
    assert len(match_sift(same, same, 0.8, 0.7)) == 0
    assert len(match_sift(np.zeros((50, 128), np.uint8), np.zeros((50, 128), np.uint8), 0.8, 0.7)) == 0


@pytest.mark.parametrize("sizes", [(0, 0), (0, 5), (5, 0)])
def test_no_descriptors_match_nothing(sizes: tuple[int, int]) -> None:
    for dims, match in ((128, match_sift), (32, match_binary)):
        a, b = (np.ones((n, dims), np.uint8) for n in sizes)
        assert match(a, b, 0.8, 0.7).shape == (0, 2)


def test_binary_matches_are_those_with_few_bits_flipped() -> None:
    rng = np.random.default_rng(3)
    a = rng.integers(0, 256, (200, 32)).astype(np.uint8)
    order = rng.permutation(200)
    b = a[order].copy()
    b[:, 0] ^= rng.integers(0, 256, 200).astype(np.uint8)
    matches = match_binary(a, b, 0.8, 0.7)
    assert len(matches) == 200
    np.testing.assert_array_equal(order[matches[:, 1]], matches[:, 0])


def test_background_leaves_the_neighbourhood_out() -> None:
    rng = np.random.default_rng(4)
    descriptors, xy, radius = random_sift(90, rng), rng.uniform(0, 100, (90, 2)), rng.uniform(0, 40, 90)
    sample = np.unique(np.linspace(0, 89, 50).astype(int))
    products = descriptors.astype(np.int64) @ descriptors[sample].astype(np.int64).T
    is_far = np.linalg.norm(xy[:, None] - xy[sample], axis=2) > radius[:, None]
    np.testing.assert_array_equal(
        background_products(descriptors, xy, radius, 50), np.where(is_far, products, 0).max(1)
    )
    is_dark = rng.random(90) < 0.4
    is_far &= is_dark[:, None] == is_dark[sample]
    np.testing.assert_array_equal(
        background_products(descriptors, xy, radius, 50, is_dark), np.where(is_far, products, 0).max(1)
    )


def guided_scene(pose: list[float], num: int = 900) -> tuple[Features, Features, np.ndarray]:
    """Two views of points with descriptors, a third of them without a partner, and the true F."""
    rng = np.random.default_rng(5)
    k = np.array([[800.0, 0, 500], [0, 800, 400], [0, 0, 1]])
    xyz = rng.uniform([-3, -2.5, 4], [3, 2.5, 9], (num, 3))
    moved = rigid3.apply(pose, xyz)
    views = [p[:, :2] / p[:, 2:] @ k[:2, :2].T + k[:2, 2] for p in (xyz, moved)]
    descriptors = random_sift(num, rng)
    other = changed(descriptors, 8, rng)
    other[: num // 3] = random_sift(num // 3, rng)
    order = rng.permutation(num)
    shape = np.concatenate([rng.uniform(1, 4, (num, 1)), rng.uniform(-3, 3, (num, 1))], 1)
    first, second = (np.concatenate([view, shape], 1).astype(np.float32) for view in views)
    rgb = np.zeros((num, 3), np.uint8)
    f = epipolar.fundamental_from_essential(epipolar.essential_from_pose(pose), k, k)
    return Features(first, descriptors, rgb), Features(second[order], other[order], rgb), f


def brute_force_guided(
    image1: guided.GuidedImage, image2: guided.GuidedImage, f: np.ndarray, band: float, change: np.ndarray
) -> np.ndarray:
    lines = np.concatenate([image1.shape[:, :2], np.ones((len(image1.shape), 1))], 1) @ f.T
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    distance = np.abs(lines[:, :2] @ image2.shape[:, :2].T + lines[:, 2:])
    scale = image2.shape[None, :, 2] - image1.shape[:, None, 2]
    turn = (image2.shape[None, :, 3] - image1.shape[:, None, 3] - change[2] + np.pi) % (2 * np.pi) - np.pi
    allowed = (distance <= band) & (scale >= change[0]) & (scale <= change[1]) & (np.abs(turn) <= change[3])
    products = np.where(allowed, image1.descriptors.astype(np.int64) @ image2.descriptors.astype(np.int64).T, 0)
    best1, second1, arg1 = two_largest(products)
    best2, second2, arg2 = two_largest(products.T)
    length = lambda product: np.sqrt(np.maximum(2 - 2 * product / 512**2, 0))  # noqa: E731
    second1, second2 = np.maximum(second1, image1.background), np.maximum(second2, image2.background)
    i = np.arange(len(best1))
    keep = (arg1 >= 0) & (arg2[arg1] == i) & (length(best1) < 0.8 * length(second1)) & (length(best1) <= 0.7)
    keep &= length(best2[arg1]) < 0.8 * length(second2[arg1])
    return np.stack([i[keep], arg1[keep]], 1)


@pytest.mark.parametrize(
    "translation",
    [[1.0, 0, 0], [0, 1.0, 0], [0.0, 0, -1.0], [0.3, 0.2, -0.9], [0.8, 0, 0.4]],
    ids=["sideways", "upwards", "forward", "epipole inside", "epipole beside"],
)
@pytest.mark.parametrize("band", [2.0, 12.0])
def test_guided_matching_is_what_its_definition_says(translation: list[float], band: float) -> None:
    pose = np.append(rigid3.quaternion(rigid3.exp_so3([0.02, -0.03, 0.05])), translation)
    features1, features2, f = guided_scene(pose)
    images = [guided.GuidedImage.of(x, guided.background_of(x)) for x in (features1, features2)]
    change = np.array([-0.5, 0.5, 0.0, np.radians(40)])
    found = guided.match_guided(*images, f, band, change, 0.8, 0.7)
    np.testing.assert_array_equal(found, brute_force_guided(*images, f, band, change))
    assert len(found) > 500


def test_a_band_as_wide_as_the_image_is_the_full_product() -> None:
    features1, features2, f = guided_scene([0.0, 0, 0, 1, 1, 0, 0])
    nothing = np.zeros(len(features1), np.int32)
    images = [guided.GuidedImage.of(x, nothing) for x in (features1, features2)]
    anything = np.array([-99.0, 99.0, 0.0, 9.0])
    found = guided.match_guided(*images, f, 1e5, anything, 0.8, 0.7)
    np.testing.assert_array_equal(found, match_sift(features1.descriptors, features2.descriptors, 0.8, 0.7))


def test_change_of_shape_covers_what_the_matches_do() -> None:
    rng = np.random.default_rng(6)
    shape1 = np.concatenate(
        [rng.uniform(0, 100, (200, 2)), rng.uniform(0, 3, (200, 1)), rng.uniform(-9, 9, (200, 1))], 1
    )
    shape2 = shape1 + np.array([0, 0, 1.0, 3.0]) + rng.normal(0, 0.1, (200, 4))
    empty = np.zeros((200, 128), np.uint8), np.zeros(200, np.int32)
    images = [guided.GuidedImage(empty[0], shape, empty[1]) for shape in (shape1, shape2)]
    low, high, centre, half = guided.change_of_shape(*images, np.stack([np.arange(200)] * 2, 1).astype(np.int32))
    assert 0.1 < low < 0.5
    assert 1.5 < high < 1.9
    assert centre == pytest.approx(3.0, abs=0.05)
    assert half == pytest.approx(np.radians(30))


def test_hamming_neighbours_equal_opencv():
    rng = np.random.default_rng(11)
    a = rng.integers(0, 256, (300, 32), np.uint8)
    b = np.concatenate(
        [a[::2] ^ (rng.random((150, 32)) < 0.1).astype(np.uint8), rng.integers(0, 256, (90, 32), np.uint8)]
    )
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)

    def passing(query, train):
        found = matcher.knnMatch(query, train, k=2)
        return {m.queryIdx: m.trainIdx for m, n in found if m.distance < 0.8 * n.distance and m.distance <= 0.5 * 256}

    forward, backward = passing(a, b), passing(b, a)
    expected = sorted((i, j) for i, j in forward.items() if backward.get(j) == i)
    assert match_binary(a, b, 0.8, 0.5).tolist() == [list(pair) for pair in expected]
    assert len(expected) > 100
