"""Whole command against the ground truth: `sfmapp odometry` on real and rendered sequences, and pycolmap beside it if
asked.

    python benchmarks/odometry.py                     # kitti00-200 forward, in steps of two, backwards; rendered ones
    python benchmarks/odometry.py --rendered 0 --peer # real data alone, and pycolmap on every second frame (minutes)
    python benchmarks/odometry.py FOLDER ...          # sequences with a ground truth: KITTI, TUM, EuRoC
    python benchmarks/odometry.py --kitti DIR --euroc DIR --tum DIR   # all that are there, in the tables of papers,
                                                      # and ORB-SLAM3 beside, where it is: see orb_slam3.py

The command runs as a process of its own with its default options, without a recording; wall seconds, CPU seconds (user
and system, children included) and peak resident memory are those of the process, its start and its imports included.
Every case runs twice or more with the same seed: costs are medians, and the files have to be the same bytes. A run
before all of them compiles the kernels. See README.md for what the numbers mean.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal

import numpy as np

from machine import RESULTS, ROOT, describe_machine
from orb_slam3 import vocabulary
from published_sequences import find_published, published_tables
from sfmapp.errors import SfmError
from sfmapp.evaluation.measured import ProcessUsage, run_measured
from sfmapp.evaluation.second_opinion import CameraGroup, SecondOpinionOptions, ask_second_opinion
from sfmapp.evaluation.trajectory import (
    KITTI_LENGTHS_M,
    MIN_PAIRS,
    Trajectory,
    absolute_error,
    associate,
    kitti_drift,
    path_shares_m,
    statistics,
)
from sfmapp.events import Events
from sfmapp.formats.colmap import read_model
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import GroundTruth
from sfmapp.pipelines.evaluate import evaluate
from sfmapp.sequences.open import SequenceOptions, open_sequence

DATA = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
# one of each kind, as render_sequences.py lays them out
RENDERED = (
    ("street", ()),
    ("street", ("--mono",)),
    ("hall", ()),
    ("hall", ("--mono",)),
    ("room", ()),
    ("handheld", ()),
)
# what a run with the same seed has to write again byte for byte; other files hold times
REPEATABLE = ("trajectory*.tum", "trajectory.kitti*", "covariance.csv", "sparse/*/*.bin")


@dataclass(frozen=True)
class Case:
    """A sequence and how it is played."""

    name: str
    sequence: Path
    flags: tuple[str, ...] = ()


def find_cases(args: argparse.Namespace) -> list[Case]:
    """The given sequences; without any, kitti00-200 in three ways and the rendered ones."""
    if args.published:
        return [Case(sequence.name, sequence.folder, sequence.flags) for sequence in args.published]
    if args.folders:
        return [Case(folder.resolve().name, folder) for folder in args.folders]
    cases = []
    kitti = DATA / "kitti00-200"
    if kitti.is_dir():
        for name, flags in (("", ()), (" step 2", ("--step", "2")), (" backwards", ("--reverse",))):
            cases.append(Case(f"kitti00-200{name}", kitti, flags))
    for place, flags in RENDERED if args.rendered else ():
        folder = args.rendered_folder / f"{place}-{args.rendered}"
        cases.append(Case(" ".join([f"rendered {place}", *(flag.strip("-") for flag in flags)]), folder, flags))
    return cases


def render(folder: Path, frames: int) -> None:
    """Make a rendered sequence if it is not there; half of one is none."""
    if not folder.is_dir():
        half = folder.with_name(f".{folder.name}.{os.getpid()}")
        script = [sys.executable, str(ROOT / "benchmarks" / "render_sequences.py"), folder.name.partition("-")[0]]
        folder.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run([*script, str(half), "--frames", str(frames)], check=True, stdout=sys.stderr)
        half.rename(folder)


def run_sfmapp(case: Case, out: Path, args: argparse.Namespace) -> dict[str, Any]:
    """One run of the command in a fresh workspace."""
    script = Path(sys.executable).with_name("sfmapp")
    command = [str(script), "odometry", str(case.sequence), "-o", str(out), "--seed", str(args.seed), "-q"]
    command += ["--no-recording", *(["--threads", str(args.threads)] if args.threads else [])]
    command += [*case.flags, *(flag for setting in args.set for flag in ("--set", setting))]
    usage = run_measured(command, out.with_suffix(".log"))
    if usage.exit_code:
        tail = out.with_suffix(".log").read_text(errors="replace")[-2000:]
        print(f"{case.name}: sfmapp ended with code {usage.exit_code}:\n{tail}", file=sys.stderr)
    return asdict(usage) | report_numbers(out, usage) | ground_truth_numbers(out, case) | {"digest": digest(out)}


def report_numbers(out: Path, usage: ProcessUsage) -> dict[str, Any]:
    """What the run tells of itself."""
    try:
        report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {"num_frames": None}
    frames, maps, timing = report["frames"], report["maps"], report["timing"]
    count = max(frames["num_frames"], 1)
    return {
        "num_frames": frames["num_frames"],
        "num_with_pose": frames["num_with_pose"],
        "num_in_largest_map": frames["num_in_largest_map"],
        "num_maps": len(maps),
        "num_keyframes": maps[0]["num_keyframes"] if maps else 0,
        "unit": maps[0]["unit"] if maps else "",
        "process_cpu_ms_per_frame": 1e3 * usage.cpu_s / count,
        "cpu_ms_per_frame": timing["cpu_ms_per_frame"],
        "cpu_ms_by_part": timing.get("parts_cpu_ms"),
        "tracking_ms": timing.get("tracking_ms"),
        "live_ate_m": next((row["ate_m"]["rmse"] for row in report["ground_truth"] if row["poses"] == "live"), None),
    }


def ground_truth_numbers(out: Path, case: Case) -> dict[str, Any]:
    """Errors of the largest map by ``sfmapp evaluate``'s own code: with a scale of its own where it has no unit."""
    try:
        result = evaluate(out, case.sequence)
        unit = json.loads((out / "report.json").read_text(encoding="utf-8"))["maps"][0]["unit"]
    except (SfmError, OSError, LookupError) as error:
        return {"ground_truth": None, "why": str(error)}
    if len(result.pairs) < MIN_PAIRS:
        return {"ground_truth": None, "why": f"{len(result.pairs)} poses say nothing of a trajectory"}
    errors = result.errors["se3" if unit == "m" else "sim3"]
    ate = statistics(errors.absolute.translation_m)
    assert ate is not None
    return {
        "ground_truth": {
            "alignment": "se3" if unit == "m" else "sim3",
            "ate_m": dict(ate),
            "ate_percent": 100 * ate["rmse"] / result.pairs.ground_truth.path_m,
            "scale": errors.absolute.scale,
            "path_m": result.pairs.ground_truth.path_m,
            "coverage": result.pairs.coverage,
            "drift_percent": errors.drift.t_rel_percent,
            "drift_deg_per_100m": 100 * errors.drift.r_rel_deg_per_m,
            "is_kitti_drift": not errors.is_by_share,
        }
    }


