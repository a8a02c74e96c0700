"""What is written of a volume."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.formats.glb import write_glb
from sfmapp.formats.mesh_ply import write_mesh_ply
from sfmapp.scene.mesh import Mesh

OCTREE, MESH_PLY, MESH_GLB = "octree.npz", "mesh.ply", "mesh.glb"
# what shadows have left of the octree
SHADOWED = "octree_shadows.npz"
# what is left with patches
JOINED = "joined.npz"
# what carving said of itself, for a call that resumes
CARVING = "octree.json"


def write_surface(folder: Path, mesh: Mesh, shown: Mesh, up: NDArray[np.float64]) -> list[str]:
    """The mesh for programs, closed and with coloured vertices, and the one for viewers, which may have a texture and
    is cut apart then; gives the names of the files. ``up``: (3,) in the world."""
    write_mesh_ply(folder / MESH_PLY, mesh)
    write_glb(folder / MESH_GLB, shown, is_z_up=bool(up[2] > np.sqrt(0.5)))
    return [MESH_PLY, MESH_GLB]
