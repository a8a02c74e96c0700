"""Plane-induced and rotation-only maps between two views.

``x2 ~ H x1`` for homogeneous pixels (N, 2) float64.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3

Array = NDArray[np.float64]


def transfer_errors(homography: Array, xy1: Array, xy2: Array) -> Array:
    """(N,) squared distances between x2 and H x1 or x1 and H^-1 x2, whichever is larger, pixels squared.

    Taking the larger of the two keeps a zoom from making one direction look harmless. Infinite at and beyond the
    horizon of either map and for a singular H.
    """
    determinant = np.linalg.det(homography) if np.isfinite(homography).all() else 0.0
    if abs(determinant) < 1e-14 * np.linalg.norm(homography) ** 3:
        return np.full(len(xy1), np.inf)
    h = homography * np.sign(determinant)
    return np.maximum(_one_way(h, xy1, xy2), _one_way(np.linalg.inv(h), xy2, xy1))


def _one_way(h: Array, source: Array, target: Array) -> Array:
    mapped = source @ h[:, :2].T + h[:, 2]
    in_front = mapped[:, 2] > 0
    w = np.where(in_front, mapped[:, 2], 1.0)[:, None]
    return np.where(in_front, ((mapped[:, :2] / w - target) ** 2).sum(1), np.inf)


def poses_from_homography(homography: Array, k1: Array, k2: Array) -> Array:
    """(K, 7) poses cam2_from_cam1 with unit translation that a plane and H allow, K <= 4; none for a pure rotation.

    Malis and Vargas, "Deeper understanding of the homography decomposition", INRIA 6303, 2007, as in OpenCV.
    """
    import cv2

    _, rotations, translations, _ = cv2.decomposeHomographyMat(np.linalg.inv(k2) @ homography @ k1, np.eye(3))
    poses = []
    for rotation, translation in zip(rotations, translations, strict=True):
        norm = np.linalg.norm(translation)
        if norm > 1e-9 and np.linalg.det(rotation) > 0:
            poses.append(rigid3.from_matrix(rotation, translation[:, 0] / norm))
    return np.array(poses).reshape(-1, 7)


def rotation_from_rays(xn1: Array, xn2: Array, weights: Array) -> Array:
    """Rotation (3, 3) that best turns the rays of xn1 into those of xn2 (Kabsch 1976).

    Both are (N, 2) normalised image points, or (N, 3) unit rays.
    """
    a, b = xn1, xn2
    if xn1.shape[1] == 2:
        a = np.concatenate([xn1, np.ones((len(xn1), 1))], 1)
        b = np.concatenate([xn2, np.ones((len(xn2), 1))], 1)
        a /= np.linalg.norm(a, axis=1, keepdims=True)
        b /= np.linalg.norm(b, axis=1, keepdims=True)
    u, _, vt = np.linalg.svd((b * weights[:, None]).T @ a)
    rotation: Array = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rotation
