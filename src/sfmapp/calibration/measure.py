"""Lengths and areas on a plane in one photograph, each with its standard deviation.

A pixel sees one point of a plane that is known in the world, or that four of its points with known places in it tell
(its homography; Criminisi, Reid and Zisserman, "Single view metrology", IJCV 2000). What is measured is a function of
the marks and of what places them, the camera and its pose or the homography, and its variance is theirs through the
slopes of that function, which follow from those of the projection.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.calibration.one_view import HAND_SIGMA_PX, MIN_DEGREES, inverse
from sfmapp.camera.camera import Camera, pixels_to_normalized, pixels_to_rays, project_jacobian
from sfmapp.errors import InputError
from sfmapp.geometry import dlt, rigid3

Array = NDArray[np.float64]

# Of the distance to a point, which its sigma along the ray may be before slopes no longer say how far it is off.
_GRAZING = 0.1
_MAX_STEPS = 50


@dataclass(frozen=True)
class Plane:
    """A plane in the world: a point (3,) and two axes (2, 3) at right angles, of unit length."""

    origin: Array
    axes: Array

    @classmethod
    def of_equation(cls, normal: Array, offset: float) -> Plane:
        """Of all X with normal . X = offset. Raises InputError for a normal that is zero or not finite."""
        length = float(np.linalg.norm(normal))
        if not (np.isfinite(length) and length > 0.0 and np.isfinite(offset)):
            raise InputError(f"plane: expected a normal that is not zero, found {normal.tolist()}")
        unit = normal / length
        # the axis of the world that lies most across it comes first
        first = np.eye(3)[int(np.argmin(np.abs(unit)))]
        first = first - unit * (unit @ first)
        first /= np.linalg.norm(first)
        return cls(unit * offset / length, np.stack([first, np.cross(unit, first)]))

    @classmethod
    def of_points(cls, xyz: Array) -> Plane:
        """Through three points or more (K, 3), the nearest to all. Raises InputError if they lie on a line."""
        middle = xyz.mean(0)
        _, widths, axes = np.linalg.svd(xyz - middle)
        if len(xyz) < 3 or not widths[1] > 1e-9 * widths[0]:
            raise InputError("plane: expected three points that are not on one line, found fewer, or a line")
        return cls(middle, axes[:2])


@dataclass(frozen=True)
class PlacedMarks:
    """Marks of one photograph on a plane.

    Attributes:
        ab: (M, 2) coordinates along the plane's axes.
        by_mark: (M, 2, 2) their slopes by their own pixels.
        by_shared: (M, 2, S) by what all have in common. shared: (S, S) covariance of this.
        sigma_px: standard deviation of a marked coordinate.
        is_grazing: (M,) bool: so nearly along the plane that slopes do not say how far a point is off.
    """

    ab: Array
    by_mark: Array
    by_shared: Array
    shared: Array
    sigma_px: float
    is_grazing: NDArray[np.bool_]


@dataclass(frozen=True)
class Quantity:
    """A measured number.

    Attributes:
        value, sigma: in the unit of the places, or its square.
        mark_share: of the variance, what the marks contribute; the rest is of the camera and its pose, or the
            homography.
    """

    value: float
    sigma: float
    mark_share: float


@dataclass(frozen=True)
class MeasuredFigure:
    """A length, or a polygon.

    Attributes:
        name: of it. ab: (K, 2) corners in the plane.
        length: between two marks; round three or more.
        area: of three or more; None for two.
        is_grazing: whether a corner is seen along the plane.
    """

    name: str
    ab: Array
    length: Quantity
    area: Quantity | None
    is_grazing: bool


def place_on_plane(
    xy: Array, camera: Camera, cam_from_world: Array, covariance: Array, plane: Plane, sigma_px: float
) -> PlacedMarks:
    """Where pixels (M, 2) see a plane.

    Args:
        camera, cam_from_world: with covariance (P + 6, P + 6) of its parameters and pose, as of a ``Location``.
        sigma_px: of a mark.

    Raises:
        InputError: a pixel that the lens does not see, or that sees the plane nowhere: beyond its horizon.
    """
    rays = pixels_to_rays(camera, xy)
    rotation, center = rigid3.rotation_matrix(cam_from_world), rigid3.center(cam_from_world)
    normal = np.cross(*plane.axes)
    across = rays @ rotation @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (normal @ (plane.origin - center)) / across
    wrong = ~(np.isfinite(distance) & (distance > 0.0))
    if wrong.any():
        n = int(np.argmax(wrong))
        raise InputError(
            f"pixel ({xy[n, 0]:g}, {xy[n, 1]:g}) does not see the plane: it is beyond the horizon, or has no ray",
            "check the plane, and mark points that lie on it",
        )
    world = center + distance[:, None] * (rays @ rotation)
    in_camera = rigid3.apply(cam_from_world, world)
    _, by_point, by_params = project_jacobian(camera, in_camera)
    by_plane = by_point @ (rotation @ plane.axes.T)
    by_shared = np.concatenate([by_params, by_point @ -rigid3.skew(in_camera), by_point], 2)
    by_mark: Array = np.asarray(np.linalg.inv(by_plane), np.float64)
    placed = PlacedMarks(
        (world - plane.origin) @ plane.axes.T, by_mark, -by_mark @ by_shared, covariance, sigma_px, wrong
    )
    sigma = np.sqrt(np.trace(_own_covariances(placed), axis1=1, axis2=2))
    return PlacedMarks(
        placed.ab, by_mark, placed.by_shared, covariance, sigma_px, np.asarray(sigma > _GRAZING * distance, bool)
    )


def place_by_homography(
    xy: Array, known: tuple[Array, Array], sigma_px: float | None, camera: Camera | None = None
) -> PlacedMarks:
    """Where pixels (M, 2) lie on a plane of which four points or more have known places, without any pose.

    Args:
        known: (K, 2) places in the plane and the pixels (K, 2) that show them.
        sigma_px: of a mark, of those as well; None: from what seven or more known points leave, else that of a hand.
        camera: takes its distortion away first; it is taken as exact. None: there is none.

    Raises:
        InputError: fewer than four known points, three of which are on a line, or a mark beyond the horizon.
    """
    if camera is not None:
        xy, known = _undistorted(camera, xy), (known[0], _undistorted(camera, known[1]))
    plane_xy, pixels = known
    if len(plane_xy) < 4:
        raise InputError(f"expected four points of the plane or more with known places, found {len(plane_xy)}")
    of_plane = dlt.normalizing(plane_xy)
    points = dlt.homogeneous(plane_xy) @ of_plane.T
    entries = (dlt.find_homographies(plane_xy[None], pixels[None])[0] @ np.linalg.inv(of_plane)).ravel()
    if not abs(entries[8]) > 0.0:  # the middle of the points is in the picture, unless no homography shows it
        raise _not_told()
    entries = entries / entries[8]
    for _ in range(_MAX_STEPS):
        seen, slopes = _mapped(entries, points)
        step = np.linalg.lstsq(slopes.reshape(-1, 8), (pixels - seen).ravel(), rcond=None)[0]
        entries[:8] += step
        if np.abs(step).max() < 1e-12 * np.abs(entries).max():
            break
    seen, slopes = _mapped(entries, points)
    rows = slopes.reshape(-1, 8)
    cofactor = inverse(rows.T @ rows) if np.isfinite(rows).all() else None
    if cofactor is None:
        raise _not_told()
    degrees = 2 * len(points) - 8
    left = float(((pixels - seen) ** 2).sum())
    if sigma_px is None:
        found = np.sqrt(left / degrees) if degrees else 0.0
        sigma_px = float(found) if degrees >= MIN_DEGREES else max(float(found), HAND_SIGMA_PX)
    ab1 = dlt.homogeneous(xy) @ np.linalg.inv(entries.reshape(3, 3)).T
    with np.errstate(divide="ignore", invalid="ignore"):
        local = ab1[:, :2] / ab1[:, 2:]
    weight = dlt.homogeneous(local) @ entries[6:]
    if not (np.isfinite(local).all() and (weight > 0.0).all()):
        n = int(np.argmin(np.where(np.isfinite(weight), weight, -np.inf)))
        raise InputError(f"pixel ({xy[n, 0]:g}, {xy[n, 1]:g}) does not see the plane: it lies beyond the horizon")
    _, by_entries = _mapped(entries, dlt.homogeneous(local))
    h = entries.reshape(3, 3)
    by_local = (h[:2, :2] - (dlt.homogeneous(local) @ h.T)[:, :2, None] / weight[:, None, None] * h[2, :2]) / weight[
        :, None, None
    ]
    scale = np.linalg.inv(of_plane)
    by_mark: Array = np.asarray(scale[:2, :2] @ np.linalg.inv(by_local), np.float64)
    ab = dlt.homogeneous(local) @ scale[:2].T
    return PlacedMarks(
        ab, by_mark, -by_mark @ by_entries, sigma_px**2 * cofactor, sigma_px, np.zeros(len(ab), np.bool_)
    )


def _undistorted(camera: Camera, xy: Array) -> Array:
    flat = pixels_to_normalized(camera, xy) @ np.diag(camera.canonical[:2]) + camera.canonical[2:4]
    if not np.isfinite(flat).all():
        n = int(np.argmin(np.isfinite(flat).all(1)))
        raise InputError(f"pixel ({xy[n, 0]:g}, {xy[n, 1]:g}): the lens of the camera does not look there")
    return flat


def _mapped(entries: Array, points: Array) -> tuple[Array, Array]:
    """Pixels (N, 2) of homogeneous points (N, 3) by a homography (9,), and slopes (N, 2, 8) by its first eight."""
    mapped = points @ entries.reshape(3, 3).T
    seen = mapped[:, :2] / mapped[:, 2:]
    slopes = np.zeros((len(points), 2, 8))
    slopes[:, 0, :3] = slopes[:, 1, 3:6] = points / mapped[:, 2:]
    slopes[:, :, 6:] = -seen[:, :, None] * (points[:, None, :2] / mapped[:, None, 2:])
    return seen, slopes


def _own_covariances(placed: PlacedMarks) -> Array:
    """(M, 2, 2) of the marks' places."""
    of_marks = placed.sigma_px**2 * placed.by_mark @ placed.by_mark.swapaxes(1, 2)
    total: Array = of_marks + placed.by_shared @ placed.shared @ placed.by_shared.swapaxes(1, 2)
    return total


