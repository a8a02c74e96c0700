"""Three places to walk, fly and drive through: a room, a machine hall, streets round a block. Metres, z up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rendered_worlds import textures
from rendered_worlds.rendering import Atlas, World

Array = NDArray[np.float64]

LIGHT = np.array([0.45, -0.3, 0.84])  # where the light comes from
AMBIENT = 0.62  # brightness of surfaces that the light does not reach
UP = np.array([0.0, 0.0, 1.0])
# the room's and the hall's walls, half widths
ROOM_HALF = (2.5, 3.0)
HALL_HALF = (7.0, 10.0)


@dataclass(frozen=True)
class Skin:
    """How a rectangle is covered."""

    texture: int  # index in the builder
    metres: float | None = None  # width of one period; None: shown once, fitted
    overlay: int = -1  # index of a texture that makes repeats differ; -1: none
    overlay_metres: float = 7.3  # width of one of its periods
    tone: float = 1.0  # factor on the brightness
    mirrored: bool = False  # left and right exchanged
    glows: bool = False  # as bright whichever way it faces


class WorldBuilder:
    """Collects textures and rectangles. All placement is by centre or corner and size in metres."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self._textures: list[NDArray[np.uint8]] = []
        self._rows: list[list[float]] = []

    def texture(self, image: NDArray[np.uint8]) -> int:
        """The index of a new texture."""
        self._textures.append(image)
        return len(self._textures) - 1

    def quad(
        self, corner: ArrayLike, right: ArrayLike, down: ArrayLike, skin: Skin, velocity: ArrayLike = (0.0, 0.0, 0.0),
        cycle: tuple[float, float] = (0.0, 1.0),
    ) -> None:  # fmt: skip
        """A rectangle by its top left corner and its edges, as seen from the visible side."""
        right, down = np.asarray(right, np.float64), np.asarray(down, np.float64)
        normal = np.cross(down, right)
        normal /= np.linalg.norm(normal)
        extent = np.array([np.linalg.norm(right), np.linalg.norm(down)])
        window = np.array([0.0, 0.0, 1.0, 1.0])
        if skin.metres is not None:
            height, width = self._textures[skin.texture].shape
            window[2:] = extent / [skin.metres, skin.metres * height / width]
            window[:2] = self.rng.random(2)
        if skin.mirrored:
            window[0], window[2] = window[0] + window[2], -window[2]
        over = np.concatenate([self.rng.random(2), extent / skin.overlay_metres])
        lit = 1.0 if skin.glows else AMBIENT + (1 - AMBIENT) * max(0.0, float(normal @ LIGHT))
        self._rows.append(
            [*np.asarray(corner, np.float64), *right, *down, skin.texture, *window, skin.overlay, *over,
             skin.tone * lit,              *np.asarray(velocity, np.float64), *cycle]
        )  # fmt: skip

    def wall(self, centre: ArrayLike, normal: ArrayLike, width: float, height: float, skin: Skin) -> None:
        """An upright rectangle that is seen from where its horizontal normal points to."""
        right = np.cross(UP, np.asarray(normal, np.float64))
        corner = np.asarray(centre, np.float64) - right * width / 2 + UP * height / 2
        self.quad(corner, right * width, -UP * height, skin)

    def box(
        self, foot: ArrayLike, size: Sequence[float], skins: Skin | Sequence[Skin], yaw_deg: float = 0.0,
        velocity: ArrayLike = (0.0, 0.0, 0.0), cycle: tuple[float, float] = (0.0, 1.0), *, has_bottom: bool = False,
    ) -> None:  # fmt: skip
        """A box on a foot point, seen from outside. Skins: one for all, or for the x faces, the y faces, the top."""
        ends, sides, top = (skins,) * 3 if isinstance(skins, Skin) else skins
        c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
        ex, ey = np.array([c, s, 0.0]), np.array([-s, c, 0.0])
        sx, sy, sz = size
        middle = np.asarray(foot, np.float64) + UP * sz / 2
        for normal, half, width, skin in (
            (ex, sx, sy, ends),
            (-ex, sx, sy, ends),
            (ey, sy, sx, sides),
            (-ey, sy, sx, sides),
        ):
            right = np.cross(UP, normal)
            corner = middle + normal * half / 2 - right * width / 2 + UP * sz / 2
            self.quad(corner, right * width, -UP * sz, skin, velocity, cycle)
        corner = middle - ex * sx / 2 + ey * sy / 2 + UP * sz / 2
        self.quad(corner, ex * sx, -ey * sy, top, velocity, cycle)
        if has_bottom:
            self.quad(middle - ex * sx / 2 - ey * sy / 2 - UP * sz / 2, ex * sx, ey * sy, top, velocity, cycle)

    def cylinder(self, foot: ArrayLike, radius: float, height: float, skin: Skin, sides: int = 16) -> None:
        """An upright column of flat sides; the texture runs once round it (or repeats by ``skin.metres``)."""
        foot = np.asarray(foot, np.float64)
        angle = np.arange(sides + 1) * 2 * np.pi / sides
        ring = foot + UP * height + radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
        around = 2 * np.pi * radius
        periods = (1.0, 1.0) if skin.metres is None else (around / skin.metres, height / skin.metres)
        for k in range(sides):
            self.quad(ring[k], ring[k + 1] - ring[k], -UP * height, replace(skin, metres=None))
            row = self._rows[-1]
            row[10:14] = [k / sides * periods[0], 0.0, periods[0] / sides, periods[1]]

    def inside(self, half: tuple[float, float], height: float, walls: Skin, floor: Skin, ceiling: Skin) -> None:
        """A room seen from inside, its floor at z = 0 around the origin."""
        hx, hy = half
        for normal, distance, width in (((-1, 0, 0), hx, 2 * hy), ((1, 0, 0), hx, 2 * hy), ((0, -1, 0), hy, 2 * hx),
                                        ((0, 1, 0), hy, 2 * hx)):  # fmt: skip
            self.wall(-np.array(normal, float) * distance + UP * height / 2, normal, width, height, walls)
        self.quad((-hx, hy, 0), (2 * hx, 0, 0), (0, -2 * hy, 0), floor)
        self.quad((-hx, -hy, height), (2 * hx, 0, 0), (0, 2 * hy, 0), ceiling)

    def repeat_turned(self) -> None:
        """Everything so far once more, turned by half about the world's z axis, lit as its like is."""
        for row in self._rows[:]:
            turned = list(row)
            for k in (0, 3, 6):  # the corner and both edges
                turned[k], turned[k + 1] = -row[k], -row[k + 1]
            self._rows.append(turned)

    def build(self) -> World:
        """The world so far."""
        rows = np.array(self._rows)
        return World(
            Atlas.of(self._textures), rows[:, :3].copy(), rows[:, 3:9].reshape(-1, 2, 3).copy(),
            rows[:, 9].astype(np.int64), rows[:, 10:14].copy(), rows[:, 14].astype(np.int64), rows[:, 15:19].copy(),
            rows[:, 19].copy(), rows[:, 20:23].copy(), rows[:, 23:25].copy(),
        )  # fmt: skip


