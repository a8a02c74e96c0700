"""`sfmapp reconstruct` beside openmvg-rs and beside pycolmap's global mapper, on the photographs of sparse.py.

    python benchmarks/sparse_peers.py                              # the sets of sparse.py, one seed
    python benchmarks/sparse_peers.py --openmvg-python ~/venv/bin/python FOLDER ...
    python benchmarks/sparse_peers.py --ours                       # sfmapp alone, the others' runs are kept

openmvg-rs (``reconstruct``, incremental, its defaults) repeats itself for any number of threads, so it runs once; it is
left out where the interpreter that is named has no ``openmvg_rs``. The global mapper (``calibrate_view_graph``, then
``global_mapping``) has the very database that pycolmap's incremental mapper has had; its costs are those of extraction
and matching there and of a process of its own for the rest. Costs and errors are taken as in sparse.py.
"""

from __future__ import annotations

import argparse
import compileall
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import sfmapp
import sparse
from machine import RESULTS, describe_machine
from sfmapp.evaluation.measured import run_measured

PROGRAMS = ("sfmapp", "pycolmap", "pycolmap global", "openmvg-rs")

# folder of photographs, folder of the result, seed
OPENMVG = """
import sys, openmvg_rs
images, output, seed = sys.argv[1:]
openmvg_rs.reconstruct(images, engine="incremental", seed=int(seed), progress=False).write_colmap(output)
"""

# database, folder of photographs, folder of the models, seed; the focal lengths are found from the matches first, as
# COLMAP's manual asks for photographs whose EXIF tells none
GLOBAL = """
import sys, pycolmap
database, images, output, seed = sys.argv[1:]
pycolmap.set_random_seed(int(seed))
calibration, options = pycolmap.ViewGraphCalibrationOptions(), pycolmap.GlobalPipelineOptions()
calibration.random_seed = options.random_seed = int(seed)
pycolmap.calibrate_view_graph(database, calibration)
pycolmap.global_mapping(database, images, output, options)
"""


def run_openmvg(data: sparse.DataSet, seed: int, work: Path, python: Path) -> dict[str, Any]:
    """One run of openmvg-rs."""
    command = [str(python), "-c", OPENMVG, str(data.images.resolve()), str(work / "openmvg"), str(seed)]
    usage = run_measured(command, work / "openmvg.log", env=foreign_environment())
    return sparse.costs(usage) | sparse.results(data, work / "openmvg" / "sparse" / "0")


def run_global(data: sparse.DataSet, seed: int, work: Path, incremental: dict[str, Any]) -> dict[str, Any]:
    """The global mapper on the database that an incremental run has left in the same folder."""
    models = work / "global"
    models.mkdir()
    database = work / "pycolmap" / "database.db"
    command = [sys.executable, "-c", GLOBAL, str(database), str(data.images.resolve()), str(models), str(seed)]
    costs = sparse.costs(run_measured(command, work / "global.log"))
    for key in ("wall_s", "cpu_s"):
        costs[key] += sum(incremental["phases"][phase][key] for phase in ("extract", "match"))
    # of features and matches pycolmap's peak is known together with its mapping alone, so that it is an upper bound
    costs["peak_memory_mb"] = max(costs["peak_memory_mb"], incremental["peak_memory_mb"])
    found = [(sparse.results(data, folder), folder.name) for folder in models.iterdir()]
    largest = max(found, key=lambda item: (item[0]["model"]["num_registered"], item[1]), default=None)
    return costs | (largest[0] if largest else sparse.results(data, models / "none"))


def foreign_environment() -> dict[str, str]:
    """Ours without what would show another interpreter our packages."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


def has_openmvg(python: Path) -> str:
    """Version of openmvg-rs of an interpreter, empty without."""
    code = "from importlib.metadata import version; print(version('openmvg-rs'))"
    asked = subprocess.run([python, "-c", code], capture_output=True, text=True, env=foreign_environment())
    return asked.stdout.strip()


def measure(data: sparse.DataSet, args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """All runs of one set: ours and pycolmap's for each seed in turns, the others after pycolmap's."""
    for seed in range(args.seeds):
        with tempfile.TemporaryDirectory(dir=args.work) as folder:
            work, about = Path(folder), {"set": data.name, "seed": seed, "is_cold": False}
            load = {"load_before": os.getloadavg()[0]}
            yield about | {"program": "sfmapp"} | load | sparse.run_sfmapp(data, seed, work, args)
            if args.ours:
                continue
            load = {"load_before": os.getloadavg()[0]}
            incremental = sparse.run_pycolmap(data, seed, work, args)
            yield about | {"program": "pycolmap"} | load | incremental
            if "phases" in incremental:
                yield about | {"program": "pycolmap global"} | load | run_global(data, seed, work, incremental)
            if seed == 0 and args.openmvg:
                load = {"load_before": os.getloadavg()[0]}
                yield about | {"program": "openmvg-rs"} | load | run_openmvg(data, seed, work, args.openmvg_python)


def medians(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians over the seeds by set and program."""
    measured = {(run["set"], run["program"]) for run in runs}
    return {
        data: {
            program: {path: sparse.typical(runs, data, program, path) for path in sparse.PATHS}
            for program in PROGRAMS
            if (data, program) in measured
        }
        for data in dict.fromkeys(run["set"] for run in runs)
    }


