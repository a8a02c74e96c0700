"""Hull, patches, and both joined: F against exact surfaces, volumes, closedness.

    python benchmarks/carving_joined.py                 # lego, and solids rendered with hollows
    python benchmarks/carving_joined.py --only jug

The lego's truth is the depth of its test views, which see no underside: what none of them looks at is in no score. The
solids are textured but for a blank third, where patches find nothing. The last three chose nothing. See README.md.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dense_child import MAX_NEIGHBORS, load_scene
from dense_inputs import LEGO_FAR, LEGO_TOLERANCE, lego_inputs
from machine import RESULTS, ROOT, describe_machine
from rendered_worlds.lit_solids import around, drawn, house, jug, rack, wheel
from rendered_worlds.solids import Lamps, Solid, render
from sfmapp.carve.hull import hull_of
from sfmapp.carve.isosurface import surface_of
from sfmapp.carve.joined import Evidence, join
from sfmapp.carve.limits import OUTLINES, PATCHES, find_known
from sfmapp.carve.options import CarveOptions
from sfmapp.carve.outlines import signed_distance
from sfmapp.carve.sight import sights_of_patches
from sfmapp.carve.silhouettes import Silhouette
from sfmapp.carve.space_carving import carve_hull
from sfmapp.carve.views import View, view_of_camera
from sfmapp.dense.densify import densify
from sfmapp.dense.options import DenseOptions
from sfmapp.dense.scene import DenseScene, DenseView, Patches
from sfmapp.dense.selection import select_neighbors
from sfmapp.evaluation.clouds import nearest_distance, sample_triangles
from sfmapp.events import Events
from sfmapp.formats.colmap import read_model
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.scene.mesh import Mesh
from sfmapp.surface.mesh import make_mesh
from sfmapp.surface.options import SurfaceOptions
from sfmapp.surface.trim import rim

Array = NDArray[np.float64]
DATA = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
SHARES = (0.005, 0.01)  # of the size, the diagonal of the true surface's box
SAMPLES = 400_000
SOLID_VIEWS, SOLID_NOISE = 32, 2.0
BLANK_ABOVE = 0.15  # of y: no texture there
SOLIDS = {
    "house": house, "jug": jug, "drawn 1": lambda: drawn(1), "drawn 2": lambda: drawn(2),
    # these three were first looked at when everything was decided
    "rack": rack, "wheel": wheel, "drawn 4": lambda: drawn(4),
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One object.

    Attributes:
        scene: photographs, masks and cameras. views, silhouettes: the same for carving.
        low, side: of the cube. truth: (N, 3) points of the true surface.
        solid: the true solid; None where only points are known.
        judged: which points (N, 3) the truth can judge; None for all.
    """

    name: str
    scene: DenseScene
    views: list[View]
    silhouettes: list[Silhouette]
    low: Array
    side: float
    truth: Array
    solid: Solid | None
    judged: Any

    @property
    def size(self) -> float:
        """Diagonal of the truth's box."""
        return float(np.linalg.norm(np.ptp(self.truth, axis=0)))


# ------------------------------------------------------------------------------------------------------------- objects
def lego_case(work: Path) -> Case:
    """The lego of NeRF's synthetic set: 50 photographs with alpha, 8 depth maps of other views."""
    folder = DATA / "nerf-lego-small"
    lego = lego_inputs(folder, work / "lego")
    order = {"model": str(lego.model), "images": str(folder / "images"), "level": 0, "has_masks": True}
    scene = load_scene(order | {"repeat_views": 0})
    model = read_model(lego.model)[0]
    views, silhouettes = [], []
    for name, idx, pose in zip(model.image_names, model.image_camera_idx, model.cam_from_world, strict=True):
        views.append(view_of_camera(name, model.cameras[idx], pose))
        alpha = cv2.imread(str(folder / "images" / name), cv2.IMREAD_UNCHANGED)[..., 3]
        silhouettes.append(Silhouette(signed_distance(alpha.astype(np.float32) / np.float32(255.0)), source="alpha"))
    truth = read_ply_geometry(lego.ground_truth).xyz
    low, side = np.array([-1.3, -1.3, -0.9]), 2.6
    return Case("lego", scene, views, silhouettes, low, side, truth, None, LegoJudge(folder))


