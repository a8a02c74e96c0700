"""What runs in a worker of a cluster: it says what it is before it is given work, and works as the run itself would."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TypeVar

from sfmapp.errors import SfmError
from sfmapp.kernel_cache import provide_kernel_cache, take_turns

Unit = TypeVar("Unit")
Result = TypeVar("Result")

_PACKAGE = Path(__file__).resolve().parent.parent
# what computes results, and may compute others in another version
_DISTRIBUTIONS = ("sfmapp", "numba", "llvmlite", "numpy", "opencv-contrib-python-headless", "scipy")


class WorkerError(SfmError):
    """A worker could not do what it was given; the message names it."""


@dataclass(frozen=True)
class Facts:
    """What a process is.

    Attributes:
        code: hash of sfmapp's source.
        versions: of Python and of the libraries that compute, by name.
        seen: of the paths that it was asked for.
        host: for people.
    """

    code: str
    versions: Mapping[str, str]
    seen: tuple[str, ...]
    host: str


def facts(paths: tuple[str, ...]) -> Facts:
    """What this process is, and which of some paths it sees."""
    return Facts(_code(), _versions(), tuple(path for path in paths if os.path.exists(path)), platform.node())


def why_unfit(own: Facts, other: Facts, paths: tuple[str, ...]) -> str:
    """Why a worker cannot give the results that this process would; empty if it can."""
    if missing := [path for path in paths if path not in other.seen]:
        return f"it does not see {missing[0]}"
    for name, version in own.versions.items():
        found = other.versions.get(name, "none")
        if found != version:
            return f"it has {name} {found}, this process has {version}"
    if own.code != other.code:
        return "the source of its sfmapp is another"
    return ""


def do_unit(work: Callable[[Unit], Result], unit: Unit) -> Result:
    """One unit, in a worker.

    Raises:
        WorkerError: it has not enough memory, or its system refuses something.
        Exception: whatever the work raises.
    """
    _prepare_process()
    try:
        return work(unit)
    except MemoryError as error:
        raise WorkerError(
            f"a worker on {platform.node()} ran out of memory", "give workers more memory, or fewer threads each"
        ) from error
    except OSError as error:
        raise WorkerError(f"a worker on {platform.node()}: {error}") from error


@cache
def _prepare_process() -> None:
    """Once for a worker: kernels from a cache that others fill too, and one thread for each unit."""
    import cv2

    provide_kernel_cache()
    take_turns()
    cv2.setNumThreads(1)


@cache
def _code() -> str:
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


@cache
def _versions() -> Mapping[str, str]:
    found = {"Python": ".".join(map(str, sys.version_info[:2]))}
    for name in _DISTRIBUTIONS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "none"
    return found
