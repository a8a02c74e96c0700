"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfmapp.errors import InputError, remedy

if TYPE_CHECKING:
    from numpy.typing import NDArray


@contextmanager
def replaced_file(path: Path) -> Iterator[Path]:
    """A path beside ``path`` to write to; renamed onto it at the end, removed if an exception passes.

    Raises:
        InputError: the folder cannot be written.
    """
    if not path.name:
        raise InputError(f"{path}: expected the name of a file to write, found a folder")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            yield beside
            os.replace(beside, path)
        finally:
            beside.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}", remedy(error)) from error


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file whole or not at all; raises as :func:`replaced_file`."""
    with replaced_file(path) as beside:
        beside.write_bytes(data)


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write an array as NumPy's file, whole or not at all; raises as :func:`replaced_file`."""
    import numpy as np

    with replaced_file(path) as beside, beside.open("wb") as stream:
        np.save(stream, array, allow_pickle=False)


@contextmanager
def replaced_folder(folder: Path, owned_names: Collection[str]) -> Iterator[Path]:
    """A new folder beside ``folder`` to write into; takes its place at the end, removed if an exception passes.

    Args:
        folder: where the result goes.
        owned_names: names of files that the format owns: those of an older version vanish with it. Everything else
            that lies in ``folder`` is carried over.

    Raises:
        InputError: the place cannot be written.
    """
    try:
        folder = folder.resolve()
        folder.parent.mkdir(parents=True, exist_ok=True)
        beside = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
        shutil.rmtree(beside, ignore_errors=True)
        beside.mkdir()
        try:
            yield beside
            _swap(beside, folder, owned_names)
        finally:
            shutil.rmtree(beside, ignore_errors=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror or error}", remedy(error)) from error


def _swap(beside: Path, folder: Path, owned_names: Collection[str]) -> None:
    if not folder.exists():
        beside.rename(folder)
        return
    old = beside.with_suffix(".old")
    folder.rename(old)
    beside.rename(folder)
    for entry in sorted(old.iterdir()):
        if entry.name not in owned_names:
            entry.rename(folder / entry.name)
    shutil.rmtree(old)
