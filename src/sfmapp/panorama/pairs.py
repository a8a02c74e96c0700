"""Which pairs of photographs are pure rotations, by how much, and what the focal length must be for that."""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_rays
from sfmapp.camera.lens import BROWN
from sfmapp.geometry import rigid3
from sfmapp.geometry.homography import rotation_from_rays
from sfmapp.geometry.self_calibration import focal_from_homographies, refine_turning_camera

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Ints = NDArray[np.int64]

# COLMAP's least number of inliers of a pair
MIN_MATCHES = 15
# A pair is a rotation if this share of its verified matches is explained by one: that of COLMAP's two-view geometry.
TURNED_SHARE = 0.9
# Below it, down to the majority, the camera also moved, or something in the picture did.
MAJORITY = 0.5
# Rotations are proposed by two matches each: of so many, one is all right (0.9999) with a half of the matches wrong.
_TRIALS = 32
_MATCHES_OF_TRIAL = 300
# focal lengths tried, in units of the longer side: from a fisheye's to that of a long telephoto lens
_FOCALS = np.geomspace(0.3, 12.0, 23)
_PAIRS_FOR_FOCAL = 12
_SURE_SIGMA = 0.2
# mean squared error, in units of the threshold, by which a focal length must be better than that known before
_TELLING = 1e-3
# Three rotations close if they do so to within this: far above what errors add up to, far below chance.
_TRIANGLE_DEG = 5.0
_LOOP_DEG = 20.0
_AVERAGING_ROUNDS = 20


@dataclass(frozen=True)
class MatchedPixels:
    """A pair and its verified matches.

    Attributes:
        images: positions i < j.
        cameras: of them.
        xy: two of (N, 2) pixels.
    """

    images: tuple[int, int]
    cameras: tuple[int, int]
    xy: tuple[Array, Array]


@dataclass(frozen=True)
class Turn:
    """The rotation that fits a pair best.

    Attributes:
        rotation: (3, 3) j_from_i.
        errors_px: (N,) angles between matched rays, in pixels in the middle of a picture.
        is_inlier: (N,) those within the threshold.
    """

    rotation: Array
    errors_px: Array
    is_inlier: Mask

    @property
    def share(self) -> float:
        """Of the matches that the rotation explains."""
        return float(self.is_inlier.mean()) if len(self.is_inlier) else 0.0


def fit_turn(rays1: Array, rays2: Array, focal: float, threshold_px: float, seed: tuple[int, ...]) -> Turn:
    """The rotation that takes most of the unit rays (N, 3) of one picture to those of another.

    Proposed by two matches each (Black, 1964), scored by truncated squares, refined with Cauchy's weights.

    Args:
        focal: pixels, that angles are counted in. seed: of the draws.
    """
    known = np.isfinite(rays1[:, 0]) & np.isfinite(rays2[:, 0])
    a, b = rays1[known], rays2[known]
    errors = np.full(len(rays1), np.inf)
    if len(a) < 2:
        return Turn(np.eye(3), errors, np.zeros(len(rays1), bool))
    scale = threshold_px / focal
    rng = np.random.default_rng(seed)
    some = rng.permutation(len(a))[:_MATCHES_OF_TRIAL]
    one, two = rng.integers(len(a), size=_TRIALS), rng.integers(len(a), size=_TRIALS)
    turns = np.concatenate([
        _frames(b[one], b[two]) @ _frames(a[one], a[two]).swapaxes(1, 2),
        rotation_from_rays(a, b, np.ones(len(a)))[None],
    ])  # fmt: skip
    # |R a - b|^2 = 2 - 2 b' R a, of unit vectors
    near = 1.0 - turns.reshape(-1, 9) @ (b[some, :, None] * a[some, None, :]).reshape(-1, 9).T
    rotation = turns[np.argmin(np.minimum(near, 0.5 * scale**2).sum(1))]
    for _ in range(4):
        square = ((a @ rotation.T - b) ** 2).sum(1)
        width = min(scale, 3.0 * math.sqrt(float(np.median(square))) + 0.1 * scale)
        rotation = rotation_from_rays(a, b, 1.0 / (1.0 + square / width**2))
    errors[known] = focal * np.linalg.norm(a @ rotation.T - b, axis=1)
    return Turn(rotation, errors, errors < threshold_px)


