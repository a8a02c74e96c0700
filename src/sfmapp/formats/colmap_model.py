"""A COLMAP model as flat arrays in COLMAP's own terms (ids), between its files and our Reconstruction (positions)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.models import PARAM_NAMES, kind_of
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError, UsageError
from sfmapp.formats.colmap_rigs import Frame, Rig, mount_images, rig_images
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import make_tracks

Keypoints = list[NDArray[np.float64]]

_LARGEST_SIDE_PX = 1_000_000  # a photograph is smaller; a corrupt file says 10^18
_LARGEST_PARAMETER = 1e9  # so are focal lengths and coefficients; a corrupt file says 10^300


@dataclass(frozen=True)
class ColmapModel:
    """What the files of a model hold.

    Attributes:
        camera_ids: (C,) int64, with cameras: C of them.
        image_ids, image_camera_ids: (I,) int64, with image_names and cam_from_world (I, 7), quaternion x y z w.
        points2d_xy: I arrays (N, 2) float64, pixels; points2d_point_ids: I arrays (N,) int64, -1 for none.
        point_ids: (P,) int64, with point_xyz (P, 3), point_rgb (P, 3) uint8, point_error_px (P,) or -1.
        track_ptr: (P + 1,) int64 into track_image_ids (O,) int64 and track_point2d_idx (O,) int64.
        rigs, frames: none where an older file has none.
        notes: what was left out in reading, as sentences that follow the name of the folder.
    """

    camera_ids: NDArray[np.int64]
    cameras: list[Camera]
    image_ids: NDArray[np.int64]
    image_camera_ids: NDArray[np.int64]
    image_names: list[str]
    cam_from_world: NDArray[np.float64]
    points2d_xy: Keypoints
    points2d_point_ids: list[NDArray[np.int64]]
    point_ids: NDArray[np.int64]
    point_xyz: NDArray[np.float64]
    point_rgb: NDArray[np.uint8]
    point_error_px: NDArray[np.float64]
    track_ptr: NDArray[np.int64]
    track_image_ids: NDArray[np.int64]
    track_point2d_idx: NDArray[np.int64]
    rigs: dict[int, Rig]
    frames: list[Frame]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class PosedImages:
    """What a model says of its images (I), without cameras and points; arrays as in :class:`ColmapModel`."""

    ids: NDArray[np.int64]
    camera_ids: NDArray[np.int64]
    names: list[str]
    cam_from_world: NDArray[np.float64]
    points2d_xy: Keypoints
    points2d_point_ids: list[NDArray[np.int64]]
    rigs: dict[int, Rig]
    frames: list[Frame]
    notes: tuple[str, ...]


NO_POINTS_NOTE = "there is no file of points: the model is read without any"
NO_RIGS_NOTE = "there is a file of frames but none of rigs: the poses are those of the images file"


def checked_camera(
    path: Path, camera_id: int | str, model: int | str, width: int, height: int, params: object
) -> Camera:
    """A camera as a file states it, or an InputError that says what is wrong with it.

    Args:
        camera_id: whatever tells this camera from the others in the file.
        model: COLMAP's id or name.
        params: the sequence of its parameters, in COLMAP's order.
    """
    place = f"{path}: camera {camera_id}"
    try:
        known = CameraModel[model] if isinstance(model, str) else CameraModel(model)
    except (KeyError, ValueError):
        name = model if isinstance(model, str) else f"with id {model}"
        supported = ", ".join(known.name for known in CameraModel)
        raise InputError(
            f"{place}: camera model {name} is not supported, expected one of {supported}",
            "undistort the images first, or convert the model with COLMAP",
        ) from None
    if not (0 < width <= _LARGEST_SIDE_PX and 0 < height <= _LARGEST_SIDE_PX):
        raise InputError(f"{place}: expected an image size of 1 to {_LARGEST_SIDE_PX} pixels, found {width} x {height}")
    values = np.asarray(params, np.float64)
    names = PARAM_NAMES[known]
    if values.shape != (len(names),):
        raise InputError(f"{place}: {known.name} has {len(names)} parameters, found {len(values)}")
    if (
        not (np.abs(values) < _LARGEST_PARAMETER).all()
        or not (values[[kind_of(name) in ("focal", "size") for name in names]] > 0).all()
    ):
        raise InputError(f"{place}: expected finite parameters and positive focal lengths, found {values.tolist()}")
    return Camera(known, int(width), int(height), values, focal_source="file")


def checked_poses(
    path: Path, what: str, ids: NDArray[np.int64], poses_wxyz: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N, 7) poses, quaternion x y z w of unit length, from (N, 7) in COLMAP's order w x y z."""
    poses = np.concatenate([poses_wxyz[:, 1:4], poses_wxyz[:, :1], poses_wxyz[:, 4:]], 1)
    with np.errstate(over="ignore", invalid="ignore"):
        norm = np.linalg.norm(poses[:, :4], axis=1)
    wrong = ~(np.isfinite(poses).all(1) & (norm > 1e-6) & (norm < 1e6))
    if wrong.any():
        first = int(np.argmax(wrong))
        raise InputError(f"{path}: {what} {ids[first]}: expected a finite pose, found {poses_wxyz[first].tolist()}")
    # text files round to six digits or so; what was written in full keeps its bits
    rounded = np.abs(norm - 1) > 1e-12
    poses[rounded, :4] /= norm[rounded, None]
    return poses


