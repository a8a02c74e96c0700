"""A drone's block and a walk round a monument with tagged photographs, through the whole command line.

    python benchmarks/tagged_sets.py [--seeds 2]        writes results/tagged_sets.json and results/tagged_sets.md

Rendered photographs with the tags that such cameras write: EXIF and XMP with the deviations of RTK for the drone, EXIF
of a phone for the walk, some of them wrong. ``sfmapp reconstruct`` and pycolmap's mapper with position priors, which
gets the same photographs, positions and deviations, are held against the truth.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from machine import RESULTS, describe_machine
from rendered_worlds import textures
from rendered_worlds.rendering import Optics, Renderer, World
from rendered_worlds.worlds import Skin, WorldBuilder
from sfmapp.camera.camera import Camera, CameraModel, simple_camera
from sfmapp.formats.colmap import read_model
from sfmapp.geometry import rigid3
from sfmapp.geometry.geodesy import LocalFrame
from sfmapp.georeference.fit import closed_form
from sfmapp.georeference.world_frame import read_georeference

Array = NDArray[np.float64]

FRAME = LocalFrame(47.4, 8.5, 430.0)
WIDTH, HEIGHT, FOCAL = 1000, 750, 850.0
_GPS, _PHOTO = 0x8825, 0x8769
KINDS = ("drone block", "monument")
# along east and north, and of heights, metres
SIGMAS = {"drone block": (0.02, 0.03), "monument": (3.0, 6.0)}


@dataclass(frozen=True)
class TaggedSet:
    """Photographs as they were taken, and what was written into them.

    Attributes:
        cam_from_world: (n, 7) in :data:`FRAME`; measured: (n, 3) there.
        wrong: numbers of the photographs whose tags are grossly wrong.
    """

    kind: str
    world: World
    cam_from_world: Array
    measured: Array
    wrong: list[int]

    @property
    def centers(self) -> Array:
        """(n, 3)."""
        return rigid3.center(self.cam_from_world)


def make_set(kind: str, seed: int) -> TaggedSet:
    """A set with the errors of its receiver."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    if kind == "drone block":
        world, poses = _village(rng), _flight(rng)
    else:
        world, poses = _square(rng), _walk(rng)
    centers = rigid3.center(poses)
    flat, up = SIGMAS[kind]
    measured = centers + rng.normal(size=centers.shape) * [flat, flat, up]
    chosen = rng.permutation(len(centers))[:4].tolist()
    if kind == "drone block":  # one fix lost, one far away
        measured[chosen[0]] += [4.0, -3.0, 6.0]
        measured[chosen[1]] += [250.0, 120.0, 0.0]
        return TaggedSet(kind, world, poses, measured, sorted(chosen[:2]))
    measured[chosen[:2]] = measured[chosen[1::-1]] + [0.0, 0.0, 90.0]
    measured[chosen[2]] += [-600.0, 900.0, 0.0]
    return TaggedSet(kind, world, poses, measured, sorted(chosen[:3]))


