"""Which pairs of images are worth matching.

Small sets are matched exhaustively. For larger ones the candidates come from the images themselves: a vocabulary of
local descriptors is learnt from the set and every image becomes one vector (VLAD, Jegou et al., CVPR 2010, with the
normalisation of Arandjelovic and Zisserman, CVPR 2013), whose nearest neighbours are matched; where file names or
time stamps show a sequence, or photographs carry GPS, their neighbours join in.

All sums run over whole numbers below 2^24, which float32 holds exactly. The pairs therefore depend neither on the
number of threads nor on the order in which the linear algebra library adds up.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.geometry.geodesy import ecef_from_geodetic
from sfmapp.geometry.orientation import MIRRORED
from sfmapp.matching.report import PairsReport
from sfmapp.option_checks import Range, check_options
from sfmapp.scene.features import Features

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageRecord, ImageSet

STAGE = "pairs"

# descriptors that the vocabulary is learnt from: 256 for each of 64 words, beyond which faiss takes no more either
_SAMPLE_SIZE = 16384
_KMEANS_ROUNDS = 12
# length of an image vector in whole numbers: its square must stay below 2^24
_VLAD_LENGTH = 4000
_BLOCK_BYTES = 64 << 20
# how names of the frames of a video end before the number
_FRAME = re.compile(r"(?:^|[/_ -])frames?[_ -]?$", re.IGNORECASE)

_RANGES = {
    "exhaustive_limit": Range(0),
    "num_neighbors": Range(1),
    "num_words": Range(1),
    "num_query_features": Range(1),
    "sequence_overlap": Range(1),
    "num_gps_neighbors": Range(0),
}


@dataclass(frozen=True)
class PairOptions:
    """Options of the stage ``pairs``.

    Attributes:
        method: auto: exhaustive for small sets, otherwise the union of retrieval, sequence and GPS.
        exhaustive_limit: auto: largest set in which every image is paired with every other.
        num_neighbors: retrieval: most similar images that each image is paired with.
        num_words: retrieval: size of the vocabulary; more words distinguish finer differences and take more memory.
        num_query_features: retrieval: keypoints used of each image, the largest first.
        sequence_overlap: sequential: each image is paired with this many that follow it.
        sequence_quadratic: sequential: also with those 2, 4, 8, ... images ahead, up to 2 to the power of the overlap.
        num_gps_neighbors: GPS: nearest images that each image is paired with.
    """

    method: Literal["auto", "exhaustive", "retrieval", "sequential"] = "auto"
    exhaustive_limit: int = 60
    num_neighbors: int = 30
    num_words: int = 64
    num_query_features: int = 1500
    sequence_overlap: int = 10
    sequence_quadratic: bool = True
    num_gps_neighbors: int = 20

    def __post_init__(self) -> None:
        check_options("pairs", self, _RANGES)


def select_pairs(
    image_set: ImageSet,
    features: Sequence[Features],
    options: PairOptions,
    *,
    seed: int,
    threads: int,
    events: Events,
) -> tuple[NDArray[np.int32], PairsReport]:
    """Choose the pairs of images to match.

    Args:
        image_set: the images.
        features: their features, in the same order; images without any are left out.
        options: see :class:`PairOptions`.
        seed: of the run; only retrieval draws random numbers.
        threads: images worked on at a time. The result does not depend on it.

    Returns:
        (P, 2) int32 positions i < j, sorted and without repetition, and the report.
    """
    images = image_set.images
    usable = np.array([i for i, f in enumerate(features) if len(f)], np.int64)
    num_all = len(usable) * (len(usable) - 1) // 2
    method = options.method
    if method == "auto":
        method = "exhaustive" if len(usable) <= options.exhaustive_limit else "auto"
    events.started(STAGE, f"candidate pairs among {len(usable)} images", total=None)
    counts: dict[str, int] = {}
    if method == "exhaustive":
        reason = _exhaustive_reason(options, len(usable))
        pairs = np.column_stack(np.triu_indices(len(usable), 1))
        counts["exhaustive"] = len(pairs)
    else:
        records, chosen = [images[i] for i in usable], [features[i] for i in usable]
        sources = _candidates(records, chosen, method, options, seed=seed, threads=threads, events=events)
        counts = {name: len(found) for name, found in sources.items()}
        pairs = _unique_pairs(np.concatenate(list(sources.values())))
        reason = _reason(options, len(usable), counts)
    # a file that is stored as a mirror image shows nothing that one that is not could have seen
    is_mirrored = np.array([images[i].orientation in MIRRORED for i in usable], bool)
    pairs = pairs[is_mirrored[pairs[:, 0]] == is_mirrored[pairs[:, 1]]]
    result = usable[pairs].astype(np.int32).reshape(-1, 2)
    report = PairsReport(
        method=method,
        reason=reason,
        num_images=len(usable),
        num_pairs=len(result),
        num_possible=num_all,
        num_by_source=counts,
        images_without_features=[images[i].name for i, f in enumerate(features) if not len(f)],
        min_pairs_per_image=int(_degrees(result, len(images))[usable].min()) if len(usable) else 0,
    )
    events.decided(STAGE, f"{len(result)} of {num_all} pairs: {reason}", **report)
    events.finished(STAGE, f"{len(result)} pairs", **report)
    return result, report


def _candidates(
    records: Sequence[ImageRecord],
    features: Sequence[Features],
    method: str,
    options: PairOptions,
    *,
    seed: int,
    threads: int,
    events: Events,
) -> dict[str, NDArray[np.int64]]:
    """(P, 2) pairs by source: ``retrieval``, ``sequence``, ``gps``, as far as the method asks for them."""
    sources: dict[str, NDArray[np.int64]] = {}
    if method in ("auto", "retrieval"):
        sources["retrieval"] = retrieval_pairs(features, options, seed=seed, threads=threads, events=events)
    if method in ("auto", "sequential"):
        groups = find_sequences(records) if method == "auto" else sequences_by_folder(records)
        sources["sequence"] = sequence_pairs(groups, options)
    if method == "auto":
        sources["gps"] = gps_pairs(records, options.num_gps_neighbors)
    return sources


def _exhaustive_reason(options: PairOptions, num_images: int) -> str:
    if options.method == "exhaustive":
        return "exhaustive as asked for"
    return f"exhaustive, as {num_images} images are not more than pairs.exhaustive_limit = {options.exhaustive_limit}"


def _reason(options: PairOptions, num_images: int, counts: dict[str, int]) -> str:
    found = ", ".join(f"{count} from {name}" for name, count in counts.items())
    if options.method == "auto":
        limit = options.exhaustive_limit
        return f"{num_images} images are more than pairs.exhaustive_limit = {limit}: {found}"
    return f"{options.method} as asked for: {found}"


def _unique_pairs(pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sorted pairs i < j without repetition."""
    ordered = np.sort(pairs.reshape(-1, 2), axis=1)
    return np.unique(ordered[ordered[:, 0] < ordered[:, 1]], axis=0)


