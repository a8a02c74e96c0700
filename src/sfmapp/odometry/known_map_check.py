"""A known map held against what a sequence says by itself: whether both are adjusted together, or kept apart.

Each keyframe that sees landmarks of the known map has two poses: by these landmarks alone, held where the known map has
them, and by the sequence alone, adjusted with none but its own observations. After the alignment that is free they
differ by what both are unsure of, if the known map is right. Where they differ by more, an average would be worse than
either, and sure of itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.covariance import pose_errors_in_gauge
from sfmapp.adjust.gauge import similarity_basis
from sfmapp.camera.camera import Camera, project_jacobian
from sfmapp.contradictions import Contradiction, widened_scale_sigma
from sfmapp.geometry import rigid3, similarity
from sfmapp.mapping.structure import residual_scale_px
from sfmapp.odometry.map.backend import classify, make_job
from sfmapp.odometry.map.covariance import estimate_map_covariance
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.map.known_map import KnownMap
from sfmapp.odometry.options import MAX_COVARIANCE_KEYFRAMES
from sfmapp.odometry.records import FrameRecord
from sfmapp.odometry.refinement.calibration_check import LOSS_SIGMAS, adjust_poses
from sfmapp.odometry.refinement.final_adjustment import MIN_SIGMA_PX
from sfmapp.odometry.report import BeliefReport, KnownMapReport
from sfmapp.odometry.result import OdometryResult
from sfmapp.odometry.tracker import MIN_INLIERS, measure_pose
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

# Root mean squares of what a sequence and the map differ by that are more are a contradiction. A rms over keyframes
# whose errors have all in common is that of a single Gaussian: 4 is one in 16,000.
MAX_SIGMAS = 4.0
# Fewest keyframes that tell: a similarity has seven parameters, and three poses eighteen.
_MIN_KEYFRAMES = 3
_STEPS, _TOLERANCE = 30, 1e-4
# Steps of a pose that begins at a minimum of other weights.
_POSE_STEPS = 5


@dataclass(frozen=True)
class Disagreement:
    """What a sequence and a known map differ by.

    Attributes:
        position_sigmas, rotation_sigmas: rms over the keyframes, in standard deviations of both together.
        moved: rms of the positions over the size of the path. turned_deg: rms of the rotations.
        worst: name of the keyframe that differs most. num: keyframes that tell.
    """

    position_sigmas: float
    rotation_sigmas: float
    moved: float
    turned_deg: float
    worst: str
    num: int

    @property
    def is_contradiction(self) -> bool:
        """They differ by more than both are unsure of."""
        return not max(self.position_sigmas, self.rotation_sigmas) <= MAX_SIGMAS


class KnownMapCheck:
    """The known map as it was given, to hold a run against and to return to.

    Args:
        known: as it was read. keyframes: it as keyframes of the run's rig.
        map_idx: its number among the maps of the run.
    """

    def __init__(self, known: KnownMap, keyframes: KeyframeMap, map_idx: int, num_places: int) -> None:
        self.map_idx, self._known, self._num_places = map_idx, known, num_places
        self.poses = np.array([k.rig_from_world for k in keyframes.keyframes]).reshape(-1, 7)
        self._before = _copied(keyframes, keyframes.keyframes)
        self._against: Disagreement | None = None

    def is_entered(self, records: list[FrameRecord]) -> bool:
        """Whether a frame has a pose in the known map."""
        return any(record.map_idx == self.map_idx and record.has_pose for record in records)

    def compare(self, keyframes: KeyframeMap) -> Disagreement | None:
        """What the sequence says by itself against the known map; None where too few keyframes tell.

        Args:
            keyframes: the known map with the keyframes of the run; not changed.
        """
        located = self._located(keyframes)
        if len(located) < _MIN_KEYFRAMES:
            return None
        num_known, num_sensors = keyframes.num_known, len(keyframes.rig.cameras)
        own = np.arange(num_known, len(keyframes.keyframes))
        # what hangs together by the sequence's own observations alone; keyframes that do not tell are left out
        job = make_job(keyframes, own, own > own[0])
        model = job.model
        adjust_poses(model, residual_scale_px(model, MIN_SIGMA_PX), _STEPS, _TOLERANCE)
        classify(model, np.zeros_like(job.num_elsewhere))
        sigma = residual_scale_px(model, MIN_SIGMA_PX)
        of_own = estimate_map_covariance(model, num_sensors, LOSS_SIGMAS * sigma).poses
        of_known = self._covariances()
        rows = np.array(sorted(located), np.int64)
        wanted = _with_poses(model, rows * num_sensors, np.array([located[int(k)][0] for k in rows]))
        nearest = [self._nearest(located[int(k)][0]) for k in rows]
        covariance = of_own[rows] + of_known[nearest] + np.array([located[int(k)][1] for k in rows])
        usable = np.isfinite(covariance).all((1, 2))
        if usable.sum() < _MIN_KEYFRAMES:
            return None
        rows, covariance = rows[usable], covariance[usable]
        images = rows * num_sensors
        freedoms = 7 if num_sensors == 1 else 6
        errors = pose_errors_in_gauge(model, wanted, images, freedoms)
        errors = _aligned(errors, covariance, similarity_basis(model.cam_from_world[images])[0][:freedoms])
        names = [keyframes.keyframes[num_known + int(k)].name for k in rows]
        self._against = _measured(errors, covariance, names, model.cam_from_world[images])
        return self._against

    def _located(self, keyframes: KeyframeMap) -> dict[int, tuple[Array, Array]]:
        """Pose (7,) and covariance (6, 6) of each keyframe of the run that sees enough landmarks, by these alone."""
        camera, found = keyframes.rig.cameras[0], {}
        for row, keyframe in enumerate(keyframes.keyframes[keyframes.num_known :]):
            seen = (keyframe.point_id < keyframes.num_known_points) & keyframe.is_inlier[:, 0]
            xyz, xy = self._before.point_xyz[keyframe.point_id[seen]], keyframe.xy[seen, 0]
            usable = np.isfinite(xyz[:, 0])
            if usable.sum() >= MIN_INLIERS:
                measured = measure_pose(camera, keyframe.rig_from_world, xyz[usable], xy[usable])
                if measured is not None:
                    good = np.flatnonzero(usable)[measured[2]]
                    of_points = self._point_covariances[keyframe.point_id[seen][good]]
                    noise_px = max(measured[3], MIN_SIGMA_PX)
                    found[row] = weighted_pose(camera, measured[0], xyz[good], xy[good], of_points, noise_px)
        return found

    @cached_property
    def _point_covariances(self) -> Array:
        """(P, 3, 3) of the landmarks of the known map, its keyframes held; infinite is that of none."""
        before, camera = self._before, self._before.rig.cameras[0]
        information = np.zeros((before.num_points, 3, 3))
        for keyframe in before.keyframes:
            good = keyframe.is_inlier[:, 0] & before.is_triangulated(keyframe.point_id)
            ids = keyframe.point_id[good]
            jacobian = _of_world_points(camera, keyframe.rig_from_world, before.point_xyz[ids])[1]
            information[ids] += np.einsum("nki,nkj->nij", jacobian, jacobian)
        model, _ = before.reconstruction(np.arange(len(before.keyframes)))
        information /= residual_scale_px(model, MIN_SIGMA_PX) ** 2
        # a point on a line through the only camera that saw it is anywhere on that
        trace = np.maximum(np.trace(information, 0, 1, 2), 1e-300)
        return np.linalg.inv(information + (1e-9 * trace)[:, None, None] * np.eye(3))

    def _covariances(self) -> Array:
        """(K, 6, 6) of the known map by its own observations."""
        num = len(self.poses)
        if not 1 < num <= MAX_COVARIANCE_KEYFRAMES:
            return np.zeros((num, 6, 6))
        model, _ = self._before.reconstruction(np.arange(num))
        sigma = residual_scale_px(model, MIN_SIGMA_PX)
        num_sensors = len(self._before.rig.cameras)
        return np.nan_to_num(estimate_map_covariance(model, num_sensors, LOSS_SIGMAS * sigma).poses)

    def _nearest(self, pose: Array) -> int:
        """The known keyframe that was taken from nearest."""
        return int(np.argmin(np.linalg.norm(rigid3.center(self.poses) - rigid3.center(pose), axis=1)))

    def restore_frame(self, keyframes: KeyframeMap) -> None:
        """Bring a map that was adjusted with the known one, in place, to where the known one was: an adjustment leaves
        place and, with one camera, size open."""
        now = np.array([k.rig_from_world for k in keyframes.keyframes[: keyframes.num_known]]).reshape(-1, 7)
        _move_onto(keyframes, now, self.poses)

    def take_apart(self, keyframes: KeyframeMap, records: list[FrameRecord]) -> KeyframeMap:
        """The run's own keyframes alone, which the frames hang on from now on, with what they saw."""
        own = _copied(keyframes, keyframes.keyframes[keyframes.num_known :])
        for record in records:
            if record.map_idx == self.map_idx and record.has_pose:
                record.join(self.map_idx, record.keyframe - keyframes.num_known)
        return own

    def lay_onto(self, own: KeyframeMap, keyframes: KeyframeMap) -> None:
        """Bring a map of the run's own, in place, to where the landmarks of the known one put its keyframes.

        Args:
            own: as of :meth:`take_apart`, adjusted since. keyframes: that it was taken from.
        """
        located = self._located(keyframes)
        rows = sorted(located)
        now = np.array([own.keyframes[k].rig_from_world for k in rows])
        _move_onto(own, now, np.array([located[k][0] for k in rows]))

    def hand_on(self, result: OdometryResult, records: list[FrameRecord]) -> None:
        """Give the map of a result that lies in the frame of the known one its unit of length, if it has no other."""
        rows = [n for n, r in enumerate(records) if r.map_idx == self.map_idx and r.has_pose]
        entry = result.maps[int(result.frame_map[rows[0]])]
        if entry.scale_source == "none":
            entry.scale_source = self._known.scale_source
            entry.scale_sigma = widened_scale_sigma(self._known.scale_sigma, entry.contradictions)

    def report(self, records: list[FrameRecord], keyframes: KeyframeMap | None, belief: BeliefReport) -> KnownMapReport:
        """What there is to say of it; keyframes: of the run in the known frame, None if no frame was found there."""
        posed = [record for record in records if record.has_pose]
        inside = [record for record in posed if record.map_idx == self.map_idx]
        num_localised = 0
        for record in inside:
            assert keyframes is not None
            ids = record.point_id
            if record.is_keyframe:
                keyframe = keyframes.keyframes[record.keyframe]
                ids = keyframe.point_id[keyframe.is_inlier[:, 0]].astype(np.int32)
            num_localised += int(np.count_nonzero(ids < self._before.num_points)) >= MIN_INLIERS
        against = self._against
        return KnownMapReport(
            source=self._known.source, num_keyframes=len(self.poses), num_places=self._num_places,
            is_found=bool(inside), num_localised=num_localised, num_new=len(inside) - num_localised,
            num_elsewhere=len(posed) - len(inside), belief=belief, max_sigmas=MAX_SIGMAS,
            position_sigmas=None if against is None else against.position_sigmas,
            rotation_sigmas=None if against is None else against.rotation_sigmas,
            moved=None if against is None else against.moved, worst=None if against is None else against.worst,
        )  # fmt: skip

    def contradiction(self, against: Disagreement) -> Contradiction:
        """What is said where the sequence contradicts the map."""
        sigmas = max(against.position_sigmas, against.rotation_sigmas)
        return Contradiction(
            "known map",
            f"the sequence contradicts {self._known.source}: over {against.num} keyframes positions differ by "
            f"{against.moved:.1%} of the size of the path and rotations by {against.turned_deg:.2g} degrees, "
            f"{sigmas:.1f} standard deviations of both together ({MAX_SIGMAS:g} are believed), {against.worst} most; "
            "the sequence keeps a map of its own, in the frame of the known one",
            "the known map is bent or of another state of the place, or a calibration is off: map it again, or "
            "calibrate",
            {
                "position_sigmas": min(against.position_sigmas, 1e9),
                "rotation_sigmas": min(against.rotation_sigmas, 1e9),
                "max_sigmas": MAX_SIGMAS, "num_keyframes": against.num,
            },
            rotation_sigma_deg=against.turned_deg, position_sigma_share=against.moved, scale_sigma=against.moved,
        )  # fmt: skip


