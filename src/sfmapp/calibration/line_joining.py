"""Pieces of edges that change sides, dark for light, as the lines of a chessboard do at each field: joined into lines.

A chain of edge points is followed with the bright side on one hand, so it ends there. Two pieces are one line where
their ends meet and one circle fits both as well as two do. Where light is not recorded in proportion, bright things
grow by some tenths of a pixel, and such lines go in zigzag: by how much is told by pieces between two others, and taken
back.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.circle_arcs import distance_from, fit_circle

Array = NDArray[np.float64]

# Pixels of the shortest piece; points that an end loses, which the smoothing pulls round the corner of a field (three
# standard deviations of one pixel); and the widest gap that is left: both corners, and as much again of blur.
LEAST_PIECE_PX = 16.0
_TRIMMED, _MOST_GAP_PX = 3, 12.0
# Cosine of the angle between two pieces of a line (10 degrees), and what their circle may be off by beyond their own:
# edges are good to a twentieth of a pixel, and pieces of a lens that no circle has exactly to a tenth.
_LEAST_COSINE, _APART_PX = 0.985, 0.15
# Pieces between two others that it takes to tell by how much bright things have grown.
_LEAST_BETWEEN = 8


def join_pieces(xy: Array, pieces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Chains of the pieces that go on in each other, where their edges are.

    Args:
        xy: (M, 2) points, which are moved in place.
        pieces: (N, 2) the first point of each, and the point behind its last.

    Returns:
        (K, 2) the points in the order of their chains, and (C + 1,) where each chain begins.
    """
    # as long as bright things have grown, lines go in zigzag
    grown = _grown(xy, pieces, _partners(xy, pieces, 2.0 * _APART_PX))
    if len(grown) >= _LEAST_BETWEEN:
        _shrink(xy, pieces, float(np.median(grown)))
    return _joined(xy, pieces, _partners(xy, pieces, _APART_PX))


@numba.njit(cache=True, nogil=True)
def _put(xy: Array, first: int, last: int, is_reversed: bool, out: Array, count: int) -> int:
    """Append points first to last (excluded), and return how many there are then."""
    for k in range(last - first):
        out[count + k] = xy[last - 1 - k] if is_reversed else xy[first + k]
    return count + last - first


@numba.njit(cache=True, nogil=True)
def _apart(xy: Array, a: NDArray[np.int64], b: NDArray[np.int64], end: int, buffer: Array, circle: Array) -> float:
    """What the circle of two pieces that meet with an end each (0 their first, 1 their last points) is off by beyond
    what the circles of each are, rms in pixels."""
    count = _put(xy, a[0] + _TRIMMED, a[1] - _TRIMMED, end == 0, buffer, 0)
    middle = count
    count = _put(xy, b[0] + _TRIMMED, b[1] - _TRIMMED, end == 1, buffer, count)
    first = fit_circle(buffer, 0, middle, circle)
    second = fit_circle(buffer, middle, count, circle)
    own = (middle * first * first + (count - middle) * second * second) / count
    joint = fit_circle(buffer, 0, count, circle)
    return math.sqrt(max(joint * joint - own, 0.0))


@numba.njit(cache=True, nogil=True)
def _partners(xy: Array, pieces: NDArray[np.int64], most_apart: float) -> NDArray[np.int64]:
    """(N, 2) for the first and the last points of each piece the piece that goes on there with its sides changed, their
    circle being off by so many pixels at most; -1 for none.

    Chains are followed with the bright side on one hand: where the sides change, two first or two last points meet.
    """
    num = len(pieces)
    best, least = np.full((num, 2), -1, np.int64), np.full((num, 2), np.inf)
    longest = 0
    for i in range(num):
        longest = max(longest, pieces[i, 1] - pieces[i, 0])
    buffer, circle = np.empty((2 * longest, 2)), np.empty(7)
    tips, chords = np.empty((num, 2, 2)), np.empty((num, 2))
    for i in range(num):
        tips[i, 0], tips[i, 1] = xy[pieces[i, 0] + _TRIMMED], xy[pieces[i, 1] - 1 - _TRIMMED]
        chord = tips[i, 1] - tips[i, 0]
        chords[i] = chord / math.hypot(chord[0], chord[1])
    for end in range(2):
        order = np.argsort(tips[:, end, 0])
        for k in range(num):
            i = order[k]
            for m in range(k + 1, num):
                j = order[m]
                dx, dy = tips[j, end, 0] - tips[i, end, 0], tips[j, end, 1] - tips[i, end, 1]
                if dx > _MOST_GAP_PX:
                    break
                if chords[i, 0] * chords[j, 0] + chords[i, 1] * chords[j, 1] > -_LEAST_COSINE:
                    continue
                along = dx * chords[i, 0] + dy * chords[i, 1]
                across = dy * chords[i, 0] - dx * chords[i, 1]
                # the other goes on, and does not run alongside
                along = along if end == 1 else -along
                if not (0.0 < along <= _MOST_GAP_PX and abs(across) <= 0.25 * _MOST_GAP_PX):
                    continue
                apart = _apart(xy, pieces[i], pieces[j], end, buffer, circle)
                if apart > most_apart:
                    continue
                if apart < least[i, end]:
                    best[i, end], least[i, end] = j, apart
                if apart < least[j, end]:
                    best[j, end], least[j, end] = i, apart
    partners = np.full((num, 2), -1, np.int64)
    for i in range(num):
        for end in range(2):
            j = best[i, end]
            if j >= 0 and best[j, end] == i:
                partners[i, end] = j
    return partners


