"""Rendered sequences: the image shows what the geometry says, and the ground truth beside it is the ground truth."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rendered_worlds import sequences as rendered
from rendered_worlds import textures
from rendered_worlds.motion import GRAVITY, ImuOptions, Motion, control_spline, measure_inertia, tremor
from rendered_worlds.rendering import Atlas, Optics, Renderer, World, moved_camera
from rendered_worlds.sequences import RenderedSequence
from rendered_worlds.worlds import Skin, WorldBuilder
from sfmapp.camera.camera import Camera, CameraModel, pixels_to_normalized, project
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import SequenceOptions
from sfmapp.scene.rig import Rig
from sfmapp.sequences.open import open_sequence

Array = NDArray[np.float64]

PINHOLE = Camera(CameraModel.PINHOLE, 160, 120, np.array([140.0, 141.0, 79.3, 61.2]))
BARREL = Camera(CameraModel.OPENCV, 160, 120, np.array([98.0, 97.5, 78.4, 62.3, -0.283, 0.074, 2e-4, 2e-5]))
FISHEYE = Camera(CameraModel.OPENCV_FISHEYE, 160, 120, np.array([70.0, 70.0, 80.5, 59.0, 0.01, -0.003, 0.002, -0.001]))
QUIET = Optics(noise_sigma=0.0, vignetting=0.0)


def builder(seed: int = 0) -> WorldBuilder:
    return WorldBuilder(np.random.default_rng(seed))


def smooth(size: int = 256, cells: int = 8, seed: int = 3) -> NDArray[np.uint8]:
    """A texture without detail below some twenty texels, so that sampling it costs next to nothing."""
    values = 128 + 30 * textures.noise(np.random.default_rng(seed), size, cells, 1)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def looking(world_point: tuple[float, float, float], away: float, yaw: float = 0.0, pitch: float = 0.0) -> Array:
    """A pose that looks along world +x at a point from a distance, turned a little."""
    rotation = rigid3.exp_so3(np.array([pitch, yaw, 0.0])) @ np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    return rigid3.from_matrix(rotation, -rotation @ (np.array(world_point) - [away, 0.0, 0.0]))


@cache
def dots_on_wall() -> tuple[World, Array]:
    """A dark wall at x = 4 with bright round dots, and the dots' centres in the world."""
    size, metres = 1024, 8.0
    y, x = np.mgrid[:size, :size] + 0.5
    image, places = np.full((size, size), 20.0), []
    rng = np.random.default_rng(7)
    for row in range(80, size, 96):
        for column in range(80, size, 96):
            cx, cy = column + rng.uniform(-8, 8), row + rng.uniform(-8, 8)
            image += 200 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 8.0**2))
            places.append((cx, cy))
    build = builder()
    build.wall(
        (4.0, 0.0, 0.0),
        (-1.0, 0.0, 0.0),
        metres,
        metres,
        Skin(build.texture(np.rint(image).astype(np.uint8)), glows=True),
    )
    spots = np.array(places) / size * metres - metres / 2
    return build.build(), np.column_stack([np.full(len(spots), 4.0), -spots[:, 0], -spots[:, 1]])


def weighted_centres(image: NDArray[np.floating], near: Array, radius: int) -> Array:
    out = np.empty_like(near)
    for i, (x, y) in enumerate(near):
        c, r = int(x), int(y)
        patch = np.maximum(image[r - radius : r + radius + 1, c - radius : c + radius + 1].astype(float) - 25, 0)
        rows, columns = np.mgrid[r - radius : r + radius + 1, c - radius : c + radius + 1] + 0.5
        out[i] = (patch * columns).sum() / patch.sum(), (patch * rows).sum() / patch.sum()
    return out


