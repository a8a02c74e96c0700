"""What becomes of a camera that is not seen for a while: rendered halls of equal bays, rooms and blocks, and KITTI.

    python benchmarks/losses.py               # ten minutes of CPU time, much of it rendering
    python benchmarks/losses.py --only room   # this, beside what is there of the others

The lens is covered for some frames, or the frames after them are of another place that was seen before (carried, or a
cut where no frame is black).
Frames after that are in the map of before, right or surely wrong, in a map of their own, or have no pose. A frame is
wrong where it is farther than half a metre or five degrees from the truth, in a similarity that lays the frames before
the loss onto the truth; bays are 4 m apart. On drives, where that is drift, it is wrong beyond 3 m.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cases import measure_cases
from kidnapped import MAX_OFF_DEG, MAX_OFF_M, Played
from loops import INDOORS, ROAD, STILL, errors_of
from machine import ROOT
from rendered_worlds import sequences, symmetric
from sfmapp.events import Events
from sfmapp.images.sequence import Frame, Sequence
from sfmapp.odometry.options import OdometryOptions
from sfmapp.odometry.run import run_odometry
from sfmapp.scene.rig import Rig
from sfmapp.sequences.open import SequenceOptions, open_sequence

Array = NDArray[np.float64]

DATA = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
MAX_OFF_DRIVING_M = 3.0
HALL, EARLY, ROUNDS = "hall of equal bays", "hall of equal bays, after 2 s", "hall of equal bays, second round"
ROOM, CARRIED, BLOCK, KITTI = "room", "room, carried", "block", "kitti00-200, one camera"
BLOCK_CARRIED, KITTI_CARRIED = "block, carried", "kitti00-200, one camera, carried or cut"
HALL_CARRIED, EARLY_CARRIED = "hall of equal bays, carried", "half a hall of equal bays, carried to the other half"
# Frame at which the lens is covered, and for how many, by turns.
COVERED = ((60, 30), (110, 20), (200, 40), (150, 30), (250, 20), (85, 12))


@dataclass(frozen=True)
class Case:
    """A sequence with a loss.

    Attributes:
        first, count: frames that are black. goes_on_at: frame of the sequence that comes after them; None: the next.
        most: frames that are played after them at most.
    """

    kind: str
    seed: int
    sequence: Sequence
    truth: Array
    first: int
    count: int
    goes_on_at: int | None = None
    most: int | None = None

    @property
    def frames(self) -> NDArray[np.int64]:
        """Frames of the sequence in the order in which they are played."""
        after = self.first + self.count
        rest = np.arange(after if self.goes_on_at is None else self.goes_on_at, len(self.truth))
        return np.concatenate([np.arange(after), rest[: self.most]])


@dataclass
class Covered:
    """A sequence as odometry plays it, with the lens covered."""

    case: Case
    rig: Rig = field(init=False)
    kind: str = "arrays"
    source: str = "rendered"
    imu: None = None
    frames_per_second: float | None = None
    num_frames: int | None = field(init=False)
    ground_truth: None = None

    def __post_init__(self) -> None:
        self.rig, self.num_frames = self.case.sequence.rig, len(self.case.frames)
        self.frames_per_second = self.case.sequence.frames_per_second

    def frames(self) -> Iterator[Frame]:
        case, shown = self.case, list(self.case.sequence.frames())
        step = shown[1].timestamp_s - shown[0].timestamp_s
        for n, idx in enumerate(case.frames.tolist()):
            images = shown[idx].images
            if case.first <= n < case.first + case.count:
                images = tuple(np.zeros_like(image) for image in images)
            yield Frame(n, f"{n:06d}.png", n * step, images)


def find_cases() -> Iterator[Case]:
    """All of them."""
    for seed in range(10, 14):
        for n in (2 * seed, 2 * seed + 1):
            yield rendered(HALL, seed, symmetric.walk_round(seed), *COVERED[n % len(COVERED)])
    for seed in range(1, 5):
        yield rendered(EARLY, seed, symmetric.walk_round(seed), 20 + 10 * (seed % 2), 30)
    for seed in (0, 4):
        yield rendered(ROUNDS, seed, symmetric.walk_round(seed, 2.0), 420 + 20 * seed, 30)
    for seed in range(4):
        room = sequences.room(1000, seed, STILL, INDOORS)
        yield rendered(ROOM, seed, room, 200 + 50 * seed, 40)
        yield rendered(ROOM, seed, room, 850 + 10 * seed, 60)
        yield rendered(CARRIED, seed, room, 600, 20, 100 + 50 * seed)
    for seed in range(11, 14):
        walk = symmetric.walk_round(seed)
        for first, goes_on_at in ((200, 60), (200, 250)):
            yield rendered(HALL_CARRIED, seed, walk, first, 20, goes_on_at, 80)
        yield rendered(EARLY_CARRIED, seed, walk, 100 + 15 * (seed - 11), 20, 160 + 10 * (seed - 11), 80)
    block = sequences.street(620, 0, STILL, Rig.single(ROAD))
    for first, count in ((150, 10), (500, 10), (530, 15)):
        yield rendered(BLOCK, 0, block, first, count)
    for seed in range(3):
        block = sequences.street(220, seed, STILL, Rig.single(ROAD))
        for goes_on_at in (60, 120):
            yield rendered(BLOCK_CARRIED, seed, block, 200, 10, goes_on_at, 60)
    if (DATA / "kitti00-200").is_dir():
        kitti = open_sequence(DATA / "kitti00-200", SequenceOptions(mono=True), Events())
        assert kitti.ground_truth is not None
        truth = kitti.ground_truth.cam_from_world
        for first, count in ((60, 5), (100, 10), (120, 3), (150, 20), (100, 60)):
            yield Case(KITTI, 0, kitti, truth, first, count)
        for first, count, goes_on_at in ((100, 0, 110), (150, 10, 40), (150, 10, 90)):
            yield Case(KITTI_CARRIED, 0, kitti, truth, first, count, goes_on_at, 60)


def rendered(
    kind: str, seed: int, walk: sequences.RenderedSequence, first: int, count: int, goes_on_at: int | None = None,
    most: int | None = None,
) -> Case:  # fmt: skip
    """A case of a rendered walk."""
    return Case(kind, seed, Played(walk), walk.cam_from_world, first, count, goes_on_at, most)  # type: ignore[arg-type]


def play(case: Case) -> dict[str, Any]:
    """One run: where the frames after the loss are."""
    begin = time.process_time()
    result = run_odometry(Covered(case), OdometryOptions(), threads=1)  # type: ignore[arg-type]
    cpu = time.process_time() - begin
    truth, posed = case.truth[case.frames], np.isfinite(result.cam_from_world[:, 0])
    idx = np.arange(len(truth))
    before = (idx < case.first) & posed
    home = int(np.bincount(result.frame_map[before]).argmax())
    inside = posed & (result.frame_map == home)
    off, off_deg = errors_of(result, truth, before & inside)
    limit = MAX_OFF_DRIVING_M if case.kind in (BLOCK, BLOCK_CARRIED, KITTI, KITTI_CARRIED) else MAX_OFF_M
    after = idx >= case.first + case.count
    wrong = after & inside & ~((off < limit) & (off_deg < MAX_OFF_DEG))
    fitted, _ = errors_of(result, truth, inside)
    return {
        "case": case.kind, "seed": case.seed, "first": case.first, "count": case.count,
        "num_after": int(after.sum()), "num_wrong": int(wrong.sum()),
        "num_right": int((after & inside).sum() - wrong.sum()), "num_apart": int((after & posed & ~inside).sum()),
        "num_without": int((after & ~posed).sum()), "ate_m": float(np.sqrt((fitted[inside] ** 2).mean())),
        "relocalizations": result.report["relocalizations"], "losses": result.report["losses"], "cpu_s": cpu,
    }  # fmt: skip


def markdown(report: dict[str, Any]) -> str:
    """One row a kind."""
    lines = [f"sfmapp {report['versions']['sfmapp']} at {report['commit']}; {report['cpu']}, {report['date']}.", ""]
    lines += [
        "| what is lost | losses | frames after: right | in a map of their own | without a pose | surely wrong "
        "| losses with a wrong frame | map of before: ATE, median (most), mm | at |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for kind in dict.fromkeys(row["case"] for row in report["rows"]):
        rows = [row for row in report["rows"] if row["case"] == kind]
        right, apart, without, wrong = (
            sum(row[key] for row in rows) for key in ("num_right", "num_apart", "num_without", "num_wrong")
        )
        ate = [1e3 * row["ate_m"] for row in rows]
        lines.append(
            f"| {kind} | {len(rows)} | {right} | {apart} | {without} | {wrong} "
            f"| {sum(row['num_wrong'] > 0 for row in rows)} | {np.median(ate):.1f} ({max(ate):.1f}) "
            f"| {', '.join(sorted({row['commit'][:8] for row in rows}))} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, print, write."""
    cases = list(find_cases())
    measure_cases(
        "losses", __doc__, dict.fromkeys(case.kind for case in cases),
        lambda kind: (play(case) for case in cases if case.kind == kind), markdown,
    )  # fmt: skip


if __name__ == "__main__":
    main()
