"""What a reconstruction will take, and what will probably go wrong in it: the job, on a page.

Every photograph is looked at in small; pairs are chosen by the rule of the run, and compared in small; a few
photographs are worked on as the run does it; and what all that shows is scaled up to the whole.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sfmapp.errors import NoReconstructionError, UsageError
from sfmapp.events import Events
from sfmapp.georeference.sources import with_positions
from sfmapp.images.load import Images, load_images, name_of
from sfmapp.images.video import is_video
from sfmapp.matching.pairs import select_pairs
from sfmapp.pipelines.planning.costs import Estimate, Given, estimate
from sfmapp.pipelines.planning.doubts import find_doubts
from sfmapp.pipelines.planning.links import Links, find_links
from sfmapp.pipelines.planning.look import Look, look_at_all
from sfmapp.pipelines.planning.machine import BUSY, Machine, known_machine, load
from sfmapp.pipelines.planning.surface_costs import surface_costs
from sfmapp.pipelines.planning.trial import choose_images, try_images
from sfmapp.pipelines.sparse.keys import stage_keys
from sfmapp.pipelines.sparse.planned import plan_key, remember_plan
from sfmapp.report.plan import FORMAT, Doubt, Interval, MachineFacts, PlannedCamera, PlanReport
from sfmapp.reporting import Usage
from sfmapp.workspace.kernels import PAIR_MODULES, kernels_compiling
from sfmapp.workspace.options import Options, with_absolute_paths
from sfmapp.workspace.usage import Stopwatch

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageSet
    from sfmapp.images.report import ImagesReport
    from sfmapp.matching.report import PairsReport

# photographs that are worked on as a run does it: so many, or as many as take about as many times the features of the
# bundled sample, but three
_MOST_TRIED, _TRIED_SAMPLES = 6, 1.0
# pairs between groups that small versions do not link, on which whole photographs have the last word
_MOST_DOUBTED = 4
# what is left of memory for other programs, before a plan says that it is too little
_MEMORY_SHARE = 0.9


def plan(
    images: Images, options: Options | None = None, *, dense: bool = False, mesh: bool = False,
    events: Events | None = None, watch: Stopwatch | None = None,
) -> PlanReport:  # fmt: skip
    """Tell what :func:`~sfmapp.reconstruct` with these photographs and options will take, and what will go wrong.

    The plan is remembered for this user, and the run that follows compares itself with it in its report.

    Args:
        images: as ``reconstruct`` takes them.
        options: of all stages.
        dense, mesh: tell as well what patches, and a mesh of them, will take.
        events: told of what is done, and asked whether to stop.
        watch: started earlier, if more is to be counted than this call.

    Raises:
        UsageError: it is a video.
        InputError: the photographs do not exist or cannot be read.
        NoReconstructionError: fewer than two can be used.
        InterruptedRunError: ``events`` was asked to stop.
    """
    options, events, watch = with_absolute_paths(options or Options()), events or Events(), watch or Stopwatch()
    if isinstance(images, str | os.PathLike) and is_video(os.fspath(images)):
        raise UsageError(
            f"{os.fspath(images)} is a video: expected photographs, as its frames are not known before they are chosen",
            "reconstruct it; or plan for the frames in OUT/images of a reconstruction of it",
        )
    image_set, found = load_images(images, options.images, events, threads=options.num_workers)
    image_set = with_positions(image_set, options.gps)
    if len(image_set.images) < 2:
        raise NoReconstructionError(
            f"{len(image_set.images)} usable photographs, at least two are needed",
            "give photographs of the same thing from different places",
        )
    machine = known_machine(events)
    usage: dict[str, Usage] = {}
    with kernels_compiling(events, usage, PAIR_MODULES):
        looks = look_at_all(image_set.images, threads=options.num_workers, events=events)
    given, selected = _worked(image_set, looks, options, machine, events)
    told = estimate(given)
    doubts = [
        *find_doubts(image_set, found, looks, given.links, given.trial),
        *_of_machine(told, machine),
    ]
    report = _report(name_of(images), image_set, found, given, selected, told, doubts)
    if dense or mesh:
        surface, disk_mb = surface_costs(given, mesh=mesh)
        report = replace(report, surface=surface, surface_disk_mb=disk_mb)
    remember_plan(report)
    return replace(report, took=watch.read())


def _worked(
    image_set: ImageSet, looks: list[Look], options: Options, machine: Machine, events: Events
) -> tuple[Given, PairsReport]:
    """Pairs by the rule of the run, what small versions tell of them, and real work on some of the photographs."""
    features, threads = [look.features for look in looks], options.num_workers
    timer = Stopwatch()
    pairs, selected = select_pairs(
        image_set, features, options.pairs, seed=options.seed, threads=threads, events=events.unheard()
    )
    select_cpu_s = timer.read().cpu_s
    links = find_links(image_set, features, pairs, seed=options.seed, threads=threads, events=events)
    wanted = _between_groups(links, len(looks))
    most = _num_tried(image_set, machine)
    trial = try_images(image_set, choose_images(links, len(looks), most, wanted), options, events)
    links = links.with_found(pair.images for pair in trial.pairs if pair.num_matches)
    return Given(image_set.images, options, machine, links, trial, select_cpu_s), selected


def _num_tried(image_set: ImageSet, machine: Machine) -> int:
    pixels = [image.width * image.height / 1e6 for image in image_set.images]
    affordable = _TRIED_SAMPLES * machine.megapixels / max(1e-6, float(np.mean(pixels)))
    return int(np.clip(affordable, 3, _MOST_TRIED))


def _between_groups(links: Links, num_images: int) -> list[tuple[int, int]]:
    """Of each of the groups that nothing links, the pair with another that looks most like one, for whole photographs
    to tell; the largest groups first."""
    groups = links.groups(num_images)
    group_of = np.empty(num_images, np.int64)
    for n, group in enumerate(groups):
        group_of[group] = n
    found = []
    for n in range(1, len(groups)):
        between = np.flatnonzero((group_of[links.pairs] == n).sum(axis=1) == 1)
        if len(between):
            best = between[links.num_putative[between].argmax()]
            found.append((int(links.pairs[best, 0]), int(links.pairs[best, 1])))
    return found[:_MOST_DOUBTED]


def _of_machine(told: Estimate, machine: Machine) -> list[Doubt]:
    """What this machine is too small for, and how well it is known."""
    doubts, memory_mb, disk_mb = [], _memory_mb(), _free_disk_mb()
    if told.whole.memory_mb.likely > _MEMORY_SHARE * memory_mb:
        doubts.append(
            Doubt(
                weight="warning", subject="memory", names=[],
                message=f"{told.peak_stage} will take {told.whole.memory_mb.text('MB')} of memory, and there are "
                f"{memory_mb:.0f}",
                remedy="--threads 1, smaller pictures (--set features.max_size_px=2000) or fewer features "
                "(--set features.max_num_features=4096)",
            )
        )  # fmt: skip
    if told.disk_mb.high > disk_mb:
        doubts.append(
            Doubt(
                weight="warning", subject="disk", names=[],
                message=f"the output takes {told.disk_mb.text('MB')}, and {disk_mb:.0f} MB are free here",
                remedy="choose an OUT on another disk, or --no-recording",
            )
        )  # fmt: skip
    if machine.is_busy:
        doubts.append(
            Doubt(
                weight="note", subject="machine", names=[],
                message=f"others were at work when this machine was measured (load {machine.load:.1f} on "
                f"{machine.cores} cores), so that stages may take less than is told",
                remedy="plan again when it is quiet: it is then measured anew",
            )
        )  # fmt: skip
    if load() > BUSY * machine.cores:
        doubts.append(
            Doubt(
                weight="note", subject="machine", names=[],
                message=f"others are at work on this machine now (load {load():.1f} on {machine.cores} cores)",
                remedy="times are those of a machine that has nothing else to do",
            )
        )  # fmt: skip
    return doubts


def _memory_mb() -> float:
    """Of the machine, 1e6 bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e6


