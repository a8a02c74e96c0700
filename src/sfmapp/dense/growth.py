"""One level of the pyramid under way: its patches, its cells, and the steps that add patches and take them away."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense import filters, layers, seeds
from sfmapp.dense.arrays import LAYERS, Cells, Images, Limits, Store
from sfmapp.dense.expand import CANDIDATES, enter, frontier, retry, try_cells
from sfmapp.dense.options import FEWEST_VIEWS
from sfmapp.dense.report import WaveReport
from sfmapp.dense.settle import settle
from sfmapp.dense.window import make_scratch
from sfmapp.events import Events

# cells of a batch that one thread works on at least: below, handing them over costs more than the work
SMALLEST_CHUNK = 64
CHUNKS_PER_THREAD = 4
# share of the depths of a view at either end that may be wrong, how many it takes to tell, and how far beyond the
# others corners are looked for
OUTSIDE, LEAST_DEPTHS, MARGIN = 0.002, 20, 2.0


def inverse_depth_range(depth: NDArray[np.float64], otherwise: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2,) smallest and largest inverse depth to search in a view where such depths (N,) are known."""
    depth = depth[depth > 0.0]
    if len(depth) < LEAST_DEPTHS:
        return otherwise
    near, far = np.quantile(depth, [OUTSIDE, 1.0 - OUTSIDE])
    return np.array([1.0 / (MARGIN * far), MARGIN / near])


# neighbours in which a corner is looked for, on the coarsest level and where that left gaps
SEARCHED_EVERYWHERE, SEARCHED_IN_GAPS = 4, 2


class Filtered(NamedTuple):
    """Patches that the filters took away."""

    contradicted: int
    without_neighbours: int
    in_small_groups: int


