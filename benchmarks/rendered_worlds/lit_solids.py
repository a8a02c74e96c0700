"""Solids with hollows that silhouettes cannot show, and a camera that goes round them with lamps about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rendered_worlds.solids import BALL, BOX, CYLINDER, RING, Lamps, Solid, shape
from sfmapp.camera.camera import Camera, simple_camera
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

DISTANCE = 5.0
# heights of the lowest and the highest camera, shares of the distance: 20 degrees below to 65 above the horizon
LOWEST, HIGHEST = -0.35, 0.9
# where lamps stand about the camera, as seen from the solid: degrees to the right and above
LAMPS_DEG = ((-55, 0), (55, 0), (0, 32), (0, -32), (-20, 20), (20, 20), (35, -35), (-35, -35))
# the same near the camera, where single shadows tell of all edges that are no sharper than 20 degrees; the last four
# are farther, and of use by their mixtures
NEAR_LAMPS_DEG = ((-19, 0), (19, 0), (0, 19), (0, -19), (-28, 28), (28, 28), (28, -28), (-28, -28))
# in between, where what shadows tell is not bound by their width: of use if the object's edges are told
WIDE_LAMPS_DEG = ((-30, 0), (30, 0), (0, 30), (0, -30))
X, Y = (0.0, np.pi / 2, 0.0), (np.pi / 2, 0.0, 0.0)


@dataclass(frozen=True)
class Rig:
    """Positions of a camera (7,) in the frame of the solid, and the lamps that stand beside it.

    Attributes:
        camera: lens and picture. poses: (N, 7) camera from world. lamps: for each pose, in the frame of the solid.
    """

    camera: Camera
    poses: Array
    lamps: list[Array]


def around(num_views: int, num_lamps: int, width: int = 480, lamps_deg: Sequence[tuple[int, int]] = LAMPS_DEG) -> Rig:
    """A camera with lamps goes round a solid of radius 1, from a little below it to high above.

    Heights rise evenly along the axis and each position is the golden angle from the last, which spreads any number of
    them evenly over the sphere.
    """
    n = np.arange(num_views)
    heights = LOWEST + (HIGHEST - LOWEST) * (n + 0.5) / num_views
    elevations = np.degrees(np.arcsin(heights))
    return looking_in(n * 180.0 * (3.0 - np.sqrt(5.0)), elevations, lamps_deg[:num_lamps], width)


def looking_in(azimuths_deg: Array, elevations_deg: Array, lamps_deg: Sequence[tuple[int, int]], width: int) -> Rig:
    """A camera at given places about a solid, with lamps to the right of it and above it, degrees."""
    camera = simple_camera(CameraModel.PINHOLE, width, width * 3 // 4, 1.65 * width)
    poses, lamps = [], []
    # directions from the middle, in the camera's axes: x to the right, y down, z ahead
    aside, above = np.radians(np.array(lamps_deg)).T
    toward = np.stack([np.sin(aside) * np.cos(above), -np.sin(above), -np.cos(aside) * np.cos(above)], axis=1)
    for azimuth, elevation in zip(azimuths_deg, elevations_deg, strict=True):
        out = _direction(float(azimuth), float(elevation))
        right = np.cross(-out, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(-out, right), -out])
        poses.append(np.concatenate([rigid3.quaternion(rotation), [0.0, 0.0, DISTANCE]]))
        lamps.append(DISTANCE * toward @ rotation)
    return Rig(camera, np.array(poses), lamps)


def lamps_at(places: Array) -> Lamps:
    """Lamps that make what is white and straight below them at the solid's middle as bright as can be told."""
    return Lamps(np.ascontiguousarray(places), np.full(len(places), DISTANCE**2))


def _direction(azimuth_deg: float, elevation_deg: float) -> Array:
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def house() -> Solid:
    """A block with an arch through it, a deep cavity, a bowl and a niche."""
    return Solid(
        np.array([
            shape(BOX, (0, 0, 0), (0.62, 0.5, 0.5)),
            shape(BOX, (0, 0, -0.4), (0.2, 0.8, 0.3), taken=True),
            shape(CYLINDER, (0, 0, -0.1), (0.2, 0.8), taken=True, turn=Y),
            shape(BOX, (0.5, 0.0, 0.1), (0.42, 0.3, 0.25), taken=True, albedo=0.5),
            shape(BALL, (-0.72, 0.0, 0.1), 0.36, taken=True, albedo=0.7),
            shape(BOX, (0.0, -0.5, 0.3), (0.4, 0.2, 0.12), taken=True),
        ]),
        1.0,
    )  # fmt: skip


