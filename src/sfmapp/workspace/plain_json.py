"""The one spelling of plain values that hashes are made of; reports are in :mod:`sfmapp.reporting`."""

from __future__ import annotations

import json
from typing import Any


def canonical_json(value: Any) -> str:
    """The one spelling of plain values that hashes are made of."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
