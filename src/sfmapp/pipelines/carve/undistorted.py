"""Photographs of a source without distortion, for what looks at all of them together."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from sfmapp.carve.silhouettes import Silhouette
from sfmapp.dense.scene import DenseView
from sfmapp.dense.undistort import lay_out, make_canvas
from sfmapp.images.pixels import read_rgb
from sfmapp.pipelines.carve.sources import CarveSource
from sfmapp.workspace.job import Job


def undistorted(
    job: Job, source: CarveSource, pixel_bytes: float, silhouettes: Sequence[Silhouette] | None = None, *,
    shrink: float = 1.0,
) -> tuple[DenseView, ...]:  # fmt: skip
    """Those with a lens and a pose, smaller where ``dense.max_memory_mb`` asks for it.

    Args:
        pixel_bytes: that each pixel of theirs will need.
        silhouettes: V of them, whose insides become masks; photographs whose silhouette tells nothing are left out.
        shrink: pixels of a photograph for one of a view, a side, at least.
    """
    posed = []
    for v, (record, view) in enumerate(zip(source.records, source.views, strict=True)):
        mask = None
        if silhouettes is not None:
            known = silhouettes[v].known
            if known is not None and not known.any():
                continue
            mask = silhouettes[v].inside if known is None else silhouettes[v].inside | ~known
        if view.camera is not None and view.cam_from_world is not None:
            posed.append((record, view.camera, view.cam_from_world, mask))
    num_bytes = pixel_bytes * sum(camera.width * camera.height for _, camera, _, _ in posed)
    shrink = max(shrink, float(np.sqrt(num_bytes / (0.5e6 * job.options.dense.max_memory_mb))))

    def load(m: int) -> DenseView:
        job.events.raise_if_cancelled()
        record, camera, pose, inside = posed[m]
        canvas = make_canvas(camera, shrink)
        rgb, mask = lay_out(canvas, read_rgb(record), inside)
        return DenseView(record.name, rgb, mask, canvas.k, pose, record.orientation)

    with ThreadPoolExecutor(job.threads) as pool:
        return tuple(pool.map(load, range(len(posed))))
