"""Rectified pairs whose disparities are known: three shared ones, and pairs rendered from worlds of rectangles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rendered_worlds.rendering import Optics, Renderer, World
from rendered_worlds.worlds import gallery_world, hall_world, room_world, street_world
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3
from sfmapp.stereo.result import RectifiedGeometry, RectifiedPair

# two surfaces this far apart in disparity do not both show in a pixel of the right picture
OCCLUDED_BY_PX = 1.5


@dataclass(frozen=True)
class StereoSet:
    """A pair and what is true of it.

    Attributes:
        name: of the set.
        pair: the pictures, RGB or grey.
        truth: (H, W) float32 disparities of the left picture, NaN where they are not known.
        visible: (H, W) bool: known, and seen by the right camera too.
        search: the least disparity that all matchers look for, and how many from there on, a multiple of 16.
    """

    name: str
    pair: RectifiedPair
    truth: NDArray[np.float32]
    visible: NDArray[np.bool_]
    search: tuple[int, int]


def visible_from_right(truth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W): pixels of the left picture that nothing nearer covers in the right one, by the left disparities alone."""
    height, width = truth.shape
    known = np.isfinite(truth)
    rows, columns = np.nonzero(known)
    disparity = truth[known]
    place = columns - disparity
    nearest = np.full((height, width + 2), -np.inf, np.float32)  # a column more on either side
    for side in (np.floor(place), np.ceil(place)):
        np.maximum.at(nearest, (rows, np.clip(side, -1, width).astype(np.int64) + 1), disparity)
    visible = np.zeros(truth.shape, np.bool_)
    there = np.clip(np.rint(place), -1, width).astype(np.int64) + 1
    visible[known] = (nearest[rows, there] < disparity + OCCLUDED_BY_PX) & (place >= 0) & (place <= width - 1)
    return visible


def shared_sets(root: Path) -> Iterator[StereoSet]:
    """Motorcycle (Scharstein et al. 2014), cones (2003) and aloe (2006) of Middlebury, those that lie in ``root``."""
    folder = root / "skimage-motorcycle"
    if folder.is_dir():
        geometry = RectifiedGeometry(741, 500, 994.978, 311.693, 255.377, 31.086, 0.193001, "m")
        truth = np.load(folder / "motorcycle_disp.npz")["arr_0"].astype(np.float32)
        names = ("motorcycle_left.png", "motorcycle_right.png")
        yield _shared("motorcycle", [folder / name for name in names], truth, (0, 64), geometry)
    folder = root / "stereo-cones"
    if folder.is_dir():
        truth = cv2.imread(str(folder / "disp2.png"), cv2.IMREAD_UNCHANGED).astype(np.float32) / 4
        yield _shared("cones", [folder / "im2.png", folder / "im6.png"], truth, (0, 64))
    folder = root / "opencv-doc-samples" / "stereo_aloe"
    if folder.is_dir():
        truth = cv2.imread(str(folder / "aloeGT.png"), cv2.IMREAD_UNCHANGED).astype(np.float32)
        yield _shared("aloe", [folder / "aloeL.jpg", folder / "aloeR.jpg"], truth, (0, 224))


def _shared(
    name: str, files: list[Path], truth: NDArray[np.float32], search: tuple[int, int],
    geometry: RectifiedGeometry | None = None,
) -> StereoSet:  # fmt: skip
    truth = np.where(np.isfinite(truth) & (truth > 0), truth, np.nan).astype(np.float32)
    left, right = (np.ascontiguousarray(cv2.imread(str(path))[..., ::-1]) for path in files)
    shown = np.ones(truth.shape, np.bool_)
    pair = RectifiedPair(left, right, shown, shown, geometry)
    return StereoSet(name, pair, truth, visible_from_right(truth), search)


@dataclass(frozen=True)
class Shot:
    """Where a rendered pair is taken: the left camera's centre, its heading, tilt, baseline and lenses."""

    name: str
    world: World
    centre: tuple[float, float, float]
    heading_deg: float
    tilt_deg: float
    baseline: float
    focal: float
    size: tuple[int, int]
    doffs: float
    search: tuple[int, int]


def shots() -> list[Shot]:
    """The rendered pairs; the last two have disparities on both sides of zero, as converging cameras do."""
    vga, wide = (752, 480), (1241, 376)
    return [
        Shot("room", room_world(1), (1.6, -1.9, 1.5), 120.0, -12.0, 0.12, 600.0, vga, 0.0, (0, 64)),
        Shot("gallery", gallery_world(1), (-1.2, -1.5, 1.4), 60.0, -10.0, 0.15, 620.0, vga, 0.0, (0, 64)),
        Shot("hall", hall_world(1), (2.0, -5.0, 1.8), 75.0, -8.0, 0.30, 600.0, vga, 0.0, (0, 80)),
        Shot("street", street_world(1), (-24.0, -1.6, 1.65), 0.0, -1.0, 0.537, 719.0, wide, 0.0, (0, 96)),
        Shot("room, converging", room_world(2), (-1.4, 1.0, 1.4), -60.0, -14.0, 0.15, 600.0, vga, 32.0, (-32, 80)),
        Shot("hall, converging", hall_world(2), (-2.5, 4.0, 2.2), -70.0, -12.0, 0.35, 600.0, vga, 36.0, (-32, 80)),
    ]


def rendered_set(shot: Shot) -> StereoSet:
    """Render a pair: two cameras whose noise and exposure differ, as two sensors do."""
    width, height = shot.size
    cx, cy = 0.5 * width + 3.3, 0.5 * height - 2.1
    cameras = [
        Camera(CameraModel.PINHOLE, width, height, np.array([shot.focal, shot.focal, cx + doffs, cy]))
        for doffs in (0.0, shot.doffs)
    ]
    heading, tilt = np.radians([shot.heading_deg, shot.tilt_deg])
    ahead = np.array([np.cos(heading) * np.cos(tilt), np.sin(heading) * np.cos(tilt), np.sin(tilt)])
    across = np.array([np.sin(heading), -np.cos(heading), 0.0])
    rotation = np.stack([across, np.cross(ahead, across), ahead])
    optics, pictures = Optics(noise_sigma=2.0), []
    for side, camera in enumerate(cameras):
        centre = np.array(shot.centre) + side * shot.baseline * across
        pose = rigid3.from_matrix(rotation, -rotation @ centre)
        renderer = Renderer(shot.world, camera)
        pictures.append(renderer.photograph(pose, optics, [7, side], gain=1.0 + 0.06 * side))
        if side == 0:
            depth = renderer.view(pose, edge_samples=False).depth
    truth = (shot.focal * shot.baseline / depth - shot.doffs).astype(np.float32)
    geometry = RectifiedGeometry(width, height, shot.focal, cx, cy, shot.doffs, shot.baseline, "m")
    shown = np.ones(truth.shape, np.bool_)
    pair = RectifiedPair(pictures[0], pictures[1], shown, shown, geometry)
    return StereoSet(shot.name, pair, truth, visible_from_right(truth), shot.search)
