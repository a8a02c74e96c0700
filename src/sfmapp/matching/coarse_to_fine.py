"""Putative matches of a pair: in full, or guided by those of the largest features."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.geometry.fundamental_refinement import polish_fundamental
from sfmapp.matching.binary import match_binary
from sfmapp.matching.descriptors import mutual_neighbors
from sfmapp.matching.euclidean import match_euclidean
from sfmapp.matching.guided import GuidedImage, change_of_shape, match_guided
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.products import Ints, ProductSearch
from sfmapp.matching.search import Ransac, find_fundamental, is_significant
from sfmapp.matching.second_motion import has_second_motion
from sfmapp.scene.features import DescriptorMetric, Features

# The coarse epipolar lines are off by more than the noise of the matches that they rest on.
_BAND_PER_THRESHOLD = 2.0
# Guided matches fit the lines that they were sought along, so they are no evidence for them. Repeated structure offers
# several geometries, each with its share of the matches. Measured: 0.7 to 1 on 142 of 143 true pairs, 0.2 to 0.6 on
# pairs that only look alike.
_MIN_COARSE_SHARE = 0.7
# Of the matches that the coarse ones promise, in proportion to the number of features, so many must be found.
_MIN_KEPT_PROMISE = 0.5
# Two images have nothing in common where matches of the largest features, a quarter to a half of all, promise less than
# this share of the inliers that a pair needs even by a stricter ratio test. A look at fewer lost a true pair of 17.
_SURE_RATIO, _MIN_SURE_SHARE = 0.75, 0.5


@dataclass(frozen=True)
class Putative:
    """Matches before verification.

    Attributes:
        matches: (K, 2) int32 positions in both images; no position occurs twice.
        fundamental: (3, 3) that guided them, None if they were matched in full.
        num_coarse: matches among the largest features, None if they were not tried first.
        num_compared: features of each image after which there was no more hope, None where there was.
    """

    matches: NDArray[np.int32]
    fundamental: NDArray[np.float64] | None = None
    num_coarse: int | None = None
    num_compared: int | None = None


def is_guidable(features: Features, options: MatchingOptions) -> bool:
    """Whether an image has so many SIFT features that guided matching pays."""
    return features.metric == DescriptorMetric.ROOT_SIFT and len(features) >= 2 * options.coarse_features


def match_features(
    features: tuple[Features, Features],
    backgrounds: tuple[Ints | None, Ints | None],
    threshold_px: float,
    options: MatchingOptions,
    ransac: Ransac,
) -> Putative:
    """Match all features of two images.

    Args:
        backgrounds: from ``background_of``; the pair is matched in full unless both are there.
        threshold_px: what counts as fitting the coarse epipolar geometry.

    Raises:
        InputError: descriptors of two kinds.
    """
    first, second = (f.descriptors for f in features)
    metric = _common_metric(*features)
    if metric != DescriptorMetric.ROOT_SIFT:
        match = match_binary if metric == DescriptorMetric.HAMMING else match_euclidean
        return Putative(match(first, second, options.max_ratio, options.max_distance))
    search = ProductSearch(first, second, features[0].is_dark, features[1].is_dark)
    limits, num_coarse = (options.max_ratio, options.max_distance), None
    if backgrounds[0] is not None and backgrounds[1] is not None:
        images = GuidedImage.of(features[0], backgrounds[0]), GuidedImage.of(features[1], backgrounds[1])
        coarse = mutual_neighbors(*search.among_first(options.coarse_features), *limits)
        found = _match_coarse_to_fine(*images, coarse, threshold_px, options, ransac)
        if found is not None:
            return found
        num_coarse, num_all = len(coarse), min(len(first), len(second))
        # What this look shows guides nothing: more pairs were guided, and cameras of a courtyard 3 % farther off.
        size = _size_of_last_look(num_all, options)
        best = search.among_first(size)
        num_sure = len(mutual_neighbors(*best, min(_SURE_RATIO, options.max_ratio), options.max_distance))
        if num_sure * num_all < _MIN_SURE_SHARE * options.min_inliers * size:
            return Putative(mutual_neighbors(*best, *limits), None, num_coarse, size)
    best = search.among_first(max(len(first), len(second)))
    return Putative(mutual_neighbors(*best, *limits), None, num_coarse)


def _size_of_last_look(num_features: int, options: MatchingOptions) -> int:
    """Features of each image, largest first, that are compared before all are: no more than half of them."""
    return options.coarse_features * (2 if 4 * options.coarse_features <= num_features else 1)


def _common_metric(first: Features, second: Features) -> DescriptorMetric:
    length1, length2 = first.descriptors.shape[1], second.descriptors.shape[1]
    if first.metric != second.metric or length1 != length2:
        raise InputError(
            f"descriptors of two kinds cannot be compared: {length1} numbers with the metric {first.metric}, "
            f"{length2} with {second.metric}"
        )
    return first.metric


def _match_coarse_to_fine(
    image1: GuidedImage,
    image2: GuidedImage,
    coarse: NDArray[np.int32],
    threshold_px: float,
    options: MatchingOptions,
    ransac: Ransac,
) -> Putative | None:
    """Matches of all features guided by coarse ones (K, 2); None where these are not to be trusted."""
    if len(coarse) < max(options.min_inliers, 8):
        return None
    xy1, xy2 = _points(image1, image2, coarse)
    needed = max(options.min_inliers, _MIN_COARSE_SHARE * len(coarse))
    fundamental = find_fundamental(xy1, xy2, threshold_px, ransac, needed / len(coarse))
    if fundamental is None:
        return None
    fundamental, inlier = polish_fundamental(fundamental, xy1, xy2, threshold_px, ransac.seed)
    extent = image2.extent
    if inlier.sum() < needed:
        return None
    if not is_significant(inlier, threshold_px, extent):
        return None
    if has_second_motion(xy1, xy2, inlier, threshold_px, extent, options, ransac):
        return None
    change, limits = change_of_shape(image1, image2, coarse[inlier]), (options.max_ratio, options.max_distance)
    guided = match_guided(image1, image2, fundamental, _BAND_PER_THRESHOLD * threshold_px, change, *limits)
    xy1, xy2 = _points(image1, image2, guided)
    fundamental, guided_inlier = polish_fundamental(fundamental, xy1, xy2, threshold_px, ransac.seed)
    num_all = min(len(image1.descriptors), len(image2.descriptors))
    promise = inlier.sum() * num_all / options.coarse_features
    if guided_inlier.sum() < _MIN_KEPT_PROMISE * promise:
        return None
    return Putative(guided, fundamental, len(coarse))


def _points(
    image1: GuidedImage, image2: GuidedImage, matches: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return (
        np.ascontiguousarray(image1.shape[matches[:, 0], :2]),
        np.ascontiguousarray(image2.shape[matches[:, 1], :2]),
    )
