"""The story of two photographs: each step of two-view geometry on its own matches, beside what the main path makes of
them.

Pixels are those of the photographs as stored. F, H and their lines are of these, E and poses of normalised image points
without the lens' distortion.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import pixels_to_normalized
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.mapping.incremental import first_cameras
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.tracks import build_tracks
from sfmapp.matching import guided
from sfmapp.matching.coarse_to_fine import is_guidable
from sfmapp.matching.descriptors import NeighborSteps, neighbor_steps
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.search import Ransac
from sfmapp.matching.stage import MatchedPair, join_pairs, match_pair
from sfmapp.matching.two_view import error_threshold_px
from sfmapp.scene.correspondences import TwoViewConfig
from sfmapp.scene.features import DescriptorMetric
from sfmapp.twoview import steps
from sfmapp.twoview.focal import with_told_focal
from sfmapp.twoview.kinds import kind_of_pair
from sfmapp.twoview.planes import planes_of
from sfmapp.twoview.report import NeighborsStep, PlaneStep, StoryReport
from sfmapp.twoview.start import start_of
from sfmapp.twoview.view import View

Array = NDArray[np.float64]
Ints = NDArray[np.int32]

STAGE = "story"


@dataclass(frozen=True)
class Story:
    """What is drawn beside what is said.

    Attributes:
        report: all that is said.
        views: both photographs; their cameras are those that the mapper would begin with, or, where nothing is known of
            a focal length, with the one that F tells.
        nearest: (N, 2) int32 keypoints before the ratio test. ratio: (K, 2) after it. putative: (M, 2) after the mutual
            check as well; the lesson's matches.
        is_own, is_main: (M,) bool, explained by F of plain RANSAC, and of the main path.
        verified: (V, 2) int32, of the main path.
        fundamental: (3, 3) refined, for the lines; NaN without one.
        used: (P, 2) int32 matches that the poses are judged by. poses: (4, 7). points: (4, P, 3) triangulated in the
            frame of camera 1, not finite where rays are parallel. in_front: (4, P) bool.
        plane_of: (P,) which plane of the report each of ``used`` is on; -1 for none.
    """

    report: StoryReport
    views: tuple[View, View]
    nearest: Ints
    ratio: Ints
    putative: Ints
    is_own: NDArray[np.bool_]
    is_main: NDArray[np.bool_]
    verified: Ints
    fundamental: Array = field(default_factory=lambda: np.full((3, 3), np.nan))
    used: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int32))
    poses: Array = field(default_factory=lambda: np.zeros((0, 7)))
    points: Array = field(default_factory=lambda: np.zeros((0, 0, 3)))
    in_front: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), np.bool_))
    plane_of: Ints = field(default_factory=lambda: np.zeros(0, np.int32))


def tell_story(
    views: tuple[View, View],
    matching: MatchingOptions,
    mapping: MappingOptions,
    *,
    seed: int,
    events: Events,
    known: MatchedPair | None = None,
) -> Story:
    """Go through two-view geometry with two photographs, step by step.

    Args:
        views: the photographs with their features and what is known of their cameras.
        matching, mapping: as of a reconstruction; what the main path does obeys them.
        known: of an earlier run; None: the pair is matched and verified here, as that would.

    Raises:
        InputError: a lens that shows what is beside or behind the camera, for which no F holds.
    """
    for view in views:
        if view.camera.is_wide:
            raise InputError(
                f"{view.name}: its lens sees more than 88 degrees off the axis, where there is no fundamental matrix",
                "make ordinary photographs of it first: sfmapp undistort",
            )
    events.started(STAGE, "two views, step by step")
    pair = known or _match(views, matching, seed)
    views = _with_first_cameras(views, pair, mapping, events)
    found = _neighbors(views, matching)
    threshold = error_threshold_px(views[0].camera, views[1].camera, matching)
    xy1, xy2 = (np.ascontiguousarray(view.xy[found.mutual[:, side]]) for side, view in enumerate(views))
    lesson = steps.Lesson(xy1, xy2, views[0].camera, views[1].camera, threshold, matching, seed)
    ransac, own = steps.search(lesson, pair)
    told = StoryReport(
        keypoints=[steps.keypoints(view.name, view.camera, view.features) for view in views],
        neighbors=None if found.is_unknown else NeighborsStep(
            num_nearest=len(found.nearest), num_after_ratio=len(found.ratio), num_mutual=len(found.mutual),
            max_ratio=matching.max_ratio, max_distance=matching.max_distance,
        ),
        ransac=ransac, eight_point=None, epipoles=None, essential=None, choice=None, triangulation=[],
        homography=None, planes=[], start=start_of(views, pair, mapping),
        kind="unknown", kind_reason="", config=TwoViewConfig(pair.geometry.config).name,
        num_verified=len(pair.matches), ended="",
    )  # fmt: skip
    # what a mapper does is told of its own cameras, the rest of what the pair itself tells of them
    views = with_told_focal(views, pair.matches, pair.geometry.fundamental)
    told = replace(told, homography=steps.homography(views, pair, lesson))
    story = Story(told, views, found.nearest, found.ratio, found.mutual, own.is_own, own.is_main, pair.matches)
    story = _with_geometry(story, lesson, pair)
    kind, reason = kind_of_pair(story.report, views, pair)
    events.finished(STAGE, f"{kind}: {reason}")
    return replace(story, report=replace(story.report, kind=kind, kind_reason=reason))


def _with_geometry(story: Story, lesson: steps.Lesson, pair: MatchedPair) -> Story:
    """F, E, the four poses and points, as far as the matches carry."""
    told, views = story.report, story.views
    used = story.verified
    if len(used) < steps.LEAST:
        reason = (
            f"the main path verified {len(used)} matches, {steps.LEAST} are the fewest that an F is told from: "
            f"{steps.why_few(told)}"
        )
        return replace(story, report=replace(told, ended=reason))
    xy1, xy2 = (np.ascontiguousarray(view.xy[used[:, side]]) for side, view in enumerate(views))
    eight, fundamental = steps.eight_points(xy1, xy2)
    noise = max(eight.sigma_px, steps.LEAST_SIGMA_PX) if np.isfinite(eight.sigma_px) else steps.LEAST_SIGMA_PX
    xn1, xn2 = (pixels_to_normalized(view.camera, xy) for view, xy in zip(views, (xy1, xy2), strict=True))
    valid = np.isfinite(xn1).all(1) & np.isfinite(xn2).all(1)
    essential, choice = steps.poses(views, fundamental, (xn1[valid], xn2[valid]), noise, pair)
    points, in_front = steps.four_clouds(choice.poses, xn1[valid], xn2[valid])
    planes: list[PlaneStep] = []
    plane_of = np.full(int(valid.sum()), -1, np.int32)
    if pair.geometry.config != TwoViewConfig.PANORAMIC:  # where a turn explains all, every plane does
        search = Ransac(lesson.options.max_ransac_trials, lesson.seed)
        px = noise, lesson.threshold_px
        planes, plane_of = planes_of(views, used[valid], choice, px, search)
    told = replace(
        told,
        planes=planes,
        eight_point=eight,
        epipoles=steps.epipoles_of(fundamental, views[0].camera, views[1].camera),
        essential=essential,
        choice=steps.choice_step(choice, xn1[valid], xn2[valid], noise / steps.mean_focal(views), views),
        triangulation=steps.ways(choice.pose, (xn1[valid], xn2[valid]), noise / steps.mean_focal(views), views),
    )
    return replace(
        story, report=told, fundamental=fundamental, used=used[valid], poses=choice.poses, points=points,
        in_front=in_front, plane_of=plane_of,
    )  # fmt: skip


def _match(views: tuple[View, View], options: MatchingOptions, seed: int) -> MatchedPair:
    features = views[0].features, views[1].features
    backgrounds = [guided.background_of(each) if is_guidable(each, options) else None for each in features]
    cameras = views[0].camera, views[1].camera
    return match_pair(features, (backgrounds[0], backgrounds[1]), cameras, options, (seed, 0, 1))


def _neighbors(views: tuple[View, View], options: MatchingOptions) -> NeighborSteps:
    first, second = (view.features for view in views)
    if not (first.metric == second.metric == DescriptorMetric.ROOT_SIFT):
        return NeighborSteps.unknown()
    return neighbor_steps(first.descriptors, second.descriptors, options.max_ratio, options.max_distance)


def _with_first_cameras(
    views: tuple[View, View], pair: MatchedPair, options: MappingOptions, events: Events
) -> tuple[View, View]:
    """The cameras that a mapper would begin with: focal lengths from the pair where nothing else is known."""
    correspondences = join_pairs(np.array([[0, 1]], np.int32), [pair])
    tracks, _ = build_tracks(correspondences, [view.features for view in views])
    cameras, _ = first_cameras(
        [view.camera for view in views], np.array([0, 1], np.int32), correspondences, tracks, options, events
    )
    return replace(views[0], camera=cameras[0]), replace(views[1], camera=cameras[1])
