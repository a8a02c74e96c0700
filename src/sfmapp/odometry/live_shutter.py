"""A rolling shutter while a map still grows: its readout as soon as the images tell it, and off every later frame."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.odometry.frontend.row_motion import RowMotion
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.map.local_map import LocalMap
from sfmapp.odometry.records import FrameRecord
from sfmapp.odometry.shutter import (
    FIRST_STRIDE,
    NEXT_STRIDE,
    Begun,
    Found,
    RowShift,
    has_settled,
    is_worth_it,
    lay_shift,
    make_question,
    search,
)

Array = NDArray[np.float64]


class LiveShutter:
    """What is known of the readout of a camera so far.

    Attributes:
        found: the readout, and what speaks for it; its readout is zero while none is believed.
        is_open: it may be asked for, and has not settled.

    Args:
        is_open: there is one camera, and nothing beside its images tells how it moves while it reads.
        records: of the run, which go on growing.
    """

    def __init__(self, is_open: bool, records: list[FrameRecord]) -> None:
        self.is_open, self.found = is_open, Begun()
        self._records, self._last = records, 0.0
        self._frame_s = 0.0

    def rows(self, step: Array | None = None) -> RowMotion:
        """How the camera moved while it read the newest frame, by the motion (7,) since the frame before it."""
        readout = self.found.readout
        if not readout or len(self._records) < 2:
            return RowMotion()
        gap_s = self._records[-1].timestamp_s - self._records[-2].timestamp_s
        share = readout * self._frame_s / gap_s if gap_s > 0 else 0.0
        return RowMotion(share, rigid3.IDENTITY if step is None else step)

    def question(self, local: LocalMap) -> Callable[[], Found] | None:
        """What :func:`~sfmapp.odometry.shutter.search` has to be asked of a map, by a copy that may be asked in another
        thread; None where there is nothing to ask."""
        if not self.is_open:
            return None
        shift_of = RowShift(self._records, local.keyframes, local.map_idx)
        job, shifts = make_question(local.keyframes, shift_of)
        stride, last = (NEXT_STRIDE if self.found.readout else FIRST_STRIDE), self._last
        return lambda: search(job, shifts, stride, last)

    def is_worth_it(self, readout: float, evidence: float) -> bool:
        """Whether a readout is believed on top of what is."""
        return is_worth_it(readout, evidence, self.found.readout)

    def take(self, readout: float, evidence: float, local: LocalMap) -> None:
        """Believe a readout on top of what was, and take it off a map."""
        if not self.found.readout:
            times = np.array([record.timestamp_s for record in self._records])
            self._frame_s = float(np.median(np.diff(times)))
            self.found = Begun(readout, evidence, readout)
        else:
            self.is_open = not has_settled(readout, self._last)
            self.found = Begun(self.found.readout + readout, self.found.evidence, self.found.first_readout)
        self._last = readout
        self.straighten(local.keyframes, local.map_idx, 0)

    def straighten(self, keyframes: KeyframeMap, map_idx: int, first: int) -> None:
        """Tell afresh what the shutter has done to the keyframes from a position on: what frames after them saw, and
        where their points are by now, says better how they moved."""
        if not self.found.readout:
            return
        begin = bisect_left(self._records, keyframes.keyframes[first].frame_idx, key=lambda record: record.frame_idx)
        shift_of = RowShift(self._records[max(begin - 1, 0) :], keyframes, map_idx)
        lay_shift(keyframes, shift_of, self.found.readout, first)
