"""How far off swept depths are, and say to be: judged on scenes that the table of errors was not fitted to.

    SFMAPP_DATA=... python benchmarks/sweep_sigma.py          writes results/sweep_sigma.md and .json
    python benchmarks/sweep_sigma.py --fit                    fits src/sfmapp/carve/sweep_error_table.py anew instead

Depth is exact: of all pixels of the lego's test views (half of the step that it is rounded to is taken off errors), and
of the rendered pixels that have texture. How many photographs decide and how strongly neighbours are held together was
chosen on the rendered scenes, those judged here among them.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sfmapp.carve.sweep_error_table as sweep_error_table
from machine import RESULTS, describe_machine
from plane_sweep import LEGO_STEP, lego_scene, textured
from sfmapp.carve.plane_sweep import sweep_view, swept_cues
from sfmapp.dense.scene import DenseScene
from stereo_sigma import PIXELS, fit, write_table
from sweep_scenes import FITTED, JUDGED, rendered_scene

Map = NDArray[np.float32]

# noise of the photographs, grey levels, and the views that are swept
SHOTS = ((1.0, (0, 3)), (2.0, (0, 5)), (4.0, (0, 1)))


@dataclass(frozen=True)
class SweptSample:
    """Cues (9, N) and errors (N,) of pixels of a map, in planes; all of the errors are seen."""

    cues: NDArray[np.float32]
    errors: NDArray[np.float64]
    unseen: float = 0.0


def sample_of(scene: DenseScene, view: int, depth: Map) -> SweptSample:
    found = sweep_view(scene, view)
    chosen = np.flatnonzero(np.isfinite(found.plane) & np.isfinite(depth))
    chosen = np.random.default_rng(0).choice(chosen, PIXELS, replace=False)
    others = [scene.views[m] for m in found.neighbors]
    cues = swept_cues(scene.views[view], others, found.planes, found.plane).reshape(9, -1)[:, chosen]
    true = (1.0 / depth.ravel()[chosen].astype(np.float64) - found.planes.first) / found.planes.step
    return SweptSample(cues, found.plane.ravel()[chosen] - true)


def fit_table() -> None:
    samples: list[Any] = []
    for setting in FITTED:
        for noise, views in SHOTS:
            scene, depths = rendered_scene(setting, noise)
            samples += [sample_of(scene, view, depths[view]) for view in views]
            print(setting.name, noise, flush=True)
    write_table(fit(samples), Path(sweep_error_table.__file__))


def judged() -> Iterator[tuple[str, DenseScene, int, Map, float]]:
    """Name, scene, view, its depth where it counts, and what that is rounded to."""
    for setting in JUDGED:
        scene, depths = rendered_scene(setting)
        yield setting.name, scene, 0, np.where(textured(scene.views[0]), depths[0], np.float32(np.nan)), 0.0
    scene, depths = lego_scene()
    for view, depth in enumerate(depths):
        yield f"lego {Path(scene.views[view].name).stem}", scene, view, depth, LEGO_STEP


def judge(name: str, scene: DenseScene, view: int, depth: Map, step: float) -> dict[str, Any]:
    """Shares, per cent, of the pixels with a true depth."""
    start = time.process_time()
    found = sweep_view(scene, view)
    cpu_s = time.process_time() - start
    known = np.isfinite(depth)
    both = known & np.isfinite(found.depth)
    error = np.abs(found.depth - depth)[both]
    right = error < 0.01 * depth[both]
    error = np.maximum(error - 0.5 * step, 0.0)
    shares = {
        "answered": both.sum() / known.sum(), "right_of_answered": right.mean(),
        "right_of_all": right.sum() / known.sum(),
        "inside_68": (error < found.sigma[both]).mean(), "inside_95": (error < found.half_width_95[both]).mean(),
    }  # fmt: skip
    return {"case": name, **{what: 100.0 * float(share) for what, share in shares.items()}, "cpu_s": cpu_s}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--fit", action="store_true")
    if parser.parse_args().fit:
        fit_table()
        return
    rows = []
    for case in judged():
        rows.append(judge(*case))
        print(rows[-1], flush=True)
    machine = describe_machine()
    (RESULTS / "sweep_sigma.json").write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n")
    columns = ("answered", "right_of_answered", "right_of_all", "inside_68", "inside_95")
    lines = [
        "# Swept depths against exact ones", "",
        "`benchmarks/sweep_sigma.py`, which says what counts. Per cent; the table of errors was not fitted to these "
        "scenes, but how many photographs decide and the weights of smoothness were chosen on the rendered ones. "
        f"{machine['date']}, commit {machine['commit']}, {machine['cores']} cores. No peer was measured.", "",
        "| view | with a depth | of these within 1 % | of all within 1 % | inside sigma (68) | inside 95 % | CPU s |",
        "|---|---|---|---|---|---|---|",
        *(f"| {row['case']} | {' | '.join(f'{row[c]:.1f}' for c in columns)} | {row['cpu_s']:.1f} |" for row in rows),
    ]  # fmt: skip
    (RESULTS / "sweep_sigma.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
