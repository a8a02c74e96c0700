"""How results and reports are spelt in JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


def canonical_json(value: Any) -> str:
    """The one spelling of plain values that hashes are made of."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)


def plain_number(value: Any) -> Any:
    """What JSON makes of numpy's scalars and arrays, of paths and of sets; for ``json.dumps(default=...)``."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, set | frozenset):
        return sorted(value)
    return str(value)


def report_text(report: Mapping[str, Any]) -> str:
    """JSON with a line for each entry of the outermost objects and lists: readable, and written in one go."""
    parts = []
    for key, value in report.items():
        if isinstance(value, list) and value:
            text = "[\n  " + ",\n  ".join(json.dumps(entry, default=plain_number) for entry in value) + "\n ]"
        else:
            text = json.dumps(value, default=plain_number)
        parts.append(f" {json.dumps(key)}: {text}")
    return "{\n" + ",\n".join(parts) + "\n}\n"
