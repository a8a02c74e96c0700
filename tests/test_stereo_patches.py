"""Two views to patches by their disparities: places, normals and sigmas on scenes whose depth is exact."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from dense_scenes import PIXEL_M, depth_errors, scene_of, wall_with_box_and_bars
from sfmapp.dense.options import DenseOptions
from sfmapp.dense.scene import DenseScene, Patches
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.stereo.patches import densify_pair, fit_slopes, stereo_patches


@cache
def pair_of_views() -> tuple[DenseScene, list[NDArray[np.float32]]]:
    """Two neighbours of an arc, ten degrees apart, the second to the left of the first, and points on the wall."""
    scene, depths, _ = scene_of(wall_with_box_and_bars(), 5, noise=1.0)
    x, z = np.meshgrid(np.linspace(-1.2, 1.2, 12), np.linspace(-0.9, 0.9, 8))
    points = np.stack([x, 0.0 * x, z], -1).reshape(-1, 3)
    return DenseScene(
        (scene.views[2], scene.views[1]), np.array([[1], [0]], np.int32), points, 2 * np.arange(len(points) + 1),
        np.tile(np.array([0, 1], np.int32), len(points)),
    ), [depths[2], depths[1]]  # fmt: skip


@cache
def found() -> Patches:
    return stereo_patches(pair_of_views()[0])


def test_places_normals_and_sigmas() -> None:
    scene, depths = pair_of_views()
    patches = found()
    assert len(patches) > 0.6 * 320 * 240
    assert (patches.num_views == 2).all()
    # the second view stands to the left
    assert (patches.reference_idx == np.argmin(scene.centers[:, 0])).all()
    off = depth_errors(scene, depths, patches.xyz, patches.reference_idx)
    assert np.median(off) < PIXEL_M
    assert np.quantile(off, 0.95) < 5.0 * PIXEL_M
    # how far along its ray the wall is
    on_wall = np.abs(patches.xyz[:, 1]) < 8.0 * PIXEL_M
    ray = patches.xyz[on_wall] - scene.centers[patches.reference_idx[0]]
    off = np.abs(patches.xyz[on_wall, 1] / ray[:, 1]) * np.linalg.norm(ray, axis=1)
    # sigmas allow for what a calibration leaves, of which there is nothing here
    assert 0.1 < np.median(off / patches.sigma[on_wall]) < 0.68
    assert np.median(np.degrees(np.arccos(np.clip(-patches.normal[on_wall, 1], -1.0, 1.0)))) < 10.0
    np.testing.assert_allclose(np.linalg.norm(patches.normal, axis=1), 1.0, atol=1e-5)
    assert (np.abs(patches.score) <= 1.0).all()
    assert np.median(patches.score) > 0.8


def test_a_mask_is_kept_to() -> None:
    scene, _ = pair_of_views()
    mask = np.ones((240, 320), np.bool_)
    mask[:, :160] = False
    masked = replace(scene, views=(replace(scene.views[0], mask=mask), scene.views[1]))
    pixel, _ = masked.views[0].project(stereo_patches(masked).xyz)
    assert len(pixel) > 1000
    assert pixel[:, 0].min() >= 160.0


def test_both_ways_cover_more_than_either() -> None:
    scene, _ = pair_of_views()
    patches, report = densify_pair(scene, DenseOptions(min_views=2))
    shares = report.two_views
    assert shares is not None
    assert shares.by_stereo + shares.by_growth == len(patches) == report.funnel[-1].count
    assert 0.5 < min(shares.of_stereo_share, shares.of_growth_share) <= 1.0
    assert shares.is_stereo_first == (shares.of_stereo_share >= shares.of_growth_share)
    assert report.funnel[0].count - report.funnel[1].count == len(patches)


def test_one_camera_in_front_of_the_other_is_left_to_growth() -> None:
    scene, _ = pair_of_views()
    first = scene.views[0]
    ahead = rigid3.compose(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, -0.3]), first.cam_from_world)
    behind = replace(scene, views=(first, replace(first, name="ahead.png", cam_from_world=ahead)))
    with pytest.raises(InputError, match="epipole"):
        stereo_patches(behind)
    _, report = densify_pair(behind, DenseOptions(min_views=2, cell_px=4))
    assert report.two_views is None


def test_slopes_of_planes_with_a_step_beside_them() -> None:
    y, x = np.mgrid[:40, :60].astype(np.float32)
    disparity = (20.0 + 0.3 * x - 0.2 * y).astype(np.float32)
    disparity[:, 30:] += 8.0
    disparity[5, 7] = np.nan
    slopes = np.zeros((40, 60, 2), np.float32)
    fit_slopes(disparity, slopes)
    known = np.isfinite(disparity)
    # a little prior stands against planes of too few pixels
    np.testing.assert_allclose(slopes[known], np.tile([0.3, -0.2], (known.sum(), 1)), atol=2e-3)
    assert not slopes[5, 7].any()
