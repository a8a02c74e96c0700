"""Depth by a sweep of planes, on rendered scenes of exact depth."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import dense_scenes
from sfmapp.carve.plane_sweep import Planes, SweptDepth, sweep_view
from sfmapp.carve.sweep_agreement import confirm
from sfmapp.dense.scene import DenseScene
from sfmapp.errors import NoReconstructionError
from sfmapp.geometry import rigid3

MIDDLE = 2


@cache
def scene() -> tuple[DenseScene, list[np.ndarray]]:
    """Five noisy views of a wall with a box and bars before it."""
    views, depths, _ = dense_scenes.scene_of(dense_scenes.wall_with_box_and_bars(), 5, 2.0)
    return views, depths


@cache
def swept(view: int = MIDDLE) -> SweptDepth:
    return sweep_view(scene()[0], view)


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
    found = sweep_view(replace(views, views=tuple(turned)), MIDDLE)
    both = np.isfinite(found.depth) & np.isfinite(swept().depth)
    assert both.mean() > 0.97
    assert np.quantile(np.abs(found.depth - swept().depth)[both] / depths[MIDDLE][both], 0.95) < 2e-3


def test_masked_pixels_have_no_depth_and_masked_neighbours_say_nothing() -> None:
    views, depths = scene()
    height, width = depths[0].shape
    open_right = np.tile(np.arange(width) >= width // 2, (height, 1))
    some = [replace(view, mask=open_right if m in (0, MIDDLE) else None) for m, view in enumerate(views.views)]
    found = sweep_view(replace(views, views=tuple(some)), MIDDLE)
    assert not np.isfinite(found.depth[:, : width // 2]).any()
    right = found.depth[:, width // 2 :]
    known = np.isfinite(right)
    assert known.mean() > 0.95
    assert (np.abs(right - depths[MIDDLE][:, width // 2 :])[known] < 0.01 * right[known]).mean() > 0.95


def test_bytes_do_not_depend_on_threads() -> None:
    with ThreadPoolExecutor(1) as pool:
        found = sweep_view(scene()[0], MIDDLE, pool)
    for one, other in ((found.depth, swept().depth), (found.sigma, swept().sigma)):
        assert one.tobytes() == other.tobytes()


def test_pictures_of_noise_have_hardly_any_depth() -> None:
    views, _ = scene()
    rng = np.random.default_rng(3)
    noise = [replace(view, rgb=rng.integers(0, 256, view.rgb.shape, np.uint8)) for view in views.views]
    assert np.isfinite(sweep_view(replace(views, views=tuple(noise)), MIDDLE).depth).mean() < 0.05


def test_a_view_without_neighbours_is_named() -> None:
    views, _ = scene()
    alone = views.neighbors.copy()
    alone[1] = -1
    with pytest.raises(NoReconstructionError, match=r"1\.png: no other photograph"):
        sweep_view(replace(views, neighbors=alone), 1)


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
