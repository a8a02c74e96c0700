"""A finished reconstruction as other commands take it up: model, features, what was known of its cameras, options."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.events import Events
from sfmapp.formats.colmap import has_model, read_model
from sfmapp.formats.database import Database
from sfmapp.images.report import CameraPrior
from sfmapp.mapping.attach import KnownModel
from sfmapp.mapping.report import Uncertainty
from sfmapp.pipelines.stored_pixels import check_pixels
from sfmapp.report.model import ReconstructionReport
from sfmapp.reporting import from_plain
from sfmapp.scene.features import Features
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.workspace.layout import RECONSTRUCT, REPORT
from sfmapp.workspace.manifest import Manifest, read_json, read_manifest
from sfmapp.workspace.options import Options, options_from_dict

DATABASE = "database.db"
# Editors write a focal length as another fraction.
_SAME_FOCAL = 1e-3


class StoredFeatures(Sequence[Features]):
    """Features of images, read from a database where they are asked for, and not kept."""

    def __init__(self, database: Database, positions: Sequence[int]) -> None:
        """``positions``: of the images in the database."""
        self._database, self._positions = database, list(positions)

    def __len__(self) -> int:
        return len(self._positions)

    @overload
    def __getitem__(self, index: int) -> Features: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Features]: ...
    def __getitem__(self, index: int | slice) -> Features | Sequence[Features]:
        if isinstance(index, slice):
            return [self._database.read_features(position) for position in self._positions[index]]
        return self._database.read_features(self._positions[index])


@dataclass(frozen=True)
class Finished:
    """A finished reconstruction.

    Attributes:
        folder, manifest, options: of the run.
        known: its largest model.
        entries: what its report says of each camera beforehand; None where it does not.
        contradictions: what speaks against the model.
    """

    folder: Path
    manifest: Manifest
    options: Options
    known: KnownModel
    entries: Sequence[CameraPrior | None]
    contradictions: Sequence[str]

    def camera_like(self, entry: CameraPrior) -> int | None:
        """The camera of the model that took photographs of the same make, size and focal length, if there is one
        alone."""
        alike = [idx for idx, known in enumerate(self.entries) if known is not None and _is_same(known, entry)]
        return alike[0] if len(alike) == 1 else None


def read_finished(folder: Path, database: Database, events: Events) -> Finished:
    """Take up a finished reconstruction, whose largest model it is.

    Args:
        folder: OUT of ``sfmapp reconstruct``. database: its own, from :func:`open_database`.

    Raises:
        InputError: the folder holds no such run, one whose features are gone, or a model of an earlier version.
        NoReconstructionError: it holds no model.
    """
    manifest = read_manifest(folder, RECONSTRUCT)
    if not has_model(folder / "sparse" / "0"):
        raise NoReconstructionError(f"{folder} holds no model", "run sfmapp reconstruct again")
    check_pixels(folder, manifest)
    model, _ = read_model(folder / "sparse" / "0", events)
    cameras, names, camera_idx = database.read_images()
    place = {name: position for position, name in enumerate(names)}
    if missing := [name for name in model.image_names if name not in place]:
        raise InputError(f"{folder}: expected the features of {missing[0]} in its database, found none")
    positions = [place[name] for name in model.image_names]
    report = read_report(folder)
    stages = None if report is None else report.stages
    entries = {} if stages is None or stages.images is None else {e.camera_idx: e for e in stages.images.cameras}
    # the cameras of a model are those of its images; the database has all
    place_of = {int(model.image_camera_idx[i]): int(camera_idx[position]) for i, position in enumerate(positions)}
    of_model = [entries.get(place_of.get(c, -1)) for c in range(len(model.cameras))]
    priors = [
        _prior(cameras[place_of[c]] if c in place_of else camera, entry)
        for c, (camera, entry) in enumerate(zip(model.cameras, of_model, strict=True))
    ]
    refined = [
        replace(camera, focal_source=prior.focal_source, is_fixed=prior.is_fixed)
        for camera, prior in zip(model.cameras, priors, strict=True)
    ]
    known = KnownModel(replace(model, cameras=refined), StoredFeatures(database, positions), priors)
    against = [] if report is None or not report.models else [one.message for one in report.models[0].contradictions]
    return Finished(folder, manifest, options_from_dict(manifest.options), known, of_model, against)


def open_database(folder: Path) -> Database:
    """The features and matches of a finished reconstruction, to be closed. Raises InputError if they are gone."""
    read_manifest(folder, RECONSTRUCT)
    return Database(folder / DATABASE, read_only=True)


def read_report(folder: Path) -> ReconstructionReport | None:
    """The report of a reconstruction; None if it is gone, or of another version."""
    try:
        return from_plain(ReconstructionReport, read_json(folder / REPORT))
    except ValueError:
        return None


def _prior(camera: Camera, entry: CameraPrior | None) -> Camera:
    """A camera of the database with what the report says of it beforehand."""
    if entry is None:
        return camera
    return replace(
        camera, focal_sigma=entry.focal_sigma_px, focal_source=entry.focal_source, is_fixed=entry.is_fixed
    )  # fmt: skip


def _is_same(known: CameraPrior, entry: CameraPrior) -> bool:
    """Whether both may be of one camera: size, make and focal length as EXIF has them, or neither has EXIF."""
    told = [(one.width, one.height, one.make, one.camera) for one in (known, entry)]
    if told[0] != told[1]:
        return False
    if "default" in (known.focal_source, entry.focal_source) or known.focal_source == "user":
        return known.focal_source in ("user", entry.focal_source)
    return abs(known.focal_px - entry.focal_px) <= _SAME_FOCAL * entry.focal_px


def check_finished(folder: Path, manifest: Manifest) -> None:
    """Raise InputError if a folder holds no reconstruction that has come to its end."""
    stage = manifest.stage("mapping")
    if not stage.is_done or not has_model(folder / "sparse" / "0") or not (folder / DATABASE).is_file():
        raise InputError(
            f"{folder}: expected a finished reconstruction with its database, found none",
            f"run sfmapp reconstruct {manifest.source or 'PHOTOS'} -o {folder} to its end first",
        )
    check_pixels(folder, manifest)


def names_in_database(folder: Path) -> list[str]:
    """The photographs of a reconstruction, in the order of its database."""
    with Database(folder / DATABASE, read_only=True) as database:
        return database.read_images()[1]


def models_of(folder: Path) -> list[Reconstruction]:
    """All models, the largest first."""
    found: list[Reconstruction] = []
    while has_model(folder / "sparse" / str(len(found))):
        found.append(read_model(folder / "sparse" / str(len(found)))[0])
    return found


def uncertainty_of(folder: Path) -> Uncertainty:
    """How sure the largest model of a reconstruction is, by its report; empty where that is gone."""
    report = read_report(folder)
    mapping = None if report is None else report.stages.mapping
    return mapping.models[0].uncertainty if mapping is not None and mapping.models else Uncertainty()
