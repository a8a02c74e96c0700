"""Tracks at the size of large sets, without pictures: a room whose photographs nearly all meet, and a way round a town.

A point is seen where it is in the picture, from its front, and much as it looks in one photograph drawn among those
that see it, as descriptors have it. Poses, points and observations are known; :func:`perturbed` is where a global
adjustment begins.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import perturb
from sfmapp.scene.tracks import make_tracks

Array = NDArray[np.float64]

CAMERA = Camera(CameraModel.SIMPLE_RADIAL, 640, 480, np.array([520.0, 320.0, 240.0, -0.05]))
NOISE_PX = 0.5
# Of a room: how far a view may differ from the one that a point was drawn in, in degrees and as a ratio of distances,
# for most points and for the few that look alike from anywhere.
_NEAR_DEG, _NEAR_RATIO, _ANYWHERE = 30.0, 1.6, 0.05
# Points are drawn and looked at so many at a time.
_BLOCK = 20_000
# Metres beyond which nothing is seen.
_FAR = 15.0


def room(num_images: int, num_observations: int, seed: int = 0) -> Reconstruction:
    """Photographs from all round a table in a room, at their true state, with noisy observations."""
    rng = np.random.default_rng([seed, 1])
    t = np.linspace(0.0, 1.0, num_images, endpoint=False)
    angle, radius = 2 * np.pi * 5 * t, 2.2 + 0.8 * np.sin(2 * np.pi * 3 * t)
    centers = np.stack([radius * np.cos(angle), radius * np.sin(angle), 1.5 + 0.4 * np.sin(2 * np.pi * 7 * t)], 1)
    targets = 0.6 * np.stack([np.cos(2 * np.pi * 11 * t), np.sin(2 * np.pi * 13 * t), 0.5 * np.sin(9 * t)], 1)
    poses = _looking(centers, targets + np.array([0.0, 0.0, 0.8]))
    return _observed(poses, lambda n: _room_points(n, rng), num_observations, rng, detection=0.7)


def street(num_images: int, num_observations: int, seed: int = 0) -> Reconstruction:
    """Photographs on a closed way between walls, at their true state, with noisy observations."""
    rng = np.random.default_rng([seed, 2])
    angle = 2 * np.pi * np.arange(num_images) / num_images
    radius = 0.5 * num_images / (2 * np.pi)
    centers = np.stack([radius * np.cos(angle), radius * np.sin(angle), 1.6 + 0.05 * np.sin(9 * angle)], 1)
    ahead = np.stack([-np.sin(angle), np.cos(angle), np.zeros(num_images)], 1)
    poses = _looking(centers, centers + ahead)
    return _observed(poses, lambda n: _street_points(n, radius, rng), num_observations, rng, detection=0.9)


def perturbed(scene: Reconstruction, seed: int = 0) -> Reconstruction:
    """Where a global adjustment begins: a step of growth away from the minimum."""
    size = rigid3.spread(scene.cam_from_world)
    return perturb(
        scene, rotation_deg=0.1, translation_fraction=0.005 / size, point_fraction=0.01 / size, focal_fraction=0.005,
        seed=seed,
    )  # fmt: skip


def _looking(centers: Array, targets: Array) -> Array:
    """Upright poses (I, 7) of cameras that look from centres to targets, z being up."""
    z = targets - centers
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    rotation = np.stack([x, np.cross(z, x), z], -2)
    return rigid3.from_matrix(rotation, -np.einsum("nij,nj->ni", rotation, centers))


def _room_points(num: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points (num, 3) on walls, floor, a table and what stands on it, and their normals."""
    kind = rng.choice(3, num, p=(0.35, 0.25, 0.4))
    xyz, normal = np.empty((num, 3)), np.empty((num, 3))
    walls, tables, things = (np.flatnonzero(kind == k) for k in range(3))
    axis, side = rng.integers(0, 2, len(walls)), rng.choice([-1.0, 1.0], len(walls))
    xyz[walls] = rng.uniform([-5.0, -4.0, 0.0], [5.0, 4.0, 3.0], (len(walls), 3))
    xyz[walls, axis] = side * np.where(axis == 0, 5.0, 4.0)
    normal[walls] = 0.0
    normal[walls, axis] = -side
    xyz[tables] = rng.uniform([-1.2, -1.2, 0.75], [1.2, 1.2, 0.8], (len(tables), 3))
    normal[tables] = [0.0, 0.0, 1.0]
    turned = rng.normal(size=(len(things), 3))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    middle = rng.uniform([-0.9, -0.9, 0.9], [0.9, 0.9, 1.2], (12, 3))[rng.integers(0, 12, len(things))]
    xyz[things], normal[things] = middle + 0.2 * turned, turned
    return xyz, normal


