"""The pinholes that show what a camera with distortion shows, and a reconstruction seen through them.

One is enough for most lenses. Of what lies more than 88 degrees off the axis it would show nothing: there it is the
faces of a cube, mounted together as a rig (:mod:`sfmapp.scene.cube`).

Size and principal point of the one follow COLMAP's undistorter (``UndistortCamera`` in colmap/image/undistortion.cc),
so that both give the same camera: focal lengths stay, the picture grows or shrinks about the principal point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized, pixels_to_rays
from sfmapp.camera.names import CameraModel
from sfmapp.errors import UsageError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.scene.cube import FACE_FROM_CAM, face_camera, faces_in_view, nearest_face
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import RigImages
from sfmapp.scene.tracks import make_tracks

Array = NDArray[np.float64]

# shares of the photograph's side between which the side of the plane is kept, COLMAP's: what the very widest lenses
# show farther out would be stretched more than it is worth
LEAST_SIDE, LARGEST_SIDE = 0.2, 2.0


@dataclass(frozen=True)
class Layout:
    """What is wanted of undistorted pictures.

    Attributes:
        blank_pixels: 0 for a picture without a pixel that the photograph does not show, 1 for one that holds all of
            the photograph; between them, part of the way. Faces of a cube are always whole.
        max_size: largest side in pixels; None for no limit.
        front_only: of photographs that show more than 88 degrees from the axis, one picture of what lies in front, not
            the faces of a cube.
    """

    blank_pixels: float = 0.0
    max_size: int | None = None
    front_only: bool = False

    def __post_init__(self) -> None:
        if not 0.0 <= self.blank_pixels <= 1.0:
            raise UsageError(f"blank_pixels is {self.blank_pixels:g}, expected a share from 0 to 1")
        if self.max_size is not None and self.max_size < 1:
            raise UsageError(f"max_size is {self.max_size}, expected 1 pixel or more")


@dataclass(frozen=True)
class Undistortion:
    """How a picture of a camera is laid out flat.

    Attributes:
        source: the camera, with its distortion.
        plane: the PINHOLE at full resolution.
        camera: the PINHOLE of the result: ``plane``, or smaller where the size is limited.
        face: of the cube that the picture is, one of :data:`sfmapp.scene.cube.FACE_FROM_CAM`; None where it is the only
            one of its photograph.
    """

    source: Camera
    plane: Camera
    camera: Camera
    face: str | None = None

    @property
    def plane_from_cam(self) -> Array | None:
        """(3, 3) rotation; None where the picture looks where the camera does."""
        return None if self.face is None else FACE_FROM_CAM[self.face]

    def name_of(self, photograph: str) -> str:
        """Name of the picture: of ``a/b.jpg`` that, or ``a/b_front.jpg``.

        The face is no folder, for many trainers of splats drop folders from names.
        """
        path = PurePosixPath(photograph)
        return photograph if self.face is None else str(path.with_name(f"{path.stem}_{self.face}{path.suffix}"))

    @property
    def is_identity(self) -> bool:
        """The pictures stay as they are."""
        size = self.source.width, self.source.height
        return not has_distortion(self.source) and (self.camera.width, self.camera.height) == size


def has_distortion(camera: Camera) -> bool:
    """Whether the camera is more than a pinhole."""
    return not camera.is_pinhole


def warn_of_sides(cameras: Sequence[Camera], stage: str, remedy: str, events: Events) -> None:
    """Say of which photographs, by their cameras, a plane holds no more than the front."""
    wide = [camera.model.name for camera in cameras if camera.is_wide]
    if wide:
        names = ", ".join(sorted(set(wide)))
        events.warned(
            stage,
            f"{len(wide)} photographs are by lenses that see to their sides and behind ({names}): only what lies in "
            f"front of them is undistorted and used. For all round: {remedy}",
        )


def plan_undistortion(camera: Camera, layout: Layout) -> list[Undistortion]:
    """The pinholes for a camera of any model: one, or the faces of a cube that its photographs show some of."""
    if camera.is_wide and not layout.front_only:
        plane = face_camera(camera)
        small = _limited(plane, layout.max_size)
        return [Undistortion(camera, plane, small, face) for face in faces_in_view(camera)]
    plane = Camera(CameraModel.PINHOLE, camera.width, camera.height, camera.canonical[:4], focal_source="file")
    if has_distortion(camera):
        plane = _fitted(camera, plane, layout.blank_pixels)
    return [Undistortion(camera, plane, _limited(plane, layout.max_size))]


def _limited(plane: Camera, max_size: int | None) -> Camera:
    """The plane, or a smaller one that shows the same."""
    shrink = 1.0 if max_size is None else min(1.0, max_size / max(plane.width, plane.height))
    if shrink == 1.0:
        return plane
    width, height = max(1, round(plane.width * shrink)), max(1, round(plane.height * shrink))
    factors = np.tile([width / plane.width, height / plane.height], 2)
    return replace(plane, width=width, height=height, params=plane.params * factors)


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
    """Undistorted pixels (N, 2) of pixels (N, 2); NaN where the lens has no inverse, and behind a face of a cube.

    ``camera``: that the pixels are counted in, if it is not that of the photograph but one of another size.
    """
    camera, params = camera or undistortion.source, undistortion.camera.params
    if undistortion.face is None:
        return pixels_to_normalized(camera, xy) * params[:2] + params[2:]
    rays = pixels_to_rays(camera, xy) @ FACE_FROM_CAM[undistortion.face].T
    rays[~(rays[:, 2] > 0.0)] = np.nan
    return rays[:, :2] / rays[:, 2:] * params[:2] + params[2:]


def _place_pixels(pictures: list[Undistortion], xy: Array, camera: Camera) -> tuple[Array, NDArray[np.int64]]:
    """Pixels (N, 2) of a photograph in the pictures made of it, and (N,) in which of them; -1 for outside of all."""
    which = np.zeros(len(xy), np.int64)
    if pictures[0].face is not None:
        which = nearest_face(pixels_to_rays(camera, xy), [str(each.face) for each in pictures])
    moved = np.full((len(xy), 2), np.nan)
    for k, picture in enumerate(pictures):
        moved[which == k] = move_pixels(picture, xy[which == k], camera)
    size = np.array([(each.camera.width, each.camera.height) for each in pictures])[which]
    which[~((moved >= 0.0) & (moved < size)).all(axis=1)] = -1
    return moved, which


@dataclass
class _Pictures:
    """What the images of a model become: pictures (P), each in turn.

    Attributes:
        first: (I,) position of the first picture of an image; one that has none keeps its place without a pose.
        names, poses, frame, sensor: of the pictures; the last two as in :class:`RigImages`.
        mounts: poses of the sensors.
    """

    first: NDArray[np.int64]
    names: list[str] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    frame: list[int] = field(default_factory=list)
    sensor: list[int] = field(default_factory=list)
    mounts: list[Array] = field(default_factory=lambda: [rigid3.IDENTITY])

    def add(self, name: str, pose: Array, frame: int, sensor: int) -> None:
        """Put a picture behind the others."""
        self.names.append(name)
        self.poses.append(pose)
        self.frame.append(frame)
        self.sensor.append(sensor)


def _name_and_mount(model: Reconstruction, pictures_of: dict[int, list[Undistortion]]) -> _Pictures:
    """Names, poses and places on rigs: the faces of a cube are a frame, or more sensors on the rig of their camera."""
    out, rig = _Pictures(np.zeros(len(model.image_names), np.int64)), model.rig
    if rig is not None:
        out.mounts = list(rig.cam_from_rig)
    next_frame = 0 if rig is None else int(rig.frame_idx.max(initial=-1)) + 1
    number = {pose.tobytes(): k for k, pose in enumerate(out.mounts)}
    for image, name in enumerate(model.image_names):
        out.first[image] = len(out.names)
        frame, sensor = (-1, 0) if rig is None else (int(rig.frame_idx[image]), int(rig.sensor_idx[image]))
        pictures = pictures_of.get(image)
        if pictures is None or pictures[0].face is None:
            out.add(name, np.full(7, np.nan) if pictures is None else model.cam_from_world[image], frame, sensor)
            continue
        if frame < 0:
            frame, next_frame = next_frame, next_frame + 1
        for each in pictures:
            mount = _seen_from(each, out.mounts[sensor])
            place = number.setdefault(mount.tobytes(), len(out.mounts))
            if place == len(out.mounts):
                out.mounts.append(mount)
            out.add(each.name_of(name), _seen_from(each, model.cam_from_world[image]), frame, place)
    return out


def _seen_from(picture: Undistortion, pose: Array) -> Array:
    """The pose (7,) of a picture, of that of its camera; bit for bit the same where both look the same way."""
    turn = picture.plane_from_cam
    if turn is None or np.array_equal(turn, np.eye(3)):
        return pose
    return rigid3.compose(rigid3.from_matrix(turn, np.zeros(3)), pose)


def undistort_reconstruction(
    model: Reconstruction,
    keypoints: list[Array],
    image_idx: NDArray[np.int64],
    undistortions: Sequence[list[Undistortion]],
) -> tuple[Reconstruction, list[Array]]:
    """The same scene seen through pinholes.

    What falls outside of the pictures is dropped, and points that lose all of their observations with it. What a face
    of a cube sees is seen by no other, so that no point is counted twice.

    Args:
        model: with the cameras that took the photographs.
        keypoints: for each image, (N, 2) pixels.
        image_idx: (V,) positions of the images that are kept; the others lose their pose.
        undistortions: V of them, the pictures of each image.

    Returns:
        The model, every image in its place, an image for every picture, and the keypoints that are left.
    """
    out, tracks = model.copy(), model.tracks
    pictures_of = dict(zip(image_idx.tolist(), undistortions, strict=True))
    pictures = _name_and_mount(model, pictures_of)
    out.image_names, out.cam_from_world = pictures.names, np.array(pictures.poses).reshape(-1, 7)
    if model.rig is not None or max(pictures.frame, default=-1) >= 0:
        frame, sensor = np.array(pictures.frame, np.int32), np.array(pictures.sensor, np.int32)
        out.rig = RigImages(frame, sensor, np.array(pictures.mounts))
    owners = np.repeat(image_idx, [len(group) for group in undistortions])
    made = np.array([pictures.first[i] + k for i, group in pictures_of.items() for k in range(len(group))], np.int64)
    every = [each for group in undistortions for each in group]
    out.image_camera_idx = np.zeros(len(out.image_names), np.int32)
    out.cameras, out.image_camera_idx[made] = _distinct_cameras(model.image_camera_idx[owners], every)
    moved: list[Array] = [np.zeros((0, 2))] * len(out.image_names)
    picture, feature_idx = (np.full(tracks.num_observations, -1, np.int64) for _ in range(2))
    for image, group in pictures_of.items():
        obs = tracks.observations_of_image(image)
        features = tracks.obs_feature_idx[obs]
        xy = np.array(keypoints[image], np.float64)[:, :2]
        xy[features] = tracks.obs_xy[obs]  # these may have been refined
        xy, which = _place_pixels(group, xy, model.cameras[model.image_camera_idx[image]])
        rank = np.full(len(xy), -1)
        for k in range(len(group)):
            is_inside = which == k
            moved[pictures.first[image] + k] = xy[is_inside]
            rank[is_inside] = np.arange(is_inside.sum())
        picture[obs], feature_idx[obs] = pictures.first[image] + which[features], rank[features]
    kept = np.flatnonzero((feature_idx >= 0) & model.obs_is_inlier)
    picture, track = picture[kept], tracks.obs_track_idx[kept]
    start = np.concatenate([[0], np.cumsum([len(xy) for xy in moved])])
    xy = np.concatenate([*moved, np.zeros((0, 2))])[start[picture] + feature_idx[kept]]
    out.tracks = make_tracks(len(moved), tracks.num_tracks, track, picture, feature_idx[kept], xy)
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
