"""Verified matches of views of the town without pictures: what matching would find, made from the town itself.

Points are drawn on walls and on the ground, each with a size that is seen as a keypoint between two distances. A view
has those that are in its picture, before all else, not too aslant, and of which it finds most; a pair matches what both
have and see from much the same side. Keypoints are off by half a pixel, some by more; the two views of each pair that
match most, and those of a chain, are compared. So mapping can be measured at sizes at which features and matching would
take hours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from rendered_worlds.rendering import Renderer, World
from rendered_worlds.towns import Walk, camera
from sfmapp.camera.camera import Camera, project
from sfmapp.geometry import rigid3
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig
from sfmapp.scene.features import Features

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

NOISE_PX, FAR_NOISE_PX, FAR_SHARE = 0.4, 2.0, 0.05
# Points a square metre of walls and of ground, by their sizes in metres, and the pixels that a keypoint has.
_PER_M2, _PER_M2_GROUND, _SIZES_M, _PIXELS = 6.0, 0.8, (0.03, 0.6), (2.0, 12.0)
# Up to which angle to its surface a point is seen, and to another view it is matched; how often it is found, matched.
_ASLANT_DEG, _MATCHED_DEG, _FOUND, _MATCHED = 68.0, 40.0, 0.8, 0.85
# How many others a view is compared with, and matches that verify a pair.
_NUM_NEIGHBORS, _MIN_MATCHES = 30, 20
# Metres beyond which nothing is looked for, and the width of the picture in which is seen what hides what.
_FAR_M, _COARSE_PX = 60.0, 200


@dataclass(frozen=True)
class Sighted:
    """What views have: keypoints (N, 2) and their points (N,) of each, the rays to them (N, 3) in the world."""

    keypoints: list[Array]
    points: list[Ints]
    rays: list[Array]


def sight(world: World, walk: Walk, width: int, seed: int = 0) -> Sighted:
    """Keypoints of every view."""
    rng = np.random.default_rng([seed, 0x70E6])
    lens, coarse = camera(width), camera(_COARSE_PX)
    points = _points(world, walk, rng)
    near, renderer = _Near(points, lens), Renderer(world, coarse)
    found = Sighted([], [], [])
    for pose in walk.cam_from_world:
        center = rigid3.center(pose)
        chosen = near.of(center)
        chosen = chosen[rng.random(len(chosen)) < _FOUND]
        ray = points.xyz[chosen] - center
        distance = np.linalg.norm(ray, axis=1)
        ray /= distance[:, None]
        cosine = -(ray * points.normal[chosen]).sum(1)
        in_camera = rigid3.apply(pose, points.xyz[chosen])
        seen = (cosine > np.cos(np.radians(_ASLANT_DEG))) & (points.size[chosen] * lens.focal < _PIXELS[1] * distance)
        seen = np.flatnonzero(seen & (in_camera[:, 2] > 0.2))
        pixel = project(lens, in_camera[seen])
        inside = ((pixel > 0.0) & (pixel < [lens.width, lens.height])).all(axis=1)
        seen, pixel = seen[inside], pixel[inside]
        view = renderer.view(pose, edge_samples=False)
        column, row = (pixel * (_COARSE_PX / width)).astype(np.int64).T
        shown = view.surface[row, column] == points.quad[chosen[seen]]
        shown |= np.abs(view.depth[row, column] / in_camera[seen, 2] - 1.0) < 0.02
        seen, pixel = seen[shown], pixel[shown]
        sigma = np.where(rng.random(len(seen)) < FAR_SHARE, FAR_NOISE_PX, NOISE_PX)
        found.keypoints.append(pixel + sigma[:, None] * rng.standard_normal(pixel.shape))
        found.points.append(chosen[seen])
        found.rays.append(ray[seen])
    return found


class _Points(NamedTuple):
    """Places (N, 3), rectangles (N,), normals (N, 3) and sizes (N,) in metres."""

    xyz: Array
    quad: Ints
    normal: Array
    size: Array


class _Near:
    """Finds the points that are near enough to be seen, which small ones have to be nearer for."""

    def __init__(self, points: _Points, lens: Camera) -> None:
        reach = np.minimum(points.size * lens.focal / _PIXELS[0], _FAR_M)
        kind = np.ceil(4.0 * np.log2(reach)).astype(np.int64)
        members = [np.flatnonzero(kind == k) for k in np.unique(kind)]
        self._kinds = [(own, cKDTree(points.xyz[own]), reach[own]) for own in members]

    def of(self, center: Array) -> Ints:
        """(K,) positions of the points."""
        found = [own[tree.query_ball_point(center, reach.max())] for own, tree, reach in self._kinds]
        return np.sort(np.concatenate(found))


def _points(world: World, walk: Walk, rng: np.random.Generator) -> _Points:
    """Points around a walk."""
    centers = rigid3.center(walk.cam_from_world)
    low, high = centers.min(0) - _FAR_M, centers.max(0) + _FAR_M
    cross = np.cross(world.edges[:, 1], world.edges[:, 0])
    area = np.linalg.norm(cross, axis=1)
    middle = world.origin + world.edges.sum(1) / 2
    is_near = ((middle > low) & (middle < high))[:, :2].all(axis=1) & (area < 1e4)
    counts = rng.poisson(_PER_M2 * np.where(is_near, area, 0.0))
    quad = np.repeat(np.arange(len(area)), counts)
    along = rng.random((len(quad), 2))
    xyz = world.origin[quad] + np.einsum("nk,nkj->nj", along, world.edges[quad])
    ground = rng.uniform(low[:2], high[:2], (int(_PER_M2_GROUND * np.prod((high - low)[:2])), 2))
    xyz = np.concatenate([xyz, np.column_stack([ground, np.zeros(len(ground))])])
    normal = np.concatenate([cross[quad] / area[quad, None], np.tile([0.0, 0.0, 1.0], (len(ground), 1))])
    quad = np.concatenate([quad, np.full(len(ground), -2)])
    # as many of each size as fit beside each other, but for a square root: small ones are not all told apart
    size = _SIZES_M[0] * (_SIZES_M[1] / _SIZES_M[0]) ** (rng.random(len(xyz)) ** 1.5)
    return _Points(xyz, quad, normal, size)


def features_of(sighted: Sighted) -> list[Features]:
    """Keypoints without descriptors."""
    return [
        Features(
            np.column_stack([xy, np.full(len(xy), 2.0), np.zeros(len(xy))]).astype(np.float32),
            np.zeros((len(xy), 0), np.uint8), np.full((len(xy), 3), 128, np.uint8),
        )
        for xy in sighted.keypoints
    ]  # fmt: skip


def match(sighted: Sighted, walk: Walk, lens: Camera, seed: int = 0) -> Correspondences:
    """Verified pairs of the views, with their true geometry."""
    rng = np.random.default_rng([seed, 0x70E7])
    pairs = _pairs(sighted)
    matches, kept = [], []
    place = np.full(1 + max(int(p.max(initial=0)) for p in sighted.points), -1, np.int64)
    for i in range(len(walk.cam_from_world)):
        place[sighted.points[i]] = np.arange(len(sighted.points[i]))
        for p in np.flatnonzero(pairs[:, 0] == i):
            j = pairs[p, 1]
            first = place[sighted.points[j]]
            both = np.flatnonzero(first >= 0)
            cosine = (sighted.rays[i][first[both]] * sighted.rays[j][both]).sum(1)
            both = both[(cosine > np.cos(np.radians(_MATCHED_DEG))) & (rng.random(len(both)) < _MATCHED)]
            if len(both) >= _MIN_MATCHES:
                matches.append(np.column_stack([first[both], both]).astype(np.int32))
                kept.append(p)
        place[sighted.points[i]] = -1
    pairs = pairs[kept]
    angles = [
        np.degrees(np.median(np.arccos(np.clip((sighted.rays[i][m[:, 0]] * sighted.rays[j][m[:, 1]]).sum(1), -1, 1))))
        for (i, j), m in zip(pairs, matches, strict=True)
    ]  # fmt: skip
    poses = walk.cam_from_world
    relative = rigid3.compose(poses[pairs[:, 1]], rigid3.inverse(poses[pairs[:, 0]]))
    relative[:, 4:] /= np.linalg.norm(relative[:, 4:], axis=1, keepdims=True)
    essential = np.array([rigid3.skew(t) for t in relative[:, 4:]]) @ rigid3.rotation_matrix(relative)
    back = np.linalg.inv(lens.k_matrix)
    counts = np.array([len(m) for m in matches])
    nothing, found = np.full(essential.shape, np.nan), counts.astype(np.int32)
    return Correspondences(
        pairs.astype(np.int32), np.concatenate([[0], np.cumsum(counts)]), np.concatenate(matches),
        np.full(len(pairs), TwoViewConfig.CALIBRATED, np.int8), back.T @ essential @ back, essential, nothing,
        relative, np.array(angles), found, found, found, np.zeros(len(pairs), np.int32),
    )  # fmt: skip


def _pairs(sighted: Sighted) -> Ints:
    """(P, 2) pairs i < j: each view with those that share most points."""
    count = np.array([len(p) for p in sighted.points])
    points = np.concatenate(sighted.points)
    table = csr_array(
        (np.ones(len(points), np.int32), points, np.concatenate([[0], np.cumsum(count)])),
        shape=(len(count), int(points.max(initial=0)) + 1),
    )
    shared = csr_array(table @ table.T)
    pairs = []
    for i in range(len(count)):
        span = slice(shared.indptr[i], shared.indptr[i + 1])
        others, number = shared.indices[span], shared.data[span]
        others, number = (
            others[(others != i) & (number >= _MIN_MATCHES)],
            number[(others != i) & (number >= _MIN_MATCHES)],
        )
        best = others[np.argsort(-number, kind="stable")[:_NUM_NEIGHBORS]]
        pairs.append(np.column_stack([np.minimum(i, best), np.maximum(i, best)]))
    return np.unique(np.concatenate(pairs), axis=0).astype(np.int64)
