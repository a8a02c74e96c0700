"""The pose of an image in a map, from what its corners look like alone.

Places that look like the image propose points; P3P and RANSAC find a pose that many of them agree on; the pose then
says where all points around that place must be, and corners that look like them there are matched as well.

Chance is excluded by counting (the a-contrario test of Moisan and Stival, "A probabilistic criterion to detect rigid
point matches", IJCV 2004). Repeated structure is not chance: the same poster at two places gives many exact matches.
What gives it away is everything around it. So all points that the pose says are in view are asked whether the image
looks there as they do, and most of them have to agree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.pose import RefinedPose, refine_pose
from sfmapp.camera.camera import Camera, pixels_to_normalized, project
from sfmapp.geometry import rigid3
from sfmapp.geometry.resection import estimate_pose
from sfmapp.matching.descriptors import mutual_neighbors
from sfmapp.matching.products import Best, largest_products
from sfmapp.odometry.loops.place_recognition import QUERY_SCALES, SIGMA_PX, Bytes, Candidate, Ids, PlaceIndex, View
from sfmapp.odometry.map.keyframe_map import KeyframeMap

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SIFT_NORM2 = 512 * 512
# A descriptor agrees if fewer than this share of those of other points resembles the image more than its own does.
_CHANCE_RANK = 0.05
# Points nearer than this to each other, in scales of a descriptor, show the same and do not count as others.
_SAME_PATCH_SIGMAS = 8.0
# Two poses of one image are two places beyond this: shares of the depth of what it sees, and degrees. An image that is
# right in both agrees to a hundredth of that.
_ELSEWHERE_DEPTHS, _ELSEWHERE_DEG = 0.1, 5.0
# Landmarks are expected where they are seen from a side as before: within this angle, at a distance between these
# shares of that (what descriptors bear).
_MAX_ASIDE_DEG, _DISTANCE_SHARES = 35.0, (0.6, 1.6)


@dataclass(frozen=True)
class RelocalizeOptions:
    """When an image is believed to show a place of the map. Distances of descriptors are those of unit vectors."""

    max_ratio: float = 0.85  # best distance over second best of a match, from both sides
    max_distance: float = 0.8  # largest distance of a match
    max_error_px: float | None = None  # inlier threshold; None: 0.3 % of the diagonal, within 3 to 8 px
    min_matches: int = 12  # fewest that a pose is looked for with
    min_inliers: int = 25  # fewest points that must agree in the end
    min_agreement: float = 0.5  # least share of the points in view that the image looks like where they must be
    min_spread: float = 0.08  # least standard deviation of the inliers in each direction, share of the image's size
    num_neighbors: int = 4  # keyframes around a place whose points take part
    max_trials: int = 500  # RANSAC samples: finds a pose with a quarter of the matches right with 99.9 %

    def error_px(self, camera: Camera) -> float:
        """The inlier threshold for images of a camera."""
        if self.max_error_px is not None:
            return self.max_error_px
        return min(max(0.003 * math.hypot(camera.width, camera.height), 3.0), 8.0)


@dataclass(frozen=True)
class LocalPoints:
    """The points around a place (M), each as it was seen in one keyframe.

    Attributes:
        point_id: (M,) ascending. xyz: (M, 3) world.
        keyframe_idx: (M,) position of the keyframe. xy: (M, 2) pixels there. descriptors: (M, 128) uint8.
        depth: (M,) in that keyframe. rotation: (M, 3, 3) its cam_from_world.
    """

    point_id: Ids
    xyz: Array
    keyframe_idx: Ids
    xy: Array
    descriptors: Bytes
    depth: Array
    rotation: Array

    def subset(self, chosen: Mask | Ids) -> LocalPoints:
        """The chosen points."""
        return LocalPoints(*(getattr(self, field.name)[chosen] for field in fields(self)))


@dataclass(frozen=True)
class Located:
    """An image in the world of a map.

    Attributes:
        cam_from_world: (7,) of the rig's first camera. covariance: (6, 6) as of ``refine_pose``.
        point_id: (M,) ascending, points that agree. corner_idx: (M,) the corners of the view that they are.
        num_matches: descriptor matches that RANSAC was given.
        num_in_view: points that were asked for their agreement. agreement: the share that gave it.
    """

    cam_from_world: Array
    covariance: Array
    point_id: Ids
    corner_idx: Ids
    num_matches: int
    num_in_view: int
    agreement: float


@dataclass(frozen=True)
class Relocalization:
    """Where a lost image may be: the map, the keyframe that it looks like, and how it lies there."""

    map_idx: int
    frame_idx: int
    located: Located


def relocalize(
    maps: Mapping[int, KeyframeMap], places: PlaceIndex, view: View, options: RelocalizeOptions, roll: float = 0.0
) -> list[Relocalization]:
    """Places of any of the maps that an image fits, the one that it looks like most first.

    Args:
        maps: by the number that they have in ``places``.
        roll: radians by which the image is thought to be turned against the keyframes, from x to y. Descriptors bear
            15 degrees of error, so try 0 and, on other frames, plus and minus 25 degrees.
    """
    fitting = []
    for candidate in places.query_view(view, roll, maps):
        found = locate(maps[candidate.map_idx], places, view, candidate, options, roll)
        if found is not None and is_convincing(found, view, options):
            fitting.append(Relocalization(candidate.map_idx, candidate.frame_idx, found))
    return fitting


def is_elsewhere(pose: Array, other: Array, depth: float) -> bool:
    """Whether two poses (7,) of one image are two places; depth: of what it sees."""
    change = rigid3.compose(other, rigid3.inverse(pose))
    turn = float(rigid3.rotation_angle_deg(rigid3.rotation_matrix(change)))
    return bool(np.linalg.norm(change[4:]) > _ELSEWHERE_DEPTHS * depth or turn > _ELSEWHERE_DEG)


def locate(
    keyframes: KeyframeMap,
    places: PlaceIndex,
    view: View,
    candidate: Candidate,
    options: RelocalizeOptions,
    roll: float,
) -> Located | None:
    """The pose of an image at a place, or None where too few points agree to have one."""
    camera = keyframes.rig.cameras[0]
    local = local_points(keyframes, places, candidate.frame_idx, options.num_neighbors)
    # the points around join in once there is a pose: to match them without one costs more than it finds
    own = np.flatnonzero(local.keyframe_idx == position_of(keyframes, candidate.frame_idx))
    point, corner = match_points(local.descriptors[own], view, roll, options)
    point = own[point]
    if len(point) < options.min_matches:
        return None
    normalized = pixels_to_normalized(camera, view.xy[corner])
    limit = options.error_px(camera)
    found = estimate_pose(
        local.xyz[point], normalized, limit / camera.focal, confidence=0.999, max_iterations=options.max_trials
    )
    if found is None or not is_beyond_chance(found.num_inliers, len(point), limit, camera):
        return None
    return locate_near(local, view, camera, found.cam_from_world, options, len(point))


def locate_near(
    local: LocalPoints, view: View, camera: Camera, predicted: Array, options: RelocalizeOptions, num_matches: int = 0
) -> Located | None:
    """The pose of an image near a predicted one, from all points around; None where they do not hold it.

    Args:
        predicted: (7,) cam_from_world, good to about four inlier thresholds.
    """
    held = hold_near(local, view, camera, predicted, options)
    if held is None:
        return None
    refined, point, corner = held
    num_in_view, agreement = agreement_at(local, view, camera, refined.cam_from_world)
    return Located(
        refined.cam_from_world, refined.covariance, local.point_id[point], corner, num_matches, num_in_view, agreement
    )


def hold_near(
    local: LocalPoints, view: View, camera: Camera, predicted: Array, options: RelocalizeOptions
) -> tuple[RefinedPose, Ids, Ids] | None:
    """The pose of :func:`locate_near`, positions of the points that hold it, and their corners: both (M,)."""
    limit = options.error_px(camera)
    pose = predicted
    for radius in (4.0 * limit, 2.0 * limit):
        point, corner = match_projected(local, view, camera, pose, radius, options)
        if len(point) < 6:
            return None
        refined = refine_pose(
            camera.canonical, pose, local.xyz[point], view.xy[corner], scale_px=0.5 * limit,
            inlier_px=limit,
        )  # fmt: skip
        pose = refined.cam_from_world
    good = refined.is_inlier
    if not np.isfinite(pose).all() or good.sum() < 6:
        return None
    return refined, point[good], corner[good]


def is_convincing(found: Located, view: View, options: RelocalizeOptions) -> bool:
    """Enough points, spread over the image, and nothing around them that contradicts."""
    return (
        len(found.point_id) >= options.min_inliers
        and found.agreement >= options.min_agreement
        and bool((view.xy[found.corner_idx].std(0) >= options.min_spread * np.array(view.shape[::-1])).all())
    )


def local_points(keyframes: KeyframeMap, places: PlaceIndex, frame_idx: int, num_neighbors: int) -> LocalPoints:
    """The triangulated points of a keyframe and of those that share most points with it, each as it looked in the
    first of these that has it."""
    around = [position_of(keyframes, frame_idx)]
    shared = shared_points(keyframes, around[0])
    shared[[k.frame_idx not in places for k in keyframes.keyframes]] = 0
    shared[around[0]] = 0
    best = np.argsort(-shared, kind="stable")[:num_neighbors]
    around += [int(k) for k in best if shared[k] > 0]
    parts = []
    for k in around:
        keyframe = keyframes.keyframes[k]
        place = places[keyframe.frame_idx]
        xyz = keyframes.point_xyz[place.point_id]
        depth = rigid3.apply(keyframe.rig_from_world, xyz)[:, 2]
        rotation = np.broadcast_to(rigid3.rotation_matrix(keyframe.rig_from_world), (len(xyz), 3, 3))
        seen = LocalPoints(
            place.point_id, xyz, np.full(len(xyz), k), place.xy.astype(np.float64), place.descriptors, depth, rotation
        )
        parts.append(seen.subset(depth > 0))  # False for NaN
    joined = LocalPoints(*(np.concatenate([getattr(p, field.name) for p in parts]) for field in fields(LocalPoints)))
    return joined.subset(np.unique(joined.point_id, return_index=True)[1])


def position_of(keyframes: KeyframeMap, frame_idx: int) -> int:
    """Position of the keyframe that a frame is."""
    return next(n for n, k in enumerate(keyframes.keyframes) if k.frame_idx == frame_idx)


def shared_points(keyframes: KeyframeMap, keyframe_idx: int) -> NDArray[np.int64]:
    """(K,) how many triangulated points each keyframe shares with one of them."""
    mark = np.zeros(keyframes.num_points, bool)
    mark[keyframes.keyframes[keyframe_idx].point_id] = True
    mark &= np.isfinite(keyframes.point_xyz[: keyframes.num_points, 0])
    return np.array([np.count_nonzero(mark[k.point_id]) for k in keyframes.keyframes], np.int64)


def match_points(descriptors: Bytes, view: View, roll: float, options: RelocalizeOptions) -> tuple[Ids, Ids]:
    """Mutual nearest neighbours among points and corners at any scale, which pass the ratio test from both sides.

    Returns:
        (K,) positions of the points, ascending, and (K,) of the corners.
    """
    scans = [largest_products(descriptors, view.descriptors(scale, roll)) for scale in QUERY_SCALES]
    best1, best2 = (_over_scales([scan[side] for scan in scans]) for side in (0, 1))
    found = mutual_neighbors(best1, best2, options.max_ratio, options.max_distance)
    return found[:, 0].astype(np.int64), found[:, 1].astype(np.int64)


def _over_scales(scans: list[Best]) -> Best:
    """Best partner at any scale, and the best product with any other partner."""
    best, second, arg = (np.stack(parts) for parts in zip(*scans, strict=True))
    winner = best.argmax(0)
    column = np.arange(best.shape[1])
    partner = arg[winner, column]
    others = np.where(arg == partner, second, best)
    return Best(best[winner, column], others.max(0), partner)


def is_beyond_chance(num_inliers: int, num_matches: int, limit_px: float, camera: Camera) -> bool:
    """Whether fewer than one pose is expected on which so many matches agree by chance: three of them make a pose, and
    any other falls into its circle with the share that this has of the image."""
    n, k = num_matches, num_inliers
    if k < 6:
        return False
    share = min(math.pi * limit_px**2 / (camera.width * camera.height), 1.0)

    def log_choose(a: int, b: int) -> float:
        return math.lgamma(a + 1) - math.lgamma(b + 1) - math.lgamma(a - b + 1)

    # up to four poses for three points
    log_poses = math.log(4.0 * max(n - 3, 1)) + log_choose(n, k) + log_choose(k, 3)
    return log_poses + (k - 3) * math.log(share) < 0.0


def match_projected(
    local: LocalPoints, view: View, camera: Camera, pose: Array, radius_px: float, options: RelocalizeOptions
) -> tuple[Ids, Ids]:
    """Corners near where points must be that look like them; one to one, positions of the points ascending."""
    in_camera = rigid3.apply(pose, local.xyz)
    expected = project(camera, in_camera)
    scale = np.log(local.depth / np.where(in_camera[:, 2] > 0, in_camera[:, 2], np.nan)) / math.log(QUERY_SCALES[-1])
    scale_idx = np.where(np.isfinite(scale), np.clip(np.rint(scale), -1, 1), 0).astype(np.int64) + 1
    roll = float(np.median(twist(rigid3.rotation_matrix(pose), local.rotation))) if len(local.point_id) else 0.0
    described = np.stack([view.descriptors(s, roll_step(roll)) for s in QUERY_SCALES])
    corner = np.full(len(expected), -1, np.int64)
    product = np.full(len(expected), int(_SIFT_NORM2 * (1.0 - 0.5 * options.max_distance**2)), np.int64)
    _nearest_within(expected, scale_idx, local.descriptors, view.xy, described, radius_px, corner, product)
    point = np.flatnonzero(corner >= 0)
    order = point[np.lexsort((point, -product[point], corner[point]))]
    is_first = np.ones(len(order), bool)
    is_first[1:] = corner[order[1:]] != corner[order[:-1]]
    point = np.sort(order[is_first])
    return point, corner[point]


def agreement_at(local: LocalPoints, view: View, camera: Camera, pose: Array) -> tuple[int, float]:
    """How many points a pose puts into the image, and the share of these that :func:`agreeing_at` says to agree."""
    point_id, agrees = agreeing_at(local, view, camera, pose)
    return len(point_id), float(agrees.mean()) if len(point_id) > 1 else 0.0


def agreeing_at(local: LocalPoints, view: View, camera: Camera, pose: Array) -> tuple[Ids, Mask]:
    """The points (N,) that a pose puts into the image, and which of them the image looks like in their places.

    A point agrees if nineteen in twenty of the others resemble what is there less than it does itself. No threshold on
    the likeness is involved, so light and blur do not matter much; under a wrong pose one point in twenty agrees.
    """
    in_camera = rigid3.apply(pose, local.xyz)
    expected = project(camera, in_camera)
    margin = 2.0 * SIGMA_PX * 3.0
    size = np.array(view.shape[::-1])
    seen = np.asarray(((expected > margin) & (expected < size - margin)).all(1))  # False for NaN
    shown = local.subset(seen)
    if seen.sum() < 2:
        return shown.point_id, np.zeros(int(seen.sum()), bool)
    place, ratio = expected[seen], shown.depth / in_camera[seen, 2]
    angle = twist(rigid3.rotation_matrix(pose), shown.rotation)
    found = view.describe(place, SIGMA_PX * ratio, angle)
    products = found.astype(np.float32) @ shown.descriptors.T.astype(np.float32)
    own = np.diag(products)
    apart = np.linalg.norm(place[:, None] - place[None], axis=2) > _SAME_PATCH_SIGMAS * SIGMA_PX
    rank = ((products >= own[:, None]) & apart).sum(1) / np.maximum(apart.sum(1), 1)
    return shown.point_id, rank < _CHANCE_RANK


def seen_as_before(keyframes: KeyframeMap, local: LocalPoints, pose: Array) -> Mask:
    """(M,) which points are seen from a pose (7,) from a side and a distance as from their keyframes."""
    owner, row = np.unique(local.keyframe_idx, return_inverse=True)
    centers = rigid3.center(np.array([keyframes.keyframes[k].rig_from_world for k in owner]).reshape(-1, 7))
    aside, far, near = sight_change(local.xyz, centers[row], rigid3.center(pose))
    share = near / np.maximum(far, 1e-300)
    is_seen: Mask = (
        (aside > math.cos(math.radians(_MAX_ASIDE_DEG))) & (share > _DISTANCE_SHARES[0]) & (share < _DISTANCE_SHARES[1])
    )
    return is_seen


def sight_change(xyz: Array, before: Array, now: Array) -> tuple[Array, Array, Array]:
    """(N,) cosines between the rays to points (N, 3) from centres before and now, (N, 3) or (3,), and the distances."""
    back, forth = before - xyz, now - xyz
    far, near = np.linalg.norm(back, axis=1), np.linalg.norm(forth, axis=1)
    return (back * forth).sum(1) / np.maximum(far * near, 1e-300), far, near


def twist(rotation: Array, other: Array) -> Array:
    """(...) angle in radians, from x to y, by which the content of an image is turned about its axis against that of
    others: of cam_from_world rotations (3, 3) and (..., 3, 3), the part about z."""
    relative = rotation @ np.swapaxes(other, -1, -2)
    return np.arctan2(relative[..., 1, 0] - relative[..., 0, 1], relative[..., 0, 0] + relative[..., 1, 1])


def roll_step(roll: float) -> float:
    """A roll to the nearest tenth of a turn's sixth (6 degrees): finer steps make no difference to a descriptor, and
    what was described once can be used again."""
    step = math.pi / 30.0
    return round(roll / step) * step


@numba.njit(cache=True, nogil=True)
def _nearest_within(
    expected: Array, scale_idx: Ids, descriptors: Bytes, xy: Array, described: Bytes, radius: float, corner: Ids,
    product: Ids,
) -> None:  # fmt: skip
    """For every point the corner within a radius with the largest product, beyond the bound that product holds.

    Args:
        expected: (M, 2) pixels, NaN for none. scale_idx: (M,) which of the descriptors of the corners to look at.
        descriptors: (M, 128). xy: (N, 2). described: (S, N, 128).
        corner, product: (M,) replaced where there is one.
    """
    for m in range(expected.shape[0]):
        if math.isnan(expected[m, 0]):
            continue
        for n in range(xy.shape[0]):
            dx, dy = xy[n, 0] - expected[m, 0], xy[n, 1] - expected[m, 1]
            if dx * dx + dy * dy <= radius * radius:
                total = np.int64(0)
                for k in range(128):
                    total += np.int64(descriptors[m, k]) * np.int64(described[scale_idx[m], n, k])
                if total > product[m]:
                    corner[m], product[m] = n, total


def compile_kernels() -> None:
    """Run every kernel of places and relocalisation once, so that numba compiles or loads them now."""
    from sfmapp.odometry.loops import place_recognition

    place_recognition.compile_kernels()
    ids = np.zeros(1, np.int64)
    row = np.zeros((1, 128), np.uint8)
    _nearest_within(np.zeros((1, 2)), ids, row, np.zeros((1, 2)), row[None], 1.0, ids.copy(), ids.copy())
