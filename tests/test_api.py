"""The library face: what is exported, how it is described, and what the stages and the parts do in memory."""

from __future__ import annotations

import dataclasses
import inspect
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import sfmapp
from sfmapp.camera.camera import PARAM_NAMES, project
from sfmapp.geometry import rigid3
from sfmapp.scene.synthetic import SyntheticScene, make_scene, perturb, synthetic_camera, true_correspondences

FUNCTIONS = [name for name in sfmapp.__all__ if inspect.isfunction(getattr(sfmapp, name))]
CLASSES = [name for name in sfmapp.__all__ if inspect.isclass(getattr(sfmapp, name))]


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return make_scene(0, 6, 300, sigma_px=0.3)


# --------------------------------------------------------------------------------------------------- what is exported


def test_import_is_instant_and_dir_shows_what_is_promised() -> None:
    code = "import sys, sfmapp; print(set(dir(sfmapp)) == {*sfmapp.__all__, '__version__'}, 'numpy' in sys.modules)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.split() == ["True", "False"]
    assert sorted(FUNCTIONS + CLASSES) == sorted(sfmapp.__all__)


def test_names_have_one_home_and_unknown_ones_are_refused() -> None:
    assert sorted(sfmapp._HOMES) == sorted(sfmapp.__all__)
    with pytest.raises(AttributeError, match="reconstrukt"):
        sfmapp.reconstrukt  # noqa: B018


@pytest.mark.parametrize("name", FUNCTIONS)
def test_help_of_a_function_is_complete(name: str) -> None:
    function = getattr(sfmapp, name)
    doc, signature = inspect.getdoc(function) or "", inspect.signature(function)
    for section in ("Args:", "Returns:", "Raises:"):
        assert section in doc, f"{name} lacks {section}"
    told = doc.partition("Args:")[2].partition("Returns:")[0]
    for parameter in signature.parameters.values():
        assert f"{parameter.name}:" in told or f"{parameter.name}, " in told, (
            f"{name} does not tell of {parameter.name}"
        )
        if parameter.name in ("events", "threads", "seed"):
            assert parameter.kind is inspect.Parameter.KEYWORD_ONLY, (name, parameter.name)
            assert parameter.default is None or parameter.name == "seed", (name, parameter.name)
            assert parameter.default is not inspect.Parameter.empty, (name, parameter.name)
        if "ArrayLike" in str(parameter.annotation):
            entry = told.partition(f"{parameter.name}")[2].partition("\n    ")[0]
            assert "(" in entry, f"{name} does not tell the shape of {parameter.name}"
    assert signature.return_annotation is not inspect.Signature.empty


@pytest.mark.parametrize("name", CLASSES)
def test_help_of_a_class_is_complete(name: str) -> None:
    kind = getattr(sfmapp, name)
    doc = inspect.getdoc(kind) or ""
    assert len(doc) > 20, name
    if dataclasses.is_dataclass(kind) and not name.endswith("Options"):
        for field in dataclasses.fields(kind):
            assert field.name in doc, f"{name} does not tell of {field.name}"
    for member, value in vars(kind).items():
        if not member.startswith("_") and (inspect.isfunction(value) or isinstance(value, property)):
            assert inspect.getdoc(value), f"{name}.{member}"


# ------------------------------------------------------------------------------------------------- stages, in memory


