"""Space carving: the octree beside a dense grid of numpy, the dinosaur, the bunny beside its mesh.

    SFMAPP_DATA=... python benchmarks/carving.py

The dense grid asks every photograph about the middle of every cell, by the mask's nearest pixel, as tutorials have it;
a better one asks only about cells that are still there. Whether the same cells are kept is told by a third one,
which reads distances between pixels as the octree does. CPU seconds are those of one run on one thread, compiled
kernels loaded; of the dense grids every eighth slab, times eight. The dinosaur is a process of its own from photographs
to the closed surface.
The bunny's hull is held against the mesh that its masks were rendered from.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from machine import RESULTS, ROOT, describe_machine
from sfmapp.carve.box import find_box, tightened
from sfmapp.carve.hull import Hull, hull_of
from sfmapp.carve.isosurface import surface_of
from sfmapp.carve.octree import Octree, codes_of
from sfmapp.carve.options import CarveOptions, MaskOptions
from sfmapp.carve.silhouettes import Silhouette, find_silhouettes
from sfmapp.carve.space_carving import carve, carve_hull
from sfmapp.carve.views import View, project_points
from sfmapp.events import Events
from sfmapp.images.image_set import ImageSet
from sfmapp.pipelines.carve.sources import find_views
from sfmapp.scene.mesh import Mesh
from sfmapp.workspace.options import load_options

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

DATA = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
DINOSAUR, BUNNY = (DATA / name for name in ("oxford-dinosaur", "vacancy-bunny"))
# the bunny's K counts pixel centres at integers, ours at a half
BUNNY_CAMERA = "PINHOLE,258.65,258.25,159.8,128.15"
GRID, FINE, SLAB, SAMPLED, COARSE = 256, 1024, 8, 8, 64
# samples of a pixel along each side where shapes are drawn
SUPER = 8


def load(folder: Path, poses: Path | None = None, camera: str | None = None) -> tuple[list[View], list[Silhouette]]:
    """Views and silhouettes of a folder, as the command finds them."""
    options = load_options(settings=[f"images.camera={camera}"] if camera else [])
    source = find_views(folder, None, poses, options)
    found, _ = find_silhouettes(ImageSet(source.records, ()), source.views, MaskOptions(), Events())
    return list(source.views), found


def surface(tree: Octree, hull: Hull) -> Mesh:
    return surface_of(tree, hull.distance, lambda xyz: hull.normals(xyz, tree.cell))


# ------------------------------------------------------------------------------------------------ beside a dense grid


def dense_grid(
    views: Sequence[View],
    low: Array,
    side: float,
    tell: Callable[[int, Array], Mask],
    *,
    drops: bool,
    every: int = 1,
) -> Mask:
    """(n, n, n) cells whose middles all views show inside, slab by slab, of these every so many; ``drops``: others are
    asked about no more."""
    at = (np.arange(GRID) + 0.5) / GRID * side
    kept = np.zeros((GRID,) * 3, bool)
    for begin in range(0, GRID, SLAB * every):
        grid = np.stack(np.meshgrid(at[begin : begin + SLAB], at, at, indexing="ij"), axis=-1).reshape(-1, 3) + low
        inside = np.ones(len(grid), bool)
        for v, view in enumerate(views):
            asked = np.flatnonzero(inside) if drops else np.arange(len(grid))
            frame = grid[asked] @ view.outer[:, :3].T + view.outer[:, 3]
            pixels = frame[:, :2] / frame[:, 2:] * view.lens_row[:2] + view.lens_row[2:4]
            inside[asked] &= tell(v, pixels)
        kept[begin : begin + SLAB] = inside.reshape(SLAB, GRID, GRID)
    return kept


def nearest(masks: Sequence[Mask]) -> Callable[[int, Array], Mask]:
    def tell(v: int, pixels: Array) -> Mask:
        height, width = masks[v].shape
        x, y = pixels[:, 0].astype(np.int32), pixels[:, 1].astype(np.int32)
        seen = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        return np.asarray(masks[v][np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)] & seen)

    return tell


def between(silhouettes: Sequence[Silhouette]) -> Callable[[int, Array], Mask]:
    """Distances between pixel centres by lines, in the octree's steps of 1 / 64 pixel."""
    scaled = [np.clip(s.distance * np.float32(64.0), -32767.0, 32767.0) for s in silhouettes]
    steps = [np.where(s > 0.0, np.maximum(np.rint(s), 1.0), np.rint(s)) for s in scaled]

    def tell(v: int, pixels: Array) -> Mask:
        height, width = steps[v].shape
        x, y = np.clip(pixels[:, 0] - 0.5, 0.0, width - 1.0), np.clip(pixels[:, 1] - 0.5, 0.0, height - 1.0)
        i, j = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
        x, y, d = x - i, y - j, steps[v]
        upper, lower = d[j, i] + x * (d[j, i + 1] - d[j, i]), d[j + 1, i] + x * (d[j + 1, i + 1] - d[j + 1, i])
        return np.asarray(upper + y * (lower - upper) > 0.0)

    return tell


