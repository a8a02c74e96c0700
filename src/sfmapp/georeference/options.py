"""What is believed of where photographs were taken."""

from __future__ import annotations

from dataclasses import dataclass

from sfmapp.option_checks import check_options, positive


@dataclass(frozen=True)
class GpsOptions:
    """Positions of photographs, and how good they are.

    Attributes:
        source: exif: what cameras and drones wrote into the files; none: no positions; or a file: OpenDroneMap's
            geo.txt, a CSV of image, latitude, longitude and height, or a track with times, GPX or CSV.
        sigma_m: standard deviation of a position along east and along north; None: as its source says, else 5 m, and
            then as the residuals tell.
        sigma_up_m: of a height; None: as its source says, else twice that of the position.
        time_offset_s: seconds to add to the clock of the photographs to get that of a track, which counts in UTC; what
            is left of it, a minute or so, is estimated where the way of the cameras tells it.
    """

    source: str = "exif"
    sigma_m: float | None = None
    sigma_up_m: float | None = None
    time_offset_s: float = 0.0

    def __post_init__(self) -> None:
        check_options("gps", self, {"sigma_m": positive(1e6), "sigma_up_m": positive(1e6)})
