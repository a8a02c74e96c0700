"""Rendered sequences with exact ground truth: a hand-held walk through a room, a drone in a hall, a drive round a
block.

A sequence is plain arrays with one row for each frame, and the worlds that they are seen in; images are rendered when
they are asked for, the same bytes every time. Edits (a blackout, a camera that stands still, a fast pan, frames from
elsewhere, a jump, lost frames) are changes of these arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rendered_worlds.motion import (
    CAM_FROM_BODY,
    DEGREE,
    GRAVITY,
    ImuOptions,
    ImuSamples,
    Motion,
    control_spline,
    interpolate,
    measure_inertia,
    tremor,
)
from rendered_worlds.rendering import Optics, Renderer, World
from rendered_worlds.worlds import STREETS, hall_world, room_world, street_world
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]

WALK_S = 28.0  # one round through the room


@dataclass(frozen=True)
class RenderedSequence:
    """Frames that can be rendered, and where they were truly taken.

    Attributes:
        name: which place.
        worlds: what is seen; the first is the sequence's own, others come from :func:`splice`.
        rig: the cameras.
        timestamps_s: (N,) from zero, ascending.
        cam_from_world: (N, 7) the rig's first camera, in the frame's own world.
        motion: (N, 6) angular velocity in the camera's frame, rad/s, and velocity in the world, m/s, at that moment.
        world_time_s: (N,) where moving things are. gain: (N,) exposure; 0 is black.
        noise_key: (N,) int64; frames of the same key, pose and time are equal byte for byte.
        place: (N,) int64 index of the world.
        optics: noise, blur, vignetting.
        seed: of the noise.
        imu: inertial samples on the same clock, and imu_from_cam (7,); None where there are none.
    """

    name: str
    worlds: tuple[World, ...]
    rig: Rig
    timestamps_s: Array
    cam_from_world: Array
    motion: Array
    world_time_s: Array
    gain: Array
    noise_key: NDArray[np.int64]
    place: NDArray[np.int64]
    optics: Optics
    seed: int
    imu: ImuSamples | None = None
    imu_from_cam: Array | None = None

    def __len__(self) -> int:
        return len(self.timestamps_s)

    @cached_property
    def _renderers(self) -> list[list[Renderer]]:
        return [[Renderer(world, camera) for camera in self.rig.cameras] for world in self.worlds]

    @property
    def ground_truth(self) -> Array:
        """(N, 7) cam_from_world of the rig's first camera, NaN for frames of another place."""
        return np.where((self.place == 0)[:, None], self.cam_from_world, np.nan)

    def image(self, frame: int, sensor: int = 0) -> NDArray[np.uint8]:
        """The (H, W) uint8 image of one sensor; may be called from several threads."""
        cam_from_rig = self.rig.cam_from_rig[sensor]
        motion = self.motion[frame].copy()
        motion[:3] = rigid3.rotation_matrix(cam_from_rig) @ motion[:3]
        picture: NDArray[np.uint8] = self._renderers[self.place[frame]][sensor].photograph(
            rigid3.compose(cam_from_rig, self.cam_from_world[frame]),
            self.optics,
            [self.seed, int(self.noise_key[frame]), sensor],
            time_s=float(self.world_time_s[frame]),
            gain=float(self.gain[frame]) * (1.0 + 0.02 * sensor),  # no two sensors are equally sensitive
            motion=motion,
        )
        return picture

    def _take(self, idx: NDArray[np.int64]) -> RenderedSequence:
        """Frames in another order, evenly in time; inertial samples no longer fit and are left out."""
        step = float(np.median(np.diff(self.timestamps_s)))
        rows = {
            k: getattr(self, k)[idx] for k in ("cam_from_world", "motion", "world_time_s", "gain", "noise_key", "place")
        }
        return replace(
            self, **rows, timestamps_s=step * np.arange(len(idx), dtype=np.float64), imu=None, imu_from_cam=None
        )


def _sequence(
    name: str,
    world: World,
    rig: Rig,
    times_s: Array,
    pose: Callable[[Array], Array],
    gain: Array,
    optics: Optics,
    seed: int,
) -> RenderedSequence:
    """Frames at the given times on cam_from_world(times)."""
    step = 1e-4
    before, after = pose(times_s - step), pose(times_s + step)
    turn = rigid3.rotation_matrix(after) @ np.swapaxes(rigid3.rotation_matrix(before), 1, 2)
    motion = np.concatenate([-rigid3.log_so3(turn), rigid3.center(after) - rigid3.center(before)], 1) / (2 * step)
    count = len(times_s)
    return RenderedSequence(
        name, (world,), rig, times_s, pose(times_s), motion, times_s.copy(), gain, np.arange(count),
        np.zeros(count, np.int64), optics, seed,
    )  # fmt: skip


