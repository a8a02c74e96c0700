"""Whether a loop leads to its place or to the like of it.

That a place looks as it did is no evidence where others look the same: bays of a hall, floors of a car park. What gives
a false loop away is that one image shows both of what it takes for the same. What tells a true one are landmarks that
the map has nowhere else, and that the way between has hardly to be corrected: a look-alike is about as far away as what
one sees there is, and drift can be of any size, mostly much smaller. Landmarks are counted by clusters as those of
places in known maps are (:mod:`sfmapp.odometry.loops.evidence`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

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
from sfmapp.odometry.loops.look_alikes import LookAlikes
from sfmapp.odometry.loops.place_recognition import Ids, PlaceIndex, View
from sfmapp.odometry.loops.relocalize import RelocalizeOptions, agreeing_at, local_points, seen_as_before
from sfmapp.odometry.map.keyframe_map import KeyframeMap

Array = NDArray[np.float64]

# Share of the clusters with a like whose like is not found: 0.03 to 0.11 where four halls of equal bays close falsely.
_UNFOUND = 0.1
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

    def is_certain(self, shift: float | None) -> bool:
        """That the images show the like of a place is less likely than :data:`MAX_DOUBT`.

        Args:
            shift: of the newest keyframe by the loop, over the depth of what it sees; None: between two maps any place
                of the old one is as likely beforehand.
        """
        where = log_prior(self._num_places) - math.log(NOT_IN_MAP) if shift is None else log_ratio_of_shift(shift)
        return self._log_ratio() + where > -math.log(MAX_DOUBT)

    def _log_ratio(self) -> float:
        """How much likelier what is found and missing is in the right place than in its like, the logarithm: more has
        no like than is overlooked, no more is missing than has changed."""
        score = self.score()
        found = score.num_clusters - score.num_missing
        return log_ratio_of_share(score.num_distinct, found, _UNFOUND) - log_ratio_of_share(
            score.num_missing, score.num_clusters, CHANGED
        )

    def score(self) -> Score:
        """What clusters say; those with a like elsewhere in the map say nothing for the loop."""
        clusters = self._tally.clusters(self._look_alikes.cluster)
        repeated = clusters[self._look_alikes.is_repeated(clusters)]
        return self._tally.score(self._look_alikes.cluster, repeated)


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
