"""Photographs to a sparse model: the main job, on a page.

:func:`reconstruct` opens the workspace and sees to it that every end is a clean one; :func:`_run` is the job.
"""

from __future__ import annotations

import os
from contextlib import nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from sfmapp.adjust.solver import import_ahead
from sfmapp.errors import NoReconstructionError, TooFewImagesError, UsageError
from sfmapp.events import Events
from sfmapp.executor import Threads
from sfmapp.formats.colmap import read_model
from sfmapp.georeference.sources import with_positions
from sfmapp.images.load import GivenImages, name_of
from sfmapp.pipelines.sparse import results
from sfmapp.pipelines.sparse.keys import StageKeys
from sfmapp.pipelines.sparse.matches import find_matches, work_executor
from sfmapp.pipelines.sparse.run import Run
from sfmapp.pipelines.sparse.videos import load_sources
from sfmapp.pipelines.sparse.world import closing, has_factors, held_poses, read_world
from sfmapp.viewer.listener import RecordingListener
from sfmapp.viewer.recording import Drawer
from sfmapp.workspace.layout import RECONSTRUCT
from sfmapp.workspace.options import Options
from sfmapp.workspace.usage import Stopwatch

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet
    from sfmapp.report.model import ReconstructionReport
    from sfmapp.scene.reconstruction import Reconstruction

# So many photographs are mapped in seconds, of which loading rerun beside it saves half a one. The child of a larger
# set would hold a hundred megabytes for nothing.
_SOON_MAPPED = 200
# Where the parts of large sets are kept until all is mapped.
PARTS = "parts"


class RunResult(NamedTuple):
    """The largest model, and the report of the run as in ``report.json``."""

    reconstruction: Reconstruction
    report: ReconstructionReport


def reconstruct(
    images: GivenImages,
    output: str | os.PathLike[str],
    options: Options | None = None,
    *,
    events: Events | None = None,
    record: bool = True,
    watch: Stopwatch | None = None,
) -> RunResult:
    """Reconstruct cameras and points from photographs.

    What an earlier run in the same output folder has done is used where it still holds.

    Args:
        images: a folder, a glob pattern, a ``.txt`` list of files, a video, or several of these; or arrays by name, an
            :class:`ImageSource`, an :class:`ImageSet`, whose pixels are not kept.
        output: folder of the results: new, empty, or of an earlier run.
        options: of all stages; see :func:`sfmapp.load_options`.
        events: listens in, and can ask the run to stop.
        record: write ``recording.rrd``, which replays the run.
        watch: started earlier, if more is to be counted in the report than this call.

    Returns:
        The largest model as it is read back from ``sparse/0`` (registered images, triangulated points), and the report.

    Raises:
        UsageError: the output folder holds something else, or another run is at work in it.
        InputError: the photographs do not exist or cannot be read.
        NoReconstructionError: they hold no reconstruction; the report is written.
        TooFewImagesError: fewer images than ``options.min_registered``; everything is written.
        InterruptedRunError: ``events`` was asked to stop; the same call resumes.
    """
    recorder = RecordingListener() if record else None
    with Drawer() as drawer, Run.opened(
        RECONSTRUCT, name_of(images), output, options, events=events, watch=watch, recorder=recorder, drawer=drawer,
        images=images,
    ) as run:  # fmt: skip
        run.listen(recorder)
        report = _run(run)
        model, _ = read_model(run.workspace.model())
    check_enough(report, run.options, output)
    return RunResult(model, report)


def check_enough(report: ReconstructionReport, options: Options, output: str | os.PathLike[str]) -> None:
    """Raise TooFewImagesError where fewer images are registered than were asked for."""
    found = report.models[0].num_registered
    if options.min_registered is not None and found < options.min_registered:
        raise TooFewImagesError(
            f"{found} images are registered, {options.min_registered} were asked for",
            f"{os.fspath(output)}/report.html tells for every image why",
        )


def _run(run: Run) -> ReconstructionReport:
    """The job: photographs, what still holds of an earlier run, models, and the report of it all."""
    with run.stage("images"):
        image_set, images = load_sources(run)
        run.image_set = with_positions(image_set, run.options.gps)
        run.stages = replace(run.stages, images=images)
    keys = read_world(run, run.image_set)
    if report := results.earlier_report(run, keys):
        return report
    if added := run.workspace.manifest.added:
        raise UsageError(
            f"{run.workspace.folder} holds a model that photographs were added to, those of {added[-1]} last",
            "nothing in it was touched; add others with --add, or reconstruct into another OUT",
        )
    run.workspace.note(image_root=os.fspath(run.image_set.root or ""))
    run.note_inputs(keys.inputs)
    return map_and_report(run, run.image_set, keys)


def map_and_report(run: Run, image_set: ImageSet, keys: StageKeys) -> ReconstructionReport:
    """From photographs to models and their report, all of it written."""
    try:
        models = _reconstruct(run, image_set, keys)
    except NoReconstructionError as failure:
        results.write_results(run, keys, [], failure)
        raise
    return results.write_results(run, keys, models)


def _reconstruct(run: Run, image_set: ImageSet, keys: StageKeys) -> list[Reconstruction]:
    """From photographs to models, the largest first."""
    options, events, threads = run.options, run.events, run.threads
    if len(image_set.images) < 2:
        raise _too_few_photographs(image_set)
    import_ahead(len(image_set.images), with_factors=has_factors(run, image_set))
    correspondences = find_matches(run, image_set, keys)
    # loaded by now, beside the features, with the kernels
    from sfmapp.mapping.divided import FEWEST, PartsWork
    from sfmapp.mapping.incremental import Ends, map_images
    from sfmapp.mapping.known_poses import map_known_poses
    from sfmapp.mapping.part_files import KeptParts

    if run.recorder is not None and run.drawer is not None and len(image_set.images) <= _SOON_MAPPED:
        run.drawer.get_ready()  # what goes wrong is told when it is to draw
    # all that follows knows pictures by keypoints and matches; descriptors are in the database
    run.features = [features.without_descriptors() for features in run.features]
    with run.stage("mapping"):
        given = (image_set, run.features, correspondences, options.mapping)
        if run.poses is not None and options.poses.fixed:
            models, mapped = map_known_poses(
                *given,
                adjust_options=options.adjust,
                threads=threads,
                events=events,
                poses=held_poses(run, run.poses, image_set),
            )
        else:
            start, is_apart = (run.before.models, run.before.is_apart) if run.before is not None else ([], False)
            kept = KeptParts(run.workspace.folder / PARTS, keys.mapping)
            # workers have nothing to do in a set that is mapped as a whole
            workers = work_executor(run, image_set) if len(image_set.images) >= FEWEST else nullcontext()
            with workers as executor:
                models, mapped = map_images(
                    *given, adjust_options=options.adjust, threads=threads, events=events,
                    ends=Ends(
                        start, is_apart, closing(run, image_set), PartsWork(executor or Threads(threads), kept)
                    ),
                )  # fmt: skip
            kept.remove()
        run.stages = replace(run.stages, mapping=mapped)
    if run.judge is not None:
        run.judge(models)
    return models


def _too_few_photographs(image_set: ImageSet) -> NoReconstructionError:
    images = image_set.images
    found = f"only one usable photograph, {images[0].name}" if images else "no usable photograph"
    skipped = f" ({len(image_set.skipped)} files could not be used)" if image_set.skipped else ""
    return NoReconstructionError(
        f"{found}{skipped}", "give at least two photographs of the same thing from different places"
    )
