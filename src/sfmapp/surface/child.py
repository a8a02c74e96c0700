"""Work that may end its process, done in a process of its own, with arrays in and arrays out."""

from __future__ import annotations

import signal
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import NoReconstructionError
from sfmapp.evaluation.measured import ProcessUsage, run_measured
from sfmapp.events import Events

AnyArray = NDArray[Any]


def run_child(
    module: str,
    task: str,
    arrays: Mapping[str, AnyArray],
    arguments: tuple[object, ...],
    advice: str,
    events: Events,
) -> dict[str, AnyArray]:
    """Run ``python -m module INPUT OUTPUT ARGUMENTS`` and hand its arrays back.

    Args:
        module: reads INPUT and writes OUTPUT, both npz.
        task: what it does, for messages.
        arrays: of INPUT.
        arguments: further ones, as they print.
        advice: what the user can do when it fails.
        events: asked many times a second whether to go on; the child is killed if not.

    Returns:
        The arrays of OUTPUT.

    Raises:
        NoReconstructionError: the child ended without a result.
        InterruptedRunError: ``events`` was asked to stop.
    """
    with tempfile.TemporaryDirectory(prefix="sfmapp-surface-") as name:
        source, target, log = (Path(name) / file for file in ("input.npz", "output.npz", "log"))
        np.savez(source, allow_pickle=False, **arrays)
        # -P: whatever lies in the working folder is not imported
        command = [sys.executable, "-P", "-m", module, str(source), str(target), *map(str, arguments)]
        try:
            usage = run_measured(command, log, on_tick=events.raise_if_cancelled)
        except OSError as error:
            raise NoReconstructionError(f"{task}: its process did not start: {error.strerror or error}") from error
        if usage.exit_code != 0 or not target.is_file():
            raise NoReconstructionError(f"{task}: {_ending(usage, log)}", advice)
        with np.load(target, allow_pickle=False) as data:
            return {key: data[key] for key in data.files}


def _ending(usage: ProcessUsage, log: Path) -> str:
    """How a child came to its end."""
    peak = f"after {usage.wall_s:.0f} s with {usage.peak_memory_mb:.0f} MB of memory"
    if usage.exit_code < 0:
        try:
            name = signal.Signals(-usage.exit_code).name
        except ValueError:
            name = str(-usage.exit_code)
        hint = ", as when memory runs out" if name == "SIGKILL" else ""
        return f"its process was ended by signal {name}{hint}, {peak}"
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return f"its process ended with exit code {usage.exit_code}, {peak}: {lines[-1] if lines else 'no message'}"
