"""Dense runs in a workspace: from a model to patches and a mesh, resumed, and a reason where there are none."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dense_models import DEPTH, PINHOLE, row_of_poses, texture, write_wall
from schemas import check_schema
from sfmapp.camera.camera import Camera, CameraModel
from sfmapp.dense.files import read_patches
from sfmapp.dense.options import DenseOptions
from sfmapp.errors import InputError, InterruptedRunError, NoReconstructionError, UsageError
from sfmapp.events import Event, Events
from sfmapp.formats.colmap import read_model, write_model
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.pipelines.dense.densify import dense
from sfmapp.pipelines.dense.mesh import mesh_cloud, mesh_workspace
from sfmapp.surface.options import SurfaceOptions
from sfmapp.workspace.options import Options

BARREL = Camera(CameraModel.OPENCV, 200, 140, np.array([165.0, 164.0, 98.4, 72.3, -0.18, 0.03, 1e-3, -1e-3]))
PIXEL = DEPTH / PINHOLE.focal
FAST = Options(dense=DenseOptions(cell_px=2), threads=1)


def report_of(output: Path) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((output / "report.json").read_text())
    check_schema("reconstruct" if "models" in report else "dense", report)
    return report


@pytest.fixture(scope="module")
def wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model, and what was made of it in ``out``."""
    folder = tmp_path_factory.mktemp("wall")
    write_wall(folder, camera=BARREL, text=True)
    dense(folder / "sparse" / "0", folder / "out", FAST, images=folder / "images", maps=True, record=False)
    return folder


def copy_of(wall: Path, tmp_path: Path) -> Path:
    shutil.copytree(wall, tmp_path / "wall")
    return tmp_path / "wall"


def test_a_text_model_with_distortion_comes_out_where_the_wall_is(wall: Path) -> None:
    patches, names = read_patches(wall / "out" / "dense" / "patches.npz")
    assert names == tuple(f"view_{m}.png" for m in range(5))
    off = np.abs(patches.xyz[:, 2] - DEPTH) / PIXEL
    assert np.median(off) < 0.3
    assert np.quantile(off, 0.95) < 1.0
    # a patch for each cell of most of the wall that three views show
    assert len(patches) > 0.7 * 200 * 140 / 4
    assert np.degrees(np.arccos(np.clip(-patches.normal[:, 2], -1, 1))).mean() < 15.0
    # how far off they are along the ray is what they say, within a factor
    assert 0.2 < np.median(off * PIXEL / patches.sigma) < 3.0
    cloud = read_ply_geometry(wall / "out" / "dense" / "fused.ply")
    np.testing.assert_array_equal(cloud.xyz[:, 2], patches.xyz[:, 2])
    # colours are those of the wall
    wall_image = texture()
    place = np.rint(patches.xyz[:, :2] * 100 + 800 - 0.5).astype(int)
    wanted = wall_image[place[:, 1], place[:, 0]].astype(int)
    assert np.median(np.abs(patches.rgb.astype(int) - wanted)) < 12


def test_maps_are_depths_of_the_wall(wall: Path) -> None:
    folder = wall / "out" / "dense" / "maps"
    depth = np.load(folder / "view_2.png.depth.npy", allow_pickle=False)
    normal = np.load(folder / "view_2.png.normal.npy", allow_pickle=False)
    # the camera in the middle looks straight at the wall
    assert depth.dtype == np.float32
    assert np.isfinite(depth).mean() > 0.6
    assert np.nanquantile(np.abs(depth - DEPTH), 0.95) < 1.5 * PIXEL
    assert normal.shape == (*depth.shape, 3)
    assert np.median(normal[np.isfinite(depth)][:, 2]) < -0.95
    for kind in ("depth", "normal"):
        assert cv2.imread(str(folder / f"view_0.png.{kind}.png")).shape[:2] == depth.shape
    views = json.loads((folder / "views.json").read_text())
    assert [view["name"] for view in views] == [f"view_{m}.png" for m in range(5)]
    assert (views[2]["height"], views[2]["width"]) == depth.shape


