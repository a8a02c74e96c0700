"""Coordinate systems by their EPSG codes, by pyproj (``pip install 'sfmapp[geo]'``).

Coordinates are easting, northing, height, or longitude, latitude, height, in this order whatever the system's own is.
Heights are ellipsoidal where the system is three-dimensional, orthometric (above a geoid) where it has a vertical part,
and of neither kind by the system where it is two-dimensional: they are then taken as they stand, and called unknown.
WGS84 in degrees needs no pyproj.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.errors import InputError
from sfmapp.packages import require

Array = NDArray[np.float64]
HeightReference = Literal["ellipsoidal", "orthometric", "unknown"]

WGS84 = "EPSG:4326"
WGS84_3D = "EPSG:4979"
_ADVICE = "name it by its EPSG code, such as EPSG:32633 (UTM zone 33 north), or EPSG:4326 (degrees); see epsg.io"
_UTM = re.compile(r"WGS ?84 UTM (\d{1,2}) ?([NS])", re.IGNORECASE)
_EPSG = re.compile(r"(?:EPSG:)?(\d{4,6}(?:\+\d{4,6})?)", re.IGNORECASE)


@dataclass(frozen=True)
class CoordinateSystem:
    """What coordinates of other programs mean. Make it with :func:`coordinate_system`.

    Attributes:
        code: as it was named, such as ``EPSG:32633``.
        name: of the system.
        is_geographic: longitudes and latitudes in degrees.
        unit: of the horizontal coordinates: ``metre``, ``degree``, ``US survey foot`` and so on.
        height_unit: of heights.
        heights: what heights are above.
    """

    code: str
    name: str
    is_geographic: bool
    unit: str
    height_unit: str
    heights: HeightReference

    def check_metres(self, place: str) -> None:
        """Refuse what is not in metres: where distances are to be measured in these coordinates.

        Args:
            place: begins the message: file and line, or the option.

        Raises:
            InputError: degrees or feet.
        """
        found = [unit for unit in (self.unit, self.height_unit) if unit != "metre"]
        if found:
            units = found[0].replace("foot", "feet") if "foot" in found[0] else f"{found[0]}s"
            raise InputError(
                f"{place}: expected a coordinate system in metres, found {self.code} ({self.name}) in {units}",
                "choose a projected system in metres, such as the UTM zone of the place",
            )

    @property
    def wkt(self) -> str:
        """The system in the words of OGC 01-009, as LAS wants it; of a three-dimensional one the horizontal part."""
        require("pyproj")
        import pyproj

        found = pyproj.CRS.from_user_input(self.code)
        text: str = (found if found.is_compound else found.to_2d()).to_wkt("WKT1_GDAL")
        return text

    def geodetic(self, coordinates: ArrayLike, place: str | Sequence[str] = "coordinates") -> Array:
        """Geodetic positions (N, 3) on WGS84, latitude, longitude and height, of coordinates (N, 3).

        Args:
            place: begins a message: where they are from; N of them for coordinates that are each from a line of a file.

        Raises:
            InputError: coordinates are outside of the system's domain, or a geoid is needed that is not installed.
        """
        values = np.asarray(coordinates, np.float64).reshape(-1, 3)
        if self.code == WGS84 or self.code == WGS84_3D:
            _check_degrees(values, place)
            return values[:, [1, 0, 2]]
        x, y, z = _transformer(self.code, WGS84_3D, self.heights).transform(*values.T)
        return _checked(np.column_stack([y, x, z if self.heights != "unknown" else values[:, 2]]), self, place)

    def coordinates(self, geodetic: ArrayLike, place: str = "coordinates") -> Array:
        """Coordinates (N, 3) in this system of geodetic positions (N, 3) on WGS84.

        Raises:
            InputError: as :meth:`geodetic`.
        """
        values = np.asarray(geodetic, np.float64).reshape(-1, 3)
        if self.code == WGS84 or self.code == WGS84_3D:
            return values[:, [1, 0, 2]]
        x, y, z = _transformer(WGS84_3D, self.code, self.heights).transform(values[:, 1], values[:, 0], values[:, 2])
        return _checked(np.column_stack([x, y, z if self.heights != "unknown" else values[:, 2]]), self, place)


_DEGREES = CoordinateSystem(WGS84, "WGS 84", True, "degree", "metre", "unknown")
_DEGREES_3D = CoordinateSystem(WGS84_3D, "WGS 84", True, "degree", "metre", "ellipsoidal")


def coordinate_system(text: str, place: str) -> CoordinateSystem:
    """The coordinate system that a text names.

    Args:
        text: an EPSG code (``EPSG:25833``, ``25833``, with a vertical one ``EPSG:25833+7837``), ``WGS84 UTM 33N`` as
            OpenDroneMap writes it, ``WGS84``, or a PROJ string (``+proj=utm +zone=33 ...``).
        place: begins messages: file and line, or the option.

    Raises:
        InputError: there is no such system, or it is of another kind than degrees or a plane.
        MissingPackageError: pyproj is needed and not installed.
    """
    text = text.strip()
    utm, code = _UTM.fullmatch(text), _EPSG.fullmatch(text)
    if utm is not None:
        if not 1 <= int(utm[1]) <= 60:
            raise InputError(f"{place}: expected a UTM zone from 1 to 60, found {utm[1]}", _ADVICE)
        text = f"EPSG:{(32600 if utm[2].upper() == 'N' else 32700) + int(utm[1])}"
    elif code is not None:
        text = f"EPSG:{code[1]}"
    elif text.upper() in ("WGS84", "WGS 84"):
        text = WGS84
    if text in (WGS84, WGS84_3D):
        return _DEGREES if text == WGS84 else _DEGREES_3D
    require("pyproj")
    import pyproj

    try:
        found = pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.CRSError:
        raise InputError(f"{place}: expected a coordinate system, found {text[:60]!r}", _ADVICE) from None
    horizontal = next((part for part in found.sub_crs_list if not part.is_vertical), found)
    if not (horizontal.is_geographic or horizontal.is_projected):
        raise InputError(f"{place}: expected degrees or a map projection, found {text[:60]} ({found.name})", _ADVICE)
    axes = found.axis_info
    is_3d = len(axes) == 3
    return CoordinateSystem(
        code=text,
        name=found.name,
        is_geographic=horizontal.is_geographic,
        unit=axes[0].unit_name,
        height_unit=axes[2].unit_name if is_3d else "metre",
        heights="orthometric" if found.is_compound else "ellipsoidal" if is_3d else "unknown",
    )


def utm_code(latitude_deg: float, longitude_deg: float) -> str:
    """EPSG code of the UTM zone of a place; zones are six degrees wide everywhere, Norway and Svalbard included."""
    zone = int((longitude_deg + 180.0) // 6.0) % 60 + 1
    return f"EPSG:{(32700 if latitude_deg < 0 else 32600) + zone}"


def _transformer(source: str, target: str, heights: HeightReference) -> Any:
    """By pyproj; never one that knows the heights or the datum only roughly."""
    import pyproj

    try:
        # where a geoid is needed, the best operation or none: without its grid pyproj would leave heights as they are
        return pyproj.Transformer.from_crs(
            source, target, always_xy=True, allow_ballpark=False, only_best=heights == "orthometric"
        )
    except pyproj.exceptions.ProjError as error:
        raise InputError(
            f"no transformation from {source} to {target}: {error}",
            "heights above a geoid need its grid: pyproj sync --file NAME, or give heights above the ellipsoid",
        ) from None


def _row_of(place: str | Sequence[str], row: int) -> str:
    return f"{place}, row {row + 1}" if isinstance(place, str) else place[row]


def _checked(values: Array, system: CoordinateSystem, place: str | Sequence[str]) -> Array:
    wrong = np.flatnonzero(~np.isfinite(values).all(1))
    if len(wrong):
        raise InputError(
            f"{_row_of(place, wrong[0])}: expected a place in {system.code} ({system.name}), found none there",
            "check the code and the order, which is easting, northing, height; heights above a geoid need its grid: "
            "pyproj sync",
        )
    return values


def _check_degrees(values: Array, place: str | Sequence[str]) -> None:
    wrong = np.flatnonzero(~((np.abs(values[:, 0]) <= 180) & (np.abs(values[:, 1]) <= 90) & np.isfinite(values[:, 2])))
    if len(wrong):
        found = ", ".join(f"{value:g}" for value in values[wrong[0]])
        raise InputError(
            f"{_row_of(place, wrong[0])}: expected longitude, latitude in degrees and a height, found {found}",
            "check the order, and the coordinate system",
        )
