"""A camera that is put down somewhere in a hall that looks the same after half a turn, with a map of that hall.

    python benchmarks/kidnapped.py             # 50 in the hall that the thresholds were chosen in, 50 in a fresh one
    python benchmarks/kidnapped.py --hall 3 --num 10 --drives 5

One walk round the hall makes the map; loop closing is off, as it takes equal bays for one (which this is not about).
Each kidnapping is a short walk from a place of its own: towards the one corner that has no like, anywhere, or in
another hall; drives go on round the hall until they have passed the corner. What is believed is right or surely wrong;
where nothing is believed it is undecided.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from machine import RESULTS, describe_machine
from rendered_worlds import symmetric
from rendered_worlds.sequences import RenderedSequence
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.images.sequence import Frame, GroundTruth, Imu
from sfmapp.odometry.map.known_map import KnownMap
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.run import Odometry, run_odometry
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]

CORNER, ANYWHERE, ELSEWHERE, DRIVE = "towards the corner", "anywhere", "another hall", "anywhere, on past the corner"
KINDS = (CORNER, ANYWHERE, ANYWHERE, ELSEWHERE, CORNER)
# A place is right within these: an eighth of a bay, which is the nearest look-alike.
MAX_OFF_M, MAX_OFF_DEG = 0.5, 5.0


@dataclass
class Played:
    """A rendered sequence as odometry plays it; images are rendered when they come."""

    rendered: RenderedSequence
    rig: Rig = field(init=False)
    kind: str = "arrays"
    source: str = "rendered"
    imu: Imu | None = None
    frames_per_second: float | None = symmetric.FRAMES_PER_SECOND
    num_frames: int | None = field(init=False)
    ground_truth: GroundTruth | None = None

    def __post_init__(self) -> None:
        self.rig, self.num_frames = self.rendered.rig, len(self.rendered)

    def frames(self) -> Iterator[Frame]:
        for idx, time_s in enumerate(self.rendered.timestamps_s):
            yield Frame(idx, f"{idx:06d}.png", float(time_s), (self.rendered.image(idx),))


@dataclass(frozen=True)
class Mapped:
    """A map of a hall, and the similarity (8,) that takes it to the truth."""

    known: KnownMap
    truth_from_map: Array
    rms_m: float


def make_map(hall: int) -> Mapped:
    """By one walk round."""
    played = Played(symmetric.walk_round(hall))
    result = run_odometry(played, OdometryOptions(loops=False), threads=1)  # type: ignore[arg-type]
    entry, inside = result.maps[0], result.frame_map == 0
    truth = played.rendered.cam_from_world[inside]
    fitted = similarity.align_poses(result.cam_from_world[inside], truth).b_from_a
    off = similarity.apply(fitted, rigid3.center(result.cam_from_world[inside])) - rigid3.center(truth)
    pictures = {
        int(image): played.rendered.image(int(frame))
        for image, frame in zip(entry.keyframe_image_idx, entry.keyframe_frame_idx, strict=True)
    }
    images = np.arange(len(entry.reconstruction.image_names), dtype=np.int64)[:, None]
    known = KnownMap(f"hall {hall}", entry.reconstruction, images, pictures)
    return Mapped(known, fitted, float(np.sqrt((off**2).sum(1).mean())))


def kidnapping(hall: int, number: int) -> tuple[str, RenderedSequence]:
    """What a number stands for: the kind, and a walk of 20 to 60 frames inside the hall."""
    rng, kind = np.random.default_rng([number, 77]), KINDS[number % len(KINDS)]
    num = int(rng.integers(20, 61))
    yaw = rng.uniform(-np.pi, np.pi)
    start = rng.uniform((-5.5, -2.0), (5.5, 2.0))
    if kind == CORNER:
        start = rng.uniform((1.0, -2.0), (5.0, 2.0))
        ahead = symmetric.CORNER - start
        yaw = np.arctan2(ahead[1], ahead[0]) + rng.uniform(-0.4, 0.4)
    inside = np.array([symmetric.HALF_LENGTH_M - 1.7, symmetric.HALF_WIDTH_M - 1.2])
    for _ in range(200):
        end = start + num * symmetric.STEP_M * np.array([np.cos(yaw), np.sin(yaw)])
        if (np.abs(end) < inside).all():
            break
        num, start = max(20, num - 1), 0.98 * start
    world = hall + 50 if kind == ELSEWHERE else hall
    return kind, symmetric.kidnapping(world, number, num, start, float(yaw))


def play(mapped: Mapped, kind: str, rendered: RenderedSequence, number: int) -> dict[str, Any]:
    """One kidnapping: what was believed first, and what it cost."""
    played = Played(rendered)
    odometry = Odometry(
        played, OdometryOptions(), seed=number, threads=1, events=Events(), known=mapped.known  # type: ignore[arg-type]
    )  # fmt: skip
    belief = odometry.recognition.belief
    assert belief is not None
    first, cpu = None, 0.0
    for frame in played.frames():
        begin = time.process_time()
        odometry.process(frame)
        cpu += time.process_time() - begin
        if first is None and belief.decided is not None:
            pose = similarity.transform_poses(mapped.truth_from_map, belief.decided.pose)
            first = frame.idx, pose
    row: dict[str, Any] = {
        "number": number, "kind": kind, "num_frames": len(rendered), "cpu_ms": 1e3 * cpu / len(rendered),
        "max_particles": belief.report().max_particles, "num_open": belief.report().num_open, "outcome": "undecided",
        "is_in_map": odometry.known is not None and odometry.known.is_entered(odometry.records),
    }  # fmt: skip
    if first is not None:
        idx, pose = first
        truth = rendered.cam_from_world[idx]
        turn = rigid3.rotation_matrix(pose) @ rigid3.rotation_matrix(truth).T
        off, off_deg = np.linalg.norm(rigid3.center(pose) - rigid3.center(truth)), rigid3.rotation_angle_deg(turn)
        is_right = kind != ELSEWHERE and off < MAX_OFF_M and off_deg < MAX_OFF_DEG
        row |= {"outcome": "right" if is_right else "surely wrong", "decided_after": idx + 1}
        row |= {"off_m": float(off), "off_deg": float(off_deg)}
    return row


def markdown(report: dict[str, Any]) -> str:
    """One table a hall."""
    lines = [f"sfmapp {report['versions']['sfmapp']} at {report['commit']}; {report['cpu']}, {report['date']}.", ""]
    lines += [
        "| hall | kidnapped | num | right | undecided | surely wrong | frames to decision, median (most) "
        "| off, median (most), m | CPU ms a frame | particles, most |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for hall in report["halls"]:
        for kind in (CORNER, ANYWHERE, DRIVE, ELSEWHERE):
            rows = [row for row in hall["rows"] if row["kind"] == kind]
            if not rows:
                continue
            num = [sum(r["outcome"] == o for r in rows) for o in ("right", "undecided", "surely wrong")]
            frames = [r["decided_after"] for r in rows if "decided_after" in r]
            off = [r["off_m"] for r in rows if r["outcome"] == "right"]
            cpu = np.mean([r["cpu_ms"] for r in rows])
            most = max(r["max_particles"] for r in rows)
            lines.append(
                f"| {hall['hall']} | {kind} | {len(rows)} | {num[0]} | {num[1]} | {num[2]} | {spread(frames, '.0f')} "
                f"| {spread(off, '.2f')} | {cpu:.0f} | {most} |"
            )
    maps = "; ".join(f"hall {h['hall']} {1e3 * h['map_rms_m']:.0f} mm" for h in report["halls"])
    lines += ["", f"Maps are off by (rms, after a similarity): {maps}. CPU: one thread of a loaded machine."]
    return "\n".join(lines)


def spread(values: list[float], form: str) -> str:
    """Median and largest."""
    return f"{np.median(values):{form}} ({max(values):{form}})" if values else "-"


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--hall", type=int, action="append", help="seed of a hall (default 0, which chose, and 1)")
    parser.add_argument("--num", type=int, default=50, help="kidnappings in each")
    parser.add_argument("--drives", type=int, default=10, help="of these that go on past the corner")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "kidnapped.json")
    args = parser.parse_args()
    report: dict[str, Any] = describe_machine() | {"halls": []}
    for hall in args.hall or [0, 1]:
        mapped = make_map(hall)
        entry: dict[str, Any] = {"hall": hall, "map_rms_m": mapped.rms_m, "rows": []}
        report["halls"].append(entry)
        walks = [(*kidnapping(hall, number), number) for number in range(args.num)]
        walks += [(DRIVE, symmetric.drive_past_corner(hall, number), number) for number in range(args.drives)]
        for kind, rendered, number in walks:
            entry["rows"].append(play(mapped, kind, rendered, number))
            print(json.dumps(entry["rows"][-1]), file=sys.stderr, flush=True)
            args.output.write_text(json.dumps(report, indent=1) + "\n")
            args.output.with_suffix(".md").write_text(markdown(report) + "\n")
    print(markdown(report))


if __name__ == "__main__":
    main()
