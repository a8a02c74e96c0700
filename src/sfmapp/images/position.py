"""Where a photograph was taken, as something beside its pixels says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Position:
    """A measured place of a camera's centre.

    Attributes:
        latitude_deg, longitude_deg: on WGS84.
        height_m: None where unknown.
        heights: what it is above: the ellipsoid, a geoid (sea level), or one knows not what.
        sigma_m: standard deviation along east and along north; None: not said.
        sigma_up_m: of the height; None: not said.
        is_stated: the sigmas are meant as such, and are no more than weights otherwise.
        source: ``EXIF``, ``XMP``, or file and line.
        attitude_deg: yaw (of the optical axis, from north to east), pitch (up is positive) and roll of the camera, as
            the gimbal of a drone says; None: not known.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float | None
    heights: Literal["ellipsoidal", "orthometric", "unknown"] = "unknown"
    sigma_m: float | None = None
    sigma_up_m: float | None = None
    is_stated: bool = False
    source: str = "EXIF"
    attitude_deg: tuple[float, float, float] | None = None

    @property
    def gps(self) -> tuple[float, float, float | None]:
        """Latitude, longitude and height alone."""
        return self.latitude_deg, self.longitude_deg, self.height_m
