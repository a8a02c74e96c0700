"""Mapping with matches that are wrong: they are found out, and the poses stay right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sfmapp.adjust.solver import AdjustOptions
from sfmapp.events import Events
from sfmapp.mapping.incremental import map_images
from sfmapp.mapping.options import MappingOptions
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import SyntheticScene, make_scene, true_correspondences
from test_mapping import center_errors, inputs


def mapped(scene: SyntheticScene, found: Correspondences) -> Reconstruction:
    image_set, features, _ = inputs(scene)
    models, _ = map_images(
        image_set, features, found, MappingOptions(), adjust_options=AdjustOptions(), threads=1, events=Events()
    )
    return models[0]


def of_observations(model: Reconstruction, scene: SyntheticScene, values: np.ndarray) -> np.ndarray:
    """Values by observation of the scene, for the observations of the model."""
    tracks = scene.observed.tracks
    at = {(i, f): k for k, (i, f) in enumerate(zip(tracks.obs_image_idx, tracks.obs_feature_idx, strict=True))}
    ours = zip(model.tracks.obs_image_idx, model.tracks.obs_feature_idx, strict=True)
    return values[[at[key] for key in ours]]


@pytest.mark.parametrize("outlier_ratio", [0.1, 0.2])
def test_observations_at_wrong_places_are_rejected(outlier_ratio: float) -> None:
    """A share of the keypoints lies anywhere in the image, and is matched all the same, in every pair."""
    scene = make_scene(3, 12, 1200, sigma_px=0.5, outlier_ratio=outlier_ratio)
    deceived = replace(scene, obs_is_outlier=np.zeros_like(scene.obs_is_outlier))
    model = mapped(scene, true_correspondences(deceived))
    assert model.is_registered.all()
    is_wrong = of_observations(model, scene, scene.obs_is_outlier)
    assert is_wrong.mean() == pytest.approx(outlier_ratio, rel=0.2)  # they were all there
    track = model.tracks.obs_track_idx
    num_inliers = np.bincount(track[model.obs_is_inlier], minlength=model.tracks.num_tracks)[track]
    is_taken = model.obs_is_inlier & is_wrong
    # a random pixel is within three pixels of the right place once in ten thousand times; of a point that one other
    # image alone tells of, it only has to be as near to an epipolar line, a band of six pixels of some 750
    assert not (is_taken & (num_inliers > 2)).any()
    assert is_taken.sum() <= 2.0 * 6.0 / 750.0 * is_wrong.sum()
    is_mapped = model.is_triangulated[model.tracks.obs_track_idx]
    assert (model.obs_is_inlier & ~is_wrong).sum() > 0.95 * (is_mapped & ~is_wrong).sum()
    assert is_mapped[~is_wrong].mean() > 0.9
    assert np.median(center_errors(model, scene.ground_truth)) < 4e-3
    assert (
        model.summary()["rms_reprojection_error_px"] < 0.5 * np.sqrt(2) * 1.05
    )  # fitted parameters can only take away


@pytest.mark.parametrize("ratio", [0.1, 0.3])
def test_matches_of_different_points_are_rejected(ratio: float) -> None:
    """A share of the matches of every pair joins the keypoints of different points, as repeated texture does."""
    scene = make_scene(3, 12, 1200, sigma_px=0.5)
    found = true_correspondences(scene)
    rng, matches = np.random.default_rng(0), found.matches.copy()
    for begin, end in zip(found.pair_ptr[:-1], found.pair_ptr[1:], strict=True):
        chosen = begin + np.flatnonzero(rng.random(end - begin) < ratio)
        matches[chosen, 1] = np.roll(matches[chosen, 1], 1)
    model = mapped(scene, replace(found, matches=matches))
    assert model.is_registered.all()
    assert np.median(center_errors(model, scene.ground_truth)) < 4e-3
    # of the keypoints that were joined to one point, those of another are left out
    point = of_observations(model, scene, scene.observed.tracks.obs_track_idx)
    kept, track = point[model.obs_is_inlier], model.tracks.obs_track_idx[model.obs_is_inlier]
    first = np.unique(track, return_index=True)[1]
    right = np.zeros(model.tracks.num_tracks, np.int64)
    for t, points in zip(track[first], np.split(kept, first[1:]), strict=True):
        right[t] = np.bincount(points).max()
    assert right.sum() > 0.99 * len(kept)
