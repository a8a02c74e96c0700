"""A gyroscope beside a camera: rotations predicted from it, and how it has to be read for the two to agree.

Angular rates are integrated between samples. Against rotations that a map has, they tell the offset between the clocks
(as in Kelly and Sukhatme, "A general framework for temporal calibration of multiple proprioceptive and exteroceptive
sensors", ISER 2010), and whether axes, sign, unit or mounting are other than they were given.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3
from sfmapp.simd.copying import copy_into

if TYPE_CHECKING:
    from sfmapp.images.sequence import Imu

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# No inertial sensor is slower than 10 Hz: a longer silence is a gap.
MAX_SILENCE_S = 0.1


def imu_rotation(imu: Imu, start_s: float, stop_s: float, gyro_bias: ArrayLike = (0.0, 0.0, 0.0)) -> Array | None:
    """Rotation (3, 3) of the rig's first camera from one moment to a later one: ``x_cam(stop) = R x_cam(start)``.

    Args:
        gyro_bias: (3,) rad/s, taken off the measurements.

    Returns:
        None where the measurements do not cover the time.
    """
    steps = imu_steps(imu, start_s, stop_s)
    if steps is None:
        return None
    turn = np.empty((3, 3))
    integrate_rotation(steps, np.asarray(gyro_bias, np.float64), turn)
    imu_from_cam = rigid3.rotation_matrix(imu.imu_from_cam)
    return np.asarray(imu_from_cam.T @ turn.T @ imu_from_cam)


class GyroTrust:
    """Whether the gyroscope has lately told the turn between frames better than a steady motion would have.

    A wrong axis, sign, unit or clock makes its predictions worse than none. Errors fade with a factor a frame, so that
    two seconds of film decide; a tie, and what nobody has seen yet, speak against it. What all errors have in common is
    its bias, which is taken off.
    """

    _FADE, _MIN_FRAMES, _MEMORY = 0.97, 5, 30

    def __init__(self) -> None:
        self._gyro, self._steady, self._seen = 0.0, 0.0, 0
        self._bias = np.zeros(3)  # radians a frame

    @property
    def is_better(self) -> bool:
        """The gyroscope's prediction is the one to use."""
        return self._seen >= self._MIN_FRAMES and self._gyro < self._steady

    def corrected(self, predicted: Array) -> Array:
        """A foretold turn (3, 3) without the bias."""
        return np.asarray(predicted @ rigid3.exp_so3(self._bias))

    def learn(self, predicted: Array, steady: Array, measured: Array) -> None:
        """Note the turns (3, 3) that both foretold for a frame, and the one that its image has shown."""
        errors = rigid3.log_so3(np.stack([predicted, steady]).swapaxes(1, 2) @ measured)
        gyro, still = ((errors - [self._bias, np.zeros(3)]) ** 2).sum(1)
        if np.isfinite(gyro) and np.isfinite(still):
            self._bias = self._bias + (errors[0] - self._bias) / min(self._seen + 1, self._MEMORY)
            self._gyro = self._FADE * self._gyro + float(gyro)
            self._steady = self._FADE * self._steady + float(still)
            self._seen += 1


# ---- integration


def imu_steps(imu: Imu, start_s: float, stop_s: float) -> Array | None:
    """(n, 7) duration, mean gyro and mean accel between neighbouring samples from start to stop; None in gaps."""
    times = imu.timestamps_s
    low, high = int(np.searchsorted(times, start_s, "right")), int(np.searchsorted(times, stop_s, "left"))
    if not stop_s > start_s or len(times) < 2:
        return None
    index = np.clip(np.arange(low - 1, high + 1), 0, len(times) - 1)
    nodes = np.concatenate([[start_s], times[low:high], [stop_s]])
    silence = np.diff(times[index]).max(initial=0.0)
    if silence > MAX_SILENCE_S or times[0] - start_s > MAX_SILENCE_S or stop_s - times[-1] > MAX_SILENCE_S:
        return None
    local = times[index[0] : index[-1] + 1]
    values = np.concatenate([imu.gyro[index[0] : index[-1] + 1], imu.accel[index[0] : index[-1] + 1]], 1)
    at_nodes = np.stack([np.interp(nodes, local, column) for column in values.T], 1)
    steps = np.column_stack([np.diff(nodes), 0.5 * (at_nodes[1:] + at_nodes[:-1])])
    return np.ascontiguousarray(steps[steps[:, 0] > 0])


