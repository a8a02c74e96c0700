"""Depth by a sweep of planes, on rendered scenes of exact depth."""

from __future__ import annotations

from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import dense_scenes
from sfmapp.carve.plane_sweep import Planes, SweptDepth, SweptPlanes, measured, sweep_planes
from sfmapp.carve.sweep_agreement import confirm
from sfmapp.carve.sweep_exchange import brought, exchange_planes
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.errors import NoReconstructionError
from sfmapp.geometry import rigid3

MIDDLE = 2


def measured_alone(views: DenseScene, view: int, pool: Executor | None = None) -> SweptDepth:
    return measured(views, view, sweep_planes(views, view, pool))


@cache
def scene() -> tuple[DenseScene, list[np.ndarray]]:
    """Five noisy views of a wall with a box and bars before it."""
    views, depths, _ = dense_scenes.scene_of(dense_scenes.wall_with_box_and_bars(), 5, 2.0)
    return views, depths


@cache
def planes_of(view: int) -> SweptPlanes:
    return sweep_planes(scene()[0], view)


@cache
def swept(view: int = MIDDLE) -> SweptDepth:
    return measured(scene()[0], view, planes_of(view))


def test_depth_is_that_of_the_scene_and_as_far_off_as_it_says() -> None:
    found, truth = swept(), scene()[1][MIDDLE]
    known = np.isfinite(found.depth)
    error = np.abs(found.depth - truth)[known]
    assert known.mean() > 0.97
    assert (error < 0.01 * truth[known]).mean() > 0.97
    # a tenth of a plane of 1.1 cm here
    assert np.median(error) < 0.004
    inside = (error < found.sigma[known]).mean()
    assert 0.68 < inside < 0.97
    # four neighbours and not one: what the table expects of a pair is a little more than there is
    off = np.abs(1.0 / found.depth - 1.0 / truth)[known] / found.planes.step
    doubtful = found.confidence[known] < 0.8
    assert (off[~doubtful] < 1.0).mean() > 0.99
    assert (off[doubtful] < 1.0).mean() < (off[~doubtful] < 1.0).mean() - 0.02


def test_planes_are_even_in_inverse_depth() -> None:
    planes = Planes(0.1, 0.02, 6)
    assert planes.depth(np.array([0.0, 2.5, 5.0])) == pytest.approx([10.0, 1.0 / 0.15, 5.0])
    assert planes.depth(np.array([-6.0])) == pytest.approx([np.inf])


def test_a_neighbour_held_upside_down_tells_the_same() -> None:
    views, depths = scene()
    turned = list(views.views)
    half_turn = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    for m in (1, 3):
        view = turned[m]
        k = view.k.copy()
        k[2:] = [view.width - k[2], view.height - k[3]]
        rgb = np.ascontiguousarray(view.rgb[::-1, ::-1])
        turned[m] = replace(view, rgb=rgb, k=k, cam_from_world=rigid3.compose(half_turn, view.cam_from_world))
    found = measured_alone(replace(views, views=tuple(turned)), MIDDLE)
    both = np.isfinite(found.depth) & np.isfinite(swept().depth)
    assert both.mean() > 0.97
    assert np.quantile(np.abs(found.depth - swept().depth)[both] / depths[MIDDLE][both], 0.95) < 2e-3


