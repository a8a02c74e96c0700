"""Photographs into a map that stands: matched with its keyframes, registered against its points, adjusted with it."""

from __future__ import annotations

from collections.abc import Sequence as Rows
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.options import AdjustReport
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.features.extract import extract_features
from sfmapp.images.folder import load_images
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.images.sequence import Sequence
from sfmapp.images.sequence_source import SequenceSource
from sfmapp.mapping.mapper import Mapper
from sfmapp.mapping.register import Registration
from sfmapp.mapping.tracks import build_tracks, track_colors
from sfmapp.matching.pairs import select_pairs
from sfmapp.matching.stage import match_images
from sfmapp.odometry.result import OdometryResult
from sfmapp.report.model import PhotoReport
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.features import Features
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import RigImages
from sfmapp.scene.tracks import Tracks, make_tracks
from sfmapp.workspace.options import Options

STAGE = "photographs"
# Photographs are matched with so many keyframes at most, evenly over the map: neighbours show the same.
MAX_KEYFRAMES = 200
# Keyframes are matched with so many next ones.
KEYFRAME_OVERLAP = 4
PREFIX = "photos/"


@dataclass(frozen=True)
class PhotoResult:
    """What became of the photographs.

    Attributes:
        rows: of each one.
        skipped: (name, reason) of files that could not be used.
        adjustment: the closing adjustment of the map with them.
    """

    rows: list[PhotoReport]
    skipped: tuple[tuple[str, str], ...]
    adjustment: AdjustReport


def add_photos(
    model: Reconstruction, odometry: OdometryResult, sequence: Sequence, photos: str, options: Options, *,
    threads: int, pool: Executor, events: Events,
) -> tuple[Reconstruction, PhotoResult]:  # fmt: skip
    """The largest map of an odometry run with photographs registered in it.

    Keyframes and photographs get features, which are matched and joined to tracks; those of the keyframes are
    triangulated from the poses that are known, beside the points that are there. Then the mapper goes on as if it had
    come that far itself.

    Args:
        model: the map, refined or not; a new one is returned.
        odometry: whose largest map it is.
        sequence: whose frames the keyframes are.
        photos: a folder, a glob or a list.
        options: of images, features, pairs, matching, mapping and adjustment.

    Raises:
        InputError: there is no usable photograph, or the frames of the sequence are gone.
    """
    found, _ = load_images(photos, options.images, events, threads=threads)
    if not found.images:
        raise InputError(f"{photos}: no usable photograph to add", "-v names the files and what is wrong with them")
    image_of_frame = _chosen_keyframes(odometry)
    names = {frame: model.image_names[image] for frame, image in image_of_frame.items()}
    with SequenceSource(sequence, names) as source:
        keyframes = [(image, _keyframe(model, image, source)) for image in image_of_frame.values()]
        images = _joined_images(model, [record for _, record in keyframes], found)
        features, _ = extract_features(images, options.features, threads=threads, events=events)
    _check_sequence(source, sequence.source)
    pairs, _ = select_pairs(images, features, options.pairs, seed=options.seed, threads=threads, events=events)
    # how the keyframes lie to each other is known: they need points that the photographs can see, no more
    pairs = pairs[(pairs[:, 1] >= len(keyframes)) | (np.diff(pairs, axis=1)[:, 0] <= KEYFRAME_OVERLAP)]
    matches, _ = match_images(
        images, features, pairs, options.matching, seed=options.seed, threads=threads, events=events
    )
    idx_of_image = np.concatenate(
        [[idx for idx, _ in keyframes], len(model.image_names) + np.arange(len(found.images))]
    ).astype(np.int64)
    joined = join(model, images, features, matches, idx_of_image)
    attempts: dict[int, Registration] = {}
    mapper = Mapper(
        reconstruction=joined, correspondences=_as_joined(matches, model.tracks, idx_of_image),
        options=options.mapping, adjust_options=options.adjust, events=events, pool=pool,
        prior_cameras=list(joined.cameras), locked=np.zeros(len(joined.image_names), bool), attempts=attempts,
    )  # fmt: skip
    events.started(STAGE, f"adding {len(found.images)} photographs", total=None)
    mapper.triangulate_images([idx for idx, _ in keyframes])
    mapper.grow()
    mapper.finish()
    adjustment = mapper.polish()
    rows = [_row(joined, len(model.image_names) + k, attempts) for k in range(len(found.images))]
    events.finished(STAGE, f"{sum(row.is_registered for row in rows)} of {len(rows)} photographs registered")
    return joined, PhotoResult(rows, found.skipped, adjustment)


