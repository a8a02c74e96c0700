"""Photographs with an EXIF orientation: models fit the pixels of the files, what is shown stands upright.

Oracles: Pillow for what EXIF's orientations mean, pycolmap for what other programs read of the files.
"""

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
from PIL import Image, ImageOps
from tests.test_report_dense import make_scene, wall

from sfmapp.camera.camera import PARAM_NAMES, Camera, CameraModel, project
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.errors import InputError, UsageError
from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.events import Event, Events
from sfmapp.formats.colmap import read_model
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.geometry import rigid3
from sfmapp.geometry.orientation import (
    INVERSE,
    MIRRORED,
    ROTATION_OF,
    is_sideways,
    upright_pinhole,
    upright_pixels,
    upright_poses,
    upright_size,
    upright_vectors,
    upright_xy,
)
from sfmapp.geometry.upright import up_direction
from sfmapp.images.folder import ImageOptions, load_images
from sfmapp.pipelines import validate as validation
from sfmapp.pipelines.dense.source import find_source
from sfmapp.pipelines.export import export_model
from sfmapp.pipelines.sparse.reconstruct import reconstruct
from sfmapp.report.dense_pictures import dense_pictures
from sfmapp.report.top_view import ground_axes
from sfmapp.scene.turned_camera import turned_back, turned_camera
from sfmapp.sequences.open import SequenceOptions, open_sequence
from sfmapp.viewer.dense_replay import make_dense_replay
from sfmapp.viewer.replay import make_replay
from sfmapp.workspace.options import Options

Array = NDArray[np.float64]

ALL = range(1, 9)
W, H = 48, 32


def exif_of(orientation: int) -> Image.Exif:
    exif = Image.Exif()
    exif[274] = orientation
    return exif


