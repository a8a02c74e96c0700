"""Points of a board in a photograph.

What a board looks like is found in a picture that is reduced to what that takes; where its points are is measured in
the picture itself. A board may be half out of the picture: markers say which points are there, and of a chessboard any
part is as good a plane as the whole, so that it is numbered from wherever it fits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.bent_edges import CrossingWindow
from sfmapp.calibration.boards import Board
from sfmapp.calibration.circle_centers import DiskMarks
from sfmapp.calibration.circles import disk_bias, find_circle_lattice, grid_of, place_on
from sfmapp.calibration.lattice import Lattice, field_contrast, find_lattice
from sfmapp.calibration.markers import dictionary_of
from sfmapp.calibration.symmetry import symmetric_points
from sfmapp.geometry.dlt import find_homography, homogeneous

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Pixels = NDArray[np.uint8]

# longer side of the picture in which boards are looked for
_REDUCED_PX = 1600
# half of the window in which a crossing is measured, at most: beyond, the bend of the lens counts, and nothing is
# gained
_WINDOW_PX = 16.0
# a measured point that is further than this from where its neighbours have it is none, in fields
_STRAY = 0.25
# beside markers there are other crossings, of their cells, a tenth of a field away and more
_STRAY_BESIDE_MARKERS = 0.08
_NEIGHBORS = 9
# so many around a point tell where it is, by a quadratic from so many on; the noise of a point is at least so much
_AROUND, _QUADRATIC, _NOISE_PX = 14, 9, 0.1
# wrong points are left out one neighbourhood at a time
_ROUNDS = 12
# of a marker's side: OpenCV's patterns and Kalibr's
_TAG_BORDERS = (2, 1)
# points beside markers that cannot be read go on from those that can, so many times; and by how much of the contrast
# the light fields at one must be lighter than the dark ones
_UNREAD_ROUNDS, _FOUR_FIELDS = 2, 0.4
# of the gap between tags: how far the corner of a tag is from where it was read or expected
_TAG_MOVES = 0.3
# what takes back the blur of a picture: sigma in pixels of what is subtracted, and how much of it
_UNSHARP = (4.0, 3.0)
# how far around a circle is its own, in steps of the board: not quite half of the way to the next; and grey values that
# tell a disk from its ground
_ROOM = {"circles": 0.47, "acircles": 0.66}
_FAINT = 8.0
# of that room, what a disk takes at most
_DISK = 0.75
# fewer blobs in rows are found in noise
_LEAST_CIRCLES = 12


@dataclass(frozen=True)
class Detection:
    """Points of a board in a photograph.

    Attributes:
        idx: (N,) int64, which of the board's points; without doubles.
        xy: (N, 2) pixels, centres at halves.
        sharpness_px: width over which edges blur, pixels of the photograph; NaN where it was not measured.
        problem: why there are none; None where there are.
        disks: what ``xy`` of circles is from.
    """

    idx: Ints
    xy: Array
    sharpness_px: float = float("nan")
    problem: str | None = None
    disks: DiskMarks | None = None


def detect_board(gray: Pixels, board: Board) -> Detection:
    """Find a board.

    Args:
        gray: (H, W).

    Returns:
        The points that were found, or why there are none.
    """
    import cv2

    cv2.setNumThreads(1)
    scale = max(1.0, max(gray.shape) / _REDUCED_PX)
    small = gray
    if scale > 1.0:
        size = (round(gray.shape[1] / scale), round(gray.shape[0] / scale))
        small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    find = {"chessboard": _chessboard, "charuco": _charuco, "aprilgrid": _april_grid}.get(board.kind, _circles)
    idx, xy = find(np.ascontiguousarray(small), board)
    if len(idx) < 4:
        return Detection(np.zeros(0, np.int64), np.zeros((0, 2)), problem=_nothing(board))
    xy = (xy + 0.5) * [gray.shape[1] / small.shape[1], gray.shape[0] / small.shape[0]] - 0.5
    disks = None
    if board.kind in ("circles", "acircles"):
        xy, disks = _disk_centers(gray, board, idx, xy)
    elif board.tells_part:
        idx, xy = _crossings_beside_markers(gray, board, idx, xy)
    else:
        xy = _crossings(gray, board, idx, xy)
    is_good = np.isfinite(xy).all(1) & _fits_neighbors(board, idx, xy)
    idx, xy = idx[is_good], xy[is_good]
    least = _LEAST_CIRCLES if board.kind in ("circles", "acircles") else 6
    if len(idx) < min(least, len(board.points)) or np.ptp(board.points[idx, :2], axis=0).min() == 0.0:
        return Detection(np.zeros(0, np.int64), np.zeros((0, 2)), problem=_nothing(board))
    disks = None if disks is None else DiskMarks(disks.mass[is_good], disks.area[is_good])
    return Detection(idx, xy + 0.5, _edge_width(gray, board, idx, xy), disks=disks)


def _nothing(board: Board) -> str:
    what = {"chessboard": "corners of a chessboard", "charuco": "markers", "aprilgrid": "tags"}.get(
        board.kind, f"a grid of {board.columns}x{board.rows} circles"
    )
    return f"no {what} were found"


# ------------------------------------------------------------------------------------------------------- chessboards


def _chessboard(gray: Pixels, board: Board) -> tuple[Ints, Array]:
    wanted = board.columns * board.rows
    lattice = find_lattice(gray, wanted)
    found = None if lattice is None else _placed(lattice, board)
    if found is not None and len(found[0]) == wanted:
        return found
    whole = _opencvs_chessboard(gray, board)
    if whole is not None:
        return np.arange(wanted), whole
    return (np.zeros(0, np.int64), np.zeros((0, 2))) if found is None else found


def _opencvs_chessboard(gray: Pixels, board: Board) -> Array | None:
    """(N, 2) the corners of a whole chessboard as OpenCV's finders see it."""
    import cv2

    size = (board.columns, board.rows)
    if min(size) < 3:
        return None
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_FAST_CHECK
    is_found, corners = cv2.findChessboardCornersSB(gray, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not is_found:
        is_found, corners = cv2.findChessboardCorners(gray, size, flags=flags)
    if not is_found:
        return None
    xy = corners.reshape(-1, 2).astype(np.float64)
    if _is_mirrored(board, np.arange(len(xy)), xy):
        xy = xy.reshape(board.rows, board.columns, 2)[:, ::-1].reshape(-1, 2)
    return np.ascontiguousarray(xy)


def _is_mirrored(board: Board, idx: Ints, xy: Array) -> bool:
    ones = np.ones((len(idx), 1))
    affine = np.linalg.lstsq(np.concatenate([board.points[idx, :2], ones], 1), xy, rcond=None)[0]
    return bool(np.linalg.det(affine[:2]) < 0)


def _placed(lattice: Lattice, board: Board) -> tuple[Ints, Array] | None:
    """The corners of a board that a grid may be, turned by quarters until it fits; the first corner has a dark field
    at its upper left where that tells the two ends of a board apart."""
    columns, rows = (int(side) + 1 for side in lattice.places.max(0))
    best: tuple[Ints, Array] | None = None
    best_score = (0, -np.inf, -1)
    strength = np.log(lattice.strength)
    for turn in range(4):
        c, r = lattice.places.T
        sense = lattice.sense * (-1 if turn % 2 else 1)
        size = (columns, rows) if turn % 2 == 0 else (rows, columns)
        c, r = ((c, r), (r, columns - 1 - c), (columns - 1 - c, rows - 1 - r), (rows - 1 - r, c))[turn]
        # a grid that is larger than the board has caught the outer edge, where a light margin makes weaker crossings
        for left in range(max(1, size[0] - board.columns + 1)):
            for top in range(max(1, size[1] - board.rows + 1)):
                is_on = (left <= c) & (c < left + board.columns) & (top <= r) & (r < top + board.rows)
                parity = (sense * (1 - 2 * ((c - left + r - top) % 2)))[is_on].sum()
                score = (int(is_on.sum()), round(float(strength[is_on].sum()), 3), int(parity > 0))
                if score > best_score:
                    idx = ((r - top) * board.columns + (c - left))[is_on]
                    best, best_score = (idx.astype(np.int64), lattice.xy[is_on]), score
    return best


# ------------------------------------------------------------------------------------------------------------ markers


def _markers(gray: Pixels, dictionary: str, border: int, num: int) -> dict[int, Array]:
    """(4, 2) corners of each of the first ``num`` markers that is seen, clockwise from its own top left. Where some are
    missing they are looked for once more with the blur taken back."""
    found = _markers_of_one(gray, dictionary, border, is_sharpened=False)
    if sum(number < num for number in found) < num:
        found = _markers_of_one(_sharpened(gray), dictionary, border, is_sharpened=True) | found
    return {number: quad for number, quad in found.items() if number < num}


def _sharpened(gray: Pixels) -> Pixels:
    import cv2

    values = gray.astype(np.float32)
    sharp = values + _UNSHARP[1] * (values - cv2.GaussianBlur(values, (0, 0), _UNSHARP[0]))
    found: Pixels = np.clip(sharp, 0.0, 255.0).astype(np.uint8)
    return found


def _markers_of_one(gray: Pixels, dictionary: str, border: int, *, is_sharpened: bool) -> dict[int, Array]:
    import cv2

    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border
    if is_sharpened:
        # corners are round, and cells run into each other
        parameters.polygonalApproxAccuracyRate = 0.06
        parameters.perspectiveRemovePixelPerCell = 8
        parameters.perspectiveRemoveIgnoredMarginPerCell = 0.3
    parameters.minMarkerPerimeterRate = 0.015
    parameters.adaptiveThreshWinSizeMax = 53
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary_of(dictionary), parameters).detectMarkers(gray)
    if ids is None:
        return {}
    found: dict[int, Array] = {}
    doubles = set()
    for number, quad in zip(ids.ravel().tolist(), corners, strict=True):
        if number in found:
            doubles.add(number)
        found[number] = quad.reshape(4, 2).astype(np.float64)
    return {number: quad for number, quad in found.items() if number not in doubles}


