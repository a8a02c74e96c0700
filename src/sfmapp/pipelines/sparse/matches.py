"""From photographs to verified matches, with what an earlier run has stored of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sfmapp.errors import UsageError
from sfmapp.executor import Executor
from sfmapp.features.extract import extract_features
from sfmapp.matching.pairs import select_pairs
from sfmapp.matching.stage import match_images
from sfmapp.workspace.kernels import MODULES, kernels_compiling
from sfmapp.workspace.store import Store

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet
    from sfmapp.pipelines.sparse.keys import StageKeys
    from sfmapp.pipelines.sparse.run import Run
    from sfmapp.scene.correspondences import Correspondences


def find_matches(run: Run, image_set: ImageSet, keys: StageKeys, modules: tuple[str, ...] = MODULES) -> Correspondences:
    """Features, pairs and matches of photographs, which are put into the run and its database.

    Where photographs are added to others, only pairs with one of them are looked for beside those that there are.

    Args:
        modules: whose kernels the run will need, compiled meanwhile.
    """
    options, events, threads = run.options, run.events, run.threads
    feature_keys = [keys.of_features(record.name) for record in image_set.images]
    with (
        kernels_compiling(events, run.usage, modules),
        Store(run.workspace.database, image_set, feature_keys, keys.matching) as store,
        work_executor(run, image_set) as executor,
    ):
        with run.stage("features", keys.features):
            run.features, extracted = extract_features(
                image_set, options.features, threads=threads, events=events,
                known=store.known_features(), store=store.put_features, executor=executor,
            )  # fmt: skip
            run.stages = replace(run.stages, features=extracted)
        with run.stage("pairs", keys.pairs):
            pairs, selected = select_pairs(
                image_set, run.features, options.pairs, seed=options.seed, threads=threads, events=events
            )
            if run.before is not None and len(run.before.pairs):
                new = pairs[(pairs >= run.before.num_images).any(axis=1)]
                pairs = np.unique(np.concatenate([run.before.pairs, new]), axis=0)
            run.stages = replace(run.stages, pairs=selected)
        with run.stage("matching", keys.matching):
            run.correspondences, matched = match_images(
                image_set, run.features, pairs, options.matching, seed=options.seed, threads=threads, events=events,
                known=store.known_pairs(pairs), on_pair=store.put_pair, executor=executor,
            )  # fmt: skip
            store.flush()
            run.stages = replace(run.stages, matching=matched)
    return run.correspondences


@contextmanager
def work_executor(run: Run, image_set: ImageSet) -> Iterator[Executor | None]:
    """The workers of a cluster that do the units of a run; None: threads of this process do."""
    address = run.options.cluster
    if address is None:
        yield None
        return
    if any(record.source is not None for record in image_set.images):
        raise UsageError(
            "photographs in memory cannot be given to a cluster", "write them to a folder that its workers see"
        )
    from sfmapp.cluster.dask_executor import open_cluster

    paths = {record.path.parent for record in image_set.images} | {
        record.mask_path.parent for record in image_set.images if record.mask_path is not None
    }
    with open_cluster(address, run.workspace.folder, sorted(paths), run.events) as executor:
        yield executor
