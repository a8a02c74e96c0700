"""Boards: what is printed on them, and where their points are.

A board's frame has x along its rows, y down its columns and z into it, so that the frame of an upright board in front
of a camera is turned like the camera's own. Lengths are metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.board_forms import BOARD_FORMS
from sfmapp.errors import InputError, UsageError
from sfmapp.formats.flat_yaml import read_flat_yaml

Array = NDArray[np.float64]
Kind = Literal["chessboard", "charuco", "circles", "acircles", "aprilgrid"]

# The most of anything along a side: boards have tens.
_MOST = 200
_LARGEST_M = 100.0
_KALIBR = {"aprilgrid": "aprilgrid", "checkerboard": "chessboard", "circlegrid": "circles"}


@dataclass(frozen=True)
class Board:
    """A flat target.

    Attributes:
        kind: of its pattern.
        columns, rows: inner corners of a chessboard, squares of a ChArUco board, circles, or tags.
        spacing: between neighbours (corners, circles), side of a square of a ChArUco board, or of a tag; metres.
        marker: side of a marker of a ChArUco board in metres; gap between tags as a share of their side.
        dictionary: of markers, a name of OpenCV's.
        unit: of lengths; ``squares`` (or whatever the pattern repeats by) of a board whose size nobody has said.
    """

    kind: Kind
    columns: int
    rows: int
    spacing: float
    marker: float = 0.0
    dictionary: str = ""
    unit: str = "m"

    def __post_init__(self) -> None:
        least = 1 if self.kind == "aprilgrid" else 2
        if not (least <= self.columns <= _MOST and least <= self.rows <= _MOST):
            raise UsageError(f"board: expected {least} to {_MOST} columns and rows, found {self.columns}x{self.rows}")
        if not 0.0 < self.spacing < _LARGEST_M:
            raise UsageError(f"board: expected a length in metres, found {self.spacing:g}", "25 mm are 0.025")
        if self.kind == "charuco" and not 0.0 < self.marker < self.spacing:
            raise UsageError(f"board: expected markers smaller than squares of {self.spacing:g}, found {self.marker:g}")
        if self.kind == "aprilgrid" and not 0.0 < self.marker < 2.0:
            raise UsageError(f"board: expected a gap between tags as a share of their side, found {self.marker:g}")

    @cached_property
    def points(self) -> Array:
        """(N, 3) the points of the board in its frame: row by row; of tags four corners each, clockwise from the one
        at the top left as the board is printed. The origin is the first corner or circle; of ChArUco boards and tags
        the corner of the whole."""
        c, r = np.meshgrid(np.arange(self.columns, dtype=np.float64), np.arange(self.rows, dtype=np.float64))
        if self.kind == "charuco":
            c, r = c[1:, 1:], r[1:, 1:]
        elif self.kind == "acircles":
            c = 2.0 * c + r % 2
        elif self.kind == "aprilgrid":
            step = 1.0 + self.marker
            corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
            xy = np.stack([c, r], -1).reshape(-1, 1, 2) * step + corners
            c, r = xy[..., 0], xy[..., 1]
        flat = np.stack([c.ravel(), r.ravel(), np.zeros(c.size)], 1)
        return flat * self.spacing

    @property
    def tells_part(self) -> bool:
        """Whether a part of it says which part it is: by its markers."""
        return self.kind in ("charuco", "aprilgrid")

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of all that is printed, in metres."""
        c, r, s = self.columns, self.rows, self.spacing
        if self.kind == "chessboard":
            return (c + 1) * s, (r + 1) * s
        if self.kind == "charuco":
            return c * s, r * s
        if self.kind == "circles":
            return c * s, r * s
        if self.kind == "acircles":
            return (2 * c + 1) * s, (r + 1) * s
        step = 1.0 + self.marker
        return (c * step + self.marker) * s, (r * step + self.marker) * s

    def text(self) -> str:
        """As :func:`parse_board` reads it."""
        fields = [self.kind, f"{self.columns}x{self.rows}", f"{self.spacing:g}"]
        fields += [f"{self.marker:g}"] * (self.kind in ("charuco", "aprilgrid"))
        fields += [self.dictionary] * bool(self.dictionary)
        return ":".join(fields)


def parse_board(text: str) -> Board:
    """The board of ``KIND:COLSxROWS:LENGTH...``, or of a target file of Kalibr's.

    Raises:
        UsageError: neither; the forms are the advice.
        InputError: the file is none of a target.
    """
    if text.lower().endswith((".yaml", ".yml")):
        return _of_kalibr(Path(text))
    kind, *fields = text.split(":")
    if kind not in get_args(Kind):
        raise UsageError(f"board {text!r}: expected one of {', '.join(get_args(Kind))}, found {kind!r}", BOARD_FORMS)
    try:
        columns, rows = (int(field) for field in fields[0].lower().split("x"))
        lengths = [float(field) for field in fields[1:3]]
    except (ValueError, IndexError):
        lengths = []
    wanted = 2 if kind in ("charuco", "aprilgrid") else 1
    if len(lengths) < wanted or len(fields) > 1 + wanted + (kind == "charuco"):
        raise UsageError(f"board {text!r}: expected COLSxROWS and {wanted} lengths", BOARD_FORMS)
    marker = lengths[1] if wanted == 2 else 0.0
    dictionary = {"charuco": "DICT_4X4_50", "aprilgrid": "DICT_APRILTAG_36H11"}.get(kind, "")
    if kind == "charuco" and len(fields) == 4:
        dictionary = fields[3].upper()
    return Board(kind, columns, rows, lengths[0], marker, dictionary)  # type: ignore[arg-type]


def _of_kalibr(path: Path) -> Board:
    fields = read_flat_yaml(path)
    kind = _KALIBR.get(str(fields.get("target_type")))
    names: tuple[str, ...]
    if kind == "aprilgrid":
        names = ("tagCols", "tagRows", "tagSize", "tagSpacing")
    elif kind == "chessboard":
        names = ("targetCols", "targetRows", "rowSpacingMeters", "colSpacingMeters")
    elif kind == "circles":
        names = ("targetCols", "targetRows", "spacingMeters")
        kind = "acircles" if fields.get("asymmetricGrid") is True else kind
    else:
        raise InputError(
            f"{path}: expected target_type {', '.join(_KALIBR)}, found {fields.get('target_type')!r}",
            "a target file of Kalibr's, or --board KIND:COLSxROWS:...",
        )
    values = [_number(path, fields, name) for name in names]
    if kind == "chessboard" and values[2] != values[3]:
        raise InputError(f"{path}: expected square fields, found rows of {values[2]:g} and columns of {values[3]:g}")
    marker = values[3] if kind == "aprilgrid" else 0.0
    dictionary = "DICT_APRILTAG_36H11" if kind == "aprilgrid" else ""
    return Board(kind, int(values[0]), int(values[1]), values[2], marker, dictionary)  # type: ignore[arg-type]


def _number(path: Path, fields: Mapping[str, object], name: str) -> float:
    value = fields.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{path}: expected {name}, a number, found {value!r}")
    return float(value)
