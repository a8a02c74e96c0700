"""What the camera wrote beside the picture, and the focal length in pixels that follows from it.

EXIF is written by cameras, phones and a hundred editors, so nothing in it is trusted: values that cannot be are left
out and named in ``problems``. Tags after CIPA DC-008 (Exif 2.32).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone

from sfmapp.images.position import Position
from sfmapp.images.tags import EMPTY, Directory, first_directory, sub_directory

# Diagonal of a 24 x 36 mm frame. CIPA DCG-001 defines the 35 mm equivalent by equal diagonals.
_FILM_DIAGONAL_MM = 43.27
_MM_PER_UNIT = {2.0: 25.4, 3.0: 10.0, 4.0: 1.0, 5.0: 0.001}

# A focal length outside these multiples of the long side (160 and 4 degrees of view) is not taken from EXIF.
_MIN_FOCAL, _MAX_FOCAL = 0.18, 15.0
_FOCAL_MM = (0.1, 10_000.0)

# Relative standard deviations of the priors.
#   35 mm equivalent: makers round it, some to marketing numbers, and lenses breathe as they focus; on phones and
#   cameras with known calibration it is good to about 5 %. Rounding to whole millimetres comes on top.
#   Sensor: the nominal focal length of a zoom and the sensor are each good to 2 %.
#   Unknown crop: 16:9 from 4:3 or 3:2 changes the answer by up to 8 %, an editor's crop by anything.
#   Default: fields of view of common lenses lie between 25 and 90 degrees, a factor of two around 1.2.
_SIGMA_35MM, _SIGMA_SENSOR, _SIGMA_FRAME, _SIGMA_CROP = 0.05, 0.03, 0.10, 0.20
DEFAULT_FOCAL, DEFAULT_FOCAL_SIGMA = 1.2, 0.50

# GPSHPositioningError is the radius that holds 68 % of positions, in standard deviations along one axis:
# sqrt(-2 ln 0.32). What is said of a dilution of precision is no better than a receiver without corrections.
_RADIUS_68, _LEAST_SIGMA_M = 1.51, 3.0

# Long side of the sensor in mm, for cameras that leave out the 35 mm equivalent. First match of "make model" counts.
_SENSOR_WIDTH_MM: tuple[tuple[str, float], ...] = (
    (r"CANON EOS-?1DS|CANON EOS-?1D ?X|CANON EOS [56]DS?\b", 36.0),
    (r"CANON EOS R(P|A|[1-68]([M ].*)?)?$", 36.0),
    (r"CANON EOS-?1D", 28.1),
    (r"CANON EOS", 22.3),
    (r"NIKON (D[3456]|D3[SX]|D4S|D6[01]0|D7[05]0|D780|D8[015]0|D800E|DF|Z ?[56789F]|Z ?[567]_?[23I]+)$", 35.9),
    (r"NIKON (D\d+[A-Z]?|Z ?30|Z ?50|Z ?50_2|Z ?FC)$", 23.6),
    (r"SONY (ILCE-[179]|ILCE-7[A-Z0-9]+|ILCE-9M\d|DSC-RX1R?(M2)?|SLT-A99V?)$", 35.8),
    (r"SONY (ILCE-[356]\d+|NEX-|SLT-A|DSLR-A[2-7]\d\d)", 23.5),
    (r"SONY DSC-RX10", 13.2),
    (r"OLYMPUS E-(M|P)|OM OM-|PANASONIC DM?C-G", 17.3),
    (r"FUJIFILM GFX", 43.8),
    (r"FUJIFILM (X-(T|E|H|PRO|A|M|S[12]0)|X100)", 23.5),
    (r"(RICOH )?PENTAX K-1\b", 35.9),
    (r"(RICOH )?PENTAX K", 23.5),
    (r"DJI FC6310|HASSELBLAD L1D-20C", 13.2),
    (r"DJI FC(220|300|330)", 6.2),
)


@dataclass(frozen=True)
class ExifFacts:
    """What EXIF says and can be believed.

    Attributes:
        make, model, lens, serial: text, empty where absent.
        orientation: 1 to 8.
        focal_mm: focal length of the lens in mm.
        focal_35mm: 35 mm equivalent focal length in mm, as written.
        focal_plane_px_per_mm: pixels per mm on the sensor, horizontally, in the picture as the camera wrote it.
        camera_size: (width, height) in pixels of the picture as EXIF remembers it.
        timestamp: seconds since 1970; without a time zone the clock's face is taken as UTC.
        position: where it was taken.
        problems: values that were left out, one phrase each.
    """

    make: str = ""
    model: str = ""
    lens: str = ""
    serial: str = ""
    orientation: int = 1
    focal_mm: float | None = None
    focal_35mm: float | None = None
    focal_plane_px_per_mm: float | None = None
    camera_size: tuple[int, int] | None = None
    timestamp: float | None = None
    position: Position | None = None
    problems: tuple[str, ...] = ()


@dataclass(frozen=True)
class FocalPrior:
    """A focal length in pixels before any photograph was looked at.

    Attributes:
        focal_px, sigma_px: mean and standard deviation in pixels.
        source: ``exif_35mm``, ``exif_sensor`` or ``default`` (``user`` is set by whoever asks the user).
        reason: how it was computed, for the report.
        problems: values that were left out, one phrase each.
    """

    focal_px: float
    sigma_px: float
    source: str
    reason: str
    problems: tuple[str, ...] = ()


def read_exif(exif: bytes) -> ExifFacts:
    """The facts in an EXIF block (which begins with its TIFF header). Never raises."""
    if not exif:
        return ExifFacts()
    first = first_directory(exif)
    photo = sub_directory(exif, first, 34665)
    gps = sub_directory(exif, first, 34853)
    problems: list[str] = []
    orientation = first.number(274)
    if orientation is not None and orientation not in range(1, 9):
        problems.append(f"EXIF orientation {orientation:g} is not 1 to 8")
        orientation = None
    unit_mm = _MM_PER_UNIT.get(photo.number(41488) or 2.0)
    resolution = _believable(photo, 41486, "FocalPlaneXResolution", 1e-3, 1e9, problems)
    width, height = photo.number(40962), photo.number(40963)
    has_size = width is not None and height is not None and 1 <= width < 1e6 and 1 <= height < 1e6
    return ExifFacts(
        make=first.text(271),
        model=first.text(272),
        lens=photo.text(42036),
        serial=photo.text(42033),
        orientation=int(orientation or 1),
        focal_mm=_believable(photo, 37386, "FocalLength", *_FOCAL_MM, problems),
        focal_35mm=_believable(photo, 41989, "FocalLengthIn35mmFilm", *_FOCAL_MM, problems),
        focal_plane_px_per_mm=resolution / unit_mm if resolution and unit_mm else None,
        camera_size=(int(width or 0), int(height or 0)) if has_size else None,
        timestamp=_timestamp(photo),
        position=_position(gps, problems) if gps is not EMPTY else None,
        problems=tuple(problems),
    )


def _believable(
    directory: Directory, tag: int, name: str, low: float, high: float, problems: list[str]
) -> float | None:
    value = directory.number(tag)
    if value is None:
        return None
    if not low <= value <= high:  # nor is NaN, which is what a zero denominator gives
        problems.append(f"EXIF {name} is {value:g}")
        return None
    return value


_DATE = re.compile(r"(\d{4})[:\-/](\d\d)[:\-/](\d\d)[ T](\d\d):(\d\d):(\d\d)")
_ZONE = re.compile(r"([+-])(\d\d):(\d\d)")


def _timestamp(photo: Directory) -> float | None:
    """When the picture was taken; digitised where that is all there is. DateTime is the editor's and does not count."""
    for date_tag, subsec_tag, zone_tag in ((36867, 37521, 36881), (36868, 37522, 36882)):
        match = _DATE.match(photo.text(date_tag))
        if match is None:
            continue
        zone = _ZONE.match(photo.text(zone_tag))
        offset = timedelta(0)
        if zone is not None:
            offset = timedelta(hours=int(zone[2]), minutes=int(zone[3])) * (-1 if zone[1] == "-" else 1)
        try:
            year, month, day, hour, minute, second = (int(group) for group in match.groups())
            seconds = datetime(year, month, day, hour, minute, second, tzinfo=timezone(offset)).timestamp()
        except (ValueError, OverflowError):
            continue
        fraction = re.match(r"[0-9]{1,9}", photo.text(subsec_tag))
        return seconds + (float("0." + fraction[0]) if fraction else 0.0)
    return None


