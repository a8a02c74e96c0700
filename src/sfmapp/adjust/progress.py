"""What a long adjustment tells of its steps."""

from __future__ import annotations

import time
from types import TracebackType

from sfmapp.events import Events

STAGE = "bundle adjustment"
# Adjustments that may take seconds tell of every step from the first, others once they have taken so long.
_LARGE_OBSERVATIONS, _QUIET_S = 500_000, 1.0


class StepProgress:
    """Tells of steps as advances of a stage of its own; a context, which says in the end how many there were.

    Every step asks for cancellation.
    """

    def __init__(self, events: Events | None, num_images: int, num_observations: int, max_steps: int) -> None:
        self._events, self._max_steps, self._num_steps = events, max_steps, 0
        self._title = f"{num_images} images, {num_observations} observations"
        self._is_large = num_observations >= _LARGE_OBSERVATIONS
        self._start, self._is_told, self._cost = time.monotonic(), False, 0.0

    def __enter__(self) -> StepProgress:
        return self

    def begin(self, cost: float) -> None:
        """The cost of the first state is known."""
        self._cost = cost
        self._tell()

    def step(self, cost: float) -> None:
        """A step was tried, whose state, or the one before it, has this cost.

        Raises:
            InterruptedRunError: a stop was asked for.
        """
        self._num_steps, self._cost = self._num_steps + 1, cost
        self._tell()
        if self._events is not None:
            if self._is_told:
                self._events.advanced(STAGE, message=self._text)
            self._events.raise_if_cancelled()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._events is not None and self._is_told:
            self._events.finished(STAGE, self._text)

    @property
    def _text(self) -> str:
        return f"step {self._num_steps} of at most {self._max_steps}, cost {self._cost:.6g}"

    def _tell(self) -> None:
        """Begin to tell, if it is time."""
        is_time = self._is_large or time.monotonic() - self._start > _QUIET_S
        if self._events is not None and is_time and not self._is_told:
            self._is_told = True
            self._events.started(STAGE, f"{self._title}, {self._text}")
