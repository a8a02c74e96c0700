"""SIFT (Lowe, IJCV 2004) with RootSIFT descriptors (Arandjelovic and Zisserman, CVPR 2012).

What differs from the textbook, each measured against true cameras on six scenes:

* The image is doubled by interpolating half way between its pixels, so that all new pixels are equally smooth; on the
  old grid every second one is sharper, which pulls the keypoints towards it.
* The first level gets the whole blur of ``SIGMA``, as if the lens had none. The finest blobs, the best located of all,
  then peak inside the scale space instead of in front of it.
* The strongest keypoints are kept, not the largest, and a second orientation only where there is room.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.features import scale_space
from sfmapp.features.descriptor import describe_all, orient_all
from sfmapp.features.scale_space import NUM_LAYERS, NUM_LEVELS, SIGMA

# pixels of the first octave in one pixel of the image
_UPSAMPLING = 2
# the Gaussians are cut off here
_TRUNCATION_SIGMAS = 3.0
# candidates per octave that are refined, in budgets: about half of them turn out to lie on edges
_REFINED_BUDGETS = 2
# share of the budget that is dealt out evenly over a grid of cells, so that no busy patch takes it all
_SPREAD_SHARE = 0.75
_SPREAD_CELLS = 8
# images whose grey levels span less than this get a proportionally lower threshold ...
_FULL_SPAN = 128.0
# ... but not below six standard deviations of what the rounding of the pixels leaves in the finest differences
_ROUNDING_FLOOR = 0.2

FloatImage = NDArray[np.float32]


class Scratch:
    """Memory for the scale space of one image at a time: taking 150 MB a megapixel and a half anew for every image
    costs as much time as its descriptors.

    Levels 1 to 3 of the first octave come first, as they are needed to the end. Its other three take as much memory as
    one and a half times all coarser octaves together, which move in once its extrema are found.
    """

    def __init__(self) -> None:
        self._memory = np.empty(0, np.float32)
        self._end = 0

    def first_octave(self, shape: tuple[int, int]) -> tuple[FloatImage, ...]:
        """Six levels (H, W) float32 for a new image; what was handed out before is overwritten."""
        size = shape[0] * shape[1]
        if len(self._memory) < NUM_LEVELS * size:
            self._memory = np.empty(0, np.float32)
            self._memory = np.empty(NUM_LEVELS * size, np.float32)
        self._end = 3 * size
        images = self._memory[: NUM_LEVELS * size].reshape(NUM_LEVELS, *shape)
        return tuple(images[i] for i in (3, 0, 1, 2, 4, 5))

    def next_octave(self, shape: tuple[int, int]) -> tuple[FloatImage, ...]:
        """Six levels (H, W) float32, half as large as those before; levels 0, 4 and 5 of the first are overwritten."""
        start, self._end = self._end, self._end + NUM_LEVELS * shape[0] * shape[1]
        return tuple(self._memory[start : self._end].reshape(NUM_LEVELS, *shape))


@dataclass(frozen=True)
class _Octave:
    """Levels 1 to 3 of an octave, and its keypoints (N, 4) float64: column, row, layer, contrast."""

    levels: tuple[FloatImage, ...]
    found: NDArray[np.float64]
    # pixels of the image in one pixel of the octave
    step: float

    def xy(self) -> NDArray[np.float64]:
        """(N, 2) COLMAP's pixels. The corner of the first pixel is the origin at every resolution up to the doubled
        one; from there on every second pixel is dropped, which keeps the centre of the first."""
        return self.found[:, :2] * self.step + 0.5 / _UPSAMPLING


def extract_sift(
    gray: NDArray[np.uint8],
    usable: NDArray[np.bool_] | None,
    *,
    max_num_features: int,
    max_num_orientations: int,
    contrast_threshold: float,
    edge_threshold: float,
    scratch: Scratch | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.uint8], float]:
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
        down), largest scale first; (N, 128) uint8 descriptors as COLMAP stores them; the contrast threshold in use.
    """
    threshold = _threshold(gray, contrast_threshold)
    octaves = _detect(gray, threshold, edge_threshold, max_num_features, scratch or Scratch())
    found = np.concatenate([octave.found for octave in octaves] or [np.zeros((0, 4))])
    xy = np.concatenate([octave.xy() for octave in octaves] or [np.zeros((0, 2))])
    octave_idx = np.repeat(np.arange(len(octaves)), [len(octave.found) for octave in octaves])
    chosen = np.sort(_choose(xy, found[:, 3], gray.shape, usable, max_num_features))
    angles = np.empty((len(chosen), max_num_orientations))
    for i, octave in enumerate(octaves):
        mine = octave_idx[chosen] == i
        angles[mine] = _orient(octave, found[chosen[mine]], max_num_orientations)
    rank, place = np.nonzero(~np.isnan(angles.T))
    order = np.lexsort((place, -found[chosen[place], 3], rank))[:max_num_features]
    rank, place = rank[order], place[order]
    angle, place = angles[place, rank], chosen[place]
    scale = SIGMA * 2.0 ** (found[place, 2] / NUM_LAYERS)
    scale *= np.array([octave.step for octave in octaves])[octave_idx[place]] if len(place) else 1.0
    order = np.lexsort((angle, xy[place, 1], xy[place, 0], -scale))
    angle, place, scale = angle[order], place[order], scale[order]
    descriptors = np.empty((len(place), 128), np.uint8)
    for i, octave in enumerate(octaves):
        # from top to bottom, so that neighbours find each other's pixels in the cache
        mine = np.flatnonzero(octave_idx[place] == i)
        mine = mine[np.argsort(place[mine], kind="stable")]
        out = np.empty((len(mine), 128), np.uint8)
        describe_all(octave.levels, found[place[mine]], angle[mine], out)
        descriptors[mine] = out
    return np.column_stack([xy[place], scale, angle]).astype(np.float32), descriptors, threshold


