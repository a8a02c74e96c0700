"""The names of the camera models, apart from all that is heavy: a command line lists them before it loads anything."""

from __future__ import annotations

from enum import IntEnum


class CameraModel(IntEnum):
    """The camera models, with COLMAP's names and numbers; those that COLMAP does not have from 1000 on."""

    SIMPLE_PINHOLE = 0
    PINHOLE = 1
    SIMPLE_RADIAL = 2
    RADIAL = 3
    OPENCV = 4
    OPENCV_FISHEYE = 5
    FULL_OPENCV = 6
    FOV = 7
    SIMPLE_RADIAL_FISHEYE = 8
    RADIAL_FISHEYE = 9
    THIN_PRISM_FISHEYE = 10
    RAD_TAN_THIN_PRISM_FISHEYE = 11
    SIMPLE_DIVISION = 12
    DIVISION = 13
    SIMPLE_FISHEYE = 14
    FISHEYE = 15
    EUCM = 16
    EQUIRECTANGULAR = 17
    PINHOLE_SKEW = 1000
    OPENCV_THIN_PRISM = 1001

    @property
    def is_colmaps(self) -> bool:
        """Whether COLMAP has this model."""
        return self < 1000


MODEL_NAMES: tuple[str, ...] = tuple(CameraModel.__members__)
