"""Depth maps by plane sweep, against patches of photographs that they do not use, and against exact depth.

    SFMAPP_DATA=... python benchmarks/plane_sweep.py [MODEL]        writes results/plane_sweep.md and .json

The courtyard has no depth of its own. For each of five photographs, patches are grown from all others but the six
that it is swept with, at half the size; where they show something that is textured in the photograph, its map is held
against them. Maps of the six, which are asked too, are swept with the seven alone. Patches of all photographs, these
six among them, say where that truth is to be doubted. The lego's test views have exact depth in steps of 0.031, whose
standard deviation is added to sigmas; they are swept with photographs of the training set. MODEL: of the courtyard
with its cameras held, if it is there already.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dense_inputs import LEGO_FAR
from machine import RESULTS, describe_machine
from sfmapp.carve.plane_sweep import NEIGHBORS, SweptDepth, SweptPlanes, measured, sweep_planes
from sfmapp.carve.sweep_agreement import confirm
from sfmapp.carve.sweep_exchange import exchange_planes
from sfmapp.dense.densify import densify
from sfmapp.dense.maps import splat_view
from sfmapp.dense.options import DenseOptions
from sfmapp.dense.outcome import LEAST_DEVIATION, NOISE_FACTOR, WINDOW_PX, noise_deviation
from sfmapp.dense.photographs import Photographs, find_photographs
from sfmapp.dense.prepare import load_scene, part_of, plan_views
from sfmapp.dense.scene import DenseScene, DenseView, Patches
from sfmapp.dense.selection import select_neighbors
from sfmapp.formats.colmap import read_model
from sfmapp.geometry import rigid3
from sfmapp.images.image_set import ImageOptions
from sfmapp.scene.reconstruction import Reconstruction

DATA = Path(os.environ["SFMAPP_DATA"])
COURTYARD, LEGO = DATA / "strecha-courtyard-21", DATA / "nerf-lego-small"
REFERENCES = ("entry_0001.jpg", "entry_0004.jpg", "entry_0007.jpg", "fountain_0003.jpg", "fountain_0007.jpg")
# of the patches that a map is held against
LEAST_SCORE = 0.8
LEGO_STEP = LEGO_FAR / 255.0
NOTHING = (np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32))
Map = NDArray[np.float32]


@dataclass(frozen=True)
class Score:
    """Of the pixels with a known depth: shares with an answer, of answers within 1 %, of all pixels with an answer
    within 1 %, and the same of those where the patches of all photographs are within 1 % of the truth (None: there are
    none); of answers inside sigma and half_width_95; CPU seconds of the map."""

    case: str
    which: str
    answered: float
    right_of_answered: float
    right_of_all: float
    right_of_agreed: float | None
    inside_68: float
    inside_95: float
    cpu_s: float


@dataclass(frozen=True)
class Truth:
    """What a map is held against.

    Attributes:
        depth: (H, W), NaN where none is known. agreed: (H, W) where a second truth tells the same; None: there is none.
        step: that depths are rounded to.
    """

    depth: Map
    agreed: NDArray[np.bool_] | None = None
    step: float = 0.0


def courtyard(model_folder: Path) -> tuple[list[Score], dict[str, float]]:
    """Scores, and by photograph the share of the true pixels in which patches of all photographs tell the same."""
    model, _ = read_model(model_folder)
    found = find_photographs(model, COURTYARD / "images", ImageOptions(), is_upright=False)
    plan, _ = plan_views(model, found, DenseOptions())
    everything = patches_without(model, found, ())
    scores, agreed = [], {}
    for name in REFERENCES:
        view = plan.names.index(name)
        used = np.unique([view, *[int(m) for m in plan.neighbors[view] if m >= 0][:NEIGHBORS]])
        swept, at = SweptScene(load_scene(part_of(plan, used))), int(np.searchsorted(used, view))
        reference = swept.scene.views[at]
        depth, second = (depth_of(patches, reference) for patches in (patches_without(model, found, used), everything))
        depth[~textured(reference)] = np.nan
        truth = Truth(depth, np.abs(second / depth - 1.0) < 0.01)
        agreed[name] = float(np.mean(np.abs(second / depth - 1.0)[np.isfinite(depth)] < 0.01))
        scores += scores_of(name, swept, at, truth)
        print(*scores[-3:], agreed[name], sep="\n", flush=True)
    return scores, agreed


def patches_without(model: Reconstruction, found: Photographs, used: Sequence[int] | NDArray[np.int64]) -> Patches:
    """Patches that grew at half the size without some photographs."""
    kept = [m for m in range(len(found.records)) if m not in used]
    others = Photographs(
        found.image_idx[kept], tuple(found.records[m] for m in kept), tuple(found.cameras[m] for m in kept), (), ()
    )
    options = DenseOptions(level=1)
    patches, _ = densify(load_scene(plan_views(model, others, options)[0]), options)
    return patches.subset(patches.score > LEAST_SCORE)


def depth_of(patches: Patches, view: DenseView) -> Map:
    """Depth (H, W) of patches in a view, NaN where there are none."""
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
    swept, scores = SweptScene(scene), []
    for view, depth in enumerate(depths):
        scores += scores_of(f"lego {Path(scene.views[view].name).stem}", swept, view, Truth(depth, step=LEGO_STEP))
        print(*scores[-3:], sep="\n", flush=True)
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


class SweptScene:
    """Maps of a scene, each made once.

    Args:
        scene: views and neighbours.
    """

    def __init__(self, scene: DenseScene) -> None:
        self.scene = scene
        self._swept: dict[int, tuple[SweptPlanes, float]] = {}

    def planes_of(self, view: int) -> tuple[SweptPlanes, float]:
        """Of a view alone, and the CPU seconds that they took."""
        if view not in self._swept:
            start = time.process_time()
            with ThreadPoolExecutor(1) as pool:
                found = sweep_planes(self.scene, view, pool)
            self._swept[view] = found, time.process_time() - start
        return self._swept[view]

    def alone(self, view: int) -> tuple[SweptDepth, float]:
        """The map of a view alone, and the CPU seconds that it took."""
        planes, cpu_s = self.planes_of(view)
        start = time.process_time()
        found = measured(self.scene, view, planes)
        return found, cpu_s + time.process_time() - start

    def answered(self, view: int) -> tuple[SweptDepth, float]:
        """After its neighbours' were asked; the CPU seconds are without those of other views' maps."""
        own, cpu_s = self.planes_of(view)
        told = {m: self.planes_of(m)[0] for m in (view, *own.neighbors)}
        start = time.process_time()
        found = measured(self.scene, view, exchange_planes(self.scene, view, told))
        return found, cpu_s + time.process_time() - start

    def both_of(self, view: int) -> list[tuple[str, SweptDepth, float]]:
        """What both are called, and both."""
        return [("alone", *self.alone(view)), ("answered", *self.answered(view))]


def scores_of(case: str, swept: SweptScene, view: int, truth: Truth) -> list[Score]:
    """Of the map of a view alone, after its neighbours' were asked, and of what these confirm of it."""
    maps = swept.both_of(view)
    _, own, cpu_s = maps[-1]
    scene = swept.scene
    others = [(scene.views[m], swept.alone(m)[0]) for m in own.neighbors]
    agree, against = confirm(scene.views[view], own, others)
    kept = (agree > 0) & (agree >= against)
    maps.append(("confirmed", replace(own, depth=np.where(kept, own.depth, np.float32(np.nan))), cpu_s))
    return [score_of(case, which, found, truth, seconds) for which, found, seconds in maps]


