"""Depth of every pixel of a photograph by a sweep of planes parallel to it: Collins, CVPR 1996, made dense.

A plane brings the neighbours' pictures to the reference's by a homography; where it meets the surface they look alike.
Planes are even in inverse depth, a pixel of the usual neighbour apart. Costs, paths, levels and tests of a match are
those of :mod:`sfmapp.stereo.semiglobal`; of several neighbours the better two count, so that what is hidden from some
is told by others. A slanted plane of each pixel takes it from there (:mod:`sfmapp.carve.slanted_sweep`), and what other
maps tell is tried as well (:mod:`sfmapp.carve.sweep_exchange`). Sigma and confidence go by the cues of
:mod:`sfmapp.stereo.disparity_error`, for a plane more is a pixel of disparity more, by a table of swept scenes, and by
how far the sparse points are off the map.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.slanted_kernels import take_islands
from sfmapp.carve.slanted_sweep import carried_on, slanted_planes
from sfmapp.carve.sweep_error_table import ERROR_TABLE
from sfmapp.carve.sweep_kernels import UNSEEN_WORD, Neighbours, decide, fill_costs
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.dense.selection import MIN_SHARED, meeting_point
from sfmapp.errors import NoReconstructionError
from sfmapp.geometry import rigid3
from sfmapp.images.pixels import as_gray
from sfmapp.stereo.disparity_error import correlations, cues_of, with_residual
from sfmapp.stereo.matcher import BLANK, ISLAND_STEP_PX, LEAST_ISLAND
from sfmapp.stereo.semiglobal import (
    BLANK_WINDOW,
    BLUR_PX,
    LEAST_NOISE,
    LEAST_SIDE,
    LEAST_UNIQUENESS,
    PLAIN,
    PLAIN_WINDOW,
    UNSEEN,
    describe,
    doubt_of,
    follow_strips,
    rows_at_a_time,
    usual_penalties,
)
from sfmapp.stereo.semiglobal_kernels import (
    GAP,
    LANES,
    NOISE_BINS,
    STRIDE,
    Found,
    Rows,
    Views,
    collect,
    even_out,
    look_again,
    noise_of,
    report,
)

Array = NDArray[np.float64]
Map = NDArray[np.float32]

# neighbours that a view is swept with
NEIGHBORS = 6
# Of the inverse depths of a view's sparse points these quantiles, and so much on both sides of them as a share of their
# own: points are where corners are, and the ground in front of them and the sky behind them are not
_QUANTILES, _BEYOND = (0.01, 0.99), (0.6, 1.5)
# without points: inverse depths as shares of that of the place where the cameras' axes meet
_AROUND_MEETING = (0.4, 2.5)
# 1 - best / second of an answer: half of what a pair asks for, as several photographs outvote one that fits by chance,
# and other views' maps are there to contradict. Of what is textured on a courtyard a tenth more is answered
LEAST_ANSWER = 0.5 * LEAST_UNIQUENESS
# NCC of the photographs that fit best: of pictures of noise 6 per cent reach it, and next to none in islands
LEAST_SCORE = 0.3
# with an equal noise in all pictures the zero-mean NCC is the share of what they have in common in the variance: below
# half of it the rest is more
LEAST_CORRELATION = 0.5
# how often the scatter is taken out of planes: three times, a point more is right within 1 % on rendered scenes
_EVENED = 3
# sparse points of a view that tell what its cameras leave: their share inside is then known to 7 per cent
LEAST_POINTS = 50
# planes, times the shorter side in pixels
_MOST_PLANES = 4.0
# a picture brought to the reference's reaches so far beyond it, as a share of its sides
_MARGIN = 0.5
_PAD = 4


@dataclass(frozen=True)
class Planes:
    """Planes parallel to a photograph, even in inverse depth.

    Attributes:
        first: inverse depth of the first, the farthest; per unit of the world.
        step: from one to the next.
        count: how many.
    """

    first: float
    step: float
    count: int

    def depth(self, plane: NDArray[np.floating]) -> Map:
        """Depth of planes, whole or between, units of the world; inf where there is none in front."""
        inverse = self.first + self.step * np.asarray(plane, np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(inverse <= 0.0, np.inf, 1.0 / inverse).astype(np.float32)


@dataclass(frozen=True)
class SweptPlanes:
    """Slanted planes through the pixels of a view, of which nothing is said yet.

    Attributes:
        planes: of the sweep.
        plane: (H, W) float32 number of the plane, with fractions; NaN where nothing is believed.
        slopes: (H, W, 2) float32 what a plane grows by from a pixel to the next, along rows and down columns.
        neighbors: positions of the views it was swept with.
    """

    planes: Planes
    plane: Map
    slopes: Map
    neighbors: tuple[int, ...]


@dataclass(frozen=True)
class SweptDepth:
    """Depth map of a view; arrays (H, W) float32, NaN where nothing is believed.

    Attributes:
        depth: along the axis, units of the world.
        sigma: 68 per cent of such depths are off by less, units of the world.
        half_width_95: 95 per cent are off by less.
        confidence: share of such depths that are off by less than a plane, 0 to 1; 0 where there is none.
        plane: number of the plane, with fractions.
        planes: that were looked at.
        neighbors: positions of the views it was swept with.
    """

    depth: Map
    sigma: Map
    half_width_95: Map
    confidence: Map
    plane: Map
    planes: Planes
    neighbors: tuple[int, ...]


def sweep_planes(scene: DenseScene, view_idx: int, pool: Executor | None = None) -> SweptPlanes:
    """Sweep planes through what a view shows.

    Args:
        scene: views without distortion, and their neighbours.
        view_idx: position of the reference.
        pool: does two things at a time; bytes do not depend on it.

    Raises:
        NoReconstructionError: the view has no neighbour.
    """
    reference = scene.views[view_idx]
    chosen = tuple(int(m) for m in scene.neighbors[view_idx] if m >= 0)[:NEIGHBORS]
    if not chosen:
        raise NoReconstructionError(
            f"{reference.name}: no other photograph shows the same from another place, so it has no depth",
            "add photographs beside it, 1 to 60 degrees apart as seen from what it shows",
        )
    others = [scene.views[m] for m in chosen]
    planes = _planes(scene, view_idx, others)
    anywhere, sure = _Level(reference, others, planes).answers(pool)
    found = slanted_planes(reference, others, planes.first, planes.step, anywhere, sure, pool)
    return believed_planes(reference, others, planes, found, np.isfinite(sure), chosen)


def _planes(scene: DenseScene, view_idx: int, others: list[DenseView]) -> Planes:
    """From the sparse points of a view, or from where the cameras look."""
    reference = scene.views[view_idx]
    seen = np.repeat(np.arange(len(scene.point_xyz)), np.diff(scene.point_ptr))[scene.point_view_idx == view_idx]
    pixel, depth = reference.project(scene.point_xyz)
    own = depth[seen][depth[seen] > 0.0]
    if len(own) >= MIN_SHARED:
        # what others see in its direction may show as well, farther than anything that it shares with them
        in_frame = depth[reference.shows(pixel)]
        far = min(np.quantile(1.0 / values, _QUANTILES[0]) for values in (own, in_frame))
        near_far = np.array([far, np.quantile(1.0 / own, _QUANTILES[1])]) * _BEYOND
    else:
        axes = rigid3.rotation_matrix(scene.cam_from_world)[:, 2]
        target = rigid3.apply(reference.cam_from_world, meeting_point(scene.centers, axes)[None])[0, 2]
        near_far = np.array(_AROUND_MEETING) / abs(target)
    middle = float(near_far.mean())
    grid = np.stack(np.meshgrid(np.linspace(0, reference.width, 9), np.linspace(0, reference.height, 9)), -1)
    speeds = []
    for other in others:
        _, epipole = _brought(reference, other, middle)
        speeds.append(np.median(np.linalg.norm(epipole[:2] - grid * epipole[2], axis=-1)))
    # no finer than what the picture's own levels can tell apart when each halves the one before it
    step = max(
        1.0 / float(np.median(speeds)),
        (near_far[1] - near_far[0]) / (_MOST_PLANES * min(reference.width, reference.height)),
    )
    count = max(int(np.ceil((near_far[1] - near_far[0]) / step)) + 1, 2)
    return Planes(float(near_far[0]), float(step), count)


def _brought(reference: DenseView, other: DenseView, inverse: float) -> tuple[Array, Array]:
    """The homography (3, 3) of a plane from pixels of the reference to those of another view, and the epipole (3,) of
    :class:`~sfmapp.carve.sweep_kernels.Neighbours`."""
    relative = rigid3.compose(other.cam_from_world, rigid3.inverse(reference.cam_from_world))
    rotation, shift = rigid3.rotation_matrix(relative), relative[4:]
    calibration, other_calibration = _matrix(reference.k), _matrix(other.k)
    plane = rotation.copy()
    plane[:, 2] += inverse * shift
    homography = other_calibration @ plane @ np.linalg.inv(calibration)
    return homography, np.asarray(np.linalg.solve(homography, other_calibration @ shift))


def _matrix(k: Array) -> Array:
    return np.array([[k[0], 0.0, k[2]], [0.0, k[1], k[3]], [0.0, 0.0, 1.0]])


class _Level:
    """One resolution of a sweep, and those below it."""

    def __init__(self, reference: DenseView, others: list[DenseView], planes: Planes) -> None:
        self.planes = planes
        self.grey = as_gray(reference.rgb)
        height, width = self.grey.shape
        self.coarse: _Level | None = None
        if planes.count > LANES or min(height, width) >= 2 * LEAST_SIDE:
            halves = Planes(planes.first, 2.0 * planes.step, (planes.count + 1) // 2 + 1)
            self.coarse = _Level(_halved(reference), [_halved(other) for other in others], halves)
        self.reference, self.others = reference, others

    def match(self, pool: Executor | None) -> Found:
        """The best plane of every pixel."""
        height, width = self.grey.shape
        count = min(self.planes.count, LANES)
        views = Views(
            _words(self.grey), np.empty((1, 1), np.uint64), self.grey, np.zeros((height, width), np.int16),
            np.full((height, width), LANES, np.uint8), doubt_of(count),
        )  # fmt: skip
        texture = self.texture(PLAIN_WINDOW)
        if self.coarse is not None:
            found = self.coarse.match(pool)
            around = np.ones((3, 3), np.uint8)
            ends = np.stack([cv2.erode(found.disparity, around), cv2.dilate(found.disparity, around)])
            plain = PLAIN * max(noise_of(self.grey, np.empty(NOISE_BINS, np.int64)), LEAST_NOISE) * PLAIN_WINDOW**2
            search = (0, self.planes.count)
            look_again(found, ends, LEAST_UNIQUENESS, texture, plain, search, views.base, views.expected)
        ring, strip = rows_at_a_time(height, width)
        rows = Rows(*np.empty((3, ring, width, LANES), np.uint8))
        agrees, best, elsewhere = np.empty((3, height, width), np.uint8)
        disparity, bend = np.empty((height, width), np.float32), np.empty((height, width), np.int16)
        found = Found(disparity, agrees, best, elsewhere, bend)
        middle = self.planes.first + 0.5 * self.planes.step * (self.planes.count - 1)
        seen = _neighbours(self.reference, self.others, middle, self.planes)
        along = self.planes.first - middle, self.planes.step
        length = GAP + STRIDE * width
        scratch = [(np.empty((4, length), np.uint8), np.empty(LANES, np.uint64)) for _ in range(2)]

        def fill(first: int, last: int, part: int) -> None:
            fill_costs(views, seen, along, np.uint8(UNSEEN), (first, last), scratch[part], rows)

        def settle(first: int, last: int, part: int) -> None:
            decide(views, (first, last), rows, found)

        paths = np.empty((4, length), np.uint8), np.empty((4, length), np.uint8)
        follow_strips(views, usual_penalties(), rows, strip, paths, fill, settle, pool)
        return found

    def texture(self, side: int) -> NDArray[np.uint16]:
        """Sums of differences from the blurred picture in windows (H, W)."""
        fine = cv2.absdiff(self.grey, cv2.GaussianBlur(self.grey, (5, 5), BLUR_PX))
        sums: NDArray[np.uint16] = cv2.boxFilter(fine, cv2.CV_16U, (side, side), normalize=False)
        return sums

    def answers(self, pool: Executor | None) -> tuple[Map, Map]:
        """Planes (H, W) of all pixels within the mask, and of those that are believed, NaN elsewhere."""
        found = self.match(pool)
        shape = self.grey.shape
        kept, sure, state = np.empty(shape, np.int16), np.empty(shape, np.float32), np.empty(shape, np.uint8)
        anywhere = found.disparity.copy()
        blank = BLANK * BLANK_WINDOW**2
        collect(found, LEAST_ANSWER, self.texture(BLANK_WINDOW), blank, (0, self.planes.count), kept)
        if self.reference.mask is not None:
            kept[~self.reference.mask], anywhere[~self.reference.mask] = -32768, np.nan
        cv2.filterSpeckles(kept, -32768, LEAST_ISLAND, 16 * ISLAND_STEP_PX)
        report(found, kept, sure, state, np.empty((3, *shape), np.float32))
        return anywhere, sure


def _halved(view: DenseView) -> DenseView:
    size = ((view.width + 1) // 2, (view.height + 1) // 2)
    scale = np.array([size[0] / view.width, size[1] / view.height])
    mask = view.mask
    if mask is not None:
        mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0
    rgb = cv2.resize(as_gray(view.rgb), size, interpolation=cv2.INTER_AREA)
    return DenseView(view.name, rgb, mask, view.k * np.tile(scale, 2), view.cam_from_world)


def _words(grey: NDArray[np.uint8]) -> NDArray[np.uint64]:
    height, width = grey.shape
    padded = np.empty((2, height + 2 * _PAD, width + 2 * _PAD), np.uint8)
    words = np.empty((height, width), np.uint64)
    describe(grey, padded[0], padded[1], np.empty((2, width), np.uint32), 0, words)
    return words


def _neighbours(reference: DenseView, others: list[DenseView], middle: float, planes: Planes) -> Neighbours:
    """Census words of the neighbours' pictures, each brought to the reference's by the middle plane."""
    words, boxes, epipoles = [], [], []
    reach = 0.5 * planes.step * planes.count
    for other in others:
        homography, epipole = _brought(reference, other, middle)
        box = _box(reference, epipole, reach)
        left, top, width, height = box
        # OpenCV counts from the middle of the first pixel
        shift = np.array([[1.0, 0.0, left + 0.5], [0.0, 1.0, top + 0.5], [0.0, 0.0, 1.0]])
        back = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])
        warp = back @ homography @ shift
        flags = cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR
        grey = cv2.warpPerspective(
            as_gray(other.rgb), warp, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        shown = np.full(other.rgb.shape[:2], 255, np.uint8) if other.mask is None else other.mask.astype(np.uint8) * 255
        shown = cv2.warpPerspective(shown, warp, (width, height), flags=cv2.WARP_INVERSE_MAP | cv2.INTER_NEAREST)
        word = _words(grey)
        word[shown == 0] = UNSEEN_WORD
        words.append(word.ravel())
        boxes.append((left, top, width, height))
        epipoles.append(epipole)
    lefts, tops, widths, heights = np.array(boxes, np.int64).T.copy()
    start = np.concatenate([[0], np.cumsum(widths * heights)[:-1]]).astype(np.int64)
    return Neighbours(np.concatenate(words), start, widths, heights, lefts, tops, np.array(epipoles))


def _box(reference: DenseView, epipole: Array, reach: float) -> tuple[int, int, int, int]:
    """Left, top, width and height of where planes as far as ``reach`` from the middle show the reference's pixels."""
    width, height = reference.width, reference.height
    corners = np.array([(x, y, 1.0) for x in (0.0, width) for y in (0.0, height)])
    seen = np.concatenate([corners - reach * epipole, corners + reach * epipole])
    seen = seen[:, :2] / np.maximum(seen[:, 2:], 0.05)
    size = np.array([width, height])
    low = np.floor(np.maximum(seen.min(axis=0), -_MARGIN * size)).astype(int)
    high = np.ceil(np.minimum(seen.max(axis=0), (1.0 + _MARGIN) * size)).astype(int)
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def believed_planes(
    reference: DenseView, others: list[DenseView], planes: Planes, found: tuple[Map, Map, Map],
    known: NDArray[np.bool_], neighbors: tuple[int, ...],
) -> SweptPlanes:  # fmt: skip
    """The planes of a view that correlate in the photographs that fit best, or, where they were known before, in the
    mean of all, and what lies close beside them.

    Args:
        found: planes, slopes and scores of :func:`~sfmapp.carve.slanted_sweep.slanted_planes`.
        known: (H, W) where the sweep alone is sure, or an earlier map is.
    """
    plane, slopes, score = found
    safe = np.where(known, plane, np.float32(0.0))
    grey = as_gray(reference.rgb).astype(np.float32)
    (_, here, _), _ = correlations(grey, _seen_by_others(reference, others, planes, safe), known)
    believed = (score >= LEAST_SCORE) | (known & (here >= LEAST_CORRELATION))
    take_islands(plane, slopes, believed, LEAST_ISLAND)
    return SweptPlanes(planes, *carried_on(plane, slopes, believed), neighbors)


