"""Where the models of a replay stand, how large their cameras are drawn, and from where they are first looked at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.viewer.replay import Replay

Array = NDArray[np.float64]

# Further models are drawn at this share of the size of the first, and this far apart, in sizes of the first.
_FURTHER_SIZE, _FURTHER_GAP = 0.6, 0.15


@dataclass(frozen=True)
class Stage:
    """The viewer's world: z up, the size of the first model; ``x_viewer = rotation (scale[m] x_model) + shift[m]``.

    Attributes:
        rotation: (3, 3) turns what is up in the models to +z.
        scale: (M,) and shift: (M, 3) of each model; 1 and 0 for the first.
        frustum: length of the cameras as they are drawn.
        eye, target: (3,) the first view.
    """

    rotation: Array
    scale: Array
    shift: Array
    frustum: float
    eye: Array
    target: Array


def set_stage(replay: Replay) -> Stage:
    """Place the models of a replay side by side, with all of them in view."""
    rotation = turn_to_z(replay.up)
    num_models = len(replay.model_cam_from_world)
    if not num_models:
        return Stage(rotation, np.ones(0), np.zeros((0, 3)), 0.1, np.array([0.0, -3.0, 1.5]), np.zeros(3))
    forward = rigid3.rotation_matrix(_poses(replay, 0))[:, 2] @ rotation.T
    direction = eye_direction(forward.mean(0))
    right = np.array([-direction[1], direction[0], 0.0])
    right /= np.linalg.norm(right)
    bodies = [body_of(*_model(replay, m), rotation) for m in range(num_models)]
    size = float(np.linalg.norm(np.ptp(bodies[0], axis=0)))
    scale, shift = np.ones(num_models), np.zeros((num_models, 3))
    edge = float((bodies[0] @ right).max())
    for m in range(1, num_models):
        extent = float(np.linalg.norm(np.ptp(bodies[m], axis=0)))
        scale[m] = _FURTHER_SIZE * size / extent if extent > 0 else 1.0
        bodies[m] = scale[m] * bodies[m]
        shift[m] = bodies[0].mean(0) - bodies[m].mean(0)
        along = (bodies[m] + shift[m]) @ right
        shift[m] += (edge + _FURTHER_GAP * size - along.min()) * right
        bodies[m] = bodies[m] + shift[m]
        edge = float((bodies[m] @ right).max())
    eye, target = frame_view(np.concatenate(bodies), direction)
    return Stage(rotation, scale, shift, frustum_length(*_model(replay, 0)), eye, target)


def _poses(replay: Replay, m: int) -> Array:
    poses = replay.model_cam_from_world[m].astype(np.float64)
    known: Array = poses[~np.isnan(poses[:, 0])]
    return known


def _model(replay: Replay, m: int) -> tuple[Array, Array]:
    """Centres of the cameras (R, 3) and points (N, 3) of a model."""
    xyz = replay.model_xyz[replay.model_ptr[m] : replay.model_ptr[m + 1]].astype(np.float64)
    return rigid3.center(_poses(replay, m)), xyz


def body_of(centers: Array, xyz: Array, rotation: Array) -> Array:
    """(N, 3) cameras and the points of the box that holds 90 % of them along each axis, turned upright."""
    centers, xyz = centers @ rotation.T, xyz @ rotation.T
    if not len(xyz):
        return centers
    low, high = np.percentile(xyz, [5, 95], axis=0)
    return np.concatenate([centers, xyz[((xyz >= low) & (xyz <= high)).all(1)]])


def frustum_length(centers: Array, xyz: Array) -> float:
    """Neighbours should not hide each other, but neither should the cameras of a video be too small to see."""
    middle = np.median(xyz, axis=0) if len(xyz) else centers.mean(0)
    depth = float(np.median(np.linalg.norm(centers - middle, axis=1)))
    chosen = centers[:: max(1, len(centers) // 500)]
    apart = np.linalg.norm(chosen[:, None] - chosen[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    nearest = float(np.median(apart.min(1))) if len(chosen) > 1 else depth
    return float(np.clip(0.45 * nearest, 0.04 * depth, 0.12 * depth)) or 0.1


def eye_direction(mean_forward: Array) -> Array:
    """(3,) unit vector from the scene to the eye: behind and above the cameras, a little aside so that depth shows."""
    heading = mean_forward * [1.0, 1.0, 0.0]
    length = float(np.linalg.norm(heading))
    # cameras all around look nowhere on average: any side will do
    heading = heading / length if length > 0.2 else np.array([0.35, 0.94, 0.0])
    aside = np.array([heading[1], -heading[0], 0.0])
    direction = -heading + 0.35 * aside + np.array([0.0, 0.0, 0.55])
    return np.asarray(direction / np.linalg.norm(direction))


def frame_view(points: Array, direction: Array) -> tuple[Array, Array]:
    """Eye and target (3,) each, the eye in a unit direction from the target, so that points (N, 3) fill the view."""
    right = np.cross(-direction, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    top = np.cross(right, -direction)
    # the viewer opens 55 degrees vertically, and the view is about 4:3; a tenth is left as a margin
    half_height = 0.9 * np.tan(np.radians(55 / 2))
    half = np.array([1.3 * half_height, half_height])
    target = points.mean(0)
    for _ in range(4):  # centre what is seen, step back until all is, and again: perspective shifts the middle
        offset = points - target
        across, toward = offset @ np.stack([right, top], 1), offset @ direction
        distance = float((np.abs(across) / half + toward[:, None]).max())
        seen = across / np.maximum(distance - toward, 1e-9 * distance)[:, None]
        middle = 0.5 * (seen.min(0) + seen.max(0)) * distance
        target = target + middle[0] * right + middle[1] * top
    return target + distance * direction, target


def turn_to_z(up: Array) -> Array:
    """The smallest rotation (3, 3) that takes a vector to +z."""
    z = np.asarray(up, np.float64) / np.linalg.norm(up)
    axis = np.cross(z, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(axis)
    if sine < 1e-9:
        return np.eye(3) if z[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return np.asarray(rigid3.exp_so3(axis / sine * np.arctan2(sine, z[2])))
