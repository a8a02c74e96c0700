"""``sfmapp undistort``: photographs and a model without distortion, held against pycolmap's undistorter."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageOps

import sfmapp
from dense_models import make_model, row_of_poses, see_wall, texture
from schemas import check_schema
from sfmapp.camera.camera import Camera, CameraModel, pixels_to_normalized, pixels_to_rays, project
from sfmapp.cli.main import main
from sfmapp.errors import InputError, UsageError
from sfmapp.events import Event, Events
from sfmapp.formats.colmap import read_model, write_model
from sfmapp.geometry import rigid3
from sfmapp.images.exif import read_exif
from sfmapp.images.headers import read_header
from sfmapp.images.rewrite import encode, without_turn
from sfmapp.pipelines.dense.source import find_source
from sfmapp.reporting import plain
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import RigImages
from sfmapp.scene.tracks import Tracks
from sfmapp.scene.undistortion import Layout, move_pixels, plan_undistortion, undistort_reconstruction, warn_of_sides
from sfmapp.workspace.layout import FORMAT
from sfmapp.workspace.options import load_options

Array = NDArray[np.float64]

BARREL = Camera(CameraModel.OPENCV, 320, 240, np.array([250.0, 252.5, 155.0, 125.0, -0.2, 0.05, 0.002, -0.001]))
FISHEYE = Camera(CameraModel.OPENCV_FISHEYE, 320, 240, np.array([180.0, 181.0, 159.0, 120.5, 0.05, -0.01, 0.0, 0.0]))
PINCUSHION = Camera(CameraModel.RADIAL, 320, 240, np.array([250.0, 162.0, 118.0, 0.15, -0.02]))
SIMPLE = Camera(CameraModel.SIMPLE_RADIAL, 321, 240, np.array([250.0, 160.5, 120.0, -0.12]))
STRAIGHT = Camera(CameraModel.SIMPLE_PINHOLE, 320, 240, np.array([250.0, 160.0, 120.0]))
LENSES = [BARREL, FISHEYE, PINCUSHION, SIMPLE]
ONE = load_options([], ["threads=1"])


def by_model(camera: Camera) -> str:
    return camera.model.name


def write_scene(folder: Path, cameras: list[Camera], suffix: str = "png") -> Reconstruction:
    """``folder/sparse/0`` and ``folder/images`` of a textured wall, a camera for each image."""
    poses = row_of_poses(len(cameras))
    model = make_model(cameras, poses, 200, suffix)
    write_model(folder / "sparse" / "0", model)
    (folder / "images").mkdir()
    for name, camera, pose in zip(model.image_names, cameras, poses, strict=True):
        Image.fromarray(see_wall(camera, pose, texture())).save(folder / "images" / name, quality=98, subsampling=0)
    return read_model(folder / "sparse" / "0")[0]


def stored(path: Path) -> NDArray[np.uint8]:
    return np.asarray(Image.open(path))


# ------------------------------------------------------------------------------------------------------ the pinhole


@pytest.mark.parametrize("blank", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("max_size", [-1, 100])
@pytest.mark.parametrize("camera", LENSES, ids=by_model)
def test_the_pinhole_is_the_one_of_pycolmap(camera: Camera, blank: float, max_size: int) -> None:
    import pycolmap

    wanted = pycolmap.UndistortCameraOptions()
    wanted.blank_pixels, wanted.max_image_size = blank, max_size
    theirs = pycolmap.undistort_camera(
        wanted, pycolmap.Camera(model=camera.model.name, width=camera.width, height=camera.height, params=camera.params)
    )
    (planned,) = plan_undistortion(camera, Layout(blank, None if max_size < 0 else max_size))
    ours = planned.camera
    assert (ours.width, ours.height) == (theirs.width, theirs.height)
    assert ours.params == pytest.approx(theirs.params, abs=1e-6)


def test_a_lens_whose_border_has_no_inverse_gets_a_picture_of_bounded_size_without_blank_pixels() -> None:
    camera = Camera(CameraModel.OPENCV_FISHEYE, 400, 300, np.array([100.0, 100.0, 200.0, 150.0, 0.0, 0.0, 0.0, 0.0]))
    (planned,) = plan_undistortion(camera, Layout(front_only=True))
    found = planned.camera
    assert (found.width, found.height) == (800, 600)
    corners = np.array([[0.5, 0.5], [799.5, 599.5]])
    rays = (corners - found.params[2:]) / found.params[:2]
    theta = np.arctan(np.linalg.norm(rays, axis=1))
    seen = camera.params[2:4] + 100.0 * theta[:, None] * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    assert (seen > 0).all()
    assert (seen < [400, 300]).all()


def test_of_lenses_that_see_all_round_it_is_said_that_the_front_is_laid_out() -> None:
    told: list[Event] = []
    panorama = Camera(CameraModel.EQUIRECTANGULAR, 400, 200, np.array([400.0, 200.0]))
    warn_of_sides([*LENSES, STRAIGHT], "dense", "cut them up", Events(told.append))
    assert not told
    warn_of_sides([*LENSES, panorama, panorama], "dense", "cut them up", Events(told.append))
    assert [event.kind for event in told] == ["warned"]
    assert told[0].message.startswith("2 photographs")
    assert "EQUIRECTANGULAR" in told[0].message
    assert told[0].message.endswith("cut them up")


# --------------------------------------------------------------------------------------------- pictures and the model


@pytest.mark.parametrize("blank", [0.0, 1.0])
def test_pictures_and_cameras_are_those_of_pycolmap(tmp_path: Path, blank: float) -> None:
    import pycolmap

    model = write_scene(tmp_path, LENSES)
    for name in model.image_names:  # theirs is bilinear: without fine detail the two have to agree
        smooth = cv2.GaussianBlur(stored(tmp_path / "images" / name), (0, 0), 2.0)
        Image.fromarray(smooth).save(tmp_path / "images" / name)
    result = sfmapp.undistort(tmp_path / "sparse" / "0", tmp_path / "out", ONE, blank_pixels=blank)
    wanted = pycolmap.UndistortCameraOptions()
    wanted.blank_pixels = blank
    pycolmap.undistort_images(
        tmp_path / "theirs", tmp_path / "sparse" / "0", tmp_path / "images", undistort_options=wanted
    )
    assert result.report["num_images"] == 4
    check_schema("undistort", plain(result.report))
    for m in range(4):
        ours, theirs = (stored(tmp_path / place / "images" / f"view_{m}.png") for place in ("out", "theirs"))
        assert ours.shape == theirs.shape
        inside = (cv2.erode((theirs.max(axis=2) > 0).astype(np.uint8), np.ones((5, 5))) > 0)[3:-3, 3:-3]
        difference = np.abs(ours.astype(int) - theirs.astype(int)).max(axis=2)[3:-3, 3:-3][inside]
        assert inside.mean() > (0.99 if blank == 0.0 else 0.6)
        assert np.percentile(difference, 99) <= 3
        mask = tmp_path / "out" / "masks" / f"view_{m}.png.png"
        assert mask.is_file() == (blank == 1.0)
        if blank == 1.0:
            shown = stored(mask) == 255
            assert 0.6 < shown.mean() < 0.999
            assert (ours[~shown] == 0).all()
            assert ((theirs.max(axis=2) > 0) == shown).mean() > 0.98


@pytest.mark.parametrize("place", ["sparse", "sparse/0"])
@pytest.mark.parametrize("max_size", [None, 150])
def test_pycolmap_sees_the_same_rays(tmp_path: Path, place: str, max_size: int | None) -> None:
    import pycolmap

    rng = np.random.default_rng(0)
    write_scene(tmp_path, LENSES)
    # noise, so that there are residuals to keep
    model, _ = read_model(tmp_path / "sparse" / "0")
    model.tracks.obs_xy[:] += rng.normal(0.0, 0.7, model.tracks.obs_xy.shape)
    write_model(tmp_path / "sparse" / "0", model)
    report = sfmapp.undistort(tmp_path, tmp_path / "out", ONE, max_size=max_size).report
    before, after = (pycolmap.Reconstruction(path) for path in (tmp_path / "sparse" / "0", tmp_path / "out" / place))
    assert {camera.model.name for camera in after.cameras.values()} == {"PINHOLE"}
    count = 0
    for image in after.images.values():
        old = next(each for each in before.images.values() if each.name == image.name)
        camera, lens = after.cameras[image.camera_id], before.cameras[old.camera_id]
        assert (camera.width, camera.height) == stored(tmp_path / "out" / "images" / image.name).shape[1::-1]
        assert image.cam_from_world().matrix() == pytest.approx(old.cam_from_world().matrix())
        for point in image.points2D:
            assert (point.xy >= 0).all()
            assert (point.xy < [camera.width, camera.height]).all()
        seen = {tuple(np.round(p.xy, 6)) for p in image.points2D if p.has_point3D()}
        expected = set()
        for point in old.points2D:
            if point.has_point3D():
                xy = camera.img_from_cam(np.append(lens.cam_from_img(point.xy), 1.0))
                if (xy >= 0).all() and (xy < [camera.width, camera.height]).all():
                    expected.add(tuple(np.round(xy, 6)))
        assert len(seen) == len(expected)
        pairs = np.array(sorted(seen)) - np.array(sorted(expected))
        assert np.abs(pairs).max() < 1e-5  # both rounded to the sixth place
        count += len(seen)
    assert count == report["num_observations"]
    assert report["num_dropped"] == before.compute_num_observations() - count


@pytest.mark.parametrize("camera", LENSES, ids=by_model)
def test_residuals_are_those_of_the_rays_to_a_millionth_of_a_pixel(camera: Camera) -> None:
    poses = row_of_poses(3)
    model = make_model([camera] * 3, poses, 100)
    model.tracks.obs_xy[:] += np.random.default_rng(3).normal(0.0, 0.7, model.tracks.obs_xy.shape)
    model.tracks.obs_xy[0] = 0.1  # beyond the crop
    keypoints = [model.tracks.obs_xy[model.tracks.observations_of_image(m)] for m in range(3)]
    planned = plan_undistortion(camera, Layout())
    flat, _ = undistort_reconstruction(model, keypoints, np.arange(3), [planned] * 3)
    expected = model.tracks.obs_xy + model.residuals_px()
    expected = move_pixels(planned[0], expected) - move_pixels(planned[0], model.tracks.obs_xy)
    moved = move_pixels(planned[0], model.tracks.obs_xy)
    size = planned[0].camera.width, planned[0].camera.height
    inside = ((moved >= 0) & (moved < size)).all(axis=1)
    assert 0.5 < inside.mean() < 1.0
    assert flat.residuals_px() == pytest.approx(expected[inside], abs=1e-6)
    assert flat.tracks.obs_xy == pytest.approx(moved[inside], abs=1e-9)


def test_what_falls_outside_takes_its_track_elements_and_its_empty_points_along() -> None:
    model = make_model([BARREL] * 2, row_of_poses(2), 50)
    keypoints = [model.tracks.obs_xy[model.tracks.observations_of_image(m)] for m in range(2)]
    (planned,) = plan_undistortion(BARREL, Layout())
    # a point whose pixels lie where the crop is, and a keypoint of no track inside
    lost = int(model.tracks.obs_track_idx[0])
    corner = np.array([[0.1, 0.1]])
    assert (move_pixels(planned, corner) < 0).any()
    model.tracks.obs_xy[model.tracks.obs_track_idx == lost] = corner
    keypoints[0] = np.concatenate([keypoints[0], [[160.0, 120.0]]])
    flat, moved = undistort_reconstruction(model, keypoints, np.arange(2), [[planned]] * 2)
    assert np.isnan(flat.point_xyz[lost]).all()
    assert lost not in flat.tracks.obs_track_idx
    assert not np.isnan(np.delete(flat.point_xyz, lost, axis=0)).any()
    assert moved[0][-1] == pytest.approx(move_pixels(planned, np.array([[160.0, 120.0]]))[0])
    for m in range(2):
        obs = flat.tracks.observations_of_image(m)
        assert moved[m][flat.tracks.obs_feature_idx[obs]] == pytest.approx(flat.tracks.obs_xy[obs])


def edge_deviation(gray: Array, k: int) -> float:
    """Largest distance in pixels of a bright stripe's middle, row by row, from a straight line."""
    rows = np.arange(8, gray.shape[0] - 8)
    columns = np.arange(gray.shape[1]) + 0.5
    window = np.abs(columns[None] - k) < gray.shape[1] * 0.2
    weight = np.where(window, gray[rows], 0.0)
    middle = (weight * columns).sum(axis=1) / weight.sum(axis=1)
    return float(np.abs(middle - np.polyval(np.polyfit(rows, middle, 1), rows)).max())


