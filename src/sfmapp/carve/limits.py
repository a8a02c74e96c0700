"""What a carved surface cannot tell: where only outlines vouch for it, what no photograph sees, where to stand next.

Bounds are those that silhouettes prove. The object lies inside the hull, so its volume is no more than the hull's; a
sheet of paper can have the same silhouettes as a block, so there is no least volume. Each ray inside a silhouette goes
through the surface twice, no nearer than it enters the hull, so its area is no less than twice the integral of the
squared distance over the solid angle; a rough surface may have any area, so there is no largest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.hull import outline_error
from sfmapp.carve.joined import Evidence, cast_votes
from sfmapp.carve.joined_kernels import BINS
from sfmapp.carve.rendering import show_mesh
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View, project_point
from sfmapp.reporting import Report
from sfmapp.scene.mesh import Mesh, enclosed_volume, face_areas
from sfmapp.surface.trim import pieces

Array = NDArray[np.float64]

# who vouches for a piece of the surface, the least first
UNSEEN, CLOSURE, OUTLINES, PATCHES = 0, 1, 2, 3
KINDS = ("unseen", "closure", "outlines", "patches")
# a piece lies on the hull if it is no farther from it, in edges of triangles: vertices of the hull's own surface are
# within a tenth, centres of triangles across its creases within half
_ON_HULL_EDGES = 0.5
# a view sees a surface that is this much turned towards it, as ``sfmapp dense`` asks for
_SMALLEST_COSINE = 0.2
# a place is hidden if the surface in front of it is nearer by more than this, in edges of triangles
_HIDDEN_EDGES = 2.0
# outlines are believed within so many of their sigmas
_SIGMAS = 3.0
# views that are asked for the least area, of a surface that they were not looked at with before
_NUM_ASKED = 24
# directions that are tried for the next photograph, spread evenly over the sphere
_NUM_TRIED = 96
# unseen places are listed from this share of the whole surface on
_SMALLEST_HOLLOW = 0.002


class Hollow(Report):
    """A piece of the surface that no photograph sees.

    Attributes:
        at: its middle, world. faces: unit direction in which it looks, from where a camera might see it.
        share: of the whole surface.
    """

    at: Sequence[float]
    faces: Sequence[float]
    share: float


class NextView(Report):
    """Where a photograph would help.

    Attributes:
        place: of a camera that looks at the middle of the object, world.
        gain_share: of the surface, what is turned to it that no photograph sees.
    """

    place: Sequence[float]
    gain_share: float


class LimitsReport(Report):
    """What is not known of a surface.

    Attributes:
        patches_share, outlines_share, closure_share, unseen_share: of its area, what patches vouch for; what
            photographs see, but only outlines bound, so that a hollow may be there; what photographs see and neither
            tells, so that it is the least surface that closes the rest; and what no photograph sees.
        hollows: the largest unseen pieces. next_views: places for photographs, the most useful first.
        volume_high: the object has no more, cubic units of the world. area_low: no less, square units.
    """

    patches_share: float
    outlines_share: float
    closure_share: float
    unseen_share: float
    hollows: Sequence[Hollow]
    next_views: Sequence[NextView]
    volume_high: float
    area_low: float


@dataclass(frozen=True)
class Known:
    """Triangles (F) of a surface and what is known of them.

    Attributes:
        kind: (F,) ``UNSEEN``, ``CLOSURE``, ``OUTLINES`` or ``PATCHES``.
        centers, normals: (F, 3), world. areas: (F,).
    """

    kind: NDArray[np.int8]
    centers: Array
    normals: Array
    areas: Array

    def of_vertices(self, mesh: Mesh) -> NDArray[np.uint8]:
        """(N,) what is known of the vertices of the mesh: the least of what is known of their triangles."""
        found = np.full(len(mesh.xyz), PATCHES, np.uint8)
        np.minimum.at(found, mesh.faces.ravel(), np.repeat(self.kind.astype(np.uint8), 3))
        return found


class SeenFaces:
    """Which triangles (F) of a closed mesh photographs see from in front, unhidden, one photograph after another.

    Attributes:
        areas: (F,). edge: that of a typical triangle, units of the world.
        is_seen: (F,) by any so far.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._xyz, self._faces = np.ascontiguousarray(mesh.xyz), mesh.faces
        self.areas = face_areas(mesh.xyz, mesh.faces)
        self.edge = float(np.sqrt(np.median(self.areas)) * 1.5)
        self.is_seen = np.zeros(len(mesh.faces), np.bool_)

    def add(self, view: View, depth: NDArray[np.float32]) -> None:
        """A photograph more, and the depths (H, W) that it shows of the mesh."""
        hidden = _HIDDEN_EDGES * self.edge
        _mark_seen(view.row, view.center, self._xyz, self._faces, depth, hidden, self.is_seen)

    def lay_out(self) -> tuple[Array, Array]:
        """Middles (F, 3) and unit normals (F, 3) of the triangles, world."""
        centers, normals = np.empty((len(self.areas), 3)), np.empty((len(self.areas), 3))
        _lay_out(self._xyz, self._faces, centers, normals)
        return centers, normals


