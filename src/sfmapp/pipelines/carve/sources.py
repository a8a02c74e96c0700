"""Where photographs with cameras come from that see an object from all sides."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.carve.views import View, view_of_camera, views_of_matrices
from sfmapp.dense.photographs import find_photographs
from sfmapp.errors import InputError, UsageError
from sfmapp.evaluation.poses import match_names
from sfmapp.events import Events
from sfmapp.formats.colmap import has_model, read_model
from sfmapp.formats.ground_truth import GroundTruth, read_ground_truth
from sfmapp.formats.middlebury_multiview import find_middlebury
from sfmapp.formats.projection_matrices import SUFFIXES, read_projection_matrices
from sfmapp.images.arrays import check_size
from sfmapp.images.folder import load_images
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.pipelines.dense.source import find_source, is_of_model
from sfmapp.workspace.layout import CARVE
from sfmapp.workspace.options import Options

Array = NDArray[np.float64]

STAGE = "views"
_LISTS = ("cameras.json", "transforms.json")
_FEWEST = 2
# entries of R R^T - I below which the left part of a matrix is a rotation written with a few digits
_ROTATION_TOLERANCE = 5e-3
_NAMES_SHOWN = 6


@dataclass(frozen=True)
class CarveSource:
    """Photographs (V) whose cameras are known.

    Attributes:
        records: V of them, in natural order. views: V, in pixels of the photographs as they are stored.
        cameras: what the cameras are, in words.
        points: (N, 3) points of a reconstruction, world; empty where there is none.
        left_out: (name, reason) of photographs without a camera, and of cameras without a photograph.
    """

    records: tuple[ImageRecord, ...]
    views: tuple[View, ...]
    cameras: str
    points: Array
    left_out: tuple[tuple[str, str], ...] = ()


def find_views(
    source: str | os.PathLike[str],
    images: str | os.PathLike[str] | None,
    poses: str | os.PathLike[str] | None,
    options: Options,
    events: Events | None = None,
) -> CarveSource:
    """Photographs of a source with their cameras.

    Args:
        source: a workspace, a COLMAP model, or a folder of photographs that holds their cameras.
        images: folder of the photographs; None: as noted in the workspace, where COLMAP has them, or the folder
            ``images`` of the source, or the source itself.
        poses: file of the cameras where the source does not hold them: whatever
            :func:`sfmapp.formats.ground_truth.read_ground_truth` or
            :func:`sfmapp.formats.projection_matrices.read_projection_matrices` reads.
        options: of these, ``images``; its camera, where the poses come without.
        events: told of photographs that are left out.

    Raises:
        UsageError: photographs without cameras.
        InputError: nothing there, fewer than two photographs with a camera, or sizes that differ.
    """
    events = events or Events()
    folder = Path(source)
    if not folder.exists():
        raise InputError(f"{folder}: expected a workspace, a COLMAP model or a folder of photographs, found nothing")
    if poses is None and is_of_model(folder):
        found = _of_model(folder, images, options, events)
    else:
        if not folder.is_dir():
            raise InputError(f"{folder}: expected a folder of photographs with their cameras, found a file")
        file = Path(poses) if poses is not None else _find_cameras(folder)
        found = _of_folder(folder, images, file, options, events)
    if found.left_out:
        events.warned(STAGE, f"{len(found.left_out)} left out: {_listed(found.left_out)}")
    if len(found.views) < _FEWEST:
        raise InputError(
            f"{folder}: expected two photographs with cameras or more, found {len(found.views)}",
            "one silhouette bounds nothing along its rays: photograph the object from all sides",
        )
    return found


def _listed(left_out: Sequence[tuple[str, str]]) -> str:
    shown = "; ".join(f"{name}: {reason}" for name, reason in left_out[:_NAMES_SHOWN])
    return shown + ("; ..." if len(left_out) > _NAMES_SHOWN else "")


def _of_model(
    folder: Path, images: str | os.PathLike[str] | None, options: Options, events: Events
) -> CarveSource:  # fmt: skip
    where = find_source(folder, None, images, options, CARVE)
    model, _ = read_model(where.model, events)
    found = find_photographs(
        model, where.images, where.options.images, is_upright=where.is_upright, threads=options.num_workers,
        events=events,
    )  # fmt: skip
    views = [
        view_of_camera(record.name, camera, model.cam_from_world[image])
        for record, camera, image in zip(found.records, found.cameras, found.image_idx, strict=True)
    ]
    return CarveSource(
        found.records, tuple(views), f"{len(views)} cameras of {where.model}", model.point_xyz[model.is_triangulated],
        tuple(found.missing),
    )  # fmt: skip


def _find_cameras(folder: Path) -> Path:
    """The file in a folder that says what its cameras are. Raises UsageError if there is none, or several."""
    listed = [folder / name for name in _LISTS if (folder / name).is_file()]
    middlebury = find_middlebury(folder)
    if listed or middlebury is not None:
        return listed[0] if listed or middlebury is None else middlebury
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES - {".txt"})
    found += [path for path in (folder / "txt", folder / "calib") if path.is_dir()]
    if len(found) != 1:
        named = ", ".join(path.name for path in found) or "none of them"
        raise UsageError(
            f"{folder}: expected cameras of the photographs in it (cameras.json, transforms.json, NAME_par.txt, a file "
            f".mat, .npz or .npy of projection matrices, a workspace or a COLMAP model), found {named}",
            "name them with --poses FILE, or run sfmapp reconstruct first",
        )
    return found[0]


def _of_folder(
    folder: Path, images: str | os.PathLike[str] | None, file: Path, options: Options, events: Events
) -> CarveSource:
    inside = folder / "images"
    root = Path(images) if images is not None else inside if inside.is_dir() else folder
    image_set, _ = load_images(root, options.images, events, threads=options.num_workers)
    if not image_set.images:
        raise InputError(f"{root}: expected photographs, found none", "name their folder with --images DIR")
    if _holds_matrices(file):
        return _of_matrices(image_set, file)
    return _of_cameras(image_set, read_ground_truth(file), options)


def _holds_matrices(file: Path) -> bool:
    """Whether a file holds projection matrices, and not cameras with poses."""
    if file.is_dir():
        return not has_model(file) and not any((file / name).is_file() for name in _LISTS) and any(file.glob("*.txt"))
    suffix = file.suffix.lower()
    if suffix != ".txt" or file.name.endswith("_par.txt"):
        return suffix in SUFFIXES - {".txt"}
    with file.open(encoding="utf-8", errors="replace") as lines:
        first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    return len(first.replace(",", " ").split()) in (12, 13)


def _of_matrices(image_set: ImageSet, file: Path) -> CarveSource:
    names, matrices = read_projection_matrices(file)
    _refuse_poses(file, matrices)
    if names is None:
        if len(matrices) != len(image_set.images):
            raise InputError(
                f"{file}: expected a matrix for each of {len(image_set.images)} photographs, found {len(matrices)}",
                "matrices without names belong to the photographs in natural order: take the others out of the folder",
            )
        index = np.arange(len(matrices))
    else:
        index = _index(image_set, names, file)
    of_image = {int(i): k for k, i in enumerate(index) if i >= 0}
    records = [image_set.images[i] for i in sorted(of_image)]
    views = views_of_matrices(
        [record.name for record in records], matrices[[of_image[i] for i in sorted(of_image)]],
        [(record.width, record.height) for record in records],
    )  # fmt: skip
    return CarveSource(
        tuple(records), tuple(views), f"{len(views)} projection matrices of {file}, used as they are", np.zeros((0, 3)),
        _left_out(image_set, of_image, names or (), index),
    )  # fmt: skip


def _refuse_poses(file: Path, matrices: Array) -> None:
    left = matrices[:, :, :3].copy()
    left[:, :2] -= 0.5 * left[:, 2:]  # the half pixel that reading has added
    if np.abs(left @ left.swapaxes(1, 2) - np.eye(3)).max() < _ROTATION_TOLERANCE:
        raise InputError(
            f"{file}: expected projection matrices into pixels, found rotations and translations",
            "give poses as a TUM trajectory or cameras.json, and what the lens is with --camera",
        )


def _of_cameras(image_set: ImageSet, known: GroundTruth, options: Options) -> CarveSource:
    known_names = [image.name for image in image_set.images]
    fitted = known.for_images(known_names)
    index = match_names(known_names, fitted.names)
    of_image = {int(i): k for k, i in enumerate(index) if i >= 0}
    given = options.images.camera is not None or options.images.camera_params is not None
    if known.cameras is None and not given and options.images.focal_px is None:
        raise UsageError(
            f"{known.path}: its poses come without cameras", "say what the lens is: --camera MODEL,... or FILE"
        )
    records, views = [], []
    for i, k in sorted(of_image.items()):
        record = image_set.images[i]
        camera = image_set.camera_of(i) if given or known.cameras is None else _sized(known.cameras[k], record)
        check_size(record, camera)
        records.append(record)
        views.append(view_of_camera(record.name, camera, fitted.cam_from_world[k]))
    return CarveSource(
        tuple(records), tuple(views), f"{len(views)} cameras of {known.path}", np.zeros((0, 3)),
        _left_out(image_set, of_image, fitted.names, index),
    )  # fmt: skip


def _sized(camera: Camera, record: ImageRecord) -> Camera:
    """A camera of the size of its photograph, where its file says nothing of it and twice the principal point was taken
    for it."""
    cx, cy = camera.canonical[2:4]
    if (camera.width, camera.height) == (round(2.0 * cx - 1.0), round(2.0 * cy - 1.0)):
        return replace(camera, width=record.width, height=record.height)
    return camera


def _index(image_set: ImageSet, names: Sequence[str], file: Path) -> NDArray[np.int64]:
    known = GroundTruth(file, tuple(names), np.zeros((len(names), 7)), None)
    ours = [image.name for image in image_set.images]
    return match_names(ours, known.for_images(ours).names)


def _left_out(
    image_set: ImageSet, of_image: dict[int, int], names: Sequence[str], index: NDArray[np.int64]
) -> tuple[tuple[str, str], ...]:
    without = [(image.name, "has no camera") for i, image in enumerate(image_set.images) if i not in of_image]
    absent = [(name, "has no photograph") for name, i in zip(names, index, strict=True) if i < 0] if len(names) else []
    return (*without, *absent)