@lru_cache(maxsize=2)
def room_world(seed: int = 0) -> World:
    """A furnished room of 5 x 6 x 3 m: plain walls with a few posters, a window, desks, shelves, a sofa, clutter."""
    rng = np.random.default_rng([seed, 0x2003])
    build = WorldBuilder(rng)
    plain = Skin(build.texture(textures.plaster(rng)), 3.0)
    floor = Skin(build.texture(textures.planks(rng, 1024, 16)), 3.0, build.texture(textures.dirt(rng)), 4.1)
    hx, hy = ROOM_HALF
    build.inside(ROOM_HALF, 3.0, plain, floor, replace(plain, tone=1.15))
    wood = Skin(build.texture(textures.planks(rng, 512, 3, 150)), 1.4, floor.overlay, 3.1)
    dark = Skin(build.texture(textures.planks(rng, 512, 4, 75)), 1.1, floor.overlay, 2.3)
    cloth = Skin(build.texture(textures.carpet(rng)), 0.8, floor.overlay, 2.9)
    for normal, distance, width in (
        ((-1, 0), hx, 2 * hy),
        ((1, 0), hx, 2 * hy),
        ((0, -1), hy, 2 * hx),
        ((0, 1), hy, 2 * hx),
    ):
        n = np.array([*normal, 0.0])  # skirting board
        build.wall(-n * (distance - 0.012) + UP * 0.045, n, width, 0.09, replace(dark, tone=1.4))
    build.quad((-1.1, 1.5, 0.006), (2.2, 0, 0), (0, -3.0, 0), replace(cloth, tone=1.2))
    _room_walls(build)
    _room_furniture(build, wood, dark, cloth)
    return build.build()


def _room_walls(build: WorldBuilder) -> None:
    rng = build.rng
    hx, hy = ROOM_HALF

    def hang(
        image: NDArray[np.uint8], normal: tuple[int, int], along: float, z: float, width: float, height: float,
        glows: bool = False,
    ) -> None:  # fmt: skip
        n = np.array([*normal, 0.0])
        centre = -n * (np.array([hx, hy, 0.0]) - 0.01) + np.abs(n[[1, 0, 2]]) * along + UP * z
        build.wall(centre, n, width, height, Skin(build.texture(image), glows=glows))

    hang(textures.window(rng, 256, 256), (-1, 0), 0.4, 1.75, 1.7, 1.4, True)
    hang(textures.drawers(rng, 256, 512, 1, 1, 185), (0, 1), 1.7, 1.02, 0.9, 2.04)
    for normal, along, z, width in (
        ((-1, 0), -1.9, 1.7, 0.6), ((-1, 0), 2.3, 1.65, 0.55), ((1, 0), -2.2, 1.7, 0.7), ((1, 0), -0.2, 1.75, 0.5),
        ((1, 0), 1.6, 1.6, 0.9), ((0, -1), -1.6, 1.8, 0.6), ((0, 1), -1.3, 1.75, 0.8), ((0, 1), 0.3, 1.6, 0.45),
    ):  # fmt: skip
        is_text = rng.random() < 0.6
        image = textures.poster(rng, 256, 512) if is_text else textures.picture(rng)
        hang(image, normal, along, z, width, width * (1.5 if is_text else 1.0))
    for normal, along in (((1, 0), 0.9), ((0, -1), 0.2), ((0, 1), 1.1), ((-1, 0), -0.8)):  # sockets and switches
        hang(textures.sign(rng, 64), normal, along, 1.15, 0.12, 0.12)
    for x, y in ((-1.0, -1.2), (1.0, 1.2)):  # lamps
        lamp = Skin(build.texture(np.full((8, 8), 250, np.uint8)), glows=True)
        build.box((x, y, 2.93), (0.6, 0.6, 0.06), lamp, has_bottom=True)


