"""Scenes of rendered worlds for depth maps: seven photographs beside and above each other, with exact depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rendered_worlds.rendering import Optics, Renderer, World
from rendered_worlds.worlds import cluttered_world, gallery_world, hall_world, room_world, street_world
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.dense.selection import select_neighbors
from sfmapp.geometry import rigid3

Map = NDArray[np.float32]

WIDTH, HEIGHT, FOCAL = 752, 480, 620.0
# to the right and upwards of the first, in baselines; they look at one place
PLACES = ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.2), (0.3, 0.8), (-0.2, -0.7), (2.0, 0.1), (-2.0, 0.0))
# of each view, to tell from where to where planes are swept
NUM_POINTS = 150
# a place is the one that another view shows if its depth differs by less than this share
SAME_DEPTH = 0.02


@dataclass(frozen=True)
class Setting:
    """Where the first photograph is taken, its heading and tilt in degrees, and the baseline in metres."""

    name: str
    make: Callable[[], World]
    center: tuple[float, float, float]
    heading_deg: float
    tilt_deg: float
    baseline: float


FITTED = (
    Setting("room 1", lambda: room_world(1), (1.6, -1.9, 1.5), 120.0, -12.0, 0.15),
    Setting("gallery 1", lambda: gallery_world(1), (-1.2, -1.5, 1.4), 60.0, -10.0, 0.25),
    Setting("hall 1", lambda: hall_world(1), (2.0, -5.0, 1.8), 75.0, -8.0, 0.5),
    Setting("street 1", lambda: street_world(1), (-24.0, -1.6, 1.65), 30.0, -1.0, 0.8),
)
JUDGED = (
    Setting("room 2", lambda: room_world(2), (-1.4, 1.0, 1.4), -60.0, -14.0, 0.2),
    Setting("gallery 2", lambda: gallery_world(2), (1.0, -1.0, 1.4), 100.0, -10.0, 0.3),
    Setting("hall 2", lambda: hall_world(2), (-2.5, 4.0, 2.2), -70.0, -12.0, 0.6),
    Setting("street 2", lambda: street_world(2), (10.0, -1.6, 1.65), 60.0, 0.0, 0.6),
    Setting("clutter", lambda: cluttered_world(1), (0.0, 0.0, 0.0), 0.0, 0.0, 0.3),
)
# these were drawn after everything was chosen, and chose nothing
FRESH = (
    Setting("room 5", lambda: room_world(5), (1.2, 1.4, 1.5), -150.0, -10.0, 0.15),
    Setting("hall 5", lambda: hall_world(5), (3.0, 3.0, 2.0), -120.0, -8.0, 0.5),
    Setting("street 5", lambda: street_world(5), (4.0, -1.6, 1.65), 40.0, -1.0, 0.7),
)


def rendered_scene(setting: Setting, noise_sigma: float = 2.0) -> tuple[DenseScene, list[Map]]:
    """The scene, and of each view its depth (H, W), NaN where there is nothing. Exposures differ by 5 per cent."""
    camera = Camera(CameraModel.PINHOLE, WIDTH, HEIGHT, np.array([FOCAL, FOCAL, WIDTH / 2 + 3.3, HEIGHT / 2 - 2.1]))
    renderer = Renderer(setting.make(), camera)
    heading, tilt = np.radians([setting.heading_deg, setting.tilt_deg])
    ahead = np.array([np.cos(heading) * np.cos(tilt), np.sin(heading) * np.cos(tilt), np.sin(tilt)])
    first = _pose(np.array(setting.center), ahead)
    depth = renderer.view(first, edge_samples=False).depth
    target = np.array(setting.center) + float(np.median(depth[np.isfinite(depth)])) * ahead
    across, down = rigid3.rotation_matrix(first)[:2]
    views, depths = [], []
    for n, (right, up) in enumerate(PLACES):
        center = np.array(setting.center) + setting.baseline * (right * across - up * down)
        pose = _pose(center, target - center)
        optics, gain = Optics(noise_sigma=noise_sigma), 1.0 + 0.05 * (n % 3 - 1)
        grey = renderer.photograph(pose, optics, [7, n], gain=gain)
        depth = renderer.view(pose, edge_samples=False).depth
        views.append(
            DenseView(f"{setting.name}, {n}", np.repeat(grey[..., None], 3, axis=2), None, camera.params, pose)
        )
        depths.append(np.where(np.isfinite(depth), depth, np.nan).astype(np.float32))
    points, ptr, seen = _points(views, depths)
    poses = np.array([view.cam_from_world for view in views])
    neighbors, _ = select_neighbors(np.full(len(views), FOCAL), poses, points, ptr, seen, 8)
    return DenseScene(tuple(views), neighbors, points, ptr, seen), depths


def _pose(center: NDArray[np.float64], ahead: NDArray[np.float64]) -> NDArray[np.float64]:
    """(7,) of a camera that is not rolled; up is z."""
    ahead = ahead / np.linalg.norm(ahead)
    across = np.cross(ahead, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    rotation = np.stack([across, np.cross(ahead, across), ahead])
    return rigid3.from_matrix(rotation, -rotation @ center)


def _points(
    views: list[DenseView], depths: list[Map]
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int32]]:
    """Places of random pixels that two views or more show, as a scene has them."""
    rng = np.random.default_rng(0)
    places = []
    for view, depth in zip(views, depths, strict=True):
        v, u = np.nonzero(np.isfinite(depth))
        chosen = rng.choice(len(v), NUM_POINTS, replace=False)
        u, v = u[chosen], v[chosen]
        rays = np.stack([(u + 0.5 - view.k[2]) / view.k[0], (v + 0.5 - view.k[3]) / view.k[1], np.ones(len(u))], 1)
        places.append(rigid3.apply(rigid3.inverse(view.cam_from_world), rays * depth[v, u, None]))
    xyz = np.concatenate(places)
    shown = np.zeros((len(xyz), len(views)), np.bool_)
    for m, (view, depth) in enumerate(zip(views, depths, strict=True)):
        pixel, far = view.project(xyz)
        inside = np.flatnonzero(view.shows(pixel))
        x, y = pixel[inside].astype(np.int64).T
        shown[inside, m] = np.abs(depth[y, x] / far[inside] - 1.0) < SAME_DEPTH
    kept = shown.sum(axis=1) >= 2
    ptr = np.concatenate([[0], np.cumsum(shown[kept].sum(axis=1))]).astype(np.int64)
    return xyz[kept], ptr, np.nonzero(shown[kept])[1].astype(np.int32)
