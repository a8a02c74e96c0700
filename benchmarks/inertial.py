"""What an IMU in the closing graph of odometry brings with one camera: rendered flights through halls, and its sigmas.

    python benchmarks/inertial.py --flights 40
    python benchmarks/inertial.py --only 1 4 7   # flown again, the others keep their rows

Each flight is tracked twice, with its IMU and without. The scale of the run with it is held against the true one in its
own standard deviations. The absolute error of both is after the best similarity (the run without has no metres), and of
the run with it also after the best rigid motion, in the metres that it states. Live errors, after the best similarity,
are those of the poses as they were given out while the map grew. Every third flight is blurred (exposed for 25 ms, not
6), every third one has a mounting that is wrong by a degree and centimetres. A row names the commit that it is of.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

import sfmapp
from machine import RESULTS, describe_machine
from rendered_worlds import sequences as rendered
from rendered_worlds.rendering import Optics
from rendered_worlds.sequences import RenderedSequence
from sfmapp.errors import SfmError
from sfmapp.evaluation.trajectory import Trajectory, absolute_error, associate
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu
from sfmapp.scene.rig import Rig

KINDS = ("plain", "blurred", "mounting wrong")
FPS = 20.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=40)
    parser.add_argument("--frames", type=int, default=160)
    parser.add_argument("--only", type=int, nargs="+", help="numbers of flights; the others keep their rows")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "inertial.json")
    args = parser.parse_args()
    by_number: dict[int, dict[str, Any]] = {}
    if args.only and args.output.exists():
        by_number = {run["flight"]: run for run in json.loads(args.output.read_text())["runs"]}
    machine, runs = describe_machine(), list[dict[str, Any]]()
    for number in args.only or range(args.flights):
        by_number[number] = fly(number, args.frames) | {"commit": machine["commit"]}
        print(described(by_number[number]), flush=True)
        runs = [by_number[n] for n in sorted(by_number)]
        args.output.write_text(json.dumps(machine | {"runs": runs}, indent=1) + "\n")
    args.output.with_suffix(".md").write_text(table(runs))
    print(table(runs))


def fly(number: int, num_frames: int) -> dict[str, Any]:
    """One flight, with and without its IMU."""
    kind = KINDS[number % len(KINDS)]
    exposure = 0.025 if kind == "blurred" else 0.006
    optics = Optics(noise_sigma=2.5, exposure_s=exposure, sub_exposures=8, vignetting=0.25)
    hall = rendered.hall(num_frames, number, optics)
    frames = [hall.image(k) for k in range(num_frames)]
    run: dict[str, Any] = {"flight": number, "kind": kind}
    camera = Rig.single(hall.rig.cameras[0])
    for name, imu in (("alone", None), ("inertial", sensor(hall, number, kind))):
        source = sfmapp.ArraySequence(frames, camera, timestamps_s=hall.timestamps_s, fps=FPS, imu=imu)
        try:
            result = sfmapp.track_sequence(source, seed=0)
        except SfmError as error:
            run[name] = {"failure": str(error)}
            continue
        run[name] = judged(result, hall)
    return run


def sensor(hall: RenderedSequence, number: int, kind: str) -> Imu:
    """Its measurements, and how it is said to be mounted."""
    found, mounting = hall.imu, hall.imu_from_cam
    assert found is not None
    assert mounting is not None
    if kind == "mounting wrong":
        rng = np.random.default_rng([number, 0x1F])
        off = rigid3.from_matrix(rigid3.exp_so3(0.01 * rng.normal(size=3)), 0.02 * rng.normal(size=3))
        mounting = rigid3.compose(off, mounting)
    return Imu(
        found.timestamps_s, found.gyro, found.accel, mounting,
        found.gyro_noise, found.accel_noise, found.gyro_walk, found.accel_walk,
    )  # fmt: skip


def judged(found: Any, hall: RenderedSequence) -> dict[str, Any]:
    """The largest map against the ground truth."""
    result = found.odometry
    frames = np.flatnonzero(result.frame_map == np.bincount(result.frame_map[result.frame_map >= 0]).argmax())
    times = hall.timestamps_s[result.frame_idx[frames]]
    pairs = associate(
        Trajectory.from_cam_from_world(result.cam_from_world[frames], times),
        Trajectory.from_cam_from_world(hall.cam_from_world, hall.timestamps_s),
    )
    live = Trajectory.from_cam_from_world(result.live_cam_from_world[frames], times)
    live_pairs = associate(live, Trajectory.from_cam_from_world(hall.cam_from_world, hall.timestamps_s))
    free, rigid = absolute_error(pairs, "sim3"), absolute_error(pairs, "se3")
    row: dict[str, Any] = {"num_frames": len(frames), "scale": 1.0 / free.scale}
    for name, errors in (("sim3", free), ("se3", rigid), ("live", absolute_error(live_pairs, "sim3"))):
        row[f"ate_{name}_mm"] = 1e3 * float(np.sqrt((errors.translation_m**2).mean()))
    entry = result.maps[result.frame_map[frames[0]]]
    row |= {"source": entry.scale_source, "sigma": entry.scale_sigma}
    if entry.contradictions:
        row["contradictions"] = [one.message for one in entry.contradictions]
    return row


def described(run: dict[str, Any]) -> str:
    """A flight in a line."""
    words = [f"{run['flight']} {run['kind']}:"]
    for name in ("alone", "inertial"):
        row = run[name]
        errors = row.get("failure") or f"{row['ate_sim3_mm']:.2f} mm, live {row['ate_live_mm']:.2f} mm"
        words.append(f"{name} {errors} ({row.get('num_frames', 0)} frames)")
    if is_metric(run):
        row = run["inertial"]
        words.append(f"in metres {row['ate_se3_mm']:.2f} mm, scale {row['scale']:.4f} +- {row['sigma']:.4f}")
    else:
        words.append(f"no metres: {run['inertial'].get('contradictions')}")
    return ", ".join(words)


def is_metric(run: dict[str, Any]) -> bool:
    return run["inertial"].get("sigma") is not None


def table(runs: list[dict[str, Any]]) -> str:
    """Each kind of flight in a row."""
    lines = [
        "Rendered flights of one camera with an IMU (`python benchmarks/inertial.py`), by images alone and with the",
        "measurements in windows and the closing graph. ATE over all frames, medians; scale errors in their stated",
        "sigmas. Live: ATE Sim3 of the poses as they were given out, of the flights that say it.",
        "",
        "| kind | flights | in metres | ATE Sim3 alone | with IMU | median of the ratios | ATE SE3 with IMU "
        "| sigma of the scale | scale errors, rms | inside 3 sigmas | live, flights | alone | with IMU "
        "| median of the ratios |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for kind in (*KINDS, "all"):
        mine = [run for run in runs if kind in (run["kind"], "all")]
        both = [(run["alone"], run["inertial"]) for run in mine if is_metric(run) and "scale" in run["alone"]]
        if not both:
            continue
        alone, ours = ([pair[n]["ate_sim3_mm"] for pair in both] for n in range(2))
        scores = [np.log(row["scale"]) / row["sigma"] for _, row in both]
        live = [[row["ate_live_mm"] for row in pair] for pair in both if all("ate_live_mm" in row for row in pair)]
        lines.append(
            f"| {kind} | {len(mine)} | {len(both)} | {np.median(alone):.2f} mm | {np.median(ours):.2f} mm "
            f"| {np.median(np.divide(ours, alone)):.2f} | {np.median([row['ate_se3_mm'] for _, row in both]):.2f} mm "
            f"| {100 * np.median([row['sigma'] for _, row in both]):.2f} % | {np.sqrt(np.mean(np.square(scores))):.2f} "
            f"| {sum(abs(score) < 3 for score in scores)} | {_live(live)} |"
        )
    return "\n".join(lines) + "\n"


def _live(errors: list[list[float]]) -> str:
    """Columns of live errors, by images alone and with the IMU."""
    if not errors:
        return "0 | | | "
    alone, ours = np.median(errors, axis=0)
    return f"{len(errors)} | {alone:.2f} mm | {ours:.2f} mm | {np.median([b / a for a, b in errors]):.2f}"


if __name__ == "__main__":
    main()
