"""COLMAP models: pycolmap is the oracle in both directions."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sfmapp.camera.camera import CameraModel
from sfmapp.errors import InputError, UsageError
from sfmapp.events import Events
from sfmapp.formats.colmap import has_model, read_model, write_model, write_model_text
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import Rig
from sfmapp.scene.synthetic import make_scene, synthetic_camera, synthetic_rig
from sfmapp.scene.tracks import make_tracks

DATA = Path(os.environ.get("SFMAPP_DATA", Path(__file__).parents[2] / "shared" / "data"))


def partial_scene(seed: int = 0) -> tuple[Reconstruction, list[np.ndarray]]:
    """Six models of camera, one image and some points missing, some outliers, keypoints beyond the tracks."""
    rng = np.random.default_rng(seed)
    scene = make_scene(seed, 7, 120, [synthetic_camera(model) for model in list(CameraModel)[:6]])
    rec = scene.observed.copy()
    rec.point_rgb = rng.integers(0, 256, rec.point_rgb.shape, np.uint8)
    rec.cam_from_world[2] = np.nan
    rec.point_xyz[::9] = np.nan
    rec.obs_is_inlier &= rng.random(len(rec.obs_is_inlier)) < 0.95
    rec.obs_is_inlier &= rec.is_registered[rec.tracks.obs_image_idx] & rec.is_triangulated[rec.tracks.obs_track_idx]
    keypoints = []
    for image in range(7):
        seen = scene.keypoints(image)
        keypoints.append(np.concatenate([seen + 0.25, rng.uniform(0, 700, (5, 2))]).astype(np.float32))
    return rec, keypoints


def oracle(folder: Path) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(str(folder))


@pytest.mark.parametrize("write", [write_model, write_model_text])
def test_pycolmap_reads_what_we_write(tmp_path: Path, write) -> None:
    rec, keypoints = partial_scene()
    write(tmp_path / "m", rec, keypoints)
    theirs = oracle(tmp_path / "m")
    assert sorted(theirs.images) == [1, 2, 4, 5, 6, 7]
    assert sorted(theirs.cameras) == [1, 2, 4, 5, 6]  # seven images over six cameras, the third image is missing
    tracks = rec.tracks
    for image_id, image in theirs.images.items():
        i = image_id - 1
        assert image.name == rec.image_names[i]
        assert image.camera_id == rec.image_camera_idx[i] + 1
        pose = image.cam_from_world()
        np.testing.assert_array_equal(pose.rotation.quat, rec.cam_from_world[i, :4])
        np.testing.assert_array_equal(pose.translation, rec.cam_from_world[i, 4:])
        expected = keypoints[i].astype(float)
        obs = tracks.observations_of_image(i)
        expected[tracks.obs_feature_idx[obs]] = tracks.obs_xy[obs]
        np.testing.assert_array_equal([p.xy for p in image.points2D], expected)
    for camera_id, camera in theirs.cameras.items():
        ours = rec.cameras[camera_id - 1]
        assert (camera.model.name, camera.width, camera.height) == (ours.model.name, ours.width, ours.height)
        np.testing.assert_array_equal(camera.params, ours.params)
    points = np.flatnonzero(rec.is_triangulated)
    assert sorted(theirs.points3D) == (points + 1).tolist()
    written = {i: theirs.points3D[i].error for i in theirs.points3D}
    theirs.update_point_3d_errors()
    for t in points:
        point = theirs.points3D[t + 1]
        np.testing.assert_array_equal(point.xyz, rec.point_xyz[t])
        np.testing.assert_array_equal(point.color, rec.point_rgb[t])
        obs = np.arange(tracks.track_ptr[t], tracks.track_ptr[t + 1])
        obs = obs[rec.obs_is_inlier[obs]]
        got = [(e.image_id - 1, e.point2D_idx) for e in point.track.elements]
        assert got == list(zip(tracks.obs_image_idx[obs].tolist(), tracks.obs_feature_idx[obs].tolist(), strict=True))
        if len(obs):
            assert written[t + 1] == pytest.approx(point.error, abs=1e-9)


def theirs_synthetic(seed: int = 0, cameras_per_rig: int = 1) -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, cameras_per_rig, 4
    options.num_points3D = 60
    return pycolmap.synthesize_dataset(options)


def assert_same(
    rec: Reconstruction, keypoints: list[np.ndarray], theirs: pycolmap.Reconstruction, atol: float = 1e-12
) -> None:
    image_ids, point_ids = sorted(theirs.images), sorted(theirs.points3D)
    assert len(rec.image_names) == len(image_ids)
    for i, image_id in enumerate(image_ids):
        image = theirs.images[image_id]
        assert rec.image_names[i] == image.name
        pose = image.cam_from_world()
        np.testing.assert_allclose(rec.cam_from_world[i, 4:], pose.translation, atol=1e-12)
        np.testing.assert_allclose(
            rigid3.rotation_matrix(rec.cam_from_world[i]), pose.rotation.matrix(), rtol=0, atol=atol
        )
        np.testing.assert_array_equal(keypoints[i], np.array([p.xy for p in image.points2D]).reshape(-1, 2))
        np.testing.assert_array_equal(rec.cameras[rec.image_camera_idx[i]].params, image.camera.params)
    for t, point_id in enumerate(point_ids):
        np.testing.assert_array_equal(rec.point_xyz[t], theirs.points3D[point_id].xyz)
        at = range(rec.tracks.track_ptr[t], rec.tracks.track_ptr[t + 1])
        got = {(image_ids[rec.tracks.obs_image_idx[o]], int(rec.tracks.obs_feature_idx[o])) for o in at}
        assert got == {(e.image_id, e.point2D_idx) for e in theirs.points3D[point_id].track.elements}
    assert rec.obs_is_inlier.all()


@pytest.mark.parametrize("cameras_per_rig", [1, 2])
@pytest.mark.parametrize("form", ["bin", "txt"])
@pytest.mark.parametrize("old", [False, True])
def test_we_read_what_pycolmap_writes(tmp_path: Path, cameras_per_rig: int, form: str, old: bool) -> None:
    theirs = theirs_synthetic(1, cameras_per_rig)
    (theirs.write_binary if form == "bin" else theirs.write_text)(str(tmp_path))
    if old:
        (tmp_path / f"rigs.{form}").unlink()
        (tmp_path / f"frames.{form}").unlink()
    rec, keypoints = read_model(tmp_path)
    assert_same(rec, keypoints, theirs)
    assert (rec.rig is None) == (old or cameras_per_rig == 1)


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_rigs_of_pycolmap_go_round(tmp_path: Path, form: str) -> None:
    """Two rigs of two cameras: read, written and read again by both."""
    theirs = theirs_synthetic(2, 2)
    (theirs.write_binary if form == "bin" else theirs.write_text)(str(tmp_path))
    rec, keypoints = read_model(tmp_path)
    assert rec.rig is not None
    image_ids = sorted(theirs.images)
    frame_of = {d.id: f for f in theirs.frames.values() for d in f.data_ids}
    for i, image_id in enumerate(image_ids):
        frame, image = frame_of[image_id], theirs.images[image_id]
        together = {image_ids.index(d.id) for d in frame.data_ids}
        assert set(np.flatnonzero(rec.rig.frame_idx == rec.rig.frame_idx[i])) == together
        rig, sensor = theirs.rigs[frame.rig_id], image.camera.sensor_id
        assert (rec.rig.sensor_idx[i] == 0) == rig.is_ref_sensor(sensor)
        if rec.rig.sensor_idx[i]:
            mount = rig.sensor_from_rig(sensor)
            found = rec.rig.cam_from_rig[rec.rig.sensor_idx[i]]
            np.testing.assert_allclose(found, [*mount.rotation.quat, *mount.translation], atol=1e-15)
    write_model(tmp_path / "again", rec, keypoints)
    again = oracle(tmp_path / "again")
    assert sorted(len(rig.sensor_ids()) for rig in again.rigs.values()) == [2, 2]
    assert len(again.frames) == len(theirs.frames)
    back, _ = read_model(tmp_path / "again")
    assert_same_rig(back, rec)


def assert_same_rig(found: Reconstruction, wanted: Reconstruction) -> None:
    assert found.rig is not None
    assert wanted.rig is not None
    np.testing.assert_array_equal(found.rig.frame_idx, wanted.rig.frame_idx)
    np.testing.assert_array_equal(found.rig.sensor_idx, wanted.rig.sensor_idx)
    np.testing.assert_array_equal(found.rig.cam_from_rig, wanted.rig.cam_from_rig)
    np.testing.assert_array_equal(found.cam_from_world, wanted.cam_from_world)


@pytest.mark.parametrize("write", [write_model, write_model_text])
@pytest.mark.parametrize("one_camera", [False, True])
def test_stereo_is_a_rig_for_pycolmap_and_comes_back(tmp_path: Path, write, one_camera: bool) -> None:
    """Exact poses of rig, frames and images, also where both sensors are one camera to us."""
    rig = synthetic_rig(0.4)
    if one_camera:
        rig = Rig((rig.cameras[0],) * 2, rig.cam_from_rig)
    cameras = [rig.cameras[0]] if one_camera else None
    rec = make_scene(0, 10, 80, cameras, rig=rig).observed
    write(tmp_path / "m", rec)
    theirs = oracle(tmp_path / "m")
    assert len(theirs.cameras) == 2
    assert list(theirs.rigs) == [1]
    assert theirs.rigs[1].ref_sensor_id.id == 1
    ((sensor, mount),) = theirs.rigs[1].non_ref_sensors.items()
    assert sensor.id == 2
    np.testing.assert_array_equal([*mount.rotation.quat, *mount.translation], rig.cam_from_rig[1])
    assert sorted(theirs.frames) == [1, 3, 5, 7, 9]
    for frame_id, frame in theirs.frames.items():
        pose = frame.rig_from_world
        np.testing.assert_array_equal([*pose.rotation.quat, *pose.translation], rec.cam_from_world[frame_id - 1])
        assert sorted((d.sensor_id.id, d.id) for d in frame.data_ids) == [(1, frame_id), (2, frame_id + 1)]
    for image_id, image in theirs.images.items():
        wanted, pose = rec.cam_from_world[image_id - 1], image.cam_from_world()
        np.testing.assert_allclose(pose.rotation.matrix(), rigid3.rotation_matrix(wanted), atol=1e-14)
        np.testing.assert_allclose(pose.translation, wanted[4:], atol=1e-13)
        np.testing.assert_array_equal(image.camera.params, rec.cameras[rec.image_camera_idx[image_id - 1]].params)
    back, _ = read_model(tmp_path / "m")
    assert_same_rig(back, rec)
    np.testing.assert_array_equal(back.residuals_px(), rec.residuals_px())


@pytest.mark.parametrize("write", [write_model, write_model_text])
def test_rigs_with_gaps_and_images_beside_them(tmp_path: Path, write) -> None:
    """Images missing on either side, images on no rig, and one camera in three roles."""
    rec = make_scene(1, 12, 150, synthetic_camera(), rig=synthetic_rig(0.4)).observed.copy()
    assert rec.rig is not None
    rec.rig = replace(rec.rig, frame_idx=np.array([4, 4, 0, 0, 1, 1, 2, 2, -1, -1, 3, 3], np.int32))
    rec.rig.sensor_idx[8:10] = 0
    gone = [3, 4]
    rec.cam_from_world[gone] = np.nan
    rec.obs_is_inlier[np.isin(rec.tracks.obs_image_idx, gone)] = False
    write(tmp_path / "m", rec)
    theirs = oracle(tmp_path / "m")
    assert len(theirs.cameras) == 3
    assert sorted(rig.num_sensors() for rig in theirs.rigs.values()) == [1, 2]
    assert len(theirs.frames) == 7
    back, _ = read_model(tmp_path / "m")
    kept = np.setdiff1d(np.arange(12), gone)
    assert back.rig is not None
    assert back.rig.frame_idx.tolist() == [0, 0, 1, 2, 3, 3, -1, -1, 4, 4]
    np.testing.assert_array_equal(back.rig.sensor_idx, rec.rig.sensor_idx[kept])
    np.testing.assert_allclose(back.cam_from_world, rec.cam_from_world[kept], atol=1e-14)
    for image_id, image in theirs.images.items():
        wanted, pose = rec.cam_from_world[image_id - 1], image.cam_from_world()
        np.testing.assert_allclose(pose.rotation.matrix(), rigid3.rotation_matrix(wanted), atol=1e-14)
        np.testing.assert_allclose(pose.translation, wanted[4:], atol=1e-13)
    # without any image of sensor 0 the next one is the reference
    rec.cam_from_world[:8:2] = rec.cam_from_world[8:11] = np.nan
    rec.obs_is_inlier[~rec.is_registered[rec.tracks.obs_image_idx]] = False
    write(tmp_path / "m", rec)
    assert [rig.num_sensors() for rig in oracle(tmp_path / "m").rigs.values()] == [1]
    np.testing.assert_array_equal(read_model(tmp_path / "m")[0].cam_from_world, rec.cam_from_world[[1, 5, 7, 11]])
    # and one sensor takes one image at a time
    rec.rig = replace(rec.rig, frame_idx=np.zeros(12, np.int32), sensor_idx=np.ones(12, np.int32))
    with pytest.raises(ValueError, match="two images of one sensor"):
        write(tmp_path / "m", rec)


@pytest.mark.parametrize("write", [write_model, write_model_text])
def test_read_write_read_is_exact(tmp_path: Path, write) -> None:
    rec, keypoints = partial_scene(3)
    write(tmp_path / "a", rec, keypoints)
    first, first_keypoints = read_model(tmp_path / "a")
    write(tmp_path / "b", first, first_keypoints)
    second, _ = read_model(tmp_path / "b")
    np.testing.assert_array_equal(first.cam_from_world, second.cam_from_world)
    np.testing.assert_array_equal(first.point_xyz, second.point_xyz)
    np.testing.assert_array_equal(first.tracks.obs_xy, second.tracks.obs_xy)
    np.testing.assert_array_equal(first.tracks.obs_feature_idx, second.tracks.obs_feature_idx)
    assert first.summary() == second.summary()
    residuals = np.linalg.norm(first.residuals_px(), axis=1)
    expected = np.linalg.norm(rec.residuals_px()[rec.obs_is_inlier], axis=1)
    np.testing.assert_array_equal(np.sort(residuals), np.sort(expected))


def test_same_input_same_bytes_and_other_files_stay(tmp_path: Path) -> None:
    rec, keypoints = partial_scene()
    folder = tmp_path / "sparse" / "0"
    write_model_text(folder, rec, keypoints)
    (folder / "notes.md").write_text("mine")
    write_model(folder, rec, keypoints)
    assert sorted(p.name for p in folder.iterdir()) == [
        "cameras.bin", "frames.bin", "images.bin", "notes.md", "points3D.bin", "rigs.bin",
    ]  # fmt: skip
    write_model(tmp_path / "again", rec, keypoints)
    for path in (tmp_path / "again").iterdir():
        assert path.read_bytes() == (folder / path.name).read_bytes()
    assert [p.name for p in (tmp_path / "sparse").iterdir()] == ["0"]
    assert has_model(folder)
    assert not has_model(tmp_path)


def test_failed_write_leaves_the_old_model(tmp_path: Path) -> None:
    rec, keypoints = partial_scene()
    write_model(tmp_path / "m", rec, keypoints)
    before = (tmp_path / "m" / "points3D.bin").read_bytes()
    rec.image_names[0] = "with space.jpg"
    with pytest.raises(UsageError, match="white space"):
        write_model_text(tmp_path / "m", rec, keypoints)
    assert (tmp_path / "m" / "points3D.bin").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["m"]
    rec.point_xyz[1] = [np.inf, 0, 0]
    with pytest.raises(ValueError, match="finite"):
        write_model(tmp_path / "m", rec, keypoints)


def test_without_keypoints_the_tracked_ones_move_up(tmp_path: Path) -> None:
    rec, keypoints = partial_scene()
    write_model(tmp_path / "m", rec)
    back, found = read_model(tmp_path / "m")
    for position, image in enumerate(rec.registered_idx):
        assert len(found[position]) == len(rec.tracks.observations_of_image(image)) < len(keypoints[image])
    assert len(oracle(tmp_path / "m").points3D) == back.tracks.num_tracks
    np.testing.assert_array_equal(back.tracks.obs_xy, rec.tracks.obs_xy[rec.obs_is_inlier])


def test_empty_reconstruction(tmp_path: Path) -> None:
    tracks = make_tracks(0, 0, *[np.zeros(0, int)] * 3, np.zeros((0, 2)))
    for write in (write_model, write_model_text):
        write(tmp_path / "m", Reconstruction.empty([], [], np.zeros(0, np.int32), tracks))
        rec, keypoints = read_model(tmp_path / "m")
        assert rec.image_names == keypoints == []


@pytest.mark.real
def test_lund_door_reference() -> None:
    folder = DATA / "lund-door" / "colmap_ground_truth"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent")
    rec, keypoints = read_model(folder)
    assert_same(rec, keypoints, oracle(folder), atol=1e-6)  # pycolmap keeps the file's rounded quaternions as they are
    summary = rec.summary()
    assert summary["num_points"] == 11384
    assert summary["mean_track_length"] == pytest.approx(6.4412333)
    assert 0.1 < summary["mean_reprojection_error_px"] < 1.0


@st.composite
def reconstructions(draw: st.DrawFn) -> tuple[Reconstruction, list[np.ndarray]]:
    """Any shape: unregistered images, points without observations, several observations in one image."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    num_images, num_points = draw(st.integers(1, 5)), draw(st.integers(0, 12))
    cameras = [
        synthetic_camera(model) for model in draw(st.lists(st.sampled_from(CameraModel), min_size=1, max_size=3))
    ]
    counts = rng.integers(0, 9, num_images)
    keypoints = [rng.uniform(-1e4, 1e4, (count, 2)) for count in counts]
    image_idx = np.repeat(np.arange(num_images), counts)
    feature_idx = np.concatenate([np.arange(count) for count in counts])
    chosen = rng.random(len(image_idx)) < (0.7 if num_points else 0.0)
    track_idx = rng.integers(0, max(num_points, 1), chosen.sum())
    xy = np.concatenate(keypoints)[chosen]
    tracks = make_tracks(num_images, num_points, track_idx, image_idx[chosen], feature_idx[chosen], xy)
    names = [f"{i:02d}/" + draw(st.text("abcé._-漢", min_size=1, max_size=6)) for i in range(num_images)]
    camera_idx = rng.integers(0, len(cameras), num_images).astype(np.int32)
    rec = Reconstruction.empty(cameras, names, camera_idx, tracks)
    poses = rng.normal(size=(num_images, 7)) * draw(st.sampled_from([1e-6, 1.0, 1e6]))
    poses[:, :4] /= np.linalg.norm(poses[:, :4], axis=1, keepdims=True)
    registered = rng.random(num_images) < 0.8
    rec.cam_from_world[registered] = poses[registered]
    triangulated = rng.random(num_points) < 0.8
    rec.point_xyz[triangulated] = rng.normal(size=(triangulated.sum(), 3)) * 10.0 ** rng.integers(-9, 9)
    rec.point_rgb = rng.integers(0, 256, (num_points, 3), np.uint8)
    rec.obs_is_inlier[:] = registered[tracks.obs_image_idx] & triangulated[tracks.obs_track_idx]
    return rec, keypoints


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(scene=reconstructions(), binary=st.booleans())
def test_round_trip(tmp_path: Path, scene, binary: bool) -> None:
    rec, keypoints = scene
    (write_model if binary else write_model_text)(tmp_path / "m", rec, keypoints)
    back, found = read_model(tmp_path / "m")
    registered, points = rec.registered_idx, np.flatnonzero(rec.is_triangulated)
    assert back.image_names == [rec.image_names[i] for i in registered]
    np.testing.assert_allclose(back.cam_from_world, rec.cam_from_world[registered], rtol=1e-15)
    np.testing.assert_array_equal(back.point_xyz, rec.point_xyz[points])
    np.testing.assert_array_equal(back.point_rgb, rec.point_rgb[points])
    for i, image in enumerate(registered):
        np.testing.assert_array_equal(found[i], keypoints[image])
        assert back.cameras[back.image_camera_idx[i]].model == rec.cameras[rec.image_camera_idx[image]].model
    used = rec.obs_is_inlier
    np.testing.assert_array_equal(registered[back.tracks.obs_image_idx], rec.tracks.obs_image_idx[used])
    np.testing.assert_array_equal(points[back.tracks.obs_track_idx], rec.tracks.obs_track_idx[used])
    np.testing.assert_array_equal(back.tracks.obs_feature_idx, rec.tracks.obs_feature_idx[used])


