"""Projection matrices as they are handed round: MATLAB's files, NumPy's, text, and folders of text."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.text_input import plain_numbers, read_limited_text

Array = NDArray[np.float64]

SUFFIXES = frozenset({".mat", ".npz", ".npy", ".txt"})
_FORMS = (
    "matrices of 3x4 in a .mat, .npy or .npz file, or a .txt file with twelve numbers to a line, after the name of the "
    "image or without"
)
_LARGEST_BYTES = 1 << 26
# the first line of each file of a folder in the form of Furukawa's PMVS
_HEADING = "CONTOUR"
# from pixels with the centre of the first one at (0, 0) to ours at (0.5, 0.5)
_HALF = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])


def read_projection_matrices(path: Path) -> tuple[list[str] | None, Array]:
    """Projection matrices of N images.

    ==================== ==============================================================================================
    ``.mat``             the one variable that holds N matrices, in a cell array or as (N, 3, 4) or (3, 4, N)
    ``.npy``, ``.npz``   (N, 3, 4) or (N, 4, 4); or ``world_mat_0``, ``world_mat_1``, ... as IDR has them
    ``.txt``             twelve numbers to a line, behind the name of the image or without
    folder               a ``.txt`` file of each image, with its name, as PMVS has them
    ==================== ==============================================================================================

    All are taken to count pixels from the centre of the first one, as OpenCV does: half a pixel is added.

    Returns:
        Names of the images, or None where the file has none: they are in natural order then; and (N, 3, 4).

    Raises:
        InputError: the file cannot be read, or holds no such matrices.
    """
    names: list[str] | None
    if path.is_dir():
        names, found = _of_folder(path)
    else:
        _check_size(path)
        readers = {".mat": _of_matlab, ".npy": _of_numpy, ".npz": _of_archive, ".txt": _of_text}
        reader = readers.get(path.suffix.lower())
        if reader is None:
            raise InputError(f"{path}: expected {_FORMS}, found a file that ends in {path.suffix or 'nothing'}")
        names, found = reader(path)
    if not len(found) or not np.isfinite(found).all():
        raise InputError(f"{path}: expected {_FORMS}, found {'none' if not len(found) else 'numbers not finite'}")
    return names, np.asarray(_HALF @ found)


def _check_size(path: Path) -> None:
    if not path.is_file():
        raise InputError(f"{path}: expected {_FORMS}, found no such file")
    if path.stat().st_size > _LARGEST_BYTES:
        raise InputError(f"{path}: expected at most {_LARGEST_BYTES} bytes of matrices, found {path.stat().st_size}")


def _of_matlab(path: Path) -> tuple[None, Array]:
    from scipy.io import loadmat

    try:
        content = loadmat(path)
    except Exception as error:  # scipy raises what it comes upon: ValueError, TypeError, zlib.error, ...
        advice = "save it with -v7: files of version 7.3 are not read" if "HDF" in str(error) else None
        raise InputError(f"{path}: expected a MATLAB file: {error}", advice) from None
    arrays = {name: value for name, value in content.items() if not name.startswith("__")}
    return None, _only(path, arrays)


def _of_numpy(path: Path) -> tuple[None, Array]:
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: expected an array of NumPy: {error}") from None
    return None, _only(path, {path.name: array})


def _of_archive(path: Path) -> tuple[None, Array]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, AttributeError) as error:
        raise InputError(f"{path}: expected an archive of NumPy: {error}") from None
    listed = sorted((int(match[1]), name) for name in arrays if (match := re.fullmatch(r"world_mat_(\d+)", name)))
    return None, _stacked(path, [arrays[name] for _, name in listed]) if listed else _only(path, arrays)


def _only(path: Path, arrays: dict[str, Any]) -> Array:
    """The matrices of the one array that holds some."""
    found = {name: kept for name, array in arrays.items() if (kept := _matrices(np.asarray(array))) is not None}
    if len(found) != 1:
        inside = ", ".join(f"{name} {np.asarray(array).shape}" for name, array in arrays.items()) or "nothing"
        raise InputError(f"{path}: expected one array of {_FORMS}, found {inside[:200]}")
    return next(iter(found.values()))


def _matrices(array: NDArray[Any]) -> Array | None:
    """(N, 3, 4) of an array that holds matrices in one of the usual forms, None of another."""
    if array.dtype == object:  # a cell array
        cells = [np.asarray(cell) for cell in array.ravel()]
        if not cells or any(cell.shape != (3, 4) or cell.dtype.kind not in "fiu" for cell in cells):
            return None
        return np.array(cells, np.float64)
    if array.dtype.kind not in "fiu":
        return None
    if array.ndim == 3 and array.shape[:2] == (3, 4) and array.shape[1:] != (3, 4):
        return np.moveaxis(array, 2, 0).astype(np.float64)
    if array.ndim == 3 and array.shape[1:] in ((3, 4), (4, 4)):
        return array[:, :3].astype(np.float64)
    return None


def _stacked(path: Path, arrays: Sequence[Any]) -> Array:
    found = [np.asarray(array) for array in arrays]
    if any(array.shape not in ((3, 4), (4, 4)) or array.dtype.kind not in "fiu" for array in found):
        raise InputError(f"{path}: expected matrices of 3x4 or 4x4, found {sorted({a.shape for a in found})}")
    return np.array([array[:3] for array in found], np.float64)


def _of_text(path: Path) -> tuple[list[str] | None, Array]:
    names, rows = [], []
    for number, line in enumerate(read_limited_text(path, _LARGEST_BYTES).splitlines(), 1):
        fields = line.replace(",", " ").split()
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) == 13:
            names.append(fields.pop(0))
        rows.append(_numbers(path, number, fields, 12))
    if names and len(names) < len(rows):
        raise InputError(f"{path}: expected the name of the image on every line or on none, found both")
    if len(set(names)) < len(names):
        raise InputError(f"{path}: expected every image once, found one twice")
    return names or None, np.array(rows).reshape(-1, 3, 4)


def _of_folder(folder: Path) -> tuple[list[str], Array]:
    paths = sorted(folder.glob("*.txt"))
    if not paths:
        raise InputError(f"{folder}: expected a .txt file with the matrix of each image, found none")
    return [path.stem for path in paths], np.array([_of_file(path) for path in paths])


def _of_file(path: Path) -> Array:
    lines = [line.split() for line in read_limited_text(path, _LARGEST_BYTES).splitlines() if line.strip()]
    if lines and lines[0] == [_HEADING]:
        del lines[0]
    if [len(line) for line in lines] not in ([4, 4, 4], [12]):
        raise InputError(f"{path}: expected three lines of four numbers, found {sum(map(len, lines))} fields")
    return np.reshape(_numbers(path, 1, [field for line in lines for field in line], 12), (3, 4))


def _numbers(path: Path, line: int, fields: Iterable[str], count: int) -> list[float]:
    fields = list(fields)
    try:
        values = plain_numbers(fields)
    except ValueError:
        values = []
    if len(values) != count:
        shown = " ".join(fields)[:80]
        raise InputError(f"{path}, line {line}: expected {count} numbers of a 3x4 matrix, found {shown!r}")
    return values
