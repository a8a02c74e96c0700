# /// script
# requires-python = ">=3.11"
# dependencies = ["mitsuba>=3.6", "numpy>=2", "pillow>=11"]
# ///
"""Render the bundled sample, data/courtyard: a made-up courtyard, photographed by hand from an arc.

    pip install mitsuba pillow && python data/make_sample.py

Everything comes from numpy noise and this file: no asset is loaded. Surfaces are diffuse grids, displaced by real
relief (bricks, joints, chips), coloured by noise over many octaves that never repeats, lit by a sun and a sky.
The camera is SIMPLE_RADIAL, and exactly so: rays are shot through the distorted pixels, nothing is resampled.

Mitsuba's vectorised mode needs a recent LLVM as a shared library: ``apt install libllvm19``, or name the file in
DRJIT_LIBLLVM_PATH (22 was used; 15 is too old). About twelve CPU minutes and 2 GB.
"""

from __future__ import annotations

import argparse
import io
import json
import time
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from PIL import Image

mi.set_variant("llvm_ad_rgb")
import drjit as dr  # noqa: E402  (its types follow the variant)

WIDTH, HEIGHT = 800, 600
FOCAL_PX, K1 = 704.0, -0.045
NUM_VIEWS = 18
TARGET = np.array([2.6, 2.6, 0.95])
SUN = np.array([0.78, 0.42, 0.74])  # direction towards it
SUN_RADIUS = 0.016  # of its disc in radians; three times the real one, for softer shadows
SUNLIGHT = [1.33, 1.19, 0.99]  # irradiance at normal incidence over pi, as the sky's colours are radiances
GLOW = [0.16, 0.16, 0.16]  # what two bounces and more would add
EXPOSURE = 0.66
WALL_LENGTH, WALL_HEIGHT = 8.6, 3.3
FOUNTAIN = np.array([3.0, 3.0, 0.0])

Array = np.ndarray


# ---------------------------------------------------------------- noise
def spectral_noise(shape: tuple[int, int], rng: np.random.Generator, beta: float = 1.9) -> Array:
    """(H, W) noise with zero mean, unit deviation and a power spectrum of 1 / f^beta: detail at every scale."""
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None]
    f = np.hypot(fy, fx)
    f[0, 0] = np.inf
    white = np.fft.rfft2(rng.standard_normal(shape, dtype=np.float32))
    noise = np.fft.irfft2(white * f ** (-beta / 2), s=shape)
    return ((noise - noise.mean()) / noise.std()).astype(np.float32)


def lattice_noise(xyz: Array, seed: int, size_m: float, octaves: int = 7, gain: float = 0.62) -> Array:
    """(...) smooth noise in about -1..1 at points (..., 3), coarsest feature size_m metres, alike on all surfaces."""
    out = np.zeros(xyz.shape[:-1], np.float32)
    amplitude, frequency = 1.0, 1.0 / size_m
    for octave in range(octaves):
        p = xyz * frequency + 17.3 * octave
        cell = np.floor(p).astype(np.int64)
        t = (p - cell).astype(np.float32)
        t = t * t * (3 - 2 * t)
        value = np.zeros_like(out)
        for corner in range(8):
            d = [(corner >> axis) & 1 for axis in range(3)]
            weight = np.ones_like(out)
            for axis in range(3):
                weight *= t[..., axis] if d[axis] else 1 - t[..., axis]
            value += weight * _hash(cell[..., 0] + d[0], cell[..., 1] + d[1], cell[..., 2] + d[2], seed + octave)
        out += amplitude * value
        amplitude *= gain
        frequency *= 2.03
    return out * (1 - gain) * 1.7


def _hash(x: Array, y: Array, z: Array, seed: int) -> Array:
    h = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791) ^ (seed * 2654435761)
    h = ((h & 0xFFFFFFFF) * 0x9E3779B1) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 0x85EBCA6B) & 0xFFFFFFFF
    return ((h ^ (h >> 13)) & 0xFFFF).astype(np.float32) / 32767.5 - 1


def smoothstep(low: float, high: float, x: Array) -> Array:
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def mix(a: Array, b: Array, t: Array) -> Array:
    return a + (np.asarray(b, np.float32) - a) * t[..., None]


