"""The sequences of KITTI's odometry benchmark (Geiger, Lenz, Urtasun, CVPR 2012)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera_files.reading import kitti_calibration
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.sequences.files import (
    Recording,
    common_size,
    frame_names,
    list_images,
    times_of_rows,
    warn_of_missing,
)

Array = NDArray[np.float64]

FRAMES_PER_SECOND = 10.0
"""KITTI's rate, where a sequence has lost its times."""
_PAIRS = (("image_0", "image_1"), ("image_2", "image_3"))


def is_kitti(folder: Path) -> bool:
    """Whether a folder holds KITTI's image folders."""
    return any((folder / left).is_dir() for left, _ in _PAIRS)


def read_kitti_sequence(folder: Path, events: Events, only: str | None = None) -> Recording:
    """A sequence folder: ``image_0``, ``image_1`` (or ``image_2``, ``image_3``), calib.txt, times.txt and the poses.

    Args:
        only: the one image folder to use, such as ``image_1``; None: the pair, grey before colour.

    Raises:
        InputError: no image can be read, or a file beside them is not what it should be.
    """
    pair = next((pair for pair in _PAIRS if (folder / pair[0]).is_dir()), _PAIRS[0])
    names = pair if only is None else (only,)
    left = list_images(folder / names[0])
    frames: list[tuple[Path, ...]] = [(path,) for path in left]
    if len(names) > 1:
        frames = with_partners(left, folder / names[1], events)
    left = [frame[0] for frame in frames]
    if not frames:
        raise InputError(f"{folder / names[0]}: expected images, found none")
    used = names[: len(frames[0])]
    sizes = tuple(common_size([frame[i] for frame in frames], str(folder / name)) for i, name in enumerate(used))
    calibration = None
    if (folder / "calib.txt").is_file():
        calibration = kitti_calibration(folder / "calib.txt", sizes, int(names[0][-1]))
    times = times_of_rows(folder / "times.txt", left) if (folder / "times.txt").is_file() else None
    resolved = folder.resolve()
    ground_truth_paths = (folder / "poses.txt", resolved.parent.parent / "poses" / f"{resolved.name}.txt")
    names_of_frames = frame_names(folder, left)
    return Recording(
        "kitti", folder, names_of_frames, times, frames, sizes, calibration, ground_truth_paths=ground_truth_paths
    )  # fmt: skip


def with_partners(left: list[Path], right_folder: Path, events: Events) -> list[tuple[Path, ...]]:
    """Frames of both cameras, by file name without its ending; of the left one alone if no name is in both folders."""
    by_stem = {path.stem: path for path in list_images(right_folder)} if right_folder.is_dir() else {}
    lonely = [path.name for path in left if path.stem not in by_stem]
    if len(lonely) == len(left):  # none of them, also where there are none at all
        return [(path,) for path in left]
    warn_of_missing(events, f"frames of {left[0].parent.name} have no partner in {right_folder.name}", lonely)
    return [(path, by_stem[path.stem]) for path in left if path.stem in by_stem]