def _threshold(gray: NDArray[np.uint8], contrast_threshold: float) -> float:
    """The contrast threshold, lowered in proportion for images with a small span of grey levels."""
    share = np.cumsum(np.bincount(gray.ravel(), minlength=256)) / gray.size
    span = float(np.searchsorted(share, 0.995) - np.searchsorted(share, 0.005))
    return max(contrast_threshold * min(1.0, span / _FULL_SPAN), min(contrast_threshold, _ROUNDING_FLOOR / 255.0))


def _detect(
    gray: NDArray[np.uint8], threshold: float, edge_threshold: float, max_num_features: int, scratch: Scratch
) -> list[_Octave]:
    """The octaves of the scale space with their keypoints, finest first."""
    import cv2

    octaves: list[_Octave] = []
    shape = (_UPSAMPLING * gray.shape[0], _UPSAMPLING * gray.shape[1])
    levels = scratch.first_octave(shape)
    while min(shape) > 2 * scale_space.BORDER + 2:
        if octaves:
            levels[0][:] = octaves[-1].levels[-1][::2, ::2]
        else:
            cv2.resize(gray.astype(np.float32), shape[::-1], dst=levels[1], interpolation=cv2.INTER_LINEAR)
            _blur(levels[1], SIGMA, levels[0])
        for i in range(1, NUM_LEVELS):
            before = SIGMA * 2.0 ** ((i - 1) / NUM_LAYERS)
            _blur(levels[i - 1], before * math.sqrt(2.0 ** (2.0 / NUM_LAYERS) - 1.0), levels[i])
        found = _find(levels, 255.0 * threshold, edge_threshold, _REFINED_BUDGETS * max_num_features)
        octaves.append(_Octave(levels[1:4], found, 2.0 ** len(octaves) / _UPSAMPLING))
        shape = ((shape[0] + 1) // 2, (shape[1] + 1) // 2)
        levels = scratch.next_octave(shape)
    return octaves


def _blur(image: FloatImage, sigma: float, target: FloatImage) -> None:
    # the kernel takes the pairs of taps beyond the fourth two at a time
    reach = 2 * math.ceil(_TRUNCATION_SIGMAS * sigma / 2.0)
    taps = np.exp(-0.5 * (np.arange(reach + 1) / sigma) ** 2)
    taps /= taps[0] + 2.0 * taps[1:].sum()
    line = np.empty(image.shape[1] + 2 * len(taps), np.float32)
    scale_space.blur(image, taps.astype(np.float32), line, target)


def _find(
    levels: tuple[FloatImage, ...], threshold: float, edge_threshold: float, max_refined: int
) -> NDArray[np.float64]:
    """(N, 4) keypoints of an octave from top to bottom: column, row, layer, contrast (threshold, too: grey levels)."""
    rows, flags = np.empty((11, 3, scale_space.TILE + 2), np.float32), np.empty(scale_space.TILE, np.uint8)
    # the parabola raises the contrast above that of the pixel, so those a little below get their chance
    start = 0.8 * threshold
    capacity = max(256, levels[0].size // 64)
    while True:
        place, value = np.empty((capacity, 3), np.int32), np.empty(capacity, np.float32)
        count = scale_space.find_extrema(levels, start, rows, flags, place, value)
        if count <= capacity:
            break
        capacity = count
    place, value = place[:count], value[:count]
    if count > max_refined:
        place = place[value >= -np.partition(-value, max_refined - 1)[max_refined - 1]]
    found = np.empty((len(place), 4))
    scale_space.refine_all(levels, np.ascontiguousarray(place), edge_threshold, found)
    found = found[found[:, 3] >= threshold]
    found = found[np.lexsort((found[:, 2], found[:, 0], found[:, 1]))]
    # two neighbours may have moved to the same place
    is_new = np.ones(len(found), bool)
    is_new[1:] = np.any(found[1:] != found[:-1], axis=1)
    return found[is_new]


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


def _orient(octave: _Octave, found: NDArray[np.float64], max_num: int) -> NDArray[np.float64]:
    angles = np.empty((len(found), max_num))
    orient_all(octave.levels, found, max_num, angles)
    return angles


def compile_kernels() -> None:
    """Run every kernel once on a tiny image, so that numba compiles or loads them now."""
    gray = np.zeros((40, 40), np.uint8)
    gray[16:24, 16:24] = 255
    extract_sift(gray, None, max_num_features=10, max_num_orientations=2, contrast_threshold=0.001, edge_threshold=10.0)