def _room_furniture(build: WorldBuilder, wood: Skin, dark: Skin, cloth: Skin) -> None:
    rng = build.rng
    hx, hy = ROOM_HALF
    books = [Skin(build.texture(textures.books(rng))) for _ in range(2)]
    screens = [Skin(build.texture(textures.screen(rng))) for _ in range(3)]
    cartons = [Skin(build.texture(textures.carton(rng))) for _ in range(5)]
    prints = [Skin(build.texture(textures.poster(rng))) for _ in range(5)]
    front = Skin(build.texture(textures.drawers(rng)))
    black = Skin(build.texture(np.full((8, 8), 40, np.uint8)))

    def table(x: float, y: float, width: float, depth: float, height: float, yaw: float, skin: Skin) -> None:
        build.box((x, y, height - 0.04), (width, depth, 0.04), skin, yaw, has_bottom=True)
        c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
        for dx, dy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            lx, ly = dx * (width / 2 - 0.06), dy * (depth / 2 - 0.06)
            build.box((x + c * lx - s * ly, y + s * lx + c * ly, 0), (0.05, 0.05, height - 0.04), dark, yaw)

    def clutter(x: float, y: float, z: float, extent: tuple[float, float], count: int) -> None:
        for _ in range(count):
            dx, dy = rng.uniform(-0.5, 0.5, 2) * extent
            at = (x + dx, y + dy, z)
            skins = (*prints, *cartons)
            skin = skins[int(rng.integers(len(skins)))]
            if rng.random() < 0.45:  # paper
                size = rng.uniform(0.14, 0.26)
                build.box(at, (size, size * 1.3, 0.004), skin, rng.uniform(-40, 40))
            else:
                w, d, h = rng.uniform(0.06, 0.2, 3)
                build.box(at, (w, d, h), replace(skin, tone=rng.uniform(0.6, 1.2)), rng.uniform(-40, 40))

    def monitor(x: float, y: float, z: float, yaw: float, skin: Skin) -> None:
        build.box((x, y, z), (0.2, 0.25, 0.015), black, yaw)
        build.box((x, y, z), (0.04, 0.06, 0.15), black, yaw)
        build.box((x, y, z + 0.12), (0.05, 0.52, 0.34), (skin, black, black), yaw)

    def chair(x: float, y: float, yaw: float) -> None:
        table(x, y, 0.44, 0.44, 0.46, yaw, cloth)
        c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
        build.box((x + 0.2 * c, y + 0.2 * s, 0.52), (0.04, 0.42, 0.4), cloth, yaw, has_bottom=True)

    table(-1.2, hy - 0.42, 1.7, 0.8, 0.74, 0, wood)
    monitor(-1.4, hy - 0.3, 0.74, -85, screens[0])
    clutter(-1.0, hy - 0.5, 0.74, (1.3, 0.4), 9)
    chair(-1.1, hy - 1.15, -70)
    build.box((1.45, hy - 0.18, 0), (1.1, 0.34, 2.0), (dark, books[0], wood))
    table(-hx + 0.42, 0.6, 0.8, 1.8, 0.74, 0, wood)
    monitor(-hx + 0.3, 0.9, 0.74, 8, screens[1])
    monitor(-hx + 0.35, 0.25, 0.74, -12, screens[2])
    clutter(-hx + 0.5, 0.6, 0.74, (0.4, 1.4), 9)
    chair(-hx + 1.05, 0.7, 25)
    build.box((hx - 0.25, -1.9, 0), (0.45, 1.1, 0.85), (front, dark, wood))
    clutter(hx - 0.25, -1.9, 0.85, (0.25, 0.8), 6)
    build.box((hx - 0.2, 2.3, 0), (0.32, 1.0, 1.75), (books[1], dark, wood))
    build.box((-1.2, -hy + 0.45, 0), (1.9, 0.85, 0.42), cloth)
    build.box((-1.2, -hy + 0.14, 0.42), (1.9, 0.25, 0.4), replace(cloth, tone=0.9))
    for x, tone in ((-1.8, 1.3), (-0.7, 0.7)):
        build.box((x, -hy + 0.35, 0.42), (0.4, 0.16, 0.36), replace(prints[0], tone=tone), 12)
    table(0.05, 0.1, 1.0, 0.6, 0.44, 20, wood)
    clutter(0.05, 0.1, 0.44, (0.6, 0.35), 8)
    for x, y, size, yaw in (
        (-2.05, -1.6, 0.4, 12),
        (-2.1, -1.62, 0.3, 30),
        (0.4, -2.65, 0.42, -9),
        (2.1, -0.6, 0.35, 25),
    ):
        z = 0.0 if size != 0.3 else 0.4
        build.box((x, y, z), (size, size * 1.2, size), cartons[int(rng.integers(5))], yaw)
    plant = Skin(build.texture(textures.leaves(rng, 256)))
    build.cylinder((2.05, 1.3, 0), 0.16, 0.3, dark, 12)
    for yaw in (0, 30, 60):
        build.box((2.05, 1.3, 0.3), (0.42, 0.42, 0.55 + 0.006 * yaw), plant, yaw)


