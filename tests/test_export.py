"""Export: every format is read back and re-projected."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import sfmapp
from schemas import check_schema
from sfmapp.camera.camera import CameraModel
from sfmapp.camera.lens import BROWN, EQUIRECTANGULAR, RADIAL_FISHEYE
from sfmapp.errors import InputError, NoReconstructionError, UsageError
from sfmapp.formats import ply
from sfmapp.formats.colmap import read_model, write_model
from sfmapp.formats.nerfstudio import read_nerfstudio
from sfmapp.pipelines import export_world
from sfmapp.pipelines.dense.source import find_source
from sfmapp.pipelines.export import EXPORTS, export_model
from sfmapp.reporting import plain
from sfmapp.scene.synthetic import synthetic_camera
from test_formats_exchange import centered_camera, scene


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    """A workspace as far as export knows one: the photographs, a manifest and a model."""
    (tmp_path / "photos").mkdir()
    folder = tmp_path / "out"
    write_model(folder / "sparse" / "0", scene([centered_camera(), centered_camera(700.0)]))
    manifest = {"format": "sfmapp workspace 1", "source": str(tmp_path / "photos"), "stages": {}, "inputs": {}}
    (folder / "run.json").write_text(json.dumps(manifest))
    return folder


@pytest.mark.parametrize("target", [name for name in EXPORTS if name not in ("geojson", "kml")])
def test_every_format_is_read_back(workspace: Path, tmp_path: Path, target: str) -> None:
    report = export_model(workspace, target, tmp_path / "copy")
    model = read_model(workspace / "sparse" / "0")[0]
    assert report["format"] == target
    assert report["num_images"] == 4
    assert report["num_points"] == model.tracks.num_tracks
    assert report["num_observations"] == model.tracks.num_observations
    # numbers are written in full but for the points of ply, which are float32, and of las, which are whole numbers
    assert report["max_px"] < (1e-3 if target in ("ply", "las", "laz", "nerfstudio") else 1e-7)
    assert report["max_coordinate"] < 1e-6 * np.ptp(model.point_xyz, axis=0).max()
    assert all(Path(file).is_file() for file in report["files"])
    check_schema("export", plain(report))


def test_images_are_found_from_transforms_json(workspace: Path, tmp_path: Path) -> None:
    for path in (tmp_path / "nerf", tmp_path / "nerf" / "deep" / "mine.json"):
        (file, _) = export_model(workspace, "nerfstudio", path)["files"]
        for name in read_nerfstudio(file).image_names:
            assert (Path(file).parent / name).resolve().parent == (tmp_path / "photos").resolve()


@pytest.mark.parametrize("kind", ["folder", "pattern", "nested pattern", "list"])
def test_images_of_any_source_are_found(photos: Path, tmp_path: Path, kind: str) -> None:
    """Whatever the run was told, every command that follows finds the photographs, wherever it is called from."""
    folder = tmp_path / "photos"
    shutil.copytree(photos, folder / "deep")
    (tmp_path / "list.txt").write_text("".join(f"{path}\n" for path in sorted(folder.rglob("*.*"))))
    source, root = {
        "folder": (folder, folder), "pattern": (f"{folder}/deep/*.*", folder / "deep"),
        "nested pattern": (f"{folder}/**/*.png", folder), "list": (tmp_path / "list.txt", folder / "deep"),
    }[kind]  # fmt: skip
    options = sfmapp.load_options(settings=["features.max_num_features=600"])
    model, _ = sfmapp.reconstruct(source, tmp_path / "out", options, record=False)
    report = sfmapp.export(tmp_path / "out", "nerfstudio", tmp_path / "far" / "nerf")
    assert report["notes"] == []
    for name in read_nerfstudio(report["files"][0]).image_names:
        assert (tmp_path / "far" / "nerf" / name).is_file()
    where = find_source(tmp_path / "out", None, None, sfmapp.Options())
    assert where.images == root
    assert all((where.images / name).is_file() for name in model.image_names)
    shutil.rmtree(folder)
    (note,) = sfmapp.export(tmp_path / "out", "nerfstudio", tmp_path / "far" / "nerf")["notes"]
    assert "photographs are not in" in note
    with pytest.raises(sfmapp.InputError, match="expected its photographs in"):
        find_source(tmp_path / "out", None, None, sfmapp.Options())


def test_a_reconstruction_in_memory_is_exported_as_it_is(workspace: Path, tmp_path: Path) -> None:
    model = sfmapp.load(workspace)
    (tmp_path / "elsewhere").mkdir()
    for target in ("colmap-text", "nerfstudio"):
        in_memory = sfmapp.export(model, target, tmp_path / "a" / target, images=tmp_path / "elsewhere")
        from_files = sfmapp.export(workspace, target, tmp_path / "b" / target, images=tmp_path / "elsewhere")
        assert in_memory["num_observations"] == from_files["num_observations"]
        for ours, theirs in zip(in_memory["files"], from_files["files"], strict=True):
            assert Path(ours).read_bytes() == Path(theirs).read_bytes()
    text = (tmp_path / "a" / "nerfstudio" / "transforms.json").read_text()
    assert "elsewhere" in text


def test_images_beside_a_colmap_model_are_found_from_transforms_json(workspace: Path, tmp_path: Path) -> None:
    project = tmp_path / "project"
    shutil.copytree(workspace / "sparse", project / "sparse")
    for name in read_model(project / "sparse" / "0")[0].image_names:
        (project / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (project / "images" / name).write_bytes(b"a photograph")
    report = export_model(project, "nerfstudio", tmp_path / "nerf")
    assert report["notes"] == []
    for name in read_nerfstudio(report["files"][0]).image_names:
        assert (tmp_path / "nerf" / name).is_file()


def test_a_model_folder_will_do(workspace: Path, tmp_path: Path) -> None:
    report = export_model(workspace / "sparse" / "0", "ply", tmp_path / "cloud.ply")
    assert report["files"] == [str(tmp_path / "cloud.ply")]
    (workspace / "run.json").unlink()
    assert export_model(workspace, "colmap-text", tmp_path / "text")["reader"] == "pycolmap"
    assert export_model(tmp_path / "text", "colmap-bin", tmp_path / "bin")["max_px"] < 1e-9


def test_bundler_says_where_its_pixels_begin(workspace: Path, tmp_path: Path) -> None:
    assert export_model(workspace, "bundler", tmp_path / "a")["notes"] == []
    write_model(tmp_path / "m", scene([synthetic_camera(CameraModel.SIMPLE_RADIAL)]))
    report = export_model(tmp_path / "m", "bundler", tmp_path / "b")
    assert report["max_px"] < 1e-7
    assert "up to 5.00 px off the centre" in report["notes"][0]


@pytest.mark.parametrize("model", list(CameraModel))
def test_every_camera_model_goes_to_nerfstudio_and_colmap(tmp_path: Path, model: CameraModel) -> None:
    camera = synthetic_camera(model)
    write_model(tmp_path / "m", scene([camera]))
    of_four = (BROWN, RADIAL_FISHEYE, EQUIRECTANGULAR)
    for target, holds in (("nerfstudio", camera.family in of_four), ("colmap-text", model.is_colmaps)):
        if not holds:
            with pytest.raises(UsageError, match=model.name):
                export_model(tmp_path / "m", target, tmp_path / target)
            continue
        assert export_model(tmp_path / "m", target, tmp_path / target)["max_px"] < 1e-3


def test_a_wrong_copy_is_noticed(workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    right = ply.write_ply

    def shifted(path: Path, xyz: np.ndarray, rgb: np.ndarray) -> None:
        right(path, xyz + np.array([0.01, 0, 0]), rgb)

    monkeypatch.setattr(export_world, "write_ply", shifted)
    report = export_model(workspace, "ply", tmp_path / "p.ply")
    assert report["max_coordinate"] == pytest.approx(0.01, rel=1e-3)
    assert report["max_px"] > 0.5
    monkeypatch.setattr(export_world, "write_ply", lambda path, xyz, rgb: right(path, xyz[1:], rgb[1:]))
    with pytest.raises((InputError, ValueError)):
        export_model(workspace, "ply", tmp_path / "p.ply")


def test_refusals(workspace: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="unknown export format 'obj'"):
        export_model(workspace, "obj", tmp_path / "x")
    with pytest.raises(UsageError, match="the model itself"):
        export_model(workspace, "colmap-bin", workspace / "sparse" / "0")
    write_model(tmp_path / "m", scene([synthetic_camera(CameraModel.OPENCV)]))
    with pytest.raises(UsageError, match="tangential"):
        export_model(tmp_path / "m", "bundler", tmp_path / "b")
    with pytest.raises(InputError, match="COLMAP model"):
        export_model(tmp_path / "absent", "ply", tmp_path / "x.ply")
    shutil.rmtree(workspace / "sparse")
    with pytest.raises(NoReconstructionError, match="holds no model"):
        export_model(workspace, "ply", tmp_path / "x.ply")
