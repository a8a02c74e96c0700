"""The first run of a command on a machine, which compiles its kernels, beside the one after it.

    SFMAPP_DATA=... python benchmarks/cold_start.py
    SFMAPP_DATA=... python benchmarks/cold_start.py --cases demo stereo --modules    # commands alone
    python benchmarks/cold_start.py --cases --modules sfmapp.features.extract        # the kernels of a module alone

Each command runs twice in processes of their own over a folder for numba's cache that is empty at first. CPU seconds
are those of the process and its children; two cores share the compilation, so the first run takes half of what it
takes more, or somewhat over, in wall time, which is given too but tells of other work on the machine as well.
Below stand the kernels of each module that is compiled ahead, by the CPU seconds that numba takes for them and for what
they call, on one thread and into an empty cache.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from machine import RESULTS, describe_machine

DATA = Path(os.environ.get("SFMAPP_DATA", "data"))
# CPU seconds that two cores work off within the time that a first run may take more
MOST_MORE_S = {"demo": 50.0}
MOST_MORE_OTHERS_S = 30.0
# kernels that take less are not listed
LISTED_S = 0.4

Arguments = list[str]
# what a command is given, and what has to be there first; OUT is where the last run of each wrote
COMMANDS: dict[str, Callable[[Path], Arguments]] = {
    "demo": lambda out: ["demo", "-o", str(out / "demo")],
    "reconstruct": lambda out: [
        "reconstruct", str(DATA / "temple-sparse-ring" / "images"), "-o", str(out / "reconstruct"),
    ],
    "odometry": lambda out: [
        "odometry", str(DATA / "kitti00-200"), "--stop", "60", "-o", str(out / "odometry"),
    ],
    "dense": lambda out: ["dense", str(out / "reconstruct")],
    "mesh": lambda out: ["mesh", str(out / "reconstruct")],
    "pair": lambda out: [
        "pair", *map(str, sorted((DATA / "fountain-P11" / "images").iterdir())[:2]), "-o", str(out / "pair"),
    ],
    "stereo": lambda out: [
        "stereo", *(str(DATA / "skimage-motorcycle" / f"motorcycle_{side}.png") for side in ("left", "right")),
        "--focal", "994.978", "--baseline", "0.193001", "-o", str(out / "stereo"),
    ],
    "panorama": lambda out: ["panorama", str(DATA / "pano-sponza-rot" / "images"), "-o", str(out / "panorama")],
    "carve": lambda out: ["carve", str(out / "reconstruct"), "--with-dense", "-o", str(out / "carve")],
    "calibrate": lambda out: [
        "calibrate", "board", str(DATA / "opencv-doc-samples" / "calib"), "--board", "9x6",
        "-o", str(out / "calibrate"),
    ],
}  # fmt: skip
# a command that goes on from another's result
NEEDS = {"dense": ["reconstruct"], "mesh": ["reconstruct", "dense"], "carve": ["reconstruct", "dense"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="*", choices=list(COMMANDS), default=list(COMMANDS))
    parser.add_argument("--modules", nargs="*", default=None, help="default: those of a reconstruction and of odometry")
    parser.add_argument("--list", metavar="MODULE", help="print the kernels of a module; what this script calls")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "cold_start.json")
    args = parser.parse_args()
    if args.list:
        print(json.dumps(compiled(args.list)))
        return
    from sfmapp.workspace.kernels import DENSE_MODULES, MODULES, ODOMETRY_MODULES

    report: dict[str, Any] = {}
    if args.output.is_file():  # rows of other cases stay
        report = json.loads(args.output.read_text(encoding="utf-8"))
    rows = {row["case"]: row for row in report.get("runs", [])}
    lists = {row["module"]: row for row in report.get("modules", [])}
    for case in args.cases:
        rows[case] = measure(case)
        print(rows[case], flush=True)
        write(args.output, rows, lists)
    wanted = args.modules if args.modules is not None else dict.fromkeys(MODULES + ODOMETRY_MODULES + DENSE_MODULES)
    for module in wanted:
        lists[module] = in_child(module)
        print(module, lists[module]["cpu_s"], flush=True)
        write(args.output, rows, lists)


def write(output: Path, rows: dict[str, Any], lists: dict[str, Any]) -> None:
    """What there is so far."""
    report = describe_machine() | {
        "runs": [rows[case] for case in COMMANDS if case in rows],
        "modules": sorted(lists.values(), key=lambda row: -row["cpu_s"]),
    }
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    output.with_suffix(".md").write_text(table(report), encoding="utf-8")


def measure(case: str) -> dict[str, Any]:
    """A command over an empty cache, and again."""
    row: dict[str, Any] = {"case": case, "load": round(os.getloadavg()[0], 1)}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("first", "second"):
            out = Path(folder) / name
            out.mkdir()
            for needed in NEEDS.get(case, []):
                run(COMMANDS[needed](out), Path(folder) / "others")
            row[name] = run(COMMANDS[case](out), Path(folder) / "cache")
        row["num_kernels"] = len(list((Path(folder) / "cache").rglob("*.nbc")))
    row["more_cpu_s"] = round(row["first"]["cpu_s"] - row["second"]["cpu_s"], 2)
    row["most_more_cpu_s"] = MOST_MORE_S.get(case, MOST_MORE_OTHERS_S)
    return row


def run(arguments: Arguments, cache: Path) -> dict[str, float]:
    """Seconds and megabytes that a command takes with numba's cache in a folder."""
    start = time.monotonic()
    child = subprocess.Popen(
        [sys.executable, "-m", "sfmapp", *arguments], env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"sfmapp {' '.join(arguments)} ended with {child.returncode}")
    return {
        "wall_s": round(time.monotonic() - start, 2),
        "cpu_s": round(usage.ru_utime + usage.ru_stime, 2),
        "peak_mb": round(usage.ru_maxrss * 1024 / 1e6),
    }


