"""Positions on the Earth: the ellipsoid WGS84, geocentric coordinates, and local frames in metres with z up.

Geodetic positions are (N, 3) float64: latitude and longitude in degrees, height above the ellipsoid in metres.
Geocentric ones (ECEF) are (N, 3) in metres: x to the Greenwich meridian in the equator's plane, z to the north pole. A
local frame has x east, y north, z up along the ellipsoid's normal at its origin. What comes back after a round trip
differs by the rounding of double precision at the Earth's radius, about 1e-9 m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# NIMA TR8350.2: semi-major axis in metres, and flattening
SEMI_MAJOR_M, FLATTENING = 6378137.0, 1.0 / 298.257223563
SEMI_MINOR_M = SEMI_MAJOR_M * (1.0 - FLATTENING)
ECCENTRICITY2 = FLATTENING * (2.0 - FLATTENING)


def ecef_from_geodetic(geodetic: ArrayLike) -> Array:
    """Geocentric coordinates (N, 3) of geodetic positions (N, 3)."""
    latitude, longitude, height = np.moveaxis(np.asarray(geodetic, np.float64), -1, 0)
    sin, cos = np.sin(np.radians(latitude)), np.cos(np.radians(latitude))
    across = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY2 * sin**2)  # radius of curvature in the prime vertical
    flat = (across + height) * cos
    turn = np.radians(longitude)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), (across * (1.0 - ECCENTRICITY2) + height) * sin], -1)


def geodetic_from_ecef(ecef: ArrayLike) -> Array:
    """Geodetic positions (N, 3) of geocentric coordinates (N, 3), for heights above -5,000 km.

    Bowring, "Transformation from spatial to geographical coordinates", Survey Review 23(181), 1976, repeated: two
    rounds reach the rounding of doubles up to 10,000 km above the ground; a third costs nothing that shows.
    """
    x, y, z = np.moveaxis(np.asarray(ecef, np.float64), -1, 0)
    flat = np.hypot(x, y)
    second2 = ECCENTRICITY2 / (1.0 - ECCENTRICITY2)
    reduced = np.arctan2(z * SEMI_MAJOR_M, flat * SEMI_MINOR_M)
    for _ in range(3):
        latitude = np.arctan2(
            z + second2 * SEMI_MINOR_M * np.sin(reduced) ** 3,
            flat - ECCENTRICITY2 * SEMI_MAJOR_M * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2((1.0 - FLATTENING) * np.sin(latitude), np.cos(latitude))
    sin, cos = np.sin(latitude), np.cos(latitude)
    # holds at the poles and the equator alike, where the usual quotients do not
    height = flat * cos + z * sin - SEMI_MAJOR_M * np.sqrt(1.0 - ECCENTRICITY2 * sin**2)
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height], -1)


@dataclass(frozen=True)
class LocalFrame:
    """An east-north-up frame in metres.

    Attributes:
        latitude_deg, longitude_deg, height_m: its origin on WGS84.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float

    @property
    def enu_from_ecef(self) -> Array:
        """(3, 3) rotation; its rows are east, north and up in geocentric axes."""
        latitude, longitude = np.radians(self.latitude_deg), np.radians(self.longitude_deg)
        sin_b, cos_b, sin_l, cos_l = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
        return np.array(
            [[-sin_l, cos_l, 0.0], [-sin_b * cos_l, -sin_b * sin_l, cos_b], [cos_b * cos_l, cos_b * sin_l, sin_b]]
        )

    @property
    def origin_ecef(self) -> Array:
        """(3,) metres."""
        return ecef_from_geodetic([self.latitude_deg, self.longitude_deg, self.height_m])

    def enu_from_geodetic(self, geodetic: ArrayLike) -> Array:
        """(N, 3) metres east, north and up of geodetic positions (N, 3)."""
        return (ecef_from_geodetic(geodetic) - self.origin_ecef) @ self.enu_from_ecef.T

    def geodetic_from_enu(self, enu: ArrayLike) -> Array:
        """Geodetic positions (N, 3) of places (N, 3) in the frame."""
        return geodetic_from_ecef(np.asarray(enu, np.float64) @ self.enu_from_ecef + self.origin_ecef)
