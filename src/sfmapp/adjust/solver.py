"""Bundle adjustment: our kernels eliminate the points, a solver that suits the fill finds the cameras, damped steps."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from importlib import import_module
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust import kernels
from sfmapp.adjust.elimination import (
    GROUP,
    Runs,
    TileRows,
    find_meetings,
    find_runs,
    mark_pairs,
    subtract_products,
)
from sfmapp.adjust.gauge import StepsInGauge
from sfmapp.adjust.kernels import Meetings, RobustLoss, Scratch, State, Sums
from sfmapp.adjust.linear import (
    LapackSystem,
    ReducedSystem,
    SolverName,
    TileSystem,
    aligned_empty,
    aligned_zeros,
    assemble,
    choose_solver,
    may_suit_gtsam,
    one_blas_thread,
    prefers_rounds,
    rounds_worth,
)
from sfmapp.adjust.options import REJECTED_WEIGHT, AdjustOptions, AdjustReport, FactorReport
from sfmapp.adjust.priors import IntrinsicPriors
from sfmapp.adjust.problem import EVERYTHING, NOTHING, Problem, Varying, make_problem, write_back
from sfmapp.adjust.progress import StepProgress
from sfmapp.camera.camera import Camera
from sfmapp.events import Events
from sfmapp.scene.reconstruction import Reconstruction

if TYPE_CHECKING:
    from sfmapp.adjust.fronts import FrontOrder
    from sfmapp.adjust.iterative import IterativeSystem

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# Beyond so many blocks only the tiles of pairs that meet are kept.
_MAX_DENSE_BLOCKS = 160
# Beside a shape that has settled, single points may still lower the cost by this share of it.
_POINTS_SETTLED = 1e-3
# Work worth a chunk of its own, and the most chunks.
_CHUNK_OBSERVATIONS, _MAX_CHUNKS = 16384, 8
# Entries of a batch of points, of 192 bytes each, and products of blocks worth a thread.
_BATCH_ENTRIES, _PART_PRODUCTS, _MAX_PARTS = 700_000, 1_000_000, 64
# Up to so many entries, 400 MB, all points are one batch where that lets a factor be held.
_HELD_ENTRIES = 2_000_000


def import_ahead(num_images: int, *, with_factors: bool) -> None:
    """Begin to import gtsam in a thread, which takes 0.7 s and 57 MB, if closing adjustments may ask it.

    They do where they have factors beside the reprojections, or a size at which gtsam solves sparse systems best.
    """
    if (with_factors or may_suit_gtsam(num_images, 6 * num_images)) and "gtsam" not in sys.modules:
        Thread(target=import_module, args=("gtsam",), name="import-gtsam").start()


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
        extra_factors: gtsam.NonlinearFactorGraph over ``X(i)`` (Pose3 world_from_cam of image i; for a rig's pose, the
            image of its sensor 0), ``K(c)`` (Vector of the free parameters of camera c, in the order of
            ``Camera.params``) and ``L(t)`` (Point3 of track t, which is then an unknown of the reduced system), or
            None. Noise and robust kernels are theirs, in units in which a pixel coordinate has a standard deviation of
            one: where it has another, :class:`~sfmapp.adjust.graph.FactorGraph` weighs them right. Factors on constant
            images or points only add to the cost; those on constant cameras, unregistered images and points without a
            place are left out.
        threads: at most this many; the result does not depend on it.
        events: told of every step of long adjustments, and asked for cancellation.

    Raises:
        InterruptedRunError: on cancellation; the reconstruction then holds the best state so far.
        ValueError: a frame of a rig is marked in part, or a factor is over an image that has not the rig's pose.
    """
    if options.backend == "gtsam":
        from sfmapp.adjust.reference import adjust_with_gtsam

        return adjust_with_gtsam(
            reconstruction, options, varying, prior_cameras=prior_cameras, extra_factors=extra_factors, events=events
        )
    is_closing = extra_factors is not None and extra_factors.size() > 0
    engine = make_engine(
        reconstruction, options, varying, prior_cameras=prior_cameras, extra_factors=extra_factors,
        is_closing=is_closing, may_iterate=True,
    )  # fmt: skip
    return run_engine(engine, reconstruction, options, threads=threads, events=events)


