"""Score the dense cloud and the mesh of a result against a true cloud or mesh."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError, UsageError
from sfmapp.evaluation.clouds import DISTANCE_FACTORS, CloudScore, sample_triangles, score_cloud, triangle_areas
from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.events import Events
from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.colmap import has_model, read_model
from sfmapp.formats.ground_truth import read_ground_truth
from sfmapp.formats.ply_reader import PlyGeometry, read_ply_geometry
from sfmapp.geometry import similarity
from sfmapp.pipelines.stored_pixels import ground_truth_in_stored_pixels, orientations_of
from sfmapp.report.validation import CloudValidation
from sfmapp.reporting import to_json

FOLDER = "validation"
CLOUD, MESH, PATCHES = Path("dense") / "fused.ply", Path("mesh") / "mesh.ply", Path("dense") / "patches.npz"

# Surfaces become points so many to the square of the distance: none is missed for want of a sample (exp(-4 pi) = 3e-6).
_SAMPLES_PER_SQUARE = 4
_SAMPLES = (10_000, 5_000_000)


def validate_cloud(
    output: str | os.PathLike[str],
    ground_truth_cloud: str | os.PathLike[str],
    *,
    ground_truth_poses: str | os.PathLike[str] | None = None,
    distance: float | None = None,
    threads: int | None = None,
    events: Events | None = None,
) -> CloudValidation:
    """Accuracy, completeness and F-score of the dense cloud, and of the mesh if there is one.

    Writes ``validation/cloud.json`` and ``validation/cloud_error.rrd`` into the workspace, or beside the cloud.

    Args:
        output: a workspace with ``dense/fused.ply`` or ``mesh/mesh.ply``, or a PLY file.
        ground_truth_cloud: a PLY: cloud or mesh. A mesh becomes points, spread evenly.
        ground_truth_poses: true cameras, as :func:`validate` takes them. The similarity that carries the cameras of the
            workspace into them carries its cloud too; None: both clouds are in one frame.
        distance: the distance D in units of the ground truth; None: the median size of a pixel at the patches.
        threads: of the search; None: as many as there are processors.
        events: progress and cancellation.

    Raises:
        InputError: a file is missing or not what it should be, or the ground truth holds no points.
        UsageError: the distance is not given and not known, or not above 0.
    """
    events, folder = events or Events(), Path(output)
    files = _files(folder)
    events.started("validate", f"reading {ground_truth_cloud}", total=1 + len(files))
    threads = threads or os.cpu_count() or 1
    notes: list[str] = []
    sim = similarity.IDENTITY if ground_truth_poses is None else _alignment(folder, Path(ground_truth_poses), notes)
    limit = _distance(folder, distance, float(sim[7]))
    ground_truth = _points(read_ply_geometry(Path(ground_truth_cloud)), limit, os.fspath(ground_truth_cloud), notes)
    if not np.isfinite(ground_truth).all(axis=1).any():
        raise InputError(f"{ground_truth_cloud}: expected finite ground-truth points, found none")
    events.advanced("validate")
    found: dict[str, tuple[NDArray[np.float64], CloudScore]] = {}
    for name, path in files.items():
        geometry = read_ply_geometry(path)
        moved = PlyGeometry(similarity.apply(sim, geometry.xyz), geometry.triangles)
        xyz = _points(moved, limit, name, notes)
        score = score_cloud(xyz, ground_truth, [limit * factor for factor in DISTANCE_FACTORS], threads=threads)
        found[name] = xyz, score
        events.advanced("validate", message=name)
    place = (folder if folder.is_dir() else folder.parent) / FOLDER
    place.mkdir(parents=True, exist_ok=True)
    recording = _record(place / "cloud_error.rrd", found, ground_truth, events)
    scores = {name: score.summary() for name, (_, score) in found.items()}
    result = CloudValidation(os.fspath(ground_truth_cloud), limit, scores, recording, notes)
    with replaced_file(place / "cloud.json") as beside:
        beside.write_text(to_json(result, indent=1) + "\n", encoding="utf-8")
    events.finished("validate", f"scored {', '.join(found)}", **result)
    return result


def _files(folder: Path) -> dict[str, Path]:
    """What can be scored, by the name that the report gives it."""
    if folder.is_file():
        return {folder.name: folder}
    files = {path.as_posix(): folder / path for path in (CLOUD, MESH) if (folder / path).is_file()}
    if not files:
        raise InputError(
            f"{folder}: expected {CLOUD.as_posix()} or {MESH.as_posix()}, found neither", "run sfmapp dense"
        )
    return files


def _distance(folder: Path, distance: float | None, scale: float) -> float:
    if distance is not None:
        if not (np.isfinite(distance) and distance > 0):
            raise UsageError(f"expected a distance above 0, found {distance:g}")
        return distance
    path = folder / PATCHES
    if not path.is_file():
        raise UsageError(f"{path} does not exist, so the size of a pixel is not known", "give --distance")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            sizes = np.asarray(arrays["size"], np.float64)
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: expected an array 'size': {error}") from error
    sizes = sizes[np.isfinite(sizes) & (sizes > 0)]
    if not len(sizes):
        raise UsageError(f"{path} holds no patches, so the size of a pixel is not known", "give --distance")
    return float(np.median(sizes)) * scale


def _alignment(folder: Path, ground_truth_poses: Path, notes: list[str]) -> NDArray[np.float64]:
    """``ground_truth_from_ours`` (8,) of the cameras in the workspace."""
    model_folder = folder / "sparse" / "0"
    if not has_model(model_folder):
        raise InputError(f"{model_folder}: expected a model, to align it with {ground_truth_poses}, found none")
    model = read_model(model_folder)[0]
    ground_truth = read_ground_truth(ground_truth_poses).for_images(model.image_names)
    # where all centres are on a line, the axes of the cameras tell how the scene is turned about it
    ground_truth = ground_truth_in_stored_pixels(ground_truth, model, orientations_of(folder), notes)
    errors = evaluate_poses(model.image_names, model.cam_from_world, ground_truth.names, ground_truth.cam_from_world)
    if errors.reference_from_estimate is None:
        raise InputError(
            f"{ground_truth_poses}: expected ground-truth cameras of two photographs of the model, found fewer"
        )
    residual = np.nanmedian(errors.center_error)
    notes.append(
        f"moved by a similarity fitted to {int(errors.is_common.sum())} cameras, median residual {residual:.4g}"
    )
    return errors.reference_from_estimate


def _points(geometry: PlyGeometry, distance: float, name: str, notes: list[str]) -> NDArray[np.float64]:
    """The points of a cloud, or points spread over a mesh."""
    if num_lost := int((~geometry.is_finite).sum()):
        notes.append(f"{name}: {num_lost} of {len(geometry.xyz)} points are not finite and are left out")
    if geometry.triangles is None or not len(geometry.triangles):
        return geometry.xyz
    area = float(triangle_areas(geometry.xyz[geometry.triangles]).sum())
    count = int(np.clip(_SAMPLES_PER_SQUARE * area / distance**2, *_SAMPLES))
    notes.append(f"{name} is a mesh of {len(geometry.triangles)} triangles: {count} points were spread over it")
    return sample_triangles(geometry.xyz, geometry.triangles, count)


def _record(
    path: Path,
    found: dict[str, tuple[NDArray[np.float64], CloudScore]],
    ground_truth: NDArray[np.float64],
    events: Events,
) -> str | None:
    """Write the recording; a failure is a warning, as the scores are worth having without it."""
    try:
        from sfmapp.viewer.cloud_error import ErrorCloud, write_error_rrd

        clouds, limits = {}, np.zeros(len(DISTANCE_FACTORS))
        for name, (xyz, score) in found.items():
            stem, limits = Path(name).stem, score.distances
            clouds[f"{stem}/accuracy"] = ErrorCloud(xyz, score.point_distance)
            clouds[f"{stem}/completeness"] = ErrorCloud(ground_truth, score.ground_truth_distance)
        write_error_rrd(path, clouds, limits, f"Errors of {', '.join(found)}")
    except Exception as error:  # rerun raises what it likes
        events.warned("validate", f"{path} was not written: {error}")
        return None
    return str(path)
