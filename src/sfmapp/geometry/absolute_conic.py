"""Self-calibration: the metric frame in which all cameras of a projective reconstruction are of one calibration.

The dual absolute quadric Q (4, 4), of rank three, is seen in every picture as ``P Q P^T ~ K K^T``. Triggs,
"Autocalibration and the absolute quadric", CVPR 1997; Hartley and Zisserman, "Multiple View Geometry", 2004 (HZ), 19.3.
Motions that leave it open: Sturm, "Critical motion sequences for monocular self-calibration and uncalibrated Euclidean
reconstruction", CVPR 1997.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.dlt import decompose_projection, homogeneous
from sfmapp.geometry.fit import count_free, minimize

Array = NDArray[np.float64]
Unknown = Literal["focal", "focal and centre", "everything"]
UNKNOWNS: tuple[Unknown, ...] = get_args(Unknown)
_NUM_OF_K: dict[Unknown, int] = {"focal": 1, "focal and centre": 3, "everything": 5}

MIN_VIEWS = 3
"""Eight unknowns of the plane at infinity and of K, of which four constraints a view beyond the first two tell."""

# A focal length that is known to a third is not known: three standard deviations reach from nothing to twice of it
_MAX_SIGMA = 0.3
# turns below, degrees, are none, and axes nearer than this are one
_NO_TURN_DEG, _SAME_AXIS_DEG = 1.0, 2.0


class NoMetricFrameError(ValueError):
    """No camera of one calibration has taken these pictures, or their motion leaves open which one has."""


@dataclass(frozen=True)
class MetricFrame:
    """A metric frame, up to a similarity, and the camera that it makes of all views.

    Attributes:
        frame: (4, 4) G: points ``G X``, cameras ``P G^-1 ~ K (R | t)``, points in front of most cameras.
        k: (3, 3) of all views.
        log_focal_sigma: standard deviation of the logarithm of the focal length, as far as what is left of the
            equations tells it: cameras that are all wrong alike are not in it.
        condition: of the equations: their largest singular value over the smallest.
        singular_values: of these, descending. num_free: 1 where the motion tells the frame.
        linear_focal: what the linear solution had, pixels; NaN where that was none of a camera.
        num_iterations: steps of the refinement.
        left: root mean square of what is left in the entries of K K^T, as shares of it.
    """

    frame: Array
    k: Array
    log_focal_sigma: float
    condition: float
    singular_values: Array
    num_free: int
    linear_focal: float
    num_iterations: int
    left: float


def linear_dual_quadric(cameras: Array) -> tuple[Array, Array]:
    """Q (4, 4), symmetric, of least algebraic error for square pixels about a principal point at the origin.

    Each view has four equations: ``w11 = w22, w12 = w13 = w23 = 0`` for w = P Q P^T. They are weighed by w33 of the
    round before, so that near and far views count alike.

    Args:
        cameras: (V, 3, 4), their pixels about the principal point, in units of about the focal length.

    Returns:
        Q of unit norm with the sign that makes most w33 positive, not yet of rank three, and the ten singular values.
    """
    pairs = [(i, j) for i in range(4) for j in range(i, 4)]
    weights = np.ones(len(cameras))
    for _ in range(5):
        rows = []
        for p, weight in zip(cameras / np.linalg.norm(cameras, axis=(1, 2), keepdims=True), weights, strict=True):
            # w_ab as a form in the ten entries of Q
            form = {
                (a, b): np.array([p[a, i] * p[b, j] + (p[a, j] * p[b, i] if i != j else 0.0) for i, j in pairs])
                for a, b in ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2), (2, 2))
            }
            rows += [weight * (form[0, 0] - form[1, 1])] + [weight * form[key] for key in ((0, 1), (0, 2), (1, 2))]
        _, values, vt = np.linalg.svd(np.array(rows), full_matrices=len(rows) < 10)
        q = np.zeros((4, 4))
        for (i, j), entry in zip(pairs, vt[9], strict=True):
            q[i, j] = q[j, i] = entry
        seen = cameras @ q @ cameras.swapaxes(1, 2) / np.linalg.norm(cameras, axis=(1, 2))[:, None, None] ** 2
        w33 = seen[:, 2, 2]
        weights = 1.0 / np.maximum(np.abs(w33), 1e-3 * np.abs(w33).max())
        weights /= weights.max()
    q *= 1.0 if np.median(w33) >= 0.0 else -1.0
    return q / np.linalg.norm(q), np.pad(values, (0, 10 - len(values)))


def self_calibrate(
    cameras: Array, points: Array, center: Array, size: float, unknown: Unknown = "focal"
) -> MetricFrame:
    """The metric frame of cameras of one calibration: linear, then least squares over K and the plane at infinity.

    Args:
        cameras: (V, 3, 4), V >= 3, in any projective frame. points: (N, 4) in it, which say what is in front.
        center: (2,) principal point, or where one is looked for first. size: longer side of the pictures, pixels.
        unknown: "focal": pixels are square and the principal point is ``center``; "focal and centre": it is the same in
            all pictures, wherever; "everything": skew and the ratio of the sides too. The more is unknown, the more
            motions are critical: turns about one axis, a turntable for one, tell the last one of nothing.

    Raises:
        NoMetricFrameError: fewer than three views; no positive definite solution; or a motion that leaves the frame
            open, with its kind where it is known.
        ValueError: cameras that are not finite.
    """
    if unknown not in UNKNOWNS:
        raise ValueError(f"unknown is {unknown!r}, expected one of {', '.join(UNKNOWNS)}")
    if not np.isfinite(cameras).all():
        raise ValueError("self-calibration takes cameras that are finite")
    if len(cameras) < MIN_VIEWS:
        raise NoMetricFrameError(f"self-calibration takes at least {MIN_VIEWS} views, got {len(cameras)}")
    about = np.array([[1 / size, 0, -center[0] / size], [0, 1 / size, -center[1] / size], [0, 0, 1.0]])
    normal = about @ cameras
    normal /= np.linalg.norm(normal, axis=(1, 2), keepdims=True)
    to_first = _to_canonical(normal[0])
    canonical = normal @ np.linalg.inv(to_first)
    start, linear = _linear_start(canonical)
    state, values, sigma, taken, left = _refined(canonical, start, unknown)
    k = _matrix_of(state.k)
    upgrade = np.zeros((4, 4))
    upgrade[:3, :3], upgrade[3, :3], upgrade[3, 3] = k, -state.plane @ k, 1.0
    frame = np.linalg.inv(upgrade) @ to_first
    # equations have noise of the size of what is left: a direction that weighs no more than it is open
    noise = np.full(len(values), left * math.sqrt(6.0 * len(cameras)) / _MAX_SIGMA / 2.0 + 1e-9 * values[0])
    num_free = 1 + count_free(values, noise)
    found = MetricFrame(
        _facing(frame, cameras, points), np.linalg.inv(about) @ k, sigma, float(values[0] / max(values[-1], 1e-300)),
        values, num_free, linear * size, taken, left,
    )  # fmt: skip
    found.k[:] /= found.k[2, 2]
    if num_free > 1 or not sigma < _MAX_SIGMA:
        known = f"; the focal length would be known to {min(sigma, 9.99):.0%}" if sigma >= 0.1 * _MAX_SIGMA else ""
        raise NoMetricFrameError(f"these motions do not tell the camera: {kind_of_motion(found.frame, cameras)}{known}")
    return found


def _to_canonical(camera: Array) -> Array:
    """(4, 4) G with ``camera G^-1 = [I | 0]``."""
    center = np.linalg.svd(camera)[2][3]
    return np.vstack([camera, center])


def _linear_start(canonical: Array) -> tuple[_State, float]:
    """Focal length and plane at infinity of the linear solution, or the best of guesses where it is none of a camera;
    and the focal length of the first, NaN then."""
    q, _ = linear_dual_quadric(canonical)
    linear = math.nan
    starts = []
    # [[K K^T, -K K^T p], [., .]] in the frame of the first camera
    squares = q[:3, :3]
    if squares[2, 2] > 0 and squares[0, 0] + squares[1, 1] > 0:
        values = np.linalg.eigvalsh(q)
        is_definite = values[1] > 0 and abs(values[0]) < values[1]
        focal = math.sqrt(0.5 * (squares[0, 0] + squares[1, 1]) / squares[2, 2])
        linear = focal if is_definite and np.linalg.eigvalsh(squares)[0] > 0 else math.nan
        plane: Array = -np.asarray(np.linalg.solve(squares, q[:3, 3]), np.float64)
        starts.append(_State(np.array([math.log(focal), 0, 0, 0, 0]), plane))
    for focal in (0.7, 1.2, 2.0, 4.0):
        starts.append(_State(np.array([math.log(focal), 0, 0, 0, 0]), _plane_of(canonical, focal)))
    ends = [_run(canonical, start, 1) for start in starts]
    return min(ends, key=lambda end: end[1])[0], linear


def _plane_of(canonical: Array, focal: float) -> Array:
    """Plane at infinity for a known focal length: linear in p and its square, by what each view's K K^T asks
    (Hartley, "Euclidean reconstruction from uncalibrated views", 1994), from views 2 and on."""
    k = np.diag([focal, focal, 1.0])
    inverse = np.linalg.inv(k)
    rows, right = [], []
    # K^-1 (A - a p^T) K = s R: with q = K p, columns are at right angles and of one length; linear about q = 0
    for p in canonical[1:]:
        m, a = inverse @ p[:, :3] @ k, inverse @ p[:, 3]
        for i, j in ((0, 1), (0, 2), (1, 2)):
            row = np.zeros(3)
            row[i] += m[:, j] @ a
            row[j] += m[:, i] @ a
            rows.append(row)
            right.append(m[:, i] @ m[:, j])
    q = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    plane: Array = np.linalg.solve(k, q)
    return plane


class _State(NamedTuple):
    """Logarithm of the focal length, principal point, logarithm of the ratio of sides, skew; and the plane at infinity
    in the frame of the first camera, ``(p, 1) . X = 0``."""

    k: Array
    plane: Array


def _matrix_of(k: Array) -> Array:
    focal = math.exp(min(max(float(k[0]), -7.0), 7.0))
    return np.array([[focal, k[4] * focal, k[1]], [0.0, focal * math.exp(k[3]), k[2]], [0.0, 0.0, 1.0]])


def _left(canonical: Array, state: _State) -> Array:
    """(V - 1, 6) entries of ``P Q P^T - K K^T``, taken back to unit K: shares of one, whatever the focal length."""
    k = _matrix_of(state.k)
    # P H with H = [K, 0; -p^T K, 1], less its last column: K R for the true plane
    turned = np.linalg.solve(k, canonical[1:, :, :3] @ k - canonical[1:, :, 3:] * (state.plane @ k))
    seen = turned @ turned.swapaxes(1, 2)
    seen = 3.0 * seen / np.trace(seen, axis1=1, axis2=2)[:, None, None] - np.eye(3)
    upper = np.triu_indices(3)
    entries: Array = seen[:, upper[0], upper[1]] * np.where(upper[0] == upper[1], 1.0, math.sqrt(2.0))
    return entries


def _run(
    canonical: Array, start: _State, num_of_k: int, max_iterations: int = 60
) -> tuple[_State, float, Array, int, Array]:
    """The state of least squares, its cost, the Jacobian's Hessian, steps, and the Jacobian."""
    directions = np.eye(8)[[*range(num_of_k), 5, 6, 7]]

    def moved(state: _State, step: Array) -> _State:
        full = step @ directions
        return _State(state.k + full[:5], state.plane + full[5:])

    def slopes(state: _State) -> Array:
        columns = []
        for n in range(len(directions)):
            step = np.zeros(len(directions))
            step[n] = 1e-6
            columns.append(
                (_left(canonical, moved(state, step)) - _left(canonical, moved(state, -step))).ravel() / 2e-6
            )
        return np.stack(columns, 1)

    def linearize(state: _State) -> tuple[float, Array, Array]:
        left, jacobian = _left(canonical, state).ravel(), slopes(state)
        return float(left @ left), jacobian.T @ jacobian, jacobian.T @ left

    best, hessian, taken = minimize(start, linearize, moved, max_iterations)
    left = _left(canonical, best).ravel()
    return best, float(left @ left), hessian, taken, slopes(best)


