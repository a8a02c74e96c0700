"""Tracks to cameras and points in a projective frame, with no calibration: a factorised core, resection, adjustment.

The core is a few views that many points have in common (Sturm and Triggs, ECCV 1996); points that not all views see,
and the other views, are added as in Beardsley, Zisserman and Murray, "Sequential updating of projective and affine
structure from motion", IJCV 1997.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import NoReconstructionError
from sfmapp.events import Events
from sfmapp.geometry.factorisation import depths_of_chain, factorise
from sfmapp.geometry.fundamental import eight_point, refine_fundamental
from sfmapp.geometry.homography import fit_homography, transfer_errors
from sfmapp.geometry.projective import resect_projective, triangulate_views
from sfmapp.geometry.projective_adjustment import AdjustmentInfo, ProjectiveModel, Sightings, adjust_projective
from sfmapp.scene.tracks import Tracks

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

# F of two views, the resection of a third and what is left to judge them by: each of a few dozen points
_CORE_POINTS, _RESECTION_POINTS = 30, 20
_CORE_VIEWS = 5
# sightings beyond so many standard deviations of the noise are wrong: one in 700 right ones is lost (two coordinates)
_LIMIT = 3.6
# pixels: keypoints are no better than that in any photograph, and a matched pair no worse
_LEAST_LIMIT, _MOST_LIMIT = 0.5, 4.0
_STEPS_BETWEEN, _STEPS_AT_END = 3, 12
# depth is seen in what stands off a plane, which may be one in ten of all points
_OFF_PLANE = 90.0
# of right matches a few per cent are dropped; where most are, what is left is no geometry of the scene
_DOUBTFUL, _HOPELESS = 0.25, 0.5
# points that this few sightings hold are of no weight in what is to hold others
_MIN_SIGHTINGS = 3
# points of each view that are adjusted while others are still to come
_HOLDING = 100


@dataclass(frozen=True)
class ProjectiveReconstruction:
    """Cameras and points that fit the tracks of uncalibrated photographs, up to any (4, 4).

    Attributes:
        view_idx: (V,) images that have a camera. point_idx: (N,) tracks that have a point.
        model: these V cameras and N points.
        seen: O sightings that fit, by position among the V and the N.
        info: of the closing adjustment.
        num_dropped: sightings that do not fit.
        core: images whose common points were factorised. core_left: share of the measurement matrix that no rank of
            four explains.
    """

    view_idx: Ints
    point_idx: Ints
    model: ProjectiveModel
    seen: Sightings
    info: AdjustmentInfo
    num_dropped: int
    core: tuple[int, ...]
    core_left: float

    @property
    def share_dropped(self) -> float:
        """Of all sightings in these images."""
        return self.num_dropped / max(self.num_dropped + len(self.seen.xy), 1)


def sightings_of_tracks(tracks: Tracks) -> Sightings:
    """All observations of tracks."""
    return Sightings(tracks.obs_image_idx.astype(np.int64), tracks.obs_track_idx.astype(np.int64), tracks.obs_xy)


def reconstruct_projective(
    tracks: Sightings, num_views: int, *, events: Events | None = None, stage: str = "projective"
) -> ProjectiveReconstruction:
    """Cameras and points from matched pixels alone.

    Args:
        tracks: all sightings; images and tracks are numbered from 0.
        num_views: number of images.
        events: told of every image, and asked for cancellation.

    Raises:
        NoReconstructionError: fewer than two images with enough points in common, copies of one picture, or pictures
            that a homography explains: a plane, or a camera that only turned.
    """
    events = events or Events()
    num_points = int(tracks.point_idx.max(initial=-1)) + 1
    table = tracks.table(num_points, num_views)
    is_seen = np.isfinite(table[:, :, 0])
    pair, core = _choose_core(table, is_seen)
    found = _grown(table, is_seen, core, events, stage)
    if found.share_dropped > _DOUBTFUL and len(core) > 2:
        # wrong matches that every view of the core has seen draw the factors to them; two views and samples do not
        other = _grown(table, is_seen, pair, events, stage)
        found = max(found, other, key=lambda each: len(each.seen.xy))
    if found.share_dropped > _HOPELESS:
        raise NoReconstructionError(
            f"only {1.0 - found.share_dropped:.0%} of the matches agree on cameras",
            "the photographs may show look-alikes, something that moved, or come from a lens with strong distortion",
        )
    return found


def _grown(table: Array, is_seen: Mask, core: tuple[int, ...], events: Events, stage: str) -> ProjectiveReconstruction:
    """All views that can be had from a core."""
    num_points, num_views = is_seen.shape
    points = np.flatnonzero(is_seen[:, list(core)].all(1))
    model, left = _factorised_core(table[points][:, list(core)])
    state = _State(table, is_seen, np.zeros((num_views, 3, 4)), np.full((num_points, 4), np.nan))
    state.cameras[list(core)] = model.cameras
    state.has_camera[list(core)] = True
    state.points[points] = model.points
    state.settle(_STEPS_BETWEEN)
    events.advanced(stage, len(core))
    while (view := state.next_view()) is not None:
        if state.add_view(view):
            state.settle(_STEPS_BETWEEN)
            events.advanced(stage)
    state.settle(_STEPS_AT_END, at_end=True)
    return state.result(core, left)


def _choose_core(table: Array, is_seen: Mask) -> tuple[tuple[int, int], tuple[int, ...]]:
    """The pair that depth shows best in, and images to factorise: with those that see most of it."""
    common = is_seen.T.astype(np.float32) @ is_seen.astype(np.float32)
    np.fill_diagonal(common, 0.0)
    pairs = np.argwhere(np.triu(common >= _CORE_POINTS))
    if not len(pairs):
        raise NoReconstructionError(
            f"no two photographs have {_CORE_POINTS} matches in common",
            "photographs of one thing are to overlap, each with the next by two thirds",
        )
    order = np.argsort(-common[pairs[:, 0], pairs[:, 1]], kind="stable")[:20]
    best, score, moved = None, 0.0, 0.0
    for i, j in pairs[order]:
        both = is_seen[:, i] & is_seen[:, j]
        a, b = table[both, i], table[both, j]
        h = fit_homography(a, b)[0]
        # what no plane and no turn explains is what tells depth
        depth_px = math.sqrt(float(np.percentile(transfer_errors(h, a, b), _OFF_PLANE, method="nearest")))
        moved = max(moved, float(np.median(np.linalg.norm(a - b, axis=1))))
        signal = min(depth_px, 30.0) * math.sqrt(float(both.sum()))
        if depth_px > 2.0 * _LEAST_LIMIT and signal > score:
            best, score = (int(i), int(j)), signal
    if best is None:
        what = (
            "they are copies of one picture" if moved < _LEAST_LIMIT
            else "they show one plane, or the camera turned without moving"
        )  # fmt: skip
        raise NoReconstructionError(
            f"a homography explains every pair of these photographs: {what}",
            "walk: photographs are to be taken from different places, of something with depth",
        )
    core = list(best)
    points = np.asarray(is_seen[:, core].all(1), np.bool_)
    while len(core) < _CORE_VIEWS:
        counts = (is_seen & points[:, None]).sum(0)
        counts[core] = 0
        view = int(np.argmax(counts))
        if counts[view] < _CORE_POINTS:
            break
        core.append(view)
        points &= is_seen[:, view]
    core.sort()
    return best, tuple(core)


def _factorised_core(xy: Array) -> tuple[ProjectiveModel, float]:
    """Cameras and points of what all views of the core see, wrong ones in it."""
    chain = []
    for v in range(xy.shape[1] - 1):
        f, _ = eight_point(xy[:, v], xy[:, v + 1])
        chain.append(refine_fundamental(f, xy[:, v], xy[:, v + 1], is_robust=True)[0])
    model, info = factorise(xy, depths=depths_of_chain(xy, np.array(chain)), max_iterations=50)
    if info.num_free > 1:
        raise NoReconstructionError(
            "the points that the first photographs share lie in one plane, or were seen from one place",
            "photographs are to be taken from different places, of something with depth",
        )
    return model, float(info.singular_values[4] / np.linalg.norm(info.singular_values))


@dataclass
class _State:
    """A reconstruction that grows: (N, V, 2) pixels, which of them are there, cameras and points in one frame."""

    table: Array
    is_seen: Mask
    cameras: Array
    points: Array
    sigma: float = 1.0

    def __post_init__(self) -> None:
        num_points, num_views = self.is_seen.shape
        self.has_camera: Mask = np.zeros(num_views, np.bool_)
        self.is_wrong: Mask = np.zeros((num_points, num_views), np.bool_)
        self.was_refused: Ints = np.full(num_views, -1)
        self.info: AdjustmentInfo | None = None

    @property
    def limit_px(self) -> float:
        """Distance beyond which a sighting is wrong."""
        return min(max(_LIMIT * self.sigma, _LEAST_LIMIT), _MOST_LIMIT)

    def sightings(self, points: Mask) -> tuple[Sightings, Ints]:
        """Of some points in the views that have a camera, numbered among these; and the numbers of the points."""
        of_points, of_views = np.flatnonzero(points), np.flatnonzero(self.has_camera)
        used = (self.is_seen & ~self.is_wrong)[np.ix_(of_points, of_views)]
        point_idx, view_idx = np.nonzero(used)
        return Sightings(view_idx, point_idx, self.table[of_points[point_idx], of_views[view_idx]]), of_points

    def settle(self, steps: int, *, at_end: bool = False) -> None:
        """Triangulate what can be, adjust, drop what is wrong; until nothing more is."""
        for _ in range(3 if at_end else 2):
            self.triangulate()
            counts = (self.is_seen & ~self.is_wrong)[:, self.has_camera].sum(1)
            least = 2 if at_end or self.has_camera.sum() < 3 else _MIN_SIGHTINGS
            chosen = np.isfinite(self.points[:, 0]) & (counts >= least)
            if not at_end:
                chosen = self.holding(chosen, counts)
            seen, _ = self.sightings(chosen)
            if not len(seen.xy):
                raise NoReconstructionError(
                    "no matches agree on cameras", "the photographs may show look-alikes, or something that moved"
                )
            model = ProjectiveModel(self.cameras[self.has_camera], self.points[chosen])
            model, self.info = adjust_projective(model, seen, is_robust=True, max_iterations=steps)
            self.cameras[self.has_camera], self.points[chosen] = model.cameras, model.points
            if math.isfinite(self.info.sigma_px):
                self.sigma = self.info.sigma_px
            self.triangulate_again(chosen)
            if not self.drop_wrong():
                break

    def holding(self, chosen: Mask, counts: Ints) -> Mask:
        """Of points, those that most views have seen: in each view so many, which hold it as well as all would."""
        held = np.zeros_like(chosen)
        order = np.argsort(-counts, kind="stable")
        for view in np.flatnonzero(self.has_camera):
            is_of_view = np.asarray(chosen & self.is_seen[:, view] & ~self.is_wrong[:, view], np.bool_)
            of_view = order[is_of_view[order]]
            held[of_view[:_HOLDING]] = True
        return held

    def triangulate(self) -> None:
        """Points that two cameras or more see and that have no place yet, or lost it."""
        used = (self.is_seen & ~self.is_wrong)[:, self.has_camera]
        new = np.flatnonzero((used.sum(1) >= 2) & ~np.isfinite(self.points[:, 0]))
        if not len(new):
            return
        xy = np.where(used[new][..., None], self.table[new][:, self.has_camera], np.nan)
        found, _ = triangulate_views(self.cameras[self.has_camera], xy)
        good = np.isfinite(found[:, 0])
        self.points[new[good]] = found[good]

    def triangulate_again(self, adjusted: Mask) -> None:
        """Points that were not adjusted with the cameras."""
        self.points[~adjusted] = np.nan
        self.triangulate()

    def drop_wrong(self) -> bool:
        """Mark sightings that are too far off; a point of two sightings that do not agree goes with both."""
        known = np.isfinite(self.points[:, 0])
        views = np.flatnonzero(self.has_camera)
        mapped = np.einsum("vij,nj->nvi", self.cameras[views], self.points[known])
        with np.errstate(divide="ignore", invalid="ignore"):
            left = np.linalg.norm(mapped[..., :2] / mapped[..., 2:] - self.table[known][:, views], axis=2)
        off = np.zeros_like(self.is_wrong)
        off[np.ix_(known, views)] = np.nan_to_num(left, nan=0.0) > self.limit_px
        # the farthest of a point first: it pulls the others off
        worst = np.zeros_like(self.is_wrong)
        rows = np.flatnonzero(off.any(1))
        distance = np.zeros(self.is_wrong.shape)
        distance[np.ix_(known, views)] = np.nan_to_num(left, nan=0.0)
        worst[rows, distance[rows].argmax(1)] = True
        self.is_wrong |= worst & off
        used = (self.is_seen & ~self.is_wrong)[:, self.has_camera].sum(1)
        self.points[(used < 2)] = np.nan
        self.points[rows] = np.nan
        return len(rows) > 0

    def next_view(self) -> int | None:
        """The image without a camera that sees most points, unless it was refused with as many."""
        known = np.isfinite(self.points[:, 0])
        held = known & ((self.is_seen & ~self.is_wrong)[:, self.has_camera].sum(1) >= 2)
        counts = (self.is_seen & held[:, None]).sum(0)
        counts[self.has_camera | (counts <= self.was_refused)] = 0
        view = int(np.argmax(counts))
        return view if counts[view] >= _RESECTION_POINTS else None

    def add_view(self, view: int) -> bool:
        """Resect an image; False where its points do not agree on a camera."""
        chosen = np.flatnonzero(np.isfinite(self.points[:, 0]) & self.is_seen[:, view])
        threshold = 2.0 * self.limit_px
        camera, info = resect_projective(self.points[chosen], self.table[chosen, view], threshold_px=threshold)
        if info.is_inlier.sum() < max(_RESECTION_POINTS, 0.5 * len(chosen)) or info.num_free > 1:
            self.was_refused[view] = len(chosen)
            return False
        self.cameras[view] = camera
        self.has_camera[view] = True
        self.is_wrong[chosen[~info.is_inlier], view] = True
        return True

    def result(self, core: Sequence[int], left: float) -> ProjectiveReconstruction:
        used = (self.is_seen & ~self.is_wrong)[:, self.has_camera].sum(1)
        chosen = np.isfinite(self.points[:, 0]) & (used >= 2)
        seen, of_points = self.sightings(chosen)
        assert self.info is not None
        views = np.flatnonzero(self.has_camera)
        model = ProjectiveModel(self.cameras[views], self.points[of_points])
        # without a step: what the residuals are of exactly these
        model, info = adjust_projective(model, seen, max_iterations=2)
        return ProjectiveReconstruction(
            views, of_points, model, seen, info, int(self.is_wrong[:, views].sum()), tuple(core), left
        )
