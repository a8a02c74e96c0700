"""What the error-state filter knows: where the sensor is in the map, and how the map lies in the world.

The sensor is told by its position in the map, rotation map_from_imu, velocity in the map, the biases of gyroscope and
accelerometer, and gravity in the axes of the map, which a map knows to its own accuracy only. Poses of neighbouring
frames err together, as they see the same points, and a map that is made with them keeps their errors: taken for new in
each frame, they would make innovations too small and the pose too sure (cf. Roumeliotis and Burdick, "Stochastic
cloning", ICRA 2002). So the map drifts: a place x of the world, in which gravity stands still, is at s C x + c of the
map, and s, C, c walk, at a rate that lasts for a while.

Poses are measured in the map, and all that they correct is told in it: slopes of measurements do not hang on the state,
but for the small lever arm. With the sensor told in the world they would, and what no pose can tell, such as where the
map began to turn, would seem to be told by slopes that are taken here and there (Huang, Mourikis and Roumeliotis,
"Analysis and improvement of the consistency of extended Kalman filter based SLAM", ICRA 2008); likewise the unit of
length, by a first velocity that was zero and is not. Filters centred on the robot do the same (Castellanos, Martinez-
Cantin, Tardos and Neira, "Robocentric map joining", Robotics and Autonomous Systems 2007).

What an adjustment of the map takes back of the drift says which part of it was drift, and not the sensor's biases; what
it takes back is told in the world as well, or the filter would carry it along for good.

The clocks of camera and sensor are apart by what is not known of them: a frame shows where the sensor is a moment later
(Li and Mourikis, "Online temporal calibration for camera-IMU systems", Int. Journal of Robotics Research 2014).

The error state (38,): position, rotation R exp(dtheta), velocity, biases, gravity, shift c, exp(dphi) C, log s, the
rate of the drift, what adjustments may yet take back of it, and that moment.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3, similarity
from sfmapp.odometry.inertial.integration import ACCEL_BIAS_SIGMA, GRAVITY, GYRO_BIAS_SIGMA, integrate

if TYPE_CHECKING:
    from sfmapp.images.sequence import Imu

Array = NDArray[np.float64]

# Where the parts of the error state are.
_P, _R, _V, _BG, _BA, _G, _CP, _CR = (slice(3 * k, 3 * k + 3) for k in range(8))
_S, _U, _W, _T = slice(24, 25), slice(25, 31), slice(31, 37), slice(37, 38)
_SIZE = 38
_ROWS = np.arange(_SIZE)
# Gravity is 9.78 to 9.83 m/s^2 from place to place.
_GRAVITY_SIGMA = 0.02
# Nearer to each other than this two views tell no distance of a point, radians: the tracker asks for a degree.
_LEAST_PARALLAX = math.radians(1.0)

# What of a pose that gets less sure is a step for itself in each frame, and not the same error seen from farther off:
# by seven rendered flights, of two cameras and two sizes of pictures, on which innovations are 0.7 to 1.0 with it, 0.8
# to 1.2 without (but for one whose first map was wrong) and 0.6 to 1.0 with all of it; those beside them are the less
# correlated the more there is of it.
_STEPS = 0.5
# What an adjustment takes back of the variance of the drift, at most: successive ones take back the same thing in part.
# What drifted long ago no adjustment of the newest keyframes takes back any more: it goes out of reach at this part of
# the rate at which points are lost. Without that the heading was believed to be known ever better, which nothing but
# the map tells. By flights 111, 112 and 113 of those of benchmarks/filtering.py, on which errors are 1.3 to 2.4 of
# their covariances; with 0.15 and nothing out of reach, which others had chosen, 2.5 to 7.3. Below a thousandth it
# tells nothing.
_MOST_TAKEN, _LEAST_TAKEN, _OUT_OF_REACH = 0.08, 1e-3, 0.05
# Where more is taken back than can have drifted of late, chi-squared of six beyond what one in a million is, it is of a
# loop or of a wrong first map, and counts the less the more it is.
_MOST_SQUARES = 38.3


@dataclass(frozen=True)
class InertialSensor:
    """Measurements, and what is known of the sensor before the first pose.

    Attributes:
        imu: on the clock of the poses, mounted as it is.
        gravity: (3,) m/s^2 in the world of the poses, which is in metres; it points down. gravity_sigma_rad: of its
            direction.
        gyro_bias, accel_bias: (3,) rad/s and m/s^2, uncertain by what biases of small sensors may be.
        scale_sigma: relative standard deviation of the unit of length of the poses; 0: they are in metres.
        clock_sigma_s: standard deviation of how far frames are later on the clock of the measurements than they say.
    """

    imu: Imu
    gravity: Array
    gravity_sigma_rad: float
    gyro_bias: Array
    accel_bias: Array
    scale_sigma: float = 0.0
    clock_sigma_s: float = 0.0


class Shared(NamedTuple):
    """How the errors of poses hang together in time, as shares of their covariance.

    Attributes:
        white: what is new in each frame and gone in the next.
        walk: what is new in each frame and stays, as the map is made with it: variance added from frame to frame.
        renewed: share of the points that the frame before did not see.
    """

    white: float
    walk: float
    renewed: float = 0.0


INDEPENDENT = Shared(1.0, 0.0)


class FilterState:
    """Where the sensor is believed to be, how far the map has drifted below it, and how sure that is.

    Args:
        speed: standard deviation of a velocity of which nothing is known, m/s.
    """

    def __init__(self, sensor: InertialSensor, speed: float) -> None:
        imu, down = sensor.imu, sensor.gravity / np.linalg.norm(sensor.gravity)
        self._imu_from_cam, self._arm = rigid3.rotation_matrix(imu.imu_from_cam), imu.imu_from_cam[4:]
        self._noises = np.array([imu.gyro_noise, imu.accel_noise, imu.gyro_walk, imu.accel_walk]) ** 2
        self._speed, self._delta = speed, np.empty(60)
        # in the map
        self._position, self._rotation, self._velocity = np.zeros(3), np.eye(3), np.zeros(3)
        self.gyro_bias, self.accel_bias, self._gravity = sensor.gyro_bias, sensor.accel_bias, sensor.gravity
        # a place x in the world is at scale turn x + shift in the map, whose unit was said to be a metre
        self._shift, self._turn, self._log_scale = np.zeros(3), np.eye(3), 0.0
        self._is_metric = sensor.scale_sigma == 0.0
        self._later_s, self._turning = 0.0, np.zeros(3)  # frames are, by the sensor's clock; rad/s, of the sensor
        self._rate = np.zeros(6)  # of the drift, a frame: of what is where the camera is, and of the rotation
        # the drift that may yet be taken back, where the camera was; covariance of it and of the rate by poses alone
        self._walked, self._there, self._by_poses = np.zeros(6), np.zeros(3), np.zeros((12, 12))
        self._num_taken, self._share_taken = 0, 0.0
        self._last_noise: Array | None = None  # (6, 6) of the last pose, in the axes of the map
        self._behind = np.zeros(3)  # in the map, where the camera was when the points that it sees were new
        self._p = np.zeros((_SIZE, _SIZE))
        self._p[_BG, _BG], self._p[_BA, _BA] = GYRO_BIAS_SIGMA**2 * np.eye(3), ACCEL_BIAS_SIGMA**2 * np.eye(3)
        along = np.outer(down, down)
        tilt = GRAVITY * sensor.gravity_sigma_rad
        self._p[_G, _G] = tilt**2 * (np.eye(3) - along) + _GRAVITY_SIGMA**2 * along
        self._p[_S, _S], self._p[_T, _T] = sensor.scale_sigma**2, sensor.clock_sigma_s**2
        self._prior = self._p.copy()

    def copied(self) -> FilterState:
        """Another that goes its own way from here."""
        other = copy.copy(self)
        other._p, other._delta = self._p.copy(), np.empty(60)
        return other

    @property
    def scale_sigma(self) -> float:
        """Relative standard deviation of the unit of length."""
        return float(np.sqrt(self._p[24, 24]))

    @property
    def clock_s(self) -> tuple[float, float]:
        """How much later frames are on the clock of the measurements than they say, and its standard deviation."""
        return self._later_s, float(np.sqrt(self._p[37, 37]))

    @property
    def tilt_sigma_rad(self) -> float:
        """Standard deviation of the direction of gravity, about the axis of which it is the largest."""
        size = float(np.linalg.norm(self._gravity))
        across = np.eye(3) - np.outer(self._gravity, self._gravity) / size**2
        return float(np.sqrt(np.linalg.eigvalsh(across @ self._p[_G, _G] @ across)[-1])) / size

    # ---- the map

    def begin(self, center: Array, rotation: Array, noise: Array, shared: Shared, turning: Array) -> None:
        """At a pose of the camera (centre, world_from_cam and their covariance), with any velocity, where the gyroscope
        says turning (3,). The world is that of the map as it is now."""
        self._turning, self._velocity = turning - self.gyro_bias, np.zeros(3)
        self._rotation = rotation @ self._imu_from_cam.T @ rigid3.exp_so3(-self._later_s * self._turning)
        self._position = center - math.exp(self._log_scale) * self._rotation @ self._arm
        self._behind, self._rate = center, np.zeros(6)
        known = np.r_[_BG, _BA, _G, _S, _T]
        kept = self._p[np.ix_(known, known)]
        self._p[:] = 0.0
        self._p[np.ix_(known, known)] = kept
        h = self._measurement()
        back = np.linalg.inv(h[:, :6])
        self._p[:6, :6] = back @ (shared.white * noise) @ back.T
        # the camera is there whatever the unit of length and the clocks are
        h[:3, _T] = 0.0
        change = np.eye(_SIZE)
        for told in (_S, _T):
            change[:6, told] = -back @ h[:, told]
        self._p = change @ self._p @ change.T
        in_map = np.eye(6)
        in_map[3:, 3:] = rotation
        self._last_noise = in_map @ noise @ in_map.T
        self._there, self._walked, self._by_poses = center, np.zeros(6), np.zeros((12, 12))
        self._by_poses[:6, :6], self._by_poses[6:, 6:] = self._last_noise, shared.walk**2 * self._last_noise
        self._p[_U, _U], self._p[_W, _W] = self._by_poses[6:, 6:], self._by_poses[:6, :6]
        self._p[_V, _V] = self._speed**2 * np.eye(3)
        self.take_map_for_world()

    def take_map_for_world(self) -> None:
        """The world becomes that of the map as it is now, without any drift; another unit of length would not move the
        camera from where it is."""
        self._turn, self._shift = np.eye(3), np.zeros(3)
        change = np.eye(_SIZE)
        change[_CP], change[_CR] = 0.0, 0.0
        change[_CP, _S] = -self._center()[:, None]
        self._p = change @ self._p @ change.T

    def move_map(self, moved: Array, *, is_followed: bool = True) -> None:
        """The map was put elsewhere: a place x of it was at moved(x), a similarity (8,). The camera stays, but for what
        that tells of where it was: nothing if the map went on without poses that were followed here, as its drift
        since then is not known of."""
        back = similarity.inverse(moved)
        if is_followed and not np.array_equal(moved, similarity.IDENTITY):
            self._take_back(self._there - similarity.apply(back, self._there), rigid3.rotation_matrix(moved))
        turn, size = rigid3.rotation_matrix(back), float(back[7])
        self._position, self._shift = similarity.apply(back, self._position), similarity.apply(back, self._shift)
        self._behind = similarity.apply(back, self._behind)
        self._rotation, self._turn = turn @ self._rotation, turn @ self._turn
        self._velocity, self._gravity = size * turn @ self._velocity, turn @ self._gravity
        self._log_scale += math.log(size)
        rate = np.kron(np.diag([size, 1.0]), turn)
        self._rate, self._walked = rate @ self._rate, rate @ self._walked
        self._there, both = similarity.apply(back, self._there), np.kron(np.eye(2), rate)
        self._by_poses = both @ self._by_poses @ both.T
        if self._last_noise is not None:
            self._last_noise = rate @ self._last_noise @ rate.T
        change = np.eye(_SIZE)
        change[_P, _P] = change[_V, _V] = change[_CP, _CP] = size * turn
        change[_G, _G] = change[_CR, _CR] = turn
        change[_U, _U] = change[_W, _W] = rate
        self._p = change @ self._p @ change.T

    def _take_back(self, shift: Array, turn: Array) -> None:
        """An adjustment has found that the map had drifted, by a shift (3,) where the camera is and a turn (3, 3).

        It is held to more of the images than the poses were: what it leaves has nothing to do with what it takes back
        (Hausman, as in :meth:`drift`). Of a drift of covariance S it takes back d, of covariance share S, and leaves
        (1 - share) S. A measurement d / share with noise (1 / share - 1) S would say the same, and as one it is told to
        what the sensor has found out about the drift besides. How large the share is, d itself tells.
        """
        taken = np.concatenate([shift, rigid3.log_so3(turn)])
        covariance = self._by_poses[:6, :6]
        squares = float(taken @ np.linalg.solve(covariance, taken))
        self._num_taken, self._share_taken = self._num_taken + 1, self._share_taken + min(squares / 6.0, 1.0)
        share = min(_MOST_TAKEN, self._share_taken / self._num_taken)
        if share > _LEAST_TAKEN:
            h = np.zeros((6, _SIZE))
            h[:, _W] = np.eye(6)
            noise, innovation = (1.0 / share - 1.0) * covariance, taken / share - self._walked
            expected = self._p[_W, _W] + noise
            self._update(innovation, h, noise + (max(1.0, squares / _MOST_SQUARES) - 1.0) * expected)
            self._by_poses = self._by_poses - share * self._by_poses[:, :6] @ np.linalg.solve(
                covariance, self._by_poses[:6]
            )
        self._walked = self._walked - taken

    def drift(self, shared: Shared, noise: Array, center: Array) -> None:
        """The map errs otherwise than at the last frame; what was mapped before stays as it was.

        Points are placed by the poses of the frames in which their errors are the same, 1 / walk of them. Where the way
        of the camera over these is wrong, by as much as one pose is, what they show goes on wrong in the same sense:
        the drift has a rate, and keeps it until no error is the same any more, 2 / walk frames.

        A pose that is measured with fewer of the same points, or from farther off, is less sure than the last one, and
        has moved away from it by the difference of their variances (Hausman, "Specification tests in econometrics",
        Econometrica 1978, lemma 2.1). One that is surer has not: new points are placed by the poses themselves. What
        the usual loss of points does is in the walk, so what is beyond that is added, in part: it is not a step for
        itself in each frame where the same points are seen from ever farther off.

        Args:
            noise: (6, 6) covariance of the pose, of the centre, and of the rotation in the camera's frame.
            center: (3,) the pose's.
        """
        in_map = np.eye(6)
        in_map[3:, 3:] = self._rotation @ self._imu_from_cam
        noise = in_map @ noise @ in_map.T
        walked = shared.walk * noise + _STEPS * (1.0 - shared.white) * self._grown(noise, shared.renewed)
        here, turning = self._center(), rigid3.exp_so3(self._rate[3:])
        spread = self._moved_with_map()
        step, kept = np.eye(_SIZE), max(0.0, 1.0 - 0.5 * shared.walk)
        step[:, _U] = spread
        step[_U, _U] = kept * np.eye(6)
        farther = np.eye(6)
        farther[:3, 3:] = -rigid3.skew(here - self._there)
        farther *= max(0.0, 1.0 - _OUT_OF_REACH * shared.walk)  # of old drift less and less can be taken back
        step[_W, _W], self._there = farther, here
        self._p = step @ self._p @ step.T + spread @ walked @ spread.T
        both = np.r_[_W, _U]
        step, added = step[np.ix_(both, both)], (1.0 - kept**2) * shared.walk**2 * noise
        self._by_poses = step @ self._by_poses @ step.T
        self._by_poses[:6, :6] += walked
        self._p[_U, _U] += added
        self._by_poses[6:, 6:] += added
        self._walked = farther @ self._walked + self._rate
        self._position = here + self._rate[:3] + turning @ (self._position - here)
        self._shift = here + self._rate[:3] + turning @ (self._shift - here)
        self._rotation, self._turn = turning @ self._rotation, turning @ self._turn
        self._velocity, self._gravity = turning @ self._velocity, turning @ self._gravity
        self._rate = kept * self._rate
        self._change_unit(shared, noise, center)

    def _moved_with_map(self) -> Array:
        """(38, 6) slopes of the state by the map: how far it moves where the camera is, and how it turns about that."""
        here, spread = self._center(), np.zeros((_SIZE, 6))
        spread[_P, :3] = spread[_CP, :3] = np.eye(3)
        spread[_P, 3:], spread[_CP, 3:] = -rigid3.skew(self._position - here), -rigid3.skew(self._shift - here)
        spread[_R, 3:], spread[_CR, 3:] = self._rotation.T, np.eye(3)
        spread[_W] = np.eye(6)
        spread[_V, 3:], spread[_G, 3:] = -rigid3.skew(self._velocity), -rigid3.skew(self._gravity)
        return spread

    def _grown(self, noise: Array, renewed: float) -> Array:
        """By how much a covariance (6, 6), in the axes of the map, is larger than that of the last pose with a share of
        its points less: the directions in which it is."""
        last, self._last_noise = self._last_noise, noise
        if last is None or not renewed < 1.0:
            return np.zeros((6, 6))
        root = np.linalg.cholesky(noise)
        inverse = np.linalg.inv(root)
        share, axes = np.linalg.eigh(np.eye(6) - inverse @ last @ inverse.T / (1.0 - renewed))
        axes = root @ axes
        grown: Array = (axes * np.maximum(share, 0.0)) @ axes.T
        return grown

    def _change_unit(self, shared: Shared, noise: Array, center: Array) -> None:
        """Of one camera the length of the way over which points were placed is the unit of the map besides, which is
        handed on to those that take their places; noise (6, 6) in the axes of the map."""
        way = center - self._behind
        self._behind = self._behind + min(shared.walk, 1.0) * way
        if self._is_metric:
            return
        # points that are farther than so many times the way have no distance yet; their depth is what a pose is less
        # sure of its place by than of its direction
        depth2 = float(np.trace(noise[:3, :3]) / np.trace(noise[3:, 3:]))
        length2 = float(way @ way) + depth2 * _LEAST_PARALLAX**2
        change2 = shared.renewed * float(way @ noise[:3, :3] @ way) / length2**2
        spread = np.zeros(_SIZE)
        here = self._center()
        spread[_P], spread[_V], spread[_CP], spread[_S] = self._position - here, self._velocity, self._shift - here, 1.0
        self._p += change2 * np.outer(spread, spread)

    # ---- the sensor

    def predict(self, step: Array) -> None:
        """On by a step (7,) of the sensor: duration, mean rate and mean force."""
        h, delta, r, size = float(step[0]), self._delta, self._rotation, math.exp(self._log_scale)
        integrate(step[None], self.gyro_bias, delta)
        slope = delta[15:].reshape(5, 3, 3)
        velocity = delta[9:12] + slope[2] @ self.accel_bias
        moved = delta[12:15] + slope[4] @ self.accel_bias
        faster = size * (h * self._gravity + r @ velocity)
        farther = size * (0.5 * h * h * self._gravity + r @ moved)
        turn, f, in_map = delta[:9].reshape(3, 3), np.eye(_SIZE), size * r
        self._turning = step[1:4] - self.gyro_bias
        f[_P, _R], f[_V, _R] = -in_map @ rigid3.skew(moved), -in_map @ rigid3.skew(velocity)
        f[_R, _R], f[_R, _BG] = turn.T, slope[0]
        f[_V, _BG], f[_V, _BA] = in_map @ slope[1], in_map @ slope[2]
        f[_P, _BG], f[_P, _BA] = in_map @ slope[3], in_map @ slope[4]
        f[_P, 24], f[_V, 24] = farther, faster
        for k in range(3):
            f[k, 6 + k], f[k, 15 + k], f[6 + k, 15 + k] = h, 0.5 * h * h * size, h * size
        self._p = f @ self._p @ f.T
        gyro, accel, gyro_walk, accel_walk = self._noises * h
        accel *= size * size
        moving = _ROWS[: _G.start]
        self._p[moving, moving] += np.repeat([accel * h * h / 3.0, gyro, accel, gyro_walk, accel_walk], 3)
        for k in range(3):
            self._p[k, 6 + k] += accel * h / 2.0
            self._p[6 + k, k] += accel * h / 2.0
        self._position = self._position + self._velocity * h + farther
        self._velocity = self._velocity + faster
        self._rotation = r @ turn

    def _center(self) -> Array:
        """(3,) of the camera in the map."""
        center: Array = self._position + math.exp(self._log_scale) * self._rotation @ self._arm
        return center

    def _seen(self) -> tuple[Array, Array]:
        """Centre (3,) and rotation map_from_cam (3, 3) of what a frame of this time shows."""
        later = self._rotation @ rigid3.exp_so3(self._later_s * self._turning) @ self._imu_from_cam
        return self._center() + self._later_s * self._camera_velocity(), later

    def _camera_velocity(self) -> Array:
        """(3,) in the map."""
        about: Array = self._rotation @ np.cross(self._turning, self._arm)
        return self._velocity + math.exp(self._log_scale) * about

    def _measurement(self) -> Array:
        """(6, 38) slopes of the camera's centre in the map and of its rotation, in its own frame."""
        h, size = np.zeros((6, _SIZE)), math.exp(self._log_scale)
        h[:3, _P], h[:3, _R] = np.eye(3), -size * self._rotation @ rigid3.skew(self._arm)
        h[:3, 24] = size * self._rotation @ self._arm
        h[3:, _R] = self._imu_from_cam.T
        h[:3, 37], h[3:, 37] = self._camera_velocity(), self._imu_from_cam.T @ self._turning
        h[:3, _V] = self._later_s * np.eye(3)
        return h

    def camera(self) -> tuple[Array, Array, Array]:
        """Rotation world_from_cam (3, 3), centre in the world (3,) and their covariance (6, 6), centre first."""
        back, size = self._turn.T, math.exp(-self._log_scale)
        center, in_map = self._seen()
        ahead = center - self._shift
        change = self._measurement()
        change[:3, _CP], change[:3, _CR] = -np.eye(3), rigid3.skew(ahead)
        change[:3, 24] -= ahead
        change[:3] = size * back @ change[:3]
        change[3:, _CR] = -in_map.T
        return back @ in_map, size * back @ ahead, change @ self._p @ change.T

    def innovation(self, center: Array, rotation: Array) -> Array:
        """(6,) what a measured pose says beyond the state."""
        here, ours = self._seen()
        return np.concatenate([center - here, rigid3.log_so3(ours.T @ rotation)])

    def whitened(self, innovation: Array, noise: Array) -> Array:
        """(6,) the innovation without the correlations that it should have, in standard deviations."""
        h = self._measurement()
        white: Array = np.linalg.solve(np.linalg.cholesky(h @ self._p @ h.T + noise), innovation)
        return white

    def correct(self, innovation: Array, noise: Array) -> None:
        """Kalman's update, the covariance in Joseph's form."""
        self._update(innovation, self._measurement(), noise)

    def _update(self, innovation: Array, h: Array, noise: Array) -> None:
        """By a measurement of slopes h (6, 38)."""
        gain = np.linalg.solve(h @ self._p @ h.T + noise, h @ self._p).T
        step, keep = gain @ innovation, np.eye(_SIZE) - gain @ h
        self._p = keep @ self._p @ keep.T + gain @ noise @ gain.T
        self._p = 0.5 * (self._p + self._p.T)
        self._position, self._velocity = self._position + step[_P], self._velocity + step[_V]
        self._rotation = rigid3.rotation_matrix(rigid3.quaternion(self._rotation @ rigid3.exp_so3(step[_R])))
        self.gyro_bias, self.accel_bias = self.gyro_bias + step[_BG], self.accel_bias + step[_BA]
        self._gravity = self._gravity + step[_G]
        turn = rigid3.exp_so3(step[_CR])
        self._turn, self._shift = turn @ self._turn, self._shift + step[_CP]
        self._log_scale, self._rate = self._log_scale + float(step[24]), self._rate + step[_U]
        self._walked, self._later_s = self._walked + step[_W], self._later_s + float(step[37])

    def forget(self, innovation: Array) -> None:
        """The poses jumped, and go on from there: the map did. What carries a camera moves steadily between the samples
        of its sensor, and the world stays where that expects it."""
        squares = [(innovation[:3] ** 2).sum(), (innovation[3:] ** 2).sum()]
        spread, jumped = self._moved_with_map(), np.repeat(squares, 3)
        self._p += (spread * jumped) @ spread.T
        self._by_poses[:6, :6] += np.diag(jumped)

    def doubt(self) -> None:
        """What is believed of the sensor, of gravity and of the unit of length is no surer than before the first pose.
        The state is to begin anew."""
        self._p = self._prior.copy()
