"""The closing adjustment of a map beside which an inertial sensor has measured: one factor graph of both.

Reprojections, their landmarks eliminated by our kernels, hold the poses of the keyframes to each other; between
neighbours in time stands gtsam's factor over what was integrated between them (Forster, Carlone, Dellaert and
Scaramuzza, "On-manifold preintegration for real-time visual-inertial odometry", T-RO 2017). The map keeps its own
frame and its own unit of length: how it lies in the world, its scale, its vertical and the offset between the clocks,
is one more variable that all inertial factors share, as in Mur-Artal and Tardos, "Visual-inertial monocular SLAM with
map reuse", RA-L 2017, and Qin and Shen, "Online temporal calibration for monocular visual-inertial systems", IROS 2018.
So is where the sensor sits on the camera, about where it is said to: Kelly and Sukhatme, "Visual-inertial sensor
fusion: localization, mapping and sensor-to-sensor self-calibration", IJRR 2011.

Variables beside the poses ``X(i)``: ``V(i)`` (3) m/s of the sensor in the z-up world; ``B(i)``
gtsam.imuBias.ConstantBias; ``A(0)`` (4) the logarithm of the metres in a map unit, two angles of tilt, and the seconds
after its time at which an image was taken; ``M(0)`` (6) how the sensor sits other than given: a turn about its own axes
in radians, and a way along the camera's axes in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, B, M, V, X
from numpy.typing import NDArray

from sfmapp.adjust.gauge import moves_into_gauge, similarity_basis
from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustReport
from sfmapp.adjust.problem import Varying
from sfmapp.geometry import rigid3
from sfmapp.images.sequence import Imu
from sfmapp.odometry.inertial.integration import (
    ACCEL_BIAS_SIGMA,
    GRAVITY,
    GYRO_BIAS_SIGMA,
    Interval,
    LinearStart,
    upright,
)
from sfmapp.odometry.inertial.seen_map import SeenMap
from sfmapp.odometry.options import MAX_COVARIANCE_KEYFRAMES
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# What the gyroscope leaves of the offset between the clocks is a millisecond where the rotations tell it; where they do
# not, cameras and sensors that are meant to be synchronous are within half a hundred.
_CLOCK_SIGMA_S = 0.05
# Mountings come from a calibration or a drawing, good to some millimetres and a third of a degree. Where measurements
# pull harder than that allows, it was a guess: the chip anywhere in a housing of a few centimetres, on a board that is
# screwed in to a degree. The pull is chi-squared with six degrees of freedom; a twentieth of good mountings, which lose
# little by it, count as guesses.
_CALIBRATED = (0.005, 0.005)  # radians, metres
_GUESSED = (0.02, 0.03)
_MAX_PULL = 12.6
# Nothing to speak of is known of the scale (its logarithm) and the tilt beforehand; this only keeps them from running
# away.
_OPEN = 10.0
# The metre of a rig is that of its baseline, and no better than that.
_MIN_METRIC_SIGMA = 1e-4
# Steps, and the gain that ends them, in square standard deviations; the images alone begin at their minimum.
# The damping has to let a map grow as a whole, far from what holds each pose among its neighbours; with 1e-8 points of
# uncertain depth leap behind cameras (2 of 40 synthetic flights).
_MAX_STEPS, _ENOUGH, _ALONE, _DAMPING = 30, 0.02, 1e-5, 1e-6
# Rounds of finding the noise of the sensor, and a residual beyond all bounds.
_ROUNDS, _MOST = 5, 1e9
# Zero densities would make the factors singular; no sensor is as good as these (gyro, accel, and their walks).
_LEAST_NOISE = (1e-7, 1e-6, 1e-8, 1e-7)


class Solved(NamedTuple):
    """What the graph has come to.

    Attributes:
        model: the map, in its own frame and unit, bent to both.
        report: of the adjustment.
        alignment: (4,) see :mod:`sfmapp.odometry.inertial.graph`; world_from_map: (3, 3) rotation, tilt included.
        covariance: (4, 4) of the alignment, the scale that of the spread of the keyframes and the tilt against their
            mean rotation; mounting: (6,), mounting_covariance: (6, 6) likewise.
        poses: (K, 6, 6) of the keyframes in the gauge of centroid, mean rotation and spread; None of more than
            400. All are infinite where the motion leaves anything open.
        linked: (J,) keyframes between which something was integrated.
        velocity: (J, 3), bias: (J, 6) accel and gyro; bias_sigma: (6,) at the middle one.
        residual: what the inertial factors add to the cost, twice, over the degrees of freedom that they bring: 1 where
            all noises are as modelled.
    """

    model: Reconstruction
    report: AdjustReport
    alignment: Array
    world_from_map: Array
    covariance: Array
    mounting: Array
    mounting_covariance: Array
    poses: Array | None
    linked: Ints
    velocity: Array
    bias: Array
    bias_sigma: Array
    residual: float


def solve_graph(
    seen: SeenMap,
    imu: Imu,
    intervals: Sequence[Interval],
    start: LinearStart,
    gyro_bias: Array,
    *,
    max_residual: float,
) -> Solved:
    """Adjust a map and its inertial measurements together.

    Where the factors leave more than their noise, that of the sensor is taken to be larger than stated by as much, and
    all is adjusted again, until they leave what chance does: sensors are shaken and heated, and seldom as good as their
    data sheets. Beyond ``max_residual`` it is no matter of noise.
    """
    images_alone = _adjusted_alone(seen)
    graph = _Graph(replace(seen, model=images_alone.reconstruction), imu, intervals, start, gyro_bias)
    before = images_alone.optimize().final_cost
    num_free = max(1, 15 * len(intervals) + 6 * graph.num_chains - 9 * len(graph.linked))
    excess, tolerance, residuals = 1.0, _ENOUGH / max(before, 1.0), list[float]()
    for _ in range(_ROUNDS):
        report = graph.optimize(excess, tolerance)
        if graph.doubts_mounting(report):
            report = graph.optimize(excess, tolerance)
        residuals.append(min(max(2.0 * (report.final_cost - before) / num_free, 0.0), _MOST))
        if not 1.0 + 2.0 * np.sqrt(2.0 / num_free) < residuals[-1] <= max_residual:
            break
        excess *= residuals[-1]
    return graph.read(report, residuals[0])


def _adjusted_alone(seen: SeenMap) -> FactorGraph:
    model = seen.model.copy()
    options = replace(seen.options, max_iterations=_MAX_STEPS, relative_cost_tolerance=_ALONE)
    return FactorGraph(model, options, varying=_varying(seen), noise_px=seen.noise_px)


def _varying(seen: SeenMap) -> Varying:
    """The first keyframe holds the place."""
    images = np.ones(len(seen.model.image_names), bool)
    images[: seen.num_sensors] = False
    return Varying(images=images)


class _Graph:
    """The graph of both, and what is read off it."""

    def __init__(
        self, seen: SeenMap, imu: Imu, intervals: Sequence[Interval], start: LinearStart, gyro_bias: Array
    ) -> None:
        self._seen, self._imu, self._intervals = seen, imu, intervals
        self._start, self._gyro_bias = start, gyro_bias
        self.linked = np.unique([(i.first, i.second) for i in intervals])
        self._mounting_sigmas = _CALIBRATED
        self.num_chains = len(self.linked) - len(intervals)
        rates = np.stack([np.interp(seen.times_s, imu.timestamps_s, column) for column in imu.gyro.T], 1) - gyro_bias
        self._place = Placement(imu.imu_from_cam, upright(start.gravity))
        self._rates = rates
        self._sums = [self._integrated(interval) for interval in intervals]
        self._values = self._initial()
        self._graph = self._built(1.0, _ALONE)

    def optimize(self, excess: float, tolerance: float) -> AdjustReport:
        """Adjust with a variance of the sensor's noise that is so many times larger than stated."""
        self._graph = self._built(excess, tolerance)
        report = self._graph.optimize()
        self._values = self._graph.values
        return report

    def doubts_mounting(self, report: AdjustReport) -> bool:
        """Whether the mounting, held as a calibrated one, is pulled too hard; from then on it is held as a guess."""
        pull = sum(2.0 * factors.cost for factors in report.factors if factors.kind == "mounting")
        if self._mounting_sigmas == _GUESSED or pull <= _MAX_PULL:
            return False
        self._mounting_sigmas = _GUESSED
        return True

    def _image(self, keyframe: int) -> int:
        return int(keyframe) * self._seen.num_sensors

    def _integrated(self, interval: Interval) -> Any:
        bias = gtsam.imuBias.ConstantBias(self._start.accel_bias, self._gyro_bias)
        sums = gtsam.PreintegratedCombinedMeasurements(preintegration(self._imu), bias)
        for step in midway(interval.steps, self._gyro_bias):
            sums.integrateMeasurement(step[4:], step[1:4], step[0])
        return sums

    def _initial(self) -> Any:
        """Velocities from what was integrated over each interval and how far the map says that it went."""
        values, start, world_from_map = gtsam.Values(), self._start, self._place.world_from_map
        scale = 1.0 if self._seen.is_metric else 1.0 / start.inverse_scale
        values.insert(A(0), np.array([np.log(scale), 0.0, 0.0, 0.0]))
        values.insert(M(0), np.zeros(6))
        map_from_cam = rigid3.inverse(self._seen.poses)
        turned = world_from_map @ rigid3.rotation_matrix(map_from_cam)
        center = scale * map_from_cam[:, 4:] @ world_from_map.T + turned @ self._place.arm
        turned = turned @ self._place.cam_from_imu
        down = np.array([0.0, 0.0, -GRAVITY])
        velocity: dict[int, Array] = {}
        for i in self._intervals:
            dt, turn = i.duration, turned[i.first]
            gained = i.delta[12:15] + i.slope(4) @ start.accel_bias
            velocity[i.first] = (center[i.second] - center[i.first] - turn @ gained) / dt - 0.5 * down * dt
            velocity[i.second] = velocity[i.first] + down * dt
            velocity[i.second] += turn @ (i.delta[9:12] + i.slope(2) @ start.accel_bias)
        for k in self.linked.tolist():
            values.insert(V(self._image(k)), velocity[k])
            values.insert(B(self._image(k)), gtsam.imuBias.ConstantBias(start.accel_bias, self._gyro_bias))
        return values

    def _built(self, excess: float, tolerance: float) -> FactorGraph:
        options = replace(
            self._seen.options, max_iterations=_MAX_STEPS, relative_cost_tolerance=tolerance, initial_damping=_DAMPING
        )
        graph = FactorGraph(
            self._seen.model, options, varying=_varying(self._seen), noise_px=self._seen.noise_px
        )  # fmt: skip
        for key in self._values.keys():  # noqa: SIM118
            graph.insert(key, _value(self._values, key))
        noise, weight = gtsam.noiseModel.Unit.Create(15), 1.0 / np.sqrt(excess)
        started: set[int] = set()
        for interval, sums in zip(self._intervals, self._sums, strict=True):
            first, second = interval.first, interval.second
            link = InertialLink(sums, self._place, self._rates[[first, second]], weight)
            a, b = self._image(first), self._image(second)
            graph.add(
                gtsam.CustomFactor(noise, [X(a), V(a), B(a), X(b), V(b), B(b), A(0), M(0)], link.error), "inertial"
            )
            if first not in started:  # the first of a chain of intervals
                sigmas = np.repeat([ACCEL_BIAS_SIGMA, GYRO_BIAS_SIGMA], 3)
                prior = gtsam.imuBias.ConstantBias(np.zeros(3), self._gyro_bias)
                graph.add(gtsam.PriorFactorConstantBias(B(a), prior, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
            started.update((first, second))
        self._hold(graph)
        return graph

    def _hold(self, graph: FactorGraph) -> None:
        """What is known beforehand of the alignment and the mounting, and a length that holds the map's unit where that
        is free."""
        seen, center = self._seen, np.zeros(4)
        sigmas = np.array([_OPEN, _OPEN, _OPEN, _CLOCK_SIGMA_S])
        if seen.scale_sigma is not None:
            sigmas[0] = max(seen.scale_sigma, _MIN_METRIC_SIGMA)
        else:
            center[0] = -np.log(self._start.inverse_scale)
            away = np.linalg.norm(rigid3.center(seen.poses) - rigid3.center(seen.poses[0]), axis=1)
            far = int(np.argmax(away))
            length = gtsam.noiseModel.Isotropic.Sigma(1, 1e-3 * away[far])
            graph.add(gtsam.RangeFactorPose3(X(0), X(self._image(far)), away[far], length))
        graph.add(gtsam.PriorFactorVector(A(0), center, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
        mounted = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(self._mounting_sigmas, 3))
        graph.add(gtsam.PriorFactorVector(M(0), np.zeros(6), mounted), "mounting")

    def read(self, report: AdjustReport, residual: float) -> Solved:
        """Estimates and marginals."""
        values = self._values
        covariance, of_mounting, bias_sigma, poses = self._covariances()
        bias = np.array([values.atConstantBias(B(self._image(k))).vector() for k in self.linked])
        alignment, mounting = values.atVector(A(0)), values.atVector(M(0))
        return Solved(
            self._graph.reconstruction, report, alignment, self._place.turned(alignment).matrix(), covariance,
            mounting, of_mounting, poses, self.linked,
            np.array([values.atVector(V(self._image(k))) for k in self.linked]), bias, bias_sigma, residual,
        )  # fmt: skip

    def _covariances(self) -> tuple[Array, Array, Array, Array | None]:
        """(4, 4) of the alignment and (6, 6) of the mounting, (6,) sigmas of the middle bias, all infinite where
        anything is open; (K, 6, 6) of the keyframes, None of too many."""
        num, middle = len(self._seen.times_s), B(self._image(self.linked[len(self.linked) // 2]))
        if num > MAX_COVARIANCE_KEYFRAMES:
            return *self._covariances_of_few(middle), None
        covariance, poses, mounting = (np.full(n, np.inf) for n in ((4, 4), (num, 6, 6), (6, 6)))
        bias_sigma, images = np.full(6, np.inf), [self._image(k) for k in range(1, num)]
        try:
            marginals = self._graph.marginal_covariance(images=images, variables=[A(0), M(0), middle])
            if marginals.is_determined:
                covariance, poses = self._in_gauge(marginals.matrix[:-12, :-12])
                mounting = marginals.of_variable(M(0))
                bias_sigma = np.sqrt(np.diag(marginals.of_variable(middle)))
        except np.linalg.LinAlgError:
            pass  # open: a variable of the sensor itself
        return covariance, mounting, bias_sigma, poses

    def _covariances_of_few(self, middle: int) -> tuple[Array, Array, Array]:
        """Of the alignment, the mounting and the middle bias, without those of all poses."""
        num, num_sensors = len(self._seen.times_s), self._seen.num_sensors
        _, _, of_alignment = self._freedoms()
        of_images, parts = np.zeros((16, num * num_sensors, 6)), np.split(np.eye(16), [4, 10], axis=1)
        of_images[:4, ::num_sensors] = of_alignment.reshape(4, num, 6)
        variables = dict(zip((A(0), M(0), middle), parts, strict=True))
        joint = self._graph.covariance_of_functions(of_images, variables)
        if joint is None:
            joint = np.full((16, 16), np.inf)
        return joint[:4, :4], joint[4:10, 4:10], np.sqrt(np.diag(joint)[10:])

    def _freedoms(self) -> tuple[Array, Array, Array]:
        """(7, 6 K) what each freedom of the map, six on a rig, does to its keyframes, (7, 6 K) what the errors of these
        have of it, and (4, 6 K) what the alignment gains where the map is held by all of them."""
        poses = self._seen.poses
        basis, constraint = similarity_basis(poses)
        if self._seen.is_metric:
            basis, constraint = basis[:6], constraint[:6]
        move = moves_into_gauge(basis, constraint)
        of_alignment = np.zeros((4, 6 * len(poses)))
        # a map that turns and grows turns and shrinks against the world: rows of turns are about the map's axes
        of_alignment[1:3] = (self._place.world_from_map @ move[:3])[:2]
        if not self._seen.is_metric:
            of_alignment[0] = move[6]
        return basis, move, of_alignment

    def _in_gauge(self, joint: Array) -> tuple[Array, Array]:
        """Covariances of the alignment (4, 4) and the keyframes (K, 6, 6) with the map held by all keyframes, out of
        the joint one (6 (K - 1) + 4) with the map held by the first."""
        num = len(self._seen.times_s)
        size = 6 * num
        basis, move, of_alignment = self._freedoms()
        change = np.zeros((size + 4, size + 4))
        change[:size, :size] = np.eye(size) - basis.T @ move
        change[size:, :size], change[size:, size:] = of_alignment, np.eye(4)
        change = change[:, 6:]  # the first keyframe did not move
        found = change @ joint @ change.T
        blocks = found[:size, :size].reshape(num, 6, num, 6)
        return found[size:, size:], blocks[np.arange(num), :, np.arange(num)]


def _value(values: Any, key: int) -> Any:
    return values.atConstantBias(key) if chr(gtsam.Symbol(key).chr()) == "b" else values.atVector(key)


def preintegration(imu: Imu) -> Any:
    """gtsam's parameters, z up."""
    parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(GRAVITY)
    stated = (imu.gyro_noise, imu.accel_noise, imu.gyro_walk, imu.accel_walk)
    densities = np.maximum(stated, _LEAST_NOISE)
    gyro, accel, gyro_walk, accel_walk = densities[:, None, None] ** 2 * np.eye(3)
    parameters.setGyroscopeCovariance(gyro)
    parameters.setAccelerometerCovariance(accel)
    parameters.setBiasOmegaCovariance(gyro_walk)
    parameters.setBiasAccCovariance(accel_walk)
    # what is lost between samples: 0.03 mm over a second, far below what any camera sees
    parameters.setIntegrationCovariance(1e-9 * np.eye(3))
    return parameters


def midway(steps: Array, gyro_bias: Array) -> Array:
    """Steps with the force turned to the middle of each: gtsam applies it in the orientation of the start."""
    half = rigid3.exp_so3(0.5 * steps[:, :1] * (steps[:, 1:4] - gyro_bias))
    return np.column_stack([steps[:, :4], np.einsum("nij,nj->ni", half, steps[:, 4:])])


class Placement:
    """Where the sensor is when a camera of the map is at a pose: gtsam.Pose3 in the z-up world, in metres.

    Args:
        imu_from_cam: (7,) see Imu. world_from_map: (3, 3) rotation that the tilt comes on top of.
    """

    def __init__(self, imu_from_cam: Array, world_from_map: Array) -> None:
        self.cam_from_imu = rigid3.rotation_matrix(imu_from_cam).T
        self.arm = rigid3.inverse(imu_from_cam)[4:]
        self.world_from_map = world_from_map
        self._cam_from_imu, self._world_from_map = gtsam.Rot3(self.cam_from_imu), gtsam.Rot3(world_from_map)

    def turned(self, alignment: Array) -> Any:
        """gtsam.Rot3 of the map in the world, tilt included."""
        return gtsam.Rot3.Expmap(np.array([alignment[1], alignment[2], 0.0])).compose(self._world_from_map)

    def sensor(self, pose: Any, velocity: Array, alignment: Array, mounting: Array, rate: Array) -> Any:
        """At the time of an image, which was taken some milliseconds of the offset later; over these the sensor turns
        at its rate (3,) in rad/s and moves at its velocity (3,)."""
        later = self.turned(alignment)
        turned, offset = later.compose(pose.rotation()), alignment[3]
        center = np.exp(alignment[0]) * later.rotate(pose.translation()) + turned.rotate(self.arm + mounting[3:])
        mounted = self._cam_from_imu.compose(gtsam.Rot3.Expmap(mounting[:3]))
        rotation = turned.compose(mounted).compose(gtsam.Rot3.Expmap(-offset * rate))
        return gtsam.Pose3(rotation, center - offset * velocity)

    def slopes(
        self, pose: Any, velocity: Array, alignment: Array, mounting: Array, rate: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Of the sensor's tangent, (6, 6) by the pose's, (6, 3) by the velocity, (6, 4) by the alignment and (6, 6) by
        the mounting."""
        sensor, later = self.sensor(pose, velocity, alignment, mounting, rate), self.turned(alignment).matrix()
        back, turned = sensor.rotation().matrix().T, later @ pose.rotation().matrix()
        scale, offset = np.exp(alignment[0]), alignment[3]
        by_pose, by_velocity, by_alignment = np.zeros((6, 6)), np.zeros((6, 3)), np.zeros((6, 4))
        by_pose[:3, :3] = back @ turned
        by_pose[3:, :3] = -back @ turned @ rigid3.skew(self.arm + mounting[3:])
        by_pose[3:, 3:] = scale * back @ turned
        by_velocity[3:] = -offset * back
        of_tilt = gtsam.Rot3.ExpmapDerivative(-np.array([alignment[1], alignment[2], 0.0]))[:, :2]
        center = sensor.translation() + offset * velocity
        by_alignment[:3, 1:3] = back @ of_tilt
        by_alignment[:3, 3] = -rate
        by_alignment[3:, 0] = back @ (center - turned @ (self.arm + mounting[3:]))
        by_alignment[3:, 1:3] = -back @ rigid3.skew(center) @ of_tilt
        by_alignment[3:, 3] = -back @ velocity
        by_mounting = np.zeros((6, 6))
        by_mounting[:3, :3] = gtsam.Rot3.Expmap(offset * rate).matrix() @ gtsam.Rot3.ExpmapDerivative(mounting[:3])
        by_mounting[3:, 3:] = back @ turned
        return by_pose, by_velocity, by_alignment, by_mounting


_SENSOR = tuple(gtsam.symbol("s", n) for n in range(6))


class InertialLink:
    """gtsam's CombinedImuFactor over poses of the camera in the map, for gtsam.CustomFactor: whitened (15,).

    Args:
        sums: gtsam.PreintegratedCombinedMeasurements. rates: (2, 3) rad/s at the two images.
        weight: factor on the whitened residual.
    """

    def __init__(self, sums: Any, place: Placement, rates: Array, weight: float) -> None:
        self._factor = gtsam.CombinedImuFactor(*_SENSOR[:4], *_SENSOR[4:], sums)
        self._place, self._rates, self._weight = place, rates, weight

    def error(self, factor: Any, values: Any, slopes: Any) -> Array:
        """The residual (15,), and its slopes by X, V, B of the first image, of the second, A and M."""
        keys = factor.keys()
        shared, inner, states = (values.atVector(keys[6]), values.atVector(keys[7])), gtsam.Values(), []
        for n, (x, v, b) in enumerate((keys[:3], keys[3:6])):
            state = (values.atPose3(x), values.atVector(v), *shared, self._rates[n])
            states.append(state)
            inner.insert(_SENSOR[2 * n], self._place.sensor(*state))
            inner.insert(_SENSOR[2 * n + 1], state[1])
            inner.insert(_SENSOR[4 + n], values.atConstantBias(b))
        if slopes is None:
            return np.asarray(self._weight * self._factor.whitenedError(inner), np.float64)
        linear = self._factor.linearize(inner)
        matrix, right = linear.jacobian()
        by_alignment, by_mounting = np.zeros((15, 4)), np.zeros((15, 6))
        for n, columns in enumerate((slice(0, 9), slice(9, 18))):
            by_sensor, by_velocity = matrix[:, columns][:, :6], matrix[:, columns][:, 6:]
            of_pose, of_velocity, of_alignment, of_mounting = self._place.slopes(*states[n])
            slopes[3 * n] = self._weight * by_sensor @ of_pose
            slopes[3 * n + 1] = self._weight * (by_velocity + by_sensor @ of_velocity)
            slopes[3 * n + 2] = self._weight * matrix[:, 18 + 6 * n : 24 + 6 * n]
            by_alignment += by_sensor @ of_alignment
            by_mounting += by_sensor @ of_mounting
        slopes[6], slopes[7] = self._weight * by_alignment, self._weight * by_mounting
        return np.asarray(-self._weight * right, np.float64)
