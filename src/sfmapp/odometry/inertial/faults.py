"""Why inertial measurements contradict a map: axes, signs, units, gravity, mounting, told apart by trying them.

Each reading of the gyroscope is held against the map's rotations, each reading of the accelerometer against its
positions in the linear system of :mod:`sfmapp.odometry.inertial.integration`; the best few are aligned in full. One
that turns a fit which contradicts the map into one that leaves no more than noise is what is the case, and is named
with its remedy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.odometry.inertial.gyroscope import (
    PROPER_AXES,
    GyroTurns,
    Reading,
    is_clearly_less,
    is_permutation,
    other_readings,
    read_as_given,
)
from sfmapp.odometry.inertial.integration import (
    ACCEL_BIAS_SIGMA,
    GRAVITY,
    InertialOptions,
    choose_poses,
    constrain,
    linear_system,
    turns_of,
)
from sfmapp.odometry.inertial.scale import ScaleRefusal
from sfmapp.odometry.inertial.seen_map import SeenMap
from sfmapp.odometry.inertial.visual_inertial import MAX_BIAS, InertialAlignment, align_imu, contradicted
from sfmapp.odometry.report import Fault, InertialEvidence

if TYPE_CHECKING:
    from sfmapp.images.sequence import Imu

Array = NDArray[np.float64]

# Poses in a row that accelerations are questioned on: half a minute, in which everything moves.
_MAX_POSES = 100
# Readings that are aligned in full; how much more one may leave than the best to be named beside it; and the share of
# that which one with more faults has to leave, or a unit that nothing tells would be named with every missing gravity.
_NUM_TRIED, _ALIKE, _BY_ONE_MORE = 4, 2.0, 0.7
# Rotation matrices of which the difference has a smaller part of their norm are within four degrees: one fault.
_ALIKE_TURN = 0.05
_ROUNDS = 5  # of the linear system: enough to tell right from wrong
# Costs are halved squares: what costs so much more than the best is out of the question.
_MAX_COST = 20.0
# A reading that is right but coarse leaves less than this share of what a wrong one does (right ones a ninth and less,
# the next best one nine tenths), and so many times what is allowed.
_SMALL_PART, _MOST_LEFT = 0.2, 8.0
_NAMES = ("x", "y", "z")
_DEFAULTS = InertialOptions()


@dataclass(frozen=True)
class _Case:
    """One reading of both sensors: ``matrix @ accel``, gravity put back or not, and how little it leaves (a cost)."""

    gyro: Reading
    matrix: Array
    has_no_gravity: bool
    cost: float

    @property
    def num_faults(self) -> int:
        """How many things are other than they were given, a sign or an order of both sensors counted once."""
        of_gyro, of_accel = _signed_axes(self)
        same = np.allclose(of_gyro, of_accel)
        axes = (not np.allclose(of_gyro, np.eye(3))) + (not same and not np.allclose(of_accel, np.eye(3)))
        units = int(not 0.5 < abs(self.gyro.factor) < 2.0) + int(abs(np.linalg.det(self.matrix)) > 2.0)
        return int(axes) + units + int(self.has_no_gravity)


def align_or_explain(seen: SeenMap, imu: Imu, options: InertialOptions = _DEFAULTS) -> InertialAlignment | ScaleRefusal:
    """As ``align_imu`` does it; a refusal because of a contradiction names its cause if that is found."""
    found = align_imu(seen, imu, options)
    if isinstance(found, InertialAlignment) or found.contradiction is None:
        return found
    tried: list[tuple[_Case, InertialAlignment | ScaleRefusal]] = []
    for case in _cases(seen.times_s, seen.poses, imu, seen.is_metric, options):
        changed = _changed(seen.times_s, seen.poses, imu, case)
        tried.append((case, align_imu(seen, changed, options)))
    return _told(found, _explaining(found, tried, options), imu)


def _explaining(
    refusal: ScaleRefusal, tried: list[tuple[_Case, InertialAlignment | ScaleRefusal]], options: InertialOptions
) -> list[tuple[_Case, float]]:
    """The cases that explain the measurements, fewest faults first, and what they leave a degree of freedom.

    One that is accepted in full does. So does one that leaves a small part of what was left and a bias as sensors have
    it: gravity that a phone has subtracted it has subtracted in a direction of its own.
    """
    given = float(refusal.evidence.get("residual", np.inf))
    accepted = [(case, better.residual) for case, better in tried if isinstance(better, InertialAlignment)]
    if not accepted:
        limit = min(_SMALL_PART * given, _MOST_LEFT * options.max_residual)
        for case, better in tried:
            left = float(better.evidence.get("residual", np.inf))
            bias = float(np.linalg.norm(better.evidence.get("accel_bias", [np.inf])))
            if left <= limit and bias <= MAX_BIAS:
                accepted.append((case, left))
    accepted.sort(key=lambda row: (row[0].num_faults, row[1]))
    kept: list[tuple[_Case, float]] = []
    for case, left in accepted:
        if any(_is_same(case, other) for other, _ in kept):
            continue
        least = min((other for _, other in kept), default=np.inf)
        if left < (_BY_ONE_MORE * least if kept and case.num_faults > kept[0][0].num_faults else _ALIKE * least):
            kept.append((case, left))
    return kept


def _is_same(case: _Case, other: _Case) -> bool:
    """Whether two readings differ by no more than a turn of the mounting that the alignment finds by itself."""
    if case.has_no_gravity != other.has_no_gravity or not np.allclose(case.gyro.imu_from_cam, other.gyro.imu_from_cam):
        return False
    pairs = ((case.gyro.factor * case.gyro.axes, other.gyro.factor * other.gyro.axes), (case.matrix, other.matrix))
    return all(np.linalg.norm(a - b) < _ALIKE_TURN * np.linalg.norm(a) for a, b in pairs)


def _told(refusal: ScaleRefusal, kept: list[tuple[_Case, float]], imu: Imu) -> ScaleRefusal:
    """The refusal with what explains it."""
    if not kept:
        advice = (
            "no order or sign of the axes, unit, missing gravity, mounting or offset of the clocks explains it: "
            "check the sensor's calibration and its file, or whether the map is bent"
        )
        return contradicted(refusal.reason, advice, _inertial(refusal))
    rows: dict[str, Fault] = {}
    for case, left in kept:  # a turn that is found twice is one
        fault, remedy = _words(case, imu)
        rows.setdefault(fault, Fault(fault=fault, remedy=remedy, residual=left))
    reason = f"{refusal.reason}; it is explained if {', or '.join(rows)}"
    evidence = replace(_inertial(refusal), explained_by=list(rows.values()))
    return contradicted(reason, "; or ".join(row.remedy for row in rows.values()), evidence)


def _inertial(refusal: ScaleRefusal) -> InertialEvidence:
    assert isinstance(refusal.evidence, InertialEvidence)
    return refusal.evidence


def _cases(times: Array, poses: Array, imu: Imu, is_metric: bool, options: InertialOptions) -> list[_Case]:
    """The readings worth a full alignment, the likeliest first; the given one is not among them."""
    chosen = choose_poses(times, poses, options)
    turns = turns_of(times, poses, chosen, options.max_interval_s)
    given = read_as_given(turns, imu)
    readings = [given]
    turned = other_readings(turns, imu)
    if is_clearly_less(turned[0].residual_rad, given.residual_rad):
        readings = turned
    first = max(0, (len(chosen) - _MAX_POSES) // 2)
    block = chosen[first : first + _MAX_POSES]
    cases = [c for reading in readings for c in _of_accelerations(times[block], poses[block], imu, reading, is_metric)]
    is_given = [c.gyro is given and not c.has_no_gravity and np.array_equal(c.matrix, np.eye(3)) for c in cases]
    others = sorted((c for c, same in zip(cases, is_given, strict=True) if not same), key=lambda c: c.cost)
    return [c for c in others if c.cost < others[0].cost + _MAX_COST][:_NUM_TRIED]


def _of_accelerations(times: Array, poses: Array, imu: Imu, reading: Reading, is_metric: bool) -> list[_Case]:
    """All readings of the accelerometer with one of the gyroscope, and how well the positions bear them out.

    What is integrated is linear in the accelerations: nine integrations of one axis read as another make all orders.
    """
    options, felt = InertialOptions(), []
    base = _with_gyro(imu, reading)
    for k in range(9):
        axes = np.zeros(9)
        axes[k] = 1.0
        felt.append(_felt(times, poses, replace(base, accel=base.accel @ axes.reshape(3, 3).T), reading, options))
    still = linear_system(times, poses, replace(base, accel=np.zeros_like(base.accel)), reading.bias, options)
    pull = _felt(times, poses, replace(base, accel=_gravity_felt(times, poses, base, reading.bias)), reading, options)
    if still is None or pull is None:
        return []
    design, target = still
    nothing = design[..., 0].copy()
    parts = np.stack([part - nothing for part in felt if part is not None])
    count = max(3.0, float(np.ptp(times)) / 2.0)  # spans of two seconds are independent of each other
    cases = []
    # a sensor that is turned is turned as a whole
    orders = PROPER_AXES if is_permutation(reading.axes) else reading.axes[None]
    for matrix in (factor * axes for factor in _FACTORS for axes in orders):
        for has_no_gravity in (False, True):
            design[..., 0] = nothing + np.tensordot(matrix.ravel(), parts, 1) + has_no_gravity * (pull - nothing)
            start = constrain(design, target, is_metric, _ROUNDS)
            faults = float(not np.allclose(matrix, np.eye(3))) + has_no_gravity
            cost = 3.0 * count * np.log(start.position_sigma) + 0.5 * (start.accel_bias**2).sum() / ACCEL_BIAS_SIGMA**2
            if np.isfinite(cost):
                cases.append(_Case(reading, matrix, has_no_gravity, float(cost + faults)))
    return cases


_FACTORS = (1.0, -1.0, GRAVITY, -GRAVITY)  # as given, negated, in g, both


def _felt(times: Array, poses: Array, imu: Imu, reading: Reading, options: InertialOptions) -> Array | None:
    system = linear_system(times, poses, imu, reading.bias, options)
    return None if system is None else system[0][..., 0]


def _with_gyro(imu: Imu, reading: Reading) -> Imu:
    """The measurements with the gyroscope, the mounting and the clock of a reading."""
    turned = rigid3.inverse(imu.imu_from_cam)
    given = turned if np.allclose(rigid3.rotation_matrix(turned), reading.imu_from_cam) else imu.imu_from_cam
    mount = rigid3.from_matrix(reading.imu_from_cam, given[4:])
    gyro = reading.factor * imu.gyro @ reading.axes.T
    return replace(imu, timestamps_s=imu.timestamps_s - reading.offset_s, gyro=gyro, imu_from_cam=mount)


def _changed(times: Array, poses: Array, imu: Imu, case: _Case) -> Imu:
    """The measurements as a case reads them."""
    base = _with_gyro(imu, case.gyro)
    accel = imu.accel @ case.matrix.T
    if case.has_no_gravity:
        known = np.isfinite(poses).all(1)
        accel = accel + _gravity_felt(times[known], poses[known], base, case.gyro.bias)
    return replace(base, accel=accel)


def _gravity_felt(times: Array, poses: Array, imu: Imu, gyro_bias: Array) -> Array:
    """(M, 3) what a sensor at rest would measure at the time of each sample, were down the map's y axis.

    Which direction it is does not matter: if the measurements have no gravity, the map's own is free.
    """
    up = np.array([0.0, -GRAVITY, 0.0])
    imu_from_map = rigid3.rotation_matrix(imu.imu_from_cam) @ rigid3.rotation_matrix(poses)
    nearest = np.clip(np.searchsorted(times, imu.timestamps_s), 1, len(times) - 1)
    before = imu.timestamps_s - times[nearest - 1] < times[nearest] - imu.timestamps_s
    nearest = nearest - before
    turns = GyroTurns(imu, 1.0, gyro_bias)
    at_sample, at_pose = turns.at(imu.timestamps_s), turns.at(times)
    turned = at_sample.swapaxes(1, 2) @ at_pose[nearest] @ imu_from_map[nearest]
    return np.asarray(turned @ up)


def _words(case: _Case, imu: Imu) -> tuple[str, str]:
    """What is the matter in a case, and what to do about it."""
    gyro, faults = case.gyro, list[tuple[str, str]]()
    size = abs(gyro.factor)
    of_gyro, of_accel = _signed_axes(case)
    if not np.allclose(gyro.imu_from_cam, rigid3.rotation_matrix(imu.imu_from_cam)):
        text = "the mounting (T_BS, imu_from_cam) is given the wrong way round"
        faults.append((text, "invert the transformation between camera and sensor"))
    if np.allclose(of_gyro, of_accel) and not np.allclose(of_gyro, np.eye(3)):
        faults.append(_of_axes("both sensors", of_gyro))
    else:
        faults += [_of_axes("the gyroscope", of_gyro)] * (not np.allclose(of_gyro, np.eye(3)))
        faults += [_of_axes("the accelerometer", of_accel)] * (not np.allclose(of_accel, np.eye(3)))
    if size < 0.5:
        faults.append(("the gyroscope is in degrees per second", "write its rates in radians per second"))
    elif size > 2:
        faults.append(
            ("the gyroscope's rates were converted to radians twice", "write its rates in radians per second")
        )
    if np.abs(np.linalg.det(case.matrix)) > 2:
        faults.append(("the accelerometer is in g", "multiply its measurements by 9.81"))
    if case.has_no_gravity:
        text = "gravity is already subtracted from the accelerations, as phones deliver them"
        faults.append((text, "record the accelerometer with gravity, not the linear or user acceleration"))
    return " and ".join(text for text, _ in faults), ", ".join(remedy for _, remedy in faults)


def _signed_axes(case: _Case) -> tuple[Array, Array]:
    """(3, 3) of the gyroscope and of the accelerometer, units left out."""
    size = np.cbrt(abs(np.linalg.det(case.matrix)))
    return float(np.sign(case.gyro.factor)) * case.gyro.axes, case.matrix / size


def _of_axes(who: str, axes: Array) -> tuple[str, str]:
    """What a signed permutation (3, 3), or another rotation, of a sensor's axes means."""
    if np.allclose(axes, -np.eye(3)):
        verb = "are" if who.startswith("both") else "is"
        return f"{who} {verb} negated", f"change the sign of {who.removeprefix('the ')}"
    if not is_permutation(axes):
        angle = float(rigid3.rotation_angle_deg(axes))
        return (
            f"{who} stand turned by {angle:.0f} degrees against the mounting (T_BS, imu_from_cam)",
            "calibrate the rotation between camera and sensor",
        )
    entries = [f"{'-' if row[k] < 0 else ''}{_NAMES[k]}" for row, k in zip(axes, np.abs(axes).argmax(1), strict=True)]
    text = f"({', '.join(entries)})"
    verb = "have" if who.startswith("both") else "has"
    return (
        f"{who} {verb} other axes",
        f"write {text} of {who.removeprefix('the ')} for (x, y, z), or correct the mounting",
    )
