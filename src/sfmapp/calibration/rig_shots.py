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

# One shot in a million costs more than 6.9 for each degree of freedom (chi-squared, six of them), whose median is 0.89.
# Lens models are never exact: where the typical shot costs more than noise does, so may every other.
_ODD, _MEDIAN = 6.9, 0.89


@dataclass(frozen=True)
class Photographs:
    """What a rig was calibrated from.

    Attributes:
        views: V boards in photographs.
        alone: (V, 7) cam_from_board that each has by itself.
        weights: of each camera (N,) over the squared residuals of its points: 1 / noise^2, or 0.
        sizes: (width, height) of each camera.
    """

    views: tuple[RigView, ...]
    alone: Array
    weights: tuple[Array, ...]
    sizes: tuple[tuple[int, int], ...]

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
    problem = RigProblem(photos.views, [True] * len(fit.cameras))
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


def limit_of(costs: Array) -> float:
    """The most that is believed: of noise, or of what the typical shot (T,) costs; shots of one photograph have 0."""
    known = costs[costs > 0]
    typical = float(np.median(known)) if len(known) else 0.0
    return _ODD * max(1.0, typical / _MEDIAN)


def more_odd(fit: RigFit, photos: Photographs, cut: Cut) -> Cut:
    """Photographs that do not belong to their shots, beside those that were cut: at most one more of each shot.

    Of three and more it is the one without which the others agree best, of two the one of the later camera.
    """
    remaining = photos.with_cut(cut)
    costs = misfits(fit, remaining)
    shots = np.flatnonzero(costs > limit_of(costs)).tolist()
    found: set[tuple[int, int]] = set()
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
    """Of the photographs that were cut those that do belong to their shots: the rig was known worse when they were."""
    limit = limit_of(misfits(fit, photos.with_cut(cut)))
    found: set[tuple[int, int]] = set()
    for camera in sorted({c for c, _ in cut}):
        mine = {key for key in cut if key[0] == camera}
        costs = misfits(fit, photos.with_cut(cut - mine))
        found |= {(c, t) for c, t in mine if costs[t] < limit}
    return frozenset(found)


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
    return float(misfits(fit, Photographs(tuple(views), alone, weights, photos.sizes))[0])


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
