"""Parts of a scene that look alike: which verified pairs took one for the other, and the map without them.

Pairs of photographs of two sides that look alike are verified as well as any, on the thing that looks alike, and a map
that is grown from all pairs lays the sides on top of each other. It then contradicts the pairs that lead round the
thing. Those match in all of the picture where the others match on the thing only, which is how Wilson and Snavely
("Network Principles for SfM", ICCV 2013), Heinly et al. ("Correcting for Duplicate Scene Structure in Sparse 3D
Reconstruction", ECCV 2014) and Yan et al. ("Distinguishing the Indistinguishable", CVPR 2017) tell them apart too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.mapping.focal_priors import Mapped
from sfmapp.mapping.mapper import STAGE
from sfmapp.mapping.report import LookAlikesReport, named_pairs
from sfmapp.mapping.verified_pairs import (
    CLEARLY,
    Chains,
    Standing,
    pair_strengths,
    standing_pairs,
)
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.reconstruction import Reconstruction

# Each round maps without what the last one refuted; the poses of a better map refute more.
MAX_ROUNDS = 4
# A pair whose rotation is so far from that of a chain of stronger pairs leads elsewhere. Rotations of pairs are good to
# a few degrees even where the focal length is a guess; sides that look alike are turned by a twelfth of a turn or more.
MAX_TURN_DEG = 20.0


@dataclass(frozen=True)
class _Attempt:
    """A map, the pairs that it was made without, and what stands against it: verified matches, and how strongly."""

    mapped: Mapped
    dropped: NDArray[np.int64]
    against: int
    doubt: float


def tell_apart(
    mapped: Mapped, correspondences: Correspondences, map_again: Callable[[Correspondences], Mapped], events: Events
) -> tuple[Mapped, LookAlikesReport]:
    """Map again without the pairs that stronger ones refute, if verified pairs stand against a map.

    Args:
        mapped: the map from all pairs.
        correspondences: all verified matches.
        map_again: makes a map from fewer of them.
        events: told of what was tried and what came of it.

    Returns:
        The map that is contradicted least, and the report: empty if nothing stands against the first.
    """
    standing = _standing(mapped, correspondences)
    before = best = _Attempt(mapped, np.zeros(0, np.int64), _weight(standing), _doubt(standing))
    if before.against == 0:
        return mapped, LookAlikesReport()
    clearly, last, dropped = CLEARLY, before, [before.dropped]
    for _ in range(MAX_ROUNDS):
        is_settled = last.against == 0
        if is_settled:  # all that the map does agree with makes it better, all that it does not only disturbs
            refuted = np.concatenate([s.agreement.pair_idx[s.agreement.disagrees] for s in standing])
        else:
            refuted = refuted_pairs(last.mapped.models, standing, correspondences, clearly)
            if np.array_equal(refuted, last.dropped) and clearly > 1.0:
                clearly = 1.0
                refuted = refuted_pairs(last.mapped.models, standing, correspondences, clearly)
        if any(np.array_equal(refuted, earlier) for earlier in dropped):
            break  # that has been tried, perhaps a round before the last
        events.decided(
            STAGE,
            f"{last.against} verified matches contradict the model: mapping again without {len(refuted)} pairs that "
            "stronger ones refute",
        )
        again = map_again(correspondences.without(refuted))
        standing = _standing(again, correspondences)
        last = _Attempt(again, refuted, _weight(standing), _doubt(standing))
        dropped.append(refuted)
        # of several maps that are as doubtful, the least doubtful says nothing: that would be choosing by chance
        is_better = CLEARLY * last.doubt < best.doubt or (is_settled and last.against == 0)
        if is_better and _size(last.mapped) >= _size(best.mapped):
            best = last
        if is_settled:
            break
    events.decided(STAGE, f"{best.against} verified matches contradict the model, {before.against} before")
    return best.mapped, _report(correspondences, best, before)


def refuted_pairs(
    models: Sequence[Reconstruction], standing: Sequence[Standing], correspondences: Correspondences, clearly: float
) -> NDArray[np.int64]:
    """Verified pairs, as positions in the correspondences, that chains of stronger pairs refute.

    Images are joined from the strongest pair down, and turned as it has them: as the model does where it agrees with
    the pair, else as the pair itself. A pair between images that are joined already, but are turned otherwise, is
    refuted if it is weaker than the weakest link between them.

    Args:
        models: whose tracks are those of the correspondences.
        standing: of the pairs with each model.
        correspondences: all verified matches.
        clearly: factor by which it must be weaker.
    """
    strength = pair_strengths(models[0], correspondences)
    rotation = rigid3.rotation_matrix(correspondences.cam2_from_cam1)
    for model, of_model in zip(models, standing, strict=True):
        pairs = of_model.agreement.pair_idx[of_model.agreement.agrees]
        first, second = (
            rigid3.rotation_matrix(model.cam_from_world[i]) for i in correspondences.pair_image_idx[pairs].T
        )
        rotation[pairs] = second @ np.swapaxes(first, 1, 2)
    # pairs of few matches too: they prove little, but a map that finds no others rests on them
    pairs = np.flatnonzero((strength > 0) & np.isfinite(rotation).all(axis=(1, 2)))
    pairs = pairs[np.argsort(-strength[pairs], kind="stable")]
    images = correspondences.pair_image_idx.astype(np.int64)
    chains = Chains.of(len(models[0].image_names), images[pairs], strength[pairs])
    turned = _turn_together(chains, images[pairs], rotation[pairs])
    i, j = images[pairs].T
    between = turned[j] @ np.swapaxes(turned[i], 1, 2) @ np.swapaxes(rotation[pairs], 1, 2)
    is_off = rigid3.rotation_angle_deg(between) > MAX_TURN_DEG
    refuted = [p for p in pairs[is_off] if chains.strength[chains.weakest_link(*images[p])] > clearly * strength[p]]
    return np.sort(np.array(refuted, np.int64))


def _turn_together(chains: Chains, images: NDArray[np.int64], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """(I, 3, 3) rotations of images along the pairs that join them, which come from the strongest down.

    Args:
        chains: of the pairs.
        images: (K, 2) of the pairs.
        rotation: (K, 3, 3) second from first.
    """
    turned = np.tile(np.eye(3), (len(chains.parent), 1, 1))
    group = np.arange(len(turned))
    for (i, j), second_from_first in zip(images, rotation, strict=True):
        if group[i] != group[j]:
            moved = group == group[j]
            turned[moved] = turned[moved] @ (turned[j].T @ second_from_first @ turned[i])
            group[moved] = group[i]
    return turned


def _standing(mapped: Mapped, correspondences: Correspondences) -> list[Standing]:
    return [standing_pairs(model, correspondences) for model in mapped.models]


def _weight(standing: Sequence[Standing]) -> int:
    """Verified matches that stand against models."""
    return sum(int(s.agreement.num_matches[s.stands].sum()) for s in standing)


def _doubt(standing: Sequence[Standing]) -> float:
    """How strong what contradicts the models is, at most, against what they rest on."""
    return max((s.doubt for s in standing), default=0.0)


def _size(mapped: Mapped) -> int:
    """Images in the largest model."""
    return max((int(model.is_registered.sum()) for model in mapped.models), default=0)


def _report(correspondences: Correspondences, best: _Attempt, before: _Attempt) -> LookAlikesReport:
    matches = correspondences.num_inliers[best.dropped]
    return LookAlikesReport(
        num_pairs_dropped=len(best.dropped),
        num_matches_dropped=int(matches.sum()),
        num_matches_against_before=before.against,
        num_matches_against=best.against,
        pairs=named_pairs(best.mapped.models[0].image_names, correspondences.pair_image_idx[best.dropped], matches),
    )
