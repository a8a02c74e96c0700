"""Questioning calibration and shutter while a map still grows, so that live poses need not wait for the end.

A rolling shutter comes first: it bends a map as a wrong lens does, and was taken for one.

A question takes as long as several frames. It is asked of a copy in a thread beside the tracking, and answered at the
first keyframe after a fixed number of frames; what the map has gained until then is brought along.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3, similarity
from sfmapp.mapping.structure import residual_scale_px
from sfmapp.odometry.live_shutter import LiveShutter
from sfmapp.odometry.map.backend import Job, choose_window, classify, make_job, run_job, take_over
from sfmapp.odometry.map.local_map import LocalMap
from sfmapp.odometry.refinement.calibration_check import adjust_poses, question_calibration
from sfmapp.odometry.refinement.final_adjustment import MIN_SIGMA_PX, rig_of
from sfmapp.odometry.shutter import Found

Array = NDArray[np.float64]

# Keyframes at which a map is questioned until its calibration has been refined: early ones for the live poses, later
# ones for motions that tell little. A first look at a calibration that is right costs one adjustment.
_AT = (8, 12, 18, 27, 40, 60)
# Of a rolling shutter, which moves points by pixels, fewer tell: these are asked for it alone.
_ROWS_AT = (4, 6)
_STEPS, _TOLERANCE = 8, 1e-4
# Frames after which an answer counts: what it took on KITTI 00 (0.25 s for 27 keyframes), at 30 frames a second.
_LAG = 10
# Why a map goes on otherwise than before.
_REFINED = "the images contradict the given calibration: going on with a refined one"
_STRAIGHT = "the images show a rolling shutter, which is taken off from now on"


class _Answer(NamedTuple):
    """What a map answers: a job of the whole of it, adjusted to other cameras or another readout, None for neither;
    whether its cameras are other ones; the readout found on top of the one before, and its evidence, zero for none."""

    job: Job | None
    is_refined: bool
    readout: float
    evidence: float


@dataclass(frozen=True)
class _Question:
    """A map that is asked, when it is to answer (frames processed by then), and its job; None for no other cameras."""

    local: LocalMap
    due: int
    answer: Future[_Answer]


class EarlyCalibration:
    """Asks the maps of a run about its calibration, until one of them has refined it, and about a rolling shutter.

    Attributes:
        is_open: it has not been refined, and may be.

    Args:
        shutter: what is known of the readout.
        executor: where maps are asked; None: in the thread that calls.
    """

    def __init__(self, is_open: bool, shutter: LiveShutter, executor: Executor | None) -> None:
        self.is_open, self._shutter = is_open, shutter
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

    def refines(self, local: LocalMap, frame_number: int) -> str:
        """Ask a map that has a new keyframe, if it is time to, or hear what it has to say; returns why it goes on with
        a refined calibration or without a rolling shutter, empty if it does not.

        The map is then adjusted to it, in place; what else is under way is over. Otherwise nothing has changed.

        Args:
            frame_number: frames processed so far.
        """
        question, reason = self._question, ""
        if question is not None and question.local is not local:
            question = self._question = None
        if question is not None and frame_number >= question.due:
            answer, self._question = question.answer.result(), None
            if answer.job is not None:
                _go_on_with(answer, local, self._shutter)
                self.is_open &= not answer.is_refined
                reason = _REFINED if answer.is_refined else _STRAIGHT
        num_due = bisect_right(_ROWS_AT + _AT, local.newest + 1)
        is_open = self._shutter.is_open or (self.is_open and num_due > len(_ROWS_AT))
        if is_open and self._question is None and num_due > self._num_asked.get(local.map_idx, 0):
            self._num_asked[local.map_idx] = num_due
            self._ask(local, frame_number)
        return reason

    def _ask(self, local: LocalMap, frame_number: int) -> None:
        everything = np.arange(len(local.keyframes.keyframes))
        may_refine = self.is_open and len(everything) >= _AT[0]
        job = make_job(local.keyframes, everything, everything > 0)
        asked = partial(_answered, job, self._shutter, self._shutter.question(local), may_refine)
        answer: Future[_Answer] = Future()
        if self._executor is not None:
            answer = self._executor.submit(asked)
        else:
            answer.set_result(asked())
        self._question = _Question(local, frame_number + _LAG, answer)


def _answered(job: Job, shutter: LiveShutter, ask_rows: Callable[[], Found] | None, may_refine: bool) -> _Answer:
    """What a map says of its readout, and, where it has nothing to say of that, of its cameras."""
    if ask_rows is not None:
        readout, evidence, straight = ask_rows()
        if straight is not None and shutter.is_worth_it(readout, evidence):
            classify(straight.model, straight.num_elsewhere)
            return _Answer(straight, False, readout, evidence)
    refined = _refined(job) if may_refine else None
    return _Answer(refined, refined is not None, 0.0, 0.0)


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


def _go_on_with(answer: _Answer, local: LocalMap, shutter: LiveShutter) -> None:
    """Put an answer that has a job, and what was adjusted to it, into a map, in place. What it has gained since keeps
    its place relative to the last keyframe that took part, in that one's unit of length, until a window fits it.
    """
    keyframes, job = local.keyframes, answer.job
    assert job is not None
    model = job.model
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
    if answer.readout:
        shutter.take(answer.readout, answer.evidence, local)
    take_over(run_job(make_job(keyframes, *choose_window(keyframes, local.options))), keyframes)
