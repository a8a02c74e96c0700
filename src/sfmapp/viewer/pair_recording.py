"""From the story of a pair to ``recording.rrd``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.dlt import homogeneous
from sfmapp.twoview.drawing import clip_lines, spread, spread_points, with_reach
from sfmapp.twoview.story import Story
from sfmapp.viewer.pair_replay import PairReplay
from sfmapp.viewer.photos import shrunk
from sfmapp.viewer.recording import RecordingReport, record_in_child

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

_SHOWN_PX = 1200
_KEYPOINTS, _MATCHES, _LINES, _POINTS = 3000, 400, 20, 4000


def record_pair(path: Path, story: Story, pictures: tuple[Pixels, Pixels]) -> RecordingReport:
    """Write a recording in a child process; never raises for what happens there.

    Args:
        pictures: (H, W, 3) RGB of both photographs as stored.
    """
    return record_in_child(path, "pair", lambda _: _replay(story, pictures), timeout_s=120.0)


def _replay(story: Story, pictures: tuple[Pixels, Pixels]) -> PairReplay:
    views, told = story.views, story.report
    small, scale = zip(*(shrunk(picture, _SHOWN_PX) for picture in pictures), strict=True)
    first, second = (view.xy * s for view, s in zip(views, scale, strict=True))

    def pairs(matches: NDArray[np.int32], kept: NDArray[np.int64]) -> Array:
        return np.column_stack([first[matches[kept, 0]], second[matches[kept, 1]]])

    mutual = spread(len(story.putative), _MATCHES)
    shown = story.used[spread_points(views[0].xy[story.used[:, 0]], _LINES)]
    lines = [np.full((len(shown), 2, 2), np.nan)] * 2
    if len(shown):
        one, two = (homogeneous(view.xy[shown[:, side]]) for side, view in enumerate(views))
        normals = two @ story.fundamental, one @ story.fundamental.T
        lines = [
            clip_lines(each, (view.camera.width, view.camera.height)) * s
            for each, view, s in zip(normals, views, scale, strict=True)
        ]
    found = [told.epipoles.first, told.epipoles.second] if told.epipoles is not None else [None, None]
    points = spread(story.points.shape[1], _POINTS)
    return PairReplay(
        title=f"{views[0].name} and {views[1].name}", names=[view.name for view in views], story=_words(story),
        picture1=small[0], picture2=small[1],
        keypoints1=first[:_KEYPOINTS], keypoints2=second[:_KEYPOINTS],
        nearest=pairs(story.nearest, spread(len(story.nearest), _MATCHES)),
        ratio=pairs(story.ratio, spread(len(story.ratio), _MATCHES)),
        mutual=pairs(story.putative, mutual), is_own=story.is_own[mutual],
        points=pairs(shown, np.arange(len(shown))), lines1=lines[0], lines2=lines[1],
        epipoles=np.array([[np.nan] * 2 if e is None else np.array(e) * s for e, s in zip(found, scale, strict=True)]),
        poses=story.poses, clouds=story.points[:, points], in_front=story.in_front[:, points],
        reach=with_reach(story), labels=_labels(story),
    )  # fmt: skip


def _labels(story: Story) -> list[str]:
    choice = story.report.choice
    if choice is None:
        return []
    return [
        f"Pose {n + 1}: {pose.num_in_front} of {choice.num_points} in front"
        + (" (chosen)" if n == choice.best and not choice.reason else "")
        for n, pose in enumerate(choice.poses)
    ]


def _words(story: Story) -> str:
    told = story.report
    lines = [f"# {told.kind.capitalize()}", told.kind_reason]
    if told.ended:
        lines.append(f"**The story ends early.** {told.ended}")
    if told.choice is not None and told.choice.reason:
        lines.append(f"**Undecidable.** {told.choice.reason}")
    lines.append(
        "Step 0: nearest neighbours; 1: after the ratio test; 2: mutual; 3: on one epipolar geometry (green), or not "
        "(red)."
    )
    return "\n\n".join(lines)
