"""From a video file to a folder with the frames that are taken, and a table of all of them."""

from __future__ import annotations

import io
import math
import re
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from fractions import Fraction
from pathlib import Path
from statistics import median
from typing import NamedTuple

from sfmapp.events import Events
from sfmapp.formats.atomic import replaced_file, write_bytes
from sfmapp.images.containers import (
    Damaged,
    DecodedFrame,
    VideoFacts,
    decoded_frames,
    gray_of,
    open_container,
    rgb_of,
)
from sfmapp.images.frame_reader import read_ahead
from sfmapp.images.video import DEFAULT_FPS, missing_end, read_video_facts
from sfmapp.video.options import VideoOptions
from sfmapp.video.quality import Look, look_at
from sfmapp.video.report import ChosenFrame, LeftFrames, SharpnessCurve, VideoReport
from sfmapp.video.selection import FrameRow, Selector, Taken

STAGE = "video"
TABLE = "frames.csv"
NEAR = "near the last frame that was taken"
_NOT_WANTED = "more than video.max_frames"
# Beside the errors of a video's own compression, those of JPEG at this quality are none.
_JPEG_QUALITY = 95
_CURVE_POINTS = 400
# Phones read the rows of a frame within 10 to 30 ms. A shift of so many pixels is more than keypoints are off.
_READOUT_S, _BENT_PX = 0.02, 2.0


def choose_frames(video: Path, folder: Path, options: VideoOptions, events: Events) -> VideoReport:
    """Choose frames of a video and write them.

    Args:
        video: a file that FFmpeg can read.
        folder: for ``frame_000123.jpg``, numbered as in the video, and ``frames.csv``; what was chosen before goes.
        options: see :class:`VideoOptions`.
        events: told of progress, and of what is wrong with the video.

    Returns:
        The report. It holds nothing that depends on threads, or on the time that anything took but ``wall_s``.

    Raises:
        InputError: it holds no frames that can be decoded, or the folder cannot be written.
        InterruptedRunError: a stop was asked for.
    """
    start = time.monotonic()
    facts = read_video_facts(str(video))
    events.started(STAGE, f"choosing frames of {video.name}", total=facts.num_frames)
    for old in folder.glob("frame_*.jpg"):
        old.unlink()
    kept, selector = _Kept(folder, options.max_frames), Selector[DecodedFrame](options)
    reader, times, is_turned = _Reader(str(video), facts), list[float](), False
    with closing(reader):
        for read in _all(reader):
            events.raise_if_cancelled()
            events.advanced(STAGE)
            times[1:] = [read.time_s]
            if read.look is None or read.frame is None:
                selector.unreadable(read.number, read.time_s, read.fault)
                continue
            is_turned |= any(read.frame.turn)
            kept.put(selector.push(read.number, read.time_s, read.look, read.frame))
    kept.put(selector.end())
    for row in selector.rows:
        row.why = row.why or NEAR
    write_table(folder / TABLE, selector.rows)
    span = (times[0], times[-1]) if times else None
    report = VideoReport(
        video=video.name, folder=folder.name, width=facts.width, height=facts.height, fps=facts.fps,
        num_frames=len(selector.rows), length_s=round(times[-1] - times[0], 3) if times else 0.0, is_turned=is_turned,
        missing_end=missing_end(facts, span, len(selector.rows)), every=kept.every,
        chosen=[_chosen(folder, row) for row in kept.rows], left_out=_left_out(selector.rows),
        breaks_s=[round(at, 3) for at in selector.breaks], curve=_curve(selector.rows),
        bend_px=_bend_px(kept.rows, max(facts.width, facts.height)), wall_s=round(time.monotonic() - start, 3),
    )  # fmt: skip
    _tell(report, events)
    return report


def frame_name(number: int) -> str:
    """The file of a frame. Pairs are chosen by such names: see ``matching/pairs.py::find_sequences``."""
    return f"frame_{number:06d}.jpg"


