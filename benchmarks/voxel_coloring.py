"""Carving by colours against the coloured hull: how well either shows photographs that were not used.

    SFMAPP_DATA=... python benchmarks/voxel_coloring.py         # lego, and solids rendered with hollows
    python benchmarks/voxel_coloring.py --only jug

Hull and carved volume are drawn alike: closed surfaces with a colour at each vertex by `carve/coloring.py`, seen twice
as fine as the photograph and averaged; or cells with their mean colours. Every eighth of a solid's photographs is held
out, and every fourth of the temple's. The cell by which outlines are trusted was found on the lego's test views, and
that the hull counts as one sight on these, the house, the jug and the first two that were drawn; the temple and the
other three chose nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from carving_joined import SOLIDS, Case, lego_case, scene_of, solid_case
from machine import RESULTS, ROOT, describe_machine
from plane_sweep import lego_views
from rendered_worlds.lit_solids import drawn as drawn_solid
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.carve.box import find_box
from sfmapp.carve.cell_grid import CellGrid, grid_of
from sfmapp.carve.coloring import color_surface
from sfmapp.carve.hull import hull_of
from sfmapp.carve.isosurface import surface_of
from sfmapp.carve.joined import Evidence, join
from sfmapp.carve.options import CarveOptions, MaskOptions
from sfmapp.carve.rendering import show_mesh
from sfmapp.carve.silhouettes import find_silhouettes
from sfmapp.carve.space_carving import carve_hull
from sfmapp.carve.swept_sights import sights_by_colors
from sfmapp.carve.views import View, view_of_camera
from sfmapp.carve.voxel_coloring import VoxelOptions, carve_by_color
from sfmapp.dense.scene import DenseView
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.images.image_set import ImageSet
from sfmapp.images.pixels import read_rgb
from sfmapp.pipelines.carve.colors import JOIN
from sfmapp.pipelines.carve.sources import find_views
from sfmapp.scene.mesh import Mesh
from sfmapp.workspace.options import load_options

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]
DATA = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
HELD_OUT, TEMPLE_HELD_OUT = 8, 4
FINER = 2
CELLS, SOLID_CELLS, VOXEL_CELLS = 256, 128, 128
# drawn after everything was chosen, and looked at once
FRESH = {f"drawn {seed}": seed for seed in (3, 4, 5)}
# no difference is as large: nothing is taken away but what sticks out of a silhouette
NEVER = 1e6
# grey levels that colours of one place may deviate by
APART = 25.0


@dataclass(frozen=True)
class Held:
    """Photographs that were not used: views, pictures before a background."""

    views: list[View]
    pictures: list[Pixels]
    background: int


def split(case: Case) -> tuple[Case, Held]:
    """The case without the photographs that are held out; of the lego these are its test views."""
    if case.name == "lego":
        tests, _ = lego_views("test_cameras.json", 1.0)
        return case, Held([view_of(view) for view in tests], [view.rgb for view in tests], 255)
    each = HELD_OUT if case.solid is not None else TEMPLE_HELD_OUT
    kept = [v for v in range(len(case.views)) if v % each]
    held = Held(case.views[::each], [view.rgb for view in case.scene.views[::each]], 0)
    scene = replace(case.scene, views=tuple(case.scene.views[v] for v in kept))
    views, silhouettes = ([given[v] for v in kept] for given in (case.views, case.silhouettes))
    return replace(case, scene=scene, views=views, silhouettes=silhouettes), held


def temple_case() -> Case:
    """The temple's sparse ring: 16 photographs before black, silhouettes as the command finds them."""
    source = find_views(DATA / "temple-sparse-ring", None, None, load_options())
    views = list(source.views)
    silhouettes, _ = find_silhouettes(ImageSet(source.records, ()), views, MaskOptions(), Events())
    scene = []
    for view, record, silhouette in zip(views, source.records, silhouettes, strict=True):
        assert view.camera is not None
        assert view.cam_from_world is not None
        k = view.camera.k_matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        scene.append(DenseView(view.name, read_rgb(record), silhouette.inside, k, view.cam_from_world))
    low, side = find_box(views, silhouettes).cube()
    return Case("temple", scene_of(scene), views, silhouettes, low, side, np.zeros((0, 3)), None, None)


def view_of(view: DenseView) -> View:
    camera = Camera(CameraModel.PINHOLE, view.width, view.height, view.k)
    return view_of_camera(view.name, camera, view.cam_from_world)


