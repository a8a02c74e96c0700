"""Silhouettes held against each other: spills, holes, and cameras that do not fit.

A pixel inside a silhouette is right only if something on its ray is inside the others: the ray of one that two others
call empty wherever they see it shows no object, a spill. A hole is doubtful if nothing but it is against an object as
thick there as around it. A camera that is turned or moved, or a mask of something else, contradicts the others' outer
tangents (:mod:`sfmapp.carve.tangency`). Where these cannot tell, as objects that go on beyond the pictures have none,
one side of its silhouette spills, the other lacks what all others hold, and both go when it is moved back (Hernandez,
Schmitt and Cipolla, "Silhouette Coherence for Camera Calibration under Circular Motion", 2007, adjust cameras by that).

Volumes are a grid of cells, coarse against the pixels; what is smaller than a cell and a margin is not judged by them.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.box import find_box
from sfmapp.carve.consistency_kernels import MOST, Fields, count_misses, free_depth, see_cells
from sfmapp.carve.outlines import Silhouette, signed_distance
from sfmapp.carve.tangency import Contradicted, Tangents, are_in_agreement, find_contradicted, is_contradictory
from sfmapp.carve.views import View, project_points
from sfmapp.errors import InputError
from sfmapp.events import Events

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STAGE = "consistency"
# with fewer views than this an odd one cannot be told
FEWEST = 4
# cells a side, and layers of them that a thread takes
_CELLS, _LAYERS = 96, 4
# points along the longer side of a grid of distances
_POINTS = 192
# pixels by which a place is beyond the outline before a view speaks against it: outlines and cameras are told to one
_MARGIN_PX = 1.5
# so many other views have to call a ray empty: one may be wrong itself
_AGAINST = 2
# share of a silhouette that spills, from which on its camera is asked; of clean ones none did at all, of cameras turned
# by 5 degrees 0.7 % at least, and of most more than 5 % (eight solids, 8 to 24 views)
_SPILLS = 0.002
# moving the silhouette has to take away so much of what speaks against it
_MENDED = 0.5
# a camera that does not fit and is not just turned lacks this much more than the typical one
_LACKS = 0.05
_ROLLS_DEG = np.arange(-8.0, 8.5, 1.0)
# of the depth of the object around a hole, at least this much lies behind one that is none, nearly everywhere in it
_DEPTH = 0.7
_EVERYWHERE = 0.9
# pixels around a hole that it is compared with, rays through each and steps along them; smaller holes are let be
_RIM_PX, _RAYS, _SAMPLES, _LEAST_HOLE_PX = 6, 48, 160, 12
# before a dark background shadows on the object are taken for holes
_WEAK = ("dark background",)
# share of the silhouette above which a hole is no shadow: the temple's were 0.7 % at most
_LARGEST_SHADOW = 0.02


@dataclass(frozen=True)
class Verdict:
    """What the other silhouettes say of one.

    Attributes:
        silhouette: repaired.
        problem: why it is not used, empty if it is.
        spilled, filled: share of its pixels that were taken away, and that were added.
        doubtful: share of holes that may be none and were left.
        turned_deg: by what its camera seems to be turned; None if it is not.
        turned_sigma_deg: standard deviation of that; None where outer tangents do not tell it.
    """

    silhouette: Silhouette
    problem: str = ""
    spilled: float = 0.0
    filled: float = 0.0
    doubtful: float = 0.0
    turned_deg: float | None = None
    turned_sigma_deg: float | None = None


@dataclass(frozen=True)
class _Evidence:
    """On the grid of a view: distances to its own outline, how many others at least call a ray empty, how many cells of
    it none does, and the margin in points of the grid."""

    distance: NDArray[np.float32]
    least: NDArray[np.uint8]
    depth: NDArray[np.float32]
    margin: int

    @property
    def held(self) -> Mask:
        """Where the others hold something."""
        return np.asarray(self.least == 0)

    @property
    def surely_held(self) -> Mask:
        """The same without what cells and margins add to it."""
        import cv2

        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * self.margin + 1,) * 2)
        return np.asarray(cv2.erode(self.held.astype(np.uint8), disc) > 0)

    @property
    def spill(self) -> float:
        return self._share((self.distance > _MARGIN_PX) & (self.least >= _AGAINST))

    @property
    def lack(self) -> float:
        return self._share((self.distance < -_MARGIN_PX) & self.surely_held)

    def _share(self, where: Mask) -> float:
        return float(np.count_nonzero(where) / max(1, int(np.count_nonzero(self.distance > 0.0))))


def compare(
    views: Sequence[View], silhouettes: Sequence[Silhouette], *, repairs: bool, workers: int, events: Events
) -> list[Verdict]:
    """What silhouettes say of each other.

    Args:
        views: V of them, with the sizes of their silhouettes.
        silhouettes: V; those that are known nowhere have no voice.
        repairs: take spills away and fill holes that are none; otherwise they are only counted.

    Returns:
        V verdicts. A silhouette whose camera does not fit is known nowhere.
    """
    verdicts = [Verdict(silhouette) for silhouette in silhouettes]
    used = [i for i, each in enumerate(silhouettes) if each.known is None or bool(each.known.any())]
    tangents = Tangents(views, silhouettes)
    if len(used) < FEWEST:
        if is_contradictory(tangents, used):
            events.warned(STAGE, f"silhouettes contradict each other: {len(used)} are too few to tell which is wrong")
        return verdicts
    most = max(1, len(used) // 10)
    contradicted, agree = find_contradicted(tangents, used, most)
    for each in contradicted:
        verdicts[each.view] = _against(silhouettes[each.view], each)
    amid = [i for i in _amid(views, silhouettes, used) if not verdicts[i].problem]
    if len(contradicted) + len(amid) <= most:
        for i in amid:
            verdicts[i] = Verdict(
                _unknown(silhouettes[i]), "has its camera where all others that look there show the object"
            )
    _judge_by_volume(views, silhouettes, used, verdicts, most, repairs=repairs, workers=workers, events=events)
    kept = [i for i in used if not verdicts[i].problem]
    if not agree and not are_in_agreement(Tangents(views, [verdict.silhouette for verdict in verdicts]), kept):
        events.warned(
            STAGE,
            "outer tangents of silhouettes contradict each other, and it may be one as well as another: masks or "
            "cameras of several are wrong, and what they carve away may be there: none is blamed",
        )
    return verdicts


def _judge_by_volume(
    views: Sequence[View], silhouettes: Sequence[Silhouette], used: Sequence[int], verdicts: list[Verdict], most: int,
    *, repairs: bool, workers: int, events: Events,
) -> None:  # fmt: skip
    """Verdicts on those of the used views that have no problem yet, by what all of these hold; ``most`` in all may have
    one."""
    out = {i: verdicts[i] for i in used if verdicts[i].problem}
    while True:
        voices = [out[i].silhouette if i in out else silhouette for i, silhouette in enumerate(silhouettes)]
        try:
            # anew without a camera that is out: a turned one cuts off a part of the object, which others seem to spill
            box = find_box(views, voices)
        except InputError as reason:
            events.warned(STAGE, f"silhouettes are not compared: {reason}")
            return
        low, side = box.cube()
        out |= {
            i: Verdict(_unknown(silhouettes[i]), "is apart from all others") for i in used if views[i].name in box.apart
        }
        kept = [i for i in used if i not in out]
        evidence = _weigh([views[i] for i in kept], [silhouettes[i] for i in kept], low, side, workers, events)
        odd = _odd_camera(evidence, [views[i] for i in kept], low + 0.5 * side)
        if odd is None:
            break
        if len(out) >= most:
            named = _names(views, [*out, kept[odd[0]]])
            events.warned(
                STAGE, f"cameras and silhouettes disagree, and not only {named}: of these none more is blamed"
            )
            return
        out[kept[odd[0]]] = Verdict(_unknown(silhouettes[kept[odd[0]]]), odd[1], turned_deg=odd[2])
    holes = _Holes([views[i] for i in kept], [silhouettes[i] for i in kept], low, side)
    for k, (i, found) in enumerate(zip(kept, evidence, strict=True)):
        verdicts[i] = _repaired(silhouettes[i], found, *holes.doubtful_ones(k), repairs)
    for i, verdict in out.items():
        verdicts[i] = verdict


def _amid(views: Sequence[View], silhouettes: Sequence[Silhouette], used: Sequence[int]) -> list[int]:
    """Views whose cameras stand inside all other silhouettes that show their places: outlines of what goes on beyond a
    picture cannot refute them, but an object is not carved from within."""
    centers = np.array([views[i].center for i in used])
    inside = np.full((len(used), len(used)), np.nan)
    for k, at in enumerate(used):
        seen = np.empty((len(used), 3))
        project_points(views[at].row, centers, seen)
        height, width = silhouettes[at].distance.shape
        x, y, depth = seen.T
        shown = np.flatnonzero((depth > 0.0) & (x >= 0.0) & (x < width) & (y >= 0.0) & (y < height))
        inside[shown, k] = silhouettes[at].distance[y[shown].astype(int), x[shown].astype(int)]
    np.fill_diagonal(inside, np.nan)
    told = ~np.isnan(inside)
    is_amid = (told.sum(axis=1) >= FEWEST - 1) & ~(told & (inside <= _MARGIN_PX)).any(axis=1)
    return [i for i, inside_all in zip(used, is_amid.tolist(), strict=True) if inside_all]


def _against(silhouette: Silhouette, found: Contradicted) -> Verdict:
    """Of a view that outer tangents speak against."""
    if found.turned_deg is None:
        problem = (
            f"contradicts the others in {found.share:.0%} of its outer tangents: its camera, or its mask, is wrong"
        )
    else:
        problem = (
            f"does not fit the others: its camera seems turned by {found.turned_deg:.1f} +- {found.sigma_deg:.1f} "
            "degrees"
        )
    return Verdict(_unknown(silhouette), problem, turned_deg=found.turned_deg, turned_sigma_deg=found.sigma_deg)


def _names(views: Sequence[View], which: Sequence[int]) -> str:
    return ", ".join(views[i].name for i in which)


def _unknown(silhouette: Silhouette) -> Silhouette:
    return replace(silhouette, known=np.zeros(silhouette.distance.shape, bool))


def _weigh(
    views: Sequence[View], silhouettes: Sequence[Silhouette], low: Array, side: float, workers: int, events: Events
) -> list[_Evidence]:
    """What the others say along the rays of each view."""
    middle = low + 0.5 * side
    fields, cell = _fields(views, silhouettes, middle), side / _CELLS

    def layers(first: int) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
        last = min(first + _LAYERS, _CELLS)
        places = np.empty(((last - first) * _CELLS**2, 3), np.int16)
        missed = np.empty_like(places)
        num = count_misses(fields, _MARGIN_PX, low, cell, _CELLS, first, last, places, missed)
        return places[:num].copy(), missed[:num].copy()

    def look(view: int) -> _Evidence:
        height, width, step = fields.sizes[view]
        least = np.full((height, width), MOST + 1, np.uint8)
        depth = np.zeros((height, width), np.float32)
        see_cells(fields, view, low, cell, places, missed, least, depth)
        start = fields.starts[view]
        distance = fields.distance[start : start + height * width].reshape(height, width)
        across = cell * fields.scales[view] / float(np.linalg.norm(views[view].center - middle))
        margin = int(np.ceil((_MARGIN_PX + step + 0.5 * np.sqrt(3.0) * across) / step))
        return _Evidence(distance, least, depth, margin)

    with ThreadPoolExecutor(max(1, workers)) as pool:
        parts = list(pool.map(layers, range(0, _CELLS, _LAYERS)))
        events.raise_if_cancelled()
        places, missed = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
        return list(pool.map(look, range(len(views))))


def _fields(views: Sequence[View], silhouettes: Sequence[Silhouette], middle: Array) -> Fields:
    sizes, distances = [], []
    for silhouette in silhouettes:
        step = max(1, -(-max(silhouette.distance.shape) // _POINTS))
        distance = silhouette.distance[step // 2 :: step, step // 2 :: step].copy()
        if silhouette.known is not None:
            distance[~silhouette.known[step // 2 :: step, step // 2 :: step]] = np.nan
        sizes.append((*distance.shape, step))
        distances.append(distance.ravel())
    ends = np.cumsum([len(distance) for distance in distances])
    return Fields(
        np.array([view.row for view in views]), np.array(sizes, np.int64), np.r_[0, ends[:-1]].astype(np.int64),
        np.concatenate(distances), np.array([_scale(view, middle) for view in views]),
    )  # fmt: skip


def _scale(view: View, at: Array) -> float:
    """Pixels by which a step of one unit moves the picture of a place, at most, at depth 1."""
    step = 1e-3 * float(np.linalg.norm(view.center - at))
    seen = np.empty((4, 3))
    project_points(view.row, np.vstack([at, at + step * np.eye(3)]), seen)
    change = (seen[1:, :2] - seen[0, :2]) / step
    return float(np.linalg.svd(np.nan_to_num(change), compute_uv=False)[0] * abs(seen[0, 2]))


def _odd_camera(
    evidence: Sequence[_Evidence], views: Sequence[View], middle: Array
) -> tuple[int, str, float | None] | None:
    """The view that fits the others worst, if its camera is to blame: its position, why, and the angle in degrees."""
    spills = np.array([each.spill for each in evidence])
    typical = float(np.median([each.lack for each in evidence]))
    for i in np.argsort(-spills, kind="stable"):
        if spills[i] < _SPILLS:
            return None
        moved = _moved_back(evidence[i])
        if moved is not None:
            step = -(-max(views[i].width, views[i].height) // _POINTS)
            angle = float(np.degrees(moved[0] * step / _scale(views[i], middle)))
            angle = float(np.hypot(angle, moved[1]))
            return int(i), f"does not fit the others: its camera seems turned by {angle:.1f} degrees", angle
        if evidence[i].lack > 3.0 * typical + _LACKS:
            return int(i), "does not fit the others: its camera, or its mask, is wrong", None
    return None


def _moved_back(found: _Evidence) -> tuple[float, float] | None:
    """How far, in points of the grid, and by what angle in degrees a silhouette has to be moved to fit what the others
    hold; None where moving does not mend it."""
    import cv2

    inside = (found.distance > 0.0).astype(np.float32)
    held, surely = found.held.astype(np.float32), found.surely_held.astype(np.float32)
    shape = tuple(int(2 ** np.ceil(np.log2(2 * n))) for n in inside.shape)
    wanted = np.fft.rfft2(held + surely, shape)
    rows, columns = np.nonzero(inside)
    center = (float(columns.mean()), float(rows.mean()))
    num, best = float(inside.sum()), (np.inf, 0.0, 0, 0)
    before = np.inf
    for roll in sorted(_ROLLS_DEG, key=abs):
        turn = cv2.getRotationMatrix2D(center, float(roll), 1.0)
        rolled = (cv2.warpAffine(inside, turn, inside.shape[::-1]) > 0.5).astype(np.float32)
        # inside but not held, and surely held but not inside, for all moves at once
        against = rolled.sum() + surely.sum() - np.fft.irfft2(wanted * np.conj(np.fft.rfft2(rolled, shape)), shape)
        if roll == 0.0:
            before = float(against[0, 0])
        place = np.unravel_index(int(np.argmin(against)), against.shape)
        if against[place] < best[0] - 1e-3 * num:
            best = (float(against[place]), float(roll), int(place[0]), int(place[1]))
    down, right = (k - n if k > n // 2 else k for k, n in zip(best[2:], shape, strict=True))
    far = float(np.hypot(down, right))
    reach = far + np.radians(abs(best[1])) * np.sqrt(num / np.pi)
    if best[0] > _MENDED * before or reach < 0.5 * found.margin:
        return None
    return far, best[1]


def _repaired(silhouette: Silhouette, found: _Evidence, holes: Mask, doubtful: Mask, repairs: bool) -> Verdict:
    """A silhouette without spills and without holes (H, W) that are none."""
    inside = silhouette.inside
    spill = _spilled(inside, found)
    num = max(1, int(np.count_nonzero(inside)))
    spilled, filled, left = (float(np.count_nonzero(each) / num) for each in (spill, holes, doubtful))
    if not repairs or not (spill.any() or holes.any()):
        return Verdict(silhouette, "", spilled, filled, left)
    import cv2

    coverage = np.clip(0.5 + silhouette.distance, 0.0, 1.0)
    # with the pixels that the outline of a hole runs through
    coverage[cv2.dilate(holes.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0] = 1.0
    coverage[spill] = 0.0
    return Verdict(replace(silhouette, distance=signed_distance(coverage)), "", spilled, filled, left)


def _spilled(inside: Mask, found: _Evidence) -> Mask:
    """(H, W) pixels inside whose rays the others call empty, where these reach beyond what margins explain."""
    import cv2

    empty = (found.least >= _AGAINST).astype(np.uint8)
    _, pieces = cv2.connectedComponents(empty & (found.distance > 0.0), connectivity=8)
    deep = np.unique(pieces[(empty > 0) & (found.distance > _MARGIN_PX)])
    spill = inside & _as_pixels(np.isin(pieces, deep[deep > 0]), inside.shape)
    # and whole pieces, of whatever size, that are mostly so, such as the crumbs that this leaves
    num, pieces, facts, _ = cv2.connectedComponentsWithStats((inside & ~spill).astype(np.uint8), connectivity=8)
    against = np.bincount(pieces.ravel(), _as_pixels(empty > 0, inside.shape).ravel(), num)
    crumbs = np.flatnonzero(against >= 0.5 * facts[:, cv2.CC_STAT_AREA])
    return np.asarray(spill | np.isin(pieces, crumbs[crumbs > 0]))


class _Holes:
    """Closed holes of silhouettes against what the other views hold behind them."""

    def __init__(self, views: Sequence[View], silhouettes: Sequence[Silhouette], low: Array, side: float) -> None:
        self._views, self._silhouettes = views, silhouettes
        self._middle, self._reach = low + 0.5 * side, 0.5 * np.sqrt(3.0) * side
        self._fields = _fields(views, silhouettes, self._middle)
        away = np.array([view.center for view in views]) - self._middle
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        between = np.clip(away @ away.T, -1.0, 1.0) - 2.0 * np.eye(len(views))
        self._nearest = np.tan(np.minimum(np.arccos(between.max(axis=1)), 0.49 * np.pi))

    def doubtful_ones(self, i: int) -> tuple[Mask, Mask]:
        """(H, W) pixels of holes that are none, and of holes that may be none.

        Behind a hole that is none the others hold as much as around it. That a hole is there and no other view looks
        through it is possible as well, if it is narrow: through an object D thick one of width w is seen by views
        within atan(w / D). Such a hole may be there, unless the background is dark, as shadows are.
        """
        import cv2

        silhouette, view = self._silhouettes[i], self._views[i]
        inside = silhouette.inside
        weak = silhouette.source in _WEAK
        false, doubtful = np.zeros(inside.shape, bool), np.zeros(inside.shape, bool)
        num, pieces, facts, _ = cv2.connectedComponentsWithStats((~inside).astype(np.uint8), connectivity=4)
        is_open = np.unique(np.concatenate([pieces[0], pieces[-1], pieces[:, 0], pieces[:, -1]]))
        for piece in np.setdiff1d(np.arange(1, num), is_open):
            left, top, width, height, area = (int(value) for value in facts[piece])
            if area < _LEAST_HOLE_PX:
                continue
            x0, y0 = max(left - _RIM_PX, 0), max(top - _RIM_PX, 0)
            cut = np.s_[y0 : top + height + _RIM_PX, x0 : left + width + _RIM_PX]
            within, distance = pieces[cut] == piece, silhouette.distance[cut]
            around = cv2.dilate(within.astype(np.uint8), np.ones((2 * _RIM_PX + 1,) * 2, np.uint8)) > 0
            through = self._depth(i, within, x0, y0)
            beside = self._depth(i, around & (distance > 1.0), x0, y0)
            if not len(through) or not len(beside) or np.median(beside) <= 0.0:
                continue
            typical = float(np.median(beside))
            if np.quantile(through, 1.0 - _EVERYWHERE) < _DEPTH * typical:
                continue
            far = float(np.linalg.norm(view.center - self._middle))
            wide = 2.0 * float(-distance[within].min()) * far / self._fields.scales[i]
            share = area / np.count_nonzero(inside)
            looked_through = wide >= float(np.median(through)) * self._nearest[i]
            sure = looked_through or (weak and share <= _LARGEST_SHADOW)
            (false if sure else doubtful)[cut] |= within
        return false, doubtful

    def _depth(self, i: int, where: Mask, x0: int, y0: int) -> Array:
        """How deep the others hold something along some of the pixels of a cut-out, world."""
        rows, columns = np.nonzero(where)
        chosen = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _RAYS)).astype(int))
        xy = np.stack([columns[chosen] + x0, rows[chosen] + y0], axis=1) + 0.5
        rays = self._views[i].rays(xy)
        rays = np.ascontiguousarray(rays[np.isfinite(rays).all(axis=1)])
        far = float(np.linalg.norm(self._views[i].center - self._middle))
        depth = np.empty(len(rays))
        free_depth(
            self._fields, i, _MARGIN_PX, self._views[i].center, rays, max(0.0, far - self._reach), far + self._reach,
            _SAMPLES, depth,
        )  # fmt: skip
        return depth


def _as_pixels(grid: Mask, shape: tuple[int, ...]) -> Mask:
    step = -(-max(shape) // _POINTS)
    full = np.repeat(np.repeat(grid, step, axis=0), step, axis=1)
    missing = [(0, max(0, n - m)) for n, m in zip(shape, full.shape, strict=True)]
    return np.asarray(np.pad(full, missing, mode="edge")[: shape[0], : shape[1]])
