"""Calibrating cameras that are mounted together: intrinsics, poses in the rig, and the covariance of all of it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as fisher

from sfmapp.calibration.adjustment import observations_of, refine, residuals_of
from sfmapp.calibration.epipolar_errors import epipolar_errors
from sfmapp.calibration.kernels import Normal
from sfmapp.calibration.result import CameraCalibration, ViewFit
from sfmapp.calibration.rig_adjustment import (
    Places,
    RigFit,
    RigProblem,
    RigView,
    adjoint,
    cam_from_board,
    camera_normal,
    places_of,
    refine_rig,
    rig_normal,
    rig_residuals,
)
from sfmapp.calibration.rig_shots import (
    Cut,
    OddPhotograph,
    Photographs,
    doubtful,
    explain,
    misfits,
    more_odd,
    placed,
    readmitted,
    worst_shot,
)
from sfmapp.calibration.rig_start import JoinedRig, SeenBoard, join_rig
from sfmapp.calibration.solve import BENT_CHANCE, RESOLVED_SIGMAS, bend_basis, bend_depth
from sfmapp.calibration.start import cauchy_weights, posed
from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError
from sfmapp.geometry import epipolar, rigid3
from sfmapp.scene.rig import Rig

Array = NDArray[np.float64]

# A point is left aside that is further out than one in a million of Gaussian ones: exp(-5.25^2 / 2).
_FAR_SIGMAS = 5.25
# Rounds of looking for photographs that were not taken together, and of weighing cameras against each other.
_MAX_ROUNDS, _WEIGHING, _ROUGH = 12, 4, 10.0
# What is known worse than this is not known: a turn in radians, a shift relative to the distance of the boards.
_UNKNOWN = 0.2
# of the smallest eigenvalue of the scaled equations over the largest: below is rounding
_SINGULAR = 1e-13
# Below so many shots sigmas are right and wide, and one odd shot can hide.
_FEW_SHOTS = 5


@dataclass(frozen=True)
class PairCalibration:
    """Two cameras of a rig.

    Attributes:
        first, second: positions.
        second_from_first: (7,).
        covariance: (6, 6) of its turn (radians) and shift (unit of the boards), about the axes of the second camera.
        essential: (3, 3), of unit norm.
        fundamental: (3, 3), of unit norm, for pixels without distortion; None where a lens sees 88 degrees off axis.
        xy: (2, N, 2) pixels of the points that both see at once. epipolar_px: (N,) their signed Sampson errors.
        by_motion: the two were never seen to have a board in common, and are joined by how the rig moved.
    """

    first: int
    second: int
    second_from_first: Array
    covariance: Array
    essential: Array
    fundamental: Array | None
    xy: Array
    epipolar_px: Array
    by_motion: bool = False

    @property
    def epipolar_rms_px(self) -> float:
        """Root mean square of the epipolar errors, pixels; NaN without a point that both see."""
        return float(np.sqrt((self.epipolar_px**2).mean())) if len(self.epipolar_px) else float("nan")

    @property
    def baseline(self) -> tuple[float, float]:
        """Distance of the cameras and its sigma, in the unit of the boards."""
        shift = self.second_from_first[4:]
        length = float(np.linalg.norm(shift))
        along = shift / max(length, 1e-300)
        return length, math.sqrt(max(float(along @ self.covariance[3:, 3:] @ along), 0.0))

    @property
    def turn_deg(self) -> tuple[float, float]:
        """Angle between the cameras and the sigma of their turn against each other (root of the trace), degrees."""
        angle = float(rigid3.rotation_angle_deg(rigid3.rotation_matrix(self.second_from_first)))
        return angle, math.degrees(math.sqrt(max(float(np.trace(self.covariance[:3, :3])), 0.0)))


@dataclass(frozen=True)
class RigCalibration:
    """C cameras that are mounted together.

    Attributes:
        names: C.
        cameras: with the covariance of each's own parameters.
        rig: cameras and their poses.
        world_from_board: (B, 7) boards that are fixed to each other, the first the identity.
        covariance: (S, S) of all that is shared: parameters of every camera, then turn (radians) and shift (unit of the
            boards) of each camera but the first, about its own axes, then of each board but the first, then their
            shapes.
        places: where in it.
        pairs: of cameras that see a board in common, and of those that motion alone joins.
        bend: (B, 3) shapes of the boards, z = a u^2 + b v^2 + c u v over their points, u and v from -1 to 1; None where
            they are flat as far as the photographs tell.
        odd: photographs that were not taken with the others of their shot.
        num_shots: moments at which two cameras and more see a board.
        noise_px, degrees_of_freedom: of a measured coordinate, over all cameras.
        widening: by which sigmas of poses are wider than the noise of the points alone makes them.
        warnings: what a user has to know, a line each.
    """

    names: tuple[str, ...]
    cameras: tuple[CameraCalibration, ...]
    rig: Rig
    world_from_board: Array
    covariance: Array
    places: Places
    pairs: tuple[PairCalibration, ...]
    odd: tuple[OddPhotograph, ...]
    num_shots: int
    noise_px: float
    degrees_of_freedom: int
    widening: float = 1.0
    bend: Array | None = None
    warnings: tuple[str, ...] = ()

    def pose_covariance(self, camera: int) -> Array:
        """(6, 6) of the pose of a camera in the rig: turn, radians, and shift, about its own axes; 0 of the first."""
        if camera == 0:
            return np.zeros((6, 6))
        place = self.places.cam_from_rig[camera - 1]
        return self.covariance[place, place]


def calibrate_rig(
    names: Sequence[str], cameras: Sequence[Camera], is_held: Sequence[bool], views: Sequence[RigView], *,
    bends: bool = True,
) -> RigCalibration:  # fmt: skip
    """Refine cameras, their poses in the rig and the boards together.

    Args:
        names: of the cameras. cameras: where their parameters begin, or stay. is_held: which of them stay.
        views: boards in photographs. Shots are moments of exposure; boards are fixed to each other.
        bends: look whether the boards are bent, and take that into account.

    Raises:
        InputError: nothing joins some of the cameras, or what joins them does not tell where they are.
    """
    photos, noise = _photographs(cameras, is_held, views)
    seen = [
        SeenBoard(view.camera, view.shot, view.board, pose)
        for view, pose in zip(photos.views, photos.alone, strict=True)
    ]
    num_boards = max(view.board for view in views) + 1
    joined = join_rig(seen, len(cameras), num_boards)
    _refuse_apart(names, joined)
    begin = RigFit(tuple(cameras), joined.cam_from_rig, np.zeros((0, 7)), joined.world_from_board)
    fit, cut = _fit_of_what_belongs_together(begin, photos, is_held)
    bent = _bent(fit, photos, is_held, cut) if bends else None
    if bent is not None:
        photos = bent[1]
        fit, cut = _fit_of_what_belongs_together(bent[0], photos, is_held)
    problem = photos.with_cut(cut).problem(is_held)
    for _ in range(_WEIGHING):
        photos, noise = _weighed(fit, problem, photos, noise)
        fit = refine_rig(fit, problem, photos.weights)
    return _result(names, fit, problem, photos, noise, joined, cut)


def _photographs(
    cameras: Sequence[Camera], is_held: Sequence[bool], views: Sequence[RigView]
) -> tuple[Photographs, Array]:
    """Each photograph by itself: its pose, points that are far out, and the noise (C,) of each camera, pixels."""
    noise, weights = np.zeros(len(cameras)), []
    alone = np.zeros((len(views), 7))
    for c, camera in enumerate(cameras):
        mine = [i for i, view in enumerate(views) if view.camera == c]
        obs = observations_of([views[i].view for i in mine])
        fit = posed(camera, [views[i].view for i in mine])
        for _ in range(3):
            fit = refine(fit, obs._replace(weight=cauchy_weights(residuals_of(fit, obs))), hold_camera=True)
        square = (residuals_of(fit, obs) ** 2).sum(1)
        known = square[np.isfinite(square)]
        # the median of a squared length of two normal numbers is 2 ln 2
        sigma2 = max(float(np.median(known)) / (2.0 * np.log(2.0)), 1e-20) if len(known) else 1.0
        is_used = np.isfinite(square) & (square < _FAR_SIGMAS**2 * sigma2)
        freedom = max(2 * int(is_used.sum()) - 6 * len(mine), 1)
        noise[c] = max(np.sqrt(square[is_used].sum() / freedom), 1e-9)
        alone[mine] = fit.cam_from_target
        weights.append(np.where(is_used, 1.0 / noise[c] ** 2, 0.0))
    sizes = tuple((camera.width, camera.height) for camera in cameras)
    return Photographs(tuple(views), alone, tuple(weights), sizes), noise


def _refuse_apart(names: Sequence[str], joined: JoinedRig) -> None:
    apart = [name for name, pose in zip(names, joined.cam_from_rig, strict=True) if np.isnan(pose).any()]
    if apart:
        raise InputError(
            f"rig: nothing tells where {' and '.join(apart)} sits beside {names[0]}: they never see the same board in "
            "one shot, and no three shots with turns about two axes show each a board",
            "take photographs with the board in both pictures; or, without any view in common, fix a board in front of "
            "each camera and move the rig, turning it about two axes",
        )


def _fit_of_what_belongs_together(begin: RigFit, photos: Photographs, is_held: Sequence[bool]) -> tuple[RigFit, Cut]:
    """The refined rig, and the photographs that were not taken with the others of their shot."""
    fit, cut, was_back = begin, Cut(), Cut()
    for _ in range(_MAX_ROUNDS):
        back = readmitted(fit, photos, cut) - was_back
        was_back |= back
        # at first poses are those of single photographs, and known that much worse
        now = (cut - back) | more_odd(fit, photos, cut, _ROUGH if fit is begin else 1.0)
        is_settled = now == cut and fit is not begin
        cut = now
        fit = placed(fit, photos.with_cut(cut))[0]
        if is_settled:
            break
        fit = refine_rig(fit, photos.with_cut(cut).problem(is_held), photos.weights)
    for _ in range(_MAX_ROUNDS):
        found = _without_worst(fit, photos, is_held, cut)
        if found is None:
            break
        fit, cut = found
    return fit, cut


def _without_worst(fit: RigFit, photos: Photographs, is_held: Sequence[bool], cut: Cut) -> tuple[RigFit, Cut] | None:
    """The rig without the shot that agrees worst, and the cut with it, where that shot does not belong to a rig that it
    had no part in; None where it does.

    A shot pulls the rig its way, among few shots so far that all of them look no better than it does.
    """
    tried = cut | worst_shot(fit, photos, cut)
    if tried == cut:
        return None
    problem = photos.with_cut(tried)
    begin = placed(fit, problem)[0]
    other = refine_rig(begin, problem.problem(is_held), photos.weights)
    return None if readmitted(other, photos, tried) & (tried - cut) else (other, tried)


def _bent(fit: RigFit, photos: Photographs, is_held: Sequence[bool], cut: Cut) -> tuple[RigFit, Photographs] | None:
    """The rig with boards that are bent, where the photographs show it by Fisher's test; None where they do not."""
    views = photos.views
    num_boards = len(fit.world_from_board)
    shapes = []
    for view in views:
        whole = np.zeros((len(view.view.xy), 3 * num_boards))
        same = [one.view for one in views if one.board == view.board]
        whole[:, 3 * view.board : 3 * view.board + 3] = bend_basis(view.view, same)
        shapes.append(whole)
    curved = replace(photos, shapes=tuple(shapes))
    problem = curved.with_cut(cut).problem(is_held)
    flat = refine_rig(fit, photos.with_cut(cut).problem(is_held), photos.weights)
    found = refine_rig(replace(flat, bend=np.zeros(3 * num_boards)), problem, photos.weights)
    inverse = _Inverse(found, problem, photos.weights)
    free = int((np.diag(inverse.shared) > 0).sum()) + 6 * problem.num_shots
    freedom = 2 * sum(int((weight > 0).sum()) for weight in photos.weights) - free
    if freedom < 1 or not 0.0 < found.cost < flat.cost or inverse.rank_gap < _SINGULAR:
        return None
    num = len(found.bend)
    ratio = (flat.cost - found.cost) / num / (found.cost / freedom)
    place = places_of(found).bend
    sigmas = np.sqrt(np.diag(inverse.shared)[place] * 2.0 * found.cost / freedom)
    is_resolved = bool((np.abs(found.bend) > RESOLVED_SIGMAS * sigmas).any())
    return (found, curved) if is_resolved and fisher.sf(ratio, num, freedom) < BENT_CHANCE else None