def _frames(first: Array, second: Array) -> Array:
    """(K, 3, 3) orthonormal columns that two unit vectors (K, 3) span; NaN never: twice the same gives any."""
    across = np.cross(first, second)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    across = np.where(length > 1e-9, across / np.maximum(length, 1e-12), 0.0)
    return np.stack([first, across, np.cross(first, across)], 2)


def measure_turns(
    pairs: Sequence[MatchedPixels], cameras: Sequence[Camera], thresholds: Sequence[float], seed: int
) -> list[Turn]:
    """The best rotation of each pair, with the cameras as they are believed to be. ``thresholds``: of each, pixels."""
    found = []
    for pair, threshold in zip(pairs, thresholds, strict=True):
        both = [cameras[c] for c in pair.cameras]
        rays = [pixels_to_rays(camera, xy) for camera, xy in zip(both, pair.xy, strict=True)]
        focal = 0.5 * (both[0].focal + both[1].focal)
        found.append(fit_turn(rays[0], rays[1], focal, threshold, (seed, *pair.images)))
    return found


def find_focal(
    camera: Camera, pairs: Sequence[MatchedPixels], homographies: Sequence[Array], threshold_px: float, seed: int
) -> Camera:
    """The camera with the focal length for which rotations explain most of what its own pairs show.

    Those of the grid and what the homographies give (HZ 19.19) are tried; the best is refined. What is known from EXIF
    is one of those tried, and it stays where the pairs cannot tell.

    Args:
        camera: as it was known before. pairs: of two photographs of this camera. homographies: of each, NaN for none.
    """
    order = np.argsort([-len(pair.xy[0]) for pair in pairs], kind="stable")[:_PAIRS_FOR_FOCAL]
    best = [pairs[k] for k in order]
    if camera.is_fixed or camera.family != BROWN or not best:
        return camera
    center = camera.canonical[2:4]
    size = max(camera.width, camera.height)
    few = [MatchedPixels(p.images, p.cameras, (_thinned(p.xy[0]), _thinned(p.xy[1]))) for p in best]
    closed = focal_from_homographies([homographies[k] for k in order if np.isfinite(homographies[k]).all()], center)
    trials = [camera.focal, *(size * _FOCALS), *([] if closed is None else [closed])]

    def turns_at(focal: float) -> list[Turn]:
        cameras = [camera.with_focal(focal)] * (max(few[0].cameras) + 1)
        return measure_turns(few, cameras, [threshold_px] * len(few), seed)

    def cost(focal: float) -> float:
        return float(sum(np.minimum((turn.errors_px / threshold_px) ** 2, 1.0).sum() for turn in turns_at(focal)))

    costs = [cost(float(focal)) for focal in trials]
    # copies of one picture fit any focal length: what was known before stays where no other is better
    is_told = min(costs) < costs[0] - _TELLING * sum(len(pair.xy[0]) for pair in few)
    found = float(trials[int(np.argmin(costs))]) if is_told else camera.focal
    turns = turns_at(found)
    good = [(p.xy[0][t.is_inlier], p.xy[1][t.is_inlier]) for p, t in zip(few, turns, strict=True)
            if t.share > TURNED_SHARE]  # fmt: skip
    if not good:
        return camera.with_focal(found)
    refined = refine_turning_camera(found, center, good)
    is_sure = refined.sigma < _SURE_SIGMA * refined.focal and abs(math.log(refined.focal / found)) < math.log(2.0)
    return camera.with_focal(refined.focal if is_sure else found)


