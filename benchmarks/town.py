"""Reconstructions of a rendered town at growing sizes: what each photograph costs, and how far the cameras are off.

    python benchmarks/town.py --peer                             # 100 and 300 photographs, matches of 100 to 1,000
    python benchmarks/town.py --photographs 1000 --width 1152    # of one megapixel

``photographs``: pictures are rendered once (``--work`` keeps them), then ``sfmapp reconstruct`` runs on the first of
them with default options. ``matches``: mapping alone, on matches that are made from the town without pictures
(``town_matches.py``). The peer is pycolmap's incremental mapper on our database, whose matches it takes as they are.
Errors are rms distances of centres after a similarity, as shares of the diagonal of the walk. An output that is there
goes on; rows of the same part and size are replaced.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from machine import RESULTS, ROOT, describe_machine
from rendered_worlds.rendering import Renderer
from rendered_worlds.towns import camera, town_world, walk
from sfmapp.evaluation.measured import high_water_mark_mb
from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.formats.colmap import read_model
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction

STAGES = ("features", "pairs", "matching", "mapping")


def name_of(view: int) -> str:
    """The file of a view."""
    return f"view_{view:05d}.jpg"


def render(folder: Path, num_views: int, width: int) -> None:
    """The pictures of the first views that are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    missing = [view for view in range(num_views) if not (folder / name_of(view)).exists()]
    if not missing:
        return
    renderer, way = Renderer(town_world(), camera(width)), walk(num_views)

    def one(view: int) -> None:
        cv2.imwrite(str(folder / name_of(view)), way.photograph(renderer, view), [cv2.IMWRITE_JPEG_QUALITY, 93])

    one(missing[0])  # which inverts the lens
    with ThreadPoolExecutor() as pool:
        list(pool.map(one, missing[1:]))


def errors(model: Reconstruction, num_views: int) -> dict[str, Any]:
    """Of the cameras of a model."""
    truth = walk(num_views).cam_from_world
    centers = rigid3.center(truth)
    size = float(np.linalg.norm(np.ptp(centers, axis=0)))
    names = [name_of(view) for view in range(num_views)]
    found = evaluate_poses(model.image_names, model.cam_from_world, names, truth).summary()
    assert found.center_error is not None
    assert found.rotation_error_deg is not None
    return {
        "registered": found.num_common, "size_m": size, "ate_share": found.center_error.rmse / size,
        "worst_m": found.center_error.max, "rotation_deg": found.rotation_error_deg.rmse,
    }  # fmt: skip


def measure_photographs(num_views: int, width: int, work: Path) -> dict[str, Any]:
    """A whole run on the first views."""
    pictures = work / f"images {width}"
    render(pictures, num_views, width)
    listed, out = work / f"{num_views}.txt", output_of(num_views, width, work)
    listed.write_text("".join(f"{pictures / name_of(view)}\n" for view in range(num_views)))
    command = [sys.executable, "-m", "sfmapp", "reconstruct", str(listed), "-o", str(out), "--no-recording", "-q"]
    subprocess.run(command, check=True)
    report = json.loads((out / "report.json").read_text())
    model, _ = read_model(out / "sparse/0")
    usage, run = report["usage"], report["run"]
    return {
        "part": "photographs", "program": "sfmapp", "views": num_views, "width": width, **errors(model, num_views),
        "cpu_s": {stage: usage[stage]["cpu_s"] for stage in STAGES}, "wall_s": run["wall_s"],
        "pairs": report["stages"]["pairs"]["num_pairs"],
        "peak_mb": run["peak_memory_mb"], "models": len(report["models"]),
        "contradictions": [one["subject"] for one in report["models"][0]["contradictions"]],
    }  # fmt: skip


def output_of(num_views: int, width: int, work: Path) -> Path:
    """Where the run on the first views is."""
    return work / f"out {width} {num_views}"


def measure_matches(num_views: int) -> dict[str, Any]:
    """Mapping on matches that were made without pictures; in a process of its own."""
    from sfmapp.adjust.options import AdjustOptions
    from sfmapp.camera.camera import Camera
    from sfmapp.camera.names import CameraModel
    from sfmapp.events import Events
    from sfmapp.images.image_set import ImageRecord, ImageSet
    from sfmapp.mapping.incremental import map_images
    from sfmapp.mapping.options import MappingOptions
    from sfmapp.workspace.kernels import MODULES
    from town_matches import features_of, match, sight

    way, lens = walk(num_views), camera(640)
    sighted = sight(town_world(), way, lens.width)
    found, features = match(sighted, way, lens), features_of(sighted)
    unknown = Camera(CameraModel.SIMPLE_RADIAL, lens.width, lens.height, np.array([1.2 * 640, 320.0, 240.0, 0.0]))
    records = [ImageRecord(name_of(i), Path(name_of(i)), lens.width, lens.height) for i in range(num_views)]
    for module in MODULES:
        import_module(module).compile_kernels()
    begin, wall = time.process_time(), time.perf_counter()
    models, report = map_images(
        ImageSet(tuple(records), (unknown,)), features, found, MappingOptions(), adjust_options=AdjustOptions(),
        threads=2, events=Events(),
    )  # fmt: skip
    cpu = time.process_time() - begin
    return {
        "part": "matches", "program": "sfmapp", "views": num_views, "width": lens.width,
        **errors(models[0], num_views), "cpu_s": {"mapping": cpu}, "wall_s": time.perf_counter() - wall,
        "pairs": found.num_pairs, "observations": models[0].tracks.num_observations,
        "peak_mb": high_water_mark_mb(), "models": len(models),
        "contradictions": [one.subject for one in report.models[0].contradictions],
    }  # fmt: skip


