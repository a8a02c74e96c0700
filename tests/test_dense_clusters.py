"""Clusters of views: every view in one core, none too large, and the same surface without doubles."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from dense_models import DEPTH, PINHOLE, write_wall
from sfmapp.dense.clusters import BASE_MB, Cluster, in_core, make_clusters, merge_clusters
from sfmapp.dense.densify import densify
from sfmapp.dense.options import DenseOptions
from sfmapp.dense.photographs import find_photographs
from sfmapp.dense.prepare import DensePlan, load_scene, part_of, plan_views
from sfmapp.dense.scene import Patches
from sfmapp.images.image_set import ImageOptions

OPTIONS = DenseOptions(cell_px=2, max_neighbors=4)


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> DensePlan:
    folder = tmp_path_factory.mktemp("wall")
    model = write_wall(folder, 8)
    found = find_photographs(model, folder / "images", ImageOptions(), is_upright=False)
    return plan_views(model, found, OPTIONS)[0]


def test_every_view_is_in_one_core_and_no_cluster_is_too_large(plan: DensePlan) -> None:
    whole = make_clusters(plan, 2, 10_000)
    assert len(whole) == 1
    np.testing.assert_array_equal(whole[0].core, np.arange(8))
    clusters = make_clusters(plan, 2, 0.6 * (whole[0].memory_mb - BASE_MB) + BASE_MB)
    assert len(clusters) > 1
    assert sorted(np.concatenate([cluster.core for cluster in clusters]).tolist()) == list(range(8))
    for cluster in clusters:
        assert cluster.memory_mb < whole[0].memory_mb
        around = plan.neighbors[cluster.core]
        assert set(around[around >= 0].tolist()) | set(cluster.core.tolist()) == set(cluster.views.tolist())
        # cameras stand in a row: so do those of a core
        np.testing.assert_array_equal(np.diff(cluster.core), 1)
    assert len(make_clusters(plan, 2, 1)) == 8


def parts_of(plan: DensePlan) -> list[Cluster]:
    """Two or more clusters."""
    whole = make_clusters(plan, 2, 10_000)[0]
    return make_clusters(plan, 2, BASE_MB + 0.75 * (whole.memory_mb - BASE_MB))


def test_clusters_make_the_same_surface(plan: DensePlan) -> None:
    whole, _ = densify(load_scene(plan), OPTIONS)
    parts = []
    for cluster in parts_of(plan):
        patches, _ = densify(load_scene(part_of(plan, cluster.views, cluster.core)), OPTIONS)
        mine = in_core(patches, cluster)
        assert np.isin(mine.reference_idx, cluster.core).all()
        parts.append(mine)
    assert len(parts) >= 2
    merged = merge_clusters(plan, 2, parts)
    assert len(merged) < sum(map(len, parts))
    pixel = DEPTH / PINHOLE.focal
    for patches in (whole, merged):
        assert np.quantile(np.abs(patches.xyz[:, 2] - DEPTH), 0.95) < pixel
    assert 0.8 * len(whole) < len(merged) < 1.4 * len(whole)
    # the cells of all views are as full as those of a single run
    counts = [np.bincount(patches.view_idx, minlength=8) for patches in (whole, merged)]
    assert (counts[1] > 0.75 * counts[0]).all()


def _first_and_others(patches: Patches) -> list[NDArray[np.int32]]:
    """Of each patch the reference and the second, the reference and the third of its views."""
    start = patches.view_ptr[:-1]
    return [np.stack([patches.view_idx[start], patches.view_idx[start + k]], axis=1).ravel() for k in (1, 2)]


def shifted(patches: Patches, depth: float) -> Patches:
    return replace(patches, xyz=patches.xyz + np.array([0.0, 0.0, depth]))


def test_a_double_goes_and_a_second_layer_stays(plan: DensePlan) -> None:
    one, _ = densify(load_scene(plan), OPTIONS)
    one = one.subset(np.flatnonzero(one.num_views >= 3)[::7])
    again = merge_clusters(plan, 2, [one, one])
    np.testing.assert_array_equal(again.xyz, one.xyz)
    np.testing.assert_array_equal(again.view_ptr, one.view_ptr)
    np.testing.assert_array_equal(again.view_idx, one.view_idx)
    # seen by some views in one cluster and by others in the next: trusted by all of them
    halves = [replace(one, view_ptr=2 * np.arange(len(one) + 1), view_idx=idx) for idx in _first_and_others(one)]
    joined = merge_clusters(plan, 2, halves)
    assert len(joined) == len(one)
    np.testing.assert_array_equal(joined.num_views, 3)
    np.testing.assert_array_equal(joined.reference_idx, one.reference_idx)
    pixel = float(np.median(one.size))
    close = merge_clusters(plan, 2, [one, shifted(one, 1.0 * pixel)])
    assert len(close) < 1.05 * len(one)
    layers = merge_clusters(plan, 2, [one, shifted(one, 30.0 * pixel)])
    assert len(layers) == 2 * len(one)
    nothing = one.subset(np.zeros(len(one), bool))
    around = merge_clusters(plan, 2, [nothing, one, nothing, one])
    np.testing.assert_array_equal(around.xyz, one.xyz)
    np.testing.assert_array_equal(around.view_idx, one.view_idx)


def test_a_cluster_does_not_depend_on_threads(plan: DensePlan, tmp_path: Path) -> None:
    cluster = parts_of(plan)[0]
    first, second = (
        densify(load_scene(part_of(plan, cluster.views, cluster.core), threads=n), OPTIONS, threads=n)[0]
        for n in (1, 2)
    )
    np.testing.assert_array_equal(first.xyz, second.xyz)
    np.testing.assert_array_equal(first.view_idx, second.view_idx)
