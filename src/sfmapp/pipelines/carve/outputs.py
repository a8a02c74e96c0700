"""What is written of a volume, and found again by a later call."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.limits import KINDS
from sfmapp.errors import InputError
from sfmapp.formats.glb import write_glb
from sfmapp.formats.mesh_ply import VertexMark, write_mesh_ply
from sfmapp.scene.mesh import Mesh
from sfmapp.workspace.job import Job

OCTREE, MESH_PLY, MESH_GLB = "octree.npz", "mesh.ply", "mesh.glb"
# what shadows have left of the octree
SHADOWED = "octree_shadows.npz"
# what colours have left of it
COLORED = "octree_colors.npz"
# what is left with patches
JOINED = "joined.npz"
# what carving and joining said of themselves, for a call that resumes
CARVING, JOINING = "octree.json", "joined.json"
# what colours told of depth, for a call that resumes, and what was said of it
SIGHTS, SEEING = "sights.npz", "sights.json"
# what is known of each vertex
EVIDENCE = "evidence"
T = TypeVar("T")


def write_surface(
    folder: Path, mesh: Mesh, evidence: NDArray[np.uint8], shown: Mesh, up: NDArray[np.float64]
) -> list[str]:
    """The mesh for programs, closed and with coloured vertices, and the one for viewers, which may have a texture and
    is cut apart then; gives the names of the files. ``evidence``: (N,) of the vertices, as
    :meth:`sfmapp.carve.limits.Known.of_vertices` has it. ``up``: (3,) in the world."""
    meaning = ", ".join(f"{number} {kind}" for number, kind in enumerate(KINDS))
    write_mesh_ply(folder / MESH_PLY, mesh, VertexMark(EVIDENCE, meaning, evidence))
    write_glb(folder / MESH_GLB, shown, is_z_up=bool(up[2] > np.sqrt(0.5)))
    return [MESH_PLY, MESH_GLB]


def earlier(job: Job, stage: str, key: str, read: Callable[[], T], said: str) -> T | None:
    """What ``read`` finds of a stage that an earlier call has finished with the same key, which is ``said``; None where
    there was no such call, or its files are taken away or damaged."""
    if not job.workspace.is_current(stage, key):
        return None
    try:
        found = read()
    except (InputError, ValueError):
        return None
    job.events.decided(stage, said)
    return found
