"""Silhouettes held against each other by their outer tangents, which needs no volume.

A plane through the centres of two cameras that touches the object's convex hull touches it in both photographs: of the
pencil of planes about their baseline, the two that bound one silhouette bound the other (Porrill and Pollard, "Curve
matching and stereo calibration", 1991; Wong and Cipolla, "Structure and motion from silhouettes", 2001). The angle
between them, in pixels, is exact to the outline's own error, so that it tells what a volume cannot: a camera turned
about its own sight, or moved.

A camera is told by what the others say of each other: where they agree, it contradicts most of them, and either a turn
of it mends that, or it is left open whether the camera or its mask is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.outlines import Silhouette, outline_pieces
from sfmapp.carve.views import View
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

# tangents contradict each other when they miss by so many times the typical miss of the others
_CONTRADICTS = 5.0
# a camera that is turned misses by so many times the typical miss of the others, and by half of that at most once it
# is turned back; of 466 true cameras none did by more than 1.3 that could be turned back, of 932 rolled by 5 degrees
# 97 % do by 2 (14 solids from 4 to 12 sides 240 pixels wide, dinosaur, temple, lego, bunny)
_TURNED, _MENDED = 2.0, 0.5
# more of a camera's tangents than this have to contradict the others, or lie inside those of more of them, for the
# camera, or the mask, to be wrong as a whole: a spill of 30 % of the silhouette contradicted half of them at most, a
# camera in the volume 75 % at least (the same scenes)
_MOST = 0.5
# of the tangents of all other cameras with each other, as few contradict each other where these agree
_AGREE = 0.1
# with fewer others that can tell nobody is blamed
_FEWEST = 3
# pixels to which outlines and cameras are taken to be told where that cannot be learned from them: if there are too few
# of them, or too many are wrong
_PLAIN_PX = 1.0
# share of a view's misses that is asked, the smallest: part of an outline may be wrong
_TRIMMED = 0.8
_STEPS = 12
_LARGEST_STEP = np.radians(5.0)


class _Hull(NamedTuple):
    """The convex hull of a silhouette as seen from its camera: unit rays (H, 3) in the world, pixels to a radian, and
    whether the object may go on beyond the picture or what is known of it."""

    rays: Array
    scale: float
    is_open: bool


class Turned(NamedTuple):
    """What turning a camera back leaves: the angle and its standard deviation, degrees, typical misses in pixels before
    and after."""

    angle_deg: float
    sigma_deg: float
    before: float
    after: float


@dataclass(frozen=True)
class Contradicted:
    """A view that the others speak against, who agree with each other.

    Attributes:
        share: of its tangents that contradict theirs.
        turned_deg, sigma_deg: the turn of its camera that mends this; None where none does.
    """

    view: int
    share: float
    turned_deg: float | None = None
    sigma_deg: float | None = None


class Tangents:
    """Outer tangents of V silhouettes; those of views without a whole convex outline tell nothing.

    Attributes:
        miss: (V, V, 2) pixels by which the tangents of a view lie outside those of another, negative inside; infinite
            where one has the axis through both cameras in its silhouette and the other has not; NaN where they cannot
            be compared.
        least_sigma: what :meth:`typical` is at least, pixels.
    """

    def __init__(self, views: Sequence[View], silhouettes: Sequence[Silhouette]) -> None:
        self._hulls = [_hull(view, silhouette) for view, silhouette in zip(views, silhouettes, strict=True)]
        self._centers = np.array([view.center for view in views])
        self._floor = np.sqrt(2.0) * np.array([silhouette.outline_sigma_px for silhouette in silhouettes])
        self.least_sigma = float(self._floor.min())
        most = max((len(hull.rays) for hull in self._hulls if hull is not None), default=0)
        # as many rays of all: the last one again and again
        self._rays = np.full((len(views), most, 3), np.nan)
        for i, hull in enumerate(self._hulls):
            if hull is not None:
                self._rays[i] = hull.rays[np.minimum(np.arange(most), len(hull.rays) - 1)]
        self._scales = np.array([np.nan if hull is None else hull.scale for hull in self._hulls])
        self._is_open = np.array([hull is None or hull.is_open for hull in self._hulls])
        self.miss = np.stack([self._misses(i)[0] for i in range(len(views))])

    def typical(self, which: Sequence[int]) -> float:
        """Standard deviation of the tangents among some views, pixels, by their median; at least their outlines'."""
        kept = np.intersect1d(np.flatnonzero(~self._is_open), which)
        miss = np.abs(self.miss[np.ix_(kept, kept)])
        miss = miss[~np.isnan(miss)]
        floor = float(np.median(self._floor[kept])) if len(kept) else 0.0
        return max(floor, 1.4826 * float(np.median(miss))) if len(miss) else floor

    def turned_back(self, i: int, kept: Sequence[int], sigma: float) -> Turned | None:
        """How a view has to be turned about its own centre to fit the kept ones; None where that is not told.

        Rays of the hull are turned by Gauss and Newton's steps, misses weighted by Geman and McClure's function of
        their own median, so that a part of the outline that is wrong does not turn the camera.
        """
        turn, hull = np.zeros(3), self._hulls[i]
        if hull is None:
            return None
        for _ in range(_STEPS):
            rotation = rigid3.exp_so3(turn)
            miss, change = self._misses(i, hull.rays @ rotation.T)
            miss, change = miss[kept].ravel(), change[kept].reshape(-1, 3)
            told = np.isfinite(miss)
            if np.count_nonzero(told) <= 3 or not change[told].any():
                return None
            miss, change = miss[told], change[told]
            scale = 2.0 * max(sigma, 1.4826 * float(np.median(np.abs(miss))))
            weighted = change / (1.0 + (miss / scale) ** 2)[:, None] ** 2
            information = weighted.T @ change
            step = -np.linalg.lstsq(information, weighted.T @ miss, rcond=1e-9)[0]
            step *= min(1.0, _LARGEST_STEP / max(float(np.linalg.norm(step)), 1e-12))
            turn = rigid3.log_so3(rigid3.exp_so3(step) @ rotation)
            if np.linalg.norm(step) < 1e-6:
                break
        angle = float(np.linalg.norm(turn))
        after = np.abs(self._misses(i, hull.rays @ rigid3.exp_so3(turn).T)[0][kept])
        before = np.abs(self.miss[i, kept])
        along = turn / max(angle, 1e-12)
        told_of = change.T @ change
        # next to nothing is known of a turn that changes no outline
        spread = np.linalg.inv(told_of + 1e-9 * np.trace(told_of) * np.eye(3))
        return Turned(
            float(np.degrees(angle)), float(np.degrees(sigma * np.sqrt(along @ spread @ along))), _rms(before),
            _rms(after, 3),
        )  # fmt: skip

    def _misses(self, i: int, rays: Array | None = None) -> tuple[Array, Array]:
        """Misses (V, 2) of a view, with other rays (H, 3) of its own if given, and how they change (V, 2, 3) as it is
        turned."""
        miss, change = np.full((len(self._rays), 2), np.nan), np.zeros((len(self._rays), 2, 3))
        if self._hulls[i] is None:
            return miss, change
        own = self._rays[i] if rays is None else rays
        base = self._centers - self._centers[i]
        length = np.linalg.norm(base, axis=1)
        told = np.flatnonzero((length > 0.0) & ~np.isnan(self._scales) & ~(self._is_open & self._is_open[i]))
        base = base[told] / length[told, None]
        # two directions across each baseline
        aside = np.cross(base, np.eye(3)[np.argmin(np.abs(base), axis=1)])
        aside /= np.linalg.norm(aside, axis=1, keepdims=True)
        across = np.stack([aside, np.cross(base, aside)], axis=1)
        mine = _bounds(np.einsum("hc,vkc->vhk", own, across))
        theirs = _bounds(np.einsum("vhc,vkc->vhk", self._rays[told], across))
        apart = _wrapped(mine.angle - theirs.angle) * [-1.0, 1.0]
        pixels = np.sqrt(2.0) / np.hypot(
            1.0 / (mine.lever * self._scales[i]), 1.0 / (theirs.lever * self._scales[told, None])
        )
        found = apart * pixels
        # what goes on beyond its picture may be wider than it shows, but no narrower
        if self._is_open[i]:
            found = np.maximum(found, 0.0)
        others_open = self._is_open[told]
        found[others_open] = np.minimum(found[others_open], 0.0)
        found[mine.is_around | theirs.is_around] = np.nan
        found[mine.is_around & ~theirs.is_around & ~others_open] = np.inf
        if not self._is_open[i]:
            found[theirs.is_around & ~mine.is_around] = np.inf
        miss[told] = found
        tangent = own[mine.at]
        normal = np.cross(base[:, None], tangent)
        normal /= np.linalg.norm(normal, axis=2, keepdims=True)
        outward = (pixels / mine.lever * [-1.0, 1.0])[..., None]
        change[told] = outward * np.cross(tangent, normal)
        return miss, change


