"""Incremental structure from motion: from verified matches to cameras and points.

The stage reads in order: :func:`map_images` makes one model after another, :class:`Mapper` grows one. Schoenberger and
Frahm, "Structure-from-Motion Revisited", CVPR 2016, is the pattern; the differences are that tracks are fixed before
mapping begins and that the adjustment is cheap enough to be called after every step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sfmapp.adjust.options import AdjustOptions
from sfmapp.camera.camera import Camera
from sfmapp.contradictions import Contradiction
from sfmapp.errors import NoReconstructionError
from sfmapp.events import Events
from sfmapp.executor import Threads
from sfmapp.images.folder import ImageSet
from sfmapp.mapping import pair_motions, verified_pairs
from sfmapp.mapping.carry import carried
from sfmapp.mapping.closing_move import closing_move, widened_by_move
from sfmapp.mapping.divided import Divided, InParts, PartsWork
from sfmapp.mapping.focal import estimate_focal_ratio
from sfmapp.mapping.focal_priors import MapFrom, Mapped, settle_focal_lengths
from sfmapp.mapping.intrinsics_check import check_intrinsics, widened_uncertainty
from sfmapp.mapping.join import find_joint, holds_together, in_common_cameras, unite
from sfmapp.mapping.look_alikes import tell_apart
from sfmapp.mapping.mapper import STAGE, Mapper
from sfmapp.mapping.merge import find_merge, merge, num_linking_points
from sfmapp.mapping.moving_planes import without_moving_planes
from sfmapp.mapping.one_place import OnePlace, find_one_place
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.register import NextImages, Registration
from sfmapp.mapping.repair import repaired
from sfmapp.mapping.report import (
    FocalReport,
    InitialPairReport,
    MappedImage,
    MappingReport,
    ModelReport,
    StartReport,
)
from sfmapp.mapping.submaps import Part
from sfmapp.mapping.tracks import build_tracks, track_colors
from sfmapp.mapping.verified_pairs import contradictions_of
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.features import Features
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.tracks import Tracks

# Share of the verified matches between images of a model that agree with their poses. Right models have 0.98 and more
# on all sets at hand, with or without weak pairs; a street walked along 0.86; those that a bad start has bent 0.75.
ENOUGH_AGREEMENT = 0.95
# A wrong part agrees by chance with two thirds of the matches at most.
WEIGHT_AGAINST = 3.0
# Starts of one model.
MAX_STARTS = 3
# Two starts whose models hold the same images, and which agree with as many of the matches but for this share of them,
# have come to the same: what does not agree are pairs of things that look alike, and no third start would help. On
# streets with terraces of equal houses three starts differ by 0.0003, a start that has bent its map by 0.2.
SAME_AGREEMENT = 0.005


@dataclass(frozen=True)
class Ends:
    """What mapping begins with and ends in, beside what it does itself, and who does it.

    Attributes:
        start: finished models of some of the images, known by their names, that mapping goes on with. Where the
            photographs turn out not to believe a focal length, or which parts are one, it begins anew.
        is_apart: images of one of them come to another with it, by the similarity between them, and not one by one.
        closing: called in the end with the finished models, the largest first, to move and adjust them further.
        parts: who maps the parts of large sets, and where these are kept; None: threads of this process, nowhere.
    """

    start: Sequence[Reconstruction] = ()
    is_apart: bool = False
    closing: Callable[[list[Mapper]], None] | None = None
    parts: PartsWork | None = None


def map_images(
    image_set: ImageSet,
    features: Sequence[Features],
    correspondences: Correspondences,
    options: MappingOptions,
    *,
    adjust_options: AdjustOptions,
    threads: int,
    events: Events,
    ends: Ends | None = None,
) -> tuple[list[Reconstruction], MappingReport]:
    """Reconstruct cameras and points from verified matches.

    Args:
        image_set: names and cameras of the images.
        features: of every image.
        correspondences: verified matches between pairs of them.
        options, adjust_options: what is accepted, and how it is adjusted.
        threads: workers; the result does not depend on it.
        events: told of every decision; ``decided`` events carry a ``snapshot`` of the map for a recording.
        ends: finished models to begin with, and what is done with those that are finished; None for neither.

    Returns:
        The models, the one with most images first, and the report: per image what was tried and why it failed.

    Raises:
        NoReconstructionError: no model could be started; its ``report`` attribute holds the report.
    """
    ends = ends or Ends()
    names = [record.name for record in image_set.images]
    image_camera_idx = np.array([record.camera_idx for record in image_set.images], np.int32)
    tracks, track_report = build_tracks(correspondences, features)
    correspondences, num_flat = without_moving_planes(correspondences, tracks, image_set.cameras, image_camera_idx)
    if num_flat:
        tracks, track_report = build_tracks(correspondences, features)
        events.warned(
            STAGE,
            f"{num_flat} pairs match only on something flat that is not part of the scene; they were left out. A mask "
            "over it (images.mask_path) would keep what else they share",
        )
    events.decided(STAGE, f"{track_report.num_tracks} tracks", **track_report)
    with ThreadPoolExecutor(threads) as pool:
        by_parts = InParts(ends.parts or PartsWork(Threads(threads)), partial(map_part, options, adjust_options))
        task = _Task(names, image_camera_idx, options, adjust_options, events, pool, threads, by_parts)

        def map_all(given: list[Camera]) -> Mapped:
            return task.map_from(given, correspondences, tracks)

        first_map = task.map_from(list(image_set.cameras), correspondences, tracks, ends)
        mapped = settle_focal_lengths(first_map, map_all, events)

        def map_again(found: Correspondences) -> Mapped:
            return task.map_from(list(mapped.cameras), found, build_tracks(found, features)[0], enough=mapped.enough)

        mapped, look_alikes = tell_apart(mapped, correspondences, map_again, events)
        models = mapped.models
        finished = [mapped.mapper_of(model) for model in models]
        first = [model.copy() for model in models]
        adjustments = [mapper.polish() for mapper in finished]
        moves = [closing_move(before, after) for before, after in zip(first, models, strict=True)]
        for model in models:
            model.point_rgb = track_colors(model.tracks, features)
        contradictions = contradictions_of(models, correspondences)
        model_reports = [
            replace(_model_report(mapped, model, found, apart, map_all, events), adjustment=adjustment)
            for model, found, apart, adjustment in zip(models, contradictions, mapped.apart, adjustments, strict=True)
        ]
        for n, (mapper, move) in enumerate(zip(finished, moves, strict=True)):
            mapper.widening = move.widening(model_reports[n].uncertainty)
            uncertainty = widened_by_move(model_reports[n].uncertainty, move, events)
            model_reports[n] = replace(model_reports[n], uncertainty=uncertainty)
        if ends.closing is not None:
            ends.closing(finished)  # which know where the closing loss bends
    report = MappingReport(
        tracks=track_report,
        focal=mapped.focal_report,
        look_alikes=look_alikes,
        initial_pairs=mapped.initial_reports,
        parts=mapped.parts,
        images=image_reports(names, models, mapped.attempts),
        models=model_reports,
    )
    events.finished(STAGE, f"{len(models)} model(s)", num_models=len(models))
    if not models:
        here = find_one_place(correspondences, tracks, image_set.cameras, image_camera_idx)
        raise no_reconstruction(report, here)
    return models, report


@dataclass(frozen=True)
class _Task:
    """What all mappings of a run have in common: which cameras they begin with and what they believe may differ."""

    names: list[str]
    image_camera_idx: NDArray[np.int32]
    options: MappingOptions
    adjust_options: AdjustOptions
    events: Events
    pool: Executor
    threads: int
    in_parts: InParts | None = None
    """How large sets are mapped in parts; None: they are not."""

    def map_from(
        self, given: list[Camera], correspondences: Correspondences, tracks: Tracks,
        ends: Ends | None = None, enough: float = ENOUGH_AGREEMENT,
    ) -> Mapped:  # fmt: skip
        """Models that begin with the given cameras, from verified matches and their tracks, or with finished ones;
        ``enough`` is the share of the matches that has to agree with a model so that no other start is tried."""
        names, options, events = self.names, self.options, self.events
        events.started(STAGE, "mapping", total=len(names))
        cameras, focal_report = first_cameras(given, self.image_camera_idx, correspondences, tracks, options, events)
        attempts: dict[int, Registration] = {}

        def mapper_of(model: Reconstruction, locked: NDArray[np.bool_] | None = None) -> Mapper:
            locked = np.zeros(len(names), bool) if locked is None else locked
            return Mapper(
                reconstruction=model, correspondences=correspondences, options=options,
                adjust_options=self.adjust_options, events=events, pool=self.pool, prior_cameras=list(cameras),
                locked=locked, attempts=attempts, threads=self.threads,
            )  # fmt: skip

        empty = Reconstruction.empty(cameras, names, self.image_camera_idx, tracks)
        begun = [carried(model, empty) for model in ends.start] if ends is not None else []
        is_apart = ends is not None and ends.is_apart
        starts = Starts(options, events, enough)
        divided = Divided([])
        if self.in_parts is not None and not begun:
            divided = self.in_parts.models(empty, correspondences, mapper_of)
            begun = divided.models
        models, initial_reports = _grow_models(empty, mapper_of, starts, begun, is_apart=is_apart)
        if divided.models and divided.is_bent(models, correspondences):
            divided = divided.given_up("parts do not make a model that holds together", events)
            models, initial_reports = _grow_models(empty, mapper_of, starts)
        models, apart = _merge_models(_without_parts(models), mapper_of, correspondences, options, events)
        models = _with_left_over(models, mapper_of, correspondences, events)
        models = [repaired(model, correspondences, mapper_of, options, events) for model in models]
        return Mapped(
            cameras, models, initial_reports, focal_report, attempts, mapper_of, apart, starts.enough, divided.report
        )


def map_part(
    options: MappingOptions, adjust_options: AdjustOptions, events: Events, part: Part
) -> list[Reconstruction]:
    """Models of a part of a large set, the largest first, by one thread."""
    options = replace(options, estimate_focal=False)
    with ThreadPoolExecutor(1) as pool:
        task = _Task(part.image_names, part.image_camera_idx, options, adjust_options, events, pool, 1)
        return task.map_from(part.cameras, part.correspondences, part.tracks).models


def _model_report(
    mapped: Mapped, model: Reconstruction, found: Sequence[Contradiction], apart: str, map_all: MapFrom, events: Events
) -> ModelReport:
    """What a finished model says; contradictions that were found among the verified pairs widen its uncertainty."""
    summary = model.summary()  # as it was grown: what follows may lean on priors
    uncertainty, contradictions = check_intrinsics(mapped, model, map_all, events)
    if contradictions:  # wrong intrinsics bend a map: what they do to it is told and in its sigmas
        found = [contradiction for contradiction in found if contradiction.subject != pair_motions.SUBJECT]
    for contradiction in found:
        events.warned(STAGE, contradiction.message, **contradiction.evidence)
        uncertainty = widened_uncertainty(
            uncertainty, model, contradiction.position_sigma_share, contradiction.rotation_sigma_deg
        )
    return ModelReport(**summary, uncertainty=uncertainty, contradictions=[*contradictions, *found], apart=apart)


@dataclass
class Starts:
    """How many models are begun for each that is kept: another one where too few of the matches agree with the first.

    Attributes:
        enough: the share that is enough: less than at first where two starts that came to the same have shown that no
            more can be had from these pairs.
    """

    options: MappingOptions
    events: Events
    enough: float = ENOUGH_AGREEMENT

    def is_last(self, model: Reconstruction, best: Reconstruction | None, shares: Sequence[float]) -> bool:
        """Whether no other start is worth while after a model with the last of these shares of agreement, where
        ``best`` is the better one of those before."""
        if shares[-1] >= self.enough:
            return True
        is_same = best is not None and np.array_equal(best.is_registered, model.is_registered)
        if is_same and abs(shares[-1] - max(shares[:-1])) <= SAME_AGREEMENT:
            self.enough = min(self.enough, max(shares) - SAME_AGREEMENT)
            self.events.decided(STAGE, f"another start came to the same, {100 * shares[-1]:.1f} % of the matches")
            return True
        return False


def _grow_models(
    empty: Reconstruction, mapper_of: Callable[..., Mapper], starts: Starts,
    begun: Sequence[Reconstruction] = (), *, is_apart: bool = False,
) -> tuple[list[Reconstruction], list[StartReport]]:  # fmt: skip
    """One model after another, each begun from images that no earlier one holds, and the initial pairs tried; before
    these such as were finished earlier go on, which leave each other's images alone where they are to stay apart.

    A model may grow into images of earlier, smaller ones: it may see more of the points that they need. But one that
    holds most of the images is not handed over to what it refused itself, as repeated structure would have it.
    """
    models: list[Reconstruction] = []
    initial_reports: list[StartReport] = []
    options, events = starts.options, starts.events
    seeds = np.ones(len(empty.image_names), bool)
    locked = np.zeros(len(seeds), bool)
    for taken_up in begun:
        others = [other.is_registered & ~taken_up.is_registered for other in begun if is_apart]
        mapper = mapper_of(taken_up, np.any([locked, *others], axis=0))
        mapper.take_up()
        events.advanced(STAGE, int(taken_up.is_registered.sum()))
        mapper.grow()
        mapper.finish()
        seeds &= ~taken_up.is_registered
        models.append(taken_up)
        if 2 * taken_up.is_registered.sum() > len(seeds):
            locked = locked | taken_up.is_registered
    while seeds.sum() >= 2 and (options.multiple_models or not models):
        model, tried = _grow_model(empty, seeds, partial(mapper_of, locked=locked), starts)
        initial_reports.append(StartReport(pairs=tried))
        if model is None:
            break
        seeds &= ~model.is_registered
        num_images, num_points = int(model.is_registered.sum()), int(model.is_triangulated.sum())
        if num_images >= min(options.min_model_images, len(seeds)) and num_points >= options.min_pose_inliers:
            models.append(model)
            if 2 * num_images > len(seeds):
                locked = locked | model.is_registered
        else:
            events.decided(STAGE, f"model dropped: {num_images} images, {num_points} points")
    return models, initial_reports


def _grow_model(
    empty: Reconstruction, seeds: NDArray[np.bool_], mapper_of: Callable[[Reconstruction], Mapper], starts: Starts
) -> tuple[Reconstruction | None, list[InitialPairReport]]:
    """A model grown from two of the seeds (I,) bool, None if there is no pair to start from, and the pairs tried.

    A start may be bad, however good it looks: few points, a small angle, a guess at the focal length. Then the map is
    bent, and verified matches do not meet in it. If too few agree, the model is grown anew from other images, from
    those it did not reach if there are any, unless two have come to the same. The one that most matches agree with is
    kept, so that it does not hang on chance which start looked best.
    """
    best: Reconstruction | None = None
    shares: list[float] = []
    most, seeds = -math.inf, seeds.copy()
    tried: list[InitialPairReport] = []
    for _ in range(MAX_STARTS):
        model = empty.copy()
        mapper = mapper_of(model)
        tried += mapper.start(seeds)
        start = model.registered_idx
        if len(start) == 0:
            break
        mapper.grow()
        mapper.finish()
        agreeing, matches = mapper.agreement()
        # more photographs are worth having only where they agree with what there is
        worth = agreeing - WEIGHT_AGAINST * (matches - agreeing)
        shares.append(agreeing / matches if matches else 1.0)
        is_last = starts.is_last(model, best, shares)
        if worth > most:
            best, most = model, worth
        if is_last:
            break
        starts.events.decided(
            STAGE, f"{agreeing} of {matches} verified matches agree with the model: trying another start"
        )
        seeds[start] = False
        if (seeds & ~model.is_registered).sum() >= 2:
            seeds &= ~model.is_registered
    return best, tried


def _without_parts(models: list[Reconstruction]) -> list[Reconstruction]:
    """The models, largest first, without those whose images a larger one holds all.

    A model may grow into images of an earlier one, as it may see more of the points that they need.
    """
    kept: list[Reconstruction] = []
    for model in sorted(models, key=lambda model: -int(model.is_registered.sum())):
        if not any((larger.is_registered | ~model.is_registered).all() for larger in kept):
            kept.append(model)
    return kept


def _merge_models(
    models: list[Reconstruction],
    mapper_of: Callable[..., Mapper],
    correspondences: Correspondences,
    options: MappingOptions,
    events: Events,
) -> tuple[list[Reconstruction], list[str]]:
    """Join smaller models to larger ones where shared images, points or pairs tell how they lie to each other.

    What is joined may reach a third one, so that it goes on until nothing can be joined any more.

    Returns:
        The models, the largest first, and for each why it was not joined to the first of the others that it was held
        against; empty if there is none.
    """
    merged: list[Reconstruction] = []
    refused: list[tuple[Reconstruction, Reconstruction, str]] = []
    for source in models:
        n = 0
        while n < len(merged):
            union, reason = _union(merged[n], source, mapper_of, correspondences, options, events)
            if union is None:
                refused.append((merged[n], source, reason))
                n += 1
            else:
                del merged[n]
                source, n = union, 0
        merged.append(source)
    merged.sort(key=lambda model: -int(model.is_registered.sum()))
    return merged, [_apart(model, merged, refused) for model in merged]


def _apart(
    model: Reconstruction,
    models: list[Reconstruction],
    refused: list[tuple[Reconstruction, Reconstruction, str]],
) -> str:
    """Why a model is not one with the first of the others that it was held against."""
    for m, other in enumerate(models):
        for target, source, reason in refused:
            if {id(target), id(source)} == {id(model), id(other)}:
                return f"apart from model {m}: {reason}"
    return ""


def _union(
    target: Reconstruction,
    source: Reconstruction,
    mapper_of: Callable[..., Mapper],
    correspondences: Correspondences,
    options: MappingOptions,
    events: Events,
) -> tuple[Reconstruction | None, str]:
    """Two models in one, or None and the reason if they cannot be joined."""
    through_image = find_merge(target, source)
    if through_image is not None:
        target_from_source, votes = through_image
        union = merge(target, source, target_from_source)
        mapper = mapper_of(union)
        mapper.adjust_globally()
        mapper.grow()
        mapper.finish()
        new = union.is_registered & ~target.is_registered
        # images that both models had do not count: they hold the new ones at any scale
        link = num_linking_points(union, new, target.is_registered & ~source.is_registered)
        if link >= options.min_pose_inliers:
            events.decided(STAGE, f"merged two models by {votes} common points: {int(new.sum())} images more")
            return union, ""
    matched = in_common_cameras(target, source, mapper_of)
    joint = find_joint(*matched, correspondences, options)
    reason, union = joint.reason, target
    if not reason:
        union = unite(*matched, joint, mapper_of, options)
        reason = holds_together(union, target, source, correspondences, options)
    sizes = f"of {int(target.is_registered.sum())} and {int(source.is_registered.sum())} images"
    if reason:
        events.decided(STAGE, f"two models {sizes} are kept apart: {reason}")
        return None, reason
    share = f"{joint.num_agreeing} of {joint.num_links} points that both see agree"
    events.decided(STAGE, f"joined two models {sizes}: {share}")
    return union, ""


def _with_left_over(
    models: list[Reconstruction], mapper_of: Callable[..., Mapper], correspondences: Correspondences, events: Events
) -> list[Reconstruction]:
    """Models with the images that none of them holds, where these waited for another model and none came of it.

    They come with what evidence there is, and go again if their verified pairs contradict it.
    """
    out: list[Reconstruction] = []
    for model in models:
        taken = np.any([other.is_registered for other in [*models, *out]], axis=0)
        if taken.all():
            out.append(model)
            continue
        grown = model.copy()
        mapper = mapper_of(grown, taken & ~model.is_registered)
        mapper.waits = False
        mapper.grow()
        new = grown.is_registered & ~model.is_registered
        if not new.any():
            out.append(model)
            continue
        mapper.finish()
        agreement = verified_pairs.pair_agreement(grown, correspondences)
        with_new = new[agreement.image_idx].any(axis=1)
        agreeing, matches = int(agreement.num_agreeing[with_new].sum()), int(agreement.num_matches[with_new].sum())
        is_kept = agreeing > verified_pairs.AGREES * matches and grown.is_registered[model.is_registered].all()
        events.decided(
            STAGE,
            f"{int(new.sum())} images held back {'are registered last' if is_kept else 'do not fit'}: {agreeing} of "
            f"their {matches} verified matches agree",
        )
        out.append(grown if is_kept else model)
    return out


def no_reconstruction(report: MappingReport, here: OnePlace | None) -> NoReconstructionError:
    """The failure of a run in which no model could be started: what all pairs have in common, or the reason of the
    best."""
    pairs = report.initial_pairs[0].pairs if report.initial_pairs else []
    reason = pairs[0].reason if pairs else "no two images share enough verified matches"
    advice = "take photographs that overlap by more than half while moving sideways between them"
    if here is not None:
        reason, advice = here.describe()
    error = NoReconstructionError(f"no initial pair: {reason}", advice)
    error.report = report
    return error


def first_cameras(
    cameras: Sequence[Camera],
    image_camera_idx: NDArray[np.int32],
    correspondences: Correspondences,
    tracks: Tracks,
    options: MappingOptions,
    events: Events,
) -> tuple[list[Camera], FocalReport]:
    """The cameras with a focal length from the pairs where nothing else is known."""
    cameras = list(cameras)
    if not options.estimate_focal:
        return cameras, FocalReport()
    ratio, report = estimate_focal_ratio(cameras, image_camera_idx, correspondences, tracks)
    if ratio is None:
        return cameras, report
    events.decided(STAGE, f"first focal length {ratio:.2f} x the longer side, from {report.num_pairs} pairs", **report)
    return [c.with_focal(ratio * max(c.width, c.height)) if c.focal_source == "default" else c for c in cameras], report


def image_reports(
    names: list[str], models: list[Reconstruction], attempts: dict[int, Registration]
) -> list[MappedImage]:
    """Per image: the model it is in, its points and observations, and what the last attempt to register it met."""
    reports = []
    for i, name in enumerate(names):
        model = next((m for m, r in enumerate(models) if r.is_registered[i]), None)
        attempt = attempts.get(i)
        reason, num_observations = "", 0
        if model is not None:
            reconstruction = models[model]
            num_observations = int(reconstruction.obs_is_inlier[reconstruction.tracks.observations_of_image(i)].sum())
        else:
            reason = attempt.reason if attempt is not None else "shares too few verified matches with any model"
        reports.append(
            MappedImage(
                name=name,
                model=model,
                reason=reason,
                num_observations=num_observations,
                num_correspondences=attempt.num_correspondences if attempt is not None else None,
                num_pose_inliers=attempt.num_inliers if attempt is not None else None,
            )
        )
    return reports


def compile_kernels() -> None:
    """Compile the kernels of this module, or load them from numba's cache."""
    from sfmapp.scene.synthetic import make_scene, true_correspondences

    scene = make_scene(0, 3, 24)
    features = [
        Features(
            np.zeros((len(scene.keypoints(i)), 4), np.float32), np.zeros((0, 128), np.uint8), np.zeros((0, 3), np.uint8)
        )
        for i in range(3)
    ]
    build_tracks(true_correspondences(scene, min_matches=1), features)
    NextImages(scene.observed).rank(scene.observed, np.arange(3))
