"""Triangle meshes as PLY (Turk, "The PLY polygon file format", 1994), binary little-endian."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.ply import COLORS, TYPES, coordinate_type
from sfmapp.scene.mesh import Mesh

_NORMALS = ("nx", "ny", "nz")


def write_mesh_ply(path: str | Path, mesh: Mesh) -> None:
    """Write vertices with normals and colours, and triangles; coordinates are of the
    :func:`~sfmapp.formats.ply.coordinate_type`. A texture is left out."""
    kind = coordinate_type(mesh.xyz)
    vertices = np.empty(len(mesh.xyz), [("xyz", "<" + TYPES[kind], 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
    vertices["xyz"], vertices["normal"], vertices["rgb"] = mesh.xyz, mesh.normal, mesh.rgb
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property {kind} {axis}" for axis in "xyz"]
    lines += [f"property float {axis}" for axis in _NORMALS]
    lines += [f"property uchar {color}" for color in COLORS]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    with replaced_file(Path(path)) as beside, beside.open("wb") as file:
        file.write("\n".join(lines).encode())
        file.write(vertices.tobytes())
        file.write(faces.tobytes())
