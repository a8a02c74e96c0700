"""Reconstructions without a calibration: cameras from F, points in a projective frame, what such a frame still says.

Cameras are (V, 3, 4) and points (N, 4), both up to scale; ``P X`` are the homogeneous pixels. For every invertible
(4, 4) G the cameras ``P G^-1`` see the points ``G X`` in the same pixels: nothing in the pixels chooses between them.
What a plane or F say of one picture in another uses no frame at all. HZ stands for Hartley and Zisserman, "Multiple
View Geometry", 2004.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.dlt import homogeneous, projection_rows
from sfmapp.geometry.fit import FitInfo, count_free, matched_points
from sfmapp.geometry.fundamental import epipoles

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_POINTS = 6
"""Of a resection: eleven unknowns, two equations each."""

# Singular values of F that a matrix of rank two has: rounding leaves the last at 1e-16 of the first
_RANK_TWO = 1e-6
# what is left of the middle one if points of a line, or one picture twice, made F
_RANK_ONE = 1e-12
# below this share of a unit vector a homogeneous coordinate is rounding
_ROUNDING = 1e-13
# points of a plane have a direction without scatter: stretched further, rounding would fill it
_FLATTEST = 1e-8


def canonical_cameras(
    fundamental: ArrayLike, plane: ArrayLike = (0.0, 0.0, 0.0), baseline: float = 1.0
) -> tuple[Array, Array]:
    """``[I | 0]`` and ``[[e2]x F + e2 v^T | b e2]``: a pair of cameras that F allows, one of its family (HZ 9.15).

    Args:
        fundamental: (3, 3) of rank two, x2^T F x1 = 0.
        plane: (3,) v, and ``baseline`` b, not 0: the four numbers that two pictures leave open when the first camera is
            [I | 0]. v moves the plane that the first three columns are the map of.

    Returns:
        Two (3, 4). The whole family is these times any (4, 4).

    Raises:
        ValueError: an F that is not finite or not of rank two, or a baseline of 0.
    """
    f = np.asarray(fundamental, np.float64)
    if f.shape != (3, 3) or not np.isfinite(f).all():
        raise ValueError(f"cameras take a finite F (3, 3), got {f.tolist()}")
    values = np.linalg.svd(f, compute_uv=False)
    if not values[1] > _RANK_ONE * values[0] or values[2] > _RANK_TWO * values[0]:
        found = ", ".join(f"{value:.2g}" for value in values)
        raise ValueError(f"cameras take an F of rank two, got one with the singular values {found}")
    if not math.isfinite(baseline) or baseline == 0.0:
        raise ValueError("the baseline of two cameras is any number but 0: without one, they have one centre and no F")
    e2 = epipoles(f)[1]
    first = np.eye(3, 4)
    second = np.column_stack([
        rigid3.skew(e2) @ (f / values[0]) + np.outer(e2, np.asarray(plane, np.float64)), baseline * e2
    ])  # fmt: skip
    return first, second


def in_frame(cameras: Array, points: Array, frame: Array) -> tuple[Array, Array]:
    """A reconstruction in another projective frame: cameras ``P G^-1`` (V, 3, 4) and points ``G X`` (N, 4), each of
    unit norm; G is (4, 4)."""
    moved = cameras @ np.linalg.inv(frame)
    turned = points @ frame.T
    return (
        moved / np.linalg.norm(moved, axis=(-2, -1), keepdims=True),
        turned / np.linalg.norm(turned, axis=-1, keepdims=True),
    )


def dehomogenized(points: Array) -> Array:
    """(N, D) of homogeneous (N, D + 1); NaN at infinity."""
    last = points[..., -1:]
    size = np.linalg.norm(points, axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        finite: Array = np.where(np.abs(last) > _ROUNDING * size, points[..., :-1] / last, np.nan)
    return finite


def project(cameras: Array, points: Array) -> Array:
    """(N, V, 2) pixels of points (N, 4) in cameras (V, 3, 4); NaN in a camera's own plane."""
    return dehomogenized(np.einsum("vij,nj->nvi", cameras, points))