def _charuco(gray: Pixels, board: Board) -> tuple[Ints, Array]:
    """Corners of squares, where the markers around have them."""
    num = (board.columns * board.rows + 1) // 2
    found = _markers(gray, board.dictionary, 1, num)
    layouts = []
    # OpenCV's boards begin with a dark square; those of before 4.6 with a light one where rows are even
    for first in range(2 - board.rows % 2):
        places = [(c, r) for r in range(board.rows) for c in range(board.columns) if (r + c + first) % 2 == 1]
        known = [number for number in found if number < len(places)]
        if not known:
            continue
        gap = 0.5 * (board.spacing - board.marker)
        corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * board.marker + gap
        source = np.concatenate([np.array(places[n]) * board.spacing + corners for n in known])
        target = np.concatenate([found[n] for n in known])
        layouts.append(_predicted(source, target, board))
    if not layouts:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    # where columns are odd, the other layout is the same one column aside but for a marker in every other row, and the
    # typical error tells nothing: points disagree beside those markers, and beyond the border no four fields meet
    limit = 3.0 * min(float(np.median(errors)) if len(errors) else np.inf for _, _, errors in layouts) + 0.5

    def score(layout: tuple[Ints, Array, Array]) -> tuple[int, int]:
        idx, xy, errors = layout
        return -int((errors > limit).sum()), int(_have_four_fields(gray, board, idx, xy, xy).sum())

    idx, xy, _ = max(layouts, key=score)
    return idx, xy


