"""What a photograph says of where the object is: the signed distance of each pixel to its outline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Silhouette:
    """The object's outline in one photograph.

    Attributes:
        distance: (H, W) float32 pixels from the centre of each pixel to the outline, positive inside, to a fraction of
            a pixel near it; +inf everywhere if there is no outside, -inf if there is no object.
        known: (H, W) bool, False where the picture cannot tell (a hand in front, a hole in the lens's field): nothing
            is carved there; None for everywhere. Beyond the picture nothing is ever known.
        confidence: between 0.5 and 1: how probable it is that a pixel far from the outline is told rightly.
        outline_sigma_px: standard deviation of the outline's place, pixels.
        source: how it was found, in a word for reports: ``alpha``, ``mask``, ``background``, ...
    """

    distance: NDArray[np.float32]
    known: NDArray[np.bool_] | None = None
    confidence: float = 1.0
    outline_sigma_px: float = 0.5
    source: str = "mask"

    @property
    def inside(self) -> NDArray[np.bool_]:
        """(H, W) pixels whose centre shows the object."""
        return np.asarray(self.distance > 0.0)
