"""From what a look and a trial have shown to what the run will take: CPU seconds, wall seconds, memory and disk.

Where real work on the photographs tells a cost, that is taken; where it cannot, as of mapping, the cost is that of the
bundled sample on this machine, in proportion. Seconds of other machines stand nowhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfmapp.features.extract import FeatureOptions, bytes_for_extraction, bytes_of_extraction
from sfmapp.images.image_set import ImageRecord
from sfmapp.pipelines.planning.links import Links
from sfmapp.pipelines.planning.machine import Machine
from sfmapp.pipelines.planning.trial import Trial, TriedPair
from sfmapp.report.plan import WHOLE, Interval, StagePlan
from sfmapp.workspace.options import Options

# an interval holds nine in ten
_SIGMAS = 1.65
# what even a cost that was measured on the same photographs is off by, from one run to the next
_REPEATED = 0.08
# Of mapping: an image costs as much as so many observations, and the least and the most that it came to on twelve sets
# in shares of this; it starts anew where matches contradict a model, which nobody knows beforehand.
_OBS_PER_IMAGE = 3300.0
_MAPPING_BELOW, _MAPPING_ABOVE = 0.35, 1.2
# Where photographs fall into parts that share little, models are grown apart and joined; with many, what is grown anew
# is small.
_PER_PART, _MOST_PARTS = 0.8, 4
# Where photographs say where they were taken, models are adjusted to that and held against it.
_WITH_POSITIONS = 2.2
# Links with fewer matches than this share of a photograph's best one hold parts together loosely.
_LOOSE = 0.1
# Of a track of verified matches: shares of its observations that are kept
_KEPT = 0.65
# Of the recording: its start, a photograph and a megapixel of photographs, in shares of each other
_RECORDING = (0.5, 0.006, 0.012)
# shares of the CPU time of stages that are shared out among the threads, after Amdahl; of the others nothing is
_PARALLEL = {"features": 0.95, "matching": 0.97, "pairs": 0.9, "mapping": 0.4}
# What choosing pairs takes with all features, of what it took with some
_MORE_FEATURES = 1.4
# What the share of linked pairs tells of the others counts as much as so many of them that were tried.
_PRIOR_PAIRS = 3.0
# bytes of a feature: keypoint, colour and descriptor in memory, and what is allocated beside them, measured on 16 sets;
# with keys in the database; in a model
_FEATURE_BYTES, _STORED_FEATURE_BYTES, _MODEL_FEATURE_BYTES = 250.0, 152.0, 24.0
# bytes of a verified match, and of a pair; of an observation, and of a point in a model
_MATCH_BYTES, _PAIR_BYTES, _OBS_BYTES, _POINT_BYTES = 16.0, 300.0, 8.0, 51.0
# of the recording: a photograph on a screen, in pixels and bytes, and an observation
_SCREEN_PX, _SCREEN_BYTES, _RECORDED_OBS_BYTES = 6e5, 150e3, 60.0
# bytes that mapping takes for an observation beyond what features leave to it
_MAPPING_OBS_BYTES = 200.0


@dataclass(frozen=True)
class Given:
    """What an estimate rests on.

    Attributes:
        images: of the run.
        select_cpu_s: that choosing its pairs took, with features of small versions.
    """

    images: Sequence[ImageRecord]
    options: Options
    machine: Machine
    links: Links
    trial: Trial
    select_cpu_s: float


class Estimate(NamedTuple):
    """What a run will find and take."""

    num_features: Interval
    num_overlapping: Interval
    num_matches: Interval
    num_observations: Interval
    stages: list[StagePlan]
    whole: StagePlan
    peak_stage: str
    disk_mb: Interval


def estimate(given: Given) -> Estimate:
    """The estimate of all stages."""
    num_features = _num_features(given)
    overlapping = _num_overlapping(given)
    matches = _num_matches(given)
    observations = _num_observations(given, overlapping, matches, num_features)
    cpu = {
        "images": Interval.about(_of_sample(given, "images", given.machine.num_images), 0.7, 3.0),
        "features": _features_cpu(given),
        "pairs": _pairs_cpu(given),
        "matching": _matching_cpu(given),
        "mapping": _mapping_cpu(given, observations),
        "output": Interval.about(_of_sample(given, "output", given.machine.num_images), 0.7, 1.5),
        "recording": _recording_cpu(given),
    }
    memory = _memory(given, num_features, matches, observations)
    cores = min(given.options.num_workers, given.machine.cores)
    stages = [
        StagePlan(
            stage=name, cpu_s=seconds, wall_s=wall_of(seconds, _PARALLEL.get(name, 0.0), cores),
            memory_mb=memory.get(name, memory["images"]),
        )
        for name, seconds in cpu.items()
    ]  # fmt: skip
    peak = max(stages, key=lambda stage: stage.memory_mb.likely)
    beside = Interval.about(_beside(given.machine), 0.2)
    whole = StagePlan(
        stage=WHOLE,
        cpu_s=_sum([*cpu.values(), beside]),
        wall_s=_sum([*(stage.wall_s for stage in stages), beside]),
        memory_mb=peak.memory_mb,
    )
    disk = _disk(given, num_features, matches, observations)
    return Estimate(num_features, overlapping, matches, observations, stages, whole, peak.stage, disk)


# ----------------------------------------------------------------------------------------------- what there will be


def _num_features(given: Given) -> Interval:
    found = np.array(list(given.trial.num_features.values()), np.float64)
    if not len(found):
        return Interval(0.0, 0.0, 0.0)
    limit = float(given.options.features.max_num_features) * len(given.images)
    error = _relative_error(found, len(given.images), least=0.03)
    likely = float(found.mean()) * len(given.images)
    return Interval(likely * (1.0 - error), min(likely, limit), min(likely * (1.0 + error), limit))


def _num_overlapping(given: Given) -> Interval:
    """Pairs of the run that overlap: those that small versions show, and as many of the others as the trial found."""
    linked, others = int(given.links.is_linked.sum()), int((~given.links.is_linked).sum())
    seen = [pair.num_matches > 0 for pair, is_linked in _tried(given) if not is_linked]
    # those that were tried are the least alike, and where most pairs are linked the others overlap as well, by little
    num = len(seen) + _PRIOR_PAIRS
    share = (sum(seen) + _PRIOR_PAIRS * linked / max(1, linked + others)) / num
    spread = _SIGMAS * math.sqrt(share * (1.0 - share) / num) + 0.5 / num
    high = linked + others * min(1.0, share + spread)
    scale = given.links.scale
    return Interval(0.85 * linked * scale, (linked + others * share) * scale, high * scale)


def _num_matches(given: Given) -> Interval:
    """Verified matches of all pairs: those of small versions, times what whole photographs have more of them."""
    in_small = given.links.scale * float(given.links.num_matches.sum())
    pairs = _tried(given)
    small = {(int(i), int(j)): int(num) for (i, j), num in zip(given.links.pairs, given.links.num_matches, strict=True)}
    matched = np.array([(small.get(pair.images, 0), pair.num_matches) for pair, _ in pairs], np.float64).reshape(-1, 2)
    total_small, total = matched.sum(axis=0)
    if total_small <= 0.0:
        return Interval(0.0, total, max(total, 100.0 * given.links.num_all))
    ratio = total / total_small
    spread = _SIGMAS * float(np.abs(matched[:, 1] - ratio * matched[:, 0]).sum()) / max(total, 1.0)
    error = min(0.9, max(0.15, spread / math.sqrt(max(1, len(matched)))))
    return Interval.about(ratio * in_small, error)


def _num_observations(given: Given, overlapping: Interval, matches: Interval, num_features: Interval) -> Interval:
    """Observations of points: a track over L images has L of them and up to L (L - 1) / 2 matches."""
    length = 2.0 + 0.2 * max(0.0, given.links.scale * _neighbors(given.links, len(given.images)) - 1.0)
    likely = min(_KEPT * 2.0 * matches.likely / (length - 1.0), 0.8 * num_features.likely)
    return Interval.about(likely, 0.45, 0.6)


def _neighbors(links: Links, num_images: int) -> float:
    """With how many others an image shares its matches, one that has more with some counted as fewer."""
    total, squares = np.zeros(num_images), np.zeros(num_images)
    for side in (0, 1):
        np.add.at(total, links.pairs[:, side], links.num_matches)
        np.add.at(squares, links.pairs[:, side], links.num_matches.astype(np.float64) ** 2)
    has_any = squares > 0.0
    return float(np.mean(total[has_any] ** 2 / squares[has_any])) if has_any.any() else 0.0


def num_parts(links: Links, num_images: int) -> int:
    """Parts, of three photographs and more, that hold together by less than a tenth of what they share inside."""
    best = np.zeros(num_images, np.int64)
    for side in (0, 1):
        np.maximum.at(best, links.pairs[:, side], links.num_matches)
    is_firm = links.num_matches > _LOOSE * np.minimum(best[links.pairs[:, 0]], best[links.pairs[:, 1]])
    firm = replace(links, num_matches=np.where(is_firm, links.num_matches, 0))
    return max(1, sum(len(group) >= 3 for group in firm.groups(num_images)))


# -------------------------------------------------------------------------------------------------- what that takes


def _features_cpu(given: Given) -> Interval:
    tried = sorted(given.trial.cpu_s)
    if not tried:
        return Interval(0.0, 0.0, 0.0)
    pixels = np.array([_pixels(image, given.options.features) for image in given.images])
    spent = np.array([given.trial.cpu_s[k] for k in tried])
    likely = float(spent.sum() / pixels[tried].sum() * pixels.sum())
    error = _relative_error(spent / pixels[tried], len(given.images), least=_REPEATED)
    machine = given.machine
    beside = max(0.0, machine.usage["features"].cpu_s - machine.image_cpu_s)
    return _sum([Interval.about(likely, error), Interval.about(beside, 0.25)])


def _pixels(record: ImageRecord, options: FeatureOptions) -> float:
    """That features are sought in, and a share of those that have to be decoded."""
    scale = min(1.0, options.max_size_px / max(record.width, record.height))
    return record.width * record.height * (0.9 * scale * scale + 0.1)


def _pairs_cpu(given: Given) -> Interval:
    """Choosing pairs took so long with a few features of each image; half of that is the vocabulary, whose size is the
    same with all of them."""
    return Interval.about(_MORE_FEATURES * given.select_cpu_s, 0.5, 1.0)


def _matching_cpu(given: Given) -> Interval:
    scale = given.links.scale
    parts = []
    every = [pair.cpu_s for pair, _ in _tried(given)]
    for wanted in (True, False):
        seconds = np.array([pair.cpu_s for pair, is_linked in _tried(given) if is_linked == wanted] or every)
        num = float((given.links.is_linked == wanted).sum()) * scale
        if len(seconds) and num:
            error = _relative_error(seconds, int(num) + 1, least=0.15)
            parts.append(Interval.about(float(seconds.mean()) * num, error))
    machine = given.machine
    beside = max(0.0, machine.usage["matching"].cpu_s - machine.pair_cpu_s) / machine.num_images * len(given.images)
    return _sum([*parts, Interval.about(beside, 0.5)])


def _mapping_cpu(given: Given, observations: Interval) -> Interval:
    machine, num_images = given.machine, len(given.images)
    unit = machine.usage["mapping"].cpu_s / (_OBS_PER_IMAGE * machine.num_images + machine.num_observations)
    likely = 0.0
    for group in given.links.groups(num_images):
        costs = _OBS_PER_IMAGE * len(group) + observations.likely * len(group) / num_images
        parts = min(num_parts(given.links.among(group, num_images), num_images), _MOST_PARTS)
        likely += unit * costs * (1.0 + _PER_PART * (parts - 1))
    if 2 * sum(image.position is not None for image in given.images) > num_images:
        likely *= _WITH_POSITIONS
    return Interval.about(likely, _MAPPING_BELOW, _MAPPING_ABOVE)


def _recording_cpu(given: Given) -> Interval:
    start, image, megapixel = _RECORDING
    machine = given.machine
    own = start + image * len(given.images) + megapixel * sum(i.width * i.height for i in given.images) / 1e6
    sample = start + image * machine.num_images + megapixel * machine.megapixels
    return Interval.about(machine.usage["recording"].cpu_s * own / sample, 0.25)


def _of_sample(given: Given, stage: str, num_images: int) -> float:
    return given.machine.usage[stage].cpu_s * len(given.images) / num_images


def _beside(machine: Machine) -> float:
    """CPU seconds of a run that no stage counts: its start and its report."""
    # kernels are loaded beside the first stages, which count them as well
    counted = sum(usage.cpu_s for name, usage in machine.usage.items() if name != "kernels")
    return max(0.0, machine.run.cpu_s - counted)


def wall_of(cpu_s: Interval, parallel: float, cores: int) -> Interval:
    """Seconds on so many cores of work that can be shared out in part, after Amdahl."""
    share = 1.0 - parallel + parallel / max(1, cores)
    return Interval(*(share * value for value in (cpu_s.low, cpu_s.likely, cpu_s.high)))


# ---------------------------------------------------------------------------------------------------- memory and disk


def _memory(given: Given, num_features: Interval, matches: Interval, observations: Interval) -> dict[str, Interval]:
    """Peaks of the process in MB by stage. What features took is kept for as long as their descriptors are."""
    machine, options = given.machine, given.options
    program = program_mb(machine)
    needs = sorted((bytes_of_extraction(image, options.features) for image in given.images), reverse=True)
    at_once, budget = 0, bytes_for_extraction(options.features)
    for need in needs[: options.num_workers]:
        if at_once and at_once + need > budget:
            break
        at_once += need
    kept = num_features.likely * _FEATURE_BYTES
    found = matches.likely * _MATCH_BYTES + given.links.num_all * _PAIR_BYTES
    scratch = at_once  # the workers' memory is not given back to the system
    peaks = {
        "images": 0.0,
        "features": at_once + kept,
        "pairs": scratch + kept,
        "matching": scratch + kept + found,
        "mapping": scratch + kept + found + observations.likely * _MAPPING_OBS_BYTES,
    }
    return {name: Interval.about(program + extra / 1e6, 0.15) for name, extra in peaks.items()}


def program_mb(machine: Machine) -> float:
    """Memory of the program with its kernels, 1e6 bytes: what the sample took beside its pictures and features."""
    pictures = machine.extraction_mb + machine.num_features * _FEATURE_BYTES / 1e6
    return max(0.0, (machine.run.peak_memory_mb or 0.0) - pictures)


def _disk(given: Given, num_features: Interval, matches: Interval, observations: Interval) -> Interval:
    """MB of the output: database, model, recording."""
    database = num_features.likely * _STORED_FEATURE_BYTES + matches.likely * _MATCH_BYTES
    database += given.links.num_all * _PAIR_BYTES
    points = observations.likely / 3.0
    model = num_features.likely * _MODEL_FEATURE_BYTES + observations.likely * _OBS_BYTES + points * _POINT_BYTES
    shown = sum(min(1.0, image.width * image.height / _SCREEN_PX) for image in given.images)
    recording = shown * _SCREEN_BYTES + observations.likely * _RECORDED_OBS_BYTES
    return Interval.about((database + model + recording) / 1e6, 0.2)


# -------------------------------------------------------------------------------------------------------- arithmetic


def _tried(given: Given) -> list[tuple[TriedPair, bool]]:
    """Pairs of the trial, each with whether small versions had linked it."""
    linked = {(int(i), int(j)) for i, j in given.links.pairs[given.links.is_linked]}
    return [(pair, pair.images in linked) for pair in given.trial.pairs]


def _relative_error(values: NDArray[np.float64], num_all: int, *, least: float) -> float:
    """Half width of the interval of a mean of all, from some, as a share of it."""
    num = len(values)
    if num < 2 or values.mean() <= 0.0:
        return max(least, 0.4 if num_all > num else 0.0)
    # of a finite set that is drawn from without putting back
    left = max(0.0, 1.0 - num / num_all)
    return max(least, _SIGMAS * float(values.std(ddof=1) / values.mean()) * math.sqrt(left / num))


def _sum(parts: Sequence[Interval]) -> Interval:
    """Of numbers that are off independently of each other."""
    likely = sum(part.likely for part in parts)
    below = math.sqrt(sum((part.likely - part.low) ** 2 for part in parts))
    above = math.sqrt(sum((part.high - part.likely) ** 2 for part in parts))
    return Interval(max(0.0, likely - below), likely, likely + above)
