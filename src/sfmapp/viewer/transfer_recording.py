"""From three photographs to ``recording.rrd``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.dlt import homogeneous
from sfmapp.twoview.drawing import clip_lines, spread_points
from sfmapp.uncalibrated.three_views import ThreeViews, TransferReport
from sfmapp.viewer.photos import shrunk
from sfmapp.viewer.recording import RecordingReport, record_in_child
from sfmapp.viewer.transfer_replay import TransferReplay

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

_SHOWN_PX, _POINTS = 1200, 16


def record_transfer(
    path: Path, told: TransferReport, views: ThreeViews, pictures: tuple[Pixels, Pixels, Pixels, Pixels]
) -> RecordingReport:
    """Write a recording in a child process; never raises for what happens there.

    Args:
        pictures: (H, W, 3) RGB of the photographs as stored, and the synthesised one.
    """
    return record_in_child(path, "transfer", lambda _: _replay(told, views, pictures), timeout_s=120.0)


def _replay(told: TransferReport, views: ThreeViews, pictures: tuple[Pixels, Pixels, Pixels, Pixels]) -> TransferReplay:
    small, scales = zip(*(shrunk(picture, _SHOWN_PX) for picture in pictures), strict=True)
    shown = views.xy[spread_points(views.xy[:, 2], _POINTS)]
    f21, f31, f32 = (np.array(f) for f in (told.fundamental_21, told.fundamental_31, told.fundamental_32))
    one, two = homogeneous(shown[:, 0]), homogeneous(shown[:, 1])
    lines2 = clip_lines(one @ f21.T, told.sizes[1]) * scales[1]
    lines31, lines32, plane = (
        clip_lines(lines, told.sizes[2]) * scales[2]
        for lines in (one @ f31.T, two @ f32.T, np.array([told.trifocal_line]))
    )
    return TransferReplay(
        f"{told.names[0]} and {told.names[1]} in {told.names[2]}", list(told.names), _words(told),
        small[0], small[1], small[2], small[3], shown * np.array(scales[:3]), lines2, lines31, lines32, plane,
    )  # fmt: skip


def _words(told: TransferReport) -> str:
    lines = ["# A third view, with no calibration"]
    lines += [
        f"{way.name}: {way.num_points - way.num_refused} of {way.num_points} told, median {way.median_px:.2f} px"
        for way in told.ways
    ]
    if told.degenerate:
        lines.append(f"**{told.degenerate}**")
    lines.append("In photograph 3 two lines of one colour cross in each point; grey: the trifocal plane.")
    return "\n\n".join(lines)