class LegoJudge:
    """Which points the depth of the lego's test views can judge: those that are not hidden in all of them."""

    def __init__(self, folder: Path) -> None:
        self.views = []
        for camera in json.loads((folder / "test_cameras.json").read_text())["cameras"]:
            image = folder / camera["file"]
            depth = cv2.imread(str(image.with_name(f"{image.stem}_depth.png")), cv2.IMREAD_UNCHANGED)
            depth = depth[..., 0] if depth.ndim == 3 else depth
            reach = np.where(depth > 0, LEGO_FAR * (1 - depth / 255.0), np.inf)
            self.views.append((np.array(camera["K"]), np.array(camera["R_w2c"]), np.ravel(camera["t_w2c"]), reach))

    def __call__(self, xyz: Array) -> NDArray[np.bool_]:
        """(N,) of points (N, 3): in front of what a test view shows, be it nothing, or hardly behind it."""
        return self._shown(xyz, LEGO_TOLERANCE, nothing_counts=True)

    def as_eth3d(self, xyz: Array, limit: float) -> NDArray[np.bool_]:
        """(N,) of points (N, 3) that ETH3D's evaluation judges (Schoeps et al., "A multi-view stereo benchmark with
        high-resolution images and multi-camera videos", CVPR 2017): rays are free up to what they meet and the limit
        behind it; one that meets nothing, as of a scanner, tells nothing."""
        return self._shown(xyz, limit, nothing_counts=False)

    def _shown(self, xyz: Array, behind: float, *, nothing_counts: bool) -> NDArray[np.bool_]:
        shown = np.zeros(len(xyz), np.bool_)
        for k, rotation, shift, reach in self.views:
            reach = reach if nothing_counts else np.where(np.isfinite(reach), reach, -np.inf)
            seen = xyz @ rotation.T + shift
            u, v = np.rint(seen[:, :2] / seen[:, 2:] * [k[0, 0], k[1, 1]] + k[:2, 2]).astype(int).T
            inside = (u >= 0) & (v >= 0) & (u < reach.shape[1]) & (v < reach.shape[0])
            away = np.linalg.norm(seen[inside], axis=1)
            shown[inside] |= away < reach[v[inside], u[inside]] + behind
        return shown


