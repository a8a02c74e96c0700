"""Bending a map so that its loops close: the pose graph, and what moves with it.

The essential graph of ORB-SLAM (Mur-Artal et al., IEEE T-RO 2015, section VII-C): every keyframe is tied to the one
before it and to those that share most points with it, by their relative pose as it is; loops tie the rest. With one
camera each keyframe has a scale of its own, as scale drifts like everything else (Strasdat et al., RSS 2010). gtsam
solves it, over world_from_keyframe, and over similarities that way: what gtsam writes ``s (R x + t)`` is a group in
which ``between`` and the order of the tangent (rotation, translation, log of the scale) are what one would expect.

The weights are those that n shared points at a depth d give: radians and translations over d are equally sure, and the
scale less so, by the depth over the baseline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.map.keyframe_map import KeyframeMap

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

# ORB-SLAM's least number of shared points of an edge, and how many edges each keyframe gets beyond the one before it:
# to near ones, and as many to those further back, where earlier loops were closed.
_MIN_SHARED, _NUM_EDGES, _NEAR = 15, 4, 20
# One direction to one shared point: a pixel at a focal length of a thousand. A common factor on all weights but for the
# damping.
_RAY_SIGMA = 1e-3
# Least baseline over depth that the scale of an edge is believed to come from: points have a degree of parallax.
_MIN_BASELINE = 0.02

# Points of a keyframe that its depth is the median of.
_DEPTH_SAMPLE = 64


@dataclass(frozen=True)
class GraphEdges:
    """Ties between keyframes (E).

    Attributes:
        pair: (E, 2) int64 positions i < j.
        num_shared: (E,) points that hold it. depth: (E,) their median depth. baseline: (E,) between the two centres.
    """

    pair: Ids
    num_shared: Ids
    depth: Array
    baseline: Array


@dataclass(frozen=True)
class LoopEdge:
    """A tie between a keyframe and one long before it: ``old_from_new`` (8,) takes the world around the new keyframe to
    where the old one says it is. num_shared: points that hold it."""

    old_idx: int
    new_idx: int
    old_from_new: Array
    num_shared: int


def essential_edges(keyframes: KeyframeMap) -> GraphEdges:
    """The ties of a map as it is."""
    num = len(keyframes.keyframes)
    counts = count_shared(keyframes)
    pairs = [(j - 1, j) for j in range(1, num)]
    for j in range(2, num):
        near, far = counts[j, : j - 1].copy(), counts[j, : j - 1].copy()
        near[: max(0, j - _NEAR)] = 0
        far[max(0, j - _NEAR) :] = 0
        for part in (near, far):
            best = np.argsort(-part, kind="stable")[:_NUM_EDGES]
            pairs += [(int(i), j) for i in best if part[i] >= _MIN_SHARED]
    pair = np.array(pairs, np.int64).reshape(-1, 2)
    depths = keyframe_depths(keyframes)
    centers = rigid3.center(np.array([k.rig_from_world for k in keyframes.keyframes]).reshape(-1, 7))
    return GraphEdges(
        pair, counts[pair[:, 0], pair[:, 1]], depths[pair[:, 1]],
        np.linalg.norm(centers[pair[:, 0]] - centers[pair[:, 1]], axis=1),
    )  # fmt: skip


def keyframe_depths(keyframes: KeyframeMap) -> Array:
    """(K,) median depth of the points of each keyframe; of keyframes without points that of the others, or one."""
    poses = np.array([k.rig_from_world for k in keyframes.keyframes]).reshape(-1, 7)
    # a sample is enough for a measure of length, and there may be a thousand keyframes
    seen_ids = [k.point_id[:: 1 + len(k.point_id) // _DEPTH_SAMPLE] for k in keyframes.keyframes]
    ids = np.concatenate(seen_ids or [np.zeros(0, np.int64)])
    owner = np.repeat(np.arange(len(poses)), [len(i) for i in seen_ids])
    axis, offset = rigid3.rotation_matrix(poses)[:, 2], poses[:, 6]
    z = np.einsum("ni,ni->n", axis[owner], keyframes.point_xyz[ids]) + offset[owner]
    seen = z > 0  # False for NaN
    z, owner = z[seen], owner[seen]
    order = np.lexsort((z, owner))
    num = np.bincount(owner, minlength=len(poses))
    middle = np.cumsum(num) - num + num // 2
    depths = np.full(len(poses), np.nan)
    depths[num > 0] = z[order][middle[num > 0]]
    return np.where(num > 0, depths, np.nanmedian(depths) if len(z) else 1.0)


def count_shared(keyframes: KeyframeMap) -> Ids:
    """(K, K) int64 triangulated points that each two keyframes share."""
    ids = np.concatenate([k.point_id for k in keyframes.keyframes] or [np.zeros(0, np.int64)])
    owner = np.repeat(np.arange(len(keyframes.keyframes)), [len(k.point_id) for k in keyframes.keyframes])
    known = keyframes.is_triangulated(ids)
    ids, owner = ids[known], owner[known]
    order = np.argsort(ids, kind="stable")
    counts = np.zeros((len(keyframes.keyframes),) * 2, np.int64)
    _count_shared(ids[order], owner[order], counts)
    return counts


@numba.njit(cache=True, nogil=True)
def _count_shared(ids: Ids, owner: Ids, counts: Ids) -> None:
    """Add one to counts (K, K) for each two owners of the same id; ids (N,) are sorted."""
    start = 0
    for n in range(1, len(ids) + 1):
        if n == len(ids) or ids[n] != ids[start]:
            for a in range(start, n):
                for b in range(start, n):
                    counts[owner[a], owner[b]] += 1
            start = n


def optimize_pose_graph(
    rig_from_world: Array, edges: GraphEdges, loops: Sequence[LoopEdge], fix_scale: bool, num_fixed: int = 1
) -> Array:
    """Where the keyframes belong once the loops count.

    Args:
        rig_from_world: (K, 7) as they are.
        edges: their ties. loops: the new ties.
        fix_scale: all keyframes keep the unit of length: the rig is stereo.
        num_fixed: the first so many keyframes stay.

    Returns:
        (K, 8) for each keyframe the similarity that takes the world around it to the corrected world.
    """
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    world_from_rig = [_node(pose, fix_scale) for pose in rigid3.inverse(rig_from_world)]
    for k, node in enumerate(world_from_rig):
        values.insert(k, node)
    size = 6 if fix_scale else 7
    between = gtsam.BetweenFactorPose3 if fix_scale else gtsam.BetweenFactorSimilarity3
    equal = gtsam.NonlinearEqualityPose3 if fix_scale else gtsam.NonlinearEqualitySimilarity3
    for k in range(num_fixed):
        graph.add(equal(k, world_from_rig[k]))
    rows = zip(edges.pair, edges.num_shared, edges.depth, edges.baseline, strict=True)
    for (i, j), count, depth, baseline in rows:
        relative = world_from_rig[i].between(world_from_rig[j])
        graph.add(between(int(i), int(j), relative, _noise(count, depth, baseline, size)))
    depths = np.ones(len(rig_from_world))
    depths[edges.pair[:, 1]] = edges.depth
    for loop in loops:
        moved = _node(loop.old_from_new, fix_scale).compose(world_from_rig[loop.new_idx])
        relative = world_from_rig[loop.old_idx].between(moved)
        # both sides see the same points, each with the baselines of its own track
        noise = _noise(loop.num_shared, float(depths[loop.new_idx]), float(depths[loop.new_idx]), size)
        graph.add(between(loop.old_idx, loop.new_idx, relative, noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(50)
    parameters.setRelativeErrorTol(1e-6)
    # small blocks in a graph that loops have tied up: at 394 keyframes a seventh of what multifrontal takes (0.91 s)
    parameters.setLinearSolverType("SEQUENTIAL_CHOLESKY")
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    corrections = np.empty((len(world_from_rig), 8))
    for k, node in enumerate(world_from_rig):
        moved = result.atPose3(k) if fix_scale else result.atSimilarity3(k)
        corrections[k] = _similarity(moved.compose(node.inverse()))
    return corrections


def _node(b_from_a: Array, fix_scale: bool) -> Any:
    """gtsam's form of a pose (7,) or a similarity (8,); a scale is dropped if it is fixed."""
    import gtsam

    x, y, z, w = b_from_a[:4]
    rotation = gtsam.Rot3.Quaternion(w, x, y, z)
    if fix_scale:
        return gtsam.Pose3(rotation, b_from_a[4:7])
    scale = b_from_a[7] if len(b_from_a) == 8 else 1.0
    return gtsam.Similarity3(rotation, b_from_a[4:7] / scale, scale)