def score_of(case: str, which: str, found: SweptDepth, truth: Truth, cpu_s: float) -> Score:
    known = np.isfinite(truth.depth)
    answered = known & np.isfinite(found.depth)
    error = np.abs(found.depth - truth.depth)
    right = error < 0.01 * truth.depth
    inside = (
        float((error < np.hypot(width, factor * truth.step / np.sqrt(12.0)))[answered].mean())
        for width, factor in ((found.sigma, 1.0), (found.half_width_95, 1.96))
    )
    agreed = None if truth.agreed is None else float(right[known & truth.agreed].mean())
    return Score(
        case, which, float(answered.sum() / known.sum()), float(right[answered].mean()), float(right[known].mean()),
        agreed, *inside, cpu_s,
    )  # fmt: skip


def main() -> None:
    with tempfile.TemporaryDirectory() as scratch:
        model = Path(sys.argv[1]) if len(sys.argv) == 2 else reconstruct(Path(scratch) / "courtyard")
        of_courtyard, agreed = courtyard(model)
    scores = lego() + of_courtyard
    machine = describe_machine()
    document = {"machine": machine, "agreed": agreed, "scores": [vars(score) for score in scores]}
    (RESULTS / "plane_sweep.json").write_text(json.dumps(document, indent=1) + "\n")
    (RESULTS / "plane_sweep.md").write_text(markdown(scores, agreed, machine))


def markdown(scores: Sequence[Score], agreed: dict[str, float], machine: dict[str, Any]) -> str:
    """The table."""
    lines = [
        "# Depth maps by plane sweep", "",
        "`benchmarks/plane_sweep.py`, which says what the truth is. Per cent of the pixels with a true depth (of the",
        "courtyard: of textured ones), CPU seconds of one map without those of its neighbours. Alone: of the sweep;",
        "answered: after the maps of neighbours were tried in it; confirmed: what these, as they are alone, confirm.",
        f"{machine['date']}, commit {machine['commit']}, {machine['cores']} cores. No peer was measured.", "",
        "| view | map | answered | of these within 1 % | within 1 % of all | of all agreed | inside sigma | inside 95 "
        "% | CPU s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for score in scores:
        shares = (
            score.answered, score.right_of_answered, score.right_of_all, score.right_of_agreed, score.inside_68,
            score.inside_95,
        )  # fmt: skip
        cells = ["" if share is None else f"{100.0 * share:.1f}" for share in shares]
        lines.append(f"| {score.case} | {score.which} | {' | '.join(cells)} | {score.cpu_s:.1f} |")
    told = ", ".join(f"{Path(name).stem} {100.0 * share:.1f} %" for name, share in agreed.items())
    lines += [
        "", "The courtyard's truth is of patches as well. Agreed are the pixels in which patches of all photographs",
        f"tell the same within 1 %: {told}.",
        "They share photographs with the map, so what is right of these is an upper bound.", "",
    ]  # fmt: skip
    return "\n".join(lines)


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
