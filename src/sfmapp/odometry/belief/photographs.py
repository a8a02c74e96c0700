"""What the landmarks of a model of photographs say of the place that one more photograph was put at.

As :mod:`sfmapp.odometry.loops.evidence` has it for a sequence: landmarks that should be in view look there as they did
in photographs beside it, or not. A place that only looks alike lacks what distinguishes the true one.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, project
from sfmapp.geometry import rigid3
from sfmapp.mapping.near_views import MAX_ANGLE_DEG, MAX_ZOOM
from sfmapp.odometry.loops.evidence import Score, Tally
from sfmapp.odometry.loops.place_recognition import SIGMA_PX, View
from sfmapp.odometry.loops.relocalize import LocalPoints, agreeing_at, sight_change
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]

# Landmarks are expected where a photograph of the model has seen them from about the same side, in about the same size:
# within what descriptors bear, and near enough for nothing to have come between.
_MIN_COS, _SIZES = math.cos(math.radians(MAX_ANGLE_DEG)), (1 / MAX_ZOOM, MAX_ZOOM)
# Photographs that landmarks are described in, and landmarks that are asked for.
_NUM_PHOTOGRAPHS, _MAX_EXPECTED = 6, 400
# Share of clusters that are hidden or have changed in a right place, for a place that is known to have its likes, where
# less is forgiven: 1 of 390 were in 20 photographs of five sets that were left out of a model and found in it, but 4 of
# 36 in another one, which looks past the edges of things that stand before others.
CHANGED_AMONG_LIKES = 0.02
# Edge of the cubes that make landmarks a cluster, in median depths.
_CLUSTER_DEPTHS = 0.2


def judge_place(
    model: Reconstruction, cam_from_world: Array, camera: Camera, picture: Bytes,
    picture_of: Callable[[int], Bytes | None],
) -> Score:  # fmt: skip
    """Look for landmarks of a model in a photograph, where its pose puts them.

    Args:
        model: with points; cameras in pixels of the pictures.
        cam_from_world: (7,) of the photograph. camera: in pixels of its picture.
        picture: (H, W) of the photograph.
        picture_of: (H, W) of an image of the model; None where it is gone.
    """
    obs = _expected(model, cam_from_world, camera)
    image = model.tracks.obs_image_idx[obs]
    parts = []
    for i in np.unique(image):
        shown = picture_of(int(i))
        if shown is not None:
            parts.append(_described(model, obs[image == i], int(i), shown, camera.focal))
    tally, cluster = Tally(), np.full(model.tracks.num_tracks, -1)
    if not parts:
        return Score()
    local = LocalPoints(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    local = local.subset(np.argsort(local.point_id))
    tally.add(*agreeing_at(local, View(picture, np.zeros((0, 2))), camera, cam_from_world))
    edge = _CLUSTER_DEPTHS * float(np.median(np.linalg.norm(local.xyz - rigid3.center(cam_from_world), axis=1)))
    cubes = np.floor(local.xyz / max(edge, 1e-300)).astype(np.int64)
    cluster[local.point_id] = np.unique(cubes, axis=0, return_inverse=True)[1].reshape(-1)
    return tally.score(cluster, np.zeros(0, np.int64))


def _expected(model: Reconstruction, pose: Array, camera: Camera) -> Ints:
    """Observations (N,), one of a point, in the photographs of the model that see most of what this one should."""
    tracks = model.tracks
    obs = np.flatnonzero(model.obs_is_inlier & model.is_triangulated[tracks.obs_track_idx])
    xyz, image = model.point_xyz[tracks.obs_track_idx[obs]], tracks.obs_image_idx[obs]
    expected = project(camera, rigid3.apply(pose, xyz))
    focal = np.array([c.focal for c in model.cameras])[model.image_camera_idx[image]]
    aside, far, near = sight_change(xyz, model.centers[image], rigid3.center(pose))
    size = camera.focal / focal * far / np.maximum(near, 1e-300)
    chosen = (aside > _MIN_COS) & (size > _SIZES[0]) & (size < _SIZES[1])
    chosen &= ((expected > 0) & (expected < [camera.width, camera.height])).all(1)  # False for NaN
    count = np.bincount(image[chosen], minlength=len(model.image_names))
    most = np.argsort(-count, kind="stable")[:_NUM_PHOTOGRAPHS]
    rows = np.flatnonzero(chosen & np.isin(image, most))
    order = rows[np.lexsort((-aside[rows], tracks.obs_track_idx[obs[rows]]))]
    first = order[np.unique(tracks.obs_track_idx[obs[order]], return_index=True)[1]]
    kept: Ints = obs[first[:: 1 + len(first) // _MAX_EXPECTED]]
    return kept


def _described(
    model: Reconstruction, obs: Ints, image: int, picture: Bytes, focal: float
) -> tuple[Ints, Array, Ints, Array, Bytes, Array, Array]:
    """The columns of :class:`LocalPoints` of points that one image shows; depths as another focal length would see
    them in that size."""
    track = model.tracks.obs_track_idx[obs].astype(np.int64)
    xyz, xy = model.point_xyz[track], model.tracks.obs_xy[obs]
    pose = model.cam_from_world[image]
    depth = rigid3.apply(pose, xyz)[:, 2] * focal / model.cameras[model.image_camera_idx[image]].focal
    rotation = np.broadcast_to(rigid3.rotation_matrix(pose), (len(xyz), 3, 3))
    described = View(picture, xy).describe(xy, np.array(SIGMA_PX), np.array(0.0))
    return track, xyz, np.full(len(xyz), image), xy, described, depth, rotation
