"""The similarity between two models that share no image: from their common tracks and the verified pairs between them.

A link is a point of the scene that images of both models see: one track with observations on both sides, or two tracks
that a verified match of a pair between the models holds together. Where it is triangulated on one side, the similarity
tells where the images of the other side must see it. Few links are triangulated well on both sides, so hypotheses come
from three 3D-3D links as well as from one image that sees points of the other model (whose focal length its own model
knows) with a vote on the scale; all are scored, and the best refined, by reprojection on both sides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import bearings, pixels_to_rays
from sfmapp.camera.lens import across_seam, project
from sfmapp.geometry import resection, rigid3, similarity
from sfmapp.geometry.sidedness import triangles_kept
from sfmapp.mapping.mapper import Mapper
from sfmapp.mapping.merge import merge, num_linking_points
from sfmapp.mapping.near_views import missing_between
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.verified_pairs import AGREES, CONTRADICTS, pair_agreement
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# Each model is off by its own drift, which the adjustment of the union takes out: hypotheses are searched with this
# multiple of the tolerance for poses, and refined down to that tolerance.
SEARCH_FACTOR = 3.0
# With two fifths of the links right, 500 triples miss an all-right one with a probability of 1e-14; they are noisy.
NUM_TRIPLES = 500
# Images of each side that are tried as a bridge, those with most links first.
MAX_BRIDGES = 6
# Scales that agree within 5 %: depths near the edge of a model are good to a few per cent.
SCALE_TOLERANCE = 0.05
# Hypotheses that are refined: the minimal ones are noisy and their order with them.
NUM_REFINED = 3
# Links that must agree, as a share of all: the rest are mismatches, of which weak pairs have many.
MIN_LINK_SHARE = 0.4
# Truncated squared error of a link that agrees, of 1 at most.
AGREEING_COST = 0.5
# Where so large a share of the links that agree does so at another scale as well, nothing tells the scale: the models
# meet in a camera that turned on the spot. Of a rendered film all did, and the scale was found 10 times too large.
UNTOLD_SHARE, OTHER_SCALES = 0.95, (0.8, 1.25)
# Share of the matches which agree with each model that must still do so in the union: a wrong one is torn.
MIN_KEPT = 0.95


@dataclass(frozen=True)
class Joint:
    """How one model lies to another.

    Attributes:
        target_from_source: (8,) as in :mod:`sfmapp.geometry.similarity`.
        num_links: points of the scene that both see and at least one has triangulated.
        num_agreeing: links that the similarity brings within the tolerance for poses.
        reason: why it is not to be trusted, with the numbers; empty if it is.
    """

    target_from_source: Array
    num_links: int
    num_agreeing: int
    reason: str = ""


class _Checks(NamedTuple):
    """Points of one model beside the pixels of images of the other, in groups: one link in one direction.

    Attributes:
        group_ptr: (G + 1,) checks of each group. group_link: (G,) its link. group_is_forward: (G,) bool: points of the
            source in images of the target.
        xyz: (C, 3) points in the world of their model. xy: (C, 2) pixels.
        image_idx: (C,) the images; rotation: (C, 3, 3), translation: (C, 3), canonical: (C, 17) theirs.
        link_tracks: (L, 2) of each link, in the target and in the source.
        point_target, point_source: (B, 3) points of the links that are triangulated on both sides, in either world.
    """

    group_ptr: Ints
    group_link: Ints
    group_is_forward: Bools
    xyz: Array
    xy: Array
    image_idx: Ints
    rotation: Array
    translation: Array
    canonical: Array
    ray: Array
    link_tracks: Ints
    point_target: Array
    point_source: Array

    @property
    def num_links(self) -> int:
        """L."""
        return len(self.link_tracks)

    @property
    def is_forward(self) -> Bools:
        """(C,) bool."""
        return np.repeat(self.group_is_forward, np.diff(self.group_ptr))


def find_joint(
    target: Reconstruction, source: Reconstruction, correspondences: Correspondences, options: MappingOptions
) -> Joint:
    """The similarity between two models that most of their links agree with.

    Args:
        target, source: models over the same tracks; images that both hold count as the target's.
        correspondences: verified matches that the tracks were made of.
        options: thresholds. At least ``min_pose_inliers`` links must agree, and two fifths of all.
    """
    checks = _checks(target, source, correspondences)
    needed = max(options.min_pose_inliers, math.ceil(MIN_LINK_SHARE * checks.num_links))
    nothing = np.full(8, np.nan)
    if checks.num_links < needed:
        reason = f"they see {checks.num_links} points in common, at least {needed} are needed"
        return Joint(nothing, checks.num_links, 0, reason)
    tolerance_px = options.max_pose_error_px
    hypotheses = np.concatenate(
        [
            _from_triples(checks),
            *(_from_image(checks, i, target, source, SEARCH_FACTOR * tolerance_px) for i in _bridges(checks)),
        ]
    )
    hypotheses = hypotheses[np.isfinite(hypotheses).all(axis=1) & (hypotheses[:, 7] > 0)]
    if len(hypotheses) == 0:
        return Joint(nothing, checks.num_links, 0, "no three points and no image tell how they lie to each other")
    cost, _ = _scores(hypotheses, checks, SEARCH_FACTOR * tolerance_px)
    best = hypotheses[np.argsort(cost, kind="stable")[:NUM_REFINED]]
    refined = np.array([_refined(sim, checks, tolerance_px) for sim in best])
    cost, agreeing = _scores(refined, checks, tolerance_px)
    chosen = int(np.argmin(cost))
    num_agreeing, reason = int(agreeing[chosen]), ""
    if num_agreeing < needed:
        reason = f"{num_agreeing} of {checks.num_links} common points agree on one place, at least {needed} are needed"
    else:
        agrees = _agrees(refined[chosen], checks, tolerance_px)
        reason = _seen_from_behind(target, source, correspondences, checks.link_tracks[agrees])
        reason = reason or _at_another_scale(refined[chosen], num_agreeing, checks, (target, source), tolerance_px)
    return Joint(refined[chosen], checks.num_links, num_agreeing, reason)


def in_common_cameras(
    target: Reconstruction, source: Reconstruction, mapper_of: Callable[[Reconstruction], Mapper]
) -> tuple[Reconstruction, Reconstruction]:
    """Both models with the same intrinsics where they share a camera: those of the model with more images of it.

    Each has refined them for itself, and few images tell little of a lens. The models are left as they are; one that
    must change is a copy.
    """
    models = [target, source]
    counts = [
        np.bincount(model.image_camera_idx[model.is_registered], minlength=len(model.cameras)) for model in models
    ]
    better = [target.cameras[c] if counts[0][c] >= counts[1][c] else source.cameras[c] for c in range(len(counts[0]))]
    for n, model in enumerate(models):
        if any(counts[n][c] and model.cameras[c] is not camera for c, camera in enumerate(better)):
            models[n] = model.copy()
            mapper_of(models[n]).adjust_to_cameras(better)
    return models[0], models[1]


def unite(
    target: Reconstruction,
    source: Reconstruction,
    joint: Joint,
    mapper_of: Callable[[Reconstruction], Mapper],
    options: MappingOptions,
) -> Reconstruction:
    """Both models in the world of the target, adjusted as one: a new model."""
    union = merge(target, source, joint.target_from_source)
    mapper = mapper_of(union)
    # where the two meet, points are made anew of what both see, as far apart as the drift of each may have left it
    mapper.max_error_px = options.max_pose_error_px
    seen = union.tracks.obs_track_idx
    is_new = source.is_registered & ~target.is_registered
    of_new, of_old = is_new[union.tracks.obs_image_idx], target.is_registered[union.tracks.obs_image_idx]
    linking = np.intersect1d(seen[of_new], seen[of_old])
    union.point_xyz[linking] = np.nan
    union.obs_is_inlier[np.isin(seen, linking)] = False
    mapper.triangulate_images(np.flatnonzero(is_new).tolist())
    mapper.adjust_globally()
    mapper.finish()
    return union


def holds_together(
    union: Reconstruction,
    target: Reconstruction,
    source: Reconstruction,
    correspondences: Correspondences,
    options: MappingOptions,
) -> str:
    """What speaks against the union of two models, with the numbers: empty if it holds together.

    The pairs between the two must agree with it, and each model may be none the worse for it.

    Args:
        union: of the target and the source, adjusted.
        target, source: as they were before.
    """
    lost = (target.is_registered | source.is_registered) & ~union.is_registered
    sides = (target.is_registered, source.is_registered & ~target.is_registered)
    if lost.any():
        return f"adjusted as one, {int(lost.sum())} images lose their support"
    if (linking := num_linking_points(union, sides[1], sides[0])) < options.min_pose_inliers:
        return f"adjusted as one, {linking} common points are left"
    agreement = pair_agreement(union, correspondences)
    for model, side in zip((target, source), sides, strict=True):
        alone = pair_agreement(model, correspondences)
        kept, before = (
            int(found.num_agreeing[side[found.image_idx].all(axis=1)].sum()) for found in (agreement, alone)
        )
        if kept < MIN_KEPT * before:
            return f"adjusted as one, {kept} of the {before} matches that agree with one of them do so still"
    first, second = agreement.image_idx.T
    between = (sides[0][first] & sides[1][second]) | (sides[1][first] & sides[0][second])
    matches, agreeing, shared = (
        int(count[between].sum()) for count in (agreement.num_matches, agreement.num_agreeing, agreement.num_shared)
    )
    if not (agreeing > AGREES * matches and shared > CONTRADICTS * agreeing):
        return f"adjusted as one, {agreeing} of {matches} verified matches between them agree, {shared} support a point"
    pairs, visible, shared = missing_between(union, *sides, correspondences)
    if pairs:
        return f"adjusted as one, {pairs} pairs are side by side and share {shared} of the {visible} points in view"
    return ""


# ---------------------------------------------------------------------- links


def _checks(target: Reconstruction, source: Reconstruction, correspondences: Correspondences) -> _Checks:
    sides = (target.is_registered, source.is_registered & ~target.is_registered)
    track_target, track_source = _links(target, sides, correspondences)
    useful = target.is_triangulated[track_target] | source.is_triangulated[track_source]
    track_target, track_source = track_target[useful], track_source[useful]
    both = target.is_triangulated[track_target] & source.is_triangulated[track_source]
    parts = []
    for holder, holder_track, viewer, viewer_track, viewer_side in (
        (source, track_source, target, track_target, sides[0]),
        (target, track_target, source, track_source, sides[1]),
    ):
        links = np.flatnonzero(holder.is_triangulated[holder_track])
        obs, link = _observations(viewer, viewer_track[links], viewer_side)
        parts.append((links[link], holder.point_xyz[holder_track[links[link]]], viewer, obs))
    counts = [np.bincount(link, minlength=len(track_target)) for link, *_ in parts]
    group_link = [np.flatnonzero(count) for count in counts]
    sizes = np.concatenate([count[link] for count, link in zip(counts, group_link, strict=True)])
    camera = [viewer.image_camera_idx[viewer.tracks.obs_image_idx[obs]] for _, _, viewer, obs in parts]
    image = [viewer.tracks.obs_image_idx[obs] for _, _, viewer, obs in parts]
    pose = np.concatenate([viewer.cam_from_world[i] for (_, _, viewer, _), i in zip(parts, image, strict=True)])
    rows = [viewer.canonical_cameras() for _, _, viewer, _ in parts]
    return _Checks(
        np.concatenate([[0], np.cumsum(sizes)]), np.concatenate(group_link),
        np.repeat([True, False], [len(link) for link in group_link]), np.concatenate([xyz for _, xyz, _, _ in parts]),
        np.concatenate([viewer.tracks.obs_xy[obs] for _, _, viewer, obs in parts]),
        np.concatenate(image).astype(np.int64), rigid3.rotation_matrix(pose), np.ascontiguousarray(pose[:, 4:]),
        np.concatenate([row[c] for row, c in zip(rows, camera, strict=True)]),
        np.concatenate([
            _coarse_rays(viewer, c, viewer.tracks.obs_xy[obs])
            for (_, _, viewer, obs), c in zip(parts, camera, strict=True)
        ]),
        np.stack([track_target, track_source], 1),
        target.point_xyz[track_target[both]], source.point_xyz[track_source[both]],
    )  # fmt: skip


def _coarse_rays(model: Reconstruction, camera_idx: NDArray[np.int32], xy: Array) -> Array:
    """(N, 3) rays of pixels. The lens is left out where it sees no farther than a pinhole: a vote is coarse, and the
    refinement is not."""
    canonical = model.canonical_cameras()[camera_idx]
    rays = np.ones((len(xy), 3))
    rays[:, :2] = (xy - canonical[:, 2:4]) / canonical[:, :2]
    for k in np.unique(camera_idx):
        if model.cameras[k].is_wide:
            rays[camera_idx == k] = pixels_to_rays(model.cameras[k], xy[camera_idx == k])
    return rays


def _links(model: Reconstruction, sides: tuple[Bools, Bools], correspondences: Correspondences) -> tuple[Ints, Ints]:
    """(L,) tracks on the first side and (L,) on the second that are one point of the scene, sorted."""
    tracks = model.tracks
    seen = np.zeros((2, tracks.num_tracks), bool)
    for side in range(2):
        seen[side, tracks.obs_track_idx[sides[side][tracks.obs_image_idx]]] = True
    shared = np.flatnonzero(seen.all(axis=0))
    between = [tracks.obs_track_idx[obs] for obs in _matches_between(model, sides, correspondences)]
    links = np.unique(np.concatenate([np.stack([shared, shared], 1), *between]).astype(np.int64), axis=0)
    return links[:, 0], links[:, 1]


def _matches_between(
    model: Reconstruction, sides: tuple[Bools, Bools], correspondences: Correspondences
) -> Iterator[Ints]:
    """Of each verified pair between the sides the observations (K, 2) that match, on the first side and on the
    second."""
    pairs = correspondences.pair_image_idx
    for a, b in ((0, 1), (1, 0)):
        for p in np.flatnonzero(sides[a][pairs[:, 0]] & sides[b][pairs[:, 1]]):
            matches = correspondences.matches_of_pair(int(p))
            obs = np.stack([_observed(model, int(pairs[p, s]), matches[:, s]) for s in (0, 1)], 1)
            yield obs[(obs >= 0).all(axis=1)][:, [a, b]]


def _observed(model: Reconstruction, image_idx: int, feature_idx: NDArray[np.int32]) -> Ints:
    """(K,) observations of keypoints of an image, -1 where they are in no track."""
    tracks = model.tracks
    obs = tracks.observations_of_image(image_idx)
    features = tracks.obs_feature_idx[obs]
    obs_of = np.full(1 + max(features.max(initial=0), feature_idx.max(initial=0)), -1, np.int64)
    obs_of[features] = obs
    return obs_of[feature_idx]


def _observations(model: Reconstruction, track: Ints, side: Bools) -> tuple[Ints, Ints]:
    """Observations (C,) of tracks (K,) by images of a side, in their order, and (C,) whose they are."""
    ptr = model.tracks.track_ptr
    length = ptr[track + 1] - ptr[track]
    owner = np.repeat(np.arange(len(track)), length)
    obs = np.arange(len(owner)) - np.repeat(np.cumsum(length) - length, length) + np.repeat(ptr[track], length)
    kept = side[model.tracks.obs_image_idx[obs]]
    return obs[kept], owner[kept]


# ------------------------------------------------------------------ same side


def _agrees(sim: Array, checks: _Checks, tolerance_px: float) -> Bools:
    """(L,) links that agree with a similarity, as :func:`_score_all` counts them."""
    error = np.nan_to_num((_residuals(sim, checks) ** 2).sum(1) / tolerance_px**2, nan=1.0)
    mean = np.add.reduceat(np.minimum(error, 1.0), checks.group_ptr[:-1]) / np.diff(checks.group_ptr)
    cost = np.ones(checks.num_links)
    np.minimum.at(cost, checks.group_link, mean)
    agrees: Bools = cost < AGREEING_COST
    return agrees


def _seen_from_behind(
    target: Reconstruction, source: Reconstruction, correspondences: Correspondences, link_tracks: Ints
) -> str:
    """Why links (K, 2) that agree with a similarity are of something and of its mirror image; empty if they are not.

    A mirrored group of photographs fits a plane from its back, by all its points; only that nobody can see through it
    speaks against that. Right views keep triangles, mirrored ones turn as many: chance lies between.
    """
    sides = (target.is_registered, source.is_registered & ~target.is_registered)
    tracks, num = target.tracks, target.tracks.num_tracks
    agreeing = link_tracks @ [num, 1]
    kept = total = points = 0
    for obs in _matches_between(target, sides, correspondences):
        obs = obs[np.isin(tracks.obs_track_idx[obs].astype(np.int64) @ [num, 1], agreeing)]
        same, all_of_pair = triangles_kept(tracks.obs_xy[obs[:, 0]], tracks.obs_xy[obs[:, 1]])
        kept, total, points = kept + same, total + all_of_pair, points + len(obs)
    # neighbouring triangles share their points: as many of them as there are points are independent at most
    if total and kept / total < 0.5 - 0.5 / math.sqrt(points):
        return f"the one is seen mirrored by the other: {kept} of {total} triangles of common points keep their side"
    return ""


def _at_another_scale(
    sim: Array, num_agreeing: int, checks: _Checks, models: tuple[Reconstruction, Reconstruction], tolerance_px: float
) -> str:
    """Why the scale of a similarity from source to target is not to be trusted; empty if links tell it.

    Scaled about the centre of an image, what that image sees stays where it is.
    """
    target, source = models
    others = []
    for image_idx in _bridges(checks):
        if target.is_registered[image_idx]:
            center = target.centers[image_idx]
        else:
            center = sim[7] * rigid3.rotation_matrix(sim[:7]) @ source.centers[image_idx] + sim[4:7]
        for factor in OTHER_SCALES:
            others.append(np.concatenate([sim[:4], center + factor * (sim[4:7] - center), [factor * sim[7]]]))
    most, change = int(_scores(np.array(others), checks, tolerance_px)[1].max()), round(100 - 100 * OTHER_SCALES[0])
    if most < UNTOLD_SHARE * num_agreeing:
        return ""
    return f"nothing tells the scale between them: {most} of {num_agreeing} common points agree at one {change} % off"


# ----------------------------------------------------------------- hypotheses


def _from_triples(checks: _Checks) -> Array:
    """(N, 8) similarities through three links that both sides have triangulated."""
    count = len(checks.point_target)
    if count < 3:
        return np.zeros((0, 8))
    # the seed is a constant: the outcome depends on the models alone
    triples = np.random.default_rng([0, count]).integers(0, count, (NUM_TRIPLES, 3))
    a, b = checks.point_source[triples], checks.point_target[triples]
    mean_a, mean_b = a.mean(axis=1, keepdims=True), b.mean(axis=1, keepdims=True)
    a, b = a - mean_a, b - mean_b
    variance = (a**2).sum(axis=(1, 2))
    u, d, vt = np.linalg.svd(np.einsum("nki,nkj->nij", b, a))
    sign = np.ones_like(d)
    sign[:, 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    # of points on a line, or one point twice, there is no rotation
    good = (d[:, 1] > 1e-6 * d[:, 0]) & (variance > 0)
    scale = (d * sign).sum(axis=1)[good] / variance[good]
    rotation = ((u * sign[:, None, :]) @ vt)[good]
    translation = mean_b[good, 0] - scale[:, None] * np.einsum("nij,nj->ni", rotation, mean_a[good, 0])
    return np.concatenate([rigid3.from_matrix(rotation, translation), scale[:, None]], axis=1)


def _bridges(checks: _Checks) -> list[int]:
    """Images that see most points of the other model, of both sides."""
    forward, bridges = checks.is_forward, []
    for direction in (True, False):
        image, count = np.unique(checks.image_idx[forward == direction], return_counts=True)
        bridges += image[np.argsort(-count, kind="stable")[:MAX_BRIDGES]].tolist()
    return bridges


def _from_image(
    checks: _Checks, image_idx: int, target: Reconstruction, source: Reconstruction, tolerance_px: float
) -> Array:
    """(N, 8) with N at most 1: the similarity through an image that sees points of the other model."""
    is_own = target.is_registered[image_idx]  # an image of the target, which sees points of the source
    own = target if is_own else source
    mine = (checks.image_idx == image_idx) & (checks.is_forward == is_own)
    camera = own.cameras[own.image_camera_idx[image_idx]]
    (points,) = bearings([camera], [checks.xy[mine]])
    # a bridge that has to be searched for longer is none
    found = resection.estimate_pose(
        checks.xyz[mine], points, tolerance_px / camera.focal, confidence=0.99, max_iterations=500
    )
    if found is None:
        return np.zeros((0, 8))
    # through the frame of the image: what it sees of its own world, scaled, stands in the other one
    own_pose = own.cam_from_world[image_idx]
    center = rigid3.center(found.cam_from_world)
    to_other = rigid3.rotation_matrix(found.cam_from_world).T @ rigid3.rotation_matrix(own_pose)
    own_center = rigid3.center(own_pose)
    scale = _voted_scale(checks, checks.is_forward != is_own, center, to_other, own_center)
    if scale is None:
        return np.zeros((0, 8))
    other_from_own = similarity.from_parts(to_other, center - scale * to_other @ own_center, scale)
    return (similarity.inverse(other_from_own) if is_own else other_from_own)[None]


def _voted_scale(checks: _Checks, chosen: Bools, center: Array, to_other: Array, own_center: Array) -> float | None:
    """The scale at which most own points appear where images of the other model see them.

    A point at ``center + s d`` appears along the ray x of an image where ``x`` is parallel to ``R (center + s d) + t``.
    """
    if not chosen.any():
        return None
    direction = (checks.xyz[chosen] - own_center) @ to_other.T
    rotation = checks.rotation[chosen]
    offset = np.einsum("nij,j->ni", rotation, center) + checks.translation[chosen]
    ray = checks.ray[chosen]
    a, b = np.cross(ray, np.einsum("nij,nj->ni", rotation, direction)), np.cross(ray, offset)
    with np.errstate(divide="ignore", invalid="ignore"):
        votes = -(a * b).sum(axis=1) / (a * a).sum(axis=1)
    votes = np.sort(np.log(votes[np.isfinite(votes) & (votes > 0)]))
    if len(votes) == 0:
        return None
    ends = np.searchsorted(votes, votes + SCALE_TOLERANCE, side="right")
    begin = int(np.argmax(ends - np.arange(len(votes))))
    return float(np.exp(np.median(votes[begin : ends[begin]])))


# ---------------------------------------------------------- score and refine


def _scores(sims: Array, checks: _Checks, tolerance_px: float) -> tuple[Array, Ints]:
    """(H,) truncated squared error, summed over the links, and (H,) links that agree with each similarity."""
    cost, agreeing = np.empty(len(sims)), np.empty(len(sims), np.int64)
    rotation, translation = rigid3.rotation_matrix(sims), np.ascontiguousarray(sims[:, 4:7])
    scale = np.ascontiguousarray(sims[:, 7])
    _score_all(rotation, translation, scale, checks, tolerance_px**2, cost, agreeing)
    return cost, agreeing


def _refined(sim: Array, checks: _Checks, tolerance_px: float) -> Array:
    """A similarity after damped least squares over the reprojection errors on both sides, weighted after Cauchy.

    The scale of the weights shrinks from that of the search to that of poses. Seven unknowns: the Jacobian is made of
    differences.
    """
    extent = float(np.linalg.norm(checks.xyz[checks.is_forward].std(axis=0)) * sim[7]) if checks.is_forward.any() else 0
    extent = extent or float(np.linalg.norm(checks.xyz.std(axis=0))) or 1.0
    units = np.array([1.0, 1.0, 1.0, extent, extent, extent, 1.0])
    for tolerance in (SEARCH_FACTOR * tolerance_px, tolerance_px, 0.5 * tolerance_px):
        residuals = _residuals(sim, checks)
        for _ in range(10):
            squared = (residuals**2).sum(axis=1)
            with np.errstate(invalid="ignore"):
                weight = np.where(np.isfinite(squared), 1.0 / (1.0 + squared / (0.5 * tolerance) ** 2), 0.0)
            jacobian = np.stack(
                [(_residuals(_moved(sim, 1e-6 * step * units), checks) - residuals) / 1e-6 for step in np.eye(7)], 2
            )
            jacobian, seen = np.where(np.isfinite(jacobian), jacobian, 0.0), np.where(weight > 0, weight, 0.0)
            filled = np.where(np.isfinite(residuals), residuals, 0.0)
            normal = np.einsum("nki,nkj,n->ij", jacobian, jacobian, seen)
            gradient = np.einsum("nki,nk,n->i", jacobian, filled, seen)
            damped = normal + 1e-6 * np.diag(np.diag(normal)) + 1e-12 * np.eye(7)
            step = -np.linalg.solve(damped, gradient)
            moved = _moved(sim, step * units)
            new = _residuals(moved, checks)
            if not _robust_cost(new, tolerance) < _robust_cost(residuals, tolerance):
                break
            sim, residuals = moved, new
            if np.abs(step).max() < 1e-7:
                break
    return sim


def _robust_cost(residuals: Array, tolerance_px: float) -> float:
    squared = (residuals**2).sum(axis=1) / (0.5 * tolerance_px) ** 2
    return float(np.log1p(np.where(np.isfinite(squared), np.minimum(squared, 1e6), 1e6)).sum())


def _moved(sim: Array, step: Array) -> Array:
    """A similarity changed by a turn, a shift and a log of scale, in the world of the target."""
    rotation = rigid3.exp_so3(step[:3]) @ rigid3.rotation_matrix(sim)
    with np.errstate(over="ignore"):  # a scale that nothing tells may go anywhere: infinity is no better than before
        return similarity.from_parts(rotation, sim[4:7] + step[3:6], float(sim[7] * np.exp(step[6])))


def _residuals(sim: Array, checks: _Checks) -> Array:
    """(C, 2) projected minus observed pixels, NaN behind a camera."""
    out = np.empty_like(checks.xy)
    _residuals_of(rigid3.rotation_matrix(sim), sim[4:7].copy(), float(sim[7]), checks.is_forward, checks, out)
    return out


@numba.njit(cache=True, nogil=True)
def _residual(
    r: Array, t: Array, s: float, forward: bool, xyz: Array, xy: Array, rotation: Array, translation: Array,
    canonical: Array,
) -> tuple[float, float]:  # fmt: skip
    """Projected minus observed pixel of a point that the similarity (r, t, s), or its inverse, carries over."""
    if forward:
        x = s * (r[0, 0] * xyz[0] + r[0, 1] * xyz[1] + r[0, 2] * xyz[2]) + t[0]
        y = s * (r[1, 0] * xyz[0] + r[1, 1] * xyz[1] + r[1, 2] * xyz[2]) + t[1]
        z = s * (r[2, 0] * xyz[0] + r[2, 1] * xyz[1] + r[2, 2] * xyz[2]) + t[2]
    else:
        d0, d1, d2 = (xyz[0] - t[0]) / s, (xyz[1] - t[1]) / s, (xyz[2] - t[2]) / s
        x = r[0, 0] * d0 + r[1, 0] * d1 + r[2, 0] * d2
        y = r[0, 1] * d0 + r[1, 1] * d1 + r[2, 1] * d2
        z = r[0, 2] * d0 + r[1, 2] * d1 + r[2, 2] * d2
    depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
    right = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
    down = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
    u, v = project(canonical, right, down, depth)
    return across_seam(canonical, u - xy[0]), v - xy[1]


@numba.njit(cache=True, nogil=True)
def _residuals_of(r: Array, t: Array, s: float, is_forward: Bools, checks: _Checks, out: Array) -> None:
    """Fill out (C, 2)."""
    xyz, xy, rotation, translation = checks.xyz, checks.xy, checks.rotation, checks.translation
    canonical = checks.canonical
    for c in range(len(xyz)):
        out[c, 0], out[c, 1] = _residual(
            r, t, s, is_forward[c], xyz[c], xy[c], rotation[c], translation[c], canonical[c]
        )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _score_all(
    rs: Array, ts: Array, scales: Array, checks: _Checks, tolerance2: float, cost: Array, agreeing: Ints
) -> None:
    """Fill cost (H,) and agreeing (H,). A link costs the mean over its images, in the direction where that is less: a
    point that its own model holds badly in depth is still right where the other model has it.
    """
    group_ptr, group_link, group_is_forward = checks.group_ptr, checks.group_link, checks.group_is_forward
    xyz, xy, rotation, translation = checks.xyz, checks.xy, checks.rotation, checks.translation
    canonical, link_cost = checks.canonical, np.empty(len(checks.link_tracks))
    for h in range(len(scales)):
        link_cost[:] = 1.0
        for g in range(len(group_link)):
            total = 0.0
            for c in range(group_ptr[g], group_ptr[g + 1]):
                du, dv = _residual(
                    rs[h], ts[h], scales[h], group_is_forward[g], xyz[c], xy[c], rotation[c], translation[c],
                    canonical[c],
                )  # fmt: skip
                error = (du * du + dv * dv) / tolerance2
                total += error if error < 1.0 else 1.0
            mean = total / (group_ptr[g + 1] - group_ptr[g])
            if mean < link_cost[group_link[g]]:
                link_cost[group_link[g]] = mean
        cost[h] = link_cost.sum()
        count = 0
        for value in link_cost:
            if value < AGREEING_COST:
                count += 1
        agreeing[h] = count


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    from sfmapp.scene.synthetic import make_scene, true_correspondences

    scene = make_scene(0, 6, 120)
    target, source = scene.observed.copy(), scene.observed.copy()
    target.cam_from_world[3:] = source.cam_from_world[:3] = np.nan
    # the steps of find_joint that run kernels
    checks = _checks(target, source, true_correspondences(scene, min_matches=1))
    hypotheses = [_from_triples(checks), *(_from_image(checks, i, target, source, 4.0) for i in _bridges(checks))]
    _scores(np.concatenate(hypotheses), checks, 4.0)
    _refined(hypotheses[0][0], checks, 4.0)
