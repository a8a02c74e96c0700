"""What is known of lengths and of the vertical, for models that no position and no survey places."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class UnitOptions:
    """Metres and the vertical, by what was measured on the site.

    Attributes:
        known: lengths, one or more with ``;`` between them: distance:IMAGE:IMAGE:METRES between two cameras,
            marker:DICT:METRES for the sides of markers, pair:DICT:ID:ID:METRES between the middles of two markers;
            None: none.
        up: exif: level as photographs are held, EXIF's orientation undone; plane: the ground below the cameras;
            markers: such as lie flat on it, of the dictionary of a known length; auto: the first of markers, plane and
            exif that tells; none: models stay as they are.
    """

    known: str | None = None
    up: Literal["none", "auto", "markers", "exif", "plane"] = "none"