# ---------------------------------------------------------------- surfaces
class Scene:
    """Collects meshes: grids of positions with a colour map of the same or a finer grid."""

    def __init__(self) -> None:
        self.shapes: dict[str, Any] = {}

    def add_grid(self, xyz: Array, rgb: Array, stride: int) -> None:
        """Add a surface: xyz (H, W, 3) metres, rgb (H, W, 3) reflectance; the mesh takes every stride-th position."""
        rows = _every(xyz.shape[0], stride)
        cols = _every(xyz.shape[1], stride)
        vertices = xyz[np.ix_(rows, cols)].reshape(-1, 3)
        # texel k covers [k, k + 1] / size in uv, so the sample at texel k sits at k + 0.5
        u, v = np.meshgrid((cols + 0.5) / xyz.shape[1], (rows + 0.5) / xyz.shape[0])
        index = np.arange(len(rows) * len(cols)).reshape(len(rows), len(cols))
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
        faces = np.stack([np.stack([a, c, b], -1), np.stack([b, c, d], -1)]).reshape(-1, 3)
        self._add(vertices, faces, np.stack([u, v], -1).reshape(-1, 2), rgb)

    def _add(self, vertices: Array, faces: Array, uv: Array, rgb: Array) -> None:
        texture = {
            "type": "bitmap", "data": mi.TensorXf(np.ascontiguousarray(np.clip(rgb, 0.01, 0.9), np.float32)),
            "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp",
        }  # fmt: skip
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict({"type": "twosided", "b": {"type": "diffuse", "reflectance": texture}})
        name = f"s{len(self.shapes):03d}"
        mesh = mi.Mesh(name, len(vertices), len(faces), properties, has_vertex_normals=False, has_vertex_texcoords=True)
        params = mi.traverse(mesh)
        params["vertex_positions"] = mi.Float(np.ascontiguousarray(vertices, np.float32).ravel())
        params["faces"] = mi.UInt32(np.ascontiguousarray(faces, np.uint32).ravel())
        # mitsuba's bitmaps have v pointing up
        uv = np.stack([uv[:, 0], 1 - uv[:, 1]], -1)
        params["vertex_texcoords"] = mi.Float(np.ascontiguousarray(uv, np.float32).ravel())
        params.update()
        self.shapes[name] = mesh


def _every(size: int, stride: int) -> Array:
    return np.unique(np.append(np.arange(0, size, stride), size - 1))


def masonry(
    shape: tuple[int, int], step_m: float, course_m: tuple[float, float], stone_m: tuple[float, float],
    wobble_m: float, rng: np.random.Generator,
) -> tuple[Array, Array]:  # fmt: skip
    """Courses of stones of random size: (H, W) number of the stone, and distance to its edge in metres."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float32) * np.float32(step_m)
    x = x + wobble_m * spectral_noise(shape, rng, 2.6)
    y = y + wobble_m * spectral_noise(shape, rng, 2.6)
    y_edges = _random_edges(-0.3, shape[0] * step_m + 0.6, course_m, rng)
    course = np.searchsorted(y_edges, y, side="right")
    stone = np.zeros(shape, np.int64)
    distance = np.minimum(y - y_edges[course - 1], y_edges[course] - y)
    for c in np.unique(course):
        here = course == c
        x_edges = _random_edges(-1.0 - rng.random(), shape[1] * step_m + 1.0, stone_m, rng)
        k = np.searchsorted(x_edges, x[here], side="right")
        stone[here] = c * 4096 + k
        distance[here] = np.minimum(distance[here], np.minimum(x[here] - x_edges[k - 1], x_edges[k] - x[here]))
    return np.unique(stone, return_inverse=True)[1].reshape(shape), distance


def _random_edges(start: float, stop: float, size: tuple[float, float], rng: np.random.Generator) -> Array:
    edges = start + np.cumsum(rng.uniform(*size, int((stop - start) / size[0]) + 4))
    return np.concatenate([[start - size[1]], [start], edges, [stop + 99]])


def weather(rgb: Array, rng: np.random.Generator, amount: float = 0.16) -> Array:
    """Multiply a colour map by fine grain, blotches and dark specks."""
    shape = rgb.shape[:2]
    grain = spectral_noise(shape, rng, 1.0)
    blotch = spectral_noise(shape, rng, 2.3)
    specks = smoothstep(2.0, 2.6, spectral_noise(shape, rng, 1.3))
    pale = smoothstep(2.1, 2.7, spectral_noise(shape, rng, 1.5))
    out = rgb * np.exp(amount * 0.9 * grain + amount * blotch)[..., None]
    out = out * (1 - 0.55 * specks[..., None])
    return mix(out, np.array([0.62, 0.6, 0.54]), 0.6 * pale).astype(np.float32)


def brick_wall(scene: Scene, rng: np.random.Generator) -> None:
    """The wall in the plane y = 0: bricks, with plaster left on a part of it."""
    step = 0.003
    shape = (int(WALL_HEIGHT / step), int(WALL_LENGTH / step))
    stone, edge = masonry(shape, step, (0.092, 0.102), (0.2, 0.31), 0.0022, rng)
    count = stone.max() + 1
    palette = np.array(
        [
            [0.42, 0.17, 0.10], [0.34, 0.13, 0.09], [0.50, 0.25, 0.15],
            [0.26, 0.12, 0.10], [0.55, 0.33, 0.22], [0.38, 0.22, 0.17],
        ]
    )  # fmt: skip
    colour = palette[rng.integers(0, len(palette), count)] * np.exp(0.16 * rng.standard_normal((count, 1)))
    solid = smoothstep(0.003, 0.011, edge)
    rgb = mix(np.broadcast_to(np.float32([0.47, 0.44, 0.38]), (*shape, 3)), colour[stone], solid)
    proud = rng.normal(0, 0.003, count)[stone] + 0.0022 * spectral_noise(shape, rng, 1.6)
    height = 0.014 * solid + solid * proud
    # what is left of the plaster: 14 mm thick with broken edges
    y = np.linspace(0, 1, shape[0])[:, None]
    cover = spectral_noise(shape, rng, 3.0) + 0.25 * spectral_noise(shape, rng, 1.8) + 1.0 * (y - 0.62)
    plaster = smoothstep(0.55, 0.61, cover)
    skin = 0.028 + 0.0016 * spectral_noise(shape, rng, 2.2)
    rgb = mix(rgb, np.array([0.60, 0.53, 0.41]), plaster)
    cracks = np.abs(spectral_noise(shape, rng, 2.5)) < 0.012
    rgb = rgb * (1 - 0.5 * (cracks * plaster))[..., None]
    height = height * (1 - plaster) + skin * plaster
    rgb = _stains(weather(rgb, rng), rng)
    x, z = _plane(shape, step)
    scene.add_grid(np.stack([x, height, z], -1), rgb, 3)


def stone_wall(scene: Scene, rng: np.random.Generator) -> None:
    """The wall in the plane x = 0: ashlar blocks with bevelled, chipped edges."""
    step = 0.003
    shape = (int(WALL_HEIGHT / step), int(WALL_LENGTH / step))
    stone, edge = masonry(shape, step, (0.2, 0.36), (0.32, 0.78), 0.006, rng)
    count = stone.max() + 1
    tint = np.array(
        [[0.46, 0.42, 0.34], [0.38, 0.37, 0.34], [0.52, 0.46, 0.35], [0.33, 0.31, 0.28], [0.45, 0.38, 0.30]]
    )
    colour = tint[rng.integers(0, len(tint), count)] * np.exp(0.13 * rng.standard_normal((count, 1)))
    chips = 0.006 * spectral_noise(shape, rng, 2.0)
    solid = smoothstep(0.006, 0.03, edge + chips)
    rgb = mix(np.broadcast_to(np.float32([0.30, 0.27, 0.22]), (*shape, 3)), colour[stone], solid)
    layers = spectral_noise((shape[0] // 4 + 1, shape[1] // 40 + 1), rng, 1.5)
    layers = np.kron(layers, np.ones((4, 40), np.float32))[: shape[0], : shape[1]]
    rgb = rgb * np.exp(0.06 * layers)[..., None]
    height = solid * (0.035 + rng.normal(0, 0.009, count)[stone]) + 0.004 * spectral_noise(shape, rng, 1.9)
    rgb = _stains(weather(rgb, rng), rng)
    y, z = _plane(shape, step)
    scene.add_grid(np.stack([height, y, z], -1), rgb, 3)


def _plane(shape: tuple[int, int], step: float) -> tuple[Array, Array]:
    """Horizontal and upward coordinates of a wall's grid, first row on top."""
    rows, cols = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float32)
    return cols * step, (shape[0] - 1 - rows) * step