def digest(out: Path) -> str:
    """Of all files that have to be the same in a second run."""
    total = hashlib.blake2b(digest_size=16)
    for path in sorted({path for pattern in REPEATABLE for path in out.glob(pattern)}):
        total.update(f"{path.relative_to(out)}\n".encode())
        total.update(path.read_bytes())
    return total.hexdigest()


def run_peer(case: Case, work: Path, args: argparse.Namespace) -> dict[str, Any]:
    """pycolmap on every second frame of the first camera: exhaustive matching, starting from the known intrinsics."""
    sequence = open_sequence(case.sequence, SequenceOptions(mono=True), Events())
    frames = [(frame.name, frame.timestamp_s) for frame in sequence.frames()][::2]
    camera, ground_truth = sequence.rig.cameras[0], sequence.ground_truth
    names = [name for name, _ in frames]
    options = SecondOpinionOptions(seed=args.seed, num_threads=args.threads, camera_model=camera.model.name)
    group = CameraGroup(tuple(names), tuple(camera.params.tolist()))
    opinion = ask_second_opinion(case.sequence, names, work / "pycolmap", options, camera_groups=[group])
    values = {
        "exit_code": 0, "wall_s": opinion.wall_s, "cpu_s": opinion.cpu_s, "peak_memory_mb": opinion.peak_memory_mb,
        "num_frames": len(names), "num_with_pose": opinion.num_registered, "num_in_largest_map": opinion.num_registered,
        "process_cpu_ms_per_frame": 1e3 * opinion.cpu_s / max(len(names), 1), "ground_truth": None,
    }  # fmt: skip
    if opinion.model_folder is None or ground_truth is None:
        return values
    model = read_model(opinion.model_folder)[0]
    pose_of = dict(zip(model.image_names, model.cam_from_world, strict=True))
    poses = np.array([pose_of.get(name, np.full(7, np.nan)) for name in names])
    trajectory = Trajectory.from_cam_from_world(poses, [time for _, time in frames])
    return values | {"ground_truth": against(trajectory, ground_truth, "sim3")}