def test_the_report_tells_what_was_done(wall: Path) -> None:
    report = report_of(wall / "out")
    section = report["stages"]["dense"]
    patches, _ = read_patches(wall / "out" / "dense" / "patches.npz")
    assert report["outcome"]["exit_code"] == 0
    assert section["num_patches"] == len(patches)
    assert section["views"]["num_views"] == 5
    assert section["views"]["views"][0]["neighbors"]
    assert section["funnel"][-1]["count"] == len(patches)
    assert section["shares"]["covered"] > 0.5
    assert report["dense"]["num_patches"] == len(patches)
    assert report["usage"]["dense"]["cpu_s"] > 0
    assert "view_2.png" in (wall / "out" / "report.html").read_text()
    manifest = json.loads((wall / "out" / "run.json").read_text())
    assert manifest["command"] == "dense"
    assert manifest["stages"]["dense"]["is_done"]
    assert manifest["options"]["dense"]["cell_px"] == 2


def test_the_same_again_does_nothing(wall: Path, tmp_path: Path) -> None:
    copy = copy_of(wall, tmp_path)
    out = copy / "out"
    before = (out / "dense" / "patches.npz").stat().st_mtime_ns
    again = dense(copy / "sparse" / "0", out, FAST, images=copy / "images", record=False)
    assert again.report["run"]["is_up_to_date"]
    assert (out / "dense" / "patches.npz").stat().st_mtime_ns == before
    # neither threads nor memory are a reason to begin anew, another photograph is
    other = replace(FAST, threads=2, dense=replace(FAST.dense, max_memory_mb=8000))
    assert dense(out, options=other, record=False).report["run"]["is_up_to_date"]
    image = cv2.imread(str(copy / "images" / "view_4.png"))
    cv2.imwrite(str(copy / "images" / "view_4.png"), np.maximum(image, 2))
    changed = dense(copy / "sparse" / "0", out, FAST, images=copy / "images", record=False)
    assert not changed.report["run"]["is_up_to_date"]
    assert not (out / "dense" / "maps").exists()
    wiped = out / "dense" / "fused.ply"
    wiped.unlink()
    dense(copy / "sparse" / "0", out, FAST, images=copy / "images", record=False)
    assert wiped.is_file()


def test_an_interrupted_run_is_resumed_cluster_by_cluster(wall: Path, tmp_path: Path) -> None:
    options = replace(FAST, dense=DenseOptions(cell_px=2, max_neighbors=2, max_memory_mb=500))
    source, images, out = wall / "sparse" / "0", wall / "images", tmp_path / "out"
    from sfmapp.dense import clusters

    expected = clusters.BASE_MB
    try:
        clusters.BASE_MB = 498.8  # so that two or three of these small views fit
        whole = dense(source, tmp_path / "whole", options, images=images, record=False)
        assert len(whole.report["clusters"]) >= 2
        events = Events()
        seen = [0]

        def stop_at_second(event: Event) -> None:
            if event.kind == "finished" and event.stage == "dense":
                seen[0] += 1
            if seen[0] == 1 and event.kind == "started" and event.stage == "dense":
                events.cancel()

        events.subscribe(stop_at_second)
        with pytest.raises(InterruptedRunError):
            dense(source, out, options, images=images, record=False, events=events)
        assert (out / "dense" / "clusters" / "0.npz").is_file()
        resumed = dense(source, out, options, images=images, record=False)
        assert resumed.report["clusters"][0]["is_resumed"]
        assert not resumed.report["clusters"][-1]["is_resumed"]
        assert not (out / "dense" / "clusters").exists()
        np.testing.assert_array_equal(resumed.patches.xyz, whole.patches.xyz)
        assert resumed.report["funnel"] == whole.report["funnel"]
    finally:
        clusters.BASE_MB = expected


