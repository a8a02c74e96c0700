"""All that a recording shows, as plain arrays: made from the results of a run, drawn by another process.

Everything stands in the frame of the final model. What the run saw on its way (other gauges, other scales) is carried
over by a similarity fitted to the cameras, so that nothing jumps when it is played.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import similarity
from sfmapp.geometry.orientation import upright_pinhole, upright_poses, upright_size, upright_vectors, upright_xy
from sfmapp.geometry.upright import up_direction
from sfmapp.viewer.handover import HandedOver

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageRecord, ImageSet
    from sfmapp.scene.features import Features
    from sfmapp.scene.reconstruction import Reconstruction
    from sfmapp.viewer.listener import Message, Step

Float32 = NDArray[np.float32]
Ints = NDArray[np.int64]

# Points of the final models that are drawn; beyond this a viewer slows down and a person sees no more.
MAX_FINAL_POINTS = 300_000
# Keypoints that found no place in the model are drawn for comparison only: the coarsest of each image.
MAX_LOOSE_KEYPOINTS = 2000


@dataclass(frozen=True)
class Replay(HandedOver):
    """A run, ready to be drawn. S steps, I images, M models (largest first), P pose and C cloud snapshots.

    Photographs are shown upright: their cameras are rolled until they are (:mod:`sfmapp.geometry.orientation`), and all
    pixels are counted in the upright picture.

    Attributes:
        title: shown on the recording.
        image_names, image_paths: of the I images.
        image_size: (I, 2) int64 width and height, upright; image_orientation: (I,) int64, EXIF.
        image_model: (I,) int64, model that holds the image, -1 for none; image_step: (I,) int64, step at which it was
            registered, -1 for never.
        image_intrinsics: (I, 4) float32 fx, fy, cx, cy in pixels.
        model_cam_from_world: (M, I, 7) float32, NaN where the image is not in the model.
        model_ptr: (M + 1,) int64; the points of model m are ``model_xyz[model_ptr[m]:model_ptr[m + 1]]``, coloured
            model_rgb.
        step: (S,) int64 ascending from 1, a time for each image that was registered and each other change of the map;
            step_registered, step_points: (S,) int64; step_error_px: (S,) float32.
        pose_step, pose_model: (P,) int64, and pose_cam_from_world: (P, I, 7) float32 as they were at that step.
        cloud_step, cloud_model: (C,) int64, cloud_ptr: (C + 1,) int64, cloud_xyz: (N, 3) float32, cloud_rgb:
            (N, 3) uint8.
        obs_ptr: (I + 1,) int64, obs_xy and obs_residual: (O, 2) float32, where the points of the final model were seen,
            and projected minus observed, in pixels.
        keypoint_ptr: (I + 1,) int64, keypoint_xy: (K, 2) float32, keypoints of no point.
        messages: (step, level, text) of what was decided.
        up: (3,) float64, the direction that is drawn upwards.
    """

    title: str
    image_names: list[str]
    image_paths: list[str]
    image_size: Ints
    image_orientation: Ints
    image_model: Ints
    image_step: Ints
    image_intrinsics: Float32
    model_cam_from_world: Float32
    model_ptr: Ints
    model_xyz: Float32
    model_rgb: NDArray[np.uint8]
    step: Ints
    step_registered: Ints
    step_points: Ints
    step_error_px: Float32
    pose_step: Ints
    pose_model: Ints
    pose_cam_from_world: Float32
    cloud_step: Ints
    cloud_model: Ints
    cloud_ptr: Ints
    cloud_xyz: Float32
    cloud_rgb: NDArray[np.uint8]
    obs_ptr: Ints
    obs_xy: Float32
    obs_residual: Float32
    keypoint_ptr: Ints
    keypoint_xy: Float32
    messages: list[tuple[int, str, str]]
    up: NDArray[np.float64]

    @classmethod
    def load(cls, folder: Path) -> Self:
        """What :meth:`save` wrote, the messages as they were."""
        loaded = super().load(folder)
        return replace(loaded, messages=[(int(step), level, text) for step, level, text in loaded.messages])


def make_replay(
    image_set: ImageSet,
    features: Sequence[Features],
    reconstructions: Sequence[Reconstruction],
    steps: Sequence[Step],
    messages: Sequence[Message] = (),
    *,
    title: str = "",
    up: NDArray[np.float64] | None = None,
) -> Replay:
    """Put the results of a run and its steps together.

    Args:
        image_set, features: the photographs and their keypoints, I of each.
        reconstructions: final models, largest first; may be empty.
        steps, messages: what a :class:`~sfmapp.viewer.listener.RecordingListener` gathered; may be empty.
        title: shown on the recording.
        up: (3,) direction in the world that is up; None: judged from the cameras of each model.
    """
    num_images = len(image_set.images)
    orientation = np.array([record.orientation for record in image_set.images], np.int64)
    final_poses = np.array([r.cam_from_world for r in reconstructions], np.float64).reshape(-1, num_images, 7)
    upright = upright_poses(final_poses, orientation)
    image_model = np.full(num_images, -1, np.int64)
    for m in reversed(range(len(reconstructions))):
        image_model[~np.isnan(final_poses[m, :, 0])] = m
    return Replay(
        title=title,
        image_names=[record.name for record in image_set.images],
        image_paths=[str(record.path) for record in image_set.images],
        image_size=np.array(
            [upright_size(r.orientation, r.width, r.height) for r in image_set.images], np.int64
        ).reshape(-1, 2),
        image_orientation=orientation,
        image_model=image_model,
        image_intrinsics=_intrinsics(reconstructions, image_model, orientation),
        model_cam_from_world=upright.astype(np.float32),
        **_final_points(reconstructions),
        **_history(steps, messages, reconstructions, final_poses, image_model, orientation),
        **_observations(features, reconstructions, image_model, image_set.images),
        up=np.asarray(up, np.float64) if up is not None else up_direction(upright[0] if len(upright) else None),
    )


# ------------------------------------------------------------------------------------------------ into the final frame


def _models_of_steps(steps: Sequence[Step], final_poses: NDArray[np.float64]) -> list[int]:
    """The final model that each step worked on: the one that shares most images with it; -1 for none."""
    models: list[int] = []
    for step in steps:
        if step.cam_from_world is None or not len(final_poses):  # thinned out: the same as the step before
            models.append(models[-1] if models else -1)
            continue
        shared = (~np.isnan(step.cam_from_world[None, :, 0]) & ~np.isnan(final_poses[:, :, 0])).sum(1)
        models.append(int(shared.argmax()) if shared.max() >= 2 else -1)
    return models


def _to_final_frame(
    step: Step, final_poses: NDArray[np.float64], model: int
) -> tuple[NDArray[np.float64], Float32 | None] | None:
    """Poses (I, 7) and points of a step in the frame of its final model; None where the two cannot be joined."""
    if model < 0 or step.cam_from_world is None:
        return None
    poses = step.cam_from_world.astype(np.float64)
    present = ~np.isnan(poses[:, 0])
    common = present & ~np.isnan(final_poses[model, :, 0])
    try:
        final_from_step = similarity.align_poses(poses[common], final_poses[model, common]).b_from_a
    except ValueError:
        return None
    poses[present] = similarity.transform_poses(final_from_step, poses[present])
    xyz = None if step.point_xyz is None else similarity.apply(final_from_step, step.point_xyz).astype(np.float32)
    return poses, xyz


# ------------------------------------------------------------------------------------------------ arrays of the parts


def _history(
    steps: Sequence[Step], messages: Sequence[Message], reconstructions: Sequence[Reconstruction],
    final_poses: NDArray[np.float64], image_model: Ints, orientation: Ints,
) -> dict[str, Any]:  # fmt: skip
    """All that has a place in time: numbers, poses, points, registrations, messages."""
    # images that were registered together follow each other, so that each is seen; 0 is before the first
    ends = np.cumsum([max(1, len(s.image_idx)) for s in steps]).astype(np.int64)
    end_of = dict(zip([s.step for s in steps], ends.tolist(), strict=True))
    final_step = int(ends[-1]) + 1 if steps else 1
    model_of = _models_of_steps(steps, final_poses)
    image_step = np.where(image_model >= 0, final_step, -1)
    for s, end, m in reversed(list(zip(steps, ends, model_of, strict=True))):
        for place, image_idx in enumerate(s.image_idx):
            if image_model[image_idx] == m >= 0:
                image_step[image_idx] = end - len(s.image_idx) + 1 + place
    moved = [_to_final_frame(s, final_poses, m) for s, m in zip(steps, model_of, strict=True)]
    kept = [(k, *pose) for k, pose in enumerate(moved) if pose is not None]
    clouds = [(k, xyz) for k, _, xyz in kept if xyz is not None]
    num_registered, num_points, error_px = 0, 0, np.nan
    texts = [(end_of.get(m.step, 0), m.level, m.text) for m in messages]
    if reconstructions:
        summary = reconstructions[0].summary()
        num_registered, num_points = summary.num_registered, summary.num_points
        error_px = summary.mean_reprojection_error_px
        texts.append((final_step, "INFO", _final_text(reconstructions)))
    return {
        "image_step": image_step.astype(np.int64),
        "step": np.append(ends, final_step).astype(np.int64),
        "step_registered": np.array([*(s.num_registered for s in steps), num_registered], np.int64),
        "step_points": np.array([*(s.num_points for s in steps), num_points], np.int64),
        "step_error_px": np.array([*(s.mean_error_px for s in steps), error_px], np.float32),
        "pose_step": np.array([ends[k] for k, _, _ in kept], np.int64),
        "pose_model": np.array([model_of[k] for k, _, _ in kept], np.int64),
        "pose_cam_from_world": upright_poses(
            np.array([p for _, p, _ in kept], np.float64).reshape(-1, len(image_model), 7), orientation
        ).astype(np.float32),
        "cloud_step": np.array([ends[k] for k, _ in clouds], np.int64),
        "cloud_model": np.array([model_of[k] for k, _ in clouds], np.int64),
        "cloud_ptr": _offsets([len(xyz) for _, xyz in clouds]),
        "cloud_xyz": _join([xyz for _, xyz in clouds], 3, np.float32),
        "cloud_rgb": _join([_colors(reconstructions[model_of[k]], steps[k]) for k, _ in clouds], 3, np.uint8),
        "messages": texts,
    }


def _colors(reconstruction: Reconstruction, step: Step) -> NDArray[np.uint8]:
    """(K, 3) colours of the points of a step; points that did not last have none and are grey.

    So are those of a step whose tracks are not those of the model, as a round of mapping that was given up made others.
    """
    assert step.point_track_idx is not None
    if len(step.point_track_idx) and step.point_track_idx.max() >= len(reconstruction.point_rgb):
        return np.full((len(step.point_track_idx), 3), 128, np.uint8)
    rgb = reconstruction.point_rgb[step.point_track_idx]
    return np.where(rgb.any(1, keepdims=True), rgb, np.uint8(128))


def _final_points(reconstructions: Sequence[Reconstruction]) -> dict[str, Any]:
    shown = []
    for r in reconstructions:
        track_idx = np.flatnonzero(r.is_triangulated)
        shown.append(track_idx[:: max(1, -(-len(track_idx) // MAX_FINAL_POINTS))])
    return {
        "model_ptr": _offsets([len(track_idx) for track_idx in shown]),
        "model_xyz": _join([r.point_xyz[k] for r, k in zip(reconstructions, shown, strict=True)], 3, np.float32),
        "model_rgb": _join([r.point_rgb[k] for r, k in zip(reconstructions, shown, strict=True)], 3, np.uint8),
    }


def _offsets(counts: Sequence[int]) -> Ints:
    return np.concatenate([[0], np.cumsum(np.asarray(counts, np.int64))]).astype(np.int64)


def _join(parts: Sequence[NDArray[Any]], width: int, dtype: Any) -> NDArray[Any]:
    return np.concatenate([np.zeros((0, width), dtype), *(np.asarray(p, dtype) for p in parts)])


def _observations(
    features: Sequence[Features],
    reconstructions: Sequence[Reconstruction],
    image_model: Ints,
    records: Sequence[ImageRecord],
) -> dict[str, Any]:
    residuals = [r.residuals_px() for r in reconstructions]
    seen_xy, seen_residual, loose_xy = [], [], []
    for image_idx, (feature, model) in enumerate(zip(features, image_model, strict=True)):
        is_loose = np.ones(len(feature), bool)
        xy, residual = np.zeros((0, 2)), np.zeros((0, 2))
        if model >= 0:
            tracks = reconstructions[model].tracks
            obs = tracks.observations_of_image(image_idx)
            obs = obs[reconstructions[model].obs_is_inlier[obs]]
            is_loose[tracks.obs_feature_idx[obs]] = False
            xy, residual = tracks.obs_xy[obs], residuals[model][obs]
        record = records[image_idx]
        loose = feature.keypoints[is_loose][:MAX_LOOSE_KEYPOINTS, :2]
        seen_xy.append(upright_xy(record.orientation, xy, record.width, record.height))
        seen_residual.append(upright_vectors(record.orientation, residual))
        loose_xy.append(upright_xy(record.orientation, loose, record.width, record.height))
    return {
        "obs_ptr": _offsets([len(xy) for xy in seen_xy]),
        "obs_xy": _join(seen_xy, 2, np.float32),
        "obs_residual": _join(seen_residual, 2, np.float32),
        "keypoint_ptr": _offsets([len(xy) for xy in loose_xy]),
        "keypoint_xy": _join(loose_xy, 2, np.float32),
    }


def _intrinsics(reconstructions: Sequence[Reconstruction], image_model: Ints, orientation: Ints) -> Float32:
    out = np.full((len(image_model), 4), np.nan, np.float32)
    for image_idx in np.flatnonzero(image_model >= 0):
        reconstruction = reconstructions[image_model[image_idx]]
        camera = reconstruction.cameras[reconstruction.image_camera_idx[image_idx]]
        turn = int(orientation[image_idx])
        out[image_idx] = upright_pinhole(turn, camera.canonical[:4], camera.width, camera.height)
    return out


def _final_text(reconstructions: Sequence[Reconstruction]) -> str:
    texts = []
    for m, reconstruction in enumerate(reconstructions):
        s = reconstruction.summary()
        texts.append(
            f"model {m}: {s.num_registered} of {s.num_images} images, {s.num_points} points, "
            f"{s.mean_reprojection_error_px:.2f} px"
        )
    return "final " + "; ".join(texts)