class Growth:
    """Patches of one level."""

    def __init__(self, images: Images, limits: Limits, threads: int, first_wave: int = 0) -> None:
        self.images, self.limits = images, limits
        self.wave = first_wave
        self.count = 0
        self.waves: list[WaveReport] = []
        num_cells = len(images.closed)
        self.cells = Cells(np.full((num_cells, LAYERS), -1, np.int32), np.zeros(num_cells, np.uint8))
        self.num_neighbors = images.neighbors.shape[1]
        self.store = Store.of_capacity(max(num_cells // 2, 1024), self.num_neighbors)
        self.num_views = len(images.width)
        most = int((images.columns.astype(np.int64) * images.rows).max())
        self._places = np.zeros((most, 2), np.int32)
        self._candidates = np.full((most, CANDIDATES), -1, np.int32)
        self._found = Store.of_capacity(1024, self.num_neighbors)
        self._fresh = np.zeros((self.num_views, max(most // 4, 256)), np.int32)
        self._num_fresh = np.full(self.num_views, -1, np.int64)
        self._threads = threads
        self._pool = ThreadPoolExecutor(threads)
        self._work = [make_scratch() for _ in range(threads * CHUNKS_PER_THREAD)]

    def close(self) -> None:
        """Let go of the threads, the patches, their cells and all that was needed to find them."""
        self._pool.shutdown()
        self._places = self._candidates = self._fresh = np.zeros((0, 0), np.int32)
        self.store = self._found = Store.of_capacity(0, self.num_neighbors)
        self.cells = Cells(np.zeros((0, LAYERS), np.int32), np.zeros(0, np.uint8))

    # ------------------------------------------------------------------------------------------------------------ seeds

    def seed_points(self, points: Store) -> int:
        """Patches at sparse points, each in its reference image; how many."""
        before = self.count
        reference = points.views[:, 0]
        for m in range(self.num_views):
            mine = np.flatnonzero(reference == m)
            if not len(mine):
                continue
            seen = points.xyz[mine].astype(np.float64) @ self.images.rotation[m].T + self.images.translation[m]
            focal, middle = self.images.k[m, :2], self.images.k[m, 2:]
            # points that are not in front of the camera land outside of any image
            places = np.where(seen[:, 2:] > 0.0, seen[:, :2] / np.maximum(seen[:, 2:], 1e-9) * focal + middle, -1e6)
            subset = points.taken(mine)
            self._batch(m, np.rint(places.clip(-1e6, 1e6)).astype(np.int32), seeds.try_points, subset)
        return self.count - before

    def seed_corners(
        self, corners: list[NDArray[np.int32]], depth_range: NDArray[np.float64], *, everywhere: bool
    ) -> int:
        """Match corners of each view (N, 2) whose cells are empty, or hold what does not explain them.

        ``everywhere``: not just with other corners.
        """
        images, before = self.images, self.count
        has_corner = np.full(len(images.closed), everywhere)
        cell_of = []
        for m, xy in enumerate(corners):
            cell = (xy // images.cell_px[0]).astype(np.int64)
            cell = np.minimum(cell, [images.columns[m] - 1, images.rows[m] - 1])
            cell_of.append(images.cell_start[m] + cell[:, 1] * images.columns[m] + cell[:, 0])
            has_corner[cell_of[m]] = True
        search = seeds.CornerSearch(
            SEARCHED_EVERYWHERE if everywhere else SEARCHED_IN_GAPS, has_corner, depth_range
        )  # fmt: skip
        for m, xy in enumerate(corners):
            is_open = (self.cells.patch[cell_of[m], LAYERS - 1] < 0) & (images.closed[cell_of[m]] == 0)
            self._batch(m, xy[is_open], seeds.match_corners, self.store, self.cells, search)
        return self.count - before

    def depth_ranges(self, otherwise: NDArray[np.float64]) -> NDArray[np.float64]:
        """(V, 2) inverse depths to search, from the patches that each view shows."""
        ranges = otherwise.copy()
        ends = np.append(self.images.cell_start[1:], len(self.images.closed))
        for m in range(self.num_views):
            shown = self.cells.patch[self.images.cell_start[m] : ends[m], 0]
            shown = shown[shown >= 0]
            depth = (
                self.store.xyz[shown].astype(np.float64) @ self.images.rotation[m, 2] + self.images.translation[m, 2]
            )
            ranges[m] = inverse_depth_range(depth, otherwise[m])
        return ranges

    def refine_coarser(self, coarser: Growth, advanced: Callable[[], None]) -> int:
        """Carry the patches of the coarser level over, a cell at a time; how many. ``advanced``: after each view."""
        before = self.count
        for m in range(self.num_views):
            n = seeds.finer_cells(
                self.images, self.cells, m, coarser.images, coarser.cells, self._places, self._candidates
            )
            self._grow(m, n, coarser.store, -1)
            advanced()
        return self.count - before

    def expand_where_few_see(self, events: Events) -> int:
        """Grow patches that one image fewer trusts, where none of the others can see the place; how many.

        Last on a level: what hides a place from an image has to be known by then.
        """
        strict, before = self.limits, self.count
        if strict.min_views == FEWEST_VIEWS:
            return 0
        self.limits = strict._replace(min_views=strict.min_views - 1)
        retry(self.cells)
        self.expand(events, everywhere=True)
        self.limits = strict
        return self.count - before

    # ------------------------------------------------------------------------------------------------------------ waves

    def expand(self, events: Events, *, everywhere: bool) -> int:
        """Waves until none finds anything; how many patches they added.

        ``everywhere``: the first wave looks at all cells, not just at those beside patches of which no wave knows yet.
        """
        before = self.count
        is_first = everywhere
        while True:
            self.wave += 1
            tried, start = 0, self.count
            for m in range(self.num_views):
                n = self._frontier(m, everywhere=is_first)
                tried += n
                self._grow(m, n, self.store, self.wave)
            if tried:
                self.waves.append(WaveReport(wave=self.wave, tried=tried, accepted=self.count - start))
            events.raise_if_cancelled()
            if self.count == start:
                return self.count - before
            is_first = False

    def _frontier(self, m: int, *, everywhere: bool) -> int:
        num_fresh = -1 if everywhere else int(self._num_fresh[m])
        n = frontier(self.images, self.store, self.cells, m, self._fresh[m], num_fresh, self._places, self._candidates)
        self._num_fresh[m] = 0
        return int(n)

    def _grow(self, m: int, n: int, parents: Store, wave: int) -> None:
        """Try the cells that wait in ``_places`` with the candidates beside them."""
        self._reserve(n)
        places, candidates = self._places, self._candidates

        def work(first: int, last: int, number: int) -> None:
            try_cells(
                self.images, parents, self.store, self.cells, m, places, candidates, (first, last), self.limits,
                wave, self._work[number], self._found,
            )  # fmt: skip

        self._in_chunks(n, work)
        self._enter(n)

    def _batch(self, m: int, places: NDArray[np.int32], kernel: Callable[..., None], *arguments: object) -> None:
        """Run a kernel of seeds over pixels of one view."""
        n = len(places)
        spare = n + np.arange(len(self._work))
        self._reserve(n + len(self._work))
        places = np.ascontiguousarray(places, np.int32)

        def work(first: int, last: int, number: int) -> None:
            more = (spare[number],) if kernel is seeds.match_corners else ()
            kernel(
                self.images, m, places, *arguments, (first, last), self.limits, self._work[number], self._found, *more
            )  # fmt: skip

        self._in_chunks(n, work)
        self._enter(n)

    def _in_chunks(self, n: int, work: Callable[[int, int, int], None]) -> None:
        """Share the range 0 to n among the threads; what is made does not depend on where it is cut."""
        if n == 0:
            return
        num_chunks = min(len(self._work), max(n // SMALLEST_CHUNK, 1)) if self._threads > 1 else 1
        cuts = np.linspace(0, n, num_chunks + 1).astype(np.int64)
        if num_chunks == 1:
            work(0, n, 0)
        else:
            list(self._pool.map(work, cuts[:-1], cuts[1:], range(num_chunks)))

    def _reserve(self, n: int) -> None:
        if len(self._found.score) < n:
            self._found = Store.of_capacity(n + n // 4, self.num_neighbors)
        if len(self.store.score) < self.count + n:
            self.store = self.store.grown(self.count + n + self.count // 2)

    def _enter(self, n: int) -> None:
        self.count = enter(
            self.images, self.store, self.cells, self.count, self._found, n, self._fresh, self._num_fresh
        )

    # ---------------------------------------------------------------------------------------------------------- filters

    def filter(self) -> Filtered:
        """Take away what other images contradict, what stands alone and what hangs together in too small groups."""
        self._refill()
        self._resolve_layers()
        least = max(self.limits.min_views - 1, FEWEST_VIEWS)
        keep = np.zeros(self.count, np.uint8)

        def work(first: int, last: int, _: int) -> None:
            filters.judge_patches(self.images, self.store, self.cells, least, first, last, keep)

        self._in_chunks(self.count, work)
        contradicted, alone = int((keep == 1).sum()), int((keep == 2).sum())
        self._compact(keep == 0)
        sizes = filters.group_sizes(self.images, self.store, self.cells, self.count, self.limits.min_views)
        is_surface = sizes >= filters.SMALLEST_GROUP
        del sizes
        self._compact(is_surface)
        in_small_groups = int((~is_surface).sum())
        return Filtered(contradicted, alone, in_small_groups)

    def _resolve_layers(self) -> None:
        """Where an image trusts two patches in one cell, let it decide between them."""
        ends = np.append(self.images.cell_start[1:], len(self.images.closed))
        for m in range(self.num_views):
            start = self.images.cell_start[m]
            cell_idx = start + np.flatnonzero(self.cells.patch[start : ends[m], LAYERS - 1] >= 0)
            loser = np.full(len(cell_idx), -1, np.int32)
            self._in_chunks(len(cell_idx), self._weigher(m, cell_idx, loser))
            layers.take_trust(self.store, self.cells, m, cell_idx, loser)

    def _weigher(
        self, m: int, cell_idx: NDArray[np.int64], loser: NDArray[np.int32]
    ) -> Callable[[int, int, int], None]:
        def work(first: int, last: int, number: int) -> None:
            layers.weigh_layers(
                self.images, self.store, self.cells, m, cell_idx, first, last, self._work[number], loser
            )  # fmt: skip

        return work

    def settle(self) -> None:
        """Let each patch settle on the plane of its neighbours."""
        n, store = self.count, self.store
        xyz, normal, sigma = store.xyz[:n].copy(), store.normal[:n].copy(), store.sigma[:n].copy()

        def work(first: int, last: int, _: int) -> None:
            settle(self.images, store, self.cells, first, last, xyz, normal, sigma)

        self._in_chunks(n, work)
        store.xyz[:n], store.normal[:n], store.sigma[:n] = xyz, normal, sigma

    def _refill(self) -> None:
        n = self.count
        quality = self.store.score[:n] * self.store.num_views[:n]
        order = np.argsort(-quality, kind="stable")
        self._num_fresh[:] = -1
        filters.refill(self.images, self.store, self.cells, order, self._fresh, self._num_fresh)

    def _compact(self, kept: NDArray[np.bool_]) -> None:
        filters.renumber(self.cells, filters.compact(self.store, kept))
        self.count = int(kept.sum())
