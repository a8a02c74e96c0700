"""Tables of points: places and the pixels that show them, corners of markers, and marks alone.

A table is text in columns, separated by commas, semicolons, tabs or spaces, with a line of names or without. A unit in
the names (``X [mm]``, ``x_mm``) is the unit of all that is computed. ``#`` begins a comment.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.text_input import plain_numbers, read_limited_text

Array = NDArray[np.float64]

_LARGEST_BYTES = 2**26
# what others call the columns, in lower case and without their unit
_NAMES: Mapping[str, str] = {
    "x": "x", "y": "y", "z": "z", "xw": "x", "yw": "y", "zw": "z", "u": "u", "v": "v", "px": "u", "py": "v",
    "col": "u", "row": "v", "name": "name", "id": "name", "point": "name", "label": "name", "figure": "name",
    "corner": "corner", "image": "image", "photograph": "image", "photo": "image", "picture": "image", "file": "image",
}  # fmt: skip
_HEAD = re.compile(r"\s*([A-Za-z]+)\s*(?:[_\s]\s*([A-Za-z]+)|[\[(]\s*([A-Za-z]+)\s*[\])])?\s*")


@dataclass(frozen=True)
class KnownPoints:
    """N points of one photograph.

    Attributes:
        path: the file. names: of the points; their number from 1 where it gives none.
        xyz: (N, 3) places. xy: (N, 2) pixels, as the file counts them.
        lines: (N,) of the file. unit: of the places, ``units`` where it names none.
    """

    path: Path
    names: tuple[str, ...]
    xyz: Array
    xy: Array
    lines: NDArray[np.int64]
    unit: str


@dataclass(frozen=True)
class MarkerPlaces:
    """Corners of square markers: by id, (4, 3) places, clockwise from the marker's own top left, and their unit."""

    path: Path
    corners: Mapping[int, Array]
    unit: str


@dataclass(frozen=True)
class Marks:
    """Pixels (M, 2) of figures: their names, one after another, with the positions of their marks."""

    path: Path
    xy: Array
    figures: tuple[tuple[str, tuple[int, ...]], ...]


@dataclass(frozen=True)
class _Table:
    columns: tuple[str, ...]
    unit: str
    rows: list[tuple[int, list[str]]]


def photographs_of(path: str | Path) -> tuple[str, ...]:
    """The photographs that the column ``image`` of a table of points names, in their order; none without one.

    Raises:
        InputError: no such file, or one that is no table of points.
    """
    table = _read_points(Path(path))
    if "image" not in table.columns:
        return ()
    place = table.columns.index("image")
    return tuple(dict.fromkeys(fields[place] for _, fields in table.rows))


def _read_points(path: Path) -> _Table:
    kinds = {4: ("x", "y", "u", "v"), 5: ("x", "y", "z", "u", "v"), 6: ("name", "x", "y", "z", "u", "v")}
    table = _read(path, kinds, "a line is: [name] X Y Z u v")
    _need(path, table, ("x", "y", "u", "v"))
    return table


def read_known_points(path: str | Path, photograph: str | None = None) -> KnownPoints:
    """Read ``[image] [name] X Y Z u v``, or ``[image] [name] X Y u v`` of a plane, whose Z is 0.

    Args:
        photograph: whose lines count where the table has a column ``image``, which names it with or without its ending.

    Raises:
        InputError: no such file, a line that is not what it has to be, one place twice in a photograph, or no line of
            the photograph: the message names the line.
    """
    path = Path(path)
    table = _read_points(path)
    if "image" in table.columns:
        table = _of_photograph(path, table, photograph)
    values = {name: _column(path, table, name) for name in ("x", "y", "z", "u", "v") if name in table.columns}
    xyz = np.stack([values["x"], values["y"], values.get("z", np.zeros(len(table.rows)))], 1)
    lines = np.array([line for line, _ in table.rows], np.int64)
    names = _names(table)
    first: dict[tuple[float, ...], int] = {}
    for place, line in zip(map(tuple, xyz.tolist()), lines.tolist(), strict=True):
        if first.setdefault(place, line) != line:
            raise InputError(
                f"{path}, line {line}: expected every place once, found that of line {first[place]} again",
                "take one of them out, or correct its coordinates",
            )
    if len(set(names)) < len(names):
        twice = next(name for n, name in enumerate(names) if name in names[:n])
        raise InputError(f"{path}: expected every name once, found {twice!r} twice")
    return KnownPoints(path, names, xyz, np.stack([values["u"], values["v"]], 1), lines, table.unit)


def _of_photograph(path: Path, table: _Table, photograph: str | None) -> _Table:
    """The lines of one photograph of a table that names several."""
    place = table.columns.index("image")
    named = list(dict.fromkeys(fields[place] for _, fields in table.rows))
    if photograph is None and len(named) > 1:
        raise InputError(f"{path}: expected points of one photograph, found those of {len(named)}: {_shown(named)}")
    wanted = {photograph, Path(photograph).stem} if photograph is not None else set(named)
    rows = [(line, fields) for line, fields in table.rows if fields[place] in wanted]
    if not rows:
        raise InputError(
            f"{path}: expected points of {photograph} in its column image, found those of {_shown(named)}",
            "the column has the name of the file, with or without its ending",
        )
    return _Table(table.columns, table.unit, rows)