def _stains(rgb: Array, rng: np.random.Generator) -> Array:
    """Dark streaks running down from the top of a wall and moss rising from its foot."""
    shape = rgb.shape[:2]
    depth = np.linspace(0, 1, shape[0], dtype=np.float32)[:, None]
    columns = np.interp(np.arange(shape[1]), np.arange(0, shape[1] + 12, 12), rng.standard_normal(shape[1] // 12 + 2))
    streak = smoothstep(0.3, 2.0, columns[None] * 0.9 + 0.7 * spectral_noise(shape, rng, 2.4)) * (1 - depth) ** 1.5
    moss = smoothstep(0.5, 1.6, spectral_noise(shape, rng, 2.0) + 7.5 * (depth - 0.86))
    return mix(rgb * (1 - 0.6 * streak[..., None]), np.array([0.12, 0.16, 0.06]), 0.75 * moss)


def floor(scene: Scene, rng: np.random.Generator) -> None:
    """Flagstones with grass and grit in the joints."""
    step = 0.0032
    size = int(10.2 / step)
    stone, edge = masonry((size, size), step, (0.36, 0.66), (0.35, 0.95), 0.012, rng)
    count = stone.max() + 1
    tint = np.array(
        [[0.40, 0.38, 0.35], [0.47, 0.42, 0.35], [0.33, 0.33, 0.33], [0.42, 0.35, 0.29], [0.50, 0.47, 0.42]]
    )
    colour = tint[rng.integers(0, len(tint), count)] * np.exp(0.12 * rng.standard_normal((count, 1)))
    solid = smoothstep(0.006, 0.024, edge + 0.005 * spectral_noise((size, size), rng, 2.0))
    joint = mix(
        np.broadcast_to(np.float32([0.21, 0.17, 0.12]), (size, size, 3)), np.array([0.13, 0.20, 0.06]),
        smoothstep(-0.3, 0.9, spectral_noise((size, size), rng, 1.7)),
    )  # fmt: skip
    rgb = weather(mix(joint, colour[stone], solid), rng, 0.17)
    tilt = rng.normal(0, 0.004, count)[stone]
    height = solid * (0.03 + tilt) + 0.003 * spectral_noise((size, size), rng, 1.8) - 0.03
    a = (np.arange(size) * step - 0.2).astype(np.float32)
    x, y = np.meshgrid(a, a)
    scene.add_grid(np.stack([x, y, height], -1), rgb, 4)
    far = np.array([[[-60, -60], [60, -60]], [[-60, 60], [60, 60]]], np.float32)
    scene.add_grid(np.concatenate([far, np.full((2, 2, 1), -0.08)], -1), np.full((2, 2, 3), 0.25, np.float32), 1)


def rock_colour(xyz: Array, seed: int, base: Array) -> Array:
    """Colour of weathered stone at points (..., 3): veins, grain, lichen."""
    coarse, fine = lattice_noise(xyz, seed, 0.35), lattice_noise(xyz, seed + 31, 0.025, 3, 0.85)
    rgb = np.asarray(base, np.float32) * np.exp(0.45 * coarse + 0.55 * fine)[..., None]
    veins = smoothstep(0.06, 0.0, np.abs(lattice_noise(xyz, seed + 57, 0.5, 5, 0.5)))
    rgb = rgb * (1 - 0.35 * veins[..., None])
    lichen = smoothstep(0.28, 0.45, lattice_noise(xyz, seed + 83, 0.16, 6, 0.7))
    rgb = mix(rgb, np.array([0.50, 0.47, 0.24]), 0.75 * lichen)
    dark = smoothstep(0.35, 0.5, lattice_noise(xyz, seed + 97, 0.07, 5, 0.75))
    return rgb * (1 - 0.5 * dark[..., None])


def wood_colour(xyz: Array, seed: int, base: Array) -> Array:
    """Planks with grain along z, 0.14 m wide across the two other axes."""
    across = xyz[..., 0] + xyz[..., 1]
    plank = np.floor(across / 0.14).astype(np.int64)
    tone = _hash(plank, plank * 3, plank * 0, seed)
    stretched = xyz * np.array([1, 1, 0.06], np.float32)
    grain = lattice_noise(stretched, seed, 0.05, 5, 0.75) + 0.5 * lattice_noise(xyz, seed + 9, 0.2)
    gap = smoothstep(0.010, 0.004, np.abs((across / 0.14) % 1 * 0.14 - 0.0))
    return np.asarray(base, np.float32) * np.exp(0.2 * tone + 0.55 * grain)[..., None] * (1 - 0.8 * gap[..., None])


def cube_faces(n: tuple[int, int, int]) -> list[Array]:
    """Six (H, W, 3) grids over the faces of the cube -1..1, n samples along x, y, z."""
    faces = []
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            face = np.empty((n[c], n[b], 3), np.float32)
            face[..., axis] = sign
            face[..., b], face[..., c] = np.meshgrid(np.linspace(-1, 1, n[b]), np.linspace(-1, 1, n[c]))
            faces.append(face)
    return faces


def block(
    scene: Scene, centre: tuple[float, float, float], size: tuple[float, float, float], seed: int,
    base: tuple[float, float, float], yaw_deg: float = 0.0, wood: bool = False, rough_m: float = 0.012,
) -> None:  # fmt: skip
    """A block of stone or wood with softened, chipped edges."""
    half = np.asarray(size, np.float32) / 2
    n = [max(4, int(s / 0.004)) for s in size]
    angle = np.radians(yaw_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]], np.float32)
    offset = np.asarray(centre, np.float32)
    for face in cube_faces((n[0], n[1], n[2])):
        body = face * half
        inner = np.clip(body, -(half - 0.02), half - 0.02)  # round the edges: pull to 2 cm around the inner box
        away = body - inner
        length = np.linalg.norm(away, axis=-1, keepdims=True)
        rounded = inner + away / np.maximum(length, 1e-6) * np.minimum(length, 0.02)
        world = rounded @ turn.T + offset
        push = (lattice_noise(world, seed, 0.22, 6, 0.55) - 0.15)[..., None] * rough_m
        normal = (away / np.maximum(length, 1e-6)) @ turn.T
        rgb = wood_colour(world, seed, np.asarray(base)) if wood else rock_colour(world, seed, np.asarray(base))
        scene.add_grid(world + push * normal, rgb, 2)


