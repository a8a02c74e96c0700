"""PLY files, ours and those of others: every encoding, any properties and elements (Turk, "The PLY polygon file
format", 1994)."""

from __future__ import annotations

import array
import itertools
import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.ply import TYPES

_LARGEST_HEADER_BYTES = 1 << 20
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_FACE_LISTS = ("vertex_indices", "vertex_index")
# as PCL, MeshLab, CloudCompare, Metashape and others call them
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("normalx", "normaly", "normalz"))
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))

# colours of 1 for white overshoot it where they come of sharpening; those of 255 do not end here
_LARGEST_FRACTION = 2.0


@dataclass(frozen=True)
class PlyGeometry:
    """What a PLY holds of points or of a surface.

    Attributes:
        xyz: (N, 3) float64 vertices as they are in the file, which may be NaN where a scanner saw nothing.
        triangles: (F, 3) int64 rows of ``xyz``, polygons cut into fans; None for a cloud.
        normal: (N, 3) float32 as they are in the file, of any length; None where it has none.
        rgb: (N, 3) uint8; None where it has none. Numbers of more than 8 bits are scaled: see :func:`_as_bytes`.
    """

    xyz: NDArray[np.float64]
    triangles: NDArray[np.int64] | None
    normal: NDArray[np.float32] | None = None
    rgb: NDArray[np.uint8] | None = None

    @property
    def is_finite(self) -> NDArray[np.bool_]:
        """(N,) bool: the vertex is somewhere."""
        return np.asarray(np.isfinite(self.xyz).all(axis=1))


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str
    count_kind: str | None  # of a list


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]

    @property
    def lists(self) -> list[_Property]:
        return [prop for prop in self.properties if prop.count_kind is not None]

    def dtype(self, order: str, lengths: tuple[int, ...] = ()) -> np.dtype:
        """Of one row; lists get the given lengths, in their order, and their counts a field ``NAME count``.

        No header can name such a field itself: its names hold no blanks.
        """
        fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        left = list(lengths)
        for prop in self.properties:
            if prop.count_kind is None:
                fields.append((prop.name, order + prop.kind))
            else:
                fields.append((f"{prop.name} count", order + prop.count_kind))
                fields.append((prop.name, order + prop.kind, (left.pop(0),)))
        return np.dtype(fields)


@dataclass(frozen=True)
class _Rows:
    """Rows (R,) of an element: numbers (R,) by name; of each list the lengths (R,), and the values end to end."""

    numbers: dict[str, NDArray[Any]]
    lists: dict[str, tuple[NDArray[np.int64], NDArray[Any]]]


