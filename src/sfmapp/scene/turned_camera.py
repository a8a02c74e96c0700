"""Cameras of pictures that EXIF says are to be turned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.models import PARAM_NAMES
from sfmapp.errors import UsageError
from sfmapp.geometry.orientation import INVERSE, MIRRORED, is_sideways, upright_size, upright_vectors, upright_xy

Array = NDArray[np.float64]

# shares of the picture's sides within which a principal point is in the middle, and beyond which it is nowhere near;
# 4:3 taken for 3:4 puts it off by an eighth
_NEAR_CENTER, _FAR_OFF_CENTER = 0.04, 0.08


def turned_camera(camera: Camera, orientation: int) -> Camera:
    """The camera of the same pictures turned, and mirrored, as an EXIF orientation says; exact for every model,
    with the covariance of its prior.

    Raises:
        UsageError: a panorama or a skewed pinhole on its side.
    """
    names = PARAM_NAMES[camera.model]
    width, height = upright_size(orientation, camera.width, camera.height)
    if is_sideways(orientation) and ("w" in names or "s" in names):
        raise UsageError(
            f"pictures of a {camera.model.name} camera cannot be turned on their side as EXIF's orientation "
            f"{orientation} says",
            "turn the photographs themselves, or take the tag out",
        )
    if "w" in names:
        return replace(camera, width=width, height=height)
    params = _turned(camera, orientation, camera.params)
    covariance = camera.prior_covariance
    if covariance is not None:
        # affine with whole numbers, so that differences are the exact slope
        zero = _turned(camera, orientation, np.zeros(len(names)))
        slope = np.stack([_turned(camera, orientation, unit) - zero for unit in np.eye(len(names))], 1)
        covariance = slope @ covariance @ slope.T
    return replace(camera, width=width, height=height, params=params, prior_covariance=covariance)


def _turned(camera: Camera, orientation: int, params: Array) -> Array:
    """Parameters (P,) of a camera of that model and size in the turned pictures: exchanged, moved, with other signs."""
    values = dict(zip(PARAM_NAMES[camera.model], params.tolist(), strict=True))
    center = upright_xy(orientation, [values["cx"], values["cy"]], camera.width, camera.height)
    values["cx"], values["cy"] = center.tolist()
    if is_sideways(orientation) and "fx" in values:
        values["fx"], values["fy"] = values["fy"], values["fx"]
    # decentring moves x by 2 (v . x) x + r^2 v, v = (p2, p1), of one model (p0, p1); prisms move it along themselves
    decentring = ("p0", "p1") if "p0" in values else ("p2", "p1")
    prisms = (("s0", "s2"), ("s1", "s3")) if "s0" in values else (("s1", "s3"), ("s2", "s4"))
    for x, y in (decentring, *prisms, ("sx1", "sy1")):
        if x in values:
            values[x], values[y] = upright_vectors(orientation, [values[x], values[y]]).tolist()
    if "s" in values and orientation in MIRRORED:  # one of the axes goes the other way
        values["s"] = -values["s"]
    return np.array(list(values.values()))


def turned_back(camera: Camera, orientation: int) -> Camera | None:
    """The camera in pixels of files with that EXIF orientation, if its parameters evidently fit the turned pictures:
    the principal point is in the middle of these, and far from that of the file. None: they do not."""
    center, size = camera.canonical[2:4], np.array([camera.width, camera.height], np.float64)
    own, turned = (float(np.abs(center / s - 0.5).max()) for s in (size, size[::-1]))
    if not is_sideways(orientation) or own < _FAR_OFF_CENTER or turned > _NEAR_CENTER:
        return None
    return turned_camera(replace(camera, width=camera.height, height=camera.width), INVERSE[orientation])


def fault_of_upright(camera: Camera, orientation: int, whose: str) -> tuple[str, str] | None:
    """For a camera that :func:`turned_back` finds to fit the turned pictures: what was expected and found, and its
    parameters in pixels of the files, as text; None for any other. ``whose`` says whose pixels are wanted."""
    stored = turned_back(camera, orientation)
    if stored is None:
        return None
    return (
        f"expected a camera of {camera.width}x{camera.height} pixels, {whose}, found one of "
        f"{camera.height}x{camera.width}, of pictures turned upright as EXIF says",
        ",".join(f"{value:.10g}" for value in stored.params),
    )
