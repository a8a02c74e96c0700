"""The pinhole that shows what a camera with distortion shows, and a reconstruction seen through it.

Size and principal point follow COLMAP's undistorter (``UndistortCamera`` in colmap/image/undistortion.cc), so that both
give the same camera: focal lengths stay, the picture grows or shrinks about the principal point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized
from sfmapp.camera.names import CameraModel
from sfmapp.events import Events
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import make_tracks

Array = NDArray[np.float64]

# shares of the photograph's side between which the side of the plane is kept, COLMAP's: what the very widest lenses
# show farther out would be stretched more than it is worth
LEAST_SIDE, LARGEST_SIDE = 0.2, 2.0


@dataclass(frozen=True)
class Undistortion:
    """How the pictures of a camera are laid out flat.

    Attributes:
        source: the camera, with its distortion.
        plane: the PINHOLE at full resolution.
        camera: the PINHOLE of the result: ``plane``, or smaller where the size is limited.
    """

    source: Camera
    plane: Camera
    camera: Camera

    @property
    def is_identity(self) -> bool:
        """The pictures stay as they are."""
        size = self.source.width, self.source.height
        return not has_distortion(self.source) and (self.camera.width, self.camera.height) == size


def has_distortion(camera: Camera) -> bool:
    """Whether the camera is more than a pinhole."""
    return not camera.is_pinhole


def warn_of_sides(cameras: Sequence[Camera], stage: str, events: Events) -> None:
    """Say of which photographs, by their cameras, a plane holds no more than the front."""
    wide = [camera.model.name for camera in cameras if camera.is_wide]
    if wide:
        names = ", ".join(sorted(set(wide)))
        events.warned(
            stage,
            f"{len(wide)} photographs are by lenses that see to their sides and behind ({names}): only what lies in "
            "front of them is laid out flat and used. For all round, cut them into pinhole pictures of several "
            "directions, and reconstruct those",
        )


def plan_undistortion(camera: Camera, blank_pixels: float = 0.0, max_size: int | None = None) -> Undistortion:
    """The pinhole for a camera.

    Args:
        camera: of any model.
        blank_pixels: 0 for a picture without a pixel that the photograph does not show, 1 for one that holds all of
            the photograph; between them, part of the way.
        max_size: largest side in pixels; None for no limit.
    """
    plane = Camera(CameraModel.PINHOLE, camera.width, camera.height, camera.canonical[:4], focal_source="file")
    if has_distortion(camera):
        plane = _fitted(camera, plane, blank_pixels)
    shrink = 1.0 if max_size is None else min(1.0, max_size / max(plane.width, plane.height))
    if shrink == 1.0:
        return Undistortion(camera, plane, plane)
    width, height = max(1, round(plane.width * shrink)), max(1, round(plane.height * shrink))
    factors = np.tile([width / plane.width, height / plane.height], 2)
    return Undistortion(camera, plane, replace(plane, width=width, height=height, params=plane.params * factors))


def _fitted(camera: Camera, plane: Camera, blank_pixels: float) -> Camera:
    """The plane with the size that holds as much of the photograph's border as is wanted."""
    sizes, params = [], plane.params.copy()
    for axis, side in enumerate((camera.width, camera.height)):
        center = plane.params[2 + axis]
        low, high = (_flat_border(camera, plane, axis, at) for at in (0.5, side - 0.5))
        with np.errstate(divide="ignore"):
            whole = min(center / (center - low.min()), (side - 0.5 - center) / (high.max() - center))
            filled = max(center / (center - low.max()), (side - 0.5 - center) / (high.min() - center))
            scale = 1.0 / np.float64(whole * blank_pixels + filled * (1.0 - blank_pixels))
        sizes.append(max(1, int(np.clip(scale, LEAST_SIDE, LARGEST_SIDE) * side)))
        params[2 + axis] = center * sizes[-1] / side
    return replace(plane, width=sizes[0], height=sizes[1], params=params)


