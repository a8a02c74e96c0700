"""Grids of circles in a picture, whole or in part: blobs that continue each other, and centres without the bias of
perspective.

The image of a circle is an ellipse whose centre is not the image of the circle's centre (Heikkila, "Geometric camera
calibration using circular control points", PAMI 2000). With f the map from the board to the picture and a radius r, the
centre of mass of the image of the disk is off by

    r^2 / 8 (f_xx + f_yy) + r^2 / 4 grad f . grad log |det grad f|

up to the fourth order of r: the curvature of f, and that the nearer part of the disk is drawn larger. Both follow from
a homography through all circles and a cubic through what it leaves of those around, so that perspective and the bend
of the lens both count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.boards import Board
from sfmapp.calibration.growing import Steps, grow
from sfmapp.geometry.dlt import find_homography, homogeneous

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Pixels = NDArray[np.uint8]

# Sides of the windows of the adaptive threshold, as shares of the longer side of the picture: small circles first.
_WINDOWS = (1.0 / 40.0, 1.0 / 16.0, 1.0 / 7.0)
_LEAST_AREA = 14.0
_LARGEST_AREA = 0.03
# area over that of the ellipse with the same second moments: 1 for an ellipse, 0.955 for a square or diamond; blobs of
# fewer pixels than so many are too coarse for that
_ROUND, _COARSE_ROUND, _COARSE = (0.97, 1.03), (0.9, 1.06), 80.0
# of the two axes of an ellipse: a circle seen from 78 degrees
_FLATTEST = 0.2
# a neighbour is as large as a blob, within this ratio of areas
_ALIKE = 2.0
# how far from its prediction a neighbour may be, as a share of the shorter step
_OFF = 0.3
_NEAR = 9
_LEAST = 8
# of the steps of a cell: less is a row, not a grid
_FLAT_CELL = 0.15
_FROM = 16


@dataclass(frozen=True)
class Disks:
    """Blobs that may be circles.

    Attributes:
        xy: (N, 2) pixels, centres at whole numbers.
        area: (N,) pixels.
    """

    xy: Array
    area: Array


@dataclass(frozen=True)
class CircleLattice:
    """Circles that continue each other.

    Attributes:
        places: (N, 2) whole numbers along two steps, which turn as x and y do.
        xy: (N, 2) pixels, centres at whole numbers.
    """

    places: Ints
    xy: Array


def find_circle_lattice(gray: Pixels, wanted: int) -> CircleLattice | None:
    """The largest grid of blobs in a picture, dark on light or light on dark; None for none. Larger windows are looked
    through until ``wanted`` circles are found."""
    best: CircleLattice | None = None
    for share in _WINDOWS:
        for picture in (gray, 255 - gray):
            found = _largest_lattice(find_disks(picture, share))
            if found is not None and (best is None or len(found.xy) > len(best.xy)):
                best = found
        if best is not None and len(best.xy) >= wanted:
            break
    return best


def find_disks(gray: Pixels, window: float) -> Disks:
    """Dark blobs that are as round as circles from anywhere. ``window``: of the threshold, a share of the picture."""
    import cv2

    side = 2 * int(0.5 * window * max(gray.shape)) + 3
    smooth = cv2.GaussianBlur(gray, (3, 3), 0)
    dark = cv2.adaptiveThreshold(smooth, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, side, 6)
    outlines, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    xy, area = [], []
    for outline in outlines:
        if len(outline) < 10:
            continue
        moments = cv2.moments(outline)
        size = moments["m00"]
        # the outline runs through the centres of pixels, half of one inside of the edge
        full = size + 0.5 * len(outline)
        if not (full > _LEAST_AREA and full < _LARGEST_AREA * gray.size) or size <= 0:
            continue
        left, top, width, height = cv2.boundingRect(outline)
        if left < 1 or top < 1 or left + width >= gray.shape[1] or top + height >= gray.shape[0]:
            continue  # cut by the border
        a, b, c = moments["mu20"] / size, moments["mu11"] / size, moments["mu02"] / size
        det = a * c - b * b
        if det <= 0:
            continue
        large = 0.5 * (a + c) + np.sqrt(0.25 * (a - c) ** 2 + b * b)
        roundness = size / (4.0 * np.pi * np.sqrt(det))
        lowest, highest = _ROUND if full > _COARSE else _COARSE_ROUND
        if lowest < roundness < highest and det / large**2 > _FLATTEST**2:
            xy.append((moments["m10"] / size, moments["m01"] / size))
            area.append(full)
    return Disks(np.array(xy).reshape(-1, 2), np.array(area))


def _largest_lattice(disks: Disks) -> CircleLattice | None:
    from scipy.spatial import cKDTree

    if len(disks.xy) < _LEAST:
        return None
    tree = cKDTree(disks.xy)
    best: dict[tuple[int, int], int] = {}
    is_taken = np.zeros(len(disks.xy), np.bool_)
    # the middle of the board is surest to have neighbours all round
    order = np.argsort(np.linalg.norm(disks.xy - np.median(disks.xy, axis=0), axis=1))
    num_seeds = 0
    for seed in order.tolist():
        if is_taken[seed]:
            continue
        num_seeds += 1
        if num_seeds > _FROM or 2 * len(best) > len(disks.xy):
            break
        grown = _grown(disks, tree, seed)
        is_taken[list(grown.values())] = True
        if len(grown) > len(best):
            best = grown
    if len(best) < _LEAST:
        return None
    places = np.array(list(best), np.int64)
    if np.ptp(places, axis=0).min() < 1:
        return None
    return CircleLattice(places - places.min(0), disks.xy[list(best.values())])


def _grown(disks: Disks, tree: object, seed: int) -> dict[tuple[int, int], int]:
    """Blobs by place, from one of them on."""
    first = _first_steps(disks, tree, seed)
    if first is None:
        return {(0, 0): seed}
    xy = disks.xy

    def find(here: int, step: Array, steps: Steps) -> int | None:
        distance, other = tree.query(xy[here] + step)  # type: ignore[attr-defined]
        shortest = min(np.hypot(*steps[0]), np.hypot(*steps[1]))
        ratio = disks.area[other] / disks.area[here]
        if distance > _OFF * shortest or not 1.0 / _ALIKE < ratio < _ALIKE:
            return None
        return int(other)

    return grow(xy, seed, first, find)


def _first_steps(disks: Disks, tree: object, seed: int) -> tuple[Array, Array] | None:
    """The two shortest steps that go two ways, turning as x and y do, to blobs that have one on the other side too."""
    xy = disks.xy
    distances, near = tree.query(xy[seed], k=min(_NEAR, len(xy)))  # type: ignore[attr-defined]
    found: list[Array] = []
    for distance, other in zip(distances[1:], near[1:], strict=True):
        ratio = disks.area[other] / disks.area[seed]
        if not 1.0 / _ALIKE < ratio < _ALIKE or distance < 3.0:
            continue
        away = xy[other] - xy[seed]
        behind, _ = tree.query(xy[seed] - away)  # type: ignore[attr-defined]
        if behind > _OFF * distance:
            continue
        if found and abs(_cross(found[0], away)) < _FLAT_CELL * np.hypot(*found[0]) * distance:
            continue
        found.append(away)
        if len(found) == 2:
            u, v = found
            return (u, v) if _cross(u, v) > 0 else (v, u)
    return None


def _cross(a: Array, b: Array) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


# ---------------------------------------------------------------------------------------------------------- on a board


def grid_of(board: Board) -> Ints:
    """(N, 2) whole numbers, columns and rows of the circles of a board."""
    found: Ints = np.round(board.points[:, :2] / board.spacing).astype(np.int64)
    return found


def place_on(lattice: CircleLattice, grid: Ints) -> tuple[Ints, Array] | None:
    """The circles of a board that a lattice may be: which, and (N, 2) pixels.

    Two steps from circle to circle span the lattice in more than one way (seen from the side a diagonal may be the
    shortest), so steps are tried until the lattice fits the board; of equal fits the one whose outline has fewest
    holes.

    Args:
        grid: as :func:`grid_of` has it.
    """
    index = {(int(c), int(r)): i for i, (c, r) in enumerate(grid)}
    size = grid.max(0) + 1
    best: tuple[Ints, Array] | None = None
    best_score = (0, -np.inf, -np.inf)
    for steps in _steps_of(grid):
        moved = lattice.places @ steps
        low, high = moved.min(0), moved.max(0)
        span = high - low + 1
        fill = -float(np.prod(span))
        # of two ways round, the one that is nearer to upright
        upright = round(float(((moved - moved.mean(0)) * (lattice.xy - lattice.xy.mean(0))).sum()), 3)
        for left in range(min(0, int(size[0] - span[0])), max(0, int(size[0] - span[0])) + 1):
            for top in range(min(0, int(size[1] - span[1])), max(0, int(size[1] - span[1])) + 1):
                if len(moved) < best_score[0]:
                    continue
                at = moved - low + [left, top]
                found = [index.get((int(c), int(r)), -1) for c, r in at]
                idx = np.array(found, np.int64)
                score = (int((idx >= 0).sum()), fill, upright)
                if score > best_score:
                    best, best_score = (idx[idx >= 0], lattice.xy[idx >= 0]), score
    return best


def _steps_of(grid: Ints) -> list[Ints]:
    """(2, 2) what the two steps of a lattice may be on a board, rows, keeping the sense of turning."""
    on = {tuple(place) for place in (grid - grid[len(grid) // 2]).tolist()}
    is_staggered = (1, 0) not in on and (0, 1) not in on
    reach = range(-2, 3)
    ways = [(c, r) for c in reach for r in reach if (c, r) != (0, 0) and (not is_staggered or (c + r) % 2 == 0)]
    # a cell holds one circle: its area is that of the board's
    cell = 2 if is_staggered else 1
    found = [np.array([u, v]) for u in ways for v in ways if u[0] * v[1] - u[1] * v[0] == cell]
    return sorted(found, key=lambda steps: (int((steps**2).sum()), steps.tolist()))


# -------------------------------------------------------------------------------------------------------- their centres


def disk_bias(places: Array, xy: Array, radius: float, num_around: int = 25) -> Array:
    """(N, 2) by how much the centres of mass of disks are off the images of their centres, pixels.

    Args:
        places: (N, 2) on the board. xy: (N, 2) pixels of the centres of mass.
        radius: of the disks, in the unit of places.
    """
    num = min(num_around, len(places))
    if num < 10:
        return np.zeros_like(xy)
    plain, first, second = _homography_derivatives(places, xy)
    distances = ((places[:, None] - places[None]) ** 2).sum(2)
    near = np.argsort(distances, axis=1, kind="stable")[:, :num]
    d = places[near] - places[:, None]
    x, y = d[..., 0], d[..., 1]
    design = np.stack([np.ones_like(x), x, y, 0.5 * x * x, x * y, 0.5 * y * y, x**3, x * x * y, x * y * y, y**3], -1)
    square = np.einsum("nka,nkb->nab", design, design)
    # circles that lie on three rows tell nothing of the third order across them
    square += 1e-9 * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(10)
    left = np.linalg.solve(square, np.einsum("nka,nki->nai", design, (xy - plain)[near]))
    fx, fy = left[:, 1] + first[0], left[:, 2] + first[1]
    fxx, fxy, fyy = (left[:, 3 + k] + second[k] for k in range(3))
    det = fx[:, 0] * fy[:, 1] - fx[:, 1] * fy[:, 0]
    det_x = fxx[:, 0] * fy[:, 1] + fx[:, 0] * fxy[:, 1] - fxx[:, 1] * fy[:, 0] - fx[:, 1] * fxy[:, 0]
    det_y = fxy[:, 0] * fy[:, 1] + fx[:, 0] * fyy[:, 1] - fxy[:, 1] * fy[:, 0] - fx[:, 1] * fyy[:, 0]
    nearer = (fx * det_x[:, None] + fy * det_y[:, None]) / det[:, None]
    bias: Array = radius**2 * (0.125 * (fxx + fyy) + 0.25 * nearer)
    return bias


def _homography_derivatives(places: Array, xy: Array) -> tuple[Array, Array, Array]:
    """Of the homography from places (N, 2) to pixels: values (N, 2), first (2, N, 2) and second derivatives (3, N, 2),
    by x x, x y and y y."""
    h = find_homography(places, xy)
    mapped = homogeneous(places) @ h.T
    w, value = mapped[:, 2:], mapped[:, :2] / mapped[:, 2:]
    by = [(h[:2, k] - value * h[2, k]) / w for k in range(2)]
    twice = [-(by[i] * h[2, j] + by[j] * h[2, i]) / w for i, j in ((0, 0), (0, 1), (1, 1))]
    return value, np.array(by), np.array(twice)