def in_child(module: str) -> dict[str, Any]:
    """What compiles in a module, in a process of its own over an empty cache."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, "--list", module]
        done = subprocess.run(command, env=os.environ | {"NUMBA_CACHE_DIR": folder}, stdout=subprocess.PIPE, check=True)
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def compiled(module: str) -> dict[str, Any]:
    """Compile the kernels of a module; CPU seconds of each, with and without what it calls."""
    from numba.core import event

    kernels: list[dict[str, Any]] = []
    at_work: list[list[float]] = []

    class Listener(event.Listener):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:
            at_work.append([time.thread_time(), 0.0])

        def on_end(self, event: Any) -> None:
            start, within = at_work.pop()
            took = time.thread_time() - start
            if at_work:
                at_work[-1][1] += took
            function = getattr(event.data.get("dispatcher"), "py_func", None)
            name = f"{function.__module__}.{function.__qualname__}" if function else "?"
            kernels.append({"kernel": name, "cpu_s": round(took, 3), "own_cpu_s": round(took - within, 3)})

    loaded = importlib.import_module(module)
    listener = Listener()
    event.register("numba:compile", listener)
    start = time.thread_time()
    loaded.compile_kernels()
    event.unregister("numba:compile", listener)
    kernels.sort(key=lambda kernel: -float(kernel["own_cpu_s"]))
    return {"module": module, "cpu_s": round(time.thread_time() - start, 2), "kernels": kernels}


def table(report: dict[str, Any]) -> str:
    """The report as Markdown."""
    lines = [
        "# First runs", "",
        f"{report['date']}, {report['commit']}, {report['cpu']}, {report['cores']} cores. "
        "CPU s of the first run, over an empty cache, and of the second; what may be more is what two cores do in 25 s "
        "(demo) and 15 s.", "",
        "| command | kernels | first, CPU s | second, CPU s | more | may be | first, wall s | second, wall s | load | "
        "peak MB |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in report["runs"]:
        first, second = row["first"], row["second"]
        lines.append(
            f"| {row['case']} | {row['num_kernels']} | {first['cpu_s']:.1f} | {second['cpu_s']:.1f} | "
            f"{row['more_cpu_s']:.1f} | {row['most_more_cpu_s']:.0f} | "
            f"{first['wall_s']:.0f} | {second['wall_s']:.0f} | {row['load']:.0f} | "
            f"{first['peak_mb']} and {second['peak_mb']} |"
        )
    if report["modules"]:
        lines += ["", "## Kernels that are compiled ahead", ""]
    for module in report["modules"]:
        lines += [f"{module['module']}: {module['cpu_s']:.1f} CPU s, {len(module['kernels'])} kernels", ""]
        slow = [kernel for kernel in module["kernels"] if kernel["own_cpu_s"] >= LISTED_S]
        lines += [f"- {kernel['own_cpu_s']:.2f} ({kernel['cpu_s']:.2f}) `{kernel['kernel']}`" for kernel in slow]
        lines += [""] if slow else []
    return "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    main()