def swept_cues(reference: DenseView, others: list[DenseView], planes: Planes, plane: Map) -> Map:
    """The cues (9, H, W) of :mod:`sfmapp.stereo.disparity_error` of planes (H, W), NaN where there is none."""
    known = np.isfinite(plane)
    safe = np.where(known, plane, np.float32(0.0))
    grey = as_gray(reference.rgb).astype(np.float32)
    return cues_of(grey, _seen_by_others(reference, others, planes, safe), safe, known)


def measured(scene: DenseScene, view_idx: int, swept: SweptPlanes) -> SweptDepth:
    """Depth with its sigma and confidence of the planes of a view, their scatter evened out."""
    planes, chosen, plane = swept.planes, swept.neighbors, swept.plane.copy()
    for _ in range(_EVENED):
        even_out(plane, np.empty_like(plane))
    known = np.isfinite(plane)
    told = ERROR_TABLE.read(swept_cues(scene.views[view_idx], [scene.views[m] for m in chosen], planes, plane))
    residual = _residual(scene, view_idx, planes, plane, told[0])
    sigma, half_width, confidence = with_residual(told, residual)
    depth = planes.depth(plane)
    # of 1 / w with those of w
    sigma, half_width = (
        np.where(known, width * planes.step * depth * depth, np.float32(np.nan)).astype(np.float32)
        for width in (sigma, half_width)
    )
    confidence = np.where(known, confidence, np.float32(0.0))
    return SweptDepth(depth, sigma, half_width, confidence, plane, planes, chosen)


