"""The error-state filter beside an odometry run: fed with live poses and samples as they come, and what it says."""

from __future__ import annotations

import csv
import math
import threading
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.contradictions import Contradiction
from sfmapp.events import Event, Events
from sfmapp.formats.atomic import replaced_file
from sfmapp.geometry import similarity
from sfmapp.images.imu_stream import ImuStream
from sfmapp.images.live_sequence import LiveSequence
from sfmapp.images.sequence import Imu, Sequence
from sfmapp.odometry.inertial.filter_state import INDEPENDENT, Shared
from sfmapp.odometry.inertial.filtering import (
    LIVE,
    FilteredPose,
    FilteredTrajectory,
    InertialFilter,
    consistency,
    filter_trajectory,
)
from sfmapp.odometry.inertial.live_start import (
    LONGEST_S,
    SHORTEST_S,
    STEP_S,
    in_metres,
    start_of,
    until,
    why_too_early,
)
from sfmapp.odometry.inertial.scale import scale_covariance
from sfmapp.odometry.inertial.smoothing import read_measured
from sfmapp.odometry.report import FilterGap, FilterReport, RejectedPose
from sfmapp.odometry.snapshot import FrameSnapshot

Array = NDArray[np.float64]

STAGE = "filter"
COLUMNS = ("timestamp_s", "position_sigma", "rotation_sigma_deg", "since_pose_s", "is_bridged", "latency_ms")
# Of what neighbouring residuals have in common the last second of frames tells, each the less the older it is.
_FORGET = 0.95
# What is new in every frame is at least the noise of its own pixels, a small part of all.
_LEAST_WHITE = 0.02
# How far a frame is believed to have more of that than others, where its own residuals say so: what walks on is no
# steadier than what is new, and of three numbers of about the same variance only one sum is known.
_OWN = 0.5
# Of a velocity of which nothing is known, m/s: whatever carries a camera.
_UNKNOWN_SPEED = 10.0


# Sigmas that had to be widened for a while are told by their size; for longer they are a contradiction.
_MAX_WIDENED = 0.1


class SharedErrors:
    """How live poses err together, by what the residuals of neighbouring frames have in common.

    Errors that partly are new in each frame, and partly walk on with the map at a rate that lasts, have over n frames
    the correlation r with 1 - r = white + (walk n + (walk n)^2) / 2, as long as the rate is the same
    (:meth:`~sfmapp.odometry.inertial.filter_state.FilterState.drift`); white and walk follow from n = 1 and 2.
    """

    def __init__(self) -> None:
        self._sums, self._weight, self._last_white = np.zeros(3), 0.0, _LEAST_WHITE

    def add(self, frame: FrameSnapshot) -> Shared:
        """Learn from a frame; what is known by then."""
        found = np.array(frame.correlation)
        if np.isfinite(found).all():
            self._sums, self._weight = _FORGET * self._sums + found, _FORGET * self._weight + 1.0
        if self._weight == 0.0:
            return INDEPENDENT
        r1, r2, renewed = (self._sums / self._weight).tolist()
        walk = (math.sqrt(1.0 + 24.0 * max(0.0, min(r1 - r2, 1.0 - r1))) - 1.0) / 6.0
        usual = 1.0 - 2.0 * r1 + r2 + walk**2
        white = usual
        if np.isfinite(found[0]):
            # 1 - r1 has half of what is new in the frame, and half of what was in the one before it
            white += _OWN * (2.0 * (1.0 - float(found[0])) - walk - walk**2 - self._last_white - usual)
        self._last_white = min(1.0, max(_LEAST_WHITE, white))
        return Shared(self._last_white, walk, renewed)


class _Frame(NamedTuple):
    """A frame as it was given out; ``moved`` is its ``map_moved``."""

    name: str
    timestamp_s: float
    pose: Array
    covariance: Array
    shared: Shared
    moved: Array


@dataclass
class _MapFilter:
    """What is filtered in one live map.

    Attributes:
        frames: with and without a pose, until the sensor predicts; of later ones the filter has what it needs.
        num_with_pose: of all.
        shares: three numbers of each frame since the filter begins. rejected: of these frames.
        scale: metres per unit of the live poses, by the sensor.
        sensed_s: the last sample that the filter had.
        reason: why the sensor does not predict yet.
    """

    frames: list[_Frame] = field(default_factory=list)
    num_with_pose: int = 0
    shares: array[float] = field(default_factory=lambda: array("d"))
    rejected: list[RejectedPose] = field(default_factory=list)
    inertial: InertialFilter | None = None
    scale: float = 1.0
    sensed_s: float = -math.inf
    clock_offset_s: float = 0.0
    tried_s: float = -math.inf
    reason: str = ""

    def keep(self, frame: _Frame, rejected_nis: float | None) -> None:
        """What the report needs of a frame that the filter had."""
        self.shares.extend(frame.shared)
        if rejected_nis is not None:
            self.rejected.append(_rejected(frame, rejected_nis))


