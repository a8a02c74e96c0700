"""The table of camera models: names, numbers, families and parameters, apart from all that is heavy, for a command line
lists them before it loads anything.

This is the one place that knows them: files, command lines and kernels all ask here. A new model of a known family is a
row; a new family is a module beside this one and its cases in :mod:`sfmapp.camera.lens`, whose names families have.
"""

from __future__ import annotations

from enum import IntEnum


class CameraModel(IntEnum):
    """The camera models, with COLMAP's names and numbers; those that COLMAP does not have from 1000 on.

    Attributes:
        family: of lenses, a name in :mod:`sfmapp.camera.lens`.
        params: names of the parameters, in the order in which they are stored. Those behind ``cy`` are the numbers of
            the family's distortion, from its first on.
    """

    family: str
    params: tuple[str, ...]

    def __new__(cls, number: int, family: str = "", params: str = "") -> CameraModel:
        """A row of the table."""
        row = int.__new__(cls, number)
        row._value_, row.family, row.params = number, family, tuple(params.split())
        return row

    SIMPLE_PINHOLE = 0, "BROWN", "f cx cy"
    PINHOLE = 1, "BROWN", "fx fy cx cy"
    SIMPLE_RADIAL = 2, "BROWN", "f cx cy k1"
    RADIAL = 3, "BROWN", "f cx cy k1 k2"
    OPENCV = 4, "BROWN", "fx fy cx cy k1 k2 p1 p2"
    OPENCV_FISHEYE = 5, "RADIAL_FISHEYE", "fx fy cx cy k1 k2 k3 k4"
    FULL_OPENCV = 6, "RATIONAL", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"
    FOV = 7, "FOV", "fx fy cx cy omega"
    SIMPLE_RADIAL_FISHEYE = 8, "RADIAL_FISHEYE", "f cx cy k1"
    RADIAL_FISHEYE = 9, "RADIAL_FISHEYE", "f cx cy k1 k2"
    THIN_PRISM_FISHEYE = 10, "THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"
    RAD_TAN_THIN_PRISM_FISHEYE = (
        11, "RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
    )  # fmt: skip
    SIMPLE_DIVISION = 12, "DIVISION", "f cx cy k"
    DIVISION = 13, "DIVISION", "fx fy cx cy k"
    SIMPLE_FISHEYE = 14, "RADIAL_FISHEYE", "f cx cy"
    FISHEYE = 15, "RADIAL_FISHEYE", "fx fy cx cy"
    EUCM = 16, "EUCM", "fx fy cx cy alpha beta"
    EQUIRECTANGULAR = 17, "EQUIRECTANGULAR", "w h"
    PINHOLE_SKEW = 1000, "SKEW", "fx fy cx cy s"
    OPENCV_THIN_PRISM = 1001, "RATIONAL", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4"

    @property
    def is_colmaps(self) -> bool:
        """Whether COLMAP has this model."""
        return self < 1000


MODEL_NAMES: tuple[str, ...] = tuple(CameraModel.__members__)
