"""What the recording of a stereo pair is drawn from, on its way to the process that draws it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.viewer.handover import HandedOver

Float32 = NDArray[np.float32]
Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class StereoReplay(HandedOver):
    """What is drawn. Pictures are the shown, smaller ones.

    Attributes:
        title: shown in the viewer. story: in words, Markdown. unit: of lengths.
        left, right: (H, W, 3) uint8 RGB. disparity, sigma, confidence: (H, W, 3) uint8, in colours.
        pinhole: focal length, cx, cy of the shown pictures, pixels; and doffs, of the right one cx + doffs.
        baseline: of the cameras; 0 where none is known, and no points then.
        xyz: (N, 3) float32 in the frame of the left camera. rgb: (N, 3) uint8. sigma_rgb: (N, 3) uint8, the colours of
            their sigma. reach: (N,) float32 sigma of their depth.
    """

    title: str
    story: str
    unit: str
    left: Pixels
    right: Pixels
    disparity: Pixels
    sigma: Pixels
    confidence: Pixels
    pinhole: list[float]
    baseline: float
    xyz: Float32
    rgb: Pixels
    sigma_rgb: Pixels
    reach: Float32
