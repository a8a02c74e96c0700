"""What ``sfmapp plan`` says against the run that follows it: CPU and wall seconds, memory, disk, pairs.

    SFMAPP_DATA=... python benchmarks/planning.py [--only CASE ...]     writes results/planning.json and planning.md

Both are commands in processes of their own. The machine is measured anew, by a plan that does not count. Some sets have
chosen constants of the estimate, others, rendered and real, have not, and are told apart. On a machine that has other
things to do, CPU seconds count, and are still up to a third too many.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

from cases import Row, measure_cases
from machine import ROOT

DATA = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
# of the likely value, on so many sets
WITHIN = 0.25
SHARED = {
    "temple-sparse-ring": "images", "fountain-P11": "images", "herz-jesus-P8": "images", "lund-door": "images",
    "strecha-courtyard-21": "images", "opensfm-lund": "images", "oxford-dinosaur": "images",
    "nerf-lego-small": "images", "sfmtool-seoul-bull": "images", "balbianello": "",
}  # fmt: skip
QUANTITIES = {"cpu_s": "CPU s", "wall_s": "wall s", "peak_mb": "memory, MB", "disk_mb": "disk, MB"}


def links_to(paths: list[Path], folder: Path) -> None:
    """Photographs under names that do not collide."""
    for path in paths:
        (folder / f"{path.parent.parent.name}_{path.name}").symlink_to(path)


def kitti(folder: Path) -> None:
    """The second half of a drive: more frames than are compared all with all."""
    links_to(sorted((DATA / "kitti00-200" / "image_0").iterdir())[100:], folder)


def two_places(folder: Path) -> None:
    """A door and a courtyard in one folder."""
    names = ("lund-door", "strecha-courtyard-21")
    links_to([path for name in names for path in (DATA / name / "images").iterdir()], folder)


def tagged(kind: str, seed: int) -> Callable[[Path], None]:
    """A drone's block or a walk round a monument, rendered, with tags."""

    def make(folder: Path) -> None:
        from tagged_sets import make_set, write_photographs

        folder.rmdir()
        write_photographs(make_set(kind, seed), folder, seed)

    return make


def room(folder: Path) -> None:
    """Frames of a walk round a rendered room, each with enough of a step to the next."""
    import cv2

    from rendered_worlds.sequences import room as walk

    sequence = walk(840, seed=9)
    for n in range(0, 840, 10):
        cv2.imwrite(str(folder / f"{n:04d}.png"), sequence.image(n))


FRESH: dict[str, Callable[[Path], None]] = {
    "drone block": tagged("drone block", 4), "monument": tagged("monument", 4), "room": room, "kitti00": kitti,
    "two places": two_places,
}  # fmt: skip


def main() -> None:
    if sys.argv[1:2] == ["--make"]:
        FRESH[sys.argv[2]](Path(sys.argv[3]))
        return
    cases = ["courtyard sample", *(name for name in SHARED if (DATA / name).is_dir()), *FRESH]
    measure_cases("planning", __doc__, cases, measured, table)


def measured(case: str) -> Iterator[Row]:
    """The plan and the run of a case."""
    with tempfile.TemporaryDirectory(prefix="planning-") as scratch:
        folder, output = Path(scratch) / "photographs", Path(scratch) / "out"
        if case in SHARED:
            folder = DATA / case / SHARED[case]
        elif case == "courtyard sample":
            folder = ROOT / "data" / "courtyard" / "images"
        else:
            folder.mkdir()
            # what a process has had of memory counts as that of its children, so that another one renders
            subprocess.run([sys.executable, __file__, "--make", case, str(folder)], check=True)
        plan = json.loads(sfmapp("plan", str(folder), "--json"))
        for out in (Path(scratch) / "first", output):  # which compiles what only such photographs need
            sfmapp("reconstruct", str(folder), "-o", str(out), "-q", may_fail=True)
        report = json.loads((output / "report.json").read_text(encoding="utf-8"))
        disk_mb = sum(path.stat().st_size for path in output.rglob("*") if path.is_file()) / 1e6
    run, whole, matching = report["run"], plan["whole"], report["stages"]["matching"]
    yield {
        "case": case,
        "has_chosen": case not in FRESH,
        "num_images": plan["num_images"],
        "plan_cpu_s": plan["took"]["cpu_s"],
        "plan_wall_s": plan["took"]["wall_s"],
        "load": plan["machine"]["load"],
        "cpu_s": against(whole["cpu_s"], run["cpu_s"]),
        "wall_s": against(whole["wall_s"], run["wall_s"]),
        "peak_mb": against(whole["memory_mb"], run["peak_memory_mb"]),
        "disk_mb": against(plan["disk_mb"], disk_mb),
        "pairs": [plan["num_pairs"], matching["num_pairs"]],
        "overlapping": against(plan["num_overlapping"], matching["num_verified_pairs"]),
        "matches": against(plan["num_matches"], matching["num_matches"]),
        "stages": {
            stage["stage"]: against(stage["cpu_s"], report["usage"][stage["stage"]]["cpu_s"])
            for stage in plan["stages"]
            if stage["stage"] in report["usage"]
        },
        "peaks_mb": {name: usage["peak_memory_mb"] for name, usage in report["usage"].items() if name != "kernels"},
        "groups": plan["groups"][:6],
        "warnings": [doubt["message"] for doubt in plan["doubts"] if doubt["weight"] == "warning"],
        "sentence": report.get("plan", {}).get("sentence", ""),
    }


