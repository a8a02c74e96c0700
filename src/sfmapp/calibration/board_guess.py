"""Which board photographs show: its kind and its size, by what several of them agree on.

Each photograph is asked by itself: for markers, whose numbers and places tell the layout; for a grid of crossings; for
a grid of circles. A photograph that shows a part of a board may show less than there is, never something else. What no
photograph tells is the unit: lengths are in squares, or whatever the pattern repeats by.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.boards import Board, Kind
from sfmapp.calibration.circles import CircleLattice, find_circle_lattice, grid_of, place_on
from sfmapp.calibration.lattice import find_lattice
from sfmapp.calibration.markers import dictionary_of
from sfmapp.errors import InputError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Pixels = NDArray[np.uint8]

# what lengths are in, as no photograph says how large a board is
UNIT = "squares"
# longer side of the picture that is looked into
_REDUCED_PX = 1200
# Families of markers, and their border in cells. Dictionaries of a family begin with the smaller ones: no board has
# more than 250 markers, and looking them up is what takes time.
_FAMILIES = (
    ("DICT_4X4_250", 1), ("DICT_5X5_250", 1), ("DICT_6X6_250", 1), ("DICT_7X7_250", 1), ("DICT_ARUCO_MIP_36H12", 1),
    ("DICT_APRILTAG_36H11", 1), ("DICT_APRILTAG_36H11", 2),
)  # fmt: skip
_SIZES = (50, 100, 250)
# half of the window in which corners of tags are measured, as a share of their side: thresholds leave them that much
# inside, where the squares of the gaps meet them
_WINDOW = 0.1
# markers that are no chance: noise and squares are now and then taken for one
_LEAST_MARKERS = 4
_MOST_COLUMNS = 30
# of the distance between two markers: what their places may be off from those of a layout in the mean, a misread number
# counting 1; and how much worse every other layout has to be
_FITS, _TELLS = 0.1, 2.0
# gaps between tags are printed as a multiple of this share of their side, which is taken if it is as near as that
_GAP, _NEAR_GAP = 0.05, 0.01
# of a grid's places: more than this filled, and of those around it inside of the picture, is the whole of it
_WHOLE = 0.95
# steps beyond a grid at which its next row would have been seen well enough to be found
_BEYOND = 1.6
_EVERY_CIRCLE, _LEAST_CROSSINGS = 10_000, 12
# photographs that show another board, per photograph that shows this one, are a contradiction; and least of them
_CONTRADICTING, _LEAST_CONTRADICTING = 0.25, 2


@dataclass(frozen=True)
class Markers:
    """Markers of one family in a photograph.

    Attributes:
        family: position in the table of families.
        quads: (4, 2) pixels of each, clockwise from its own top left.
    """

    family: int
    quads: Mapping[int, Array]


@dataclass(frozen=True)
class Sign:
    """What a photograph shows that may be a board.

    Attributes:
        kind: of the pattern; markers count apart.
        columns, rows: of the grid, columns the more.
        is_whole: it goes on nowhere, though there is room in the picture.
    """

    kind: Kind
    columns: int
    rows: int
    is_whole: bool


@dataclass(frozen=True)
class BoardGuess:
    """The board that photographs show.

    Attributes:
        board: with lengths in squares: sides of squares, tags, or steps between circles.
        num_agree: photographs that show it whole, or markers of it; num_part: that may show a part of it.
        num_other: that show another board; num_nothing: that show none.
        notes: what to know of it, a line each.
    """

    board: Board
    num_agree: int
    num_part: int
    num_other: int
    num_nothing: int
    notes: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """What was guessed, and by what."""
        num = self.num_agree + self.num_part + self.num_other + self.num_nothing
        parts = [f"{self.num_agree} of {num} photographs looked into agree"]
        parts += [f"{self.num_part} may show a part of it"] * bool(self.num_part)
        parts += [f"{self.num_other} show another"] * bool(self.num_other)
        parts += [f"{self.num_nothing} show none"] * bool(self.num_nothing)
        return f"{self.board.text()}: {', '.join(parts)}"

    @property
    def is_sure(self) -> bool:
        """Three photographs and more agree, and none shows another."""
        return self.num_agree >= 3 and self.num_other == 0


@dataclass(frozen=True)
class PictureSigns:
    """What was found in one photograph: markers of the families that have some, and a grid where there are none."""

    markers: tuple[Markers, ...]
    sign: Sign | None


def signs_of(gray: Pixels) -> PictureSigns:
    """What in a picture (H, W) may be a board; reduced, so that it is quick."""
    import cv2

    cv2.setNumThreads(1)
    scale = max(1.0, max(gray.shape) / _REDUCED_PX)
    if scale > 1.0:
        size = (round(gray.shape[1] / scale), round(gray.shape[0] / scale))
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    markers = tuple(_markers(gray))
    if markers:
        return PictureSigns(markers, None)
    return PictureSigns((), _crossings(gray) or _circles(gray))


def guess_board(pictures: Sequence[PictureSigns], source: str) -> BoardGuess:
    """The board that photographs agree on.

    Raises:
        InputError: they show none, or different ones; it says which and how many.
    """
    found = _of_markers(pictures)
    if found is None:
        found = _of_grids(pictures)
    if found is None:
        raise InputError(
            f"{source}: expected photographs of a board, found none in the {len(pictures)} that were looked into: no "
            "markers, no chessboard, no grid of circles",
            "say what they show: --board KIND:COLSxROWS:LENGTH",
        )
    if found.num_other >= max(_LEAST_CONTRADICTING, _CONTRADICTING * found.num_agree):
        raise InputError(
            f"{source}: expected photographs of one board, found {found.text}; {'; '.join(found.notes)}",
            "take away the photographs of the others, or say which one counts: --board KIND:COLSxROWS:LENGTH",
        )
    return found


# ------------------------------------------------------------------------------------------------------------- markers


def _markers(gray: Pixels) -> Iterator[Markers]:
    import cv2

    for border in (1, 2):
        families = [n for n, family in enumerate(_FAMILIES) if family[1] == border]
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = border
        parameters.minMarkerPerimeterRate = 0.02
        # strict, as each marker is looked for in thousands
        parameters.errorCorrectionRate = 0.3
        detector = cv2.aruco.ArucoDetector([dictionary_of(_FAMILIES[n][0]) for n in families], parameters)
        corners, ids, _, which = detector.detectMarkersMultiDict(gray)
        if ids is None:
            continue
        numbers, owner = np.ravel(ids), np.ravel(which)
        for n, family in enumerate(families):
            own = np.flatnonzero(owner == n)
            counts = Counter(numbers[own].tolist())
            once = [k for k in own if counts[int(numbers[k])] == 1]
            if len(once) >= _LEAST_MARKERS:
                yield Markers(family, {int(numbers[k]): _refined(gray, corners[k].reshape(4, 2)) for k in once})


def _refined(gray: Pixels, quad: NDArray[np.float32]) -> Array:
    """(4, 2) the corners of a marker to a part of a pixel."""
    import cv2

    half = max(3, round(_WINDOW * float(np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).min())))
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.02)
    found = cv2.cornerSubPix(gray, quad.reshape(4, 1, 2).astype(np.float32).copy(), (half, half), (-1, -1), stop)
    return np.asarray(found, np.float64).reshape(4, 2)


def _of_markers(pictures: Sequence[PictureSigns]) -> BoardGuess | None:
    votes = Counter(max(one.markers, key=lambda m: len(m.quads)).family for one in pictures if one.markers)
    if not votes:
        return None
    family = votes.most_common(1)[0][0]
    own = [next((m for m in one.markers if m.family == family), None) for one in pictures]
    seen = [m for m in own if m is not None]
    layout = _layout(seen)
    if layout is None:
        raise InputError(
            f"expected a board of markers, found markers of {_FAMILIES[family][0]} in {len(seen)} photographs, whose "
            "places are those of no ChArUco board or AprilGrid",
            "say what they show: --board KIND:COLSxROWS:LENGTH",
        )
    kind, columns, first, step = layout
    agrees = [m is not None and _fit(m, kind, columns, first, step) for m in own]
    numbers = Counter(n for m, good in zip(own, agrees, strict=True) if good and m is not None for n in m.quads)
    # a number that one photograph alone has may be misread
    last = max((n for n, count in numbers.items() if count > 1 or len(seen) == 1), default=max(numbers, default=0))
    rows = int(_places(np.array([last]), kind, columns, first)[0, 1]) + 1
    others = sum(bool(one.markers) and not good for one, good in zip(pictures, agrees, strict=True))
    nothing = sum(not one.markers and one.sign is None for one in pictures)
    part = len(pictures) - sum(agrees) - others - nothing
    board, notes = _board_of_markers(kind, columns, rows, step, family, last)
    if others:
        notes.append(f"{others} photographs have markers whose places differ")
    return BoardGuess(board, sum(agrees), part, others, nothing, tuple(notes))


def _board_of_markers(
    kind: Kind, columns: int, rows: int, step: float, family: int, last: int
) -> tuple[Board, list[str]]:
    """The board, and what to know of it. ``step``: between neighbouring places in sides of a marker."""
    name = _FAMILIES[family][0]
    if kind == "charuco":
        size = next((n for n in _SIZES if n > last), _SIZES[-1])
        name = name.replace("_250", f"_{size}")
        return Board("charuco", columns, rows, 1.0, round(1.0 / step, 2), name, unit=UNIT), []
    gap = step - 1.0
    nearest = _GAP * round(gap / _GAP)
    if abs(gap - nearest) < _NEAR_GAP and nearest > 0:
        return Board("aprilgrid", columns, rows, 1.0, round(nearest, 3), name, unit=UNIT), []
    note = f"the gap between tags is {gap:.3f} of their side, which is no usual one: measure it, and say it by --board"
    return Board("aprilgrid", columns, rows, 1.0, round(gap, 3), name, unit=UNIT), [note]


def _places(numbers: Ints, kind: Kind, columns: int, first: int) -> Array:
    """(N, 2) column and row of markers by their numbers."""
    if kind == "aprilgrid":
        # Kalibr counts from the bottom: rows here are negative
        return np.stack([numbers % columns, numbers // columns], 1).astype(np.float64)
    # in two rows together there are as many markers as columns
    pair, left = numbers // columns, numbers % columns
    in_upper = (columns + first) // 2
    is_lower = left >= in_upper
    along = np.where(is_lower, left - in_upper, left)
    # in the upper row of two the first marker is in the second square, unless that one is dark
    begin = np.where(is_lower, first, 1 - first)
    return np.stack([2 * along + begin, 2 * pair + is_lower], 1).astype(np.float64)


def _steps(markers: Markers) -> tuple[Ints, Array]:
    """(M, 2) numbers of markers beside each other, and (M, 2) the way between their middles in their own sides."""
    numbers = np.array(sorted(markers.quads), np.int64)
    quads = np.array([markers.quads[int(n)] for n in numbers])
    middles = quads.mean(1)
    a, b, c, d = quads.swapaxes(0, 1)
    axes = 0.5 * np.stack([b - a + c - d, d - a + c - b], 1)
    distances = np.linalg.norm(middles[:, None] - middles[None], axis=2)
    near = np.argsort(distances, axis=1, kind="stable")[:, 1:5]
    pairs = np.stack([np.repeat(np.arange(len(numbers)), near.shape[1]), near.ravel()], 1)
    both = 0.5 * (axes[pairs[:, 0]] + axes[pairs[:, 1]])
    way = (middles[pairs[:, 1]] - middles[pairs[:, 0]])[:, None]
    local: Array = np.linalg.solve(both.swapaxes(1, 2), way.swapaxes(1, 2))[..., 0]
    return numbers[pairs], local


def _layout(seen: Sequence[Markers]) -> tuple[Kind, int, int, float] | None:
    """Kind, columns, which square is the first dark one, and step between places in sides of a marker; None where none
    fits, or several do."""
    found = [_steps(markers) for markers in seen]
    numbers, local = (np.concatenate(parts) for parts in zip(*found, strict=True))
    scores: list[tuple[float, Kind, int, int, float]] = []
    hypotheses: list[tuple[Kind, int]] = [("charuco", 0), ("charuco", 1), ("aprilgrid", 0)]
    for kind, first in hypotheses:
        for columns in range(2, _MOST_COLUMNS + 1):
            error, step = _misfit(numbers, local, kind, columns, first)
            scores.append((error, kind, columns, first, step))
    scores.sort()
    error, kind, columns, first, step = scores[0]
    if error > _FITS or step <= 1.0 or scores[1][0] < _TELLS * error:
        return None
    return kind, columns, first, step


def _misfit(numbers: Ints, local: Array, kind: Kind, columns: int, first: int) -> tuple[float, float]:
    """By how much ways between markers differ from those of a layout, as a share of them, in the mean; and the step
    between places that fits best."""
    a, b = (_places(numbers[:, k], kind, columns, first) for k in range(2))
    way = b - a
    if kind == "aprilgrid":
        way[:, 1] = -way[:, 1]
    size = np.linalg.norm(way, axis=1)
    length = np.linalg.norm(local, axis=1)
    if not (size > 0).all():
        return np.inf, 0.0
    step = float(np.median(length / size))
    best = np.inf
    # programs begin with any corner of a tag
    for turn in range(4):
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[turn]
        turned = local @ np.array([[c, s], [-s, c]])
        off = np.linalg.norm(turned - step * way, axis=1) / length
        best = min(best, float(np.minimum(off, 1.0).mean()))
    return best, step


def _fit(markers: Markers, kind: Kind, columns: int, first: int, step: float) -> bool:
    error, own = _misfit(*_steps(markers), kind, columns, first)
    return error < 2.0 * _FITS and 0.8 < own / step < 1.25


# ------------------------------------------------------------------------------------------------ grids without marks


def _crossings(gray: Pixels) -> Sign | None:
    lattice = find_lattice(gray, _LEAST_CROSSINGS)
    if lattice is None:
        return None
    columns, rows = (int(side) + 1 for side in lattice.places.max(0))
    is_whole = len(lattice.xy) > _WHOLE * columns * rows and _has_room(lattice.places, lattice.xy, gray.shape)
    return Sign("chessboard", max(columns, rows), min(columns, rows), is_whole)


def _has_room(places: Ints, xy: Array, shape: tuple[int, ...]) -> bool:
    """Whether the places around a grid are in the picture, so that it would have been seen to go on."""
    at = {(int(c), int(r)): pixel for (c, r), pixel in zip(places, xy, strict=True)}
    columns, rows = places.max(0)
    inside = []
    for c in range(columns + 1):
        for edge, before in ((0, 1), (rows, rows - 1)):
            if (c, edge) in at and (c, before) in at:
                inside.append(at[c, edge] + _BEYOND * (at[c, edge] - at[c, before]))
    for r in range(rows + 1):
        for edge, before in ((0, 1), (columns, columns - 1)):
            if (edge, r) in at and (before, r) in at:
                inside.append(at[edge, r] + _BEYOND * (at[edge, r] - at[before, r]))
    if not inside:
        return False
    beyond = np.array(inside)
    return bool(((beyond > 0) & (beyond < np.array(shape[::-1]))).all(1).mean() > _WHOLE)


def _circles(gray: Pixels) -> Sign | None:
    lattice = find_circle_lattice(gray, _EVERY_CIRCLE)
    if lattice is None:
        return None
    span = lattice.places.max(0) + 1
    # a grid whose rows are shifted by half a step is one of diagonals
    along = np.stack([lattice.places.sum(1), lattice.places[:, 1] - lattice.places[:, 0]], 1)
    along -= along.min(0)
    tilted = along.max(0) + 1
    num = len(lattice.xy)
    straight_fill, tilted_fill = num / float(np.prod(span)), 2.0 * num / float(np.prod(tilted))
    if straight_fill >= tilted_fill:
        is_whole = straight_fill > _WHOLE and _has_room(lattice.places, lattice.xy, gray.shape)
        return Sign("circles", int(span.max()), int(span.min()), is_whole)
    return _staggered(lattice.places, lattice.xy, along, gray.shape)


def _staggered(places: Ints, xy: Array, along: Ints, shape: tuple[int, ...]) -> Sign | None:
    """An asymmetric grid, rows of which are either way: the one that has as many circles in every row."""
    extent = along.max(0) + 1
    for across in (0, 1):
        rows = int(extent[across])
        columns = round(len(places) / rows)
        if columns < 2 or rows < 2:
            continue
        board = Board("acircles", columns, rows, 1.0)
        found = place_on(CircleLattice(places, xy), grid_of(board))
        if found is not None and len(found[0]) == len(board.points) == len(places):
            return Sign("acircles", columns, rows, _has_room(along, xy, shape))
    return Sign("acircles", int(extent.max()), int(extent.min()), False)


def _of_grids(pictures: Sequence[PictureSigns]) -> BoardGuess | None:
    signs = [one.sign for one in pictures if one.sign is not None]
    counts = Counter((sign.kind, sign.columns, sign.rows) for sign in signs if sign.is_whole)
    if not counts:
        # no board is seen with room all around: a grid that comes again
        counts = Counter((sign.kind, sign.columns, sign.rows) for sign in signs)
        counts = Counter({key: count for key, count in counts.items() if count > 1})
    if not counts:
        return None
    # whoever shows more speaks against a size, whoever shows less does not

    def score(key: tuple[Kind, int, int]) -> tuple[int, int]:
        larger = sum(not _may_be_part(sign, *key) for sign in signs)
        return counts[key] - larger, key[1] * key[2]

    kind, columns, rows = max(counts, key=score)
    agree = part = other = 0
    different: Counter[str] = Counter()
    for sign in signs:
        if (sign.kind, sign.columns, sign.rows) == (kind, columns, rows):
            agree += 1
        elif _may_be_part(sign, kind, columns, rows):
            part += 1
        else:
            other += 1
            different[f"{sign.kind} {sign.columns}x{sign.rows}"] += 1
    notes = [f"{count} show {text}" for text, count in different.most_common(3)]
    board = Board(kind, columns, rows, 1.0, unit=UNIT)
    return BoardGuess(board, agree, part, other, len(pictures) - len(signs), tuple(notes))


def _may_be_part(sign: Sign, kind: Kind, columns: int, rows: int) -> bool:
    """Whether a photograph may show a board of a size, or a part of it."""
    if (sign.kind, sign.columns, sign.rows) == (kind, columns, rows):
        return True
    if sign.kind != kind or sign.is_whole:
        return False
    # the rows of an asymmetric grid that is cut may be taken for others
    return sign.kind == "acircles" or (sign.columns <= columns and sign.rows <= min(rows, columns))
