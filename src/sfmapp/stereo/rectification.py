"""Two cameras, of any lens each, turned so that rows of their pictures are epipolar lines.

The x axis of both rectified cameras is the baseline, their z axis the bisector of the two optical axes as far as it is
perpendicular to the baseline: no rotation distorts both pictures less (Fusiello, Trucco and Verri, "A compact algorithm
for rectification of stereo pairs", Machine Vision and Applications 2000, whose axis is that of the first camera alone).
Rows that only one photograph reaches are cut off, and columns that the other camera cannot see at any distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_rays, project
from sfmapp.dense.undistort import resample
from sfmapp.errors import EpipoleInPictureError, InputError
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig
from sfmapp.stereo.result import RectifiedGeometry, RectifiedPair

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

# places along each side of a photograph at which it is asked where its border comes to lie
_BORDER_STEPS, _GRID_STEPS = 65, 33
# what lies farther off the rectified axis is left out: there a pixel is a quarter as wide as in the middle
_WIDEST_DEG = 60.0
# an axis that turns farther leaves less than half of a photograph on that plane
_MOST_TURN_DEG = 45.0
# sides of a result over those of its photograph, the undistorter's limit
_LARGEST_SIDE = 2.0
# cameras that would move no pixel by more are rectified as they are, pixels
_ALREADY_PX = 0.02
# share of each side of a photograph that the pair has to keep, for a search along rows to mean anything
_LEAST_SHARE = 0.1


@dataclass(frozen=True)
class Rectification:
    """How two photographs become a pair whose rows are epipolar lines.

    Attributes:
        rig: the two cameras, the left one first.
        left_from_camera, right_from_camera: (3, 3) rotations of points from the cameras' frames.
        geometry: of the result.
        is_identity: the photographs are rectified as they are.
        kept: share of the pixels of each photograph that is kept.
        scale: of each photograph, pixels of the result to one of its own in the middle of what is kept, along a side:
            below 1 it loses resolution.
        turn_deg: of each camera, how far its axis turns.
        is_turned: the cameras stand one above the other, and the pictures are laid on their side.
    """

    rig: Rig
    left_from_camera: Array
    right_from_camera: Array
    geometry: RectifiedGeometry
    is_identity: bool
    kept: tuple[float, float]
    scale: tuple[float, float]
    turn_deg: tuple[float, float]
    is_turned: bool

    def camera_matrix(self, side: int) -> Array:
        """(3, 3) of the left (0) or right (1) rectified camera, the centre of the first pixel at (0.5, 0.5)."""
        g = self.geometry
        return np.array([[g.focal, 0.0, g.cx + side * g.doffs], [0.0, g.focal, g.cy], [0.0, 0.0, 1.0]])

    def rotation(self, side: int) -> Array:
        """(3, 3) rectified from camera, of the left (0) or right (1) one."""
        return self.right_from_camera if side else self.left_from_camera

    def points(self, side: int, xy: Array) -> Array:
        """Rectified pixels (N, 2) of pixels (N, 2) of the left (0) or right (1) photograph; NaN behind the plane."""
        rays = pixels_to_rays(self.rig.cameras[side], xy) @ self.rotation(side).T
        rays[~(rays[:, 2] > 0.0)] = np.nan
        flat: Array = (rays @ self.camera_matrix(side).T)[:, :2] / rays[:, 2:]
        return flat

    def sampling_map(self, side: int) -> Array:
        """(H, W, 2) pixels of the photograph that the pixels of the result show; NaN where its lens does not look."""
        g = self.geometry
        y, x = np.mgrid[: g.height, : g.width] + 0.5
        rays = np.stack([x - g.cx - side * g.doffs, y - g.cy, np.full(x.shape, g.focal)], -1).reshape(-1, 3)
        return project(self.rig.cameras[side], rays @ self.rotation(side)).reshape(g.height, g.width, 2)


def rectified_as_is(rig: Rig) -> RectifiedGeometry | None:
    """The geometry of two cameras whose pictures are rectified already, the left one first; None if they are not."""
    left, right = rig.cameras
    if not (left.is_pinhole and right.is_pinhole) or (left.width, left.height) != (right.width, right.height):
        return None
    fx, fy, cx, cy = left.canonical[:4]
    fx2, fy2, cx2, cy2 = right.canonical[:4]
    pose = rig.cam_from_rig[1]
    turn = math.radians(float(rigid3.rotation_angle_deg(rigid3.rotation_matrix(pose))))
    baseline = float(np.linalg.norm(pose[4:]))
    # by how much a pixel would move: of turns, of a baseline that is no row, of other scales, in pixels
    off = turn * fx + float(np.hypot(*pose[5:])) / max(baseline, 1e-300) * left.width
    off += max(abs(f / fx - 1.0) for f in (fy, fx2, fy2)) * max(left.width, left.height) + abs(cy2 - cy)
    if off > _ALREADY_PX or not pose[4] < 0.0:
        return None
    return RectifiedGeometry(left.width, left.height, fx, cx, cy, cx2 - cx, baseline, "m")


def plan_rectification(rig: Rig) -> Rectification:
    """How the photographs of two cameras are rectified.

    Args:
        rig: two cameras, the left one first; the second's pose is that of the right one in the left one's frame.

    Raises:
        EpipoleInPictureError: one sees the other, or would.
        InputError: the cameras stand at one place, the second is to the left of the first, or the pictures share too
            little.
    """
    as_is = rectified_as_is(rig)
    if as_is is not None:
        eye = np.eye(3)
        return Rectification(rig, eye, eye, as_is, True, (1.0, 1.0), (1.0, 1.0), (0.0, 0.0), False)
    left_turn, right_turn = _rotations(rig)
    turns = (left_turn, right_turn)
    sides = [_extent(camera, turn) for camera, turn in zip(rig.cameras, turns, strict=True)]
    focals = [_kept_focal(camera, turn) for camera, turn in zip(rig.cameras, turns, strict=True)]
    focal = math.sqrt(focals[0] * focals[1])
    geometry = _layout(rig, sides, focal)
    baseline = rigid3.inverse(rig.cam_from_rig[1])[4:]
    plan = Rectification(
        rig, left_turn, right_turn, geometry, False, (1.0, 1.0),
        (geometry.focal / focals[0], geometry.focal / focals[1]),
        (_axis_turn_deg(left_turn), _axis_turn_deg(right_turn)), abs(float(baseline[1])) > abs(float(baseline[0])),
    )  # fmt: skip
    kept = (_kept_share(plan, 0), _kept_share(plan, 1))
    if min(kept) < _LEAST_SHARE:
        raise InputError(
            f"the two cameras look too far apart: of the photographs {kept[0]:.0%} and {kept[1]:.0%} can be seen by "
            "both",
            "check that the calibration belongs to these photographs and is in their order",
        )
    return Rectification(**{**plan.__dict__, "kept": kept})


def _rotations(rig: Rig) -> tuple[Array, Array]:
    """Rotations into the rectified frame from those of the left and the right camera."""
    right_from_left = rigid3.rotation_matrix(rig.cam_from_rig[1])
    center = rigid3.center(rig.cam_from_rig[1])
    length = float(np.linalg.norm(center))
    if not length > 0.0:
        raise InputError("expected two cameras at two places, found both at one", "check the translation of the rig")
    along = center / length
    axes = np.array([0.0, 0.0, 1.0]) + right_from_left.T[:, 2]
    forward = axes - (axes @ along) * along
    if not np.linalg.norm(forward) > 1e-6:
        _refuse_epipole(rig.cameras[0], along)
        raise InputError("the two cameras look in opposite directions: nothing is seen by both")
    forward /= np.linalg.norm(forward)
    if abs(along[0]) >= abs(along[1]) and along[0] < 0.0:
        raise InputError(
            "the second camera stands to the left of the first: left and right are swapped", "give them the other way"
        )
    left_turn = np.stack([along, np.cross(forward, along), forward])
    turns = left_turn, left_turn @ right_from_left.T
    for camera, turn, axis in zip(rig.cameras, turns, (along, right_from_left @ -along), strict=True):
        if _axis_turn_deg(turn) > _MOST_TURN_DEG:
            _refuse_epipole(camera, axis)
    return turns


def _refuse_epipole(camera: Camera, towards: Array) -> None:
    """Refuse a camera that sees the other one, or would if that were in front of it: rows would meet in that point."""
    axis = towards if towards[2] > 0.0 else -towards
    x, y = project(camera, axis[None])[0]
    if 0.0 <= x <= camera.width and 0.0 <= y <= camera.height:
        raise EpipoleInPictureError(
            f"an epipole is inside the photograph, at ({x:.0f}, {y:.0f}): one camera stands in front of the other, and "
            "epipolar lines meet there, so that no plane shows them as rows",
            "take photographs side by side; sfmapp reconstruct and sfmapp dense take such pairs",
        )


def _axis_turn_deg(turn: Array) -> float:
    return math.degrees(math.acos(min(max(float(turn[2, 2]), -1.0), 1.0)))


def _border(camera: Camera) -> Array:
    w, h = float(camera.width), float(camera.height)
    x, y = np.linspace(0.0, w, _BORDER_STEPS), np.linspace(0.0, h, _BORDER_STEPS)
    return np.concatenate([np.stack([u + 0.0 * y, v + 0.0 * x], 1) for u, v in ((x, 0.0), (x, h), (0.0, y), (w, y))])


def _on_plane(rays: Array) -> Array:
    """(N, 2) places on the plane z = 1 of rays (N, 3), those too far out at the rim; NaN for NaN."""
    rim = math.tan(math.radians(_WIDEST_DEG))
    across = np.hypot(rays[:, 0], rays[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.where(
            rays[:, 2] > 0.0, np.minimum(across / rays[:, 2], rim), np.where(np.isnan(across), across, rim)
        )
        flat: Array = rays[:, :2] / across[:, None] * radius[:, None]
    flat[across == 0.0] = 0.0
    return flat


def _extent(camera: Camera, turn: Array) -> Array:
    """(4,) left, top, right and bottom of what a photograph shows on the plane z = 1: of each side of its bent border
    the median, between a picture without blanks and a whole one."""
    rays = pixels_to_rays(camera, _border(camera))
    flat = _on_plane(rays @ turn.T)
    flat = flat[np.isfinite(flat).all(1)]
    if not len(flat):
        raise InputError(f"the lens {camera.model.name} has no inverse at the border of the photograph")
    low, high = flat.min(0), flat.max(0)
    u, v = ((flat - 0.5 * (low + high)) / (high - low)).T
    is_side = np.abs(u) >= np.abs(v)
    groups = (is_side & (u < 0), ~is_side & (v < 0), is_side & (u > 0), ~is_side & (v > 0))
    fallback = (low[0], low[1], high[0], high[1])
    return np.array([
        np.median(flat[group, n % 2]) if group.any() else fallback[n] for n, group in enumerate(groups)
    ])  # fmt: skip


def _kept_focal(camera: Camera, turn: Array) -> float:
    """Focal length of a plane at which the middle of a photograph keeps its resolution: the median over it."""
    x, y = ((np.arange(_GRID_STEPS) + 0.5) / _GRID_STEPS * side for side in (camera.width, camera.height))
    center = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    flat = [
        _on_plane(pixels_to_rays(camera, center + step) @ turn.T)
        for step in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))
    ]
    along, down = flat[0] - flat[1], flat[2] - flat[3]
    area = np.abs(along[:, 0] * down[:, 1] - along[:, 1] * down[:, 0])
    area = area[np.isfinite(area) & (area > 0.0)]
    if not len(area):
        raise InputError(f"the lens {camera.model.name} shows nothing near the plane of the pair")
    return float(1.0 / math.sqrt(np.median(area)))


def _layout(rig: Rig, sides: list[Array], focal: float) -> RectifiedGeometry:
    """The common field, in pixels. A point is no further to the right in the right picture, at any distance: columns of
    the left one to the left of all that the right one shows have no partner, and the other way round."""
    left, right = sides
    top, bottom = max(left[1], right[1]), min(left[3], right[3])
    left_x, right_x = (max(left[0], right[0]), left[2]), (right[0], min(right[2], left[2]))
    width = max(left_x[1] - left_x[0], right_x[1] - right_x[0])
    if not (min(left_x[1] - left_x[0], right_x[1] - right_x[0]) > 0.0 and bottom > top):
        raise InputError(
            "the two cameras see nothing in common",
            "check that the calibration belongs to these photographs and is in their order",
        )
    largest = _LARGEST_SIDE * max(max(camera.width, camera.height) for camera in rig.cameras)
    focal = min(focal, largest / max(width, bottom - top))
    return RectifiedGeometry(
        width=max(round(width * focal), 1), height=max(round((bottom - top) * focal), 1), focal=focal,
        cx=-left_x[0] * focal, cy=-top * focal, doffs=(left_x[0] - right_x[0]) * focal,
        baseline=float(np.linalg.norm(rig.cam_from_rig[1, 4:])), unit="m",
    )  # fmt: skip


def _kept_share(plan: Rectification, side: int) -> float:
    camera, g = plan.rig.cameras[side], plan.geometry
    x, y = ((np.arange(_GRID_STEPS) + 0.5) / _GRID_STEPS * size for size in (camera.width, camera.height))
    flat = plan.points(side, np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
    return float(((flat >= 0.0) & (flat <= [g.width, g.height])).all(1).mean())


def check_sizes(rig: Rig, left: Pixels, right: Pixels) -> None:
    """Raise InputError where a photograph has not the size of its camera."""
    for name, camera, photograph in zip(("left", "right"), rig.cameras, (left, right), strict=True):
        if photograph.shape[1::-1] != (camera.width, camera.height):
            raise InputError(
                f"the {name} photograph has {photograph.shape[1]} x {photograph.shape[0]} pixels, its camera "
                f"{camera.width} x {camera.height}"
            )


def rectify(plan: Rectification, left: Pixels, right: Pixels) -> RectifiedPair:
    """The pictures of a pair, each pixel interpolated by cubics.

    Args:
        left, right: (H, W) or (H, W, 3) photographs of the plan's cameras.

    Raises:
        InputError: a photograph that has not the size of its camera.
    """
    check_sizes(plan.rig, left, right)
    g = plan.geometry
    if plan.is_identity:
        everywhere = np.ones(left.shape[:2], np.bool_)
        return RectifiedPair(left, right, everywhere, everywhere, g)
    pictures, shown = [], []
    for side, photograph in enumerate((left, right)):
        k = np.array([g.focal, g.focal, g.cx + side * g.doffs, g.cy])
        flat, is_shown = resample(
            plan.rig.cameras[side], k, (g.width, g.height), photograph, plan.rotation(side)
        )  # fmt: skip
        usable = is_shown == 255
        flat[~usable] = 0
        pictures.append(flat)
        shown.append(usable)
    return RectifiedPair(
        pictures[0], pictures[1], shown[0], shown[1], g, plan.left_from_camera, plan.right_from_camera
    )  # fmt: skip
