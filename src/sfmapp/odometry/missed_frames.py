"""Frames that got no pose at their time, and get one as soon as a map reaches back to them.

Before a map begins, and after a loss until the camera is found again, frames go by in which the same things are to be
seen. From the first frame that has a pose again they are followed backwards in time, as all others are forwards.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.odometry.frontend.active_tracks import ActiveTracks
from sfmapp.odometry.frontend.pyramid import Pyramid
from sfmapp.odometry.map.local_map import LocalMap
from sfmapp.odometry.records import FrameRecord
from sfmapp.odometry.tracker import track

Array = NDArray[np.float64]

# So many are kept, the last ones: two seconds, 30 MB at 752 x 480 while there is no pose.
_MOST = 60
# Following ends where less than that share of the keyframe's points is left: forwards, keyframes with new points would
# have been made before. On the rim of a map poses are still found, and are up to ten times as far off.
_LEAST_LEFT = 0.4


@dataclass(frozen=True)
class Placed:
    """A frame that was missed, its pose (7,) cam_from_world, and the tracks that it was measured with."""

    record: FrameRecord
    pose: Array
    tracks: ActiveTracks


class MissedFrames:
    """The last frames without a pose, up to the present one."""

    def __init__(self) -> None:
        self._kept: deque[tuple[FrameRecord, Pyramid]] = deque(maxlen=_MOST)

    def note(self, record: FrameRecord, pyramid: Pyramid) -> None:
        """This frame has no pose."""
        self._kept.append((record, pyramid))

    def forget(self) -> None:
        """What was missed lies behind."""
        self._kept.clear()

    def reach_back(self, local: LocalMap, keyframe: int) -> list[Placed]:
        """Follow the points of a keyframe backwards through the frames without a pose before it, as far as that goes.

        Args:
            keyframe: position of the keyframe, whose image the map still holds.

        Returns:
            The frames that were found, the last first; the records are not changed.
        """
        tracks, pose, step = local.mapped_tracks_of(keyframe), local.pose(keyframe), rigid3.IDENTITY
        previous, placed, least = local.images[keyframe], list[Placed](), _LEAST_LEFT * len(tracks)
        for record, pyramid in reversed(self._kept):
            if record.has_pose:
                continue
            found = track(local, tracks, pose, step, previous, pyramid)
            if found is None or found.num_inliers < least or not np.isfinite(found.covariance).all():
                break
            step = rigid3.compose(found.pose, rigid3.inverse(pose))
            tracks, pose, previous = found.tracks, found.pose, pyramid
            placed.append(Placed(record, pose, tracks.subset(found.is_mapped)))
        return placed
