"""From where a dense result is looked at in its report, and the pictures of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.scene import DenseScene, DenseView, Patches
from sfmapp.geometry import rigid3
from sfmapp.geometry.orientation import MIRRORED, upright_pinhole, upright_pixels, upright_poses, upright_size
from sfmapp.geometry.upright import up_direction
from sfmapp.report.preview import VirtualCamera, picture_of_mesh, picture_of_patches
from sfmapp.scene.mesh import Mesh

Array = NDArray[np.float64]

LONGER_SIDE_PX = 640
_QUALITY = 85
# of pixels of the reference image, so that discs of adjacent cells overlap
_DISC_RADIUS_PX = 0.9
# the turned view: to the side and up
_TURN_DEG, _RISE_DEG = 28.0, 22.0


@dataclass(frozen=True)
class Picture:
    """A JPEG file and what it shows."""

    caption: str
    jpeg: bytes


@dataclass(frozen=True)
class PictureRow:
    """Pictures from one place, and which that is."""

    title: str
    pictures: tuple[Picture, ...]


def dense_pictures(scene: DenseScene, patches: Patches, mesh: Mesh | None, *, cell_px: int = 1) -> list[PictureRow]:
    """Patches and mesh as two of the photographs and an eye beside them see them; nothing without patches.

    The first photograph is the one that most patches trust, the second looks another way.
    """
    if not len(patches):
        return []
    radius = (np.float32(_DISC_RADIUS_PX * cell_px) * patches.size).astype(np.float32)
    rows = []
    for v in _chosen_views(scene, patches):
        view = scene.views[v]
        photo = Picture("photograph", _jpeg(upright_pixels(_shrunk(view.rgb), view.orientation)))
        is_mirrored = view.orientation in MIRRORED
        shown = _pictures(patches, radius, mesh, _eye_of(view), is_mirrored=is_mirrored)
        rows.append(PictureRow(view.name, (photo, *shown)))
    eye = turned_eye(scene, patches, _chosen_views(scene, patches)[0])
    rows.append(PictureRow("from beside and above", tuple(_pictures(patches, radius, mesh, eye))))
    return rows


def _pictures(
    patches: Patches, radius: NDArray[np.float32], mesh: Mesh | None, eye: VirtualCamera, *, is_mirrored: bool = False
) -> list[Picture]:
    colored, clay = picture_of_patches(patches.xyz, patches.normal, patches.rgb, radius, eye)
    shown = [("patches", colored), ("patches in the light of a lamp", clay)]
    if mesh is not None:
        shown.append(("mesh in the light of a lamp", picture_of_mesh(mesh.xyz, mesh.faces, mesh.normal, eye)))
    return [Picture(caption, _jpeg(image[:, ::-1] if is_mirrored else image)) for caption, image in shown]


def _chosen_views(scene: DenseScene, patches: Patches) -> list[int]:
    """One or two views: that which most patches trust, and of those with half as many the one most turned from it."""
    counts = np.bincount(patches.view_idx, minlength=len(scene.views))
    first = int(counts.argmax())
    forward = rigid3.rotation_matrix(scene.cam_from_world)[:, 2]
    alignment = np.where(2 * counts >= counts[first], forward @ forward[first], np.inf)
    second = int(alignment.argmin())
    return [first] if second == first else [first, second]


def _eye_of(view: DenseView) -> VirtualCamera:
    """The view's own eye, its head upright."""
    scale = LONGER_SIDE_PX / max(view.width, view.height)
    k = upright_pinhole(view.orientation, view.k, view.width, view.height) * scale
    width, height = upright_size(view.orientation, round(view.width * scale), round(view.height * scale))
    return VirtualCamera(k, upright_poses(view.cam_from_world[None], [view.orientation])[0], width, height)


def turned_eye(scene: DenseScene, patches: Patches, v: int) -> VirtualCamera:
    """The eye of view v, turned around what it sees to the side and up, at a distance from which all of that shows."""
    eye = _eye_of(scene.views[v])
    body = _middle_points(patches.xyz)
    target = np.median(body, axis=0)
    up = up_direction(scene.upright_cam_from_world)
    back = scene.centers[v] - target
    # to the side on which the other cameras are: what is seen from there is known
    side = np.cross(up, back)
    sign = 1.0 if side @ (scene.centers.mean(axis=0) - scene.centers[v]) >= 0 else -1.0
    back = rigid3.exp_so3(np.radians(sign * _TURN_DEG) * up) @ (back / np.linalg.norm(back))
    back = _raised(back, up)
    right = np.cross(-back, up)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(-back, right), -back])
    center = target + _distance((body - target) @ axes.T, eye) * back
    pose = rigid3.from_matrix(axes, -axes @ center)
    return VirtualCamera(eye.k, np.asarray(pose), eye.width, eye.height)


def _raised(direction: Array, up: Array) -> Array:
    """A unit vector turned towards up, as far as that leaves it 65 degrees above the horizon."""
    height = float(np.degrees(np.arcsin(np.clip(direction @ up, -1.0, 1.0))))
    level = direction - (direction @ up) * up
    if np.linalg.norm(level) < 1e-6:
        level = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    level /= np.linalg.norm(level)
    angle = np.radians(min(height + _RISE_DEG, max(height, 65.0), 85.0))
    return np.asarray(np.cos(angle) * level + np.sin(angle) * up)


def _middle_points(xyz: Array) -> Array:
    """Some 20000 of the points in the box that holds 96 % of them along each axis."""
    sample = xyz[:: max(1, len(xyz) // 20_000)]
    low, high = np.percentile(sample, [2, 98], axis=0)
    kept = ((sample >= low) & (sample <= high)).all(axis=1)
    return np.asarray(sample[kept] if kept.any() else sample)


def _distance(offset: Array, eye: VirtualCamera) -> float:
    """How far from the origin along -z an eye has to stand to see points (N, 3) around it, given in its axes."""
    fx, fy, cx, cy = eye.k
    half = np.array([min(cx, eye.width - cx) / fx, min(cy, eye.height - cy) / fy])
    return float((np.abs(offset[:, :2]) / half - offset[:, 2:]).max())


def _shrunk(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    import cv2

    scale = LONGER_SIDE_PX / max(rgb.shape[:2])
    if scale >= 1.0:
        return rgb
    size = (round(rgb.shape[1] * scale), round(rgb.shape[0] * scale))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


def _jpeg(rgb: NDArray[np.uint8]) -> bytes:
    import cv2

    return bytes(cv2.imencode(".jpg", np.ascontiguousarray(rgb[:, :, ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1])
