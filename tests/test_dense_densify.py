"""Densification on rendered scenes: where patches lie, what is kept, and that threads do not matter."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from dense_scenes import (
    HEIGHT,
    PIXEL_M,
    WIDTH,
    depth_errors,
    project,
    scene_of,
    wall_with_box_and_bars,
)
from sfmapp.dense.densify import densify
from sfmapp.dense.growth import Growth
from sfmapp.dense.options import DenseOptions
from sfmapp.dense.scene import DenseScene, DenseView, Patches
from sfmapp.errors import InterruptedRunError
from sfmapp.events import Events
from sfmapp.geometry import rigid3

NUM_VIEWS = 7


@cache
def rendered(noise: float) -> tuple[DenseScene, list[NDArray[np.float32]], list[NDArray[np.int32]]]:
    return scene_of(wall_with_box_and_bars(), NUM_VIEWS, noise)


@cache
def patches_of(noise: float, cell_px: int = 1) -> Patches:
    return densify(rendered(noise)[0], DenseOptions(cell_px=cell_px))[0]


def covered(patches: Patches, m: int, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(H, W) bool: pixels of view m within one pixel of a patch of those chosen that this view trusts."""
    scene, depths, _ = rendered(0.0)
    pixels, depth = project(scene.views[m], patches.xyz[chosen])
    column, row = pixels.astype(np.int64).T
    inside = (column >= 1) & (row >= 1) & (column < WIDTH - 1) & (row < HEIGHT - 1) & (depth > 0.0)
    out = np.zeros((HEIGHT, WIDTH), bool)
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            x, y = column[inside] + dx, row[inside] + dy
            near = np.abs(depths[m][y, x] - depth[inside]) < 0.06
            out[y[near], x[near]] = True
    return out


@pytest.mark.parametrize(("noise", "most_median", "least_share"), [(0.0, 0.25, 0.97), (3.0, 0.6, 0.95)])
def test_patches_lie_on_the_surfaces(noise: float, most_median: float, least_share: float) -> None:
    scene, depths, _ = rendered(noise)
    patches = patches_of(noise)
    errors = depth_errors(scene, depths, patches.xyz, patches.reference_idx) / PIXEL_M
    assert len(patches) > 0.8 * WIDTH * HEIGHT
    assert np.median(errors) < most_median
    # five pixels: a patch beyond is on another surface
    assert (errors < 5.0).mean() > least_share
    # and an error is not free: with noise it grows
    assert np.median(errors) > 0.005


def test_most_of_what_three_views_see_is_covered() -> None:
    patches = patches_of(0.0)
    everywhere = np.ones(len(patches), bool)
    # twelve pixels at the border are seen by too few
    inner = covered(patches, 3, everywhere)[12:-12, 30:-30]
    assert inner.mean() > 0.95