def measure_peer(num_views: int, width: int, work: Path) -> dict[str, Any]:
    """pycolmap's incremental mapper on the database of our run; in a process of its own."""
    import pycolmap

    database = output_of(num_views, width, work) / "database.db"
    with tempfile.TemporaryDirectory() as folder:
        pycolmap.set_random_seed(0)
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = 0
        begin, wall = time.process_time(), time.perf_counter()
        found = pycolmap.incremental_mapping(database, work / f"images {width}", folder, options)
        cpu, wall = time.process_time() - begin, time.perf_counter() - wall
        largest = max(found.values(), key=lambda model: model.num_reg_images())
        largest.write(folder)
        model, _ = read_model(Path(folder))
    return {
        "part": "photographs", "program": "pycolmap", "views": num_views, "width": width, **errors(model, num_views),
        "cpu_s": {"mapping": cpu}, "wall_s": wall, "peak_mb": high_water_mark_mb(), "models": len(found),
    }  # fmt: skip


def in_child(*arguments: object) -> dict[str, Any]:
    """What this script measures in a process of its own."""
    command = [sys.executable, __file__, "--child", *map(str, arguments)]
    made = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    row: dict[str, Any] = json.loads(made.stdout.splitlines()[-1])
    return row


def markdown(report: dict[str, Any]) -> str:
    """A row for each run."""
    where = f"{report['date'][:10]}, commit {report['commit']}, {report['cpu']}, {report['cores']} cores."
    lines = [
        "# A rendered town", "",
        f"{where} ATE: rms of centres, as a share of the diagonal of the walk. The peer maps from our database.", "",
        "| from | program | views | width | registered (models) | size, m | ATE, % | worst, m | rotation, deg | pairs "
        "| CPU ms a view: features | matching | mapping | peak MB | red for |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in report["rows"]:
        cost = {stage: f"{1000 * s / row['views']:.1f}" for stage, s in row["cpu_s"].items()}
        lines.append(
            f"| {row['part']} | {row['program']} | {row['views']} | {row['width']} | {row['registered']} "
            f"({row['models']}) | {row['size_m']:.0f} | {100 * row['ate_share']:.4f} | {row['worst_m']:.3f} "
            f"| {row['rotation_deg']:.3f} | {row.get('pairs', '')} | {cost.get('features', '')} "
            f"| {cost.get('matching', '')} | {cost['mapping']} | {row['peak_mb']:.0f} "
            f"| {', '.join(row.get('contradictions', []))} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photographs", type=int, nargs="*", default=[100, 300])
    parser.add_argument("--matches", type=int, nargs="*", default=[100, 300, 1000])
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--peer", action="store_true", help="pycolmap's mapper on the databases of the photographs")
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "town", help="keeps pictures and runs")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "town.json")
    parser.add_argument("--child", nargs="+", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        kind, views, *others = arguments.child
        given = (int(views), int(others[0]), Path(others[1])) if others else (int(views),)
        print(json.dumps({"matches": measure_matches, "peer": measure_peer}[kind](*given)))  # type: ignore[operator]
        return
    report: dict[str, Any] = {"rows": []}
    if arguments.output.exists():
        report = json.loads(arguments.output.read_text(encoding="utf-8"))
    report |= describe_machine()

    def keep(row: dict[str, Any]) -> None:
        def key(other: dict[str, Any]) -> tuple[Any, ...]:
            return other["part"], other["program"], other["width"], other["views"]

        report["rows"] = sorted([other for other in report["rows"] if key(other) != key(row)] + [row], key=key)
        print(json.dumps(row), flush=True)
        arguments.output.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        arguments.output.with_suffix(".md").write_text(markdown(report), encoding="utf-8")

    for num_views in arguments.photographs:
        keep(measure_photographs(num_views, arguments.width, arguments.work))
        if arguments.peer:
            keep(in_child("peer", num_views, arguments.width, arguments.work))
    for num_views in arguments.matches:
        keep(in_child("matches", num_views))


if __name__ == "__main__":
    main()
