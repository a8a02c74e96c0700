"""Grids that grow from one of their points: each neighbour is looked for a step on from the point before."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Place: TypeAlias = tuple[int, int]
Steps: TypeAlias = tuple[Array, Array]


def grow(xy: Array, seed: int, first: Steps, find: Callable[[int, Array, Steps], int | None]) -> dict[Place, int]:
    """Points by place, the seed at (0, 0).

    A step is the one that led to a point, or, along the other axis, that of the point before; so it follows
    perspective and distortion.

    Args:
        xy: (N, 2) pixels.
        first: steps (2,) from the seed along both axes.
        find: the point that lies a step (2,) on from a point with these steps along the axes; None for none.
    """
    places: dict[Place, int] = {(0, 0): seed}
    taken, steps, queue = {seed}, {(0, 0): first}, deque([(0, 0)])
    while queue:
        at = queue.popleft()
        here = places[at]
        for axis, way in ((0, 1), (0, -1), (1, 1), (1, -1)):
            to = (at[0] + way, at[1]) if axis == 0 else (at[0], at[1] + way)
            if to in places:
                continue
            back = (at[0] - way, at[1]) if axis == 0 else (at[0], at[1] - way)
            step = xy[here] - xy[places[back]] if back in places else way * steps[at][axis]
            found = find(here, step, steps[at])
            if found is None or found in taken:
                continue
            places[to] = found
            taken.add(found)
            own = list(steps[at])
            own[axis] = way * (xy[found] - xy[here])
            steps[to] = (own[0], own[1])
            queue.append(to)
    return places
