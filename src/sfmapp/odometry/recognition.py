"""Knowing a place again: keyframes remembered, loops closed, maps joined, lost frames found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor

import numpy as np
from numpy.typing import NDArray

from sfmapp.odometry.belief.belief import OwnFrame, PlaceBelief
from sfmapp.odometry.frontend.corners import find_corners
from sfmapp.odometry.loops.closing import apply_closure, join_maps
from sfmapp.odometry.loops.detection import LoopClosure, LoopFinder
from sfmapp.odometry.loops.place_recognition import PlaceIndex
from sfmapp.odometry.loops.place_recognition import View as PlaceView
from sfmapp.odometry.loops.relocalize import Relocalization, RelocalizeOptions, relocalize
from sfmapp.odometry.loops.rivals import believe_place
from sfmapp.odometry.map.keyframe_map import KeyframeMap
from sfmapp.odometry.map.local_map import LocalMap, View
from sfmapp.odometry.records import FrameRecord

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

# A keyframe is remembered as a place once it shares fewer than this share of its points with the last such.
_NEW_PLACE = 0.5
# Fewest points that make a place, and fewest corners in which a place may be seen again: frames with fewer are black,
# blurred or white.
_MIN_POINTS, _MIN_CORNERS = 15, 40
# Corners of a lost frame; closer together than those that are tracked, as any of them may be a point of the map.
_CORNERS, _CORNER_DISTANCE_PX = 1000, 5.0

# Rolls at which a lost frame is looked at, one after the other: descriptors bear 15 degrees.
_ROLLS_DEG = (0.0, 25.0, -25.0)

# Of lost frames that fit several places of a known map, every so many is held against it: the next shows the same.
_OPEN = 5
# Keyframes after which one is held against a known map in any case.
_LOOK_AGAIN = 3

# Keyframes after a loop before the next is looked for: what drifts in between is what a window can bear.
_REST = 30


class Recognition:
    """All places of all maps.

    Attributes:
        belief: where the camera is in a known map; None without one.

    Args:
        executor: where vocabularies are learnt; None: in the thread that calls.
    """

    def __init__(self, seed: int, executor: Executor | None = None) -> None:
        self._places, self._finder = PlaceIndex(seed=seed, executor=executor), LoopFinder()
        self._num_searches, self._num_waited, self._seed = 0, 0, seed
        self.belief: PlaceBelief | None = None
        # keyframe of the current map up to which no loop is looked for
        self._resting_until = 0
        # keyframe of the current map that was held against a known one last
        self._looked_at = 0
        self._last = np.zeros(0, np.int64)

    @property
    def num_places(self) -> int:
        """How many keyframes are remembered."""
        return len(self._places)

    @property
    def num_open_loops(self) -> int:
        """Loops that were seen and not believed, as they may lead to the like of their place."""
        return self._finder.num_open

    def know(self, local: LocalMap) -> None:
        """Remember the keyframes of a map that was there before, as far as there are pictures of them."""
        for position, picture in local.known.pictures.items():
            keyframe = local.keyframes.keyframes[position]
            if len(keyframe.point_id) >= _MIN_POINTS:
                self._places.add(
                    local.map_idx, keyframe.frame_idx, picture, keyframe.xy[:, 0], keyframe.point_id
                )  # fmt: skip
        self._places.learn()
        self.belief = PlaceBelief(local.map_idx, local.keyframes, self._places, local.known.pictures, self._seed)

    def remember(
        self, maps: dict[int, LocalMap], local: LocalMap, view: View, xy: Array, ids: Ids, covariance: Array
    ) -> LoopClosure | None:  # fmt: skip
        """Remember the newest keyframe of a map, if it shows something new, and say whether that closes a loop.

        Args:
            view: its frame. xy: (N, 2) pixels and ids: (N,) ascending, its triangulated points.
            covariance: (6, 6) of its pose given the map; not finite where that was not measured.
        """
        is_new = len(ids) >= _MIN_POINTS and np.isin(ids, self._last, True).sum() <= _NEW_PLACE * len(ids)
        is_open = self.belief is not None and self.belief.map_idx != local.map_idx and len(ids) >= _MIN_POINTS
        # keyframes in between show what the ones before have shown
        is_again = not 0 <= local.newest - self._looked_at < _LOOK_AGAIN
        is_open &= is_new or self._finder.is_suspicious or is_again
        if is_new:
            self._last = ids
            seen = self._places.add(local.map_idx, view.frame_idx, view.images[0], xy, ids)
        elif is_open or self._finder.is_suspicious:
            seen = PlaceView(view.images[0], xy, ids)
        else:
            return None
        if is_open:
            self._looked_at = local.newest
            self._look(maps, OwnFrame(local.map_idx, local.keyframes, local.newest, covariance), seen)
        if local.newest < self._resting_until or not (is_new or self._finder.is_suspicious):
            return None
        keyframes = {number: other.keyframes for number, other in maps.items()}
        barred = None if self.belief is None else self.belief.map_idx
        return self._finder.find(keyframes, local.map_idx, self._places, view.frame_idx, seen, barred)

    def _look(self, maps: dict[int, LocalMap], own: OwnFrame, seen: PlaceView) -> None:
        """Judge where in the known map the camera is that makes a map of its own; where that is certain, the two are
        held against each other as a loop is."""
        belief = self.belief
        assert belief is not None
        belief.look(maps[belief.map_idx].keyframes, seen, own=own)
        if belief.decided is not None and not self._finder.is_suspicious:
            self._finder.suspect(belief.map_idx, belief.decided.known_from_own)

    def forget(self, frame_idx: int) -> bool:
        """Let go of a keyframe that is to be dropped; False if it is needed to confirm a loop."""
        if self._finder.is_suspicious:
            return False
        if frame_idx in self._places:
            self._places.remove(frame_idx)
        self._resting_until -= 1
        return True

    def close(
        self, maps: dict[int, LocalMap], records: Sequence[FrameRecord], closure: LoopClosure
    ) -> tuple[LocalMap, float]:
        """Close a loop, or join two maps through it; the frames move along.

        No adjustment may be under way. ``maps`` loses a map that was taken into another.

        Returns:
            The map that holds the newest keyframe now, and the factor on its unit of length.
        """
        self._finder.reset()
        if self.belief is not None:
            self.belief.reset()
        local, scale = (
            self._close(maps, records, closure)
            if closure.old_map == closure.new_map
            else self._join(maps, records, closure)
        )
        self._resting_until = local.newest + _REST
        return local, scale

    def _close(
        self, maps: dict[int, LocalMap], records: Sequence[FrameRecord], closure: LoopClosure
    ) -> tuple[LocalMap, float]:
        local = maps[closure.new_map]
        closed = apply_closure(local.keyframes, self._places, closure)
        become = _renaming(local.keyframes.num_points, closed.renamed)
        for record in records:
            if record.map_idx == local.map_idx and record.has_pose:
                record.move(closed.corrections[record.keyframe, 7], become)
        return local, float(closed.corrections[-1, 7])

    def _join(
        self, maps: dict[int, LocalMap], records: Sequence[FrameRecord], closure: LoopClosure
    ) -> tuple[LocalMap, float]:
        joined = join_maps({number: local.keyframes for number, local in maps.items()}, self._places, closure)
        kept, absorbed = maps[joined.kept_map], maps.pop(joined.absorbed_map)
        position = {keyframe.frame_idx: n for n, keyframe in enumerate(joined.keyframes.keyframes)}
        become = _renaming(joined.keyframes.num_points, joined.renamed)
        for local, offset, scale in ((kept, 0, 1.0), (absorbed, joined.id_offset, joined.kept_from_absorbed[7])):
            place = [position[keyframe.frame_idx] for keyframe in local.keyframes.keyframes]
            for record in records:
                if record.map_idx == local.map_idx and record.has_pose:
                    record.move(scale, become, offset)
                    record.join(kept.map_idx, place[record.keyframe])
        newest = absorbed if closure.new_map == absorbed.map_idx else kept
        kept.keyframes, kept.images = joined.keyframes, {len(position) - 1: newest.images[newest.newest]}
        return kept, float(joined.kept_from_absorbed[7]) if newest is absorbed else 1.0

    def find(self, maps: dict[int, LocalMap], view: View) -> tuple[LocalMap, int, Array, Ids, Array] | None:
        """Find a lost frame in any of the maps, where it is certain not to be at the like of its place; in a known one
        where :class:`PlaceBelief` is certain.

        Returns:
            The map, the frame that it looks like, the pose (7,), and the points seen: ids (N,) and pixels (N, 2).
        """
        if len(self._places) == 0:
            return None
        corners = find_corners(view.pyramids[0], np.zeros((0, 2)), _CORNERS, min_distance_px=_CORNER_DISTANCE_PX)
        if len(corners) < _MIN_CORNERS:
            return None
        keyframes = {number: local.keyframes for number, local in maps.items()}
        is_open = self.belief is not None and self.belief.is_open
        if not is_open:  # a frame that fits several places is turned as it should be
            self._num_searches += 1
        self._num_waited = (self._num_waited + 1) % _OPEN if is_open else 0
        roll = math.radians(_ROLLS_DEG[(self._num_searches - 1) % 3])
        seen, found, options = PlaceView(view.images[0], corners), None, RelocalizeOptions()
        if self.belief is not None:
            known = keyframes.pop(self.belief.map_idx)
            if self._num_waited == 0:
                found = self._find_known(known, seen, roll)
        if found is None:
            fitting = relocalize(keyframes, self._places, seen, options, roll)
            found = believe_place(
                fitting, keyframes, self._places, seen, view.timestamp_s, options, self._finder.repetition
            )
        if found is None:
            return None
        located = found.located
        return (
            maps[found.map_idx],
            found.frame_idx,
            located.cam_from_world,
            located.point_id,
            corners[located.corner_idx],
        )

    def _find_known(self, known: KeyframeMap, seen: PlaceView, roll: float) -> Relocalization | None:
        """Find a lost frame in the known map, where no other place of it might be the right one."""
        belief = self.belief
        assert belief is not None
        belief.look(known, seen, roll)
        decided = belief.decided
        if decided is None or decided.located is None:
            return None
        return Relocalization(belief.map_idx, decided.place, decided.located)


def _renaming(num_points: int, renamed: Ids) -> NDArray[np.int32]:
    """(num_points,) what each id has become."""
    become = np.arange(num_points, dtype=np.int32)
    become[renamed[:, 0]] = renamed[:, 1]
    return become