def kept_cells(tree: Octree, hull: Hull) -> Mask:
    """Finest cells of an octree whose middles are inside."""
    at_surface = tree.surface[hull.distance(tree.centers(tree.surface)) > 0.0]
    codes = np.sort(np.concatenate([tree.finest_full(), at_surface]))
    places = np.stack(np.meshgrid(*[np.arange(2**tree.depth)] * 3, indexing="ij"), axis=-1)
    result = np.zeros((2**tree.depth,) * 3, bool)
    for x in range(len(places)):
        asked = codes_of(places[x].reshape(-1, 3))
        found = np.minimum(np.searchsorted(codes, asked), len(codes) - 1)
        result[x] = (codes[found] == asked).reshape(result.shape[1:])
    return result


def cpu_of(work: Callable[[], Any]) -> tuple[float, Any]:
    begin = time.process_time()
    result = work()
    return time.process_time() - begin, result


def beside_a_grid(views: list[View], silhouettes: list[Silhouette]) -> dict[str, Any]:
    low, side = find_box(views, silhouettes).cube()
    masks, everyone = [s.inside for s in silhouettes], len(views)
    options = CarveOptions(cells=GRID, min_views=everyone)
    carve(views, silhouettes, low, side, options, threads=1)
    ours = min(cpu_of(lambda: carve(views, silhouettes, low, side, options, threads=1))[0] for _ in range(3))
    tree, report = carve(views, silhouettes, low, side, options)
    plain, _ = cpu_of(lambda: dense_grid(views, low, side, nearest(masks), drops=False, every=SAMPLED))
    dropping, _ = cpu_of(lambda: dense_grid(views, low, side, nearest(masks), drops=True, every=SAMPLED))
    same = dense_grid(views, low, side, between(silhouettes), drops=True)
    hull = hull_of(views, silhouettes, min_views=everyone)
    mine = kept_cells(tree, hull)
    fine, fine_report = carve(views, silhouettes, low, side, CarveOptions(cells=FINE, min_views=everyone))
    return {
        "cells": GRID,
        "cpu_s": {"sfmapp": ours, "dense": SAMPLED * plain, "dense, dropping": SAMPLED * dropping},
        "kept": int(mine.sum()),
        "differ": int((mine != same).sum()),
        "levels": [level.looked_at for level in report.levels],
        "questions": report.num_questions,
        "fine_cells": FINE,
        "fine_mb": {
            "sfmapp": (fine.surface.nbytes + sum(codes.nbytes for codes in fine.full)) / 1e6,
            "dense": FINE**3 / 1e6,
            "dense, a bit a cell": FINE**3 / 8e6,
        },
        "fine_share_of_dense": fine_report.share_of_dense,
    }


# ------------------------------------------------------------------------------------------- the dinosaur, as a process


