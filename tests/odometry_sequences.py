"""Short rendered sequences with exact ground truth, as odometry takes them: images of 320 x 240, rendered once per
session."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from rendered_worlds import sequences as rendered
from rendered_worlds.rendering import Optics, World
from rendered_worlds.sequences import RenderedSequence
from sfmapp.adjust.gauge import similarity_basis
from sfmapp.camera.camera import Camera, CameraModel
from sfmapp.events import Event, Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.images.sequence import Frame, GroundTruth, Imu
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.result import OdometryResult
from sfmapp.odometry.run import run_odometry
from sfmapp.scene.rig import Rig
from sfmapp.scene.synthetic import SyntheticScene

Array = NDArray[np.float64]
Images = tuple[NDArray[np.uint8], ...]

OPTICS = Optics(noise_sigma=2.0)
PINHOLE = Camera(CameraModel.PINHOLE, 320, 240, np.array([262.0, 262.0, 160.0, 120.0]))
_BASELINE_M = 0.11


@dataclass
class Played:
    """A rendered sequence as odometry plays it, all images in memory."""

    images: list[Images]
    timestamps_s: Array
    rig: Rig
    ground_truth: GroundTruth
    imu: Imu | None = None
    kind: str = "folder"
    source: str = "rendered"
    frames_per_second: float | None = 30.0
    num_frames: int | None = field(init=False)

    def __post_init__(self) -> None:
        self.num_frames = len(self.images)

    def frames(self) -> Iterator[Frame]:
        for idx, images in enumerate(self.images):
            yield Frame(idx, f"{idx:06d}.png", float(self.timestamps_s[idx]), images)

    def taken(self, idx: NDArray[np.int64], *, mirrored: bool = False) -> Played:
        """Some frames, at their own times, or (backwards) at those times mirrored."""
        times = self.timestamps_s[idx]
        times = times.max() - times if mirrored else times
        ground_truth = GroundTruth(times, self.ground_truth.cam_from_world[idx])
        return replace(
            self, images=[self.images[i] for i in idx], timestamps_s=times, ground_truth=ground_truth, imu=None
        )


# sequences that differ in some frames share the others
_worlds: dict[bytes | int | float, World] = {}  # kept, so that their ids stay theirs
_rendered: dict[tuple[bytes | int | float, ...], NDArray[np.uint8]] = {}


def _image(sequence: RenderedSequence, frame: int, sensor: int) -> NDArray[np.uint8]:
    key = (
        id(sequence.worlds[sequence.place[frame]]), sensor, sequence.rig.cameras[sensor].params.tobytes(),
        sequence.rig.cam_from_rig[sensor].tobytes(), sequence.seed, int(sequence.noise_key[frame]),
        float(sequence.gain[frame]), sequence.cam_from_world[frame].tobytes(),
    )  # fmt: skip
    if key not in _rendered:
        _rendered[key] = sequence.image(frame, sensor)
        _worlds[key[0]] = sequence.worlds[sequence.place[frame]]
    return _rendered[key]


def play(sequence: RenderedSequence) -> Played:
    """All of a rendered sequence, in metres. Nothing moves in the rooms, so the time of a frame does not count."""
    images = [tuple(_image(sequence, f, s) for s in range(len(sequence.rig.cameras))) for f in range(len(sequence))]
    imu = None
    if sequence.imu is not None and sequence.imu_from_cam is not None:
        i = sequence.imu
        imu = Imu(
            i.timestamps_s, i.gyro, i.accel, sequence.imu_from_cam, i.gyro_noise, i.accel_noise, i.gyro_walk,
            i.accel_walk,
        )  # fmt: skip
    times = sequence.timestamps_s
    return Played(images, times, sequence.rig, GroundTruth(times, sequence.ground_truth), imu)


def room_rig(is_stereo: bool) -> Rig:
    """A pinhole camera, or two beside each other, a hand's breadth apart."""
    if not is_stereo:
        return Rig.single(PINHOLE)
    return Rig((PINHOLE, PINHOLE), np.stack([rigid3.IDENTITY, [0, 0, 0, 1, -_BASELINE_M, 0, 0]]))


@cache
def whole_room_walk(num_frames: int, seed: int = 0) -> RenderedSequence:
    """One world for all walks of a seed: what differs in frames or in cameras shares the images that are the same."""
    return rendered.room(num_frames, seed, OPTICS, PINHOLE)


def room_walk(num_frames: int = 80, is_stereo: bool = False, seed: int = 0) -> RenderedSequence:
    """The first frames of the walk round the room, 30 frames a second, without motion blur."""
    return replace(whole_room_walk(80, seed)._take(np.arange(num_frames)), rig=room_rig(is_stereo))


@cache
def room(num_frames: int = 80, is_stereo: bool = False, seed: int = 0) -> Played:
    """:func:`room_walk`, played."""
    return play(room_walk(num_frames, is_stereo, seed))


class Told(list[Event]):
    """What was told, and the Events object that tells it."""

    def __init__(self) -> None:
        super().__init__()
        self.events = Events(self.append)

    def messages(self, kind: str) -> list[str]:
        return [event.message for event in self if event.kind == kind]


