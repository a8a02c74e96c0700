"""Results of stereo: what they count."""

from __future__ import annotations

import numpy as np

from sfmapp.stereo.result import DisparityMap, PixelState


def test_density_counts_matched_pixels_and_not_guesses() -> None:
    state = np.array([[PixelState.MATCHED, PixelState.FILLED], [PixelState.UNKNOWN, PixelState.MATCHED]], np.uint8)
    blank = np.zeros((2, 2), np.float32)
    assert DisparityMap(blank, state, blank, blank, blank, (0.0, 64.0)).density == 0.5
