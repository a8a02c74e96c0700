"""One view among others that is wrong: a camera turned or moved, a mask of something else. Is it named, and no other?

    SFMAPP_DATA=... python benchmarks/carving_wrong_views.py [--only CASE ...]

Silhouettes are held against each other by their outer tangents alone; the command asks the volume that they leave as
well, and leaves out cameras that stand where all others show the object. Solids are drawn, 240 pixels wide, seen from
6, 8 and 12 sides spread over a sphere; none of them chose a threshold. Cameras are turned about their own centre, or
moved without being turned: into the volume, nearer by a tenth of the distance, aside by a twentieth. Wrong masks are
upside down, or without the half to one side.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from carving import BUNNY, BUNNY_CAMERA, DATA, DINOSAUR, load
from carving_tolerance import WIDTH, Scene, rendered
from cases import measure_cases
from rendered_worlds.lit_solids import around, drawn
from sfmapp.carve.box import find_box
from sfmapp.carve.outlines import Silhouette, coverage_of_mask, signed_distance
from sfmapp.carve.tangency import Contradicted, Tangents, find_contradicted
from sfmapp.carve.views import View

Array = NDArray[np.float64]
SOLIDS, SIDES, DRAWS = (71, 72, 73, 74), (6, 8, 12), 2
SETS = {
    "bunny": lambda: load(BUNNY, BUNNY / "tumpose.txt", BUNNY_CAMERA), "dinosaur": lambda: load(DINOSAUR),
    "temple": lambda: load(DATA / "temple-sparse-ring"), "lego": lambda: load(DATA / "nerf-lego-small"),
}  # fmt: skip
TURNS = {"looks up or down": 0, "looks aside": 1, "rolled": 2}
TURNED_DEG = 5.0
KINDS = (*TURNS, "in the volume", "nearer", "moved aside", "mask upside down", "half a mask")


def scene(case: str) -> Scene:
    if case in SETS:
        return SETS[case]()
    _, seed, _, num, _ = case.split()
    views, silhouettes = rendered(drawn(int(seed)), around(int(num), 1, WIDTH))
    return views, [by_mask(each.inside) for each in silhouettes]


def by_mask(mask: NDArray[np.bool_]) -> Silhouette:
    """As the command takes masks of whole pixels."""
    return Silhouette(signed_distance(coverage_of_mask(mask)), outline_sigma_px=0.2)


CASES = (*SETS, *(f"drawn {seed} from {num} sides" for num in SIDES for seed in SOLIDS))


def turned(view: View, axis: int, degrees: float) -> View:
    """About the camera's centre: the axis to the right, down, or ahead."""
    ahead = view.axis
    right = view.outer[0, :3] - (view.outer[0, :3] @ ahead) * ahead
    right /= np.linalg.norm(right)
    about = (right, np.cross(ahead, right), ahead)[axis]
    return placed(view, Rotation.from_rotvec(np.radians(degrees) * about).as_matrix(), view.center)


def placed(view: View, rotation: Array, center: Array) -> View:
    """With rays turned by a rotation of the world, from another place; a matrix from now on."""
    left = np.diag([*view.lens_row[:2], 1.0]) @ view.outer[:, :3]
    left[:2] += view.lens_row[2:4, None] * view.outer[2, :3]
    left = left @ rotation.T
    lens = np.zeros_like(view.lens_row)
    lens[:2] = 1.0
    outer = np.column_stack([left, -left @ center])
    return replace(view, outer=outer, lens_row=lens, camera=None, cam_from_world=None)


def spoiled(view: View, silhouette: Silhouette, kind: str, middle: Array, rng: np.random.Generator) -> tuple[View, Any]:
    away = middle - view.center
    if kind in TURNS:
        return turned(view, TURNS[kind], TURNED_DEG * float(rng.choice([-1, 1]))), silhouette
    if kind == "in the volume":
        out = rng.normal(size=3)
        at = middle + 0.08 * np.linalg.norm(away) * out / np.linalg.norm(out)
        return placed(view, np.eye(3), at), silhouette
    if kind == "nearer":
        return placed(view, np.eye(3), view.center + 0.1 * away), silhouette
    if kind == "moved aside":
        across = np.cross(away, rng.normal(size=3))
        at = view.center + 0.05 * np.linalg.norm(away) * across / np.linalg.norm(across)
        return placed(view, np.eye(3), at), silhouette
    mask = silhouette.inside.copy()
    if kind == "mask upside down":
        mask = mask[::-1]
    else:
        mask[:, int(np.median(np.nonzero(mask)[1])) :] = False
    return view, replace(silhouette, distance=signed_distance(coverage_of_mask(mask)))


