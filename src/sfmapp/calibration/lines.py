"""A camera from the straight lines of photographs, without a board: what they tell of it, how surely, and what not.

Two kinds of evidence: straight lines of the world are straight without the distortion, wherever they run (plumb lines);
and in a built world most run in a few directions at right angles, whose vanishing points tell focal length and
principal point. Lines vote, nothing is started from (:mod:`sfmapp.calibration.line_search`), and what comes out has to
convince lines that it was not made from.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.line_edges import MOST_PIXELS, Arcs, find_arcs
from sfmapp.calibration.line_planes import on_lines
from sfmapp.calibration.line_refinement import (
    CENTER_X,
    LOG_FOCAL,
    NUM_CAMERA,
    STRENGTH,
    Lines,
    Problem,
    Solution,
    World,
    covariance_of,
    solve,
    straightness_px,
    vanishing_points,
)
from sfmapp.calibration.line_report import (
    HeldOutLines,
    LineDirection,
    LineParameter,
    LinePhotograph,
    LinesReport,
    Verdict,
)
from sfmapp.calibration.line_search import (
    CENTER_SHARE,
    STRAIGHT_SIGMAS,
    STRENGTHS,
    Found,
    find_worlds,
    likely_strengths,
    lines_of,
    losses,
    plain_problem,
    settle,
    sharpened,
    solve_plumb,
    strength_votes,
    worlds_of,
)
from sfmapp.calibration.result import CameraCalibration, ViewFit
from sfmapp.calibration.vanishing import SIGMA_PX, misses
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

# Fewer arcs than this in a photograph, or in all, show nothing.
_LEAST_ARCS = 12
# Searches with other random numbers; all have to come to one focal length.
NUM_SEEDS = 3
_SAME_FOCAL = 0.01
# What is zero within this many sigmas is left zero.
_SEEN_SIGMAS = 3.0
# Held-out lines meet vanishing points this many sigmas more often than by chance where there are any.
_LEAST_MET_SIGMAS = 5.0
# A line is bent by a distortion from this rms distance on; a distortion lambda R^2 that is no better known is unknown.
_BENT_PX, _WORST_STRENGTH = 0.3, 0.05
# A bend that the means of edge points, good to a twentieth of a pixel, show.
_TELLING_PX = 0.1
# A focal length that is no better known than this share is not called known, nor one whose halves differ by more than
# so many sigmas (and one per cent). Others of nearly its likelihood (a ratio of e to this) are in its sigma, up to so
# far away: a third of what nothing but a default leaves open.
_WORST_FOCAL, _MOST_APART_SIGMAS, _RIVAL_GAIN, _WORST_RIVAL = 0.05, 3.0, 12.0, 0.2
# Fewer lines than this along a direction do not count it.
_LEAST_OF_DIRECTION = 6
# What is assumed where lines do not tell: the project's default for photographs that say nothing, and how far off it
# may be (mapping's prior has the same two).
_DEFAULT_FOCAL, _DEFAULT_LOG_SIGMA = 1.2, 0.6
_ADVICE = (
    "photograph a built place across a corner of a house or a room, with long lines out to the borders of the picture; "
    "several photographs of one camera are used together"
)
# Fields along the sides in which held-out lines count as one witness, and the most (log-likelihood) that one is worth.
_WITNESS_CELLS, _MOST_OF_WITNESS = 12, 3.0
# A distortion that is this many sigmas of the jackknife from zero needs only so many by held-out lines. Boards have 21
# to 69 and 1.1 to 2.7; photographs without distortion or straight lines 17 at most with less than 1.5, random arcs 8.
_STEADY_SIGMAS, _STEADY_T = 20.0, 1.5
# Parts that straight lines alone are held out in; worlds are sought in halves, for each part would take a search.
_PLUMB_FOLDS = 6
# Least sigma, as a share, of a focal length that no third direction checks: right angles of houses are not exact.
_UNCHECKED_FOCAL = 0.05
# Cells along the sides of a photograph that are held out in turn, as the fields of a chessboard.
_HELD_CELLS = 6


@dataclass(frozen=True)
class LinePicture:
    """A photograph to calibrate from.

    Attributes:
        name: of the photograph.
        grey: (H, W) uint8; all photographs of a camera have one size.
        mask: (H, W) True where it may be used; None for everywhere.
    """

    name: str
    grey: Grey
    mask: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class LineCalibration:
    """A camera from lines.

    Attributes:
        calibration: SIMPLE_DIVISION. What is not told has the sigma of what was assumed instead.
        report: what is told, and why.
        names: of the photographs that were used.
        photos: their arcs, and the directions that these run along.
    """

    calibration: CameraCalibration
    report: LinesReport
    names: tuple[str, ...]
    photos: tuple[Lines, ...]


def calibrate_from_lines(pictures: Sequence[LinePicture], seed: int = 0) -> LineCalibration:
    """Distortion, focal length and principal point of one camera, as far as straight lines tell them.

    Raises:
        InputError: photographs of several sizes, or with too few lines, or whose lines tell nothing.
    """
    sizes = {picture.grey.shape for picture in pictures}
    if len(sizes) != 1:
        shown = ", ".join(sorted(f"{width}x{height}" for height, width in sizes)) or "none"
        raise InputError(
            f"expected photographs of one size, found {shown}", "calibrate each camera, and each zoom, alone"
        )
    ((height, width),) = sizes
    return calibrate_from_arcs(
        [one.name for one in pictures], [find_arcs(one.grey, one.mask) for one in pictures], (width, height), seed
    )


def calibrate_from_arcs(
    names: Sequence[str], arcs: Sequence[Arcs], size: tuple[int, int], seed: int = 0
) -> LineCalibration:
    """As :func:`calibrate_from_lines`, from the arcs of photographs of a size (width, height)."""
    problem = plain_problem(*size, max(1.0, 2.0 ** math.ceil(math.log2(max(size) / MOST_PIXELS))))
    used = [k for k, one in enumerate(arcs) if len(one) >= _LEAST_ARCS]
    if not used:
        raise InputError(
            f"expected at least {_LEAST_ARCS} edges that may be straight lines, found {max(map(len, arcs), default=0)}",
            _ADVICE,
        )
    shown = [arcs[k] for k in used]
    votes = np.sum([strength_votes(problem, one) for one in shown], axis=0)
    search = _search(problem, shown, likely_strengths(votes)[:2], seed)
    trials = [_try(problem, *parts, has_worlds=search is not None, seed=seed) for parts in _folds(problem, shown, 2)]
    held_out = _held_out(trials, search)
    focal = _judge_focal(search, trials, held_out)
    if search is not None and focal.is_told:
        problem, solution = search.problem, search.best.solution
    else:  # a world that does not convince says nothing of the distortion either
        solution = solve_plumb(problem, shown, likely_strengths(votes))
        trials = [_try(problem, *parts, has_worlds=False, seed=seed) for parts in _folds(problem, shown, _PLUMB_FOLDS)]
        held_out = _held_out(trials, None)
    strength = _judge_strength(problem, solution, trials)
    free = solution
    solution, center = _final(problem, solution, strength)
    focal = _held_to(focal, abs(float(solution.camera[LOG_FOCAL] - free.camera[LOG_FOCAL])))
    if not (focal.is_told or strength.is_told or strength.is_none):
        raise InputError(
            f"the lines of {len(used)} photograph{'s' * (len(used) > 1)} tell nothing of the camera: distortion: "
            f"{strength.reason}; focal length: {focal.reason}",
            _ADVICE,
        )
    calibration = _calibration(problem, solution, (strength, focal, center), [names[k] for k in used])
    report = LinesReport(
        mode="directions" if focal.is_told else "plumb lines",
        parameters=_parameters(problem, solution, calibration, (strength, focal, center)),
        photographs=_photographs(problem, solution, names, arcs, used),
        strengths=STRENGTHS.tolist(),
        votes=votes.tolist(),
        held_out=held_out,
        num_seeds=0 if search is None else search.num_agreeing,
        warnings=calibration.warnings,
    )
    return LineCalibration(calibration, report, tuple(names[k] for k in used), solution.photos)


# ------------------------------------------------------------------------------------------------------- the search


@dataclass(frozen=True)
class _Search:
    """What searches with several random numbers came to.

    Attributes:
        best: refined on all lines.
        problem: with the errors that the lines of directions show to have.
        num_agreeing: searches whose best has the same focal length, or one of the rivals.
        rivals: logarithms of other focal lengths that lines like nearly as well, over that of the best.
    """

    best: Found
    problem: Problem
    num_agreeing: int
    rivals: tuple[float, ...]


def _search(problem: Problem, arcs: Sequence[Arcs], strengths: Array, seed: int) -> _Search | None:
    tops: list[Found] = []
    others: list[Found] = []
    for k in range(NUM_SEEDS):
        found = find_worlds(problem, arcs, strengths, seed + 1000 * k)
        if not found:
            return None
        tops.append(found[0])
        others += found
    top = max(tops, key=lambda one: one.gain)
    best = settle(problem, arcs, top.solution.camera, worlds_of(top.solution))
    sharp = sharpened(problem, best.solution)
    best = settle(sharp, arcs, best.solution.camera, worlds_of(best.solution))
    liked = [math.log(one.focal / best.focal) for one in others if one.gain > top.gain - _RIVAL_GAIN]
    rivals = tuple(sorted((log for log in liked if abs(log) > _WORST_FOCAL), key=abs))
    farthest = max((abs(log) for log in rivals), default=0.0) + _SAME_FOCAL
    agreeing = sum(abs(math.log(one.focal / best.focal)) < max(farthest, 2.0 * _SAME_FOCAL) for one in tops)
    return _Search(best, sharp, agreeing, rivals)


# --------------------------------------------------------------------------------------------------- held-out lines


@dataclass(frozen=True)
class _Trial:
    """A calibration from some of the lines, and how it fares with the others, N of them.

    Attributes:
        strength, log_focal: of the calibration; the focal length is None where no world was found.
        log_focal_sigma: of it.
        predicted_px: (N,) rms bend of each line by the distortion.
        before_px, after_px: (N,) rms distances of the points of a line from a straight one, without and with the
            distortion undone.
        gained: (N,) log-likelihood of each line with the distortion, less that without.
        witness: (N,) part of a picture that the line is in: all lines of a part count as one witness.
        num_met, num_expected, num_lines: straight lines that meet a vanishing point, how many would by chance, and all.
        variance: of num_met by chance.
    """

    strength: float
    log_focal: float | None
    log_focal_sigma: float
    predicted_px: Array
    before_px: Array
    after_px: Array
    gained: Array
    witness: NDArray[np.int64]
    num_met: int
    num_expected: float
    num_lines: int
    variance: float


def _cells(problem: Problem, arcs: Arcs, num: int = _HELD_CELLS) -> NDArray[np.int64]:
    """(N, 2) the field of the picture that the middle of each line is in."""
    middle = arcs.points.mean(1) / [problem.width, problem.height]
    cells: NDArray[np.int64] = np.clip((middle * num).astype(np.int64), 0, num - 1)
    return cells


def _folds(problem: Problem, arcs: Sequence[Arcs], num: int) -> list[tuple[list[Arcs], list[Arcs]]]:
    """Lines to learn from and lines to ask, in num ways of which each asks others: those whose middle is in one of num
    kinds of fields of the pictures, so that the edges of one thing are on one side. Two kinds are a chessboard's."""
    kind = [_cells(problem, one) @ [1, 1 if num == 2 else 2] % num for one in arcs]
    learn = [[one.take(k != n) for one, k in zip(arcs, kind, strict=True)] for n in range(num)]
    ask = [[one.take(k == n) for one, k in zip(arcs, kind, strict=True)] for n in range(num)]
    return list(zip(learn, ask, strict=True))


