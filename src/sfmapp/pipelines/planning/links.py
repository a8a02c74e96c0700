"""Which photographs probably show the same, by features of small versions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.images.image_set import ImageSet
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.stage import match_pair
from sfmapp.scene.correspondences import TwoViewConfig
from sfmapp.scene.features import Features

STAGE = "overlap"
# Of more pairs than this so many are compared, and all of photographs that these link with nothing: a linked one takes
# 4 ms, and a look at a thousand photographs is to take a minute.
_MOST_COMPARED = 5000
# pairs a task: one takes a third of a millisecond where nothing matches
_BATCH = 64
# A small feature is off by a pixel or so of the small version, three of the whole: COLMAP's 4 px at two megapixels,
# which the matching stage scales with the picture, become this share of the diagonal.
_ERROR_SHARE = 0.004
# hypotheses, of a few dozen matches
_MAX_TRIALS = 500
# Verified matches of small versions that make a pair; the stage asks for 15 of ten times as many features.
_MIN_INLIERS = 10


@dataclass(frozen=True)
class Links:
    """Pairs that the run will compare, or some of them, and which overlap as far as a cheap look tells.

    Attributes:
        pairs: (P, 2) int32 positions i < j.
        num_all: that the run will compare.
        num_matches: (P,) int64 verified matches of small versions, 0 where there is no link.
        num_putative: (P,) int64 matches of small versions before verification.
        config: (P,) int8 of :class:`~sfmapp.scene.correspondences.TwoViewConfig`.
    """

    pairs: NDArray[np.int32]
    num_matches: NDArray[np.int64]
    num_putative: NDArray[np.int64]
    config: NDArray[np.int8]
    num_all: int

    @property
    def scale(self) -> float:
        """Pairs of the run for each that was compared."""
        return self.num_all / max(1, len(self.pairs))

    @property
    def is_linked(self) -> NDArray[np.bool_]:
        """(P,) bool."""
        return self.num_matches > 0

    def with_found(self, found: Iterable[tuple[int, int]]) -> Links:
        """The same with pairs that whole photographs have linked where small versions showed nothing."""
        position = {(int(i), int(j)): p for p, (i, j) in enumerate(self.pairs)}
        num_matches = self.num_matches.copy()
        for pair in found:
            if pair in position:
                num_matches[position[pair]] = max(1, num_matches[position[pair]])
        return replace(self, num_matches=num_matches)

    def among(self, group: Sequence[int], num_images: int) -> Links:
        """Pairs of the photographs of a group, at least one."""
        is_in = np.zeros(num_images, bool)
        is_in[list(group)] = True
        inside = is_in[self.pairs].all(axis=1)
        return Links(
            self.pairs[inside], self.num_matches[inside], self.num_putative[inside], self.config[inside], self.num_all
        )

    def joined(self, other: Links) -> Links:
        """With other pairs of the same run."""
        return Links(
            np.concatenate([self.pairs, other.pairs]),
            np.concatenate([self.num_matches, other.num_matches]),
            np.concatenate([self.num_putative, other.num_putative]),
            np.concatenate([self.config, other.config]),
            self.num_all,
        )

    def groups(self, num_images: int) -> list[list[int]]:
        """Photographs that are linked with each other, the largest group first, then by the first of each."""
        parent = list(range(num_images))

        def root(i: int) -> int:
            while parent[i] != i:
                parent[i] = parent[parent[i]]
                i = parent[i]
            return i

        for i, j in self.pairs[self.is_linked]:
            parent[root(int(j))] = root(int(i))
        members: dict[int, list[int]] = {}
        for i in range(num_images):
            members.setdefault(root(i), []).append(i)
        return sorted(members.values(), key=lambda group: (-len(group), group[0]))

    def degrees(self, num_images: int) -> NDArray[np.int64]:
        """(I,) number of links of each photograph."""
        return np.bincount(self.pairs[self.is_linked].ravel(), minlength=num_images)


def find_links(
    image_set: ImageSet, features: Sequence[Features], pairs: NDArray[np.int32], *, seed: int, threads: int,
    events: Events,
) -> Links:  # fmt: skip
    """Match the small versions of pairs; the result does not depend on the number of threads.

    Args:
        features: of small versions, in pixels of the whole photographs.
        pairs: (P, 2) int32 that the run will compare; of very many a part is drawn.
    """
    cameras = [image_set.cameras[image.camera_idx] for image in image_set.images]

    def compare(pair: NDArray[np.int32]) -> tuple[int, int, int]:
        i, j = map(int, pair)
        diagonal = max(float(np.hypot(cameras[k].width, cameras[k].height)) for k in (i, j))
        options = MatchingOptions(
            max_error_px=min(_ERROR_SHARE * diagonal, 1000.0), min_inliers=_MIN_INLIERS, max_ransac_trials=_MAX_TRIALS
        )
        found = match_pair((features[i], features[j]), (None, None), (cameras[i], cameras[j]), options, (seed, i, j))
        is_none = found.geometry.config in (TwoViewConfig.UNDEFINED, TwoViewConfig.DEGENERATE)
        return (0 if is_none else len(found.matches), found.num_putative, found.geometry.config)

    def links_of(chosen: NDArray[np.int64], pool: ThreadPoolExecutor) -> Links:
        batches = [chosen[first : first + _BATCH] for first in range(0, len(chosen), _BATCH)]
        rows: list[tuple[int, int, int]] = []
        for batch in pool.map(lambda batch: [compare(pairs[p]) for p in batch], batches):
            rows += batch
            events.advanced(STAGE, len(batch))
        table = np.array(rows, np.int64).reshape(-1, 3)
        return Links(pairs[chosen], table[:, 0], table[:, 1], table[:, 2].astype(np.int8), len(pairs))

    order = np.random.default_rng([seed, 0x6C696E6B]).permutation(len(pairs))
    first = np.sort(order[:_MOST_COMPARED])
    events.started(STAGE, f"comparing {len(first)} of {len(pairs)} pairs in small", total=len(first))
    with ThreadPoolExecutor(max(1, threads)) as pool:
        try:
            links = links_of(first, pool)
            rest = np.sort(order[_MOST_COMPARED:])
            is_loose = np.ones(len(features), bool)
            is_loose[links.groups(len(features))[0]] = False
            rest = rest[is_loose[pairs[rest]].any(axis=1)]
            if len(rest):
                events.started(STAGE, f"comparing {len(rest)} more pairs of photographs apart", total=len(rest))
                links = links.joined(links_of(rest, pool))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    events.finished(STAGE, f"{int(links.is_linked.sum())} of {len(links.pairs)} pairs are linked")
    return links
