"""The plane that a wheeled robot moves in, and how its camera is mounted over it, out of its poses.

A vehicle on level ground keeps the height of its camera and the direction in which the camera sees the plane's normal;
springs, bumps and curves make it deviate a little. What it deviates by is a residual of three numbers a keyframe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.odometry.report import PlaneEvidence

Array = NDArray[np.float64]

# Sigmas to begin with: springs nod and roll by half a degree; heights, as a share of the size of the path.
_TILT_RAD, _HEIGHT_SHARE, _ROUNDS = 0.01, 0.01, 10
# Deviations are never taken to be smaller, so that an exact plane is no singular weight.
_LEAST_TILT_RAD, _LEAST_HEIGHT_SHARE = 1e-5, 1e-6
# Fewest keyframes that tell three variances.
MIN_KEYFRAMES = 10
# A camera on wheels looks about level; this says so where the motion, straight on, does not tell the plane.
_MOUNTED_RAD = 0.35
# What looks like a vehicle on level ground: it nods and rolls by less than this, leaves its plane by less than this
# share of its way, and turns by more than this, as a straight way tells no plane. A hand sways by two degrees or more.
_MAX_TILT_RAD, _MAX_HEIGHT_SHARE, MIN_TURN_RAD = float(np.radians(1.0)), 0.02, float(np.radians(30.0))


@dataclass(frozen=True)
class MotionPlane:
    """A plane of motion.

    Attributes:
        normal: (3,) unit, in the map. distance: of the camera's centres from its origin along it, map units.
        up_in_cam: (3,) the normal as the camera sees it. basis: (2, 3) tangents to it in the camera's frame: turning
            the normal towards the first is a nod about the camera's x axis, towards the second a roll about its z axis.
        deviations: (K, 3) of keyframes: of the normal along ``basis`` in radians, and of the height in map units.
        turned_rad: between the keyframes that face the most different ways in the plane.
        size: root mean squared distance of the keyframes from their mean, map units.
    """

    normal: Array
    distance: float
    up_in_cam: Array
    basis: Array
    deviations: Array
    turned_rad: float
    size: float

    @property
    def looks_level(self) -> bool:
        """Whether this is how a vehicle on level ground moves, and the motion tells its plane."""
        nod, roll, height = np.sqrt((self.deviations**2).mean(0))
        is_flat = max(nod, roll) < _MAX_TILT_RAD and height < _MAX_HEIGHT_SHARE * self.size
        return bool(is_flat and self.turned_rad > MIN_TURN_RAD)


def fit_motion_plane(cam_from_map: Array) -> MotionPlane | None:
    """The plane that poses (K, 7) deviate from the least, rotations and heights weighted by how much they do.

    With M the mean rotation, the normals that the cameras see have a variance of 1 - |M n|^2, heights n^T C n with the
    covariance C of the centres: for given weights n is an eigenvector.

    Returns:
        None of fewer than three poses, or of poses in one place.
    """
    rotations, centers = rigid3.rotation_matrix(cam_from_map), rigid3.center(cam_from_map)
    mean, middle = rotations.mean(0), centers.mean(0)
    size = float(np.sqrt(((centers - middle) ** 2).sum(1).mean()))
    if len(cam_from_map) < 3 or not size > 0.0:
        return None
    scatter = (centers - middle).T @ (centers - middle) / len(centers)
    down = mean[1] / max(float(np.linalg.norm(mean[1])), 1e-12)
    mounted = (np.eye(3) - np.outer(down, down)) / (len(centers) * _MOUNTED_RAD**2)
    tilt, height = _TILT_RAD, _HEIGHT_SHARE * size
    for _ in range(_ROUNDS):
        form = (np.eye(3) - mean.T @ mean) / (2.0 * tilt**2) + scatter / height**2 + mounted
        normal = np.linalg.eigh(form)[1][:, 0]
        tilt = max(float(np.sqrt(max(1.0 - normal @ mean.T @ mean @ normal, 0.0) / 2.0)), _LEAST_TILT_RAD)
        height = max(float(np.sqrt(max(normal @ scatter @ normal, 0.0))), _LEAST_HEIGHT_SHARE * size)
    up = mean @ normal
    if up[1] > 0.0:  # the camera's y axis points down
        normal, up = -normal, -up
    up /= np.linalg.norm(up)
    basis = tangents(up)
    deviations = np.column_stack([rotations @ normal @ basis.T, (centers - middle) @ normal])
    flat = rotations[:, 2] - np.outer(rotations[:, 2] @ normal, normal)
    flat /= np.maximum(np.linalg.norm(flat, axis=1), 1e-12)[:, None]
    turned = float(np.arccos(np.clip((flat @ flat.T).min(), -1.0, 1.0)))
    return MotionPlane(normal, float(middle @ normal), up, basis, deviations, turned, size)


def offer_plane(cam_from_map: Array) -> PlaneEvidence | None:
    """What speaks for it that a camera, whose motion was taken to be free, was on wheels on level ground; None where
    nothing does."""
    plane = fit_motion_plane(cam_from_map) if len(cam_from_map) >= MIN_KEYFRAMES else None
    if plane is None or not plane.looks_level:
        return None
    nod, roll, height = np.sqrt((plane.deviations**2).mean(0))
    reason = (
        f"the camera turned by {np.degrees(plane.turned_rad):.0f} degrees and nodded and rolled by "
        f"{np.degrees(nod):.2f} and {np.degrees(roll):.2f}; it left a plane by {height / plane.size:.2%} of its way: "
        "odometry.motion=planar would hold it there as well as it keeps to it"
    )
    return unheld(plane, reason, state="offered")


def unheld(plane: MotionPlane, reason: str, state: str = "dropped") -> PlaneEvidence:
    """Evidence of a plane that nothing was adjusted with."""
    deviation = np.sqrt((plane.deviations**2).mean(0))
    return PlaneEvidence(
        state=state, reason=reason, turned_deg=float(np.degrees(plane.turned_rad)),
        deviation_deg=np.degrees(deviation[:2]).tolist(), deviation_height=float(deviation[2]),
        up_in_cam=plane.up_in_cam.tolist(),
    )  # fmt: skip


def tangents(up: Array) -> Array:
    """(2, 3) orthonormal tangents at a unit vector: along the camera's optical axis, and across it."""
    ahead = np.eye(3)[2 if abs(up[2]) < 0.9 else 1]
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    return np.stack([ahead, np.cross(up, ahead)])


def shared_factor(deviations: Array) -> Array:
    """(D,) by how much the variance of a mean of each column (K, D) is larger than if its rows were independent.

    Autocorrelations are summed as long as those of neighbouring lags stay positive together (Geyer, "Practical Markov
    chain Monte Carlo", Statistical Science 1992): a road that bends, or a curve that a car leans in, is one deviation
    and not one for each keyframe.
    """
    centered = deviations - deviations.mean(0)
    num = len(centered)
    out = np.ones(centered.shape[1])
    for column in range(centered.shape[1]):
        series = centered[:, column]
        variance = float(series @ series)
        if not variance > 0.0:
            continue
        rho = np.array([series[: num - lag] @ series[lag:] for lag in range(num)]) / variance
        pairs = rho[: num - num % 2].reshape(-1, 2).sum(1)
        last = int(np.argmax(pairs <= 0.0)) if (pairs <= 0.0).any() else len(pairs)
        out[column] = max(1.0, 2.0 * pairs[:last].sum() - 1.0)
    return out
