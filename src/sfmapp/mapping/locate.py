"""Where a photograph was taken, in a model that is finished and stays as it is.

The photograph is matched with photographs of the model, and its pose estimated from the points that these matches tell.
A pose is believed only where nothing speaks against it: not another place that other matches put it at, unless these
are clearly weaker, and not photographs beside it of whose points it shows next to none.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.covariance import moved_to_gauge
from sfmapp.adjust.gauge import moves_into_gauge, similarity_basis
from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.pose import refine_pose
from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.geometry.noise import sigma_of_lengths
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.mapping import structure
from sfmapp.mapping.attach import KnownModel, NewPhotograph, attach
from sfmapp.mapping.mapper import Mapper
from sfmapp.mapping.near_views import missing_between
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.register import Registration, register_image
from sfmapp.mapping.verified_pairs import CLEARLY, pair_agreement, pair_strengths
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.pairs import PairOptions, image_vector, learn_vocabulary
from sfmapp.matching.stage import join_pairs, match_images
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.features import Features
from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

STAGE = "locating"
# Photographs of the model around a new one that its covariance is computed with: beyond, they say next to nothing.
MAX_AROUND = 50
# Other places that are looked at: of things that are there more often any one tells as much.
_MAX_RIVALS = 3


@dataclass(frozen=True)
class LocateOptions:
    """Options of the stages that locating goes through."""

    matching: MatchingOptions
    mapping: MappingOptions
    adjust: AdjustOptions
    seed: int = 0
    threads: int = 1


@dataclass(frozen=True)
class Located:
    """Where a photograph was taken, or why that is not known.

    Attributes:
        name: of the photograph.
        reason: why it is not located, with the numbers; empty if it is.
        cam_from_world: (7,) in the model's world; NaN where it is not located.
        covariance: (6, 6) over rotation w (radians) and translation v of ``x_cam <- exp(w) x_cam + v``: by the noise of
            its keypoints and by what is not known of points and cameras of the model around it, whose own poses, by
            inner constraints (:mod:`sfmapp.adjust.covariance`), are the frame.
        camera: with the focal length that was found, if that was searched.
        track_idx: (M,) points of the model that agree. xy: (M, 2) pixels that show them.
        num_correspondences: points that its matches tell.
        images: photographs of the model that it was matched with, most matches first, and num_matches of each.
        num_tried: photographs of the model that were compared with it.
        rms_px: of the residuals of the points that agree.
        rivals: poses (7,) at which clearly weaker matches put it as well.
        told_focal: focal length by these points alone, if it were free, and its standard deviation, in pixels.
    """

    name: str
    reason: str
    cam_from_world: Array
    covariance: Array
    camera: Camera
    track_idx: Ints
    xy: Array
    num_correspondences: int = 0
    images: tuple[str, ...] = ()
    num_matches: tuple[int, ...] = ()
    num_tried: int = 0
    rms_px: float = 0.0
    rivals: tuple[Array, ...] = ()
    told_focal: tuple[float, float] | None = None

    def refused(self, reason: str) -> Located:
        """The same without a pose."""
        return replace(self, reason=reason)

    @property
    def is_located(self) -> bool:
        """Whether there is a pose."""
        return not self.reason

    @property
    def center_covariance(self) -> Array:
        """(3, 3) of the camera's centre, in the model's world."""
        return rigid3.center_covariance(self.cam_from_world, self.covariance)


@dataclass(frozen=True)
class _Place:
    """A pose that some of the pairs agree with.

    Attributes:
        model: the model with the photograph in it, registered. registration: how that came.
        strength: of the strongest pair that agrees.
        against: (K,) positions of pairs that contradict it. nearest: the image of the strongest pair.
    """

    model: Reconstruction
    registration: Registration
    strength: float
    against: Ints
    nearest: int


def locate_photograph(
    known: KnownModel, photograph: NewPhotograph, candidates: Sequence[int], options: LocateOptions, events: Events,
    pool: Executor,
) -> Located:  # fmt: skip
    """Find where one photograph was taken.

    Args:
        known: the model. photograph: with its features.
        candidates: images of the model that it is matched with.
        options: of matching and mapping; those that the model was made with fit it best.

    Raises:
        InterruptedRunError: a stop was asked for.
    """
    matches = _matched(known, photograph, candidates, options, events)
    query = len(known.model.image_names)
    lost = Located(
        photograph.name, "", np.full(7, np.nan), np.full((6, 6), np.nan), photograph.camera, np.zeros(0, np.int64),
        np.zeros((0, 2)), num_tried=len(candidates),
    )  # fmt: skip
    order = np.argsort(-matches.num_inliers, kind="stable")
    order = order[matches.num_inliers[order] > 0]
    lost = replace(
        lost,
        images=tuple(known.model.image_names[i] for i in matches.pair_image_idx[order, 0]),
        num_matches=tuple(int(n) for n in matches.num_inliers[order]),
    )
    best = _place(known, photograph, matches, options)
    if isinstance(best, Registration):
        return replace(lost, reason=best.reason, num_correspondences=best.num_correspondences)
    lost = replace(lost, num_correspondences=best.registration.num_correspondences)
    rivals = _rivals(known, photograph, matches, best, options)
    if rivals and (reason := _as_strong(known, matches, best, rivals[0])):
        return replace(lost, reason=reason)
    is_new = np.arange(query + 1) == query
    num, visible, shared = missing_between(best.model, is_new, ~is_new, matches)
    if num:
        name = known.model.image_names[best.nearest]
        reason = (
            f"where its matches put it, beside {name}, it should show {visible} points that photographs beside it "
            f"show, and shows {shared}: it looks alike there"
        )
        return replace(lost, reason=reason)
    lost = replace(lost, rivals=tuple(rival.model.cam_from_world[query] for rival in rivals))
    return _adjusted(known, lost, best.model, options, events, pool)


def find_candidates(
    known: KnownModel, features: Sequence[Features], options: PairOptions, seed: int
) -> list[list[int]]:
    """For each photograph the images of a model that it is to be matched with: all of a small model, otherwise those
    that look most like it.

    Args:
        features: of the photographs. options: of the pairs of a reconstruction.
    """
    num = len(known.model.image_names)
    if num <= options.exhaustive_limit:
        return [list(range(num))] * len(features)
    words = learn_vocabulary(known.features, options, seed=seed)
    vectors = np.array([
        image_vector(one.whole_numbers(options.num_query_features), words) for one in known.features
    ])  # fmt: skip
    found = []
    for one in features:
        alike = vectors @ image_vector(one.whole_numbers(options.num_query_features), words)
        found.append(np.sort(np.argsort(-alike, kind="stable")[: options.num_neighbors]).tolist())
    return found


def _matched(
    known: KnownModel, photograph: NewPhotograph, candidates: Sequence[int], options: LocateOptions, events: Events
) -> Correspondences:
    """Verified matches with some images of the model: pairs (image of the model, number of images)."""
    model, query = known.model, len(candidates)
    cameras = [model.cameras[model.image_camera_idx[i]] for i in candidates]
    records = [
        ImageRecord(name, Path(name), camera.width, camera.height, camera_idx=k)
        for k, (name, camera) in enumerate(
            zip([*(model.image_names[i] for i in candidates), photograph.name], [*cameras, photograph.camera],
                strict=True)
        )
    ]  # fmt: skip
    pairs = np.array([(k, query) for k in range(query)], np.int32).reshape(-1, 2)
    features = [*(known.features[i] for i in candidates), photograph.features]
    found, _ = match_images(
        ImageSet(tuple(records), (*cameras, photograph.camera)), features, pairs, options.matching, seed=options.seed,
        threads=options.threads, events=Events(),
    )  # fmt: skip
    events.raise_if_cancelled()
    renamed = np.stack([np.asarray(candidates, np.int32), np.full(query, len(model.image_names), np.int32)], 1)
    return replace(found, pair_image_idx=renamed.reshape(-1, 2))


def _place(
    known: KnownModel, photograph: NewPhotograph, matches: Correspondences, options: LocateOptions
) -> _Place | Registration:
    """The pose that most matches tell, from those pairs that agree with it; the failure if there is none."""
    joined = attach(known, photograph, matches)
    found = _registered(known, photograph, joined, options)
    if found.cam_from_world is None:
        return found
    agreement = pair_agreement(joined, matches)
    of_query = (agreement.image_idx == len(known.model.image_names)).any(1)
    agreeing = agreement.pair_idx[of_query & agreement.agrees]
    against = agreement.pair_idx[of_query & agreement.contradicts]
    if len(against):  # what belongs elsewhere has no say in where it is here
        joined = attach(known, photograph, matches.without(against))
        found = _registered(known, photograph, joined, options)
        if found.cam_from_world is None:
            return found
    strengths = pair_strengths(joined, matches)
    if not len(agreeing):
        return replace(found, cam_from_world=None, reason="none of its pairs agrees with the pose of its points")
    nearest = agreeing[np.argmax(strengths[agreeing])]
    return _Place(joined, found, float(strengths[nearest]), against, int(matches.pair_image_idx[nearest, 0]))


def _registered(
    known: KnownModel, photograph: NewPhotograph, joined: Reconstruction, options: LocateOptions
) -> Registration:
    """Register the last image of a model, in place."""
    query = len(joined.image_names) - 1
    mapping = options.mapping
    # room for what is not known of the points
    limit = min(3.0 * _limit_px(known, options), mapping.max_pose_error_px)
    camera, is_new = photograph.camera, photograph.camera_idx is None
    search_focal = is_new and camera.focal_source == "default" and not camera.is_fixed
    # of a camera that the model has not the focal length is as sure as its prior
    focal_sigma = np.inf if search_focal else (camera.focal_sigma or 0.0) if is_new and not camera.is_fixed else 0.0
    found = register_image(
        joined, query, mapping, search_focal=search_focal,
        max_error_px=mapping.max_pose_error_px if search_focal else limit,
    )  # fmt: skip
    if found.cam_from_world is None:
        return found
    camera = joined.cameras[joined.image_camera_idx[query]]
    if found.focal_px is not None:
        camera = camera.with_focal(found.focal_px)
        joined.cameras[joined.image_camera_idx[query]] = camera
    obs = joined.tracks.observations_of_image(query)
    refined = refine_pose(
        camera.canonical, found.cam_from_world, joined.point_xyz[joined.tracks.obs_track_idx[obs]],
        joined.tracks.obs_xy[obs], scale_px=0.5 * limit, inlier_px=limit,
        focal_sigma_px=focal_sigma,
    )  # fmt: skip
    joined.cam_from_world[query] = refined.cam_from_world
    joined.obs_is_inlier[obs] = refined.is_inlier
    if focal_sigma > 0.0:
        joined.cameras[joined.image_camera_idx[query]] = camera.with_focal(float(refined.canonical[:2].mean()))
    num_inliers = int(refined.is_inlier.sum())
    if num_inliers < mapping.min_pose_inliers:
        reason = f"{num_inliers} points agree with its pose to {limit:.1f} px, {mapping.min_pose_inliers} are needed"
        joined.cam_from_world[query] = np.nan
        return replace(found, cam_from_world=None, num_inliers=num_inliers, reason=reason)
    return replace(found, cam_from_world=refined.cam_from_world, num_inliers=num_inliers)


def _limit_px(known: KnownModel, options: LocateOptions) -> float:
    """Largest residual of an observation that supports its point in the model."""
    mapping, scale = options.mapping, structure.residual_scale_px(known.model, 0.1)
    return float(np.clip(mapping.max_reprojection_error_sigmas * scale, 1.0, mapping.max_reprojection_error_px))


def _rivals(
    known: KnownModel, photograph: NewPhotograph, matches: Correspondences, best: _Place, options: LocateOptions
) -> list[_Place]:
    """Other places at which pairs that contradict the best one put a photograph, those of most points first."""
    found: list[_Place] = []
    left = best.against
    while len(left) and len(found) < _MAX_RIVALS:
        others = np.setdiff1d(np.arange(matches.num_pairs), left)
        place = _place(known, photograph, matches.without(others), options)
        if isinstance(place, Registration):
            break
        found.append(place)
        left = np.intersect1d(left, place.against)
    return found


def _as_strong(known: KnownModel, matches: Correspondences, best: _Place, rival: _Place) -> str:
    """Why a place is not believed although its points agree: what puts the photograph elsewhere is not clearly weaker;
    empty if it is."""
    there = float(pair_strengths(best.model, matches)[best.against].max())
    if best.strength >= CLEARLY * there:
        return ""
    names = known.model.image_names
    return (
        f"two places fit: {best.registration.num_inliers} points beside {names[best.nearest]} and "
        f"{rival.registration.num_inliers} beside {names[rival.nearest]}, matched over {100 * best.strength:.0f} and "
        f"{100 * there:.0f} % of the picture"
    )


def _adjusted(
    known: KnownModel, found: Located, joined: Reconstruction, options: LocateOptions, events: Events, pool: Executor
) -> Located:
    """A photograph adjusted together with the part of the model around it, and how sure its pose is.

    Points of few photographs are hardly surer than one more keypoint: a pose that takes them for exact is worse than
    its sigmas. What the model would change by is not kept.
    """
    query = len(joined.image_names) - 1
    around = _around(joined, query)
    stored = around.copy()
    priors = [*known.prior_cameras, *joined.cameras[len(known.prior_cameras) :]]
    mapper = Mapper(
        reconstruction=around, correspondences=join_pairs(np.zeros((0, 2), np.int32), []), options=options.mapping,
        adjust_options=options.adjust, events=events, pool=pool, prior_cameras=priors, locked=np.zeros(query + 1, bool),
    )  # fmt: skip
    closing, varying, noise = mapper.closing_options()
    mapper.loss_scale_px = noise.sigma_px
    limit = _limit_px(known, options)
    for _ in range(2):  # against points that were exact some seemed to be off, against points that move they are not
        FactorGraph(
            around, mapper.robust(closing), varying=varying, prior_cameras=priors, noise_px=noise.robust_px
        ).optimize()
        obs = around.tracks.observations_of_image(query)
        lengths = around.errors_px()
        around.obs_is_inlier[obs] = lengths[obs] <= limit  # False for NaN
    graph = FactorGraph(around, closing, varying=varying, prior_cameras=priors, noise_px=noise.sigma_px)
    covariance = _in_frame_of_others(graph, around, query)
    obs = obs[around.obs_is_inlier[obs]]
    if len(obs) < options.mapping.min_pose_inliers:
        reason = (
            f"{len(obs)} points agree with its pose to {limit:.1f} px, {options.mapping.min_pose_inliers} are needed"
        )
        return replace(found, reason=reason)
    if covariance is None:
        return replace(found, reason=f"its pose is open: {len(obs)} points leave a motion that they do not see")
    others = around.registered_idx[around.registered_idx != query]
    pose = moved_to_gauge(stored, around, others, 7).cam_from_world[query]
    # a blurred photograph is less sure than those of the model
    own = sigma_of_lengths(lengths[obs]) / sigma_of_lengths(lengths[around.obs_is_inlier])
    return replace(
        found,
        cam_from_world=pose,
        covariance=max(own, 1.0) ** 2 * covariance,
        camera=joined.cameras[joined.image_camera_idx[query]],
        track_idx=around.tracks.obs_track_idx[obs].astype(np.int64),
        xy=around.tracks.obs_xy[obs],
        rms_px=float(np.sqrt((lengths[obs] ** 2).mean())),
        told_focal=_told_focal(joined, query, obs),
    )


def _in_frame_of_others(graph: FactorGraph, around: Reconstruction, query: int) -> Array | None:
    """(6, 6) of the pose of one image where the other ones, which have no say but in this, hold place, turn and scale
    by inner constraints: the frame that a finished model has; None where it is open."""
    images = around.registered_idx  # the query is the last
    try:
        marginal = graph.marginal_covariance(images=images)
    except InputError:
        return None
    if not marginal.is_determined or not np.isfinite(marginal.matrix).all():
        return None
    basis = similarity_basis(around.cam_from_world[images])[0]
    constraint = np.zeros_like(basis)
    constraint[:, :-6] = similarity_basis(around.cam_from_world[images[:-1]])[1]
    moved = np.eye(basis.shape[1]) - basis.T @ moves_into_gauge(basis, constraint)
    covariance: Array = (moved @ marginal.matrix @ moved.T)[-6:, -6:]
    return covariance


def _told_focal(joined: Reconstruction, query: int, obs: Ints) -> tuple[float, float]:
    """Focal length of a photograph by its own points, and its standard deviation, in pixels."""
    xyz, xy = joined.point_xyz[joined.tracks.obs_track_idx[obs]], joined.tracks.obs_xy[obs]
    camera = joined.cameras[joined.image_camera_idx[query]]
    free = refine_pose(camera.canonical, joined.cam_from_world[query], xyz, xy, scale_px=None, focal_sigma_px=np.inf)
    return float(free.canonical[:2].mean()), float(np.sqrt(free.covariance[6, 6]))


def _around(joined: Reconstruction, query: int) -> Reconstruction:
    """The part of a model around its last image: images that share most points with it, and what two of them see."""
    tracks = joined.tracks
    obs = tracks.observations_of_image(query)
    is_shared = np.zeros(tracks.num_tracks, bool)
    is_shared[tracks.obs_track_idx[obs[joined.obs_is_inlier[obs]]]] = True
    counted = joined.obs_is_inlier & is_shared[tracks.obs_track_idx]
    shared = np.bincount(tracks.obs_image_idx[counted], minlength=query + 1)
    chosen = np.argsort(-shared, kind="stable")[: MAX_AROUND + 1]
    part = joined.copy()
    left_out = np.setdiff1d(np.arange(query + 1), chosen)
    part.cam_from_world[left_out] = np.nan
    part.obs_is_inlier &= np.isfinite(part.cam_from_world[tracks.obs_image_idx, 0])
    length = np.bincount(tracks.obs_track_idx[part.obs_is_inlier], minlength=tracks.num_tracks)
    part.point_xyz[length < 2] = np.nan
    part.obs_is_inlier &= length[tracks.obs_track_idx] >= 2
    return part
