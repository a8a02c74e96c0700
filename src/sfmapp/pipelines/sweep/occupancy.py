"""The feature-occupancy volume of a model: edges of its photographs, a box about its points, and the files of both."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.carve.feature_occupancy import STAGE, sweep_features
from sfmapp.carve.views import view_of_camera
from sfmapp.dense.prepare import DensePlan, load_scene, part_of
from sfmapp.dense.pyramid import noise_deviation
from sfmapp.errors import InputError, UsageError
from sfmapp.events import Events
from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.ply import write_ply
from sfmapp.report.sweep_document import OccupancyReport

# on the longest side; the most are about a gigabyte
_CELLS = (8, 512)
# the box holds all points but so many on either side of each axis, and so much more, as shares
_OUTSIDE, _MARGIN = 0.01, 0.05
# gradients (Sobel) that begin an edge: the strongest tenth, and four deviations of what noise alone makes of them,
# which is sqrt(12) times its own; edges go on from there to half of it
_STRONGEST, _NOISE_FACTOR, _GOES_ON = 0.9, 4.0 * np.sqrt(12.0), 0.5
FILES = ("occupancy.npz", "occupancy.ply")


def write_occupancy(plan: DensePlan, cells: int, folder: Path, events: Events) -> OccupancyReport:
    """Sweep a plane through the box of a plan's sparse points, and write what it finds.

    ``occupancy.npz`` gets ``low``, ``cell``, ``votes``, ``seen`` and ``is_feature`` of
    :class:`~sfmapp.carve.feature_occupancy.FeatureOccupancy`, ``occupancy.ply`` the middles of the cells that hold a
    feature, the brighter the more photographs vote for them.

    Args:
        plan: views and points. cells: on the longest side of the box.
        folder: for the files.
        events: progress and cancellation.

    Raises:
        UsageError: a number of cells that is none.
        InputError: the model has no points.
    """
    if not _CELLS[0] <= cells <= _CELLS[1]:
        raise UsageError(f"--occupancy {cells}: expected {_CELLS[0]} to {_CELLS[1]} cells")
    if not len(plan.point_xyz):
        raise InputError("the model has no points to tell the box of the volume", "triangulate, or reconstruct anew")
    low, high = np.quantile(plan.point_xyz, (_OUTSIDE, 1.0 - _OUTSIDE), axis=0)
    low, high = low - _MARGIN * (high - low), high + _MARGIN * (high - low)
    cell = float((high - low).max()) / cells
    width, depth, height = (max(int(np.ceil(side)), 1) for side in (high - low) / cell)
    views, edges = [], []
    for v in range(len(plan.records)):
        events.raise_if_cancelled()
        view = load_scene(part_of(plan, np.array([v]))).views[0]
        camera = Camera(CameraModel.PINHOLE, view.width, view.height, view.k)
        views.append(view_of_camera(view.name, camera, view.cam_from_world))
        edges.append(edges_of(view.rgb, view.mask))
    found = sweep_features(views, edges, low, cell, (height, depth, width), events)
    if not found.is_feature.any():
        events.warned(
            STAGE,
            f"no cell holds a feature that chance does not explain: cells of {cell:.3g} are so wide in pixels, or the "
            f"{len(views)} photographs so few, that most cells hold an edge in all of them; ask for more cells",
        )
    with replaced_file(folder / FILES[0]) as beside, beside.open("wb") as file:
        np.savez_compressed(
            file, low=found.low, cell=found.cell, votes=found.votes, seen=found.seen, is_feature=found.is_feature
        )
    share = found.votes[found.is_feature] / found.seen[found.is_feature]
    write_ply(folder / FILES[1], found.points, np.repeat(np.rint(255.0 * share).astype(np.uint8)[:, None], 3, axis=1))
    return OccupancyReport(cells=[width, depth, height], cell=cell, num_features=len(found.points))


def edges_of(rgb: NDArray[np.uint8], mask: NDArray[np.bool_] | None) -> NDArray[np.uint8]:
    """Edges (H, W), 255 or 0, of a photograph (H, W, 3): Canny's, their thresholds from its own gradients and noise."""
    grey = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)
    across, down = (cv2.Sobel(grey, cv2.CV_16S, dx, 1 - dx) for dx in (1, 0))
    strength = np.hypot(across.astype(np.float32), down.astype(np.float32))
    begins = max(float(np.quantile(strength, _STRONGEST)), _NOISE_FACTOR * noise_deviation(grey))
    edges = cv2.Canny(across, down, _GOES_ON * begins, begins, L2gradient=True)
    return np.asarray(edges if mask is None else np.where(mask, edges, 0), np.uint8)
