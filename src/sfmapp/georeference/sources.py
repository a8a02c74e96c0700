"""Positions of photographs from files beside them.

=========== ==========================================================================================================
geo.txt     OpenDroneMap's: a coordinate system, then ``image x y z [yaw pitch roll [sigma_xy sigma_z]]``
CSV         a line of titles: ``image, latitude, longitude [, height, sigma, sigma_up]``
CSV, a track ``time, latitude, longitude [, height]``: matched by the photographs' clock
GPX         a track with times: matched by the photographs' clock
=========== ==========================================================================================================
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.safe_xml import read_xml
from sfmapp.formats.text_input import plain_numbers, read_limited_text
from sfmapp.georeference.coordinate_systems import CoordinateSystem, coordinate_system
from sfmapp.georeference.options import GpsOptions
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.images.position import Position

Array = NDArray[np.float64]

_LARGEST_BYTES = 2**28
# A photograph between two fixes of a track that are farther apart in time than this has no position, in seconds.
_LONGEST_GAP_S = 30.0
# titles that columns go by, in lower case
_TITLES = {
    "image": ("image", "name", "file", "filename", "label", "photo"),
    "time": ("time", "timestamp", "time_s", "datetime", "utc"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon", "lng", "long"),
    "height": ("height", "alt", "altitude", "ele", "elevation", "height_m"),
    "sigma": ("sigma", "sigma_m", "accuracy", "horizontal_accuracy"),
    "sigma_up": ("sigma_up", "sigma_up_m", "vertical_accuracy"),
}
_CSV_ADVICE = "write a line of titles first: image,latitude,longitude,height (or time in place of image, for a track)"


class Fix(NamedTuple):
    """A place of a track at a time (seconds since 1970): latitude, longitude, height (NaN where unknown)."""

    time_s: float
    latitude_deg: float
    longitude_deg: float
    height_m: float


@dataclass(frozen=True)
class PositionFile:
    """What a file holds: positions by name of the image, or a track."""

    path: Path
    by_name: dict[str, Position]
    track: tuple[Fix, ...] = ()


def with_positions(image_set: ImageSet, options: GpsOptions) -> ImageSet:
    """The photographs with the positions that ``options.source`` names.

    Raises:
        InputError: the file cannot be read, is damaged, or names no photograph of the set.
    """
    if options.source == "exif":
        return image_set
    if options.source == "none":
        return replace(image_set, images=tuple(replace(record, position=None) for record in image_set.images))
    found = read_positions(Path(options.source))
    records = image_set.images
    if found.track:
        positions = _along_track(found, records, options.time_offset_s)
    else:
        positions = _by_name(found, records)
    images = tuple(replace(record, position=one) for record, one in zip(records, positions, strict=True))
    return replace(image_set, images=images)


def read_positions(path: Path) -> PositionFile:
    """Positions of a file of any of these kinds, told apart by what is in it.

    Raises:
        InputError: names file and line, what was expected and what was found.
    """
    text = read_limited_text(path, _LARGEST_BYTES)
    if text.lstrip().startswith("<"):
        return PositionFile(path, {}, _read_gpx(path, text))
    lines = text.splitlines()
    first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    titles = [title.strip().strip('"').lower() for title in first.split(",")]
    if len(titles) > 1 and any(title in _TITLES["latitude"] for title in titles):
        return _read_csv(path, lines)
    return PositionFile(path, _read_geo(path, lines))


# ------------------------------------------------------------------------------------------------------- photographs


def _by_name(found: PositionFile, records: Sequence[ImageRecord]) -> list[Position | None]:
    positions = [found.by_name.get(record.name, found.by_name.get(Path(record.name).name)) for record in records]
    if not any(position is not None for position in positions):
        named = next(iter(found.by_name), "nothing")
        raise InputError(
            f"{found.path}: expected positions of photographs such as {records[0].name}, found none, but of {named}",
            "name the images as they lie in their folder",
        )
    return positions


def _along_track(found: PositionFile, records: Sequence[ImageRecord], offset_s: float) -> list[Position | None]:
    """Places on the track at the times of the photographs."""
    track = np.array(found.track)
    if not any(record.timestamp is not None for record in records):
        raise InputError(
            f"{found.path}: a track is matched by time, and no photograph has a time",
            "give a file with names of images in place of times",
        )
    times = np.array([math.nan if record.timestamp is None else record.timestamp + offset_s for record in records])
    positions = [
        None
        if math.isnan(place[0])
        else Position(
            place[0], place[1], None if math.isnan(place[2]) else place[2], source=f"{found.path.name}, by time"
        )
        for place in places_along(track, times).tolist()
    ]
    if not any(position is not None for position in positions):
        taken = [record.timestamp for record in records if record.timestamp is not None]
        raise InputError(
            f"{found.path}: the track is from {_clock(track[0, 0])} to {_clock(track[-1, 0])}, the photographs by "
            f"their clock from {_clock(min(taken))} to {_clock(max(taken))}: none falls into it",
            "give the seconds to add to the photographs' clock: --set gps.time_offset_s=...; a track counts in UTC, "
            "cameras mostly in local time",
        )
    return positions


def places_along(track: Array, times_s: Array) -> Array:
    """(n, 3) between the fixes of a track (T, 4), whose first column ascends, around times (n,); NaN off the track, and
    in a gap of it."""
    after = np.searchsorted(track[:, 0], times_s)
    inside = np.minimum(after, len(track) - 1)
    before = np.maximum(inside - 1, 0)
    length = track[inside, 0] - track[before, 0]
    is_fix = track[inside, 0] == times_s
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(is_fix, 1.0, (times_s - track[before, 0]) / length)
        between = track[before, 1:] + share[:, None] * (track[inside, 1:] - track[before, 1:])
    places = np.where(is_fix[:, None], track[inside, 1:], between)
    is_known = is_fix | ((after > 0) & (after < len(track)) & (length <= _LONGEST_GAP_S))
    found: Array = np.where(is_known[:, None], places, np.nan)
    return found


def _clock(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M:%S")


# -------------------------------------------------------------------------------------------------------------- files


def _read_geo(path: Path, lines: Sequence[str]) -> dict[str, Position]:
    """OpenDroneMap's geo.txt: https://docs.opendronemap.org/geo."""
    system: CoordinateSystem | None = None
    found: dict[str, Position] = {}
    for number, line in enumerate(lines, 1):
        text, place = line.strip(), f"{path}:{number}"
        if not text or text.startswith("#"):
            continue
        if system is None:
            system = coordinate_system(text, place)
            continue
        fields = text.split()
        if len(fields) not in (3, 4, 7, 9):
            raise InputError(
                f"{place}: expected image x y [z [yaw pitch roll [sigma_xy sigma_z]]], found {len(fields)} fields",
                "names of images may hold no spaces in this format",
            )
        name, *rest = fields
        values = _numbers(rest, place)
        height = values[2] if len(values) > 2 else math.nan
        geodetic = system.geodetic([[values[0], values[1], 0.0 if math.isnan(height) else height]], [place])[0]
        sigma, sigma_up = (values[6], values[7]) if len(values) == 8 else (None, None)
        attitude = (values[3], values[4], values[5]) if len(values) > 5 else None
        _add(
            found, name, place,
            Position(
                float(geodetic[0]), float(geodetic[1]), None if math.isnan(height) else float(geodetic[2]),
                system.heights, _sigma(sigma, place), _sigma(sigma_up, place), sigma is not None,
                f"{path.name}:{number}", attitude,
            ),
        )  # fmt: skip
    if not found:
        raise InputError(f"{path}: expected a coordinate system and a line for each image, found no image")
    return found


