"""The comparison with pycolmap and the ground truth: numbers, table, notes and failures, on a scene that both know."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from schemas import check_schema
from sfmapp.errors import InputError, InterruptedRunError, NoReconstructionError, SfmError
from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.evaluation.second_opinion import SecondOpinion
from sfmapp.events import Events
from sfmapp.formats.colmap import write_model
from sfmapp.geometry import rigid3, similarity
from sfmapp.pipelines import validate as pipeline
from sfmapp.report.validation import PycolmapSide, Side, Validation
from sfmapp.reporting import plain
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_scene
from sfmapp.workspace.layout import FORMAT

NUM_IMAGES = 6


@pytest.fixture
def scene() -> Reconstruction:
    return make_scene(num_images=NUM_IMAGES, num_points=60, seed=1).ground_truth


def with_poses(scene: Reconstruction, cam_from_world: np.ndarray) -> Reconstruction:
    copy = scene.copy()
    copy.cam_from_world = cam_from_world
    return copy


@pytest.fixture
def workspace(tmp_path: Path, scene: Reconstruction) -> Path:
    """As a run leaves it, with the true scene as its result."""
    from PIL import Image

    photos, out = tmp_path / "photos", tmp_path / "out"
    rng = np.random.default_rng(0)
    for name in scene.image_names:
        path = photos / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 255, (40, 50), np.uint8)).save(path)
    write_model(out / "sparse" / "0", scene)
    stages = {"mapping": {"run": {"wall_s": 2.0, "cpu_s": 4.0, "peak_memory_mb": 200.0}}}
    manifest = {"format": FORMAT, "stages": stages, "source": str(photos), "options": {}}
    (out / "run.json").write_text(json.dumps(manifest))
    return out


@pytest.fixture
def ground_truth_file(tmp_path: Path, scene: Reconstruction) -> Path:
    rotation = rigid3.rotation_matrix(scene.cam_from_world)
    cameras = [
        {
            "file": f"images/{name}", "model": "pinhole", "K": scene.cameras[0].k_matrix.tolist(), "dist": None,
            "R_w2c": r.tolist(), "t_w2c": pose[4:].tolist(), "width": 50, "height": 40,
        }
        for name, pose, r in zip(scene.image_names, scene.cam_from_world, rotation, strict=True)
    ]  # fmt: skip
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"convention": "x_cam = R_w2c @ X_world + t_w2c", "cameras": cameras}))
    return path


Answer = Callable[..., SecondOpinion]


def opinion_on(model: Reconstruction | None, asked: list[dict[str, Any]]) -> Answer:
    """A stand-in for pycolmap that finds the given model and notes how it was asked."""

    def ask(root: Path, names: list[str], output: Path, options: Any, **more: Any) -> SecondOpinion:
        asked.append({"root": root, "names": names, "output": output, "options": options, **more})
        folder = None
        if model is not None:
            folder = output / "sparse" / "0"
            folder.parent.mkdir(parents=True, exist_ok=True)
            write_model(folder, model)
        phases = {"map": {"wall_s": 1.0, "cpu_s": 2.0}}
        registered = 0 if model is None else int(model.is_registered.sum())
        path = None if folder is None else str(folder)
        return SecondOpinion(len(names), registered, 0, 0, 1, 0.0, 0.0, path, phases, 10.0, 18.0, 100.0, "4.2", {})

    return ask


def test_the_same_model_in_another_world_agrees(
    workspace: Path, ground_truth_file: Path, scene: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    sim = similarity.from_parts(rigid3.exp_so3([0.3, -0.2, 1.0]), [5.0, 6, 7], 3.0)
    other = with_poses(scene, similarity.transform_poses(sim, scene.cam_from_world))
    other.point_xyz = similarity.apply(sim, scene.point_xyz)
    asked: list[dict[str, Any]] = []
    monkeypatch.setattr(pipeline, "ask_second_opinion", opinion_on(other, asked))
    result = pipeline.validate(workspace, ground_truth_file)
    assert asked[0]["names"] == scene.image_names
    assert asked[0]["root"] == workspace.parent / "photos"
    assert asked[0]["camera_groups"] is None
    assert result.agreement is not None
    assert result.agreement["num_common"] == NUM_IMAGES
    assert result.agreement["center_error_share"]["max"] < 1e-9
    assert result.agreement["rotation_error_deg"]["max"] < 1e-5
    assert result.pycolmap is not None
    for side in (result.ours, result.pycolmap):
        assert side["registered"] == side["images"] == NUM_IMAGES
        assert side["points"] == scene.summary()["num_points"]
        assert side["reprojection_error_px"] < 1e-9
        assert side["ground_truth"]["center_error"]["max"] < 1e-9
        assert side["ground_truth"]["auc"]["0.5"] == pytest.approx(1.0, abs=1e-4)
    check_schema("validate", plain(result))
    table = result.table()
    assert max(map(len, table.splitlines())) <= 100
    for words in ("registered images", "6 of 6", "2.0 s", "10.0 s   5.00 x less", "4.50 x less", "2.00 x more",
                  "worst 0.0000 deg", "AUC at 0.5 deg", "cameras.json"):  # fmt: skip
        assert words in table, words
    assert json.loads((workspace / "validation" / "report.json").read_text()) == plain(result)


def test_known_differences_come_out(
    workspace: Path, ground_truth_file: Path, scene: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    """pycolmap lost an image and turned another by one degree in place."""
    poses = scene.cam_from_world.copy()
    turned = rigid3.exp_so3([0, np.radians(1.0), 0]) @ rigid3.rotation_matrix(poses[2])
    poses[2] = rigid3.from_matrix(turned, -turned @ rigid3.center(poses[2]))
    poses[0] = np.nan
    other = with_poses(scene, poses)
    other.obs_is_inlier[other.tracks.obs_image_idx == 0] = False
    monkeypatch.setattr(pipeline, "ask_second_opinion", opinion_on(other, []))
    result = pipeline.validate(workspace, ground_truth_file)
    assert result.agreement is not None
    assert result.pycolmap is not None
    assert result.agreement["num_common"] == NUM_IMAGES - 1
    assert result.agreement["rotation_error_deg"]["max"] == pytest.approx(1.0, abs=1e-5)
    assert result.agreement["rotation_error_deg"]["median"] < 1e-5
    assert result.pycolmap["registered"] == NUM_IMAGES - 1
    # of 15 pairs 5 lost an image and 4 hold the turned one
    assert result.pycolmap["ground_truth"]["auc"]["0.5"] == pytest.approx(6 / 15, abs=1e-4)
    assert result.pycolmap["ground_truth"]["auc"]["5"] == pytest.approx((6 + 4 * 0.8) / 15, abs=1e-4)
    assert "5 of 6" in result.table()


def test_ground_truth_beyond_the_photographs_is_left_out(
    workspace: Path, ground_truth_file: Path, scene: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A trajectory of a thousand frames is no failure of the six that were given."""
    monkeypatch.setattr(pipeline, "ask_second_opinion", opinion_on(scene, []))
    document = json.loads(ground_truth_file.read_text())
    document["cameras"] += [document["cameras"][0] | {"file": f"images/stranger{k}.jpg"} for k in range(3)]
    del document["cameras"][1]
    ground_truth_file.write_text(json.dumps(document))
    result = pipeline.validate(workspace, ground_truth_file)
    assert result.ours["ground_truth"]["num_reference_images"] == NUM_IMAGES - 1
    assert result.ours["ground_truth"]["auc"]["5"] == pytest.approx(1.0, abs=1e-4)
    assert "3 entries of the ground truth have no photograph" in result.table()
    assert "1 photographs are not in the ground truth" in result.table()


