"""The error-state filter beside an odometry run: fed with live poses and samples as they come, and what it says."""

from __future__ import annotations

import csv
import io
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.contradictions import Contradiction
from sfmapp.events import Event, Events
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


@dataclass
class _MapFilter:
    """What is filtered in one live map.

    Attributes:
        names: of its frames, with and without a pose; times_s and poses beside them.
        scale: metres per unit of the live poses, by the sensor.
        reason: why the sensor does not predict yet.
    """

    names: list[str] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    covariances: list[Array] = field(default_factory=list)
    shares: list[Shared] = field(default_factory=list)
    moved: list[Array] = field(default_factory=list)
    first: int = 0
    inertial: InertialFilter | None = None
    scale: float = 1.0
    next_sample: int = 0
    clock_offset_s: float = 0.0
    tried_s: float = -np.inf
    reason: str = ""


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
        now.names.append(frame.name)
        now.times_s.append(frame.timestamp_s)
        now.poses.append(frame.cam_from_world)
        now.covariances.append(frame.covariance)
        now.shares.append(shared)
        now.moved.append(frame.map_moved)
        if self._imu is None:
            return
        if now.inertial is not None:
            self._go_on(now, now.inertial, len(now.times_s) - 1)
        elif has_pose:
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
        while (sample := self._sample(now.next_sample)) is not None and sample[0] - now.clock_offset_s <= until_s:
            inertial.add_sample(float(sample[0]) - now.clock_offset_s, sample[1:4], sample[4:])
            now.next_sample += 1

    def _sample(self, idx: int) -> Array | None:
        """(7,) time, rates and forces; None where there is none yet."""
        imu = self._imu
        if isinstance(imu, ImuStream):
            return imu.sample(idx)
        if imu is None or idx >= len(imu.timestamps_s):
            return None
        return np.concatenate([imu.timestamps_s[idx : idx + 1], imu.gyro[idx], imu.accel[idx]])

    def _begin(self, now: _MapFilter, imu: Imu) -> None:
        """Look for a start in the last seconds, once in a while, and go through them: what the filter knows at their
        end, and how sure it is, follows from the poses and their covariances as it does later."""
        times = np.array(now.times_s)
        if times[-1] - times[0] < SHORTEST_S or times[-1] - now.tried_s < STEP_S:
            return
        now.tried_s = float(times[-1])
        recent = np.flatnonzero(times >= times[-1] - LONGEST_S)
        found = start_of(times[recent], _in_last_map(now, recent), until(imu, now.tried_s), is_metric=self._is_metric)
        if isinstance(found, str):
            now.reason = found
            return
        now.scale, now.clock_offset_s = found.scale, found.clock_offset_s
        measured = [int(n) for n in recent if np.isfinite(now.covariances[n]).all()]
        first = next((n for n in measured if now.shares[n] is not INDEPENDENT), measured[0])
        # the last samples before the frame tell the first after it
        after = int(np.searchsorted(imu.timestamps_s - now.clock_offset_s, times[first], "right"))
        now.next_sample = max(0, after - 2)
        inertial = InertialFilter(found.sensor, _UNKNOWN_SPEED)
        for n in range(first, len(times)):
            self._go_on(now, inertial, n)
        now.reason = why_too_early(*inertial.start_sigmas)
        if not now.reason:
            inertial.settle()
            inertial.on_pose = self._on_pose
            now.inertial, now.first = inertial, len(times) - 1

    def _go_on(self, now: _MapFilter, inertial: InertialFilter, n: int) -> None:
        """The samples until a frame, and the frame."""
        frame_s = now.times_s[n]
        self._sense(now, inertial, frame_s)
        measured = read_measured(
            [frame_s], in_metres(now.poses[n][None], now.scale), scale_covariance(now.covariances[n], now.scale)[None]
        )
        inertial.add_frame(frame_s, measured.pose(0), now.shares[n], in_metres(now.moved[n], now.scale))

    def finish(self, events: Events) -> tuple[FilteredTrajectory, FilterReport] | None:
        """What was found of the map with the most poses, and what there is to say of it; None without a frame."""
        if not self._maps:
            return None
        most = max(self._maps.values(), key=lambda entry: int(np.isfinite(np.array(entry.poses)[:, 0]).sum()))
        if most.inertial is not None:
            found = most.inertial.result()
        else:
            found = _at_constant_velocity(most)
        names = most.names[most.first :]
        shares = np.array(most.shares)[most.first :]
        reason = (most.reason or "the map was too short") if self._imu is not None and most.inertial is None else None
        report = _report(found, names, most.times_s[most.first :], shares, reason)
        events.decided(STAGE, _told(report), **report)
        return found, report