@pytest.mark.parametrize("camera", [BARREL, FISHEYE, PINCUSHION], ids=by_model)
def test_straight_lines_are_straight(tmp_path: Path, camera: Camera) -> None:
    # a soft bright stripe along a slanted line of the scene, left of the middle
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = pixels_to_normalized(camera, np.stack([u.ravel(), v.ravel()], axis=1))
    picture = 250.0 * np.exp(-(((rays[:, 0] - 0.05 * rays[:, 1] + 0.42) / 0.02) ** 2))
    gray = picture.reshape(u.shape)
    model = make_model([camera] * 2, row_of_poses(2), 50)
    write_model(tmp_path / "sparse" / "0", model)
    (tmp_path / "images").mkdir()
    for name in model.image_names:
        Image.fromarray(np.round(gray).astype(np.uint8)).save(tmp_path / "images" / name)
    sfmapp.undistort(tmp_path, tmp_path / "out", ONE)
    flat = stored(tmp_path / "out" / "images" / model.image_names[0]).astype(float)
    planned = plan_undistortion(camera, Layout())[0].camera
    place = float(planned.params[2] - 0.42 * planned.params[0])
    assert flat.ndim == 2  # grey stays grey
    assert edge_deviation(gray, int(gray[120].argmax())) > 1.5
    assert edge_deviation(flat, int(place)) < 0.1


