"""One photograph against points with known places: least squares over its pose and, where they are free, its lens.

What is asked of such a fit is not only where it ends but how sure each number is, and which single point the others
contradict; both need the slopes of all residuals, which are few here, so everything stands in plain dense arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import lens
from sfmapp.camera.camera import Camera, project_jacobian
from sfmapp.camera.models import canonical_from_params
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3
from sfmapp.geometry.damped import solve_damped, turn_columns

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

POSE = 6
MIN_DEGREES = 5
"""Fewer numbers than this beyond the unknowns do not tell the noise."""
HAND_SIGMA_PX = 1.0
"""Standard deviation of a coordinate that a hand has marked, where the residuals are too few to tell."""

_MAX_STEPS = 200
_TOLERANCE = 1e-14
# Chance that any of the good points of a picture is taken for a wrong one.
_FALSE_ALARM = 1e-3
# Of its own variance, what a point has to leave to the others to be checked by them.
_UNCHECKED = 1e-6
# Of the worst statistic: points that go together with it, so that thousands of matches do not take thousands of fits.
_AS_BAD = 0.5
# Residuals below are rounding, pixels.
_EXACT_PX = 1e-8


@dataclass(frozen=True)
class Prior:
    """What is known of a camera beforehand: ``rows @ (p - params)`` is normal with unit variance.

    Attributes:
        params: (P,) the middle. rows: (Q, P), a combination of parameters each, by its standard deviation.
    """

    params: Array
    rows: Array


@dataclass(frozen=True)
class OneView:
    """A photograph's camera and pose after a fit, over F free parameters and the pose.

    Attributes:
        camera, cam_from_world: as fitted, (7,).
        is_free: (P,) bool, of the parameters of the camera.
        residual: (N, 2) measured minus projected, pixels; NaN for a point that the lens does not see.
        slope: (N, 2, F + 6) of the projected pixels by the free parameters, a turn w in radians and a shift v of
            ``x_cam <- exp(w) x_cam + v``.
        is_used: (N,) bool, the points that were fitted.
        prior_information: (F + 6, F + 6) of the prior.
        cost: half the sum of squares over ``noise_px``, with the prior.
        noise_px: that a residual was divided by.
    """

    camera: Camera
    cam_from_world: Array
    is_free: Bools
    residual: Array
    slope: Array
    is_used: Bools
    prior_information: Array
    cost: float
    noise_px: float

    @property
    def num_unknown(self) -> int:
        return int(self.is_free.sum()) + POSE

    @property
    def squares(self) -> float:
        """Sum of the squared residuals that were fitted, square pixels."""
        return float((self.residual[self.is_used] ** 2).sum())

    @property
    def information(self) -> Array:
        """(F + 6, F + 6) by the points and the prior."""
        rows = self.slope[self.is_used].reshape(-1, self.num_unknown) / self.noise_px
        total: Array = rows.T @ rows + self.prior_information
        return total

    @property
    def degrees_of_freedom(self) -> float:
        """Measured numbers less the unknowns that they have to tell: a prior takes its share of these."""
        cofactor = inverse(self.information)
        if cofactor is None:
            return 2.0 * float(self.is_used.sum()) - self.num_unknown
        told = self.num_unknown - float((cofactor * self.prior_information).sum())
        return 2.0 * float(self.is_used.sum()) - told


Refit = Callable[[OneView, Bools], OneView]


def inverse(information: Array) -> Array | None:
    """The inverse of a symmetric matrix, scaled before by its diagonal; None if it has none to working precision."""
    diagonal = np.diag(information)
    if not (np.isfinite(information).all() and (diagonal > 0.0).all()):
        return None
    scale = 1.0 / np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    if not values[0] > 1e-13 * values[-1]:
        return None
    found: Array = scale[:, None] * (vectors / values @ vectors.T) * scale
    return 0.5 * (found + found.T)


def fit_view(
    camera: Camera, cam_from_world: Array, points: tuple[Array, Array], is_used: Bools, *,
    is_free: Bools | None = None, prior: Prior | None = None, noise_px: float = 1.0,
) -> OneView:  # fmt: skip
    """Minimise the squared residuals over the pose and the free parameters (Levenberg 1944, Marquardt 1963).

    Args:
        camera, cam_from_world: the start, (7,).
        points: N places in the world (N, 3) and their pixels (N, 2). is_used: (N,) which of them count.
        is_free: (P,) bool; None: none of the camera's parameters.
        prior: of the camera's parameters.
        noise_px: standard deviation of a coordinate, against which a prior is weighed.
    """
    free = np.zeros(len(camera.params), bool) if is_free is None else np.asarray(is_free, bool)
    params, rotation = camera.params.copy(), rigid3.rotation_matrix(cam_from_world)
    translation = np.array(cam_from_world[4:], np.float64)
    problem = _Problem(
        np.ascontiguousarray(canonical_from_params(camera.model)), camera.family, np.flatnonzero(free),
        np.ascontiguousarray(points[0][is_used]), np.ascontiguousarray(points[1][is_used]),
        camera.params.copy() if prior is None else np.array(prior.params),
        np.zeros((0, len(params))) if prior is None else np.array(prior.rows), float(noise_px),
        float(camera.width) if camera.model == CameraModel.EQUIRECTANGULAR else 0.0,
    )  # fmt: skip
    _descend(problem, params, rotation, translation)
    fitted = camera.with_params(params) if free.any() else camera
    pose = rigid3.from_matrix(rotation, translation)
    return _linearized(fitted, pose, points, is_used, free, prior, noise_px)


class _Problem(NamedTuple):
    """What a fit is to: M points and Q pieces of knowledge of P parameters, F of which are free.

    Attributes:
        canonical_from: (FAMILY, P) the canonical row of parameters. family: of lenses.
        free: (F,) positions of the free parameters.
        xyz, xy: (M, 3), (M, 2).
        middle, rows: (P,), (Q, P) of the prior.
        noise_px: of a coordinate.
        period: width of a panorama, whose left and right borders are one line; 0 for none.
    """

    canonical_from: Array
    family: int
    free: NDArray[np.int64]
    xyz: Array
    xy: Array
    middle: Array
    rows: Array
    noise_px: float
    period: float


@numba.njit(cache=True, nogil=True)
def _descend(problem: _Problem, params: Array, rotation: Array, translation: Array) -> None:
    """Levenberg and Marquardt's method over the free parameters and the pose, in place."""
    num = problem.free.shape[0] + POSE
    h, g, new_h, new_g = np.empty((num, num)), np.empty(num), np.empty((num, num)), np.empty(num)
    factor, step = np.empty((num, num)), np.empty(num)
    new_params, new_rotation, new_translation = params.copy(), rotation.copy(), translation.copy()
    column = np.empty((3, 1))
    damping, cost = 1e-3, _linearize(problem, params, rotation, translation, h, g)
    for _ in range(_MAX_STEPS):
        if not np.isfinite(cost):
            return
        new_cost = np.inf
        if solve_damped(h, g, damping, factor, step):
            for k in range(num - POSE):
                new_params[problem.free[k]] = params[problem.free[k]] + step[k]
            turn_columns(step[num - 6 : num - 3], rotation, new_rotation)
            turn_columns(step[num - 6 : num - 3], translation.reshape(3, 1), column)
            for k in range(3):
                new_translation[k] = column[k, 0] + step[num - 3 + k]
            new_cost = _linearize(problem, new_params, new_rotation, new_translation, new_h, new_g)
        if new_cost <= cost:
            gain, cost, damping = cost - new_cost, new_cost, max(damping * 0.1, 1e-15)
            params[:], rotation[:], translation[:] = new_params, new_rotation, new_translation
            h, new_h, g, new_g = new_h, h, new_g, g
            if gain <= _TOLERANCE * cost:
                return
        elif damping > 1e12:
            return
        else:
            damping = max(damping * 10.0, 1e-6)


