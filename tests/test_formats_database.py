"""The database: pycolmap reads ours and maps from it, we read pycolmap's."""

from __future__ import annotations

import dataclasses
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sfmapp.camera.camera import Camera, CameraModel, simple_camera
from sfmapp.errors import InputError
from sfmapp.formats.database import Database
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.features import DescriptorMetric, Features
from sfmapp.scene.synthetic import SyntheticScene, make_scene, synthetic_camera, true_correspondences


def features_of(scene: SyntheticScene, image: int, orb: bool = False) -> Features:
    rng = np.random.default_rng([7, image])
    xy = scene.keypoints(image)
    keypoints = np.concatenate([xy, rng.uniform(1, 9, (len(xy), 1)), rng.uniform(-3, 3, (len(xy), 1))], 1)
    descriptors = rng.integers(0, 256, (len(xy), 32 if orb else 128), np.uint8)
    metric = DescriptorMetric.HAMMING if orb else DescriptorMetric.ROOT_SIFT
    rgb = rng.integers(0, 256, (len(xy), 3), np.uint8)
    is_dark = rng.random(len(xy)) < 0.5 if image % 2 else None
    return Features(keypoints.astype(np.float32), descriptors, rgb, metric, is_dark)


def filled(
    path: Path, num_images: int = 5, cameras: list[Camera] | None = None, num_points: int = 200
) -> SyntheticScene:
    scene = make_scene(3, num_images, num_points, cameras, sigma_px=0.3)
    ground_truth = scene.ground_truth
    with Database(path) as database:
        database.set_images(ground_truth.cameras, ground_truth.image_names, ground_truth.image_camera_idx)
        for image in range(num_images):
            database.write_features(image, features_of(scene, image), f"key{image}")
        database.write_pairs(true_correspondences(scene), "pairs")
    return scene


def assert_equal(a: Correspondences | Features, b: Correspondences | Features) -> None:
    for field in dataclasses.fields(a):
        ours, theirs = np.asarray(getattr(a, field.name)), np.asarray(getattr(b, field.name))
        assert ours.dtype == theirs.dtype, field.name
        np.testing.assert_array_equal(ours, theirs, err_msg=field.name)


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "a b#?.db"
    models = [synthetic_camera(model) for model in list(CameraModel)[:6]]
    models[1] = dataclasses.replace(models[1], focal_source="exif_35mm")
    scene = filled(path, 7, models)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]  # the log is folded in
    for read_only in (False, True):
        with Database(path, read_only=read_only) as database:
            cameras, names, camera_idx = database.read_images()
            assert names == scene.ground_truth.image_names
            np.testing.assert_array_equal(camera_idx, scene.ground_truth.image_camera_idx)
            for ours, expected in zip(cameras, models, strict=True):
                assert (ours.model, ours.width, ours.height) == (expected.model, expected.width, expected.height)
                np.testing.assert_array_equal(ours.params, expected.params)
            assert [camera.focal_source for camera in cameras] == ["default", "file"] + ["default"] * 4
            assert database.feature_keys() == {i: f"key{i}" for i in range(7)}
            for image in range(7):
                assert_equal(database.read_features(image), features_of(scene, image))
            ground_truth = true_correspondences(scene)
            assert_equal(database.read_pairs(), ground_truth)
            assert set(database.pair_keys()) == set(map(tuple, ground_truth.pair_image_idx.tolist()))
            some = database.read_pairs(ground_truth.pair_image_idx[3:5])
            np.testing.assert_array_equal(some.matches_of_pair(1), ground_truth.matches_of_pair(4))
            with pytest.raises(InputError, match="found none"):
                database.read_pairs(np.array([[1, 99]]))