def markdown(report: dict[str, Any]) -> str:
    """One line for a program and a set."""
    versions = report["versions"]
    lines = [
        f"sfmapp at {report['commit']}, pycolmap {versions['pycolmap']} (camera mode auto), "
        f"openmvg-rs {report['openmvg'] or 'not there'}; {report['seeds']} seeds, medians; {report['cpu']}, "
        f"{report['cores']} cores, {report['date']}. "
        "Errors are over the photographs that a program registered; AUC counts all.",
        "",
        "| set | program | registered | wall s | CPU s | peak MB | centre error mean | rotation error mean deg "
        "| AUC@1 | AUC@5 |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for data, programs in report["medians"].items():
        for program, row in programs.items():
            cells = [(row["model.num_registered"], ".0f"), *((row[path], ".4g") for path in sparse.RATIO_PATHS)]
            cells += [(row["ground_truth.auc.1"], ".3f"), (row["ground_truth.auc.5"], ".3f")]
            text = " | ".join("-" if value is None else format(value, form) for value, form in cells)
            lines.append(f"| {data} ({row['model.num_images']:.0f}) | {program} | {text} |")
    loud = max(run["load_before"] for run in report["runs"])
    note = "where it was high CPU seconds are more, and wall seconds tell nothing."
    return "\n".join([*lines, "", f"Highest load average before a run: {loud:.1f}; {note}"])


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folders", nargs="*", type=Path, help="data sets; default: those of sparse.py")
    parser.add_argument("--seeds", type=int, default=1, help="runs of each but openmvg-rs, which repeats itself")
    parser.add_argument("--ours", action="store_true", help="run sfmapp alone, and keep the others' runs of the output")
    parser.add_argument("--openmvg-python", type=Path, default=Path(sys.executable), metavar="PYTHON",
                        help="interpreter that has openmvg-rs; default: this one")  # fmt: skip
    parser.add_argument("--work", type=Path, default=None, help="folder for the workspaces, which are removed again")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "sparse_peers.json")
    args = parser.parse_args()
    compileall.compile_dir(Path(sfmapp.__file__).parent, quiet=1)  # as sparse.py does, and why
    args.threads, args.camera_mode, args.set = None, "auto", []
    args.openmvg = has_openmvg(args.openmvg_python)
    report: dict[str, Any] = describe_machine() | {"seeds": args.seeds, "openmvg": args.openmvg, "runs": []}
    if args.ours:
        earlier = json.loads(args.output.read_text())
        report["openmvg"] = earlier["openmvg"]
        report["runs"] = [run for run in earlier["runs"] if run["program"] != "sfmapp"]
    args.output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=args.work) as kernels:
        args.numba_cache = Path(os.environ.get("NUMBA_CACHE_DIR", kernels))
        sets = sparse.find_sets(args.folders)
        with tempfile.TemporaryDirectory(dir=args.work) as warm:  # kernels are compiled before anything is measured
            sparse.run_sfmapp(min(sets, key=lambda data: len(data.image_names)), 0, Path(warm), args)
        for data in sets:
            for run in measure(data, args):
                report["runs"].append(run)
                error = sparse.pick(run, "ground_truth.center_error.mean")
                print(f"{run['set']} {run['program']} seed {run['seed']}: {run['model']['num_registered']} of "
                      f"{run['model']['num_images']}, {run['cpu_s']:.1f} s CPU, {run['peak_memory_mb']:.0f} MB, "
                      f"centre error {error}", file=sys.stderr, flush=True)  # fmt: skip
                report["medians"] = medians(report["runs"])
                args.output.write_text(json.dumps(report, indent=1) + "\n")
    args.output.with_suffix(".md").write_text(markdown(report) + "\n")
    print(markdown(report))


if __name__ == "__main__":
    main()
