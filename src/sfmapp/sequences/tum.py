"""The RGB-D benchmark of TUM (Sturm et al., IROS 2012): ``rgb.txt``, ``rgb/`` and ``groundtruth.txt``."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera_files.opencv_lens import camera_from_opencv, scaled_to
from sfmapp.camera_files.reading import Calibration
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.formats.clocks import Times, parse_time, read_column
from sfmapp.formats.trajectory_input import TrajectoryFile
from sfmapp.images.sequence import GroundTruth
from sfmapp.images.sources import EXTENSIONS
from sfmapp.scene.rig import Rig
from sfmapp.sequences.files import (
    Recording,
    Size,
    common_size,
    confined,
    frame_names,
    in_order,
    list_images,
    read_rows,
    times_in_names,
    warn_of_missing,
)

Array = NDArray[np.float64]

# The intrinsics of the colour cameras that the benchmark publishes: fx fy cx cy, k1 k2 p1 p2 k3, pixel centres at
# whole numbers, 640x480. The third camera's images are undistorted.
_PUBLISHED = {
    "1": ((517.306408, 516.469215, 318.643040, 255.313989), (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)),
    "2": ((520.908620, 521.007327, 325.141442, 249.701764), (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}
_SIZE = (640, 480)


def is_tum(folder: Path) -> bool:
    """Whether a folder is laid out as TUM's sequences are."""
    return (folder / "rgb.txt").is_file() or ((folder / "rgb").is_dir() and (folder / "groundtruth.txt").is_file())


def read_tum_sequence(folder: Path, events: Events) -> Recording:
    """A sequence folder. Frames that ``rgb.txt`` names and that are not there are left out with a warning.

    Raises:
        InputError: no image can be read, or a line of ``rgb.txt`` is not what it should be.
    """
    times: Times | None
    if (folder / "rgb.txt").is_file():
        times, paths = _read_list(folder, events)
    else:
        paths = list_images(folder / "rgb")
        times = times_in_names(paths)
    size = common_size(paths, str(folder / "rgb"))
    frames: list[tuple[Path, ...]] = [(path,) for path in paths]
    calibration = _published_calibration(folder, size)
    names, ground_truth_paths = frame_names(folder, paths), (folder / "groundtruth.txt",)
    return Recording("tum", folder, names, times, frames, (size,), calibration, ground_truth_paths=ground_truth_paths)


def _read_list(folder: Path, events: Events) -> tuple[Times, list[Path]]:
    list_path = folder / "rgb.txt"
    times, paths, missing = [], [], []
    for number, fields in read_rows(list_path):
        place = f"{list_path}:{number}"
        try:
            time = parse_time(fields[0])
        except ValueError:
            time = None
        if time is None or len(fields) < 2:
            raise InputError(f"{place}: expected a time and a file name, found {' '.join(fields)[:80]!r}")
        path = confined(folder, " ".join(fields[1:]), place)
        if path.suffix.lower() not in EXTENSIONS or not path.is_file():
            missing.append(" ".join(fields[1:]))
            continue
        times.append(time)
        paths.append(path)
    warn_of_missing(events, "files that rgb.txt names are not there, or are no images", missing)
    return read_column(str(list_path), times, "s"), paths


def tum_ground_truth(file: TrajectoryFile) -> GroundTruth:
    """Poses of a trajectory as those of the camera."""
    times, has_pose = file.trajectory.timestamps_s, file.trajectory.has_pose
    assert times is not None
    return in_order(GroundTruth(times[has_pose], file.cam_from_world[has_pose]))


def _published_calibration(folder: Path, size: Size) -> Calibration | None:
    """The published camera that the name of the folder, or of the one around it, tells."""
    resolved = folder.resolve()
    for name in (resolved.name, resolved.parent.name):
        found = re.search(r"(?:freiburg|(?<![a-z])fr)[-_]?([123])(?!\d)", name.lower())
        if found:
            intrinsics, lens = _PUBLISHED[found[1]]
            place = f"TUM's freiburg{found[1]} camera"
            fitted = scaled_to(place, camera_from_opencv(place, _SIZE, intrinsics, lens, False), size)
            return Calibration(Rig.single(fitted.camera), lenses=(fitted.lens,), notes=fitted.notes)
    return None
