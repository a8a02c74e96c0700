"""Bundle adjustment of cameras and points in a projective frame: least reprojection error with no calibration at all.

Twelve numbers a camera and four a point, each moved at right angles to itself; the fifteen of the frame are left to the
damping. HZ stands for Hartley and Zisserman, "Multiple View Geometry", 2004 (18.1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.dlt import normalizing
from sfmapp.geometry.fit import CAUCHY_SIGMAS, cauchy, robust_sigma

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Sightings:
    """Which pixel shows which point in which view.

    Attributes:
        view_idx, point_idx: (O,) int64. xy: (O, 2) pixels.
    """

    view_idx: Ints
    point_idx: Ints
    xy: Array

    def of(self, keep: Mask) -> Sightings:
        """Some of them."""
        return Sightings(self.view_idx[keep], self.point_idx[keep], self.xy[keep])

    def table(self, num_points: int, num_views: int) -> Array:
        """(N, V, 2) pixels, NaN where a point was not seen."""
        out = np.full((num_points, num_views, 2), np.nan)
        out[self.point_idx, self.view_idx] = self.xy
        return out


def sightings_of(xy: Array) -> Sightings:
    """The finite ones of a table of pixels (N, V, 2)."""
    point_idx, view_idx = np.nonzero(np.isfinite(xy).all(2))
    return Sightings(view_idx, point_idx, np.asarray(xy[point_idx, view_idx], np.float64))


@dataclass(frozen=True)
class ProjectiveModel:
    """Cameras (V, 3, 4) and points (N, 4), each of unit norm."""

    cameras: Array
    points: Array

    def left(self, seen: Sightings) -> Array:
        """(O, 2) pixels that are left: seen minus where the model has them."""
        mapped = np.einsum("oij,oj->oi", self.cameras[seen.view_idx], self.points[seen.point_idx])
        with np.errstate(divide="ignore", invalid="ignore"):
            left: Array = seen.xy - mapped[:, :2] / mapped[:, 2:]
        return left


@dataclass(frozen=True)
class AdjustmentInfo:
    """How an adjustment ended.

    Attributes:
        num_iterations: steps, rejected ones included. rms_px: of a coordinate, at the end.
        sigma_px: standard deviation of a coordinate, as the residuals and the free numbers tell.
        is_inlier: (O,) sightings within three of these.
    """

    num_iterations: int
    rms_px: float
    sigma_px: float
    is_inlier: Mask


def adjust_projective(
    model: ProjectiveModel, seen: Sightings, *, is_robust: bool = False, fixed_views: Mask | None = None,
    max_iterations: int = 30,
) -> tuple[ProjectiveModel, AdjustmentInfo]:  # fmt: skip
    """Least reprojection error over cameras and points, by Levenberg and Marquardt with the points eliminated.

    Args:
        model: where it starts. seen: O sightings; points that fewer than two views saw do not move.
        is_robust: some are wrong: Cauchy's loss, its scale by the median residual at the start.
        fixed_views: (V,) bool, cameras that do not move; all of them: points alone.

    Raises:
        ValueError: sightings that are not finite.
    """
    if not np.isfinite(seen.xy).all():
        raise ValueError("an adjustment takes pixels that are finite")
    num_views = len(model.cameras)
    about = normalizing(seen.xy)
    scaled = replace(seen, xy=seen.xy * about[0, 0] + about[:2, 2])
    moves = np.ones(num_views, np.bool_) if fixed_views is None else ~fixed_views
    state = _unit(ProjectiveModel(about @ model.cameras, model.points))
    squared = (state.left(scaled) ** 2).sum(1)
    loss = CAUCHY_SIGMAS * max(robust_sigma(squared, 2), 1e-9) if is_robust else math.inf
    cost = cauchy(squared, loss)[0]
    damping, taken = 1e-4, 0
    structure = _Structure.of(scaled, num_views, len(state.points))
    system = _linearized(state, scaled, structure, loss)
    while taken < max_iterations and damping < 1e8:
        taken += 1
        candidate = _moved(state, scaled, structure, system, moves, damping)
        new_cost = cauchy((candidate.left(scaled) ** 2).sum(1), loss)[0]
        if not new_cost < cost:
            damping *= 10.0
            continue
        has_converged = cost - new_cost <= 1e-8 * cost
        state, cost, damping = candidate, new_cost, max(0.1 * damping, 1e-10)
        if has_converged:
            break
        system = _linearized(state, scaled, structure, loss)
    found = _unit(ProjectiveModel(np.linalg.inv(about) @ state.cameras, state.points))
    left = found.left(seen)
    squared = (left**2).sum(1)
    free = 2 * len(left) - 11 * int(moves.sum()) - 3 * len(np.unique(seen.point_idx)) + (15 if moves.all() else 0)
    sigma = math.sqrt(float(squared.sum()) / free) if free > 0 else math.nan
    if is_robust:
        sigma = robust_sigma(squared, 2) * math.sqrt(max(2 * len(left) / free, 1.0)) if free > 0 else math.nan
    rms = math.sqrt(float(squared.mean()) / 2.0)
    within = squared <= 2.0 * (3.0 * max(sigma, 1e-9)) ** 2 if math.isfinite(sigma) else np.ones(len(left), np.bool_)
    return found, AdjustmentInfo(taken, rms, sigma, np.asarray(within, np.bool_))


def noise_of_places(model: ProjectiveModel, seen: Sightings, frame: Array, sigma_px: float) -> Array:
    """(N, 3, 3) covariances of where a frame (4, 4) puts the points, of the noise of their own pixels by cameras that
    stand; every point is to be seen in two views."""
    camera = (model.cameras @ np.linalg.inv(frame))[seen.view_idx]
    place = model.points @ frame.T
    place /= place[:, 3:]
    mapped = np.einsum("oij,oj->oi", camera, place[seen.point_idx])
    pixel = mapped[:, :2] / mapped[:, 2:]
    by_place = (camera[:, :2, :3] - pixel[:, :, None] * camera[:, 2:, :3]) / mapped[:, 2, None, None]
    told = _Groups.of(seen.point_idx, len(place)).sums(by_place.swapaxes(1, 2) @ by_place)
    # rays that are all but one leave the depth open: large, and not an error
    depth = 1e-12 * np.trace(told, axis1=1, axis2=2)
    covariances: Array = sigma_px**2 * np.linalg.inv(told + depth[:, None, None] * np.eye(3))
    return covariances


def _unit(model: ProjectiveModel) -> ProjectiveModel:
    return ProjectiveModel(
        model.cameras / np.linalg.norm(model.cameras, axis=(1, 2), keepdims=True),
        model.points / np.linalg.norm(model.points, axis=1, keepdims=True),
    )


class _Groups(NamedTuple):
    """Rows that belong to the same one of ``num``: their order, where each begins in it, and whose they are."""

    order: Ints
    starts: Ints
    whose: Ints
    num: int

    @classmethod
    def of(cls, index: Ints, num: int) -> _Groups:
        order = np.argsort(index, kind="stable")
        whose, starts = np.unique(index[order], return_index=True)
        return cls(order, starts, whose, num)

    def sums(self, values: Array) -> Array:
        """(num, ...) of values (O, ...)."""
        out = np.zeros((self.num, *values.shape[1:]))
        if len(self.whose):
            out[self.whose] = np.add.reduceat(values[self.order], self.starts, axis=0)
        return out


class _Structure(NamedTuple):
    """What meets what: sightings by view and by point; pairs of sightings of one point (Q,), by the pair of views, as
    ``first * V + second``, first <= second."""

    by_view: _Groups
    by_point: _Groups
    first: Ints
    second: Ints
    by_pair: _Groups

    @classmethod
    def of(cls, seen: Sightings, num_views: int, num_points: int) -> _Structure:
        order = np.lexsort((seen.view_idx, seen.point_idx))
        points, first, second = seen.point_idx[order], [order], [order]
        for apart in range(1, len(order)):
            at = np.flatnonzero(points[apart:] == points[:-apart])
            if not len(at):
                break
            first.append(order[at])
            second.append(order[at + apart])
        one, other = np.concatenate(first), np.concatenate(second)
        keys = seen.view_idx[one] * num_views + seen.view_idx[other]
        return cls(
            _Groups.of(seen.view_idx, num_views), _Groups.of(seen.point_idx, num_points), one, other,
            _Groups.of(keys, num_views * num_views),
        )  # fmt: skip


class _System(NamedTuple):
    """Normal equations: cameras (V, 12, 12) and (V, 12), points (N, 3, 3) and (N, 3), and what mixes them, a block
    (O, 12, 3) for each sighting; ``bases`` (N, 4, 3) are the directions in which points move."""

    cameras: Array
    camera_pull: Array
    points: Array
    point_pull: Array
    mixed: Array
    bases: Array


def _linearized(model: ProjectiveModel, seen: Sightings, structure: _Structure, loss: float) -> _System:
    camera, point = model.cameras[seen.view_idx], model.points[seen.point_idx]
    mapped = np.einsum("oij,oj->oi", camera, point)
    pixel = mapped[:, :2] / mapped[:, 2:]
    left = seen.xy - pixel
    weight = np.sqrt(cauchy((left**2).sum(1), loss)[1])
    # by the homogeneous pixel (O, 2, 3)
    by_mapped = np.zeros((len(pixel), 2, 3))
    by_mapped[:, 0, 0] = by_mapped[:, 1, 1] = 1.0
    by_mapped[:, :, 2] = -pixel
    by_mapped *= (weight / mapped[:, 2])[:, None, None]
    by_camera = (by_mapped[:, :, :, None] * point[:, None, None, :]).reshape(-1, 2, 12)
    bases = _across(model.points)
    by_point = by_mapped @ camera @ bases[seen.point_idx]
    pull = (left * weight[:, None])[:, :, None]
    of_camera, of_point = by_camera.swapaxes(1, 2), by_point.swapaxes(1, 2)
    return _System(
        structure.by_view.sums(of_camera @ by_camera), structure.by_view.sums((of_camera @ pull)[:, :, 0]),
        structure.by_point.sums(of_point @ by_point), structure.by_point.sums((of_point @ pull)[:, :, 0]),
        of_camera @ by_point, bases,
    )  # fmt: skip


def _across(points: Array) -> Array:
    """(N, 4, 3) orthonormal directions at right angles to unit vectors (N, 4), by Householder's reflection."""
    mirror = points.copy()
    mirror[:, 3] += np.where(points[:, 3] < 0.0, -1.0, 1.0)
    mirror /= np.linalg.norm(mirror, axis=1, keepdims=True)
    basis: Array = np.eye(4)[:, :3] - 2.0 * mirror[:, :, None] * mirror[:, None, :3]
    return basis


