"""Calibration from lines of real photographs of built places whose focal length is known: how often it is told, and
how often what is told is right within its sigmas.

    python benchmarks/line_photographs.py [--each N]       writes results/line_photographs.md and .json

The truth is that of the laser-registered cameras (fountain, herz, entry), of COLMAP's model (lund-door) and of KITTI's
calibration. Photographs of one camera are independent of each other here: one at a time.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from machine import RESULTS, describe_machine
from sfmapp.calibration.lines import LinePicture, calibrate_from_lines
from sfmapp.errors import InputError

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
    data = Path(os.environ["SFMAPP_DATA"])
    report = {**describe_machine(), "photographs": []}
    chosen = places(data, args.each)
    for path, focal in chosen:
        start = time.process_time()
        row = {"photograph": f"{path.relative_to(data).parts[0]} {path.name}", "truth_px": focal, **told_of(path)}
        report["photographs"].append({**row, "cpu_s": time.process_time() - start})
        print(report["photographs"][-1], flush=True)
    (RESULTS / "line_photographs.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    (RESULTS / "line_photographs.md").write_text(table(report), encoding="utf-8")


def told_of(path: Path) -> dict[str, Any]:
    """What is said of the focal length in a photograph: with its sigma, or why it is not told."""
    picture = LinePicture(path.name, np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8))
    try:
        found = calibrate_from_lines([picture])
    except InputError as error:
        return {"is_refused": True, "why": str(error).partition("focal length: ")[2] or str(error)}
    length = found.report.parameters[1]
    told = {"focal_px": length.value, "sigma_px": length.sigma} if length.verdict == "measured" else {}
    return {"is_refused": False, **told, "why": length.reason}


def table(report: dict[str, Any]) -> str:
    """The results for a person."""
    rows = report["photographs"]
    told = [row for row in rows if "focal_px" in row]
    right = [row for row in told if abs(row["focal_px"] - row["truth_px"]) <= SIGMAS * row["sigma_px"]]
    refused = sum(row["is_refused"] for row in rows)
    lines = [
        f"sfmapp {report['versions']['sfmapp']} at {report['commit']}, {report['date']}",
        "",
        f"{len(rows)} photographs, one at a time: a focal length is told of {len(told)}, within {SIGMAS:g} sigmas of "
        f"{len(right)}; {refused} are refused, and of {len(rows) - len(told) - refused} it is said that it is unknown.",
        "",
        "| photograph | focal length px | found | off | sigmas | why | CPU s |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        answer = "refused | | " if row["is_refused"] else "unknown | | "
        if "focal_px" in row:
            off = row["focal_px"] - row["truth_px"]
            answer = f"{row['focal_px']:.0f} +- {row['sigma_px']:.0f} | {100.0 * off / row['truth_px']:+.1f} % | "
            answer += f"{off / row['sigma_px']:+.1f}"
        lines.append(f"| {row['photograph']} | {row['truth_px']:.0f} | {answer} | {row['why']} | {row['cpu_s']:.0f} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
