"""Marked pixels against each other: where a point lies in a model, and which mark is a slip of the hand.

The test is Baarda's data snooping ("A testing procedure for use in geodetic networks", 1968): of a point whose marks do
not fit one place, the mark goes whose absence makes the rest fit best, one after another while three are left. With
three marks of which any two fit as well as others, none can be named, and the point has no place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, chi2

from sfmapp.camera.camera import pixels_to_rays, project
from sfmapp.formats.control_points import ControlPoints
from sfmapp.geometry import rigid3
from sfmapp.georeference.control.landmarks import Linearized, Marks, fit_landmark
from sfmapp.georeference.control.report import MarkSlip
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

# Chance that any of the good marks of a file is taken for a slip.
_FALSE_ALARM = 1e-3
# Below this angle between all its rays, the depth of a point is no measurement: a hundredth of a radian.
_MIN_ANGLE = 0.01


@dataclass(frozen=True)
class MarkedPoints:
    """Control points (P) as a model sees them by their marks alone.

    Attributes:
        place: (P, 3) in the model's world, NaN where two photographs of it do not tell one.
        covariance: (P, 3, 3) with the cameras held, in units of the marks' sigmas times ``spread``.
        is_used: (O,) bool: marks in registered photographs that are no slips, of points that have a place.
        spread: how many of their sigmas the marks scatter, one at least.
        slips: marks that the others refute.
        unplaced: by position of the point, why it has no place.
    """

    place: Array
    covariance: Array
    is_used: NDArray[np.bool_]
    spread: float
    slips: list[MarkSlip]
    unplaced: dict[int, str]

    @property
    def is_placed(self) -> NDArray[np.bool_]:
        """(P,) bool."""
        return np.isfinite(self.place[:, 0])


def check_marks(reconstruction: Reconstruction, control: ControlPoints) -> MarkedPoints:
    """Triangulate control points from the marks in registered photographs that agree with each other.

    Args:
        reconstruction: in any frame; its images are those of the control points, in the same order.
    """
    num = control.num_points
    place, covariance = np.full((num, 3), np.nan), np.full((num, 3, 3), np.nan)
    is_used = reconstruction.is_registered[control.obs_image_idx]
    unplaced: dict[int, str] = {}
    whole: dict[int, Linearized] = {}
    for p in range(num):
        own = control.observations_of(p)
        own = own[is_used[own]]
        if len(own) < 2:
            unplaced[p] = f"{len(own)} of its marks are in photographs of the model, two are needed"
        elif (found := _triangulate(reconstruction, control, own)) is None:
            unplaced[p] = "its rays do not meet in front of the photographs"
        else:
            whole[p] = found
    spread = _spread(list(whole.values()))
    slips: list[MarkSlip] = []
    for p, found in whole.items():
        own = control.observations_of(p)
        kept, fitted, reason = _without_slips(reconstruction, control, own[is_used[own]], found, spread, len(is_used))
        is_used[np.setdiff1d(own, kept)] = False
        if fitted is None:
            unplaced[p] = reason
            continue
        if _widest_angle(reconstruction, control, kept, fitted.place) < _MIN_ANGLE:
            unplaced[p] = "all photographs of it stand in one line with it: its distance is open"
            continue
        place[p], covariance[p] = fitted.place, spread**2 * np.linalg.inv(fitted.information)
        registered = own[reconstruction.is_registered[control.obs_image_idx[own]]]
        slips += [_slip(reconstruction, control, p, int(o), fitted, len(kept)) for o in np.setdiff1d(registered, kept)]
    for p in unplaced:
        is_used[control.observations_of(p)] = False
    return MarkedPoints(place, covariance, is_used, spread, slips, unplaced)


def _triangulate(reconstruction: Reconstruction, control: ControlPoints, obs: NDArray[np.int64]) -> Linearized | None:
    """The place that fits marks (M,) best, begun where their rays come nearest to each other."""
    images = control.obs_image_idx[obs]
    poses = reconstruction.cam_from_world[images]
    cameras = [reconstruction.cameras[c] for c in reconstruction.image_camera_idx[images]]
    rays = np.concatenate([pixels_to_rays(c, control.obs_xy[o : o + 1]) for c, o in zip(cameras, obs, strict=True)])
    if not np.isfinite(rays).all():
        return None
    # sum |(I - d d^T) (x - c)|^2 over rays d from centres c
    directions = np.einsum("nji,nj->ni", rigid3.rotation_matrix(poses), rays)
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    start = np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, rigid3.center(poses)), rcond=None)[0]
    if not ((start - rigid3.center(poses)) * directions).sum(1).min() > 0:
        return None
    return fit_landmark(poses, cameras, Marks(images, control.obs_xy[obs], control.obs_sigma_px[obs]), None, start)


def _spread(found: Sequence[Linearized]) -> float:
    """Robust ratio of the marks' scatter to their sigmas: by the median of the points, so that slips do not count; 1
    unless that median is larger than chance makes it."""
    num = len(found)
    if num == 0:
        return 1.0
    degrees = np.array([len(one.residual) - 3 for one in found])
    squares = np.array([one.residual @ one.residual for one in found])
    middle = (num + 1) // 2
    # of independent uniform numbers the one in the middle has a beta distribution
    if np.sort(chi2.cdf(squares, degrees))[middle - 1] < beta.isf(_FALSE_ALARM, middle, num + 1 - middle):
        return 1.0
    return max(1.0, float(np.sqrt(np.median(squares / chi2.ppf(0.5, degrees)))))


def _limit(degrees: int, spread: float, num_marks: int) -> float:
    return spread**2 * float(chi2.isf(_FALSE_ALARM / num_marks, degrees))


def _without_slips(
    reconstruction: Reconstruction,
    control: ControlPoints,
    obs: NDArray[np.int64],
    found: Linearized,
    spread: float,
    num_marks: int,
) -> tuple[NDArray[np.int64], Linearized | None, str]:
    """Marks (K,) that agree, their place, or None and why they have none."""
    fitted = found
    while (misfit := fitted.residual @ fitted.residual) > _limit(len(fitted.residual) - 3, spread, num_marks):
        pixels = np.sqrt(misfit / len(fitted.residual))
        if len(obs) == 2:
            return obs, None, f"its two marks are {pixels:.1f} sigma apart across the rays: one of them is wrong"
        tried = [(n, _triangulate(reconstruction, control, np.delete(obs, n))) for n in range(len(obs))]
        ranked = sorted(
            ((one.residual @ one.residual, n, one) for n, one in tried if one is not None), key=lambda entry: entry[:2]
        )
        if not ranked:
            return obs, None, "no two of its rays meet"
        alike = [entry for entry in ranked if entry[0] <= ranked[0][0] + _limit(1, spread, num_marks)]
        if len(alike) > 1:
            names = [reconstruction.image_names[control.obs_image_idx[obs[n]]] for _, n, _ in alike]
            return (
                obs,
                None,
                f"its marks are {pixels:.1f} sigma off, and any of {', '.join(names)} may be the wrong one",
            )
        _, worst, fitted = ranked[0]
        obs = np.delete(obs, worst)
    return obs, fitted, ""


def _widest_angle(
    reconstruction: Reconstruction, control: ControlPoints, obs: NDArray[np.int64], place: Array
) -> float:
    ray = place - reconstruction.centers[control.obs_image_idx[obs]]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return float(np.arccos(np.clip((ray @ ray.T).min(), -1.0, 1.0)))


def _slip(
    reconstruction: Reconstruction, control: ControlPoints, point: int, obs: int, fitted: Linearized, num_agreeing: int
) -> MarkSlip:
    image = int(control.obs_image_idx[obs])
    camera = reconstruction.cameras[reconstruction.image_camera_idx[image]]
    wanted = project(camera, rigid3.apply(reconstruction.cam_from_world[image], fitted.place)[None])[0]
    marked = control.obs_xy[obs]
    return MarkSlip(
        point=control.names[point],
        image=reconstruction.image_names[image],
        line=int(control.obs_line[obs]),
        marked_px=(float(marked[0]), float(marked[1])),
        expected_px=(float(wanted[0]), float(wanted[1])),
        distance_px=float(np.linalg.norm(wanted - marked)),
        num_agreeing=num_agreeing,
    )
