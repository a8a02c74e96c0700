"""Triangle meshes as PLY (Turk, "The PLY polygon file format", 1994), binary little-endian."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.ply import COLORS, TYPES, coordinate_type
from sfmapp.scene.mesh import Mesh

_NORMALS = ("nx", "ny", "nz")


@dataclass(frozen=True)
class VertexMark:
    """One more property of vertices.

    Attributes:
        name: of the property. meaning: what its numbers say, a comment of the file.
        values: (N,) uint8.
    """

    name: str
    meaning: str
    values: NDArray[np.uint8]


def write_mesh_ply(path: str | Path, mesh: Mesh, mark: VertexMark | None = None) -> None:
    """Write vertices with normals and colours, and with a mark if there is one, and triangles; coordinates are of the
    :func:`~sfmapp.formats.ply.coordinate_type`. A texture is left out."""
    kind = coordinate_type(mesh.xyz)
    fields: list[Any] = [("xyz", "<" + TYPES[kind], 3), ("normal", "<f4", 3), ("rgb", "u1", 3)]
    vertices = np.empty(len(mesh.xyz), fields if mark is None else [*fields, ("mark", "u1")])
    vertices["xyz"], vertices["normal"], vertices["rgb"] = mesh.xyz, mesh.normal, mesh.rgb
    lines = ["ply", "format binary_little_endian 1.0"]
    if mark is not None:
        vertices["mark"] = mark.values
        lines.append(f"comment {mark.name}: {mark.meaning}")
    faces = np.empty(len(mesh.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.faces
    lines.append(f"element vertex {len(vertices)}")
    lines += [f"property {kind} {axis}" for axis in "xyz"]
    lines += [f"property float {axis}" for axis in _NORMALS]
    lines += [f"property uchar {color}" for color in COLORS]
    lines += [] if mark is None else [f"property uchar {mark.name}"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    with replaced_file(Path(path)) as beside, beside.open("wb") as file:
        file.write("\n".join(lines).encode())
        file.write(vertices.tobytes())
        file.write(faces.tobytes())
