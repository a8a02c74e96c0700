"""Knowing a place again: keyframes remembered, loops closed, maps joined, lost frames found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import Executor

import numpy as np
from numpy.typing import NDArray

from sfmapp.odometry.frontend.corners import find_corners
from sfmapp.odometry.loops.closing import apply_closure, join_maps
from sfmapp.odometry.loops.detection import LoopClosure, LoopFinder, LoopOptions
from sfmapp.odometry.loops.place_recognition import PlaceIndex
from sfmapp.odometry.loops.place_recognition import View as PlaceView
from sfmapp.odometry.loops.relocalize import Relocalization, RelocalizeOptions, is_ambiguous, relocalize
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

# Keyframes after a loop before the next is looked for: what drifts in between is what a window can bear.
_REST = 30


class Recognition:
    """All places of all maps.

    Attributes:
        num_ambiguous: frames that might have been at several places of a known map.

    Args:
        executor: where vocabularies are learnt; None: in the thread that calls.
    """

    def __init__(self, seed: int, executor: Executor | None = None) -> None:
        self._places, self._finder = PlaceIndex(seed=seed, executor=executor), LoopFinder()
        self._num_searches, self.num_ambiguous = 0, 0
        # keyframe of the current map up to which no loop is looked for
        self._resting_until = 0
        self._last = np.zeros(0, np.int64)

    @property
    def num_places(self) -> int:
        """How many keyframes are remembered."""
        return len(self._places)

    def know(self, local: LocalMap) -> None:
        """Remember the keyframes of a map that was there before, as far as there are pictures of them."""
        for position, picture in local.known.pictures.items():
            keyframe = local.keyframes.keyframes[position]
            if len(keyframe.point_id) >= _MIN_POINTS:
                self._places.add(
                    local.map_idx, keyframe.frame_idx, picture, keyframe.xy[:, 0], keyframe.point_id
                )  # fmt: skip
        self._places.learn()

    def remember(
        self, maps: dict[int, LocalMap], local: LocalMap, view: View, xy: Array, ids: Ids
    ) -> LoopClosure | None:
        """Remember the newest keyframe of a map, if it shows something new, and say whether that closes a loop.

        Args:
            view: its frame. xy: (N, 2) pixels and ids: (N,) ascending, its triangulated points.
        """
        is_new = len(ids) >= _MIN_POINTS and np.isin(ids, self._last, True).sum() <= _NEW_PLACE * len(ids)
        if is_new:
            self._last = ids
            seen = self._places.add(local.map_idx, view.frame_idx, view.images[0], xy, ids)
        elif self._finder.is_suspicious:
            seen = PlaceView(view.images[0], xy, ids)
        else:
            return None
        if local.newest < self._resting_until:
            return None
        keyframes = {number: other.keyframes for number, other in maps.items()}
        closure = self._finder.find(keyframes, local.map_idx, self._places, view.frame_idx, seen)
        if closure is not None and closure.old_map != closure.new_map and maps[closure.old_map].keyframes.num_known:
            last = closure.views[-1]
            frame_idx = maps[closure.old_map].keyframes.keyframes[last.old_idx].frame_idx
            if self._is_elsewhere(maps, seen, Relocalization(closure.old_map, frame_idx, last.located)):
                return None
        return closure

    def _is_elsewhere(
        self, maps: dict[int, LocalMap], seen: PlaceView, found: Relocalization, roll: float = 0.0
    ) -> bool:
        """Whether what was found in a known map might be another place of it, and so is not to be believed."""
        if self.num_ambiguous:
            # seen once at two places, the camera is between things that look alike: the next view, in which one of
            # them falls just short, tells nothing (a street of equal houses: 20 m off, and sure)
            return True
        known = maps[found.map_idx].keyframes
        is_open = is_ambiguous(known, self._places, seen, found, RelocalizeOptions(), roll)
        self.num_ambiguous += is_open
        return is_open

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
        """Find a lost frame in any of the maps; in a known one as surely as a loop is, for nothing leads there.

        Returns:
            The map, the frame that it looks like, the pose (7,), and the points seen: ids (N,) and pixels (N, 2).
        """
        if len(self._places) == 0:
            return None
        corners = find_corners(view.pyramids[0], np.zeros((0, 2)), _CORNERS, min_distance_px=_CORNER_DISTANCE_PX)
        if len(corners) < _MIN_CORNERS:
            return None
        keyframes = {number: local.keyframes for number, local in maps.items()}
        roll, self._num_searches = math.radians(_ROLLS_DEG[self._num_searches % 3]), self._num_searches + 1
        seen = PlaceView(view.images[0], corners)
        found = relocalize(keyframes, self._places, seen, RelocalizeOptions(), roll)
        if found is None:
            return None
        if keyframes[found.map_idx].num_known and (
            found.located.agreement < LoopOptions().min_agreement or self._is_elsewhere(maps, seen, found, roll)
        ):
            return None
        located = found.located
        return (
            maps[found.map_idx],
            found.frame_idx,
            located.cam_from_world,
            located.point_id,
            corners[located.corner_idx],
        )


def _renaming(num_points: int, renamed: Ids) -> NDArray[np.int32]:
    """(num_points,) what each id has become."""
    become = np.arange(num_points, dtype=np.int32)
    become[renamed[:, 0]] = renamed[:, 1]
    return become