def _village(rng: np.random.Generator) -> World:
    """Houses and trees on a meadow of 200 x 180 m."""
    build = WorldBuilder(rng)
    spots = build.texture(textures.leaves(rng, 1024, 12))
    meadow = Skin(build.texture(textures.grass(rng, 1024)), 37.0, spots, 61.0)
    street = Skin(build.texture(textures.asphalt(rng)), 23.0, spots, 41.0)
    stains = build.texture(textures.dirt(rng))
    roofs = [Skin(build.texture(textures.tiles(rng, 512, 16)), 7.0, stains, 9.1, 0.7 + 0.15 * k) for k in range(4)]
    walls = [Skin(build.texture(textures.facade(rng, 512)), 11.0, stains, 9.1) for _ in range(3)]
    crown = Skin(build.texture(textures.leaves(rng)), 2.0, stains, 3.1)
    build.quad((-100, 90, 0), (200, 0, 0), (0, -180, 0), meadow)
    for y in (-30.0, 25.0):
        build.quad((-100, y + 3, 0.05), (200, 0, 0), (0, -6, 0), street)
    for x in np.arange(-84.0, 85.0, 18.0):
        for y in (-62.0, -44.0, -14.0, 8.0, 44.0, 62.0):
            at = [x + rng.uniform(-4, 4), y + rng.uniform(-3, 3), 0.0]
            if rng.random() < 0.65:
                size = [float(v) for v in (*rng.uniform(7, 12, 2), rng.uniform(3, 9))]
                wall, roof = walls[int(rng.integers(3))], roofs[int(rng.integers(4))]
                build.box(at, size, (wall, wall, roof), float(rng.uniform(-20, 20)))
            else:
                for _ in range(3):
                    place = [at[0] + rng.uniform(-5, 5), at[1] + rng.uniform(-5, 5), 0.0]
                    build.box(place, [float(v) for v in rng.uniform(2, 5, 3)], crown, float(rng.uniform(0, 90)))
    return build.build()