@pytest.mark.parametrize("camera", [PINHOLE, BARREL, FISHEYE], ids=["pinhole", "barrel", "fisheye"])
def test_dots_are_where_the_camera_projects_them(camera: Camera) -> None:
    world, points = dots_on_wall()
    pose = looking((4.0, 0.3, -0.2), 3.5)
    expected = project(camera, rigid3.apply(pose, points))
    radius = 6
    # near the middle, where no lens bends a dot by much
    inside = np.linalg.norm(expected - camera.canonical[2:4], axis=1) < 45
    expected = expected[inside]
    assert len(expected) > 6
    found = weighted_centres(Renderer(world, camera).view(pose).grey, expected, radius)
    error = found - expected
    # seen straight on: perspective and the lens bend a dot by little; its centre is unbiased
    assert np.abs(error.mean(0)).max() < 0.02
    assert np.sqrt((error**2).mean()) < 0.06


@settings(max_examples=12, deadline=None)
@given(st.floats(-0.5, 0.5), st.floats(-0.4, 0.4), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_two_views_of_a_plane_differ_by_its_homography(yaw: float, pitch: float, dy: float, dz: float) -> None:
    world = plane_world()
    first, second = looking((4.0, 0.0, 0.0), 4.0), looking((4.0, dy, dz), 3.6, yaw, pitch)
    a, b = (Renderer(world, PINHOLE).view(pose) for pose in (first, second))
    relative = rigid3.compose(second, rigid3.inverse(first))
    # H = K (R + t n^T / d) K^-1 for the plane n^T X = d of the first camera (Hartley and Zisserman, eq. 13.2)
    rotation, d = rigid3.rotation_matrix(relative), 4.0
    k = PINHOLE.k_matrix
    h = k @ (rotation + np.outer(relative[4:], [0.0, 0.0, 1.0]) / d) @ np.linalg.inv(k)
    y, x = np.mgrid[: PINHOLE.height, : PINHOLE.width] + 0.5
    mapped = np.stack([x, y, np.ones_like(x)], -1) @ h.T
    mapped = mapped[..., :2] / mapped[..., 2:]
    inside = (mapped > 2).all(-1) & (mapped < [PINHOLE.width - 2, PINHOLE.height - 2]).all(-1)
    expected = bilinear(b.grey, mapped[inside])
    difference = a.grey[inside] - expected
    assert inside.sum() > 500
    assert np.abs(difference).mean() < 0.6  # of a contrast of 30
    assert abs(difference.mean()) < 0.25


def plane_world() -> World:
    build = builder()
    build.wall((4.0, 0.0, 0.0), (-1.0, 0.0, 0.0), 40.0, 40.0, Skin(build.texture(smooth()), 6.0, glows=True))
    return build.build()


def bilinear(image: NDArray[np.float32], xy: Array) -> Array:
    from scipy.ndimage import map_coordinates

    values: Array = map_coordinates(image.astype(np.float64), [xy[:, 1] - 0.5, xy[:, 0] - 0.5], order=3)
    return values


def test_depth_is_exact_and_disparity_is_focal_times_baseline_over_depth() -> None:
    build = builder()
    skin = Skin(build.texture(smooth()), 3.0, glows=True)
    build.inside((5.0, 6.0), 3.0, skin, skin, skin)
    build.box((2.0, 0.5, 0.0), (1.0, 0.7, 1.4), skin, 25.0)
    world = build.build()
    pose = looking((4.0, 0.0, 1.3), 5.0, 0.1, -0.05)
    baseline = 0.2
    other = pose + np.array([0, 0, 0, 0, -baseline, 0, 0])
    left, right = Renderer(world, PINHOLE).view(pose), Renderer(world, PINHOLE).view(other)
    y, x = np.mgrid[: PINHOLE.height, : PINHOLE.width] + 0.5
    rays = pixels_to_normalized(PINHOLE, np.stack([x.ravel(), y.ravel()], 1))
    points = np.column_stack([rays, np.ones(len(rays))]) * left.depth.ravel()[:, None].astype(np.float64)
    inside = rigid3.apply(rigid3.inverse(pose), points)
    box = rigid3.apply(
        rigid3.from_matrix(rigid3.exp_so3([0, 0, -np.radians(25)]), np.zeros(3)), inside - [2.0, 0.5, 0.7]
    )
    # every point lies on a wall or on the box
    to_wall = np.abs(np.abs(inside - [0, 0, 1.5]) - [5.0, 6.0, 1.5]).min(1)
    to_box = np.abs(np.abs(box) - [0.5, 0.35, 0.7]).min(1)
    assert np.minimum(to_wall, to_box).max() < 1e-5
    assert (np.abs(box) < [0.49, 0.34, 0.69]).all(1).sum() == 0
    # what the left image shows appears f b / z to the left in the right image
    shifted = x - PINHOLE.canonical[0] * baseline / left.depth
    column = np.round(shifted - 0.5).astype(int)
    ok = (column >= 1) & (column < PINHOLE.width - 2)
    rows = np.arange(PINHOLE.height)[:, None].repeat(PINHOLE.width, 1)
    same = ok & (right.surface[rows, column.clip(0, PINHOLE.width - 1)] == left.surface)
    assert same.sum() > 0.8 * ok.sum()
    values = bilinear(right.grey, np.stack([shifted[same], y[same]], 1))
    assert np.median(np.abs(values - left.grey[same])) < 0.5


def test_nearer_surfaces_hide_farther_ones_and_backs_are_not_seen() -> None:
    build = builder()
    near, far = (build.texture(np.full((4, 4), tone, np.uint8)) for tone in (200, 50))
    build.wall((6.0, 0.0, 0.0), (-1.0, 0.0, 0.0), 50.0, 50.0, Skin(far, glows=True))
    build.wall((3.0, 0.0, 0.0), (-1.0, 0.0, 0.0), 1.0, 1.0, Skin(near, glows=True))
    build.wall((2.0, 0.0, 0.0), (1.0, 0.0, 0.0), 1.0, 1.0, Skin(near, glows=True))  # its back
    view = Renderer(build.build(), PINHOLE).view(looking((0.0, 0.0, 0.0), 0.0))
    corners = project(PINHOLE, [[-0.5, -0.5, 3.0], [0.5, 0.5, 3.0]])
    y, x = np.mgrid[:120, :160] + 0.5
    inside = (x > corners[0, 0]) & (x < corners[1, 0]) & (y > corners[0, 1]) & (y < corners[1, 1])
    assert np.array_equal(view.surface == 1, inside)
    # the rim is grey by the share that is covered: their sum is the area
    covered = (view.grey.astype(np.float64) - 50).sum() / 150
    assert covered == pytest.approx(np.prod(corners[1] - corners[0]), rel=2e-3)


def test_textures_do_not_alias_when_they_are_far_away() -> None:
    rng = np.random.default_rng(0)
    build = builder()
    salt = build.texture((255 * rng.integers(0, 2, (256, 256))).astype(np.uint8))
    build.quad((-500, 500, 0), (1000, 0, 0), (0, -1000, 0), Skin(salt, 2.0, glows=True))
    renderer = Renderer(build.build(), PINHOLE)
    grey = renderer.view(looking((0.0, 0.0, 1.5), 0.0)).grey
    horizon = int(PINHOLE.canonical[3]) + 1
    assert grey[-1].std() > 10  # near the camera its grains are seen
    assert grey[horizon + 1 : horizon + 6].std() < 4  # far away they are grey
    assert grey[horizon + 1 : horizon + 6].mean() == pytest.approx(127.5, abs=4)


def test_noise_gain_vignetting_are_what_was_asked_for() -> None:
    build = builder()
    build.wall(
        (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), 50.0, 50.0, Skin(build.texture(np.full((4, 4), 100, np.uint8)), glows=True)
    )
    renderer, pose = Renderer(build.build(), PINHOLE), looking((1.0, 0.0, 0.0), 1.0)
    for sigma in (1.5, 6.0):
        image = renderer.photograph(pose, Optics(noise_sigma=sigma, vignetting=0.0), [1, 2])
        expected = np.sqrt(sigma**2 + 1 / 12)  # rounding adds a twelfth
        # standard error of a standard deviation: sigma / sqrt(2 n)
        assert image.std() == pytest.approx(expected, abs=5 * expected / np.sqrt(2 * image.size))
        assert image.mean() == pytest.approx(100, abs=5 * expected / np.sqrt(image.size))
    a, b = (renderer.photograph(pose, Optics(vignetting=0.0), [1, k]).astype(float) for k in (0, 1))
    assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.05
    assert (renderer.photograph(pose, QUIET, [0], gain=1.3) == 130).all()
    dim = renderer.photograph(pose, Optics(noise_sigma=0.0, vignetting=0.3), [0])
    assert dim[60, 80] == 100
    assert dim[0, 0] == pytest.approx(70, abs=1)


def test_motion_blur_is_the_mean_over_the_exposure() -> None:
    world, _ = dots_on_wall()
    renderer, pose = Renderer(world, PINHOLE), looking((4.0, 0.0, 0.0), 3.0)
    motion = np.array([0.0, 1.0, 0.0, 0.0, 0.3, 0.0])
    optics = Optics(noise_sigma=0.0, vignetting=0.0, exposure_s=0.05, sub_exposures=2)
    halves = [renderer.view(moved_camera(pose, motion, t)).grey for t in (-0.0125, 0.0125)]
    expected = np.rint((halves[0] + halves[1]) / 2)
    assert np.abs(renderer.photograph(pose, optics, [0], motion=motion) - expected).max() <= 1
    # at a hundredth of the speed nothing moves by a pixel: the sharp image
    sharp = renderer.photograph(pose, QUIET, [0])
    assert np.array_equal(renderer.photograph(pose, optics, [0], motion=motion / 100), sharp)
    # with as many steps as it takes, twice as many change next to nothing
    many = [
        renderer.photograph(pose, replace(optics, sub_exposures=n), [0], motion=motion).astype(float) for n in (40, 2)
    ]
    twice = np.mean(
        [renderer.view(moved_camera(pose, motion, t)).grey for t in np.linspace(-0.025, 0.025, 41)[1:] - 0.000625], 0
    )
    assert np.abs(many[0] - twice).max() < 3
    assert np.abs(many[1] - twice).max() > 6


def test_rows_of_a_rolling_shutter_are_taken_one_after_the_other() -> None:
    world, _ = dots_on_wall()
    renderer, motion = Renderer(world, PINHOLE), np.array([0.1, 0.6, 0.2, 0.0, 0.5, 0.0])
    pose = looking((4.0, 0.0, 0.0), 3.0)
    rolled = renderer.photograph(pose, replace(QUIET, readout_s=0.1), [0], motion=motion)
    for first in (0, 56, 112):  # bands of eight rows; at their borders edges are not known, and not smoothed
        late = 0.1 * ((first + 4) / PINHOLE.height - 0.5)
        then = renderer.photograph(moved_camera(pose, motion, late), QUIET, [0])
        rows = slice(first + 1, first + 7)
        np.testing.assert_array_equal(rolled[rows], then[rows])
        assert first == 56 or (rolled[rows] != renderer.photograph(pose, QUIET, [0])[rows]).any()


def test_a_moving_quad_moves() -> None:
    build = builder()
    build.box((5.0, 0.0, -0.5), (1, 1, 1), Skin(build.texture(smooth()), glows=True), 0.0, (0.0, 1.0, 0.0), (0.0, 3.0))
    world = build.build()
    np.testing.assert_allclose(world.origin_at(1.25) - world.origin, np.tile([0.0, 1.25, 0.0], (5, 1)), atol=1e-12)
    np.testing.assert_allclose(world.origin_at(3.5) - world.origin, np.tile([0.0, 0.5, 0.0], (5, 1)), atol=1e-12)


def test_textures_need_powers_of_two() -> None:
    with pytest.raises(ValueError, match="powers of two"):
        Atlas.of([np.zeros((10, 16), np.uint8)])


# ------------------------------------------------------------------------------------------------------------- motion


def wild_motion(seed: int = 0) -> Motion:
    rng = np.random.default_rng(seed)
    controls = np.cumsum(rng.normal(0, [1, 1, 1, 0.7, 0.3, 0.4], (20, 6)), 0)
    return Motion((control_spline(controls, 0.7), tremor(rng, 11.0, 0.2, np.full(6, 0.02))))


def test_inertia_integrates_to_the_trajectory() -> None:
    motion, turn = wild_motion(), rigid3.from_matrix(rigid3.exp_so3([0.3, -2.0, 0.5]), np.zeros(3))
    exact = ImuOptions(2000.0, 0, 0, 0, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    times = np.arange(0.0, 10.0, 1 / exact.rate_hz) + 0.5 / exact.rate_hz  # the middle of each step
    imu = measure_inertia(motion, times, turn, exact, np.random.default_rng(0))
    start = rigid3.inverse(rigid3.compose(turn, motion.body_from_world([0.0])))[0]
    rotation, place, speed = rigid3.rotation_matrix(start), start[4:], motion.velocity([0.0])[0]
    dt = 1 / exact.rate_hz
    for gyro, accel in zip(imu.gyro, imu.accel, strict=True):
        middle = rotation @ rigid3.exp_so3(gyro * dt / 2)
        force = middle @ accel - [0, 0, GRAVITY]
        place = place + dt * speed + dt * dt / 2 * force
        speed = speed + dt * force
        rotation = rotation @ rigid3.exp_so3(gyro * dt)
    end = rigid3.inverse(rigid3.compose(turn, motion.body_from_world([10.0])))[0]
    assert rigid3.rotation_angle_deg(rotation.T @ rigid3.rotation_matrix(end)) < 1e-3
    np.testing.assert_allclose(place, end[4:], atol=1e-3)
    np.testing.assert_allclose(speed, motion.velocity([10.0])[0], atol=1e-3)


def test_inertial_noise_and_bias_walk_have_their_densities() -> None:
    still = Motion((control_spline(np.tile([1.0, 2, 3, 0, 0, 0], (400, 1)), 1.0),))
    options = ImuOptions(200.0, 1e-3, 2e-2, 1e-4, 1e-3, (0.1, 0.0, 0.0), (0.0, 0.2, 0.0))
    imu = measure_inertia(still, np.arange(0, 300, 0.005), rigid3.IDENTITY, options, np.random.default_rng(5))
    for values, bias, noise, walk, start in (
        (imu.gyro, imu.gyro_bias, 1e-3, 1e-4, [0.1, 0, 0]),
        (imu.accel - [0, 0, GRAVITY], imu.accel_bias, 2e-2, 1e-3, [0, 0.2, 0]),
    ):
        count = values.size
        assert (values - bias).std() == pytest.approx(noise * np.sqrt(200), rel=5 / np.sqrt(2 * count))
        assert np.diff(bias, axis=0).std() == pytest.approx(walk / np.sqrt(200), rel=5 / np.sqrt(2 * count))
        np.testing.assert_allclose(bias[0], start, atol=5 * walk)


def test_tremor_is_as_strong_as_asked() -> None:
    sigma = np.array([0.5, 1, 2, 3, 4, 5])
    values = tremor(np.random.default_rng(0), 4000.0, 0.5, sigma)(np.linspace(0, 4000, 50_000))
    np.testing.assert_allclose(values.std(0), sigma, rtol=0.06)  # some 8,000 / 2 independent values


# ---------------------------------------------------------------------------------------------------------- sequences


def small(name: str, num_frames: int = 24, **options: float) -> RenderedSequence:
    """A place seen by small cameras with the same lens."""
    make: Callable[..., RenderedSequence] = getattr(rendered, name)
    sequence = make(num_frames, **options)
    rig = sequence.rig
    shrunk = []
    for camera in rig.cameras:
        params = camera.params.copy()
        params[:4] /= 4
        shrunk.append(Camera(camera.model, camera.width // 4, camera.height // 4, params))
    return RenderedSequence(**{**vars_of(sequence), "rig": Rig(tuple(shrunk), rig.cam_from_rig)})


def vars_of(sequence: RenderedSequence) -> dict[str, object]:
    return {name: getattr(sequence, name) for name in sequence.__dataclass_fields__}


@pytest.fixture(scope="module")
def places() -> dict[str, RenderedSequence]:
    return {"room": small("room", 60), "hall": small("hall", 60), "street": small("street", 60, moving_cars=4)}


@pytest.mark.parametrize("name", ["room", "hall", "street"])
def test_a_place_is_seen_without_gaps(name: str, places: dict[str, RenderedSequence]) -> None:
    sequence = places[name]
    for frame in (0, 43):
        view = sequence._renderers[0][0].view(sequence.cam_from_world[frame])
        assert (view.surface >= 0).all()
        assert view.depth.min() > 0.25
        assert view.grey.std() > 12


def test_the_seed_decides_and_nothing_else(places: dict[str, RenderedSequence]) -> None:
    hall, again, other = places["hall"], small("hall", 60), small("hall", 60, seed=1)
    with ThreadPoolExecutor(2) as pool:
        images = list(pool.map(lambda frame: again.image(frame, 1), (30, 31, 32)))
    for frame, image in zip((30, 31, 32), images, strict=True):
        assert np.array_equal(hall.image(frame, 1), image)
    assert not np.array_equal(hall.image(30), other.image(30))
    assert not np.array_equal(hall.image(0), hall.image(1))  # at rest, but the noise differs


@pytest.mark.parametrize("name", ["room", "hall", "street"])
def test_velocities_are_those_of_the_poses(name: str, places: dict[str, RenderedSequence]) -> None:
    sequence = places[name]
    step = sequence.timestamps_s[1]
    centers = rigid3.center(sequence.cam_from_world)
    np.testing.assert_allclose(
        (centers[2:] - centers[:-2]) / (2 * step),
        sequence.motion[1:-1, 3:],
        atol=0.08 * max(1, np.abs(sequence.motion).max()),
    )
    for k in (38, 51):
        moved = moved_camera(sequence.cam_from_world[k], sequence.motion[k], step / 4)
        nearer = rigid3.compose(moved, rigid3.inverse(sequence.cam_from_world[k + 1]))
        now = rigid3.compose(sequence.cam_from_world[k], rigid3.inverse(sequence.cam_from_world[k + 1]))
        assert np.linalg.norm(rigid3.log_so3(rigid3.rotation_matrix(nearer))) < np.linalg.norm(
            rigid3.log_so3(rigid3.rotation_matrix(now))
        )


def test_the_hall_is_seen_by_the_body_that_its_imu_sits_on(places: dict[str, RenderedSequence]) -> None:
    hall = places["hall"]
    assert hall.imu is not None
    assert hall.imu_from_cam is not None
    at = np.searchsorted(hall.imu.timestamps_s, hall.timestamps_s - 1e-6)
    np.testing.assert_allclose(hall.imu.timestamps_s[at], hall.timestamps_s, atol=1e-9)
    expected = rigid3.compose(rigid3.inverse(hall.imu_from_cam), hall.imu.imu_from_world[at])
    np.testing.assert_allclose(expected, hall.cam_from_world, atol=1e-9)
    at_rest = hall.imu.timestamps_s < 1.0
    up = hall.imu.accel[at_rest].mean(0) - hall.imu.accel_bias[at_rest].mean(0)
    assert np.linalg.norm(up) == pytest.approx(GRAVITY, abs=0.02)
    world_up = rigid3.rotation_matrix(hall.imu.imu_from_world[0])[:, 2]
    np.testing.assert_allclose(up / np.linalg.norm(up), world_up, atol=2e-3)


def test_walks_and_drives_come_back() -> None:
    walk = rigid3.center(rendered.room(1000).cam_from_world)
    assert np.linalg.norm(walk[840:960] - walk[:120], axis=1).max() < 0.25
    assert np.ptp(walk, axis=0)[:2].min() > 1.5
    drive = rigid3.center(rendered.street(600, moving_cars=4).cam_from_world)
    way = np.linalg.norm(np.diff(drive, axis=0), axis=1)
    assert way.min() > 0.45
    assert way.max() < 1.15
    apart = np.linalg.norm(drive[None, :100, :2] - drive[400:, None, :2], axis=2)
    assert (apart.min(0)[:60] < 0.8).all()


def test_edits_change_what_they_say(places: dict[str, RenderedSequence]) -> None:
    room = places["room"]
    dark = rendered.blackout(room, 5, 3)
    assert dark.image(6).max() < 20
    assert np.array_equal(dark.image(8), room.image(8))
    standing = rendered.stand(room, 4, 6)
    assert len(standing) == len(room) + 6
    assert np.ptp(standing.cam_from_world[4:11], axis=0).max() == 0
    assert not np.array_equal(standing.image(5), standing.image(6))
    assert np.array_equal(standing.image(11), room.image(5))
    turned = rendered.pan(room, 4, 6)
    centers = rigid3.center(turned.cam_from_world)
    assert np.ptp(centers[4:11], axis=0).max() < 1e-12
    before, after = (rigid3.rotation_matrix(turned.cam_from_world[k]) for k in (4, 10))
    assert rigid3.rotation_angle_deg(before.T @ after) == pytest.approx(90)
    elsewhere = rendered.splice(room, places["hall"], 7, 5)
    assert np.isnan(elsewhere.ground_truth[7:12]).all()
    assert np.array_equal(elsewhere.ground_truth[12:], room.ground_truth[7:])
    assert np.array_equal(elsewhere.image(13), room.image(8))
    assert not np.array_equal(elsewhere.image(8), room.image(8))
    twice = rendered.repeat(room, 2 * len(room))
    assert np.array_equal(twice.image(len(room) + 3), room.image(3))
    assert (np.diff(twice.timestamps_s) > 0).all()
    fewer = rendered.drop(places["hall"], [3, 4])
    assert fewer.imu is places["hall"].imu
    assert fewer.timestamps_s[3] == places["hall"].timestamps_s[5]
    assert np.array_equal(fewer.image(3, 1), places["hall"].image(5, 1))


def test_moving_cars_move_and_the_rest_does_not(places: dict[str, RenderedSequence]) -> None:
    world = places["street"].worlds[0]
    moves = world.velocity.any(1)
    assert moves.sum() == 4 * 10  # five faces each of body and cabin
    way = np.linalg.norm(world.origin_at(0.5) - world.origin_at(0.0), axis=1)
    assert (way[~moves] == 0).all()
    np.testing.assert_allclose(way[moves], 0.5 * np.linalg.norm(world.velocity[moves], axis=1))


@pytest.mark.parametrize(
    ("name", "kind"),
    [pytest.param("street", "kitti", marks=pytest.mark.slow), ("hall", "euroc"), ("room", "tum")],
)
def test_what_is_written_is_read_as_the_real_data_are(name: str, kind: str, tmp_path: Path) -> None:
    script = Path(__file__).resolve().parent.parent / "benchmarks" / "render_sequences.py"
    out = tmp_path / name
    shown = subprocess.run(
        [sys.executable, str(script), name, str(out), "--frames", "3"], capture_output=True, text=True
    )
    assert shown.returncode == 0, shown.stderr
    sequence = getattr(rendered, name)(3)
    read = open_sequence(out, SequenceOptions(), Events())
    assert read.kind == kind
    assert len(read.rig.cameras) == len(sequence.rig.cameras)
    for camera, expected in zip(read.rig.cameras, sequence.rig.cameras, strict=True):
        np.testing.assert_allclose(camera.canonical, expected.canonical, atol=1e-9)
    np.testing.assert_allclose(read.rig.cam_from_rig, sequence.rig.cam_from_rig, atol=1e-9)
    frames = list(read.frames())
    for k, frame in enumerate(frames):
        for sensor, image in enumerate(frame.images):
            assert np.array_equal(image, sequence.image(k, sensor))
    times = np.array([frame.timestamp_s for frame in frames])
    np.testing.assert_allclose(times - times[0], sequence.timestamps_s, atol=1e-6)
    assert read.ground_truth is not None
    at = np.array([np.argmin(np.abs(read.ground_truth.timestamps_s - t)) for t in times])
    relative = rigid3.compose(sequence.ground_truth, rigid3.inverse(sequence.ground_truth[0]))
    found = rigid3.compose(
        read.ground_truth.cam_from_world[at], rigid3.inverse(read.ground_truth.cam_from_world[at[0]])
    )
    np.testing.assert_allclose(found, relative, atol=1e-6)
    if sequence.imu is not None:
        assert read.imu is not None
        np.testing.assert_allclose(read.imu.gyro, sequence.imu.gyro, atol=1e-7)
        np.testing.assert_allclose(read.imu.imu_from_cam, sequence.imu_from_cam, atol=1e-9)
