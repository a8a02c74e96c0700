"""Two cameras one of which stands in front of the other: rows that are half-planes about the baseline.

No plane shows epipolar lines as rows where an epipole lies in the picture. A cylinder about the baseline does, after
Pollefeys, Koch and Van Gool, "A simple and efficient rectification method for general motion" (ICCV 1999), and Roy,
Meunier and Cox (CVPR 1997): a row is the angle about the baseline, a column the angle theta from it. Columns go by
log tan(theta / 2): that is the conformal one, so windows keep their shape, and what comes nearer grows by the same
factor all over them. A disparity then is the logarithm of how much nearer a point has come, whatever its direction.

What was found is brought back to the left photograph, as the disparities of a camera that stood beside it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_rays, project
from sfmapp.dense.undistort import resample
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.planes.sampling import resampled
from sfmapp.scene.rig import Rig
from sfmapp.stereo.disparity_error import DisparityError
from sfmapp.stereo.measured import MeasuredPair, measured_of
from sfmapp.stereo.result import DisparityMap, PixelState, RectifiedGeometry, RectifiedPair

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Pixels = NDArray[np.uint8]

# pixels of a result to one of the photograph where it is farthest from the epipole: rows there are not enlarged
_SCALE = 0.75
# and at most so many in all: what is about the epipole is enlarged anyway
_MOST_PIXELS = 4e6
# nearer to the epipole, as a share of the farthest corner, a disparity tells next to nothing
_NEAREST_SHARE = 0.04
# rows beyond a full turn on either side, so that every pixel has neighbours
_OVERLAP = 24
# share of a pixel that the photograph has to show
_COVERED = 0.99
# rows that are brought back at a time
_STRIP = 16
# neighbours whose disparities differ by more are of two surfaces, pixels
_STEP_PX = 0.75


@dataclass(frozen=True)
class PolarRectification:
    """How two photographs become a pair whose rows are half-planes about the baseline.

    Attributes:
        rig: the two cameras, in the order of the photographs.
        axes: (3, 3) rotation from the first camera's frame: z along the baseline towards the second, or away from it
            where that one stands behind.
        scale: pixels for a radian about the baseline.
        start: log tan(theta / 2) of the first column.
        width, height: of the pair.
        is_second_ahead: in the direction that both look.
    """

    rig: Rig
    axes: Array
    scale: float
    start: float
    width: int
    height: int
    is_second_ahead: bool

    def rays(self, column: Array, row: Array, turn: Array | None = None) -> Array:
        """(..., 3) directions of pixels in the frame of the first camera, or in one that is turned against it by
        ``turn`` (3, 3). Columns and rows are broadcast: those of a rectangle, (C,) and (R, 1), cost little more than
        its sides. Columns of a second camera that stands behind run inwards, so that disparities are positive."""
        axes = self.axes if turn is None else self.axes @ turn.T
        along, about = self._along(column), (row - _OVERLAP) / self.scale
        # tan(theta / 2) = exp(u): cos theta = -tanh u, sin theta = 1 / cosh u
        across, ahead, cos, sin = 1.0 / np.cosh(along), -np.tanh(along), np.cos(about), np.sin(about)
        rays = np.empty((*np.broadcast_shapes(column.shape, row.shape), 3))
        for k in range(3):
            rays[..., k] = across * (cos * axes[0, k] + sin * axes[1, k]) + ahead * axes[2, k]
        return rays

    def places(self, rays: Array) -> Array:
        """(N, 2) pixels of directions (N, 3) in the first camera's frame."""
        right, down, ahead = np.ascontiguousarray((rays @ self.axes.T).T)
        across = right * right + down * down
        length = np.sqrt(across + ahead * ahead)
        # log tan(theta / 2), bounded in the direction of the baseline
        along = np.log(np.maximum(np.sqrt(across), 1e-6 * length) / np.maximum(length + ahead, 1e-12 * length))
        about = np.arctan2(down, right)
        about[about < 0.0] += 2.0 * math.pi
        column = (along - self.start) * self.scale
        return np.stack([self.width - column if self.is_second_ahead else column, about * self.scale + _OVERLAP], 1)

    def _along(self, column: Array) -> Array:
        column = self.width - column if self.is_second_ahead else column
        return np.asarray(self.start + column / self.scale)

    def ranges(self, rays: Array, disparity: Array) -> tuple[Array, Array]:
        """How far away along unit directions (N, 3) of the first camera something with these disparities (N,) is, and
        how fast that changes with them; in the unit of the baseline, NaN beyond infinity."""
        baseline = float(np.linalg.norm(self.rig.cam_from_rig[1, 4:]))
        cos = np.clip(rays @ self.axes[2], -1.0, 1.0)
        sin = np.sqrt(1.0 - cos * cos)
        sign = 1.0 if self.is_second_ahead else -1.0
        # tan(theta / 2) of the other camera's ray: disparities are differences of logarithms
        other = np.maximum(sin, 1e-12) / np.maximum(1.0 + cos, 1e-12) * np.exp(sign * disparity / self.scale)
        square = other * other
        other_sin, other_cos = 2.0 * other / (1.0 + square), (1.0 - square) / (1.0 + square)
        between = sign * (other_sin * cos - other_cos * sin)
        between[~(between > 0.0)] = np.nan
        return baseline * other_sin / between, -baseline * sin * other_sin / (self.scale * between**2)


