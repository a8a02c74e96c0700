"""Two photographs to patches: by growth alone, by stereo alone, and by both as ``sfmapp dense`` has it.

    python benchmarks/dense_pairs.py            # results/dense_pairs.md

Rendered pairs have exact depths. The truth of a pair of photographs is what four or more of all photographs of its set
agree on, both of the pair among them: places where a window says nothing are missing there. See README.md.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from machine import RESULTS, ROOT, describe_machine
from rendered_worlds.rendering import Optics, Renderer, World
from rendered_worlds.worlds import gallery_world, hall_world, room_world, street_world
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.dense.densify import compile_kernels, densify
from sfmapp.dense.files import read_patches
from sfmapp.dense.maps import splat_view
from sfmapp.dense.options import DenseOptions
from sfmapp.dense.photographs import find_photographs
from sfmapp.dense.prepare import load_scene, part_of, plan_views
from sfmapp.dense.scene import DenseScene, DenseView, Patches
from sfmapp.formats.colmap import read_model
from sfmapp.geometry import rigid3
from sfmapp.pipelines.dense.densify import dense
from sfmapp.pipelines.dense.results import PATCHES
from sfmapp.pipelines.dense.source import find_source
from sfmapp.pipelines.sparse.reconstruct import reconstruct
from sfmapp.stereo.patches import densify_pair, stereo_patches
from sfmapp.workspace.options import Options

Array = NDArray[np.float64]
Truths = list[NDArray[np.float32]]

OPTIONS = DenseOptions(min_views=2)
SIZE, FOCAL, NUM_POINTS = (752, 480), 620.0, 300
# place, the left camera's centre, its heading and tilt, the baseline, and how far the right camera turns inwards
RENDERED = (
    ("room", room_world(1), (1.6, -1.9, 1.5), (120.0, -12.0), 0.2, 3.0),
    ("hall", hall_world(1), (2.0, -5.0, 1.8), (75.0, -8.0), 0.6, 4.0),
    ("hall, wide", hall_world(2), (-2.5, 4.0, 2.2), (-70.0, -12.0), 1.5, 10.0),
    ("street", street_world(1), (-24.0, -1.6, 1.65), (0.0, -1.0), 0.8, 1.0),
    ("gallery, wide", gallery_world(1), (-1.2, -1.5, 1.4), (60.0, -10.0), 0.5, 12.0),
)
PHOTOGRAPHS = (
    ("fountain-P11", (("0004", "0005"), ("0003", "0006"), ("0007", "0009"))),
    (
        "strecha-courtyard-21",
        (("entry_0000", "entry_0001"), ("entry_0005", "entry_0006"), ("entry_0007", "entry_0009")),
    ),
)
# photographs that have to agree on what is true
NUM_TRUE = 4
COLUMNS = ("density", "right", "bad", "median_px", "cpu_s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "dense_pairs.md")
    parser.add_argument("--work", type=Path, help="where models of all photographs are kept, and taken from if there")
    arguments = parser.parse_args()
    output = arguments.output
    cv2.setNumThreads(1)
    data = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
    report: dict[str, Any] = describe_machine()
    compile_kernels()
    densify_pair(rendered(*RENDERED[0][1:])[0], OPTIONS)
    report["pairs"] = [measured(name, *rendered(*case)) for name, *case in RENDERED]
    with tempfile.TemporaryDirectory() as work:
        for name, pairs in PHOTOGRAPHS:
            cases = photographed(data / name / "images", (arguments.work or Path(work)) / name, pairs)
            report["pairs"] += [measured(f"{name}, {pair}", scene, truths) for pair, scene, truths in cases]
    output.with_suffix(".json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    output.write_text(markdown(report), encoding="utf-8")
    print(markdown(report))


def measured(name: str, scene: DenseScene, truths: Truths) -> dict[str, Any]:
    """Each way in numbers."""
    runs = {
        "growth": lambda: densify(scene, OPTIONS)[0],
        "stereo": lambda: stereo_patches(scene),
        "both": lambda: densify_pair(scene, OPTIONS)[0],
    }
    row: dict[str, Any] = {"pair": name}
    for way, run in runs.items():
        start = time.process_time()
        patches = run()
        row[way] = {"cpu_s": time.process_time() - start, **scored(patches, scene, truths)}
    return row


def scored(patches: Patches, scene: DenseScene, truths: Truths) -> dict[str, float]:
    """Shares of the true pixels of both views that are covered, and that are right to a pixel of disparity; of the
    covered ones the share that is not, and the median error. Disparity is that along the baseline, focal length times
    baseline over depth."""
    baseline = float(np.linalg.norm(scene.centers[0] - scene.centers[1]))
    errors, known = [], 0
    for view, truth in zip(scene.views, truths, strict=True):
        depth, _ = splat_view(
            view.k, view.cam_from_world, view.width, view.height, patches.xyz, patches.normal, 1.0
        )  # fmt: skip
        known += int(np.isfinite(truth).sum())
        error = np.abs(1.0 / depth - 1.0 / truth) * view.k[0] * baseline
        errors.append(error[np.isfinite(error)])
    error = np.concatenate(errors)
    return {
        "density": len(error) / known, "right": float((error < 1.0).sum() / known), "bad": float((error >= 1.0).mean()),
        "median_px": float(np.median(error)),
    }  # fmt: skip


def rendered(
    world: World, center: Sequence[float], angles: Sequence[float], baseline: float, toe_deg: float
) -> tuple[DenseScene, Truths]:
    """A pair, three hundred sparse points of it, and true depths where both cameras see."""
    width, height = SIZE
    k = np.array([FOCAL, FOCAL, width / 2, height / 2])
    renderer = Renderer(world, Camera(CameraModel.PINHOLE, width, height, k))
    first = looking(np.asarray(center, np.float64), *angles)
    second_center = np.asarray(center) + baseline * rigid3.rotation_matrix(first)[0]
    poses = (first, looking(second_center, angles[0] + toe_deg, angles[1]))
    views, depths = [], []
    for side, pose in enumerate(poses):
        grey = renderer.photograph(pose, Optics(noise_sigma=2.0), [5, side], gain=1.0 - 0.05 * side)
        views.append(DenseView(f"{side}.png", np.repeat(grey[..., None], 3, 2), None, k, pose))
        depths.append(renderer.view(pose, edge_samples=False).depth)
    truths = [_seen_by_both(views, depths, side) for side in (0, 1)]
    row, column = np.nonzero(np.isfinite(truths[0]))
    some = np.random.default_rng(5).choice(len(row), NUM_POINTS, replace=False)
    points = _places(views[0], depths[0])[row[some], column[some]]
    ptr, seen = 2 * np.arange(NUM_POINTS + 1), np.tile(np.array([0, 1], np.int32), NUM_POINTS)
    return DenseScene(tuple(views), np.array([[1], [0]], np.int32), points, ptr, seen), truths


def looking(center: Array, heading_deg: float, tilt_deg: float) -> Array:
    """(7,) pose of a camera somewhere that looks that way, z up."""
    heading, tilt = np.radians(heading_deg), np.radians(tilt_deg)
    forward = np.array([np.cos(heading) * np.cos(tilt), np.sin(heading) * np.cos(tilt), np.sin(tilt)])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rigid3.from_matrix(rotation, -rotation @ center)


def _places(view: DenseView, depth: NDArray[np.float32]) -> Array:
    """(H, W, 3) world."""
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    rays = np.stack([(x - view.k[2]) / view.k[0], (y - view.k[3]) / view.k[1], np.ones_like(x)], -1)
    places = rigid3.apply(rigid3.inverse(view.cam_from_world), (rays * depth[..., None]).reshape(-1, 3))
    return np.asarray(places.reshape(view.height, view.width, 3))


def _seen_by_both(views: list[DenseView], depths: Truths, side: int) -> NDArray[np.float32]:
    """Depths of a view, NaN where the other one does not see the same to a hundredth."""
    view, other = views[side], views[1 - side]
    depth = np.where(np.isfinite(depths[side]), depths[side], np.nan)
    pixel, far = other.project(_places(view, np.nan_to_num(depth, nan=1.0)).reshape(-1, 3))
    shown = other.shows(pixel)
    x, y = np.where(shown[:, None], pixel, 0.0).astype(np.int64).T
    same = shown & (np.abs(depths[1 - side][y, x] / far - 1.0) < 0.01)
    return np.where(same.reshape(depth.shape), depth, np.nan).astype(np.float32)


def photographed(
    images: Path, work: Path, pairs: Sequence[tuple[str, str]]
) -> Iterator[tuple[str, DenseScene, Truths]]:
    """Pairs of photographs and depths that several of all agree on."""
    if not (work / PATCHES).is_file():
        reconstruct(images, work, record=False)
        dense(work, record=False)
    patches, names = read_patches(work / PATCHES)
    model, _ = read_model(work / "sparse" / "0")
    source = find_source(work, None, None, Options())
    plan, _ = plan_views(model, find_photographs(model, source.images, source.options.images, is_upright=True), OPTIONS)
    strong = patches.subset(patches.num_views >= NUM_TRUE)
    patch = np.repeat(np.arange(len(strong)), strong.num_views)
    for pair in pairs:
        chosen = sorted(next(n for n, name in enumerate(names) if one in name) for one in pair)
        scene = replace(load_scene(part_of(plan, np.array(chosen))), neighbors=np.array([[1], [0]], np.int32))
        of_both = np.intersect1d(*(patch[strong.view_idx == m] for m in chosen))
        truths = [
            splat_view(
                view.k, view.cam_from_world, view.width, view.height, strong.xyz[of_both], strong.normal[of_both], 1.0
            )[0]
            for view in scene.views
        ]  # fmt: skip
        yield ", ".join(pair), scene, truths


def markdown(report: dict[str, Any]) -> str:
    """The results as a table: growth / stereo / both in each cell."""
    lines = [
        "# Two photographs to patches", "", f"{report['date']}, {report['commit']}, {report['cpu']}", "",
        "Growth / stereo / both, as `sfmapp dense` has it. Covered and right: of the pixels of both views whose depth",
        "is known, per cent; right is within a pixel of disparity. Off: of the covered ones, those that are not. One",
        "thread.",
        "Photographs are judged by what four of all agree on, which windows found, as growth has them.", "",
        "| pair | covered | right | off | median error, px | CPU s |", "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in report["pairs"]:
        cells = [
            " / ".join(
                f"{100 * row[way][key]:.1f}" if key in ("density", "right", "bad") else f"{row[way][key]:.2f}"
                for way in ("growth", "stereo", "both")
            )
            for key in COLUMNS
        ]  # fmt: skip
        lines.append(f"| {row['pair']} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    main()
