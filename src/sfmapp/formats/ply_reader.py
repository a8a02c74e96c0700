"""PLY files of others: every encoding, any properties and elements (Turk, "The PLY polygon file format", 1994)."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.ply import LARGEST_HEADER_BYTES, TYPES

_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_FACE_LISTS = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class PlyGeometry:
    """What a PLY holds of a surface.

    Attributes:
        xyz: (N, 3) float64 vertices as they are in the file, which may be NaN where a scanner saw nothing.
        triangles: (F, 3) int64 rows of ``xyz``, polygons cut into fans; None for a cloud.
    """

    xyz: NDArray[np.float64]
    triangles: NDArray[np.int64] | None


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
    def has_list(self) -> bool:
        return any(prop.count_kind is not None for prop in self.properties)

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


def read_ply_geometry(path: str | Path) -> PlyGeometry:
    """Read the vertices of a PLY and its faces, if it has any. Other properties and elements are passed over.

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
    order, elements = _header(path, file)
    names = [element.name for element in elements]
    if names.count("vertex") != 1 or names.count("face") > 1:
        raise InputError(f"{path}: expected one element 'vertex', found {', '.join(names) or 'no elements'}")
    xyz, triangles = np.zeros((0, 3)), None
    last = max(names.index(name) for name in ("vertex", "face") if name in names)
    for element in elements[: last + 1]:
        _check_size(path, file, element, order)
        if element.name == "vertex":
            xyz = _vertices(path, file, element, order)
        elif element.name == "face" and element.count and _has_corners(path, element):
            triangles = _fans(path, *_lists(path, file, element, order))
        else:
            _skip(path, file, element, order)
    if triangles is not None and len(triangles):
        lowest, highest = int(triangles.min()), int(triangles.max())
        if lowest < 0 or highest >= len(xyz):
            found = lowest if lowest < 0 else highest
            raise InputError(f"{path}: expected faces of vertices 0 to {len(xyz) - 1}, found {found}")
    return PlyGeometry(xyz, triangles)


# ---------------------------------------------------------------- header


def _header(path: Path, file: BinaryIO) -> tuple[str, list[_Element]]:
    """Byte order ("" for text) and elements; the file stands at the first byte behind the header."""
    head = file.read(LARGEST_HEADER_BYTES)
    end = head.find(b"end_header")
    if head[:4] not in (b"ply\n", b"ply\r") or end < 0:
        raise InputError(f"{path}: expected a PLY header, found {head[:16]!r}")
    end += len(b"end_header")
    file.seek(end + (2 if head[end : end + 2] == b"\r\n" else 1))
    lines = [line.split() for line in head[:end].decode("ascii", "replace").splitlines()[1:-1]]
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
    return _ORDERS[lines[0][1]], [_Element(name, count, tuple(properties)) for name, count, properties in elements]


def _property(words: list[str]) -> _Property | None:
    if len(words) == 3 and words[1] in TYPES:
        return _Property(words[2], TYPES[words[1]], None)
    if len(words) == 5 and words[1] == "list" and words[3] in TYPES and TYPES.get(words[2], "f")[0] != "f":
        return _Property(words[4], TYPES[words[3]], TYPES[words[2]])
    return None


def _check_size(path: Path, file: BinaryIO, element: _Element, order: str) -> None:
    """Before anything is allocated: can the rest of the file hold this at all?"""
    num_lists = sum(prop.count_kind is not None for prop in element.properties)
    row = element.dtype(order, (0,) * num_lists).itemsize if order else 2 * len(element.properties)
    left = os.fstat(file.fileno()).st_size - file.tell()
    if element.count * row > left + (0 if order else 1):
        raise InputError(
            f"{path}: truncated: expected {element.count} rows of '{element.name}' of at least {row} bytes, "
            f"found {left} bytes"
        )


# ---------------------------------------------------------------- body


def _vertices(path: Path, file: BinaryIO, element: _Element, order: str) -> NDArray[np.float64]:
    names = [prop.name for prop in element.properties]
    if element.has_list or not {"x", "y", "z"} <= set(names):
        raise InputError(f"{path}: expected vertices with numbers x, y and z, found {', '.join(names)}")
    if order:
        rows = np.fromfile(file, element.dtype(order), element.count)
        return np.stack([rows[axis].astype(np.float64) for axis in "xyz"], 1)
    columns = [names.index(axis) for axis in "xyz"]
    if not element.count:
        return np.zeros((0, 3))
    try:
        rows = np.loadtxt(_text_rows(path, file, element), np.float64, comments=None, ndmin=2)
    except ValueError as error:
        raise InputError(f"{path}: expected {len(names)} numbers per vertex: {error}") from None
    if rows.shape != (element.count, len(names)):
        raise InputError(f"{path}: expected {element.count} vertices of {len(names)} numbers, found {rows.shape}")
    return rows[:, columns]


def _has_corners(path: Path, element: _Element) -> bool:
    corners = next((prop for prop in element.properties if prop.name in _FACE_LISTS), None)
    if corners is not None and (corners.count_kind is None or corners.kind[0] == "f"):
        raise InputError(f"{path}: expected a list of integers '{corners.name}', found other numbers")
    return corners is not None


