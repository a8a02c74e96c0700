"""Whether maps repeat themselves, as far as they have shown: each new place that fits another one says so, each that
fits none says that they do not.

What looks like a place may be the like of it that no map has seen. Its landmarks cannot tell: they are all there. What
tells is whether the map has had anything twice where it could have had.
"""

from __future__ import annotations

from collections.abc import Iterable

from sfmapp.odometry.loops.evidence import log_ratio_of_share
from sfmapp.odometry.map.keyframe_map import KeyframeMap

# Fewest places of a map, apart from a new one, that this could have fitted.
_MIN_OTHERS = 5
# Share of the places of a map that fit none of the others, where there are likes that it has not seen: 0.42 to 0.52 in
# four halls of equal bays walked round once; 1.0 on one drive, one block and in one furnished room of 13 places.
_SINGLE = 0.5


class Repetition:
    """Which places were held against others of their map, and which of them fitted one that they are not at."""

    def __init__(self) -> None:
        self._asked: set[int] = set()
        self._likes: dict[int, set[int]] = {}

    def ask(self, frame_idx: int, num_others: int) -> None:
        """A place is held against the others of its map that do not show the same points.

        Args:
            frame_idx: the frame that its keyframe is. num_others: so many of those there are.
        """
        if num_others >= _MIN_OTHERS:
            self._asked.add(frame_idx)

    def note_like(self, frame_idx: int, other: int) -> None:
        """A place fits another one, that of a frame elsewhere."""
        self._likes.setdefault(frame_idx, set()).add(other)

    def forgive(self, frame_idx: Iterable[int]) -> None:
        """Places were where they seemed to be: a loop has proven to be one."""
        for frame in frame_idx:
            self._likes.pop(frame, None)
            self._asked.discard(frame)

    def log_ratio(self, maps: Iterable[KeyframeMap], place: int) -> float:
        """Logarithm of how much likelier it is that so many places of maps fit no other if what these show is there
        once than if it has likes that they have not seen; 0 where it is no likelier.

        Args:
            place: the frame of the one that is in question; one that has a like is told nothing by others.
        """
        repeated = set(self._likes).union(*self._likes.values())
        if place in repeated:
            return 0.0
        told = [k.frame_idx for keyframes in maps for k in keyframes.keyframes]
        told = [frame for frame in told if frame in self._asked or frame in repeated]
        return log_ratio_of_share(sum(frame not in repeated for frame in told), len(told), _SINGLE)