def _try(problem: Problem, learn: list[Arcs], ask: list[Arcs], *, has_worlds: bool, seed: int) -> _Trial:
    """Calibrate from some of the lines and ask the others."""
    votes = np.sum([strength_votes(problem, one) for one in learn], axis=0)
    strengths = likely_strengths(votes)
    found = find_worlds(problem, learn, strengths[:2], seed) if has_worlds else []
    camera = found[0].solution.camera if found else solve_plumb(problem, learn, strengths).camera
    lens = problem.lens(camera)
    plain = replace(lens, strength=0.0)
    plain_camera, plain_worlds = _without_distortion(problem, learn, camera, found)
    predicted, before, after, witness, met, gained = [], [], [], [], [], []
    for k, one in enumerate(ask):
        if len(one) == 0:
            continue
        predicted.append(straightness_px(plain, Arcs(on_lines(lens, one.points), one.length_px, one.rms_px)))
        before.append(straightness_px(plain, one))
        after.append(straightness_px(lens, one))
        witness.append(k * _WITNESS_CELLS**2 + _cells(problem, one, _WITNESS_CELLS) @ [1, _WITNESS_CELLS])
        world = found[0].solution.photos[k].world if found else None
        gained.append(losses(problem, plain_camera, one, plain_worlds[k]) - losses(problem, camera, one, world))
        if world is not None:
            met.append(_meetings(problem, camera, one, world))
    each = np.sum(met, axis=0) if met else np.zeros(4)
    return _Trial(
        float(camera[STRENGTH]), float(camera[LOG_FOCAL]) if found else None,
        float(np.sqrt(found[0].solution.covariance[LOG_FOCAL, LOG_FOCAL])) if found else math.inf,
        _joined(predicted), _joined(before), _joined(after), _joined(gained),
        np.concatenate(witness) if witness else np.zeros(0, np.int64),
        int(each[0]), float(each[1]), int(each[2]), float(each[3]),
    )  # fmt: skip


