"""Distortion, focal length, principal point and the directions of built worlds, from lines, by least squares.

What is minimised are distances in the photograph: of the points of each line from the best image of a line through its
vanishing point, or from the best of any line where it belongs to no direction. That best line is found anew for each
trial of the unknowns (variable projection, Golub and Pereyra 1973), so lines are no unknowns. Lines count less the
worse they fit (Geman and McClure 1985).

The covariance is that of clustered errors (the sandwich of White 1980, Liang and Zeger 1986): lines of one direction in
one part of the picture are the edges of one thing, and count as one witness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.line_edges import KNOTS, Arcs
from sfmapp.calibration.line_planes import DivisionLens, distances, fit_lines, fit_planes
from sfmapp.calibration.vanishing import SIGMA_BUILT, SIGMA_PX
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# The unknowns of the camera: strength of the distortion, logarithm of the focal length, principal point; the last two
# in units of R.
STRENGTH, LOG_FOCAL, CENTER_X, CENTER_Y, NUM_CAMERA = 0, 1, 2, 3, 4
# A line that is off by this many sigmas has lost three quarters of its weight.
_LOST_AT = 2.5
# Parts along the sides of a picture in which lines of a direction count as one witness.
_CELLS = 5
# Between two places of a numeric derivative; the unknowns are of order one.
_STEP = 2e-5
_MOST_ROUNDS = 25


@dataclass(frozen=True)
class World:
    """The directions of the world in one photograph.

    Attributes:
        rotation: (3, 3), column k is the axis k in the camera.
        extra_axis: the axis that further directions are at right angles to, -1 without any.
        extra_angles: (E,) radians of further directions about that axis, from the next axis on.
    """

    rotation: Array
    extra_axis: int = -1
    extra_angles: tuple[float, ...] = ()

    @property
    def directions(self) -> Array:
        """(3 + E, 3) unit directions in the camera."""
        axes = self.rotation.T
        if not self.extra_angles:
            return axes
        first, second = axes[(self.extra_axis + 1) % 3], axes[(self.extra_axis + 2) % 3]
        angles = np.array(self.extra_angles)[:, None]
        return np.concatenate([axes, np.cos(angles) * first + np.sin(angles) * second])

    def moved(self, step: Array) -> World:
        """Turned by step[:3] (axis times radians) with the further angles changed by the rest."""
        angles = tuple(float(a + d) for a, d in zip(self.extra_angles, step[3:], strict=True))
        return World(rigid3.exp_so3(step[:3]) @ self.rotation, self.extra_axis, angles)


@dataclass(frozen=True)
class Lines:
    """The arcs of one photograph in a problem, and what each is taken for.

    Attributes:
        arcs: of the photograph.
        world: None where no directions are known: lines are straight, and no more.
        member: (N,) the direction of each line, -1 for none.
    """

    arcs: Arcs
    world: World | None
    member: Ints

    def sigma_px(self, pixel_scale: float) -> Array:
        """(N,) what a line's points may be off by."""
        is_built = self.member >= 0
        sigma: Array = np.hypot(SIGMA_PX * pixel_scale, is_built * SIGMA_BUILT * self.arcs.length_px / np.sqrt(12.0))
        return sigma


@dataclass(frozen=True)
class Solution:
    """Where the unknowns came to rest.

    Attributes:
        camera: (4,) the unknowns of the camera, see the module.
        photos: with their worlds.
        covariance: (4, 4) of the camera's unknowns, the priors included; NaN where nothing determines them.
    """

    camera: Array
    photos: tuple[Lines, ...]
    covariance: Array


@dataclass(frozen=True)
class Problem:
    """What does not change while unknowns are sought.

    Attributes:
        width, height: of the photographs.
        is_free: (4,) bool, which unknowns of the camera are sought.
        prior_sigma: (4,) of the camera's unknowns about ``prior``; infinite for none.
        prior: (4,).
        pixel_scale: errors of edges in pixels, over those of a photograph of usual size.
    """

    width: int
    height: int
    is_free: NDArray[np.bool_]
    prior_sigma: Array
    prior: Array
    pixel_scale: float = 1.0

    @property
    def radius_px(self) -> float:
        return 0.5 * float(np.hypot(self.width, self.height))

    def lens(self, camera: Array) -> DivisionLens:
        """The lens of the camera's unknowns."""
        middle = np.array([self.width, self.height]) / 2.0
        return DivisionLens(float(camera[STRENGTH]), middle + camera[CENTER_X:] * self.radius_px, self.radius_px)


def vanishing_points(directions: Array, focal: float) -> Array:
    """(D, 3) vanishing points of directions (D, 3) for a focal length in units of R."""
    return directions / [1.0, 1.0, focal]