def test_a_region_holds_all_patches(wall: Path, tmp_path: Path) -> None:
    region = (-0.4, -0.3, 3.0, 0.5, 0.4, 5.0)
    options = replace(FAST, dense=DenseOptions(cell_px=2, region=region))
    found = dense(wall / "sparse" / "0", tmp_path / "out", options, images=wall / "images", record=False).patches
    assert len(found) > 100
    assert (found.xyz >= region[:3]).all()
    assert (found.xyz <= region[3:]).all()
    assert np.ptp(found.xyz[:, 0]) > 0.8


# ---------------------------------------------------------------------------------------------------------------- mesh


def test_a_mesh_lies_on_the_wall(wall: Path, tmp_path: Path) -> None:
    out = copy_of(wall, tmp_path) / "out"
    result = mesh_workspace(out, FAST, record=False)
    assert result.mesh is not None
    assert np.quantile(np.abs(result.mesh.xyz[:, 2] - DEPTH), 0.9) < 1.5 * PIXEL
    assert (out / "mesh" / "mesh.ply").is_file()
    assert (out / "mesh" / "mesh.glb").read_bytes()[:4] == b"glTF"
    report = report_of(out)
    assert report["stages"]["mesh"]["num_faces"] == len(result.mesh.faces)
    assert report["dense"]["mesh"]["num_faces"] == len(result.mesh.faces)
    again = mesh_workspace(out, FAST, record=False)
    assert again.report["run"]["is_up_to_date"]
    # patches that have changed make a new one
    dense(out, options=replace(FAST, dense=DenseOptions(cell_px=3)), record=False)
    assert mesh_workspace(out, FAST, record=False).mesh is not None


def test_patches_of_an_earlier_model_make_no_mesh(wall: Path, tmp_path: Path) -> None:
    folder = copy_of(wall, tmp_path)
    model, keypoints = read_model(folder / "sparse" / "0")
    dense(folder / "sparse" / "0", folder / "out2", FAST, images=folder / "images", record=False)
    moved = model.copy()
    moved.cam_from_world[:, 4:] += 0.1
    shutil.rmtree(folder / "sparse" / "0")
    write_model(folder / "sparse" / "0", moved, keypoints)
    with pytest.raises(InputError, match="of an earlier one"):
        mesh_workspace(folder / "out2", FAST, record=False)
    dense(folder / "out2", options=FAST, record=False)
    assert mesh_workspace(folder / "out2", FAST, record=False).mesh is not None


def test_a_mesh_of_a_cloud(wall: Path, tmp_path: Path) -> None:
    result = mesh_cloud(wall / "out" / "dense" / "fused.ply", tmp_path / "surface", FAST)
    assert result.mesh is not None
    assert np.quantile(np.abs(result.mesh.xyz[:, 2] - DEPTH), 0.9) < 1.5 * PIXEL
    assert (tmp_path / "surface" / "mesh" / "mesh.ply").is_file()
    with pytest.raises(UsageError, match="texture"):
        mesh_cloud(
            wall / "out" / "dense" / "fused.ply", tmp_path / "t", replace(FAST, surface=SurfaceOptions(texture=True))
        )


def test_a_mesh_needs_patches_or_normals(tmp_path: Path) -> None:
    from sfmapp.formats.ply import write_ply

    write_ply(tmp_path / "bare.ply", np.zeros((4, 3)), np.zeros((4, 3), np.uint8))
    with pytest.raises(InputError, match="normals"):
        mesh_cloud(tmp_path / "bare.ply", tmp_path / "out")
    with pytest.raises(InputError, match="not a workspace"):
        mesh_workspace(tmp_path)


def ball(count: int = 3000) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    normal = np.random.default_rng(0).normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    return normal * 2.0, normal


