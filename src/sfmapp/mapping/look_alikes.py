"""Parts of a scene that look alike: which verified pairs took one for the other, and the map without them.

Pairs of photographs of two sides that look alike are verified as well as any, on the thing that looks alike, and a map
that is grown from all pairs lays the sides on top of each other. It then contradicts the pairs that lead round the
thing. Those match in all of the picture where the others match on the thing only, which is how Wilson and Snavely
("Network Principles for SfM", ICCV 2013), Heinly et al. ("Correcting for Duplicate Scene Structure in Sparse 3D
Reconstruction", ECCV 2014) and Yan et al. ("Distinguishing the Indistinguishable", CVPR 2017) tell them apart too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.mapping.focal_priors import Mapped
from sfmapp.mapping.mapper import STAGE
from sfmapp.mapping.verified_pairs import NUM_NAMED, Chains, Standing, standing_pairs
from sfmapp.scene.correspondences import Correspondences

# Each round removes what holds images in a wrong place; what was hidden behind it comes to light in the next.
MAX_ROUNDS = 3


def tell_apart(
    mapped: Mapped, correspondences: Correspondences, map_again: Callable[[Correspondences], Mapped], events: Events
) -> tuple[Mapped, dict[str, Any]]:
    """Map again without the pairs that stronger ones contradict, for as long as the evidence against the map falls.

    Args:
        mapped: the map from all pairs.
        correspondences: all verified matches.
        map_again: makes a map from fewer of them.
        events: told of what was tried and what came of it.

    Returns:
        The map with the least verified matches against it, and the report: empty if none stands against the first.
    """
    standing = [standing_pairs(model, correspondences) for model in mapped.models]
    first = weight = _weight(standing)
    if weight == 0:
        return mapped, {}
    best, dropped, kept_dropped = mapped, np.zeros(0, np.int64), np.zeros(0, np.int64)
    for _ in range(MAX_ROUNDS):
        suspects = np.concatenate([suspected_pairs(s, len(mapped.models[0].image_names)) for s in standing])
        if np.isin(suspects, dropped).all():
            break
        dropped = np.union1d(dropped, suspects)
        events.decided(
            STAGE,
            f"{weight} verified matches contradict the model: mapping again without {len(dropped)} weaker pairs, which "
            "may have taken parts that look alike for one",
        )
        again = map_again(correspondences.without(dropped))
        standing = [standing_pairs(model, correspondences) for model in again.models]
        if _weight(standing) < weight and _size(again) >= _size(best):
            best, weight, kept_dropped = again, _weight(standing), dropped
        if _weight(standing) == 0:
            break
    events.decided(STAGE, f"{weight} verified matches contradict the model, {first} before")
    return best, _report(correspondences, best, kept_dropped, first, weight)


def suspected_pairs(standing: Standing, num_images: int) -> NDArray[np.int64]:
    """Pairs, as positions in the correspondences, that a model rests on and that stronger ones contradict.

    A pair that stands against a model and the chain of pairs that holds its two images where they are cannot both be
    right. Where the weakest link of that chain is weaker than the pair, it goes, and with it all pairs between what
    stronger ones join on either side, as they say the same; then the next chain, until none is left that is weaker.

    Args:
        standing: of the pairs with one model.
        num_images: of the model, registered or not.
    """
    agreement, strength = standing.agreement, standing.strength
    images = agreement.image_idx
    is_left = agreement.agrees
    against = np.flatnonzero(standing.stands)
    for k in against[np.argsort(-strength[against], kind="stable")]:
        first, second = images[k]
        while True:
            chains = Chains.of(num_images, images[is_left], strength[is_left])
            link = chains.weakest_link(first, second)
            if link < 0 or chains.strength[link] >= strength[k]:
                break
            here, there = (chains.group_before(i, int(chains.joined_as[link])) for i in (first, second))
            is_left &= ~((here[images] & there[images][:, ::-1]).any(axis=1))
    return agreement.pair_idx[agreement.agrees & ~is_left]


def _weight(standing: Sequence[Standing]) -> int:
    """Verified matches that stand against models."""
    return sum(int(s.agreement.num_matches[s.stands].sum()) for s in standing)


def _size(mapped: Mapped) -> int:
    """Images in the largest model."""
    return max((int(model.is_registered.sum()) for model in mapped.models), default=0)


def _report(
    correspondences: Correspondences, mapped: Mapped, dropped: NDArray[np.int64], before: int, after: int
) -> dict[str, Any]:
    matches = correspondences.num_inliers[dropped]
    names = mapped.models[0].image_names
    strongest = dropped[np.argsort(-matches, kind="stable")[:NUM_NAMED]]
    return {
        "num_pairs_dropped": len(dropped),
        "num_matches_dropped": int(matches.sum()),
        "num_matches_against_before": before,
        "num_matches_against": after,
        "pairs": [
            {
                "images": [names[i] for i in correspondences.pair_image_idx[p]],
                "num_matches": int(correspondences.num_inliers[p]),
            }
            for p in strongest
        ],
    }
