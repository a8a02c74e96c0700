"""Ground control points: surveyed places and the pixels that somebody marked them at, from ODM's list or a table.

ODM's ``gcp_list.txt`` has a coordinate system in its first line and then ``x y z px py image [name]``, a line for each
marked pixel. OpenSfM, which reads it for ODM, counts pixels from the centre of the first one; here that centre is
(0.5, 0.5), so half a pixel is added. Our table is a CSV that counts as we do and knows standard deviations.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.text_input import plain_numbers, read_limited_text

Array = NDArray[np.float64]

LOCAL = "local"
"""Coordinate system of a site: metres along three axes at right angles, z up, no place on Earth."""

COLUMNS = ("name", "x", "y", "z", "sigma_x", "sigma_y", "sigma_z", "image", "px", "py", "sigma_px")
"""Of our table, in any order; the coordinates of a point may be left empty after its first row."""

_LARGEST_BYTES = 2**26
_EXAMPLE = "EPSG:25832, WGS84 UTM 32N, +proj=utm +zone=32 +datum=WGS84, or local"
_LINE = "a line is: x y z px py image [name]"
_TABLE = "a table begins with a line '# crs: EPSG:...', then the names of its columns: " + ", ".join(COLUMNS)


@dataclass(frozen=True)
class ControlPoints:
    """Surveyed points (P) and where photographs show them (O observations, sorted by point, then by photograph).

    Attributes:
        path: the file that they come from, crs_line: the number of the line that names the coordinate system.
        crs: coordinate system as the file names it, such as ``EPSG:25832`` or ``WGS84 UTM 32N``; or ``local``.
        names: P names, unique.
        xyz: (P, 3) float64 in that system, easting (or longitude) first, heights in its unit.
        sigma_m: (P, 3) float64 standard deviations of the coordinates, metres.
        obs_point_idx: (O,) int64, ascending.
        obs_image_idx: (O,) int64, positions among the photographs.
        obs_xy: (O, 2) float64 pixels, the centre of the first at (0.5, 0.5).
        obs_sigma_px: (O,) float64 standard deviations of a marked coordinate.
        obs_line: (O,) int64 lines of the file.
    """

    path: Path
    crs_line: int
    crs: str
    names: tuple[str, ...]
    xyz: Array
    sigma_m: Array
    obs_point_idx: NDArray[np.int64]
    obs_image_idx: NDArray[np.int64]
    obs_xy: Array
    obs_sigma_px: Array
    obs_line: NDArray[np.int64]

    @property
    def num_points(self) -> int:
        """P."""
        return len(self.names)

    def observations_of(self, point: int) -> NDArray[np.int64]:
        """(K,) positions of the observations of a point."""
        return np.arange(*np.searchsorted(self.obs_point_idx, [point, point + 1]))


@dataclass(frozen=True)
class _Row:
    """A marked pixel as a line has it; coordinates and sigmas None where they are left to another row."""

    line: int
    name: str
    xyz: tuple[float, ...] | None
    sigma_m: tuple[float, ...] | None
    image: str
    xy: tuple[float, float]
    sigma_px: float


def read_control_points(
    path: str | Path,
    sizes: Mapping[str, tuple[int, int]],
    *,
    sigma_m: tuple[float, float, float] = (0.02, 0.02, 0.03),
    sigma_px: float = 1.0,
) -> ControlPoints:
    """Read ODM's ``gcp_list.txt`` or our CSV, whichever it is.

    Args:
        sizes: width and height in pixels by name of the photographs, in their order. Lines name them so, or by the
            file name alone where that is unique.
        sigma_m: of points whose file gives none: those of network RTK, a few centimetres and poorer in height.
        sigma_px: of marks whose file gives none: those of a hand with a mouse.

    Raises:
        InputError: no such file, or a line that is not what it has to be; the message names it, what was expected and
            what was found.
    """
    path = Path(path)
    lines = read_limited_text(path, _LARGEST_BYTES).splitlines()
    first = next((line for line in lines if line.strip() and not line.lstrip().startswith("#")), "")
    if "image" in [field.strip().lower() for field in first.split(",")]:
        crs_line, crs, rows = _read_table(path, lines, sigma_m, sigma_px)
    else:
        crs_line, crs, rows = _read_odm(path, lines, sigma_m, sigma_px)
    if not rows:
        raise InputError(f"{path}: expected control points, found none", _LINE)
    return _gather(path, crs_line, crs, rows, sizes)


# ------------------------------------------------------------------------------------------------------------------ ODM


def _read_odm(
    path: Path, lines: Sequence[str], sigma_m: tuple[float, float, float], sigma_px: float
) -> tuple[int, str, list[_Row]]:
    content = [
        (n, line.strip()) for n, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")
    ]
    if not content:
        raise InputError(f"{path}: expected a coordinate system and control points, found no line", _LINE)
    (crs_line, header), *rest = content
    crs = _system(path, crs_line, header)
    rows, name_of = [], dict[tuple[float, ...], str]()
    for line, text in rest:
        words = text.split("\t") if text.count("\t") >= 5 else text.split()
        if len(words) < 6:
            raise InputError(
                f"{path}, line {line}: expected at least 6 words, found {len(words)}: {text[:80]!r}",
                _TABLE if "," in text else _LINE,
            )
        x, y, z, px, py = _numbers(path, line, words[:5], ("x", "y", "z", "px", "py"))
        name = words[6].strip() if len(words) > 6 else name_of.setdefault((x, y, z), f"point{len(name_of) + 1}")
        # the centre of the first pixel is at the origin for OpenSfM, half a pixel from it for us
        rows.append(_Row(line, name, (x, y, z), sigma_m, words[5].strip(), (px + 0.5, py + 0.5), sigma_px))
    return crs_line, crs, rows


def _system(path: Path, line: int, text: str) -> str:
    """The coordinate system that a header names."""
    words = text.split()
    try:
        is_data = len(plain_numbers(words[:5])) == 5
    except ValueError:
        is_data = False
    if is_data:
        raise InputError(
            f"{path}, line {line}: expected a coordinate system in the first line, found {text[:80]!r}",
            f"write one of {_EXAMPLE}",
        )
    return LOCAL if text.lower() == LOCAL else text


def _numbers(path: Path, line: int, fields: Sequence[str], names: Sequence[str], advice: str = _LINE) -> list[float]:
    """Finite numbers of a line, by what they are."""
    out = []
    for name, field in zip(names, fields, strict=True):
        try:
            (value,) = plain_numbers([field])
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise InputError(f"{path}, line {line}: expected a number for {name}, found {field.strip()[:40]!r}", advice)
        out.append(value)
    return out


# ---------------------------------------------------------------------------------------------------------- our own CSV


def _read_table(
    path: Path, lines: Sequence[str], sigma_m: tuple[float, float, float], sigma_px: float
) -> tuple[int, str, list[_Row]]:
    crs_line, crs, head = 0, "", dict[str, int]()
    rows = []
    for line, text in enumerate(lines, 1):
        if text.lstrip().startswith("#"):
            if found := re.match(r"\s*#\s*crs\s*[:=]\s*(.+)", text, re.IGNORECASE):
                crs_line, crs = line, _system(path, line, found[1].strip().rstrip(","))
        elif text.strip():
            fields = [field.strip() for field in next(csv.reader([text]))]
            if head:
                rows.append(_table_row(path, line, fields, head, (sigma_m, sigma_px)))
            else:
                head = _columns(path, line, fields)
    if not crs:
        raise InputError(
            f"{path}: expected a line '# crs: ...' before the columns, found none", f"write one of # crs: {_EXAMPLE}"
        )
    return crs_line, crs, rows


def _columns(path: Path, line: int, fields: Sequence[str]) -> dict[str, int]:
    """Positions of the columns by name."""
    names = [field.lower() for field in fields]
    advice = f"columns: {', '.join(COLUMNS)}; the sigmas may be left out"
    if unknown := [name for name in names if name not in COLUMNS]:
        raise InputError(f"{path}, line {line}: expected known columns, found {unknown[0]!r}", advice)
    needed = [name for name in COLUMNS if not name.startswith("sigma")]
    if missing := [name for name in needed if name not in names]:
        raise InputError(f"{path}, line {line}: expected a column {missing[0]!r}, found none", advice)
    if len(set(names)) < len(names):
        raise InputError(f"{path}, line {line}: expected each column once, found one twice", advice)
    return {name: n for n, name in enumerate(names)}


def _table_row(
    path: Path,
    line: int,
    fields: Sequence[str],
    head: Mapping[str, int],
    defaults: tuple[tuple[float, float, float], float],
) -> _Row:
    if len(fields) != len(head):
        raise InputError(f"{path}, line {line}: expected {len(head)} fields, found {len(fields)}", _TABLE)

    def group(names: tuple[str, ...]) -> tuple[float, ...] | None:
        """Numbers of columns; None where all are empty or not there."""
        held = [fields[head[name]] if name in head else "" for name in names]
        return tuple(_numbers(path, line, held, names, _TABLE)) if any(held) else None

    name, image = fields[head["name"]], fields[head["image"]]
    if not name or not image:
        raise InputError(
            f"{path}, line {line}: expected names of a point and of a photograph, found an empty field", _TABLE
        )
    xyz, sigmas, sigma = group(("x", "y", "z")), group(("sigma_x", "sigma_y", "sigma_z")), group(("sigma_px",))
    px, py = _numbers(path, line, [fields[head["px"]], fields[head["py"]]], ("px", "py"), _TABLE)
    if xyz is not None and sigmas is None:
        sigmas = defaults[0]
    for value, unit in [*((s, "m") for s in sigmas or ()), *((s, "px") for s in sigma or ())]:
        if not value > 0:
            raise InputError(
                f"{path}, line {line}: expected standard deviations above zero, found {value:g} {unit}",
                "give the accuracy that the survey states, or leave the field empty for the default",
            )
    return _Row(line, name, xyz, sigmas, image, (px, py), sigma[0] if sigma else defaults[1])


# ------------------------------------------------------------------------------------------------------ what all have


def _gather(
    path: Path, crs_line: int, crs: str, rows: Sequence[_Row], sizes: Mapping[str, tuple[int, int]]
) -> ControlPoints:
    points: dict[str, list[_Row]] = {}
    for row in rows:
        points.setdefault(row.name, []).append(row)
    photographs, order = _Photographs(sizes), list(sizes)
    observations: list[tuple[int, int, _Row]] = []
    for p, (name, own) in enumerate(points.items()):
        seen = dict[int, _Row]()
        for row in own:
            image = photographs.find(path, row)
            _check_pixel(path, row, order[image], *sizes[order[image]])
            if image in seen:
                raise InputError(
                    f"{path}, line {row.line}: expected one mark of point {name!r} in {order[image]}, found another in "
                    f"line {seen[image].line}",
                    "remove one of them",
                )
            seen[image] = row
        if len(seen) < 2:
            raise InputError(
                f"{path}, line {own[0].line}: expected point {name!r} in two photographs or more, found it in one",
                "mark it in another photograph, or remove the line: a single ray does not fix a point",
            )
        observations += [(p, image, seen[image]) for image in sorted(seen)]
    places = [_place(path, name, own) for name, own in points.items()]
    _check_places(path, places)
    return ControlPoints(
        path=path,
        crs_line=crs_line,
        crs=crs,
        names=tuple(points),
        xyz=np.array([row.xyz for row in places], np.float64).reshape(-1, 3),
        sigma_m=np.array([row.sigma_m for row in places], np.float64).reshape(-1, 3),
        obs_point_idx=np.array([p for p, _, _ in observations], np.int64),
        obs_image_idx=np.array([i for _, i, _ in observations], np.int64),
        obs_xy=np.array([row.xy for *_, row in observations], np.float64).reshape(-1, 2),
        obs_sigma_px=np.array([row.sigma_px for *_, row in observations], np.float64),
        obs_line=np.array([row.line for *_, row in observations], np.int64),
    )


class _Photographs:
    """Positions of photographs by the names that lines give them."""

    def __init__(self, sizes: Mapping[str, tuple[int, int]]) -> None:
        self._full = {name: n for n, name in enumerate(sizes)}
        self._short: dict[str, list[int]] = {}
        for n, name in enumerate(sizes):
            self._short.setdefault(PurePosixPath(name).name.lower(), []).append(n)

    def find(self, path: Path, row: _Row) -> int:
        """That which a row names in full, or by the file name alone in any case."""
        name = row.image.replace("\\", "/").removeprefix("./")
        if name in self._full:
            return self._full[name]
        found = self._short.get(PurePosixPath(name).name.lower(), [])
        if len(found) == 1:
            return found[0]
        if found:
            raise InputError(
                f"{path}, line {row.line}: expected the name of one photograph, found {row.image!r}, of which there "
                f"are {len(found)}",
                "give it with its folder",
            )
        some = ", ".join(list(self._full)[:3])
        raise InputError(
            f"{path}, line {row.line}: expected the name of a photograph, such as {some}; found {row.image!r}",
            "add the photograph, or remove the line",
        )


def _check_pixel(path: Path, row: _Row, image: str, width: int, height: int) -> None:
    if not (0 <= row.xy[0] <= width and 0 <= row.xy[1] <= height):
        raise InputError(
            f"{path}, line {row.line}: expected a pixel of {image}, which has {width} x {height}, found "
            f"({row.xy[0]:g}, {row.xy[1]:g})",
            "pixels are those of the file as stored: not turned by EXIF's orientation, nor of a smaller copy",
        )


def _place(path: Path, name: str, rows: Sequence[_Row]) -> _Row:
    """The row that says where a point is, with which all others have to agree."""
    known = [row for row in rows if row.xyz is not None]
    if not known:
        raise InputError(
            f"{path}, line {rows[0].line}: expected coordinates of point {name!r} in one of its rows, found none",
            "fill x, y and z where the point is first marked",
        )
    for row in known[1:]:
        if (row.xyz, row.sigma_m) != (known[0].xyz, known[0].sigma_m):
            raise InputError(
                f"{path}, line {row.line}: expected the coordinates and sigmas of point {name!r} that line "
                f"{known[0].line} has, found others",
                "give one of the points another name, or leave all but one empty in a CSV",
            )
    return known[0]


def _check_places(path: Path, places: Sequence[_Row]) -> None:
    """Two names for one place are one point."""
    first: dict[tuple[float, ...], _Row] = {}
    for row in places:
        assert row.xyz is not None
        if (other := first.setdefault(row.xyz, row)) is not row:
            raise InputError(
                f"{path}, line {row.line}: expected another place for point {row.name!r} than for {other.name!r} in "
                f"line {other.line}, found the same",
                "a point has one name; correct the coordinates, or the name",
            )
