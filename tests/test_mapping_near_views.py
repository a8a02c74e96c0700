"""Images that a model puts side by side: pairs that show the same, and pairs that do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfmapp.camera.camera import project
from sfmapp.geometry import rigid3
from sfmapp.mapping import near_views
from sfmapp.mapping.near_views import MAX_ANGLE_DEG, MAX_ZOOM, MIN_VISIBLE
from sfmapp.mapping.verified_pairs import contradictions_of
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import SyntheticScene, make_scene, true_correspondences
from sfmapp.scene.tracks import make_tracks


@pytest.fixture(scope="module", params=["ring", "grid", "forward"])
def scene(request) -> SyntheticScene:
    return make_scene(3, 24, 900, layout=request.param)


def split(model: Reconstruction, is_other: np.ndarray) -> Reconstruction:
    """The model where two sets of images (I,) bool found none of each other's points: each is there twice."""
    tracks = model.tracks
    track = tracks.obs_track_idx + tracks.num_tracks * is_other[tracks.obs_image_idx]
    apart = make_tracks(
        tracks.num_images, 2 * tracks.num_tracks, track, tracks.obs_image_idx, tracks.obs_feature_idx, tracks.obs_xy
    )
    return replace(
        model, tracks=apart, point_xyz=np.tile(model.point_xyz, (2, 1)), point_rgb=np.tile(model.point_rgb, (2, 1)),
        obs_is_inlier=np.ones(apart.num_observations, bool),
    )  # fmt: skip


def test_near_views_of_a_right_model_share_what_both_see(scene):
    model, pairs = scene.ground_truth, true_correspondences(scene, min_matches=1)
    found = near_views.near_views(model, pairs)
    assert len(found.num_visible) > 5
    assert not found.is_missing.any()
    assert not near_views.contradiction_of(model, pairs)
    # nine in ten of the visible points are detected, in each image on its own, and some sides are turned away
    points_alone = near_views.near_views(model, pairs.without(np.arange(pairs.num_pairs)))
    share = points_alone.num_shared / points_alone.num_visible
    assert 0.5 < np.median(share) < 1.0


def test_the_points_in_view_are_those_that_project_into_the_picture(scene):
    model, pairs = scene.ground_truth, true_correspondences(scene, min_matches=1)
    found = near_views.near_views(model, pairs)
    for (i, j), visible in list(zip(found.image_idx, found.num_visible, strict=True))[:5]:
        counts = []
        for a, b in ((i, j), (j, i)):
            obs = model.tracks.observations_of_image(a)
            xyz = model.point_xyz[model.tracks.obs_track_idx[obs[model.obs_is_inlier[obs]]]]
            ray_a, ray_b = xyz - model.centers[a], xyz - model.centers[b]
            far_a, far_b = np.linalg.norm(ray_a, axis=1), np.linalg.norm(ray_b, axis=1)
            angle = np.degrees(np.arccos(np.clip((ray_a * ray_b).sum(1) / (far_a * far_b), -1, 1)))
            seen, in_camera = model.cameras[model.image_camera_idx[b]], rigid3.apply(model.cam_from_world[b], xyz)
            pixel = project(seen, in_camera)
            inside = (in_camera[:, 2] > 0) & ((pixel >= 0) & (pixel < [seen.width, seen.height])).all(1)
            zoom = far_a / far_b
            is_near = (angle <= MAX_ANGLE_DEG) & (zoom <= MAX_ZOOM) & (zoom >= 1 / MAX_ZOOM)
            counts.append((inside & is_near).sum())
        assert min(counts) == visible


def test_images_side_by_side_without_a_match_are_missing(scene):
    other = np.arange(24) % 2 == 1
    all_pairs = true_correspondences(scene, min_matches=1)
    between = other[all_pairs.pair_image_idx[:, 0]] != other[all_pairs.pair_image_idx[:, 1]]
    pairs = all_pairs.without(np.flatnonzero(between))
    model = split(scene.ground_truth, other)
    found = near_views.near_views(model, pairs)
    is_between = other[found.image_idx[:, 0]] != other[found.image_idx[:, 1]]
    assert is_between.sum() >= near_views.MIN_PAIRS
    assert np.array_equal(found.is_missing, is_between)
    count, visible, shared = near_views.missing_between(model, other, ~other, pairs)
    assert count == is_between.sum()
    assert visible >= MIN_VISIBLE * count
    assert shared == 0
    subjects = [c.subject for c in contradictions_of([model], pairs)[0]]
    assert "near views" in subjects


def test_pairs_that_nobody_tried_to_match_say_nothing(scene):
    other = np.arange(24) % 2 == 1
    pairs = true_correspondences(scene, min_matches=1)
    inside = np.flatnonzero(other[pairs.pair_image_idx[:, 0]] == other[pairs.pair_image_idx[:, 1]])
    tried = replace(
        pairs.without(np.setdiff1d(np.arange(pairs.num_pairs), inside)),
        pair_image_idx=np.where(
            np.isin(np.arange(pairs.num_pairs), inside)[:, None], pairs.pair_image_idx, pairs.pair_image_idx[inside[:1]]
        ),
    )
    assert not near_views.near_views(split(scene.ground_truth, other), tried).is_missing.any()