@numba.njit(cache=True, nogil=True)
def _lay_out_face(xyz: Array, a: int, b: int, c: int, center: Array, normal: Array) -> None:
    """Middle (3,) and unit normal (3,) of a triangle."""
    total = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        center[k] = (xyz[a, k] + xyz[b, k] + xyz[c, k]) / 3.0
        normal[k] = 0.5 * (
            (xyz[b, i] - xyz[a, i]) * (xyz[c, j] - xyz[a, j]) - (xyz[b, j] - xyz[a, j]) * (xyz[c, i] - xyz[a, i])
        )
        total += normal[k] ** 2
    for k in range(3):
        normal[k] /= max(math.sqrt(total), 1e-300)


@numba.njit(cache=True, nogil=True)
def _lay_out(xyz: Array, faces: NDArray[np.int32], centers: Array, normals: Array) -> None:
    for f in range(faces.shape[0]):
        _lay_out_face(xyz, faces[f, 0], faces[f, 1], faces[f, 2], centers[f], normals[f])


@numba.njit(cache=True, nogil=True)
def _mark_seen(
    row: Array, place: Array, xyz: Array, faces: NDArray[np.int32], depth: NDArray[np.float32], hidden: float,
    is_seen: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Mark triangles that a view shows from in front, no farther behind what it shows than ``hidden``."""
    height, width = depth.shape
    center, normal = np.empty(3), np.empty(3)
    for f in range(faces.shape[0]):
        if is_seen[f]:
            continue
        _lay_out_face(xyz, faces[f, 0], faces[f, 1], faces[f, 2], center, normal)
        dx, dy, dz = place[0] - center[0], place[1] - center[1], place[2] - center[2]
        along = dx * normal[0] + dy * normal[1] + dz * normal[2]
        if along <= _SMALLEST_COSINE * math.sqrt(dx * dx + dy * dy + dz * dz):
            continue
        u, v, ahead = project_point(row, center[0], center[1], center[2])
        if ahead > 0.0 and u >= 0.0 and v >= 0.0 and u < width and v < height:
            is_seen[f] = ahead <= depth[int(v), int(u)] + np.float32(hidden)


def find_known(
    mesh: Mesh, views: Sequence[View], evidence: Evidence | None = None, band: float = 0.0, *,
    threads: int = 1, seen: SeenFaces | None = None,
) -> Known:  # fmt: skip
    """Who vouches for each triangle.

    Args:
        mesh: closed.
        views: the photographs.
        evidence: of a surface that is not the whole hull's: what is not on the hull is not told by outlines; None:
            these tell all of it.
        band: within which a patch of the evidence vouches, units of the world.
        threads: that ask the hull; the result does not depend on it.
        seen: by all views; None: they are asked here.
    """
    if seen is None:
        seen = SeenFaces(mesh)
        for view in views:
            seen.add(view, show_mesh(view, mesh.xyz, mesh.faces).depth)
    centers, normals = seen.lay_out()
    kind = np.full(len(mesh.faces), OUTLINES, np.int8)
    if evidence is not None:
        kind[np.abs(evidence.hull.distance(centers, threads)) > _ON_HULL_EDGES * seen.edge] = CLOSURE
    kind[~seen.is_seen] = UNSEEN
    if evidence is not None:
        kind[_beside_patches(centers, evidence, band)] = PATCHES
    return Known(kind, centers, normals, seen.areas)


def _beside_patches(centers: Array, evidence: Evidence, band: float) -> NDArray[np.bool_]:
    """Which places (F, 3) lie within a band of a patch that a photograph sees there."""
    votes = np.zeros((len(centers), BINS), np.uint8)
    cast_votes(centers, evidence.sights, band, 1.0, votes)
    return np.asarray((votes[:, 1 : BINS - 1] > 0).any(axis=1))


def find_limits(
    mesh: Mesh, hull_mesh: Mesh, views: Sequence[View], silhouettes: Sequence[Silhouette], known: Known,
    area_low: float | None = None,
) -> LimitsReport:  # fmt: skip
    """What is not known of a surface.

    Args:
        mesh: the surface, of which ``known`` tells. hull_mesh: that of the hull, which may be the same.
        views, silhouettes: one of each for a photograph.
        area_low: the most that :func:`area_shown` gives for the hull; None: it is asked here.
    """
    total = float(known.areas.sum())
    shares = [float(known.areas[known.kind == kind].sum()) / total for kind in range(len(KINDS))]
    return LimitsReport(
        unseen_share=shares[UNSEEN], closure_share=shares[CLOSURE], outlines_share=shares[OUTLINES],
        patches_share=shares[PATCHES],
        hollows=_hollows(mesh, known), next_views=_next_views(mesh, views, known),
        volume_high=_volume_high(hull_mesh, views, silhouettes),
        area_low=_area_low(hull_mesh, views, silhouettes) if area_low is None else area_low,
    )  # fmt: skip


def _hollows(mesh: Mesh, known: Known) -> list[Hollow]:
    idx = np.flatnonzero(known.kind == UNSEEN)
    if not len(idx):
        return []
    piece = pieces(mesh.faces[idx], len(mesh.xyz))
    areas = np.bincount(piece, known.areas[idx])
    found = []
    for number in np.argsort(-areas, kind="stable"):
        share = float(areas[number] / known.areas.sum())
        if share < _SMALLEST_HOLLOW:
            break
        mine = idx[piece == number]
        weight = known.areas[mine, None]
        way = (weight * known.normals[mine]).sum(axis=0)
        way = way / max(float(np.linalg.norm(way)), 1e-300)
        at = (weight * known.centers[mine]).sum(axis=0) / weight.sum()
        found.append(Hollow(at=at.tolist(), faces=way.tolist(), share=share))
    return found


def _next_views(mesh: Mesh, views: Sequence[View], known: Known, num: int = 3) -> list[NextView]:
    """Places on the sphere that the photographs were taken from, one after another, each for what those before leave.

    What hides what is not asked: the surface before an unseen hollow is one that nobody has seen.
    """
    middle = (mesh.xyz.min(axis=0) + mesh.xyz.max(axis=0)) / 2.0
    away = float(np.median([np.linalg.norm(view.center - middle) for view in views]))
    n = np.arange(_NUM_TRIED)
    height, turn = 1.0 - (2.0 * n + 1.0) / _NUM_TRIED, n * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - height**2)
    tried = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    toward = middle + away * tried
    unseen = np.flatnonzero(known.kind == UNSEEN)
    found: list[NextView] = []
    for _ in range(num):
        shown = np.empty(len(unseen), np.bool_)
        gains = [_gain(known.centers, known.normals, known.areas, unseen, place, shown) for place in toward]
        best = int(np.argmax(gains))
        share = gains[best] / float(known.areas.sum())
        if share < _SMALLEST_HOLLOW:
            break
        found.append(NextView(place=toward[best].tolist(), gain_share=share))
        _gain(known.centers, known.normals, known.areas, unseen, toward[best], shown)
        unseen = unseen[~shown]
    return found


@numba.njit(cache=True, nogil=True)
def _gain(
    centers: Array, normals: Array, areas: Array, idx: NDArray[np.int64], place: Array, shown: NDArray[np.bool_]
) -> float:
    """Which triangles of some are turned towards a place, into ``shown``, and their area."""
    total = 0.0
    for i in range(len(idx)):
        f = idx[i]
        dx, dy, dz = place[0] - centers[f, 0], place[1] - centers[f, 1], place[2] - centers[f, 2]
        along = dx * normals[f, 0] + dy * normals[f, 1] + dz * normals[f, 2]
        shown[i] = along > _SMALLEST_COSINE * math.sqrt(dx * dx + dy * dy + dz * dz)
        if shown[i]:
            total += areas[f]
    return total


def _volume_high(hull_mesh: Mesh, views: Sequence[View], silhouettes: Sequence[Silhouette]) -> float:
    """Of the hull with its outlines farther out by three sigmas."""
    volume = enclosed_volume(hull_mesh.xyz, hull_mesh.faces)
    error = outline_error(views, silhouettes, hull_mesh.xyz.mean(axis=0))
    return volume + error * float(face_areas(hull_mesh.xyz, hull_mesh.faces).sum())


def _area_low(hull_mesh: Mesh, views: Sequence[View], silhouettes: Sequence[Silhouette]) -> float:
    """The largest that some views give, evenly spread from the first to the last: of more it is hardly larger."""
    asked = np.unique(np.linspace(0, len(views) - 1, min(_NUM_ASKED, len(views))).round().astype(int)).tolist()
    return max(
        area_shown(views[v], silhouettes[v], show_mesh(views[v], hull_mesh.xyz, hull_mesh.faces).depth) for v in asked
    )


def area_shown(view: View, silhouette: Silhouette, depth: NDArray[np.float32]) -> float:
    """What the object's area is at least by one view, square units of the world, 0 where it does not tell: twice the
    integral of squared distance over solid angle, three sigmas inside the outline; ``depth``: (H, W) of the hull."""
    if view.camera is None:  # angles of a matrix that may not be decomposed are not known
        return 0.0
    sure = silhouette.distance > _SIGMAS * silhouette.outline_sigma_px + 0.5
    if silhouette.known is not None:
        sure &= silhouette.known
    v, u = np.nonzero(sure & np.isfinite(depth))
    # r^2 dOmega of a pixel on a plane at depth z is z^2 / (fx fy) times the cosine to the axis
    fx, fy, cx, cy = view.camera.k_matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    x, y = (u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy
    cosine = 1.0 / np.sqrt(1.0 + x**2 + y**2)
    away = depth[v, u].astype(np.float64)
    return 2.0 * float((away**2 * cosine).sum() / (fx * fy))