def drawn(view: View, mesh: Mesh, background: int) -> Array:
    """(H, W, 3) what a view shows of a mesh with colours at its vertices."""
    assert view.camera is not None
    assert view.cam_from_world is not None
    fine = Camera(CameraModel.PINHOLE, FINER * view.width, FINER * view.height, FINER * view.camera.params)
    shown = show_mesh(view_of_camera(view.name, fine, view.cam_from_world), mesh.xyz, mesh.faces)
    picture = np.full((*shown.depth.shape, 3), float(background))
    row, column = np.nonzero(shown.face >= 0)
    corners, depth = mesh.faces[shown.face[row, column]], shown.depth[row, column].astype(np.float64)
    fx, fy, cx, cy = fine.params
    at = np.stack([(column + 0.5 - cx) / fx * depth, (row + 0.5 - cy) / fy * depth, depth], axis=1)
    a, b, c = (rigid3.apply(view.cam_from_world, mesh.xyz)[corners[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    square = (normal**2).sum(axis=1)
    first = (np.cross(b - at, c - at) * normal).sum(axis=1) / square
    second = (np.cross(c - at, a - at) * normal).sum(axis=1) / square
    shares = np.clip(np.stack([first, second, 1.0 - first - second], axis=1), 0.0, 1.0)
    shares /= shares.sum(axis=1, keepdims=True)
    picture[row, column] = (shares[..., None] * mesh.rgb[corners]).sum(axis=1)
    return np.asarray(cv2.resize(picture, (view.width, view.height), interpolation=cv2.INTER_AREA))


def psnr(picture: NDArray[np.generic], truth: Pixels) -> float:
    return float(10.0 * np.log10(255.0**2 / np.mean((picture.astype(np.float64) - truth) ** 2)))


def surfaces(case: Case, held: Held, cells: int) -> Iterator[dict[str, Any]]:
    """The hull's surface, and that of hull and colours together, as ``sfmapp carve`` and ``--colors`` make them."""
    photographs = [view.rgb for view in case.scene.views]
    begin = time.process_time()
    hull = hull_of(case.views, case.silhouettes)
    names = [view.name for view in case.views]
    tree, _ = carve_hull(hull, names, case.low, case.side, CarveOptions(cells=cells), Events(), threads=2)
    mesh = surface_of(tree, hull.distance)
    yield row(case, "hull", mesh, tree.cell, held, photographs, time.process_time() - begin)
    sights, report = sights_by_colors(case.scene.views, tree.centers(tree.surface), threads=2)
    joined, _ = join(
        Evidence(case.views, case.silhouettes, hull, sights), case.low, case.side, cells, JOIN, threads=2
    )  # fmt: skip
    mesh = surface_of(joined.tree, joined.distance)
    found = row(case, "colors", mesh, tree.cell, held, photographs, time.process_time() - begin)
    yield found | {"known_share": report.known_share}


def row(
    case: Case, way: str, mesh: Mesh, cell: float, held: Held, photographs: Sequence[Pixels], cpu_s: float
) -> dict[str, Any]:  # fmt: skip
    rgb, report = color_surface(mesh, cell, case.views, case.silhouettes, lambda v: photographs[v], threads=2)
    mesh = Mesh(mesh.xyz, mesh.faces, mesh.normal, rgb)
    scores = [
        psnr(drawn(view, mesh, held.background), truth)
        for view, truth in zip(held.views, held.pictures, strict=True)
    ]  # fmt: skip
    told: dict[str, Any] = {
        "case": case.name, "drawn": "surface", "way": way, "cells": round(case.side / cell), "psnr": np.mean(scores),
        "psnr_by_view": scores, "iou": np.mean([fit.iou for fit in report.views]), "cpu_s": cpu_s,
        "differences": [dict(difference) for difference in report.differences],
    }  # fmt: skip
    if case.solid is not None:
        a, b, c = (mesh.xyz[mesh.faces[:, k]] for k in range(3))
        told["volume_error"] = float((a * np.cross(b, c)).sum() / 6.0) / case.solid.volume() - 1.0
    return told


def voxels(case: Case, held: Held) -> Iterator[dict[str, Any]]:
    """Cells of the hull in colours, and of what voxel colouring leaves of it."""
    photographs = [view.rgb for view in case.scene.views]
    hull = hull_of(case.views, case.silhouettes)
    names, options = [view.name for view in case.views], CarveOptions(cells=VOXEL_CELLS)
    tree, _ = carve_hull(hull, names, case.low, case.side, options, Events(), threads=2)
    grid = grid_of(replace(tree, surface=tree.surface[hull.distance(tree.centers(tree.surface)) > 0.0]))
    for way, apart in (("hull", NEVER), ("voxel colouring", APART)):
        begin = time.process_time()
        found, report = carve_by_color(
            grid, case.views, case.silhouettes, photographs, VoxelOptions(apart=apart), threads=2
        )  # fmt: skip
        cpu_s = time.process_time() - begin
        pictures = [found.photograph(view, (held.background,) * 3) for view in held.views]
        scores = [psnr(picture, truth) for picture, truth in zip(pictures, held.pictures, strict=True)]
        told: dict[str, Any] = {
            "case": case.name, "drawn": "cells", "way": way, "cells": VOXEL_CELLS, "psnr": np.mean(scores),
            "psnr_by_view": scores, "rounds": report.rounds, "cpu_s": cpu_s, "volume": found.grid.volume,
        }  # fmt: skip
        if case.solid is not None:
            told["volume_error"] = found.grid.volume / case.solid.volume() - 1.0
            told["lost_share"] = lost_share(case, found.grid)
        yield told


def lost_share(case: Case, grid: CellGrid) -> float:
    """Of the cells in the middle of which the solid is at least a cell deep, those that are gone."""
    assert case.solid is not None
    places = np.argwhere(np.ones(grid.filled.shape, bool))
    true = case.solid.distance(grid.low + (places + 0.5) * grid.tree.cell) < -grid.tree.cell
    return float((grid.filled.ravel()[true] == 0).mean())


def markdown(report: dict[str, Any]) -> str:
    lines = [
        "# Carving by colours", "",
        f"`benchmarks/voxel_coloring.py`; sfmapp at {report['commit']}; {report['cpu']}, {report['date']}.", "",
        "| object | drawn as | cells | way | PSNR of unused photographs, dB | over the hull | IoU of silhouettes | "
        "volume | true cells lost | CPU s | at |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for run in report["runs"]:
        hull = next(
            r for r in report["runs"] if (r["case"], r["drawn"], r["way"]) == (run["case"], run["drawn"], "hull")
        )  # fmt: skip
        gain = "" if run is hull else f"{run['psnr'] - hull['psnr']:+.2f}"
        iou = f"{run['iou']:.3f}" if "iou" in run else ""
        volume = f"{run['volume_error']:+.1%}" if "volume_error" in run else ""
        lost = f"{run['lost_share']:.2%}" if "lost_share" in run else ""
        lines.append(
            f"| {run['case']} | {run['drawn']} | {run['cells']} | {run['way']} | {run['psnr']:.2f} | {gain} | {iou} | "
            f"{volume} | {lost} | {run['cpu_s']:.0f} | {run['commit']} |"
        )
    lines += ["", "Grey levels by which photographs of one place differ, by the degrees between their directions:", ""]
    for run in report["runs"]:
        if run.get("differences"):
            told = ", ".join(f"{d['from_deg']:.0f} to {d['to_deg']:.0f}: {d['levels']:.1f}" for d in run["differences"])
            lines.append(f"- {run['case']}, {run['way']}: {told}")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", default="", help="objects whose names begin with this; others keep their results")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "voxel_coloring.json")
    args = parser.parse_args()
    runs = json.loads(args.output.read_text())["runs"] if args.output.is_file() else []
    report: dict[str, Any] = describe_machine()
    order = ["lego", "temple", *SOLIDS, *FRESH]
    cases = {"lego": lambda: lego_case(Path(folder)), "temple": temple_case}
    names = [name for name in order if name.startswith(args.only)]
    with tempfile.TemporaryDirectory(prefix="colors-") as folder:
        for name in names:
            solid = drawn_solid(FRESH[name]) if name in FRESH else None
            case, held = split(cases[name]() if name in cases else solid_case(name, solid))
            runs = [old for old in runs if old["case"] != name]
            for measured in (surfaces(case, held, CELLS if name in cases else SOLID_CELLS), voxels(case, held)):
                for run in measured:
                    runs.append(run | {"commit": report["commit"]})
                    print(json.dumps(run, default=float), file=sys.stderr, flush=True)
    report["runs"] = sorted(runs, key=lambda run: order.index(run["case"]))
    args.output.write_text(json.dumps(report, indent=1, default=float) + "\n")
    args.output.with_suffix(".md").write_text(markdown(report))
    print(markdown(report), end="")


if __name__ == "__main__":
    main()
