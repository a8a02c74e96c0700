"""The same adjustment as a plain gtsam graph, one factor per observation: slow, short, and written by somebody else.

Poses are ``X(i)`` (world_from_cam of image i, on a rig of that of sensor 0), points ``L(t)`` by track, cameras
``C(c)``: Cal3Bundler for models with one focal length, unless their principal point is free, which that holds;
otherwise Cal3DS2 or Cal3Fisheye. What is not free, or is in gtsam's model and not in ours, is held by a prior, and two
focal lengths of gtsam's that are one of ours are tied to each other; so is the place ``V(i)`` of an image on its rig,
and the vector ``K(c)`` of the free parameters of a camera that other factors mention.
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
from sfmapp.adjust.problem import NOTHING, Problem, Varying, free_values, make_problem, write_back
from sfmapp.camera.camera import Camera
from sfmapp.camera.lens import BROWN, RADIAL_FISHEYE
from sfmapp.camera.models import PARAM_NAMES, canonical_from_params
from sfmapp.errors import UsageError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

# The canonical slots of gtsam's parameters, -1 for its skew: f, k1, k2, and fx, fy, s, cx, cy with four of distortion.
_BUNDLER, _FULL = (0, 4, 5), (0, 1, -1, 2, 3, 4, 5, 6, 7)
# Standard deviation of what must not move, in its own unit: far below any effect, and Cholesky keeps its digits.
_HELD = 1e-7
# Of the difference of two focal lengths that are one, in pixels: a thousandth of what is ever known of it, and no more
# stiff than Cholesky can bear, which has to tell the two apart from what it leaves of their sum.
_TIED = 1e-4


def adjust_with_gtsam(
    reconstruction: Reconstruction,
    options: AdjustOptions,
    varying: Varying,
    *,
    prior_cameras: Sequence[Camera] | None = None,
    extra_factors: Any = None,
    noise_px: float = 1.0,
    events: Events | None = None,
) -> AdjustReport:
    """``adjust_bundle`` with gtsam's own factors and Levenberg-Marquardt. Cancellation is looked at once, before."""
    start = time.perf_counter()
    if events is not None:
        events.raise_if_cancelled()
    plain = PlainGraph(reconstruction, options, varying, prior_cameras, extra_factors, noise_px)
    problem, graph, values = plain.problem, plain.graph, plain.values
    if problem.num_observations == 0:
        return AdjustReport(termination="nothing", solver="none")
    first = graph.error(values)
    optimizer = gtsam.LevenbergMarquardtOptimizer(
        graph, values, _points_first(values), _parameters(options, plain.has_ties)
    )
    result = optimizer.optimize()
    final = graph.error(result)
    if final < first:
        plain.read_back(result)
        write_back(problem, reconstruction)
    count = optimizer.iterations()
    return AdjustReport(
        termination="converged" if count < options.max_iterations else "iterations", num_iterations=count,
        initial_cost=first, final_cost=min(first, final), num_images=int((problem.image_block >= 0).sum()),
        num_cameras=int((problem.camera_block >= 0).sum()), num_points=len(problem.track_idx),
        num_observations=problem.num_observations, num_unknowns=values.dim(), solver="none", noise_px=noise_px,
        wall_s=time.perf_counter() - start,
    )  # fmt: skip