def _weighed(fit: RigFit, problem: RigProblem, photos: Photographs, noise: Array) -> tuple[Photographs, Array]:
    """Weights and noise of each camera from its own residuals and its share of the degrees of freedom (Helmert's
    variance components; Koch, "Parameter Estimation and Hypothesis Testing in Linear Models", 1999, section 3.6)."""
    obs = problem.weighted(photos.weights)
    inverse = _Inverse(fit, problem, photos.weights)
    new = noise.copy()
    for c, r in enumerate(rig_residuals(fit, problem)):
        counts = photos.weights[c] > 0
        taken = inverse.trace_with(camera_normal(fit, problem, obs[c], c)[1])
        freedom = max(2.0 * float(counts.sum()) - taken, 1.0)
        new[c] = max(np.sqrt((r[counts] ** 2).sum() / freedom), 1e-9)
    weights = tuple(np.where(w > 0, 1.0 / n**2, 0.0) for w, n in zip(photos.weights, new, strict=True))
    return replace(photos, weights=weights), new


class _Inverse:
    """The covariance of a rig's unknowns, by blocks."""

    def __init__(self, fit: RigFit, problem: RigProblem, weights: Sequence[Array]) -> None:
        normal = rig_normal(fit, problem, problem.weighted(weights))[1]
        own = normal.own.copy()
        own[~(np.abs(own).max((1, 2)) > 0)] = np.eye(6)
        self._own = np.linalg.inv(own)
        self._coupling = normal.cross @ self._own
        reduced = normal.shared - np.einsum("tsi,tri->sr", self._coupling, normal.cross)
        is_free = np.diag(normal.shared) > 0
        scale = 1.0 / np.sqrt(np.where(is_free, np.diag(normal.shared), 1.0))
        scaled = (reduced * scale[:, None] * scale[None, :])[np.ix_(is_free, is_free)]
        values, vectors = np.linalg.eigh(scaled) if is_free.any() else (np.ones(1), np.zeros((0, 1)))
        self.rank_gap = float(values[0])
        inner = (vectors / np.maximum(values, 1e-15)) @ vectors.T
        self.shared = np.zeros_like(reduced)
        self.shared[np.ix_(is_free, is_free)] = inner * scale[is_free][:, None] * scale[is_free][None, :]

    def trace_with(self, normal: Normal) -> float:
        """How many degrees of freedom the observations of other normal equations take."""
        shared, cross, own = normal.shared, normal.cross, normal.own
        between = -self.shared @ self._coupling
        inner = self._own + self._coupling.swapaxes(1, 2) @ (self.shared @ self._coupling)
        return float((self.shared * shared).sum() + 2.0 * (between * cross).sum() + (inner * own).sum())


