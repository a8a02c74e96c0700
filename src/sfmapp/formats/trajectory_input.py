"""Trajectories as other programs write them: TUM's, KITTI's and EuRoC's text files, told apart by what is in them.

===== ===================================================================== =========================================
TUM   8 columns: ``timestamp_s tx ty tz qx qy qz qw``                       Sturm et al., IROS 2012
KITTI 12 columns: the rows of world_from_cam (3, 4); line i is frame i      Geiger et al., CVPR 2012
EuRoC 8 columns or more, commas: ``timestamp_ns, px, py, pz, qw, qx, qy, qz`` Burri et al., IJRR 2016
===== ===================================================================== =========================================

All hold world_from_body: of the camera in TUM's and KITTI's truth, of the IMU in EuRoC's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.evaluation.trajectory import Trajectory
from sfmapp.formats.text_input import read_limited_text
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import SequenceKind

Array = NDArray[np.float64]
TrajectoryFormat = Literal["tum", "kitti", "euroc"]

# six digits are customary, three occur
_QUATERNION_TOLERANCE = 1e-2
# entries of a rotation written with three digits; what is further off is scaled, mirrored or no rotation
_ROTATION_TOLERANCE = 5e-3
# four days at 30 frames a second: a larger number is not one of a frame
_MOST_FRAMES = 10**7


@dataclass(frozen=True)
class TrajectoryFile:
    """What a file holds.

    Attributes:
        path, format: where it is from, and what it turned out to be; a kind of sequence if it is one's truth.
        trajectory: its poses in the order of the file; a line with "nan" in it is a gap.
        is_numbered: ``PATH.frames`` beside a KITTI trajectory names the frame of each line (see
            :func:`sfmapp.formats.kitti.write_kitti`): the others are gaps, and the last ones may be missing.
    """

    path: Path
    format: TrajectoryFormat | SequenceKind
    trajectory: Trajectory
    is_numbered: bool = False


def read_trajectory(path: str | Path, times: str | Path | None = None) -> TrajectoryFile:
    """Read a trajectory in any of the formats above.

    Args:
        path: the file. Lines that begin with ``#`` and empty ones are skipped.
        times: file with the seconds of each line of a KITTI trajectory (``times.txt``); the others have their own.

    Raises:
        InputError: the file has none of the formats, or a line is not like the others; or the times do not fit.
    """
    path = Path(path)
    numbers, table, has_commas = _table(path)
    columns = table.shape[1]
    if has_commas and columns >= 8:
        return TrajectoryFile(path, "euroc", _euroc(path, numbers, table))
    if columns == 8:
        rotation = _rotations(path, numbers, table[:, 4:])
        return TrajectoryFile(path, "tum", Trajectory(table[:, 1:4], rotation, _timestamps(path, numbers, table[:, 0])))
    if columns == 12:
        trajectory = _kitti(path, numbers, table)
        frames = _frames(path, len(table))
        if frames is not None:
            trajectory = _spread(trajectory, frames)
        if times is not None:
            trajectory = replace(trajectory, timestamps_s=_times(Path(times), len(trajectory), path))
        return TrajectoryFile(path, "kitti", trajectory, frames is not None)
    raise InputError(
        f"{path}:{numbers[0]}: expected a trajectory, found {columns} columns",
        "TUM has 8 columns (timestamp tx ty tz qx qy qz qw), KITTI 12 (the rows of a 3 x 4 matrix), EuRoC's "
        "data.csv 8 or more with commas between them",
    )


def _table(path: Path) -> tuple[list[int], Array, bool]:
    """Line numbers, values (N, C) of up to 12 columns (nan in gaps), and whether commas stand between them."""
    rows: list[list[float]] = []
    numbers: list[int] = []
    has_commas, columns = False, 0
    for number, line in enumerate(read_limited_text(path).splitlines(), 1):
        text = line.strip().lstrip("\ufeff")
        if not text or text.startswith(("#", "%")):
            continue
        if not rows:
            has_commas = "," in text
        fields = text.rstrip(",").split(",") if has_commas else text.split()
        try:
            row = [float(field) for field in fields]
        except ValueError:
            if not rows and columns == 0 and not any(map(_is_number, fields)):
                columns = -1  # one line of titles
                continue
            raise InputError(f"{path}:{number}: expected numbers, found {text[:80]!r}") from None
        if rows and len(row) != columns:
            raise InputError(f"{path}:{number}: expected {columns} columns as above, found {len(row)}")
        columns = len(row)
        rows.append(row[:8] if has_commas else row[:13])
        numbers.append(number)
    if not rows:
        raise InputError(f"{path}: expected a trajectory, found no line of numbers")
    return numbers, np.array(rows, np.float64), has_commas


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _euroc(path: Path, numbers: list[int], table: Array) -> Trajectory:
    fraction = np.flatnonzero(np.isfinite(table[:, 0]) & (table[:, 0] % 1 != 0))
    if len(fraction):
        raise InputError(
            f"{path}:{numbers[fraction[0]]}: expected a timestamp in whole nanoseconds, found {table[fraction[0], 0]}",
            "timestamps in seconds belong into a TUM file, with spaces between the columns",
        )
    times = _timestamps(path, numbers, table[:, 0]) / 1e9
    return Trajectory(table[:, 1:4], _rotations(path, numbers, table[:, [5, 6, 7, 4]]), times)


def _kitti(path: Path, numbers: list[int], table: Array) -> Trajectory:
    matrix = table.reshape(-1, 3, 4)
    rotation = matrix[:, :, :3]
    with np.errstate(invalid="ignore"):  # gaps are nan
        off = np.abs(rotation @ rotation.swapaxes(-1, -2) - np.eye(3)).max((1, 2))
        # each product sums three entries, twice
        wrong = (off > 6 * _ROTATION_TOLERANCE) | (np.linalg.det(np.nan_to_num(rotation)) < 0)
    if wrong.any():
        first = int(np.argmax(wrong))
        raise InputError(
            f"{path}:{numbers[first]}: expected a rotation in columns 1-3, 5-7, 9-11, found {rotation[first].tolist()}"
        )
    return Trajectory(matrix[:, :, 3], rotation)


def _frames(path: Path, count: int) -> NDArray[np.int64] | None:
    """The frame of each line of a KITTI trajectory with gaps; None where no file tells."""
    sidecar = path.with_name(path.name + ".frames")
    if not sidecar.is_file():
        return None
    _, table, _ = _table(sidecar)
    frames = table[:, 0]
    whole = np.isfinite(frames).all() and (frames % 1 == 0).all() and (np.diff(frames, prepend=-1) > 0).all()
    if table.shape[1] != 1 or len(frames) != count or not whole or frames[-1] > _MOST_FRAMES:
        raise InputError(f"{sidecar}: expected {count} ascending numbers of frames, one for each line of {path.name}")
    return frames.astype(np.int64)


def _spread(trajectory: Trajectory, frames: NDArray[np.int64]) -> Trajectory:
    count = int(frames[-1]) + 1
    position, rotation = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
    position[frames], rotation[frames] = trajectory.position, trajectory.rotation
    return Trajectory(position, rotation)


def _rotations(path: Path, numbers: list[int], quaternion: Array) -> Array:
    """Rotations (N, 3, 3) of quaternions x y z w that are of unit length but for rounding."""
    norm = np.linalg.norm(quaternion, axis=1)
    wrong = np.abs(norm - 1) > _QUATERNION_TOLERANCE  # false for nan
    if wrong.any():
        first = int(np.argmax(wrong))
        raise InputError(
            f"{path}:{numbers[first]}: expected a quaternion of unit length, found x y z w = "
            f"{' '.join(map('{:g}'.format, quaternion[first]))}"
        )
    return rigid3.rotation_matrix(quaternion / norm[:, None])


def _timestamps(path: Path, numbers: list[int], values: Array) -> Array:
    if not np.isfinite(values).all():
        raise InputError(f"{path}:{numbers[int(np.argmin(np.isfinite(values)))]}: expected a timestamp, found none")
    return values


def _times(path: Path, count: int, trajectory: Path) -> Array:
    _, table, _ = _table(path)
    if table.shape[1] != 1 or not np.isfinite(table).all():
        raise InputError(f"{path}: expected one number of seconds on each line, found {table.shape[1]} columns")
    if len(table) != count:
        raise InputError(f"{path}: expected a line for each of the {count} of {trajectory}, found {len(table)}")
    return table[:, 0]
