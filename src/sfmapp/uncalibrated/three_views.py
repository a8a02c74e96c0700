"""Three photographs without a calibration: their cameras in a projective frame, what two of them say of the third."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import NoReconstructionError
from sfmapp.events import Events
from sfmapp.geometry.fundamental import refine_fundamental
from sfmapp.geometry.projective import triangulate_views
from sfmapp.geometry.projective_adjustment import sightings_of
from sfmapp.geometry.trifocal import (
    Transfer,
    crossing_angles,
    transfer_by_lines,
    transfer_by_tensor,
    trifocal_of,
)
from sfmapp.geometry.two_rays import fundamental_of, move_to_meet
from sfmapp.reporting import Report
from sfmapp.uncalibrated.projective_model import reconstruct_projective

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# half of the points fit the geometry, the other half judge it; both need that many
_LEAST_COMMON = 40
# where the lines of more points cross too flat than this, one speaks of cameras on a line
_ON_A_LINE = 0.9
# one right match in 16,000 is farther off its epipolar line
_MATCH_SIGMAS = 4.0


class WayReport(Report):
    """One way of transfer, on points that had no part in the geometry.

    Attributes:
        name: of the way.
        num_points: that were held back. num_refused: of these, where the answer would be too uncertain.
        median_px, p90_px: distance from the keypoint in the third photograph, of those not refused.
        median_sigma_px: of the longer axis of the ellipse that the noise asks for.
    """

    name: str
    num_points: int
    num_refused: int
    median_px: float
    p90_px: float
    median_sigma_px: float


class NewViewReport(Report):
    """A photograph synthesised in the place of the third.

    Attributes:
        coverage: share of its pixels that either photograph filled.
        correlation: normalised, of its grey values with the real photograph's, over these.
        num_triangles: of the net between transferred matches.
    """

    coverage: float
    correlation: float
    num_triangles: int


class TransferReport(Report):
    """What two photographs tell of the third.

    Attributes:
        names: of the three. sizes: (width, height) of each.
        num_matches: between 1 and 2, 1 and 3, 2 and 3. num_common: points that all three show.
        noise_px: standard deviation of a coordinate, as the adjustment tells it.
        fundamental_21, fundamental_31, fundamental_32: 3 x 3, x_j^T F_ji x_i = 0; the last two each of its own pair.
        tensor: 3 x 3 x 3, T[i][j][k] of photographs 1, 2, 3.
        cameras: 3 x 4 each, in one projective frame.
        trifocal_line: a x + b y + c = 0 of the trifocal plane in photograph 3: where a transfer by lines says nothing.
        ways: by lines and by the tensor, on points that were held back.
        median_crossing_deg: angle between the two epipolar lines of a point.
        line_sigma_px: standard deviation of such a line, at right angles to it, in the median.
        degenerate: in words, where transfer by lines is refused; empty where it is not.
        new_view: of a synthesised photograph; absent where there is none.
    """

    names: tuple[str, str, str]
    sizes: tuple[tuple[int, int], tuple[int, int], tuple[int, int]]
    num_matches: tuple[int, int, int]
    num_common: int
    noise_px: float
    fundamental_21: Sequence[Sequence[float]]
    fundamental_31: Sequence[Sequence[float]]
    fundamental_32: Sequence[Sequence[float]]
    tensor: Sequence[Sequence[Sequence[float]]]
    cameras: Sequence[Sequence[Sequence[float]]]
    trifocal_line: tuple[float, float, float]
    ways: Sequence[WayReport]
    median_crossing_deg: float
    line_sigma_px: float
    degenerate: str
    new_view: NewViewReport | None = None


@dataclass(frozen=True)
class ThreeViews:
    """Three photographs in one projective frame.

    Attributes:
        cameras: (3, 3, 4). tensor: (3, 3, 3).
        points: (N, 4) that all three have seen, and their pixels xy (N, 3, 2).
        noise_px: standard deviation of a coordinate.
    """

    cameras: Array
    tensor: Array
    points: Array
    xy: Array
    noise_px: float

    @property
    def fundamentals(self) -> tuple[Array, Array, Array]:
        """F21, F31 and F32."""
        p = self.cameras
        return fundamental_of(p[0], p[1]), fundamental_of(p[0], p[2]), fundamental_of(p[1], p[2])


def find_three_views(xy: Array, *, events: Events | None = None) -> ThreeViews:
    """Cameras of three photographs from points that all of them show, some of which are wrong.

    Args:
        xy: (N, 3, 2) pixels.

    Raises:
        NoReconstructionError: fewer than forty points, copies of one picture, or pictures that homographies explain.
    """
    if len(xy) < _LEAST_COMMON:
        raise NoReconstructionError(
            f"three photographs are to have {_LEAST_COMMON} points in common, found {len(xy)}",
            "take them from nearer places, of something with texture; each is to show most of what the others do",
        )
    found = reconstruct_projective(sightings_of(xy), 3, events=events)
    if len(found.view_idx) < 3:
        raise NoReconstructionError(
            "the points that the three photographs share do not agree on three cameras",
            "the photographs may show look-alikes, or something that moved between them",
        )
    table = found.seen.table(len(found.point_idx), 3)
    in_all = np.isfinite(table[:, :, 0]).all(1)
    noise = found.info.sigma_px
    return ThreeViews(
        found.model.cameras, trifocal_of(found.model.cameras), found.model.points[in_all], table[in_all],
        max(noise if math.isfinite(noise) else found.info.rms_px, 0.05),
    )  # fmt: skip


@dataclass(frozen=True)
class _Lines:
    """F31 and F32, each from its own pair alone, with their covariances; the noise of a coordinate."""

    f31: Array
    f32: Array
    covariances: tuple[Array, Array] | None
    noise_px: float

    @classmethod
    def of(cls, xy: Array, start: tuple[Array, Array]) -> _Lines:
        fits = [refine_fundamental(f, xy[:, n], xy[:, 2], is_robust=True) for n, f in enumerate(start)]
        one, two = (info.covariance for _, info in fits)
        known = None if one is None or two is None else (one, two)
        return cls(fits[0][0], fits[1][0], known, max(info.sigma_px for _, info in fits))

    def offset_sigma(self, xy: Array) -> float:
        """Median standard deviation of a line where it meets the other, px, at right angles to it."""
        told = transfer_by_lines(
            self.f31, self.f32, xy[:, 0], xy[:, 1], covariances=self.covariances, noise_px=self.noise_px
        )
        return float(np.median(told.sigmas * np.sin(crossing_angles(self.f31, self.f32, xy[:, 0], xy[:, 1]))))


def judge_transfer(xy: Array) -> list[WayReport]:
    """Transfer points that had no part in the geometry: half of them fit it, the other half is moved, and round."""
    is_first = np.arange(len(xy)) % 2 == 0
    of_lines, of_tensor = [], []
    for fitted, held in ((xy[is_first], xy[~is_first]), (xy[~is_first], xy[is_first])):
        views = find_three_views(fitted)
        f21, f31, f32 = views.fundamentals
        # what does not fit the geometry of the pair is a wrong match, whatever the third says
        good = held[agreeing(f21, held[:, 0], held[:, 1], views.noise_px)]
        lines = _Lines.of(views.xy, (f31, f32))
        of_lines.append((
            transfer_by_lines(
                lines.f31, lines.f32, good[:, 0], good[:, 1], covariances=lines.covariances, noise_px=views.noise_px
            ),
            good[:, 2],
        ))  # fmt: skip
        told = transfer_by_tensor(views.tensor, good[:, 0], good[:, 1], noise_px=views.noise_px)
        of_tensor.append((told, good[:, 2]))
    return [_way("by lines: F31 x1 x F32 x2", of_lines), _way("by the trifocal tensor", of_tensor)]


def agreeing(f21: Array, xy1: Array, xy2: Array, noise_px: float) -> Mask:
    """(N,) bool: matches that need not be moved by more than four standard deviations to meet."""
    moved = move_to_meet(f21, xy1, xy2)
    lengths = np.hypot(np.linalg.norm(moved[0] - xy1, axis=1), np.linalg.norm(moved[1] - xy2, axis=1))
    return np.asarray(lengths < _MATCH_SIGMAS * noise_px, np.bool_)


def _way(name: str, parts: Sequence[tuple[Transfer, Array]]) -> WayReport:
    told = np.concatenate([t.is_told for t, _ in parts])
    gap = np.concatenate([np.linalg.norm(t.xy - xy, axis=1) for t, xy in parts])
    sigmas = np.concatenate([t.sigmas for t, _ in parts])
    if not told.any():
        return WayReport(
            name=name,
            num_points=len(told),
            num_refused=len(told),
            median_px=math.nan,
            p90_px=math.nan,
            median_sigma_px=math.nan,
        )
    return WayReport(
        name=name, num_points=len(told), num_refused=int((~told).sum()), median_px=float(np.median(gap[told])),
        p90_px=float(np.percentile(gap[told], 90)), median_sigma_px=float(np.median(sigmas[told])),
    )  # fmt: skip


def tell_transfer(
    views: ThreeViews, names: tuple[str, str, str], sizes: tuple[tuple[int, int], ...],
    num_matches: tuple[int, int, int], xy: Array,
) -> TransferReport:  # fmt: skip
    """What there is to say of three photographs; xy (N, 3, 2) are all points in common."""
    ways = judge_transfer(xy)
    tensor = ways[1]
    if tensor.num_refused > 0.5 * tensor.num_points:
        raise NoReconstructionError(
            f"the matches do not tell the geometry of these three photographs: of {tensor.num_points} points that had "
            f"no part in it, {tensor.num_refused} cannot be transferred even by the tensor",
            "take photographs that have more in common, or from places that are farther apart",
        )
    f21 = views.fundamentals[0]
    lines = _Lines.of(views.xy, views.fundamentals[1:])
    f31, f32 = lines.f31, lines.f32
    angles = crossing_angles(f31, f32, views.xy[:, 0], views.xy[:, 1])
    e31, e32 = (np.linalg.svd(f)[0][:, 2] for f in (f31, f32))
    line = np.cross(e31, e32)
    line = line / max(float(np.linalg.norm(line[:2])), 1e-300)
    share = ways[0].num_refused / max(ways[0].num_points, 1)
    degenerate = ""
    if share > _ON_A_LINE:
        degenerate = (
            f"the three camera centres lie nearly on a line: every point is in a plane with them, the trifocal plane, "
            f"in which both epipolar lines are one. Transfer by lines is refused for {share:.0%} of the points; the "
            "tensor is not"
        )
    elif share > 0:
        degenerate = (
            f"{share:.0%} of the points lie near the trifocal plane, which the three camera centres span: their "
            "epipolar lines cross too flat, and transfer by lines is refused there; the tensor is not"
        )
    plane = (float(line[0]), float(line[1]), float(line[2]))
    width_heights = (sizes[0], sizes[1], sizes[2])
    return TransferReport(
        names=names, sizes=width_heights, num_matches=num_matches, num_common=len(xy), noise_px=views.noise_px,
        fundamental_21=f21.tolist(), fundamental_31=f31.tolist(), fundamental_32=f32.tolist(),
        tensor=views.tensor.tolist(), cameras=views.cameras.tolist(),
        trifocal_line=plane, ways=ways,
        median_crossing_deg=float(np.degrees(np.median(angles))),
        line_sigma_px=lines.offset_sigma(views.xy),
        degenerate=degenerate,
    )  # fmt: skip


def order_of_depth(views: ThreeViews, points: Array) -> Array:
    """(N,) numbers that grow with the distance from camera 3 among points (N, 4) that it sees in one pixel.

    Along a line of sight of camera 3 the ratio of the depths in cameras 3 and 1 is monotone, rising if camera 1 has
    centre 3 before it (compare the epipolar ordering of Laveau and Faugeras, "3-D scene representation as a collection
    of images", ICPR 1994); that takes no calibration, but the signs of an oriented frame (Hartley, "Chirality", 1998).
    """
    signed = views.cameras.copy()
    # points in front of camera 1, then the others with the signs that most of these ask for
    toward = points * np.where(points @ signed[0, 2] < 0.0, -1.0, 1.0)[:, None]
    for camera in signed[1:]:
        camera *= 1.0 if np.median(toward @ camera[2]) >= 0.0 else -1.0
    depths = toward @ signed[:, 2].T
    ratio = depths[:, 2] / np.maximum(depths[:, 0], 1e-300)
    center = np.array([(-1.0) ** k * np.linalg.det(np.delete(signed[2], k, axis=1)) for k in range(4)])
    middle = (toward / np.linalg.norm(toward, axis=1, keepdims=True)).mean(0)
    center *= 1.0 if center @ middle >= 0.0 else -1.0
    ordered: Array = ratio if center @ signed[0, 2] >= 0.0 else -ratio
    return ordered


def transferred_pairs(views: ThreeViews, xy: Array) -> tuple[Array, Array, Array]:
    """Matches (N, 2, 2) of photographs 1 and 2 in photograph 3: those that agree and are told (K, 2, 2), where they are
    there (K, 2), and their order of depth (K,)."""
    good = xy[agreeing(views.fundamentals[0], xy[:, 0], xy[:, 1], views.noise_px)]
    told = transfer_by_tensor(views.tensor, good[:, 0], good[:, 1], noise_px=views.noise_px)
    points, info = triangulate_views(views.cameras[:2], good)
    kept = told.is_told & info.is_inlier
    return good[kept], told.xy[kept], order_of_depth(views, points[kept])
