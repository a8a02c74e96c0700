"""Which way a surface leans that one light does not reach, as the other lights show.

With n the normal of a matt surface, c and l unit vectors to the camera and to a lamp, r_c and r_l the distances, the
photograph under the lamp over the one that is lit from the camera is ``q = g (r_c / r_l)^2 (n l) / (n c)``. With
``m = n / (n c)`` and ``k = l (r_c / r_l)^2`` that is linear: ``m c = 1, m k = q / g`` (photometric stereo; Woodham,
Optical Engineering 19(1), 1980). So what a lamp would show that does not reach a place, ``m k``, is a sum over those
lamps that do, wherever its direction is one of theirs and the camera's; positive where the surface leans towards it and
something else throws the shadow, not positive where the surface is turned away. The gains g follow from pixels that all
lamps light, which have more equations than m has numbers.

Directions depend on where the surface is: it is taken to be where a ray enters the hull. If it lies deeper, at the
bottom of a hollow, lamps beside the camera are seen under smaller angles, and it leans towards them more than is said.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from sfmapp.carve.octree import Octree, places_of
from sfmapp.carve.views import View, project_points

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# of what a surface shows that faces the camera, from which it counts as lit by a lamp, and as leaning towards one
_LIT, _LEANS = 0.1, 0.1
# slope of the surface, to the side that no lamp in use shows, which may not turn the answer: 72 degrees
_SLOPE = 3.0
# singular values below this share of the largest: the lamps are in one plane with the camera
_FLAT = 0.1
# pixels of each photograph that gains are found by, and the change of the quotient about them up to which it is smooth
_SAMPLES, _SMOOTH = 2000, 1.15
# share of a gain's column that the equations resolve
_RESOLVED = 0.99
# lamps that are needed: of three, of which two are in one plane with the camera, one gain was found 14 % off
_LEAST_LAMPS = 4


@dataclass(frozen=True)
class Quotients:
    """Photographs under lamps over the one lit from the camera, linear, and where all that is.

    Attributes:
        view: its camera. lamps: (L, 3) world. entry: (H, W) distance at which rays enter the hull.
        typical, least, most: (L, H, W) quotients, and the least and greatest of 3 x 3 pixels.
        usable: (H, W) bool pixels that both may be told in.
    """

    view: View
    lamps: Array
    entry: Array
    typical: Array
    least: Array
    most: Array
    usable: Mask


def quotients_of(view: View, lamps: Sequence[Array], hull: Octree, quotients: Array, usable: Mask) -> Quotients:
    """Of one camera: quotients (L, H, W)."""
    entry = _entries(view, hull)
    usable = usable & np.isfinite(entry)
    least, most = minimum_filter(quotients, (1, 3, 3)), maximum_filter(quotients, (1, 3, 3))
    return Quotients(view, np.array(lamps, np.float64), entry, quotients, least, most, usable)


def lamp_gains(photographs: Iterable[Quotients], typical: Array) -> Array:
    """Gains (L,) of the lamps, by pixels that all of them light; NaN where these do not tell.

    Args:
        photographs: under the same lamps; gone through once.
        typical: (L,) quotients of lit surfaces, to begin with.
    """
    rows, sides = [], []
    for photograph in photographs:
        smooth = (photograph.least > _LIT * typical[:, None, None]) & (photograph.most < _SMOOTH * photograph.least)
        at = np.flatnonzero(smooth.all(axis=0) & photograph.usable)
        at = at[:: max(1, len(at) // _SAMPLES)]
        if not len(at):
            continue
        vectors = _vectors(photograph, at)
        left, sizes, _ = np.linalg.svd(vectors)
        for j in range(vectors.shape[1]):
            # combinations of the vectors that are nothing, whatever the normal
            nothing = np.full(len(at), True) if j >= 3 else sizes[:, j] < _FLAT * sizes[:, 0]
            weights = left[nothing, :, j]
            shown = photograph.typical.reshape(len(typical), -1)[:, at[nothing]].T / typical
            rows.append(weights[:, 1:] * shown)
            sides.append(-weights[:, 0])
    if len(typical) < _LEAST_LAMPS or not rows or sum(map(len, rows)) < _SAMPLES // 10:
        return np.full(len(typical), np.nan)
    matrix, side = np.concatenate(rows), np.concatenate(sides)
    inverse = np.ones(len(typical))
    # once more without what is not matt, or lit by other parts of the object
    for _ in range(3):
        off = np.abs(matrix @ inverse - side)
        good = off <= 3.0 * np.median(off)
        inverse = np.linalg.pinv(matrix[good], rcond=1e-2) @ side[good]
    resolved = np.diag(np.linalg.pinv(matrix[good], rcond=1e-2) @ matrix[good])
    is_told = (resolved > _RESOLVED) & (inverse > 0.0)
    return np.asarray(typical / np.where(is_told, inverse, np.nan))


def leans_towards(photograph: Quotients, gains: Array, lamp: int, among: Mask) -> Mask:
    """Pixels (H, W) among some whose surface certainly leans towards a lamp that does not reach it.

    Args:
        gains: (L,) of :func:`lamp_gains`.
        lamp: which. among: (H, W) bool.
    """
    at = np.flatnonzero(among & photograph.usable)
    num = len(photograph.lamps)
    least, most = (level.reshape(num, -1)[:, at].T / gains for level in (photograph.least, photograph.most))
    lit = least > _LIT
    lit[:, lamp] = False
    vectors = _vectors(photograph, at)
    leans = np.zeros(len(at), np.bool_)
    for pattern in np.unique(lit, axis=0):
        which = np.flatnonzero(pattern)
        if not len(which):
            continue
        those = np.flatnonzero((lit == pattern).all(axis=1))
        known = vectors[those][:, [0, *(which + 1)]]
        wanted = vectors[those, lamp + 1]
        # across what is nearly one plane nothing is told
        weights = np.einsum("nij,ni->nj", np.linalg.pinv(known, rcond=_FLAT), wanted)
        missing = np.linalg.norm(np.einsum("nij,ni->nj", known, weights) - wanted, axis=1)
        # the lowest that can be: a lamp that reaches a place only in part would show more
        shown = np.where(weights[:, 1:] > 0.0, least[those][:, which], most[those][:, which])
        value = weights[:, 0] + (weights[:, 1:] * shown).sum(axis=1)
        leans[those] = value > _LEANS + _SLOPE * missing
    result = np.zeros(among.shape, np.bool_)
    result.flat[at[leans]] = True
    return result


def _entries(view: View, hull: Octree) -> Array:
    """(H, W) distances from the camera to the first cell of a hull's surface, inf beside it."""
    middles = hull.low + (places_of(hull.surface) + 0.5) * hull.cell
    seen, beside = np.empty((len(middles), 3)), np.empty((len(middles), 3))
    project_points(view.row, middles, seen)
    across = np.cross(view.axis, [0.0, 0.0, 1.0] if abs(view.axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    project_points(view.row, middles + hull.cell * across / np.linalg.norm(across), beside)
    entry = np.full((view.height, view.width), np.inf)
    in_sight = (
        (seen[:, 2] > 0.0) & (seen[:, :2] >= 0.0).all(axis=1) & (seen[:, :2] < [view.width, view.height]).all(axis=1)
    )
    columns, rows = seen[in_sight, :2].astype(np.int64).T
    np.minimum.at(entry, (rows, columns), np.linalg.norm(middles[in_sight] - view.center, axis=1))
    # a cell covers more than the pixel that its middle is in
    wide = np.linalg.norm((beside - seen)[in_sight, :2], axis=1)
    return np.asarray(minimum_filter(entry, 2 * int(np.ceil(wide.max(initial=1.0))) + 1))


def _vectors(photograph: Quotients, at: NDArray[np.int64]) -> Array:
    """(N, 1 + L, 3) of pixels: to the camera, unit, and to the lamps, times the square of the quotient of distances."""
    view = photograph.view
    rows, columns = np.unravel_index(at, photograph.usable.shape)
    rays = view.rays(np.stack([columns + 0.5, rows + 0.5], axis=1))
    depth = photograph.entry.flat[at]
    place = view.center + depth[:, None] * rays
    toward = photograph.lamps - place[:, None]
    away = np.linalg.norm(toward, axis=2, keepdims=True)
    return np.concatenate([-rays[:, None], toward / away * (depth[:, None, None] / away) ** 2], axis=1)
