"""An octree as a file of arrays, and one joined with patches."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.joined import Joined, Nodes
from sfmapp.carve.octree import MAX_DEPTH, Octree
from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file

_NAMES = ("low", "side", "full", "level_starts", "surface")
_JOINED_NAMES = ("band", "node_starts", "node_codes", "node_distance")


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
    _write(path, _arrays(octree))


def write_joined(path: Path, joined: Joined) -> None:
    """Write what :func:`write_octree` writes, and beside it:

    ================= ======== ========================================================================================
    ``band``          ()       see :class:`~sfmapp.carve.joined.Joined`
    ``node_starts``   (L + 1,) int64: nodes of the l-th lattice are those from ``node_starts[l]`` on
    ``node_codes``    (N,)     uint64, ascending in each lattice
    ``node_distance`` (N,)     float32 signed distances, units of the world
    ================= ======== ========================================================================================

    Raises:
        InputError: it cannot be written.
    """
    nodes = {
        "band": np.float64(joined.band),
        "node_starts": np.cumsum([0, *(len(nodes.codes) for nodes in joined.nodes)]).astype(np.int64),
        "node_codes": np.concatenate([nodes.codes for nodes in joined.nodes]),
        "node_distance": np.concatenate([nodes.distance for nodes in joined.nodes]),
    }
    _write(path, _arrays(joined.tree) | nodes)


def _arrays(octree: Octree) -> dict[str, Any]:
    starts = np.cumsum([0, *map(len, octree.full)]).astype(np.int64)
    return {
        "low": octree.low, "side": np.float64(octree.side), "full": np.concatenate(octree.full),
        "level_starts": starts, "surface": octree.surface,
    }  # fmt: skip


def _write(path: Path, arrays: dict[str, Any]) -> None:
    with replaced_file(path) as beside, beside.open("wb") as stream:
        np.savez_compressed(stream, **arrays)


def read_octree(path: Path) -> Octree:
    """Read what :func:`write_octree` wrote. Raises InputError if it is no such file, or damaged."""
    low, side, full, starts, surface = _read(path, _NAMES)
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


def read_joined(path: Path) -> Joined:
    """Read what :func:`write_joined` wrote. Raises InputError if it is no such file, or damaged."""
    tree = read_octree(path)
    band, starts, codes, distance = _read(path, _JOINED_NAMES)
    is_sound = (
        band.shape == () and band > 0.0 and starts.dtype == np.int64 and codes.dtype == np.uint64
        and distance.dtype == np.float32 and starts.ndim == codes.ndim == 1 and codes.shape == distance.shape
        and 2 <= len(starts) <= tree.depth + 2 and starts[0] == 0 and starts[-1] == len(codes)
        and (np.diff(starts) > 0).all() and np.isfinite(distance).all()
    )  # fmt: skip
    if not is_sound:
        raise InputError(f"{path}: expected a volume joined with patches, found other arrays, or damaged ones")
    parts = [slice(starts[level], starts[level + 1]) for level in range(len(starts) - 1)]
    return Joined(tree, tuple(Nodes(codes[part], distance[part]) for part in parts), float(band))


def _read(path: Path, names: tuple[str, ...]) -> list[NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            return [archive[name] for name in names]
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, AttributeError) as error:
        raise InputError(f"{path}: expected the octree of a volume: {error}") from None
