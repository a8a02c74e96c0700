"""Bundle adjustment on SO(3): rotations of cameras at one centre, their focal lengths and distortion, and the rays that
they see.

The rays are landmarks, two numbers each, and not eliminated beforehand as differences of pairs would be: a point that
four photographs show has four measurements and not six, so that their noise is counted once, and the covariance is that
of the maximum likelihood. The rays go by the Schur complement, track by track; what is left is dense and small.

The loss is of tracks, and not of each measurement: of two that do not agree none is better than the other, and a loss
of each would have the least where one of them takes all of the difference.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import lens
from sfmapp.camera.camera import Camera, pixels_to_rays
from sfmapp.camera.models import PARAM_NAMES, canonical_from_params, kind_of
from sfmapp.geometry import rigid3
from sfmapp.scene.tracks import Tracks

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Cauchy's weight of a track is a half at three standard deviations: one track in ninety is as far off by chance.
_CAUCHY = 3.0
# least noise of a keypoint, pixels: copies of one picture have none, and the prior is to weigh more than rounding
_LEAST_NOISE_PX = 0.01
_MAX_STEPS, _CONVERGED = 30, 1e-7
_MOST_LENGTHENING = 2.0
# of the square of a keypoint's error, what is left of it at least where its ray hangs on it alone
_LEAST_SHARE = 0.05
# What is believed of a lens before it is seen: k1 and k2 of photographs are a few tenths at most.
_DISTORTION_SIGMA = 0.3
# Nothing known of a focal length: within a factor of two of the guess.
_UNKNOWN_LOG_FOCAL = math.log(2.0)
# What keypoints at the margin of a picture have in common, pixels: they shift with the slopes of brightness and scale
# about them, which no residual shows. The focal lengths of three rendered rings were off by a tenth to the whole of it
# over half the width, one of them by nine standard deviations without it.
_COMMON_PX = 0.01
# residuals are averaged over so many cells along each side of a picture, of so many residuals at least
_CELLS, _FEWEST_OF_CELL = 6, 6


@dataclass(frozen=True)
class Turned:
    """Cameras at one centre.

    Attributes:
        cameras: C cameras.
        rotations: (I, 3, 3) cam_from_world; NaN where unknown.
        rays: (T, 3) unit directions in the world.
    """

    cameras: list[Camera]
    rotations: Array
    rays: Array


@dataclass(frozen=True)
class TurnedFit:
    """What an adjustment has come to.

    Attributes:
        state: the cameras.
        residuals: (O, 2) pixels.
        noise_px: standard deviation of a coordinate of a keypoint, of one whose spread is one.
        free: of each camera the names of what was refined, ``log_focal``, ``k1``, ``k2``.
        covariance: (3 I + K, 3 I + K) of rotations, radians about the axes of each camera, and of the K refined numbers
            of all cameras in the order of ``free``; in the gauge in which the rotations do not turn on the whole.
        correlation: factor, at least one, that the covariance was widened by in standard deviations, as residuals of
            neighbours agree with each other more than noise does.
        cost: half of the sum of the robust squared residuals, pixels squared, prior included.
    """

    state: Turned
    residuals: Array
    noise_px: float
    free: tuple[tuple[str, ...], ...]
    covariance: Array
    correlation: float
    cost: float

    @property
    def rotation_sigma_deg(self) -> Array:
        """(I, 3) about the axes of each camera."""
        num = 3 * len(self.state.rotations)
        variance = np.diag(self.covariance)[:num].reshape(-1, 3)
        sigma: Array = np.degrees(np.sqrt(np.maximum(variance, 0.0)))
        return sigma

    def sigmas(self, camera_idx: int) -> dict[str, float]:
        """Of what was refined of a camera: ``log_focal``, ``k1``, ``k2``."""
        first = 3 * len(self.state.rotations) + sum(len(names) for names in self.free[:camera_idx])
        at = first + np.arange(len(self.free[camera_idx]))
        values = np.sqrt(np.maximum(np.diag(self.covariance)[at], 0.0))
        return dict(zip(self.free[camera_idx], values.tolist(), strict=True))


class _Views(NamedTuple):
    """What kernels need of a state.

    Attributes:
        image, track, camera: (O,) int64 of each observation. xy: (O, 2).
        rotations: (I, 3, 3). rays: (T, 3). tangents: (T, 3, 2). rows: (C, 17) cameras.
        spread: (C, K, 16) how the canonical numbers of a camera change with what is refined of it.
    """

    image: NDArray[np.int64]
    track: NDArray[np.int64]
    camera: NDArray[np.int64]
    xy: Array
    rotations: Array
    rays: Array
    tangents: Array
    rows: Array
    spread: Array


@numba.njit(cache=True, nogil=True)
def _linearize(v: _Views, with_slopes: bool, residuals: Array, by_camera: Array, by_ray: Array) -> None:
    """Residuals (O, 2); with slopes also the derivatives of what is predicted by cameras (O, 2, 3 + K), rotations
    first, and by rays (O, 2, 2)."""
    slopes = np.zeros(lens.JACOBIAN)
    for o in range(v.image.shape[0]):
        turn, ray, row = v.rotations[v.image[o]], v.rays[v.track[o]], v.rows[v.camera[o]]
        x = turn[0, 0] * ray[0] + turn[0, 1] * ray[1] + turn[0, 2] * ray[2]
        y = turn[1, 0] * ray[0] + turn[1, 1] * ray[1] + turn[1, 2] * ray[2]
        z = turn[2, 0] * ray[0] + turn[2, 1] * ray[1] + turn[2, 2] * ray[2]
        if not with_slopes:
            px, py = lens.project(row, x, y, z)
            residuals[o, 0], residuals[o, 1] = v.xy[o, 0] - px, v.xy[o, 1] - py
            continue
        lens.project_jacobian(row, x, y, z, slopes)
        tangent = v.tangents[v.track[o]]
        for k in range(2):
            residuals[o, k] = v.xy[o, k] - slopes[k]
            a, b, c = slopes[2 + 3 * k], slopes[3 + 3 * k], slopes[4 + 3 * k]
            by_camera[o, k, 0] = c * y - b * z
            by_camera[o, k, 1] = a * z - c * x
            by_camera[o, k, 2] = b * x - a * y
            for n in range(2):
                total = 0.0
                for m in range(3):
                    total += (a * turn[0, m] + b * turn[1, m] + c * turn[2, m]) * tangent[m, n]
                by_ray[o, k, n] = total
            for n in range(v.spread.shape[1]):
                total = 0.0
                for m in range(v.spread.shape[2]):
                    if v.spread[v.camera[o], n, m] != 0.0:
                        total += slopes[8 + 2 * m + k] * v.spread[v.camera[o], n, m]
                by_camera[o, k, 3 + n] = total


@numba.njit(cache=True, nogil=True)
def _reduce(
    track_ptr: NDArray[np.int64], columns: NDArray[np.int64], weights: Array, residuals: Array, by_camera: Array,
    by_ray: Array, hessian: Array, gradient: Array, inverses: Array, toward: Array,
) -> None:  # fmt: skip
    """Add up the normal equations of all but the rays.

    Args:
        track_ptr: (T + 1,). columns: (O, Q) unknowns that the columns of by_camera belong to, -1 for none.
        weights: (O,). residuals: (O, 2). by_camera: (O, 2, Q). by_ray: (O, 2, 2).
        hessian, gradient: (P, P) and (P,), added to.
        inverses, toward: (T, 2, 2) and (T, 2), of the rays: inverse of their block, and their right-hand side.
    """
    num = columns.shape[1]
    longest = 0
    for t in range(track_ptr.shape[0] - 1):
        longest = max(longest, track_ptr[t + 1] - track_ptr[t])
    mixed = np.zeros((longest, num, 2))
    for t in range(track_ptr.shape[0] - 1):
        first, last = track_ptr[t], track_ptr[t + 1]
        a = b = d = e0 = e1 = 0.0
        for o in range(first, last):
            w = weights[o]
            j = by_ray[o]
            a += w * (j[0, 0] * j[0, 0] + j[1, 0] * j[1, 0])
            b += w * (j[0, 0] * j[0, 1] + j[1, 0] * j[1, 1])
            d += w * (j[0, 1] * j[0, 1] + j[1, 1] * j[1, 1])
            e0 += w * (j[0, 0] * residuals[o, 0] + j[1, 0] * residuals[o, 1])
            e1 += w * (j[0, 1] * residuals[o, 0] + j[1, 1] * residuals[o, 1])
        det = a * d - b * b
        if not det > 1e-14 * (a + d) * (a + d):
            continue
        inverses[t, 0, 0], inverses[t, 1, 1] = d / det, a / det
        inverses[t, 0, 1] = inverses[t, 1, 0] = -b / det
        toward[t, 0], toward[t, 1] = e0, e1
        s0 = inverses[t, 0, 0] * e0 + inverses[t, 0, 1] * e1
        s1 = inverses[t, 1, 0] * e0 + inverses[t, 1, 1] * e1
        for o in range(first, last):
            w = weights[o]
            m = mixed[o - first]
            for p in range(num):
                c0, c1 = by_camera[o, 0, p] * w, by_camera[o, 1, p] * w
                m[p, 0] = c0 * by_ray[o, 0, 0] + c1 * by_ray[o, 1, 0]
                m[p, 1] = c0 * by_ray[o, 0, 1] + c1 * by_ray[o, 1, 1]
                row = columns[o, p]
                if row < 0:
                    continue
                gradient[row] += c0 * residuals[o, 0] + c1 * residuals[o, 1] - m[p, 0] * s0 - m[p, 1] * s1
                for q in range(num):
                    if columns[o, q] >= 0:
                        hessian[row, columns[o, q]] += c0 * by_camera[o, 0, q] + c1 * by_camera[o, 1, q]
        for o in range(first, last):
            for p in range(num):
                row = columns[o, p]
                if row < 0:
                    continue
                left = mixed[o - first, p]
                l0 = left[0] * inverses[t, 0, 0] + left[1] * inverses[t, 1, 0]
                l1 = left[0] * inverses[t, 0, 1] + left[1] * inverses[t, 1, 1]
                for other in range(first, last):
                    for q in range(num):
                        if columns[other, q] >= 0:
                            right = mixed[other - first, q]
                            hessian[row, columns[other, q]] -= l0 * right[0] + l1 * right[1]


class _Problem:
    """What stays the same from step to step."""

    def __init__(
        self, tracks: Tracks, image_camera_idx: Ints, free: Sequence[tuple[str, ...]], priors: Sequence[Camera],
        spread: Array | None,
    ) -> None:  # fmt: skip
        self.tracks, self.free, self.priors = tracks, tuple(free), priors
        self.inverse2 = np.ones(tracks.num_observations) if spread is None else 1.0 / spread**2
        self.image = tracks.obs_image_idx.astype(np.int64)
        self.track = tracks.obs_track_idx.astype(np.int64)
        self.camera = np.asarray(image_camera_idx, np.int64)[self.image]
        self.of_camera = [np.flatnonzero(self.camera == c) for c in range(len(free))]
        self.num_images = tracks.num_images
        self.num_free = max((len(names) for names in free), default=0)
        starts = 3 * self.num_images + np.cumsum([0, *(len(names) for names in free)])
        self.num_unknowns = int(starts[-1])
        self.starts = starts
        columns = np.full((len(self.image), 3 + self.num_free), -1, np.int64)
        columns[:, :3] = 3 * self.image[:, None] + np.arange(3)
        for c, names in enumerate(free):
            columns[self.of_camera[c], 3 : 3 + len(names)] = starts[c] + np.arange(len(names))
        self.columns = columns
        # a ray has two numbers of its own: of the squares of n measurements, this is what is left of each
        total = np.add.reduceat(self.inverse2, tracks.track_ptr[:-1])
        self.share = np.maximum(1.0 - self.inverse2 / total[tracks.obs_track_idx], _LEAST_SHARE)
        self.surplus = np.maximum(np.diff(tracks.track_ptr) - 1, 1).astype(np.float64)

    def linearize(self, state: Turned, *, with_slopes: bool = True) -> tuple[Array, Array, Array]:
        """Residuals (O, 2), and the derivatives of what is predicted by cameras (O, 2, Q) and by rays (O, 2, 2), which
        are empty if they are not asked for."""
        num = len(self.image) if with_slopes else 0
        residuals = np.empty((len(self.image), 2))
        by_camera, by_ray = np.zeros((num, 2, 3 + self.num_free)), np.empty((num, 2, 2))
        spread = np.zeros((len(state.cameras), self.num_free, lens.FAMILY))
        for c, camera in enumerate(state.cameras):
            for k, name in enumerate(self.free[c]):
                spread[c, k] = canonical_from_params(camera.model) @ _direction(camera, name)
        rows = np.array([camera.canonical for camera in state.cameras])
        views = _Views(
            self.image, self.track, self.camera, self.tracks.obs_xy, state.rotations, state.rays,
            _tangents(state.rays), rows, spread,
        )  # fmt: skip
        _linearize(views, with_slopes, residuals, by_camera, by_ray)
        return residuals, by_camera, by_ray

    def residuals(self, state: Turned) -> Array:
        """(O, 2) pixels."""
        return self.linearize(state, with_slopes=False)[0]

    def squares(self, residuals: Array) -> Array:
        """(O,) squared lengths of residuals, in units of the spread of each."""
        out: Array = (residuals[:, 0] ** 2 + residuals[:, 1] ** 2) * self.inverse2
        return out

    def of_tracks(self, residuals: Array) -> Array:
        """(T,) sums of these over each track, for every measurement that it has more than one."""
        out: Array = np.add.reduceat(self.squares(residuals), self.tracks.track_ptr[:-1]) / self.surplus
        return out

    def prior(self, state: Turned) -> tuple[Array, Array]:
        """Errors (K,) of the refined numbers in units of their prior's standard deviation, and its inverse."""
        errors, weights = [], []
        for camera, before, names in zip(state.cameras, self.priors, self.free, strict=True):
            for name in names:
                if name == "log_focal":
                    known = before.focal_sigma is not None and before.focal_source != "default"
                    sigma = before.focal_sigma / before.focal if known and before.focal_sigma else _UNKNOWN_LOG_FOCAL
                    errors.append(math.log(before.focal / camera.focal) / sigma)
                else:
                    sigma = _DISTORTION_SIGMA
                    errors.append(-_param(camera, name) / sigma)
                weights.append(1.0 / sigma)
        return np.array(errors), np.array(weights)

    def cost(self, residuals: Array, state: Turned, scale2: float, noise2: float) -> float:
        """Half of the sum of Cauchy's robust squares, and of the prior in units of the noise."""
        squares = self.of_tracks(residuals)
        if not np.isfinite(squares).all():
            return math.inf
        errors, _ = self.prior(state)
        return float(0.5 * scale2 * self.surplus @ np.log1p(squares / scale2) + 0.5 * noise2 * (errors**2).sum())

    def normal(
        self, state: Turned, scale2: float, noise2: float
    ) -> tuple[Array, Array, tuple[Array, Array, Array, Array, Array]]:
        """Hessian and gradient of all but the rays, and what :meth:`moved` needs of the latter."""
        residuals, by_camera, by_ray = self.linearize(state)
        weights = self.inverse2 / (1.0 + self.of_tracks(residuals) / scale2)[self.tracks.obs_track_idx]
        hessian, gradient = np.zeros((self.num_unknowns, self.num_unknowns)), np.zeros(self.num_unknowns)
        num_tracks = self.tracks.num_tracks
        inverses, toward = np.zeros((num_tracks, 2, 2)), np.zeros((num_tracks, 2))
        _reduce(
            self.tracks.track_ptr, self.columns, weights, residuals, by_camera, by_ray, hessian, gradient, inverses,
            toward,
        )  # fmt: skip
        errors, inverse_sigma = self.prior(state)
        at = np.arange(3 * self.num_images, self.num_unknowns)
        hessian[at, at] += noise2 * inverse_sigma**2
        gradient[at] += noise2 * inverse_sigma * errors
        # the world may turn as a whole: cameras do by what their rotation makes of it
        gauge = state.rotations.reshape(-1, 3)
        free = 3 * self.num_images
        hessian[:free, :free] += gauge @ gauge.T * (np.trace(hessian[:free, :free]) / free / self.num_images)
        return hessian, gradient, (inverses, toward, weights, by_camera, by_ray)

    def moved(self, state: Turned, step: Array, of_rays: tuple[Array, Array, Array, Array, Array]) -> Turned:
        """The state after a step, with what follows from it for the rays."""
        inverses, toward, weights, by_camera, by_ray = of_rays
        by_step = np.where(self.columns >= 0, step[self.columns], 0.0)
        followed = np.einsum("nkp,np->nk", by_camera, by_step)
        change = weights[:, None] * np.einsum("nki,nk->ni", by_ray, followed)
        rest = toward - np.add.reduceat(change, self.tracks.track_ptr[:-1], axis=0)
        sideways = np.einsum("tij,tj->ti", inverses, rest)
        rays = state.rays + np.einsum("tij,tj->ti", _tangents(state.rays), sideways)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        turns = rigid3.exp_so3(step[: 3 * self.num_images].reshape(-1, 3)) @ state.rotations
        cameras = []
        for c, camera in enumerate(state.cameras):
            params = camera.params.copy()
            for k, name in enumerate(self.free[c]):
                by = step[self.starts[c] + k]
                params += _direction(camera, name) * (np.expm1(by) if name == "log_focal" else by)
            cameras.append(camera.with_params(params))
        return Turned(cameras, turns, rays)

    def curvature(self, residuals: Array, scale2: float) -> tuple[float, float, float]:
        """Mean weight, mean second derivative of the loss, and variance of its first, of the tracks."""
        squares = self.of_tracks(residuals)
        weights = 1.0 / (1.0 + squares / scale2)
        total = self.surplus.sum()
        weight = float(self.surplus @ weights / total)
        slope = weight - float((weights**2 * squares).sum()) / (scale2 * total)
        return weight, slope, 0.5 * float(self.surplus @ (weights**2 * squares) / total)

    def variance(self, residuals: Array) -> float:
        """Of a coordinate of a keypoint: the median of a squared length of two normal numbers is 2 ln 2."""
        squares = self.squares(residuals) / self.share
        return max(float(np.median(squares)) / (2.0 * math.log(2.0)), _LEAST_NOISE_PX**2)