def read_ply_geometry(path: str | Path) -> PlyGeometry:
    """Read the vertices of a PLY and its faces, if it has any. Other properties and elements are passed over.

    Names of properties are compared without regard to case.

    Raises:
        InputError: the file is missing, not a PLY, or holds less, or something else, than its header promises.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            return _read(path, file)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def _read(path: Path, file: BinaryIO) -> PlyGeometry:
    order, line_end, elements = _header(path, file)
    names = [element.name for element in elements]
    if names.count("vertex") != 1 or names.count("face") > 1:
        raise InputError(f"{path}: expected one element 'vertex', found {', '.join(names) or 'no elements'}")
    vertices, triangles = _Rows({}, {}), None
    last = max(names.index(name) for name in ("vertex", "face") if name in names)
    for element in elements[: last + 1]:
        _check_size(path, file, element, order)
        if element.name == "face" and not (element.count and _has_corners(path, element)):
            _skip(path, file, element, order)
        elif element.name == "vertex":
            _check_vertices(path, element)
            vertices = _read_rows(path, file, element, order)
        elif element.name == "face":
            lists = _read_rows(path, file, element, order).lists
            triangles = _fans(path, *next(lists[name] for name in _FACE_LISTS if name in lists))
        else:
            _skip(path, file, element, order)
    if order and line_end == b"\r\n" and last + 1 == len(elements) and file.read(1):
        raise InputError(
            f"{path}: expected the end of the file after what its header declares, found more",
            "its lines end as in a Windows text file: if it was transferred as text, its numbers are damaged; "
            "transfer it as binary",
        )
    with np.errstate(invalid="ignore"):  # of NaN that were made to signal
        xyz = np.stack([vertices.numbers[axis].astype(np.float64) for axis in "xyz"], 1)
    if triangles is not None and len(triangles):
        lowest, highest = int(triangles.min()), int(triangles.max())
        if lowest < 0 or highest >= len(xyz):
            found = lowest if lowest < 0 else highest
            raise InputError(f"{path}: expected faces of vertices 0 to {len(xyz) - 1}, found {found}")
    normal, color = _columns(vertices, _NORMALS), _columns(vertices, _COLORS)
    with np.errstate(over="ignore", invalid="ignore"):
        normals = None if normal is None else np.stack([axis.astype(np.float32) for axis in normal], 1)
    return PlyGeometry(xyz, triangles, normals, None if color is None else _as_bytes(color))


def _columns(rows: _Rows, choices: tuple[tuple[str, ...], ...]) -> list[NDArray[Any]] | None:
    """The first of the choices of names of which all are there."""
    names = next((names for names in choices if set(names) <= set(rows.numbers)), None)
    return None if names is None else [rows.numbers[name] for name in names]


def _as_bytes(channels: list[NDArray[Any]]) -> NDArray[np.uint8]:
    """(N, 3) colours of 8 bits from any numbers.

    Files do not say what white is. Fractions are taken to be of 1 where none goes far beyond it, of 255 otherwise;
    whole numbers to be of 255, or of 65535 where one goes beyond 255.
    """
    if all(channel.dtype in (np.dtype("u1"), np.dtype("i1")) for channel in channels):
        return np.stack([channel.view(np.uint8) for channel in channels], 1)
    values = np.nan_to_num(np.stack([channel.astype(np.float64) for channel in channels], 1), posinf=0.0, neginf=0.0)
    highest = values.max(initial=0.0)
    if highest <= _LARGEST_FRACTION and any(channel.dtype.kind == "f" for channel in channels):
        values *= 255.0
    elif highest > 255.0:
        values /= 257.0
    rounded: NDArray[np.uint8] = np.rint(values.clip(0.0, 255.0)).astype(np.uint8)
    return rounded


# ---------------------------------------------------------------- header


def _header(path: Path, file: BinaryIO) -> tuple[str, bytes, list[_Element]]:
    """Byte order ("" for text), what lines end with, and elements; the file stands at the first byte behind it."""
    head = file.read(_LARGEST_HEADER_BYTES)
    first = re.match(rb"ply[ \t]*(\r\n|\r|\n)", head)
    # all lines end as the first one does: what follows the last may be a number that looks like the end of a line
    blanks = rb"[ \t\r]*" if first and first[1] == b"\n" else rb"[ \t]*"
    end = re.search(rb"[\r\n]end_header" + blanks + first[1], head) if first else None
    if first is None or end is None:
        raise InputError(f"{path}: expected a PLY header, found {head[:16]!r}")
    file.seek(end.end())
    lines = [line.split() for line in head[first.end() : end.start()].decode("ascii", "replace").splitlines()]
    lines = [words for words in lines if words and words[0] not in ("comment", "obj_info")]
    if not lines or len(lines[0]) != 3 or lines[0][0] != "format" or lines[0][1] not in _ORDERS:
        raise InputError(
            f"{path}: expected a format among {', '.join(_ORDERS)}, found {' '.join((lines or [[]])[0])!r}"
        )
    elements: list[tuple[str, int, list[_Property]]] = []
    for words in lines[1:]:
        if words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) <= 18:
            elements.append((words[1], int(words[2]), []))
        elif words[0] == "property" and elements and (prop := _property(words)) is not None:
            elements[-1][2].append(prop)
        else:
            raise InputError(f"{path}: expected elements and their properties, found {' '.join(words)[:80]!r}")
    for name, _, properties in elements:
        if len({prop.name for prop in properties}) < len(properties) or not properties:
            raise InputError(
                f"{path}: expected properties of '{name}' under names of their own, found none or twice one"
            )
    order = _ORDERS[lines[0][1]]
    return order, first[1], [_Element(name, count, tuple(properties)) for name, count, properties in elements]


def _property(words: list[str]) -> _Property | None:
    if len(words) == 3 and words[1] in TYPES:
        return _Property(words[2].lower(), TYPES[words[1]], None)
    if len(words) == 5 and words[1] == "list" and words[3] in TYPES and TYPES.get(words[2], "f")[0] != "f":
        return _Property(words[4].lower(), TYPES[words[3]], TYPES[words[2]])
    return None


def _check_size(path: Path, file: BinaryIO, element: _Element, order: str) -> None:
    """Before anything is allocated: can the rest of the file hold this at all?"""
    row = element.dtype(order, (0,) * len(element.lists)).itemsize if order else 2 * len(element.properties)
    left = os.fstat(file.fileno()).st_size - file.tell()
    if element.count * row > left + (0 if order else 1):
        raise InputError(
            f"{path}: truncated: expected {element.count} rows of '{element.name}' of at least {row} bytes, "
            f"found {left} bytes"
        )


def _check_vertices(path: Path, element: _Element) -> None:
    numbers = {prop.name for prop in element.properties if prop.count_kind is None}
    if not {"x", "y", "z"} <= numbers:
        names = ", ".join(prop.name for prop in element.properties)
        raise InputError(f"{path}: expected vertices with numbers x, y and z, found {names}")


def _has_corners(path: Path, element: _Element) -> bool:
    corners = next((prop for prop in element.properties if prop.name in _FACE_LISTS), None)
    if corners is not None and (corners.count_kind is None or corners.kind[0] == "f"):
        raise InputError(f"{path}: expected a list of integers '{corners.name}', found other numbers")
    return corners is not None


# ---------------------------------------------------------------- body


def _skip(path: Path, file: BinaryIO, element: _Element, order: str) -> None:
    if not order:
        for _ in _text_rows(path, file, element):
            pass
    elif element.lists:
        _read_rows(path, file, element, order)
    else:
        file.seek(element.dtype(order).itemsize * element.count, os.SEEK_CUR)


def _read_rows(path: Path, file: BinaryIO, element: _Element, order: str) -> _Rows:
    if not order:
        return _rows_of_lists_in_text(path, file, element) if element.lists else _rows_in_text(path, file, element)
    alike = _rows_alike(file, element, order)
    if alike is None:
        return _rows_of_lists(path, file, element, order)
    lists = {prop.name: alike[prop.name] for prop in element.lists}
    return _Rows(
        {prop.name: alike[prop.name] for prop in element.properties if prop.count_kind is None},
        {name: (np.full(len(values), values.shape[1]), values.ravel()) for name, values in lists.items()},
    )


def _rows_alike(file: BinaryIO, element: _Element, order: str) -> NDArray[Any] | None:
    """All rows at once where every list is as long as that of the first row, as in triangle meshes; else None."""
    start, lengths = file.tell(), []
    for prop in element.properties if element.lists and element.count else ():
        if prop.count_kind is not None:
            found = np.fromfile(file, order + prop.count_kind, 1)
            if not len(found) or not 0 <= found[0] <= 255:
                file.seek(start)
                return None
            lengths.append(int(found[0]))
        file.seek(np.dtype(prop.kind).itemsize * (lengths[-1] if prop.count_kind else 1), os.SEEK_CUR)
    file.seek(start)
    lengths += [0] * (len(element.lists) - len(lengths))
    dtype = element.dtype(order, tuple(lengths))
    if element.count * dtype.itemsize > os.fstat(file.fileno()).st_size - start:
        return None
    rows = np.fromfile(file, dtype, element.count)
    if all((rows[f"{prop.name} count"] == length).all() for prop, length in zip(element.lists, lengths, strict=True)):
        return rows
    file.seek(start)
    return None


def _rows_of_lists(path: Path, file: BinaryIO, element: _Element, order: str) -> _Rows:
    """Rows of different lengths: where the lists stand is found one by one, what stands in them all at once."""
    start, data = file.tell(), file.read()
    # bytes from the end of one list, or the start of the row, to the count of the next
    gaps, gap = [], 0
    for prop in element.properties:
        if prop.count_kind is not None:
            gaps.append(gap)
        gap = 0 if prop.count_kind is not None else gap + np.dtype(prop.kind).itemsize
    counts = [struct.Struct(order + np.dtype(prop.count_kind).char) for prop in element.lists]
    sizes = [np.dtype(prop.kind).itemsize for prop in element.lists]
    steps = list(zip(gaps, counts, sizes, strict=True))
    places, lengths = array.array("q"), array.array("q")  # of the row, and of the first value of each list
    place, length, end = 0, 0, len(data)
    for row in range(element.count):
        places.append(place)
        for step, count, size in steps:
            if place + step + count.size > end:
                raise InputError(f"{path}: truncated in row {row} of '{element.name}'")
            (length,) = count.unpack_from(data, place + step)
            place += step + count.size
            places.append(place)
            lengths.append(length)
            place += length * size
            if length < 0 or place > end:
                raise InputError(f"{path}: truncated in row {row} of '{element.name}', a list of {length}")
        place += gap
        if place > end:
            raise InputError(f"{path}: truncated in row {row} of '{element.name}'")
    file.seek(start + place)
    shape = (element.count, len(steps))
    return _gather(
        element, order, np.frombuffer(data, np.uint8),
        np.frombuffer(places, np.int64).reshape(-1, len(steps) + 1), np.frombuffer(lengths, np.int64).reshape(shape),
    )  # fmt: skip


def _gather(
    element: _Element, order: str, data: NDArray[np.uint8], places: NDArray[np.int64], lengths: NDArray[np.int64]
) -> _Rows:
    """Numbers and lists of rows that stand at places (R, 1 + L) in bytes (B,), with lists of lengths (R, L)."""

    def take(at: NDArray[np.int64], kind: str) -> NDArray[Any]:
        dtype = np.dtype(order + kind)
        values: NDArray[Any] = data[at[:, None] + np.arange(dtype.itemsize)].reshape(-1).view(dtype)
        return values

    numbers, lists = {}, {}
    at, n = places[:, 0], 0
    for prop in element.properties:
        size = np.dtype(prop.kind).itemsize
        if prop.count_kind is None:
            numbers[prop.name] = take(at, prop.kind)
            at = at + size
            continue
        length, first = lengths[:, n], places[:, n + 1]
        within = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
        lists[prop.name] = length, take(np.repeat(first, length) + size * within, prop.kind)
        at, n = first + length * size, n + 1
    return _Rows(numbers, lists)


def _text_rows(path: Path, file: BinaryIO, element: _Element) -> Iterator[bytes]:
    """The next lines of a text file, one per row, blank ones left out."""
    lines = (line for line in iter(file.readline, b"") if line.strip())
    count = 0
    for line in itertools.islice(lines, element.count):
        count += 1
        yield line
    if count < element.count:
        raise InputError(f"{path}: truncated: expected {element.count} rows of '{element.name}', found {count}")


def _rows_in_text(path: Path, file: BinaryIO, element: _Element) -> _Rows:
    names = [prop.name for prop in element.properties]
    rows = np.zeros((0, len(names)))
    if element.count:
        try:
            rows = np.loadtxt(_text_rows(path, file, element), np.float64, comments=None, ndmin=2)
        except ValueError as error:
            raise InputError(f"{path}: expected {len(names)} numbers per {element.name}: {error}") from None
    if rows.shape != (element.count, len(names)):
        raise InputError(
            f"{path}: expected {element.count} rows of '{element.name}' of {len(names)} numbers, found {rows.shape}"
        )
    return _Rows({prop.name: _of_kind(rows[:, n], prop.kind) for n, prop in enumerate(element.properties)}, {})


def _of_kind(values: NDArray[np.float64], kind: str) -> NDArray[Any]:
    """Numbers of text as the header declares them, which tells colours of 8 bits from fractions; others stay."""
    if kind[0] == "f":
        return values
    limits = np.iinfo(kind)
    return values.astype(kind) if ((values >= limits.min) & (values <= limits.max)).all() else values


def _rows_of_lists_in_text(path: Path, file: BinaryIO, element: _Element) -> _Rows:
    columns: dict[str, list[Any]] = {prop.name: [] for prop in element.properties}
    lengths: dict[str, list[int]] = {prop.name: [] for prop in element.lists}
    for row, line in enumerate(_text_rows(path, file, element)):
        words, place = line.split(), 0
        try:
            for prop in element.properties:
                length = 1
                if prop.count_kind is not None:
                    length, place = int(words[place]), place + 1
                    lengths[prop.name].append(length)
                if length < 0 or place + length > len(words):
                    raise ValueError
                read = int if prop.kind[0] != "f" and prop.count_kind is not None else float
                columns[prop.name] += map(read, words[place : place + length])
                place += length
        except (ValueError, IndexError):
            raise InputError(f"{path}: expected row {row} of '{element.name}', found {line[:60]!r}") from None
    numbers, lists = {}, {}
    for prop in element.properties:
        values = np.array(columns[prop.name], np.float64) if prop.kind[0] == "f" or prop.count_kind is None else None
        if prop.count_kind is None:
            numbers[prop.name] = _of_kind(np.array(columns[prop.name], np.float64), prop.kind)
            continue
        try:
            values = np.array(columns[prop.name], np.int64) if values is None else values
            lists[prop.name] = np.array(lengths[prop.name], np.int64), values
        except OverflowError:
            raise InputError(
                f"{path}: expected whole numbers in '{prop.name}' of '{element.name}', found one beyond 64 bits"
            ) from None
    return _Rows(numbers, lists)


def _fans(path: Path, lengths: NDArray[np.int64], values: NDArray[Any]) -> NDArray[np.int64]:
    """(F, 3) triangles of polygons: first corner, and each pair of the following ones."""
    if len(lengths) and lengths.min() < 3:
        raise InputError(f"{path}: expected faces of three corners and more, found {lengths.min()}")
    values = values.astype(np.int64)
    first = np.concatenate([[0], np.cumsum(lengths)[:-1]]) if len(lengths) else np.zeros(0, np.int64)
    counts = lengths - 2
    start = np.repeat(first, counts)
    step = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.stack([values[start], values[start + step + 1], values[start + step + 2]], 1)
