"""One model as it grows: the steps of incremental mapping as verbs."""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.covariance import estimate_covariances
from sfmapp.adjust.graph import FactorGraph
from sfmapp.adjust.options import AdjustOptions, AdjustReport
from sfmapp.adjust.problem import Varying
from sfmapp.adjust.selected_inverse import selected_covariances
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import Camera
from sfmapp.camera.models import PARAM_NAMES
from sfmapp.events import Events
from sfmapp.mapping import structure
from sfmapp.mapping.initialize import InitialPair, initial_angles, initialize_from_pair, rank_initial_pairs
from sfmapp.mapping.keypoint_noise import KeypointNoise, keypoint_noise
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.register import NextImages, Registration, register_image
from sfmapp.mapping.report import CameraSigmas, ImageSigmas, InitialPairReport, Uncertainty
from sfmapp.mapping.settling import Round, adjust_until_settled, round_options
from sfmapp.mapping.snapshot import ModelSnapshot
from sfmapp.mapping.tracks import USELESS_CONFIGS
from sfmapp.mapping.verified_pairs import MIN_MATCHES, pair_agreement
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.reconstruction import Reconstruction

STAGE = "mapping"
# Share of the observations of an image that must hold once all is adjusted, where they are few. Those of a right pose
# are verified matches and nearly all hold; those of a mirrored or repeated part are torn between two poses.
MIN_AGREEMENT = 2 / 3
# A position this uncertain, in distances of the points that tell it and in shares of the least angle of triangulation
# (in radians), is weak: a tenth of the shortest baseline that makes points.
WEAK_SHARE_OF_ANGLE = 0.1
# A weak image waits for another model if a pair with an image outside of this one has so many times the matches of its
# strongest pair inside: no matter of chance, and what comes with one image comes with its neighbours too.
ELSEWHERE = 2.0
# An adjustment of squares has settled when no larger share of the observations changes sides.
MAX_CHANGED = 1e-3
# Synthetic keypoints may be exact; no detector's are better than this.
MIN_NOISE_PX = 0.02
# The dense inverse of eight unknowns per image takes half a second and 50 MB for this many; beyond it only the blocks
# that are wanted are made.
MAX_DENSE_IMAGES = 200
# What a growing model looks like is told when so large a share of its images is new, as telling takes all observations:
# at every step up to fifty images.
TOLD_SHARE = 0.02


