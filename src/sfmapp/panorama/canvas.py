"""The surfaces that a panorama is drawn on: sphere, cylinder, plane."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_rays, project
from sfmapp.panorama.warp import Axes, Lenses

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

Projection = Literal["spherical", "cylindrical", "planar"]

# A plane stretches what is 45 degrees off its axis by two; a cylinder what is 50 degrees above the horizon by 2.4.
_MOST_OF_PLANE, _MOST_OF_CYLINDER = math.radians(45.0), math.radians(50.0)
# where a projection that was asked for stops: its picture grows without bound
_END_OF_PLANE, _END_OF_CYLINDER = math.radians(75.0), math.radians(80.0)
# places along each side of a photograph that tell how far it reaches
_STEPS = 65
_BIN = math.radians(2.0)


@dataclass(frozen=True)
class View:
    """A photograph as the panorama uses it.

    Attributes:
        camera: that took it. rotation: (3, 3) cam_from_world.
        least_z: z of unit rays in the corners: what lies farther from the axis is not in the photograph, wherever the
            polynomial of its distortion may put it.
    """

    camera: Camera
    rotation: Array
    least_z: float

    @staticmethod
    def of(camera: Camera, rotation: Array) -> View:
        """With what the lens shows."""
        rays = pixels_to_rays(camera, _border(camera))
        return View(camera, rotation, float(np.nanmin(rays[:, 2])) - 1e-3)

    def pixels(self, rays: Array) -> tuple[Array, Mask]:
        """Pixels (N, 2) of directions in the world (N, 3), and which of them the photograph shows."""
        seen = rays @ self.rotation.T
        xy = project(self.camera, seen)
        x, y = xy.T
        inside = (seen[:, 2] >= self.least_z) & (x > 0.5) & (x < self.camera.width - 0.5)
        inside &= (y > 0.5) & (y < self.camera.height - 0.5)
        return xy, inside


def lenses_of(views: Sequence[View]) -> Lenses:
    """The photographs as kernels see them."""
    return Lenses(
        np.array([view.rotation for view in views], np.float64),
        np.array([view.camera.canonical for view in views], np.float64),
        np.array([(view.camera.width, view.camera.height) for view in views], np.float64),
        np.array([view.least_z for view in views], np.float64),
    )


@dataclass(frozen=True)
class Canvas:
    """A surface about the place that the photographs were taken from.

    The point (x, y) of the surface is at pixel (x scale - left, y scale - top), the centre of the first one at 0.5; x
    is the angle around the vertical axis, or the tangent of it on a plane; y the angle below the horizon, or its
    tangent.

    Attributes:
        projection: its kind. scale: pixels of a radian, or of the unit of tangents.
        left, top: of the picture, pixels. width, height: of it.
        is_closed: it goes all round, and its right side continues at its left.
    """

    projection: Projection
    scale: float
    left: float
    top: float
    width: int
    height: int
    is_closed: bool

    def axes(self, columns: Array, rows: Array) -> Axes:
        """Directions in the world of pixels at these places."""
        x, y = (columns + self.left) / self.scale, (rows + self.top) / self.scale
        if self.projection == "planar":
            return Axes(x, np.ones_like(x), np.ones_like(y), y)
        if self.projection == "cylindrical":
            return Axes(np.sin(x), np.cos(x), np.ones_like(y), y)
        return Axes(np.sin(x), np.cos(x), np.cos(y), np.sin(y))

    def scaled(self, factor: float) -> Canvas:
        """The same surface with fewer pixels; a closed one keeps whole columns, so its scale may differ a little."""
        width, height = max(1, round(self.width * factor)), max(1, math.ceil(self.height * factor))
        by = width / self.width if self.is_closed else factor
        return replace(self, scale=self.scale * by, left=self.left * by, top=self.top * by, width=width, height=height)


def choose_canvas(views: Sequence[View], projection: Projection | None, max_size: int | None) -> Canvas:
    """The surface for what the photographs show, at the resolution that they have in their middles.

    Args:
        projection: None for a plane where all lies within 45 degrees of the middle, a sphere where it goes all round or
            more than 50 degrees up or down, and a cylinder otherwise.
        max_size: limit of the longer side, pixels.
    """
    rays = np.concatenate([_shown(view) for view in views])
    angle, below = np.arctan2(rays[:, 0], rays[:, 2]), np.arcsin(np.clip(rays[:, 1], -1.0, 1.0))
    start, span = _arc(angle)
    poles = [any(bool(view.pixels(np.array([[0.0, sign, 0.0]]))[1][0]) for view in views) for sign in (-1.0, 1.0)]
    is_closed = span >= 2.0 * math.pi or any(poles)
    if projection is None:
        projection = _best(angle, below, is_closed)
    scale = float(np.median([view.camera.focal for view in views]))
    x_low, x_high = (-math.pi, math.pi) if is_closed else (start, start + span)
    y_low, y_high = float(below.min()), float(below.max())
    if projection == "spherical":
        y_low, y_high = -math.pi / 2 if poles[0] else y_low, math.pi / 2 if poles[1] else y_high
    else:
        end = _END_OF_PLANE if projection == "planar" else _END_OF_CYLINDER
        if projection == "planar":
            is_closed = False
            kept = rays[rays[:, 2] > math.cos(end)]
            slopes = kept[:, :2] / kept[:, 2:]
            (x_low, y_low), (x_high, y_high) = slopes.min(0).tolist(), slopes.max(0).tolist()
        else:
            y_low, y_high = math.tan(max(y_low, -end)), math.tan(min(y_high, end))
    longest = scale * max(x_high - x_low, y_high - y_low)
    if max_size is not None and longest > max_size:
        scale *= max_size / longest
    width, height = (max(1, math.floor(scale * reach)) for reach in (x_high - x_low, y_high - y_low))
    if is_closed:  # whole columns all round
        scale = width / (2.0 * math.pi)
    return Canvas(projection, scale, x_low * scale, y_low * scale, width, height, is_closed)


def _best(angle: Array, below: Array, is_closed: bool) -> Projection:
    up = float(np.abs(below).max())
    if not is_closed and max(float(np.abs(angle).max()), up) <= _MOST_OF_PLANE:
        return "planar"
    return "spherical" if is_closed or up > _MOST_OF_CYLINDER else "cylindrical"


def _arc(angle: Array) -> tuple[float, float]:
    """Start and length of the shortest arc that holds all angles; the whole circle if no gap is left."""
    num = round(2.0 * math.pi / _BIN)
    filled = np.zeros(num, bool)
    filled[((angle + math.pi) / _BIN).astype(int) % num] = True
    if filled.all():
        return -math.pi, 2.0 * math.pi
    # the longest run of empty bins
    twice = np.concatenate([filled, filled])
    ends = np.flatnonzero(twice)
    gaps = np.diff(ends)
    behind = ends[np.argmax(gaps)] + gaps.max()  # the first filled bin behind the gap
    first = (behind % num) * _BIN - math.pi
    turned = (angle - first) % (2.0 * math.pi)
    low, high = float(turned.min()), float(turned.max())
    start = first + low
    if start > math.pi / 2:  # so that the middle of the panorama is at zero, or near it
        start -= 2.0 * math.pi
    return start, high - low


def _border(camera: Camera) -> Array:
    steps = np.linspace(0.5, 1.0, _STEPS)
    steps = np.concatenate([1.0 - steps[::-1], steps])
    x, y = steps * (camera.width - 1.0) + 0.5, steps * (camera.height - 1.0) + 0.5
    sides = [np.column_stack([x, np.full_like(x, at)]) for at in (0.5, camera.height - 0.5)]
    sides += [np.column_stack([np.full_like(y, at), y]) for at in (0.5, camera.width - 0.5)]
    return np.concatenate(sides)


def _shown(view: View) -> Array:
    """Directions in the world that a photograph shows, all over it."""
    camera = view.camera
    steps = np.linspace(0.0, 1.0, _STEPS)
    x, y = np.meshgrid(steps * (camera.width - 1.0) + 0.5, steps * (camera.height - 1.0) + 0.5)
    rays = pixels_to_rays(camera, np.column_stack([x.ravel(), y.ravel()]))
    return np.asarray(rays[np.isfinite(rays[:, 0])] @ view.rotation, np.float64)
