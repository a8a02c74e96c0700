"""Cameras that carve: a 3x4 matrix and a lens each, so that matrices which may not be decomposed are cameras too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.camera import lens
from sfmapp.camera.camera import Camera, pixels_to_rays
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.geometry.upright import up_direction

Array = NDArray[np.float64]

# a view as a row for kernels: twelve numbers of the 3x4 matrix, row by row, and the lens
ROW = 12 + lens.ROW
# smallest singular value of the left 3x3 part of a camera matrix against its largest, below which it has no centre
_FLAT = 1e-12


@dataclass(frozen=True)
class View:
    """One photograph's camera: pixel = lens(outer @ (X, 1)).

    A calibrated camera has its pose in ``outer`` and its intrinsics in ``lens_row``. A projection matrix that is known
    only as a whole stands in ``outer`` as it is, before a lens that changes nothing.

    Attributes:
        name: of the photograph.
        width, height: pixels.
        outer: (3, 4) from the world into the frame that the lens takes; its third row gives the depth, positive in
            front of the camera, in units of the world.
        lens_row: (17,) of :mod:`sfmapp.camera.lens`.
        camera, cam_from_world: what the two were made of, pose (7,); None for a matrix.
    """

    name: str
    width: int
    height: int
    outer: Array
    lens_row: Array
    camera: Camera | None = None
    cam_from_world: Array | None = None

    @cached_property
    def row(self) -> Array:
        """(29,) float64, what kernels take."""
        return np.concatenate([self.outer.ravel(), self.lens_row])

    @cached_property
    def center(self) -> Array:
        """(3,) place of the camera, world."""
        return np.asarray(-np.linalg.solve(self.outer[:, :3], self.outer[:, 3]))

    @cached_property
    def axis(self) -> Array:
        """(3,) unit direction of looking, world."""
        return np.asarray(self.outer[2, :3] / np.linalg.norm(self.outer[2, :3]))

    @property
    def is_mirrored(self) -> bool:
        """Its world is seen as in a mirror: it has a left-handed frame, as some matrices have."""
        return bool(np.linalg.det(self.outer[:, :3]) < 0.0)

    def rays(self, xy: Array) -> Array:
        """(N, 3) unit directions in the world of pixels (N, 2); NaN where the lens has none."""
        if self.camera is not None and self.cam_from_world is not None:
            return np.asarray(pixels_to_rays(self.camera, xy) @ rigid3.rotation_matrix(self.cam_from_world))
        rays = np.linalg.solve(self.outer[:, :3], np.column_stack([xy, np.ones(len(xy))]).T).T
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def angle_deg(place: Array, view: View, light: Array) -> float:
    """Between a camera and a light (3,) as seen from a place (3,), degrees."""
    a, b = view.center - place, light - place
    return float(np.degrees(np.arccos(np.clip(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)), -1.0, 1.0))))


def up_of_views(views: Sequence[View]) -> Array:
    """(3,) unit vector that was probably up when photographs were taken, see
    :func:`sfmapp.geometry.upright.up_direction`."""
    poses = []
    for view in views:
        middle, lower = np.array([[0.5, 0.5], [0.5, 0.75]]) * [view.width, view.height]
        ahead, below = view.rays(np.array([middle, lower]))
        down = below - (below @ ahead) * ahead
        down /= np.linalg.norm(down)
        # the horizontal axis counts as a line, so that it may be turned about in a mirrored world
        poses.append(np.concatenate([rigid3.quaternion(np.stack([np.cross(down, ahead), down, ahead])), np.zeros(3)]))
    return up_direction(np.array(poses))


def view_of_camera(name: str, camera: Camera, cam_from_world: ArrayLike) -> View:
    """The view of a calibrated camera with a pose (7,), x y z w and translation."""
    pose = np.asarray(cam_from_world, np.float64)
    return View(name, camera.width, camera.height, rigid3.to_matrix(pose), camera.canonical, camera, pose)


def views_of_matrices(names: Sequence[str], matrices: ArrayLike, sizes: Sequence[tuple[int, int]]) -> list[View]:
    """The views of projection matrices (V, 3, 4) of one object to pictures of some sizes (width, height).

    The sign of a matrix tells front from behind only in a world that is not mirrored, and worlds of matrices often are
    (a turntable's that turns the other way): what the middles of most pictures look at is taken to be in front.

    Raises:
        InputError: as :func:`view_of_matrix`.
    """
    given = np.asarray(matrices, np.float64)
    views = [view_of_matrix(name, p, *size) for name, p, size in zip(names, given, sizes, strict=True)]
    rays = np.array([np.linalg.solve(v.outer[:, :3], [0.5 * v.width, 0.5 * v.height, 1.0]) for v in views])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    centers = np.array([view.center for view in views])
    # the place that is nearest to all of these lines
    target = np.linalg.lstsq(across.sum(axis=0), np.einsum("vij,vj->i", across, centers), rcond=None)[0]
    behind = np.einsum("vc,vc->v", [view.axis for view in views], target - centers) < 0.0
    return [replace(v, outer=-v.outer) for v in views] if behind.sum() > 0.5 * len(views) else views


def view_of_matrix(name: str, matrix: ArrayLike, width: int, height: int) -> View:
    """The view of a projection matrix (3, 4) to pixels whose first has its centre at (0.5, 0.5), used as it is.

    Its scale and sign are free; they are set so that depths are distances along the axis, positive in front of the
    camera if the world is not mirrored (Hartley and Zisserman, "Multiple View Geometry", 2003, eq. 6.15).

    Raises:
        InputError: the matrix has another shape, is not finite, or has its centre at infinity.
    """
    p = np.array(matrix, np.float64)
    if p.shape != (3, 4) or not np.isfinite(p).all():
        raise InputError(f"{name}: expected a 3x4 projection matrix of finite numbers, found shape {p.shape}")
    sizes = np.linalg.svd(p[:, :3], compute_uv=False)
    if sizes[-1] <= _FLAT * sizes[0]:
        raise InputError(f"{name}: its projection matrix has no finite centre", "parallel projections cannot carve yet")
    p *= np.sign(np.linalg.det(p[:, :3])) / np.linalg.norm(p[2, :3])
    plain = np.zeros(lens.ROW)
    plain[:2] = 1.0
    return View(name, width, height, p, plain)


@numba.njit(cache=True, nogil=True)
def project_point(row: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Pixel (u, v) and depth of a world point in the view of a row (29,); NaN pixels where the lens does not look."""
    a = row[0] * x + row[1] * y + row[2] * z + row[3]
    b = row[4] * x + row[5] * y + row[6] * z + row[7]
    c = row[8] * x + row[9] * y + row[10] * z + row[11]
    u, v = lens.project(row[12:], a, b, c)
    return u, v, c


@numba.njit(cache=True, nogil=True)
def project_points(row: Array, xyz: Array, out: Array) -> None:
    """Pixels and depths (N, 3) of world points (N, 3), see :func:`project_point`, into ``out``."""
    optics = row[12:]  # a new view of it for each point costs as much as the point
    for i in range(xyz.shape[0]):
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        a = row[0] * x + row[1] * y + row[2] * z + row[3]
        b = row[4] * x + row[5] * y + row[6] * z + row[7]
        c = row[8] * x + row[9] * y + row[10] * z + row[11]
        out[i, 0], out[i, 1] = lens.project(optics, a, b, c)
        out[i, 2] = c
