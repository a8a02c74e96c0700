"""The arrays that the kernels of densification work on, bundled as named tuples, which numba takes apart at no cost."""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from sfmapp.simd.pointers import pointer

# surfaces that a cell can hold, one behind the other
LAYERS = 2

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]


class Images(NamedTuple):
    """Views (V) at one level of the pyramid, their grids of cells, and the pairs of each view with its neighbours (K).

    Pixels are index coordinates: the centre of the top-left pixel is (0, 0). The world is moved and scaled so that
    float32 does for places in it.

    Attributes:
        quads: (P,) uint32 packed words of all images; those of view m begin at ``start[m]``.
        start: (V,) int64.
        width, height: (V,) int32 pixels.
        k: (V, 4) float64 fx, fy, cx, cy.
        rotation, translation, center: (V, 3, 3), (V, 3), (V, 3) float64, cam_from_world and the camera's place.
        neighbors: (V, K) int32, best first, -1 behind the last.
        slot: (V, V) int8, where among the neighbours of the first view the second stands; -1 if it is none.
        a, b: (V, K, 9) and (V, K, 3) float32 of the warps from a view into its neighbours.
        cell_px: (1,) int32 side of a cell.
        cell_start: (V,) int64, columns, rows: (V,) int32. Cell (x, y) of view m is ``cell_start[m] + y columns[m]
            + x``.
        closed: (G,) uint8, not 0 in cells outside the masks.
        noise: (V,) float32 standard deviation of the noise in grey.
    """

    quads: NDArray[np.uint32]
    start: NDArray[np.int64]
    width: Ints
    height: Ints
    k: NDArray[np.float64]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    center: NDArray[np.float64]
    neighbors: Ints
    slot: NDArray[np.int8]
    a: Floats
    b: Floats
    cell_px: Ints
    cell_start: NDArray[np.int64]
    columns: Ints
    rows: Ints
    closed: NDArray[np.uint8]
    noise: Floats


class Store(NamedTuple):
    """Patches (N), or room for them.

    Attributes:
        xyz, normal: (N, 3) float32.
        score, sigma, size: (N,) float32 mean NCC with the trusted images; standard deviation along the ray of the
            reference image; what a pixel of the reference image measures at the patch.
        views: (N, K + 1) int16 trusted images, the reference first, the others from best to worst, -1 behind the last.
        num_views: (N,) uint8, 0 where there is no patch.
        wave: (N,) int32.
    """

    xyz: Floats
    normal: Floats
    score: Floats
    sigma: Floats
    size: Floats
    views: NDArray[np.int16]
    num_views: NDArray[np.uint8]
    wave: Ints

    @staticmethod
    def of_capacity(count: int, num_neighbors: int) -> Store:
        """Room for so many patches of which there is none yet; memory is taken as they come."""
        return Store(
            np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32),
            np.zeros(count, np.float32), np.zeros(count, np.float32), np.zeros(count, np.float32),
            np.zeros((count, num_neighbors + 1), np.int16), np.zeros(count, np.uint8), np.zeros(count, np.int32),
        )  # fmt: skip

    def grown(self, capacity: int) -> Store:
        """A copy with more room."""
        other = Store.of_capacity(capacity, self.views.shape[1] - 1)
        for name in self._fields:
            old = getattr(self, name)
            getattr(other, name)[: len(old)] = old
        return other

    def taken(self, idx: NDArray[np.intp]) -> Store:
        """A copy of the patches at some positions."""
        return Store(
            self.xyz[idx], self.normal[idx], self.score[idx], self.sigma[idx], self.size[idx],
            self.views[idx], self.num_views[idx], self.wave[idx],
        )  # fmt: skip


class Cells(NamedTuple):
    """What is known of the cells (G) of all views.

    Attributes:
        patch: (G, LAYERS) int32 patches in a cell, each of a surface of its own, -1 where there is none.
        tried: (G,) uint8 how often a patch was tried there; the highest bit marks cells that wait for the next wave.
    """

    patch: Ints
    tried: NDArray[np.uint8]


class Limits(NamedTuple):
    """Thresholds of a patch.

    Attributes:
        min_views: images that have to trust it, the reference among them.
        enough: images from which on nobody asks why the others do not trust it; of a patch with fewer, the others must
            have a reason for not seeing it.
        trusted: NCC from which an image trusts a patch.
        promising: NCC below which an image does not take part in the refinement.
        max_refined: images that take part in it, best first.
    """

    min_views: int
    enough: int
    trusted: float
    promising: float
    max_refined: int


class ImagePointers(NamedTuple):
    """The arrays of :class:`Images` as pointers, with what their shapes say.

    A tuple of arrays costs two atomic operations an array each time that it is handed on; pointers cost nothing.
    """

    quads: Any
    start: Any
    width: Any
    height: Any
    k: Any
    rotation: Any
    translation: Any
    center: Any
    neighbors: Any
    slot: Any
    a: Any
    b: Any
    cell_start: Any
    columns: Any
    rows: Any
    closed: Any
    noise: Any
    cell_px: int
    num_views: int
    num_slots: int


class StorePointers(NamedTuple):
    """The arrays of :class:`Store` as pointers; ``row``: views that a patch has room for."""

    xyz: Any
    normal: Any
    score: Any
    sigma: Any
    size: Any
    views: Any
    num_views: Any
    wave: Any
    row: int


@numba.njit(cache=True, nogil=True)
def image_pointers(images: Images) -> ImagePointers:
    """Pointers to the arrays of images, which the caller keeps alive."""
    return ImagePointers(
        pointer(images.quads), pointer(images.start), pointer(images.width), pointer(images.height),
        pointer(images.k), pointer(images.rotation), pointer(images.translation), pointer(images.center),
        pointer(images.neighbors), pointer(images.slot), pointer(images.a), pointer(images.b),
        pointer(images.cell_start), pointer(images.columns), pointer(images.rows), pointer(images.closed),
        pointer(images.noise), images.cell_px[0], images.neighbors.shape[0], images.neighbors.shape[1],
    )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def store_pointers(store: Store) -> StorePointers:
    """Pointers to the arrays of a store, which the caller keeps alive."""
    return StorePointers(
        pointer(store.xyz), pointer(store.normal), pointer(store.score), pointer(store.sigma), pointer(store.size),
        pointer(store.views), pointer(store.num_views), pointer(store.wave), store.views.shape[1],
    )  # fmt: skip


class CellPointers(NamedTuple):
    """The arrays of :class:`Cells` as pointers: layer l of cell g is ``patch[LAYERS * g + l]``."""

    patch: Any
    tried: Any


@numba.njit(cache=True, nogil=True)
def cell_pointers(cells: Cells) -> CellPointers:
    """Pointers to the arrays of cells, which the caller keeps alive."""
    return CellPointers(pointer(cells.patch), pointer(cells.tried))


@numba.njit(cache=True, nogil=True)
def copy_patch(store: Store, source: int, target: int) -> None:
    """Enter a patch of a store at another position of it as well."""
    store.xyz[target], store.normal[target] = store.xyz[source], store.normal[source]
    store.score[target], store.sigma[target] = store.score[source], store.sigma[source]
    store.size[target], store.views[target] = store.size[source], store.views[source]
    store.num_views[target], store.wave[target] = store.num_views[source], store.wave[source]
