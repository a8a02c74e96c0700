"""Matchers of rectified pairs beside each other: errors against true disparities, density, CPU time.

    python benchmarks/stereo.py
    python benchmarks/stereo.py --sets cones "room, converging" --matchers StereoBM sfmapp -o /tmp/stereo.json
    python benchmarks/stereo.py --peer-python /tmp/peers/bin/python    # pip install pyelas pandora[sgm] there

Motorcycle, cones and aloe (Middlebury) and six rendered pairs, whose two cameras differ in noise and exposure; the last
two have disparities below zero. All matchers search the same disparities. Three errors are told, each over the pixels
that the other camera sees and over all whose disparity is known:

- *answered*: over pixels that the matcher gives a disparity; who answers less errs less, so the density stands beside.
- *wrong or none*: bad-1, where a pixel without an answer is wrong.
- *complete*: bad-1, bad-2 and the mean over every pixel, when holes are filled as KITTI's development kit fills those
  of everybody: by the lesser of the disparities beside them on the row.

Two things are told apart where there are any: pixels whose disparity was not searched, where who guesses higher errs
less (a tenth of the street, a car of 198 px of disparity); and truth in whole pixels (aloe), from which a matcher that
answers in whole pixels, as ELAS does, is never off by 1.2: there all answers are rounded as the truth is.

CPU times are those of all threads together. OpenCV is told to work with one; our matchers work with two.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from machine import RESULTS, describe_machine
from sfmapp.stereo.checks import fill_holes
from sfmapp.stereo.match import match_pair
from sfmapp.stereo.options import StereoOptions
from stereo_pairs import StereoSet, rendered_set, shared_sets, shots
from stereo_peers import ELSEWHERE, OPENCV, run_elsewhere

Disparity = NDArray[np.float32]

ROUNDS = 3  # the least of their times counts
OURS: dict[str, StereoOptions] = {
    "sfmapp": StereoOptions(),
    "sfmapp, filled": StereoOptions(fill=True),
    "sfmapp, refined": StereoOptions(refine=True),
    "sfmapp window": StereoOptions(matcher="window"),
    "sfmapp window, filled": StereoOptions(matcher="window", fill=True),
    "sfmapp window, fixed": StereoOptions(matcher="window", windows="fixed"),
    "sfmapp window, adaptive": StereoOptions(matcher="window", windows="adaptive"),
    "sfmapp window, shiftable": StereoOptions(matcher="window", windows="shiftable"),
    "sfmapp window, fixed, ZNCC": StereoOptions(matcher="window", windows="fixed", cost="zncc"),
    "sfmapp window, fixed, SAD": StereoOptions(matcher="window", windows="fixed", cost="sad"),
}


def scores(disparity: Disparity, case: StereoSet) -> dict[str, float]:
    """Densities and errors of the module's docstring, shares in percent."""
    out: dict[str, float] = {}
    full = fill_holes(disparity)
    for where, counted in (("visible", case.visible), ("all", np.isfinite(case.truth))):
        answered = counted & np.isfinite(disparity)
        error = np.abs(disparity - case.truth)[answered]
        out[f"density_{where}"] = 100.0 * float(answered.sum() / counted.sum())
        out |= _errors(error, f"answered_{where}")
        out[f"wrong_or_none_{where}"] = 100.0 * float(1.0 - (error <= 1.0).sum() / counted.sum())
        out |= _errors(np.abs(full - case.truth)[counted], f"complete_{where}")
        searched = counted & (case.truth > case.search[0] - 0.5) & (case.truth < sum(case.search) - 0.5)
        out[f"searched_{where}"] = 100.0 * float(searched.sum() / counted.sum())
        out |= _errors(np.abs(full - case.truth)[searched], f"searched_{where}")
        if np.array_equal(case.truth[counted], np.rint(case.truth[counted])):
            out |= _errors(np.abs(np.rint(full) - case.truth)[counted], f"whole_{where}")
    return out


def _errors(error: Disparity, name: str) -> dict[str, float]:
    if not len(error):
        error = np.full(1, np.nan, np.float32)
    bad = {f"bad{t}_{name}": 100.0 * float((error > t).mean()) for t in (1, 2)}
    return {**bad, f"mean_{name}": float(error.mean())}


def matchers(peer_python: Path | None) -> dict[str, Callable[[StereoSet], tuple[Disparity, float]]]:
    """By name, what gives the disparities of a set and the CPU seconds that they took."""
    out: dict[str, Callable[[StereoSet], tuple[Disparity, float]]] = {}
    for name, options in OURS.items():
        out[name] = timed(lambda case, options=options: ours(case, options))
    for name, peer in OPENCV.items():
        out[name] = timed(lambda case, peer=peer: peer(case.pair.left, case.pair.right, case.search))
    if peer_python is not None:
        for name in ELSEWHERE:
            out[name] = lambda case, name=name: run_elsewhere(
                peer_python, name, case.pair.left, case.pair.right, case.search
            )
    return out


def ours(case: StereoSet, options: StereoOptions) -> Disparity:
    """By one of our matchers, over the disparities that all search."""
    least, num = case.search
    return match_pair(case.pair, replace(options, min_disparity=least, num_disparities=num)).disparity


def timed(run: Callable[[StereoSet], Disparity]) -> Callable[[StereoSet], tuple[Disparity, float]]:
    """The same, with its least CPU time in a few rounds, the first of which only warms up."""

    def measured(case: StereoSet) -> tuple[Disparity, float]:
        found, least = run(case), np.inf
        for _ in range(ROUNDS):
            start = time.process_time()
            found = run(case)
            least = min(least, time.process_time() - start)
        return found, least

    return measured