def write_ball(path: Path, xyz: NDArray[np.float64], normal: NDArray[np.float64]) -> Path:
    names = ("x", "y", "z", "normal_x", "normal_y", "normal_z")
    head = f"ply\nformat binary_big_endian 1.0\nelement vertex {len(xyz)}\n"
    head += "".join(f"property double {name}\n" for name in names) + "end_header\n"
    path.write_bytes(head.encode() + np.concatenate([xyz, normal], 1).astype(">f8").tobytes())
    return path


def test_a_mesh_of_a_foreign_cloud_without_colours_and_with_gaps(tmp_path: Path) -> None:
    xyz, normal = ball()
    xyz[::100, 1], normal[1::100], normal[2::100, 0] = np.nan, 0.0, np.inf
    said: list[Event] = []
    path = write_ball(tmp_path / "ball.ply", xyz, normal * 7)
    mesh = mesh_cloud(path, tmp_path / "out", FAST, events=Events(said.append)).mesh
    assert mesh is not None
    np.testing.assert_allclose(np.linalg.norm(mesh.xyz, axis=1), 2.0, atol=0.05)
    assert (mesh.rgb == mesh.rgb[0, 0]).all()
    assert 100 < mesh.rgb[0, 0] < 255
    warned = [event.message for event in said if event.kind == "warned"]
    assert [("30 of 3000" in message, "60 of 3000" in message) for message in warned] == [(True, False), (False, True)]
    assert any("no colours" in event.message for event in said if event.kind == "decided")


def test_clouds_that_cannot_become_a_mesh_say_why(tmp_path: Path) -> None:
    xyz, normal = ball(100)
    for bad, words in ((xyz, normal * 0), (xyz * np.nan, normal), (xyz[:0], normal[:0])):
        with pytest.raises(InputError, match="places and normals, found none among") as caught:
            mesh_cloud(write_ball(tmp_path / "a.ply", bad, words), tmp_path / "out", FAST)
        assert "a.ply" in str(caught.value)
        assert "normals" in str(caught.value.advice)


def test_a_cloud_that_single_precision_has_spoilt_is_told(tmp_path: Path) -> None:
    said: list[Event] = []
    xyz, normal = ball()
    far = xyz + np.array([500_000.0, 5_800_000.0, 100.0])
    for places in (far, far.astype(np.float32).astype(np.float64)):
        mesh_cloud(write_ball(tmp_path / "a.ply", places, normal), tmp_path / "out", FAST, events=Events(said.append))
    warned = [event.message for event in said if event.kind == "warned"]
    assert len(warned) == 1
    assert "0.5 apart in single precision" in warned[0]


# ----------------------------------------------------------------------------------------------------------- bad input


def assert_failed(output: Path, code: int, words: str) -> None:
    report = report_of(output)
    assert report["outcome"]["exit_code"] == code
    assert words in report["outcome"]["message"]
    assert report["outcome"]["advice"]
    assert (output / "report.html").is_file()


@pytest.mark.parametrize(("order", "num_points"), [((3, 0, 4, 2, 1), 120), ((2, 4, 0, 1, 3), 0)])
def test_poses_that_contradict_the_images(tmp_path: Path, order: tuple[int, ...], num_points: int) -> None:
    model = write_wall(tmp_path, 5, num_points=num_points)
    write_model(tmp_path / "wrong", replace(model, cam_from_world=row_of_poses(5)[list(order)]))
    with pytest.raises(NoReconstructionError, match="poses contradict") as caught:
        dense(tmp_path / "wrong", tmp_path / "out", FAST, images=tmp_path / "images", record=False)
    assert "photographs belong together" in str(caught.value.advice)
    assert_failed(tmp_path / "out", 4, "contradict")
    # what there is is kept
    assert (tmp_path / "out" / "dense" / "fused.ply").is_file()
    with pytest.raises(NoReconstructionError, match="as before"):
        dense(tmp_path / "out", options=FAST, record=False)


