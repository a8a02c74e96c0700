"""A rolling shutter reads the rows of an image one after the other: how fast, and where points would be had it not.

A point of row y is seen at the time ``readout (y / height - 1/2)`` from the middle of the image. How fast it moves in
the image there follows from the map itself: it is projected with the poses of the frames before and after. So the
readout, as a share of the time between frames, is the only unknown. A hand trembles faster than frames follow each
other: where there is a gyroscope, it tells how much faster the camera turned while a frame was read than on the way
from the frame before to the one after, if that clearly explains more.
Adjustments with three values of the readout tell where the cost is least, and whether the images care at all: a global
shutter, or a camera that hardly moves, leaves it at zero.

A map that was made as if there were none has given up observations for what the shutter did to them, most of all where
it did much. Those left speak for a readout that is too short, so which agree is asked again after each step towards it.
So does one whose readout was found early (:mod:`sfmapp.odometry.live_shutter`), and it has given up fewer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.problem import Varying
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import project
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu
from sfmapp.mapping.structure import residual_scale_px
from sfmapp.odometry.frontend.row_motion import by_rows
from sfmapp.odometry.inertial.window import swings_at
from sfmapp.odometry.map.backend import Job, classify, make_job, take_over
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.records import FrameRecord
from sfmapp.odometry.refinement.final_adjustment import MIN_EVIDENCE, MIN_SIGMA_PX
from sfmapp.odometry.report import ShutterReport
from sfmapp.odometry.tracker import measure_pose
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

# Steps, as shares of the time between frames, in which the least cost is looked for, first far and then near, until it
# has settled: the motion is known the better the straighter its images are. It has where the next change, were it as
# much smaller as the last one was, would move nothing by 0.05 pixels that moves by 20 from frame to frame. No camera
# reads longer than one frame; one that reads from the bottom up is mounted upside down.
FIRST_STRIDE, NEXT_STRIDE, _ROUNDS = 0.25, 0.1, 5
_SETTLED, _MAX_READOUT = 0.005, 1.0
# A sensor that reads within so small a share is as good as a global shutter: what is found is some other error.
_MIN_READOUT = 0.05
# What a gyroscope has to explain beyond the frames: as much as errors of patches, which are not independent, make of
# nothing (``MIN_EVIDENCE``).
_CLEAR = 30.0
# Frames that are farther apart than that many steady steps say nothing about the motion in between.
_MAX_GAP = 2.5
# A time over which a motion is straight, as a share of that between frames.
_SHORT = 0.01
# Of each adjustment, the last one having brought the map close to its minimum; and of a first glance, which spares all
# else where there is no sign of a rolling shutter.
_STEPS, _GLANCE_STEPS = 12, 3


class Found(NamedTuple):
    """A readout, the evidence for it, and the map adjusted with it, None where there is nothing to be believed."""

    readout: float
    evidence: float
    job: Job | None


@dataclass(frozen=True)
class Begun:
    """The readout of a rolling shutter that was found while a map grew, and the evidence for it, as those of
    :class:`~sfmapp.odometry.report.ShutterReport`."""

    readout: float = 0.0
    evidence: float = 0.0
    first_readout: float = 0.0


def straighten(
    records: list[FrameRecord], keyframes: KeyframeMap, map_idx: int, imu: Imu | None = None, begun: Begun | None = None
) -> ShutterReport:
    """Find the readout of the camera of a map, and move what its frames saw to where a global shutter had seen it.

    Where that is worth it, the map is adjusted, and observations and keyframes are changed in place; the frames between
    them are to be measured again. Else nothing is.

    Args:
        imu: measured beside the frames; None where there is none, or where it is not to count.
        begun: what was found before, and was taken off the keyframes as their ``row_shift``.

    Returns:
        The numbers behind the decision.
    """
    begun = begun or Begun()
    total, last, first = begun.readout, begun.readout, (begun.evidence, begun.first_readout)
    source: Imu | None = None
    for n in range(_ROUNDS):
        is_first = n == 0 and total == 0
        stride = FIRST_STRIDE if is_first else NEXT_STRIDE
        shift_of = RowShift(records, keyframes, map_idx, source)
        lay_shift(keyframes, shift_of, total)
        found = search(*make_question(keyframes, shift_of), stride, last)
        if is_first and imu is not None:
            shift_of = RowShift(records, keyframes, map_idx, imu)
            turned = search(*make_question(keyframes, shift_of), stride, last)
            if turned[1] > found[1] + _CLEAR:
                found, source = turned, imu
        readout, evidence, job = found
        if is_first:
            first = evidence, readout
        if job is None or not is_worth_it(readout, evidence, total):
            break
        total += readout
        lay_shift(keyframes, RowShift(records, keyframes, map_idx, source), total)
        classify(job.model, job.num_elsewhere)
        take_over(job, keyframes)
        if has_settled(readout, last):
            break
        _measure_again(records, keyframes, map_idx, total, source, beside_keyframes=True)
        last = readout
    if total:
        undo(records, keyframes, map_idx, total, source)
    return ShutterReport(evidence=first[0], min_evidence=MIN_EVIDENCE, first_readout=first[1], readout=total)


def is_worth_it(readout: float, evidence: float, total: float) -> bool:
    """Whether a readout is believed on top of what was found before: first by much evidence; what is next gained is
    little, but never a loss."""
    return evidence >= (0.0 if total else MIN_EVIDENCE) and _MIN_READOUT <= abs(total + readout) <= _MAX_READOUT


def has_settled(readout: float, last: float) -> bool:
    """Whether what would be found after this on top of a readout is nothing, by how much it was the time before."""
    return bool(last) and readout**2 < _SETTLED * abs(last)


def make_question(keyframes: KeyframeMap, shift_of: RowShift) -> tuple[Job, Array]:
    """A copy of a map that is asked for its readout, and (O, 2) how far that moves its observations."""
    everything = np.arange(len(keyframes.keyframes))
    job = make_job(keyframes, everything, everything > 0)
    model, tracks = job.model, job.model.tracks
    shifts = np.zeros_like(tracks.obs_xy)
    for k, keyframe in enumerate(keyframes.keyframes):
        obs = tracks.observations_of_image(k)
        shifts[obs] = shift_of(keyframe.frame_idx, model.point_xyz[tracks.obs_track_idx[obs]], tracks.obs_xy[obs])
    return job, shifts


def search(job: Job, shifts: Array, stride: float, last: float) -> Found:
    """The readout of least cost in steps of a stride, what it gains, and the map adjusted with it; None for the map
    where there is no least cost within reach, or costs that are no numbers; or, the first time, no sign of one.

    Args:
        last: what was found the time before, in whose direction the least cost is looked for first; 0 the first time.
    """
    if not shifts.any():
        return Found(0.0, 0.0, None)
    sigma = residual_scale_px(job.model, MIN_SIGMA_PX)
    towards = 1 if last > 0 else -1
    if last == 0:
        glance = [_adjusted(job, shifts, n * stride, sigma, _GLANCE_STEPS)[0] for n in (-1, 0, 1)]
        if not np.isfinite(glance).all() or abs(_vertex(*glance)) * stride < 0.5 * _MIN_READOUT:
            return Found(0.0, 0.0, None)
        towards = 1 if glance[2] < glance[0] else -1
    costs = {n: _adjusted(job, shifts, n * stride, sigma)[0] for n in (0, towards)}
    if not costs[towards] < costs[0]:
        costs[-towards] = _adjusted(job, shifts, -towards * stride, sigma)[0]
    best = min(costs, key=lambda n: (costs[n], abs(n)))
    while {best - 1, best + 1} - set(costs) and abs(best) * stride <= _MAX_READOUT:
        beyond = best + (1 if best > 0 else -1)
        costs[beyond] = _adjusted(job, shifts, beyond * stride, sigma)[0]
        if costs[beyond] >= costs[best]:
            break
        best = beyond
    if {best - 1, best + 1} - set(costs) or not np.isfinite(list(costs.values())).all():
        return Found(0.0, 0.0, None)
    readout = stride * (best + _vertex(costs[best - 1], costs[best], costs[best + 1]))
    cost, job.model = _adjusted(job, shifts, readout, sigma)
    return Found(readout, costs[0] - cost, job)


def _vertex(before: float, here: float, after: float) -> float:
    """Where a parabola through three costs at -1, 0 and 1 is least; beyond them if it bends the wrong way."""
    bend = before + after - 2 * here
    if bend <= 0:
        return 1.0 if after < before else -1.0
    return 0.5 * (before - after) / bend


def lay_shift(keyframes: KeyframeMap, shift_of: RowShift, readout: float, first: int = 0) -> None:
    """Note what a readout has done to the keyframes from one position on."""
    for keyframe in keyframes.keyframes[first:]:
        shift = None
        if readout:
            xyz = keyframes.point_xyz[keyframe.point_id]
            shift = readout * shift_of(keyframe.frame_idx, xyz, keyframe.xy[:, 0])
        keyframe.row_shift = shift


def undo(
    records: list[FrameRecord], keyframes: KeyframeMap, map_idx: int, readout: float, imu: Imu | None = None
) -> None:
    """Take what a readout adds from all observations of a map, in place."""
    _measure_again(records, keyframes, map_idx, readout, imu)
    shift_of = RowShift(records, keyframes, map_idx, imu)
    lay_shift(keyframes, shift_of, readout)
    for keyframe in keyframes.keyframes:
        keyframe.xy[:, 0], keyframe.row_shift = keyframe.straight_xy(0), None
    for record in records:
        if record.map_idx == map_idx and len(record.xy):
            xy = record.xy.astype(np.float64)
            shift = shift_of(record.frame_idx, keyframes.point_xyz[record.point_id], xy)
            record.see(record.point_id, xy - readout * shift)


def _measure_again(
    records: list[FrameRecord], keyframes: KeyframeMap, map_idx: int, readout: float, imu: Imu | None,
    beside_keyframes: bool = False,
) -> None:  # fmt: skip
    """Poses of the frames between the keyframes of a map, from what they saw less what a readout adds.

    Args:
        beside_keyframes: of those alone that a keyframe comes just before or after, by whose poses it moves.
    """
    mine = [r for r in records if r.map_idx == map_idx and r.has_pose]
    shift_of, camera = RowShift(records, keyframes, map_idx, imu), keyframes.rig.cameras[0]
    for before, record, after in zip([None, *mine], mine, [*mine[1:], None], strict=False):
        is_beside = any(r is not None and r.is_keyframe for r in (before, after))
        if record.is_keyframe or not len(record.xy) or (beside_keyframes and not is_beside):
            continue
        xyz, xy = keyframes.point_xyz[record.point_id], record.xy.astype(np.float64)
        known = np.isfinite(xyz[:, 0])
        keyframe = keyframes.keyframes[record.keyframe].rig_from_world
        straight = (xy - readout * shift_of(record.frame_idx, xyz, xy))[known]
        measured = measure_pose(camera, rigid3.compose(record.frame_from_keyframe, keyframe), xyz[known], straight)
        if measured is not None:
            record.measure(measured[1], rigid3.compose(measured[0], rigid3.inverse(keyframe)))


class RowShift:
    """How far points move in the image between the middle of a readout of a whole frame and their rows."""

    def __init__(
        self, records: list[FrameRecord], keyframes: KeyframeMap, map_idx: int, imu: Imu | None = None
    ) -> None:
        rows = [r for r in records if r.map_idx == map_idx and r.has_pose]
        self._camera = keyframes.rig.cameras[0]
        self._poses = [
            rigid3.compose(r.frame_from_keyframe, keyframes.keyframes[r.keyframe].rig_from_world) for r in rows
        ]
        self._position = {r.frame_idx: n for n, r in enumerate(rows)}
        self._times = np.array([r.timestamp_s for r in rows])
        self._unit = float(np.median(np.diff(self._times))) if len(rows) > 1 else 0.0
        # (F, 3) rad/s of the camera beyond what the frames say
        self._swings = None if imu is None or len(rows) < 2 else swings_at(self._times, imu)

    def __call__(self, frame_idx: int, xyz: Array, xy: Array) -> Array:
        """(N, 2) pixels for points seen at pixels in a frame; zero where the motion is not known."""
        n = self._position.get(frame_idx, -1)
        before, after = max(n - 1, 0), min(n + 1, len(self._poses) - 1)
        if n < 0 or after == before:
            return np.zeros_like(xy)
        gap = float(self._times[after] - self._times[before]) / self._unit
        if gap > _MAX_GAP:
            return np.zeros_like(xy)
        if self._swings is None or not np.isfinite(self._swings[n]).all():
            first, last = self._poses[before], self._poses[after]
        else:
            first, last, gap = *self._turned(n, before, after, gap), 2 * _SHORT
        here, there = (project(self._camera, rigid3.apply(pose, xyz)) for pose in (first, last))
        return by_rows(self._camera, (there - here) / gap, xy, 1.0)

    def _turned(self, n: int, before: int, after: int, gap: float) -> tuple[Array, Array]:
        """Poses (7,) a short time before and after a frame, which moves as those around it and turns faster by its
        swing."""
        assert self._swings is not None
        center, rotation = rigid3.center(self._poses[n]), rigid3.rotation_matrix(self._poses[n])
        around = [self._poses[k] for k in (before, after)]
        way = (rigid3.center(around[1]) - rigid3.center(around[0])) / gap
        first, last = (rigid3.rotation_matrix(pose) for pose in around)
        turn = rigid3.log_so3(last @ first.T) / gap - self._unit * self._swings[n]
        out = []
        for time in (-_SHORT, _SHORT):
            turned = rigid3.exp_so3(time * turn) @ rotation
            out.append(rigid3.from_matrix(turned, -turned @ (center + time * way)))
        return out[0], out[1]


def _adjusted(
    job: Job, shifts: Array, readout: float, sigma: float, steps: int = _STEPS
) -> tuple[float, Reconstruction]:
    """The map adjusted with a readout and its cost in squares of the noise."""
    model: Reconstruction = job.model.copy()
    model.tracks = replace(model.tracks, obs_xy=model.tracks.obs_xy - readout * shifts)
    options = AdjustOptions(
        loss="cauchy", loss_scale_px=2 * sigma, max_iterations=steps, relative_cost_tolerance=1e-5,
        refine_focal=False, refine_distortion=False,
    )  # fmt: skip
    return 2 * adjust_bundle(model, options, varying=Varying(images=job.is_variable)).final_cost / sigma**2, model
