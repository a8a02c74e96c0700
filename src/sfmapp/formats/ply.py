"""Point clouds as PLY (Turk, "The PLY polygon file format", 1994), binary little-endian."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file

# numpy's codes of the types that a header can name, without the byte order
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
LARGEST_HEADER_BYTES = 65536
COLORS = ("red", "green", "blue")


def write_ply(path: str | Path, xyz: NDArray[np.floating], rgb: NDArray[np.uint8]) -> None:
    """Write coloured points, with coordinates of the :func:`coordinate_type`.

    Args:
        xyz: (N, 3) finite.
        rgb: (N, 3) uint8.
    """
    xyz = np.asarray(xyz, np.float64).reshape(-1, 3)
    kind = coordinate_type(xyz)
    data = np.empty(len(xyz), [("xyz", "<" + TYPES[kind], 3), ("rgb", "u1", 3)])
    data["xyz"], data["rgb"] = xyz, rgb
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    lines += [f"property {kind} {axis}" for axis in "xyz"]
    lines += [f"property uchar {color}" for color in COLORS]
    with replaced_file(Path(path)) as beside, beside.open("wb") as file:
        file.write("\n".join([*lines, "end_header", ""]).encode())
        file.write(data.tobytes())


def coordinate_type(xyz: NDArray[np.float64]) -> str:
    """``float``, which every viewer reads, unless that rounds coordinates (N, 3) by more than a millionth of their
    extent (places far from their origin, as georeferenced ones are): then ``double``."""
    with np.errstate(over="ignore"):
        rounded = len(xyz) and np.abs(xyz.astype(np.float32) - xyz).max() > 1e-6 * np.ptp(xyz, axis=0).max()
    return "double" if rounded else "float"


def read_ply(path: str | Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Read points (N, 3) float64 and colours (N, 3) uint8, black where there are none.

    The vertices have to come first; other properties of theirs and other elements (faces) are passed over.

    Raises:
        InputError: as :func:`read_vertices`.
    """
    vertices = read_vertices(path)
    return xyz_of(vertices), rgb_of(vertices)


def read_vertices(path: str | Path) -> NDArray[Any]:
    """Read vertices (N,), a structured array of all their properties, x, y and z among them.

    Raises:
        InputError: the file is missing, not binary little-endian, truncated, or its coordinates are not finite.
    """
    path = Path(path)
    data, lines, start = read_binary(path)
    count, fields = _vertex_fields(path, lines)
    names = [name for name, _ in fields]
    if len(set(names)) < len(names) or not {"x", "y", "z"} <= set(names):
        raise InputError(f"{path}: expected vertices with x, y and z, found {', '.join(names) or 'none'}")
    dtype = np.dtype(fields)
    if count * dtype.itemsize > len(data) - start:
        raise InputError(
            f"{path}: truncated: expected {count} vertices of {dtype.itemsize} bytes, found {len(data) - start} bytes"
        )
    vertices = np.frombuffer(data, dtype, count, start)
    if not np.isfinite(xyz_of(vertices)).all():
        raise InputError(f"{path}: expected finite coordinates, found NaN or infinity")
    return vertices


def xyz_of(vertices: NDArray[Any]) -> NDArray[np.float64]:
    """(N, 3) places of vertices (N,)."""
    return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], 1)


def rgb_of(vertices: NDArray[Any]) -> NDArray[np.uint8]:
    """(N, 3) colours of vertices (N,), black where there are none."""
    if all(color in (vertices.dtype.names or ()) and vertices.dtype[color] == np.uint8 for color in COLORS):
        return np.stack([vertices[color] for color in COLORS], 1)
    return np.zeros((len(vertices), 3), np.uint8)


def read_binary(path: Path) -> tuple[bytes, list[list[str]], int]:
    """A binary little-endian file: its bytes, the words of the header's lines from the first element on, and where what
    they promise begins.

    Raises:
        InputError: the file is missing, or another one.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    end = data.find(b"end_header\n", 0, LARGEST_HEADER_BYTES)
    if not data.startswith(b"ply\n") or end < 0:
        raise InputError(f"{path}: expected a PLY header, found {data[:16]!r}")
    lines = [line.split() for line in data[:end].decode("ascii", "replace").splitlines()[1:]]
    lines = [words for words in lines if words and words[0] not in ("comment", "obj_info")]
    if lines[:1] != [["format", "binary_little_endian", "1.0"]]:
        raise InputError(f"{path}: expected binary little-endian PLY, found {' '.join((lines or [[]])[0])!r}")
    return data, lines[1:], end + len(b"end_header\n")


def _vertex_fields(path: Path, lines: list[list[str]]) -> tuple[int, list[tuple[str, str]]]:
    """Number of vertices, and their fields as numpy takes them."""
    if not lines or lines[0][:2] != ["element", "vertex"] or len(lines[0]) != 3 or not lines[0][2].isdecimal():
        raise InputError(f"{path}: expected the vertices as the first element of the header")
    fields = []
    for words in lines[1:]:
        if words[0] == "element":
            break
        if len(words) != 3 or words[0] != "property" or words[1] not in TYPES:
            raise InputError(f"{path}: expected plain properties of the vertices, found {' '.join(words)!r}")
        fields.append((words[2], "<" + TYPES[words[1]]))
    if len(lines[0][2]) > 18:
        raise InputError(f"{path}: expected a possible number of vertices, found {lines[0][2][:40]}")
    return int(lines[0][2]), fields
