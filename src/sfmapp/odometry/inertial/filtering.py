"""An error-state Kalman filter over poses and inertial measurements: where the camera is, at the rate of the sensor.

Each sample of the sensor moves the state on, each pose with its covariance corrects it; of what comes later it knows
nothing. Sola, "Quaternion kinematics for the error-state Kalman filter", arXiv 1711.02508, 2017, sections 5 and 6; a
sample is integrated, and its slopes taken, by the preintegration of :mod:`sfmapp.odometry.inertial.integration`.

What the state is, and how it errs, is in :mod:`sfmapp.odometry.inertial.filter_state`.

Without a sensor the filter of :mod:`sfmapp.odometry.inertial.smoothing` takes its place: the camera goes on as it
moves.
"""

from __future__ import annotations

import itertools
import math
import time
from array import array
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.inertial.filter_state import INDEPENDENT, FilterState, InertialSensor, Shared
from sfmapp.odometry.inertial.filtered_rows import FilteredRow, FilteredRows, as_given
from sfmapp.odometry.inertial.gyroscope import MAX_SILENCE_S
from sfmapp.odometry.inertial.smoothing import (
    SmoothingOptions,
    compile_kernels,
    read_measured,
    smooth_trajectory,
    unknown_rates,
)
from sfmapp.odometry.report import FilterConsistency

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# Innovations of so many frames are held against what they should be, of no fewer than so many; what one in a thousand
# of good ones goes beyond is too much: the quantile of a normal distribution.
_WINDOW, _LEAST_WINDOW, _QUANTILE = 40, 20, 3.09
# Rows that are looked at together, of what may be hours.
_AT_ONCE = 10_000
# Frames further apart than so many times their usual distance have lost some between them.
_DROPPED = 1.5
LIVE = SmoothingOptions(max_gap_s=5.0, is_causal=True)
"""Only the past counts, and gaps of up to five seconds are bridged."""


