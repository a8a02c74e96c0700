"""Where a camera can have come while it was not seen: what its way says of a place that it seems to turn up at.

A camera goes on as it did, stops, or turns, so it is within the way that it can have gone of where it would be had it
gone on (dead reckoning). What looks like a place of a map and lies outside of that may be one that the camera was
carried to; it may as well be the like of it that no map has seen yet, of which landmarks tell nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.map.keyframe_map import KeyframeMap

Array = NDArray[np.float64]

# What a place is known to, share of the depth of what is seen there: two poses farther apart are two places.
_SURE_DEPTHS = 0.1


@dataclass(frozen=True)
class Way:
    """Where and when keyframes (K) were taken: ascending seconds (K,), and centres (K, 3)."""

    timestamps_s: Array
    center: Array

    def before(self, timestamp_s: float) -> Way:
        """The part before a time."""
        num = int(np.searchsorted(self.timestamps_s, timestamp_s))
        return Way(self.timestamps_s[:num], self.center[:num])


def way_of(keyframes: KeyframeMap, b_from_a: Array = similarity.IDENTITY) -> Way:
    """The way on which a run has made a map, moved by a similarity (8,); keyframes that it knew before are of none."""
    own = keyframes.keyframes[keyframes.num_known :]
    poses = np.array([k.rig_from_world for k in own]).reshape(-1, 7)
    return Way(np.array([k.timestamp_s for k in own]), similarity.apply(b_from_a, rigid3.center(poses)))


def log_ratio_of_gap(way: Way, timestamp_s: float, center: Array, depth: float) -> float | None:
    """Logarithm of how much likelier a camera that was last seen on a way has come to a place than to one that looks
    like it, negative where it can have come to several such; None where the way does not lead there.

    Both are even densities over a plane: of the camera one out to the way that it can have gone at its highest speed,
    about where it would be had it gone on, of look-alikes one out to the depth.

    Args:
        way: up to where it was last seen. timestamp_s, center: when and where (3,) it is seen again.
        depth: of what is seen there.
    """
    if len(way.timestamps_s) < 2:
        return None
    steps, seconds = np.diff(way.center, axis=0), np.maximum(np.diff(way.timestamps_s), 1e-9)
    gap_s = timestamp_s - way.timestamps_s[-1]
    reach = max(gap_s * float((np.linalg.norm(steps, axis=1) / seconds).max()), _SURE_DEPTHS * depth)
    expected = way.center[-1] + gap_s / seconds[-1] * steps[-1]
    if np.linalg.norm(center - expected) > reach:
        return None
    return -2.0 * math.log(reach / depth)


def log_ratio_of_seam(old: Way, new: Way, depth: float) -> float | None:
    """The same of two maps that one camera has made, the new one where a loop puts it, at the keyframes of both that
    are nearest in time."""
    apart = np.abs(old.timestamps_s[:, None] - new.timestamps_s)
    if not apart.size:
        return None
    i, j = np.unravel_index(int(apart.argmin()), apart.shape)
    if old.timestamps_s[i] < new.timestamps_s[j]:
        return log_ratio_of_gap(old.before(new.timestamps_s[j]), new.timestamps_s[j], new.center[j], depth)
    return log_ratio_of_gap(new.before(old.timestamps_s[i]), old.timestamps_s[i], old.center[i], depth)