def find_contradicted(tangents: Tangents, used: Sequence[int], most: int) -> tuple[list[Contradicted], bool]:
    """Views that contradict the others, who agree with each other.

    Args:
        used: views that are asked.
        most: as many are blamed at most.

    Returns:
        Them, worst first, and whether what is left agrees. Nobody is blamed where more than ``most`` would be, or where
        it may be one as well as another.
    """
    out: list[Contradicted] = []
    kept = list(used)
    while True:
        ranked = sorted(kept, key={k: _against(tangents, k, kept) for k in kept}.__getitem__)
        # of those it is held against as many are left aside, the worst, as may be blamed after it
        spare = max(0, most - len(out) - 1)
        found = [each for i in kept if (each := _judged(tangents, i, _surest(ranked, i, spare))) is not None]
        if not found:
            return out, are_in_agreement(tangents, kept)
        worst = max(found, key=lambda each: ranked.index(each.view))
        rivals = [each.view for each in found if each is not worst]
        others = _surest(ranked, worst.view, spare)
        if len(out) == most or any(_judged(tangents, worst.view, _but(others, i), 2) is None for i in rivals):
            return [], False
        out.append(worst)
        kept.remove(worst.view)


def is_contradictory(tangents: Tangents, used: Sequence[int]) -> bool:
    """Whether silhouettes of a few views contradict each other beyond what outlines and cameras err by."""
    miss = np.abs(tangents.miss[np.ix_(used, used)])
    return bool(_contradict(miss[~np.isnan(miss)], _PLAIN_PX).any())


