"""Similarities (scale, rotation, translation) as plain arrays, and their fit to points and to cameras.

A similarity ``b_from_a`` is (8,) float64: quaternion x, y, z, w, translation, scale, with ``x_b = s R x_a + t``: a pose
of :mod:`sfmapp.geometry.rigid3` and a scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

IDENTITY: Array = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])

# Points thinner than this share of their length are a line as far as double precision can tell: the correlation
# matrix holds the square, 1e-12, with four digits to spare.
_COLLINEAR = 1e-6
# A direction in which the centres spread less than this many residuals says nothing about the rotation (three sigma).
_SPREAD_OVER_RESIDUAL = 3.0
# Pairs of cameras tried by the robust fit: all of them up to 64 cameras. For more, 2000 random pairs miss all
# samples of two good cameras, with half of them bad, with a probability of 0.75^2000.
_MAX_SAMPLES = 2016
# Candidates that go on to the concentration steps, as in FAST-LTS.
_NUM_STARTS = 10


@dataclass(frozen=True)
class PoseAlignment:
    """A similarity that carries cameras from one world to another.

    Attributes:
        b_from_a: (8,) similarity.
        is_inlier: (N,) bool: the cameras it was fitted to.
        is_twist_from_orientations: the centres lie on a line (within their errors), so the rotation about that line
            comes from the orientations of the cameras.
    """

    b_from_a: Array
    is_inlier: NDArray[np.bool_]
    is_twist_from_orientations: bool


def from_parts(rotation: ArrayLike, translation: ArrayLike, scale: float) -> Array:
    """Similarity (8,) of a rotation matrix (3, 3), a translation (3,) and a scale."""
    return np.append(rigid3.from_matrix(rotation, translation), scale)


def apply(b_from_a: ArrayLike, x_a: ArrayLike) -> Array:
    """Points (..., 3) moved from frame a to frame b."""
    sim = np.asarray(b_from_a, np.float64)
    moved: Array = sim[7] * (np.asarray(x_a, np.float64) @ rigid3.rotation_matrix(sim).T) + sim[4:7]
    return moved


def inverse(b_from_a: ArrayLike) -> Array:
    """``a_from_b``."""
    sim = np.asarray(b_from_a, np.float64)
    rotation = rigid3.rotation_matrix(sim).T
    return from_parts(rotation, -rotation @ sim[4:7] / sim[7], 1.0 / sim[7])


def compose(c_from_b: ArrayLike, b_from_a: ArrayLike) -> Array:
    """``c_from_a``: first the second argument, then the first."""
    left, right = np.asarray(c_from_b, np.float64), np.asarray(b_from_a, np.float64)
    rotation = rigid3.rotation_matrix(left) @ rigid3.rotation_matrix(right)
    return from_parts(rotation, apply(left, right[4:7]), left[7] * right[7])


def transform_poses(b_from_a: ArrayLike, cam_from_a: ArrayLike) -> Array:
    """Poses ``cam_from_b`` (..., 7) of the same cameras in world b; a camera has no scale, so that of b is dropped."""
    sim, poses = np.asarray(b_from_a, np.float64), np.asarray(cam_from_a, np.float64)
    rotation = rigid3.rotation_matrix(poses) @ rigid3.rotation_matrix(sim).T
    centers = apply(sim, rigid3.center(poses))
    return rigid3.from_matrix(rotation, -np.einsum("...ij,...j->...i", rotation, centers))


def umeyama(x_a: ArrayLike, x_b: ArrayLike) -> Array:
    """The similarity that minimises ``sum |x_b - (s R x_a + t)|^2``, in closed form.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", IEEE PAMI 13(4), 1991,
    equations 34 to 43.

    Args:
        x_a, x_b: (N, 3) corresponding points, at least three that are not on a line.

    Returns:
        (8,) ``b_from_a``.

    Raises:
        ValueError: the points do not determine a similarity.
    """
    moments = _moments(np.asarray(x_a, np.float64), np.asarray(x_b, np.float64))
    if moments.is_collinear:
        raise ValueError("a similarity needs three points that are not on a line")
    return _similarity(moments, moments.rotation)


def align_poses(cam_from_a: ArrayLike, cam_from_b: ArrayLike) -> PoseAlignment:
    """Least-squares similarity between the centres of the same cameras in two worlds.

    Centres on a line leave the rotation about the line open (two cameras, a straight path). There the orientations of
    the cameras close it: of all rotations that map line to line, the one closest to them in the chordal sense. A line
    is what is thinner than three times the error that the fit leaves.

    Args:
        cam_from_a, cam_from_b: (N, 7) poses, without NaN, N >= 2.

    Raises:
        ValueError: fewer than two cameras, or all of them in one place: the scale is open.
    """
    pose_a, pose_b = np.asarray(cam_from_a, np.float64), np.asarray(cam_from_b, np.float64)
    b_from_a, is_line = _fit(_Cameras.of(pose_a, pose_b))
    return PoseAlignment(b_from_a, np.ones(len(pose_a), bool), is_line)


def align_poses_robust(cam_from_a: ArrayLike, cam_from_b: ArrayLike) -> PoseAlignment:
    """Like :func:`align_poses`, for cameras of which fewer than half are grossly wrong. Deterministic, no threshold.

    Least median of squares over pairs of cameras (Rousseeuw, JASA 1984), concentration steps from the ten best
    (Rousseeuw and Van Driessen, FAST-LTS, 2006), then least squares over all cameras within 2.5 robust standard
    deviations. With fewer than four cameras nothing can be told apart and the plain fit is returned.

    Raises:
        ValueError: as :func:`align_poses`; also if the cameras that agree are all in one place.
    """
    pose_a, pose_b = np.asarray(cam_from_a, np.float64), np.asarray(cam_from_b, np.float64)
    if len(pose_a) < 4:
        return align_poses(pose_a, pose_b)
    cameras = _Cameras.of(pose_a, pose_b)
    starts = _minimal_fits(cameras)
    if not starts:
        raise ValueError("all cameras are in one place: the scale is open")
    best = min((_concentrate(cameras, sim) for _, sim in starts), key=lambda end: end[0])[1]
    b_from_a = best
    for _ in range(20):  # the set settles in a few rounds
        is_inlier = _within_robust_sigma(cameras.residuals(b_from_a), cameras.extent_b)
        previous, (b_from_a, is_line) = b_from_a, _fit(cameras.subset(is_inlier))
        if np.array_equal(previous, b_from_a):
            break
    return PoseAlignment(b_from_a, is_inlier, is_line)


@dataclass(frozen=True)
class _Moments:
    """Means, spreads and correlation of two point sets, and the singular vectors of the latter."""

    mean_a: Array
    mean_b: Array
    variance_a: float
    correlation: Array
    singular_values: Array
    u: Array
    vt: Array
    is_collinear: bool

    @property
    def rotation(self) -> Array:
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(self.u) * np.linalg.det(self.vt))])
        turn: Array = (self.u * sign) @ self.vt
        return turn


def _moments(x_a: Array, x_b: Array) -> _Moments:
    if len(x_a) < 2:
        raise ValueError("a similarity needs at least two points")
    mean_a, mean_b = x_a.mean(0), x_b.mean(0)
    a, b = x_a - mean_a, x_b - mean_b
    correlation = b.T @ a / len(a)
    spread_a, spread_b = np.sqrt((a**2).sum(1).mean()), np.sqrt((b**2).sum(1).mean())
    # centres that differ by rounding alone are one place
    if not spread_a > 1e-12 * np.abs(x_a).max() or not spread_b > 1e-12 * np.abs(x_b).max():
        raise ValueError("all points are in one place: the scale is open")
    u, d, vt = np.linalg.svd(correlation)
    return _Moments(mean_a, mean_b, float(spread_a**2), correlation, d, u, vt, bool(d[1] <= _COLLINEAR**2 * d[0]))


def _similarity(m: _Moments, rotation: Array) -> Array:
    """Best scale and translation for a given rotation."""
    scale = float(np.sum(rotation * m.correlation)) / m.variance_a
    return from_parts(rotation, m.mean_b - scale * rotation @ m.mean_a, scale)


@dataclass(frozen=True)
class _Cameras:
    """Centres and orientations of the same cameras in two worlds."""

    center_a: Array
    center_b: Array
    b_from_a_rotation: Array
    extent_b: float

    @staticmethod
    def of(cam_from_a: Array, cam_from_b: Array) -> _Cameras:
        rotation = rigid3.rotation_matrix(cam_from_b).swapaxes(-1, -2) @ rigid3.rotation_matrix(cam_from_a)
        center_b = rigid3.center(cam_from_b)
        return _Cameras(rigid3.center(cam_from_a), center_b, rotation, float(np.ptp(center_b, axis=0).max(initial=0.0)))

    def subset(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> _Cameras:
        return _Cameras(self.center_a[index], self.center_b[index], self.b_from_a_rotation[index], self.extent_b)

    def residuals(self, b_from_a: Array) -> Array:
        lengths: Array = np.linalg.norm(self.center_b - apply(b_from_a, self.center_a), axis=1)
        return lengths


def _fit(cameras: _Cameras) -> tuple[Array, bool]:
    """Least squares over the centres; the twist about a line from the orientations."""
    m = _moments(cameras.center_a, cameras.center_b)
    if not m.is_collinear:
        b_from_a = _similarity(m, m.rotation)
        # per axis, with the seven parameters taken off the 3 N equations
        num_free = max(3 * len(cameras.center_a) - 7, 1)
        sigma = np.sqrt((cameras.residuals(b_from_a) ** 2).sum() / num_free)
        thickness = min(b_from_a[7] * _thickness(cameras.center_a), _thickness(cameras.center_b))
        if thickness > _SPREAD_OVER_RESIDUAL * sigma:
            return b_from_a, False
    return _similarity(m, _closest_about_axis(m.vt[0], m.u[:, 0], cameras.b_from_a_rotation.sum(0))), True


def _thickness(centers: Array) -> float:
    """Standard deviation of points across their longest axis, in the wider of the two directions."""
    return float(np.linalg.svd(centers - centers.mean(0), compute_uv=False)[1] / np.sqrt(len(centers)))


def _closest_about_axis(axis_a: Array, axis_b: Array, orientations: Array) -> Array:
    """Rotations (..., 3, 3) that map axis_a to axis_b (..., 3) and are else closest to a sum of rotations (..., 3, 3).

    With R = exp(phi [axis_b]) R0, trace(R^T M) = const + A cos phi + B sin phi.
    """
    rotation_0 = _frame(axis_b) @ _frame(axis_a).swapaxes(-1, -2)
    k = orientations @ rotation_0.swapaxes(-1, -2)
    cosine = np.trace(k, axis1=-2, axis2=-1) - np.einsum("...i,...ij,...j->...", axis_b, k, axis_b)
    sine = np.sum(rigid3.skew(axis_b) * k, axis=(-2, -1))
    return rigid3.exp_so3(np.arctan2(sine, cosine)[..., None] * axis_b) @ rotation_0


def _frame(axis: Array) -> Array:
    """Right-handed orthonormal bases (..., 3, 3) with the given unit vectors (..., 3) as their first columns."""
    helper = np.eye(3)[np.argmin(np.abs(axis), axis=-1)]
    second = np.cross(axis, helper)
    second /= np.linalg.norm(second, axis=-1, keepdims=True)
    return np.stack([axis, second, np.cross(axis, second)], axis=-1)


def _minimal_fits(cameras: _Cameras) -> list[tuple[float, Array]]:
    """The best fits to pairs of cameras by the median of their residuals, each with that median.

    The closed form of :func:`_closest_about_axis` for all pairs at once: two centres are a line.
    """
    count = len(cameras.center_a)
    if count * (count - 1) // 2 <= _MAX_SAMPLES:
        i, j = np.triu_indices(count, 1)
    else:
        i, j = np.random.default_rng([0, count]).integers(0, count, (2, _MAX_SAMPLES))
    step_a, step_b = cameras.center_a[j] - cameras.center_a[i], cameras.center_b[j] - cameras.center_b[i]
    length_a, length_b = np.linalg.norm(step_a, axis=1), np.linalg.norm(step_b, axis=1)
    # two cameras in one place
    good = (length_a > 1e-12 * np.abs(cameras.center_a).max()) & (length_b > 1e-12 * np.abs(cameras.center_b).max())
    i, j, scale = i[good], j[good], length_b[good] / length_a[good]
    axis_b = step_b[good] / length_b[good, None]
    orientations = cameras.b_from_a_rotation[i] + cameras.b_from_a_rotation[j]
    rotation = _closest_about_axis(step_a[good] / length_a[good, None], axis_b, orientations)
    middle_a, middle_b = cameras.center_a[i] + cameras.center_a[j], cameras.center_b[i] + cameras.center_b[j]
    translation = (middle_b - scale[:, None] * np.einsum("nij,nj->ni", rotation, middle_a)) / 2
    medians = np.array(
        [
            np.median(np.linalg.norm(cameras.center_b - (s * cameras.center_a @ r.T + t), axis=1))
            for r, t, s in zip(rotation, translation, scale, strict=True)
        ]
    )
    best = np.argsort(medians, kind="stable")[:_NUM_STARTS]
    return [(float(medians[k]), from_parts(rotation[k], translation[k], float(scale[k]))) for k in best]


def _concentrate(cameras: _Cameras, b_from_a: Array) -> tuple[float, Array]:
    """Fit again and again to the better half; returns the sum of squares of that half, and the fit."""
    half = len(cameras.center_a) // 2 + 1
    best = np.inf
    for _ in range(50):
        residuals = cameras.residuals(b_from_a)
        chosen = np.argsort(residuals, kind="stable")[:half]
        cost = float((residuals[chosen] ** 2).sum())
        if not cost < best * (1 - 1e-9):
            break
        best, kept = cost, b_from_a
        try:
            b_from_a = _fit(cameras.subset(chosen))[0]
        except ValueError:  # the better half stands in one place
            break
    return best, kept


def _within_robust_sigma(residuals: Array, extent: float) -> NDArray[np.bool_]:
    """Residuals below 2.5 robust standard deviations (Rousseeuw and Leroy 1987, with its small-sample factor).

    The centre errors are lengths in three dimensions: their median is 1.538 sigma per axis, and 2.5 sigma of a normal
    variable (1.2 % outside) correspond to 3.30 sigma of such a length.
    """
    sigma = (1 + 5 / max(len(residuals) - 3, 1)) * np.median(residuals) / 1.538
    # exact data: rounding must not make outliers
    return residuals <= max(3.30 * sigma, 1e-9 * extent)
