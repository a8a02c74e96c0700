"""Focal lengths from what photographs have in common, without a board: one function for each kind of motion.

Pixels are square and the principal point is known (the middle of the picture, if nothing else is). Each function says
which motions tell it nothing.
HZ stands for Hartley and Zisserman, "Multiple View Geometry", 2004.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.epipolar import sampson_errors
from sfmapp.geometry.fit import FitInfo
from sfmapp.geometry.fundamental import fundamental_from_points, rank_two, refine_fundamental
from sfmapp.geometry.homography import rotation_from_rays

Array = NDArray[np.float64]

_FLAT = np.diag([1.0, 1.0, 0.0])
# A focal length is told if one that is so many times as long, or as short, leaves E so many times as unequal.
_CHANGE, _TELLING, _ROUNDING = 1.2, 3.0, 1e-6
# product of the last numbers of vanishing points of unit length, below which one of them is at infinity
_INFINITE = 1e-12
_MAX_STEPS, _CONVERGED = 30, 1e-12
# F has seven numbers; with twice as many matches their noise is known from what is left. Matches farther off than three
# standard deviations are wrong ones; that deviation follows from the median of the lengths of normal numbers.
_NUM_FREE, _MIN_MATCHES, _LIMIT, _MAD, _MAX_ROUNDS = 7, 14, 3.0, 1.4826, 20


def focals_from_fundamental(fundamental: Array, center1: Array, center2: Array) -> tuple[float, float] | None:
    """Focal lengths of two cameras, pixels, from F alone.

    Bougnoux, "From projective to Euclidean space under any practical situation", ICCV 1998.

    Args:
        fundamental: (3, 3), x2^T F x1 = 0.
        center1, center2: (2,) principal points.

    Returns:
        None where F has no such focal lengths. It tells nothing where the optical axes lie in one plane (cameras that
        look at one point, or in one direction), and little near that: both are infinite or imaginary then.
    """
    f = _centered(fundamental, center1, center2)
    squares = (_bougnoux(f), _bougnoux(f.T))
    if not (np.isfinite(squares).all() and min(squares) > 0.0):
        return None
    return float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))


def _bougnoux(f: Array) -> float:
    """Squared focal length of the first camera, of an F whose principal points are the origin."""
    u, _, _ = np.linalg.svd(f)
    across = rigid3.skew(u[:, 2])
    above = (across @ _FLAT @ f)[2, 2] * f[2, 2]
    below = (across @ _FLAT @ f @ _FLAT @ f.T)[2, 2]
    # the numbers of an F of unit norm; a smaller denominator is rounding
    return float(-above / below) if abs(below) > 1e-14 * np.linalg.norm(f) ** 3 else np.inf


def focal_from_fundamental(
    fundamental: Array, center1: Array, center2: Array, size: float
) -> tuple[float, float] | None:
    """The focal length that two cameras share, pixels, from F alone, and how unequal it leaves E's singular values.

    K^T F K is an essential matrix if its two singular values s1, s2 are equal. With w = f^2 both sides of that are
    polynomials, and (s1^2 - s2^2) / (s1^2 + s2^2), which is least at f (cf. Mendonca and Cipolla, CVPR 1999), has its
    extremes at the roots of another (cf. Sturm, "On focal length calibration from two views", CVPR 2001).

    Args:
        fundamental: (3, 3), x2^T F x1 = 0.
        center1, center2: (2,) principal points.
        size: longer side of the pictures: focal lengths from a tenth to twenty times that are looked for.

    Returns:
        Focal length and inequality, 0 for an exact one; None without any, and where a focal length that is 20 % off
        would do nearly as well. It tells nothing where the optical axes are
        parallel (the camera moved without turning), nor where they meet at the same distance from both cameras (a
        turntable, or a camera on an arc).
    """
    scale = np.diag([size, size, 1.0])
    f = scale @ _centered(fundamental, center1, center2) @ scale
    trace, square = _traces(f / np.linalg.norm(f))
    # (s1^2 - s2^2)^2 over (s1^2 + s2^2)^2
    above, below = 2.0 * square - trace * trace, trace * trace
    extremes = (above.deriv() * below - above * below.deriv()).roots()
    w = extremes.real[
        (np.abs(extremes.imag) < 1e-6 * np.abs(extremes)) & (extremes.real > 0.01) & (extremes.real < 400.0)
    ]
    if not len(w):
        return None
    unequal = np.sqrt(np.maximum(above(w) / below(w), 0.0))
    best = int(np.argmin(unequal))
    beside = w[best] * np.array([_CHANGE**-2, _CHANGE**2])
    if np.sqrt(np.maximum(above(beside) / below(beside), 0.0)).min() < max(_TELLING * unequal[best], _ROUNDING):
        return None
    return float(np.sqrt(w[best])) * size, float(unequal[best])


@dataclass(frozen=True)
class FocalsOfPair:
    """Focal lengths that the matches of two photographs tell.

    Attributes:
        focals: (1,) that both share, or (2,) pixels.
        covariance: of their logarithms: the noise of the matches, as far as F's own covariance carries it.
        noise_px: standard deviation of a matched coordinate.
        is_inlier: (N,) matches that count.
    """

    focals: Array
    covariance: Array
    noise_px: float
    is_inlier: NDArray[np.bool_]

    @property
    def sigmas(self) -> Array:
        """Standard deviations of the focal lengths, pixels."""
        found: Array = self.focals * np.sqrt(np.diag(self.covariance))
        return found


def focals_from_matches(
    xy1: Array, xy2: Array, center1: Array, center2: Array, size: float, *, is_shared: bool = True,
    fundamental: Array | None = None,
) -> FocalsOfPair | None:  # fmt: skip
    """Focal lengths from matches, with the sigmas that their noise asks for.

    F is fitted with its covariance, and both are carried to the focal lengths: what they change by, one standard
    deviation of F to each side along each of its axes.

    Args:
        xy1, xy2: (N, 2) pixels; with an F to start from some of the matches may be wrong.
        center1, center2: (2,) principal points. Their errors are not in the sigmas.
        size: longer side of the pictures.
        is_shared: both have one focal length (:func:`focal_from_fundamental`); False: each its own
            (:func:`focals_from_fundamental`). These say which motions tell nothing.
        fundamental: (3, 3) F that is near, x2^T F x1 = 0, of a search by samples perhaps; None: that of all matches.

    Returns:
        None where the matches leave F open, or where an F within one standard deviation tells no focal lengths: a
        motion that is, as far as the noise lets it be seen, one of those that tell nothing.
    """
    scaled = np.diag([size, size, 1.0])
    start = None if fundamental is None else scaled @ _centered(fundamental, center1, center2) @ scaled
    fit = _fit_fundamental((xy1 - center1) / size, (xy2 - center2) / size, start)
    if fit is None:
        return None
    matrix, info = fit
    middle = np.zeros(2)

    def logs(f: Array) -> Array | None:
        if is_shared:
            one = focal_from_fundamental(f, middle, middle, 1.0)
            return None if one is None else np.log([one[0]])
        both = focals_from_fundamental(f, middle, middle)
        return None if both is None else np.log(both)

    found = logs(matrix)
    assert info.covariance is not None
    values, axes = np.linalg.eigh(info.covariance)
    steps = (axes[:, -_NUM_FREE:] * np.sqrt(np.maximum(values[-_NUM_FREE:], 0.0))).T.reshape(-1, 3, 3)
    beside = [logs(rank_two(matrix + sign * step)) for step in steps for sign in (1.0, -1.0)]
    if found is None or any(one is None for one in beside):
        return None
    sides = np.array(beside).reshape(len(steps), 2, -1)
    slopes = 0.5 * (sides[:, 0] - sides[:, 1])
    # what bends is part of what is not known: the mean of both sides differs from the middle
    bends = 0.5 * (sides[:, 0] + sides[:, 1]) - found
    covariance = slopes.T @ slopes + 0.5 * bends.T @ bends
    return FocalsOfPair(size * np.exp(found), covariance, size * info.sigma_px, info.is_inlier)


def _fit_fundamental(xy1: Array, xy2: Array, start: Array | None) -> tuple[Array, FitInfo] | None:
    """F of the matches that agree with it, with its covariance; None where they are few or leave it open."""
    if len(xy1) < _MIN_MATCHES:
        return None
    matrix = fundamental_from_points(xy1, xy2) if start is None else rank_two(start)
    is_inlier = np.zeros(len(xy1), bool)
    for _ in range(_MAX_ROUNDS):
        lengths = np.sqrt(sampson_errors(matrix, xy1, xy2))
        before, is_inlier = is_inlier, lengths <= _LIMIT * max(_MAD * float(np.median(lengths)), 1e-15)
        if is_inlier.sum() < _MIN_MATCHES:
            return None
        if (is_inlier == before).all():
            break
        matrix, info = refine_fundamental(matrix, xy1[is_inlier], xy2[is_inlier])
    return None if info.covariance is None else (matrix, replace(info, is_inlier=is_inlier))


@dataclass(frozen=True)
class SharedFocal:
    """The focal length of one camera, from several pairs of its photographs.

    Attributes:
        focal, sigma: pixels; the sigma is as wide as the pairs differ.
        num_pairs: that tell it, and agree.
    """

    focal: float
    sigma: float
    num_pairs: int


def combine_focals(pairs: Sequence[FocalsOfPair]) -> SharedFocal | None:
    """What pairs of photographs of one camera tell together; None without any.

    The weighted mean of the logarithms, in which pairs count that are within three sigmas of the weighted median: a
    motion near to one that tells nothing has a long tail. Pairs that share photographs are not independent, so the
    sigma is no smaller than that of the best pair over the root of half of their number, nor than they differ by.
    """
    if not pairs:
        return None
    logs = np.array([np.log(pair.focals[0]) for pair in pairs])
    sigmas = np.array([math.sqrt(max(pair.covariance[0, 0], 1e-16)) for pair in pairs])
    weights = sigmas**-2
    order = np.argsort(logs)
    share = np.cumsum(weights[order]) / weights.sum()
    middle = logs[order[int(np.searchsorted(share, 0.5))]]
    near = np.abs(logs - middle) <= 3.0 * np.hypot(sigmas, sigmas.min())
    total = weights[near].sum()
    mean = float((weights[near] * logs[near]).sum() / total)
    excess = float((weights[near] * (logs[near] - mean) ** 2).sum()) / max(1, near.sum() - 1)
    sigma = math.sqrt(2.0 / total * max(1.0, excess)) if near.sum() > 1 else float(sigmas[near][0])
    return SharedFocal(math.exp(mean), math.exp(mean) * sigma, int(near.sum()))


def _traces(f: Array) -> tuple[np.polynomial.Polynomial, np.polynomial.Polynomial]:
    """Traces of E E^T and of its square, polynomials in w, for E = K F K, K = diag(f, f, 1)."""
    w = np.polynomial.Polynomial([0.0, 1.0])
    diagonal = (w, w, np.polynomial.Polynomial([1.0]))
    zero = np.polynomial.Polynomial([0.0])
    # D F D F^T has the eigenvalues of E E^T
    matrix = [
        [sum((diagonal[i] * diagonal[k] * (f[i, k] * f[j, k]) for k in range(3)), zero) for j in range(3)]
        for i in range(3)
    ]
    trace = sum((matrix[i][i] for i in range(3)), zero)
    square = sum((matrix[i][j] * matrix[j][i] for i in range(3) for j in range(3)), zero)
    return trace, square


def focal_from_homographies(homographies: Sequence[Array], center: Array) -> float | None:
    """The focal length of a camera that only turned, pixels, from the maps between its photographs.

    H = K R K^-1 leaves the dual of the absolute conic alone, H w H^T = w (HZ 19.19): with det H = 1 linear in f^2.

    Args:
        homographies: (3, 3) each, x2 ~ H x1.
        center: (2,) principal point.

    Returns:
        None where there is none. A turn about the optical axis tells nothing, and a small one little; a camera that
        moved as well, in front of anything but what is far away, has no such H.
    """
    rows, right = [], []
    for homography in homographies:
        h = _shift(-center) @ homography @ _shift(center)
        determinant = np.linalg.det(h)
        if abs(determinant) < 1e-14 * np.linalg.norm(h) ** 3:
            continue
        h = h / np.cbrt(determinant)
        # of the size of a picture: rows are comparable then
        size = math.sqrt(float(np.linalg.norm(h[:2, 2])) / max(float(np.linalg.norm(h[2, :2])), 1e-300))
        if not 0.0 < size < 1e12:
            continue
        scale = np.diag([1.0, 1.0, size])
        g = scale @ h @ np.linalg.inv(scale)
        upper = np.triu_indices(3)
        rows.append((g @ _FLAT @ g.T - _FLAT)[upper] / size**2)
        right.append((np.diag([0.0, 0.0, 1.0]) - np.outer(g[:, 2], g[:, 2]))[upper])
    if not rows:
        return None
    a, b = np.concatenate(rows), np.concatenate(right)
    total = float(a @ a)
    square = float(a @ b) / total if total > 0.0 else np.nan
    return float(np.sqrt(square)) if np.isfinite(square) and square > 0.0 else None


def focal_from_vanishing_points(first: Array, second: Array) -> Array:
    """(N,) focal lengths, pixels, for which the directions of vanishing points are at right angles (HZ example 8.27).

    Args:
        first, second: (N, 3) homogeneous, pixels from the principal point.

    Returns:
        NaN where there is none. Directions that are parallel to the picture have their vanishing point at infinity, and
        tell nothing: a building seen from straight ahead.
    """
    depth = first[:, 2] * second[:, 2]
    square = -(first[:, :2] * second[:, :2]).sum(1) / np.where(np.abs(depth) < _INFINITE, np.nan, depth)
    found: Array = np.sqrt(np.where(square > 0.0, square, np.nan))
    return found


@dataclass(frozen=True)
class TurningCamera:
    """A camera that only turned.

    Attributes:
        focal, sigma: pixels.
        rotations: (K, 3, 3) cam2_from_cam1 of the pairs.
        noise_px: standard deviation of a measured coordinate.
    """

    focal: float
    sigma: float
    rotations: Array
    noise_px: float


def refine_turning_camera(focal: float, center: Array, matches: Sequence[tuple[Array, Array]]) -> TurningCamera:
    """The focal length that turns the rays of matched pixels best onto each other, from one that is near.

    Levenberg and Marquardt on the distances in the second picture under Cauchy's weights, whose scale follows from the
    residuals; every pair has a rotation of its own.

    Args:
        focal: pixels. center: (2,) principal point.
        matches: pixels (N, 2) and (N, 2) of each pair; wrong ones count little.
    """
    turns = np.array([
        rotation_from_rays((a - center) / focal, (b - center) / focal, np.ones(len(a))) for a, b in matches
    ])  # fmt: skip
    damping, scale2 = 1e-4, 9.0 * _variance(focal, turns, center, matches)
    cost, hessian, gradient = _turning_normal(focal, turns, center, matches, scale2)
    for _ in range(_MAX_STEPS):
        step = np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient)
        tried = (focal * float(np.exp(step[0])), rigid3.exp_so3(step[1:].reshape(-1, 3)) @ turns)
        if not _turning_normal(*tried, center, matches, scale2)[0] <= cost:
            damping *= 10.0
            if damping > 1e8:
                break
            continue
        before, damping = cost, damping * 0.1
        focal, turns = tried
        is_converged = before - _turning_normal(focal, turns, center, matches, scale2)[0] <= _CONVERGED * before
        scale2 = min(scale2, 9.0 * _variance(focal, turns, center, matches))
        cost, hessian, gradient = _turning_normal(focal, turns, center, matches, scale2)
        if is_converged:
            break
    variance = _variance(focal, turns, center, matches)
    sigma = focal * float(np.sqrt(variance * np.linalg.inv(hessian)[0, 0]))
    return TurningCamera(focal, sigma, turns, float(np.sqrt(variance)))


def _turned(focal: float, turn: Array, center: Array, pair: tuple[Array, Array]) -> tuple[Array, Array]:
    """(N, 2) second pixels less the first's that were turned, and the derivatives (N, 2, 4) of these by the logarithm
    of the focal length and by a turn."""
    xy1, xy2 = pair
    x = (xy1 - center) / focal
    p = np.column_stack([x, np.ones(len(x))]) @ turn.T
    mapped = p[:, :2] / p[:, 2:]
    by_point = np.zeros((len(x), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0
    by_point[:, :, 2] = -mapped
    by_point *= focal / p[:, 2:, None]
    # the rays of the first pixels become longer by what the focal length grows
    by_focal = focal * mapped - (by_point @ (turn[:, :2] @ x.T).T[:, :, None])[:, :, 0]
    by_turn = -by_point @ rigid3.skew(p)
    return xy2 - center - focal * mapped, np.concatenate([by_focal[:, :, None], by_turn], 2)


def _turning_normal(
    focal: float, turns: Array, center: Array, matches: Sequence[tuple[Array, Array]], scale2: float
) -> tuple[float, Array, Array]:
    num = 1 + 3 * len(matches)
    cost, hessian, gradient = 0.0, np.zeros((num, num)), np.zeros(num)
    for k, (turn, pair) in enumerate(zip(turns, matches, strict=True)):
        residual, jacobian = _turned(focal, turn, center, pair)
        square = (residual**2).sum(1) / scale2
        weight = 1.0 / (1.0 + square)
        at = np.array([0, 1 + 3 * k, 2 + 3 * k, 3 + 3 * k])
        cost += float(np.log1p(square).sum()) * 0.5 * scale2
        hessian[np.ix_(at, at)] += np.einsum("n,nia,nib->ab", weight, jacobian, jacobian)
        gradient[at] += np.einsum("n,nia,ni->a", weight, jacobian, residual)
    return cost, hessian, gradient


def _variance(focal: float, turns: Array, center: Array, matches: Sequence[tuple[Array, Array]]) -> float:
    """Of a coordinate, pixels squared: the median of a squared length of two normal numbers is 2 ln 2."""
    squares = [(_turned(focal, turn, center, pair)[0] ** 2).sum(1) for turn, pair in zip(turns, matches, strict=True)]
    return max(float(np.median(np.concatenate(squares))) / (2.0 * math.log(2.0)), 1e-12)


def _centered(fundamental: Array, center1: Array, center2: Array) -> Array:
    """F of pixels from the principal points, of unit norm."""
    f = _shift(center2).T @ fundamental @ _shift(center1)
    unit: Array = f / np.linalg.norm(f)
    return unit


def _shift(by: Array) -> Array:
    return np.array([[1.0, 0.0, by[0]], [0.0, 1.0, by[1]], [0.0, 0.0, 1.0]])
