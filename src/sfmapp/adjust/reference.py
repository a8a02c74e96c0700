"""The same adjustment as a plain gtsam graph, one factor per observation: slow, short, and written by somebody else.

Poses are ``X(q)`` (world_from_cam), points ``L(p)``, cameras ``C(c)``: Cal3Bundler for models with one focal length,
Cal3DS2 for those with two, Cal3Fisheye. What is not free, or is in gtsam's model and not in ours, is held by a prior;
so is the place ``V(i)`` of an image on its rig.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, K, L, V, X
from numpy.typing import NDArray

from sfmapp.adjust.factors import ExtraFactors, gtsam_pose
from sfmapp.adjust.options import AdjustOptions, AdjustReport
from sfmapp.adjust.priors import IntrinsicPriors
from sfmapp.adjust.problem import Problem, Varying, free_values, make_problem, write_back
from sfmapp.camera.camera import Camera
from sfmapp.camera.lens import BROWN, RADIAL_FISHEYE
from sfmapp.camera.models import PARAM_NAMES, canonical_from_params
from sfmapp.errors import UsageError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Our parameters in gtsam's order, None where ours have no such thing, and the canonical slots of all of them.
_BUNDLER = ("f", "k1", "k2")
_DS2 = ("fx", "fy", None, "cx", "cy", "k1", "k2", "p1", "p2")
_FISHEYE = ("fx", "fy", None, "cx", "cy", "k1", "k2", "k3", "k4")
# Standard deviation of what must not move, in its own unit: far below any effect, and Cholesky keeps its digits.
_HELD = 1e-7


def adjust_with_gtsam(
    reconstruction: Reconstruction,
    options: AdjustOptions,
    varying: Varying,
    *,
    prior_cameras: Sequence[Camera] | None = None,
    extra_factors: Any = None,
    events: Events | None = None,
) -> AdjustReport:
    """``adjust_bundle`` with gtsam's own factors and Levenberg-Marquardt. Cancellation is looked at once, before."""
    start = time.perf_counter()
    if events is not None:
        events.raise_if_cancelled()
    extras = ExtraFactors(extra_factors) if extra_factors is not None else None
    problem = make_problem(
        reconstruction, refine=options.refine, varying=varying,
        extra_images=extras.images if extras else (), extra_cameras=extras.cameras if extras else (),
    )  # fmt: skip
    if problem.num_observations == 0:
        return AdjustReport("nothing", solver="gtsam")
    lenses = [Lens(problem, c, reconstruction.cameras[idx]) for c, idx in enumerate(problem.camera_idx)]
    graph, values = reprojection_graph(problem, lenses, options)
    priors = IntrinsicPriors(problem, prior_cameras, options)
    for camera, slot, mean, weight in zip(priors.camera, priors.slot, priors.mean, priors.weight, strict=True):
        row = (np.array(lenses[camera].slots) == slot).astype(np.float64)[None]
        graph.add(_linear(values, {C(int(camera)): row}, mean - problem.canonical[camera, slot], weight**-0.5))
    if extras is not None:
        _add_extras(graph, values, problem, lenses, extras)
    first = graph.error(values)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, _points_first(problem, values), _parameters(options))
    result = optimizer.optimize()
    final = graph.error(result)
    if final < first:
        _read_back(problem, lenses, result)
        write_back(problem, reconstruction)
    count = optimizer.iterations()
    return AdjustReport(
        "converged" if count < options.max_iterations else "iterations", count, 0, first, min(first, final),
        int((problem.image_block >= 0).sum()), int((problem.camera_block >= 0).sum()), len(problem.track_idx),
        problem.num_observations, "gtsam", time.perf_counter() - start,
    )  # fmt: skip


