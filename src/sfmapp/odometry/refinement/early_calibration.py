"""Questioning the calibration while a map still grows, so that live poses need not wait for the end.

A question takes as long as several frames. It is asked of a copy in a thread beside the tracking, and answered at the
first keyframe after a fixed number of frames; what the map has gained until then is brought along.
"""

from __future__ import annotations

from bisect import bisect_right
from concurrent.futures import Executor, Future
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3, similarity
from sfmapp.mapping.structure import residual_scale_px
from sfmapp.odometry.map.backend import Job, choose_window, classify, make_job, run_job, take_over
from sfmapp.odometry.map.local_map import LocalMap
from sfmapp.odometry.refinement.calibration_check import adjust_poses, question_calibration
from sfmapp.odometry.refinement.final_adjustment import MIN_SIGMA_PX, rig_of

Array = NDArray[np.float64]

# Keyframes at which a map is questioned until its calibration has been refined: early ones for the live poses, later
# ones for motions that tell little. A first look at a calibration that is right costs one adjustment.
_AT = (8, 12, 18, 27, 40, 60)
_STEPS, _TOLERANCE = 8, 1e-4
# Frames after which an answer counts: what it took on KITTI 00 (0.25 s for 27 keyframes), at 30 frames a second.
_LAG = 10


@dataclass(frozen=True)
class _Question:
    """A map that is asked, when it is to answer (frames processed by then), and its job; None for no other cameras."""

    local: LocalMap
    due: int
    answer: Future[Job | None]


class EarlyCalibration:
    """Asks the maps of a run about its calibration, until one of them has refined it.

    Attributes:
        is_open: it has not been refined, and may be.

    Args:
        executor: where maps are asked; None: in the thread that calls.
    """

    def __init__(self, is_open: bool, executor: Executor | None) -> None:
        self.is_open = is_open
        self._executor = executor
        self._num_asked: dict[int, int] = {}
        self._question: _Question | None = None

    @property
    def is_asking(self) -> bool:
        """Whether a map has not answered yet: it may gain keyframes, and must not lose any."""
        return self._question is not None

    def forget(self) -> None:
        """The maps have changed so much that what one of them would answer does not fit any more."""
        self._question = None

    def refines(self, local: LocalMap, frame_number: int) -> bool:
        """Ask a map that has a new keyframe, if it is time to, or hear what it has to say; returns whether it goes on
        with a refined calibration.

        The map is then adjusted to it, in place; what else is under way is over. Otherwise nothing has changed.

        Args:
            frame_number: frames processed so far.
        """
        question, is_refined = self._question, False
        if question is not None and question.local is not local:
            question = self._question = None
        if question is not None and frame_number >= question.due:
            job, self._question = question.answer.result(), None
            if job is not None:
                _go_on_with(job, local)
                is_refined = True
                self.is_open = False
        num_due = bisect_right(_AT, local.newest + 1)
        if self.is_open and self._question is None and num_due > self._num_asked.get(local.map_idx, 0):
            self._num_asked[local.map_idx] = num_due
            self._ask(local, frame_number)
        return is_refined

    def _ask(self, local: LocalMap, frame_number: int) -> None:
        everything = np.arange(len(local.keyframes.keyframes))
        job = make_job(local.keyframes, everything, everything > 0)
        answer: Future[Job | None] = Future()
        if self._executor is not None:
            answer = self._executor.submit(_refined, job)
        else:
            answer.set_result(_refined(job))
        self._question = _Question(local, frame_number + _LAG, answer)


def _refined(job: Job) -> Job | None:
    """The job of a whole map with refined cameras; None where they stay as they are."""
    sigma = residual_scale_px(job.model, MIN_SIGMA_PX)
    cost = adjust_poses(job.model, sigma, _STEPS, _TOLERANCE)
    answer = question_calibration(job.model, cost, sigma, may_refine=True)
    if not answer.is_refined:
        return None
    job.model = answer.model
    classify(job.model, job.num_elsewhere)
    return job


def _go_on_with(job: Job, local: LocalMap) -> None:
    """Put refined cameras and what was adjusted to them into a map, in place. What it has gained since keeps its place
    relative to the last keyframe that took part, in that one's unit of length, until a window fits it to the cameras.
    """
    keyframes, model = local.keyframes, job.model
    local.backend.finish(keyframes)
    last = len(job.keyframe_idx) - 1
    before = keyframes.keyframes[last]
    old, new = before.rig_from_world.copy(), model.cam_from_world[last * len(model.cameras)]
    place = np.full(keyframes.num_points, -1, np.int64)
    place[job.point_id] = np.arange(len(job.point_id))
    seen = before.point_id[place[before.point_id] >= 0]
    depths = [rigid3.apply(old, keyframes.point_xyz[seen])[:, 2], rigid3.apply(new, model.point_xyz[place[seen]])[:, 2]]
    scale = float(np.nanmedian(depths[1] / depths[0]))
    turn = rigid3.rotation_matrix(rigid3.inverse(new)) @ rigid3.rotation_matrix(old)
    moved = similarity.from_parts(turn, rigid3.apply(rigid3.inverse(new), scale * old[4:]), scale)
    xyz = similarity.apply(moved, keyframes.point_xyz)
    for keyframe in keyframes.keyframes[last + 1 :]:
        keyframe.rig_from_world = similarity.transform_poses(moved, keyframe.rig_from_world)
    take_over(job, keyframes)
    lacking = np.isnan(keyframes.point_xyz[:, 0])
    keyframes.point_xyz[lacking] = xyz[lacking]
    keyframes.rig = local.rig = rig_of(model)
    take_over(run_job(make_job(keyframes, *choose_window(keyframes, local.options))), keyframes)