def _predicted(source: Array, target: Array, board: Board, reach: float = 1.01) -> tuple[Ints, Array, Array]:
    """Where points of a board are by the corners of markers beside them, and how well those fit each other, pixels.
    ``reach``: how far these may be, in sides of a square or tag."""
    idx, xy, errors = [], [], []
    for i, point in enumerate(board.points[:, :2]):
        distance = np.abs(source - point).max(1)
        near = np.flatnonzero(distance < reach * board.spacing)
        if len(near) < 4:
            continue
        if len(near) < 8:  # one marker beside it: more from further away keep the plane from tipping
            near = np.flatnonzero(distance < 2.01 * board.spacing)
        h = find_homography(source[near], target[near])
        mapped = np.concatenate([source[near], np.ones((len(near), 1))], 1) @ h.T
        at = h @ [*point, 1.0]
        # a plane through corners that are none, of a misread marker, may be seen from its edge
        if not np.isfinite(mapped).all() or (mapped[:, 2] * at[2] <= 0.0).any():
            continue
        errors.append(np.sqrt(((mapped[:, :2] / mapped[:, 2:] - target[near]) ** 2).sum(1).mean()))
        idx.append(i)
        xy.append(at[:2] / at[2])
    return np.array(idx, np.int64), np.array(xy).reshape(-1, 2), np.array(errors)


