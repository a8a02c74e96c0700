"""What four corners in a photograph tell of a plane: the shape of the rectangle, and how it lies before the camera."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.locate import Location, locate_camera
from sfmapp.camera.camera import Camera, pixels_to_normalized
from sfmapp.camera.models import PARAM_NAMES, kind_of
from sfmapp.errors import NoReconstructionError
from sfmapp.geometry import rigid3
from sfmapp.geometry.rectangle import UNIT_SQUARE, RectangleShape, shape_of_rectangle
from sfmapp.planes.report import PlanePose

Array = NDArray[np.float64]

# of the longer side: how far a principal point lies from the middle where nothing is known of it. Those of Strecha's
# cameras are 0.7 per cent off, phones with stabilised lenses one
_CENTER_SHARE = 0.01


@dataclass(frozen=True)
class KnownCamera:
    """The camera of a photograph.

    Attributes:
        camera: its distortion is taken as exact.
        covariance: (P, P) of its parameters; None: the focal length has the sigma that the camera states.
        text: where it is from.
    """

    camera: Camera
    covariance: Array | None
    text: str

    @property
    def is_guess(self) -> bool:
        """Nothing is known of the focal length."""
        return self.camera.focal_source == "default"

    def sigmas(self, kind: str) -> Array:
        """Standard deviations of the focal lengths (``focal``) or of the principal point (``center``)."""
        is_one = np.array([kind_of(name) == kind for name in PARAM_NAMES[self.camera.model]])
        if self.covariance is not None:
            told: Array = np.sqrt(np.diag(self.covariance)[is_one])
            return told
        if kind == "focal":
            return np.full(int(is_one.sum()), self.camera.focal_sigma or 0.0)
        size = max(self.camera.width, self.camera.height)
        return np.full(2, 0.0 if self.camera.is_fixed else _CENTER_SHARE * size)

    def covariance_or_prior(self) -> Array:
        """(P, P) of its parameters, as given, or of what is known before."""
        if self.covariance is not None:
            return self.covariance
        names = PARAM_NAMES[self.camera.model]
        sigmas = np.zeros(len(names))
        for kind in ("focal", "center"):
            sigmas[[kind_of(name) == kind for name in names]] = self.sigmas(kind)
        return np.diag(sigmas**2)


def shape_in(known: KnownCamera, corners: Array, sigma_px: float) -> RectangleShape:
    """The rectangle that corners (4, 2), pixels, are of."""
    focal = known.camera.focal
    flat = pixels_to_normalized(known.camera, corners) * focal
    return shape_of_rectangle(
        flat, focal, sigma_px=sigma_px, focal_share=float(known.sigmas("focal").mean()) / focal,
        center_sigma_px=float(known.sigmas("center").mean()),
    )  # fmt: skip


def poses_in(
    known: KnownCamera, corners: Array, size: tuple[float, float], sigma_px: float
) -> tuple[list[PlanePose], float | None]:
    """Poses of a rectangle (width, height) that its corners allow, the likeliest first, and the sigma of its distance.

    None where the focal length is a guess, or the corners leave the pose open.
    """
    if known.is_guess:
        return [], None
    places = np.concatenate([UNIT_SQUARE * size, np.zeros((4, 1))], 1)
    try:
        found = locate_camera(
            places, corners, known.camera, method="all", sigma_px=sigma_px,
            max_error_px=max(12.0, 4.0 * sigma_px), camera_covariance=known.covariance_or_prior(),
        )  # fmt: skip
    except NoReconstructionError:
        return [], None
    middle = np.array([0.5 * size[0], 0.5 * size[1], 0.0])
    first = _pose(found.view.cam_from_world, middle, math.sqrt(found.view.squares / 4.0))
    others = [_pose(other.cam_from_world, middle, other.rms_px) for other in found.others]
    return [first, *others], _distance_sigma(found, middle)


def _pose(cam_from_plane: Array, middle: Array, rms_px: float) -> PlanePose:
    at = rigid3.apply(cam_from_plane, middle)
    normal = rigid3.rotation_matrix(cam_from_plane)[:, 2]
    distance = float(np.linalg.norm(at))
    cosine = abs(float(normal @ at)) / distance
    return PlanePose(
        distance=distance, tilt_deg=math.degrees(math.acos(min(cosine, 1.0))), normal=normal.tolist(),
        cam_from_plane=cam_from_plane.tolist(), rms_px=rms_px,
    )  # fmt: skip


def _distance_sigma(found: Location, middle: Array) -> float:
    """A turn about the camera leaves the distance; a shift changes it along the line of sight."""
    at = rigid3.apply(found.view.cam_from_world, middle)
    along = at / np.linalg.norm(at)
    return math.sqrt(max(float(along @ found.covariance[-3:, -3:] @ along), 0.0))