def _of_world_points(camera: Camera, pose: Array, xyz: Array) -> tuple[Array, Array, Array]:
    """(N, 2) pixels, and their derivatives by world points (N, 2, 3) and by the pose (N, 2, 6), rotation first."""
    in_camera = rigid3.apply(pose, xyz)
    xy, by_point, _ = project_jacobian(camera, in_camera)
    by_turn = -by_point @ np.array([rigid3.skew(x) for x in in_camera])
    return xy, by_point @ rigid3.rotation_matrix(pose), np.concatenate([by_turn, by_point], 2)


def weighted_pose(
    camera: Camera, pose: Array, xyz: Array, xy: Array, of_points: Array, noise_px: float
) -> tuple[Array, Array]:
    """A pose by landmarks that are no truth: each counts by what the image and its own covariance leave open of where
    it is seen.

    Args:
        pose: (7,) cam_from_world to begin with. xyz: (N, 3) world, xy: (N, 2) pixels, of what agrees with that.
        of_points: (N, 3, 3) covariances of the landmarks. noise_px: standard deviation of a pixel coordinate.

    Returns:
        (7,) and (6, 6) over rotation (radians) and translation of ``x_cam <- exp(w) x_cam + v``.
    """
    noise = noise_px**2 * np.eye(2)
    for _ in range(_POSE_STEPS):
        seen, by_point, by_pose = _of_world_points(camera, pose, xyz)
        weight = np.linalg.inv(noise + by_point @ of_points @ by_point.transpose(0, 2, 1))
        normal = np.einsum("nki,nkl,nlj->ij", by_pose, weight, by_pose)
        step = np.linalg.solve(normal, np.einsum("nki,nkl,nl->i", by_pose, weight, xy - seen))
        turned = rigid3.from_matrix(rigid3.exp_so3(step[:3]), step[3:])
        pose = rigid3.compose(turned, pose)
    return pose, np.linalg.inv(normal)


