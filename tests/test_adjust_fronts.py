"""The order of fronts: what goes together, and how much it fills. What they factor and invert is in
``test_adjust_large.py``."""

from __future__ import annotations

import numpy as np

from sfmapp.adjust.fronts import FrontOrder


def test_fronts_gather_what_is_eliminated_together_and_fill_no_more_than_they_must() -> None:
    # all meet all: one front; a chain: as many entries as it has
    num = 40
    a, b = np.triu_indices(num)
    assert FrontOrder(num, a, b).num_own.tolist() == [num]
    chain = FrontOrder(num, np.arange(num - 1), np.arange(1, num))
    assert chain.num_entries == 2 * num - 1
    assert sorted(np.concatenate([o[:k] for o, k in zip(chain.blocks, chain.num_own, strict=True)])) == list(range(num))
    # a grid fills far less by its degrees than row by row
    side = 20
    at = np.arange(side * side).reshape(side, side)
    a, b = (np.concatenate([x.ravel(), y.ravel()]) for x, y in ((at[:, :-1], at[:-1]), (at[:, 1:], at[1:])))
    assert FrontOrder(side * side, a, b).num_entries < 0.6 * side * side * side
