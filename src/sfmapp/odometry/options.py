"""Options of the odometry stage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sfmapp.option_checks import SHARE, Range, check_options, positive

# Keyframes that a map may have for covariances of all of them, which take two dense matrices over all poses.
MAX_COVARIANCE_KEYFRAMES = 400
_RANGES = {
    "max_tracks": Range(50, 10_000),
    "keyframe_parallax": positive(1.0),
    "keyframe_loss": SHARE,
    "cull_seen": SHARE,
    "window": Range(2, 1000),
    "window_anchors": Range(0, 1000),
    "min_triangulation_deg": positive(90.0),
    "min_stereo_deg": positive(90.0),
    "max_lost_s": Range(0.0, 1e6),
}


@dataclass(frozen=True)
class OdometryOptions:
    """How a camera is tracked through a sequence. Shares and angles where possible, so that no image size is assumed.

    Attributes:
        max_tracks: corners tracked at a time, spread over the image
        keyframe_parallax: median shift beyond rotation since the last keyframe, share of the image width
        keyframe_loss: a keyframe is due when less than this share of the last one's mapped points is still tracked
        cull_seen: a keyframe is dropped once this share of its points is seen by three others; 1: never
        window: keyframes whose poses the local adjustment may change
        window_anchors: earlier keyframes that take part unchanged, those that share the most points
        min_triangulation_deg: smallest angle between the rays of a new point of one moving camera
        min_stereo_deg: the same for a rig, whose baseline is known; depths are then good to about 10 %
        max_lost_s: seconds without relocalization before a new map is begun
        motion: planar for a wheeled robot on level ground: maps begin among more wrong corners, and a ground plane
            takes part in the closing adjustment where the images agree; ackermann for a car whose camera looks ahead
        known_map: OUT of an earlier odometry run or reconstruction, or a COLMAP model with its photographs, that the
            sequence is localised in
        loops: recognise places seen before, close loops and join maps
        refine_camera: refine the calibration where the images clearly contradict it
        smooth: also write the trajectory smoothed by an error-state filter: steadier, with short gaps bridged
        filter: also write live poses as an error-state filter has them, predicted with the IMU, at its rate and in
            metres, or by constant velocity, with sigmas, gaps of up to five seconds bridged
        covariance: estimate covariances of the keyframes after the final adjustment
    """

    max_tracks: int = 600
    keyframe_parallax: float = 0.02
    keyframe_loss: float = 0.65
    cull_seen: float = 0.95
    window: int = 10
    window_anchors: int = 10
    min_triangulation_deg: float = 1.0
    min_stereo_deg: float = 0.2
    max_lost_s: float = 1.0
    motion: Literal["free", "planar", "ackermann"] = "free"
    known_map: str | None = None
    loops: bool = True
    refine_camera: bool = True
    smooth: bool = False
    filter: bool = False
    covariance: bool = True

    def __post_init__(self) -> None:
        check_options("odometry", self, _RANGES)


@dataclass(frozen=True)
class ScaleOptions:
    """Where the metric scale of a single camera comes from.

    Attributes:
        source: marker:DICT:METRES, distance:FRAME:FRAME:METRES, distance:path:METRES, camera_height:METRES, imu or
            arbitrary; auto: the IMU where there is one
    """

    source: str | None = None
