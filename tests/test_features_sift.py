"""SIFT against blobs of known place and size, against symmetry, and against pycolmap."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfmapp.features import descriptor, scale_space
from sfmapp.features.octaves import Octave, Scratch
from sfmapp.features.sift import extract_sift

DEFAULTS = {
    "max_num_features": 8192,
    "max_num_orientations": 2,
    "contrast_threshold": 0.02 / 9,
    "edge_threshold": 10.0,
}


def sift(gray: np.ndarray, usable: np.ndarray | None = None, **changes: float) -> tuple[np.ndarray, np.ndarray]:
    keypoints, descriptors, _, _ = extract_sift(gray, usable, **(DEFAULTS | changes))  # type: ignore[arg-type]
    return keypoints, descriptors


def blobs(xy: np.ndarray, sigma: np.ndarray, size: tuple[int, int], contrast: float = 120.0) -> np.ndarray:
    """Gaussian blobs at COLMAP's pixels xy, of either sign, as a uint8 picture; dithered, so that rounding is noise."""
    y, x = np.mgrid[: size[1], : size[0]] + 0.5
    picture = np.full(x.shape, 128.0)
    for n, ((cx, cy), s) in enumerate(zip(xy, sigma, strict=True)):
        picture += (1 if n % 2 else -1) * contrast * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * s * s))
    noise = np.random.default_rng(0).random(x.shape)
    return np.clip(np.floor(picture + noise), 0, 255).astype(np.uint8)


def texture(size: tuple[int, int], seed: int = 0) -> np.ndarray:
    """Smooth noise over all scales."""
    rng = np.random.default_rng(seed)
    total = np.zeros(size[::-1], np.float32)
    for s in (1.0, 2.0, 4.0, 8.0, 16.0):
        total += s * cv2.GaussianBlur(rng.normal(size=size[::-1]).astype(np.float32), (0, 0), s)
    return np.clip(128 + 45 * total / total.std(), 0, 255).astype(np.uint8)


def nearest(xy: np.ndarray, to: np.ndarray) -> np.ndarray:
    return np.argmin(((xy[None] - to[:, None]) ** 2).sum(axis=2), axis=1)


@given(seed=st.integers(0, 1000), octave=st.sampled_from([0, 1, 2]), layer=st.floats(0.1, 0.9))
def test_blobs_are_found_where_they_are(seed: int, octave: int, layer: float) -> None:
    # at whole powers of two a blob lies in the seam of two octaves, and a hair decides whether either holds it
    sigma = 2.0 ** (octave + layer)
    grid = np.stack(np.meshgrid(np.arange(4), np.arange(3)), axis=-1).reshape(-1, 2) * 64.0 + 48.0
    ground_truth = grid + np.random.default_rng(seed).uniform(-0.5, 0.5, grid.shape)
    keypoints, _ = sift(blobs(ground_truth, np.full(len(ground_truth), sigma), (288, 224)))
    found = keypoints[nearest(keypoints[:, :2], ground_truth)]
    error = found[:, :2] - ground_truth
    assert np.abs(error).max() < 0.03
    assert np.abs(error.mean(axis=0)).max() < 0.01
    # the difference of Gaussians peaks where its own width is that of the blob
    assert np.abs(np.log2(found[:, 2] / sigma)).max() < 0.25


@pytest.mark.parametrize("shift", [0.0, 0.125, 0.25, 0.375, 0.5])
def test_no_bias_towards_the_pixel_grid(shift: float) -> None:
    """The error is no function of the fraction of the pixel: it would bend every camera the same way."""
    grid = np.stack(np.meshgrid(np.arange(9), np.arange(9)), axis=-1).reshape(-1, 2) * 28.0 + 24.0
    ground_truth = grid + shift
    keypoints, _ = sift(blobs(ground_truth, np.full(len(ground_truth), 1.1), (272, 272)))
    error = keypoints[nearest(keypoints[:, :2], ground_truth), :2] - ground_truth
    assert np.abs(error.mean(axis=0)).max() < 0.005


def test_quarter_turn_turns_keypoints_and_keeps_descriptors() -> None:
    picture = texture((300, 260))
    straight, straight_descriptors = sift(picture)
    turned, turned_descriptors = sift(np.ascontiguousarray(np.rot90(picture, -1)))
    # clockwise: (x, y) goes to (height - y, x) in COLMAP's pixels, without any half pixel
    expected = np.column_stack([260 - straight[:, 1], straight[:, 0]])
    at = nearest(turned[:, :2], expected)
    angle = np.angle(np.exp(1j * (turned[at, 3] - straight[:, 3] - math.pi / 2)))
    same = (np.abs(turned[at, :2] - expected).max(axis=1) < 0.02) & (np.abs(angle) < 0.05)
    assert len(straight) > 500
    assert same.mean() > 0.7
    distance = np.linalg.norm(straight_descriptors[same].astype(float) - turned_descriptors[at[same]], axis=1) / 512
    assert np.median(distance) < 0.08