def test_pycolmap_reads_ours(tmp_path: Path) -> None:
    scene = filled(tmp_path / "d.db")
    before = (tmp_path / "d.db").read_bytes()
    database = pycolmap.Database.open(str(tmp_path / "d.db"))
    assert database.num_images() == database.num_frames() == 5
    assert database.num_rigs() == database.num_cameras() == 1
    for image in range(5):
        ours = features_of(scene, image)
        theirs = database.read_keypoints(image + 1)
        np.testing.assert_array_equal(theirs, ours.keypoints)
        descriptors = database.read_descriptors(image + 1)
        assert descriptors.type == pycolmap.FeatureExtractorType.SIFT
        np.testing.assert_array_equal(descriptors.data, ours.descriptors)
        assert database.read_image(image + 1).name == scene.ground_truth.image_names[image]
    ground_truth = true_correspondences(scene)
    for p, (i, j) in enumerate(ground_truth.pair_image_idx.tolist()):
        geometry = database.read_two_view_geometry(i + 1, j + 1)
        np.testing.assert_array_equal(geometry.inlier_matches, ground_truth.matches_of_pair(p))
        np.testing.assert_array_equal(database.read_matches(i + 1, j + 1), ground_truth.matches_of_pair(p))
        assert int(geometry.config) == ground_truth.config[p]
        assert geometry.H is None
        if not ground_truth.config[p]:
            assert geometry.F is geometry.E is geometry.cam2_from_cam1 is None
            continue
        np.testing.assert_array_equal(geometry.F, ground_truth.fundamental[p])
        np.testing.assert_array_equal(geometry.E, ground_truth.essential[p])
        np.testing.assert_array_equal(geometry.cam2_from_cam1.rotation.quat, ground_truth.cam2_from_cam1[p, :4])
        np.testing.assert_array_equal(geometry.cam2_from_cam1.translation, ground_truth.cam2_from_cam1[p, 4:])
    database.close()
    with Database(tmp_path / "d.db") as again:
        assert_equal(again.read_pairs(), ground_truth)
    assert len((tmp_path / "d.db").read_bytes()) == len(before)


def test_gps_and_binary_descriptors_reach_pycolmap(tmp_path: Path) -> None:
    scene = make_scene(0, 2, 50)
    with Database(tmp_path / "d.db") as database:
        database.set_images(
            scene.ground_truth.cameras, scene.ground_truth.image_names, [0, 0], [None, (48.1, 11.5, 520.0)]
        )
        database.write_features(0, features_of(scene, 0, orb=True))
        assert_equal(database.read_features(0), features_of(scene, 0, orb=True))
    theirs = pycolmap.Database.open(str(tmp_path / "d.db"))
    (prior,) = theirs.read_all_pose_priors()
    np.testing.assert_array_equal(prior.position, [48.1, 11.5, 520.0])
    assert prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.WGS84
    assert prior.corr_data_id.id == 2
    assert theirs.read_descriptors(1).data.shape[1] == 32
    theirs.close()


@pytest.mark.parametrize(("metric", "length"), [("l2", 256), ("l2", 0), ("hamming", 61), ("root_sift", 128)])
def test_descriptors_of_any_metric_come_back(tmp_path: Path, metric: str, length: int) -> None:
    """SuperPoint's 256 floats, none at all, AKAZE's 61 bytes: bit for bit here, and as bytes in COLMAP."""
    rng = np.random.default_rng(1)
    values = rng.normal(size=(7, length)) if metric == "l2" else rng.integers(0, 256, (7, length), np.uint8)
    features = Features.from_arrays(rng.uniform(0, 99, (7, 2)), values, metric=metric)
    path = tmp_path / "d.db"
    with Database(path) as database:
        database.set_images([simple_camera(CameraModel.PINHOLE, 99, 99, 90.0)], ["a.png", "b.png"], [0, 0])
        database.write_features(0, Features.from_arrays(np.zeros((3, 2)), np.ones((3, 8)), metric="l2"))
        database.write_features(0, features)
        assert_equal(database.read_features(0), features)
        # an image list in another order takes them along
        database.set_images([simple_camera(CameraModel.PINHOLE, 99, 99, 90.0)], ["b.png", "a.png"], [0, 0])
        assert_equal(database.read_features(1), features)
    with Database(path, read_only=True) as database:
        assert_equal(database.read_features(1), features)
    if length:
        theirs = pycolmap.Database.open(str(path))
        assert theirs.read_descriptors(2).data.tobytes() == features.descriptors.tobytes()
        theirs.close()


