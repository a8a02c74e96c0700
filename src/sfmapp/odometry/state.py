"""What odometry is doing between two frames, and what may follow what."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto


class Phase(Enum):
    """What is done with the next frame."""

    INITIALIZING = auto()  # there is no map yet: one is begun as soon as the views allow it
    TRACKING = auto()  # its pose is measured in the current map
    LOST = auto()  # it is looked for where its tracks were, and in the places of all maps
    # it is looked for in the places of all maps, and another map may begin; so begins a run that knows a map
    STARTING_OVER = auto()


_NEXT = {
    Phase.INITIALIZING: {Phase.TRACKING},  # a map has begun
    Phase.TRACKING: {Phase.LOST},  # a frame's pose could not be measured
    Phase.LOST: {Phase.TRACKING, Phase.STARTING_OVER},  # it was found again, or not for too long
    Phase.STARTING_OVER: {Phase.TRACKING},  # a place was recognized, or another map has begun
}


@dataclass
class RunState:
    """The phase of a run, and since when it is lost.

    Attributes:
        phase: see :class:`Phase`.
        lost_since_s: time of the first frame without a pose, while ``is_lost``.
    """

    phase: Phase = Phase.INITIALIZING
    lost_since_s: float = float("nan")

    @property
    def is_lost(self) -> bool:
        """There is a map, and the camera is not known to be in it."""
        return self.phase in (Phase.LOST, Phase.STARTING_OVER)

    @property
    def may_begin_map(self) -> bool:
        """A map may begin with the next frame."""
        return self.phase in (Phase.INITIALIZING, Phase.STARTING_OVER)

    def expect_known_map(self) -> None:
        """There is a map from the start, and the camera may be in it; until it is found there another may begin."""
        assert self.phase is Phase.INITIALIZING
        self.phase = Phase.STARTING_OVER

    def track(self) -> None:
        """A map has begun, or the camera was found again in one."""
        self._go_to(Phase.TRACKING)

    def lose(self, timestamp_s: float) -> None:
        """The pose of the frame of this time could not be measured."""
        self._go_to(Phase.LOST)
        self.lost_since_s = timestamp_s

    def wait(self, timestamp_s: float, max_lost_s: float) -> None:
        """The frame of this time was not found either: start over if that has lasted for too long."""
        # to the millisecond: what a clock that began in 1970 rounds away may not decide
        if self.phase is Phase.LOST and round(timestamp_s - self.lost_since_s, 3) >= max_lost_s:
            self._go_to(Phase.STARTING_OVER)

    def _go_to(self, phase: Phase) -> None:
        assert phase in _NEXT[self.phase], f"{phase.name} cannot follow {self.phase.name}"
        self.phase = phase
