"""Clusters of views to patches: one after the other on all threads of this process, or each by another worker."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sfmapp.dense import outcome
from sfmapp.dense.clusters import Cluster, in_core
from sfmapp.dense.densify import densify
from sfmapp.dense.files import read_patches, write_patches
from sfmapp.dense.options import FEWEST_VIEWS, DenseOptions
from sfmapp.dense.prepare import DensePlan, load_scene, part_of
from sfmapp.dense.report import DensifyReport
from sfmapp.dense.scene import Patches
from sfmapp.events import Events
from sfmapp.pipelines.dense.results import STAGE, PartReport
from sfmapp.stereo.patches import densify_pair

if TYPE_CHECKING:
    from sfmapp.pipelines.dense.source import DenseJob


def densify_clusters(
    job: DenseJob, plan: DensePlan, clusters: Sequence[Cluster], wanted: Sequence[int]
) -> Iterator[tuple[int, Patches, PartReport]]:
    """Patches of clusters, the images counted as in the plan, as they are done: number, patches and report of each."""
    address = job.options.cluster
    is_whole = len(clusters) == 1
    if address is None or is_whole or not wanted:
        make = densify_pair if is_whole and len(plan.records) == FEWEST_VIEWS else densify
        for number in wanted:
            part = plan if is_whole else part_of(plan, clusters[number].views, clusters[number].core)
            options, threads, events = job.options.dense, job.threads, job.events
            patches, row = _densify(part, clusters[number], options, threads=threads, events=events, make=make)
            # all of one cluster are of its core: hundreds of megabytes that need no copy
            yield number, patches if is_whole else in_core(patches, clusters[number]), row
        return
    from sfmapp.cluster.dask_executor import open_cluster

    job.events.started(STAGE, f"patches of {len(wanted)} clusters", total=len(wanted))
    paths = sorted({record.path.parent for record in plan.records})
    with open_cluster(address, job.workspace.folder, paths, job.events) as executor:
        assert executor.folder is not None
        chosen = [clusters[number] for number in wanted]
        parts = [part_of(plan, cluster.views, cluster.core) for cluster in chosen]
        units = list(zip(wanted, parts, chosen, strict=True))
        with closing(executor.run(partial(_densify_into, executor.folder, job.options.dense), units)) as rows:
            for n, row in rows:
                path = executor.folder / f"{wanted[n]}.npz"
                patches, _ = read_patches(path)
                path.unlink()
                yield wanted[n], in_core(patches, clusters[wanted[n]]), row
                job.events.advanced(STAGE)
    job.events.finished(STAGE, f"patches of {len(wanted)} clusters")


def _densify_into(folder: Path, options: DenseOptions, unit: tuple[int, DensePlan, Cluster]) -> PartReport:
    """Patches of a cluster into a file, by a worker."""
    number, part, cluster = unit
    patches, row = _densify(part, cluster, options, threads=1, events=Events())
    write_patches(folder / f"{number}.npz", patches, part.names)
    return row


def _densify(
    part: DensePlan,
    cluster: Cluster,
    options: DenseOptions,
    *,
    threads: int,
    events: Events,
    make: Callable[..., tuple[Patches, DensifyReport]] = densify,
) -> tuple[Patches, PartReport]:
    """Patches of a cluster, the images counted as in ``part``, and what is told of it."""
    scene = load_scene(part, threads=threads, events=events)
    texture = [outcome.textured_pixels(scene.views[at]) for at in np.searchsorted(cluster.views, cluster.core)]
    patches, row = make(scene, options, threads=threads, events=events)
    return patches, PartReport(**row, texture=texture, num_points=len(scene.point_xyz))