def _result(
    names: Sequence[str],
    fit: RigFit,
    problem: RigProblem,
    photos: Photographs,
    noise: Array,
    joined: JoinedRig,
    cut: Cut,
) -> RigCalibration:
    inverse = _Inverse(fit, problem, photos.weights)
    places = places_of(fit)
    odd = explain(fit, photos, cut, names)
    linked = photos.with_cut(cut).views
    widening = _widening(misfits(fit, photos.with_cut(cut)))
    scale = np.where(np.arange(places.total) < places.params[-1].stop, 1.0, widening)
    covariance = inverse.shared * scale[:, None] * scale[None, :]
    shots_of = [{v.shot for v in linked if v.camera == c} for c in range(len(names))]
    shared_shots = {t for a, b in itertools.combinations(shots_of, 2) for t in a & b}
    is_used = [weight > 0 for weight in photos.weights]
    freedom = 2 * sum(int(used.sum()) for used in is_used)
    freedom -= int((np.diag(inverse.shared) > 0).sum()) + 6 * problem.num_shots
    rig = Rig(fit.cameras, fit.cam_from_rig)
    found = RigCalibration(
        tuple(names), _cameras(fit, problem, photos, covariance, noise, odd), rig, fit.world_from_board, covariance,
        places, tuple(_pairs(fit, problem, photos, covariance, joined)), tuple(odd), len(shared_shots),
        float(np.sqrt((noise**2).mean())), freedom, widening, fit.bend.reshape(-1, 3) if len(fit.bend) else None,
    )  # fmt: skip
    _refuse_unknown(found, inverse.rank_gap, np.linalg.norm(rigid3.inverse(photos.alone)[:, 4:], axis=1))
    return replace(found, warnings=(*_warnings(found), *doubtful(fit, photos, cut)))