def dinosaur_child(cells: int) -> None:
    begin = time.perf_counter()
    views, silhouettes = load(DINOSAUR)
    masks = time.perf_counter()
    low, side = find_box(views, silhouettes).cube()
    hull = hull_of(views, silhouettes)
    names = [view.name for view in views]
    tree, _ = carve_hull(hull, names, low, side, CarveOptions(cells=cells), Events())
    carved = time.perf_counter()
    mesh = surface(tree, hull)
    told = {"masks_s": masks - begin, "carve_s": carved - masks, "surface_s": time.perf_counter() - carved}
    # before the check, which takes more than what it checks
    told["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0 * 1.048576
    print(json.dumps(told | {"surface_cells": len(tree.surface), "triangles": len(mesh), "closed": is_closed(mesh)}))


def is_closed(mesh: Mesh) -> bool:
    """Each edge is walked once in each direction."""
    a, b = mesh.faces.ravel().astype(np.int64), mesh.faces[:, [1, 2, 0]].ravel().astype(np.int64)
    forth, back = np.sort(a * len(mesh.xyz) + b), np.sort(b * len(mesh.xyz) + a)
    return bool((forth == back).all() and (np.diff(forth) > 0).all())


def dinosaur(cells: int) -> dict[str, Any]:
    begin = time.perf_counter()
    words = [sys.executable, __file__, "--dinosaur", str(cells)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        told = child.stdout.read()
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise RuntimeError(f"the dinosaur ended with {child.returncode}")
    return {
        "cells": cells,
        "load": os.getloadavg()[0],
        "wall_s": time.perf_counter() - begin,
        "cpu_s": used.ru_utime + used.ru_stime,  # with the check
        **json.loads(told.splitlines()[-1]),
    }


# ------------------------------------------------------------------------------------------------------------ the bunny


def read_ply(path: Path) -> tuple[Array, NDArray[np.int64]]:
    lines = path.read_text(encoding="ascii").splitlines()
    counts = [int(line.split()[2]) for line in lines if line.startswith("element")]
    body = lines[lines.index("end_header") + 1 :]
    xyz = np.array([line.split() for line in body[: counts[0]]], float)
    return xyz, np.array([line.split()[1:] for line in body[counts[0] : sum(counts)]], int)


def shown(view: View, xyz: Array, faces: NDArray[Any], off: float = 0.0) -> Mask:
    """(H, W) pixels whose centres, moved by ``off`` along u and v, show a mesh."""
    pixels = np.empty((len(xyz), 3))
    project_points(view.row, np.ascontiguousarray(xyz, float), pixels)
    drawn = np.zeros((view.height * SUPER, view.width * SUPER), np.uint8)
    fine = np.round((pixels[:, :2] - off) * SUPER * 256.0 - 128.0).astype(np.int32)
    for corners in fine[faces]:
        cv2.fillConvexPoly(drawn, corners, 255, cv2.LINE_8, 8)
    middle = SUPER // 2
    return np.asarray(drawn[middle::SUPER, middle::SUPER] > 0)


def iou(a: Mask, b: Mask) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def bunny() -> dict[str, Any]:
    views, silhouettes = load(BUNNY, BUNNY / "tumpose.txt", BUNNY_CAMERA)
    xyz, faces = read_ply(BUNNY / "GT.ply")
    box, hull = find_box(views, silhouettes), hull_of(views, silhouettes)
    coarse, _ = carve(views, silhouettes, *box.cube(), CarveOptions(cells=COARSE))
    low, side = tightened(box, coarse).cube()
    runs = []
    for cells in (None, FINE // 2):
        tree, told = carve(views, silhouettes, low, side, CarveOptions(cells=cells))
        mesh = surface(tree, hull)
        fits = [iou(shown(v, mesh.xyz, mesh.faces), s.inside) for v, s in zip(views, silhouettes, strict=True)]
        runs.append(
            {
                "cells": told.cells,
                "asked": cells is not None,
                "cell_mm": tree.cell,
                "iou": fits,
                "closed": is_closed(mesh),
            }
        )
    outside = -hull.distance(xyz)
    return {
        "runs": runs,
        "outside_mm": {"max": float(outside.max()), "share": float((outside > 0.0).mean())},
        # the mesh itself against the masks, with pixel centres as the source's K has them and half a pixel off
        "mesh_iou": [iou(shown(v, xyz, faces), s.inside) for v, s in zip(views, silhouettes, strict=True)],
        "mesh_iou_half_a_pixel_off": [
            iou(shown(v, xyz, faces, 0.5), s.inside) for v, s in zip(views, silhouettes, strict=True)
        ],
    }


# -------------------------------------------------------------------------------------------------------------- results


def markdown(report: dict[str, Any]) -> str:
    grid, bunny_told = report["grid"], report["bunny"]
    lines = [
        "# Space carving",
        "",
        f"{report['date']}, {report['commit']}, {report['cpu']}. How it is measured: `benchmarks/carving.py`.",
        "",
        f"## Octree and dense grid, the dinosaur's 36 silhouettes, {grid['cells']} cells along the side",
        "",
        "| | CPU, s | times ours |",
        "|---|---|---|",
        *(f"| {name} | {s:.2f} | {s / grid['cpu_s']['sfmapp']:.1f} |" for name, s in grid["cpu_s"].items()),
        "",
        f"{grid['kept']} cells kept; {grid['differ']} differ from the dense grid that reads distances as the octree "
        f"does. Cells looked at, level by level: {', '.join(map(str, grid['levels']))}; views were asked "
        f"{grid['questions']} times.",
        "",
        f"At {grid['fine_cells']} cells, MB: "
        + ", ".join(f"{name} {mb:.1f}" for name, mb in grid["fine_mb"].items())
        + f"; {100 * grid['fine_share_of_dense']:.2f} % of a grid's cells were looked at.",
        "",
        "## The dinosaur, from photographs to its closed surface, a process of its own",
        "",
        f"Wall times on two cores that {report['dinosaur'][0]['load']:.0f} other processes shared.",
        "",
        "| cells | wall, s | CPU, s | peak, MB | silhouettes, s | box, carving, s | surface, s | triangles | closed |",
        "|---|---|---|---|---|---|---|---|---|",
        *map(dinosaur_line, report["dinosaur"]),
        "",
        "## The bunny, six masks",
        "",
        "| cells | a cell, mm | farthest vertex outside, cells | IoU of silhouettes, least | mean | closed |",
        "|---|---|---|---|---|---|",
        *(
            f"| {r['cells']}{'' if r['asked'] else ', by default'} | {r['cell_mm']:.2f} | "
            f"{bunny_told['outside_mm']['max'] / r['cell_mm']:.2f} | {min(r['iou']):.4f} | {np.mean(r['iou']):.4f} | "
            f"{'yes' if r['closed'] else 'NO'} |"
            for r in bunny_told["runs"]
        ),
        "",
        f"The true mesh's vertex that is farthest outside the hull: {bunny_told['outside_mm']['max']:.2f} mm "
        f"({100 * bunny_told['outside_mm']['share']:.1f} % of them are outside at all; outlines of whole pixels are "
        "told to half of one, 1.45 mm). "
        f"Projected, the mesh fits the masks to {min(bunny_told['mesh_iou']):.4f} to {max(bunny_told['mesh_iou']):.4f} "
        "with pixel centres at integers, as the source's principal point counts them, and to "
        f"{min(bunny_told['mesh_iou_half_a_pixel_off']):.4f} to {max(bunny_told['mesh_iou_half_a_pixel_off']):.4f} "
        "half a pixel off.",
    ]
    return "\n".join(lines) + "\n"


def dinosaur_line(run: dict[str, Any]) -> str:
    first = (
        f"| {run['cells']} | {run['wall_s']:.1f} | {run['cpu_s']:.1f} | {run['peak_mb']:.0f} | {run['masks_s']:.1f} | "
    )
    closed = "yes" if run["closed"] else "NO"
    return first + f"{run['carve_s']:.1f} | {run['surface_s']:.1f} | {run['triangles']} | {closed} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "carving.json")
    parser.add_argument("--dinosaur", type=int, metavar="CELLS", help=argparse.SUPPRESS)
    parser.add_argument("--only", choices=("grid", "dinosaur", "bunny"), help="do the others again later")
    args = parser.parse_args()
    if args.dinosaur is not None:
        dinosaur_child(args.dinosaur)
        return
    parts: dict[str, Callable[[], Any]] = {
        "dinosaur": lambda: [dinosaur(cells) for cells in (512, 2048)],
        "bunny": bunny,
        "grid": lambda: beside_a_grid(*load(DINOSAUR)),
    }
    report = json.loads(args.output.read_text()) if args.only and args.output.is_file() else {}
    report |= describe_machine()
    for name, measure in parts.items():
        if args.only in (None, name):
            report[name] = measure()
            print(name, json.dumps(report[name])[:600], flush=True)
    args.output.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    if all(name in report for name in parts):
        args.output.with_suffix(".md").write_text(markdown(report), encoding="utf-8")
        print(markdown(report))


if __name__ == "__main__":
    main()
