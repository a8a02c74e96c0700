"""What kind of pair two photographs are, in one word and in a sentence."""

from __future__ import annotations

import numpy as np

from sfmapp.geometry import rigid3
from sfmapp.matching.stage import MatchedPair
from sfmapp.scene.correspondences import TwoViewConfig
from sfmapp.twoview.report import StoryReport
from sfmapp.twoview.view import View

# Matches of a picture with a copy that was saved again scatter by less than a keypoint is good for, and do not move on
# the whole.
_SAME_PX, _STILL_PX = 0.5, 0.1
# Cosine of 30 degrees: the camera went along its axis rather than across it.
_FORWARD = 0.866


def kind_of_pair(story: StoryReport, views: tuple[View, View], pair: MatchedPair) -> tuple[str, str]:
    """One of the words of :class:`~sfmapp.twoview.report.StoryReport`, and why."""
    matches, config = pair.matches, TwoViewConfig(pair.geometry.config)
    if len(matches):
        shift = views[0].xy[matches[:, 0]] - views[1].xy[matches[:, 1]]
        scatter, move = np.median(np.linalg.norm(shift, axis=1)), np.linalg.norm(np.median(shift, axis=0))
        if scatter < _SAME_PX and move < _STILL_PX:
            return "identical", (
                "matches lie at the same pixels in both: one picture twice, or a camera that did not move"
            )
    if config == TwoViewConfig.WATERMARK:
        return "watermark", "nearly all matches lie near the border and moved alike: something that was written on both"
    if config == TwoViewConfig.PANORAMIC:
        turn = float(rigid3.rotation_angle_deg(rigid3.rotation_matrix(pair.geometry.cam2_from_cam1)))
        return "rotation", (
            f"a turn by {turn:.1f} degrees on the spot explains the matches: there is no parallax, and no depth to be "
            "had"
        )
    if config in (TwoViewConfig.PLANAR, TwoViewConfig.PLANAR_OR_PANORAMIC):
        share = f"{story.homography.share:.0%} of" if story.homography else "most of"
        return "plane", (
            f"one homography explains {share} the matches, and no rotation does: they lie on a plane, seen from two "
            "places"
        )
    if config not in (TwoViewConfig.CALIBRATED, TwoViewConfig.UNCALIBRATED, TwoViewConfig.MULTIPLE):
        return "unknown", "no model explains enough matches to be more than chance"
    pose = pair.geometry.cam2_from_cam1
    center = rigid3.center(pose) if np.isfinite(pose).all() else np.zeros(3)
    if abs(center[2]) > _FORWARD and story.epipoles is not None and all(story.epipoles.is_inside):
        way = "towards" if center[2] > 0 else "away from"
        return "forward", (
            f"the camera went along its axis, {way} the scene, and the epipoles lie in both pictures: near these there "
            "is little parallax"
        )
    return "general", "a scene with depth, seen from two places"