def adjust_turns(
    start: Turned, tracks: Tracks, image_camera_idx: Ints, free: Sequence[tuple[str, ...]], priors: Sequence[Camera],
    spread: Array | None = None,
) -> TurnedFit:  # fmt: skip
    """Rotations, lenses and rays of least robust squared reprojection error, by Levenberg and Marquardt.

    Where errors have long tails, weights alone make the curvature greater than it is, and steps too short; they are
    lengthened by what Cauchy's loss curves less on the average.

    Args:
        start: near the solution. tracks: of which each image sees three or more.
        image_camera_idx: (I,). free: what is refined of each camera. priors: cameras as they were known beforehand.
        spread: (O,) how much noisier each keypoint is than others; None: all alike.

    Raises:
        ValueError: nothing to adjust, or numbers that are not finite.
    """
    if tracks.num_observations < 6 or not np.isfinite(start.rotations).all() or not np.isfinite(start.rays).all():
        raise ValueError("expected finite rotations and rays and six observations or more")
    problem = _Problem(tracks, image_camera_idx, free, priors, spread)
    state, damping = start, 1e-4
    residuals = problem.residuals(state)
    noise2 = problem.variance(residuals)
    scale2 = _CAUCHY**2 * noise2
    cost = problem.cost(residuals, state, scale2, noise2)
    for _ in range(_MAX_STEPS):
        hessian, gradient, of_rays = problem.normal(state, scale2, noise2)
        weight, slope, _ = problem.curvature(residuals, scale2)
        longer = min(weight / max(slope, 1e-9), _MOST_LENGTHENING)
        while damping < 1e8:
            damped = hessian + damping * np.diag(np.diag(hessian) + 1e-12)
            step = longer * np.asarray(np.linalg.solve(damped, gradient), np.float64)
            tried = problem.moved(state, step, of_rays)
            residuals = problem.residuals(tried)
            after = problem.cost(residuals, tried, scale2, noise2)
            if after <= cost:
                break
            damping, longer = 10.0 * damping, 1.0
        else:
            break
        is_done = cost - after <= _CONVERGED * cost
        state, damping = tried, max(damping * 0.1, 1e-12)
        noise2 = min(noise2, problem.variance(residuals))
        is_done &= _CAUCHY**2 * noise2 > 0.999 * scale2
        scale2 = min(scale2, _CAUCHY**2 * noise2)
        cost = problem.cost(residuals, state, scale2, noise2)
        if is_done:
            break
    return _fit(problem, state, scale2, noise2)


