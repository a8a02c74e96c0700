"""How a map begins: two views with enough parallax, or one look of a stereo rig."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.pose import refine_pose
from sfmapp.camera.camera import Camera, pixels_to_normalized, project
from sfmapp.geometry import epipolar, homography, rigid3
from sfmapp.geometry.planar_motion import NumPoints, estimate_planar_motion
from sfmapp.geometry.relative_pose import refine_on_inliers
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.search import Ransac
from sfmapp.matching.two_view import TwoViewGeometry, verify_front
from sfmapp.odometry.frontend.alignment import align_patches
from sfmapp.odometry.frontend.corners import find_corners
from sfmapp.odometry.frontend.pose_choice import RIVAL_SHARE, explaining_poses, is_way_known, tells_apart
from sfmapp.odometry.frontend.pyramid import Pyramid
from sfmapp.odometry.frontend.small_image import align_small_images
from sfmapp.odometry.options import OdometryOptions
from sfmapp.scene.correspondences import TwoViewConfig

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# The first view is given up for a newer one when fewer of its corners are left.
_MIN_LEFT = 0.4
# Before that, where fewer are left than this, parallax is as large as it gets: the best of several motions will do if
# the next is worse by this factor.
_LATE, _LATE_RIVAL_SHARE = 0.5, 1.15
# Share of the corners that have to agree; and on wheels, where two angles tell which do, if so many of these are where
# they should be in the views between as well.
_MIN_AGREEING, _MIN_AGREEING_ON_WHEELS, _MIN_AGREEING_BETWEEN = 0.5, 0.15, 0.7
# Nod and roll on springs, in which a planar motion that is looked for has no say, move points by so many times the
# limit; inliers are then found by a motion without a plane.
_SPRINGS = 2.5
# A robot's camera looks level to this, and nods and rolls by less than that from one view to another.
_LEVEL_RAD, _NOD_RAD = float(np.radians(10.0)), float(np.radians(2.0))
# Displacement, as a share of the image width, below which two views are not even looked at.
_MIN_FLOW = 0.01
# Fewest points of a first map; half of what pose refinement and the keyframe rules are comfortable with.
_MIN_POINTS = 40
# A first map needs a median angle that bounds its depth errors to a few percent at a quarter pixel of noise.
_MIN_MEDIAN_ANGLE_DEG = 0.8
# A rolling shutter that turns ever faster bends two images so that depths explain it, but not the frames in between,
# which had no say: there, what is left beside the points may be this share of what is left beside a mere turn. At that
# share depth explains 95 % of the squared motion. Asked are the frames at which corners had moved about these shares.
_MAX_LEFT_SHARE, _WITNESSES_AT = 0.22, (0.25, 0.5, 0.75)
# Corners are located to that anyway.
_NOISE_PX = 0.2
# Without a frame in between, a mere turn has to leave this share of the displacement.
_MIN_NOT_TURNED = 0.5


@dataclass(frozen=True)
class TwoViews:
    """The two views that a map begins with.

    Attributes:
        first, last: positions among the frames seen since the first view (first is 0).
        last_from_first: (7,) pose; the median depth of the points in the first view is 1.
        track: (N,) int64 positions of the corners that have become points. xyz: (N, 3) in the frame of the first view.
        config: what the pair looks like. median_angle_deg, num_inliers, num_tracks: the numbers behind the decision.
    """

    last_from_first: Array
    track: NDArray[np.int64]
    xyz: Array
    config: TwoViewConfig
    median_angle_deg: float
    num_inliers: int
    num_tracks: int


@dataclass
class MapInitializer:
    """Follows corners from a first view until two views make a map.

    Attributes:
        first: pyramid of the first view. corners: (N, 2) where they were in it.
        seen: for every frame since, (N, 2) where the corners are, NaN where they were lost; first the corners.
        reason: why there is no map yet.
        is_still, is_turn: of the last frame: the picture has hardly moved since the first view, or as by a mere turn.
    """

    camera: Camera
    options: OdometryOptions
    seed: int
    first: Pyramid | None = None
    corners: Array = field(default_factory=lambda: np.zeros((0, 2)))
    seen: list[Array] = field(default_factory=list)
    reason: str = "no frame yet"
    is_still: bool = False
    is_turn: bool = False
    _previous: Pyramid | None = None

    def restart(self, pyramid: Pyramid) -> None:
        """Begin anew with this frame as the first view."""
        height, width = pyramid.shape
        spacing = 0.5 * np.sqrt(height * width / self.options.max_tracks)
        self.first = self._previous = pyramid
        self.corners = find_corners(pyramid, np.zeros((0, 2)), self.options.max_tracks, min_distance_px=float(spacing))
        self.seen = [self.corners]

    def add(self, pyramid: Pyramid) -> TwoViews | None:
        """Follow the corners into the next frame; returns two views as soon as they make a map."""
        self.is_still = self.is_turn = False
        if self.first is None or self._previous is None:
            self.restart(pyramid)
            self.reason = "waiting for motion"
            return None
        self.seen.append(self._follow(pyramid))
        self._previous = pyramid
        left = np.isfinite(self.seen[-1][:, 0])
        if left.sum() < max(_MIN_POINTS, _MIN_LEFT * len(self.corners)):
            self.reason = f"{int(left.sum())} of {len(self.corners)} corners are left of the first view"
            self.restart(pyramid)
            return None
        flow = np.linalg.norm(self.seen[-1][left] - self.corners[left], axis=1)
        if np.median(flow) < _MIN_FLOW * self.camera.width:
            self.reason, self.is_still = "hardly any motion in the image", True
            return None
        return self._two_views(np.flatnonzero(left))

    def _follow(self, pyramid: Pyramid) -> Array:
        """(N, 2) corners in a new frame: found from the last frame, then measured against the first view."""
        assert self.first is not None
        assert self._previous is not None
        xy = np.full_like(self.corners, np.nan)
        alive = np.flatnonzero(np.isfinite(self.seen[-1][:, 0]))
        if not len(alive):
            return xy
        before = self.seen[-1][alive]
        guess, rotation = before, align_small_images(self._previous, pyramid, self.camera.focal)
        if rotation is not None:
            rays = np.column_stack([pixels_to_normalized(self.camera, before), np.ones(len(before))])
            turned = project(self.camera, rays @ rotation.T)
            guess = np.where(np.isfinite(turned), turned, before)
        step = align_patches(self._previous, before, pyramid, guess, coarsest_level=4)
        alive, there = alive[step.is_converged], step.xy[step.is_converged]
        xy[alive] = there
        anew = align_patches(self.first, self.corners[alive], pyramid, there, coarsest_level=1)
        # where both agree the first view counts, as its error does not grow from frame to frame
        better = anew.is_converged & (np.linalg.norm(anew.xy - there, axis=1) < 1.5)
        xy[alive[better]] = anew.xy[better]
        return xy

    def _two_views(self, track: NDArray[np.int64]) -> TwoViews | None:
        xy1, xy2 = self.corners[track], self.seen[-1][track]
        limit = max(1.0, 1e-3 * self.camera.width)
        found = verify_front(
            xy1, xy2, self.camera, self.camera, MatchingOptions(max_error_px=limit), Ransac(2000, self.seed)
        )
        if self.options.motion != "free" and found.config != TwoViewConfig.PANORAMIC:
            self._hold_to_plane(found, xy1, xy2, limit)
        num = int(found.is_inlier.sum())
        usable = found.config in (TwoViewConfig.CALIBRATED, TwoViewConfig.PLANAR, TwoViewConfig.UNCALIBRATED)
        if not usable or not np.isfinite(found.cam2_from_cam1).all():
            self.reason = f"the two views look like {found.config.name}"
            self.is_turn = found.config in (TwoViewConfig.PANORAMIC, TwoViewConfig.PLANAR_OR_PANORAMIC)
            return None
        least = _MIN_AGREEING if self.options.motion == "free" else _MIN_AGREEING_ON_WHEELS
        if found.median_angle_deg < _MIN_MEDIAN_ANGLE_DEG or num < max(_MIN_POINTS, least * len(track)):
            self.reason = f"{num} of {len(track)} corners agree, {found.median_angle_deg:.2f} deg of parallax"
            return None
        # a plane tells which corners agree; how the camera nodded and rolled in it they tell by themselves
        pose = self._only_pose(found.cam2_from_cam1, track[found.is_inlier], limit)
        if pose is None:
            self.reason = "several motions explain the two views alike"
            return None
        xn1, xn2 = (pixels_to_normalized(self.camera, xy[found.is_inlier]) for xy in (xy1, xy2))
        depths, angles = epipolar.ray_depths(pose, xn1, xn2)
        good = (depths > 0).all(1) & (np.degrees(angles) > 0.25 * _MIN_MEDIAN_ANGLE_DEG)
        if good.sum() < _MIN_POINTS:
            self.reason = f"{int(good.sum())} points with depth"
            return None
        shown = np.column_stack([xn1, np.ones(len(xn1))]) * depths[:, :1]
        with_depth = int(good.sum())
        if num < _MIN_AGREEING * len(track):
            good[good] = self._agree_between(pose, track[found.is_inlier][good], shown[good], limit)
        if good.sum() < max(_MIN_POINTS, _MIN_AGREEING_BETWEEN * with_depth) or not self._is_confirmed(
            pose, track[found.is_inlier][good], shown[good]
        ):
            self.reason = "the frames in between do not show the same depths"
            return None
        unit = 1.0 / float(np.median(depths[good, 0]))
        pose = np.concatenate([pose[:4], unit * pose[4:]])
        return TwoViews(
            pose,
            track[found.is_inlier][good],
            unit * shown[good],
            found.config,
            found.median_angle_deg,
            num,
            len(track),
        )

    def _only_pose(self, given: Array, track: NDArray[np.int64], limit_px: float) -> Array | None:
        """The relative pose of the first and the last view, None if others explain them and those between as well."""
        xy1, xy2 = self.corners[track], self.seen[-1][track]
        poses, costs = explaining_poses(self.camera, xy1, xy2, given, limit_px)
        if len(track) < _MIN_AGREEING * int(np.isfinite(self.seen[-1][:, 0]).sum()):
            # wrong matches make rivals, most of which no vehicle can do
            is_car = self.options.motion == "ackermann"
            on_wheels = [k for k, pose in enumerate(poses) if _is_on_wheels(pose, is_car=is_car)]
            poses, costs = [poses[k] for k in on_wheels], costs[on_wheels]
        if not poses:
            return None
        own = costs.copy()
        if len(poses) > 1:
            for n in self._witnesses(track):
                costs += [self._left_between(pose, track, n, limit_px) for pose in poses]
        order = np.argsort(costs, kind="stable")
        best = int(order[0])
        is_late = len(track) < _LATE * len(self.corners)
        share = _LATE_RIVAL_SHARE if is_late else RIVAL_SHARE
        if len(poses) > 1 and not tells_apart(costs[best], costs[order[1]], len(track), share):
            return None
        return poses[best] if is_way_known(self.camera, poses[best], xy1, xy2, own[best]) else None

    def _left_between(self, last_from_first: Array, track: NDArray[np.int64], n: int, limit_px: float) -> float:
        """Squared residuals, pixels, of the n-th view where points are made of the first and the last."""
        first_xy, last_xy, xy = self.corners[track], self.seen[-1][track], self.seen[n][track]
        xn1, xn2 = (pixels_to_normalized(self.camera, pixels) for pixels in (first_xy, last_xy))
        depths, _ = epipolar.ray_depths(last_from_first, xn1, xn2)
        xyz = np.column_stack([xn1, np.ones(len(xn1))]) * depths[:, :1]
        known = np.isfinite(xy[:, 0]) & (depths > 0).all(1)
        error = self._errors_between(last_from_first, n, xyz[known], xy[known])
        squared = np.minimum(np.nan_to_num(error**2, nan=limit_px**2), limit_px**2)
        return float(squared.sum()) + limit_px**2 * int((np.isfinite(xy[:, 0]) & ~known).sum())

    def _errors_between(self, last_from_first: Array, n: int, xyz: Array, xy: Array) -> Array:
        """(N,) pixels by which points are off in the n-th view, its pose fitted to them; NaN behind the camera."""
        camera = self.camera
        start = rigid3.interpolate(rigid3.IDENTITY, last_from_first, n / (len(self.seen) - 1))
        pose = refine_pose(camera.canonical, start, xyz, xy).cam_from_world
        return np.asarray(np.linalg.norm(project(camera, rigid3.apply(pose, xyz)) - xy, axis=1), np.float64)

    def _witnesses(self, track: NDArray[np.int64]) -> list[int]:
        """Views between the first and the last at which the corners had moved by certain shares of their way."""
        last, first_xy = len(self.seen) - 1, self.corners[track]
        flow = float(np.median(np.linalg.norm(self.seen[-1][track] - first_xy, axis=1)))
        moved = np.array([np.nanmedian(np.linalg.norm(xy[track] - first_xy, axis=1)) for xy in self.seen[1:last]])
        return sorted({1 + int(np.argmin(np.abs(moved - share * flow))) for share in _WITNESSES_AT if len(moved)})

    def _is_confirmed(self, last_from_first: Array, track: NDArray[np.int64], xyz: Array) -> bool:
        """Whether points (N, 3) made of the first and the last view explain the views between them."""
        last, camera = len(self.seen) - 1, self.camera
        first_xy, last_xy = self.corners[track], self.seen[-1][track]
        flow = float(np.median(np.linalg.norm(last_xy - first_xy, axis=1)))
        if last == 1:
            return _left_by_turn(camera, first_xy, last_xy) > _MIN_NOT_TURNED * flow
        left, turned = 0.0, 0.0
        for n in self._witnesses(track):
            xy = self.seen[n][track]
            known = np.isfinite(xy[:, 0])
            if known.sum() < _MIN_POINTS:
                continue
            error = self._errors_between(last_from_first, n, xyz[known], xy[known])
            error = np.nan_to_num(error, nan=camera.width)  # a point behind its camera explains nothing
            left += max(0.0, float(np.median(error)) ** 2 - _NOISE_PX**2)
            turned += _left_by_turn(camera, first_xy[known], xy[known]) ** 2
        return left < _MAX_LEFT_SHARE**2 * turned

    def _agree_between(self, last_from_first: Array, track: NDArray[np.int64], xyz: Array, limit_px: float) -> Mask:
        """(N,) which points are within a limit of where they should be in every view between that is asked."""
        agree = np.ones(len(track), bool)
        for n in self._witnesses(track):
            xy = self.seen[n][track]
            known = np.isfinite(xy[:, 0])
            if known.sum() >= _MIN_POINTS:
                error = self._errors_between(last_from_first, n, xyz[known], xy[known])
                agree[known] &= error < limit_px  # False behind a camera
        return agree

    def _hold_to_plane(self, found: TwoViewGeometry, xy1: Array, xy2: Array, limit_px: float) -> None:
        """Put a motion that begins with a wheeled robot's in the place of one where that explains fewer corners: two
        unknowns bear more outliers than five; springs and a camera that does not look level come after."""
        xn1, xn2 = (pixels_to_normalized(self.camera, xy) for xy in (xy1, xy2))
        num_points: NumPoints = 1 if self.options.motion == "ackermann" else 2
        limit = limit_px / self.camera.focal
        planar = estimate_planar_motion(xn1, xn2, _SPRINGS * limit, seed=self.seed, num_points=num_points)
        if planar is None:
            return
        pose, errors = refine_on_inliers(planar[0], xn1, xn2, limit, first_gate=_SPRINGS * limit, rounds=8)
        is_inlier = errors < limit**2
        if is_inlier.sum() <= found.is_inlier.sum():
            return
        found.cam2_from_cam1, found.is_inlier = pose, is_inlier
        found.config = TwoViewConfig.CALIBRATED
        _, angles = epipolar.ray_depths(found.cam2_from_cam1, xn1[found.is_inlier], xn2[found.is_inlier])
        found.median_angle_deg = float(np.degrees(np.median(angles))) if len(angles) else 0.0


def _is_on_wheels(cam2_from_cam1: Array, *, is_car: bool) -> bool:
    """Whether a pose is what a camera that looks about level can do on level ground; one on a car, looking ahead, goes
    where it looks or back, along half of its turn over the rear axle and all of it far ahead of that."""
    turn, way = rigid3.log_so3(rigid3.rotation_matrix(cam2_from_cam1)), rigid3.center(cam2_from_cam1)
    way /= np.linalg.norm(way)
    nod, slack = float(np.hypot(turn[0], turn[2])), float(np.sin(_LEVEL_RAD))
    is_level = abs(way[1]) < slack and nod < _NOD_RAD + slack * abs(turn[1])
    # cam2_from_cam1 turns against the car
    aside = float(np.arctan2(way[0], way[2]) if way[2] > 0.0 else np.arctan2(-way[0], -way[2]))
    low, high = sorted((0.0, -float(turn[1])))
    return bool(is_level and (not is_car or low - _LEVEL_RAD < aside < high + _LEVEL_RAD))


def _left_by_turn(camera: Camera, xy1: Array, xy2: Array) -> float:
    """Median distance in pixels between (N, 2) corners in a view and where the best turn alone takes them."""
    rays1, rays2 = pixels_to_normalized(camera, xy1), pixels_to_normalized(camera, xy2)
    weights = np.ones(len(xy1))
    for _ in range(4):
        rotation = homography.rotation_from_rays(rays1, rays2, weights)
        turned = project(camera, np.column_stack([rays1, np.ones(len(rays1))]) @ rotation.T)
        error = np.nan_to_num(np.linalg.norm(turned - xy2, axis=1), nan=camera.width)
        median = float(np.median(error))
        weights = 1.0 / (1.0 + (error / max(median, 1e-9)) ** 2)
    return median