def triangulate_views(cameras: Array, xy: ArrayLike) -> tuple[Array, FitInfo]:
    """Points from their pixels in two views or more, in any projective frame: homogeneous, by SVD under |X| = 1.

    Args:
        cameras: (V, 3, 4). xy: (N, V, 2) pixels, NaN where a point was not seen.

    Returns:
        (N, 4) of unit norm, NaN for what fewer than two views saw or one line of sight leaves open; the inliers are the
        others. The minimum is algebraic: :func:`sfmapp.geometry.projective_adjustment.adjust_projective` has that of
        the reprojection error.

    Raises:
        ValueError: of another shape.
    """
    pixels = np.asarray(xy, np.float64)
    if pixels.ndim != 3 or pixels.shape[1:] != (len(cameras), 2):
        raise ValueError(f"triangulation takes pixels (N, {len(cameras)}, 2), got {pixels.shape}")
    # each camera of unit norm, and pixels about their middle: rows of one size in the whole system
    middle = np.nanmean(pixels.reshape(-1, 2), 0)
    scale = float(np.sqrt(np.nanmean((pixels - middle) ** 2)))
    about = np.array([[1 / scale, 0, -middle[0] / scale], [0, 1 / scale, -middle[1] / scale], [0, 0, 1.0]])
    normal = about @ cameras
    normal = normal / np.linalg.norm(normal, axis=(1, 2), keepdims=True)
    rows = ((pixels - middle) / scale)[..., None] * normal[:, None, 2] - normal[:, :2]
    is_seen = np.isfinite(rows).all((2, 3))
    rows = np.where(is_seen[:, :, None, None], rows, 0.0).reshape(len(pixels), -1, 4)
    _, values, vt = np.linalg.svd(rows, full_matrices=rows.shape[1] < 4)
    is_known = (is_seen.sum(1) >= 2) & (values[:, 2] > 1e-12 * values[:, 0])
    found = np.where(is_known[:, None], vt[:, 3], np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        condition = float(np.median(values[is_known, 0] / values[is_known, 2])) if is_known.any() else math.inf
    return found, FitInfo(is_known, 1, condition, np.zeros(0), 1)


def resect_projective(
    points: ArrayLike, xy: ArrayLike, *, threshold_px: float | None = None, seed: int = 0, max_trials: int = 400
) -> tuple[Array, FitInfo]:
    """Camera of points in a projective frame, by the direct linear transform.

    Points are whitened first, in four dimensions: their frame has no distances that could be normalised.

    Args:
        points: (N, 4), N >= 6. xy: (N, 2) pixels.
        threshold_px: some points may be wrong: samples of six, and what lies within this many pixels of the best;
            None: all of them count.
        seed: the same draws the same samples.

    Returns:
        (3, 4) of unit norm and what is known of it; ``num_free`` is above 1 for points of a plane.

    Raises:
        ValueError: fewer than six points, or some that are not finite.
    """
    x, pixels = np.asarray(points, np.float64), np.asarray(xy, np.float64)
    if x.ndim != 2 or x.shape[1] != 4 or pixels.shape != (len(x), 2):
        raise ValueError(f"a resection takes points (N, 4) and pixels (N, 2), got {x.shape} and {pixels.shape}")
    if len(x) < MIN_POINTS:
        raise ValueError(f"a resection takes at least {MIN_POINTS} points, got {len(x)}")
    if not (np.isfinite(x).all() and np.isfinite(pixels).all()):
        raise ValueError("a resection takes points and pixels that are finite")
    middle, scale = pixels.mean(0), float(max(pixels.std(), 1e-300))
    whitening = whitening_of(x)
    white = x @ whitening.T
    white /= np.linalg.norm(white, axis=1, keepdims=True)
    rows = projection_rows(white, (pixels - middle) / scale).reshape(len(x), 2, 12)
    is_inlier, taken = np.ones(len(x), np.bool_), 1
    if threshold_px is not None:
        limit = threshold_px / scale
        is_inlier, taken = _most_inliers(rows, white, (pixels - middle) / scale, limit, max_trials, seed)
        if is_inlier.sum() < MIN_POINTS:
            return np.full((3, 4), np.nan), FitInfo(is_inlier, taken, math.nan, np.zeros(0), 0)
    chosen = rows[is_inlier].reshape(-1, 12)
    _, values, vt = np.linalg.svd(chosen, full_matrices=len(chosen) < 12)
    left = chosen @ vt[11]
    sigma = float(np.linalg.norm(left)) / math.sqrt(max(len(chosen) - 11, 1))  # one is left of six points
    noise = np.full(12, sigma * math.sqrt(len(chosen)) + 1e-12 * values[0])
    about = np.array([[scale, 0, middle[0]], [0, scale, middle[1]], [0, 0, 1.0]])
    camera = about @ vt[11].reshape(3, 4) @ whitening
    info = FitInfo(
        is_inlier, taken, float(values[0] / max(values[10], 1e-300)), values, max(count_free(values, noise), 1)
    )
    return camera / np.linalg.norm(camera), info


def whitening_of(points: Array) -> Array:
    """(4, 4) that makes the scatter of points (N, 4), each of unit norm, a multiple of the identity: what normalising
    is in a frame that has no distances."""
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(unit.T @ unit / len(unit))
    whitening: Array = (vectors / np.sqrt(np.maximum(values, _FLATTEST * values[-1]))).T
    return whitening


def _most_inliers(rows: Array, points: Array, xy: Array, limit: float, max_trials: int, seed: int) -> tuple[Mask, int]:
    """Of cameras through samples of six: the points that the best has, by the truncated square of what is left."""
    rng = np.random.default_rng([seed, len(points)])
    samples = rng.random((max_trials, len(points))).argpartition(MIN_POINTS - 1, axis=1)[:, :MIN_POINTS]
    found = np.linalg.svd(rows[samples].reshape(max_trials, 12, 12))[2][:, 11].reshape(-1, 3, 4)
    best, inlier = math.inf, np.zeros(len(points), np.bool_)
    for squared in (((project(found, points) - xy[:, None]) ** 2).sum(2)).T:
        kept = np.nan_to_num(squared, nan=np.inf)
        cost = float(np.minimum(kept, limit**2).sum())
        if cost < best:
            best, inlier = cost, kept < limit**2
    return inlier, max_trials


@dataclass(frozen=True)
class PlaneParallax:
    """Where points stand against a plane, from two pictures without a calibration.

    Attributes:
        parallax: (N,) kappa of ``x2 ~ H x1 + kappa e2``, the last coordinate of H x1 being positive: the distance from
            the plane over the depth, up to a factor that all points share. Its sign is that of the side.
        sigmas: (N,) standard deviation of each for the noise given; NaN without.
        is_known: (N,) bool: the point is not at the epipole, where every parallax looks alike.
        left_px: (N,) distance from x2 to its epipolar line.
    """

    parallax: Array
    sigmas: Array
    is_known: Mask
    left_px: Array

    def sides(self, sigmas: float = 3.0) -> NDArray[np.int64]:
        """(N,) 1 and -1 for the two sides of the plane, 0 for points that are on it as far as can be told.

        Which is the nearer side follows from a point of known side, or from the motion: where e2 has the sign of
        K2 t, its third coordinate negative for a camera that went forward, a positive parallax lies on camera 1's side
        of the plane.
        """
        limit = np.where(np.isfinite(self.sigmas), sigmas * self.sigmas, 0.0)
        signs: NDArray[np.int64] = np.where(np.abs(self.parallax) > limit, np.sign(self.parallax), 0.0).astype(np.int64)
        return np.where(self.is_known, signs, 0)


def plane_parallax(
    homography: Array, epipole2: Array, xy1: ArrayLike, xy2: ArrayLike, noise_px: float | None = None
) -> PlaneParallax:
    """Parallax relative to a plane (Shashua and Navab, PAMI 1996; HZ 13.3).

    With the plane ``n^T X = d`` in the frame of camera 1, ``H = K2 (R + t n^T / d) K1^-1`` and ``e2 = K2 t`` it is
    ``(d - n^T X) / (d Z)``: 1 / Z for a plane at infinity, and of two points at one depth it has the ratio of their
    distances from the plane.

    Args:
        homography: (3, 3) of the plane, x2 ~ H x1. epipole2: (3,) homogeneous, in picture 2, with the sign of K2 t.
        xy1, xy2: (N, 2) matched pixels. noise_px: standard deviation of a coordinate.

    Raises:
        ValueError: points that are not finite, or no points.
    """
    a, b = matched_points(xy1, xy2, 1, "parallax against a plane")
    mapped = homogeneous(a) @ (homography / np.linalg.norm(homography)).T
    mapped = mapped * np.where(np.median(mapped[:, 2]) < 0.0, -1.0, 1.0)
    e = epipole2 / np.linalg.norm(epipole2)
    # what moves x2 from where the plane has it: mapped + kappa e, cross x2, along the epipolar line
    along = e[:2] - b * e[2]
    toward = b * mapped[:, 2:] - mapped[:, :2]
    squared = (along**2).sum(1)
    is_known = squared > (1e-9 * (1.0 + np.abs(b).max())) ** 2
    safe = np.where(is_known, squared, 1.0)
    parallax = np.where(is_known, (along * toward).sum(1) / safe, np.nan)
    across = np.stack([-along[:, 1], along[:, 0]], 1) / np.sqrt(safe)[:, None]
    depth = mapped[:, 2] + np.where(is_known, parallax, 0.0) * e[2]
    left = np.abs((across * toward).sum(1)) / np.maximum(np.abs(depth), 1e-300)
    sigmas = np.full(len(a), np.nan)
    if noise_px is not None:
        unit = along / np.sqrt(safe)[:, None]
        # by x2, and by x1 through H
        h = homography / np.linalg.norm(homography)
        slopes = h[:2, :2] - b[:, :, None] * h[2, :2]
        by_first = np.linalg.norm(np.einsum("ni,nij->nj", unit, slopes), axis=1)
        sigmas = noise_px * np.hypot(depth, by_first) / np.sqrt(safe)
    return PlaneParallax(parallax, sigmas, np.asarray(is_known, np.bool_), left)


def steps_to_contact(xy1: ArrayLike, xy2: ArrayLike, epipole: Array, noise_px: float) -> tuple[Array, Array]:
    """How many more steps like the last one lead a camera that does not turn into each point's own depth.

    Without turning, points run straight from the epipole, which is where the camera goes, and
    ``|x2 - e| / |x1 - e| = Z1 / Z2``: contact is ``Z2 / (Z1 - Z2)`` steps away, whatever K is.

    Args:
        xy1, xy2: (N, 2) matched pixels. epipole: (2,) pixels, the same in both pictures. noise_px: of a coordinate.

    Returns:
        (N,) steps, infinite where nothing comes nearer and negative where it recedes; and (N,) standard deviation.

    Raises:
        ValueError: points that are not finite, or no points.
    """
    a, b = matched_points(xy1, xy2, 1, "time to contact")
    near, far = np.linalg.norm(a - epipole, axis=1), np.linalg.norm(b - epipole, axis=1)
    grown = far - near
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = near / grown
        sigma = noise_px * np.hypot(near, far) / grown**2
    return np.where(grown == 0.0, np.inf, steps), np.where(grown == 0.0, np.inf, sigma)
