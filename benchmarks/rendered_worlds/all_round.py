"""Photographs through any lens, however wide: pinhole pictures on the faces of a cube, resampled along the lens's rays.

The ray caster of :mod:`rendered_worlds.rendering` works on the plane in front of a camera and ends before a right angle
from its axis. Six of its pictures about one centre show everything. They are finer than the photograph, and each of its
pixels is the mean of several samples of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rendered_worlds.rendering import Optics, Renderer, World
from sfmapp.camera.camera import Camera, pixels_to_rays
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

SAMPLES = 2  # a side of a pixel
FINER = 1.5  # pixels of a face for one of the photograph, a side, where the face is coarsest and the lens is as usual
MARGIN_PX = 2  # of a face beyond its right angle, for bilinear samples
# the face's camera from the photograph's: ahead, right, behind, left, below, above
_FACES = np.array([
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 0, -1], [0, 1, 0], [1, 0, 0]], [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],
    [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
], np.float64)  # fmt: skip


class AllRoundRenderer:
    """Renders a world through a lens of any family and width; black where the lens shows nothing."""

    def __init__(self, world: World, camera: Camera) -> None:
        self.world = world
        self.camera = camera

    @cached_property
    def rays(self) -> Array:
        """(H S, W S, 3) unit rays of the samples, S to a pixel's side; NaN where the lens has no inverse."""
        width, height = self.camera.width, self.camera.height
        x, y = np.meshgrid(*((np.arange(side * SAMPLES) + 0.5) / SAMPLES for side in (width, height)))
        return pixels_to_rays(self.camera, np.stack([x.ravel(), y.ravel()], 1)).reshape(*x.shape, 3)

    @cached_property
    def _face_camera(self) -> Camera:
        """A pinhole that sees a little more than a right angle, finer in its middle than the lens is in most places."""
        steps = np.linalg.norm(np.diff(self.rays, axis=1), axis=2)
        half = math.ceil(FINER / (SAMPLES * float(np.nanmedian(steps))))
        side = 2 * (half + MARGIN_PX)
        return Camera(CameraModel.PINHOLE, side, side, np.array([half, half, side / 2, side / 2]))

    @cached_property
    def _maps(self) -> list[tuple[NDArray[np.bool_], NDArray[np.float32]]]:
        """For each face the samples on it (H S, W S), and where they are, (N, 2) pixels as OpenCV counts them."""
        nearest = np.argmax(np.nan_to_num(self.rays @ _FACES[:, 2].T), axis=2)
        nearest[np.isnan(self.rays[..., 0])] = -1
        maps = []
        for k, face in enumerate(_FACES):
            on_face = nearest == k
            x, y, z = face @ self.rays[on_face].T
            fx, fy, cx, cy = self._face_camera.params
            maps.append((on_face, np.stack([fx * x / z + cx - 0.5, fy * y / z + cy - 0.5], 1).astype(np.float32)))
        return maps

    def view(self, cam_from_world: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Grey values (H, W), neither rounded nor clipped, and the distance (H, W) of the nearest that is seen, inf of
        nothing."""
        renderer = Renderer(self.world, self._face_camera)
        rotation, center = rigid3.rotation_matrix(cam_from_world), rigid3.center(cam_from_world)
        grey = np.zeros(self.rays.shape[:2], np.float32)
        distance = np.full(self.rays.shape[:2], np.inf, np.float32)
        for (on_face, places), face in zip(self._maps, _FACES, strict=True):
            if not len(places):
                continue
            turned = face @ rotation
            seen = renderer.view(rigid3.from_matrix(turned, -turned @ center))
            depth = np.where(np.isfinite(seen.depth), seen.depth, np.float32(0))
            # OpenCV takes at most 32766 rows
            rows = np.array_split(places, max(1, -(-len(places) // 30_000)))
            grey[on_face] = np.concatenate(
                [cv2.remap(seen.grey, part[:, None], None, cv2.INTER_LINEAR)[:, 0] for part in rows]
            )
            here = np.concatenate([cv2.remap(depth, part[:, None], None, cv2.INTER_NEAREST)[:, 0] for part in rows])
            along = (self.rays[on_face] @ face[2]).astype(np.float32)
            distance[on_face] = np.where(here > 0, here / along, np.inf)
        height, width = self.camera.height, self.camera.width
        mean: NDArray[np.float32] = grey.reshape(height, SAMPLES, width, SAMPLES).mean(axis=(1, 3), dtype=np.float32)
        return mean, distance.reshape(height, SAMPLES, width, SAMPLES).min(axis=(1, 3))

    def photograph(self, cam_from_world: ArrayLike, optics: Optics, key: Sequence[int]) -> NDArray[np.uint8]:
        """An (H, W) uint8 image with the sensor's noise, drawn from the integers of ``key``; no vignetting, no blur."""
        grey, _ = self.view(cam_from_world)
        rng = np.random.default_rng([*key, 0x2E17DE3])
        grey += np.float32(optics.noise_sigma) * rng.standard_normal(grey.shape, np.float32)
        image: NDArray[np.uint8] = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
        return image