def _joined(parts: Sequence[Array]) -> Array:
    return np.concatenate(parts) if parts else np.zeros(0)


def _without_distortion(
    problem: Problem, arcs: list[Arcs], camera: Array, found: Sequence[Found]
) -> tuple[Array, list[World | None]]:
    """What the same lines come to where there is no distortion."""
    held = replace(problem, is_free=np.array([False, True, True, True]))
    camera = np.where(held.is_free, camera, 0.0)
    if not found:
        return camera, [None] * len(arcs)
    solution = settle(held, arcs, camera, worlds_of(found[0].solution)).solution
    return solution.camera, [photo.world for photo in solution.photos]


def _meetings(problem: Problem, camera: Array, arcs: Arcs, world: World) -> Array:
    """Lines that meet a vanishing point, expected by chance, straight lines, and the variance by chance."""
    straight = arcs.take(straightness_px(problem.lens(camera), arcs) < STRAIGHT_SIGMAS * SIGMA_PX * problem.pixel_scale)
    if len(straight) == 0:
        return np.zeros(4)
    lines = lines_of(problem, camera, straight)
    directions = world.directions
    miss = misses(lines, vanishing_points(directions, float(np.exp(camera[LOG_FOCAL]))))
    # within two sigmas on either side of one of the directions, of half a circle; the peak is 1 / (2 pi)^(1/2) sigmas
    # high
    chance = np.minimum(len(directions) * 4.0 / (math.sqrt(2.0 * math.pi) * lines.peak), 1.0)
    return np.array([(miss.min(1) < 2.0).sum(), chance.sum(), len(straight), (chance * (1.0 - chance)).sum()])


