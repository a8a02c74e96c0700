"""A model in another program's format, read back and compared before anybody relies on it."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError, NoReconstructionError, UsageError
from sfmapp.events import Events
from sfmapp.formats.colmap import has_model, read_model, write_model, write_model_text
from sfmapp.formats.colmap_model import model_from_reconstruction, reconstruction_from_model
from sfmapp.pipelines.export_world import (
    NO_WORLD,
    Cloud,
    CloudCopy,
    World,
    copy_georeference,
    dense_cloud,
    export_cloud_las,
    export_cloud_ply,
    export_map,
    world_of,
)
from sfmapp.pipelines.stored_pixels import check_pixels
from sfmapp.report.model import ExportReport
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.workspace.layout import USUAL_FOLDERS
from sfmapp.workspace.manifest import image_root, read_manifest

_NOTICEABLE_PX = 0.1  # below the noise of a keypoint


@dataclass(frozen=True)
class _Source:
    """The model to export: where it and its images lie, if they do, and what world it is in."""

    folder: Path | None
    model: Reconstruction
    keypoints: list[NDArray[np.float64]]
    image_folder: Path | None
    notes: tuple[str, ...] = ()
    run: Path | None = None
    world: World = NO_WORLD
    cloud: Cloud | None = None


@dataclass(frozen=True)
class _Copy:
    """What was read back: the model with our images and points in our order, and the files it came from.

    Attributes:
        max_coordinate: worst difference of what was written and is no point of the model, in its frame.
    """

    model: Reconstruction
    files: list[Path]
    reader: str
    notes: tuple[str, ...] = ()
    max_coordinate: float = 0.0


def export_model(
    output: str | os.PathLike[str] | Reconstruction,
    target: str,
    path: str | os.PathLike[str],
    *,
    images: str | os.PathLike[str] | None = None,
    keypoints: list[NDArray[np.float64]] | None = None,
    crs: str | None = None,
    is_dense: bool = False,
) -> ExportReport:
    """Write a model in another format, read it back and re-project every inlier with what was read.

    A model that lies in a frame of the world is written in that frame, metres about its origin, with
    ``georeference.json`` beside it; LAS and LAZ, and PLY if asked to, in a coordinate system; maps in degrees.

    Args:
        output: the workspace of a run, of which the largest model is taken, the folder of a COLMAP model, or a
            reconstruction in memory.
        target: one of ``EXPORTS``.
        path: where to write: a folder for COLMAP's formats, a file or folder for the others.
        images: folder of the photographs; None: as noted in the workspace, or where COLMAP has them.
        keypoints: of a reconstruction in memory, (N, 2) pixels for each image; None: the tracked ones.
        crs: coordinate system of the points of PLY, LAS and LAZ, such as ``EPSG:25833``, in metres; None: of PLY the
            frame of the model, of LAS and LAZ the UTM zone.
        is_dense: of PLY, LAS and LAZ: the dense points of the run.

    Returns:
        What was written, and how well it was read back.

    Raises:
        UsageError: an unknown format, a camera or name that it cannot hold, the model's own folder as the target, or a
            coordinate system or dense points that the format or the model has no place for.
        NoReconstructionError: the workspace holds no model.
        InputError: there is no model, nothing can be written, or what was read back is not what was written.
        MissingPackageError: the format, or the coordinate system, needs a package that is not installed.
    """
    if target not in EXPORTS:
        raise UsageError(f"unknown export format {target!r}, expected one of {', '.join(EXPORTS)}")
    if (crs is not None or is_dense) and target not in CLOUDS:
        what = f"--crs {crs}" if crs is not None else "--dense"
        raise UsageError(f"{what} does not go with {target}", f"it is for {', '.join(CLOUDS)}")
    if isinstance(output, Reconstruction):
        source = _in_memory(output, keypoints)
    else:
        source = _source(Path(output))
    source = replace(source, world=world_of(source.run, crs))
    if is_dense:
        if source.run is None:
            raise UsageError("--dense: there is no run that could have dense points", "give the folder of a run")
        source = replace(source, cloud=dense_cloud(source.run))
    if images is not None:
        source = replace(source, image_folder=Path(images))
    copy = EXPORTS[target](source, Path(path))
    if source.run is not None and source.world.georeference is not None and target in WITH_FRAME:
        copy = replace(copy, files=[*copy.files, copy_georeference(source.run, copy.files[0].parent)])
    ours, theirs = source.model, copy.model
    same_names = len(theirs.image_names) == len(ours.image_names) and all(
        theirs_name.endswith(name) for theirs_name, name in zip(theirs.image_names, ours.image_names, strict=True)
    )
    if not same_names or theirs.point_xyz.shape != ours.point_xyz.shape:
        raise InputError(
            f"{path}: expected to read back {len(ours.image_names)} images and {len(ours.point_xyz)} points, found "
            f"{len(theirs.image_names)} and {len(theirs.point_xyz)}"
        )
    return ExportReport(
        format=target,
        files=[os.fspath(file) for file in copy.files],
        reader=copy.reader,
        num_images=len(ours.image_names),
        num_points=int(ours.is_triangulated.sum()) if source.cloud is None else len(source.cloud.xyz),
        num_observations=int(ours.obs_is_inlier.sum()),
        max_px=_worst_px(ours, theirs),
        max_coordinate=max(float(np.abs(theirs.point_xyz - ours.point_xyz).max(initial=0.0)), copy.max_coordinate),
        notes=[*source.notes, *copy.notes],
    )


def _in_memory(model: Reconstruction, keypoints: list[NDArray[np.float64]] | None) -> _Source:
    """What a file would hold of a reconstruction: the registered images, the triangulated points, the inliers."""
    written = model_from_reconstruction(model, keypoints)
    held, held_keypoints, _ = reconstruction_from_model(Path("reconstruction"), written)
    return _Source(None, held, held_keypoints, None)


def _source(output: Path) -> _Source:
    folder, image_folder, run = output, None, None
    if (output / "run.json").is_file():
        run = output
        manifest = read_manifest(output)
        check_pixels(output, manifest)
        image_folder = image_root(manifest)
        folder = output / "sparse" / "0"
        if not has_model(folder):
            raise NoReconstructionError(f"{output} holds no model to export", "run sfmapp reconstruct first")
    else:
        if not has_model(output) and has_model(output / "sparse" / "0"):
            folder = output / "sparse" / "0"
        image_folder = next((folder / name for name in USUAL_FOLDERS if (folder / name).is_dir()), None)
    events, notes = Events(), list[str]()
    events.subscribe(lambda event: notes.append(event.message))
    model, keypoints = read_model(folder, events)
    return _Source(folder, model, keypoints, image_folder, tuple(notes), run)


def _worst_px(ours: Reconstruction, theirs: Reconstruction) -> float:
    """Worst difference over all inliers: of the pixel where their cameras see their points, and of the residual."""
    with_theirs = ours.copy()
    with_theirs.cameras, with_theirs.image_camera_idx = theirs.cameras, theirs.image_camera_idx
    with_theirs.cam_from_world, with_theirs.point_xyz = theirs.cam_from_world, theirs.point_xyz
    residuals = ours.residuals_px()
    worst = _largest_difference(with_theirs.residuals_px(), residuals)
    if theirs.tracks.num_observations:  # the format holds pixels as well
        found = theirs.residuals_px()
        if len(found) != len(residuals):
            raise InputError(f"expected to read back {len(residuals)} observations, found {len(found)}")
        worst = max(worst, _largest_difference(found, residuals))
    return worst


def _largest_difference(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Of vectors (O, 2); behind a camera (NaN) in both is no difference, in one of them an infinite one."""
    missing = np.isnan(a).any(1), np.isnan(b).any(1)
    lengths = np.linalg.norm(a - b, axis=1)
    lengths[missing[0] & missing[1]] = 0.0
    lengths[missing[0] != missing[1]] = np.inf
    return float(lengths.max(initial=0.0))