@dataclass(frozen=True)
class _Fit:
    """The lines of a photograph at given unknowns, in groups: those that are free and those of a direction.

    Attributes:
        residuals: (N, KNOTS) distances in sigmas, over sqrt(KNOTS): a line's square sum is its mean squared distance.
        groups: of each group the lines (indices), the coefficients of their normals, and the tangents.
    """

    residuals: Array
    groups: tuple[tuple[NDArray[np.intp], Array, Array], ...]


def _groups_of(photo: Lines) -> list[NDArray[np.intp]]:
    free = photo.member < 0
    return [group for group in (np.flatnonzero(free), np.flatnonzero(~free)) if len(group)]


def _vanishing_of(camera: Array, photo: Lines, group: NDArray[np.intp]) -> Array | None:
    member = photo.member[group]
    if photo.world is None or member[0] < 0:
        return None
    points: Array = vanishing_points(photo.world.directions, float(np.exp(camera[LOG_FOCAL])))[member]
    return points


def _scale(problem: Problem, photo: Lines) -> Array:
    scale: Array = 1.0 / (np.sqrt(KNOTS) * photo.sigma_px(problem.pixel_scale)[:, None])
    return scale


def _fit(problem: Problem, camera: Array, photo: Lines) -> _Fit:
    """The best lines at given unknowns."""
    residuals, groups = np.empty(photo.arcs.points.shape[:2]), []
    for group in _groups_of(photo):
        fitted = fit_lines(problem.lens(camera), photo.arcs.points[group], _vanishing_of(camera, photo, group))
        residuals[group] = fitted.residuals
        groups.append((group, fitted.coefficients, fitted.tangents))
    return _Fit(residuals * _scale(problem, photo), tuple(groups))


def _derivative(problem: Problem, fit: _Fit, ahead: tuple[Array, Lines], behind: tuple[Array, Lines]) -> Array:
    """(N, KNOTS) difference of the residuals between two places close by, less what other normals make good (Kaufman's
    form of variable projection, 1975)."""
    result = np.empty_like(fit.residuals)
    for group, coefficients, tangents in fit.groups:
        sides = []
        for camera, photo in (ahead, behind):
            vanishing = _vanishing_of(camera, photo, group)
            sides.append(distances(problem.lens(camera), photo.arcs.points[group], vanishing, coefficients))
        change = sides[0] - sides[1]
        result[group] = change - np.einsum("nkt,nt->nk", tangents, np.einsum("nkt,nk->nt", tangents, change))
    scaled: Array = result * _scale(problem, ahead[1])
    return scaled


def _weights(residuals: Array) -> Array:
    weights: Array = 1.0 / (1.0 + (residuals**2).sum(1) / _LOST_AT**2) ** 2
    return weights


def _cost(fits: Sequence[_Fit]) -> float:
    """The loss of which the weights are the derivative."""
    total = 0.0
    for fit in fits:
        x = (fit.residuals**2).sum(1)
        total += float((x / (1.0 + x / _LOST_AT**2)).sum())
    return total


def solve(problem: Problem, camera: Array, photos: Sequence[Lines]) -> Solution:
    """Levenberg and Marquardt's method from a start, and the covariance where it ends."""
    camera, photos = camera.copy(), list(photos)
    damping = 1e-4
    fits = [_fit(problem, camera, photo) for photo in photos]
    cost = _cost(fits) + _prior_cost(problem, camera)
    for _ in range(_MOST_ROUNDS):
        hessian, gradient, _, free = _normal_equations(problem, camera, photos, fits)
        is_better = False
        for _ in range(6):
            damped = hessian + damping * np.diag(np.maximum(np.diag(hessian), 1e-12))
            step: Array = -np.linalg.lstsq(damped, gradient, rcond=None)[0].astype(np.float64)
            new_camera, new_photos = _moved(camera, photos, step, free)
            new_fits = [_fit(problem, new_camera, photo) for photo in new_photos]
            new_cost = _cost(new_fits) + _prior_cost(problem, new_camera)
            if np.isfinite(new_cost) and new_cost <= cost:
                is_better = True
                break
            damping *= 10.0
        if not is_better:
            break
        gained, cost = cost - new_cost, new_cost
        camera, photos, fits, damping = new_camera, new_photos, new_fits, max(damping / 10.0, 1e-9)
        if gained < 1e-5 * max(cost, 1.0):
            break
    return Solution(camera, tuple(photos), covariance_of(problem, camera, photos))


