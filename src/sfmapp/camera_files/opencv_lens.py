"""Lenses of OpenCV's many coefficients as cameras of ours, which have four."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera, pixels_to_normalized
from sfmapp.camera.models import PARAM_NAMES, kind_of
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError
from sfmapp.formats.colmap_model import checked_camera

Array = NDArray[np.float64]
Size = tuple[int, int]

SIGMA_CALIBRATED = 0.01
"""Trust in a calibration that somebody else made, relative to the focal length: as for camera_params of photographs."""
# A fit that is this good is taken for the lens: a tenth of what a corner is located to.
_GOOD_FIT_PX = 0.05


@dataclass(frozen=True)
class FullLens:
    """A lens as ``cv2.projectPoints`` has it, pixel centres at whole numbers.

    Attributes:
        size: width and height of the images that it was calibrated with.
        intrinsics: (4,) fx, fy, cx, cy.
        coefficients: (5, 8, 12 or 14) k1, k2, p1, p2, k3, ...
    """

    size: Size
    intrinsics: Array
    coefficients: Array

    @property
    def k_matrix(self) -> Array:
        """(3, 3)."""
        fx, fy, cx, cy = self.intrinsics
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def project(self, rays: Array) -> Array:
        """Pixels (N, 2), centres at whole numbers, of normalised image points (N, 2)."""
        import cv2

        points = np.concatenate([rays, np.ones((len(rays), 1))], 1)
        zero = np.zeros(3)
        pixels: Array = cv2.projectPoints(points, zero, zero, self.k_matrix, self.coefficients)[0].reshape(-1, 2)
        return pixels

    def rays(self, pixels: Array) -> Array:
        """Normalised image points (N, 2) of pixels (N, 2), centres at whole numbers; wrong without an inverse."""
        import cv2

        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
        pixels = np.ascontiguousarray(pixels[:, None])
        found: Array = cv2.undistortPoints(pixels, self.k_matrix, self.coefficients, criteria=criteria).reshape(-1, 2)
        return found


@dataclass(frozen=True)
class CalibratedCamera:
    """A camera of ours.

    Attributes:
        camera: the nearest of our models.
        lens: what it stands for, where the difference matters: frames are then resampled with :func:`sampling_map`.
        notes: what was changed on the way, one line each.
        stated: what the file says, of a lens with more coefficients than the camera has, whether that matters or not.
    """

    camera: Camera
    lens: FullLens | None = None
    notes: tuple[str, ...] = ()
    stated: FullLens | None = None


def camera_from_opencv(
    place: str, size: Size, intrinsics: Sequence[float] | Array, coefficients: Sequence[float] | Array, fisheye: bool
) -> CalibratedCamera:
    """A camera of numbers in OpenCV's terms. Half a pixel is added to the principal point.

    Args:
        place: begins the messages.
        intrinsics: fx, fy, cx, cy; pixel centres at whole numbers.
        coefficients: k1, k2, p1, p2, k3, ... as ``cv2.projectPoints`` has them, or k1..k4 of a fisheye lens.

    Raises:
        InputError: numbers that no lens has, or a lens with no inverse in the picture.
    """
    fx, fy, cx, cy = (float(value) for value in intrinsics)
    known = [float(value) for value in coefficients]
    while known and known[-1] == 0.0:
        known.pop()
    if not all(map(math.isfinite, (fx, fy, cx, cy, *known))) or min(fx, fy) <= 0:
        raise InputError(f"{place}: expected finite numbers and positive focal lengths, found {fx, fy, cx, cy, *known}")
    if fisheye and len(known) > 4:
        raise InputError(f"{place}: expected 4 coefficients of a fisheye lens, found {len(known)}")
    lens: FullLens | None = None
    stated: FullLens | None = None
    notes: tuple[str, ...] = ()
    params = [fx, fy, cx, cy, *known, *[0.0] * (4 - len(known))]
    if len(known) > 4:
        params, stated, is_near, notes = _fitted(place, size, np.array([fx, fy, cx, cy]), known)
        lens = None if is_near else stated
    model = "OPENCV_FISHEYE" if fisheye else "OPENCV" if known else "PINHOLE"
    params[2:4] = [params[2] + 0.5, params[3] + 0.5]
    camera = checked_camera(Path(place), 0, model, *size, params[: 4 if model == "PINHOLE" else 8])
    return CalibratedCamera(replace(camera, focal_sigma=SIGMA_CALIBRATED * camera.focal), lens, notes, stated)


def exact_camera(lens: FullLens) -> Camera | None:
    """The camera that is such a lens, with all of its coefficients; None for a tilted sensor, which is none of ours."""
    coefficients = np.concatenate([lens.coefficients, np.zeros(14 - len(lens.coefficients))])
    if coefficients[12:].any():
        return None
    model = CameraModel.OPENCV_THIN_PRISM if coefficients[8:].any() else CameraModel.FULL_OPENCV
    fx, fy, cx, cy = lens.intrinsics
    params = np.array([fx, fy, cx + 0.5, cy + 0.5, *coefficients])[: len(PARAM_NAMES[model])]
    camera = Camera(model, *lens.size, params, focal_source="file")
    return replace(camera, focal_sigma=SIGMA_CALIBRATED * camera.focal)


def camera_from_colmap(
    place: str, model: str, size: Size, params: Sequence[float] | Array, covariance: Array | None = None
) -> CalibratedCamera:
    """A camera as COLMAP states it: parameters in its order, pixel centres at halves.

    Args:
        covariance: (P, P) of the parameters, which is the prior then; None: the focal length is good to a hundredth.

    Raises:
        InputError: no known model, or not its parameters.
    """
    camera = checked_camera(Path(place), 0, model, *size, params)
    if covariance is not None:
        if covariance.shape != (len(camera.params),) * 2 or np.linalg.eigvalsh(covariance)[0] < -1e-9 * np.trace(
            covariance
        ):
            raise InputError(
                f"{place}: covariance: expected one of {len(camera.params)} parameters, found {covariance.shape[0]} x "
                f"{covariance.shape[1]} numbers, or one that is none",
                "take it out of the file, or calibrate again",
            )
        camera = replace(camera, prior_covariance=covariance)
        if camera.focal_variance > 0.0:
            sigma = float(np.sqrt(camera.focal_variance))
            note = f"{place}: held as its covariance says, the focal length to {sigma:.2g} px"
            return CalibratedCamera(replace(camera, focal_sigma=sigma), notes=(note,))
    return CalibratedCamera(replace(camera, focal_sigma=SIGMA_CALIBRATED * camera.focal))


def _fitted(
    place: str, size: Size, intrinsics: Array, known: list[float]
) -> tuple[list[float], FullLens, bool, tuple[str, ...]]:
    """OPENCV parameters near a lens of more coefficients; the lens itself; whether they are near enough; and a note."""
    # OpenCV takes 4, 5, 8, 12 or 14
    wanted = next((count for count in (5, 8, 12, 14) if count >= len(known)), 0)
    if not wanted:
        raise InputError(f"{place}: expected at most 14 coefficients of a lens, found {len(known)}")
    lens = FullLens(size, intrinsics, np.array(known + [0.0] * (wanted - len(known))))
    params, rms, largest = _nearest_opencv(place, lens)
    note = f"{place}: the nearest lens with k1, k2, p1, p2 is off by {rms:.2f} px rms and {largest:.2f} px at most"
    if rms < _GOOD_FIT_PX:
        return params, lens, True, (f"{note}: it is used",)
    return params, lens, False, (f"{note}: frames are resampled by that much to be its own",)


def _nearest_opencv(place: str, lens: FullLens) -> tuple[list[float], float, float]:
    """OPENCV parameters (pixel centres at whole numbers) that come nearest in the picture; rms and largest error in
    pixels. Gauss-Newton over a grid of pixels; the start, the lens cut off behind p2, is near in practice."""
    width, height = lens.size
    pixels = np.stack(np.meshgrid(np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 25)), -1).reshape(-1, 2)
    rays = lens.rays(pixels)
    with np.errstate(all="ignore"):
        good = np.abs(lens.project(rays) - pixels).max(1) < 1e-3
    if good.sum() < 0.9 * len(good):
        raise InputError(
            f"{place}: the distortion cannot be inverted within {width}x{height} pixels: {lens.coefficients}"
        )
    x, y, pixels = rays[good, 0], rays[good, 1], pixels[good]
    r2 = x * x + y * y
    zero, one = np.zeros_like(x), np.ones_like(x)
    params = np.concatenate([lens.intrinsics, lens.coefficients[:4]])
    for _ in range(20):
        fx, fy, cx, cy, k1, k2, p1, p2 = params
        radial = 1 + r2 * (k1 + r2 * k2)
        u, v = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
        residual = np.concatenate([fx * u + cx - pixels[:, 0], fy * v + cy - pixels[:, 1]])
        du = [u, zero, one, zero, fx * x * r2, fx * x * r2 * r2, fx * 2 * x * y, fx * (r2 + 2 * x * x)]
        dv = [zero, v, zero, one, fy * y * r2, fy * y * r2 * r2, fy * (r2 + 2 * y * y), fy * 2 * x * y]
        step = np.linalg.lstsq(np.concatenate([np.stack(du, 1), np.stack(dv, 1)]), residual, rcond=None)[0]
        params = params - step
        if np.abs(step).max() < 1e-10:
            break
    error = np.hypot(*residual.reshape(2, -1))
    return params.tolist(), float(np.sqrt(np.mean(error**2))), float(error.max())


def sampling_map(camera: Camera, lens: FullLens | None) -> NDArray[np.float32] | None:
    """(H, W, 2) float32: where ``cv2.remap`` finds each pixel of a frame of ``camera`` in one of ``lens``.

    Points beyond the edge of where the camera's polynomial has an inverse lie outside of the picture. None without a
    lens. The images may be smaller or larger than the lens was calibrated with.
    """
    if lens is None:
        return None
    grid = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), -1).reshape(-1, 2)
    rays = pixels_to_normalized(camera, grid)
    is_known = np.isfinite(rays[:, 0])
    scale = camera.width / lens.size[0]
    found = (lens.project(np.where(is_known[:, None], rays, 0.0)) + 0.5) * scale - 0.5
    found[~is_known] = -1e4
    return found.reshape(camera.height, camera.width, 2).astype(np.float32)


def is_length(model: CameraModel) -> NDArray[np.bool_]:
    """(P,) which parameters of a model are pixels, and grow with the picture."""
    return np.array([kind_of(name) != "distortion" or name == "s" for name in PARAM_NAMES[model]], np.bool_)


def scaled_to(place: str, calibrated: CalibratedCamera, size: Size) -> CalibratedCamera:
    """The camera for images of another size but the same shape, with a note if that was needed.

    Raises:
        InputError: the shapes differ: the images were cut, or the calibration is of another camera.
    """
    camera = calibrated.camera
    if (camera.width, camera.height) == size:
        return calibrated
    scale = size[0] / camera.width
    if abs(camera.height * scale - size[1]) > 1.0:
        raise InputError(
            f"{place}: expected a calibration for images of {size[0]}x{size[1]} pixels, found one for "
            f"{camera.width}x{camera.height}",
            "calibrate the camera at the size of the images, or give --camera",
        )
    sigma = camera.focal_sigma and camera.focal_sigma * scale
    params = np.where(is_length(camera.model), camera.params * scale, camera.params)
    note = f"{place}: calibrated at {camera.width}x{camera.height}, scaled to the images' {size[0]}x{size[1]}"
    scaled = replace(camera, width=size[0], height=size[1], params=params, focal_sigma=sigma)
    if camera.prior_covariance is not None:
        by = np.where(is_length(camera.model), scale, 1.0)
        scaled = replace(scaled, prior_covariance=camera.prior_covariance * np.outer(by, by))
    return replace(calibrated, camera=scaled, notes=(*calibrated.notes, note))