def _fit(problem: _Problem, state: Turned, scale2: float, noise2: float) -> TurnedFit:
    hessian, _, _ = problem.normal(state, scale2, noise2)
    residuals = problem.residuals(state)
    noise2 = problem.variance(residuals)
    factor = _correlation(problem, state, residuals, noise2)
    # asymptotic variance of an M-estimator (Huber and Ronchetti, 2009, 7.6), for errors are heavier in the tails than
    # the normal ones that the median stands for
    weight, slope, influence = problem.curvature(residuals, scale2)
    variance = max(influence * weight / slope**2, noise2)
    # in units of its diagonal: what the prior alone holds is small beside what rays hold, and no rounding
    unit = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    inverse = unit[:, None] * np.linalg.pinv(unit[:, None] * hessian * unit, hermitian=True) * unit
    # without what the gauge was held by
    gauge = np.zeros((problem.num_unknowns, 3))
    gauge[: 3 * problem.num_images] = state.rotations.reshape(-1, 3)
    across = np.eye(problem.num_unknowns) - gauge @ gauge.T / problem.num_images
    covariance = variance * factor**2 * across @ inverse @ across
    covariance += np.diag(_common(problem, state))
    cost = problem.cost(residuals, state, scale2, noise2)
    return TurnedFit(state, residuals, math.sqrt(noise2), problem.free, covariance, factor, cost)