def _april_grid(gray: Pixels, board: Board) -> tuple[Ints, Array]:
    """Corners of tags. Their numbers say where they are; which corner is the first depends on the program that drew
    them, and is told from the grid."""
    num = board.columns * board.rows
    found: dict[int, Array] = {}
    for border in _TAG_BORDERS:
        tags = _markers(gray, board.dictionary, border, num)
        if len(tags) > len(found):
            found = tags
    if len(found) < 2:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    best: tuple[Ints, Array] = (np.zeros(0, np.int64), np.zeros((0, 2)))
    best_error = np.inf
    for turn in range(4):
        idx, xy = [], []
        for number, quad in found.items():
            row, column = board.rows - 1 - number // board.columns, number % board.columns
            first = 4 * (row * board.columns + column)
            idx += [first + k for k in range(4)]
            xy += list(np.roll(quad, turn, axis=0))
        source, target = board.points[idx, :2], np.array(xy)
        h = find_homography(source, target)
        mapped = np.concatenate([source, np.ones((len(idx), 1))], 1) @ h.T
        error = float(np.median(np.hypot(*(mapped[:, :2] / mapped[:, 2:] - target).T)))
        if error < best_error:
            best, best_error = (np.array(idx, np.int64), target), error
    return best


# ------------------------------------------------------------------------------------------------------------- circles


def _circles(gray: Pixels, board: Board) -> tuple[Ints, Array]:
    lattice = find_circle_lattice(gray, len(board.points))
    found = None if lattice is None else place_on(lattice, grid_of(board))
    if found is None or len(found[0]) < len(board.points):
        whole = _opencvs_circles(gray, board)
        if whole is not None:
            return np.arange(len(whole)), whole
    return (np.zeros(0, np.int64), np.zeros((0, 2))) if found is None else found


def _opencvs_circles(gray: Pixels, board: Board) -> Array | None:
    """(N, 2) the centres of a whole grid as OpenCV's finder sees it."""
    import cv2

    size = (board.columns, board.rows)
    flags = cv2.CALIB_CB_SYMMETRIC_GRID if board.kind == "circles" else cv2.CALIB_CB_ASYMMETRIC_GRID
    parameters = cv2.SimpleBlobDetector_Params()
    # as large as circles get where few fill the picture
    parameters.maxArea = 0.05 * gray.size
    parameters.minArea = 12.0
    parameters.minDistBetweenBlobs = 4.0
    for more in (0, cv2.CALIB_CB_CLUSTERING):
        for picture in (gray, 255 - gray):  # dark on light, or light on dark
            detector = cv2.SimpleBlobDetector_create(parameters)
            is_found, centers = cv2.findCirclesGrid(picture, size, flags=flags | more, blobDetector=detector)
            if is_found:
                xy = centers.reshape(-1, 2).astype(np.float64)
                if not _is_mirrored(board, np.arange(len(xy)), xy):
                    return np.ascontiguousarray(xy)
                if board.kind == "acircles":  # the shift of every other row tells left from right
                    return None
                return np.ascontiguousarray(xy.reshape(board.rows, board.columns, 2)[:, ::-1].reshape(-1, 2))
    return None


