"""What the numbers of a benchmark depend on, and where they are kept."""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
# one file a benchmark, NAME.json, with its tables beside it, NAME.md; the date is inside
RESULTS = ROOT / "benchmarks" / "results"
PACKAGES = ("sfmapp", "pycolmap", "numpy", "numba", "opencv-contrib-python-headless", "gtsam")


def describe_machine() -> dict[str, Any]:
    """Date, commit, versions and processor."""
    model = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    is_dirty = bool(_git("status", "--porcelain", "--untracked-files=no", "src", "pipelines"))
    return {
        "date": datetime.now(UTC).isoformat(timespec="minutes"),
        "commit": _git("rev-parse", "--short", "HEAD") + ("+changes" if is_dirty else ""),
        "versions": {name: version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "cpu": model[0].split(":")[1].strip() if model else platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
    }


def _git(*words: str) -> str:
    return subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True).stdout.strip()