def against(planned: dict[str, float], took: float) -> dict[str, Any]:
    """A planned interval beside what was taken."""
    return {
        **{key: round(planned[key], 4) for key in ("low", "likely", "high")},
        "took": round(took, 4),
        "ratio": round(planned["likely"] / took, 3) if took else None,
        "is_within": planned["low"] <= took <= planned["high"],
    }


def sfmapp(*words: str, may_fail: bool = False) -> str:
    """What a command prints, with a cache of its own; a run without a reconstruction has a report all the same."""
    command = [sys.executable, "-m", "sfmapp", *words]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True)
    if done.returncode and not (may_fail and done.returncode == 4):
        raise RuntimeError(f"{' '.join(words)}: {done.stderr[-500:]}")
    return done.stdout


@cache
def cache_folder() -> tempfile.TemporaryDirectory[str]:
    """There until this process ends."""
    return tempfile.TemporaryDirectory(prefix="planning-cache-")


@cache
def environment() -> dict[str, str]:
    """With a cache in which the machine has been measured."""
    folder = cache_folder().name
    given = os.environ | {"PYTHONPATH": str(ROOT / "src"), "XDG_CACHE_HOME": folder}
    given.setdefault("NUMBA_CACHE_DIR", str(Path(folder) / "numba"))
    command = [sys.executable, "-m", "sfmapp", "plan", str(ROOT / "data" / "courtyard" / "images"), "-q"]
    subprocess.run(command, env=given, check=True, stderr=subprocess.DEVNULL)
    return given


def is_near(row: Row, quantity: str) -> bool:
    """Whether a plan was within a quarter of what was taken."""
    return abs(row[quantity]["ratio"] - 1.0) <= WITHIN


def table(report: dict[str, Any]) -> str:
    """The report as Markdown."""
    rows = report["rows"]
    lines = [
        "# Plans", "",
        f"{report['date']}, {report['commit']}, {report['cpu']}, {report['cores']} cores. Planned / taken, and whether "
        "what was taken is inside of the interval.", "",
    ]  # fmt: skip
    for has_chosen, title in ((True, "Sets that have chosen constants"), (False, "Sets that have not")):
        mine = [row for row in rows if row["has_chosen"] == has_chosen]
        head = ["set", "images", *QUANTITIES.values(), "pairs", "warnings", "plan, CPU s", "load"]
        lines += [f"## {title}", "", f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
        for row in mine:
            cells = [
                f"{row[q]['likely']:.4g} / {row[q]['took']:.4g}{'' if row[q]['is_within'] else ' (out)'}"
                for q in QUANTITIES
            ]
            lines.append(
                f"| {row['case']} | {row['num_images']} | " + " | ".join(cells) + f" | {row['pairs'][0]} / "
                f"{row['pairs'][1]} | {len(row['warnings'])} | {row['plan_cpu_s']:.1f} | {row['load']:.1f} |"
            )
        if mine:
            near = ", ".join(f"{name} {sum(is_near(row, q) for row in mine)}" for q, name in QUANTITIES.items())
            inside = ", ".join(f"{name} {sum(row[q]['is_within'] for row in mine)}" for q, name in QUANTITIES.items())
            lines += ["", f"Within a quarter, of {len(mine)}: {near}. Inside the interval: {inside}.", ""]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
