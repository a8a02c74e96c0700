"""One step of a global adjustment at the size of large sets: sfmapp, an earlier commit of it, and pycolmap's Ceres.

Problems are synthetic (:mod:`large_scenes`): a room in which nearly all photographs meet nearly all others, and a
street in which each meets its neighbours. Every program begins at the same state with the same observations, loss and
free parameters, in a process of its own. A step is the least of three: linearise and eliminate, solve, try. Ceres is
given as many steps; what it takes for its set-up is not counted, nor is what ours takes.

    python benchmarks/large_adjustment.py                                 # ours and Ceres, one thread and two
    python benchmarks/large_adjustment.py --base ../earlier-checkout      # and an earlier commit
    python benchmarks/large_adjustment.py --sets room-1000 --threads 1 -o /tmp/new.json
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from large_scenes import CAMERA, perturbed, room, street
from machine import RESULTS, ROOT, describe_machine

SETS = {
    "room-300": (room, 300, 600_000), "room-1000": (room, 1000, 2_100_000),
    "street-300": (street, 300, 200_000), "street-1000": (street, 1000, 700_000),
    "street-3000": (street, 3000, 2_000_000),
}  # fmt: skip
NUM_STEPS, DAMPING, LOSS_PX = 3, 1e-4, 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=[*SETS], choices=[*SETS])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--base", type=Path, help="a checkout of an earlier commit")
    parser.add_argument("--no-ceres", action="store_true")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "large_adjustment.json")
    parser.add_argument("--run", nargs=3, metavar=("PROGRAM", "THREADS", "FILE"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.run:
        program, threads, file = arguments.run
        run = run_ceres if program == "ceres" else run_sfmapp
        print(json.dumps(run(read_scene(Path(file)), int(threads))))
        return
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in arguments.sets:
            rows += compare(name, Path(folder) / f"{name}.npz", arguments)
    report = describe_machine() | {"rows": rows}
    arguments.output.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    arguments.output.with_suffix(".md").write_text(table(report), encoding="utf-8")


def compare(name: str, file: Path, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """The rows of one set."""
    make, num_images, num_observations = SETS[name]
    scene = perturbed(make(num_images, num_observations))
    tracks = scene.tracks
    np.savez(
        file, track=tracks.obs_track_idx, image=tracks.obs_image_idx, feature=tracks.obs_feature_idx, xy=tracks.obs_xy,
        poses=scene.cam_from_world, points=scene.point_xyz, params=scene.cameras[0].params,
    )  # fmt: skip
    lengths = np.diff(tracks.track_ptr)
    facts = {
        "set": name, "images": num_images, "points": tracks.num_tracks, "observations": tracks.num_observations,
        "products": int((lengths * (lengths + 1) // 2).sum()),
    }  # fmt: skip
    programs = [("sfmapp", ROOT, threads) for threads in arguments.threads]
    if arguments.base:
        programs.insert(0, ("before", arguments.base.resolve(), 1))
    if not arguments.no_ceres:
        programs.append(("ceres", ROOT, 1))
    rows = []
    for program, checkout, threads in programs:
        paths = [str(checkout / "src"), str(Path(__file__).parent)]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
        if program == "before" and "NUMBA_CACHE_DIR" in os.environ:
            environment["NUMBA_CACHE_DIR"] = os.environ["NUMBA_CACHE_DIR"] + "-before"
        command = [sys.executable, __file__, "--run", program, str(threads), str(file)]
        made = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
        rows.append(facts | {"program": program, "threads": threads} | json.loads(made.stdout.splitlines()[-1]))
        print(described(rows[-1]), flush=True)
    return rows


def read_scene(file: Path) -> Any:
    """The reconstruction that an adjustment begins with."""
    from sfmapp.scene.reconstruction import Reconstruction
    from sfmapp.scene.tracks import make_tracks

    with np.load(file) as d:
        indices = [d[key].astype(np.int64) for key in ("track", "image", "feature")]
        num = len(d["poses"])
        out = Reconstruction.empty(
            [CAMERA.with_params(d["params"])], [f"{i:05d}.jpg" for i in range(num)], np.zeros(num, np.int32),
            make_tracks(num, len(d["points"]), *indices, d["xy"]),
        )  # fmt: skip
        out.cam_from_world[:], out.point_xyz[:], out.obs_is_inlier[:] = d["poses"], d["points"], True
    return out


def run_sfmapp(scene: Any, threads: int) -> dict[str, Any]:
    """Three steps of ours: the least seconds of each part, costs, memory."""
    import inspect

    from sfmapp.adjust.options import AdjustOptions
    from sfmapp.adjust.solver import adjust_bundle, make_engine
    from sfmapp.scene.synthetic import make_scene

    options = AdjustOptions(loss="cauchy", loss_scale_px=LOSS_PX, initial_damping=DAMPING)
    adjust_bundle(make_scene(0, 3, 40).observed, options)  # loads the kernels
    engine = make_engine(scene, options, is_closing=True)
    parts: dict[str, list[tuple[float, float]]] = {"linearise": [], "solve": [], "try": []}
    costs = []
    with ThreadPoolExecutor(threads) as pool, engine.lone():
        run = map if threads == 1 else pool.map
        solve = (run,) if "run" in inspect.signature(engine.solve).parameters else ()
        for _ in range(NUM_STEPS + 1):  # the first touches memory anew
            with Clock(parts["linearise"]):
                costs.append(engine.linearize(DAMPING, run))
            with Clock(parts["solve"]):
                step = engine.solve(*solve)
            with Clock(parts["try"]):
                engine.attempt(step, run)
            engine.accept()
    seconds = {name: np.min(np.array(times[1:]), axis=0) for name, times in parts.items()}
    return {
        "solver": engine.solver, "fill": round(engine.fill, 4), "costs": costs,
        "cpu_s": round(float(sum(t[0] for t in seconds.values())), 3),
        "wall_s": round(float(sum(t[1] for t in seconds.values())), 3),
        "parts_cpu_s": {name: round(float(t[0]), 3) for name, t in seconds.items()},
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3),
    }  # fmt: skip


def run_ceres(scene: Any, threads: int) -> dict[str, Any]:
    """As many steps of Ceres in pycolmap: mean seconds of one, set-up left out."""
    import pycolmap

    from bundle_adjustment import from_pycolmap, neutral_cost, to_pycolmap

    model = to_pycolmap(scene)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_PX
    solver = options.ceres.solver_options
    solver.num_threads = threads
    solver.function_tolerance = solver.gradient_tolerance = solver.parameter_tolerance = 0.0
    config = pycolmap.BundleAdjustmentConfig()
    for i in range(len(scene.image_names)):
        config.add_image(i + 1)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.UNSPECIFIED)
    seconds, costs = [], []
    for num_steps in (1, NUM_STEPS + 1):  # the difference leaves the set-up out
        solver.max_num_iterations = num_steps
        times: list[tuple[float, float]] = []
        twin = pycolmap.Reconstruction(model)
        with Clock(times):
            pycolmap.create_default_bundle_adjuster(options, config, twin).solve()
        seconds.append(times[0])
        costs.append(neutral_cost(from_pycolmap(twin, scene), "cauchy", LOSS_PX))
    cpu, wall = (np.array(seconds[1]) - seconds[0]) / NUM_STEPS
    return {
        "cpu_s": round(float(cpu), 3), "wall_s": round(float(wall), 3), "costs": costs,
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3),
    }  # fmt: skip


class Clock:
    """Appends CPU and wall seconds of a block to a list."""

    def __init__(self, times: list[tuple[float, float]]) -> None:
        self._times = times

    def __enter__(self) -> None:
        self._cpu, self._wall = time.process_time(), time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self._times.append((time.process_time() - self._cpu, time.perf_counter() - self._wall))


def described(row: dict[str, Any]) -> str:
    """A row in a line."""
    return (
        f"{row['set']}, {row['program']}, {row['threads']} thread(s): {row['cpu_s']} CPU s, {row['wall_s']} s, "
        f"{row['peak_mb']} MB {row.get('parts_cpu_s', '')} {row.get('solver', '')} {row['costs'][-1]:.6g}"
    )


def table(report: dict[str, Any]) -> str:
    """The rows as Markdown."""
    head = ("set", "observations", "fill", "program", "threads", "CPU s", "wall s", "linearise", "solve", "try", "MB")
    lines = [
        "# Steps of large adjustments",
        "",
        f"{report['date'][:10]}, commit {report['commit']}, {report['cpu']}; the least of {NUM_STEPS} steps, of Ceres "
        "their mean. Parts are CPU seconds. Memory is that of the process, the problem included.",
        "",
        f"| {' | '.join(head)} |",
        "|" + "---|" * len(head),
    ]
    for row in report["rows"]:
        parts = row.get("parts_cpu_s", {})
        fill = f"{row['fill']:.0%} ({row['solver']})" if "fill" in row else ""
        lines.append(
            f"| {row['set']} | {row['observations']} | {fill} | {row['program']} | {row['threads']} | {row['cpu_s']} | "
            f"{row['wall_s']} | {' | '.join(str(parts.get(name, '')) for name in ('linearise', 'solve', 'try'))} | "
            f"{row['peak_mb']} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
