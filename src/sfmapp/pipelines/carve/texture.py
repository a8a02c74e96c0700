"""The photographs as the texture of a carved surface."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.dense.undistort import lay_out, make_canvas
from sfmapp.images.pixels import read_rgb
from sfmapp.pipelines.carve.sources import CarveSource
from sfmapp.scene.mesh import Mesh
from sfmapp.surface.report import TextureReport
from sfmapp.surface.texture import texture_mesh
from sfmapp.workspace.job import Job


def with_texture(job: Job, source: CarveSource, mesh: Mesh) -> tuple[Mesh, TextureReport | None]:
    """The mesh with a texture of its photographs, undistorted; as it is where they come with matrices that have no
    lens, which is said.

    Raises:
        NoReconstructionError: a child process ended without a result.
        MissingPackageError: xatlas or open3d is not installed.
    """
    posed = [
        (record, view.camera, view.cam_from_world)
        for record, view in zip(source.records, source.views, strict=True)
        if view.camera is not None and view.cam_from_world is not None
    ]
    if not posed:
        job.events.warned(
            "texture", "projection matrices have no lens to lay photographs out by: vertices are coloured"
        )
        return mesh, None
    num_bytes = 3.0 * sum(camera.width * camera.height for _, camera, _ in posed)
    shrink = max(1.0, float(np.sqrt(num_bytes / (0.5e6 * job.options.dense.max_memory_mb))))

    def load(m: int) -> DenseView:
        job.events.raise_if_cancelled()
        record, camera, pose = posed[m]
        canvas = make_canvas(camera, shrink)
        rgb, mask = lay_out(canvas, read_rgb(record), None)
        return DenseView(record.name, rgb, mask, canvas.k, pose, record.orientation)

    with ThreadPoolExecutor(job.threads) as pool:
        views = tuple(pool.map(load, range(len(posed))))
    scene = DenseScene(
        views, np.full((len(views), 1), -1, np.int32), np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32)
    )
    return texture_mesh(mesh, scene, job.options.surface, events=job.events)
