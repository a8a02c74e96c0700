"""Whether the mapper would begin a model with a pair: its own function is asked."""

from __future__ import annotations

import numpy as np

from sfmapp.mapping.initialize import initial_angles, rank_initial_pairs
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.tracks import build_tracks
from sfmapp.matching.stage import MatchedPair, join_pairs
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.twoview.report import StartStep
from sfmapp.twoview.view import View


def start_of(views: tuple[View, View], pair: MatchedPair, options: MappingOptions) -> StartStep:
    """What the mapper thinks of the pair as a start, if it had no other."""
    correspondences = join_pairs(np.array([[0, 1]], np.int32), [pair])
    tracks, _ = build_tracks(correspondences, [view.features for view in views])
    empty = Reconstruction.empty(
        [view.camera for view in views], [view.name for view in views], np.array([0, 1], np.int32), tracks
    )
    ranked = rank_initial_pairs(empty, correspondences, np.ones(2, np.bool_), options)
    wanted = options.min_initial_inliers, options.min_initial_angle_deg
    if not ranked:
        reason = f"{len(pair.matches)} verified matches, {options.min_pose_inliers} are the fewest that it looks at"
        return StartStep(
            would_begin=False, num_points=0, min_points=wanted[0], median_angle_deg=0.0, min_angle_deg=wanted[1],
            score=0.0, reason=reason, fallback="",
        )  # fmt: skip
    first = ranked[0]
    reason = first.reason or first.shortfall(*wanted)
    least = options.min_pose_inliers, initial_angles(options)[-1]
    fallback = ""
    if reason and not first.reason:
        short = first.shortfall(*least)
        fallback = (
            f"if no pair reached this it would ask for less, down to {least[0]} points under {least[1]:.2g} degrees: "
            + (f"that too is missed ({short})" if short else "then it would begin with it")
        )
    return StartStep(
        would_begin=not reason, num_points=first.num_points, min_points=wanted[0],
        median_angle_deg=first.median_angle_deg, min_angle_deg=wanted[1], score=first.score, reason=reason,
        fallback=fallback,
    )  # fmt: skip
