"""A bent model is told by the relative poses that its pairs have by themselves; a right one is left alone."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.geometry import rigid3
from sfmapp.mapping.pair_motions import contradiction_of
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import SyntheticScene, make_scene, true_correspondences


def placed(scene: SyntheticScene, turn_deg: float) -> Reconstruction:
    """The cameras of a scene at their true places, but for the second half, which is turned as a whole about the middle
    of all centres."""
    model = scene.observed.copy()
    model.cam_from_world[:] = scene.ground_truth.cam_from_world
    half = np.arange(len(model.image_names)) >= len(model.image_names) // 2
    rotation, middle = rigid3.exp_so3(np.radians([0.0, turn_deg, 0.0])), scene.ground_truth.centers.mean(0)
    turn = rigid3.from_matrix(rotation, middle - rotation @ middle)
    model.cam_from_world[half] = rigid3.compose(model.cam_from_world[half], turn)
    return model


@pytest.mark.parametrize("seed", range(3))
def test_right_poses_are_not_contradicted_whatever_the_noise(seed: int) -> None:
    for sigma_px in (0.1, 0.5, 1.0):
        scene = make_scene(seed, 8, 600, sigma_px=sigma_px)
        assert contradiction_of(placed(scene, 0.0), true_correspondences(scene)) == []


@pytest.mark.parametrize("turn_deg", [0.3, 0.5])
def test_a_bend_is_said_by_as_much_as_it_is(turn_deg: float) -> None:
    scene = make_scene(1, 8, 600, sigma_px=0.3)
    (found,) = contradiction_of(placed(scene, turn_deg), true_correspondences(scene))
    assert found.subject == "relative poses of pairs"
    # pairs across the bend are off by all of it, those on one side by nothing
    assert found.evidence["median_turn_deg"] == pytest.approx(turn_deg, rel=0.2)
    # each camera is off by half of it, about one axis of three
    assert 0.5 < found.rotation_sigma_deg / (0.5 * turn_deg / np.sqrt(3.0)) < 2.5
    assert 0 < found.evidence["num_pairs_against"] < found.evidence["num_pairs"]
