"""What a calibration comes to, whichever way it was got: a camera, the sigma of each parameter, and what is left.

Nothing here knows of boards or lines: `calibrate board`, `target`, `lines` and `rig` all end in this type.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.camera.models import PARAM_NAMES

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ViewFit:
    """One photograph and what the calibration leaves of it.

    Attributes:
        name: of the photograph.
        cam_from_target: (7,) pose of the board or target in front of the camera, in its own unit; None where the
            method has no target.
        xy: (N, 2) measured pixels.
        residuals: (N, 2) measured minus projected, pixels.
        is_used: (N,) bool, False for a point that was left aside.
        problem: why the view is odd, or was left aside altogether; None for nothing.
    """

    name: str
    cam_from_target: Array | None
    xy: Array
    residuals: Array
    is_used: NDArray[np.bool_]
    problem: str | None = None

    @property
    def rms_px(self) -> float:
        """Root mean square length of the residuals that count, pixels; NaN without any."""
        used = self.residuals[self.is_used]
        return float(np.sqrt((used**2).sum(1).mean())) if len(used) else float("nan")


@dataclass(frozen=True)
class CameraCalibration:
    """A camera of P parameters and how sure they are.

    Attributes:
        camera: with its image size; pixel centres at halves.
        covariance: (P, P) of the parameters, in the order of ``param_names``; rows of parameters that were held are 0.
        method: how it was got, a line for a person.
        noise_px: standard deviation of one measured coordinate, from the residuals and their degrees of freedom.
        degrees_of_freedom: measured numbers less unknowns.
        views: photographs and their residuals.
        frame_covariance: (P + 6, P + 6) of the parameters and of the frame of the camera itself, a turn (radians, about
            its axes) and a shift (in the unit of the targets): what moves all targets together is no error of them, but
            of the camera. None where the method has no targets, and the frame is that which turns with the camera.
        distances: (nearest, median, farthest) distance of the points that it was made from, in the unit of the targets.
        warnings: what a user has to know, a line each.
    """

    camera: Camera
    covariance: Array
    method: str
    noise_px: float
    degrees_of_freedom: int
    views: tuple[ViewFit, ...] = ()
    frame_covariance: Array | None = None
    distances: tuple[float, float, float] | None = None
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        num = len(self.param_names)
        if self.covariance.shape != (num, num):
            raise ValueError(f"expected a covariance of {num} parameters, found {self.covariance.shape}")
        if self.frame_covariance is not None and self.frame_covariance.shape != (num + 6, num + 6):
            raise ValueError(f"expected a frame_covariance of {num} + 6, found {self.frame_covariance.shape}")

    @property
    def param_names(self) -> tuple[str, ...]:
        return PARAM_NAMES[self.camera.model]

    @property
    def sigmas(self) -> Array:
        """(P,) standard deviations; 0 for a parameter that was held."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def correlations(self) -> Array:
        """(P, P), 1 on the diagonal; 0 beside it where a parameter was held."""
        sigmas = self.sigmas
        scale = np.divide(1.0, sigmas, out=np.zeros_like(sigmas), where=sigmas > 0)
        found: Array = self.covariance * scale[:, None] * scale[None, :]
        np.fill_diagonal(found, 1.0)
        return found

    @property
    def rms_px(self) -> float:
        """Root mean square length of all residuals that count, pixels; NaN without any."""
        used = [view.residuals[view.is_used] for view in self.views]
        flat = np.concatenate(used) if used else np.zeros((0, 2))
        return float(np.sqrt((flat**2).sum(1).mean())) if len(flat) else float("nan")