def test_no_texture(tmp_path: Path) -> None:
    write_wall(tmp_path, 4, wall=np.full((1600, 1600, 3), 140, np.uint8))
    with pytest.raises(NoReconstructionError, match="no texture"):
        dense(tmp_path / "sparse" / "0", tmp_path / "out", FAST, images=tmp_path / "images", record=False)
    assert_failed(tmp_path / "out", 4, "no texture")


def test_one_photograph_many_times(tmp_path: Path) -> None:
    model = write_wall(tmp_path, 4)
    first = (tmp_path / "images" / "view_0.png").read_bytes()
    for name in model.image_names:
        (tmp_path / "images" / name).write_bytes(first)
    write_model(tmp_path / "model", replace(model, cam_from_world=np.tile(row_of_poses(4)[:1], (4, 1))))
    with pytest.raises(NoReconstructionError, match="copies"):
        dense(tmp_path / "model", tmp_path / "out", FAST, images=tmp_path / "images", record=False)
    assert_failed(tmp_path / "out", 4, "copies")


def test_two_views_have_to_agree_where_there_are_no_more(tmp_path: Path) -> None:
    write_wall(tmp_path, 2)
    told: list[Event] = []
    model, images = tmp_path / "sparse" / "0", tmp_path / "images"
    result = dense(model, tmp_path / "out", FAST, images=images, record=False, events=Events(told.append))
    assert any("no third can contradict" in (event.message or "") for event in told)
    assert (result.patches.num_views == 2).all()
    off = np.abs(result.patches.xyz[:, 2] - DEPTH) / PIXEL
    assert np.median(off) < 1.0
    assert np.quantile(off, 0.95) < 3.0
    assert len(result.patches) > 0.5 * 200 * 140 / 4
    three = replace(FAST, dense=replace(FAST.dense, min_views=3))
    with pytest.raises(InputError, match="2 usable images") as caught:
        dense(model, tmp_path / "strict", three, images=images, record=False)
    assert "min_views=3" in str(caught.value.advice)


def test_one_view_has_no_depth(tmp_path: Path) -> None:
    write_wall(tmp_path, 2)
    (tmp_path / "images" / "view_1.png").unlink()
    with pytest.raises(InputError, match="1 usable images"):
        dense(tmp_path / "sparse" / "0", tmp_path / "out", FAST, images=tmp_path / "images", record=False)


def test_a_photograph_and_its_copies_are_warned_of(tmp_path: Path) -> None:
    write_wall(tmp_path, 4)
    shutil.copy(tmp_path / "images" / "view_1.png", tmp_path / "images" / "view_9.png")
    model, _ = read_model(tmp_path / "sparse" / "0")
    model.image_names.append("view_9.png")
    model.image_camera_idx = np.append(model.image_camera_idx, model.image_camera_idx[1])
    model.cam_from_world = np.concatenate([model.cam_from_world, model.cam_from_world[1:2]])
    model.tracks = replace(model.tracks, image_ptr=np.append(model.tracks.image_ptr, model.tracks.image_ptr[-1]))
    write_model(tmp_path / "model", model)
    result = dense(tmp_path / "model", tmp_path / "out", FAST, images=tmp_path / "images", record=False)
    assert result.report["views"]["copies"] == ["view_9.png"]
    assert result.image_names == tuple(f"view_{m}.png" for m in range(4))
    assert any("view_9.png" in row["message"] for row in report_of(tmp_path / "out")["warnings"])


def test_what_is_no_source(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="expected a workspace of sfmapp or a COLMAP model"):
        dense(tmp_path / "empty")
    with pytest.raises(InputError, match="no such folder"):
        dense(tmp_path / "none")
    write_wall(tmp_path / "wall", 3)
    model = tmp_path / "wall" / "sparse" / "0"
    with pytest.raises(InputError, match="found no folder"):
        dense(model, tmp_path / "out", images=tmp_path / "gone")
    (tmp_path / "wall" / "images").rename(tmp_path / "wall" / "elsewhere")
    with pytest.raises(UsageError, match="expected its photographs in"):
        dense(model, tmp_path / "out")
