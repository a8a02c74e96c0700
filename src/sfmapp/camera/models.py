"""The table of camera models: names, numbers, parameters, and the family of lenses that each belongs to.

This is the one place that knows them: files, command lines and kernels all ask here. A new model of a known family is a
row of the table; a new family is a module beside this one and its case in :mod:`sfmapp.camera.lens`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.lens import (
    BROWN,
    DIVISION,
    EQUIRECTANGULAR,
    EUCM,
    FAMILY,
    FOV,
    RAD_TAN_THIN_PRISM_FISHEYE,
    RADIAL_FISHEYE,
    RATIONAL,
    SKEW,
    THIN_PRISM_FISHEYE,
)
from sfmapp.camera.names import CameraModel

Array = NDArray[np.float64]


class _Row(NamedTuple):
    family: int
    params: tuple[str, ...]
    slots: tuple[tuple[int, ...], ...]


_ONE = {"f": (0, 1), "cx": (2,), "cy": (3,)}
_TWO = {"fx": (0,), "fy": (1,), "cx": (2,), "cy": (3,)}


def _row(family: int, first: Mapping[str, tuple[int, ...]], names: str = "", slots: tuple[int, ...] = ()) -> _Row:
    bends = names.split()
    places = slots or tuple(range(4, 4 + len(bends)))
    return _Row(family, (*first, *bends), (*first.values(), *((place,) for place in places)))


_TABLE = {
    CameraModel.SIMPLE_PINHOLE: _row(BROWN, _ONE),
    CameraModel.PINHOLE: _row(BROWN, _TWO),
    CameraModel.SIMPLE_RADIAL: _row(BROWN, _ONE, "k1"),
    CameraModel.RADIAL: _row(BROWN, _ONE, "k1 k2"),
    CameraModel.OPENCV: _row(BROWN, _TWO, "k1 k2 p1 p2"),
    CameraModel.OPENCV_FISHEYE: _row(RADIAL_FISHEYE, _TWO, "k1 k2 k3 k4"),
    CameraModel.FULL_OPENCV: _row(RATIONAL, _TWO, "k1 k2 p1 p2 k3 k4 k5 k6"),
    CameraModel.FOV: _row(FOV, _TWO, "omega"),
    CameraModel.SIMPLE_RADIAL_FISHEYE: _row(RADIAL_FISHEYE, _ONE, "k1"),
    CameraModel.RADIAL_FISHEYE: _row(RADIAL_FISHEYE, _ONE, "k1 k2"),
    CameraModel.THIN_PRISM_FISHEYE: _row(THIN_PRISM_FISHEYE, _TWO, "k1 k2 p1 p2 k3 k4 sx1 sy1"),
    CameraModel.RAD_TAN_THIN_PRISM_FISHEYE: _row(
        RAD_TAN_THIN_PRISM_FISHEYE, _TWO, "k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3"
    ),
    CameraModel.SIMPLE_DIVISION: _row(DIVISION, _ONE, "k"),
    CameraModel.DIVISION: _row(DIVISION, _TWO, "k"),
    CameraModel.SIMPLE_FISHEYE: _row(RADIAL_FISHEYE, _ONE),
    CameraModel.FISHEYE: _row(RADIAL_FISHEYE, _TWO),
    CameraModel.EUCM: _row(EUCM, _TWO, "alpha beta"),
    CameraModel.EQUIRECTANGULAR: _Row(EQUIRECTANGULAR, ("w", "h"), ((0, 2), (1, 3))),
    CameraModel.PINHOLE_SKEW: _row(SKEW, _TWO, "s"),
    CameraModel.OPENCV_THIN_PRISM: _row(RATIONAL, _TWO, "k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4"),
}

# Names of the parameters of each model, in the order in which they are stored.
PARAM_NAMES: dict[CameraModel, tuple[str, ...]] = {model: row.params for model, row in _TABLE.items()}

# What each parameter of a lens without distortion is, where that is not zero.
_NEUTRAL = {"alpha": 0.0, "beta": 1.0}


def family_of(model: CameraModel) -> int:
    """Number of the family in :mod:`sfmapp.camera.lens`."""
    return _TABLE[model].family


def kind_of(name: str) -> str:
    """``focal``, ``center``, ``size`` (of a panorama, which nothing can refine) or ``distortion``, by the name."""
    if name in ("w", "h"):
        return "size"
    if name in ("f", "fx", "fy"):
        return "focal"
    return "center" if name in ("cx", "cy") else "distortion"


def canonical_from_params(model: CameraModel) -> Array:
    """(16, P) matrix that spreads a model's parameters over the canonical sixteen: each copied into its slots.

    The width and height of a panorama become the pixels of a radian and the middle.
    """
    matrix = np.zeros((FAMILY, len(PARAM_NAMES[model])))
    for column, slots in enumerate(_TABLE[model].slots):
        for slot in slots:
            matrix[slot, column] = 1.0
    if model == CameraModel.EQUIRECTANGULAR:
        matrix[0, 0], matrix[1, 1], matrix[2, 0], matrix[3, 1] = 0.5 / math.pi, 1.0 / math.pi, 0.5, 0.5
    return matrix


def plain_params(model: CameraModel, width: int, height: int, focal: float) -> Array:
    """(P,) parameters with one focal length in pixels, a centred principal point and no distortion.

    FOV has no parameter without distortion: omega starts at 0.01. A panorama's focal length follows from its size.
    """
    values = {"f": focal, "fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2, "omega": 0.01}
    values |= {"w": float(width), "h": float(height)} | _NEUTRAL
    return np.array([values.get(name, 0.0) for name in PARAM_NAMES[model]])
