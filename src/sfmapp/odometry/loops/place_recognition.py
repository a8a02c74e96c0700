"""Places seen before: what the points of each keyframe look like, and which keyframes look like a given image.

Every keyframe keeps one RootSIFT descriptor for each of its points, taken upright and at one fixed scale around the
tracked corner itself, so that a match is a match with a point in space. Corners have no scale and no orientation of
their own; an image that asks describes its corners at three scales and at a given roll instead, which covers changes
of scale from 0.7 to 1.4 (measured: 1.3 to 1.7 times the matches of dominant orientations in driving, and three times
those of ORB under a roll of 10 degrees).

A vocabulary is learnt from the first keyframes, and again whenever there are four times as many, in a thread beside the
tracking, which takes it over a fixed number of places later; every keyframe is one VLAD vector over it (see
:mod:`sfmapp.matching.pairs`, whose sums over whole numbers are the same on any machine).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Container, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.features import scale_space
from sfmapp.features.descriptor import ROOM, describe
from sfmapp.matching.pairs import PairOptions, image_vector, learn_vocabulary
from sfmapp.scene.features import Features

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Ids = NDArray[np.int64]

# Scale of the stored descriptors (pixels; a cell is three of them): on corners, the finest with full recall.
SIGMA_PX = 2.26
# Scales at which an image that asks is described: with a descriptor good for +-20 %, these reach from 0.65 to 1.55.
QUERY_SCALES = (1.0 / 1.35, 1.0, 1.35)
# Blur of each level of the pyramid, and the largest scale described on it, in pixels of the level.
_BLUR_PX, _LEVEL_SIGMA_PX, _NUM_LEVELS = 1.5, 2.6, 2
_SIGMA_RANGE_PX = (1.6, _LEVEL_SIGMA_PX * 2 ** (_NUM_LEVELS - 1))
# Descriptors that a vocabulary is learnt from, in all: 250 for each of 64 words.
_SAMPLE_SIZE = 16384
# Places after which a vocabulary counts that it took so many to begin with: it takes 0.1 to 0.2 s.
_LAG = 2
# Places that stand for one: of neighbours in time only the most similar is a candidate.
_ISLAND = 3
_BLOCK = 256


@dataclass(frozen=True)
class PlaceOptions:
    """How places are remembered and found again."""

    max_points: int = 400  # points described per keyframe, those followed longest; 128 bytes each
    num_words: int = 64  # size of the vocabulary; 256 bytes a word and keyframe
    learn_after: int = 8  # keyframes after which the vocabulary is learnt first
    min_similarity: float = 0.3  # least similarity of a candidate, in those of keyframes that follow each other (DBoW2)
    num_candidates: int = 3  # places tried for one image, at most


class View:
    """An image and its corners, described at whatever scale and roll is asked for.

    Attributes:
        shape: (height, width). xy: (N, 2) float64 corners in COLMAP's pixels.
        point_id: (N,) which points they are, -1 where unknown.
    """

    def __init__(self, image: Bytes, xy: Array, point_id: Ids | None = None) -> None:
        self.shape: tuple[int, int] = image.shape[:2]
        self.point_id: Ids = np.full(len(xy), -1) if point_id is None else np.array(point_id, np.int64)
        self.xy = np.ascontiguousarray(xy, np.float64)
        self._levels = _pyramid(image)
        self._known: dict[tuple[float, float], Bytes] = {}

    def describe(self, xy: Array, sigma_px: Array, angle: Array) -> Bytes:
        """(M, 128) RootSIFT at any places (M, 2), scales (M,) in pixels and angles (M,) in radians from x to y."""
        out = np.empty((len(xy), 128), np.uint8)
        sigma = np.clip(np.broadcast_to(np.asarray(sigma_px, np.float64), len(xy)), *_SIGMA_RANGE_PX)
        turn = np.ascontiguousarray(np.broadcast_to(np.asarray(angle, np.float64), len(xy)))
        level = (sigma > _LEVEL_SIGMA_PX).astype(np.int64)
        for k, image in enumerate(self._levels):
            mine = np.flatnonzero(level == k)
            found = np.empty((len(mine), 128), np.uint8)
            # pixel centres are whole numbers in the kernel, and the corner of the first pixel is common to all levels
            place = np.ascontiguousarray(xy[mine] * 0.5**k - 0.5)
            _describe_at(image, place, sigma[mine] * 0.5**k, turn[mine], found)
            out[mine] = found
        return out

    def descriptors(self, scale: float = 1.0, roll: float = 0.0) -> Bytes:
        """(N, 128) of the corners.

        Args:
            scale: over that of stored descriptors.
            roll: radians by which the image's content is turned against what it is compared with, from x to y.
        """
        key = (scale, roll)
        if key not in self._known:
            self._known[key] = self.describe(self.xy, np.array(SIGMA_PX * scale), np.array(roll))
        return self._known[key]


@dataclass(frozen=True)
class Place:
    """A keyframe as it is remembered.

    Attributes:
        map_idx, frame_idx: which keyframe of which map.
        point_id: (M,) int64 ascending. xy: (M, 2) float32 pixels. descriptors: (M, 128) uint8.
    """

    map_idx: int
    frame_idx: int
    point_id: Ids
    xy: Floats
    descriptors: Bytes


@dataclass(frozen=True)
class Candidate:
    """A place that looks like the image that asked.

    Attributes:
        map_idx, frame_idx: which keyframe.
        similarity: cosine between the two vectors, over that between keyframes that follow each other.
    """

    map_idx: int
    frame_idx: int
    similarity: float


@dataclass(frozen=True)
class _Vocabulary:
    """What was learnt from places.

    Attributes:
        words: (W, 128) float32. vectors: of the places that it was learnt from, by their frames.
    """

    words: Floats
    vectors: dict[int, NDArray[np.int16]]


class PlaceIndex:
    """All keyframes of all maps, by frame number: that of a keyframe stays the same when others are dropped or joined.

    What is found depends on the order of the calls alone. One thread at a time.

    Args:
        executor: where vocabularies are learnt; None: in the thread that calls.
    """

    def __init__(self, options: PlaceOptions = PlaceOptions(), seed: int = 0, executor: Executor | None = None) -> None:
        self.options = options
        self._seed, self._executor = seed, executor
        self._future: Future[_Vocabulary] | None = None
        self._num_added, self._due = 0, 0
        self._places: list[Place] = []
        self._row: dict[int, int] = {}
        self._words: Floats | None = None
        self._num_learnt = 0
        self._vectors = np.zeros((0, 0), np.int16)
        # similarity of each place with the one before it in its map, NaN without one
        self._reference = np.zeros(0)

    def __len__(self) -> int:
        return len(self._places)

    def __contains__(self, frame_idx: int) -> bool:
        return frame_idx in self._row

    def __getitem__(self, frame_idx: int) -> Place:
        return self._places[self._row[frame_idx]]

    def add(self, map_idx: int, frame_idx: int, image: Bytes, xy: Array, point_id: Ids) -> View:
        """Remember a keyframe.

        Args:
            image: (H, W) uint8 of the rig's first camera.
            xy: (N, 2) its points in pixels, point_id: (N,) ascending; older points have smaller ids and go first.

        Returns:
            The image with its described points, to look for loops with before it is forgotten.
        """
        view = View(image, xy, point_id)
        kept = slice(0, self.options.max_points)
        described = view.descriptors()[kept].copy()
        place = Place(map_idx, frame_idx, np.array(point_id[kept]), view.xy[kept].astype(np.float32), described)
        self._row[frame_idx] = len(self._places)
        self._places.append(place)
        self._num_added += 1
        if self._future is not None and self._num_added >= self._due:
            self._take_over(self._future.result())
        elif self._words is not None:
            self._embed(len(self._places) - 1)
        if self._future is None and len(self._places) >= max(self.options.learn_after, 4 * self._num_learnt):
            self._begin_to_learn()
        return view

    def query(self, frame_idx: int, exclude: Collection[int] = (), *, other_maps: bool = False) -> list[Candidate]:
        """Places that look like a keyframe, the most similar first.

        Args:
            exclude: frames that are no candidates, such as those that share points with it.
            other_maps: only places of other maps, in place of only those of its own.
        """
        row = self._row[frame_idx]
        mine = np.array([place.map_idx == self._places[row].map_idx for place in self._places])
        allowed = ~mine if other_maps else mine
        allowed[[self._row[frame] for frame in exclude if frame in self._row]] = False
        allowed[row] = False
        if self._words is None or not allowed.any():
            return []
        reference = self._reference[row]
        return self._best(self._vectors[row], allowed, reference if np.isfinite(reference) else self._usual(), False)

    def query_view(self, view: View, roll: float, maps: Container[int]) -> list[Candidate]:
        """Places of some maps (by their numbers) that look like an image; without a vocabulary yet, the last places."""
        allowed = np.array([place.map_idx in maps for place in self._places], bool)
        if self._words is None:
            last = np.flatnonzero(allowed)[: -1 - self.options.num_candidates * _ISLAND : -_ISLAND]
            latest = [self._places[k] for k in last]
            return [Candidate(place.map_idx, place.frame_idx, math.nan) for place in latest]
        vector = _vector(view.descriptors(roll=roll), self._words)
        return self._best(vector, allowed, self._usual(), True)

    def rename_points(self, map_idx: int, old_id: Ids, new_id: Ids) -> None:
        """Points of a map that turned out to be others. Of two that become the same in one place the first stays."""
        if not len(old_id):
            return
        order = np.argsort(old_id, kind="stable")
        old_id, new_id = np.asarray(old_id)[order], np.asarray(new_id)[order]
        for n, place in enumerate(self._places):
            if place.map_idx != map_idx:
                continue
            at = np.minimum(np.searchsorted(old_id, place.point_id), len(old_id) - 1)
            renamed = np.where(old_id[at] == place.point_id, new_id[at], place.point_id)
            ids, first = np.unique(renamed, return_index=True)
            self._places[n] = Place(map_idx, place.frame_idx, ids, place.xy[first], place.descriptors[first])

    def move_map(self, from_map: int, to_map: int, id_offset: int) -> None:
        """The keyframes of a map now belong to another, their points' ids raised by an offset."""
        for n, p in enumerate(self._places):
            if p.map_idx == from_map:
                self._places[n] = Place(to_map, p.frame_idx, p.point_id + id_offset, p.xy, p.descriptors)

    def remove(self, frame_idx: int) -> None:
        """Forget a keyframe that was dropped from its map."""
        row = self._row.pop(frame_idx)
        del self._places[row]
        if self._words is not None:
            self._vectors[row : len(self._places)] = self._vectors[row + 1 : len(self._places) + 1]
            self._reference[row : len(self._places)] = self._reference[row + 1 : len(self._places) + 1]
        for frame, other in self._row.items():
            self._row[frame] = other - (other > row)

    def learn(self) -> None:
        """Learn a vocabulary from the places so far, however few, if there is none: all of a map are known at once."""
        if self._words is None and self._places:
            self._num_learnt = len(self._places)
            self._take_over(_learn(self._places, self.options, self._seed))

    def _begin_to_learn(self) -> None:
        """Learn a vocabulary from all places so far, to be taken over when there are a few more."""
        self._num_learnt, self._due = len(self._places), self._num_added + _LAG
        if self._executor is not None:
            self._future = self._executor.submit(_learn, list(self._places), self.options, self._seed)
        else:
            self._future = Future()
            self._future.set_result(_learn(self._places, self.options, self._seed))

    def _take_over(self, learnt: _Vocabulary) -> None:
        """Go by another vocabulary from now on."""
        self._future, self._words = None, learnt.words
        self._vectors = np.zeros((2 * len(self._places), learnt.words.size), np.int16)
        self._reference = np.full(2 * len(self._places), np.nan)
        for row, place in enumerate(self._places):
            self._embed(row, learnt.vectors.get(place.frame_idx))

    def _embed(self, row: int, vector: NDArray[np.int16] | None = None) -> None:
        assert self._words is not None
        if row == len(self._vectors):
            self._vectors = np.concatenate([self._vectors, np.zeros_like(self._vectors)])
            self._reference = np.concatenate([self._reference, np.full(row, np.nan)])
        self._vectors[row] = _vector(self._places[row].descriptors, self._words) if vector is None else vector
        before = row > 0 and self._places[row - 1].map_idx == self._places[row].map_idx
        self._reference[row] = (
            _similarities(self._vectors[row - 1 : row], self._vectors[row])[0] if before else math.nan
        )

    def _usual(self) -> float:
        """Median similarity of keyframes that follow each other."""
        known = self._reference[: len(self._places)]
        known = known[np.isfinite(known)]
        return float(np.median(known)) if len(known) else 1.0

    def _best(
        self, vector: NDArray[np.int16], allowed: NDArray[np.bool_], reference: float, lost: bool
    ) -> list[Candidate]:
        """The best of each island of neighbours; one that is lost takes what there is."""
        similarity = _similarities(self._vectors[: len(self._places)], vector) / max(reference, 1e-3)
        found: list[Candidate] = []
        taken = ~allowed
        for row in np.argsort(-similarity, kind="stable"):
            if len(found) == self.options.num_candidates:
                break
            if taken[row] or (similarity[row] < self.options.min_similarity and not lost):
                continue
            place = self._places[row]
            found.append(Candidate(place.map_idx, place.frame_idx, float(similarity[row])))
            for other in range(max(0, row - _ISLAND), min(len(taken), row + _ISLAND + 1)):
                taken[other] |= self._places[other].map_idx == place.map_idx
        return found


