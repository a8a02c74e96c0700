"""How far two cameras have turned against each other since they were calibrated, by matches of one pair.

Where the calibration holds, matches of a rectified pair lie on common rows. A right camera that has turned by w since,
and a baseline whose direction has, move them off by ``w_z x - w_x (1 + y^2) + w_y x y`` and by what grows with the
disparity (normalised image points). Four of these five numbers show in rows that differ as a whole or along x; a turn
about the vertical, the one that falsifies depths, shows only in the four corners. So matches are refined to some
hundredths of a pixel (:mod:`sfmapp.stereo.alignment`), and what a pair does not tell is held at the calibration's, with
its sigma said.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.fit import CAUCHY_SIGMAS, cauchy, inverse_or_none, minimize, robust_sigma
from sfmapp.geometry.fundamental import sampson_jacobian
from sfmapp.stereo.result import RectifiedGeometry
from sfmapp.stereo.sparse_matches import PairMatches

Array = NDArray[np.float64]

# before a pair is looked at: a rig that was knocked turns by tenths of a degree, the direction of a baseline with it
_PRIOR_RAD = np.radians(0.5)
# matches that a fit of five numbers is asked to rest on, and cells of the picture that are left out in turn
_LEAST_MATCHES, _CELLS, _ROUNDS = 60, (4, 3), 30
# chi-square of five degrees of freedom that chance exceeds once in a thousand; and what one number has to be, in sigmas
_CHANCE, _TOLD_SIGMAS = 20.5, 3.0
# of what is found: rows of rendered pairs were pulled together by so much, and by less now (stereo/alignment.py)
_SYSTEMATIC = 0.05
# what it may leave of all disparities, pixels: long lenses show a turn about the vertical in fractions of a row, and it
# moves disparities by pixels
_WORST_SHIFT_PX = 0.5
# a turn beyond this is no calibration that has drifted: it is another rig's
_LARGEST_DEG = 3.0
# What of a lens's decentring is not known bends rows as a turn about the vertical does, p2 by half of it: after a good
# calibration that is 1e-4. A pattern beyond the next number is taken for the lens's: rectified pairs of KITTI's have
# one of 0.6 degrees, where a turn of that size would put their horizon at 45 m.
_LENS_RAD, _LARGEST_ABOUT_Y_DEG = 2e-4, 0.3
# the one number that disparities hang on: the turn about y
_ABOUT_Y = 1
# A rig that turned did so about any axis as likely as about another: what it did about two tells the usual size of the
# third, in a ratio that Student's t of two degrees of freedom has. Its 95 per cent over those of a Gaussian.
_STUDENT = 4.303 / 1.960


@dataclass(frozen=True)
class Misalignment:
    """Of the right camera of a rectified pair against the calibration, in the rectified frame: x along the baseline,
    y down, z forward.

    Attributes:
        turn_deg: (3,) rotation vector that takes directions of the calibrated right camera's frame to those of the true
            one. direction_deg: (2,) by how much the baseline's direction has moved along y and z.
        sigma_deg: (5,) of these five, by leaving cells of the picture out in turn; of numbers that were held, of what
            the pair leaves open. For the turn about y that is narrowed by what the rig did about the other two axes.
        is_told: (5,) bool: the pair tells it, and it is in the correction; the others are held at the calibration's.
        is_significant: the calibration does not hold: five numbers explain what chance does once in a thousand times,
            on matches of cells that they were not fitted to as well, and one of them is beyond three of its sigmas.
        num_matches: that it rests on. rms_px: of y_left - y_right before and after the correction, without gross ones.
    """

    turn_deg: Array
    direction_deg: Array
    sigma_deg: Array
    is_told: NDArray[np.bool_]
    is_significant: bool
    num_matches: int
    rms_px: tuple[float, float]

    @property
    def moved_rows_px(self) -> float:
        """By how much it moves rows, by what it takes out of their differences."""
        return math.sqrt(max(self.rms_px[0] ** 2 - self.rms_px[1] ** 2, 0.0))

    @property
    def is_turn(self) -> bool:
        """It is as small as turns of rigs are about the vertical, so that disparities may be corrected for it; what is
        not shows in rows alone."""
        return bool(abs(self.turn_deg[_ABOUT_Y]) <= _LARGEST_ABOUT_Y_DEG)

    def source_rows(self, geometry: RectifiedGeometry) -> Array:
        """(H, W) y of the right picture that belongs into each pixel of it for rows to agree; x stays."""
        g = geometry
        y, x = np.mgrid[: g.height, : g.width] + 0.5
        x, wanted = (x - g.cx - g.doffs) / g.focal, (y - g.cy) / g.focal
        turn = rigid3.exp_so3(np.radians(self.turn_deg))
        found = wanted
        for _ in range(3):
            aligned = np.stack([x, found, np.ones_like(x)], -1) @ turn  # by its transpose
            found = found + wanted - aligned[..., 1] / aligned[..., 2]
        rows: Array = found * g.focal + g.cy
        return rows

    @property
    def is_foreign(self) -> bool:
        """It is larger than any rig drifts: the calibration is of another one."""
        return bool(np.linalg.norm(self.turn_deg) > _LARGEST_DEG)

    def right_from_left(self, baseline: float) -> Array:
        """(7,) pose of the true right camera in the frame of the rectified left one."""
        numbers = np.radians(np.concatenate([self.turn_deg, self.direction_deg]))
        rotation, center = rigid3.exp_so3(numbers[:3]), _center(numbers)
        return rigid3.from_matrix(rotation, -rotation @ center * (baseline / np.linalg.norm(center)))


def measure_misalignment(
    matches: PairMatches, geometry: RectifiedGeometry, *, has_direction: bool = True
) -> Misalignment | None:
    """What matches of a rectified pair, refined, say against its calibration; None where there are too few.
    ``has_direction``: the baseline's direction may have moved as well, else the right camera alone has turned.

    The five numbers are those of the least Sampson error under Cauchy's loss, with a prior of half a degree each.
    """
    g = geometry
    left = (matches.left - [g.cx, g.cy]) / g.focal
    right = (matches.right - [g.cx + g.doffs, g.cy]) / g.focal
    kept = _plausible(left, right)
    if kept.sum() < _LEAST_MATCHES:
        return None
    left, right = left[kept], right[kept]
    cells = _cells(left)
    scale = 1.0 / g.focal
    free = np.array([True, True, True, has_direction, has_direction])
    step, noise = _fitted(left, right, free, scale)
    sigma = _sigmas(left, right, cells, free, (step, noise))
    told = np.abs(step) > _TOLD_SIGMAS * sigma
    # a rig that evidently turned about the other axes has turned about this one too; of one that did not, the lens may
    # be what is seen
    has_turned = bool(np.abs(step[[0, 2]]).max() > _TOLD_SIGMAS * _LENS_RAD)
    told[_ABOUT_Y] &= has_turned or abs(step[_ABOUT_Y]) > _TOLD_SIGMAS * _LENS_RAD
    told[_ABOUT_Y] &= sigma[_ABOUT_Y] * g.focal < _WORST_SHIFT_PX
    # what shows in rows as a whole is told by any pair; the others are left alone where they may be nothing
    free = np.array([True, bool(told[_ABOUT_Y]), True, bool(told[3]), bool(told[4])]) & free
    by_rows = step[_ABOUT_Y]
    if not free.all():
        step, noise = _fitted(left, right, free, scale)
        sigma = np.where(free, _sigmas(left, right, cells, free, (step, noise)), sigma)
    sigma = np.hypot(sigma, _SYSTEMATIC * np.abs(step))
    sigma[_ABOUT_Y] = np.hypot(sigma[_ABOUT_Y], _LENS_RAD)
    if not free[_ABOUT_Y]:
        sigma[_ABOUT_Y] = _left_open(float(by_rows), float(sigma[_ABOUT_Y]), step[[0, 2]])
    is_significant = bool((np.abs(step) > _TOLD_SIGMAS * sigma)[free].any())
    is_significant &= _held_out_gain(left, right, cells, free, noise) > _CHANCE
    rms = tuple(
        float(g.focal * np.sqrt(2.0) * robust_sigma(_squared(at, left, right), 1)) for at in (np.zeros(5), step)
    )
    return Misalignment(
        np.degrees(step[:3]), np.degrees(step[3:]), np.degrees(sigma), free, is_significant, len(left),
        (rms[0], rms[1]),
    )  # fmt: skip


def _left_open(by_rows: float, sigma: float, others: Array) -> float:
    """Root of the mean square of a turn about the vertical that is held, when rows say ``by_rows`` +- ``sigma`` of it
    and the rig turned by ``others`` (2,) about the other axes: of the product of both Gaussians, about zero."""
    prior = _STUDENT * float(np.sqrt(np.mean(others**2)))
    share = prior**2 / (prior**2 + sigma**2)
    return float(np.sqrt(share * sigma**2 + (share * by_rows) ** 2))


def _slopes(numbers: Array) -> Array:
    """(6, 3, 3) E of turn and direction (5,), and its derivatives by them: with the right camera at c of the left one,
    [-R c]x R = -R [c]x."""
    rotation, center = rigid3.exp_so3(numbers[:3]), rigid3.skew(_center(numbers))
    turns = [-rigid3.skew(axis) @ rotation @ center for axis in np.eye(3)]
    shifts = [-rotation @ rigid3.skew(axis) for axis in np.eye(3)[1:]]
    return np.stack([-rotation @ center, *turns, *shifts])


def _center(numbers: Array) -> Array:
    """(3,) of the right camera in the frame of the left one, its x component one."""
    return np.array([1.0, numbers[3], numbers[4]])


def _plausible(left: Array, right: Array) -> NDArray[np.bool_]:
    """Matches whose rows differ by no more than those of the others."""
    dy = left[:, 1] - right[:, 1]
    middle = np.median(dy) if len(dy) else 0.0
    spread = 1.4826 * float(np.median(np.abs(dy - middle))) if len(dy) else 0.0
    kept: NDArray[np.bool_] = np.abs(dy - middle) < max(6.0 * spread, 1e-4)
    return kept


def _squared(numbers: Array, left: Array, right: Array) -> Array:
    residual, _ = sampson_jacobian(_slopes(numbers)[0], np.zeros((0, 3, 3)), left, right)
    squared: Array = residual**2
    return squared


def _fitted(left: Array, right: Array, free: NDArray[np.bool_], scale: float) -> tuple[Array, float]:
    """The five numbers, those that are not free at zero, and the noise of a Sampson distance."""
    numbers = np.zeros(5)
    noise = max(robust_sigma(_squared(numbers, left, right), 1), 0.02 * scale)
    for _ in range(2):  # the noise is that about the fit
        linearize = partial(_linearized, left=left, right=right, free=free, noise=noise)
        numbers, _, _ = minimize(numbers, linearize, lambda at, step: np.asarray(at + step), _ROUNDS)
        noise = max(robust_sigma(_squared(numbers, left, right), 1), 0.02 * scale)
    return numbers, noise


def _linearized(
    numbers: Array, left: Array, right: Array, free: NDArray[np.bool_], noise: float
) -> tuple[float, Array, Array]:
    """Cost, and half its second and first derivatives, in squares of the noise; what is held has a prior of nothing."""
    slopes = _slopes(numbers)
    residual, jacobian = sampson_jacobian(slopes[0], slopes[1:], left, right)
    jacobian[:, ~free] = 0.0
    cost, weights = cauchy(residual**2 / noise**2, CAUCHY_SIGMAS)
    weighted = jacobian * (weights / noise**2)[:, None]
    hessian = weighted.T @ jacobian + np.eye(5) / _PRIOR_RAD**2
    return cost + float(numbers @ numbers) / _PRIOR_RAD**2, hessian, weighted.T @ residual + numbers / _PRIOR_RAD**2


def _cells(left: Array) -> NDArray[np.int64]:
    """(N,) in which cell of the picture each match lies; cells of as many matches each."""
    column = np.argsort(np.argsort(left[:, 0])) * _CELLS[0] // len(left)
    row = np.argsort(np.argsort(left[:, 1])) * _CELLS[1] // len(left)
    return np.asarray(row * _CELLS[0] + column)


def _one_step(
    left: Array, right: Array, kept: NDArray[np.bool_], free: NDArray[np.bool_], at: tuple[Array, float]
) -> Array:
    """The fit to some of the matches, one step from that to all: they differ by little."""
    numbers, noise = at
    _, hessian, gradient = _linearized(numbers, left[kept], right[kept], free, noise)
    return numbers - np.asarray(np.linalg.solve(hessian, gradient))


def _sigmas(
    left: Array, right: Array, cells: NDArray[np.int64], free: NDArray[np.bool_], at: tuple[Array, float]
) -> Array:
    """(5,) by leaving cells out in turn (Wu, "Jackknife, bootstrap and other resampling methods", 1986), for errors of
    neighbours are alike; not below what independent errors would make."""
    _, hessian, _ = _linearized(at[0], left, right, free, at[1])
    inverse = inverse_or_none(hessian)
    formal = np.full(5, _PRIOR_RAD) if inverse is None else np.sqrt(np.diag(inverse))
    without = np.array([_one_step(left, right, cells != one, free, at) for one in np.unique(cells)])
    count = len(without)
    spread = np.sqrt((count - 1) / count * ((without - without.mean(0)) ** 2).sum(0))
    sigma: Array = np.minimum(np.maximum(formal, spread), _PRIOR_RAD)
    return sigma


def _held_out_gain(left: Array, right: Array, cells: NDArray[np.int64], free: NDArray[np.bool_], noise: float) -> float:
    """By how much a fit to one half of the cells lowers the cost of the other half, both ways, in chi-square."""
    gain = 0.0
    for half in (0, 1):
        mine = (cells + cells // _CELLS[0]) % 2 == half  # as on a chessboard
        numbers, _ = _fitted(left[mine], right[mine], free, noise)
        before, after = (
            cauchy(_squared(at, left[~mine], right[~mine]) / noise**2, CAUCHY_SIGMAS)[0]
            for at in (np.zeros(5), numbers)
        )
        gain += before - after
    return gain
