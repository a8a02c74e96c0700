"""Three views with no calibration: the trifocal tensor, and points and lines that two of them take to the third.

``T`` is (3, 3, 3), ``T[i, j, k]`` with i of picture 1, j of 2 and k of 3: for lines ``l_i = sum l2_j l3_k T[i, j, k]``,
and for points and any lines through theirs in the other pictures ``sum x1_i l2_j l3_k T[i, j, k] = 0``, as in Hartley
and Zisserman, "Multiple View Geometry", 2004 (HZ), chapter 15.
Part of the literature writes ``F13`` for what takes a point of picture 1 to its line in picture 3, and a transfer
``m3 ~ F13 m1 x F23 m2``; here that is ``F31``: ``x3^T F31 x1 = 0``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.dlt import homogeneous, normalizing
from sfmapp.geometry.fit import FitInfo, count_free, matched_points
from sfmapp.geometry.projective import dehomogenized, triangulate_views
from sfmapp.geometry.projective_adjustment import ProjectiveModel, adjust_projective, sightings_of
from sfmapp.geometry.two_rays import move_to_meet

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_POINTS = 7
"""Of the linear way: 26 unknowns, four equations each."""


def trifocal_of(cameras: ArrayLike) -> Array:
    """The tensor (3, 3, 3), of unit norm, of three cameras (3, 3, 4) in any frame (HZ 17.12).

    Raises:
        ValueError: of another shape, or not finite.
    """
    p = np.asarray(cameras, np.float64)
    if p.shape != (3, 3, 4) or not np.isfinite(p).all():
        raise ValueError(f"a trifocal tensor takes three finite cameras (3, 3, 4), got {p.shape}")
    tensor = np.zeros((3, 3, 3))
    for i in range(3):
        others = np.delete(p[0], i, axis=0)
        rows = np.array([[np.vstack([others, p[1, j], p[2, k]]) for k in range(3)] for j in range(3)])
        tensor[i] = (-1.0) ** i * np.linalg.det(rows)
    unit: Array = tensor / np.linalg.norm(tensor)
    return unit


def _equations(x1: Array, x2: Array, x3: Array) -> Array:
    """(4 N, 27) in the entries of T: two lines through each of x2 (N, 3) and x3, along the axes (HZ 16.2)."""
    # lines x = u and y = v: their rows are those of a cross product
    lines2, lines3 = (
        np.stack([np.stack([w, zero, -u], 1), np.stack([zero, w, -v], 1)], 1)
        for u, v, w, zero in ((x[:, 0], x[:, 1], x[:, 2], np.zeros(len(x))) for x in (x2, x3))
    )
    rows: Array = np.einsum("ni,naj,nbk->nabijk", x1, lines2, lines3).reshape(-1, 27)
    return rows


def _three_sets(xy1: ArrayLike, xy2: ArrayLike, xy3: ArrayLike, at_least: int, what: str) -> tuple[Array, Array, Array]:
    a, b, c = (np.ascontiguousarray(xy, np.float64) for xy in (xy1, xy2, xy3))
    if a.ndim != 2 or a.shape[1] != 2 or a.shape != b.shape or a.shape != c.shape:
        raise ValueError(f"{what} takes three arrays (N, 2), got {a.shape}, {b.shape} and {c.shape}")
    if len(a) < at_least:
        raise ValueError(f"{what} takes at least {at_least} points in all three pictures, got {len(a)}")
    bad = ~(np.isfinite(a).all(1) & np.isfinite(b).all(1) & np.isfinite(c).all(1))
    if bad.any():
        raise ValueError(
            f"{what}: {int(bad.sum())} of {len(a)} points are not finite, the first is {int(bad.argmax())}"
        )
    return a, b, c


def fit_trifocal(
    xy1: ArrayLike, xy2: ArrayLike, xy3: ArrayLike, noise_px: float | None = None
) -> tuple[Array, FitInfo]:
    """The tensor of N >= 7 points by the normalised linear algorithm, made a true one of least algebraic error for the
    epipoles that it has (HZ algorithms 16.1 and 16.2).

    Args:
        xy1, xy2, xy3: (N, 2) pixels. noise_px: standard deviation of a coordinate; None: as the residuals tell.

    Returns:
        T (3, 3, 3) of unit norm, and what is known of it; ``num_free`` above 1 where the points leave it open: those of
        a plane do, and cameras that did not move.

    Raises:
        ValueError: fewer than seven points, or some that are not finite.
    """
    a, b, c = _three_sets(xy1, xy2, xy3, MIN_POINTS, "a trifocal tensor")
    maps = [normalizing(xy) for xy in (a, b, c)]
    x1, x2, x3 = (homogeneous(xy) @ m.T for xy, m in zip((a, b, c), maps, strict=True))
    rows = _equations(x1, x2, x3)
    _, values, vt = np.linalg.svd(rows, full_matrices=False)
    tensor = _true_tensor(vt[26].reshape(3, 3, 3), rows)
    left = rows @ tensor.ravel()
    sigma = math.sqrt(float(left @ left) / max(len(rows) - 18, 1))
    if noise_px is not None:
        # a row has the noise of three coordinates, times entries of order one
        sigma = max(sigma, noise_px * max(m[0, 0] for m in maps))
    noise = np.full(27, sigma * math.sqrt(len(rows)) + 1e-12 * values[0])
    info = FitInfo(
        np.ones(len(a), np.bool_), 1, float(values[0] / max(values[25], 1e-300)), values,
        max(count_free(values, noise), 1),
    )  # fmt: skip
    pixels = np.einsum("ijk,ia,jb,kc->abc", tensor, maps[0], *(np.linalg.inv(m).T for m in maps[1:]))
    return pixels / np.linalg.norm(pixels), info


def _true_tensor(tensor: Array, rows: Array) -> Array:
    """Of all tensors with the epipoles of this one: that of least algebraic error (HZ algorithm 16.2)."""
    e2, e3 = epipoles_of(tensor)
    # T_i = a_i e3^T - e2 b_i^T, linear in the columns a_i, b_i of the other two cameras
    parts = np.zeros((27, 18))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                parts[9 * i + 3 * j + k, 3 * i + j] += e3[k]
                parts[9 * i + 3 * j + k, 9 + 3 * i + k] -= e2[j]
    u, s, _ = np.linalg.svd(parts, full_matrices=False)
    basis = u[:, s > 1e-10 * s[0]]
    best = np.linalg.svd(rows @ basis, full_matrices=False)[2][-1]
    true: Array = (basis @ best).reshape(3, 3, 3)
    return true


def epipoles_of(tensor: Array) -> tuple[Array, Array]:
    """(3,) each, of unit norm: the first camera as pictures 2 and 3 see it (HZ algorithm 15.1)."""
    lefts = np.array([np.linalg.svd(t)[0][:, 2] for t in tensor])
    rights = np.array([np.linalg.svd(t)[2][2] for t in tensor])
    return np.linalg.svd(lefts)[2][2], np.linalg.svd(rights)[2][2]


def fundamentals_of(tensor: Array) -> tuple[Array, Array]:
    """F21 and F31 (3, 3) of unit norm: ``x2^T F21 x1 = 0`` and ``x3^T F31 x1 = 0`` (HZ 15.1)."""
    e2, e3 = epipoles_of(tensor)
    f21 = rigid3.skew(e2) @ np.stack([t @ e3 for t in tensor], 1)
    f31 = rigid3.skew(e3) @ np.stack([t.T @ e2 for t in tensor], 1)
    return f21 / np.linalg.norm(f21), f31 / np.linalg.norm(f31)


def cameras_of(tensor: Array) -> Array:
    """(3, 3, 4) cameras of a tensor, the first ``[I | 0]``; the others in one frame with it (HZ 15.1)."""
    e2, e3 = epipoles_of(tensor)
    second = np.column_stack([np.stack([t @ e3 for t in tensor], 1), e2])
    third = np.column_stack([(np.outer(e3, e3) - np.eye(3)) @ np.stack([t.T @ e2 for t in tensor], 1), e3])
    return np.stack([np.eye(3, 4), second, third])


def refine_trifocal(
    tensor: Array, xy1: ArrayLike, xy2: ArrayLike, xy3: ArrayLike, *, is_robust: bool = False
) -> tuple[Array, FitInfo]:
    """The tensor of least reprojection error in three pictures, the gold standard (HZ algorithm 16.3), over the cameras
    and the points.

    Args:
        tensor: (3, 3, 3) start. xy1, xy2, xy3: (N, 2) pixels, N >= 7.
        is_robust: some of the points may be wrong: Cauchy's loss.

    Returns:
        T of unit norm; the inliers are within three standard deviations in all three pictures.

    Raises:
        ValueError: fewer than seven points, or some that are not finite.
    """
    a, b, c = _three_sets(xy1, xy2, xy3, MIN_POINTS, "the refinement of a trifocal tensor")
    xy = np.stack([a, b, c], 1)
    cameras = cameras_of(tensor)
    points, _ = triangulate_views(cameras, xy)
    points = np.where(np.isfinite(points), points, [0.0, 0.0, 0.0, 1.0])
    seen = sightings_of(xy)
    model, info = adjust_projective(ProjectiveModel(cameras, points), seen, is_robust=is_robust)
    is_inlier = np.ones(len(a), np.bool_)
    np.logical_and.at(is_inlier, seen.point_idx, info.is_inlier)
    return trifocal_of(model.cameras), FitInfo(is_inlier, info.num_iterations, math.nan, np.zeros(0), 1, info.sigma_px)


@dataclass(frozen=True)
class Transfer:
    """Points of two pictures in the third.

    Attributes:
        xy: (N, 2) pixels; NaN where nothing can be said.
        covariance: (N, 2, 2) px^2 for the noise of both pictures, the geometry being exact.
        is_told: (N,) bool: the longer axis of that ellipse is short enough.
    """

    xy: Array
    covariance: Array
    is_told: Mask

    @property
    def sigmas(self) -> Array:
        """(N,) px, along the longer axis of the ellipse."""
        finite = np.isfinite(self.covariance).all((1, 2))
        longest = np.full(len(self.xy), np.inf)
        longest[finite] = np.sqrt(np.linalg.eigvalsh(self.covariance[finite])[:, 1].clip(0.0))
        return longest


LIMIT_SIGMAS = 10.0
"""An ellipse so many times as long as the noise of a coordinate is no answer. Of exact F it is what two lines give that
cross at some eight degrees."""


def transfer_by_lines(
    f31: Array, f32: Array, xy1: ArrayLike, xy2: ArrayLike, *, covariances: tuple[Array, Array] | None = None,
    noise_px: float = 1.0, limit_sigmas: float = LIMIT_SIGMAS,
) -> Transfer:  # fmt: skip
    """Points of pictures 1 and 2 in picture 3, where their epipolar lines cross: ``x3 ~ F31 x1 x F32 x2`` (HZ 15.11).

    In the trifocal plane, which the three camera centres span, both lines are one: nothing is told there, and little
    near it, whatever the pixels. Three centres on a line have every point in such a plane.
    :func:`transfer_by_tensor` has no such plane.

    Args:
        f31, f32: (3, 3), ``x3^T F31 x1 = 0`` and ``x3^T F32 x2 = 0``. xy1, xy2: (N, 2) matched pixels.
        covariances: (9, 9) of the entries of both F; None: they are exact.
        noise_px: standard deviation of a coordinate. limit_sigmas: ellipses that are longer, in units of the noise, are
            refused.

    Raises:
        ValueError: points that are not finite, or no points.
    """
    a, b = matched_points(xy1, xy2, 1, "a transfer")
    lines = [homogeneous(xy) @ f.T for xy, f in ((a, f31), (b, f32))]
    sizes = [np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-300) for line in lines]
    normals = np.stack([line[:, :2] / size[:, None] for line, size in zip(lines, sizes, strict=True)], 1)
    xy = dehomogenized(np.cross(lines[0] / sizes[0][:, None], lines[1] / sizes[1][:, None]))
    at = homogeneous(np.nan_to_num(xy))
    # how far each line is off where they cross, at right angles to it
    offsets = np.stack([
        noise_px**2 * ((at @ f)[:, :2] ** 2).sum(1) / size**2 for f, size in zip((f31, f32), sizes, strict=True)
    ], 1)  # fmt: skip
    if covariances is not None:
        for n, (pixels, covariance, size) in enumerate(zip((a, b), covariances, sizes, strict=True)):
            by_f = (at[:, :, None] * homogeneous(pixels)[:, None, :]).reshape(-1, 9)
            offsets[:, n] += np.einsum("ni,ij,nj->n", by_f, covariance, by_f) / size**2
    sine = normals[:, 0, 0] * normals[:, 1, 1] - normals[:, 0, 1] * normals[:, 1, 0]
    crosses = np.isfinite(xy).all(1) & (np.abs(sine) > 1e-12)
    inverse = np.linalg.inv(np.where(crosses[:, None, None], normals, np.eye(2)))
    covariance = np.where(
        crosses[:, None, None], (inverse * offsets[:, None, :]) @ inverse.swapaxes(1, 2), np.full((2, 2), np.inf)
    )
    return _judged(xy, covariance, limit_sigmas * noise_px)


def _judged(xy: Array, covariance: Array, limit_px: float) -> Transfer:
    told = Transfer(xy, covariance, np.ones(len(xy), np.bool_))
    return Transfer(xy, covariance, np.asarray(np.isfinite(xy).all(1) & (told.sigmas <= limit_px), np.bool_))


def transfer_by_tensor(
    tensor: Array, xy1: ArrayLike, xy2: ArrayLike, *, noise_px: float = 1.0, limit_sigmas: float = LIMIT_SIGMAS
) -> Transfer:
    """Points of pictures 1 and 2 in picture 3 by ``x3_k = x1_i l2_j T[i, j, k]``, l2 through x2 at right angles to its
    epipolar line, after both pixels were moved until they meet (HZ 15.3).

    It fails only on the line through the first two centres, at the epipoles of pictures 1 and 2, where two views have
    no parallax.

    Args:
        tensor: (3, 3, 3). xy1, xy2: (N, 2) matched pixels.
        noise_px: standard deviation of a coordinate. limit_sigmas: as of :func:`transfer_by_lines`.

    Raises:
        ValueError: points that are not finite, or no points.
    """
    a, b = matched_points(xy1, xy2, 1, "a transfer")
    f21 = fundamentals_of(tensor)[0]

    def contracted(at1: Array, at2: Array) -> Array:
        at1, at2 = move_to_meet(f21, at1, at2)
        x1 = homogeneous(at1)
        epipolar = x1 @ f21.T
        # through x2 at right angles to the epipolar line: the line that fixes a point best
        last = at2[:, 1] * epipolar[:, 0] - at2[:, 0] * epipolar[:, 1]
        across = np.stack([epipolar[:, 1], -epipolar[:, 0], last], 1)
        return dehomogenized(np.einsum("ni,nj,ijk->nk", x1, across, tensor))

    # what the noise of the four coordinates makes of it, by differences
    step = max(0.1 * noise_px, 1e-4)
    slopes = np.zeros((len(a), 2, 4))
    for axis in range(4):
        shift = step * np.eye(4)[axis].reshape(2, 2)
        after, before = contracted(a + shift[0], b + shift[1]), contracted(a - shift[0], b - shift[1])
        slopes[:, :, axis] = (after - before) / (2.0 * step)
    covariance = np.nan_to_num(noise_px**2 * slopes @ slopes.swapaxes(1, 2), nan=np.inf)
    return _judged(contracted(a, b), covariance, limit_sigmas * noise_px)


def transfer_line(tensor: Array, line2: ArrayLike, line3: ArrayLike) -> Array:
    """Lines (N, 3) of pictures 2 and 3 in picture 1: ``l_i = l2_j l3_k T[i, j, k]``, with normals of unit length
    (HZ 15.1); NaN for two epipolar lines of one plane through the first camera, which leave it open."""
    l2, l3 = np.asarray(line2, np.float64), np.asarray(line3, np.float64)
    found = np.einsum("...j,...k,ijk->...i", l2, l3, tensor)
    size = np.linalg.norm(l2, axis=-1) * np.linalg.norm(l3, axis=-1)
    is_open = np.linalg.norm(found, axis=-1) <= 1e-12 * size
    with np.errstate(divide="ignore", invalid="ignore"):
        lines: Array = np.where(
            is_open[..., None], np.nan, found / np.linalg.norm(found[..., :2], axis=-1, keepdims=True)
        )
    return lines


def crossing_angles(f31: Array, f32: Array, xy1: Array, xy2: Array) -> Array:
    """(N,) angles, radians, between the two lines in picture 3 of points (N, 2) matched in pictures 1 and 2: zero in
    the trifocal plane, where a transfer by lines tells nothing."""
    one, two = homogeneous(xy1) @ f31.T, homogeneous(xy2) @ f32.T
    cross = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    size = np.linalg.norm(one[:, :2], axis=1) * np.linalg.norm(two[:, :2], axis=1)
    angles: Array = np.arcsin((cross / np.maximum(size, 1e-300)).clip(0.0, 1.0))
    return angles
