"""What is written of a volume."""

from __future__ import annotations

from pathlib import Path

from sfmapp.carve.files import write_octree
from sfmapp.carve.octree import Octree
from sfmapp.formats.glb import write_glb
from sfmapp.formats.mesh_ply import write_mesh_ply
from sfmapp.scene.mesh import Mesh

OCTREE, MESH_PLY, MESH_GLB = "octree.npz", "mesh.ply", "mesh.glb"
# what carving said of itself, for a call that resumes
CARVING = "octree.json"


def write_volume(folder: Path, octree: Octree, mesh: Mesh | None = None) -> list[str]:
    """The octree and, once there is one, the mesh; gives the names of the files."""
    if mesh is None:
        write_octree(folder / OCTREE, octree)
        return [OCTREE]
    write_mesh_ply(folder / MESH_PLY, mesh)
    write_glb(folder / MESH_GLB, mesh)
    return [OCTREE, MESH_PLY, MESH_GLB]