def _surest(ranked: Sequence[int], i: int, spare: int) -> list[int]:
    """The others of some views, but for the last ones."""
    others = _but(ranked, i)
    return sorted(others[: len(others) - spare])


def _judged(tangents: Tangents, i: int, others: Sequence[int], fewest: int = _FEWEST) -> Contradicted | None:
    """A view against others; None if it fits them, if they do not fit each other, or if fewer than some can tell."""
    miss = tangents.miss[i, others]
    miss = miss[~np.isnan(miss[:, 0])]
    if len(miss) < fewest or not _stands_out(miss, tangents.least_sigma):
        return None
    # which takes as long as all others are many
    if not are_in_agreement(tangents, others):
        return None
    sigma = tangents.typical(others)
    share = float(np.mean(_contradict(np.abs(miss), sigma)))
    if _rms(np.abs(miss)) >= _TURNED * sigma:
        turned = tangents.turned_back(i, others, sigma)
        if turned is not None and turned.after <= min(_MENDED * turned.before, _TURNED * sigma):
            return Contradicted(i, share, turned.angle_deg, turned.sigma_deg)
    return Contradicted(i, share) if _contradicts_most(miss, sigma) else None


def _stands_out(miss: Array, sigma: float) -> bool:
    """Whether misses (N, 2) may be those of a view that is wrong."""
    return _rms(np.abs(miss)) >= _TURNED * sigma or _contradicts_most(miss, sigma)


def _contradicts_most(miss: Array, sigma: float) -> bool:
    wrong = _contradict(np.abs(miss), sigma)
    # what spills is contradicted as well, but carves nothing
    lacks = (wrong & ((miss < 0.0) | np.isinf(miss))).any(axis=1)
    return bool(max(np.mean(wrong), np.mean(lacks)) > _MOST)


def _but(kept: Sequence[int], i: int) -> list[int]:
    return [k for k in kept if k != i]