def _position(gps: Directory, problems: list[str]) -> Position | None:
    latitude, longitude = _degrees(gps, 2, 1, "S"), _degrees(gps, 4, 3, "W")
    if latitude is None or longitude is None:
        return None
    if abs(latitude) > 90 or abs(longitude) > 180:
        problems.append(f"EXIF GPS position ({latitude:g}, {longitude:g}) is not on Earth")
        return None
    if latitude == 0.0 and longitude == 0.0:  # what phones write before they have a fix
        return None
    altitude = gps.number(6)
    if altitude is not None and not abs(altitude) <= 100_000:  # nor is NaN
        altitude = None
    # 0 and 1: above and below sea level, by Exif 3.0 of the ellipsoid; 2 and 3: above and below sea level
    kind = gps.values.get(5, (0,))
    reference = kind[0] if kind and not isinstance(kind, str) else 0
    if altitude is not None and reference in (1, 3):
        altitude = -altitude
    error, dilution = gps.number(31), gps.number(11)
    sigma = None
    if error is not None and 0 < error < 1e5:
        sigma = error / _RADIUS_68
    elif dilution is not None and 0 < dilution < 1e4:
        # no error in metres by the standard, but phones have written theirs into it
        sigma = max(dilution, _LEAST_SIGMA_M)
    return Position(
        latitude, longitude, altitude, "orthometric" if reference in (2, 3) else "unknown", sigma,
        is_stated=error is not None and sigma is not None and error / _RADIUS_68 == sigma, source="EXIF",
    )  # fmt: skip


