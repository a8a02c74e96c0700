"""What solves a reduced system quickest: our tiles, our envelope, gtsam or LAPACK, by size and fill.

One thread, CPU seconds. Systems are random, of six unknowns a pose, on two patterns: ``loop``, neighbours along a
closed way, as a sequence has them, and ``places``, neighbours in a plane in random order, as a pile of photographs has
them. Each solver gets the same tiles and has to find the same step; the least of several runs counts, as other work on
the machine only adds.

    python benchmarks/reduced_systems.py
    python benchmarks/reduced_systems.py --sizes 60 300 --fills 0.1 0.5 -o /tmp/new/reduced_systems.md
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.linalg.lapack  # noqa: F401  before its threads are limited
from threadpoolctl import threadpool_limits

from machine import RESULTS, describe_machine
from sfmapp.adjust.envelope import EnvelopeSystem
from sfmapp.adjust.factors import SparseSystem
from sfmapp.adjust.linear import LapackSystem, ReducedSystem, TileSystem, aligned_zeros, choose_solver

SIZES = (10, 25, 60, 126, 300, 500, 1000)
FILLS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0)
DIM = 6
SOLVERS = ("tiles", "envelope", "gtsam", "lapack")
# Tiles are for fewer poses than that.
MAX_TILE_POSES = 300
# Repeats go on for so long, at least two; longer systems than that are run once.
REPEAT_S, LONG_S = 0.2, 4.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="numbers of poses")
    parser.add_argument("--fills", type=float, nargs="+", default=FILLS, help="shares of pairs that meet")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "reduced_systems.md")
    arguments = parser.parse_args()
    rows = []
    with threadpool_limits(1, "blas"):
        for pattern in ("loop", "places"):
            for size in arguments.sizes:
                done = set()
                for fill in arguments.fills:
                    row = measure(pattern, size, fill)
                    if row["fill"] not in done:  # few poses have few fills
                        rows.append(row)
                        print(described(row), flush=True)
                    done.add(row["fill"])
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    report = describe_machine() | {"rows": rows}
    arguments.output.write_text(table(report), encoding="utf-8")


def measure(pattern: str, size: int, fill: float) -> dict[str, Any]:
    """CPU seconds of a step by each solver."""
    rng = np.random.default_rng(0)
    met = neighbours(pattern, size, fill, rng)
    keys = np.flatnonzero(met)
    tiles, right = random_system(keys, size, rng)
    dims = np.full(size, DIM)
    systems: dict[str, ReducedSystem] = {
        "tiles": TileSystem(size),
        "envelope": EnvelopeSystem(dims, keys, keys),
        "gtsam": SparseSystem(posed(size), keys, keys, []),
        "lapack": LapackSystem(dims, keys, keys),
    }
    row: dict[str, Any] = {"pattern": pattern, "poses": size, "fill": round(2 * len(keys) / (size * (size + 1)), 3)}
    steps = {}
    for name, system in systems.items():
        if name == "tiles" and size > MAX_TILE_POSES:
            continue
        row[name], steps[name] = quickest(partial(solve_once, system, tiles, right))
    for step in steps.values():
        assert np.abs(step - steps["lapack"]).max() < 1e-9
    row["chosen"] = choose_solver(size, DIM * size, row["fill"], is_closing=True)
    return row


def solve_once(system: ReducedSystem, tiles: np.ndarray, right: np.ndarray) -> np.ndarray | None:
    """A step; what the solver spoils are copies."""
    return system.solve(tiles.copy(), right.copy())


def neighbours(pattern: str, size: int, fill: float, rng: np.random.Generator) -> np.ndarray:
    """(B, B) bool, upper: which poses meet."""
    if pattern == "loop":
        apart = np.abs(np.arange(size)[:, None] - np.arange(size))
        apart = np.minimum(apart, size - apart).astype(float)
    else:
        place = rng.uniform(size=(size, 2))
        apart = np.linalg.norm(place[:, None] - place, axis=2)
    return np.triu((apart <= np.quantile(apart, fill)) | np.eye(size, dtype=bool))


def random_system(keys: np.ndarray, size: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Tiles (B * B * 64,) of a positive definite system, and a right-hand side (B * 8,)."""
    first, second = np.divmod(keys, size)
    tiles = aligned_zeros(size * size * 64)
    view = tiles.reshape(-1, 8, 8)
    values = np.zeros((len(keys), 8, 8))
    values[:, :DIM, :DIM] = 0.1 * rng.normal(size=(len(keys), DIM, DIM))
    weight = 0.8 * (np.bincount(first, minlength=size) + np.bincount(second, minlength=size))
    own = first == second
    values[own] = np.eye(8) * np.where(np.arange(8) < DIM, 1.0, 0.0)[:, None]
    values[own] *= weight[:, None, None]
    values[own] += np.diag(np.where(np.arange(8) < DIM, 0.0, 1.0))
    view[keys] = values
    right = rng.normal(size=(size, 8))
    right[:, DIM:] = 0.0
    return tiles, right.ravel()


def posed(size: int) -> Any:
    """What the sparse system asks of a problem: poses, and nothing else."""
    number, nothing = np.arange(size), np.zeros(0, np.int64)
    return SimpleNamespace(
        num_blocks=size, num_pose_blocks=size, block_dim=np.full(size, DIM), image_idx=number, pose_images=number,
        pose_block=number, camera_block=nothing, second_block=nothing, camera_idx=nothing, track_idx=nothing,
        point_block=nothing,
    )  # fmt: skip


def quickest(solve: Callable[[], Any]) -> tuple[float, Any]:
    """The least CPU seconds of several runs, after one that nobody counts, and what came of it."""
    begin = time.process_time()
    found = solve()
    best = time.process_time() - begin
    if best > LONG_S:
        return best, found
    spent = count = 0.0
    while count < 2 or spent < REPEAT_S:
        begin = time.process_time()
        solve()
        took = time.process_time() - begin
        best, spent, count = min(best, took), spent + took, count + 1
    return best, found


def described(row: dict[str, Any]) -> str:
    """A system in a line."""
    times = ", ".join(f"{name} {1e3 * row[name]:.1f} ms" for name in SOLVERS if name in row)
    return f"{row['pattern']}, {row['poses']} poses, {row['fill']:.0%} full: {times}"


def table(report: dict[str, Any]) -> str:
    """The tables as Markdown."""
    where = f"{report['date'][:10]}, commit {report['commit']}, {report['cpu']}"
    head = ("pattern", "poses", "fill", "tiles", "envelope", "gtsam", "LAPACK", "a closing adjustment takes")
    lines = [
        "# Reduced systems",
        "",
        f"{where}, one thread; CPU milliseconds of a step.",
        "",
        f"| {' | '.join(head)} |",
        "|" + "---|" * len(head),
    ]
    for row in report["rows"]:
        times = " | ".join(f"{1e3 * row[name]:.1f}" if name in row else "" for name in SOLVERS)
        lines.append(f"| {row['pattern']} | {row['poses']} | {row['fill']:.0%} | {times} | {row['chosen']} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
