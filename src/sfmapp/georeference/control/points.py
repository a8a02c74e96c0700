"""Ground control: where surveyed points lie in the frame, how a model comes to them, and what they say if left out.

Control is kept honest by leaving each point out in turn. With the covariance C of its adjusted place by everything, its
survey included, and S of the survey, the place without the survey has the covariance ``C + C (S - C)^-1 C``, and lies
``S (S - C)^-1 (adjusted - surveyed)`` from the survey: the deletion residual of a block of observations (Cook and
Weisberg, "Residuals and Influence in Regression", 1982, section 2.2), exact where the adjustment is linear.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.formats.control_points import LOCAL, ControlPoints
from sfmapp.geometry import rigid3, similarity
from sfmapp.geometry.geodesy import LocalFrame
from sfmapp.georeference.consensus import likeliest_set
from sfmapp.georeference.coordinate_systems import HeightReference, coordinate_system

Array = NDArray[np.float64]

# Points thinner than this many of their residuals are a line: three sigma.
_SPREAD_OVER_RESIDUAL = 3.0
# A direction in which the survey has but this share of its variance of its own is not held by anything else.
_HELD_BY_ITSELF = 1e-6
# Chance that any good point, or known length, is left aside.
FALSE_ALARM = 1e-3
# One is the wrong one and not another if the squares fall by this much more without it: 3 sigma.
CLEARLY = 9.0


@dataclass(frozen=True)
class Survey:
    """Control points (P) in a frame.

    Attributes:
        frame: on Earth; None where coordinates are local.
        place: (P, 3) metres, east, north, up; of local coordinates as they are.
        covariance: (P, 3, 3) of the survey.
        heights: what heights in the frame are above.
    """

    frame: LocalFrame | None
    place: Array
    covariance: Array
    heights: HeightReference


def survey_in_frame(control: ControlPoints, frame: LocalFrame | None = None) -> Survey:
    """Control points in a frame of the world.

    Args:
        frame: None: about the middle of the points.

    Raises:
        InputError: there is no such coordinate system, it is in feet, or the coordinates are none of it.
        MissingPackageError: pyproj is needed and not installed.
    """
    if control.crs == LOCAL:
        covariance = np.einsum("pi,ij->pij", control.sigma_m**2, np.eye(3))
        return Survey(None, control.xyz.copy(), covariance, "unknown")
    place = f"{control.path}, line {control.crs_line}"
    system = coordinate_system(control.crs, place)
    if not system.is_geographic:
        system.check_metres(place)
    # a point is in the file with its first mark, or before
    lines = [control.obs_line[control.observations_of(p)].min(initial=10**9) for p in range(control.num_points)]
    geodetic = system.geodetic(control.xyz, [f"{control.path}, line {line}" for line in lines])
    if frame is None:
        frame = LocalFrame(*map(float, geodetic.mean(0)))
    # sigmas are along the axes of the system, which meridian convergence turns against east and north
    steps = np.eye(3) * ([1e-5, 1e-5, 1.0] if system.is_geographic else 1.0)
    own = frame.enu_from_geodetic(geodetic)
    axes = np.stack([frame.enu_from_geodetic(system.geodetic(control.xyz + step)) - own for step in steps], -1)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    covariance = np.einsum("pij,pj,pkj->pik", axes, control.sigma_m**2, axes)
    # heights above a geoid that is known have been brought to the ellipsoid
    return Survey(frame, own, covariance, "unknown" if system.heights == "unknown" else "ellipsoidal")


@dataclass(frozen=True)
class Alignment:
    """A similarity that carries points to their survey, or why there is none.

    Attributes:
        world_from_model: (8,); None where there is none.
        is_inlier: (P,) bool, those that it was fitted to.
        problem: empty where there is one.
    """

    world_from_model: Array | None
    is_inlier: NDArray[np.bool_]
    problem: str


def align_to_survey(place: Array, surveyed: Array) -> Alignment:
    """Robust similarity from places in a model (P, 3), NaN where there is none, to those of the survey (P, 3).

    It begins with the likeliest set of points (:func:`~sfmapp.georeference.consensus.likeliest_set`); then all within
    2.5 robust standard deviations count. With three points nothing can be told apart.
    """
    known = np.flatnonzero(np.isfinite(place[:, 0]))
    none = np.zeros(len(place), bool)
    if len(known) < 3:
        return Alignment(
            None,
            none,
            f"{len(known)} control points have a place in the model: three that are not on a line are needed",
        )
    model, world = place[known], surveyed[known]
    found = likeliest_set(model, world, np.ones_like(world), is_stated=False)
    if found is None:
        return Alignment(None, none, "the control points do not tell where the model lies")
    lengths = np.linalg.norm(found.similarity.apply(model) - world, axis=1)
    # a length of three dimensions: the median is 1.538 sigma per axis, and 3.30 sigma of it stand for 2.5 of one axis
    sigma = (1 + 5 / max(len(known) - 3, 1)) * float(np.median(lengths)) / 1.538
    inlier = lengths <= max(3.30 * sigma, 1e-9 * float(np.abs(world).max()))
    try:
        kept = similarity.umeyama(model[inlier], world[inlier])
    except ValueError:
        return Alignment(None, none, "all control points lie on a line: the turn about it is open")
    off = similarity.apply(kept, model[inlier]) - world[inlier]
    residual = np.sqrt((off**2).sum() / max(3 * inlier.sum() - 7, 1))
    spread = np.linalg.svd(world[inlier] - world[inlier].mean(0), compute_uv=False) / np.sqrt(inlier.sum())
    if spread[1] < _SPREAD_OVER_RESIDUAL * residual:
        return Alignment(None, none, "the control points lie as good as on a line: the turn about it is open")
    none[known[inlier]] = True
    return Alignment(kept, none, "")


def similarity_covariance(place: Array, covariance: Array) -> Array | None:
    """(7, 7) of the similarity that points (P, 3) with covariances (P, 3, 3) hold: the turn about their middle (radians
    about east, north, up), the logarithm of the scale, and the shift of the middle. None where they hold none."""
    arm = place - place.mean(0)
    slope = np.concatenate([-rigid3.skew(arm), arm[:, :, None], np.broadcast_to(np.eye(3), (len(arm), 3, 3))], 2)
    information = np.einsum("pia,pij,pjb->ab", slope, np.linalg.inv(covariance), slope)
    root = np.sqrt(np.maximum(np.diag(information), 1e-300))
    if np.linalg.cond(information / np.outer(root, root)) > _HELD_BY_ITSELF**-2:
        return None
    inverse: Array = np.linalg.inv(information)
    return inverse


@dataclass(frozen=True)
class LeftOut:
    """A control point as the adjustment puts it that does not know its survey.

    Attributes:
        residual: (3,) that place minus the survey, covariance: (3, 3) of this difference.
    """

    residual: Array
    covariance: Array

    @property
    def square(self) -> float:
        """Of three degrees of freedom: by how much twice the cost falls if the survey of the point is left out."""
        return float(self.residual @ np.linalg.solve(self.covariance, self.residual))

    @property
    def normalized_horizontal(self) -> float:
        """Length over what is expected, of two degrees of freedom: 95 % are below 2.448."""
        return float(np.sqrt(self.residual[:2] @ np.linalg.solve(self.covariance[:2, :2], self.residual[:2])))

    @property
    def normalized_vertical(self) -> float:
        """Of one degree of freedom: 95 % are below 1.960."""
        return float(abs(self.residual[2]) / np.sqrt(self.covariance[2, 2]))


def leave_out(adjusted: Array, covariance: Array, surveyed: Array, survey_covariance: Array) -> LeftOut | None:
    """A point that took part, as if it had not; None where the others do not hold the model.

    Args:
        adjusted: (3,) its place by the adjustment, covariance: (3, 3) of that, its survey included.
        surveyed: (3,), survey_covariance: (3, 3).
    """
    rest = survey_covariance - covariance
    root = np.linalg.inv(np.linalg.cholesky(survey_covariance))
    if not np.linalg.eigvalsh(root @ rest @ root.T).min() > _HELD_BY_ITSELF:
        return None
    residual = survey_covariance @ np.linalg.solve(rest, adjusted - surveyed)
    of_place = covariance + covariance @ np.linalg.solve(rest, covariance)
    return LeftOut(residual, of_place + survey_covariance)


def left_out_already(adjusted: Array, covariance: Array, surveyed: Array, survey_covariance: Array) -> LeftOut:
    """A point whose survey took no part; arguments as of :func:`leave_out`."""
    return LeftOut(adjusted - surveyed, covariance + survey_covariance)