def _disk_centers(gray: Pixels, board: Board, idx: Ints, xy: Array) -> tuple[Array, DiskMarks]:
    """Images of the centres of the disks near pixels (N, 2): their centres of mass, less what perspective and lens move
    these by as far as the points tell; and what was measured, for when the camera is known."""
    axes = _axes(board, idx, xy)
    found, area = np.full_like(xy, np.nan), np.full(len(xy), np.nan)
    for i in range(len(xy)):
        at = xy[i]
        for _ in range(3):
            mass = _mass(gray, at, axes[i], _ROOM[board.kind])
            if mass is None:
                break
            at, area[i] = mass
            found[i] = at
    marks = DiskMarks(found + 0.5, area)
    is_found = np.isfinite(found).all(1)
    if is_found.sum() >= 6:
        plane = board.points[idx[is_found], :2] / board.spacing
        determinants = np.abs(np.linalg.det(_axes(board, idx[is_found], found[is_found])))
        radius = np.sqrt(np.median(area[is_found] / determinants) / np.pi)
        found[is_found] -= disk_bias(plane, found[is_found], float(radius))
    return found, marks


def _mass(gray: Pixels, at: Array, axes: Array, room: float) -> tuple[Array, float] | None:
    """Centre of mass of the disk near a pixel and its area, pixels, each pixel weighted by how far it is from the
    ground around; None where it is cut by the border or nothing stands out.

    Args:
        axes: (2, 2) pixels along the board's sides, rows. room: how far the nearest neighbour leaves it, in steps.
    """
    reach = room * np.sqrt((axes**2).sum(0))
    low, high = np.ceil(at - reach).astype(int), np.floor(at + reach).astype(int)
    size = np.array(gray.shape[::-1])
    # the ring around may be cut by the border, the disk may not
    if (at - _DISK * reach < 0).any() or (at + _DISK * reach > size - 1).any() or (high - low).min() < 2:
        return None
    low, high = np.maximum(low, 0), np.minimum(high, size - 1)
    values = gray[low[1] : high[1] + 1, low[0] : high[0] + 1].astype(np.float64)
    x, y = np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1)
    on_board = np.stack(np.meshgrid(x - at[0], y - at[1]), -1) @ np.linalg.inv(axes)
    away = np.hypot(on_board[..., 0], on_board[..., 1]) / room
    ring, middle = values[(away > 0.85) & (away < 1.0)], values[away < 0.25]
    if not len(ring) or not len(middle):
        return None
    ground, disk = float(np.median(ring)), float(np.median(middle))
    if abs(disk - ground) < _FAINT:
        return None
    weight = np.where(away < 1.0, np.clip(((values - ground) / (disk - ground) - 0.15) / 0.7, 0.0, 1.0), 0.0)
    total = float(weight.sum())
    found = np.array([(weight.sum(0) * x).sum(), (weight.sum(1) * y).sum()]) / total
    return found, total


# --------------------------------------------------------------------------------------------------------- measurement


def _axes(board: Board, idx: Ints, xy: Array) -> Array:
    """(N, 2, 2) pixels along a field's two sides at each point, by the points nearest to it."""
    plane = board.points[idx, :2] / board.spacing
    distances = ((plane[:, None] - plane[None]) ** 2).sum(2)
    near = np.argsort(distances, axis=1, kind="stable")[:, :_NEIGHBORS]
    source = plane[near] - plane[:, None]
    target = xy[near] - xy[:, None]
    square = np.einsum("nka,nkb->nab", source, source) + 1e-9 * np.eye(2)
    found: Array = np.linalg.solve(square, np.einsum("nka,nkb->nab", source, target))
    return found


