"""One more photograph beside a finished model: its matches with photographs of the model, and the points they tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.mapping.tracks import USELESS_CONFIGS
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.features import Features
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import make_tracks

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class KnownModel:
    """A finished model that photographs are found in.

    Attributes:
        model: its observations name keypoints by their positions among the features.
        features: of its images, in their order; they may be read where they are asked for.
        prior_cameras: its cameras, in their order, as they were known before anything was seen with them.
    """

    model: Reconstruction
    features: Sequence[Features]
    prior_cameras: Sequence[Camera]


@dataclass(frozen=True)
class NewPhotograph:
    """A photograph that is to be found in a model.

    Attributes:
        name: of it.
        features: its keypoints and descriptors.
        camera: that took it, as far as is known.
        camera_idx: which of the model's cameras that is; None where it is none of them.
    """

    name: str
    features: Features
    camera: Camera
    camera_idx: int | None = None


def attach(known: KnownModel, photograph: NewPhotograph, matches: Correspondences) -> Reconstruction:
    """The model with a photograph as its last image, not registered, and the observations that its matches tell.

    A keypoint that was matched with several points shows the one that most of the matches are with.

    Args:
        matches: verified, pairs (image of the model, number of images of the model).
    """
    model, tracks = known.model, known.model.tracks
    query, cameras = len(model.image_names), list(model.cameras)
    camera_idx = photograph.camera_idx
    if camera_idx is None:
        camera_idx = len(cameras)
        cameras.append(photograph.camera)
    track, feature = _shown_points(model, matches)
    xy = photograph.features.keypoints[feature, :2].astype(np.float64)
    track_idx = np.concatenate([tracks.obs_track_idx, track])
    # its observations come last of each track: those of the model keep what is known of them
    order = np.argsort(track_idx, kind="stable")
    joined = make_tracks(
        query + 1, tracks.num_tracks, track_idx[order],
        np.concatenate([tracks.obs_image_idx, np.full(len(track), query)])[order],
        np.concatenate([tracks.obs_feature_idx, feature])[order], np.concatenate([tracks.obs_xy, xy])[order],
    )  # fmt: skip
    return replace(
        model,
        cameras=cameras,
        image_names=[*model.image_names, photograph.name],
        image_camera_idx=np.append(model.image_camera_idx, camera_idx).astype(np.int32),
        cam_from_world=np.concatenate([model.cam_from_world, np.full((1, 7), np.nan)]),
        tracks=joined,
        obs_is_inlier=np.concatenate([model.obs_is_inlier, np.zeros(len(track), bool)])[order],
        point_xyz=model.point_xyz.copy(),
        rig=None,
    )


def _shown_points(model: Reconstruction, matches: Correspondences) -> tuple[Ints, Ints]:
    """Points (N,), each at most once, and the keypoints (N,) of the photograph that show them, each at most once."""
    tracks, none = model.tracks, np.zeros(0, np.int64)
    supports = model.obs_is_inlier & model.is_triangulated[tracks.obs_track_idx]
    seen: list[NDArray[np.int64]] = []
    for p, (image, _) in enumerate(matches.pair_image_idx.tolist()):
        if matches.config[p] in USELESS_CONFIGS:
            continue
        obs = tracks.observations_of_image(image)
        obs = obs[supports[obs]]
        found = matches.matches_of_pair(p).astype(np.int64)
        point = np.full(int(max(tracks.obs_feature_idx[obs].max(initial=-1), found[:, 0].max(initial=-1))) + 1, -1)
        point[tracks.obs_feature_idx[obs]] = tracks.obs_track_idx[obs]
        shown = np.stack([point[found[:, 0]], found[:, 1]], 1)
        seen.append(shown[shown[:, 0] >= 0])
    if not seen:
        return none, none
    pairs, votes = np.unique(np.concatenate(seen), axis=0, return_counts=True)
    for column in (0, 1):
        order = np.lexsort((pairs[:, 1 - column], -votes, pairs[:, column]))
        first = order[np.unique(pairs[order, column], return_index=True)[1]]
        pairs, votes = pairs[first], votes[first]
    return pairs[:, 0], pairs[:, 1]
