"""What looks at landmarks say for and against a place.

Landmarks that a pose puts into the image are there as they were, or not. Neighbours stand and fall together: one box
that was carried away takes all of its landmarks along, and one poster that hangs elsewhere as well brings all of its
own. So evidence is counted by clusters of landmarks: in the right place the share that is found differs from cluster to
cluster (a beta distribution), one in twenty clusters is hidden or has changed, and in a wrong place one in twenty is
there by being of the kind that is everywhere. No cluster speaks by more than nineteen to one then, however many
landmarks it has, and none speaks twice, however often it is looked at: standing still makes nobody surer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ids = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Beta distributions of the share of a cluster that is found: of one that is there, and of one that is not, where one
# landmark in twenty resembles what is in its place by chance (relocalize.agreement_at).
_THERE, _NOT_THERE = (3.0, 1.0), (1.0, 19.0)
# Share of clusters of a right place that are hidden or have changed (1 to 2 % were in a rendered hall in which nothing
# changes), and of those of a wrong one that look alike.
CHANGED, _COMMON = 0.05, 0.05
# Probability of as many missing clusters by chance that contradicts a place.
_CHANCE = 0.01
# All that speaks against a place that is believed: of a thousand cameras that believe to know where they are, one does
# not, as far as the likelihoods are right.
MAX_DOUBT = 1e-3
# Probability, beforehand, that the camera is at no place of a map; its places share the rest.
NOT_IN_MAP = 0.5
# Fewest landmarks of a cluster that speaks.
_MIN_LANDMARKS = 3


@dataclass(frozen=True)
class Score:
    """What clusters say of a place, sums of log likelihood ratios against chance.

    Attributes:
        support: of all clusters. distinct: of those that are found and have no like elsewhere in the map.
        against: of those that are missing, at most 0.
        num_clusters: that speak. num_missing: that speak against it. num_distinct: that are found and have no like.
    """

    support: float = 0.0
    distinct: float = 0.0
    against: float = 0.0
    num_clusters: int = 0
    num_missing: int = 0
    num_distinct: int = 0

    @property
    def total(self) -> float:
        """What counts against other places and against none: what has its like elsewhere speaks for no place."""
        return self.distinct + self.against

    @property
    def is_contradicted(self) -> bool:
        """More is missing than what is hidden or has changed in a right place."""
        return self.is_contradicted_beyond(CHANGED)

    def is_contradicted_beyond(self, share: float) -> bool:
        """The same where another share of the clusters of a right place is hidden or has changed."""
        return is_contradicted(self.num_clusters, self.num_missing, share)


@dataclass
class Tally:
    """How often landmarks were looked for from a place, and found.

    Attributes:
        point_id: (N,) ascending. num_looks, num_found: (N,).
    """

    point_id: Ids = field(default_factory=lambda: np.zeros(0, np.int64))
    num_looks: Ids = field(default_factory=lambda: np.zeros(0, np.int64))
    num_found: Ids = field(default_factory=lambda: np.zeros(0, np.int64))

    def add(self, point_id: Ids, is_found: Mask) -> None:
        """Another look at landmarks (M,), each at most once."""
        ids, row = np.unique(np.concatenate([self.point_id, point_id]), return_inverse=True)
        old, new = row[: len(self.point_id)], row[len(self.point_id) :]
        looks, found = np.zeros(len(ids), np.int64), np.zeros(len(ids), np.int64)
        looks[old], found[old] = self.num_looks, self.num_found
        looks[new] += 1
        found[new] += is_found
        self.point_id, self.num_looks, self.num_found = ids, looks, found

    def clusters(self, cluster: Ids) -> Ids:
        """Those of its landmarks, ascending.

        Args:
            cluster: (P,) of the landmarks of the map, -1 for none.
        """
        found = np.unique(cluster[self.point_id])
        return found[found >= 0]

    def score(self, cluster: Ids, repeated: Ids) -> Score:
        """What all looks say together.

        Args:
            cluster: (P,) of the landmarks of the map, -1 for none. repeated: clusters that the map holds twice.
        """
        mine = cluster[self.point_id]
        known = mine >= 0
        ids, row = np.unique(mine[known], return_inverse=True)
        num = np.bincount(row, minlength=len(ids))
        found = np.bincount(row, (self.num_found / self.num_looks)[known], len(ids))
        speaks = num >= _MIN_LANDMARKS
        ratio = np.array([log_ratio(int(n), float(k)) for n, k in zip(num[speaks], found[speaks], strict=True)])
        is_distinct = ~np.isin(ids[speaks], repeated)
        return Score(
            float(ratio.sum()), float(ratio[is_distinct & (ratio > 0)].sum()), float(ratio[ratio < 0].sum()),
            int(speaks.sum()), int((ratio < 0).sum()), int((is_distinct & (ratio > 0)).sum()),
        )  # fmt: skip


def is_contradicted(num: int, num_against: int, share: float = CHANGED) -> bool:
    """Whether more of what was asked speaks against a place than the share that is hidden or has changed in a right
    one: as much by chance once in a hundred places."""
    logs = (
        math.lgamma(num + 1) - math.lgamma(k + 1) - math.lgamma(num - k + 1)
        + k * math.log(share) + (num - k) * math.log(1 - share)
        for k in range(num_against)
    )  # fmt: skip
    return 1.0 - sum(math.exp(log) for log in logs) < _CHANCE


def log_ratio_of_share(num: int, total: int, expected: float) -> float:
    """Logarithm of how much likelier it is that ``num`` of ``total`` independent draws are of a kind if its share is as
    found than if it is as expected; 0 where it is no larger."""
    if num <= expected * total:
        return 0.0
    share = num / total
    rest = (total - num) * math.log((1.0 - share) / (1.0 - expected)) if num < total else 0.0
    return num * math.log(share / expected) + rest


def log_prior(num_places: int) -> float:
    """Logarithm of the probability of one place of a map beforehand."""
    return math.log((1.0 - NOT_IN_MAP) / max(num_places, 1))


def log_ratio(num: int, found: float) -> float:
    """Logarithm of how much likelier a cluster of ``num`` landmarks, ``found`` of them there, is in the right place
    than in a wrong one."""
    there, not_there = _log_beta_binomial(num, found, _THERE), _log_beta_binomial(num, found, _NOT_THERE)
    most = max(there, not_there)
    a, b = math.exp(there - most), math.exp(not_there - most)
    return math.log((1 - CHANGED) * a + CHANGED * b) - math.log((1 - _COMMON) * b + _COMMON * a)


def _log_beta_binomial(num: int, found: float, beta: tuple[float, float]) -> float:
    """But for the binomial coefficient, which is common to both."""
    return _log_beta(found + beta[0], num - found + beta[1]) - _log_beta(*beta)


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
