"""The order of fronts: what goes together, and how much it fills. What they factor and invert is in
``test_adjust_large.py``."""

from __future__ import annotations

import numpy as np

from sfmapp.adjust.fronts import FrontOrder


def num_entries(order: FrontOrder) -> int:
    """Of the factor, in blocks, zeros that are kept included."""
    return sum(own * (own + 1) // 2 + own * (len(b) - own) for own, b in zip(order.num_own, order.blocks, strict=True))


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Neighbours on a square grid."""
    at = np.arange(side * side).reshape(side, side)
    a, b = (np.concatenate([x.ravel(), y.ravel()]) for x, y in ((at[:, :-1], at[:-1]), (at[:, 1:], at[1:])))
    return a, b


def test_fronts_eliminate_each_block_once_before_what_takes_over() -> None:
    order = FrontOrder(400, *grid(20))
    own = np.concatenate([b[:n] for b, n in zip(order.blocks, order.num_own, strict=True)])
    np.testing.assert_array_equal(order.position[own], np.arange(400))
    for f, (blocks, num, parent) in enumerate(zip(order.blocks, order.num_own, order.parent, strict=True)):
        assert (np.diff(order.position[blocks]) > 0).all()
        assert (parent > f and np.isin(blocks[num:], order.blocks[parent]).all()) or (parent < 0 and num == len(blocks))
    for a, b in zip(*grid(20), strict=True):  # each pair is in the columns of the one that goes first
        first = min(a, b, key=order.position.__getitem__)
        front = int(np.searchsorted(np.cumsum(order.num_own), order.position[first], side="right"))
        assert np.isin([a, b], order.blocks[front]).all()


def test_fronts_gather_what_is_eliminated_together_and_fill_little_more_than_they_must() -> None:
    a, b = np.triu_indices(40)
    assert FrontOrder(40, a, b).num_own.tolist() == [40]  # all meet all
    # a chain must have two entries for each block; small fronts are not worth their handling, but stay small
    for num in (1000, 4000):
        chain = FrontOrder(num, np.arange(num - 1), np.arange(1, num))
        assert 2 * num - 1 <= num_entries(chain) < 40 * num
        assert num / 80 < len(chain.blocks) < num / 4
    # a grid row by row fills side^3; by its degrees far less, and what is merged does not change that
    assert num_entries(FrontOrder(3600, *grid(60))) < 0.5 * 60**3