@lru_cache(maxsize=2)
def gallery_world(seed: int = 0) -> World:
    """A room of 5 x 6 x 3 m with something to see in every direction: pictures all over, boxes on the floor."""
    rng = np.random.default_rng([seed, 0x6A11])
    build = WorldBuilder(rng)
    dirt = build.texture(textures.dirt(rng))
    walls, floor, ceiling = (
        Skin(build.texture(image), metres, dirt, 3.7)
        for image, metres in (
            (textures.concrete(rng, 1024), 2.2), (textures.planks(rng, 1024, 12), 2.4),
            (textures.planks(rng, 1024, 16, 160), 3.1),
        )
    )  # fmt: skip
    build.inside(ROOM_HALF, 3.0, walls, floor, ceiling)
    hx, hy = ROOM_HALF
    for normal, length in (((-1, 0), hy), ((1, 0), hy), ((0, -1), hx), ((0, 1), hx)):
        n = np.array([*normal, 0.0])
        for along in np.arange(-length + 0.5, length, 0.85):
            for z in (0.75, 1.6, 2.45):
                image = textures.poster(rng) if rng.random() < 0.5 else textures.picture(rng)
                centre = -n * (np.array([hx, hy, 0.0]) - 0.02) + np.abs(n[[1, 0, 2]]) * (along + rng.uniform(-0.1, 0.1))
                width, height = rng.uniform(0.45, 0.68, 2)
                build.wall(centre + UP * (z + rng.uniform(-0.06, 0.06)), n, width, height, Skin(build.texture(image)))
    for x in (-1.7, 0.0, 1.7):  # on the ceiling, seen from below
        for y in (-2.2, -0.7, 0.7, 2.2):
            skin = Skin(build.texture(textures.picture(rng)), glows=True)
            build.quad((x - 0.4, y - 0.4, 2.99), (0.8, 0, 0), (0, 0.8, 0), skin)
    sides = [Skin(build.texture(textures.carton(rng))) for _ in range(6)]
    sides += [Skin(build.texture(textures.machine(rng))) for _ in range(3)]
    for k in range(16):
        turn = 2 * np.pi * k / 16 + rng.uniform(-0.1, 0.1)
        place = np.array([(hx - 0.55) * np.cos(turn), (hy - 0.6) * np.sin(turn), 0.0])
        skins = [sides[int(i)] for i in rng.integers(len(sides), size=3)]
        build.box(place, rng.uniform(0.3, 0.6, 3).tolist(), skins, rng.uniform(-40, 40))
    return build.build()


@lru_cache(maxsize=2)
def hall_world(seed: int = 0) -> World:
    """A machine hall of 14 x 20 x 7 m: brick walls, windows, pillars, machines, pipes, crates."""
    rng = np.random.default_rng([seed, 0x4A11])
    build = WorldBuilder(rng)
    stains = build.texture(textures.dirt(rng))
    brick = Skin(build.texture(textures.bricks(rng, 1024, 40, 12)), 3.2, stains, 5.9, 0.8)
    ground = Skin(build.texture(textures.concrete(rng, 1024)), 4.8, stains, 6.7, 0.75)
    roof = Skin(build.texture(textures.planks(rng, 512, 8, 80)), 3.0, stains, 5.1, 0.6)
    build.inside(HALL_HALF, 7.0, brick, ground, roof)
    hx = HALL_HALF[0]
    steel = Skin(build.texture(textures.plaster(rng)), 2.0, stains, 2.7, 0.5)
    stripe = Skin(build.texture(np.full((16, 16), 225, np.uint8)), None, stains, 1.7)
    for x in (-3.6, 3.6):
        build.quad((x - 0.06, 9, 0.003), (0.12, 0, 0), (0, -18, 0), stripe)
    panes = [Skin(build.texture(textures.window(rng)), glows=True, tone=0.9) for _ in range(3)]
    for y in np.arange(-8.0, 8.1, 2.6):
        for side in (-1, 1):
            centre = (side * (hx - 0.02), y + side * 0.3, 5.0)
            build.wall(centre, (-side, 0, 0), 1.6, 2.2, panes[int(rng.integers(3))])
    concrete = Skin(build.texture(textures.concrete(rng)), 2.0, stains, 3.3, 0.95)
    for x in (-5.0, 5.0):
        for y in (-6.0, 0.0, 6.0):
            build.cylinder((x, y, 0), 0.3, 7.0, concrete, 20)
        build.box((x, 0, 6.3), (0.3, 20, 0.5), steel, has_bottom=True)
    for y in (-7.5, -2.5, 2.5, 7.5):
        build.box((0, y, 6.5), (14, 0.25, 0.4), steel, has_bottom=True)
    for side, z in ((-1, 3.4), (-1, 3.7), (1, 3.1), (1, 3.45)):
        build.box(
            (side * (hx - 0.25), 0, z), (0.14, 20, 0.14), replace(steel, tone=rng.uniform(0.4, 0.9)), has_bottom=True
        )
    _hall_objects(build, stains)
    return build.build()