def _held_out(trials: Sequence[_Trial], search: _Search | None) -> HeldOutLines:
    bent = [trial.predicted_px > _BENT_PX for trial in trials]
    before = np.concatenate([trial.before_px[b] for trial, b in zip(trials, bent, strict=True)])
    after = np.concatenate([trial.after_px[b] for trial, b in zip(trials, bent, strict=True)])
    shares = [t.log_focal - math.log(search.best.focal) for t in trials if t.log_focal is not None] if search else []
    return HeldOutLines(
        num_bent=len(before),
        bend_before_px=float(np.median(before)) if len(before) else 0.0,
        bend_after_px=float(np.median(after)) if len(after) else 0.0,
        num_lines=sum(trial.num_lines for trial in trials),
        num_met=sum(trial.num_met for trial in trials) if shares else None,
        num_expected=sum(trial.num_expected for trial in trials) if shares else None,
        focal_shares=[math.exp(share) for share in shares] or None,
    )


# ------------------------------------------------------------------------------------------------------- the verdicts


@dataclass(frozen=True)
class _Judged:
    """Whether a parameter is told, and why, or why not.

    Attributes:
        is_none: it is zero as far as anybody can see, which is something told as well.
        widened: the least sigma that the halves leave it, in its own unit.
    """

    is_told: bool
    reason: str
    is_none: bool = False
    widened: float = 0.0


