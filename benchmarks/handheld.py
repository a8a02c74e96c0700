"""Hand-held sequences of a rendered room, like 7-Scenes, against the exact truth and beside ORB-SLAM3.

    python benchmarks/handheld.py           # renders what is not there: minutes

Somebody stands in a furnished room and films to and fro for 16 seconds: 640x480 at 30 frames a second, blur of 12 ms,
noise, a wandering exposure; some sensors read row by row within 20 ms. The lens is given. Errors are those of all poses
after a similarity. ORB-SLAM3 runs where its wheel and a vocabulary are (see orb_slam3.py and orb_vocabulary.py); its
frames come eight times slower than the sequence, so that its mapping keeps up on a busy machine.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cases import measure_cases
from machine import ROOT
from odometry import Case, run_orb_slam3, run_sfmapp
from orb_slam3 import vocabulary

# seeds of room and motion, and milliseconds from the first row to the last
SEQUENCES = {
    "room 0, rows within 20 ms": (0, 20),
    "room 1": (1, 0),
    "room 2, rows within 20 ms": (2, 20),
}
FRAMES, SLOW = 480, 8.0
FIGURES = ("num_frames", "num_in_largest_map", "num_keyframes", "live_ate_m", "ground_truth", "cpu_ms_per_frame",
           "process_cpu_ms_per_frame", "peak_memory_mb", "exit_code")  # fmt: skip


def rendered(seed: int, readout_ms: int) -> Path:
    """The folder of a sequence, which is made if it is not there; half of one is none."""
    folder = ROOT / "out" / "rendered" / f"handheld-{FRAMES}-{seed}-{readout_ms}"
    if not folder.is_dir():
        half = folder.with_name(f".{folder.name}.{os.getpid()}")
        folder.parent.mkdir(parents=True, exist_ok=True)
        script = [sys.executable, str(ROOT / "benchmarks" / "render_sequences.py"), "handheld", str(half)]
        script += ["--frames", str(FRAMES), "--seed", str(seed), "--readout", str(readout_ms / 1000)]
        subprocess.run(script, check=True, stdout=sys.stderr)
        half.rename(folder)
    return folder


def measured(name: str) -> Iterator[dict[str, Any]]:
    """One run of each program."""
    folder = rendered(*SEQUENCES[name])
    for path in folder.rglob("*.png"):  # nobody shall wait for the disk
        path.read_bytes()
    case, options = Case(name, folder, ("--mono",)), argparse.Namespace(seed=0, threads=None, set=[])
    with tempfile.TemporaryDirectory() as work:
        ours = run_sfmapp(case, Path(work) / "out", options)
        yield {"case": name, "program": "sfmapp"} | {key: ours.get(key) for key in FIGURES}
        words = vocabulary()
        if words is not None:
            theirs = run_orb_slam3(case, Path(work), SLOW)
            with words.open("rb") as lines:
                num_words = sum(1 for _ in lines) - 1
            yield {"case": name, "program": "ORB-SLAM3", "num_nodes": num_words} | {
                key: theirs.get(key) for key in FIGURES if key in theirs
            }


def markdown(report: dict[str, Any]) -> str:
    """One table."""
    lines = [
        f"sfmapp {report['versions']['sfmapp']} at {report['commit']}; {report['cpu']}, {report['cores']} cores, "
        f"{report['date']}. One run each; ORB-SLAM3 is not deterministic.",
        "",
        "| sequence | program | frames with a pose | ATE mm | live ATE mm | CPU ms a frame, whole process | peak MB |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in report["rows"]:
        truth, live = row["ground_truth"], row.get("live_ate_m")
        program = row["program"] + (f" ({row['num_nodes']:,} words)" if row.get("num_nodes") else "")
        lines.append(
            f"| {row['case']} | {program} | {row['num_in_largest_map']} of {row['num_frames']} "
            f"| {'-' if truth is None else format(1000 * truth['ate_m']['rmse'], '.2f')} "
            f"| {'-' if live is None else format(1000 * live, '.1f')} "
            f"| {row['process_cpu_ms_per_frame']:.1f} | {row['peak_memory_mb']:.0f} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    measure_cases("handheld", __doc__, list(SEQUENCES), measured, markdown)