def _wandering_gain(rng: np.random.Generator, times_s: Array, step_s: float, sigma: float, mean: float) -> Array:
    """Auto exposure: a smooth log-normal factor."""
    gain: Array = mean * np.exp(tremor(rng, times_s[-1] + 1.0, step_s, np.full(6, sigma))(times_s)[:, 0])
    return gain


def room(
    num_frames: int = 1000, seed: int = 0, optics: Optics | None = None, camera: Camera | None = None
) -> RenderedSequence:
    """A hand-held camera walks round a furnished room, 640x480 at 30 frames a second; a round takes 840 frames.

    The camera looks ahead and to the sides, bobs and trembles. Starts over along the same way after a round.
    """
    rng = np.random.default_rng([seed, 0x2004])
    if camera is None:
        camera = Camera(CameraModel.PINHOLE, 640, 480, np.array([525.0, 525.0, 320.0, 240.0]))
    times = np.arange(num_frames) / 30.0
    duration = times[-1] + 1.0
    phase = 2 * np.pi * np.arange(-DEGREE, int(duration) + DEGREE + 1) / WALK_S + rng.uniform(0, 2 * np.pi)
    a, b, c = rng.uniform(0, 2 * np.pi, 3)
    wide = 1.0 + 0.12 * np.sin(2 * phase + a)
    walk = np.stack(
        [1.05 * wide * np.cos(phase), 1.55 * wide * np.sin(phase), 1.45 + 0.1 * np.sin(3 * phase + b),
         phase + np.pi / 2 + 0.75 * np.sin(2 * phase + b) + 0.3 * np.sin(5 * phase + c),
         np.radians(9) + np.radians(9) * np.sin(3 * phase + c), np.radians(3) * np.sin(2 * phase + a)], 1,
    )  # fmt: skip
    degree = np.pi / 180
    body = Motion((
        control_spline(walk, 1.0, -2.0),
        tremor(rng, duration, 0.45, [0.02, 0.02, 0.015, 1.2 * degree, 1.2 * degree, 1.0 * degree]),
        tremor(rng, duration, 0.12, [0.002, 0.002, 0.002, 0.15 * degree, 0.15 * degree, 0.1 * degree]),
    ))  # fmt: skip
    gain = _wandering_gain(rng, times, 2.0, 0.05, 1.1)
    return _sequence(
        "room", room_world(seed), Rig.single(camera), times,
        lambda t: rigid3.compose(CAM_FROM_BODY, body.body_from_world(t)), gain,
        optics or Optics(exposure_s=0.008, sub_exposures=16), seed,
    )  # fmt: skip


def handheld(
    num_frames: int = 1000, seed: int = 0, optics: Optics | None = None, camera: Camera | None = None
) -> RenderedSequence:
    """Somebody films a part of a furnished room on the spot, 640x480 at 30 frames a second, like 7-Scenes (Shotton et
    al., CVPR 2013): a cheap sensor with a rolling shutter, blur, noise and a wandering exposure.

    The camera stays within 1.5 x 1.5 m, looks to one side of the room and turns to and fro, at 20 degrees a second in
    the median and up to some 100; what it saw it sees again and again.
    """
    rng = np.random.default_rng([seed, 0x75CE])
    if camera is None:
        camera = Camera(CameraModel.PINHOLE, 640, 480, np.array([525.0, 525.0, 320.0, 240.0]))
    times = np.arange(num_frames) / 30.0
    duration, step, degree = times[-1] + 1.0, 0.75, np.pi / 180
    count = int(np.ceil(duration / step)) + DEGREE + 1
    # standing behind the middle of the room, looking across it
    side = rng.uniform(0, 2 * np.pi)
    stand = np.array([-0.7 * np.cos(side), -0.9 * np.sin(side), 1.45, side, 14 * degree, 0.0])
    reach = np.array([0.75, 0.75, 0.3, 80 * degree, 16 * degree, 9 * degree])
    body = Motion((
        control_spline(stand + reach * rng.uniform(-1, 1, (count, 6)), step),
        tremor(rng, duration, 0.45, [0.012, 0.012, 0.01, 1.0 * degree, 1.0 * degree, 0.8 * degree]),
        tremor(rng, duration, 0.12, [0.002, 0.002, 0.002, 0.15 * degree, 0.15 * degree, 0.1 * degree]),
    ))  # fmt: skip
    gain = _wandering_gain(rng, times, 0.9, 0.12, 1.1)
    return _sequence(
        "handheld", room_world(seed), Rig.single(camera), times,
        lambda t: rigid3.compose(CAM_FROM_BODY, body.body_from_world(t)), gain,
        optics or Optics(noise_sigma=3.0, vignetting=0.3, exposure_s=0.012, sub_exposures=4, readout_s=0.02), seed,
    )  # fmt: skip


