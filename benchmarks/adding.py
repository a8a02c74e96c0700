"""Photographs added in batches to a reconstruction, and two models merged, beside all of them at once.

    python benchmarks/adding.py                          # sets with ground truth, several random orders each
    python benchmarks/adding.py --sets fountain-P11 --orders 5

Each order is five batches: the first, photographs nearest to a random one (a fifth of all, five or more), is
reconstructed, the others, at random, are added with ``--add``. Errors are those of centres and rotations after a
similarity, means over all photographs; those of all at once are means of three seeds, beside the least and the largest.
CPU seconds are those of all runs of an order together. ``late link``: two views of the courtyard that
have no match with the first ones, and then those between. Two models that share three photographs are merged.

An output that is there already goes on from where it was.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from locating import EXACT, names_in
from machine import RESULTS, ROOT, describe_machine
from sfmapp.errors import NoReconstructionError
from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.geometry import rigid3
from sfmapp.pipelines.sparse.add import add_photographs
from sfmapp.pipelines.sparse.merge import merge_reconstructions
from sfmapp.pipelines.sparse.reconstruct import RunResult, reconstruct
from sfmapp.workspace.options import load_options
from sparse import DATA

SETS = ("fountain-P11", "herz-jesus-P8", "temple-sparse-ring", "strecha-courtyard-21", "lund-door", EXACT)
NUM_BATCHES, LEAST, NUM_SEEDS = 5, 5, 3
# two models of a set that share three photographs
HALVES = {
    "fountain-P11": (range(7), range(4, 11)),
    "strecha-courtyard-21": (range(12), range(7, 21)),
}
# views of the courtyard: of the fountain, two of the far end of the entry, and those between
SIDES = (range(10, 15), (8, 9), (*range(8), *range(15, 21)))


def folder_of(name: str) -> Path:
    """A set."""
    return ROOT / "data" / EXACT if name == EXACT else DATA / name


def batches(name: str, order: int) -> list[list[str]]:
    """Five batches of the photographs of a set in a random order."""
    names = names_in(folder_of(name) / "images")
    truth = read_ground_truth(folder_of(name) / "cameras.json").for_images(names)
    rng, centers = np.random.default_rng([order, 0xADD]), rigid3.center(truth.cam_from_world)
    near = np.argsort(np.linalg.norm(centers - centers[rng.integers(len(names))], axis=1), kind="stable")
    first = near[: max(LEAST, len(names) // NUM_BATCHES)]
    rest = rng.permutation(np.setdiff1d(np.arange(len(names)), first))
    parts = [first, *np.array_split(rest, NUM_BATCHES - 1)]
    return [[truth.names[i] for i in part] for part in parts if len(part)]


def add_all(name: str, parts: Sequence[Sequence[str]], work: Path) -> list[RunResult]:
    """The first batch reconstructed, the others added to it, each from a folder of its own."""
    found = []
    for n, part in enumerate(parts):
        (work / f"batch{n}").mkdir(parents=True)
        for photograph in part:
            shutil.copyfile(folder_of(name) / "images" / photograph, work / f"batch{n}" / photograph)
        run = add_photographs if n else reconstruct
        found.append(run(work / f"batch{n}", work / "out", record=False))
    return found


def errors(name: str, result: RunResult) -> dict[str, Any]:
    """Of a model against the ground truth."""
    names = names_in(folder_of(name) / "images")
    truth = read_ground_truth(folder_of(name) / "cameras.json").for_images(names)
    model = result.reconstruction
    found = evaluate_poses(model.image_names, model.cam_from_world, truth.names, truth.cam_from_world).summary()
    center, rotation = found.center_error_share, found.rotation_error_deg
    assert center is not None
    assert rotation is not None
    return {"registered": found.num_common, "center_share": center.mean, "rotation_deg": rotation.mean}


def measure(name: str, order: int, work: Path) -> dict[str, Any]:
    """One order of one set."""
    row: dict[str, Any] = {"case": name, "order": order, "num": len(names_in(folder_of(name) / "images"))}
    try:
        found = add_all(name, batches(name, order), work)
    except NoReconstructionError as error:
        return row | {"no_start": str(error)}
    moved = [one.report.added.moved_sigmas for one in found if one.report.added is not None]
    cpu = sum(one.report.run.cpu_s for one in found)
    return row | errors(name, found[-1]) | {"cpu_s": cpu, "moved_sigmas": moved}


def measure_whole(name: str, work: Path) -> dict[str, Any]:
    """All photographs at once, three seeds."""
    runs = []
    for seed in range(NUM_SEEDS):
        found = reconstruct(
            folder_of(name) / "images", work / str(seed), load_options([], [f"seed={seed}"]), record=False
        )  # fmt: skip
        runs.append(errors(name, found) | {"cpu_s": found.report.run.cpu_s})
    return {"case": name, "runs": runs}


def measure_late_link(work: Path) -> dict[str, Any]:
    """Views that link to nothing, and then those that link them."""
    name = "strecha-courtyard-21"
    names = names_in(folder_of(name) / "images")
    found = add_all(name, [[names[i] for i in side] for side in SIDES], work)
    second, third = found[1].report.added, found[2].report.added
    assert second is not None
    assert third is not None
    return {
        "case": "late link", "registered": [int(one.report.models[0].num_registered) for one in found],
        "left_over": [{"name": one.name, "model": one.model, "reason": one.reason} for one in second.photographs],
        "linked": list(third.linked), "models": [len(one.report.models) for one in found],
    }  # fmt: skip


def measure_merge(name: str, work: Path) -> dict[str, Any]:
    """Two models of a set made one."""
    names, folders = names_in(folder_of(name) / "images"), []
    for k, half in enumerate(HALVES[name]):
        folders.append(work / f"photos {k}")
        folders[k].mkdir(parents=True)
        for i in half:
            shutil.copyfile(folder_of(name) / "images" / names[i], folders[k] / names[i])
        reconstruct(folders[k], work / str(k), record=False)
    found = merge_reconstructions(work / "0", work / "1", work / "both", record=False)
    assert found.report.merged is not None
    return {"case": name, "num": len(names), "off_sigmas": found.report.merged.off_sigmas} | errors(name, found)


def of_whole(report: dict[str, Any], name: str, what: str) -> list[float]:
    """A figure of a set in all runs at once."""
    return [float(run[what]) for row in report["whole"] if row["case"] == name for run in row["runs"]]


def markdown(report: dict[str, Any]) -> str:
    """A row for each order."""
    lines = [f"sfmapp {report['versions']['sfmapp']} at {report['commit']}; {report['cpu']}, {report['date']}.", ""]
    lines += [
        "| set | order | registered (all at once) | centres off, share of the size (all at once: mean, least, most) "
        "| ratio | rotations, degrees (all at once) | ratio | CPU s (all at once) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in report["rows"]:
        name, cells = row["case"], [row["case"], str(row["order"])]
        if "no_start" in row:
            lines.append(f"| {' | '.join(cells)} | no model of the first batch | | | | | |")
            continue
        registered, center, rotation, cpu = (
            of_whole(report, name, what) for what in ("registered", "center_share", "rotation_deg", "cpu_s")
        )
        lines.append(
            f"| {' | '.join(cells)} | {row['registered']} ({min(registered):.0f}) of {row['num']} "
            f"| {row['center_share']:.3e} ({np.mean(center):.3e}, {min(center):.3e} to {max(center):.3e}) "
            f"| {row['center_share'] / np.mean(center):.3f} | {row['rotation_deg']:.4f} ({np.mean(rotation):.4f}) "
            f"| {row['rotation_deg'] / np.mean(rotation):.3f} | {row['cpu_s']:.0f} ({np.mean(cpu):.0f}) |"
        )
    for row in report["merged"]:
        center, rotation = (of_whole(report, row["case"], what) for what in ("center_share", "rotation_deg"))
        text = f"Two halves of {row['case']} merged: {row['registered']} of {row['num']} photographs"
        beside = "" if not center else f", {row['center_share'] / np.mean(center):.3f} and "
        beside += "" if not center else f"{row['rotation_deg'] / np.mean(rotation):.3f} times all at once"
        off = f"centres off by {row['center_share']:.3e}, rotations by {row['rotation_deg']:.4f} degrees"
        lines += ["", f"{text}, {off}{beside}; shared ones {row['off_sigmas']:.1f} sigmas apart before."]
    for row in report["late"]:
        sides = ", ".join(str(n) for n in row["registered"])
        reasons = "; ".join(sorted({one["reason"] for one in row["left_over"] if one["model"] != 0}))
        text = f"Late link: {sides} views in the largest model after each batch. Those of the second: {reasons}."
        lines += ["", f"{text} Linked by the third: {len(row['linked'])}."]
    return "\n".join(lines)


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sets", nargs="*", default=SETS)
    parser.add_argument("--orders", type=int, default=3)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "adding.json")
    args = parser.parse_args()
    report: dict[str, Any] = describe_machine() | {"whole": [], "rows": [], "merged": [], "late": []}
    if args.output.exists():
        report = json.loads(args.output.read_text(encoding="utf-8"))

    def keep(part: str, row: dict[str, Any]) -> None:
        report[part].append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
        args.output.write_text(json.dumps(report, indent=1) + "\n")
        args.output.with_suffix(".md").write_text(markdown(report) + "\n")

    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        if not report["late"]:
            keep("late", measure_late_link(work / "late"))
        for name in set(HALVES) - {row["case"] for row in report["merged"]}:
            keep("merged", measure_merge(name, work / f"{name} halves"))
        for name in args.sets:
            if not any(row["case"] == name for row in report["whole"]):
                keep("whole", measure_whole(name, work / f"{name} whole"))
            done = [row["order"] for row in report["rows"] if row["case"] == name]
            for order in set(range(args.orders)) - set(done):
                keep("rows", measure(name, order, work / f"{name} {order}"))
    print(markdown(report))


if __name__ == "__main__":
    main()
