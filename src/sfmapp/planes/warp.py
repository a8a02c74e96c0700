"""A picture put onto a plane of a photograph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import UsageError
from sfmapp.images.pixels import white_of
from sfmapp.planes.sampling import Region, resampled
from sfmapp.planes.view import PlaneView

Array = NDArray[np.float64]
Blend = Literal["over", "multiply"]

# points on each side of the picture, between which a bent side is taken for straight
_SIDE_POINTS = 200


@dataclass(frozen=True)
class Look:
    """How a picture lies on a photograph.

    Attributes:
        blend: ``over`` covers what was there; ``multiply`` lets it shine through, as print on a wall with its shadows.
        opacity: from 0 to 1.
    """

    blend: Blend = "over"
    opacity: float = 1.0

    def __post_init__(self) -> None:
        if self.blend not in ("over", "multiply"):
            raise UsageError(f"blend is {self.blend!r}", "over or multiply")
        if not 0.0 <= self.opacity <= 1.0:
            raise UsageError(f"opacity is {self.opacity:g}, expected a share from 0 to 1")


def put_picture(
    picture: NDArray[Any], photograph: NDArray[Any], view: PlaneView, look: Look | None = None, *,
    free: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[Any], NDArray[np.uint8]]:  # fmt: skip
    """A picture on a plane of a photograph, and where it is.

    Args:
        picture: (h, w), (h, w, 3) or (h, w, 4) with alpha, uint8 or uint16.
        photograph: (H, W) or (H, W, 3 or 4), uint8 or uint16; it stays as it is where the picture is not.
        view: of the plane, its coordinates those of the picture's pixels, whose first has its centre at (0.5, 0.5).
        free: (H, W) False where something stands in front of the plane; None: nothing does.

    Returns:
        The photograph with the picture, in its own depth, in colour if either is; (H, W) from 0 to 255, the share of
        each pixel that the picture covers.
    """
    look = look or Look()
    height, width = photograph.shape[:2]
    layers, out = _layers(picture), _layers(photograph)
    if layers.shape[2] > 1 and out.shape[2] == 1:
        out = np.repeat(out, 3, axis=2)
    out = out.copy()
    scale = np.float32(white_of(photograph) / white_of(picture))
    mask = np.zeros((height, width), np.uint8)
    region = _region(view, (layers.shape[1], layers.shape[0]), (width, height))
    for tile in resampled(layers, view.on_plane, region):
        at = tile.rows, tile.columns
        weight = tile.cover * np.float32(look.opacity)
        if free is not None:
            weight = weight * free[at]
        opaque = weight
        if layers.shape[2] == 4:
            opaque = weight * np.clip(tile.values[..., 3] / np.float32(np.iinfo(layers.dtype).max), 0.0, 1.0)
        out[at] = _composed(out[at], tile.values[..., :3] * scale, (weight, opaque), look, white_of(photograph))
        mask[at] = np.rint(255.0 * opaque)
    return (out[..., 0] if out.shape[2] == 1 else out), mask


def _composed(
    below: NDArray[Any], values: NDArray[np.float32], weights: tuple[NDArray[np.float32], NDArray[np.float32]],
    look: Look, white: int,
) -> NDArray[Any]:  # fmt: skip
    """A tile (h, w, C) with the picture on it (Porter and Duff, "Compositing digital images", SIGGRAPH 1984).

    Args:
        values: (h, w, 1 or 3) multiplied by the picture's alpha. weights: of these, and that alpha with it.
    """
    weight, opaque = (each[..., None] for each in weights)
    color = below[..., :3].astype(np.float32)
    top = values * color / np.float32(white) if look.blend == "multiply" else values
    out = below.astype(np.float32)
    if below.shape[2] == 4:  # colours of what was transparent say nothing
        full = np.float32(np.iinfo(below.dtype).max)
        alpha = below[..., 3:].astype(np.float32) / full
        total = opaque + alpha * (1.0 - opaque)
        mixed = weight * top + alpha * (1.0 - opaque) * color
        out[..., :3] = np.where(total > 0.0, mixed / np.maximum(total, np.float32(1e-6)), color)
        out[..., 3:] = total * full
    else:
        out[...] = weight * top + (1.0 - opaque) * color
    out[..., :3] = np.clip(out[..., :3], 0, white)  # cubics overshoot, and twelve bits end before sixteen do
    limit = np.iinfo(below.dtype).max
    kept: NDArray[Any] = np.where(opaque > 0.0, np.clip(np.rint(out), 0, limit), below).astype(below.dtype)
    return kept


def _layers(pixels: NDArray[Any]) -> NDArray[Any]:
    return pixels if pixels.ndim == 3 else pixels[..., None]


def _region(view: PlaneView, picture: tuple[int, int], photograph: tuple[int, int]) -> Region:
    """What of a photograph the picture may cover."""
    along = np.linspace(0.0, 1.0, _SIDE_POINTS)
    zero, one = np.zeros_like(along), np.ones_like(along)
    border = np.concatenate([np.stack(each, 1) for each in ((along, zero), (one, along), (along, one), (zero, along))])
    xy = view.seen(border * picture)
    xy = xy[np.isfinite(xy).all(1)]
    low = np.clip(np.floor(xy.min(0)) - 2.0, 0, photograph).astype(int)
    high = np.clip(np.ceil(xy.max(0)) + 2.0, 0, photograph).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])