@dataclass(kw_only=True)
class Mapper:
    """Grows one model. Every method is a step of the method and changes ``reconstruction`` in place.

    ``prior_cameras`` are what the cameras of the model, in their order, were before anything was seen with them.
    ``locked`` (I,) bool are images that this model must not register. ``attempts``: the last one for each image.
    ``loss_scale_px``: the noise that robust losses are set for, once it has been measured.
    ``waits``: weak images whose strongest pairs are with images outside of the model are left to another one, which
    may grow from there. ``held`` (I,) bool: images whose poses are known and stay as they are; None for none.
    ``poses_tell_centers``: poses are or were known, which tells principal points that EXIF does not. ``widening``: of
    standard deviations that the residuals give, by what closing adjustments have moved. ``threads``: of adjustments.
    """

    reconstruction: Reconstruction
    correspondences: Correspondences
    options: MappingOptions
    adjust_options: AdjustOptions
    events: Events
    pool: Executor
    prior_cameras: list[Camera]
    locked: NDArray[np.bool_]
    attempts: dict[int, Registration] = field(default_factory=dict)
    failed_with: dict[int, int] = field(default_factory=dict)
    times_dropped: dict[int, int] = field(default_factory=dict)
    size_at_global: tuple[int, int] = (0, 0)
    loss_scale_px: float | None = None
    waits: bool = True
    held: NDArray[np.bool_] | None = None
    poses_tell_centers: bool = False
    threads: int = 1
    widening: float = 1.0
    max_error_px: float = field(init=False)
    _next: NextImages = field(init=False)
    _untold: list[int] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        self.max_error_px = self.options.max_reprojection_error_px
        self._next = NextImages(self.reconstruction)

    # ------------------------------------------------------------------ start

    def start(self, seeds: NDArray[np.bool_]) -> list[InitialPairReport]:
        """Register two of the seeds (I,) bool; returns the pairs that were tried, each with the reason against it."""
        options = self.options
        tried: list[InitialPairReport] = []
        ranked = rank_initial_pairs(self.reconstruction, self.correspondences, seeds, options)
        inliers = options.min_initial_inliers
        while True:
            # many matches under a small angle before few under a wide one, which may be of things that look alike
            for angle in initial_angles(self.options):
                for pair in ranked:
                    reason = pair.reason or pair.shortfall(inliers, angle)
                    tried.append(pair.report(self.reconstruction.image_names, reason))
                    if not reason and self._start_from(pair):
                        return tried
            if inliers <= options.min_pose_inliers:
                return tried
            inliers = max(inliers // 2, options.min_pose_inliers)
            self.events.decided(STAGE, f"no initial pair; relaxing to {inliers} matches")

    def _start_from(self, pair: InitialPair) -> bool:
        initialize_from_pair(self.reconstruction, pair)
        self.triangulate_images(list(pair.image_idx))
        self.adjust_globally()
        names = [self.reconstruction.image_names[i] for i in pair.image_idx]
        num_points = int(self.reconstruction.is_triangulated.sum())
        if num_points < self.options.min_pose_inliers:
            self._forget(list(pair.image_idx))
            return False
        self._decided(f"initial pair {names[0]} - {names[1]}: {num_points} points", list(pair.image_idx))
        self.events.advanced(STAGE, 2)
        return True

    def _forget(self, images: list[int]) -> None:
        self.reconstruction.cam_from_world[images] = np.nan
        self.reconstruction.point_xyz[:] = np.nan
        self.reconstruction.obs_is_inlier[:] = False

    def take_up(self) -> None:
        """Go on with a model that was finished before: with all that its images see of its points, and the noise of
        that."""
        self.triangulate_images(self.reconstruction.registered_idx.tolist())
        self._settle_points()
        self.size_at_global = self._size()

    # ------------------------------------------------------------------- grow

    def grow(self) -> None:
        """Register images until none is left or none fits; then once more after everything was adjusted."""
        while True:
            while registered := self.register_next_images():
                self.triangulate_images(registered)
                if self.is_grown():
                    self.adjust_globally()
                else:
                    self.adjust_around(registered)
                self._decided(f"registered {self._names(registered)}", registered)
                self.events.advanced(STAGE, len(registered))
            taken_back = self.drop_contradicted_images()
            if not taken_back and (not self._candidates().size or self._size() == self.size_at_global):
                if self._untold:
                    self._tell("no other image fits")
                return
            # a second chance: the adjusted map may hold more points and better poses
            self.adjust_globally()
            self.failed_with.clear()

    def register_next_images(self) -> list[int]:
        """Register the best next image, and with it others that see as much of the map; returns them.

        Images that failed are tried again once they see half as many points more. Images whose position is weak come
        when no other does, one at a time, the surest first.
        """
        order, scores, counts = self._next.rank(self.reconstruction, self._candidates())
        enough = counts >= self.options.min_pose_inliers
        worth = [
            (i, s)
            for i, s, n in zip(order[enough].tolist(), scores[enough].tolist(), counts[enough].tolist(), strict=True)
            if n >= 1.5 * self.failed_with.get(i, 0)
        ]
        registered: list[int] = []
        weak: list[Registration] = []
        while worth and not registered:
            # "as much": the map around them is as settled as around the best, and no image hangs on another
            batch = [i for i, score in worth if score >= 0.75 * worth[0][1]]
            worth = worth[len(batch) :]
            known = self._known_cameras()
            # all of them before the first is accepted, which changes what the others would start from
            results = list(self.pool.map(lambda i, known=known: self._attempt(i, known), batch))
            weak += [result for result in results if self._is_weak(result)]
            sure = [result for result in results if not self._is_weak(result)]
            registered = [result.image_idx for result in self._one_for_each_camera(sure) if self._accept(result)]
        for result in sorted(weak, key=lambda result: result.position_sigma):
            if registered:
                break
            if not self._is_left_to_another(result) and self._accept(result):
                registered = [result.image_idx]
        return registered

    def _is_weak(self, result: Registration) -> bool:
        limit = WEAK_SHARE_OF_ANGLE * np.radians(self.options.min_triangulation_angle_deg)
        return result.cam_from_world is not None and not result.position_sigma <= limit

    def _one_for_each_camera(self, results: list[Registration]) -> list[Registration]:
        """Results without those that searched the focal length of a camera which a surer one has found as well."""
        found: dict[int, Registration] = {}
        for result in results:
            if result.focal_px is not None:
                camera_idx = int(self.reconstruction.image_camera_idx[result.image_idx])
                best = found.setdefault(camera_idx, result)
                if result.position_sigma < best.position_sigma:
                    found[camera_idx] = result
        return [
            result
            for result in results
            if result.focal_px is None or result is found[int(self.reconstruction.image_camera_idx[result.image_idx])]
        ]

    def _is_left_to_another(self, result: Registration) -> bool:
        """Whether a weak image waits, as its strongest pair is with an image outside of this model."""
        others, matches = self._pairs_of(result.image_idx)
        registered = self.reconstruction.is_registered[others]
        inside, outside = matches[registered].max(initial=0), np.where(registered, 0, matches)
        strongest = int(outside.max(initial=0))
        if not self.waits or strongest < max(ELSEWHERE * inside, self.options.min_initial_inliers):
            return False
        reason = (
            f"its position is uncertain by {100 * result.position_sigma:.1f} % of the distance of the points it sees, "
            f"and its strongest pair, {strongest} matches, is with "
            f"{self.reconstruction.image_names[others[np.argmax(outside)]]}, outside of this model"
        )
        self._accept(replace(result, cam_from_world=None, reason=reason))
        return True

    def _pairs_of(self, image_idx: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Images (K,) that an image has verified matches with, and how many (K,)."""
        pairs, matches = self.correspondences.pair_image_idx, self.correspondences.num_inliers
        useful = (matches > 0) & ~np.isin(self.correspondences.config, USELESS_CONFIGS)
        own = np.flatnonzero(useful & (pairs == image_idx).any(axis=1))
        return pairs[own].sum(axis=1, dtype=np.int64) - image_idx, matches[own]

    def _attempt(self, image_idx: int, known_cameras: NDArray[np.bool_]) -> Registration:
        camera_idx = self.reconstruction.image_camera_idx[image_idx]
        camera = self.reconstruction.cameras[camera_idx]
        search_focal = camera.focal_source == "default" and not camera.is_fixed and not known_cameras[camera_idx]
        # the map's own tolerance with room for its drift
        max_error_px = min(3.0 * self.max_error_px, self.options.max_pose_error_px)
        return register_image(
            self.reconstruction, image_idx, self.options, search_focal=search_focal,
            max_error_px=self.options.max_pose_error_px if search_focal else max_error_px,
        )  # fmt: skip

    def _accept(self, result: Registration) -> bool:
        self.attempts[result.image_idx] = result
        name = self.reconstruction.image_names[result.image_idx]
        if result.cam_from_world is None:
            self.failed_with[result.image_idx] = result.num_correspondences
            self.events.decided(STAGE, f"{name}: {result.reason}")
            return False
        self.reconstruction.cam_from_world[result.image_idx] = result.cam_from_world
        if result.focal_px is not None:
            camera_idx = self.reconstruction.image_camera_idx[result.image_idx]
            camera = self.reconstruction.cameras[camera_idx].with_focal(result.focal_px)
            self.reconstruction.cameras[camera_idx] = camera
            self.prior_cameras[camera_idx] = camera
        return True

    def triangulate_images(self, images: list[int]) -> None:
        """Add the observations of newly registered images to their points, and triangulate what they make possible."""
        tracks = self.reconstruction.tracks
        seen = np.unique(np.concatenate([tracks.obs_track_idx[tracks.observations_of_image(i)] for i in images]))
        seen = seen.astype(np.int64)
        exists = self.reconstruction.is_triangulated[seen]
        structure.filter_observations(self.reconstruction, self.options, self.pool, seen[exists], self.max_error_px)
        missing = seen[~self.reconstruction.is_triangulated[seen]]
        structure.triangulate(self.reconstruction, missing, self.options, self.pool, self.max_error_px)

    # ----------------------------------------------------------------- adjust

    def is_grown(self) -> bool:
        """True if the model is small enough to be adjusted whole, or has grown enough since it last was."""
        images, points = self._size()
        return (
            images <= 2 * self.options.local_window
            or images >= self.options.global_growth * self.size_at_global[0]
            or points >= self.options.global_growth * self.size_at_global[1]
        )

    def adjust_around(self, images: list[int]) -> None:
        """Adjust new images, the registered ones that share most points with them, and those points."""
        variable = np.zeros(len(self.reconstruction.image_names), bool)
        variable[images] = True
        variable[self._covisible_images(images)] = True
        if self.held is not None:
            variable &= ~self.held
        reconstruction, tracks = self.reconstruction, self.reconstruction.tracks
        # intrinsics vary only where no image outside the window depends on them
        outside = reconstruction.is_registered & ~variable
        cameras = np.zeros(len(reconstruction.cameras), bool)
        cameras[reconstruction.image_camera_idx[variable]] = True
        cameras[reconstruction.image_camera_idx[outside]] = False
        seen = np.unique(np.concatenate([tracks.obs_track_idx[tracks.observations_of_image(i)] for i in images]))
        seen = seen[reconstruction.is_triangulated[seen]].astype(np.int64)
        points = np.zeros(tracks.num_tracks, bool)
        points[seen] = True
        options = replace(self.adjust_options, max_iterations=15, relative_cost_tolerance=1e-4)
        varying = Varying(images=variable, cameras=cameras, points=points)
        adjust_bundle(reconstruction, options, varying=varying, prior_cameras=self.prior_cameras)
        structure.filter_observations(reconstruction, self.options, self.pool, seen, self.max_error_px)

    def adjust_to_cameras(self, cameras: list[Camera]) -> None:
        """Take over intrinsics that another model has found, and adjust poses and points to them."""
        reconstruction = self.reconstruction
        reconstruction.cameras[:] = cameras
        options = replace(self.adjust_options, max_iterations=25, relative_cost_tolerance=1e-4)
        varying = self._everything(cameras=np.zeros(len(cameras), bool))
        self._adjust(options, varying)

    def adjust_globally(self) -> None:
        """Adjust everything, filter, and triangulate again what was lost or has become possible."""
        reconstruction = self.reconstruction
        options = replace(self.adjust_options, max_iterations=25, relative_cost_tolerance=1e-4)
        if reconstruction.is_registered.sum() < 3:  # two views cannot tell the lens from the scene
            options = replace(options, refine_focal=False, refine_distortion=False)
        self._adjust(options, self._everything())
        if self.held is not None:  # what does not fit known poses is taken back next
            self._refine_principal_points(options)
        self._settle_points()
        self.size_at_global = self._size()

    def _adjust(self, options: AdjustOptions, varying: Varying) -> None:
        """Adjust all that varies, on all threads."""
        adjust_bundle(
            self.reconstruction, options, varying=varying, prior_cameras=self.prior_cameras, threads=self.threads,
            events=self.events,
        )  # fmt: skip

    def finish(self) -> None:
        """Adjust until the set of inliers settles; cameras with several images refine their principal point too.

        The damping starts low: the map is at its minimum already, and what is still to be found lies in directions in
        which the cost is almost flat, such as principal point against rotation.
        """
        options = replace(self.adjust_options, initial_damping=1e-7, relative_cost_tolerance=1e-7)
        for _ in range(6):
            before = self.reconstruction.obs_is_inlier.copy()
            self._adjust(options, self._everything())
            self._refine_principal_points(options)
            self._settle_points()
            changed = int((before != self.reconstruction.obs_is_inlier).sum())
            summary = self.reconstruction.summary()
            self.events.decided(
                STAGE, f"final adjustment: {changed} observations became inliers or outliers", **summary
            )
            if changed <= MAX_CHANGED * before.sum():
                return

    def polish(self) -> AdjustReport:
        """Adjust a finished map with a loss that lets go of what is far off the noise, until it settles: the closing
        adjustments, of which the last is reported, as ``unsettled`` where it has not.

        A pixel may be ten standard deviations of precise keypoints: with squares alone, the few observations near the
        limit decide what many others tell little of, such as the lens.
        """
        self.loss_scale_px = self._residual_scale_px
        let_go = np.zeros(self.reconstruction.tracks.num_tracks, bool)
        return adjust_until_settled(partial(self._polish_once, let_go), STAGE, self.events)

    def _polish_once(self, let_go: NDArray[np.bool_], num_steps: int) -> Round:
        """Some steps of closing adjustment, after which observations are chosen anew; ``let_go`` (T,) bool are points
        that earlier rounds have lost, to which this one adds."""
        reconstruction = self.reconstruction
        before = reconstruction.obs_is_inlier.copy()
        options, chosen = self._polishing()
        graph = FactorGraph(
            reconstruction, round_options(options, num_steps), varying=self._everything(centers=chosen),
            prior_cameras=self.prior_cameras, noise_px=1.0, threads=self.threads,
        )  # fmt: skip
        report = graph.optimize(self.events)
        self.events.decided(STAGE, f"closing adjustment: {report.text}", **report)
        self._settle_points(let_go)
        made = Round(report, before, reconstruction.obs_is_inlier.copy())
        summary = reconstruction.summary()
        self.events.decided(
            STAGE, f"robust adjustment: {made.num_changed} observations became inliers or outliers", **summary
        )
        return made

    def adjust_with(self, extra_factors: Any, noise: KeypointNoise) -> None:
        """Adjust a finished map once more as :meth:`polish` does, with gtsam factors over ``X(i)`` beside the
        reprojections, whose sigmas are true ones, and settle its points.

        Args:
            noise: that of the map before there were such factors, by which both are weighed.
        """
        options, chosen = self._polishing()
        options = replace(options, initial_damping=1e-6, relative_cost_tolerance=1e-6)
        # priors on intrinsics count against residuals of a pixel, here as before, so that factors alone make a change
        unit, priors = noise.robust_px, list(self.prior_cameras)
        if options.principal_point_sigma_px is not None:
            options = replace(options, principal_point_sigma_px=unit * options.principal_point_sigma_px)
        if options.distortion_sigma is not None:
            options = replace(options, distortion_sigma=unit * options.distortion_sigma)
        for c, camera in enumerate(priors):
            if camera.focal_sigma is not None:
                priors[c] = replace(camera, focal_sigma=unit * camera.focal_sigma)
        graph = FactorGraph(
            self.reconstruction, options, varying=self._everything(centers=chosen), prior_cameras=priors, noise_px=unit,
            threads=self.threads,
        )  # fmt: skip
        graph.add(extra_factors)
        report = graph.optimize(self.events)
        factors = [
            replace(f, normalized_residual=unit * f.normalized_residual) if f.kind == "intrinsics prior" else f
            for f in report.factors
        ]
        report = replace(report, factors=factors)  # in the deviations that cameras claim
        self.events.decided(STAGE, f"closing adjustment: {report.text}", **report)
        if report.termination == "iterations":
            self.events.warned(STAGE, f"the closing adjustment did not settle in {report.num_iterations} steps")
        self._settle_points()

    def pose_covariances_with(self, extra_factors: Any) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
        """Images (n,) and covariances (n, 6, 6) of their poses at the minimum of :meth:`adjust_with`, with factors
        whose sigmas are true ones; None where they cannot be had."""
        chosen = self._free_principal_points()
        options = self.with_free_centers(self.adjust_options, chosen) if chosen.any() else self.adjust_options
        given = {"prior_cameras": self.prior_cameras, "extra_factors": extra_factors}
        found = selected_covariances(self.reconstruction, options, **given)
        if found is None and self.reconstruction.is_registered.sum() <= MAX_DENSE_IMAGES:
            found = estimate_covariances(self.reconstruction, options, **given)
        if found is None or not found.is_told.all():
            return None
        return found.image_idx, found.poses

    def _polishing(self) -> tuple[AdjustOptions, NDArray[np.bool_]]:
        """Options of the last adjustment, and the cameras (C,) bool whose principal points are free in it."""
        chosen = self._free_principal_points()
        options = replace(
            self.robust(self.adjust_options), max_iterations=100, initial_damping=1e-8, relative_cost_tolerance=1e-5
        )
        return self.with_free_centers(options, chosen) if chosen.any() else options, chosen

    def robust(self, options: AdjustOptions) -> AdjustOptions:
        """The options with the loss of the closing adjustment, unless another one was asked for."""
        return options.robust(self.loss_scale_px or self._residual_scale_px)

    @property
    def noise(self) -> KeypointNoise:
        """Of the keypoints, by what the closing adjustment has left."""
        options, varying = self._closing_freedoms()
        return keypoint_noise(self.reconstruction, self.robust(options), varying, MIN_NOISE_PX)

    @property
    def _residual_scale_px(self) -> float:
        """Standard deviation of residuals, which is below that of keypoints where tracks are short, in pixels."""
        return structure.residual_scale_px(self.reconstruction, MIN_NOISE_PX)

    def agreement(self) -> tuple[int, int]:
        """How many verified matches between registered images agree with their poses, and how many there are."""
        found = pair_agreement(self.reconstruction, self.correspondences)
        return int(found.num_agreeing.sum()), int(found.num_matches.sum())

    def _refine_principal_points(self, options: AdjustOptions) -> None:
        """Adjust everything with free principal points, for the cameras that MappingOptions names."""
        chosen = self._free_principal_points()
        if chosen.any():
            options = self.with_free_centers(options, chosen)
            self._adjust(options, self._everything(cameras=chosen))

    def _free_principal_points(self) -> NDArray[np.bool_]:
        """(C,) bool: cameras whose principal point is refined."""
        reconstruction, mode = self.reconstruction, self.options.refine_principal_point
        registered = reconstruction.image_camera_idx[reconstruction.is_registered]
        shared = np.bincount(registered, minlength=len(reconstruction.cameras)) >= 3
        # a calibration tells them too, and how well
        unknown = np.array(
            [
                mode == "always"
                or c.focal_source == "default"
                or prior.focal_variance > 0.0
                or (self.poses_tell_centers and c.focal_source.startswith("exif"))
                for c, prior in zip(reconstruction.cameras, self.prior_cameras, strict=True)
            ],
            bool,
        )
        free: NDArray[np.bool_] = shared & unknown & (mode != "never")
        return free

    def with_free_centers(self, options: AdjustOptions, chosen: NDArray[np.bool_]) -> AdjustOptions:
        """The options with free principal points under the prior of MappingOptions, for cameras chosen (C,) bool."""
        cameras = self.reconstruction.cameras
        size = max(max(c.width, c.height) for c, is_chosen in zip(cameras, chosen, strict=True) if is_chosen)
        # the adjustment counts residuals in pixels; the prior is weighed against them at their true noise
        noise_px = structure.residual_scale_px(self.reconstruction, 0.1)
        sigma_px = self.options.principal_point_sigma * size / noise_px
        return replace(options, refine_principal_point=True, principal_point_sigma_px=sigma_px)

    def uncertainty(self) -> Uncertainty:
        """Standard deviations of the finished model for the report: of parameters, and of centres against its size.

        They follow from the residuals under the model (independent errors, a right lens model) in the gauge of inner
        constraints: what the photographs can tell, not how far the lens model is off. Images whose poses are left open
        are named, and have no part in the gauge. Empty where more is not determined, and for large models in which
        most photographs meet most others.
        """
        reconstruction, options = self.reconstruction, self.adjust_options
        chosen = self._free_principal_points()
        if chosen.any():
            options = self.with_free_centers(options, chosen)
        is_small = reconstruction.is_registered.sum() <= MAX_DENSE_IMAGES
        estimate = estimate_covariances if is_small else selected_covariances
        found = estimate(reconstruction, options, prior_cameras=self.prior_cameras)
        if found is None or not found.is_determined:
            return Uncertainty()
        images, poses = found.image_idx[found.is_told], found.poses[found.is_told]
        # c = -R^T t moves by -R^T v; its variance along one axis is a third of the trace
        center_sigma = np.sqrt(np.trace(poses[:, 3:, 3:], axis1=1, axis2=2) / 3.0)
        angle_sigma = np.degrees(np.sqrt(np.trace(poses[:, :3, :3], axis1=1, axis2=2) / 3.0))
        centers = reconstruction.centers[images]
        size = float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
        parameters = [
            CameraSigmas(
                camera=int(c),
                sigma={
                    PARAM_NAMES[reconstruction.cameras[c].model][k]: float(np.sqrt(variance))
                    for k, variance in zip(free, np.diag(covariance), strict=True)
                },
            )
            for c, free, covariance in zip(found.camera_idx, found.free_params, found.intrinsics, strict=True)
        ]
        return Uncertainty(
            noise_px=found.sigma_px,
            cameras=parameters,
            median_center_sigma_share=float(np.median(center_sigma)) / size,
            worst_center_sigma_share=float(center_sigma.max()) / size,
            median_rotation_sigma_deg=float(np.median(angle_sigma)),
            images={
                reconstruction.image_names[i]: ImageSigmas(
                    center_sigma_share=float(c) / size, rotation_sigma_deg=float(a)
                )
                for i, c, a in zip(images, center_sigma, angle_sigma, strict=True)
            },
            images_left_open=[reconstruction.image_names[i] for i in found.image_idx[~found.is_told]],
        )

    def closing_options(self) -> tuple[AdjustOptions, Varying, KeypointNoise]:
        """How the finished map is adjusted as a factor graph, with squares (:meth:`robust` makes it the closing loss),
        what varies, and the noise of its keypoints."""
        return *self._closing_freedoms(), self.noise

    def _closing_freedoms(self) -> tuple[AdjustOptions, Varying]:
        """Options of an adjustment as a factor graph, with priors that are what they say, and what varies in it."""
        chosen = self._free_principal_points()
        options = replace(self.adjust_options, max_iterations=100, initial_damping=1e-6, relative_cost_tolerance=1e-7)
        if chosen.any():
            cameras = [c for c, is_chosen in zip(self.reconstruction.cameras, chosen, strict=True) if is_chosen]
            sigma_px = self.options.principal_point_sigma * max(max(c.width, c.height) for c in cameras)
            options = replace(options, refine_principal_point=True, principal_point_sigma_px=sigma_px)
        return options, self._everything(centers=chosen)

    def _settle_points(self, let_go: NDArray[np.bool_] | None = None) -> None:
        """Measure the noise; filter accordingly, and triangulate again what was lost or has become possible, without
        points that are ``let_go`` (T,) bool: those that are lost now are added to it.

        A point of two rays that miss each other by several deviations is triangulated in their middle, from where a
        robust loss slides, in a good ten steps, to one of them and lets go of the other: triangulated again, it would
        do so in every round.
        """
        scale = structure.residual_scale_px(self.reconstruction)
        # one pixel is about what the best detectors reach on blurred or distorted images: never filter below it
        lower, upper = min(1.0, self.options.max_reprojection_error_px), self.options.max_reprojection_error_px
        if np.isfinite(scale):
            self.max_error_px = float(np.clip(self.options.max_reprojection_error_sigmas * scale, lower, upper))
        before = self.reconstruction.is_triangulated
        structure.filter_observations(self.reconstruction, self.options, self.pool, None, self.max_error_px)
        is_missing = ~self.reconstruction.is_triangulated
        if let_go is not None:
            let_go |= is_missing & before
            is_missing &= ~let_go
        missing = np.flatnonzero(is_missing)
        structure.triangulate(self.reconstruction, missing, self.options, self.pool, self.max_error_px)
        self._drop_weak_images()

    def _drop_weak_images(self) -> None:
        """Take back images that lost their support or that much of the map contradicts, and points that need them."""
        reconstruction, least = self.reconstruction, self.options.min_pose_inliers
        tracks, used = reconstruction.tracks, reconstruction.obs_is_inlier
        counts = np.bincount(tracks.obs_image_idx[used], minlength=tracks.num_images)
        sees = reconstruction.is_triangulated[tracks.obs_track_idx]
        visible = np.bincount(tracks.obs_image_idx[sees], minlength=tracks.num_images)
        weak = (counts < least) | ((counts < 4 * least) & (counts < MIN_AGREEMENT * visible))
        if self.held is not None:  # a pose that is known needs no support
            weak &= ~self.held
        dropped = np.flatnonzero(reconstruction.is_registered & weak)
        # a model of two or three images stands or falls as a whole, with its points
        if len(dropped) == 0 or reconstruction.is_registered.sum() - len(dropped) < 3:
            return
        reconstruction.cam_from_world[dropped] = np.nan
        structure.filter_observations(reconstruction, self.options, self.pool, None, self.max_error_px)
        for i in dropped.tolist():
            reason = f"{counts[i]} of {visible[i]} observations hold after the adjustment: too few to trust the pose"
            self._take_back(i, int(visible[i]), int(counts[i]), reason)

    def drop_contradicted_images(self, *, held_too: bool = False) -> bool:
        """Take back images that most of their own verified matches contradict, the worst first; True if there are any.
        Those that are held stay, unless ``held_too``.

        What contradicts one image of a pair contradicts the other: once the wrong one is gone, nothing speaks against
        its neighbours any more.
        """
        reconstruction = self.reconstruction
        found = pair_agreement(reconstruction, self.correspondences)
        weight = np.where(found.num_matches >= MIN_MATCHES, found.num_matches, 0)
        against = weight * found.contradicts
        num_images = len(reconstruction.image_names)
        dropped: list[int] = []
        while reconstruction.is_registered.sum() - len(dropped) > 3:
            total, bad = (
                np.bincount(found.image_idx.ravel(), weights=w.repeat(2), minlength=num_images)
                for w in (weight, against)
            )
            share = bad / np.maximum(total, 1)
            if self.held is not None and not held_too:
                share[self.held] = 0.0
            worst = int(np.argmax(share))
            if share[worst] <= 0.5:
                break
            dropped.append(worst)
            touching = (found.image_idx == worst).any(axis=1)
            weight, against = np.where(touching, 0, weight), np.where(touching, 0, against)
            reason = f"{int(bad[worst])} of its {int(total[worst])} verified matches contradict its pose"
            self._take_back(worst, int(total[worst]), int(total[worst] - bad[worst]), reason)
        if dropped:
            reconstruction.cam_from_world[dropped] = np.nan
            structure.filter_observations(reconstruction, self.options, self.pool, None, self.max_error_px)
        return bool(dropped)

    def _take_back(self, image_idx: int, num_correspondences: int, num_inliers: int, reason: str) -> None:
        """Note that an image is unregistered again, and why."""
        self.attempts[image_idx] = Registration(image_idx, num_correspondences, num_inliers, None, reason=reason)
        self.failed_with[image_idx] = num_correspondences
        self.times_dropped[image_idx] = self.times_dropped.get(image_idx, 0) + 1
        self.events.decided(STAGE, f"deregistered {self.reconstruction.image_names[image_idx]}: {reason}")

    # ---------------------------------------------------------------- helpers

    def _everything(
        self, *, cameras: NDArray[np.bool_] | None = None, centers: NDArray[np.bool_] | None = None
    ) -> Varying:
        """All that an adjustment of the whole map may change; arguments as of :class:`Varying`."""
        if self.held is None:
            return Varying(cameras=cameras, centers=centers)
        points = self.reconstruction.is_triangulated
        return Varying(images=~self.held, cameras=cameras, centers=centers, points=points)

    def _size(self) -> tuple[int, int]:
        return int(self.reconstruction.is_registered.sum()), int(self.reconstruction.is_triangulated.sum())

    def _candidates(self) -> NDArray[np.int64]:
        """Images that may be registered, without those taken back twice: they would come forever."""
        hopeless = [i for i, times in self.times_dropped.items() if times >= 2]
        return np.setdiff1d(np.flatnonzero(~self.reconstruction.is_registered & ~self.locked), hopeless)

    def _known_cameras(self) -> NDArray[np.bool_]:
        """(C,) bool: cameras with a registered image, which the adjustment has refined."""
        counts = np.bincount(
            self.reconstruction.image_camera_idx[self.reconstruction.is_registered],
            minlength=len(self.reconstruction.cameras),
        )
        return counts > 0

    def _covisible_images(self, images: list[int]) -> NDArray[np.int64]:
        """The registered images that share most points with the given ones, as many as the window holds."""
        tracks, used = self.reconstruction.tracks, self.reconstruction.obs_is_inlier
        own = np.concatenate([tracks.observations_of_image(i) for i in images])
        obs = tracks.observations_of_tracks(np.unique(tracks.obs_track_idx[own[used[own]]]))
        shared = np.bincount(
            tracks.obs_image_idx[obs[used[obs]]], minlength=len(self.reconstruction.image_names)
        ).astype(np.int64)
        shared[images] = 0
        order = np.argsort(-shared, kind="stable")[: max(1, self.options.local_window - len(images))]
        return order[shared[order] > 0]

    def _names(self, images: list[int]) -> str:
        return ", ".join(self.reconstruction.image_names[i] for i in images)

    def _decided(self, message: str, images: list[int]) -> None:
        """Tell of images that have come, and with a good part of new ones what the model looks like."""
        self._untold += images
        if len(self._untold) < TOLD_SHARE * self.reconstruction.is_registered.sum():
            self.events.decided(STAGE, message)
        else:
            self._tell(message)

    def _tell(self, message: str) -> None:
        """Tell what the model looks like, with the images that have come since that was told."""
        if not self.events.is_heard:  # looking takes all observations
            return
        summary = self.reconstruction.summary()
        self.events.decided(
            STAGE, f"{message}; {summary.num_points} points, {summary.mean_reprojection_error_px:.2f} px",
            **summary,
            snapshot=ModelSnapshot(
                tuple(self._untold), summary.num_registered, summary.num_points, summary.mean_reprojection_error_px,
                self.reconstruction.cam_from_world.copy(), self.reconstruction.point_xyz.astype(np.float32),
            ),
        )  # fmt: skip
        self._untold = []
