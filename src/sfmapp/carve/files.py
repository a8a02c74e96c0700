"""An octree as a file of arrays."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from sfmapp.carve.octree import MAX_DEPTH, Octree
from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file

_NAMES = ("low", "side", "full", "level_starts", "surface")


def write_octree(path: Path, octree: Octree) -> None:
    """Write an octree as NumPy's compressed archive, whole or not at all.

    ================ ======== =========================================================================================
    ``low``          (3,)     corner of the cube, world
    ``side``         ()       of the cube, units of the world
    ``full``         (N,)     uint64 Morton codes of the cells inside, level by level, see :class:`Octree`
    ``level_starts`` (L + 2,) int64: those of level l are ``full[level_starts[l]:level_starts[l + 1]]``
    ``surface``      (M,)     uint64 codes of the finest cells that the surface passes through
    ================ ======== =========================================================================================

    Raises:
        InputError: it cannot be written.
    """
    starts = np.cumsum([0, *map(len, octree.full)]).astype(np.int64)
    with replaced_file(path) as beside, beside.open("wb") as stream:
        np.savez_compressed(
            stream, low=octree.low, side=np.float64(octree.side), full=np.concatenate(octree.full), level_starts=starts,
            surface=octree.surface,
        )  # fmt: skip


def read_octree(path: Path) -> Octree:
    """Read what :func:`write_octree` wrote. Raises InputError if it is no such file, or damaged."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            low, side, full, starts, surface = (archive[name] for name in _NAMES)
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, AttributeError) as error:
        raise InputError(f"{path}: expected the octree of a volume: {error}") from None
    depth = len(starts) - 2
    is_sound = (
        low.shape == (3,) and side.shape == () and 0 <= depth <= MAX_DEPTH and starts.dtype == np.int64
        and full.dtype == surface.dtype == np.uint64 and full.ndim == surface.ndim == 1
        and starts[0] == 0 and starts[-1] == len(full) and (np.diff(starts) >= 0).all()
        and np.isfinite(low).all() and side > 0.0
    )  # fmt: skip
    if not is_sound:
        raise InputError(f"{path}: expected the octree of a volume, found other arrays, or damaged ones")
    parts = tuple(full[starts[level] : starts[level + 1]] for level in range(depth + 1))
    return Octree(low, float(side), depth, parts, surface)
