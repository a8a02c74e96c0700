"""What is asked of the matching of a rectified pair."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sfmapp.errors import UsageError
from sfmapp.option_checks import Range, check_options

MatcherName = Literal["sgm", "window", "opencv-sgbm", "opencv-bm"]
CostName = Literal["census", "zncc", "sad", "ssd"]
WindowsName = Literal["nested", "fixed", "adaptive", "shiftable"]
Correction = Literal["auto", "turn", "rows", "no"]


@dataclass(frozen=True)
class StereoOptions:
    """Options of the stage ``stereo``.

    Attributes:
        matcher: sgm is our semi-global matching; window takes the best disparity of each pixel alone by windows about
            it; opencv-sgbm and opencv-bm are OpenCV's StereoSGBM and StereoBM.
        min_disparity: Least disparity x_left - x_right that is looked for, pixels; may be negative. None: as matches
            tell.
        num_disparities: How many from there on, pixels. None: as matches tell.
        cost: What two pixels of windows cost: bits of their census, 1 - ZNCC, absolute or squared differences.
        windows: nested adds three windows of rising size, fixed has one, adaptive the best of several sizes for each
            pixel, shiftable the best of nine places about it.
        window: Side of the matching window, pixels, odd; None: what is best for the matcher; sgm has none.
        left_right_px: Disparities that differ by more when they are looked for from the other side are dropped, pixels.
        correct_rig: What is done where matches say that the cameras have turned since their calibration. turn: rectify
            as they say; rows: bring rows together and leave disparities as they are, for a lens may be what is seen;
            no: nothing; auto: turn, but rows of photographs that were rectified before.
        refine: Lay slanted planes through the pixels that sgm has found: errors below a pixel become smaller by a tenth
            to a quarter, and matching takes three times as long.
        fill: Fill what only one camera sees from its neighbours, and mark it so.
    """

    matcher: MatcherName = "sgm"
    min_disparity: int | None = None
    num_disparities: int | None = None
    cost: CostName = "census"
    windows: WindowsName = "nested"
    window: int | None = None
    left_right_px: float = 1.0
    correct_rig: Correction = "auto"
    refine: bool = False
    fill: bool = False

    def __post_init__(self) -> None:
        check_options("stereo", self, {"num_disparities": Range(1), "window": Range(1), "left_right_px": Range(0.0)})
        if self.window is not None and self.window % 2 == 0:
            raise UsageError(f"stereo.window is {self.window}, expected an odd number of pixels")
