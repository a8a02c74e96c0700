"""Oriented patches as the surface asks for them: how far apart they are, and what is near a place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import NoReconstructionError

NUM_NEAREST = 6
NUM_AROUND = 6
CHUNK = 200_000
# At least so many patches are asked how far apart they are. The distance to the sixth neighbour scatters by a fifth:
# the median of all of them is told to a thousandth.
_ASKED = 100_000


@dataclass(frozen=True)
class PatchCloud:
    """Patches (N) that can be asked for those near a place.

    Attributes:
        xyz: (N, 3) float64, world.
        normal: (N, 3) float32 unit normals, outward.
        rgb: (N, 3) uint8.
        spacing: (N,) float64 distance at which neighbours of each patch are expected, world units.
        median_spacing: its median over the patches, world units.
        tree: scipy's cKDTree of the places.
    """

    xyz: NDArray[np.float64]
    normal: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    spacing: NDArray[np.float64]
    median_spacing: float
    tree: Any

    def nearest(self, xyz: NDArray[np.float64], threads: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Distances (M, K) and positions (M, K) of the patches nearest to places (M, 3), nearest first."""
        k = min(NUM_NEAREST, len(self.xyz))
        distance, idx = self.tree.query(xyz, k=list(range(1, k + 1)), workers=threads)
        return distance, idx


def make_patch_cloud(
    xyz: NDArray[np.float64],
    normal: NDArray[np.float32],
    rgb: NDArray[np.uint8],
    size: NDArray[np.float32],
    threads: int,
) -> PatchCloud:
    """Build the search tree and find the spacing of the patches, as that of a square grid of the same density.

    The distance to the nearest neighbour alone would depend on how regular the patches lie, and a stray patch has a
    large one. Where a patch's neighbours are to be expected is known from what its pixel measures; the median over all
    patches of one by the other makes up for the pixels of a cell and for images that overlap.

    Args:
        xyz, normal, rgb: (N, 3) patches.
        size: (N,) what a pixel measures at each patch, world units.

    Raises:
        NoReconstructionError: there are fewer than eight patches, or most are at the same place.
    """
    from scipy.spatial import cKDTree

    if len(xyz) <= NUM_AROUND:
        raise NoReconstructionError(f"surface: expected more than {NUM_AROUND} patches, found {len(xyz)}")
    # sliding midpoints instead of medians: a fifth of the time to build, and no slower to ask for surfaces
    tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)
    some = slice(None, None, max(len(xyz) // _ASKED, 1))
    distance = tree.query(xyz[some], k=[NUM_AROUND + 1], workers=threads)[0][:, 0]
    # on average so many others are within that distance of a patch: the circle holds so many squares of the grid
    grid = distance * np.sqrt(np.pi / NUM_AROUND)
    spacing = float(np.median(grid / size[some])) * size.astype(np.float64)
    if not spacing.min() > 0.0:
        raise NoReconstructionError("surface: expected patches at different places, found most of them at the same")
    return PatchCloud(xyz, normal, rgb, spacing, float(np.median(grid)), tree)
