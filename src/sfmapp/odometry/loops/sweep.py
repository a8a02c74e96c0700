"""Adjusting a large map piece by piece, where all at once would take too long."""

from __future__ import annotations

from sfmapp.events import Events
from sfmapp.odometry.loops.pose_graph import count_shared
from sfmapp.odometry.map.backend import choose_window, make_job, run_job, take_over
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.options import OdometryOptions

# Up to so many keyframes everything is adjusted at once, and beyond that if no more than this share of all pairs of
# keyframes share points: factorising the rest takes time with the cube of the keyframes.
_ALWAYS_WHOLE, _MAX_COUPLING = 200, 0.1


def is_too_large(keyframes: KeyframeMap) -> bool:
    """Whether a map has so many keyframes that see the same points that it is better adjusted piece by piece."""
    num = len(keyframes.keyframes)
    return num > _ALWAYS_WHOLE and float((count_shared(keyframes) > 0).mean()) > _MAX_COUPLING


def sweep(keyframes: KeyframeMap, options: OdometryOptions, events: Events, num_sweeps: int = 2) -> None:
    """Adjust overlapping windows from the first keyframe to the last and again, in place; what is around a window and
    shares points with it stays (block Gauss-Seidel), and so do the keyframes of a map that was there before."""
    num, step = len(keyframes.keyframes), max(1, options.window // 2)
    for _ in range(num_sweeps):
        for newest in range(max(min(options.window, num) - 1, keyframes.num_known), num, step):
            job = make_job(keyframes, *choose_window(keyframes, options, newest))
            take_over(run_job(job), keyframes)
            events.raise_if_cancelled()
