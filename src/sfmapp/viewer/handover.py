"""Dataclasses of arrays on their way to the process that draws them: the arrays as npz, the rest as JSON."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Self

import numpy as np

_ARRAYS, _TEXT = "replay.npz", "replay.json"


class HandedOver:
    """What dataclasses inherit whose fields are arrays and what JSON can hold; each has a folder of its own."""

    def save(self, folder: Path) -> None:
        """Write the fields to a folder, for the process that draws."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}  # type: ignore[arg-type]
        arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
        np.savez(folder / _ARRAYS, allow_pickle=False, **arrays)
        text = {name: value for name, value in values.items() if name not in arrays}
        (folder / _TEXT).write_text(json.dumps(text), encoding="utf-8")

    @classmethod
    def load(cls, folder: Path) -> Self:
        """What :meth:`save` wrote; tuples come back as lists."""
        values: dict[str, Any] = json.loads((folder / _TEXT).read_text(encoding="utf-8"))
        with np.load(folder / _ARRAYS, allow_pickle=False) as arrays:
            values.update({name: arrays[name] for name in arrays.files})
        return cls(**values)
