"""``calib.txt`` of Middlebury's stereo pairs (Scharstein et al., GCPR 2014): two rectified cameras, lengths in mm.

::

    cam0=[994.978 0 311.193; 0 994.978 254.877; 0 0 1]
    cam1=[994.978 0 342.279; 0 994.978 254.877; 0 0 1]
    doffs=31.086
    baseline=193.001
    width=741
    height=500

Pixel centres are at whole numbers, as OpenCV has them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file

_LINE = re.compile(r"\s*(\w+)\s*=\s*(.*?)\s*")
_MILLIMETRES = 1e3


@dataclass(frozen=True)
class MiddleburyCalibration:
    """Two rectified cameras, principal points with pixel centres at whole numbers.

    Attributes:
        focal: pixels, of both. cx, cy: of the left one. doffs: principal point of the right one minus that, along x.
        baseline_m: distance of the centres, metres. width, height: of both pictures. num_disparities: to be searched.
    """

    focal: float
    cx: float
    cy: float
    doffs: float
    baseline_m: float
    width: int
    height: int
    num_disparities: int | None = None


def is_middlebury(text: str) -> bool:
    """Whether the text of a file is of this form."""
    return any(re.match(r"\s*cam0\s*=\s*\[", line) for line in text.splitlines())


def middlebury_fields(place: str, text: str) -> dict[str, Any]:
    """Its fields under the names that calibration files of two cameras have for them, the baseline in metres.

    Raises:
        InputError: a line is of another form, or a matrix, the baseline or a size is missing.
    """
    given: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        found = _LINE.fullmatch(line)
        if found is None:
            raise InputError(f"{place}:{number}: expected name=value, found {line.strip()[:80]!r}")
        given[found[1]] = found[2]
    width, height = (_number(place, given, name) for name in ("width", "height"))
    cameras = {name: _matrix(place, given, name) for name in ("cam0", "cam1")}
    fields: dict[str, Any] = {
        name: {"intrinsics": matrix, "width": width, "height": height} for name, matrix in cameras.items()
    }
    doffs = cameras["cam1"][2] - cameras["cam0"][2]
    if "doffs" in given and abs(_number(place, given, "doffs") - doffs) > 0.5:
        raise InputError(
            f"{place}: expected doffs to be the difference of the principal points, {doffs:.3f}, found {given['doffs']}"
        )
    return {**fields, "baseline": _number(place, given, "baseline") / _MILLIMETRES}


def write_middlebury(path: Path, calibration: MiddleburyCalibration) -> None:
    """Write a ``calib.txt``. Raises InputError if it cannot be written."""
    c = calibration

    def matrix(cx: float) -> str:
        return f"[{c.focal!r} 0 {cx!r}; 0 {c.focal!r} {c.cy!r}; 0 0 1]"

    lines = [
        f"cam0={matrix(c.cx)}", f"cam1={matrix(c.cx + c.doffs)}", f"doffs={c.doffs!r}",
        f"baseline={c.baseline_m * _MILLIMETRES!r}", f"width={c.width}", f"height={c.height}",
    ]  # fmt: skip
    if c.num_disparities is not None:
        lines.append(f"ndisp={c.num_disparities}")
    with replaced_file(path) as beside:
        beside.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _number(place: str, given: dict[str, str], name: str) -> float:
    try:
        return float(given[name])
    except (KeyError, ValueError):
        raise InputError(f"{place}: expected {name}=NUMBER, found {given.get(name, 'no such line')!r}") from None


def _matrix(place: str, given: dict[str, str], name: str) -> list[float]:
    """fx, fy, cx, cy of ``[fx 0 cx; 0 fy cy; 0 0 1]``."""
    try:
        rows = [[float(one) for one in row.split()] for row in given[name].strip("[]").split(";")]
        (fx, skew, cx), (zero, fy, cy), last = rows
        if skew or zero or last != [0.0, 0.0, 1.0]:
            raise ValueError
    except (KeyError, ValueError):
        raise InputError(
            f"{place}: expected {name}=[f 0 cx; 0 f cy; 0 0 1], found {given.get(name, 'no such line')!r}"
        ) from None
    return [fx, fy, cx, cy]