def _read_csv(path: Path, lines: Sequence[str]) -> PositionFile:
    found: dict[str, Position] = {}
    fixes: list[Fix] = []
    columns: dict[str, int] = {}
    for number, line in enumerate(lines, 1):
        place = f"{path}:{number}"
        if not line.strip() or line.startswith("#"):
            continue
        fields = [field.strip() for field in next(csv.reader(io.StringIO(line)))]
        if not columns:
            columns = _columns(fields, place)
            continue
        if len(fields) <= max(columns.values()):
            raise InputError(f"{place}: expected {max(columns.values()) + 1} fields, found {len(fields)}", _CSV_ADVICE)
        of = {name: fields[column] for name, column in columns.items()}
        latitude, longitude = _numbers([of["latitude"], of["longitude"]], place)
        _check_place(latitude, longitude, place)
        height = _numbers([of["height"]], place)[0] if of.get("height") else math.nan
        if "image" not in columns:
            fixes.append(Fix(_time(of["time"], place), latitude, longitude, height))
            continue
        sigma, sigma_up = (
            _sigma(_numbers([of[name]], place)[0] if of.get(name) else None, place) for name in ("sigma", "sigma_up")
        )
        known = None if math.isnan(height) else height
        source = f"{path.name}:{number}"
        position = Position(latitude, longitude, known, "unknown", sigma, sigma_up, sigma is not None, source)
        _add(found, of["image"], place, position)
    if not found and not fixes:
        raise InputError(f"{path}: expected a line for each image, found none", _CSV_ADVICE)
    return PositionFile(path, found, _in_order(fixes))