def _street_points(num: int, radius: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points (num, 3) on walls at both sides of a round way and on the ground, and their normals."""
    angle, side = rng.uniform(0.0, 2 * np.pi, num), rng.integers(0, 3, num)
    outward = np.stack([np.cos(angle), np.sin(angle), np.zeros(num)], 1)
    away = np.where(side == 0, -4.0, np.where(side == 1, 4.0, rng.uniform(-4.0, 4.0, num))) + rng.normal(0, 0.1, num)
    xyz = outward * (radius + away)[:, None]
    xyz[:, 2] = np.where(side == 2, 0.0, rng.uniform(0.0, 5.0, num))
    normal = outward * np.where(side == 0, 1.0, -1.0)[:, None]
    normal[side == 2] = [0.0, 0.0, 1.0]
    return xyz, normal


def _observed(
    poses: Array, draw: Callable[[int], tuple[Array, Array]], num_observations: int, rng: np.random.Generator,
    detection: float,
) -> Reconstruction:  # fmt: skip
    """Draw points until there are so many observations, and put everything together."""
    centers = rigid3.center(poses)
    points, tracks_of, images_of, count, total = [], [], [], 0, 0
    while total < num_observations:
        xyz, normal = draw(_BLOCK)
        seen = np.stack([_sees(pose, center, xyz, normal) for pose, center in zip(poses, centers, strict=True)], 1)
        seen &= _alike(seen, xyz, centers, rng) & (rng.random(seen.shape) < detection)
        kept = seen.sum(1) >= 2
        enough = np.searchsorted(np.cumsum(seen[kept].sum(1)), num_observations - total) + 1
        kept = np.flatnonzero(kept)[:enough]
        track, image = np.nonzero(seen[kept])
        points.append(xyz[kept])
        tracks_of.append(track + count)
        images_of.append(image)
        count, total = count + len(kept), total + len(track)
    xyz, track, image = np.concatenate(points), np.concatenate(tracks_of), np.concatenate(images_of)
    pixels = np.empty((total, 2))
    order = np.argsort(image, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(image[order])) + 1):
        pixels[part] = project(CAMERA, rigid3.apply(poses[image[part[0]]], xyz[track[part]]))
    pixels += rng.normal(0.0, NOISE_PX, pixels.shape)
    feature = np.empty(total, np.int64)
    feature[order] = np.arange(total) - np.searchsorted(image[order], image[order])
    names = [f"{i:05d}.jpg" for i in range(len(poses))]
    tracks = make_tracks(len(poses), count, track, image, feature, pixels)
    out = Reconstruction.empty([CAMERA], names, np.zeros(len(poses), np.int32), tracks)
    out.cam_from_world[:], out.point_xyz[:], out.obs_is_inlier[:] = poses, xyz, True
    return out


def _sees(pose: Array, center: Array, xyz: Array, normal: Array) -> NDArray[np.bool_]:
    """(N,) bool: in the picture, from the front, at most 75 degrees aslant and not far away."""
    seen = np.zeros(len(xyz), bool)
    view = center - xyz
    length = np.linalg.norm(view, axis=1)
    near = np.flatnonzero((length < _FAR) & ((view * normal).sum(1) > np.cos(np.radians(75.0)) * length))
    local = rigid3.apply(pose, xyz[near])
    fx, cx, cy = CAMERA.params[0], CAMERA.params[1], CAMERA.params[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = (np.abs(local[:, 0] / local[:, 2]) < cx / fx) & (np.abs(local[:, 1] / local[:, 2]) < cy / fx)
    seen[near[(local[:, 2] > 0.3) & inside]] = True
    return seen


def _alike(seen: NDArray[np.bool_], xyz: Array, centers: Array, rng: np.random.Generator) -> NDArray[np.bool_]:
    """(N, I) bool: which views of a point are near one that is drawn among those that see it."""
    drawn = np.argmax(seen * rng.random(seen.shape), 1)
    alike = np.zeros(seen.shape, bool)
    point, image = np.nonzero(seen)
    view, first = centers[image] - xyz[point], centers[drawn[point]] - xyz[point]
    length, other = np.linalg.norm(view, axis=1), np.linalg.norm(first, axis=1)
    cosine = (view * first).sum(1) / (length * other)
    ratio = np.abs(np.log(length / other))
    near = (cosine > np.cos(np.radians(_NEAR_DEG))) & (ratio < np.log(_NEAR_RATIO))
    alike[point, image] = near | (rng.random(len(xyz)) < _ANYWHERE)[point]
    return alike
