"""Options of choosing frames of a video."""

from __future__ import annotations

from dataclasses import dataclass

from sfmapp.option_checks import Range, check_options

_RANGES = {"parallax": Range(0.002, 0.2), "overlap": Range(0.3, 0.98), "max_frames": Range(2, 100_000)}


@dataclass(frozen=True)
class VideoOptions:
    """Which frames of videos are taken for photographs.

    Attributes:
        parallax: a frame is taken where the mean parallax of the points followed since the last one reaches this
            share of the longer side of the picture, whatever the camera has turned.
        overlap: or where this share of the picture is left of what the last one showed.
        max_frames: most frames of one video; where there would be more, every second one is left out, or more.
    """

    parallax: float = 0.02
    overlap: float = 0.8
    max_frames: int = 1200

    def __post_init__(self) -> None:
        check_options("video", self, _RANGES)