@pytest.fixture(scope="module")
def model_bytes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    rec, keypoints = partial_scene()
    folder = tmp_path_factory.mktemp("fuzz") / "m"
    write_model(folder, rec, keypoints)
    model = {path.name: path.read_bytes() for path in folder.iterdir()}
    write_model_text(folder, rec, keypoints)
    return model | {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def rig_bytes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("fuzz") / "rig"
    rec = make_scene(0, 6, 20, rig=synthetic_rig()).observed
    write_model(folder, rec)
    model = {path.name: path.read_bytes() for path in folder.iterdir()}
    write_model_text(folder, rec)
    return model | {path.name: path.read_bytes() for path in folder.iterdir()}


def lay_out(folder: Path, files: dict[str, bytes], ending: str) -> None:
    for name, data in files.items():
        if name.endswith(ending):
            (folder / name).write_bytes(data)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_refused_or_read(
    tmp_path: Path, model_bytes: dict[str, bytes], rig_bytes: dict[str, bytes], data: st.DataObject
) -> None:
    model_bytes = data.draw(st.sampled_from([model_bytes, rig_bytes]))
    name = data.draw(st.sampled_from(sorted(model_bytes)))
    lay_out(tmp_path, {old.name: b"" for old in tmp_path.iterdir()}, "")
    for old in tmp_path.iterdir():
        old.unlink()
    damaged = bytearray(model_bytes[name])
    # most of the structure is in the first bytes
    place = st.integers(0, min(len(damaged), data.draw(st.sampled_from([8, 64, 400, 10**9]))) - 1)
    for at in data.draw(st.lists(place, min_size=1, max_size=4)):
        damaged[at] ^= 1 << data.draw(st.integers(0, 7))
    if data.draw(st.booleans()):
        damaged = damaged[: data.draw(st.integers(0, len(damaged)))]
    lay_out(tmp_path, model_bytes | {name: bytes(damaged)}, name[-4:])
    try:
        rec, _ = read_model(tmp_path)
    except InputError:
        return
    rec.residuals_px()
    assert np.isfinite(rec.point_xyz).all()
    if rec.rig is not None:
        assert np.isfinite(rec.rig.rig_from_world(rec.cam_from_world)).all()


def refuse(folder: Path, model_bytes: dict[str, bytes], name: str, data: bytes, match: str) -> None:
    lay_out(folder, model_bytes | {name: data}, name[-4:])
    with pytest.raises(InputError, match=match):
        read_model(folder)


def test_refusals_say_what_is_wrong(tmp_path: Path, model_bytes: dict[str, bytes]) -> None:
    cameras, points, images = (model_bytes[f"{stem}.bin"] for stem in ("cameras", "points3D", "images"))
    unknown = cameras[:12] + struct.pack("<i", 18) + cameras[16:]
    refuse(tmp_path, model_bytes, "cameras.bin", unknown, "with id 18 is not supported")
    unknown = cameras[:12] + struct.pack("<i", 99) + cameras[16:]
    refuse(tmp_path, model_bytes, "cameras.bin", unknown, "with id 99")
    negative = cameras[:32] + struct.pack("<d", -3) + cameras[40:]
    refuse(tmp_path, model_bytes, "cameras.bin", negative, "positive focal")
    refuse(tmp_path, model_bytes, "points3D.bin", struct.pack("<Q", 2**60) + points[8:], r"points3D\.bin: expected")
    refuse(tmp_path, model_bytes, "points3D.bin", points[:-3], "found fewer")
    refuse(tmp_path, model_bytes, "points3D.bin", points + b"x", "expected the end")
    nan = points[:16] + struct.pack("<d", np.nan) + points[24:]
    refuse(tmp_path, model_bytes, "points3D.bin", nan, "NaN")
    refuse(tmp_path, model_bytes, "images.bin", images[:8] + images[:4] + images[12:], "no|image|frame")
    refuse(tmp_path, model_bytes, "images.bin", images[: len(images) // 2], "expected")
    with pytest.raises(InputError, match="COLMAP model"):
        read_model(tmp_path / "absent")


def test_text_refusals_name_the_line(tmp_path: Path) -> None:
    good = {
        "cameras.txt": b"# c\n1 PINHOLE 100 80 50 50 50 40\n",
        "images.txt": b"1 1 0 0 0 0 0 1 1 a b.jpg\n10 20 5\n",
        "points3D.txt": b"5 0 0 4 1 2.0 3 nan 1 0\n",
    }
    lay_out(tmp_path, good, "txt")
    rec, keypoints = read_model(tmp_path)
    assert rec.image_names == ["a b.jpg"]
    assert keypoints[0].tolist() == [[10, 20]]
    refuse(tmp_path, good, "cameras.txt", b"1 PINHOLE 100 80 50 50 x 40\n", r"cameras\.txt:1: expected numbers")
    refuse(tmp_path, good, "cameras.txt", b"1 PINHOLE 100 80 50 50 40\n", "has 4 parameters, found 3")
    refuse(tmp_path, good, "cameras.txt", b"1 ORTHO 100 80 50 50 40 1 1 1\n", "ORTHO is not supported")
    refuse(tmp_path, good, "images.txt", b"1 1 0 0 0 0 0 1 1 a.jpg\n10 20\n", "three fields")
    refuse(
        tmp_path, good, "images.txt", b"1 1 0 0 0 0 0 1 7 a.jpg\n10 20 5\n", "camera 7, which the model does not hold"
    )
    refuse(tmp_path, good, "points3D.txt", b"5 0 0 4 1 2 3 0 1 1\n", "names keypoint 1 of image 'a b.jpg', which has 1")
    refuse(tmp_path, good, "points3D.txt", b"6 0 0 4 1 2 3 0 1 0\n", "which names point 5")
    refuse(tmp_path, good, "points3D.txt", b"5 0 0 4 1 2 3 0 1 0 1 0\n", "as many keypoints")
    refuse(tmp_path, good, "points3D.txt", b"5 0 0 4 1 2 300 0 1 0\n", "from 0 to 255")
    refuse(tmp_path, good, "points3D.txt", b"5 0 0 4 1 2 3.5 0 1 0\n", "whole numbers from 0 to 255")
    refuse(tmp_path, good, "points3D.txt", b"\xff\xfe\n", "UTF-8")


# models that others have edited --------------------------------------------------------------------------------------


def observations(model: Any) -> set[tuple[str, int, int]]:
    """Image name, keypoint and point of every observation that pycolmap's images tell of, of points that exist."""
    return {
        (image.name, k, point.point3D_id)
        for image in model.images.values()
        for k, point in enumerate(image.points2D)
        if point.has_point3D() and point.point3D_id in model.points3D
    }


def our_observations(folder: Path, said: list[str]) -> set[tuple[str, int, int]]:
    rec, keypoints = read_model(folder, Events(lambda event: said.append(event.message)))
    ids = sorted(oracle(folder).points3D)
    tracks = rec.tracks
    for image, xy in enumerate(keypoints):
        obs = tracks.observations_of_image(image)
        np.testing.assert_array_equal(tracks.obs_xy[obs], xy[tracks.obs_feature_idx[obs]])
    rows = zip(tracks.obs_image_idx, tracks.obs_feature_idx, tracks.obs_track_idx, strict=True)
    return {(rec.image_names[i], int(k), ids[t]) for i, k, t in rows}


def without_every_third(text: str) -> str:
    return "\n".join(line for n, line in enumerate(text.split("\n")) if n % 3 or line.startswith("#"))


def without_tracks(text: str) -> str:
    return "\n".join(line if line.startswith("#") else " ".join(line.split()[:8]) for line in text.split("\n"))


def without_names(text: str) -> str:
    """Keypoints of the first image lose their points."""
    lines = text.split("\n")
    fields = lines[2].split()
    lines[2] = " ".join("-1" if k % 3 == 2 else field for k, field in enumerate(fields))
    return "\n".join(lines)


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize(
    ("name", "edit", "says"),
    [
        ("points3D", without_every_third, "name points that are not there"),
        ("points3D", lambda text: "", "name points that are not there"),
        ("points3D", without_tracks, "stand with the images alone"),
        ("images", without_names, None),
    ],
)
def test_filtered_models_mean_what_they_mean_to_colmap(
    tmp_path: Path, name: str, edit: Callable[[str], str], says: str | None, binary: bool
) -> None:
    rec, keypoints = partial_scene()
    write_model_text(tmp_path, rec, keypoints)
    for stem in ("rigs", "frames"):
        (tmp_path / f"{stem}.txt").unlink()
    path = tmp_path / f"{name}.txt"
    path.write_text(edit(path.read_text()))
    if binary:
        oracle(tmp_path).write_binary(str(tmp_path))
    theirs = oracle(tmp_path)
    said: list[str] = []
    found = our_observations(tmp_path, said)
    assert found == observations(theirs)
    if not binary:  # COLMAP puts some of it in order where it writes
        assert (says is None) == (not said)
        assert says is None or (len(said) == 1 and says in said[0])


def test_a_deleted_image_and_an_emptied_one(tmp_path: Path) -> None:
    rec, keypoints = partial_scene()
    write_model_text(tmp_path, rec, keypoints)
    for stem in ("rigs", "frames"):
        (tmp_path / f"{stem}.txt").unlink()
    lines = (tmp_path / "images.txt").read_text().split("\n")
    full = our_observations(tmp_path, [])
    gone, emptied = lines[1].split()[9], lines[3].split()[9]
    (tmp_path / "images.txt").write_text("\n".join([lines[0], lines[3], "", *lines[5:]]))
    said: list[str] = []
    found, _ = read_model(tmp_path, Events(lambda event: said.append(event.message)))
    assert gone not in found.image_names
    assert emptied in found.image_names
    assert found.tracks.num_observations == sum(name not in (gone, emptied) for name, _, _ in full)
    assert len(said) == 1
    assert f"{sum(name in (gone, emptied) for name, _, _ in full)} observations name images" in said[0]


@pytest.mark.parametrize("write", [write_model, write_model_text])
def test_cameras_of_every_model_cross_over(tmp_path: Path, write) -> None:
    """Ours as COLMAP reads them, and COLMAP's as we do, used or not."""
    rec, keypoints = partial_scene()
    write(tmp_path / "m", rec, keypoints)
    model = oracle(tmp_path / "m")
    known = [each for each in CameraModel if each.is_colmaps]
    cameras = {7000 - number: synthetic_camera(each) for number, each in enumerate(known)}
    for camera_id, ours in cameras.items():
        theirs = pycolmap.Camera(
            camera_id=camera_id, model=ours.model.name, width=ours.width, height=ours.height, params=ours.params
        )
        model.add_camera_with_trivial_rig(theirs)
    if write is write_model:
        model.write_binary(str(tmp_path / "m"))
    else:
        model.write_text(str(tmp_path / "m"))
    back, _ = read_model(tmp_path / "m")
    found = {camera.model: camera for camera in back.cameras}
    for ours in cameras.values():
        np.testing.assert_array_equal(found[ours.model].params, ours.params)


@pytest.mark.parametrize("model", list(CameraModel), ids=lambda model: model.name)
@pytest.mark.parametrize("write", [write_model, write_model_text])
def test_a_model_of_every_lens(tmp_path: Path, write, model) -> None:
    rec, keypoints = partial_scene()
    rec.cameras = [synthetic_camera(model, camera.width, camera.height) for camera in rec.cameras]
    write(tmp_path, rec, keypoints)
    back, _ = read_model(tmp_path)
    for theirs in back.cameras:
        assert theirs.model == model
        np.testing.assert_array_equal(theirs.params, rec.cameras[0].params)
    if model.is_colmaps:
        for camera in oracle(tmp_path).cameras.values():
            assert camera.model.name == model.name
            np.testing.assert_array_equal(camera.params, rec.cameras[0].params)


def test_text_as_editors_leave_it(tmp_path: Path) -> None:
    """Windows line ends, a byte order mark, blanks at line ends, comments and blank lines in between."""
    rec, keypoints = partial_scene()
    write_model_text(tmp_path, rec, keypoints)
    plain, _ = read_model(tmp_path)
    for path in tmp_path.iterdir():
        lines = path.read_text().split("\n")
        step = 2 if path.stem == "images" else 1  # the two lines of an image stay together
        records = ["\n".join(lines[i : i + step]) for i in range(1, len(lines), step)]
        text = "\ufeff# made by hand\n" + "\n# a comment\n\n".join(records) + "\n# the end"
        path.write_bytes(text.replace("\n", " \t\r\n").encode())
    said: list[str] = []
    back, _ = read_model(tmp_path, Events(lambda event: said.append(event.message)))
    assert not said
    assert back.image_names == plain.image_names
    for name in ("cam_from_world", "point_xyz", "point_rgb"):
        np.testing.assert_array_equal(getattr(back, name), getattr(plain, name))
    np.testing.assert_array_equal(back.tracks.obs_xy, plain.tracks.obs_xy)


@pytest.mark.parametrize("write", [write_model, write_model_text])
def test_files_that_are_missing(tmp_path: Path, write) -> None:
    """Known poses come without points; frames without rigs leave the poses of the images file."""
    rec = make_scene(0, 6, 20, rig=synthetic_rig()).observed
    write(tmp_path, rec)
    plain, _ = read_model(tmp_path)
    for stem in ("points3D", "rigs"):
        next(tmp_path.glob(f"{stem}.*")).unlink()
    said: list[str] = []
    back, _ = read_model(tmp_path, Events(lambda event: said.append(event.message)))
    assert len(back.point_xyz) == back.tracks.num_observations == 0
    assert [any(word in note for note in said) for word in ("no file of points", "none of rigs")] == [True, True]
    np.testing.assert_allclose(back.cam_from_world, plain.cam_from_world, atol=1e-14)


RIG_FILES = {
    "cameras.txt": b"1 PINHOLE 100 80 50 50 50 40\n2 PINHOLE 100 80 50 50 50 40\n",
    "rigs.txt": b"1 2 CAMERA 1 CAMERA 2 1 1 0 0 0 1 0 0\n",
    "frames.txt": b"1 1 1 0 0 0 0 0 0 2 CAMERA 1 1 CAMERA 2 2\n",
    "images.txt": b"1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 1 0 0 2 b.jpg\n\n",
    "points3D.txt": b"",
}


@pytest.mark.parametrize(
    ("name", "data", "match"),
    [
        ("rigs.txt", RIG_FILES["rigs.txt"] * 2, "found rig 1 twice"),
        ("rigs.txt", b"1 3 CAMERA 1 CAMERA 2 1 1 0 0 0 1 0 0 CAMERA 2 1 1 0 0 0 2 0 0\n", "found camera 2 twice"),
        ("frames.txt", RIG_FILES["frames.txt"] + b"1 1 1 0 0 0 5 0 0 1 CAMERA 1 9\n", "every frame id once"),
        ("frames.txt", b"1 1 1 0 0 0 0 0 0 2 CAMERA 2 1 CAMERA 1 2\n", "image 1 of camera 2, but the images"),
        ("images.txt", b"1 1 0 0 0 0 0 0 1 a.jpg\n2 1 0 0 0 1 0 0 2 b.jpg\n", "three fields per keypoint of image 'a"),
        ("cameras.txt", b"1 PINHOLE 1_00 80 50 50 50 40\n", "expected whole numbers"),
        ("images.txt", b"1 0 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 1 0 0 2 b.jpg\n\n", "image 1: expected a finite pose"),
        ("images.txt", RIG_FILES["images.txt"].replace(b"b.jpg", b"a.jpg"), "'a.jpg' twice"),
    ],
)  # fmt: skip
def test_contradictions_are_refused(tmp_path: Path, name: str, data: bytes, match: str) -> None:
    lay_out(tmp_path, RIG_FILES, "txt")
    assert read_model(tmp_path)[0].rig is not None
    refuse(tmp_path, RIG_FILES, name, data, match)
