"""Photographs without their distortion and a PINHOLE model beside them, as COLMAP's undistorter lays them out. One that
shows what is beside and behind the camera becomes the faces of a cube.

A calibration may take the place of the model's cameras; with one, photographs need no model, and get none.

``images/`` holds the photographs under their names, ``masks/NAME.png`` what is to be ignored, and the model is in
``sparse/0``, where the trainers of Gaussian splats and nerfstudio look for it, and in ``sparse`` as well, where COLMAP
itself has it and OpenMVS reads it.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sfmapp
from sfmapp.camera.camera import Camera
from sfmapp.camera_files.writing import write_camera_files
from sfmapp.dense.photographs import Photographs, find_photographs
from sfmapp.dense.undistort import resample
from sfmapp.errors import InputError, NoReconstructionError, UsageError
from sfmapp.events import Events
from sfmapp.formats.atomic import replaced_file, write_bytes
from sfmapp.formats.colmap import MODEL_FILES, read_model
from sfmapp.images.folder import load_images
from sfmapp.images.image_set import ImageRecord
from sfmapp.images.pixels import decode_file, read_file, read_mask_file
from sfmapp.images.rewrite import encode, encode_mask, without_turn
from sfmapp.pipelines.calibrated_model import with_calibration
from sfmapp.pipelines.dense.source import DenseSource, find_source, is_of_model, model_digest
from sfmapp.report.model import CalibratedModelReport, UndistortedCamera, UndistortNumbers, UndistortReport
from sfmapp.reporting import NamedReason
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.undistortion import (
    Layout,
    Undistortion,
    has_distortion,
    plan_undistortion,
    undistort_reconstruction,
    warn_of_sides,
)
from sfmapp.workspace.job import Job
from sfmapp.workspace.keys import input_key, stage_key
from sfmapp.workspace.layout import UNDISTORT
from sfmapp.workspace.manifest import recorded_versions
from sfmapp.workspace.options import Options
from sfmapp.workspace.usage import Stopwatch

STAGE = UNDISTORT
IMAGES, MASKS = "images", "masks"
_NAMES_SHOWN = 3


@dataclass(frozen=True)
class UndistortResult:
    """What was written.

    Attributes:
        output: the folder.
        report: of it.
    """

    output: Path
    report: UndistortReport


@dataclass(kw_only=True)
class _Job(Job):
    """An undistortion under way.

    Attributes:
        photographs: that are there.
        undistortions: of each the pictures that are made of it.
        lost: (name, reason) of photographs that could not be read.
        calibration: what is to be said of a calibration that has replaced the cameras of the model.
    """

    photographs: Photographs = field(init=False)
    undistortions: list[list[Undistortion]] = field(init=False)
    lost: list[tuple[str, str]] = field(default_factory=list)
    calibration: CalibratedModelReport | None = None

    @property
    def names(self) -> list[str]:
        """Of the pictures."""
        pairs = zip(self.photographs.records, self.undistortions, strict=True)
        return [each.name_of(record.name) for record, group in pairs for each in group]

    @property
    def kept(self) -> list[int]:
        """Positions of the photographs that were written."""
        lost = {name for name, _ in self.lost}
        return [i for i, record in enumerate(self.photographs.records) if record.name not in lost]


def undistort(
    source: str | os.PathLike[str],
    output: str | os.PathLike[str],
    options: Options | None = None,
    *,
    images: str | os.PathLike[str] | None = None,
    layout: Layout | None = None,
    events: Events | None = None,
    watch: Stopwatch | None = None,
) -> UndistortResult:
    """Write undistorted photographs of a model, and the model with PINHOLE cameras beside them.

    The same call again resumes one that was cut off.

    Args:
        source: the workspace of a reconstruction, of which the largest model is taken, or of odometry on a folder of
            frames, of which the keyframes are, or the folder of a COLMAP model; with a calibration also photographs
            alone: a folder, a glob or a list.
        output: a new folder, an empty one, or that of an earlier call.
        options: of these, the masks (``images.mask_path``), ``threads``, and ``images.camera``: a calibration that
            takes the place of the cameras of the model, whose poses and points are adjusted to it.
        images: folder of the photographs; None: as noted in the workspace, or where COLMAP has them.
        layout: how the pictures are cut; None: without a blank pixel, and of any size.
        events: progress, warnings and cancellation.
        watch: started when the run began.

    Raises:
        UsageError: an output that holds something else.
        InputError: no model, or none of its photographs.
        NoReconstructionError: the workspace holds no model.
    """
    layout, options = layout or Layout(), options or Options()
    if options.images.camera is not None and not is_of_model(Path(source)):
        return _undistort_alone(source, output, options, layout, images, events, watch)
    where = find_source(source, output, images, options, UNDISTORT)
    _check_target(where)
    model, keypoints = read_model(where.model, events)
    if not len(model.registered_idx):
        raise NoReconstructionError(f"{where.model}: expected images with a pose, found none")
    with _Job.opened(UNDISTORT, where.images, where.output, where.options, events=events, watch=watch) as job:
        _note_source(job, where)
        job.photographs = find_photographs(
            model, where.images, job.options.images,
            is_upright=where.is_upright, with_copies=True, threads=job.threads, events=job.events,
        )  # fmt: skip
        if where.camera is not None:
            model, job.photographs, job.calibration = with_calibration(
                model, job.photographs, str(where.images), where.camera, job.events, threads=job.threads
            )
        made_of = [where.is_upright, model_digest(where.model), job.photographs.missing]
        return _make(job, layout, made_of, MODEL_FILES, lambda: _write_model(job, model, keypoints))


def _undistort_alone(
    source: str | os.PathLike[str], output: str | os.PathLike[str], options: Options, layout: Layout,
    images: str | os.PathLike[str] | None, events: Events | None, watch: Stopwatch | None,
) -> UndistortResult:  # fmt: skip
    """Photographs of a calibrated camera, of which there is no model.

    Raises:
        UsageError: a folder of photographs beside them, or an output that holds something else.
        InputError: there are none, or the camera is not theirs.
    """
    if images is not None:
        raise UsageError(
            f"{source}: expected a model beside the photographs in {images}, found none",
            "leave out --images: SOURCE is the folder of the photographs",
        )
    with _Job.opened(UNDISTORT, source, output, options, events=events, watch=watch) as job:
        found, _ = load_images(source, job.options.images, job.events, threads=job.threads)
        if not found.images:
            raise InputError(f"{source}: expected photographs or a model, found neither")
        job.note_inputs({})
        cameras = tuple(found.cameras[record.camera_idx] for record in found.images)
        job.photographs = Photographs(np.arange(len(cameras)), tuple(found.images), cameras, (), ())
        return _make(job, layout, [], (), lambda: _numbers(job, _write_cameras(job)))


def _make(
    job: _Job, layout: Layout, made_of: Sequence[object], files: Sequence[str], write: Callable[[], UndistortNumbers]
) -> UndistortResult:
    """Write the pictures, and with ``write`` what belongs to them, unless an earlier run has.

    Args:
        made_of: what the result depends on beside photographs, cameras and layout.
        files: of the model, that an earlier run has to have left.
    """
    if layout.front_only:
        warn_of_sides(job.photographs.cameras, STAGE, "leave out --front-only", job.events)
    _plan(job, layout)
    cameras = [(camera.model.name, *camera.params.tolist()) for camera in job.photographs.cameras]
    key = stage_key(
        (__name__,), layout, cameras, [input_key(record) for record in job.photographs.records], list(made_of)
    )
    known = _known_numbers(job, key, files)
    numbers = known
    if numbers is None:
        _begin(job, key)
        _write_photographs(job)
        numbers = write()
        job.workspace.finish(STAGE, job.watch.read(), report=numbers)
        job.workspace.save()
    report = UndistortReport(**numbers, run=job.took(is_up_to_date=known is not None))
    return UndistortResult(job.workspace.folder, report)


def _plan(job: _Job, layout: Layout) -> None:
    """Decide which pictures are made of each photograph.

    Raises:
        InputError: two of them would have the same name.
    """
    job.undistortions = [plan_undistortion(camera, layout) for camera in job.photographs.cameras]
    names = job.names
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{twice}: a photograph and a face of a cube have the same name", "rename one of them")


def _check_target(where: DenseSource) -> None:
    """Neither the model nor the photographs may be what is written."""
    root = where.output.resolve()
    for path, role in ((where.model, "the model"), (where.images, "the folder of the photographs")):
        resolved = path.resolve()
        if resolved == root or resolved.is_relative_to(root):
            raise UsageError(f"{path}: {role} is in {where.output}, where the results go", "choose another folder: -o")


def _note_source(job: _Job, where: DenseSource) -> None:
    job.workspace.note(
        # what the model belongs to, for the commands that take this workspace; and what that was made of
        source=os.path.abspath(where.output / IMAGES),
        photographs=os.path.abspath(where.images),
        model=os.path.abspath(where.model),
        versions={"sfmapp": sfmapp.__version__, **recorded_versions()},
    )


def _target(job: _Job, folder: str, name: str) -> Path:
    """Where a file goes.

    Raises:
        UsageError: a link leads out of the output folder, perhaps to the photographs themselves.
    """
    root = job.workspace.folder
    path = root / folder / name
    if not path.parent.resolve().is_relative_to(root.resolve()):
        raise UsageError(f"{path}: a symbolic link leads out of {root}", "remove it, or choose another folder: -o")
    return path


def _begin(job: _Job, key: str) -> None:
    """Take away what an earlier run with another key has written, and note what this one is going to."""
    workspace = job.workspace
    _target(job, "sparse/0", MODEL_FILES[0])
    if not workspace.has_key(STAGE, key):
        workspace.write_models([])
        for name in set(workspace.manifest.stage(STAGE).names or ()):
            if not PurePosixPath(name).is_absolute() and ".." not in PurePosixPath(name).parts:
                _target(job, IMAGES, name).unlink(missing_ok=True)
                _target(job, MASKS, f"{name}.png").unlink(missing_ok=True)
    workspace.begin(STAGE, key, names=job.names)


def _known_numbers(job: _Job, key: str, files: Sequence[str]) -> UndistortNumbers | None:
    """What an earlier run has written, if all of it is there."""
    folder = job.workspace.folder
    wanted = [folder / IMAGES / name for name in job.names]
    wanted += [folder / "sparse" / "0" / name for name in files]
    if not job.workspace.is_current(STAGE, key) or not all(path.is_file() for path in wanted):
        return None
    return job.workspace.manifest.stage(STAGE).report


def _write_photographs(job: _Job) -> None:
    """Write them all. One that cannot be read is noted in ``job.lost``, and costs the others nothing."""
    records, events = job.photographs.records, job.events
    events.started(STAGE, f"{len(records)} photographs", total=len(records))

    def write(i: int) -> tuple[str, str] | None:
        events.raise_if_cancelled()
        record = records[i]
        targets = {each.name_of(record.name): each for each in job.undistortions[i]}
        missing = {name: each for name, each in targets.items() if not _target(job, IMAGES, name).is_file()}
        reason = None
        try:
            for name, (picture, mask) in zip(missing, _undistorted(record, list(missing.values())), strict=True):
                if mask is not None:  # the picture appears whole, after its mask
                    _write(_target(job, MASKS, f"{name}.png"), encode_mask(mask))
                _write(_target(job, IMAGES, name), picture)
        except InputError as error:
            reason = record.name, str(error)
        events.advanced(STAGE)
        return reason

    pool = ThreadPoolExecutor(job.threads)
    try:
        job.lost += [found for found in pool.map(write, range(len(records))) if found is not None]
    finally:
        pool.shutdown(cancel_futures=True)
    events.finished(STAGE, f"{len(records) - len(job.lost)} photographs written")
    if job.lost:
        listed = "; ".join(reason for _, reason in job.lost[:_NAMES_SHOWN])
        text = f"{len(job.lost)} of {len(records)} photographs cannot be used: {listed}"
        if len(job.lost) == len(records):
            raise InputError(text)
        events.warned(STAGE, text, names=[name for name, _ in job.lost])


def _write(path: Path, data: bytes) -> None:
    write_bytes(path, data)


def _undistorted(record: ImageRecord, pictures: list[Undistortion]) -> Iterator[tuple[bytes, NDArray[np.bool_] | None]]:
    """The files of pictures of a photograph, and (h, w) True where each may be used; None for everywhere.

    Raises:
        InputError: it, or its mask, cannot be read.
    """
    if not pictures:
        return
    data, header = read_file(record)
    mask = read_mask_file(record)
    if pictures[0].is_identity and record.turn == 1:
        kept = without_turn(data, header)
        yield encode(decode_file(record, data, header), header.format) if kept is None else kept, mask
        return
    pixels = decode_file(record, data, header)
    for how in pictures:
        flat, shown = _lay_out(how, pixels)
        usable = shown == 255
        flat[~usable] = 0
        if mask is not None:
            usable &= _lay_out(how, mask.astype(np.uint8) * 255)[0] > 127
        try:
            picture = encode(flat, header.format)
        except InputError as error:
            raise InputError(f"{record.name}: {error}") from error
        yield picture, usable if mask is not None or not usable.all() else None


def _lay_out(how: Undistortion, pixels: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """Pixels of the pinhole, each the mean of those that it covers, and 255 where all of these are shown."""
    import cv2

    cv2.setNumThreads(1)
    size, final = (how.plane.width, how.plane.height), (how.camera.width, how.camera.height)
    if has_distortion(how.source):
        flat, shown = resample(how.source, how.plane.params, size, pixels, how.plane_from_cam)
    else:
        flat, shown = pixels, np.full(size[::-1], 255, np.uint8)
    if final != size:
        flat, shown = (cv2.resize(layer, final, interpolation=cv2.INTER_AREA) for layer in (flat, shown))
    return np.array(flat), shown


def _write_model(job: _Job, model: Reconstruction, keypoints: list[NDArray[np.float64]]) -> UndistortNumbers:
    """Write the model of the photographs that were written, and tell of it."""
    photographs, kept = job.photographs, job.kept
    undistortions = [job.undistortions[i] for i in kept]
    flat, moved = undistort_reconstruction(model, keypoints, photographs.image_idx[kept], undistortions)
    job.workspace.write_models([flat], moved)
    for name in MODEL_FILES:
        _share(job.workspace.model() / name, job.workspace.folder / "sparse" / name)
    return replace(
        _numbers(job, flat.cameras),
        num_points=int(flat.is_triangulated.sum()),
        num_observations=flat.tracks.num_observations,
        num_dropped=int(model.obs_is_inlier.sum()) - flat.tracks.num_observations,
    )


def _write_cameras(job: _Job) -> list[Camera]:
    """Write the pinhole of pictures without a model for other programs, where they share one; all of them."""
    every = [each.camera for i in job.kept for each in job.undistortions[i]]
    keys = [(camera.width, camera.height, *camera.params.tolist()) for camera in every]
    cameras = [*dict(zip(keys, every, strict=True)).values()]
    if len(cameras) == 1:
        write_camera_files(job.workspace.folder, cameras[0], "camera")
    else:
        sizes = ", ".join(f"{camera.width}x{camera.height}" for camera in cameras[:_NAMES_SHOWN])
        job.events.warned(STAGE, f"no cameras.txt: the pictures are of {len(cameras)} cameras ({sizes})")
    return cameras


def _numbers(job: _Job, cameras: Sequence[Camera]) -> UndistortNumbers:
    """What was written of pictures."""
    pictures = [
        (each.name_of(job.photographs.records[i].name), each) for i in job.kept for each in job.undistortions[i]
    ]
    masks = [job.workspace.folder / MASKS / f"{name}.png" for name, _ in pictures]
    return UndistortNumbers(
        num_images=len(pictures),
        num_faces=sum(each.face is not None for _, each in pictures),
        num_copied=sum(each.is_identity for _, each in pictures),
        num_masks=sum(path.is_file() for path in masks),
        cameras=[UndistortedCamera(width=c.width, height=c.height, params=c.params.tolist()) for c in cameras],
        num_points=0,
        num_observations=0,
        num_dropped=0,
        missing=[NamedReason(name=name, reason=reason) for name, reason in (*job.photographs.missing, *job.lost)],
        calibration=job.calibration,
    )


def _share(path: Path, other: Path) -> None:
    """Have a file in another place as well, without a second copy of its bytes where the file system can."""
    with replaced_file(other) as beside:
        beside.unlink(missing_ok=True)
        with suppress(OSError):
            os.link(path, beside)
            return
        shutil.copyfile(path, beside)
