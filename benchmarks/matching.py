"""The matching stage alone: CPU time, the pairs that it verifies, and how many of these are right.

    python benchmarks/matching.py                        # shared sets and walks through rendered worlds
    python benchmarks/matching.py --before OTHER/src     # in turns with the package of another checkout

Features come before and are not counted, kernels are compiled, one thread. A pair is right where the rotation between
its views is within 5 degrees of the truth and its direction within 20; a pair without a relative pose is not judged.
Pairs that an earlier package has right and this one does not have at all are lost.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import sfmapp
from machine import RESULTS, ROOT, describe_machine
from rendered_worlds import sequences
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.geometry import rigid3

DATA = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
SETS = (
    "temple-sparse-ring", "fountain-P11", "herz-jesus-P8", "strecha-courtyard-21", "lund-door", "opensfm-lund",
    "oxford-dinosaur", "nerf-lego-small",
)  # fmt: skip
# frames of a sequence, and every how many of them are a photograph
WALKS = {"room": (840, 12), "hall": (600, 8), "street": (450, 6)}
ROTATION_DEG, DIRECTION_DEG = 5.0, 20.0


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
    report = describe_machine() | {"sets": []}
    names = args.sets or [*(name for name in SETS if (DATA / name).is_dir()), *(f"{name}:0" for name in WALKS)]
    with tempfile.TemporaryDirectory() as work:
        for name in names:
            folder = DATA / name if ":" not in name else render(name, Path(work))
            row: dict[str, Any] = {"set": name, "now": in_child(folder, None)}
            if args.before:
                row["before"] = in_child(folder, args.before)
                right = {tuple(pair) for pair in row["now"]["pairs"]}
                row["num_lost"] = sum(tuple(pair) not in right for pair in row["before"]["right"])
            report["sets"].append(row)
            print(line(row), flush=True)
            args.output.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    args.output.with_suffix(".md").write_text(markdown(report), encoding="utf-8")


def render(name: str, work: Path) -> Path:
    """Write the frames of a walk, and where they were taken."""
    place, seed = name.split(":")
    num_frames, step = WALKS[place]
    sequence = getattr(sequences, place)(num_frames, int(seed))
    folder = work / name.replace(":", "-")
    (folder / "images").mkdir(parents=True)
    cameras = []
    for frame in range(0, num_frames, step):
        cv2.imwrite(str(folder / "images" / f"{frame:04d}.png"), sequence.image(frame))
        pose = sequence.cam_from_world[frame]
        rotation = rigid3.rotation_matrix(pose).tolist()
        cameras.append({"file": f"images/{frame:04d}.png", "R_w2c": rotation, "t_w2c": pose[4:].tolist()})
    (folder / "cameras.json").write_text(json.dumps({"cameras": cameras}), encoding="utf-8")
    return folder


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
    pairs = np.asarray(found.pair_image_idx)[np.diff(found.pair_ptr) > 0]
    names, right, wrong = [image.name for image in images.images], [], []
    truth = folder / "cameras.json"
    if truth.exists():
        reference = read_ground_truth(truth).for_images(names)
        known = dict(zip(reference.names, reference.cam_from_world, strict=True))
        for (i, j), pose in zip(pairs, found.cam2_from_cam1[np.diff(found.pair_ptr) > 0], strict=True):
            if np.isfinite(pose).all() and names[i] in known and names[j] in known:
                true = rigid3.compose(known[names[j]], rigid3.inverse(known[names[i]]))
                (right if agrees(pose, true) else wrong).append([int(i), int(j)])
    return {
        "num_images": len(names), "num_pairs": found.num_pairs, "cpu_s": cpu_s, "pairs": pairs.tolist(),
        "right": right, "num_wrong": len(wrong),
    }  # fmt: skip


def agrees(pose: NDArray[np.float64], true: NDArray[np.float64]) -> bool:
    """Whether a relative pose is that of the truth; a pair without translation has no direction."""
    turn = rigid3.rotation_matrix(pose) @ rigid3.rotation_matrix(true).T
    angle = math.degrees(math.acos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    lengths = np.linalg.norm(pose[4:]) * np.linalg.norm(true[4:])
    cosine = 1.0 if lengths == 0 else float(pose[4:] @ true[4:] / lengths)
    return angle < ROTATION_DEG and cosine > math.cos(math.radians(DIRECTION_DEG))


def line(row: dict[str, Any]) -> str:
    """One set as a row of the table."""
    now, before = row["now"], row.get("before")
    cells = [f"{row['set']} ({now['num_images']}, {now['num_pairs']})"]
    cells.append(" / ".join(f"{run['cpu_s']:.2f}" for run in (now, before) if run))
    cells.append(f"{before['cpu_s'] / now['cpu_s']:.2f}" if before else "-")
    cells.append(" / ".join(str(len(run["pairs"])) for run in (now, before) if run))
    cells.append(" / ".join(str(len(run["right"])) for run in (now, before) if run))
    cells.append(" / ".join(str(run["num_wrong"]) for run in (now, before) if run))
    cells.append(str(row.get("num_lost", "-")))
    return "| " + " | ".join(cells) + " |"


def markdown(report: dict[str, Any]) -> str:
    """The table."""
    return "\n".join([
        f"sfmapp at {report['commit']}; {report['cpu']}, {report['date']}. Cells: now / before, CPU s of one thread.",
        "",
        "| set (images, pairs) | CPU s | ratio | verified pairs | right | wrong | right before, lost now |",
        "|---|---|---|---|---|---|---|",
        *(line(row) for row in report["sets"]),
        "",
    ])  # fmt: skip


if __name__ == "__main__":
    main()