def _judge_focal(search: _Search | None, trials: Sequence[_Trial], held_out: HeldOutLines) -> _Judged:
    if search is None:
        return _Judged(False, "no two lines meet anywhere")
    solution = search.best.solution
    counts = [np.bincount(photo.member[photo.member >= 0], minlength=3)[:3] for photo in solution.photos]
    if not any((count >= _LEAST_OF_DIRECTION).sum() >= 2 for count in counts):
        return _Judged(False, f"no two directions at right angles have {_LEAST_OF_DIRECTION} lines each")
    sigma = float(np.sqrt(solution.covariance[LOG_FOCAL, LOG_FOCAL]))
    if not sigma < _WORST_FOCAL:
        return _Judged(
            False,
            "the view is frontal or shows one direction in depth only: vanishing points near infinity leave the focal "
            f"length open by {100 * min(sigma, 9.99):.0f} %",
        )
    logs = [trial.log_focal for trial in trials if trial.log_focal is not None]
    if len(logs) < 2 or held_out.num_met is None or held_out.num_expected is None:
        return _Judged(False, "there are too few lines to ask half of them about the other half")
    spread = math.sqrt(max(sum(trial.variance for trial in trials), 1.0))
    if (held_out.num_met - held_out.num_expected) / spread < _LEAST_MET_SIGMAS:
        return _Judged(
            False,
            f"{held_out.num_met} of {held_out.num_lines} held-out lines meet the vanishing points of the others, "
            f"{held_out.num_expected:.0f} would by chance: no built world of a few directions shows",
        )
    apart = abs(logs[0] - logs[1])
    if apart > _MOST_APART_SIGMAS * math.hypot(*(trial.log_focal_sigma for trial in trials)) and apart > _SAME_FOCAL:
        return _Judged(False, f"two halves of the lines have focal lengths that differ by {100 * apart:.1f} %")
    farthest = abs(search.rivals[-1]) if search.rivals else 0.0
    if farthest > _WORST_RIVAL:
        rival = 100 * (math.exp(search.rivals[-1]) - 1.0)
        return _Judged(False, f"another focal length, {rival:+.0f} %, explains the lines nearly as well")
    if search.num_agreeing < NUM_SEEDS:
        return _Judged(False, f"{search.num_agreeing} of {NUM_SEEDS} searches found this focal length")
    reason = (
        f"{held_out.num_met} of {held_out.num_lines} held-out lines meet the vanishing points of the others "
        f"({held_out.num_expected:.0f} would by chance)"
    )
    if search.rivals:
        rival = 100 * (math.exp(search.rivals[-1]) - 1.0)
        reason += f"; another focal length, {rival:+.0f} %, explains the lines nearly as well and is in the sigma"
    # halves that lie on one side of the whole show that it hangs on few lines
    whole = math.log(search.best.focal)
    return _Judged(True, reason, widened=max(apart / 2.0, farthest, *(abs(log - whole) for log in logs)))