def _copied(keyframes: KeyframeMap, chosen: list[Keyframe]) -> KeyframeMap:
    """Some keyframes of a map, with its points, as a map of their own."""
    out = KeyframeMap(keyframes.rig)
    ids = out.new_points(keyframes.num_points)
    out.point_xyz[ids] = keyframes.point_xyz[ids]
    for k in chosen:
        out.append(replace(k, rig_from_world=k.rig_from_world.copy(), is_inlier=k.is_inlier.copy()))
    return out


def _move_onto(keyframes: KeyframeMap, now: Array, wanted: Array) -> None:
    """Move a map, in place, so that poses (N, 7) lie where they are wanted; a rig keeps its unit of length."""
    try:
        wanted_from_now = similarity.align_poses(now, wanted).b_from_a
    except ValueError:  # all in one place: what was held there has kept it
        return
    if keyframes.rig.is_stereo:
        rotation = rigid3.rotation_matrix(wanted_from_now)
        shift = rigid3.center(wanted).mean(0) - rotation @ rigid3.center(now).mean(0)
        wanted_from_now = similarity.from_parts(rotation, shift, 1.0)
    num = keyframes.num_points
    keyframes.point_xyz[:num] = similarity.apply(wanted_from_now, keyframes.point_xyz[:num])
    for keyframe in keyframes.keyframes:
        keyframe.rig_from_world = similarity.transform_poses(wanted_from_now, keyframe.rig_from_world)


