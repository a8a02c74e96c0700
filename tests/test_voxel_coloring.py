"""Colours that carve: exact photographs of cells, painted solids with noise, swept sights, and ``--colors``."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import sfmapp
from carving_scenes import (
    Solid,
    around,
    ball,
    box,
    pixel_centers,
    shown_depth,
    silhouette_of,
    without,
    write_cameras,
)
from sfmapp.camera.camera import pixels_to_rays
from sfmapp.carve.cell_grid import CellGrid, grid_of
from sfmapp.carve.files import read_octree
from sfmapp.carve.octree import Octree
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View
from sfmapp.carve.voxel_coloring import VoxelOptions, carve_by_color, shown_cells
from sfmapp.cli.main import main
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.pipelines.carve.run import CarveInput, carve

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

NUM, SKY = 32, (255, 255, 255)
VIEWS = around(14, 5.0, 120, 90, 35.0)
TROUGH = without(box((0.7, 0.7, 0.5)), box((0.35, 0.35, 0.5), (0.0, 0.0, 0.3)))
# photographs of cells at the middles of pixels are exact, and so is everything that is asked of them
EXACT = VoxelOptions(apart=1e-3, mixing=0.0, min_views=1, clear_px=0.0)


def cells_of(solid: Solid) -> CellGrid:
    """Cells whose middles are inside."""
    empty = np.empty(0, np.uint64)
    tree = Octree(np.full(3, -1.0), 2.0, 5, (empty,) * 6, empty)
    places = np.stack(np.meshgrid(*[np.arange(NUM)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = solid(-1.0 + (places + 0.5) * tree.cell) < 0.0
    return CellGrid(tree, np.zeros(3, np.int64), inside.reshape(NUM, NUM, NUM).astype(np.uint8))


def paint(xyz: Array) -> Array:
    """Colours (N, 3) of places, 20 to 235, in waves as long as the object."""
    phase = np.array([[6.0, 1.0, 2.0], [-1.0, 7.0, 3.0], [2.0, -2.0, 6.5]])
    return np.asarray(127.5 + 107.0 * np.sin(xyz @ phase + [0.0, 1.0, 2.0]))


def photographs_of(grid: CellGrid, colors: Pixels) -> tuple[list[Silhouette], list[Pixels]]:
    """Exact ones of cells with colours (NUM^3, 3)."""
    silhouettes, pictures = [], []
    for view in VIEWS:
        seen = shown_cells(grid, view)
        silhouettes.append(Silhouette(np.where(seen >= 0, np.float32(0.5), np.float32(-0.5))))
        pictures.append(np.where((seen >= 0)[..., None], colors[seen], np.uint8(255)).astype(np.uint8))
    return silhouettes, pictures


def cell_colors() -> Pixels:
    places = np.stack(np.meshgrid(*[np.arange(NUM)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(paint(-1.0 + (places + 0.5) * 2.0 / NUM).astype(np.uint8))


def test_two_scenes_make_the_same_photographs_and_the_larger_one_is_found() -> None:
    # one colour in the trough, and its paint elsewhere
    colors = cell_colors()
    places = np.stack(np.meshgrid(*[np.arange(NUM)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    colors[(np.abs(places - (NUM - 1) / 2.0)[:, :2] < 8.0).all(axis=1)] = (120, 90, 60)
    scene = cells_of(TROUGH)
    silhouettes, pictures = photographs_of(scene, colors)
    found, _ = carve_by_color(cells_of(box((1.0, 1.0, 1.0))), VIEWS, silhouettes, pictures, EXACT, threads=2)
    # another shape, whose photographs are the same to the last bit
    for view, picture in zip(VIEWS, pictures, strict=True):
        assert (found.photograph(view, SKY) == picture).all()
    assert (found.grid.filled >= scene.filled).all()
    assert found.grid.filled.sum() > 1.1 * scene.filled.sum()
    # and carving it once more leaves it: it is the largest one
    again, report = carve_by_color(found.grid, VIEWS, silhouettes, pictures, EXACT)
    assert report.rounds == 0
    assert (again.grid.filled == found.grid.filled).all()


def test_a_painted_hollow_is_found_and_nothing_of_the_object_is_lost() -> None:
    scene, full = cells_of(TROUGH), cells_of(box((0.7, 0.7, 0.5)))
    silhouettes, pictures = photographs_of(scene, cell_colors())
    one, _ = carve_by_color(full, VIEWS, silhouettes, pictures, EXACT)
    two, report = carve_by_color(full, VIEWS, silhouettes, pictures, EXACT, threads=2)
    assert (one.grid.filled == two.grid.filled).all()
    assert (one.rgb == two.rgb).all()
    assert (one.grid.filled >= scene.filled).all()
    # what one pixel alone shows, or none, stays
    assert report.num_before - report.num_after > 0.6 * (int(full.filled.sum()) - int(scene.filled.sum()))


def photograph(view: View, solid: Solid, seed: int, waves: float) -> tuple[Pixels, Silhouette]:
    """A painted solid before white as rays through the middles of pixels see it, with noise; so many waves."""
    assert view.camera is not None
    assert view.cam_from_world is not None
    xy = pixel_centers(view)
    away = shown_depth(view, solid, xy)
    hit = np.isfinite(away)
    rays = pixels_to_rays(view.camera, xy[hit]) @ rigid3.rotation_matrix(view.cam_from_world)
    color = np.full((len(xy), 3), 255.0)
    color[hit] = paint(waves * (view.center + away[hit, None] * rays))
    color += np.random.default_rng(seed).normal(0.0, 2.0, color.shape)
    picture = np.clip(np.rint(color), 0, 255).astype(np.uint8).reshape(view.height, view.width, 3)
    return picture, silhouette_of(view, solid)


@pytest.mark.parametrize("solid", [TROUGH, without(ball(0.8), ball(0.5, (0.0, 0.0, 0.7)))], ids=["trough", "bowl"])
def test_noise_and_edges_take_little_away(solid: Solid) -> None:
    pictures, silhouettes = zip(*[photograph(view, solid, n, 0.6) for n, view in enumerate(VIEWS)], strict=True)
    full = cells_of(box((0.7, 0.7, 0.5)) if solid is TROUGH else ball(0.8))
    found, _ = carve_by_color(full, VIEWS, silhouettes, pictures, VoxelOptions(apart=25.0), threads=2)
    # what is there as a whole: a cell that the surface passes through may stick out of an outline
    whole = cells_of(lambda xyz: solid(xyz) + np.sqrt(0.75) * full.tree.cell).filled > 0
    taken = (full.filled > 0) & (found.grid.filled == 0) & (cells_of(solid).filled == 0)
    assert (found.grid.filled[whole] == 0).mean() < 1e-3
    assert taken.sum() > 0.2 * ((full.filled > 0) & (cells_of(solid).filled == 0)).sum()


def test_photographs_of_another_size_are_named() -> None:
    full = cells_of(ball(0.8))
    silhouettes, pictures = photographs_of(full, cell_colors())
    with pytest.raises(InputError, match=r"view_000.png: expected a photograph of 120x90 pixels"):
        carve_by_color(full, VIEWS, silhouettes, [picture[:-1] for picture in pictures], EXACT)


# ------------------------------------------------------------------------------------------------ sfmapp carve --colors
CUP = without(box((0.8, 0.6, 0.5)), box((0.6, 0.4, 0.5), (0.0, 0.0, 0.3)))
VOLUME = 1.6 * 1.2 * 1.0 - 1.2 * 0.8 * 0.7


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs of a painted trough from above, with alpha."""
    path = tmp_path_factory.mktemp("painted")
    (path / "images").mkdir()
    views = around(24, 5.0, 160, 120, 50.0)
    for n, view in enumerate(views):
        picture, silhouette = photograph(view, CUP, n, 4.0)
        alpha = np.where(silhouette.inside, np.uint8(255), np.uint8(0))
        cv2.imwrite(str(path / "images" / view.name), np.dstack([picture[..., ::-1], alpha]))
    write_cameras(path, views)
    return path


