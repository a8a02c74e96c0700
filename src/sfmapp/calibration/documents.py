"""JSON documents of this room: written beside and renamed, and read with what was expected where they are others."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.text_input import read_json_object
from sfmapp.reporting import Report, document_text, from_plain

R = TypeVar("R", bound=Report)


def write_document(path: Path, document: Mapping[str, Any]) -> None:
    """Write a document. Raises InputError if it cannot be written."""
    with replaced_file(path) as beside:
        beside.write_text(document_text(document), encoding="utf-8", errors="backslashreplace")


def read_document(
    path: Path, kind: type[R], form: str, expected: str, advice: str, fields: Mapping[str, Any] | None = None
) -> R:  # fmt: skip
    """A document that :func:`write_document` has written.

    Args:
        form: what its field ``format`` has to say.
        expected: what it is, for the error.
        fields: what the file holds, where it has been read already.

    Raises:
        InputError: it cannot be read, or is another: what was expected and found, and the advice.
    """
    fields = read_json_object(path) if fields is None else fields
    if fields.get("format") != form:
        found = fields.get("format", "no format")
        raise InputError(f"{path}: expected {expected} (format {form!r}), found {found!r}", advice)
    try:
        return from_plain(kind, fields)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
