"""A camera that does not wait: frames dropped, age of poses, memory and error in real time on a busy machine.

    python benchmarks/live.py                      # all cases; the rendered frames take some minutes first
    python benchmarks/live.py --cases "room, a busy core"

A thread plays frames out of a file in real time, whatever becomes of them: a rendered room of 640x480 there and back,
at 30 frames a second, and 200 frames of KITTI 00, of one camera, at their 10. A busy core is a process that counts;
the column load has how many processes wanted to run in all when a case began. Age is from when a frame was there until
its pose was known. Errors are after the best similarity, live of the poses as they were given out, and final; beside
them stands the run that had all frames and all the time it wanted. Memory is what the process holds, over that before
the first frame.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import tempfile
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sfmapp
from machine import RESULTS, describe_machine
from rendered_worlds import sequences as rendered
from sfmapp.camera.camera import Camera
from sfmapp.evaluation.trajectory import Trajectory, absolute_error, associate
from sfmapp.events import Events
from sfmapp.images.live_buffer import MAX_WAITING, LiveBuffer
from sfmapp.images.live_sequence import LiveSequence
from sfmapp.odometry.result import OdometryResult
from sfmapp.pipelines.odometry.live import LatencyLog
from sfmapp.reporting import to_json
from sfmapp.scene.rig import Rig
from sfmapp.sequences.open import SequenceOptions, open_sequence

Array = NDArray[np.float64]

PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 1e6


@dataclass(frozen=True)
class Film:
    """Frames in a file, one after another: (N, H, W) uint8; where they were taken, and in which order they are played.

    Attributes:
        order: (M,) int64 into the frames. cam_from_world: (N, 7). fps: that they are played at.
    """

    path: Path
    camera: Camera
    order: NDArray[np.int64]
    cam_from_world: Array
    fps: float


@dataclass(frozen=True)
class Case:
    """``waiting``: places for frames; None: all frames, one after another, without a clock."""

    film: str
    name: str
    busy: int
    waiting: int | None


def cases() -> list[Case]:
    """The same for both films: without a clock, live, beside one busy process, and with other numbers of places."""
    found = []
    for film in ("room", "kitti00-200"):
        found += [Case(film, f"{film}, nothing dropped", 0, None), Case(film, film, 0, MAX_WAITING)]
        found += [Case(film, f"{film}, a busy core", 1, MAX_WAITING)]
        found += [Case(film, f"{film}, {n} wait", 0, n) for n in (1, 4)]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=300, help="that are rendered; played there, back and there")
    parser.add_argument("--cases", nargs="+", help="names; the others keep their rows")
    parser.add_argument("--films", type=Path, help="folder that keeps the frames for the next time")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "live.json")
    args = parser.parse_args()
    rows: dict[str, dict[str, Any]] = {}
    if args.cases and args.output.exists():
        rows = {row["case"]: row for row in json.loads(args.output.read_text())["runs"]}
    machine = describe_machine()
    with tempfile.TemporaryDirectory() as scratch:
        films: dict[str, Film] = {}
        for case in cases():
            if args.cases and case.name not in args.cases:
                continue
            if case.film not in films:
                films[case.film] = film_of(case.film, args.frames, args.films or Path(scratch))
            # a process of its own, so that the memory is that of one run
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
                rows[case.name] = pool.submit(run, case, films[case.film]).result() | {"commit": machine["commit"]}
            runs = [rows[c.name] for c in cases() if c.name in rows]
            args.output.write_text(json.dumps(machine | {"runs": runs}, indent=1) + "\n")
            print(json.dumps(rows[case.name]), flush=True)
    args.output.with_suffix(".md").write_text(table(runs))
    print(table(runs))


def film_of(name: str, num_frames: int, folder: Path) -> Film:
    """The frames of a case, written where they are not there yet."""
    path = folder / f"{name}-{num_frames}.raw"
    if name != "room":
        options = SequenceOptions(mono=True)
        sequence = open_sequence(Path(os.environ["SFMAPP_DATA"]) / name, options, Events())
        truth = sequence.ground_truth
        assert truth is not None
        camera, poses, order = sequence.rig.cameras[0], truth.cam_from_world, np.arange(len(truth.cam_from_world))
        images = (frame.images[0] for frame in sequence.frames())
    else:
        room = rendered.room(num_frames)
        there = np.arange(num_frames)
        camera, poses, order = (
            room.rig.cameras[0],
            room.cam_from_world,
            np.concatenate([there, there[-2::-1], there[1:]]),
        )
        images = (room.image(k) for k in range(num_frames))
    if not path.exists():
        with (folder / "part").open("wb") as file:
            for image in images:
                file.write(image.tobytes())
        (folder / "part").rename(path)
    return Film(path, camera, order, poses, 30.0 if name == "room" else 10.0)


def run(case: Case, film: Film) -> dict[str, Any]:
    """One case, in a process of its own."""
    from sfmapp.workspace.kernels import compile_odometry_kernels

    compile_odometry_kernels(Events())
    stop = multiprocessing.Event()
    busy = [multiprocessing.Process(target=count, args=(stop,), daemon=True) for _ in range(case.busy)]
    for process in busy:
        process.start()
    memory, log = [memory_mb()], LatencyLog()
    try:
        row: dict[str, Any] = {"case": case.name, "load_average": os.getloadavg()[0]}
        if case.waiting is None:
            played = sfmapp.ArraySequence(frames_of(film, memory), film.camera, fps=film.fps)
            return row | judged(sfmapp.track_sequence(played, seed=0).odometry, film) | of_memory(memory)
        live = LiveSequence(Rig.single(film.camera), Events(), LiveBuffer(case.waiting))
        player = threading.Thread(target=play, args=(film, live, memory))
        player.start()
        result = sfmapp.track_sequence(live, on_frame=log.note, seed=0).odometry
        player.join()
    finally:
        stop.set()
    told = log.report(live.counts)
    return row | judged(result, film) | of_memory(memory) | {"live": json.loads(to_json(told))}


def count(stop: Any) -> None:
    """Keep a core busy."""
    number = 0
    while number % 1_000_000 or not stop.is_set():
        number += 1


def frames_of(film: Film, memory: list[float]) -> Any:
    """The frames as they are played."""
    camera = film.camera
    buffer = np.empty((camera.height, camera.width), np.uint8)
    with film.path.open("rb") as file:
        for number, k in enumerate(film.order.tolist()):
            file.seek(k * buffer.nbytes)
            file.readinto(memoryview(buffer))
            if number % 10 == 0:
                memory.append(memory_mb())
            yield buffer


def play(film: Film, live: LiveSequence, memory: list[float]) -> None:
    """Push each frame when it is due."""
    live.is_walked.wait()
    begin = time.monotonic()
    for number, image in enumerate(frames_of(film, memory)):
        time.sleep(max(0.0, begin + number / film.fps - time.monotonic()))
        live.push(image, number / film.fps)
    live.end("closed")


def memory_mb() -> float:
    return float(Path("/proc/self/statm").read_text().split()[1]) * PAGE_MB


def of_memory(memory: list[float]) -> dict[str, Any]:
    """What the run held over its start, by thirds of it: the most in each."""
    thirds = np.array_split(np.array(memory[1:]) - memory[0], 3)
    return {"memory_mb": [round(float(part.max()), 1) for part in thirds]}


def judged(result: OdometryResult, film: Film) -> dict[str, Any]:
    """The frames of the largest map against where they were taken."""
    times = np.arange(len(film.order)) / film.fps
    truth = Trajectory.from_cam_from_world(film.cam_from_world[film.order], times)
    mine = result.frame_map == 0
    row: dict[str, Any] = {
        "num_played": len(film.order),
        "num_with_pose": int(mine.sum()),
        "num_maps": len(result.maps),
    }
    for name, poses in (("final", result.cam_from_world), ("live", result.live_cam_from_world)):
        known = mine & np.isfinite(poses[:, 0])
        pairs = associate(Trajectory.from_cam_from_world(poses[known], result.timestamps_s[known]), truth)
        row[f"ate_{name}_mm"] = None  # of a map that fell apart
        if len(pairs) > 2:
            error = absolute_error(pairs, "sim3").translation_m
            row[f"ate_{name}_mm"] = round(1e3 * float(np.sqrt((error**2).mean())), 3)
    return row


def table(runs: list[dict[str, Any]]) -> str:
    head = (
        "| case | load | frames | dropped | with a pose | age of a pose, ms: median / 95 % / most "
        "| ATE live / final, mm | memory by thirds, MB |"
    )
    lines = [__doc__.split("\n\n")[0] + "\n", head, "|---|---|---|---|---|---|---|---|"]
    for row in runs:
        dropped, age = "-", "-"
        if (live := row.get("live")) is not None:
            dropped, ms = f"{live['num_dropped']}", live["latency_ms"]
            age = f"{ms['median']:.0f} / {ms['p95']:.0f} / {ms['max']:.0f}"
        errors = " / ".join(
            "-" if (ate := row[f"ate_{name}_mm"]) is None else f"{ate:.2f}" for name in ("live", "final")
        )
        memory = row["memory_mb"]
        lines.append(
            f"| {row['case']} | {row['load_average']:.0f} | {row['num_played']} | {dropped} | {row['num_with_pose']} "
            f"| {age} | {errors} | {' / '.join(f'{most:.0f}' for most in memory)} |"
        )
    return "\n".join(lines) + "\n\n" + __doc__.split("\n\n")[2].strip() + "\n"


if __name__ == "__main__":
    main()
