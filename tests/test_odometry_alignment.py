"""Patches, small images and epipolar searches: exact shifts, noise at its bound, light, borders, and OpenCV beside."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sfmapp.geometry.rigid3 import exp_so3, rotation_angle_deg
from sfmapp.odometry.frontend.alignment import align_patches
from sfmapp.odometry.frontend.epipolar_search import search_along_epipolar
from sfmapp.odometry.frontend.pyramid import build_pyramid
from sfmapp.odometry.frontend.small_image import align_small_images

Array = NDArray[np.float64]
Texture = Callable[[Array, Array], Array]


def waves(seed: int, shortest: float = 8.0, longest: float = 60.0, num: int = 60) -> Texture:
    """A band-limited texture of unit variance that can be looked at anywhere: f(x, y)."""
    rng = np.random.default_rng([seed, 1])
    length = np.exp(rng.uniform(np.log(shortest), np.log(longest), num))
    angle, phase = rng.uniform(0, np.pi, num), rng.uniform(0, 2 * np.pi, num)
    kx, ky = 2 * np.pi / length * np.cos(angle), 2 * np.pi / length * np.sin(angle)
    weight = np.sqrt(2.0 / num)

    def value(x: Array, y: Array) -> Array:
        total = np.zeros(np.broadcast(x, y).shape)
        for k in range(num):
            total += np.cos(kx[k] * x + ky[k] * y + phase[k])
        return weight * total

    return value


def render(
    texture: Texture, shape: tuple[int, int], matrix: Array | None = None, shift: tuple[float, float] = (0.0, 0.0),
    contrast: float = 35.0, middle: float = 128.0, noise: float = 0.0, seed: int = 0,
) -> NDArray[np.uint8]:  # fmt: skip
    """Image whose pixel at x shows the texture at ``matrix (x - shift)``."""
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    u, v = x - shift[0], y - shift[1]
    if matrix is not None:
        u, v = matrix[0, 0] * u + matrix[0, 1] * v, matrix[1, 0] * u + matrix[1, 1] * v
    image = middle + contrast * texture(u, v)
    image += np.random.default_rng([seed, 2]).normal(0, noise, shape) if noise else 0
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def grid(shape: tuple[int, int], margin: float, step: float, seed: int = 0) -> Array:
    y, x = np.mgrid[margin : shape[0] - margin : step, margin : shape[1] - margin : step]
    return np.stack([x.ravel(), y.ravel()], 1) + np.random.default_rng([seed, 3]).uniform(-0.5, 0.5, (x.size, 2))


def test_levels_are_the_image_at_half_the_coordinates() -> None:
    y, x = np.mgrid[:97, :131] + 0.5
    pyramid = build_pyramid((x + y).astype(np.uint8), 3)
    assert pyramid.shape == (97, 131)
    assert [pyramid.level(k).shape for k in range(3)] == [(97, 131), (48, 65), (24, 32)]
    level = pyramid.level(2).astype(np.float64)
    v, u = np.mgrid[:24, :32] + 0.5
    assert np.abs(level - 4 * (u + v))[2:-2, 2:-2].max() <= 1.0


def test_levels_are_the_binomial_of_even_length() -> None:
    image = np.random.default_rng(5).integers(0, 256, (50, 37), dtype=np.uint8)
    padded = np.pad(image.astype(np.float64), 2, mode="edge")[1:, 1:]
    taps = np.array([1, 3, 3, 1]) / 8
    rows = sum(taps[k] * padded[k : k + 50 : 2][:25] for k in range(4))
    expected = sum(taps[k] * rows[:, k : k + 36 : 2][:, :18] for k in range(4))
    assert np.array_equal(build_pyramid(image, 2).level(1), np.floor(expected + 0.5))


def test_levels_end_where_patches_would_see_borders_only() -> None:
    assert build_pyramid(np.zeros((376, 1241), np.uint8)).num_levels == 5
    assert build_pyramid(np.zeros((480, 640), np.uint8)).num_levels == 5
    assert build_pyramid(np.zeros((1, 1), np.uint8)).num_levels == 1


@settings(max_examples=30)
@given(st.floats(-8, 8), st.floats(-8, 8), st.integers(5, 7))
def test_shifts_are_found_to_a_hundredth(dx: float, dy: float, half_width: int) -> None:
    texture, shape = waves(3), (120, 160)
    first, second = build_pyramid(render(texture, shape)), build_pyramid(render(texture, shape, shift=(dx, dy)))
    xy = grid(shape, 28, 12)
    result = align_patches(first, xy, second, xy, half_width=half_width)
    error = (result.xy - xy - (dx, dy))[result.is_converged & (result.zncc > 0.9)]
    assert len(error) > 0.85 * len(xy)
    # a wave of the texture may be taken for the next one
    error = error[np.abs(error).max(axis=1) < 1.0]
    assert len(error) > 0.8 * len(xy)
    assert np.abs(error.mean(axis=0)).max() < 0.01
    assert np.median(np.abs(error)) < 0.02
    assert np.abs(error).max() < 0.15


@pytest.mark.parametrize("noise", [2.0, 5.0])
def test_noise_moves_patches_as_little_as_can_be(noise: float) -> None:
    texture, shape, shift = waves(4), (240, 320), (0.37, -0.21)
    xy = grid(shape, 20, 16)
    errors, predicted = [], []
    for seed in range(4):
        first = build_pyramid(render(texture, shape, noise=noise, seed=2 * seed))
        second = build_pyramid(render(texture, shape, shift=shift, noise=noise, seed=2 * seed + 1))
        result = align_patches(first, xy, second, xy + shift, coarsest_level=1)
        assert result.is_converged.mean() > 0.99
        errors.append((result.xy - xy - shift)[result.is_converged])
    y, x = np.mgrid[-7:8, -7:8].astype(np.float64)
    for u, v in xy:  # Cramer-Rao: both images noisy, gain and bias free, all 15 x 15 pixels of equal worth
        h = 0.5
        columns = [
            (texture(u + x + h, v + y) - texture(u + x - h, v + y)) / (2 * h),
            (texture(u + x, v + y + h) - texture(u + x, v + y - h)) / (2 * h),
            texture(u + x, v + y), np.ones_like(x),
        ]  # fmt: skip
        jacobian = 35.0 * np.stack([column.ravel() for column in columns], 1)
        predicted.append(2 * noise**2 * np.diag(np.linalg.inv(jacobian.T @ jacobian))[:2])
    bound = np.sqrt(np.median(predicted))
    spread = np.median(np.abs(np.concatenate(errors))) / 0.6745
    # the bell pays for its robustness at edges with half of the pixels
    assert 0.8 * bound < spread < 2.2 * bound
    assert np.abs(np.concatenate(errors).mean(axis=0)).max() < 0.1 * spread + 0.003


@pytest.mark.parametrize(("scale", "angle"), [(1.0, 0.35), (1.35, 0.0), (0.75, -0.2), (2.1, 0.1)])
def test_warps_are_followed(scale: float, angle: float) -> None:
    texture, shape = waves(5, shortest=14), (200, 240)
    # the target shows at an offset d what the reference shows at affine d
    affine = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ [[1, 0.1], [0, 1]]
    middle = np.array([120.0, 100.0])
    first = build_pyramid(render(texture, shape, shift=(120, 100)))
    second = build_pyramid(render(texture, shape, affine, (120, 100)))
    there = grid(shape, 50, 15)
    xy = (there - middle) @ affine.T + middle
    inside = (np.abs(xy - middle) < (100, 80)).all(axis=1)
    xy, there = xy[inside], there[inside]
    guess = there + np.random.default_rng(1).uniform(-2, 2, there.shape)
    warps = np.repeat(affine[None], len(xy), axis=0)
    result = align_patches(first, xy, second, guess, affine=warps, coarsest_level=1)
    assert result.is_converged.mean() > 0.9
    error = (result.xy - there)[result.is_converged]
    assert np.median(np.abs(error)) < 0.03
    assert np.abs(error.mean(axis=0)).max() < 0.02
    assert np.median(result.zncc) > 0.97


@pytest.mark.parametrize(("contrast", "middle"), [(17.0, 60.0), (60.0, 128.0), (25.0, 200.0)])
def test_light_does_not_matter(contrast: float, middle: float) -> None:
    texture, shape, shift = waves(6), (120, 160), (2.4, -1.7)
    first = build_pyramid(render(texture, shape))
    second = build_pyramid(render(texture, shape, shift=shift, contrast=contrast, middle=middle))
    xy = grid(shape, 24, 12)
    result = align_patches(first, xy, second, xy)
    assert result.is_converged.mean() > 0.9
    assert np.median(np.abs(result.xy - xy - shift)[result.is_converged]) < 0.03
    assert np.median(result.zncc) > 0.98


def test_plain_patches_and_edges_are_refused() -> None:
    x = np.arange(160) + 0.5
    noise = np.random.default_rng(0).normal(0, 1, (120, 160))
    xy = np.array([[40.0, 60.0], [80.0, 60.0]])
    plain = build_pyramid(np.rint(128 + 0.3 * noise).astype(np.uint8))
    assert not align_patches(plain, xy, plain, xy).is_converged.any()
    edge = build_pyramid(np.clip(np.rint(128 + 60 * np.tanh((x - 80) / 2) + 0.2 * noise), 0, 255).astype(np.uint8))
    assert not align_patches(edge, xy, edge, xy).is_converged.any()


def test_what_is_not_there_does_not_correlate() -> None:
    shape = (120, 160)
    first, second = build_pyramid(render(waves(7), shape)), build_pyramid(render(waves(8), shape))
    xy = grid(shape, 24, 12)
    result = align_patches(first, xy, second, xy)
    assert (result.is_converged & (result.zncc > 0.9)).mean() < 0.05


def test_borders_are_safe_and_not_converged() -> None:
    texture, shape = waves(9), (90, 110)
    pyramid = build_pyramid(render(texture, shape))
    wild = [-1e9, -5.0, 0.0, 0.2, 3.0, 55.0, 107.0, 109.9, 110.0, 300.0, 1e12, np.nan, np.inf]
    xy = np.array([(x, y) for x in wild for y in wild])
    warps = np.random.default_rng(0).normal(0, 3, (len(xy), 2, 2))
    warps[::7] = np.nan
    warps[::11] = 0.0
    margin = 7.5
    for affine in (None, warps):
        for other in (xy, np.full_like(xy, 50.0)):
            for result in (
                align_patches(pyramid, xy, pyramid, other, affine=affine),
                align_patches(pyramid, other, pyramid, xy, affine=affine),
            ):
                inside = result.xy[result.is_converged]
                assert np.all((inside >= margin) & (inside <= np.array([110, 90]) - margin))
    near = np.array([[9.0, 45.0], [55.0, 81.5]])
    assert align_patches(pyramid, near, pyramid, near + 0.5).is_converged.all()


def test_any_company_gives_the_same_bytes() -> None:
    texture, shape = waves(10), (200, 300)
    first = build_pyramid(render(texture, shape, noise=2))
    second = build_pyramid(render(texture, shape, shift=(3.2, 1.1), noise=2, seed=1))
    xy = grid(shape, 12, 6)
    every = align_patches(first, xy, second, xy)
    some = align_patches(first, xy[100:130], second, xy[100:130])
    for name in ("xy", "zncc", "is_converged"):
        assert getattr(every, name)[100:130].tobytes() == getattr(some, name).tobytes()


def test_no_points_are_no_problem() -> None:
    pyramid = build_pyramid(np.zeros((50, 60), np.uint8))
    assert align_patches(pyramid, np.empty((0, 2)), pyramid, np.empty((0, 2))).xy.shape == (0, 2)
    found = search_along_epipolar(
        pyramid, np.empty((0, 2)), pyramid, np.empty((0, 5, 2)), np.empty(0, np.int64)
    )  # fmt: skip
    assert found.xy.shape == (0, 2)


def kitti(data_root: Path, *frames: int) -> list[NDArray[np.uint8]]:
    import cv2

    folder = data_root / "kitti00-200" / "image_0"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    return [cv2.imread(str(folder / f"{frame:06d}.jpg"), cv2.IMREAD_GRAYSCALE) for frame in frames]


@pytest.mark.real
def test_real_tracks_keep_to_the_epipolar_lines_better_than_opencvs(data_root: Path) -> None:
    import cv2

    a, b = kitti(data_root, 75, 77)
    corners = cv2.goodFeaturesToTrack(a, 1500, 0.005, 8)[:, 0]
    klt = {"winSize": (15, 15), "maxLevel": 4, "criteria": (3, 30, 0.01)}
    there, seen, _ = cv2.calcOpticalFlowPyrLK(a, b, corners, None, **klt)
    back, seen_back, _ = cv2.calcOpticalFlowPyrLK(b, a, there, None, **klt)
    good_cv = (seen[:, 0] > 0) & (seen_back[:, 0] > 0) & (np.linalg.norm(back - corners, axis=1) < 0.5)
    xy, first, second = corners.astype(np.float64) + 0.5, build_pyramid(a), build_pyramid(b)
    ours = align_patches(first, xy, second, xy)
    ours_back = align_patches(second, ours.xy, first, xy)
    good = ours.is_converged & ours_back.is_converged & (np.linalg.norm(ours_back.xy - xy, axis=1) < 0.5)
    assert good.sum() > 0.95 * good_cv.sum()
    both = good & good_cv
    agree = np.linalg.norm(ours.xy - there - 0.5, axis=1)[both]
    assert np.median(agree) < 0.2
    # the lines from both sets, so that neither is favoured
    focal = 718.856
    middle = 0.5 * (ours.xy + there + 0.5)[both] / focal
    essential, _ = cv2.findEssentialMat(xy[both] / focal, middle, np.array(
        [[1, 0, 607.693 / focal], [0, 1, 185.716 / focal], [0, 0, 1]]), cv2.USAC_ACCURATE, 0.9999, 0.3 / focal
    )  # fmt: skip
    k = np.array([[focal, 0, 607.693], [0, focal, 185.716], [0, 0, 1]])
    fundamental = np.linalg.inv(k).T @ essential[:3] @ np.linalg.inv(k)

    def distance(target: Array) -> Array:
        p, q = (np.column_stack([z[both], np.ones(both.sum())]) for z in (xy, target))
        line = p @ fundamental.T
        return np.abs((line * q).sum(1)) / np.linalg.norm(line[:, :2], axis=1)

    ours_px, theirs_px = np.median(distance(ours.xy)), np.median(distance(there.astype(np.float64) + 0.5))
    assert ours_px < 0.2
    assert ours_px < 1.02 * theirs_px


def rotated(texture: Texture, rotation: Array, focal: float, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """View of a texture painted on the sphere of directions, by a pinhole turned by rotation (camera_from_world)."""
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    rays = np.stack([(x - shape[1] / 2) / focal, (y - shape[0] / 2) / focal, np.ones(shape)], -1) @ rotation
    u, v = np.arctan2(rays[..., 0], rays[..., 2]), np.arctan2(rays[..., 1], np.hypot(rays[..., 0], rays[..., 2]))
    return np.clip(np.rint(128 + 35 * texture(focal * u, focal * v)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("shape", [(376, 1240), (480, 640)])
@pytest.mark.parametrize("turn_deg", [(0.5, -1.0, 2.0), (3.0, 8.0, -4.0), (-2.0, 14.0, 1.0)])
def test_small_images_tell_the_rotation(shape: tuple[int, int], turn_deg: tuple[float, float, float]) -> None:
    texture = waves(11, shortest=12, longest=400, num=80)
    focal, turn = 0.8 * shape[0], exp_so3(np.radians(turn_deg))
    first = rotated(texture, np.eye(3), focal, shape)
    second = (0.7 * rotated(texture, turn, focal, shape) + 20).astype(np.uint8)
    found = align_small_images(build_pyramid(first), build_pyramid(second), focal)
    assert found is not None
    assert rotation_angle_deg(found @ turn.T) < 0.3
    assert np.allclose(found @ found.T, np.eye(3), atol=1e-9)


def test_small_images_of_other_things_tell_nothing() -> None:
    shape = (240, 320)
    one, other = (build_pyramid(render(waves(seed, shortest=12, longest=400), shape)) for seed in (12, 13))
    blank = build_pyramid(np.full(shape, 90, np.uint8))
    assert align_small_images(one, other, 300.0) is None
    assert align_small_images(one, blank, 300.0) is None
    assert align_small_images(blank, one, 300.0) is None
    tiny = build_pyramid(np.zeros((9, 12), np.uint8))
    assert align_small_images(tiny, tiny, 10.0) is None


def test_a_plane_of_known_disparity_is_found_along_the_lines() -> None:
    texture, shape = waves(14, shortest=7), (200, 320)
    first = build_pyramid(render(texture, shape, noise=2))
    slope = np.array([[1.04, 0.0], [0.0, 1.0]])  # disparities of 12 to 25 pixels across the image
    second = build_pyramid(render(texture, shape, slope, (-25.0, 0.0), contrast=28, middle=110, noise=2, seed=1))
    xy = grid(shape, 16, 11)
    xy = xy[xy[:, 0] > 60]
    there = np.column_stack([xy[:, 0] / 1.04 - 25.0, xy[:, 1]])
    steps = np.arange(0.0, 80.0, 2.0)
    segments = np.stack([xy[:, None, 0] - steps, np.repeat(xy[:, 1:], len(steps), 1)], -1)
    counts = np.full(len(xy), len(steps))
    found = search_along_epipolar(first, xy, second, segments, counts)
    assert found.is_found.mean() > 0.9
    assert np.isnan(found.xy[~found.is_found]).all()
    error = (found.xy - there)[found.is_found]
    assert (np.linalg.norm(error, axis=1) < 0.5).mean() > 0.98
    assert np.median(np.abs(error)) < 0.06
    # beyond the count nothing is looked at
    none = search_along_epipolar(first, xy, second, segments, np.full(len(xy), 3))
    assert none.is_found.mean() < 0.1


def test_repeated_structure_is_not_taken_for_a_match() -> None:
    y, x = np.mgrid[:160, :240] + 0.5
    tiles = 128 + 50 * np.sin(2 * np.pi * x / 20) * np.sin(2 * np.pi * y / 20)
    pyramid = build_pyramid(np.rint(tiles).astype(np.uint8))
    xy = grid((160, 240), 30, 17)
    xy = xy[xy[:, 0] > 90]
    steps = np.arange(0.0, 64.0, 2.0)
    segments = np.stack([xy[:, None, 0] - steps, np.repeat(xy[:, 1:], len(steps), 1)], -1)
    found = search_along_epipolar(pyramid, xy, pyramid, segments, np.full(len(xy), len(steps)))
    assert not found.is_found.any()


@pytest.mark.real
def test_real_stereo_pairs_are_matched(data_root: Path) -> None:
    import cv2

    from sfmapp.odometry.frontend.corners import find_corners

    folder = data_root / "stereo-cones"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    left, right = (cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE) for name in ("im2.png", "im6.png"))
    ground_truth = cv2.imread(str(folder / "disp2.png"), cv2.IMREAD_UNCHANGED) / 4.0
    first = build_pyramid(left)
    xy = find_corners(first, np.empty((0, 2)), 600, min_distance_px=6)
    steps = np.arange(0.0, 64.0, 2.0)
    segments = np.stack([xy[:, None, 0] - steps, np.repeat(xy[:, 1:], len(steps), 1)], -1)
    found = search_along_epipolar(first, xy, build_pyramid(right), segments, np.full(len(xy), len(steps)))
    disparity = ground_truth[xy[:, 1].astype(int), xy[:, 0].astype(int)]
    known = (disparity > 0) & (xy[:, 0] - disparity > 10)
    assert found.is_found[known].mean() > 0.75
    error = np.abs(xy[:, 0] - found.xy[:, 0] - disparity)[known & found.is_found]
    assert np.median(error) < 0.2
    assert (error > 3).mean() < 0.08