def run_engine(
    engine: Engine, reconstruction: Reconstruction, options: AdjustOptions, *, threads: int, events: Events | None
) -> AdjustReport:
    """Adjust, and put the state into the reconstruction."""
    start = time.perf_counter()
    problem = engine.problem
    workers = min(threads, engine.num_tasks)
    with ThreadPoolExecutor(workers) if workers > 1 else nullcontext() as pool, engine.lone():
        try:
            outcome = _minimize(engine, options, pool.map if pool is not None else map, events)
        finally:
            write_back(problem, reconstruction)
    variance = engine.noise_px**2
    return replace(
        outcome, initial_cost=outcome.initial_cost / variance, final_cost=outcome.final_cost / variance,
        num_images=int((problem.image_block >= 0).sum()), num_cameras=int((problem.camera_block >= 0).sum()),
        num_points=len(problem.track_idx), num_observations=problem.num_observations,
        num_unknowns=int(problem.block_dim.sum()), solver=engine.solver, fill=engine.fill, noise_px=engine.noise_px,
        factors=engine.factor_reports() if engine.is_closing else (),
        num_left_out=engine.extras.num_left_out if engine.extras else 0,
        wall_s=time.perf_counter() - start,
    )  # fmt: skip


def make_engine(
    reconstruction: Reconstruction,
    options: AdjustOptions,
    varying: Varying = EVERYTHING,
    *,
    prior_cameras: Sequence[Camera] | None = None,
    extra_factors: Any = None,
    is_closing: bool = False,
    may_iterate: bool = False,
    noise_px: float = 1.0,
) -> Engine:
    """The engine over a reconstruction's problem, priors and extra factors; arguments as of :func:`adjust_bundle`.

    Args:
        extra_factors: a gtsam graph, or what was made of one.
        is_closing: the reduced system is left to gtsam or LAPACK.
        may_iterate: where it is so large and full that conjugate gradients are clearly quicker it is never made: for
            those who want steps, and no more.
        noise_px: of a pixel coordinate, against which priors and extra factors are weighed.
    """
    extras = extra_factors
    if extra_factors is not None and not hasattr(extra_factors, "attach"):
        from sfmapp.adjust.factors import ExtraFactors

        extras = ExtraFactors(extra_factors) if extra_factors.size() > 0 else None
    problem = make_problem(
        reconstruction, refine=options.refine, varying=varying, mentioned=extras.mentioned if extras else NOTHING
    )
    if extras is not None:
        extras.attach(problem)
    priors = IntrinsicPriors(problem, prior_cameras, options)
    return Engine(problem, options, priors, extras, is_closing=is_closing, may_iterate=may_iterate, noise_px=noise_px)