@numba.njit(cache=True, nogil=True)
def fill_turn(w: tuple[float, float, float], series: tuple[float, float, float], out: Array, slope: Array) -> None:
    """exp(w) and its right Jacobian (Sola 2017, equation 183), both (3, 3), of the series sin n / n,
    (1 - cos n) / n^2 and (n - sin n) / n^3 of n = |w|."""
    a, b, c = series
    n2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    for i in range(3):
        for j in range(3):
            square = w[i] * w[j] - (n2 if i == j else 0.0)
            out[i, j] = (1.0 if i == j else 0.0) + b * square
            slope[i, j] = (1.0 if i == j else 0.0) + c * square
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[k, j] += a * w[i]
        out[j, k] -= a * w[i]
        slope[k, j] -= b * w[i]
        slope[j, k] += b * w[i]


@numba.njit(cache=True, nogil=True)
def turn_by(wx: float, wy: float, wz: float, out: Array, slope: Array) -> None:
    """exp(w) and its right Jacobian, (3, 3), by series: a step of an inertial sensor is a small angle."""
    n2 = wx * wx + wy * wy + wz * wz
    a = 1.0 - n2 / 6.0 * (1.0 - n2 / 20.0 * (1.0 - n2 / 42.0))
    b = 0.5 - n2 / 24.0 * (1.0 - n2 / 30.0 * (1.0 - n2 / 56.0))
    c = (1.0 - n2 / 20.0 * (1.0 - n2 / 42.0)) / 6.0
    fill_turn((wx, wy, wz), (a, b, c), out, slope)


@numba.njit(cache=True, nogil=True)
def integrate_rotation(steps: Array, gyro_bias: Array, turn: Array) -> None:
    """Rotation imu(start) from imu(stop) into turn (3, 3)."""
    step, slope, new = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            turn[i, j] = 1.0 if i == j else 0.0
    for n in range(steps.shape[0]):
        h = steps[n, 0]
        turn_by(
            (steps[n, 1] - gyro_bias[0]) * h, (steps[n, 2] - gyro_bias[1]) * h, (steps[n, 3] - gyro_bias[2]) * h, step,
            slope,
        )  # fmt: skip
        multiply(turn, step, new)
        copy_into(turn, new)


@numba.njit(cache=True, nogil=True)
def multiply(a: Array, b: Array, out: Array) -> None:
    """Product of two 3 x 3 matrices; out is neither of them."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@numba.njit(cache=True, nogil=True)
def _accumulate(steps: Array, turns: Array) -> None:
    """Products of rotations, steps (M - 1, 3, 3) into turns (M, 3, 3), the identity first."""
    turns[0] = np.eye(3)
    for n in range(steps.shape[0]):
        multiply(turns[n], steps[n], turns[n + 1])


# ---- how it has to be read

# Offsets between clocks that are looked for: beyond a second nothing but another epoch is known.
_MAX_OFFSET_S, _OFFSET_STEP_S = 1.0, 0.02
# Another reading counts where it leaves less than this share of what the given one leaves, as a standard deviation:
# over some tens of intervals chance reaches a tenth.
_CLEARLY_LESS = 0.5
# Two readings that leave nearly the same are not told apart.
_ALIKE = 1.3
# More intervals would take time, and tell no more apart.
_MAX_QUESTIONED = 100
_UNITS = (1.0, float(np.pi / 180), float(180 / np.pi))  # as given; it was degrees a second; it was taken for degrees


@dataclass(frozen=True)
class Turns:
    """What a map says of rotations between poses, in the camera's frame.

    Attributes:
        start_s, stop_s: (N,) seconds on the frames' clock. seen: (N, 3, 3) camera(start) from camera(stop).
    """

    start_s: Array
    stop_s: Array
    seen: Array

    def part(self, most: int) -> Turns:
        """At most so many of them, those in the middle."""
        first = max(0, (len(self.start_s) - most) // 2)
        return Turns(*(v[first : first + most] for v in (self.start_s, self.stop_s, self.seen)))

    @property
    def rms_rad(self) -> float:
        """Of the angles."""
        return float(np.sqrt((rigid3.log_so3(self.seen) ** 2).sum(1).mean()))


@dataclass(frozen=True)
class Reading:
    """How the measured rates are to be taken: ``factor * axes @ gyro`` in the frame that ``imu_from_cam`` leads to.

    Attributes:
        axes: (3, 3) signed permutation, or any rotation. factor: on the unit.
        imu_from_cam: (3, 3) mounting.
        offset_s: to be added to a time of the frames for the time that the measurements carry; offset_sigma_s: its
            standard deviation, infinite where the rotations do not tell it.
        bias: (3,) rad/s, in the same frame. residual_rad: robust rms of what is left of a rotation.
    """

    axes: Array
    factor: float
    imu_from_cam: Array
    offset_s: float
    offset_sigma_s: float
    bias: Array
    residual_rad: float


class GyroTurns:
    """Rotations by the rates times a factor, less a bias, at any times; across gaps they say nothing."""

    def __init__(self, imu: Imu, factor: float, bias: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        self._times = np.ascontiguousarray(imu.timestamps_s, np.float64)
        rates = np.ascontiguousarray(factor * imu.gyro - np.asarray(bias))
        self._turns = np.empty((len(rates), 3, 3))
        self._rates = 0.5 * (rates[1:] + rates[:-1])
        _accumulate(rigid3.exp_so3(self._rates * np.diff(self._times)[:, None]), self._turns)

    def between(self, start_s: Array, stop_s: Array) -> Array:
        """(N, 3, 3) imu(start) from imu(stop)."""
        first, second = self.at(start_s), self.at(stop_s)
        return np.asarray(first.swapaxes(1, 2) @ second)

    def at(self, times_s: Array) -> Array:
        """(N, 3, 3) imu(first sample) from imu(time)."""
        j = np.clip(np.searchsorted(self._times, times_s, "right") - 1, 0, len(self._rates) - 1)
        return np.asarray(self._turns[j] @ rigid3.exp_so3(self._rates[j] * (times_s - self._times[j])[:, None]))


def read_as_given(turns: Turns, imu: Imu) -> Reading:
    """The clocks' offset, and what is left with it, if all else is as it was given."""
    mounting = rigid3.rotation_matrix(imu.imu_from_cam)
    gyro, seen = GyroTurns(imu, 1.0), _mounted(turns, mounting)
    offsets = _offsets()
    left = np.array([_unbiased(_errors(turns, seen, gyro, offset), turns)[1] for offset in offsets])
    best, middle = int(left.argmin()), len(offsets) // 2
    start = 0.0 if left[best] > _CLEARLY_LESS * left[middle] else float(offsets[best])
    found = _refined(turns, imu, np.eye(3), 1.0, mounting, start)
    if start == 0.0 or abs(found.offset_s) < 2 * _OFFSET_STEP_S:
        return found
    elsewhere = np.abs(offsets - found.offset_s) > 5 * _OFFSET_STEP_S
    # a motion that repeats itself fits at several offsets
    if left[elsewhere].min() < _ALIKE * left[best]:
        return _refined(turns, imu, np.eye(3), 1.0, mounting, 0.0)
    return found


