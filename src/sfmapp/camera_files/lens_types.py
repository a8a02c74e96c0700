"""What calibration files call a lens, and in which order they give its coefficients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any

from sfmapp.errors import InputError


class LensType(Enum):
    """How a lens maps angles to the image, before its coefficients."""

    PERSPECTIVE = "perspective"
    FISHEYE = "fisheye"


# Keys that name a type of lens.
_TYPE_KEYS = (
    "distortion_model", "distortion_type", "camera_model", "camera_type", "model_type", "lens_model", "lens_type",
    "projection_type", "projection_model", "model", "type",
)  # fmt: skip
# What such keys hold that says nothing of the lens.
_OF_OTHER_THINGS = frozenset({
    "", "camera", "sensor", "calibration", "intrinsics", "mono", "monocular", "stereo", "rgb", "gray", "grey", "color",
})  # fmt: skip
_FISHEYE_KEYS = ("fisheye_model", "is_fisheye", "fisheye", "fish_eye")
# ORB-SLAM3 calls it KannalaBrandt8; Kalibr equidistant; OpenCV fisheye; RealSense kannala_brandt4; VINS-Fusion
# KANNALA_BRANDT; COLMAP OPENCV_FISHEYE.
_FISHEYE = frozenset({
    "equidistant", "equi", "fisheye", "opencvfisheye", "fisheyeopencv", "kannalabrandt", "kannalabrandt4",
    "kannalabrandt8", "kb", "kb4", "kb8", "pinholeequi", "pinholeequidistant", "pinholefisheye", "simplefisheye",
    "simpleradialfisheye", "radialfisheye",
})  # fmt: skip
# Without a word on the distortion, or with one that is perspective. ORB-SLAM3's "Rectified" is a pinhole.
_PINHOLE = frozenset({"pinhole", "perspective", "rectified", "simplepinhole"})
_NO_DISTORTION = frozenset({"none", "nodistortion", "undistorted", "rectified", "simplepinhole"})
_PERSPECTIVE = frozenset({
    "radtan", "radialtangential", "radialtangential8", "radtan8", "plumbbob", "rationalpolynomial", "rational",
    "brown", "brownconrady", "opencv", "fullopencv", "opencvpinhole", "pinholeradtan", "pinholebrown", "thinprism",
    "tilted", "simpleradial", "radial",
})  # fmt: skip
_EXPECTED = (
    "pinhole, radtan, plumb_bob, rational_polynomial, brown_conrady, or of a fisheye lens equidistant, fisheye, "
    "KannalaBrandt8"
)
_ADVICE = "calibrate with one of these, such as Kalibr's pinhole-radtan or pinhole-equi, or undistort the images first"

_COEFFICIENTS = {
    # as cv2.projectPoints takes them
    LensType.PERSPECTIVE: (
        "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y",
    ),
    LensType.FISHEYE: ("k1", "k2", "k3", "k4"),
}  # fmt: skip
_SPELLINGS = {"tau_x": ("tau_x", "taux", "tauX"), "tau_y": ("tau_y", "tauy", "tauY")}

Sections = Sequence[Mapping[str, Any]]
"""All that describes one camera: its own fields, and what is nested in them or stands above them."""


def type_fields(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Those of a file's fields that name a type of lens."""
    return {key: fields[key] for key in (*_TYPE_KEYS, *_FISHEYE_KEYS) if key in fields}


def _named(sections: Sections) -> list[tuple[str, str, str]]:
    """Keys that name a type, what they hold, and the same in small letters and digits alone."""
    found = [(key, fields[key]) for fields in sections for key in _TYPE_KEYS if isinstance(fields.get(key), str)]
    plain = [(key, value, "".join(c for c in value.lower() if c.isalnum())) for key, value in found]
    return [(key, value, name) for key, value, name in plain if name not in _OF_OTHER_THINGS]


def lens_type(place: str, sections: Sections) -> LensType | None:
    """The type of lens that a camera's fields name; None if none is named.

    Raises:
        InputError: a name that is not known, or names that contradict each other.
    """
    named, found = _named(sections), dict[LensType, str]()
    for key, value, name in named:
        if name in _FISHEYE:
            found.setdefault(LensType.FISHEYE, f"{key} {value}")
        elif name in _PERSPECTIVE | _NO_DISTORTION:
            found.setdefault(LensType.PERSPECTIVE, f"{key} {value}")
        elif name not in _PINHOLE:
            what = "a distortion model such as" if key.startswith("distortion") else key
            raise InputError(f"{place}: expected {what} {_EXPECTED}; found {value!r}", _ADVICE)
    for key, value in [(key, fields[key]) for fields in sections for key in _FISHEYE_KEYS if key in fields]:
        if isinstance(value, dict | list | str) or value is None:
            continue
        if value not in (0, 1):
            raise InputError(f"{place}: expected {key} of 0 or 1, found {value!r}", _ADVICE)
        found.setdefault(LensType.FISHEYE if value else LensType.PERSPECTIVE, f"{key} {value:g}")
    if len(found) > 1:
        raise InputError(
            f"{place}: expected one type of lens, found {' and '.join(found.values())}",
            "leave the one that is right",
        )
    return next(iter(found), LensType.PERSPECTIVE if named else None)


def is_without_distortion(sections: Sections) -> bool:
    """Whether a type is named that has no distortion, so that coefficients contradict it."""
    return any(name in _NO_DISTORTION for _, _, name in _named(sections))


def named_coefficients(place: str, section: Mapping[str, Any], lens: LensType | None) -> list[Any]:
    """Coefficients that have names of their own (``k1``, ``p1``, ...), in OpenCV's order; 0 where there is none.

    Raises:
        InputError: coefficients that such a lens does not have, or that do not tell which lens they are of.
    """
    known = {}
    for name in _COEFFICIENTS[LensType.PERSPECTIVE]:
        spelling = next((s for s in _SPELLINGS.get(name, (name,)) if s in section), None)
        if spelling is not None and section[spelling] not in (0, None):
            known[name] = section[spelling]
    if lens is None and "k4" in known and not known.keys() & {"p1", "p2", "k5", "k6"}:
        raise InputError(
            f"{place}: expected the type of the lens, found k4 without k5 and k6, which is of a fisheye lens or of a "
            "rational one",
            'add "model": "fisheye" or "model": "opencv"',
        )
    order = _COEFFICIENTS[lens or LensType.PERSPECTIVE]
    foreign = [name for name in known if name not in order]
    if foreign:
        raise InputError(
            f"{place}: expected k1, k2, k3, k4 of a fisheye lens, found {', '.join(foreign)} as well",
            "name the type of the lens that the coefficients are of",
        )
    return [known.get(name, 0.0) for name in order]
