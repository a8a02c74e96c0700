"""Whether a loop leads to its place or to the like of it.

That a place looks as it did is no evidence where others look the same: bays of a hall, floors of a car park. What gives
a false loop away is that one image shows both of what it takes for the same. What tells a true one are landmarks that
the map has nowhere else, and that the way between has hardly to be corrected: a look-alike is about as far away as what
one sees there is, and drift can be of any size, mostly much smaller. Landmarks are counted by clusters as those of
places in known maps are (:mod:`sfmapp.odometry.loops.evidence`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.odometry.loops.evidence import (
    CHANGED,
    MAX_DOUBT,
    NOT_IN_MAP,
    Score,
    Tally,
    is_contradicted,
    log_prior,
    log_ratio_of_share,
)
from sfmapp.odometry.loops.gaps import log_ratio_of_gap, way_of
from sfmapp.odometry.loops.look_alikes import LookAlikes
from sfmapp.odometry.loops.place_recognition import Ids, PlaceIndex, View
from sfmapp.odometry.loops.pose_graph import keyframe_depths
from sfmapp.odometry.loops.relocalize import (
    Relocalization,
    RelocalizeOptions,
    agreeing_at,
    local_points,
    position_of,
    seen_as_before,
)
from sfmapp.odometry.loops.repetition import Repetition
from sfmapp.odometry.map.keyframe_map import KeyframeMap

Array = NDArray[np.float64]

# Share of the clusters with a like whose like is not found: 0.03 to 0.11 where four halls of equal bays close falsely.
_UNFOUND = 0.1
# The same share where places are alike that the map has not seen: mostly 0.35 to 0.63 of the clusters at the like of a
# place had none in half of a hall that is the same after half a turn, 0.73 to 0.8 at times; of those of places in
# furnished rooms 0.74 to 0.95. Less is asked for where the way may lead there, more where it leads elsewhere.
_MAY_BE_UNSEEN, _UNSEEN = 0.45, 0.6
# Fewest places of a map that could have shown that it repeats itself: halls of equal bays have shown it after five.
_MIN_PLACES = 5
# Drift is of any size within three decades, up to the depth of what is seen, as far as look-alikes are.
_MIN_SHIFT = 1e-3


class LoopEvidence:
    """What landmarks say of one suspected loop, in all keyframes that saw it.

    Args:
        old_map: where the loop leads. places: its keyframes as they are remembered.
        old_from_new: (8,) the loop, if it lies within that map; None: it comes from another.
    """

    def __init__(
        self, old_map: KeyframeMap, places: PlaceIndex, old_from_new: Array | None, options: RelocalizeOptions
    ) -> None:
        self._map, self._places, self._options = old_map, places, options
        self._look_alikes = LookAlikes(old_map, places, {}, old_from_new)
        self._num_places = sum(k.frame_idx in places for k in old_map.keyframes)
        self._tally = Tally()

    def look(self, view: View, old_idx: int, pose: Array) -> None:
        """Look for the landmarks around an old keyframe in another image.

        Args:
            old_idx: position of the keyframe. pose: (7,) of the image in the old map.
        """
        frame_idx = self._map.keyframes[old_idx].frame_idx
        local = local_points(self._map, self._places, frame_idx, self._options.num_neighbors)
        # points that are newer than the loop belong to no cluster
        local = local.subset(local.point_id < len(self._look_alikes.cluster))
        expected = local.subset(seen_as_before(self._map, local, pose))
        self._tally.add(*agreeing_at(expected, view, self._map.rig.cameras[0], pose))

    @property
    def weight(self) -> float:
        """What all clusters say together, as if none had a like: for comparing places with each other."""
        score = self._tally.score(self._look_alikes.cluster, np.zeros(0, np.int64))
        return score.support + score.against

    @property
    def is_contradicted(self) -> bool:
        """More is missing than what is hidden or has changed in a right place."""
        return self._tally.score(self._look_alikes.cluster, np.zeros(0, np.int64)).is_contradicted

    def is_certain_by_drift(self, shift: float) -> bool:
        """That the images show the like of a place is less likely than :data:`MAX_DOUBT`, within a map.

        Args:
            shift: of the newest keyframe by the loop, over the depth of what it sees.
        """
        return self._outweighs(log_ratio_of_shift(shift), _UNFOUND)

    def is_certain_by_way(self, by_way: float | None, by_maps: float) -> bool:
        """The same where a camera was not seen for a while.

        Args:
            by_way: as of :func:`log_ratio_of_gap`. Where the way may lead to several look-alikes, or not there at all
                (None), any place of the map is as likely beforehand, and the map must show that it does not repeat
                itself, as otherwise it may do so where it has not been seen.
            by_maps: as of :meth:`Repetition.log_ratio`.
        """
        if by_way is not None and by_way >= 0.0:
            return self._outweighs(by_way, _UNFOUND)
        if by_way is None and self._num_places < _MIN_PLACES:
            return False
        anywhere = log_prior(self._num_places) - math.log(NOT_IN_MAP) + by_maps
        return self._outweighs(anywhere, _UNSEEN if by_way is None else _MAY_BE_UNSEEN)

    def _outweighs(self, where: float, unfound: float) -> bool:
        """Whether landmarks and what is known beforehand, a logarithm, speak for the place: more have no like than are
        overlooked, no more is missing than has changed."""
        score = self.score()
        found = score.num_clusters - score.num_missing
        log_ratio = log_ratio_of_share(score.num_distinct, found, unfound) - log_ratio_of_share(
            score.num_missing, score.num_clusters, CHANGED
        )
        return log_ratio + where > -math.log(MAX_DOUBT)

    def score(self) -> Score:
        """What clusters say; those with a like elsewhere in the map say nothing for the loop."""
        clusters = self._tally.clusters(self._look_alikes.cluster)
        repeated = clusters[self._look_alikes.is_repeated(clusters)]
        return self._tally.score(self._look_alikes.cluster, repeated)


def believe_place(
    fitting: Sequence[Relocalization], maps: Mapping[int, KeyframeMap], places: PlaceIndex, view: View,
    timestamp_s: float, options: RelocalizeOptions, repetition: Repetition,
) -> Relocalization | None:  # fmt: skip
    """Of the places that a lost image fits the one where most is found and least is missing, if it is certain.

    Args:
        fitting: as of :func:`relocalize`. timestamp_s: when the image was taken. repetition: of the maps.
    """
    judged = []
    for found in fitting:
        keyframes, pose = maps[found.map_idx], found.located.cam_from_world
        evidence, position = LoopEvidence(keyframes, places, None, options), position_of(keyframes, found.frame_idx)
        evidence.look(view, position, pose)
        judged.append((evidence, keyframes, position, found))
    if not judged:
        return None
    evidence, keyframes, position, found = max(judged, key=lambda place: place[0].weight)
    if evidence.is_contradicted:
        return None
    way, depth = way_of(keyframes).before(timestamp_s), float(keyframe_depths(keyframes)[position])
    by_way = log_ratio_of_gap(way, timestamp_s, rigid3.center(found.located.cam_from_world), depth)
    return found if evidence.is_certain_by_way(by_way, repetition.log_ratio((keyframes,), found.frame_idx)) else None


def log_ratio_of_shift(shift: float) -> float:
    """Logarithm of how much likelier drift has a size than the distance of a look-alike.

    Both are densities over a plane: of drift the one in which each power of ten is as likely, of look-alikes an even
    one out to the depth.

    Args:
        shift: over the depth of what is seen.
    """
    decades = -math.log(_MIN_SHIFT)
    return -2.0 * math.log(max(shift, _MIN_SHIFT)) - math.log(2.0 * decades)


def are_seen_apart(keyframes: KeyframeMap, new_id: Ids, old_id: Ids, limit_px: float) -> bool:
    """Whether pairs of points (M,) that would be the same are two for certain: one image shows both, apart.

    Args:
        limit_px: farther than that apart.
    """
    partner = np.full(keyframes.num_points, -1, np.int64)
    both = (new_id >= 0) & (new_id != old_id)
    partner[new_id[both]] = old_id[both]
    is_apart = np.zeros(keyframes.num_points, bool)
    for keyframe in keyframes.keyframes:
        ids = keyframe.point_id
        row = np.flatnonzero(partner[ids] >= 0)
        at = np.minimum(np.searchsorted(ids, partner[ids[row]]), len(ids) - 1)
        shown = ids[at] == partner[ids[row]]
        row, at = row[shown], at[shown]
        off = np.linalg.norm(keyframe.xy[row, 0] - keyframe.xy[at, 0], axis=1)
        is_apart[ids[row[off > limit_px]]] = True
    return is_contradicted(int((partner >= 0).sum()), int(is_apart.sum()))
