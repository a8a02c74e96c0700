"""One connected map while it grows: keyframes, the images of the recent ones, and the adjustment beside."""

from __future__ import annotations

import math
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized, project
from sfmapp.geometry import rigid3
from sfmapp.geometry.triangulation import Observed, triangulate_tracks
from sfmapp.images.sequence import Imu
from sfmapp.odometry.frontend.active_tracks import ActiveTracks, References, align_to_references, patch_warp
from sfmapp.odometry.frontend.corners import find_corners
from sfmapp.odometry.frontend.pyramid import Pyramid
from sfmapp.odometry.frontend.row_motion import RowMotion
from sfmapp.odometry.frontend.stereo import match_stereo
from sfmapp.odometry.inertial.window import NUM_KEYFRAMES, turns_between
from sfmapp.odometry.map.backend import Backend, Job, choose_window, make_job
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.map.known_map import KnownPictures
from sfmapp.odometry.map.moving import Witnesses
from sfmapp.odometry.options import OdometryOptions
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Ids = NDArray[np.int64]

# Keyframes whose images are kept: references of patches and places to find lost points again.
_KEPT_IMAGES = 20
# A patch that has come to look less alike than that gets the newest keyframe as its reference.
_MIN_LIKENESS = 0.9
# Points that are looked for again: how alike and how near the prediction they must be, and the change of scale allowed.
_FOUND_LIKENESS, _FOUND_PX, _FOUND_SCALE = 0.85, 3.0, 1.5
# A point is blurred, not hidden, where it is found at this level of the pyramids, so alike and as near in pixels of
# the level. Of the points that are missing in blurred pictures 46 to 84 % are found so (flights exposed for 25 ms), of
# those behind something 0 to 15 %, in single frames 21 % (boards with textures from coarse to fine, and other rooms).
_BLURRED_LEVEL, _BLURRED_LIKENESS = 2, 0.7
# Points are looked for so far from the border, and where no track is in the same cell.
_MARGIN_PX, _CELL_PX = 8.0, 4
# Keyframes that must have seen a point before it counts as missing.
_OFTEN = 3
# A triangulated point agrees with its observations to that many pixels.
_TRIANGULATION_PX = 2.0


@dataclass(frozen=True)
class View:
    """A frame as the map sees it: which one it is, and its images (H, W) uint8, as they are and as pyramids."""

    frame_idx: int
    timestamp_s: float
    name: str
    images: tuple[NDArray[np.uint8], ...]
    pyramids: tuple[Pyramid, ...]


@dataclass(frozen=True)
class _Sought:
    """Points that should be in sight.

    Attributes:
        tracks: each as the keyframe of its reference saw it.
        guess: (N, 2) pixels where they are expected. warp: (N, 2, 2) of :func:`patch_warp`.
    """

    tracks: ActiveTracks
    guess: Array
    warp: Array

    def subset(self, chosen: Mask) -> _Sought:
        """Some of them."""
        return _Sought(self.tracks.subset(chosen), self.guess[chosen], self.warp[chosen])


