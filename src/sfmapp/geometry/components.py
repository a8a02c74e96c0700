"""The trees of union-find, in which everything that hangs together has one root."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True, nogil=True)
def find_root(parent: NDArray[np.signedinteger[Any]], node: int) -> int:
    """The root above a node, where each of parent (N,) is what is above one, or itself; the way there is halved.

    Tarjan and van Leeuwen, "Worst-case analysis of set union algorithms", Journal of the ACM 1984.
    """
    while parent[node] != node:
        parent[node] = parent[parent[node]]
        node = parent[node]
    return node
