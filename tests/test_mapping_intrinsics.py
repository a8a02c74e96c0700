"""Focal lengths and lenses that were given wrong: found out, said, and inside the stated sigmas."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from nadir_block import nadir_block
from sfmapp.adjust.options import AdjustOptions
from sfmapp.camera.camera import Camera, CameraModel, simple_camera
from sfmapp.events import Events
from sfmapp.mapping.incremental import map_images
from sfmapp.mapping.options import MappingOptions
from sfmapp.report.document import camera_rows, make_checks
from sfmapp.scene.synthetic import SyntheticScene, make_scene
from test_mapping import center_errors, inputs

TRUE = simple_camera(CameraModel.SIMPLE_RADIAL, 1000, 750, 900.0)


def map_with(scene: SyntheticScene, camera: Camera, num_cameras: int = 1) -> SimpleNamespace:
    """Map a scene with a given camera; the model, its report row, its checks by name, and the warnings."""
    image_set, features, found = inputs(scene)
    image_set.cameras = (camera,) * num_cameras
    warnings: list[str] = []
    events = Events()
    events.subscribe(lambda event: warnings.append(event.message) if event.kind == "warned" else None)
    models, report = map_images(
        image_set, features, found, MappingOptions(), adjust_options=AdjustOptions(), threads=1, events=events
    )
    row = report["models"][0]
    cameras = camera_rows(image_set, models[0], row["uncertainty"])
    lights = {check["name"]: check["light"] for check in make_checks(report["models"], [], cameras)}
    return SimpleNamespace(
        model=models[0], row=row, lights=lights, warnings=warnings, focal=report["focal"], cameras=cameras
    )


def worst_error_in_sigmas(result: SimpleNamespace, scene: SyntheticScene) -> float:
    """The largest error of a centre, per axis, over its stated standard deviation."""
    centers = result.model.centers
    distances = np.linalg.norm(centers - centers.mean(0), axis=1)
    to_size = np.sqrt((distances**2).mean()) / distances.max()
    sigmas = [entry["center_sigma_share"] for entry in result.row["uncertainty"]["images"].values()]
    return float((center_errors(result.model, scene.ground_truth) * to_size / np.sqrt(3) / sigmas).max())


# ------------------------------------------------------------------------------------------------- wrong focal lengths


@pytest.mark.parametrize(("layout", "factor"), [("ring", 0.33), ("grid", 3.5)])
def test_a_wrong_focal_length_from_exif_is_searched_as_if_unknown(layout, factor):
    scene = make_scene(3, 10, 700, TRUE, layout=layout)
    result = map_with(scene, replace(TRUE.with_focal(900 * factor), focal_sigma=27 * factor, focal_source="exif_35mm"))
    assert result.model.is_registered.all()
    assert result.model.cameras[0].focal == pytest.approx(900, rel=0.01)
    assert result.focal["kept"] == "as_unknown"
    assert any("is wrong by the photographs" in line for line in result.warnings)
    assert result.lights["focal length of camera 0 against its prior"] == "amber"


@pytest.mark.parametrize("factor", [0.96, 1.0, 1.04])
def test_a_focal_length_within_its_sigma_is_not_doubted(factor):
    scene = make_scene(4, 10, 700, TRUE, layout="ring")
    result = map_with(scene, replace(TRUE.with_focal(900 * factor), focal_sigma=27.0, focal_source="exif_35mm"))
    assert result.model.cameras[0].focal == pytest.approx(900, rel=0.01)
    assert "kept" not in result.focal
    assert result.warnings == []
    assert result.lights["focal length of camera 0 against its prior"] == "green"


# ------------------------------------------------------------------------------------------------------- flat scenes


def flat_lens(k1: float, k2: float, p1: float, p2: float) -> Camera:
    return Camera(CameraModel.OPENCV, 3000, 2250, np.array([2222.0, 2222.0, 1500.0, 1125.0, k1, k2, p1, p2]))


def flat_prior(focal: float) -> Camera:
    return simple_camera(CameraModel.SIMPLE_RADIAL, 3000, 2250, focal, 0.1 * focal, "exif_35mm")


@pytest.mark.parametrize("seed", [1, 2])
def test_a_flat_block_says_that_it_does_not_tell_the_focal_length(seed):
    # decentring that the adjusted lens has not: left to itself the focal length goes to 1790 to 1990 px
    scene = nadir_block(seed, flat_lens(-0.1, 0.15, 2e-3, -1e-3), relief=0.2, tilt_deg=1.0, jitter=0.3)
    result = map_with(scene, flat_prior(2222.0))
    found = result.cameras[0]
    assert found["focal_evidence"]["is_determined"] is False
    assert result.lights["focal length of camera 0 against its prior"] == "amber"
    error = abs(result.model.cameras[0].focal - 2222)
    assert error < 150
    assert error < 3 * found["sigma"]["f"] < 3 * 222.3
    assert worst_error_in_sigmas(result, scene) < 3
    assert result.row["contradictions"] == []


@pytest.mark.parametrize("seed", [2, 3])
def test_a_prior_that_photographs_put_elsewhere_without_telling_themselves_is_a_contradiction(seed):
    # EXIF is off by five of its sigmas, and photographs of something flat tell less than it claims to know
    scene = nadir_block(seed, flat_lens(0.0, 0.0, 0.0, 0.0), relief=0.2, tilt_deg=1.0, jitter=0.3)
    result = map_with(scene, replace(flat_prior(2600.0), focal_sigma=78.0))
    found = result.cameras[0]["focal_evidence"]
    assert found["is_determined"] is False
    assert found["tension"] > 2.0
    (contradiction,) = result.row["contradictions"]
    assert "sigmas apart" in contradiction["message"]
    assert contradiction["message"] in result.warnings
    # in between, with a sigma that reaches from one to the other
    error = result.model.cameras[0].focal - 2222
    assert 50 < error < 3 * result.cameras[0]["sigma"]["f"] < 3 * 222.3
    assert worst_error_in_sigmas(result, scene) < 3


def test_a_block_with_relief_tells_it_against_a_prior_that_is_off():
    scene = nadir_block(3, flat_lens(0.0, 0.0, 0.0, 0.0), relief=8.0, tilt_deg=8.0)
    result = map_with(scene, flat_prior(2400.0))
    assert result.cameras[0]["focal_evidence"]["is_determined"] is True
    assert result.model.cameras[0].focal == pytest.approx(2222, rel=2e-3)
    assert result.lights["focal length of camera 0 against its prior"] == "green"


# ------------------------------------------------------------------------------------------------- fixed intrinsics


@pytest.mark.parametrize(("layout", "factor"), [("ring", 0.8), ("grid", 1.25)])
def test_fixed_intrinsics_that_are_wrong_are_red_and_inside_the_stated_sigmas(layout, factor):
    scene = make_scene(5, 10, 900, TRUE, layout=layout)
    result = map_with(scene, replace(TRUE.with_focal(900 * factor), focal_source="user", is_fixed=True))
    assert result.model.cameras[0].focal == 900 * factor  # the user's wish
    (found,) = result.row["contradictions"]
    assert found["subject"] == "given intrinsics"
    assert "f 9" in found["evidence"]["freed"] or "f 8" in found["evidence"]["freed"]
    assert 1e-4 < found["position_sigma_share"] < 1.0
    assert result.lights["contradiction: given intrinsics"] == "red"
    assert any("the photographs indicate" in line for line in result.warnings)
    assert worst_error_in_sigmas(result, scene) < 3


def test_fixed_intrinsics_that_are_right_are_not_contradicted():
    scene = make_scene(6, 10, 900, TRUE)
    result = map_with(scene, replace(TRUE, focal_source="user", is_fixed=True))
    assert result.row["contradictions"] == []
    assert result.warnings == []
    assert worst_error_in_sigmas(result, scene) < 4


# --------------------------------------------------------------------------------------------------- cut photographs


@pytest.mark.parametrize("offset", [0.0, 90.0])
def test_photographs_that_were_cut_each_otherwise_are_red(offset):
    rng = np.random.default_rng(7)
    centers = TRUE.params[1:3] + rng.uniform(-offset, offset, (12, 2))
    scene = make_scene(7, 12, 1500, [TRUE.with_params([900.0, *center, 0.0]) for center in centers], layout="grid")
    for model in (scene.ground_truth, scene.observed):  # all that is known is that the files have one size
        model.cameras, model.image_camera_idx = [TRUE], np.zeros(12, np.int32)
    result = map_with(scene, simple_camera(CameraModel.SIMPLE_RADIAL, 1000, 750, 1200.0, 600.0))
    found = [row["subject"] for row in result.row["contradictions"]]
    assert found == (["cropped photographs"] if offset else [])
    assert worst_error_in_sigmas(result, scene) < (3 if offset else 4)
