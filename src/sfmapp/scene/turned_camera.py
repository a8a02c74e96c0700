"""Cameras of pictures that EXIF says are to be turned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sfmapp.camera.camera import PARAM_NAMES, Camera
from sfmapp.geometry.orientation import INVERSE, is_sideways, upright_size, upright_vectors, upright_xy

# shares of the picture's sides within which a principal point is in the middle, and beyond which it is nowhere near;
# 4:3 taken for 3:4 puts it off by an eighth
_NEAR_CENTER, _FAR_OFF_CENTER = 0.04, 0.08


def turned_camera(camera: Camera, orientation: int) -> Camera:
    """The camera of the same pictures turned, and mirrored, as an EXIF orientation says; exact for every model."""
    values = dict(zip(PARAM_NAMES[camera.model], camera.params.tolist(), strict=True))
    center = upright_xy(orientation, [values["cx"], values["cy"]], camera.width, camera.height)
    values["cx"], values["cy"] = center.tolist()
    if is_sideways(orientation) and "fx" in values:
        values["fx"], values["fy"] = values["fy"], values["fx"]
    if "p1" in values:  # decentring moves x by 2 (v . x) x + r^2 v, v = (p2, p1)
        values["p2"], values["p1"] = upright_vectors(orientation, [values["p2"], values["p1"]]).tolist()
    width, height = upright_size(orientation, camera.width, camera.height)
    return replace(camera, width=width, height=height, params=np.array(list(values.values())))


def turned_back(camera: Camera, orientation: int) -> Camera | None:
    """The camera in pixels of files with that EXIF orientation, if its parameters evidently fit the turned pictures:
    the principal point is in the middle of these, and far from that of the file. None: they do not."""
    center, size = camera.canonical[2:4], np.array([camera.width, camera.height], np.float64)
    own, turned = (float(np.abs(center / s - 0.5).max()) for s in (size, size[::-1]))
    if not is_sideways(orientation) or own < _FAR_OFF_CENTER or turned > _NEAR_CENTER:
        return None
    return turned_camera(replace(camera, width=camera.height, height=camera.width), INVERSE[orientation])