def filter_beside(sequence: Sequence) -> LiveFilter:
    """The filter of a run over a sequence."""
    is_metric = sequence.rig.is_stereo
    if isinstance(sequence, LiveSequence) and sequence.imu_stream is not None:
        return LiveFilter(sequence.imu_stream, is_metric=is_metric, on_pose=sequence.on_filtered)
    return LiveFilter(sequence.imu, is_metric=is_metric)


def pushes_imu(sequence: Sequence) -> bool:
    """Whether inertial measurements come one by one beside the frames."""
    return isinstance(sequence, LiveSequence) and sequence.imu_stream is not None


class LiveFilter:
    """Listener of a run that filters its live poses, each map apart.

    With a sensor each row is found as its sample comes. Without one the poses wait for the end, as the level of the
    accelerations is that of all; each row still knows only of what came before it.

    A sample that a program pushes goes on from the last frame at once, in the thread that pushes; where the filter is
    busy with a frame, it goes on from that, in the thread that tracks.

    Args:
        imu: on the clock of the frames, all of it or as it comes; None without one.
        is_metric: live poses are in metres.
        on_pose: called with the row of each sample once the sensor predicts.
    """

    def __init__(
        self, imu: Imu | ImuStream | None, *, is_metric: bool, on_pose: Callable[[FilteredPose], None] | None = None
    ) -> None:
        self._imu, self._is_metric, self._on_pose = imu, is_metric, on_pose
        self._maps: dict[int, _MapFilter] = {}
        self._current = -1
        self._shared = SharedErrors()
        self._lock = threading.Lock()
        if isinstance(imu, ImuStream):
            imu.listen(self._sense_newest)

    def __call__(self, event: Event) -> None:
        seen = event.data.get("snapshot")
        if isinstance(seen, FrameSnapshot):
            self.add(seen)

    def add(self, frame: FrameSnapshot) -> None:
        """Take a frame along as it was given out."""
        with self._lock:
            self._add(frame)

    def _add(self, frame: FrameSnapshot) -> None:
        shared, has_pose = self._shared.add(frame), bool(np.isfinite(frame.cam_from_world[0]))
        if has_pose and frame.map_idx != self._current:
            self._current = frame.map_idx
            # one that is found again is in the frame that it had, and knows what it knew
            self._maps.setdefault(self._current, _MapFilter())
        if self._current < 0:
            return
        now = self._maps[self._current]
        now.num_with_pose += has_pose
        taken = _Frame(frame.name, frame.timestamp_s, frame.cam_from_world, frame.covariance, shared, frame.map_moved)
        if self._imu is not None and now.inertial is not None:
            now.keep(taken, self._go_on(now, now.inertial, taken))
        else:
            now.frames.append(taken)
            if self._imu is not None and has_pose:
                self._begin(now, self._imu.recorded() if isinstance(self._imu, ImuStream) else self._imu)
        if isinstance(self._imu, ImuStream) and now.inertial is not None:  # what came while it was busy
            self._sense(now, now.inertial, math.inf)

    def _sense_newest(self) -> None:
        """A sample has come."""
        if self._lock.acquire(blocking=False):
            try:
                now = self._maps.get(self._current)
                if now is not None and now.inertial is not None:
                    self._sense(now, now.inertial, math.inf)
            finally:
                self._lock.release()

    def _sense(self, now: _MapFilter, inertial: InertialFilter, until_s: float) -> None:
        """The samples until a moment."""
        while len(samples := self._samples(now.sensed_s, until_s + now.clock_offset_s)):
            for sample in samples:
                inertial.add_sample(float(sample[0]) - now.clock_offset_s, sample[1:4], sample[4:])
            now.sensed_s = float(samples[-1][0])

    def _samples(self, after_s: float, until_s: float) -> Array | list[Array]:
        """Time, rates and forces (7,) of each after a moment until another one, on the sensor's clock."""
        imu = self._imu
        if imu is None:
            return []
        if isinstance(imu, ImuStream):
            return [sample for sample in imu.after(after_s) if sample[0] <= until_s]
        some = slice(*np.searchsorted(imu.timestamps_s, [after_s, until_s], "right").tolist())
        return np.column_stack([imu.timestamps_s[some], imu.gyro[some], imu.accel[some]])

    def _begin(self, now: _MapFilter, imu: Imu) -> None:
        """Look for a start in the last seconds, once in a while, and go through them: what the filter knows at their
        end, and how sure it is, follows from the poses and their covariances as it does later."""
        first_s, last_s = now.frames[0].timestamp_s, now.frames[-1].timestamp_s
        if last_s - first_s < SHORTEST_S or last_s - now.tried_s < STEP_S:
            return
        now.tried_s = last_s
        recent = [frame for frame in now.frames if frame.timestamp_s >= last_s - LONGEST_S]
        times = np.array([frame.timestamp_s for frame in recent])
        found = start_of(times, _in_last_map(recent), until(imu, last_s), is_metric=self._is_metric)
        if isinstance(found, str):
            now.reason = found
            return
        now.scale, now.clock_offset_s = found.scale, found.clock_offset_s
        measured = [n for n, frame in enumerate(recent) if np.isfinite(frame.covariance).all()]
        first = next((n for n in measured if recent[n].shared is not INDEPENDENT), measured[0])
        # the last two samples before the frame tell the first after it
        before = np.searchsorted(imu.timestamps_s - now.clock_offset_s, times[first], "right") - 3
        now.sensed_s = float(imu.timestamps_s[before]) if before >= 0 else -math.inf
        inertial = InertialFilter(found.sensor, _UNKNOWN_SPEED)
        nis = None
        for frame in recent[first:]:
            nis = self._go_on(now, inertial, frame)
        now.reason = why_too_early(*inertial.start_sigmas)
        if not now.reason:
            inertial.settle()
            inertial.on_pose = self._on_pose
            now.inertial = inertial
            now.frames.clear()
            now.keep(recent[-1], nis)

    def _go_on(self, now: _MapFilter, inertial: InertialFilter, frame: _Frame) -> float | None:
        """The samples until a frame, and the frame; its NIS if its pose was not believed."""
        frame_s = frame.timestamp_s
        self._sense(now, inertial, frame_s)
        measured = read_measured(
            [frame_s], in_metres(frame.pose[None], now.scale), scale_covariance(frame.covariance, now.scale)[None]
        )
        return inertial.add_frame(frame_s, measured.pose(0), frame.shared, in_metres(frame.moved, now.scale))

    def finish(self, events: Events) -> tuple[FilteredTrajectory, FilterReport] | None:
        """What was found of the map with the most poses, and what there is to say of it; None without a frame."""
        if not self._maps:
            return None
        most = max(self._maps.values(), key=lambda entry: entry.num_with_pose)
        if most.inertial is not None:
            found, shares = most.inertial.result(), np.array(most.shares).reshape(-1, 3)
        else:
            found, shares = _at_constant_velocity(most.frames), np.array([frame.shared for frame in most.frames])
            most.rejected = [_rejected(most.frames[f], float(found.nis[f])) for f in np.flatnonzero(found.is_rejected)]
        reason = (most.reason or "the map was too short") if self._imu is not None and most.inertial is None else None
        report = _report(found, most.rejected, shares, reason)
        events.decided(STAGE, _told(report), **report)
        return found, report


