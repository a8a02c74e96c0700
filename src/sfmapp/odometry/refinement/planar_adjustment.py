"""The closing adjustment of a map whose camera is on wheels: reprojections, and a ground plane held to evidence.

Each keyframe has a factor that its camera sees the plane's normal as the others do, and is as high above it. How well a
vehicle keeps to that is learned: the variances of nod, roll and height are estimated as components beside the images'
own noise (Foerstner, "Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten", AVN 1979), and are as much
larger as deviations hang together along the way.

Variables beside the poses ``X(i)``: ``G(0)`` (5), about the plane that the images alone show: two tangents of its
normal in the map, its distance, and two tangents of the normal in the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import G, X
from numpy.typing import NDArray

from sfmapp.adjust.gauge import moves_into_gauge, similarity_basis
from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustOptions, AdjustReport
from sfmapp.adjust.problem import Varying
from sfmapp.geometry import rigid3
from sfmapp.odometry.refinement.motion_plane import (
    MIN_KEYFRAMES,
    MIN_TURN_RAD,
    MotionPlane,
    fit_motion_plane,
    shared_factor,
    tangents,
    unheld,
)
from sfmapp.odometry.report import PlaneEvidence
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

# Rounds of learning the variances, and the relative change of a standard deviation that ends them.
_ROUNDS, _SETTLED = 6, 0.03
_MAX_STEPS, _TOLERANCE, _DAMPING = 30, 1e-6, 1e-6
# A vehicle that nods or rolls by more, or leaves its plane by more than this share of its way, is on no plane.
_MAX_TILT_RAD, _MAX_HEIGHT_SHARE = float(np.radians(3.0)), 0.05
# Fewest independent deviations that variances may be learned of: with as few the estimate is good to a third.
_MIN_INDEPENDENT = 6.0
# Little is known of the plane beforehand, but that cameras look about level.
_OPEN_RAD = 0.35
# The length that holds the unit of a map that has none, as a share of itself.
_UNIT = 1e-3
_NAMES = ("nod", "roll", "height")


@dataclass(frozen=True)
class PlanarMap:
    """A map that images and the plane hold together.

    Attributes:
        model: bent to both, in the frame and unit that it had.
        pose_covariance: (K, 6, 6) of its keyframes, in the gauge of centroid, mean rotation and spread (of a metric
            map without the spread).
        adjustment: of all together. evidence: numbers for the report.
    """

    model: Reconstruction
    pose_covariance: Array
    adjustment: AdjustReport
    evidence: PlaneEvidence


def hold_to_plane(
    model: Reconstruction, options: AdjustOptions, noise_px: float, num_sensors: int
) -> PlanarMap | PlaneEvidence:
    """Adjust a map together with the plane that its camera moves in.

    Args:
        model: adjusted by its images, image S k + s that of sensor s at the k-th keyframe. Not changed.
        options: of that adjustment. noise_px: standard deviation of a pixel coordinate, were all errors independent.
        num_sensors: S.

    Returns:
        The map, or why there is no such plane.
    """
    poses = model.cam_from_world[::num_sensors]
    plane = fit_motion_plane(poses) if len(poses) >= MIN_KEYFRAMES else None
    if plane is None:
        return PlaneEvidence(state="dropped", reason=f"{len(poses)} keyframes tell no plane of motion")
    if plane.turned_rad < MIN_TURN_RAD:
        # about so straight a way a normal of any roll fits: what sways aside would be taken for heights
        turned, least_turn = np.degrees([plane.turned_rad, MIN_TURN_RAD])
        return unheld(plane, f"turns of {turned:.0f} degrees tell no plane, {least_turn:.0f} are asked for")
    sigmas = np.sqrt((plane.deviations**2).mean(0))
    least = np.array([1e-5, 1e-5, 1e-6 * plane.size])
    graph, found, start = None, None, model
    for _ in range(_ROUNDS):
        graph = _Graph(start, plane, options, noise_px, num_sensors, np.maximum(sigmas, least))
        report = graph.optimize()
        found = graph.read()
        if found is None:
            return unheld(plane, "the observations do not determine the poses beside the plane")
        start = graph.model
        before, sigmas = sigmas, np.maximum(found.learned, least)
        if np.abs(np.log(sigmas / np.maximum(before, least))).max() < _SETTLED:
            break
    assert graph is not None
    assert found is not None
    reason = _broken(plane, found)
    evidence = _evidence(plane, found)
    if reason is not None:
        return replace(evidence, state="dropped", reason=reason)
    return PlanarMap(graph.model, found.poses, report, evidence)


@dataclass(frozen=True)
class _Found:
    """What a graph has come to.

    Attributes:
        residuals: (K, 3) nod, roll and height. learned: (3,) their standard deviations, as much larger as they hang
            together; shared: (3,) that factor of the variance. redundancy: (3,) deviations that tell them.
        poses: (K, 6, 6) covariances. mounting: (2, 2) of the normal in the camera, radians squared.
        up_in_cam: (3,).
    """

    residuals: Array
    learned: Array
    shared: Array
    redundancy: Array
    poses: Array
    mounting: Array
    up_in_cam: Array


class _Graph:
    """Reprojections and the plane, with standard deviations (3,) of nod, roll and height."""

    def __init__(
        self, model: Reconstruction, plane: MotionPlane, options: AdjustOptions, noise_px: float, num_sensors: int,
        sigmas: Array,
    ) -> None:  # fmt: skip
        self._num_sensors, self._sigmas = num_sensors, sigmas
        self._factor = PlaneFactor(plane)
        options = replace(
            options, max_iterations=_MAX_STEPS, relative_cost_tolerance=_TOLERANCE, initial_damping=_DAMPING
        )  # fmt: skip
        self._graph = FactorGraph(
            model.copy(), options, varying=_varying(model, num_sensors), noise_px=noise_px
        )  # fmt: skip
        self._num = len(model.image_names) // num_sensors
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        self._graph.insert(G(0), np.zeros(5))
        for k in range(self._num):
            factor = gtsam.CustomFactor(noise, [X(k * num_sensors), G(0)], self._factor.error)
            self._graph.add(factor, "ground plane")
        open_ = gtsam.noiseModel.Diagonal.Sigmas(np.array([_OPEN_RAD, _OPEN_RAD, 1e3 * plane.size, 10.0, 10.0]))
        self._graph.add(gtsam.PriorFactorVector(G(0), np.zeros(5), open_), "open")
        if num_sensors == 1:
            poses = model.cam_from_world
            away = np.linalg.norm(rigid3.center(poses) - rigid3.center(poses[0]), axis=1)
            far = int(np.argmax(away))
            length = gtsam.noiseModel.Isotropic.Sigma(1, _UNIT * away[far])
            self._graph.add(gtsam.RangeFactorPose3(X(0), X(far), away[far], length), "unit")

    @property
    def model(self) -> Reconstruction:
        """The map in its present state."""
        return self._graph.reconstruction

    def optimize(self) -> AdjustReport:
        """Adjust."""
        return self._graph.optimize()

    def read(self) -> _Found | None:
        """Residuals, what they say of their standard deviations, and covariances; None where anything is open."""
        num, step = self._num, self._num_sensors
        images = [step * k for k in range(1, num)]
        try:
            marginals = self._graph.marginal_covariance(images=images, variables=[G(0)])
        except np.linalg.LinAlgError:
            return None
        if not marginals.is_determined:
            return None
        joint = np.zeros((6 * num + 5, 6 * num + 5))  # the first keyframe does not move
        joint[6:, 6:] = marginals.matrix
        ground = self._graph.values.atVector(G(0))
        poses = self.model.cam_from_world[::step]
        residuals, explained = np.empty((num, 3)), np.zeros(3)
        for k in range(num):
            at = np.concatenate([6 * k + np.arange(6), 6 * num + np.arange(5)])
            residuals[k], slopes = self._factor.linearized(poses[k], ground)
            explained += np.diag(slopes @ joint[np.ix_(at, at)] @ slopes.T)
        redundancy = np.maximum(num - explained / self._sigmas**2, 1.0)
        shared = shared_factor(residuals)
        learned = np.sqrt(shared * (residuals**2).sum(0) / redundancy)
        covariance = _in_gauge(joint[:-5, :-5], poses, step > 1)
        _, up = self._factor.directions(ground)
        return _Found(residuals, learned, shared, redundancy, covariance, marginals.of_variable(G(0))[3:, 3:], up)


class PlaneFactor:
    """How a keyframe deviates from the plane: nod, roll and height, for gtsam.CustomFactor over X and G."""

    def __init__(self, plane: MotionPlane) -> None:
        self._plane, self._of_normal = plane, tangents(plane.normal)

    def directions(self, ground: Array) -> tuple[Array, Array]:
        """(3,) normals in the map and in the camera."""
        normal = self._plane.normal + ground[:2] @ self._of_normal
        up = self._plane.up_in_cam + ground[3:] @ self._plane.basis
        return normal / np.linalg.norm(normal), up / np.linalg.norm(up)

    def error(self, factor: Any, values: Any, slopes: Any) -> Array:
        """The residual (3,), and its slopes by X and G."""
        keys = factor.keys()
        pose, ground = values.atPose3(keys[0]), values.atVector(keys[1])
        residual, of_pose, of_ground = self._at(pose.rotation().matrix(), pose.translation(), ground)
        if slopes is not None:
            slopes[0], slopes[1] = of_pose, of_ground
        return residual

    def linearized(self, cam_from_map: Array, ground: Array) -> tuple[Array, Array]:
        """The residual (3,) and its slopes (3, 11) by our tangent of the pose and by G."""
        map_from_cam = rigid3.inverse(cam_from_map)
        residual, of_pose, of_ground = self._at(rigid3.rotation_matrix(map_from_cam), map_from_cam[4:], ground)
        return residual, np.concatenate([-of_pose, of_ground], 1)

    def _at(self, rotation: Array, center: Array, ground: Array) -> tuple[Array, Array, Array]:
        away = self._plane.normal + ground[:2] @ self._of_normal
        length = float(np.linalg.norm(away))
        normal = away / length
        of_normal = (np.eye(3) - np.outer(normal, normal)) @ self._of_normal.T / length
        seen, basis = rotation.T @ normal, self._plane.basis
        residual = np.append(basis @ seen - ground[3:], center @ normal - self._plane.distance - ground[2])
        of_pose, of_ground = np.zeros((3, 6)), np.zeros((3, 5))
        of_pose[:2, :3] = basis @ rigid3.skew(seen)
        of_pose[2, 3:] = seen
        of_ground[:2, :2] = basis @ rotation.T @ of_normal
        of_ground[2, :2] = center @ of_normal
        of_ground[2, 2] = -1.0
        of_ground[:2, 3:] = -np.eye(2)
        return residual, of_pose, of_ground


def _varying(model: Reconstruction, num_sensors: int) -> Varying:
    """The first keyframe holds the place."""
    images = np.ones(len(model.image_names), bool)
    images[:num_sensors] = False
    return Varying(images=images)


def _in_gauge(joint: Array, poses: Array, is_metric: bool) -> Array:
    """(K, 6, 6) covariances with the map held by all keyframes, out of (6 K, 6 K) with it held otherwise."""
    basis, constraint = (rows[: 6 if is_metric else 7] for rows in similarity_basis(poses))
    change = np.eye(len(joint)) - basis.T @ moves_into_gauge(basis, constraint)
    found = (change @ joint @ change.T).reshape(len(poses), 6, len(poses), 6)
    return np.asarray(found[np.arange(len(poses)), :, np.arange(len(poses))], np.float64)


def _broken(plane: MotionPlane, found: _Found) -> str | None:
    """Why a plane does not hold; None where it does."""
    limits = np.array([_MAX_TILT_RAD, _MAX_TILT_RAD, _MAX_HEIGHT_SHARE * plane.size])
    spread = np.sqrt((found.residuals**2).mean(0))
    worst = int(np.argmax(spread / limits))
    if spread[worst] > limits[worst]:
        k = int(np.argmax(np.abs(found.residuals[:, worst])))
        far = found.residuals[k, worst]
        size = f"{abs(far) / plane.size:.1%} of the way" if worst == 2 else f"{np.degrees(abs(far)):.1f} degrees"
        limit = f"{_MAX_HEIGHT_SHARE:.0%}" if worst == 2 else f"{np.degrees(_MAX_TILT_RAD):.0f}"
        return (
            f"the camera left the plane: {_NAMES[worst]} by up to {size}, at keyframe {k} (rms allowed: {limit}); "
            "a ramp, stairs or a hand"
        )
    # where a car leans in its curves roll alone says nothing, by its sigma; without heights there is no plane
    if len(found.residuals) < _MIN_INDEPENDENT * found.shared[2]:
        return (
            f"the ground bends: heights hang together over {found.shared[2]:.0f} of {len(found.residuals)} keyframes, "
            "so that a plane says nothing that the images do not"
        )
    return None


def _evidence(plane: MotionPlane, found: _Found) -> PlaneEvidence:
    up = found.up_in_cam
    sigma, learned = np.degrees(np.sqrt(np.diag(found.mounting))), np.degrees(found.learned[:2])
    pitch = float(np.degrees(np.arcsin(np.clip(up[2], -1.0, 1.0))))
    roll = float(np.degrees(np.arctan2(up[0], -up[1])))
    reason = (
        f"with standard deviations of {learned[0]:.2f} and {learned[1]:.2f} degrees of nod and roll and "
        f"{found.learned[2] / plane.size:.2%} of the way of height, learned of the map; the camera looks {pitch:.2f} "
        f"+- {sigma[0]:.2f} degrees above the plane and is rolled by {roll:.2f} +- {sigma[1]:.2f}"
    )
    return PlaneEvidence(
        state="held", reason=reason, turned_deg=float(np.degrees(plane.turned_rad)),
        deviation_deg=np.degrees(np.sqrt((found.residuals[:, :2] ** 2).mean(0))).tolist(),
        deviation_height=float(np.sqrt((found.residuals[:, 2] ** 2).mean())),
        sigma_deg=np.degrees(found.learned[:2]).tolist(), sigma_height=float(found.learned[2]),
        hang_together=found.shared.tolist(), up_in_cam=up.tolist(),
        camera_pitch_deg=pitch, camera_roll_deg=roll,
        camera_pitch_sigma_deg=float(sigma[0]), camera_roll_sigma_deg=float(sigma[1]),
    )  # fmt: skip
