"""The last adjustment of all: of the frames between the keyframes as well.

Keyframes are a tenth of the frames of a camera that stays in a room, and those whose points others see are dropped on
the way. What all the others saw was remembered. Adjusted together with them, points and poses rest on ten times as many
observations, and the poses in between no longer on one measurement alone. Long tracks of bad corners are told by it,
too: they hold a large share of all squared residuals.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.mapping.structure import residual_scale_px
from sfmapp.odometry.map.backend import classify, make_job, take_over
from sfmapp.odometry.map.keyframe_map import Keyframe, KeyframeMap
from sfmapp.odometry.records import FrameRecord, measure_again, shows_the_same
from sfmapp.odometry.refinement.calibration_check import adjust_poses
from sfmapp.odometry.refinement.final_adjustment import MIN_SIGMA_PX

Array = NDArray[np.float64]

# Frames and keyframes that are adjusted together at most; of more frames every so many takes part.
_MOST_IMAGES = 2000
# Rounds, each of which decides afresh which observations agree, and the most steps of each: later ones let go of single
# observations. Of 8 steps instead of 4 errors are 1.95, 2.77 and 3.00 for 2.02, 2.47 and 3.08 mm (rendered hand-held
# rooms 1, 2 and 4, of which 4 chose nothing), for 1.6 times the time. With every other frame alone 4 had 3.51.
_ROUNDS, _STEPS, _TOLERANCE = 2, 4, 1e-5


def adjust_frames(records: list[FrameRecord], keyframes: KeyframeMap, map_idx: int, events: Events) -> int:
    """Adjust the keyframes, the points and the frames between them together, in place, by what one camera saw.

    Args:
        records: as :func:`~sfmapp.odometry.records.measure_again` has left them.

    Returns:
        How many frames took part. None do where they saw less than the keyframes have: a camera that moves so fast that
        most frames are keyframes gains nothing.
    """
    mine = [record for record in records if record.map_idx == map_idx and record.has_pose]
    frames = _frames_between(mine)
    num_keyframes = len(keyframes.keyframes)
    of_keyframes = sum(int(keyframe.is_inlier.sum()) for keyframe in keyframes.keyframes)
    if sum(len(record.xy) for record in frames) < of_keyframes or num_keyframes >= _MOST_IMAGES:
        return 0
    every = -(-len(frames) // (_MOST_IMAGES - num_keyframes))
    frames = frames[::every]
    whole = KeyframeMap(keyframes.rig, [*keyframes.keyframes, *(_as_keyframe(r, keyframes) for r in frames)])
    whole.point_xyz, whole.num_points = keyframes.point_xyz, keyframes.num_points
    whole.recount()
    everything = np.arange(len(whole.keyframes))
    job = make_job(whole, everything, everything > 0)
    for _ in range(_ROUNDS):
        adjust_poses(job.model, residual_scale_px(job.model, MIN_SIGMA_PX), _STEPS, _TOLERANCE, events=events)
        classify(job.model, job.num_elsewhere)
        events.raise_if_cancelled()
    take_over(job, whole)
    measure_again(records, keyframes, map_idx)
    for record, adjusted in zip(frames, whole.keyframes[num_keyframes:], strict=True):
        before = keyframes.keyframes[record.keyframe]
        moved = rigid3.compose(adjusted.rig_from_world, rigid3.inverse(before.rig_from_world))
        record.measure(record.covariance, moved)
    for before_it, twin in pairwise(mine):
        if shows_the_same(twin, before_it):
            twin.measure(before_it.covariance, before_it.frame_from_keyframe)
    return len(frames)


def _frames_between(mine: list[FrameRecord]) -> list[FrameRecord]:
    """The frames of a map that saw something of their own and are no keyframes."""
    before: list[FrameRecord | None] = [None, *mine]
    return [
        r
        for r, last in zip(mine, before, strict=False)
        if len(r.xy) and not r.is_keyframe and not (last is not None and shows_the_same(r, last))
    ]


def _as_keyframe(record: FrameRecord, keyframes: KeyframeMap) -> Keyframe:
    """A frame with the points of the map that it saw."""
    # loops have made points one that a frame may have seen as two
    point_id, first = np.unique(record.point_id.astype(np.int64), return_index=True)
    known = keyframes.is_triangulated(point_id)
    point_id, xy = point_id[known], record.xy[first[known]].astype(np.float64)[:, None]
    pose = rigid3.compose(record.frame_from_keyframe, keyframes.keyframes[record.keyframe].rig_from_world)
    is_inlier = np.ones((len(point_id), 1), bool)
    return Keyframe(record.frame_idx, record.timestamp_s, record.name, pose, point_id, xy, is_inlier)