def write_table(path: Path, rows: Sequence[FrameRow]) -> None:
    """``frames.csv``: a row for each frame of the video."""
    with replaced_file(path) as beside, beside.open("w", encoding="utf-8", newline="\n") as file:
        file.write("frame,time_s,sharpness,parallax,overlap,speed,file,why\n")
        for row in rows:
            values = (row.sharpness, row.parallax, row.overlap, row.speed)
            numbers = ",".join("" if v is None else f"{v:.4f}" for v in values)
            name = frame_name(row.number) if row.is_taken else ""
            file.write(f'{row.number},{row.time_s:.4f},{numbers},{name},"{row.why}"\n')


# ------------------------------------------------------------------------------------------------------ reading


class _Read(NamedTuple):
    """A frame of a video and a look at it; both None where it has a fault."""

    number: int
    time_s: float
    frame: DecodedFrame | None
    look: Look | None
    fault: str = ""


class _Reader:
    """One walk through a video; called from a thread that reads ahead."""

    def __init__(self, video: str, facts: VideoFacts) -> None:
        self._facts = facts
        self._container = open_container(video, is_stream=False)
        self._frames = decoded_frames(self._container)
        self._number, self._last_s = -1, -math.inf

    def close(self) -> None:
        """Give the file back."""
        self._frames.close()  # type: ignore[attr-defined]  # a generator
        self._container.close()

    def __call__(self) -> _Read | None:
        item = next(self._frames, None)
        if item is None:
            return None
        self._number += 1
        at = self._time(None if isinstance(item, Damaged) else item.time_s)
        if isinstance(item, Damaged):
            return _Read(self._number, at, None, None, "damaged: it cannot be decoded")
        gray = gray_of(item)
        if gray.shape != (self._facts.height, self._facts.width):
            fault = f"{gray.shape[1]}x{gray.shape[0]} pixels, where the video began with other ones"
            return _Read(self._number, at, None, None, fault)
        return _Read(self._number, at, item, look_at(gray))

    def _time(self, time_s: Fraction | None) -> float:
        """As the file says, as long as it advances; else by the rate."""
        if time_s is not None and float(time_s) > self._last_s:
            self._last_s = float(time_s)
        else:
            self._last_s = max(self._last_s, -1 / (self._facts.fps or DEFAULT_FPS)) + 1 / (
                self._facts.fps or DEFAULT_FPS
            )
        return self._last_s


def _all(reader: _Reader) -> Iterator[_Read]:
    with closing(read_ahead(reader)) as reads:  # type: ignore[type-var]  # a generator
        yield from reads


# ------------------------------------------------------------------------------------------------------ writing


class _Kept:
    """The frames on the disk, no more than so many: else every second one goes, and of those to come."""

    def __init__(self, folder: Path, most: int) -> None:
        self.rows: list[FrameRow] = []
        self.every = 1
        self._folder, self._most, self._count = folder, most, 0

    def put(self, taken: Iterator[Taken[DecodedFrame]]) -> None:
        for one in taken:
            self._count += 1
            if (self._count - 1) % self.every:
                self._leave(one.row)
                continue
            write_bytes(self._folder / frame_name(one.row.number), _jpeg(one.held))
            self.rows.append(one.row)
            if len(self.rows) > self._most:
                self.every *= 2
                for row in self.rows[1::2]:
                    (self._folder / frame_name(row.number)).unlink()
                    self._leave(row)
                self.rows = self.rows[::2]

    def _leave(self, row: FrameRow) -> None:
        row.is_taken, row.why = False, _NOT_WANTED


def _jpeg(frame: DecodedFrame) -> bytes:
    import cv2  # noqa: F401  # before Pillow and whatever comes after it: their libraries do not bear another order
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(rgb_of(frame)).save(out, "JPEG", quality=_JPEG_QUALITY, subsampling=0)
    return out.getvalue()


