"""Boards on paper, at true size, as SVG or PDF.

Both are lists of filled shapes in millimetres: no picture, so that edges are as sharp as the printer makes them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.boards import Board
from sfmapp.calibration.markers import marker_bits
from sfmapp.errors import UsageError
from sfmapp.formats.atomic import write_bytes

# width and height in millimetres, upright
PAPERS = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "letter": (215.9, 279.4)}

# what common printers leave white
_MARGIN_MM = 8.0
# below the board: what it is, and a line of known length to lay a ruler on
_CAPTION_MM = 8.0
_RULER_MM = 100.0
_POINTS_PER_MM = 72.0 / 25.4
# radius of a circle as a share of the distance between neighbours, as OpenCV's pattern generator has it
CIRCLE_RADIUS = 0.25
# cells of the black border of a tag: Kalibr's have two
KALIBR_BORDER = 2
# control points of a quarter of a circle as a Bezier curve
_BEZIER = 4.0 / 3.0 * (math.sqrt(2.0) - 1.0)


@dataclass(frozen=True)
class Rectangle:
    """A black rectangle, millimetres from the top left."""

    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True)
class Disk:
    """A black disk, millimetres from the top left."""

    x: float
    y: float
    radius: float


def default_board(paper: str) -> Board:
    """The ChArUco board with the largest squares of whole millimetres that fits on a sheet: found when only a part of
    it is in the picture."""
    width, height = _room(paper)
    columns, rows = 11, 8
    square = math.floor(min(width / columns, height / rows))
    return Board("charuco", columns, rows, square / 1000.0, 0.75 * square / 1000.0, "DICT_4X4_50")


def write_board(path: Path, board: Board, paper: str) -> None:
    """Write a board as it is to be printed, the long side of the sheet lying.

    Args:
        path: ends in ``.svg`` or ``.pdf``.
        paper: one of :data:`PAPERS`.

    Raises:
        UsageError: another ending, or a board that does not fit on the sheet.
        InputError: it cannot be written.
    """
    kind = path.suffix.lower()
    if kind not in (".svg", ".pdf"):
        raise UsageError(f"{path}: expected a file that ends in .svg or .pdf, found {kind or 'no ending'}")
    width, height = (1000.0 * side for side in board.size)
    room = _room(paper)
    if width > room[0] or height > room[1]:
        share = min(room[0] / width, room[1] / height)
        raise UsageError(
            f"board {board.text()}: {width:.0f} x {height:.0f} mm do not fit on {paper}, which has room for "
            f"{room[0]:.0f} x {room[1]:.0f}",
            f"lengths may be {share:.3f} of these; or take a larger sheet: --paper {', '.join(PAPERS)}",
        )
    sheet = PAPERS[paper][::-1]
    left, top = (sheet[0] - width) / 2.0, (sheet[1] - _CAPTION_MM - height) / 2.0
    shapes = [_moved(shape, left, top) for shape in shapes_of(board)]
    below = sheet[1] - _MARGIN_MM
    shapes.append(Rectangle(sheet[0] - _MARGIN_MM - _RULER_MM, below - 0.5, _RULER_MM, 0.5))
    caption = f"{board.text()}  print at 100 %, without fitting to the page; the line is {_RULER_MM:.0f} mm long"
    text = (_MARGIN_MM, below, caption)
    write_bytes(path, _svg(sheet, shapes, text) if kind == ".svg" else _pdf(sheet, shapes, text))


def _room(paper: str) -> tuple[float, float]:
    if paper not in PAPERS:
        raise UsageError(f"paper is {paper!r}, expected one of {', '.join(PAPERS)}")
    short, long = PAPERS[paper]
    return long - 2.0 * _MARGIN_MM, short - 2.0 * _MARGIN_MM - _CAPTION_MM


def shapes_of(board: Board) -> Iterator[Rectangle | Disk]:
    """What is black, in millimetres from the top left of the board."""
    s = 1000.0 * board.spacing
    if board.kind == "chessboard":
        for r in range(board.rows + 1):
            for c in range(r % 2, board.columns + 1, 2):
                yield Rectangle(c * s, r * s, s, s)
    elif board.kind == "charuco":
        m, number = 1000.0 * board.marker, 0
        for r in range(board.rows):
            for c in range(board.columns):
                if (r + c) % 2 == 0:
                    yield Rectangle(c * s, r * s, s, s)
                else:
                    at = (c * s + (s - m) / 2.0, r * s + (s - m) / 2.0)
                    yield from _marker(marker_bits(board.dictionary, number, 1), at, m)
                    number += 1
    elif board.kind == "aprilgrid":
        gap = s * board.marker
        for r in range(board.rows):
            for c in range(board.columns):
                # Kalibr counts from the bottom left
                number = (board.rows - 1 - r) * board.columns + c
                at = (gap + c * (s + gap), gap + r * (s + gap))
                yield from _marker(marker_bits(board.dictionary, number, KALIBR_BORDER), at, s)
        for r in range(board.rows + 1):
            for c in range(board.columns + 1):
                yield Rectangle(c * (s + gap), r * (s + gap), gap, gap)
    else:
        for x, y, _ in 1000.0 * board.points:
            yield Disk(x + 0.5 * s, y + 0.5 * s, CIRCLE_RADIUS * s * (1.0 if board.kind == "circles" else 1.2))


def _marker(bits: NDArray[np.bool_], at: tuple[float, float], side: float) -> Iterator[Rectangle]:
    """The black cells of a marker, those beside each other as one."""
    cell = side / len(bits)
    for r, row in enumerate(bits):
        edges = np.flatnonzero(np.diff(np.concatenate([[True], row, [True]]).astype(np.int8)))
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            yield Rectangle(at[0] + first * cell, at[1] + r * cell, (last - first) * cell, cell)


def _moved(shape: Rectangle | Disk, dx: float, dy: float) -> Rectangle | Disk:
    if isinstance(shape, Disk):
        return Disk(shape.x + dx, shape.y + dy, shape.radius)
    return Rectangle(shape.x + dx, shape.y + dy, shape.width, shape.height)


def _svg(sheet: tuple[float, float], shapes: list[Rectangle | Disk], text: tuple[float, float, str]) -> bytes:
    parts = []
    for shape in shapes:
        if isinstance(shape, Disk):
            parts.append(f'<circle cx="{shape.x:.5f}" cy="{shape.y:.5f}" r="{shape.radius:.5f}"/>')
        else:
            place = f'x="{shape.x:.5f}" y="{shape.y:.5f}"'
            parts.append(f'<rect {place} width="{shape.width:.5f}" height="{shape.height:.5f}"/>')
    parts.append(f'<text x="{text[0]:.3f}" y="{text[1]:.3f}" font-size="3" font-family="sans-serif">'
                 f"{escape(text[2])}</text>")  # fmt: skip
    size = f'width="{sheet[0]}mm" height="{sheet[1]}mm" viewBox="0 0 {sheet[0]} {sheet[1]}"'
    body = "\n".join(parts)
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} fill="#000">\n{body}\n</svg>\n'.encode()


def _pdf(sheet: tuple[float, float], shapes: list[Rectangle | Disk], text: tuple[float, float, str]) -> bytes:
    """A page of PDF 1.4 (ISO 32000-1): y goes up, lengths are points once the matrix has scaled millimetres."""
    k = _POINTS_PER_MM
    lines = [f"{k:.8f} 0 0 {-k:.8f} 0 {sheet[1] * k:.5f} cm", "0 g"]
    for shape in shapes:
        if isinstance(shape, Rectangle):
            lines.append(f"{shape.x:.5f} {shape.y:.5f} {shape.width:.5f} {shape.height:.5f} re f")
            continue
        x, y, r, b = shape.x, shape.y, shape.radius, shape.radius * _BEZIER
        lines.append(f"{x + r:.5f} {y:.5f} m")
        for turn in range(4):
            (ax, ay), (bx, by) = [(math.cos(a), math.sin(a)) for a in (turn * math.pi / 2, (turn + 1) * math.pi / 2)]
            numbers = (x + r * ax + b * bx, y + r * ay + b * by, x + r * bx + b * ax, y + r * by + b * ay)
            lines.append(" ".join(f"{number:.5f}" for number in (*numbers, x + r * bx, y + r * by)) + " c")
        lines.append("f")
    escaped = text[2].replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
    lines.append(f"BT /F1 3 Tf 1 0 0 -1 {text[0]:.3f} {text[1]:.3f} Tm ({escaped}) Tj ET")
    stream = "\n".join(lines).encode("latin-1", "replace")
    media = f"[0 0 {sheet[0] * k:.4f} {sheet[1] * k:.4f}]"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {media} /Contents 4 0 R /Resources "
        "<< /Font << /F1 << /Type /Font /Subtype /Type1 /BaseFont /Helvetica >> >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
    ]
    data, places = b"%PDF-1.4\n", []
    for number, body in enumerate(objects, 1):
        places.append(len(data))
        data += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    end = b"trailer << /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, len(data))
    return data + b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1) + table + end
