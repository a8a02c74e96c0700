"""Points of a reconstruction that one more photograph shows: matched with the photographs that it was made of."""

from __future__ import annotations

from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.features.extract import extract_image
from sfmapp.features.octaves import Scratch
from sfmapp.formats.colmap import read_model
from sfmapp.formats.database import Database
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.matching.stage import match_images
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.workspace.layout import RECONSTRUCT
from sfmapp.workspace.manifest import manifest_of
from sfmapp.workspace.options import options_from_dict

Array = NDArray[np.float64]

MAX_IMAGES = 100
"""Images of a model that a photograph is matched with, evenly over all: neighbours show the same."""


def find_model_points(
    folder: Path, record: ImageRecord, camera: Camera, events: Events
) -> tuple[tuple[str, ...], Array, Array]:
    """Names (ids), places (N, 3) and pixels (N, 2) of points of the largest model that a photograph shows.

    Args:
        folder: of ``sfmapp reconstruct``. record, camera: of the photograph.

    Raises:
        InputError: the folder holds no reconstruction with its features, or the photograph matches none of its images.
    """
    manifest = manifest_of(folder)
    if manifest is None or manifest.command != RECONSTRUCT or not (folder / "database.db").is_file():
        raise InputError(f"{folder}: expected a folder of sfmapp reconstruct with its database, found none")
    options = options_from_dict(manifest.options)
    model, _ = read_model(folder / "sparse" / "0", events)
    chosen = model.registered_idx[:: -(-len(model.registered_idx) // MAX_IMAGES)]
    with Database(folder / "database.db", read_only=True) as database:
        place = {name: i for i, name in enumerate(database.read_images()[1])}
        if missing := [model.image_names[i] for i in chosen if model.image_names[i] not in place]:
            raise InputError(f"{folder}: expected the features of {missing[0]} in its database, found none")
        features = [database.read_features(place[model.image_names[i]]) for i in chosen]
    own, line = extract_image(record, options.features, Scratch())
    for warning in line.warnings:
        events.warned("features", warning)
    records = [
        ImageRecord(model.image_names[i], Path(model.image_names[i]), c.width, c.height, camera_idx=k)
        for k, i in enumerate(chosen)
        for c in [model.cameras[model.image_camera_idx[i]]]
    ]
    cameras = [model.cameras[model.image_camera_idx[i]] for i in chosen]
    query = len(records)
    photograph = ImageRecord(record.name, record.path, record.width, record.height, camera_idx=query)
    images = ImageSet((*records, photograph), (*cameras, camera))
    pairs = np.array([(k, query) for k in range(query)], np.int32).reshape(-1, 2)
    found, _ = match_images(
        images, [*features, own], pairs, options.matching, seed=options.seed, threads=options.num_workers, events=events
    )  # fmt: skip
    votes: defaultdict[int, Counter[int]] = defaultdict(Counter)
    for p, (k, _) in enumerate(found.pair_image_idx):
        track_of = _track_of_keypoint(model, int(chosen[k]))
        for theirs, ours in found.matches_of_pair(p):
            if int(theirs) in track_of:
                votes[int(ours)][track_of[int(theirs)]] += 1
    if not votes:
        raise InputError(
            f"{record.name}: expected to find points of {folder} in it, found none",
            "it has to show the place from about where photographs of the reconstruction were taken",
        )
    keypoints = sorted(votes)
    tracks = [votes[keypoint].most_common(1)[0][0] for keypoint in keypoints]
    return (
        tuple(f"{track}/{n}" for n, track in enumerate(tracks)),
        model.point_xyz[tracks],
        own.keypoints[keypoints, :2].astype(np.float64),
    )


def _track_of_keypoint(model: Reconstruction, image_idx: int) -> dict[int, int]:
    """Tracks with a place, by the keypoints of an image that support them."""
    tracks = model.tracks
    mine = (tracks.obs_image_idx == image_idx) & model.obs_is_inlier
    mine &= np.isfinite(model.point_xyz[tracks.obs_track_idx]).all(1)
    return dict(zip(tracks.obs_feature_idx[mine].tolist(), tracks.obs_track_idx[mine].tolist(), strict=True))
