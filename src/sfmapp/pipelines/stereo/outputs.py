"""What is written of a measured pair: maps with their errors, cloud and mesh."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sfmapp.camera_files.rectified_writing import CAMERA_FILES, RectifiedCameras, write_rectified_files
from sfmapp.formats.atomic import write_array, write_bytes
from sfmapp.formats.disparity_files import fits_kitti, write_disparity
from sfmapp.formats.glb import write_glb
from sfmapp.formats.ply import write_ply
from sfmapp.formats.sampling_maps import SAMPLING_MAPS, write_sampling_maps
from sfmapp.images.pixels import as_rgb
from sfmapp.stereo.measured import MeasuredPair, cloud_of, mesh_of
from sfmapp.stereo.prepare import PreparedPair
from sfmapp.stereo.result import DisparityMap, RectifiedPair
from sfmapp.stereo.sparse import sparse_points

SPARSE = ("sparse.csv", "sparse.ply")
"""Of keypoints alone."""

_COVARIANCES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_COLUMNS = ("x", "y", "z", "xx", "xy", "xz", "yy", "yz", "zz", "left_x", "left_y", "right_x", "right_y")


def write_cameras(folder: Path, prepared: PreparedPair) -> Iterator[Path]:
    """The cameras before and after rectification, for other programs; gives the path of each file. None where no
    baseline is known."""
    plan, g = prepared.plan, prepared.pair.geometry
    if plan is None or g is None or g.baseline is None:
        for name in CAMERA_FILES:
            (folder / name).unlink(missing_ok=True)
        return
    rotations = np.stack([plan.left_from_camera, plan.right_from_camera])
    yield from write_rectified_files(
        folder,
        RectifiedCameras(
            plan.rig, rotations, g.focal, g.cx, g.cy, g.doffs, g.baseline, (g.width, g.height), is_metric=g.unit == "m"
        ),
    )


def write_maps(folder: Path, found: DisparityMap, measured: MeasuredPair) -> Iterator[Path]:
    """Disparities in the forms of other programs, depths, and the errors of both; gives the path of each file."""
    for suffix in ("npy", "pfm", "png"):
        path = folder / f"disparity.{suffix}"
        if suffix == "png" and not fits_kitti(found.disparity):
            path.unlink(missing_ok=True)  # KITTI's has no place for them
            continue
        write_disparity(path, found.disparity)
        yield path
    arrays = {
        "disparity_sigma.npy": measured.error.sigma, "disparity_95.npy": measured.error.half_width_95,
        "confidence.npy": measured.error.confidence, "depth.npy": measured.depth,
        "depth_sigma.npy": measured.depth_sigma,
    }  # fmt: skip
    for name, array in arrays.items():
        path = folder / name
        if array is None:
            path.unlink(missing_ok=True)  # of an earlier run with a baseline
            continue
        write_array(path, array)
        yield path


def write_models(folder: Path, pair: RectifiedPair, found: DisparityMap, measured: MeasuredPair) -> Iterator[Path]:
    """The coloured cloud and the textured mesh of the view, where depths are known; gives the path of each."""
    cloud, mesh = folder / "cloud.ply", folder / "view.glb"
    if measured.depth is None or not measured.is_solid.any():
        for path in (cloud, mesh):
            path.unlink(missing_ok=True)
        return
    write_ply(cloud, *cloud_of(pair, measured))
    yield cloud
    write_glb(mesh, mesh_of(pair, found, measured))
    yield mesh


def write_sampling(folder: Path, prepared: PreparedPair, *, wanted: bool) -> Iterator[Path]:
    """Where pixels of the pair come from, if that is wanted and a plane rectifies it; gives the path of each file."""
    if not wanted or prepared.plan is None:
        for name in SAMPLING_MAPS:
            (folder / name).unlink(missing_ok=True)
        return
    yield from write_sampling_maps(folder, *(prepared.plan.sampling_map(side).astype(np.float32) for side in (0, 1)))


def write_sparse(folder: Path, pair: RectifiedPair, *, wanted: bool) -> Iterator[Path]:
    """Points of keypoints alone with their covariances, where they are wanted; gives the path of each."""
    table, cloud = (folder / name for name in SPARSE)
    if not wanted or pair.geometry is None or pair.geometry.baseline is None:
        for path in (table, cloud):
            path.unlink(missing_ok=True)
        return
    found = sparse_points(pair)
    rows = np.column_stack([
        found.xyz, *(found.covariance[:, i, j] for i, j in _COVARIANCES), found.matches.left, found.matches.right
    ])  # fmt: skip
    lines = [",".join(_COLUMNS), *(",".join(f"{value:.9g}" for value in row) for row in rows)]
    write_bytes(table, "\n".join([*lines, ""]).encode())
    yield table
    x, y = found.matches.left.astype(np.int64).T
    write_ply(cloud, found.xyz, as_rgb(pair.left)[y, x])
    yield cloud
