"""What photographs of an object see of it, by their colours alone: swept depth maps that confirm each other."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from sfmapp.carve.plane_sweep import SweptDepth, SweptPlanes, measured, sweep_planes
from sfmapp.carve.sight import Sight, sight_of_map
from sfmapp.carve.sweep_agreement import confirm
from sfmapp.carve.sweep_exchange import exchange_planes
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.dense.selection import select_neighbors
from sfmapp.errors import NoReconstructionError
from sfmapp.events import Events
from sfmapp.reporting import Report

Array = NDArray[np.float64]

STAGE = "sights"
# photographs whose maps are held against each one's
_NEIGHBORS = 8
# places that tell from where to where planes are swept
_PLACES = 64
_NO_POINTS = np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32)


class SightsReport(Report):
    """What colours told.

    Attributes:
        num_maps: photographs that see something, of ``num_views``.
        known_share: of the pixels that show the object, those whose depth others confirm.
    """

    num_views: int
    num_maps: int
    known_share: float


def sights_by_colors(
    views: Sequence[DenseView], around: Array, events: Events | None = None, *, threads: int = 1
) -> tuple[list[Sight], SightsReport]:
    """Sweep planes through what each view shows, and keep what another one confirms and no more of them see through.

    Args:
        views: with masks, without distortion.
        around: (N, 3) places on a surface that holds the object, world: planes are swept from before the nearest of
            them to behind the farthest.
        events: progress and cancellation.
        threads: views at a time; the result does not depend on it.

    Raises:
        NoReconstructionError: no view has a depth that another one confirms.
        InterruptedRunError: ``events`` was asked to stop.
    """
    events = events or Events()
    poses, num = np.array([view.cam_from_world for view in views]).reshape(-1, 7), len(views)
    neighbors, _ = select_neighbors(np.array([view.k[0] for view in views]), poses, *_NO_POINTS, _NEIGHBORS)
    places = around[:: max(1, len(around) // _PLACES)]
    seen_by = np.tile(np.arange(num, dtype=np.int32), len(places))
    scene = DenseScene(tuple(views), neighbors, places, num * np.arange(len(places) + 1), seen_by)
    # swept, then held against each other
    events.started(STAGE, f"planes through {num} photographs", total=2 * num)

    def sweep(v: int) -> SweptPlanes | None:
        events.raise_if_cancelled()
        try:
            found: SweptPlanes | None = sweep_planes(scene, v)
        except NoReconstructionError:
            found = None
        return found

    with ThreadPoolExecutor(threads) as pool:
        swept = {}
        for v, found in enumerate(pool.map(sweep, range(num))):
            if found is not None:
                swept[v] = found
            events.advanced(STAGE)

        def measure(v: int) -> SweptDepth | None:
            events.raise_if_cancelled()
            return measured(scene, v, exchange_planes(scene, v, swept)) if v in swept else None

        maps: list[SweptDepth | None] = []
        for depth in pool.map(measure, range(num)):
            maps.append(depth)
            events.advanced(STAGE)
        kept = list(pool.map(lambda v: _confirmed(scene, maps, v), range(num)))
    sights = [
        sight_of_map(views[v].k, views[v].cam_from_world, told) for v, told in enumerate(kept) if told is not None
    ]
    if not sights:
        raise NoReconstructionError(
            f"no depth of {num} photographs is confirmed by another one",
            "where surfaces have no texture, or photographs stand far apart, carve by silhouettes alone",
        )
    shown = sum(view.width * view.height if view.mask is None else int(view.mask.sum()) for view in views)
    known = sum(int(np.isfinite(sight.depth).sum()) for sight in sights)
    report = SightsReport(num_views=num, num_maps=len(sights), known_share=known / max(shown, 1))
    events.finished(STAGE, f"{len(sights)} photographs see {report.known_share:.0%} of what they show", **report)
    return sights, report


def _confirmed(scene: DenseScene, maps: Sequence[SweptDepth | None], v: int) -> NDArray[np.float32] | None:
    """The depth map of a view, NaN where none confirms it or more see through it; None if nothing is left."""
    own = maps[v]
    if own is None:
        return None
    others = [(scene.views[m], swept) for m in scene.neighbors[v] if m >= 0 and (swept := maps[m]) is not None]
    agree, against = confirm(scene.views[v], own, others)
    kept = (agree > 0) & (agree >= against) & np.isfinite(own.depth)
    return np.where(kept, own.depth, np.float32(np.nan)) if kept.any() else None
