"""How far an estimated trajectory is from the true one: absolute, relative and KITTI's errors.

Definitions, with their sources:

- *association*: each pose of the trajectory that has fewer of them is paired with the nearest in time of the other
  (Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012).
- *absolute error* (ATE): after an alignment over all pairs, the distance of positions and the angle of
  ``R_ground_truth^T R_estimate``. The alignment is Umeyama's closed form (PAMI 1991) over the positions; ``se3`` keeps
  the scale at one (Zhang and Scaramuzza, "A tutorial on quantitative trajectory evaluation", IROS 2018).
- *relative error* (RPE): length and angle of ``(Q_i^-1 Q_j)^-1 (P_i^-1 P_j)`` for true poses Q and estimated ones P a
  given number of frames, seconds or metres apart (Sturm et al.). No alignment is involved, but a scale may be.
- *drift* (t_rel, r_rel): the relative error over stretches of 100, 200, ..., 800 m of the true path that begin at every
  tenth frame, divided by their length, mean over all stretches (Geiger et al., "Are we ready for autonomous driving?",
  CVPR 2012, and the development kit of the odometry benchmark).

Positions are those of the body (camera) in the world. Lengths are in the unit of the ground truth, taken to be metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.errors import InputError, UsageError
from sfmapp.evaluation.report import Statistics
from sfmapp.geometry import rigid3, similarity

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Alignment = Literal["se3", "sim3", "origin", "none"]
DeltaUnit = Literal["frames", "s", "m"]

ALIGNMENTS: tuple[Alignment, ...] = get_args(Alignment)
MAX_DIFFERENCE_S = 0.01
"""Poses further apart in time than this are no pair: half a period at 50 Hz."""
KITTI_LENGTHS_M = tuple(range(100, 900, 100))
KITTI_STEP = 10
PATH_SHARES = tuple(k / 10 for k in range(1, 9))
"""Stretches, as shares of the path, where it is too short for KITTI's."""
DELTA_TOLERANCE = 0.1
"""Pairs whose distance in seconds or metres is off by more than this share of it do not count as that far apart."""

# A similarity has seven numbers, and lays any two positions on any other two: of fewer pairs no error is one.
MIN_PAIRS = 3
# A step between neighbours longer than this many median steps is a gap: one lost frame at a regular rate, with room
# for a jittering clock, is none yet.
_GAP_STEPS = 2.5


@dataclass(frozen=True)
class Trajectory:
    """Poses of a body over time.

    Attributes:
        position: (N, 3) of the body in the world, NaN where there is no pose.
        rotation: (N, 3, 3) world_from_body. Matrices of few digits are taken as they are, not made orthonormal.
        timestamps_s: (N,) seconds; None: poses are known by their number alone.
    """

    position: Array
    rotation: Array
    timestamps_s: Array | None = None

    @classmethod
    def from_cam_from_world(cls, cam_from_world: ArrayLike, timestamps_s: ArrayLike | None = None) -> Trajectory:
        """Of poses (N, 7) cam_from_world, NaN in gaps."""
        poses = rigid3.inverse(cam_from_world).reshape(-1, 7)
        times = None if timestamps_s is None else np.asarray(timestamps_s, np.float64)
        return cls(poses[:, 4:], rigid3.rotation_matrix(poses), times)

    def __len__(self) -> int:
        return len(self.position)

    def __getitem__(self, index: Indices | NDArray[np.bool_] | slice) -> Trajectory:
        times = None if self.timestamps_s is None else self.timestamps_s[index]
        return Trajectory(self.position[index], self.rotation[index], times)

    @property
    def has_pose(self) -> NDArray[np.bool_]:
        """(N,) bool: no gap."""
        return np.asarray(np.isfinite(self.position).all(1) & np.isfinite(self.rotation).all((1, 2)), np.bool_)

    @property
    def world_from_body(self) -> Array:
        """(N, 7) poses, NaN where there is none."""
        poses = np.full((len(self), 7), np.nan)
        kept = self.has_pose
        poses[kept] = rigid3.from_matrix(self.rotation[kept], self.position[kept])
        return poses

    @property
    def distance_m(self) -> Array:
        """(N,) length of the path from the first pose to each; no pose may be missing."""
        steps = np.linalg.norm(np.diff(self.position, axis=0), axis=1)
        return np.concatenate([np.zeros(min(1, len(self))), np.cumsum(steps)])

    @property
    def path_m(self) -> float:
        """Length of the whole path."""
        return float(self.distance_m[-1]) if len(self) else 0.0


