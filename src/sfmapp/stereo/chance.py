"""Whether two pictures show the same: more is matched than when the right one is turned.

A matcher that asks for smooth disparities finds some in noise too: a twentieth to a quarter of the pixels, by how
smooth the noise is. A picture that stands on its head, mirrored or not, or lies on its side has the same textures,
contrast and noise, and nothing of it in its place: what is matched then is what chance matches. Two things are held
against that: how many pixels are matched, and how many of them are of the largest patch, for what both pictures show
lies together, and what chance finds is scattered.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.stereo.checks import largest_patch
from sfmapp.stereo.result import DisparityMap, RectifiedPair

# Pairs of which more is matched are not asked: of noise it is at most 27 %, of photographs of two places 7
LEAST_DENSITY = 0.3
# Times what chance matches, in pixels and in pixels of the largest patch. Pixels alone tell little: of photographs with
# noise of 40 grey values there are 1.1 times as many. Their largest patch has 1.8 times as many and more, and that of
# pictures that are noise but for 1 % 2 times; where noise is as coarse as the patch, it takes 2 % (2.2 times). Of pairs
# that show nothing in common 34 of 44 have less (benchmarks/stereo_chance.py)
LEAST_RATIO, LEAST_PATCH_RATIO = 2.0, 1.5
# Where much more is matched than in another of the turned pictures, that one shows the same: edges that run up and down
# are upright when they stand on their head, and a fence is when it is mirrored too
_SHOWS_THE_SAME = 2.5


@dataclass(frozen=True)
class AgainstChance:
    """What is matched of a pair, and by chance.

    Attributes:
        density, by_chance: shares of pixels.
        patch, patch_by_chance: pixels of the largest patch without a step.
    """

    density: float
    by_chance: float
    patch: int
    patch_by_chance: float

    @property
    def is_no_better(self) -> bool:
        """Neither more pixels nor a larger patch than chance would match."""
        return self.density <= LEAST_RATIO * self.by_chance and self.patch <= LEAST_PATCH_RATIO * self.patch_by_chance


def against_chance(
    pair: RectifiedPair, found: DisparityMap, match: Callable[[RectifiedPair], DisparityMap]
) -> AgainstChance:
    """Match the right picture on its head, mirrored on its head, and on its side."""
    densities, patches = [], []
    for right, shown in zip(_turned(pair.right), _turned(pair.right_shown), strict=True):
        by_chance = match(replace(pair, right=right, right_shown=shown))
        densities.append(by_chance.density)
        patches.append(largest_patch(by_chance))
    return AgainstChance(found.density, _usual(densities), largest_patch(found), _usual(patches))


def chance_text(pair: RectifiedPair, found: DisparityMap, match: Callable[[RectifiedPair], DisparityMap]) -> str | None:
    """What is to be said of a pair that is matched no better than chance would; None of others."""
    if found.density >= LEAST_DENSITY:
        return None
    told = against_chance(pair, found, match)
    if not told.is_no_better:
        return None
    return (
        f"the pictures do not show the same, or nothing that can be told from noise: {told.density:.1%} of the pixels "
        f"are matched, and {told.by_chance:.1%} when the right picture stands on its head or lies on its side"
    )


def _turned(picture: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """A picture on its head, mirrored on its head, and on its side, of one size: mirrored where it ends too early."""
    yield np.ascontiguousarray(picture[::-1])
    yield np.ascontiguousarray(picture[::-1, ::-1])
    height, width = picture.shape[:2]
    lying = np.rot90(picture)[:height, :width]
    missing = [(0, height - lying.shape[0]), (0, width - lying.shape[1])] + [(0, 0)] * (picture.ndim - 2)
    yield np.pad(lying, missing, "symmetric")


def _usual(values: Sequence[float]) -> float:
    """Mean of what the turned pictures have that do not show the same."""
    return float(np.mean([value for value in values if value <= _SHOWS_THE_SAME * min(values)]))
