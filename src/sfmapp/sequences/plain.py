"""Sequences that follow no benchmark: a folder of images, or ``left`` and ``right``; and calibrations beside them."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path

from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.formats.clocks import Times, parse_time, read_column
from sfmapp.images.sources import find_images
from sfmapp.sequences.files import (
    Recording,
    common_size,
    frame_names,
    has_images,
    list_images,
    read_rows,
    times_in_names,
    times_of_rows,
)
from sfmapp.sequences.kitti import with_partners

_PAIRS = (
    ("left", "right"), ("cam0", "cam1"), ("image_left", "image_right"), ("images_left", "images_right"),
    ("camera_0", "camera_1"), ("image_00", "image_01"), ("cam_left", "cam_right"),
)  # fmt: skip
_TIMES = ("times.txt", "timestamps.txt", "timestamp.txt", "data.csv", "times.csv", "timestamps.csv", "rgb.txt")
_GROUND_TRUTHS = ("groundtruth.txt", "groundtruth.tum", "groundtruth.csv", "poses.txt")
_CALIBRATION_STEMS = (
    "calib", "calibration", "camera", "intrinsics", "camera_info", "camchain", "stereo", "sensor", "ost",
)  # fmt: skip
_CALIBRATIONS = (
    *(stem + ending for stem in _CALIBRATION_STEMS for ending in (".json", ".yaml", ".yml", ".xml", ".txt")),
    "cameras.txt", "K.txt", "dso/camchain.yaml",
)  # fmt: skip


def find_calibration(*folders: Path) -> Path | None:
    """The first file in the folders that has a name of a calibration; None if there is none."""
    for folder in folders:
        for name in _CALIBRATIONS:
            if (folder / name).is_file():
                return folder / name
        others = sorted(folder.glob("*camchain*.yaml")) if folder.is_dir() else []
        if others:
            return others[0]
    return None


def find_pair(folder: Path) -> tuple[Path, Path] | None:
    """Folders of the left and the right images in a folder; None if there are none."""
    for names in _PAIRS:
        left, right = (_folder_of_images(folder / name) for name in names)
        if left is not None and right is not None:
            return left, right
    return None


def _folder_of_images(folder: Path) -> Path | None:
    return next((candidate for candidate in (folder, folder / "data") if has_images(candidate)), None)


def read_pair_sequence(root: Path, left: Path, right: Path, events: Events) -> Recording:
    """Images of two folders, paired by their file names, or in order where the names differ and the counts agree.

    Raises:
        InputError: no image can be read, or times beside them do not fit.
    """
    files, others = list_images(left), list_images(right)
    frames = with_partners(files, right, events)
    if frames and len(frames[0]) == 1:
        if len(files) != len(others):
            raise InputError(
                f"{right}: expected images named like those of {left.name}, or as many of them ({len(files)}), found "
                f"{len(others)} with other names"
            )
        frames = list(zip(files, others, strict=True))
    first = [frame[0] for frame in frames]
    sizes = (common_size(first, str(left)), common_size([frame[1] for frame in frames], str(right)))
    times = _times(first, left, left.parent, root)
    return Recording(
        "folder", root, frame_names(root, first), times, frames, sizes, None, ground_truth_paths=_ground_truths(root)
    )


def read_folder_sequence(root: Path, folder: Path) -> Recording:
    """The images of a folder in natural order of their names; ``root`` is where what belongs to them lies.

    Raises:
        InputError: no image can be read, or times beside them do not fit.
    """
    return _of_files(root, list_images(folder), str(folder), (folder, root))


def read_listed_sequence(source: str) -> Recording:
    """The images of a glob pattern or of a text file that lists them. Raises InputError as a folder does."""
    found = find_images(source)
    return _of_files(found.root, found.paths, source, (found.root,))


def _of_files(root: Path, files: list[Path], what: str, folders: tuple[Path, ...]) -> Recording:
    size = common_size(files, what)
    frames: list[tuple[Path, ...]] = [(path,) for path in files]
    times = _times(files, *folders)
    return Recording(
        "folder", root, frame_names(root, files), times, frames, (size,), None, ground_truth_paths=_ground_truths(root)
    )


def _ground_truths(root: Path) -> tuple[Path, ...]:
    return tuple(root / name for name in _GROUND_TRUTHS)


def _times(files: list[Path], *folders: Path) -> Times | None:
    """Seconds of the files from a list beside the images, or from their names; None where neither tells."""
    for folder in folders:
        for name in _TIMES:
            if (folder / name).is_file():
                return _listed_times(folder / name, files)
    return times_in_names(files)


def _listed_times(path: Path, files: list[Path]) -> Times:
    """Times of a list that names the files, before or behind the time, or has a line for each of them."""
    position = {key: i for i, file in reversed(list(enumerate(files))) for key in (file.name, file.stem)}
    times: list[Decimal | None] = [None] * len(files)
    for _, fields in read_rows(path):
        values = [field for part in fields for field in part.split(",") if field]
        if len(values) < 2:
            continue
        named = [(values[k].rsplit("/", 1)[-1], values[1 - k]) for k in (0, 1)]
        told = [(position[name], _time_or_none(time)) for name, time in named if name in position]
        found = next(((i, time) for i, time in told if time is not None), None)
        if told and found is None:
            raise InputError(f"{path}: expected a time and a file name, found {' '.join(values[:2])[:80]!r}")
        if found is not None:
            times[found[0]] = found[1]
    known = [time for time in times if time is not None]
    if not known:
        return times_of_rows(path, files)
    if len(known) < len(files):
        missing = files[times.index(None)].name
        raise InputError(f"{path}: expected the times of all {len(files)} images, found none of {missing}")
    return read_column(str(path), known, "ns" if path.name == "data.csv" else "s")


def _time_or_none(text: str) -> Decimal | None:
    try:
        return parse_time(text)
    except ValueError:
        return None
