"""The matching stage alone: CPU time, and the pairs that it verifies.

    python benchmarks/matching.py                        # shared sets and walks through rendered worlds
    python benchmarks/matching.py --before OTHER/src     # in turns with the package of another checkout

Features come before and are not counted, kernels are compiled, one thread. Pairs that the other package verifies and
this one does not are lost.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import sfmapp
from machine import RESULTS, ROOT, describe_machine
from rendered_worlds import sequences

DATA = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
SETS = (
    "temple-sparse-ring", "fountain-P11", "herz-jesus-P8", "strecha-courtyard-21", "lund-door", "opensfm-lund",
    "oxford-dinosaur", "nerf-lego-small", "sfmtool-seoul-bull",
)  # fmt: skip
# frames of a sequence, and every how many of them are a photograph
WALKS = {"room": (840, 12), "hall": (600, 8), "street": (450, 6)}


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sets", nargs="*", help="some of the sets; 'room:SEED' for a walk")
    parser.add_argument("--before", type=Path, help="src of another checkout, whose package is measured too")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "matching.json")
    args = parser.parse_args()
    if args.child:
        print(json.dumps(measure(Path(args.child))))
        return
    report = describe_machine() | {"before": commit_of(args.before), "sets": []}
    names = args.sets or [*(name for name in SETS if (DATA / name).is_dir()), *(f"{name}:0" for name in WALKS)]
    with tempfile.TemporaryDirectory() as work:
        for name in names:
            folder = DATA / name if ":" not in name else render(name, Path(work))
            row: dict[str, Any] = {"set": name, "now": in_child(folder, None)}
            if args.before:
                row["before"] = in_child(folder, args.before)
                row["num_lost"] = sum(pair not in row["now"]["pairs"] for pair in row["before"]["pairs"])
            report["sets"].append(row)
            print(line(row), flush=True)
            args.output.write_text(json.dumps(report) + "\n", encoding="utf-8")
    args.output.with_suffix(".md").write_text(markdown(report), encoding="utf-8")


def render(name: str, work: Path) -> Path:
    """Write the frames of a walk."""
    place, seed = name.split(":")
    num_frames, step = WALKS[place]
    sequence = getattr(sequences, place)(num_frames, int(seed))
    folder = work / name.replace(":", "-")
    (folder / "images").mkdir(parents=True)
    for frame in range(0, num_frames, step):
        cv2.imwrite(str(folder / "images" / f"{frame:04d}.png"), sequence.image(frame))
    return folder


def commit_of(source: Path | None) -> str:
    """Which commit the package of another checkout is at."""
    if source is None:
        return ""
    command = ["git", "-C", str(source), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def in_child(folder: Path, source: Path | None) -> dict[str, Any]:
    """:func:`measure` in a process of its own, by this package or another."""
    environment = dict(os.environ)
    if source is not None:
        environment["PYTHONPATH"] = os.pathsep.join([str(source.resolve()), str(ROOT / "benchmarks")])
    command = [sys.executable, __file__, "--child", str(folder)]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def measure(folder: Path) -> dict[str, Any]:
    """Match all pairs of a set, or those that are chosen of a large one."""
    images = sfmapp.load_images(folder / "images")
    features = sfmapp.extract_features(images)
    sfmapp.match_images(images, features, [(0, 1)])
    start = time.process_time()
    found = sfmapp.match_images(images, features, threads=1)
    cpu_s = time.process_time() - start
    pairs = np.asarray(found.pair_image_idx)[np.diff(found.pair_ptr) > 0].tolist()
    return {"num_images": len(images.images), "num_pairs": found.num_pairs, "cpu_s": cpu_s, "pairs": pairs}


def line(row: dict[str, Any]) -> str:
    """One set as a row of the table."""
    now, before = row["now"], row.get("before")
    cells = [f"{row['set']} ({now['num_images']}, {now['num_pairs']})"]
    cells.append(" / ".join(f"{run['cpu_s']:.2f}" for run in (now, before) if run))
    cells.append(f"{before['cpu_s'] / now['cpu_s']:.2f}" if before else "-")
    cells.append(" / ".join(str(len(run["pairs"])) for run in (now, before) if run))
    cells.append(str(row.get("num_lost", "-")))
    return "| " + " | ".join(cells) + " |"


def markdown(report: dict[str, Any]) -> str:
    """The table."""
    return "\n".join([
        f"sfmapp at {report['commit']}; {report['cpu']}, {report['date']}. CPU s of one thread.",
        f"Cells: now / at {report['before']}." if report["before"] else "",
        "",
        "| set (images, pairs) | CPU s | ratio | verified pairs | lost |",
        "|---|---|---|---|---|",
        *(line(row) for row in report["sets"]),
        "",
    ])  # fmt: skip


if __name__ == "__main__":
    main()
