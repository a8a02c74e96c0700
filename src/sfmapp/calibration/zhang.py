"""A first camera and first poses from views of planes: normalised DLT, and Zhang's closed form.

Z. Zhang, "A flexible new technique for camera calibration", PAMI 22(11), 2000; the row of the system is that of its
equation 8, v_ij = (h_i1 h_j1, h_i1 h_j2 + h_i2 h_j1, h_i2 h_j2, h_i3 h_j1 + h_i1 h_j3, h_i3 h_j2 + h_i2 h_j3,
h_i3 h_j3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.adjustment import TargetView
from sfmapp.camera.camera import Camera, pixels_to_rays
from sfmapp.geometry import rigid3
from sfmapp.geometry.dlt import find_homography, homogeneous

Array = NDArray[np.float64]

# A direction of the system that views hold no better than this many times the noise of their homographies is not held.
_HELD = 5.0


@dataclass(frozen=True)
class ClosedForm:
    """What Zhang's linear system says.

    Attributes:
        k_matrix: (3, 3) calibration matrix; None where it has no solution with positive focal lengths.
        rank: directions of the six unknowns that the views hold; five are needed.
        singular_values: (6,) of the system, of the largest.
    """

    k_matrix: Array | None
    rank: int
    singular_values: Array


def closed_form(views: Sequence[TargetView], size: tuple[int, int], *, has_skew: bool = False) -> ClosedForm:
    """K from B = K^-T K^-1, which every homography constrains twice.

    Args:
        views: of planes, z of their points is not looked at.
        size: of the pictures; the unknowns are scaled by it, so that singular values can be compared.
        has_skew: False adds the equation that there is none.
    """
    scale = np.array([[2.0 / max(size), 0.0, -size[0] / max(size)], [0.0, 2.0 / max(size), -size[1] / max(size)],
                      [0.0, 0.0, 1.0]])  # fmt: skip
    rows, noise = [], []
    for view in views:
        h = find_homography(view.xyz[:, :2], view.xy)
        mapped = view.xyz[:, :2] @ h[:, :2].T + h[:, 2]
        error = np.sqrt(((mapped[:, :2] / mapped[:, 2:] - view.xy) ** 2).sum(1).mean())
        noise.append(2.0 * error / max(size) / np.sqrt(len(view.xy)))
        # the plane's own unit has no part in it
        extent = float(np.sqrt(((view.xyz - view.xyz.mean(0)) ** 2).sum(1).mean()))
        g = scale @ h @ np.diag([extent, extent, 1.0])
        g = g / np.linalg.norm(g[:, :2]) * np.sqrt(2.0)
        rows += [_row(g, 0, 1), _row(g, 0, 0) - _row(g, 1, 1)]
    if not has_skew:
        rows.append(np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0]) * len(views))
    _, values, vt = np.linalg.svd(np.array(rows), full_matrices=False)
    values = np.concatenate([values, np.zeros(6 - len(values))])
    # numerical noise bounds it from below where corners are exact
    least = max(_HELD * float(np.median(noise)) * np.sqrt(len(views)), 1e-9)
    return ClosedForm(_k_from_b(vt[-1], np.linalg.inv(scale)), int((values > least).sum()), values / values[0])


def _row(h: Array, i: int, j: int) -> Array:
    a, b = h[:, i], h[:, j]
    return np.array([
        a[0] * b[0], a[0] * b[1] + a[1] * b[0], a[1] * b[1],
        a[2] * b[0] + a[0] * b[2], a[2] * b[1] + a[1] * b[2], a[2] * b[2],
    ])  # fmt: skip


def _k_from_b(b: Array, unscale: Array) -> Array | None:
    """K of the six numbers of B, which are known up to a factor: the inverse of its Cholesky root."""
    matrix = np.array([[b[0], b[1], b[3]], [b[1], b[2], b[4]], [b[3], b[4], b[5]]])
    matrix = matrix if matrix[0, 0] > 0 else -matrix
    try:
        root = np.linalg.inv(np.linalg.cholesky(matrix).T)
    except np.linalg.LinAlgError:
        return None
    k: Array = unscale @ root
    found: Array = k / k[2, 2]
    return found


def plane_poses(camera: Camera, views: Sequence[TargetView]) -> Array:
    """(V, 7) cam_from_target of planes z = 0, from pixels of any lens; NaN where there is none in front of it.

    The DLT of unit rays d, which may point anywhere: d x H (X, Y, 1) = 0; the two columns that are rotation are brought
    onto SO(3) by SVD. As |d x v|^2 = v^T (I - d d^T) v, the normal equations of a view are sums of products of two
    symmetric matrices, which are made for all views at once.
    """
    if not views:
        return np.zeros((0, 7))
    counts = np.array([len(view.xy) for view in views])
    starts = np.cumsum(counts) - counts
    d = pixels_to_rays(camera, np.concatenate([view.xy for view in views]))
    is_known = np.isfinite(d[:, 0]) & np.isfinite(d[:, 1]) & np.isfinite(d[:, 2])
    d = np.where(is_known[:, None], d, 0.0)
    # places on the plane about their middle, in units of their spread
    p = np.concatenate([view.xyz[:, :2] for view in views])
    middle = np.add.reduceat(p, starts) / counts[:, None]
    p = p - np.repeat(middle, counts, axis=0)
    spread = np.sqrt(np.add.reduceat((p**2).sum(1), starts) / (2.0 * counts))
    spread = np.where(spread > 0, spread, 1.0)
    p = homogeneous(p / np.repeat(spread, counts)[:, None])
    normalize = np.zeros((len(views), 3, 3))
    normalize[:, 0, 0] = normalize[:, 1, 1] = 1.0 / spread
    normalize[:, :2, 2], normalize[:, 2, 2] = -middle / spread[:, None], 1.0
    i, j = np.triu_indices(3)
    off = (is_known[:, None, None] * np.eye(3) - d[:, :, None] * d[:, None, :])[:, i, j]
    both = np.add.reduceat(off[:, :, None] * (p[:, i] * p[:, j])[:, None, :], starts)
    place = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    squares = both[:, place[:, None, :, None], place[None, :, None, :]].reshape(-1, 9, 9)
    h = np.linalg.eigh(squares)[1][:, :, 0].reshape(-1, 3, 3)
    along = np.add.reduceat(d[:, :, None] * p[:, None, :], starts)
    h = np.where((h * along).sum(axis=(1, 2), keepdims=True) < 0, -h, h) @ normalize
    with np.errstate(divide="ignore", invalid="ignore"):
        h = h / np.sqrt(np.linalg.norm(h[:, :, 0], axis=1) * np.linalg.norm(h[:, :, 1], axis=1))[:, None, None]
    num_known = np.add.reduceat(is_known.astype(np.int64), starts)
    is_found = (num_known >= 4) & np.isfinite(h.reshape(-1, 9)).all(axis=1)
    h[~is_found] = np.eye(3)
    u, _, vt = np.linalg.svd(np.stack([h[:, :, 0], h[:, :, 1], np.cross(h[:, :, 0], h[:, :, 1])], 2))
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    poses: Array = np.where(is_found[:, None], rigid3.from_matrix(u @ vt, h[:, :, 2]), np.nan)
    return poses
