"""What a dense run works on: a model, its photographs, and the workspace that the results go to."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from sfmapp.dense.photographs import find_photographs
from sfmapp.dense.prepare import DensePlan, plan_views
from sfmapp.dense.report import ViewsReport
from sfmapp.errors import InputError, NoReconstructionError, UsageError
from sfmapp.events import Events
from sfmapp.formats.colmap import has_model, is_model_file, read_model
from sfmapp.pipelines.calibrated_model import with_calibration
from sfmapp.pipelines.stored_pixels import has_stored_pixels
from sfmapp.report.model import CalibratedModelReport
from sfmapp.workspace.job import Job
from sfmapp.workspace.layout import DENSE, MANIFEST, ODOMETRY, RECONSTRUCT, STEREO, UNDISTORT, USUAL_FOLDERS
from sfmapp.workspace.manifest import Manifest, image_root, missing_photographs, read_manifest
from sfmapp.workspace.options import Options, options_from_dict, options_to_dict
from sfmapp.workspace.usage import Stopwatch

# the workspace in the folder of a COLMAP model, if no other place is named
INSIDE = "sfmapp"


@dataclass(frozen=True)
class DenseSource:
    """Where everything is.

    Attributes:
        model: folder of the COLMAP model.
        images: folder of the photographs.
        output: the workspace.
        command: that wrote it or is to make it.
        is_upright: the model counts pixels in photographs turned as EXIF says.
        options: those given, with the masks of the run that made the model unless others are named.
        camera: calibration whose cameras are to replace those of the model; None: they stay.
    """

    model: Path
    images: Path
    output: Path
    command: str
    is_upright: bool
    options: Options
    camera: str | None = None


@dataclass
class DenseJob(Job):
    """A dense run, or the making of its mesh, under way.

    Attributes:
        where: model, photographs and workspace.
    """

    where: DenseSource | None = None

    @property
    def known(self) -> DenseSource:
        """``where``, which every such job has."""
        assert self.where is not None
        return self.where

    def note_source(self) -> None:
        """Write down what this run works on and how; a reconstruction has noted its own photographs."""
        if self.known.command == DENSE:
            self.note_inputs({})
            self.workspace.note(model=os.path.abspath(self.known.model), is_upright=self.known.is_upright)
        else:
            plain = options_to_dict(self.options)
            own = {name: plain[name] for name in ("dense", "surface")}
            self.workspace.note(options={**self.workspace.manifest.options, **own})
        self.workspace.save()


def dense_job(
    where: DenseSource, events: Events | None, watch: Stopwatch | None = None
) -> AbstractContextManager[DenseJob]:
    """Open the workspace of a dense run or of its mesh."""
    return DenseJob.opened(
        where.command, where.images, where.output, where.options, events=events, watch=watch, where=where
    )


def calibrate_source(job: DenseJob) -> CalibratedModelReport | None:
    """Put the model with the cameras of a calibration into the workspace, where everything else takes it from; None
    where no calibration was given.

    Raises:
        InputError: the calibration or the model cannot be read, or do not belong together.
    """
    where = job.known
    if where.camera is None:
        return None
    model, keypoints = read_model(where.model, job.events)
    photographs = find_photographs(
        model, where.images, job.options.images,
        is_upright=where.is_upright, with_copies=True, threads=job.threads, events=job.events,
    )  # fmt: skip
    found, _, report = with_calibration(
        model, photographs, str(where.images), where.camera, job.events, threads=job.threads
    )  # fmt: skip
    job.workspace.write_models([found], keypoints, job.events)
    job.where = dataclasses.replace(where, model=job.workspace.model(), camera=None)
    return report


def plan_source(job: DenseJob) -> tuple[DensePlan, ViewsReport]:
    """What is planned with the views of the model, and the report of it.

    Raises:
        InputError: the model or too many of its photographs are gone.
        NoReconstructionError: no baseline between the views.
    """
    where = job.known
    if not has_model(where.model):
        raise InputError(f"{where.model}: the model that this workspace was made from is gone", "restore it")
    model, _ = read_model(where.model, job.events)
    photographs = find_photographs(
        model, where.images, job.options.images,
        is_upright=where.is_upright, threads=job.threads, events=job.events,
    )  # fmt: skip
    return plan_views(model, photographs, job.options.dense, job.events)


def is_of_model(source: Path) -> bool:
    """Whether it is a workspace or the folder of a COLMAP model, and not one of photographs."""
    return (source / MANIFEST).is_file() or has_model(source) or has_model(source / "sparse" / "0")


def find_source(
    source: str | os.PathLike[str],
    output: str | os.PathLike[str] | None,
    images: str | os.PathLike[str] | None,
    options: Options,
    asked_for: str = DENSE,
) -> DenseSource:
    """Find model, photographs and workspace.

    Args:
        source: a workspace, or the folder of a COLMAP model.
        output: where the results go; None: into the workspace itself, or the folder ``sfmapp`` of the model.
        images: folder of the photographs; None: as noted in the workspace, or where COLMAP has them.
        options: of the run.
        asked_for: the command, for what is said.

    Raises:
        UsageError: a workspace of another command.
        InputError: no model, no photographs.
        NoReconstructionError: the workspace holds no model.
    """
    folder = Path(source)
    # what undistort has written is a COLMAP model with its photographs where COLMAP has them
    if (folder / MANIFEST).is_file() and read_manifest(folder).command != UNDISTORT:
        return _in_workspace(folder, output, images, options, asked_for)
    if not has_model(folder):
        if not has_model(folder / "sparse" / "0"):
            what = "no such folder" if not folder.is_dir() else "neither of them"
            advice = "photographs alone are straightened with --camera FILE" if asked_for == UNDISTORT else ""
            raise InputError(f"{folder}: expected a workspace of sfmapp or a COLMAP model, found {what}", advice)
        folder = folder / "sparse" / "0"
    target = folder / INSIDE if output is None else Path(output)
    return DenseSource(
        folder, _image_folder(folder, images), target, DENSE, False, options, options.images.camera
    )  # fmt: skip


def _in_workspace(
    folder: Path,
    output: str | os.PathLike[str] | None,
    images: str | os.PathLike[str] | None,
    options: Options,
    asked_for: str,
) -> DenseSource:
    manifest = read_manifest(folder)
    command = manifest.command
    if command == ODOMETRY and (asked_for == STEREO or (asked_for == UNDISTORT and output is not None)):
        model = folder / "sparse" / "0"
        if not has_model(model):
            raise NoReconstructionError(f"{folder} holds no model", "run sfmapp odometry again")
        target = folder if output is None else Path(output)
        frames = _frame_folder(manifest.source, images, asked_for)
        return DenseSource(model, frames, target, DENSE, False, options, options.images.camera)
    if command not in (RECONSTRUCT, DENSE):
        raise UsageError(
            f"{folder} holds the results of sfmapp {command}, not of sfmapp {RECONSTRUCT}",
            f"its model can be used all the same: sfmapp {asked_for} {folder}/sparse/0 --images DIR -o OUT",
        )
    is_own = output is None or Path(output).resolve() == folder.resolve()
    target = folder if output is None else Path(output)
    if command == DENSE:
        model = Path(manifest.model or "")
        found = Path(images) if images is not None else Path(manifest.source)
        is_upright = bool(manifest.is_upright)
    else:
        model = folder / "sparse" / "0"
        found = Path(images) if images is not None else _photograph_folder(folder, manifest)
        is_upright = not has_stored_pixels(manifest)
        if not has_model(model):
            raise NoReconstructionError(f"{folder} holds no model", "run sfmapp reconstruct first")
    earlier = options_from_dict({"images": manifest.options.get("images", {})}).images
    camera = options.images.camera
    if is_own and camera not in (None, earlier.camera):
        raise UsageError(
            f"{folder} holds a model that was made without {camera}, which stays as it is",
            f"have the results elsewhere: sfmapp {asked_for} {folder} --camera {camera} -o OUT",
        )
    if options.images.mask_path is None and earlier.mask_path is not None:
        images_options = dataclasses.replace(options.images, mask_path=earlier.mask_path)
        options = dataclasses.replace(options, images=images_options)
    return DenseSource(
        model, found, target, command if is_own else DENSE, is_upright, options, None if is_own else camera
    )  # fmt: skip


def _photograph_folder(folder: Path, manifest: Manifest) -> Path:
    """The folder of a reconstruction's photographs. Raises InputError if they are gone."""
    found = image_root(manifest)
    if found is None:
        raise missing_photographs(folder, manifest)
    return found


def _frame_folder(source: str, images: str | os.PathLike[str] | None, asked_for: str) -> Path:
    """The folder that the names of an odometry run's keyframes are relative to."""
    folder = Path(source) if images is None else Path(images)
    if not folder.is_dir():
        raise InputError(
            f"{folder}: expected the folder of the frames, found {'a file' if folder.is_file() else 'no folder'}",
            "run sfmapp odometry on a folder of its frames"
            if asked_for == STEREO
            else "name the folder that holds the keyframes as files: --images DIR",
        )
    return folder


def _image_folder(model: Path, images: str | os.PathLike[str] | None) -> Path:
    if images is not None:
        if not Path(images).is_dir():
            raise InputError(f"{images}: expected the folder of the photographs, found no folder")
        return Path(images)
    for name in USUAL_FOLDERS:
        if (model / name).is_dir():
            return model / name
    looked = ", ".join(os.path.normpath(model / name) for name in USUAL_FOLDERS)
    raise UsageError(f"{model}: expected its photographs in {looked}, found no such folder", "give --images DIR")


def model_digest(model: Path) -> str:
    """Hash of the files of a model."""
    digest = hashlib.blake2b(digest_size=16)
    for path in sorted(model.iterdir()):
        if is_model_file(path):
            digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()
