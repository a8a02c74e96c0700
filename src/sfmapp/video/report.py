"""What the choice of frames says of itself."""

from __future__ import annotations

from collections.abc import Sequence

from sfmapp.reporting import Report


class ChosenFrame(Report):
    """A frame that is one of the photographs.

    Attributes:
        name: of its file, as the images of the run are named.
        number: in the video, from 0. time_s: in the video.
        sharpness: comparable between neighbours alone.
        parallax, overlap: against the one before it, as shares; None of the first.
        why: it was taken there.
    """

    name: str
    number: int
    time_s: float
    sharpness: float
    parallax: float | None
    overlap: float | None
    why: str


class LeftFrames(Report):
    """Frames that were left out for one reason, how many, and the time of the first of them."""

    reason: str
    count: int
    first_s: float


class SharpnessCurve(Report):
    """Sharpness along a video, in stretches of equal length: the median of each, of those that have frames.

    Attributes:
        time_s: the middle of each. median: of its frames.
    """

    time_s: Sequence[float]
    median: Sequence[float]


class VideoReport(Report):
    """Which frames of a video were taken, and why the others were not.

    Attributes:
        video: its name. folder: of its frames, below the folder of the photographs.
        width, height: pixels of the frames. fps: as the file says; None: it does not.
        num_frames, length_s: that could be read.
        is_turned: the file says that pictures are to be turned, and they were.
        missing_end: how much there was of a file that ends too early; empty of a whole one.
        every: of the places where a frame was due, this one of so many was taken, for ``video.max_frames``.
        chosen: frames, in order.
        left_out: other frames, by reason, the most frequent first.
        breaks_s: times at which the picture has nothing of the one before.
        curve: of the sharpness.
        bend_px: how far the first and the last row of a chosen frame are shifted against each other by a rolling
            shutter that reads it in 20 ms: median, and what a tenth of the frames exceed; None: nothing was followed.
        key: of the video and the options that this was made with.
    """

    video: str
    folder: str
    width: int
    height: int
    fps: float | None
    num_frames: int
    length_s: float
    is_turned: bool
    missing_end: str
    every: int
    chosen: Sequence[ChosenFrame]
    left_out: Sequence[LeftFrames]
    breaks_s: Sequence[float]
    curve: SharpnessCurve
    bend_px: Sequence[float] | None
    wall_s: float
    key: str = ""
