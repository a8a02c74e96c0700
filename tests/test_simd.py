"""The vector intrinsics against numpy and exact arithmetic, at any alignment, for any number of rows."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.simd import bilinear, dots, f32x16, f64x8
from sfmapp.simd.bits import count_bits
from sfmapp.simd.pointers import Pointer, offset, pointer
from sfmapp.simd.shared import shared_filler, shared_function

SHIFTS = [0, 1, 3, 7, 13]  # elements from the start of an array: addresses of any alignment
GUARD = -12345.0


def rounded(exact: Fraction, kind: type[np.floating[Any]]) -> float:
    """The float of a kind that is nearest to a rational number, of two the even one."""
    start = kind(float(exact))
    candidates = [start, np.nextafter(start, kind(-np.inf)), np.nextafter(start, kind(np.inf))]
    unsigned = np.uint32 if kind is np.float32 else np.uint64
    return float(min(candidates, key=lambda c: (abs(Fraction(float(c)) - exact), int(c.view(unsigned)) & 1)))


def fused(a: Any, b: Any, c: Any, kind: type[np.floating[Any]]) -> Any:
    """``a * b + c`` elementwise with one rounding."""
    exact = np.frompyfunc(
        lambda x, y, z: rounded(Fraction(float(x)) * Fraction(float(y)) + Fraction(float(z)), kind), 3, 1
    )
    return exact(a, b, c).astype(kind)


def guarded(values: NDArray[Any], shift: int) -> NDArray[Any]:
    """Values behind ``shift`` other numbers and before twenty."""
    out = np.full(shift + values.size + 20, GUARD).astype(values.dtype)
    out[shift : shift + values.size] = values.ravel()
    return out


# ------------------------------------------------------------------------------------------------------------- pointers


@numba.njit
def _read(array, start, count):  # type: ignore[no-untyped-def]
    p = offset(offset(pointer(array), start + 2), -2)
    out = np.empty(count, array.dtype)
    for i in range(count):
        out[i] = p[i]
    p[0] = 77
    return out


@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.int32, np.uint32, np.float32, np.float64])
def test_pointers_read_and_write_the_array(dtype: type) -> None:
    array = np.arange(24, dtype=dtype).reshape(4, 6)
    np.testing.assert_array_equal(_read(array, 5, 7), np.arange(5, 12, dtype=dtype))
    assert array[0, 5] == 77
    assert (array.ravel()[[4, 6]] == [4, 6]).all()
    part = np.arange(24, dtype=dtype)[9:]
    np.testing.assert_array_equal(_read(part, 1, 3), np.arange(10, 13, dtype=dtype))


# ---------------------------------------------------------------------------------------------------------------- f64x8


@numba.njit
def _updates(which, C, c, A, a, B, b, rows):  # type: ignore[no-untyped-def]
    if which == 0:
        f64x8.add2(C, c, A, a, B, b, rows)
    elif which == 1:
        f64x8.subtract3(pointer(C), c, pointer(A), a, pointer(B), b, rows)
    elif which == 2:
        f64x8.assign3(C, c, A, a, B, b, rows)
    elif which == 3:
        f64x8.subtract8(C, c, pointer(A), a, B, b, rows)
    else:
        f64x8.assign8(C, c, A, a, pointer(B), b, rows)


@pytest.mark.parametrize("shift", SHIFTS)
@pytest.mark.parametrize("rows", [0, 1, 3, 5, 8])
@pytest.mark.parametrize(
    ("which", "depth", "sign"), [(0, 2, 1), (1, 3, -1), (2, 3, 0), (3, 8, -1), (4, 8, 0)],
    ids=["add2", "subtract3", "assign3", "subtract8", "assign8"],
)  # fmt: skip
def test_updates_are_fused_sums_in_order(which: int, depth: int, sign: int, rows: int, shift: int) -> None:
    rng = np.random.default_rng(10 * which + rows)
    c, a, b = rng.standard_normal((rows, 8)), rng.standard_normal((depth, 8)), rng.standard_normal((depth, 8))
    expected = c if sign else np.zeros_like(c)
    for k in range(depth):
        expected = fused(a[k, :rows, None], -b[k] if sign < 0 else b[k], expected, np.float64)
    target, left, right = guarded(c, shift), guarded(a, shift + 1), guarded(b, shift)
    _updates(which, target, shift, left, shift + 1, right, shift, rows)
    np.testing.assert_array_equal(target, guarded(expected.astype(float), shift))  # and nothing beside it
    np.testing.assert_array_equal(left, guarded(a, shift + 1))
    np.testing.assert_array_equal(right, guarded(b, shift))


def test_an_update_may_write_where_it_reads_its_rows() -> None:
    rng = np.random.default_rng(0)
    a, tile = rng.standard_normal((8, 8)), rng.standard_normal((8, 8))
    expected = np.zeros((8, 8))
    for k in range(8):
        expected = fused(a[k, :, None], tile[k], expected, np.float64)
    flat = tile.ravel().copy()
    _updates(4, flat, 0, a.ravel(), 0, flat, 0, 8)
    np.testing.assert_array_equal(flat.reshape(8, 8), expected)


@numba.njit
def _store8(C, c, v):  # type: ignore[no-untyped-def]
    f64x8.store8(C, c, v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7])
    f64x8.store8(pointer(C), c + 9, v[7], v[6], v[5], v[4], v[3], v[2], v[1], v[0])


@pytest.mark.parametrize("shift", SHIFTS)
def test_store8_writes_eight_numbers(shift: int) -> None:
    values = np.random.default_rng(0).standard_normal(8)
    target = guarded(np.full(17, GUARD), shift)
    _store8(target, shift, values)
    np.testing.assert_array_equal(target, guarded(np.concatenate([values, [GUARD], values[::-1]]), shift))


@numba.njit
def _spread(C, c, base, A, a, slots, units, first, last):  # type: ignore[no-untyped-def]
    f64x8.spread(C, c, pointer(base), A, a, slots, pointer(units), first, last)


@pytest.mark.parametrize("shift", SHIFTS)
@pytest.mark.parametrize(("first", "last"), [(0, 0), (0, 1), (1, 4), (0, 5), (3, 3)])
def test_spread_adds_the_columns_that_slots_name(first: int, last: int, shift: int) -> None:
    rng = np.random.default_rng(last)
    base, a, units = rng.standard_normal((2, 8)), rng.standard_normal((6, 2)), rng.standard_normal((5, 8))
    slots = np.array([5, 0, 3, 3, 1])
    expected = base
    for n in range(first, last):
        expected = fused(a[slots[n], :, None], units[n], expected, np.float64)
    target = guarded(np.zeros(16), shift)
    _spread(target, shift, base.ravel(), guarded(a, shift), shift, slots, units.ravel(), first, last)
    np.testing.assert_array_equal(target, guarded(expected.astype(float), shift))


# --------------------------------------------------------------------------------------------------------------- f32x16


@numba.njit
def _arithmetic(a, b, c, at, out):  # type: ignore[no-untyped-def]
    x, y, z = f32x16.load(pointer(a), at), f32x16.load(pointer(b), at), f32x16.load(pointer(c), at)
    p = pointer(out)
    f32x16.store(p, at, f32x16.add(x, y))
    f32x16.store(p, at + 16, f32x16.subtract(x, y))
    f32x16.store(p, at + 32, f32x16.multiply(x, y))
    f32x16.store(p, at + 48, f32x16.divide(x, y))
    f32x16.store(p, at + 64, f32x16.fma(x, y, z))
    f32x16.store(p, at + 80, f32x16.splat(a[at + 2]))
    f32x16.store(p, at + 96, f32x16.ramp(a[at], b[at]))
    return f32x16.total(x)


@pytest.mark.parametrize("shift", SHIFTS)
def test_rows_do_the_arithmetic_of_float32(shift: int) -> None:
    rng = np.random.default_rng(shift)
    a, b, c = (rng.standard_normal(16).astype(np.float32) for _ in range(3))
    b[0] = a[0] + 6.5  # where the ramp ends
    out = np.full(shift + 7 * 16 + 20, GUARD, np.float32)
    total = _arithmetic(*(guarded(v, shift) for v in (a, b, c)), shift, out)
    ramp = np.minimum(a[0] + np.arange(16, dtype=np.float32), b[0])
    rows = [a + b, a - b, a * b, a / b, fused(a, b, c, np.float32), np.full(16, a[2]), ramp]
    np.testing.assert_array_equal(out, guarded(np.concatenate(rows), shift))
    folded = a
    while len(folded) > 1:
        folded = folded[: len(folded) // 2] + folded[len(folded) // 2 :]
    assert total == folded[0]


@numba.njit
def _load_bytes(pixels, at, out):  # type: ignore[no-untyped-def]
    f32x16.store(pointer(out), 0, f32x16.load_bytes(pointer(pixels), at))


@pytest.mark.parametrize("shift", SHIFTS)
def test_bytes_become_floats(shift: int) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, 16 + shift, dtype=np.uint8)
    pixels[shift] = 255  # not a negative number
    out = np.empty(16, np.float32)
    _load_bytes(pixels, shift, out)
    np.testing.assert_array_equal(out, pixels[shift:].astype(np.float32))


# ------------------------------------------------------------------------------------------------------------- bilinear


@numba.njit
def _sample_bytes(image, at, step, u, v, out):  # type: ignore[no-untyped-def]
    base = offset(pointer(image), at)
    rows = f32x16.load(pointer(u), 0), f32x16.load(pointer(v), 0)
    f32x16.store(pointer(out), 0, bilinear.sample_bytes(base, step, rows[0], rows[1]))


@numba.njit
def _sample_quads(quads, at, width, u, v, out):  # type: ignore[no-untyped-def]
    base, p = offset(pointer(quads), at), pointer(out)
    rows = f32x16.load(pointer(u), 0), f32x16.load(pointer(v), 0)
    f32x16.store(p, 0, bilinear.sample_quads(base, width, rows[0], rows[1]))
    value, dx, dy = bilinear.sample_quads_with_slopes(base, width, rows[0], rows[1])
    f32x16.store(p, 16, value)
    f32x16.store(p, 32, dx)
    f32x16.store(p, 48, dy)


@numba.njit
def _quad_pixels(quads, at, width, u, v, out):  # type: ignore[no-untyped-def]
    rows = f32x16.load(pointer(u), 0), f32x16.load(pointer(v), 0)
    f32x16.store(pointer(out), 0, bilinear.quad_pixels(offset(pointer(quads), at), width, rows[0], rows[1]))


def interpolated(image: NDArray[np.uint8], u: Any, v: Any) -> tuple[Any, Any, Any]:
    """Value and slopes of the bilinear surface, each step rounded to float32, multiply-adds once."""
    c, r = np.floor(u).astype(int), np.floor(v).astype(int)
    fx, fy = u - np.floor(u), v - np.floor(v)
    p00, p10 = image[r, c].astype(np.float32), image[r, c + 1].astype(np.float32)
    p01, p11 = image[r + 1, c].astype(np.float32), image[r + 1, c + 1].astype(np.float32)
    above, below = fused(fx, p10 - p00, p00, np.float32), fused(fx, p11 - p01, p01, np.float32)
    dx = fused(fy, (p11 - p01) - (p10 - p00), p10 - p00, np.float32)
    return fused(fy, below - above, above, np.float32), dx, below - above


@pytest.mark.parametrize("width", [5, 16, 33])
def test_samples_are_those_of_the_bilinear_surface(width: int) -> None:
    rng = np.random.default_rng(width)
    image = rng.integers(0, 256, (7, width), dtype=np.uint8)
    u = rng.uniform(0, width - 1.01, 16).astype(np.float32)
    v = rng.uniform(0, 5.99, 16).astype(np.float32)
    u[:3], v[:3] = [0.0, width - 2.0, 1.0], [0.0, 5.0, 2.5]  # on pixels, in corners
    value, dx, dy = interpolated(image, u, v)

    out = np.empty(64, np.float32)
    quads = np.concatenate([np.zeros(3, np.uint32), bilinear.pack_quads(image).ravel()])
    _sample_quads(quads, 3, np.int32(width), u, v, out)
    np.testing.assert_array_equal(out.reshape(4, 16), [value, value, dx, dy])
    # of bytes about any pixel, on either side of it
    out = np.empty(16, np.float32)
    padded = np.concatenate([image.ravel(), np.zeros(3, np.uint8)])
    _sample_bytes(padded, 2 * width + 1, width, u - np.float32(1), v - np.float32(2), out)
    np.testing.assert_array_equal(out, interpolated(image, u - np.float32(1) + 1, v - np.float32(2) + 2)[0])


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (3, 1), (5, 7)])
def test_a_word_holds_a_pixel_and_those_right_and_below(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    wide = np.zeros((shape[0] + 1, shape[1] + 1), np.uint32)
    wide[:-1, :-1] = image
    expected = wide[:-1, :-1] | wide[:-1, 1:] << 8 | wide[1:, :-1] << 16 | wide[1:, 1:] << 24
    np.testing.assert_array_equal(bilinear.pack_quads(image), expected)


def test_pixels_at_whole_offsets_on_all_sides() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (9, 11), dtype=np.uint8)
    u, v = rng.integers(-5, 6, 16), rng.integers(-4, 5, 16)
    out = np.empty(16, np.float32)
    quads = bilinear.pack_quads(image).ravel()
    _quad_pixels(quads, 4 * 11 + 5, np.int32(11), u.astype(np.float32), v.astype(np.float32), out)
    np.testing.assert_array_equal(out, image[4 + v, 5 + u])


# ----------------------------------------------------------------------------------------------------------------- dots


@numba.njit
def _tile(a, packed, row, group, sums, masks, second1, second2):  # type: ignore[no-untyped-def]
    return dots.tile(a, packed, row, group, sums, masks, second1, second2)


def _packed(first: np.ndarray, second: np.ndarray, by_bytes: bool) -> tuple[np.ndarray, np.ndarray]:
    """Both matrices as the tile reads them."""
    row_type, group_type, offset, per_sum = (np.uint8, np.int8, 128, 4) if by_bytes else (np.int16, np.int16, 0, 2)
    starts = (offset * first.sum(1)).astype(np.int32)[:, None].view(row_type)
    groups = (second - offset).astype(group_type).reshape(-1, dots.LANES, dots.DIMS // per_sum, per_sum)
    return np.concatenate([first.astype(row_type), starts], 1), np.ascontiguousarray(groups.transpose(0, 2, 1, 3))


@pytest.mark.parametrize("largest", [255, 4000])
@pytest.mark.parametrize("shift", [0, 1, 5])
def test_a_tile_holds_the_products_and_marks_those_above_the_bounds(shift: int, largest: int) -> None:
    rng = np.random.default_rng(largest + shift)
    rows, groups, lanes, dims = 3 * dots.ROWS, 2 * dots.GROUPS, dots.LANES, dots.DIMS
    low = 0 if largest == 255 else -largest
    first = rng.integers(low, largest + 1, (rows, dims))
    second = rng.integers(low, largest + 1, (groups * lanes, dims))
    products = first @ second.T
    assert np.abs(products).max() < 2**31
    bound1 = np.quantile(products, 0.8, axis=1).astype(np.int32)
    bound2 = np.quantile(products, 0.9, axis=0).astype(np.int32)
    bound1[: dots.ROWS] = products.max()
    bound2[: dots.GROUPS * lanes] = products.max()  # the first tile has nothing to tell
    has_bytes = np.int8 == dots.GROUP_TYPE
    for by_bytes in (False, True) if has_bytes and largest == 255 else (False,):
        a, b = (guarded(x, shift)[shift : shift + x.size].reshape(x.shape) for x in _packed(first, second, by_bytes))
        told = []
        for row in range(0, rows, dots.ROWS):
            for group in range(0, groups, dots.GROUPS):
                room = np.full(dots.ROWS * dots.GROUPS * lanes + 2, 7, np.int32)
                sums, masks = room[1:-1].reshape(dots.ROWS, dots.GROUPS * lanes), np.zeros(dots.ROWS, np.uint32)
                is_any = _tile(a, b, row, group, sums, masks, bound1, bound2)
                i, j = np.arange(row, row + dots.ROWS), np.arange(group * lanes, (group + dots.GROUPS) * lanes)
                block = products[np.ix_(i, j)]
                above = (block > bound1[i, None]) | (block > bound2[j])
                np.testing.assert_array_equal(masks, (above << np.arange(len(j))).sum(axis=1))
                assert is_any == above.any()
                told.append(is_any)
                np.testing.assert_array_equal(sums, block if is_any else 7)
                assert room[0] == room[-1] == 7
        assert any(told)
        assert not told[0]


@numba.njit
def _best(a, packed, best1, best2):  # type: ignore[no-untyped-def]
    for row in range(0, len(a), dots.ROWS):
        for group in range(0, len(packed), dots.GROUPS):
            dots.tile_of_best(a, packed, row, group, best1, best2, row, row + 10 + dots.BLOCK * (group + 2))


@numba.njit
def _two_largest(best):  # type: ignore[no-untyped-def]
    found = np.empty((len(best), 2), np.int32)
    for i in range(len(best)):
        found[i, 0], found[i, 1] = dots.two_largest_lanes(best, i)
    return found


@pytest.mark.parametrize("by_bytes", [False, True])
def test_the_best_of_a_block_are_those_of_a_sort(by_bytes: bool) -> None:
    if by_bytes and np.int8 != dots.GROUP_TYPE:
        pytest.skip("the processor has no products of bytes")
    rng = np.random.default_rng(3)
    rows, columns = 3 * dots.ROWS, 2 * dots.GROUPS * dots.LANES
    first, second = rng.integers(0, 256, (rows, dots.DIMS)), rng.integers(0, 256, (columns, dots.DIMS))
    first[1], second[0], second[5] = 255, 255, 255  # the largest that there can be, twice
    best1 = np.zeros((rows, 2, dots.LANES), np.int32)
    best2 = np.zeros((2 * dots.GROUPS + 2, 2, dots.LANES), np.int32)
    _best(*_packed(first, second, by_bytes), best1, best2)
    assert not best2[:2].any()
    products = first @ second.T
    row_ids, column_ids = np.arange(rows) + 10, np.arange(columns) + 2 * dots.LANES
    of_rows = np.sort(256 * products + 255 - column_ids, 1)[:, :-3:-1]
    of_columns = np.sort(256 * products.T + 255 - row_ids, 1)[:, :-3:-1]
    np.testing.assert_array_equal(_two_largest(best1), of_rows)
    np.testing.assert_array_equal(best2[2:].transpose(0, 2, 1).reshape(-1, 2), of_columns)


# ----------------------------------------------------------------------------------------------------------------- bits


@numba.njit
def _count(words, out):  # type: ignore[no-untyped-def]
    for i in range(len(words)):
        out[i] = count_bits(words[i])


@pytest.mark.parametrize("size", [1, 7, 64, 65])
def test_bits_are_counted(size: int) -> None:
    words = np.random.default_rng(size).integers(0, 2**64, size, dtype=np.uint64)
    words[: min(size, 3)] = np.array([0, 2**64 - 1, 2**63], np.uint64)[: min(size, 3)]
    out = np.empty(size, np.uint64)
    _count(words, out)
    np.testing.assert_array_equal(out, np.bitwise_count(words))


# -------------------------------------------------------------------------------------- what is compiled once for all


def _scaled(numbers: Pointer, given: Pointer, out: Pointer) -> None:
    for n in range(3):
        out[n] = numbers[n] * given[n]


_scale, _fill_scaled = shared_function("sfmapp_test_scale", _scaled), shared_filler("sfmapp_test_fill", _scaled)


@numba.njit(nogil=True)
def _scale_both(factors: Any, x: Any, out: Any) -> float:
    a, b, c = _scale(factors, x[0], x[1], x[2])
    _fill_scaled(factors, x[0], x[1], x[2], out)
    return 100 * a + 10 * b + c


def test_what_is_shared_is_bound_by_the_first_call_in_whichever_thread() -> None:
    factors, x, out = np.array([1.0, 2.0, 3.0]), np.array([3.0, 2.0, 1.0]), np.zeros((8, 3))
    _scale_both.compile("(float64[::1], float64[::1], float64[::1])")  # type: ignore[attr-defined]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda n: _scale_both(factors, x, out[n]), range(8)))
    assert found == [343.0] * 8
    assert (out == [3.0, 4.0, 3.0]).all()


def test_what_is_shared_takes_no_array_with_gaps() -> None:
    with pytest.raises(numba.TypingError):
        _scale_both(np.arange(6.0)[::2], np.arange(3.0), np.zeros(3))
