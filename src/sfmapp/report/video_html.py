"""What was chosen of videos, for the page of a reconstruction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from sfmapp.report.page import table
from sfmapp.report.plots import Curve, plot_svg
from sfmapp.video.report import VideoReport

STRIP_LENGTH = 24
"""Most frames of a video that are shown."""


def frames_of_strip(report: VideoReport) -> list[str]:
    """Names of the frames that are shown: all, or so many spread evenly over them."""
    count = len(report.chosen)
    if not count:
        return []
    return [report.chosen[k].name for k in np.unique(np.linspace(0, count - 1, min(count, STRIP_LENGTH)).astype(int))]


def videos_section(reports: Sequence[VideoReport], pictures: Mapping[str, str]) -> str:
    """For each video the frames that were chosen, its sharpness, and what was left out.

    Args:
        pictures: URLs of the frames that are shown, by name.
    """
    return "<h2>Videos</h2>" + "".join(_video(report, pictures) for report in reports)


def _video(report: VideoReport, pictures: Mapping[str, str]) -> str:
    of_time = {one.name: one for one in report.chosen}
    strip = "".join(
        f'<img src="{pictures[name]}" title="{escape(_title(of_time[name].time_s, of_time[name].why))}" '
        f'alt="{escape(name)}" style="height:84px;margin:0 3px 3px 0">'
        for name in frames_of_strip(report)
        if name in pictures
    )
    shown = len(frames_of_strip(report))
    note = f" {shown} of them, evenly spread:" if shown < len(report.chosen) else ""
    return (
        f"<h3>{escape(report.video)}</h3><p>{escape(_headline(report))}{note}</p><p>{strip}</p>{_curve(report)}"
        + table(
            [("t", "left out"), ("", "frames"), ("", "first, s")],
            [[("t", one.reason), ("", one.count), ("", f"{one.first_s:.1f}")] for one in report.left_out],
        )
    )


def _title(time_s: float, why: str) -> str:
    return f"{time_s:.2f} s: {why}"


def _headline(report: VideoReport) -> str:
    rate = f" at {report.fps:.4g} frames a second" if report.fps else ""
    text = (
        f"{len(report.chosen)} of {report.num_frames} frames were chosen, of {report.length_s:.1f} s, "
        f"{report.width}x{report.height}{rate}."
    )
    if report.is_turned:
        text += " They are turned upright, as the file asks for."
    if report.missing_end:
        text += f" The video ends too early, {report.missing_end}."
    if report.breaks_s:
        times = ", ".join(f"{at:.1f} s" for at in report.breaks_s)
        text += f" It breaks off at {times}: a cut, or a motion too fast to be followed."
    if report.bend_px is not None:
        text += (
            " A rolling shutter that reads a frame in 20 ms would shift its first and last row against each other by "
            f"{report.bend_px[0]:.2g} px (those of a tenth of the frames by {report.bend_px[1]:.2g} px or more), which "
            "nothing takes back."
        )
    if report.every > 1:
        text += f" One of {report.every} frames that were due was taken, for video.max_frames."
    return text


def _curve(report: VideoReport) -> str:
    """Sharpness over time, with that of the chosen frames; breaks are shaded."""
    time_s = np.array(report.curve.time_s)
    if len(time_s) < 2:
        return ""
    chosen = np.full(len(time_s), np.nan)
    for one in report.chosen:
        k = int(np.abs(time_s - one.time_s).argmin())
        chosen[k] = np.nanmax([chosen[k], one.sharpness])
    known = np.flatnonzero(np.isfinite(chosen))
    between = np.interp(np.arange(len(time_s)), known, chosen[known]) if len(known) else chosen
    curves = [
        Curve("sharpness of all", np.array(report.curve.median), "#8a94a6"),
        Curve("of those chosen", between, "#2f6fdb"),
    ]
    return plot_svg(time_s, curves, [(at, at) for at in report.breaks_s], "seconds")
