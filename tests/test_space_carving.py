"""The octree of a hull against a dense grid asked point by point, and what happens where nothing can be told."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from carving_scenes import around, ball, both, box, ring, silhouette_of
from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.carve.hull import hull_of
from sfmapp.carve.octree import Octree, codes_of, places_of
from sfmapp.carve.options import CarveOptions
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.space_carving import carve
from sfmapp.carve.views import View, view_of_camera
from sfmapp.errors import InputError, NoReconstructionError

LOW, SIDE = np.full(3, -1.5), 3.0
CELLS = 32


def filled(tree: Octree) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Finest cells (n, n, n) in full cells, and those at the surface."""
    inside, surface = (np.zeros((2**tree.depth,) * 3, bool) for _ in range(2))
    for level, codes in enumerate(tree.full):
        size = 2 ** (tree.depth - level)
        for x, y, z in places_of(codes) * size:
            assert not inside[x : x + size, y : y + size, z : z + size].any()
            inside[x : x + size, y : y + size, z : z + size] = True
    surface[tuple(places_of(tree.surface).T)] = True
    return inside, surface


def lattice(cells: int, per_cell: int = 1) -> NDArray[np.float64]:
    """(n, n, n, 3) places of middles of cells, or of so many points along a side of each."""
    at = (np.arange(cells * per_cell) + 0.5) / (cells * per_cell) * SIDE
    return LOW + np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1)


