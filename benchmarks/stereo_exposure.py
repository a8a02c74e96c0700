"""Matchers of pairs whose two pictures are exposed differently: gain, gamma, vignetting, light from one side.

    python benchmarks/stereo_exposure.py

The right picture of each set is changed, the left one stays. Census (of semi-global matching and of windows) beside
ZNCC (of windows) and StereoSGBM, over the pixels that both cameras see.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from machine import RESULTS, describe_machine
from sfmapp.images.pixels import as_gray
from sfmapp.stereo.options import StereoOptions
from stereo import ours, scores
from stereo_pairs import rendered_set, shared_sets, shots

Floats = NDArray[np.float32]

SETS = ("motorcycle", "cones", "room", "gallery", "hall", "street")
MATCHERS = {
    "sfmapp": StereoOptions(),
    "sfmapp window, fixed": StereoOptions(matcher="window", windows="fixed"),
    "sfmapp window, fixed, ZNCC": StereoOptions(matcher="window", windows="fixed", cost="zncc"),
    "StereoSGBM": StereoOptions(matcher="opencv-sgbm"),
}
# by name: of grey values, and of columns and of squared distances from the middle, from 0 to 1, the changed values
CHANGES: dict[str, Callable[[Floats, Floats, Floats], Floats]] = {
    "none": lambda grey, column, radius: grey,
    "gain 0.5": lambda grey, column, radius: 0.5 * grey,
    "gain 1.6, saturated": lambda grey, column, radius: 1.6 * grey,
    "gamma 2": lambda grey, column, radius: 255.0 * (grey / 255.0) ** 2,
    "corners at 0.3": lambda grey, column, radius: grey * (1.0 - 0.7 * radius),
    "left side at 0.4": lambda grey, column, radius: grey * (0.4 + 0.6 * column),
}


def changed(picture: NDArray[np.uint8], change: str) -> NDArray[np.uint8]:
    """(H, W) as the other exposure has it."""
    height, width = picture.shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x, y = (x + 0.5) / width, (y + 0.5) / height
    radius = 2.0 * ((x - 0.5) ** 2 + (y - 0.5) ** 2)
    return np.clip(np.rint(CHANGES[change](picture.astype(np.float32), x, radius)), 0, 255).astype(np.uint8)


def markdown(report: dict[str, Any]) -> str:
    """The table."""
    lines = ["# Pairs that are exposed differently", "", f"{report['date']}, {report['commit']}, {report['cpu']}", ""]
    lines += ["Of pixels that both cameras see: density / bad-1 of answers / none or bad-1, %.", ""]
    lines += ["| set | right picture | " + " | ".join(MATCHERS) + " |", "|" + "---|" * (2 + len(MATCHERS))]
    for name in SETS:
        for change in CHANGES:
            runs = {run["matcher"]: run for run in report["runs"] if (run["set"], run["change"]) == (name, change)}
            if runs:
                cells = [f"{r['density']:.1f} / {r['bad1']:.2f} / {r['none_or_bad1']:.1f}" for r in runs.values()]
                lines.append(f"| {name} | {change} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, default=RESULTS / "stereo_exposure.json")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    root = Path(os.environ.get("SFMAPP_DATA", "../shared/data"))
    runs = []
    cases = [*shared_sets(root), *(rendered_set(shot) for shot in shots() if shot.name in SETS)]
    for case in (one for one in cases if one.name in SETS):
        left, right = as_gray(case.pair.left), as_gray(case.pair.right)
        for change in CHANGES:
            spoilt = replace(case, pair=replace(case.pair, left=left, right=changed(right, change)))
            for matcher, options in MATCHERS.items():
                told = scores(ours(spoilt, options), spoilt)
                row = {"density": told["density_visible"], "bad1": told["bad1_answered_visible"],
                       "none_or_bad1": told["wrong_or_none_visible"]}  # fmt: skip
                runs.append({"set": case.name, "change": change, "matcher": matcher, **row})
    report = {**describe_machine(), "runs": runs}
    args.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    args.out.with_suffix(".md").write_text(markdown(report), encoding="utf-8")
    print(markdown(report))


if __name__ == "__main__":
    main()