def _judge_strength(problem: Problem, solution: Solution, trials: Sequence[_Trial]) -> _Judged:
    strength, sigma = float(solution.camera[STRENGTH]), float(np.sqrt(solution.covariance[STRENGTH, STRENGTH]))
    # the jackknife's sigma (of two halves, half of what they are apart)
    each = np.array([trial.strength for trial in trials])
    spread = math.sqrt((len(each) - 1) / len(each) * float(((each - each.mean()) ** 2).sum()))
    sigma = max(sigma, spread)
    if sigma > _WORST_STRENGTH:
        return _Judged(False, f"too few long lines away from the middle: open by {sigma:.2f} of the corner's radius")
    if abs(strength) < _SEEN_SIGMAS * sigma:
        return _Judged(
            False, f"none is visible: the corner moves by less than {200 * sigma:.1f} % of its radius", is_none=True,
            widened=spread,
        )  # fmt: skip
    t = _t_of_gains(problem, trials)
    # few lines long enough to show a bend cannot make many sigmas of it, but agree whichever of them are left out
    is_steady = len(each) == _PLUMB_FOLDS and abs(strength) > _STEADY_SIGMAS * sigma and t > _STEADY_T
    if t < _SEEN_SIGMAS and not is_steady:
        # it is left zero, which may be wrong by all that was found
        text = f"held-out lines do not prefer it to none ({t:.1f} sigmas)"
        return _Judged(False, text, widened=max(spread, abs(strength)))
    reason = f"held-out lines prefer it to none ({t:.1f} sigmas)"
    if is_steady:
        reason += f", and it is the same to {sigma:.3f} whichever {_PLUMB_FOLDS}th of the lines is left out"
    return _Judged(True, reason, widened=spread)


def _held_to(focal: _Judged, moved: float) -> _Judged:
    """The verdict on a focal length that moved by a share when what lines do not tell was held at what is assumed: a
    distortion that is there, and held at zero, takes it along."""
    if not focal.is_told:
        return focal
    if moved > _WORST_FOCAL:
        text = f"a distortion or a principal point that the lines do not tell changes it by {100 * moved:.0f} %"
        return _Judged(False, text)
    return replace(focal, widened=max(focal.widened, moved))


def _t_of_gains(problem: Problem, trials: Sequence[_Trial]) -> float:
    """By how many of its sigmas the distortion that the others found is better than none for held-out lines that it
    bends by enough to tell."""
    gained = []
    for trial in trials:
        is_bent = trial.predicted_px > _TELLING_PX * problem.pixel_scale
        each = np.bincount(trial.witness[is_bent], trial.gained[is_bent])
        gained.append(each[each != 0.0])
    # no single thing in the picture convinces alone
    each = np.clip(np.concatenate(gained), -_MOST_OF_WITNESS, _MOST_OF_WITNESS)
    return float(each.sum() / math.sqrt(max((each**2).sum(), 1e-12)))


# ------------------------------------------------------------------------------------------------------ the camera


def _final(problem: Problem, solution: Solution, strength: _Judged) -> tuple[Solution, _Judged]:
    """Solved once more with all that is not told held at what is assumed, and the verdict on the principal point. The
    covariance stays that with everything free and the prior of the principal point."""
    has_worlds = solution.photos[0].world is not None
    sigmas = np.sqrt(np.diag(solution.covariance))
    counts = [np.bincount(photo.member[photo.member >= 0], minlength=3)[:3] for photo in solution.photos]
    has_third = not has_worlds or any(count.min() >= _LEAST_OF_DIRECTION for count in counts)
    is_told = (sigmas[CENTER_X:] < 0.5 * problem.prior_sigma[CENTER_X:]) & has_third
    free = np.array([strength.is_told, has_worlds, *is_told])
    camera = np.where(free, solution.camera, [0.0, solution.camera[LOG_FOCAL], 0.0, 0.0])
    solved = solve(replace(problem, is_free=free), camera, solution.photos)
    full = replace(problem, is_free=np.array([True, has_worlds, True, True]))
    covariance = covariance_of(full, solved.camera, solved.photos)
    in_pixels = np.sqrt(np.diag(covariance))[CENTER_X:] * problem.radius_px
    told = free[CENTER_X:]
    axes = " and ".join(name for name, is_told in zip(("cx", "cy"), told, strict=True) if is_told)
    if told.all():
        reason = f"told to {in_pixels[0]:.1f} and {in_pixels[1]:.1f} px, better than what is common among cameras"
    else:
        assumed = CENTER_SHARE * max(problem.width, problem.height)
        missing = "three vanishing points at finite distance" if has_worlds else "a strong distortion"
        reason = (
            f"only {axes} is told; " if axes else ""
        ) + f"it takes {missing} to tell it: the middle is taken instead, with a sigma of {assumed:.0f} px"
    return Solution(solved.camera, solved.photos, covariance), _Judged(bool(told.all()), reason)


