"""Parts of a large set, and the models that they came to, as files: for workers that share no memory, and for a run
that was stopped. Arrays as they are, nothing that is run."""

from __future__ import annotations

import hashlib
import shutil
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.formats.atomic import replaced_file
from sfmapp.mapping.submaps import Part
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import Tracks

_OWN = ("image_idx", "image_camera_idx", "camera_idx", "track_idx")


@dataclass(frozen=True)
class StoredPart:
    """A part whose arrays are in a file.

    Attributes:
        path: of the file; models that it comes to are written beside it.
        image_names, cameras: as of :class:`~sfmapp.mapping.submaps.Part`.
    """

    path: Path
    image_names: list[str]
    cameras: list[Camera]


@dataclass(frozen=True)
class KeptParts:
    """Models of parts that an earlier run has come to, and where new ones are kept.

    Attributes:
        folder: made when it is needed.
        key: of whatever else than a part decides what it comes to.
    """

    folder: Path
    key: str

    def read(self, part: Part) -> list[Reconstruction] | None:
        """The models of a part; None where there are none, or none that can be read."""
        try:
            return read_models(self._path(part), part)
        except InputError:
            return None

    def write(self, part: Part, models: Sequence[Reconstruction]) -> None:
        """Keep the models of a part."""
        self.folder.mkdir(exist_ok=True)
        write_models(self._path(part), models)

    def remove(self) -> None:
        """Forget all, and what was kept under other keys."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, part: Part) -> Path:
        digest = hashlib.blake2b(self.key.encode(), digest_size=16)
        for name, array in sorted(_arrays_of(part).items()):
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(array).data)
        for camera in part.cameras:
            prior = (camera.model.name, camera.width, camera.height, camera.focal_sigma, camera.is_fixed)
            digest.update(repr(prior).encode())
            digest.update(camera.params.data)
            digest.update(b"" if camera.prior_covariance is None else camera.prior_covariance.tobytes())
        return self.folder / f"{digest.hexdigest()}.npz"


def store_part(folder: Path, number: int, part: Part) -> StoredPart:
    """Write the arrays of a part, by its number, to a folder."""
    path = folder / f"part_{number}.npz"
    _save(path, _arrays_of(part))
    return StoredPart(path, part.image_names, part.cameras)


def map_stored(map_part: Callable[[Events, Part], list[Reconstruction]], stored: StoredPart) -> Path:
    """Map a part whose arrays are in a file, heard by nobody; the file of its models."""
    path = stored.path.with_suffix(".models.npz")
    write_models(path, map_part(Events(), _read_part(stored)))
    return path


def write_models(path: Path, models: Sequence[Reconstruction]) -> None:
    """Write models of one part: poses, points, which observations hold, and intrinsics."""
    arrays: dict[str, NDArray[Any]] = {"num_models": np.array(len(models))}
    for n, model in enumerate(models):
        arrays |= {
            f"cam_from_world_{n}": model.cam_from_world, f"point_xyz_{n}": model.point_xyz,
            f"obs_is_inlier_{n}": model.obs_is_inlier,
            f"params_{n}": np.concatenate([camera.params for camera in model.cameras]),
        }  # fmt: skip
    _save(path, arrays)


def read_models(path: Path, part: Part) -> list[Reconstruction]:
    """Models that :func:`write_models` has written, of the part that they are of.

    Raises:
        InputError: the file is not there, or is not one of these.
    """
    ends = np.cumsum([len(camera.params) for camera in part.cameras])[:-1]
    with _loaded(path) as arrays:
        models = []
        for n in range(int(arrays["num_models"])):
            params = np.split(arrays[f"params_{n}"], ends)
            cameras = [replace(camera, params=own) for camera, own in zip(part.cameras, params, strict=True)]
            model = Reconstruction.empty(cameras, part.image_names, part.image_camera_idx, part.tracks)
            model.cam_from_world = arrays[f"cam_from_world_{n}"]
            model.point_xyz = arrays[f"point_xyz_{n}"]
            model.obs_is_inlier = arrays[f"obs_is_inlier_{n}"]
            models.append(model)
        return models


def _read_part(stored: StoredPart) -> Part:
    with _loaded(stored.path) as arrays:
        own = {name: arrays[name] for name in _OWN}
        tracks = Tracks(**{field.name: arrays[f"tracks.{field.name}"] for field in fields(Tracks)})
        found = {field.name: arrays[f"correspondences.{field.name}"] for field in fields(Correspondences)}
    return Part(
        image_names=stored.image_names, cameras=stored.cameras, correspondences=Correspondences(**found), tracks=tracks,
        **own,
    )  # fmt: skip


def _arrays_of(part: Part) -> dict[str, NDArray[Any]]:
    arrays = {name: getattr(part, name) for name in _OWN}
    for prefix, value in (("tracks", part.tracks), ("correspondences", part.correspondences)):
        arrays |= {f"{prefix}.{field.name}": getattr(value, field.name) for field in fields(value)}
    return arrays


def _save(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    """Write arrays, whole or not at all."""
    with replaced_file(path) as beside, beside.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


@contextmanager
def _loaded(path: Path) -> Iterator[Any]:
    """The arrays of a file; whatever is wrong with it is an InputError."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            yield arrays
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: expected a part of a large set, or its models: {error}") from error