def _hall_objects(build: WorldBuilder, stains: int) -> None:
    rng = build.rng
    hx, hy = HALL_HALF
    plates = [Skin(build.texture(textures.machine(rng)), None, stains, 2.1) for _ in range(8)]
    cartons = [Skin(build.texture(textures.carton(rng))) for _ in range(5)]
    wood = Skin(build.texture(textures.planks(rng)), 1.0, stains, 1.9)
    tops = Skin(build.texture(textures.tiles(rng)), 1.5, stains, 2.2, 0.8)
    signs = [Skin(build.texture(textures.sign(rng))) for _ in range(5)]
    signs += [Skin(build.texture(textures.poster(rng))) for _ in range(4)]
    for side in (-1, 1):
        for y in np.arange(-8.4, 8.5, 2.4):
            w, d, h = rng.uniform(0.8, 1.5), rng.uniform(1.2, 2.0), rng.uniform(0.9, 2.9)
            skin = replace(plates[int(rng.integers(8))], tone=rng.uniform(0.7, 1.25))
            other = replace(plates[int(rng.integers(8))], tone=rng.uniform(0.7, 1.25))
            foot = np.array([side * (hx - 0.2 - w / 2), y + rng.uniform(-0.2, 0.2), 0])
            build.box(foot, (w, d, h), (skin, other, tops), rng.uniform(-4, 4))
            if rng.random() < 0.6:
                build.box(foot + UP * h, (0.5 * w, 0.4 * d, rng.uniform(0.2, 0.8)), other, rng.uniform(-20, 20))
    for k in range(30):
        x, y = rng.uniform(-4.6, 4.6), rng.choice([-1, 1]) * rng.uniform(8.2, 9.3)
        if k >= 20:  # low things below the flight
            x, y = rng.uniform(-4, 4), rng.uniform(-7, 7)
        size = rng.uniform(0.3, 0.9) if k < 20 else rng.uniform(0.2, 0.45)
        skin = cartons[int(rng.integers(5))] if rng.random() < 0.6 else wood
        build.box(
            (x, y, 0),
            (size, size * rng.uniform(0.8, 1.6), size),
            replace(skin, tone=rng.uniform(0.7, 1.2)),
            rng.uniform(0, 90),
        )
        if k < 20 and rng.random() < 0.5:
            build.box((x, y, size), (size * 0.7,) * 3, cartons[int(rng.integers(5))], rng.uniform(0, 90))
    for k in range(16):
        side, width = (-1 if k % 2 else 1), rng.uniform(0.4, 1.0)
        build.wall(
            (rng.uniform(-6, 6), side * (hy - 0.02), rng.uniform(1.6, 4.5)), (0, -side, 0), width, width, signs[k % 9]
        )
    for x, side in ((-2.5, 1), (2.0, -1)):
        gate = Skin(build.texture(textures.drawers(rng, 256, 256, 6, 1, 120)), None, stains, 1.7)
        build.wall((x, side * (hy - 0.03), 1.6), (0, -side, 0), 3.0, 3.2, gate)


@dataclass(frozen=True)
class Streets:
    """Where the streets run: two along x at these y, two along y at these x. All are alike across."""

    xs: tuple[float, float] = (0.0, 120.0)
    ys: tuple[float, float] = (0.0, 90.0)
    lane: float = 1.6  # from the street's middle to the middle of a lane
    kerb: float = 5.2  # from the street's middle to the kerb; cars park in between
    front: float = 7.8  # from the street's middle to the houses
    beyond: float = 90.0  # how far the streets go on past the crossings


STREETS = Streets()


def road_under_the_sky(build: WorldBuilder) -> int:
    """Asphalt as far as one sees, and clouds over it; the texture of its stains."""
    stains = build.texture(textures.dirt(build.rng))
    road = Skin(build.texture(textures.asphalt(build.rng)), 6.0, stains, 17.3)
    sky = Skin(build.texture(textures.clouds(build.rng)), 900.0, glows=True)
    build.inside((700.0, 700.0), 400.0, sky, road, sky)
    return stains


@lru_cache(maxsize=2)
def street_world(seed: int = 0, *, moving_cars: int = 0) -> World:
    """Four streets round a block, with houses, hedges, kerbs, parked cars, trees, poles; moving cars on request."""
    rng = np.random.default_rng([seed, 0x57E7])
    build = WorldBuilder(rng)
    stains = road_under_the_sky(build)
    paint = Skin(build.texture(textures._finish(215 + 12 * textures.noise(rng, 128, 16, 4))), 1.0, stains, 2.9)
    x_ends = (STREETS.xs[0] - STREETS.beyond, STREETS.xs[1] + STREETS.beyond)
    y_ends = (STREETS.ys[0] - STREETS.beyond, STREETS.ys[1] + STREETS.beyond)
    for y in STREETS.ys:
        for x in np.arange(x_ends[0], x_ends[1], 9.0):
            if np.abs(x + 1.5 - np.array(STREETS.xs)).min() > STREETS.kerb + 2:
                build.quad((x, y + 0.06, 0.003), (3.0, 0, 0), (0, -0.12, 0), paint)
    for x in STREETS.xs:
        for y in np.arange(y_ends[0], y_ends[1], 9.0):
            if np.abs(y + 1.5 - np.array(STREETS.ys)).min() > STREETS.kerb + 2:
                build.quad((x - 0.06, y + 3.0, 0.003), (0.12, 0, 0), (0, -3.0, 0), paint)
    _Street(build, stains).blocks(x_ends, y_ends)
    if moving_cars:
        _Street(build, stains).traffic(moving_cars, x_ends, y_ends)
    return build.build()


