"""Where the pixels of a rectified pair come from in its photographs, in two forms.

``rectification_maps.npz`` has ``left`` and ``right``, (H, W, 2) float32: x and y of the photograph for each pixel of
the result, the centre of the first pixel at (0.5, 0.5), NaN where the lens does not look. ``rectification_maps.yml.gz``
has ``map1x``, ``map1y``, ``map2x`` and ``map2y`` as ``cv2.remap`` takes them: centres at whole numbers, and far outside
for nowhere.
"""

from __future__ import annotations

import gzip
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file, write_bytes

Map = NDArray[np.float32]

SAMPLING_MAPS = ("rectification_maps.npz", "rectification_maps.yml.gz")
"""What is written of them."""

_SIDES = ("left", "right")
# a pixel of no photograph, for a program that knows no NaN there
_NOWHERE = -1e4


def write_sampling_maps(folder: Path, left: Map, right: Map) -> Iterator[Path]:
    """Write both forms, maps (H, W, 2); gives the path of each.

    Raises:
        InputError: the folder cannot be written.
    """
    maps = {name: np.asarray(one, np.float32) for name, one in zip(_SIDES, (left, right), strict=True)}
    plain, opencv = (folder / name for name in SAMPLING_MAPS)
    with replaced_file(plain) as beside, beside.open("wb") as file:
        np.savez(file, allow_pickle=False, **maps)
    yield plain
    write_bytes(opencv, gzip.compress(_opencv_text(maps).encode(), compresslevel=1, mtime=0))
    yield opencv


def _opencv_text(maps: dict[str, Map]) -> str:
    import cv2

    how = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_BASE64
    storage = cv2.FileStorage("maps.yml", how)
    for number, name in enumerate(_SIDES, 1):
        index = np.where(np.isnan(maps[name]), np.float32(_NOWHERE), maps[name] - np.float32(0.5))
        for axis, letter in enumerate("xy"):
            storage.write(f"map{number}{letter}", np.ascontiguousarray(index[..., axis]))
    return str(storage.releaseAndGetString())


def read_sampling_maps(path: Path) -> tuple[Map, Map]:
    """Left and right map (H, W, 2) of a file of either form, in ours.

    Raises:
        InputError: the file is missing, or no such file.
    """
    try:
        found = _read_opencv(path) if path.name.endswith(".gz") else _read_plain(path)
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    left, right = found
    if left.ndim != 3 or left.shape[2] != 2 or left.shape != right.shape or left.dtype != np.float32:
        raise InputError(f"{path}: expected two maps (H, W, 2) float32, found {left.shape} and {right.shape}")
    return left, right


def _read_plain(path: Path) -> tuple[Map, Map]:
    with np.load(path, allow_pickle=False) as archive:
        return archive["left"], archive["right"]


def _read_opencv(path: Path) -> tuple[Map, Map]:
    import cv2

    text = gzip.decompress(path.read_bytes()).decode()
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    maps = []
    for number in (1, 2):
        parts = [storage.getNode(f"map{number}{letter}").mat() for letter in "xy"]
        if any(part is None for part in parts):
            raise ValueError(f"expected map{number}x and map{number}y, found {'others' if text else 'nothing'}")
        index = np.stack(parts, -1).astype(np.float32)
        maps.append(np.where(index <= _NOWHERE, np.float32(np.nan), index + np.float32(0.5)))
    return maps[0], maps[1]