def _widening(costs: Array) -> float:
    """By how much more than noise the photographs of a shot differ, from what each shot costs (T,): 1 unless that is
    beyond chance. Lenses are never quite what their model is, so errors are shared by the points of a photograph."""
    known = costs[costs != 0]
    if not len(known):
        return 1.0
    mean = float(known.mean())
    return float(np.sqrt(mean)) if mean > 1.0 + 3.0 * np.sqrt(2.0 / (6.0 * len(known))) else 1.0


def _cameras(
    fit: RigFit, problem: RigProblem, photos: Photographs, covariance: Array, noise: Array, odd: Sequence[OddPhotograph]
) -> tuple[CameraCalibration, ...]:
    """Each camera of a rig as a calibration of its own."""
    why = {(one.camera, one.shot): one.reason for one in odd}
    residuals, places = rig_residuals(fit, problem), places_of(fit)
    found = []
    for c, camera in enumerate(fit.cameras):
        poses, ptr = cam_from_board(fit, problem, c), problem.obs[c].ptr
        views = []
        for k, v in enumerate(problem.of_camera[c]):
            view = photos.views[problem.order[v]]
            rows = slice(ptr[k], ptr[k + 1])
            is_used = photos.weights[c][rows] > 0
            problem_of = why.get((c, view.shot))
            views.append(ViewFit(view.view.name, poses[k], view.view.xy, residuals[c][rows], is_used, problem_of))
        distance = np.linalg.norm(rigid3.apply(poses, np.zeros(3)), axis=1)
        block = covariance[places.params[c], places.params[c]]
        num = 2 * int((photos.weights[c] > 0).sum()) - 6 * len(views) - int((np.diag(block) > 0).sum())
        found.append(CameraCalibration(
            camera, block, "boards before several cameras, together", float(noise[c]), num, tuple(views),
            distances=(float(distance.min()), float(np.median(distance)), float(distance.max())),
        ))  # fmt: skip
    return tuple(found)


