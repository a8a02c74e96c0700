"""``sfmapp reconstruct --cluster`` with 1, 2 and 4 local workers, one of them killed at random: the same bytes or not.

    SFMAPP_DATA=... python benchmarks/clusters.py
    SFMAPP_DATA=... python benchmarks/clusters.py --only fountain-P11

A worker is killed after a random share of the steps of features and matching, in three draws. CPU time is that of the
process and of its workers; what workers are on two cores is the cost of dask, and no gain.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cases import measure_cases

DATA = Path(os.environ.get("SFMAPP_DATA", "data"))
SETS = ("temple-sparse-ring", "fountain-P11", "opensfm-lund")
WORKERS, DRAWS = (1, 2, 4), 3


def measured(name: str) -> Iterator[dict[str, Any]]:
    """Rows of a set: threads, workers, and four workers of which one is killed."""
    expected, num_steps = "", 0
    for workers, draw in [(0, None), *((n, None) for n in WORKERS), *((WORKERS[-1], n) for n in range(DRAWS))]:
        kill_at = None
        if draw is not None:
            kill_at = int(np.random.default_rng([draw, *name.encode()]).integers(1, num_steps))
        row, digest, num_steps = reconstructed(name, workers, kill_at)
        expected = expected or digest
        yield {"case": name, "workers": workers, "killed_at_step": kill_at, **row, "is_same": digest == expected}


def reconstructed(name: str, workers: int, kill_at: int | None) -> tuple[dict[str, Any], str, int]:
    """What one run took, the digest of its model, and how many steps its features and matches had."""
    import sfmapp
    from sfmapp.events import Event, Events

    steps = [0]

    def listen(event: Event) -> None:
        if event.kind == "advanced" and event.stage in ("features", "matching"):
            steps[0] += 1
            if steps[0] == kill_at:
                min(multiprocessing.active_children(), key=lambda child: child.pid or 0).kill()

    options = replace(sfmapp.load_options(), cluster=f"local:{workers}" if workers else None)
    start, cpu = time.perf_counter(), _cpu_s()
    with tempfile.TemporaryDirectory() as folder:
        sfmapp.reconstruct(DATA / name / "images", folder, options, events=Events(listen), record=False)
        digest = hashlib.blake2b(digest_size=16)
        for path in sorted(Path(folder).glob("sparse/*/*.bin")):
            digest.update(path.name.encode() + path.read_bytes())
    took = {"wall_s": round(time.perf_counter() - start, 1), "cpu_s": round(_cpu_s() - cpu, 1)}
    return took, digest.hexdigest(), steps[0]


def _cpu_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def markdown(report: dict[str, Any]) -> str:
    """The table."""
    lines = [
        f"Measured {report['date'][:10]}, {report['commit']}, {report['cpu']}, {report['cores']} cores.",
        "",
        "| set | workers | killed | wall, s | CPU, s | the bytes of threads |",
        "|---|---|---|---|---|---|",
    ]
    for row in report["rows"]:
        killed = "" if row["killed_at_step"] is None else f"one, at step {row['killed_at_step']}"
        lines.append(
            f"| {row['case']} | {row['workers'] or 'threads'} | {killed} | {row['wall_s']} | {row['cpu_s']} |"
            f" {'yes' if row['is_same'] else '**no**'} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    measure_cases("clusters", __doc__, SETS, measured, markdown)
