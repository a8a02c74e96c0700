"""A hall that looks the same after half a turn, but for one corner, and walks in it. Metres, z up.

Its bays repeat along each side, so a view of a wall may be of any of them, and half a turn about the middle takes the
hall to itself: only what stands in one corner tells the two ends apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rendered_worlds import textures
from rendered_worlds.motion import CAM_FROM_BODY
from rendered_worlds.rendering import Optics, World
from rendered_worlds.sequences import RenderedSequence, _sequence
from rendered_worlds.worlds import UP, Skin, WorldBuilder
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]

CAMERA = Camera(CameraModel.PINHOLE, 320, 240, np.array([220.0, 220.0, 160.0, 120.0]))
FRAMES_PER_SECOND, STEP_M = 15.0, 0.08
OPTICS = Optics(noise_sigma=2.0, edge_samples=False)
# Half of the length and of the width, the height, and the bays of one side.
HALF_LENGTH_M, HALF_WIDTH_M, _HEIGHT_M, _NUM_BAYS = 8.0, 3.5, 3.6, 4
# The way round it: half of the straights, and the radius of the ends.
_STRAIGHT_M, _RADIUS_M = 4.2, 1.5
# Where the corner is that has no like.
CORNER = np.array([HALF_LENGTH_M, HALF_WIDTH_M])


@lru_cache(maxsize=4)
def symmetric_hall(seed: int = 0) -> World:
    """A hall of 16 x 7 m with four equal bays a side; half a turn takes everything to its like but one corner."""
    rng = np.random.default_rng([seed, 0x5E77])
    build = WorldBuilder(rng)
    bay = 2 * HALF_LENGTH_M / _NUM_BAYS
    front, post = build.texture(textures.poster(rng, 512, 512)), build.texture(textures.machine(rng))
    things = [Skin(build.texture(kind(rng))) for kind in (textures.carton, textures.books)]
    end = [Skin(build.texture(textures.poster(rng, 512, 512))), Skin(build.texture(textures.picture(rng)))]
    floor, roof = Skin(build.texture(textures.concrete(rng))), Skin(build.texture(textures.planks(rng)))
    for k in range(_NUM_BAYS):  # one side, the same before every bay
        x = -HALF_LENGTH_M + k * bay
        build.wall((x + bay / 2, HALF_WIDTH_M, _HEIGHT_M / 2), (0, -1, 0), bay, _HEIGHT_M, Skin(front))
        build.box((x, HALF_WIDTH_M - 0.15, 0), (0.4, 0.3, _HEIGHT_M), Skin(post))
        build.box((x + 1.4, HALF_WIDTH_M - 0.5, 0), (0.7, 0.6, 1.2), things[0], 15.0)
        build.box((x + 2.9, HALF_WIDTH_M - 0.4, 0), (0.5, 0.5, 1.9), things[1], -20.0)
        build.quad((x, HALF_WIDTH_M, 0), (bay, 0, 0), (0, -HALF_WIDTH_M, 0), floor)
        build.quad((x, 0, _HEIGHT_M), (bay, 0, 0), (0, HALF_WIDTH_M, 0), roof)
    width = HALF_WIDTH_M
    for n, skin in enumerate(end):  # one end in two halves
        y = width / 2 if n == 0 else -width / 2
        build.wall((HALF_LENGTH_M, y, _HEIGHT_M / 2), (-1, 0, 0), width, _HEIGHT_M, skin)
    build.repeat_turned()
    _fill_corner(build)
    return build.build()


def _fill_corner(build: WorldBuilder) -> None:
    """What stands in one corner alone: before its walls, and boxes."""
    rng, (x, y) = build.rng, CORNER
    picture, board = (Skin(build.texture(kind(rng))) for kind in (textures.screen, textures.window))
    build.wall((x - 0.02, y - 1.2, 1.8), (-1, 0, 0), 2.2, 2.4, replace(picture, tone=1.3))
    build.wall((x - 1.4, y - 0.02, 1.9), (0, -1, 0), 2.4, 2.4, board)
    for k in range(3):
        skin = Skin(build.texture((textures.drawers, textures.carton, textures.poster)[k](rng)))
        at = (x - 0.6 - 0.8 * k, y - 1.9 + 0.55 * k, 0.0)
        build.box(at, [float(v) for v in rng.uniform((0.4, 0.4, 0.7), (0.7, 0.7, 1.5))], skin, 25.0 * k)


def walk_round(seed: int = 0, laps: float = 1.1) -> RenderedSequence:
    """Round the hall and on to where it began, looking ahead and outwards by turns."""
    arc = np.pi * _RADIUS_M
    lap = 4 * _STRAIGHT_M + 2 * arc
    way = np.arange(0.0, laps * lap, STEP_M)
    rng = np.random.default_rng([seed, 0x5E78])
    phase = rng.uniform(0, 2 * np.pi, 4)

    def pose(times: Array) -> Array:
        s = times * FRAMES_PER_SECOND * STEP_M
        x, y, yaw = _on_way(s % lap)
        # twice as often as laps: the walk is its own like
        yaw = yaw - 0.5 + 0.45 * np.sin(8 * np.pi * s / lap + phase[0])
        z = 1.6 + 0.06 * np.sin(1.7 * s + phase[1])
        return _poses(x, y, z, yaw, 0.03 * np.sin(1.1 * s + phase[2]))

    return _played("round", seed, way, pose)


def _on_way(s: Array) -> tuple[Array, Array, Array]:
    """Place and direction (x, y, yaw) after a way from the middle of one straight, anticlockwise."""
    arc, straight = np.pi * _RADIUS_M, 2 * _STRAIGHT_M
    half = straight + arc
    turned = s >= half
    s = np.where(turned, s - half, s)
    begins = _STRAIGHT_M  # half a straight, an end, half a straight
    on_arc = np.clip(s - begins, 0.0, arc)
    angle = on_arc / _RADIUS_M
    x = np.minimum(s, begins) + _RADIUS_M * np.sin(angle) - np.maximum(s - begins - arc, 0.0)
    y = -_RADIUS_M * np.cos(angle)
    sign = np.where(turned, -1.0, 1.0)
    return sign * x, sign * y, angle + np.pi * turned


def kidnapping(world_seed: int, seed: int, num_frames: int, start: Array, yaw: float) -> RenderedSequence:
    """A short walk from a place (x, y) on, nearly straight ahead."""
    rng = np.random.default_rng([seed, 0x5E79])
    phase, bend = rng.uniform(0, 2 * np.pi, 4), rng.uniform(-0.12, 0.12)
    way = STEP_M * np.arange(num_frames, dtype=np.float64)

    def pose(times: Array) -> Array:
        s = times * FRAMES_PER_SECOND * STEP_M
        x = start[0] + s * np.cos(yaw + 0.5 * bend * s)
        y = start[1] + s * np.sin(yaw + 0.5 * bend * s)
        z = 1.6 + 0.06 * np.sin(1.7 * s + phase[1])
        return _poses(x, y, z, yaw + bend * s + 0.1 * np.sin(1.3 * s + phase[0]), 0.03 * np.sin(1.1 * s + phase[2]))

    return _played("kidnapped", world_seed, way, pose, seed)


def drive_past_corner(world_seed: int, seed: int) -> RenderedSequence:
    """On the way round the hall from anywhere, for 60 frames at least, until the corner that has no like is 3 m behind.

    The camera looks ahead and outwards by turns of its own, beside the way of the map.
    """
    rng = np.random.default_rng([seed, 0x5E7A])
    arc = np.pi * _RADIUS_M
    lap, behind = 4 * _STRAIGHT_M + 2 * arc, _STRAIGHT_M + arc + 3.0
    first = rng.uniform(0.0, lap)
    length = (behind - first) % lap
    length += lap if length < 60 * STEP_M else 0.0
    aside, phase = rng.uniform(-0.4, 0.4), rng.uniform(0, 2 * np.pi, 3)

    def pose(times: Array) -> Array:
        s = first + times * FRAMES_PER_SECOND * STEP_M
        x, y, yaw = _on_way(s % lap)
        x, y = x - aside * np.sin(yaw), y + aside * np.cos(yaw)
        z = 1.6 + 0.06 * np.sin(1.7 * s + phase[1])
        return _poses(x, y, z, yaw - 0.5 + 0.45 * np.sin(1.9 * s + phase[0]), 0.03 * np.sin(1.1 * s + phase[2]))

    return _played("past the corner", world_seed, np.arange(0.0, length, STEP_M), pose, seed)


def turned_half(cam_from_world: Array) -> Array:
    """Poses (N, 7) at the like of a place: half a turn about the middle of the hall."""
    return rigid3.compose(cam_from_world, np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]))


def pose_at(x: float, y: float, yaw: float) -> Array:
    """(7,) of a level camera at eye height."""
    pose: Array = _poses(*(np.array([v]) for v in (x, y, 1.6, yaw, 0.0)))[0]
    return pose


def _poses(x: Array, y: Array, z: Array, yaw: Array, pitch: Array) -> Array:
    turn = rigid3.exp_so3(yaw[:, None] * UP) @ rigid3.exp_so3(pitch[:, None] * np.array([0.0, 1.0, 0.0]))
    return rigid3.compose(CAM_FROM_BODY, rigid3.inverse(rigid3.from_matrix(turn, np.stack([x, y, z], 1))))


def _played(name: str, world_seed: int, way: Array, pose: Callable[[Array], Array], seed: int = 0) -> RenderedSequence:
    times = np.arange(len(way)) / FRAMES_PER_SECOND
    world = symmetric_hall(world_seed)
    return _sequence(name, world, Rig.single(CAMERA), times, pose, np.full(len(times), 1.15), OPTICS, seed)
