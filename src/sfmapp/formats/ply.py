"""Point clouds as PLY (Turk, "The PLY polygon file format", 1994), binary little-endian."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.formats.atomic import replaced_file

# numpy's codes of the types that a header can name, without the byte order
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
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
