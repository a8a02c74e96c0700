"""Which of our source files a stage runs, found by following its imports.

A change to any of them may change the results of the stage, so that their hash is part of its key: nobody has to
remember to raise a version number. Imports within functions count, those for type checkers alone do not; a module named
in a string counts as well, as children are started by their name. What only keeps and shows results (:data:`_SHELL`)
has no part in them, wherever it is imported.
"""

from __future__ import annotations

import hashlib
import re
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent
_SHELL = ("cli", "workspace", "report", "viewer")
# Parsing a hundred modules takes 300 ms, this takes 10, for patterns that begin with plain text are found fast. The
# formatter sees to it that imports look like that, and tests/test_workspace_code.py that a parser finds the same.
_FOR_TYPES = re.compile(r"\nif TYPE_CHECKING:\n(?:(?:[ \t].*)?\n)+")
_FROM = re.compile(r"from sfmapp([\w.]*) import (\([^)]*\)|.*)")
_WHOLE = re.compile(r"import sfmapp\.([\w.]+)")
_NAMED = re.compile(r'"sfmapp\.([a-z_0-9.]+)"')
_ALIAS = re.compile(r" as \w+|#.*")
_WORD = re.compile(r"\w+")


@cache
def source_digest(*entries: str) -> str:
    """Hash of the source of some of our modules and of all that they import."""
    digest = hashlib.blake2b(digest_size=16)
    for module in sorted(closure(*entries)):
        digest.update(module.encode() + b"\0" + _source(module).encode() + b"\0")
    return digest.hexdigest()


def closure(*entries: str) -> set[str]:
    """Names of modules and of all of ours that they import, at the first or the last hand."""
    found: set[str] = set()
    ahead = list(entries)
    while ahead:
        module = ahead.pop()
        if module not in found:
            found.add(module)
            ahead += [other for other in imported(module) if other.split(".")[1] not in _SHELL]
    return found


@cache
def imported(module: str) -> frozenset[str]:
    """Names of our modules that one imports when it is run, or names in a string."""
    text = _FOR_TYPES.sub("", _source(module))
    found = {f"sfmapp.{name}" for name in _WHOLE.findall(text)}
    for rest, names in _FROM.findall(text):
        base = f"sfmapp{rest}"
        if _is_room(base):
            found |= {
                sub if path_of(sub := f"{base}.{name}") else base for name in _WORD.findall(_ALIAS.sub("", names))
            }
        else:
            found.add(base)
    found |= {name for rest in _NAMED.findall(text) if path_of(name := f"sfmapp.{rest}")}
    return frozenset(found - {"sfmapp", module})


@cache
def _is_room(module: str) -> bool:
    return PACKAGE.joinpath(*module.split(".")[1:]).is_dir()


@cache
def path_of(module: str) -> Path | None:
    """File of one of our modules; None if it is no module."""
    path = PACKAGE.joinpath(*module.split(".")[1:])
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return file if file.is_file() else None


@cache
def _source(module: str) -> str:
    path = path_of(module)
    if path is None:
        raise ModuleNotFoundError(f"there is no module {module}")
    return path.read_text(encoding="utf-8")
