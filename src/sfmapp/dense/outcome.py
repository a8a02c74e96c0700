"""What became of a dense run: were there patches where the images have texture, and if not, why not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sfmapp.dense.pyramid import noise_deviation
from sfmapp.dense.scene import DenseView, Patches
from sfmapp.errors import NoReconstructionError

# a window of 7x7 pixels is textured if its grey values vary by so much, and by so much more than noise does
LEAST_DEVIATION, NOISE_FACTOR, WINDOW_PX = 4.0, 3.0, 7
# of the open pixels that have to be textured, and of the textured cells that have to be covered
LEAST_TEXTURED, LEAST_COVERED, GOOD_COVERED = 0.01, 0.01, 0.1


def textured_pixels(view: DenseView) -> tuple[int, int]:
    """How many of the open pixels of a view are textured, and how many there are."""
    import cv2

    gray = cv2.cvtColor(np.ascontiguousarray(view.rgb), cv2.COLOR_RGB2GRAY)
    window = (WINDOW_PX, WINDOW_PX)
    mean = cv2.boxFilter(gray, cv2.CV_32F, window)
    variance = cv2.sqrBoxFilter(gray, cv2.CV_32F, window) - mean * mean
    textured = variance > max(LEAST_DEVIATION, NOISE_FACTOR * noise_deviation(gray)) ** 2
    is_open = np.ones(gray.shape, bool) if view.mask is None else view.mask
    return int((textured & is_open).sum()), int(is_open.sum())


def judge(patches: Patches, texture: Sequence[tuple[int, int]], cell_px: int) -> dict[str, Any]:
    """Shares: ``textured``, of the open pixels of all views; ``covered``, cells that trust a patch to textured ones.

    Args:
        patches: the result.
        texture: of each view, as :func:`textured_pixels` gives it.
        cell_px: side of a cell.
    """
    textured, is_open = (sum(column) for column in zip(*texture, strict=True))
    cells = max(textured, LEAST_TEXTURED * is_open) / cell_px**2
    return {
        "textured": textured / max(is_open, 1),
        "covered": len(patches.view_idx) / max(cells, 1.0),
    }


def check(patches: Patches, shares: dict[str, Any]) -> str | None:
    """A warning if little was found, None if all is well.

    Raises:
        NoReconstructionError: hardly anything was found; it says whether for lack of texture, or because the poses
            contradict the images.
    """
    found = f"{len(patches)} patches"
    if shares["textured"] < LEAST_TEXTURED and shares["covered"] < GOOD_COVERED:
        raise NoReconstructionError(
            f"{found}: the images show next to no texture ({100 * shares['textured']:.1f} % of their area)",
            "patches need texture to be matched: sharper or closer photographs, or a pattern on the surface",
        )
    share = f"{found} cover {100 * shares['covered']:.1f} % of what is textured in the images"
    if shares["covered"] < LEAST_COVERED:
        raise NoReconstructionError(
            f"{share}: the poses contradict the images",
            "check that model and photographs belong together (names, sizes, orientation), that the poses are "
            "world to camera, and the reprojection error of the model",
        )
    if shares["covered"] < GOOD_COVERED:
        return f"only {share}: are the poses exact, and do the photographs overlap?"
    return None