def model_from_reconstruction(reconstruction: Reconstruction, keypoints: Keypoints | None) -> ColmapModel:
    """The registered part of a reconstruction in COLMAP's terms: ids are positions plus one.

    A camera that serves as several sensors becomes several cameras, the others with ids after the last.
    """
    tracks = reconstruction.tracks
    registered = reconstruction.registered_idx
    points = np.flatnonzero(reconstruction.is_triangulated)
    used = (
        reconstruction.obs_is_inlier
        & reconstruction.is_registered[tracks.obs_image_idx]
        & reconstruction.is_triangulated[tracks.obs_track_idx]
    )
    if not np.isfinite(reconstruction.cam_from_world[registered]).all():
        raise ValueError("cannot write a model: a registered image has a pose that is not finite")
    if not np.isfinite(reconstruction.point_xyz[points]).all():
        raise ValueError("cannot write a model: a triangulated point is not finite")
    point2d_idx = tracks.obs_feature_idx.astype(np.int64)
    xy: Keypoints = []
    point_ids: list[NDArray[np.int64]] = []
    for image in registered:
        obs = tracks.observations_of_image(image)
        if keypoints is None:
            # without the keypoints only the tracked ones are known: they move up, in their order
            obs = obs[np.argsort(tracks.obs_feature_idx[obs], kind="stable")]
            point2d_idx[obs] = np.arange(len(obs))
            xy.append(tracks.obs_xy[obs])
        else:
            xy.append(np.array(keypoints[image], np.float64)[:, :2])
            xy[-1][point2d_idx[obs]] = tracks.obs_xy[obs]
        ids = np.full(len(xy[-1]), -1, np.int64)
        obs = obs[used[obs]]
        ids[point2d_idx[obs]] = tracks.obs_track_idx[obs].astype(np.int64) + 1
        if np.count_nonzero(ids >= 0) != len(obs):
            raise ValueError(f"{reconstruction.image_names[image]}: a keypoint belongs to two points")
        point_ids.append(ids)
    length = np.bincount(tracks.obs_track_idx[used], minlength=tracks.num_tracks)[points]
    mounted = mount_images(reconstruction, registered)
    return ColmapModel(
        camera_ids=mounted.camera_ids,
        cameras=[reconstruction.cameras[idx] for idx in mounted.camera_idx],
        image_ids=registered + 1,
        image_camera_ids=mounted.image_camera_ids,
        image_names=[reconstruction.image_names[image] for image in registered],
        cam_from_world=reconstruction.cam_from_world[registered],
        points2d_xy=xy,
        points2d_point_ids=point_ids,
        point_ids=points + 1,
        point_xyz=reconstruction.point_xyz[points],
        point_rgb=reconstruction.point_rgb[points],
        point_error_px=_mean_error_px(reconstruction, used)[points],
        track_ptr=np.concatenate([[0], np.cumsum(length)]),
        track_image_ids=tracks.obs_image_idx[used].astype(np.int64) + 1,
        track_point2d_idx=point2d_idx[used],
        rigs=mounted.rigs,
        frames=mounted.frames,
    )