@numba.njit(cache=True, nogil=True)
def _linearize(problem: _Problem, params: Array, rotation: Array, translation: Array, h: Array, g: Array) -> float:
    """Cost, half the sum of squares, and the lower triangle of its Gauss-Newton system; infinite where the lens does
    not see a point."""
    free, xyz, xy = problem.free, problem.xyz, problem.xy
    num_free = free.shape[0]
    num = num_free + POSE
    row, out, slope = np.empty(lens.ROW), np.empty(lens.JACOBIAN), np.empty((2, num))
    for i in range(lens.FAMILY):
        row[i] = 0.0
        for k in range(params.shape[0]):
            row[i] += problem.canonical_from[i, k] * params[k]
    row[lens.FAMILY] = problem.family
    h[:], g[:] = 0.0, 0.0
    cost, weight = 0.0, 1.0 / problem.noise_px**2
    for n in range(xyz.shape[0]):
        x = rotation[0, 0] * xyz[n, 0] + rotation[0, 1] * xyz[n, 1] + rotation[0, 2] * xyz[n, 2] + translation[0]
        y = rotation[1, 0] * xyz[n, 0] + rotation[1, 1] * xyz[n, 1] + rotation[1, 2] * xyz[n, 2] + translation[1]
        z = rotation[2, 0] * xyz[n, 0] + rotation[2, 1] * xyz[n, 1] + rotation[2, 2] * xyz[n, 2] + translation[2]
        lens.project_jacobian(row, x, y, z, out)
        for c in range(2):
            a, b, d = out[2 + 3 * c], out[3 + 3 * c], out[4 + 3 * c]
            for k in range(num_free):
                slope[c, k] = 0.0
                for i in range(lens.FAMILY):
                    slope[c, k] += out[8 + 2 * i + c] * problem.canonical_from[i, free[k]]
            # of a turn w the point moves by w x p
            slope[c, num_free] = y * d - z * b
            slope[c, num_free + 1] = z * a - x * d
            slope[c, num_free + 2] = x * b - y * a
            slope[c, num_free + 3], slope[c, num_free + 4], slope[c, num_free + 5] = a, b, d
            residual = xy[n, c] - out[c]
            if c == 0 and problem.period > 0.0:
                residual -= problem.period * np.round(residual / problem.period)
            if not np.isfinite(residual):
                return np.inf
            cost += weight * residual * residual
            for i in range(num):
                g[i] -= weight * slope[c, i] * residual
                for j in range(i + 1):
                    h[i, j] += weight * slope[c, i] * slope[c, j]
    for q in range(problem.rows.shape[0]):
        off = 0.0
        for k in range(params.shape[0]):
            off += problem.rows[q, k] * (params[k] - problem.middle[k])
        cost += off * off
        for i in range(num_free):
            g[i] += problem.rows[q, free[i]] * off
            for j in range(i + 1):
                h[i, j] += problem.rows[q, free[i]] * problem.rows[q, free[j]]
    return 0.5 * cost