@dataclass(frozen=True)
class Pairs:
    """An estimate and the ground truth at the same P moments, in the order of time.

    Attributes:
        estimate, ground_truth: P poses each.
        estimate_idx, ground_truth_idx: (P,) their positions in the whole trajectories.
        num_estimate, num_ground_truth: poses of the whole trajectories, gaps left out.
        coverage: share, 0 to 1, of the ground truth's duration over which there is an estimate (see :func:`associate`).
        is_gap: (P,) bool: much time (or a number) has passed since the pose before.
    """

    estimate: Trajectory
    ground_truth: Trajectory
    estimate_idx: Indices
    ground_truth_idx: Indices
    num_estimate: int
    num_ground_truth: int
    coverage: float
    is_gap: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.estimate_idx)

    @property
    def clock(self) -> Array:
        """(P,) seconds of the ground truth, or numbers of frames where there are no timestamps."""
        times = self.ground_truth.timestamps_s
        return times if times is not None else self.ground_truth_idx.astype(np.float64)


@dataclass(frozen=True)
class AbsoluteError:
    """Errors at P moments after an alignment.

    Attributes:
        ground_truth_from_estimate: (8,) similarity that was applied.
        translation_m: (P,). rotation_deg: (P,) degrees, 0 to 180.
        aligned: the estimate in the world of the ground truth.
    """

    ground_truth_from_estimate: Array
    translation_m: Array
    rotation_deg: Array
    aligned: Trajectory

    @property
    def scale(self) -> float:
        return float(self.ground_truth_from_estimate[7])


@dataclass(frozen=True)
class RelativeError:
    """Errors of Q relative motions.

    Attributes:
        delta, unit: how far apart the poses of a motion are.
        first, last: (Q,) positions in the pairs.
        translation_m: (Q,). rotation_deg: (Q,) degrees, 0 to 180.
    """

    delta: float
    unit: DeltaUnit
    first: Indices
    last: Indices
    translation_m: Array
    rotation_deg: Array


@dataclass(frozen=True)
class Drift:
    """Relative errors over S stretches of the path, by their length.

    Attributes:
        lengths_m: that were asked for; those longer than the path have no stretch.
        first, last: (S,) positions in the pairs.
        length_m: (S,) one of ``lengths_m`` each.
        translation: (S,) error divided by the length. rotation_deg_per_m: (S,).
    """

    lengths_m: tuple[float, ...]
    first: Indices
    last: Indices
    length_m: Array
    translation: Array
    rotation_deg_per_m: Array

    @property
    def t_rel_percent(self) -> float:
        """Mean translational drift in percent; NaN without a stretch."""
        return float(100 * self.translation.mean()) if len(self.first) else float("nan")

    @property
    def r_rel_deg_per_m(self) -> float:
        """Mean rotational drift; NaN without a stretch."""
        return float(self.rotation_deg_per_m.mean()) if len(self.first) else float("nan")


def statistics(values: ArrayLike) -> Statistics | None:
    """Rmse, mean, median, standard deviation, least and largest of errors (N,); None without any."""
    errors = np.asarray(values, np.float64)
    if not len(errors):
        return None
    return Statistics(
        rmse=float(np.sqrt((errors**2).mean())),
        mean=float(errors.mean()),
        median=float(np.median(errors)),
        std=float(errors.std()),
        min=float(errors.min()),
        max=float(errors.max()),
    )


# ---------------------------------------------------------------------------------------------------------- association


