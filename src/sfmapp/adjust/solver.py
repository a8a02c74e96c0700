"""Bundle adjustment: our kernels eliminate the points, dense tiles or gtsam solve for the cameras, damped steps."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust import kernels
from sfmapp.adjust.kernels import BlockArrays, RobustLoss, Scratch, State, Sums, find_slot
from sfmapp.adjust.linear import aligned_zeros, assemble, factorize_tiles, mark_pairs, number_keys, solve_tiles
from sfmapp.adjust.options import AdjustOptions, AdjustReport
from sfmapp.adjust.priors import IntrinsicPriors
from sfmapp.adjust.problem import EVERYTHING, Problem, Varying, make_problem, write_back
from sfmapp.camera.camera import Camera
from sfmapp.events import Events
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Up to this many blocks, and above if this share of all pairs meets, the dense tile factor beats gtsam's sparse one.
_MAX_DENSE_BLOCKS, _DENSE_SHARE = 160, 0.3
# Work worth a chunk of its own, and the most memory that the chunks' private sums may take together.
_CHUNK_OBSERVATIONS, _MAX_CHUNKS, _CHUNK_BYTES = 16384, 8, 1 << 26


def adjust_bundle(
    reconstruction: Reconstruction,
    options: AdjustOptions = AdjustOptions(),
    *,
    varying: Varying = EVERYTHING,
    prior_cameras: Sequence[Camera] | None = None,
    extra_factors: Any = None,
    threads: int = 1,
    events: Events | None = None,
) -> AdjustReport:
    """Minimise the reprojection errors of the inlier observations, in place, over poses, intrinsics and points.

    The gauge is left free unless something holds it (a constant image, a constant point, extra factors): the damping
    picks the nearest solution. The state is never worse than it was given.

    Args:
        reconstruction: poses, points and cameras are replaced; whatever is constant keeps its bits.
        varying: which poses, intrinsics and points take part and may change; all by default.
        prior_cameras: (C,) cameras as they were known beforehand: Gaussian priors around their parameters, with
            ``focal_sigma`` for focal lengths and the options' sigmas for the rest. None for no priors.
        extra_factors: gtsam.NonlinearFactorGraph over ``X(i)`` (Pose3 world_from_cam of image i; for a rig's pose,
            the image of its sensor 0) and ``K(c)`` (Vector of the free parameters of camera c, in the order of
            ``Camera.params``), or None. Factors on constant images or cameras only add to the cost.
        threads: at most this many; the result does not depend on it.
        events: asked for cancellation at every step.

    Raises:
        InterruptedRunError: on cancellation; the reconstruction then holds the best state so far.
        ValueError: a frame of a rig is marked in part, or a factor is over an image that has not the rig's pose.
    """
    start = time.perf_counter()
    if options.backend == "gtsam":
        from sfmapp.adjust.reference import adjust_with_gtsam

        return adjust_with_gtsam(
            reconstruction, options, varying, prior_cameras=prior_cameras, extra_factors=extra_factors, events=events
        )
    engine = make_engine(reconstruction, options, varying, prior_cameras=prior_cameras, extra_factors=extra_factors)
    problem = engine.problem
    workers = min(threads, engine.num_chunks)
    with ThreadPoolExecutor(workers) if workers > 1 else nullcontext() as pool:
        try:
            outcome = _minimize(engine, options, pool.map if pool is not None else map, events)
        finally:
            write_back(problem, reconstruction)
    return replace(
        outcome, num_images=int((problem.image_block >= 0).sum()), num_cameras=int((problem.camera_block >= 0).sum()),
        num_points=len(problem.track_idx), num_observations=problem.num_observations, solver=engine.solver,
        wall_s=time.perf_counter() - start,
    )  # fmt: skip


def make_engine(
    reconstruction: Reconstruction,
    options: AdjustOptions,
    varying: Varying = EVERYTHING,
    *,
    prior_cameras: Sequence[Camera] | None = None,
    extra_factors: Any = None,
) -> Engine:
    """The engine over a reconstruction's problem, priors and extra factors; arguments as of :func:`adjust_bundle`."""
    extras = None
    if extra_factors is not None and extra_factors.size() > 0:
        from sfmapp.adjust.factors import ExtraFactors

        extras = ExtraFactors(extra_factors)
    problem = make_problem(
        reconstruction, refine=options.refine, varying=varying,
        extra_images=extras.images if extras else (), extra_cameras=extras.cameras if extras else (),
    )  # fmt: skip
    if extras is not None:
        extras.attach(problem)
    return Engine(problem, options, IntrinsicPriors(problem, prior_cameras, options), extras)


