"""Solids of exact shape, cameras around them, and their silhouettes without a renderer."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from sfmapp.camera.camera import pixels_to_rays, simple_camera
from sfmapp.camera.names import CameraModel
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.views import View, view_of_camera
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
# signed distance of points (N, 3) to a solid (N,), positive outside, never more than the true one
Solid = Callable[[Array], Array]


def ball(radius: float = 1.0, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Solid:
    return lambda xyz: np.asarray(np.linalg.norm(xyz - np.array(at), axis=1) - radius)


def box(half: tuple[float, float, float] = (0.8, 0.6, 0.5), at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Solid:
    def distance(xyz: Array) -> Array:
        q = np.abs(xyz - np.array(at)) - np.array(half)
        return np.asarray(np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0))

    return distance


def ring(radius: float = 0.8, thickness: float = 0.25) -> Solid:
    """A torus around z."""

    def distance(xyz: Array) -> Array:
        across = np.linalg.norm(xyz[:, :2], axis=1) - radius
        return np.asarray(np.hypot(across, xyz[:, 2]) - thickness)

    return distance


def both(*solids: Solid) -> Solid:
    return lambda xyz: np.asarray(np.min([solid(xyz) for solid in solids], axis=0))


def without(solid: Solid, taken: Solid) -> Solid:
    return lambda xyz: np.asarray(np.maximum(solid(xyz), -taken(xyz)))


def around(
    num: int = 12, distance: float = 5.0, width: int = 160, height: int = 120, elevation_deg: float = 20.0
) -> list[View]:
    """Cameras on a circle that look at the origin, every other one lower; z is up."""
    camera = simple_camera(CameraModel.PINHOLE, width, height, 1.6 * width)
    views = []
    for i in range(num):
        azimuth = 2.0 * np.pi * i / num
        elevation = np.radians(elevation_deg if i % 2 == 0 else -0.5 * elevation_deg)
        out = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        right = np.cross(-out, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(-out, right), -out])
        pose = np.concatenate([rigid3.quaternion(rotation), -rotation @ (distance * out)])
        views.append(view_of_camera(f"view_{i:03d}.png", camera, pose))
    return views


def shown_depth(view: View, solid: Solid, xy: Array, far: float = 20.0, steps: int = 96) -> Array:
    """Distances (N,) along the rays of pixels to a solid by sphere tracing (Hart, 1996); inf where there is none."""
    assert view.camera is not None
    assert view.cam_from_world is not None
    rays = pixels_to_rays(view.camera, xy) @ rigid3.rotation_matrix(view.cam_from_world)
    t, hit = np.zeros(len(xy)), np.zeros(len(xy), bool)
    going = np.arange(len(xy))
    for _ in range(steps):
        d = solid(view.center + t[going, None] * rays[going])
        t[going] += d
        hit[going[d < 1e-4]] = True
        going = going[(d >= 1e-4) & (t[going] < far)]
    return np.where(hit, t, np.inf)


def pixel_centers(view: View) -> Array:
    """(H W, 2), row by row."""
    grid = np.stack(np.meshgrid(np.arange(view.width), np.arange(view.height)), axis=-1)
    return np.asarray(grid.reshape(-1, 2) + 0.5)


def mask_of(view: View, solid: Solid) -> NDArray[np.bool_]:
    """(H, W) pixels whose centre shows the solid."""
    return np.asarray(np.isfinite(shown_depth(view, solid, pixel_centers(view))).reshape(view.height, view.width))


def silhouette_of(view: View, solid: Solid) -> Silhouette:
    """By the mask alone: the outline is half-way between pixel centres that differ."""
    inside = mask_of(view, solid)
    distance = distance_transform_edt(inside) - distance_transform_edt(~inside)
    return Silhouette((distance - 0.5 * np.sign(distance)).astype(np.float32))


def write_cameras(folder: Path, views: Iterable[View]) -> None:
    """``cameras.json`` of photographs in ``images/``, which counts pixels from the centre of the first one."""
    cameras = []
    for view in views:
        assert view.camera is not None
        k = view.camera.k_matrix - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        cameras.append({
            "file": f"images/{view.name}", "K": k.tolist(), "R_w2c": view.outer[:, :3].tolist(),
            "t_w2c": view.outer[:, 3].tolist(), "width": view.width, "height": view.height,
        })  # fmt: skip
    (folder / "cameras.json").write_text(json.dumps({"cameras": cameras}))
