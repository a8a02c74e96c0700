"""Sizes as people write them: ``1200x800`` pixels, ``2.4x1.2m``, ``30cm``."""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from sfmapp.errors import UsageError

METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254, "ft": 0.3048}

_NUMBER = r"(\d+(?:\.\d*)?|\.\d+)(?:e[+-]?\d+)?"
_SIZE = re.compile(rf"\s*(?P<width>{_NUMBER})\s*x\s*(?P<height>{_NUMBER})\s*(?P<unit>[a-z]*)\s*", re.IGNORECASE)
_LENGTH = re.compile(rf"\s*(?P<length>{_NUMBER})\s*(?P<unit>[a-z]*)\s*", re.IGNORECASE)


class Size(NamedTuple):
    """Width and height: metres, or pixels."""

    width: float
    height: float
    is_metric: bool


def parse_size(text: str) -> Size:
    """``WxH`` in pixels, or with a unit of length behind. Raises UsageError for anything else."""
    match = _SIZE.fullmatch(text)
    unit = match["unit"].lower() if match else ""
    if match is None or (unit and unit not in ("px", *METRES)):
        raise UsageError(f"size is {text!r}, expected WxH in pixels, or with a unit", _examples())
    scale = METRES.get(unit, 1.0)
    width, height = float(match["width"]) * scale, float(match["height"]) * scale
    is_metric = unit in METRES
    if not (0.0 < width < math.inf and 0.0 < height < math.inf):
        raise UsageError(f"size is {text!r}, expected more than nothing along both sides", _examples())
    if not is_metric and (width != int(width) or height != int(height)):
        raise UsageError(f"size is {text!r}, expected whole pixels, or a unit behind", _examples())
    return Size(width, height, is_metric)


def parse_length(text: str) -> float:
    """Metres of a length with its unit. Raises UsageError for anything else."""
    match = _LENGTH.fullmatch(text)
    if match is None or match["unit"].lower() not in METRES or not 0.0 < float(match["length"]) < math.inf:
        raise UsageError(f"length is {text!r}, expected a number and its unit", "2.4m, 30cm, 210mm, 12in or 8ft")
    return float(match["length"]) * METRES[match["unit"].lower()]


def _examples() -> str:
    return "1200x800 for pixels; 2.4x1.2m, 297x210mm for the true size"
