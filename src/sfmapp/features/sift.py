"""SIFT (Lowe, IJCV 2004) with RootSIFT descriptors (Arandjelovic and Zisserman, CVPR 2012).

What differs from the textbook, each measured against true cameras on six scenes:

* The image is doubled by interpolating half way between its pixels, so that all new pixels are equally smooth; on the
  old grid every second one is sharper, which pulls the keypoints towards it.
* The first level gets the whole blur of ``SIGMA``, as if the lens had none. The finest blobs, the best located of all,
  then peak inside the scale space instead of in front of it.
* The strongest keypoints are kept, not the largest, and a second orientation only where there is room.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from sfmapp.features import scale_space
from sfmapp.features.descriptor import describe_all, orient_all
from sfmapp.features.octaves import UPSAMPLING, Octave, Scratch, Window
from sfmapp.features.scale_space import NUM_LAYERS, SIGMA

# candidates per octave that are refined, in budgets: about half of them turn out to lie on edges
_REFINED_BUDGETS = 2
# share of the budget that is dealt out evenly over a grid of cells, so that no busy patch takes it all
_SPREAD_SHARE = 0.75
_SPREAD_CELLS = 8
# images whose grey levels span less than this get a proportionally lower threshold ...
_FULL_SPAN = 128.0
# ... but not below six standard deviations of what the rounding of the pixels leaves in the finest differences
_ROUNDING_FLOOR = 0.2


def extract_sift(
    gray: NDArray[np.uint8],
    usable: NDArray[np.bool_] | None,
    *,
    max_num_features: int,
    max_num_orientations: int,
    contrast_threshold: float,
    edge_threshold: float,
    scratch: Scratch | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.bool_], float]:
    """Detect and describe.

    Args:
        gray: (H, W) uint8.
        usable: (H, W) bool, False where nothing may be detected; None for everywhere.
        max_num_features: the strongest so many are kept, with some regard to their spread over the image.
        max_num_orientations: descriptors at one place, at most; seconds only where the budget has room.
        contrast_threshold: least difference of Gaussians, for grey levels in [0, 1]; lowered for flat images.
        edge_threshold: largest ratio of the principal curvatures.
        scratch: memory that the next image in this thread can use again; None: taken anew.

    Returns:
        (N, 4) float32 x, y in COLMAP's pixels, scale in pixels, orientation in radians from x towards y (which points
        down), largest scale first; (N, 128) uint8 descriptors as COLMAP stores them; (N,) whether each is darker than
        what lies around it; the contrast threshold in use.
    """
    threshold = _threshold(gray, contrast_threshold)
    octaves, places = _detect(gray, threshold, edge_threshold, max_num_features, scratch or Scratch())
    found = np.concatenate([*places, np.zeros((0, 5))])
    xy = np.concatenate([octave.xy(place) for octave, place in zip(octaves, places, strict=True)] + [np.zeros((0, 2))])
    chosen = np.sort(_choose(xy, found[:, 3], gray.shape, usable, max_num_features))
    octave_idx = np.repeat(np.arange(len(octaves)), [len(place) for place in places])[chosen]
    found, xy = found[chosen], xy[chosen]
    # seconds have room only if the budget is not full, or where one has no orientation at all
    for num in (1, max_num_orientations) if len(found) == max_num_features else (max_num_orientations,):
        angles, vectors = _describe(octaves, octave_idx, found, max_num_orientations, num)
        if num == max_num_orientations or not np.isnan(angles[:, 0]).any():
            break
    rank, place = np.nonzero(~np.isnan(angles.T))
    order = np.lexsort((place, -found[place, 3], rank))[:max_num_features]
    rank, place = rank[order], place[order]
    angle, vector = angles[place, rank], vectors[place, rank]
    scale = SIGMA * 2.0 ** (found[place, 2] / NUM_LAYERS)
    scale *= np.array([octave.step for octave in octaves])[octave_idx[place]] if len(place) else 1.0
    order = np.lexsort((angle, xy[place, 1], xy[place, 0], -scale))
    keypoints = np.column_stack([xy[place], scale, angle])[order].astype(np.float32)
    return keypoints, vector[order], found[place[order], 4] > 0.0, threshold


def _threshold(gray: NDArray[np.uint8], contrast_threshold: float) -> float:
    """The contrast threshold, lowered in proportion for images with a small span of grey levels."""
    import cv2

    share = np.cumsum(cv2.calcHist([gray], [0], None, [256], [0.0, 256.0]), dtype=np.float64) / gray.size
    span = float(np.searchsorted(share, 0.995) - np.searchsorted(share, 0.005))
    return max(contrast_threshold * min(1.0, span / _FULL_SPAN), min(contrast_threshold, _ROUNDING_FLOOR / 255.0))


def _detect(
    gray: NDArray[np.uint8], threshold: float, edge_threshold: float, max_num_features: int, scratch: Scratch
) -> tuple[list[Octave], list[NDArray[np.float64]]]:
    """The octaves of the scale space, finest first, and the keypoints of each."""
    octaves: list[Octave] = []
    places: list[NDArray[np.float64]] = []
    scratch.begin()
    octave = Octave(gray, 1.0 / UPSAMPLING, scratch)
    while min(octave.shape) > 2 * scale_space.BORDER + 2:
        coarser = octave.coarser()
        found = _find(octave, coarser, 255.0 * threshold, edge_threshold, _REFINED_BUDGETS * max_num_features)
        octaves.append(octave)
        places.append(found)
        octave = coarser
    return octaves, places


def _find(
    octave: Octave, coarser: Octave, threshold: float, edge_threshold: float, max_refined: int
) -> NDArray[np.float64]:
    """(N, 5) keypoints of an octave from top to bottom: column, row, layer, contrast (threshold, too: grey levels), and
    1 for dark ones, -1 for bright ones; fills level 0 of the next one."""
    strongest, cut = np.zeros(0, np.float32), np.float32(0.0)
    found, place, value = [np.zeros((0, 5))], [np.zeros((0, 4), np.int32)], [np.zeros(0, np.float32)]
    # the parabola raises the contrast above that of the pixel, so those a little below get their chance
    for window, its_place, its_value in _search(octave, coarser, 0.8 * threshold):
        strongest = np.concatenate([strongest, its_value])
        if len(strongest) > max_refined:
            strongest = -np.partition(-strongest, max_refined - 1)[:max_refined]
            cut = strongest.min()
        # what is too weak already will be so in the end
        place.append(its_place[its_value >= cut])
        value.append(its_value[its_value >= cut])
        found.append(np.empty((len(place[-1]), 5)))
        scale_space.refine_all(window.levels, window.origin, octave.shape, place[-1], edge_threshold, found[-1])
    is_strong = np.concatenate(value) >= cut
    places, keypoints = np.concatenate(place)[is_strong], np.concatenate(found)[is_strong]
    for n in np.flatnonzero(places[:, 3]):
        while places[n, 3]:
            window = octave.look_up(*places[n, 1:3])
            one = places[n : n + 1], edge_threshold, keypoints[n : n + 1]
            scale_space.refine_all(window.levels, window.origin, octave.shape, *one)
    keypoints = keypoints[keypoints[:, 3] >= threshold]
    keypoints = keypoints[np.lexsort((keypoints[:, 2], keypoints[:, 0], keypoints[:, 1]))]
    # two neighbours may have moved to the same place
    is_new = np.ones(len(keypoints), bool)
    is_new[1:] = np.any(keypoints[1:] != keypoints[:-1], axis=1)
    return keypoints[is_new]


def _search(
    octave: Octave, coarser: Octave, start: float
) -> Iterator[tuple[Window, NDArray[np.int32], NDArray[np.float32]]]:
    """Extrema (N, 4) and (N,) of an octave with a window that has them: all at once if it is whole."""
    rows = np.zeros((scale_space.NUM_ROWS_AT_WORK, scale_space.PITCH), np.float32)
    marks = np.empty(scale_space.PITCH, np.int64)
    found = []
    for window in octave.windows_to_search():
        octave.hand_down(window, coarser)
        found.append(_extrema(window, octave.shape[0], start, rows, marks))
        if not octave.is_whole:
            yield window, *found.pop()
    if octave.is_whole:
        yield window, np.concatenate([place for place, _ in found]), np.concatenate([value for _, value in found])


def _extrema(
    window: Window, height: int, start: float, rows: NDArray[np.float32], marks: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Extrema of the rows that are a window's own: (N, 4) layer, row, column, rounds of refinement, and (N,) values."""
    first, last = max(window.rows[0], scale_space.BORDER), min(window.rows[1], height - scale_space.BORDER)
    capacity = max(256, (last - first) * window.levels[0].shape[1] // 64)
    while True:
        place, value = np.empty((capacity, 4), np.int32), np.empty(capacity, np.float32)
        span = window.origin[0], first, last
        count = scale_space.find_extrema(window.levels, span, start, rows, marks, place, value)
        if count <= capacity:
            return place[:count], value[:count]
        capacity = count


def _choose(
    xy: NDArray[np.float64],
    contrast: NDArray[np.float64],
    shape: tuple[int, ...],
    usable: NDArray[np.bool_] | None,
    max_num: int,
) -> NDArray[np.int64]:
    """Positions of the keypoints to keep: the strongest of every cell of a grid first, then the strongest anywhere."""
    height, width = shape
    keep = np.arange(len(xy))
    if usable is not None:
        column = np.clip(xy[:, 0].astype(np.int64), 0, width - 1)
        row = np.clip(xy[:, 1].astype(np.int64), 0, height - 1)
        keep = keep[usable[row, column]]
    if len(keep) <= max_num:
        return keep
    grid = np.clip((xy[keep] * (_SPREAD_CELLS / max(height, width))).astype(np.int64), 0, _SPREAD_CELLS - 1)
    cell = grid[:, 1] * _SPREAD_CELLS + grid[:, 0]
    order = np.lexsort((keep, -contrast[keep], cell))
    _, starts, counts = np.unique(cell[order], return_index=True, return_counts=True)
    rank = np.empty(len(keep), np.int64)
    rank[order] = np.arange(len(keep)) - np.repeat(starts, counts)
    quota = int(_SPREAD_SHARE * max_num / len(starts))
    return keep[np.lexsort((keep, -contrast[keep], rank >= quota))[:max_num]]


def _describe(
    octaves: list[Octave], octave_idx: NDArray[np.int64], found: NDArray[np.float64], max_num: int, num_described: int
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Orientations (N, max_num), strongest first, NaN where there are fewer, and descriptors (N, max_num, 128) of so
    many of them."""
    angles = np.empty((len(found), max_num))
    descriptors = np.empty((len(found), max_num, 128), np.uint8)
    row = np.floor(found[:, 1])
    for i, octave in enumerate(octaves):
        for window in octave.windows_to_describe():
            mine = np.flatnonzero((octave_idx == i) & (row >= window.rows[0]) & (row < window.rows[1]))
            its_angles, top = np.empty((len(mine), max_num)), window.origin[0]
            orient_all(window.levels, top, found[mine], max_num, its_angles)
            angles[mine] = its_angles
            # from top to bottom, so that neighbours find each other's pixels in the cache
            place, rank = np.nonzero(~np.isnan(its_angles[:, :num_described]))
            out = np.empty((len(place), 128), np.uint8)
            describe_all(window.levels, top, found[mine[place]], its_angles[place, rank], out)
            descriptors[mine[place], rank] = out
    return angles, descriptors


def compile_kernels() -> None:
    """Run every kernel once on a tiny image, so that numba compiles or loads them now."""
    gray = np.zeros((40, 40), np.uint8)
    gray[16:24, 16:24] = 255
    extract_sift(gray, None, max_num_features=10, max_num_orientations=2, contrast_threshold=0.001, edge_threshold=10.0)
