"""What a run shows while it is under way: handed to the listeners as ``snapshot`` of its events."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.odometry.residual_memory import Correlation
from sfmapp.odometry.result import FrameState

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BeliefState:
    """Where the camera may be in a known map, after a frame was held against it.

    Attributes:
        pose: (P, 7) cam_from_world of particles of all places, in the known map. weight: (P,) with the probabilities of
            the places in it; sum 1 less ``not_in_map``. mode: (P,) which place.
        probability: (M,) of the places. best: (M, 7) their mean poses.
        not_in_map: probability. decided: the place that is believed, -1 for none.
        point_xyz: (N, 3) landmarks of the known map.
    """

    pose: Array
    weight: Array
    mode: NDArray[np.int64]
    probability: Array
    best: Array
    not_in_map: float
    decided: int
    point_xyz: Array


@dataclass(frozen=True)
class FrameSnapshot:
    """One frame, with every ``advanced`` event of stage ``odometry``. Listeners may keep the arrays.

    Attributes:
        frame_idx, name, timestamp_s: which frame.
        state: what became of it.
        image: (H, W) uint8, the rig's first camera.
        xy: (N, 2) float32 tracked points, pixels. is_mapped: (N,) bool, those that the pose was measured with.
        cam_from_world: (7,) pose as it was given out, NaN without one.
        covariance: (6, 6) of the pose given the map, over rotation (radians) and translation of
            ``x_cam <- exp(w) x_cam + v``; NaN where it was not measured.
        map_moved: (8,) how adjustments and loops have moved the map below the camera since the frame before, and
            changed its unit: a place x of now was at map_moved(x).
        correlation: how far the frame's residuals are those of the frames before it; NaN where nobody filters.
        map_idx: which map the pose is in, counted from 0 in the order in which they began.
        cpu_s: CPU seconds of tracking, back end not included.
        latency_s: of a live source, seconds from when the frame came until its pose was known; NaN of recorded ones.
        belief: where in a known map it might be; None where it was not held against one.
    """

    frame_idx: int
    name: str
    timestamp_s: float
    state: FrameState
    image: NDArray[np.uint8]
    xy: NDArray[np.float32]
    is_mapped: NDArray[np.bool_]
    cam_from_world: Array
    covariance: Array
    correlation: Correlation
    map_moved: Array
    map_idx: int
    cpu_s: float
    latency_s: float = math.nan
    belief: BeliefState | None = None


@dataclass(frozen=True)
class MapSnapshot:
    """What changed in the map, with ``decided`` events: a new keyframe, an adjustment, a loop closed, maps joined.

    Attributes:
        frame_idx: the frame at which it happened.
        map_idx: which map; see FrameSnapshot.
        keyframe_frame_idx: (K,) int64 and keyframe_cam_from_world (K, 7): keyframes that are new or have moved.
        point_id: (P,) int64 and point_xyz (P, 3): points that are new or have moved.
        is_complete: these are all of the map's keyframes and points; forget the others.
    """

    frame_idx: int
    map_idx: int
    keyframe_frame_idx: NDArray[np.int64]
    keyframe_cam_from_world: Array
    point_id: NDArray[np.int64]
    point_xyz: Array
    is_complete: bool = False