def associate(
    estimate: Trajectory, ground_truth: Trajectory, *, max_difference_s: float = MAX_DIFFERENCE_S, offset_s: float = 0.0
) -> Pairs:
    """Poses of the same moments.

    Every pose of the trajectory with fewer poses (of the estimate, if they have as many) is paired with the nearest in
    time of the other, the earlier of two equally near, if that is within ``max_difference_s``. One pose of the other
    may serve twice. Both are put in the order of time first. Without timestamps in either, equal numbers are pairs.

    Coverage counts the time between neighbouring paired poses, unless it is a gap (2.5 median steps and more), which
    counts as one step, and half a step at each end; divided by the duration of the ground truth. Without timestamps it
    is the share of the true poses that have an estimate.

    Raises:
        InputError: no pair, or only one of the two has timestamps, or neither has and their lengths differ.
    """
    with_pose = np.flatnonzero(estimate.has_pose), np.flatnonzero(ground_truth.has_pose)
    if estimate.timestamps_s is None or ground_truth.timestamps_s is None:
        idx = _same_numbers(estimate, ground_truth)
        coverage = len(idx) / max(len(with_pose[1]), 1)
        is_gap = np.diff(idx, prepend=idx[:1]) > 1
        return Pairs(estimate[idx], ground_truth[idx], idx, idx, len(with_pose[0]), len(with_pose[1]), coverage, is_gap)
    times = estimate.timestamps_s + offset_s, ground_truth.timestamps_s
    ours, theirs = (idx[np.argsort(t[idx], kind="stable")] for idx, t in zip(with_pose, times, strict=True))
    t_ours, t_theirs = times[0][ours], times[1][theirs]
    if len(theirs) < len(ours):
        near, is_pair = _nearest(t_theirs, t_ours, max_difference_s)
        a, b = ours[near[is_pair]], theirs[is_pair]
    else:
        near, is_pair = _nearest(t_ours, t_theirs, max_difference_s)
        a, b = ours[is_pair], theirs[near[is_pair]]
    if not len(a):
        raise _no_pair(t_ours, t_theirs, max_difference_s)
    step = np.diff(times[0][a], prepend=times[0][a[0]])
    median = float(np.median(step[1:])) if len(a) > 1 else 0.0
    is_gap = step > _GAP_STEPS * median
    covered = np.where(is_gap, median, step).sum()
    covered += min(median / 2, max(times[0][a[0]] - t_theirs[0], 0)) + min(
        median / 2, max(t_theirs[-1] - times[0][a[-1]], 0)
    )
    duration = float(np.ptp(t_theirs))
    coverage = min(float(covered) / duration, 1.0) if duration > 0 else 1.0
    return Pairs(estimate[a], ground_truth[b], a, b, len(ours), len(theirs), coverage, is_gap)


def _same_numbers(estimate: Trajectory, ground_truth: Trajectory) -> Indices:
    if (estimate.timestamps_s is None) != (ground_truth.timestamps_s is None):
        which = "estimate" if estimate.timestamps_s is None else "ground_truth"
        raise InputError(f"the {which} has no timestamps, the other has", "give them, one a line: --times FILE")
    if len(estimate) != len(ground_truth):
        raise InputError(
            "expected as many poses in the estimate as in the ground truth, for without timestamps line i belongs to "
            "line i; "
            f"found {len(estimate)} and {len(ground_truth)}",
            "use trajectories with timestamps (TUM), or give those of the ground truth with --times FILE",
        )
    idx = np.flatnonzero(estimate.has_pose & ground_truth.has_pose)
    if not len(idx):
        raise InputError("no line has a pose in both trajectories")
    return idx


def _nearest(few: Array, many: Array, max_difference_s: float) -> tuple[Indices, NDArray[np.bool_]]:
    """For each of ascending times (K,) the nearest of ascending times (M,), the earlier of two; and if it is near."""
    if not len(many):
        return np.zeros(len(few), np.int64), np.zeros(len(few), bool)
    after = np.clip(np.searchsorted(many, few), 0, len(many) - 1)
    before = np.maximum(after - 1, 0)
    near = np.where(np.abs(few - many[before]) <= np.abs(many[after] - few), before, after)
    # the first of equal times: the order of the file decides, not the search
    near = np.searchsorted(many, many[near])
    return near, np.abs(few - many[near]) <= max_difference_s


def _no_pair(ours: Array, theirs: Array, max_difference_s: float) -> InputError:
    span = [f"{t[0]:.3f} to {t[-1]:.3f} s" if len(t) else "no pose at all" for t in (ours, theirs)]
    advice = "--offset SECONDS shifts the estimate, --max-diff SECONDS widens the search"
    if len(ours) and len(theirs) and (ours[0] > 1e3 * abs(theirs[-1]) or theirs[0] > 1e3 * abs(ours[-1])):
        advice = "one of them seems to count in another unit or from another start; " + advice
    return InputError(
        f"no pose of the estimate ({span[0]}) is within {max_difference_s:g} s of one of the ground truth ({span[1]})",
        advice,
    )


# ------------------------------------------------------------------------------------------------------------ alignment


def align(pairs: Pairs, how: Alignment) -> Array:
    """``ground_truth_from_estimate`` (8,) over all pairs.

    Positions on a straight line leave the rotation about it open; there the orientations close it. With ``origin`` the
    first pose of the estimate is laid on that of the ground truth.

    Raises:
        InputError: fewer than two pairs, or the positions are all in one place.
    """
    return similarity.from_parts(*_alignment(pairs, how))


