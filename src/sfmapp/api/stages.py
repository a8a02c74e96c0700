"""The stages of a reconstruction one by one, in memory: photographs, features, matches, models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfmapp.adjust.linear import one_blas_thread
from sfmapp.adjust.options import AdjustOptions
from sfmapp.api.images import load_images
from sfmapp.api.reconstruction import Reconstruction
from sfmapp.errors import InputError
from sfmapp.events import Events
from sfmapp.features import extract
from sfmapp.features.extract import FeatureOptions
from sfmapp.images.image_set import ImageSet
from sfmapp.images.load import Images
from sfmapp.mapping import incremental
from sfmapp.mapping.options import MappingOptions
from sfmapp.matching import pairs as pair_selection
from sfmapp.matching import stage
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.pairs import PairOptions
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.features import Features
from sfmapp.workspace.options import num_threads

PairOfImages = tuple[int, int] | tuple[str, str]


class Matcher(Protocol):
    """A matcher of keypoints in place of our own: LightGlue, SuperGlue, or a nearest-neighbour search of yours.

    Example:
        >>> class LightGlueMatcher:
        ...     def match(self, first, second):
        ...         return lightglue(first.keypoints, first.descriptors, second.keypoints, second.descriptors)
        >>> correspondences = sfmapp.match_images(images, features, matcher=LightGlueMatcher())
    """

    def match(self, first: Features, second: Features) -> NDArray[np.integer]:
        """Matches of two images before verification.

        Called for one pair after the other, always in the thread that called ``match_images``.

        Args:
            first, second: features of the two images, as they were given.

        Returns:
            (K, 2) whole numbers, positions of the matched keypoints in both.
        """
        ...


def extract_features(
    images: Images,
    options: FeatureOptions | None = None,
    *,
    events: Events | None = None,
    threads: int | None = None,
) -> list[Features]:
    """Find and describe keypoints: SIFT, or ORB where ``options.kind`` says so.

    Args:
        images: whatever ``load_images`` takes, or what it gives.
        options: kind, number and thresholds.
        events: told of progress, image by image, and warned of images without features.
        threads: images worked on at a time, at most; None: one for each core. The result does not depend on it.

    Returns:
        :class:`Features` of the I images in their order; none for an image that cannot be read.

    Raises:
        InputError: the images do not exist, or an array is no picture.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> features = sfmapp.extract_features({"left": left, "right": right})
        >>> features[0].keypoints[:, :2], features[0].descriptors
    """
    with one_blas_thread():
        image_set = load_images(images, events=events, threads=threads)
        options, workers = options or FeatureOptions(), num_threads(threads)
        return extract.extract_features(image_set, options, threads=workers, events=events or Events())[0]


def match_images(
    images: ImageSet,
    features: Sequence[Features],
    pairs: Sequence[PairOfImages] | NDArray[np.integer] | PairOptions | None = None,
    options: MatchingOptions | None = None,
    *,
    matcher: Matcher | None = None,
    matches: Mapping[PairOfImages, ArrayLike] | None = None,
    events: Events | None = None,
    threads: int | None = None,
    seed: int = 0,
) -> Correspondences:
    """Match keypoints between images and verify the matches by two-view geometry.

    Args:
        images: from ``load_images``.
        features: one for each image, all of one metric, our own or yours (``Features.from_arrays``).
        pairs: which images to match, (P, 2) positions or names; or how to choose them. None: all pairs of a small set,
            else those that look alike or follow each other (see ``PairOptions``).
        options: thresholds of matching and verification.
        matcher: pairs the keypoints in place of our own search.
        matches: the matches themselves, (K, 2) positions of keypoints in both images, by pair of positions or names;
            ``pairs`` and ``matcher`` are not used.
        events: told of progress.
        threads: pairs worked on at a time; None: as many as there are cores. The result does not depend on it.
        seed: of RANSAC and of the choice of pairs.

    Returns:
        The verified :class:`Correspondences`, pairs in ascending order of their positions.

    Raises:
        InputError: features of two kinds, one too few, or positions of images or keypoints that are not there.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> images = sfmapp.load_images("photos/")
        >>> features = sfmapp.extract_features(images)
        >>> correspondences = sfmapp.match_images(images, features)
        >>> correspondences.num_inliers  # of each pair
    """
    _check_one_for_each(images, features)
    options, events, workers = options or MatchingOptions(), events or Events(), num_threads(threads)
    with one_blas_thread():
        if matches is not None:
            found = _by_position(images, matches)
            return stage.verify_matches(
                images, features, ((i, j, found[i, j]) for i, j in sorted(found)), options,
                seed=seed, threads=workers, events=events,
            )[0]  # fmt: skip
        chosen = _chosen_pairs(images, features, pairs, seed=seed, threads=workers, events=events)
        if matcher is not None:
            answers = ((i, j, matcher.match(features[i], features[j])) for i, j in chosen.tolist())
            return stage.verify_matches(
                images, features, answers, options, seed=seed, threads=workers, events=events
            )[0]  # fmt: skip
        return stage.match_images(images, features, chosen, options, seed=seed, threads=workers, events=events)[0]


def map_images(
    images: ImageSet,
    features: Sequence[Features],
    correspondences: Correspondences,
    options: MappingOptions | None = None,
    *,
    adjust_options: AdjustOptions | None = None,
    events: Events | None = None,
    threads: int | None = None,
) -> list[Reconstruction]:
    """Reconstruct cameras and points from verified matches: incremental structure from motion.

    Args:
        images: names and cameras, from ``load_images``.
        features: keypoints of each image; descriptors are not looked at.
        correspondences: verified matches, from ``match_images``.
        options: what is accepted, and when everything is adjusted.
        adjust_options: of the bundle adjustments.
        events: told of every decision.
        threads: workers; None: as many as there are cores. The result does not depend on it.

    Returns:
        Models, the one with most images first, each in a world and a unit of length of its own.

    Raises:
        NoReconstructionError: no model could be started; its ``report`` tells what was tried.
        InputError: one feature too few.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> models = sfmapp.map_images(images, features, correspondences)
        >>> models[0].image("a.jpg").cam_from_world
    """
    _check_one_for_each(images, features)
    with one_blas_thread():
        models, _ = incremental.map_images(
            images, features, correspondences, options or MappingOptions(),
            adjust_options=adjust_options or AdjustOptions(), threads=num_threads(threads), events=events or Events(),
        )  # fmt: skip
    keypoints = [found.keypoints[:, :2].astype(np.float64) for found in features]
    return [Reconstruction.of(model, keypoints) for model in models]


def _check_one_for_each(images: ImageSet, features: Sequence[Features]) -> None:
    if len(images.images) != len(features):
        raise InputError(f"features: expected one of each of {len(images.images)} images, found {len(features)}")


def _chosen_pairs(
    images: ImageSet, features: Sequence[Features], pairs: Any, *, seed: int, threads: int, events: Events
) -> NDArray[np.int32]:
    """(P, 2) positions i < j, ascending, none twice."""
    if pairs is None or isinstance(pairs, PairOptions):
        options = pairs or PairOptions()
        return pair_selection.select_pairs(images, features, options, seed=seed, threads=threads, events=events)[0]
    chosen = sorted(_by_position(images, {tuple(pair): None for pair in pairs}))
    return np.array(chosen, np.int32).reshape(-1, 2)


def _by_position(images: ImageSet, by_pair: Mapping[Any, Any]) -> dict[tuple[int, int], Any]:
    """The same by positions i < j; arrays (K, 2) are turned round with their pair.

    Raises:
        InputError: an image that is not there, is paired with itself, or a pair that comes twice.
    """
    position = {name: i for i, name in enumerate(images.names)}
    found: dict[tuple[int, int], Any] = {}
    for pair, value in by_pair.items():
        first, second = (position.get(key, -1) if isinstance(key, str) else int(key) for key in pair)
        low, high = min(first, second), max(first, second)
        if low < 0 or high >= len(position) or low == high or (low, high) in found:
            raise InputError(f"pair {pair}: expected two of {len(position)} images by position or name, each pair once")
        found[low, high] = value if value is None or low == first else np.asarray(value)[..., ::-1]
    return found
