"""What a photograph shows of a plane, seen straight on."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import UsageError
from sfmapp.images.pixels import white_of
from sfmapp.planes.sampling import resampled
from sfmapp.planes.view import PlaneView

Array = NDArray[np.float64]

MAX_SIDE, MAX_PIXELS = 65_000, 250_000_000
"""Of a result: what files of pictures hold, and what ``images.max_pixels`` reads again."""


class Area(NamedTuple):
    """A rectangle of a plane in its own unit, and the size of the picture of it."""

    left: float
    top: float
    right: float
    bottom: float
    width: int
    height: int


def take_plane(photograph: NDArray[Any], view: PlaneView, area: Area) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """A part of a plane, seen straight on, and what of it the photograph shows.

    Args:
        photograph: (H, W) or (H, W, 3 or 4), uint8 or uint16. view: of the plane. area: of it.

    Returns:
        The picture (h, w, ...), black where the photograph does not show it; (h, w) True where it does.

    Raises:
        UsageError: the picture would be larger than files hold.
    """
    check_size(area.width, area.height)
    layers = photograph if photograph.ndim == 3 else photograph[..., None]
    out = np.zeros((area.height, area.width, layers.shape[2]), layers.dtype)
    shown = np.zeros((area.height, area.width), np.bool_)
    full, white = float(np.iinfo(layers.dtype).max), float(white_of(photograph))
    step = np.array([(area.right - area.left) / area.width, (area.bottom - area.top) / area.height])

    def find(xy: Array) -> Array:
        return view.seen(np.array([area.left, area.top]) + xy * step)

    for tile in resampled(layers, find, (0, 0, area.width, area.height)):
        at, values = (tile.rows, tile.columns), tile.values
        if values.shape[2] == 4:
            values[..., :3] *= full / np.maximum(values[..., 3:], 1e-3)
        values[..., :3] = np.clip(values[..., :3], 0.0, white)  # cubics overshoot, and twelve bits end before sixteen
        shown[at] = tile.cover > 0.5
        out[at] = np.where(shown[at][..., None], np.clip(np.rint(values), 0, full), 0).astype(layers.dtype)
    return (out[..., 0] if photograph.ndim == 2 else out), shown


def check_size(width: float, height: float) -> None:
    """Raises UsageError for a picture that is empty, or larger than files hold."""
    is_there = math.isfinite(width * height) and min(width, height) >= 1
    if not is_there or max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
        raise UsageError(
            f"the picture would have {width:g} x {height:g} pixels, expected 1 to {MAX_SIDE:,} a side and at most "
            f"{MAX_PIXELS // 1_000_000} million",
            "--max-size limits its longer side",
        )


def natural_scale(view: PlaneView, size: tuple[float, float]) -> float:
    """Pixels for a unit of the plane that lose nothing of a rectangle (width, height): those of the photograph where it
    shows it the largest."""
    w, h = size
    at = np.array([[x * w, y * h] for x in (0.0, 0.5, 1.0) for y in (0.0, 0.5, 1.0)])
    step = 1e-4 * max(w, h)
    scales = [
        np.linalg.norm(view.seen(at + move) - view.seen(at - move), axis=1) / (2.0 * step)
        for move in (np.array([step, 0.0]), np.array([0.0, step]))
    ]
    return float(np.nanmax(scales))
