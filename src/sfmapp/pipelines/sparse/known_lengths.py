"""Known lengths as a user writes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from sfmapp.errors import UsageError
from sfmapp.odometry.inertial.markers import parse_marker
from sfmapp.odometry.inertial.scale import Length, parse_length

_FORMS = "distance:IMAGE:IMAGE:METRES, marker:DICT:METRES or pair:DICT:ID:ID:METRES"


@dataclass(frozen=True)
class KnownLength:
    """What the user has measured: between two images, along the side of markers, or between two markers.

    Attributes:
        text: as it was given.
        images: positions of two images; None for markers. dictionary: of markers; None for images.
        ids: of two markers; None for the sides of all.
    """

    text: str
    length: Length
    images: tuple[int, int] | None = None
    dictionary: str | None = None
    ids: tuple[int, int] | None = None


def parse_known_lengths(text: str, names: Sequence[str]) -> list[KnownLength]:
    """Known lengths of an option.

    Args:
        names: of the images.

    Raises:
        UsageError: one is none of the forms, or names no image.
    """
    return [_parse(part.strip(), names) for part in text.split(";") if part.strip()]


def _parse(text: str, names: Sequence[str]) -> KnownLength:
    kind, *rest = (part.strip() for part in text.split(":"))
    if kind == "distance" and len(rest) == 3:
        a, b = (_image_named(name, names) for name in rest[:2])
        if a == b:
            raise UsageError(f"--scale {text}: a distance is between two different photographs")
        return KnownLength(text, parse_length(rest[2]), images=(a, b))
    if kind == "marker" and len(rest) == 2:
        marker = parse_marker(":".join(rest))
        return KnownLength(text, marker.side, dictionary=marker.dictionary)
    if kind == "pair" and len(rest) == 4 and all(number.isdigit() for number in rest[1:3]) and rest[1] != rest[2]:
        marker = parse_marker(f"{rest[0]}:{rest[3]}")
        return KnownLength(text, marker.side, dictionary=marker.dictionary, ids=(int(rest[1]), int(rest[2])))
    raise UsageError(f"--scale {text}: expected {_FORMS}", "such as marker:DICT_4X4_50:0.16; --scale may be repeated")


def _image_named(name: str, names: Sequence[str]) -> int:
    """Position of the image of a name, in full, without its folder, or without its suffix too."""
    for short in (str, lambda full: PurePosixPath(full).name, lambda full: PurePosixPath(full).stem):
        found = [i for i, full in enumerate(names) if short(full) == name]
        if len(found) == 1:
            return found[0]
        if found:
            raise UsageError(f"--scale: {name} is the name of {len(found)} photographs", "give it with its folder")
    raise UsageError(f"--scale: there is no photograph {name!r}", f"they are named such as {', '.join(names[:2])}")