def plan_polar(rig: Rig) -> PolarRectification:
    """How a pair is rectified of which one camera stands in front of the other.

    Raises:
        InputError: both stand at one place, or the epipole is not in the first picture.
    """
    center = rigid3.center(rig.cam_from_rig[1])
    length = float(np.linalg.norm(center))
    if not length > 0.0:
        raise InputError("expected two cameras at two places, found both at one", "check the translation of the rig")
    is_ahead = bool(center[2] > 0.0)
    forward = center / length * (1.0 if is_ahead else -1.0)
    right = np.cross(forward, [0.0, -1.0, 0.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    camera = rig.cameras[0]
    w, h = float(camera.width), float(camera.height)
    corners = pixels_to_rays(camera, np.array([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]]))
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    widest = float(np.arccos(np.clip(np.nanmin(corners @ forward), -1.0, 1.0)))
    # at the widest, a radian about the baseline is sin(theta) focal lengths long
    scale = _SCALE * camera.focal * math.sin(min(widest, 0.5 * math.pi))
    end = math.log(math.tan(0.5 * min(widest, 0.6 * math.pi)))
    start = math.log(math.tan(0.5 * _NEAREST_SHARE * widest))
    scale = min(scale, math.sqrt(_MOST_PIXELS / (2.0 * math.pi * (end - start))))
    height = round(2.0 * math.pi * scale)
    width = max(round((end - start) * scale), 1)
    return PolarRectification(rig, axes, height / (2.0 * math.pi), start, width, height + 2 * _OVERLAP, is_ahead)


def rectify_polar(plan: PolarRectification, left: Pixels, right: Pixels) -> RectifiedPair:
    """The pictures of a pair, averaged where they are made smaller; of a geometry they have infinity alone."""
    turn = rigid3.rotation_matrix(plan.rig.cam_from_rig[1])
    pictures, shown = [], []
    for camera, photograph, rotation in zip(plan.rig.cameras, (left, right), (np.eye(3), turn), strict=True):
        layers = photograph if photograph.ndim == 3 else photograph[..., None]

        def find(xy: Array, camera: Camera = camera, rotation: Array = rotation) -> Array:
            # of a rectangle, row by row
            width = int(np.count_nonzero(xy[:, 1] == xy[0, 1]))
            return project(camera, plan.rays(xy[:width, 0], xy[::width, 1:], rotation).reshape(-1, 3))

        flat = np.zeros((plan.height, plan.width, layers.shape[2]), np.uint8)
        cover = np.zeros((plan.height, plan.width), np.bool_)
        for tile in resampled(layers, find, (0, 0, plan.width, plan.height)):
            flat[tile.rows, tile.columns] = np.clip(np.rint(tile.values), 0, 255)
            cover[tile.rows, tile.columns] = tile.cover > _COVERED
        flat[~cover] = 0
        pictures.append(flat.reshape(*cover.shape, *photograph.shape[2:]))
        shown.append(cover)
    geometry = RectifiedGeometry(plan.width, plan.height, plan.scale, 0.0, 0.0)
    return RectifiedPair(pictures[0], pictures[1], shown[0], shown[1], geometry)


def on_photograph(
    plan: PolarRectification, pair: RectifiedPair, found: DisparityMap, error: DisparityError,
    photographs: tuple[Pixels, Pixels], unit: str, *, has_baseline: bool = True,
) -> tuple[RectifiedPair, DisparityMap, MeasuredPair]:  # fmt: skip
    """What was found in a polar pair, pixel by pixel of the left photograph without its distortion.

    Returns:
        The left photograph and the right one as if it had been taken from the same place, for what is far; disparities
        that a camera beside the left one would have, at the distance that the two have, which are as many pixels as
        depths ask for and have the sigmas that depths have; and the depths.
    """
    camera = plan.rig.cameras[0]
    focal, size = camera.focal, (camera.width, camera.height)
    k = np.array([focal, focal, *_principal_point(camera)])
    turn = rigid3.rotation_matrix(plan.rig.cam_from_rig[1])
    flat, shown = zip(
        *(
            resample(one, k, size, photograph, rotation)
            for one, photograph, rotation in zip(plan.rig.cameras, photographs, (np.eye(3), turn.T), strict=True)
        ),
        strict=True,
    )
    baseline = float(np.linalg.norm(plan.rig.cam_from_rig[1, 4:]))
    geometry = RectifiedGeometry(size[0], size[1], focal, k[2], k[3], 0.0, baseline if has_baseline else None, unit)
    shape = size[1], size[0]
    place, depth, steps = np.empty((*shape, 2), np.float32), np.empty(shape), np.empty(shape)
    for top in range(0, shape[0], _STRIP):  # which stays near the processor
        rows = slice(top, min(top + _STRIP, shape[0]))
        place[rows], depth[rows], steps[rows] = _looked_up(plan, k, rows, found.disparity)
    beside = (focal * baseline / depth).astype(np.float32)
    is_known = np.isfinite(beside) & (shown[0] == 255)

    def on_grid(values: Map, factor: Array | float = 1.0) -> Map:
        near = cv2.remap(values, place, None, cv2.INTER_NEAREST, borderValue=float("nan"))
        return np.where(is_known, near * factor, np.nan).astype(np.float32)

    sigma, half = on_grid(error.sigma, steps), on_grid(error.half_width_95, steps)
    confidence = np.nan_to_num(on_grid(error.confidence))
    state = np.where(is_known, PixelState.MATCHED, PixelState.UNKNOWN).astype(np.uint8)
    there = np.where(is_known, beside, np.nan).astype(np.float32)
    known = there[is_known]
    searched = (0.0, float(np.quantile(known, 0.999)) if known.size else 0.0)
    map_ = DisparityMap(
        there, state, on_grid(found.cost), on_grid(found.curvature), np.nan_to_num(on_grid(found.uniqueness)), searched,
        found.info,
    )  # fmt: skip
    both = RectifiedPair(flat[0], flat[1], shown[0] == 255, shown[1] == 255, geometry)
    return both, map_, measured_of(geometry, map_, DisparityError(sigma, half, confidence))


def _looked_up(
    plan: PolarRectification, k: Array, rows: slice, disparity: Map
) -> tuple[NDArray[np.float32], Array, Array]:
    """Where some rows (R) of the flat left photograph are in the pair, (R, W, 2); their depths (R, W), and how many
    pixels of a disparity beside it one of the pair is, as errors are enlarged."""
    focal = k[0]
    y, x = np.mgrid[rows, : plan.rig.cameras[0].width] + 0.5
    rays = np.stack([(x - k[2]) / focal, (y - k[3]) / focal, np.ones_like(x)], -1).reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1)
    rays /= length[:, None]
    place = (plan.places(rays) - 0.5).reshape(*x.shape, 2).astype(np.float32)
    ranges, slope = plan.ranges(rays, _sampled(disparity, place).ravel().astype(np.float64))
    depth = ranges / length
    steps = np.abs(slope / length) * focal * np.linalg.norm(plan.rig.cam_from_rig[1, 4:]) / depth**2
    # an error in pixels that are enlarged is enlarged with them, in one direction; it is averaged in the other
    cos = np.clip(rays @ plan.axes[2], 0.1, 1.0)
    enlarged = plan.scale / np.maximum(focal * np.sqrt(1.0 - cos * cos) / cos, 1.0)
    steps *= np.sqrt(np.maximum(enlarged, 1.0))
    return place, depth.reshape(x.shape), steps.reshape(x.shape)


def _principal_point(camera: Camera) -> tuple[float, float]:
    """Where the camera looks straight ahead, pixels."""
    x, y = project(camera, np.array([[0.0, 0.0, 1.0]]))[0]
    return float(x), float(y)


def _sampled(disparity: Map, place: NDArray[np.float32]) -> Map:
    """Between four disparities of one surface, else the nearest."""
    linear = cv2.remap(disparity, place, None, cv2.INTER_LINEAR, borderValue=float("nan"))
    near = cv2.remap(disparity, place, None, cv2.INTER_NEAREST, borderValue=float("nan"))
    return np.asarray(np.where(np.abs(linear - near) < _STEP_PX, linear, near), np.float32)