def moved(cam_from_world: Array, step: Array) -> Array:
    """The pose (7,) after a turn and a shift (6,) of the camera's frame, ``x_cam <- exp(w) x_cam + v``."""
    return rigid3.compose(rigid3.from_matrix(rigid3.exp_so3(step[:3]), step[3:]), cam_from_world)


def _linearized(
    camera: Camera, pose: Array, points: tuple[Array, Array], is_used: Bools, is_free: Bools, prior: Prior | None,
    noise_px: float,
) -> OneView:  # fmt: skip
    xyz, xy = points
    in_camera = rigid3.apply(pose, xyz)
    pixels, by_point, by_params = project_jacobian(camera, in_camera)
    by_turn = by_point @ -rigid3.skew(in_camera)
    slope = np.concatenate([by_params[:, :, is_free], by_turn, by_point], 2)
    residual = xy - pixels
    if camera.model == CameraModel.EQUIRECTANGULAR:  # its left and right borders are one line
        residual[:, 0] -= camera.width * np.round(residual[:, 0] / camera.width)
    information = np.zeros((slope.shape[2], slope.shape[2]))
    pull = 0.0
    if prior is not None:
        information[:-POSE, :-POSE] = prior.rows[:, is_free].T @ prior.rows[:, is_free]
        pull = float(((prior.rows @ (camera.params - prior.params)) ** 2).sum())
    squares = float((residual[is_used] ** 2).sum())
    cost = 0.5 * (squares / noise_px**2 + pull) if np.isfinite(squares) else np.inf
    return OneView(camera, pose, is_free, residual, slope, is_used, information, cost, noise_px)


