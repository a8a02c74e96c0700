"""Particles: poses in a map and, with one camera, the unit of length that the camera's own map has there.

One set stands for one place that the camera may be at (clustered particle filtering: Milstein, Sanchez and Williamson,
"Robust global localization using clustered particle filtering", AAAI 2002). A filter that resamples all of them
together loses one of two equal places by chance; here what is believed of places is kept beside the particles, and a
set is resampled within itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

# Fewest and most particles of a set, and bounds of the number by KLD sampling: with the probability of that many
# standard deviations (0.99) the divergence from the true distribution is below the first (Fox, IJRR 2003).
MIN_PARTICLES, MAX_PARTICLES = 30, 500
_DIVERGENCE, _QUANTILE = 0.1, 2.326
# Bins that these are counted in: shares of the depth of what is seen, and degrees.
BIN_DEPTHS, BIN_DEG = 0.05, 2.5
# Share of landmarks that are seen anywhere, and how many count as independent of each other: the landmarks of a place
# have the errors of a few keyframes in common.
_ASTRAY, _INDEPENDENT = 0.1, 20
# Standard deviation of a motion that was not measured, in radians and as a share of the depth.
_UNMEASURED = 0.01


@dataclass(frozen=True)
class Particles:
    """A set of weighted particles.

    Attributes:
        pose: (P, 7) cam_from_world of the newest frame in the known map.
        log_scale: (P,) of the known map's unit over the own one's, natural.
        weight: (P,) sum 1.
    """

    pose: Array
    log_scale: Array
    weight: Array

    def __len__(self) -> int:
        return len(self.weight)

    def joined(self, other: Particles, share: float) -> Particles:
        """Both sets, the other with a share of the weight."""
        weight = np.concatenate([(1 - share) * self.weight, share * other.weight])
        return Particles(
            np.concatenate([self.pose, other.pose]), np.concatenate([self.log_scale, other.log_scale]), weight
        )

    def moved(self, step: Array, covariance: Array, depth: float, rng: np.random.Generator) -> Particles:
        """After a motion that was measured in the own map.

        Args:
            step: (7,) pose of the camera now from the one before, in the own unit. covariance: (6, 6) of that, over
                rotation and translation of ``x <- exp(w) x + v``, in the own unit; not finite where it is not known.
            depth: of what is seen, in the known unit.
        """
        num, scale = len(self), np.exp(self.log_scale)
        if np.isfinite(covariance).all():
            root = np.linalg.cholesky(covariance + 1e-18 * np.eye(6))
            error = rng.standard_normal((num, 6)) @ root.T
            error[:, 3:] *= scale[:, None]
        else:
            error = _UNMEASURED * rng.standard_normal((num, 6)) * np.repeat([1.0, depth], 3)
        turn = rigid3.exp_so3(error[:, :3]) @ rigid3.rotation_matrix(step)
        steps = rigid3.from_matrix(turn, scale[:, None] * step[4:] + error[:, 3:])
        return Particles(rigid3.compose(steps, self.pose), self.log_scale, self.weight)

    def weighed(self, xyz: Array, ray: Array, sigma: float) -> Particles:
        """Weights by landmarks (M, 3) seen along rays (M, 2), x and y over z, with a standard deviation of these."""
        found = np.empty(len(self))
        _log_likelihood(self.pose, xyz, ray, sigma, _ASTRAY, found)
        found *= min(1.0, _INDEPENDENT / max(len(xyz), 1))
        weight = self.weight * np.exp(found - found.max())
        return Particles(self.pose, self.log_scale, weight / weight.sum())

    def resampled(self, num: int, rng: np.random.Generator) -> Particles:
        """So many of equal weight, drawn with low variance (systematic resampling; Thrun, Burgard and Fox,
        "Probabilistic Robotics", table 4.4)."""
        at = (rng.random() + np.arange(num)) / num
        chosen = np.minimum(np.searchsorted(np.cumsum(self.weight), at), len(self) - 1)
        return Particles(self.pose[chosen], self.log_scale[chosen], np.full(num, 1.0 / num))

    def num_wanted(self, depth: float) -> int:
        """How many particles the set needs: as many as the bins that they spread over ask for."""
        mean = self.mean()[0]
        turn = rigid3.log_so3(rigid3.rotation_matrix(self.pose) @ rigid3.rotation_matrix(mean).T)
        place = (rigid3.center(self.pose) - rigid3.center(mean)) / (BIN_DEPTHS * depth)
        bins = np.rint(np.column_stack([place, np.degrees(turn) / BIN_DEG])).astype(np.int64)
        return kld_number(len(np.unique(bins, axis=0)))

    def mean(self) -> tuple[Array, float]:
        """Pose (7,) and logarithm of the scale; rotations lie near each other."""
        aligned = self.pose[:, :4] * np.sign(self.pose[:, :4] @ self.pose[0, :4])[:, None]
        quaternion = self.weight @ aligned
        quaternion /= np.linalg.norm(quaternion)
        turn = rigid3.rotation_matrix(quaternion)
        center = self.weight @ rigid3.center(self.pose)
        return rigid3.from_matrix(turn, -turn @ center), float(self.weight @ self.log_scale)


def kld_number(num_bins: int) -> int:
    """Particles for a distribution over so many bins: Fox, "Adapting the sample size in particle filters through
    KLD-sampling", IJRR 2003, equation 7; within :data:`MIN_PARTICLES` and :data:`MAX_PARTICLES`."""
    if num_bins < 2:
        return MIN_PARTICLES
    k = num_bins - 1
    part = 2.0 / (9.0 * k)
    wanted = k / (2.0 * _DIVERGENCE) * (1.0 - part + math.sqrt(part) * _QUANTILE) ** 3
    return int(min(max(math.ceil(wanted), MIN_PARTICLES), MAX_PARTICLES))