def hall_rig() -> Rig:
    """Two cameras with barrel lenses, 11 cm apart and turned by more than half a degree against each other."""
    left = Camera(CameraModel.OPENCV, 752, 480, np.array([458.6, 457.3, 367.7, 248.9, -0.283, 0.0739, 1.9e-4, 1.8e-5]))
    right = Camera(
        CameraModel.OPENCV, 752, 480, np.array([457.6, 456.1, 380.5, 255.7, -0.284, 0.0745, -1.1e-4, -3.6e-5])
    )
    turn = rigid3.exp_so3(np.array([0.009, -0.0035, 0.0025]))
    other = rigid3.from_matrix(turn, np.array([-0.11, 0.0004, -0.0009]))
    return Rig((left, right), np.stack([rigid3.IDENTITY, other]))


def hall(
    num_frames: int = 600, seed: int = 0, optics: Optics | None = None, rig: Rig | None = None
) -> RenderedSequence:
    """A drone flies through a machine hall: stereo 752x480 with barrel lenses at 20 frames a second, IMU at 200 Hz.

    It stands for 1.5 s, then flies at up to some 3 m/s with turns of up to some 120 degrees a second; it tilts where it
    accelerates. The exposure wanders by a third.
    """
    rng = np.random.default_rng([seed, 0x4A12])
    rig = rig or hall_rig()
    times = np.arange(num_frames) / 20.0
    duration, step = times[-1] + 1.0, 0.9
    count, rest = int(np.ceil(duration / step)) + DEGREE + 1, DEGREE + 1 + int(1.5 / step)
    controls = np.zeros((count, 6))
    controls[:, :3] = rng.uniform([-3.6, -7.0, 0.7], [3.6, 7.0, 3.4], (count, 3))
    controls[:, 3] = np.cumsum(rng.normal(0, 0.75, count))
    controls[:rest] = [*controls[0, :2], 0.6, controls[0, 3], 0, 0]
    for k in range(rest, count):  # no point much farther than can be flown in a step
        hop = controls[k, :3] - controls[k - 1, :3]
        controls[k, :3] = controls[k - 1, :3] + hop * min(1.0, 2.6 / float(np.linalg.norm(hop)))
    path = control_spline(controls, step)
    knots = np.arange(-0.5, duration + 0.6, 0.1)
    force, yaw = path(knots, nu=2), path(knots)[:, 3]
    ahead = np.cos(yaw) * force[:, 0] + np.sin(yaw) * force[:, 1]
    left = -np.sin(yaw) * force[:, 0] + np.cos(yaw) * force[:, 1]
    tilt = np.zeros((len(knots), 6))
    tilt[:, 4], tilt[:, 5] = np.arctan2(ahead, GRAVITY), -np.arctan2(left, GRAVITY)
    degree = np.pi / 180
    shake = tremor(rng, duration, 0.15, [0.003, 0.003, 0.003, 0.3 * degree, 0.4 * degree, 0.4 * degree])
    shake.c[: DEGREE + 10] = 0.0
    body = Motion((path, interpolate(knots, tilt), shake))
    # the IMU's x axis points up, its z axis ahead
    turn = rigid3.exp_so3(np.array([0.004, -0.026, 0.015])) @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    imu_from_cam = rigid3.from_matrix(turn, np.array([-0.0216, -0.0647, 0.0098]))
    imu_from_body = rigid3.compose(rigid3.from_matrix(turn, np.zeros(3)), CAM_FROM_BODY)
    options = ImuOptions()
    imu_times = np.arange(-0.05, times[-1] + 0.05, 1 / options.rate_hz)
    imu = measure_inertia(body, imu_times, imu_from_body, options, rng)
    gain = _wandering_gain(rng, times, 0.9, 0.15, 1.45)
    cam_from_body = rigid3.compose(rigid3.inverse(imu_from_cam), imu_from_body)
    sequence = _sequence(
        "hall", hall_world(seed), rig, times, lambda t: rigid3.compose(cam_from_body, body.body_from_world(t)), gain,
        optics or Optics(noise_sigma=2.5, exposure_s=0.006, sub_exposures=8, vignetting=0.25), seed,
    )  # fmt: skip
    return replace(sequence, imu=imu, imu_from_cam=imu_from_cam)


