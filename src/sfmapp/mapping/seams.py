"""How two submaps lie to each other, and whether they agree: by the images and tracks that both have.

Each submap knows its images and points up to a similarity, and how well: the joint covariance of those that both have.
The similarity is the generalised least squares fit to what both say of these, after a robust start, so that where what
they share is one street corner the depths of points tell the scale. What it is not fitted to judges it: where images
that only one of them has see points of the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.gauge import similarity_motions
from sfmapp.adjust.graph import FactorGraph
from sfmapp.geometry import rigid3, similarity
from sfmapp.mapping.mapper import Mapper
from sfmapp.mapping.merge import find_merge
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.report import MIN_SHARED
from sfmapp.mapping.submaps import Submap
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import Tracks, make_tracks

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# A shared image is elsewhere by so many standard deviations of both, which are those of noise alone, and by so many
# degrees or this share of the distance of what it sees: as much as two models of one place do not differ by. A third of
# them may be, as images that either submap holds by little.
OFF_SIGMAS, OFF_SHARE, OFF_DEG, MAX_OFF = 10.0, 0.02, 1.0, 1 / 3
# Points of both beside the images that the fit takes: the covariance costs by them, and those of one corner say the
# same.
NUM_POINTS = 12
# Depths of points near the edge of a model are good to a few per cent.
_NEAR_SHARE = 0.05
# Share of the points of one submap that images of the other alone see which must be where these see them: of right
# joints nearly all are, of wrong ones next to none.
MIN_SEEN = 0.5


@dataclass(frozen=True)
class Common:
    """What two submaps have in common, and a first similarity.

    Attributes:
        submaps: numbers of the first and the second.
        image_idx: (M,) images of the run that both hold.
        track_idx: (N,) tracks of the run that both have triangulated; chosen: (P,) of these, for the fit.
        first_from_second: (8,) as in :mod:`sfmapp.geometry.similarity`.
        reason: why there is none, with the numbers; empty if there is.
    """

    submaps: tuple[int, int]
    image_idx: Ints
    track_idx: Ints
    chosen: Ints
    first_from_second: Array
    reason: str = ""


@dataclass(frozen=True)
class Seam:
    """How one submap lies to another.

    Attributes:
        submaps: numbers of the first and the second.
        image_idx: (M,) images of the run that both hold. is_off: (M,) bool, those that are elsewhere.
        first_from_second: (8,) as in :mod:`sfmapp.geometry.similarity`.
        middle, size: place (3,) in the world of the first that turns and scales are about, and length of shifts.
        information: (7, 7) on turn, shift in sizes and logarithm of the scale, by both submaps together.
        sigmas: rms of what both say differently, in standard deviations of both.
        num_points, num_seen: points of one that images of the other alone see, and those that are where these see them.
        reason: why it is not to be trusted, with the numbers; empty if it is.
    """

    submaps: tuple[int, int]
    image_idx: Ints
    is_off: Bools
    first_from_second: Array
    middle: Array
    size: float
    information: Array
    sigmas: float
    num_points: int = 0
    num_seen: int = 0
    reason: str = ""


def find_common(first: int, second: int, submaps: Sequence[Submap], options: MappingOptions) -> Common:
    """What two submaps, by their numbers, have in common."""
    a, b = submaps[first], submaps[second]
    images = np.intersect1d(a.registered_idx, b.registered_idx)
    tracks = np.intersect1d(a.triangulated_idx, b.triangulated_idx)
    nothing = np.zeros(0, np.int64)
    found = Common((first, second), images, tracks, nothing, np.full(8, np.nan))
    if len(images) < MIN_SHARED:
        return replace(found, reason=f"they share {len(images)} of the {MIN_SHARED} images that are needed")
    start = find_merge(*(_only(submap, images, tracks) for submap in (a, b)))
    if start is None:
        return replace(found, reason=f"{len(tracks)} points of both do not agree on one scale")
    chosen = _well_known(a, b, images, tracks, start[0])
    if len(chosen) < min(NUM_POINTS, options.min_pose_inliers):
        return replace(found, reason=f"{len(chosen)} points of both agree, at least {NUM_POINTS} are needed")
    return replace(found, chosen=chosen, first_from_second=start[0])


def _only(submap: Submap, images: Ints, tracks: Ints) -> Reconstruction:
    """The model with the poses of some images and the points of some tracks, in this order, without observations."""
    model, at = submap.model, submap.places_of_images(images)
    empty = Reconstruction.empty(
        model.cameras, [model.image_names[i] for i in at], model.image_camera_idx[at],
        _no_observations(len(images), len(tracks)),
    )  # fmt: skip
    return replace(
        empty, cam_from_world=model.cam_from_world[at], point_xyz=model.point_xyz[submap.places_of_tracks(tracks)]
    )


def _no_observations(num_images: int, num_tracks: int) -> Tracks:
    nothing = np.zeros(0, np.int64)
    return make_tracks(num_images, num_tracks, nothing, nothing, nothing, np.zeros((0, 2)))


def _well_known(a: Submap, b: Submap, images: Ints, tracks: Ints, a_from_b: Array) -> Ints:
    """Tracks that both know well, of those that agree: of each shared image in turn those with most observations."""
    xyz_a, xyz_b = (s.model.point_xyz[s.places_of_tracks(tracks)] for s in (a, b))
    support = np.minimum(*(s.num_observations[s.places_of_tracks(tracks)] for s in (a, b)))
    middle = a.model.centers[a.places_of_images(images)].mean(0)
    distance = np.linalg.norm(xyz_a - middle, axis=1)
    is_near = np.linalg.norm(similarity.apply(a_from_b, xyz_b) - xyz_a, axis=1) <= _NEAR_SHARE * distance
    order = np.lexsort((tracks, -support))
    ranked = tracks[order[(is_near & (support >= 3))[order]]]
    sees = [np.isin(ranked, a.part.track_idx[a.tracks_seen(i)]) for i in a.places_of_images(images)]
    turns = [iter(np.flatnonzero(mask).tolist()) for mask in sees]
    chosen: list[int] = []
    while turns and len(chosen) < NUM_POINTS:
        for turn in list(turns):
            new = next((n for n in turn if n not in chosen), None)
            if new is None:
                turns.remove(turn)
            elif len(chosen) < NUM_POINTS:
                chosen.append(new)
    return np.sort(ranked[chosen])


def joint_covariances(
    submap: Submap, mapper_of: Callable[[Submap], Mapper], commons: Sequence[Common]
) -> dict[tuple[int, int], Array]:
    """By their submaps, for each of several things that a submap has in common with others, the joint covariance
    (6 M + 3 P, 6 M + 3 P) of poses of the images and of the chosen points, in the gauge of
    :mod:`sfmapp.adjust.covariance`; nothing where more than a similarity is open.

    Args:
        mapper_of: a model's mapper, which knows what varied in it.
    """
    wanted = [common for common in commons if not common.reason]
    if not wanted:
        return {}
    mapper = mapper_of(submap)
    options, varying, noise = mapper.closing_options()
    graph = FactorGraph(
        submap.model, options, varying=varying, prior_cameras=mapper.prior_cameras, noise_px=noise.sigma_px
    )
    images = submap.places_of_images(np.unique(np.concatenate([common.image_idx for common in wanted])))
    points = submap.places_of_tracks(np.unique(np.concatenate([common.chosen for common in wanted])))
    joint = graph.marginal_covariance(images=images.tolist(), points=points.tolist())
    if not joint.is_determined or not np.isfinite(joint.matrix).all():
        return {}
    found = {}
    for common in wanted:
        image = np.searchsorted(images, submap.places_of_images(common.image_idx))
        point = np.searchsorted(points, submap.places_of_tracks(common.chosen))
        rows = [6 * image[:, None] + np.arange(6), 6 * len(images) + 3 * point[:, None] + np.arange(3)]
        at = np.concatenate([part.ravel() for part in rows])
        found[common.submaps] = joint.matrix[np.ix_(at, at)]
    return found


def fit_seam(
    common: Common, submaps: Sequence[Submap], covariances: Sequence[Array | None], options: MappingOptions
) -> Seam:
    """The similarity that what both submaps say of images and chosen points agrees with best, and what speaks against
    it.

    Args:
        covariances: of these in the first and in the second, as of :func:`joint_covariances`; None where open.
    """
    a, b = (submaps[n] for n in common.submaps)
    num = len(common.image_idx)
    seam = Seam(
        common.submaps, common.image_idx, np.zeros(num, bool), common.first_from_second, np.zeros(3), 1.0,
        np.zeros((7, 7)), np.nan, reason=common.reason,
    )  # fmt: skip
    known = [covariance for covariance in covariances if covariance is not None]
    if common.reason or len(known) < 2:
        return replace(seam, reason=common.reason or "how sure one of them is cannot be had")
    poses = [s.model.cam_from_world[s.places_of_images(common.image_idx)] for s in (a, b)]
    points = [s.model.point_xyz[s.places_of_tracks(common.chosen)] for s in (a, b)]
    middle = rigid3.center(poses[0]).mean(0)
    size = float(np.median(np.linalg.norm(points[0] - middle, axis=1)))
    is_off, sim = seam.is_off, common.first_from_second
    for _ in range(2):  # with all images, then without those that are elsewhere
        fit = _Fit(poses, points, known, ~is_off, middle, size)
        sim = fit.solved(sim)
        is_off = fit.elsewhere(sim)
    sigmas, num_off = fit.sigmas(sim), int(is_off.sum())
    seam = replace(
        seam, is_off=is_off, first_from_second=sim, middle=middle, size=size, information=fit.information(sim),
        sigmas=sigmas,
    )  # fmt: skip
    if num_off > MAX_OFF * num or num - num_off < MIN_SHARED:
        return replace(
            seam,
            reason=f"{num_off} of the {num} images that both have are elsewhere, {sigmas:.1f} standard deviations rms",
        )  # fmt: skip
    num_points, num_seen = _crossing(a, b, common, sim, options)
    seam = replace(seam, num_points=num_points, num_seen=num_seen)
    if num_seen < max(options.min_pose_inliers, MIN_SEEN * num_points):
        return replace(seam, reason=f"of {num_points} points that both sides see {num_seen} are where both see them")
    return seam


class _Fit:
    """Generalised least squares of a similarity between two worlds."""

    def __init__(
        self, poses: Sequence[Array], points: Sequence[Array], covariances: Sequence[Array], used: Bools,
        middle: Array, size: float,
    ) -> None:  # fmt: skip
        self._poses, self._points, self._covariances = poses, points, covariances
        self._middle, self._size = middle, size
        num = len(used)
        self._rows = np.concatenate([np.repeat(used, 6), np.ones(3 * len(points[0]), bool)])
        self._num_images = num

    def _difference(self, sim: Array) -> Array:
        """(N,) what the first says beyond the second."""
        moved = similarity.transform_poses(sim, self._poses[1])
        turned = rigid3.compose(self._poses[0], rigid3.inverse(moved))
        of_poses = np.concatenate([rigid3.log_so3(rigid3.rotation_matrix(turned)), turned[:, 4:]], 1)
        return np.concatenate([of_poses.ravel(), (self._points[0] - similarity.apply(sim, self._points[1])).ravel()])

    def _covariance(self, sim: Array) -> Array:
        """(N, N) of the difference."""
        rotation, scale = rigid3.rotation_matrix(sim), sim[7]
        num, size = self._num_images, len(self._rows)
        move = np.zeros((size, size))
        pose_rows = np.arange(6 * num)
        move[pose_rows, pose_rows] = np.tile(np.repeat([1.0, scale], 3), num)  # in the frame of the camera
        for start in range(6 * num, size, 3):
            move[start : start + 3, start : start + 3] = scale * rotation
        total: Array = self._covariances[0] + move @ self._covariances[1] @ move.T
        return total

    def _motion(self, sim: Array) -> Array:
        """(7, N) what turns, shifts and scales of the second do to it."""
        of_poses = similarity_motions(similarity.transform_poses(sim, self._poses[1]), self._middle, self._size)
        away = similarity.apply(sim, self._points[1]) - self._middle
        of_points = np.concatenate(
            [rigid3.skew(away), np.broadcast_to(self._size * np.eye(3), (len(away), 3, 3)), away[:, None]], 1
        )
        return np.concatenate([of_poses.reshape(7, -1), of_points.transpose(1, 0, 2).reshape(7, -1)], 1)

    def _weighed(self, sim: Array) -> tuple[Array, Array]:
        """Motion (7, R) and difference (R,) in standard deviations that are independent of each other."""
        rows = self._rows
        covariance = self._covariance(sim)[np.ix_(rows, rows)]
        scale = np.sqrt(np.diag(covariance))
        # what the two know together is never exact to a hundred thousandth
        root = np.linalg.cholesky(covariance / np.outer(scale, scale) + 1e-10 * np.eye(len(scale)))
        both = np.concatenate([self._motion(sim), self._difference(sim)[None]])[:, rows] / scale
        white = np.asarray(np.linalg.solve(root, both.T).T, np.float64)
        return white[:7], white[7]

    def solved(self, sim: Array) -> Array:
        """The best similarity, from a start."""
        for _ in range(10):
            motion, difference = self._weighed(sim)
            step = np.asarray(np.linalg.lstsq(motion.T, difference, rcond=None)[0], np.float64)
            sim = moved_about(sim, step, self._middle, self._size)
            if np.abs(step).max() < 1e-9:
                break
        return sim

    def information(self, sim: Array) -> Array:
        """(7, 7)."""
        motion, _ = self._weighed(sim)
        product: Array = motion @ motion.T
        return product

    def sigmas(self, sim: Array) -> float:
        """Rms of the difference in standard deviations."""
        _, difference = self._weighed(sim)
        return float(np.sqrt((difference**2).sum() / (len(difference) - 7)))

    def elsewhere(self, sim: Array) -> Bools:
        """(M,) bool: images that the two put at different places."""
        num = self._num_images
        off = self._difference(sim)[: 6 * num].reshape(num, 6)
        covariance = self._covariance(sim)
        blocks = np.stack([covariance[6 * n : 6 * n + 6, 6 * n : 6 * n + 6] for n in range(num)])
        sigmas = np.sqrt(np.einsum("ni,ni->n", off, np.linalg.solve(blocks, off[..., None])[..., 0]) / 6.0)
        turn = np.degrees(np.linalg.norm(off[:, :3], axis=1))
        shift = np.linalg.norm(
            similarity.apply(sim, rigid3.center(self._poses[1])) - rigid3.center(self._poses[0]), axis=1
        )
        is_off: Bools = (sigmas > OFF_SIGMAS) & ((shift > OFF_SHARE * self._size) | (turn > OFF_DEG))
        return is_off


def moved_about(sim: Array, step: Array, middle: Array, size: float) -> Array:
    """A similarity followed by a small one (7,): turn about the middle, shift in sizes, and logarithm of the scale."""
    rotation, scale = rigid3.exp_so3(step[:3]), float(np.exp(step[6]))
    small = similarity.from_parts(rotation, middle - scale * rotation @ middle + size * step[3:6], scale)
    return similarity.compose(small, sim)


def _crossing(a: Submap, b: Submap, common: Common, sim: Array, options: MappingOptions) -> tuple[int, int]:
    """Points of one that images which only the other has see, and how many of them are where these see them: most
    images do, in the direction that more do."""
    share: dict[int, float] = {}
    for holder, viewer, viewer_from_holder in ((a, b, similarity.inverse(sim)), (b, a, sim)):
        model, at = viewer.model.copy(), viewer.places_of_tracks(common.track_idx)
        model.point_xyz[:] = np.nan
        held = holder.model.point_xyz[holder.places_of_tracks(common.track_idx)]
        model.point_xyz[at] = similarity.apply(viewer_from_holder, held)
        length = model.errors_px()
        only = model.is_registered.copy()
        only[viewer.places_of_images(common.image_idx)] = False
        obs = only[model.tracks.obs_image_idx] & model.is_triangulated[model.tracks.obs_track_idx]
        track = model.tracks.obs_track_idx[obs]
        total = np.bincount(track, minlength=model.tracks.num_tracks)
        agreeing = np.bincount(track, weights=length[obs] <= options.max_pose_error_px, minlength=len(total))
        for t in np.flatnonzero(total).tolist():
            number = int(viewer.part.track_idx[t])
            share[number] = max(share.get(number, 0.0), agreeing[t] / total[t])
    return len(share), sum(value > 0.5 for value in share.values())