def are_in_agreement(tangents: Tangents, kept: Sequence[int]) -> bool:
    """Whether tangents among some views are told well, and hardly any of them contradict each other."""
    miss = tangents.miss[np.ix_(kept, kept)]
    told, sigma = np.abs(miss[~np.isnan(miss)]), tangents.typical(kept)
    if not len(told):
        return True
    return sigma <= _CONTRADICTS * _PLAIN_PX and bool(np.mean(_contradict(told, sigma)) <= _AGREE)


def _contradict(miss: Array, sigma: float) -> NDArray[np.bool_]:
    """Of misses without their signs."""
    return np.asarray((miss > _CONTRADICTS * sigma) | np.isinf(miss))


def _against(tangents: Tangents, i: int, kept: Sequence[int]) -> float:
    """How far a view misses the others in the median, pixels."""
    miss = np.abs(tangents.miss[i, kept])
    miss = miss[~np.isnan(miss)]
    return float(np.median(miss)) if len(miss) else 0.0


def _rms(miss: Array, fitted: int = 0) -> float:
    """Root mean square of the smaller ones, after some numbers were fitted to them; infinite if too few are left."""
    miss = np.sort(miss[~np.isnan(miss)])
    miss = miss[: int(np.ceil(_TRIMMED * len(miss)))]
    return float(np.sqrt(np.sum(miss**2) / (len(miss) - fitted))) if len(miss) > fitted else np.inf


class _Bounds(NamedTuple):
    """The two planes of a pencil (V, 2) that bound a hull: angles, sine of the angle from the baseline at which they
    touch it, which ray does, and (V,) whether the hull lies all around the baseline."""

    angle: Array
    lever: Array
    at: NDArray[np.int64]
    is_around: NDArray[np.bool_]


def _bounds(flat: Array) -> _Bounds:
    """Of hulls (V, H, 2) as seen along the baseline."""
    middle = flat.mean(axis=1)
    toward = np.arctan2(middle[:, 1], middle[:, 0])
    angle = _wrapped(np.arctan2(flat[..., 1], flat[..., 0]) - toward[:, None])
    at = np.stack([angle.argmin(axis=1), angle.argmax(axis=1)], axis=1)
    ends = np.take_along_axis(angle, at, axis=1)
    lever = np.take_along_axis(np.hypot(flat[..., 0], flat[..., 1]), at, axis=1)
    return _Bounds(ends + toward[:, None], lever, at, ends[:, 1] - ends[:, 0] >= np.pi)


def _wrapped(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def _hull(view: View, silhouette: Silhouette) -> _Hull | None:
    """None where there is no object, or the lens has no rays for its outline."""
    import cv2

    inside = silhouette.inside
    if silhouette.known is not None and not silhouette.known.any():
        return None
    # marching squares on the distance itself, which crosses nought where coverage crosses a half
    pieces = outline_pieces(np.clip(silhouette.distance, -1.0, 1.0) + np.float32(0.5))
    xy = np.concatenate([pieces[:, :2], pieces[:, 2:]]).astype(np.float64)
    if len(xy) < 3:
        return None
    around = xy.mean(axis=0) + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    rays = view.rays(np.concatenate([around, xy]))
    (ahead, right, down), rays = rays[:3], rays[3:]
    rays = rays[np.isfinite(rays).all(axis=1)]
    if len(rays) < 3 or not np.isfinite([ahead, right, down]).all() or (rays @ ahead <= 0.0).any():
        return None
    across = np.cross(ahead, np.eye(3)[np.argmin(np.abs(ahead))])
    across /= np.linalg.norm(across)
    flat = np.stack([rays @ across, rays @ np.cross(ahead, across)], axis=1) / (rays @ ahead)[:, None]
    corners = cv2.convexHull(flat.astype(np.float32), returnPoints=False).ravel()
    scale = 1.0 / np.sqrt(np.linalg.norm(right - ahead) * np.linalg.norm(down - ahead))
    edge = inside[0].any() or inside[-1].any() or inside[:, 0].any() or inside[:, -1].any()
    return _Hull(rays[corners], float(scale), bool(edge or (silhouette.known is not None)))
