"""The surface through oriented points: balls and boxes, levels that meet, what order and noise do."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.geometry.cube_cases import EDGES, surface_loops
from sfmapp.scene.mesh import enclosed_volume, face_vectors, vertex_normals
from sfmapp.surface import bricks, poisson, poisson_kernels
from sfmapp.surface.poisson import BOX_SCALE
from sfmapp.surface.trim import rim

Array = NDArray[np.float64]


def ball(count: int) -> Array:
    """Points on the unit sphere on a Fibonacci lattice, which is nowhere in line with a grid."""
    i = np.arange(count)
    z, phi = 1.0 - 2.0 * (i + 0.5) / count, np.pi * (3.0 - np.sqrt(5.0)) * i
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def times_met(faces: NDArray[np.int32]) -> NDArray[np.int64]:
    """How many triangles each edge has."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0, return_counts=True)[1]


def is_oriented(faces: NDArray[np.int32]) -> bool:
    """Whether each edge is walked once in either direction."""
    walks = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    there, back = (np.unique(w, axis=0, return_counts=True) for w in (walks, walks[:, ::-1]))
    return bool(np.array_equal(there[0], back[0]) and np.array_equal(there[1], back[1]))


def turned(axis: tuple[float, float, float], angle: float) -> Array:
    """A rotation, by Rodrigues' formula."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


# one level that fills the box; two and three of them; more points than cells, and about as many
@pytest.mark.parametrize(("count", "depth"), [(8000, 5), (20_000, 6), (60_000, 6), (60_000, 7)])
def test_a_ball_is_round_to_a_few_hundredths_of_a_cell(count: int, depth: int) -> None:
    xyz = ball(count)
    surface = poisson.poisson(3.0 * xyz + 7.0, xyz.astype(np.float32), depth)
    cell = BOX_SCALE * 2.0 / 2**depth
    if count * cell**2 / (4.0 * np.pi) < poisson.SAMPLES_PER_CELL:
        cell *= 2.0  # the next coarser level answers
    error = (np.linalg.norm((surface.xyz - 7.0) / 3.0, axis=1) - 1.0) / cell
    # vertices amid the crossings of a cell lie below a curved surface, by an eighth of its curvature (of cells of this
    # length) for each square cell, and the mean of the points' planes above it
    assert -0.25 * cell < error.mean() < 0.25 * cell
    assert 1e-4 < error.std() < 0.015
    assert np.abs(error).max() < 0.06
    assert (times_met(surface.faces) == 2).all()
    assert is_oriented(surface.faces)
    assert len(surface.xyz) - len(surface.faces) // 2 == 2
    outward = vertex_normals(surface.xyz, surface.faces)
    cosine = np.einsum("nc,nc->n", outward, (surface.xyz - 7.0) / 3.0)
    # no ripples: within twice the angle between the normals of neighbouring cells
    assert cosine.min() > np.cos(2.0 * cell)
    assert (
        0.0 < 4.0 / 3.0 * np.pi * 27.0 - enclosed_volume(surface.xyz, surface.faces) < 27.0 * 4.0 * np.pi * 0.05 * cell
    )


def box_samples(rotation: Array, step: float) -> tuple[Array, Array]:
    """Points and normals on the sides of a cube of side 2, not in line with any grid, and turned."""
    grid = np.arange(-1.0 + 0.5 * step, 1.0, step)
    a, b = (g.ravel() for g in np.meshgrid(grid, grid))
    xyz, normal = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            points = np.empty((len(a), 3))
            points[:, axis], points[:, axis - 1], points[:, axis - 2] = sign, a, b
            xyz.append(points)
            normal.append(np.tile(sign * np.eye(3)[axis], (len(a), 1)))
    return np.concatenate(xyz) @ rotation.T, np.concatenate(normal) @ rotation.T


@pytest.mark.parametrize("angle", [0.0, 0.3, 0.7853981633974483])
def test_sides_of_a_box_are_flat_however_they_lie_to_the_grid(angle: float) -> None:
    rotation = turned((1.0, 0.4, 0.2), angle)
    xyz, normal = box_samples(rotation, 0.02)
    surface = poisson.poisson(xyz, normal.astype(np.float32), 6)
    cell = BOX_SCALE * np.ptp(xyz, axis=0).max() / 2**6
    inside = surface.xyz @ rotation
    distance = (np.abs(inside) - 1.0) / cell
    largest = np.argmax(distance, axis=1)
    at_side = np.sort(np.abs(inside), axis=1)[:, 1] < 1.0 - 4.0 * cell
    error = distance[at_side, largest[at_side]]
    assert at_side.mean() > 0.5
    assert np.abs(error).max() < 0.04
    assert error.std() < 0.012
    # edges are rounded by the width of a kernel, one and a half cells, and no more
    assert -1.2 < distance.max(axis=1).min() < -0.1
    assert distance.max() < 0.1
    assert (times_met(surface.faces) == 2).all()


def test_levels_meet_without_a_gap_or_a_step() -> None:
    """One side of a ball has sixteen times as many points: two levels finer."""
    dense, sparse = ball(160_000), ball(6_000)
    xyz = np.concatenate([dense[dense[:, 0] > 0.1], sparse[sparse[:, 0] <= 0.1]])
    surface = poisson.poisson(xyz, xyz.astype(np.float32), 8)
    cell = BOX_SCALE * 2.0 / 2**8
    assert (times_met(surface.faces) == 2).all()
    assert is_oriented(surface.faces)
    assert len(surface.xyz) - len(surface.faces) // 2 == 2
    size = np.sqrt(np.linalg.norm(face_vectors(surface.xyz, surface.faces), axis=1))
    x = surface.xyz[surface.faces].mean(axis=1)[:, 0]
    assert 3.0 < np.median(size[x < -0.2]) / np.median(size[x > 0.4]) < 5.0
    error = (np.linalg.norm(surface.xyz, axis=1) - 1.0) / cell
    x = surface.xyz[:, 0]
    assert np.abs(error[x > 0.4]).max() < 0.1
    # coarse cells are four fine ones
    assert np.abs(error[x <= 0.4]).max() < 0.4
    seam = np.abs(x - 0.1) < 0.1
    outward = np.einsum("nc,nc->n", vertex_normals(surface.xyz, surface.faces), surface.xyz)
    assert outward[seam].min() > np.cos(0.15)


def test_the_order_of_the_points_is_in_no_byte() -> None:
    rng = np.random.default_rng(0)
    xyz = ball(9000) * (1.0 + 0.01 * rng.normal(size=(9000, 1)))
    normal = ball(9000).astype(np.float32)
    mixed = rng.permutation(len(xyz))
    one, two = (poisson.poisson(xyz[order], normal[order], 6) for order in (np.arange(len(xyz)), mixed))
    np.testing.assert_array_equal(one.xyz, two.xyz)
    np.testing.assert_array_equal(one.faces, two.faces)


def test_how_bricks_are_shared_is_in_no_byte(monkeypatch: pytest.MonkeyPatch) -> None:
    xyz = ball(9000) * (1.0 + 0.01 * np.random.default_rng(0).normal(size=(9000, 1)))
    alone = poisson.poisson(xyz, ball(9000).astype(np.float32), 7)
    monkeypatch.setattr(bricks, "PART", 50)
    shared = poisson.poisson(xyz, ball(9000).astype(np.float32), 7, threads=3)
    np.testing.assert_array_equal(shared.xyz, alone.xyz)
    np.testing.assert_array_equal(shared.faces, alone.faces)


def test_noise_is_averaged_and_its_mean_is_not_shifted() -> None:
    rng = np.random.default_rng(1)
    count, depth = 60_000, 6
    cell = BOX_SCALE * 2.0 / 2**depth
    normal = ball(count)
    xyz = normal * (1.0 + 0.5 * cell * rng.normal(size=(count, 1)))
    surface = poisson.poisson(xyz, normal.astype(np.float32), depth)
    cell = BOX_SCALE * np.ptp(xyz, axis=0).max() / 2**depth
    error = (np.linalg.norm(surface.xyz, axis=1) - 1.0) / cell
    # 5 points a cell, and a kernel of two to three: 0.5 over the root of 10 to 25 would be left of white noise
    assert 0.03 < error.std() < 0.25
    assert abs(error.mean()) < 0.05


def test_two_balls_and_a_hollow_one_keep_their_sides() -> None:
    xyz = ball(12_000)
    hollow = np.concatenate([xyz, 0.6 * xyz, 0.5 * xyz + [0.0, 0.0, 2.5]])
    normal = np.concatenate([xyz, -xyz, xyz]).astype(np.float32)
    surface = poisson.poisson(hollow, normal, 7)
    assert (times_met(surface.faces) == 2).all()
    volume = 4.0 / 3.0 * np.pi * (1.0 - 0.6**3 + 0.5**3)
    assert enclosed_volume(surface.xyz, surface.faces) == pytest.approx(volume, rel=0.01)


def test_a_surface_that_leaves_the_box_is_closed_at_its_sides() -> None:
    """Of a square, which has no inside of its own."""
    rng = np.random.default_rng(4)
    xyz = np.column_stack([rng.uniform(-1.0, 1.0, (20_000, 2)), np.zeros(20_000)])
    surface = poisson.poisson(xyz, np.tile(np.float32([0.0, 0.0, 1.0]), (len(xyz), 1)), 7)
    assert np.abs(surface.xyz).max() > 0.98 * BOX_SCALE
    assert (times_met(surface.faces) == 2).all()
    assert is_oriented(surface.faces)


def test_the_rim_is_what_has_one_face() -> None:
    rng = np.random.default_rng(5)
    faces = np.array([rng.choice(12, 3, replace=False) for _ in range(40)], np.int32)
    walks = [(int(a), int(b)) for face in faces for a, b in zip(face, np.roll(face, -1), strict=True)]
    sides = [tuple(sorted(walk)) for walk in walks]
    expected = sorted((side, walk) for side, walk in zip(sides, walks, strict=True) if sides.count(side) == 1)
    assert 3 < len(expected) < len(walks)
    assert rim(faces).tolist() == [list(walk) for _, walk in expected]
    assert rim(faces[:0]).shape == (0, 2)


def test_cells_are_cut_alike_on_both_sides_of_a_face() -> None:
    for case in range(256):
        crossed = [
            n for n, (corner, axis) in enumerate(EDGES) if (case >> corner & 1) != (case >> (corner | 1 << axis) & 1)
        ]
        assert sorted(edge for loop in surface_loops(case) for edge in loop) == crossed


def test_bricks_know_what_is_around_them() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(40.0, 90.0, (3000, 3)).astype(np.float32)
    order, cells = bricks.order_samples(points, 7)
    points = points[order]
    levels = bricks.make_levels(points, np.zeros(len(points), np.int8), cells, 7, 1.5, Events())
    place, other = np.empty(3, np.int64), np.empty(3, np.int64)
    assert [level.num for level in levels] == [128, 64, 32]
    for n, level in enumerate(levels):
        assert (np.diff(level.codes) > 0).all()
        known = {int(code): b for b, code in enumerate(level.codes)}
        for b in range(0, len(level.codes), 37):
            bricks.place_of(level.codes[b], place)
            for k in range(27):
                x, y, z = place[0] + k % 3 - 1, place[1] + k // 3 % 3 - 1, place[2] + k // 9 - 1
                expected = known.get(int(bricks.code_of(x, y, z)), -1) if min(x, y, z) >= 0 else -1
                assert level.around[b, k] == expected
            if n + 1 < len(levels):
                bricks.place_of(levels[n + 1].codes[level.parent[b]], other)
                np.testing.assert_array_equal(other, place // 2)
    # each sample's cell, and those within a cell and a half, are of the finest level
    for offset in (-1.5, 1.5):
        at = np.floor((points + np.float32(offset)) / 4).astype(np.int64)
        mine = np.array([bricks.code_of(*p) for p in at])
        assert levels[0].is_leaf[np.searchsorted(levels[0].codes, mine)].all()


def test_points_of_a_plane_have_the_density_that_they_have() -> None:
    """Whichever way the plane lies and wherever it passes through cells: 1, 2 and 5 points in a cell side's square."""
    rng = np.random.default_rng(3)
    for number in (1.0, 2.0, 5.0):
        for angle in (0.0, 0.4, 0.9):
            # beside what is around, each finds itself: (3/4 - 1/12)^3 on average, as of the 0.64 of a plane
            found = [density_on_plane(number, angle, offset, rng) for offset in (np.arange(8) + 0.5) / 8]
            assert np.mean(found) == pytest.approx(number + 0.463, rel=0.08)


def density_on_plane(number: float, angle: float, offset: float, rng: np.random.Generator) -> float:
    """Found at random points of a plane that is turned by an angle, in rad, and so far, in cells, behind a border."""
    flat = rng.uniform(-20.0, 20.0, (int(number * 1600), 2))
    xyz = np.column_stack([flat, np.full(len(flat), offset)]) @ turned((1.0, 1.0, 0.3), angle).T + 32.0
    order, cells = bricks.order_samples(xyz.astype(np.float32), 6)
    points, here = xyz[order].astype(np.float32), bricks.members(cells, 0)
    counts = np.zeros((len(here.codes), 64), np.float32)
    poisson_kernels.count_samples(points, here.first, 0, counts)
    density = np.zeros(len(points), np.float32)
    poisson_kernels.find_densities(
        points, np.ones(len(points), np.bool_), here.codes, here.first, 0, bricks.bricks_around(here.codes),
        counts, density, 0, len(here.codes),
    )  # fmt: skip
    return float(np.mean(density[np.abs(flat[order]).max(axis=1) < 17.0]))
