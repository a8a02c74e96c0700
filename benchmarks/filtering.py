"""Live poses through the error-state filter on rendered flights with an IMU: innovations, errors and gaps in sigmas.

    python benchmarks/filtering.py --flights 8
    python benchmarks/filtering.py --only 3 5   # flown again, the others keep their rows

Every second flight is one of a stereo pair; those from 100 on have pictures of half the size. Those with a star were
looked at while the filter was made. NIS is the mean of normalised innovations squared, a degree of freedom, of all but
the first five frames, rejected ones among them. Beside it stand the 95 % interval of independent ones, and that of as
many as they are worth: squares of innovations that last for some frames, and are spread more widely than chi-squared,
tell less, and by how much is the median of the *other* flights, so that no flight widens its own interval. Neighbours
are how innovations are correlated with those of the frame before; white ones lie within the number beside. NEES is of
every tenth frame, of what has come to the errors since the filter's first row: what was wrong at that is the choice of
a world. Beside stands the filter that takes the errors of poses for new in each frame. ATE is of the same frames, all
those that are filtered, of final poses, of poses as they were given out, and of filtered ones: after a similarity, and
of stereo pairs after a motion. Gaps are frames from the middle of the filtered flight on whose poses the filter is not
given, of one and the same run: their error is that at their last frame, of rotation and position about three axes each,
in the standard deviations that the filter states.
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
from scipy.stats import chi2, t

import sfmapp
from machine import RESULTS, describe_machine
from rendered_worlds import sequences as rendered
from rendered_worlds.rendering import Optics
from rendered_worlds.sequences import RenderedSequence
from sfmapp.errors import SfmError
from sfmapp.evaluation.trajectory import Trajectory, absolute_error, associate
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu
from sfmapp.odometry.inertial.filtering import FilteredTrajectory, consistency
from sfmapp.odometry.residual_memory import NOT_KNOWN
from sfmapp.odometry.result import OdometryResult
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
CHOSE = (20, 21, 22, 24, 26, 28, *range(100, 109), *range(110, 114))
FIRST_SMALL = 100


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
        judge_by_others(runs)
        args.output.write_text(json.dumps(machine | {"runs": runs}, indent=1) + "\n")
        print(json.dumps(by_number[number]), flush=True)
    args.output.with_suffix(".md").write_text(table(runs))
    print(table(runs))


def fly(number: int, num_frames: int) -> dict[str, Any]:
    """One flight, tracked once and filtered in several ways."""
    is_stereo, hall = number % 2 == 1, flown_hall(number, num_frames)
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
        tracked = sfmapp.track_sequence(source, options=options, on_frame=seen.append, seed=0).odometry
    except SfmError as error:
        return run | {"failure": str(error)}
    return run | filtered_flight(seen, tracked, imu, hall, is_stereo=is_stereo)


def flown_hall(number: int, num_frames: int) -> RenderedSequence:
    """The flight of a number."""
    if number < FIRST_SMALL:
        return rendered.hall(num_frames, number)
    optics = Optics(noise_sigma=2.5, exposure_s=0.006, sub_exposures=3, vignetting=0.25)
    rig = rendered.hall_rig()
    halved = [
        replace(c, width=c.width // 2, height=c.height // 2, params=c.params * np.repeat([0.5, 1.0], 4))
        for c in rig.cameras
    ]
    return rendered.hall(num_frames, number, optics, replace(rig, cameras=tuple(halved)))


def filtered_flight(
    seen: list[FrameSnapshot], tracked: OdometryResult, imu: Imu, hall: RenderedSequence, *, is_stereo: bool
) -> dict[str, Any]:
    """What the filter makes of the live poses of a run, and their errors beside those of the run."""
    run: dict[str, Any] = {}
    told = filtered(seen, imu, is_stereo)
    if told is None:
        return run | {"failure": "the motion told too little to begin"}
    run |= {"begins_s": round(float(told.timestamps_s[0]), 3), "filter": judged(told, hall)}
    run["ate_mm"] = ate(told, tracked, hall, is_stereo=is_stereo)
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
        replace(frame, cam_from_world=nothing) if begin_s <= frame.timestamp_s else frame
        for frame in seen
        if frame.timestamp_s < begin_s + gap_s
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
    nis = found.nis[_FIRST:]
    told = consistency(nis, found.innovation[_FIRST:])
    assert told is not None
    known = nis[np.isfinite(nis)]
    spread = float(known.var() / known.mean() ** 2) / (2.0 / 6.0)
    rows, error = errors(found, hall)
    some = np.arange(10, len(rows), 10)
    covariance = found.covariance[rows[some]]
    nees = (error[some] * np.linalg.solve(covariance, error[some][..., None])[..., 0]).sum(1) / 6.0
    return {
        "num": told.num_innovations,
        "nis": round(told.mean, 3),
        "bounds": [round(told.mean_low, 3), round(told.mean_high, 3)],
        "inside": round(told.share_inside, 3),
        "spread": round(spread, 3),
        "lasts_frames": round(told.num_innovations / told.num_independent, 3),
        "neighbours": None if told.correlation is None else round(told.correlation, 3),
        "white": round(told.max_correlation, 3),
        "rejected": int(found.is_rejected.sum()),
        "nees": round(float(nees.mean()), 3),
        "error_mm": round(1e3 * float(np.sqrt((error[:, 3:] ** 2).sum(1).mean())), 2),
        "sigma_mm": round(1e3 * float(np.sqrt((found.position_sigma[rows] ** 2).mean())), 2),
    }


def ate(
    found: FilteredTrajectory, tracked: OdometryResult, hall: RenderedSequence, *, is_stereo: bool
) -> dict[str, float | None]:
    """Absolute errors of the frames that are filtered, rms in millimetres, of each kind of poses."""
    rows, _ = errors(found, hall)
    times = found.timestamps_s[rows]
    mine = (tracked.frame_map == 0) & (np.abs(tracked.timestamps_s[:, None] - times).min(1) < 1e-6)
    truth = Trajectory.from_cam_from_world(hall.cam_from_world, hall.timestamps_s)
    out: dict[str, float | None] = {}
    for name, at_s, poses in (
        ("final", tracked.timestamps_s[mine], tracked.cam_from_world[mine]),
        ("live", tracked.timestamps_s[mine], tracked.live_cam_from_world[mine]),
        ("filtered", times, found.cam_from_world[rows]),
    ):
        known = np.isfinite(poses[:, 0])
        pairs = associate(Trajectory.from_cam_from_world(poses[known], at_s[known]), truth)
        error = absolute_error(pairs, "se3" if is_stereo else "sim3").translation_m
        out[name] = round(1e3 * float(np.sqrt((error**2).mean())), 2)
    return out


def judge_by_others(runs: list[dict[str, Any]]) -> None:
    """Add to each flight the 95 % interval of its NIS, by how many independent innovations those of the others are
    worth."""
    flown = [run for run in runs if "filter" in run]
    share = {run["flight"]: run["filter"]["spread"] * run["filter"]["lasts_frames"] for run in flown}
    for run in flown:
        others = [value for number, value in share.items() if number != run["flight"]]
        freedom = 6.0 * run["filter"]["num"] / max([1.0, *([float(np.median(others))] if others else [])])
        run["filter"]["worth_bounds"] = np.round(chi2.ppf([0.025, 0.975], freedom) / freedom, 3).tolist()


def table(runs: list[dict[str, Any]]) -> str:
    """A flight in a row, and the gaps of all together."""
    lines = [
        __doc__.split("\n\n")[0] + "\n",
        "| flight | frames | cameras | begins, s | NIS | independent | as these are | taken for new "
        "| neighbours (white) | rejected | NEES | taken for new | error / sigma, mm "
        "| ATE final / live / filtered, mm |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for run in runs:
        if "failure" in run:
            lines.append(f"| {run['flight']} | {run['frames']} | {run['cameras']} | {run['failure']}{' |' * 11}")
            continue
        ours, other, (low, high) = run["filter"], run["taken for new"], run["filter"]["bounds"]
        least, most = ours["worth_bounds"]
        naive = ("-", "-") if other is None else (f"{other['nis']:.2f}", f"{other['nees']:.0f}")
        lines.append(
            f"| {run['flight']}{'*' * (run['flight'] in CHOSE)} | {run['frames']} | {run['cameras']} "
            f"| {run['begins_s']:.2f} | {ours['nis']:.2f} | {low:.2f} to {high:.2f} | {least:.2f} to {most:.2f} "
            f"| {naive[0]} | {ours['neighbours']:.2f} ({ours['white']:.2f}) | {ours['rejected']} | {ours['nees']:.1f} "
            f"| {naive[1]} | {ours['error_mm']:.1f} / {ours['sigma_mm']:.1f} "
            f"| {' / '.join(f'{error:.1f}' for error in run['ate_mm'].values())} |"
        )
    lines += ["", of_all(runs)]
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


def of_all(runs: list[dict[str, Any]]) -> str:
    """Flights as independent draws: the mean of their NIS, and its 95 % interval by how they scatter."""
    means = np.array([run["filter"]["nis"] for run in runs if "filter" in run])
    half = float(t.ppf(0.975, max(1, len(means) - 1)) * means.std(ddof=1) / np.sqrt(len(means)))
    return f"NIS over {len(means)} flights: {means.mean():.2f}, within {half:.2f} by how they scatter."


if __name__ == "__main__":
    main()
