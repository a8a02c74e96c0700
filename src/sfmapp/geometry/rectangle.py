"""What four corners in a picture tell of a rectangle: its shape, and how sure that is.

With K known, ``K^-1 H = (a b c)`` of the unit square has a and b along the sides: their lengths are as width to height,
and the angle between them says whether it is a rectangle at all (Zhang and He, "Whiteboard scanning and image
enhancement", Digital Signal Processing 17, 2007). With K known roughly, that the angle is right tells K in turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry.dlt import find_homographies

Array = NDArray[np.float64]

UNIT_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
"""Corners clockwise from the top left, y down."""
# focal lengths tried, evenly over so many of their sigmas to both sides
_STEPS, _REACH = 161, 4.0
_STEP_PX = 1e-2
_MOST_SIGMAS = 3.0


@dataclass(frozen=True)
class RectangleShape:
    """What the corners tell.

    Attributes:
        aspect: width over height; sigma of its logarithm in ``aspect_share``, which is its relative sigma where small.
        angle_deg, angle_sigma_deg: between the sides, if the focal length is what was given.
        focal_px, focal_share: as given and as the right angle corrects it, and the sigma of its logarithm.
        misfit_sigmas: how far the right angle and what is known of the focal length contradict each other.
    """

    aspect: float
    aspect_share: float
    angle_deg: float
    angle_sigma_deg: float
    focal_px: float
    focal_share: float
    misfit_sigmas: float

    @property
    def aspect_sigma(self) -> float:
        """Standard deviation of the aspect ratio."""
        return self.aspect * self.aspect_share

    @property
    def is_rectangle(self) -> bool:
        """Whether corners and focal length are those of a rectangle within three sigmas. Otherwise the angle was not
        used: ``aspect`` is that of the sides under what was known of the focal length."""
        return self.misfit_sigmas <= _MOST_SIGMAS


def shape_of_rectangle(
    corners: Array, focal_px: float, *, sigma_px: float, focal_share: float = 0.0, center_sigma_px: float = 0.0
) -> RectangleShape:
    """The shape of a rectangle of which the corners are seen.

    The focal length is taken through its whole distribution, narrowed by the right angle; for each, the noise of the
    corners and the right angle act on the aspect ratio to first order.

    Args:
        corners: (4, 2) pixels without distortion, clockwise from the top left, relative to the principal point.
        focal_px: in the same pixels. focal_share: sigma of its logarithm.
        sigma_px: of a coordinate of a corner. center_sigma_px: of one of the principal point.
    """
    corners = np.asarray(corners, np.float64)
    moved = corners + _STEP_PX * np.concatenate([np.eye(8).reshape(8, 4, 2), np.tile(np.eye(2)[:, None], (1, 4, 1))])
    back = 2.0 * corners - moved
    sigmas = np.append(np.full(8, sigma_px), np.full(2, center_sigma_px))
    squares = np.broadcast_to(UNIT_SQUARE, (21, 4, 2))
    sides = find_homographies(squares, np.concatenate([corners[None], moved, back]))[:, :, :2]
    share = np.linspace(-_REACH, _REACH, _STEPS) * focal_share if focal_share > 0.0 else np.zeros(1)
    told = _told(sides, focal_px, share, focal_share, sigmas)
    misfit = math.sqrt(float(told.cost.min()))
    middle = len(share) // 2
    by_focal = np.gradient(told.cosine, share)[middle] * focal_share if len(share) > 1 else 0.0
    angle = math.acos(float(np.clip(told.cosine[middle], -1.0, 1.0)))
    angle_sigma = math.hypot(math.sqrt(float(told.var_c[middle])), float(by_focal)) / max(math.sin(angle), 1e-6)
    if misfit > _MOST_SIGMAS:
        aspect, aspect_share, focal, share_left = _moments(told.prior, told.log_aspect, told.var_a, share)
    else:
        if len(share) > 1:  # the angle may tell the focal length better than the steps are apart
            focal, share_left = _moments(told.posterior, told.log_aspect, told.var_a, share)[2:]
            reach = _REACH * max(share_left, float(share[1] - share[0]))
            share = np.linspace(focal - reach, focal + reach, _STEPS)
            told = _told(sides, focal_px, share, focal_share, sigmas)
        aspect, aspect_share, focal, share_left = _moments(told.posterior, told.put_right, told.rest, share)
    return RectangleShape(
        math.exp(aspect), aspect_share, math.degrees(angle), math.degrees(angle_sigma), focal_px * math.exp(focal),
        share_left, misfit,
    )  # fmt: skip


class _Told(NamedTuple):
    """By focal lengths (F,): logarithm of the aspect ratio and cosine of the angle, their variances and covariance by
    the noise of the corners, and twice the negative logarithm of the probability of the focal length."""

    log_aspect: Array
    cosine: Array
    var_a: Array
    var_c: Array
    cov: Array
    prior: Array

    @property
    def cost(self) -> Array:
        return self.prior + self.cosine**2 / self.var_c

    @property
    def posterior(self) -> Array:
        """Twice the negative logarithm of the probability, once the angle is known to be right."""
        return self.cost + np.log(self.var_c)

    @property
    def put_right(self) -> Array:
        """Where the angle is off, the corners are: by the part of their noise that moves both, the aspect is, too."""
        return self.log_aspect - self.cov / self.var_c * self.cosine

    @property
    def rest(self) -> Array:
        """Variance of :attr:`put_right`."""
        return np.maximum(self.var_a - self.cov**2 / self.var_c, 0.0)


def _told(sides: Array, focal_px: float, share: Array, focal_share: float, sigmas: Array) -> _Told:
    """For focal lengths ``focal_px exp(share)``, of sides (21, 3, 2): as seen, and with each of ten numbers moved ahead
    and back."""
    log_aspect, cosine = _shape(sides, focal_px * np.exp(share))
    slopes = np.stack([(each[1:11] - each[11:]) / (2.0 * _STEP_PX) for each in (log_aspect, cosine)]) * sigmas[:, None]
    (var_a, cov), (_, var_c) = np.einsum("akf,bkf->abf", slopes, slopes)
    prior = (share / focal_share) ** 2 if focal_share > 0.0 else np.zeros(1)
    return _Told(log_aspect[0], cosine[0], var_a, np.maximum(var_c, 1e-24), cov, prior)


def _moments(cost: Array, log_aspect: Array, variance: Array, share: Array) -> tuple[float, float, float, float]:
    """Mean and standard deviation of the logarithms of the aspect ratio and of the focal length."""
    weight = np.exp(-0.5 * (cost - cost.min()))
    weight /= weight.sum()
    aspect, focal = float(weight @ log_aspect), float(weight @ share)
    spread = float(weight @ (variance + (log_aspect - aspect) ** 2))
    return aspect, math.sqrt(spread), focal, math.sqrt(float(weight @ (share - focal) ** 2))


def _shape(sides: Array, focals: Array) -> tuple[Array, Array]:
    """(S, F) logarithm of the aspect ratio, and cosine of the angle, of the first two columns (S, 3, 2) of maps of the
    unit square, by focal lengths (F,)."""
    flat, across = np.einsum("ski,skj->sij", sides[:, :2], sides[:, :2]), sides[:, 2]
    squares = flat[:, None] / (focals**2)[None, :, None, None] + (across[:, :, None] * across[:, None])[:, None]
    aa, bb, ab = squares[..., 0, 0], squares[..., 1, 1], squares[..., 0, 1]
    return 0.5 * np.log(aa / bb), ab / np.sqrt(aa * bb)
