"""From what a sweep found to a slanted plane through every pixel, by rounds of :mod:`sfmapp.carve.slanted_kernels`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.slanted_kernels import improve_rows, slopes_of, take_told_rows
from sfmapp.dense.arrays import Images
from sfmapp.dense.pyramid import Frame, make_images
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.dense.window import DX, DY, FALL_OFF, NUM_PIXELS, make_scratch
from sfmapp.geometry import rigid3
from sfmapp.images.pixels import as_gray

Map = NDArray[np.float32]

# the fourth changes a fifth of a point of what is right within 1 %
ROUNDS = 3
# deviation of a window's weights, pixels: of dense patches it is 1.3, as those have neighbours to settle with
SPREAD_PX = 2.0
# beyond, planes that are carried on are right less often than what was found there
CARRIED_PX = 2.0
# planes scatter less than that between the pixels that slopes are taken from
_MEDIAN_PX = 5


def slanted_planes(
    reference: DenseView, others: Sequence[DenseView], first: float, step: float, plane: Map, sure: Map,
    pool: Executor | None,
) -> tuple[Map, Map, Map]:  # fmt: skip
    """Planes (H, W), with fractions, their slopes (H, W, 2) per pixel, and the mean NCC (H, W) of the photographs that
    fit them best, -2 where nothing was measured.

    Args:
        reference, others: the view and those it was swept with.
        first, step: inverse depth of plane 0 and from one to the next, per unit of the world.
        plane: (H, W) what the sweep found, NaN outside of the mask.
        sure: (H, W) the same where it is sure, NaN elsewhere.
        pool: does two things at a time; bytes do not depend on it.
    """
    height, width = plane.shape
    images, unit = _images(reference, others, first, step, plane)
    planes = np.empty((height, width, 3), np.float32)
    slopes_of(cv2.medianBlur(np.nan_to_num(plane), _MEDIAN_PX), planes[..., 1:])
    planes[..., 1:] *= np.float32(step * unit)
    planes[..., 0] = (first + step * plane) * unit
    planes[planes[..., 0] <= 0.0] = np.nan
    held = ((first + step * sure) * unit).astype(np.float32)
    score = np.where(np.isfinite(planes[..., 0]), np.float32(0.0), np.float32(-2.0))
    for _ in range(ROUNDS):
        planes, score = _round(images, planes, score, held, step * unit, pool)
    found = (planes[..., 0] / np.float32(unit) - np.float32(first)) / np.float32(step)
    slopes = planes[..., 1:] / np.float32(step * unit)
    # a score of exactly zero is that of the start
    return found.astype(np.float32), slopes, np.where(score == 0.0, np.float32(-2.0), score)


def better_told(
    reference: DenseView, others: Sequence[DenseView], first: float, step: float, plane: Map, slopes: Map,
    told: tuple[Map, Map], pool: Executor | None,
) -> tuple[Map, Map, Map]:  # fmt: skip
    """As :func:`slanted_planes`, of planes and slopes that are there already and those that other maps tell.

    Args:
        told: inverse depths (K, H, W) and their slopes (K, H, W, 2) per pixel, per unit of the world; NaN where a map
            tells nothing.
    """
    images, unit = _images(reference, others, first, step, plane)
    start: Map = np.concatenate([(first + step * plane)[..., None], step * slopes], axis=-1).astype(np.float32)
    start *= np.float32(unit)
    hints = np.concatenate([told[0][..., None], told[1]], axis=-1)
    hints *= np.float32(unit)
    planes, score = np.empty_like(start), np.empty_like(plane)

    def work(rows: tuple[int, int]) -> None:
        take_told_rows(images, start, hints, step * unit, rows, _scratch(), planes, score)

    _in_halves(work, len(plane), pool)
    found = (planes[..., 0] / np.float32(unit) - np.float32(first)) / np.float32(step)
    slopes = (planes[..., 1:] / np.float32(step * unit)).astype(np.float32)
    return found.astype(np.float32), slopes, score


def _images(
    reference: DenseView, others: Sequence[DenseView], first: float, step: float, plane: Map
) -> tuple[Images, float]:
    """The views for kernels, the reference first, and what inverse depths are multiplied with there."""
    # units in which inverse depths are about one, for single precision
    unit = 1.0 / max(float(first + step * np.nanmedian(plane)), step)
    star = DenseScene(
        (reference, *others), np.full((1 + len(others), len(others)), -1, np.int32), np.zeros((0, 3)),
        np.zeros(1, np.int64), np.zeros(0, np.int32),
    )  # fmt: skip
    star.neighbors[0] = np.arange(1, 1 + len(others))
    frame = Frame(rigid3.center(reference.cam_from_world), 1.0 / unit)
    return make_images(star, [as_gray(view.rgb) for view in star.views], frame, 1), unit


def carried_on(plane: Map, slopes: Map, believed: NDArray[np.bool_]) -> tuple[Map, Map]:
    """Planes (H, W) and slopes (H, W, 2) where they are believed, and within CARRIED_PX of that those of the nearest
    believed pixel, carried on by its slopes; NaN elsewhere, and where there was none.

    What stands alone there is right less often: on four photographs of a courtyard 49 per cent of it are within 1 % of
    patches of other photographs, and 60 per cent of what is carried on.
    """
    if not believed.any():
        return np.full_like(plane, np.nan), np.full_like(slopes, np.nan)
    away, label = cv2.distanceTransformWithLabels(
        (~believed).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    y, x = np.nonzero((away > 0.0) & (away <= CARRIED_PX) & np.isfinite(plane))
    place = np.zeros(int(label.max()) + 1, np.int64)
    place[label[believed]] = np.flatnonzero(believed)
    from_y, from_x = np.divmod(place[label[y, x]], plane.shape[1])
    lean = slopes[from_y, from_x]
    out = np.where(believed, plane, np.float32(np.nan))
    out[y, x] = plane[from_y, from_x] + lean[:, 0] * (x - from_x) + lean[:, 1] * (y - from_y)
    leans = np.where(believed[..., None], slopes, np.float32(np.nan))
    leans[y, x] = lean
    return out, leans


def _round(images: Images, planes: Map, score: Map, held: Map, step: float, pool: Executor | None) -> tuple[Map, Map]:
    better, told = np.empty_like(planes), np.empty_like(score)

    def work(rows: tuple[int, int]) -> None:
        improve_rows(images, planes, score, held, step, rows, _scratch(), better, told)

    _in_halves(work, len(score), pool)
    return better, told


def _in_halves(work: Callable[[tuple[int, int]], None], height: int, pool: Executor | None) -> None:
    upper, lower = (0, height // 2), (height // 2, height)
    if pool is None:
        work(upper)
        work(lower)
    else:
        other = pool.submit(work, upper)
        work(lower)
        other.result()


def _scratch() -> Map:
    scratch = make_scratch()
    x, y = scratch[DX : DX + NUM_PIXELS], scratch[DY : DY + NUM_PIXELS]
    scratch[FALL_OFF : FALL_OFF + NUM_PIXELS] = np.exp(-(x * x + y * y) / (2.0 * SPREAD_PX * SPREAD_PX))
    return scratch
