"""Marked points in the adjustment: landmarks that a hand has clicked, with sigmas of their own, and eliminated.

A point that photographs show at pixels ``z_i`` and a survey puts at ``m`` adds the least squares

    1/2 sum |z_i - project(K_i, T_i, L)|^2 / sigma_i^2 + 1/2 (L - m)^T S^-1 (L - m)

over its place L, of which only what is left at the best L goes into the adjustment, as one gtsam factor over the poses
``X(i)`` and the intrinsics ``K(c)`` (variable projection; Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973). Its
residual is the whole vector at that place, and its derivative that by the poses without what a move of L makes up for,
so that the normal equations are the Schur complement of the plain graph's (Triggs et al. 1999, section 6.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import K, X
from numpy.typing import NDArray

from sfmapp.adjust.graph import FactorGraph
from sfmapp.camera.camera import Camera, project_jacobian
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

_MAX_STEPS, _SMALL_STEP = 30, 1e-12
# Huber's loss bends here, in standard deviations, where it costs nothing: wrong positions were left out before.
_HUBER_SIGMAS = 3.0


@dataclass(frozen=True)
class Marks:
    """Where photographs show one point.

    Attributes:
        image_idx: (M,) int64 positions of the photographs, each once.
        xy: (M, 2) pixels.
        sigma_px: (M,) standard deviations of each coordinate.
    """

    image_idx: NDArray[np.int64]
    xy: Array
    sigma_px: Array


@dataclass(frozen=True)
class Surveyed:
    """Where a point is by a survey: place (3,) and covariance (3, 3), in the frame of the model."""

    place: Array
    covariance: Array

    @property
    def root_information(self) -> Array:
        """(3, 3) W with W^T W the inverse of the covariance."""
        root: Array = np.linalg.inv(np.linalg.cholesky(self.covariance))
        return root


@dataclass(frozen=True)
class Linearized:
    """A point at the place that fits best, whitened: R rows, M photographs.

    Attributes:
        place: (3,).
        residual: (R,), of marks (two a photograph, projected minus marked), then of the survey.
        by_place: (R, 3) derivatives by the place; by_pose: (M, 2, 6) by poses, in gtsam's tangent of world_from_cam;
        by_params: M arrays (2, P) by the parameters of the cameras.
    """

    place: Array
    residual: Array
    by_place: Array
    by_pose: Array
    by_params: list[Array]

    @property
    def information(self) -> Array:
        """(3, 3) of the place, with the cameras held."""
        return self.by_place.T @ self.by_place


def fit_landmark(
    poses: Array, cameras: Sequence[Camera], marks: Marks, surveyed: Surveyed | None, start: Array
) -> Linearized | None:
    """The place that fits best, by Gauss-Newton from a start (3,); None where a photograph does not look there.

    Args:
        poses: (M, 7) cam_from_world of the photographs.
        cameras: M of them.
    """
    place, found = start, _at(poses, cameras, marks, surveyed, start)
    for _ in range(_MAX_STEPS):
        if found is None:
            return None
        try:
            step = -np.linalg.solve(found.information, found.by_place.T @ found.residual)
        except np.linalg.LinAlgError:
            return None
        cost, moved = found.residual @ found.residual, None
        for _ in range(12):  # halve what overshoots
            moved = _at(poses, cameras, marks, surveyed, place + step)
            if moved is not None and moved.residual @ moved.residual <= cost:
                break
            step, moved = step / 2, None
        if moved is None:
            break
        place, found = place + step, moved
        if np.abs(step).max() <= _SMALL_STEP * (1.0 + np.abs(place).max()):
            break
    return found


def _at(
    poses: Array, cameras: Sequence[Camera], marks: Marks, surveyed: Surveyed | None, place: Array
) -> Linearized | None:
    rotation = rigid3.rotation_matrix(poses)
    local = rotation @ place + poses[:, 4:]
    size = 2 * len(poses)
    rows = size + 3 * (surveyed is not None)
    residual, by_place = np.empty(rows), np.empty((rows, 3))
    by_pose, by_params = np.empty((len(poses), 2, 6)), []
    for n, camera in enumerate(cameras):
        pixel, by_local, by_param = project_jacobian(camera, local[n : n + 1])
        weight = 1.0 / marks.sigma_px[n]
        residual[2 * n : 2 * n + 2] = weight * (pixel[0] - marks.xy[n])
        by_local = weight * by_local[0]
        by_place[2 * n : 2 * n + 2] = by_local @ rotation[n]
        # a turn w and a shift v of world_from_cam on the right move the point by X x w - v in the camera
        by_pose[n] = by_local @ np.concatenate([rigid3.skew(local[n]), -np.eye(3)], 1)
        by_params.append(weight * by_param[0])
    if surveyed is not None:
        residual[size:] = surveyed.root_information @ (place - surveyed.place)
        by_place[size:] = surveyed.root_information
    return Linearized(place, residual, by_place, by_pose, by_params) if np.isfinite(residual).all() else None


@dataclass(frozen=True)
class Positions:
    """Measured places of cameras that are off together, as those of a receiver whose base was put down wrongly.

    Attributes:
        image_idx: (N,) int64; places: (N, 3) metres in the frame of the model.
        sigma_m: (3,) of one of them; common_sigma_m: (3,) of what all have in common.
    """

    image_idx: NDArray[np.int64]
    places: Array
    sigma_m: Array
    common_sigma_m: Array

    def add_to(self, graph: FactorGraph) -> None:
        """Add the positions to a graph, and what they have in common as a variable of its own."""
        common = gtsam.symbol("o", 0)
        graph.insert(common, np.zeros(3))
        graph.add(gtsam.PriorFactorPoint3(common, np.zeros(3), gtsam.noiseModel.Diagonal.Sigmas(self.common_sigma_m)))
        huber = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER_SIGMAS)
        noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Diagonal.Sigmas(self.sigma_m))
        for i, place in zip(self.image_idx.tolist(), self.places, strict=True):
            graph.add(gtsam.CustomFactor(noise, [X(i), common], _position_error(X(i), common, place)))


def _position_error(image: int, common: int, place: Array) -> Any:
    def error(_: Any, values: Any, jacobians: list[Array] | None) -> Array:
        pose = values.atPose3(image)
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(np.concatenate([np.zeros((3, 3)), pose.rotation().matrix()], 1))
            jacobians[1] = np.asfortranarray(-np.eye(3))
        residual: Array = pose.translation() - values.atPoint3(common) - place
        return residual

    return error


class LandmarkFactor:
    """A marked point as a factor over poses and free intrinsics.

    Args:
        reconstruction: whose cameras and numbers of images are meant; its poses are not looked at.
        free: for each camera, positions of the parameters that the adjustment may change.
        surveyed: None for a point that is only seen, which ties photographs together.
        start: (3,) near the place.
    """

    def __init__(
        self,
        reconstruction: Reconstruction,
        free: Sequence[NDArray[np.int64]],
        marks: Marks,
        surveyed: Surveyed | None,
        start: Array,
    ) -> None:
        self.marks, self.surveyed, self.start = marks, surveyed, np.array(start, np.float64)
        self.cameras: list[int] = []
        """Cameras with free parameters, in the order of the keys behind those of the images."""
        self._camera_idx = reconstruction.image_camera_idx[marks.image_idx].tolist()
        self._lenses, self._free = list(reconstruction.cameras), list(free)
        self._images = [X(int(i)) for i in marks.image_idx]
        self.cameras = [c for c in sorted(set(self._camera_idx)) if len(free[c])]

    def gtsam_factor(self) -> Any:
        """As gtsam has it."""
        rows = 2 * len(self._images) + 3 * (self.surveyed is not None)

        def error(_: Any, values: Any, jacobians: list[Array] | None) -> Array:
            found = self._at_values(values)
            if jacobians is not None:
                # without what a move of the place makes up for
                basis = np.linalg.qr(found.by_place)[0]
                for n, matrix in enumerate(self.derivatives(found)):
                    jacobians[n] = np.asfortranarray(matrix - basis @ (basis.T @ matrix))
            return found.residual

        keys = [*self._images, *(K(c) for c in self.cameras)]
        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(rows), keys, error)

    def at(self, reconstruction: Reconstruction) -> Linearized | None:
        """The point where a reconstruction sees it; None where a photograph does not look there."""
        poses = reconstruction.cam_from_world[self.marks.image_idx]
        lenses = [reconstruction.cameras[c] for c in self._camera_idx]
        return fit_landmark(poses, lenses, self.marks, self.surveyed, self.start)

    def covariance(self, found: Linearized, joint: Array) -> Array:
        """(3, 3) of the place, by the joint covariance of its poses and intrinsics after the adjustment.

        Args:
            joint: (N, N) over six rows for each photograph, in gtsam's tangent, and the free parameters of
                :attr:`cameras`.
        """
        inverse = np.linalg.inv(found.information)
        slope = inverse @ found.by_place.T @ np.concatenate(self.derivatives(found), 1)
        covariance: Array = inverse + slope @ joint @ slope.T
        return covariance

    def derivatives(self, found: Linearized) -> list[Array]:
        """(R, 6) by each photograph's pose and (R, Q) by each camera's free parameters, in the order of the keys."""
        rows = len(found.residual)
        out = []
        for n in range(len(self._images)):
            matrix = np.zeros((rows, 6))
            matrix[2 * n : 2 * n + 2] = found.by_pose[n]
            out.append(matrix)
        for c in self.cameras:
            matrix = np.zeros((rows, len(self._free[c])))
            for n in np.flatnonzero(np.array(self._camera_idx) == c).tolist():
                matrix[2 * n : 2 * n + 2] = found.by_params[n][:, self._free[c]]
            out.append(matrix)
        return out

    def _at_values(self, values: Any) -> Linearized:
        poses = []
        for key in self._images:
            matrix = values.atPose3(key).inverse().matrix()
            poses.append(rigid3.from_matrix(matrix[:3, :3], matrix[:3, 3]))
        lenses = dict(enumerate(self._lenses))
        for c in self.cameras:
            params = np.array(lenses[c].params)
            params[self._free[c]] = values.atVector(K(c))
            lenses[c] = lenses[c].with_params(params)
        mine = [lenses[c] for c in self._camera_idx]
        found = fit_landmark(np.array(poses), mine, self.marks, self.surveyed, self.start)
        if found is None:
            raise RuntimeError("a marked point lies where its photographs do not look")
        return found
