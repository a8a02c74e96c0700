"""The photographs as the texture of a carved surface."""

from __future__ import annotations

import numpy as np

from sfmapp.dense.scene import DenseScene
from sfmapp.pipelines.carve.sources import CarveSource
from sfmapp.pipelines.carve.undistorted import undistorted
from sfmapp.scene.mesh import Mesh
from sfmapp.surface.report import TextureReport
from sfmapp.surface.texture import texture_mesh
from sfmapp.workspace.job import Job

_PIXEL_BYTES = 3.0


def with_texture(job: Job, source: CarveSource, mesh: Mesh) -> tuple[Mesh, TextureReport | None]:
    """The mesh with a texture of its photographs, undistorted; as it is where they come with matrices that have no
    lens, which is said.

    Raises:
        NoReconstructionError: a child process ended without a result.
        MissingPackageError: xatlas or open3d is not installed.
    """
    views = undistorted(job, source, _PIXEL_BYTES)
    if not views:
        job.events.warned(
            "texture", "projection matrices have no lens to lay photographs out by: vertices are coloured"
        )
        return mesh, None
    scene = DenseScene(
        views, np.full((len(views), 1), -1, np.int32), np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32)
    )
    return texture_mesh(mesh, scene, job.options.surface, events=job.events)
