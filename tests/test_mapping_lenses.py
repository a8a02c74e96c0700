"""A scene seen through each lens, mapped from its matches alone."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from sfmapp.adjust.solver import AdjustOptions
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.mapping.incremental import map_images
from sfmapp.mapping.options import MappingOptions
from sfmapp.scene.features import Features
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import SyntheticScene, make_scene, synthetic_camera, true_correspondences

# A panorama, and lenses that see up to 110 degrees and more from their axis.
WIDE = {
    "panorama": Camera(CameraModel.EQUIRECTANGULAR, 2000, 1000, np.array([2000.0, 1000.0])),
    "fisheye": Camera(CameraModel.OPENCV_FISHEYE, 1000, 1000, np.array([260.0, 261.0, 503, 498, -0.01, 0.002, 0, 0])),
    "eucm": Camera(CameraModel.EUCM, 1000, 1000, np.array([240.0, 241.0, 503.0, 498.0, 0.62, 1.0])),
}


@pytest.mark.parametrize("model", list(CameraModel), ids=lambda model: model.name)
def test_every_image_is_registered(model: CameraModel) -> None:
    """With a calibration that is a little off in all that can be refined."""
    map_and_check(make_scene(7, 10, 900, synthetic_camera(model), layout="ring", sigma_px=0.4))


@pytest.mark.parametrize("lens", WIDE)
def test_every_image_is_registered_from_what_lies_all_round(lens: str) -> None:
    """Views that look anywhere: half of what two have in common may lie behind one of them."""
    scene = make_scene(3, 10, 900, WIDE[lens], layout="inside", sigma_px=0.4)
    model = map_and_check(scene)
    tracks, used = model.tracks, np.flatnonzero(model.obs_is_inlier)
    seen = rigid3.apply(model.cam_from_world[tracks.obs_image_idx[used]], model.point_xyz[tracks.obs_track_idx[used]])
    angle = np.degrees(np.arccos(seen[:, 2] / np.linalg.norm(seen, axis=1)))
    truth = scene.ground_truth
    true = rigid3.apply(truth.cam_from_world[truth.tracks.obs_image_idx], truth.point_xyz[truth.tracks.obs_track_idx])
    behind = (true[:, 2] < 0).mean()
    assert behind > 0.1
    assert (angle > 90.0).mean() > 0.95 * behind
    errors = evaluate_poses(model.image_names, model.cam_from_world, truth.image_names, truth.cam_from_world)
    # 0.4 px of 260 to 320 px a radian, over some hundred points at 3 units
    assert 1e-5 < np.sqrt(np.mean(errors.center_error**2)) < 3e-3


def map_and_check(scene: SyntheticScene) -> Reconstruction:
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
    return models[0]