def test_rigs_stay_rigs(tmp_path: Path) -> None:
    import pycolmap

    model = write_scene(tmp_path, [BARREL, FISHEYE, BARREL, FISHEYE])
    model.cameras, model.image_camera_idx = [BARREL, FISHEYE], np.array([0, 1, 0, 1], np.int32)
    mount = rigid3.compose(model.cam_from_world[1], rigid3.inverse(model.cam_from_world[0]))
    model.cam_from_world[3] = rigid3.compose(mount, model.cam_from_world[2])
    frame, sensor = np.array([0, 0, 1, 1], np.int32), np.array([0, 1, 0, 1], np.int32)
    model.rig = RigImages(frame, sensor, np.array([rigid3.IDENTITY, mount]))
    write_model(tmp_path / "sparse" / "0", model)
    sfmapp.undistort(tmp_path, tmp_path / "out", ONE)
    before, after = (pycolmap.Reconstruction(path) for path in (tmp_path / "sparse" / "0", tmp_path / "out" / "sparse"))
    assert (after.num_rigs(), after.num_frames(), after.num_cameras()) == (1, 2, 2)
    for image in after.images.values():
        old = next(each for each in before.images.values() if each.name == image.name)
        assert image.cam_from_world().matrix() == pytest.approx(old.cam_from_world().matrix(), abs=1e-12)