def _pairs(
    fit: RigFit, problem: RigProblem, photos: Photographs, covariance: Array, joined: JoinedRig
) -> list[PairCalibration]:
    places = places_of(fit)

    def at(camera: int) -> slice:
        return places.cam_from_rig[camera - 1]

    found = []
    for i, j in itertools.combinations(range(len(fit.cameras)), 2):
        pose = rigid3.compose(fit.cam_from_rig[j], rigid3.inverse(fit.cam_from_rig[i]))
        # a motion of the first camera is one of the second the other way, seen through the pose between them
        by_shared = np.zeros((6, len(covariance)))
        by_shared[:, at(j)] = np.eye(6)
        if i > 0:
            by_shared[:, at(i)] = -adjoint(pose)
        xy = _common_points(problem, photos, i, j)
        pair = (fit.cameras[i], fit.cameras[j])
        essential = epipolar.essential_from_pose(pose)
        is_flat = not (pair[0].is_wide or pair[1].is_wide)
        fundamental = epipolar.fundamental_from_essential(essential, pair[0].k_matrix, pair[1].k_matrix)
        found.append(PairCalibration(
            i, j, pose, by_shared @ covariance @ by_shared.T, essential, fundamental if is_flat else None, xy,
            epipolar_errors(pair, pose, xy[0], xy[1]), (i, j) in joined.motions,
        ))  # fmt: skip
    return found


