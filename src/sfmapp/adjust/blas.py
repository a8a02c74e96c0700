"""Factors and products in place, in rows of larger arrays: BLAS and LAPACK by the pointers that scipy has for Cython.

numpy copies what it factors and subtracts, and knows no triangles; scipy's own functions copy what is not alone in its
memory, and hold the GIL. Called by their pointers they do neither. Matrices are float64, of any distance between rows
and none between columns. The caller sees to it that there is one thread of BLAS.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_MODULES = {"dpotrf": "cython_lapack", "dpotri": "cython_lapack"}


def factor_lower(matrix: Array) -> bool:
    """Put the Cholesky factor L of a symmetric matrix (N, N), of which the lower half counts, into that half; False
    where it is not positive definite."""
    return _lapack("dpotrf", matrix)


def invert_lower(factor: Array) -> bool:
    """Put the lower half of the inverse of L L^T in the place of L (N, N), its lower half; False where it is
    singular."""
    return _lapack("dpotri", factor)


def divide_rows(rows: Array, factor: Array, *, is_turned: bool) -> None:
    """``rows L^-1`` in the place of rows (M, N), or ``rows L^-T`` where turned; L (N, N) is the lower half."""
    num, size = rows.shape
    turn = b"T" if is_turned else b"N"
    _call("dtrsm", b"L", b"U", turn, b"N", size, num, 1.0, factor, _step(factor), rows, _step(rows))


def divide_columns(columns: Array, factor: Array, *, is_turned: bool) -> None:
    """``L^-1 columns`` in the place of columns (N, M), or ``L^-T columns`` where turned."""
    size, num = columns.shape
    turn = b"T" if is_turned else b"N"
    if num == 1:
        _call("dtrsv", b"U", b"N" if is_turned else b"T", b"N", size, factor, _step(factor), columns, _step(columns))
        return
    _call("dtrsm", b"R", b"U", turn, b"N", num, size, 1.0, factor, _step(factor), columns, _step(columns))


def subtract_product(out: Array, left: Array, right: Array) -> None:
    """Take ``left right^T`` off out (M, N); left (M, K), right (N, K)."""
    (rows, columns), inner = out.shape, left.shape[1]
    _call("dgemm", b"T", b"N", columns, rows, inner, -1.0, right, _step(right), left, _step(left), 1.0, out, _step(out))


def subtract_square(out: Array, left: Array) -> None:
    """Take ``left left^T`` off the lower half of out (M, M); left (M, K)."""
    _call("dsyrk", b"U", b"T", len(out), left.shape[1], -1.0, left, _step(left), 1.0, out, _step(out))


def _step(matrix: Array) -> int:
    """How far a row is from the last one, in numbers."""
    return max(1, matrix.strides[0] // 8)


def _lapack(name: str, matrix: Array) -> bool:
    info = ctypes.c_int(0)
    _call(name, b"U", len(matrix), matrix, _step(matrix), info)
    return info.value == 0


def _call(name: str, *arguments: Any) -> None:
    """Fortran's way: all by reference. It counts by columns, so that its upper half is our lower one."""
    if any(isinstance(a, np.ndarray) and a.size == 0 for a in arguments):
        return
    _function(name, len(arguments))(*map(_reference, arguments))


def _reference(argument: Any) -> Any:
    if isinstance(argument, np.ndarray):
        return ctypes.c_void_p(argument.ctypes.data)
    if isinstance(argument, int):
        return ctypes.byref(ctypes.c_int(argument))
    if isinstance(argument, float):
        return ctypes.byref(ctypes.c_double(argument))
    return argument if isinstance(argument, bytes) else ctypes.byref(argument)


@cache
def _function(name: str, num_arguments: int) -> Any:
    """What scipy exports to Cython under a name; ctypes lets go of the GIL while it runs."""
    from importlib import import_module

    capsule = import_module(f"scipy.linalg.{_MODULES.get(name, 'cython_blas')}").__pyx_capi__[name]
    name_of, pointer_of = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
    name_of.restype, name_of.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer_of.restype, pointer_of.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    signature = name_of(capsule)
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * num_arguments)(pointer_of(capsule, signature))
