"""The joint refinement of cameras that are mounted together, of where they sit in the rig, and of boards.

A view is a board b in a camera c at a shot t: ``cam_from_rig[c] . rig_from_world[t] . world_from_board[b]``. Each
camera alone has the normal equations of :mod:`sfmapp.calibration.adjustment`, over its parameters and the pose of the
board in each of its views; by the chain rule a small motion of that pose is a motion of the camera, of the rig or of
the board (the adjoint of SE(3); Sola et al., "A micro Lie theory for state estimation in robotics", 2018). So the
equations of a rig are those of its cameras, moved, and the pose of the rig at every shot is eliminated as that of a
view is.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.adjustment import (
    FIRST_DAMPING,
    LARGEST_DAMPING,
    TargetView,
    empty_normal,
    observations_of,
    param_of_slot,
    step_of,
)
from sfmapp.calibration.kernels import Normal, Observations, State, normal_equations, residuals
from sfmapp.camera.camera import Camera
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_MAX_STEPS = 80
# relative: a step that lowers the cost by less is the last
_CONVERGED = 1e-12
# the same of a shot whose cost is only compared
_SETTLED = 1e-6


@dataclass(frozen=True)
class RigView:
    """A board in a photograph.

    Attributes:
        camera, shot, board: positions among the cameras, the moments of exposure and the boards.
        view: the points.
    """

    camera: int
    shot: int
    board: int
    view: TargetView


@dataclass(frozen=True)
class RigFit:
    """C cameras, T shots, B boards that are fixed to each other.

    Attributes:
        cameras: C.
        cam_from_rig: (C, 7), the first the identity.
        rig_from_world: (T, 7). The world is the frame of the first board.
        world_from_board: (B, 7), the first the identity.
        bend: (3 B,) shapes of the boards, as :func:`sfmapp.calibration.solve.bend_basis` has them; empty for flat ones.
        cost: half the weighted squares of the residuals.
    """

    cameras: tuple[Camera, ...]
    cam_from_rig: Array
    rig_from_world: Array
    world_from_board: Array
    bend: Array = field(default_factory=lambda: np.zeros(0))
    cost: float = math.inf


class RigProblem:
    """The views of a rig by camera, as kernels read them.

    Args:
        views: at least one; two views of a problem may share camera and shot where boards differ.
        is_held: (C,) cameras whose parameters stay.
        shapes: of each view (N, 3 B), how the shapes of the boards move its points; None for flat boards.

    Attributes:
        order: (V,) position among ``views`` of each view, sorted by camera.
        camera, shot, board: (V,) of the views in that order.
        obs: of each camera.
    """

    def __init__(
        self, views: Sequence[RigView], is_held: Sequence[bool], shapes: Sequence[Array] | None = None
    ) -> None:
        camera = np.array([view.camera for view in views], np.int64)
        self.order: Ints = np.argsort(camera, kind="stable").astype(np.int64)
        self.camera: Ints = camera[self.order]
        self.shot: Ints = np.array([views[i].shot for i in self.order], np.int64)
        self.board: Ints = np.array([views[i].board for i in self.order], np.int64)
        self.is_held = tuple(is_held)
        self.of_camera = [np.flatnonzero(self.camera == c) for c in range(len(self.is_held))]
        self.obs = [
            observations_of(
                [views[self.order[v]].view for v in mine],
                None if shapes is None else [shapes[self.order[v]] for v in mine],
            )
            for mine in self.of_camera
        ]
        self.num_shots = int(self.shot.max()) + 1
        self.num_boards = int(self.board.max()) + 1

    def weighted(self, weights: Sequence[Array]) -> list[Observations]:
        """The observations of each camera with other weights (N,) of the squared residuals."""
        return [obs._replace(weight=weight) for obs, weight in zip(self.obs, weights, strict=True)]


@dataclass(frozen=True)
class Places:
    """Where the unknowns stand that all shots share: parameters of every camera, then the poses of cameras but the
    first, then those of boards but the first, then shapes of boards. A pose has a turn (radians) and a shift about the
    axes of its frame."""

    params: tuple[slice, ...]
    cam_from_rig: tuple[slice, ...]
    world_from_board: tuple[slice, ...]
    bend: slice
    total: int


def places_of(fit: RigFit) -> Places:
    """Where the shared unknowns of a rig stand."""
    ends = np.cumsum([0, *(len(camera.params) for camera in fit.cameras)]).tolist()
    params = tuple(slice(a, b) for a, b in itertools.pairwise(ends))
    num_poses = len(fit.cameras) - 1 + len(fit.world_from_board) - 1
    starts = [ends[-1] + 6 * k for k in range(num_poses)]
    poses = tuple(slice(start, start + 6) for start in starts)
    cut, shapes = len(fit.cameras) - 1, ends[-1] + 6 * num_poses
    total = shapes + len(fit.bend)
    return Places(params, poses[:cut], poses[cut:], slice(shapes, total), total)


def cam_from_board(fit: RigFit, problem: RigProblem, camera: int) -> Array:
    """(V, 7) poses of the boards in the views of a camera."""
    mine = problem.of_camera[camera]
    rig_from_board = rigid3.compose(fit.rig_from_world[problem.shot[mine]], fit.world_from_board[problem.board[mine]])
    return rigid3.compose(fit.cam_from_rig[camera], rig_from_board)


def rig_residuals(fit: RigFit, problem: RigProblem) -> list[Array]:
    """(N, 2) measured minus projected pixels of each camera; NaN where the lens does not look."""
    out = [np.empty_like(obs.xy) for obs in problem.obs]
    for c, obs in enumerate(problem.obs):
        residuals(_state(fit, c, cam_from_board(fit, problem, c)), obs, out[c])
    return out


def rig_normal(fit: RigFit, problem: RigProblem, obs: Sequence[Observations]) -> tuple[float, Normal]:
    """The cost and the normal equations; those of parameters that are held are zero."""
    total, places, cost = empty_normal(places_of(fit).total, problem.num_shots), places_of(fit), 0.0
    for c in range(len(fit.cameras)):
        part = camera_normal(fit, problem, obs[c], c)
        cost += part[0]
        for whole, one in zip(total, part[1], strict=True):
            whole += one
    assert places.total == len(total.right)
    return cost, total


def camera_normal(fit: RigFit, problem: RigProblem, obs: Observations, camera: int) -> tuple[float, Normal]:
    """What one camera adds to :func:`rig_normal`."""
    mine, places = problem.of_camera[camera], places_of(fit)
    model = fit.cameras[camera].model
    slots = np.full_like(param_of_slot(model), -1) if problem.is_held[camera] else param_of_slot(model)
    own = empty_normal(len(fit.cameras[camera].params) + len(fit.bend), len(mine))
    poses = cam_from_board(fit, problem, camera)
    cost = normal_equations(_state(fit, camera, poses), obs, slots, own)
    shots, at = problem.shot[mine], np.r_[places.params[camera], places.bend]
    by_shot = adjoint(fit.cam_from_rig[camera])
    by_pose = np.zeros((len(mine), 6, places.total))
    if camera > 0:
        by_pose[:, range(6), range(*places.cam_from_rig[camera - 1].indices(places.total))] = 1.0
    cam_from_world = rigid3.compose(fit.cam_from_rig[camera], fit.rig_from_world[shots])
    for b, place in enumerate(places.world_from_board, 1):
        shows = problem.board[mine] == b
        by_pose[shows, :, place] = adjoint(cam_from_world[shows])
    out = empty_normal(places.total, problem.num_shots)
    half = np.zeros((len(mine), places.total, 6))
    half[:, at] = own.cross
    crossed = np.einsum("vsi,vit->st", half, by_pose)
    moved = by_pose.swapaxes(1, 2) @ own.own
    out.shared[np.ix_(at, at)] += own.shared
    out.shared[:] += crossed + crossed.T + np.einsum("vsi,vit->st", moved, by_pose)
    out.right[at] += own.right
    out.right[:] += np.einsum("vis,vi->s", by_pose, own.own_right)
    np.add.at(out.cross, shots, (half + moved) @ by_shot)
    np.add.at(out.own, shots, by_shot.T @ own.own @ by_shot)
    np.add.at(out.own_right, shots, own.own_right @ by_shot)
    return cost, out


def adjoint(pose: Array) -> Array:
    """(..., 6, 6) how a small motion (turn, shift) behind a pose ``b_from_a`` appears in front of it:
    ``b_from_a exp(x) = exp(Ad x) b_from_a``."""
    rotation = rigid3.rotation_matrix(pose)
    out = np.zeros((*rotation.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    out[..., 3:, :3] = rigid3.skew(pose[..., 4:]) @ rotation
    return out


def refine_rig(start: RigFit, problem: RigProblem, weights: Sequence[Array] | None = None) -> RigFit:
    """The rig that makes the weighted squares of the residuals least, from a start that is near.

    Args:
        weights: (N,) of the squared residuals of each camera; None: 1.
    """
    obs = problem.obs if weights is None else problem.weighted(weights)
    fit, damping, factor, steps = start, FIRST_DAMPING, 4.0, 0
    cost, normal = rig_normal(fit, problem, obs)
    while steps < _MAX_STEPS and math.isfinite(cost) and damping < LARGEST_DAMPING:
        step = step_of(normal, damping, hold_poses=False)
        tried = None if step is None else _moved(fit, *step[:2])
        new_cost = math.nan if tried is None else float(shot_costs(tried, problem, obs).sum())
        if tried is None or not new_cost <= cost:
            damping, factor = damping * factor, factor * 2.0
            continue
        steps += 1
        is_converged = cost - new_cost <= _CONVERGED * cost
        fit, damping, factor = tried, damping * 0.1, 4.0
        cost, normal = rig_normal(fit, problem, obs)
        if is_converged:
            break
    return replace(fit, cost=cost)


def refine_shots(start: RigFit, problem: RigProblem, weights: Sequence[Array]) -> tuple[RigFit, Array]:
    """The best pose of the rig at every shot, each for itself, with all else held, and what each costs (T,).

    Returns:
        Infinite costs for shots whose start has a point where a lens does not look.
    """
    obs = problem.weighted(weights)
    fit, cost = start, shot_costs(start, problem, obs)
    is_lost = ~np.isfinite(cost)
    if is_lost.any():
        ptrs = [(one, np.repeat(is_lost[problem.shot[mine]], np.diff(one.ptr)))
                for one, mine in zip(obs, problem.of_camera, strict=True)]  # fmt: skip
        obs = [one._replace(weight=np.where(lost, 0.0, one.weight)) for one, lost in ptrs]
    damping, is_moving = np.full(len(cost), FIRST_DAMPING), ~is_lost
    for _ in range(_MAX_STEPS):
        if not is_moving.any():
            break
        normal = rig_normal(fit, problem, obs)[1]
        own = normal.own.copy()
        own[:, range(6), range(6)] *= 1.0 + damping[:, None]
        own[~is_moving] = np.eye(6)
        step = np.where(is_moving[:, None], np.linalg.solve(own, normal.own_right[:, :, None])[:, :, 0], 0.0)
        tried = replace(fit, rig_from_world=_turned(fit.rig_from_world, step))
        new_cost = shot_costs(tried, problem, obs)
        is_better = is_moving & (new_cost <= cost)
        moved = np.where(is_better[:, None], tried.rig_from_world, fit.rig_from_world)
        fit = replace(fit, rig_from_world=moved)
        is_moving &= ~(is_better & (cost - new_cost <= _SETTLED * cost)) & (damping < LARGEST_DAMPING)
        cost = np.where(is_better, new_cost, cost)
        damping = np.where(is_better, damping * 0.1, damping * 10.0)
    return fit, np.where(is_lost, np.inf, cost)


def shot_costs(fit: RigFit, problem: RigProblem, obs: Sequence[Observations]) -> Array:
    """(T,) half the weighted squares of the residuals of each shot; not finite where a lens does not look."""
    out = np.zeros(problem.num_shots)
    for r, one, mine in zip(rig_residuals(fit, problem), obs, problem.of_camera, strict=True):
        square = np.where(one.weight > 0, one.weight * (r**2).sum(1), 0.0)
        np.add.at(out, np.repeat(problem.shot[mine], np.diff(one.ptr)), 0.5 * square)
    return out


def _state(fit: RigFit, camera: int, poses: Array) -> State:
    rotation, translation = rigid3.rotation_matrix(poses), np.ascontiguousarray(poses[:, 4:])
    return State(fit.cameras[camera].canonical, rotation, translation, fit.bend)


def _moved(fit: RigFit, shared: Array, own: Array) -> RigFit:
    """A rig after a step of the shared unknowns and of each shot (T, 6)."""
    places = places_of(fit)
    cameras = tuple(
        camera.with_params(camera.params + shared[place])
        for camera, place in zip(fit.cameras, places.params, strict=True)
    )

    def moved(poses: Array, slots: Sequence[slice]) -> Array:
        steps = np.array([shared[place] for place in slots]).reshape(-1, 6)
        return np.concatenate([poses[:1], _turned(poses[1:], steps)])

    return RigFit(
        cameras, moved(fit.cam_from_rig, places.cam_from_rig), _turned(fit.rig_from_world, own),
        moved(fit.world_from_board, places.world_from_board), fit.bend + shared[places.bend],
    )  # fmt: skip


def _turned(poses: Array, steps: Array) -> Array:
    """Poses (N, 7) after small motions (N, 6) in their own frames."""
    turn = rigid3.exp_so3(steps[:, :3])
    shift = np.einsum("nij,nj->ni", turn, poses[:, 4:]) + steps[:, 3:]
    return rigid3.from_matrix(turn @ rigid3.rotation_matrix(poses), shift)