def _common(problem: _Problem, state: Turned) -> Array:
    """(U,) variances of what errors that all keypoints share make of the focal lengths."""
    out = np.zeros(problem.num_unknowns)
    names = [(camera, name) for camera, mine in zip(state.cameras, problem.free, strict=True) for name in mine]
    for k, (camera, name) in enumerate(names):
        if name == "log_focal":
            out[3 * problem.num_images + k] = (_COMMON_PX / (0.5 * max(camera.width, camera.height))) ** 2
    return out


def _correlation(problem: _Problem, state: Turned, residuals: Array, noise2: float) -> float:
    """Means of residuals over cells of the pictures, in units of what independent noise would leave of them."""
    size = np.array([[camera.width, camera.height] for camera in state.cameras])[problem.camera]
    place = np.clip((problem.tracks.obs_xy / size * _CELLS).astype(np.int64), 0, _CELLS - 1)
    cell = (problem.image * _CELLS + place[:, 1]) * _CELLS + place[:, 0]
    residuals = residuals * np.sqrt(problem.inverse2)[:, None]
    variance = noise2 * problem.share
    is_good = (residuals**2).sum(1) < _CAUCHY**2 * 2.0 * variance
    cell, residuals, variance = cell[is_good], residuals[is_good], variance[is_good]
    counts, spread = np.bincount(cell), np.bincount(cell, variance)
    sums = np.stack([np.bincount(cell, residuals[:, k]) for k in range(2)], 1)
    known = counts >= _FEWEST_OF_CELL
    if not known.any():
        return 1.0
    return max(1.0, math.sqrt(float(((sums[known] ** 2).sum(1) / (2.0 * spread[known])).mean())))


