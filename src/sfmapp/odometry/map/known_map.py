"""A map that was there before: an earlier run, or a reconstruction of photographs, as keyframes that tracking can use.

All that tracking does with keyframes it does in one camera. So photographs of other cameras are turned into what the
sequence's own camera would have seen from where they were taken: pictures by resampling, observations by their rays.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized, project
from sfmapp.errors import UsageError
from sfmapp.geometry import rigid3
from sfmapp.odometry.frontend.pyramid import Pyramid, build_pyramid
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

# Known pictures that landmarks are looked for in at a keyframe, and how differently these may look at most.
_NUM_NEAR, _MAX_TURN_RAD = 6, 0.8
# What the images of the known map are called in the map that it has become a part of.
PREFIX = "map/"


@dataclass(frozen=True)
class KnownMap:
    """A map and what its images look like.

    Attributes:
        source: what it was read from, for messages.
        model: with tracks and points, in the frame and the unit that are to be kept.
        image_idx: (K, S) images of the keyframes (or photographs, S = 1), by camera of the rig.
        pictures: grey, (H, W) uint8, by image; of the first cameras, those that there are.
        scale_source, scale_sigma: of its unit of length; see :class:`~sfmapp.odometry.result.MapResult`.
    """

    source: str
    model: Reconstruction
    image_idx: NDArray[np.int64]
    pictures: Mapping[int, Bytes]
    scale_source: str = "none"
    scale_sigma: float | None = None


class KnownPictures:
    """Pictures of the keyframes of a known map, by position; pyramids are built where the camera comes near.

    Args:
        pictures: (H, W) uint8 in the pixels of the sequence's camera.
    """

    def __init__(self, pictures: dict[int, Bytes]) -> None:
        self.pictures = pictures
        self._positions = np.array(sorted(pictures), np.int64)
        self._built: dict[int, Pyramid] = {}

    def near(self, keyframes: KeyframeMap, pose: Array) -> dict[int, Pyramid]:
        """Pyramids of the pictures that were taken from nearest, in nearly the same direction, by position.

        Args:
            pose: (7,) of the camera.
        """
        if not len(self._positions):
            return {}
        poses = np.array([keyframes.keyframes[k].rig_from_world for k in self._positions])
        distance = np.linalg.norm(rigid3.center(poses) - rigid3.center(pose), axis=1)
        axis = rigid3.rotation_matrix(poses)[:, 2] @ rigid3.rotation_matrix(pose)[2]
        turn = np.arccos(np.clip(axis, -1.0, 1.0))
        alike = np.flatnonzero(turn < _MAX_TURN_RAD)
        spread = max(rigid3.spread(poses), 1e-12)
        order = alike[np.argsort(distance[alike] / spread + turn[alike], kind="stable")][:_NUM_NEAR]
        chosen = [int(self._positions[k]) for k in order]
        self._built = {k: self._built.get(k) or build_pyramid(self.pictures[k]) for k in chosen}
        return dict(self._built)


def known_keyframes(known: KnownMap, rig: Rig) -> tuple[KeyframeMap, KnownPictures]:
    """The known map as keyframes of the sequence's rig, and their pictures.

    Keyframes are numbered before the frames of the sequence, from ``-K``; points by their tracks.

    Raises:
        UsageError: the sequence has more cameras than the map.
    """
    num_sensors = len(rig.cameras)
    if known.image_idx.shape[1] < num_sensors:
        raise UsageError(
            f"{known.source}: a map of one camera has no metres of its own for the two of the sequence", "give --mono"
        )
    model = known.model
    keyframes, tracks = KeyframeMap(rig), model.tracks
    ids = keyframes.new_points(tracks.num_tracks)
    keyframes.point_xyz[ids] = np.where(model.is_triangulated[:, None], model.point_xyz, np.nan)
    first = known.image_idx[:, 0]
    usable = np.flatnonzero(model.is_registered[first])
    pictures: dict[int, Bytes] = {}
    for k in usable:
        image = int(first[k])
        sensors = [_seen(model, int(i), rig.cameras[s]) for s, i in enumerate(known.image_idx[k, :num_sensors])]
        # a point is one of the keyframe where its first camera sees it
        point_id, rows = np.unique(sensors[0][0], return_index=True)
        xy = np.full((len(point_id), num_sensors, 2), np.nan)
        xy[:, 0] = sensors[0][1][rows]
        for s in range(1, num_sensors):
            other, at = np.unique(sensors[s][0], return_index=True)
            _, here, there = np.intersect1d(point_id, other, True, return_indices=True)
            xy[here, s] = sensors[s][1][at[there]]
        position = len(keyframes.keyframes)
        keyframes.append(
            Keyframe(
                position - len(usable), float(position - len(usable)), PREFIX + model.image_names[image],
                model.cam_from_world[image].copy(), point_id, xy, np.isfinite(xy[:, :, 0]),
            )
        )  # fmt: skip
        if image in known.pictures:
            camera = model.cameras[model.image_camera_idx[image]]
            pictures[position] = as_seen_by(known.pictures[image], camera, rig.cameras[0])
    keyframes.hold_known()
    return keyframes, KnownPictures(pictures)


def _seen(model: Reconstruction, image: int, camera: Camera) -> tuple[NDArray[np.int64], Array]:
    """Tracks (N,) that agree with an image, and pixels (N, 2) at which another camera would have seen them there."""
    obs = model.tracks.observations_of_image(image)
    obs = obs[model.obs_is_inlier[obs] & model.is_triangulated[model.tracks.obs_track_idx[obs]]]
    xy, given = model.tracks.obs_xy[obs].astype(np.float64), model.cameras[model.image_camera_idx[image]]
    if not is_same(given, camera):
        ray = pixels_to_normalized(given, xy)
        xy = project(camera, np.column_stack([ray, np.ones(len(ray))]))
    inside = ((xy > 0) & (xy < [camera.width, camera.height])).all(1)  # False for NaN
    return model.tracks.obs_track_idx[obs[inside]].astype(np.int64), xy[inside]


def is_same(first: Camera, second: Camera) -> bool:
    """Whether two cameras take the same pixels."""
    sizes = (first.width, first.height) == (second.width, second.height)
    return sizes and first.model == second.model and np.array_equal(first.params, second.params)


def as_seen_by(picture: Bytes, given: Camera, camera: Camera) -> Bytes:
    """What another camera would have seen from the same place, black where the picture ends.

    Args:
        picture: (H, W) of the given camera, or of a smaller copy.
    """
    import cv2

    if is_same(given, camera) and picture.shape == (camera.height, camera.width):
        return picture
    shrink = min(1.0, camera.focal / given.focal * given.width / picture.shape[1])
    if shrink < 1.0:  # finer pixels are averaged, not skipped
        size = (max(1, round(picture.shape[1] * shrink)), max(1, round(picture.shape[0] * shrink)))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    ray = pixels_to_normalized(camera, np.column_stack([column.ravel(), row.ravel()]))
    there = project(given, np.column_stack([ray, np.ones(len(ray))]))
    there *= np.array([picture.shape[1] / given.width, picture.shape[0] / given.height])
    maps = np.nan_to_num(there - 0.5, nan=-10.0).astype(np.float32).reshape(camera.height, camera.width, 2)
    return np.asarray(cv2.remap(picture, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR))
