# /// script
# requires-python = ">=3.11"
# dependencies = ["mitsuba>=3.6", "numpy>=2", "pillow>=11"]
# ///
"""Render scenes with exact poses and exact depth, to score dense clouds against.

    python data/make_dense_scene.py courtyard OUT
    python data/make_dense_scene.py railing OUT

courtyard is the world of the bundled sample; railing has bars of 6 to 16 pixels before a textured wall. The camera is
a PINHOLE of 1600x1200; the photographs are noisy (3 grey levels) JPEGs. OUT receives::

    images/*.jpg       depth/*.npy (H, W) float32, z in metres at the pixels' centres, 0 for the sky
    model/             COLMAP text model, the true cameras and no points
    model_points/      the same with 3000 points of the true surface, each seen by three views and more
    ground_truth.ply          surface that two views and more see, one point per voxel of a ground pixel; of the railing
    with
                       its label (red: 1 railing, 0 rest) and the bar's width in pixels (green)
    scene.json         gsd: metres per pixel at the median depth of the median view; bbox: [low, high]

See make_sample.py for what mitsuba needs. Six to ten CPU minutes each.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import make_sample as sample
import mitsuba as mi
import numpy as np
from PIL import Image

Array = np.ndarray
Pose = tuple[Array, Array]
Place = Callable[[Array, Array, Array], tuple[Array, Array, Array]]

WIDTH, HEIGHT, FOCAL_PX = 1600, 1200, 1408.0
NOISE_GREY = 3.0
SKYLIGHT, GROUNDLIGHT = [0.42, 0.47, 0.55], [0.24, 0.22, 0.19]  # on surfaces that face up and down
MIN_VIEWS_SURFACE, MIN_VIEWS_POINT = 2, 3
NUM_POINTS = 3000
RAILING_DISTANCE_M = 3.4  # of the cameras from the bars, about
BAR_WIDTHS_PX = (6, 8, 10, 12, 16)  # of level 0: 3 to 8 at level 1


@dataclass(frozen=True)
class World:
    """What is photographed: bars is the same railing on its own, for its labels, one scene per width in pixels."""

    scene: mi.Scene
    views: list[Pose]
    low: Array
    high: Array
    bars: dict[int, mi.Scene]


# ---------------------------------------------------------------- worlds
def courtyard() -> World:
    size = sample.WALL_LENGTH
    views = sample.make_cameras(num_views=20)
    return World(sample.build_scene(), views, np.array([-0.3, -0.3, -0.2]), np.array([size, size, 3.6]), {})


def railing(seed: int = 21) -> World:
    """Two rows of bars before a plastered wall, on a floor, seen from a strip of camera places in front of them."""
    world = sample.Scene()
    rng = np.random.default_rng([seed, 1])
    _sheet(world, rng, (6.4, 2.8), lambda a, b, h: (a - 3.2, h, b))
    _sheet(world, rng, (6.4, 4.0), lambda a, b, h: (a - 3.2, b - 0.1, h))
    bars = {}
    for k, width in enumerate(BAR_WIDTHS_PX):
        only = sample.Scene()
        for scene in (world, only):
            _bars(scene, k, width * RAILING_DISTANCE_M / FOCAL_PX, seed)
        bars[width] = mi.load_dict({"type": "scene", **only.shapes})
    sky = sample.sky(np.random.default_rng([seed, 2]))
    scene = mi.load_dict({"type": "scene", "sky": sky, **world.shapes})
    views = []
    jitter = np.random.default_rng([seed, 3])
    for k in range(20):
        x, height = -2.3 + 4.6 * (k % 10) / 9, (1.05, 1.75)[k // 10]
        centre = np.array([x, 1.0 + RAILING_DISTANCE_M, height]) + jitter.normal(0, 0.06, 3)
        views.append(sample.look_at(centre, np.array([0.55 * x, 0.3, 0.85]), jitter.normal(0, 0.02)))
    return World(scene, views, np.array([-3.1, -0.1, -0.1]), np.array([3.1, 3.0, 2.7]), bars)


def _sheet(scene: sample.Scene, rng: np.random.Generator, size_m: tuple[float, float], place: Place) -> None:
    """A plane with shallow relief; place(a, b, height) gives x, y, z."""
    step = 0.003
    shape = (int(size_m[1] / step), int(size_m[0] / step))
    b, a = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float32) * np.float32(step)
    height = 0.01 * sample.spectral_noise(shape, rng, 2.6)
    tone = np.exp(0.25 * sample.spectral_noise(shape, rng, 1.8))[..., None]
    rgb = sample.weather(rng.uniform(0.3, 0.45, 3).astype(np.float32) * tone, rng)
    scene.add_grid(np.stack(place(a, b, height), -1), rgb, 4)


def _bars(scene: sample.Scene, k: int, width: float, seed: int) -> None:
    """One field of the railing: six uprights, round or square in turn, a hand rail, and a slanting brace behind."""
    left = -2.2 + 0.9 * k
    for i in range(6):
        x = left + 0.14 * i
        _bar(scene, np.array([x, 1.0, 0.0]), np.array([x, 1.0, 1.05]), width, (4, 48)[i % 2], seed + 100 * k + i)
    ends = np.array([left - 0.08, 1.0, 1.07]), np.array([left + 0.78, 1.0, 1.07])
    _bar(scene, *ends, width, 4, seed + 100 * k + 50)
    ends = np.array([left, 0.5, 0.0]), np.array([left + 0.7, 0.5, 1.3])
    _bar(scene, *ends, width, 48, seed + 100 * k + 51)


def _bar(scene: sample.Scene, start: Array, end: Array, width: float, sides: int, seed: int) -> None:
    """A prism of so many sides (4: a box, 48: as good as a cylinder) around the line from start to end."""
    along = (end - start) / np.linalg.norm(end - start)
    u = np.cross(along, [0.0, 1.0, 0.0])
    u /= np.linalg.norm(u)
    turn = np.linspace(0, 2 * np.pi, sides + 1) + np.pi / 4
    radius = width / 2 / np.cos(np.pi / sides)
    corners = radius * (np.cos(turn)[:, None] * u + np.sin(turn)[:, None] * np.cross(along, u))
    per_side = max(1, 96 // sides)  # texels: a mesh takes its corners alone
    fine = np.concatenate([np.linspace(a, b, per_side, endpoint=False) for a, b in itertools.pairwise(corners)])
    fine = np.concatenate([fine, corners[-1:]])
    rows = np.arange(0, np.linalg.norm(end - start), 0.002)
    xyz = (start + rows[:, None, None] * along + fine[None]).astype(np.float32)
    tone = sample.lattice_noise(xyz, seed, 0.03, 5, 0.8)
    tint = np.random.default_rng(seed).uniform(0.2, 0.6, 3).astype(np.float32)
    scene.add_grid(xyz, tint * np.exp(0.8 * tone)[..., None], per_side)


# ---------------------------------------------------------------- photographs
def rays(pose: Pose, x: mi.Float, y: mi.Float) -> mi.Ray3f:
    """Rays through pixels; along them a distance of 1 is a depth z of 1."""
    rotation, translation = pose
    x, y = (x - WIDTH / 2) / FOCAL_PX, (y - HEIGHT / 2) / FOCAL_PX
    axes = [mi.Vector3f(*[mi.Float(float(c)) for c in row]) for row in rotation]
    origin = mi.Point3f(*[mi.Float(float(c)) for c in -rotation.T @ translation])
    ray = mi.Ray3f(origin, dr.normalize(x * axes[0] + y * axes[1] + axes[2]))
    dr.make_opaque(ray.o)  # else the pose becomes a constant of a kernel that is compiled every time
    return ray


def pixels() -> tuple[mi.Float, mi.Float]:
    """Places of all pixels, row after row, without the half."""
    index = dr.arange(mi.UInt32, WIDTH * HEIGHT)
    return mi.Float(index % WIDTH), mi.Float(index // WIDTH)


def radiance(scene: mi.Scene, ray: mi.Ray3f, xi: list[mi.Float]) -> mi.Color3f:
    """Light along rays: the sun, with soft shadows, and an even sky over even ground.

    Without the hemisphere that make_sample draws from there is no noise but the sensor's, at a few samples per pixel.
    """
    hit = scene.ray_intersect(ray)
    seen = hit.is_valid()
    albedo, frame = sample._surface(hit, ray, seen)
    sun_frame = mi.Frame3f(dr.normalize(mi.Vector3f(sample.SUN.tolist())))
    disc = mi.warp.square_to_uniform_disk(mi.Point2f(xi[0], xi[1])) * sample.SUN_RADIUS
    light = sample._sunlight(scene, hit, frame, dr.normalize(sun_frame.to_world(mi.Vector3f(disc.x, disc.y, 1))), seen)
    up = 0.5 + 0.5 * frame.n.z
    light += up * mi.Color3f(SKYLIGHT) + (1 - up) * mi.Color3f(GROUNDLIGHT)
    return dr.select(seen, albedo * light, scene.environment().eval(hit, ~seen))


def photograph(scene: mi.Scene, pose: Pose, spp: int, seed: int) -> Array:
    """(H, W, 3) uint8; sampled as make_sample.render does, then the sensor's noise."""
    rng = np.random.default_rng([seed, 99])
    column, row = pixels()
    shifts = [mi.Float(rng.random(WIDTH * HEIGHT, dtype=np.float32)) for _ in range(4)]
    orders = [rng.permutation(spp) for _ in range(2)]
    r2 = np.array([0.7548776662466927, 0.5698402909980532])
    total = mi.Color3f(0)
    for k in range(spp):
        xi = []
        for d in range(4):
            offset = mi.Float(float(orders[d // 2][k] * r2[d % 2] % 1))
            dr.make_opaque(offset)
            xi.append(dr.minimum((shifts[d] + offset) - dr.floor(shifts[d] + offset), 0.9999))
        spread = 0.42 * dr.sqrt(-2 * dr.log(1 - xi[0]))  # Box and Muller
        sin, cos = dr.sincos(2 * np.pi * xi[1])
        ray = rays(pose, column + 0.5 + spread * cos, row + 0.5 + spread * sin)
        total += radiance(scene, ray, xi[2:])
        dr.eval(total)
    linear = np.array(total).T.reshape(HEIGHT, WIDTH, 3) / spp
    grey = sample.develop(linear, sample.EXPOSURE) + rng.normal(0, NOISE_GREY, linear.shape)
    return np.round(np.clip(grey, 0, 255)).astype(np.uint8)


def distances(scene: mi.Scene, pose: Pose) -> Array:
    """(H, W) float32 depth z of the first surface at the pixels' centres, 0 where there is none."""
    column, row = pixels()
    ray = rays(pose, column + 0.5, row + 0.5)
    hit = scene.ray_intersect_preliminary(ray)
    forward = pose[0][2]
    z = hit.t * dr.dot(ray.d, mi.Vector3f(*[float(c) for c in forward]))
    return np.array(dr.select(hit.is_valid(), z, 0.0)).reshape(HEIGHT, WIDTH)


# ---------------------------------------------------------------- the ground truth
def lift(pose: Pose, depth: Array) -> Array:
    """(H, W, 3) world points of a depth map."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64) + 0.5
    rays_cam = np.stack([(u - WIDTH / 2) / FOCAL_PX, (v - HEIGHT / 2) / FOCAL_PX, np.ones_like(u)], -1)
    return (rays_cam * depth[..., None] - pose[1]) @ pose[0]


def project(pose: Pose, xyz: Array) -> tuple[Array, Array]:
    """(N, 2) pixels and (N,) depths of world points."""
    cam = xyz @ pose[0].T + pose[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return cam[:, :2] / cam[:, 2:] * FOCAL_PX + [WIDTH / 2, HEIGHT / 2], cam[:, 2]


def sees(pose: Pose, depth: Array, xyz: Array) -> Array:
    """(N,) bool: the point is in the image and not behind the depths of the four pixels around it."""
    uv, z = project(pose, xyz)
    inside = (z > 0) & (uv > 1).all(axis=1) & (uv < [WIDTH - 1, HEIGHT - 1]).all(axis=1)
    seen = np.zeros(len(xyz), bool)
    u, v = np.floor(uv[inside] - 0.5).astype(np.int64).T
    around = np.stack([depth[v + dv, u + du] for dv in (0, 1) for du in (0, 1)])
    seen[inside] = (around.min(axis=0) > 0) & (np.abs(around - z[inside]).min(axis=0) < 0.004 * z[inside])
    return seen


def surface(world: World, depths: list[Array], labels: list[Array], voxel: float) -> tuple[Array, Array, Array]:
    """Points (N, 3) that two views see, one per voxel (the first met); labels (N,); (N, V) bool who sees each."""
    xyz, label, keys = np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(0, np.int64)
    for pose, depth, marks in zip(world.views, depths, labels, strict=True):
        new, mark = lift(pose, depth)[depth > 0], marks[depth > 0]
        inside = ((new > world.low) & (new < world.high)).all(axis=1)
        new, mark = new[inside], mark[inside]
        cell = np.floor((new - world.low) / voxel).astype(np.int64)
        key, first = np.unique((cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2], return_index=True)
        fresh = first[~np.isin(key, keys, assume_unique=True)]
        keys = np.concatenate([keys, np.setdiff1d(key, keys, assume_unique=True)])
        xyz, label = np.concatenate([xyz, new[fresh]]), np.concatenate([label, mark[fresh]])
    seen = np.stack([sees(pose, depth, xyz) for pose, depth in zip(world.views, depths, strict=True)], 1)
    kept = seen.sum(axis=1) >= MIN_VIEWS_SURFACE
    return xyz[kept], label[kept], seen[kept]


# ---------------------------------------------------------------- files
def write_ground_truth(path: Path, xyz: Array, label: Array | None) -> None:
    fields = [(axis, "<f4") for axis in "xyz"] + ([("red", "u1"), ("green", "u1")] if label is not None else [])
    rows = np.empty(len(xyz), fields)
    for i, axis in enumerate("xyz"):
        rows[axis] = xyz[:, i]
    if label is not None:
        rows["red"], rows["green"] = label > 0, label
    kinds = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    header += [f"property {kinds[kind]} {name}" for name, kind in fields]
    path.write_bytes("\n".join([*header, "end_header", ""]).encode() + rows.tobytes())


def write_model(folder: Path, views: list[Pose], xyz: Array, seen: Array) -> None:
    """COLMAP's text model; keypoints are the exact projections of the points."""
    folder.mkdir(parents=True, exist_ok=True)
    camera = f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL_PX} {FOCAL_PX} {WIDTH / 2} {HEIGHT / 2}\n"
    (folder / "cameras.txt").write_text(camera)
    images, tracks = [], [[] for _ in xyz]
    for k, pose in enumerate(views):
        numbers = " ".join(repr(float(c)) for c in [*quaternion_wxyz(pose[0]), *pose[1]])
        images.append(f"{k + 1} {numbers} 1 {name_of(k)}")
        mine = np.flatnonzero(seen[:, k]) if len(xyz) else np.zeros(0, np.int64)
        uv = project(pose, xyz[mine])[0]
        images.append(" ".join(f"{u!r} {v!r} {p + 1}" for (u, v), p in zip(uv.tolist(), mine, strict=True)))
        for place, p in enumerate(mine):
            tracks[p].append(f"{k + 1} {place}")
    (folder / "images.txt").write_text("\n".join([*images, ""]))
    points = [f"{p + 1} {x!r} {y!r} {z!r} 128 128 128 0.0 " + " ".join(tracks[p])
              for p, (x, y, z) in enumerate(xyz.tolist())]  # fmt: skip
    (folder / "points3D.txt").write_text("\n".join([*points, ""]))


def quaternion_wxyz(rotation: Array) -> Array:
    """Of the four forms, the eigenvector that fits best (Bar-Itzhack 2000)."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2], r[0, 2] - r[2, 0]],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1]
    return np.array([w, x, y, z]) * (1 if w >= 0 else -1)


def name_of(view: int) -> str:
    return f"view_{view + 1:02d}.jpg"


def write_geometry(world: World, output: Path) -> None:
    """Depth maps, models, ground truth and scene.json."""
    (output / "depth").mkdir(exist_ok=True)
    depths, labels = [], []
    for k, pose in enumerate(world.views):
        depths.append(distances(world.scene, pose))
        np.save(output / "depth" / f"{Path(name_of(k)).stem}.npy", depths[-1])
        labels.append(np.zeros(depths[-1].shape, np.uint8))
        for width, bars in world.bars.items():
            labels[-1][(depths[-1] > 0) & (np.abs(distances(bars, pose) - depths[-1]) < 1e-4)] = width
    gsd = float(np.median([np.median(depth[depth > 0]) for depth in depths]) / FOCAL_PX)
    xyz, label, seen = surface(world, depths, labels, gsd)
    write_ground_truth(output / "ground_truth.ply", xyz, label if world.bars else None)
    chosen = np.flatnonzero(seen.sum(axis=1) >= MIN_VIEWS_POINT)
    chosen = np.random.default_rng(5).choice(chosen, NUM_POINTS, replace=False)
    write_model(output / "model", world.views, np.zeros((0, 3)), seen[:0])
    write_model(output / "model_points", world.views, xyz[chosen], seen[chosen])
    facts = {"gsd": gsd, "bbox": [world.low.tolist(), world.high.tolist()], "num_ground_truth": len(xyz)}
    (output / "scene.json").write_text(json.dumps(facts, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("world", choices=["courtyard", "railing"])
    parser.add_argument("output", type=Path)
    parser.add_argument("--spp", type=int, default=4, help="samples per pixel")
    parser.add_argument("--quality", type=int, default=92, help="of the JPEGs")
    parser.add_argument(
        "--photographs-only", action="store_true", help="depth, models and ground truth are there already"
    )
    args = parser.parse_args()
    start = time.process_time()
    world = {"courtyard": courtyard, "railing": railing}[args.world]()
    print(f"scene built, {time.process_time() - start:.0f} CPU s", flush=True)
    (args.output / "images").mkdir(parents=True, exist_ok=True)
    for k, pose in enumerate(world.views):
        Image.fromarray(photograph(world.scene, pose, args.spp, k)).save(
            args.output / "images" / name_of(k), quality=args.quality, subsampling=0
        )
        print(f"{name_of(k)}: {time.process_time() - start:.0f} CPU s", flush=True)
    if not args.photographs_only:
        write_geometry(world, args.output)
        print(f"all written, {time.process_time() - start:.0f} CPU s", flush=True)
    dr.flush_malloc_cache()


if __name__ == "__main__":
    main()