def _chosen_keyframes(odometry: OdometryResult) -> dict[int, int]:
    """Images in the largest map of up to MAX_KEYFRAMES of its keyframes, by frame, in the order of the frames."""
    entry = odometry.maps[0]
    chosen = np.arange(len(entry.keyframe_frame_idx))[:: -(-len(entry.keyframe_frame_idx) // MAX_KEYFRAMES)]
    return dict(sorted((int(entry.keyframe_frame_idx[k]), int(entry.keyframe_image_idx[k])) for k in chosen))


def _keyframe(model: Reconstruction, image_idx: int, source: SequenceSource) -> ImageRecord:
    name, camera_idx = model.image_names[image_idx], int(model.image_camera_idx[image_idx])
    camera = model.cameras[camera_idx]
    return ImageRecord(name, Path(name), camera.width, camera.height, camera_idx=camera_idx, source=source)


def _check_sequence(source: SequenceSource, place: str) -> None:
    """Raises InputError if the frames are not those that the map was made of."""
    if source.renamed is not None:
        idx, expected, found = source.renamed
        raise InputError(
            f"{place}: frame {idx} is {found}, not {expected} as in the odometry run",
            "the sequence has changed: run sfmapp odometry again",
        )
    if not source.num_found:
        raise InputError(f"{place}: the frames of the odometry run are gone")


def _joined_images(model: Reconstruction, keyframes: Rows[ImageRecord], photos: ImageSet) -> ImageSet:
    """Keyframes and photographs as one set; the cameras of the map come first."""
    shifted = [
        replace(record, name=PREFIX + record.name, camera_idx=record.camera_idx + len(model.cameras))
        for record in photos.images
    ]
    return ImageSet((*keyframes, *shifted), (*model.cameras, *photos.cameras), photos.skipped)


def join(
    model: Reconstruction, images: ImageSet, features: Rows[Features], matches: Correspondences,
    idx_of_image: NDArray[np.int64],
) -> Reconstruction:  # fmt: skip
    """The map with the tracks of the features beside its own, and images that are not registered yet.

    Args:
        idx_of_image: position in the result of each image of the set; those from ``len(model.image_names)`` on are new.
    """
    new, _ = build_tracks(matches, features)
    old, num_old = model.tracks, len(model.image_names)
    added = [images.images[k] for k in np.flatnonzero(idx_of_image >= num_old)]
    tracks = _tracks_beside(old, new, idx_of_image, num_old + len(added))
    names = [*model.image_names, *(record.name for record in added)]
    camera_idx = np.concatenate([model.image_camera_idx, [record.camera_idx for record in added]]).astype(np.int32)
    joined = Reconstruction.empty(list(images.cameras), names, camera_idx, tracks)
    joined.cam_from_world[:num_old] = model.cam_from_world
    joined.point_xyz[: old.num_tracks] = model.point_xyz
    # tracks of the map come first, so its observations stay in order
    joined.obs_is_inlier[: old.num_observations] = model.obs_is_inlier
    joined.point_rgb = np.concatenate([model.point_rgb, track_colors(new, features)])
    if model.rig is not None:
        none = np.full(len(added), -1, np.int32)
        frame_idx, sensor_idx = np.append(model.rig.frame_idx, none), np.append(model.rig.sensor_idx, none + 1)
        joined.rig = RigImages(frame_idx.astype(np.int32), sensor_idx.astype(np.int32), model.rig.cam_from_rig)
    return joined


def _tracks_beside(old: Tracks, new: Tracks, idx_of_image: NDArray[np.int64], num_images: int) -> Tracks:
    """Both sets of tracks; keypoints of the new ones are numbered after those of the old."""
    offset = _num_features(old)
    return make_tracks(
        num_images,
        old.num_tracks + new.num_tracks,
        np.concatenate([old.obs_track_idx, new.obs_track_idx + old.num_tracks]),
        np.concatenate([old.obs_image_idx, idx_of_image[new.obs_image_idx]]),
        np.concatenate([old.obs_feature_idx, new.obs_feature_idx + offset]),
        np.concatenate([old.obs_xy, new.obs_xy]),
    )


def _as_joined(matches: Correspondences, old: Tracks, idx_of_image: NDArray[np.int64]) -> Correspondences:
    """Matches with the images and keypoints numbered as :func:`join` has them."""
    pairs = idx_of_image[matches.pair_image_idx].astype(np.int32)
    return replace(matches, pair_image_idx=pairs, matches=matches.matches + np.int32(_num_features(old)))


def _num_features(tracks: Tracks) -> int:
    """Keypoints of other tracks are numbered from here on."""
    return int(tracks.obs_feature_idx.max(initial=-1)) + 1


def _row(model: Reconstruction, image_idx: int, attempts: dict[int, Registration]) -> PhotoReport:
    name = model.image_names[image_idx].removeprefix(PREFIX)
    attempt, is_registered, reason = attempts.get(image_idx), bool(model.is_registered[image_idx]), ""
    if not is_registered:
        reason = attempt.reason if attempt is not None else "shares too few verified matches with the map"
    return PhotoReport(
        name=name, is_registered=is_registered, reason=reason,
        num_correspondences=attempt.num_correspondences if attempt is not None else None,
        num_pose_inliers=attempt.num_inliers if attempt is not None else None,
    )  # fmt: skip
