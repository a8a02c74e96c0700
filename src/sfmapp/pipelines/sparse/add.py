"""More photographs into a finished reconstruction.

All is written beside, in ``OUT/.adding``, and takes its place at the end: the earlier state is whole until the new one
is.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError, UsageError
from sfmapp.events import Events
from sfmapp.formats.colmap import read_model
from sfmapp.formats.database import Database
from sfmapp.georeference.sources import with_positions
from sfmapp.georeference.world_frame import GEOREFERENCE
from sfmapp.images.folder import load_found
from sfmapp.images.image_set import ImageSet
from sfmapp.images.load import load_images, name_of
from sfmapp.images.report import ImagesReport
from sfmapp.images.sources import Found
from sfmapp.mapping.closing_move import closing_move
from sfmapp.mapping.report import Uncertainty
from sfmapp.pipelines.sparse.finished import (
    DATABASE,
    check_finished,
    models_of,
    names_in_database,
    read_report,
    uncertainty_of,
)
from sfmapp.pipelines.sparse.keys import StageKeys, stage_keys
from sfmapp.pipelines.sparse.photographs import PHOTOGRAPHS, as_before, link_photographs, with_new
from sfmapp.pipelines.sparse.reconstruct import RunResult, check_enough, map_and_report
from sfmapp.pipelines.sparse.run import Before, Run
from sfmapp.pipelines.sparse.videos import Sources, frames_and_photographs, sources_of
from sfmapp.pipelines.sparse.world import read_world
from sfmapp.report.model import AddedPhotograph, AddedReport, ReconstructionReport
from sfmapp.reporting import NamedReason
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.video.report import VideoReport
from sfmapp.viewer.listener import RecordingListener
from sfmapp.workspace.layout import MANIFEST, PAGE, RECONSTRUCT, REPORT
from sfmapp.workspace.manifest import Manifest, image_root, missing_photographs, read_manifest
from sfmapp.workspace.options import Options, flat_options, options_from_dict, with_absolute_paths
from sfmapp.workspace.usage import Stopwatch
from sfmapp.workspace.workspace import open_workspace

# Where the new state is made, in OUT, and what says in it that it is whole.
_BESIDE, _READY = ".adding", "ready"
# In the order in which they take the place of the old ones: the manifest last.
_RESULTS = (DATABASE, "sparse", "recording.rrd", GEOREFERENCE, "log.jsonl", PAGE, REPORT, MANIFEST)
# Options that decide no result, and may be others than at first.
_FREE = frozenset({"threads", "cluster", "min_registered", "features.memory_mb"})
_MATCHING = "matching"


@dataclass(frozen=True)
class _New:
    """Photographs that are to be added.

    Attributes:
        root: folder that the names of old and new ones are relative to. names: of the new ones.
        source: where these are from. known: (name, reason) of what was there already.
        videos: of what frames are chosen.
    """

    root: Path
    names: tuple[str, ...]
    source: str
    known: tuple[tuple[str, str], ...]
    videos: tuple[VideoReport, ...] = ()


def add_photographs(
    images: str | os.PathLike[str] | Sequence[str],
    output: str | os.PathLike[str],
    options: Options | None = None,
    *,
    events: Events | None = None,
    record: bool = True,
    watch: Stopwatch | None = None,
) -> RunResult:
    """Add photographs to a finished reconstruction.

    Features and matches of before are kept; new photographs are matched with each other and with the old ones as pairs
    are chosen for all of them. The models go on from where they were.

    Args:
        images: a folder, a glob pattern, a list or a video, or several of these. What is there already, by its bytes or
            its name, is told.
        output: of the reconstruction, whose options are used.
        options: None, or such as do not contradict those of the reconstruction.
        events, record, watch: as of :func:`sfmapp.pipelines.sparse.reconstruct.reconstruct`.

    Raises:
        UsageError: options that differ from those of the reconstruction.
        InputError: there is no finished reconstruction, photographs of it are gone or have changed, or there is none to
            add.
        TooFewImagesError: fewer images than ``options.min_registered``; everything is written.
        InterruptedRunError: a stop was asked for; the reconstruction is as it was, and the same call goes on.
    """
    folder, events, watch = Path(output), events or Events(), watch or Stopwatch()
    read_manifest(folder, RECONSTRUCT)
    with open_workspace(folder, RECONSTRUCT):
        _put_in_place(folder)
        manifest = read_manifest(folder, RECONSTRUCT)
        first = options_from_dict(manifest.options)
        check_finished(folder, manifest)
        if options is not None:
            _check_options(with_absolute_paths(options), first)
            first = replace(
                first, threads=options.threads, cluster=options.cluster, min_registered=options.min_registered
            )
        old_names = names_in_database(folder)
        new = _new_photographs(images, folder, manifest, old_names, first, events)
        for name, reason in new.known:
            events.warned("images", f"{name}: {reason}")
        if not new.names:
            return _nothing_new(folder, watch)
        recorder = RecordingListener() if record else None
        with Run.opened(
            RECONSTRUCT, manifest.source, folder / _BESIDE, first, events=events, watch=watch, recorder=recorder,
            images=images,
        ) as run:  # fmt: skip
            run.listen(recorder)
            report = _run(run, folder, manifest, new, old_names)
        (folder / _BESIDE / _READY).touch()
        _put_in_place(folder)
    check_enough(report, first, folder)
    model, _ = read_model(folder / "sparse" / "0")
    return RunResult(model, report)


def _run(
    run: Run, folder: Path, manifest: Manifest, new: _New, old_names: Sequence[str]
) -> ReconstructionReport:  # fmt: skip
    """The job, in its own workspace."""
    before, uncertainty = models_of(folder), uncertainty_of(folder)
    with run.stage("images"):
        image_set, images, of_before = _all_photographs(run, folder, manifest, new, old_names)
        run.image_set = with_positions(image_set, run.options.gps)
        run.stages = replace(run.stages, images=images, videos=new.videos or None)
    keys = read_world(run, run.image_set)
    database = run.workspace.database
    if not database.is_file():
        beside = database.with_suffix(".copy")
        shutil.copyfile(folder / DATABASE, beside)
        beside.replace(database)
    num_old = len(old_names)
    known = _with_new_key(database, manifest, stage_keys(run.options, of_before), keys)
    if not len(known):
        run.events.warned(_MATCHING, "matches of before are of another version of sfmapp: they are made again")
    is_between_old = (known < num_old).all(axis=1) if len(known) else np.zeros(0, bool)
    run.before = Before(num_old, known[is_between_old].astype(np.int32).reshape(-1, 2), before)
    registered = {name for model in before for name in (model.image_names[i] for i in model.registered_idx)}
    run.added = lambda models: _added(run, new, before[0], registered, uncertainty, models)
    # what was made of the model before says itself that it is of another one
    kept = {name: stage for name, stage in manifest.stages.items() if name not in run.workspace.manifest.stages}
    run.workspace.note(stages={**kept, **run.workspace.manifest.stages})
    run.workspace.note(image_root=os.fspath(new.root), added=[*(manifest.added or ()), new.source])
    run.note_inputs(keys.inputs)
    return map_and_report(run, run.image_set, keys)


# ------------------------------------------------------------------------------------------------------ what is there


def _check_options(given: Options, first: Options) -> None:
    """Raises UsageError if options were asked for that differ from those of the first run."""
    told, known, plain = (flat_options(one) for one in (given, first, Options()))
    others = [
        f"{name} = {told[name]} (it was made with {known.get(name)})"
        for name in told
        if told[name] != plain.get(name) and told[name] != known.get(name) and name not in _FREE
    ]
    if others:
        raise UsageError(
            f"options that differ from those of the reconstruction: {'; '.join(others)}",
            "nothing was touched; leave them out, or reconstruct all photographs into another OUT",
        )


def _nothing_new(folder: Path, watch: Stopwatch) -> RunResult:
    """What there is, where all photographs are there already."""
    report = read_report(folder)
    if report is None:
        raise InputError(f"{folder}: expected its report.json, found none", "run sfmapp reconstruct again")
    model, _ = read_model(folder / "sparse" / "0")
    return RunResult(model, replace(report, run=replace(report.run, is_up_to_date=True, **watch.read())))


# -------------------------------------------------------------------------------------------------------- photographs


def _new_photographs(
    images: str | os.PathLike[str] | Sequence[str], folder: Path, manifest: Manifest, old_names: Sequence[str],
    options: Options, events: Events,
) -> _New:  # fmt: skip
    """Which of some photographs are new, under which names, and the folder that has all of them."""
    root = image_root(manifest)
    if root is None:
        raise missing_photographs(folder, manifest)
    given, videos = _given(images, folder, old_names, options, events)
    if not given.images:
        raise InputError(f"{name_of(images)}: no usable photograph to add", "-v names the files and what is wrong")
    of_digest = {digest.split("+")[0]: name for name, digest in manifest.inputs.items()}
    taken, known = set(old_names), list[tuple[str, str]]()
    inside, outside = dict[str, Path](), dict[str, Path]()
    for record in given.images:
        is_inside = record.path.is_relative_to(root)
        name = record.path.relative_to(root).as_posix() if is_inside else record.name
        if record.digest in of_digest:
            same = of_digest[record.digest]
            known.append((name, "is there already" if same == name else f"is there already, as {same}"))
        elif name in taken:
            known.append((name, "another photograph of that name is there already: rename this one to add it"))
        else:
            (inside if is_inside else outside)[name] = record.path
            taken.add(name)
            of_digest[record.digest] = name
    if outside:
        links = (folder / PHOTOGRAPHS).absolute()
        link_photographs(links, {name: root / name for name in (*old_names, *inside)} if links != root else {})
        link_photographs(links, outside)
        root = links
    return _New(root, (*inside, *outside), os.path.abspath(name_of(images)), tuple(known), tuple(videos))


def _given(
    images: str | os.PathLike[str] | Sequence[str], folder: Path, old_names: Sequence[str], options: Options,
    events: Events,
) -> tuple[ImageSet, list[VideoReport]]:  # fmt: skip
    """What is to be added, and what was chosen of the videos in it."""
    unmasked, sources = replace(options.images, mask_path=None), sources_of(images)
    if not isinstance(sources, Sources):
        return load_images(sources, unmasked, events, threads=options.num_workers)[0], []
    taken = {name.split("/")[0] for name in old_names}
    found, videos = frames_and_photographs(sources, folder, options, events, taken)
    return load_found(name_of(images), found, unmasked, events, options.num_workers)[0], videos


def _all_photographs(
    run: Run, folder: Path, manifest: Manifest, new: _New, old_names: Sequence[str]
) -> tuple[ImageSet, ImagesReport, ImageSet]:
    """Old photographs in the order of the database, then new ones; and the old ones alone."""
    paths = [new.root / name for name in (*old_names, *new.names)]
    found, report = load_found(
        new.source, Found(new.root, paths), run.options.images, run.events, run.threads
    )  # fmt: skip
    records = {record.name: record for record in found.images}
    digests = {name: digest.split("+")[0] for name, digest in manifest.inputs.items()}
    for name in old_names:
        record = records.get(name)
        if record is None or record.digest != digests.get(name, record.digest):
            what = "is gone" if record is None else "has changed"
            raise InputError(
                f"{new.root / name}: expected a photograph of the reconstruction as it was, which {what}",
                "bring it back, or reconstruct anew into another OUT",
            )
    own = [records[name] for name in old_names]
    before = as_before(folder / DATABASE, old_names, own, found.cameras)
    added = [records[name] for name in new.names if name in records]
    union = with_new(
        before, [record.camera_idx for record in own], [(one, found.cameras[one.camera_idx]) for one in added]
    )  # fmt: skip
    return replace(union, skipped=found.skipped, root=new.root), report, before


def _with_new_key(
    database: Path, manifest: Manifest, of_before: StageKeys, keys: StageKeys
) -> NDArray[np.int64]:  # fmt: skip
    """Keep matches of before, and of an interrupted call, as those of all photographs; pairs (P, 2) of the former."""
    earlier = manifest.stage(_MATCHING).key
    if earlier != of_before.matching:
        return np.zeros((0, 2), np.int64)
    with Database(database) as store:
        held = np.array(
            sorted(pair for pair, key in store.pair_keys().items() if key in (earlier, keys.matching)), np.int32
        ).reshape(-1, 2)
        store.write_pairs(store.read_pairs(held), keys.matching)
    return held.astype(np.int64)


# ------------------------------------------------------------------------------------------------------------ the end


def _added(
    run: Run, new: _New, before: Reconstruction, registered: set[str], uncertainty: Uncertainty,
    models: Sequence[Reconstruction],
) -> AddedReport:  # fmt: skip
    """What became of the new photographs, and of those that were left over before."""
    assert run.image_set is not None
    assert run.before is not None
    mapped = {row.name: row for row in run.stages.mapping.images} if run.stages.mapping is not None else {}
    rows = [
        AddedPhotograph(name=name, model=mapped[name].model, reason=mapped[name].reason)
        for name in run.image_set.names[run.before.num_images :]
        if name in mapped
    ]
    linked = [
        name
        for name in run.image_set.names[: run.before.num_images]
        if name not in registered and name in mapped and mapped[name].model is not None
    ]
    moved = None
    if models:
        there = {name: k for k, name in enumerate(models[0].image_names)}
        at = [there[name] for name in before.image_names]
        after = replace(before, cam_from_world=models[0].cam_from_world[at])
        moved = closing_move(before, after).in_sigmas(uncertainty)
    matched = run.stages.matching
    return AddedReport(
        source=new.source, photographs=rows,
        known=[NamedReason(name=name, reason=reason) for name, reason in new.known], linked=linked,
        num_pairs=matched.num_pairs if matched is not None else 0,
        num_known_pairs=len(run.before.pairs), moved_sigmas=moved,
    )  # fmt: skip


def _put_in_place(folder: Path) -> None:
    """Let what was made beside take its place, if it is whole; goes on where that was cut off."""
    beside = folder / _BESIDE
    if not (beside / _READY).is_file():
        return
    for name in _RESULTS:
        made, old = beside / name, folder / name
        if made.is_dir():
            if old.is_dir():
                old.replace(beside / f"{name}.before")
            made.replace(old)
        elif made.is_file():
            made.replace(old)
        elif name not in (DATABASE, "sparse", MANIFEST):
            old.unlink(missing_ok=True)
    (beside / _READY).unlink()
    shutil.rmtree(beside)
