"""KITTI's odometry benchmark (Geiger, Lenz, Urtasun, CVPR 2012): its sequences and its trajectories.

A trajectory has a line per frame: the 12 numbers, row by row, of the 3 x 4 matrix world_from_cam of camera 0 (left
grey), relative to the first frame. There are no times and no gaps: line i is frame i.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.calibration.reading import kitti_calibration
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.text_input import nearest_rotation, plain_numbers
from sfmapp.geometry import rigid3
from sfmapp.sequences.files import (
    Recording,
    common_size,
    frame_names,
    list_images,
    read_rows,
    times_of_rows,
    warn_of_missing,
)

Array = NDArray[np.float64]

FRAMES_PER_SECOND = 10.0
"""KITTI's rate, where a sequence has lost its times."""
_PAIRS = (("image_0", "image_1"), ("image_2", "image_3"))


def write_kitti(path: str | Path, cam_from_world: Array, frame_idx: ArrayLike | None = None) -> None:
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
    matrices = np.concatenate([rigid3.rotation_matrix(relative), relative[:, 4:, None]], 2).reshape(-1, 12)
    with replaced_file(path) as beside:
        beside.write_text("".join(" ".join(f"{v:.9e}" for v in row) + "\n" for row in matrices), encoding="utf-8")
    sidecar = _sidecar(path)
    if has_pose.all() and np.array_equal(numbers, np.arange(len(numbers))):
        sidecar.unlink(missing_ok=True)
        return
    with replaced_file(sidecar) as beside:
        beside.write_text("".join(f"{number}\n" for number in numbers[has_pose]), encoding="utf-8")


def read_kitti(path: str | Path) -> Array:
    """cam_from_world (F, 7) of a trajectory, frame by frame; NaN for frames that ``PATH.frames`` leaves out.

    Raises:
        InputError: a line does not hold 12 finite numbers with a rotation, or the frames beside it do not fit.
    """
    path = Path(path)
    poses = []
    for number, fields in read_rows(path):
        place = f"{path}:{number}"
        try:
            matrix = np.array(plain_numbers(fields)).reshape(3, 4)
        except ValueError:
            matrix = np.full((3, 4), np.nan)
        if not np.isfinite(matrix).all():
            raise InputError(f"{place}: expected 12 finite numbers (KITTI poses), found {' '.join(fields)[:80]!r}")
        # the benchmark's own files are rounded to six digits
        poses.append(rigid3.from_matrix(nearest_rotation(place, matrix[:, :3]), matrix[:, 3]))
    table = rigid3.inverse(np.array(poses).reshape(-1, 7))
    sidecar = _sidecar(path)
    if not sidecar.is_file():
        return table
    rows = [" ".join(fields) for _, fields in read_rows(sidecar)]
    if len(rows) != len(table) or not all(row.isdecimal() and len(row) < 10 for row in rows):
        raise InputError(f"{sidecar}: expected {len(table)} numbers of frames, one a line, found {len(rows)} lines")
    numbers = np.array([int(row) for row in rows], np.int64)
    if (np.diff(numbers) <= 0).any():
        raise InputError(f"{sidecar}: expected ascending numbers of frames")
    whole = np.full((int(numbers[-1]) + 1 if len(numbers) else 0, 7), np.nan)
    whole[numbers] = table
    return whole


def _sidecar(path: Path) -> Path:
    return path.with_name(path.name + ".frames")


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