def _calibration(
    problem: Problem, solution: Solution, judged: tuple[_Judged, _Judged, _Judged], names: Sequence[str]
) -> CameraCalibration:
    """SIMPLE_DIVISION with the covariance of its parameters f, cx, cy, k."""
    strength, focal, center_told = judged
    radius = problem.radius_px
    covariance = solution.covariance.copy()
    if focal.is_told:
        share = math.exp(solution.camera[LOG_FOCAL])
    else:
        share = _DEFAULT_FOCAL * max(problem.width, problem.height) / radius
        covariance[LOG_FOCAL], covariance[:, LOG_FOCAL] = 0.0, 0.0
        covariance[LOG_FOCAL, LOG_FOCAL] = _DEFAULT_LOG_SIGMA**2
    if focal.is_told and not center_told.is_told:
        focal = replace(focal, widened=max(focal.widened, _UNCHECKED_FOCAL))
    for unknown, verdict in ((STRENGTH, strength), (LOG_FOCAL, focal)):
        sigma = math.sqrt(max(covariance[unknown, unknown], 1e-24))
        factor = max(verdict.widened / sigma, 1.0)
        covariance[unknown] *= factor
        covariance[:, unknown] *= factor
    focal_px, k = share * radius, float(solution.camera[STRENGTH]) * share**2
    center = problem.lens(solution.camera).center
    jacobian = np.zeros((4, NUM_CAMERA))
    jacobian[0, LOG_FOCAL], jacobian[3, LOG_FOCAL], jacobian[3, STRENGTH] = focal_px, 2.0 * k, share**2
    jacobian[1, CENTER_X] = jacobian[2, CENTER_X + 1] = radius
    sigma_px = math.sqrt(covariance[LOG_FOCAL, LOG_FOCAL]) * focal_px
    camera = Camera(
        CameraModel.SIMPLE_DIVISION,
        problem.width,
        problem.height,
        np.array([focal_px, *center, k]),
        sigma_px,
        "lines" if focal.is_told else "default",
    )
    views = [_view(problem, solution, name, photo) for name, photo in zip(names, solution.photos, strict=True)]
    num = sum(int(view.is_used.sum()) for view in views)
    # a line takes two numbers of its points, one where its vanishing point is known
    spent = sum(int((~(photo.member >= 0)).sum()) * 2 + int((photo.member >= 0).sum()) for photo in solution.photos)
    square = sum(float((view.residuals[view.is_used] ** 2).sum()) for view in views)
    freedom = max(num - spent - NUM_CAMERA - 3 * len(views), 1)
    return CameraCalibration(
        camera, jacobian @ covariance @ jacobian.T, _method(solution, focal, len(names)), math.sqrt(square / freedom),
        freedom, tuple(views), warnings=tuple(_warnings(strength, focal, center_told)),
    )  # fmt: skip


def _method(solution: Solution, focal: _Judged, num: int) -> str:
    lines = sum(len(photo.arcs) for photo in solution.photos)
    kind = "vanishing points and straightness" if focal.is_told else "straightness"
    return f"{kind} of {lines} lines in {num} photograph{'s' * (num > 1)}"