def _rejected(frame: _Frame, nis: float) -> RejectedPose:
    return RejectedPose(
        name=frame.name, timestamp_s=frame.timestamp_s,
        reason=f"the motion contradicts it: NIS {nis:.0f} of 6 degrees of freedom, at most {LIVE.max_nis:g} is "
        "believed",
    )  # fmt: skip


def _in_last_map(frames: list[_Frame]) -> Array:
    """(N, 7) poses of frames, as the map has them at the last one now that adjustments have moved it."""
    poses, before_from_now = np.full((len(frames), 7), np.nan), similarity.IDENTITY
    for k in range(len(frames) - 1, -1, -1):
        if np.isfinite(frames[k].pose[0]):
            poses[k] = similarity.transform_poses(similarity.inverse(before_from_now), frames[k].pose)
        before_from_now = similarity.compose(frames[k].moved, before_from_now)
    return poses


def _at_constant_velocity(frames: list[_Frame]) -> FilteredTrajectory:
    """The same by the poses alone. What walks with the map is motion to this filter; what frames share is added to what
    it says of itself."""
    covariances = np.array([frame.covariance for frame in frames])
    white = np.array([frame.shared.white for frame in frames])[:, None, None]
    found = filter_trajectory(
        [frame.timestamp_s for frame in frames], np.array([frame.pose for frame in frames]), white * covariances
    )
    common = np.where(np.isfinite(covariances), (1.0 - white) * covariances, 0.0)
    rows = np.flatnonzero(found.frame_row >= 0)
    return replace(found, covariance=found.covariance + common[rows])