def _export_colmap(
    write: Callable[[Path, Reconstruction, list[NDArray[np.float64]]], None], ending: str
) -> Callable[[_Source, Path], _Copy]:
    def export(source: _Source, path: Path) -> _Copy:
        from sfmapp.formats.pycolmap_reader import read_with_pycolmap

        if source.folder is not None and path.exists() and path.resolve() == source.folder.resolve():
            raise UsageError(f"{path} is the model itself", "choose another folder to export to")
        for camera in source.model.cameras:
            if not camera.model.is_colmaps:
                raise UsageError(
                    f"COLMAP has no {camera.model.name} cameras",
                    "write undistorted photographs with a PINHOLE model beside them: sfmapp undistort",
                )
        write(path, source.model, source.keypoints)
        ours = read_model(path)[0]
        copy = read_with_pycolmap(path)
        # pycolmap vouches for cameras, poses and points, our reader adds the observations
        copy.tracks, copy.obs_is_inlier = ours.tracks, ours.obs_is_inlier
        stems = ("cameras", "frames", "images", "points3D", "rigs")
        return _Copy(copy, [path / f"{stem}.{ending}" for stem in stems], "pycolmap")

    return export


def _export_points(
    write: Callable[[Cloud, Path, World], CloudCopy], ending: str, name: str
) -> Callable[[_Source, Path], _Copy]:
    def export(source: _Source, path: Path) -> _Copy:
        points = np.flatnonzero(source.model.is_triangulated)
        copy = source.model.copy()
        sparse = Cloud(source.model.point_xyz[points], source.model.point_rgb[points])
        cloud = sparse if source.cloud is None else source.cloud
        back = write(cloud, _file_in(path, ending, name), source.world)
        if not np.array_equal(back.rgb, cloud.rgb):
            raise InputError(f"{back.file}: expected to read back the colours that were written, found others")
        if source.cloud is None:
            copy.point_xyz[points] = back.xyz
        worst = float(np.abs(back.xyz - cloud.xyz).max(initial=0.0))
        return _Copy(copy, [back.file], back.reader, back.notes, worst)

    return export


