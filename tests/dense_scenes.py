"""Small rendered scenes with exact poses and depth for the tests of densification."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from rendered_worlds import textures
from rendered_worlds.rendering import Renderer, World
from rendered_worlds.worlds import Skin, WorldBuilder
from sfmapp.camera.camera import Camera, CameraModel
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
CAMERA = Camera(CameraModel.PINHOLE, WIDTH, HEIGHT, np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]))
# how far the cameras stand from the wall, metres
DISTANCE = 3.0
# what a pixel measures there
PIXEL_M = DISTANCE / FOCAL


@cache
def wall_with_box_and_bars() -> World:
    """A textured wall at y = 0 that faces the cameras at y < 0, a box before it, and bars of some six pixels."""
    rng = np.random.default_rng(4)
    build = WorldBuilder(rng)
    box = build.texture(textures.leaves(rng))
    # spots of some six pixels and larger ones
    spots = 128 + 90 * textures.noise(rng, 512, 32, 3)
    wall = build.texture(np.clip(np.rint(spots), 0, 255).astype(np.uint8))
    build.wall([0, 0, 0], [0, -1, 0], 8.0, 6.0, Skin(wall, 2.0))
    build.box([-0.5, -0.5, -0.4], [0.5, 0.3, 0.8], Skin(box, 0.8))
    for x in (0.25, 0.55, 0.85):
        build.cylinder([x, -0.7, -0.6], 0.024, 1.2, Skin(wall, 1.0), 8)
    return build.build()


def poses(count: int) -> Array:
    """(count, 7) cam_from_world on an arc around the middle of the wall, 40 degrees wide."""
    out = []
    for turn in np.linspace(-np.radians(20), np.radians(20), count):
        center = DISTANCE * np.array([np.sin(turn), -np.cos(turn), 0.1 * np.sin(5.0 * turn)])
        z = -center / np.linalg.norm(center)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        rotation = np.stack([x, np.cross(z, x), z])
        out.append(rigid3.from_matrix(rotation, -rotation @ center))
    return np.array(out)


def nearest_neighbors(count: int, most: int) -> NDArray[np.int32]:
    """(count, most) int32 neighbours along the arc, those two steps away first."""
    rows = []
    for m in range(count):
        order = sorted((s for s in range(count) if s != m), key=lambda s: (abs(abs(s - m) - 2), s))
        rows.append((order + [-1] * most)[:most])
    return np.array(rows, np.int32)


def scene_of(world: World, count: int, noise: float = 0.0, *, masks: list[NDArray[np.bool_]] | None = None) -> tuple[
    DenseScene, list[NDArray[np.float32]], list[NDArray[np.int32]]
]:  # fmt: skip
    """Views of a world without sparse points, their depth maps and their maps of rectangles."""
    renderer, cam_from_world = Renderer(world, CAMERA), poses(count)
    rng = np.random.default_rng(7)
    views, depths, surfaces = [], [], []
    for m, pose in enumerate(cam_from_world):
        seen = renderer.view(pose)
        grey = seen.grey + noise * rng.standard_normal(seen.grey.shape)
        rgb = np.repeat(np.clip(np.rint(grey), 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)
        mask = masks[m] if masks is not None else None
        views.append(DenseView(f"{m}.png", rgb, mask, np.array(CAMERA.params[:4]), pose))
        depths.append(seen.depth)
        surfaces.append(seen.surface)
    nothing = (np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32))
    return DenseScene(tuple(views), nearest_neighbors(count, min(6, count - 1)), *nothing), depths, surfaces


def project(view: DenseView, xyz: Array) -> tuple[Array, Array]:
    """(N, 2) pixels and (N,) depths."""
    seen = xyz @ rigid3.rotation_matrix(view.cam_from_world).T + view.cam_from_world[4:]
    return seen[:, :2] / seen[:, 2:] * view.k[:2] + view.k[2:], seen[:, 2]


def depth_errors(scene: DenseScene, depths: list[NDArray[np.float32]], xyz: Array, reference: NDArray) -> Array:
    """(N,) difference to the true depth in the reference view, the least one around the pixel: edges are half seen."""
    errors = np.full(len(xyz), np.inf)
    for m, view in enumerate(scene.views):
        mine = np.flatnonzero(reference == m)
        pixels, depth = project(view, xyz[mine])
        column, row = pixels.astype(np.int64).T
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                true = depths[m][(row + dy).clip(0, HEIGHT - 1), (column + dx).clip(0, WIDTH - 1)]
                errors[mine] = np.minimum(errors[mine], np.abs(depth - true))
    return errors