def other_readings(turns: Turns, imu: Imu) -> list[Reading]:
    """Those with other axes, sign, unit, mounting or clock that leave least, alike ones together, simplest first."""
    turns = turns.part(_MAX_QUESTIONED)
    given = rigid3.rotation_matrix(imu.imu_from_cam)
    found: list[tuple[float, int, tuple[Array, float, Array, float]]] = []
    for factor in (sign * unit for unit in _UNITS for sign in (1.0, -1.0)):
        gyro = GyroTurns(imu, factor)
        for is_late, offset in enumerate((0.0, _offset_by_angle(turns, gyro))):
            measured = gyro.between(turns.start_s + offset, turns.stop_s + offset)
            for is_inverse, mounting in enumerate((given, given.T)):
                seen = _mounted(turns, mounting)
                free = [] if is_inverse else [_turned(measured, seen)]
                for n, axes in enumerate([*PROPER_AXES, *free]):
                    errors = rigid3.log_so3(axes @ measured.swapaxes(1, 2) @ axes.T @ seen)
                    faults = int(factor != 1.0) + is_inverse + int(n > 0) + 2 * int(n == len(PROPER_AXES)) + is_late
                    found.append((_unbiased(errors, turns)[1], faults, (axes, factor, mounting, offset)))
    least = min(row[0] for row in found)
    # the turn is free where the axes are not: it fits a little better than what is the case
    close = sorted((row for row in found if row[0] <= 3.0 * least), key=lambda row: row[:2][::-1])
    distinct: dict[tuple[bytes, float, bytes], tuple[Array, float, Array, float]] = {}
    for _, _, row in close:
        distinct.setdefault((row[0].tobytes(), row[1], row[2].tobytes()), row)
    readings = [_refined(turns, imu, *row) for row in list(distinct.values())[:8]]
    least = min(reading.residual_rad for reading in readings)
    alike = [reading for reading in readings if reading.residual_rad <= _ALIKE * least]
    return [reading for reading in alike if is_permutation(reading.axes)] or alike


def is_permutation(axes: Array) -> bool:
    """Whether axes are only named otherwise, and turned round."""
    return bool(np.allclose(np.abs(axes).max(1), 1.0))