def _refined(canonical: Array, start: _State, unknown: Unknown) -> tuple[_State, Array, float, int, float]:
    """The state, the singular values of its equations, the standard deviation of log f, steps, and what is left."""
    state, cost, _, taken, jacobian = _run(canonical, start, _NUM_OF_K[unknown])
    # the plane is measured in units of where it is seen: columns of one size
    scaled = jacobian * np.append(np.ones(_NUM_OF_K[unknown]), np.full(3, _plane_unit(canonical)))
    values = np.linalg.svd(scaled, compute_uv=False)
    num_left = max(5 * (len(canonical) - 1) - jacobian.shape[1], 1)
    variance = cost / num_left
    normal = scaled.T @ scaled
    eigenvalues, vectors = np.linalg.eigh(normal)
    inverse = (vectors / np.maximum(eigenvalues, 1e-18 * eigenvalues[-1])) @ vectors.T
    sigma = math.sqrt(max(variance, 1e-20) * float(inverse[0, 0]))
    return state, values, sigma, taken, math.sqrt(cost / (6 * (len(canonical) - 1)))


def _plane_unit(canonical: Array) -> float:
    """What a step of the plane is worth: the size of the first columns over that of the last."""
    first = np.linalg.norm(canonical[1:, :, :3], axis=(1, 2))
    last = np.linalg.norm(canonical[1:, :, 3], axis=1)
    return float(np.median(first / np.maximum(last, 1e-12)))


