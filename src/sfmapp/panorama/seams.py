"""Which photograph is shown where in a panorama: seams in the middle of overlaps, and around what moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.panorama.canvas import Canvas
from sfmapp.panorama.preview import Shown

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
Labels = NDArray[np.int16]
Mask = NDArray[np.bool_]

# Colours are compared in means over so many pixels, so that a hair's breadth of parallax is no motion.
_BLUR, _CLOSING = (5, 5), (9, 9)
# What differs by so many grey levels, and by so many times the usual difference, has moved.
_LEAST_DIFFERENCE, _UNUSUAL = 12.0, 4.0
# Seams keep away from what moved, as bands of low frequencies are blended over 32 pixels of the picture, of which the
# panorama in small has a half or less.
_AWAY = (17, 17)
# around a region, so that the seam that it gets is looked at on both sides
_MARGIN = 3
# pixels that are cut through: 150,000 with five photographs take 1.4 CPU seconds
_MOST_CUT = 150_000
# pixels of regions, times photographs, that are looked at together: 240 MB; what is larger, as leaves in the wind all
# round, keeps its seams in the middle of overlaps
_MOST_COMPARED = 20_000_000
# What one region is given changes what is best for its neighbours; of rendered scenes the second time changes the last.
_ROUNDS = 3


def find_seams(shown: Sequence[Shown], gains: Array, canvas: Canvas) -> Labels:
    """(H, W) which photograph is shown where, -1 for none, with no seam through what moved where that can be had.

    Each pixel is of the photograph whose borders are farthest away. Regions in which photographs differ are given, one
    by one, to that photograph, as far as it shows them, with which seams cost least: a seam costs what the two
    photographs that meet in it differ by there (Kwatra et al., "Graphcut textures", SIGGRAPH 2003), beyond what is
    usual. So what moved is there whole or not at all (Uyttendaele, Eden and Szeliski, "Eliminating ghosting and
    exposure artifacts in image mosaics", CVPR 2001), also where it reaches beyond the overlap. Regions that no
    photograph alone does for are cut where it costs least. Cuts through all of a panorama, as OpenCV's Stitcher makes
    them, take 2 to 18 CPU seconds where this takes 0.2 to 1.2.
    """
    label, limit, found = _start(shown, gains.astype(np.float32), canvas)
    regions = [region for region in found if region.mask.size * len(shown) <= _MOST_COMPARED]
    soft = [_Soft.of(each, gain) for each, gain in zip(shown, gains.astype(np.float32), strict=True)]
    for _ in range(_ROUNDS):
        changed = [_assign(label, soft, region, limit) for region in regions]
        if not any(changed):
            break
    num_cut = 0
    for region in sorted(regions, key=lambda region: region.mask.size):
        if num_cut < _MOST_CUT:
            num_cut += _cut(label, soft, region, limit)
    return label


@dataclass(frozen=True)
class _Soft:
    """A photograph in the small panorama, evened out and blurred; NaN where it shows nothing."""

    left: int
    top: int
    colors: Floats

    @classmethod
    def of(cls, each: Shown, gain: Floats) -> _Soft:
        import cv2

        colors = np.asarray(cv2.blur(each.colors * gain, _BLUR), np.float32)
        colors[~each.inside] = np.nan
        return cls(each.left, each.top, colors)

    def at(self, rows: Ints, columns: Ints) -> Floats | None:
        """(h, w, 3) of a part of the canvas; None where the photograph shows nothing of it."""
        height, width = self.colors.shape[:2]
        y, x = rows - self.top, columns - self.left
        in_y, in_x = (y >= 0) & (y < height), (x >= 0) & (x < width)
        if not (in_y.any() and in_x.any()):
            return None
        out = np.full((len(rows), len(columns), 3), np.nan, np.float32)
        out[np.ix_(in_y, in_x)] = self.colors[np.ix_(y[in_y], x[in_x])]
        return out if np.isfinite(out).any() else None


@dataclass(frozen=True)
class _Region:
    """Where photographs differ, with a margin.

    Attributes:
        rows: (h,). columns: (w,), which go on at the left where a closed panorama ends at the right.
        mask: (h, w).
    """

    rows: Ints
    columns: Ints
    mask: Mask


def _start(shown: Sequence[Shown], factors: Floats, canvas: Canvas) -> tuple[Labels, float, list[_Region]]:
    """Seams in the middle of overlaps, what colours may differ by, and where they differ by more."""
    import cv2

    label = np.full((canvas.height, canvas.width), -1, np.int16)
    best = np.zeros(label.shape, np.float32)
    colors = np.zeros((*label.shape, 3), np.float32)
    for k, each in enumerate(shown):
        at = _place(each)
        is_better = each.inside & (each.depth + 1e-6 > best[at])
        label[at][is_better], best[at][is_better] = k, each.depth[is_better] + 1e-6
        colors[at][is_better] = each.colors[is_better] * factors[k]
    difference = np.zeros(label.shape, np.float32)
    for each, factor in zip(shown, factors, strict=True):
        at, mine = _place(each), each.colors * factor
        apart = np.abs(cv2.blur(mine, _BLUR) - cv2.blur(colors[at], _BLUR)).max(2)
        # the blur reaches beyond the borders of a photograph
        inner = cv2.erode(each.inside.astype(np.uint8), np.ones(_BLUR, np.uint8), borderValue=0) > 0
        np.maximum(difference[at], np.where(inner, apart, 0.0), out=difference[at])
    seen = difference[label >= 0]
    limit = _LEAST_DIFFERENCE + _UNUSUAL * (float(np.median(seen)) if len(seen) else 0.0)
    moved = (difference > limit).astype(np.uint8)
    # of a closed panorama twice, side by side, so that what is cut by its end is whole once
    moved = np.concatenate([moved, moved], 1) if canvas.is_closed else moved
    moved = cv2.morphologyEx(moved, cv2.MORPH_CLOSE, np.ones(_CLOSING, np.uint8))
    moved = cv2.dilate(moved, np.ones(_AWAY, np.uint8))
    return label, limit, _regions(moved, canvas)


def _regions(moved: NDArray[np.uint8], canvas: Canvas) -> list[_Region]:
    """Each connected region, once."""
    import cv2

    count, region, stats, _ = cv2.connectedComponentsWithStats(moved, connectivity=8)
    out, wide = [], canvas.width
    # what begins in the first copy, but for the right parts of what goes across the end
    across = set(np.unique(region[:, wide - 1]).tolist()) if canvas.is_closed else set()
    for n in range(1, count):
        left, top, width, height = stats[n, :4].tolist()
        if left >= wide:
            continue
        if canvas.is_closed and left == 0:
            y, x = np.nonzero(region[:, :wide] == n)
            if region[y[0], x[0] + wide] in across:
                continue
        rows = np.arange(max(0, top - _MARGIN), min(canvas.height, top + height + _MARGIN))
        columns = np.arange(left - _MARGIN, left + min(width, wide) + _MARGIN)
        if canvas.is_closed:
            columns = columns[:wide]
        else:
            columns = columns[(columns >= 0) & (columns < wide)]
        mask = region[np.ix_(rows, columns % region.shape[1])] == n
        out.append(_Region(rows, columns % wide, mask))
    return out


@dataclass(frozen=True)
class _Part:
    """A part of the canvas and the photographs that show some of it.

    Attributes:
        numbers: (K,) of the photographs. colors: (K, h, w, 3) NaN where one shows nothing.
        own: (h, w) positions in ``numbers``, -1 for none.
    """

    numbers: Ints
    colors: Floats
    own: Ints

    @classmethod
    def of(cls, label: Labels, soft: Sequence[_Soft], region: _Region) -> _Part:
        parts = [(k, part) for k, each in enumerate(soft) if (part := each.at(region.rows, region.columns)) is not None]
        numbers = np.array([k for k, _ in parts])
        position = np.full(len(soft) + 1, -1)
        position[numbers] = np.arange(len(numbers))
        own = position[label[np.ix_(region.rows, region.columns)]]
        return cls(numbers, np.array([part for _, part in parts]), own)

    def put(self, label: Labels, region: _Region, found: Ints) -> None:
        """Write positions into the labels of the canvas."""
        label[np.ix_(region.rows, region.columns)] = np.where(self.own >= 0, self.numbers[found], -1)


def _assign(label: Labels, soft: Sequence[_Soft], region: _Region, limit: float) -> bool:
    """Give a region to the photograph with which the seams in and around it cost least; whether that changed any."""
    if len(np.unique(label[np.ix_(region.rows, region.columns)])) < 2:
        return False
    part = _Part.of(label, soft, region)
    least, best = _seam_cost(part.own, part.colors, limit), part.own
    for k in range(len(part.numbers)):
        if least == 0.0:
            break
        tried = np.where(region.mask & np.isfinite(part.colors[k, :, :, 0]), k, part.own)
        cost = _seam_cost(tried, part.colors, limit)
        if cost < least:
            least, best = cost, tried
    if best is part.own:
        return False
    part.put(label, region, best)
    return True


def _cut(label: Labels, soft: Sequence[_Soft], region: _Region, limit: float) -> int:
    """Cut through a region where no photograph alone does, if that costs less; its number of pixels, 0 if nothing was
    to do. What is near its borders keeps its photograph."""
    import cv2

    if region.mask.size > _MOST_CUT or len(np.unique(label[np.ix_(region.rows, region.columns)])) < 2:
        return 0
    part = _Part.of(label, soft, region)
    before = _seam_cost(part.own, part.colors, limit)
    if before == 0.0:
        return 0
    is_edge = np.ones(part.own.shape, bool)
    is_edge[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN] = False
    used = [k for k in range(len(part.numbers)) if (part.own == k).any()]
    masks = [np.isfinite(part.colors[k, :, :, 0]) & (~is_edge | (part.own == k)) for k in used]
    found = cv2.detail_GraphCutSeamFinder("COST_COLOR").find(
        [cv2.UMat(np.nan_to_num(part.colors[k])) for k in used], [(0, 0)] * len(used),
        [cv2.UMat(mask.astype(np.uint8) * 255) for mask in masks],
    )  # fmt: skip
    tried = part.own.copy()
    for k, mask in zip(used, found, strict=True):
        tried[(np.asarray(mask.get()) > 0) & (part.own >= 0)] = k
    if _seam_cost(tried, part.colors, limit) < before:
        part.put(label, region, tried)
    return int(region.mask.size)


def _seam_cost(label: Ints, colors: Floats, limit: float) -> float:
    """What photographs (K, h, w, 3) differ by along the seams between their labels (h, w), beyond a limit."""
    total = 0.0
    for shift in ((1, 0), (0, 1)):
        a, b = label[: label.shape[0] - shift[0], : label.shape[1] - shift[1]], label[shift[0] :, shift[1] :]
        y, x = np.nonzero((a != b) & (a >= 0) & (b >= 0))
        if not len(y):
            continue
        i, j, there = a[y, x], b[y, x], (y + shift[0], x + shift[1])
        here = [np.abs(colors[i, *place] - colors[j, *place]).max(1) for place in ((y, x), there)]
        # one of them shows both sides, or each its own alone
        apart = np.fmax(*here)
        alone = np.isnan(apart)
        apart[alone] = np.abs(colors[i, y, x] - colors[j, *there]).max(1)[alone]
        total += float(np.maximum(np.nan_to_num(apart) - limit, 0.0).sum())
    return total


def _place(each: Shown) -> tuple[slice, slice]:
    height, width = each.inside.shape
    return slice(each.top, each.top + height), slice(each.left, each.left + width)
