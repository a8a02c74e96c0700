"""Live poses through the error-state filter on rendered flights with an IMU: innovations, errors and gaps in sigmas.

    python benchmarks/filtering.py --flights 8
    python benchmarks/filtering.py --only 3 5   # flown again, the others keep their rows

Every second flight is one of a stereo pair; those with a star were looked at while the filter was made. NIS is the
mean of normalised innovations squared, a degree of freedom, of all but the first five frames, rejected ones among
them, beside its 95 % interval; NEES is of every tenth frame, of what has come to the errors since the filter's first
row: what was wrong at that is the choice of a world. Beside stands the filter that takes the errors of poses for new
in each frame. Gaps are frames from the middle of the filtered flight on whose poses the filter is not given, of one and
the same run: their error is that at their last frame, of rotation and position about three axes each, in the standard
deviations that the filter states.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sfmapp
from machine import RESULTS, describe_machine
from rendered_worlds import sequences as rendered
from rendered_worlds.sequences import RenderedSequence
from sfmapp.errors import SfmError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu
from sfmapp.odometry.inertial.filtering import FilteredTrajectory, consistency
from sfmapp.odometry.residual_memory import NOT_KNOWN
from sfmapp.odometry.snapshot import FrameSnapshot
from sfmapp.pipelines.odometry.filtering import LiveFilter
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]

GAPS_S = (0.5, 1.0, 2.0, 3.0)
FPS = 20.0
# The first innovations hang on the velocity, of which nothing is known at the start.
_FIRST = 5
# Those before were looked at while the filter was made, and so were the ones named here.
FIRST_FLIGHT = 20
CHOSE = (20, 22, 24, 26)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=8)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--only", type=int, nargs="+", help="numbers of flights; the others keep their rows")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "filtering.json")
    args = parser.parse_args()
    by_number: dict[int, dict[str, Any]] = {}
    if args.only and args.output.exists():
        by_number = {run["flight"]: run for run in json.loads(args.output.read_text())["runs"]}
    machine, runs = describe_machine(), list[dict[str, Any]]()
    for number in args.only or range(FIRST_FLIGHT, FIRST_FLIGHT + args.flights):
        by_number[number] = fly(number, args.frames) | {"commit": machine["commit"]}
        runs = [by_number[n] for n in sorted(by_number)]
        args.output.write_text(json.dumps(machine | {"runs": runs}, indent=1) + "\n")
        print(json.dumps(by_number[number]), flush=True)
    args.output.with_suffix(".md").write_text(table(runs))
    print(table(runs))


def fly(number: int, num_frames: int) -> dict[str, Any]:
    """One flight, tracked once and filtered in several ways."""
    is_stereo = number % 2 == 1
    hall = rendered.hall(num_frames, number)
    assert hall.imu is not None
    assert hall.imu_from_cam is not None
    found, rig = hall.imu, hall.rig if is_stereo else Rig.single(hall.rig.cameras[0])
    with ThreadPoolExecutor(2) as pool:
        frames = list(pool.map(lambda k: tuple(hall.image(k, s) for s in range(len(rig.cameras))), range(num_frames)))
    imu = Imu(
        found.timestamps_s, found.gyro, found.accel, hall.imu_from_cam,
        found.gyro_noise, found.accel_noise, found.gyro_walk, found.accel_walk,
    )  # fmt: skip
    seen = list[FrameSnapshot]()
    source = sfmapp.ArraySequence(frames, rig, timestamps_s=hall.timestamps_s, fps=FPS, imu=imu)
    options = sfmapp.load_options(settings=["odometry.filter=true"])
    run: dict[str, Any] = {"flight": number, "cameras": len(rig.cameras), "frames": num_frames}
    try:
        sfmapp.track_sequence(source, options=options, on_frame=seen.append, seed=0)
    except SfmError as error:
        return run | {"failure": str(error)}
    told = filtered(seen, imu, is_stereo)
    if told is None:
        return run | {"failure": "the motion told too little to begin"}
    run |= {"begins_s": round(float(told.timestamps_s[0]), 3), "filter": judged(told, hall)}
    alone = [replace(frame, correlation=NOT_KNOWN) for frame in seen]
    naive = filtered(alone, imu, is_stereo)
    run["taken for new"] = judged(naive, hall) if naive is not None else None
    run["latency_ms"] = [round(1e3 * float(np.percentile(told.latency_s, q)), 3) for q in (50, 95, 100)]
    run["gaps"] = [row for gap_s in GAPS_S if (row := bridged(gap_s, seen, told, (imu, is_stereo), hall)) is not None]
    return run


def filtered(seen: list[FrameSnapshot], imu: Imu, is_stereo: bool) -> FilteredTrajectory | None:
    """Live poses as a run hands them on; None where the sensor never predicts."""
    beside = LiveFilter(imu, is_metric=is_stereo)
    for frame in seen:
        beside.add(frame)
    found = beside.finish(Events())
    return found[0] if found is not None and found[1].prediction == "imu" else None


def bridged(
    gap_s: float, seen: list[FrameSnapshot], told: FilteredTrajectory, sensor: tuple[Imu, bool], hall: RenderedSequence
) -> dict[str, Any] | None:
    """The end of a gap: its error and the six errors in their standard deviations; None where none fits."""
    first_s, last_s = float(told.timestamps_s[0]), float(told.timestamps_s[-1])
    begin_s = first_s + 0.3 * (last_s - first_s)
    if begin_s + gap_s > last_s:
        return None
    nothing = np.full(7, np.nan)
    frames = [
        replace(frame, cam_from_world=nothing) if begin_s <= frame.timestamp_s < begin_s + gap_s else frame
        for frame in seen
    ]
    found = filtered(frames, *sensor)
    if found is None:
        return None
    rows, error = errors(found, hall)
    inside = np.flatnonzero((found.timestamps_s[rows] >= begin_s) & (found.timestamps_s[rows] < begin_s + gap_s))
    last = inside[-1]
    ratio = error[last] / np.sqrt(np.diag(found.covariance[rows[last]]))
    return {
        "gap_s": gap_s,
        "error_mm": round(1e3 * float(np.linalg.norm(error[last, 3:])), 2),
        "sigma_mm": round(1e3 * float(found.position_sigma[rows[last]]), 2),
        "sigmas": np.round(ratio, 2).tolist(),
    }


def errors(found: FilteredTrajectory, hall: RenderedSequence) -> tuple[NDArray[np.int64], Array]:
    """Rows at frames, and the errors (N, 6) of their poses beyond that of the first, which places the world: rotation
    and translation of ``x_cam <- exp(w) x_cam + v``, radians and metres."""
    at = np.clip(np.searchsorted(found.timestamps_s, hall.timestamps_s), 0, len(found.timestamps_s) - 1)
    is_there = np.abs(found.timestamps_s[at] - hall.timestamps_s) < 1e-6
    # where a sample and a frame are of the same moment, the frame is the later row
    rows = np.searchsorted(found.timestamps_s, hall.timestamps_s[is_there] + 1e-6) - 1
    poses, truth = found.cam_from_world[rows], hall.cam_from_world[is_there]
    world = rigid3.compose(rigid3.inverse(truth[0]), poses[0])
    change = rigid3.compose(poses, rigid3.inverse(rigid3.compose(truth, world)))
    turned = rigid3.log_so3(rigid3.rotation_matrix(change))
    return rows, np.concatenate([turned, change[:, 4:]], 1)


def judged(found: FilteredTrajectory, hall: RenderedSequence) -> dict[str, Any]:
    """Innovations and errors against what is stated of them, a degree of freedom."""
    told = consistency(found.nis[_FIRST:])
    assert told is not None
    rows, error = errors(found, hall)
    some = np.arange(10, len(rows), 10)
    covariance = found.covariance[rows[some]]
    nees = (error[some] * np.linalg.solve(covariance, error[some][..., None])[..., 0]).sum(1) / 6.0
    return {
        "num": told.num_innovations,
        "nis": round(told.mean, 3),
        "bounds": [round(told.mean_low, 3), round(told.mean_high, 3)],
        "inside": round(told.share_inside, 3),
        "rejected": int(found.is_rejected.sum()),
        "nees": round(float(nees.mean()), 3),
        "error_mm": round(1e3 * float(np.sqrt((error[:, 3:] ** 2).sum(1).mean())), 2),
        "sigma_mm": round(1e3 * float(np.sqrt((found.position_sigma[rows] ** 2).mean())), 2),
    }


def table(runs: list[dict[str, Any]]) -> str:
    """A flight in a row, and the gaps of all together."""
    lines = [
        __doc__.split("\n\n")[0] + "\n",
        "| flight | frames | cameras | begins, s | NIS (95 % of runs) | taken for new | innovations inside 95 % "
        "| rejected | NEES | taken for new | error / sigma, mm |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for run in runs:
        if "failure" in run:
            lines.append(f"| {run['flight']} | {run['frames']} | {run['cameras']} | {run['failure']} | | | | | | | |")
            continue
        ours, other = run["filter"], run["taken for new"]
        low, high = ours["bounds"]
        lines.append(
            f"| {run['flight']}{'*' * (run['flight'] in CHOSE)} | {run['frames']} | {run['cameras']} "
            f"| {run['begins_s']:.2f} "
            f"| {ours['nis']:.2f} ({low:.2f} to {high:.2f}) "
            f"| {other['nis']:.2f} | {100 * ours['inside']:.0f} % | {ours['rejected']} | {ours['nees']:.1f} "
            f"| {other['nees']:.0f} | {ours['error_mm']:.1f} / {ours['sigma_mm']:.1f} |"
        )
    lines += ["", "| gap | flights | error / sigma, mm, medians | errors in sigmas, rms | beyond 3 of 6 errors each |"]
    lines.append("|---|---|---|---|---|")
    for gap_s in GAPS_S:
        gaps = [row for run in runs for row in run.get("gaps", []) if row["gap_s"] == gap_s]
        if gaps:
            ratios = np.abs([row["sigmas"] for row in gaps])
            middle = [np.median([row[name] for row in gaps]) for name in ("error_mm", "sigma_mm")]
            lines.append(
                f"| {gap_s:g} s | {len(gaps)} | {middle[0]:.1f} / {middle[1]:.1f} | {np.sqrt((ratios**2).mean()):.2f} "
                f"| {int((ratios > 3.0).sum())} of {ratios.size} |"
            )
    return "\n".join(lines) + "\n\n" + __doc__.split("\n\n")[2].strip() + "\n"


if __name__ == "__main__":
    main()
