"""Positions that drones write beside EXIF's, as XMP: with the state of RTK, standard deviations, and the gimbal.

Read are the namespaces of DJI (``drone-dji``) and of Pix4D (``Camera``), which others write as well. Nothing in them is
trusted: what cannot be is left out and named.
"""

from __future__ import annotations

import math
from dataclasses import replace

from sfmapp.errors import InputError
from sfmapp.formats.safe_xml import read_xml
from sfmapp.images.position import Position

# the extended part of XMP, which is larger, holds depth maps and the like
_LARGEST_BYTES = 1 << 20
_NAMESPACES = ("www.dji.com/drone-dji/", "pix4d.com/camera/")
# DJI's RtkFlag: 50 is a fixed solution; 34 a floating one, 16 a single one, 0 none
_RTK_FIXED = 50.0
_RTK_FIXED_SIGMA_M, _RTK_FLOAT_SIGMA_M = 0.05, 1.0


def with_xmp(position: Position | None, xmp: bytes, problems: list[str]) -> Position | None:
    """What EXIF says of a position, made better by XMP. Never raises.

    Args:
        position: by EXIF; None without.
        xmp: the packet; empty without.
        problems: what was left out is added, one phrase each.
    """
    if not xmp:
        return position
    if len(xmp) > _LARGEST_BYTES:
        problems.append("its XMP is too large to be read")
        return position
    try:
        values = _values(xmp)
    except InputError:
        problems.append("its XMP is damaged or declares entities, and is not read")
        return position
    return _position(position, values, problems) if values else position


def _values(xmp: bytes) -> dict[str, float]:
    """Numbers by name, in lower case, of the namespaces that are known."""
    found: dict[str, float] = {}
    for element in read_xml(xmp.strip(b"\0 \r\n\t"), "XMP").iter():
        for name, text in [*element.attrib.items(), (element.tag, element.text or "")]:
            space, _, local = name.rpartition("}")
            if not any(known in space for known in _NAMESPACES):
                continue
            try:
                value = float(text.strip().removesuffix("m"))
            except ValueError:
                continue
            if math.isfinite(value):
                found[local.lower()] = value
    return found


def _position(position: Position | None, values: dict[str, float], problems: list[str]) -> Position | None:
    latitude = values.get("gpslatitude", values.get("latitude"))
    # DJI's older programs write GpsLongtitude
    longitude = values.get("gpslongitude", values.get("gpslongtitude", values.get("longitude")))
    height = values.get("absolutealtitude")
    if latitude is not None and longitude is not None and (latitude, longitude) != (0.0, 0.0):
        if abs(latitude) <= 90 and abs(longitude) <= 180:
            known = height if height is not None else position.height_m if position else None
            kind = position.heights if position is not None else "unknown"
            base = position or Position(latitude, longitude, known)
            position = replace(
                base, latitude_deg=latitude, longitude_deg=longitude, height_m=known, heights=kind, source="XMP"
            )
        else:
            problems.append(f"XMP position ({latitude:g}, {longitude:g}) is not on Earth")
    if position is None:
        return None
    position = _with_sigmas(position, values)
    angles = [values.get(f"gimbal{name}degree", values.get(name)) for name in ("yaw", "pitch", "roll")]
    if all(angle is not None for angle in angles):
        yaw, pitch, roll = (float(angle or 0.0) for angle in angles)
        position = replace(position, attitude_deg=(yaw, pitch, roll))
    return position


def _with_sigmas(position: Position, values: dict[str, float]) -> Position:
    flag = values.get("rtkflag")
    flat = [values[name] for name in ("rtkstdlat", "rtkstdlon") if values.get(name, 0.0) > 0]
    up = values.get("rtkstdhgt", 0.0)
    if len(flat) == 2 and up > 0 and flag:
        return replace(position, sigma_m=math.hypot(*flat) / math.sqrt(2.0), sigma_up_m=up, is_stated=True)
    if values.get("gpsxyaccuracy", 0.0) > 0 and values.get("gpszaccuracy", 0.0) > 0:
        return replace(position, sigma_m=values["gpsxyaccuracy"], sigma_up_m=values["gpszaccuracy"], is_stated=True)
    if flag:
        sigma = _RTK_FIXED_SIGMA_M if flag == _RTK_FIXED else _RTK_FLOAT_SIGMA_M
        return replace(position, sigma_m=sigma, sigma_up_m=2 * sigma)
    return position
