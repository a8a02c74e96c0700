"""Copies of arrays in kernels.

``a[:] = b`` does the same, but brings code that broadcasts, and that writes the message of its failure: one to two CPU
seconds to compile.
"""

from __future__ import annotations

from typing import Any

import numba
from numpy.typing import NDArray


@numba.njit(cache=True, nogil=True, error_model="numpy")
def copy_into(out: NDArray[Any], values: NDArray[Any]) -> None:
    """Copy values, of any shape, into an array of the same shape; both without gaps."""
    to, of = out.reshape(-1), values.reshape(-1)
    for n in range(to.shape[0]):
        to[n] = of[n]
