"""Rendered sequences with one thing wrong that users get wrong: is the answer right, or does it say that it is not?

    python benchmarks/wrong_inputs.py                        # all faults, all worlds, two seeds: about an hour
    python benchmarks/wrong_inputs.py --only "focal" --seeds 5
    python benchmarks/wrong_inputs.py --only "street.*late" --frames 120

Sequences are rendered once into ``out/wrong_inputs`` and laid out as real data sets are; a fault changes what the
program is told (calibration, clocks, inertial samples) or some of the images, never the ground truth that the result is
held against. Every run is the whole command with default options. The error is that of the keyframes of the largest
map after the best alignment (SE(3) where the run has metres, else Sim(3)), and is divided by what the run states: the
root mean square of errors by that of the standard deviations, those of positions and of the scale together. A run is
SURE AND WRONG where no light is red and that quotient is above three.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from machine import RESULTS, ROOT, describe_machine
from render_sequences import LAYOUTS, WRITERS, write_images
from rendered_worlds import sequences as rendered
from rendered_worlds.motion import GRAVITY
from rendered_worlds.sequences import RenderedSequence
from sfmapp.camera.camera import Camera
from sfmapp.errors import SfmError
from sfmapp.evaluation.trajectory import Trajectory, absolute_error, associate
from sfmapp.geometry import rigid3
from sfmapp.odometry.result import OdometryResult
from sfmapp.pipelines.odometry.track import track_sequence
from sfmapp.report.model import OdometryRunReport
from sfmapp.workspace.options import load_options

Array = NDArray[np.float64]
# as many standard deviations as an honest statement is off by at most
MAX_SIGMAS = 3.0


@dataclass(frozen=True)
class Recorded(RenderedSequence):
    """A rendered sequence whose images come from files, so that what is told of them can be changed."""

    folder: Path = Path()
    source: Callable[[int, int], tuple[int, int]] = lambda frame, sensor: (frame, sensor)
    edit: Callable[[int, NDArray[np.uint8]], NDArray[np.uint8]] = lambda frame, image: image

    def image(self, frame: int, sensor: int = 0) -> NDArray[np.uint8]:
        """The image of a frame, which may be that of another one."""
        frame, sensor = self.source(frame, sensor)
        image = cv2.imread(str(picture(self.folder, frame, sensor)), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        return self.edit(frame, np.asarray(image, np.uint8))


@dataclass(frozen=True)
class Case:
    """A fault in a world: what it makes of the sequence, and the settings of the run."""

    name: str
    world: str
    fault: Callable[[Recorded], Recorded]
    settings: tuple[str, ...] = ()
    self_calibrate: bool = False


def picture(folder: Path, frame: int, sensor: int) -> Path:
    return folder / f"image_{sensor}" / f"{frame:06d}.png"


def record(world: str, seed: int, num_frames: int, work: Path) -> Recorded:
    """A sequence with its images on disk; rendered where they are not yet."""
    sequence: RenderedSequence = getattr(rendered, world)(num_frames, seed)
    folder = work / "images" / f"{world}-{seed}-{num_frames}"
    if not folder.is_dir():
        half = folder.with_name(f".{folder.name}.{os.getpid()}")
        for sensor in range(len(sequence.rig.cameras)):
            (half / f"image_{sensor}").mkdir(parents=True)
        write_images(sequence, lambda frame, sensor: picture(half, frame, sensor), 2)
        half.rename(folder)
    return Recorded(**{name: getattr(sequence, name) for name in RenderedSequence.__dataclass_fields__}, folder=folder)


# ------------------------------------------------------------------ faults


def focal_off(factor: float) -> Callable[[Recorded], Recorded]:
    """All cameras with focal lengths that are wrong by a factor."""

    def fault(sequence: Recorded) -> Recorded:
        cameras = tuple(scaled(camera, factor) for camera in sequence.rig.cameras)
        return replace(sequence, rig=replace(sequence.rig, cameras=cameras))

    return fault


def scaled(camera: Camera, factor: float) -> Camera:
    params = camera.params.copy()
    params[:2] *= factor  # PINHOLE and OPENCV begin with fx, fy
    return replace(camera, params=params)


def late(frames: int) -> Callable[[Recorded], Recorded]:
    """The second camera is some frames late, or early where that is negative."""

    def fault(sequence: Recorded) -> Recorded:
        first, count = max(frames, 0), len(sequence) - abs(frames)
        rows = first + np.arange(count)
        names = ("cam_from_world", "motion", "world_time_s", "gain", "noise_key", "place", "timestamps_s")
        kept = replace(sequence, **{name: getattr(sequence, name)[rows] for name in names})
        return replace(kept, source=lambda frame, sensor: (frame + first - frames * sensor, sensor))

    return fault


def swapped(sequence: Recorded) -> Recorded:
    """Left and right images exchanged; the calibration is not."""
    return replace(sequence, source=lambda frame, sensor: (frame, 1 - sensor))


def first_camera(sequence: Recorded) -> Recorded:
    """The first camera alone."""
    rig = replace(sequence.rig, cameras=sequence.rig.cameras[:1], cam_from_rig=sequence.rig.cam_from_rig[:1])
    return replace(sequence, rig=rig)


def inertia(change: Callable[[Array, Array, Array, Recorded], tuple[Array, Array, Array]]) -> Any:
    """Other inertial samples (times, gyro, accel) on one camera."""

    def fault(sequence: Recorded) -> Recorded:
        imu = sequence.imu
        assert imu is not None
        times, gyro, accel = change(imu.timestamps_s, imu.gyro, imu.accel, sequence)
        return first_camera(replace(sequence, imu=replace(imu, timestamps_s=times, gyro=gyro, accel=accel)))

    return fault


def without_gravity(times: Array, gyro: Array, accel: Array, sequence: Recorded) -> tuple[Array, Array, Array]:
    """As phones deliver it."""
    assert sequence.imu is not None
    rotation = rigid3.rotation_matrix(sequence.imu.imu_from_world)
    return times, gyro, accel - GRAVITY * rotation[:, :, 2]


def with_box(sequence: Recorded) -> Recorded:
    """Something textured that fills 60 % of the view sways before the camera for a third of the time."""
    skin = rendered.room(1, 9).image(0, 0)
    skin = np.asarray(cv2.resize(skin, (4000, 4000)), np.uint8)
    first, last = len(sequence) // 3, 2 * len(sequence) // 3

    def edit(frame: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if not first <= frame < last:
            return image
        height, width = image.shape
        y, x = int(height * 0.2), int(width * (0.12 + 0.1 * np.sin(frame / 9)))
        high, wide = int(height * 0.79), int(width * 0.76)
        image = image.copy()
        image[y : y + high, x : x + wide] = skin[900 : 900 + high, 900 : 900 + wide]
        return image

    return first_camera(replace(sequence, edit=edit))


def cases() -> list[Case]:
    found = []
    for world in ("room", "street", "hall"):
        found += [Case(f"{world} mono right", world, first_camera), Case(f"{world} box", world, with_box)]
        found.append(Case(f"{world} self-calibrate", world, first_camera, self_calibrate=True))
        for factor in (0.7, 0.9, 1.1, 1.3):
            fault = focal_off(factor)
            found.append(Case(f"{world} mono focal x{factor}", world, lambda s, f=fault: first_camera(f(s))))
        if world == "room":
            continue
        found.append(Case(f"{world} stereo right", world, lambda s: replace(s, imu=None)))
        stereo = {"focal x0.9": focal_off(0.9), "focal x1.1": focal_off(1.1), "late by 1": late(1),
                  "early by 1": late(-1), "late by 3": late(3), "swapped": swapped}  # fmt: skip
        found += [
            Case(f"{world} stereo {name}", world, lambda s, f=fault: f(replace(s, imu=None)))
            for name, fault in stereo.items()
        ]
    samples = {
        "right": lambda t, g, a, s: (t, g, a),
        "gravity subtracted": without_gravity,
        "axes permuted": lambda t, g, a, s: (t, g, a[:, [1, 2, 0]]),
        "all axes permuted": lambda t, g, a, s: (t, g[:, [1, 2, 0]], a[:, [1, 2, 0]]),
        "accelerometer negated": lambda t, g, a, s: (t, g, -a),
        "gyroscope negated": lambda t, g, a, s: (t, -g, a),
        "accelerometer in g": lambda t, g, a, s: (t, g, a / GRAVITY),
        "gyroscope in degrees": lambda t, g, a, s: (t, np.degrees(g), a),
        **{f"clock {d:+g} s": lambda t, g, a, s, d=d: (t + d, g, a) for d in (0.02, -0.02, 0.05, -0.05, 0.2)},
    }
    return found + [Case(f"hall imu {name}", "hall", inertia(change)) for name, change in samples.items()]


# ------------------------------------------------------------------ runs


def run(case: Case, seed: int, args: argparse.Namespace) -> dict[str, Any]:
    """One run of the command, and its verdict."""
    work = args.work / "run"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    sequence = case.fault(record(case.world, seed, args.frames, args.work))
    folder = work / "sequence"
    folder.mkdir()
    WRITERS[LAYOUTS[case.world]](sequence, folder, 2)
    if case.self_calibrate:
        for name in ("calib.json", "calib.txt", "mav0/cam0/sensor.yaml"):
            (folder / name).unlink(missing_ok=True)
    options = load_options(settings=[*case.settings, f"seed={seed}", "threads=2"])
    row: dict[str, Any] = {"case": case.name, "seed": seed}
    try:
        result, report = track_sequence(folder, work / "out", options, record=False, self_calibrate=case.self_calibrate)
    except SfmError as error:
        return row | {"verdict": "refused", "said": str(error)}
    return row | judged(result, report, sequence)


def judged(result: OdometryResult, report: OdometryRunReport, sequence: Recorded) -> dict[str, Any]:
    """The error of the largest map in metres and in what it states."""
    entry = result.maps[0]
    # how fast the machine was says nothing about the result
    red = [check.name for check in report.checks if check.light == "red" and not check.name.startswith("speed")]
    frames = np.searchsorted(result.frame_idx, entry.keyframe_frame_idx)
    poses = entry.reconstruction.cam_from_world[entry.keyframe_image_idx]
    pairs = associate(
        Trajectory.from_cam_from_world(poses, result.timestamps_s[frames] - result.timestamps_s[0]),
        Trajectory.from_cam_from_world(sequence.ground_truth, sequence.timestamps_s - sequence.timestamps_s[0]),
    )
    is_metric = entry.scale_source != "none"
    alignment, free = absolute_error(pairs, "se3" if is_metric else "sim3"), absolute_error(pairs, "sim3")
    centers = rigid3.center(poses)
    spread = float(np.sqrt(((centers - centers.mean(0)) ** 2).sum(1).mean()))
    variance = np.nan
    if entry.covariance is not None and np.isfinite(entry.covariance).any():
        diagonal = np.diagonal(entry.covariance[:, 3:, 3:], axis1=1, axis2=2).sum(1)
        variance = float(np.nanmean(diagonal)) + (spread * (entry.scale_sigma or 0.0)) ** 2
    # lengths of the map in the unit of the ground truth, so that sigmas can be compared with errors
    unit = 1.0 if is_metric else free.scale
    error, sigma = float(np.sqrt((alignment.translation_m**2).mean())), float(np.sqrt(variance)) * unit
    sigmas = error / sigma
    if is_metric and entry.scale_sigma:  # positions may be stated as unsure while the unit of length is not
        sigmas = max(sigmas, abs(np.log(free.scale)) / entry.scale_sigma)
    if red:  # no sigma at all claims nothing
        verdict = "said, but too sure" if sigmas > MAX_SIGMAS else "said"
    else:
        verdict = "right" if sigmas <= MAX_SIGMAS else "SURE AND WRONG"
    return {
        "verdict": verdict, "error_m": error, "sigma_m": sigma, "error_sigmas": sigmas, "scale": 1 / free.scale,
        "scale_sigma": entry.scale_sigma, "red": red, "num_frames": int((result.frame_map == 0).sum()),
        "path_m": pairs.ground_truth.path_m, "is_metric": is_metric,
    }  # fmt: skip


def measure(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for case in cases():
        if re.search(args.only, case.name):
            for seed in range(args.first_seed, args.first_seed + args.seeds):
                yield run(case, seed, args)


def line(row: dict[str, Any]) -> str:
    """A row of the table."""
    head = f"| {row['case']} | {row['seed']} | {row['verdict']} |"
    if "error_m" not in row:
        return f"{head} | | | | {row['said'][:110]} |"
    scale = f"{row['scale']:.3f}" + ("" if row["scale_sigma"] is None else f" +- {row['scale_sigma']:.2g}")
    return (
        f"{head} {row['error_m']:.3g} of {row['path_m']:.3g} | {row['error_sigmas']:.2g} |"
        f" {scale if row['is_metric'] else '-'} | {'; '.join(row['red'])} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="cases whose name matches this regular expression")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=160)
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "wrong_inputs")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "wrong_inputs.json", help="every run in numbers")
    args = parser.parse_args()
    rows = []
    print("| fault | seed | verdict | error m of path | in sigmas | scale | red |\n|---|---|---|---|---|---|---|")
    for row in measure(args):
        rows.append(row)
        print(line(row), flush=True)
    args.output.write_text(json.dumps(describe_machine() | {"runs": rows}, indent=1) + "\n")
    wrong = [row for row in rows if row["verdict"] == "SURE AND WRONG"]
    print(f"\n{len(rows)} runs, {len(wrong)} sure and wrong", file=sys.stderr)


if __name__ == "__main__":
    main()
