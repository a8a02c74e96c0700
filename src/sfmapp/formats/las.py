"""Point clouds as LAS 1.4 and LAZ (ASPRS, "LAS Specification 1.4 - R15", 2019), by laspy and lazrs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file
from sfmapp.packages import require

Array = NDArray[np.float64]

# Coordinates are whole numbers of steps: ten million of them across a cloud, far below what its points are known by.
_STEPS = 1e7
_COLOURED = 7  # point format with a colour
_EIGHT_TO_SIXTEEN = 257


@dataclass(frozen=True)
class LasCloud:
    """What a LAS file holds: xyz (N, 3) float64, rgb (N, 3) uint8, and the WKT of its coordinate system, if any."""

    xyz: Array
    rgb: NDArray[np.uint8]
    wkt: str | None


def step_of(xyz: Array) -> float:
    """The power of ten that coordinates (N, 3) are rounded to."""
    extent = float(np.ptp(xyz, axis=0).max()) if len(xyz) else 1.0
    return float(10.0 ** np.floor(np.log10(max(extent, 1e-9) / _STEPS)))


def write_las(path: str | Path, xyz: Array, rgb: NDArray[np.uint8], wkt: str | None = None) -> None:
    """Write coloured points; compressed if the name ends in ``.laz``.

    Args:
        xyz: (N, 3) finite; written about an offset near them, to :func:`step_of`.
        rgb: (N, 3) uint8.
        wkt: coordinate system; None for none.

    Raises:
        MissingPackageError: laspy is not installed.
        InputError: it cannot be written.
    """
    require("laspy", "lazrs")
    import laspy

    path, xyz = Path(path), np.asarray(xyz, np.float64).reshape(-1, 3)
    header = laspy.LasHeader(point_format=_COLOURED, version="1.4")
    header.generating_software = "sfmapp"
    header.scales = np.full(3, step_of(xyz))
    header.offsets = np.floor(xyz.min(0)) if len(xyz) else np.zeros(3)
    if wkt is not None:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    # demanded of this point format, with a system or without
    header.global_encoding.wkt = True
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = xyz.T
    cloud.red, cloud.green, cloud.blue = rgb.astype(np.uint16).reshape(-1, 3).T * np.uint16(_EIGHT_TO_SIXTEEN)
    with replaced_file(path) as beside, beside.open("wb") as file:
        cloud.write(file, do_compress=path.suffix.lower() == ".laz")


def read_las(path: str | Path) -> LasCloud:
    """Read the points of a LAS or LAZ with colours. Raises InputError if it is none."""
    require("laspy", "lazrs")
    import laspy

    try:
        cloud = laspy.read(path)
    except (OSError, ValueError, laspy.errors.LaspyException) as error:
        raise InputError(f"{path}: cannot be read as LAS: {error}") from error
    if "red" not in cloud.point_format.dimension_names:
        raise InputError(f"{path}: expected points with colours, found point format {cloud.point_format.id}")
    rgb = np.stack([cloud.red, cloud.green, cloud.blue], -1) // _EIGHT_TO_SIXTEEN
    found = [vlr.string for vlr in cloud.header.vlrs if isinstance(vlr, laspy.vlrs.known.WktCoordinateSystemVlr)]
    xyz = np.stack([cloud.x, cloud.y, cloud.z], -1).astype(np.float64)
    return LasCloud(xyz, rgb.astype(np.uint8), found[0].rstrip("\0") if found else None)
