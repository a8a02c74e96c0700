"""From models to views: pixels stay where the cameras say, masks and sizes come along, neighbours have a baseline."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from dense_models import DEPTH, PINHOLE, make_model, row_of_poses, see_wall, texture, write_wall
from sfmapp.camera.camera import Camera, CameraModel, pixels_to_normalized, project
from sfmapp.dense.files import read_patches, write_fused_ply, write_patches
from sfmapp.dense.maps import splat_view
from sfmapp.dense.options import DenseOptions
from sfmapp.dense.photographs import find_photographs, scaled_camera
from sfmapp.dense.prepare import DensePlan, load_scene, part_of, plan_views
from sfmapp.dense.scene import DenseScene, Patches
from sfmapp.dense.selection import meeting_point, select_neighbors
from sfmapp.dense.undistort import lay_out, make_canvas
from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.events import Event, Events
from sfmapp.formats.ply import TYPES
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.geometry import rigid3
from sfmapp.images.image_set import ImageOptions
from sfmapp.scene.reconstruction import Reconstruction

RADIAL = Camera(CameraModel.SIMPLE_RADIAL, 200, 140, np.array([180.0, 101.3, 68.6, -0.12]))
BARREL = Camera(CameraModel.OPENCV, 200, 140, np.array([125.0, 124.0, 98.4, 72.3, -0.28, 0.07, 2e-3, -1e-3]))
FISHEYE = Camera(CameraModel.OPENCV_FISHEYE, 200, 140, np.array([80.0, 80.0, 100.5, 69.0, 0.01, -0.003, 0.002, -0.001]))
CAMERAS = pytest.mark.parametrize("camera", [PINHOLE, RADIAL, BARREL, FISHEYE], ids=lambda c: c.model.name)


def plan_of(
    folder: Path, model: Reconstruction, options: DenseOptions | None = None, masks: Path | None = None,
    is_upright: bool = False, events: Events | None = None,
) -> DensePlan:  # fmt: skip
    image_options = ImageOptions(mask_path=None if masks is None else str(masks))
    found = find_photographs(model, folder / "images", image_options, is_upright=is_upright, events=events)
    return plan_views(model, found, options or DenseOptions(), events)[0]


def scene_of(folder: Path, model: Reconstruction, options: DenseOptions | None = None) -> DenseScene:
    return load_scene(plan_of(folder, model, options))


# ---------------------------------------------------------------------------------------------------------- pixels


@CAMERAS
@pytest.mark.parametrize("shrink", [1.0, 2.0, 1.7])
def test_an_undistorted_pixel_shows_what_its_ray_meets(camera: Camera, shrink: float) -> None:
    # a large camera, so that sampling costs nothing, and a texture that is smooth even when shrunk
    camera = scaled_camera(camera, 800, 560)
    wall = cv2.GaussianBlur(texture(), (0, 0), 6).astype(float)
    wall = np.clip(128 + 45 * (wall - wall.mean()) / wall.std(), 0, 255).astype(np.uint8)
    pose = row_of_poses(3)[2]
    canvas = make_canvas(camera, shrink)
    rgb, mask = lay_out(canvas, see_wall(camera, pose, wall), None)
    assert rgb.shape[1::-1] == canvas.working_size
    fx, fy, cx, cy = canvas.k
    flat = Camera(CameraModel.PINHOLE, rgb.shape[1], rgb.shape[0], np.array([fx, fy, cx, cy]))
    expected = see_wall(flat, pose, wall).astype(int)
    shown = np.ones(rgb.shape[:2], bool) if mask is None else cv2.erode(mask.astype(np.uint8), np.ones((5, 5))) > 0
    error = np.abs(rgb.astype(int) - expected)[shown]
    # by how much the texture changes from pixel to pixel: half a pixel off would be half of it
    shifted = np.abs(np.roll(expected, 1, axis=1) - expected)[shown].mean()
    assert shifted > 1.0
    assert error.mean() < min(0.6, 0.25 * shifted)
    assert shown.mean() > 0.6


@CAMERAS
def test_the_mask_is_what_the_photograph_shows(camera: Camera) -> None:
    canvas = make_canvas(camera, 1.0)
    height, width = camera.height, camera.width
    rgb, mask = lay_out(canvas, np.full((height, width, 3), 200, np.uint8), None)
    v, u = np.mgrid[: rgb.shape[0], : rgb.shape[1]] + 0.5
    fx, fy, cx, cy = canvas.k
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1).reshape(-1, 3)
    place = project(camera, rays)
    back = pixels_to_normalized(camera, place)
    true = np.isfinite(back).all(axis=1) & (np.abs(back - rays[:, :2]).max(axis=1) < 1e-6)
    true &= (place >= 0).all(axis=1) & (place <= [width, height]).all(axis=1)
    found = np.ones(len(rays), bool) if mask is None else mask.ravel()
    assert (found != true).mean() < 2e-3
    # nearly all of the photograph is on it: what a wide lens shows at its rim may be left out
    assert true.sum() > 0.7 * width * height


def test_no_distortion_no_resampling() -> None:
    image = np.random.default_rng(0).integers(0, 255, (140, 200, 3)).astype(np.uint8)
    rgb, mask = lay_out(make_canvas(PINHOLE, 1.0), image, None)
    np.testing.assert_array_equal(rgb, image)
    assert mask is None
    half, _ = lay_out(make_canvas(PINHOLE, 2.0), image, None)
    mean = image.reshape(70, 2, 100, 2, 3).mean(axis=(1, 3))
    assert np.abs(half - mean).max() <= 0.51


@given(st.integers(20, 300), st.integers(20, 300), st.sampled_from([1.0, 2.0, 3.0, 4.0, 1.3, 2.71]))
def test_the_rays_of_a_canvas_stay(width: int, height: int, shrink: float) -> None:
    camera = Camera(CameraModel.PINHOLE, width, height, np.array([100.0, 110.0, width / 2 + 3, height / 2 - 2]))
    canvas = make_canvas(camera, shrink)
    w, h = canvas.working_size
    # the corner of the canvas is the corner of the photograph, its far end where the canvas ends
    fx, fy, cx, cy = canvas.k
    np.testing.assert_allclose([(0 - cx) / fx, (0 - cy) / fy], (-camera.canonical[2:4]) / camera.canonical[:2])
    far = (np.array([canvas.width, canvas.height]) - camera.canonical[2:4]) / camera.canonical[:2]
    np.testing.assert_allclose([(w - cx) / fx, (h - cy) / fy], far)
    assert width - canvas.width < shrink
    assert height - canvas.height < shrink


def test_a_whole_scene_projects_its_points_where_they_are_seen(tmp_path: Path) -> None:
    model = write_wall(tmp_path, camera=BARREL)
    scene = scene_of(tmp_path, model)
    assert len(scene.views) == 5
    assert len(scene.point_xyz) == model.tracks.num_tracks
    for m, view in enumerate(scene.views):
        fx, fy, cx, cy = view.k
        seen = rigid3.apply(view.cam_from_world, scene.point_xyz)
        flat = Camera(CameraModel.PINHOLE, view.width, view.height, np.array([fx, fy, cx, cy]))
        xy = project(flat, seen)
        assert (xy[:, 0] > -30).all()
        idx = np.repeat(np.arange(len(scene.point_xyz)), np.diff(scene.point_ptr))[scene.point_view_idx == m]
        # the colours at the points are those of the other views
        inside = idx[(xy[idx] > 2).all(axis=1) & (xy[idx] < [view.width - 2, view.height - 2]).all(axis=1)]
        assert len(inside) > 20


# --------------------------------------------------------------------------------------------------- resolution, masks


def test_resolution(tmp_path: Path) -> None:
    model = write_wall(tmp_path)
    assert scene_of(tmp_path, model).views[0].rgb.shape == (140, 200, 3)
    small = scene_of(tmp_path, model, DenseOptions(level=1)).views[0]
    assert small.rgb.shape == (70, 100, 3)
    np.testing.assert_allclose(small.k, np.array([180.0, 181.0, 101.3, 68.6]) / 2)
    # a pixel at full resolution measures depth / focal
    wanted = 2.5 * DEPTH / PINHOLE.focal
    view = scene_of(tmp_path, model, DenseOptions(ground_sampling=wanted)).views[2]
    assert DEPTH / view.k[:2].mean() == pytest.approx(wanted, rel=0.03)
    huge = replace(PINHOLE, width=6000, height=4200, params=PINHOLE.params * 30)
    poses = row_of_poses(3)
    large = make_model([huge] * 3, poses)
    found = find_photographs(model, tmp_path / "images", ImageOptions(), is_upright=False)
    three = replace(found, image_idx=np.arange(3), records=found.records[:3], cameras=(huge,) * 3)
    plan, report = plan_views(large, three, DenseOptions())
    assert report["shrink"] == [4.0, 4.0, 4.0]
    assert plan.canvases[0].working_size == (1500, 1050)


def test_masks_alpha_and_smaller_photographs(tmp_path: Path) -> None:
    model = write_wall(tmp_path)
    masks = tmp_path / "masks"
    masks.mkdir()
    mask = np.full((140, 200), 255, np.uint8)
    mask[:, :50] = 0
    cv2.imwrite(str(masks / "view_0.png.png"), mask)
    path = tmp_path / "images" / "view_1.png"
    image = cv2.imread(str(path))
    alpha = np.full((140, 200, 1), 255, np.uint8)
    alpha[:70] = 0
    cv2.imwrite(str(path), np.concatenate([image, alpha], axis=2))
    half = cv2.resize(cv2.imread(str(tmp_path / "images" / "view_2.png")), (100, 70), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(tmp_path / "images" / "view_2.png"), half)
    views = load_scene(plan_of(tmp_path, model, masks=masks)).views
    assert views[0].mask is not None
    np.testing.assert_array_equal(views[0].mask, mask > 0)
    assert views[1].mask is not None
    np.testing.assert_array_equal(views[1].mask, alpha[..., 0] > 0)
    assert (views[1].rgb[:70] == 255).all()
    np.testing.assert_array_equal(views[1].rgb[70:], image[70:, :, ::-1])
    assert views[2].rgb.shape == (70, 100, 3)
    np.testing.assert_allclose(views[2].k, np.array([180.0, 181.0, 101.3, 68.6]) / 2)
    assert views[3].mask is None


def test_masks_that_fit_nothing_are_an_error(tmp_path: Path) -> None:
    model = write_wall(tmp_path)
    (tmp_path / "masks").mkdir()
    with pytest.raises(InputError, match=r"no mask in .* fits"):
        plan_of(tmp_path, model, masks=tmp_path / "masks")


@pytest.mark.parametrize("is_upright", [True, False])
def test_photographs_are_held_as_the_model_has_them(tmp_path: Path, is_upright: bool) -> None:
    from PIL import Image

    model = write_wall(tmp_path, 3)
    upright = [np.asarray(Image.open(tmp_path / "images" / name)) for name in model.image_names]
    for name, pixels in zip(model.image_names, upright, strict=True):
        exif = Image.Exif()
        exif[274] = 3  # upside down
        stored = np.ascontiguousarray(pixels[::-1, ::-1]) if is_upright else pixels
        Image.fromarray(stored).save(tmp_path / "images" / name, exif=exif)
    views = load_scene(plan_of(tmp_path, model, is_upright=is_upright)).views
    for view, pixels in zip(views, upright, strict=True):
        np.testing.assert_array_equal(view.rgb, pixels)


def test_a_turned_photograph_is_known_by_its_shape(tmp_path: Path) -> None:
    from PIL import Image

    model = write_wall(tmp_path, 3)
    path = tmp_path / "images" / "view_1.png"
    pixels = np.asarray(Image.open(path))
    exif = Image.Exif()
    exif[274] = 6  # turn by 90 degrees to see it upright
    Image.fromarray(np.ascontiguousarray(np.rot90(pixels))).save(path, exif=exif)
    for is_upright in (True, False):
        np.testing.assert_array_equal(load_scene(plan_of(tmp_path, model, is_upright=is_upright)).views[1].rgb, pixels)


# ---------------------------------------------------------------------------------------------------------- bad input


def test_photographs_that_are_gone(tmp_path: Path) -> None:
    model = write_wall(tmp_path)
    told: list[Event] = []
    (tmp_path / "images" / "view_3.png").unlink()
    plan = plan_of(tmp_path, model, events=Events(told.append))
    assert plan.names == ("view_0.png", "view_1.png", "view_2.png", "view_4.png")
    warnings = [event.message for event in told if event.kind == "warned"]
    assert any("view_3.png" in text and str(tmp_path / "images") in text for text in warnings)
    for m in (1, 2, 4):
        (tmp_path / "images" / f"view_{m}.png").unlink()
    with pytest.raises(InputError, match="1 usable images"):
        plan_of(tmp_path, model)
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    with pytest.raises(InputError, match=r"5 of 5 images .*view_0.png: no such file") as caught:
        plan_of(tmp_path, model)
    assert "--images" in str(caught.value.advice)


def test_photographs_of_another_shape(tmp_path: Path) -> None:
    model = write_wall(tmp_path)
    cv2.imwrite(str(tmp_path / "images" / "view_2.png"), np.zeros((100, 200, 3), np.uint8))
    with pytest.raises(InputError, match=r"view_2.png: 200x100 pixels, .* has 200x140"):
        plan_of(tmp_path, model)


def test_copies_are_left_out(tmp_path: Path) -> None:
    poses = row_of_poses(4)
    poses[3] = poses[1]
    poses[3, 4] += 1e-5
    model = make_model([PINHOLE] * 4, poses)
    wall = texture()
    (tmp_path / "images").mkdir()
    for name, pose in zip(model.image_names, poses, strict=True):
        cv2.imwrite(str(tmp_path / "images" / name), see_wall(PINHOLE, pose, wall))
    first = (tmp_path / "images" / "view_1.png").read_bytes()
    (tmp_path / "images" / "view_3.png").write_bytes(first)
    told: list[Event] = []
    plan = plan_of(tmp_path, model, events=Events(told.append))
    assert plan.names == ("view_0.png", "view_1.png", "view_2.png")
    assert any("view_3.png" in event.message and "copies" in event.message for event in told if event.kind == "warned")
    for name in model.image_names:
        (tmp_path / "images" / name).write_bytes(first)
    together = replace(model, cam_from_world=np.tile(poses[1], (4, 1)))
    with pytest.raises(NoReconstructionError, match="copies"):
        plan_of(tmp_path, together)


def test_one_place_is_no_baseline(tmp_path: Path) -> None:
    model = write_wall(tmp_path, 4, step=0.001)
    with pytest.raises(NoReconstructionError, match="one place"):
        plan_of(tmp_path, model)


# ---------------------------------------------------------------------------------------------------------- neighbours


def select(
    poses: NDArray[np.float64], num_points: int, max_neighbors: int = 4, focal: NDArray[np.float64] | None = None
) -> NDArray[np.int32]:
    camera = replace(PINHOLE, width=800, height=560, params=np.array([180.0, 180.0, 400.0, 280.0]))
    model = make_model([camera] * len(poses), poses, num_points)
    tracks = model.tracks
    focal = np.full(len(poses), 180.0) if focal is None else focal
    ptr = tracks.track_ptr.astype(np.int64)
    return select_neighbors(focal, poses, model.point_xyz, ptr, tracks.obs_image_idx, max_neighbors)[0]


@pytest.mark.parametrize("num_points", [200, 0], ids=["points", "cameras"])
def test_neighbours_have_a_baseline_and_are_near(num_points: int) -> None:
    # 2.9 degrees apart as seen from the wall, the last a copy of the first
    poses = row_of_poses(15, 0.2)
    poses = np.concatenate([poses, poses[:1]])
    poses[15, 4] += 1e-4
    neighbors = select(poses, num_points)
    centers = rigid3.center(poses)
    rays = centers - [0.0, 0.0, DEPTH]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for m, row in enumerate(neighbors):
        assert (row >= 0).all()
        assert len(set(row.tolist()) | {m}) == 5
        angle = np.degrees(np.arccos(np.clip(rays[row] @ rays[m], -1, 1)))
        assert angle.min() > 1.5
        assert angle.max() < 25.0
        assert 5.0 < np.median(angle) < 20.0
    assert 15 not in neighbors[0]
    assert 0 not in neighbors[15]


def test_a_like_scale_is_preferred() -> None:
    poses = row_of_poses(5, 0.7)
    alike = select(poses, 200, 2)
    assert set(alike[2].tolist()) == {1, 3}
    mixed = select(poses, 200, 2, np.array([180.0, 18.0, 180.0, 18.0, 180.0]))
    assert set(mixed[2].tolist()) == {0, 4}


def test_views_that_look_elsewhere_are_no_neighbours() -> None:
    poses = row_of_poses(4)
    turned = rigid3.exp_so3(np.array([0.0, np.pi, 0.0])) @ rigid3.rotation_matrix(poses[3])
    poses[3] = rigid3.from_matrix(turned, -turned @ rigid3.center(poses)[3])
    neighbors = select(poses, 0)
    assert (neighbors[3] == -1).all()
    assert not (neighbors[:3] == 3).any()


def test_where_axes_meet() -> None:
    poses = row_of_poses(5)
    rotation, center = rigid3.rotation_matrix(poses), rigid3.center(poses)
    place = meeting_point(center, rotation[:, 2])
    np.testing.assert_allclose(place, [0.0, 0.0, DEPTH], atol=0.05)
    # parallel axes meet nowhere: ahead, where neighbours are ten degrees apart
    ahead = meeting_point(np.array([[x, 0.0, 0.0] for x in range(5)], float), np.tile([0.0, 0.0, 1.0], (5, 1)))
    np.testing.assert_allclose(ahead, [2.0, 0.0, 1 / np.radians(10.0)], rtol=1e-6)


def test_a_part_of_a_plan(tmp_path: Path) -> None:
    model = write_wall(tmp_path, 6)
    plan = plan_of(tmp_path, model, DenseOptions(max_neighbors=3))
    whole, part = load_scene(plan, threads=2), load_scene(part_of(plan, np.array([1, 2, 4]), np.array([2])))
    assert [view.name for view in part.views] == ["view_1.png", "view_2.png", "view_4.png"]
    np.testing.assert_array_equal(part.views[2].rgb, whole.views[4].rgb)
    assert (part.neighbors[[0, 2]] == -1).all()
    wanted = [[1, 2, 4].index(s) for s in plan.neighbors[2] if s in (1, 2, 4)]
    assert part.neighbors[1].tolist() == wanted + [-1] * (3 - len(wanted))
    assert (np.diff(part.point_ptr) >= 2).all()
    for p, xyz in enumerate(part.point_xyz):
        at = int(np.flatnonzero((whole.point_xyz == xyz).all(axis=1))[0])
        seen = whole.point_view_idx[whole.point_ptr[at] : whole.point_ptr[at + 1]]
        mine = part.point_view_idx[part.point_ptr[p] : part.point_ptr[p + 1]]
        assert [[1, 2, 4][v] for v in mine] == [s for s in seen if s in (1, 2, 4)]


# --------------------------------------------------------------------------------------------------------------- files


def some_patches(n: int = 50) -> Patches:
    rng = np.random.default_rng(3)
    counts = rng.integers(2, 5, n)
    normal = rng.normal(size=(n, 3)).astype(np.float32)
    return Patches(
        rng.normal(size=(n, 3)) + 4e5, normal / np.linalg.norm(normal, axis=1, keepdims=True),
        rng.integers(0, 255, (n, 3)).astype(np.uint8), rng.random(n, np.float32), rng.random(n, np.float32),
        rng.random(n, np.float32), rng.integers(0, 9, n).astype(np.int32), np.concatenate([[0], np.cumsum(counts)]),
        np.concatenate([rng.permutation(5)[:c] for c in counts]).astype(np.int32),
    )  # fmt: skip


def test_patches_come_back_as_they_were(tmp_path: Path) -> None:
    patches, names = some_patches(), ("a.jpg", "b/ü.jpg", "c.png", "d", "e")
    write_patches(tmp_path / "patches.npz", patches, names)
    back, back_names = read_patches(tmp_path / "patches.npz")
    assert back_names == names
    for name in ("xyz", "normal", "rgb", "score", "sigma", "size", "wave", "view_ptr", "view_idx"):
        np.testing.assert_array_equal(getattr(back, name), getattr(patches, name))
    with np.load(tmp_path / "patches.npz", allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["reference"], patches.reference_idx)
    empty = patches.subset(np.zeros(len(patches), bool))
    write_patches(tmp_path / "empty.npz", empty, names)
    assert len(read_patches(tmp_path / "empty.npz")[0]) == 0


def test_damaged_patches_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "patches.npz"
    write_patches(path, some_patches(), "abcde")
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    wrong = {
        "format": np.array("sfmapp patches 99"),
        "view_idx": arrays["view_idx"] + 1,
        "view_ptr": arrays["view_ptr"][::-1].copy(),
        "xyz": np.full_like(arrays["xyz"], np.nan),
        "normal": arrays["normal"].astype(np.float64),
        "score": arrays["score"][1:],
        "names": np.arange(5),
    }
    for name, value in wrong.items():
        with path.open("wb") as file:
            np.savez(file, **(arrays | {name: value}))
        with pytest.raises(InputError, match=r"patches\.npz"):
            read_patches(path)
    for data in (b"", b"PK\3\4 no archive", path.read_bytes()[:400]):
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"patches\.npz"):
            read_patches(path)
    np.save(path.with_suffix(".npy"), np.array([{}], object), allow_pickle=True)
    with pytest.raises(InputError):
        read_patches(path.with_suffix(".npy"))
    with pytest.raises(InputError, match="No such file"):
        read_patches(tmp_path / "none.npz")


def test_the_fused_cloud_has_what_it_promises(tmp_path: Path) -> None:
    patches = some_patches()
    write_fused_ply(tmp_path / "fused.ply", patches)
    header = (tmp_path / "fused.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert header[3:] == [
        "property double x", "property double y", "property double z", "property float nx", "property float ny",
        "property float nz", "property uchar red", "property uchar green", "property uchar blue",
        "property uchar views", "property float score", "property float sigma",
    ]  # fmt: skip
    back = read_ply_geometry(tmp_path / "fused.ply")
    np.testing.assert_array_equal(back.xyz, patches.xyz)
    np.testing.assert_array_equal(back.rgb, patches.rgb)
    np.testing.assert_array_equal(back.normal, patches.normal)
    body = (tmp_path / "fused.ply").read_bytes().partition(b"end_header\n")[2]
    vertices = np.frombuffer(body, [(line.split()[2], "<" + TYPES[line.split()[1]]) for line in header[3:]])
    np.testing.assert_array_equal(vertices["views"], patches.num_views)
    np.testing.assert_array_equal(vertices["sigma"], patches.sigma)


# ---------------------------------------------------------------------------------------------------------------- maps


def test_a_map_shows_planes_and_what_is_in_front() -> None:
    k, width, height = np.array([100.0, 100.0, 40.0, 30.0]), 80, 60
    pose = row_of_poses(3)[2]
    rotation, center = rigid3.rotation_matrix(pose), rigid3.center(pose)
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])

    def on_plane(offset: float, columns: range) -> NDArray[np.float64]:
        v, u = np.meshgrid(np.arange(0, height, 2) + 1.0, np.array(columns) + 1.0)
        rays = np.stack([(u - 40.0) / 100.0, (v - 30.0) / 100.0, np.ones_like(u)], -1).reshape(-1, 3)
        seen = rays * (-offset / (rays @ normal))[:, None]
        return (seen - pose[4:]) @ rotation

    far, near = on_plane(4.0, range(0, 80, 2)), on_plane(3.0, range(0, 40, 2))
    xyz = np.concatenate([near, far, center[None] - rotation[2] * 2])
    normals = np.tile(normal @ rotation, (len(xyz), 1))
    depth, turned = splat_view(k, pose, width, height, xyz, normals, 1.0)
    v, u = np.mgrid[:height, :width] + 0.5
    slope = ((u - 40.0) / 100.0) * normal[0] + ((v - 30.0) / 100.0) * normal[1] + normal[2]
    expected = -np.where(u < 40, 3.0, 4.0) / slope
    assert np.isfinite(depth).all()
    clear = np.abs(u - 40) > 2
    np.testing.assert_allclose(depth[clear], expected[clear], rtol=1e-5)
    np.testing.assert_allclose(turned, np.broadcast_to(normal, turned.shape), atol=1e-6)
    none, flat = splat_view(k, pose, width, height, xyz[:0], normals[:0], 1.0)
    assert np.isnan(none).all()
    assert not flat.any()