def _degrees(pairs: NDArray[np.int32], num_images: int) -> NDArray[np.int64]:
    return np.bincount(pairs.ravel(), minlength=num_images)


# ---------------------------------------------------------------------------------------------- retrieval


def retrieval_pairs(
    features: Sequence[Features], options: PairOptions, *, seed: int, threads: int, events: Events
) -> NDArray[np.int64]:
    """(P, 2) pairs i < j of images of which one is among those that look most like the other."""
    words = learn_vocabulary(features, options, seed=seed)
    events.raise_if_cancelled()
    vectors = np.empty((len(features), words.size), np.float32)

    def fill(i: int) -> None:
        events.raise_if_cancelled()
        vectors[i] = image_vector(features[i].whole_numbers(options.num_query_features), words)

    with ThreadPoolExecutor(max(1, threads)) as pool:
        list(pool.map(fill, range(len(features))))
    return _unique_pairs(nearest_vectors(vectors, options.num_neighbors))


def learn_vocabulary(features: Sequence[Features], options: PairOptions, *, seed: int) -> NDArray[np.float32]:
    """(K, D) whole-numbered words: k-means over a random sample of the descriptors."""
    rng = np.random.default_rng([seed, 0x7061697273])
    sample = _sample_descriptors(features, options.num_query_features, rng)
    distinct = np.unique(sample, axis=0)
    num_words = min(options.num_words, len(distinct))
    words = distinct[np.sort(rng.choice(len(distinct), num_words, replace=False))]
    for _ in range(_KMEANS_ROUNDS):
        nearest = _nearest_word(sample, words)
        counts = np.bincount(nearest, minlength=num_words)
        moved = np.rint(_sum_by_word(sample, nearest, num_words) / np.maximum(counts, 1)[:, None])
        # a word that lost all its descriptors stays where it is
        moved = np.where(counts[:, None] > 0, moved, words).astype(np.float32)
        if np.array_equal(moved, words):
            break
        words = moved
    return words