def _reach(board: Board) -> Array:
    """(2,) how far the window goes along the edges and how far from the nearer of them, in fields, so that it sees
    nothing but the four fields that meet."""
    if board.kind == "charuco":
        return np.array([0.45, 0.45 * (1.0 - board.marker / board.spacing)])
    if board.kind == "aprilgrid":
        return np.array([0.9 * board.marker, 0.1])
    return np.array([0.45, 0.45])


def window_of(board: Board) -> CrossingWindow | None:
    """The window in which crossings are measured; None for boards of circles."""
    if board.kind in ("circles", "acircles"):
        return None
    return CrossingWindow(board.spacing, _reach(board), _WINDOW_PX)


def _crossings(gray: Pixels, board: Board, idx: Ints, xy: Array) -> Array:
    """Crossings near pixels (N, 2): first in a window as wide as the picture was reduced by, then once more from
    there."""
    found = np.ascontiguousarray(xy)
    for _ in range(2):
        is_known = np.isfinite(found).all(1)
        axes = np.full((len(found), 2, 2), np.nan)
        if is_known.sum() < 4:
            return found
        axes[is_known] = _axes(board, idx[is_known], found[is_known])
        out = np.full_like(found, np.nan)
        kept = np.empty((int(is_known.sum()), 2))
        straight = np.zeros((len(kept), 3, 2))
        symmetric_points(gray, found[is_known], axes[is_known], straight, _reach(board), _WINDOW_PX, kept)
        out[is_known] = kept
        found = out
    return found


def _crossings_beside_markers(gray: Pixels, board: Board, idx: Ints, xy: Array) -> tuple[Ints, Array]:
    """Crossings of boards with markers. Beside them there are corners of markers and cells, where three fields are
    light: what is no crossing of four is left out, and looked for where those that are have it, together with what
    markers that could not be read have left open."""
    found = _crossings(gray, board, idx, xy)
    is_good = _have_four_fields(gray, board, idx, xy, found)
    idx, found = idx[is_good], found[is_good]
    for _ in range(_UNREAD_ROUNDS):
        if len(idx) < 6:
            break
        more, at, _ = _predicted(board.points[idx, :2], found, board, 2.01)
        is_new = ~np.isin(more, idx)
        if not is_new.any():
            break
        both, begin = np.concatenate([idx, more[is_new]]), np.concatenate([found, at[is_new]])
        measured = _crossings(gray, board, both, begin)
        measured[: len(idx)] = found
        is_good = _have_four_fields(gray, board, both, begin, measured)
        is_good[: len(idx)] = True
        if is_good.sum() == len(idx):
            break
        idx, found = both[is_good], measured[is_good]
    order = np.argsort(idx, kind="stable")
    return idx[order], found[order]


def _have_four_fields(gray: Pixels, board: Board, idx: Ints, begin: Array, xy: Array) -> NDArray[np.bool_]:
    """(N,) bool: near where a point was expected, dark and light meet in turn."""
    known = np.isfinite(xy).all(1)
    found = np.zeros(len(xy), np.bool_)
    if known.sum() < 4:
        return found
    axes = _axes(board, idx[known], xy[known])
    gap = board.marker if board.kind == "aprilgrid" else 0.5 * (1.0 - board.marker / board.spacing)
    for i, axis in zip(np.flatnonzero(known), axes, strict=True):
        share = 0.4 * gap
        reach = share * np.abs(axis).sum(0) + 1.0
        is_inside = (xy[i] > reach).all() and (xy[i] < np.array(gray.shape[::-1]) - 1.0 - reach).all()
        is_near = board.kind == "charuco" or (
            np.hypot(*(xy[i] - begin[i])) < _TAG_MOVES * gap * np.linalg.norm(axis, axis=1).min() + 1.0
        )
        found[i] = is_inside and is_near and field_contrast(gray, xy[i], axis[0], axis[1], share) > _FOUR_FIELDS
    return found


