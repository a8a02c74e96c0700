"""A sensor and a camera on analytic motions, and maps of what the camera saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying
from sfmapp.camera.camera import Camera, CameraModel, pixels_to_rays, project
from sfmapp.geometry import rigid3, similarity
from sfmapp.images.sequence import Imu
from sfmapp.odometry.inertial.integration import GRAVITY
from sfmapp.odometry.inertial.seen_map import SeenMap
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import Rig, RigImages
from sfmapp.scene.tracks import make_tracks

IMU_FROM_CAM = rigid3.from_matrix(rigid3.exp_so3([1.2, -1.1, 1.3]), [0.05, -0.03, 0.08])
GYRO_BIAS, ACCEL_BIAS = np.array([-0.002, 0.02, 0.07]), np.array([-0.05, 0.12, 0.06])
CAMERA = Camera(CameraModel.PINHOLE, 640, 480, np.array([320.0, 320.0, 320.0, 240.0]))
# the map's world: another origin, heading, tilt and unit
SCALE = 2.7
MAP_FROM_WORLD = similarity.from_parts(rigid3.exp_so3([0.9, -0.5, 2.0]), [3.0, -1.0, 0.5], 1 / SCALE)
FIXED = AdjustOptions(refine_focal=False, refine_distortion=False)


class Flight:
    """A sensor on sums of sines, z up: positions with exact derivatives, rotations with differences."""

    def __init__(self, seed: int, acceleration: float = 1.5, turning: float = 0.6) -> None:
        rng = np.random.default_rng([seed, 21])
        self._rates = rng.uniform(0.5, 5.0, (4, 3))
        self._phases = rng.uniform(0, 6.28, (2, 4, 3))
        self._sizes = acceleration / self._rates**2 * rng.uniform(0.3, 1.0, (4, 3))
        self._angles = turning / self._rates * rng.uniform(0.3, 1.0, (4, 3))
        self._drift = np.array([0.4, -0.2, 0.1])

    def _sum(self, t: np.ndarray, sizes: np.ndarray, phases: np.ndarray, order: int) -> np.ndarray:
        wave = self._rates * t[:, None, None] + phases + 0.5 * np.pi * order
        return (sizes * self._rates**order * np.sin(wave)).sum(1)

    def position(self, t: np.ndarray) -> np.ndarray:
        return self._sum(t, self._sizes, self._phases[0], 0) + t[:, None] * self._drift

    def velocity(self, t: np.ndarray) -> np.ndarray:
        return self._sum(t, self._sizes, self._phases[0], 1) + self._drift

    def rotation(self, t: np.ndarray) -> np.ndarray:
        return rigid3.exp_so3(self._sum(t, self._angles, self._phases[1], 0))

    def gyro(self, t: np.ndarray) -> np.ndarray:
        h = 1e-5
        return rigid3.log_so3(self.rotation(t - h).swapaxes(1, 2) @ self.rotation(t + h)) / (2 * h)

    def accel(self, t: np.ndarray) -> np.ndarray:
        force = self._sum(t, self._sizes, self._phases[0], 2) + np.array([0.0, 0.0, GRAVITY])
        return np.einsum("nji,nj->ni", self.rotation(t), force)

    def cam_from_world(self, t: np.ndarray) -> np.ndarray:
        imu_from_world = rigid3.inverse(rigid3.from_matrix(self.rotation(t), self.position(t)))
        return rigid3.compose(rigid3.inverse(IMU_FROM_CAM), imu_from_world)

    def imu(self, seed: int, stop_s: float, noise: float = 1.0, rate_hz: float = 200.0) -> Imu:
        """Measurements with the noise of a small sensor times a factor, and walking biases."""
        rng = np.random.default_rng([seed, 22])
        t = np.arange(-0.02, stop_s + 0.02, 1 / rate_hz)
        densities = noise * np.array([1.7e-4, 2e-3, 1.9e-5, 3e-3])
        white = rng.normal(size=(2, len(t), 3)) * densities[:2, None, None] * np.sqrt(rate_hz)
        walk = np.cumsum(rng.normal(size=(2, len(t), 3)) * densities[2:, None, None] / np.sqrt(rate_hz), 1)
        has_bias = float(noise > 0)
        gyro = self.gyro(t) + white[0] + walk[0] + has_bias * GYRO_BIAS
        accel = self.accel(t) + white[1] + walk[1] + has_bias * ACCEL_BIAS
        return Imu(t, gyro, accel, IMU_FROM_CAM, *densities)


def true_map(flight: Flight, times: np.ndarray, scale: float = SCALE) -> np.ndarray:
    """(K, 7) cam_from_map."""
    return similarity.transform_poses(np.r_[MAP_FROM_WORLD[:7], 1 / scale], flight.cam_from_world(times))


def true_gravity() -> np.ndarray:
    return rigid3.rotation_matrix(MAP_FROM_WORLD) @ [0.0, 0.0, -GRAVITY]


def seen_map(
    flight: Flight,
    times: np.ndarray,
    seed: int,
    sigma_px: float,
    *,
    baseline_m: float | None = None,
    num_points: int = 500,
) -> SeenMap:
    """What a camera (with a baseline: a pair, in metres) saw of points around, each for three seconds at most, adjusted
    to the minimum of the images alone."""
    rng = np.random.default_rng([seed, 23])
    scale = SCALE if baseline_m is None else 1.0
    poses = true_map(flight, times, scale)
    rig_of = Rig.single(CAMERA)
    if baseline_m is not None:
        rig_of = Rig((CAMERA, CAMERA), np.stack([rigid3.IDENTITY, [0, 0, 0, 1, -baseline_m, 0, 0]]))
    num_sensors = len(rig_of.cameras)
    sensors = np.tile(np.arange(num_sensors, dtype=np.int32), len(times))
    frames = np.repeat(np.arange(len(times), dtype=np.int32), num_sensors)
    images = rigid3.compose(rig_of.cam_from_rig[sensors], poses[frames])
    # each in front of some camera, at 2 to 10 m, and followed for a while
    owner, depth = rng.integers(len(times), size=num_points), rng.uniform(2.0, 10.0, num_points) / scale
    pixel = rng.uniform([0, 0], [640, 480], (num_points, 2))
    xyz = rigid3.apply(rigid3.inverse(poses[owner]), pixels_to_rays(CAMERA, pixel) * depth[:, None])
    local = rigid3.apply(images[:, None], xyz[None])
    xy = project(CAMERA, local.reshape(-1, 3)).reshape(*local.shape[:2], 2)
    near = np.abs(times[frames][:, None] - times[owner]) < 1.5
    inside = (local[..., 2] > 0.3 / scale) & (xy > 0).all(-1) & (xy < [640, 480]).all(-1) & near
    image, track = np.nonzero(inside)
    noisy = xy[image, track] + sigma_px * rng.normal(size=(len(image), 2))
    tracks = make_tracks(len(images), num_points, track, image, track, noisy)
    model = Reconstruction.empty([CAMERA] * num_sensors, [str(i) for i in range(len(images))], sensors, tracks)
    model.cam_from_world, model.point_xyz = images, xyz
    model.obs_is_inlier[:] = True
    if num_sensors > 1:
        model.rig = RigImages(frames, sensors, rig_of.cam_from_rig)
    if sigma_px > 0:
        varying = np.ones(len(images), bool)
        varying[:num_sensors] = False
        options = replace(FIXED, relative_cost_tolerance=1e-9)
        FactorGraph(model, options, varying=Varying(images=varying), noise_px=sigma_px).optimize()
    return SeenMap(model, times, FIXED, max(sigma_px, 1e-3), None if baseline_m is None else 0.003)