def street_rig() -> Rig:
    """A rectified pair with a baseline of 0.537 m."""
    camera = Camera(CameraModel.PINHOLE, 1241, 376, np.array([718.856, 718.856, 607.6928, 185.7157]))
    return Rig((camera, camera), np.stack([rigid3.IDENTITY, [0, 0, 0, 1, -0.537, 0, 0]]))


def street(
    num_frames: int = 600, seed: int = 0, optics: Optics | None = None, rig: Rig | None = None, *, moving_cars: int = 0,
    lean_deg: float = 0.0, ramp_m: float = 0.0,
) -> RenderedSequence:  # fmt: skip
    """A car drives clockwise round a block: rectified stereo 1241x376 at 10 frames a second.

    5 m/s in the turns, up to 11 m/s between them; a round of about 390 m takes some 450 frames, then it starts again.

    Args:
        lean_deg: roll of the car in the turns. ramp_m: by how much it rises from the 4th to the 9th second and stays.
    """
    rng = np.random.default_rng([seed, 0x57E8])
    times = np.arange(num_frames) / 10.0
    knots = np.arange(-1.5, times[-1] + 1.6, 0.25)
    degree = np.pi / 180
    sway = tremor(rng, times[-1] + 1.0, 0.5, [0.015, 0.015, 0.012, 0.15 * degree, 0.25 * degree, 0.2 * degree])
    state = _drive(knots)
    turning = np.abs(np.gradient(state[:, 3], knots))
    state[:, 5] += lean_deg * degree * turning / max(float(turning.max()), 1e-9)
    share = np.clip((knots - 4.0) / 5.0, 0.0, 1.0)
    rise = ramp_m * share**2 * (3.0 - 2.0 * share)
    way = np.linalg.norm(np.gradient(state[:, :2], axis=0), axis=1)
    state[:, 2] += rise
    state[:, 4] -= np.arctan2(np.gradient(rise), way)
    body = Motion((interpolate(knots, state), sway))
    return _sequence(
        "street", street_world(seed, moving_cars=moving_cars), rig or street_rig(), times,
        lambda t: rigid3.compose(CAM_FROM_BODY, body.body_from_world(t)), _wandering_gain(rng, times, 3.0, 0.04, 1.25),
        optics or Optics(), seed,
    )  # fmt: skip