class Engine:
    """The arrays of one problem and the four things to do with them: linearise, solve, try, accept."""

    def __init__(self, problem: Problem, options: AdjustOptions, priors: IntrinsicPriors, extras: Any = None) -> None:
        p = problem
        self.problem, self.priors, self.extras = p, priors, extras
        self.loss = RobustLoss(kernels.LOSS_IDS[options.loss], options.loss_scale_px**2)
        blocks, images = p.num_blocks, len(p.image_idx)
        empty = np.zeros(0, np.int64)
        self.solver, self.hash_keys, self.hash_values, self.num_tiles = "dense", empty, empty, blocks * blocks
        self.rows = np.empty((images, 12))
        kernels.fill_rows(p.poses, p.image_pose, p.image_mount, p.mounts, self.rows)
        if blocks > _MAX_DENSE_BLOCKS:
            self._choose_sparse()
        fitting = max(1, _CHUNK_BYTES // max(1, self.num_tiles * 512))
        self.num_chunks = int(np.clip(p.num_observations // _CHUNK_OBSERVATIONS, 1, min(_MAX_CHUNKS, fitting)))
        shares = np.linspace(0, p.num_observations, self.num_chunks + 1)
        self.limits = np.searchsorted(p.point_ptr, shares)
        self.limits[0], self.limits[-1] = 0, len(p.track_idx)
        chunks = self.num_chunks
        num_cross = images if (p.second_block < 0).all() else 2 * images + len(p.camera_idx)
        self.tiles = aligned_zeros(chunks, self.num_tiles * 64)
        self.own, self.cross = aligned_zeros(chunks, blocks * 64), aligned_zeros(chunks, num_cross * 64)
        self.gradient = aligned_zeros(chunks, 2 * blocks * 8)
        self.inverse = aligned_zeros(blocks * 64)
        self.diagonal = np.ones(blocks * 8)
        self.factor = np.zeros((len(p.track_idx), 12))
        self.sums = np.zeros((chunks, 2))
        sizes = [
            kernels.scratch_size(self.limits[k], self.limits[k + 1], p.point_ptr, blocks, len(p.free.slot))
            for k in range(chunks)
        ]
        self.scratch = [Scratch(aligned_zeros(doubles), np.zeros(integers, np.int64)) for doubles, integers in sizes]
        self.new_poses, self.new_rows = np.empty_like(p.poses), np.empty_like(self.rows)
        self.new_canonical, self.new_xyz = np.empty_like(p.canonical), np.empty_like(p.xyz)
        self.damping = 0.0

    def _choose_sparse(self) -> None:
        """Keep only the tiles of blocks that meet, and leave their factor to gtsam, unless that is most of them."""
        from sfmapp.adjust.factors import SparseSystem

        p, blocks = self.problem, self.problem.num_blocks
        met = np.eye(blocks, dtype=bool)
        mark_pairs(p.points, p.images(self.rows), p.lenses, met)
        if self.extras is not None:
            met.reshape(-1)[self.extras.pairs] = True
        keys = np.flatnonzero(met)
        if 2 * len(keys) > _DENSE_SHARE * blocks * blocks:
            return
        self.solver, self.num_tiles = "sparse", len(keys)
        self.hash_keys, self.hash_values = number_keys(keys)
        self.sparse = SparseSystem(p, keys)

    def linearize(self, damping: float, run: Callable[..., Any]) -> float:
        """Reduced system at the current state with damped points; returns the cost of the state."""
        p, self.damping = self.problem, damping
        points, images, lenses = p.points, p.images(self.rows), p.lenses
        blocks = BlockArrays(p.block_dim, self.hash_keys, self.hash_values)

        def chunk(k: int) -> float:
            sums = Sums(self.tiles[k], self.own[k], self.cross[k], self.gradient[k])
            cost: float = kernels.reduce_points(
                (self.limits[k], self.limits[k + 1]), points, images, lenses, blocks, self.loss, damping, sums,
                self.factor, self.scratch[k],
            )  # fmt: skip
            return cost

        cost = sum(run(chunk, range(self.num_chunks)))
        own, gradient = np.zeros(p.num_blocks * 64), np.zeros(p.num_blocks * 8)
        self.priors.add(p.canonical, own, gradient)
        if self.extras is not None:
            self.extras.linearize(own, gradient)
        every = Sums(self.tiles, self.own, self.cross, self.gradient)
        assemble(every, images, lenses, blocks, own, gradient, self.diagonal)
        return cost + self.other_cost(p.poses, p.canonical)

    def other_cost(self, poses: Array, canonical: Array) -> float:
        """Cost of priors and extra factors."""
        cost = self.priors.cost(canonical)
        return cost + self.extras.cost(poses, canonical) if self.extras is not None else cost

    def solve(self) -> Array | None:
        """Step of the blocks (B * 8,), or None where the damped system is not positive definite."""
        p, blocks, tiles = self.problem, self.problem.num_blocks, self.tiles[0]
        step = -self.gradient[0].reshape(2, -1).sum(0)
        if self.extras is not None:
            self.extras.add_pairs(tiles, self.tile_numbers(self.extras.pairs))
        place = self.tile_numbers(np.arange(blocks) * (blocks + 1))[:, None] * 64 + np.arange(8) * 9
        used = np.arange(8) < p.block_dim[:, None]
        tiles[place[used]] += self.damping * self.diagonal.reshape(-1, 8)[used]
        if self.solver == "sparse":
            return self.sparse.solve(tiles.reshape(-1, 8, 8), step)
        if not factorize_tiles(tiles, blocks, self.inverse):
            return None
        solve_tiles(tiles, blocks, self.inverse, step)
        return step if np.isfinite(step).all() else None

    def tile_numbers(self, keys: NDArray[np.int64]) -> NDArray[np.int64]:
        """Tiles of block pairs a B + b."""
        if self.solver == "dense":
            return keys
        return np.array([find_slot(self.hash_keys, self.hash_values, key) for key in keys], np.int64)

    def attempt(self, step: Array, run: Callable[..., Any]) -> tuple[float, float]:
        """Try a step: cost of the new state, and the decrease that the quadratic model predicts."""
        p = self.problem
        points, images, lenses = p.points, p.images(self.rows), p.lenses
        new = State(self.new_rows, self.new_canonical, self.new_xyz)
        kernels.retract(p.poses, p.pose_block, p.image_pose, images, lenses, step, self.new_poses, new)

        def chunk(k: int) -> None:
            kernels.substitute_points(
                (self.limits[k], self.limits[k + 1]), points, images, lenses, self.loss, self.factor, step, new,
                self.sums[k], self.scratch[k].doubles,
            )  # fmt: skip

        list(run(chunk, range(self.num_chunks)))
        cost, decrease = float(self.sums[:, 0].sum()), float(self.sums[:, 1].sum())
        decrease += 0.5 * float(step @ (self.damping * self.diagonal * step - self.gradient[0, : len(step)]))
        return cost + self.other_cost(self.new_poses, self.new_canonical), decrease

    def accept(self) -> None:
        """Make the state that was tried the current one."""
        p = self.problem
        p.poses, self.new_poses = self.new_poses, p.poses
        p.canonical, self.new_canonical = self.new_canonical, p.canonical
        p.xyz, self.new_xyz = self.new_xyz, p.xyz
        self.rows, self.new_rows = self.new_rows, self.rows


def _minimize(engine: Engine, options: AdjustOptions, run: Callable[..., Any], events: Events | None) -> AdjustReport:
    """Levenberg-Marquardt with the damping rule of Nielsen (1999), as Ceres has it; what took part is not told."""
    problem = engine.problem
    if problem.num_observations == 0 and engine.extras is None:
        return AdjustReport("nothing")
    damping, growth, tolerance = options.initial_damping, 2.0, options.relative_cost_tolerance
    first = cost = engine.linearize(damping, run)
    termination, iterations, rejected = "iterations", 0, 0
    if not np.isfinite(cost):
        return AdjustReport("stalled", initial_cost=cost, final_cost=cost)
    while iterations < options.max_iterations:
        if events is not None:
            events.raise_if_cancelled()
        iterations += 1
        step = engine.solve()
        if step is not None:
            new_cost, predicted = engine.attempt(step, run)
            if predicted <= 1e-3 * tolerance * cost:
                # nothing left to gain that would show; take it if it is a gain at all
                if new_cost < cost:
                    engine.accept()
                    cost = new_cost
                termination = "converged"
                break
            gain = (cost - new_cost) / predicted
            if new_cost < cost and gain > 1e-3:
                engine.accept()
                decrease, cost = cost - new_cost, new_cost
                if decrease <= tolerance * (cost + decrease):
                    termination = "converged"
                    break
                damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), 1e-10)
                growth = 2.0
                if iterations < options.max_iterations:
                    engine.linearize(damping, run)
                continue
            if abs(cost - new_cost) <= tolerance * cost:
                termination = "converged"
                break
        rejected += 1
        damping *= growth
        growth *= 2.0
        if damping > 1e16:
            termination = "stalled"
            break
        engine.linearize(damping, run)
    return AdjustReport(termination, iterations, rejected, first, cost)
