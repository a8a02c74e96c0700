"""One photograph against points with known places: least squares over its pose and, where they are free, its lens.

What is asked of such a fit is not only where it ends but how sure each number is, and which single point the others
contradict; both need the slopes of all residuals, which are few here, so everything stands in plain dense arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as fisher

from sfmapp.camera.camera import Camera, project_jacobian
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3

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
    best = _linearized(camera, cam_from_world, points, is_used, free, prior, noise_px)
    damping = 1e-3
    for _ in range(_MAX_STEPS):
        if not np.isfinite(best.cost):
            break
        step = _step(best, prior, damping)
        tried = None
        if step is not None:
            params = best.camera.params.copy()
            params[free] += step[:-POSE]
            tried = _linearized(
                best.camera.with_params(params), moved(best.cam_from_world, step[-POSE:]), points, is_used, free, prior,
                noise_px,
            )  # fmt: skip
        if tried is not None and tried.cost <= best.cost:
            gain, best, damping = best.cost - tried.cost, tried, max(damping * 0.1, 1e-15)
            if gain <= _TOLERANCE * best.cost:
                break
        elif damping > 1e12:
            break
        else:
            damping = max(damping * 10.0, 1e-6)
    return best


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


def _step(view: OneView, prior: Prior | None, damping: float) -> Array | None:
    rows = view.slope[view.is_used].reshape(-1, view.num_unknown) / view.noise_px
    right = rows.T @ (view.residual[view.is_used].ravel() / view.noise_px)
    if prior is not None:
        right[:-POSE] -= prior.rows[:, view.is_free].T @ (prior.rows @ (view.camera.params - prior.params))
    normal = view.information
    diagonal = np.diag(normal).copy()
    if not (np.isfinite(normal).all() and (diagonal > 0.0).all()):
        return None
    scale = 1.0 / np.sqrt(diagonal)
    try:
        scaled = normal * scale[:, None] * scale + damping * np.eye(len(scale))
        solved: Array = scale * np.linalg.solve(scaled, scale * right)
    except np.linalg.LinAlgError:
        return None
    return solved if np.isfinite(solved).all() else None


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
    return float(fisher.isf(_FALSE_ALARM / num_points, 2, 1e9 if is_noise_given else max(degrees, 1.0)))


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


def with_noise(view: OneView, noise: Noise) -> Array | None:
    """(F + 6, F + 6) covariance of the free parameters and the pose; None if the points leave one of them open."""
    prior = view.prior_information
    rows = replace(view, noise_px=1.0, prior_information=np.zeros_like(prior)).information
    return inverse(rows / noise.variance + prior)
