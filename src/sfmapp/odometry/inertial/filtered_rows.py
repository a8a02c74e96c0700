"""The rows of a filter that runs for hours: few in memory, the others in a file without a name.

At 200 samples a second an hour is 720,000 poses with their covariances, 280 MB.
"""

from __future__ import annotations

import tempfile
from array import array
from typing import IO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.odometry.inertial.smoothing import error_from_tangent

Array = NDArray[np.float64]

# Numbers of a row: those of FilteredRow, the pose and its covariance told as they are given out.
_SIZE = 1 + 7 + 36 + 4
# So many numbers wait to be written, 2 MB.
_WAITING = 2**18


class FilteredRow(NamedTuple):
    """A pose that was found: rotation world_from_cam (3, 3), centre (3,), and their covariance (6, 6), centre first;
    for the rest see :class:`~sfmapp.odometry.inertial.filtering.FilteredTrajectory`."""

    timestamp_s: float
    rotation: Array
    center: Array
    covariance: Array
    since_pose_s: float
    is_bridged: bool
    latency_s: float
    widening: float


def as_given(rows: list[FilteredRow]) -> tuple[Array, Array]:
    """Poses (N, 7) cam_from_world, and their covariances (N, 6, 6) in the order of the error of poses."""
    rotation = np.array([row.rotation for row in rows]).reshape(-1, 3, 3)
    centers = np.array([row.center for row in rows]).reshape(-1, 3)
    covariance = np.array([row.covariance for row in rows]).reshape(-1, 6, 6)
    change = np.linalg.inv(error_from_tangent(rotation))
    return rigid3.inverse(rigid3.from_matrix(rotation, centers)), change @ covariance @ change.swapaxes(1, 2)


class FilteredRows:
    """Rows as they are found, which is not quite in the order of their times: frames are late.

    Attributes:
        num_settled: how many will have none before them any more.
    """

    def __init__(self) -> None:
        self.num_settled = 0
        self._open, self._waiting = list[FilteredRow](), array("d")
        self._file: IO[bytes] | None = None

    def add(self, row: FilteredRow) -> None:
        self._open.append(row)

    def settle(self, until_s: float) -> None:
        """No row of this moment or an earlier one will come.

        Raises:
            OSError: the folder of temporary files is full.
        """
        settled = sorted((row for row in self._open if row.timestamp_s <= until_s), key=lambda row: row.timestamp_s)
        self._open = [row for row in self._open if row.timestamp_s > until_s]
        if not settled:
            return
        poses, covariance = as_given(settled)
        rest = [(row.since_pose_s, row.is_bridged, row.latency_s, row.widening) for row in settled]
        times = np.array([row.timestamp_s for row in settled])
        numbers = np.concatenate([times[:, None], poses, covariance.reshape(-1, 36), np.array(rest, float)], 1)
        self._waiting.frombytes(numbers.tobytes())
        self.num_settled += len(settled)
        if len(self._waiting) >= _WAITING:
            self._write()

    def table(self) -> Array:
        """(N, 48) all rows in the order of their times: time, pose, covariance, seconds since a pose, whether it is
        bridged, latency, widening. Those that are in the file stay there, and are read where they are looked at."""
        self.settle(np.inf)
        if self._file is None:
            return np.array(self._waiting).reshape(-1, _SIZE)
        self._write()
        return np.memmap(self._file, np.float64, "r", shape=(self.num_settled, _SIZE))

    def _write(self) -> None:
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="sfmapp-filtered-")  # noqa: SIM115  it lives as long as the rows
        self._waiting.tofile(self._file)
        self._file.flush()
        del self._waiting[:]
