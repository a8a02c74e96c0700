"""Photographs without their distortion, at working resolution."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.lens import distort
from sfmapp.scene.camera import Camera, pixels_to_normalized

Array = NDArray[np.float64]

# what a wide lens shows farther out than this, in sides of the photograph, would be stretched more than it is worth
LARGEST_MARGIN = 0.125
_STRIP_PX = 1 << 20


@dataclass(frozen=True)
class Canvas:
    """The plane that a photograph is laid out on.

    Attributes:
        camera: of the photograph.
        left, top, width, height: of the plane at full resolution, in pixels of the pinhole camera that has the lens's
            own focal lengths and principal point.
        shrink: pixels at full resolution for one at working resolution, a side; 1 or more.
    """

    camera: Camera
    left: int
    top: int
    width: int
    height: int
    shrink: float

    @property
    def working_size(self) -> tuple[int, int]:
        """Width and height in pixels of the working resolution."""
        return max(round(self.width / self.shrink), 1), max(round(self.height / self.shrink), 1)

    @property
    def k(self) -> Array:
        """(4,) ``fx, fy, cx, cy`` in pixels of the working resolution."""
        fx, fy, cx, cy = self.camera.canonical[:4]
        x, y = self.working_size[0] / self.width, self.working_size[1] / self.height
        return np.array([fx * x, fy * y, (cx - self.left) * x, (cy - self.top) * y])

    @property
    def is_distorted(self) -> bool:
        return self.camera.is_fisheye or bool(self.camera.canonical[4:].any())


def make_canvas(camera: Camera, shrink: float) -> Canvas:
    """The plane that holds what a camera shows, but for the outermost of very wide lenses.

    Where ``shrink`` is a whole number the last few columns and rows that would not fill a pixel are left out, so that
    every pixel is the mean of as many.
    """
    canvas = Canvas(camera, 0, 0, camera.width, camera.height, shrink)
    if canvas.is_distorted:
        left, top, right, bottom = _extent(camera)
        canvas = Canvas(camera, left, top, right - left, bottom - top, shrink)
    if shrink == round(shrink):
        step = round(shrink)
        width, height = (max(side // step * step, min(side, step)) for side in (canvas.width, canvas.height))
        canvas = Canvas(camera, canvas.left, canvas.top, width, height, shrink)
    return canvas


def _extent(camera: Camera) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of the border of the photograph, laid out flat."""
    width, height = camera.width, camera.height
    x, y = np.linspace(0.0, width, 65), np.linspace(0.0, height, 65)
    border = np.concatenate(
        [np.stack([u, v], axis=-1) for u, v in ((x, 0 * x), (x, 0 * x + height), (0 * y, y), (0 * y + width, y))]
    )
    flat = pixels_to_normalized(camera, border) * camera.canonical[:2] + camera.canonical[2:4]
    margin = LARGEST_MARGIN * np.array([width, height])
    # the lens has no inverse out there: as far as we go
    flat = np.where(np.isfinite(flat), flat, border + np.where(border > [width / 2, height / 2], margin, -margin))
    low = np.ceil(np.maximum(flat.min(axis=0), -margin)).astype(int)
    high = np.floor(np.minimum(flat.max(axis=0), np.array([width, height]) + margin)).astype(int)
    return int(low[0]), int(low[1]), int(max(high[0], low[0] + 1)), int(max(high[1], low[1] + 1))


def lay_out(
    canvas: Canvas, rgb: NDArray[np.uint8], mask: NDArray[np.bool_] | None
) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """Undistort a photograph and shrink it, each pixel the mean of those it covers.

    Args:
        canvas: made for its camera.
        rgb: (H, W, 3).
        mask: (H, W), True where it may be used; None for everywhere.

    Returns:
        (h, w, 3) colours and (h, w) mask, False also where the photograph shows nothing; None for True everywhere.
    """
    import cv2

    cv2.setNumThreads(1)
    opacity = None if mask is None else mask.astype(np.uint8) * 255
    if canvas.is_distorted:
        rgb, opacity = _undistort(canvas, rgb, opacity)
    else:
        rgb = rgb[: canvas.height, : canvas.width]
        opacity = None if opacity is None else opacity[: canvas.height, : canvas.width]
    if canvas.working_size != (canvas.width, canvas.height):
        rgb = cv2.resize(rgb, canvas.working_size, interpolation=cv2.INTER_AREA)
        opacity = None if opacity is None else cv2.resize(opacity, canvas.working_size, interpolation=cv2.INTER_AREA)
    usable = None if opacity is None else opacity > 127
    return np.ascontiguousarray(rgb), None if usable is None or usable.all() else usable


def _undistort(
    canvas: Canvas, rgb: NDArray[np.uint8], opacity: NDArray[np.uint8] | None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """At full resolution, a strip at a time: maps of a whole large photograph would outweigh it many times."""
    import cv2

    camera = canvas.camera
    flat = np.empty((canvas.height, canvas.width, 3), np.uint8)
    shown = np.empty((canvas.height, canvas.width), np.uint8)
    reach = _reach(camera)
    rows = max(_STRIP_PX // canvas.width, 1)
    for top in range(0, canvas.height, rows):
        bottom = min(top + rows, canvas.height)
        maps = np.empty((2, bottom - top, canvas.width), np.float32)
        valid = np.empty((bottom - top, canvas.width), np.uint8)
        _fill_maps(
            camera.is_fisheye, camera.canonical, reach, canvas.left, canvas.top + top, camera.width, camera.height,
            maps, valid,
        )  # fmt: skip
        cv2.remap(rgb, maps[0], maps[1], cv2.INTER_CUBIC, flat[top:bottom], cv2.BORDER_REPLICATE)
        if opacity is not None:
            valid = np.minimum(valid, cv2.remap(opacity, maps[0], maps[1], cv2.INTER_LINEAR))
        shown[top:bottom] = valid
    return flat, shown


def _reach(camera: Camera) -> float:
    """Radius in the normalised plane up to which the lens is one to one: beyond, its polynomial folds back."""
    radius = np.tan(np.linspace(0.0, 1.53, 4000))
    row = camera.canonical.copy()
    row[:4] = 1.0, 1.0, 0.0, 0.0
    if not camera.is_fisheye:
        row[6:] = 0.0  # the tangential terms are no reason to fold
    image = np.array([distort(camera.is_fisheye, row, r, 0.0)[0] for r in radius])
    folds = np.flatnonzero(np.diff(image) <= 0.0)
    return float(radius[folds[0]]) if len(folds) else math.inf


@numba.njit(cache=True, nogil=True)
def _fill_maps(fisheye, row, reach, left, top, width, height, maps, valid):  # type: ignore[no-untyped-def]
    """Where each pixel of the plane lies in the photograph, as OpenCV counts pixels; 255 where it shows any."""
    for v in range(maps.shape[1]):
        y = (top + v + 0.5 - row[3]) / row[1]
        for u in range(maps.shape[2]):
            x = (left + u + 0.5 - row[2]) / row[0]
            px, py = distort(fisheye, row, x, y)
            is_shown = x * x + y * y < reach * reach and 0.0 <= px <= width and 0.0 <= py <= height
            valid[v, u] = 255 if is_shown else 0
            # OpenCV has the centre of the top-left pixel at (0, 0)
            maps[0, v, u] = px - 0.5 if is_shown else 0.0
            maps[1, v, u] = py - 0.5 if is_shown else 0.0
