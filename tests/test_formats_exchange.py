"""PLY, Bundler, nerfstudio, TUM trajectories, ground truth: conventions against other readers and plain arithmetic."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sfmapp.camera.camera import Camera, CameraModel, project
from sfmapp.errors import InputError, UsageError
from sfmapp.formats.bundler import read_bundler, write_bundler
from sfmapp.formats.colmap import read_model, write_model, write_model_text
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.formats.nerfstudio import POINTS_NAME, read_nerfstudio, write_nerfstudio
from sfmapp.formats.ply import write_ply
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.formats.trajectory import read_tum, write_tum
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_scene, synthetic_camera

FUZZ = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def centered_camera(focal: float = 900.0, width: int = 1001) -> Camera:
    """The most that Bundler can hold: odd width, so that the centre falls into a pixel."""
    return Camera(CameraModel.RADIAL, width, 750, np.array([focal, width / 2, 375, -0.08, 0.02]))


def scene(cameras: list[Camera], num_images: int = 5) -> Reconstruction:
    """Noisy, coloured, with an unregistered image, missing points and outliers."""
    rng = np.random.default_rng(5)
    rec = make_scene(5, num_images, 80, cameras).observed.copy()
    rec.point_rgb = rng.integers(0, 256, rec.point_rgb.shape, np.uint8)
    rec.cam_from_world[1] = np.nan
    rec.point_xyz[::7] = np.nan
    rec.obs_is_inlier &= rng.random(len(rec.obs_is_inlier)) < 0.9
    rec.obs_is_inlier &= rec.is_registered[rec.tracks.obs_image_idx] & rec.is_triangulated[rec.tracks.obs_track_idx]
    return rec


def damaged(data: st.DataObject, good: bytes) -> bytes:
    bad = bytearray(good)
    for at in data.draw(st.lists(st.integers(0, len(bad) - 1), min_size=1, max_size=4)):
        bad[at] ^= 1 << data.draw(st.integers(0, 7))
    return bytes(bad[: data.draw(st.sampled_from([len(bad), data.draw(st.integers(0, len(bad)))]))])


# PLY -----------------------------------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    xyz=hnp.arrays(np.float64, st.tuples(st.integers(0, 20), st.just(3)), elements=st.floats(-1e12, 1e12)),
    seed=st.integers(0, 9),
)
def test_ply_round_trip(tmp_path: Path, xyz: np.ndarray, seed: int) -> None:
    rgb = np.random.default_rng(seed).integers(0, 256, (len(xyz), 3), np.uint8)
    write_ply(tmp_path / "p.ply", xyz, rgb)
    back = read_ply_geometry(tmp_path / "p.ply")
    np.testing.assert_array_equal(back.rgb, rgb)
    extent = np.ptp(xyz, axis=0).max() if len(xyz) else 0.0
    np.testing.assert_allclose(back.xyz, xyz, rtol=0, atol=1e-6 * extent)


def test_ply_keeps_georeferenced_points(tmp_path: Path) -> None:
    near = np.random.default_rng(0).normal(size=(50, 3))
    far = near + np.array([4_500_000.0, 700_000.0, 300.0])
    for xyz, kind in ((near, b"float x"), (far, b"double x")):
        write_ply(tmp_path / "p.ply", xyz, np.zeros((50, 3), np.uint8))
        assert kind in (tmp_path / "p.ply").read_bytes()
        np.testing.assert_allclose(read_ply_geometry(tmp_path / "p.ply").xyz, xyz, rtol=0, atol=1e-5)


def test_ply_of_colmap(tmp_path: Path) -> None:
    rec = scene([centered_camera()])
    write_model(tmp_path / "m", rec)
    pycolmap.Reconstruction(str(tmp_path / "m")).export_PLY(str(tmp_path / "theirs.ply"))
    back = read_ply_geometry(tmp_path / "theirs.ply")
    assert back.rgb is not None
    expected = np.concatenate([rec.point_xyz, rec.point_rgb], 1)[rec.is_triangulated]
    found = np.concatenate([back.xyz, back.rgb], 1)
    np.testing.assert_allclose(found[np.lexsort(found.T)], expected[np.lexsort(expected.T)], rtol=1e-6, atol=1e-6)


def test_ply_reader_passes_over_what_it_does_not_need(tmp_path: Path) -> None:
    head = (
        b"ply\nformat binary_little_endian 1.0\ncomment x\nelement vertex 2\nproperty short q\nproperty double x\n"
        b"property float y\nproperty int z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.array([(7, 1.5, 2.5, 3), (8, 4.5, 5.5, 6)], [("q", "<i2"), ("x", "<f8"), ("y", "<f4"), ("z", "<i4")])
    (tmp_path / "p.ply").write_bytes(head + rows.tobytes() + b"\x03" + bytes(12))
    back = read_ply_geometry(tmp_path / "p.ply")
    assert back.xyz.tolist() == [[1.5, 2.5, 3], [4.5, 5.5, 6]]
    assert back.rgb is back.normal is None


@FUZZ
@given(data=st.data())
def test_damaged_ply(tmp_path: Path, data: st.DataObject) -> None:
    write_ply(tmp_path / "p.ply", np.eye(3), np.eye(3).astype(np.uint8))
    (tmp_path / "p.ply").write_bytes(damaged(data, (tmp_path / "p.ply").read_bytes()))
    try:
        back = read_ply_geometry(tmp_path / "p.ply")
    except InputError:
        return
    assert len(back.xyz) <= 3
    assert back.rgb is None or len(back.rgb) == len(back.xyz)


# Bundler -------------------------------------------------------------------------------------------------------------


def assert_same_model(rec: Reconstruction, back: Reconstruction, atol_px: float = 1e-7) -> None:
    """The registered part, observations included, sees the same pixels."""
    registered, points = rec.registered_idx, np.flatnonzero(rec.is_triangulated)
    assert back.image_names == [rec.image_names[i] for i in registered]
    np.testing.assert_allclose(back.centers, rec.centers[registered], atol=1e-9)
    np.testing.assert_allclose(back.point_xyz, rec.point_xyz[points], atol=1e-12)
    np.testing.assert_array_equal(back.point_rgb, rec.point_rgb[points])
    for position, image in enumerate(registered):
        theirs = back.cameras[back.image_camera_idx[position]]
        ours = rec.cameras[rec.image_camera_idx[image]]
        assert (theirs.width, theirs.height) == (ours.width, ours.height)
        np.testing.assert_allclose(
            project(theirs, rigid3.apply(back.cam_from_world[position], back.point_xyz)),
            project(ours, rigid3.apply(rec.cam_from_world[image], rec.point_xyz[points])),
            atol=atol_px,
        )


def test_bundler_round_trip(tmp_path: Path) -> None:
    rec = scene([centered_camera(), centered_camera(700.0, 1000)])
    write_bundler(tmp_path / "b.out", rec)
    sizes = [(rec.cameras[i].width, 750) for i in rec.image_camera_idx[rec.registered_idx]]
    back = read_bundler(tmp_path / "b.out", np.array(sizes))
    assert len(back.cameras) == 2
    assert_same_model(rec, back)
    used = rec.obs_is_inlier
    np.testing.assert_allclose(back.tracks.obs_xy, rec.tracks.obs_xy[used], atol=1e-9)
    np.testing.assert_array_equal(back.tracks.obs_feature_idx, rec.tracks.obs_feature_idx[used])
    np.testing.assert_allclose(back.residuals_px(), rec.residuals_px()[used], atol=1e-7)
    # without the sizes everything is right up to a shift of the pixels
    np.testing.assert_allclose(read_bundler(tmp_path / "b.out").residuals_px(), back.residuals_px(), atol=1e-7)


def test_bundler_convention_by_hand(tmp_path: Path) -> None:
    """A point up and to the right, in front of a camera that looks down -z, has positive pixels."""
    (tmp_path / "b.out").write_text(
        "# Bundle file v0.3\n1 1\n100 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n1 2 -10\n9 8 7\n1 0 0 10 20\n"
    )
    rec = read_bundler(tmp_path / "b.out", np.array([[80, 60]]))
    np.testing.assert_allclose(rec.residuals_px(), 0, atol=1e-12)
    np.testing.assert_allclose(rec.tracks.obs_xy, [[50, 10]])  # right of the centre and above it
    assert rec.point_rgb.tolist() == [[9, 8, 7]]


def test_bundler_counts_pixels_from_the_principal_point(tmp_path: Path) -> None:
    camera = centered_camera()
    camera = camera.with_params(camera.params + np.array([0, 7, -4, 0, 0]))
    rec = scene([camera])
    write_bundler(tmp_path / "b.out", rec)
    sizes, residuals = np.array([(1001, 750)] * 4), rec.residuals_px()[rec.obs_is_inlier]
    # taking the centre instead shifts pixels and projections alike
    shifted = read_bundler(tmp_path / "b.out", sizes)
    np.testing.assert_allclose(shifted.residuals_px(), residuals, atol=1e-7)
    np.testing.assert_allclose(
        shifted.tracks.obs_xy + np.array([7, -4]), rec.tracks.obs_xy[rec.obs_is_inlier], atol=1e-9
    )
    assert_same_model(rec, read_bundler(tmp_path / "b.out", sizes, np.tile(camera.params[1:3], (4, 1))))


def test_bundler_refuses_what_it_cannot_hold(tmp_path: Path) -> None:
    def refused(camera: Camera) -> str:
        with pytest.raises(UsageError) as error:
            write_bundler(tmp_path / "b.out", scene([camera]))
        return str(error.value)

    text = refused(synthetic_camera(CameraModel.OPENCV))
    assert "tangential distortion" in text
    assert "separate focal lengths" in text
    assert "fisheye" in refused(synthetic_camera(CameraModel.OPENCV_FISHEYE))
    assert not list(tmp_path.iterdir())
    # a richer model without anything in its extra parameters is no loss
    plain = Camera(CameraModel.OPENCV, 1000, 750, np.array([900.0, 900, 500, 375, -0.1, 0.01, 0, 0]))
    write_bundler(tmp_path / "b.out", scene([plain]))


def test_bundler_of_the_world(data_root: Path) -> None:
    rec = read_bundler(data_root / "balbianello" / "Balbianello.out")
    summary = rec.summary()
    assert (summary["num_registered"], summary["num_points"], summary["num_observations"]) == (5, 544, 1417)
    assert 0.1 < summary["mean_reprojection_error_px"] < 0.3  # 0.21 when it was published


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("# Bundle file v0.4\n0 0\n", "v0.3"),
        ("# Bundle file v0.3\n1000000000000 5\n", "truncated: expected 1000000000000 cameras"),
        ("# Bundle file v0.3\n1 x\n", "nothing but numbers"),
        ("# Bundle file v0.3\n1 0\n1 0 0  1 0 0 0 1 0 0 0 2  0 0 0\n", "rotation"),
        ("# Bundle file v0.3\n1 1\n1 0 0  1 0 0 0 1 0 0 0 1  0 0 0\n0 0 0 0 0 0 1 3 0 5 5\n", "views of 1 cameras"),
        ("# Bundle file v0.3\n1 1\n1 0 0  1 0 0 0 1 0 0 0 1  0 0 0\n0 0 0 0 0 0 9 0 0 5 5\n", "truncated"),
        ("# Bundle file v0.3\n1 1\n1 0 0  1 0 0 0 1 0 0 0 1  0 0 0\n0 0 nan 0 0 0 0\n", "finite"),
        ("# Bundle file v0.3\n1 1\n1 0 0  1 0 0 0 1 0 0 0 1  0 0 0\n0 0 0 0 0 300 0\n", "colours"),
        ("# Bundle file v0.3\n0 0\n7\n", "1 more numbers"),
    ],
)
def test_bundler_refusals(tmp_path: Path, text: str, match: str) -> None:
    (tmp_path / "b.out").write_text(text)
    with pytest.raises(InputError, match=match):
        read_bundler(tmp_path / "b.out")


@FUZZ
@given(data=st.data())
def test_damaged_bundler(tmp_path: Path, data: st.DataObject) -> None:
    if not (tmp_path / "good.out").exists():
        write_bundler(tmp_path / "good.out", scene([centered_camera()], 3))
    (tmp_path / "bad.out").write_bytes(damaged(data, (tmp_path / "good.out").read_bytes()))
    try:
        rec = read_bundler(tmp_path / "bad.out")
    except InputError:
        return
    rec.residuals_px()


# nerfstudio ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("models", [[model] for model in CameraModel] + [list(CameraModel)], ids=lambda m: len(m))
def test_nerfstudio_round_trip(tmp_path: Path, models: list[CameraModel]) -> None:
    rec = scene([synthetic_camera(model) for model in models], 7)
    write_nerfstudio(tmp_path / "transforms.json", rec)
    document = json.loads((tmp_path / "transforms.json").read_text())
    assert ("fl_x" in document) == (len(models) == 1)
    back = read_nerfstudio(tmp_path / "transforms.json")
    assert all(name.startswith("images/") for name in back.image_names)
    back.image_names = [name.removeprefix("images/") for name in back.image_names]
    points = rec.point_xyz[rec.is_triangulated]
    np.testing.assert_allclose(back.point_xyz, points, atol=1e-6 * np.ptp(points, axis=0).max())
    back.point_xyz = points  # those went through float32
    assert_same_model(rec, back)


def test_nerfstudio_sees_the_same_rays(tmp_path: Path) -> None:
    """nerfstudio's own arithmetic: direction ((u - cx) / fx, -(v - cy) / fy, -1), turned by transform_matrix."""
    camera = Camera(CameraModel.PINHOLE, 800, 600, np.array([700.0, 710, 390, 310]))
    rec = scene([camera])
    write_nerfstudio(tmp_path / "transforms.json", rec)
    document = json.loads((tmp_path / "transforms.json").read_text())
    xyz = read_ply_geometry(tmp_path / POINTS_NAME).xyz
    for frame, image in zip(document["frames"], rec.registered_idx, strict=True):
        seen = project(camera, rigid3.apply(rec.cam_from_world[image], rec.point_xyz[rec.is_triangulated]))
        matrix = np.array(frame["transform_matrix"])
        u, v = seen.T
        rays = np.stack(
            [(u - document["cx"]) / document["fl_x"], -(v - document["cy"]) / document["fl_y"], -np.ones(len(u))], 1
        )
        rays = rays @ matrix[:3, :3].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        towards = xyz - matrix[:3, 3]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        np.testing.assert_allclose(rays, towards, atol=1e-6)


