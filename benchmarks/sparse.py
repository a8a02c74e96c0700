"""Whole command against whole pipeline: `sfmapp reconstruct` and pycolmap on the same photographs, side by side.

    python benchmarks/sparse.py                      # the sets below, three seeds each
    python benchmarks/sparse.py FOLDER ... --seeds 1 # folders with images/ and cameras.json (or another ground truth)

Each program runs as a process of its own with its default options; wall seconds, CPU seconds (user and system, children
included) and peak resident memory are those of the process, interpreter start and imports included. The two take turns
and swap the order from seed to seed. See README.md for what the numbers mean.
"""

from __future__ import annotations

import argparse
import compileall
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import sfmapp
from machine import RESULTS, ROOT, describe_machine
from sfmapp.errors import SfmError
from sfmapp.evaluation.measured import ProcessUsage, run_measured
from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.evaluation.second_opinion import SecondOpinionOptions, ask_second_opinion
from sfmapp.formats.colmap import has_model, read_model
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.reporting import plain

DATA = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
DEFAULT_SETS = ("fountain-P11", "herz-jesus-P8", "lund-door", "temple-sparse-ring")
GROUND_TRUTH_NAMES = (
    "cameras.json",
    "ground_truth.json",
    "trajectory.tum",
    "groundtruth.txt",
    "sparse/0",
    "sparse",
    "ground_truth",
)
IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".ppm", ".pgm"}
PROGRAMS = ("sfmapp", "pycolmap")


@dataclass(frozen=True)
class DataSet:
    """Photographs and what is known of their cameras."""

    name: str
    images: Path
    ground_truth: Path | None

    @property
    def image_names(self) -> list[str]:
        paths = (p for p in self.images.rglob("*") if p.suffix.lower() in IMAGE_SUFFIXES)
        return sorted(p.relative_to(self.images).as_posix() for p in paths)


def find_sets(folders: list[Path]) -> list[DataSet]:
    """The data sets in the given folders; without any, the shared ones that are there and the bundled sample."""
    if not folders:
        folders = [path for name in DEFAULT_SETS if (path := DATA / name).is_dir()]
        folders += [path for path in [ROOT / "data" / "courtyard"] if (path / "images").is_dir()]
    sets = []
    for folder in folders:
        if not (folder / "images").is_dir():
            sys.exit(f"{folder}: no folder images/ in it")
        ground_truth = next((folder / name for name in GROUND_TRUTH_NAMES if (folder / name).exists()), None)
        sets.append(DataSet(folder.resolve().name, folder / "images", ground_truth))
    return sets


def run_sfmapp(data: DataSet, seed: int, work: Path, args: argparse.Namespace) -> dict[str, Any]:
    """One run of the command in a fresh workspace."""
    out = work / "sfmapp"
    script = Path(sys.executable).with_name("sfmapp")
    command = [str(script), "reconstruct", str(data.images), "-o", str(out), "--seed", str(seed), "-q"]
    command += ["--threads", str(args.threads)] if args.threads else []
    command += [flag for setting in args.set for flag in ("--set", setting)]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(args.numba_cache)}
    usage = run_measured(command, work / "sfmapp.log", env=environment)
    if usage.exit_code not in (0, 4):
        tail = (work / "sfmapp.log").read_text(errors="replace")[-2000:]
        print(f"sfmapp ended with code {usage.exit_code}:\n{tail}", file=sys.stderr)
    return costs(usage) | results(data, out / "sparse" / "0")


def run_pycolmap(data: DataSet, seed: int, work: Path, args: argparse.Namespace) -> dict[str, Any]:
    """One run of extraction, exhaustive matching and mapping with pycolmap's defaults."""
    options = SecondOpinionOptions(seed=seed, num_threads=args.threads, camera_mode=args.camera_mode)
    try:
        opinion = ask_second_opinion(data.images, data.image_names, work / "pycolmap", options)
    except SfmError as error:
        print(f"pycolmap failed: {error}", file=sys.stderr)
        return {"exit_code": 1} | results(data, work / "none")
    usage = ProcessUsage(0, opinion.wall_s, opinion.cpu_s, opinion.peak_memory_mb)
    return costs(usage) | {"phases": opinion.phases} | results(data, Path(opinion.model_folder or work / "none"))


RUNNERS: dict[str, Callable[..., dict[str, Any]]] = {"sfmapp": run_sfmapp, "pycolmap": run_pycolmap}


