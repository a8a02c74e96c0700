"""How far two frames of one camera are apart, by the points that both show.

The parallax is what is left of the motion of points once the rotation that explains the most is taken away, at that of
several focal lengths which leaves the least: a camera that turns on the spot has none, whatever its lens. It is a mean,
as a median is blind to what stands before a wall that fills more than half of the picture. A plane seen
from the front moves almost as if the camera had turned; there, the overlap tells that frames are apart.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.turned_views import turn_at_focal

Array = NDArray[np.float64]

# Focal lengths that are tried, in longer sides of the picture: fields of view of 90 to 20 degrees.
_FOCALS = np.log([0.5, 0.7, 1.0, 1.4, 2.0, 2.8])
# Residuals, in longer sides, at which a weight has halved; and what one counts at most: points may move by themselves.
_SCALE, _MOST = 0.02, 0.06
_AFFINE_FITS = 4
# Points of a regular grid across a picture, by which overlaps are told.
_GRID = np.stack(np.meshgrid((np.arange(16) + 0.5) / 16, (np.arange(12) + 0.5) / 12), axis=-1).reshape(-1, 2)


class Apart(NamedTuple):
    """How far a frame is from another one.

    Attributes:
        parallax: mean, as a share of the longer side of the picture.
        overlap: share of the two pictures that both show.
        flow: median motion, as a share of the longer side.
    """

    parallax: float
    overlap: float
    flow: float


def motion_between(xy1: Array, xy2: Array, shape: tuple[int, int]) -> Apart:
    """How far apart two frames are by points seen in both.

    Args:
        xy1, xy2: (N, 2) pixels, N >= 3, some of them wrong.
        shape: (height, width) of the frames.
    """
    height, width = shape
    side, middle = max(height, width), np.array([width, height]) / 2
    xn1, xn2 = (xy1 - middle) / side, (xy2 - middle) / side
    left = [_SCALE * np.sqrt(turn_at_focal(xn1, xn2, _SCALE, focal)[1]) for focal in _FOCALS]
    flow = float(np.median(np.linalg.norm(xn2 - xn1, axis=1)))
    parallax = min(float(np.minimum(residuals, _MOST).mean()) for residuals in left)
    return Apart(parallax, _overlap(xn1, xn2, np.array([width, height]) / side), flow)


def _overlap(xn1: Array, xn2: Array, size: Array) -> float:
    """Share of both pictures that an affine motion puts inside the other: where a camera goes ahead, all of the second
    lies within the first."""
    affine = _affine(xn1, xn2)
    linear, shift = affine[:, :2], affine[:, 2]
    grid = (_GRID - 0.5) * size
    there, back = grid @ linear.T + shift, (grid - shift) @ np.linalg.pinv(linear).T
    return float(np.mean([(np.abs(seen) <= size / 2).all(axis=1).mean() for seen in (there, back)]))


def incoherence(xy1: Array, xy2: Array, side: int) -> float:
    """Median distance of points (N, 2) from where an affine motion of all puts them, as a share of a side in pixels."""
    affine = _affine(xy1 / side, xy2 / side)
    off = xy1 / side @ affine[:, :2].T + affine[:, 2] - xy2 / side
    return float(np.median(np.linalg.norm(off, axis=1)))


def _affine(xn1: Array, xn2: Array) -> Array:
    """(2, 3) affine motion by least squares with Cauchy weights."""
    rows = np.column_stack([xn1, np.ones(len(xn1))])
    weight = np.ones(len(xn1))
    affine = np.eye(2, 3)
    for _ in range(_AFFINE_FITS):
        root = np.sqrt(weight)[:, None]
        affine = np.linalg.lstsq(rows * root, xn2 * root, rcond=None)[0].T
        weight = 1 / (1 + ((rows @ affine.T - xn2) ** 2).sum(axis=1) / _SCALE**2)
    return affine
