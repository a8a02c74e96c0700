"""The surface of octrees: closed, oriented, manifold whatever the distance says, and in the right place."""

from __future__ import annotations

import numpy as np
import pytest

from carving_scenes import Solid, around, ball, both, box, ring, silhouette_of
from sfmapp.carve.hull import hull_of
from sfmapp.carve.isosurface import surface_of
from sfmapp.carve.octree import Octree, codes_of
from sfmapp.carve.options import CarveOptions
from sfmapp.carve.space_carving import carve
from sfmapp.scene.mesh import Mesh, face_vectors


def volume(mesh: Mesh) -> float:
    return float((mesh.xyz[mesh.faces].mean(axis=1) * face_vectors(mesh.xyz, mesh.faces)).sum() / 3.0)


def check_closed(mesh: Mesh) -> None:
    """Each edge is walked once in each direction, and the triangles at each vertex are one fan."""
    a, b = mesh.faces[:, [0, 1, 2]].ravel().astype(np.int64), mesh.faces[:, [1, 2, 0]].ravel().astype(np.int64)
    forth, back = a * len(mesh.xyz) + b, b * len(mesh.xyz) + a
    assert len(np.unique(forth)) == len(forth)
    assert (np.sort(forth) == np.sort(back)).all()
    # at a vertex, each triangle leads from the edge that it leaves by to the one that it comes by: one cycle
    corner = np.arange(mesh.faces.size)
    before = corner - corner % 3 + (corner % 3 + 2) % 3
    order = np.argsort(forth)
    following = order[np.searchsorted(forth[order], back[before])]
    assert (a[following] == a).all()
    lowest, at = corner.copy(), corner.copy()
    for _ in range(24):
        at = following[at]
        lowest = np.minimum(lowest, at)
    first = np.full(len(mesh.xyz), mesh.faces.size)
    np.minimum.at(first, a, corner)
    assert (lowest == first[a]).all()


def whole(cells: int, side: float = 3.0) -> Octree:
    """All cells of a cube as its surface."""
    depth = int(cells).bit_length() - 1
    places = np.stack(np.meshgrid(*[np.arange(cells)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    empty = tuple(np.empty(0, np.uint64) for _ in range(depth + 1))
    return Octree(np.full(3, -0.5 * side), side, depth, empty, np.sort(codes_of(places)))


@pytest.mark.parametrize("seed", range(3))
def test_noise_has_a_closed_surface(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mesh = surface_of(whole(16), lambda xyz: rng.normal(size=len(xyz)))
    assert len(mesh) > 5000
    check_closed(mesh)


@pytest.mark.parametrize(
    ("solid", "exact"),
    [
        (ball(), 4.0 / 3.0 * np.pi),
        (ring(), 2.0 * np.pi**2 * 0.8 * 0.25**2),
        (box((0.8, 0.6, 0.5)), 8.0 * 0.8 * 0.6 * 0.5),
    ],
)
def test_the_surface_of_a_solid_is_where_it_should_be(solid: Solid, exact: float) -> None:
    tree = whole(64)
    mesh = surface_of(tree, lambda xyz: -solid(xyz))
    check_closed(mesh)
    # chords cut off 1 / 8 of a cell squared by the radius; corners and edges of a box a third of a cell at most
    assert volume(mesh) == pytest.approx(exact, rel=0.012)
    assert np.abs(solid(mesh.xyz)).max() < 0.35 * tree.cell
    outward = solid(mesh.xyz + 0.1 * tree.cell * mesh.normal) - solid(mesh.xyz)
    assert np.quantile(outward, 0.02) > 0.05 * tree.cell


def test_the_surface_closes_beyond_its_cells_and_at_the_cube() -> None:
    # one cell on the surface of a ball that reaches through three faces of the cube
    tree = whole(16)
    few = Octree(np.array([0.0, 0.0, 0.0]), 1.6, 4, tree.full, codes_of(np.array([[9, 0, 0]])))
    mesh = surface_of(few, lambda xyz: 1.0 - np.linalg.norm(xyz, axis=1))
    check_closed(mesh)
    assert volume(mesh) == pytest.approx(np.pi / 6.0, rel=0.25)
    # full cells alone: the whole cube, but for the half cell by which the surface lies inside its faces
    full = (*tree.full[:1], np.arange(8, dtype=np.uint64), *tree.full[2:])
    cube = surface_of(Octree(tree.low, 3.0, 4, full, tree.surface[:0]), lambda xyz: np.ones(len(xyz)))
    check_closed(cube)
    assert 0.6 * 27.0 < volume(cube) < 27.0


def test_a_hull_holds_the_solid_and_little_more() -> None:
    views = around(24, width=320, height=240, elevation_deg=40.0)
    solid = both(ball(0.7), box((0.9, 0.3, 0.3)))
    silhouettes = [silhouette_of(view, solid) for view in views]
    tree, report = carve(views, silhouettes, np.full(3, -1.2), 2.4, CarveOptions(cells=64))
    hull = hull_of(views, silhouettes)
    mesh = surface_of(tree, hull.distance, lambda xyz: hull.normals(xyz, tree.cell))
    check_closed(mesh)
    exact = surface_of(tree, lambda xyz: -solid(xyz))
    check_closed(exact)
    assert report.volume_low < volume(mesh) < report.volume_high
    assert 0.99 * volume(exact) < volume(mesh) < 1.08 * volume(exact)
    # outlines of masks are off by half a pixel, which is 0.005 here
    assert hull.distance(exact.xyz).min() > -0.01
    assert np.linalg.norm(mesh.normal, axis=1) == pytest.approx(1.0, abs=1e-5)
    again = surface_of(tree, lambda xyz: hull.distance(xyz, threads=1))
    assert again.xyz.tobytes() == mesh.xyz.tobytes()
    assert again.faces.tobytes() == mesh.faces.tobytes()
