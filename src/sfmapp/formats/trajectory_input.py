"""Trajectories as other programs write them: TUM's, KITTI's and EuRoC's text files, told apart by what is in them.

===== ===================================================================== =========================================
TUM   8 columns: ``timestamp_s tx ty tz qx qy qz qw``                       Sturm et al., IROS 2012
KITTI 12 columns: the rows of world_from_cam (3, 4); line i is frame i      Geiger et al., CVPR 2012
EuRoC 8 columns or more, commas: ``timestamp_ns, px, py, pz, qw, qx, qy, qz`` Burri et al., IJRR 2016
===== ===================================================================== =========================================

All hold world_from_body: of the camera in TUM's and KITTI's ground truth, of the IMU in EuRoC's. Times may be in
another unit (ORB-SLAM3 writes nanoseconds into TUM's form): see :mod:`sfmapp.formats.clocks`. KITTI's rows may be whole
4 x 4 matrices.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.evaluation.trajectory import Trajectory
from sfmapp.formats.clocks import Times, Unit, parse_time, read_column
from sfmapp.formats.text_input import plain_numbers, read_limited_text
from sfmapp.formats.trajectory import frames_beside
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
TrajectoryFormat = Literal["tum", "kitti", "euroc"]

# six digits are customary, three occur
_QUATERNION_TOLERANCE = 1e-2
# entries of a rotation written with three digits; what is further off is scaled, mirrored or no rotation
_ROTATION_TOLERANCE = 5e-3
_MOST_COLUMNS = 16
# four days at 30 frames a second: a larger number is not one of a frame
_MOST_FRAMES = 10**7


@dataclass(frozen=True)
class TrajectoryFile:
    """What a file holds.

    Attributes:
        path, format: where it is from, and what it turned out to be; a kind of sequence if it is one's ground truth.
        trajectory: its poses in the order of the file; a line with "nan" in it is a gap.
        is_numbered: ``PATH.frames`` beside a KITTI trajectory names the frame of each line (see
            :func:`sfmapp.formats.trajectory.write_kitti`): the others are gaps, and the last ones may be missing.
        note: how its times were read, where they are not in the unit of the format; empty otherwise.
        poses: (N, 7) world_from_body, unit quaternions of those in the file, or of the rotations nearest to the
            matrices in it, NaN in gaps; None: as in ``trajectory``.
    """

    path: Path
    format: TrajectoryFormat | Literal["folder", "video", "bag", "arrays"]
    trajectory: Trajectory
    is_numbered: bool = False
    note: str = ""
    poses: Array | None = None

    @property
    def cam_from_world(self) -> Array:
        """(N, 7) poses of the body the other way round, NaN in gaps."""
        return rigid3.inverse(self.trajectory.world_from_body if self.poses is None else self.poses)


@dataclass(frozen=True)
class _Table:
    """The lines of a file: their numbers, their first fields, values (N, C) of up to 17 columns (nan in gaps), the
    names of the columns if a line tells them, and whether commas stand between them."""

    numbers: list[int]
    first: list[str]
    values: Array
    titles: list[str]
    has_commas: bool


def read_trajectory(
    path: str | Path, times: str | Path | None = None, *, like: Array | None = None, is_euroc: bool = False
) -> TrajectoryFile:
    """Read a trajectory in any of the formats above.

    Args:
        path: the file. Lines that begin with ``#`` and empty ones are skipped.
        times: file with the seconds of each line of a KITTI trajectory (``times.txt``); the others have their own.
        like: seconds of another clock of the same recording, which tells units apart.
        is_euroc: the file has its place in EuRoC's layout: columns between commas are EuRoC's, whatever the times.

    Raises:
        InputError: the file has none of the formats, or a line is not like the others; or the times do not fit.
    """
    path = Path(path)
    table = _table(path)
    columns = table.values.shape[1]
    if table.has_commas and columns >= 8:
        clock = _clock(path, table, "ns", like)
        order = [5, 6, 7, 4] if _is_w_first(path, table, is_euroc) else [4, 5, 6, 7]
        poses = _poses(path, table.numbers, table.values[:, 1:4], table.values[:, order])
        return TrajectoryFile(path, "euroc", _trajectory(poses, clock.seconds), note=clock.note, poses=poses)
    if columns == 8:
        clock = _clock(path, table, "s", like)
        poses = _poses(path, table.numbers, table.values[:, 1:4], table.values[:, 4:])
        return TrajectoryFile(path, "tum", _trajectory(poses, clock.seconds), note=clock.note, poses=poses)
    if columns == 12 or (columns == 16 and _are_whole_matrices(table.values)):
        matrix, poses = _matrices(path, table.numbers, table.values[:, :12])
        frames = _frames(path, len(table.values))
        if frames is not None:
            matrix, poses = (_spread(rows, frames) for rows in (matrix, poses))
        trajectory = Trajectory(matrix[:, :, 3], matrix[:, :, :3])
        if times is not None:
            trajectory = replace(trajectory, timestamps_s=_times(Path(times), len(trajectory), path))
        return TrajectoryFile(path, "kitti", trajectory, frames is not None, poses=poses)
    raise InputError(
        f"{path}:{table.numbers[0]}: expected a trajectory, found "
        f"{columns if columns <= _MOST_COLUMNS else f'more than {_MOST_COLUMNS}'} columns",
        "TUM has 8 columns (timestamp tx ty tz qx qy qz qw), KITTI 12 (the rows of a 3 x 4 matrix; 16 of a 4 x 4 "
        "one), EuRoC's data.csv 8 or more with commas between them",
    )


def read_tum(path: str | Path) -> tuple[list[str], Array]:
    """Names and poses of a TUM trajectory without gaps, which may be empty.

    Returns:
        The timestamps as they are written, for names of images come as timestamps too, and cam_from_world (N, 7).

    Raises:
        InputError: a line does not hold eight finite numbers and a quaternion of unit length.
    """
    path = Path(path)
    table = _table(path, may_be_empty=True)
    if not table.first:
        return [], np.zeros((0, 7))
    if table.has_commas or table.values.shape[1] != 8:
        raise InputError(
            f"{path}:{table.numbers[0]}: expected 8 numbers (TUM trajectory: timestamp tx ty tz qx qy qz qw)"
        )
    is_gap = ~np.isfinite(table.values).all(1)
    if is_gap.any():
        raise InputError(f"{path}:{table.numbers[int(np.argmax(is_gap))]}: expected 8 finite numbers, found others")
    return table.first, rigid3.inverse(_poses(path, table.numbers, table.values[:, 1:4], table.values[:, 4:]))


def _table(path: Path, *, may_be_empty: bool = False) -> _Table:
    rows: list[list[float]] = []
    numbers: list[int] = []
    first: list[str] = []
    titles: list[str] = []
    has_commas, columns = False, 0
    for number, line in enumerate(read_limited_text(path).splitlines(), 1):
        text = line.strip().lstrip("\ufeff")
        if not rows and text.startswith(("#", "%")) and "," in text:
            titles = text.lstrip("#% ").split(",")
        if not text or text.startswith(("#", "%")):
            continue
        if not rows:
            has_commas = "," in text
        fields = text.rstrip(",").split(",") if has_commas else text.split()
        try:
            row = plain_numbers(fields)
        except ValueError:
            if not rows and columns == 0 and not any(map(_is_number, fields)):
                columns, titles = -1, fields  # one line of titles
                continue
            raise InputError(f"{path}:{number}: expected numbers, found {text[:80]!r}") from None
        if rows and len(row) != columns:
            raise InputError(f"{path}:{number}: expected {columns} columns as above, found {len(row)}")
        columns = len(row)
        rows.append(row[:8] if has_commas else row[: _MOST_COLUMNS + 1])
        numbers.append(number)
        first.append(fields[0])
    if not rows and not may_be_empty:
        raise InputError(f"{path}: expected a trajectory, found no line of numbers")
    return _Table(numbers, first, np.array(rows, np.float64), titles, has_commas)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _is_w_first(path: Path, table: _Table, is_euroc: bool) -> bool:
    """Whether quaternions between commas are w x y z, as EuRoC's, or x y z w, as of a TUM file with commas.

    Raises:
        InputError: neither a line of titles, nor the layout, nor times in nanoseconds tell.
    """
    for position, title in enumerate(table.titles[:8]):
        if re.fullmatch(r"q_?(\w*_)?w", title.split("[")[0].strip().lower()):
            return position == 4
    values = table.values[:, 0]
    fraction = np.flatnonzero(np.isfinite(values) & (values % 1 != 0))
    if len(fraction) and not is_euroc:
        raise InputError(
            f"{path}:{table.numbers[fraction[0]]}: expected a timestamp in whole nanoseconds, found "
            f"{table.first[fraction[0]][:40]}",
            "timestamps in seconds belong into a TUM file, with spaces between the columns",
        )
    return True


def _are_whole_matrices(values: Array) -> bool:
    return bool((np.isnan(values[:, 12:]) | (values[:, 12:] == [0, 0, 0, 1])).all())


def _matrices(path: Path, numbers: list[int], table: Array) -> tuple[Array, Array]:
    """World_from_body as matrices (N, 3, 4), as they are, and as poses (N, 7), made rotations."""
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
    poses, kept = np.full((len(matrix), 7), np.nan), np.isfinite(matrix).all((1, 2))
    u, _, vt = np.linalg.svd(rotation[kept])
    poses[kept] = rigid3.from_matrix(u @ vt, matrix[kept, :, 3])
    return matrix, poses


def _frames(path: Path, count: int) -> NDArray[np.int64] | None:
    """The frame of each line of a KITTI trajectory with gaps; None where no file tells."""
    sidecar = frames_beside(path)
    if not sidecar.is_file():
        return None
    table = _table(sidecar).values
    frames = table[:, 0]
    whole = np.isfinite(frames).all() and (frames % 1 == 0).all() and (np.diff(frames, prepend=-1) > 0).all()
    if table.shape[1] != 1 or len(frames) != count or not whole or frames[-1] > _MOST_FRAMES:
        raise InputError(f"{sidecar}: expected {count} ascending numbers of frames, one for each line of {path.name}")
    return frames.astype(np.int64)


def _spread(rows: Array, frames: NDArray[np.int64]) -> Array:
    """Rows at the positions of their frames, NaN between them."""
    spread = np.full((int(frames[-1]) + 1, *rows.shape[1:]), np.nan)
    spread[frames] = rows
    return spread


def _trajectory(poses: Array, seconds: Array) -> Trajectory:
    return Trajectory(poses[:, 4:], rigid3.rotation_matrix(poses), seconds)


def _poses(path: Path, numbers: list[int], position: Array, quaternion: Array) -> Array:
    """Poses (N, 7) of positions and of quaternions x y z w that are of unit length but for rounding."""
    norm = np.linalg.norm(quaternion, axis=1)
    wrong = np.abs(norm - 1) > _QUATERNION_TOLERANCE  # false for nan
    if wrong.any():
        first = int(np.argmax(wrong))
        raise InputError(
            f"{path}:{numbers[first]}: expected a quaternion of unit length, found x y z w = "
            f"{' '.join(map('{:g}'.format, quaternion[first]))}"
        )
    # those of full precision keep their digits
    unit = np.where(np.abs(norm - 1)[:, None] > 1e-12, quaternion / norm[:, None], quaternion)
    return np.concatenate([unit, position], 1)


def _clock(path: Path, table: _Table, unit: Unit, like: Array | None) -> Times:
    """The times of the first column. Raises InputError: a line has none."""
    times = []
    for number, text in zip(table.numbers, table.first, strict=True):
        try:
            times.append(parse_time(text))
        except ValueError:
            raise InputError(f"{path}:{number}: expected a timestamp, found {text[:40]!r}") from None
    return read_column(str(path), times, unit, like)


def _times(path: Path, count: int, trajectory: Path) -> Array:
    table = _table(path)
    if table.values.shape[1] != 1 or not np.isfinite(table.values).all():
        raise InputError(f"{path}: expected one number of seconds on each line, found {table.values.shape[1]} columns")
    if len(table.values) != count:
        raise InputError(f"{path}: expected a line for each of the {count} of {trajectory}, found {len(table.values)}")
    return _clock(path, table, "s", None).seconds