def _degrees(gps: Directory, tag: int, ref_tag: int, negative: str) -> float | None:
    parts = gps.numbers(tag)[:3]
    if not parts or not all(math.isfinite(part) for part in parts):
        return None
    value = sum(part / 60.0**i for i, part in enumerate(parts))
    return -value if gps.text(ref_tag).upper().startswith(negative) else value


def focal_prior(facts: ExifFacts, width: int, height: int) -> FocalPrior:
    """The focal length of a width x height picture (either way round), in pixels, with its standard deviation.

    In this order: the 35 mm equivalent, the focal length in mm over the width of the sensor, 1.2 times the long side.
    The 35 mm equivalent relates diagonals (CIPA DCG-001), of the frame that the sensor has: pictures wider than 3:2 are
    taken as a 3:2 frame that lost height, those squarer than 4:3 as a 4:3 frame that lost width. For 16:9 this lies
    between what a 4:3 sensor (4 % more) and a native 16:9 frame (4.5 % less) would give.
    """
    problems: list[str] = []
    long_side, short_side = float(max(width, height)), float(min(width, height))
    is_cropped = _is_cropped(facts, long_side, short_side)
    if facts.focal_35mm is not None:
        frame_diagonal = math.hypot(
            max(long_side, short_side * 4.0 / 3.0),
            max(short_side, long_side * 2.0 / 3.0),
        )
        focal = facts.focal_35mm / _FILM_DIAGONAL_MM * frame_diagonal
        # a percent of slack, because sizes are multiples of 8 or 16
        is_native = 1.32 <= long_side / short_side <= 1.52
        sigma = math.hypot(_SIGMA_35MM if is_native else _SIGMA_FRAME, 1.0 / math.sqrt(12.0) / facts.focal_35mm)
        reason = f"EXIF: {facts.focal_35mm:g} mm in 35 mm film"
        if _is_believable(focal / long_side, reason, problems):
            sigma = _SIGMA_CROP if is_cropped else sigma
            return FocalPrior(focal, sigma * focal, "exif_35mm", reason, tuple(problems))
    sensor = _sensor_width(facts, long_side, problems)
    if facts.focal_mm is not None and sensor is not None:
        focal = facts.focal_mm / sensor * long_side
        reason = f"EXIF: {facts.focal_mm:g} mm on a sensor {sensor:.4g} mm wide"
        if _is_believable(focal / long_side, reason, problems):
            sigma = _SIGMA_CROP if is_cropped else _SIGMA_SENSOR
            return FocalPrior(focal, sigma * focal, "exif_sensor", reason, tuple(problems))
    focal = DEFAULT_FOCAL * long_side
    return FocalPrior(focal, DEFAULT_FOCAL_SIGMA * focal, "default", "1.2 times the long side", tuple(problems))


def _is_cropped(facts: ExifFacts, long_side: float, short_side: float) -> bool:
    """EXIF remembers a picture of another shape, so somebody has cut it."""
    if facts.camera_size is None:
        return False
    was_long, was_short = max(facts.camera_size), min(facts.camera_size)
    return abs(long_side / short_side * was_short / was_long - 1.0) > 0.02


def _is_believable(focal_over_long_side: float, reason: str, problems: list[str]) -> bool:
    if _MIN_FOCAL <= focal_over_long_side <= _MAX_FOCAL:
        return True
    problems.append(f"{reason} gives an impossible field of view")
    return False


def _sensor_width(facts: ExifFacts, long_side: float, problems: list[str]) -> float | None:
    """Long side of the sensor in mm, from the table of cameras, else from the resolution of the focal plane."""
    make = facts.make.split()[0] if facts.make.split() else ""
    name = facts.model if facts.model.upper().startswith(make.upper()) else f"{make} {facts.model}"
    for pattern, width_mm in _SENSOR_WIDTH_MM:
        if re.match(pattern, " ".join(name.upper().split())):
            return width_mm
    if facts.focal_plane_px_per_mm is None:
        return None
    camera_side = float(max(facts.camera_size)) if facts.camera_size else long_side
    width_mm = camera_side / facts.focal_plane_px_per_mm
    # Editors that shrink a picture rewrite its size but not this resolution: the sensor then seems tiny. Sensors under
    # 5.5 mm sit in phones, whose lenses are shorter than 10 mm.
    if not 1.0 <= width_mm <= 70.0 or (width_mm < 5.5 and (facts.focal_mm or 0.0) > 10.0):
        problems.append(f"EXIF FocalPlaneXResolution means a sensor {width_mm:.3g} mm wide (was the picture resized?)")
        return None
    return width_mm