def measure(placed: PlacedMarks, figures: Sequence[tuple[str, Sequence[int]]]) -> list[MeasuredFigure]:
    """Lengths of figures of two marks, the way round and the areas of those of more.

    Args:
        placed: M marks. figures: names and positions of their marks, in order round them.

    Raises:
        InputError: a figure of fewer than two marks, or that crosses itself.
    """
    found = []
    for name, marks in figures:
        index = np.asarray(marks, np.int64)
        ab = placed.ab[index]
        if len(index) < 2:
            raise InputError(f"{name}: expected two marks for a length, three or more for an area, found {len(index)}")
        if len(index) > 3 and _crosses_itself(ab):
            raise InputError(f"{name}: its sides cross each other", "list the corners in order round it")
        is_grazing = bool(placed.is_grazing[index].any())
        if len(index) == 2:
            found.append(MeasuredFigure(name, ab, _quantity(placed, index, *_path(ab, False)), None, is_grazing))
        else:
            way, area = _quantity(placed, index, *_path(ab, True)), _quantity(placed, index, *_area(ab))
            found.append(MeasuredFigure(name, ab, way, area, is_grazing))
    return found


def _path(ab: Array, is_closed: bool) -> tuple[float, Array]:
    """Length of a path and its slopes (K, 2)."""
    following = np.roll(ab, -1, axis=0) if is_closed else ab[1:]
    sides = following - ab[: len(following)]
    lengths = np.linalg.norm(sides, axis=1)
    along = sides / np.where(lengths > 0.0, lengths, 1.0)[:, None]
    slopes = np.zeros_like(ab)
    slopes[: len(along)] -= along
    slopes[(np.arange(len(along)) + 1) % len(ab)] += along
    return float(lengths.sum()), slopes