def test_floats_of_colmap_are_read(tmp_path: Path) -> None:
    path = tmp_path / "d.db"
    with Database(path) as database:
        database.set_images([simple_camera(CameraModel.PINHOLE, 99, 99, 90.0)], ["a.png"], [0])
    floats = np.random.default_rng(2).normal(size=(5, 128)).astype(np.float32)
    theirs = pycolmap.Database.open(str(path))
    kind = pycolmap.FeatureExtractorType.ALIKED_N32
    theirs.write_keypoints(1, np.zeros((5, 2), np.float32))
    theirs.write_descriptors(1, pycolmap.FeatureDescriptorsFloat(type=kind, data=floats).to_bytes())
    theirs.close()
    with Database(path, read_only=True) as database:
        found = database.read_features(0)
    assert found.metric == DescriptorMetric.L2
    np.testing.assert_array_equal(found.descriptors, floats)


def test_pycolmap_maps_from_ours(tmp_path: Path) -> None:
    scene = filled(tmp_path / "d.db", 6, num_points=400)
    (tmp_path / "images").mkdir()
    (tmp_path / "out").mkdir()
    models = pycolmap.incremental_mapping(str(tmp_path / "d.db"), str(tmp_path / "images"), str(tmp_path / "out"))
    assert models[0].num_reg_images() == 6
    long_tracks = np.count_nonzero(np.diff(scene.observed.tracks.track_ptr) > 2)  # those of two images it ignores
    assert models[0].num_points3D() > 0.8 * long_tracks
    assert 0.1 < models[0].compute_mean_reprojection_error() < 0.6  # the noise is 0.3 px per axis
    assert {image.name for image in models[0].images.values()} == set(scene.ground_truth.image_names)


def test_we_read_pycolmaps(tmp_path: Path) -> None:
    path = tmp_path / "d.db"
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 4
    options.num_points3D, options.two_view_geometry_has_relative_pose = 30, True
    theirs = pycolmap.Database.open(str(path))
    pycolmap.synthesize_dataset(options, theirs)
    expected = {i: (theirs.read_keypoints(i), theirs.read_descriptors(i).data) for i in range(1, 5)}
    with Database(path, read_only=True) as database:
        _, names, _ = database.read_images()
        assert len(names) == 4
        assert database.feature_keys() == {}
        assert database.pair_keys() == {}
        for i in range(4):
            features = database.read_features(i)
            keypoints, descriptors = expected[i + 1]
            np.testing.assert_array_equal(features.keypoints[:, :2], keypoints[:, :2])
            np.testing.assert_allclose(features.keypoints[:, 2:], [[1, 0]] * len(keypoints), atol=1e-6)
            np.testing.assert_array_equal(features.descriptors, descriptors)
            assert not features.rgb.any()
        pairs = database.read_pairs()
    assert pairs.num_pairs == 6
    for p, (i, j) in enumerate(pairs.pair_image_idx.tolist()):
        geometry = theirs.read_two_view_geometry(i + 1, j + 1)
        np.testing.assert_array_equal(pairs.matches_of_pair(p), geometry.inlier_matches)
        np.testing.assert_array_equal(pairs.fundamental[p], geometry.F)
        np.testing.assert_array_equal(pairs.cam2_from_cam1[p, :4], geometry.cam2_from_cam1.rotation.quat)
        assert pairs.num_putative[p] == 30
    theirs.close()


def test_affine_keypoints_follow_colmap(tmp_path: Path) -> None:
    filled(tmp_path / "d.db", 2)
    shape = np.array([[10, 20, 3 * np.cos(0.5), -3 * np.sin(0.5), 3 * np.sin(0.5), 3 * np.cos(0.5)]], np.float32)
    db = sqlite3.connect(tmp_path / "d.db")
    db.execute("UPDATE keypoints SET rows = 1, cols = 6, data = ? WHERE image_id = 1", (shape.tobytes(),))
    db.execute("UPDATE descriptors SET rows = 1, data = zeroblob(128) WHERE image_id = 1")
    db.execute("DELETE FROM sfmapp_features")
    db.commit()
    with Database(tmp_path / "d.db") as database:
        np.testing.assert_allclose(database.read_features(0).keypoints, [[10, 20, 3, 0.5]], rtol=1e-6)
    theirs = pycolmap.FeatureKeypoint(dict(zip(("x", "y", "a11", "a12", "a21", "a22"), shape[0].tolist(), strict=True)))
    assert theirs.compute_scale() == pytest.approx(3)
    assert theirs.compute_orientation() == pytest.approx(0.5)