def _thinned(xy: Array) -> Array:
    return xy[:: max(len(xy) // 150, 1)]


def consistent(pairs: Sequence[tuple[int, int]], turns: Array, counts: Ints) -> Mask:
    """(P,) whether the rotation of a pair agrees with more triangles of pairs, weighted by matches, than it does not.

    A pair in no triangle does. ``turns``: (P, 3, 3) j_from_i.
    """
    of = {pair: (turn, count) for pair, turn, count in zip(pairs, turns, counts.tolist(), strict=True)}
    of |= {(j, i): (turn.T, count) for (i, j), (turn, count) in list(of.items())}
    beside: dict[int, set[int]] = {}
    for i, j in of:
        beside.setdefault(i, set()).add(j)
    score = np.zeros(len(pairs))
    for n, (i, j) in enumerate(pairs):
        for k in sorted(beside[i] & beside[j]):
            (first, count1), (second, count2) = of[i, k], of[k, j]
            closes = rigid3.rotation_angle_deg(second @ first @ turns[n].T) < _TRIANGLE_DEG
            score[n] += min(count1, count2) * (1.0 if closes else -1.0)
    return score >= 0.0


def groups_of(num_images: int, pairs: Ints) -> list[Ints]:
    """Groups of two images or more that pairs (P, 2) join, the largest first."""
    beside = _neighbors(num_images, pairs, np.ones(len(pairs), np.int64))
    seen, groups = np.zeros(num_images, bool), []
    for first in range(num_images):
        if not seen[first] and beside[first]:
            group = [first, *(image for image, _ in _tree(beside, first))]
            seen[group] = True
            groups.append(np.sort(np.array(group, np.int64)))
    return sorted(groups, key=lambda group: (-len(group), int(group[0])))


def _neighbors(num_images: int, pairs: Ints, counts: Ints) -> list[list[tuple[int, int]]]:
    """Of each image the images that it is paired with, and the count of each pair."""
    beside: list[list[tuple[int, int]]] = [[] for _ in range(num_images)]
    for (i, j), count in zip(pairs.tolist(), counts.tolist(), strict=True):
        beside[i].append((j, count))
        beside[j].append((i, count))
    return beside


def _tree(beside: Sequence[Sequence[tuple[int, int]]], root: int) -> list[tuple[int, int]]:
    """Images behind the root and the one that each hangs on, along the strongest pairs (Prim, 1957)."""
    seen, order = {root}, []
    heap = [(-count, image, root) for image, count in beside[root]]
    heapq.heapify(heap)
    while heap:
        _, image, before = heapq.heappop(heap)
        if image in seen:
            continue
        seen.add(image)
        order.append((image, before))
        for each, count in beside[image]:
            heapq.heappush(heap, (-count, each, image))
    return order


def average_rotations(num_images: int, pairs: Ints, turns: Array, counts: Ints) -> tuple[Array, Mask]:
    """Rotations (I, 3, 3) cam_from_world, NaN where no pair leads, and (P,) which pairs agree with them.

    Chained along the tree of pairs with most matches, then averaged on the tangent space with Geman and McClure's
    weights (Chatterjee and Govindu, ICCV 2013), so that a loop's error is shared by all of it.
    """
    root = int(np.bincount(pairs.ravel(), np.repeat(counts, 2), num_images).argmax())
    of = {(int(i), int(j)): turn for (i, j), turn in zip(pairs, turns, strict=True)}
    rotations = np.full((num_images, 3, 3), np.nan)
    rotations[root] = np.eye(3)
    for node, before in _tree(_neighbors(num_images, pairs, counts), root):
        step = of[before, node] if (before, node) in of else of[node, before].T
        rotations[node] = step @ rotations[before]
    known = np.isfinite(rotations[pairs[:, 0], 0, 0])
    i, j = pairs[known].T
    measured, strength = turns[known], np.minimum(counts[known], 100.0)
    for _ in range(_AVERAGING_ROUNDS):
        # in the world: the error of a pair is the difference of the turns of its cameras
        error = rigid3.log_so3(rotations[j].swapaxes(1, 2) @ measured @ rotations[i])
        angle2 = (error**2).sum(1)
        scale2 = max(float(np.median(angle2)), math.radians(0.5) ** 2) * 4.0
        laplacian, right = _laplacian(num_images, i, j, strength / (1.0 + angle2 / scale2) ** 2, error)
        step = np.linalg.lstsq(laplacian, right, rcond=None)[0]
        rotations = rotations @ rigid3.exp_so3(-step)
        if np.abs(step).max() < 1e-9:
            break
    agrees = np.zeros(len(pairs), bool)
    agrees[known] = rigid3.rotation_angle_deg(rotations[j].swapaxes(1, 2) @ measured @ rotations[i]) < _LOOP_DEG
    return rotations, agrees


def _laplacian(num_images: int, i: Ints, j: Ints, weights: Array, error: Array) -> tuple[Array, Array]:
    """Normal equations of world rotations s with R <- R exp(-s): s_j - s_i is what a pair's error asks for."""
    laplacian, right = np.zeros((num_images, num_images)), np.zeros((num_images, 3))
    np.add.at(laplacian, (i, i), weights)
    np.add.at(laplacian, (j, j), weights)
    np.add.at(laplacian, (i, j), -weights)
    np.add.at(laplacian, (j, i), -weights)
    np.add.at(right, j, -weights[:, None] * error)
    np.add.at(right, i, weights[:, None] * error)
    return laplacian, right
