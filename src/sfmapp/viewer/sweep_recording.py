"""From swept depth maps to ``recording.rrd``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.feature_occupancy import FeatureOccupancy
from sfmapp.dense.maps import depth_picture
from sfmapp.geometry import rigid3
from sfmapp.geometry.upright import up_direction
from sfmapp.viewer.dense_replay import thinned
from sfmapp.viewer.photos import shrunk_jpeg
from sfmapp.viewer.recording import RecordingReport, record_in_child
from sfmapp.viewer.stereo_recording import errors_in_colors
from sfmapp.viewer.sweep_replay import Pixels, SweepReplay

Map = NDArray[np.float32]

# of all maps together, and cells of the volume: some 30 MB each
_POINTS, _CELLS = 800_000, 200_000
_QUALITY = 85


@dataclass(frozen=True)
class ShownMap:
    """A map as it is shown, small.

    Attributes:
        name, text: of the photograph, and what is said of its map.
        rgb: (H, W, 3). depth, sigma: (H, W), NaN where nothing is known. k: (4,) of these. cam_from_world: (7,).
    """

    name: str
    text: str
    rgb: Pixels
    depth: Map
    sigma: Map
    k: NDArray[np.float64]
    cam_from_world: NDArray[np.float64]


def record_sweep(
    path: Path, title: str, story: str, maps: Sequence[ShownMap], volume: FeatureOccupancy | None
) -> RecordingReport:
    """Write a recording in a child process; never raises for what happens there.

    Args:
        path: the file, replaced when the new one is whole. title: shown in the viewer. story: in words, Markdown.
        maps: one at least. volume: None for none.
    """
    return record_in_child(path, "sweep", lambda _: make_sweep_replay(title, story, maps, volume), timeout_s=180.0)


def make_sweep_replay(title: str, story: str, maps: Sequence[ShownMap], volume: FeatureOccupancy | None) -> SweepReplay:
    """Put maps together for the screen; points are thinned, the same ones every time."""
    poses = np.array([each.cam_from_world for each in maps])
    origin = np.median(rigid3.center(poses), axis=0)
    shifted = poses.copy()
    shifted[:, 4:] += rigid3.rotation_matrix(poses) @ origin
    clouds = [_cloud(each, pose, _POINTS // len(maps)) for each, pose in zip(maps, shifted, strict=True)]
    share = np.concatenate([cloud[2] for cloud in clouds])
    files = [
        shrunk_jpeg(picture[:, :, ::-1], max(picture.shape), _QUALITY)[0]
        for each in maps
        for picture in (each.rgb, depth_picture(each.depth), errors_in_colors(each.sigma / each.depth))
    ]
    cells, cell_rgb, cell, box = _cells(volume, origin)
    return SweepReplay(
        title=title, story=story, map_texts=[each.text for each in maps], up=up_direction(poses), origin=origin,
        names=[each.name for each in maps], cam_from_world=shifted, k=np.array([each.k for each in maps]),
        size=np.array([each.depth.shape[::-1] for each in maps], np.int64),
        jpeg=np.frombuffer(b"".join(files), np.uint8),
        jpeg_ptr=np.cumsum([0, *(len(file) for file in files)]).astype(np.int64),
        xyz=np.concatenate([cloud[0] for cloud in clouds]), rgb=np.concatenate([cloud[1] for cloud in clouds]),
        sigma_rgb=errors_in_colors(share), radius=np.concatenate([cloud[3] for cloud in clouds]),
        map_ptr=np.cumsum([0, *(len(cloud[0]) for cloud in clouds)]).astype(np.int64),
        cell_xyz=cells, cell_rgb=cell_rgb, cell=cell, box=box,
    )  # fmt: skip


def _cloud(shown: ShownMap, pose: NDArray[np.float64], most: int) -> tuple[Map, Pixels, Map, Map]:
    """Places, colours, sigmas as a share of the depth, and radii of the known pixels of a map."""
    v, u = np.nonzero(np.isfinite(shown.depth))
    chosen = thinned(len(v), most)
    widened = np.sqrt(len(v) / max(len(chosen), 1))
    v, u = v[chosen], u[chosen]
    depth = shown.depth[v, u].astype(np.float64)
    fx, fy, cx, cy = shown.k
    rays = np.stack([(u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy, np.ones(len(u))], axis=1)
    xyz = rigid3.apply(rigid3.inverse(pose), rays * depth[:, None])
    radius = 0.5 * widened * depth / fx
    return xyz.astype(np.float32), shown.rgb[v, u], shown.sigma[v, u] / shown.depth[v, u], radius.astype(np.float32)


def _cells(volume: FeatureOccupancy | None, origin: NDArray[np.float64]) -> tuple[Map, Pixels, float, Map]:
    if volume is None:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), 0.0, np.zeros((2, 3), np.float32)
    share = volume.votes[volume.is_feature] / np.maximum(volume.seen[volume.is_feature], 1)
    chosen = thinned(len(share), _CELLS)
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
    high = volume.low + volume.cell * np.array(volume.votes.shape[::-1])
    return (
        (volume.points[chosen] - origin).astype(np.float32), table[np.rint(255.0 * share[chosen]).astype(np.uint8)],
        volume.cell, (np.array([volume.low, high]) - origin).astype(np.float32),
    )  # fmt: skip