class _Street:
    """What stands along the streets."""

    def __init__(self, build: WorldBuilder, stains: int) -> None:
        self.build = build
        self.rng = rng = build.rng
        self.stains = stains
        self.facades = [build.texture(textures.facade(rng)) for _ in range(24)]
        self.gable = Skin(build.texture(textures.bricks(rng, 1024, 40, 12)), 3.2, stains, 7.1)
        self.roof = Skin(build.texture(textures.tiles(rng, 512, 16, 110, 14)), 4.0, stains)
        self.pavement = Skin(build.texture(textures.tiles(rng)), 3.2, stains, 9.7)
        self.hedge = Skin(build.texture(textures.leaves(rng)), 1.6, stains, 4.1)
        self.crown = Skin(build.texture(textures.leaves(rng, 512, 12)), 2.4, stains, 3.7, 0.9)
        self.bark = Skin(build.texture(textures.planks(rng, 256, 8, 80)), 0.5)
        self.metal = Skin(build.texture(textures.plaster(rng, 64)), 1.0, tone=0.55)
        self.signs = [Skin(build.texture(textures.sign(rng))) for _ in range(8)]
        self.fence = Skin(build.texture(textures.drawers(rng, 512, 128, 1, 16, 130)), 4.0, stains, 5.3)
        self.bodies = [
            (Skin(build.texture(textures.car_end(rng))), Skin(build.texture(textures.car_side(rng))),
             Skin(build.texture(textures.car_glass(rng)), tone=rng.uniform(0.6, 1.4)))
            for _ in range(8)
        ]  # fmt: skip

    def blocks(self, x_ends: tuple[float, float], y_ends: tuple[float, float]) -> None:
        """Nine blocks: the one that the streets enclose and those around it."""
        front = STREETS.front
        xs = [x_ends[0], STREETS.xs[0], STREETS.xs[1], x_ends[1]]
        ys = [y_ends[0], STREETS.ys[0], STREETS.ys[1], y_ends[1]]
        for i in range(3):
            for j in range(3):
                low = np.array([xs[i] + front * (i > 0), ys[j] + front * (j > 0)])
                high = np.array([xs[i + 1] - front * (i < 2), ys[j + 1] - front * (j < 2)])
                size = high - low
                wide = front - STREETS.kerb
                self.build.box([*(low + high) / 2, 0.0], (size[0] + 2 * wide, size[1] + 2 * wide, 0.13), self.pavement)
                for k, (normal, start, is_row) in enumerate((
                    ((0.0, -1.0), (low[0], low[1]), j > 0), ((0.0, 1.0), (low[0], high[1]), j < 2),
                    ((-1.0, 0.0), (low[0], low[1]), i > 0), ((1.0, 0.0), (high[0], low[1]), i < 2),
                )):  # fmt: skip
                    if is_row:
                        self._row(np.array(start), np.array(normal), size[0 if k < 2 else 1])
        for x in STREETS.xs:  # houses close the streets' far ends
            for y, side in ((y_ends[0], 1), (y_ends[1], -1)):
                self._house(np.array([x, y]), np.array([0.0, side]), 26.0)
        for y in STREETS.ys:
            for x, side in ((x_ends[0], 1), (x_ends[1], -1)):
                self._house(np.array([x, y]), np.array([side, 0.0]), 26.0)

    def _row(self, start: Array, normal: Array, length: float) -> None:
        """Houses, gardens and what stands at the kerb along one side of a block; the normal points to the street."""
        rng, along = self.rng, np.abs(normal[::-1])
        done = 0.0
        while done < length - 7:
            width = min(rng.uniform(8, 19), length - done)
            middle = start + along * (done + width / 2) - normal * rng.choice([0.0, 0.0, 1.5, 3.0])
            if rng.random() < 0.82:
                self._house(middle, normal, width)
            else:
                skin = self.hedge if rng.random() < 0.6 else self.fence
                size = (width, 0.6) if normal[0] == 0 else (0.6, width)
                self.build.box([*middle - normal * 0.3, 0.13], (*size, rng.uniform(1.1, 2.2)), skin)
                self._tree(middle - normal * rng.uniform(3, 6), rng.uniform(1.5, 2.6))
            done += width + (rng.uniform(1, 4) if rng.random() < 0.25 else 0.0)
        kerb = start + normal * (STREETS.front - STREETS.kerb)
        for at in np.arange(4.0, length - 2, 6.4):
            place = kerb + along * (at + rng.uniform(-0.5, 0.5))
            if rng.random() < 0.5:
                heading = np.degrees(np.arctan2(along[1], along[0])) + 180 * int(rng.integers(0, 2))
                self.car([*place + normal * rng.uniform(1.0, 1.25), 0.0], heading + rng.normal(0, 1.5))
            if rng.random() < 0.22:
                self._tree(place - normal * 0.8, rng.uniform(1.2, 2.0))
            elif rng.random() < 0.3:
                self._pole(place - normal * 0.5, normal)

    def _house(self, middle: Array, normal: Array, width: float) -> None:
        rng, build = self.rng, self.build
        depth, height = rng.uniform(8, 11), rng.uniform(5.5, 13)
        skin = Skin(int(rng.choice(self.facades)), None, self.stains, 5.7, rng.uniform(0.75, 1.25), rng.random() < 0.5)
        foot = [*middle - normal * depth / 2, 0.13]
        size = (width, depth, height) if normal[0] == 0 else (depth, width, height)
        skins = (self.gable, skin, self.roof) if normal[0] == 0 else (skin, self.gable, self.roof)
        build.box(foot, size, skins)
        right = np.array([-normal[1], normal[0], 0.0])
        front = np.array([*middle, 0.13])
        for _ in range(int(rng.integers(0, 4))):  # balconies, steps, shop signs
            at = front + right * rng.uniform(-0.4, 0.4) * width + np.array([*normal, 0.0]) * 0.3
            kind = int(rng.integers(0, 3))
            if kind == 0:
                box = (2.2, 0.7, 0.9) if normal[0] == 0 else (0.7, 2.2, 0.9)
                build.box(at + UP * rng.uniform(2.8, max(height - 2, 3)), box, self.fence, has_bottom=True)
            elif kind == 1:
                box = (1.6, 0.6, 0.35) if normal[0] == 0 else (0.6, 1.6, 0.35)
                build.box(at, box, self.pavement)
            else:
                box = (0.12, 0.7, 0.7) if normal[0] == 0 else (0.7, 0.12, 0.7)
                build.box(at + UP * rng.uniform(2.5, 3.5), box, self.signs[int(rng.integers(8))], has_bottom=True)
        build.box([*middle - normal * depth / 2, height], (1.0, 0.7, rng.uniform(1, 2.5)), self.gable)

    def _tree(self, at: Array, radius: float) -> None:
        foot, height = np.array([*at, 0.1]), self.rng.uniform(2.2, 3.4)
        self.build.cylinder(foot, 0.15 + 0.05 * radius, height + 0.5, self.bark, 8)
        for _ in range(5):
            shift = np.array([*self.rng.uniform(-0.5, 0.5, 2) * radius, height + self.rng.uniform(-0.2, 1.0) * radius])
            size = radius * self.rng.uniform(0.7, 1.3, 3)
            self.build.box(foot + shift, tuple(size), self.crown, self.rng.uniform(0, 90), has_bottom=True)

    def _pole(self, at: Array, normal: Array) -> None:
        high = self.rng.uniform(2.6, 7.0)
        foot = np.array([*at, 0.1])
        self.build.cylinder(foot, 0.06 if high < 4 else 0.1, high, self.metal, 8)
        if high < 4.5:
            yaw = np.degrees(np.arctan2(normal[1], normal[0])) + 90
            skin = self.signs[int(self.rng.integers(8))]
            self.build.box(
                foot + UP * (high - 0.7), (0.06, 0.65, 0.65), (skin, self.metal, self.metal), yaw, has_bottom=True
            )

    def car(
        self, foot: ArrayLike, yaw_deg: float, velocity: ArrayLike = (0.0, 0.0, 0.0),
        cycle: tuple[float, float] = (0.0, 1.0),
    ) -> None:  # fmt: skip
        """A body and a cabin; the car looks along the yaw angle."""
        end, side, glass = self.bodies[int(self.rng.integers(len(self.bodies)))]
        length, width = self.rng.uniform(3.7, 4.7), self.rng.uniform(1.65, 1.85)
        low, high = self.rng.uniform(0.78, 0.95), self.rng.uniform(0.5, 0.75)
        tone = self.rng.uniform(0.8, 1.15)
        paint = replace(self.metal, tone=tone)
        foot = np.asarray(foot, np.float64)
        skins = (replace(end, tone=tone), replace(side, tone=tone), paint)
        self.build.box(foot, (length, width, low), skins, yaw_deg, velocity, cycle)
        back = 0.25 * np.array([np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg)), 0.0])
        self.build.box(
            foot - back + UP * low, (0.52 * length, 0.9 * width, high), (glass, glass, paint), yaw_deg, velocity, cycle
        )

    def traffic(self, count: int, x_ends: tuple[float, float], y_ends: tuple[float, float]) -> None:
        """Cars that come the other way; the drive goes clockwise."""
        for k in range(count):
            speed, side = self.rng.uniform(6, 11), k % 4
            horizontal = side % 2 == 0
            ends = x_ends if horizontal else y_ends
            length = ends[1] - ends[0]
            # clockwise is +x on the upper street, -y on the right one, and so on; this is against it
            direction = {0: np.array([-1.0, 0]), 1: np.array([0, 1.0]), 2: np.array([1.0, 0]), 3: np.array([0, -1.0])}[
                side
            ]
            line = {0: STREETS.ys[1], 1: STREETS.xs[1], 2: STREETS.ys[0], 3: STREETS.xs[0]}[side]
            right = np.array([direction[1], -direction[0]])
            begin = ends[0] if direction.sum() > 0 else ends[1]
            start = np.array([begin, line] if horizontal else [line, begin]) + right * STREETS.lane
            yaw = float(np.degrees(np.arctan2(direction[1], direction[0])))
            velocity = [*direction * speed, 0.0]
            self.car([*start, 0.0], yaw, velocity, (self.rng.uniform(0, length), length))


