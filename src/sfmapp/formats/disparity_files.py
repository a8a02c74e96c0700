"""Disparity maps as files: PFM (Middlebury, 2014), 16-bit PNG (KITTI, 2012) and NPY.

In arrays they are float32 pixels x_left - x_right, NaN where unknown. PFM has inf there, and its lowest row first; the
PNG has 256 times the disparity, rounded, and zero where unknown, so it holds what is above zero and below 256 alone.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError, remedy
from sfmapp.formats.atomic import write_array, write_bytes

Disparity = NDArray[np.float32]

KITTI_SCALE = 256.0
_SUFFIXES = (".pfm", ".png", ".npy")
# Pf is grey, PF has three channels; the sign of the scale says which byte comes first
_PFM_HEADER = re.compile(rb"(Pf|PF)\s+(\d{1,6})\s+(\d{1,6})\s+([-+]?[0-9.]+(?:[eE][-+]?\d+)?)[ \t]*\r?\n")


def write_disparity(path: str | Path, disparity: Disparity) -> None:
    """Write disparities (H, W) in the format that the name ends in: ``.pfm``, ``.png`` (KITTI) or ``.npy``.

    Raises:
        InputError: no such ending, a disparity that the format cannot hold, or the file cannot be written.
    """
    path = Path(path)
    values = np.where(np.isfinite(disparity), disparity, np.nan).astype(np.float32)
    suffix = _suffix_of(path)
    if suffix == ".png" and not fits_kitti(values):
        low, high = np.nanmin(values), np.nanmax(values)
        raise InputError(
            f"{path}: KITTI's PNG holds disparities from 1/256 to 65535/256 pixels, found {low:g} to {high:g}",
            "Write a PFM or an NPY file.",
        )
    if suffix == ".npy":
        write_array(path, values)
    else:
        write_bytes(path, _pfm(values) if suffix == ".pfm" else _kitti(values))


def read_disparity(path: str | Path) -> Disparity:
    """Disparities (H, W) of a file that :func:`write_disparity`, Middlebury or KITTI wrote; NaN where unknown.

    Raises:
        InputError: it is none of these, or damaged.
    """
    path = Path(path)
    suffix = _suffix_of(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}", remedy(error)) from error
    if suffix == ".npy":
        return _from_npy(path)
    return _from_pfm(path, data) if suffix == ".pfm" else _from_kitti(path, data)


def fits_kitti(disparity: Disparity) -> bool:
    """Whether KITTI's PNG can hold all finite disparities."""
    steps = np.rint(KITTI_SCALE * np.float64(disparity[np.isfinite(disparity)]))
    return bool(((steps >= 1) & (steps <= 65535)).all())


def _suffix_of(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise InputError(f"{path}: expected a disparity map ending in {', '.join(_SUFFIXES)}, found {suffix or 'none'}")
    return suffix


def _pfm(values: Disparity) -> bytes:
    height, width = values.shape
    rows = np.where(np.isnan(values), np.float32(np.inf), values)[::-1]
    return f"Pf\n{width} {height}\n-1\n".encode() + rows.astype("<f4").tobytes()


def _kitti(values: Disparity) -> bytes:
    import cv2

    steps = np.where(np.isnan(values), 0.0, np.rint(KITTI_SCALE * np.float64(values)))
    _, data = cv2.imencode(".png", steps.astype(np.uint16))
    return bytes(data)


def _from_pfm(path: Path, data: bytes) -> Disparity:
    header = _PFM_HEADER.match(data)
    if header is None or header[1] != b"Pf":
        start = "three channels" if header else repr(data[:12])
        raise InputError(f"{path}: expected a grey PFM file, which begins with Pf, width, height, scale; found {start}")
    width, height, scale = int(header[2]), int(header[3]), float(header[4])
    if scale == 0 or not np.isfinite(scale) or width == 0 or height == 0:
        raise InputError(f"{path}: expected a size and a scale other than zero, found {width} x {height}, {scale:g}")
    num_bytes, expected = len(data) - header.end(), 4 * width * height
    if num_bytes != expected:
        raise InputError(f"{path}: expected {expected} bytes for {width} x {height} numbers, found {num_bytes}")
    values = np.frombuffer(data, "<f4" if scale < 0 else ">f4", offset=header.end()).reshape(height, width)[::-1]
    return np.where(np.isfinite(values), values, np.nan).astype(np.float32)


def _from_kitti(path: Path, data: bytes) -> Disparity:
    import cv2

    steps = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if steps is None or steps.dtype != np.uint16 or steps.ndim != 2:
        found = "no picture" if steps is None else f"{steps.dtype} of shape {steps.shape}"
        raise InputError(
            f"{path}: expected a PNG of one channel with 16 bits, 256 times the disparity (KITTI), found {found}",
            "Divide an 8-bit PNG by the scale that its authors tell, and save it as NPY.",
        )
    return np.where(steps > 0, steps / np.float32(KITTI_SCALE), np.nan).astype(np.float32)


def _from_npy(path: Path) -> Disparity:
    try:
        values = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{path}: expected a NumPy array file: {error}") from error
    if not isinstance(values, np.ndarray) or values.ndim != 2 or values.dtype.kind not in "fiu" or not values.size:
        found = f"{values.dtype} of shape {values.shape}" if isinstance(values, np.ndarray) else "an archive"
        raise InputError(f"{path}: expected an array of two dimensions of numbers, found {found}")
    return np.where(np.isfinite(values), values, np.nan).astype(np.float32)