def _sample_descriptors(
    features: Sequence[Features], num_per_image: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """At most _SAMPLE_SIZE descriptors, the same number from every image as far as it has them."""
    share = max(1, _SAMPLE_SIZE // len(features))
    chosen = rng.permutation(len(features))[:_SAMPLE_SIZE]
    parts = []
    for i in np.sort(chosen):
        descriptors = features[i].whole_numbers(num_per_image)
        if len(descriptors) > share:
            descriptors = descriptors[np.sort(rng.choice(len(descriptors), share, replace=False))]
        parts.append(descriptors)
    return np.concatenate(parts)


def _nearest_word(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.int64]:
    """(N,) position of the word nearest to each descriptor; the first of equal ones."""
    half_square = (words.astype(np.float64) ** 2).sum(axis=1) / 2.0
    nearest = np.empty(len(descriptors), np.int64)
    step = max(1, _BLOCK_BYTES // (8 * len(words)))
    for start in range(0, len(descriptors), step):
        block = descriptors[start : start + step]
        np.argmin(half_square - block @ words.T, axis=1, out=nearest[start : start + step])
    return nearest


def _sum_by_word(descriptors: NDArray[np.float32], nearest: NDArray[np.int64], num_words: int) -> NDArray[np.float64]:
    """(K, D) sum of the descriptors of each word."""
    total = np.zeros((num_words, descriptors.shape[1]))
    # no more than 65536 at a time, so that sums of numbers below 256 are exact
    step = min(max(1, _BLOCK_BYTES // (4 * num_words)), 1 << 16)
    for start in range(0, len(descriptors), step):
        block = descriptors[start : start + step]
        is_of_word = np.zeros((num_words, len(block)), np.float32)
        is_of_word[nearest[start : start + step], np.arange(len(block))] = 1.0
        total += is_of_word @ block
    return total


def image_vector(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """VLAD of one image.

    Args:
        descriptors: (N, D) float32 of whole numbers.
        words: (K, D) float32 of whole numbers.

    Returns:
        (K * D,) float32 of whole numbers, of length _VLAD_LENGTH up to rounding; residuals are summed per word, rooted,
        normalised per word (so that a repeated texture counts once) and then as a whole.
    """
    nearest = _nearest_word(descriptors, words)
    counts = np.bincount(nearest, minlength=len(words))
    residual = _sum_by_word(descriptors, nearest, len(words)) - counts[:, None] * words.astype(np.float64)
    residual = np.sign(residual) * np.sqrt(np.abs(residual))
    residual /= np.maximum(np.linalg.norm(residual, axis=1, keepdims=True), 1e-12)
    length = max(float(np.sqrt((residual**2).sum())), 1e-12)
    # truncation never makes the vector longer, so its square stays below 2^24
    return np.trunc(residual.ravel() * (_VLAD_LENGTH / length)).astype(np.float32)


def nearest_vectors(vectors: NDArray[np.float32], num_neighbors: int) -> NDArray[np.int64]:
    """(N * k, 2) pairs of each row with its k most similar other rows; of equal ones the first."""
    num = len(vectors)
    k = min(num_neighbors, num - 1)
    if k < 1:
        return np.zeros((0, 2), np.int64)
    pairs = np.empty((num, k, 2), np.int64)
    step = max(1, _BLOCK_BYTES // (8 * num))
    for start in range(0, num, step):
        rows = np.arange(start, min(start + step, num))
        distance = -(vectors[rows] @ vectors.T)
        distance[np.arange(len(rows)), rows] = np.inf
        pairs[rows, :, 0] = rows[:, None]
        pairs[rows, :, 1] = np.argsort(distance, axis=1, kind="stable")[:, :k]
    return pairs.reshape(-1, 2)


# ----------------------------------------------------------------------------------------------- sequence


def sequence_pairs(groups: Iterable[Sequence[int]], options: PairOptions) -> NDArray[np.int64]:
    """(P, 2) pairs of each image with the next ones of its sequence, nearby ones and at doubling distances."""
    distances = set(range(1, options.sequence_overlap + 1))
    if options.sequence_quadratic:
        distances |= {1 << power for power in range(min(options.sequence_overlap, 20) + 1)}
    parts = [np.zeros((0, 2), np.int64)]
    for group in groups:
        order = np.asarray(group, np.int64)
        parts += [np.column_stack([order[:-d], order[d:]]) for d in sorted(distances) if d < len(order)]
    return _unique_pairs(np.concatenate(parts))


def sequences_by_folder(records: Sequence[ImageRecord]) -> list[list[int]]:
    """Positions of the images of each folder in the natural order of their names: 2 comes before 10."""
    groups: dict[str, list[int]] = defaultdict(list)
    for i, record in enumerate(records):
        groups[record.name.rpartition("/")[0]].append(i)
    return [sorted(group, key=lambda i: _natural(records[i].name)) for _, group in sorted(groups.items())]


def find_sequences(records: Sequence[ImageRecord]) -> list[list[int]]:
    """Runs of images that were taken one after the other, as far as their names or time stamps tell.

    A run of names differs in one number only, and the numbers are dense or mostly equally spaced, as those of a
    camera's roll or of the frames of a video are; those of photographs from many hands are neither. Names that say
    ``frame`` before the number are of one video, however far apart its frames were chosen. What is left is ordered by
    time stamp where one camera took it.
    """
    by_pattern: dict[tuple[str, str], list[tuple[int, int]]] = defaultdict(list)
    for i, record in enumerate(records):
        match = re.fullmatch(r"(.*?)(\d+)(\D*)", record.name)
        if match:
            by_pattern[match[1], match[3]].append((int(match[2]), i))
    groups = []
    for (before, _), numbered in sorted(by_pattern.items()):
        ordered = sorted(numbered)
        if _FRAME.search(before) or _is_regular([number for number, _ in ordered]):
            groups.append([i for _, i in ordered])
    taken = {i for group in groups for i in group}
    by_camera: dict[tuple[str, str, str], list[int]] = defaultdict(list)
    for i, record in enumerate(records):
        if i not in taken and record.timestamp is not None and (record.make or record.model):
            folder = record.name.rpartition("/")[0]
            by_camera[folder, str(record.make), str(record.model)].append(i)
    for _, group in sorted(by_camera.items()):
        groups.append(sorted(group, key=lambda i: (records[i].timestamp, _natural(records[i].name))))
    return [group for group in groups if len(group) > 1]


def _is_regular(numbers: list[int]) -> bool:
    """Sorted numbers are those of a sequence: at most every third is used, or most steps are the same."""
    if len(numbers) < 3:
        return False
    steps = np.diff(np.array(numbers, np.float64))
    return bool(steps.sum() <= 3 * len(numbers) or (steps == np.median(steps)).mean() >= 0.5)


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key in which runs of digits count as numbers."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


# ---------------------------------------------------------------------------------------------------- gps


def gps_pairs(records: Sequence[ImageRecord], num_neighbors: int) -> NDArray[np.int64]:
    """(P, 2) pairs of each image that has GPS with the nearest others."""
    with_gps = np.array([i for i, record in enumerate(records) if record.gps is not None], np.int64)
    k = min(num_neighbors, len(with_gps) - 1)
    if k < 1:
        return np.zeros((0, 2), np.int64)
    # a height that is unknown is taken as that of the sea
    xyz = ecef_from_geodetic(np.nan_to_num(np.array([records[i].gps for i in with_gps], np.float64)))
    pairs = np.empty((len(with_gps), k, 2), np.int64)
    for row, place in enumerate(xyz):
        distance = ((xyz - place) ** 2).sum(axis=1)
        distance[row] = np.inf
        pairs[row, :, 0] = with_gps[row]
        pairs[row, :, 1] = with_gps[np.argsort(distance, kind="stable")[:k]]
    return _unique_pairs(pairs)