@lru_cache(maxsize=2)
def look_alike_world(seed: int = 0, *, has_background: bool = True) -> World:
    """A thing about a metre in size that looks the same from opposite sides, in a room of 9 x 8 m with clutter along
    its walls that does not, or before nothing at all."""
    rng = np.random.default_rng([seed, 0xA11CE])
    build = WorldBuilder(rng)
    kinds = (textures.machine, textures.books, textures.carton, textures.poster, textures.picture)
    ends, sides, *small = (Skin(build.texture(kind(rng))) for kind in kinds)
    plain = Skin(build.texture(textures.plaster(rng)), 3.0)
    build.box((0, 0, 0), (0.9, 0.55, 1.1), (ends, sides, plain))
    for k, (x, y, width, height) in enumerate(
        ((0.55, 0.42, 0.25, 0.5), (0.15, -0.5, 0.3, 0.35), (0.6, -0.3, 0.22, 0.7))
    ):
        for sign in (1, -1):
            skins = (small[k], small[(k + 1) % 3], small[(k + 2) % 3])
            build.box((sign * x, sign * y, 0), (width, width, height), skins)
    if has_background:
        build.inside((4.5, 4.0), 3.2, plain, Skin(build.texture(textures.carpet(rng)), 2.5), plain)
        for n in range(14):
            angle = 2 * np.pi * (n + rng.uniform(-0.3, 0.3)) / 14
            foot = rng.uniform(3.0, 3.7) * np.array([np.cos(angle), np.sin(angle), 0.0])
            skin = Skin(build.texture(kinds[int(rng.integers(len(kinds)))](rng)))
            size = [float(v) for v in (*rng.uniform(0.4, 0.9, 2), rng.uniform(0.6, 2.0))]
            build.box(foot, size, (skin, skin, plain), yaw_deg=float(rng.uniform(0, 90)))
    return build.build()


