"""Something that moves and fills much of the view: what a map should see there and does not, and what does not follow.

The poses of a map that is right explain nearly all that is followed from frame to frame, and points that should be in
sight are found again. Both fail at once where something comes between: the points behind it are not found, and what is
on it follows another motion. Once it fills most of the view, that motion is taken for the camera's, and the points that
were in the map before are the only witnesses. They are counted here.

In a blurred picture points are missing too. Reduced to a quarter of its size it shows them where they should be,
though, which nothing does that is behind something else. Such points speak against no pose; they only say that what was
measured there is smeared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.contradictions import Contradiction
from sfmapp.odometry.map.keyframe_map import KeyframeMap

Array = NDArray[np.float64]

# Frames, and keyframes, that are judged together; fewest tracks in them.
_FRAMES, _KEYFRAMES, _MIN_TRACKS = 5, 3, 100
# Of the tracks that are found, those that do not follow the measured motion. Without anything large that moves it is at
# most 16 % on rendered and real sequences (cars in streets included), with something over half of the view 55 to 94 %.
_MAX_REJECTED = 0.3
# Of the points that should be in sight, those that are found. There it is at least 62 %, behind something 15 to 45 %.
_MIN_VISIBLE = 0.5
# What all of it going wrong would add to positions, as a share of their spread, and to rotations: half a view that
# moves has bent trajectories by up to their own spread.
_POSITION_SHARE, _ROTATION_DEG = 0.5, 15.0
# The same of all of it being blurred. Positions of four flights that were exposed for 25 ms, and of which a third to a
# half of the points was found, were off by 1.0 to 5.9 % of their spread, two to fifteen of their own sigmas.
_BLURRED_POSITION_SHARE, _BLURRED_ROTATION_DEG = 0.05, 1.5


@dataclass(frozen=True)
class _Count:
    """How many of something agree with the map at a frame."""

    frame_idx: int
    num: int
    num_good: int


class Witnesses:
    """Counts what agrees with a map while it grows, and says where too little did."""

    def __init__(self) -> None:
        self._followed, self._visible, self._sharp = list[_Count](), list[_Count](), list[_Count]()

    def followed(self, frame_idx: int, num_found: int, num_kept: int) -> None:
        """Of the tracks found in a frame so many agree with its pose, or with the epipolar lines that it makes."""
        self._followed.append(_Count(frame_idx, num_found, num_kept))

    def misses(self, num_expected: int, num_found: int) -> bool:
        """Whether a keyframe that finds so few of the points that it should see has something to explain."""
        return num_found < _MIN_VISIBLE * num_expected

    def visible(self, frame_idx: int, num_expected: int, num_found: int, num_blurred: int = 0) -> None:
        """Of the points that a keyframe should see so many are found, and so many more are there, if blurred."""
        self._sharp.append(_Count(frame_idx, num_expected, num_found))
        self._visible.append(_Count(frame_idx, num_expected, num_found + num_blurred))

    def contradictions(self, keyframes: KeyframeMap) -> list[Contradiction]:
        """What speaks against a map."""
        first, last = keyframes.keyframes[0].frame_idx, keyframes.keyframes[-1].frame_idx
        followed, visible, sharp = (
            [c for c in counts if first <= c.frame_idx <= last]
            for counts in (self._followed, self._visible, self._sharp)
        )
        kept, frames = _least(followed, _FRAMES, 1 - _MAX_REJECTED)
        _, hidden = _least(visible, _KEYFRAMES, _MIN_VISIBLE)
        found, missing = _least(sharp, _KEYFRAMES, _MIN_VISIBLE)
        if frames or hidden:  # what covers a view may look like what is behind it here and there
            return [_moves(kept, found, frames, missing)]
        return [_blurred(found, missing)] if missing else []


def _moves(kept: float, seen: float, frames: list[int], missing: list[int]) -> Contradiction:
    """So small a share of the tracks follows the camera in some frames, and of the points is found in others."""
    where, said = sorted(frames + missing), list[str]()
    if frames:
        said.append(f"{1 - kept:.0%} of the tracks that are found there do not follow the camera's motion")
    if missing:
        said.append(f"{seen:.0%} of the points that should be in sight are found")
    message = f"something moves or covers the view in frames {where[0]} to {where[-1]}: {', '.join(said)}"
    advice = "leave these frames out (--start, --stop), or cover what moves or is fixed to the camera"
    evidence = {
        "first_frame": where[0], "last_frame": where[-1], "share_followed": kept, "share_visible": seen,
        "min_followed": 1 - _MAX_REJECTED, "min_visible": _MIN_VISIBLE,
    }  # fmt: skip
    extent = max(1 - kept, 1 - seen)
    share = _POSITION_SHARE * extent
    return Contradiction("what moves", message, advice, evidence, _ROTATION_DEG * extent, share, share)


def _blurred(found: float, where: list[int]) -> Contradiction:
    """So small a share of the points is found in some frames, and most of the others are there, if blurred."""
    message = (
        f"the picture is blurred in frames {where[0]} to {where[-1]}: {found:.0%} of the points that should be in "
        "sight are found, most others only when it is reduced to a quarter of its size"
    )
    advice = "expose for a shorter time, in more light or with a higher gain, or move more slowly"
    evidence = {
        "first_frame": where[0], "last_frame": where[-1], "share_sharp": found, "min_visible": _MIN_VISIBLE,
    }  # fmt: skip
    share = _BLURRED_POSITION_SHARE * (1 - found)
    return Contradiction("sharpness", message, advice, evidence, _BLURRED_ROTATION_DEG * (1 - found), share, share)


def _least(counts: list[_Count], together: int, limit: float) -> tuple[float, list[int]]:
    """The least share of what agrees over so many counts in a row, and the frames that bring it below a limit."""
    if len(counts) < together:
        return 1.0, []
    num, good = (np.array(values, float) for values in ([c.num for c in counts], [c.num_good for c in counts]))
    several, agree = (np.lib.stride_tricks.sliding_window_view(values, together).sum(1) for values in (num, good))
    share = np.where(several >= _MIN_TRACKS, agree / np.maximum(several, 1), 1.0)
    is_below = np.convolve(share < limit, np.ones(together)) > 0
    return float(share.min()), [counts[n].frame_idx for n in np.flatnonzero(is_below & (good < limit * num))]
