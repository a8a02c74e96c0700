"""One photograph against points with known places: least squares over its pose and, where they are free, its lens.

What is asked of such a fit is not only where it ends but how sure each number is, and which single point the others
contradict; both need the slopes of all residuals, which are few here, so everything stands in plain dense arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.one_view_kernels import (
    POSE,
    Problem,
    deletions,
    descend,
    slope_changes,
    slopes,
)
from sfmapp.camera.camera import Camera
from sfmapp.camera.models import canonical_from_params
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3
from sfmapp.geometry.damped import invert

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

MIN_DEGREES = 5
"""Fewer numbers than this beyond the unknowns do not tell the noise."""
HAND_SIGMA_PX = 1.0
"""Standard deviation of a coordinate that a hand has marked, where the residuals are too few to tell."""

# Chance that any of the good points of a picture is taken for a wrong one.
_FALSE_ALARM = 1e-3
# Condition, by Frobenius' norm, of a system scaled to a unit diagonal, beyond which rounding leaves no digit of it.
_OPEN = 1e13
# Of the worst statistic: points that go together with it, so that thousands of matches do not take thousands of fits.
_AS_BAD = 0.5


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

    @cached_property
    def squares(self) -> float:
        """Sum of the squared residuals that were fitted, square pixels."""
        return float((self.residual[self.is_used] ** 2).sum())

    @cached_property
    def point_information(self) -> Array:
        """(F + 6, F + 6) by the points, if their coordinates have a standard deviation of one pixel."""
        rows = self.slope[self.is_used].reshape(-1, self.num_unknown)
        total: Array = rows.T @ rows
        return total

    @cached_property
    def cofactor(self) -> Array | None:
        """(F + 6, F + 6) inverse of the information by points and prior; None if they leave something open."""
        return inverse(self.point_information / self.noise_px**2 + self.prior_information)

    @cached_property
    def degrees_of_freedom(self) -> float:
        """Measured numbers less the unknowns that they have to tell: a prior takes its share of these."""
        degrees = 2.0 * float(self.is_used.sum()) - self.num_unknown
        if self.cofactor is None:
            return degrees
        return degrees + float((self.cofactor * self.prior_information).sum())


Refit = Callable[[OneView, Bools], OneView]


def inverse(information: Array) -> Array | None:
    """The inverse of a symmetric matrix, scaled before by its diagonal; None if it has none to working precision."""
    found = np.empty_like(information)
    return found if invert(np.ascontiguousarray(information), _OPEN, found) else None


@cache
def _canonical_from(model: CameraModel) -> Array:
    return np.ascontiguousarray(canonical_from_params(model))


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
    problem = _problem(camera, points, is_used, free, prior, noise_px)
    descend(problem, params, rotation, translation)
    count = len(is_used)
    residual, slope = np.empty((count, 2)), np.empty((count, 2, len(problem.free) + POSE))
    slopes(problem, params, rotation, translation, slope, residual)
    pose = rigid3.from_matrix(rotation, translation)
    squares = float((residual[is_used] ** 2).sum())
    pull = 0.0 if prior is None else float(((prior.rows @ (params - prior.params)) ** 2).sum())
    cost = 0.5 * (squares / noise_px**2 + pull) if math.isfinite(squares) else math.inf
    fitted = camera.with_params(params) if len(problem.free) else camera
    return OneView(fitted, pose, free, residual, slope, is_used, _of_prior(prior, free), cost, noise_px)


def _problem(
    camera: Camera, points: tuple[Array, Array], is_used: Bools, is_free: Bools, prior: Prior | None, noise_px: float
) -> Problem:
    num = len(camera.params)
    return Problem(
        _canonical_from(camera.model), camera.family, np.flatnonzero(is_free), np.ascontiguousarray(points[0]),
        np.ascontiguousarray(points[1]), np.ascontiguousarray(is_used),
        np.zeros(num) if prior is None else np.array(prior.params),
        np.zeros((0, num)) if prior is None else np.array(prior.rows), float(noise_px),
        float(camera.width) if camera.model == CameraModel.EQUIRECTANGULAR else 0.0,
    )  # fmt: skip


def _of_prior(prior: Prior | None, is_free: Bools) -> Array:
    """(F + 6, F + 6) information of a prior."""
    num = int(is_free.sum())
    information = np.zeros((num + POSE, num + POSE))
    if prior is not None:
        information[:num, :num] = prior.rows[:, is_free].T @ prior.rows[:, is_free]
    return information


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
    # binary fractions, such as centres at halves, count as they are
    scaled = 2.0 * xy.ravel() * 10.0 ** np.arange(7.0)[:, None]
    is_whole = np.abs(scaled - np.round(scaled)).max(axis=1, initial=0.0) < 1e-6
    return float(10.0 ** -int(np.argmax(is_whole)) / math.sqrt(12.0)) if is_whole.any() else 0.0


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
    count = len(view.residual)
    statistic, distance = np.full(count, np.nan), np.full(count, np.nan)
    if view.cofactor is not None:
        deletions(
            view.slope, view.residual, view.is_used, view.cofactor / view.noise_px**2, view.degrees_of_freedom,
            view.squares, given_px or 0.0, statistic, distance,
        )  # fmt: skip
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
    return inverse(view.point_information / noise.variance + view.prior_information)


def bent_covariance(view: OneView, noise: Noise, points: tuple[Array, Array]) -> Array | None:
    """Covariance (F + 6, F + 6) with what the curvature of the projection adds to it; None where a point leaves the
    lens's sight within a sigma, or the points leave something open.

    Of twenty points and fourteen unknowns squared errors are a tenth above the first order, of fourteen points 60 %,
    while the residuals are as flat as they should be (parameter-effects curvature; Bates and Watts, "Relative curvature
    measures of nonlinearity", JRSS B, 1980). Two terms, both of the fourth order in the noise. With x = x0 + A t +
    1/2 B t t, t normal, that in B has the covariance 1/2 sum B_ab B_ab^T, where B_ab = -J^+ (the change of J along A_a)
    A_b. And the slopes J are those of the estimate, not of the truth a sigma beside it, where a combination may be
    known less well: so the first order is taken in the mean over the places x +- A_a, sum over a of (C(x + A_a) +
    C(x - A_a) - 2 C) / 2.
    """
    covariance = with_noise(view, noise)
    if covariance is None:
        return None
    scale = np.sqrt(np.diag(covariance))
    root = scale[:, None] * np.linalg.cholesky(covariance / scale[:, None] / scale)
    rows = view.slope[view.is_used].reshape(-1, len(root))
    ahead, back = (slopes_aside(view, points, step * root) for step in (1.0, -1.0))
    if view.cofactor is None or not (np.isfinite(ahead).all() and np.isfinite(back).all()):
        return covariance
    curves, places = spread_of_curves(view, ahead, back, root), spread_of_places(rows, ahead, back, root, noise)
    bent: Array = covariance + curves + root @ places @ root.T
    return bent


def spread_of_curves(view: OneView, ahead: Array, back: Array, root: Array) -> Array:
    """(F + 6, F + 6) 1/2 sum B_ab B_ab^T of :func:`bent_covariance`, by the changes of slopes along +- ``root``."""
    num, rows = len(root), view.slope[view.is_used].reshape(-1, len(root))
    assert view.cofactor is not None
    # the change of J along each A_a, by its unknowns
    along = (0.5 * (ahead - back) @ root).reshape(-1, num * num)
    bend = -(view.cofactor @ rows.T @ along).reshape(num, num, num) / view.noise_px**2
    # two motions in turn are not their sum: exp(w') (exp(w) x + v) + v' turns by w + w' + w' x w / 2, moves by
    # v + v' + w' x v
    turn, shift = root[-POSE:-3], root[-3:]
    bend[-POSE:-3] -= 0.5 * (rigid3.skew(turn.T) @ turn).swapaxes(0, 1)
    bend[-3:] -= (rigid3.skew(shift.T) @ turn).swapaxes(0, 1)
    bend = bend.reshape(num, -1)
    found: Array = 0.5 * bend @ bend.T
    return found


def slopes_aside(view: OneView, points: tuple[Array, Array], steps: Array) -> Array:
    """(2 N, K, F + 6) changes of the slopes of the N points that are used along steps (F + 6, K)."""
    changes = np.empty((*view.residual.shape, steps.shape[1], view.num_unknown))
    slope_changes(
        _problem(view.camera, points, view.is_used, view.is_free, None, view.noise_px), view.camera.params.copy(),
        rigid3.rotation_matrix(view.cam_from_world), view.cam_from_world[4:].copy(), np.ascontiguousarray(steps.T),
        view.slope, changes,
    )  # fmt: skip
    found: Array = changes[view.is_used].reshape(-1, steps.shape[1], view.num_unknown)
    return found


def spread_of_places(rows: Array, ahead: Array, back: Array, root: Array, noise: Noise) -> Array:
    """(K, K) what the covariance gains in the mean over places a sigma aside, in units of ``root``; nothing along what
    it would lose there."""
    num = len(root)
    gain = np.zeros((num, num))
    plain = rows @ root
    here = plain.T @ plain
    for changes in (ahead, back):
        there = (rows[:, None] + changes).swapaxes(0, 1) @ root
        information = np.eye(num) + (there.swapaxes(1, 2) @ there - here) / noise.variance
        gain += 0.5 * (np.linalg.inv(information) - np.eye(num)).sum(0)
    values, vectors = np.linalg.eigh(0.5 * (gain + gain.T))
    found: Array = vectors * np.maximum(values, 0.0) @ vectors.T
    return found
