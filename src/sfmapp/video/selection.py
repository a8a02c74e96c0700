"""Which frames of a video are taken: far enough apart to tell depth, near enough to be matched, and sharp.

The points of the last frame that was taken are followed. Where they say that the camera has come far enough, the
sharpest of the frames around that place is taken, and points of it are followed from then on. A frame in which nothing
of the last one is found is left out, and where those after it show something else, the video was cut there.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from statistics import median
from typing import Generic, TypeVar

import numpy as np

from sfmapp.odometry.frontend.pyramid import Pyramid, build_pyramid
from sfmapp.video.following import MIN_POINTS, Follower
from sfmapp.video.motion import Apart
from sfmapp.video.options import VideoOptions
from sfmapp.video.quality import Look, Pixels

# Shares of the wanted distance between which the sharpest frame is looked for; and how far at most where all frames
# there are blurred. Frames that are too near cost time, those that are too far apart the model.
_OPEN, _CLOSE, _CLOSE_OF_BLURRED = 0.6, 1.15, 1.5
# What a frame at the end of that stretch may be sharper for nothing, rather than one in its middle.
_WORTH_OF_PLACE = 0.15
# Below this share of the median sharpness of the last frames a frame is blurred.
_BLURRED, _NUM_RECENT = 0.7, 30
# The first frame of a stretch is the sharpest of so many, while they show much the same.
_NUM_FIRST, _NEAR_FIRST = 15, 0.3
# Share of the points that is left where they are as good as gone. Points are also lost to whatever passes a camera that
# stands, and to noise where there is little to see, which tells nothing: it takes this share of the wanted distance.
_FEW_LEFT, _COME = 0.4, 0.35
# Frames after a break that show one thing, before it is believed that the video was cut.
_NUM_AFTER_CUT = 3

Held = TypeVar("Held")


@dataclass(slots=True)
class FrameRow:
    """What is said of a frame of a video, a row of ``frames.csv``.

    Attributes:
        number: from 0. time_s: in the video. sharpness: None where it was not judged.
        parallax, overlap: against the last frame that was taken, as shares; None where it was not followed.
        speed: median motion of points from the frame before, in longer sides a second; None where it was not followed.
        is_taken: it is one of the photographs. why: it is, or is not.
    """

    number: int
    time_s: float
    sharpness: float | None = None
    parallax: float | None = None
    overlap: float | None = None
    speed: float | None = None
    is_taken: bool = False
    why: str = ""


@dataclass(frozen=True)
class Taken(Generic[Held]):
    """A frame that is taken, with what was held of it."""

    row: FrameRow
    held: Held


@dataclass(frozen=True)
class _Candidate(Generic[Held]):
    row: FrameRow
    held: Held
    score: float
    why: str
    follower: Follower


@dataclass
class Selector(Generic[Held]):
    """Takes the frames of a video one after another. What it holds of them does not grow, but for their rows.

    Attributes:
        rows: of all frames so far; those since the last one that was taken are not yet final.
        breaks: times, in seconds, of the first frame after each place where the video shows something else.
    """

    options: VideoOptions
    rows: list[FrameRow] = field(default_factory=list)
    breaks: list[float] = field(default_factory=list)
    _main: Follower | None = None
    _is_first: bool = True
    _best: _Candidate[Held] | None = None
    _waiting: list[FrameRow] = field(default_factory=list)
    _probe: _Candidate[Held] | None = None
    _num_probed: int = 0
    _num_here: int = 0
    _recent: deque[float] = field(default_factory=lambda: deque(maxlen=_NUM_RECENT))
    _last: tuple[int, Pixels] | None = None
    _followed_s: float = 0.0

    def unreadable(self, number: int, time_s: float, why: str) -> None:
        """Note a frame that cannot be read."""
        self.rows.append(FrameRow(number, time_s, why=why))

    def push(self, number: int, time_s: float, look: Look, held: Held) -> Iterator[Taken[Held]]:
        """Look at the next frame; those that are taken by now, in their order.

        Args:
            number, time_s: of the frame. look: at it. held: what is given back if it is taken.
        """
        row = FrameRow(number, time_s, look.sharpness)
        self.rows.append(row)
        if look.fault:
            row.why, row.sharpness = look.fault, None
            return
        if self._last is not None and np.array_equal(self._last[1], look.small):
            row.why = f"repeats frame {self._last[0]}"
            return
        self._last = number, look.small
        pyramid = build_pyramid(look.small)
        if self._main is None:
            self._begin(row, held, Follower(pyramid))
        elif self._main.follow(pyramid):
            self._probe = None
            yield from self._go_on(row, held, pyramid)
        else:
            yield from self._lose(row, held, pyramid)

    def end(self) -> Iterator[Taken[Held]]:
        """The frames that are taken where the video ends."""
        yield from self._take()

    # ---------------------------------------------------------------------------------------------- stretches

    def _begin(self, row: FrameRow, held: Held, follower: Follower) -> None:
        """Begin a stretch with a frame, or one that was followed already since."""
        if not follower.has_points:
            row.why = "too few points to follow"
            return
        self._main, self._is_first, self._num_here, self._followed_s = follower, True, 1, row.time_s
        self._waiting = [row]
        self._best = _Candidate(row, held, row.sharpness or 0.0, "", Follower(follower.first))

    def _lose(self, row: FrameRow, held: Held, pyramid: Pyramid) -> Iterator[Taken[Held]]:
        """A frame in which nothing of those before is found: blurred, or the first of something else."""
        row.why = "nothing of the frames before it is found in it"
        if self._probe is None or not self._probe.follower.follow(pyramid):
            self._probe, self._num_probed = _Candidate(row, held, 0.0, "", Follower(pyramid)), 1
            return
        self._num_probed += 1
        if self._num_probed < _NUM_AFTER_CUT:
            return
        first, self._probe = self._probe, None
        yield from self._take()
        self.breaks.append(first.row.time_s)
        self._recent.clear()
        self._begin(first.row, first.held, first.follower)
        if self._best is not None:
            self._best.follower.follow(pyramid)

    def _go_on(self, row: FrameRow, held: Held, pyramid: Pyramid) -> Iterator[Taken[Held]]:
        """A frame that goes on from those before."""
        assert self._main is not None
        self._num_here += 1
        row.speed = self._main.step / max(row.time_s - self._followed_s, 1e-6)
        self._followed_s = row.time_s
        if self._best is not None and not self._best.follower.follow(pyramid):
            self._best = None
        while True:
            apart = self._main.apart()
            row.parallax, row.overlap = apart.parallax, apart.overlap
            far, why = self._progress(apart)
            if far < _NEAR_FIRST if self._is_first else far >= _OPEN:
                self._consider(row, held, pyramid, far, why)
            if not self._is_due(far):
                break
            is_this = self._best is not None and self._best.row is row
            yield from self._take()
            if is_this:
                break
        self._recent.append(row.sharpness or 0.0)

    def _progress(self, apart: Apart) -> tuple[float, str]:
        """How far the camera has come, 1 where a frame is wanted, and by what that is told."""
        assert self._main is not None
        left = self._main.share_left
        told = {
            "parallax": apart.parallax / self.options.parallax,
            "overlap": (1 - apart.overlap) / (1 - self.options.overlap),
        }
        told["points lost"] = (1 - left) / (1 - _FEW_LEFT) if max(told.values()) >= _COME else 0.0
        if len(self._main.xy) < 1.5 * MIN_POINTS and left < 1 - _FEW_LEFT:
            told["points lost"] = max(told["points lost"], _CLOSE_OF_BLURRED)
        why = max(told, key=lambda name: told[name])
        return told[why], why

    def _consider(self, row: FrameRow, held: Held, pyramid: Pyramid, far: float, why: str) -> None:
        """Make a frame the best of its place, if it is."""
        off = 0.0 if self._is_first else min(abs(far - 1) / (1 - _OPEN), 1.0)
        score = (row.sharpness or 0.0) * (1 - _WORTH_OF_PLACE * off)
        if row not in self._waiting[-1:]:
            self._waiting.append(row)
        if self._best is None or score > self._best.score:
            follower = Follower(pyramid)
            if follower.has_points:
                self._best = _Candidate(row, held, score, why, follower)

    def _is_due(self, far: float) -> bool:
        if self._best is None:
            return False
        if self._is_first:
            return far >= _NEAR_FIRST or self._num_here >= _NUM_FIRST
        is_blurred = bool(self._recent) and (self._best.row.sharpness or 0.0) < _BLURRED * median(self._recent)
        return far >= (_CLOSE_OF_BLURRED if is_blurred else _CLOSE)

    def _take(self) -> Iterator[Taken[Held]]:
        """Take the best frame of its place."""
        best, self._best = self._best, None
        if best is None:
            return
        for row in self._waiting:
            row.why = f"less sharp than frame {best.row.number}, or less well placed"
        why = ("first after a break" if self.breaks else "first") if self._is_first else best.why
        among = f", sharpest of {len(self._waiting)}" if len(self._waiting) > 1 else ""
        best.row.is_taken, best.row.why = True, why + among
        self._waiting, self._main, self._is_first = [], best.follower, False
        yield Taken(best.row, best.held)
