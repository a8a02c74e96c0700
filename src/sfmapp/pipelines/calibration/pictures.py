"""Photographs or frames of a board, and what was found in each."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.board_guess import BoardGuess, PictureSigns, guess_board, signs_of
from sfmapp.calibration.boards import Board
from sfmapp.calibration.detection import Detection, detect_board
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.geometry.dlt import find_homography
from sfmapp.images.folder import load_images
from sfmapp.images.image_set import ImageRecord
from sfmapp.images.pixels import read_gray
from sfmapp.images.sequence import Frame, SequenceOptions
from sfmapp.images.video import is_video, sharpness
from sfmapp.sequences.open import open_sequence
from sfmapp.workspace.job import Job

Pixels = NDArray[np.uint8]
P = TypeVar("P")

STAGE = "detection"
# of a video: of so many pieces the sharpest frame is looked into, and so many of these are kept
_PIECES, _KEPT = 120, 30
# of photographs, to guess the board: so many, and more up to so many as long as it is not sure
_LOOKED_INTO = (0, 6, 12, 24, 48)
# frames are alike whose boards are nearer than this share of the picture's diagonal, all corners together
_ALIKE = 0.04
# a frame whose edges are this many times as wide as the sharpest tenth's is blurred
_BLURRED = 2.0


@dataclass(frozen=True)
class BoardPicture:
    """A photograph or frame.

    Attributes:
        name: of the file, or number of the frame.
        detection: what was found.
        unused: why it is left aside; None for one that counts.
        picked: why a frame of a video was taken.
        like: name of a frame that was taken and shows the same, where that is why it is left aside.
        path: of a photograph; None of a frame.
        read: its grey values (H, W) once more; None of what does not count.
    """

    name: str
    detection: Detection
    unused: str | None = None
    picked: str | None = None
    like: str | None = None
    path: Path | None = None
    read: Callable[[], Pixels] | None = None


@dataclass(frozen=True)
class BoardPictures:
    """All that were looked into.

    Attributes:
        board: that they show; guess: how it was told, None where it was given.
        size: width and height of those that count, as stored.
        pictures: in their order.
        digests: of the files, by name.
    """

    board: Board
    guess: BoardGuess | None
    size: tuple[int, int]
    pictures: tuple[BoardPicture, ...]
    digests: dict[str, str]

    @property
    def used(self) -> list[BoardPicture]:
        return [picture for picture in self.pictures if picture.unused is None]


def look_at_pictures(job: Job, board: Board | None) -> BoardPictures:
    """Find the board in the photographs, or in frames of the video, that the job's source is. ``board``: None: the one
    that several of them agree on.

    Raises:
        InputError: nothing can be read, or photographs agree on no board.
    """
    return _look_at_video(job, board) if is_video(job.source) else _look_at_photographs(job, board)


def _look_at_photographs(job: Job, given: Board | None) -> BoardPictures:
    images, _ = load_images(job.source, job.options.images, job.events, threads=job.threads)
    if not images.images:
        raise InputError(f"{job.source}: expected photographs of the board, found none that can be read")
    counts = Counter((record.width, record.height) for record in images.images)
    size = counts.most_common(1)[0][0]
    guess = None
    if given is None:
        alike = [record for record in images.images if (record.width, record.height) == size]
        guess = _guessed(job, alike, lambda record: read_gray(record))
    board = given if guess is None else guess.board
    assert board is not None

    def look(record: ImageRecord) -> BoardPicture:
        if (record.width, record.height) != size:
            turned = ", it was turned by a program" if (record.height, record.width) == size else ""
            other = f"it has {record.width}x{record.height} pixels, most have {size[0]}x{size[1]}{turned}"
            return BoardPicture(record.name, _nothing(other), other, path=record.path)
        try:
            found = detect_board(read_gray(record), board)
        except InputError as error:
            return BoardPicture(record.name, _nothing(str(error)), str(error), path=record.path)
        return BoardPicture(record.name, found, found.problem, path=record.path, read=partial(read_gray, record))

    pictures = _in_threads(look, images.images, job.threads, job.events)
    return BoardPictures(board, guess, size, tuple(pictures), {record.name: record.digest for record in images.images})


def _guessed(job: Job, pictures: Sequence[P], gray_of: Callable[[P], Pixels]) -> BoardGuess:
    """The board that some of the pictures agree on: a few spread over all of them, more where these are not sure."""
    order = sorted(range(len(pictures)), key=lambda n: (_van_der_corput(n), n))

    def look(n: int) -> PictureSigns | None:
        job.events.raise_if_cancelled()
        try:
            return signs_of(gray_of(pictures[n]))
        except InputError:
            return None  # what cannot be read is told where the board is looked for

    signs: list[PictureSigns] = []
    guess, failed = None, None
    with ThreadPoolExecutor(job.threads) as pool:
        for first, last in itertools.pairwise(_LOOKED_INTO):
            signs += [one for one in pool.map(look, order[first:last]) if one is not None]
            try:
                guess = guess_board(signs, job.source)
            except InputError as error:
                guess, failed = None, error
            if (guess is not None and guess.is_sure) or last >= len(pictures):
                break
    if guess is None:
        assert failed is not None
        raise failed
    text = f"the board is {guess.text}; lengths are in {guess.board.unit}"
    job.events.decided(STAGE, text)
    if not guess.is_sure:
        job.events.warned(STAGE, f"not sure: {text}; say what the board is by --board if it is another")
    for note in guess.notes:
        job.events.warned(STAGE, note)
    return guess


def _van_der_corput(n: int) -> float:
    """The numbers from 0 on in an order whose beginnings are spread over all of them (base 2)."""
    value, share = 0.0, 0.5
    while n:
        value, share, n = value + share * (n & 1), 0.5 * share, n >> 1
    return value


def _nothing(problem: str) -> Detection:
    return Detection(np.zeros(0, np.int64), np.zeros((0, 2)), problem=problem)


def _in_threads(
    look: Callable[[ImageRecord], BoardPicture], records: Sequence[ImageRecord], threads: int, events: Events
) -> list[BoardPicture]:
    events.started(STAGE, f"{len(records)} photographs", total=len(records))

    def one(record: ImageRecord) -> BoardPicture:
        events.raise_if_cancelled()
        found = look(record)
        events.advanced(STAGE)
        return found

    pool = ThreadPoolExecutor(threads)
    try:
        found = list(pool.map(one, records))
    finally:
        pool.shutdown(cancel_futures=True)
    num = sum(picture.unused is None for picture in found)
    events.finished(STAGE, f"the board was found in {num} of {len(found)} photographs")
    return found


# -------------------------------------------------------------------------------------------------------------- videos


def _look_at_video(job: Job, given: Board | None) -> BoardPictures:
    """The sharpest frame of each piece of a video, and of those with a board some that differ."""
    # a calibration that lies beside it is what the film is to replace, or belongs to another camera
    sequence = open_sequence(
        job.source, SequenceOptions(mono=True), job.events, require_camera=False, look_beside=False
    )
    total = sequence.num_frames
    length = max(1, -(-total // _PIECES)) if total else 15
    job.events.started(STAGE, "frames of the video", total=total)
    sharpest: list[Frame] = []
    best = -1.0
    piece = -1
    for frame in sequence.frames():
        job.events.advanced(STAGE)
        score = sharpness(frame.images[0])
        if frame.idx // length != piece:
            piece, best = frame.idx // length, -1.0
            sharpest.append(frame)
        if score > best:
            best, sharpest[-1] = score, frame
    if not sharpest:
        raise InputError(f"{job.source}: expected a video of the board, found no frame that can be read")
    size = sharpest[0].images[0].shape[::-1]
    guess = _guessed(job, sharpest, lambda frame: frame.images[0]) if given is None else None
    board = given if guess is None else guess.board
    assert board is not None
    with ThreadPoolExecutor(job.threads) as pool:
        found = list(pool.map(lambda frame: detect_board(frame.images[0], board), sharpest))
    pictures = [BoardPicture(frame.name, one, one.problem) for frame, one in zip(sharpest, found, strict=True)]
    chosen = [
        replace(one, read=partial(_gray_of, frame)) if one.unused is None else one
        for one, frame in zip(choose_frames(pictures, (int(size[0]), int(size[1])), board), sharpest, strict=True)
    ]
    num = sum(picture.unused is None for picture in chosen)
    job.events.finished(STAGE, f"{num} frames were picked of {len(chosen)} that were looked into")
    return BoardPictures(board, guess, (int(size[0]), int(size[1])), tuple(chosen), {})


def _gray_of(frame: Frame) -> Pixels:
    return frame.images[0]


def choose_frames(pictures: Sequence[BoardPicture], size: tuple[int, int], board: Board) -> list[BoardPicture]:
    """The same pictures, each with the reason why it was picked or does not count: it is blurred, or shows what another
    shows.

    Frames are taken one after another, each as far as can be from all that were taken: by where the corners of the
    whole board are, so that place, distance and tilt all count.
    """
    where = {i: _outline(picture.detection, board) for i, picture in enumerate(pictures) if picture.unused is None}
    widths = np.array([picture.detection.sharpness_px for picture in pictures])
    reasons: dict[int, str] = {}
    like: dict[int, str] = {}
    if where:
        limit = _BLURRED * float(np.nanquantile(widths[list(where)], 0.1))
        for i in list(where):
            if widths[i] > limit:
                reasons[i] = f"blurred: its edges are {widths[i]:.1f} px wide"
                del where[i]
    diagonal = float(np.hypot(*size))
    # the one with most points begins
    taken: list[int] = []
    picked: dict[int, str] = {}
    left = sorted(where, key=lambda i: (-len(pictures[i].detection.idx), i))
    while left and len(taken) < _KEPT:
        if taken:
            away = [min(_apart(where[i], where[k]) for k in taken) / diagonal for i in left]
            n = int(np.argmax(away))
            if away[n] < _ALIKE:
                break
            why = f"the board is {away[n]:.0%} of the picture from where those before it have it"
        else:
            n, why = 0, "it shows most points"
        picked[left[n]] = why
        taken.append(left.pop(n))
    for i in left:
        nearest = min(taken, key=lambda k: _apart(where[i], where[k]))
        apart = _apart(where[i], where[nearest]) / diagonal
        like[i] = pictures[nearest].name
        reasons[i] = f"like frame {like[i]}: the board is {apart:.1%} of the picture away"
    return [
        replace(one, unused=reasons.get(i, one.unused), picked=picked.get(i), like=like.get(i))
        for i, one in enumerate(pictures)
    ]


def _outline(detection: Detection, board: Board) -> NDArray[np.float64]:
    """(4, 2) pixels of the corners of the whole board, by the plane that the found points lie in."""
    h = find_homography(board.points[detection.idx, :2], detection.xy)
    low, high = board.points[:, :2].min(0), board.points[:, :2].max(0)
    corners = np.array([[low[0], low[1], 1.0], [high[0], low[1], 1.0], [*high, 1.0], [low[0], high[1], 1.0]])
    mapped = corners @ h.T
    found: NDArray[np.float64] = mapped[:, :2] / mapped[:, 2:]
    return found


def _apart(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Root mean square distance of two outlines, pixels."""
    return float(np.sqrt(((a - b) ** 2).sum(1).mean()))