def _facing(frame: Array, cameras: Array, points: Array) -> Array:
    """The frame, or its mirror through the first camera, whichever has most points in front."""
    metric = cameras @ np.linalg.inv(frame)
    metric = metric * np.where(np.linalg.det(metric[:, :, :3]) < 0, -1.0, 1.0)[:, None, None]
    turned = points @ frame.T
    with np.errstate(divide="ignore", invalid="ignore"):
        depths = homogeneous(turned[:, :3] / turned[:, 3:]) @ metric[:, 2].T
    if np.nanmean(depths > 0) >= 0.5:
        return frame
    return np.diag([1.0, 1.0, 1.0, -1.0]) @ frame


def kind_of_motion(frame: Array, cameras: Array) -> str:
    """In words, what is special of the turns that cameras (V, 3, 4) make in a frame."""
    rotations = [decompose_projection(p)[1] for p in cameras @ np.linalg.inv(frame)]
    turns = np.array([rigid3.log_so3(r @ rotations[0].T) for r in rotations[1:]])
    angles = np.linalg.norm(turns, axis=1)
    if np.degrees(angles.max()) < _NO_TURN_DEG:
        return "the camera moved without turning, and any focal length does"
    axes = turns[angles > np.radians(_NO_TURN_DEG)]
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    off = np.degrees(np.arcsin(np.sqrt((1.0 - (axes @ axes[0]) ** 2).clip(0.0, 1.0))))
    if off.max() < _SAME_AXIS_DEG:
        return (
            "it turned about one axis only, as on a turntable or on a level floor, which leaves the scale along that "
            "axis and where it vanishes open"
        )
    return "its turns are of a kind that more than one camera could have made, or too small for their noise"