class Engine:
    """The arrays of one problem and the four things to do with them: linearise, solve, try, accept."""

    def __init__(
        self,
        problem: Problem,
        options: AdjustOptions,
        priors: IntrinsicPriors,
        extras: Any = None,
        *,
        is_closing: bool = False,
        may_iterate: bool = False,
        noise_px: float = 1.0,
    ) -> None:
        p = problem
        self.problem, self.priors, self.extras = p, priors, extras
        self.loss = RobustLoss(kernels.LOSS_IDS[options.loss], options.loss_scale_px**2)
        self.noise_px, self.is_closing = noise_px, is_closing
        priors.weight *= noise_px**2
        if extras is not None:
            extras.weight = noise_px**2
        blocks, images = p.num_blocks, len(p.image_idx)
        self.solver: SolverName = "tiles"
        self.fill = 1.0
        self.system: ReducedSystem | None = None
        self.front_order: FrontOrder | None = None
        self.rows = np.empty((images, 12))
        kernels.fill_rows(p.poses, p.image_pose, p.image_mount, p.mounts, self.rows)
        self.meetings = Meetings(p.block_dim, *find_meetings(p.points, p.images(self.rows), p.lenses, blocks))
        self.iterative: IterativeSystem | None = None
        products = self._arrange_tiles(is_closing, may_iterate)
        self._arrange_points(products)
        chunks = self.num_chunks
        num_cross = images if (p.second_block < 0).all() else 2 * images + len(p.camera_idx)
        self.tiles = aligned_zeros(len(self.tile_rows.column) * 64)
        self.own, self.cross = aligned_zeros(chunks, blocks * 64), aligned_zeros(chunks, num_cross * 64)
        self.gradient = aligned_zeros(chunks, 2 * blocks * 8)
        self.diagonal = np.ones(blocks * 8)
        self.factor = np.zeros((len(p.track_idx), 12))
        self.sums = np.zeros((chunks, 2))
        doubles, integers = kernels.scratch_size(blocks, len(p.free.slot))
        self.scratch = [Scratch(aligned_zeros(doubles), np.zeros(integers, np.int64)) for _ in range(chunks)]
        self.new_poses, self.new_rows = np.empty_like(p.poses), np.empty_like(self.rows)
        self.new_canonical, self.new_xyz = np.empty_like(p.canonical), np.empty_like(p.xyz)
        self.damping = self.shape_decrease = 0.0

    def _arrange_tiles(self, is_closing: bool, may_iterate: bool) -> Ints:
        """Choose what solves, and the tiles that are kept; returns how many products each group of their rows sums."""
        p, blocks = self.problem, self.problem.num_blocks
        partners, is_small = self.meetings.partners, blocks <= _MAX_DENSE_BLOCKS
        counts = np.bincount(self.meetings.block // GROUP, partners[:, 1] - partners[:, 0], -(-blocks // GROUP))
        products, keys, order = counts.astype(np.int64), np.arange(blocks * blocks), None
        if blocks and (is_closing or not is_small):
            keys = self._met_pairs()
            self.fill = 2 * len(keys) / (blocks * (blocks + 1))
            self.solver = choose_solver(blocks, int(p.block_dim.sum()), self.fill, is_closing=is_closing)
        if self.solver == "envelope":
            from sfmapp.adjust.front_system import best_order, factored_by  # loads scipy
            from sfmapp.adjust.fronts import FrontOrder
            from sfmapp.adjust.iterative import IterativeSystem, is_of_cluster

            order, flops = best_order(p.block_dim, *np.divmod(keys, blocks), self.fill)
            cost = len(self.meetings.block), int(products.sum()), flops
            may_iterate = may_iterate and self.extras is None
            if may_iterate and prefers_rounds(*cost):
                self.solver, order = "iterative", None
                keys = keys[is_of_cluster(*np.divmod(keys, blocks))]
            elif isinstance(order, FrontOrder):
                self.solver, self.front_order = "fronts", order
        self.has_all_tiles = is_small or self.solver == "tiles"
        self.tile_keys = np.arange(blocks * blocks) if self.has_all_tiles else keys
        numbers = keys if self.has_all_tiles else np.arange(len(keys))
        row, column = np.divmod(self.tile_keys, max(1, blocks))
        self.tile_rows = TileRows(np.searchsorted(row, np.arange(blocks + 1)), column)
        if self.solver == "gtsam":
            from sfmapp.adjust.factors import SparseSystem

            self.system = SparseSystem(p, keys, numbers, self.extras.block_keys() if self.extras else [])
        elif self.solver == "lapack":
            self.system = LapackSystem(p.block_dim, keys, numbers)
        elif self.solver in ("envelope", "fronts", "iterative"):
            near = factored_by(order, p.block_dim, keys, numbers)
            self.system = near
            if self.solver == "iterative":
                self.iterative = IterativeSystem(p.block_dim, near)
            elif may_iterate and cost[0] <= _HELD_ENTRIES:
                self.iterative = IterativeSystem(p.block_dim, near, int(rounds_worth(*cost) / 2))
        return products

    def _met_pairs(self) -> Ints:
        """Pairs of blocks a B + b, a <= b, that meet in a point, an image or a factor, ascending."""
        p, met = self.problem, np.eye(self.problem.num_blocks, dtype=bool)
        mark_pairs(self.meetings, met)
        other, second = p.camera_block[p.image_camera], p.second_block
        shared = (p.image_block >= 0) & (other >= 0)
        met[p.image_block[shared], other[shared]] = True
        shared &= second[p.image_camera] >= 0
        met[p.image_block[shared], second[p.image_camera[shared]]] = True
        met[p.camera_block[second >= 0], second[second >= 0]] = True
        if self.extras is not None:
            met.reshape(-1)[self.extras.pairs] = True
        return np.flatnonzero(met)

    def _arrange_points(self, products: Ints) -> None:
        """Part points in batches of chunks, and groups of rows of tiles in parts that cost alike by their products."""
        p, ptr, num_points = self.problem, self.meetings.ptr, len(self.problem.track_idx)
        # rounds go over all points again and again
        num_batches = 1 if self.iterative is not None else max(1, -(-int(ptr[-1]) // _BATCH_ENTRIES))
        batches = np.searchsorted(ptr, np.linspace(0, int(ptr[-1]), num_batches + 1))
        batches[0], batches[-1] = 0, num_points
        self.num_chunks = int(np.clip(p.num_observations // _CHUNK_OBSERVATIONS, 1, _MAX_CHUNKS))
        ends = p.point_ptr[batches]
        self.limits = np.searchsorted(p.point_ptr, np.linspace(ends[:-1], ends[1:], self.num_chunks + 1, axis=1))
        self.limits[:, 0], self.limits[:, -1] = batches[:-1], batches[1:]
        self.shares = np.searchsorted(p.point_ptr, np.linspace(0, p.num_observations, self.num_chunks + 1))
        self.shares[0], self.shares[-1] = 0, num_points
        self.runs = Runs(*find_runs(self.meetings, batches))
        self.point_rows = aligned_empty(int(np.diff(ptr[batches]).max(initial=0)) * 24)
        num_parts = int(np.clip(products.sum() // _PART_PRODUCTS, 1, _MAX_PARTS))
        self.parts = np.searchsorted(np.cumsum(products), np.linspace(0, products.sum(), num_parts + 1))
        self.parts[0], self.parts[-1] = 0, len(products)

    @property
    def num_tasks(self) -> int:
        """So many threads have something to do."""
        return max(self.num_chunks, len(self.parts) - 1)

    def lone(self) -> AbstractContextManager[Any]:
        """A context in which LAPACK has one thread, if it is asked: with more its bytes would depend on how many."""
        return one_blas_thread() if self.solver in ("lapack", "envelope", "fronts", "iterative") else nullcontext()

    def linearize(self, damping: float, run: Callable[..., Any]) -> float:
        """Reduced system at the current state with damped points; returns the cost of the state.

        The tiles are left as they are while the factor of an earlier step is held.
        """
        p = self.problem
        # more damping than the factor that is held has: the steps to come are others
        is_held = self.iterative is not None and self.iterative.is_held and damping <= self.damping
        if self.iterative is not None:
            self.iterative.is_held = is_held
        self.damping = damping
        points, images, lenses = p.points, p.images(self.rows), p.lenses
        self.own[:], self.cross[:], self.gradient[:] = 0.0, 0.0, 0.0
        cost = 0.0
        for batch, limits in enumerate(self.limits):
            first = self.meetings.ptr[limits]

            def chunk(k: int, limits: Ints = limits, first: Ints = first) -> float:
                sums = Sums(self.own[k], self.cross[k], self.gradient[k])
                rows = self.point_rows[24 * (first[k] - first[0]) :]
                part: float = kernels.reduce_points(
                    (limits[k], limits[k + 1]), points, images, lenses, self.meetings, self.loss, damping, sums,
                    self.factor, rows, self.scratch[k],
                )  # fmt: skip
                return part

            def products(k: int, batch: int = batch, first: Ints = first) -> None:
                subtract_products(
                    (self.parts[k], self.parts[k + 1]), batch, self.meetings, self.runs, self.point_rows,
                    first[0], self.tile_rows, self.tiles,
                )  # fmt: skip

            cost += sum(run(chunk, range(self.num_chunks)))
            if not is_held:
                list(run(products, range(len(self.parts) - 1)))
        own, gradient = np.zeros(p.num_blocks * 64), np.zeros(p.num_blocks * 8)
        self.priors.add(p.canonical, own, gradient)
        if self.extras is not None:
            self.extras.linearize(own, gradient)
        sums = Sums(self.own, self.cross, self.gradient)
        assemble(self.tiles, sums, images, lenses, p.block_dim, self.tile_rows, (own, gradient), self.diagonal)
        total: float = cost + self.other_cost()
        return total

    def other_cost(self, *, is_new: bool = False) -> float:
        """Cost of priors and extra factors at the current state, or at the new one."""
        p, extras = self.problem, self.extras
        if is_new:
            cost = self.priors.cost(self.new_canonical)
            state = (self.new_poses, self.new_canonical, self.new_xyz)
            return cost + extras.cost(*state, extras.new_values) if extras is not None else cost
        cost = self.priors.cost(p.canonical)
        return cost + extras.cost(p.poses, p.canonical, p.xyz, extras.values) if extras is not None else cost

    def solve(self, run: Callable[..., Any] = map) -> Array | None:
        """Step of the blocks (B * 8,), or None where the damped system is not positive definite.

        ``shape_decrease`` is then what the blocks have to gain, were all points at their best already.
        """
        p, blocks, tiles = self.problem, self.problem.num_blocks, self.tiles
        right = -self.gradient[0].reshape(2, -1).sum(0)
        if self.extras is not None:
            self.extras.add_pairs(tiles, self.tile_numbers(self.extras.pairs))
        place = self.tile_numbers(np.arange(blocks) * (blocks + 1))[:, None] * 64 + np.arange(8) * 9
        used = np.arange(8) < p.block_dim[:, None]
        tiles[place[used]] += self.damping * self.diagonal.reshape(-1, 8)[used]
        if self.iterative is not None:
            gauge = partial(StepsInGauge, p, self.num_freedoms, self.diagonal)
            found = self.iterative.solve_with(lambda x: self._product(x, run), gauge, tiles, right, run)
        else:
            if self.system is None:
                self.system = TileSystem(blocks)
            found = self.system.solve(tiles, right.copy(), run)
        if found is None or not np.isfinite(found).all():
            return None
        self.shape_decrease = 0.5 * float(right @ found)
        return found

    def _product(self, x: Array, run: Callable[..., Any]) -> Array:
        """The damped reduced system times x (B * 8,), by the points, without its tiles."""
        from sfmapp.adjust.iterative import add_block_products, add_point_products

        p, out = self.problem, np.zeros((self.num_chunks, len(x)))

        def chunk(k: int) -> None:
            part = int(self.limits[0, k]), int(self.limits[0, k + 1])
            add_point_products(part, self.meetings, self.point_rows, x, out[k])

        list(run(chunk, range(self.num_chunks)))
        for k in range(1, self.num_chunks):
            out[0] += out[k]
        add_block_products(self.own[0], self.cross[0], p.images(self.rows), p.lenses, x, out[0])
        used = (np.arange(8) < p.block_dim[:, None]).ravel()
        total: Array = out[0] + self.damping * self.diagonal * used * x
        return total

    def has_settled(self, sigmas: float, cost: float, decrease: float) -> bool:
        """Whether the last step, which lowered the cost so much, moved no combination of the blocks by more than so
        many of its standard deviations, as the cost that is left tells them, and the points by little.

        The greatest such move is the length of the step in the metric of the reduced system. Robust losses let go of
        single observations long after that, step by step, which moves a few points and nothing else.
        """
        if sigmas == 0.0 or decrease > _POINTS_SETTLED * cost:
            return False
        num_redundant = self.degrees_of_freedom
        return num_redundant > 0 and self.shape_decrease <= sigmas**2 * cost / num_redundant

    @property
    def degrees_of_freedom(self) -> int:
        """Numbers observed beyond those that are unknown, extra factors and their own unknowns left out."""
        p = self.problem
        num_unknowns = int(p.block_dim.sum())
        num_eliminated = int((~p.is_constant & (p.point_block < 0)).sum())
        if self.extras is not None:
            num_unknowns -= self.extras.num_own_dims
        return 2 * p.num_observations - 3 * num_eliminated - num_unknowns + self.num_freedoms

    @property
    def num_freedoms(self) -> int:
        """Of a similarity that changes nothing: seven, six with a baseline, none where something is held."""
        p = self.problem
        is_free = (p.pose_block >= 0).all() and not p.is_constant.any() and self.extras is None
        return 0 if not is_free else 6 if p.has_baseline else 7

    def tile_numbers(self, keys: Ints) -> Ints:
        """Tiles of block pairs a B + b."""
        return keys if self.has_all_tiles else np.searchsorted(self.tile_keys, keys)

    def attempt(self, step: Array, run: Callable[..., Any]) -> tuple[float, float]:
        """Try a step: cost of the new state, and the decrease that the quadratic model predicts."""
        p = self.problem
        points, images, lenses = p.points, p.images(self.rows), p.lenses
        new = State(self.new_rows, self.new_canonical, self.new_xyz)
        kernels.retract(p.poses, p.pose_block, p.image_pose, images, lenses, step, self.new_poses, new)
        if self.extras is not None:
            self.extras.retract(step)

        def chunk(k: int) -> None:
            kernels.substitute_points(
                (self.shares[k], self.shares[k + 1]), points, images, lenses, self.loss, self.factor, step, new,
                self.sums[k], self.scratch[k].doubles,
            )  # fmt: skip

        list(run(chunk, range(self.num_chunks)))
        cost, decrease = float(self.sums[:, 0].sum()), float(self.sums[:, 1].sum())
        decrease += 0.5 * float(step @ (self.damping * self.diagonal * step - self.gradient[0, : len(step)]))
        return cost + self.other_cost(is_new=True), decrease

    def accept(self) -> None:
        """Make the state that was tried the current one."""
        p = self.problem
        p.poses, self.new_poses = self.new_poses, p.poses
        p.canonical, self.new_canonical = self.new_canonical, p.canonical
        p.xyz, self.new_xyz = self.new_xyz, p.xyz
        self.rows, self.new_rows = self.new_rows, self.rows
        if self.extras is not None:
            self.extras.accept()

    def factor_reports(self) -> list[FactorReport]:
        """What each kind of factor comes to at the current state; costs in square standard deviations."""
        p, variance = self.problem, self.noise_px**2
        squares, rejected, cost = kernels.weigh_observations(
            p.points, p.images(self.rows), p.lenses, self.loss, REJECTED_WEIGHT
        )
        rows, kept = 2 * p.num_observations, 2 * (p.num_observations - rejected)
        out = [
            FactorReport(
                kind="reprojection", num_factors=p.num_observations, num_rows=rows, cost=cost / variance,
                normalized_residual=float(np.sqrt(squares / variance / max(1, kept))), num_rejected=rejected,
            )
        ]  # fmt: skip
        if len(self.priors.weight):
            num, cost = len(self.priors.mean), self.priors.cost(p.canonical) / variance
            residual = float(np.sqrt(2 * cost / num))
            out.append(
                FactorReport(
                    kind="intrinsics prior", num_factors=num, num_rows=num, cost=cost, normalized_residual=residual
                )
            )
        return [*out, *(self.extras.reports() if self.extras is not None else [])]


def _minimize(engine: Engine, options: AdjustOptions, run: Callable[..., Any], events: Events | None) -> AdjustReport:
    """Levenberg-Marquardt with the damping rule of Nielsen (1999), as Ceres has it; what took part is not told."""
    problem = engine.problem
    if problem.num_observations == 0 and engine.extras is None:
        return AdjustReport(termination="nothing")
    progress = StepProgress(events, len(problem.image_idx), problem.num_observations, options.max_iterations)
    damping, growth, tolerance = options.initial_damping, 2.0, options.relative_cost_tolerance
    first = cost = engine.linearize(damping, run)
    termination, iterations, rejected = "iterations", 0, 0
    if not np.isfinite(cost):
        return AdjustReport(termination="stalled", initial_cost=cost, final_cost=cost)
    with progress:
        progress.begin(cost)
        while iterations < options.max_iterations:
            iterations += 1
            step = engine.solve(run)
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
                    progress.step(cost)
                    if decrease <= tolerance * (cost + decrease) or engine.has_settled(
                        options.settled_sigmas, cost, decrease
                    ):
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
            progress.step(cost)
            damping *= growth
            growth *= 2.0
            if damping > 1e16:
                termination = "stalled"
                break
            engine.linearize(damping, run)
    return AdjustReport(
        termination=termination, num_iterations=iterations, num_rejected=rejected, initial_cost=first, final_cost=cost
    )