def _moved(
    model: ProjectiveModel, seen: Sightings, structure: _Structure, system: _System, moves: Mask, damping: float
) -> ProjectiveModel:
    """A damped step further."""
    sizes = np.maximum(np.trace(system.points, axis1=1, axis2=2), 1e-12) / 3.0
    inverse = np.linalg.inv(system.points + damping * sizes[:, None, None] * np.eye(3))
    camera_step = np.zeros((len(model.cameras), 12))
    if moves.any():
        camera_step[moves] = _camera_steps(seen, structure, system, inverse, moves, damping)
    through = (system.mixed.swapaxes(1, 2) @ camera_step[seen.view_idx][:, :, None])[:, :, 0]
    pull = system.point_pull - structure.by_point.sums(through)
    point_step = (inverse @ pull[:, :, None])[:, :, 0]
    point_step[np.bincount(seen.point_idx, minlength=len(model.points)) < 2] = 0.0
    return _unit(
        ProjectiveModel(
            model.cameras + camera_step.reshape(-1, 3, 4),
            model.points + (system.bases @ point_step[:, :, None])[:, :, 0],
        )
    )


def _camera_steps(
    seen: Sightings, structure: _Structure, system: _System, inverse: Array, moves: Mask, damping: float
) -> Array:
    """(M, 12) of the cameras that move, from the system with the points eliminated."""
    num_views = len(system.cameras)
    weighted = system.mixed @ inverse[seen.point_idx]
    blocks = structure.by_pair.sums(weighted[structure.first] @ system.mixed[structure.second].swapaxes(1, 2))
    blocks = -blocks.reshape(num_views, num_views, 12, 12)
    diagonal = np.arange(num_views)
    own = blocks[diagonal, diagonal] + system.cameras
    for k in range(12):
        own[:, k, k] += damping * np.maximum(system.cameras[:, k, k], 1e-12)
    # pairs stand once, with the lower view first
    blocks = blocks + blocks.transpose(1, 0, 3, 2)
    blocks[diagonal, diagonal] = own
    right = system.camera_pull - structure.by_view.sums(
        (weighted @ system.point_pull[seen.point_idx][:, :, None])[:, :, 0]
    )
    count = 12 * int(moves.sum())
    reduced = blocks[np.ix_(moves, moves)].transpose(0, 2, 1, 3).reshape(count, count)
    # the frame and each camera's scale leave it singular but for the damping
    scale = 1.0 / np.sqrt(np.diag(reduced).clip(1e-300))
    scaled = reduced * scale[:, None] * scale + 1e-13 * np.eye(count)
    step: Array = scale * np.linalg.solve(scaled, right[moves].ravel() * scale)
    return step.reshape(-1, 12)
