"""What the readers of sequences share: listing frames, their times and sizes, and the files that lie beside them."""

from __future__ import annotations

import bisect
import math
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera_files.reading import Calibration
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.formats.clocks import Times, are_dates, parse_time, read_column, times_of_names
from sfmapp.formats.text_input import read_limited_text
from sfmapp.images.bag_sequence import BagFrames
from sfmapp.images.frame_reader import LARGEST_FRAME_PX, read_regular_file, some
from sfmapp.images.headers import UnusableImage, read_header
from sfmapp.images.sequence import STAGE, GroundTruth, Imu, SequenceKind
from sfmapp.images.sources import is_picture, natural_key, printable

Array = NDArray[np.float64]
Size = tuple[int, int]

_LARGEST_TABLE_BYTES = 1 << 28
# Looked at to learn the size of the frames: a few strays must not decide it.
_SIZES_SAMPLED = 9
# Numbers in file names that leave out more than that are no counts of frames.
_LARGEST_MEAN_GAP = 100


@dataclass(frozen=True)
class Recording:
    """A sequence as its files tell it, before the user's wishes.

    Attributes:
        kind, root: layout, and the folder that names are relative to.
        names: N names of frames.
        times: of the N frames as they are written, not yet in order; None where nothing tells.
        paths: for each frame one file, or two of a pair; one as well where a pair lacks the second.
        sizes: (width, height) of the images of each camera.
        calibration: None if there is none.
        imu, ground_truth: None where there is none, or where the files that may hold the ground truth are
            ``ground_truth_paths``; poses are of the first camera.
        ground_truth_paths: where a trajectory of the body may lie; the first that is there counts.
        notes: how times of the IMU and the ground truth were read, where that is not what the format says.
        bag: where frames lie that are messages of a bag; ``paths`` then hold their names alone, and the pose of an IMU
            that nothing tells is NaN.
    """

    kind: SequenceKind
    root: Path
    names: list[str]
    times: Times | None
    paths: list[tuple[Path, ...]]
    sizes: tuple[Size, ...]
    calibration: Calibration | None
    imu: Imu | None = None
    ground_truth: GroundTruth | None = None
    ground_truth_paths: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()
    bag: BagFrames | None = None


def list_images(folder: Path) -> list[Path]:
    """The image files of a folder in natural order, hidden ones left out. Raises InputError if it cannot be read.

    Names without an ending are as good as others, but what follows a dot may be the fraction of a time: no number is
    taken for an ending here.
    """
    try:
        entries = [Path(entry.path) for entry in os.scandir(folder) if not entry.name.startswith(".")]
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {error.strerror or error}") from error
    files = [path for path in entries if is_picture(path)]
    return sorted(files, key=lambda path: natural_key(path.name))


def has_images(folder: Path) -> bool:
    """Whether a folder holds an image file."""
    try:
        with os.scandir(folder) as entries:
            return any(is_picture(Path(entry.path)) for entry in entries if entry.name[0] != ".")
    except OSError:
        return False


def frame_names(root: Path, paths: Sequence[Path]) -> list[str]:
    """Names of files relative to the sequence, printable."""
    return [printable(os.path.relpath(path, root)) for path in paths]


def confined(root: Path, entry: str, place: str) -> Path:
    """The file that a list names, which must lie below ``root``. Raises InputError if it points elsewhere."""
    pure = PurePosixPath(entry.replace("\\", "/"))
    if not entry or "\0" in entry or pure.is_absolute() or ".." in pure.parts or re.match("[A-Za-z]:", entry):
        raise InputError(f"{place}: expected a file inside of {root}, found {printable(entry[:80])!r}")
    return root / pure


def common_size(paths: Sequence[Path], what: str) -> Size:
    """(width, height) that most of a sample of image files have.

    Raises:
        InputError: none of them can be read.
    """
    sampled = np.unique(np.linspace(0, max(len(paths) - 1, 0), _SIZES_SAMPLED).round().astype(int)).tolist()
    found = [_size_or_problem(paths[i]) for i in sampled] if paths else ["there is no image file"]
    sizes = Counter(size for size in found if not isinstance(size, str))
    if not sizes:  # the first that can be read will have to do
        others = (_size_or_problem(path) for path in paths)
        sizes.update([size for size in [next((s for s in others if not isinstance(s, str)), None)] if size])
    if not sizes:
        raise InputError(f"{what}: expected at least one image that can be read, found none: {found[0]}")
    return max(sizes, key=lambda size: (sizes[size], size))


def _size_or_problem(path: Path) -> Size | str:
    try:
        header = read_header(read_regular_file(path))
    except UnusableImage as reason:
        return f"{path.name}: {reason}"
    if header.width * header.height > LARGEST_FRAME_PX:
        return f"{path.name}: it claims {header.width}x{header.height} pixels"
    return header.width, header.height