class Lens:
    """A camera as gtsam knows it.

    Attributes:
        calibration: at the problem's state. factor: the reprojection factor that goes with it.
        slots: canonical slot of each of gtsam's parameters, -1 for none.
        free: positions of the free ones, in the order of ``Camera.params``.
    """

    def __init__(self, problem: Problem, index: int, camera: Camera) -> None:
        names = PARAM_NAMES[camera.model]
        canonical = problem.canonical[index]
        if camera.family not in (BROWN, RADIAL_FISHEYE):
            raise UsageError(f"the gtsam backend has no {camera.model.name} cameras", "use adjust.backend=schur")
        single = names[0] == "f" and camera.family == BROWN
        self.factor: Any
        if single:
            fx, _, cx, cy, k1, k2, _, _ = canonical[:8]
            order: tuple[str | None, ...] = _BUNDLER
            self.calibration, self.factor = gtsam.Cal3Bundler(fx, k1, k2, cx, cy), gtsam.GeneralSFMFactor2Cal3Bundler
        else:
            fx, fy, cx, cy, *d = canonical[:8]
            fisheye = camera.family == RADIAL_FISHEYE
            order = _FISHEYE if fisheye else _DS2
            self.calibration = (gtsam.Cal3Fisheye if fisheye else gtsam.Cal3DS2)(fx, fy, 0.0, cx, cy, *d)
            self.factor = gtsam.GeneralSFMFactor2Cal3Fisheye if fisheye else gtsam.GeneralSFMFactor2Cal3DS2
        spread = canonical_from_params(camera.model)
        place = {name: int(np.flatnonzero(spread[:, p])[0]) for p, name in enumerate(names)}
        self.slots = [place.get(name or "", -1) for name in order]
        wanted = [names[p] for p in problem.free.params[index]]
        if not set(wanted) <= set(order):
            raise UsageError(
                f"the gtsam backend cannot refine the principal point of a {camera.model.name} camera",
                "use the camera model OPENCV, or adjust.backend=schur",
            )
        self.free = [order.index(name) for name in wanted]

    def canonical_at(self, value: Any, before: Array) -> Array:
        """Canonical row of another calibration of the same kind; ``before`` belongs to this one."""
        out = before.copy()
        delta = self.calibration.localCoordinates(value)
        for slot, change in zip(self.slots, delta, strict=True):
            if slot >= 0:
                out[slot] += change
        if len(self.slots) == 3:
            out[1] = out[0]
        return out


def reprojection_graph(problem: Problem, lenses: list[Lens], options: AdjustOptions) -> tuple[Any, Any]:
    """One GeneralSFMFactor2 per observation, what holds the constant things, and the values at the problem's state."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise: Any = gtsam.noiseModel.Unit.Create(2)
    if options.loss != "trivial":
        kind = gtsam.noiseModel.mEstimator.Huber if options.loss == "huber" else gtsam.noiseModel.mEstimator.Cauchy
        noise = gtsam.noiseModel.Robust.Create(kind.Create(options.loss_scale_px), noise)
    held = gtsam.noiseModel.Isotropic.Sigma(6, _HELD)
    for q, pose in enumerate(problem.poses):
        values.insert(X(q), gtsam_pose(pose))
        if problem.pose_block[q] < 0:
            graph.add(gtsam.PriorFactorPose3(X(q), gtsam_pose(pose), held))
    view = [X(int(q)) for q in problem.image_pose]
    for i in np.flatnonzero(problem.image_mount >= 0):
        mount = problem.mounts[problem.image_mount[i]]
        rig_from_cam = gtsam_pose(rigid3.from_matrix(mount[:9].reshape(3, 3), mount[9:]))
        values.insert(V(int(i)), values.atPose3(view[i]).compose(rig_from_cam))
        graph.add(gtsam.BetweenFactorPose3(view[i], V(int(i)), rig_from_cam, held))
        view[i] = V(int(i))
    for c, lens in enumerate(lenses):
        values.insert(C(c), lens.calibration)
        rows = np.delete(np.eye(len(lens.slots)), lens.free, 0)
        if len(rows):
            graph.add(_linear(values, {C(c): rows}, np.zeros(len(rows)), _HELD))
    for p, xyz in enumerate(problem.xyz):
        values.insert(L(p), xyz)
        if problem.is_constant[p]:
            graph.add(gtsam.PriorFactorPoint3(L(p), xyz, gtsam.noiseModel.Isotropic.Sigma(3, _HELD)))
    point = np.repeat(np.arange(len(problem.xyz)), np.diff(problem.point_ptr))
    for o, (i, p) in enumerate(zip(problem.obs_image.tolist(), point.tolist(), strict=True)):
        c = int(problem.image_camera[i])
        graph.add(lenses[c].factor(problem.obs_xy[o], noise, view[i], L(p), C(c)))
    return graph, values


def _linear(values: Any, rows: dict[int, Array], right: Any, sigma: float) -> Any:
    """The factor ``sum rows_k (value_k - current value_k) = right`` with one standard deviation for all its rows."""
    b = np.atleast_1d(np.asarray(right, np.float64))
    noise = gtsam.noiseModel.Isotropic.Sigma(len(b), sigma)
    jacobian = gtsam.JacobianFactor(*[part for item in rows.items() for part in item], b, noise)
    point = gtsam.Values()
    for key in rows:
        if gtsam.Symbol(key).chr() == ord("k"):
            point.insert(key, values.atVector(key))
        else:
            point.insert(key, _calibration_of(values, key))
    return gtsam.LinearContainerFactor(jacobian, point)


def _calibration_of(values: Any, key: int) -> Any:
    """gtsam's Values want to be asked for the right type."""
    for getter in (values.atCal3Bundler, values.atCal3DS2):
        try:
            return getter(key)
        except RuntimeError:
            pass
    return values.atCal3Fisheye(key)


