"""A town of streets on a grid, with terraces of equal houses, and a walk through it that closes many loops.

Metres, z up, the town around the origin. The first views of a long walk are those of a short one, and what has been
walked grows from one corner of the town. Facades, walls, cars and signs are of a few kinds that come back
all over the town, in a quarter of the rows as terraces of two kinds, whose houses are all alike; what tells two places
apart is the order in which things stand, and stains.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rendered_worlds import textures
from rendered_worlds.motion import CAM_FROM_BODY
from rendered_worlds.rendering import Optics, Renderer, World
from rendered_worlds.worlds import STREETS, UP, Skin, WorldBuilder, _Street, road_under_the_sky
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Crossing = tuple[int, int]

# Views of the longest walk.
MAX_VIEWS = 3000
# Crossings a side, and metres between two; the town ends in rows of houses half a block beyond the last ones.
NUM_CROSSINGS, PITCH_M = 8, 42.0
# The widths of houses of a terrace, and the share of rows that are one.
_TERRACE_WIDTHS_M, _TERRACE_SHARE = (6.8, 9.1), 0.25
# Every place is two views, ahead to the left and to the right; corners are rounded by so much.
STEP_M, _ASIDE_DEG, _CORNER_M, _EYE_M = 2.2, 34.0, 4.0, 1.7
OPTICS = Optics(noise_sigma=2.0, edge_samples=False)


def camera(width: int) -> Camera:
    """A camera of 4:3 that sees 78 degrees across, with the barrel distortion of a simple lens."""
    height, focal = width * 3 // 4, 0.62 * width
    return Camera(CameraModel.SIMPLE_RADIAL, width, height, np.array([focal, width / 2, height / 2, -0.06]))


@dataclass(frozen=True)
class Walk:
    """Views of the town.

    Attributes:
        cam_from_world: (N, 7) of each, pairs of left and right.
        seed: of the town and its noise.
    """

    cam_from_world: Array
    seed: int

    def photograph(self, renderer: Renderer, view: int) -> NDArray[np.uint8]:
        """The (H, W) uint8 picture of a view."""
        return renderer.photograph(self.cam_from_world[view], OPTICS, [self.seed, view], gain=1.1)


@lru_cache(maxsize=2)
def town_world(seed: int = 0) -> World:
    """Blocks between and around the streets."""
    rng = np.random.default_rng([seed, 0x70E4])
    build = WorldBuilder(rng)
    stains = road_under_the_sky(build)
    town = _Town(build, stains)
    for i in range(NUM_CROSSINGS + 1):
        for j in range(NUM_CROSSINGS + 1):
            town.block(_corner((i, j)) - PITCH_M)
    return build.build()


def _corner(crossing: Crossing) -> Array:
    """Where a crossing is, (x, y)."""
    return PITCH_M * (np.array(crossing, np.float64) - (NUM_CROSSINGS - 1) / 2)


class _Town(_Street):
    """What stands in blocks: rows of houses as along any street, and terraces."""

    def __init__(self, build: WorldBuilder, stains: int) -> None:
        super().__init__(build, stains)
        self.gables = [Skin(build.texture(textures.bricks(build.rng)), 3.2, stains, 7.1) for _ in range(16)]

    def _house(self, middle: Array, normal: Array, width: float) -> None:
        self.gable = self.gables[int(self.rng.integers(len(self.gables)))]
        super()._house(middle, normal, width)

    def block(self, low: Array) -> None:
        """One block whose streets meet at ``low`` (x, y), a pitch apart."""
        foot, size = low + PITCH_M / 2, PITCH_M - 2 * STREETS.kerb
        self.build.box([*foot, 0.0], (size, size, 0.13), self.pavement)
        first, last = low + STREETS.front, low + PITCH_M - STREETS.front
        for normal, start in (
            ((0.0, -1.0), first), ((0.0, 1.0), np.array([first[0], last[1]])),
            ((-1.0, 0.0), first), ((1.0, 0.0), np.array([last[0], first[1]])),
        ):  # fmt: skip
            if self.rng.random() < _TERRACE_SHARE:
                self._terrace(np.array(start), np.array(normal), PITCH_M - 2 * STREETS.front)
            else:
                self._row(np.array(start), np.array(normal), PITCH_M - 2 * STREETS.front)

    def _terrace(self, start: Array, normal: Array, length: float) -> None:
        """Houses that are all alike, of one of two kinds, and a car or two before them."""
        kind, along = int(self.rng.integers(2)), np.abs(normal[::-1])
        width, depth, height = _TERRACE_WIDTHS_M[kind], 9.0, (7.5, 9.5)[kind]
        skin, gable = Skin(self.facades[kind], None, self.stains, 5.7), self.gables[kind]
        skins = (gable, skin, self.roof) if normal[0] == 0 else (skin, gable, self.roof)
        size = (width, depth, height) if normal[0] == 0 else (depth, width, height)
        for k in range(int(length // width)):
            middle = start + along * (k + 0.5) * width - normal * depth / 2
            self.build.box([*middle, 0.13], size, skins)
            step = (1.6, 0.6, 0.35) if normal[0] == 0 else (0.6, 1.6, 0.35)
            self.build.box([*middle + normal * (depth / 2 + 0.3), 0.13], step, self.pavement)
        heading = np.degrees(np.arctan2(along[1], along[0]))
        for at in self.rng.uniform(3.0, length - 3.0, int(self.rng.integers(0, 3))):
            place = start + normal * (STREETS.front - STREETS.kerb + 1.1) + along * at
            self.car([*place, 0.0], heading + 180 * int(self.rng.integers(2)))


def walk(num_views: int, seed: int = 0) -> Walk:
    """The first views of the walk through a town, at most ``MAX_VIEWS``."""
    places = MAX_VIEWS // 2 + 1
    corners = [_corner(c) for c in _route(int(places * STEP_M / PITCH_M) + 3)]
    x, y, yaw = _along(corners, STEP_M * np.arange(places, dtype=np.float64))
    rng = np.random.default_rng([seed, 0x70E5])
    cam_from_world = np.empty((places, 2, 7))
    for k, side in enumerate((1.0, -1.0)):  # left, right
        turn = yaw + side * np.radians(_ASIDE_DEG) + rng.normal(0.0, 0.03, places)
        pitch = -0.06 + rng.normal(0.0, 0.02, places)  # a little upwards
        roll = rng.normal(0.0, 0.02, places)
        spot = np.stack([x, y, np.full(places, _EYE_M)], 1) + rng.normal(0.0, 0.12, (places, 3))
        axes = rigid3.exp_so3(turn[:, None] * UP) @ rigid3.exp_so3(pitch[:, None] * np.array([0.0, 1.0, 0.0]))
        axes = axes @ rigid3.exp_so3(roll[:, None] * np.array([1.0, 0.0, 0.0]))
        cam_from_world[:, k] = rigid3.compose(CAM_FROM_BODY, rigid3.inverse(rigid3.from_matrix(axes, spot)))
    return Walk(cam_from_world.reshape(-1, 7)[:num_views], seed)


def _route(count: int) -> list[Crossing]:
    """So many crossings, one after the other: on to a street that is new, where there is none the shortest way to one;
    near ones first, and never straight back."""
    route: list[Crossing] = [(0, 0), (1, 0)]
    walked = {frozenset(route)}
    while len(route) < count:
        here, before = route[-1], route[-2]

        def worth(way: Crossing, here: Crossing = here) -> tuple[int, int, Crossing]:
            return 0 if frozenset((here, way)) not in walked else 1 + _steps_to_new(way, walked), max(way), way

        route.append(min((way for way in _neighbors(here) if way != before), key=worth))
        walked.add(frozenset(route[-2:]))
    return route


def _neighbors(crossing: Crossing) -> list[Crossing]:
    """The crossings beside one."""
    i, j = crossing
    ways = ((i + 1, j), (i, j + 1), (i - 1, j), (i, j - 1))
    return [way for way in ways if min(way) >= 0 and max(way) < NUM_CROSSINGS]


def _steps_to_new(crossing: Crossing, walked: set[frozenset[Crossing]]) -> int:
    """How many streets on the next one begins that was not walked."""
    reached, steps = {crossing}, 0
    while all(frozenset((here, way)) in walked for here in reached for way in _neighbors(here)):
        reached |= {way for here in reached for way in _neighbors(here)}
        steps += 1
        if steps > 2 * NUM_CROSSINGS:  # there is none
            break
    return steps


def _along(corners: list[Array], way: Array) -> tuple[Array, Array, Array]:
    """Place and direction (x, y, yaw) after each way along a polygon whose corners are rounded, as far as it goes."""
    line: list[Array] = [corners[0]]
    for before, here, after in zip(corners, corners[1:], corners[2:], strict=False):
        start, end = (before - here) / PITCH_M, (after - here) / PITCH_M
        t = np.linspace(0.0, 1.0, 12)[:, None]
        line += list(here + _CORNER_M * ((1 - t) ** 2 * start + t**2 * end))  # a parabola: 0 at both ends to the middle
    points = np.array(line)
    lengths = np.concatenate([[0.0], np.cumsum([np.linalg.norm(b - a) for a, b in pairwise(points)])])
    x, y = (np.interp(way, lengths, points[:, k]) for k in range(2))
    back, on = ([np.interp(at, lengths, points[:, k]) for k in range(2)] for at in (way - 0.5, way + 0.5))
    return x, y, np.arctan2(on[1] - back[1], on[0] - back[0])
