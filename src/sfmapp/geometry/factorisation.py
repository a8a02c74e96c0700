"""Cameras and points in a projective frame from many views at once: the measurement matrix has rank four.

Sturm and Triggs, "A factorization based algorithm for multi-image projective structure and motion", ECCV 1996; HZ 18.2
(Hartley and Zisserman, "Multiple View Geometry", 2004).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry.dlt import homogeneous
from sfmapp.geometry.fit import FitInfo
from sfmapp.geometry.homography import fit_homography, transfer_errors
from sfmapp.geometry.projective import project
from sfmapp.geometry.projective_adjustment import ProjectiveModel

Array = NDArray[np.float64]

MIN_POINTS = 8
"""Of a frame that more than one choice of depths would not fit: F of two views takes as many."""

_CONVERGED, _ROUNDING = 1e-6, 1e-13
_OFF_PLANE = 90.0


def factorise(
    xy: ArrayLike, *, depths: ArrayLike | None = None, max_iterations: int = 200
) -> tuple[ProjectiveModel, FitInfo]:
    """Factorise N points that V views all see: ``depth x = P X`` for all of them, of rank four.

    Depths and factors in turn: the nearest matrix of rank four, then the depths that it has. The measurement matrix is
    balanced in between, columns and triples of rows to unit norm, without which the depths run to where few rows count.

    Args:
        xy: (N, V, 2) pixels, all finite, N >= 8 and V >= 2.
        depths: (N, V) to begin with: of a chain of fundamental matrices, for one (:func:`depths_of_chain`). None: 1,
            which is right for affine cameras, and near for distant ones.

    Returns:
        Cameras and points in a projective frame. ``condition`` is the first singular value over the fourth, and
        ``singular_values`` has five: the fifth is what noise leaves. ``num_free`` is above 1 where homographies
        explain as much: the points lie in a plane, or the cameras in one place.

    Raises:
        ValueError: a point that is not seen everywhere, or fewer points or views than that.
    """
    pixels = np.asarray(xy, np.float64)
    if pixels.ndim != 3 or pixels.shape[2] != 2:
        raise ValueError(f"factorisation takes pixels (N, V, 2), got {pixels.shape}")
    num_points, num_views = pixels.shape[:2]
    if num_points < MIN_POINTS or num_views < 2:
        raise ValueError(
            f"factorisation takes at least {MIN_POINTS} points in 2 views, got {num_points} points in {num_views}"
        )
    if not np.isfinite(pixels).all():
        missing = int((~np.isfinite(pixels).all(2)).sum())
        raise ValueError(
            f"factorisation takes points that every view has seen, {missing} of {num_points * num_views} are missing"
        )
    middle = pixels.reshape(-1, 2).mean(0)
    scale = math.sqrt(2.0) / max(float(np.sqrt(((pixels - middle) ** 2).sum(2).mean())), 1e-300)
    rays = homogeneous((pixels - middle) * scale)
    depth = np.ones((num_points, num_views)) if depths is None else np.array(depths, np.float64)
    if depth.shape != (num_points, num_views) or not np.isfinite(depth).all():
        raise ValueError(f"depths are to be finite, of shape {(num_points, num_views)}; got {depth.shape}")
    before, taken = math.inf, 0
    u, s, vt = np.zeros((0, 4)), np.zeros(5), np.zeros((4, 0))
    while taken < max_iterations:
        taken += 1
        depth = _balanced(rays, depth)
        measured = (depth[..., None] * rays).reshape(num_points, -1).T
        u, s, vt = np.linalg.svd(measured, full_matrices=False)
        rank_four = ((u[:, :4] * s[:4]) @ vt[:4]).T.reshape(num_points, num_views, 3)
        left = float(np.sqrt((s[4:] ** 2).sum() / (s**2).sum()))
        if left < _ROUNDING or (math.isfinite(before) and before - left <= _CONVERGED * before):
            break
        before = left
        depth = (rank_four * rays).sum(2) / (rays**2).sum(2)
    cameras = (u[:, :4] * s[:4]).reshape(num_views, 3, 4)
    back = np.array([[1 / scale, 0, middle[0]], [0, 1 / scale, middle[1]], [0, 0, 1.0]])
    cameras = back @ cameras
    points = vt[:4].T
    values = s[:5] if len(s) > 4 else np.append(s, 0.0)
    rms_px = float(np.sqrt(np.nanmean((project(cameras, points) - pixels) ** 2)))
    is_open = _homographies_fit(pixels, rms_px, scale)
    info = FitInfo(
        np.ones(num_points, np.bool_), taken, float(values[0] / max(values[3], 1e-300)), values, 2 if is_open else 1
    )
    return ProjectiveModel(
        cameras / np.linalg.norm(cameras, axis=(1, 2), keepdims=True),
        points / np.linalg.norm(points, axis=1, keepdims=True),
    ), info


def _homographies_fit(pixels: Array, left_px: float, scale: float) -> bool:
    """Whether maps from the first view to each other explain the points as well as cameras do: rank three."""
    squared = []
    for view in range(1, pixels.shape[1]):
        h = fit_homography(pixels[:, 0], pixels[:, view])[0]
        # what stands off a plane may be one in ten of what is seen
        squared.append(
            float(np.percentile(transfer_errors(h, pixels[:, 0], pixels[:, view]), _OFF_PLANE, method="nearest"))
        )
    return math.sqrt(max(squared)) <= 3.0 * left_px + 1e-9 / scale


def _balanced(rays: Array, depth: Array) -> Array:
    """Depths (N, V) times factors of points and views that make every point and every view of one size."""
    for _ in range(3):
        weighted = depth**2 * (rays**2).sum(2)
        depth = depth / np.sqrt(weighted.sum(1, keepdims=True))
        weighted = depth**2 * (rays**2).sum(2)
        depth = depth / np.sqrt(weighted.sum(0, keepdims=True))
    return depth


def depths_of_chain(xy: Array, fundamentals: Array) -> Array:
    """(N, V) depths of points through a chain of views, each by F from the view before it (Sturm and Triggs, eq. 3).

    Args:
        xy: (N, V, 2) pixels. fundamentals: (V - 1, 3, 3), ``x_(v+1)^T F x_v = 0``.
    """
    x = homogeneous(np.asarray(xy, np.float64))
    depths = np.ones(x.shape[:2])
    for v, f in enumerate(fundamentals):
        e = np.linalg.svd(f)[0][:, 2]
        line = x[:, v] @ f.T
        across = np.cross(np.broadcast_to(e, line.shape), x[:, v + 1])
        squared = (across**2).sum(1)
        depths[:, v + 1] = depths[:, v] * (across * line).sum(1) / np.maximum(squared, 1e-300)
        depths[:, v + 1] /= np.median(np.abs(depths[:, v + 1]))
    return depths