def test_budget_order_and_orientations() -> None:
    picture = texture((400, 300))
    keypoints, descriptors = sift(picture, max_num_features=500)
    assert keypoints.shape == (500, 4)
    assert descriptors.shape == (500, 128)
    assert descriptors.dtype == np.uint8
    order = np.lexsort((keypoints[:, 3], keypoints[:, 1], keypoints[:, 0], -keypoints[:, 2]))
    np.testing.assert_array_equal(order, np.arange(500))
    # RootSIFT times 512 is as long as 512, but for rounding
    length = np.linalg.norm(descriptors.astype(float), axis=1)
    assert length.min() > 500
    assert length.max() < 524
    # a full budget holds one orientation per place
    assert len(np.unique(keypoints[:, :3], axis=0)) == 500
    everything, _ = sift(picture, max_num_features=100_000)
    _, counts = np.unique(everything[:, :3], axis=0, return_counts=True)
    assert counts.max() == 2
    assert (counts == 2).mean() > 0.03
    single, _ = sift(picture, max_num_features=100_000, max_num_orientations=1)
    assert len(single) == len(counts)


def test_no_part_of_the_picture_goes_without() -> None:
    """A busy half may not take the whole budget from a faint one, nor the faint one take as much."""
    picture = texture((400, 400)).astype(float)
    picture[:, 200:] = 128 + (picture[:, 200:] - 128) * 0.15
    keypoints, _ = sift(picture.astype(np.uint8), max_num_features=800)
    share = (keypoints[:, 0] > 200).mean()
    assert 0.3 < share < 0.5


def test_mask_blanks() -> None:
    picture = texture((300, 200))
    usable = np.zeros((200, 300), bool)
    usable[50:150, 100:200] = True
    keypoints, _ = sift(picture, usable)
    assert len(keypoints) > 100
    assert keypoints[:, 0].min() >= 100
    assert keypoints[:, 0].max() <= 200
    assert keypoints[:, 1].min() >= 50
    assert keypoints[:, 1].max() <= 150
    assert len(sift(picture, np.zeros((200, 300), bool))[0]) == 0


def test_dark_pictures_keep_most_keypoints() -> None:
    picture = texture((400, 300))
    bright, _ = sift(picture)
    dark, _ = sift((picture // 12).astype(np.uint8))
    assert len(dark) > 0.5 * len(bright)


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (1, 500), (9, 9), (640, 3), (37, 41)])
@pytest.mark.parametrize("level", [0, 255])
def test_nothing_in_constant_or_tiny_pictures(size: tuple[int, int], level: int) -> None:
    keypoints, descriptors = sift(np.full(size, level, np.uint8))
    assert keypoints.shape == (0, 4)
    assert descriptors.shape == (0, 128)