def solid_case(name: str, solid: Solid | None = None) -> Case:
    """A rendered solid, by default that of the name: its texture is fixed in space, there is none in a third of it,
    before black with alpha."""
    solid = solid or SOLIDS[name]()
    rig = around(SOLID_VIEWS, 1)
    texture = np.random.default_rng([7, 0x7E47]).uniform(40.0, 220.0, (64, 64, 64)).astype(np.float32)
    nothing = Lamps(np.zeros((0, 3)), np.zeros(0))
    dense_views, views, silhouettes = [], [], []
    for n, pose in enumerate(rig.poses):
        shown = render(solid, rig.camera, pose, nothing)
        view = view_of_camera(f"view_{n:03d}.png", rig.camera, pose)
        grey = shown.cover * _color(view, shown.depth, texture)
        grey += np.random.default_rng([n, 0x5EED]).normal(0.0, SOLID_NOISE, grey.shape).astype(np.float32)
        rgb = np.repeat(np.clip(grey.round(), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        k = rig.camera.k_matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        dense_views.append(DenseView(view.name, rgb, shown.cover > 0.5, k, pose))
        views.append(view)
        silhouettes.append(Silhouette(signed_distance(shown.cover), source="alpha"))
    low = np.full(3, -1.05)
    return Case(name, scene_of(dense_views), views, silhouettes, low, 2.1, surface_points(solid), solid, None)


def _color(view: View, depth: NDArray[np.float32], texture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Grey (H, W) of a texture in space at two scales, blank above a plane."""
    from scipy.ndimage import map_coordinates

    from sfmapp.camera.camera import pixels_to_rays
    from sfmapp.geometry import rigid3

    assert view.camera is not None
    assert view.cam_from_world is not None
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    rays = pixels_to_rays(view.camera, np.stack([x.ravel(), y.ravel()], 1)) @ rigid3.rotation_matrix(
        view.cam_from_world
    )
    hit = np.isfinite(depth.ravel())
    points = view.center + depth.ravel()[hit, None] * rays[hit]
    grey = np.zeros(depth.size, np.float32)
    fine = map_coordinates(texture, (points * 30.0).T, order=1, mode="grid-wrap")
    coarse = map_coordinates(texture, (points * 9.0).T, order=1, mode="grid-wrap")
    grey[hit] = np.where(points[:, 1] > BLANK_ABOVE, 130.0, 0.5 * (fine + coarse))
    return grey.reshape(depth.shape)


def scene_of(views: Sequence[DenseView]) -> DenseScene:
    poses, focal = np.array([view.cam_from_world for view in views]), np.array([view.k[:2].mean() for view in views])
    no_points = np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32)
    neighbors, _ = select_neighbors(focal, poses, *no_points, MAX_NEIGHBORS)
    return DenseScene(tuple(views), neighbors, *no_points)


def surface_points(solid: Solid, num: int = 150_000) -> Array:
    """Points spread evenly over a solid's surface: of a thin shell, drawn to it along the slope of the distance."""
    rng, found, total = np.random.default_rng(3), [], 0
    while total < num:
        xyz = rng.uniform(-1.0, 1.0, (1_000_000, 3)) * solid.reach
        xyz = xyz[np.abs(solid.distance(xyz)) < 0.01]
        for _ in range(4):
            step = 1e-5
            slope = np.stack(
                [solid.distance(xyz + step * e) - solid.distance(xyz - step * e) for e in np.eye(3)], axis=1
            )
            slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
            xyz = xyz - solid.distance(xyz)[:, None] * slope
        found.append(xyz[np.abs(solid.distance(xyz)) < 1e-3])
        total += len(found[-1])
    return np.concatenate(found)[:num]


# ---------------------------------------------------------------------------------------------------------------- runs
def measure(case: Case, cells: int) -> Iterator[dict[str, Any]]:
    """A row for each way."""
    begin = time.process_time()
    patches, _ = densify(case.scene, DenseOptions(level=0, cell_px=1, max_neighbors=MAX_NEIGHBORS), threads=2)
    dense_s = time.process_time() - begin
    names = [view.name for view in case.views]
    begin = time.process_time()
    hull = hull_of(case.views, case.silhouettes)
    tree, _ = carve_hull(hull, names, case.low, case.side, CarveOptions(cells=cells), Events())
    mesh = surface_of(tree, hull.distance)
    yield row(case, "hull", mesh, cpu_s=time.process_time() - begin)
    yield row(case, "patches", patches, cpu_s=dense_s)
    made, report = make_mesh(
        patches.xyz, patches.normal, patches.rgb, patches.size, case.scene, SurfaceOptions(), threads=2
    )
    yield row(case, "mesh of patches", made, cpu_s=dense_s + report.cpu_s)
    begin = time.process_time()
    evidence = Evidence(case.views, case.silhouettes, hull, sights_of_patches(case.views, patches, names))
    joined, told = join(evidence, case.low, case.side, cells)
    mesh = surface_of(joined.tree, joined.distance)
    joined_s = dense_s + time.process_time() - begin
    yield row(case, "joined", mesh, cpu_s=joined_s)
    known = find_known(mesh, case.views, evidence, told.band, threads=2)
    for least, way in ((OUTLINES, "of it, by patches or outlines"), (PATCHES, "of it, by patches")):
        kept = known.kind >= least
        part = Mesh(mesh.xyz, mesh.faces[kept], mesh.normal, mesh.rgb)
        yield row(case, way, part, cpu_s=joined_s) | {"area_share": float(known.areas[kept].sum() / known.areas.sum())}


def row(case: Case, way: str, made: Mesh | Patches, cpu_s: float) -> dict[str, Any]:
    """Scores at shares of the size; of closed meshes the volume."""
    points = made.xyz if isinstance(made, Patches) else sample_triangles(made.xyz, made.faces, SAMPLES)
    told: dict[str, Any] = {"case": case.name, "way": way, "cpu_s": cpu_s}
    if isinstance(made, Mesh):
        told["open_edges"] = len(rim(made.faces))
    judged = np.ones(len(points), np.bool_) if case.judged is None else case.judged(points)
    told["judged_share"] = float(judged.mean())
    limits = np.array(SHARES) * case.size
    if case.solid is None:
        error = nearest_distance(points, case.truth, limits[-1], threads=2)
    else:
        error = np.abs(case.solid.distance(points))
    missed = nearest_distance(case.truth, points, limits[-1], threads=2)
    for share, limit in zip(SHARES, limits, strict=True):
        accuracy, completeness = float((error[judged] <= limit).mean()), float((missed <= limit).mean())
        told[f"at {share:g}"] = {
            "f": f_score(accuracy, completeness), "accuracy": accuracy,
            "completeness": completeness, "accuracy_of_all": float((error <= limit).mean()),
        }  # fmt: skip
        if case.judged is not None:
            observed = case.judged.as_eth3d(points, limit)
            told[f"at {share:g}"]["accuracy_as_eth3d"] = float((error[observed] <= limit).mean())
    if case.solid is not None and isinstance(made, Mesh) and not told["open_edges"]:
        a, b, c = (made.xyz[made.faces[:, k]] for k in range(3))
        true = case.solid.volume()
        told["volume_error"] = float((a * np.cross(b, c)).sum() / 6.0) / true - 1.0
    return told


def f_score(accuracy: float, completeness: float) -> float:
    return 2 * accuracy * completeness / max(accuracy + completeness, 1e-12)


# -------------------------------------------------------------------------------------------------------------- report
def markdown(report: dict[str, Any]) -> str:
    """One table."""
    lines = [
        f"sfmapp at {report['commit']}; {report['cpu']}, {report['date']}.",
        "",
        "| object | cells | way | F % at 0.5 / 1 % | accuracy % | completeness % | volume | open edges | CPU s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for run in report["runs"]:
        parts = [run[f"at {share:g}"] for share in SHARES]
        cells = [" / ".join(f"{100 * part[k]:.1f}" for part in parts) for k in ("f", "accuracy", "completeness")]
        volume = f"{100 * run['volume_error']:+.1f} %" if "volume_error" in run else ""
        about = f"| {run['case']} | {run['cells']} | {run['way']}"
        edges = "" if "area_share" in run else run.get("open_edges", "")
        told = f"{volume} | {edges} | {run['cpu_s']:.0f}"
        about += f" ({100 * run['area_share']:.0f} % of the area)" if "area_share" in run else ""
        lines.append(f"{about} | {' | '.join(cells)} | {told} |")
    shares = {run["way"]: run for run in report["runs"] if run["case"] == "lego"}
    lines += ["", "Sizes are diagonals of boxes. CPU of patches is in what is made of them."]
    for commit in dict.fromkeys(run["commit"] for run in report["runs"] if run["commit"] != report["commit"]):
        told = dict.fromkeys(f"{run['case']} {run['way']}" for run in report["runs"] if run["commit"] == commit)
        lines.append(f"At {commit}: {', '.join(told)}.")
    if shares:
        told = ", ".join(
            f"{way} {100 * run['judged_share']:.0f} % ({100 * run['at 0.01']['accuracy_of_all']:.1f} % within 1 %)"
            for way, run in shares.items()
        )
        lines += ["", f"Of the lego the test views can judge (accuracy of all, hidden undersides too): {told}."]
        told = ", ".join(f"{way} {_as_eth3d(run)}" for way, run in shares.items() if _as_eth3d(run))
        lines += ["", f"F of the lego at 0.5 / 1 % with accuracies as ETH3D has them, softer than the table's: {told}."]
        lines += [
            "There a ray that meets nothing tells nothing, and what is farther behind a surface than the limit is",
            "neither right nor wrong. In the table rays beside the object are free, and up to 1.3 % behind counts.",
        ]
        lines += [
            "",
            "The lego's closed surface is below its patches and their mesh. Most of what is wrong lies where no",
            "photograph looks, which they leave open and a closed surface has to guess; without all that no patch",
            "tells it is still below the patches. Tried on it, F at 1 %: what nothing tells leans to empty by 3 over",
            "the cells a node, 98.5 (solids -0.1 to +0.1); by 12 where four in five photographs have patches before",
            "it, 98.8, but from 6 on a lean may hollow out what is full; unseen parts as membranes within their",
            "rims, 98.3; fewer iterations after filling, 98.6, and 98.3 with a lean beside, so that it is chance.",
        ]
    return "\n".join(lines) + "\n"


def _as_eth3d(run: dict[str, Any]) -> str:
    parts = [run[f"at {share:g}"] for share in SHARES]
    if "accuracy_as_eth3d" not in parts[0]:
        return ""
    return " / ".join(f"{100 * f_score(part['accuracy_as_eth3d'], part['completeness']):.1f}" for part in parts)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", default="", help="objects whose names begin with this; others keep their results")
    parser.add_argument("--cells", type=int, help="default: 256 for the lego, 128 for solids")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "carving_joined.json")
    args = parser.parse_args()
    runs = json.loads(args.output.read_text())["runs"] if args.output.is_file() else []
    names = [name for name in ("lego", *SOLIDS) if name.startswith(args.only)]
    if not (DATA / "nerf-lego-small").is_dir():
        names = [name for name in names if name != "lego"]
    report: dict[str, Any] = describe_machine()
    with tempfile.TemporaryDirectory(prefix="joined-") as folder:
        for name in names:
            case = lego_case(Path(folder)) if name == "lego" else solid_case(name)
            cells = args.cells or (256 if name == "lego" else 128)
            for measured in measure(case, cells):
                run = measured | {"cells": cells, "commit": report["commit"]}
                runs = [old for old in runs if (old["case"], old["way"]) != (run["case"], run["way"])] + [run]
                print(json.dumps(run), file=sys.stderr, flush=True)
    order = ["lego", *SOLIDS]
    report["runs"] = sorted(runs, key=lambda run: order.index(run["case"]))
    args.output.write_text(json.dumps(report, indent=1) + "\n")
    args.output.with_suffix(".md").write_text(markdown(report))
    print(markdown(report), end="")


if __name__ == "__main__":
    main()