def run(sequence: Played, options: OdometryOptions | None = None, seed: int = 0, threads: int = 2) -> OdometryResult:
    return run_odometry(sequence, options or OdometryOptions(), seed=seed, threads=threads)  # type: ignore[arg-type]


@cache
def _run_room(num_frames: int, is_stereo: bool, seed: int) -> OdometryResult:
    return run(room(num_frames, is_stereo, seed))


def run_room(num_frames: int = 80, is_stereo: bool = False, seed: int = 0) -> OdometryResult:
    """Odometry of :func:`room` by default options, run once for all tests that only read it: not to be changed."""
    return _run_room(num_frames, is_stereo, seed)


def centers_and_ground_truth(result: OdometryResult, sequence: Played, map_idx: int = 0) -> tuple[Array, Array]:
    """(N, 3) camera centres of one map and the true ones, of frames that have both."""
    poses, ground_truth = result.cam_from_world, sequence.ground_truth.cam_from_world[result.frame_idx]
    both = (result.frame_map == map_idx) & np.isfinite(poses[:, 0]) & np.isfinite(ground_truth[:, 0])
    return rigid3.center(poses[both]), rigid3.center(ground_truth[both])


def absolute_error(result: OdometryResult, sequence: Played, map_idx: int = 0) -> tuple[float, float]:
    """Rms distance from the ground truth, in metres, after the best similarity, and the factor that it puts on
    lengths."""
    ours, ground_truth = centers_and_ground_truth(result, sequence, map_idx)
    ground_truth_from_ours = similarity.umeyama(ours, ground_truth)
    error = similarity.apply(ground_truth_from_ours, ours) - ground_truth
    return float(np.sqrt((error**2).sum(1).mean())), float(ground_truth_from_ours[7])


def path_length(sequence: Played) -> float:
    centers = rigid3.center(sequence.ground_truth.cam_from_world)
    return float(np.nansum(np.linalg.norm(np.diff(centers, axis=0), axis=1)))


# ------------------------------------------------------------------ keyframe maps without images


def keyframe_map(scene: SyntheticScene, rig: Rig) -> KeyframeMap:
    """The observations of a synthetic scene as a map: images S k + s are what sensor s saw at keyframe k."""
    model, num_sensors = scene.observed, len(rig.cameras)
    tracks, keyframes = model.tracks, KeyframeMap(rig)
    keyframes.new_points(tracks.num_tracks)
    keyframes.point_xyz[: tracks.num_tracks] = model.point_xyz
    for k in range(len(model.image_names) // num_sensors):
        observations = [tracks.observations_of_image(num_sensors * k + s) for s in range(num_sensors)]
        seen = [tracks.obs_track_idx[o].astype(np.int64) for o in observations]
        ids = np.unique(np.concatenate(seen))
        xy = np.full((len(ids), num_sensors, 2), np.nan)
        for s in range(num_sensors):
            xy[np.searchsorted(ids, seen[s]), s] = tracks.obs_xy[observations[s]]
        pose = model.cam_from_world[num_sensors * k]
        keyframes.append(Keyframe(10 * k, float(k), f"{k:06d}.png", pose.copy(), ids, xy, np.isfinite(xy[:, :, 0])))
    return keyframes


def gauge_errors(ours: Array, ground_truth: Array, num_freedoms: int) -> Array:
    """(K, 6) errors w, v of poses (K, 7) after moving the ground truth to the gauge of the covariances.

    Args:
        num_freedoms: 7 where a similarity is open, 6 where lengths are known.
    """
    start = similarity.align_poses(ground_truth, ours).b_from_a.copy()
    if num_freedoms == 6:
        turned = rigid3.center(ground_truth) @ rigid3.rotation_matrix(start).T
        start[4:] = [*(rigid3.center(ours).mean(0) - turned.mean(0)), 1.0]
    moved = similarity.transform_poses(start, ground_truth)
    for _ in range(20):
        basis, constraint = (rows[:num_freedoms] for rows in similarity_basis(moved))
        error = pose_errors(ours, moved)
        move = np.zeros(7)
        move[:num_freedoms] = np.linalg.solve(constraint @ basis.T, constraint @ error.ravel())
        if np.abs(move).max() < 1e-13:
            break
        centers = rigid3.center(moved)
        mean = centers.mean(0)
        size = float(np.sqrt(((centers - mean) ** 2).sum(1).mean()))
        turn, scale = rigid3.exp_so3(move[:3]), float(np.exp(move[6]))
        shift = mean + size * move[3:6] - scale * turn @ mean
        moved = similarity.transform_poses(similarity.from_parts(turn, shift, scale), moved)
    return pose_errors(ours, moved)


def pose_errors(ours: Array, ground_truth: Array) -> Array:
    """(K, 6) w and v with ``ours = (exp(w), v) ground_truth``."""
    delta = rigid3.compose(ours, rigid3.inverse(ground_truth))
    return np.concatenate([rigid3.log_so3(rigid3.rotation_matrix(delta)), delta[:, 4:]], 1)


def normalized_errors(errors: Array, covariances: Array) -> Array:
    """(K,) NEES for each degree of freedom: one on average where the covariances are right."""
    return np.array([e @ np.linalg.solve(c, e) / 6 for e, c in zip(errors, covariances, strict=True)])
