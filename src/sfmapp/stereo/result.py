"""What stereo hands on: the geometry of a rectified pair, its pictures, and disparities."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class PixelState(IntEnum):
    """Of a pixel of a disparity map."""

    UNKNOWN = 0
    MATCHED = 1
    """Found, and found again from the other side."""
    FILLED = 2
    """Not seen by both: a guess from its neighbours, made only when it is asked for."""


@dataclass(frozen=True)
class RectifiedGeometry:
    """Of two pictures whose rows are epipolar lines: a point at depth Z lies ``focal * baseline / Z - doffs`` further
    to the left in the right picture, which is its disparity d = x_left - x_right.

    Attributes:
        width, height: of both pictures, pixels.
        focal: pixels, of both.
        cx, cy: principal point of the left picture, pixels, the centre of the first pixel at (0.5, 0.5).
        doffs: principal point of the right picture minus that of the left along x, pixels: minus the disparity of a
            point at infinity (Middlebury's name).
        baseline: distance of the centres, in the unit of the rig; None where nothing tells it.
        unit: of the baseline and of depths: ``m`` where the rig is calibrated in metres, otherwise empty.
        covariance: (3, 3) of (focal, baseline, doffs) from the calibration; None where it says nothing of it.
    """

    width: int
    height: int
    focal: float
    cx: float
    cy: float
    doffs: float = 0.0
    baseline: float | None = None
    unit: str = ""
    covariance: Array | None = None


@dataclass(frozen=True)
class RectifiedPair:
    """Two pictures of one size whose rows are epipolar lines, the left camera's picture first.

    Attributes:
        left, right: (H, W) or (H, W, 3) uint8.
        left_shown, right_shown: (H, W) bool, False where the photograph does not reach.
        geometry: None where rows are aligned and no camera is known: depth is then projective.
        left_from_camera, right_from_camera: (3, 3) rotations from the cameras' frames into the rectified ones; None
            where no camera is known, or the photographs came rectified.
    """

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    left_shown: NDArray[np.bool_]
    right_shown: NDArray[np.bool_]
    geometry: RectifiedGeometry | None = None
    left_from_camera: Array | None = None
    right_from_camera: Array | None = None


@dataclass(frozen=True)
class DisparityMap:
    """Disparities of the left picture of a rectified pair, and what the matcher knows of each.

    Attributes:
        disparity: (H, W) float32 pixels, x_left - x_right, larger nearer; NaN where there is none.
        state: (H, W) uint8 of :class:`PixelState`.
        cost: (H, W) float32 matching cost at the disparity, in the unit of the matcher; NaN where there is none.
        curvature: (H, W) float32 second derivative of that cost by disparity there, per square pixel.
        uniqueness: (H, W) float32 from 0 to 1: how far the best cost is below the best one elsewhere on the row,
            1 - best / second; 0 where they are equal.
        searched: (2,) the least and the greatest disparity that was looked for, pixels.
        info: what the matcher counted and decided, in words that a report prints.
    """

    disparity: NDArray[np.float32]
    state: NDArray[np.uint8]
    cost: NDArray[np.float32]
    curvature: NDArray[np.float32]
    uniqueness: NDArray[np.float32]
    searched: tuple[float, float]
    info: dict[str, Any] = field(default_factory=dict)

    @property
    def density(self) -> float:
        """Share of pixels that were matched; filled ones do not count."""
        return float((self.state == PixelState.MATCHED).mean())