def _drive(times_s: Array) -> Array:
    """States (N, 6) of the car: clockwise on the lane beside the block, starting in the middle of the upper street."""
    from scipy.ndimage import gaussian_filter1d

    radius, ds = 8.0, 0.05
    wide = STREETS.xs[1] - STREETS.xs[0] - 2 * STREETS.lane
    high = STREETS.ys[1] - STREETS.ys[0] - 2 * STREETS.lane
    legs = [wide / 2 - radius, high - 2 * radius, wide - 2 * radius, high - 2 * radius, wide / 2 - radius]
    curvature, slow = [], []
    for k, leg in enumerate(legs):
        straight = np.zeros(round(leg / ds))
        before, after = np.arange(len(straight)) * ds, np.arange(len(straight))[::-1] * ds
        gap = np.minimum(after, before) if 0 < k < 4 else (after if k == 0 else before)
        curvature.append(straight)
        slow.append(np.sqrt(5.0**2 + 2 * 1.3 * np.maximum(gap - 2.0, 0.0)))
        if k < 4:
            turn = round(radius * np.pi / 2 / ds)
            curvature.append(np.full(turn, -np.pi / 2 / (turn * ds)))
            slow.append(np.full(turn, 5.0))
    smooth = gaussian_filter1d(np.concatenate(curvature), 2.0 / ds, mode="wrap")
    speed = gaussian_filter1d(np.minimum(np.concatenate(slow), 11.0), 4.0 / ds, mode="wrap")
    rounds = int(np.ceil(times_s[-1] * 11 / (len(smooth) * ds))) + 2
    smooth, speed = np.tile(smooth, rounds), np.tile(speed, rounds)
    yaw = np.concatenate([[0.0], np.cumsum(smooth * ds)])
    middle = (yaw[1:] + yaw[:-1]) / 2
    way = ds * np.cumsum(np.stack([np.cos(middle), np.sin(middle)], 1), 0)
    start = np.array([(STREETS.xs[0] + STREETS.xs[1]) / 2, STREETS.ys[1] - STREETS.lane])
    clock = np.cumsum(ds / speed)
    clock -= clock[len(clock) // rounds - 1]  # a round before time zero, for what lies before it
    x, y, turn = (np.interp(times_s, clock, v) for v in (way[:, 0] + start[0], way[:, 1] + start[1], yaw[1:]))
    state = np.zeros((len(times_s), 6))
    state[:, 0], state[:, 1], state[:, 2], state[:, 3] = x, y, 1.65, turn
    return state


def blackout(sequence: RenderedSequence, first: int, count: int) -> RenderedSequence:
    """The lens is covered for ``count`` frames from ``first``."""
    gain = sequence.gain.copy()
    gain[first : first + count] = 0.0
    return replace(sequence, gain=gain)


def drop(sequence: RenderedSequence, lost: ArrayLike) -> RenderedSequence:
    """Frames ``lost`` are missing; the others keep their times, the inertial samples stay."""
    kept = np.setdiff1d(np.arange(len(sequence)), np.asarray(lost))
    shorter = sequence._take(kept)
    return replace(
        shorter, timestamps_s=sequence.timestamps_s[kept], imu=sequence.imu, imu_from_cam=sequence.imu_from_cam
    )


def repeat(sequence: RenderedSequence, num_frames: int) -> RenderedSequence:
    """The sequence over and over, jumping from its end to its start, byte for byte the same, for ``num_frames``."""
    return sequence._take(np.arange(num_frames) % len(sequence))


def stand(sequence: RenderedSequence, at: int, count: int) -> RenderedSequence:
    """The camera stands still for ``count`` more frames at frame ``at``; each has noise of its own."""
    idx = np.concatenate([np.arange(at + 1), np.full(count, at), np.arange(at + 1, len(sequence))])
    longer = sequence._take(idx)
    longer.motion[at : at + count + 1] = 0.0
    key = longer.noise_key.copy()
    key[at + 1 : at + 1 + count] = sequence.noise_key.max() + 1 + np.arange(count)
    return replace(longer, noise_key=key, world_time_s=longer.timestamps_s.copy())


def pan(sequence: RenderedSequence, at: int, count: int, angle_deg: float = 90.0) -> RenderedSequence:
    """At frame ``at`` the camera turns on the spot about the world's vertical, within ``count`` more frames.

    It goes on along the same way and stays turned.
    """
    paused = stand(sequence, at, count)
    share = np.clip((np.arange(len(paused)) - at) / count, 0.0, 1.0)
    eased, rate = share**2 * (3 - 2 * share), 6 * share * (1 - share)  # smoothstep and its derivative
    step = float(np.median(np.diff(sequence.timestamps_s)))
    angle, speed = np.radians(angle_deg) * eased, np.radians(angle_deg) * rate / (count * step)
    up = np.array([0.0, 0.0, 1.0])
    old = rigid3.rotation_matrix(paused.cam_from_world)
    new = old @ rigid3.exp_so3(-angle[:, None] * up)
    centers = rigid3.center(paused.cam_from_world)
    motion = paused.motion.copy()
    motion[:, :3] = np.einsum("nij,j->ni", new, up) * speed[:, None] + motion[:, :3]
    poses = rigid3.from_matrix(new, -np.einsum("nij,nj->ni", new, centers))
    return replace(paused, cam_from_world=poses, motion=motion)


def splice(
    sequence: RenderedSequence, other: RenderedSequence, at: int, count: int, first: int = 0
) -> RenderedSequence:
    """``count`` frames of another place, seen by the same cameras, come before frame ``at``."""
    idx = np.concatenate([np.arange(at), np.zeros(count, np.int64), np.arange(at, len(sequence))])
    longer = sequence._take(idx)
    inserted, taken = slice(at, at + count), slice(first, first + count)
    for name in ("cam_from_world", "motion", "world_time_s", "gain"):
        getattr(longer, name)[inserted] = getattr(other, name)[taken]
    longer.noise_key[inserted] = sequence.noise_key.max() + 1 + np.arange(count)
    longer.place[inserted] = len(sequence.worlds) + other.place[taken]
    return replace(longer, worlds=(*sequence.worlds, *other.worlds))