def cluttered_world(seed: int = 0) -> World:
    """Boards, slats and boxes of all sizes that hide one another, up to 5 m along +x from the origin at 1.4 m above the
    floor, before a wall askew: whatever is seen has something else behind it."""
    rng = np.random.default_rng([seed, 0xC1077E])
    build = WorldBuilder(rng)
    kinds = (textures.machine, textures.books, textures.carton, textures.poster, textures.picture, textures.leaves,
             textures.planks, textures.bricks, textures.carpet, textures.plaster)  # fmt: skip
    skins = [Skin(build.texture(kind(rng)), float(rng.uniform(0.4, 1.2))) for kind in kinds]
    floor = Skin(build.texture(textures.carpet(rng)), 1.5, build.texture(textures.dirt(rng)), 2.3)
    build.quad((-1.0, 12.0, 0.0), (9.0, 0.0, 0.0), (0.0, -24.0, 0.0), floor)
    askew = np.radians(rng.uniform(-25.0, 25.0))
    wall = skins[int(rng.integers(len(skins)))]
    build.wall((6.0, 0.0, 4.0), (-np.cos(askew), np.sin(askew), 0.0), 24.0, 10.0, wall)
    for _ in range(45):
        distance = float(np.exp(rng.uniform(np.log(1.3), np.log(4.8))))
        centre = distance * np.array([1.0, *rng.uniform((-0.6, -0.4), (0.6, 0.4))]) + (0.0, 0.0, 1.4)
        size = np.exp(rng.uniform(np.log(0.04), np.log(0.45), 2)) * distance / 2.0
        _board(build, centre, rng.uniform((-50.0, -35.0, -60.0), (50.0, 35.0, 60.0)), size, skins)
    for _ in range(8):
        x = float(rng.uniform(2.0, 5.0))
        sides = [float(v) for v in rng.uniform(0.2, 0.7, 3)]
        foot = (x, float(rng.uniform(-0.6, 0.6) * x), 0.0)
        build.box(foot, sides, skins[int(rng.integers(len(skins)))], yaw_deg=float(rng.uniform(0, 90)))
    return build.build()


def _board(build: WorldBuilder, centre: ArrayLike, turn_deg: ArrayLike, size: ArrayLike, skins: Sequence[Skin]) -> None:
    """A rectangle that faces the origin but for a turn about the vertical, a tilt, and a roll in its plane."""
    yaw, tilt, roll = np.radians(turn_deg)
    normal = -np.array([np.cos(yaw) * np.cos(tilt), np.sin(yaw) * np.cos(tilt), np.sin(tilt)])
    across = np.cross(UP, normal)
    across /= np.linalg.norm(across)
    upwards = np.cross(normal, across)
    right = np.cos(roll) * across + np.sin(roll) * upwards
    up = np.cross(normal, right)
    width, height = np.asarray(size, np.float64)
    corner = np.asarray(centre, np.float64) - right * width / 2 + up * height / 2
    build.quad(corner, right * width, -up * height, skins[int(build.rng.integers(len(skins)))])