# ------------------------------------------------------------------------------------------------------ how sure it is


@dataclass(frozen=True)
class Noise:
    """Standard deviation of a marked coordinate.

    Attributes:
        sigma_px: from the residuals, or what was given or is usual where these are too few.
        variance: (px^2) by which a cofactor becomes a covariance: that of a Student distribution where the noise is
            itself estimated, which with few degrees of freedom is wider than the square of ``sigma_px``.
        source: where it is from, for a person.
    """

    sigma_px: float
    variance: float
    source: str


def resolution_sigma(xy: Array) -> float:
    """Standard deviation, pixels, of the rounding of pixels (N, 2) as they were written: whole pixels have 0.29."""
    for digits in range(7):
        # binary fractions, such as centres at halves, count as they are
        if np.abs(xy * 10.0**digits * 2.0 - np.round(xy * 10.0**digits * 2.0)).max(initial=0.0) < 1e-6:
            return float(10.0**-digits / np.sqrt(12.0))
    return 0.0


def noise_of(view: OneView, given_px: float | None, xy: Array) -> Noise:
    """The noise of the marks (N, 2) of a fit.

    The covariance of an estimate with unknown noise is that of a Student distribution with nu degrees of freedom, its
    squares over nu - 2, so that NEES has the mean 1 for any nu.

    Args:
        given_px: what the user knows it to be; None to find it.
    """
    degrees, rounding = view.degrees_of_freedom, resolution_sigma(xy)
    if given_px is not None:
        return Noise(given_px, given_px**2, "as given")
    if degrees < MIN_DEGREES:
        found = np.sqrt(view.squares / degrees) if degrees > 0.5 else 0.0
        sigma = max(float(found), HAND_SIGMA_PX)
        text = f"{degrees:.0f} degrees of freedom do not tell the noise: {sigma:.2g} px, as of a mark by hand, is taken"
        return Noise(sigma, sigma**2, text)
    sigma = float(np.sqrt(view.squares / degrees))
    if sigma < rounding:
        return Noise(rounding, rounding**2, "the rounding of the marks, which the residuals are below")
    # of numbers themselves: exact data have sigmas as well
    floor = float(np.finfo(float).eps * np.abs(xy).max(initial=1.0))
    return Noise(
        max(sigma, floor), max(view.squares / (degrees - 2.0), floor**2), f"residuals, {degrees:.0f} degrees of freedom"
    )


# --------------------------------------------------------------------------------------------- which points are wrong