def write_filtered_csv(path: Path, found: FilteredTrajectory) -> None:
    """How sure each pose is, and what it hangs on."""
    position, rotation = found.position_sigma, np.degrees(found.rotation_sigma_rad)
    columns = (found.timestamps_s, position, rotation, found.since_pose_s, found.is_bridged, 1e3 * found.latency_s)
    with replaced_file(path) as beside, beside.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for timestamp_s, *sigmas, since_s, is_bridged, latency_ms in zip(*columns, strict=True):
            numbers = [f"{value:.6g}" for value in (*sigmas, since_s)]
            writer.writerow([repr(float(timestamp_s)), *numbers, int(is_bridged), f"{latency_ms:.4g}"])


def _report(found: FilteredTrajectory, rejected: list[RejectedPose], shares: Array, reason: str | None) -> FilterReport:
    latency = 1e3 * found.latency_s if len(found.latency_s) else np.zeros(1)
    rate = 1.0 / float(np.median(np.diff(found.timestamps_s))) if len(found.timestamps_s) > 1 else 0.0
    rows = found.frame_row[found.frame_row >= 0]
    white, walk, _ = np.median(shares, axis=0).tolist() if len(shares) else Shared(1.0, 0.0)
    return FilterReport(
        prediction=found.prediction, num_poses=len(found.timestamps_s), rate_hz=round(rate, 3),
        num_used=int((found.since_pose_s[rows] == 0.0).sum()), rejected=rejected, gaps=list(_gaps(found)),
        latency_ms_median=float(np.median(latency)), latency_ms_p95=float(np.percentile(latency, 95)),
        latency_ms_max=float(latency.max()), white_share=white, walk_share=walk, reason=reason,
        consistency=consistency(found.nis, found.innovation), contradictions=_contradictions(found),
    )  # fmt: skip


def _contradictions(found: FilteredTrajectory) -> list[Contradiction]:
    """What the motion says against the stated sigmas: none where no more than a tenth of them had to be widened."""
    wide = np.flatnonzero(found.widening > 1.0)
    share = len(wide) / max(1, len(found.widening))
    if share <= _MAX_WIDENED:
        return []
    factor = float(found.widening.max())
    return [Contradiction(
        "filtered live poses",
        f"poses are {math.sqrt(factor):.1f} times as far as their sigmas say from where the IMU expects them, first at "
        f"{found.timestamps_s[wide[0]]:.2f} s; sigmas of {share:.0%} of the filtered poses are wider for it",
        "check the noise densities of the IMU, its mounting and its clock; the live poses may be wrong as well",
        {"variance_factor": factor, "share_widened": share, "max_share": _MAX_WIDENED},
    )]  # fmt: skip


def _gaps(found: FilteredTrajectory) -> Iterator[FilterGap]:
    """Stretches of poses that were bridged, each from the last pose that was used."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], found.is_bridged.astype(np.int8), [0]])))
    position, rotation = found.position_sigma, found.rotation_sigma_rad
    for last in edges[1::2] - 1:
        yield FilterGap(
            first_s=float(found.timestamps_s[last] - found.since_pose_s[last]), last_s=float(found.timestamps_s[last]),
            position_sigma=float(position[last]), rotation_sigma_deg=float(np.degrees(rotation[last])),
        )  # fmt: skip


def _told(report: FilterReport) -> str:
    text = (
        f"filtered live by {report.prediction.replace('imu', 'the IMU')}: {report.num_poses} poses at "
        f"{report.rate_hz:.4g} Hz, {report.num_used} measured ones used, {len(report.rejected)} rejected, "
        f"{len(report.gaps)} gaps bridged"
    )
    if report.consistency is not None:
        told = report.consistency
        text += (
            f"; innovations {told.mean:.2f} of what is expected ({told.correlated_low:.2f} to "
            f"{told.correlated_high:.2f} by chance: {told.num_innovations} that are worth {told.num_independent:.0f} "
            f"independent ones), {told.share_inside:.0%} inside 95 %"
        )
    return text if report.reason is None else f"{text}; not by the IMU: {report.reason}"
