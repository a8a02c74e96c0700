"""Priors on intrinsics in a bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Problem
from sfmapp.camera.camera import Camera
from sfmapp.camera.models import PARAM_NAMES, kind_of

Array = NDArray[np.float64]


class IntrinsicPriors:
    """Independent Gaussians on free intrinsics: what gtsam's PriorFactorVector would add, without its import."""

    def __init__(self, problem: Problem, cameras: Sequence[Camera] | None, options: AdjustOptions) -> None:
        rows = []
        for c, camera_idx in enumerate(problem.camera_idx if cameras is not None else ()):
            assert cameras is not None
            camera = cameras[camera_idx]
            first = 6 if problem.camera_block[c] < problem.num_pose_blocks else 0
            for n, param in enumerate(problem.free.params[c]):
                sigma = self._sigma(PARAM_NAMES[camera.model][param], camera, options)
                if sigma is not None:
                    slots = problem.free.slot[problem.free.ptr[c] : problem.free.ptr[c + 1]]
                    columns = problem.free.column[problem.free.ptr[c] : problem.free.ptr[c + 1]]
                    slot = slots[np.flatnonzero(columns == first + n)[0]]
                    rows.append((c, slot, problem.camera_block[c] * 8 + first + n, camera.params[param], sigma))
        table = np.array(rows, np.float64).reshape(-1, 5)
        self.camera, self.slot, self.index = (table[:, k].astype(np.int64) for k in range(3))
        self.mean, self.weight = table[:, 3], 1.0 / table[:, 4] ** 2

    @staticmethod
    def _sigma(name: str, camera: Camera, options: AdjustOptions) -> float | None:
        kind = kind_of(name)
        if kind == "focal":
            return camera.focal_sigma
        return options.principal_point_sigma_px if kind == "center" else options.distortion_sigma

    def cost(self, canonical: Array) -> float:
        error = canonical[self.camera, self.slot] - self.mean
        return float(0.5 * (self.weight * error * error).sum())

    def add(self, canonical: Array, own: Array, gradient: Array) -> None:
        """Add weight and gradient to the blocks' own tiles (B * 64,) and to the gradient (B * 8,)."""
        own[self.index // 8 * 64 + self.index % 8 * 9] += self.weight
        gradient[self.index] += self.weight * (canonical[self.camera, self.slot] - self.mean)
