"""Depth maps by plane sweep, against patches of photographs that they do not use, and against exact depth.

    SFMAPP_DATA=... python benchmarks/plane_sweep.py [MODEL]        writes results/plane_sweep.md and .json

The courtyard has no depth of its own. For each of three photographs, patches are grown from all others but the four
that it is swept with, at half the size; where they show something that is textured in the photograph, its map is held
against them. The lego's test views have exact depth in steps of 0.031, half of which is taken off errors where sigmas
are judged; they are swept with photographs of the training set. MODEL: of the courtyard with its cameras held, if it is
there already.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dense_inputs import LEGO_FAR
from machine import RESULTS, describe_machine
from sfmapp.carve.plane_sweep import NEIGHBORS, SweptDepth, sweep_view
from sfmapp.carve.sweep_agreement import confirm
from sfmapp.dense.densify import densify
from sfmapp.dense.maps import splat_view
from sfmapp.dense.options import DenseOptions
from sfmapp.dense.outcome import LEAST_DEVIATION, NOISE_FACTOR, WINDOW_PX, noise_deviation
from sfmapp.dense.photographs import Photographs, find_photographs
from sfmapp.dense.prepare import load_scene, plan_views
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.dense.selection import select_neighbors
from sfmapp.formats.colmap import read_model
from sfmapp.geometry import rigid3
from sfmapp.images.image_set import ImageOptions
from sfmapp.scene.reconstruction import Reconstruction

DATA = Path(os.environ["SFMAPP_DATA"])
COURTYARD, LEGO = DATA / "strecha-courtyard-21", DATA / "nerf-lego-small"
REFERENCES = ("entry_0004.jpg", "fountain_0003.jpg", "fountain_0007.jpg")
# of the patches that a map is held against
LEAST_SCORE = 0.8
LEGO_STEP = LEGO_FAR / 255.0
NOTHING = (np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32))
Map = NDArray[np.float32]


@dataclass(frozen=True)
class Score:
    """Of the pixels with a known depth: shares with an answer, of answers within 1 %, of all pixels with an answer
    within 1 %, of answers inside sigma; CPU seconds of the map."""

    case: str
    which: str
    answered: float
    right_of_answered: float
    right_of_all: float
    inside_sigma: float
    cpu_s: float


def courtyard(model_folder: Path) -> list[Score]:
    model, _ = read_model(model_folder)
    found = find_photographs(model, COURTYARD / "images", ImageOptions(), is_upright=False)
    plan, _ = plan_views(model, found, DenseOptions())
    scores = []
    for name in REFERENCES:
        view = plan.names.index(name)
        near = [int(m) for m in plan.neighbors[view] if m >= 0]
        scene = load_scene(plan)
        truth = held_out_depth(model, found, [view, *near[:NEIGHBORS]], scene.views[view])
        truth[~textured(scene.views[view])] = np.nan
        scores += scores_of(name, scene, view, near, truth, 0.0)
        print(*scores[-2:], sep="\n", flush=True)
    return scores


def held_out_depth(model: Reconstruction, found: Photographs, used: Sequence[int], view: DenseView) -> Map:
    """Depth (H, W) of patches that grew without some photographs, NaN where there are none."""
    kept = [m for m in range(len(found.records)) if m not in used]
    others = Photographs(
        found.image_idx[kept], tuple(found.records[m] for m in kept), tuple(found.cameras[m] for m in kept), (), ()
    )
    options = DenseOptions(level=1)
    patches, _ = densify(load_scene(plan_views(model, others, options)[0]), options)
    patches = patches.subset(patches.score > LEAST_SCORE)
    depth, _ = splat_view(view.k, view.cam_from_world, view.width, view.height, patches.xyz, patches.normal, 2.0)
    return depth


def textured(view: DenseView) -> NDArray[np.bool_]:
    """(H, W), by the same measure as :func:`sfmapp.dense.outcome.textured_pixels`."""
    grey = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)
    mean = cv2.boxFilter(grey, cv2.CV_32F, (WINDOW_PX, WINDOW_PX))
    variance = cv2.sqrBoxFilter(grey, cv2.CV_32F, (WINDOW_PX, WINDOW_PX)) - mean * mean
    return np.asarray(variance > max(LEAST_DEVIATION, NOISE_FACTOR * noise_deviation(grey)) ** 2)


def lego_scene() -> tuple[DenseScene, list[Map]]:
    """The test views first, with their depth; their neighbours are photographs of the training set."""
    tests, depths = lego_views("test_cameras.json", 0.5)
    photographs, _ = lego_views("cameras.json", 1.0)
    views = (*tests, *photographs)
    poses = np.array([view.cam_from_world for view in views])
    ranked, _ = select_neighbors(np.array([view.k[0] for view in views]), poses, *NOTHING, 2 * len(tests))
    # test views are nobody's neighbours
    rows = [[m for m in row if m >= len(tests)][:8] for row in ranked]
    neighbors = np.array([row + [-1] * (8 - len(row)) for row in rows], np.int32)
    return DenseScene(tuple(views), neighbors, *NOTHING), depths


def lego() -> list[Score]:
    scene, depths = lego_scene()
    scores = []
    for view, depth in enumerate(depths):
        near = [int(m) for m in scene.neighbors[view] if m >= 0]
        scores += scores_of(f"lego {Path(scene.views[view].name).stem}", scene, view, near, depth, LEGO_STEP / 2.0)
        print(*scores[-2:], sep="\n", flush=True)
    return scores


def lego_views(file: str, scale: float) -> tuple[list[DenseView], list[Map]]:
    """Views on white, and the depth of those that have one, both made smaller."""
    views, depths = [], []
    for camera in json.loads((LEGO / file).read_text())["cameras"]:
        rgba = cv2.imread(str(LEGO / camera["file"]), cv2.IMREAD_UNCHANGED)
        alpha = rgba[..., 3:] / 255.0
        rgb = np.rint(rgba[..., 2::-1] * alpha + 255.0 * (1.0 - alpha)).astype(np.uint8)
        size = (round(scale * rgb.shape[1]), round(scale * rgb.shape[0]))
        rgb, opacity = (cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in (rgb, rgba[..., 3]))
        matrix = np.array(camera["K"])
        k = scale * np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5])
        pose = rigid3.from_matrix(np.array(camera["R_w2c"]), np.array(camera["t_w2c"]).ravel())
        views.append(DenseView(camera["file"], rgb, opacity > 127, k, pose))
        if "depth" in camera:
            level = cv2.imread(str(LEGO / camera["depth"]), cv2.IMREAD_UNCHANGED)
            level = (level[..., 0] if level.ndim == 3 else level)[:: round(1 / scale), :: round(1 / scale)]
            v, u = np.mgrid[: level.shape[0], : level.shape[1]] + 0.5 * scale
            along = np.hypot(np.hypot((u - k[2]) / k[0], (v - k[3]) / k[1]), 1.0)
            depth = LEGO_FAR * (1.0 - level / 255.0) / along
            depths.append(np.where(level > 0, depth, np.nan).astype(np.float32))
    return views, depths


# by the number of views of the scene and the view: its map, and the CPU seconds that it took
SWEPT: dict[tuple[int, int], tuple[SweptDepth, float]] = {}


def swept(scene: DenseScene, view: int) -> tuple[SweptDepth, float]:
    key = (len(scene.views), view)
    if key not in SWEPT:
        start = time.process_time()
        found = sweep_view(scene, view)
        SWEPT[key] = found, time.process_time() - start
    return SWEPT[key]


def scores_of(case: str, scene: DenseScene, view: int, near: Sequence[int], truth: Map, floor: float) -> list[Score]:
    """Of the map of a view as it is, and of what the maps of its neighbours confirm."""
    own, cpu = swept(scene, view)
    agree, against = confirm(scene.views[view], own, [(scene.views[m], swept(scene, m)[0]) for m in near])
    kept = (agree > 0) & (agree >= against)
    confirmed = replace(own, depth=np.where(kept, own.depth, np.float32(np.nan)))
    scores = []
    for which, found in (("answered", own), ("confirmed", confirmed)):
        known = np.isfinite(truth)
        both = known & np.isfinite(found.depth)
        error = np.abs(found.depth - truth)[both]
        right = error < 0.01 * truth[both]
        inside = (np.maximum(error - floor, 0.0) < found.sigma[both]).mean()
        scores.append(
            Score(case, which, both.sum() / known.sum(), right.mean(), right.sum() / known.sum(), inside, cpu)
        )
    return scores


def main() -> None:
    with tempfile.TemporaryDirectory() as scratch:
        model = Path(sys.argv[1]) if len(sys.argv) == 2 else reconstruct(Path(scratch) / "courtyard")
        scores = lego() + courtyard(model)
    machine = describe_machine()
    document = {"machine": machine, "scores": [vars(score) for score in scores]}
    (RESULTS / "plane_sweep.json").write_text(json.dumps(document, indent=1, default=float) + "\n")
    lines = [
        "# Depth maps by plane sweep", "",
        "`benchmarks/plane_sweep.py`, which says what the truth is. Shares of the pixels with a true depth (courtyard:",
        f"of the textured ones), CPU seconds of one map. {machine['date']}, commit {machine['commit']}, "
        f"{machine['cores']} cores. No peer was measured.", "",
        "| view | depths | with one | of these within 1 % | within 1 % of all | inside sigma | CPU s |",
        "|---|---|---|---|---|---|---|",
        *(f"| {s.case} | {s.which} | {s.answered:.1%} | {s.right_of_answered:.1%} | {s.right_of_all:.1%} | "
          f"{s.inside_sigma:.1%} | {s.cpu_s:.2f} |" for s in scores),
    ]  # fmt: skip
    (RESULTS / "plane_sweep.md").write_text("\n".join(lines) + "\n")


def reconstruct(output: Path) -> Path:
    """The courtyard's points, its cameras held."""
    cameras = str(COURTYARD / "cameras.json")
    command = [sys.executable, "-m", "sfmapp", "reconstruct", str(COURTYARD / "images"), "-o", str(output), "-q"]
    subprocess.run(
        [*command, "--pose-priors", cameras, "--camera", cameras, "--fix-poses", "--no-recording"], check=True
    )
    return output / "sparse" / "0"


if __name__ == "__main__":
    main()
