"""All maps of a run, by number."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor

from sfmapp.images.sequence import Imu
from sfmapp.odometry.map.local_map import LocalMap
from sfmapp.odometry.options import OdometryOptions
from sfmapp.scene.rig import Rig


class Atlas:
    """Maps that are not connected. A number that a map has had is never given again: live poses are told apart by it.

    Attributes:
        maps: by number, in the order in which they began; those that were taken into others are gone.
    """

    def __init__(self, options: OdometryOptions, executor: Executor | None, imu: Imu | None = None) -> None:
        self.maps: dict[int, LocalMap] = {}
        self._options, self._executor, self._imu = options, executor, imu
        self._num_begun = 0

    def __iter__(self) -> Iterator[LocalMap]:
        return iter(self.maps.values())

    def new_map(self, rig: Rig) -> LocalMap:
        """An empty map, which takes the place of one that did not begin."""
        number = self._num_begun
        self.maps[number] = LocalMap(rig, self._options, self._executor, number, self._imu)
        return self.maps[number]

    def begin(self, local: LocalMap) -> None:
        """A new map has keyframes and points: it stays."""
        self._num_begun = local.map_idx + 1

    def discard(self, local: LocalMap) -> None:
        """Forget a new map that did not begin."""
        del self.maps[local.map_idx]
        local.backend.finish(local.keyframes)
