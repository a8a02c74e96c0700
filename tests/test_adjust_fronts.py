"""The factor by fronts and the entries of the inverse that it makes, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from sfmapp.adjust.fronts import FrontFactor, FrontOrder, order_of


def system(kind: str, num: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A positive definite matrix of blocks of one to eight unknowns, and the block of each."""
    rng = np.random.default_rng(seed)
    apart = np.abs(np.arange(num)[:, None] - np.arange(num))
    met = {
        "loop": np.minimum(apart, num - apart) < 4, "scattered": rng.random((num, num)) < 0.04, "full": apart >= 0,
        "apart": apart < 1, "two": (apart < 3) & ((np.arange(num) < num // 2)[:, None] == (np.arange(num) < num // 2)),
    }[kind]  # fmt: skip
    met[:, -1] |= kind == "loop"  # a camera that all share
    block_of = np.repeat(np.arange(num), rng.integers(1, 9, num))
    matrix = rng.normal(size=(len(block_of), len(block_of))) * (met | met.T)[np.ix_(block_of, block_of)]
    matrix = np.triu(matrix) + np.triu(matrix, 1).T
    return matrix + np.diag(np.abs(matrix).sum(1) + 0.1), block_of


def factor_of(matrix: np.ndarray, block_of: np.ndarray) -> FrontFactor:
    found = sparse.csc_matrix(matrix)
    return FrontFactor(found, block_of, order_of(found, block_of))


@pytest.mark.parametrize("kind", ["loop", "scattered", "full", "apart", "two"])
def test_a_factor_by_fronts_solves_and_inverts_as_dense_algebra_does(kind: str) -> None:
    matrix, block_of = system(kind, 70, 1)
    factor, inverse = factor_of(matrix, block_of), np.linalg.inv(matrix)
    right = np.random.default_rng(2).normal(size=(len(matrix), 3))
    np.testing.assert_allclose(factor.solve(right), np.linalg.solve(matrix, right), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(factor.solve(right[:, 0]), np.linalg.solve(matrix, right[:, 0]), rtol=1e-9, atol=1e-12)
    is_made = np.zeros(matrix.shape, bool)
    for unknowns, num_own, found in factor.inverse():
        np.testing.assert_allclose(found, inverse[np.ix_(unknowns, unknowns)], rtol=1e-8, atol=1e-12)
        is_made[np.ix_(unknowns, unknowns[:num_own])] = True
    assert (is_made | is_made.T)[matrix != 0].all()
    assert is_made.mean() > 0.99 if kind == "full" else is_made.mean() < 0.5


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


def test_a_matrix_that_is_not_positive_definite_is_told() -> None:
    matrix, block_of = system("loop", 30, 3)
    matrix[17, 17] = -1.0
    with pytest.raises(np.linalg.LinAlgError):
        factor_of(matrix, block_of)