def _fits_neighbors(board: Board, idx: Ints, xy: Array) -> NDArray[np.bool_]:
    """(N,) bool: a point is where those around it have it, a part of a field either way.

    A wrong point puts its neighbours in the wrong as well, but less than itself: so the worst of each neighbourhood
    goes first, and the rest is looked at again without it.
    """
    is_good: NDArray[np.bool_] = np.asarray(np.isfinite(xy).all(1))
    stray = _STRAY_BESIDE_MARKERS if board.tells_part else _STRAY
    for _ in range(_ROUNDS):
        where = np.flatnonzero(is_good)
        if len(where) < 6:
            break
        plane, pixels = board.points[idx[where], :2] / board.spacing, xy[where]
        off, near = _off_neighbors(plane, pixels)
        off /= np.maximum(stray * np.linalg.norm(_axes(board, idx[where], pixels), axis=2).min(1), 1.5)
        is_worst = (off > 1.0) & (off >= off[near].max(1))
        if not is_worst.any():
            break
        is_good[where[is_worst]] = False
    return is_good


def _off_neighbors(plane: Array, pixels: Array) -> tuple[Array, Ints]:
    """(N,) how far points are from where those around have them, pixels; and (N, K) which these are. What a homography
    through all leaves is smooth, whatever the lens: it is a quadratic through the neighbours, those that fit it worst
    weighing less."""
    mapped = homogeneous(plane) @ find_homography(plane, pixels).T
    left = pixels - mapped[:, :2] / mapped[:, 2:]
    near = np.argsort(((plane[:, None] - plane[None]) ** 2).sum(2), axis=1, kind="stable")[:, 1 : _AROUND + 1]
    x, y = np.moveaxis(plane[near] - plane[:, None], 2, 0)
    terms = [np.ones_like(x), x, y, x * x, x * y, y * y]
    design = np.stack(terms if near.shape[1] >= _QUADRATIC else terms[:3], -1)
    weight = np.ones(near.shape)
    for _ in range(2):
        square = np.einsum("nk,nka,nkb->nab", weight, design, design)
        # neighbours on one or two lines leave some of it open
        square += 1e-6 * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(design.shape[2])
        found = np.linalg.solve(square, np.einsum("nk,nka,nki->nai", weight, design, left[near]))
        residual = np.linalg.norm(left[near] - design @ found, axis=2)
        scale = np.median(residual, axis=1, keepdims=True) + _NOISE_PX
        weight = 1.0 / (1.0 + (residual / scale) ** 2)
    return np.linalg.norm(left - found[:, 0], axis=1), near


def _edge_width(gray: Pixels, board: Board, idx: Ints, xy: Array) -> float:
    """Median width over which the brightness changes from dark to light across the edges at the points, pixels: the
    difference of both over the steepest slope."""
    axes = _axes(board, idx, xy)
    widths = []
    for at, axis in zip(xy, axes, strict=True):
        reach = min(_WINDOW_PX, 0.4 * float(np.linalg.norm(axis, axis=1).min()))
        left, top = (round(value - reach) for value in at)
        side = int(2 * reach) + 1
        patch = gray[max(top, 0) : top + side, max(left, 0) : left + side].astype(np.float64)
        if min(patch.shape) < 4:
            continue
        dy, dx = np.gradient(patch)
        slope = np.percentile(np.hypot(dx, dy), 99.0)
        if slope > 0:
            widths.append(float((np.percentile(patch, 95.0) - np.percentile(patch, 5.0)) / slope))
    return float(np.median(widths)) if widths else float("nan")
