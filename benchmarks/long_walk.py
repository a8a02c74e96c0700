"""A walk of 10,000 frames: memory and CPU time while it grows, and what its end costs.

    python benchmarks/long_walk.py                     # CPU time: 4 minutes for the frames, one for the run
    python benchmarks/long_walk.py --frames 3000 --films FOLDER -o /tmp/walk.json

A hand-held camera of 320x240 goes round a rendered room again and again, at 30 frames a second, never quite the same
way. Frames come from a generator, and nothing of them is kept. Memory is what the process holds over that at frame
2,000, by when everything that is needed once is there; the end is all that comes after the last frame, the closing
adjustment before all.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sfmapp
from live import memory_mb
from machine import RESULTS, describe_machine
from rendered_worlds.rendering import Optics
from rendered_worlds.sequences import RenderedSequence, room
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.evaluation.trajectory import Trajectory, absolute_error, associate

Image = NDArray[np.uint8]

CAMERA = Camera(CameraModel.PINHOLE, 320, 240, np.array([262.5, 262.5, 160.0, 120.0]))
STEP, SETTLED = 500, 2000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--films", type=Path, help="folder that keeps the frames for the next time")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "long_walk.json")
    args = parser.parse_args()
    sequence = room(args.frames, 1, Optics(exposure_s=0.0, sub_exposures=1), CAMERA)
    with tempfile.TemporaryDirectory() as scratch:
        film = (args.films or Path(scratch)) / f"long-walk-{args.frames}.raw"
        if not film.exists():
            with film.with_suffix(".part").open("wb") as file:
                for frame in range(args.frames):
                    file.write(sequence.image(frame).tobytes())
            film.with_suffix(".part").rename(film)
        report = describe_machine() | measure(film, sequence)
    args.output.write_text(json.dumps(report, indent=1) + "\n")
    args.output.with_suffix(".md").write_text(table(report))
    print(table(report))


def measure(film: Path, sequence: RenderedSequence) -> dict[str, Any]:
    """The run, and the curve of memory and CPU time by frame."""
    curve: list[dict[str, float]] = []

    def frames() -> Iterator[Image]:
        image = np.empty((CAMERA.height, CAMERA.width), np.uint8)
        with film.open("rb") as file:
            for number in range(len(sequence)):
                if number % STEP == 0:
                    curve.append({"frame": number, "memory_mb": memory_mb(), "cpu_s": time.process_time()})
                file.readinto(memoryview(image))
                yield image
        curve.append({"frame": len(sequence), "memory_mb": memory_mb(), "cpu_s": time.process_time()})

    cpu_ms: list[float] = []
    result = sfmapp.track_sequence(
        sfmapp.ArraySequence(frames(), CAMERA), seed=0, on_frame=lambda snapshot: cpu_ms.append(1e3 * snapshot.cpu_s)
    )
    end, odometry = time.process_time(), result.odometry
    times = np.arange(len(sequence)) / 30.0
    known = np.isfinite(odometry.cam_from_world[:, 0]) & (odometry.frame_map == 0)
    pairs = associate(
        Trajectory.from_cam_from_world(odometry.cam_from_world[known], odometry.timestamps_s[known]),
        Trajectory.from_cam_from_world(sequence.ground_truth, times),
    )
    assert odometry.report is not None
    return {
        "num_frames": len(sequence), "num_with_pose": int(known.sum()),
        "num_keyframes": len(odometry.maps[0].keyframe_frame_idx), "num_loops": odometry.report.loops,
        "ate_mm": 1e3 * float(np.sqrt((absolute_error(pairs, "sim3").translation_m ** 2).mean())),
        "frame_cpu_ms": {"median": float(np.median(cpu_ms)), "p99": float(np.percentile(cpu_ms, 99)),
                         "most": max(cpu_ms[STEP:], default=float("nan"))},
        "end_cpu_s": end - curve[-1]["cpu_s"], "end_memory_mb": memory_mb(), "curve": curve,
    }  # fmt: skip


def table(report: dict[str, Any]) -> str:
    curve, frame = report["curve"], report["frame_cpu_ms"]
    settled = next((row["memory_mb"] for row in curve if row["frame"] >= SETTLED), curve[-1]["memory_mb"])
    lines = [
        __doc__.split("\n\n")[0] + "\n", __doc__.split("\n\n")[2].strip() + "\n",
        f"{report['num_with_pose']} of {report['num_frames']} frames have a pose, {report['num_keyframes']} keyframes, "
        f"{report['num_loops']} loops closed, ATE {report['ate_mm']:.1f} mm after a similarity. CPU ms of tracking a "
        f"frame: {frame['median']:.1f} in the middle, {frame['p99']:.0f} of one in a hundred, {frame['most']:.0f} at "
        f"most after the first {STEP}. The end took {report['end_cpu_s']:.1f} CPU s, reports included, and left "
        f"{report['end_memory_mb'] - settled:+.0f} MB.\n",
        "| frame | memory over that at frame 2,000, MB | CPU ms a frame since the row before |", "|---|---|---|",
    ]  # fmt: skip
    for before, row in zip([curve[0], *curve], curve, strict=False):
        spent = (row["cpu_s"] - before["cpu_s"]) / max(row["frame"] - before["frame"], 1)
        lines.append(f"| {row['frame']:,.0f} | {row['memory_mb'] - settled:+.0f} | {1e3 * spent:.1f} |")
    return "\n".join(lines) + f"\n\n{report['commit']}, {report['date'][:10]}, {report['cpu']}.\n"


if __name__ == "__main__":
    main()
