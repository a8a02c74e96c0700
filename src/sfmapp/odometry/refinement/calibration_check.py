"""What the images of a whole map say against the calibration that was given, and what they cannot tell.

Unknowns are what a calibration can be off by: one focal length for all cameras of a rig and what they differ by, the
shape of the pixels, distortion, and how the second camera is turned. Each has a prior around what was given. The images
weigh in with the information that is left when poses and points have followed (:mod:`sfmapp.adjust.calibration`), less
what smooth fields of displacement explain as well, which no lens model has, and divided by what errors of neighbouring
tracks have in common. So what a motion cannot tell stays as it was given. A change counts if tracks that had no part in
it agree, direction by direction; a given value that is far off gives way, round by round.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.calibration import RAW, CalibrationSystem, reduce_to_calibration
from sfmapp.adjust.gauge import moves_into_gauge, similarity_basis
from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustOptions, AdjustReport
from sfmapp.adjust.problem import Varying
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import Camera
from sfmapp.camera.lens import BROWN, FAMILY, RADIAL_FISHEYE
from sfmapp.camera.models import PARAM_NAMES, canonical_from_params, kind_of
from sfmapp.camera.names import CameraModel
from sfmapp.contradictions import Contradiction
from sfmapp.events import Events
from sfmapp.geometry import rigid3, similarity
from sfmapp.geometry.noise import exceeded_by_chance
from sfmapp.geometry.triangulation import Observed, triangulate_tracks
from sfmapp.mapping.structure import residual_scale_px
from sfmapp.odometry.map.backend import classify
from sfmapp.odometry.report import CalibrationCheck, ScaleParts
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

# What a calibration is off by: rectification and temperature leave a per cent of the focal length, two lenses of a kind
# that were calibrated together differ by less, and pixels are as square as they were given.
_FOCAL_SIGMA, _FOCAL_DIFFERENCE_SIGMA, _ASPECT_SIGMA = 0.01, 0.003, 0.001
_RADIAL_SIGMA, _TANGENTIAL_SIGMA = 0.02, 0.002
# The cameras of a rig turn against each other with temperature and shocks. A hundredth of a degree of that changes the
# scale of a drive by half a percent.
_TURN_SIGMA_DEG = 0.05
# A board measures the baseline of a rig to some thousandths.
_BASELINE_SIGMA = 0.002
# What a turn of the rig by its prior makes of the scale of a drive: where tracks are too few to say more.
_UNKNOWN_SCALE = 0.05
# Smooth fields that no lens model has: rectification leaves a tenth of a pixel, as a calibration's own residuals do;
# where the images show more of them, up to twice that, rounds of finding out.
_FIELD_SIGMA_PX, _MAX_FIELD_SIGMA_PX, _FIELD_STEPS, _FIELD_DEGREES = 0.1, 0.2, 3, (2, 3)
# Tracks that began within so many frames of the map, in the same cell (columns, rows) of the image, share errors of
# their patches. Small maps have too few such clusters to tell how errors are spread, and get by with smaller ones, in
# the end with single tracks: there have to be that many for each unknown.
_CLUSTERS, _MIN_CLUSTERS = ((3, 4, 2), (1, 4, 2), (1, 8, 4)), 1.5
# How often chance alone makes such a change, and how many times that what errors of patches that all tracks have in
# common make of it (exact cameras of rendered sequences: up to half of chance; real rectified ones: 20 to 150 times);
# what other tracks must gain by it, in standard deviations, and by each direction of it.
_MAX_CHANCE, _SHARED_ERRORS, _MIN_HELD_OUT_SIGMAS, _MIN_DIRECTION_SIGMAS, _FOLDS = 1e-3, 3.0, 3.0, 1.0, 5
# A cluster counts for no more than so many usual ones.
_MAX_GAIN = 5.0
# Rounds until the next would move by less than a share of a sigma; how far one may go, in the focal length's logarithm.
_ROUNDS, _ROUNDS_FAR, _SETTLED_SIGMAS, _MAX_STEP = 6, 14, 0.5, 0.05
# A step that makes the cost rise by more than this share has gone too far; steps of the adjustment after one, the share
# of the cost that ends them, and the sigmas that poses move by in all: what is left of that the next look allows for.
_MAX_RISE, _FOLLOWING_STEPS, _FOLLOWING_TOLERANCE, _FOLLOWED_SIGMAS = 1.05, 30, 1e-4, 0.5
# How many steps may be made in one, and how far (cosine) two have to go the same way for that.
_MAX_REACH, _SAME_WAY = 4.0, 0.7
# A prior that the data leave by so many sigmas is not believed any more.
_PRIOR_SIGMAS = 3.0
# What was found instead must be known to this share of the change.
_MAX_UNSURE = 0.2
# Where the rounds end before it has settled, more is still to come: with twice what has moved until then as sigma, a
# rendered drive with a focal length of 0.7 of the true one was 3.2 sigmas off.
_PART_OF_THE_WAY = 3.0
_MIN_SIGMA_PX = 0.02
# Where Cauchy's loss begins to bend, in sigmas.
LOSS_SIGMAS = 2.0
_TRIANGULATION_PX, _TRIANGULATION_DEG = 2.0, 0.2


@dataclass(frozen=True)
class Answer:
    """What came of questioning a calibration.

    Attributes:
        model: with the calibration that is believed, poses and points adjusted to it.
        is_refined: it is not the given one.
        report: the numbers behind that.
        contradictions: the given calibration is wrong, and what is right could not be told or may not be taken.
        scale_sigma: relative standard deviation of the unit of length of a rig; None for a single camera.
        pose_covariance: (F, 6, 6) what the refined calibration leaves open, in the gauge of the map's covariance; None
            if the given one is believed.
        excess: how many times farther off the given calibration was than calibrations ordinarily are, at least 1.
    """

    model: Reconstruction
    is_refined: bool
    report: CalibrationCheck
    contradictions: list[Contradiction]
    scale_sigma: float | None
    pose_covariance: Array | None = None
    excess: float = 1.0


@dataclass(frozen=True)
class Unknowns:
    """What may be off: the names, prior standard deviations (Q,), and which of them may be off by more than that."""

    names: list[str]
    sigmas: Array
    is_open: NDArray[np.bool_]

    @staticmethod
    def of(model: Reconstruction) -> Unknowns:
        """Those of the cameras of a model."""
        rows = [("focal", _FOCAL_SIGMA, True)]
        if len(model.cameras) > 1:
            rows.append(("focal_difference", _FOCAL_DIFFERENCE_SIGMA, True))
        for c, camera in enumerate(model.cameras):
            rows.append((f"aspect_{c}", _ASPECT_SIGMA, False))
            bends = [name for name in PARAM_NAMES[_fullest(camera).model] if kind_of(name) == "distortion"]
            kinds = [_TANGENTIAL_SIGMA if name[0] in "ps" else _RADIAL_SIGMA for name in bends]
            rows += [(f"distortion_{c}_{k}", sigma, True) for k, sigma in enumerate(kinds)]
        if len(model.cameras) > 1:
            rows += [(f"turn_{axis}", math.radians(_TURN_SIGMA_DEG), True) for axis in "xyz"]
        names, sigmas, is_open = zip(*rows, strict=True)
        return Unknowns(list(names), np.array(sigmas), np.array(is_open, bool))

    def directions(self, model: Reconstruction) -> Array:
        """(C, 19, Q) how each unknown changes the canonical intrinsics and the turn of each camera."""
        out, column = np.zeros((len(model.cameras), RAW, len(self.names))), self.names.index
        for c, camera in enumerate(model.cameras):
            fx, fy = camera.canonical[:2]
            out[c, :2, column("focal")] = fx, fy
            out[c, :2, column(f"aspect_{c}")] = fx / 2, -fy / 2
            slots = _distortion_slots(camera)
            out[c, slots, column(f"distortion_{c}_0") + np.arange(len(slots))] = 1.0
            if len(model.cameras) > 1:
                out[c, :2, column("focal_difference")] = np.array([fx, fy]) * (0.5 if c else -0.5)
        if len(model.cameras) > 1:
            out[1, np.arange(16, 19), column("turn_x") + np.arange(3)] = 1.0
        return out

    def between(self, given: Reconstruction, found: Reconstruction) -> Array:
        """(Q,) what the cameras of one model differ by from those of another."""
        x, column = np.zeros(len(self.names)), self.names.index
        canonical = [np.array([c.canonical for c in model.cameras]) for model in (given, found)]
        logs = np.log(canonical[1][:, :2] / canonical[0][:, :2])
        x[column("focal")] = logs.mean()
        for c in range(len(logs)):
            x[column(f"aspect_{c}")] = logs[c, 0] - logs[c, 1]
            slots = _distortion_slots(given.cameras[c])
            x[column(f"distortion_{c}_0") + np.arange(len(slots))] = canonical[1][c, slots] - canonical[0][c, slots]
        if given.rig is not None and found.rig is not None:
            x[column("focal_difference")] = logs[1].mean() - logs[0].mean()
            turn = rigid3.compose(found.rig.cam_from_rig[1], rigid3.inverse(given.rig.cam_from_rig[1]))
            x[column("turn_x") + np.arange(3)] = rigid3.log_so3(rigid3.rotation_matrix(turn))
        return x

    def named(self, values: Array) -> dict[str, float]:
        """Values (Q,) as they stand in the report."""
        return dict(zip(self.names, values.tolist(), strict=True))

    def priors(self, x: Array) -> Array:
        """(Q,) standard deviations where the data say x: those that it leaves by far are as wide as it is off."""
        return np.where(self.is_open & (np.abs(x) > _PRIOR_SIGMAS * self.sigmas), np.abs(x), self.sigmas)


@dataclass(frozen=True)
class _Look:
    """A model, and what its tracks say of its calibration.

    Attributes:
        x: (Q,) change from the given calibration so far. cost: of the adjustment, in units of the noise.
        system: by cluster of tracks whose errors are shared; its last N unknowns are amplitudes of smooth fields.
        noise: how much more the data vary than independent errors would.
        priors: (Q,) standard deviations around the given calibration. field_prior: information of an amplitude.
        step: (Q,) to where the cost and the priors are least. covariance: (Q, Q) of that.
    """

    model: Reconstruction
    x: Array
    cost: float
    system: CalibrationSystem
    noise: float
    priors: Array
    field_prior: float
    step: Array
    covariance: Array

    @property
    def change(self) -> Array:
        """(Q,) where the images lead from the given calibration: as far as was gone, or the first step."""
        return self.x if self.x.any() else self.step

    @property
    def data_information(self) -> Array:
        """(Q, Q) what the images alone say, fields and shared errors allowed for."""
        return np.asarray(np.linalg.inv(self.covariance) - np.diag(self.priors**-2.0), np.float64)

    @property
    def step_sigmas(self) -> float:
        """How far the step goes, in standard deviations of where it ends."""
        return math.sqrt(max(float(self.step @ np.linalg.solve(self.covariance, self.step)), 0.0))


def question_calibration(
    model: Reconstruction,
    cost: float,
    sigma: float,
    *,
    may_refine: bool,
    found_before: tuple[Reconstruction, float] | None = None,
) -> Answer:
    """Hold the given calibration of a map against its images.

    Args:
        model: adjusted with the cameras as they were given; image S k + s is that of sensor s at the k-th keyframe.
        cost: of that adjustment in units of the noise. sigma: the noise in pixels.
        may_refine: the given calibration may be replaced; otherwise it is only said what contradicts it.
        found_before: the same, with the cameras that an earlier question has found. Where the given ones are far off,
            a map that was made with others is torn by them, and leads nowhere.
    """
    unknowns = Unknowns.of(model)
    first = begin = _look(model, np.zeros(len(unknowns.names)), cost, sigma, unknowns)
    if found_before is not None:
        begin = _look(found_before[0], unknowns.between(model, found_before[0]), found_before[1], sigma, unknowns)
    if first is None or begin is None:
        is_rig = len(model.cameras) > 1
        return Answer(model, False, CalibrationCheck(is_refined=False), [], _UNKNOWN_SCALE if is_rig else None)
    limit = _SHARED_ERRORS * exceeded_by_chance(len(first.x), _MAX_CHANCE)
    surprise = float(first.step @ first.data_information @ first.step)
    if begin is first and surprise < limit / _SHARED_ERRORS:
        return _kept(first, first, unknowns, _report(first, surprise, limit, unknowns), [])
    last = _settle(begin, sigma, unknowns)
    surprise = float(last.change @ last.data_information @ last.change)
    basis, held_out = _held_out(last)
    far = unknowns.priors(last.change) > unknowns.sigmas
    known = (np.sqrt(np.diag(last.covariance)) < _MAX_UNSURE * np.abs(last.x))[far].all()
    settled = last.step_sigmas < _SETTLED_SIGMAS * _ROUNDS
    agree = held_out[:-1] > _MIN_DIRECTION_SIGMAS
    report = replace(
        _report(last, surprise, limit, unknowns),
        held_out_sigmas=float(held_out[-1]), direction_sigmas=held_out[:-1].tolist(), is_settled=settled,
        given=[c.params.tolist() for c in model.cameras],
    )  # fmt: skip
    is_better = last.cost < first.cost and held_out[-1] > _MIN_HELD_OUT_SIGMAS
    if may_refine and settled and known and surprise > limit and is_better and agree.any():
        # x = basis a, and what other tracks do not confirm may as well be as it was given
        doubtful = basis[:, ~agree] @ (np.linalg.inv(basis)[~agree] @ last.x)
        refined = _start_afresh(last, sigma, unknowns)
        pairs = zip(refined.model.cameras, model.cameras, strict=True)
        report = replace(
            report, is_refined=True, focal_change=[c.focal / g.focal - 1 for c, g in pairs],
            refined=[c.params.tolist() for c in refined.model.cameras],
        )  # fmt: skip
        return _refined(refined, doubtful, unknowns, report)
    found = [_contradiction(first, last, report, unknowns)] if surprise > limit and far.any() else []
    return _kept(first, last, unknowns, report, found)


def _report(look: _Look, surprise: float, limit: float, unknowns: Unknowns) -> CalibrationCheck:
    """What the images would change, how sure they are of it, and how much is needed to be believed."""
    return CalibrationCheck(
        is_refined=False, surprise=surprise, max_surprise=limit, noise_inflation=look.noise,
        change=unknowns.named(look.change), sigma=unknowns.named(np.sqrt(np.diag(look.covariance))),
    )  # fmt: skip


# ------------------------------------------------------------------ what the images say


def follow_with_poses(model: Reconstruction, sigma: float, events: Events | None = None) -> float:
    """Adjust poses and points of a map, in place, as closely as a look at its calibration asks for; returns the cost.

    Where robust losses let go of single observations, the last steps are many and small: on KITTI 00 half of all.
    """
    return adjust_poses(model, sigma, _FOLLOWING_STEPS, _FOLLOWING_TOLERANCE, _FOLLOWED_SIGMAS, events)


def adjust_poses(
    model: Reconstruction, sigma: float, max_steps: int, tolerance: float, settled_sigmas: float = 0.0,
    events: Events | None = None,
) -> float:  # fmt: skip
    """Adjust poses and points of a map, in place, its first keyframe held; returns the cost in units of the noise."""
    options, varying = _of_poses(model, sigma, max_steps, tolerance)
    options = replace(options, settled_sigmas=settled_sigmas)
    return 2 * adjust_bundle(model, options, varying=varying, events=events).final_cost / sigma**2


def close_poses(
    model: Reconstruction, sigma: float, max_steps: int, tolerance: float, events: Events | None = None
) -> AdjustReport:
    """The same as the closing adjustment; twice its final cost is in units of the noise."""
    options, varying = _of_poses(model, sigma, max_steps, tolerance)
    return FactorGraph(model, options, varying=varying, noise_px=sigma).optimize(events)


def _of_poses(model: Reconstruction, sigma: float, max_steps: int, tolerance: float) -> tuple[AdjustOptions, Varying]:
    num_sensors = 1 if model.rig is None else len(model.rig.cam_from_rig)
    variable = np.ones(len(model.image_names), bool)
    variable[:num_sensors] = False
    options = AdjustOptions(
        loss="cauchy", loss_scale_px=LOSS_SIGMAS * sigma, max_iterations=max_steps, relative_cost_tolerance=tolerance,
        refine_focal=False, refine_distortion=False,
    )  # fmt: skip
    return options, Varying(images=variable)


def _look(model: Reconstruction, x: Array, cost: float, sigma: float, unknowns: Unknowns) -> _Look | None:
    """What the tracks say around a model; None where they are too few, or say nothing that is finite."""
    num, fields = len(x), _smooth_fields(model)
    num_wanted = _MIN_CLUSTERS * (num + 2 * len(model.cameras) * fields.shape[1])
    clusters = partial(_clusters, model, num_wanted=num_wanted)
    try:
        system = reduce_to_calibration(model, unknowns.directions(model), sigma, clusters, fields=fields)
    except np.linalg.LinAlgError:
        return None
    gradient, information = system.gradient.sum(0), system.information.sum(0)
    num_clusters = len(system.gradient)
    if num_clusters < num_wanted or not (np.isfinite(information).all() and np.isfinite(cost)):
        return None
    # scores where the data have their minimum: a weak prior keeps what they leave open
    weak = information + np.diag(1e-6 * np.diag(information))
    away: Array = -np.linalg.solve(weak, gradient)
    scores = system.gradient + system.information @ away
    scatter = scores.T @ scores * num_clusters / (num_clusters - 1)
    noise = max(1.0, float(np.trace(np.linalg.solve(weak, scatter))) / len(gradient))
    priors, off, field_sigma = unknowns.priors(x), np.concatenate([x, np.zeros(len(gradient) - num)]), _FIELD_SIGMA_PX
    for _ in range(_FIELD_STEPS):
        prior = np.concatenate([priors, np.full(len(gradient) - num, field_sigma)]) ** -2.0
        covariance = np.linalg.inv(information / noise + np.diag(prior))
        step = -(covariance @ (gradient / noise + prior * off))
        field_sigma = float(np.clip(np.sqrt((step[num:] ** 2).mean()), _FIELD_SIGMA_PX, _MAX_FIELD_SIGMA_PX))
    found = _Look(model, x, cost, system, noise, priors, prior[-1], step[:num], covariance[:num, :num])
    return found if np.isfinite(covariance).all() and np.isfinite(step).all() else None


def _smooth_fields(model: Reconstruction) -> Array:
    """(O, N) monomials of the place in the image, which runs from -1 to 1."""
    size = np.array([[c.width, c.height] for c in model.cameras], np.float64)
    u, v = (2 * model.tracks.obs_xy / size[model.image_camera_idx[model.tracks.obs_image_idx]] - 1).T
    low, high = _FIELD_DEGREES
    return np.column_stack([u**a * v ** (n - a) for n in range(low, high + 1) for a in range(n + 1)])


def _clusters(model: Reconstruction, track_idx: NDArray[np.int64], num_wanted: float) -> NDArray[np.int64]:
    """(T,) number of the cluster of each track, by where and when it was first seen."""
    tracks, camera = model.tracks, model.cameras[0]
    first = tracks.track_ptr[track_idx]
    frames = tracks.obs_image_idx[first].astype(np.int64) // len(model.cameras)
    for num_frames, columns, rows in _CLUSTERS:
        place = tracks.obs_xy[first] / [camera.width / columns, camera.height / rows]
        column, row = np.clip(place.astype(np.int64), 0, [columns - 1, rows - 1]).T
        keys = (frames // num_frames * rows + row) * columns + column
        numbers: NDArray[np.int64] = np.unique(keys, return_inverse=True)[1]
        if numbers.max(initial=-1) + 1 >= num_wanted:
            return numbers
    return np.arange(len(track_idx))


def _held_out(look: _Look) -> tuple[Array, Array]:
    """Whether tracks that had no part in a change agree with it, direction by direction.

    The tracks are split into folds, whole clusters each. What a fold's others say is taken as the calibration, then
    one direction of it is put back to what was given, the fields following; the fold's own tracks, their points free,
    say by how much that is worse.

    Returns:
        (Q, Q) columns of independent directions, and (Q + 1,) the gain of each, and of all together, in standard
        deviations, which are those of its sum over the clusters.
    """
    system, num = look.system, len(look.x)
    prior = np.concatenate([look.priors**-2.0, np.full(system.gradient.shape[1] - num, look.field_prior)])
    off = np.concatenate([look.x, np.zeros(len(prior) - num)])
    # of the information against the priors
    root = np.sqrt(prior[:num])
    basis = np.linalg.eigh(look.data_information / np.outer(root, root)).eigenvectors / root[:, None]
    coordinates = np.linalg.inv(basis)
    gains = np.zeros((len(system.gradient), num + 1))
    for fold in range(_FOLDS):
        held = np.arange(len(gains)) % _FOLDS == fold
        gradient = system.gradient[~held].sum(0) / look.noise + prior * off
        information = system.information[~held].sum(0) / look.noise + np.diag(prior)
        best = -np.linalg.solve(information, gradient)
        states = np.tile(best[:, None], num + 2)
        states[:num, 1:-1] -= basis * (coordinates @ (look.x + best[:num]))
        states[:num, -1] = -look.x
        right = gradient[num:, None] + information[num:, :num] @ states[:num, 1:]
        states[num:, 1:] = -np.linalg.solve(information[num:, num:], right)
        costs = system.gradient[held] @ states
        costs += 0.5 * np.einsum("tqn,qn->tn", system.information[held] @ states, states)
        gains[held] = costs[:, 1:] - costs[:, :1]
    # one cluster that gains very much must not make the rest look unsure, nor decide alone
    limit = _MAX_GAIN * np.median(np.abs(gains), axis=0)
    gains = np.clip(gains, -limit, limit)
    total = gains.sum(0)
    sigma = np.sqrt(((gains - gains.mean(0)) ** 2).sum(0))
    return basis, np.where(sigma > 0, total / np.where(sigma > 0, sigma, 1.0), 0.0)


# ------------------------------------------------------------------ following it


def _settle(look: _Look, sigma: float, unknowns: Unknowns) -> _Look:
    """Go where the images and the priors say, until they say nothing more or it does not get better."""
    reach, limit, way = 1.0, _MAX_REACH, np.zeros(len(look.x))
    for number in range(_ROUNDS_FAR):
        is_far = (look.priors > unknowns.sigmas).any() or abs(look.step[0]) > _MAX_STEP
        if look.step_sigmas < _SETTLED_SIGMAS or (number >= _ROUNDS and not is_far):
            break
        # robust weights and bent maps make steps too short: where one goes on as the last did, go further
        metric = np.linalg.inv(look.covariance)
        length = math.sqrt(max(float(way @ metric @ way), 1e-300)) * look.step_sigmas
        reach = min(2 * reach, limit) if way @ metric @ look.step > _SAME_WAY * length else 1.0
        farthest = _MAX_STEP / max(abs(look.step[0]), 1e-300)
        for share in sorted({min(r, farthest) for r in (reach, 1.0, 0.5, 0.25) if r <= reach}, reverse=True):
            after = _go(look, share * look.step, sigma, unknowns)
            if after is not None and _is_nearer(after, look, share):
                break
            reach, limit = 1.0, max(1.0, limit / 2)
        else:
            break
        look, way = after, look.step
    return look


def _is_nearer(after: _Look, before: _Look, share: float) -> bool:
    """Whether what came of a share of the step is to be gone on from: more than a step has to bring it to where the
    images and the priors say less. The cost alone, which lacks the priors and the fields, rises on that way."""
    if after.cost >= _MAX_RISE * before.cost:
        return False
    return share <= 1 or after.cost < before.cost or after.step_sigmas < before.step_sigmas / share


def _go(look: _Look, step: Array, sigma: float, unknowns: Unknowns) -> _Look | None:
    """Change the calibration by a step (Q,), let poses and points follow, and look again."""
    model = _changed(look.model, unknowns.directions(look.model) @ step)
    _move_frames(model, look.system.response[:, :, : len(step)] @ step)
    cost = follow_with_poses(model, sigma)
    return _look(model, look.x + step, cost, sigma, unknowns)


def _fullest(camera: Camera) -> Camera:
    """The camera with all parameters that its family of lenses has, where the family has a model with them."""
    model = {BROWN: CameraModel.OPENCV, RADIAL_FISHEYE: CameraModel.OPENCV_FISHEYE}.get(camera.family, camera.model)
    row, first = camera.canonical, canonical_from_params(model).argmax(axis=0)
    return replace(camera, model=model, params=row[first])


def _distortion_slots(camera: Camera) -> NDArray[np.int64]:
    """Places in the canonical row of what bends the image."""
    model = _fullest(camera).model
    first = canonical_from_params(model).argmax(axis=0)
    slots: NDArray[np.int64] = first[[kind_of(name) == "distortion" for name in PARAM_NAMES[model]]]
    return slots


def _changed(model: Reconstruction, change: Array) -> Reconstruction:
    """A copy with canonical intrinsics and turns of the cameras changed by (C, 19); the rig's own poses stay."""
    out, num_sensors = model.copy(), len(model.cameras)
    out.cameras = [
        replace(_fullest(camera).with_canonical(camera.canonical[:FAMILY] + by[:FAMILY]), is_fixed=False)
        for camera, by in zip(model.cameras, change, strict=True)
    ]
    if model.rig is not None:
        turns = rigid3.from_matrix(rigid3.exp_so3(change[:, FAMILY:]), np.zeros((num_sensors, 3)))
        frames = model.rig.rig_from_world(model.cam_from_world)
        out.rig = replace(model.rig, cam_from_rig=rigid3.compose(turns, model.rig.cam_from_rig))
        out.cam_from_world = out.rig.cam_from_world(np.arange(len(model.image_names)), frames[model.rig.frame_idx])
    return out


