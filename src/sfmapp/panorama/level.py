"""The frame of a panorama: its horizon level, its middle ahead."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.orientation import upright_poses
from sfmapp.geometry.upright import up_direction

Array = NDArray[np.float64]

# With less than this of their length left in their mean, the directions go all round and there is no middle.
_NO_MIDDLE = 0.2


def level(rotations: Array, orientation: Sequence[int]) -> Array:
    """Rotations (K, 3, 3) cam_from_world in a world whose y axis is down and whose z axis looks at their middle.

    What is down follows from how people hold cameras: level from side to side, whatever EXIF says of the roll
    (:func:`~sfmapp.geometry.upright.up_direction`). Of a full circle the middle is where the first photograph looks.

    Args:
        rotations: in any world. orientation: EXIF's of each photograph.
    """
    poses = upright_poses(rigid3.from_matrix(rotations, np.zeros((len(rotations), 3))), orientation)
    down = -up_direction(poses)
    forward = rotations[:, 2]
    flat = forward - np.outer(forward @ down, down)
    middle = flat.mean(0)
    if np.linalg.norm(middle) < _NO_MIDDLE:
        middle = flat[np.argmax(np.linalg.norm(flat, axis=1) > 0.5)]
    if np.linalg.norm(middle) < 1e-6:  # all look straight up or down
        middle = rotations[0, 1] - (rotations[0, 1] @ down) * down
    ahead = middle / np.linalg.norm(middle)
    world = np.stack([np.cross(down, ahead), down, ahead])
    turned: Array = rotations @ world.T
    return turned