def _text_rows(path: Path, file: BinaryIO, element: _Element) -> Iterator[bytes]:
    """The next lines of a text file, one per row, blank ones left out."""
    lines = (line for line in iter(file.readline, b"") if line.strip())
    count = 0
    for line in itertools.islice(lines, element.count):
        count += 1
        yield line
    if count < element.count:
        raise InputError(f"{path}: truncated: expected {element.count} rows of '{element.name}', found {count}")


def _skip(path: Path, file: BinaryIO, element: _Element, order: str) -> None:
    if not order:
        for _ in _text_rows(path, file, element):
            pass
    elif element.has_list:
        _lists(path, file, element, order)
    else:
        file.seek(element.dtype(order).itemsize * element.count, os.SEEK_CUR)


def _lists(path: Path, file: BinaryIO, element: _Element, order: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Lengths (F,) and values, end to end, of the list of vertices of each face (or of the first list)."""
    wanted = next((p for p in element.properties if p.name in _FACE_LISTS), None)
    wanted = wanted or next(p for p in element.properties if p.count_kind is not None)
    if not order:
        return _text_lists(path, file, element, wanted)
    alike = _lists_alike(file, element, order)
    if alike is not None:
        values = alike[wanted.name].astype(np.int64)
        return np.full(len(values), values.shape[1]), values.ravel()
    data = file.read()
    lengths, values_of, place = np.zeros(element.count, np.int64), [], 0
    kinds = [(p, np.dtype(order + p.kind), np.dtype(order + (p.count_kind or "u1"))) for p in element.properties]
    for row in range(element.count):
        for prop, kind, count_kind in kinds:
            length = 1
            if prop.count_kind is not None:
                if place + count_kind.itemsize > len(data):
                    raise InputError(f"{path}: truncated in row {row} of '{element.name}'")
                length = int(np.frombuffer(data, count_kind, 1, place)[0])
                place += count_kind.itemsize
            if length < 0 or place + length * kind.itemsize > len(data):
                raise InputError(f"{path}: truncated in row {row} of '{element.name}', a list of {length}")
            if prop is wanted:
                lengths[row] = length
                values_of.append(np.frombuffer(data, kind, length, place))
            place += length * kind.itemsize
    file.seek(place - len(data), os.SEEK_CUR)
    return lengths, np.concatenate([np.zeros(0, np.int64), *values_of]).astype(np.int64)


def _lists_alike(file: BinaryIO, element: _Element, order: str) -> NDArray | None:
    """All rows at once where every list is as long as that of the first row, as in triangle meshes; else None."""
    start, lengths = file.tell(), []
    for prop in element.properties:
        if prop.count_kind is not None:
            found = np.fromfile(file, order + prop.count_kind, 1)
            if not len(found) or not 0 <= found[0] <= 255:
                break
            lengths.append(int(found[0]))
        file.seek(np.dtype(prop.kind).itemsize * (lengths[-1] if prop.count_kind else 1), os.SEEK_CUR)
    else:
        dtype = element.dtype(order, tuple(lengths))
        file.seek(start)
        rows = np.fromfile(file, dtype, element.count)
        lists = [prop.name for prop in element.properties if prop.count_kind is not None]
        if len(rows) == element.count and all(
            (rows[f"{name} count"] == length).all() for name, length in zip(lists, lengths, strict=True)
        ):
            return rows
    file.seek(start)
    return None


def _text_lists(
    path: Path, file: BinaryIO, element: _Element, wanted: _Property
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    lengths: list[int] = []
    values: list[int] = []
    for row, line in enumerate(_text_rows(path, file, element)):
        words, place = line.split(), 0
        try:
            for prop in element.properties:
                length = 1
                if prop.count_kind is not None:
                    length, place = int(words[place]), place + 1
                if length < 0 or place + length > len(words):
                    raise ValueError
                if prop is wanted:
                    lengths.append(length)
                    values += map(int, words[place : place + length])
                place += length
        except (ValueError, IndexError):
            raise InputError(f"{path}: expected row {row} of '{element.name}', found {line[:60]!r}") from None
    try:
        return np.array(lengths, np.int64), np.array(values, np.int64)
    except OverflowError:
        raise InputError(f"{path}: expected rows of vertices in '{element.name}', found one beyond 64 bits") from None


def _fans(path: Path, lengths: NDArray[np.int64], values: NDArray[np.int64]) -> NDArray[np.int64]:
    """(F, 3) triangles of polygons: first corner, and each pair of the following ones."""
    if len(lengths) and lengths.min() < 3:
        raise InputError(f"{path}: expected faces of three corners and more, found {lengths.min()}")
    first = np.concatenate([[0], np.cumsum(lengths)[:-1]]) if len(lengths) else np.zeros(0, np.int64)
    counts = lengths - 2
    start = np.repeat(first, counts)
    step = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.stack([values[start], values[start + step + 1], values[start + step + 2]], 1)