def _similarity(node: Any) -> Array:
    """(8,) of a gtsam.Pose3 or gtsam.Similarity3."""
    scale = node.scale() if hasattr(node, "scale") else 1.0
    return similarity.from_parts(node.rotation().matrix(), scale * np.asarray(node.translation()), scale)


def _noise(num_shared: int, depth: float, baseline: float, size: int) -> Any:
    import gtsam

    sigma = _RAY_SIGMA / np.sqrt(max(num_shared, 1))
    parallax = min(max(baseline / depth, _MIN_BASELINE), 1.0)
    sigmas = np.array([sigma] * 3 + [sigma * depth] * 3 + [sigma / parallax])
    return gtsam.noiseModel.Diagonal.Sigmas(sigmas[:size])


def apply_corrections(keyframes: KeyframeMap, corrections: Array) -> None:
    """Move keyframes and points, in place; a point moves with the first keyframe that sees it.

    Args:
        corrections: (K, 8) as of :func:`optimize_pose_graph`.
    """
    reference = np.full(keyframes.num_points, -1, np.int64)
    for k in range(len(keyframes.keyframes) - 1, -1, -1):
        reference[keyframes.keyframes[k].point_id] = k
    owned = np.flatnonzero((reference >= 0) & np.isfinite(keyframes.point_xyz[: keyframes.num_points, 0]))
    mine = corrections[reference[owned]]
    rotated = np.einsum("nij,nj->ni", rigid3.rotation_matrix(mine), keyframes.point_xyz[owned])
    keyframes.point_xyz[owned] = mine[:, 7:] * rotated + mine[:, 4:7]
    for keyframe, correction in zip(keyframes.keyframes, corrections, strict=True):
        keyframe.rig_from_world = similarity.transform_poses(correction, keyframe.rig_from_world)


def compile_kernels() -> None:
    """Run the kernel once, so that numba compiles or loads it now."""
    ids = np.zeros(1, np.int64)
    _count_shared(ids, ids, np.zeros((1, 1), np.int64))
