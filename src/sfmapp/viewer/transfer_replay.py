"""What the recording of a transfer is drawn from, on its way to the process that draws it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.viewer.handover import HandedOver

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TransferReplay(HandedOver):
    """What is drawn. Pixels are those of the shown, smaller photographs.

    Attributes:
        title: shown in the viewer. names: of the three. story: in words, Markdown.
        picture1, picture2, picture3, synthesised: (H, W, 3) uint8 RGB.
        points: (L, 3, 2) of some matches, in the three photographs.
        lines2: (L, 2, 2) ends of their epipolar lines in photograph 2; lines31, lines32: those in photograph 3 of their
            points in 1 and in 2; NaN outside.
        plane: (1, 2, 2) ends of the trifocal plane in photograph 3, NaN outside.
    """

    title: str
    names: list[str]
    story: str
    picture1: NDArray[np.uint8]
    picture2: NDArray[np.uint8]
    picture3: NDArray[np.uint8]
    synthesised: NDArray[np.uint8]
    points: Array
    lines2: Array
    lines31: Array
    lines32: Array
    plane: Array
