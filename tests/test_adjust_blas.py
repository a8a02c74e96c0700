"""Factors and products in place, in parts of larger arrays, against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from sfmapp.adjust import blas


def part(rows: int, columns: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A part of a larger array, and the larger one."""
    whole = np.random.default_rng(seed).normal(size=(rows + 3, columns + 5))
    return whole[2 : rows + 2, 1 : columns + 1], whole


@pytest.mark.parametrize("size", [1, 7, 40])
def test_factors_and_what_is_divided_by_them_are_those_of_dense_algebra(size: int) -> None:
    matrix, whole = part(size, size, 0)
    matrix[:] = matrix @ matrix.T + size * np.eye(size)
    before, outside = matrix.copy(), whole.sum() - matrix.sum()
    assert blas.factor_lower(matrix)
    lower = np.tril(matrix)
    np.testing.assert_allclose(lower, np.linalg.cholesky(before), atol=1e-12)
    inverse = np.linalg.inv(lower)
    for is_turned, by in ((False, inverse), (True, inverse.T)):
        rows, columns = part(9, size, 1)[0], part(size, 9, 2)[0]
        expected = rows @ by, by @ columns, by @ columns[:, :1]
        blas.divide_rows(rows, matrix, is_turned=is_turned)
        single = columns[:, :1].copy()
        blas.divide_columns(columns, matrix, is_turned=is_turned)
        blas.divide_columns(single, matrix, is_turned=is_turned)
        for found, wanted in zip((rows, columns, single), expected, strict=True):
            np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert blas.invert_lower(matrix)
    np.testing.assert_allclose(np.tril(matrix), np.tril(np.linalg.inv(before)), atol=1e-12)
    assert whole.sum() - matrix.sum() == pytest.approx(outside)  # nothing beside it is touched
    matrix[:] = -np.eye(size)
    assert not blas.factor_lower(matrix)


def test_products_are_subtracted_where_they_belong() -> None:
    out, whole = part(6, 4, 3)
    left, right, before = part(6, 5, 4)[0], part(4, 5, 5)[0], whole.copy()
    blas.subtract_product(out, left, right)
    before[2:8, 1:5] -= left @ right.T
    np.testing.assert_allclose(whole, before, atol=1e-12)
    square, whole = part(6, 6, 6)
    before = whole.copy()
    blas.subtract_square(square, left)
    before[2:8, 1:7] -= np.tril(left @ left.T)
    np.testing.assert_allclose(whole, before, atol=1e-12)
    blas.subtract_product(out[:0], left[:0], right)  # nothing