def rays_of_tracks(cameras: Sequence[Camera], rotations: Array, tracks: Tracks, image_camera_idx: Ints) -> Array:
    """(T, 3) mean direction in the world that each track is seen in; NaN where a lens has no inverse."""
    camera = np.asarray(image_camera_idx)[tracks.obs_image_idx]
    rays = np.empty((tracks.num_observations, 3))
    for c, each in enumerate(cameras):
        at = np.flatnonzero(camera == c)
        rays[at] = pixels_to_rays(each, tracks.obs_xy[at])
    world = np.einsum("nji,nj->ni", rotations[tracks.obs_image_idx], rays)
    sums: Array = np.add.reduceat(world, tracks.track_ptr[:-1], axis=0)
    unit: Array = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    return unit


def refinable(camera: Camera, *, distortion: int) -> tuple[str, ...]:
    """Names of what may be refined of a camera: its focal length, and as many of k1 and k2 as are asked for."""
    names = PARAM_NAMES[camera.model]
    if camera.is_fixed or not any(kind_of(name) == "focal" for name in names):
        return ()
    return ("log_focal", *(name for name in ("k1", "k2")[:distortion] if name in names))


def with_noise(camera: Camera, sigmas: dict[str, float]) -> Camera:
    """The camera with the standard deviation of its focal length, as far as that was refined."""
    sigma = sigmas.get("log_focal")
    return camera if sigma is None else replace(camera, focal_sigma=sigma * camera.focal, focal_source="photographs")


def _tangents(rays: Array) -> Array:
    """(T, 3, 2) two unit vectors at right angles to each unit ray and to each other (Duff et al., JCGT 2017)."""
    x, y, z = rays.T
    sign = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], 1)
    return np.stack([first, np.stack([b, sign + y * y * a, -y], 1)], 2)


def _direction(camera: Camera, name: str) -> Array:
    """(P,) how the parameters of a camera change with one of those that are refined."""
    names = PARAM_NAMES[camera.model]
    if name == "log_focal":
        return np.where([kind_of(each) == "focal" for each in names], camera.params, 0.0)
    return np.array([float(each == name) for each in names])


def _param(camera: Camera, name: str) -> float:
    return float(camera.params[PARAM_NAMES[camera.model].index(name)])