def _move_frames(model: Reconstruction, motion: Array) -> None:
    """Move the frames of a map by (F, 6), rotation and translation of ``exp(w) x + v``, in place."""
    step = rigid3.from_matrix(rigid3.exp_so3(motion[:, :3]), motion[:, 3:])
    if model.rig is None:
        model.cam_from_world = rigid3.compose(step, model.cam_from_world)
        return
    frames = rigid3.compose(step, model.rig.rig_from_world(model.cam_from_world))
    model.cam_from_world = model.rig.cam_from_world(np.arange(len(model.image_names)), frames[model.rig.frame_idx])


def _start_afresh(look: _Look, sigma: float, unknowns: Unknowns) -> _Look:
    """The tracks were sorted out by a calibration that was off, which keeps what agrees with it: take them all again,
    and settle once more."""
    model = look.model.copy()
    tracks = model.tracks
    lost = np.flatnonzero(~model.is_triangulated)
    triangulate_tracks(
        lost, Observed(tracks.track_ptr, tracks.obs_image_idx, tracks.obs_xy), model.views(), _TRIANGULATION_PX,
        math.radians(_TRIANGULATION_DEG), model.point_xyz, model.obs_is_inlier,
    )  # fmt: skip
    classify(model, np.zeros(tracks.num_tracks, np.int64))
    sigma = residual_scale_px(model, _MIN_SIGMA_PX)
    cost = follow_with_poses(model, sigma)
    again = _look(model, look.x, cost, sigma, unknowns)
    return look if again is None else replace(_settle(again, sigma, unknowns), cost=look.cost)