def _add_extras(graph: Any, values: Any, problem: Problem, lenses: list[Lens], extras: ExtraFactors) -> None:
    """The caller's factors with their keys made local; K(c) is tied to the calibration C(c)."""
    extras.attach(problem)
    local_image = {X(int(i)): X(int(q)) for i, q in zip(problem.image_idx, problem.image_pose, strict=True)}
    local_camera = {K(int(c)): (K(n), n) for n, c in enumerate(problem.camera_idx)}
    for key in extras.known.keyVector():
        if key in local_camera:
            name, n = local_camera[key]
            values.insert(name, free_values(problem, problem.canonical, n))
            read = np.eye(len(lenses[n].slots))[lenses[n].free]
            size = len(read)
            graph.add(_linear(values, {name: np.eye(size), C(n): -read}, np.zeros(size), _HELD))
    renamed = local_image | {key: name for key, (name, _) in local_camera.items()}
    for n in range(extras.known.size()):
        factor = extras.known.at(n)
        graph.add(factor.rekey([renamed[key] for key in list(factor.keys())]))


def _points_first(problem: Problem, values: Any) -> Any:
    """Points, then images on rigs, then poses, then intrinsics; gtsam's own COLAMD is several times slower here."""
    ordering = gtsam.Ordering()
    points = [L(p) for p in range(len(problem.xyz))]
    for key in points:
        ordering.push_back(key)
    rank = {ord("v"): 0, ord("x"): 1}
    for key in sorted(set(values.keys()) - set(points), key=lambda k: (rank.get(gtsam.Symbol(k).chr(), 2), k)):
        ordering.push_back(key)
    return ordering


def _parameters(options: AdjustOptions) -> Any:
    parameters = gtsam.LevenbergMarquardtParams.CeresDefaults()
    parameters.setMaxIterations(options.max_iterations)
    parameters.setRelativeErrorTol(options.relative_cost_tolerance)
    parameters.setAbsoluteErrorTol(0.0)
    parameters.setLinearSolverType("SEQUENTIAL_CHOLESKY")
    return parameters


def _read_back(problem: Problem, lenses: list[Lens], result: Any) -> None:
    """Put gtsam's values into the problem's state."""
    for q in np.flatnonzero(problem.pose_block >= 0):
        matrix = result.atPose3(X(int(q))).inverse().matrix()
        problem.poses[q] = rigid3.from_matrix(matrix[:3, :3], matrix[:3, 3])
    for c in np.flatnonzero(problem.camera_block >= 0):
        problem.canonical[c] = lenses[c].canonical_at(_calibration_of(result, C(int(c))), problem.canonical[c])
    for p in np.flatnonzero(~problem.is_constant):
        problem.xyz[p] = result.atPoint3(L(int(p)))