def _flat_border(camera: Camera, plane: Camera, axis: int, at: float) -> Array:
    """Coordinate along ``axis`` on the plane of the border pixels with that coordinate in the photograph.

    Pixels at which the lens has no inverse are left out; where it has none along all of the border, that is infinitely
    far out.
    """
    along = np.arange(camera.height if axis == 0 else camera.width) + 0.5
    border = np.empty((len(along), 2))
    border[:, axis], border[:, 1 - axis] = at, along
    flat = (pixels_to_normalized(camera, border) * plane.params[:2] + plane.params[2:])[:, axis]
    flat = flat[np.isfinite(flat)]
    side = (camera.width, camera.height)[axis]
    return flat if len(flat) else np.array([np.inf if at > side / 2 else -np.inf])


def move_pixels(undistortion: Undistortion, xy: Array, camera: Camera | None = None) -> Array:
    """Undistorted pixels (N, 2) of pixels (N, 2); NaN where the lens has no inverse.

    ``camera``: that the pixels are counted in, if it is not that of the photograph but one of another size.
    """
    params = undistortion.camera.params
    return pixels_to_normalized(camera or undistortion.source, xy) * params[:2] + params[2:]


def undistort_reconstruction(
    model: Reconstruction, keypoints: list[Array], image_idx: NDArray[np.int64], undistortions: list[Undistortion]
) -> tuple[Reconstruction, list[Array]]:
    """The same scene seen through pinholes.

    What falls outside of the pictures is dropped, and points that lose all of their observations with it.

    Args:
        model: with the cameras that took the photographs.
        keypoints: for each image, (N, 2) pixels.
        image_idx: (V,) positions of the images that are kept; the others lose their pose.
        undistortions: V of them.

    Returns:
        The model, every image in its place, and the keypoints that are left.
    """
    out, tracks = model.copy(), model.tracks
    cameras, camera_idx = _distinct_cameras(model.image_camera_idx[image_idx], undistortions)
    out.cameras = cameras
    out.image_camera_idx = np.zeros(len(model.image_names), np.int32)
    out.image_camera_idx[image_idx] = camera_idx
    gone = np.setdiff1d(np.arange(len(model.image_names)), image_idx)
    out.cam_from_world[gone] = np.nan
    moved: list[Array] = [np.zeros((0, 2))] * len(model.image_names)
    feature_idx = np.full(tracks.num_observations, -1, np.int64)
    for image, undistortion in zip(image_idx.tolist(), undistortions, strict=True):
        obs = tracks.observations_of_image(image)
        features = tracks.obs_feature_idx[obs]
        xy = np.array(keypoints[image], np.float64)[:, :2]
        xy[features] = tracks.obs_xy[obs]  # these may have been refined
        xy = move_pixels(undistortion, xy, model.cameras[model.image_camera_idx[image]])
        size = undistortion.camera.width, undistortion.camera.height
        is_inside = ((xy >= 0.0) & (xy < size)).all(axis=1)
        moved[image] = xy[is_inside]
        feature_idx[obs] = np.where(is_inside, np.cumsum(is_inside) - 1, -1)[features]
    kept = np.flatnonzero((feature_idx >= 0) & model.obs_is_inlier)
    image, track = tracks.obs_image_idx[kept], tracks.obs_track_idx[kept]
    start = np.concatenate([[0], np.cumsum([len(xy) for xy in moved])])
    xy = np.concatenate([*moved, np.zeros((0, 2))])[start[image] + feature_idx[kept]]
    out.tracks = make_tracks(len(moved), tracks.num_tracks, track, image, feature_idx[kept], xy)
    out.obs_is_inlier = np.ones(len(kept), bool)
    out.point_xyz[(np.diff(tracks.track_ptr) > 0) & (np.diff(out.tracks.track_ptr) == 0)] = np.nan
    return out, moved


def _distinct_cameras(
    camera_idx: NDArray[np.int32], undistortions: list[Undistortion]
) -> tuple[list[Camera], NDArray[np.int32]]:
    """The pinholes, in the order of the cameras (V,) that they stand for, and whose is which."""
    keys = [
        (int(camera), each.camera.width, each.camera.height, *each.camera.params.tolist())
        for camera, each in zip(camera_idx, undistortions, strict=True)
    ]
    position = {key: i for i, key in enumerate(sorted(set(keys)))}
    by_key = {key: each.camera for key, each in zip(keys, undistortions, strict=True)}
    return [by_key[key] for key in position], np.array([position[key] for key in keys], np.int32)
