"""From patches and a mesh to ``dense/recording.rrd``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.scene import DenseScene, Patches
from sfmapp.scene.mesh import Mesh
from sfmapp.viewer.dense_replay import make_dense_replay
from sfmapp.viewer.recording import RecordingReport, record_in_child


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
    return record_in_child(
        path, "dense",
        lambda _: make_dense_replay(scene, patches, mesh=mesh, title=title, up=up, max_points=max_points),
        timeout_s=timeout_s,
    )  # fmt: skip
