"""The joint refinement of a camera and of the poses of its views, by Levenberg and Marquardt with the views eliminated.

Every view has six unknowns that no other has, so the normal equations are an arrow: what is solved is as large as the
camera has parameters (Triggs et al., "Bundle adjustment: a modern synthesis", 1999, section 6.3).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.kernels import Normal, Observations, State, normal_equations, residuals
from sfmapp.camera.camera import Camera
from sfmapp.camera.models import canonical_from_params
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_MAX_STEPS = 100
FIRST_DAMPING, LARGEST_DAMPING = 1e-4, 1e10
# relative: a step that lowers the cost by less is the last
_CONVERGED = 1e-11


@dataclass(frozen=True)
class TargetView:
    """Points of a target that a photograph shows.

    Attributes:
        name: of the photograph.
        xyz: (N, 3) in the frame of the target, in its unit.
        xy: (N, 2) pixels.
    """

    name: str
    xyz: Array
    xy: Array


@dataclass(frozen=True)
class Fit:
    """A camera and the poses of V views.

    Attributes:
        camera: with refined parameters.
        cam_from_target: (V, 7).
        bend: (B,) shape of the target; empty for a flat one.
        cost: half the weighted squares of the residuals, pixels squared.
        num_steps: that were taken.
    """

    camera: Camera
    cam_from_target: Array
    bend: Array
    cost: float
    num_steps: int = 0


def observations_of(views: Sequence[TargetView], bends: Sequence[Array] | None = None) -> Observations:
    """The points of views end to end, each with weight 1. ``bends``: (N, B) for each view; None for flat targets."""
    ptr = np.concatenate([[0], np.cumsum([len(view.xy) for view in views])]).astype(np.int64)
    xyz = np.concatenate([view.xyz for view in views]) if views else np.zeros((0, 3))
    xy = np.concatenate([view.xy for view in views]) if views else np.zeros((0, 2))
    bend = np.zeros((len(xy), 0)) if bends is None else np.concatenate(bends)
    return Observations(
        ptr, np.ascontiguousarray(xyz, np.float64), np.ascontiguousarray(bend, np.float64),
        np.ascontiguousarray(xy, np.float64), np.ones(len(xy)),
    )  # fmt: skip


def residuals_of(fit: Fit, obs: Observations) -> Array:
    """(N, 2) measured minus projected pixels; NaN where the lens does not look."""
    out = np.empty_like(obs.xy)
    residuals(_state(fit), obs, out)
    return out


def refine(start: Fit, obs: Observations, *, hold_poses: bool = False, hold_camera: bool = False) -> Fit:
    """The fit that makes the weighted squares of the residuals least, from a start that is near.

    Args:
        start: every view in front of the camera.
        hold_poses: refine the parameters alone. hold_camera: refine the poses, and the shape, alone.

    Returns:
        The start where no step from it is better.
    """
    slots = param_of_slot(start.camera.model)
    if hold_camera:
        slots = np.full_like(slots, -1)
    num_params = len(start.camera.params)
    normal = empty_normal(num_params + len(start.bend), len(obs.ptr) - 1)
    fit, damping, factor = start, FIRST_DAMPING, 4.0
    cost = normal_equations(_state(fit), obs, slots, normal)
    steps = 0
    while steps < _MAX_STEPS and math.isfinite(cost) and damping < LARGEST_DAMPING:
        step = damped_step(normal, damping, hold_poses=hold_poses)
        if step is None:
            damping *= factor
            continue
        shared, own = step
        tried = _moved(fit, shared, own)
        new_cost = _cost(tried, obs)
        if not new_cost <= cost:
            damping, factor = damping * factor, factor * 2.0
            continue
        steps += 1
        is_converged = cost - new_cost <= _CONVERGED * cost
        fit, damping, factor = tried, damping * 0.1, 4.0
        cost = normal_equations(_state(fit), obs, slots, normal)
        if is_converged:
            break
    return replace(fit, cost=cost, num_steps=steps)


def normal_at(fit: Fit, obs: Observations) -> Normal:
    """The normal equations at a fit: what its covariance follows from."""
    normal = empty_normal(len(fit.camera.params) + len(fit.bend), len(obs.ptr) - 1)
    normal_equations(_state(fit), obs, param_of_slot(fit.camera.model), normal)
    return normal


def empty_normal(num_shared: int, num_views: int) -> Normal:
    """Room for normal equations."""
    return Normal(
        np.zeros((num_shared, num_shared)), np.zeros((num_views, num_shared, 6)), np.zeros((num_views, 6, 6)),
        np.zeros(num_shared), np.zeros((num_views, 6)),
    )  # fmt: skip


def param_of_slot(model: CameraModel) -> NDArray[np.int64]:
    """(16,) the parameter of a model that each number of the canonical row is; -1 for none."""
    spread = canonical_from_params(model)
    return np.where(spread.any(1), spread.argmax(1), -1).astype(np.int64)


def _state(fit: Fit) -> State:
    poses = fit.cam_from_target
    return State(fit.camera.canonical, rigid3.rotation_matrix(poses), np.ascontiguousarray(poses[:, 4:]), fit.bend)


def _cost(fit: Fit, obs: Observations) -> float:
    r = residuals_of(fit, obs)
    is_used = obs.weight > 0
    return float(0.5 * (obs.weight[is_used] * (r[is_used] ** 2).sum(1)).sum())


def _moved(fit: Fit, shared: Array, own: Array) -> Fit:
    """A fit after a step of the shared unknowns (S,) and of each view (V, 6)."""
    num_params = len(fit.camera.params)
    rotation = rigid3.rotation_matrix(fit.cam_from_target)
    turn = rigid3.exp_so3(own[:, :3])
    translation = np.einsum("vij,vj->vi", turn, fit.cam_from_target[:, 4:]) + own[:, 3:]
    return replace(
        fit,
        camera=fit.camera.with_params(fit.camera.params + shared[:num_params]),
        cam_from_target=rigid3.from_matrix(turn @ rotation, translation),
        bend=fit.bend + shared[num_params:],
    )


def damped_step(normal: Normal, damping: float, *, hold_poses: bool) -> tuple[Array, Array] | None:
    """The damped step of the shared unknowns and of the views; None where there is none."""
    diagonal = np.diag(normal.shared).copy()
    is_free = diagonal > 0
    own_step = np.zeros_like(normal.own_right)
    shared_step = np.zeros(len(diagonal))
    try:
        if hold_poses:
            reduced, right, coupling = normal.shared.copy(), normal.right, None
        else:
            own = normal.own.copy()
            own[:, range(6), range(6)] *= 1.0 + damping
            # an empty view has nothing to solve
            own[~(np.abs(normal.own).max((1, 2)) > 0)] = np.eye(6)
            solved = np.linalg.solve(
                own, np.concatenate([normal.cross.swapaxes(1, 2), normal.own_right[:, :, None]], 2)
            )
            coupling = solved[:, :, :-1]
            reduced = normal.shared - np.einsum("vsi,vit->st", normal.cross, coupling)
            right = normal.right - np.einsum("vsi,vi->s", normal.cross, solved[:, :, -1])
        if is_free.any():
            scale = 1.0 / np.sqrt(diagonal[is_free])
            reduced = reduced[np.ix_(is_free, is_free)]
            reduced[range(len(reduced)), range(len(reduced))] += damping * diagonal[is_free]
            scaled = reduced * scale[:, None] * scale[None, :]
            shared_step[is_free] = scale * np.linalg.solve(scaled, scale * right[is_free])
        if coupling is not None:
            own_step = solved[:, :, -1] - np.einsum("vis,s->vi", coupling, shared_step)
    except np.linalg.LinAlgError:
        return None
    if not (np.isfinite(shared_step).all() and np.isfinite(own_step).all()):
        return None
    return shared_step, own_step