def _free_disk_mb() -> float:
    """Of the working folder, 1e6 bytes."""
    return shutil.disk_usage(".").free / 1e6


def _report(
    source: str, image_set: ImageSet, found: ImagesReport, given: Given, selected: PairsReport, told: Estimate,
    doubts: list[Doubt],
) -> PlanReport:  # fmt: skip
    images, machine = image_set.images, given.machine
    return PlanReport(
        format=FORMAT,
        source=source,
        key=plan_key(stage_keys(given.options, image_set), given.options),
        num_images=len(images),
        num_skipped=len(image_set.skipped),
        megapixels=sum(image.width * image.height for image in images) / 1e6,
        threads=given.options.num_workers,
        cameras=[
            PlannedCamera(
                num_images=one.num_images, width=one.width, height=one.height, model=one.model, focal_px=one.focal_px,
                focal_source=one.focal_source, name=f"{one.make} {one.camera}".strip(),
            )
            for one in found.cameras
        ],
        groups=[len(group) for group in given.links.groups(len(images))],
        num_pairs=given.links.num_all,
        num_overlapping=told.num_overlapping,
        pairs_reason=selected.reason,
        num_features=told.num_features,
        num_matches=told.num_matches,
        num_observations=told.num_observations,
        stages=told.stages,
        whole=told.whole,
        peak_stage=told.peak_stage,
        disk_mb=told.disk_mb,
        surface=[],
        surface_disk_mb=Interval(0.0, 0.0, 0.0),
        doubts=doubts,
        machine=MachineFacts(
            processor=machine.processor, cores=machine.cores, memory_mb=_memory_mb(), free_disk_mb=_free_disk_mb(),
            load=load(), calibrated=machine.calibrated, calibration_load=machine.load,
            is_calibration_busy=machine.is_busy,
        ),
        took=Usage(wall_s=0.0, cpu_s=0.0),
    )  # fmt: skip
