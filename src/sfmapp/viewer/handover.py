"""Dataclasses of arrays on their way to the process that draws them: the arrays as npz, the rest as JSON."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np


def save_fields(folder: Path, stem: str, record: Any) -> None:
    """Write the fields of a dataclass, arrays and what JSON can hold, to ``STEM.npz`` and ``STEM.json``."""
    values = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
    np.savez(folder / f"{stem}.npz", allow_pickle=False, **arrays)
    text = {name: value for name, value in values.items() if name not in arrays}
    (folder / f"{stem}.json").write_text(json.dumps(text), encoding="utf-8")


def load_fields(folder: Path, stem: str) -> dict[str, Any]:
    """What :func:`save_fields` wrote; tuples come back as lists."""
    values: dict[str, Any] = json.loads((folder / f"{stem}.json").read_text(encoding="utf-8"))
    with np.load(folder / f"{stem}.npz", allow_pickle=False) as arrays:
        values.update({name: arrays[name] for name in arrays.files})
    return values
