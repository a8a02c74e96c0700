"""What the choice of pairs and their matching have brought."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sfmapp.reporting import Report


class PairsReport(Report):
    """What the stage ``pairs`` chose.

    Attributes:
        reason: why by this method, in words.
        num_images: those that have features.
        num_possible: pairs of them in all.
        num_by_source: pairs by what proposed them; a pair may have been proposed twice.
    """

    method: str
    reason: str
    num_images: int
    num_pairs: int
    num_possible: int
    num_by_source: Mapping[str, int]
    images_without_features: Sequence[str]
    min_pairs_per_image: int


class PairReport(Report):
    """One pair that was matched.

    Attributes:
        image_idx: positions i < j of the images.
        config: of its two-view geometry; see :class:`~sfmapp.scene.correspondences.TwoViewConfig`.
        num_coarse: matches among the largest features that were to guide the others; None if there was no need.
        is_guided: they did.
        num_compared: features of each image, largest first, that showed nothing in common, so that the rest was left
            out; None: all were compared.
        num_putative, num_verified: matches before and after verification.
        num_inliers_f, num_inliers_e, num_inliers_h: of fundamental matrix, essential matrix and homography.
        median_angle_deg: between the rays of its matches; None: not known.
    """

    image_idx: tuple[int, int]
    config: str
    num_coarse: int | None
    is_guided: bool
    num_compared: int | None
    num_putative: int
    num_verified: int
    num_inliers_f: int
    num_inliers_e: int
    num_inliers_h: int
    median_angle_deg: float | None
    cpu_s: float


class MatchingReport(Report):
    """What the stage ``matching`` found.

    Attributes:
        num_resumed_pairs: those of an earlier run.
        num_matches: verified ones, of all pairs.
        num_unlike_pairs: pairs whose largest features showed nothing in common.
        num_pairs_with_moving_plane: pairs in which something flat moves differently from the scene.
        configs: pairs by their two-view geometry.
        cpu_s: of the workers.
    """

    num_pairs: int
    num_resumed_pairs: int
    num_verified_pairs: int
    num_matches: int
    num_unlike_pairs: int
    num_pairs_with_moving_plane: int
    configs: Mapping[str, int]
    cpu_s: float
    wall_s: float
    pairs: Sequence[PairReport]
