"""A scene with something flat in every picture that is no part of it: the same scene as without."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sfmapp.adjust.options import AdjustOptions
from sfmapp.camera.camera import CameraModel, simple_camera
from sfmapp.events import Events
from sfmapp.mapping.incremental import map_images
from sfmapp.mapping.options import MappingOptions
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.stage import MatchedPair, join_pairs
from sfmapp.matching.two_view import Ransac, verify_pair
from sfmapp.scene.features import Features
from sfmapp.scene.synthetic import make_scene, true_correspondences
from test_mapping import center_errors

CAMERA = simple_camera(CameraModel.SIMPLE_RADIAL, 1000, 750, 900.0)
NUM_FLAT = 250


def with_poster(seed: int, is_still: bool):
    """Verified matches of nine aerial photographs, a fifth of each hidden by a poster that matches everywhere."""
    scene = make_scene(seed, 9, 1500, CAMERA, layout="grid", sigma_px=0.4)
    rng = np.random.default_rng([seed, 9])
    spot = rng.uniform(0, [400, 330], (NUM_FLAT, 2))
    image_set = SimpleNamespace(images=[], cameras=(replace(CAMERA.with_focal(1200.0)),), skipped=())
    features, visible = [], []
    for i, name in enumerate(scene.ground_truth.image_names):
        corner = np.array([300.0, 400.0]) if is_still else rng.uniform(0, [600, 420])
        xy = scene.keypoints(i)
        visible.append(~((xy > corner) & (xy < corner + np.array([400, 330]))).all(1))
        xy = np.concatenate([xy, spot + corner + rng.normal(0, 0.3, spot.shape)])
        keypoints = np.concatenate([xy, np.ones_like(xy)], 1).astype(np.float32)
        features.append(Features(keypoints, np.zeros((len(xy), 128), np.uint8), np.zeros((len(xy), 3), np.uint8)))
        image_set.images.append(SimpleNamespace(name=name, camera_idx=0))
    true = true_correspondences(scene, min_matches=1)
    pairs = []
    for p, (i, j) in enumerate(true.pair_image_idx):
        matches = true.matches_of_pair(p)
        matches = matches[visible[i][matches[:, 0]] & visible[j][matches[:, 1]]]
        flat = np.stack([len(f) - NUM_FLAT + np.arange(NUM_FLAT) for f in (features[i], features[j])], 1)
        matches = np.concatenate([matches, flat.astype(np.int32)])
        xy1, xy2 = (features[k].keypoints[matches[:, s], :2].astype(np.float64) for s, k in enumerate((i, j)))
        camera = image_set.cameras[0]
        found = verify_pair(xy1, xy2, camera, camera, MatchingOptions(), Ransac(1000, p))
        pairs.append(MatchedPair(matches[found.is_inlier], len(matches), found))
    return (
        scene,
        image_set,
        features,
        join_pairs(true.pair_image_idx, pairs),
        [p.geometry.num_moving_alone for p in pairs],
    )


@pytest.mark.parametrize(("seed", "is_still"), [(1, False), (2, False), (3, True)])
def test_the_scene_is_mapped_as_if_nothing_were_in_front_of_it(seed, is_still):
    scene, image_set, features, found, set_aside = with_poster(seed, is_still)
    (model, *more), _ = map_images(
        image_set, features, found, MappingOptions(), adjust_options=AdjustOptions(), threads=1, events=Events()
    )
    assert more == []
    assert model.is_registered.all()
    assert center_errors(model, scene.ground_truth).max() < 0.02
    used = np.bincount(model.tracks.obs_image_idx[model.obs_is_inlier], minlength=9)
    on_poster = (
        model.tracks.obs_feature_idx >= np.array([len(f) for f in features])[model.tracks.obs_image_idx] - NUM_FLAT
    )
    assert used.min() > 100
    assert (on_poster & model.obs_is_inlier).sum() < 0.02 * used.sum()
    assert np.count_nonzero(set_aside) >= 3