def _prior_cost(problem: Problem, camera: Array) -> float:
    return float((((camera - problem.prior) / problem.prior_sigma) ** 2).sum())


def _moved(camera: Array, photos: Sequence[Lines], step: Array, free: Ints) -> tuple[Array, list[Lines]]:
    camera = camera.copy()
    camera[free] += np.clip(step[: len(free)], -0.3, 0.3)
    at, moved = len(free), []
    for photo in photos:
        if photo.world is None:
            moved.append(photo)
            continue
        size = 3 + len(photo.world.extra_angles)
        moved.append(replace(photo, world=photo.world.moved(np.clip(step[at : at + size], -0.3, 0.3))))
        at += size
    return camera, moved


def _normal_equations(
    problem: Problem, camera: Array, photos: Sequence[Lines], fits: Sequence[_Fit]
) -> tuple[Array, Array, Array, Ints]:
    """Hessian (P, P), gradient (P,), gradients of the witnesses (W, P), and which unknowns of the camera are free."""
    free = np.flatnonzero(problem.is_free)
    sizes = [0 if photo.world is None else 3 + len(photo.world.extra_angles) for photo in photos]
    num = len(free) + sum(sizes)
    hessian, gradient, witnesses = np.zeros((num, num)), np.zeros(num), []
    at = len(free)
    for photo, fit, size in zip(photos, fits, sizes, strict=True):
        r, weights = fit.residuals, _weights(fit.residuals)
        jacobian = np.empty((*r.shape, len(free) + size))
        for k, unknown in enumerate(free):
            shift = np.zeros(NUM_CAMERA)
            shift[unknown] = 0.5 * _STEP
            jacobian[..., k] = _derivative(problem, fit, (camera + shift, photo), (camera - shift, photo)) / _STEP
        for k in range(size):
            step = np.zeros(size)
            step[k] = 0.5 * _STEP
            assert photo.world is not None
            ahead, behind = (replace(photo, world=photo.world.moved(s)) for s in (step, -step))
            jacobian[..., len(free) + k] = _derivative(problem, fit, (camera, ahead), (camera, behind)) / _STEP
        where = np.concatenate([np.arange(len(free)), np.arange(at, at + size)]).astype(np.intp)
        at += size
        hessian[np.ix_(where, where)] += np.einsum("n,nki,nkj->ij", weights, jacobian, jacobian)
        each = np.einsum("n,nki,nk->ni", weights, jacobian, r)
        gradient[where] += each.sum(0)
        groups = np.unique(_witness_of(problem, photo), return_inverse=True)[1]
        summed = np.zeros((groups.max(initial=-1) + 1, num))
        for k, column in enumerate(where):
            summed[:, column] = np.bincount(groups, each[:, k], len(summed))
        witnesses.append(summed)
    for k, unknown in enumerate(free):
        hessian[k, k] += problem.prior_sigma[unknown] ** -2
        gradient[k] += (camera[unknown] - problem.prior[unknown]) * problem.prior_sigma[unknown] ** -2
    return hessian, gradient, np.concatenate(witnesses), free


def _witness_of(problem: Problem, photo: Lines) -> Ints:
    """(N,) a number for each line, the same for lines of one direction in one part of the picture."""
    middle = photo.arcs.points.mean(1) / [problem.width, problem.height]
    cell = np.clip((middle * _CELLS).astype(np.int64), 0, _CELLS - 1)
    witness: Ints = (photo.member + 1) * _CELLS**2 + cell[:, 0] * _CELLS + cell[:, 1]
    return witness


def covariance_of(problem: Problem, camera: Array, photos: Sequence[Lines]) -> Array:
    """(4, 4) covariance of the camera's unknowns, zero for those that are held."""
    fits = [_fit(problem, camera, photo) for photo in photos]
    hessian, _, witnesses, free = _normal_equations(problem, camera, photos, fits)
    result = np.zeros((NUM_CAMERA, NUM_CAMERA))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    values, vectors = np.linalg.eigh(hessian * np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T * np.outer(scale, scale)
    num = int((np.abs(witnesses).sum(1) > 0).sum())
    # few witnesses understate the spread
    factor = num / max(num - hessian.shape[0], 1)
    middle = factor * witnesses.T @ witnesses
    middle[np.arange(len(free)), np.arange(len(free))] += problem.prior_sigma[free] ** -2.0
    result[np.ix_(free, free)] = (inverse @ middle @ inverse)[: len(free), : len(free)]
    return result


def straightness_px(lens: DivisionLens, arcs: Arcs) -> Array:
    """(N,) rms distance in pixels of the points of each line from the best image of a straight one."""
    return fit_planes(lens, arcs.points)[2]
