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

from sfmapp.calibration.kernels import (
    Normal,
    Observations,
    State,
    damped_step,
    moved_poses,
    normal_equations,
    residuals,
)
from sfmapp.camera.camera import Camera
from sfmapp.camera.models import canonical_from_params
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_MAX_STEPS = 100
FIRST_DAMPING, LARGEST_DAMPING = 1e-4, 1e10
# least by which a step that does as it promised divides the damping (Madsen, Nielsen and Tingleff, "Methods for
# non-linear least squares problems", 2004, equation 2.21)
_LEAST_FACTOR = 0.01
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
    slots, spread = param_of_slot(start.camera.model), canonical_from_params(start.camera.model)
    if hold_camera:
        slots = np.full_like(slots, -1)
    num_params, num_views = len(start.camera.params), len(obs.ptr) - 1
    num_shared = num_params + len(start.bend)
    normal, next_normal = (empty_normal(num_shared, num_views) for _ in range(2))
    params, state = start.camera.params, _state(start)
    damping, factor, steps, is_moved = FIRST_DAMPING, 2.0, 0, False
    cost = normal_equations(state, obs, slots, normal)
    while steps < _MAX_STEPS and math.isfinite(cost) and damping < LARGEST_DAMPING:
        step = step_of(normal, damping, hold_poses=hold_poses)
        if step is None:
            damping *= factor
            continue
        shared, own, promised = step
        tried = params + shared[:num_params]
        next_state = _moved(state, spread @ tried, own, shared[num_params:])
        new_cost = normal_equations(next_state, obs, slots, next_normal)
        if not new_cost <= cost:
            damping, factor = damping * factor, factor * 2.0
            continue
        steps += 1
        is_converged, is_moved = cost - new_cost <= _CONVERGED * cost, True
        damping *= max(_LEAST_FACTOR, 1.0 - (2.0 * (cost - new_cost) / promised - 1.0) ** 3) if promised > 0 else 1.0
        params, state, cost, factor = tried, next_state, new_cost, 2.0
        normal, next_normal = next_normal, normal
        if is_converged:
            break
    if not is_moved:
        return replace(start, cost=cost, num_steps=steps)
    poses = rigid3.from_matrix(state.rotation, state.translation)
    return Fit(start.camera.with_params(params), poses, state.bend, cost, steps)


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


def _moved(state: State, canonical: Array, own: Array, bend: Array) -> State:
    """The unknowns after a step: the sixteen numbers of the camera that it leads to, steps of views (V, 6), and of the
    shape."""
    row = state.row.copy()
    row[: len(canonical)] = canonical
    after = State(row, np.empty_like(state.rotation), np.empty_like(state.translation), state.bend + bend)
    moved_poses(state, own, after.rotation, after.translation)
    return after


def step_of(normal: Normal, damping: float, *, hold_poses: bool) -> tuple[Array, Array, float] | None:
    """The damped step of the shared unknowns (S,) and of the views (V, 6), and the decrease of the cost that it
    promises; None where there is none."""
    shared_step, own_step = np.empty_like(normal.right), np.empty_like(normal.own_right)
    promised = damped_step(normal, damping, hold_poses, shared_step, own_step)
    return (shared_step, own_step, promised) if math.isfinite(promised) else None