def _columns(titles: Sequence[str], place: str) -> dict[str, int]:
    lower = [title.lower() for title in titles]
    columns = {
        name: next(lower.index(title) for title in known if title in lower)
        for name, known in _TITLES.items()
        if set(known) & set(lower)
    }
    missing = {"latitude", "longitude"} - columns.keys()
    if missing or not columns.keys() & {"image", "time"}:
        found = ", ".join(titles)
        raise InputError(
            f"{place}: expected titles image (or time), latitude and longitude, found {found[:80]}", _CSV_ADVICE
        )
    return columns


def _read_gpx(path: Path, text: str) -> tuple[Fix, ...]:
    """Track points, route points and way points that have a time (GPX 1.1)."""
    fixes = []
    for element in read_xml(text, str(path)).iter():
        if element.tag.rpartition("}")[2] not in ("trkpt", "rtept", "wpt"):
            continue
        parts = {child.tag.rpartition("}")[2]: (child.text or "").strip() for child in element}
        if not parts.get("time"):
            continue
        place = f"{path}: point at {parts['time'][:30]}"
        latitude, longitude = _numbers([element.get("lat", ""), element.get("lon", "")], place)
        _check_place(latitude, longitude, place)
        height = _numbers([parts["ele"]], place)[0] if parts.get("ele") else math.nan
        fixes.append(Fix(_time(parts["time"], place), latitude, longitude, height))
    if not fixes:
        raise InputError(f"{path}: expected a GPX track whose points have times, found no such point")
    return _in_order(fixes)


def _in_order(fixes: Sequence[Fix]) -> tuple[Fix, ...]:
    return tuple(sorted(fixes, key=lambda fix: fix.time_s))


def _add(found: dict[str, Position], name: str, place: str, position: Position) -> None:
    if name in found:
        raise InputError(f"{place}: expected every image once, found {name} again", "remove one of the lines")
    found[name] = position


def _numbers(fields: Sequence[str], place: str) -> list[float]:
    try:
        values = plain_numbers(fields)
    except ValueError:
        values = [math.inf]
    if not all(map(math.isfinite, values)):
        raise InputError(
            f"{place}: expected numbers, found {', '.join(fields)[:80]}",
            "correct the line, or begin it with # to skip it",
        )
    return values


def _check_place(latitude: float, longitude: float, place: str) -> None:
    if abs(latitude) > 90 or abs(longitude) > 180:
        raise InputError(
            f"{place}: expected latitude and longitude in degrees, found {latitude:g}, {longitude:g}",
            "give degrees of WGS84; coordinates in other systems go into a geo.txt, with their EPSG code",
        )


def _sigma(value: float | None, place: str) -> float | None:
    if value is not None and not 0 < value < 1e6:
        raise InputError(
            f"{place}: expected a standard deviation above 0 in metres, found {value:g}",
            "give what the receiver states, or leave the field empty where it is not known",
        )
    return value


def _time(text: str, place: str) -> float:
    """Seconds since 1970 of a number of them, or of a date and time (UTC where no zone is said)."""
    try:
        value = float(text)
        if math.isfinite(value):
            return value
    except ValueError:
        pass
    try:
        time = datetime.fromisoformat(text.replace("Z", "+00:00"))
        return (time if time.tzinfo is not None else time.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        raise InputError(
            f"{place}: expected a time such as 2026-05-01T12:30:00Z or seconds since 1970, found {text[:40]!r}"
        ) from None