def nerf_document(**changes: Any) -> dict[str, Any]:
    frame = {"file_path": "./a.png", "transform_matrix": np.eye(4).tolist()}
    return {"w": 80, "h": 60, "fl_x": 50.0, "frames": [frame]} | changes


def test_nerfstudio_of_others(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(nerf_document()))
    rec = read_nerfstudio(path)
    assert rec.image_names == ["a.png"]
    assert rec.cameras[0].params.tolist() == [50, 50, 40, 30, 0, 0, 0, 0]
    # OpenGL's identity looks down -z, y up
    np.testing.assert_allclose(rigid3.rotation_matrix(rec.cam_from_world[0]), np.diag([1, -1, -1]), atol=1e-12)
    blender = nerf_document(camera_angle_x=np.pi / 2)
    del blender["fl_x"]
    path.write_text(json.dumps(blender))
    assert read_nerfstudio(path).cameras[0].focal == pytest.approx(40)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"frames": 3}, "list of frames"),
        ({"frames": [{}]}, "file_path"),
        ({"frames": [{"file_path": "a", "transform_matrix": [[1, 0], [0, 1]]}]}, "3 x 4 finite numbers"),
        ({"frames": [{"file_path": "a", "transform_matrix": [["1", 0, 0, 0]] * 4}]}, "finite numbers"),
        ({"frames": [{"file_path": "a", "transform_matrix": (2 * np.eye(4)).tolist()}]}, "rotation"),
        ({"frames": [{"file_path": "a", "transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}]}, "rotation"),
        ({"frames": nerf_document()["frames"] * 2}, "once"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"k3": 0.1}, "no k3"),
        ({"fl_x": -5}, "positive focal"),
        ({"fl_x": True}, "a finite number"),
        ({"fl_x": float("nan")}, "found NaN"),
        ({"w": 1e300}, "image size"),
        ({"w": 0.5}, "whole number"),
        ({"ply_file_path": "../../etc/passwd"}, "beside"),
        ({"ply_file_path": "absent.ply"}, "cannot be read"),
        ({"applied_transform": [[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0]]}, "rotation"),
    ],
)
def test_nerfstudio_refusals(tmp_path: Path, changes: dict[str, Any], match: str) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(nerf_document(**changes)))
    with pytest.raises(InputError, match=match):
        read_nerfstudio(path)


