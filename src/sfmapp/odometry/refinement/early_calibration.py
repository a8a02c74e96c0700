"""Questioning the calibration while a map still grows, so that live poses need not wait for the end."""

from __future__ import annotations

import numpy as np

from sfmapp.mapping.structure import residual_scale_px
from sfmapp.odometry.map.backend import classify, make_job, take_over
from sfmapp.odometry.map.local_map import LocalMap
from sfmapp.odometry.refinement.calibration_check import adjust_poses, question_calibration
from sfmapp.odometry.refinement.final_adjustment import MIN_SIGMA_PX, rig_of

# Keyframes at which a map is questioned until its calibration has been refined: early ones for the live poses, later
# ones for motions that tell little. A first look at a calibration that is right costs one adjustment.
_AT = (8, 12, 18, 27, 40, 60)
_STEPS, _TOLERANCE = 8, 1e-4


def is_time_to_ask(local: LocalMap) -> bool:
    """Whether a map has come to a number of keyframes at which it is questioned."""
    return local.newest + 1 in _AT


def refine_early(local: LocalMap) -> bool:
    """Hold the calibration of a growing map against what it has seen; returns whether it was refined.

    The map is then adjusted to it, in place, and goes on with it; what else is under way is over. Otherwise nothing has
    changed."""
    keyframes = local.keyframes
    everything = np.arange(len(keyframes.keyframes))
    job = make_job(keyframes, everything, everything > 0)
    sigma = residual_scale_px(job.model, MIN_SIGMA_PX)
    cost = adjust_poses(job.model, sigma, _STEPS, _TOLERANCE)
    answer = question_calibration(job.model, cost, sigma, may_refine=True)
    if not answer.is_refined:
        return False
    local.backend.finish(keyframes)
    job.model = answer.model
    classify(job.model, job.num_elsewhere)
    take_over(job, keyframes)
    keyframes.rig = local.rig = rig_of(job.model)
    return True
