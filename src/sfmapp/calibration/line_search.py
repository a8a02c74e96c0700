"""From the arcs of photographs to distortion, focal length and directions, without a start: everything is tried.

The strength of the distortion is one unknown that all lines vote on, so its whole range is looked at. For each strength
that they favour, and each focal length, the best frame of each photograph is sought among many; what stands out is
refined, and only then chosen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.line_edges import Arcs
from sfmapp.calibration.line_planes import fit_planes
from sfmapp.calibration.line_refinement import (
    LOG_FOCAL,
    NUM_CAMERA,
    STRENGTH,
    Lines,
    Problem,
    Solution,
    World,
    solve,
    straightness_px,
    vanishing_points,
)
from sfmapp.calibration.vanishing import (
    FOCAL_SHARES,
    SIGMA_PX,
    PlaneLines,
    find_axes,
    focals_of_pairs,
    gains,
    misses,
    plane_lines,
    search_frames,
)

Array = NDArray[np.float64]

# Strengths lambda R^2 that are tried: the corner of the photograph goes out to ten times its radius, or comes in to
# 0.7.
STRENGTHS = np.concatenate([np.arange(-0.9, -0.3, 0.02), np.arange(-0.3, 0.4001, 0.01)])
# A line is straight below this many sigmas, and belongs to a direction below that many.
STRAIGHT_SIGMAS, MEMBER_SIGMAS = 1.5, 3.0
# The bend of a line that counts half, in sigmas: half of one, for the mean of edge points at a knot is better than one.
_BEND_SCALE = 0.5
# Peaks of the votes below this share of the highest are no candidates, and most that are.
_RIVAL_VOTES, _MOST_STRENGTHS = 0.8, 3
# Principal points of cameras lie about the middle by this share of the longer side (one sigma): what is assumed of it
# where lines do not tell, and what their telling has to beat.
CENTER_SHARE = 0.02
# Focal lengths nearer than this are one hypothesis, and so many hypotheses are refined.
_SAME_FOCAL, _MOST_FOCALS = 1.12, 3
# What a further direction has to gain: the price of an angle that was chosen among some hundred (log of that), and of
# its not being there at all.
_PRICE_OF_DIRECTION = 8.0
_LEAST_OF_DIRECTION = 6
_MOST_EXTRAS = 3
# Nearer than this to an axis it is the axis, of a frame that is not quite right.
_NEAREST_EXTRA = math.radians(10.0)
_ROUNDS = 4
# One whose gain is this much below that of the best after the first round, or this share of it, is dropped as well:
# what further rounds change is less.
_HOPELESS, _HOPELESS_SHARE = 40.0, 0.3
# Arcs of all photographs together that hypotheses are refined with, and of one at least.
_MOST_ARCS, _LEAST_ARCS = 300, 60
# A start whose focal length has come this near to that of a better one after the first round is dropped.
_MERGED = 0.01


@dataclass(frozen=True)
class Found:
    """A solution and the evidence for it.

    Attributes:
        solution: with its worlds.
        gain: log-likelihood of the lines over that of a world without directions, the price of extra directions paid.
    """

    solution: Solution
    gain: float

    @property
    def focal(self) -> float:
        """In units of R."""
        return float(np.exp(self.solution.camera[LOG_FOCAL]))


def plain_problem(width: int, height: int, pixel_scale: float) -> Problem:
    """Photographs of a camera of which nothing is known but that its principal point is near the middle."""
    center = CENTER_SHARE * max(width, height) / (0.5 * math.hypot(width, height))
    sigma = np.array([np.inf, np.inf, center, center])
    return Problem(width, height, np.ones(NUM_CAMERA, bool), sigma, np.zeros(NUM_CAMERA), pixel_scale)


def strength_votes(problem: Problem, arcs: Arcs) -> Array:
    """For each of :data:`STRENGTHS` how many lines are straight, each counting less the more it bends."""
    limit = _BEND_SCALE * SIGMA_PX * problem.pixel_scale
    votes = np.empty(len(STRENGTHS))
    for k, strength in enumerate(STRENGTHS):
        camera = np.array([strength, 0.0, 0.0, 0.0])
        bend = straightness_px(problem.lens(camera), arcs)
        votes[k] = (1.0 / (1.0 + (bend / limit) ** 2)).sum()
    return votes


def likely_strengths(votes: Array) -> Array:
    """The strengths that lines vote for, the best first: the highest peaks of the votes."""
    padded = np.concatenate([[-np.inf], votes, [-np.inf]])
    peaks = np.flatnonzero((votes >= padded[:-2]) & (votes > padded[2:]) & (votes > _RIVAL_VOTES * votes.max()))
    return STRENGTHS[peaks[np.argsort(-votes[peaks], kind="stable")][:_MOST_STRENGTHS]]


def solve_plumb(problem: Problem, arcs: Sequence[Arcs], strengths: Array) -> Solution:
    """Distortion and its centre from straight lines alone: the best of what several starts come to."""
    free = np.array([True, False, True, True]) & problem.is_free
    # what else than its bend a line may be off by does not matter here
    sharp = replace(problem, is_free=free, pixel_scale=problem.pixel_scale / 3.0)
    photos = [Lines(one, None, np.full(len(one), -1)) for one in arcs]
    solved = [solve(sharp, np.array([strength, 0.0, 0.0, 0.0]), photos) for strength in strengths]
    cost = [sum(float(losses(problem, one.camera, arc, None).sum()) for arc in arcs) for one in solved]
    return solved[int(np.argmin(cost))]


def find_worlds(problem: Problem, arcs: Sequence[Arcs], strengths: Array, seed: int) -> list[Found]:
    """Solutions for focal lengths that stand out, the best first.

    Args:
        arcs: of each photograph.
        strengths: where distortion may start.
        seed: of the search.
    """
    # arcs are in the order of their length: the longest tell hypotheses apart
    most = max(_MOST_ARCS // len(arcs), _LEAST_ARCS)
    arcs = [one.take(np.arange(min(len(one), most))) for one in arcs]
    firsts: list[Found] = []
    for strength in strengths:
        camera = np.zeros(NUM_CAMERA)
        camera[STRENGTH] = strength
        for focal, rotations in _likely_frames(problem, arcs, camera, seed):
            camera[LOG_FOCAL] = math.log(focal)
            first = settle(problem, arcs, camera, [World(rotation) for rotation in rotations], rounds=1)
            if all(abs(math.log(first.focal / other.focal)) > _MERGED for other in firsts):
                firsts.append(first)
    top = max((first.gain for first in firsts), default=0.0)
    found = [
        settle(problem, arcs, first.solution.camera, worlds_of(first.solution))
        for first in firsts
        if first.gain > top - max(_HOPELESS, _HOPELESS_SHARE * top)
    ]
    return sorted(found, key=lambda one: -one.gain)


def worlds_of(solution: Solution) -> list[World]:
    """The worlds of all photographs of a solution that has them."""
    return [photo.world for photo in solution.photos if photo.world is not None]


def lines_of(problem: Problem, camera: Array, arcs: Arcs) -> PlaneLines:
    """The planes of arcs, for a lens."""
    normals, covariances, _ = fit_planes(problem.lens(camera), arcs.points)
    return plane_lines(normals, covariances, arcs.length_px, problem.pixel_scale)


def _likely_frames(problem: Problem, arcs: Sequence[Arcs], camera: Array, seed: int) -> list[tuple[float, list[Array]]]:
    """Focal lengths in units of R that stand out, each with a rotation for each photograph."""
    longer = max(problem.width, problem.height) / problem.radius_px
    limit = STRAIGHT_SIGMAS * SIGMA_PX * problem.pixel_scale
    lens = problem.lens(camera)
    searched: list[tuple[PlaneLines | None, Array]] = []
    for k, one in enumerate(arcs):
        straight = one.take(straightness_px(lens, one) < limit)
        if len(straight) < _LEAST_OF_DIRECTION:
            searched.append((None, np.zeros((0, 3))))
            continue
        lines = lines_of(problem, camera, straight)
        searched.append((lines, find_axes(lines, np.random.default_rng([seed, k]))))
    own = [focals_of_pairs(axes[:8], FOCAL_SHARES[0] * longer, FOCAL_SHARES[-1] * longer) for _, axes in searched]
    focals = np.unique(np.concatenate([FOCAL_SHARES * longer, *own]))[:400]
    total, rotations = np.zeros(len(focals)), []
    for k, (searchable, axes) in enumerate(searched):
        if searchable is None or len(axes) == 0:
            rotations.append(np.broadcast_to(np.eye(3), (len(focals), 3, 3)))
            continue
        gain, found = search_frames(searchable, axes, focals, np.random.default_rng([seed, k, 1]))
        total += gain
        rotations.append(found)
    chosen: list[int] = []
    for i in np.argsort(-total, kind="stable"):
        if all(abs(math.log(focals[i] / focals[c])) > math.log(_SAME_FOCAL) for c in chosen):
            chosen.append(int(i))
        if len(chosen) == _MOST_FOCALS:
            break
    return [(float(focals[i]), [found[i] for found in rotations]) for i in chosen]


def settle(
    problem: Problem, arcs: Sequence[Arcs], camera: Array, worlds: Sequence[World], rounds: int = _ROUNDS
) -> Found:
    """Assign lines to directions and solve, in turn, until it rests."""
    worlds = list(worlds)
    solution = None
    for turn in range(rounds):
        photos = [assigned(problem, camera, one, world) for one, world in zip(arcs, worlds, strict=True)]
        solution = solve(problem, camera, photos)
        camera = solution.camera
        worlds = worlds_of(solution)
        if turn == 1:
            worlds = [_with_extras(problem, camera, one, world) for one, world in zip(arcs, worlds, strict=True)]
    assert solution is not None
    return Found(solution, gain_of(problem, solution))


def assigned(problem: Problem, camera: Array, arcs: Arcs, world: World) -> Lines:
    """Each line with the direction whose vanishing point it misses least, if it does not miss it clearly."""
    lines = lines_of(problem, camera, arcs)
    miss = misses(lines, vanishing_points(world.directions, float(np.exp(camera[LOG_FOCAL]))))
    member = miss.argmin(1).astype(np.int64)
    is_straight = straightness_px(problem.lens(camera), arcs) < 2.0 * STRAIGHT_SIGMAS * SIGMA_PX * problem.pixel_scale
    member[(miss.min(1) > MEMBER_SIGMAS) | ~is_straight] = -1
    return Lines(arcs, world, member)


def sharpened(problem: Problem, solution: Solution) -> Problem:
    """The problem with the errors that lines of directions show to have, where these are less than was expected: things
    that are nearly along a direction, as a parked car along a street, then stand apart from it."""
    bends = [
        straightness_px(problem.lens(solution.camera), photo.arcs)[photo.member >= 0] / problem.pixel_scale
        for photo in solution.photos
    ]
    typical = float(np.median(np.concatenate(bends))) if sum(map(len, bends)) else SIGMA_PX
    return replace(problem, pixel_scale=problem.pixel_scale * float(np.clip(2.0 * typical / SIGMA_PX, 1.0 / 3.0, 1.0)))


def losses(problem: Problem, camera: Array, arcs: Arcs, world: World | None) -> Array:
    """(N,) what each line has against a camera, and a world in its photograph: its bend, and that it meets nothing."""
    bend = straightness_px(problem.lens(camera), arcs) / (_BEND_SCALE * SIGMA_PX * problem.pixel_scale)
    loss: Array = 0.5 * bend**2 / (1.0 + bend**2 / 9.0)
    if world is None:
        return loss
    points = vanishing_points(world.directions, float(np.exp(camera[LOG_FOCAL])))
    return loss - gains(lines_of(problem, camera, arcs), points, len(points))[0]


def gain_of(problem: Problem, solution: Solution) -> float:
    """Log-likelihood of the lines of all photographs over that of worlds without directions."""
    total = 0.0
    for photo in solution.photos:
        assert photo.world is not None
        lines = lines_of(problem, solution.camera, photo.arcs)
        directions = photo.world.directions
        points = vanishing_points(directions, float(np.exp(solution.camera[LOG_FOCAL])))
        total += float(gains(lines, points, len(directions))[0].sum())
        total -= _PRICE_OF_DIRECTION * len(photo.world.extra_angles)
    return total


def _with_extras(problem: Problem, camera: Array, arcs: Arcs, world: World) -> World:
    """The world with further directions at right angles to one of its axes, where lines show some."""
    lines = lines_of(problem, camera, arcs)
    focal = float(np.exp(camera[LOG_FOCAL]))
    taken = misses(lines, vanishing_points(world.rotation.T, focal)).min(1) < MEMBER_SIGMAS
    left = np.flatnonzero(~taken)
    if len(left) < _LEAST_OF_DIRECTION:
        return world
    best, most = world, 0.0
    for axis in range(3):
        normals = lines.normals[left] * [1.0, 1.0, 1.0 / focal]
        along = np.cross(world.rotation[:, axis], normals)
        first, second = world.rotation[:, (axis + 1) % 3], world.rotation[:, (axis + 2) % 3]
        angles = np.arctan2(along @ second, along @ first) % math.pi
        points = vanishing_points(np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second, focal)
        miss = misses(lines, points)[left]
        miss[:, np.abs((angles + math.pi / 4) % (math.pi / 2) - math.pi / 4) < _NEAREST_EXTRA] = np.inf
        each = np.log(0.5 + 0.5 * lines.peak[left, None] * np.exp(-0.5 * np.minimum(miss**2, 80.0)))
        chosen: list[float] = []
        gained, open_ = 0.0, np.ones(len(left), bool)
        for _ in range(_MOST_EXTRAS):
            gain = each[open_].sum(0)
            top = int(gain.argmax())
            members = open_ & (miss[:, top] < MEMBER_SIGMAS)
            if gain[top] < _PRICE_OF_DIRECTION + _LEAST_OF_DIRECTION or members.sum() < _LEAST_OF_DIRECTION:
                break
            chosen.append(float(angles[top]))
            gained += float(gain[top]) - _PRICE_OF_DIRECTION
            open_ &= ~members
        if gained > most:
            best, most = World(world.rotation, axis, tuple(chosen)), gained
    return best