def read_rows(path: Path, separator: str | None = None) -> list[tuple[int, list[str]]]:
    """Line numbers and fields of the lines that are neither empty nor comments. Raises InputError as text files do."""
    rows = []
    for number, line in enumerate(read_limited_text(path, _LARGEST_TABLE_BYTES).lstrip("\ufeff").splitlines(), 1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            rows.append((number, [field.strip() for field in stripped.split(separator)]))
    return rows


def read_number_table(path: Path, num_columns: int) -> tuple[list[Decimal], Array]:
    """Times of the first column as they are written, and (N, num_columns) finite numbers of a csv file; further columns
    are left aside, and a first line of names too.

    Raises:
        InputError: a line has too few columns, or one that is no finite number.
    """
    times, table = [], []
    for position, (number, fields) in enumerate(read_rows(path, ",")):
        try:
            row = [float(field) for field in fields[:num_columns]]
        except ValueError:
            row = []
            if position == 0:
                continue
        try:
            times.append(parse_time(fields[0]))
        except ValueError:
            row = []
        if len(row) < num_columns or not all(map(math.isfinite, row)):
            raise InputError(
                f"{path}:{number}: expected {num_columns} numbers and commas, found {','.join(fields)[:80]!r}"
            )
        table.append(row)
    return times, np.array(table, np.float64).reshape(-1, num_columns)


def read_times(path: Path) -> Times:
    """Seconds from the first column of a list of times; ``2011-09-26 13:02:25.964`` is one as well, in UTC.

    Raises:
        InputError: a line is no time.
    """
    numbers: list[Decimal] = []
    moments: list[float] = []
    for number, fields in read_rows(path):
        try:
            numbers.append(parse_time(fields[0].split(",")[0]))
            continue
        except ValueError:
            pass
        try:
            moment = datetime.fromisoformat(" ".join(fields[:2]))
            moments.append(moment.replace(tzinfo=moment.tzinfo or UTC).timestamp())
        except (ValueError, OverflowError):
            raise InputError(f"{path}:{number}: expected a time, found {' '.join(fields)[:80]!r}") from None
    if numbers and moments:
        raise InputError(f"{path}: expected times of one kind, found {len(numbers)} numbers and {len(moments)} dates")
    return Times(np.array(moments, np.float64), "s") if moments else read_column(str(path), numbers, "s")


def frame_numbers(paths: Sequence[Path]) -> NDArray[np.int64] | None:
    """(N,) numbers that the file names count with: ``000123.png``, ``frame_0123.jpg``; None if they do not count up,
    or tell times instead."""
    stems = [path.stem for path in paths]
    parts = [re.split(r"(\d+)", stem) for stem in stems]
    if not parts or any(len(part) != len(parts[0]) or part[::2] != parts[0][::2] for part in parts):
        return None
    varying = [i for i in range(1, len(parts[0]), 2) if any(part[i] != parts[0][i] for part in parts)]
    if len(parts) == 1 or len(varying) != 1:
        return np.arange(1) if len(parts) == 1 else None
    if any(len(part[varying[0]]) > 15 for part in parts) or are_dates(stems) or times_of_names(stems) is not None:
        return None
    numbers = np.array([int(part[varying[0]]) for part in parts], np.int64)
    if (np.diff(numbers) <= 0).any() or numbers[-1] - numbers[0] > _LARGEST_MEAN_GAP * len(numbers):
        return None
    return numbers


def times_in_names(paths: Sequence[Path]) -> Times | None:
    """Seconds of the frames where their names are times (see :func:`~sfmapp.formats.clocks.times_of_names`)."""
    return times_of_names([path.stem for path in paths])


def rows_of_frames(num_rows: int, paths: Sequence[Path]) -> NDArray[np.int64] | None:
    """(N,) which rows of a list without names belong to the frames: one each, or by number where frames were taken
    out; None if neither fits."""
    if num_rows == len(paths):
        return np.arange(num_rows)
    if not all(re.fullmatch(r"\d{1,12}", path.stem) for path in paths):
        return None
    numbers = np.array([int(path.stem) for path in paths], np.int64)
    return numbers if len(numbers) and numbers.max() < num_rows else None


def ascending(timestamps_s: Array) -> NDArray[np.int64]:
    """Positions of the longest strictly ascending choice of times, so that one wild value costs one frame alone.

    Patience sorting: the smallest end of a chain of each length, and each element's predecessor in its chain.
    """
    ends: list[float] = []
    last: list[int] = []
    previous = np.full(len(timestamps_s), -1, np.int64)
    for i, time in enumerate(timestamps_s.tolist()):
        length = bisect.bisect_left(ends, time)
        if length == len(ends):
            ends.append(time)
            last.append(i)
        elif time < ends[length]:
            ends[length], last[length] = time, i
        previous[i] = last[length - 1] if length else -1
    chain = []
    i = last[-1] if last else -1
    while i >= 0:
        chain.append(i)
        i = int(previous[i])
    return np.array(chain[::-1], np.int64)


def times_of_rows(path: Path, paths: Sequence[Path]) -> Times:
    """Seconds of the N frames from a list of times without names.

    Raises:
        InputError: a line is no time, or there are not as many lines as frames.
    """
    times = read_times(path)
    rows = rows_of_frames(len(times.seconds), paths)
    if rows is None:
        raise InputError(
            f"{path}: expected a line for each of {len(paths)} frames, found {len(times.seconds)}",
            "take the file away and give the rate with --fps, or complete it",
        )
    return times.at(rows)


def in_order(ground_truth: GroundTruth) -> GroundTruth:
    """The same poses, ascending in time, one for each time."""
    times, first = np.unique(ground_truth.timestamps_s, return_index=True)
    return GroundTruth(times, ground_truth.cam_from_world[first])


def warn_of_missing(events: Events, what: str, names: list[str]) -> None:
    """One warning for files that a list names and that are not there, or that have no partner."""
    if names:
        events.warned(STAGE, f"{len(names)} {what}: {some(names)}", names=names)