def _flight(rng: np.random.Generator) -> Array:
    """5 x 6 photographs straight down from 60 m, tilted by a degree or two."""
    grid = np.stack([np.arange(30) % 5, np.arange(30) // 5], 1) * np.array([20.0, 15.0])
    centers = np.column_stack([grid - grid.mean(0), np.full(30, 60.0)]) + rng.normal(0.0, 0.7, (30, 3))
    rotation = rigid3.exp_so3(rng.normal(0.0, 0.03, (30, 3))) @ np.diag([1.0, -1.0, -1.0])
    return rigid3.from_matrix(rotation, -np.einsum("nij,nj->ni", rotation, centers))


def _square(rng: np.random.Generator) -> World:
    """A monument on steps in a square with houses round it."""
    build = WorldBuilder(rng)
    stains = build.texture(textures.dirt(rng))
    stone = Skin(build.texture(textures.concrete(rng)), 2.3, stains, 3.7)
    marble = Skin(build.texture(textures.plaster(rng)), 1.9, stains, 2.9, 1.2)
    reliefs = [Skin(build.texture(kind(rng)), None, stains, 1.3) for kind in (
        textures.picture, textures.poster, textures.machine, textures.picture, textures.poster, textures.machine
    )]  # fmt: skip
    for k, half in enumerate((4.5, 4.0, 3.5)):
        build.box((0, 0, 0.25 * k), (2 * half, 2 * half, 0.25), stone)
    build.box((0, 0, 0.75), (4.0, 3.2, 2.6), (reliefs[0], reliefs[1], stone))
    build.box((0, 0, 3.35), (2.6, 2.2, 2.4), (reliefs[2], reliefs[3], marble), 20.0)
    build.cylinder((0, 0, 5.75), 0.9, 2.2, reliefs[4])
    for k, (x, y) in enumerate(((2.9, 2.9), (-2.9, 2.9), (-2.9, -2.9), (2.9, -2.9))):
        build.cylinder((x, y, 0.75), 0.45, 3.2, reliefs[(k + 4) % 6], 12)
        build.box((x, y, 3.95), (1.1, 1.1, 0.9), (reliefs[k], reliefs[k + 1], marble), float(rng.uniform(0, 90)))
    ground = Skin(build.texture(textures.tiles(rng, 1024, 16)), 9.0, build.texture(textures.leaves(rng)), 13.0)
    build.quad((-45, 45, 0), (90, 0, 0), (0, -90, 0), ground)
    for k in range(20):
        angle = 2 * np.pi * (k + rng.uniform(-0.2, 0.2)) / 20
        foot = rng.uniform(36, 42) * np.array([np.cos(angle), np.sin(angle), 0.0])
        facade = Skin(build.texture(textures.facade(rng, 512)), None, stains, 5.7, rng.uniform(0.75, 1.2))
        size = (9.0, 12.5, float(rng.uniform(8, 15)))
        build.box(foot, size, (facade, facade, stone), float(np.degrees(angle)))
    return build.build()


def _walk(rng: np.random.Generator) -> Array:
    """32 photographs from hand, round and round at 12 to 17 m."""
    angle = 2 * np.pi * np.arange(32) / 32 + rng.normal(0.0, 0.04, 32)
    far = 14.5 + 2.0 * np.sin(3 * angle) + rng.normal(0.0, 0.4, 32)
    centers = np.column_stack([far * np.cos(angle), far * np.sin(angle), 1.6 + rng.normal(0.0, 0.1, 32)])
    ahead = np.array([0.0, 0.0, 3.2]) + rng.normal(0.0, 0.5, (32, 3)) - centers
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    rotation = rigid3.exp_so3(rng.normal(0.0, 0.02, (32, 3))) @ np.stack([right, np.cross(ahead, right), ahead], 1)
    return rigid3.from_matrix(rotation, -np.einsum("nij,nj->ni", rotation, centers))


# ------------------------------------------------------------------------------------------------------ photographs


def write_photographs(tagged: TaggedSet, folder: Path, seed: int) -> None:
    """The JPEGs with their tags."""
    params = simple_camera(CameraModel.SIMPLE_RADIAL, WIDTH, HEIGHT, FOCAL).params.copy()
    params[3] = -0.05 if tagged.kind == "drone block" else 0.03
    renderer = Renderer(tagged.world, Camera(CameraModel.SIMPLE_RADIAL, WIDTH, HEIGHT, params))
    folder.mkdir(parents=True)
    places = FRAME.geodetic_from_enu(tagged.measured)
    for n, (pose, place) in enumerate(zip(tagged.cam_from_world, places.tolist(), strict=True)):
        grey = renderer.photograph(pose, Optics(), [seed, n], gain=1.0 + 0.05 * np.sin(n))
        given: dict[str, Any] = {"exif": _exif(tagged.kind, n, place), "quality": 95}
        if tagged.kind == "drone block":
            given["xmp"] = _xmp(place)
        Image.fromarray(grey).convert("RGB").save(folder / f"IMG_{n:04d}.jpg", **given)


def _exif(kind: str, number: int, place: list[float]) -> Image.Exif:
    """As a phone, or a drone, writes it: to a hundredth of a second of arc or finer, heights to a millimetre."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = ("DJI", "FC6310R") if kind == "drone block" else ("Maker", "Phone 12")
    # 36 mm across: of the diagonal, as cameras round it
    focal_35mm = round(FOCAL * 43.27 / float(np.hypot(WIDTH, HEIGHT)))
    exif.get_ifd(_PHOTO).update({0xA405: focal_35mm, 0x9003: f"2026:05:02 10:{number // 4:02d}:{number % 4 * 15:02d}"})
    latitude, longitude, height = place
    exif.get_ifd(_GPS).update({
        1: "N" if latitude >= 0 else "S", 2: _degrees(abs(latitude)), 3: "E" if longitude >= 0 else "W",
        4: _degrees(abs(longitude)), 5: b"\0" if height >= 0 else b"\1", 6: round(abs(height), 3),
    })  # fmt: skip
    return exif


def _degrees(value: float) -> tuple[float, float, float]:
    minutes = (value - int(value)) * 60
    return float(int(value)), float(int(minutes)), round((minutes - int(minutes)) * 60, 5)


def _xmp(place: list[float]) -> bytes:
    latitude, longitude, height = place
    flat, up = SIGMAS["drone block"]
    fields = {
        "GpsLatitude": f"{latitude:+.9f}", "GpsLongitude": f"{longitude:+.9f}", "AbsoluteAltitude": f"{height:+.3f}",
        "RtkFlag": "50", "RtkStdLon": f"{flat:.5f}", "RtkStdLat": f"{flat:.5f}", "RtkStdHgt": f"{up:.5f}",
        "GimbalPitchDegree": "-90.0", "GimbalRollDegree": "+0.0", "GimbalYawDegree": "+0.0",
    }  # fmt: skip
    text = " ".join(f'drone-dji:{name}="{value}"' for name, value in fields.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {text}/></rdf:RDF></x:xmpmeta>'
    ).encode()


# ------------------------------------------------------------------------------------------------------------- runs


def run_pycolmap(images: Path, output: Path, kind: str) -> None:
    """pycolmap's mapper with position priors; its largest model is left in ``output/model``.

    It reads the positions from EXIF by itself; the deviations are given to it, as its default is 1 m.
    """
    import pycolmap

    database = output / "database.db"
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    extraction.use_gpu = matching.use_gpu = False
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    pycolmap.extract_features(database, images, [], pycolmap.CameraMode.SINGLE, reader, extraction, pycolmap.Device.cpu)
    pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
    flat, up = SIGMAS[kind]
    if kind == "monument":
        flat, up = 5.0, 10.0  # a guess, as ours
    with pycolmap.Database.open(database) as opened:
        for prior in opened.read_all_pose_priors():
            prior.position_covariance = np.diag([flat**2, flat**2, up**2])
            opened.update_pose_prior(prior)
    options = pycolmap.IncrementalPipelineOptions()
    options.use_prior_position = options.use_robust_loss_on_prior_position = True
    found = pycolmap.incremental_mapping(database, images, output, options)
    best = max(found.values(), key=lambda one: one.num_reg_images())
    (output / "model").mkdir()
    best.write(output / "model")


def measure(command: list[str]) -> float:
    """CPU seconds of a command."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def errors_of(model_folder: Path, truth: Array) -> dict[str, Any]:
    """Shape and scale of a model in metres: error of the scale, and of places after a motion of the whole."""
    model = read_model(model_folder)[0]
    order = [int(Path(name).stem[-4:]) for name in model.image_names]
    centers = np.full(truth.shape, np.nan)
    centers[order] = model.centers
    kept = np.isfinite(centers[:, 0])
    rotation, scale, _ = (part[0] for part in closed_form(centers[None, kept], truth[None, kept]))
    moved = (centers[kept] - centers[kept].mean(0)) @ rotation.T + truth[kept].mean(0)
    return {
        "num_registered": int(kept.sum()),
        "scale_error_share": float(np.log(scale)),
        "rms_m": float(np.sqrt(((moved - truth[kept]) ** 2).sum(1).mean())),
    }


def sigmas(ellipse: dict[str, float] | None) -> list[float]:
    """East, north and up; of the two axes of the ellipse the mean."""
    if ellipse is None:
        return [np.nan] * 3
    flat = float(np.hypot(ellipse["major_m"], ellipse["minor_m"]) / np.sqrt(2.0))
    return [flat, flat, ellipse["up_m"]]


def of_ours(output: Path, tagged: TaggedSet) -> dict[str, Any]:
    """What the report says, and how far it is off in the world."""
    report = json.loads((output / "report.json").read_text())
    stage = report["stages"]["georeference"]
    world = read_georeference(output)
    assert world is not None
    frame = world.frame
    rows = [row for row in stage["images"] if row.get("adjusted_m") is not None]
    number = np.array([int(Path(row["name"]).stem[-4:]) for row in rows])
    truth = frame.enu_from_geodetic(FRAME.geodetic_from_enu(tagged.centers))[number]
    off = np.array([row["adjusted_m"] for row in rows]) - truth
    named = sorted(int(n) for n, row in zip(number, rows, strict=True) if not row["is_used"])
    sigma = np.array([sigmas(row["ellipse"]) for row in rows])
    place = stage["models"][0]
    return {
        "wrong": tagged.wrong,
        "named": named,
        "scale_sigma_share": place["scale_sigma_share"],
        "horizontal_rms_m": float(np.sqrt((off[:, :2] ** 2).sum(1).mean())),
        "vertical_rms_m": float(np.sqrt((off[:, 2] ** 2).mean())),
        "within_95": float((np.abs(off / sigma) <= 1.96).mean()),
        "residual_rms_m": place["rms_residual_m"],
        "contradictions": [found["message"] for found in place["contradictions"]],
        "red": [check["name"] for check in report["checks"] if check["light"] == "red"],
    }


def run_set(kind: str, seed: int) -> list[dict[str, Any]]:
    """A row of each program."""
    tagged = make_set(kind, seed)
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        images, theirs, ours = (Path(scratch) / name for name in ("images", "theirs", "ours"))
        write_photographs(tagged, images, seed)
        theirs.mkdir()
        given = {"kind": kind, "seed": seed, "photographs": len(tagged.measured)}
        command = [sys.executable, "-m", "sfmapp", "reconstruct", str(images), "-o", str(ours), "--no-recording", "-q"]
        cpu_s = measure(command)
        found = errors_of(ours / "sparse" / "0", tagged.centers) | of_ours(ours, tagged)
        rows.append(given | {"program": "sfmapp", "cpu_s": round(cpu_s, 1)} | found)
        print(rows[-1], flush=True)
        cpu_s = measure([sys.executable, __file__, "--pycolmap", str(images), str(theirs), kind])
        found = errors_of(theirs / "model", tagged.centers)
        rows.append(given | {"program": "pycolmap", "cpu_s": round(cpu_s, 1)} | found)
        print(rows[-1], flush=True)
    return rows


def write_results(rows: list[dict[str, Any]]) -> None:
    """The tables as JSON and as Markdown."""
    machine = describe_machine()
    (RESULTS / "tagged_sets.json").write_text(json.dumps(machine | {"rows": rows}, indent=1) + "\n")
    lines = [
        "# A drone's block and a walk round a monument, from tagged photographs", "",
        "`benchmarks/tagged_sets.py`: rendered photographs (30 and 32 of 1000 x 750), RTK of 2 and 3 cm in XMP with",
        "two wrong tags (8 m and 280 m off), a phone's EXIF of 3 and 6 m with three (two exchanged, one 1.1 km off).",
        "rms: of the cameras' places after a motion without scale. pycolmap's mapper gets the same positions and",
        f"deviations, with its robust loss on them. {machine['date']}, pycolmap {machine['versions']['pycolmap']}.", "",
        "| set | seed | program | registered | scale off | rms m | CPU s |", "|---|---|---|---|---|---|---|",
        *(
            f"| {row['kind']} | {row['seed']} | {row['program']} | {row['num_registered']} of {row['photographs']} "
            f"| {100 * row['scale_error_share']:+.3f} % | {row['rms_m']:.3f} | {row['cpu_s']} |"
            for row in rows
        ),
        "", "What `sfmapp` says of itself, and how far it is off in the world:", "",
        "| set | seed | wrong tags named | right ones lost | sigma of scale | horizontal rms m | height rms m "
        "| inside 95 % | residuals m | contradictions |", "|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in (row for row in rows if row["program"] == "sfmapp"):
        hit = len(set(row["named"]) & set(row["wrong"]))
        cells = [
            row["kind"], row["seed"], f"{hit} of {len(row['wrong'])}", len(row["named"]) - hit,
            f"{100 * row['scale_sigma_share']:.3f} %", f"{row['horizontal_rms_m']:.3f}",
            f"{row['vertical_rms_m']:.3f}", f"{100 * row['within_95']:.0f} %",
            " and ".join("-" if r is None else f"{r:.2f}" for r in row["residual_rms_m"]), len(row["contradictions"]),
        ]  # fmt: skip
        lines.append(f"| {' | '.join(map(str, cells))} |")
    (RESULTS / "tagged_sets.md").write_text("\n".join(lines) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--pycolmap", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.pycolmap:
        images, output, kind = arguments.pycolmap
        run_pycolmap(Path(images), Path(output), kind)
        return
    write_results([row for kind in KINDS for seed in range(arguments.seeds) for row in run_set(kind, seed)])


if __name__ == "__main__":
    main()
