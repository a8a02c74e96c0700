"""A COLMAP model as flat arrays in COLMAP's own terms (ids), between its files and our Reconstruction (positions)."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError, UsageError
from sfmapp.formats.colmap_rigs import Frame, Rig, mount_images, rig_images
from sfmapp.scene.camera import PARAM_NAMES, Camera, CameraModel
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import make_tracks

Keypoints = list[NDArray[np.float64]]

MODEL_NAMES = {model.value: model.name for model in CameraModel} | {
    6: "FULL_OPENCV", 7: "FOV", 8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE", 10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE", 12: "SIMPLE_DIVISION", 13: "DIVISION", 14: "SIMPLE_FISHEYE", 15: "FISHEYE",
    16: "EUCM", 17: "EQUIRECTANGULAR",
}  # fmt: skip
"""Names of COLMAP 4.2's camera models by id, ours and others: the others are refused by name."""

_LARGEST_SIDE_PX = 1_000_000  # a photograph is smaller; a corrupt file says 10^18


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
        name = model if isinstance(model, str) else MODEL_NAMES.get(model, f"with id {model}")
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
    if not np.isfinite(values).all() or not (values[[name.startswith("f") for name in names]] > 0).all():
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
    lengths = np.linalg.norm(reconstruction.residuals_px()[used], axis=1)
    track_idx = tracks.obs_track_idx[used]
    total = np.bincount(track_idx, lengths, tracks.num_tracks)
    count = np.bincount(track_idx, minlength=tracks.num_tracks)
    mean = total / np.maximum(count, 1)
    mean[(count == 0) | ~np.isfinite(mean)] = -1.0
    return mean


def reconstruction_from_model(folder: Path, model: ColmapModel) -> tuple[Reconstruction, Keypoints]:
    """The reconstruction that a model holds, images and points in ascending order of their ids; all ids are checked.

    Raises:
        InputError: ids that are double, missing or out of range; two names alike; images and tracks that disagree.
    """
    for what, ids in (("camera", model.camera_ids), ("image", model.image_ids), ("point", model.point_ids)):
        values, counts = np.unique(ids, return_counts=True)
        if (counts > 1).any():
            raise InputError(f"{folder}: expected every {what} id once, found {what} {values[counts > 1][0]} twice")
    twice = sorted(name for name, count in Counter(model.image_names).items() if count > 1)
    if twice:
        raise InputError(f"{folder}: expected every image name once, found {twice[0]!r} twice")
    camera_order = np.argsort(model.camera_ids)
    image_order = np.argsort(model.image_ids)
    point_order = np.argsort(model.point_ids)
    image_ids = model.image_ids[image_order]
    xy = [model.points2d_xy[i] for i in image_order]
    camera_idx = _positions(folder, "an image", "camera", model.image_camera_ids[image_order], model.camera_ids)
    rank = np.empty_like(point_order)
    rank[point_order] = np.arange(len(rank))
    obs_point = np.repeat(np.arange(len(rank)), np.diff(model.track_ptr))
    obs_image = _positions(folder, "a point", "image", model.track_image_ids, image_ids)
    obs_xy = _checked_observations(folder, model, image_order, obs_image, obs_point)
    tracks = make_tracks(len(image_ids), len(rank), rank[obs_point], obs_image, model.track_point2d_idx, obs_xy)
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
    return reconstruction, xy


def _positions(
    folder: Path, who: str, what: str, ids: NDArray[np.int64], known_ids: NDArray[np.int64]
) -> NDArray[np.int64]:
    """(N,) ranks of ids (N,) among known_ids."""
    known = np.sort(known_ids)
    position = np.searchsorted(known, ids)
    wrong = position >= len(known)
    if len(known):
        wrong |= known[np.minimum(position, len(known) - 1)] != ids
    if wrong.any():
        raise InputError(f"{folder}: {who} names {what} {ids[np.argmax(wrong)]}, which the model does not hold")
    return position


def _checked_observations(
    folder: Path,
    model: ColmapModel,
    image_order: NDArray[np.int64],
    obs_image: NDArray[np.int64],
    obs_point: NDArray[np.int64],
) -> NDArray[np.float64]:
    """(O, 2) pixels of the track elements, after checking that images and points tell the same story."""
    counts = np.array([len(model.points2d_xy[i]) for i in image_order], np.int64)
    start = np.concatenate([[0], np.cumsum(counts)])
    idx = model.track_point2d_idx
    wrong = idx >= counts[obs_image] if len(idx) else np.zeros(0, bool)
    if wrong.any():
        first = int(np.argmax(wrong))
        raise InputError(
            f"{folder}: point {model.point_ids[obs_point[first]]} names keypoint {idx[first]} of image "
            f"{model.image_names[image_order[obs_image[first]]]!r}, which has {counts[obs_image[first]]}"
        )
    flat_xy = np.concatenate([model.points2d_xy[i] for i in image_order] or [np.zeros((0, 2))])
    flat_ids = np.concatenate([model.points2d_point_ids[i] for i in image_order] or [np.zeros(0, np.int64)])
    at = start[obs_image] + idx
    differs = flat_ids[at] != model.point_ids[obs_point]
    if differs.any():
        first = int(np.argmax(differs))
        raise InputError(
            f"{folder}: point {model.point_ids[obs_point[first]]} claims keypoint {idx[first]} of image "
            f"{model.image_names[image_order[obs_image[first]]]!r}, which names point {flat_ids[at[first]]}"
        )
    if np.count_nonzero(flat_ids != -1) != len(at):
        raise InputError(
            f"{folder}: expected as many keypoints with a point as track elements, found "
            f"{np.count_nonzero(flat_ids != -1)} and {len(at)}"
        )
    return flat_xy[at]


def checked_names(names: list[str]) -> None:
    """Raise UsageError for image names that COLMAP's text files cannot hold."""
    for name in names:
        if name.split() != [name]:
            raise UsageError(
                f"COLMAP's text format ends an image name at white space, which {name!r} holds",
                "export the binary format, or rename the image",
            )