def boulder(scene: Scene, centre: tuple[float, float, float], size: tuple[float, float, float], seed: int) -> None:
    """An ellipsoid crumpled by noise."""
    rng = np.random.default_rng(seed)
    base = np.array([0.44, 0.41, 0.37]) * rng.uniform(0.75, 1.15) * np.exp(0.03 * rng.standard_normal(3))
    n = max(60, int(max(size) * 1.7 / 0.004))
    for face in cube_faces((n, n, n)):
        # tangent spacing makes the six grids nearly even on the sphere
        ball = np.tan(face * (np.pi / 4))
        ball = ball / np.linalg.norm(ball, axis=-1, keepdims=True)
        body = ball * np.asarray(size, np.float32) + np.asarray(centre, np.float32)
        lumps = lattice_noise(body, seed, max(size) * 1.1, 8, 0.5)
        facets = np.abs(lattice_noise(body, seed + 5, max(size) * 0.7, 4, 0.5))
        body = body + ball * np.asarray(size, np.float32) * (0.42 * lumps - 0.3 * facets)[..., None]
        scene.add_grid(body.astype(np.float32), rock_colour(body, seed + 7, base), 2)


def turned(
    scene: Scene, foot: tuple[float, float, float], profile: list[tuple[float, float]], seed: int,
    base: tuple[float, float, float], flutes: int = 0, rough_m: float = 0.010, step_m: float = 0.004,
) -> None:  # fmt: skip
    """A surface of revolution about the vertical through foot; profile holds (radius, height) corners."""
    corners = np.asarray(profile, np.float64)
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    s = np.linspace(0, along[-1], int(along[-1] / step_m))
    radius, height = np.interp(s, along, corners[:, 0]), np.interp(s, along, corners[:, 1])
    angle = np.linspace(0, 2 * np.pi, int(2 * np.pi * radius.max() / step_m) + 1)
    tangent = np.stack([np.gradient(radius, s), np.gradient(height, s)], -1)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    xyz = np.concatenate(
        [radius[:, None, None] * ring[None], np.broadcast_to(height[:, None, None], (len(s), len(angle), 1))], -1
    )
    normal = np.concatenate(
        [tangent[:, 1, None, None] * ring[None], np.broadcast_to(-tangent[:, 0, None, None], (len(s), len(angle), 1))],
        -1,
    )
    world = (xyz + np.asarray(foot)).astype(np.float32)
    push = rough_m * (lattice_noise(world, seed, 0.25, 7, 0.58) - 0.1)
    if flutes:
        middle = (height > 0.3) & (height < height.max() - 0.35)
        push = push - 0.016 * middle[:, None] * np.abs(np.sin(angle * flutes / 2))[None]
    rgb = rock_colour(world, seed + 3, np.asarray(base))
    scene.add_grid((world + push[..., None] * normal).astype(np.float32), rgb, 2)