def test_bars_and_the_wall_behind_are_both_kept() -> None:
    patches = patches_of(0.0)
    is_bar = (patches.xyz[:, 1] < -0.6) & (patches.xyz[:, 0] > 0.1)
    _, depths, surfaces = rendered(0.0)
    bars = (depths[3] < 2.5) & (np.arange(WIDTH) > WIDTH // 2)
    assert covered(patches, 3, is_bar)[bars].mean() > 0.8
    # the wall within three pixels of a bar in the middle view
    near = np.zeros_like(bars)
    for shift in (-3, -2, -1, 1, 2, 3):
        near |= np.roll(bars, shift, axis=1)
    near &= ~bars & (surfaces[3] == surfaces[3][HEIGHT // 2, WIDTH // 2 + 2])
    assert covered(patches, 3, ~is_bar)[near].mean() > 0.8


def test_normals_face_the_cameras_and_are_those_of_the_wall() -> None:
    patches = patches_of(0.0)
    wall = (np.abs(patches.xyz[:, 1]) < 0.03) & (np.abs(patches.xyz[:, 2]) < 0.7) & (np.abs(patches.xyz[:, 0]) < 1.2)
    np.testing.assert_allclose(np.linalg.norm(patches.normal, axis=1), 1.0, atol=1e-4)
    angle = np.degrees(np.arccos(np.clip(-patches.normal[wall, 1], -1.0, 1.0)))
    assert np.median(angle) < 8.0
    eye = rendered(0.0)[0].centers[patches.reference_idx]
    assert (np.einsum("ij,ij->i", eye - patches.xyz, patches.normal) > 0.0).all()


def test_every_patch_is_seen_by_enough_distinct_views() -> None:
    patches = patches_of(0.0)
    assert patches.num_views.min() >= 2
    owner = np.repeat(np.arange(len(patches)), patches.num_views)
    assert len(np.unique(owner * NUM_VIEWS + patches.view_idx)) == len(owner)
    assert ((patches.score >= 0.7) & (patches.score <= 1.0)).all()
    assert (patches.sigma > 0.0).mean() > 0.999


def num_seeing(m: int) -> NDArray[np.int64]:
    """(H, W) views that see what each pixel of view m shows, itself among them, well inside their pictures."""
    scene, depths, _ = rendered(0.0)
    view = scene.views[m]
    v, u = np.indices((HEIGHT, WIDTH)) + 0.5
    rays = np.stack([(u - view.k[2]) / view.k[0], (v - view.k[3]) / view.k[1], np.ones_like(u)], axis=-1)
    world = rigid3.apply(rigid3.inverse(view.cam_from_world), (rays * depths[m][..., None]).reshape(-1, 3))
    count = np.zeros(len(world), np.int64)
    for other, depth_map in zip(scene.views, depths, strict=True):
        count += sees(other, depth_map, world)
    return count.reshape(HEIGHT, WIDTH)


def sees(view: DenseView, depth_map: NDArray[np.float32], xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) bool: places (N, 3) that lie in the picture of a view, five pixels from its border, with nothing before."""
    pixels, depth = project(view, xyz)
    inside = (depth > 0.0) & ((pixels >= 5.0) & (pixels < [WIDTH - 5, HEIGHT - 5])).all(axis=1)
    column, row = np.where(inside[:, None], pixels, 0.0).astype(np.int64).T
    return np.asarray(inside & (np.abs(depth_map[row, column] - depth) < 3.0 * PIXEL_M))


def test_two_views_do_where_no_third_can_see(monkeypatch: pytest.MonkeyPatch) -> None:
    patches, m = patches_of(0.0), 0
    seen_by = num_seeing(m)
    in_two = seen_by == 2
    assert in_two.sum() > 1000
    everything = np.ones(len(patches), bool)
    assert covered(patches, m, everything)[in_two].mean() > 0.9
    mine = (patches.num_views == 2) & (patches.reference_idx == m)
    column, row = project(rendered(0.0)[0].views[m], patches.xyz[mine])[0].astype(np.int64).T
    assert (seen_by[row, column] <= 2).mean() > 0.85
    # and that is what brings them
    monkeypatch.setattr(Growth, "expand_where_few_see", lambda *_: 0)
    strict, _ = densify(rendered(0.0)[0], DenseOptions())
    assert covered(strict, m, np.ones(len(strict), bool))[in_two].mean() < 0.6


def test_two_views_do_not_where_a_third_sees_something_else() -> None:
    scene, depths, _ = rendered(0.0)
    first, second, third = scene.views[2:5]
    other = dataclasses.replace(third, rgb=np.ascontiguousarray(third.rgb[::-1, ::-1]))
    neighbors = np.array([[1, 2], [0, 2], [0, 1]], np.int32)
    views = (first, second, other)
    trio = DenseScene(views, neighbors, scene.point_xyz, scene.point_ptr, scene.point_view_idx)
    of_two, _ = densify(trio, DenseOptions(min_views=2))
    assert len(of_two) > 0.5 * WIDTH * HEIGHT
    patches, _ = densify(trio, DenseOptions())
    in_two = patches.num_views == 2
    # it does not speak against what lies outside of its picture
    is_seen = sees(third, depths[4], patches.xyz[in_two])
    assert (~is_seen).sum() > 1000
    assert is_seen.sum() < 0.05 * len(of_two)


def test_an_image_trusts_no_patch_that_it_cannot_see(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, depths, _ = rendered(0.0)

    def hidden(patches: Patches) -> float:
        """Share of the pairs of a patch and an image that trusts it in which something stands between them."""
        owner, count = np.repeat(np.arange(len(patches)), patches.num_views), 0
        for m, view in enumerate(scene.views):
            pixels, depth = project(view, patches.xyz[owner[patches.view_idx == m]])
            column, row = pixels.astype(np.int64).T
            around = [
                depths[m][(row + dy).clip(0, HEIGHT - 1), (column + dx).clip(0, WIDTH - 1)]
                for dx in (-1, 0, 1) for dy in (-1, 0, 1)
            ]  # fmt: skip
            # the bars stand half a metre and more before what they hide
            count += int((np.max(around, axis=0) < depth - 0.2).sum())
        return count / len(owner)

    assert hidden(patches_of(0.0)) < 0.002
    monkeypatch.setattr(Growth, "_resolve_layers", lambda _: None)
    assert hidden(densify(scene, DenseOptions())[0]) > 1.5 * hidden(patches_of(0.0))


def test_the_deviation_tells_how_far_off_a_patch_is() -> None:
    scene, depths, _ = rendered(3.0)
    patches = patches_of(3.0)
    ratio = depth_errors(scene, depths, patches.xyz, patches.reference_idx) / np.maximum(patches.sigma, 1e-9)
    # half of a normal distribution lies within 0.67 deviations; neighbours share pixels, which the deviation leaves out
    assert 0.3 < np.median(ratio) < 2.5
    order = np.argsort(patches.sigma)
    errors = depth_errors(scene, depths, patches.xyz, patches.reference_idx)[order]
    quarter = len(errors) // 4
    assert np.median(errors[-quarter:]) > 1.5 * np.median(errors[:quarter])


def test_threads_change_nothing() -> None:
    scene, _, _ = rendered(3.0)
    one, report = densify(scene, DenseOptions(cell_px=2), threads=1)
    two, _ = densify(scene, DenseOptions(cell_px=2), threads=2)
    for name in ("xyz", "normal", "rgb", "score", "sigma", "size", "wave", "view_ptr", "view_idx"):
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes(), name
    assert report["num_patches"] == len(one)
    removed = sum(step["count"] for step in report["funnel"][1:-1])
    assert report["funnel"][0]["count"] - removed == report["funnel"][-1]["count"] == len(one)


def test_two_pixel_cells_hold_a_quarter_of_the_patches() -> None:
    assert 0.2 < len(patches_of(0.0, 2)) / len(patches_of(0.0, 1)) < 0.35


def test_nothing_grows_where_there_is_no_texture_but_noise() -> None:
    scene, _, _ = rendered(0.0)
    rng = np.random.default_rng(1)
    views = []
    for view in scene.views:
        gray = np.clip(np.rint(120.0 + 3.0 * rng.standard_normal(view.rgb.shape[:2])), 0, 255).astype(np.uint8)
        views.append(type(view)(view.name, np.repeat(gray[:, :, None], 3, axis=2), None, view.k, view.cam_from_world))
    blank = DenseScene(tuple(views), scene.neighbors, scene.point_xyz, scene.point_ptr, scene.point_view_idx)
    assert len(densify(blank, DenseOptions())[0]) < 0.002 * WIDTH * HEIGHT


def test_masks_keep_patches_out() -> None:
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:, : WIDTH // 2] = False
    scene, _, _ = scene_of(wall_with_box_and_bars(), NUM_VIEWS, masks=[mask] * NUM_VIEWS)
    patches, _ = densify(scene, DenseOptions(cell_px=2))
    assert len(patches) > 1000
    for p, m in ((np.arange(len(patches)), patches.reference_idx),):
        for view_idx, view in enumerate(scene.views):
            mine = p[m == view_idx]
            pixels, _ = project(view, patches.xyz[mine])
            assert (pixels[:, 0] > WIDTH // 2 - 1.0).all()


def test_what_other_images_contradict_is_taken_away() -> None:
    scene, _, _ = rendered(0.0)
    grown: list[Growth] = []
    planted = 0
    original = Growth.filter

    def with_outliers(self: Growth) -> dict[str, int]:
        nonlocal planted
        # some patches are moved towards their reference camera, to where there is nothing: the bars are not as near
        rng = np.random.default_rng(0)
        chosen = rng.choice(self.count, self.count // 50, replace=False)
        eye = self.images.center[self.store.views[chosen, 0]]
        self.store.xyz[chosen] += (0.4 * (eye - self.store.xyz[chosen])).astype(np.float32)
        self.store.wave[chosen] = 100000
        planted = len(chosen)
        grown.append(self)
        return original(self)

    Growth.filter = with_outliers  # type: ignore[method-assign]
    try:
        patches, _ = densify(scene, DenseOptions(cell_px=2))
    finally:
        Growth.filter = original  # type: ignore[method-assign]
    assert planted > 300
    assert (patches.wave == 100000).sum() < 0.02 * planted
    assert len(patches) > 0.8 * len(patches_of(0.0, 2))


def test_a_run_can_be_stopped() -> None:
    events = Events()
    events.cancel()
    with pytest.raises(InterruptedRunError):
        densify(rendered(0.0)[0], DenseOptions(cell_px=4), events=events)
