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
    """Gaussians on free intrinsics, independent or with the joint covariance of a calibration: what gtsam's
    PriorFactorVector would add, without its import.

    Attributes:
        camera, slot, index, mean: (V,) of each free parameter with a prior: its camera, its place in the canonical row,
            its unknown, and what it is by the prior.
        first, second: (W,) positions among these of the entries of the information; weight: (W,) the entries.
    """

    def __init__(self, problem: Problem, cameras: Sequence[Camera] | None, options: AdjustOptions) -> None:
        rows: list[tuple[float, ...]] = []
        entries: list[tuple[int, int, float]] = []
        for c, camera_idx in enumerate(problem.camera_idx if cameras is not None else ()):
            assert cameras is not None
            camera = cameras[camera_idx]
            first = 6 if problem.camera_block[c] < problem.num_pose_blocks else 0
            place, information = _information(camera, problem.free.params[c], options)
            start = len(rows)
            for n in place.tolist():
                slots = problem.free.slot[problem.free.ptr[c] : problem.free.ptr[c + 1]]
                columns = problem.free.column[problem.free.ptr[c] : problem.free.ptr[c + 1]]
                slot = slots[np.flatnonzero(columns == first + n)[0]]
                mean = camera.params[problem.free.params[c][n]]
                rows.append((c, slot, problem.camera_block[c] * 8 + first + n, mean))
            if first + max(place.tolist(), default=0) >= 8:  # of two blocks, whose tile between is not ours
                information = np.diag(1.0 / np.diag(np.linalg.inv(information)))
            entries += [(start + k, start + m, information[k, m]) for k, m in np.argwhere(information != 0.0).tolist()]
        table, pairs = np.array(rows, np.float64).reshape(-1, 4), np.array(entries, np.float64).reshape(-1, 3)
        self.camera, self.slot, self.index = (table[:, k].astype(np.int64) for k in range(3))
        self.mean, self.weight = table[:, 3], pairs[:, 2].copy()
        self.first, self.second = pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64)

    def cost(self, canonical: Array) -> float:
        error = canonical[self.camera, self.slot] - self.mean
        return float(0.5 * (self.weight * error[self.first] * error[self.second]).sum())

    def add(self, canonical: Array, own: Array, gradient: Array) -> None:
        """Add weight and gradient to the blocks' own tiles (B * 64,) and to the gradient (B * 8,)."""
        row, column = self.index[self.first], self.index[self.second]
        own[row // 8 * 64 + row % 8 * 8 + column % 8] += self.weight
        error = canonical[self.camera, self.slot] - self.mean
        np.add.at(gradient, row, self.weight * error[self.second])


def _information(camera: Camera, free: NDArray[np.int64], options: AdjustOptions) -> tuple[NDArray[np.int64], Array]:
    """Which of the free parameters (Q,) have a prior, as positions (V,) among them, and its information (V, V)."""
    names = [PARAM_NAMES[camera.model][param] for param in free]
    if camera.focal_sigma is not None and camera.focal_variance > 0.0:
        assert camera.prior_covariance is not None
        factor = camera.focal_sigma**2 / camera.focal_variance
        covariance = factor * camera.prior_covariance[np.ix_(free, free)]
        told = np.flatnonzero(np.diag(covariance) > 0.0).astype(np.int64)
        return told, np.asarray(np.linalg.inv(covariance[np.ix_(told, told)]), np.float64)
    sigmas = [_sigma(name, camera, options) for name in names]
    place = np.array([n for n, sigma in enumerate(sigmas) if sigma is not None], np.int64)
    return place, np.diag([1.0 / sigma**2 for sigma in sigmas if sigma is not None])


def _sigma(name: str, camera: Camera, options: AdjustOptions) -> float | None:
    kind = kind_of(name)
    if kind == "focal":
        return camera.focal_sigma
    return options.principal_point_sigma_px if kind == "center" else options.distortion_sigma
