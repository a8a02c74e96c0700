"""Real work on a few of the photographs: what the stages take, and find, on this machine with these pictures."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sfmapp.events import Events
from sfmapp.features.extract import extract_features
from sfmapp.images.image_set import ImageSet
from sfmapp.matching import guided
from sfmapp.matching.coarse_to_fine import is_guidable
from sfmapp.matching.stage import match_pair
from sfmapp.pipelines.planning.links import Links
from sfmapp.scene.correspondences import TwoViewConfig
from sfmapp.workspace.options import Options

STAGE = "trial"


@dataclass(frozen=True)
class TriedPair:
    """A pair that was matched as a run does it.

    Attributes:
        images: positions i < j.
        num_matches: verified.
        cpu_s: of the thread that did it.
    """

    images: tuple[int, int]
    num_matches: int
    config: TwoViewConfig
    cpu_s: float


@dataclass(frozen=True)
class Trial:
    """What real work on some of the photographs took and found.

    Attributes:
        num_features, cpu_s: by position of each image that was tried; those that cannot be read are left out.
        pairs: all of these images.
    """

    num_features: dict[int, int]
    cpu_s: dict[int, float]
    pairs: list[TriedPair]


def choose_images(links: Links, num_images: int, most: int, wanted: Sequence[tuple[int, int]] = ()) -> list[int]:
    """Positions of the images to try, sorted: so many of a set, among them pairs that overlap and such that do not.

    The first is the one with most matches; then in turn the one that shares most with those chosen and the one that
    shares least, for the costs of both kinds of pairs. ``wanted``: pairs that are to be among them in any case.
    """
    shared = np.zeros((num_images, num_images), np.int64)
    i, j = links.pairs[:, 0], links.pairs[:, 1]
    shared[i, j] = shared[j, i] = links.num_matches
    chosen = [int(shared.sum(axis=1).argmax())] if num_images else []
    while len(chosen) < min(most, num_images):
        with_chosen = shared[chosen].sum(axis=0)
        with_chosen[chosen] = -1 if len(chosen) % 2 else np.iinfo(np.int64).max
        chosen.append(int(with_chosen.argmax() if len(chosen) % 2 else with_chosen.argmin()))
    return sorted({*chosen, *(k for pair in wanted for k in pair)})


def try_images(image_set: ImageSet, chosen: Sequence[int], options: Options, events: Events) -> Trial:
    """Extract the features of some images, and match each with each, as a run does it."""
    images = tuple(image_set.images[k] for k in chosen)
    part = ImageSet(images, image_set.cameras, (), image_set.root)
    quiet, threads = events.unheard(), options.num_workers
    events.started(STAGE, f"features and matches of {len(images)} photographs", total=2)
    features, report = extract_features(part, options.features, threads=threads, events=quiet)
    events.advanced(STAGE)
    has_any = [n for n, found in enumerate(features) if len(found)]
    backgrounds = {n: guided.background_of(features[n]) for n in has_any if is_guidable(features[n], options.matching)}

    def match(pair: tuple[int, int]) -> TriedPair:
        m, n = pair
        cameras = part.cameras[images[m].camera_idx], part.cameras[images[n].camera_idx]
        i, j = chosen[m], chosen[n]
        found = match_pair(
            (features[m], features[n]), (backgrounds.get(m), backgrounds.get(n)), cameras, options.matching,
            (options.seed, i, j),
        )  # fmt: skip
        return TriedPair((i, j), len(found.matches), TwoViewConfig(found.geometry.config), found.cpu_s)

    with ThreadPoolExecutor(threads) as pool:
        pairs = list(pool.map(match, combinations(has_any, 2)))
    events.finished(STAGE, f"{len(images)} photographs and {len(pairs)} pairs were tried")
    return Trial(
        {chosen[n]: len(features[n]) for n in has_any},
        {chosen[n]: report.images[n].cpu_s or 0.0 for n in has_any},
        pairs,
    )
