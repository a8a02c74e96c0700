"""What follows from the table of camera models in :mod:`sfmapp.camera.names`: families, slots, plain parameters."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import lens
from sfmapp.camera.lens import FAMILY
from sfmapp.camera.names import CameraModel

Array = NDArray[np.float64]


# Names of the parameters of each model, in the order in which they are stored.
PARAM_NAMES: dict[CameraModel, tuple[str, ...]] = {model: model.params for model in CameraModel}

# Places of the parameters that every family has in the canonical sixteen; those of distortion follow in their order.
_SLOTS = {"f": (0, 1), "fx": (0,), "fy": (1,), "cx": (2,), "cy": (3,), "w": (0, 2), "h": (1, 3)}

# What each parameter of a lens without distortion is, where that is not zero.
_NEUTRAL = {"alpha": 0.0, "beta": 1.0}


@cache
def family_of(model: CameraModel) -> int:
    """Number of the family in :mod:`sfmapp.camera.lens`."""
    return int(getattr(lens, model.family))


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
    bends = [name for name in model.params if name not in _SLOTS]
    for column, name in enumerate(model.params):
        for slot in _SLOTS[name] if name in _SLOTS else (4 + bends.index(name),):
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
