"""The first focal length, from exact and noisy fundamental matrices."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.camera.camera import CameraModel, simple_camera
from sfmapp.mapping.focal import estimate_focal_ratio
from sfmapp.scene.correspondences import TwoViewConfig
from sfmapp.scene.synthetic import make_scene, true_correspondences

SIZE = (1000, 750)


def estimate(ratio: float, assumed: float = 1.2, layout: str = "grid", source: str = "default", sigma_px: float = 0.5):
    true = simple_camera(CameraModel.SIMPLE_PINHOLE, *SIZE, ratio * SIZE[0])
    scene = make_scene(5, 9, 1500, true, layout=layout, sigma_px=sigma_px)
    found = true_correspondences(scene)
    found.config[found.config == TwoViewConfig.CALIBRATED] = TwoViewConfig.UNCALIBRATED
    camera = simple_camera(CameraModel.SIMPLE_PINHOLE, *SIZE, assumed * SIZE[0], source=source)
    return estimate_focal_ratio([camera], np.zeros(9, np.int32), found, scene.observed.tracks)


@pytest.mark.parametrize("ratio", [0.6, 0.8, 2.0, 2.8])
def test_pairs_give_the_focal_length(ratio):
    found, data = estimate(ratio)
    assert found == pytest.approx(ratio, rel=0.1)
    assert data["loss"] < data["loss_at_default"]


def test_a_right_default_is_kept():
    found, data = estimate(1.2)
    assert found is None  # another explains the pairs no better
    assert data["ratio"] == pytest.approx(1.2, rel=0.05)


def test_what_is_known_is_not_searched():
    found, data = estimate(2.5, source="exif_35mm")
    assert found is None
    assert data["num_pairs"] == 0
