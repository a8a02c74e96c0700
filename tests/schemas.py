"""Reports against the schemas that docs/reference/schemas promises."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "reference" / "schemas"


def check_schema(name: str, document: Any) -> None:
    """A document as it was read from JSON has to be as its schema says."""
    schema = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator(schema).validate(document)