def _mean_error_px(reconstruction: Reconstruction, used: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(T,) mean length of the residuals of each track; -1, COLMAP's sign for unknown, where there is none."""
    tracks = reconstruction.tracks
    lengths = reconstruction.errors_px()[used]
    track_idx = tracks.obs_track_idx[used]
    total = np.bincount(track_idx, lengths, tracks.num_tracks)
    count = np.bincount(track_idx, minlength=tracks.num_tracks)
    mean = total / np.maximum(count, 1)
    mean[(count == 0) | ~np.isfinite(mean)] = -1.0
    return mean


def check_unique(folder: Path, what: str, ids: NDArray[np.int64], names: Sequence[str] = ()) -> None:
    """Raise InputError if an id or a name is there twice."""
    values, counts = np.unique(ids, return_counts=True)
    if (counts > 1).any():
        raise InputError(f"{folder}: expected every {what} id once, found {what} {values[counts > 1][0]} twice")
    twice = sorted(name for name, count in Counter(names).items() if count > 1)
    if twice:
        raise InputError(f"{folder}: expected every {what} name once, found {twice[0]!r} twice")


def reconstruction_from_model(folder: Path, model: ColmapModel) -> tuple[Reconstruction, Keypoints, tuple[str, ...]]:
    """The reconstruction that a model holds, images and points in ascending order of their ids; all ids are checked.

    Points and images that were taken away leave ids behind in what names them: those count as none, and a note says so.

    Returns:
        The reconstruction, the pixels of the keypoints of each image, and notes as :class:`ColmapModel` has them.

    Raises:
        InputError: ids that are double or out of range, cameras that are missing; two names alike; images and tracks
            that contradict each other.
    """
    check_unique(folder, "camera", model.camera_ids)
    check_unique(folder, "image", model.image_ids, model.image_names)
    check_unique(folder, "point", model.point_ids)
    camera_order = np.argsort(model.camera_ids)
    image_order = np.argsort(model.image_ids)
    point_order = np.argsort(model.point_ids)
    image_ids = model.image_ids[image_order]
    xy = [model.points2d_xy[i] for i in image_order]
    camera_idx = _positions(model.image_camera_ids[image_order], model.camera_ids[camera_order])
    if (camera_idx < 0).any():
        missing = model.image_camera_ids[image_order][np.argmax(camera_idx < 0)]
        raise InputError(f"{folder}: an image names camera {missing}, which the model does not hold")
    observed, notes = _observations(folder, model, image_order, point_order)
    flat_xy = np.concatenate([*xy, np.zeros((0, 2))])
    tracks = make_tracks(
        len(image_ids), len(point_order), observed.point, observed.image, observed.keypoint, flat_xy[observed.at]
    )
    reconstruction = Reconstruction(
        [model.cameras[i] for i in camera_order],
        [model.image_names[i] for i in image_order],
        camera_idx.astype(np.int32),
        model.cam_from_world[image_order],
        tracks,
        model.point_xyz[point_order],
        np.ones(tracks.num_observations, bool),
        model.point_rgb[point_order],
        rig_images(image_ids, model.rigs, model.frames),
    )
    return reconstruction, xy, (*model.notes, *notes)


def _positions(ids: NDArray[np.int64], known: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N,) ranks of ids (N,) among ascending ones, -1 where they are not among them."""
    if not len(known):
        return np.full(len(ids), -1, np.int64)
    position = np.minimum(np.searchsorted(known, ids), len(known) - 1)
    return np.where(known[position] == ids, position, -1)


@dataclass(frozen=True)
class _Observed:
    """Observations (O,): positions of point and image, of the keypoint in its image, and among those of all images."""

    point: NDArray[np.int64]
    image: NDArray[np.int64]
    keypoint: NDArray[np.int64]
    at: NDArray[np.int64]


def _observations(
    folder: Path, model: ColmapModel, image_order: NDArray[np.int64], point_order: NDArray[np.int64]
) -> tuple[_Observed, list[str]]:
    """What the tracks claim and what the keypoints name, put together as COLMAP does; and notes of what was left out.

    An observation counts if one side tells of it and the other does not deny it: tools that filter a model often edit
    only one of its files.
    """
    counts = np.array([len(model.points2d_xy[i]) for i in image_order], np.int64)
    start = np.concatenate([[0], np.cumsum(counts)])
    named_ids = np.concatenate([*(model.points2d_point_ids[i] for i in image_order), np.zeros(0, np.int64)])
    rank = np.empty_like(point_order)
    rank[point_order] = np.arange(len(rank))
    point = np.repeat(rank, np.diff(model.track_ptr))
    image = _positions(model.track_image_ids, model.image_ids[image_order])
    # an image that is gone, or whose line of keypoints was emptied
    kept = (image >= 0) & (counts[image] > 0 if len(counts) else False)
    tracked = _Observed(point[kept], image[kept], model.track_point2d_idx[kept], np.zeros(0, np.int64))
    names = [model.image_names[i] for i in image_order]
    at = _claimed_keypoints(folder, tracked, model.point_ids[point_order], names, counts, start, named_ids)
    notes = []
    if num_lost := int(len(kept) - kept.sum()):
        notes.append(f"{num_lost} observations name images or keypoints that are not there: they count as none")
    unclaimed = named_ids >= 0
    unclaimed[at] = False
    rest = np.flatnonzero(unclaimed)
    rest_point = _positions(named_ids[rest], model.point_ids[point_order])
    if num_lost := int((rest_point < 0).sum()):
        notes.append(f"{num_lost} keypoints name points that are not there: they count as none")
    rest, rest_point = rest[rest_point >= 0], rest_point[rest_point >= 0]
    if len(rest):
        notes.append(f"{len(rest)} observations stand with the images alone, not with their points: they are kept")
    rest_image = np.searchsorted(start, rest, side="right") - 1
    return _Observed(
        np.concatenate([tracked.point, rest_point]),
        np.concatenate([tracked.image, rest_image]),
        np.concatenate([tracked.keypoint, rest - start[rest_image]]),
        np.concatenate([at, rest]),
    ), notes


def _claimed_keypoints(
    folder: Path,
    tracked: _Observed,
    point_ids: NDArray[np.int64],
    names: list[str],
    counts: NDArray[np.int64],
    start: NDArray[np.int64],
    named_ids: NDArray[np.int64],
) -> NDArray[np.int64]:
    """(O,) where the keypoints of track elements are among those of all images, none of them denied or claimed twice.

    Args:
        tracked: the elements; its ``at`` is not looked at.
        point_ids: by position. names, counts, start (I + 1): of the images and their keypoints, in the order of ids.
        named_ids: (K,) the points that the keypoints name, -1 for none.
    """

    def element(o: int) -> str:
        return f"keypoint {tracked.keypoint[o]} of image {names[tracked.image[o]]!r}"

    wrong = tracked.keypoint >= counts[tracked.image]
    if wrong.any():
        first = int(np.argmax(wrong))
        raise InputError(
            f"{folder}: point {point_ids[tracked.point[first]]} names {element(first)}, which has "
            f"{counts[tracked.image[first]]}"
        )
    at = start[tracked.image] + tracked.keypoint
    differs = (named_ids[at] != point_ids[tracked.point]) & (named_ids[at] != -1)
    if differs.any():
        first = int(np.argmax(differs))
        raise InputError(
            f"{folder}: point {point_ids[tracked.point[first]]} claims {element(first)}, which names point "
            f"{named_ids[at[first]]}",
            "images and points are not of one model: take both from the same export",
        )
    twice = np.bincount(at, minlength=1) > 1
    if twice.any():
        again = element(int(np.flatnonzero(twice[at])[0]))
        raise InputError(f"{folder}: expected as many keypoints as observations of points, found {again} claimed twice")
    return at


def checked_names(names: list[str]) -> None:
    """Raise UsageError for image names that COLMAP's text files cannot hold."""
    for name in names:
        if name.split() != [name]:
            raise UsageError(
                f"COLMAP's text format ends an image name at white space, which {name!r} holds",
                "export the binary format, or rename the image",
            )