def told(views: Sequence[View], silhouettes: Sequence[Silhouette]) -> tuple[dict[int, Contradicted], bool]:
    """Views that are named, and whether the rest agrees."""
    used = [i for i, each in enumerate(silhouettes) if each.known is None or each.known.any()]
    found, agree = find_contradicted(Tangents(views, silhouettes), used, max(1, len(used) // 10))
    return {each.view: each for each in found}, agree


def measured(case: str) -> Iterator[dict[str, Any]]:
    views, silhouettes = scene(case)
    clean, _ = told(views, silhouettes)
    about = {"case": case, "views": len(views), "named_if_clean": len(clean)}
    low, side = find_box(views, silhouettes).cube()
    rng = np.random.default_rng(len(views))
    for kind in KINDS:
        for wrong in rng.choice(len(views), DRAWS, replace=False):
            view, silhouette = spoiled(views[wrong], silhouettes[wrong], kind, low + 0.5 * side, rng)
            named, agree = told(
                [view if i == wrong else each for i, each in enumerate(views)],
                [silhouette if i == wrong else each for i, each in enumerate(silhouettes)],
            )
            found = named.pop(int(wrong), None)
            yield about | {
                "kind": kind, "wrong": views[wrong].name, "named": found is not None, "wrongly_named": len(named),
                "undecided": not agree, "turned_deg": found and found.turned_deg,
                "sigma_deg": found and found.sigma_deg,
            }  # fmt: skip


def markdown(report: dict[str, Any]) -> str:
    lines = [
        "# One view that is wrong", "",
        f"{report['date']}, {report['commit']}, {report['cpu']}. How: `benchmarks/carving_wrong_views.py`.", "",
        (__doc__ or "").split("\n\n")[2].replace("\n", " "), "",
        "Named, of so many; in brackets how many others were named.", "",
    ]  # fmt: skip
    rows = report["rows"]
    groups = {name: [row for row in rows if row["case"] == name] for name in SETS}
    for num in SIDES:
        groups[f"drawn, {num} sides"] = [r for r in rows if r["views"] == num and r["case"].startswith("drawn")]
    groups = {name: found for name, found in groups.items() if found}
    lines += [f"| | {' | '.join(groups)} |", "|---|" + "---|" * len(groups)]
    for kind in KINDS:
        cells = []
        for found in groups.values():
            mine = [row for row in found if row["kind"] == kind]
            cells.append(f"{sum(r['named'] for r in mine)} of {len(mine)} ({sum(r['wrongly_named'] for r in mine)})")
        name = f"{kind}, {TURNED_DEG:.0f} degrees" if kind in TURNS else kind
        lines.append(f"| {name} | {' | '.join(cells)} |")
    clean = [
        f"{sum({r['case']: r['named_if_clean'] for r in found}.values())} of {len({r['case'] for r in found})} sets"
        for found in groups.values()
    ]
    lines.append(f"| named though all are right | {' | '.join(clean)} |")
    errors = np.array([
        (abs(r["turned_deg"] - TURNED_DEG), abs(r["turned_deg"] - TURNED_DEG) / r["sigma_deg"])
        for r in rows if r["kind"] in TURNS and r["sigma_deg"]
    ])  # fmt: skip
    if len(errors):
        lines += [
            "", f"Angles of {len(errors)} turned cameras: {np.sqrt(np.mean(errors[:, 0] ** 2)):.2f} degrees off (RMS), "
            f"{np.mean(errors[:, 1] < 2.0):.0%} within two of their standard deviations.",
        ]  # fmt: skip
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    measure_cases("carving_wrong_views", __doc__, CASES, measured, markdown)
