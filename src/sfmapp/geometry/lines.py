"""Lines in space: from segments in photographs by way of projection planes, with covariance.

A line is six Plücker coordinates, a unit direction d and the moment m = X x d of any of its points X: d . m = 0, and
abs(m) is the distance from the origin. A segment of a photograph with the rays s and e of its ends spans, with the
camera's centre, the projection plane with the normal n = s x e; a line seen twice is where two such planes meet
(Bartoli and Sturm, "Structure from motion using lines", CVIU 2005; Zhang et al., "Building a 3-D line-based map using
stereo SLAM", TRO 2015). Planes that coincide meet in no line: that is so where the line is in one plane with both
centres, as horizontal lines are for two cameras of one height that look across the way between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

# Planes that meet at less than so many sigmas of their angle have no line to tell.
_LEAST_SIGMAS = 3.0
# The angle below which planes are the same whatever is said of their noise: rounding of double precision.
_ROUNDING = 1e-9


class DegenerateLinesError(ValueError):
    """Planes that meet in no line: the message says why, and what would help."""


@dataclass(frozen=True)
class SpaceLine:
    """A line in space.

    Attributes:
        direction: (3,) unit; its sign is free.
        moment: (3,) X x direction, for points X of the line.
        covariance: (6, 6) of direction and moment. Its rank is four, the freedom of a line.
        plane_angle_deg: between the planes that it was made from.
    """

    direction: Array
    moment: Array
    covariance: Array
    plane_angle_deg: float

    @property
    def nearest_point(self) -> Array:
        """(3,) the point of the line that is nearest to the origin."""
        point: Array = np.cross(self.direction, self.moment)
        return point

    def distance(self, points: ArrayLike) -> Array:
        """(N,) distances of points (N, 3)."""
        off: Array = np.linalg.norm(np.cross(np.asarray(points, np.float64), self.direction) - self.moment, axis=1)
        return off

    def distance_sigma(self, point: ArrayLike) -> float:
        """Standard deviation of the line's place at a point of it, the mean over the directions across."""
        x = np.asarray(point, np.float64)
        # moment about the point: m - x x d; across the line it is the displacement, turned by a right angle
        jacobian = np.concatenate([-rigid3.skew(x), np.eye(3)], axis=1)
        return math.sqrt(float(np.trace(jacobian @ self.covariance @ jacobian.T)) / 2.0)


def plane_of_segment(start: ArrayLike, end: ArrayLike, sigma: float) -> tuple[Array, Array]:
    """The projection plane of a segment.

    Args:
        start, end: (3,) rays of its ends in the camera's frame, of any length.
        sigma: of each end across the ray, radians (pixels over the focal length).

    Returns:
        (3,) unit normal n = s x e and its (3, 3) covariance, of rank two.

    Raises:
        DegenerateLinesError: the ends are the same ray.
    """
    s, e = (np.asarray(ray, np.float64) / np.linalg.norm(ray) for ray in (start, end))
    normal = np.cross(s, e)
    norm = float(np.linalg.norm(normal))
    if not norm > max(_ROUNDING, _LEAST_SIGMAS * sigma):
        raise DegenerateLinesError(
            f"the ends of a segment are {math.degrees(norm):.2g} degrees apart: it has no direction; expected a "
            "longer one"
        )
    unit = normal / norm
    across = (np.eye(3) - np.outer(unit, unit)) / norm
    by_start, by_end = -across @ rigid3.skew(e), across @ rigid3.skew(s)
    covariance: Array = sigma**2 * (by_start @ by_start.T + by_end @ by_end.T)
    return unit, covariance


def line_of_planes(
    normals: ArrayLike, covariances: ArrayLike, cams_from_world: ArrayLike, *, least_sigmas: float = _LEAST_SIGMAS
) -> SpaceLine:
    """The line in which the projection planes of two photographs meet.

    Args:
        normals: (2, 3) unit, in the frames of the cameras.
        covariances: (2, 3, 3) of them.
        cams_from_world: (2, 7) poses, which are taken as exact.
        least_sigmas: angle between the planes in its own standard deviations that is enough.

    Raises:
        DegenerateLinesError: the planes are one as far as anybody can see, or the cameras are in one place.
    """
    poses, covariances = np.asarray(cams_from_world, np.float64), np.asarray(covariances, np.float64)
    rotations = rigid3.rotation_matrix(poses)
    n = np.einsum("kji,kj->ki", rotations, np.asarray(normals, np.float64))
    spread = np.einsum("kji,kjl,klm->kim", rotations, covariances, rotations)
    centers = rigid3.center(poses)
    cross = np.cross(n[0], n[1])
    sine = float(np.linalg.norm(cross))
    baseline = float(np.linalg.norm(centers[1] - centers[0]))
    if baseline <= _ROUNDING * max(float(np.abs(centers).max()), 1.0):
        raise DegenerateLinesError("both photographs are from one place: a line is seen from two")
    # the angle's sigma: what turns one normal towards the other
    direction = cross / max(sine, 1e-300)
    toward = [np.cross(direction, n[0]), np.cross(direction, n[1])]
    sigma = math.sqrt(sum(float(t @ c @ t) for t, c in zip(toward, spread, strict=True))) if sine > _ROUNDING else 0.0
    if not sine > max(_ROUNDING, least_sigmas * sigma):
        raise DegenerateLinesError(
            f"the projection planes are {math.degrees(sine):.2g} degrees apart ({math.degrees(sigma):.2g} are noise): "
            "the line lies in one plane with both cameras; expected a photograph from off this plane"
        )
    # points of plane k: n_k . X = h_k; the line is d = n0 x n1, m = h1 n0 - h0 n1 (signs as of m = X x d), over abs(d)
    h = (n * centers).sum(1)
    raw = np.concatenate([cross, h[1] * n[0] - h[0] * n[1]])
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3], jacobian[:3, 3:] = -rigid3.skew(n[1]), rigid3.skew(n[0])
    jacobian[3:, :3] = h[1] * np.eye(3) - np.outer(n[1], centers[0])
    jacobian[3:, 3:] = -h[0] * np.eye(3) + np.outer(n[0], centers[1])
    of_normals = np.zeros((6, 6))
    of_normals[:3, :3], of_normals[3:, 3:] = spread[0], spread[1]
    unit = (np.eye(6) - np.outer(raw, np.concatenate([direction, np.zeros(3)])) / sine) / sine
    jacobian = unit @ jacobian
    line = raw / sine
    return SpaceLine(
        line[:3], line[3:], jacobian @ of_normals @ jacobian.T, math.degrees(math.asin(min(sine, 1.0)))
    )  # fmt: skip


def project_line(line: SpaceLine, cam_from_world: ArrayLike) -> Array:
    """(3,) unit normal of the projection plane of a line, in the camera's frame; the sign is free.

    Raises:
        DegenerateLinesError: the line goes through the camera's centre.
    """
    pose = np.asarray(cam_from_world, np.float64)
    about_center = line.moment - np.cross(rigid3.center(pose), line.direction)
    norm = float(np.linalg.norm(about_center))
    if not norm > _ROUNDING:
        raise DegenerateLinesError("the line goes through the camera's centre, where it is seen as a point")
    normal: Array = rigid3.rotation_matrix(pose) @ about_center / norm
    return normal
