"""Dense patches: cost, scores against exact depth, memory and sameness, beside the prototype of the research note.

    python data/make_dense_scene.py courtyard out/dense/courtyard   # and railing: ten CPU minutes each
    python benchmarks/dense.py --scenes out/dense                   # everything that is there
    python benchmarks/dense.py --only lego

Each run is a process of its own with one thread; kernels are compiled before. See README.md.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dense_inputs import lego_inputs, photographs_model
from machine import RESULTS, ROOT, describe_machine
from sfmapp.evaluation.clouds import score_cloud
from sfmapp.evaluation.measured import run_measured
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.reporting import plain

DATA = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
PROTOTYPE = ROOT.parent / "shared" / "research" / "prototypes"

# Of the research note: other data than ours, but for the fountain. CPU s, points; F at 1, 2 and 5 ground pixels.
PUBLISHED = {
    "fountain": {"PMVS2": (138, 111_635, None), "OpenMVS 2.3": (562, 573_769, None), "prototype": (9.8, 252_046, None)},
    "courtyard level 1": {
        "PMVS2": (274, 183_164, (47.2, 85.2, 98.5)), "OpenMVS 2.3": (1209, 1_254_940, (81.1, 95.0, 99.5)),
        "prototype": (117.8, 2_176_190, (88.2, 97.3, 99.6)),
    },
    "courtyard level 0": {"prototype": (None, None, (70, 84, 94))},
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One run of a densifier.

    Attributes:
        name: of the row in the table, without the program.
        images, model: photographs and COLMAP text model of their cameras.
        level, cell_px: resolution and cell.
        has_masks: the alpha of the photographs says where there is something.
        ground_truth: PLY of the true surface, None for none; distances: where to score, in its units.
        box: low and high corner of what is scored.
        repeat_views: so many views are given a second time, for the memory of larger sets.
        peer_images: photographs for programs that know no alpha; None: the same, "" for no peer.
    """

    name: str
    images: Path
    model: Path
    level: int
    cell_px: int
    has_masks: bool = False
    ground_truth: Path | None = None
    distances: tuple[float, ...] = ()
    box: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    repeat_views: int = 0
    peer_images: Path | None = None
    has_peer: bool = True


def find_cases(scenes: Path, work: Path, only: str) -> Iterator[Case]:
    """What can be measured here, in the order of the table; only: what the names have to begin with."""
    if (DATA / "fountain-P11").is_dir() and "fountain".startswith(only):
        images = DATA / "fountain-P11" / "images"
        yield Case("fountain", images, photographs_model(images, work / "fountain"), 1, 2)
    if (DATA / "nerf-lego-small").is_dir() and only[:4] in ("", "lego"):
        lego = lego_inputs(DATA / "nerf-lego-small", work / "lego")
        for has_masks, name in ((True, "lego with masks"), (False, "lego without masks")):
            yield Case(
                name, DATA / "nerf-lego-small" / "images", lego.model, 0, 1, has_masks, lego.ground_truth,
                (0.005 * lego.size, 0.01 * lego.size), peer_images=lego.images_on_white, has_peer=not has_masks,
            )  # fmt: skip
    for scene, levels in (("courtyard", (1, 0)), ("railing", (1,))):
        folder = scenes / scene
        if not (folder / "scene.json").is_file():
            continue
        facts = json.loads((folder / "scene.json").read_text())
        low, high = (tuple(corner) for corner in facts["bbox"])
        for level in levels:
            pixel = facts["gsd"] * 2**level
            yield Case(
                f"{scene} level {level}", folder / "images", folder / "model_points", level, 1,
                ground_truth=folder / "ground_truth.ply", distances=(pixel, 2 * pixel, 5 * pixel), box=(low, high),
            )  # fmt: skip
        if scene == "courtyard":
            yield Case(
                "25 views of 2 MP", folder / "images", folder / "model_points", 0, 2, repeat_views=5, has_peer=False
            )


