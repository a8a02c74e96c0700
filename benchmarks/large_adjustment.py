"""Global adjustments at the size of large sets: sfmapp, an earlier commit of it, and pycolmap's Ceres.

Problems are synthetic (:mod:`large_scenes`): a room in which nearly all photographs meet nearly all others, and a
street in which each meets its neighbours. Every program begins at the same state with the same observations, loss and
free parameters, in a process of its own, and adjusts until a step lowers the cost by less than a millionth of it; the
costs in the end come from one neutral function. Of ours the parts of a step are measured too, and steps by the exact
factor where rounds of conjugate gradients are chosen.

    python benchmarks/large_adjustment.py                                 # ours and Ceres, one thread and two
    python benchmarks/large_adjustment.py --base ../earlier-checkout      # and an earlier commit
    python benchmarks/large_adjustment.py --sets room-1000 --threads 1 --scenes /tmp/scenes -o /tmp/large.json
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
# Steps whose parts are measured, after one that touches memory anew; of whole adjustments the most, and when they end.
NUM_STEPS, DAMPING, LOSS_PX = 2, 1e-4, 1.0
MAX_STEPS, TOLERANCE = 30, 1e-6
# Ceres is given up after so long.
GIVEN_UP_S = 1200.0
# ``exact`` is ours by the factor, ``before`` the earlier commit.
PROGRAMS = ("sfmapp", "exact", "before", "ceres")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=[*SETS], choices=[*SETS])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--base", type=Path, help="a checkout of an earlier commit")
    parser.add_argument("--programs", nargs="+", default=list(PROGRAMS), choices=PROGRAMS)
    parser.add_argument("--scenes", type=Path, help="a folder that keeps the problems for the next run")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "large_adjustment.json")
    parser.add_argument("--run", nargs=3, metavar=("PROGRAM", "THREADS", "FILE"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.run:
        program, threads, file = arguments.run
        scene = read_scene(Path(file))
        made = run_ceres(scene, int(threads)) if program == "ceres" else run_sfmapp(scene, int(threads), program)
        print(json.dumps(made))
        return
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.scenes or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for name in arguments.sets:
            rows += compare(name, folder / f"{name}.npz", arguments)
            write(rows, arguments)


def write(rows: list[dict[str, Any]], arguments: argparse.Namespace) -> None:
    """The report, with rows of an earlier one that were not measured anew."""
    report = describe_machine() | {"before": commit_of(arguments.base)}
    measured = {(row["set"], row["program"], row["threads"]) for row in rows}
    if arguments.output.is_file():
        earlier = json.loads(arguments.output.read_text(encoding="utf-8"))
        report["before"] = report["before"] or earlier["before"]
        rows = rows + [r for r in earlier["rows"] if (r["set"], r["program"], r["threads"]) not in measured]
    sets = [*SETS]
    report["rows"] = sorted(
        rows, key=lambda row: (sets.index(row["set"]), PROGRAMS.index(row["program"]), row["threads"])
    )
    arguments.output.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    arguments.output.with_suffix(".md").write_text(table(report), encoding="utf-8")


def compare(name: str, file: Path, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """The rows of one set."""
    if not file.exists():
        make_scene_file(name, file)
    scene = read_scene(file)
    lengths = np.diff(scene.tracks.track_ptr)
    facts = {
        "set": name, "images": len(scene.image_names), "points": scene.tracks.num_tracks,
        "observations": scene.tracks.num_observations, "products": int((lengths * (lengths + 1) // 2).sum()),
    }  # fmt: skip
    del scene
    runs = [("sfmapp", threads) for threads in arguments.threads] + [(name, 1) for name in PROGRAMS[1:]]
    rows = []
    for program, threads in runs:
        if program not in arguments.programs or (program == "before" and not arguments.base):
            continue
        checkout = arguments.base.resolve() if program == "before" else ROOT
        paths = [str(checkout / "src"), str(Path(__file__).parent)]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
        if program == "before" and "NUMBA_CACHE_DIR" in os.environ:
            environment["NUMBA_CACHE_DIR"] = os.environ["NUMBA_CACHE_DIR"] + "-before"
        command = [sys.executable, __file__, "--run", program, str(threads), str(file)]
        try:
            made = subprocess.run(
                command, env=environment, check=True, stdout=subprocess.PIPE, text=True, timeout=GIVEN_UP_S
            )
        except subprocess.TimeoutExpired:
            print(f"{name}, {program}: given up after {GIVEN_UP_S:.0f} s")
            continue
        rows.append(facts | {"program": program, "threads": threads} | json.loads(made.stdout.splitlines()[-1]))
        print(described(rows[-1]), flush=True)
    return rows


def commit_of(checkout: Path | None) -> str | None:
    """The commit of a checkout."""
    if checkout is None:
        return None
    words = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()


def make_scene_file(name: str, file: Path) -> None:
    """Draw a problem, where its adjustment begins."""
    make, num_images, num_observations = SETS[name]
    scene = perturbed(make(num_images, num_observations))
    tracks = scene.tracks
    np.savez(
        file, track=tracks.obs_track_idx, image=tracks.obs_image_idx, feature=tracks.obs_feature_idx, xy=tracks.obs_xy,
        poses=scene.cam_from_world, points=scene.point_xyz, params=scene.cameras[0].params,
    )  # fmt: skip


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


def run_sfmapp(scene: Any, threads: int, program: str) -> dict[str, Any]:
    """A whole adjustment of ours, and the least seconds of each part of a step."""
    import inspect

    from bundle_adjustment import neutral_cost
    from sfmapp.adjust import solver
    from sfmapp.adjust.options import AdjustOptions
    from sfmapp.scene.synthetic import make_scene

    if program == "exact":
        solver.prefers_rounds = lambda *_: False  # type: ignore[attr-defined]
    options = AdjustOptions(
        loss="cauchy", loss_scale_px=LOSS_PX, initial_damping=DAMPING, relative_cost_tolerance=TOLERANCE,
        max_iterations=MAX_STEPS,
    )  # fmt: skip
    solver.adjust_bundle(make_scene(0, 3, 40).observed, options)  # loads the kernels
    iterating = {"may_iterate": True} if "may_iterate" in inspect.signature(solver.make_engine).parameters else {}
    engine = solver.make_engine(scene.copy(), options, is_closing=True, **iterating)
    parts: dict[str, list[tuple[float, float]]] = {"linearise": [], "solve": [], "try": []}
    with ThreadPoolExecutor(threads) as pool, engine.lone():
        run = map if threads == 1 else pool.map
        solve = (run,) if "run" in inspect.signature(engine.solve).parameters else ()
        for _ in range(NUM_STEPS + 1):
            with Clock(parts["linearise"]):
                engine.linearize(DAMPING, run)
            with Clock(parts["solve"]):
                step = engine.solve(*solve)
            with Clock(parts["try"]):
                engine.attempt(step, run)
            engine.accept()
    seconds = {name: np.min(np.array(times[1:]), axis=0) for name, times in parts.items()}
    name, fill = engine.solver, engine.fill
    del engine
    whole: list[tuple[float, float]] = []
    with Clock(whole):
        report = solver.adjust_bundle(scene, options, threads=threads)
    return {
        "solver": name, "fill": round(fill, 4),
        "step_cpu_s": round(float(sum(t[0] for t in seconds.values())), 3),
        "step_wall_s": round(float(sum(t[1] for t in seconds.values())), 3),
        "parts_cpu_s": {name: round(float(t[0]), 3) for name, t in seconds.items()},
        "steps": report.num_iterations, "cpu_s": round(whole[0][0], 3), "wall_s": round(whole[0][1], 3),
        "cost": neutral_cost(scene, "cauchy", LOSS_PX), "peak_mb": peak_mb(),
    }  # fmt: skip


def run_ceres(scene: Any, threads: int) -> dict[str, Any]:
    """A whole adjustment by Ceres in pycolmap; a step is what it takes over the number of its steps."""
    import pycolmap

    from bundle_adjustment import from_pycolmap, neutral_cost, to_pycolmap

    model = to_pycolmap(scene)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_PX
    solver = options.ceres.solver_options
    solver.num_threads, solver.function_tolerance, solver.max_num_iterations = threads, TOLERANCE, MAX_STEPS
    solver.gradient_tolerance = solver.parameter_tolerance = 0.0
    config = pycolmap.BundleAdjustmentConfig()
    for i in range(len(scene.image_names)):
        config.add_image(i + 1)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.UNSPECIFIED)
    times: list[tuple[float, float]] = []
    with Clock(times):
        summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    found = summary.ceres_summary
    steps = found.num_successful_steps + found.num_unsuccessful_steps
    cpu, wall = times[0]
    return {
        "step_cpu_s": round(cpu / steps, 3), "step_wall_s": round(wall / steps, 3), "steps": steps,
        "cpu_s": round(cpu, 3), "wall_s": round(wall, 3),
        "cost": neutral_cost(from_pycolmap(model, scene), "cauchy", LOSS_PX), "peak_mb": peak_mb(),
    }  # fmt: skip


def peak_mb() -> int:
    """The most memory that this process has held."""
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)


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
        f"{row['set']}, {row['program']}, {row['threads']} thread(s): a step {row['step_cpu_s']} CPU s, "
        f"{row['step_wall_s']} s {row.get('parts_cpu_s', '')} {row.get('solver', '')}; {row['steps']} steps, "
        f"{row['cpu_s']} CPU s, {row['wall_s']} s to {row['cost']:.7g}, {row['peak_mb']} MB"
    )


def table(report: dict[str, Any]) -> str:
    """The rows as Markdown."""
    head = (
        "set", "observations", "program", "threads", "solver", "a step: CPU s", "wall s", "linearise", "solve", "try",
        "steps", "whole: CPU s", "wall s", "cost", "MB",
    )  # fmt: skip
    parts = ("linearise", "solve", "try")
    where = f"{report['date'][:10]}, commit {report['commit']}, {report['cpu']}"
    lines = [
        "# Large adjustments",
        "",
        f"{where}. A step is the least of {NUM_STEPS}, of Ceres the mean of all; its parts are CPU seconds. Whole "
        f"adjustments end where a step lowers the cost by less than {TOLERANCE:g} of it. Memory is that of the "
        "process, the problem included.",
        "",
        f"| {' | '.join(head)} |",
        "|" + "---|" * len(head),
    ]
    for row in report["rows"]:
        solver = f"{row['solver']}, {row['fill']:.0%} full" if "fill" in row else ""
        begin = [row[key] for key in ("set", "observations", "program", "threads")]
        step = [row["step_cpu_s"], row["step_wall_s"], *(row.get("parts_cpu_s", {}).get(name, "") for name in parts)]
        whole = [row["steps"], row["cpu_s"], row["wall_s"], f"{row['cost']:.1f}", row["peak_mb"]]
        lines.append(f"| {' | '.join(map(str, [*begin, solver, *step, *whole]))} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
