"""Cells that mixtures of lamps show to be empty, whatever edges the object has.

If the camera's direction c lies among those of three lamps, ``c = sum a_i l_i`` with all a_i positive, then
``n c = sum a_i (n l_i) <= sum a_i max(n l_i, 0)`` whatever the normal n: under that mixture of lamps a matt surface is
at least as bright as under the camera's own light. A pixel is a sum of what it shows, so that holds for edges of any
sharpness, for rough surfaces and any albedo. Where the mixture is darker, something stands between the surface and one
of the three.

So let U hold the object O, and let R be a part of U from whose points straight ways to the camera, and to three such
lamps, meet nothing of U but R, and where the mixture is darker than the camera's light. If there were points of O in R,
then the one that is nearest to the camera along its axis would be seen, and be reached by all three, as whatever could
hide it would be one of O nearer still: lamps are less than a right angle from the camera. So R is empty. All such R
together are one again. It is found by holding cells that are not proven, with ways through what is not yet held, until
none is left to be held, which does not depend on the order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, generate_binary_structure

from sfmapp.carve.cell_grid import CellGrid
from sfmapp.carve.mixture_kernels import FREE, HELD, hold_unproven
from sfmapp.carve.views import View, project_points

Array = NDArray[np.float64]
Levels = NDArray[np.float32]

# share of the camera's light that a mixture is taken to show at least: light falls off with distance within the object,
# is sent on by its other parts, and powers of lamps are not known better
_LIMIT = 0.75


@dataclass(frozen=True)
class LampLight:
    """What the photographs of one camera show of light under each lamp.

    Attributes:
        view: index of the camera.
        lamps: (L, 3) places of the lamps, world.
        most: (L, H, W) float32, of each pixel the greatest brightness that it may have under each lamp, against that
            under a lamp of the same power and at the same distance at the camera; inf where nothing is known.
    """

    view: int
    lamps: Array
    most: Levels


def proven_empty(grid: CellGrid, view: View, light: LampLight) -> NDArray[np.int64]:
    """Cells (N, 3) of a window that one camera and its lamps prove to be empty, and that are beside no other.

    Ways go from the middles of cells, so those beside a held one are left out.
    """
    state = grid.filled.copy()
    places = np.argwhere(state)
    seen = np.empty((len(places), 3))
    middles = grid.low + (places + 0.5) * grid.tree.cell
    project_points(view.row, middles, seen)
    is_seen = (seen > 0.0).all(axis=1) & (seen[:, :2] < [view.width, view.height]).all(axis=1)
    places, middles = places[is_seen], middles[is_seen]
    columns, rows = seen[is_seen, :2].astype(np.int64).T
    # where no lamp is missed, nothing is proven
    is_dark = light.most.min(axis=0)[rows, columns] < _LIMIT
    places, middles = places[is_dark], middles[is_dark]
    state[tuple(places.T)] = FREE
    places = places[np.argsort(np.linalg.norm(middles - view.center, axis=1), kind="stable")].astype(np.int32)
    while hold_unproven(
        view.row, view.center, light.lamps, light.most, _LIMIT, grid.low, grid.tree.cell, places, state
    ):
        pass
    beside = binary_dilation(state == HELD, generate_binary_structure(3, 1))
    return np.argwhere((state == FREE) & ~beside)