def run_orb_slam3(case: Case, work: Path, slow: float = 1.0) -> dict[str, Any]:
    """ORB-SLAM3, its start and the loading of its vocabulary included; with a scale of its own for one camera.

    Args:
        slow: how many times slower than the sequence it gets its frames.
    """
    out, is_mono = work / "orb_slam3.txt", "--mono" in case.flags
    command = [sys.executable, str(ROOT / "benchmarks" / "orb_slam3.py"), str(case.sequence), str(out)]
    command += ["--slow", f"{slow:g}"]
    usage = run_measured([*command, *(["--mono"] if is_mono else [])], work / "orb_slam3.log")
    sequence = open_sequence(case.sequence, SequenceOptions(mono=is_mono), Events())
    count = sequence.num_frames or 0
    values = asdict(usage) | {"num_frames": count, "num_in_largest_map": 0, "ground_truth": None,
                              "process_cpu_ms_per_frame": 1e3 * usage.cpu_s / max(count, 1)}  # fmt: skip
    if usage.exit_code or sequence.ground_truth is None:
        return values
    rows = np.loadtxt(out, ndmin=2)
    poses = rigid3.inverse(np.column_stack([rows[:, 4:], rows[:, 1:4]]))
    found = against(
        Trajectory.from_cam_from_world(poses, rows[:, 0]), sequence.ground_truth, "sim3" if is_mono else "se3"
    )
    return values | {"num_with_pose": len(rows), "num_in_largest_map": len(rows), "ground_truth": found}


def against(
    trajectory: Trajectory, ground_truth: GroundTruth, alignment: Literal["se3", "sim3"]
) -> dict[str, Any] | None:
    """What ``ground_truth_numbers`` has, of another program's trajectory; None of fewer poses than tell anything."""
    pairs = associate(
        trajectory, Trajectory.from_cam_from_world(ground_truth.cam_from_world, ground_truth.timestamps_s)
    )
    if len(pairs) < MIN_PAIRS:
        return None
    error, path = absolute_error(pairs, alignment), pairs.ground_truth.path_m
    ate, lengths_m = statistics(error.translation_m), KITTI_LENGTHS_M
    assert ate is not None
    is_long = path > lengths_m[0]
    drift = kitti_drift(pairs, scale=error.scale, lengths_m=lengths_m if is_long else path_shares_m(pairs))
    return {"alignment": alignment, "ate_m": dict(ate), "ate_percent": 100 * ate["rmse"] / path, "path_m": path,
            "scale": error.scale, "coverage": pairs.coverage, "drift_percent": drift.t_rel_percent,
            "drift_deg_per_100m": 100 * drift.r_rel_deg_per_m, "is_kitti_drift": is_long}  # fmt: skip