# ---------------------------------------------------------------- runs
def run_ours(case: Case, work: Path, threads: int = 1) -> dict[str, Any]:
    """``densify`` in a process of its own. CPU: from loading to the result, and of the whole process."""
    order = {
        "images": str(case.images), "model": str(case.model), "level": case.level, "cell_px": case.cell_px,
        "has_masks": case.has_masks, "repeat_views": case.repeat_views, "threads": threads,
        "output": str(work / "ours.npz"),
    }  # fmt: skip
    lines: list[str] = []
    usage = run_measured(
        [sys.executable, str(ROOT / "benchmarks" / "dense_child.py"), json.dumps(order)],
        work / "ours.log", env={**os.environ, "OMP_NUM_THREADS": "1"}, on_line=lines.append,
    )  # fmt: skip
    if usage.exit_code:
        message = (work / "ours.log").read_text(errors="replace")[-500:]
        return {"case": case.name, "program": "sfmapp", "threads": threads, "failed": message}
    told = json.loads(lines[-1])
    with np.load(work / "ours.npz", allow_pickle=False) as arrays:
        digest = hashlib.blake2b(digest_size=12)
        for name in sorted(arrays):
            digest.update(arrays[name].tobytes())
        xyz = arrays["xyz"]
    row = {"case": case.name, "program": "sfmapp", "threads": threads, "num_points": len(xyz)}
    row |= {"cpu_s": told["cpu_s"], "process_cpu_s": usage.cpu_s, "wall_s": told["wall_s"]}
    return row | {"peak_memory_mb": usage.peak_memory_mb, "digest": digest.hexdigest()} | scores(case, xyz)


def run_prototype(case: Case, work: Path) -> dict[str, Any]:
    """The batch PMVS of the research note, compiled by a run on small images before. CPU as it tells it itself."""
    copy = work / "prototype"
    shutil.copytree(PROTOTYPE, copy, dirs_exist_ok=True)
    words = ["pmvs_batch.py", str(case.peer_images or case.images), str(case.model), str(work / "peer.ply")]
    words += ["--csize", str(case.cell_px), "--threads", "1", "--level"]
    code = "import sys, pmvs_batch"
    for level in (case.level + 1 + (case.peer_images is None), case.level):
        code += f"; sys.argv = {[*words, str(level)]!r}; pmvs_batch.main()"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=copy, capture_output=True, text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    if done.returncode:
        return {"case": case.name, "program": "prototype", "threads": 1, "failed": done.stderr[-500:]}
    told = [json.loads(line) for line in done.stdout.splitlines() if re.match(r'\{"times"', line)][-1]
    row = {"case": case.name, "program": "prototype", "threads": 1, "num_points": told["N"], "cpu_s": told["cpu"]}
    return row | {"wall_s": told["wall"]} | scores(case, read_ply_geometry(work / "peer.ply").xyz)


def scores(case: Case, xyz: NDArray[np.float64]) -> dict[str, Any]:
    """Accuracy, completeness and F of a cloud; of a ground truth with labels, completeness by label and width."""
    if case.ground_truth is None:
        return {}
    score = score_cloud(xyz, read_ply_geometry(case.ground_truth).xyz, case.distances, box=case.box, threads=2)
    found: dict[str, Any] = {"score": plain(score.summary())}
    labels = ground_truth_labels(case.ground_truth)
    if labels is not None:
        is_scored = ~np.isnan(score.ground_truth_distance)
        surfaces = {"rest": labels == 0, "railing": labels > 0}
        surfaces |= {f"bars of {width} px": labels == width for width in np.unique(labels[labels > 0]).tolist()}
        found["completeness_by_surface"] = {
            name: [float((score.ground_truth_distance[mine & is_scored] <= d).mean()) for d in score.distances]
            for name, mine in surfaces.items()
        }
    return found


def ground_truth_labels(path: Path) -> NDArray[np.uint8] | None:
    """Widths in pixels (0: no bar) as ``make_dense_scene.py`` leaves them in the property green; None without."""
    with path.open("rb") as file:
        head = file.read(4096)
        start = head.index(b"end_header\n") + len(b"end_header\n")
        if b"green" not in head[:start] or b"blue" in head[:start]:  # a colour
            return None
        file.seek(start)
        return np.fromfile(file, [("xyz", "<f4", 3), ("red", "u1"), ("green", "u1")])["green"]


def measure(case: Case, work: Path, program: str | None) -> Iterator[dict[str, Any]]:
    """All runs of a case: ours, the prototype where it is at hand, and for the fountain ours on two threads."""
    load = os.getloadavg()[0]
    if program != "prototype":
        yield run_ours(case, work) | {"load_before": load}
    if program != "prototype" and case.name == "fountain":
        yield run_ours(case, work, threads=2) | {"load_before": load}
    if program != "sfmapp" and case.has_peer and PROTOTYPE.is_dir():
        yield run_prototype(case, work) | {"load_before": load}


