"""What a pair of cameras will measure before it is built: depth errors, common field of view, the baseline to choose.

Two equal cameras stand at -B/2 and B/2 on the x axis, their rows along it, both turned inwards by half the angle of
convergence. A point between them in the plane of the axes is seen at angles a and b from the axis z; of both together,
Z = B / (tan a + tan b). For parallel axes that is f B / d exactly. An error of the disparity is shared evenly by both
pictures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.errors import UsageError
from sfmapp.reporting import Report

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StereoDesign:
    """Two equal cameras and how well pixels are matched.

    Attributes:
        focal_px: focal length, pixels. width, height: of a picture, pixels.
        baseline: distance of the centres, metres.
        converging_deg: angle between the axes, degrees; 0 for parallel ones.
        disparity_error_px: largest error of a disparity, pixels.
        baseline_error: of the calibration, metres. focal_error_px: pixels.
        greatest_disparity_px: that the matcher looks for; None for the width of a picture.
    """

    focal_px: float
    width: int
    height: int
    baseline: float
    converging_deg: float = 0.0
    disparity_error_px: float = 1.0
    baseline_error: float = 0.0
    focal_error_px: float = 0.0
    greatest_disparity_px: float | None = None

    def __post_init__(self) -> None:
        for name in ("focal_px", "width", "height", "baseline", "disparity_error_px"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise UsageError(f"{name.replace('_', ' ')} is {value:g}, expected more than nothing")
        if not 0.0 <= self.converging_deg < 180.0 - 2.0 * self.half_view_deg:
            raise UsageError(
                f"axes that converge at {self.converging_deg:g} degrees: expected an angle from 0 to "
                f"{180.0 - 2.0 * self.half_view_deg:.4g} degrees, where both still look ahead"
            )

    @property
    def half_view_deg(self) -> float:
        """Half the horizontal field of view."""
        return math.degrees(math.atan(0.5 * self.width / self.focal_px))

    @property
    def fixation(self) -> float:
        """Where the axes meet, metres ahead; infinite for parallel ones."""
        half = math.radians(0.5 * self.converging_deg)
        return 0.5 * self.baseline / math.tan(half) if half else math.inf

    def disparity(self, depth: ArrayLike) -> Array:
        """Pixels, of points (...,) midway between the cameras; below zero beyond the fixation."""
        angle = np.arctan2(0.5 * self.baseline, np.asarray(depth, np.float64)) - 0.5 * math.radians(self.converging_deg)
        pixels: Array = 2.0 * self.focal_px * np.tan(angle)
        return pixels

    def depth(self, disparity: ArrayLike) -> Array:
        """Metres, of disparities (...,) midway between the cameras; infinite where the lines of sight do not meet."""
        angle = np.arctan(np.asarray(disparity, np.float64) / (2.0 * self.focal_px))
        slope = np.tan(angle + 0.5 * math.radians(self.converging_deg))
        with np.errstate(divide="ignore"):
            metres: Array = np.where(slope > 0.0, 0.5 * self.baseline / slope, np.inf)
        return metres

    def common_width(self, depth: ArrayLike) -> Array:
        """Metres of the plane at a depth (...,) that both pictures show; 0 where they show nothing in common."""
        start, end = self._left_view(depth)
        return np.asarray(np.maximum(2.0 * np.minimum(end, -start), 0.0))

    def common_share(self, depth: ArrayLike) -> Array:
        """The same as a share of what one picture shows of that plane."""
        start, end = self._left_view(depth)
        return np.asarray(np.maximum(2.0 * np.minimum(end, -start), 0.0) / (end - start))

    @property
    def nearest(self) -> float:
        """The least depth, metres: where the fields of view begin to overlap, or the matcher's search ends."""
        edge = math.radians(self.half_view_deg + 0.5 * self.converging_deg)
        nearest = 0.5 * self.baseline / math.tan(edge)
        if self.greatest_disparity_px is not None:
            nearest = max(nearest, float(self.depth(self.greatest_disparity_px)))
        return nearest

    @property
    def farthest_common(self) -> float:
        """Where converging fields of view part again, metres; infinite where they never do."""
        edge = math.radians(0.5 * self.converging_deg - self.half_view_deg)
        return 0.5 * self.baseline / math.tan(edge) if edge > 0.0 else math.inf

    @property
    def zero_disparity_radius(self) -> float:
        """Of the surface whose points have disparity 0, metres: an upright cylinder through both centres and the point
        where the axes meet (the circle of Vieth and Mueller); infinite for parallel axes."""
        angle = math.radians(self.converging_deg)
        return 0.5 * self.baseline / math.sin(angle) if angle else math.inf

    def _left_view(self, depth: ArrayLike) -> tuple[Array, Array]:
        """Where the left picture's field of view begins and ends along x at a depth (...,)."""
        z, half = np.asarray(depth, np.float64), math.radians(0.5 * self.converging_deg)
        edge = math.radians(self.half_view_deg)
        return -0.5 * self.baseline + z * math.tan(half - edge), -0.5 * self.baseline + z * math.tan(half + edge)