# ------------------------------------------------------------------ what follows from it


def _refined(look: _Look, doubtful: Array, unknowns: Unknowns, report: CalibrationCheck) -> Answer:
    """The calibration that was found is believed, as far as it is known: what (Q,) is doubtful of it may be wrong."""
    num, look = len(look.x), replace(look, covariance=look.covariance + np.outer(doubtful, doubtful))
    scale = _scale_parts(look, 0.0, unknowns)
    num_sensors = len(look.model.cameras)
    poses, freedoms = look.model.cam_from_world[::num_sensors], 6 if num_sensors > 1 else 7
    basis, constraint = (rows[:freedoms] for rows in similarity_basis(poses))
    moved = look.system.response[:, :, :num].reshape(-1, num)
    moved = moved - basis.T @ (moves_into_gauge(basis, constraint) @ moved)
    by_frame = moved.reshape(-1, 6, num)
    open_ = by_frame @ look.covariance @ by_frame.transpose(0, 2, 1)
    excess = max(1.0, float(np.abs(look.x / unknowns.sigmas).max()) / _PRIOR_SIGMAS)
    sigma = None if scale is None else scale.sigma
    return Answer(look.model, True, replace(report, scale=scale), [], sigma, open_, excess)


def _kept(
    first: _Look, last: _Look, unknowns: Unknowns, report: CalibrationCheck, found: list[Contradiction]
) -> Answer:
    """The given calibration stays; what the images would rather have is part of what the scale is not known by."""
    if last is first:
        shift = float(first.system.log_scale[: len(first.x)] @ first.step)
    else:
        shift = math.log(rigid3.spread(last.model.cam_from_world) / rigid3.spread(first.model.cam_from_world))
    scale = _scale_parts(first, shift, unknowns)
    return Answer(first.model, False, replace(report, scale=scale), found, None if scale is None else scale.sigma)


