"""Which way is up, where positions do not tell or tell the opposite."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.upright import up_direction
from sfmapp.georeference.fit import Level

Array = NDArray[np.float64]

# Positions that tell the vertical better than this need no help.
LEVEL_ENOUGH_RAD = float(np.radians(5.0))
# How level people hold cameras, as a mean over many photographs.
_PHOTOGRAPHS_RAD = float(np.radians(5.0))
# How well a gimbal knows the vertical, and the length of the mean of unit vectors that differ by ten degrees at most.
_GIMBAL_RAD, _AGREEING = float(np.radians(3.0)), 0.98


def known_level(cam_from_world: Array, image_idx: NDArray[np.int64], pitch_deg: Array) -> Level:
    """What tells the vertical of a model beside positions: a drone's gimbal, else photographs that were held level.

    Args:
        cam_from_world: (I, 7) of the model.
        image_idx: (m,) images with positions; pitch_deg: (m,) of their optical axes above the horizon, NaN if unknown.
    """
    known = np.isfinite(pitch_deg)
    if known.any():
        pitch, rotation = np.radians(pitch_deg[known]), rigid3.rotation_matrix(cam_from_world[image_idx[known]])
        seen = np.stack([np.zeros_like(pitch), -np.cos(pitch), np.sin(pitch)], 1)
        mean = np.einsum("nji,nj->ni", rotation, seen).mean(0)
        length = float(np.linalg.norm(mean))
        if length > _AGREEING:
            return Level(mean / length, _GIMBAL_RAD, "gimbal")
    return Level(up_direction(cam_from_world), _PHOTOGRAPHS_RAD, "photographs")


def upside_down(poses: Array, rotation: Array) -> bool:
    """Whether a rotation (3, 3) from the model to east, north, up puts cameras (m, 7) on their heads.

    Positions that are a mirror image, as without the sign of their latitude, fit a flat layout once it is turned over.
    """
    axes = rigid3.rotation_matrix(poses) @ rotation.T
    looks, tops = axes[:, 2].mean(0), -axes[:, 1].mean(0)
    # photographs of one direction that look at the sky, or whose tops point down
    return bool(looks[2] > 0.9 or (tops[2] < -0.5))