def test_stages_in_memory_need_no_file(photos: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from sfmapp.images.pixels import read_rgb

    arrays = {record.name: read_rgb(record) for record in sfmapp.load_images(photos).images}
    monkeypatch.chdir(tmp_path)
    images = sfmapp.load_images(arrays)
    features = sfmapp.extract_features(images, sfmapp.FeatureOptions(max_num_features=1500))
    correspondences = sfmapp.match_images(images, features, seed=1)
    (model,) = sfmapp.map_images(images, features, correspondences)
    assert model.is_registered.all()
    assert len(model.points) > 300
    assert list(tmp_path.iterdir()) == []
    # the same by a matcher of ours that hands on what was found, and by matches in a table
    by_pair = {
        (images.names[i], images.names[j]): correspondences.matches_of_pair(p)
        for p, (i, j) in enumerate(correspondences.pair_image_idx.tolist())
    }
    again = sfmapp.match_images(images, features, matches=by_pair)
    assert again.pair_image_idx.tolist() == correspondences.pair_image_idx.tolist()
    assert again.num_inliers.sum() > 0.95 * correspondences.num_inliers.sum()
    turned = sfmapp.match_images(images, features, matches={(b, a): m[:, ::-1] for (a, b), m in by_pair.items()})
    assert turned.matches.tolist() == again.matches.tolist()


def test_own_features_and_matcher(scene: SyntheticScene) -> None:
    """Keypoints without descriptors, matched by what point they show: the model is the scene."""
    truth = scene.ground_truth
    names = truth.image_names
    blank = {name: np.zeros((truth.cameras[0].height, truth.cameras[0].width), np.uint8) for name in names}
    images = sfmapp.load_images(blank, camera=truth.cameras[0])
    features, shown = [], []
    for i in range(len(names)):
        obs = truth.tracks.observations_of_image(i)
        features.append(sfmapp.Features.from_arrays(scene.observed.tracks.obs_xy[obs]))
        shown.append(truth.tracks.obs_track_idx[obs])
    calls = []

    class ByPoint:
        def match(self, first: sfmapp.Features, second: sfmapp.Features) -> np.ndarray:
            i, j = (next(k for k, f in enumerate(features) if f is one) for one in (first, second))
            calls.append((i, j))
            return np.stack(np.intersect1d(shown[i], shown[j], return_indices=True)[1:], 1)

    correspondences = sfmapp.match_images(images, features, matcher=ByPoint())
    assert len(calls) == 15
    (model,) = sfmapp.map_images(images, features, correspondences)
    assert model.is_registered.all()
    errors = np.linalg.norm(model.residuals_px()[model.obs_is_inlier], axis=1)
    assert np.sqrt((errors**2).mean() / 2) < 0.35


def test_pairs_by_name_or_position_and_what_is_no_pair(scene: SyntheticScene) -> None:
    images = sfmapp.load_images({name: np.zeros((20, 20), np.uint8) for name in "abc"})
    features = [sfmapp.Features.from_arrays(np.zeros((5, 2)), np.eye(5, 8)) for _ in range(3)]
    found = sfmapp.match_images(images, features, [("c", "a"), ("b", "c")])
    assert found.pair_image_idx.tolist() == [[0, 2], [1, 2]]
    for wrong in ([(0, 3)], [("a", "z")], [(1, 1)], [(0, 1), (1, 0)]):
        with pytest.raises(sfmapp.InputError, match="expected two of 3 images"):
            sfmapp.match_images(images, features, wrong)
    with pytest.raises(sfmapp.InputError, match="expected one of each of 3 images, found 2"):
        sfmapp.match_images(images, features[:2])
    for matches in ([[0, 5]], [[-1, 0]], [[0.0, 1.0]], [0, 1]):
        with pytest.raises(sfmapp.InputError, match="matches of images 0 and 1: expected"):
            sfmapp.match_images(images, features, matches={(0, 1): matches})


# ------------------------------------------------------------------------------------------------------------ parts


def test_triangulated_points_are_where_they_are(scene: SyntheticScene) -> None:
    truth = scene.ground_truth
    xy = np.full((6, truth.tracks.num_tracks, 2), np.nan)
    xy[truth.tracks.obs_image_idx, truth.tracks.obs_track_idx] = truth.tracks.obs_xy
    xy[0, :10] += 100.0  # wrong in one of the views
    found = sfmapp.triangulate([sfmapp.Rigid3(pose) for pose in truth.cam_from_world], truth.cameras[0], xy)
    many = np.isfinite(xy[..., 0]).sum(0) >= 4
    np.testing.assert_allclose(found.xyz[many], truth.point_xyz[many], atol=1e-6)
    seen_wrong = np.flatnonzero(many[:10] & np.isfinite(xy[0, :10, 0]))
    assert not found.is_inlier[0, seen_wrong].any()
    with pytest.raises(sfmapp.InputError, match="triangulate"):
        sfmapp.triangulate(truth.cam_from_world, truth.cameras[0], xy[:5])


@pytest.mark.parametrize("model", list(sfmapp.CameraModel))
def test_the_pose_of_one_camera_from_points(model: sfmapp.CameraModel) -> None:
    if "f" not in PARAM_NAMES[model] and "fx" not in PARAM_NAMES[model]:
        pytest.skip("an equirectangular picture has no focal length")
    scene = make_scene(1, 3, 300, synthetic_camera(model), sigma_px=0.5)
    seen = scene.ground_truth.tracks.observations_of_image(1)
    xyz = scene.ground_truth.point_xyz[scene.ground_truth.tracks.obs_track_idx[seen]]
    xy = scene.observed.tracks.obs_xy[seen].copy()
    rng = np.random.default_rng(0)
    wrong = rng.permutation(len(xy))[: len(xy) // 4]
    xy[wrong] += rng.uniform(50, 300, (len(wrong), 2))
    found = sfmapp.estimate_pose(xyz, xy, scene.ground_truth.cameras[0])
    assert not found.is_inlier[wrong].any()
    assert found.is_inlier.sum() == len(xy) - len(wrong)
    error = rigid3.compose(found.cam_from_world, rigid3.inverse(scene.ground_truth.cam_from_world[1]))
    deviation = np.concatenate([rigid3.log_so3(rigid3.rotation_matrix(error)), error[4:]])
    # six degrees of freedom: a squared Mahalanobis distance of 22.5 is exceeded once in a thousand
    assert deviation @ np.linalg.solve(found.covariance, deviation) < 22.5
    with pytest.raises(sfmapp.NoReconstructionError, match="four of"):
        sfmapp.estimate_pose(xyz, rng.uniform(0, 500, xy.shape), scene.ground_truth.cameras[0], max_error_px=0.01)


def test_two_views_verified_by_hand(scene: SyntheticScene) -> None:
    pairs = true_correspondences(scene)
    i, j = pairs.pair_image_idx[0]
    truth, camera = scene.ground_truth, dataclasses.replace(scene.ground_truth.cameras[0], focal_source="user")
    common = np.intersect1d(
        truth.tracks.obs_track_idx[truth.tracks.observations_of_image(i)],
        truth.tracks.obs_track_idx[truth.tracks.observations_of_image(j)],
    )
    xy1, xy2 = (project(camera, rigid3.apply(truth.cam_from_world[k], truth.point_xyz[common])) for k in (i, j))
    found = sfmapp.verify_pair(xy1, xy2, camera, seed=3)
    assert found.config.name == "CALIBRATED"
    assert found.is_inlier.all()
    relative = rigid3.compose(truth.cam_from_world[j], rigid3.inverse(truth.cam_from_world[i]))
    turned = rigid3.compose(found.cam2_from_cam1, rigid3.inverse(relative))
    assert rigid3.rotation_angle_deg(rigid3.rotation_matrix(turned)) < 1e-3
    with pytest.raises(sfmapp.InputError, match="finite pixels"):
        sfmapp.verify_pair(xy1, xy2[:-1], camera)


# --------------------------------------------------------------------------------------------------- reconstruction


def test_views_show_the_arrays(scene: SyntheticScene) -> None:
    model = sfmapp.Reconstruction.of(scene.observed.copy())
    view = model.image(model.image_names[2])
    assert view.idx == 2
    assert view == model.images[2]
    assert np.asarray(view.cam_from_world).tobytes() == model.cam_from_world[2].tobytes()
    assert model.camera(view.name) is model.camera(0) is view.camera
    seen = view.observations
    assert (seen.image_idx == 2).all()
    assert set(view.track_ids) <= set(seen.track_ids)
    track = int(model.points.ids[5])
    of_track = model.observations_of_track(track)
    assert (of_track.track_ids == track).all()
    assert len(of_track) == model.points.num_images[5]
    assert len(set(of_track.image_names)) == len(of_track)
    errors = np.linalg.norm(of_track.residuals_px, axis=1)
    assert model.points.error_px[5] == pytest.approx(errors.mean())
    assert model.points.xyz[5].tolist() == model.point_xyz[track].tolist()
    model.cam_from_world[2] = np.nan
    assert view.cam_from_world is None
    for call in (
        lambda: model.image("nothing.jpg"), lambda: model.image(99), lambda: model.camera(1),
        lambda: model.observations_of_track(10**6),
    ):  # fmt: skip
        with pytest.raises(sfmapp.InputError, match="expected"):
            call()


@pytest.mark.parametrize("text", [False, True])
def test_load_refine_and_save_round_trip(scene: SyntheticScene, tmp_path: Path, text: bool) -> None:
    sfmapp.Reconstruction.of(scene.ground_truth).save(tmp_path / "sparse/0", text=text)
    model = sfmapp.load(tmp_path)
    assert model.cam_from_world.tolist() == sfmapp.load(tmp_path / "sparse/0").cam_from_world.tolist()
    np.testing.assert_allclose(model.residuals_px(), 0.0, atol=1e-9)
    moved = sfmapp.Reconstruction.of(perturb(model, rotation_deg=0.2, translation_fraction=0.002, seed=2))
    held = moved.cam_from_world[1].copy()
    report = sfmapp.adjust_bundle(moved, constant_images=[moved.image_names[1]], constant_cameras=[0])
    assert report.final_cost < 1e-9 * report.initial_cost
    assert moved.cam_from_world[1].tobytes() == held.tobytes()
    assert moved.cameras[0].params.tolist() == model.cameras[0].params.tolist()
    moved.save(tmp_path / "again")
    assert sfmapp.load(tmp_path / "again").point_xyz.tobytes() == moved.points.xyz.tobytes()
    for wrong in (tmp_path / "none", tmp_path / "again" / "images.bin"):
        with pytest.raises(sfmapp.InputError, match="expected a workspace of sfmapp or a COLMAP model"):
            sfmapp.load(wrong)
    with pytest.raises(sfmapp.InputError, match="sparse/7"):
        sfmapp.load(tmp_path, model=7)
    for wrong_camera in ([1], [-1], [0.5]):
        with pytest.raises(sfmapp.InputError, match="camera: expected positions"):
            sfmapp.adjust_bundle(moved, constant_cameras=wrong_camera)  # type: ignore[arg-type]


def test_covariance_of_points_and_poses(scene: SyntheticScene) -> None:
    model = sfmapp.Reconstruction.of(scene.observed.copy())
    sfmapp.adjust_bundle(model)
    covariances = model.covariance()
    assert covariances.sigma_px == pytest.approx(0.3, rel=0.1)
    assert covariances.num_gauge == 7
    point = covariances.of_point(int(model.points.ids[0]))
    assert point.shape == (3, 3)
    assert (np.linalg.eigvalsh(point) > 0).all()
    assert covariances.of_image(0).shape == (6, 6)
    assert len(covariances.of_camera(0))
    held = model.covariance(constant_images=[model.image_names[0]], sigma_px=0.3)
    assert held.num_gauge == 1
    with pytest.raises(sfmapp.InputError, match="image 0 has no covariance"):
        held.of_image(0)


def test_copies_stay_what_they_are(scene: SyntheticScene) -> None:
    model = sfmapp.Reconstruction.of(scene.observed, [np.zeros((3, 2))] * 6)
    copy = model.copy()
    assert isinstance(copy, sfmapp.Reconstruction)
    assert copy.keypoints is model.keypoints
    copy.cam_from_world[0] = 0.0
    assert (model.cam_from_world[0] != 0.0).any()
    assert sfmapp.Reconstruction.of(model) is model


def test_one_call_gives_the_same_with_and_without_a_folder(photos: Path, tmp_path: Path) -> None:
    options = sfmapp.load_options(settings=["features.max_num_features=800"])
    in_memory, report = sfmapp.reconstruct(photos, options=options, seed=2, threads=1)
    assert report is None
    written, _ = sfmapp.reconstruct(photos, tmp_path / "out", options, record=False, seed=2, threads=2)
    assert in_memory.cam_from_world.tobytes() == written.cam_from_world.tobytes()
    assert in_memory.points.xyz.tobytes() == written.point_xyz.tobytes()
    in_memory.save(tmp_path / "saved")
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        saved, ours = tmp_path / "saved" / name, tmp_path / "out" / "sparse" / "0" / name
        assert saved.read_bytes() == ours.read_bytes(), name
    with pytest.raises(sfmapp.InputError, match="found list"):
        sfmapp.reconstruct([np.zeros((20, 20), np.uint8)], tmp_path / "none")  # type: ignore[arg-type]


def test_arrays_have_a_workspace_like_any_other(photos: Path, tmp_path: Path) -> None:
    """Without a file of the photographs; what needs their pixels again says so, and takes them from files."""
    from schemas import check_schema
    from sfmapp.images.pixels import read_rgb
    from sfmapp.pipelines.dense.source import find_source
    from sfmapp.workspace.options import Options

    options = sfmapp.load_options(settings=["features.max_num_features=800"])
    arrays = {record.name: read_rgb(record) for record in sfmapp.load_images(photos).images}
    sfmapp.reconstruct(photos, tmp_path / "files", options, record=False, threads=1)
    out = tmp_path / "out"
    model, report = sfmapp.reconstruct(arrays, out, options, record=False, threads=2)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (out / "sparse/0" / name).read_bytes() == (tmp_path / "files/sparse/0" / name).read_bytes(), name
    assert report is not None
    check_schema("reconstruct", json.loads((out / "report.json").read_text()))
    assert report.run.source == report.stages.images.source == "memory://photographs"
    assert [row.name for row in report.images] == list(arrays)
    assert not [path for path in out.rglob("*") if path.suffix in (".png", ".jpg")]
    # the same arrays are done already, in a set as well; other pixels are not
    again = sfmapp.reconstruct(sfmapp.load_images(arrays), out, options, record=False)
    assert again.report is not None
    assert again.report.run.is_up_to_date
    assert again.reconstruction.point_xyz.tobytes() == model.point_xyz.tobytes()
    first = next(iter(arrays))
    changed = sfmapp.reconstruct({**arrays, first: arrays[first][::-1]}, out, options, record=False)
    assert changed.report is not None
    assert not changed.report.run.is_up_to_date
    assert changed.report.stages.features.num_known == len(arrays) - 1
    with pytest.raises(sfmapp.InputError, match="arrays in memory") as caught:
        sfmapp.undistort(out, tmp_path / "flat")
    assert "--images" in str(caught.value.advice)
    with pytest.raises(sfmapp.InputError, match="pycolmap reads files"):
        sfmapp.validate(out)
    assert find_source(out, None, photos, Options()).images == photos
    exported = sfmapp.export(out, "nerfstudio", tmp_path / "nerf")
    assert any("put them there" in note for note in exported.notes)


def test_a_reconstruction_of_ones_own_arrays(scene: SyntheticScene, tmp_path: Path) -> None:
    """Whatever another program has found becomes a model that COLMAP reads."""
    import pycolmap

    truth = scene.ground_truth
    order = np.random.default_rng(0).permutation(truth.tracks.num_observations)
    tracks = sfmapp.Tracks.from_observations(
        truth.tracks.obs_track_idx[order], truth.tracks.obs_image_idx[order], truth.tracks.obs_xy[order]
    )
    model = sfmapp.Reconstruction(
        truth.cameras, truth.image_names, truth.image_camera_idx, truth.cam_from_world, tracks,
        truth.point_xyz, np.ones(tracks.num_observations, bool),
    )  # fmt: skip
    np.testing.assert_allclose(model.residuals_px(), 0.0, atol=1e-9)
    model.save(tmp_path)
    theirs = pycolmap.Reconstruction(str(tmp_path))
    assert theirs.num_reg_images() == 6
    assert theirs.num_points3D() == len(model.points)
    assert theirs.compute_num_observations() == tracks.num_observations
    for wrong in (
        ([0, 0], [0], np.zeros((2, 2))), ([0, 0], [1, 1], np.zeros((2, 2))), ([-1, 0], [0, 1], np.zeros((2, 2))),
        ([0, 0], [0, 1], np.full((2, 2), np.nan)), ([0.5, 0.5], [0, 1], np.zeros((2, 2))),
    ):  # fmt: skip
        with pytest.raises(sfmapp.InputError, match="tracks: expected"):
            sfmapp.Tracks.from_observations(*wrong)
    assert sfmapp.Tracks.from_observations([], [], np.zeros((0, 2)), num_images=3).num_images == 3