def _residual(scene: DenseScene, view_idx: int, planes: Planes, plane: Map, sigma: Map) -> float:
    """Standard deviation of what cameras leave of planes, which no cue tells: so much more, in planes, that 68 per cent
    of the sparse points of a view lie inside. Points are in all of their photographs at once, and so off by little of
    what one pair of cameras is; what they are is counted as the map's. Zero where there are too few to tell."""
    view = scene.views[view_idx]
    seen = np.repeat(np.arange(len(scene.point_xyz)), np.diff(scene.point_ptr))[scene.point_view_idx == view_idx]
    pixel, depth = view.project(scene.point_xyz[seen])
    inside = view.shows(pixel)
    x, y = pixel[inside].astype(np.int64).T
    off = (1.0 / depth[inside] - planes.first) / planes.step - plane[y, x]
    told = sigma[y, x]
    usable = np.isfinite(off)
    if usable.sum() < LEAST_POINTS:
        return 0.0
    # 68 per cent of the points ask for no more
    excess = np.square(off[usable]) - np.square(told[usable].astype(np.float64))
    return float(np.sqrt(max(np.quantile(excess, 0.68), 0.0)))


def _seen_by_others(reference: DenseView, others: list[DenseView], planes: Planes, plane: Map) -> Iterator[Map]:
    """What the neighbours show, in the mean, one plane farther, at these planes, and one nearer."""
    height, width = plane.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    # where the plane at infinity shows a pixel, and what an inverse depth adds to that
    brought = [_brought(reference, other, 0.0) for other in others]
    rays = [pixels @ homography.T for homography, _ in brought]
    adds = [homography @ epipole for homography, epipole in brought]
    pictures = [as_gray(other.rgb).astype(np.float32) for other in others]
    for off in (-1.0, 0.0, 1.0):
        inverse = planes.first + planes.step * (plane.astype(np.float64) + off)
        total, shown = np.zeros((2, height, width), np.float32)
        for other, ray, add, picture in zip(others, rays, adds, pictures, strict=True):
            u, v, z = (ray[..., axis] + inverse * add[axis] for axis in range(3))
            in_front = z > 0.0
            u, v = (
                np.where(in_front, part / np.where(in_front, z, 1.0) - 0.5, -1e4).astype(np.float32) for part in (u, v)
            )
            inside = (u > -0.5) & (v > -0.5) & (u < other.width - 0.5) & (v < other.height - 0.5)
            seen = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            total += np.where(inside, seen, np.float32(0.0))
            shown += inside
        yield (total / np.maximum(shown, np.float32(1.0))).astype(np.float32)