def deletion_statistics(view: OneView, given_px: float | None = None) -> tuple[Array, Array]:
    """How far each point is from where all others put it: F statistics (N,), and its distance from there, px (N,).

    For a point that was fitted it is as if it had not been: r^T (I - H)^-1 r over the noise of the rest, where H is its
    own block of the projector on the slopes (Cook and Weisberg, "Residuals and Influence in Regression", 1982; Baarda's
    data snooping). NaN where it alone holds a combination of the unknowns, so that nothing can check it; infinite where
    the lens does not see it.
    """
    cofactor = inverse(view.information)
    count, degrees = len(view.residual), view.degrees_of_freedom
    statistic, distance = np.full(count, np.nan), np.full(count, np.nan)
    if cofactor is None:
        return statistic, distance
    is_seen = np.asarray(np.isfinite(view.residual).all(1), bool)
    statistic[~is_seen], distance[~is_seen] = np.inf, np.inf
    leverage = view.slope @ cofactor @ view.slope.swapaxes(1, 2) / view.noise_px**2
    spread = np.eye(2) - np.where(view.is_used, 1.0, -1.0)[:, None, None] * leverage
    spread[~is_seen] = np.eye(2)
    is_checked = is_seen & (np.linalg.eigvalsh(spread)[:, 0] > _UNCHECKED)
    spread, residual, used = spread[is_checked], view.residual[is_checked], view.is_used[is_checked]
    # r^T S^-1 r is the same square for both kinds: of a fitted point S is I - H, of another I + H
    solved = np.linalg.solve(spread, residual[:, :, None])[..., 0]
    square = (residual * solved).sum(1)
    rest = np.where(used, degrees - 2.0, degrees)
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = np.where(used, np.maximum(view.squares - square, 0.0), view.squares) / np.maximum(rest, 0.0)
    if given_px is not None:
        variance = np.full(len(square), given_px**2)
    variance = np.where(rest >= 1.0 if given_px is None else rest > -np.inf, variance + _EXACT_PX**2, np.nan)
    statistic[is_checked] = 0.5 * square / variance
    distance[is_checked] = np.linalg.norm(np.where(used[:, None], solved, residual), axis=1)
    return statistic, distance


def wrong_limit(num_points: int, degrees: float, *, is_noise_given: bool) -> float:
    """The F statistic beyond which a point of ``num_points`` is wrong: a false alarm in a thousand pictures."""
    chance, degrees = _FALSE_ALARM / num_points, 1e9 if is_noise_given else max(degrees, 1.0)
    # with two degrees above, the distribution function of F has a closed form: (1 + 2 x / d)^(-d / 2) is left
    return 0.5 * degrees * math.expm1(-2.0 * math.log(chance) / degrees)


def without_wrong_points(view: OneView, refit: Refit, given_px: float | None) -> OneView:
    """The fit to the points that agree: the worst is left aside, others come back, until none changes.

    Args:
        view: a fit to points that mostly agree.
        refit: the fit to other points, from a start.
        given_px: the noise where the user knows it.
    """
    count = len(view.is_used)
    seen = {view.is_used.tobytes()}
    for _ in range(2 * count):
        statistic, _ = deletion_statistics(view, given_px)
        degrees = view.degrees_of_freedom
        inside = wrong_limit(count, degrees - 2.0, is_noise_given=given_px is not None)
        outside = wrong_limit(count, degrees, is_noise_given=given_px is not None)
        is_used = view.is_used.copy()
        worst = np.where(view.is_used, np.nan_to_num(statistic, nan=0.0), 0.0)
        if worst.max() > inside and degrees - 2.0 >= MIN_DEGREES - 2.0:
            # of many at once only those that are nearly as bad: a bad one makes its neighbours look bad
            is_used &= ~(worst >= max(inside, _AS_BAD * worst.max()))
        else:
            is_used |= ~view.is_used & (statistic < outside)
        if is_used.tobytes() in seen:
            break
        seen.add(is_used.tobytes())
        view = refit(view, is_used)
    return view


def misfit_under(variance: float) -> Callable[[OneView], float]:
    """Of a fit, the sum of the squared residuals of all points, each no more than three sigmas of a noise allow."""
    limit = 18.0 * max(variance, np.finfo(float).tiny)

    def misfit(view: OneView) -> float:
        squares = (view.residual**2).sum(1)
        return float(np.minimum(np.where(np.isfinite(squares), squares, np.inf), limit).sum())

    return misfit


def with_noise(view: OneView, noise: Noise) -> Array | None:
    """(F + 6, F + 6) covariance of the free parameters and the pose; None if the points leave one of them open."""
    prior = view.prior_information
    rows = replace(view, noise_px=1.0, prior_information=np.zeros_like(prior)).information
    return inverse(rows / noise.variance + prior)
