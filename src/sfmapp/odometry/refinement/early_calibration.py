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


class EarlyCalibration:
    """Asks the maps of a run about its calibration, until one of them has refined it.

    Attributes:
        is_open: it has not been refined, and may be.
    """

    def __init__(self, is_open: bool) -> None:
        self.is_open = is_open
        self._asked: set[tuple[int, int]] = set()

    def refines(self, local: LocalMap) -> bool:
        """Ask a map that has a new keyframe, if it is time to; returns whether it goes on with a refined calibration.

        The map is then adjusted to it, in place; what else is under way is over. Otherwise nothing has changed.
        """
        asked = (local.map_idx, local.newest)
        if not self.is_open or local.newest + 1 not in _AT or asked in self._asked:
            return False
        self._asked.add(asked)
        is_refined = _refine(local)
        self.is_open = not is_refined
        return is_refined


def _refine(local: LocalMap) -> bool:
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