def _alignment(pairs: Pairs, how: Alignment) -> tuple[Array, Array, float]:
    """Rotation (3, 3), translation (3,) and scale of :func:`align`."""
    x_a, x_b = pairs.estimate.position, pairs.ground_truth.position
    if how == "none":
        return np.eye(3), np.zeros(3), 1.0
    if how == "origin":
        rotation = pairs.ground_truth.rotation[0] @ pairs.estimate.rotation[0].T
        return rotation, x_b[0] - rotation @ x_a[0], 1.0
    try:
        try:
            fit = similarity.umeyama(x_a, x_b)
        except ValueError:
            fit = similarity.align_poses(_cam_from_world(pairs.estimate), _cam_from_world(pairs.ground_truth)).b_from_a
    except ValueError as error:
        raise InputError(f"{len(pairs)} pairs do not determine an alignment: {error}", "--align origin") from None
    rotation = rigid3.rotation_matrix(fit)
    if how == "sim3":
        return rotation, fit[4:7], float(fit[7])
    return rotation, x_b.mean(0) - rotation @ x_a.mean(0), 1.0  # the best rotation does not depend on the scale


def is_straight(pairs: Pairs) -> bool:
    """The positions lie on a line within the errors of an alignment, so the turn about it is not theirs to tell."""
    try:
        fit = similarity.align_poses(_cam_from_world(pairs.estimate), _cam_from_world(pairs.ground_truth))
    except ValueError:
        return True
    return fit.is_twist_from_orientations


def _cam_from_world(trajectory: Trajectory) -> Array:
    return rigid3.inverse(rigid3.from_matrix(trajectory.rotation, trajectory.position))


# --------------------------------------------------------------------------------------------------------------- errors


def absolute_error(pairs: Pairs, how: Alignment = "se3") -> AbsoluteError:
    """Distance and angle between the aligned estimate and the ground truth at each pair.

    Raises:
        InputError: the alignment is not determined (see :func:`align`).
    """
    rotation, translation, scale = _alignment(pairs, how)
    aligned = Trajectory(
        scale * pairs.estimate.position @ rotation.T + translation,
        rotation @ pairs.estimate.rotation,
        pairs.estimate.timestamps_s,
    )
    return AbsoluteError(
        similarity.from_parts(rotation, translation, scale),
        np.linalg.norm(aligned.position - pairs.ground_truth.position, axis=1),
        _angle_deg(pairs.ground_truth.rotation.swapaxes(-1, -2) @ aligned.rotation),
        aligned,
    )


def relative_error(
    pairs: Pairs,
    delta: float = 1.0,
    unit: DeltaUnit = "frames",
    *,
    scale: float = 1.0,
    is_overlapping: bool = False,
    is_by_estimate: bool = False,
) -> RelativeError:
    """Errors of the motions between poses that are ``delta`` apart.

    Args:
        delta, unit: in frames (pairs), seconds or metres of path.
        scale: factor on the estimate's positions, that of a similarity alignment.
        is_overlapping: a motion begins at every pose; else where the one before has ended. In metres and in seconds the
            pose nearest to the asked distance ends a motion, and those off by more than a tenth do not count; but
            motions in metres that do not overlap end at the first pose that is at least as far.
        is_by_estimate: metres are measured along the estimate, not along the ground truth.

    Raises:
        UsageError: ``delta`` is not positive, or not whole in frames, or in seconds where there are none.
        InputError: no two poses are that far apart.
    """
    if not (np.isfinite(delta) and delta > 0) or (unit == "frames" and delta % 1):
        raise UsageError(f"expected a positive {'whole ' if unit == 'frames' else ''}delta, found {delta:g} {unit}")
    if unit == "s":
        if pairs.ground_truth.timestamps_s is None:
            raise UsageError("a delta in seconds needs timestamps", "--times FILE, or a delta in frames (1f)")
        first, last = _apart_in_time(pairs.ground_truth.timestamps_s, delta, is_overlapping)
    elif unit == "m":
        way = pairs.estimate.distance_m * scale if is_by_estimate else pairs.ground_truth.distance_m
        first, last = _apart_along(way, delta, is_overlapping)
    else:
        first = np.arange(0, max(len(pairs) - int(delta), 0), 1 if is_overlapping else int(delta), dtype=np.int64)
        last = first + int(delta)
    if not len(first):
        raise InputError(
            f"no two of {len(pairs)} poses over {pairs.ground_truth.path_m:.3g} m are {delta:g} {unit} apart",
            "give a smaller delta",
        )
    return RelativeError(delta, unit, first, last, *_motion_errors(pairs, first, last, scale))


