"""Loops: a keyframe that shows a place seen long before, and the similarity that takes its world to the older one.

A false loop bends the whole map, so a loop has to be seen several times. The first keyframe finds it by what it looks
like (:mod:`sfmapp.odometry.loops.relocalize`); the ones that follow must find themselves where the first says they are,
with as many points and as little that contradicts; and one similarity, fitted to all of them and to their points as the
old keyframes saw them, must explain them all. What it corrects must be something that the way between could have lost,
and what is seen there must be there alone (:mod:`sfmapp.odometry.loops.rivals`): a loop that only leads to what the
map has elsewhere as well waits for a keyframe that sees something else. The same search between two maps joins them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.loops.gaps import log_ratio_of_seam, way_of
from sfmapp.odometry.loops.place_recognition import Candidate, Ids, PlaceIndex, View
from sfmapp.odometry.loops.pose_graph import keyframe_depths
from sfmapp.odometry.loops.relocalize import (
    LocalPoints,
    Located,
    RelocalizeOptions,
    is_convincing,
    is_elsewhere,
    local_points,
    locate,
    locate_near,
    position_of,
    shared_points,
    twist,
)
from sfmapp.odometry.loops.repetition import Repetition
from sfmapp.odometry.loops.rivals import LoopEvidence, are_seen_apart
from sfmapp.odometry.map.keyframe_map import KeyframeMap

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_MAX_STEPS = 20


@dataclass(frozen=True)
class LoopOptions:
    """When a loop is believed."""

    min_gap: int = 10  # keyframes just before one that are no loop
    min_shared: int = 15  # keyframes that share so many points are neighbours, no loop (ORB-SLAM)
    min_views: int = 3  # keyframes in which a loop must be seen
    max_views: int = 12  # keyframes after which a loop that still may be a look-alike is given up
    min_agreement: float = 0.6  # least mean over the views of the share of points in view that agree
    max_misses: int = 1  # keyframes in between that may fail to see it
    max_drift: float = 0.15  # stereo: longest correction, share of the way between
    max_drift_mono: float = 0.5  # the same where the scale drifts as well
    max_rotation_deg: float = 30.0  # largest correction of the orientation
    max_stereo_scale: float = 1.15  # stereo: depths of the same points on both sides must agree to this factor
    relocalize: RelocalizeOptions = field(default_factory=RelocalizeOptions)  # what each view of a loop must satisfy


@dataclass(frozen=True)
class LoopView:
    """A keyframe in which a loop was seen.

    Attributes:
        new_idx, old_idx: positions of the keyframe and of the old one that it was held against.
        old: (M) old points. new_id: (M,) the points of the keyframe that they are. xy: (M, 2) pixels there.
        located: how the keyframe lies in the old world by itself.
    """

    new_idx: int
    old_idx: int
    old: LocalPoints
    new_id: Ids
    xy: Array
    located: Located


@dataclass(frozen=True)
class LoopClosure:
    """A loop within a map, or between two.

    Attributes:
        new_map, old_map: numbers of the maps.
        old_from_new: (8,) similarity that takes the world around the new keyframes to the old one; scale 1 in stereo.
        views: the keyframes that saw it, in order.
        point_pairs: (M, 2) ids of the same points: new, old; no id occurs twice in a column.
        num_inliers: points that agree with old_from_new in each view. rms_px: their residuals.
        shift, rotation_deg, scale: what it corrects at the newest keyframe; shift over the median depth there.
    """

    new_map: int
    old_map: int
    old_from_new: Array
    views: tuple[LoopView, ...]
    point_pairs: Ids
    num_inliers: tuple[int, ...]
    rms_px: float
    shift: float
    rotation_deg: float
    scale: float


@dataclass
class _Suspicion:
    """A loop that was seen, but not often enough yet.

    Attributes:
        evidence: what landmarks say of it; None where it has been judged already.
    """

    old_map: int
    old_from_new: Array
    views: list[LoopView] = field(default_factory=list)
    num_misses: int = 0
    evidence: LoopEvidence | None = None

    @property
    def is_contradicted(self) -> bool:
        """Too much is missing where it leads."""
        return self.evidence is not None and self.evidence.is_contradicted

    def is_certain(self, keyframes: KeyframeMap, old_map: KeyframeMap, repetition: Repetition) -> bool:
        """It does not lead to the like of its place."""
        if self.evidence is None:
            return True
        view = self.views[-1]
        if old_map is keyframes:
            return self.evidence.is_certain_by_drift(self.shift(keyframes) / keyframe_depths(keyframes)[view.new_idx])
        ways, depth = (way_of(old_map), way_of(keyframes, self.old_from_new)), keyframe_depths(old_map)[view.old_idx]
        by_maps = repetition.log_ratio((old_map, keyframes), old_map.keyframes[view.old_idx].frame_idx)
        return self.evidence.is_certain_by_way(log_ratio_of_seam(*ways, float(depth)), by_maps)

    def shift(self, keyframes: KeyframeMap) -> float:
        """By how much it moves the newest keyframe that saw it."""
        center = rigid3.center(keyframes.keyframes[self.views[-1].new_idx].rig_from_world)
        return float(np.linalg.norm(similarity.apply(self.old_from_new, center) - center))


class LoopFinder:
    """Looks for loops at every keyframe. What it finds depends on the order of the calls alone.

    Attributes:
        num_open: loops that were seen often enough and may lead to the like of their place.
        repetition: what was found of the likes of places in their own maps.
    """

    def __init__(self, options: LoopOptions = LoopOptions()) -> None:
        self.options, self.num_open, self.repetition = options, 0, Repetition()
        self._suspicion: _Suspicion | None = None

    @property
    def is_suspicious(self) -> bool:
        """A loop was seen and waits for more keyframes to see it: show every one, those that are no place as well."""
        return self._suspicion is not None

    def reset(self) -> None:
        """Forget what is suspected: the map has changed under it, or another has begun."""
        self._suspicion = None

    def suspect(self, old_map: int, old_from_new: Array) -> None:
        """Have the keyframes that follow looked for where a similarity (8,) puts them in another map."""
        self._suspicion = _Suspicion(old_map, old_from_new)

    def find(
        self, maps: Mapping[int, KeyframeMap], map_idx: int, places: PlaceIndex, frame_idx: int, view: View,
        barred: int | None = None,
    ) -> LoopClosure | None:  # fmt: skip
        """Look whether a new keyframe closes a loop of its map, or shows a place of another map.

        Args:
            maps: by their numbers.
            map_idx, frame_idx: the keyframe, which ``places`` knows; while a loop is suspected any keyframe.
            view: as ``places.add`` returned it, or its image, points and their ids.
            barred: a map that is looked into only where :meth:`suspect` has said so.

        Returns:
            A loop once it is certain. The maps are only read.
        """
        keyframes = maps[map_idx]
        new_idx = position_of(keyframes, frame_idx)
        if self._suspicion is not None:
            return self._confirm(maps, map_idx, places, new_idx, view)
        neighbors = self._neighbors(keyframes, new_idx)
        others = {k.frame_idx for k in keyframes.keyframes if k.frame_idx in places}.difference(neighbors)
        self.repetition.ask(frame_idx, len(others))
        candidates = places.query(frame_idx, neighbors)
        candidates += places.query(frame_idx, other_maps=True)
        found: list[_Suspicion] = []
        for candidate in candidates:
            if candidate.map_idx in maps and candidate.map_idx != barred:
                suspicion = self._sight(maps, map_idx, places, new_idx, view, candidate)
                found += [] if suspicion is None else [suspicion]
        # of places that look alike the one where most is found and least is missing
        self._suspicion = max(found, key=lambda s: s.evidence.weight if s.evidence else 0.0, default=None)
        return None

    def _sight(
        self, maps: Mapping[int, KeyframeMap], map_idx: int, places: PlaceIndex, new_idx: int, view: View,
        candidate: Candidate,
    ) -> _Suspicion | None:  # fmt: skip
        """Look for a keyframe at a place that it looks like."""
        options, keyframes, old_map = self.options, maps[map_idx], maps[candidate.map_idx]
        old_idx = position_of(old_map, candidate.frame_idx)
        roll = 0.0
        if old_map is keyframes:  # orientations drift slowly: the map knows how the image is turned
            pair = np.array([keyframes.keyframes[k].rig_from_world for k in (new_idx, old_idx)])
            roll = float(twist(*rigid3.rotation_matrix(pair)))
        located = locate(old_map, places, view, candidate, options.relocalize, roll)
        if located is None or not is_convincing(located, view, options.relocalize):
            return None
        if old_map is keyframes:
            self._note_like(keyframes, new_idx, old_idx, located.cam_from_world)
        seen = seen_in(old_map, places, view, (new_idx, old_idx), located, options.relocalize)
        start = initial_similarity(keyframes, seen, options)
        if start is None:
            return None
        suspicion = _Suspicion(candidate.map_idx, start, [seen])
        if not self._fits(maps, map_idx, suspicion):
            return None
        within = suspicion.old_from_new if old_map is keyframes else None
        suspicion.evidence = LoopEvidence(old_map, places, within, options.relocalize)
        suspicion.evidence.look(view, old_idx, located.cam_from_world)
        return None if suspicion.is_contradicted else suspicion

    def _confirm(
        self, maps: Mapping[int, KeyframeMap], map_idx: int, places: PlaceIndex, new_idx: int, view: View
    ) -> LoopClosure | None:
        """Look for the keyframe where a suspected loop says that it is."""
        suspicion = self._suspicion
        assert suspicion is not None
        keyframes, old_map = maps[map_idx], maps.get(suspicion.old_map)
        seen = None
        if old_map is not None:
            pose = similarity.transform_poses(suspicion.old_from_new, keyframes.keyframes[new_idx].rig_from_world)
            last_old = max(0, suspicion.views[0].new_idx - self.options.min_gap) if old_map is keyframes else None
            old_idx = nearest_place(old_map, places, pose, last_old)
            if old_idx is not None:
                seen = self._seen_near(old_map, places, view, new_idx, old_idx, pose)
        if seen is not None:
            trial = _Suspicion(
                suspicion.old_map, suspicion.old_from_new, [*suspicion.views, seen], evidence=suspicion.evidence
            )
            if self._fits(maps, map_idx, trial):
                if old_map is keyframes:
                    self._note_like(keyframes, new_idx, seen.old_idx, seen.located.cam_from_world)
                if trial.evidence is not None:
                    trial.evidence.look(view, seen.old_idx, seen.located.cam_from_world)
                return self._judge(maps, map_idx, trial)
        suspicion.num_misses += 1
        if suspicion.num_misses > self.options.max_misses:
            self._suspicion = None
        return None

    def _judge(self, maps: Mapping[int, KeyframeMap], map_idx: int, trial: _Suspicion) -> LoopClosure | None:
        """Believe a loop that another keyframe has seen, drop it, or wait for the next keyframe."""
        options, num = self.options, len(trial.views)
        self._suspicion = None if trial.is_contradicted else trial
        if self._suspicion is None or num < options.min_views:
            return None
        agrees = bool(np.mean([v.located.agreement for v in trial.views]) >= options.min_agreement)
        is_certain = agrees and trial.is_certain(maps[map_idx], maps[trial.old_map], self.repetition)
        if num == options.min_views:
            self.num_open += agrees and not is_certain
        else:  # it has been open
            self.num_open -= is_certain
        if is_certain or not agrees or num >= options.max_views:
            self._suspicion = None
        return self._closure(maps, map_idx, trial) if is_certain else None

    def _seen_near(
        self, old_map: KeyframeMap, places: PlaceIndex, view: View, new_idx: int, old_idx: int, pose: Array
    ) -> LoopView | None:
        options, camera = self.options.relocalize, old_map.rig.cameras[0]
        local = local_points(old_map, places, old_map.keyframes[old_idx].frame_idx, options.num_neighbors)
        located = locate_near(local, view, camera, pose, options)
        if located is None or not is_convincing(located, view, options):
            return None
        return seen_in(old_map, places, view, (new_idx, old_idx), located, options)

    def _note_like(self, keyframes: KeyframeMap, new_idx: int, old_idx: int, pose: Array) -> None:
        """A keyframe fits its map at an old one, where a pose (7,) puts it."""
        keyframe, depth = keyframes.keyframes[new_idx], float(keyframe_depths(keyframes)[new_idx])
        if is_elsewhere(keyframe.rig_from_world, pose, depth):
            self.repetition.note_like(keyframe.frame_idx, keyframes.keyframes[old_idx].frame_idx)

    def _neighbors(self, keyframes: KeyframeMap, new_idx: int) -> list[int]:
        """Frames that are no loop with a keyframe: those just before it and those that see the same points."""
        shared = shared_points(keyframes, new_idx)
        first = new_idx - self.options.min_gap
        return [
            k.frame_idx for n, k in enumerate(keyframes.keyframes) if n >= first or shared[n] >= self.options.min_shared
        ]

    def _fits(self, maps: Mapping[int, KeyframeMap], map_idx: int, suspicion: _Suspicion) -> bool:
        """Fit one similarity to all views; whether all of them agree with it, and it with the way between."""
        options, keyframes, old_map = self.options, maps[map_idx], maps[suspicion.old_map]
        system = _LoopSystem(keyframes, old_map, suspicion.views)
        limit = options.relocalize.error_px(keyframes.rig.cameras[0])
        suspicion.old_from_new = system.refine(suspicion.old_from_new, 0.5 * limit, keyframes.rig.is_stereo)
        counts = system.count_inliers(suspicion.old_from_new, limit)
        # where half of the points have never been lost the two sides are tied already
        is_known = float((system.new_id == system.old_id).mean())
        if min(counts) < options.relocalize.min_inliers or is_known > 0.5:
            return False
        if old_map is not keyframes:
            return True
        # descriptors were looked for as far as four inlier thresholds away
        return _could_have_drifted(keyframes, suspicion, options) and not are_seen_apart(
            keyframes, system.new_id, system.old_id, 4.0 * limit
        )

    def _closure(self, maps: Mapping[int, KeyframeMap], map_idx: int, suspicion: _Suspicion) -> LoopClosure:
        keyframes, old_map = maps[map_idx], maps[suspicion.old_map]
        self.repetition.forgive(keyframes.keyframes[v.new_idx].frame_idx for v in suspicion.views)
        system = _LoopSystem(keyframes, old_map, suspicion.views)
        limit = self.options.relocalize.error_px(keyframes.rig.cameras[0])
        error = np.linalg.norm(system.forward(suspicion.old_from_new), axis=1)
        good = error < limit
        return LoopClosure(
            map_idx, suspicion.old_map, suspicion.old_from_new, tuple(suspicion.views),
            _agreed_pairs(system.new_id[good], system.old_id[good]),
            tuple(system.count_inliers(suspicion.old_from_new, limit)), float(np.sqrt((error[good] ** 2).mean())),
            float(suspicion.shift(keyframes) / keyframe_depths(keyframes)[suspicion.views[-1].new_idx]),
            float(rigid3.rotation_angle_deg(rigid3.rotation_matrix(suspicion.old_from_new))),
            float(suspicion.old_from_new[7]),
        )  # fmt: skip


def nearest_place(keyframes: KeyframeMap, places: PlaceIndex, pose: Array, last: int | None) -> int | None:
    """The keyframe before a last one that is a place and looks from nearest in nearly the same direction: distance over
    its depth, plus radians between the axes."""
    known = np.array([n for n, k in enumerate(keyframes.keyframes[:last]) if k.frame_idx in places], np.int64)
    if not len(known):
        return None
    poses = np.array([keyframes.keyframes[n].rig_from_world for n in known])
    distance = np.linalg.norm(rigid3.center(poses) - rigid3.center(pose), axis=1) / keyframe_depths(keyframes)[known]
    axis = rigid3.rotation_matrix(poses)[:, 2] @ rigid3.rotation_matrix(pose)[2]
    return int(known[np.argmin(distance + np.arccos(np.clip(axis, -1.0, 1.0)))])


def seen_in(
    old_map: KeyframeMap, places: PlaceIndex, view: View, pair: tuple[int, int], located: Located,
    options: RelocalizeOptions,
) -> LoopView:  # fmt: skip
    """A located keyframe as one view of a loop; pair: positions of the new and of the old keyframe."""
    local = local_points(old_map, places, old_map.keyframes[pair[1]].frame_idx, options.num_neighbors)
    old = local.subset(np.searchsorted(local.point_id, located.point_id))
    return LoopView(*pair, old, view.point_id[located.corner_idx], view.xy[located.corner_idx], located)


def initial_similarity(keyframes: KeyframeMap, view: LoopView, options: LoopOptions) -> Array | None:
    """From the pose of the new keyframe in the old world; the scale is the ratio of its points' depths on both sides.

    None where too few points have a depth on both sides or, in stereo, where these contradict.
    """
    pose = keyframes.keyframes[view.new_idx].rig_from_world
    new_depth = rigid3.apply(pose, keyframes.point_xyz[np.maximum(view.new_id, 0)])[:, 2]
    old_depth = rigid3.apply(view.located.cam_from_world, view.old.xyz)[:, 2]
    known = (view.new_id >= 0) & (new_depth > 0) & (old_depth > 0)  # False for NaN
    if known.sum() < 6:
        return None
    scale = float(np.median(old_depth[known] / new_depth[known]))
    if keyframes.rig.is_stereo:
        if abs(math.log(scale)) > math.log(options.max_stereo_scale):
            return None
        scale = 1.0
    zoom = np.append(rigid3.IDENTITY, scale)
    world_from_camera = np.append(rigid3.inverse(view.located.cam_from_world), 1.0)
    return similarity.compose(world_from_camera, similarity.compose(zoom, np.append(pose, 1.0)))


def _could_have_drifted(keyframes: KeyframeMap, suspicion: _Suspicion, options: LoopOptions) -> bool:
    """Whether the way between the two sides is long enough to have lost what the loop corrects.

    Half the depth of the scene is free: so much a map can be off after a blackout, however short the way.
    """
    view = suspicion.views[-1]
    centers = rigid3.center(np.array([k.rig_from_world for k in keyframes.keyframes]))
    way = float(np.linalg.norm(np.diff(centers[view.old_idx : view.new_idx + 1], axis=0), axis=1).sum())
    share = options.max_drift if keyframes.rig.is_stereo else options.max_drift_mono
    free = 0.5 * float(keyframe_depths(keyframes)[view.new_idx])
    shift = suspicion.shift(keyframes)
    angle = rigid3.rotation_angle_deg(rigid3.rotation_matrix(suspicion.old_from_new))
    return bool(shift <= share * way + free and angle <= options.max_rotation_deg)


def _agreed_pairs(new_id: Ids, old_id: Ids) -> Ids:
    """(M, 2) pairs of ids; where views contradict, the pair that most of them saw, and no id twice."""
    known = new_id >= 0
    pairs, votes = np.unique(np.stack([new_id[known], old_id[known]], 1), axis=0, return_counts=True)
    pairs, votes = pairs[pairs[:, 0] != pairs[:, 1]], votes[pairs[:, 0] != pairs[:, 1]]
    for column in (0, 1):
        order = np.lexsort((pairs[:, 1 - column], -votes, pairs[:, column]))
        first = np.unique(pairs[order, column], return_index=True)[1]
        pairs, votes = pairs[order[first]], votes[order[first]]
    ordered: Ids = pairs[np.argsort(pairs[:, 0], kind="stable")]
    return ordered


class _LoopSystem:
    """Residuals of all views of a loop against one similarity: old points in the new keyframes, and new points in the
    old ones."""

    def __init__(self, keyframes: KeyframeMap, old_map: KeyframeMap, views: list[LoopView]) -> None:
        camera: Camera = keyframes.rig.cameras[0]
        self.focal = camera.focal
        self.old_id = np.concatenate([v.old.point_id for v in views])
        self.new_id = np.concatenate([v.new_id for v in views])
        self.view = np.repeat(np.arange(len(views)), [len(v.new_id) for v in views])
        self.old_xyz = old_map.point_xyz[self.old_id]
        new_poses = np.array([keyframes.keyframes[v.new_idx].rig_from_world for v in views])
        self.new_pose = new_poses[self.view]
        self.new_xy = pixels_to_normalized(camera, np.concatenate([v.xy for v in views]))
        new_xyz = keyframes.point_xyz[np.maximum(self.new_id, 0)]
        self.known = (self.new_id >= 0) & np.isfinite(new_xyz[:, 0])
        self.new_xyz = new_xyz[self.known]
        old_keyframe = np.concatenate([v.old.keyframe_idx for v in views])[self.known]
        self.old_pose = np.array([k.rig_from_world for k in old_map.keyframes])[old_keyframe]
        self.old_xy = pixels_to_normalized(camera, np.concatenate([v.old.xy for v in views])[self.known])

    def forward(self, old_from_new: Array) -> Array:
        """(M, 2) pixels by which the old points miss where the new keyframes saw them."""
        return self._residuals(
            self.new_pose, similarity.apply(similarity.inverse(old_from_new), self.old_xyz), self.new_xy
        )

    def backward(self, old_from_new: Array) -> Array:
        """(B, 2) pixels by which the new points, as far as they are known, miss where the old keyframes saw them."""
        return self._residuals(self.old_pose, similarity.apply(old_from_new, self.new_xyz), self.old_xy)

    def _residuals(self, pose: Array, xyz: Array, xy: Array) -> Array:
        in_camera = rigid3.apply(pose, xyz)
        depth = np.where(in_camera[:, 2:] > 0, in_camera[:, 2:], np.nan)
        # behind the camera or beyond the lens: as far off as a right angle
        return np.nan_to_num(self.focal * (in_camera[:, :2] / depth - xy), nan=self.focal)

    def count_inliers(self, old_from_new: Array, limit_px: float) -> list[int]:
        """For each view, how many of its old points are where it saw them."""
        good = np.linalg.norm(self.forward(old_from_new), axis=1) < limit_px
        return [int(n) for n in np.bincount(self.view, good, self.view[-1] + 1)]

    def refine(self, start: Array, scale_px: float, fix_scale: bool) -> Array:
        """Minimise the Cauchy loss of both kinds of residuals over seven parameters, or six: damped Gauss-Newton with
        derivatives by differences."""
        size = 6 if fix_scale else 7
        center = np.nanmean(self.old_xyz, 0)
        spread = float(np.nanmean(np.linalg.norm(self.old_xyz - center, axis=1)))

        def moved(sim: Array, step: Array) -> Array:
            full = np.append(step, np.zeros(7 - size))
            turn = similarity.from_parts(rigid3.exp_so3(full[:3]), spread * full[3:6], math.exp(full[6]))
            around = np.array([0.0, 0.0, 0.0, 1.0, *center, 1.0])
            return similarity.compose(
                around, similarity.compose(turn, similarity.compose(similarity.inverse(around), sim))
            )

        def residuals(sim: Array) -> Array:
            return np.concatenate([self.forward(sim), self.backward(sim)])

        def cost(r: Array) -> float:
            return float(np.log1p((r**2).sum(1) / scale_px**2).sum())

        state, r, damping, h = start, residuals(start), 1e-4, 1e-6
        for _ in range(_MAX_STEPS):
            weight = 1.0 / (1.0 + (r**2).sum(1, keepdims=True) / scale_px**2)
            columns = [
                (residuals(moved(state, h * e)) - residuals(moved(state, -h * e))) / (2 * h) for e in np.eye(size)
            ]
            jacobian = np.stack([c.ravel() for c in columns], 1)
            weighted = jacobian * np.repeat(weight.ravel(), 2)[:, None]
            normal, gradient = weighted.T @ jacobian, weighted.T @ r.ravel()
            step = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), -gradient)
            trial = moved(state, step)
            trial_r = residuals(trial)
            if cost(trial_r) < cost(r):
                done = cost(r) - cost(trial_r) < 1e-6 * cost(r)
                state, r, damping = trial, trial_r, damping * 0.1
                if done:
                    break
            else:
                damping *= 10.0
        return state