def _shown(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def read_marker_places(path: str | Path) -> MarkerPlaces:
    """Read ``id corner X Y Z``, a line for each of the four corners of a marker, numbered 0 to 3.

    Raises:
        InputError: as above, or a marker without four corners.
    """
    path = Path(path)
    table = _read(path, {5: ("name", "corner", "x", "y", "z")}, "a line is: id corner X Y Z, with corners 0 to 3")
    _need(path, table, ("name", "corner", "x", "y", "z"))
    numbers = {name: _column(path, table, name) for name in ("name", "corner", "x", "y", "z")}
    found: dict[int, dict[int, Array]] = {}
    for n, (line, _) in enumerate(table.rows):
        marker, corner = numbers["name"][n], numbers["corner"][n]
        if marker != int(marker) or marker < 0 or corner not in (0, 1, 2, 3):
            raise InputError(
                f"{path}, line {line}: expected an id and a corner 0 to 3, found {marker:g} and {corner:g}"
            )
        corners = found.setdefault(int(marker), {})
        if int(corner) in corners:
            raise InputError(f"{path}, line {line}: expected every corner once, found corner {corner:g} again")
        corners[int(corner)] = np.array([numbers[name][n] for name in ("x", "y", "z")])
    for marker, corners in found.items():
        if len(corners) < 4:
            raise InputError(f"{path}: expected four corners of marker {marker}, found {len(corners)}")
    whole = {marker: np.stack([corners[k] for k in range(4)]) for marker, corners in found.items()}
    return MarkerPlaces(path, whole, table.unit)


def read_marks(path: str | Path) -> Marks:
    """Read ``name u v``: lines of one name, one after another, are the marks of one figure.

    Raises:
        InputError: as above.
    """
    path = Path(path)
    table = _read(path, {3: ("name", "u", "v")}, "a line is: name u v")
    _need(path, table, ("name", "u", "v"))
    figures: dict[str, list[int]] = {}
    for n, name in enumerate(_names(table)):
        figures.setdefault(name, []).append(n)
    xy = np.stack([_column(path, table, "u"), _column(path, table, "v")], 1)
    return Marks(path, xy, tuple((name, tuple(marks)) for name, marks in figures.items()))


def _read(path: Path, kinds: Mapping[int, tuple[str, ...]], advice: str) -> _Table:
    """The lines of a file as fields, and what its columns are; ``kinds`` without a line of names, by their number."""
    rows = []
    for line, text in enumerate(read_limited_text(path, _LARGEST_BYTES).splitlines(), 1):
        content = text.partition("#")[0].strip()
        if content:
            separator = next((s for s in (";", "\t", ",") if s in content), None)
            rows.append((line, [field.strip() for field in content.split(separator)]))
    if not rows:
        raise InputError(f"{path}: expected points, found no line", advice)
    line, fields = rows[0]
    heads = [_head(field) for field in fields]
    if all(head is not None for head in heads):
        columns = tuple(head[0] for head in heads if head is not None)
        units = {head[1] for head in heads if head is not None and head[0] in ("x", "y", "z") and head[1]}
        rows = rows[1:]
        if len(set(columns)) < len(columns) or len(units) > 1:
            raise InputError(f"{path}, line {line}: expected every column once, in one unit, found {fields}", advice)
    elif len(fields) in kinds:
        columns, units = kinds[len(fields)], set()
    else:
        raise InputError(
            f"{path}, line {line}: expected names of columns, or {' or '.join(map(str, kinds))} fields, found "
            f"{len(fields)}: {' '.join(fields)[:80]!r}",
            advice,
        )
    for line, fields in rows:
        if len(fields) != len(columns):
            raise InputError(f"{path}, line {line}: expected {len(columns)} fields, found {len(fields)}", advice)
    if not rows:
        raise InputError(f"{path}: expected points, found the names of columns only", advice)
    return _Table(columns, units.pop() if units else "units", rows)


def _head(field: str) -> tuple[str, str] | None:
    """A column and its unit, of its name; None for what is no name of one."""
    match = _HEAD.fullmatch(field)
    if match is None or match[1].lower() not in _NAMES:
        return None
    return _NAMES[match[1].lower()], (match[2] or match[3] or "").lower()


def _need(path: Path, table: _Table, names: Sequence[str]) -> None:
    if missing := [name for name in names if name not in table.columns]:
        raise InputError(f"{path}: expected a column {missing[0]!r}, found {', '.join(table.columns)}")


def _names(table: _Table) -> tuple[str, ...]:
    if "name" not in table.columns:
        return tuple(str(n + 1) for n in range(len(table.rows)))
    place = table.columns.index("name")
    return tuple(fields[place] or str(n + 1) for n, (_, fields) in enumerate(table.rows))


def _column(path: Path, table: _Table, name: str) -> Array:
    place, values = table.columns.index(name), []
    for line, fields in table.rows:
        try:
            (value,) = plain_numbers([fields[place]])
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise InputError(f"{path}, line {line}: expected a finite number for {name}, found {fields[place][:40]!r}")
        values.append(value)
    return np.array(values)