class LocalMap:
    """Keyframes, points and the images that points are looked for with."""

    def __init__(
        self, rig: Rig, options: OdometryOptions, executor: Executor | None, map_idx: int, imu: Imu | None = None
    ) -> None:
        self.rig, self.options, self.map_idx, self._imu = rig, options, map_idx, imu
        self.keyframes = KeyframeMap(rig)
        self.backend = Backend(executor)
        self.images: dict[int, Pyramid] = {}
        self.witnesses = Witnesses()
        self.known = KnownPictures({})

    @property
    def camera(self) -> Camera:
        return self.rig.cameras[0]

    @property
    def newest(self) -> int:
        """Position of the newest keyframe."""
        return len(self.keyframes.keyframes) - 1

    def pose(self, keyframe: int) -> Array:
        """(7,) rig_from_world of a keyframe."""
        return self.keyframes.keyframes[keyframe].rig_from_world

    def references(self, tracks: ActiveTracks) -> References:
        """The keyframes that tracks refer to."""
        keyframe = np.unique(tracks.reference)
        return References.of(keyframe, np.array([self.pose(int(k)) for k in keyframe]))

    def points_of(self, tracks: ActiveTracks) -> tuple[Array, Mask]:
        """(N, 3) world points of tracks, guessed where they are not in the map, and (N,) which are in it."""
        xyz = self.keyframes.point_xyz[tracks.point_id]
        mapped = np.isfinite(xyz[:, 0])
        guessed = tracks.subset(~mapped)
        xyz[~mapped] = guessed.world_points(self.references(guessed))
        return xyz, mapped

    def redundant_keyframe(self) -> int | None:
        """The keyframe whose image was dropped last, if others of this run see nearly all that it sees (Mur-Artal et
        al., "ORB-SLAM", 2015, section VI-E)."""
        position = self.newest - _KEPT_IMAGES
        if position <= self.keyframes.num_known or self.options.cull_seen >= 1:
            return None
        keyframe = self.keyframes.keyframes[position]
        ids = keyframe.point_id[keyframe.is_inlier[:, 0] & self.keyframes.is_triangulated(keyframe.point_id)]
        others = self.keyframes.num_own_observations(ids) // len(self.rig.cameras) - 1
        return position if (others >= 3).mean() > self.options.cull_seen else None

    def remove_keyframe(self, position: int) -> Keyframe:
        """Drop a keyframe without an image; no adjustment may be under way."""
        self.images = {k - 1: image for k, image in self.images.items()}
        return self.keyframes.remove(position)

    def begin(self, view: View, corners: Array) -> ActiveTracks:
        """Make the first keyframe of a map, at the identity, of corners (N, 2) without depth; returns their tracks."""
        self.images[0] = view.pyramids[0]
        tracks = self.start_tracks(corners, 0, ActiveTracks.none())
        self._append(view, rigid3.IDENTITY, tracks)
        return tracks

    def tracks_of_newest(self) -> ActiveTracks:
        """The tracks that the newest keyframe saw, looked for as it saw them from now on: the map has changed."""
        keyframe, number = self.keyframes.keyframes[-1], self.newest
        known = self.mapped_tracks_of(number)
        guessed = keyframe.is_inlier[:, 0] & ~self.keyframes.is_triangulated(keyframe.point_id)
        return known.joined(self._tracks(keyframe.point_id[guessed], keyframe.xy[guessed, 0], number, known))

    def mapped_tracks_of(self, position: int) -> ActiveTracks:
        """The points of the map that a keyframe saw, looked for as it saw them."""
        keyframe = self.keyframes.keyframes[position]
        mapped = keyframe.is_inlier[:, 0] & self.keyframes.is_triangulated(keyframe.point_id)
        known = self.tracks_at(keyframe.point_id[mapped], keyframe.xy[mapped, 0], keyframe.rig_from_world)
        return replace(known, reference=np.full(len(known), position))

    def tracks_at(self, point_id: NDArray[np.int64], xy: Array, pose: Array) -> ActiveTracks:
        """Tracks of points (N,), ascending, seen at pixels (N, 2) of a frame that is to become the next keyframe."""
        depth = rigid3.apply(pose, self.keyframes.point_xyz[point_id])[:, 2]
        number = np.full(len(point_id), self.newest + 1)
        ray = pixels_to_normalized(self.camera, xy)
        return ActiveTracks(point_id, xy, number, xy.copy(), ray, 1 / depth, np.ones(len(xy), np.float32))

    def find_known(self, pyramid: Pyramid, pose: Array) -> ActiveTracks:
        """The landmarks of the known map that should be in sight from a pose (7,), as its pictures show them.

        A corner that looks like a landmark is up to a pixel from it; its patch is found to a tenth.
        """
        known = self.known.near(self.keyframes, pose)
        if not known:
            return ActiveTracks.none()
        recent, self.images = self.images, known
        expected = self._expected(ActiveTracks.none(), pyramid, pose, RowMotion())
        found = self._find_again(expected, ActiveTracks.none(), pyramid)
        self.images = recent
        return found

    def add_keyframe(
        self, view: View, pose: Array, tracks: ActiveTracks, frame_number: int, rows: RowMotion | None = None
    ) -> ActiveTracks:
        """Make a keyframe of a tracked view: find lost points again, add corners, triangulate, begin to adjust.

        Args:
            view: the frame. pose: (7,) its rig_from_world. tracks: what was tracked into it, outliers left out.
            frame_number: frames processed so far, the clock of the backend.
            rows: how the camera moved while the frame was read; None: it did not.

        Returns:
            The tracks to follow from here.
        """
        pyramid, rows = view.pyramids[0], rows or RowMotion()
        known = self.known.near(self.keyframes, pose)
        self.images |= known
        if self.images:
            sought = self._expected(tracks, pyramid, pose, rows)
            found = self._find_again(sought, tracks, pyramid)
            self._count_visible(view.frame_idx, tracks.point_id, found.point_id, sought, pyramid)
            tracks = tracks.joined(found)
        for position in known:
            del self.images[position]
        number = self.newest + 1
        self.images[number] = pyramid
        tracks = self._renew_references(tracks, number, pose)
        tracks = tracks.joined(self._new_corners(tracks, pyramid, number))
        self._append(view, pose, tracks)
        if rows.readout:
            tracks = self._straighten_newest(tracks, rows)
        if len(view.pyramids) > 1:
            self._match_stereo(view, tracks)
        self.backend.finish(self.keyframes)
        self._adjust(tracks, frame_number)
        for old in [k for k in self.images if k <= number - _KEPT_IMAGES]:
            del self.images[old]
        return tracks

    def _straighten_newest(self, tracks: ActiveTracks, rows: RowMotion) -> ActiveTracks:
        """Note what a rolling shutter has done to the newest keyframe, and where its new references lie without it."""
        keyframe, number = self.keyframes.keyframes[-1], self.newest
        shift = rows.shift_px(self.camera, keyframe.rig_from_world, self.points_of(tracks)[0], tracks.xy)
        keyframe.row_shift, ray = shift, tracks.reference_ray.copy()
        here = tracks.reference == number
        ray[here] = pixels_to_normalized(self.camera, tracks.xy[here] - shift[here])
        return replace(tracks, reference_ray=ray)

    def _append(self, view: View, pose: Array, tracks: ActiveTracks) -> None:
        xy = np.full((len(tracks), len(self.rig.cameras), 2), np.nan)
        xy[:, 0] = tracks.xy
        seen = np.isfinite(xy[:, :, 0])
        self.keyframes.append(
            Keyframe(view.frame_idx, view.timestamp_s, view.name, pose.copy(), tracks.point_id, xy, seen)
        )

    def _adjust(self, tracks: ActiveTracks, frame_number: int) -> None:
        """Triangulate what has become triangulable, and begin to adjust the window."""
        job = make_job(self.keyframes, *choose_window(self.keyframes, self.options))
        self._triangulate(job, tracks.point_id)
        if self._imu is not None:
            first = max(self.keyframes.num_known, self.newest + 1 - NUM_KEYFRAMES)
            recent = self.keyframes.keyframes[first:]
            times = np.array([keyframe.timestamp_s for keyframe in recent])
            poses = np.array([keyframe.rig_from_world for keyframe in recent])
            job.turns = turns_between(times, poses, self._imu, first)
        self.backend.begin(job, frame_number)

    def _triangulate(self, job: Job, wanted: NDArray[np.int64]) -> None:
        """Triangulate those of the wanted points (ids) that are not in the map, from the views of a job."""
        model, tracks = job.model, job.model.tracks
        new = np.flatnonzero(np.isnan(model.point_xyz[:, 0]) & np.isin(job.point_id, wanted, assume_unique=True))
        smallest = self.options.min_stereo_deg if self.rig.is_stereo else self.options.min_triangulation_deg
        triangulate_tracks(
            new, Observed(tracks.track_ptr, tracks.obs_image_idx, tracks.obs_xy), model.views(), _TRIANGULATION_PX,
            math.radians(smallest), model.point_xyz, model.obs_is_inlier,
        )  # fmt: skip
        self.keyframes.point_xyz[job.point_id[new]] = model.point_xyz[new]

    def _count_visible(self, frame_idx: int, tracked: Ids, found: Ids, sought: _Sought, pyramid: Pyramid) -> None:
        """Note how many of the points that should be in sight, and that have been seen often, are."""
        num_seen = _OFTEN * len(self.rig.cameras)
        # of a map that was there before the report tells apart from these
        tracked, found = (ids[ids >= self.keyframes.num_known_points] for ids in (tracked, found))
        sought = sought.subset(sought.tracks.point_id >= self.keyframes.num_known_points)
        tracked = tracked[self.keyframes.is_triangulated(tracked)]
        num = [
            int((self.keyframes.num_observations(ids) >= num_seen).sum())
            for ids in (tracked, found, sought.tracks.point_id)
        ]
        expected, seen, num_blurred = num[0] + num[2], num[0] + num[1], 0
        if self.witnesses.misses(expected, seen):
            often = self.keyframes.num_observations(sought.tracks.point_id) >= num_seen
            missing = often & ~np.isin(sought.tracks.point_id, found)
            num_blurred = self._count_blurred(sought.subset(missing), pyramid)
        self.witnesses.visible(frame_idx, expected, seen, num_blurred)

    def _count_blurred(self, sought: _Sought, pyramid: Pyramid) -> int:
        """How many of the points that are not found are there all the same in a picture too blurred to find them in:
        in one of a quarter of the size they lie where they should, which what is behind something else does not."""
        scale = 2.0**_BLURRED_LEVEL
        if pyramid.num_levels <= _BLURRED_LEVEL:
            return 0
        coarse = replace(sought.tracks, reference_xy=sought.tracks.reference_xy / scale)
        images = {k: self.images[int(k)].reduced(_BLURRED_LEVEL) for k in np.unique(coarse.reference).tolist()}
        guess = sought.guess / scale
        xy, zncc, found = align_to_references(
            coarse, images, pyramid.reduced(_BLURRED_LEVEL), guess, sought.warp, coarsest_level=1
        )
        found &= (np.linalg.norm(xy - guess, axis=1) < _FOUND_PX) & (zncc > _BLURRED_LIKENESS)
        return int(found.sum())

    def _find_again(self, sought: _Sought, tracks: ActiveTracks, pyramid: Pyramid) -> ActiveTracks:
        """Look for points that are not tracked any more."""
        sought = sought.subset(self._is_free(sought.guess, tracks.xy, pyramid.shape[1]))
        xy, zncc, found = align_to_references(
            sought.tracks, self.images, pyramid, sought.guess, sought.warp, coarsest_level=1
        )
        found &= (np.linalg.norm(xy - sought.guess, axis=1) < _FOUND_PX) & (zncc > _FOUND_LIKENESS)
        return replace(sought.tracks, xy=xy, zncc=zncc).subset(found)

    def _expected(self, tracks: ActiveTracks, pyramid: Pyramid, pose: Array, rows: RowMotion) -> _Sought:
        """The points of recent keyframes that are not tracked any more and should be in sight, and where."""
        lost = self._lost_points(tracks)
        xyz = self.keyframes.point_xyz[lost.point_id]
        references = self.references(lost)
        k = references.position(lost.reference)
        in_camera = rigid3.apply(pose, xyz)
        in_reference = np.einsum("nij,nj->ni", references.rotation[k], xyz) + references.translation[k]
        guess, ratio = project(self.camera, in_camera), in_camera[:, 2] / in_reference[:, 2]
        guess += rows.shift_px(self.camera, pose, xyz, guess)
        height, width = pyramid.shape
        margin = np.minimum(guess, np.array([width, height]) - guess).min(1)
        near = (margin > _MARGIN_PX) & (ratio < _FOUND_SCALE) & (ratio > 1 / _FOUND_SCALE)  # False for NaN
        guess, ratio, k, depth = guess[near], ratio[near], k[near], in_reference[near, 2]
        lost = replace(
            lost.subset(near), reference_ray=in_reference[near, :2] / depth[:, None], inverse_depth=1 / depth
        )
        warp = patch_warp(references.camera_from(pose)[0][k], lost.reference_ray, ratio)
        return _Sought(lost, guess, warp)

    def _lost_points(self, tracks: ActiveTracks) -> ActiveTracks:
        """Points of keyframes whose images are kept that are not tracked, each as the newest of these saw it."""
        kept = sorted(self.images)
        seen = [self.keyframes.keyframes[k] for k in kept]
        point_id = np.concatenate([k.point_id for k in seen])
        xy = np.concatenate([k.xy[:, 0] for k in seen])
        reference = np.repeat(kept, [len(k.point_id) for k in seen])
        wanted = np.concatenate([k.is_inlier[:, 0] for k in seen]) & self.keyframes.is_triangulated(point_id)
        known = np.zeros(self.keyframes.num_points, bool)
        known[tracks.point_id] = True
        chosen = np.flatnonzero(wanted & ~known[point_id])[::-1]
        ids, newest = np.unique(point_id[chosen], return_index=True)
        chosen = chosen[newest]
        ones = np.ones(len(ids))
        return ActiveTracks(
            ids, xy[chosen], reference[chosen], xy[chosen], np.zeros((len(ids), 2)), ones, ones.astype(np.float32)
        )

    def _is_free(self, xy: Array, taken_xy: Array, width: int) -> Mask:
        """(N,) which places have no track in their cell of 4 pixels; of several in a cell, the first."""
        columns = width // _CELL_PX + 1
        taken = np.floor_divide(taken_xy, _CELL_PX).astype(np.int64) @ [1, columns]
        cells = np.floor_divide(xy, _CELL_PX).astype(np.int64) @ [1, columns]
        free = np.zeros(len(xy), bool)
        free[np.unique(cells, return_index=True)[1]] = True
        return free & ~np.isin(cells, taken)

    def _renew_references(self, tracks: ActiveTracks, number: int, pose: Array) -> ActiveTracks:
        """Give tracks whose patch has changed, or whose reference image will be dropped, the new keyframe."""
        oldest = max(number - _KEPT_IMAGES + 1, self.keyframes.num_known - 1)
        stale = (tracks.zncc < _MIN_LIKENESS) | (tracks.reference <= oldest)
        xyz, _ = self.points_of(tracks)
        reference, reference_xy = tracks.reference.copy(), tracks.reference_xy.copy()
        ray, inverse_depth = tracks.reference_ray.copy(), tracks.inverse_depth.copy()
        reference[stale], reference_xy[stale] = number, tracks.xy[stale]
        ray[stale] = pixels_to_normalized(self.camera, tracks.xy[stale])
        inverse_depth[stale] = 1 / np.maximum(rigid3.apply(pose, xyz[stale])[:, 2], 1e-6)
        return replace(
            tracks, reference=reference, reference_xy=reference_xy, reference_ray=ray, inverse_depth=inverse_depth
        )

    def _new_corners(self, tracks: ActiveTracks, pyramid: Pyramid, number: int) -> ActiveTracks:
        """Corners where there are no tracks; their depth is guessed from their neighbours in the image."""
        wanted = self.options.max_tracks - len(tracks)
        if wanted < self.options.max_tracks // 50:
            return ActiveTracks.none()
        height, width = pyramid.shape
        spacing = 0.5 * math.sqrt(height * width / self.options.max_tracks)
        xy = find_corners(pyramid, tracks.xy, wanted, min_distance_px=spacing)
        return self.start_tracks(xy, number, tracks)

    def start_tracks(self, xy: Array, number: int, neighbours: ActiveTracks) -> ActiveTracks:
        """New tracks at corners (N, 2) of a keyframe."""
        return self._tracks(self.keyframes.new_points(len(xy)), xy, number, neighbours)

    def _tracks(self, point_id: NDArray[np.int64], xy: Array, number: int, neighbours: ActiveTracks) -> ActiveTracks:
        """Tracks seen at (N, 2) in a keyframe, with the depths of their neighbours in the image for a guess."""
        inverse_depth = np.ones(len(xy))
        depths = self._inverse_depths(neighbours, number)
        known = np.isfinite(depths)
        if known.any() and len(xy):
            squared = ((xy[:, None] - neighbours.xy[known][None]) ** 2).sum(2)
            inverse_depth = depths[known][np.argmin(squared, 1)]
        return ActiveTracks(
            point_id, xy, np.full(len(xy), number), xy.copy(), pixels_to_normalized(self.camera, xy), inverse_depth,
            np.ones(len(xy), np.float32),
        )  # fmt: skip

    def _inverse_depths(self, tracks: ActiveTracks, number: int) -> Array:
        """(N,) inverse depths of tracks in a keyframe that may not be in the map yet; NaN for unmapped points."""
        if number > self.newest:
            return np.where(np.isfinite(self.keyframes.point_xyz[tracks.point_id, 0]), tracks.inverse_depth, np.nan)
        in_camera = rigid3.apply(self.pose(number), self.keyframes.point_xyz[tracks.point_id])
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(in_camera[:, 2] > 0, 1 / in_camera[:, 2], np.nan)

    def _match_stereo(self, view: View, tracks: ActiveTracks) -> None:
        """Find the tracks of the newest keyframe in the other camera of the rig."""
        keyframe = self.keyframes.keyframes[-1]
        xyz, mapped = self.points_of(tracks)
        depth = np.where(mapped, rigid3.apply(keyframe.rig_from_world, xyz)[:, 2], np.nan)
        keyframe.xy[:, 1] = match_stereo(self.rig, view.pyramids, tracks.xy, depth)
        keyframe.is_inlier[:, 1] = np.isfinite(keyframe.xy[:, 1, 0])
        self.keyframes.count(keyframe.point_id, keyframe.is_inlier[:, 1])
