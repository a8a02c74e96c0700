"""`sfmapp odometry --map` on second runs over a known map, on photographs of another day, and where the map is of
another place or the place has look-alikes.

    python benchmarks/known_maps.py                # kitti00-200 backwards, and rendered places
    python benchmarks/known_maps.py --only room    # cases with this in their names

Each case makes a map by one command and plays a sequence in it by another, both processes of their own. Errors are
those of the largest map after a similarity, as reports have them; beside them stands the same sequence without the map.
What is rendered has the same world in both runs, so that where the second run ends up in the frame of the first is
measured too: by the similarity that takes the first run to the truth, applied to the second.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from machine import RESULTS, ROOT, describe_machine
from render_sequences import write_tum_layout
from rendered_worlds import sequences as rendered
from rendered_worlds import textures
from rendered_worlds.motion import CAM_FROM_BODY
from rendered_worlds.rendering import World
from rendered_worlds.sequences import RenderedSequence
from rendered_worlds.worlds import Skin, WorldBuilder
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.evaluation.measured import run_measured
from sfmapp.formats.trajectory_input import read_tum
from sfmapp.geometry import rigid3, similarity

Array = NDArray[np.float64]

DATA = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
# of the street of equal houses: width of a house, and how many
HOUSE_M, NUM_HOUSES = 5.0, 10
FOUND, ELSEWHERE = "in the map", "not in the map"


@dataclass(frozen=True)
class Case:
    """A map and a sequence that is played in it.

    Attributes:
        name: for people. expected: ``in the map`` or ``not in the map``.
        mapped, played: give the folders of sequences, rendered where they are not there, and flags to play them with.
        is_of_photographs: the map is a reconstruction.
    """

    name: str
    expected: str
    mapped: tuple[Callable[[], Path], tuple[str, ...]]
    played: tuple[Callable[[], Path], tuple[str, ...]]
    is_of_photographs: bool = False


def equal_houses(seed: int = 0) -> World:
    """A street between two rows of houses that are the same, to the pixel, and a wall at one end that is not."""
    rng = np.random.default_rng([seed, 0x40E5])
    build = WorldBuilder(rng)
    fronts = [build.texture(textures.poster(rng, 512, 512)), build.texture(textures.machine(rng))]
    road = Skin(build.texture(textures.concrete(rng)), HOUSE_M)
    length = HOUSE_M * NUM_HOUSES
    for side, front in ((1.0, fronts[0]), (-1.0, fronts[1])):
        build.wall((length / 2, 3.0 * side, 3.0), (0, -side, 0), length, 6.0, Skin(front, HOUSE_M))
    things = [Skin(build.texture(textures.carton(rng))), Skin(build.texture(textures.books(rng)))]
    for x in np.arange(NUM_HOUSES) * HOUSE_M:  # the same before every house
        build.box((x + 1.2, 1.9, 0), (0.7, 0.7, 1.9), things[0], 20.0)
        build.box((x + 3.6, 2.4, 0), (0.9, 0.5, 1.3), things[1], -10.0)
    build.quad((0, 3.0, 0), (length, 0, 0), (0, -6.0, 0), road)
    build.wall((length, 0, 3.0), (-1, 0, 0), 6.0, 6.0, Skin(build.texture(textures.picture(rng))))
    return build.build()


def walk_past(world: World, first_m: float, last_m: float, seed: int) -> RenderedSequence:
    """Along the street of equal houses, looking at one side."""
    times = np.arange(60) / 30.0
    rng = np.random.default_rng([seed, 0x40E6])
    wobble = rng.uniform(0, 2 * np.pi, 4)

    def pose(t: Array) -> Array:
        x = first_m + (last_m - first_m) * t / times[-1]
        y, z = 0.1 * np.sin(2 * t + wobble[0]), 1.6 + 0.05 * np.sin(3 * t + wobble[1])
        yaw = np.pi / 2 + 0.06 * np.sin(2 * t + wobble[2])
        none = np.zeros_like(yaw)
        world_from_body = np.stack([none, none, np.sin(yaw / 2), np.cos(yaw / 2), x, y, z], 1)
        return rigid3.compose(CAM_FROM_BODY, rigid3.inverse(world_from_body))

    like = rendered.room(len(times), seed)
    return rendered._sequence("houses", world, like.rig, times, pose, np.ones(len(times)), like.optics, seed)


def find_cases(folder: Path) -> Iterator[Case]:
    """All of them."""
    kitti = DATA / "kitti00-200"
    if kitti.is_dir():
        yield Case(
            "kitti00-200, one camera, backwards",
            FOUND,
            (lambda: kitti, ("--mono",)),
            (lambda: kitti, ("--mono", "--reverse")),
        )
        yield Case(
            "kitti00-200, one camera, odd frames in the map of the even ones",
            FOUND,
            (lambda: kitti, ("--mono", "--step", "2")),
            (lambda: kitti, ("--mono", "--start", "1", "--step", "2")),
        )

    def sequence(name: str, make: Callable[[], RenderedSequence]) -> Callable[[], Path]:
        def folder_of_it() -> Path:
            out = folder / name
            if not out.is_dir():
                half = folder / f".{name}.{os.getpid()}"
                half.mkdir(parents=True)
                write_tum_layout(make(), half, 2)
                half.rename(out)
            return out

        return folder_of_it

    def walk(seed: int, num_frames: int) -> RenderedSequence:
        return rendered.room(num_frames, seed)

    def again() -> RenderedSequence:
        """Another walk, with noise and exposure of its own, in the first room."""
        return replace(walk(5, 300), worlds=walk(0, 200).worlds)

    def other_noise() -> RenderedSequence:
        backwards = walk(0, 200)._take(np.arange(200)[::-1])
        return replace(backwards, seed=11)

    def photographs() -> RenderedSequence:
        """Every eighth view, by a camera of a wider lens, darker."""
        camera = Camera(CameraModel.PINHOLE, 960, 720, np.array([620.0, 620.0, 480.0, 360.0]))
        taken = rendered.room(200, 0, camera=camera)._take(np.arange(0, 200, 8))
        return replace(taken, gain=0.7 * taken.gain, seed=12)

    room = sequence("room", lambda: walk(0, 200))
    back = sequence("room-back", other_noise)
    yield Case("room, the same walk backwards, other noise", FOUND, (room, ()), (back, ()))
    yield Case("room, another walk", FOUND, (room, ()), (sequence("room-again", again), ()))
    photos = sequence("room-photographs", photographs)
    yield Case("room, photographs by another camera, darker", FOUND, (photos, ()), (room, ()), True)
    yield Case("another room", ELSEWHERE, (room, ()), (sequence("room-other", lambda: walk(9, 150)), ()))
    houses = sequence("houses", lambda: walk_past(equal_houses(), 4.0, 19.0, 0))
    beyond = sequence("houses-beyond", lambda: walk_past(equal_houses(), 28.0, 38.0, 1))
    yield Case("equal houses, farther down the street", ELSEWHERE, (houses, ()), (beyond, ()))


def run(command: list[str], out: Path) -> dict[str, Any]:
    """One command; what its report says."""
    usage = run_measured([sys.executable, "-m", "sfmapp", *command, "-o", str(out), "-q"], out.with_suffix(".log"))
    path = out / "report.json"
    report = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return {"exit_code": usage.exit_code, "cpu_s": usage.cpu_s, "report": report}


def ate_of(report: dict[str, Any]) -> float | None:
    """Rmse of the largest map, metres."""
    rows = [row for row in report.get("ground_truth", []) if row["poses"] == "final"]
    return rows[0]["ate_m"]["rmse"] if rows else None


def off_in_frame(first: Path, second: Path, truths: tuple[Path, Path]) -> float | None:
    """Rmse in metres of the second run in the frame of the first, laid onto the truth as the first one is."""
    truth_from_map, poses, truth = None, np.zeros((0, 7)), np.zeros((0, 7))
    for out, folder in zip((first, second), truths, strict=True):
        if not (out / "trajectory.tum").is_file() or not (folder / "groundtruth.txt").is_file():
            return None
        times, poses = read_tum(out / "trajectory.tum")
        true_times, truth = read_tum(folder / "groundtruth.txt")
        near = np.abs(np.array(true_times, float)[None] - np.array(times, float)[:, None]).argmin(1)
        truth = truth[near]
        if truth_from_map is None:
            truth_from_map = similarity.align_poses(poses, truth).b_from_a
    assert truth_from_map is not None
    moved = similarity.apply(truth_from_map, rigid3.center(poses))
    return float(np.sqrt(((moved - rigid3.center(truth)) ** 2).sum(1).mean()))


def measure(case: Case, work: Path) -> dict[str, Any]:
    """A map, a sequence in it, and the sequence alone."""
    stem = "".join(c if c.isalnum() else "-" for c in case.name)
    first, second, alone = (work / f"{stem}-{kind}" for kind in ("map", "in-map", "alone"))
    source, flags = case.mapped[0](), case.mapped[1]
    if case.is_of_photographs:
        calib = json.loads((source / "calib.json").read_text())
        camera = ",".join(str(v) for v in (calib["fx"], calib["fy"], calib["cx"] + 0.5, calib["cy"] + 0.5))
        made = run(["reconstruct", str(source / "rgb"), "--camera", f"PINHOLE,{camera}"], first)
    else:
        made = run(["odometry", str(source), *flags, "--no-recording"], first)
    played, flags = case.played[0](), case.played[1]
    without = run(["odometry", str(played), *flags, "--no-recording"], alone)
    inside = run(["odometry", str(played), *flags, "--no-recording", "--map", str(first)], second)
    report = inside["report"]
    told = (report.get("stages", {}).get("odometry") or {}).get("known_map") or {}
    frames = report.get("frames") or {}
    row = {
        "case": case.name, "expected": case.expected, "exit_code": inside["exit_code"],
        "num_frames": frames.get("num_frames"), "num_with_pose": frames.get("num_with_pose"),
        "num_with_pose_alone": (without["report"].get("frames") or {}).get("num_with_pose"),
        "first_ate_m": ate_of(made["report"]), "alone_ate_m": ate_of(without["report"]), "ate_m": ate_of(report),
        "cpu_s": inside["cpu_s"], "alone_cpu_s": without["cpu_s"], "known_map": told,
        "contradicted": any(
            c["subject"] == "known map" for m in report.get("maps", []) for c in m["contradictions"]
        ),
    }  # fmt: skip
    if told.get("is_found") and not case.is_of_photographs:
        row["off_in_frame_m"] = off_in_frame(first, second, (source, played))
    return row


def markdown(report: dict[str, Any]) -> str:
    """One table."""
    lines = [
        f"sfmapp {report['versions']['sfmapp']} at {report['commit']}; {report['cpu']}, {report['date']}.", "",
        "| sequence | frames with a pose (alone) | in the map, new, elsewhere | ATE m: first run, alone, in the map "
        "| off in the first run's frame, m | disagreement, sigmas (position, rotation) | CPU s (alone) "
        "| as it should be | commit |",
        "|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in report["rows"]:
        told = row["known_map"]
        counts = ", ".join(str(told.get(k, "-")) for k in ("num_localised", "num_new", "num_elsewhere"))
        ates = ", ".join(cell(row[k]) for k in ("first_ate_m", "alone_ate_m", "ate_m"))
        sigmas = ", ".join(cell(told.get(k)) for k in ("position_sigmas", "rotation_sigmas"))
        right = "yes" if is_right(row) else "NO"
        red = ", red" if row["contradicted"] else ""
        lines.append(
            f"| {row['case']} | {row['num_with_pose']} of {row['num_frames']} ({row['num_with_pose_alone']}) "
            f"| {counts} | {ates} | {cell(row.get('off_in_frame_m'))} | {sigmas}{red} "
            f"| {row['cpu_s']:.1f} ({row['alone_cpu_s']:.1f}) | {right} "
            f"| {row['commit']} |"
        )
    lines += [
        "",
        "As it should be: found where it is in the map and not red, not found where it is elsewhere. CPU seconds are "
        "of whole processes on a loaded machine, kernels compiled before.",
    ]
    return "\n".join(lines)


def is_right(row: dict[str, Any]) -> bool:
    """Found where it is, not contradicted there, and not found where it is not."""
    found = bool(row["known_map"].get("is_found"))
    return found and not row["contradicted"] if row["expected"] == FOUND else not found


def cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", action="append", metavar="TEXT", help="only cases with this in their names")
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "known_maps", help="sequences and results")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "known_maps.json")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    machine, told = describe_machine(), {}
    if args.only and args.output.is_file():
        before = json.loads(args.output.read_text())
        told = {row["case"]: {"commit": before["commit"]} | row for row in before["rows"]}
    for case in find_cases(args.work / "sequences"):
        if args.only and not any(text in case.name for text in args.only):
            continue
        told[case.name] = {"commit": machine["commit"]} | measure(case, args.work)
        print(json.dumps(told[case.name]), file=sys.stderr)
        report: dict[str, Any] = machine | {"rows": list(told.values())}
        args.output.write_text(json.dumps(report, indent=1) + "\n")
        args.output.with_suffix(".md").write_text(markdown(report) + "\n")
    print(markdown(report))


if __name__ == "__main__":
    main()