def _export_places(ending: str, name: str) -> Callable[[_Source, Path], _Copy]:
    def export(source: _Source, path: Path) -> _Copy:
        back = export_map(source.model, _file_in(path, ending, name), source.world)
        centers = source.model.centers[source.model.is_registered]
        worst = float(np.abs(back.xyz - centers).max(initial=0.0))
        return _Copy(source.model.copy(), [back.file], back.reader, back.notes, worst)

    return export


def _export_bundler(source: _Source, path: Path) -> _Copy:
    from sfmapp.formats.bundler import list_path, read_bundler, write_bundler

    file = _file_in(path, ".out", "bundle.out")
    write_bundler(file, source.model)
    cameras = [source.model.cameras[i] for i in source.model.image_camera_idx]
    sizes = np.array([(camera.width, camera.height) for camera in cameras]).reshape(-1, 2)
    principal_points = np.array([camera.canonical[2:4] for camera in cameras]).reshape(-1, 2)
    off_center = np.linalg.norm(principal_points - sizes / 2, axis=1).max(initial=0.0)
    notes: tuple[str, ...] = ()
    if off_center > _NOTICEABLE_PX:
        notes = (
            f"pixels are counted from the principal point, up to {off_center:.2f} px off the centre of the image: the "
            "geometry is exact, but a program that takes the centre for it sees the photographs shifted by as much",
        )
    copy = read_bundler(file, sizes, principal_points)
    return _Copy(copy, [file, list_path(file)], "sfmapp", notes)


def _export_nerfstudio(source: _Source, path: Path) -> _Copy:
    from sfmapp.formats.nerfstudio import POINTS_NAME, read_nerfstudio, write_nerfstudio

    file = _file_in(path, ".json", "transforms.json")
    folder = file.resolve().parent / "images" if source.image_folder is None else source.image_folder.resolve()
    write_nerfstudio(file, source.model, Path(os.path.relpath(folder, file.resolve().parent)).as_posix())
    missing = [name for name in source.model.image_names if not (folder / name).exists()]
    notes: tuple[str, ...] = ()
    if missing:
        notes = (
            f"{len(missing)} of {len(source.model.image_names)} photographs are not in {folder}, where the file says "
            f"they are, {missing[0]} for one: put them there",
        )
    return _Copy(read_nerfstudio(file), [file, file.with_name(POINTS_NAME)], "sfmapp", notes)


def _file_in(path: Path, ending: str, name: str) -> Path:
    """The path itself if it has the format's ending, else a file of the usual name in the folder that it names."""
    return path if path.suffix.lower() == ending and not path.is_dir() else path / name


EXPORTS: dict[str, Callable[[_Source, Path], _Copy]] = {
    "colmap-bin": _export_colmap(write_model, "bin"),
    "colmap-text": _export_colmap(write_model_text, "txt"),
    "ply": _export_points(export_cloud_ply, ".ply", "points.ply"),
    "las": _export_points(export_cloud_las, ".las", "points.las"),
    "laz": _export_points(export_cloud_las, ".laz", "points.laz"),
    "bundler": _export_bundler,
    "nerfstudio": _export_nerfstudio,
    "geojson": _export_places(".geojson", "cameras.geojson"),
    "kml": _export_places(".kml", "cameras.kml"),
}
# of points alone, sparse or dense; and those in the frame of the model, which is written beside them
CLOUDS, WITH_FRAME = ("ply", "las", "laz"), ("colmap-bin", "colmap-text", "ply", "bundler", "nerfstudio")
