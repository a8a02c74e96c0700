"""Trajectories as text: one pose per line, ``timestamp tx ty tz qx qy qz qw``, world_from_cam (Sturm et al., "A
benchmark for the evaluation of RGB-D SLAM systems", IROS 2012)."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.text_input import finite_array, plain_numbers, read_limited_text
from sfmapp.geometry import rigid3

_HEAD = "# timestamp tx ty tz qx qy qz qw\n"


def write_tum(path: str | Path, timestamps_s: ArrayLike, cam_from_world: NDArray[np.float64]) -> None:
    """Write the poses that are there.

    Args:
        timestamps_s: (N,) seconds.
        cam_from_world: (N, 7), NaN where unregistered: such poses are left out.
    """
    lines = _lines(np.asarray(timestamps_s, np.float64), cam_from_world)
    with replaced_file(Path(path)) as beside:
        beside.write_text(_HEAD + "".join(lines), encoding="utf-8")


class GrowingTum:
    """A trajectory on disk as it grows: each pose is handed to the system at once, whole, and survives a killed run.

    Raises:
        OSError: the file cannot be written; what it held before of this trajectory stays readable.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)
        self._size = 0
        self._write(_HEAD)

    def append(self, timestamp_s: float, cam_from_world: NDArray[np.float64]) -> None:
        """Add a pose (7,), if it is one."""
        for line in _lines(np.array([timestamp_s]), cam_from_world[None]):
            self._write(line)

    def close(self) -> None:
        self._file.close()

    def _write(self, line: str) -> None:
        data = line.encode()
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError:
            with contextlib.suppress(OSError):  # half a line would spoil the file
                self._file.truncate(self._size)
                self._file.seek(self._size)
            raise
        self._size += len(line)


def _lines(timestamps_s: NDArray[np.float64], cam_from_world: NDArray[np.float64]) -> list[str]:
    """A line for each of the poses (N, 7) that are there."""
    kept = np.isfinite(cam_from_world).all(1)
    world_from_cam = rigid3.inverse(cam_from_world[kept])
    rows = np.concatenate([timestamps_s[kept, None], world_from_cam[:, 4:], world_from_cam[:, :4]], 1)
    return [" ".join(map(repr, row)) + "\n" for row in rows.tolist()]


def read_tum(path: str | Path) -> tuple[list[str], NDArray[np.float64]]:
    """Read timestamps as they are written, for names come as timestamps too, and cam_from_world (N, 7) float64.

    Raises:
        InputError: a line does not hold eight finite numbers and a quaternion of unit length.
    """
    path = Path(path)
    names, rows = [], []
    for number, line in enumerate(read_limited_text(path).splitlines(), 1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        place = f"{path}:{number}"
        try:
            rows.append(finite_array(place, plain_numbers(fields), (8,)))
        except ValueError:
            raise InputError(f"{place}: expected 8 finite numbers, found {line[:80]!r}") from None
        if abs(np.hypot.reduce(rows[-1][4:]) - 1) > 1e-2:  # six digits are customary, three occur
            raise InputError(f"{place}: expected a quaternion of unit length, found {fields[4:]}")
        names.append(fields[0])
    table = np.array(rows, np.float64).reshape(-1, 8)
    norm = np.linalg.norm(table[:, 4:], axis=1, keepdims=True)
    unit = np.where(np.abs(norm - 1) > 1e-12, table[:, 4:] / np.where(norm > 0, norm, 1), table[:, 4:])
    return names, rigid3.inverse(np.concatenate([unit, table[:, 1:4]], 1))