def dense_grid(views: list[View], silhouettes: list[Silhouette], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Points (..., 3) inside the hull, by numpy and the project's cameras: bilinear distances."""
    result = np.ones(points.shape[:-1], bool)
    for view, silhouette in zip(views, silhouettes, strict=True):
        assert view.camera is not None
        pixels = project(view.camera, points.reshape(-1, 3) @ view.outer[:, :3].T + view.outer[:, 3])
        x = np.clip(pixels[:, 0] - 0.5, 0.0, view.width - 1.001)
        y = np.clip(pixels[:, 1] - 0.5, 0.0, view.height - 1.001)
        i, j = x.astype(int), y.astype(int)
        x, y, d = x - i, y - j, np.rint(silhouette.distance * 64.0)
        value = (1 - y) * ((1 - x) * d[j, i] + x * d[j, i + 1]) + y * ((1 - x) * d[j + 1, i] + x * d[j + 1, i + 1])
        result &= (value > 0.0).reshape(result.shape)
    return result


def wide_views(views: list[View]) -> list[View]:
    """The same places through fisheyes whose pictures hold the whole cube."""
    result = []
    for view in views:
        assert view.cam_from_world is not None
        camera = Camera(
            CameraModel.OPENCV_FISHEYE, 160, 160, np.array([150.0, 150.0, 80.0, 80.0, 0.05, -0.02, 0.01, 0.0])
        )
        result.append(view_of_camera(view.name, camera, view.cam_from_world))
    return result


@pytest.mark.parametrize("lens", ["plain", "fisheye"])
def test_the_octree_keeps_what_a_dense_grid_keeps(lens: str) -> None:
    views = around(7, width=200, height=200)
    views = wide_views(views) if lens == "fisheye" else views
    silhouettes = [silhouette_of(view, both(ring(), box((0.2, 0.3, 0.7)))) for view in views]
    tree, report = carve(views, silhouettes, LOW, SIDE, CarveOptions(cells=CELLS, min_views=7))
    inside, surface = filled(tree)
    assert not (inside & surface).any()
    kept = dense_grid(views, silhouettes, lattice(CELLS))
    hull = hull_of(views, silhouettes, min_views=7)
    told = inside.copy()
    told[surface] = hull.distance(lattice(CELLS)[surface]) > 0.0
    assert (told == kept).all()
    # conservative: not one of 27 points in a cell disagrees with it
    samples = dense_grid(views, silhouettes, lattice(CELLS, 3)).reshape((CELLS, 3) * 3)
    fine = samples.transpose(0, 2, 4, 1, 3, 5).reshape(CELLS, CELLS, CELLS, 27)
    assert fine[inside].all()
    assert not fine[~inside & ~surface].any()
    # and few are left undecided for nothing: samples in cells miss some that the outline cuts at a corner
    mixed = fine.any(axis=-1) & ~fine.all(axis=-1)
    assert surface.sum() < 3.0 * mixed.sum()
    assert report.share_of_dense < 0.6
    assert [level.looked_at for level in report.levels[:3]] == [1, 8, 64]


@pytest.mark.parametrize(("lens", "misses"), [("plain", 0), ("plain", 2), ("fisheye", 1)])
def test_views_that_are_not_asked_are_no_nearer(lens: str, misses: int) -> None:
    views = around(9, width=200, height=200)
    views = wide_views(views) if lens == "fisheye" else views
    silhouettes = [silhouette_of(view, both(ring(), box((0.2, 0.3, 0.7)))) for view in views]
    known = np.ones((views[3].height, views[3].width), bool)
    known[:, :70] = False
    silhouettes[3] = Silhouette(silhouettes[3].distance, known)
    hull = hull_of(views, silhouettes, min_views=6, misses=misses)
    # near each other, and beyond most pictures
    rng = np.random.default_rng(1)
    points = np.concatenate([lattice(CELLS).reshape(-1, 3), rng.normal(0.0, 4.0, (3000, 3))])
    by_view = hull.distance_by_view(points)
    told = np.sort(np.nan_to_num(by_view, nan=np.inf), axis=1)[:, misses].astype(np.float64)
    told[np.isfinite(by_view).sum(axis=1) < 6] = -np.inf
    assert 0.03 < np.isinf(told).mean() < 0.9
    found = hull.distance(points)
    assert found == pytest.approx(told, rel=1e-5, abs=1e-6)
    assert hull.distance(points[::-1])[::-1].tobytes() == found.tobytes()


@pytest.mark.parametrize(("width", "most"), [(64, 64), (200, 128), (400, 256)])
def test_no_point_of_a_smooth_solid_is_farther_outside_than_a_cell(width: int, most: int) -> None:
    views = around(8, width=width, height=width)
    rng = np.random.default_rng(2)
    way = rng.normal(size=(4000, 3))
    points = 0.9 * way / np.linalg.norm(way, axis=1, keepdims=True)
    silhouettes = [dataclasses.replace(silhouette_of(view, ball(0.9)), outline_sigma_px=0.2) for view in views]
    tree, report = carve(views, silhouettes, np.full(3, -0.95), 1.9)
    assert report.cells == most
    outside = -float(hull_of(views, silhouettes).distance(points).min())
    assert 0.0 < outside < tree.cell
    # and cells are not much larger than what whole pixels tell
    if most < 256:
        assert tree.cell < 5.0 * outside


def test_any_number_of_threads_gives_the_same_bytes() -> None:
    views = around(6)
    silhouettes = [silhouette_of(view, ball()) for view in views]
    trees = [carve(views, silhouettes, LOW, SIDE, CarveOptions(cells=64), threads=n)[0] for n in (1, 2, 5)]
    for tree in trees[1:]:
        assert tree.surface.tobytes() == trees[0].surface.tobytes()
        assert [codes.tobytes() for codes in tree.full] == [codes.tobytes() for codes in trees[0].full]
    assert (np.diff(trees[0].surface.astype(np.int64)) > 0).all()


def test_what_too_few_see_is_neither_full_nor_forgotten() -> None:
    views = around(5, elevation_deg=0.0)
    everything = [Silhouette(np.full((120, 160), np.inf, np.float32)) for _ in views]
    # above the pictures nothing is seen, whatever the silhouettes say
    tree, report = carve(views, everything, LOW, SIDE, CarveOptions(cells=CELLS))
    inside, surface = filled(tree)
    top = int(codes_of(np.array([[16, 16, 31]]))[0])
    assert not inside[16, 16, 31], top
    assert not surface[16, 16, 31]
    assert inside[16, 16, 16]
    assert report.touches_box
    assert 0.05 < report.unseen_share < 0.6


def test_what_is_not_known_is_not_carved() -> None:
    views = around(6)
    silhouettes = [silhouette_of(view, ball()) for view in views]
    whole = (hull_of(views, silhouettes).distance(lattice(CELLS).reshape(-1, 3)) > 0.0).sum()
    # a hand that hides half of one picture, where the mask says that there is nothing
    known = np.ones((120, 160), bool)
    known[:, :80] = False
    hidden = silhouettes[0].distance.copy()
    hidden[~known] = -5.0
    covered = [Silhouette(hidden, known), *silhouettes[1:]]
    tree, _ = carve(views, covered, LOW, SIDE, CarveOptions(cells=CELLS))
    inside, surface = filled(tree)
    distance = hull_of(views, covered).distance(lattice(CELLS).reshape(-1, 3)).reshape(inside.shape)
    assert (distance[inside] > 0.0).all()
    assert not (distance[~inside & ~surface] > 0.0).any()
    assert (distance > 0.0).sum() == pytest.approx(whole, rel=0.05)
    strict = hull_of(views, [Silhouette(hidden), *silhouettes[1:]]).distance(lattice(CELLS).reshape(-1, 3))
    assert (strict > 0.0).sum() < 0.7 * whole


def test_silhouettes_that_know_nothing_are_as_if_they_were_not_there() -> None:
    views = around(7)
    silhouettes = [silhouette_of(view, ball()) for view in views]
    nothing = Silhouette(np.full((120, 160), -np.inf, np.float32), np.zeros((120, 160), bool))
    with_them, _ = carve(views, [*silhouettes[:3], *[nothing] * 4], LOW, SIDE, CarveOptions(cells=CELLS))
    without, _ = carve(views[:3], silhouettes[:3], LOW, SIDE, CarveOptions(cells=CELLS))
    assert with_them.surface.tobytes() == without.surface.tobytes()
    assert [codes.tobytes() for codes in with_them.full] == [codes.tobytes() for codes in without.full]


def test_a_miss_that_is_allowed_carves_nothing() -> None:
    views = around(8)
    silhouettes = [silhouette_of(view, ball()) for view in views]
    holed = [Silhouette(np.full((120, 160), -np.inf, np.float32)), *silhouettes[1:]]
    tree, report = carve(views, holed, LOW, SIDE, CarveOptions(cells=CELLS, misses=1))
    without, _ = carve(views[1:], silhouettes[1:], LOW, SIDE, CarveOptions(cells=CELLS, min_views=4))
    assert report.misses == 1
    # where the first one sees: beyond its picture another one may miss instead
    near = np.linalg.norm(lattice(CELLS), axis=-1) < 1.1
    assert (filled(tree)[0][near] == filled(without)[0][near]).all()


def test_nothing_is_carved_to_nothing_in_silence() -> None:
    views = around(6)
    silhouettes = [silhouette_of(view, ball(0.6)) for view in views]
    options = CarveOptions(cells=16)
    empty = dataclasses.replace(silhouettes[2], distance=np.full((120, 160), -np.inf, np.float32))
    with pytest.raises(NoReconstructionError, match=r"view_002\.png show no object"):
        carve(views, [*silhouettes[:2], empty, *silhouettes[3:]], LOW, SIDE, options)
    with pytest.raises(NoReconstructionError, match="no place in the volume is seen"):
        carve(views, silhouettes, LOW + 100.0, SIDE, options)
    elsewhere = silhouette_of(views[4], ball(0.3, (0.0, 0.0, 0.9)))
    with pytest.raises(NoReconstructionError, match=r"outside 1 silhouettes or more.* view_004\.png"):
        carve(views, [*silhouettes[:4], elsewhere, silhouettes[5]], LOW, SIDE, options)
    with pytest.raises(InputError, match=r"view_001\.png.*20 x 10 pixels"):
        carve(views, [silhouettes[0], Silhouette(np.ones((10, 20), np.float32)), *silhouettes[2:]], LOW, SIDE, options)
    with pytest.raises(InputError, match="cube"):
        carve(views, silhouettes, LOW, -1.0, options)