def test_changed_image_list_keeps_what_it_can(tmp_path: Path) -> None:
    path = tmp_path / "d.db"
    scene = filled(path)
    ground_truth, pairs = scene.ground_truth, true_correspondences(scene)
    names = ground_truth.image_names
    with Database(path) as database:
        # one image is gone, two are new, one of them in front
        new = ["0_new.jpg", names[0], names[2], names[3], names[4], "z_new.jpg"]
        database.set_images(ground_truth.cameras, new, [0] * 6)
        assert database.feature_keys() == {1: "key0", 2: "key2", 3: "key3", 4: "key4"}
        assert_equal(database.read_features(2), features_of(scene, 2))
        back = database.read_pairs()
        assert back.pair_image_idx.tolist() == [[1, 2], [1, 3], [1, 4], [2, 3], [2, 4], [3, 4]]
        of_pair = {tuple(pair): p for p, pair in enumerate(pairs.pair_image_idx.tolist())}
        np.testing.assert_array_equal(back.matches_of_pair(4), pairs.matches_of_pair(of_pair[2, 4]))
        # turned round: features stay, pairs go
        database.set_images(ground_truth.cameras, new[::-1], [0] * 6)
        assert database.feature_keys() == {4: "key0", 3: "key2", 2: "key3", 1: "key4"}
        assert database.read_pairs().num_pairs == 0
        database.set_images(ground_truth.cameras, new[::-1], [0] * 6)
        assert len(database.feature_keys()) == 4
    theirs = pycolmap.Database.open(str(path))
    assert theirs.num_images() == theirs.num_frames() == 6
    theirs.close()


def test_rewriting_replaces(tmp_path: Path) -> None:
    path = tmp_path / "d.db"
    scene = filled(path)
    pairs = true_correspondences(scene)
    with Database(path) as database:
        other = features_of(scene, 1)
        database.write_features(0, other, "other")
        assert_equal(database.read_features(0), other)
        assert database.feature_keys()[0] == "other"
        database.write_pairs(pairs, "again")
        assert set(database.pair_keys().values()) == {"again"}
        database.clear_pairs()
        assert database.pair_keys() == {}
        assert database.read_pairs().num_pairs == 0


def test_killed_process_leaves_a_whole_database(tmp_path: Path) -> None:
    script = f"""
import sys, os, signal
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_formats_database import *
scene = make_scene(3, 4, 200, sigma_px=0.3)
database = Database({str(tmp_path / "d.db")!r})
database.set_images(scene.ground_truth.cameras, scene.ground_truth.image_names, scene.ground_truth.image_camera_idx)
database.write_features(0, features_of(scene, 0), "k")
database.write_features(1, features_of(scene, 1), "k")
database._db.execute("BEGIN IMMEDIATE")
database._db.execute("DELETE FROM keypoints")
os.kill(os.getpid(), signal.SIGKILL)
"""
    done = subprocess.run([sys.executable, "-c", script], check=False)
    assert done.returncode == -signal.SIGKILL
    scene = make_scene(3, 4, 200, sigma_px=0.3)
    with Database(tmp_path / "d.db") as database:
        assert database.feature_keys() == {0: "k", 1: "k"}
        assert_equal(database.read_features(1), features_of(scene, 1))
    assert [p.name for p in tmp_path.iterdir()] == ["d.db"]


def test_failed_transaction_changes_nothing(tmp_path: Path) -> None:
    scene = filled(tmp_path / "d.db")
    with Database(tmp_path / "d.db") as database:
        with pytest.raises(InputError, match="UNIQUE"):
            database.set_images(scene.ground_truth.cameras, ["a", "a"], [0, 0])
        assert database.read_images()[1] == scene.ground_truth.image_names
        assert len(database.feature_keys()) == 5


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("template") / "d.db"
    filled(path, 3, num_points=60)
    return path


def read_everything(path: Path) -> None:
    with Database(path, read_only=True) as database:
        _, names, _ = database.read_images()
        database.feature_keys()
        database.pair_keys()
        database.read_pairs()
        for image in range(len(names)):
            database.read_features(image)


