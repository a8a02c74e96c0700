"""Writing trajectories as text; :mod:`sfmapp.formats.trajectory_input` reads them.

TUM's form has one pose per line, ``timestamp tx ty tz qx qy qz qw``, world_from_cam (Sturm et al., "A benchmark for the
evaluation of RGB-D SLAM systems", IROS 2012). KITTI's has a line per frame: the 12 numbers, row by row, of the 3 x 4
matrix world_from_cam of camera 0 (left grey), relative to the first frame; there are no times and no gaps: line i is
frame i (Geiger, Lenz, Urtasun, CVPR 2012).
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.formats.atomic import replaced_file
from sfmapp.geometry import rigid3

_HEAD = "# timestamp tx ty tz qx qy qz qw\n"
_AT_ONCE = 10_000


def write_tum(path: str | Path, timestamps_s: ArrayLike, cam_from_world: NDArray[np.float64]) -> None:
    """Write the poses that are there.

    Args:
        timestamps_s: (N,) seconds.
        cam_from_world: (N, 7), NaN where unregistered: such poses are left out.
    """
    times = np.asarray(timestamps_s, np.float64)
    with replaced_file(Path(path)) as beside, beside.open("w", encoding="utf-8") as file:
        file.write(_HEAD)
        for first in range(0, len(times), _AT_ONCE):  # hours of a sensor's samples would be a gigabyte of text
            some = slice(first, first + _AT_ONCE)
            file.writelines(_lines(times[some], cam_from_world[some]))


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


def write_kitti(path: str | Path, cam_from_world: NDArray[np.float64], frame_idx: ArrayLike | None = None) -> None:
    """Write a trajectory, relative to its first pose.

    The benchmark's tools take line i for frame i and know no gaps. So a frame without a pose has no line, and nothing
    is invented for it: then ``PATH.frames`` beside it names the frame of each line, one number a line. Where that file
    is missing the trajectory is whole, and tools may read it as it is.

    Args:
        cam_from_world: (F, 7), NaN where there is no pose.
        frame_idx: (F,) ascending positions of the frames in the sequence, where some were left out; None: 0 to F - 1.

    Raises:
        InputError: the file cannot be written.
    """
    path = Path(path)
    numbers = np.arange(len(cam_from_world)) if frame_idx is None else np.asarray(frame_idx, np.int64)
    has_pose = np.isfinite(cam_from_world).all(1)
    poses = np.asarray(cam_from_world, np.float64)[has_pose]
    relative = rigid3.compose(poses[:1], rigid3.inverse(poses)) if len(poses) else poses
    matrices = rigid3.to_matrix(relative).reshape(-1, 12)
    with replaced_file(path) as beside:
        beside.write_text("".join(" ".join(f"{v:.9e}" for v in row) + "\n" for row in matrices), encoding="utf-8")
    sidecar = frames_beside(path)
    if has_pose.all() and np.array_equal(numbers, np.arange(len(numbers))):
        sidecar.unlink(missing_ok=True)
        return
    with replaced_file(sidecar) as beside:
        beside.write_text("".join(f"{number}\n" for number in numbers[has_pose]), encoding="utf-8")


def frames_beside(path: Path) -> Path:
    """Where the numbers of the frames of a KITTI trajectory are, if it has gaps."""
    return path.with_name(path.name + ".frames")