def _in_last_map(now: _MapFilter, frames: NDArray[np.int64]) -> Array:
    """(N, 7) poses of some frames, the last one among them, as the map has them now that adjustments have moved it."""
    poses, before_from_now = np.full((len(frames), 7), np.nan), similarity.IDENTITY
    for k in range(len(frames) - 1, -1, -1):
        if np.isfinite(now.poses[frames[k]][0]):
            poses[k] = similarity.transform_poses(similarity.inverse(before_from_now), now.poses[frames[k]])
        before_from_now = similarity.compose(now.moved[frames[k]], before_from_now)
    return poses


def _at_constant_velocity(entry: _MapFilter) -> FilteredTrajectory:
    """The same by the poses alone. What walks with the map is motion to this filter; what frames share is added to what
    it says of itself."""
    covariances, white = np.array(entry.covariances), np.array([share.white for share in entry.shares])[:, None, None]
    found = filter_trajectory(entry.times_s, np.array(entry.poses), white * covariances)
    common = np.where(np.isfinite(covariances), (1.0 - white) * covariances, 0.0)
    rows = np.flatnonzero(found.frame_row >= 0)
    return replace(found, covariance=found.covariance + common[rows])


def filtered_csv(found: FilteredTrajectory) -> str:
    """How sure each pose is, and what it hangs on."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    position, rotation = found.position_sigma, np.degrees(found.rotation_sigma_rad)
    for n, timestamp_s in enumerate(found.timestamps_s):
        writer.writerow([
            repr(float(timestamp_s)), f"{position[n]:.6g}", f"{rotation[n]:.6g}", f"{found.since_pose_s[n]:.6g}",
            int(found.is_bridged[n]), f"{1e3 * found.latency_s[n]:.4g}",
        ])  # fmt: skip
    return text.getvalue()


def _report(
    found: FilteredTrajectory, names: list[str], times_s: list[float], shares: Array, reason: str | None
) -> FilterReport:
    latency = 1e3 * found.latency_s if len(found.latency_s) else np.zeros(1)
    rate = 1.0 / float(np.median(np.diff(found.timestamps_s))) if len(found.timestamps_s) > 1 else 0.0
    rejected = [
        RejectedPose(
            name=names[f], timestamp_s=times_s[f],
            reason=f"the motion contradicts it: NIS {found.nis[f]:.0f} of 6 degrees of freedom, at most "
            f"{LIVE.max_nis:g} is believed",
        )
        for f in np.flatnonzero(found.is_rejected)
    ]  # fmt: skip
    rows = found.frame_row[found.frame_row >= 0]
    white, walk, _ = np.median(shares, axis=0).tolist() if len(shares) else Shared(1.0, 0.0)
    return FilterReport(
        prediction=found.prediction, num_poses=len(found.timestamps_s), rate_hz=round(rate, 3),
        num_used=int((found.since_pose_s[rows] == 0.0).sum()), rejected=rejected, gaps=list(_gaps(found)),
        latency_ms_median=float(np.median(latency)), latency_ms_p95=float(np.percentile(latency, 95)),
        latency_ms_max=float(latency.max()), white_share=white, walk_share=walk, reason=reason,
        consistency=consistency(found.nis), contradictions=_contradictions(found),
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
            f"; innovations {told.mean:.2f} of what is expected ({told.mean_low:.2f} to {told.mean_high:.2f} by "
            f"chance), {told.share_inside:.0%} inside 95 %"
        )
    return text if report.reason is None else f"{text}; not by the IMU: {report.reason}"
