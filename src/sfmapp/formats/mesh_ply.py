"""Triangle meshes as PLY (Turk, "The PLY polygon file format", 1994), binary little-endian."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.ply import COLORS, TYPES, coordinate_type, read_binary, rgb_of, xyz_of
from sfmapp.scene.mesh import Mesh, vertex_normals

_NORMALS = ("nx", "ny", "nz")

Field = tuple[str, ...]
Element = tuple[str, int, list[Field]]


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


def read_mesh_ply(path: str | Path) -> Mesh:
    """Read a triangle mesh: black where it has no colours, with normals of its faces where it has none.

    Elements other than vertices and faces are passed over if they come last.

    Raises:
        InputError: the file is missing, not binary little-endian, truncated, has faces that are not triangles of its
            vertices, or coordinates that are not finite.
    """
    path = Path(path)
    data, lines, start = read_binary(path)
    elements = _elements(path, lines)
    if [name for name, _, _ in elements[:2]] != ["vertex", "face"]:
        found = ", ".join(name for name, _, _ in elements) or "none"
        raise InputError(f"{path}: expected the elements vertex and face, found {found}")
    vertices = _rows(path, data, start, "vertices", elements[0][1], _vertex_type(path, elements[0][2]))
    face_type = _face_type(path, elements[1][2])
    rows = _rows(path, data, start + vertices.nbytes, "triangles", elements[1][1], face_type)
    xyz = xyz_of(vertices)
    if not np.isfinite(xyz).all():
        raise InputError(f"{path}: expected finite coordinates, found NaN or infinity")
    faces = rows["corners"].astype(np.int64)
    if len(rows) and (rows["count"] != 3).any():
        raise InputError(
            f"{path}: expected triangles, found a face with {rows['count'][rows['count'] != 3][0]} corners"
        )
    if len(rows) and not (faces.min() >= 0 and faces.max() < len(xyz)):
        raise InputError(f"{path}: expected corners from 0 to {len(xyz) - 1}, found {faces.min()} to {faces.max()}")
    corners = faces.astype(np.int32)
    if set(_NORMALS) <= set(vertices.dtype.names or ()):
        normal = np.stack([vertices[axis].astype(np.float32) for axis in _NORMALS], axis=1)
    else:
        normal = vertex_normals(xyz, corners)
    return Mesh(xyz, corners, normal, rgb_of(vertices))


def _elements(path: Path, lines: list[list[str]]) -> list[Element]:
    """Name, count and properties of each element of a header."""
    elements: list[Element] = []
    for words in lines:
        if words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) <= 18:
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property" and elements:
            elements[-1][2].append(tuple(words[1:]))
        else:
            raise InputError(f"{path}: expected elements and their properties, found {' '.join(words)[:80]!r}")
    return elements


def _vertex_type(path: Path, fields: list[Field]) -> np.dtype:
    names = [field[-1] for field in fields]
    if any(len(field) != 2 or field[0] not in TYPES for field in fields) or len(set(names)) < len(names):
        raise InputError(f"{path}: expected plain properties of the vertices, found {', '.join(names)}")
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"{path}: expected vertices with x, y and z, found {', '.join(names) or 'none'}")
    return np.dtype([(name, "<" + TYPES[kind]) for kind, name in fields])


def _face_type(path: Path, fields: list[Field]) -> np.dtype:
    """Of faces that are all triangles."""
    words = fields[0] if len(fields) == 1 else ()
    kinds = words[1:3] if len(words) == 4 and words[0] == "list" else ()
    if len(kinds) != 2 or any(TYPES.get(kind, "f4")[0] not in "iu" for kind in kinds):
        found = "; ".join(" ".join(field) for field in fields) or "none"
        raise InputError(f"{path}: expected one property of faces, a list of corners, found {found}")
    return np.dtype([("count", "<" + TYPES[kinds[0]]), ("corners", "<" + TYPES[kinds[1]], 3)])


def _rows(path: Path, data: bytes, start: int, what: str, count: int, dtype: np.dtype) -> NDArray:
    if count * dtype.itemsize > len(data) - start:
        raise InputError(
            f"{path}: truncated: expected {count} {what} of {dtype.itemsize} bytes, found {len(data) - start} bytes"
        )
    return np.frombuffer(data, dtype, count, start)
