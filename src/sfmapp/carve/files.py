"""An octree as a file of arrays, one joined with patches, and what photographs see of a surface."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.joined import Joined, Nodes
from sfmapp.carve.octree import Octree
from sfmapp.carve.options import MAX_DEPTH
from sfmapp.carve.sight import Sight, sight_of_map
from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file

_NAMES = ("low", "side", "full", "level_starts", "surface")
_JOINED_NAMES = ("band", "node_starts", "node_codes", "node_distance")
_SIGHT_NAMES = ("k", "cam_from_world", "shape", "depth")


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


def write_sights(path: Path, sights: Sequence[Sight]) -> None:
    """Write sights that :func:`~sfmapp.carve.sight.sight_of_map` made as NumPy's compressed archive.

    ================== ====== ==========================================================================================
    ``k``              (S, 4) ``fx, fy, cx, cy`` in pixels of the map, the centre of the top-left one (0.5, 0.5)
    ``cam_from_world`` (S, 7) pose, see :mod:`sfmapp.geometry.rigid3`
    ``shape``          (S, 2) int64 height and width of each map
    ``depth``          (N,)   float32 the maps one after another, row by row, units of the world; NaN: not known
    ================== ====== ==========================================================================================

    Raises:
        InputError: it cannot be written.
    """
    maps = {
        "k": np.array([sight.k for sight in sights]),
        "cam_from_world": np.array([sight.cam_from_world for sight in sights]),
        "shape": np.array([sight.depth.shape for sight in sights], np.int64),
        "depth": np.concatenate([sight.depth.ravel() for sight in sights]),
    }
    _write(path, maps)


def read_sights(path: Path) -> list[Sight]:
    """Read what :func:`write_sights` wrote, the same to the last bit. Raises InputError if it is no such file, or
    damaged."""
    k, poses, shape, depth = _read(path, _SIGHT_NAMES)
    num = len(shape) if shape.ndim else 0
    is_sound = (
        k.shape == (num, 4) and poses.shape == (num, 7) and shape.shape == (num, 2) and shape.dtype == np.int64
        and depth.dtype == np.float32 and depth.ndim == 1 and (shape > 0).all()
        and int(shape.prod(axis=1).sum()) == len(depth)
    )  # fmt: skip
    if not is_sound:
        raise InputError(f"{path}: expected depth maps of photographs, found other arrays, or damaged ones")
    parts = np.split(depth, np.cumsum(shape.prod(axis=1))[:-1])
    return [sight_of_map(*sight) for sight in zip(k, poses, map(np.reshape, parts, shape), strict=True)]


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
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, AttributeError):
        # what numpy says of other files is that they could be loaded "unsafely"
        raise InputError(
            f"{path}: expected an archive of {', '.join(names)}, found another file, or a damaged one"
        ) from None
