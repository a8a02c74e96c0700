"""Local adjustment beside the tracking: begun at a keyframe, taken over a fixed number of frames later.

The frame at which a result is taken over depends on nothing but the sequence, so a run gives the same bytes however
fast the machine is: where the adjustment is late, tracking waits.
"""

from __future__ import annotations

import time
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.geometry.noise import sigma_of_lengths
from sfmapp.mapping.structure import residual_scale_px
from sfmapp.odometry.inertial.window import Turn, turn_factor
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.options import OdometryOptions
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Frames between a keyframe and the moment at which its adjustment counts.
LAG = 2
# Residuals beyond so many robust standard deviations are outliers, within these bounds in pixels.
_OUTLIER_SIGMAS, _OUTLIER_RANGE_PX = 4.0, (1.0, 4.0)
# Where the loss begins to bend, in sigmas: Cauchy's 95 % efficiency, and no less than this.
_LOSS_SIGMAS, _MIN_LOSS_PX = 2.0, 0.1
# Errors of patches have so much in common that they weigh as if they were larger: up to twice what residuals show
# (:mod:`sfmapp.odometry.map.covariance`). Counts where a sensor is weighed against them.
_SHARED = 2.0
# Local steps: a window starts close to its minimum, and the next keyframe adjusts it again.
_WINDOW_STEPS = 6


@dataclass
class Job:
    """An adjustment under way, over a copy of a part of the map.

    Attributes:
        keyframe_idx: (K,) keyframes that take part. is_variable: (K,) those that may move.
        point_id: (P,) ids of the model's points. num_elsewhere: (P,) their observations by other keyframes.
        turns: what a gyroscope says of neighbouring keyframes, by their positions in the map.
    """

    keyframe_idx: NDArray[np.int64]
    is_variable: Mask
    model: Reconstruction
    point_id: NDArray[np.int64]
    num_elsewhere: NDArray[np.int64]
    turns: list[Turn] = field(default_factory=list)
    cpu_s: float = 0.0


def choose_window(
    keyframes: KeyframeMap, options: OdometryOptions, newest: int | None = None
) -> tuple[NDArray[np.int64], Mask]:
    """A keyframe and those just before it, and the others that share the most points with them as unmoved anchors.

    Args:
        newest: the last keyframe of the window; None for the newest there is.

    Returns:
        (K,) ascending keyframe positions, (K,) which of them may move. The first keyframe never moves, nor do those of
        a map that was there before.
    """
    all_keyframes = keyframes.keyframes
    newest = len(all_keyframes) - 1 if newest is None else newest
    first = max(keyframes.num_known, newest - options.window + 1)
    seen = np.zeros(keyframes.num_points, bool)
    for keyframe in all_keyframes[first : newest + 1]:
        seen[keyframe.point_id] = True
    seen &= np.isfinite(keyframes.point_xyz[: keyframes.num_points, 0])
    owner = np.repeat(np.arange(len(all_keyframes)), [len(k.point_id) for k in all_keyframes])
    shared = np.bincount(owner[seen[np.concatenate([k.point_id for k in all_keyframes])]], minlength=len(all_keyframes))
    shared[first : newest + 1] = 0
    best = np.argsort(-shared, kind="stable")[: options.window_anchors]
    chosen = np.sort(np.concatenate([best[shared[best] > 0], np.arange(first, newest + 1)]))
    return chosen, (chosen >= first) & (chosen <= newest) & (chosen > 0)


def make_job(keyframes: KeyframeMap, keyframe_idx: NDArray[np.int64], is_variable: Mask) -> Job:
    """Copy what an adjustment needs, so that it may run in another thread."""
    model, point_id = keyframes.reconstruction(keyframe_idx)
    here = np.bincount(model.tracks.obs_track_idx, minlength=len(point_id))
    return Job(keyframe_idx, is_variable, model, point_id, keyframes.num_observations(point_id) - here)