def _area(ab: Array) -> tuple[float, Array]:
    """Area of a polygon (Gauss's formula) and its slopes (K, 2)."""
    after, before = np.roll(ab, -1, axis=0), np.roll(ab, 1, axis=0)
    signed = 0.5 * float((ab[:, 0] * after[:, 1] - ab[:, 1] * after[:, 0]).sum())
    across = after - before
    slopes = 0.5 * np.stack([across[:, 1], -across[:, 0]], 1)
    return abs(signed), slopes * (1.0 if signed >= 0.0 else -1.0)


def _crosses_itself(ab: Array) -> bool:
    def side(p: Array, q: Array, r: Array) -> float:
        return float((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    count = len(ab)
    for i in range(count):
        p, q = ab[i], ab[(i + 1) % count]
        for j in range(i + 2, count - (i == 0)):
            r, s = ab[j], ab[(j + 1) % count]
            if side(p, q, r) * side(p, q, s) < 0.0 and side(r, s, p) * side(r, s, q) < 0.0:
                return True
    return False


def _quantity(placed: PlacedMarks, index: NDArray[np.int64], value: float, slopes: Array) -> Quantity:
    by_marks = np.einsum("ki,kij->kj", slopes, placed.by_mark[index])
    by_shared = np.einsum("ki,kis->s", slopes, placed.by_shared[index])
    of_marks = placed.sigma_px**2 * float((by_marks**2).sum())
    total = of_marks + float(by_shared @ placed.shared @ by_shared)
    return Quantity(value, float(np.sqrt(total)), of_marks / total if total > 0.0 else 1.0)


def _not_told() -> InputError:
    return InputError(
        "the known points do not tell the plane: three of them lie on a line, or two at one place",
        "use four corners of something as large as what is measured",
    )
