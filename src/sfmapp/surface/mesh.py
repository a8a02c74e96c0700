"""Oriented patches to a mesh: Poisson, then away with what no patch and no camera vouches for."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.scene import DenseScene
from sfmapp.errors import NoReconstructionError
from sfmapp.events import Events
from sfmapp.reporting import Step
from sfmapp.scene.mesh import Mesh, vertex_normals
from sfmapp.surface.gaps import close_gaps
from sfmapp.surface.options import SurfaceOptions
from sfmapp.surface.patch_cloud import make_patch_cloud
from sfmapp.surface.poisson import ClosedSurface, depth_for, poisson
from sfmapp.surface.report import MeshReport
from sfmapp.surface.trim import Surroundings, in_view, look_around, rim, without_islands

STAGE = "mesh"


def make_mesh(
    xyz: NDArray[np.float64],
    normal: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    size: NDArray[np.float32],
    scene: DenseScene | None,
    options: SurfaceOptions,
    *,
    threads: int = 1,
    events: Events | None = None,
) -> tuple[Mesh, MeshReport]:
    """Reconstruct the surface that oriented patches lie on.

    Args:
        xyz: (N, 3) places of the patches, world.
        normal: (N, 3) unit normals, outward.
        rgb: (N, 3).
        size: (N,) what a pixel measures at each patch, world units.
        scene: the views; what none of them can show is cut off. None: no such trimming.
        options: depth and trimming.
        threads: that share the work; the result does not depend on their number.
        events: progress and cancellation.

    Returns:
        The mesh, and the report.

    Raises:
        NoReconstructionError: too few patches, no surface, or nothing is left of it after trimming.
        InterruptedRunError: ``events`` was asked to stop.
    """
    events = events or Events()
    wall, cpu = time.monotonic(), time.process_time()
    events.started(STAGE, "surface", total=4)
    patches = make_patch_cloud(xyz, normal, rgb, size, threads)
    depth = options.depth or depth_for(xyz, patches.median_spacing)
    events.advanced(STAGE, message=f"Poisson, depth {depth}")
    surface = poisson(xyz, normal, depth, events, threads=threads, stage=STAGE)
    events.advanced(STAGE, message="trimming")
    around = look_around(surface.xyz, vertex_normals(surface.xyz, surface.faces), patches, threads)
    events.advanced(STAGE)
    moved, kept, funnel = _trim(surface, around, patches.median_spacing, scene, options)
    if scene is not None and scene.region is not None:
        # what bulges out of the region is pressed flat onto its sides: a closed surface stays closed
        moved = moved.clip(scene.region.low, scene.region.high)
    mesh = _cut(moved, surface.faces, around, kept)
    report = MeshReport(
        depth=depth,
        spacing=patches.median_spacing,
        num_vertices=len(mesh.xyz),
        num_faces=len(mesh.faces),
        num_rim_edges=len(rim(mesh.faces)),
        funnel=funnel,
        poisson=surface.usage,
        wall_s=round(time.monotonic() - wall, 3),
        cpu_s=round(time.process_time() - cpu, 3),
    )
    events.advanced(STAGE)
    events.finished(STAGE, f"{len(mesh.faces)} triangles", **report)
    return mesh, report


def _trim(
    surface: ClosedSurface, around: Surroundings, spacing: float, scene: DenseScene | None, options: SurfaceOptions
) -> tuple[NDArray[np.float64], NDArray[np.bool_], list[Step]]:
    """Where the vertices go (N, 3), the faces to keep (F,), and how many were left after each step."""
    faces = surface.faces
    funnel = [Step(name="Poisson", count=len(faces))]

    def keep(name: str, kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
        funnel.append(Step(name=name, count=int(kept.sum())))
        if not kept.any():
            raise NoReconstructionError(
                f"surface: nothing is left of {len(faces)} triangles after trimming ({name})",
                "try a larger surface.trim_distance",
            )
        return kept

    kept: NDArray[np.bool_] = np.ones(len(faces), np.bool_)
    if options.trim_density > 0.0:
        sparse = around.radius > np.quantile(around.radius, 1.0 - options.trim_density)
        kept = keep("dense enough", kept & ~sparse[faces].any(axis=1))
    far = around.distance > options.trim_distance
    kept = keep("near patches", kept & ~far[faces].any(axis=1))
    kept = keep("on the side of the patches", kept & ~around.is_backside[faces].all(axis=1))
    if scene is not None:
        kept = keep("in view", kept & in_view(surface.xyz, faces, scene))
    kept = keep("not in islands", without_islands(surface.xyz, faces, kept, options.min_island))
    xyz, kept = close_gaps(surface.xyz, faces, kept, scene, options.max_hole, spacing)
    return xyz, keep("gaps closed", kept), funnel


def _cut(xyz: NDArray[np.float64], faces: NDArray[np.int32], around: Surroundings, kept: NDArray[np.bool_]) -> Mesh:
    """The kept faces (F,) with the vertices they need."""
    faces = faces[kept]
    is_used = np.zeros(len(xyz), np.bool_)
    is_used[faces] = True
    faces = (np.cumsum(is_used, dtype=np.int32) - np.int32(1))[faces]
    xyz = xyz[is_used]
    return Mesh(xyz, faces, vertex_normals(xyz, faces), around.rgb[is_used])