def run_job(job: Job) -> Job:
    """Adjust, then decide afresh which observations agree; points with fewer than two of them are given up."""
    start = time.thread_time()
    model = job.model
    num_sensors = len(model.image_names) // max(1, len(job.keyframe_idx))
    sigma = residual_scale_px(model, _MIN_LOSS_PX / _LOSS_SIGMAS)
    options = AdjustOptions(
        loss="cauchy", loss_scale_px=_LOSS_SIGMAS * sigma,
        max_iterations=_WINDOW_STEPS, relative_cost_tolerance=1e-4, refine_focal=False, refine_distortion=False,
    )  # fmt: skip
    varying = Varying(images=np.repeat(job.is_variable, num_sensors))
    if job.turns:
        graph = FactorGraph(model, options, varying=varying, noise_px=_SHARED * sigma)
        _add_turns(graph, job, num_sensors)
        graph.optimize()
    else:
        adjust_bundle(model, options, varying=varying)
    classify(model, job.num_elsewhere)
    job.cpu_s = time.thread_time() - start
    return job


def _add_turns(graph: FactorGraph, job: Job, num_sensors: int) -> None:
    """Add what a gyroscope says of keyframes that take part, unless neither may move."""
    from gtsam.symbol_shorthand import X

    place = {int(k): n for n, k in enumerate(job.keyframe_idx)}
    for turn in job.turns:
        first, second = place.get(turn.first, -1), place.get(turn.second, -1)
        if min(first, second) >= 0 and job.is_variable[[first, second]].any():
            graph.add(turn_factor(X(first * num_sensors), X(second * num_sensors), turn), "gyroscope")


def classify(model: Reconstruction, num_elsewhere: NDArray[np.int64]) -> float:
    """Mark the observations that agree with the model and drop points without support; returns sigma in pixels."""
    error = model.errors_px()
    used = error[model.obs_is_inlier & np.isfinite(error)]
    sigma = sigma_of_lengths(used) if len(used) else 1.0
    limit = float(np.clip(_OUTLIER_SIGMAS * sigma, *_OUTLIER_RANGE_PX))
    model.obs_is_inlier = error < limit  # False for NaN
    support = np.bincount(model.tracks.obs_track_idx, model.obs_is_inlier, model.tracks.num_tracks)
    weak = support + num_elsewhere < 2
    model.point_xyz[weak] = np.nan
    model.obs_is_inlier &= ~weak[model.tracks.obs_track_idx]
    return sigma


def take_over(job: Job, keyframes: KeyframeMap) -> None:
    """Put the result of a job into the map. What was added meanwhile stays as it is."""
    num_sensors = len(keyframes.rig.cameras)
    model, tracks = job.model, job.model.tracks
    moved = np.flatnonzero(job.is_variable)
    for k, pose in zip(job.keyframe_idx[moved], model.cam_from_world[moved * num_sensors], strict=True):
        keyframes.keyframes[k].rig_from_world = pose.copy()
    keyframes.point_xyz[job.point_id] = model.point_xyz
    for n, k in enumerate(job.keyframe_idx):
        keyframe = keyframes.keyframes[k]
        for s in range(num_sensors):
            obs = tracks.observations_of_image(n * num_sensors + s)
            keyframe.is_inlier[tracks.obs_feature_idx[obs], s] = model.obs_is_inlier[obs]


class Backend:
    """At most one adjustment at a time, in a thread beside the tracking, or in its own where there is no executor."""

    def __init__(self, executor: Executor | None) -> None:
        self._executor = executor
        self._future: Future[Job] | None = None
        self._due = 0
        self.cpu_s = 0.0
        self.num_jobs = 0

    def begin(self, job: Job, frame_number: int) -> None:
        """Start a job. The last one must have been taken over."""
        assert self._future is None
        self._due = frame_number + LAG
        if self._executor is not None:
            self._future = self._executor.submit(run_job, job)
        else:
            self._future = Future()
            self._future.set_result(run_job(job))
        self.num_jobs += 1

    def finish(self, keyframes: KeyframeMap, frame_number: int | None = None) -> bool:
        """Take over what is due at a frame, or whatever is under way without one; returns whether the map changed."""
        if self._future is None or (frame_number is not None and frame_number < self._due):
            return False
        job = self._future.result()
        self._future = None
        take_over(job, keyframes)
        self.cpu_s += job.cpu_s
        return True
