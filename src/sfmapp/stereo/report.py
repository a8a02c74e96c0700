"""What is said of a pair: how it was rectified, what its rows say of that, and what was matched."""

from __future__ import annotations

from collections.abc import Sequence

from sfmapp.reporting import Report
from sfmapp.stereo.measured import MeasuredReport
from sfmapp.stereo.temporal import ConsistencyReport


class RowsReport(Report):
    """How well rows of a rectified pair are epipolar lines, by sparse matches that no rectification was fitted to.

    Attributes:
        num_matches: whose rows agree to a few pixels.
        median_px, rms_px: of y_left - y_right; the latter without gross errors (1.4826 times the median of its size).
    """

    num_matches: int
    median_px: float
    rms_px: float


class MisalignmentReport(Report):
    """How far the right camera has turned since the calibration, in the rectified frame: x along the baseline, y down,
    z forward.

    Attributes:
        turn_deg: (3) rotation vector. direction_deg: (2) of the baseline along y and z. sigma_deg: (5) of these.
        is_told: (5) by the pair; the others are held at the calibration's.
        is_significant: the calibration does not hold. is_corrected: that was used.
        num_matches: that it rests on. rms_before_px, rms_after_px: of y_left - y_right of them.
    """

    turn_deg: Sequence[float]
    direction_deg: Sequence[float]
    sigma_deg: Sequence[float]
    is_told: Sequence[bool]
    is_significant: bool
    is_corrected: bool
    num_matches: int
    rms_before_px: float
    rms_after_px: float


class RectificationReport(Report):
    """How two photographs became a pair whose rows are epipolar lines.

    Attributes:
        cameras: how they are known.
        width, height: of the result, pixels.
        focal_px, cx_px, cy_px, doffs_px: of the result, the centre of the first pixel at (0.5, 0.5); absent where no
            camera is known.
        baseline: distance of the centres; absent where nothing tells it. unit: of that and of depths.
        is_as_given: the photographs were rectified already.
        is_polar: rows are half-planes about the baseline; sizes and focal length are those of the left photograph,
            which what was found is brought back to.
        is_swapped: the photographs were taken in the other order, as the calibration says.
        is_turned: the cameras stand one above the other, and the pictures are laid on their side.
        kept: share of each photograph that is kept. scale: pixels of the result to one of the photograph, along a side.
        turn_deg: how far the axis of each camera turns.
        rows: how well rows agree; absent where too little matches.
        misalignment: of the rig against its calibration; absent without one.
        warnings: what is wrong, or may be.
    """

    cameras: str
    width: int
    height: int
    focal_px: float | None = None
    cx_px: float | None = None
    cy_px: float | None = None
    doffs_px: float | None = None
    baseline: float | None = None
    unit: str
    is_as_given: bool
    is_polar: bool = False
    is_swapped: bool
    is_turned: bool
    kept: tuple[float, float]
    scale: tuple[float, float]
    turn_deg: tuple[float, float]
    rows: RowsReport | None = None
    misalignment: MisalignmentReport | None = None
    warnings: Sequence[str]


class DisparityReport(Report):
    """What a matcher found.

    Attributes:
        matcher: its name. searched: the least and the greatest disparity that was looked for; told_by: what told it.
        density: share of pixels that were matched. filled: share that was filled.
        quantiles_px: 1, 50 and 99 per cent of the disparities; empty where there are none.
        depths: the depths of these, nearest first; empty where no baseline is known.
    """

    matcher: str
    searched: tuple[float, float]
    told_by: str
    density: float
    filled: float
    quantiles_px: Sequence[float]
    depths: Sequence[float]


class StereoPairReport(Report):
    """Of one pair.

    Attributes:
        name: of the pair, its folder where there are several. left, right: the photographs.
        measured: how far off disparities and depths may be.
        consistency: of a frame of a film, how it agrees with the one before; absent of others.
        files: what was written of it, relative to the output.
    """

    name: str
    left: str
    right: str
    rectification: RectificationReport
    disparity: DisparityReport
    measured: MeasuredReport
    consistency: ConsistencyReport | None = None
    files: Sequence[str]