@numba.njit(cache=True, nogil=True)
def _grown(xy: Array, pieces: NDArray[np.int64], partners: NDArray[np.int64]) -> Array:
    """By how much an edge is to the left of where it is, seen along its chain, in pixels: half of what each piece
    between two others is off from the circle of these, whose sides are the other way round."""
    longest = 0
    for i in range(len(pieces)):
        longest = max(longest, pieces[i, 1] - pieces[i, 0])
    buffer, circle = np.empty((2 * longest, 2)), np.empty(7)
    grown, count = np.empty(len(pieces)), 0
    for i in range(len(pieces)):
        before, after = partners[i, 0], partners[i, 1]
        if before < 0 or after < 0:
            continue
        num = _put(xy, pieces[before, 0] + _TRIMMED, pieces[before, 1] - _TRIMMED, True, buffer, 0)
        num = _put(xy, pieces[after, 0] + _TRIMMED, pieces[after, 1] - _TRIMMED, True, buffer, num)
        fit_circle(buffer, 0, num, circle)
        span = math.hypot(buffer[num - 1, 0] - buffer[0, 0], buffer[num - 1, 1] - buffer[0, 1])
        first, last, total = pieces[i, 0] + _TRIMMED, pieces[i, 1] - _TRIMMED, 0.0
        for k in range(first, last):
            total += distance_from(circle, xy[k, 0], xy[k, 1], span)
        grown[count] = 0.5 * total / (last - first)
        count += 1
    return grown[:count]


@numba.njit(cache=True, nogil=True)
def _shrink(xy: Array, pieces: NDArray[np.int64], grown: float) -> None:
    """Move the points of pieces to where their edges are."""
    for i in range(len(pieces)):
        first, last = pieces[i, 0], pieces[i, 1]
        dx, dy = xy[last - 1, 0] - xy[first, 0], xy[last - 1, 1] - xy[first, 1]
        length = math.hypot(dx, dy)
        for k in range(first, last):
            xy[k, 0] += grown * dy / length
            xy[k, 1] -= grown * dx / length


@numba.njit(cache=True, nogil=True)
def _joined(xy: Array, pieces: NDArray[np.int64], partners: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Chains of the pieces that go on in each other, as :func:`join_pieces` has them."""
    num = len(pieces)
    total = 0
    for i in range(num):
        total += pieces[i, 1] - pieces[i, 0]
    out, starts = np.empty((total, 2)), np.empty(num + 1, np.int64)
    seen, count, chains = np.zeros(num, np.bool_), 0, 0
    for is_loop in (False, True):
        for begin in range(num):
            if seen[begin] or (not is_loop and partners[begin, 0] >= 0 and partners[begin, 1] >= 0):
                continue
            starts[chains] = count
            chains += 1
            i, end = begin, 1 if partners[begin, 0] < 0 else 0
            is_first = True
            while i >= 0 and not seen[i]:
                seen[i] = True
                after = partners[i, end]
                first, last = pieces[i, 0], pieces[i, 1]
                for side in range(2):
                    if (side != end and not is_first) or (side == end and after >= 0):
                        if side == 0:
                            first += _TRIMMED
                        else:
                            last -= _TRIMMED
                count = _put(xy, first, last, end == 0, out, count)
                # the next is entered where this one is left
                i, end, is_first = after, 1 - end, False
    starts[chains] = count
    return out[:count], starts[: chains + 1]
