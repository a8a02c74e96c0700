"""The faces of a cube round a camera: six pinholes that together see all that it sees, however wide its lens.

Each looks along an axis of the camera and sees 90 degrees and a pixel or two more, so that what lies on an edge of the
cube is inside of both pictures. ``up`` and ``down`` adjoin ``front`` with their lower and upper side.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera import lens
from sfmapp.camera.camera import Camera, pixels_to_rays, project_jacobian
from sfmapp.camera.models import PARAM_NAMES
from sfmapp.camera.names import CameraModel

Array = NDArray[np.float64]

# rotations from the axes of the camera (x right, y down, z forward) to those of a face; their rows are the face's axes
FACE_FROM_CAM: dict[str, Array] = {
    "front": np.eye(3),
    "right": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "back": np.array([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]),
    "left": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "up": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "down": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}
# share of the pixels for an angle that a lens has on its axis: what it shows with fewer would be a smear
LEAST_RESOLUTION = 0.25
# places along each side of a photograph where it is asked which faces its rays meet
_STEPS = 65


def face_camera(camera: Camera) -> Camera:
    """The PINHOLE of the faces: in their middle as many pixels for an angle as the camera has on its axis."""
    _, by_ray, _ = project_jacobian(camera, [[0.0, 0.0, 1.0]])
    focal = float(by_ray[0, 0, 0] + by_ray[0, 1, 1]) / 2.0
    side = 2 * math.floor(focal) + 2  # more than twice the focal length: beyond 90 degrees
    return Camera(CameraModel.PINHOLE, side, side, np.array([focal, focal, side / 2, side / 2]), focal_source="file")


def faces_in_view(camera: Camera) -> list[str]:
    """Names of the faces that the photograph shows some of."""
    x, y = (np.linspace(0.0, side, _STEPS) for side in (camera.width, camera.height))
    rays = pixels_to_rays(camera, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    names = list(FACE_FROM_CAM)
    met = nearest_face(rays[rays[:, 2] >= math.cos(reach_angle(camera))], names)
    return [name for k, name in enumerate(names) if (met == k).any()]


def nearest_face(rays: Array, names: list[str]) -> NDArray[np.int64]:
    """(N,) position in ``names`` of the face whose axis a ray (N, 3) is nearest to."""
    axes = np.array([FACE_FROM_CAM[name][2] for name in names])
    nearest: NDArray[np.int64] = (rays @ axes.T).argmax(axis=1)
    return nearest


def reach_angle(camera: Camera) -> float:
    """Angle from the axis, in radians, up to which the lens is one to one and has pixels enough for what it shows."""
    angle, row = np.linspace(0.0, math.pi, 4000), radial_part(camera)
    growth = np.diff([lens.project(row, math.sin(a), 0.0, math.cos(a))[0] for a in angle])
    ends = np.flatnonzero(~(growth > LEAST_RESOLUTION * growth[0]))
    return float(angle[ends[0]]) if len(ends) else math.pi


def reach_radius(camera: Camera) -> float:
    """Radius in the normalised plane up to which the lens is one to one: beyond, its polynomial folds back."""
    radius, row = np.tan(np.linspace(0.0, 1.53, 4000)), radial_part(camera)
    image = np.array([lens.distort(row, r, 0.0)[0] for r in radius])
    folds = np.flatnonzero(~(np.diff(image) > 0.0))
    return float(radius[folds[0]]) if len(folds) else math.inf


def radial_part(camera: Camera) -> Array:
    """The row (17,) of a lens in units of its focal length, without tangential terms, skew and prism: these are no
    reason for it to fold back."""
    is_radial = [name[0] not in "ps" for name in PARAM_NAMES[camera.model]]
    row = camera.with_params(np.where(is_radial, camera.params, 0.0)).canonical
    row[:4] = 1.0, 1.0, 0.0, 0.0
    return row