def ivy(scene: Scene, rng: np.random.Generator) -> None:
    """Leaves hanging over the corner of the walls, each a bent kite of its own green."""
    count = 5200
    along = np.abs(rng.normal(0, 0.62, count)) + rng.exponential(0.25, count)
    reach = 0.5 + 1.5 * np.exp(-along / 0.9) + 0.3 * np.sin(along * 7)
    drop = rng.random(count) ** 0.9 * reach
    thickness = 0.03 + 0.16 * rng.random(count)
    on_brick = rng.random(count) < 0.55
    z = WALL_HEIGHT + 0.12 - drop
    centre = np.where(
        on_brick[:, None], np.stack([along, thickness, z], -1), np.stack([thickness + 0.02, along, z], -1)
    )
    out = np.where(on_brick[:, None], [0.0, 1.0, 0.25], [1.0, 0.0, 0.25]) + 0.45 * rng.standard_normal((count, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    down = np.array([0, 0, -1.0]) + 0.5 * rng.standard_normal((count, 3))
    down -= out * np.sum(out * down, 1, keepdims=True)
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    side = np.cross(out, down)
    length = rng.uniform(0.05, 0.105, (count, 1))
    corners = np.stack(
        [
            centre - 0.5 * length * down, centre + 0.42 * length * side + 0.15 * length * out,
            centre + 0.7 * length * down, centre - 0.42 * length * side + 0.15 * length * out,
        ], 1,
    )  # fmt: skip
    faces = (np.arange(count)[:, None, None] * 4 + np.array([[0, 2, 1], [0, 3, 2]])).reshape(-1, 3)
    green = np.array([0.10, 0.22, 0.05]) * np.exp(
        0.4 * rng.standard_normal((count, 1)) + 0.15 * rng.standard_normal((count, 3))
    )
    autumn = rng.random(count) < 0.12
    green[autumn] = np.array([0.35, 0.17, 0.05]) * np.exp(0.3 * rng.standard_normal((autumn.sum(), 1)))
    # four texels per leaf, in one row: base, rim, tip, rim
    shade = np.array([0.75, 1.0, 1.25, 0.9])
    rgb = (green[:, None] * shade[None, :, None]).reshape(1, -1, 3)
    rgb = np.concatenate([rgb, rgb])
    uv = np.stack([(np.arange(4 * count) + 0.5) / (4 * count), np.full(4 * count, 0.5)], -1)
    scene._add(corners.reshape(-1, 3), faces, uv, rgb)


def build_scene(seed: int = 7) -> mi.Scene:
    """The whole courtyard: corner of the walls at the origin, z up, metres."""
    scene = Scene()
    brick_wall(scene, np.random.default_rng([seed, 1]))
    stone_wall(scene, np.random.default_rng([seed, 2]))
    floor(scene, np.random.default_rng([seed, 3]))
    ivy(scene, np.random.default_rng([seed, 4]))
    sand, grey, clay, oak = (0.52, 0.46, 0.35), (0.42, 0.41, 0.39), (0.50, 0.23, 0.13), (0.27, 0.17, 0.10)
    rng = np.random.default_rng([seed, 5])
    start = 0.15
    while start < WALL_LENGTH - 0.2:  # coping stones
        length = rng.uniform(0.5, 0.85)
        middle, jitter = start + length / 2, rng.normal(0, 0.012, 4)
        block(
            scene,
            (middle, 0.0 + jitter[0], WALL_HEIGHT + 0.06 + jitter[1]),
            (length - 0.015, 0.42, 0.14),
            int(900 + 10 * start),
            sand,
        )
        block(
            scene,
            (0.0 + jitter[2], middle, WALL_HEIGHT + 0.06 + jitter[3]),
            (0.42, length - 0.015, 0.14),
            int(700 + 10 * start),
            grey,
        )
        start += length
    # door, its frame and three steps at the stone wall
    block(scene, (0.06, 3.15, 1.48), (0.08, 0.96, 1.9), 41, oak, wood=True, rough_m=0.004)
    for y, s in ((2.55, 42), (3.75, 43)):
        block(scene, (0.10, y, 1.5), (0.26, 0.24, 2.0), s, sand)
    block(scene, (0.12, 3.15, 2.6), (0.32, 1.66, 0.26), 44, sand)
    for k in range(3):
        block(
            scene,
            (0.55 - 0.02 * k, 3.15 + 0.03 * k, 0.09 + 0.17 * k),
            (1.25 - 0.34 * k, 2.3 - 0.3 * k, 0.18),
            45 + k,
            grey,
        )
    # window with shutters at the brick wall
    block(scene, (5.35, 0.03, 1.75), (0.75, 0.05, 1.0), 51, (0.06, 0.07, 0.08), rough_m=0.004)
    for x, yaw, s in ((4.72, 14.0, 52), (5.98, -9.0, 53)):
        block(scene, (x, 0.12, 1.75), (0.46, 0.045, 1.08), s, (0.13, 0.24, 0.22), yaw, wood=True, rough_m=0.004)
    block(scene, (5.35, 0.10, 1.17), (1.05, 0.24, 0.1), 54, sand)
    block(scene, (5.35, 0.07, 2.36), (1.15, 0.18, 0.2), 55, sand)
    # colonnade: two whole columns under a beam, one broken
    shaft = [(0.0, 0.0), (0.30, 0.0), (0.30, 0.12), (0.25, 0.16), (0.27, 0.2), (0.21, 0.26), (0.2, 0.6)]
    top = [(0.175, 2.35), (0.21, 2.4), (0.21, 2.44), (0.29, 2.56), (0.29, 2.66), (0.0, 2.66)]
    turned(scene, (1.45, 1.15, 0.0), shaft + top, 61, sand, flutes=16)
    turned(scene, (3.75, 1.15, 0.0), shaft + top, 62, sand, flutes=16)
    turned(scene, (6.25, 1.2, 0.0), [*shaft, (0.19, 1.32), (0.12, 1.42), (0.0, 1.37)], 63, sand, flutes=16)
    block(scene, (2.55, 1.15, 2.80), (3.3, 0.4, 0.3), 64, sand, rough_m=0.02)
    # fountain: a basin, a stem and a bowl
    basin = [
        (0.0, 0.10), (0.86, 0.12), (0.9, 0.42), (0.88, 0.5), (0.92, 0.54), (1.1, 0.54), (1.13, 0.5),
        (1.07, 0.44), (1.03, 0.12), (1.14, 0.08), (1.16, 0.0),
    ]  # fmt: skip
    turned(scene, tuple(FOUNTAIN), basin[::-1], 71, grey)
    ball = [(0.15 * np.sin(t), 1.47 - 0.15 * np.cos(t)) for t in np.linspace(0.5, np.pi, 24)]
    stem = [
        (0.3, 0.1), (0.3, 0.2), (0.17, 0.27), (0.12, 0.45), (0.16, 0.62), (0.11, 0.8), (0.16, 0.92),
        (0.5, 1.1), (0.56, 1.19), (0.51, 1.19), (0.3, 1.1), (0.09, 1.07), (0.07, 1.3), *ball,
    ]  # fmt: skip
    turned(scene, tuple(FOUNTAIN), stem, 72, sand)
    for s, (centre, size) in enumerate(
        [
            ((5.15, 2.35, 0.17), (0.46, 0.36, 0.33)), ((5.75, 2.05, 0.10), (0.24, 0.28, 0.2)),
            ((1.75, 5.35, 0.25), (0.50, 0.58, 0.48)), ((2.35, 5.75, 0.10), (0.28, 0.22, 0.2)),
            ((4.55, 4.75, 0.10), (0.27, 0.24, 0.2)), ((0.75, 1.0, 0.2), (0.38, 0.33, 0.36)),
            ((0.6, 6.6, 0.2), (0.42, 0.5, 0.45)), ((7.4, 0.65, 0.2), (0.5, 0.35, 0.4)),
        ]
    ):  # fmt: skip
        boulder(scene, centre, size, 81 + s)
    pot = [
        (0.0, 0.0),
        (0.12, 0.0),
        (0.2, 0.2),
        (0.22, 0.32),
        (0.15, 0.44),
        (0.17, 0.5),
        (0.14, 0.5),
        (0.12, 0.43),
        (0.0, 0.35),
    ]
    turned(scene, (0.75, 4.62, 0.0), pot, 91, clay)
    turned(scene, (0.62, 1.72, 0.0), [(r * 1.15, z * 1.35) for r, z in pot], 92, clay)
    turned(scene, (2.65, 0.62, 0.0), [(r * 0.9, z * 0.9) for r, z in pot], 93, clay)
    block(scene, (4.35, 1.75, 0.16), (0.62, 0.4, 0.3), 94, sand, 27.0, rough_m=0.03)
    block(scene, (1.35, 7.1, 0.2), (0.5, 0.8, 0.4), 95, sand, -18.0, rough_m=0.03)
    return mi.load_dict({"type": "scene", "sky": sky(np.random.default_rng([seed, 6])), **scene.shapes})


def sky(rng: np.random.Generator) -> dict[str, Any]:
    """A blue gradient with thin clouds, as light from all around."""
    shape = (256, 512)
    up = np.cos(np.linspace(0, np.pi, shape[0]))[:, None]
    blue = mix(
        np.broadcast_to(np.float32([0.95, 1.12, 1.35]), (*shape, 3)),
        np.array([0.30, 0.52, 1.0]),
        smoothstep(0, 0.9, up + np.zeros(shape)),
    )
    cloud = smoothstep(0.1, 1.8, spectral_noise(shape, rng, 3.2)) * smoothstep(0.0, 0.25, up)
    rgb = mix(blue, np.array([1.5, 1.5, 1.5]), 0.8 * cloud) * np.where(up > 0, 1.0, 0.25)[..., None]
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(rgb, np.float32)), "to_world": upright}


