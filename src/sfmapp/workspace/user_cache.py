"""What is remembered of this machine between runs, for this user: small JSON documents, and nothing that is run.

They lie in ``$XDG_CACHE_HOME/sfmapp``, else in ``~/.cache/sfmapp``. What cannot be written is not remembered, and what
is damaged, or of another version, is not there.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file
from sfmapp.reporting import R, Report, from_plain, to_json
from sfmapp.workspace.manifest import read_json

# documents of a kind; the oldest make room
_MOST = 100


def remember(kind: str, key: str, document: Report) -> None:
    """Keep a document until the cache is emptied, or a hundred newer ones of its kind are there."""
    folder = _folder(kind)
    if folder is None:
        return
    with contextlib.suppress(InputError, OSError):
        with replaced_file(folder / f"{key}.json") as beside:
            beside.write_text(to_json(document), encoding="utf-8", errors="backslashreplace")
        by_age = sorted(folder.glob("*.json"), key=lambda path: path.stat().st_mtime)
        for path in by_age[:-_MOST]:
            path.unlink()


def recall(kind: str, key: str, as_report: type[R]) -> R | None:
    """The document that was kept under a key; None if there is none that can be read as this."""
    folder = _folder(kind)
    try:
        return None if folder is None else from_plain(as_report, read_json(folder / f"{key}.json"))
    except ValueError:
        return None


def _folder(kind: str) -> Path | None:
    """Where documents of a kind lie; None where the user has no such place."""
    root = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    return root / "sfmapp" / kind if root.is_absolute() else None
