"""Fit what the cues of swept depths mean, on rendered scenes, and write it to src/sfmapp/carve/sweep_error_table.py.

python benchmarks/sweep_sigma.py
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sfmapp.carve.sweep_error_table as sweep_error_table
from sfmapp.carve.plane_sweep import sweep_view, swept_cues
from sfmapp.dense.scene import DenseScene
from stereo_sigma import PIXELS, fit, write_table
from sweep_scenes import FITTED, rendered_scene

# noise of the photographs, grey levels, and the views that are swept
SHOTS = ((1.0, (0, 3)), (2.0, (0, 5)), (4.0, (0, 1)))


@dataclass(frozen=True)
class SweptSample:
    """Cues (9, N) and errors (N,) of pixels of a map, in planes; all of the errors are seen."""

    cues: NDArray[np.float32]
    errors: NDArray[np.float64]
    unseen: float = 0.0


def sample_of(scene: DenseScene, view: int, depth: NDArray[np.float32]) -> SweptSample:
    found = sweep_view(scene, view)
    chosen = np.flatnonzero(np.isfinite(found.plane) & np.isfinite(depth))
    chosen = np.random.default_rng(0).choice(chosen, PIXELS, replace=False)
    others = [scene.views[m] for m in found.neighbors]
    cues = swept_cues(scene.views[view], others, found.planes, found.plane).reshape(9, -1)[:, chosen]
    true = (1.0 / depth.ravel()[chosen].astype(np.float64) - found.planes.first) / found.planes.step
    return SweptSample(cues, found.plane.ravel()[chosen] - true)


def main() -> None:
    samples: list[Any] = []
    for setting in FITTED:
        for noise, views in SHOTS:
            scene, depths = rendered_scene(setting, noise)
            samples += [sample_of(scene, view, depths[view]) for view in views]
            print(setting.name, noise, flush=True)
    write_table(fit(samples), Path(sweep_error_table.__file__))


if __name__ == "__main__":
    main()