REFUSALS = [
    ("UPDATE keypoints SET rows = 1000000000000 WHERE image_id = 1", "expected .* bytes"),
    ("UPDATE keypoints SET cols = 5 WHERE image_id = 1", r"expected \(2, 4, 6\) columns"),
    ("UPDATE keypoints SET data = 'text' WHERE image_id = 1", "found str"),
    ("UPDATE keypoints SET rows = 'many' WHERE image_id = 1", "whole numbers of rows"),
    ("UPDATE keypoints SET rows = 1, data = zeroblob(16) WHERE image_id = 1", "keypoints|matches"),
    ("UPDATE descriptors SET rows = 1, data = zeroblob(128) WHERE image_id = 2", "a descriptor for each"),
    ("DELETE FROM descriptors WHERE image_id = 2", "found none"),
    ("INSERT INTO sfmapp_descriptors VALUES (2, 'cosine')", "known metric, found 'cosine'"),
    (
        "INSERT INTO sfmapp_descriptors VALUES (2, 'l2'); UPDATE descriptors SET cols = 130 WHERE image_id = 2",
        r"expected \(4,\) columns",
    ),
    ("UPDATE sfmapp_features SET rgb = x'00' WHERE image_id = 2", "colours of image 2"),
    ("UPDATE sfmapp_signs SET is_dark = x'00' WHERE image_id = 2", "signs of image 2"),
    ("UPDATE two_view_geometries SET rows = rows + 1", "matches of pair"),
    ("UPDATE two_view_geometries SET rows = -5", "matches of pair"),
    ("UPDATE two_view_geometries SET config = 77", "configuration"),
    ("UPDATE two_view_geometries SET F = zeroblob(8)", "F of pair"),
    ("UPDATE two_view_geometries SET qvec = 3", "qvec of pair"),
    ("UPDATE two_view_geometries SET pair_id = 5 + pair_id", "known images"),
    ("UPDATE sfmapp_pairs SET num_putative = 'x'", "counts"),
    ("UPDATE cameras SET params = zeroblob(7)", "blob of float64"),
    ("UPDATE cameras SET params = zeroblob(16)", "parameters, found 2"),
    ("UPDATE cameras SET model = 6", "FULL_OPENCV has 12 parameters"),
    ("UPDATE cameras SET width = 0", "image size"),
    ("UPDATE images SET camera_id = 9", "names camera 9"),
    ("DROP TABLE images", "no table of images"),
]


@pytest.mark.parametrize(("statement", "match"), REFUSALS)
def test_malformed_rows_are_refused(tmp_path: Path, template: Path, statement: str, match: str) -> None:
    path = tmp_path / "d.db"
    shutil.copy(template, path)
    db = sqlite3.connect(path)
    db.executescript(statement)
    db.commit()
    db.close()
    with pytest.raises(InputError, match=match):
        read_everything(path)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        Database(tmp_path / "absent.db", read_only=True)
    (tmp_path / "text.db").write_text("not a database, but long enough to be looked at" * 50)
    for read_only in (False, True):
        with pytest.raises(InputError, match="not a database"):
            Database(tmp_path / "text.db", read_only=read_only)
    with pytest.raises(InputError, match="unable to open"):
        Database(tmp_path / "no" / "folder.db")
    db = sqlite3.connect(tmp_path / "old.db")
    db.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT, camera_id INTEGER)")
    db.commit()
    with pytest.raises(InputError, match=r"COLMAP 4\.2 or newer"):
        Database(tmp_path / "old.db")


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_refused_or_read(tmp_path: Path, template: Path, data: st.DataObject) -> None:
    damaged = bytearray(template.read_bytes())
    pages = len(damaged) // 4096
    for _ in range(data.draw(st.integers(1, 4))):
        # heads of pages and rows, rather than the middle of a blob
        at = data.draw(st.integers(0, pages - 1)) * 4096 + data.draw(st.integers(0, 4095))
        damaged[at] ^= 1 << data.draw(st.integers(0, 7))
    path = tmp_path / "d.db"
    path.write_bytes(damaged)
    try:
        read_everything(path)
    except InputError as error:
        if os.fspath(path) not in str(error):
            raise
