"""A scene seen through each lens, mapped from its matches alone."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from sfmapp.adjust.solver import AdjustOptions
from sfmapp.camera.camera import CameraModel
from sfmapp.events import Events
from sfmapp.mapping.incremental import map_images
from sfmapp.mapping.options import MappingOptions
from sfmapp.scene.features import Features
from sfmapp.scene.synthetic import make_scene, synthetic_camera, true_correspondences


@pytest.mark.parametrize("model", list(CameraModel), ids=lambda model: model.name)
def test_every_image_is_registered(model: CameraModel) -> None:
    """With a calibration that is a little off in all that can be refined."""
    scene = make_scene(7, 10, 900, synthetic_camera(model), layout="ring", sigma_px=0.4)
    camera = scene.ground_truth.cameras[0]
    given = camera.with_focal(1.004 * camera.focal)
    records = [SimpleNamespace(name=name, camera_idx=0) for name in scene.ground_truth.image_names]
    features = []
    for i in range(len(records)):
        xy = scene.keypoints(i)
        keypoints = np.concatenate([xy, np.ones_like(xy)], 1).astype(np.float32)
        features.append(Features(keypoints, np.zeros((len(xy), 128), np.uint8), np.full((len(xy), 3), 7, np.uint8)))
    image_set = SimpleNamespace(images=records, cameras=(given,), skipped=())
    models, _ = map_images(
        image_set, features, true_correspondences(scene), MappingOptions(), adjust_options=AdjustOptions(), threads=1,
        events=Events(),
    )  # fmt: skip
    assert len(models) == 1
    assert models[0].is_registered.all()
    rms = models[0].summary()["rms_reprojection_error_px"]
    assert 0.3 < rms < 0.4 * np.sqrt(2) * 1.05
