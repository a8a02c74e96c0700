"""Photographs without their distortion, at working resolution."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized
from sfmapp.camera.lens import distort, project
from sfmapp.camera.names import CameraModel
from sfmapp.scene.cube import reach_angle, reach_radius
from sfmapp.scene.undistortion import has_distortion
from sfmapp.simd.cubic import cubic_weights

Array = NDArray[np.float64]

# what a wide lens shows farther out than this, in sides of the photograph, would be stretched more than it is worth
LARGEST_MARGIN = 0.125
# pixels beyond the border of a panorama that the interpolation reaches for
_SEAM = 2


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
        return has_distortion(self.camera)


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
    shown: NDArray[np.uint8] | None = None
    opacity = None if mask is None else mask.astype(np.uint8) * 255
    if canvas.is_distorted:
        rgb, shown, opacity = _undistort(canvas, rgb, opacity)
    else:
        rgb = rgb[: canvas.height, : canvas.width]
        opacity = None if opacity is None else opacity[: canvas.height, : canvas.width]
    if canvas.working_size != (canvas.width, canvas.height):
        rgb = cv2.resize(rgb, canvas.working_size, interpolation=cv2.INTER_AREA)
        opacity, shown = (
            None if plane is None else cv2.resize(plane, canvas.working_size, interpolation=cv2.INTER_AREA)
            for plane in (opacity, shown)
        )
    # of a mask most of a pixel has to be open; what lies beyond the photograph may have no part in one
    usable = np.ones(rgb.shape[:2], np.bool_) if opacity is None else opacity > 127
    usable &= True if shown is None else shown == 255
    return np.ascontiguousarray(rgb), None if usable.all() else usable


def _undistort(
    canvas: Canvas, rgb: NDArray[np.uint8], opacity: NDArray[np.uint8] | None
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8] | None]:
    """At full resolution: colours, 255 where the photograph shows them, and the mask."""
    camera, size = canvas.camera, (canvas.width, canvas.height)
    fx, fy, cx, cy = camera.canonical[:4]
    k = np.array([fx, fy, cx - canvas.left, cy - canvas.top])
    flat, shown = resample(camera, k, size, rgb)
    return flat, shown, None if opacity is None else resample(camera, k, size, opacity)[0]


def resample(
    camera: Camera, k: Array, size: tuple[int, int], pixels: NDArray[Any], plane_from_cam: Array | None = None
) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """What a pinhole shows of a photograph.

    Args:
        camera: of the photograph.
        k: (4,) ``fx, fy, cx, cy`` of the pinhole, in pixels.
        size: its width and height in pixels.
        pixels: (H, W) or (H, W, C), uint8 or uint16; a channel of 16 bits never gets brighter than its brightest pixel,
            for cameras write fewer bits into them.
        plane_from_cam: (3, 3) rotation to the axes of the pinhole; None where it looks where the camera does.

    Returns:
        The same of (h, w), and (h, w) 255 where the photograph shows it: beyond, its border is carried on.
    """
    layers = np.ascontiguousarray(pixels if pixels.ndim == 3 else pixels[..., None])
    white = np.full(layers.shape[2], 255.0) if layers.dtype == np.uint8 else layers.max(axis=(0, 1)).astype(np.float64)
    flat, shown = np.empty((size[1], size[0], layers.shape[2]), layers.dtype), np.empty(size[::-1], np.uint8)
    row = camera.canonical
    if plane_from_cam is None:
        _resample(layers, row, reach_radius(camera), k, white, flat, shown)
    else:
        if camera.model == CameraModel.EQUIRECTANGULAR:
            layers = _with_neighbors(layers)
            row[2:4] += _SEAM
        cam_from_plane = np.ascontiguousarray(plane_from_cam.T)
        _resample_turned(layers, row, math.cos(reach_angle(camera)), cam_from_plane, k, white, flat, shown)
    return flat.reshape(size[1], size[0], *pixels.shape[2:]), shown


def _with_neighbors(panorama: NDArray[Any]) -> NDArray[Any]:
    """A panorama (H, W, C) with a rim of what is beyond its border: the other end, and across the poles half round."""
    wide = np.concatenate([panorama[:, -_SEAM:], panorama, panorama[:, :_SEAM]], axis=1)
    half = panorama.shape[1] // 2
    above, below = (np.roll(wide[rows][::-1], half, axis=1) for rows in (slice(_SEAM), slice(-_SEAM, None)))
    return np.ascontiguousarray(np.concatenate([above, wide, below]))


@numba.njit(cache=True, nogil=True, inline="always")
def _interpolate(pixels: NDArray[Any], px: float, py: float, white: NDArray[np.float64], out: NDArray[Any]) -> None:
    """Fill out (C,) with the colour of a photograph (H, W, C) at a pixel."""
    height, width, channels = pixels.shape
    px, py = min(max(px, 0.0), float(width)) - 0.5, min(max(py, 0.0), float(height)) - 0.5
    i, j = math.floor(px), math.floor(py)
    wx, wy = cubic_weights(px - i), cubic_weights(py - j)
    for c in range(channels):
        total = 0.5
        for b in range(4):
            line = pixels[min(max(j - 1 + b, 0), height - 1)]
            for a in range(4):
                total += wy[b] * wx[a] * line[min(max(i - 1 + a, 0), width - 1), c]
        out[c] = int(min(max(total, 0.0), white[c]))


@numba.njit(cache=True, nogil=True)
def _resample(
    pixels: NDArray[Any], row: NDArray[np.float64], reach: float, k: NDArray[np.float64], white: NDArray[np.float64],
    out: NDArray[Any], shown: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Fill out (h, w, C) of the plane of k from a photograph (H, W, C); shown (h, w): 255 where it shows any of it.

    The border of the photograph is carried on, so that pixels at the edge have company of their kind.
    """
    height, width, _ = pixels.shape
    for v in range(out.shape[0]):
        y = (v + 0.5 - k[3]) / k[1]
        for u in range(out.shape[1]):
            x = (u + 0.5 - k[2]) / k[0]
            px, py = distort(row, x, y)
            is_shown = x * x + y * y < reach * reach and 0.0 <= px <= width and 0.0 <= py <= height
            shown[v, u] = 255 if is_shown else 0
            _interpolate(pixels, px, py, white, out[v, u])


@numba.njit(cache=True, nogil=True)
def _resample_turned(
    pixels: NDArray[Any], row: NDArray[np.float64], cos_reach: float, cam_from_plane: NDArray[np.float64],
    k: NDArray[np.float64], white: NDArray[np.float64], out: NDArray[Any], shown: NDArray[np.uint8],
) -> None:  # fmt: skip
    """As :func:`_resample`, for a plane that looks elsewhere and lenses that see all round."""
    height, width, _ = pixels.shape
    r = cam_from_plane
    for v in range(out.shape[0]):
        y = (v + 0.5 - k[3]) / k[1]
        for u in range(out.shape[1]):
            x = (u + 0.5 - k[2]) / k[0]
            a = r[0, 0] * x + r[0, 1] * y + r[0, 2]
            b = r[1, 0] * x + r[1, 1] * y + r[1, 2]
            c = r[2, 0] * x + r[2, 1] * y + r[2, 2]
            px, py = project(row, a, b, c)
            is_shown = c >= cos_reach * math.sqrt(a * a + b * b + c * c)
            is_shown &= 0.0 <= px <= width and 0.0 <= py <= height
            shown[v, u] = 255 if is_shown else 0
            if math.isnan(px):
                px = py = 0.0
            _interpolate(pixels, px, py, white, out[v, u])
