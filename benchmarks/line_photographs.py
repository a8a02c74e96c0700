"""Calibration from lines of real photographs of built places whose focal length is known: how often it is told, and
how often what is told is right within its sigmas.

    python benchmarks/line_photographs.py [--each N]       writes results/line_photographs.md

The truth is that of the laser-registered cameras (fountain, herz, entry), of COLMAP's model (lund-door) and of KITTI's
calibration. Photographs of one camera are independent of each other here: one at a time.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

import cv2
import numpy as np

from machine import describe_machine
from sfmapp.calibration.lines import LinePicture, calibrate_from_lines
from sfmapp.errors import InputError

RESULTS = Path(__file__).parent / "results" / "line_photographs.md"
# so many standard deviations a right answer may be off
SIGMAS = 3.0


def places(data: Path, each: int) -> list[tuple[Path, float]]:
    """Photographs, so many of each place and spread over it, and their focal length in pixels."""
    found = []
    for folder, start in (
        ("herz-jesus-P8", ""), ("strecha-courtyard-21", "images/entry"), ("fountain-P11", ""), ("lund-door", "")
    ):  # fmt: skip
        cameras = json.loads((data / folder / "cameras.json").read_text())["cameras"]
        chosen = [camera for camera in cameras if camera["file"].startswith(start)]
        for k in np.unique(np.linspace(0, len(chosen) - 1, each).round().astype(int)):
            k_matrix = np.array(chosen[k]["K"])
            found.append((data / folder / chosen[k]["file"], float(k_matrix[[0, 1], [0, 1]].mean())))
    kitti = json.loads((data / "kitti00-200" / "calib.json").read_text())
    frames = sorted((data / "kitti00-200" / "image_0").iterdir())
    for k in np.unique(np.linspace(0, len(frames) - 1, each).round().astype(int)):
        found.append((frames[k], float(kitti["fx"])))
    return found


def main() -> None:
    """Measure and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--each", type=int, default=8, help="photographs of each place; default: 8")
    args = parser.parse_args()
    data, rows = Path(os.environ["SFMAPP_DATA"]), []
    told, right = 0, 0
    chosen = places(data, args.each)
    for path, focal in chosen:
        start = time.process_time()
        name = f"{path.relative_to(data).parts[0]} {path.name}"
        try:
            found = calibrate_from_lines([LinePicture(path.name, cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))])
        except InputError as error:
            why = str(error).partition("focal length: ")[2] or str(error)
            rows.append(f"| {name} | {focal:.0f} | refused | | | {why} | {time.process_time() - start:.0f} |")
            print(rows[-1], flush=True)
            continue
        bend, length, _ = found.report.parameters
        answer, off = "unknown", ""
        if length.verdict == "measured":
            sigmas = (length.value - focal) / length.sigma
            told, right = told + 1, right + (abs(sigmas) <= SIGMAS)
            answer = f"{length.value:.0f} +- {length.sigma:.0f}"
            off = f"{100.0 * (length.value / focal - 1.0):+.1f} % | {sigmas:+.1f}"
        rows.append(
            f"| {name} | {focal:.0f} | {answer} | {off or ' | '} | distortion {bend.value:.3f} +- {bend.sigma:.3f}, "
            f"{bend.verdict}; {length.reason} | {time.process_time() - start:.0f} |"
        )
        print(rows[-1], flush=True)
    machine = describe_machine()
    lines = [
        f"sfmapp {machine['versions']['sfmapp']} at {machine['commit']}, {machine['date']}",
        "",
        f"{len(chosen)} photographs: a focal length is told of {told}, right within {SIGMAS:g} sigmas of {right}; of "
        f"the other {len(chosen) - told} none is told.",
        "",
        "| photograph | focal length px | found | off | sigmas | what is said | CPU s |",
        "|---|---|---|---|---|---|---|",
        *rows,
    ]
    RESULTS.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
