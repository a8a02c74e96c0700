"""Chessboards in a picture, whole or in part: saddles of the brightness that continue each other row by row.

At a crossing of four fields the brightness has a saddle, and the two directions in which it does not bend are the
edges. Neighbours lie along the edges and are saddles of the other sense (light and dark have changed places), so a
grid grows from a saddle by itself; each step is predicted from the one before, which follows perspective and
distortion alike. After the idea of Geiger et al., "Automatic camera and range sensor calibration using a single shot",
ICRA 2012.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.growing import Steps, grow

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Blurs in pixels at which saddles are looked for: sharp pictures first.
_BLURS = (1.2, 2.5, 5.0)
# saddles that are as strong as this share of the strongest hundredth; paper in the shade has a tenth of the contrast
_WEAKEST = 0.02
_MOST = 3000
_MOST_SEEDS = 80
# neighbours that a saddle is looked for among: in a large field there is noise between it and the next
_NEAR = 50
# how far from its prediction a neighbour may be, as a share of the step; how far its edges may be turned, radians
_OFF, _TURNED = 0.3, 0.45
# the light changes slowly over a board: a crossing with a sixth of the strength, four tenths of the contrast, of those
# around it is none
_WEAK = 1.0 / 6.0
# of a step along both: where the four fields are looked at, near the crossing and further away; and by how much of the
# contrast the light ones must be lighter than the dark ones
_FIELD_SHARES = (0.15, 0.3)
_FOUR_FIELDS = 0.4
# fewer corners than these are found in any wallpaper
_LEAST = 12


@dataclass(frozen=True)
class Lattice:
    """Crossings that continue each other.

    Attributes:
        places: (N, 2) column and row, from 0; columns and rows turn as x and y do.
        xy: (N, 2) pixels, centres at whole numbers.
        sense: (N,) +1 where the field between the growing column and the growing row is dark, -1 where it is light.
        strength: (N,) how sharp the crossings are: minus the determinant of the Hessian.
    """

    places: Ints
    xy: Array
    sense: Ints
    strength: Array


@dataclass(frozen=True)
class _Saddles:
    xy: Array
    edges: Array  # (N, 2) angles of the two edges, radians
    tree: Any
    bend: Array  # (N, 3) Hessian xx, xy, yy
    strength: Array  # (N,) how far its determinant is below zero


def find_lattice(gray: NDArray[np.uint8], wanted: int) -> Lattice | None:
    """The grid of crossings in a picture; None for none. Of several (a screen that shows a board has another on it) the
    one that covers most, among those with at least half as many crossings as any. Blurrier pictures are looked into
    until ``wanted`` are found."""
    found: list[Lattice] = []
    for blur in _BLURS:
        found += _lattices(gray, _saddles(gray, blur))
        if any(len(one.xy) >= wanted for one in found):
            break
    most = min(max((len(one.xy) for one in found), default=0), wanted)
    large = [one for one in found if 2 * len(one.xy) >= most]
    return max(large, key=lambda one: (_area(one), len(one.xy)), default=None)


def _area(lattice: Lattice) -> float:
    """That its crossings span, in steps of a tenth, so that among equals the number of crossings counts."""
    spread = np.linalg.det(np.cov(lattice.xy.T)) ** 0.5
    return round(10.0 * float(np.log(max(spread, 1e-9)))) / 10.0


def _saddles(gray: NDArray[np.uint8], blur: float) -> _Saddles:
    import cv2
    from scipy.spatial import cKDTree

    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), blur)
    # differences over as many pixels as the blur is wide
    ix, iy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3)
    ixx, iyy = cv2.Sobel(ix, cv2.CV_32F, 1, 0, ksize=3), cv2.Sobel(iy, cv2.CV_32F, 0, 1, ksize=3)
    ixy = cv2.Sobel(ix, cv2.CV_32F, 0, 1, ksize=3)
    strength = ixy * ixy - ixx * iyy
    radius = max(1, round(1.5 * blur))
    highest = cv2.dilate(strength, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8))
    border = 3
    inner = np.zeros(gray.shape, np.bool_)
    inner[border:-border, border:-border] = True
    rows, cols = np.nonzero((strength >= highest) & (strength > 0) & inner)
    strong = strength[rows, cols]
    order = np.argsort(-strong, kind="stable")[:_MOST]
    if len(order):
        level = strong[order[len(order) // 100]]
        order = order[strong[order] > _WEAKEST * level]
    rows, cols = rows[order], cols[order]
    a, b, c = (image[rows, cols].astype(np.float64) for image in (ixx, ixy, iyy))
    # a tangent of the angle of an edge: a + 2 b t + c t^2 = 0, written so that nothing is divided by zero
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    edges = np.stack([np.arctan2(-b + root, c), np.arctan2(-b - root, c)], 1)
    # the place where the gradient is none
    det = np.maximum(b * b - a * c, 1e-12)
    gx, gy = (image[rows, cols].astype(np.float64) for image in (ix, iy))
    # Sobel's kernels are 8 times a difference over a pixel; second ones 64 times
    dx, dy = 8.0 * (c * gx - b * gy) / det, 8.0 * (a * gy - b * gx) / det
    far = np.hypot(dx, dy) > 1.5 * blur + 0.5
    dx[far], dy[far] = 0.0, 0.0
    xy = np.stack([cols + dx, rows + dy], 1)
    return _Saddles(xy, edges, cKDTree(xy) if len(xy) else None, np.stack([a, b, c], 1), b * b - a * c)


def _lattices(gray: NDArray[np.uint8], saddles: _Saddles) -> list[Lattice]:
    found: list[Lattice] = []
    is_taken = np.zeros(len(saddles.xy), np.bool_)
    num_seeds = 0
    for seed in range(len(saddles.xy)):
        if is_taken[seed]:
            continue
        num_seeds += 1
        if num_seeds > _MOST_SEEDS:
            break
        grown = _grown(saddles, seed)
        if len(grown) >= _LEAST:
            is_taken[list(grown.values())] = True
            crossings = _without_tails(_with_four_fields(gray, saddles, grown))
            if len(crossings) >= _LEAST:
                found.append(_lattice(saddles, crossings))
    return found


def _grown(saddles: _Saddles, seed: int) -> dict[tuple[int, int], int]:
    """Saddles by place, from one of them on, over whatever continues it."""
    first = _first_steps(saddles, seed)
    if first is None:
        return {}
    xy = saddles.xy

    def find(here: int, step: Array, steps: Steps) -> int | None:
        found = _nearest(saddles, xy[here] + step, here, steps)
        is_near = found is not None and np.hypot(*(xy[found] - xy[here] - step)) <= _OFF * np.hypot(*step)
        return found if is_near else None

    places = grow(xy, seed, first, find)
    return _without_tails(_without_weak(saddles, places))


def _without_weak(saddles: _Saddles, places: dict[tuple[int, int], int]) -> dict[tuple[int, int], int]:
    """Without saddles far weaker than those around them: the outer edge of a board has some, where dark fields end."""
    kept = {}
    for (c, r), idx in places.items():
        around = [places[c + i, r + j] for i in (-1, 0, 1) for j in (-1, 0, 1) if (c + i, r + j) in places]
        if saddles.strength[idx] > _WEAK * np.median(saddles.strength[around]):
            kept[c, r] = idx
    return kept


def _with_four_fields(
    gray: NDArray[np.uint8], saddles: _Saddles, places: dict[tuple[int, int], int]
) -> dict[tuple[int, int], int]:
    """Without saddles that are no crossing of four fields: where a board ends its margin takes the place of two."""
    kept = {}
    for (c, r), idx in places.items():
        at = saddles.xy[idx]
        steps = [
            _step(saddles, places, (c, r), (1, 0)), _step(saddles, places, (c, r), (0, 1)),
        ]  # fmt: skip
        if steps[0] is None or steps[1] is None:
            continue
        worst = min(field_contrast(gray, at, steps[0], steps[1], share) for share in _FIELD_SHARES)
        if worst > _FOUR_FIELDS:
            kept[c, r] = idx
    return kept


def _step(
    saddles: _Saddles, places: dict[tuple[int, int], int], at: tuple[int, int], way: tuple[int, int]
) -> Array | None:
    """From a saddle to the next, by the ones before and behind it; None where there is neither."""
    here = places[at]
    ahead, behind = places.get((at[0] + way[0], at[1] + way[1])), places.get((at[0] - way[0], at[1] - way[1]))
    if ahead is None and behind is None:
        return None
    first, last = (here if behind is None else behind), (here if ahead is None else ahead)
    found: Array = (saddles.xy[last] - saddles.xy[first]) / (2.0 if here not in (first, last) else 1.0)
    return found


def field_contrast(gray: NDArray[np.uint8], at: Array, u: Array, v: Array, share: float) -> float:
    """By how much two fields across from each other are lighter than the others, of all contrast there is."""
    values = []
    for i, j in ((1, 1), (-1, -1), (1, -1), (-1, 1)):
        x, y = np.round(at + share * (i * u + j * v)).astype(int)
        if not (0 <= y < gray.shape[0] and 0 <= x < gray.shape[1]):
            return 1.0  # what is outside of the picture says nothing
        values.append(float(gray[y, x]))
    one, other = values[:2], values[2:]
    spread = max(values) - min(values)
    return max(min(one) - max(other), min(other) - max(one)) / spread if spread > 0 else 0.0


def _nearest(saddles: _Saddles, at: Array, here: int, steps: tuple[Array, Array]) -> int | None:
    """The saddle nearest to a place that may be the neighbour of another: of the other sense, its edges alike."""
    _, candidates = saddles.tree.query(at, k=min(5, len(saddles.xy)))
    sense = _sense(saddles, here, steps)
    for other in np.atleast_1d(candidates):
        if (
            int(other) != here
            and _sense(saddles, int(other), steps) == -sense
            and _is_along(saddles, int(other), steps)
        ):
            return int(other)
    return None


def _sense(saddles: _Saddles, idx: int, steps: tuple[Array, Array]) -> int:
    """+1 where the field between two steps is dark, so that the brightness has its top on the way across; -1 where it
    is
    light."""
    a, b, c = saddles.bend[idx]
    u, v = steps[0] / np.hypot(*steps[0]), steps[1] / np.hypot(*steps[1])
    dx, dy = u + v
    return 1 if a * dx * dx + 2.0 * b * dx * dy + c * dy * dy < 0 else -1


def _is_along(saddles: _Saddles, idx: int, steps: tuple[Array, Array]) -> bool:
    """Whether the two edges at a saddle lie along two steps."""
    wanted = [np.arctan2(step[1], step[0]) for step in steps]
    first, second = saddles.edges[idx]
    straight = max(_between(first, wanted[0]), _between(second, wanted[1]))
    crossed = max(_between(first, wanted[1]), _between(second, wanted[0]))
    return min(straight, crossed) < _TURNED


def _between(a: float, b: float) -> float:
    """Angle between two lines, radians."""
    return float(abs((a - b + np.pi / 2) % np.pi - np.pi / 2))


def _first_steps(saddles: _Saddles, seed: int) -> tuple[Array, Array] | None:
    """Steps to a neighbour along each of the edges of a saddle, turning as x and y do."""
    distances, near = saddles.tree.query(saddles.xy[seed], k=min(_NEAR, len(saddles.xy)))
    units = np.stack([np.cos(saddles.edges[seed]), np.sin(saddles.edges[seed])], 1)
    if units[0, 0] * units[1, 1] - units[0, 1] * units[1, 0] < 0:
        units = units[::-1]
    pair = (units[0], units[1])
    sense = _sense(saddles, seed, pair)
    found: list[Array | None] = [None, None]
    for distance, other in zip(np.atleast_1d(distances)[1:], np.atleast_1d(near)[1:], strict=True):
        if distance < 3.0 or not np.isfinite(distance):
            continue
        away = saddles.xy[other] - saddles.xy[seed]
        for k in range(2):
            is_ahead = abs(away @ units[k]) > np.cos(0.25) * distance
            if found[k] is not None or not is_ahead or _sense(saddles, int(other), pair) != -sense:
                continue
            if _is_along(saddles, int(other), pair):
                found[k] = away * np.sign(away @ units[k])
    if found[0] is None or found[1] is None:
        return None
    return found[0], found[1]


def _without_tails(places: dict[tuple[int, int], int]) -> dict[tuple[int, int], int]:
    """Without what hangs on by one side alone, and is no part of any field."""
    while True:
        kept = {at: idx for at, idx in places.items() if _num_fields(at, places)}
        if len(kept) == len(places):
            return kept
        places = kept


def _num_fields(at: tuple[int, int], places: dict[tuple[int, int], int]) -> int:
    c, r = at
    return sum(
        (c + i, r) in places and (c, r + j) in places and (c + i, r + j) in places for i in (-1, 1) for j in (-1, 1)
    )


def _lattice(saddles: _Saddles, grown: dict[tuple[int, int], int]) -> Lattice:
    places = np.array(list(grown), np.int64)
    idx = np.array([grown[at] for at in grown])
    places -= places.min(0)
    order = np.lexsort((places[:, 0], places[:, 1]))
    places, idx = places[order], idx[order]
    xy = saddles.xy[idx]
    ones = np.ones(len(places))
    (u, v, _) = np.linalg.lstsq(np.stack([places[:, 0], places[:, 1], ones], 1), xy, rcond=None)[0]
    sense = np.array([_sense(saddles, int(k), (u, v)) for k in idx], np.int64)
    return Lattice(places, xy, sense, saddles.strength[idx])