def _offset_by_angle(turns: Turns, gyro: GyroTurns) -> float:
    """The offset at which the angles agree best, whatever the axes are."""
    seen = np.linalg.norm(rigid3.log_so3(turns.seen), axis=1)
    left = []
    for offset in _offsets():
        measured = gyro.between(turns.start_s + offset, turns.stop_s + offset)
        left.append(float(np.median((np.linalg.norm(rigid3.log_so3(measured), axis=1) - seen) ** 2)))
    return float(_offsets()[int(np.argmin(left))])


def _turned(measured: Array, seen: Array) -> Array:
    """The rotation (3, 3) that brings the measured rotations nearest to those seen (Kabsch)."""
    product = rigid3.log_so3(seen).T @ rigid3.log_so3(measured)
    u, _, vt = np.linalg.svd(product)
    return np.asarray(u @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))]) @ vt)


def is_clearly_less(residual: float, of_given: float) -> bool:
    """Whether what another reading leaves is so much less that chance is ruled out; False without numbers."""
    return bool(np.isfinite(residual) and residual < _CLEARLY_LESS * of_given)


def _proper_axes() -> Array:
    """(24, 3, 3) rotations that permute the axes and turn them round, the identity first."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            axes = np.diag(signs) @ np.eye(3)[list(order)]
            if np.linalg.det(axes) > 0:
                found.append(axes)
    return np.array(found)


PROPER_AXES = _proper_axes()


def _offsets() -> Array:
    steps = round(_MAX_OFFSET_S / _OFFSET_STEP_S)
    return np.asarray(_OFFSET_STEP_S * np.arange(-steps, steps + 1), np.float64)


def _mounted(turns: Turns, imu_from_cam: Array) -> Array:
    return np.asarray(imu_from_cam @ turns.seen @ imu_from_cam.T)


def _errors(turns: Turns, seen: Array, gyro: GyroTurns, offset: float) -> Array:
    """(N, 3) radians from what is measured to what is seen."""
    measured = gyro.between(turns.start_s + offset, turns.stop_s + offset)
    left: Array = rigid3.log_so3(measured.swapaxes(1, 2) @ seen)
    return left


def _unbiased(errors: Array, turns: Turns) -> tuple[Array, float, Array]:
    """Bias (3,) of the rates, robust rms of what it leaves, and weights (N,); to the first order in an interval."""
    dt = turns.stop_s - turns.start_s
    weight, bias, left = np.ones(len(dt)), np.zeros(3), errors
    for _ in range(3):
        bias = -(weight * dt) @ errors / (weight @ dt**2)
        left = errors + dt[:, None] * bias
        squares = (left**2).sum(1)
        weight = 1.0 / (1.0 + squares / (4.0 * np.median(squares) + 1e-24))
    # of three normal components the median of the squared length is 2.366 variances
    return bias, float(np.sqrt(np.median(squares) * 3.0 / 2.366)), weight


def _refined(turns: Turns, imu: Imu, axes: Array, factor: float, mounting: Array, offset: float) -> Reading:
    """Bias and offset by Gauss-Newton, the rates integrated again without the bias."""
    mounted = Turns(turns.start_s, turns.stop_s, axes.T @ _mounted(turns, mounting) @ axes)
    bias, sigma, residual, h = np.zeros(3), np.inf, np.inf, 1e-3
    for _ in range(4):
        gyro = GyroTurns(imu, factor, bias)
        at, before, after = (_errors(turns, mounted.seen, gyro, offset + d) for d in (0.0, -h, h))
        more, residual, weight = _unbiased(at, turns)
        dt = turns.stop_s - turns.start_s
        slopes = np.concatenate([((after - before) / (2 * h))[..., None], dt[:, None, None] * np.eye(3)], 2)
        normal = np.einsum("n,nki,nkj->ij", weight, slopes, slopes)
        right = -np.einsum("n,nki,nk->i", weight, slopes, at)
        scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        covariance = scale[:, None] * np.linalg.pinv(normal * np.outer(scale, scale), rcond=1e-9) * scale
        change = covariance @ right
        noise = residual / np.sqrt(3.0)
        sigma = noise * float(np.sqrt(max(covariance[0, 0], 0.0)))
        if not (np.isfinite(sigma) and sigma < _OFFSET_STEP_S):  # the rotations are too even to tell
            offset, sigma = offset if abs(offset) > _OFFSET_STEP_S else 0.0, np.inf
            bias = bias + more
            continue
        offset += float(np.clip(change[0], -_OFFSET_STEP_S, _OFFSET_STEP_S))
        bias = bias + change[1:]
    return Reading(axes, factor, mounting, offset, sigma, axes @ bias, residual)


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    integrate_rotation(np.zeros((1, 7)), np.zeros(3), np.empty((3, 3)))
    _accumulate(np.zeros((1, 3, 3)), np.empty((2, 3, 3)))