def _scale_parts(look: _Look, shift: float, unknowns: Unknowns) -> ScaleParts | None:
    """Relative standard deviation of the unit of length of a rig, and what it is made of; None without a rig.

    With a path that does not bend and points that are far, a turn of the second camera by w looks like a scale that is
    off by w f / disparity, and a lens that is longer like a longer way: what the images do not tell of the two is
    left as wide as the priors are.
    """
    if len(look.model.cameras) == 1:
        return None
    by = look.system.log_scale[: len(look.x)]
    sigmas = np.sqrt(np.diag(look.covariance))
    parts = {
        kind: float(np.sqrt(((by * sigmas)[[n.startswith(kind) for n in unknowns.names]] ** 2).sum()))
        for kind in ("focal", "aspect", "distortion", "turn")
    }
    calibration = float(np.sqrt(by @ look.covariance @ by))
    noise = math.sqrt(look.noise * look.system.scale_variance)
    total = math.sqrt(_BASELINE_SIGMA**2 + calibration**2 + noise**2 + shift**2)
    return ScaleParts(
        baseline=_BASELINE_SIGMA, calibration=calibration, **parts, disparity=noise, shift=abs(shift), sigma=total
    )


def _contradiction(first: _Look, last: _Look, report: CalibrationCheck, unknowns: Unknowns) -> Contradiction:
    """The images say clearly that the given calibration is wrong; what is right they do not, or it may not be taken."""
    num_sensors = len(first.model.cameras)
    given, found = first.model.cam_from_world[::num_sensors], last.model.cam_from_world[::num_sensors]
    moved = similarity.transform_poses(similarity.align_poses(found, given).b_from_a, found)
    turn = rigid3.log_so3(rigid3.rotation_matrix(rigid3.compose(moved, rigid3.inverse(given))))
    shift = rigid3.center(moved) - rigid3.center(given)
    size = max(rigid3.spread(first.model.cam_from_world), 1e-12)
    share = 1.0 if report.is_settled else _PART_OF_THE_WAY
    # where not even a step made it better, the map is torn: anything may be off
    torn = 0.0 if last.x.any() else 1.0
    focal = [first.model.cameras[0].focal, last.model.cameras[0].focal]
    if torn:
        focal[1] *= math.exp(last.step[0])
    return Contradiction(
        "given calibration",
        f"the images contradict the given calibration by {report.surprise:.0f} where shared errors explain up to "
        f"{report.max_surprise:.0f}: a focal length of {focal[0]:.1f} px is given, they indicate {focal[1]:.1f}"
        + ("" if report.is_settled else ", and more refinement would change it further"),
        "calibrate the camera, or give a better focal length",
        {k: report[k] for k in ("surprise", "max_surprise", "is_settled", "change")},
        rotation_sigma_deg=max(share * float(np.degrees(np.sqrt((turn**2).mean()))), 180.0 * torn),
        position_sigma_share=max(share * float(np.sqrt((shift**2).mean())) / size, torn),
        scale_sigma=(
            max(share * abs(math.log(rigid3.spread(last.model.cam_from_world) / size)), torn)
            if num_sensors > 1
            else 0.0
        ),
    )
