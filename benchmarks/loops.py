"""Loops that lead to their place, and to the like of it: rendered halls of equal bays, rooms and blocks.

    python benchmarks/loops.py               # a quarter of an hour of CPU time, most of it rendering
    python benchmarks/loops.py --only hall   # cases with this in their names

Each walk is played without loops and with them. A loop is right where it puts the newest keyframe, seen from the old
one, within half a metre and five degrees of the truth; bays are 4 m apart. Walks in halls are 1.1 rounds: 2.6 m of them
are seen again.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kidnapped import MAX_OFF_DEG, MAX_OFF_M, Played
from machine import RESULTS, describe_machine
from rendered_worlds import sequences, symmetric
from rendered_worlds.rendering import Optics
from rendered_worlds.sequences import RenderedSequence
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.events import Event, Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.result import OdometryResult
from sfmapp.odometry.run import run_odometry
from sfmapp.odometry.snapshot import MapSnapshot
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]

STILL = Optics(exposure_s=0.0, sub_exposures=1)
INDOORS = Camera(CameraModel.PINHOLE, 320, 240, np.array([262.5, 262.5, 160.0, 120.0]))
ROAD = Camera(CameraModel.PINHOLE, 620, 188, np.array([359.428, 359.428, 303.8464, 92.85785]))
# Keyframes on each side of the old one that tell its unit of length.
_NEAR = 8


def find_cases() -> Iterator[tuple[str, int, RenderedSequence]]:
    """Kinds of walks, seeds and walks."""
    for seed in range(10):
        yield "hall of equal bays", seed, symmetric.walk_round(seed)
    for seed in (0, 4):
        yield "hall of equal bays, two rounds", seed, symmetric.walk_round(seed, 2.0)
    for seed in range(4):
        yield "room", seed, sequences.room(1000, seed, STILL, INDOORS)
    yield "block", 0, sequences.street(620, 0, STILL, Rig.single(ROAD))


def play(rendered: RenderedSequence, loops: bool) -> dict[str, Any]:
    """One run: its error, and whether its loops are right."""
    offs: list[tuple[float, float]] = []

    def listen(event: Event) -> None:
        if event.message == "a loop is closed":
            offs.append(off(event.data["snapshot"], event.data["old_frame_idx"], rendered.cam_from_world))

    begin = time.process_time()
    result = run_odometry(
        Played(rendered),
        OdometryOptions(loops=loops),
        threads=1,
        events=Events(listen),  # type: ignore[arg-type]
    )
    cpu = time.process_time() - begin
    inside = (result.frame_map == 0) & np.isfinite(result.cam_from_world[:, 0])
    fitted, _ = errors_of(result, rendered.cam_from_world, inside)
    right = sum(m < MAX_OFF_M and deg < MAX_OFF_DEG for m, deg in offs)
    return {
        "ate_m": float(np.sqrt((fitted[inside] ** 2).mean())), "num_frames": len(rendered),
        "num_with_pose": int(inside.sum()), "num_right": right, "num_wrong": len(offs) - right, "offs": offs,
        "cpu_s": cpu,
    }  # fmt: skip


def errors_of(result: OdometryResult, truth: Array, fitted: NDArray[np.bool_]) -> tuple[Array, Array]:
    """(N,) metres and degrees by which frames are off once some of them are laid onto the truth."""
    moved = similarity.transform_poses(
        similarity.align_poses(result.cam_from_world[fitted], truth[fitted]).b_from_a, result.cam_from_world
    )
    turn = rigid3.rotation_matrix(moved) @ np.swapaxes(rigid3.rotation_matrix(truth), 1, 2)
    return np.linalg.norm(rigid3.center(moved) - rigid3.center(truth), axis=1), rigid3.rotation_angle_deg(turn)


def off(snapshot: MapSnapshot, old_frame_idx: int, truth: Array) -> tuple[float, float]:
    """Metres and degrees by which the newest keyframe of a map, seen from an old one, is off."""
    frames, poses = snapshot.keyframe_frame_idx, snapshot.keyframe_cam_from_world
    old = int(np.flatnonzero(frames == old_frame_idx)[0])
    near = slice(max(0, old - _NEAR), old + _NEAR + 1)
    metres = rigid3.spread(truth[frames[near]]) / rigid3.spread(poses[near])
    seen = rigid3.compose(poses[-1], rigid3.inverse(poses[old]))
    true = rigid3.compose(truth[frames[-1]], rigid3.inverse(truth[old_frame_idx]))
    turn = rigid3.rotation_matrix(seen) @ rigid3.rotation_matrix(true).T
    return float(np.linalg.norm(metres * rigid3.center(seen) - rigid3.center(true))), float(
        rigid3.rotation_angle_deg(turn)
    )


def markdown(report: dict[str, Any]) -> str:
    """One row a kind."""
    lines = [f"sfmapp {report['versions']['sfmapp']} at {report['commit']}; {report['cpu']}, {report['date']}.", ""]
    lines += [
        "| walks | num | loops right | loops wrong | walks without a loop | ATE without loops, median (most), mm "
        "| ATE with loops, mm | CPU s, without and with |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind in dict.fromkeys(row["kind"] for row in report["rows"]):
        rows = [row for row in report["rows"] if row["kind"] == kind]
        ate = [[1e3 * row[k]["ate_m"] for row in rows] for k in ("without", "with")]
        right, wrong = (sum(row["with"][k] for row in rows) for k in ("num_right", "num_wrong"))
        none = sum(not row["with"]["offs"] for row in rows)
        cpu = [np.mean([row[k]["cpu_s"] for row in rows]) for k in ("without", "with")]
        lines.append(
            f"| {kind} | {len(rows)} | {right} | {wrong} | {none} | {spread(ate[0])} | {spread(ate[1])} "
            f"| {cpu[0]:.1f}, {cpu[1]:.1f} |"
        )
    return "\n".join(lines)


def spread(values: list[float]) -> str:
    """Median and largest."""
    return f"{np.median(values):.1f} ({max(values):.1f})"


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", action="append", metavar="TEXT", help="only the cases with this in their names")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "loops.json")
    args = parser.parse_args()
    report: dict[str, Any] = describe_machine() | {"rows": []}
    for kind, seed, rendered in find_cases():
        if args.only and not any(text in kind for text in args.only):
            continue
        row = {"kind": kind, "seed": seed, "without": play(rendered, False), "with": play(rendered, True)}
        report["rows"].append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
        args.output.write_text(json.dumps(report, indent=1) + "\n")
        args.output.with_suffix(".md").write_text(markdown(report) + "\n")
    print(markdown(report))


if __name__ == "__main__":
    main()