def test_nerfstudio_poses_need_neither_points_nor_our_cameras(tmp_path: Path) -> None:
    """As a ground truth: panoramas, scenes without sizes, points that are gone or not to be read."""
    path = tmp_path / "transforms.json"
    (tmp_path / "bad.ply").write_bytes(b"no points")
    frames = [
        {"file_path": ".\\images\\a 1.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 40.0},
        {"file_path": "/data/b", "transform_matrix": np.eye(4).tolist()},
    ]
    path.write_text(json.dumps(nerf_document(frames=frames, ply_file_path="absent.ply")))
    ground_truth = read_ground_truth(path)
    assert ground_truth.names == ("images/a 1.png", "/data/b")
    assert ground_truth.cameras is not None
    assert [camera.focal for camera in ground_truth.cameras] == [40, 50]
    assert ground_truth.for_images(["b.jpg", "a 1.jpg"]).names == ("a 1.jpg", "b.jpg")
    for changes in ({"camera_model": "EQUIRECTANGULAR"}, {"w": None}, {"k3": 0.1}, {"ply_file_path": "bad.ply"}):
        path.write_text(json.dumps(nerf_document(frames=frames) | changes))
        np.testing.assert_array_equal(read_ground_truth(path).cam_from_world, ground_truth.cam_from_world)
    path.write_text(json.dumps(nerf_document(applied_scale=0)))
    with pytest.raises(InputError, match="applied_scale above 0"):
        read_ground_truth(path)


def test_nerfstudio_points_in_text_with_gaps_and_a_scale(tmp_path: Path) -> None:
    """The points that ns-process-data writes; and a world that was scaled after it was turned."""
    rec = scene([synthetic_camera()])
    write_nerfstudio(tmp_path / "transforms.json", rec)
    plain = read_nerfstudio(tmp_path / "transforms.json")
    document = json.loads((tmp_path / "transforms.json").read_text())
    for frame in document["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= 0.25
    (tmp_path / "transforms.json").write_text(json.dumps(document | {"applied_scale": 0.25}))
    points = read_ply_geometry(tmp_path / POINTS_NAME)
    assert points.rgb is not None
    rows = [f"{x / 4!r} {y / 4!r} {z / 4!r} {r} {g} {b}" for (x, y, z), (r, g, b) in
            zip(points.xyz.tolist(), points.rgb.tolist(), strict=True)]  # fmt: skip
    head = f"ply\nformat ascii 1.0\nelement vertex {len(rows) + 1}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz")
    head += "".join(f"property uint8 {color}\n" for color in ("red", "green", "blue"))
    (tmp_path / POINTS_NAME).write_text("\n".join([head + "end_header", "nan nan nan 1 2 3", *rows, ""]))
    back = read_nerfstudio(tmp_path / "transforms.json")
    np.testing.assert_allclose(back.cam_from_world, plain.cam_from_world, atol=1e-12)
    np.testing.assert_allclose(back.point_xyz, plain.point_xyz, atol=1e-12)
    np.testing.assert_array_equal(back.point_rgb, plain.point_rgb)


def test_nerfstudio_fisheye_of_instant_ngp(tmp_path: Path) -> None:
    (tmp_path / "t.json").write_text(json.dumps(nerf_document(is_fisheye=True, k1=0.1, k4=0.01)))
    camera = read_nerfstudio(tmp_path / "t.json").cameras[0]
    assert camera.model == CameraModel.OPENCV_FISHEYE
    assert camera.params[[4, 7]].tolist() == [0.1, 0.01]


@pytest.mark.parametrize("text", ["", "[1]", "{", "[" * 100_000, '{"frames": 1' + "0" * 5000 + "}", "\x00"])
def test_json_from_outside(tmp_path: Path, text: str) -> None:
    (tmp_path / "t.json").write_text(text)
    with pytest.raises(InputError):
        read_nerfstudio(tmp_path / "t.json")
    with pytest.raises(InputError):
        read_ground_truth(tmp_path / "t.json")


@FUZZ
@given(data=st.data())
def test_damaged_nerfstudio(tmp_path: Path, data: st.DataObject) -> None:
    if not (tmp_path / "good.json").exists():
        write_nerfstudio(tmp_path / "good.json", scene([synthetic_camera()], 3))
    (tmp_path / "bad.json").write_bytes(damaged(data, (tmp_path / "good.json").read_bytes()))
    try:
        read_nerfstudio(tmp_path / "bad.json").residuals_px()
    except InputError:
        return


# trajectories --------------------------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 8))
def test_tum_round_trip(tmp_path: Path, seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(count, 7))
    poses[:, :4] /= np.linalg.norm(poses[:, :4], axis=1, keepdims=True)
    poses[rng.random(count) < 0.2] = np.nan
    times = np.sort(rng.uniform(1.3e9, 1.4e9, count))
    write_tum(tmp_path / "t.tum", times, poses)
    names, back = read_tum(tmp_path / "t.tum")
    kept = np.isfinite(poses[:, 0])
    assert [float(name) for name in names] == times[kept].tolist()
    np.testing.assert_allclose(back[:, 4:], poses[kept, 4:], atol=1e-12)
    np.testing.assert_allclose(rigid3.rotation_matrix(back), rigid3.rotation_matrix(poses[kept]), atol=1e-12)


def test_tum_is_world_from_cam(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("# comment\n\n12.5 1 2 3 0 0 0.70711 0.70711\n")
    _, poses = read_tum(tmp_path / "t.txt")
    np.testing.assert_allclose(rigid3.center(poses), [[1, 2, 3]], atol=1e-5)
    # x of the camera is y of the world
    np.testing.assert_allclose(rigid3.rotation_matrix(poses[0]).T[:, 0], [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize(
    "line", ["1 2 3", "1 2 3 4 0 0 0 x", "1 2 3 4 0 0 0 nan", "1 2 3 4 0 0 0 2", "1 2 3 4 0 0 0 0"]
)
def test_tum_refusals(tmp_path: Path, line: str) -> None:
    (tmp_path / "t.txt").write_text(f"0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(InputError, match=r"t\.txt:2: expected"):
        read_tum(tmp_path / "t.txt")


# ground truth
# ---------------------------------------------------------------------------------------------------------------


def json_ground_truth(path: Path, rec: Reconstruction, prefix: str = "images/", **changes: Any) -> Path:
    """cameras.json as the shared data have it."""
    entries = []
    for image in rec.registered_idx:
        camera, pose = rec.cameras[rec.image_camera_idx[image]], rec.cam_from_world[image]
        k_matrix = camera.k_matrix
        k_matrix[:2, 2] -= 0.5
        dist = camera.canonical[4:8].tolist()
        entry = {"file": prefix + rec.image_names[image], "model": "pinhole", "K": k_matrix.tolist()}
        entry |= {"dist": dist if any(dist) else None, "R_w2c": rigid3.rotation_matrix(pose).tolist()}
        entry |= {"t_w2c": pose[4:].tolist(), "width": camera.width, "height": camera.height}
        entries.append(entry | changes)
    path.write_text(json.dumps({"convention": "x", "cameras": entries}))
    return path


def test_all_forms_of_ground_truth_agree(tmp_path: Path) -> None:
    rec = scene([centered_camera()])
    write_model(tmp_path / "sparse" / "0", rec)
    write_nerfstudio(tmp_path / "transforms.json", rec)
    write_tum(tmp_path / "t.tum", np.arange(5.0), rec.cam_from_world)
    registered = rec.registered_idx
    paths = [
        tmp_path, tmp_path / "sparse" / "0", tmp_path / "transforms.json", tmp_path / "t.tum",
        json_ground_truth(tmp_path / "cameras.json", rec),
    ]  # fmt: skip
    for path in paths:
        ground_truth = read_ground_truth(path)
        assert len(ground_truth.names) == len(registered)
        np.testing.assert_allclose(
            rigid3.rotation_matrix(ground_truth.cam_from_world),
            rigid3.rotation_matrix(rec.cam_from_world[registered]),
            atol=1e-9,
        )
        np.testing.assert_allclose(ground_truth.cam_from_world[:, 4:], rec.cam_from_world[registered, 4:], atol=1e-9)
        if path.suffix == ".tum":
            assert ground_truth.cameras is None
        else:
            assert ground_truth.cameras is not None
            for camera, image in zip(ground_truth.cameras, registered, strict=True):
                ours = rec.cameras[rec.image_camera_idx[image]]
                np.testing.assert_allclose(camera.canonical, ours.canonical, atol=1e-9)
            assert ground_truth.for_images(rec.image_names).names == tuple(rec.image_names[i] for i in registered)
        with pytest.raises(InputError, match="no name fits"):
            ground_truth.for_images(["p.jpg", "q.jpg"])


@pytest.mark.parametrize("name", ["sparse/0", "sparse", "colmap/sparse/0", "transforms.json", "cameras.json"])
def test_a_ground_truth_is_found_in_its_folder(tmp_path: Path, name: str) -> None:
    rec = scene([centered_camera()])
    if name == "transforms.json":
        write_nerfstudio(tmp_path / name, rec)
    elif name == "cameras.json":
        json_ground_truth(tmp_path / name, rec)
    else:
        write_model(tmp_path / name, rec)
    expected = rec.cam_from_world[rec.registered_idx, 4:]
    np.testing.assert_allclose(read_ground_truth(tmp_path).cam_from_world[:, 4:], expected, atol=1e-9)


@pytest.mark.parametrize("write", [write_model, write_model_text])
def test_poses_of_a_colmap_model_are_a_ground_truth_whatever_its_lenses(tmp_path: Path, write: Any) -> None:
    """As those of ETH3D: thin prism cameras, and observations that nobody asks for."""
    rec = scene([centered_camera()])
    write(tmp_path, rec)
    plain = read_ground_truth(tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path))
    for camera in model.cameras.values():
        camera.model, camera.params = "THIN_PRISM_FISHEYE", [900.0, 900, 500, 375, *[0.01] * 8]
    (model.write_binary if write is write_model else model.write_text)(str(tmp_path))
    with pytest.raises(InputError, match="THIN_PRISM_FISHEYE"):
        read_model(tmp_path)
    (next(tmp_path.glob("points3D.*"))).write_bytes(b"no points at all")
    ground_truth = read_ground_truth(tmp_path)
    assert ground_truth.cameras is None
    assert ground_truth.names == plain.names
    np.testing.assert_allclose(ground_truth.cam_from_world, plain.cam_from_world, atol=1e-14)


def test_ground_truth_agrees_with_opencv_on_the_half_pixel(tmp_path: Path) -> None:
    """K and dist of cameras.json go to cv2.projectPoints as they are; ours is half a pixel more."""
    rec = scene([synthetic_camera(CameraModel.OPENCV)])
    ground_truth = read_ground_truth(json_ground_truth(tmp_path / "cameras.json", rec))
    entry = json.loads((tmp_path / "cameras.json").read_text())["cameras"][0]
    points = rec.point_xyz[rec.is_triangulated]
    rvec = cv2.Rodrigues(np.array(entry["R_w2c"]))[0]
    theirs = cv2.projectPoints(points, rvec, np.array(entry["t_w2c"]), np.array(entry["K"]), np.array(entry["dist"]))[0]
    assert ground_truth.cameras is not None
    ours = project(ground_truth.cameras[0], rigid3.apply(ground_truth.cam_from_world[0], points))
    np.testing.assert_allclose(ours - 0.5, theirs[:, 0], atol=1e-6)


def test_ground_truth_of_a_trajectory_is_matched_by_number(tmp_path: Path) -> None:
    (tmp_path / "t.tum").write_text("1305031102.1753 0 0 0 0 0 0 1\n1305031102.2 1 0 0 0 0 0 1\n")
    names = ["rgb/1305031102.175300.png", "rgb/x.png"]
    assert read_ground_truth(tmp_path / "t.tum").for_images(names).names == (
        "rgb/1305031102.175300.png",
        "1305031102.2",
    )


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"R_w2c": (np.eye(3) * 1.1).tolist()}, "rotation"),
        ({"R_w2c": None}, "3 x 3 finite"),
        ({"t_w2c": [1, 2]}, "3 finite"),
        ({"K": [[1, 2, 3]]}, "3 x 3"),
        ({"K": [[500, 3, 320], [0, 500, 240], [0, 0, 1]]}, "without skew"),
        ({"K": [[-500, 0, 320], [0, 500, 240], [0, 0, 1]]}, "positive focal"),
        ({"dist": [0, 0, 0, 0, 0.5]}, "dist"),
        ({"dist": "none"}, "dist"),
        ({"file": 3}, "name of its file"),
        ({"file": "same.jpg"}, "once"),
        ({"width": -3}, "image size"),
        ({"width": "wide"}, "finite number"),
    ],
)
def test_ground_truth_refusals(tmp_path: Path, changes: dict[str, Any], match: str) -> None:
    with pytest.raises(InputError, match=match):
        read_ground_truth(json_ground_truth(tmp_path / "cameras.json", scene([centered_camera()]), **changes))


