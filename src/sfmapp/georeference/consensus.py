"""Which of the measured places of cameras agree with a model and with each other.

Every set of places is an explanation: a similarity brings the model to those of the set, which have normal errors; all
others are wrong, and lie anywhere. How good places are beside what is said of them is not known, and averaged over, so
that sets are compared by what they explain, and no threshold is needed (MacKay, "Bayesian interpolation", 1992). Sets
to compare come of trimmed least squares (Rousseeuw and Van Driessen, 2006) with every number of wrong places that is
less than half.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sfmapp.georeference.fit import Similarity, closed_form, fit_similarity

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Beforehand one place in so many is wrong; evidence mostly outweighs this by far.
_WRONG = 0.02
# Factors on the sigmas that are averaged over. Stated ones are right within a third, or too small: of what a receiver
# leaves out (the lever arm, the shutter), and of the model's own bend, the less likely the larger. Where nothing is
# stated anything from RTK on is likely alike beside a guess of some metres, and poorer the less likely.
_FACTORS = np.geomspace(1e-3, 1e3, 97)
_STATED_SPREAD, _STATED_UP_TO, _GUESS_RANGE, _GUESS_POOR = 0.3, 300.0, (2e-3, 20.0), 2.0
# All triples up to this many, else as many drawn: with 40 % wrong places one in five triples is right.
_MAX_TRIPLES = 2000
# ... and fewer where there are so many places that memory would matter: then fewer do
_MAX_SCORES = 4_000_000
_NUM_STARTS, _CONCENTRATIONS, _NUM_FITTED = 10, 10, 10
# Another explanation counts if it puts some camera so many sigmas elsewhere, and is not so much less likely: e^5 = 150.
_ELSEWHERE_SIGMAS, _CLEAR_LOG_ODDS = 10.0, 5.0


@dataclass(frozen=True)
class Rival:
    """Another explanation that is not clearly less likely.

    Attributes:
        similarity: by it; is_inlier: (n,) bool, the places that agree with it.
        log_odds: of the first against it.
    """

    similarity: Similarity
    is_inlier: Mask
    log_odds: float


@dataclass(frozen=True)
class Explanation:
    """The likeliest set of places.

    Attributes:
        similarity: that fits them best; is_inlier: (n,) bool, the set.
        factor: on the sigmas, by these.
        rival: None where no other is nearly as likely.
    """

    similarity: Similarity
    is_inlier: Mask
    factor: float
    rival: Rival | None


def likeliest_set(centers: Array, places: Array, sigma: Array, *, is_stated: bool) -> Explanation | None:
    """The set of places that explains a model and the places best.

    Args:
        centers: (n, 3) in the model; places: (n, 3); sigma: (n, 3) of the places, infinite for what is unknown.
        is_stated: sigmas are more than a guess.

    Returns:
        None where no set determines a similarity. Three places are a set of their own.
    """
    if len(centers) < 3:
        return None
    prior = _prior_of_factors(is_stated=is_stated)
    known = np.isfinite(sigma)
    # a wrong place lies anywhere in a box about all of them
    reach = np.where(known, np.abs(places - _median(places)), 0.0).max(0)
    anywhere = np.where(known, np.log(np.maximum(2.0 * reach, sigma) / np.where(known, sigma, 1.0)), 0.0).sum(1)
    beforehand = anywhere - np.log(_WRONG / (1.0 - _WRONG))

    def judged(start: Similarity, is_inlier: Mask) -> tuple[float, float]:
        """Log likelihood of a set, and the factor by it."""
        squares = np.where(known, (start.apply(centers) - np.where(known, places, 0.0)) / sigma, 0.0) ** 2
        freedom = int(known[is_inlier].sum()) - 7
        likelihood, factor = _averaged(float(squares[is_inlier].sum()), max(freedom, 1), prior)
        return likelihood - float(beforehand[~is_inlier].sum()), factor

    first = sorted(
        ((judged(start, is_inlier)[0], start, is_inlier) for start, is_inlier in _sets(centers, places, sigma)),
        key=lambda one: -one[0],
    )
    found = []
    for _, start, is_inlier in first[:_NUM_FITTED]:
        fit = fit_similarity(centers, places, sigma, is_inlier, start) or start
        found.append((*judged(fit, is_inlier), fit, is_inlier))
    if not found:
        return None
    found.sort(key=lambda one: -one[0])
    likelihood, factor, fit, is_inlier = found[0]
    rival = None
    for other, _, similarity, agreeing in found[1:]:
        off = np.abs(similarity.apply(centers) - fit.apply(centers)) / sigma
        if likelihood - other < _CLEAR_LOG_ODDS and off.max() > _ELSEWHERE_SIGMAS * factor:
            rival = Rival(similarity, agreeing, likelihood - other)
            break
    return Explanation(fit, is_inlier, factor, rival)


def _median(places: Array) -> Array:
    """(3,) of places (n, 3); zero where none is known."""
    columns = [column[np.isfinite(column)] for column in places.T]
    return np.array([np.median(column) if len(column) else 0.0 for column in columns])


def _prior_of_factors(*, is_stated: bool) -> Array:
    """Probabilities of :data:`_FACTORS`."""
    if not is_stated:
        within = np.clip(_FACTORS, *_GUESS_RANGE) == _FACTORS
        weight = np.where(within, np.minimum(1.0, _GUESS_POOR / _FACTORS), 0.0)
        return np.asarray(weight / weight.sum(), np.float64)
    right = np.exp(-0.5 * (np.log(_FACTORS) / _STATED_SPREAD) ** 2)
    wider = np.where((_FACTORS >= 1.0) & (_FACTORS <= _STATED_UP_TO), 1.0 / _FACTORS, 0.0)
    both: Array = 0.5 * right / right.sum() + 0.5 * wider / wider.sum()
    return both


def _averaged(squares: float, freedom: int, prior: Array) -> tuple[float, float]:
    """Log likelihood of so many normal numbers with this sum of squares, over the factors on their sigmas, and the
    factor by it (geometric mean)."""
    logs = np.log(_FACTORS)
    with np.errstate(divide="ignore"):
        each = np.log(prior) - freedom * (logs + 0.5 * np.log(2.0 * np.pi)) - 0.5 * squares / _FACTORS**2
    top = float(each.max())
    weight = np.exp(each - top)
    return top + float(np.log(weight.sum())), float(np.exp((weight @ logs) / weight.sum()))


def _sets(centers: Array, places: Array, sigma: Array) -> Iterator[tuple[Similarity, Mask]]:
    """Sets of places that a similarity fits best among those of their size, with it."""
    num = len(centers)
    flat = np.where(np.isfinite(places), places, 0.0)
    weight = 1.0 / np.where(np.isfinite(sigma), sigma, np.inf) ** 2

    def scores(rotation: Array, scale: Array, shift: Array) -> Array:
        moved = scale[:, None, None] * (centers @ rotation.transpose(0, 2, 1)) + shift[:, None]
        squares: Array = ((moved - flat) ** 2 * weight).sum(2)
        return squares

    triples = _triples(num)
    tried = closed_form(centers[triples], flat[triples])
    trimmed = np.cumsum(np.sort(scores(*tried), axis=1), axis=1)
    seen: set[bytes] = set()
    for size in _sizes(num):
        order = np.argsort(trimmed[:, size - 1], kind="stable")[:_NUM_STARTS]
        rotation, scale, shift = (part[order] for part in tried)
        kept = np.zeros((0, size), np.int64)
        for _ in range(_CONCENTRATIONS):
            before, kept = kept, np.sort(
                np.argsort(scores(rotation, scale, shift), axis=1, kind="stable")[:, :size], axis=1
            )  # fmt: skip
            if np.array_equal(before, kept):
                break
            rotation, scale, shift = closed_form(centers[kept], flat[kept])
        for k in range(len(kept)):
            if kept[k].tobytes() in seen or not (np.isfinite(scale[k]) and scale[k] > 0):
                continue
            seen.add(kept[k].tobytes())
            is_inlier = np.zeros(num, bool)
            is_inlier[kept[k]] = True
            yield (
                Similarity(rotation[k], float(scale[k]), np.zeros(3), shift[k], np.zeros((7, 7)), np.ones((num, 3))),
                is_inlier,
            )


def _triples(num: int) -> NDArray[np.int64]:
    if num**3 <= 6 * _MAX_TRIPLES:
        return np.array(list(combinations(range(num), 3)), np.int64)
    drawn = np.random.default_rng(num).integers(0, num, (min(_MAX_TRIPLES, _MAX_SCORES // num), 3))
    triples = np.sort(drawn, axis=1)
    distinct: NDArray[np.int64] = triples[(triples[:, 0] != triples[:, 1]) & (triples[:, 1] != triples[:, 2])]
    return distinct


def _sizes(num: int) -> list[int]:
    """Sizes of sets: all but a few, and fewer and fewer down to just over half, three at least."""
    least = max(3, num // 2 + 1)
    most = num - least
    wrong = {*range(min(7, most + 1)), *np.geomspace(7, max(most, 7), 10).round().astype(int).tolist()}
    return [num - w for w in sorted(wrong) if w <= most]