def test_noise_and_stripes_survive() -> None:
    rng = np.random.default_rng(1)
    assert len(sift(rng.integers(0, 256, (200, 300), np.uint8))[0]) > 500
    stripes = np.tile((np.arange(300) // 4 % 2 * 255).astype(np.uint8), (200, 1))
    assert len(sift(stripes)[0]) < 100


# --------------------------------------------------------------------------------------- against pycolmap


def half_size(path: Path) -> np.ndarray:
    gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    return cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def colmap_sift(gray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    import pycolmap

    options = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    with pytest.warns(DeprecationWarning, match="deprecated"):
        extractor = pycolmap.Sift(options, pycolmap.Device.cpu)
    keypoints, descriptors = extractor.extract(np.ascontiguousarray(gray))
    return keypoints, np.clip(np.rint(512 * descriptors), 0, 255).astype(np.uint8)


@pytest.mark.real
@pytest.mark.parametrize("name", ["fountain-P11/images/0003.jpg", "lund-door/images/DSC_0003.JPG"])
def test_same_places_as_colmap(data_root: Path, name: str) -> None:
    from scipy.spatial import cKDTree

    gray = half_size(data_root / name)
    ours, our_descriptors = sift(gray)
    theirs, their_descriptors = colmap_sift(gray)

    def key(keypoints: np.ndarray) -> np.ndarray:
        turn = np.column_stack([np.cos(keypoints[:, 3]), np.sin(keypoints[:, 3])])
        return np.column_stack([keypoints[:, :2], 2 * np.log2(keypoints[:, 2]), 4 * turn])

    distance, at = cKDTree(key(theirs)).query(key(ours))
    same = distance < 0.7
    assert same.mean() > 0.3
    offset = (ours[:, :2] - theirs[at, :2])[same]
    assert np.abs(np.median(offset, axis=0)).max() < 0.005
    assert np.abs(offset.mean(axis=0)).max() < 0.01
    # the finest levels are blurred otherwise on purpose; the coarser ones are the same
    assert np.median(np.abs(offset), axis=0).max() < 0.1
    assert np.median(np.abs(offset[ours[same, 2] > 2.0]), axis=0).max() < 0.05
    # the layout is COLMAP's: descriptors of either can be matched with those of the other
    apart = np.linalg.norm(our_descriptors[same].astype(float) - their_descriptors[at[same]], axis=1) / 512
    assert np.median(apart) < 0.15


def true_fundamental(data_root: Path, scene: str, first: int, second: int) -> tuple[list[Path], np.ndarray]:
    """Files and F (COLMAP's pixels of the half-size pictures) of two views."""
    cameras = [json.loads((data_root / scene / "cameras.json").read_text())["cameras"][i] for i in (first, second)]
    inverse_k, rotation, translation = [], [], []
    for camera in cameras:
        k = np.array(camera["K"])
        k[:2, 2] += 0.5
        inverse_k.append(np.linalg.inv(np.diag([0.5, 0.5, 1.0]) @ k))
        rotation.append(np.array(camera["R_w2c"]))
        translation.append(np.array(camera["t_w2c"]))
    turn = rotation[1] @ rotation[0].T
    t = translation[1] - turn @ translation[0]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return [data_root / scene / camera["file"] for camera in cameras], inverse_k[1].T @ cross @ turn @ inverse_k[0]


def true_matches(features: list[tuple[np.ndarray, np.ndarray]], fundamental: np.ndarray) -> np.ndarray:
    """Epipolar errors (pixels, below 1.5) of mutual nearest neighbours that pass the ratio test, each place once."""
    (xy1, d1), (xy2, d2) = ((k[:, :2].astype(float), d.astype(np.float32)) for k, d in features)
    product = (d1 / np.linalg.norm(d1, axis=1)[:, None]) @ (d2 / np.linalg.norm(d2, axis=1)[:, None]).T
    best = product.argmax(axis=1)
    two = -np.partition(-product, 1, axis=1)[:, :2]
    angle = np.arccos(np.clip(two, -1, 1))
    good = (product.argmax(axis=0)[best] == np.arange(len(d1))) & (angle[:, 0] < 0.8 * angle[:, 1])
    p, q = xy1[good], xy2[best[good]]
    _, once = np.unique(np.round(np.column_stack([p, q]), 2), axis=0, return_index=True)
    p, q = (np.column_stack([a[once], np.ones(len(once))]) for a in (p, q))
    l2, l1 = p @ fundamental.T, q @ fundamental
    error = np.abs((q * l2).sum(axis=1)) / np.sqrt(np.hypot(*l2[:, :2].T) * np.hypot(*l1[:, :2].T))
    return error[error < 1.5]


@pytest.mark.real
@pytest.mark.parametrize(("scene", "first"), [("fountain-P11", 4), ("herz-jesus-P8", 2)])
def test_more_true_matches_than_colmap(data_root: Path, scene: str, first: int) -> None:
    """With no more keypoints than COLMAP found, more true matches, and these no further from their epipolar lines."""
    files, fundamental = true_fundamental(data_root, scene, first, first + 1)
    pictures = [half_size(path) for path in files]
    theirs = [colmap_sift(gray) for gray in pictures]
    ours = [sift(gray, max_num_features=len(t[0])) for gray, t in zip(pictures, theirs, strict=True)]
    our_error, their_error = true_matches(ours, fundamental), true_matches(theirs, fundamental)
    assert len(our_error) > 1.05 * len(their_error)
    assert np.median(our_error) < 1.03 * np.median(their_error)


@pytest.mark.parametrize("size", [(301, 223), (64, 500), (90, 17)])
def test_windows_of_rows_change_no_byte(size: tuple[int, int]) -> None:
    """Of textures, of noise, whose keypoints move far while they are refined, and of patterns with equal peaks."""
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    noise = np.random.default_rng(3).integers(0, 256, x.shape).astype(np.uint8)
    waves = (128 + 100 * np.cos(x / 6) * np.cos(y / 6)).astype(np.uint8)
    for picture in (texture(size), noise, waves):
        for budget in (60, 100_000):
            options = DEFAULTS | {"max_num_features": budget}
            whole = extract_sift(picture, None, **options)  # type: ignore[arg-type]
            for scratch in (Scratch(whole_px=1), Scratch(whole_px=20_000)):
                for expected, found in zip(whole, extract_sift(picture, None, **options, scratch=scratch), strict=True):  # type: ignore[arg-type]
                    np.testing.assert_array_equal(found, expected)


def test_levels_looked_up_around_a_pixel_are_those_of_the_octave() -> None:
    picture = texture((140, 110))
    octave = Octave(picture, 0.5, Scratch())
    *_, whole = octave.windows_to_search()
    finest = [level.copy() for level in whole.levels]  # some are overwritten by the next octave
    coarser = octave.coarser()
    octave.hand_down(whole._replace(rows=(0, octave.shape[0])), coarser)
    *_, whole_coarser = coarser.windows_to_search()
    for which, levels in ((octave, finest), (coarser, whole_coarser.levels)):
        height, width = which.shape
        for row, col in ((6, 5), (height // 2, width // 2 + 1), (height - 6, width - 7), (9, width - 6)):
            window = which.look_up(row, col)
            top, left = window.origin
            for found, level in zip(window.levels, levels, strict=True):
                rows, cols = found.shape
                assert top < row < top + rows - 1
                assert left < col < left + cols - 1
                np.testing.assert_array_equal(found, level[top : top + rows, left : left + cols])


def test_dark_blobs_are_told_from_bright_ones() -> None:
    xy = np.random.default_rng(3).permutation([(30.0 + 40.0 * i, 30.0 + 40.0 * j) for i in range(5) for j in range(4)])
    keypoints, _, is_dark, _ = extract_sift(blobs(xy, np.full(20, 4.0), (220, 180)), None, **DEFAULTS)  # type: ignore[arg-type]
    is_blob = np.hypot(*(keypoints[:, None, :2] - xy).T).T.min(axis=1) < 0.5
    which = np.hypot(*(keypoints[:, None, :2] - xy).T).T.argmin(axis=1)
    is_blob &= np.abs(keypoints[:, 2] - 4.0) < 1.0
    assert len(np.unique(which[is_blob])) == 20
    np.testing.assert_array_equal(is_dark[is_blob], which[is_blob] % 2 == 0)


def test_blur_is_a_plain_sum_however_rows_are_divided() -> None:
    """In numpy, at widths around whole vectors, with kernels of either length; a few rows at a time the same bytes."""
    rng = np.random.default_rng(0)
    for width, reach in itertools.product((13, 31, 32, 33, 90), (4, 6, 10)):
        image = rng.uniform(0.0, 255.0, (37, width)).astype(np.float32)
        taps = np.exp(-0.5 * (np.arange(reach + 1) / (reach / 3.0)) ** 2).astype(np.float32)
        both = np.concatenate([taps[:0:-1], taps]).astype(np.float64)
        padded = np.pad(image.astype(np.float64), reach, mode="reflect")
        down = np.einsum("rck,k->rc", np.lib.stride_tricks.sliding_window_view(padded, len(both), 0), both)
        expected = np.einsum("rck,k->rc", np.lib.stride_tricks.sliding_window_view(down, len(both), 1), both)
        whole, parts = np.empty_like(image), np.empty_like(image)
        lines = scale_space.empty_lines(width)
        scale_space.blur(image, taps, lines, whole, (0, 37, 37), (0, 0))
        np.testing.assert_allclose(whole, expected, rtol=3e-6)
        for first in range(0, 37, 7):
            top, last = max(0, first - reach), min(37, first + 7)
            scale_space.blur(image[top : last + reach], taps, lines, parts, (first, last, 37), (top, 0))
        np.testing.assert_array_equal(parts, whole)


def test_descriptors_are_those_of_a_plain_histogram() -> None:
    """Every second gradient in the turned square of cells, dealt out to eight neighbours, in numpy; at borders too."""
    rng = np.random.default_rng(1)
    level = scale_space.empty_level((70, 90))
    level[:] = cv2.GaussianBlur(rng.uniform(0.0, 255.0, level.shape), (0, 0), 2.0)
    found = np.column_stack([rng.uniform(5.0, 85.0, 40), rng.uniform(5.0, 65.0, 40), rng.uniform(0.5, 3.5, 40)])
    angle, out = rng.uniform(0.0, 2.0 * np.pi, 40), np.empty((40, 128), np.uint8)
    descriptor.describe_all((level, level, level), 0, found, angle, out)
    for (x, y, layer), turn, mine in zip(found, angle, out, strict=True):
        cell = 3.0 * scale_space.SIGMA * 2.0 ** (layer / 3.0)
        reach = int(2.5 * cell * (abs(np.cos(turn)) + abs(np.sin(turn)))) + 1
        rows = np.arange(max(1, round(y) - reach), min(69, round(y) + reach + 1), 2)
        columns = np.arange(max(1, round(x) - reach), min(89, round(x) + reach + 1), 2)
        r, c = (place.ravel() for place in np.meshgrid(rows, columns, indexing="ij"))
        along = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) @ [c - x, r - y] / cell
        near = (np.abs(along) < 2.5).all(axis=0)
        r, c, (u, v) = r[near], c[near], along[:, near]
        gradient = (level[r, c + 1] - level[r, c - 1]) + 1j * (level[r + 1, c] - level[r - 1, c])
        weight = np.abs(gradient) * np.exp(-(u**2 + v**2) / 8.0)
        eighths = (turn - np.angle(gradient)) * 4.0 / np.pi % 8.0
        cells = np.zeros((6, 6, 8))
        for i, j, k in np.ndindex(2, 2, 2):
            at = [np.floor(each).astype(int) + step for each, step in ((v + 2.5, i), (u + 2.5, j), (eighths, k))]
            share = np.prod([
                1.0 - np.abs(place - each) for place, each in zip(at, (v + 2.5, u + 2.5, eighths), strict=True)
            ], axis=0)  # fmt: skip
            np.add.at(cells, (at[0], at[1], at[2] % 8), weight * share)
        inside = cells[1:5, 1:5].ravel()
        inside = np.minimum(inside, 0.2 * np.linalg.norm(inside))
        expected = np.minimum(512.0 * np.sqrt(inside / inside.sum()), 255.0)
        assert np.abs(mine - expected).max() < 1.0  # half of it is rounding, the rest the angles to 1e-5


def test_samples_on_the_edge_of_the_cells_stay_in_them() -> None:
    """A place that rounds to the far edge counts for the last cell, and nothing behind the memory is written to."""
    room = np.full(descriptor.ROOM + 256, 123.0, np.float32)
    level = scale_space.empty_level((60, 60))
    level[:] = np.random.default_rng(2).uniform(0.0, 255.0, level.shape)
    # cells of four pixels: what lies ten pixels away less a bit is two and a half of them from the middle, less a bit
    descriptor.describe(level, 9.0 + 2.0**-20, 9.0 + 2.0**-20, 4.0 / 3.0, 0.0, room, np.empty(128, np.uint8))
    np.testing.assert_array_equal(room[descriptor.ROOM :], 123.0)


def test_extrema_are_those_of_a_plain_search() -> None:
    """All 26 neighbours, in numpy, at widths around whole vectors and whole tiles."""
    rng = np.random.default_rng(0)
    for width in (13, 26, 27, 90, scale_space.TILE + 12):
        flat = rng.normal(size=6 * 40 * width + scale_space.SLACK).astype(np.float32)
        levels = tuple(flat[: -scale_space.SLACK].reshape(6, 40, width))
        place, value = np.empty((40 * width, 4), np.int32), np.empty(40 * width, np.float32)
        rows = np.zeros((scale_space.NUM_ROWS_AT_WORK, scale_space.PITCH), np.float32)
        marks = np.empty(scale_space.PITCH, np.int64)
        count = scale_space.find_extrema(levels, (100, 105, 135), 0.5, rows, marks, place, value)
        d = np.diff(levels, axis=0)
        near = np.lib.stride_tricks.sliding_window_view(d, (3, 3, 3))[:, 4:-4, 4:-4]
        middle = d[1:-1, 5:-5, 5:-5]
        is_peak = (middle == near.max(axis=(3, 4, 5))) & (middle > 0.5)
        is_peak |= (middle == near.min(axis=(3, 4, 5))) & (middle < -0.5)
        expected = np.argwhere(is_peak) + np.array([1, 105, 5])
        found = place[:count, :3]
        np.testing.assert_array_equal(found[np.lexsort(found.T[::-1])], expected)
        np.testing.assert_array_equal(
            value[:count], np.abs(d[found[:, 0], found[:, 1] - 100, found[:, 2]])
        )  # fmt: skip