def _with_poses(model: Reconstruction, image_idx: Ids, poses: Array) -> Reconstruction:
    """The model with other poses (N, 7) of images (N,), on a rig of whole frames."""
    out = model.copy()
    out.move_images(image_idx, poses)
    return out


def _aligned(errors: Array, covariance: Array, basis: Array) -> Array:
    """Errors (n, 6) of poses once the gauge that is free, spanned by a basis (G, 6 n), takes up what it can of them, by
    their covariances (n, 6, 6): positions of a short path are less sure than its rotations, and may not turn them."""
    weight = np.linalg.inv(covariance)
    weighted = np.einsum("gni,nij->gnj", basis.reshape(len(basis), -1, 6), weight).reshape(len(basis), -1)
    taken = np.linalg.solve(weighted @ basis.T, weighted @ errors.ravel())
    return errors - (taken @ basis).reshape(-1, 6)


def _measured(errors: Array, covariance: Array, names: list[str], poses: Array) -> Disagreement:
    halves = [slice(0, 3), slice(3, 6)]
    share = [(errors[:, h] ** 2).sum(1) / np.trace(covariance[:, h, h], 0, 1, 2) for h in halves]
    rotation, position = (math.sqrt(float(s.mean())) for s in share)
    moved = math.sqrt(float((errors[:, 3:] ** 2).sum(1).mean())) / max(rigid3.spread(poses), 1e-300)
    turned = math.degrees(math.sqrt(float((errors[:, :3] ** 2).sum(1).mean())))
    worst = names[int(np.argmax(np.maximum(*share)))]
    return Disagreement(position, rotation, moved, turned, worst, len(names))