class PlainGraph:
    """The gtsam graph of an adjustment, and the way back from its values.

    Attributes:
        problem: what takes part. graph: gtsam.NonlinearFactorGraph. values: gtsam.Values at the problem's state.
        extras: the factors beside the reprojections, if any.
    """

    def __init__(
        self,
        reconstruction: Reconstruction,
        options: AdjustOptions,
        varying: Varying,
        prior_cameras: Sequence[Camera] | None,
        extra_factors: Any,
        noise_px: float = 1.0,
    ) -> None:
        extras = extra_factors
        if extra_factors is not None and not isinstance(extra_factors, ExtraFactors):
            extras = ExtraFactors(extra_factors)
        problem = make_problem(
            reconstruction, refine=options.refine, varying=varying, mentioned=extras.mentioned if extras else NOTHING
        )
        self.problem, self.extras = problem, extras
        self._pose_keys = [X(int(i)) for i in problem.image_idx[problem.pose_images]]
        self._lenses = [Lens(problem, c, reconstruction.cameras[idx]) for c, idx in enumerate(problem.camera_idx)]
        self.graph, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        views = self._add_poses()
        self._add_cameras()
        self._add_points()
        self._add_observations(views, options, noise_px)
        self._add_priors(IntrinsicPriors(problem, prior_cameras, options))
        if extras is not None:
            extras.attach(problem)
            self._add_extras(extras)

    @property
    def has_ties(self) -> bool:
        """Two focal lengths of gtsam's are one of ours."""
        return any(len(lens.ties) for lens in self._lenses)

    def _add_poses(self) -> list[int]:
        """Poses, and what holds the constant ones and those on a rig; returns the keys of the images' own poses."""
        problem, graph, values = self.problem, self.graph, self.values
        held = gtsam.noiseModel.Isotropic.Sigma(6, _HELD)
        for q, (key, pose) in enumerate(zip(self._pose_keys, problem.poses, strict=True)):
            values.insert(key, gtsam_pose(pose))
            if problem.pose_block[q] < 0:
                graph.add(gtsam.PriorFactorPose3(key, gtsam_pose(pose), held))
        view = [self._pose_keys[q] for q in problem.image_pose]
        for i in np.flatnonzero(problem.image_mount >= 0):
            mount = problem.mounts[problem.image_mount[i]]
            rig_from_cam = gtsam_pose(rigid3.from_matrix(mount[:9].reshape(3, 3), mount[9:]))
            key = V(int(problem.image_idx[i]))
            values.insert(key, values.atPose3(view[i]).compose(rig_from_cam))
            graph.add(gtsam.BetweenFactorPose3(view[i], key, rig_from_cam, held))
            view[i] = key
        return view

    def _add_cameras(self) -> None:
        for c, lens in zip(self.problem.camera_idx.tolist(), self._lenses, strict=True):
            self.values.insert(C(c), lens.calibration)
            for rows, sigma in ((lens.held, _HELD), (lens.ties, _TIED)):
                if len(rows):
                    self.graph.add(_linear(self.values, {C(c): rows}, np.zeros(len(rows)), sigma))

    def _add_points(self) -> None:
        problem, held = self.problem, gtsam.noiseModel.Isotropic.Sigma(3, _HELD)
        for t, xyz, is_constant in zip(problem.track_idx.tolist(), problem.xyz, problem.is_constant, strict=True):
            self.values.insert(L(t), xyz)
            if is_constant:
                self.graph.add(gtsam.PriorFactorPoint3(L(t), xyz, held))

    def _add_observations(self, views: list[int], options: AdjustOptions, noise_px: float) -> None:
        problem = self.problem
        noise: Any = gtsam.noiseModel.Isotropic.Sigma(2, noise_px)
        if options.loss != "trivial":
            kind = gtsam.noiseModel.mEstimator.Huber if options.loss == "huber" else gtsam.noiseModel.mEstimator.Cauchy
            noise = gtsam.noiseModel.Robust.Create(kind.Create(options.loss_scale_px / noise_px), noise)
        tracks = np.repeat(problem.track_idx, np.diff(problem.point_ptr)).tolist()
        cameras = problem.image_camera.tolist()
        keys = [C(c) for c in problem.camera_idx.tolist()]
        for i, t, xy in zip(problem.obs_image.tolist(), tracks, problem.obs_xy, strict=True):
            c = cameras[i]
            self.graph.add(self._lenses[c].factor(xy, noise, views[i], L(t), keys[c]))

    def _add_priors(self, priors: IntrinsicPriors) -> None:
        problem = self.problem
        information = np.zeros((len(priors.mean), len(priors.mean)))
        information[priors.first, priors.second] = priors.weight
        for c in np.unique(priors.camera):
            own = np.flatnonzero(priors.camera == c)
            rows = np.array(self._lenses[c].slots) == priors.slot[own, None]
            white = np.linalg.cholesky(information[np.ix_(own, own)]).T
            off = white @ (priors.mean[own] - problem.canonical[c, priors.slot[own]])
            key = C(int(problem.camera_idx[c]))
            self.graph.add(_linear(self.values, {key: white @ rows}, off, 1.0))

    def _add_extras(self, extras: ExtraFactors) -> None:
        """The caller's factors; K(c) is tied to the calibration C(c)."""
        problem, values = self.problem, self.values
        local = {K(c): n for n, c in enumerate(problem.camera_idx.tolist())}
        mentioned = set(extras.known.keyVector())
        for key in sorted(mentioned & local.keys()):
            n = local[key]
            values.insert(key, free_values(problem, problem.canonical, n))
            read = np.eye(len(self._lenses[n].slots))[self._lenses[n].free]
            size = len(read)
            tied = {key: np.eye(size), C(int(problem.camera_idx[n])): -read}
            self.graph.add(_linear(values, tied, np.zeros(size), _HELD))
        values.insert(extras.values)
        for n in range(extras.known.size()):
            self.graph.add(extras.known.at(n))

    def read_back(self, result: Any) -> None:
        """Put gtsam's values into the problem's state, and into those of the extra factors' own variables.

        Raises:
            RuntimeError: some of what varies is not among them, or of another type.
        """
        problem = self.problem
        for q in np.flatnonzero(problem.pose_block >= 0):
            matrix = result.atPose3(self._pose_keys[q]).inverse().matrix()
            problem.poses[q] = rigid3.from_matrix(matrix[:3, :3], matrix[:3, 3])
        for c in np.flatnonzero(problem.camera_block >= 0):
            calibration = _calibration_of(result, C(int(problem.camera_idx[c])))
            problem.canonical[c] = self._lenses[c].canonical_at(calibration, problem.canonical[c])
        for p in np.flatnonzero(~problem.is_constant):
            problem.xyz[p] = result.atPoint3(L(int(problem.track_idx[p])))
        if self.extras is not None:
            self.extras.values = result.extract(list(self.extras.values.keys()))


