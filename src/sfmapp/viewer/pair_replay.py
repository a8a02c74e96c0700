"""What the recording of a pair is drawn from, on its way to the process that draws it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.viewer.handover import HandedOver

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PairReplay(HandedOver):
    """What is drawn. Pixels are those of the shown, smaller photographs.

    Attributes:
        title: shown in the viewer. names: of both photographs. story: in words, Markdown.
        picture1, picture2: (H, W, 3) uint8 RGB.
        keypoints1, keypoints2: (N, 2).
        nearest, ratio, mutual: (K, 4) x1, y1, x2, y2. is_own: (M,) bool of the mutual ones, on F of plain RANSAC.
        points: (L, 4) matches whose lines are drawn. lines1, lines2: (L, 2, 2) ends in each picture, NaN outside.
        epipoles: (2, 2), NaN at infinity.
        poses: (P, 7) cam2_from_cam1. clouds: (P, Q, 3) in the frame of camera 1. in_front: (P, Q) bool.
        reach: how far the points are. labels: of the poses.
    """

    title: str
    names: list[str]
    story: str
    picture1: NDArray[np.uint8]
    picture2: NDArray[np.uint8]
    keypoints1: Array
    keypoints2: Array
    nearest: Array
    ratio: Array
    mutual: Array
    is_own: NDArray[np.bool_]
    points: Array
    lines1: Array
    lines2: Array
    epipoles: Array
    poses: Array
    clouds: Array
    in_front: NDArray[np.bool_]
    reach: float
    labels: list[str]