@dataclass(frozen=True)
class FilteredTrajectory:
    """Poses at the times of the sensor's samples and of the frames. Of a long run the arrays of rows are read-only
    views of a file.

    Attributes:
        timestamps_s: (N,) ascending.
        cam_from_world: (N, 7). covariance: (N, 6, 6) over rotation (radians) and translation of
            ``x_cam <- exp(w) x_cam + v``.
        since_pose_s: (N,) seconds since the last pose that was used.
        is_bridged: (N,) bool: a frame since then, or this one, brought no pose that was used.
        frame_row: (F,) int64 position of each frame in these, -1 of those that nothing reaches.
        innovation: (F, 6) what measured poses said beyond the prediction, each of the six a standard deviation large
            and independent where all is as modelled; NaN where there was nothing to compare, and without a sensor.
        nis: (F,) normalised innovations squared, 6 in the mean where all is as modelled; NaN as above.
        is_rejected: (F,) bool: the pose disagreed with the motion and was not used.
        prediction: ``imu`` or ``constant velocity``.
        gyro_bias, accel_bias: (3,) in the end; zeros without a sensor.
        clock_s: how much later frames are on the clock of the measurements than they say, and its standard deviation,
            in the end; zeros as above.
        latency_s: (N,) seconds on the clock that finding a row took, after its sample or pose was there.
        widening: (N,) factor that is in the covariance, as innovations of the last frames were larger than they should
            be; 1 where they were not.
    """

    timestamps_s: Array
    cam_from_world: Array
    covariance: Array
    since_pose_s: Array
    is_bridged: Bools
    frame_row: Ints
    innovation: Array
    nis: Array
    is_rejected: Bools
    prediction: str
    gyro_bias: Array
    accel_bias: Array
    clock_s: tuple[float, float]
    latency_s: Array
    widening: Array

    @property
    def position_sigma(self) -> Array:
        """(N,) standard deviation of the camera's centre in the world, the root of the sum over the axes."""
        sigma = np.empty(len(self.timestamps_s))
        for first in range(0, len(sigma), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            of_center = rigid3.center_covariance(self.cam_from_world[some], self.covariance[some])
            sigma[some] = np.sqrt(np.trace(of_center, axis1=1, axis2=2))
        return sigma

    @property
    def rotation_sigma_rad(self) -> Array:
        """(N,) standard deviation of the rotation, the root of the sum over the axes."""
        sigma: Array = np.sqrt(np.trace(self.covariance[:, :3, :3], axis1=1, axis2=2))
        return sigma


class FilteredPose(NamedTuple):
    """A pose as it is given out, at a sample of the sensor; see :class:`FilteredTrajectory` for what each means."""

    timestamp_s: float
    cam_from_world: Array
    covariance: Array
    since_pose_s: float
    is_bridged: bool


def filter_trajectory(
    timestamps_s: ArrayLike,
    cam_from_world: ArrayLike,
    covariance: ArrayLike,
    sensor: InertialSensor | None = None,
    options: SmoothingOptions = LIVE,
) -> FilteredTrajectory:
    """Filter measured poses of frames, using at each time what came before it.

    Poses that the motion contradicts (``options.max_nis``) are left out, up to ``options.max_rejected`` in a row: then
    the map has jumped, and the world, in which the sensor tells how the camera moves, stays where it was. After a gap
    that is too long, or that the sensor was silent in, the filter begins anew with the biases that it has.
    Without a sensor the level of the accelerations is that of the whole trajectory.

    Args:
        timestamps_s: (F,) strictly ascending.
        cam_from_world: (F, 7) in one world; NaN in gaps.
        covariance: (F, 6, 6) as :func:`~sfmapp.adjust.pose.refine_pose` gives it; a pose whose covariance is not
            finite and positive counts as a gap.
        sensor: None: the camera goes on as it moves, and rows are those of the frames.

    Raises:
        ValueError: times that do not ascend.
    """
    if sensor is None:
        return _at_constant_velocity(timestamps_s, cam_from_world, covariance, options)
    measured = read_measured(timestamps_s, cam_from_world, covariance)
    imu = sensor.imu
    found = InertialFilter(sensor, unknown_rates(measured)[0], options)
    n = 0
    for f, frame_s in enumerate(measured.times):
        while n < len(imu.timestamps_s) and imu.timestamps_s[n] <= frame_s:
            found.add_sample(float(imu.timestamps_s[n]), imu.gyro[n], imu.accel[n])
            n += 1
        found.add_frame(float(frame_s), measured.pose(f))
    return found.result()


def consistency(nis: Array, innovation: Array | None = None) -> FilterConsistency | None:
    """Hold innovations of six degrees of freedom against what is stated of them; None without any.

    Their mean square has a chi-squared distribution where they are independent from frame to frame, which is tested by
    how they are correlated with those of the frame before (Bar-Shalom, Li and Kirubarajan, "Estimation with
    applications to tracking and navigation", 2001, section 5.4.2). Of a filter whose covariances are right in size, but
    which does not model all that lasts, as many are independent as the correlations of NIS leave.

    Args:
        nis: (F,) normalised innovations squared, NaN of frames without.
        innovation: (F, 6) as of :class:`FilteredTrajectory`; None where only their squares are known.
    """
    from scipy.stats import chi2  # heavy to load

    known = nis[np.isfinite(nis)]
    if not len(known):
        return None
    low, high = chi2.ppf([0.025, 0.975], 6.0)
    num_independent = len(known) / correlation_time(autocovariance(known))
    bounds = [chi2.ppf([0.025, 0.975], 6.0 * num) / (6.0 * num) for num in (len(known), num_independent)]
    correlation = None if innovation is None else neighbour_correlation(innovation)
    return FilterConsistency(
        num_innovations=len(known), mean=float(known.mean() / 6.0),
        mean_low=float(bounds[0][0]), mean_high=float(bounds[0][1]),
        share_inside=float(np.mean((known >= low) & (known <= high))),
        num_independent=num_independent, correlated_low=float(bounds[1][0]), correlated_high=float(bounds[1][1]),
        correlation=correlation, max_correlation=float(1.96 / np.sqrt(6.0 * len(known))),
    )  # fmt: skip


def autocovariance(values: Array) -> Array:
    """(N,) of a series about its own mean, at 0 to N - 1 steps: sums over N, which are not larger than the truth."""
    from scipy.signal import correlate

    apart = values - values.mean()
    found: Array = correlate(apart, apart, "full")[len(apart) - 1 :] / len(apart)
    return found


def correlation_time(autocovariance: Array) -> float:
    """How many steps a value of a series (N,) lasts, 1 or more: a mean of n is as good as one of n over this.

    The initial monotone sequence of Geyer, "Practical Markov chain Monte Carlo", Statistical Science 1992, section 3.3:
    sums over two neighbouring steps, as long as they are above zero, none larger than the one before.
    """
    if not autocovariance[0] > 0.0:
        return 1.0
    even = len(autocovariance) // 2 * 2
    pairs = np.minimum.accumulate(autocovariance[:even].reshape(-1, 2).sum(1) / autocovariance[0])
    return max(1.0, 2.0 * float(pairs[pairs > 0.0].sum()) - 1.0)


def neighbour_correlation(innovation: Array) -> float | None:
    """Of innovations (F, 6) with those of the frame before, by their scalar products; None without neighbours."""
    one, other = innovation[:-1], innovation[1:]
    both = np.isfinite(one[:, 0]) & np.isfinite(other[:, 0])
    size = float(np.sqrt((one[both] ** 2).sum() * (other[both] ** 2).sum()))
    return float((one[both] * other[both]).sum()) / size if size > 0.0 else None


def _at_constant_velocity(
    timestamps_s: ArrayLike, cam_from_world: ArrayLike, covariance: ArrayLike, options: SmoothingOptions
) -> FilteredTrajectory:
    """The same by the frames alone."""
    compile_kernels()  # which is no latency
    times, begin = np.asarray(timestamps_s, np.float64), time.perf_counter()
    found = smooth_trajectory(times, cam_from_world, covariance, options)
    spent = time.perf_counter() - begin
    rows = np.flatnonzero(np.isfinite(found.cam_from_world[:, 0]))
    frame_row = np.full(len(times), -1, np.int64)
    frame_row[rows] = np.arange(len(rows))
    used = np.where(found.is_predicted, -1, np.arange(len(times)))[rows]
    since = times[rows] - times[np.maximum.accumulate(used)] if len(rows) else np.zeros(0)
    return FilteredTrajectory(
        times[rows], found.cam_from_world[rows], found.covariance[rows], since, found.is_predicted[rows], frame_row,
        np.full((len(times), 6), np.nan), found.nis, found.is_rejected, "constant velocity", np.zeros(3), np.zeros(3),
        (0.0, 0.0), np.full(len(rows), spent / max(len(rows), 1)), np.ones(len(rows)),
    )  # fmt: skip


class _Sample(NamedTuple):
    """What the sensor said at a moment: gyro and accel (6,)."""

    timestamp_s: float
    value: Array


class InertialFilter:
    """The filter on its way: fed with samples and poses as they come, each kind in the order of its times.

    A sample moves the state on, and is a row at once. A pose corrects the state at its own time, also where samples
    have gone on meanwhile: these are integrated anew from there.

    Attributes:
        on_pose: called with the row of each sample, as soon as it is there.

    Args:
        sensor: its ``imu`` tells mounting and noises here, its measurements come one by one.
        speed: standard deviation of a velocity of which nothing is known, m/s.
    """

    def __init__(self, sensor: InertialSensor, speed: float, options: SmoothingOptions = LIVE) -> None:
        self.on_pose: Callable[[FilteredPose], None] | None = None
        self._options, self._start = options, FilterState(sensor, speed)
        self._anchor: FilterState | None = (
            None  # at the last frame, which was used or not; None: begins with the next pose
        )
        self._head: FilterState | None = None  # at the newest sample
        self._anchor_s = self._head_s = self._used_s = -math.inf
        self._samples: list[_Sample] = []  # from the last one before the anchor on
        self._in_a_row, self._is_waiting, self._interval_s = 0, False, math.inf
        self._had_pose = False  # the last frame
        self._since_forgotten = _WINDOW  # frames since what was predicted was forgotten
        self._rows, self._recent = FilteredRows(), deque[float](maxlen=_WINDOW)
        self._innovation, self._is_rejected, self._frame_row = array("d"), array("b"), array("q")  # of each frame

    def add_sample(self, timestamp_s: float, gyro: Array, accel: Array) -> None:
        """Move on to a sample: rad/s and m/s^2. One that is no later than the last is left out."""
        begin = time.perf_counter()
        sample = _Sample(timestamp_s, np.concatenate([gyro, accel]))
        if self._samples and not timestamp_s > self._samples[-1].timestamp_s:
            return
        is_silent = bool(self._samples) and timestamp_s - self._samples[-1].timestamp_s > MAX_SILENCE_S
        self._samples.append(sample)
        if is_silent or timestamp_s - self._used_s > self._options.max_gap_s:
            self._stop()
        if self._head is not None and timestamp_s > self._head_s:
            self._head.predict(self._step(self._head_s, timestamp_s))
            self._head_s = timestamp_s
            is_late = timestamp_s - self._used_s > _DROPPED * self._interval_s
            row = self._note(self._head, timestamp_s, self._is_waiting or is_late, begin)
            if self.on_pose is not None:
                (pose,), (covariance,) = as_given([row])
                self.on_pose(FilteredPose(timestamp_s, pose, covariance, row.since_pose_s, row.is_bridged))
        elif self._head is None:
            del self._samples[:-2]

    def add_frame(
        self, timestamp_s: float, pose: tuple[Array, Array, Array] | None, shared: Shared = INDEPENDENT,
        map_moved: Array = similarity.IDENTITY,
    ) -> float | None:  # fmt: skip
        """Correct by a frame, later than those before it.

        Args:
            pose: centre (3,), rotation world_from_cam (3, 3) and their covariance (6, 6); None of a frame without.
            shared: how far its error is that of the frames before.
            map_moved: (8,) a place x of the map was at map_moved(x) in the frame before: what an adjustment or a loop
                has changed is no motion, and the sensor knew nothing of it. In a gap, and right after it, it is not
                read as drift taken back: the map may have drifted meanwhile.

        Returns:
            The normalised innovation squared of a pose that was not believed; None otherwise.
        """
        begin = time.perf_counter()
        is_followed, self._had_pose = self._had_pose and pose is not None, pose is not None
        self._frame_row.append(-1)
        self._innovation.extend([math.nan] * 6)
        self._is_rejected.append(False)
        if self._anchor is not None and not self._reaches(timestamp_s):
            self._stop()
        if self._anchor is None:
            if pose is not None:
                self._begin_at(timestamp_s, pose, shared, begin)
            return None
        at_frame = self._anchor.copied()
        self._go_through(at_frame, self._anchor_s, timestamp_s)
        at_frame.move_map(map_moved, is_followed=is_followed)
        is_used = pose is not None and self._correct(at_frame, pose, shared)
        if self._anchor is None:
            assert pose is not None
            self._begin_at(timestamp_s, pose, shared, begin)
            return None
        if is_used:
            self._interval_s = timestamp_s - self._anchor_s
            self._used_s = timestamp_s
        self._is_waiting = not is_used
        self._hold(at_frame, timestamp_s)
        self._note_frame(at_frame, timestamp_s, not is_used, begin)
        return sum(value**2 for value in self._innovation[-6:]) if self._is_rejected[-1] else None

    @property
    def start_sigmas(self) -> tuple[float, float]:
        """Of the unit of length, relative, and of the direction of gravity, radians; infinite before the first pose."""
        state = self._anchor
        return (math.inf, math.inf) if state is None else (state.scale_sigma, state.tilt_sigma_rad)

    def settle(self) -> None:
        """Take what came so far for the start: the last frame is the first row, and its map is the world."""
        if self._anchor is None:
            return
        begin = time.perf_counter()
        state, now = self._anchor, self._anchor_s
        state.take_map_for_world()
        del self._innovation[:-6], self._is_rejected[:-1], self._frame_row[:-1]
        self._rows = FilteredRows()
        self._hold(state, now)
        self._note_frame(state, now, self._is_waiting, begin)

    def result(self) -> FilteredTrajectory:
        """All rows in the order of time."""
        rows, state = self._rows.table(), self._anchor or self._start
        innovation = np.array(self._innovation).reshape(-1, 6)
        return FilteredTrajectory(
            rows[:, 0], rows[:, 1:8], rows[:, 8:44].reshape(-1, 6, 6), rows[:, 44], rows[:, 45] == 1.0,
            np.array(self._frame_row, np.int64), innovation, (innovation**2).sum(1),
            np.array(self._is_rejected, bool), "imu",
            state.gyro_bias, state.accel_bias, state.clock_s, rows[:, 46], rows[:, 47],
        )  # fmt: skip

    def _begin_at(self, timestamp_s: float, pose: tuple[Array, Array, Array], shared: Shared, begin: float) -> None:
        state = self._start.copied()
        turning = self._value(timestamp_s)[:3] if self._samples else state.gyro_bias
        state.begin(*pose, shared, turning)
        self._used_s, self._in_a_row, self._is_waiting = timestamp_s, 0, False
        self._hold(state, timestamp_s)
        self._note_frame(state, timestamp_s, False, begin)

    def _stop(self) -> None:
        """Begin anew with the next pose, with the biases and the gravity that are known by now."""
        if self._anchor is not None:
            self._start = self._anchor
        self._anchor = self._head = None

    def _reaches(self, timestamp_s: float) -> bool:
        """Whether there are samples all the way to a frame."""
        if timestamp_s - self._used_s > self._options.max_gap_s or len(self._samples) < 2:
            return False
        return timestamp_s - self._samples[-1].timestamp_s <= MAX_SILENCE_S

    def _hold(self, state: FilterState, timestamp_s: float) -> None:
        """Go on from a state at the time of a frame, and take what came since then with it."""
        self._anchor, self._anchor_s = state, timestamp_s
        before = [n for n, sample in enumerate(self._samples) if sample.timestamp_s <= timestamp_s]
        del self._samples[: max(0, len(before) - 2)]
        self._head, self._head_s = state.copied(), timestamp_s
        newest = self._samples[-1].timestamp_s if self._samples else -math.inf
        if newest > timestamp_s:
            self._go_through(self._head, timestamp_s, newest)
            self._head_s = newest

    def _go_through(self, state: FilterState, start_s: float, stop_s: float) -> None:
        """Move a state on by the samples in between."""
        between = [sample.timestamp_s for sample in self._samples if start_s < sample.timestamp_s < stop_s]
        for now, then in itertools.pairwise([start_s, *between, stop_s]):
            if then > now:
                state.predict(self._step(now, then))

    def _step(self, start_s: float, stop_s: float) -> Array:
        """(7,) duration and mean measurements between two moments with no sample between them."""
        return np.concatenate([[stop_s - start_s], 0.5 * (self._value(start_s) + self._value(stop_s))])

    def _value(self, timestamp_s: float) -> Array:
        """Measurements (6,) between two samples; after the newest one as the last two go on."""
        samples = self._samples
        n = min(max(1, next((k for k, s in enumerate(samples) if s.timestamp_s >= timestamp_s), len(samples))),
                len(samples) - 1)  # fmt: skip
        if n < 1:
            return samples[0].value
        (first_s, first), (second_s, second) = samples[n - 1], samples[n]
        share = min(max((timestamp_s - first_s) / (second_s - first_s), 0.0), 2.0)
        value: Array = first + share * (second - first)
        return value

    def _correct(self, state: FilterState, pose: tuple[Array, Array, Array], shared: Shared) -> bool:
        """By the pose of a frame, if the motion does not contradict it."""
        center, rotation, noise = pose
        self._since_forgotten += 1
        state.drift(shared, noise, center)
        noise = shared.white * noise
        innovation = state.innovation(center, rotation)
        white = state.whitened(innovation, noise)
        self._innovation[-6:] = array("d", white)
        nis = float(white @ white)
        self._recent.append(min(nis, self._options.max_nis))
        if nis > self._options.max_nis:
            self._in_a_row += 1
            if self._in_a_row <= self._options.max_rejected:
                self._is_rejected[-1] = True
                return False
            if self._since_forgotten < _WINDOW:
                # the map jumped, and again: it is what the sensor is taken for that is wrong
                state.doubt()
                self._start, self._anchor, self._since_forgotten = state, None, _WINDOW
                return False
            state.forget(innovation)
            self._since_forgotten = 0
        self._in_a_row = 0
        state.correct(innovation, noise)
        return True

    def _widening(self) -> float:
        """By how much the innovations of the last frames are larger than expected, as a factor of variances; 1 where
        that may be chance. The quantile of chi-squared is that of Wilson and Hilferty, PNAS 1931."""
        num = len(self._recent)
        if num < _LEAST_WINDOW:
            return 1.0
        small = 2.0 / (9.0 * 6.0 * num)
        mean = sum(self._recent) / (6.0 * num)
        return mean if mean > (1.0 - small + _QUANTILE * math.sqrt(small)) ** 3 else 1.0

    def _note(self, state: FilterState, now: float, is_bridged: bool, begin: float) -> FilteredRow:
        rotation, center, covariance = state.camera()
        spent = time.perf_counter() - begin
        wider = self._widening()
        row = FilteredRow(now, rotation, center, wider * covariance, now - self._used_s, is_bridged, spent, wider)
        self._rows.add(row)
        return row

    def _note_frame(self, state: FilterState, now: float, is_bridged: bool, begin: float) -> None:
        """The row of the newest frame; samples and frames that come later are later ones."""
        self._note(state, now, is_bridged, begin)
        self._rows.settle(now)
        self._frame_row[-1] = self._rows.num_settled - 1