def turned_by_pillow(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    image = Image.fromarray(pixels)
    image.getexif()[274] = orientation
    return np.asarray(ImageOps.exif_transpose(image))


def as_stored(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """What a camera that is held so writes, so that Pillow turns it back."""
    stored = upright_pixels(pixels, INVERSE[orientation])
    np.testing.assert_array_equal(turned_by_pillow(stored, orientation), pixels)
    return np.asarray(stored)


def write_photos(photos: Path, folder: Path, orientation: dict[str, int] | int, *, keep: bool = False) -> None:
    """The photographs with an EXIF orientation, turned so that they are upright by it; keep: only labelled with it."""
    folder.mkdir()
    for path in photos.iterdir():
        value = orientation if isinstance(orientation, int) else orientation[path.name]
        pixels = np.asarray(Image.open(path).convert("RGB"))
        stored = pixels if keep else as_stored(pixels, value)
        Image.fromarray(stored).save(folder / path.name, exif=exif_of(value), compress_level=1)


# ----------------------------------------------------------------------------------------------------------- geometry


@pytest.mark.parametrize("orientation", ALL)
def test_pixels_places_and_cameras_turn_as_pillow_turns_pictures(orientation: int) -> None:
    stored = np.random.default_rng(0).integers(0, 255, (H, W, 3), np.uint8)
    upright = turned_by_pillow(stored, orientation)
    np.testing.assert_array_equal(upright_pixels(stored, orientation), upright)
    assert upright_size(orientation, W, H) == upright.shape[1::-1]
    y, x = np.mgrid[:H, :W]
    place = upright_xy(orientation, np.stack([x, y], -1) + 0.5, W, H)
    column, row = np.moveaxis(np.floor(place).astype(int), -1, 0)
    np.testing.assert_array_equal(upright[row, column], stored)
    start, end = upright_xy(orientation, [[3, 4], [4, 6]], W, H)
    np.testing.assert_allclose(upright_vectors(orientation, [1, 2]), end - start)
    np.testing.assert_array_equal(upright_pixels(upright, INVERSE[orientation]), stored)


def bent_camera(model: CameraModel) -> Camera:
    """A camera of that model, none of whose terms is zero."""
    values = {
        "f": 40.0,
        "fx": 40.0,
        "fy": 43.0,
        "cx": 25.0,
        "cy": 14.0,
        "k1": 0.1,
        "k2": -0.05,
        "p1": 0.02,
        "p2": -0.03,
    }
    values |= {"k3": 0.01, "k4": -0.004, "k0": -0.02, "k5": 0.002, "k6": 0.001, "k": -0.1, "omega": 0.8, "w": W, "h": H}
    values |= {"alpha": 0.6, "beta": 1.1, "p0": 0.01, "s0": 0.02, "s1": -0.01, "s2": 0.03, "s3": 0.015, "s4": -0.02}
    values |= {"sx1": 0.02, "sy1": -0.01, "s": 2.0}
    return Camera(model, W, H, np.array([values[name] for name in PARAM_NAMES[model]]))


@pytest.mark.parametrize("model", list(CameraModel))
@pytest.mark.parametrize("orientation", ALL)
def test_a_turned_camera_sees_the_turned_picture(orientation: int, model: CameraModel) -> None:
    camera = bent_camera(model)
    if is_sideways(orientation) and model in (CameraModel.EQUIRECTANGULAR, CameraModel.PINHOLE_SKEW):
        with pytest.raises(UsageError, match="on their side"):
            turned_camera(camera, orientation)
        return
    rays = np.random.default_rng(1).uniform([-0.6, -0.4, 1.0], [0.6, 0.4, 1.0], (50, 3))
    turned_rays = np.column_stack([upright_vectors(orientation, rays[:, :2]), rays[:, 2]])
    expected = upright_xy(orientation, project(camera, rays), W, H)
    np.testing.assert_allclose(project(turned_camera(camera, orientation), turned_rays), expected, atol=1e-9)


@pytest.mark.parametrize("model", [CameraModel.OPENCV, CameraModel.THIN_PRISM_FISHEYE, CameraModel.SIMPLE_RADIAL])
@pytest.mark.parametrize("orientation", ALL)
def test_the_prior_of_a_turned_camera_says_the_same_of_pixels(orientation: int, model: CameraModel) -> None:
    camera = bent_camera(model)
    rays = np.random.default_rng(1).uniform([-0.6, -0.4, 1.0], [0.6, 0.4, 1.0], (7, 3))
    turned_rays = np.column_stack([upright_vectors(orientation, rays[:, :2]), rays[:, 2]])
    root = np.random.default_rng(2).normal(size=(len(camera.params),) * 2) * 1e-3
    turned = turned_camera(replace(camera, prior_covariance=root @ root.T), orientation)
    assert turned.prior_covariance is not None

    def deviations(of: Camera, at: Array, covariance: Array) -> Array:
        """(14, 14) covariance of pixels by that of the parameters, through central differences."""
        steps = 1e-5 * np.eye(len(of.params))
        slope = [project(of.with_params(of.params + h), at) - project(of.with_params(of.params - h), at) for h in steps]
        jacobian = np.stack(slope, -1).reshape(14, -1) / 2e-5
        return np.asarray(jacobian @ covariance @ jacobian.T)

    expected = deviations(camera, rays, root @ root.T)
    turn = np.kron(np.eye(7), np.stack([upright_vectors(orientation, axis) for axis in np.eye(2)], 1))
    found = deviations(turned, turned_rays, turned.prior_covariance)
    np.testing.assert_allclose(found, turn @ expected @ turn.T, atol=1e-6 * float(np.abs(expected).max()))


@pytest.mark.parametrize("orientation", ALL)
def test_a_rolled_camera_sees_the_upright_picture_but_for_its_mirror(orientation: int) -> None:
    rng = np.random.default_rng(2)
    pose = rigid3.from_matrix(rigid3.exp_so3(rng.normal(size=3)), [0.1, 0.2, 6.0])
    xyz = rng.uniform(-1, 1, (20, 3))
    k = np.array([40.0, 43.0, 25.0, 14.0])

    def see(k: NDArray[Any], pose: NDArray[Any]) -> NDArray[Any]:
        seen = rigid3.apply(pose, xyz)
        return seen[:, :2] / seen[:, 2:] * k[:2] + k[2:]

    rolled = upright_poses(np.stack([pose, np.full(7, np.nan)]), [orientation, orientation])
    assert np.isnan(rolled[1]).all()
    np.testing.assert_allclose(rigid3.center(rolled[0]), rigid3.center(pose), atol=1e-12)
    shown = see(upright_pinhole(orientation, k, W, H), rolled[0])
    if orientation in MIRRORED:
        shown[:, 0] = upright_size(orientation, W, H)[0] - shown[:, 0]
    np.testing.assert_allclose(shown, upright_xy(orientation, see(k, pose), W, H), atol=1e-9)


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_up_is_where_the_upright_pictures_have_it(orientation: int) -> None:
    """Cameras held every which way: the guess from their poses alone is wrong, and right with EXIF."""
    level = np.array([[0.0, np.sin(a / 2), 0.0, np.cos(a / 2), 0.0, 0.0, 0.0] for a in np.linspace(0, 2, 6)])
    mixed = np.array([1, orientation, orientation, orientation, orientation, orientation])
    stored = upright_poses(level, [INVERSE[ROTATION_OF[o]] for o in mixed])
    np.testing.assert_allclose(up_direction(upright_poses(stored, mixed)), [0.0, -1.0, 0.0], atol=1e-9)
    assert up_direction(stored) @ [0.0, -1.0, 0.0] < 0.9
    axes = ground_axes(rigid3.rotation_matrix(upright_poses(stored, mixed)))
    np.testing.assert_allclose(axes[:, 1], 0.0, atol=1e-9)


# ----------------------------------------------------------------------------------------------- models and exports


def check_with_pycolmap(model_folder: Path, photos: Path, work: Path) -> None:
    """Sizes, reprojections and colours in the pixels that pycolmap reads, and what its undistorter makes of them."""
    import pycolmap

    model = pycolmap.Reconstruction(model_folder)
    images = [image for image in model.images.values() if image.has_pose]
    assert len(images) == 7
    for image in images:
        pixels = pycolmap.Bitmap.read(photos / image.name, True).to_array().astype(int)
        camera = model.cameras[image.camera_id]
        assert (camera.width, camera.height) == pixels.shape[1::-1]
        seen = [point for point in image.points2D if point.has_point3D()]
        points = [model.points3D[point.point3D_id] for point in seen]
        xy = np.array([image.project_point(point.xyz) for point in points])
        assert np.median(np.linalg.norm(xy - [point.xy for point in seen], axis=1)) < 0.5
        column, row = np.floor(xy).astype(int).T.clip(0, [[camera.width - 1], [camera.height - 1]])
        colors = np.array([point.color for point in points]).astype(int)
        assert np.median(np.abs(pixels[row, column] - colors)) <= 8
    pycolmap.undistort_images(work, model_folder, photos)
    name = images[0].name
    # pycolmap copies EXIF into what it undistorts
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    stored, undistorted = (cv2.imread(str(path / name), flags) for path in (photos, work / "images"))
    small = [cv2.resize(picture, (40, 40), interpolation=cv2.INTER_AREA).ravel() for picture in (stored, undistorted)]
    assert np.corrcoef(small)[0, 1] > 0.95


def check_database(path: Path, size: tuple[int, int]) -> None:
    import pycolmap

    database = pycolmap.Database.open(path)
    assert {(camera.width, camera.height) for camera in database.read_all_cameras()} == {size}
    for image in database.read_all_images():
        xy = np.array(database.read_keypoints(image.image_id))[:, :2]
        assert (xy > 0).all()
        assert (xy < size).all()
        assert (xy.max(0) > 0.9 * np.array(size)).all()
    database.close()


@pytest.mark.parametrize("orientation", ALL)
def test_models_and_exports_fit_the_files_as_pycolmap_reads_them(
    photos: Path, sample: Path, tmp_path: Path, orientation: int
) -> None:
    write_photos(photos, tmp_path / "photos", orientation)
    warned: list[Event] = []
    result = reconstruct(
        tmp_path / "photos", tmp_path / "out",
        events=Events(lambda event: warned.append(event) if event.kind == "warned" else None), record=False,
    )  # fmt: skip
    assert sum("mirror images" in event.message for event in warned) == (orientation in MIRRORED)
    check_with_pycolmap(tmp_path / "out/sparse/0", tmp_path / "photos", tmp_path / "undistorted")
    check_database(tmp_path / "out/database.db", upright_size(orientation, 400, 300))
    model = result.reconstruction
    for target in ("colmap-text", "nerfstudio", "bundler"):
        report = export_model(tmp_path / "out", target, tmp_path / target)
        assert report["max_px"] < 1e-3
    size = upright_size(orientation, 400, 300)
    document = json.loads((tmp_path / "nerfstudio/transforms.json").read_text())
    assert (document["w"], document["h"]) == size
    # the sample's true cameras, of the upright pictures: rolled with them, in a world that is mirrored as they are
    ground_truth = read_ground_truth(sample / "cameras.json")
    mirror = np.diag([-1.0, 1.0, 1.0]) if orientation in MIRRORED else np.eye(3)
    rotation = mirror @ rigid3.rotation_matrix(ground_truth.cam_from_world) @ mirror
    poses = rigid3.from_matrix(rotation, ground_truth.cam_from_world[:, 4:] @ mirror)
    poses = upright_poses(poses, [INVERSE[ROTATION_OF[orientation]]] * len(poses))
    errors = evaluate_poses(
        model.image_names, model.cam_from_world, [Path(n).stem + ".png" for n in ground_truth.names], poses
    )
    assert np.nanmax(errors.rotation_error_deg) < 0.2


def test_labels_alone_change_no_model(photos: Path, tmp_path: Path) -> None:
    """One camera held in four ways writes the same kind of pixels: one camera, and the same bytes as without EXIF."""
    names = sorted(path.name for path in photos.iterdir())
    ways = {name: (1, 6, 3, 8)[k % 4] for k, name in enumerate(names)}
    write_photos(photos, tmp_path / "labelled", ways, keep=True)
    for source, out in ((photos, "plain"), (tmp_path / "labelled", "labelled_out")):
        reconstruct(source, tmp_path / out, record=False)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        plain, labelled = (tmp_path / out / "sparse/0" / name for out in ("plain", "labelled_out"))
        assert plain.read_bytes() == labelled.read_bytes()
    assert len(read_model(tmp_path / "labelled_out/sparse/0")[0].cameras) == 1
    manifest = json.loads((tmp_path / "labelled_out/run.json").read_text())
    assert manifest["stages"]["mapping"]["pixels"] == "stored"
    assert not find_source(tmp_path / "labelled_out", None, None, Options()).is_upright

    # a workspace of an earlier version says nothing of the kind, and is not mixed up with those of today
    del manifest["stages"]["mapping"]["pixels"], manifest["stages"]["mapping"]["orientations"]
    (tmp_path / "labelled_out/run.json").write_text(json.dumps(manifest))
    assert find_source(tmp_path / "labelled_out", None, None, Options()).is_upright
    with pytest.raises(InputError, match="earlier version of sfmapp, which turned 5"):
        export_model(tmp_path / "labelled_out", "ply", tmp_path / "points.ply")
    with pytest.raises(InputError, match="earlier version of sfmapp, which turned 5"):
        validation.validate(tmp_path / "labelled_out")
    shutil.copy(tmp_path / "plain/report.json", tmp_path / "labelled_out")  # nothing was turned: no difference
    export_model(tmp_path / "labelled_out", "ply", tmp_path / "points.ply")


def test_mirrored_files_among_others_are_told(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for k in range(6):
        pixels = rng.integers(0, 255, (H, W, 3), np.uint8)
        Image.fromarray(pixels).save(tmp_path / f"{k}.png", exif=exif_of(5 if k == 2 else 6))
    log: list[Event] = []
    image_set, _ = load_images(tmp_path, ImageOptions(), Events(log.append))
    told = [event.message for event in log if event.kind == "warned"]
    assert len(told) == 1
    assert told[0].startswith("2.png: stored as mirror images")
    assert [record.camera_idx for record in image_set.images] == [0, 0, 1, 0, 0, 0]


def test_a_mirrored_file_joins_no_model_of_others(photos: Path, tmp_path: Path) -> None:
    ways = {path.name: 2 if k == 3 else 1 for k, path in enumerate(sorted(photos.iterdir()))}
    write_photos(photos, tmp_path / "photos", ways)
    report = reconstruct(tmp_path / "photos", tmp_path / "out", record=False).report
    lost = [row for row in report["images"] if not row["is_registered"]]
    assert [ways[row["name"]] for row in lost] == [2]
    assert lost[0]["failed_at"] == "pairs"
    assert "mirror image" in lost[0]["reason"]


@pytest.mark.parametrize("orientation", range(2, 9))
@pytest.mark.parametrize("is_upright", [True, False])
def test_validate_compares_with_a_ground_truth_in_one_frame(
    tmp_path: Path, orientation: int, is_upright: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sfmapp.formats.colmap import write_model
    from sfmapp.scene.synthetic import make_scene as make_cameras
    from sfmapp.workspace.layout import FORMAT

    model = make_cameras(num_images=6, num_points=60, seed=1).ground_truth
    for name in model.image_names:
        path = tmp_path / "photos" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.random.default_rng(0).integers(0, 255, (H, W), np.uint8)).save(
            path, exif=exif_of(orientation)
        )
    write_model(tmp_path / "out/sparse/0", model)
    manifest = {"format": FORMAT, "stages": {"mapping": {"pixels": "stored"}}, "source": str(tmp_path / "photos")}
    (tmp_path / "out/run.json").write_text(json.dumps(manifest))
    upright = upright_poses(model.cam_from_world, [orientation] * 6)
    if orientation in MIRRORED:  # the true world, of which the files show a mirror image
        mirror = np.diag([-1.0, 1.0, 1.0])
        upright = rigid3.from_matrix(mirror @ rigid3.rotation_matrix(upright) @ mirror, upright[:, 4:] @ mirror)
    write_model(tmp_path / "ground_truth", replace(model, cam_from_world=upright) if is_upright else model)
    monkeypatch.setattr(validation, "_ask", lambda *_: None)
    result = validation.validate(tmp_path / "out", tmp_path / "ground_truth")
    assert result.ours["ground_truth"]["rotation_error_deg"]["max"] < 1e-4
    assert any("turned back" in note for note in result.notes) == is_upright


# -------------------------------------------------------------------------------------------------------- calibrations


def write_frames(folder: Path, orientation: int) -> None:
    folder.mkdir()
    for k in range(3):
        pixels = np.random.default_rng(k).integers(0, 255, (H, W), np.uint8)
        Image.fromarray(pixels).save(folder / f"{k:03d}.png", exif=exif_of(orientation))


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_calibrations_of_upright_frames_are_turned_back_or_refused_with_what_to_give(
    tmp_path: Path, orientation: int
) -> None:
    write_frames(tmp_path / "frames", orientation)
    stored = Camera(CameraModel.OPENCV, W, H, np.array([40.0, 41.0, 23.5, 16.2, 0.1, -0.02, 0.003, -0.004]))
    upright = turned_camera(stored, orientation)
    fx, fy, cx, cy, *rest = upright.params.tolist()
    calibration = {"width": H, "height": W, "fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5}
    calibration |= dict(zip(("k1", "k2", "p1", "p2"), rest, strict=True))
    (tmp_path / "calib.json").write_text(json.dumps(calibration))
    sequence = open_sequence(tmp_path / "frames", SequenceOptions(camera=str(tmp_path / "calib.json")), Events())
    assert sequence.orientation == orientation
    found = sequence.rig.cameras[0]
    assert (found.width, found.height) == (W, H)
    np.testing.assert_allclose(found.params, stored.params, atol=1e-9)
    assert next(iter(sequence.frames())).images[0].shape == (H, W)
    text = ",".join(["OPENCV", *map(str, upright.params)])
    with pytest.raises(InputError, match="turned upright") as caught:
        open_sequence(tmp_path / "frames", SequenceOptions(camera=text), Events())
    advised = str(caught.value.advice).removeprefix("give --camera ")
    sequence = open_sequence(tmp_path / "frames", SequenceOptions(camera=advised), Events())
    np.testing.assert_allclose(sequence.rig.cameras[0].params, stored.params, atol=1e-6)
    options = ImageOptions(camera_model=CameraModel.OPENCV, camera_params=tuple(upright.params))
    with pytest.raises(UsageError, match="turned upright"):
        load_images(tmp_path / "frames", options, Events())
    assert turned_back(stored, orientation) is None
    load_images(tmp_path / "frames", replace(options, camera_params=tuple(stored.params)), Events())


# ------------------------------------------------------------------------------------------------------- what is shown


def decoded(jpeg: bytes) -> NDArray[Any]:
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB).astype(float)


def stored_scene(upright: DenseScene, orientation: int) -> DenseScene:
    """The scene as cameras that are held so have it; of those that mirror, the world is mirrored."""
    back = INVERSE[ROTATION_OF[orientation]]
    views = []
    for view in upright.views:
        k = upright_pinhole(back, view.k, view.width, view.height)
        pose = upright_poses(view.cam_from_world[None], [back])[0]
        views.append(DenseView(view.name, upright_pixels(view.rgb, INVERSE[orientation]), None, k, pose, orientation))
    return replace(upright, views=tuple(views))


@pytest.mark.parametrize("orientation", ALL)
def test_dense_pictures_and_recordings_are_upright(orientation: int) -> None:
    plain = make_scene()
    smooth = cv2.resize(np.random.default_rng(4).integers(0, 255, (5, 8, 3), np.uint8), (160, 96))
    plain = replace(plain, views=tuple(replace(view, rgb=smooth) for view in plain.views))
    scene, patches = stored_scene(plain, orientation), wall(0, 80)
    for expected, found in zip(dense_pictures(plain, patches, None), dense_pictures(scene, patches, None), strict=True):
        for e, f in zip(expected.pictures, found.pictures, strict=True):
            want, got = decoded(e.jpeg), decoded(f.jpeg)
            assert want.shape == got.shape
            if orientation in MIRRORED and e.caption != "photograph":
                # the patches stand in the mirrored world, of which the picture shows the mirror image
                want = want[:, ::-1] if expected.title != "from beside and above" else want
            assert np.abs(want - got).mean() < 3.0, (expected.title, e.caption)
    shown, before = make_dense_replay(scene, patches), make_dense_replay(plain, patches)
    np.testing.assert_allclose(shown.cam_from_world, before.cam_from_world, atol=1e-9)
    np.testing.assert_allclose(shown.view_k, before.view_k, atol=1e-9)
    np.testing.assert_allclose(shown.up, before.up, atol=1e-9)
    picture = decoded(shown.photo[: shown.photo_ptr[1]].tobytes())
    want = smooth[:, ::-1] if orientation in MIRRORED else smooth
    assert np.abs(picture - want).mean() < 3.0


@pytest.mark.parametrize("orientation", ALL)
def test_a_replay_counts_in_upright_pixels(orientation: int) -> None:
    from sfmapp.images.image_set import ImageRecord, ImageSet
    from sfmapp.scene.features import Features
    from sfmapp.scene.synthetic import make_scene as make_cameras

    model = make_cameras(num_images=3, num_points=40, seed=1).ground_truth
    camera = model.cameras[0]
    records = tuple(
        ImageRecord(name, Path(name), camera.width, camera.height, orientation) for name in model.image_names
    )
    features = []
    for k in range(3):
        obs = model.tracks.observations_of_image(k)
        keypoints = np.zeros((int(model.tracks.obs_feature_idx[obs].max()) + 1, 4), np.float32)
        keypoints[model.tracks.obs_feature_idx[obs], :2] = model.tracks.obs_xy[obs]
        count = len(keypoints)
        features.append(Features(keypoints, np.zeros((count, 128), np.uint8), np.zeros((count, 3), np.uint8)))
    replay = make_replay(ImageSet(records, tuple(model.cameras)), features, [model], [])
    assert tuple(replay.image_size[0]) == upright_size(orientation, camera.width, camera.height)
    for k in range(3):
        mine = slice(replay.obs_ptr[k], replay.obs_ptr[k + 1])
        obs = model.tracks.observations_of_image(k)
        obs = obs[model.obs_is_inlier[obs]]
        seen = rigid3.apply(
            replay.model_cam_from_world[0, k].astype(float), model.point_xyz[model.tracks.obs_track_idx[obs]]
        )
        fx, fy, cx, cy = replay.image_intrinsics[k]
        xy = seen[:, :2] / seen[:, 2:] * [fx, fy] + [cx, cy]
        shown = replay.obs_xy[mine] + replay.obs_residual[mine]
        if orientation in MIRRORED:
            xy[:, 0] = replay.image_size[k, 0] - xy[:, 0]
        np.testing.assert_allclose(xy, shown, atol=4.0)  # but for the distortion, which pinholes do not have


class Logged:
    """What a live drawing logs, the last of each kind by entity."""

    def __init__(self) -> None:
        self.last: dict[tuple[str, str], Any] = {}

    def log(self, path: str, archetype: Any, **_: Any) -> None:
        self.last[path, type(archetype).__name__] = archetype

    def __getattr__(self, _: str) -> Any:
        return lambda *args, **kwargs: None


@pytest.mark.parametrize("orientation", ALL)
def test_live_frames_are_upright(orientation: int) -> None:
    from sfmapp.odometry.result import FrameState
    from sfmapp.viewer.live_rrd import LiveDrawing

    drawing, logged = LiveDrawing(None, None), Logged()
    drawing._recording = logged  # type: ignore[assignment]
    camera = Camera(CameraModel.PINHOLE, W, H, np.array([40.0, 40.0, W / 2, H / 2]))
    drawing.draw({
        "kind": "begin", "title": "", "camera": camera, "ground_truth_times": None, "ground_truth_cam_from_world": None,
        "is_metric": False, "orientation": orientation,
    })  # fmt: skip
    stored = cv2.resize(np.random.default_rng(0).integers(0, 255, (4, 6), np.uint8), (W, H))
    xy = np.array([[5.0, 7.0], [40.0, 20.0]])
    drawing.draw({
        "kind": "frame", "frame_idx": 0, "timestamp_s": 0.0, "state": int(FrameState.TRACKED), "image": stored,
        "xy": xy, "is_mapped": np.array([True, False]), "num_tracked": 2, "num_mapped": 1, "map_idx": 0,
        "cam_from_world": rigid3.IDENTITY, "cpu_s": 0.01,
    })  # fmt: skip
    jpeg = bytes(logged.last["image", "EncodedImage"].blob.as_arrow_array().to_pylist()[0])
    shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.abs(shown.astype(float) - turned_by_pillow(stored, orientation)).mean() < 4
    for name, place in (("mapped", xy[0]), ("tracked", xy[1])):
        found = logged.last[f"image/{name}", "Points2D"].positions.as_arrow_array().to_pylist()[0]
        np.testing.assert_allclose(found, upright_xy(orientation, place, W, H))
    # the world is turned so that the top of the upright picture is up
    turn = np.array(logged.last["world/scene", "Transform3D"].mat3x3.as_arrow_array().to_pylist()[0]).reshape(3, 3).T
    top = upright_vectors(INVERSE[orientation], [0.0, -1.0])
    np.testing.assert_allclose(turn @ [*top, 0.0], [0.0, 0.0, 1.0], atol=1e-6)