# ---------------------------------------------------------------- cameras
def make_cameras(seed: int = 11, num_views: int = NUM_VIEWS) -> list[tuple[Array, Array]]:
    """World-to-camera (R, t) of every view, x right, y down, z forward: an unsteady walk around the fountain."""
    rng = np.random.default_rng(seed)
    views = []
    for k in range(num_views):
        share = k / (num_views - 1)
        azimuth = np.radians(-4 + 98 * share + rng.normal(0, 1.2))
        distance = 4.75 + 0.65 * np.sin(2.1 * k + 0.5) + rng.normal(0, 0.12)
        height = 1.65 + 0.5 * np.sin(1.3 * k + 1.0) + rng.normal(0, 0.06)
        centre = np.array([2.75 + distance * np.cos(azimuth), 2.75 + distance * np.sin(azimuth), height])
        views.append(look_at(centre, TARGET + rng.normal(0, 0.16, 3), np.radians(rng.normal(0, 1.6))))
    return views


def look_at(centre: Array, target: Array, roll_rad: float = 0.0) -> tuple[Array, Array]:
    """World-to-camera (R, t) of a camera at a point that looks at another, level but for its roll."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    x = np.cos(roll_rad) * right + np.sin(roll_rad) * np.cross(forward, right)
    rotation = np.stack([x, np.cross(forward, x), forward])
    return rotation, -rotation @ centre


def undistort(x: Array, y: Array) -> tuple[Array, Array]:
    """Normalised points of distorted normalised points: Newton on r (1 + k1 r^2) = r_d."""
    distorted = np.hypot(x, y)
    r = distorted.copy()
    for _ in range(6):
        r -= (r * (1 + K1 * r * r) - distorted) / (1 + 3 * K1 * r * r)
    scale = np.where(distorted > 1e-12, r / np.maximum(distorted, 1e-12), 1.0)
    return x * scale, y * scale


def radiance(scene: mi.Scene, ray: mi.Ray3f, xi: list[mi.Float]) -> mi.Color3f:
    """Light along rays: sun and sky on a diffuse surface, one bounce of both, and an even glow for the rest.

    Every sample sees the sun's disc once and one direction of the hemisphere, drawn by its cosine, so that only
    penumbrae and occlusion are noisy. xi: four uniform numbers per ray.
    """
    sky = scene.environment()
    hit = scene.ray_intersect(ray)
    seen = hit.is_valid()
    albedo, frame = _surface(hit, ray, seen)
    sun_frame = mi.Frame3f(dr.normalize(mi.Vector3f(SUN.tolist())))
    disc = mi.warp.square_to_uniform_disk(mi.Point2f(xi[0], xi[1])) * SUN_RADIUS
    sun = dr.normalize(sun_frame.to_world(mi.Vector3f(disc.x, disc.y, 1)))
    light = _sunlight(scene, hit, frame, sun, seen)
    bounce = hit.spawn_ray(frame.to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(xi[2], xi[3]))))
    second = scene.ray_intersect(bounce, seen)
    blocked = seen & second.is_valid()
    albedo2, frame2 = _surface(second, bounce, blocked)
    reflected = albedo2 * (_sunlight(scene, second, frame2, sun, blocked) + mi.Color3f(GLOW))
    light += dr.select(blocked, reflected, sky.eval(second, seen & ~blocked))
    return dr.select(seen, albedo * light, sky.eval(hit, ~seen))


def _surface(hit: mi.SurfaceInteraction3f, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.Color3f, mi.Frame3f]:
    """Reflectance, and the normal on the side that the ray comes from."""
    albedo = hit.bsdf().eval_diffuse_reflectance(hit, active)
    return albedo, mi.Frame3f(dr.select(dr.dot(hit.n, ray.d) < 0, hit.n, -hit.n))


def _sunlight(
    scene: mi.Scene, hit: mi.SurfaceInteraction3f, frame: mi.Frame3f, sun: mi.Vector3f, active: mi.Bool
) -> mi.Color3f:
    facing = dr.dot(frame.n, sun)
    active = active & (facing > 0)
    lit = active & ~scene.ray_test(hit.spawn_ray(sun), active)
    return dr.select(lit, facing, 0.0) * mi.Color3f(SUNLIGHT)


def render(scene: mi.Scene, rotation: Array, translation: Array, spp: int, seed: int) -> Array:
    """(H, W, 3) linear radiance; samples spread by a Gaussian of 0.42 px about the centre of their pixel.

    Quasi-random: each pixel shifts the same plane-filling sequence (Roberts' R2) by its own random offset, once each
    for the place in the pixel, on the sun and in the hemisphere, in three different orders.
    """
    rng = np.random.default_rng([seed, 99])
    centre = -rotation.T @ translation
    num_pixels = HEIGHT * WIDTH
    # the centre of the top-left pixel is (0.5, 0.5) and the principal point the middle of the image
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].reshape(2, -1) + 0.5
    shifts = rng.random((6, num_pixels), dtype=np.float32)
    orders = [rng.permutation(spp) for _ in range(3)]
    r2 = np.array([0.7548776662466927, 0.5698402909980532])
    total = np.zeros((num_pixels, 3))
    for k in range(spp):
        xi = [(shifts[d] + np.float32(orders[d // 2][k] * r2[d % 2] % 1)) % 1 for d in range(6)]
        spread = 0.42 * np.sqrt(-2 * np.log(np.maximum(1 - xi[0], 1e-4)))  # Box and Muller
        du, dv = spread * np.cos(2 * np.pi * xi[1]), spread * np.sin(2 * np.pi * xi[1])
        x, y = undistort((u + du - WIDTH / 2) / FOCAL_PX, (v + dv - HEIGHT / 2) / FOCAL_PX)
        direction = np.stack([x, y, np.ones_like(x)]).T @ rotation
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        ray = mi.Ray3f(mi.Point3f(centre.tolist()), mi.Vector3f(*[mi.Float(c) for c in direction.T]))
        dr.make_opaque(ray.o)  # else the position becomes a constant of a kernel that is compiled every time
        total += np.array(radiance(scene, ray, [mi.Float(c) for c in xi[2:]])).T
    return (total / spp).reshape(HEIGHT, WIDTH, 3)


def develop(radiance: Array, exposure: float) -> Array:
    """(H, W, 3) uint8 sRGB with a soft shoulder."""
    x = radiance * exposure
    x = np.where(x < 0.6, x, 0.6 + 0.4 * (1 - np.exp(-(x - 0.6) / 0.4)))
    srgb = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(np.clip(srgb, 0, 1) * 255).astype(np.uint8)


def describe(views: list[tuple[Array, Array]]) -> dict[str, Any]:
    """What cameras.json holds."""
    matrix = [[FOCAL_PX, 0.0, WIDTH / 2 - 0.5], [0.0, FOCAL_PX, HEIGHT / 2 - 0.5], [0.0, 0.0, 1.0]]
    return {
        "convention": "x_cam = R_w2c @ X_world + t_w2c; x right, y down, z forward; u = fx*x'+cx with (x', y') = "
        "(x/z, y/z) * (1 + k1*r^2), r^2 = (x/z)^2 + (y/z)^2; OpenCV pixel centres at integers (for COLMAP's add 0.5 "
        "to cx, cy)",
        "note": "rendered by data/make_sample.py: exact; metres, world z up, corner of the walls at the origin",
        "cameras": [
            {
                "file": f"images/{name_of(k)}", "model": "simple_radial", "K": matrix, "dist": [K1, 0.0, 0.0, 0.0],
                "R_w2c": rotation.tolist(), "t_w2c": translation.tolist(), "width": WIDTH, "height": HEIGHT,
            }
            for k, (rotation, translation) in enumerate(views)
        ],
    }  # fmt: skip


def name_of(view: int) -> str:
    return f"courtyard_{view + 1:02d}.jpg"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).parent / "courtyard")
    parser.add_argument("--spp", type=int, default=32, help="samples per pixel")
    parser.add_argument("--views", type=int, nargs="*", help="render only these")
    parser.add_argument("--quality", type=int, default=90, help="of the JPEGs")
    args = parser.parse_args()
    views = make_cameras()
    (args.output / "images").mkdir(parents=True, exist_ok=True)
    (args.output / "cameras.json").write_text(json.dumps(describe(views), indent=1) + "\n")
    start = time.process_time()
    scene = build_scene()
    print(f"scene built, {time.process_time() - start:.0f} CPU s", flush=True)
    for k in args.views or range(NUM_VIEWS):
        image = develop(render(scene, *views[k], args.spp, k), EXPOSURE)
        data = io.BytesIO()
        Image.fromarray(image).save(data, "JPEG", quality=args.quality)
        (args.output / "images" / name_of(k)).write_bytes(data.getvalue())
        print(f"{name_of(k)}: {len(data.getvalue()) >> 10} KB, {time.process_time() - start:.0f} CPU s", flush=True)
    dr.flush_malloc_cache()


if __name__ == "__main__":
    main()