def test_no_model_of_pycolmap_and_no_opinion_at_all(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "ask_second_opinion", opinion_on(None, []))
    nothing = pipeline.validate(workspace)
    assert nothing.pycolmap is not None
    assert nothing.pycolmap["registered"] == 0
    assert nothing.agreement is None
    assert "0 of 6" in nothing.table()

    def fail(*_: object, **__: object) -> SecondOpinion:
        raise SfmError("it fell over")

    monkeypatch.setattr(pipeline, "ask_second_opinion", fail)
    failed = pipeline.validate(workspace)
    assert failed.pycolmap is None
    assert "pycolmap failed" in failed.table()
    assert "it fell over" in failed.table()

    def stop(*_: object, **__: object) -> SecondOpinion:
        raise InterruptedRunError("stop")

    monkeypatch.setattr(pipeline, "ask_second_opinion", stop)
    with pytest.raises(InterruptedRunError):
        pipeline.validate(workspace)


def test_what_is_not_recorded_is_said(workspace: Path, scene: Reconstruction, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "ask_second_opinion", opinion_on(scene, []))
    manifest = json.loads((workspace / "run.json").read_text())
    (workspace / "run.json").write_text(json.dumps(manifest | {"stages": {}}))
    result = pipeline.validate(workspace)
    assert result.ours["wall_s"] is None
    assert result.table().count("not recorded") == 3
    assert "x less" not in result.table()


