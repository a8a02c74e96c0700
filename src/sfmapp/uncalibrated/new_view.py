"""A photograph from a third place without a model: matches are transferred, and what is between them carried along.

The matches of two photographs span a net of triangles (Delaunay's); where each of its corners is in the third view
the trifocal tensor says, and affine maps carry the pixels between (as in view morphing, Seitz and Dyer, SIGGRAPH 1996).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

# A triangle that is stretched more than so many times spans two surfaces.
_MOST_STRETCH = 4.0
# of the picture's width: longer edges span what no match was found on
_LONGEST_EDGE = 0.12


@dataclass(frozen=True)
class NewView:
    """A synthesised photograph.

    Attributes:
        pixels: (H, W, 3) uint8 RGB. is_filled: (H, W) bool.
        num_triangles: of both nets.
    """

    pixels: Pixels
    is_filled: NDArray[np.bool_]
    num_triangles: int


def synthesise(
    pictures: tuple[Pixels, Pixels], xy: tuple[Array, Array], target: Array, depth: Array, size: tuple[int, int]
) -> NewView:
    """Draw a view from two photographs.

    Args:
        pictures: (H, W, 3) uint8 RGB of photographs 1 and 2. xy: (N, 2) matched pixels in each.
        target: (N, 2) where the matches are in the new view. depth: (N,) that grows with the distance from it: what is
            nearer covers what is farther.
        size: (width, height) of the new view.
    """
    drawn, weights, count = [], [], 0
    for picture, source in zip(pictures, xy, strict=True):
        label, corners, stretch = _net(source, target, depth, size, picture.shape[1])
        count += len(corners)
        drawn.append(_carried(picture, label, source[corners], target[corners]))
        # what was seen from nearer is sharper
        own = np.zeros(label.shape)
        own[label >= 0] = 1.0 / np.maximum(stretch[label[label >= 0]], 1e-6)
        weights.append(own)
    total = weights[0] + weights[1]
    is_filled = total > 0
    share = np.divide(weights[0], total, out=np.zeros_like(total), where=is_filled)[:, :, None]
    mixed = share * drawn[0] + (1.0 - share) * drawn[1]
    pixels = np.where(is_filled[:, :, None], np.rint(mixed), 0).astype(np.uint8)
    return NewView(pixels, np.asarray(is_filled, np.bool_), count)


def _net(
    source: Array, target: Array, depth: Array, size: tuple[int, int], width: int
) -> tuple[NDArray[np.int32], NDArray[np.int64], Array]:
    """Which triangle each pixel (H, W) of the new view shows, -1 for none; the corners (T, 3), and how many pixels of
    the new view one of the photograph becomes."""
    import cv2
    from scipy.spatial import Delaunay

    corners = np.asarray(Delaunay(source).simplices, np.int64)
    a, b = source[corners], target[corners]
    edges = [np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2) for x in (a, b)]
    areas = [_doubled_areas(x) for x in (a, b)]
    ratio = edges[1] / np.maximum(edges[0], 1e-9)
    keeps = (
        (edges[0].max(1) < _LONGEST_EDGE * width) & (ratio.max(1) < _MOST_STRETCH) & (ratio.min(1) > 1 / _MOST_STRETCH)
        & (areas[0] * areas[1] > 0)
    )  # fmt: skip
    corners, stretch = corners[keeps], np.abs(areas[1] / np.where(areas[0] == 0, 1.0, areas[0]))[keeps]
    label = np.full((size[1], size[0]), -1, np.int32)
    # the farthest first
    for n in np.argsort(-depth[corners].mean(1), kind="stable"):
        # sixteenths of a pixel, whose centres stand at a half
        shape = np.rint((target[corners[n]] - 0.5) * 16.0).astype(np.int32)
        cv2.fillConvexPoly(label, shape, int(n), shift=4)
    return label, corners, stretch


def _doubled_areas(triangles: Array) -> Array:
    """(T,) signed, of triangles (T, 3, 2)."""
    one, two = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    areas: Array = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    return areas


def _carried(picture: Pixels, label: NDArray[np.int32], source: Array, target: Array) -> Array:
    """(H, W, 3) the photograph's pixels through the affine map of each triangle."""
    import cv2

    # target to source, with a row for the shift: (T, 2, 3)
    bases = np.concatenate([target, np.ones((*target.shape[:2], 1))], 2)
    maps = np.linalg.solve(bases, source).swapaxes(1, 2)
    y, x = np.nonzero(label >= 0)
    of_pixel = maps[label[y, x]]
    at = np.einsum("nij,nj->ni", of_pixel, np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1)) - 0.5
    map_xy = np.full((*label.shape, 2), -10.0, np.float32)
    map_xy[y, x] = at
    return np.asarray(
        cv2.remap(picture, map_xy[..., 0], map_xy[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
        np.float64,
    )


def correlation(first: Pixels, second: Pixels, is_used: NDArray[np.bool_]) -> float:
    """Normalised cross-correlation of the grey values of two pictures where they are to be compared."""
    grey = [picture[is_used].astype(np.float64).mean(1) for picture in (first, second)]
    if len(grey[0]) < 2:
        return 0.0
    a, b = (each - each.mean() for each in grey)
    return float(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12))