@pytest.fixture(scope="module")
def carved(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("carved") / "out"
    assert main(["carve", str(folder), "-o", str(out), "--cells", "64", "--no-recording", "-q", "--colors"]) == 0
    return out


def test_colors_hollow_out_what_silhouettes_leave_full(carved: Path) -> None:
    report = json.loads((carved / "report.json").read_text())
    assert report["sights"]["num_maps"] >= 12
    assert report["joining"]["hull_volume"] > 1.5 * VOLUME
    assert 0.95 * VOLUME < report["surface"]["volume"] < 1.35 * VOLUME
    left = grid_of(read_octree(carved / "octree_colors.npz"))
    xyz = np.random.default_rng(5).uniform(-0.8, 0.8, (40000, 3))
    deep, hollow = 2.0 * left.tree.cell, box((0.6, 0.4, 0.35), (0.0, 0.0, 0.15))
    assert left.holds(xyz[CUP(xyz) < -deep]).mean() > 0.98
    assert left.holds(xyz[hollow(xyz) < -deep]).mean() < 0.3
    # painted alike from everywhere: photographs that look from far apart differ little more than neighbours
    differences = {row["from_deg"]: row["levels"] for row in report["colors"]["differences"]}
    assert differences[15.0] < 40.0


def test_colors_that_were_stopped_go_on_to_the_same_bytes(folder: Path, carved: Path, tmp_path: Path) -> None:
    what, options = CarveInput(folder, by_colors=True), sfmapp.load_options(settings=["carve.cells=64"])
    events = sfmapp.Events()

    def stop(event: sfmapp.Event) -> None:
        if event.kind == "advanced" and event.stage == "join":
            events.cancel()

    events.subscribe(stop)
    with pytest.raises(sfmapp.InterruptedRunError):
        carve(what, tmp_path / "out", options, record=False, events=events)
    assert not (tmp_path / "out" / "mesh.ply").exists()
    found = carve(what, tmp_path / "out", options, record=False)
    assert "sights" not in found.report.usage
    for name in ("mesh.ply", "octree_colors.npz", "sights.npz"):
        assert (tmp_path / "out" / name).read_bytes() == (carved / name).read_bytes()
    # a file that was cut off is made again
    (tmp_path / "out" / "sights.npz").write_bytes((carved / "sights.npz").read_bytes()[:1000])
    found = carve(what, tmp_path / "out", options, record=False)
    assert "sights" in found.report.usage
    assert (tmp_path / "out" / "mesh.ply").read_bytes() == (carved / "mesh.ply").read_bytes()


def test_colors_that_were_stopped_at_their_exchange_leave_nothing_half_done(
    folder: Path, carved: Path, tmp_path: Path
) -> None:
    what, options = CarveInput(folder, by_colors=True), sfmapp.load_options(settings=["carve.cells=64"])
    events, told = sfmapp.Events(), []

    def stop(event: sfmapp.Event) -> None:
        if event.kind in ("started", "advanced") and event.stage == "sights":
            told.append(event)
            if len(told) > 1 + told[0].total // 2:
                events.cancel()

    events.subscribe(stop)
    with pytest.raises(sfmapp.InterruptedRunError):
        carve(what, tmp_path / "out", options, record=False, events=events)
    assert len(told) < 1 + told[0].total
    assert not (tmp_path / "out" / "sights.npz").exists()
    found = carve(what, tmp_path / "out", options, record=False)
    assert "sights" in found.report.usage
    for name in ("mesh.ply", "octree_colors.npz", "sights.npz"):
        assert (tmp_path / "out" / name).read_bytes() == (carved / name).read_bytes()


def test_colors_and_patches_are_not_joined(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["carve", str(folder), "-o", str(tmp_path / "out"), "--colors", "--lights", "lights.json", "-q"]
    assert main(command) == 2
    assert "one of --with-dense, --lights and --colors" in capsys.readouterr().err
