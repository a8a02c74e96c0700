"""Rigid motions in three dimensions as plain arrays.

A pose ``b_from_a`` is ``(..., 7)`` float64: quaternion x, y, z, w, then translation, with ``x_b = R x_a + t``.
Every function broadcasts over leading axes; :class:`Rigid3` is one such pose as a value. Quaternions and rotation
formulas follow Sola et al., "A micro Lie theory for state estimation in robotics", 2018, and Sola, "Quaternion
kinematics for the error-state Kalman filter", 2017.
"""

from __future__ import annotations

import math
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.errors import InputError

Array = NDArray[np.float64]

IDENTITY: Array = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


def skew(v: ArrayLike) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): ``skew(v) @ w == cross(v, w)``."""
    v = np.asarray(v, np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def rotation_matrix(pose_or_quaternion: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of poses (..., 7) or unit quaternions (..., 4), x y z w."""
    q = np.asarray(pose_or_quaternion, np.float64)
    # of one pose, in numbers of Python's: arrays of one number each take four times as long
    x, y, z, w = q[:4].tolist() if q.ndim == 1 else (q[..., 0], q[..., 1], q[..., 2], q[..., 3])
    out = np.empty((*q.shape[:-1], 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return out


def quaternion(rotation: ArrayLike) -> Array:
    """Unit quaternions (..., 4), x y z w with w >= 0, of rotation matrices (..., 3, 3).

    Shepperd's method: the largest of the four components is found first, so that nothing cancels.
    """
    m = np.asarray(rotation, np.float64)
    if m.ndim == 2:
        return _quaternion_of_one(m)
    trace = np.trace(m, axis1=-2, axis2=-1)
    # 4 q_i q_j, from sums and differences of the entries; row i is 4 q_i times the quaternion.
    products = np.empty((*m.shape[:-2], 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        products[..., i, i] = 1 + 2 * m[..., i, i] - trace
        products[..., i, j] = products[..., j, i] = m[..., j, i] + m[..., i, j]
        products[..., i, 3] = products[..., 3, i] = m[..., k, j] - m[..., j, k]
    products[..., 3, 3] = 1 + trace
    largest = np.argmax(np.diagonal(products, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    upper: Array = np.where(q[..., 3:] < 0, -q, q)
    return upper


def _quaternion_of_one(m: Array) -> Array:
    """The same of one matrix (3, 3), in numbers of Python's, to the same bits in an eighth of the time."""
    (a, b, c), (d, e, f), (g, h, i) = m.tolist()
    trace = a + e + i
    diagonal = (1 + 2 * a - trace, 1 + 2 * e - trace, 1 + 2 * i - trace, 1 + trace)
    largest = diagonal.index(max(diagonal))
    q = (
        (diagonal[0], d + b, g + c, h - f), (d + b, diagonal[1], h + f, c - g), (g + c, h + f, diagonal[2], d - b),
        (h - f, c - g, d - b, diagonal[3]),
    )[largest]  # fmt: skip
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    upper = np.array(q) / norm
    return -upper if upper[3] < 0 else upper


def from_matrix(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Poses (..., 7) of rotation matrices (..., 3, 3) and translations (..., 3)."""
    return np.concatenate([quaternion(rotation), np.asarray(translation, np.float64)], -1)


def to_matrix(b_from_a: ArrayLike) -> Array:
    """Matrices (..., 3, 4) of poses (..., 7): the rotation, and the translation as the last column."""
    pose = np.asarray(b_from_a, np.float64)
    return np.concatenate([rotation_matrix(pose), pose[..., 4:, None]], -1)


def compose(c_from_b: ArrayLike, b_from_a: ArrayLike) -> Array:
    """``c_from_a``: first the second argument, then the first; read as fractions that cancel."""
    left, right = np.asarray(c_from_b, np.float64), np.asarray(b_from_a, np.float64)
    rotation = rotation_matrix(left) @ rotation_matrix(right)
    return from_matrix(rotation, apply(left, right[..., 4:]))


def inverse(b_from_a: ArrayLike) -> Array:
    """``a_from_b``."""
    pose = np.asarray(b_from_a, np.float64)
    q = pose[..., :4] * np.array([-1.0, -1.0, -1.0, 1.0])
    translation = -np.einsum("...ij,...j->...i", rotation_matrix(q), pose[..., 4:])
    return np.concatenate([q, translation], -1)


def apply(b_from_a: ArrayLike, x_a: ArrayLike) -> Array:
    """Points (..., 3) moved from frame a to frame b."""
    pose = np.asarray(b_from_a, np.float64)
    moved: Array = np.einsum("...ij,...j->...i", rotation_matrix(pose), np.asarray(x_a, np.float64)) + pose[..., 4:]
    return moved


def center(cam_from_world: ArrayLike) -> Array:
    """Camera centres (..., 3) in the world: ``-R^T t``."""
    return inverse(cam_from_world)[..., 4:]


def center_jacobian(cam_from_world: ArrayLike) -> Array:
    """(..., 3, 6) how the centres of cameras move in the world with their poses (..., 7): with the rotation w and the
    translation v of ``x_cam <- exp(w) x_cam + v``, ``-R^T t`` moves by ``-R^T v``."""
    turn = np.swapaxes(rotation_matrix(cam_from_world), -1, -2)
    return np.concatenate([np.zeros_like(turn), -turn], -1)


def center_covariance(cam_from_world: ArrayLike, covariance: ArrayLike) -> Array:
    """Covariances (..., 3, 3) of camera centres, in the world, of those of poses (..., 6, 6) over (w, v) as above."""
    jacobian = center_jacobian(cam_from_world)
    out: Array = jacobian @ np.asarray(covariance, np.float64) @ np.swapaxes(jacobian, -1, -2)
    return out


def spread(cam_from_world: ArrayLike) -> float:
    """Root mean square distance of the camera centres of poses (N, 7) from their middle."""
    centers = center(cam_from_world)
    return float(np.sqrt(((centers - centers.mean(0)) ** 2).sum(1).mean()))


def exp_so3(w: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians (Rodrigues)."""
    w = np.asarray(w, np.float64)
    angle2 = np.sum(w * w, -1)
    angle = np.sqrt(angle2)
    small = angle2 < 1e-12
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1 - angle2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle2 / 24, (1 - np.cos(safe)) / safe**2)
    k = skew(w)
    rotation: Array = np.eye(3) + a[..., None, None] * k + b[..., None, None] * (k @ k)
    return rotation


def log_so3(rotation: ArrayLike) -> Array:
    """Rotation vectors (..., 3) in radians, of norm at most pi, of rotation matrices (..., 3, 3)."""
    q = quaternion(rotation)
    norm = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    half = np.arctan2(norm, q[..., 3:])
    # sin(x)/x by its series near zero, where the quotient would lose its digits
    factor = np.where(norm < 1e-8, 2.0 / np.maximum(q[..., 3:], 0.5), 2 * half / np.where(norm < 1e-8, 1.0, norm))
    return factor * q[..., :3]


def interpolate(first: ArrayLike, last: ArrayLike, share: ArrayLike) -> Array:
    """Poses (..., 7) a share (...) of the way from ``first`` (..., 7) to ``last``: centres on a line, rotations about a
    fixed axis at a steady rate."""
    share = np.asarray(share, np.float64)[..., None]
    start = rotation_matrix(first)
    turn = log_so3(rotation_matrix(last) @ start.swapaxes(-1, -2))
    rotation = exp_so3(share * turn) @ start
    centers = (1 - share) * center(first) + share * center(last)
    return from_matrix(rotation, -(rotation @ centers[..., None])[..., 0])


def rotation_angle_deg(rotation: ArrayLike) -> Array:
    """Angles (...) in degrees, 0 to 180, of rotation matrices (..., 3, 3)."""
    angle: Array = np.degrees(np.linalg.norm(log_so3(rotation), axis=-1))
    return angle


class Rigid3:
    """A rigid motion ``b_from_a``, ``x_b = R x_a + t``: one pose of the arrays that everything here works on.

    It goes wherever an array of shape (7,) does, as ``numpy.asarray(pose)`` gives that; ``c_from_b @ b_from_a`` is the
    one after the other, ``b_from_a @ points`` moves points (..., 3). It cannot be changed.

    Args:
        pose: (7,) quaternion x, y, z, w, then translation. A quaternion that is not of unit length is scaled to it.

    Raises:
        InputError: another shape, NaN or infinity, or a quaternion of length zero.

    Example:
        >>> cam_from_world = sfmapp.Rigid3.from_matrix(R, t)
        >>> cam_from_world.center  # of the camera in the world: -R^T t
        >>> x_cam = cam_from_world @ x_world
    """

    __slots__ = ("_pose",)

    def __init__(self, pose: ArrayLike) -> None:
        values = np.array(pose, np.float64)
        if values.shape != (7,) or not np.isfinite(values).all() or not values[:4].any():
            raise InputError(
                f"pose: expected a quaternion x, y, z, w and a translation, 7 finite numbers, found {values}"
            )
        length = float(np.linalg.norm(values[:4]))
        if abs(length - 1.0) > 1e-12:
            values[:4] /= length
        values.setflags(write=False)
        self._pose = values

    @classmethod
    def identity(cls) -> Rigid3:
        """No motion."""
        return cls(IDENTITY)

    @classmethod
    def from_matrix(cls, rotation: ArrayLike, translation: ArrayLike | None = None) -> Rigid3:
        """The motion of a rotation matrix (3, 3) and a translation (3,), or of both in one matrix (3, 4) or (4, 4).

        Raises:
            InputError: another shape, or no rotation: its columns are not orthonormal to 1e-3, or it is a reflection.
        """
        matrix = np.array(rotation, np.float64)
        if translation is None and matrix.shape in ((3, 4), (4, 4)):
            matrix, translation = matrix[:3, :3], matrix[:3, 3]
        moved = np.zeros(3) if translation is None else np.asarray(translation, np.float64)
        if matrix.shape != (3, 3) or moved.shape != (3,):
            raise InputError(
                "pose: expected a rotation (3, 3) and a translation (3,), or one matrix (3, 4) or (4, 4), found "
                f"{matrix.shape} and {moved.shape}"
            )
        if not np.allclose(matrix.T @ matrix, np.eye(3), atol=1e-3) or np.linalg.det(matrix) < 0:
            raise InputError("pose: expected a rotation matrix, found one that is not orthonormal or mirrors")
        return cls(from_matrix(matrix, moved))

    @property
    def quaternion(self) -> Array:
        """(4,) x, y, z, w."""
        return self._pose[:4]

    @property
    def translation(self) -> Array:
        """(3,) t: where the origin of a lies in b."""
        return self._pose[4:]

    @property
    def rotation(self) -> Array:
        """(3, 3) R."""
        return rotation_matrix(self._pose)

    @property
    def matrix(self) -> Array:
        """(4, 4) for homogeneous coordinates."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.rotation, self.translation
        return out

    @property
    def center(self) -> Array:
        """(3,) where the origin of b lies in a: the camera centre of a pose ``cam_from_world``."""
        return center(self._pose)

    def inverse(self) -> Rigid3:
        """``a_from_b``."""
        return Rigid3(inverse(self._pose))

    @overload
    def __matmul__(self, other: Rigid3) -> Rigid3: ...
    @overload
    def __matmul__(self, other: ArrayLike) -> Array: ...
    def __matmul__(self, other: Rigid3 | ArrayLike) -> Rigid3 | Array:
        if isinstance(other, Rigid3):
            return Rigid3(compose(self._pose, other._pose))
        return apply(self._pose, other)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self._pose, dtype) if copy or dtype is not None else self._pose

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Rigid3) and np.array_equal(self._pose, other._pose)

    def __hash__(self) -> int:
        return hash(self._pose.tobytes())

    def __repr__(self) -> str:
        q, t = (" ".join(f"{value:.6g}" for value in part) for part in (self.quaternion, self.translation))
        return f"Rigid3(quaternion xyzw {q}, translation {t})"
