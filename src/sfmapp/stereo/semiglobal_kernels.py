"""Kernels of semi-global matching: 64 disparities of a pixel are one vector of bytes.

Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008. Each pixel looks at the
disparities ``base + k``, k from 0 to 63, of a base of its own, which coarser levels tell. Where neighbours have other
bases their vectors are read shifted: in memory 32 bytes of 255 lie between pixels, so what falls outside is dear. Costs
along a path are held with their minimum at zero, which keeps them in a byte; four paths come from above, four from
below, and half their sums are kept.

``Rows`` is a ring: pictures with more rows than it has are worked on in strips, in which paths from below begin some
rows further down. Nothing here allocates.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.simd import u8x64 as u8
from sfmapp.simd.bits import first_bit
from sfmapp.simd.pointers import Index, Pointer, offset, pointer

LANES = u8.WIDTH
GAP = 32
STRIDE = LANES + GAP
# bases that differ by more share too few disparities to hand costs over
MOST_SHIFT = GAP - 2
# what leads out of the right picture costs no less than the best in it, and at most so many times as much: where there
# is nothing to tell disparities apart by, that they lead into the picture speaks for none of them
UNSEEN_OVER_SEEN = 3
# the mean of two pixels on opposite sides of one is of its surface where it is off by less
SAME_SURFACE_PX = 1.0
# greatest departure from linear of 8 x 8 weighted bytes, rounded up
NOISE_BINS = 2048
# disparities that are looked at beyond those of half the resolution
ROOM = 4
# at the beginning of a path
_START = 1 << 20

Bytes = NDArray[np.uint8]
Words = NDArray[np.uint64]
Ints = NDArray[np.int16]
Floats = NDArray[np.float32]


class Views(NamedTuple):
    """What is matched.

    Attributes:
        left: (H, W) uint64 words whose bits describe a pixel's surroundings.
        right: (H, W + 2 M) the same of the right picture, columns reversed, with M more on both sides.
        grey: (H, W) uint8 of the left picture.
        base: (H, W) int16 least disparity that a pixel looks at.
        expected: (H, W) uint8 lane that the coarser level found, 64 where it found none.
        doubt: (65, 64) uint8 by expected lane: what is added to costs; 255 for lanes that are not looked at.
    """

    left: Words
    right: Words
    grey: Bytes
    base: Ints
    expected: Bytes
    doubt: Bytes


class Penalties(NamedTuple):
    """Of a path: small (uint8) for a step of one disparity, large (256,) uint8 for a larger one by the difference in
    grey of the two pixels."""

    small: np.uint8
    large: Bytes


class Rows(NamedTuple):
    """(R, W, 64) uint8 each, row y at y % R: costs, and half the sums of the paths from above and from below."""

    costs: Bytes
    above: Bytes
    below: Bytes


class Found(NamedTuple):
    """(H, W) each.

    Attributes:
        disparity: float32 pixels.
        agrees: uint8, 1 where the right picture finds it too.
        best, elsewhere: uint8 half the sum of all paths there, and the least but for its neighbours.
        bend: int16 second difference of these sums there; 0 at the end of the search.
    """

    disparity: Floats
    agrees: Bytes
    best: Bytes
    elsewhere: Bytes
    bend: Ints


@numba.njit(cache=True, nogil=True)
def _beside(row: Pointer, at: Index, shift: Index, own: Any) -> Any:
    """Costs of a neighbour for one's own disparities; one's own where it does not look at them."""
    if shift > MOST_SHIFT or shift < -MOST_SHIFT:
        return own
    value = u8.load(row, at + shift)
    return u8.select_equal(value, u8.splat(np.uint8(255)), own, value)


@numba.njit(cache=True, nogil=True)
def _raw_costs(views: Views, y: Index, out: Pointer) -> None:
    """Differing bits of row y for all disparities."""
    width = views.left.shape[1]
    margin = (views.right.shape[1] - width) // 2
    right = pointer(views.right[y])
    for x in range(width):
        start = margin + width - 1 - x + views.base[y, x]
        u8.store(out, GAP + STRIDE * x, u8.count_differences(views.left[y, x], right, start))


@numba.njit(cache=True, nogil=True)
def smooth_columns(base: Ints, y: Index, raw: Bytes) -> None:
    """Weighted means, 1 2 1, of row y of a ring of raw costs (4, GAP + STRIDE W) and of those above and below it, into
    its last row."""
    height, width = base.shape
    above, below = max(y - 1, 0), min(y + 1, height - 1)
    row_a, row_b, row_c = pointer(raw[above % 3]), pointer(raw[y % 3]), pointer(raw[below % 3])
    middle = pointer(raw[3])
    for x in range(width):
        at, b = GAP + STRIDE * x, np.int64(base[y, x])
        own = u8.load(row_b, at)
        both = u8.mean(_beside(row_a, at, b - base[above, x], own), _beside(row_c, at, b - base[below, x], own))
        u8.store(middle, at, u8.mean(both, own))


@numba.njit(cache=True, nogil=True)
def smoothed(base: Ints, y: Index, x: Index, middle: Pointer) -> Any:
    """Costs of a pixel: the weighted mean, 1 2 1, of those in a row that :func:`smooth_columns` has made."""
    at, b = GAP + STRIDE * x, np.int64(base[y, x])
    own = u8.load(middle, at)
    left, right = max(x - 1, 0), min(x + 1, base.shape[1] - 1)
    both = u8.mean(
        _beside(middle, GAP + STRIDE * left, b - base[y, left], own),
        _beside(middle, GAP + STRIDE * right, b - base[y, right], own),
    )
    return u8.mean(both, own)


@numba.njit(cache=True, nogil=True)
def _smooth_costs(views: Views, unseen: np.uint8, y: Index, raw: Bytes, costs: Pointer) -> None:
    """Costs of row y: weighted means, 1 2 1 both ways, of raw costs of three rows; the cost of the unseen put in."""
    base, width = views.base, views.left.shape[1]
    middle, doubt = pointer(raw[3]), pointer(views.doubt)
    smooth_columns(base, y, raw)
    for x in range(width):
        b = np.int64(base[y, x])
        cost = smoothed(base, y, x, middle)
        first, last = x - b - width + 1, x - b + 1
        if first > 0 or last < LANES:
            seen = u8.lowest(u8.within(cost, first, last, u8.splat(np.uint8(255))))
            cost = u8.within(cost, first, last, u8.splat(cost_of_unseen(unseen, seen)))
        u8.store(costs, LANES * x, u8.add(cost, u8.load(doubt, LANES * np.int64(views.expected[y, x]))))


@numba.njit(cache=True, nogil=True)
def cost_of_unseen(unseen: np.uint8, seen: np.uint8) -> np.uint8:
    """Of what leads out of the other picture, by the least cost of what leads into it."""
    return np.uint8(min(max(np.int64(unseen), np.int64(seen)), UNSEEN_OVER_SEEN * np.int64(seen)))


@numba.njit(cache=True, nogil=True)
def fill_costs(views: Views, unseen: np.uint8, first: Index, last: Index, raw: Bytes, rows: Rows) -> None:
    """Costs of the rows first to last - 1; ``raw``: scratch (4, GAP + STRIDE W)."""
    height, ring = views.left.shape[0], rows.costs.shape[0]
    clear(raw)
    for y in range(max(first - 1, 0), min(first + 1, height)):
        _raw_costs(views, y, pointer(raw[y % 3]))
    for y in range(first, last):
        if y + 1 < height:
            _raw_costs(views, y + 1, pointer(raw[(y + 1) % 3]))
        _smooth_costs(views, unseen, y, raw, pointer(rows.costs[y % ring]))


@numba.njit(cache=True, nogil=True)
def _step(path: Pointer, at: Index, shift: Index, small: Any, large: np.uint8, cost: Any) -> Any:
    """One pixel further on a path: its costs, before their minimum is taken off."""
    if shift == _START:
        return cost
    m = u8.splat(large)
    if shift >= -MOST_SHIFT and shift <= MOST_SHIFT:
        before = at + shift
        m = u8.minimum(m, u8.load(path, before))
        beside = u8.minimum(u8.load(path, before - 1), u8.load(path, before + 1))
        m = u8.minimum(m, u8.add(beside, small))
    return u8.add(m, cost)


@numba.njit(cache=True, nogil=True)
def _follow_row(
    views: Views, penalties: Penalties, y: Index, step: Index, begins: bool, paths: Bytes, costs: Pointer, sums: Pointer
) -> None:
    """Four paths through row y: along it, on both diagonals, down the column; half their sum goes to ``sums``.

    step: 1 for paths from the left and from above, -1 for those from the right and from below. begins: no row came
    before.
    """
    width = views.left.shape[1]
    yb = y if begins else y - step
    base, base_b = pointer(views.base[y]), pointer(views.base[yb])
    grey, grey_b, large = pointer(views.grey[y]), pointer(views.grey[yb]), pointer(penalties.large)
    first, second, column, along = pointer(paths[0]), pointer(paths[1]), pointer(paths[2]), pointer(paths[3])
    small = u8.splat(penalties.small)
    x = 0 if step > 0 else width - 1
    diagonal_a, diagonal_b = (x - y) % width, (x + y) % width
    value_d = u8.splat(np.uint8(0))
    for n in range(width):
        b, g = np.int64(base[x]), np.int64(grey[x])
        cost = u8.load(costs, LANES * x)
        shift_a = shift_b = shift_c = shift_d = np.int64(_START)
        large_a = large_b = large_c = large_d = penalties.small
        xa, xb = x - step, x + step
        if not begins:
            shift_c = b - base_b[x]
            large_c = large[abs(g - grey_b[x])]
            if n > 0:
                shift_a = b - base_b[xa]
                large_a = large[abs(g - grey_b[xa])]
            if n < width - 1:
                shift_b = b - base_b[xb]
                large_b = large[abs(g - grey_b[xb])]
        if n > 0:
            shift_d = b - base[xa]
            large_d = large[abs(g - grey[xa])]
        slot_a, slot_b, slot_c = GAP + STRIDE * diagonal_a, GAP + STRIDE * diagonal_b, GAP + STRIDE * x
        value_a = _step(first, slot_a, shift_a, small, large_a, cost)
        value_b = _step(second, slot_b, shift_b, small, large_b, cost)
        value_c = _step(column, slot_c, shift_c, small, large_c, cost)
        if shift_d == 0:  # what was stored just now is slow to read shifted
            beside = u8.minimum(u8.shift_up(value_d), u8.shift_down(value_d))
            m = u8.minimum(u8.minimum(value_d, u8.splat(large_d)), u8.add(beside, small))
            value_d = u8.add(m, cost)
        else:
            value_d = _step(along, GAP, shift_d, small, large_d, cost)
        value_a = u8.subtract(value_a, u8.splat(u8.lowest(value_a)))
        value_b = u8.subtract(value_b, u8.splat(u8.lowest(value_b)))
        value_c = u8.subtract(value_c, u8.splat(u8.lowest(value_c)))
        value_d = u8.subtract(value_d, u8.splat(u8.lowest(value_d)))
        u8.store(first, slot_a, value_a)
        u8.store(second, slot_b, value_b)
        u8.store(column, slot_c, value_c)
        u8.store(along, GAP, value_d)
        u8.store(sums, LANES * x, u8.add(u8.mean(value_a, value_b), u8.mean(value_c, value_d)))
        x += step
        diagonal_a, diagonal_b = (diagonal_a + step) % width, (diagonal_b + step) % width


@numba.njit(cache=True, nogil=True)
def follow_down(views: Views, penalties: Penalties, first: Index, last: Index, paths: Bytes, rows: Rows) -> None:
    """Paths from above through the rows first to last - 1, which go on from where ``paths`` (4, GAP + STRIDE W) is."""
    ring = rows.costs.shape[0]
    if first == 0:
        clear(paths)
    for y in range(first, last):
        costs, sums = pointer(rows.costs[y % ring]), pointer(rows.above[y % ring])
        _follow_row(views, penalties, y, 1, y == 0, paths, costs, sums)


@numba.njit(cache=True, nogil=True)
def follow_up(views: Views, penalties: Penalties, first: Index, last: Index, paths: Bytes, rows: Rows) -> None:
    """Paths from below that begin in row last - 1 and end in row first; ``paths`` is scratch."""
    ring = rows.costs.shape[0]
    clear(paths)
    for y in range(last - 1, first - 1, -1):
        costs, sums = pointer(rows.costs[y % ring]), pointer(rows.below[y % ring])
        _follow_row(views, penalties, y, -1, y == last - 1, paths, costs, sums)


@numba.njit(cache=True, nogil=True)
def between_lanes(sums: Pointer, at: Index, best: np.int64) -> tuple[np.float32, np.int64]:
    """How far beside the best of costs the least is, by two lines of opposite slope (equiangular fit), and their second
    difference."""
    before, after = np.int64(sums[at - 1]), np.int64(sums[at + 1])
    shift, rise = np.float32(0.0), max(before, after) - best
    if rise > 0 and max(before, after) < 255:
        shift = np.float32(0.5) * np.float32(before - after) / np.float32(rise)
    return shift, before + after - 2 * best


@numba.njit(cache=True, nogil=True)
def decide(
    views: Views, tolerance: Index, first: Index, last: Index, rows: Rows, cost: Bytes, label: Ints, found: Found
) -> None:
    """Disparities of the rows first to last - 1, and whether the right picture finds the same but for a tolerance.

    Of disparities that lead into the right picture, as long as there are any: what leads out of it has the cost of a
    match that is neither good nor bad, and a steep surface, which the other view shows half as wide, matches no better.
    Those that lead out still are rivals, which make it less unique.

    Between whole pixels by two lines of opposite slope (equiangular fit). ``cost``, ``label``: scratch (W + 2 M,) of a
    row of the right picture, uint8 and int16.
    """
    base, width = views.base, views.left.shape[1]
    corner = (views.right.shape[1] - width) // 2 + width - 1
    ring = rows.costs.shape[0]
    right_cost, right_label = pointer(cost), pointer(label)
    for y in range(first, last):
        above, below = pointer(rows.above[y % ring]), pointer(rows.below[y % ring])
        for n in range(cost.shape[0]):
            right_cost[n], right_label[n] = np.uint8(255), np.int16(-32768)
        for x in range(width):
            value = u8.add(u8.load(above, LANES * x), u8.load(below, LANES * x))
            u8.store(above, LANES * x, value)
            seen, last_seen = value, x - np.int64(base[y, x])
            if last_seen >= 0 and (last_seen < LANES - 1 or last_seen >= width):
                seen = u8.within(value, last_seen - width + 1, last_seen + 1, u8.splat(np.uint8(255)))
            best = u8.lowest(seen)
            k = first_bit(u8.lanes_equal(seen, u8.splat(best)))
            found.best[y, x] = best
            found.elsewhere[y, x] = u8.lowest(u8.hide(value, k))
            found.bend[y, x] = np.int16(k)
            u8.keep_lower(value, base[y, x], right_cost, right_label, corner - x + base[y, x])
        for x in range(width):
            k = np.int64(found.bend[y, x])
            best, disparity = np.int64(found.best[y, x]), base[y, x] + k
            shift, bend = np.float32(0.0), np.int64(0)
            if k > 0 and k < LANES - 1:
                shift, bend = between_lanes(above, LANES * x + k, best)
            found.disparity[y, x] = np.float32(disparity) + shift
            found.bend[y, x] = np.int16(bend)
            place = x - disparity
            agrees = place >= 0 and place < width
            if agrees:
                agrees = abs(np.int64(right_label[corner - place]) - disparity) <= tolerance
            found.agrees[y, x] = np.uint8(agrees)


@numba.njit(cache=True, nogil=True)
def clear(rows: Bytes) -> None:
    """Fill with 255, the cost of what is not looked at."""
    flat = rows.reshape(-1)
    for n in range(flat.shape[0]):
        flat[n] = np.uint8(255)


@numba.njit(cache=True, nogil=True)
def noise_of(grey: Bytes, counts: NDArray[np.int64]) -> float:
    """Standard deviation of the noise of a picture, from the median of what is not linear in it (after Immerkaer,
    "Fast noise variance estimation", CVIU 1996), in every fourth row; ``counts``: scratch
    (NOISE_BINS,)."""
    height, width = grey.shape
    for n in range(counts.shape[0]):
        counts[n] = 0
    total = 0
    for y in range(1, height - 1, 4):
        a, b, c = grey[y - 1], grey[y], grey[y + 1]
        for x in range(1, width - 1):
            sides = np.int64(a[x - 1]) + a[x + 1] + c[x - 1] + c[x + 1] + 4 * np.int64(b[x])
            counts[abs(sides - 2 * (np.int64(a[x]) + b[x - 1] + b[x + 1] + c[x]))] += 1
            total += 1
    passed, value = 0, 0
    while value < counts.shape[0] - 1 and 2 * (passed + counts[value]) < total:
        passed += counts[value]
        value += 1
    # where in the bin the median is
    inside = (0.5 * total - passed) / max(counts[value], 1) - 0.5
    return float(max(value + inside, 0.0) / (6.0 * 0.6745))


@numba.njit(cache=True, nogil=True)
def _uniqueness(found: Found, y: Index, x: Index) -> float:
    """1 - best / elsewhere; 0 where all costs are zero, or what leads out of the right picture is cheaper."""
    best, elsewhere = np.float32(found.best[y, x]), np.float32(found.elsewhere[y, x])
    return float(max(elsewhere - best, np.float32(0.0)) / max(elsewhere, np.float32(1.0)))


@numba.njit(cache=True, nogil=True)
def look_again(
    coarse: Found, ends: Floats, least: float, texture: NDArray[np.uint16], plain: float, search: tuple[int, int],
    base: Ints, expected: Bytes,
) -> None:  # fmt: skip
    """Where a level looks, by what half the resolution found: ``base`` and ``expected`` (H, W) of :class:`Views`.

    ends: (2, h, w) least and greatest disparity in the neighbourhood of each pixel of half the resolution.

    A pixel looks about the disparities of its neighbourhood; where these are too far apart to be looked at all, at its
    own and at as many as can be of those on the nearer side. It expects its own where ``texture`` (H, W) uint16 is
    below ``plain``, both views agreed, and the uniqueness was not below ``least``.
    """
    height, width = base.shape
    rows, columns = coarse.disparity.shape
    first, count = search
    for v in range(rows):
        for u in range(columns):
            start = first
            if count > LANES:
                start = min(
                    max(_start_of_search(coarse.disparity[v, u], ends[0, v, u], ends[1, v, u]), first),
                    first + count - LANES,
                )
            lane = np.int64(np.rint(2 * coarse.disparity[v, u])) - start
            sure = coarse.agrees[v, u] > 0 and _uniqueness(coarse, v, u) >= least
            sure = sure and lane >= 0 and lane < LANES
            for y in range(2 * v, min(2 * v + 2, height)):
                for x in range(2 * u, min(2 * u + 2, width)):
                    base[y, x] = np.int16(start)
                    expected[y, x] = np.uint8(lane if sure and texture[y, x] < plain else LANES)


@numba.njit(cache=True, nogil=True)
def _start_of_search(disparity: float, least: float, greatest: float) -> int:
    """Least disparity to look at from those of half the resolution."""
    own, low, high = 2 * disparity, 2 * least, 2 * greatest
    if high - low <= LANES - 2 * ROOM:
        return int(np.rint((low + high) / 2)) - LANES // 2
    if own - low < high - own:
        return int(np.rint(max(low - ROOM, own + ROOM + 1 - LANES)))
    return int(np.rint(min(high + ROOM - LANES, own - ROOM)))


@numba.njit(cache=True, nogil=True)
def collect(
    found: Found, least: float, texture: NDArray[np.uint16], blank: float, search: tuple[int, int], out: Ints
) -> None:
    """Sixteenths of disparities (H, W) int16 that both views tell, whose uniqueness is not below ``least``, whose
    ``texture`` (H, W) is not below ``blank``, and which are among those asked for (the least, and how many); -32768 for
    others."""
    height, width = out.shape
    low, high = search[0] - 0.5, search[0] + search[1] - 0.5
    for y in range(height):
        for x in range(width):
            sure = found.agrees[y, x] > 0 and texture[y, x] >= blank and _uniqueness(found, y, x) >= least
            sure = sure and low <= found.disparity[y, x] <= high
            out[y, x] = np.int16(np.rint(16 * found.disparity[y, x])) if sure else np.int16(-32768)


@numba.njit(cache=True, nogil=True)
def _even_out(values: Pointer, width: Index, step: Index, first: Index, last: Index, out: Pointer) -> None:
    """A row of means of values and of pairs on opposite sides, one or two ``step`` away, in columns first to last - 1.

    A slanted plane stays as it is, as the mean of a pair is its value in the middle; a pair whose mean is more than
    SAME_SURFACE_PX off is of more than one surface, and does not count.
    """
    for x in range(first, last):
        own = values[x]
        total, weights = own, np.float32(1.0)
        for n in range(1, 3):
            before, behind = values[x - n * step], values[x + n * step]
            mean = np.float32(0.5) * (before + behind)
            off = (mean - own) / np.float32(SAME_SURFACE_PX)
            weight = np.float32(1.0) - off * off
            one = abs(behind - before) < np.float32(2.0 * n) and weight > np.float32(0.0)
            total += weight * mean if one else np.float32(0.0)
            weights += weight if one else np.float32(0.0)
        out[x] = total / weights


@numba.njit(cache=True, nogil=True)
def even_out(disparity: Floats, scratch: Floats) -> None:
    """Take the scatter out of (H, W) disparities, along rows and then down columns; NaN stays NaN.

    Pairs that are on opposite sides of a pixel and lie on its surface are averaged with it.
    """
    height, width = disparity.shape
    rows, between = pointer(disparity), pointer(scratch)
    for y in range(height):
        for x in range(width):
            scratch[y, x] = disparity[y, x]
        _even_out(offset(rows, y * width), width, 1, 2, width - 2, offset(between, y * width))
    for y in range(height):
        if y < 2 or y >= height - 2:
            for x in range(width):
                disparity[y, x] = scratch[y, x]
        else:
            _even_out(offset(between, y * width), width, width, 0, width, offset(rows, y * width))


@numba.njit(cache=True, nogil=True)
def report(found: Found, kept: Ints, disparity: Floats, state: Bytes, measures: Floats) -> None:
    """What a disparity map holds: ``kept`` (H, W) is -32768 where nothing is known; measures (3, H, W) cost, curvature
    and uniqueness."""
    height, width = kept.shape
    nan = np.float32(np.nan)
    for y in range(height):
        for x in range(width):
            known = kept[y, x] != -32768
            best = np.float32(found.best[y, x])
            disparity[y, x] = found.disparity[y, x] if known else nan
            state[y, x] = np.uint8(known)
            measures[0, y, x] = best if known else nan
            measures[1, y, x] = np.float32(found.bend[y, x]) if known else nan
            measures[2, y, x] = _uniqueness(found, y, x)
