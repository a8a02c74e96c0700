"""Photographs located in finished models: those left out of sets with ground truth, and some in halls of look-alikes.

    python benchmarks/locating.py             # all
    python benchmarks/locating.py --halls 2   # a fresh hall

Sets: every third photograph is left out, the rest reconstructed, those left out are located. Their errors stand beside
those of the same photographs reconstructed together with all others; NEES of their poses (6 degrees of freedom, 1 if
sigmas are right) is against the ground truth moved to the frame of the photographs of the model, of exact renderings
and of surveyed sets, whose own errors count in it.

Halls (``rendered_worlds.symmetric``): 16 m with four equal bays a side that half a turn takes to themselves, but for
one corner. The model has the whole hall, or the half without that corner: then the true place of half of the
photographs is not in it, and an exact double of it may be.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kidnapped import ANYWHERE, CORNER, ELSEWHERE, MAX_OFF_DEG, MAX_OFF_M, kidnapping
from machine import RESULTS, ROOT, describe_machine
from rendered_worlds import symmetric
from sfmapp.adjust.covariance import moved_to_gauge
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.geometry import rigid3
from sfmapp.pipelines.sparse.locate import LocatedResult, locate_photographs
from sfmapp.pipelines.sparse.reconstruct import reconstruct
from sfmapp.report.located_html import with_located
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.workspace.options import load_options
from sparse import DATA, IMAGE_SUFFIXES

Array = NDArray[np.float64]

SETS = ("fountain-P11", "herz-jesus-P8", "strecha-courtyard-21", "temple-sparse-ring", "lund-door")
EXACT = "courtyard"
MODELS = ("whole hall", "half of it")


def names_in(folder: Path) -> list[str]:
    """Photographs of a folder."""
    return sorted(path.name for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)


def modelled(images: Path, names: Sequence[str], output: Path) -> Reconstruction:
    """A reconstruction of some photographs of a folder."""
    output.parent.mkdir(parents=True, exist_ok=True)
    chosen = output.with_suffix(".txt")
    chosen.write_text("".join(f"{images / name}\n" for name in names))
    return reconstruct(str(chosen), output, record=False).reconstruction


def errors(model: Reconstruction, truth: dict[str, Array], names: Sequence[str]) -> Array:
    """(N, 6) of the poses of some images of a model, in the gauge of the others."""
    known = model.copy()
    known.cam_from_world[:] = [truth[name] for name in model.image_names]
    wanted = np.array([model.image_names.index(name) for name in names])
    true = moved_to_gauge(model, known, np.setdiff1d(model.registered_idx, wanted), 7).cam_from_world[wanted]
    change = rigid3.compose(model.cam_from_world[wanted], rigid3.inverse(true))
    return np.concatenate([rigid3.log_so3(rigid3.rotation_matrix(change)), change[:, 4:]], 1)


def measure_set(name: str, work: Path) -> dict[str, Any]:
    """Photographs left out of one set."""
    folder = ROOT / "data" / EXACT if name == EXACT else DATA / name
    names = names_in(folder / "images")
    held = names[1::3]
    given = next(folder / one for one in ("cameras.json", "ground_truth.json") if (folder / one).exists())
    ground_truth = read_ground_truth(given).for_images(names)
    truth = dict(zip(ground_truth.names, ground_truth.cam_from_world, strict=True))
    model = modelled(folder / "images", [one for one in names if one not in held], work / "rest")
    whole = modelled(folder / "images", names, work / "all")
    result = locate_photographs([folder / "images" / one for one in held], work / "rest")
    rows = [one for one in result.report.photographs if one.pose is not None]
    together = with_located(model, rows)
    found = errors(together, truth, [one.name for one in rows])
    covariances = [one.covariance for one in result.photographs if one.is_located]
    beside = errors(whole, truth, [one.name for one in rows])
    size = float(np.ptp(together.centers, axis=0).max())
    scale = [float(np.ptp(one.centers, axis=0).max()) for one in (together, whole)]
    nees = [float(e @ np.linalg.solve(c, e)) / 6.0 for e, c in zip(found, covariances, strict=True)]
    return {
        "case": name, "held_out": len(held), "located": len(rows), "refused": [
            {"name": one.name, "reason": one.reason} for one in result.report.photographs if one.pose is None
        ],
        "center_share": float(np.linalg.norm(found[:, 3:], axis=1).mean()) / scale[0],
        "center_share_all": float(np.linalg.norm(beside[:, 3:], axis=1).mean()) / scale[1],
        "rotation_deg": float(np.degrees(np.linalg.norm(found[:, :3], axis=1)).mean()),
        "rotation_deg_all": float(np.degrees(np.linalg.norm(beside[:, :3], axis=1)).mean()),
        "nees": float(np.mean(nees)), "nees_all": nees, "size": size,
        "cpu_s": float(np.mean([one.took.cpu_s for one in result.report.photographs])),
        "wall_s": float(np.mean([one.took.wall_s for one in result.report.photographs])),
        "missing": [one.landmarks.num_missing for one in rows if one.landmarks is not None],
        "clusters": [one.landmarks.num_clusters for one in rows if one.landmarks is not None],
    }  # fmt: skip


def model_of_hall(hall: int, kind: str, work: Path) -> Path:
    """A model of a hall with the cameras and poses that it was rendered with: its look-alikes are not what is tried."""
    (work / "images").mkdir(parents=True)
    sequence, cameras = symmetric.walk_round(hall), list[dict[str, Any]]()
    fx, fy, cx, cy = symmetric.CAMERA.params.tolist()
    for i in range(0, len(sequence), 4):
        pose = sequence.cam_from_world[i]
        if kind != MODELS[0] and rigid3.center(pose)[0] > -0.5:
            continue
        cv2.imwrite(str(work / "images" / f"{i:04d}.png"), sequence.image(i))
        cameras.append({
            "file": f"{i:04d}.png", "R_w2c": rigid3.rotation_matrix(pose).tolist(), "t_w2c": pose[4:].tolist(),
            "K": [[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]],
            "width": symmetric.CAMERA.width, "height": symmetric.CAMERA.height,
        })  # fmt: skip
    (work / "cameras.json").write_text(json.dumps({"cameras": cameras}))
    settings = {
        "poses.file": work / "cameras.json", "poses.fixed": "true", "images.fix_intrinsics": "true",
        "images.camera": f"PINHOLE,{fx},{fy},{cx},{cy}", "pairs.method": "sequential",
    }  # fmt: skip
    options = load_options([], [f"{name}={value}" for name, value in settings.items()])
    reconstruct(work / "images", work / "out", options, record=False)
    return work / "out"


def measure_hall(hall: int, kind: str, num: int, work: Path) -> dict[str, Any]:
    """Photographs from all over a hall, and from another one."""
    model = model_of_hall(hall, kind, work)
    (work / "new").mkdir()
    truths, kinds = list[Array](), list[str]()
    for number in range(num):
        where, sequence = kidnapping(hall, number)
        cv2.imwrite(str(work / "new" / f"{number:03d}.png"), sequence.image(0))
        truths.append(sequence.cam_from_world[0])
        kinds.append(where)
    found = locate_photographs(work / "new", model)
    return {"hall": hall, "model": kind, "rows": judged(found, kinds, truths)}


def judged(found: LocatedResult, kinds: Sequence[str], truths: Sequence[Array]) -> list[dict[str, Any]]:
    """What became of each photograph of a hall."""
    rows = []
    for one, row, kind, truth in zip(found.photographs, found.report.photographs, kinds, truths, strict=True):
        entry: dict[str, Any] = {"kind": kind, "outcome": "not located", "reason": row.reason, "cpu_s": row.took.cpu_s}
        if one.is_located:
            turn = rigid3.rotation_matrix(one.cam_from_world) @ rigid3.rotation_matrix(truth).T
            off = float(np.linalg.norm(rigid3.center(one.cam_from_world) - rigid3.center(truth)))
            off_deg = float(rigid3.rotation_angle_deg(turn))
            is_right = kind != ELSEWHERE and off < MAX_OFF_M and off_deg < MAX_OFF_DEG
            entry |= {"outcome": "right" if is_right else "wrong", "off_m": off, "off_deg": off_deg}
        rows.append(entry)
    return rows


def markdown(report: dict[str, Any]) -> str:
    """Two tables."""
    lines = [f"sfmapp {report['versions']['sfmapp']} at {report['commit']}; {report['cpu']}, {report['date']}.", ""]
    if report["sets"]:
        lines += [
            "| set | left out | located | centres off, share of the size (all at once) "
            "| rotations, degrees (all at once) | NEES | landmarks missing, clusters | CPU s a photograph |",
            "|---|---|---|---|---|---|---|---|",
        ]
    for row in report["sets"]:
        name = f"{row['case']} (exact)" if row["case"] == EXACT else row["case"]
        lines.append(
            f"| {name} | {row['held_out']} | {row['located']} | {row['center_share']:.2e} "
            f"({row['center_share_all']:.2e}) | {row['rotation_deg']:.4f} ({row['rotation_deg_all']:.4f}) "
            f"| {row['nees']:.2f} | {sum(row['missing'])} of {sum(row['clusters'])} | {row['cpu_s']:.1f} |"
        )
    lines += ["", "| hall | model | photographs | num | right | not located | wrong | off, most, m | CPU s |",
              "|---|---|---|---|---|---|---|---|---|"]  # fmt: skip
    for hall in report["halls"]:
        for kind in (CORNER, ANYWHERE, ELSEWHERE):
            rows = [row for row in hall["rows"] if row["kind"] == kind]
            num = [sum(row["outcome"] == one for row in rows) for one in ("right", "not located", "wrong")]
            off = max((row["off_m"] for row in rows if row["outcome"] == "right"), default=0.0)
            cpu = float(np.mean([row["cpu_s"] for row in rows])) if rows else 0.0
            lines.append(
                f"| {hall['hall']} | {hall['model']} | {kind} | {len(rows)} | {num[0]} | {num[1]} | {num[2]} "
                f"| {off:.2f} | {cpu:.1f} |"
            )
    return "\n".join(lines)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--halls", type=int, nargs="*", help="seeds (default 0, which chose thresholds, and 1)")
    parser.add_argument("--sets", nargs="*", help="default: all")
    parser.add_argument("--num", type=int, default=40, help="photographs in each hall")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "locating.json")
    args = parser.parse_args()
    report: dict[str, Any] = describe_machine() | {"sets": [], "halls": []}
    jobs: list[tuple[str, Any]] = [("sets", one) for one in (args.sets if args.sets is not None else (EXACT, *SETS))]
    jobs += [("halls", (hall, kind)) for hall in (args.halls if args.halls is not None else (0, 1)) for kind in MODELS]
    for part, case in jobs:
        with tempfile.TemporaryDirectory() as work:
            if part == "sets":
                row = measure_set(case, Path(work))
            else:
                row = measure_hall(*case, args.num, Path(work) / "hall")
        report[part].append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
        args.output.write_text(json.dumps(report, indent=1) + "\n")
        args.output.with_suffix(".md").write_text(markdown(report) + "\n")
    print(markdown(report))


if __name__ == "__main__":
    main()