def drawn(
    pose: Array, covariance: Array, log_scale: float, scale_sigma: float, depth: float, num: int,
    rng: np.random.Generator,
) -> Particles:  # fmt: skip
    """Particles of equal weight about a measured pose.

    Args:
        pose: (7,) cam_from_world. covariance: (6, 6) as of ``refine_pose``. depth: of what is seen, for a covariance
            that is not known.
    """
    if np.isfinite(covariance).all():
        values, vectors = np.linalg.eigh(covariance)
        error = (rng.standard_normal((num, 6)) * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    else:
        error = _UNMEASURED * rng.standard_normal((num, 6)) * np.repeat([1.0, depth], 3)
    moved = rigid3.from_matrix(rigid3.exp_so3(error[:, :3]), error[:, 3:])
    scales = log_scale + scale_sigma * rng.standard_normal(num)
    return Particles(rigid3.compose(moved, pose), scales, np.full(num, 1.0 / num))


@numba.njit(cache=True, nogil=True)
def _log_likelihood(pose: Array, xyz: Array, ray: Array, sigma: float, astray: float, out: Array) -> None:
    """Sum over landmarks of log((1 - e) exp(-r^2 / 2) + e exp(-8)), r in standard deviations: a landmark is where a
    pose puts it, or anywhere; that is worth as much as four standard deviations.

    Args:
        pose: (P, 7). xyz: (M, 3). ray: (M, 2). out: (P,).
    """
    floor = astray * math.exp(-8.0)
    for p in range(pose.shape[0]):
        x, y, z, w = pose[p, 0], pose[p, 1], pose[p, 2], pose[p, 3]
        r00, r01, r02 = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
        r10, r11, r12 = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
        r20, r21, r22 = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
        total = 0.0
        for m in range(xyz.shape[0]):
            a, b, c = xyz[m, 0], xyz[m, 1], xyz[m, 2]
            depth = r20 * a + r21 * b + r22 * c + pose[p, 6]
            likelihood = floor
            if depth > 0.0:
                u = (r00 * a + r01 * b + r02 * c + pose[p, 4]) / depth - ray[m, 0]
                v = (r10 * a + r11 * b + r12 * c + pose[p, 5]) / depth - ray[m, 1]
                likelihood += (1.0 - astray) * math.exp(-0.5 * (u * u + v * v) / (sigma * sigma))
            total += math.log(likelihood)
        out[p] = total


def compile_kernels() -> None:
    """Run every kernel once, so that numba compiles or loads them now."""
    pose, point = np.array([rigid3.IDENTITY]), np.array([[0.0, 0.0, 1.0]])
    _log_likelihood(pose, point, np.zeros((1, 2)), 1.0, 0.1, np.empty(1))