def merged(runs: list[dict[str, Any]], new: dict[str, Any]) -> list[dict[str, Any]]:
    """The runs with a new one in the place of the one it repeats."""
    key = ("case", "program", "threads")
    kept = [run for run in runs if any(run[k] != new[k] for k in key)]
    return sorted([*kept, new], key=lambda run: (run["case"], run["program"] != "sfmapp", run["threads"]))


# ---------------------------------------------------------------- report
def markdown(report: dict[str, Any]) -> str:
    """One table of all runs and of the published figures, and one of the surfaces of the railing."""
    commits = ", ".join(sorted({run["commit"] for run in report["runs"]}))
    lines = [
        f"sfmapp at {commits}, one thread, kernels compiled; {report['cpu']}, {report['date']}.",
        "",
        "| case | program | CPU s | points | F % | accuracy % | completeness % | peak MB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in dict.fromkeys(run["case"] for run in report["runs"]):
        for run in (run for run in report["runs"] if run["case"] == name):
            if "failed" in run:
                lines.append(f"| {name} | {run['program']} | failed | | | | | |")
                continue
            program = run["program"] + (" on 2 threads" if run["threads"] == 2 else "")
            rows = run.get("score", {}).get("scores", [])
            cells = [" / ".join(f"{100 * row[k]:.1f}" for row in rows) for k in ("f_score", "accuracy", "completeness")]
            memory = f"{run['peak_memory_mb']:.0f}" if "peak_memory_mb" in run else ""
            lines.append(
                f"| {name} | {program} | {run['cpu_s']:.1f} | {run['num_points']} | {' | '.join(cells)} | {memory} |"
            )
        for program, (cpu, count, f) in PUBLISHED.get(name, {}).items():
            shown = " / ".join(map(str, f)) if f else ""
            lines.append(f"| {name} | {program}, note | {cpu or ''} | {count or ''} | {shown} | | | |")
    lines += [
        "",
        "F, accuracy and completeness at 1 / 2 / 5 ground pixels of the working level; lego: at 0.5 / 1 % of its size.",
    ]
    digests = {run["threads"]: run["digest"] for run in report["runs"] if run["case"] == "fountain" and "digest" in run}
    if len(digests) == 2:
        lines.append(
            f"Bytes on 1 and 2 threads (fountain): {'the same' if digests[1] == digests[2] else 'NOT the same'}."
        )
    for run in report["runs"]:
        if "completeness_by_surface" in run:
            lines.append(f"Completeness of {run['case']}, {run['program']}: " + "; ".join(
                f"{name} {' / '.join(f'{100 * v:.1f}' for v in values)}"
                for name, values in run["completeness_by_surface"].items()) + ".")  # fmt: skip
    lines.append(f"Highest load average before a run: {max(run['load_before'] for run in report['runs']):.1f}.")
    return "\n".join(lines) + "\n"


def published() -> dict[str, Any]:
    """The figures of the note as the results hold them."""
    names = ("cpu_s", "num_points", "f_scores")
    return {
        case: {program: dict(zip(names, figures, strict=True)) for program, figures in programs.items()}
        for case, programs in PUBLISHED.items()
    }


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", type=Path, default=ROOT / "out" / "dense", help="folder of the rendered scenes")
    parser.add_argument("--only", default="", help="cases whose names begin with this; others keep their results")
    parser.add_argument("--program", choices=["sfmapp", "prototype"], help="run just one of the two")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "dense.json")
    args = parser.parse_args()
    runs = json.loads(args.output.read_text())["runs"] if args.output.is_file() else []
    report: dict[str, Any] = describe_machine() | {"published": published(), "runs": runs}
    with tempfile.TemporaryDirectory(prefix="dense-") as name:
        work = Path(name)
        for case in find_cases(args.scenes, work, args.only):
            if not case.name.startswith(args.only):
                continue
            for run in measure(case, work, args.program):
                run |= {"commit": report["commit"], "date": report["date"]}
                report["runs"] = merged(report["runs"], run)
                print(json.dumps(run), file=sys.stderr, flush=True)
                args.output.write_text(json.dumps(report, indent=1) + "\n")
    args.output.with_suffix(".md").write_text(markdown(report))
    print(markdown(report), end="")


if __name__ == "__main__":
    main()
