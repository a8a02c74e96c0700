"""What is believed of ground control points."""

from __future__ import annotations

from dataclasses import dataclass

from sfmapp.option_checks import check_options, positive


@dataclass(frozen=True)
class ControlOptions:
    """Ground control points, and how good they are where their file does not say.

    Attributes:
        file: OpenDroneMap's gcp_list.txt, or a CSV with columns name, x, y, z, sigma_x, sigma_y, sigma_z, image, px, py
            and sigma_px below a line '# crs: EPSG:25833'; None: none.
        sigma_m: standard deviation of a coordinate along east and along north; a survey by network RTK has 0.02.
        sigma_up_m: of a height.
        sigma_px: of a marked pixel coordinate.
    """

    file: str | None = None
    sigma_m: float = 0.02
    sigma_up_m: float = 0.03
    sigma_px: float = 1.0

    def __post_init__(self) -> None:
        ranges = {"sigma_m": positive(1e6), "sigma_up_m": positive(1e6), "sigma_px": positive(1e6)}
        check_options("control", self, ranges)