def test_ground_truth_from_nowhere(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found nothing"):
        read_ground_truth(tmp_path / "absent.json")
    with pytest.raises(InputError, match="COLMAP model"):
        read_ground_truth(tmp_path)
    (tmp_path / "empty.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match="trajectory"):
        read_ground_truth(tmp_path / "empty.txt")
    (tmp_path / "report.json").write_text('{"registered": 3}')
    with pytest.raises(InputError, match="list of cameras"):
        read_ground_truth(tmp_path / "report.json")


def test_ground_truth_of_the_shared_data(data_root: Path) -> None:
    for name, count in (
        ("fountain-P11", 11),
        ("herz-jesus-P8", 8),
        ("temple-sparse-ring", 16),
        ("nerf-lego-small", 50),
    ):
        ground_truth = read_ground_truth(data_root / name / "cameras.json")
        assert len(ground_truth.names) == count
        images = [path.name for path in (data_root / name / "images").iterdir()]
        assert sorted(ground_truth.for_images(images).names) == sorted(images)
    door = read_ground_truth(data_root / "lund-door" / "cameras.json")
    model = read_ground_truth(data_root / "lund-door" / "colmap_ground_truth").for_images(door.names)
    assert model.names == door.names
    np.testing.assert_allclose(model.cam_from_world, door.cam_from_world, atol=1e-12)
    assert door.cameras is not None
    assert model.cameras is not None
    for a, b in zip(door.cameras, model.cameras, strict=True):
        np.testing.assert_allclose(a.canonical, b.canonical)
        assert (a.width, a.height) == (b.width, b.height)
    rotation_only = read_ground_truth(data_root / "pano-sponza-rot" / "gt.json")
    np.testing.assert_allclose(rigid3.center(rotation_only.cam_from_world), 0, atol=1e-12)