def test_photographs_at_half_the_size_of_their_cameras(tmp_path: Path) -> None:
    model = write_scene(tmp_path, [BARREL] * 2)
    for path in (tmp_path / "images").iterdir():
        picture = Image.open(path)
        picture.reduce(2).save(path)
    sfmapp.undistort(tmp_path, tmp_path / "out", ONE)
    flat, _ = read_model(tmp_path / "out" / "sparse")
    assert flat.cameras[0].params[:2] == pytest.approx(BARREL.params[:2] / 2)
    assert stored(tmp_path / "out" / "images" / "view_0.png").shape[1] == flat.cameras[0].width
    assert flat.tracks.num_observations > 0.8 * model.tracks.num_observations
    assert np.abs(flat.residuals_px()).max() < 1e-6  # the scene is exact


# ------------------------------------------------------------------------------------- lenses that see to their sides

PANORAMA = Camera(CameraModel.EQUIRECTANGULAR, 400, 200, np.array([400.0, 200.0]))
# 85 degrees from the axis in the middle of the borders, 119 in the corners
WIDE = Camera(CameraModel.OPENCV_FISHEYE, 240, 240, np.array([80.0, 80.5, 119.0, 121.0, 0.01, -0.002, 0.0, 0.0]))


def sky(directions: Array) -> Array:
    """Brightness of unit vectors (N, 3) of the world: smooth, another one everywhere."""
    waves = np.array([[2.0, 3.0, -1.0], [-3.0, 1.0, 2.0], [1.0, -2.0, 4.0]])
    return 127.0 + 35.0 * np.sin(directions @ waves.T + [0.3, 1.1, 2.0]).sum(axis=1)


