"""Which photographs of a rig were not taken together, although they are said to be.

Every photograph fits its board with a pose of its own. Photographs of one moment have to fit with one pose of the rig,
and what that costs, in squares of the noise, is chi-squared with six degrees of freedom for each but the first. A board
that moved between the exposures, a pair that was swapped, or a picture of another moment costs hundreds of times that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.rig_adjustment import RigFit, RigProblem, RigView, refine_shots, shot_costs
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Cut = frozenset[tuple[int, int]]
"""Cameras and shots: photographs that were not taken with the others of their shot."""

# Of noise one shot in a million costs more than 6.9 for each degree of freedom (chi-squared, six of them); the median
# is 0.89, of n shots give or take 0.72 / sqrt(n).
_NOISE, _MEDIAN, _MEDIAN_SIGMA = 6.9, 0.89, 0.72
# What is no noise (a board that trembles, a lens that is not quite its model) lies in few of the six directions: of two
# one shot in a million costs 20 times the median. It differs by factors from shot to shot: five sigmas of the logarithm
# are believed.
_STRIKING, _SPREAD = 20.0, 5.0
# A shot that the rig was not fitted to costs more than one that it was: another chance at so many times the limit.
_BACK = 3.0


@dataclass(frozen=True)
class Photographs:
    """What a rig was calibrated from.

    Attributes:
        views: V boards in photographs.
        alone: (V, 7) cam_from_board that each has by itself.
        weights: of each camera (N,) over the squared residuals of its points: 1 / noise^2, or 0.
        sizes: (width, height) of each camera.
        shapes: of each view (N, 3 B), how the shapes of the boards move its points; None for flat boards.
    """

    views: tuple[RigView, ...]
    alone: Array
    weights: tuple[Array, ...]
    sizes: tuple[tuple[int, int], ...]
    shapes: tuple[Array, ...] | None = None

    def problem(self, is_held: Sequence[bool]) -> RigProblem:
        """The views by camera. ``is_held``: (C,) cameras whose parameters stay."""
        return RigProblem(self.views, is_held, self.shapes)

    def with_shots(self, shots: Sequence[int]) -> Photographs:
        """The same with other moments of exposure (V,)."""
        views = tuple(replace(view, shot=int(shot)) for view, shot in zip(self.views, shots, strict=True))
        return replace(self, views=views)

    def with_cut(self, cut: Cut) -> Photographs:
        """Photographs that were cut have shots of their own: they say of the lens what they said, and nothing of the
        rig."""
        last = max(view.shot for view in self.views)
        own = {key: last + 1 + k for k, key in enumerate(sorted(cut))}
        return self.with_shots([own.get((view.camera, view.shot), view.shot) for view in self.views])


@dataclass(frozen=True)
class OddPhotograph:
    """A photograph that was not taken with the others of its shot, for a person to read: what it was taken for, and why
    that is not so."""

    camera: int
    shot: int
    reason: str


def placed(fit: RigFit, photos: Photographs) -> tuple[RigFit, Array]:
    """The rig with its best pose at every shot, all else held, and what each shot costs (T,): the squares of its
    residuals in those of the noise."""
    problem = photos.problem([True] * len(fit.cameras))
    obs = problem.weighted(photos.weights)
    # from the photograph whose own pose suits the others best
    poses, cost = np.tile(rigid3.IDENTITY, (problem.num_shots, 1)), np.full(problem.num_shots, np.inf)
    alone = rigid3.compose(
        rigid3.inverse(fit.cam_from_rig[problem.camera]),
        rigid3.compose(photos.alone[problem.order], rigid3.inverse(fit.world_from_board[problem.board])),
    )
    for camera in range(len(fit.cameras)):
        tried = poses.copy()
        mine = problem.of_camera[camera]
        tried[problem.shot[mine]] = alone[mine]
        new = shot_costs(replace(fit, rig_from_world=tried), problem, obs)
        is_better = np.isin(np.arange(problem.num_shots), problem.shot[mine]) & (new < cost)
        poses[is_better], cost[is_better] = tried[is_better], new[is_better]
    found, cost = refine_shots(replace(fit, rig_from_world=poses), problem, photos.weights)
    return found, 2.0 * cost


def misfits(fit: RigFit, photos: Photographs) -> Array:
    """(T,) what it costs the photographs of each shot to have been taken together, for each degree of freedom; 0 where
    there is only one."""
    together = placed(fit, photos)[1]
    keys = sorted({(view.shot, view.camera) for view in photos.views})
    place = {key: k for k, key in enumerate(keys)}
    apart = placed(fit, photos.with_shots([place[view.shot, view.camera] for view in photos.views]))[1]
    shot = np.array([key[0] for key in keys])
    num = np.bincount(shot, minlength=len(together))
    alone = np.bincount(shot, apart, minlength=len(together))
    freedom = 6.0 * np.maximum(num - 1, 1)
    return np.where(num > 1, (together - np.where(np.isfinite(alone), alone, 0.0)) / freedom, 0.0)


def striking(costs: Array) -> float:
    """What shots cost at most that nothing is wrong with, from the costs of all (T,); 0 for those of one photograph."""
    known = costs[costs > 0]
    median = float(np.median(known)) if len(known) else 0.0
    is_noise = median < _MEDIAN + 3.0 * _MEDIAN_SIGMA / np.sqrt(max(len(known), 1))
    return _NOISE if is_noise else _STRIKING * median


def limit_of(costs: Array) -> float:
    """The most that is believed: more than :func:`striking` where costs (T,) are no noise, and differ much."""
    least = striking(costs)
    if least == _NOISE:
        return least
    known = np.log(costs[costs > 0])
    middle = float(np.median(known))
    # the median distance from the median is 0.6745 sigmas
    spread = float(np.median(np.abs(known - middle))) / 0.6745
    return max(least, float(np.exp(min(middle + _SPREAD * spread, 700.0))))


def more_odd(fit: RigFit, photos: Photographs, cut: Cut, tolerance: float) -> Cut:
    """Photographs that do not belong to their shots, beside those that were cut: at most one more of each shot, which
    costs more than so many times what is believed.

    Of three and more it is the one without which the others agree best, of two the one of the later camera.
    """
    remaining = photos.with_cut(cut)
    costs = misfits(fit, remaining)
    return _odd_of(fit, photos, cut, np.flatnonzero(costs > tolerance * limit_of(costs)).tolist())


def worst_shot(fit: RigFit, photos: Photographs, cut: Cut) -> Cut:
    """The photograph that does not belong to its shot, if any does not: of the shot that costs most, where that is more
    than noise."""
    costs = misfits(fit, photos.with_cut(cut))
    worst = int(np.argmax(costs))
    return _odd_of(fit, photos, cut, [worst]) if costs[worst] > _NOISE else Cut()


def _odd_of(fit: RigFit, photos: Photographs, cut: Cut, shots: Sequence[int]) -> Cut:
    """One photograph of each of some shots: see :func:`more_odd`."""
    remaining, found = photos.with_cut(cut), set[tuple[int, int]]()
    cameras_of = {t: sorted({v.camera for v in remaining.views if v.shot == t}) for t in shots}
    many = {t for t in shots if len(cameras_of[t]) > 2}
    found |= {(cameras_of[t][-1], t) for t in shots if t not in many}
    without = {
        c: misfits(fit, photos.with_cut(cut | {(c, t) for t in many if c in cameras_of[t]}))
        for c in (sorted({c for t in many for c in cameras_of[t]}))
    }
    found |= {(min(cameras_of[t], key=lambda c: (float(without[c][t]), -c)), t) for t in many}
    return frozenset(found)


def readmitted(fit: RigFit, photos: Photographs, cut: Cut) -> Cut:
    """Of the photographs that were cut those that may belong to their shots: the rig was known worse when they were,
    and is known worse without them."""
    limit = _BACK * limit_of(misfits(fit, photos.with_cut(cut)))
    found: set[tuple[int, int]] = set()
    for camera in sorted({c for c, _ in cut}):
        mine = {key for key in cut if key[0] == camera}
        costs = misfits(fit, photos.with_cut(cut - mine))
        found |= {(c, t) for c, t in mine if costs[t] < limit}
    return frozenset(found)


def doubtful(fit: RigFit, photos: Photographs, cut: Cut) -> list[str]:
    """Shots that are used although their photographs agree much worse than those of the others."""
    linked = photos.with_cut(cut)
    costs = misfits(fit, linked)
    found = []
    for shot in np.flatnonzero(costs > striking(costs)).tolist():
        names = " and ".join(dict.fromkeys(view.view.name for view in linked.views if view.shot == shot))
        typical = costs[shot] / float(np.median(costs[costs > 0]))
        found.append(
            f"{names} agree worst, by {typical:.0f} times the typical squares: perhaps the board moved between them"
        )
    return found


def explain(fit: RigFit, photos: Photographs, cut: Cut, names: Sequence[str]) -> list[OddPhotograph]:
    """Why each photograph that was cut does not belong to its shot."""
    limit = limit_of(misfits(fit, photos.with_cut(cut)))
    found = []
    for camera, shot in sorted(cut, key=lambda key: (key[1], key[0])):
        own = [v for v in photos.views if (v.camera, v.shot) == (camera, shot)]
        others = [v for v in photos.views if v.shot == shot and v.camera != camera and (v.camera, shot) not in cut]
        name, beside = own[0].view.name, " and ".join(dict.fromkeys(v.view.name for v in others))
        reason = _swapped(fit, photos, (camera, shot), limit) or _of_another(fit, photos, cut, (camera, shot), limit)
        if reason is None:
            turn, shift = _motion(fit, photos, camera, shot)
            reason = (
                f"the board is {1000 * shift:.1f} mm and {turn:.2f} degrees from where {beside} has it: it moved "
                "between the exposures, or they were not made at one moment"
            )
        found.append(OddPhotograph(camera, shot, f"{name} ({names[camera]}) is not used with {beside}: {reason}"))
    return found


def _cost_of(fit: RigFit, photos: Photographs, chosen: Sequence[tuple[int, int]]) -> float:
    """What it costs views (position, camera that they are taken for) to be of one shot, for each degree of freedom."""
    views = [replace(photos.views[i], camera=c, shot=0) for i, c in chosen]
    used = {i: photos.weights[photos.views[i].camera] for i, _ in chosen}
    start = {i: sum(len(v.view.xy) for v in photos.views[:i] if v.camera == photos.views[i].camera) for i in used}
    weights = tuple(
        np.concatenate([np.zeros(0), *(used[i][start[i] : start[i] + len(photos.views[i].view.xy)]
                                       for i, c in chosen if c == camera)])
        for camera in range(len(fit.cameras))
    )  # fmt: skip
    alone = photos.alone[[i for i, _ in chosen]]
    shapes = None if photos.shapes is None else tuple(photos.shapes[i] for i, _ in chosen)
    return float(misfits(fit, Photographs(tuple(views), alone, weights, photos.sizes, shapes))[0])


def _positions(photos: Photographs, camera: int, shot: int) -> list[int]:
    return [i for i, view in enumerate(photos.views) if (view.camera, view.shot) == (camera, shot)]


def _swapped(fit: RigFit, photos: Photographs, key: tuple[int, int], limit: float) -> str | None:
    camera, shot = key
    for other in sorted({v.camera for v in photos.views if v.shot == shot} - {camera}):
        if photos.sizes[other] == photos.sizes[camera]:
            mine, others = _positions(photos, camera, shot), _positions(photos, other, shot)
            if _cost_of(fit, photos, [*((i, other) for i in mine), *((i, camera) for i in others)]) < limit:
                return f"the two are swapped, {photos.views[others[0]].view.name} is of its camera"
    return None


def _of_another(fit: RigFit, photos: Photographs, cut: Cut, key: tuple[int, int], limit: float) -> str | None:
    camera, shot = key
    mine = _positions(photos, camera, shot)
    for t in sorted({t for _, t in cut} - {shot}):
        for other in sorted({v.camera for v in photos.views if v.shot == t and (v.camera, t) not in cut}):
            others = _positions(photos, other, t)
            if other != camera and _cost_of(fit, photos, [(i, photos.views[i].camera) for i in mine + others]) < limit:
                return f"it is of the moment of {photos.views[others[0]].view.name}"
    return None


def _motion(fit: RigFit, photos: Photographs, camera: int, shot: int) -> tuple[float, float]:
    """By how much the board of a photograph stands elsewhere than the others of its shot have it: degrees, and the unit
    of the board."""
    apart, _ = placed(fit, photos.with_cut(frozenset({(camera, shot)})))
    first = _positions(photos, camera, shot)[0]
    mine, view = photos.alone[first], photos.views[first]
    rig_from_board = rigid3.compose(apart.rig_from_world[shot], fit.world_from_board[view.board])
    theirs = rigid3.compose(fit.cam_from_rig[camera], rig_from_board)
    middle = view.view.xyz.mean(0)
    turn = float(rigid3.rotation_angle_deg(rigid3.rotation_matrix(rigid3.compose(mine, rigid3.inverse(theirs)))))
    return turn, float(np.linalg.norm(rigid3.apply(mine, middle) - rigid3.apply(theirs, middle)))