# ------------------------------------------------------------------------------------------------------ telling


def _chosen(folder: Path, row: FrameRow) -> ChosenFrame:
    return ChosenFrame(
        name=f"{folder.name}/{frame_name(row.number)}", number=row.number, time_s=round(row.time_s, 4),
        sharpness=round(row.sharpness or 0.0, 4), parallax=row.parallax and round(row.parallax, 4),
        overlap=row.overlap and round(row.overlap, 4), why=row.why,
    )  # fmt: skip


def _left_out(rows: Sequence[FrameRow]) -> list[LeftFrames]:
    """By reason, whatever the frame is that a reason names."""
    first: dict[str, float] = {}
    counts: Counter[str] = Counter()
    for row in rows:
        if not row.is_taken:
            reason = re.sub(r"frame \d+", "another frame", row.why)
            first.setdefault(reason, row.time_s)
            counts[reason] += 1
    return [LeftFrames(reason=name, count=n, first_s=round(first[name], 3)) for name, n in counts.most_common()]


def _curve(rows: Sequence[FrameRow]) -> SharpnessCurve:
    judged = [row for row in rows if row.sharpness is not None]
    step = -(-len(judged) // _CURVE_POINTS) or 1
    parts = [judged[k : k + step] for k in range(0, len(judged), step)]
    return SharpnessCurve(
        time_s=[round(median(row.time_s for row in part), 3) for part in parts],
        median=[round(median(row.sharpness or 0.0 for row in part), 4) for part in parts],
    )


def _bend_px(rows: Sequence[FrameRow], side_px: int) -> tuple[float, float] | None:
    speeds = sorted(row.speed for row in rows if row.speed is not None)
    if not speeds:
        return None
    middle, most = (speeds[int(share * (len(speeds) - 1))] for share in (0.5, 0.9))
    return round(_READOUT_S * side_px * middle, 2), round(_READOUT_S * side_px * most, 2)


def _tell(report: VideoReport, events: Events) -> None:
    video = report.video
    if report.missing_end:
        events.warned(STAGE, f"{video} ends too early, {report.missing_end}: it was cut off, or its end is damaged")
    if report.breaks_s:
        some = ", ".join(f"{at:.1f} s" for at in report.breaks_s[:5]) + (", ..." if len(report.breaks_s) > 5 else "")
        events.warned(
            STAGE, f"{video} breaks off at {some}: a cut, or a motion too fast to be followed. What is on both sides "
            "comes together only where it is seen again", breaks_s=report.breaks_s,
        )  # fmt: skip
    if report.every > 1:
        events.warned(
            STAGE, f"{video}: one of {report.every} frames that were due was taken, for video.max_frames: they may be "
            "too far apart to be matched",
        )  # fmt: skip
    if report.is_turned:
        events.decided(STAGE, f"{video}: frames are turned upright, as the file asks for")
    if report.bend_px is not None and report.bend_px[0] > _BENT_PX:
        events.warned(
            STAGE, f"{video}: points move fast at the frames that were taken: a rolling shutter that reads a frame in "
            f"20 ms bends them by {report.bend_px[0]:.1f} px (a tenth of them by {report.bend_px[1]:.1f} px or more), "
            "which nothing takes back; a global shutter does not", bend_px=report.bend_px,
        )  # fmt: skip
    for left in report.left_out:
        if left.reason in ("black", "over-exposed", "without contrast") or left.reason.startswith("damaged"):
            events.decided(STAGE, f"{video}: {left.count} frames are {left.reason}, from {left.first_s:.1f} s on")
    with suppress(IndexError):
        events.finished(
            STAGE, f"{video}: {len(report.chosen)} of {report.num_frames} frames, {report.chosen[0].time_s:.1f} to "
            f"{report.chosen[-1].time_s:.1f} s", num_chosen=len(report.chosen), num_frames=report.num_frames,
        )  # fmt: skip