def markdown(report: dict[str, Any]) -> str:
    """The tables."""
    about = f"{report['date']}, {report['commit']}, {report['cpu']}"
    if "kept" in report:
        about += f"; {'; '.join(report['kept']['matchers'])}: {report['kept']['date']}"
    lines = [
        "# Matchers of rectified pairs", "", about, "",
        "Bad-1 and bad-2: percent of pixels whose disparity is off by more than 1 or 2 px. The first three errors are",
        "of pixels that the matcher answers, among those that both cameras see. Complete: holes filled on their rows.",
        "CPU: of all threads together, two of ours and one of OpenCV's.", "",
    ]  # fmt: skip
    head = ("matcher", "density %", "bad-1", "bad-2", "mean px", "none or bad-1", "complete: bad-1", "bad-2", "mean px",
            "all: bad-1", "bad-2", "mean px", "CPU ms")  # fmt: skip
    keys = ("density_visible", "bad1_answered_visible", "bad2_answered_visible", "mean_answered_visible",
            "wrong_or_none_visible", "bad1_complete_visible", "bad2_complete_visible", "mean_complete_visible",
            "bad1_complete_all", "bad2_complete_all", "mean_complete_all", "cpu_ms")  # fmt: skip
    for name in dict.fromkeys(run["set"] for run in report["runs"]):
        runs = [run for run in report["runs"] if run["set"] == name]
        low, count = runs[0]["search"]
        lines += [f"## {name}, {runs[0]['width']} x {runs[0]['height']}, disparities {low} to {low + count - 1}", ""]
        lines += ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
        for run in runs:
            digits = (0 if key == "cpu_ms" else 3 if key.startswith("mean") else 2 for key in keys)
            cells = [f"{run[key]:.{n}f}" for key, n in zip(keys, digits, strict=True)]
            lines.append("| " + " | ".join([run["matcher"], *cells]) + " |")
        lines += ["", *_apart(runs)]
    return "\n".join(lines)


def _apart(runs: Sequence[dict[str, Any]]) -> list[str]:
    """Tables of pixels whose disparity was searched, and of answers rounded as the truth is."""
    lines: list[str] = []
    for kind in ("searched", "whole"):
        told = [run for run in runs if f"bad1_{kind}_all" in run and (kind == "whole" or run["searched_all"] < 99.9)]
        if not told:
            continue
        share = 100.0 - told[0].get("searched_all", 100.0)
        lines.append(
            f"Without the {share:.1f} % of pixels whose disparity was not searched, complete:"
            if kind == "searched" else "In whole pixels, as the truth is, complete:"
        )  # fmt: skip
        lines += ["", "| matcher | bad-1 | bad-2 | mean px | all: bad-1 | bad-2 | mean px |", "|" + "---|" * 7]
        for run in told:
            cells = [f"{run[f'{key}_{kind}_{where}']:.{3 if key == 'mean' else 2}f}"
                     for where in ("visible", "all") for key in ("bad1", "bad2", "mean")]  # fmt: skip
            lines.append("| " + " | ".join([run["matcher"], *cells]) + " |")
        lines.append("")
    return lines


def measure(
    names: Sequence[str] | None, wanted: Sequence[str] | None, peer_python: Path | None, root: Path
) -> list[dict[str, Any]]:
    """A row for each set and matcher; ``names``: of sets, ``wanted``: how names of matchers begin."""
    cases = list(shared_sets(root)) + [rendered_set(shot) for shot in shots() if not names or shot.name in names]
    runs = []
    for case in cases:
        if names and case.name not in names:
            continue
        height, width = case.truth.shape
        for matcher, run in matchers(peer_python).items():
            if wanted and not any(matcher.startswith(word) for word in wanted):
                continue
            found, cpu_s = run(case)
            row: dict[str, Any] = {"set": case.name, "matcher": matcher, "search": case.search}
            row |= {"width": width, "height": height, **scores(found, case), "cpu_ms": 1e3 * cpu_s}
            runs.append(row)
            print(f"{case.name:16} {matcher:26} density {row['density_visible']:5.1f}"
                  f" answered {row['bad1_answered_visible']:5.2f} {row['bad2_answered_visible']:5.2f}"
                  f" {row['mean_answered_visible']:5.3f} none or bad {row['wrong_or_none_visible']:5.2f}"
                  f" complete {row['bad1_complete_visible']:5.2f} all {row['bad1_complete_all']:5.2f}"
                  f" {row['cpu_ms']:7.0f} ms", flush=True)  # fmt: skip
    return runs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", help="names of sets; all without it")
    parser.add_argument("--matchers", nargs="+", help="how the names of matchers begin; all without it")
    parser.add_argument("--peer-python", type=Path, help="an interpreter that has elas and pandora")
    parser.add_argument("--keep", type=Path, help="results whose rows stand for what is not measured anew")
    parser.add_argument("-o", "--out", type=Path, default=RESULTS / "stereo.json")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    root = Path(os.environ.get("SFMAPP_DATA", "../shared/data"))
    runs = measure(args.sets, args.matchers, args.peer_python, root)
    kept: dict[str, Any] = {}
    if args.keep is not None:
        measured = {(run["set"], run["matcher"]) for run in runs}
        old = json.loads(args.keep.read_text(encoding="utf-8"))
        rows = [run for run in old["runs"] if (run["set"], run["matcher"]) not in measured]
        kept = {"kept": {"date": old["date"], "matchers": sorted({run["matcher"] for run in rows})}}
        runs += rows
    report = {**describe_machine(), **kept, "runs": runs}
    args.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    args.out.with_suffix(".md").write_text(markdown(report), encoding="utf-8")


if __name__ == "__main__":
    main()
