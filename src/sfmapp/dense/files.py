"""The files that hold patches: ``fused.ply`` for others to read, ``patches.npz`` with all that we know of them."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.scene import Patches
from sfmapp.errors import InputError
from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.ply import COLORS, TYPES

FORMAT = "sfmapp patches 1"
CHUNK = 1 << 20
_PLY_FIELDS = (
    *((axis, "double") for axis in "xyz"), *((axis, "float") for axis in ("nx", "ny", "nz")),
    *((color, "uchar") for color in COLORS), ("views", "uchar"), ("score", "float"), ("sigma", "float"),
)  # fmt: skip
# name, kind of its dtype, its shape: N patches, N+1, M trusted images or a number
_ARRAYS = (
    ("xyz", "f8", ("N", 3)), ("normal", "f4", ("N", 3)), ("rgb", "u1", ("N", 3)), ("reference", "i4", ("N",)),
    ("view_ptr", "i8", ("N+1",)), ("view_idx", "i4", ("M",)), ("score", "f4", ("N",)), ("sigma", "f4", ("N",)),
    ("size", "f4", ("N",)), ("wave", "i4", ("N",)),
)  # fmt: skip


def write_fused_ply(path: str | Path, patches: Patches) -> None:
    """Write binary little-endian vertices: x y z (double), nx ny nz (float), red green blue (uchar), ``views``, the
    number of trusted images (uchar), ``score``, their mean NCC (float), and ``sigma``, the standard deviation along
    the ray of the reference image in units of the world (float).

    Raises:
        InputError: the file cannot be written.
    """
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(patches)}"]
    lines += [f"property {ply_kind} {name}" for name, ply_kind in _PLY_FIELDS]
    with replaced_file(Path(path)) as beside, beside.open("wb") as file:
        file.write("\n".join([*lines, "end_header", ""]).encode())
        for start in range(0, len(patches), CHUNK):
            file.write(_vertices(patches, slice(start, start + CHUNK)).tobytes())


def _vertices(patches: Patches, part: slice) -> NDArray[Any]:
    num_views = patches.num_views[part]
    data = np.empty(len(num_views), [(name, "<" + TYPES[kind]) for name, kind in _PLY_FIELDS])
    for column, axis in enumerate("xyz"):
        data[axis], data[f"n{axis}"] = patches.xyz[part, column], patches.normal[part, column]
    for column, color in enumerate(COLORS):
        data[color] = patches.rgb[part, column]
    data["views"], data["score"], data["sigma"] = num_views.clip(0, 255), patches.score[part], patches.sigma[part]
    return data


def write_patches(path: str | Path, patches: Patches, names: Sequence[str]) -> None:
    """Write all that is known of patches as a numpy archive without pickles.

    It holds ``format``, ``names`` of the images and the arrays of :class:`Patches`, with ``reference`` for the
    position of the reference image; the trusted images of patch p are ``view_idx[view_ptr[p]:view_ptr[p + 1]]``.

    Args:
        path: ends in ``.npz``.
        patches: what to write.
        names: of the images that ``view_idx`` counts.

    Raises:
        InputError: the file cannot be written.
    """
    arrays: dict[str, Any] = {name: np.asarray(getattr(patches, _field(name)), kind) for name, kind, _ in _ARRAYS}
    with replaced_file(Path(path)) as beside, beside.open("wb") as file:
        arrays |= {"format": np.array(FORMAT), "names": np.array(list(names), np.str_)}
        np.savez(file, allow_pickle=False, **arrays)


def read_patches(path: str | Path) -> tuple[Patches, tuple[str, ...]]:
    """Read what :func:`write_patches` has written: the patches, and the names of the images.

    Raises:
        InputError: the file is missing, not of this format, or does not fit together.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            found = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, KeyError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InputError(f"{path}: cannot be read: {reason}") from error
    version = str(found["format"]) if "format" in found else "another file"
    if version != FORMAT:
        raise InputError(f"{path}: expected {FORMAT!r}, found {version!r}", "run sfmapp dense again")
    names = found.get("names", np.zeros(0, np.str_))
    if names.ndim != 1 or names.dtype.kind != "U":
        raise InputError(f"{path}: expected names of images, found {names.dtype} of shape {names.shape}")
    _check(path, found, len(names))
    fields = {_field(name): found[name] for name, _, _ in _ARRAYS if name != "reference"}
    return Patches(**fields), tuple(names.tolist())


def _field(name: str) -> str:
    return "reference_idx" if name == "reference" else name


def _check(path: Path, found: dict[str, NDArray[Any]], num_views: int) -> None:
    """Raise InputError unless all arrays are there and fit together."""
    count, num_trusted = (len(found[name]) if name in found and found[name].ndim else 0 for name in ("xyz", "view_idx"))
    lengths = {"N": count, "N+1": count + 1, "M": num_trusted}
    for name, kind, dims in _ARRAYS:
        shape = tuple(lengths.get(str(side), side) for side in dims)
        array = found.get(name)
        if array is None or array.dtype != np.dtype(kind) or array.shape != shape:
            what = "nothing" if array is None else f"{array.dtype} of shape {array.shape}"
            raise InputError(f"{path}: expected {name} as {np.dtype(kind)} of shape {shape}, found {what}")
    ptr, view_idx = found["view_ptr"], found["view_idx"]
    lists_fit = ptr[0] == 0 and ptr[-1] == num_trusted and bool((np.diff(ptr) >= 1).all())
    if not lists_fit or bool(((view_idx < 0) | (view_idx >= num_views)).any()):
        raise InputError(f"{path}: expected lists of the {num_views} images for {count} patches, found others")
    if not np.isfinite(found["xyz"]).all() or not np.isfinite(found["normal"]).all():
        raise InputError(f"{path}: expected finite places and normals, found NaN or infinity")
