"""From patches and a mesh to ``dense/recording.rrd``."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.scene import DenseScene, Patches
from sfmapp.scene.mesh import Mesh
from sfmapp.viewer.dense_replay import make_dense_replay
from sfmapp.viewer.recording import RecordingReport, draw_in_child


def record_dense(
    path: Path, scene: DenseScene, patches: Patches, *, mesh: Mesh | None = None, title: str = "",
    up: NDArray[np.float64] | None = None, max_points: int = 500_000, timeout_s: float = 600.0,
) -> RecordingReport:  # fmt: skip
    """Write a recording of patches growing wave by wave, in a child process; never raises for what happens there.

    Args:
        path: the file, replaced when the new one is whole; its folder is there.
        scene: the views.
        patches: of them more than ``max_points`` are thinned, the same ones every time; the recording says so.
        mesh: made of the patches; None for none.
        title: shown in the viewer, such as the name of the image folder.
        up: (3,) direction in the world that is up (aligned worlds: z); None: judged from the cameras.
        max_points: to show. Half a million are 40 MB.
        timeout_s: the child is stopped after this long.
    """
    start = time.monotonic()
    try:
        with tempfile.TemporaryDirectory(prefix="recording-", dir=path.parent) as name:
            make_dense_replay(scene, patches, mesh=mesh, title=title, up=up, max_points=max_points).save(Path(name))
            problem = draw_in_child("dense", Path(name), path, 1, timeout_s)
    except OSError as error:
        problem = error.strerror or str(error)
    size = path.stat().st_size if not problem else 0
    return RecordingReport(None if problem else path, size, time.monotonic() - start, problem)
