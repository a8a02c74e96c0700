"""Text and JSON from outside: size limits, numbers, matrices, and messages that name the place."""

from __future__ import annotations

import json
import stat
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError

LARGEST_BYTES = 2**30
"""A text file beyond this is refused before it is read: a model of ten million observations takes half of it."""


def read_limited_text(path: Path, largest_bytes: int = LARGEST_BYTES) -> str:
    """The UTF-8 text of a file. Raises InputError if it is missing, no text, or larger than the limit."""
    try:
        size = _size(path)
        if size > largest_bytes:
            raise InputError(f"{path}: expected at most {largest_bytes} bytes, found {size}")
        return path.read_text(encoding="utf-8-sig")  # some editors put a byte order mark first
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected UTF-8 text, found other bytes") from None


def _size(path: Path) -> int:
    """Bytes of a file. Raises InputError for a device, such as /dev/zero, which may never end."""
    found = path.stat()
    if stat.S_ISCHR(found.st_mode) or stat.S_ISBLK(found.st_mode):
        raise InputError(f"{path}: expected a file, found a device")
    return found.st_size


def read_json_object(path: Path, largest_bytes: int = 2**26) -> dict[str, Any]:
    """The object that a JSON file holds. Raises InputError for anything else, NaN and infinity included."""

    def refuse(constant: str) -> NoReturn:
        raise InputError(f"{path}: expected finite numbers, found {constant}")

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        twice = [name for name, count in Counter(name for name, _ in pairs).items() if count > 1]
        if twice:
            raise InputError(f"{path}: expected every name once in an object, found {twice[0][:40]!r} twice")
        return dict(pairs)

    try:
        text = read_limited_text(path, largest_bytes)
        value = json.loads(text, parse_constant=refuse, object_pairs_hook=unique)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected JSON: {error}") from None
    if not isinstance(value, dict):
        raise InputError(f"{path}: expected a JSON object, found {type(value).__name__}")
    return value


def plain_numbers(fields: Iterable[str]) -> list[float]:
    """The numbers that fields of text hold. Raises ValueError for others, and for 1_0, a number to Python alone."""
    fields = list(fields)
    if any("_" in field for field in fields):
        raise ValueError("an underscore in a number")
    return [float(field) for field in fields]


def finite_array(place: str, value: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Nested lists of finite numbers as an array of the given shape; place begins the message if they are not."""
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        array = None
    # strings would be converted, None would become NaN
    if array is None or array.shape != shape or not np.isfinite(array).all() or _holds_text(value):
        expected = " x ".join(map(str, shape)) + " finite numbers" if shape else "a finite number"
        raise InputError(f"{place}: expected {expected}, found {str(value)[:80]}")
    return array


def _holds_text(value: Any) -> bool:
    return any(map(_holds_text, value)) if isinstance(value, list) else isinstance(value, str | bool)


def nearest_rotation(place: str, matrix: NDArray[np.float64], tolerance: float = 1e-3) -> NDArray[np.float64]:
    """The rotation (3, 3) closest to a matrix that was rounded by no more than ``tolerance`` per entry.

    Raises:
        InputError: the matrix is no rotation: scaled, mirrored or skewed.
    """
    with np.errstate(all="ignore"):
        error = np.abs(matrix @ matrix.T - np.eye(3)).max()
    if not error < 6 * tolerance or np.linalg.det(matrix) < 0:  # each product sums three entries, twice
        raise InputError(f"{place}: expected a rotation matrix, found {matrix.tolist()}")
    u, _, vt = np.linalg.svd(matrix)
    rotation: NDArray[np.float64] = u @ vt
    return rotation