def kitti_drift(
    pairs: Pairs,
    *,
    scale: float = 1.0,
    lengths_m: tuple[float, ...] = KITTI_LENGTHS_M,
    step: int = KITTI_STEP,
) -> Drift:
    """KITTI's errors over stretches of the true path; they may be none.

    A stretch begins at every ``step``-th pair and ends at the first one that is more than its length away along the
    true path. Errors are divided by the nominal length, as in the development kit: a gap at the end of a stretch makes
    it look worse, not better.

    Args:
        scale: factor on the estimate's positions, that of a similarity alignment.
        lengths_m: of the stretches; those of the benchmark are 100, 200, ..., 800.
        step: pairs between the beginnings.
    """
    way = pairs.ground_truth.distance_m
    begin = np.repeat(np.arange(0, len(pairs), step, dtype=np.int64), len(lengths_m))
    length = np.tile(np.asarray(lengths_m, np.float64), len(begin) // max(len(lengths_m), 1))
    end = np.searchsorted(way, way[begin] + length, side="right")
    kept = end < len(pairs)
    first, last, length = begin[kept], end[kept], length[kept]
    translation, rotation = _motion_errors(pairs, first, last, scale)
    return Drift(tuple(lengths_m), first, last, length, translation / length, rotation / length)


def path_shares_m(pairs: Pairs) -> tuple[float, ...]:
    """Lengths for :func:`kitti_drift` where the path is shorter than 100 m: 10, 20, ..., 80 % of it."""
    return tuple(share * pairs.ground_truth.path_m for share in PATH_SHARES)


def _motion_errors(pairs: Pairs, first: Indices, last: Indices, scale: float) -> tuple[Array, Array]:
    """Length and angle (Q,) of the true motion's inverse times the estimated motion."""

    def motion(trajectory: Trajectory, factor: float) -> tuple[Array, Array]:
        back = trajectory.rotation[first].swapaxes(-1, -2)
        step = factor * (trajectory.position[last] - trajectory.position[first])
        return back @ trajectory.rotation[last], np.einsum("nij,nj->ni", back, step)

    (rotation, step), (true_rotation, true_step) = motion(pairs.estimate, scale), motion(pairs.ground_truth, 1.0)
    # a rotation before it does not change the length of a vector, but matrices of few digits are no exact rotations
    back = true_rotation.swapaxes(-1, -2)
    return np.linalg.norm(np.einsum("nij,nj->ni", back, step - true_step), axis=1), _angle_deg(back @ rotation)


def _angle_deg(matrix: Array) -> Array:
    """Angles (N,) in degrees of the rotations nearest to matrices (N, 3, 3): rounding must not look like a turn."""
    u, _, vt = np.linalg.svd(matrix)
    return rigid3.rotation_angle_deg(u @ vt)


def _apart_in_time(times: Array, delta_s: float, is_overlapping: bool) -> tuple[Indices, Indices]:
    near, is_near = _nearest(times + delta_s, times, DELTA_TOLERANCE * delta_s)
    is_near &= near > np.arange(len(times))
    return _chained(np.where(is_near, near, -1), is_overlapping)


def _apart_along(way: Array, delta_m: float, is_overlapping: bool) -> tuple[Indices, Indices]:
    if is_overlapping:
        near, is_near = _nearest(way + delta_m, way, DELTA_TOLERANCE * delta_m)
        return _chained(np.where(is_near & (near > np.arange(len(way))), near, -1), True)
    ends, walked = [0], 0.0
    for idx, step in enumerate(np.diff(way).tolist(), 1):
        walked += step
        if walked >= delta_m:
            ends.append(idx)
            walked = 0.0
    return np.array(ends[:-1], np.int64), np.array(ends[1:], np.int64)


def _chained(last: Indices, is_overlapping: bool) -> tuple[Indices, Indices]:
    """Motions from the end (or -1) of the one that begins at each pose: all, or each where the one before has ended."""
    if is_overlapping:
        first = np.flatnonzero(last >= 0)
        return first, last[first]
    chosen, idx = [], 0
    while idx < len(last):
        if last[idx] >= 0:
            chosen.append(idx)
        idx = int(last[idx]) if last[idx] >= 0 else idx + 1
    first = np.array(chosen, np.int64)
    return first, last[first]
