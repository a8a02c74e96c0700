"""Which way is up where no position and no survey tells: markers, the ground, or how photographs are held."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.orientation import upright_poses
from sfmapp.geometry.upright import up_direction
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

# How level people hold cameras, as a mean over many photographs: the horizon of a hand-held picture is off by some
# degrees, and those of one hand in common.
_HELD_RAD = float(np.radians(5.0))
# Their horizontal axes turn by some 15 degrees: the plane of these is across up, wherever they look.
_TURNED = 0.07
# A ground plane: its points lie within this share of their distance from the cameras, are at least this share of all,
# and its normal is at most so far from the tops of the photographs.
_NEAR, _LEAST_SHARE, _FARTHEST_RAD = 0.005, 0.15, float(np.radians(35.0))
# Planes tried, from each of several seeds, whose results have to agree within this.
_NUM_TRIED, _NUM_SEEDS, _AGREE_RAD = 400, 3, float(np.radians(2.0))
# No ground is more level than that.
_GROUND_RAD = float(np.radians(1.0))
# Markers in one plane have normals within this.
_FLAT_RAD = float(np.radians(10.0))


@dataclass(frozen=True)
class Up:
    """Up in the frame of a model: a unit vector (3,), its standard deviation about each axis, and what told it; or why
    nothing does."""

    direction: Array
    sigma_rad: float
    source: str
    problem: str = ""


def up_of_photographs(model: Reconstruction, orientation: NDArray[np.integer] | list[int]) -> Up:
    """By the roll of photographs, EXIF orientations (I,) undone: people hold cameras level, more or less."""
    poses = upright_poses(model.cam_from_world, orientation)
    across = rigid3.rotation_matrix(poses[model.is_registered])[:, 0]
    spread = np.linalg.eigvalsh(across.T @ across / len(across))
    # of photographs that do not turn, tops are up if they look ahead, and nothing of the kind if they look down
    problem = "" if spread[1] > _TURNED else "photographs look one way: whether that is down or ahead cannot be told"
    return Up(up_direction(poses), 2 * _HELD_RAD if problem else _HELD_RAD, "photographs", problem)


def up_of_ground(model: Reconstruction, photographs: Up) -> Up:
    """By the plane that most points lie on, below the cameras and roughly across the tops of the photographs."""
    xyz = model.point_xyz[model.is_triangulated]
    centers = model.centers[model.is_registered]
    nothing = Up(
        photographs.direction, np.inf, "plane", "there is no plane below the cameras that enough points lie on"
    )
    if photographs.problem or len(xyz) < 30:
        return Up(photographs.direction, np.inf, "plane", photographs.problem) if photographs.problem else nothing
    near = _NEAR * float(np.median(np.linalg.norm(xyz - centers.mean(0), axis=1)))
    found = [_plane(xyz, centers, photographs.direction, near, seed) for seed in range(_NUM_SEEDS)]
    if any(one is None for one in found):
        return nothing
    normals = np.array([one[0] for one in found if one is not None])
    if np.arccos(np.clip(normals @ normals.T, -1.0, 1.0)).max() > _AGREE_RAD:
        return nothing
    return Up(normals[0], max(_GROUND_RAD, found[0][1] if found[0] is not None else np.inf), "plane")


def _plane(xyz: Array, centers: Array, up: Array, near: float, seed: int) -> tuple[Array, float] | None:
    """Normal of the plane with most points, and its standard deviation by their scatter."""
    rng = np.random.default_rng([seed, len(xyz)])
    best, kept = 0, None
    for _ in range(_NUM_TRIED):
        a, b, c = xyz[rng.choice(len(xyz), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if not length > 0:
            continue
        normal *= np.sign(normal @ up) / length
        if normal @ up < np.cos(_FARTHEST_RAD) or ((centers - a) @ normal > 0).mean() < 0.95:
            continue
        inlier = np.abs((xyz - a) @ normal) < near
        if inlier.sum() > best:
            best, kept = int(inlier.sum()), inlier
    if kept is None or best < _LEAST_SHARE * len(xyz):
        return None
    on = xyz[kept] - xyz[kept].mean(0)
    _, spread, axes = np.linalg.svd(on, full_matrices=False)
    normal = axes[2] * np.sign(axes[2] @ up)
    # a slope is known by the scatter over the extent of the points, the shorter way
    return normal, float(spread[2] / max(spread[1], 1e-300) / np.sqrt(max(best - 3, 1)))


def up_of_markers(corners: Array) -> Up:
    """By markers (M, 4, 3) that lie flat on the ground, corners clockwise from their own top left."""
    across, down = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    normals = -np.cross(across, down)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    if not len(normals):
        return Up(np.array([0.0, 0.0, 1.0]), np.inf, "markers", "no marker was measured from two photographs")
    mean = normals.mean(0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    angles = np.arccos(np.clip(normals @ mean, -1.0, 1.0))
    if angles.max() > _FLAT_RAD:
        worst = float(np.degrees(angles.max()))
        return Up(mean, np.inf, "markers", f"markers are turned against each other by {worst:.0f} degrees: some stand")
    sigma = float(np.sqrt((angles**2).mean() / max(len(angles) - 1, 1) / 2)) if len(angles) > 1 else 2 * _GROUND_RAD
    return Up(mean, max(sigma, _GROUND_RAD), "markers")


def level_rotation(up: Array) -> Array:
    """(3, 3) the smallest turn that brings up to z."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return rigid3.exp_so3(axis / sine * np.arctan2(sine, float(up[2])))