def rays_of(camera: Camera, pose: Array) -> Array:
    """Unit vectors (H * W, 3) of the world that the pixels see."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    return pixels_to_rays(camera, np.stack([u.ravel(), v.ravel()], axis=1)) @ rigid3.rotation_matrix(pose)


def write_surroundings(folder: Path, cameras: list[Camera]) -> Reconstruction:
    """``folder/sparse/0`` and ``folder/images`` of points and a sky all round the cameras, with noisy observations."""
    rng = np.random.default_rng(5)
    poses = np.array([rigid3.from_matrix(rigid3.exp_so3(rng.normal(size=3)), rng.normal(size=3)) for _ in cameras])
    xyz = rng.normal(size=(300, 3))
    xyz *= 6.0 / np.linalg.norm(xyz, axis=1, keepdims=True)
    pixels = np.array([project(camera, rigid3.apply(pose, xyz)) for camera, pose in zip(cameras, poses, strict=True)])
    sizes = np.array([(camera.width, camera.height) for camera in cameras])[:, None]
    image, track = np.nonzero(((pixels > 4) & (pixels < sizes - 4)).all(axis=2))
    xy = pixels[image, track] + rng.normal(0.0, 0.5, (len(image), 2))
    tracks = Tracks.from_observations(track, image, xy, num_images=len(cameras))
    names = [f"view_{m}.png" for m in range(len(cameras))]
    kinds = list({id(camera): camera for camera in cameras}.values())
    camera_idx = np.array([[kind is camera for kind in kinds].index(True) for camera in cameras], np.int32)
    model = Reconstruction.empty(kinds, names, camera_idx, tracks)
    model.cam_from_world, model.point_xyz, model.obs_is_inlier[:] = poses, xyz, True
    write_model(folder / "sparse" / "0", model)
    (folder / "images").mkdir()
    for name, camera, pose in zip(names, cameras, poses, strict=True):
        picture = np.nan_to_num(sky(rays_of(camera, pose))).reshape(camera.height, camera.width)
        Image.fromarray(np.round(picture).astype(np.uint8)).save(folder / "images" / name)
    return model


@pytest.mark.parametrize("max_size", [None, 50])
def test_photographs_of_all_round_become_faces_of_cubes_on_a_rig(tmp_path: Path, max_size: int | None) -> None:
    import pycolmap

    cameras = [PANORAMA, WIDE, STRAIGHT, PANORAMA]
    model = write_surroundings(tmp_path, cameras)
    report = sfmapp.undistort(tmp_path, tmp_path / "out", ONE, max_size=max_size).report
    before, after = (pycolmap.Reconstruction(tmp_path / place / "sparse" / "0") for place in (".", "out"))
    # nothing is lost, and nothing counted twice; the fisheye sees nothing of what is straight behind it
    assert (report["num_images"], report["num_faces"], report["num_dropped"]) == (6 + 5 + 1 + 6, 17, 0)
    assert after.compute_num_observations() == before.compute_num_observations() == report["num_observations"]
    assert after.num_points3D() == before.num_points3D()
    # two kinds of cubes, each a rig, and the photograph that needs none
    assert sorted(len(frame.data_ids) for frame in after.frames.values()) == [1, 5, 6, 6]
    assert sorted(rig.num_sensors() for rig in after.rigs.values()) == [1, 5, 6]
    tracks = model.tracks
    pairs = zip(tracks.obs_image_idx.tolist(), tracks.obs_track_idx.tolist(), strict=True)
    observed = dict(zip(pairs, tracks.obs_xy, strict=True))
    for image in after.images.values():
        number, camera = int(image.name.removeprefix("view_")[0]), after.cameras[image.camera_id]
        assert camera.model.name == "PINHOLE"
        assert max_size is None or camera.width <= max_size
        pose = model.cam_from_world[number]
        assert image.projection_center() == pytest.approx(rigid3.center(pose), abs=1e-9)
        picture_from_cam = image.cam_from_world().rotation.matrix() @ rigid3.rotation_matrix(pose).T
        for point in image.points2D:
            if point.has_point3D():
                assert (point.xy >= 0).all()
                assert (point.xy < [camera.width, camera.height]).all()
                # observation and reprojection lie on the same rays as those of the photograph
                ray = pixels_to_rays(cameras[number], observed[number, point.point3D_id - 1][None])[0]
                assert camera.img_from_cam(picture_from_cam @ ray) == pytest.approx(point.xy, abs=1e-6)
                xyz = before.points3D[point.point3D_id].xyz
                wanted = camera.img_from_cam(picture_from_cam @ rigid3.apply(pose, xyz))
                assert camera.img_from_cam(image.cam_from_world() * xyz) == pytest.approx(wanted, abs=1e-6)


def test_a_cube_that_is_mounted_on_a_rig_stays_on_it(tmp_path: Path) -> None:
    import pycolmap

    model = write_surroundings(tmp_path, [STRAIGHT, WIDE, STRAIGHT, WIDE])
    mount = rigid3.compose(model.cam_from_world[1], rigid3.inverse(model.cam_from_world[0]))
    model.cam_from_world[3] = rigid3.compose(mount, model.cam_from_world[2])
    frame, sensor = np.array([0, 0, 1, 1], np.int32), np.array([0, 1, 0, 1], np.int32)
    model.rig = RigImages(frame, sensor, np.array([rigid3.IDENTITY, mount]))
    write_model(tmp_path / "sparse" / "0", model)
    sfmapp.undistort(tmp_path, tmp_path / "out", ONE, max_size=20)
    before, after = (pycolmap.Reconstruction(tmp_path / place / "sparse" / "0") for place in (".", "out"))
    assert (after.num_rigs(), after.num_frames(), after.num_cameras(), after.num_reg_images()) == (1, 2, 6, 12)
    for image in after.images.values():
        old = next(each for each in before.images.values() if image.name[:6] == each.name[:6])
        assert image.projection_center() == pytest.approx(old.projection_center(), abs=1e-9)
        if "front" in image.name:
            assert image.cam_from_world().matrix() == pytest.approx(old.cam_from_world().matrix(), abs=1e-12)


def test_faces_show_what_lies_there_across_seam_and_poles_masks_too(tmp_path: Path) -> None:
    model = write_surroundings(tmp_path, [PANORAMA, PANORAMA, WIDE])
    (tmp_path / "masks").mkdir()
    night = sky(rays_of(PANORAMA, model.cam_from_world[1])).reshape(200, 400) < 120.0
    Image.fromarray((255 * ~night).astype(np.uint8)).save(tmp_path / "masks" / "view_1.png.png")
    options = load_options([], ["threads=1", f"images.mask_path={tmp_path / 'masks'}"])
    sfmapp.undistort(tmp_path, tmp_path / "out", options)
    flat, _ = read_model(tmp_path / "out" / "sparse")
    for name, camera_idx, pose in zip(flat.image_names, flat.image_camera_idx, flat.cam_from_world, strict=True):
        camera = flat.cameras[camera_idx]
        found = stored(tmp_path / "out" / "images" / name).astype(float)
        assert found.shape == (camera.height, camera.width)
        mask = tmp_path / "out" / "masks" / f"{name}.png"
        usable = stored(mask) > 0 if mask.is_file() else np.ones(found.shape, bool)
        wanted = sky(rays_of(camera, pose)).reshape(found.shape)
        if "view_1" in name:
            assert not (usable & (wanted < 116.0)).any(), name
            assert usable[wanted > 124.0].all(), name
            usable[:] = True
        # of the fisheye's faces only the one in front is full
        assert usable.all() == ("view_2" not in name or "front" in name), name
        inside = cv2.erode(usable.astype(np.uint8), np.ones((5, 5)), borderValue=1) > 0
        assert np.abs(found - wanted)[inside].max() < 2.0, name  # two roundings, and a little of interpolation
        assert (found[~usable] == 0).all()


def test_the_front_alone_is_one_picture_of_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_surroundings(tmp_path, [PANORAMA, WIDE])
    assert main(["undistort", str(tmp_path), "-o", str(tmp_path / "out"), "--front-only", "--threads", "1"]) == 0
    assert "2 photographs are by lenses that see to their sides" in capsys.readouterr().err
    flat, _ = read_model(tmp_path / "out" / "sparse")
    assert flat.image_names == ["view_0.png", "view_1.png"]
    assert flat.rig is None


def test_faces_and_photographs_of_one_name_are_refused(tmp_path: Path) -> None:
    model = write_surroundings(tmp_path, [PANORAMA, STRAIGHT])
    (tmp_path / "images" / "view_1.png").rename(tmp_path / "images" / "view_0_left.png")
    model.image_names[1] = "view_0_left.png"
    write_model(tmp_path / "sparse" / "0", model)
    with pytest.raises(InputError, match=r"view_0_left\.png: a photograph and a face of a cube have the same name"):
        sfmapp.undistort(tmp_path, tmp_path / "out", ONE)
    assert not (tmp_path / "out" / "images").exists()


# -------------------------------------------------------------------------------------------------- what files hold


def test_without_distortion_files_are_copied(tmp_path: Path) -> None:
    write_scene(tmp_path, [STRAIGHT, replace(STRAIGHT, model=CameraModel.PINHOLE, params=[250.0, 251.0, 160.0, 120.0])])
    report = sfmapp.undistort(tmp_path, tmp_path / "out", ONE).report
    assert report["num_copied"] == 2
    for m in range(2):
        copy, original = (tmp_path / place / "images" / f"view_{m}.png" for place in ("out", "."))
        assert copy.read_bytes() == original.read_bytes()
    cameras = read_model(tmp_path / "out" / "sparse")[0].cameras
    assert [camera.model for camera in cameras] == [CameraModel.PINHOLE] * 2
    assert cameras[0].params.tolist() == [250.0, 250.0, 160.0, 120.0]
    # a limit on the size is another matter
    assert sfmapp.undistort(tmp_path, tmp_path / "small", ONE, max_size=160).report["num_copied"] == 0
    assert stored(tmp_path / "small" / "images" / "view_0.png").shape == (120, 160, 3)


@pytest.mark.parametrize("camera", [STRAIGHT, BARREL], ids=by_model)
@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
def test_nobody_turns_what_is_written(tmp_path: Path, camera: Camera, suffix: str) -> None:
    write_scene(tmp_path, [camera] * 2, suffix)
    exif = Image.Exif()
    exif[274] = 6
    for path in (tmp_path / "images").iterdir():
        picture = Image.open(path)
        picture.load()
        picture.save(path, exif=exif, quality=98, **({"lossless": True} if suffix == "webp" else {}))
        assert read_exif(read_header(path.read_bytes()).exif).orientation == 6
    sfmapp.undistort(tmp_path, tmp_path / "out", ONE)
    path = tmp_path / "out" / "images" / f"view_0.{suffix}"
    with Image.open(path) as picture:
        assert picture.format == {"jpg": "JPEG", "tif": "TIFF"}.get(suffix, suffix.upper())
        plain, turned = np.asarray(picture), np.asarray(ImageOps.exif_transpose(picture))
    planned = plan_undistortion(camera, Layout())[0].camera
    assert plain.shape == (planned.height, planned.width, 3)
    assert (plain == turned).all()
    for flags in (cv2.IMREAD_COLOR_RGB, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION):
        found = cv2.imread(str(path), flags)
        assert found.shape == plain.shape
        assert np.abs(found.astype(int) - plain).max() <= 3  # two decoders of JPEG
    if camera is STRAIGHT:  # not a pixel was touched
        original = stored(tmp_path / "images" / f"view_0.{suffix}")
        # Pillow turns TIFFs as it reads them
        assert (plain == (np.rot90(original) if suffix == "tif" else original)).all()


def test_a_tag_that_cannot_be_changed_is_told() -> None:
    data = (Path(__file__).parent / "conftest.py").read_bytes()
    exif = Image.Exif()
    exif[274] = 8
    header = replace(read_header(encode(np.zeros((20, 30), np.uint8), "jpeg")), exif=exif.tobytes()[6:])
    assert without_turn(data, header) is None


def test_sixteen_bits_alpha_and_masks_are_carried_along(tmp_path: Path) -> None:
    write_scene(tmp_path, [BARREL] * 3)
    images, masks = tmp_path / "images", tmp_path / "masks"
    deep = stored(images / "view_0.png").astype(np.uint16) * 16  # 12 bits in 16
    cv2.imwrite(str(images / "view_0.png"), deep[..., ::-1])
    alpha = np.full((240, 320), 255, np.uint8)
    alpha[:, :100] = 0
    Image.fromarray(np.dstack([stored(images / "view_1.png"), alpha])).save(images / "view_1.png")
    masks.mkdir()
    Image.fromarray(alpha).save(masks / "view_2.png.png")
    options = load_options([], ["threads=1", f"images.mask_path={masks}"])
    sfmapp.undistort(tmp_path, tmp_path / "out", options, blank_pixels=0.0)
    out = tmp_path / "out"
    found = cv2.imread(str(out / "images" / "view_0.png"), cv2.IMREAD_UNCHANGED)
    assert found.dtype == np.uint16
    assert deep.max() / 2 < found.max() <= deep.max()
    assert len(np.unique(found)) > 1000  # no 8 bits on the way
    flat_alpha = stored(out / "images" / "view_1.png")[..., 3]
    (planned,) = plan_undistortion(BARREL, Layout())
    border = move_pixels(planned, np.stack([np.full(200, 100.0), np.linspace(20, 220, 200)], axis=1))
    for x, y in border[(border[:, 1] > 5) & (border[:, 1] < planned.camera.height - 5)]:
        assert flat_alpha[int(y), int(x) - 3] == 0
        assert flat_alpha[int(y), int(x) + 3] == 255
    mask = stored(out / "masks" / "view_2.png.png")
    assert set(np.unique(mask)) == {0, 255}
    assert ((mask > 127) == (flat_alpha > 127)).all()
    assert sorted(path.name for path in (out / "masks").iterdir()) == ["view_2.png.png"]


def test_other_commands_take_the_folder_with_its_own_pictures(tmp_path: Path) -> None:
    write_scene(tmp_path, [BARREL] * 2)
    sfmapp.undistort(tmp_path, tmp_path / "out", ONE)
    assert main(["export", str(tmp_path / "out"), "--to", "nerfstudio", "-o", str(tmp_path / "out" / "ns"), "-q"]) == 0
    frames = json.loads((tmp_path / "out" / "ns" / "transforms.json").read_text())["frames"]
    for frame in frames:
        picture = (tmp_path / "out" / "ns" / frame["file_path"]).resolve()
        assert picture.parent == (tmp_path / "out" / "images").resolve()
    where = find_source(tmp_path / "out", tmp_path / "dense", None, ONE)
    assert where.model == tmp_path / "out" / "sparse" / "0"
    assert where.images.resolve() == (tmp_path / "out" / "images").resolve()
    # pinholes have nothing to undistort
    again = sfmapp.undistort(tmp_path / "out", tmp_path / "again", ONE)
    assert again.report["num_copied"] == 2
    with pytest.raises(UsageError, match="where the results go"):
        sfmapp.undistort(tmp_path / "out", tmp_path / "out", ONE)


# --------------------------------------------------------------------------------------------------- what goes wrong


def test_a_missing_or_damaged_photograph_costs_the_others_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scene(tmp_path, [BARREL] * 5)
    (tmp_path / "images" / "view_1.png").unlink()
    data = (tmp_path / "images" / "view_3.png").read_bytes()
    (tmp_path / "images" / "view_3.png").write_bytes(data[: len(data) // 2])
    command = ["undistort", str(tmp_path), "-o", str(tmp_path / "out"), "--threads", "2", "--json"]
    assert main(command) == 0
    said = capsys.readouterr()
    result = json.loads(said.out)
    assert {row["name"] for row in result["missing"]} == {"view_1.png", "view_3.png"}
    assert "view_1.png" in said.err
    assert "view_3.png" in said.err
    model, keypoints = read_model(tmp_path / "out" / "sparse" / "0")
    assert model.image_names == ["view_0.png", "view_2.png", "view_4.png"]
    assert all(len(xy) for xy in keypoints)
    assert sorted(path.name for path in (tmp_path / "out" / "images").iterdir()) == model.image_names
    # brought back, the same command takes them in, and does only that
    (tmp_path / "images" / "view_3.png").write_bytes(data)
    write_time = (tmp_path / "out" / "images" / "view_0.png").stat().st_mtime_ns
    assert main(command) == 0
    assert [row["name"] for row in json.loads(capsys.readouterr().out)["missing"]] == ["view_1.png"]
    assert len(read_model(tmp_path / "out" / "sparse" / "0")[0].image_names) == 4
    assert write_time <= (tmp_path / "out" / "images" / "view_0.png").stat().st_mtime_ns


def test_a_run_that_was_cut_off_is_resumed_and_another_replaces_it(tmp_path: Path) -> None:
    write_scene(tmp_path, [BARREL] * 3)
    out = tmp_path / "out"
    sfmapp.undistort(tmp_path, out, ONE, blank_pixels=1.0)
    assert sfmapp.undistort(tmp_path, out, ONE, blank_pixels=1.0).report["run"]["is_up_to_date"]
    (out / "images" / "view_1.png").unlink()
    kept = (out / "images" / "view_0.png").stat().st_mtime_ns
    again = sfmapp.undistort(tmp_path, out, ONE, blank_pixels=1.0)
    assert not again.report["run"]["is_up_to_date"]
    assert again.report["num_masks"] == 3
    assert (out / "images" / "view_1.png").is_file()
    assert (out / "images" / "view_0.png").stat().st_mtime_ns == kept
    # with other settings nothing of the first run stays
    (out / "images" / "mine.txt").write_text("the user's")
    (tmp_path / "images" / "view_2.png").unlink()
    report = sfmapp.undistort(tmp_path, out, ONE).report
    assert report["num_masks"] == 0
    assert list((out / "masks").iterdir()) == []
    assert {path.name for path in (out / "images").iterdir()} == {"view_0.png", "view_1.png", "mine.txt"}


def test_nothing_of_the_users_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_scene(tmp_path, [BARREL] * 2)
    before = {path: path.read_bytes() for path in (tmp_path / "images").iterdir()}
    assert main(["undistort", str(tmp_path), "-o", str(tmp_path)]) == 2  # beside the originals
    strangers = tmp_path / "strangers"
    strangers.mkdir()
    (strangers / "a.txt").write_text("x")
    assert main(["undistort", str(tmp_path), "-o", str(strangers)]) == 2
    # a result whose folder of pictures was made a link to the originals
    out = tmp_path / "out"
    sfmapp.undistort(tmp_path, out, ONE)
    for path in (out / "images").iterdir():
        path.unlink()
    (out / "images").rmdir()
    (out / "images").symlink_to(tmp_path / "images")
    with pytest.raises(UsageError, match="leads out"):
        sfmapp.undistort(tmp_path, out, ONE, max_size=100)
    assert {path: path.read_bytes() for path in (tmp_path / "images").iterdir()} == before
    # or that of the model
    (out / "images").unlink()
    shutil.rmtree(out / "sparse")
    (out / "sparse").symlink_to(tmp_path / "sparse")
    model = {path: path.read_bytes() for path in (tmp_path / "sparse" / "0").iterdir()}
    with pytest.raises(UsageError, match="leads out"):
        sfmapp.undistort(tmp_path, out, ONE, max_size=100)
    assert {path: path.read_bytes() for path in (tmp_path / "sparse" / "0").iterdir()} == model
    assert "nothing in it was touched" in capsys.readouterr().err


def test_names_that_lead_out_are_left_out(tmp_path: Path) -> None:
    model = write_scene(tmp_path / "p", [BARREL] * 3)
    (tmp_path / "outside.png").write_bytes((tmp_path / "p" / "images" / "view_1.png").read_bytes())
    model.image_names[1] = "../../outside.png"
    (tmp_path / "p" / "images" / "sub").mkdir()
    (tmp_path / "p" / "images" / "view_2.png").rename(tmp_path / "p" / "images" / "sub" / "view_2.png")
    model.image_names[2] = "sub/view_2.png"
    write_model(tmp_path / "p" / "sparse" / "0", model)
    report = sfmapp.undistort(tmp_path / "p", tmp_path / "o" / "u", ONE).report
    assert [row["name"] for row in report["missing"]] == ["../../outside.png"]
    assert not (tmp_path / "o" / "outside.png").exists()
    assert (tmp_path / "o" / "u" / "images" / "sub" / "view_2.png").is_file()
    assert read_model(tmp_path / "o" / "u" / "sparse")[0].image_names == ["view_0.png", "sub/view_2.png"]


def test_keyframes_of_odometry_on_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_scene(tmp_path / "w", [BARREL] * 2)
    manifest = {"format": FORMAT, "command": "odometry", "stages": {}, "source": str(tmp_path / "w" / "images")}
    (tmp_path / "w" / "run.json").write_text(json.dumps(manifest))
    assert sfmapp.undistort(tmp_path / "w", tmp_path / "out", ONE).report["num_images"] == 2
    (tmp_path / "film.mp4").write_bytes(b"")
    (tmp_path / "w" / "run.json").write_text(json.dumps(manifest | {"source": str(tmp_path / "film.mp4")}))
    assert main(["undistort", str(tmp_path / "w"), "-o", str(tmp_path / "other")]) == 3
    assert "--images DIR" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("flags", [["--blank-pixels", "1.5"], ["--blank-pixels", "nan"], ["--max-size", "0"]])
def test_settings_that_make_no_sense_are_refused(tmp_path: Path, flags: list[str]) -> None:
    write_scene(tmp_path, [BARREL] * 2)
    assert main(["undistort", str(tmp_path), "-o", str(tmp_path / "out"), *flags]) == 2
    assert not (tmp_path / "out").exists()


def test_no_photograph_at_all_is_an_error(tmp_path: Path) -> None:
    write_scene(tmp_path, [BARREL] * 2)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="2 of 2 images"):
        sfmapp.undistort(tmp_path, tmp_path / "out", ONE, images=tmp_path / "empty")


def test_a_workspace_of_reconstruct_needs_no_more_than_its_name(reconstructed: Path, tmp_path: Path) -> None:
    assert main(["undistort", str(reconstructed), "-o", str(tmp_path / "flat"), "--threads", "1"]) == 0
    import pycolmap

    before, after = (
        pycolmap.Reconstruction(path) for path in (reconstructed / "sparse" / "0", tmp_path / "flat" / "sparse" / "0")
    )
    assert after.num_reg_images() == before.num_reg_images() == 7
    assert after.compute_num_observations() > 0.95 * before.compute_num_observations()
    errors = [each.compute_mean_reprojection_error() for each in (before, after)]
    assert errors[1] == pytest.approx(errors[0], rel=0.1)