def test_masked_pixels_have_no_depth_and_masked_neighbours_say_nothing() -> None:
    views, depths = scene()
    height, width = depths[0].shape
    open_right = np.tile(np.arange(width) >= width // 2, (height, 1))
    some = [replace(view, mask=open_right if m in (0, MIDDLE) else None) for m, view in enumerate(views.views)]
    found = measured_alone(replace(views, views=tuple(some)), MIDDLE)
    assert not np.isfinite(found.depth[:, : width // 2]).any()
    right = found.depth[:, width // 2 :]
    known = np.isfinite(right)
    assert known.mean() > 0.95
    assert (np.abs(right - depths[MIDDLE][:, width // 2 :])[known] < 0.01 * right[known]).mean() > 0.95


def test_bytes_do_not_depend_on_threads() -> None:
    with ThreadPoolExecutor(1) as pool:
        found = measured_alone(scene()[0], MIDDLE, pool)
    for one, other in ((found.depth, swept().depth), (found.sigma, swept().sigma)):
        assert one.tobytes() == other.tobytes()


def test_pictures_of_noise_have_hardly_any_depth() -> None:
    views, _ = scene()
    rng = np.random.default_rng(3)
    noise = [replace(view, rgb=rng.integers(0, 256, view.rgb.shape, np.uint8)) for view in views.views]
    assert np.isfinite(measured_alone(replace(views, views=tuple(noise)), MIDDLE).depth).mean() < 0.05


def test_a_view_without_neighbours_is_named() -> None:
    views, _ = scene()
    alone = views.neighbors.copy()
    alone[1] = -1
    with pytest.raises(NoReconstructionError, match=r"1\.png: no other photograph"):
        measured_alone(replace(views, neighbors=alone), 1)


def test_other_maps_confirm_what_is_right_and_contradict_what_is_not() -> None:
    views, depths = scene()
    others = [(views.views[m], swept(m)) for m in (0, 1, 3, 4)]
    wrong = swept().depth.copy()
    wrong[100:130, 20:60] *= 0.9  # afloat before the wall
    agree, against = confirm(views.views[MIDDLE], replace(swept(), depth=wrong), others)
    assert np.median(against[105:125, 25:55]) >= 2
    assert (agree[105:125, 25:55] == 0).mean() > 0.9
    right = np.abs(wrong - depths[MIDDLE]) < 0.002 * wrong
    assert (agree[right] > against[right]).mean() > 0.97


def test_maps_say_nothing_of_what_they_do_not_show() -> None:
    views, _ = scene()
    nothing = replace(swept(0), depth=np.full_like(swept(0).depth, np.nan))
    agree, against = confirm(views.views[MIDDLE], swept(), [(views.views[0], nothing)])
    assert not agree.any()
    assert not against.any()


def test_a_plane_is_the_same_plane_in_another_view() -> None:
    views, depths = scene()
    view, other = views.views[1], views.views[MIDDLE]
    # a wall across the line of sight at a slant, n x = 1 in the frame of the view
    normal = np.array([0.2, -0.15, 1.0]) / np.median(depths[1])

    def exact(to: DenseView) -> tuple[np.ndarray, np.ndarray]:
        pose = rigid3.compose(to.cam_from_world, rigid3.inverse(view.cam_from_world))
        own = rigid3.rotation_matrix(pose) @ normal
        own /= 1.0 + own @ pose[4:]
        v, u = np.mgrid[: to.height, : to.width] + 0.5
        fx, fy, cx, cy = to.k
        return own[0] * (u - cx) / fx + own[1] * (v - cy) / fy + own[2], own[:2] / (fx, fy)

    inverse, slopes = exact(view)
    planes = Planes(0.05, 0.01, 20)
    plane = ((inverse - planes.first) / planes.step).astype(np.float32)
    leans = np.broadcast_to(slopes / planes.step, (*plane.shape, 2)).astype(np.float32)
    told, told_slopes = brought(view, SweptPlanes(planes, plane, leans, ()), other)
    known = np.isfinite(told)
    assert known.mean() > 0.5
    true, true_slopes = exact(other)
    np.testing.assert_allclose(told[known], true[known], rtol=1e-5)
    np.testing.assert_allclose(told_slopes[known], np.broadcast_to(true_slopes, told_slopes.shape)[known], rtol=1e-3)


def test_other_maps_fill_what_one_lost_and_right_what_it_got_wrong() -> None:
    views, depths = scene()
    damaged = planes_of(MIDDLE).plane.copy()
    lost, wrong = np.s_[40:70, 20:60], np.s_[100:130, 20:60]
    damaged[lost] = np.nan
    damaged[wrong] *= 0.7
    told = {m: planes_of(m) for m in range(5)} | {MIDDLE: replace(planes_of(MIDDLE), plane=damaged)}
    alone, found = (measured(views, MIDDLE, each) for each in (told[MIDDLE], exchange_planes(views, MIDDLE, told)))
    for part in (lost, wrong):
        true = depths[MIDDLE][part]
        assert (np.abs(alone.depth[part] - true) < 0.01 * true).mean() < 0.1
        assert (np.abs(found.depth[part] - true) < 0.01 * true).mean() > 0.95
    # and nothing is lost elsewhere
    right, before = (np.abs(each.depth - depths[MIDDLE]) < 0.01 * depths[MIDDLE] for each in (found, swept()))
    assert right.mean() > before.mean() - 0.002
    with ThreadPoolExecutor(1) as pool:
        again = exchange_planes(views, MIDDLE, told, pool)
    assert again.plane.tobytes() == exchange_planes(views, MIDDLE, told).plane.tobytes()


def test_masked_pixels_are_told_nothing() -> None:
    views, _ = scene()
    some, own = list(views.views), planes_of(MIDDLE)
    mask = np.ones(own.plane.shape, np.bool_)
    mask[:, :50] = False
    some[MIDDLE] = replace(some[MIDDLE], mask=mask)
    masked = replace(own, plane=np.where(mask, own.plane, np.float32(np.nan)))
    told = {m: planes_of(m) for m in range(5)} | {MIDDLE: masked}
    found = exchange_planes(replace(views, views=tuple(some)), MIDDLE, told)
    assert not np.isfinite(found.plane[~mask]).any()
    assert np.isfinite(found.plane[mask]).mean() > 0.97
