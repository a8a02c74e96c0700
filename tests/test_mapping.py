"""The incremental loop on synthetic scenes with known ground truth."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from sfmapp.adjust.options import AdjustOptions
from sfmapp.camera.camera import CameraModel, simple_camera
from sfmapp.errors import NoReconstructionError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.mapping.incremental import map_images
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.structure import residual_scale_px
from sfmapp.scene.correspondences import TwoViewConfig
from sfmapp.scene.features import Features
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import SyntheticScene, make_scene, true_correspondences


def inputs(scene: SyntheticScene, focal_ratio: float | None = 1.2):
    """Image set, features and matches of a scene; cameras know no more than a default focal, or everything (None)."""
    cameras = []
    for camera in scene.ground_truth.cameras:
        guess = simple_camera(camera.model, camera.width, camera.height, (focal_ratio or 1) * camera.width)
        cameras.append(camera if focal_ratio is None else guess)
    records = [
        SimpleNamespace(name=name, camera_idx=int(c))
        for name, c in zip(scene.ground_truth.image_names, scene.ground_truth.image_camera_idx, strict=True)
    ]
    features = []
    for i in range(len(records)):
        xy = scene.keypoints(i)
        keypoints = np.concatenate([xy, np.ones_like(xy)], 1).astype(np.float32)
        features.append(Features(keypoints, np.zeros((len(xy), 128), np.uint8), np.full((len(xy), 3), 7, np.uint8)))
    return SimpleNamespace(images=records, cameras=tuple(cameras), skipped=()), features, true_correspondences(scene)


def reconstruct(scene: SyntheticScene, focal_ratio: float | None = 1.2, threads: int = 1, **options):
    image_set, features, found = inputs(scene, focal_ratio)
    return map_images(
        image_set, features, found, MappingOptions(**options), adjust_options=AdjustOptions(), threads=threads,
        events=Events(),
    )  # fmt: skip


def center_errors(model: Reconstruction, ground_truth: Reconstruction) -> np.ndarray:
    """Distances of the centres after a similarity fit, as a share of the scene's size."""
    common = model.is_registered
    a, b = model.centers[common], ground_truth.centers[common]
    a0, b0 = a - a.mean(0), b - b.mean(0)
    u, s, vt = np.linalg.svd(b0.T @ a0)
    d = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    scale = (s * np.diag(d)).sum() / (a0**2).sum()
    return np.linalg.norm(scale * a0 @ (u @ d @ vt).T - b0, axis=1) / np.sqrt((b0**2).sum(1).mean())


@pytest.mark.parametrize("layout", ["ring", "grid"])
def test_every_image_is_registered_and_errors_have_the_size_of_the_noise(layout):
    scene = make_scene(1, 14, 1500, layout=layout, sigma_px=0.5)
    models, report = reconstruct(scene)
    assert len(models) == 1
    assert models[0].is_registered.all()
    error = center_errors(models[0], scene.ground_truth)
    # half a pixel over a focal of 900 is 5.6e-4; hundreds of points average it, the free intrinsics take some back
    assert 2e-4 < np.median(error) < 2e-3
    assert error.max() < 4e-3
    assert models[0].is_triangulated.mean() > 0.99
    assert models[0].obs_is_inlier.mean() > 0.95
    # noise, less what the fitted points, poses, focal length and distortion take of it; the gauge of 7 is free
    num_values, num_fitted = 2 * models[0].obs_is_inlier.sum(), 3 * models[0].is_triangulated.sum() + 6 * 14 + 2 - 7
    rms = models[0].summary()["rms_reprojection_error_px"]
    assert rms == pytest.approx(0.5 * np.sqrt(2 * (1 - num_fitted / num_values)), rel=0.03)
    assert [entry["model"] for entry in report["images"]] == [0] * 14


def test_exact_observations_give_the_exact_scene():
    scene = make_scene(2, 10, 800, sigma_px=0.0)
    models, _ = reconstruct(scene, focal_ratio=None)
    assert models[0].is_registered.all()
    assert models[0].obs_is_inlier.mean() > 0.95
    assert center_errors(models[0], scene.ground_truth).max() < 1e-5
    assert models[0].summary()["rms_reprojection_error_px"] < 1e-4


def test_gtsam_as_the_backend_comes_to_the_same():
    scene = make_scene(11, 8, 300, sigma_px=0.4)
    image_set, features, found = inputs(scene)
    models = [
        map_images(
            image_set, features, found, MappingOptions(refine_principal_point="never"),
            adjust_options=AdjustOptions(backend=backend), threads=1, events=Events(),
        )[0][0]
        for backend in ("schur", "gtsam")
    ]  # fmt: skip
    np.testing.assert_array_equal(models[0].obs_is_inlier, models[1].obs_is_inlier)
    assert center_errors(models[1], models[0]).max() < 1e-4
    assert models[1].cameras[0].focal == pytest.approx(models[0].cameras[0].focal, rel=1e-4)


def test_uncertainty_has_the_size_of_the_error():
    ratios = []
    for seed in range(6):
        scene = make_scene(20 + seed, 10, 400, sigma_px=0.5)
        models, report = reconstruct(scene)
        uncertainty = report["models"][0]["uncertainty"]
        assert uncertainty["noise_px"] == pytest.approx(0.5, rel=0.15)
        sigma = uncertainty["cameras"][0]["sigma"]["f"]
        ratios.append((models[0].cameras[0].focal - scene.ground_truth.cameras[0].focal) / sigma)
    assert 0.2 < np.sqrt(np.mean(np.square(ratios))) < 2.0  # a chi of 6 degrees of freedom over root 6