class Lens:
    """A camera as gtsam knows it.

    Attributes:
        calibration: at the problem's state. factor: the reprojection factor that goes with it.
        slots: canonical slot of each of gtsam's parameters, -1 for none.
        free: positions of the free ones, in the order of ``Camera.params``.
        held: (n, len(slots)) rows of the identity, of what is constant.
        ties: (n, len(slots)) differences of what is one parameter of ours.
    """

    def __init__(self, problem: Problem, index: int, camera: Camera) -> None:
        names = PARAM_NAMES[camera.model]
        if camera.family not in (BROWN, RADIAL_FISHEYE):
            raise UsageError(f"the gtsam backend has no {camera.model.name} cameras", "use adjust.backend=schur")
        fx, fy, cx, cy, *d = problem.canonical[index, :8]
        self.factor: Any
        self.slots: tuple[int, ...] = _FULL
        is_centered = not any(names[p] in ("cx", "cy") for p in problem.free.params[index])
        if names[0] == "f" and camera.family == BROWN and is_centered:
            self.slots = _BUNDLER
            self.calibration = gtsam.Cal3Bundler(fx, d[0], d[1], cx, cy)
            self.factor = gtsam.GeneralSFMFactor2Cal3Bundler
        elif camera.family == BROWN:
            self.calibration, self.factor = gtsam.Cal3DS2(fx, fy, 0.0, cx, cy, *d), gtsam.GeneralSFMFactor2Cal3DS2
        else:
            self.calibration = gtsam.Cal3Fisheye(fx, fy, 0.0, cx, cy, *d)
            self.factor = gtsam.GeneralSFMFactor2Cal3Fisheye
        spread = canonical_from_params(camera.model)
        at = [
            [n for n, slot in enumerate(self.slots) if slot >= 0 and spread[slot, p]]
            for p in problem.free.params[index]
        ]
        self.free: list[int] = [places[0] for places in at]
        self._followers = [(n, places[0]) for places in at for n in places[1:]]
        identity = np.eye(len(self.slots))
        self.ties = np.array([identity[n] - identity[first] for n, first in self._followers]).reshape(-1, len(identity))
        self.held = np.delete(identity, [n for places in at for n in places], 0)

    def canonical_at(self, value: Any, before: Array) -> Array:
        """Canonical row of another calibration of the same kind; ``before`` belongs to this one."""
        out = before.copy()
        delta = self.calibration.localCoordinates(value)
        for slot, change in zip(self.slots, delta, strict=True):
            if slot >= 0:
                out[slot] += change
        for n, first in self._followers:
            out[self.slots[n]] = out[self.slots[first]]
        if self.slots == _BUNDLER:
            out[1] = out[0]
        return out


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


def _points_first(values: Any) -> Any:
    """Points, then images on rigs, then poses, then intrinsics; gtsam's own COLAMD is several times slower here."""
    ordering = gtsam.Ordering()
    rank = {ord("l"): 0, ord("v"): 1, ord("x"): 2}
    for key in sorted(values.keys(), key=lambda k: (rank.get(gtsam.Symbol(k).chr(), 3), k)):
        ordering.push_back(key)
    return ordering


def _parameters(options: AdjustOptions, has_ties: bool) -> Any:
    """``has_ties``: damping in shares of the diagonal would hold what is tied, however softly the data hold it, and
    Cholesky would lose what is left of it; QR does not."""
    parameters = gtsam.LevenbergMarquardtParams.CeresDefaults()
    parameters.setDiagonalDamping(not has_ties)
    parameters.setMaxIterations(options.max_iterations)
    parameters.setRelativeErrorTol(options.relative_cost_tolerance)
    parameters.setAbsoluteErrorTol(0.0)
    parameters.setLinearSolverType("SEQUENTIAL_QR" if has_ties else "SEQUENTIAL_CHOLESKY")
    return parameters