def measure(cases: Sequence[Case], args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """All runs of all cases."""
    for case in cases:
        if case.sequence.parent == args.rendered_folder:
            render(case.sequence, args.rendered)
        for path in case.sequence.rglob("*.png"):  # nobody shall wait for the disk
            path.read_bytes()
        for repeat in range(args.repeats):
            load = os.getloadavg()[0]
            with tempfile.TemporaryDirectory(dir=args.work) as work:
                run = run_sfmapp(case, Path(work) / "out", args)
            yield {"case": case.name, "program": "sfmapp", "repeat": repeat, "load_before": load} | run
        if args.published and vocabulary() is not None and "imu" not in case.flags:
            load = os.getloadavg()[0]
            with tempfile.TemporaryDirectory(dir=args.work) as work:
                run = run_orb_slam3(case, Path(work))
            yield {"case": case.name, "program": "ORB-SLAM3", "repeat": 0, "load_before": load} | run
        if args.peer and not case.flags:
            load = os.getloadavg()[0]
            with tempfile.TemporaryDirectory(dir=args.work) as work:
                try:
                    run = run_peer(case, Path(work), args)
                except SfmError as error:
                    print(f"{case.name}: pycolmap failed: {error}", file=sys.stderr)
                    continue
            yield {"case": case.name, "program": "pycolmap", "repeat": 0, "load_before": load} | run


def summaries(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each case and program: medians of the costs and the first run's results; failed runs are counted."""
    rows = []
    for case, program in dict.fromkeys((run["case"], run["program"]) for run in runs):
        chosen = [run for run in runs if (run["case"], run["program"]) == (case, program)]
        num_failed = sum(run["exit_code"] != 0 for run in chosen)
        chosen = [run for run in chosen if run["exit_code"] == 0] or chosen[:1]
        row = {key: chosen[0].get(key) for key in RESULT_KEYS}
        row |= {"case": case, "program": program, "num_failed": num_failed}
        for key in COST_KEYS:
            values = [run[key] for run in chosen if run.get(key) is not None]
            row[key] = median(values) if values else None
        digests = {run.get("digest") for run in chosen}
        row["same_bytes"] = None if len(chosen) < 2 else len(digests) == 1
        rows.append(row)
    return rows


COST_KEYS = ("wall_s", "cpu_s", "peak_memory_mb", "cpu_ms_per_frame", "process_cpu_ms_per_frame")
RESULT_KEYS = (
    "num_frames",
    "num_with_pose",
    "num_in_largest_map",
    "num_maps",
    "unit",
    "live_ate_m",
    "ground_truth",
    "exit_code",
)


def markdown(report: dict[str, Any]) -> str:
    """One table."""
    lines = [
        f"sfmapp {report['versions']['sfmapp']} at {report['commit']}, seed {report['seed']}, "
        f"{report['repeats']} runs; {report['cpu']}, {report['cores']} cores, {report['date']}.",
        "",
        "| sequence | frames in the largest map | ATE rmse m (% of path) | live ATE m | drift %, deg/100 m "
        "| CPU ms a frame (whole process) | frames/s | peak MB | same bytes |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in report["rows"]:
        ground_truth = row["ground_truth"] or {}
        ate = (
            f"{ground_truth['ate_m']['rmse']:.3g} ({ground_truth['ate_percent']:.2g} %) {ground_truth['alignment']}"
            if ground_truth
            else "-"
        )
        drift = (
            f"{ground_truth['drift_percent']:.2f}, {ground_truth['drift_deg_per_100m']:.2f}" if ground_truth else "-"
        )
        if ground_truth and not ground_truth["is_kitti_drift"]:
            drift += " *"
        speed = row["num_frames"] / row["wall_s"] if row["num_frames"] and row["wall_s"] else None
        same = {True: "yes", False: "NO", None: "-"}[row["same_bytes"]]
        name = row["case"] + {"sfmapp": "", "pycolmap": ", pycolmap on every second frame"}.get(
            row["program"], f", {row['program']}"
        )
        frames = f"{row['num_in_largest_map']} of {row['num_frames']}"
        if row["num_failed"]:
            frames += f" ({row['num_failed']} runs FAILED)"
        lines.append(
            f"| {name} | {frames} | {ate} | {_cell(row['live_ate_m'], '.3g')} | {drift} "
            f"| {_cell(row['cpu_ms_per_frame'], '.1f')} ({_cell(row['process_cpu_ms_per_frame'], '.1f')}) "
            f"| {_cell(speed, '.1f')} | {_cell(row['peak_memory_mb'], '.0f')} | {same} |"
        )
    loud = max((run["load_before"] for run in report["runs"]), default=0.0)
    lines += ["", f"Highest load average before a run: {loud:.1f}."]
    if any(row["ground_truth"] and not row["ground_truth"]["is_kitti_drift"] for row in report["rows"]):
        lines.append("\\* the path is too short for KITTI's stretches: over 10, 20, ..., 80 % of it.")
    return "\n".join(lines)


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def environment(args: argparse.Namespace) -> dict[str, Any]:
    """What the numbers depend on."""
    return describe_machine() | {
        "seed": args.seed,
        "repeats": args.repeats,
        "threads": args.threads,
        "settings": args.set,
    }


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folders", nargs="*", type=Path, help="sequences; default: kitti00-200 and rendered ones")
    for name, text in (("kitti", "KITTI odometry"), ("euroc", "EuRoC MAV"), ("tum", "TUM RGB-D")):
        parser.add_argument(
            f"--{name}", type=Path, metavar="DIR", help=f"play what is there of {text}; mono and stereo"
        )
    parser.add_argument(
        "--repeats", type=int, default=2, help="runs of each case; two tell whether the bytes are the same"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=None, help="default: the command's own choice")
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.OPTION=VALUE", help="option of sfmapp")
    parser.add_argument("--rendered", type=int, default=300, metavar="N", help="frames of each rendered one; 0: none")
    parser.add_argument("--rendered-folder", type=Path, default=ROOT / "out" / "rendered", help="where they are kept")
    parser.add_argument("--only", action="append", metavar="TEXT", help="only the cases with this in their names")
    parser.add_argument("--peer", action="store_true", help="pycolmap as well, on every second frame: minutes")
    parser.add_argument("--work", type=Path, default=None, help="folder for the workspaces, which are removed again")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=None,
        help="default: benchmarks/results/odometry.json; of --kitti, --euroc, --tum: out/published.json",
    )
    args = parser.parse_args()
    args.published = find_published(args.kitti, args.euroc, args.tum)
    report: dict[str, Any] = environment(args) | {"runs": []}
    output = args.output or (ROOT / "out" / "published.json" if args.published else RESULTS / "odometry.json")
    output.parent.mkdir(parents=True, exist_ok=True)
    cases = [case for case in find_cases(args) if not args.only or any(text in case.name for text in args.only)]
    if not cases:
        sys.exit(f"no sequence to play: none in {DATA}, none named")
    for case in [case for case in cases if case.sequence.is_dir()][:1]:  # compiles what no cache holds yet
        with tempfile.TemporaryDirectory(dir=args.work) as work:
            run_sfmapp(Case("warm", case.sequence, ("--stop", "40")), Path(work) / "out", args)
    for run in measure(cases, args):
        report["runs"].append(run)
        ground_truth = run["ground_truth"]
        print(f"{run['case']} {run['program']}: {run.get('num_in_largest_map')} of {run['num_frames']} frames, "
              f"ATE {ground_truth['ate_m']['rmse'] if ground_truth else None}, "
              f"{run['wall_s']:.1f} s wall, {run['cpu_s']:.1f} s CPU, "
              f"{run['peak_memory_mb']:.0f} MB", file=sys.stderr)  # fmt: skip
        report["rows"] = summaries(report["runs"])
        output.write_text(json.dumps(report, indent=1) + "\n")
    text = markdown(report)
    if args.published:
        text += "\n\n" + published_tables(args.published, report["rows"])
    output.with_suffix(".md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