def _common_points(problem: RigProblem, photos: Photographs, first: int, second: int) -> Array:
    """(2, N, 2) pixels of points of boards that two cameras see in one shot."""
    seen: list[dict[tuple[int, int], tuple[Array, Array]]] = []
    for camera in (first, second):
        ptr, mine = problem.obs[camera].ptr, {}
        for k, v in enumerate(problem.of_camera[camera]):
            rows = np.arange(ptr[k], ptr[k + 1])
            rows = rows[photos.weights[camera][rows] > 0]
            mine[int(problem.shot[v]), int(problem.board[v])] = (
                problem.obs[camera].xyz[rows],
                problem.obs[camera].xy[rows],
            )
        seen.append(mine)
    found = [np.zeros((2, 0, 2))]
    for key in sorted(seen[0].keys() & seen[1].keys()):
        (xyz1, xy1), (xyz2, xy2) = seen[0][key], seen[1][key]
        place = {tuple(point): n for n, point in enumerate(xyz2.tolist())}
        both = [(n, place[tuple(point)]) for n, point in enumerate(xyz1.tolist()) if tuple(point) in place]
        if both:
            one, two = np.array(both).T
            found.append(np.stack([xy1[one], xy2[two]]))
    return np.concatenate(found, 1)


def _refuse_unknown(found: RigCalibration, rank_gap: float, distances: Array) -> None:
    """Raise InputError for cameras that boards and motion leave open."""
    far = float(np.median(distances))
    for c, name in enumerate(found.names[1:], 1):
        sigmas = np.sqrt(np.maximum(np.diag(found.pose_covariance(c)), 0.0))
        if rank_gap < _SINGULAR or sigmas[:3].max() > _UNKNOWN or sigmas[3:].max() > _UNKNOWN * far:
            raise InputError(
                f"rig: the photographs do not tell where {name} sits beside {found.names[0]}: its turn is known to "
                f"{np.degrees(sigmas[:3].max()):.2g} degrees, its place to {sigmas[3:].max():.2g} m, with boards "
                f"{far:.2g} m away",
                "take more photographs, with the board at different angles and distances; a rig that is moved has to "
                "turn about two axes",
            )


def _warnings(found: RigCalibration) -> list[str]:
    warnings = [one.reason for one in found.odd]
    if found.bend is not None:
        depths = " and ".join(f"{1000.0 * bend_depth(one):.2f} mm" for one in found.bend)
        warnings.append(f"bent boards, up to {depths} out of their planes: taken into account")
    if found.widening > 1.0:
        warnings.append(
            f"photographs of one shot differ by {found.widening:.1f} times what the noise of their points explains "
            "(lens models that are not quite right, boards that are not quite flat): sigmas of poses are wider by that"
        )
    if found.num_shots < _FEW_SHOTS:
        warnings.append(
            f"only {found.num_shots} shots show a board to two cameras: {_FEW_SHOTS} and more, at different angles, "
            "are advised"
        )
    return warnings