def jug() -> Solid:
    """A hollow cylinder with a handle, standing on a ring, with dents."""
    return Solid(
        np.array([
            shape(CYLINDER, (0, 0, 0), (0.5, 0.55), rounding=0.05),
            shape(RING, (0.55, 0, 0.05), (0.28, 0.08), turn=(np.pi / 2, 0, 0), albedo=0.5),
            shape(RING, (0, 0, -0.5), (0.55, 0.12), albedo=0.5),
            shape(CYLINDER, (0, 0, 0.35), (0.4, 0.6), taken=True, rounding=0.05),
            shape(BALL, (-0.6, 0.1, 0.0), 0.28, taken=True, albedo=0.7),
            shape(BALL, (0.1, -0.65, 0.1), 0.33, taken=True, albedo=0.7),
            shape(BOX, (0.1, 0.5, -0.1), (0.25, 0.12, 0.2), taken=True),
        ]),
        1.0,
    )  # fmt: skip


def rack() -> Solid:
    """Thin shelves on posts before a wall, with a bowl and a slot: thin parts, and hollows between them."""
    posts = [shape(CYLINDER, (x, -0.3, -0.1), (0.05, 0.45)) for x in (-0.45, 0.45)]
    return Solid(
        np.array([
            shape(BOX, (0, 0, -0.52), (0.6, 0.42, 0.06)),
            shape(BOX, (0, 0, -0.12), (0.55, 0.38, 0.03), rounding=0.01, albedo=0.5),
            shape(BOX, (0, 0, 0.28), (0.55, 0.38, 0.03), rounding=0.01),
            shape(BOX, (0, 0.34, -0.1), (0.5, 0.05, 0.45), albedo=0.7),
            *posts,
            shape(BALL, (0.2, -0.05, 0.5), 0.24),
            shape(BALL, (0.2, -0.05, 0.62), 0.2, taken=True, albedo=0.5),
            shape(BOX, (-0.25, -0.2, -0.48), (0.2, 0.06, 0.1), taken=True),
        ]),
        1.0,
    )  # fmt: skip


def wheel() -> Solid:
    """A thin rim about a hub with a blind hole, held by spokes, on a foot."""
    spokes = [shape(CYLINDER, (0, 0, 0.1), (0.045, 0.55), turn=(t, 0.0, 0.0)) for t in (0.3, 1.35, 2.4)]
    return Solid(
        np.array([
            shape(RING, (0, 0, 0.1), (0.58, 0.07), turn=X),
            shape(CYLINDER, (0, 0, 0.1), (0.2, 0.22), turn=X, albedo=0.5),
            *spokes,
            shape(BOX, (0, 0, -0.66), (0.3, 0.4, 0.14)),
            shape(CYLINDER, (0.2, 0, 0.1), (0.11, 0.3), taken=True, turn=X, albedo=0.7),
            shape(BALL, (0.0, -0.42, -0.45), 0.2, taken=True),
        ]),
        1.0,
    )  # fmt: skip


def drawn(seed: int) -> Solid:
    """A lump of rounded shapes with hollows, drawn at random."""
    rng = np.random.default_rng([seed, 0x50C1D])
    shapes = []
    for _ in range(3):
        kind = (BOX, BALL, CYLINDER)[rng.integers(3)]
        sizes = rng.uniform(0.3, 0.5, 3)
        shapes.append(shape(kind, rng.uniform(-0.25, 0.25, 3), sizes, rounding=0.05, turn=rng.normal(0, 1, 3)))
    for _ in range(6):
        out = rng.normal(0, 1, 3)
        at = out / np.linalg.norm(out) * rng.uniform(0.35, 0.65)
        kind = (BOX, BALL, CYLINDER)[rng.integers(3)]
        sizes, albedo = rng.uniform(0.12, 0.32, 3), rng.uniform(0.35, 0.8)
        shapes.append(shape(kind, at, sizes, taken=True, turn=rng.normal(0, 1, 3), albedo=albedo))
    return Solid(np.array(shapes), 1.0)