class DepthRow(Report):
    """What a rig tells of a point at one depth, midway between the cameras. Lengths are in the unit of the study.

    Attributes:
        depth: of the point. disparity_px: at it.
        nearest, farthest: exact depths at the largest errors of the disparity; farthest is None where that is infinity.
        spread: between them.
        of_disparity, of_baseline, of_focal: the three terms of the largest error, to first order.
        total: their sum.
        common_share: of a picture at this depth that both show.
    """

    depth: float
    disparity_px: float
    nearest: float
    farthest: float | None
    spread: float | None
    of_disparity: float
    of_baseline: float
    of_focal: float
    total: float
    common_share: float


class RigStudy(Report):
    """One rig. Lengths are in the unit of the study.

    Attributes:
        baseline, converging_deg: of it.
        fixation: where the axes meet; None for parallel ones.
        zero_disparity_radius: of the cylinder of disparity 0; None for parallel ones.
        least_depth: nearest point that both see, and the matcher finds.
        greatest_depth: where the disparity differs from that of infinity by its largest error: farther points are not
            told from infinity.
        farthest_common: where converging fields part again; None where they do not.
        rows: by depth.
    """

    baseline: float
    converging_deg: float
    fixation: float | None
    zero_disparity_radius: float | None
    least_depth: float
    greatest_depth: float
    farthest_common: float | None
    rows: Sequence[DepthRow]


class WantedBaseline(Report):
    """The least baseline that keeps the error of a depth below a limit, for parallel axes.

    Attributes:
        depth, error: as they were asked for. baseline: that does it.
        common_share: of a picture at this depth, that both would show; 0 if nothing.
    """

    depth: float
    error: float
    baseline: float
    common_share: float


class DesignReport(Report):
    """The report of ``sfmapp stereo-design``.

    Attributes:
        focal_px, width, height: of both cameras.
        field_of_view_deg: horizontal.
        disparity_error_px, baseline_error, focal_error_px: largest errors, as they were given.
        unit: of lengths.
        rigs: one for each baseline. wanted: where an error was asked for.
    """

    focal_px: float
    width: int
    height: int
    field_of_view_deg: float
    disparity_error_px: float
    baseline_error: float
    focal_error_px: float
    unit: str
    rigs: Sequence[RigStudy]
    wanted: Sequence[WantedBaseline]


def study(design: StereoDesign, depths: ArrayLike, unit_m: float = 1.0) -> RigStudy:
    """What a rig tells at depths (N,) metres; lengths of the result are in units of ``unit_m`` metres."""
    z = np.asarray(depths, np.float64)
    return RigStudy(
        baseline=design.baseline / unit_m, converging_deg=design.converging_deg,
        fixation=_finite(design.fixation / unit_m),
        zero_disparity_radius=_finite(design.zero_disparity_radius / unit_m),
        least_depth=design.nearest / unit_m, greatest_depth=_greatest(design) / unit_m,
        farthest_common=_finite(design.farthest_common / unit_m),
        rows=[_row(design, one, unit_m) for one in z.tolist()],
    )  # fmt: skip


def baseline_for(design: StereoDesign, depth: float, error: float) -> float:
    """The least baseline, metres, with which a point at a depth is told to ``error`` metres at the largest error of the
    disparity, for parallel axes: that of the far side, which is the larger, B = e Z (1 + Z / error) / f."""
    if not (0.0 < depth < math.inf and 0.0 < error < math.inf):
        raise UsageError(f"an error of {error:g} m at {depth:g} m: expected lengths above zero")
    return design.disparity_error_px * depth * (1.0 + depth / error) / design.focal_px


def _row(design: StereoDesign, depth: float, unit_m: float) -> DepthRow:
    error = design.disparity_error_px
    disparity = float(design.disparity(depth))
    near, far = (float(design.depth(disparity + sign * error)) / unit_m for sign in (1.0, -1.0))
    half = math.radians(0.5 * design.converging_deg)
    angle = math.atan(disparity / (2.0 * design.focal_px))
    # Z = B / 2 / tan(angle + half): its slope by the angle, and the angle's by disparity and focal length
    by_angle = depth**2 / (0.5 * design.baseline) / math.cos(angle + half) ** 2
    by_disparity = by_angle * math.cos(angle) ** 2 / (2.0 * design.focal_px)
    terms = (
        by_disparity * error, depth / design.baseline * design.baseline_error,
        abs(by_disparity * disparity) / design.focal_px * design.focal_error_px,
    )  # fmt: skip
    is_told = math.isfinite(far)
    return DepthRow(
        depth=depth / unit_m, disparity_px=disparity, nearest=near, farthest=far if is_told else None,
        spread=far - near if is_told else None, of_disparity=terms[0] / unit_m, of_baseline=terms[1] / unit_m,
        of_focal=terms[2] / unit_m, total=sum(terms) / unit_m, common_share=float(design.common_share(depth)),
    )  # fmt: skip


def _greatest(design: StereoDesign) -> float:
    """The depth whose disparity is one largest error from that of infinity."""
    at_infinity = -2.0 * design.focal_px * math.tan(math.radians(0.5 * design.converging_deg))
    return float(design.depth(at_infinity + design.disparity_error_px))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