def costs(usage: ProcessUsage) -> dict[str, Any]:
    """What a process took."""
    return asdict(usage)


def results(data: DataSet, model_folder: Path) -> dict[str, Any]:
    """Counts, and errors against the ground truth, of a model; both programs are judged by the same code."""
    model = read_model(model_folder)[0] if has_model(model_folder) else None
    summary: dict[str, Any] = plain(model.summary()) if model is not None else {"num_registered": 0}
    values: dict[str, Any] = {"model": summary | {"num_images": len(data.image_names)}}
    if data.ground_truth is not None:
        ground_truth = read_ground_truth(data.ground_truth).for_images(data.image_names)
        names, poses = (model.image_names, model.cam_from_world) if model is not None else ([], [])
        errors = evaluate_poses(names, poses, ground_truth.names, ground_truth.cam_from_world)
        values["ground_truth"] = plain(errors.summary())
    return values


def measure(data: DataSet, args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """All runs of one data set."""
    for path in data.images.rglob("*"):  # neither program shall be the one that waits for the disk
        if path.is_file():
            path.read_bytes()
    for seed in range(args.seeds):
        for program in PROGRAMS if seed % 2 == 0 else PROGRAMS[::-1]:
            if args.only not in (None, program):
                continue
            load = os.getloadavg()[0]
            with tempfile.TemporaryDirectory(dir=args.work) as work:
                is_cold = program == "sfmapp" and not any(args.numba_cache.iterdir())
                run = RUNNERS[program](data, seed, Path(work), args)
            yield {"set": data.name, "program": program, "seed": seed, "is_cold": is_cold, "load_before": load} | run
            if is_cold:  # kernels were compiled: count this one as the cold run and take the seed again, warm
                with tempfile.TemporaryDirectory(dir=args.work) as work:
                    run = RUNNERS[program](data, seed, Path(work), args)
                yield {"set": data.name, "program": program, "seed": seed, "is_cold": False, "load_before": load} | run


def pick(run: dict[str, Any], path: str) -> float | None:
    """A number of a run by its path, such as ``ground_truth.auc.1``; keys hold no dot but in ``0.5``, which stands
    last."""
    value: Any = run
    for key in path.split(".", 2):
        value = value.get(key) if isinstance(value, dict) else None
    return value


def typical(runs: list[dict[str, Any]], data: str, program: str, path: str) -> float | None:
    """Median over the warm runs; None if a run lacks the number."""
    values = [pick(run, path) for run in runs if (run["set"], run["program"], run["is_cold"]) == (data, program, False)]
    return None if not values or any(v is None for v in values) else median(v for v in values if v is not None)


def medians(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians over the seeds and ratios pycolmap / sfmapp, by set."""
    table: dict[str, Any] = {}
    for data in dict.fromkeys(run["set"] for run in runs):
        table[data] = {p: {path: typical(runs, data, p, path) for path in PATHS} for p in PROGRAMS}
        ours, theirs = table[data]["sfmapp"], table[data]["pycolmap"]
        table[data]["pycolmap_over_sfmapp"] = {
            path: theirs[path] / ours[path] for path in RATIO_PATHS if ours[path] and theirs[path] is not None
        }
    return table


RATIO_PATHS = (
    "wall_s",
    "cpu_s",
    "peak_memory_mb",
    "ground_truth.center_error.mean",
    "ground_truth.rotation_error_deg.mean",
)
PATHS = (
    *RATIO_PATHS, "ground_truth.center_error.median", "ground_truth.center_error.max",
    "ground_truth.rotation_error_deg.max",
    "ground_truth.auc.0.5", "ground_truth.auc.1", "ground_truth.auc.3", "ground_truth.auc.5", "model.num_images",
    "model.num_registered",
    "model.num_points", "model.mean_track_length", "model.mean_reprojection_error_px",
)  # fmt: skip


def markdown(report: dict[str, Any]) -> str:
    """Two tables: what it cost and how good it is."""
    lines = [
        f"sfmapp {report['versions']['sfmapp']} at {report['commit']}, pycolmap {report['versions']['pycolmap']}"
        f" (camera mode {report['camera_mode']}), {report['seeds']} seeds, medians; {report['cpu']},"
        f" {report['cores']} cores, {report['date']}. Cells: sfmapp / pycolmap (ratio).",
        "",
        "| set | registered | wall s | CPU s | peak MB |",
        "|---|---|---|---|---|",
    ]
    accuracy = [
        "| set | centre error mean | rotation error mean deg | AUC@0.5 | AUC@1 | AUC@3 | AUC@5 | points | track length "
        "| reprojection px |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for data, row in report["medians"].items():
        cost = [_cell(row, "model.num_registered", ".0f"), *(_cell(row, path, ".4g") for path in RATIO_PATHS[:3])]
        lines.append(f"| {data} ({row['sfmapp']['model.num_images'] or row['pycolmap']['model.num_images']:.0f}) | "
                     + " | ".join(cost) + " |")  # fmt: skip
        cells = [_cell(row, path, ".4g") for path in RATIO_PATHS[3:]]
        cells += [_cell(row, f"ground_truth.auc.{t}", ".3f") for t in ("0.5", "1", "3", "5")]
        cells += [_cell(row, "model.num_points", ".0f"), _cell(row, "model.mean_track_length", ".2f")]
        cells.append(_cell(row, "model.mean_reprojection_error_px", ".3f"))
        accuracy.append(f"| {data} | " + " | ".join(cells) + " |")
    cold = [run for run in report["runs"] if run["is_cold"]]
    notes = [
        f"First run with no compiled kernels ({run['set']}): {run['wall_s']:.1f} s wall, {run['cpu_s']:.1f} s CPU."
        for run in cold
    ]
    loud = max((run["load_before"] for run in report["runs"]), default=0.0)
    notes.append(f"Highest load average before a run: {loud:.1f}.")
    return "\n".join([*lines, "", *accuracy, "", *notes])


def _cell(row: dict[str, Any], path: str, form: str) -> str:
    ours, theirs, ratio = (row[k].get(path) for k in ("sfmapp", "pycolmap", "pycolmap_over_sfmapp"))
    text = " / ".join("-" if v is None else format(v, form) for v in (ours, theirs))
    return text + (f" ({ratio:.2f})" if ratio is not None else "")


def environment(args: argparse.Namespace) -> dict[str, Any]:
    """What the numbers depend on."""
    return describe_machine() | {
        "seeds": args.seeds,
        "threads": args.threads,
        "camera_mode": args.camera_mode,
        "settings": args.set,
    }


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folders", nargs="*", type=Path, help="data sets; default: the shared ones and the sample")
    parser.add_argument("--seeds", type=int, default=3, help="runs of each program on each set")
    parser.add_argument("--threads", type=int, default=None, help="threads of both; default: their own choice")
    parser.add_argument("--camera-mode", default="auto", choices=["auto", "single", "per_folder", "per_image"],
                        help="which photographs share a camera in pycolmap; auto is its default")  # fmt: skip
    parser.add_argument("--only", choices=PROGRAMS, help="run just one of the two")
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.OPTION=VALUE", help="option of sfmapp")
    parser.add_argument("--work", type=Path, default=None, help="folder for the workspaces, which are removed again")
    parser.add_argument("-o", "--output", type=Path, default=None, help="default: benchmarks/results/sparse.json")
    args = parser.parse_args()
    # what pip does when it installs; both programs run modules of ours, and Python may have been told to keep nothing
    compileall.compile_dir(Path(sfmapp.__file__).parent, quiet=1)
    args.numba_cache = Path(tempfile.mkdtemp(prefix="numba-", dir=args.work))
    report: dict[str, Any] = environment(args) | {"runs": []}
    output = args.output or RESULTS / "sparse.json"
    output.parent.mkdir(parents=True, exist_ok=True)
    try:
        for data in find_sets(args.folders):
            for run in measure(data, args):
                report["runs"].append(run)
                error = pick(run, "ground_truth.center_error.mean")
                print(f"{run['set']} {run['program']} seed {run['seed']}{' cold' if run['is_cold'] else ''}: "
                      f"{run['model']['num_registered']} of {run['model']['num_images']}, "
                      f"{run.get('wall_s', 0):.1f} s wall, {run.get('cpu_s', 0):.1f} s CPU, "
                      f"{run.get('peak_memory_mb', 0):.0f} MB, centre error {error}", file=sys.stderr)  # fmt: skip
                report["medians"] = medians(report["runs"])
                output.write_text(json.dumps(report, indent=1) + "\n")
    finally:
        shutil.rmtree(args.numba_cache, ignore_errors=True)
    output.with_suffix(".md").write_text(markdown(report) + "\n")
    print(markdown(report))


if __name__ == "__main__":
    main()