def _learn(places: Sequence[Place], options: PlaceOptions, seed: int) -> _Vocabulary:
    """A vocabulary of places, and their vectors over it."""
    share = max(1, _SAMPLE_SIZE // len(places))
    rng = np.random.default_rng([seed, 0x706C6163, len(places)])
    samples = []
    for place in places:
        few = np.sort(rng.permutation(len(place.descriptors))[:share])
        samples.append(
            Features(np.zeros((len(few), 4), np.float32), place.descriptors[few], np.zeros((0, 3), np.uint8))
        )
    words = learn_vocabulary(
        samples, PairOptions(num_words=options.num_words, num_query_features=share), seed=seed
    )  # fmt: skip
    return _Vocabulary(words, {place.frame_idx: _vector(place.descriptors, words) for place in places})


@numba.njit(cache=True, nogil=True)
def _describe_at(level: Floats, place: Array, sigma: Array, angle: Array, out: Bytes) -> None:
    """Descriptors (N, 128) at pixels (N, 2) of a level, whose first pixel has its centre at (0, 0)."""
    room = np.empty(ROOM, np.float32)
    for n in range(place.shape[0]):
        describe(level, place[n, 0], place[n, 1], sigma[n], angle[n], room, out[n])


def _pyramid(image: Bytes) -> list[Floats]:
    """The image and its half, each blurred."""
    import cv2

    taps = np.exp(-0.5 * (np.arange(2 * math.ceil(1.5 * _BLUR_PX) + 1) / _BLUR_PX) ** 2)
    taps = (taps / (taps[0] + 2.0 * taps[1:].sum())).astype(np.float32)
    levels = []
    for k in range(_NUM_LEVELS):
        if k:
            half = (image.shape[1] // 2, image.shape[0] // 2)
            image = cv2.resize(image[: 2 * half[1], : 2 * half[0]], half, interpolation=cv2.INTER_AREA)
        blurred = scale_space.empty_level((image.shape[0], image.shape[1]))
        lines = scale_space.empty_lines(image.shape[1])
        scale_space.blur(image.astype(np.float32), taps, lines, blurred, (0, len(image), len(image)), (0, 0))
        levels.append(blurred)
    return levels


def _vector(descriptors: Bytes, words: Floats) -> NDArray[np.int16]:
    """(D,) whole numbers with a length of at most 4000."""
    return image_vector(descriptors.astype(np.float32), words).astype(np.int16)


def _similarities(vectors: NDArray[np.int16], vector: NDArray[np.int16]) -> Array:
    """(N,) cosines; the products are below 2^24, so float32 holds their sums exactly."""
    query = vector.astype(np.float32)
    products = [vectors[k : k + _BLOCK].astype(np.float32) @ query for k in range(0, len(vectors), _BLOCK)]
    length2 = float(query @ query)
    return np.concatenate([*products, np.zeros(0, np.float32)]).astype(np.float64) / max(length2, 1.0)


def compile_kernels() -> None:
    """Run every kernel once on a tiny image, so that numba compiles or loads them now."""
    view = View(np.zeros((64, 64), np.uint8), np.array([[32.0, 32.0]]))
    view.descriptors()
    view.descriptors(1.35)
