"""Closing a loop, and joining two maps: moving them, making points that are the same one point, adjusting the seam."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import similarity
from sfmapp.odometry.loops.detection import LoopClosure
from sfmapp.odometry.loops.place_recognition import Ids, PlaceIndex
from sfmapp.odometry.loops.pose_graph import LoopEdge, apply_corrections, essential_edges, optimize_pose_graph
from sfmapp.odometry.map.backend import make_job, run_job, take_over
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap

Array = NDArray[np.float64]

# Keyframes on each side of a seam that may move in its adjustment, and others that hold them.
_SEAM, _ANCHORS = 10, 20


@dataclass(frozen=True)
class Closed:
    """What closing a loop changed: all keyframes and points of the map.

    Attributes:
        corrections: (K, 8) similarities by keyframe, old world to new, the adjustment of the seam left out. What hangs
            on a keyframe (frames between, the current pose) moves with ``similarity.transform_poses``.
        renamed: (M, 2) ids that are no more, and those that they have become.
    """

    corrections: Array
    renamed: Ids


@dataclass(frozen=True)
class Joined:
    """Two maps made one.

    Attributes:
        keyframes: the joined map, with the number, world and unit of the one that took the other in.
        kept_map, absorbed_map: numbers of the maps.
        kept_from_absorbed: (8,) similarity between their worlds.
        id_offset: to be added to the ids of points of the absorbed map.
        renamed: (M, 2) ids that are no more, counted after that, and those that they have become.
    """

    keyframes: KeyframeMap
    kept_map: int
    absorbed_map: int
    kept_from_absorbed: Array
    id_offset: int
    renamed: Ids


def apply_closure(keyframes: KeyframeMap, places: PlaceIndex, closure: LoopClosure) -> Closed:
    """Close a loop of a map, in place: a pose graph bends it, the points seen on both sides become one, and the
    keyframes at the seam are adjusted.

    Raises:
        ValueError: the loop is one between two maps.
    """
    if closure.new_map != closure.old_map:
        raise ValueError(f"the loop joins maps {closure.new_map} and {closure.old_map}: use join_maps")
    poses = np.array([k.rig_from_world for k in keyframes.keyframes])
    loops = [
        LoopEdge(v.old_idx, v.new_idx, closure.old_from_new, n)
        for v, n in zip(closure.views, closure.num_inliers, strict=True)
    ]
    corrections = optimize_pose_graph(
        poses, essential_edges(keyframes), loops, keyframes.rig.is_stereo, max(1, keyframes.num_known)
    )
    apply_corrections(keyframes, corrections)
    pairs = closure.point_pairs
    renamed = np.stack([pairs.max(1), pairs.min(1)], 1)
    fuse_points(keyframes, renamed)
    places.rename_points(closure.old_map, renamed[:, 0], renamed[:, 1])
    sides = [[v.new_idx for v in closure.views], [v.old_idx for v in closure.views]]
    adjust_seam(keyframes, renamed[:, 1], sides)
    return Closed(corrections, renamed)


def join_maps(maps: dict[int, KeyframeMap], places: PlaceIndex, closure: LoopClosure) -> Joined:
    """Bring the smaller of two maps into the larger, or into the one that was there before. ``maps`` is not changed;
    ``places`` is.

    Raises:
        ValueError: the loop lies within one map.
    """
    if closure.new_map == closure.old_map:
        raise ValueError(f"the loop lies within map {closure.old_map}: use apply_closure")
    old, new = maps[closure.old_map], maps[closure.new_map]
    keep_old = (old.num_known, len(old.keyframes)) >= (new.num_known, len(new.keyframes))
    kept_map, absorbed_map = (closure.old_map, closure.new_map) if keep_old else (closure.new_map, closure.old_map)
    kept, absorbed = maps[kept_map], maps[absorbed_map]
    kept_from_absorbed = closure.old_from_new if keep_old else similarity.inverse(closure.old_from_new)
    offset = kept.num_points
    joined = KeyframeMap(kept.rig)
    joined.new_points(offset + absorbed.num_points)
    joined.point_xyz[:offset] = kept.point_xyz[:offset]
    moved = similarity.apply(kept_from_absorbed, absorbed.point_xyz[: absorbed.num_points])
    joined.point_xyz[offset : offset + absorbed.num_points] = moved
    others = [_moved(k, kept_from_absorbed, offset) for k in absorbed.keyframes]
    joined.keyframes = sorted([*kept.keyframes, *others], key=lambda k: k.frame_idx)
    joined.hold_same_known(kept)
    kept_id, absorbed_id = closure.point_pairs.T[::-1] if keep_old else closure.point_pairs.T
    renamed = np.stack([absorbed_id + offset, kept_id], 1)
    fuse_points(joined, renamed)
    places.move_map(absorbed_map, kept_map, offset)
    places.rename_points(kept_map, renamed[:, 0], renamed[:, 1])
    position = {k.frame_idx: n for n, k in enumerate(joined.keyframes)}
    sides = [
        [position[new.keyframes[v.new_idx].frame_idx] for v in closure.views],
        [position[old.keyframes[v.old_idx].frame_idx] for v in closure.views],
    ]
    adjust_seam(joined, renamed[:, 1], sides)
    return Joined(joined, kept_map, absorbed_map, kept_from_absorbed, offset, renamed)


def _moved(keyframe: Keyframe, b_from_a: Array, id_offset: int) -> Keyframe:
    return Keyframe(
        keyframe.frame_idx, keyframe.timestamp_s, keyframe.name,
        similarity.transform_poses(b_from_a, keyframe.rig_from_world), keyframe.point_id + id_offset, keyframe.xy,
        keyframe.is_inlier, keyframe.row_shift,
    )  # fmt: skip


def fuse_points(keyframes: KeyframeMap, renamed: Ids) -> None:
    """Make pairs of points one, in place.

    Args:
        renamed: (M, 2) ids to give up, and the ids that they become; no id of the second column is in the first. Where
            a keyframe sees both, the observation of the second stays. A point without a position takes the other's.
    """
    xyz = keyframes.point_xyz
    become = np.arange(keyframes.num_points)
    become[renamed[:, 0]] = renamed[:, 1]
    lacking = np.isnan(xyz[renamed[:, 1], 0])
    xyz[renamed[lacking, 1]] = xyz[renamed[lacking, 0]]
    xyz[renamed[:, 0]] = np.nan
    for keyframe in keyframes.keyframes:
        ids = become[keyframe.point_id]
        is_new = ids != keyframe.point_id
        if not is_new.any():
            continue
        order = np.lexsort((is_new, ids))
        first = np.ones(len(order), bool)
        first[1:] = ids[order[1:]] != ids[order[:-1]]
        order = order[first]
        keyframe.point_id, keyframe.xy = ids[order], keyframe.xy[order]
        keyframe.is_inlier = keyframe.is_inlier[order]
        keyframe.row_shift = None if keyframe.row_shift is None else keyframe.row_shift[order]
        # the observations that made the pair have been checked against the other side
        keyframe.is_inlier[is_new[order]] = np.isfinite(keyframe.xy[is_new[order]][..., 0])
    keyframes.recount()


def adjust_seam(keyframes: KeyframeMap, fused: Ids, sides: list[list[int]]) -> None:
    """Adjust the keyframes at both sides of a seam with their points; those around hold them where they are.

    Args:
        fused: ids of the points seen from both sides. sides: positions of keyframes known to lie on each.
    """
    count = len(keyframes.keyframes)
    is_fused = np.zeros(keyframes.num_points, bool)
    is_fused[fused] = True
    seeing = np.array([np.count_nonzero(is_fused[k.point_id]) for k in keyframes.keyframes])
    nearest = np.stack([np.abs(np.arange(count)[:, None] - np.array(side)).min(1) for side in sides])
    variable = np.zeros(count, bool)
    for n in range(len(sides)):
        mine = np.flatnonzero(nearest[n] == nearest.min(0))
        order = np.lexsort((nearest[n][mine], -seeing[mine]))
        variable[mine[order[:_SEAM]]] = True
    variable[: max(1, keyframes.num_known)] = False
    seen = np.zeros(keyframes.num_points, bool)
    for k in np.flatnonzero(variable):
        seen[keyframes.keyframes[k].point_id] = True
    seen &= np.isfinite(keyframes.point_xyz[: keyframes.num_points, 0])
    shared = np.array([np.count_nonzero(seen[k.point_id]) for k in keyframes.keyframes])
    shared[variable] = 0
    anchors = np.argsort(-shared, kind="stable")[:_ANCHORS]
    chosen = variable.copy()
    chosen[anchors[shared[anchors] > 0]] = True
    keyframe_idx = np.flatnonzero(chosen)
    job = make_job(keyframes, keyframe_idx, variable[keyframe_idx])
    run_job(job)
    take_over(job, keyframes)