def test_what_the_user_said_of_the_cameras_is_passed_on(
    workspace: Path, scene: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[dict[str, Any]] = []
    monkeypatch.setattr(pipeline, "ask_second_opinion", opinion_on(scene, asked))
    manifest = json.loads((workspace / "run.json").read_text())
    manifest["options"] = {"images": {"camera_model": "PINHOLE", "focal_px": 45.0, "fix_intrinsics": True}}
    (workspace / "run.json").write_text(json.dumps(manifest))
    pipeline.validate(workspace)
    assert asked[0]["options"].camera_model == "PINHOLE"
    assert asked[0]["options"].fix_intrinsics
    groups = asked[0]["camera_groups"]
    assert sorted(name for group in groups for name in group.names) == sorted(scene.image_names)
    assert all(group.params == (45.0, 45.0, 25.0, 20.0) for group in groups)


def test_changed_photographs_are_noticed(
    workspace: Path, scene: Reconstruction, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "ask_second_opinion", opinion_on(scene, []))
    manifest = json.loads((workspace / "run.json").read_text())
    from sfmapp.images.folder import ImageOptions, load_images

    images = load_images(manifest["source"], ImageOptions(), Events())[0].images
    manifest["inputs"] = {image.name: image.digest + "+alpha" for image in images}
    (workspace / "run.json").write_text(json.dumps(manifest))
    assert "run it again" not in pipeline.validate(workspace).table()
    manifest["inputs"][images[2].name] = "0" * 32
    (workspace / "run.json").write_text(json.dumps(manifest))
    assert f"1 photographs are not what they were in our run, {images[2].name}" in pipeline.validate(workspace).table()


def test_refusals(workspace: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError):
        pipeline.validate(tmp_path / "nowhere")
    with pytest.raises(InputError):
        pipeline.validate(workspace, tmp_path / "no-ground_truth.json")
    for path in (workspace / "sparse" / "0").iterdir():
        path.unlink()
    with pytest.raises(NoReconstructionError):
        pipeline.validate(workspace)


def test_table_without_ground_truth_or_opinion_has_no_gaps(scene: Reconstruction) -> None:
    ours = Side(registered=3, images=3, points=5, track_length=None, reprojection_error_px=None,
                wall_s=1.0, cpu_s=None, peak_memory_mb=10.0)  # fmt: skip
    empty = Validation(ours, None, None, None, [])
    assert "None" not in empty.table()
    theirs = PycolmapSide(**{**ours, "wall_s": 0.5}, phases={}, version="4.2", options={})
    nothing = evaluate_poses([], [], scene.image_names, scene.cam_from_world)
    tilted = replace(empty, pycolmap=theirs, agreement=nothing.summary())
    assert "too few to align" in tilted.table()
    assert "2.00 x more" in tilted.table()