def _warnings(strength: _Judged, focal: _Judged, center: _Judged) -> list[str]:
    warnings = []
    if focal.is_told and not center.is_told:
        warnings.append(
            "the focal length rests on two directions that are taken to be at right angles, and on a principal point "
            "in the middle: no third direction recedes that would show otherwise"
        )
    if not focal.is_told:
        warnings.append(f"the focal length is a default, not measured: {focal.reason}")
    if not (strength.is_told or strength.is_none):
        warnings.append(f"the distortion is not told, and left zero: {strength.reason}")
    return warnings


def _view(problem: Problem, solution: Solution, name: str, photo: Lines) -> ViewFit:
    lens = problem.lens(solution.camera)
    points = photo.arcs.points
    is_straight = straightness_px(lens, photo.arcs) < STRAIGHT_SIGMAS * SIGMA_PX * problem.pixel_scale
    residuals = (points - on_lines(lens, points)).reshape(-1, 2)
    return ViewFit(name, None, points.reshape(-1, 2), residuals, np.repeat(is_straight, points.shape[1]))


def _parameters(
    problem: Problem, solution: Solution, calibration: CameraCalibration, judged: tuple[_Judged, _Judged, _Judged]
) -> list[LineParameter]:
    strength, focal, center = judged
    f = calibration.camera.params[0]
    sigma_f, sigma_x, sigma_y, _ = calibration.sigmas
    # the sigma of lambda, without that of the focal length which is in that of k
    sigma = math.sqrt(solution.covariance[STRENGTH, STRENGTH])
    corner = float(solution.camera[STRENGTH])
    middle = problem.lens(solution.camera).center - np.array([problem.width, problem.height]) / 2.0
    verdict: Verdict = "measured" if strength.is_told else "left alone" if strength.is_none else "unknown"
    return [
        LineParameter(
            name="distortion lambda R^2", verdict=verdict, value=corner, sigma=max(sigma, strength.widened),
            reason=strength.reason,
        ),
        LineParameter(
            name="focal length px", verdict="measured" if focal.is_told else "unknown", value=float(f),
            sigma=float(sigma_f), reason=focal.reason,
        ),
        LineParameter(
            name="principal point px from the middle", verdict="measured" if center.is_told else "left alone",
            value=float(np.hypot(*middle)), sigma=float(np.hypot(sigma_x, sigma_y)), reason=center.reason,
        ),
    ]  # fmt: skip


def _photographs(
    problem: Problem, solution: Solution, names: Sequence[str], arcs: Sequence[Arcs], used: Sequence[int]
) -> list[LinePhotograph]:
    lens = problem.lens(solution.camera)
    result = []
    for k, (name, one) in enumerate(zip(names, arcs, strict=True)):
        if k not in used:
            problem_found = f"{len(one)} edges that may be straight, {_LEAST_ARCS} are needed"
            result.append(LinePhotograph(name=name, num_arcs=len(one), num_straight=0, problem=problem_found))
            continue
        photo = solution.photos[used.index(k)]
        straight = straightness_px(lens, one) < STRAIGHT_SIGMAS * SIGMA_PX * problem.pixel_scale
        result.append(
            LinePhotograph(
                name=name, num_arcs=len(one), num_straight=int(straight.sum()),
                directions=[] if photo.world is None else _directions(problem, solution.camera, photo, photo.world),
            )
        )  # fmt: skip
    return result


def _directions(problem: Problem, camera: Array, photo: Lines, world: World) -> list[LineDirection]:
    result = []
    center, focal = problem.lens(camera).center, float(np.exp(camera[LOG_FOCAL])) * problem.radius_px
    for k, direction in enumerate(world.directions):
        point = center + focal * direction[:2] / direction[2] if abs(direction[2]) > 1e-9 else np.full(2, np.inf)
        is_near = np.abs(point).max() < 1e6
        result.append(
            LineDirection(
                direction=direction.tolist(), num_lines=int((photo.member == k).sum()),
                vanishing_point=point.tolist() if is_near else None,
            )
        )  # fmt: skip
    return result
