"""A plane as a photograph shows it: from its coordinates to pixels and back, through the lens."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized, project
from sfmapp.errors import UsageError
from sfmapp.geometry.dlt import find_homographies, homogeneous
from sfmapp.scene.cube import reach_radius

Array = NDArray[np.float64]

# the corner that is nearest to the line through its neighbours has to be so far from it, in pixels
_LEAST_HEIGHT_PX = 1.0
_ORDER = "give the corners in order round it: top left, top right, bottom right, bottom left of the picture"


@dataclass(frozen=True)
class PlaneView:
    """Where a photograph shows a plane.

    Attributes:
        homography: (3, 3) from the plane to pixels, or to normalised image points where there is a camera; the third
            coordinate is positive in front of the camera.
        camera: takes its distortion into account; None: there is none.
    """

    homography: Array
    camera: Camera | None = None

    @cached_property
    def _reach(self) -> float:
        """Radius beyond which the lens would fold what it does not see back into the picture."""
        return math.inf if self.camera is None else reach_radius(self.camera)

    def seen(self, ab: Array) -> Array:
        """Pixels (N, 2) of points of the plane (N, 2); NaN at and beyond its horizon, and where the lens does not
        look."""
        flat = _mapped(np.ascontiguousarray(self.homography, np.float64), np.ascontiguousarray(ab, np.float64))
        if self.camera is None:
            return flat
        flat[~((flat**2).sum(1) < self._reach**2)] = np.nan
        return project(self.camera, homogeneous(flat))

    def on_plane(self, pixels: Array) -> Array:
        """Points of the plane (N, 2) that pixels (N, 2) show; NaN beyond the horizon."""
        flat = pixels
        if self.camera is not None:
            flat = pixels_to_normalized(self.camera, pixels)
            flat[~((flat**2).sum(1) < self._reach**2)] = np.nan
        # the last coordinate is one over the weight of the point, which is positive in front
        inverse = np.ascontiguousarray(np.linalg.inv(self.homography), np.float64)
        return _mapped(inverse, np.ascontiguousarray(flat, np.float64))


@numba.njit(cache=True, nogil=True)
def _mapped(homography: Array, xy: Array) -> Array:
    """(N, 2) points through a homography; NaN where the last coordinate is not positive."""
    out = np.empty(xy.shape)
    for n in range(xy.shape[0]):
        x, y = xy[n, 0], xy[n, 1]
        weight = homography[2, 0] * x + homography[2, 1] * y + homography[2, 2]
        unit = 1.0 / weight if weight > 0.0 else math.nan
        out[n, 0] = unit * (homography[0, 0] * x + homography[0, 1] * y + homography[0, 2])
        out[n, 1] = unit * (homography[1, 0] * x + homography[1, 1] * y + homography[1, 2])
    return out


def view_of_corners(corners: ArrayLike, size: tuple[float, float], camera: Camera | None = None) -> PlaneView:
    """The view of a rectangle of which the corners are seen.

    Args:
        corners: (4, 2) pixels, clockwise from the rectangle's own top left.
        size: its width and height, in the unit of the plane; its top left is the origin.
        camera: of the photograph; None: without distortion.

    Raises:
        UsageError: another number of corners, or some that no rectangle has: crossed, on a line, the wrong way round.
    """
    xy = np.asarray(corners, np.float64)
    if xy.shape != (4, 2) or not np.isfinite(xy).all():
        raise UsageError(f"corners: expected four pixels, finite numbers, found an array of shape {xy.shape}", _ORDER)
    flat = xy if camera is None else pixels_to_normalized(camera, xy)
    if not np.isfinite(flat).all():
        n = int(np.argmin(np.isfinite(flat).all(1)))
        raise UsageError(f"corner {n + 1} ({xy[n, 0]:g}, {xy[n, 1]:g}): the lens of the camera does not look there")
    _check_shape(flat if camera is None else flat * camera.focal, xy)
    width, height = size
    places = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
    return PlaneView(find_homographies(places[None], flat[None])[0], camera)


def _check_shape(flat: Array, corners: Array) -> None:
    """Raises UsageError if four points (4, 2) are not round a convex quadrilateral, clockwise."""
    sides = np.roll(flat, -1, axis=0) - flat
    before = np.roll(sides, 1, axis=0)
    turns = before[:, 0] * sides[:, 1] - before[:, 1] * sides[:, 0]  # positive to the right, as y points down
    shown = " ".join(f"{x:g},{y:g}" for x, y in corners)
    across = np.linalg.norm(np.roll(flat, -1, axis=0) - np.roll(flat, 1, axis=0), axis=1)
    heights = np.abs(turns) / np.maximum(across, 1e-9)
    if heights.min() < _LEAST_HEIGHT_PX:
        n = int(heights.argmin())
        raise UsageError(
            f"corners {shown}: corner {n + 1} lies {heights[n]:.2f} pixels from the line through its neighbours",
            "the four corners of a rectangle are needed, no three of them on one line",
        )
    if (turns > 0.0).all():
        return
    if (turns < 0.0).all():
        raise UsageError(f"corners {shown}: they go round the other way, and the picture would be mirrored", _ORDER)
    if (turns > 0.0).sum() == 2:
        raise UsageError(f"corners {shown}: the sides cross each other", _ORDER)
    raise UsageError(f"corners {shown}: one of them lies inside the others, which no view of a rectangle shows", _ORDER)


def check_in_photograph(corners: Array, size: tuple[int, int], name: str) -> list[str]:
    """Warnings of corners that lie outside of a photograph, of size width and height.

    Raises:
        UsageError: all of them do so to one side, or one is farther out than the photograph is long.
    """
    low, high = np.zeros(2), np.array(size, np.float64)
    is_out = (corners < low) | (corners > high)
    beyond = np.maximum(low - corners, corners - high).max(1)
    is_apart = (corners < low).all(0).any() or (corners > high).all(0).any()
    worst = int(beyond.argmax())
    place = f"corner {worst + 1} ({corners[worst, 0]:g}, {corners[worst, 1]:g})"
    if is_apart or beyond[worst] > max(size):
        raise UsageError(
            f"{place} lies outside of {name}, which is {size[0]} x {size[1]}",
            "pixels are those of the file as it is stored, before EXIF turns it: x to the right, y down",
        )
    if is_out.any():
        return [f"{place} lies {beyond[worst]:.1f} pixels outside of {name}: what is not in it is left out"]
    return []
