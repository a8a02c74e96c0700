"""Maps of keyframes, the adjustment beside them, and how a map begins."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import odometry_sequences as played
from sfmapp.camera.camera import CameraModel, project, simple_camera
from sfmapp.geometry import rigid3
from sfmapp.odometry.frontend.alignment import align_patches
from sfmapp.odometry.frontend.pyramid import build_pyramid
from sfmapp.odometry.initialize import MapInitializer, TwoViews
from sfmapp.odometry.map.backend import LAG, Backend, choose_window, classify, make_job, take_over
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.options import OdometryOptions
from sfmapp.scene.correspondences import TwoViewConfig
from sfmapp.scene.rig import Rig
from sfmapp.scene.synthetic import make_scene, synthetic_rig

Array = np.ndarray
OPTIONS = OdometryOptions()
CAMERA = simple_camera(CameraModel.PINHOLE, 640, 480, 525.0)
MONO = Rig.single(CAMERA)


def mono_map(seed: int = 0, num_keyframes: int = 12, sigma_px: float = 0.3) -> tuple[KeyframeMap, Array]:
    scene = make_scene(seed, num_keyframes, 250, CAMERA, sigma_px=sigma_px, layout="forward")
    return played.keyframe_map(scene, MONO), scene.ground_truth.cam_from_world


# ------------------------------------------------------------------ the map


@pytest.mark.parametrize("rig", [MONO, synthetic_rig()], ids=["mono", "stereo"])
def test_a_reconstruction_holds_what_went_in(rig: Rig) -> None:
    num_sensors = len(rig.cameras)
    arguments = {"rig": rig} if num_sensors > 1 else {"cameras": rig.cameras[0]}
    scene = make_scene(2, 5 * num_sensors, 120, **arguments)
    keyframes = played.keyframe_map(scene, rig)
    model, point_id = keyframes.reconstruction(np.arange(5))
    given, tracks = scene.observed.tracks, model.tracks
    np.testing.assert_array_equal(point_id, np.unique(given.obs_track_idx))
    np.testing.assert_array_equal(point_id[tracks.obs_track_idx], given.obs_track_idx)
    np.testing.assert_array_equal(tracks.obs_image_idx, given.obs_image_idx)
    np.testing.assert_array_equal(tracks.obs_xy, given.obs_xy)
    np.testing.assert_allclose(model.cam_from_world, scene.observed.cam_from_world, atol=1e-12)
    np.testing.assert_array_equal(model.point_xyz, scene.observed.point_xyz[point_id])
    assert model.obs_is_inlier.all()
    # features are positions in the keyframe
    for k, keyframe in enumerate(keyframes.keyframes):
        for s in range(num_sensors):
            obs = tracks.observations_of_image(num_sensors * k + s)
            np.testing.assert_array_equal(keyframe.xy[tracks.obs_feature_idx[obs], s], tracks.obs_xy[obs])


def test_outliers_and_unknown_points_are_no_inliers() -> None:
    keyframes, _ = mono_map()
    keyframes.keyframes[3].is_inlier[:4] = False
    lost = keyframes.keyframes[5].point_id[7]
    keyframes.point_xyz[lost] = np.nan
    model, point_id = keyframes.reconstruction(np.arange(12))
    obs = model.tracks.observations_of_image(3)
    flags = dict(zip(model.tracks.obs_feature_idx[obs], model.obs_is_inlier[obs], strict=True))
    assert not any(flags[f] for f in range(4))
    assert not model.obs_is_inlier[point_id[model.tracks.obs_track_idx] == lost].any()


def test_room_grows_and_counts_stay() -> None:
    keyframes = KeyframeMap(MONO)
    first = keyframes.new_points(1000)
    keyframes.point_xyz[first] = 1.0
    ids = np.arange(5)
    one = Keyframe(0, 0.0, "a", rigid3.IDENTITY, ids, np.zeros((5, 1, 2)), np.ones((5, 1), bool))
    keyframes.append(one)
    more = keyframes.new_points(5000)
    np.testing.assert_array_equal(more, np.arange(1000, 6000))
    assert keyframes.num_points == 6000
    assert not keyframes.is_triangulated(more).any()
    assert keyframes.is_triangulated(first).all()
    xy = np.zeros((3, 1, 2))
    xy[2] = np.nan
    keyframes.append(Keyframe(1, 1.0, "b", rigid3.IDENTITY, np.array([1, 4, 5999]), xy, np.isfinite(xy[:, :, 0])))
    wanted = np.array([0, 1, 4, 5999])
    np.testing.assert_array_equal(keyframes.num_observations(wanted), [1, 2, 2, 0])
    keyframes.recount()
    np.testing.assert_array_equal(keyframes.num_observations(wanted), [1, 2, 2, 0])


# ------------------------------------------------------------------ the back end


def test_an_adjustment_counts_at_the_promised_frame_and_no_sooner() -> None:
    keyframes, _ = mono_map()
    before = np.array([k.rig_from_world for k in keyframes.keyframes])
    with ThreadPoolExecutor(1) as executor:
        backend = Backend(executor)
        backend.begin(make_job(keyframes, *choose_window(keyframes, OPTIONS)), 100)
        executor.submit(lambda: None).result()  # it is done long since
        for frame in range(100, 100 + LAG):
            assert not backend.finish(keyframes, frame)
            np.testing.assert_array_equal([k.rig_from_world for k in keyframes.keyframes], before)
        assert backend.finish(keyframes, 100 + LAG)
        assert not backend.finish(keyframes, 100 + LAG)
    after = np.array([k.rig_from_world for k in keyframes.keyframes])
    moved = (before != after).any(1)
    np.testing.assert_array_equal(moved, np.arange(12) >= 2)  # a window of ten


def test_tracking_waits_for_a_late_adjustment() -> None:
    keyframes, _ = mono_map()
    gate = threading.Event()
    with ThreadPoolExecutor(1) as executor:
        executor.submit(gate.wait)
        backend = Backend(executor)
        backend.begin(make_job(keyframes, *choose_window(keyframes, OPTIONS)), 0)
        assert not backend.finish(keyframes, 1)
        threading.Timer(0.1, gate.set).start()
        assert backend.finish(keyframes, LAG)
    assert backend.num_jobs == 1


def center_errors(keyframes: KeyframeMap, ground_truth: Array) -> Array:
    centers = rigid3.center(np.array([k.rig_from_world for k in keyframes.keyframes]))
    return np.linalg.norm(centers - rigid3.center(ground_truth), axis=1)


def test_the_window_brings_poses_back() -> None:
    keyframes, ground_truth = mono_map(sigma_px=0.2)
    rng = np.random.default_rng(0)
    for keyframe in keyframes.keyframes[8:]:
        keyframe.rig_from_world = rigid3.compose(
            rigid3.from_matrix(rigid3.exp_so3(rng.normal(0, 0.01, 3)), rng.normal(0, 0.05, 3)), keyframe.rig_from_world
        )
    before = center_errors(keyframes, ground_truth)[8:].max()
    with ThreadPoolExecutor(1) as executor:
        backend = Backend(executor)
        for frame in range(3):
            backend.begin(make_job(keyframes, *choose_window(keyframes, OPTIONS)), frame)
            backend.finish(keyframes)
    assert 1e-4 < center_errors(keyframes, ground_truth)[8:].max() < 0.4 * before


def test_points_with_support_elsewhere_are_kept() -> None:
    keyframes, _ = mono_map(sigma_px=0.0)
    chosen = np.arange(3, 12)
    job = make_job(keyframes, chosen, chosen > 3)
    counts = np.bincount(job.model.tracks.obs_track_idx, minlength=len(job.point_id))
    np.testing.assert_array_equal(job.num_elsewhere + counts, keyframes.num_observations(job.point_id))
    elsewhere, only_here = np.flatnonzero(job.num_elsewhere >= 2)[0], np.flatnonzero(job.num_elsewhere == 0)[0]
    for track in (elsewhere, only_here):  # all that the window sees of them is wrong
        job.model.tracks.obs_xy[job.model.tracks.obs_track_idx == track] += 50.0
    sigma = classify(job.model, job.num_elsewhere)
    assert sigma < 1e-6
    take_over(job, keyframes)
    assert keyframes.is_triangulated(job.point_id[[elsewhere]]).all()
    assert not keyframes.is_triangulated(job.point_id[[only_here]]).any()
    for k in chosen:
        seen = keyframes.keyframes[k]
        wrong = np.isin(seen.point_id, job.point_id[[elsewhere, only_here]])
        assert not seen.is_inlier[wrong].any()


def test_what_was_added_meanwhile_stays() -> None:
    keyframes, _ = mono_map()
    with ThreadPoolExecutor(1) as executor:
        backend = Backend(executor)
        backend.begin(make_job(keyframes, *choose_window(keyframes, OPTIONS)), 0)
        new = keyframes.new_points(10)
        keyframes.point_xyz[new] = 3.0
        pose = np.array([0, 0, 0, 1.0, 7, 8, 9])
        xy = np.full((10, 1, 2), 5.0)
        keyframes.append(Keyframe(500, 50.0, "new", pose, new, xy, np.ones((10, 1), bool)))
        assert backend.finish(keyframes)
    np.testing.assert_array_equal(keyframes.point_xyz[new], 3.0)
    np.testing.assert_array_equal(keyframes.keyframes[-1].rig_from_world, pose)


# ------------------------------------------------------------------ two views


class Plane:
    """A wall at z = 4 with blotches of all sizes; the camera moves before it."""

    def __init__(self, seed: int, slope: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        self.k = 2 * np.pi / np.exp(rng.uniform(np.log(0.08), np.log(1.0), 80))
        self.direction, self.phase = rng.uniform(0, np.pi, 80), rng.uniform(0, 2 * np.pi, 80)
        self.slope = slope

    def photograph(self, pose: Array, seed: int) -> Array:
        cam = played.PINHOLE
        y, x = np.mgrid[: cam.height, : cam.width] + 0.5
        rays = np.stack([(x - 160) / 262, (y - 120) / 262, np.ones_like(x)], -1) @ rigid3.rotation_matrix(pose)
        center = rigid3.center(pose)
        # z = 4 + slope |x|: two walls that meet in an edge, or one
        u = np.zeros_like(x)
        for _ in range(30):
            u = center[0] + rays[..., 0] * (4 + self.slope * np.abs(u) - center[2]) / rays[..., 2]
        v = center[1] + rays[..., 1] * (4 + self.slope * np.abs(u) - center[2]) / rays[..., 2]
        value = np.zeros_like(x)
        for k, d, p in zip(self.k, self.direction, self.phase, strict=True):
            value += np.cos(k * (u * np.cos(d) + v * np.sin(d)) + p)
        noise = np.random.default_rng(seed).normal(0, 1.5, x.shape)
        return np.clip(128 + 40 * value / np.sqrt(40) + noise, 0, 255).astype(np.uint8)


def begin(slope: float, poses: Array) -> tuple[TwoViews | None, MapInitializer]:
    plane, initializer = Plane(1, slope), MapInitializer(played.PINHOLE, OPTIONS, 0)
    for n, pose in enumerate(poses):
        views = initializer.add(build_pyramid(plane.photograph(pose, n)))
        if views is not None:
            return views, initializer
    return None, initializer


def poses_along(direction: Array, turn: Array, num: int) -> Array:
    share = np.arange(num)[:, None]
    rotation = rigid3.exp_so3(share * turn)
    return rigid3.from_matrix(rotation, -np.einsum("nij,nj->ni", rotation, share * direction))


@pytest.mark.parametrize("slope", [0.0, 0.8], ids=["one plane", "two planes"])
def test_two_views_of_known_pose(slope: float) -> None:
    poses = poses_along(np.array([0.04, 0.01, 0.0]), np.array([0.0, 0.004, 0.002]), 25)
    views, initializer = begin(slope, poses)
    if views is None:  # a plane that cannot be told from its mirror image is no map: waiting is honest
        assert slope == 0.0
        assert initializer.reason
        return
    ground_truth = poses[len(initializer.seen) - 1]
    found = views.last_from_first
    turn = rigid3.rotation_matrix(found) @ rigid3.rotation_matrix(ground_truth).T
    assert np.degrees(np.linalg.norm(rigid3.log_so3(turn))) < 0.35
    a, b = rigid3.center(found), rigid3.center(ground_truth)
    assert np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))) < 4.0
    # depths, in the unit in which their median is one
    assert np.median(views.xyz[:, 2]) == pytest.approx(1.0, abs=1e-9)
    # the points lie on the walls
    unit = np.linalg.norm(b) / np.linalg.norm(a)
    x, z = unit * views.xyz[:, 0], unit * views.xyz[:, 2]
    off = np.abs(z / (4 + slope * np.abs(x)) - 1)
    assert 1e-4 < np.median(off) < 0.06
    np.testing.assert_allclose(project(played.PINHOLE, views.xyz), initializer.corners[views.track], atol=1e-6)
    assert views.num_inliers >= 40
    assert views.median_angle_deg > 0.8


def test_a_rotation_makes_no_two_views() -> None:
    views, initializer = begin(0.8, poses_along(np.zeros(3), np.array([0.002, 0.008, 0.0]), 25))
    assert views is None
    assert TwoViewConfig.PANORAMIC.name in initializer.reason or "corners" in initializer.reason


def test_no_motion_makes_no_two_views() -> None:
    views, initializer = begin(0.8, poses_along(np.zeros(3), np.zeros(3), 6))
    assert views is None
    assert "motion" in initializer.reason


def test_black_and_plain_images_make_no_two_views() -> None:
    initializer = MapInitializer(played.PINHOLE, OPTIONS, 0)
    for value in (0, 0, 128, 255, 255):
        assert initializer.add(build_pyramid(np.full((240, 320), value, np.uint8))) is None


# ------------------------------------------------------------------ memory that was never written


def fill_free_memory(fill: float) -> None:
    """Leave garbage in the blocks of memory that this thread is given next."""
    kept = [np.full(size, fill, np.float32) for size in range(500, 9000, 7) for _ in range(2)]
    del kept


def test_warped_patches_do_not_depend_on_what_lay_in_memory() -> None:
    """The same patches give the same bytes, whatever was in the memory that they are worked on in."""
    plane = Plane(2, 0.5)
    poses = poses_along(np.array([0.06, 0.0, 0.0]), np.zeros(3), 2)
    one, other = (build_pyramid(plane.photograph(pose, n)) for n, pose in enumerate(poses))
    y, x = np.mgrid[10:230:14, 10:310:14]
    xy = np.stack([x.ravel(), y.ravel()], 1) + 0.37
    warps = np.eye(2) + np.random.default_rng(0).normal(0, 0.06, (len(xy), 2, 2))

    def aligned(_: int = 0) -> tuple[bytes, ...]:
        found = align_patches(one, xy, other, xy, affine=warps, coarsest_level=2)
        assert found.is_converged.mean() > 0.5
        return found.xy.tobytes(), found.zncc.tobytes(), found.is_converged.tobytes()

    calm = aligned()
    for fill in (np.nan, np.inf, 1e38, -1e38, 1e6, 0.0):
        fill_free_memory(fill)
        assert aligned() == calm
    # and from several threads at once, each with memory of its own
    with ThreadPoolExecutor(4) as executor:
        assert set(executor.map(aligned, range(40))) == {calm}