def test_same_bytes_on_any_number_of_threads():
    scene = make_scene(4, 10, 800)
    one, two = reconstruct(scene, threads=1)[0][0], reconstruct(scene, threads=2)[0][0]
    assert one.cam_from_world.tobytes() == two.cam_from_world.tobytes()
    assert one.point_xyz.tobytes() == two.point_xyz.tobytes()
    assert one.obs_is_inlier.tobytes() == two.obs_is_inlier.tobytes()
    assert one.cameras[0].params.tobytes() == two.cameras[0].params.tobytes()


@pytest.mark.parametrize("ratio", [0.7, 2.0])
def test_unknown_focal_length_is_found(ratio):
    camera = simple_camera(CameraModel.SIMPLE_RADIAL, 1000, 750, ratio * 1000)
    scene = make_scene(5, 10, 1500, camera, layout="grid" if ratio < 1 else "ring", sigma_px=0.5)
    models, report = reconstruct(scene)
    assert models[0].is_registered.all()
    assert models[0].cameras[0].focal == pytest.approx(ratio * 1000, rel=0.01)
    # what the pairs tell beforehand is a step of a grid, and far better than the default of 1.2
    assert report["focal"]["ratio"] == pytest.approx(ratio, rel=0.06)
    assert report["focal"]["loss"] < 0.6 * report["focal"]["loss_at_default"]


def test_one_camera_per_image():
    cameras = [simple_camera(CameraModel.SIMPLE_RADIAL, 1000, 750, f) for f in np.linspace(700, 1500, 12)]
    scene = make_scene(6, 12, 1500, cameras, sigma_px=0.5)
    models, _ = reconstruct(scene)
    assert models[0].is_registered.all()
    focal = np.array([c.focal for c in models[0].cameras])
    np.testing.assert_allclose(focal, np.linspace(700, 1500, 12), rtol=0.025)


def test_a_scene_in_two_parts_makes_two_models():
    scene = make_scene(7, 16, 1500, sigma_px=0.3)
    image_set, features, found = inputs(scene)
    first = np.arange(16) < 9
    across = first[found.pair_image_idx[:, 0]] != first[found.pair_image_idx[:, 1]]
    keep = np.flatnonzero(~across)
    counts = found.num_inliers[keep]
    from dataclasses import fields, replace

    per_pair = {f.name: getattr(found, f.name)[keep] for f in fields(found) if f.name not in ("pair_ptr", "matches")}
    parted = replace(
        found, **per_pair, pair_ptr=np.concatenate([[0], np.cumsum(counts)]),
        matches=np.concatenate([found.matches_of_pair(p) for p in keep]),
    )  # fmt: skip
    models, report = map_images(
        image_set, features, parted, MappingOptions(), adjust_options=AdjustOptions(), threads=1, events=Events()
    )
    assert [int(m.is_registered.sum()) for m in models] == [9, 7]
    assert [entry["model"] for entry in report["images"]] == [0] * 9 + [1] * 7
    for model in models:
        assert np.median(center_errors(model, scene.ground_truth)) < 2e-3


@pytest.mark.parametrize(
    "config", [TwoViewConfig.PANORAMIC, TwoViewConfig.PLANAR_OR_PANORAMIC, TwoViewConfig.WATERMARK]
)
def test_pairs_without_depth_start_nothing(config):
    scene = make_scene(8, 5, 400)
    image_set, features, found = inputs(scene)
    found.config[:] = config
    with pytest.raises(NoReconstructionError, match="no initial pair") as caught:
        map_images(
            image_set, features, found, MappingOptions(), adjust_options=AdjustOptions(), threads=1, events=Events()
        )
    assert [entry["model"] for entry in caught.value.report["images"]] == [None] * 5
    assert all("too few verified matches" in entry["reason"] for entry in caught.value.report["images"])
    assert "moving sideways" in caught.value.advice


def test_no_matches_is_a_clear_answer():
    scene = make_scene(9, 3, 100)
    image_set, features, found = inputs(scene)
    found.config[:] = TwoViewConfig.UNDEFINED
    with pytest.raises(NoReconstructionError, match="no two images share"):
        map_images(
            image_set, features, found, MappingOptions(min_pose_inliers=10_000), adjust_options=AdjustOptions(),
            threads=1, events=Events(),
        )  # fmt: skip


def test_an_image_that_cannot_be_registered_is_explained():
    scene = make_scene(10, 8, 600, sigma_px=0.3)
    image_set, features, found = inputs(scene)
    touching = (found.pair_image_idx == 7).any(1)
    found.config[touching] = TwoViewConfig.UNDEFINED
    models, report = map_images(
        image_set, features, found, MappingOptions(), adjust_options=AdjustOptions(), threads=1, events=Events()
    )
    assert models[0].is_registered.tolist() == [True] * 7 + [False]
    assert "too few verified matches" in report["images"][7]["reason"]
    assert [entry["model"] for entry in report["images"]] == [0] * 7 + [None]
    assert np.median(center_errors(models[0], scene.ground_truth)) < 2e-3


def test_residual_scale_leaves_out_points_behind_their_camera() -> None:
    # cameras that all look one way, so that a point can be behind all of them
    model = make_scene(0, 6, 300, layout="grid", sigma_px=0.5).observed.copy()
    model.obs_is_inlier[:] = True
    before = residual_scale_px(model)
    assert before == pytest.approx(0.5, rel=0.1)
    behind = np.arange(300) % 5 < 2
    model.point_xyz[behind] = 2 * rigid3.center(model.cam_from_world).mean(0) - model.point_xyz[behind]
    # of so many, anything that they have to say would move the median
    assert residual_scale_px(model) == pytest.approx(before, rel=0.1)
    assert residual_scale_px(model, 2 * before) == 2 * before
    model.obs_is_inlier[:] = False
    assert np.isnan(residual_scale_px(model))
    assert residual_scale_px(model, 0.5) == 0.5
