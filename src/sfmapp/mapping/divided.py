"""A large set of images mapped in parts: divided, each part by itself, and what agrees put together as one model.

What comes of it is where mapping goes on: images that no part holds, or that stand against their neighbours, are then
registered as any others are, and all is adjusted together. No part's failure is one of the whole.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from sfmapp.errors import SfmError
from sfmapp.events import Events
from sfmapp.executor import Executor
from sfmapp.mapping.assembly import Assembly, assemble, union
from sfmapp.mapping.division import divide
from sfmapp.mapping.mapper import STAGE, Mapper
from sfmapp.mapping.options import MappingOptions
from sfmapp.mapping.part_files import KeptParts, map_stored, read_models, store_part
from sfmapp.mapping.report import FailedPartReport, PartsReport, SeamReport, SubmapReport
from sfmapp.mapping.seams import Seam, find_common, fit_seam, joint_covariances
from sfmapp.mapping.submaps import Part, Submap
from sfmapp.mapping.tracks import USELESS_CONFIGS
from sfmapp.mapping.verified_pairs import pair_agreement
from sfmapp.scene.correspondences import Correspondences
from sfmapp.scene.reconstruction import Reconstruction

_STEP = "mapping parts"


# Fewer images take less time as a whole: 300 views of a rendered town three quarters of it and 1,000 four fifths. Of
# 3,000 the whole had grown after 69 CPU seconds, where parts were joined after 95 (other loads, before adjustments by
# fronts, which parts are too small for); what follows is the same for both. Where one thread gains by parts has not
# been found: they pay where several workers map them.
FEWEST = 5000
# So large a share of the verified matches may agree with submaps and not with the model of all: of a rendered town it
# is 0.00002, and two maps are taken for the same up to this difference where starts are compared too.
MAX_LOST_AGREEMENT = 0.005


@dataclass(frozen=True)
class Divided:
    """What mapping in parts has brought.

    Attributes:
        models: of submaps that agree, the largest first; none where images are to be mapped as a whole.
        report: of the parts, empty where there are none.
        submaps: all of them.
    """

    models: list[Reconstruction]
    report: PartsReport = field(default_factory=PartsReport)
    submaps: list[Submap] = field(default_factory=list)

    def is_bent(self, models: Sequence[Reconstruction], correspondences: Correspondences) -> bool:
        """Whether fewer of the verified matches agree with finished models than do with submaps: then parts that look
        alike were put together, or a wrong one has bent the others."""
        whole = [pair_agreement(model, correspondences) for model in models]
        apart = [pair_agreement(submap.model, submap.part.correspondences) for submap in self.submaps]
        agreeing = [
            sum(int(f.num_agreeing.sum()) for f in found) / max(sum(int(f.num_matches.sum()) for f in found), 1)
            for found in (whole, apart)
        ]
        return agreeing[0] < agreeing[1] - MAX_LOST_AGREEMENT

    def given_up(self, reason: str, events: Events) -> Divided:
        """Nothing but the report, and in it why all images are mapped as a whole after all."""
        events.warned(STAGE, f"{reason}: mapping all images as a whole")
        return Divided([], replace(self.report, given_up=reason))


@dataclass(frozen=True)
class PartFailure:
    """What stands for the models of a part that could not be mapped: why."""

    reason: str

    @staticmethod
    def of(error: Exception) -> PartFailure:
        """What a part, or the worker that had it, raised."""
        known = isinstance(error, SfmError)
        return PartFailure(str(error) if known else f"{type(error).__name__}: {error}")


@dataclass(frozen=True)
class PartsWork:
    """Who maps the parts of a large set, and where what they come to is kept, None for nowhere."""

    executor: Executor
    kept: KeptParts | None = None


@dataclass(frozen=True)
class InParts:
    """How a large set is mapped in parts.

    Attributes:
        work: who maps them, and where they are kept.
        map_part: makes the models of one, the largest first; can be sent to another process.
    """

    work: PartsWork
    map_part: Callable[[Events, Part], list[Reconstruction]]

    def models(
        self, empty: Reconstruction, correspondences: Correspondences, mapper_of: Callable[[Reconstruction], Mapper]
    ) -> Divided:
        """Models of what the parts of a set agree on.

        Args:
            empty: all images, their cameras and tracks; nothing of it is changed.
            mapper_of: of a model of all images, whose options and events are those of the parts.
        """
        parts = parts_of(empty, correspondences) if len(empty.image_names) >= FEWEST else []
        if not parts:
            return Divided([])
        mapper = mapper_of(empty)
        submaps, failed = self._mapped(parts, mapper.events)
        models, report = joined(submaps, empty, partial(_mapper_of_part, mapper), mapper.options, mapper.events)
        found = Divided(models, replace(report, failed=failed), submaps)
        if not models:
            return found.given_up("no part came to a model", mapper.events)
        for model in models:
            _set_up(model, mapper_of(model))
        return found

    def _mapped(self, parts: Sequence[Part], events: Events) -> tuple[list[Submap], list[FailedPartReport]]:
        """What the parts come to, in their order, whoever is done first, and those that come to nothing."""
        sizes = [len(part.image_idx) for part in parts]
        found: dict[int, list[Reconstruction] | PartFailure] = {}
        events.started(_STEP, f"{len(parts)} parts of {min(sizes)} to {max(sizes)} images", total=len(parts))
        with closing(self._answers(parts, events)) as answers:
            for n, models in answers:
                found[n] = models or PartFailure("no two of its images begin a model")
                registered = [] if isinstance(models, PartFailure) else [int(m.is_registered.sum()) for m in models]
                text = f"{' + '.join(map(str, registered)) or 'none'} of {sizes[n]} images of part {n}"
                events.decided(STAGE, text)
                events.advanced(_STEP, message=text)
        events.finished(_STEP)
        submaps, failed = [], []
        for n, part in enumerate(parts):
            models = found[n]
            if not isinstance(models, PartFailure):
                submaps += [Submap(part, model) for model in models]
                continue
            failed.append(FailedPartReport(
                first_image=part.image_names[0], num_images=sizes[n], reason=models.reason
            ))  # fmt: skip
            events.warned(
                STAGE,
                f"part {n} ({part.image_names[0]} and {sizes[n] - 1} more images) came to nothing, and its images are "
                f"registered from where its neighbours are: {models.reason}",
            )
        return submaps, failed

    def _answers(
        self, parts: Sequence[Part], events: Events
    ) -> Generator[tuple[int, list[Reconstruction] | PartFailure], None, None]:
        """Models of the parts as they come, those first that an earlier run has kept."""
        kept, executor = self.work.kept, self.work.executor
        waiting = []
        for n, part in enumerate(parts):
            known = kept.read(part) if kept is not None else None
            if known is None:
                waiting.append(n)
            else:
                yield n, known
        for k, models in self._made(executor, [parts[n] for n in waiting], events):
            if kept is not None and not isinstance(models, PartFailure):  # which the next run may not have
                kept.write(parts[waiting[k]], models)
            yield waiting[k], models

    def _made(
        self, executor: Executor, parts: Sequence[Part], events: Events
    ) -> Generator[tuple[int, list[Reconstruction] | PartFailure], None, None]:
        """Models of parts that an executor maps, as they come."""
        if executor.folder is None:
            yield from executor.run(partial(self.map_part, events.unheard()), parts, instead=PartFailure.of)
            return
        stored = [store_part(executor.folder, n, part) for n, part in enumerate(parts)]
        for n, path in executor.run(partial(map_stored, self.map_part), stored, instead=PartFailure.of):
            yield n, path if isinstance(path, PartFailure) else read_models(path, parts[n])


def parts_of(empty: Reconstruction, correspondences: Correspondences) -> list[Part]:
    """The parts in which images are to be mapped; none where they are better mapped as a whole."""
    is_useful = ~np.isin(correspondences.config, USELESS_CONFIGS)
    num_matches = np.where(is_useful, correspondences.num_inliers, 0)
    divided = divide(len(empty.image_names), correspondences.pair_image_idx, num_matches)
    return [Part.of(empty, correspondences, images) for images in divided] if len(divided) > 1 else []


def _mapper_of_part(like: Mapper, submap: Submap) -> Mapper:
    part = submap.part
    return replace(
        like, reconstruction=submap.model, correspondences=part.correspondences, prior_cameras=list(part.cameras),
        locked=np.zeros(len(part.image_idx), bool),
    )  # fmt: skip


def _set_up(model: Reconstruction, mapper: Mapper) -> None:
    """Give a model of several parts its points, and bring it to rest where images are to be registered in it."""
    # where parts meet, as far off as these may have drifted
    mapper.max_error_px = mapper.options.max_pose_error_px
    mapper.triangulate_images(model.registered_idx.tolist())
    if not model.is_registered.all():
        mapper.adjust_globally()


def joined(
    submaps: Sequence[Submap], empty: Reconstruction, mapper_of_part: Callable[[Submap], Mapper],
    options: MappingOptions, events: Events,
) -> tuple[list[Reconstruction], PartsReport]:  # fmt: skip
    """Models of submaps that agree, without points yet, the largest first, and what is to be said of all.

    Submaps that share images with a larger model and have no part in it are left out: their images are free.

    Args:
        empty: all images, their cameras and tracks; nothing of it is changed.
        mapper_of_part: knows what varied in a submap's model.
    """
    seams = find_seams(submaps, mapper_of_part, options)
    worlds, seams = assemble(submaps, seams)
    kept: list[Assembly] = []
    reasons: dict[int, str] = {}
    for world in worlds:
        against = _reason_against(world, kept, seams)
        if not against:
            kept.append(world)
            continue
        for n in world.members:
            reasons[n] = f"it is not one with {against}"
            images = submaps[n].registered_idx
            events.warned(
                STAGE,
                f"submap {n} ({empty.image_names[images[0]]} and {len(images) - 1} more images) is left out, and its "
                f"images are registered anew from where its neighbours are: {reasons[n]}",
            )
    report = PartsReport(
        submaps=[
            SubmapReport(
                first_image=empty.image_names[s.registered_idx[0]], num_images=len(s.registered_idx),
                num_images_of_part=len(s.part.image_idx), reason=reasons.get(n, ""),
            )
            for n, s in enumerate(submaps)
        ],
        seams=[
            SeamReport(
                submaps=list(seam.submaps), num_images=len(seam.image_idx), num_elsewhere=int(seam.is_off.sum()),
                num_points=seam.num_points, num_points_agreeing=seam.num_seen, reason=seam.reason,
                sigmas=seam.sigmas if np.isfinite(seam.sigmas) else None,
            )
            for seam in seams
        ],
    )  # fmt: skip
    events.decided(
        STAGE,
        f"{len(submaps) - len(reasons)} of {len(submaps)} submaps are one, by {sum(not s.reason for s in seams)} seams",
        **report,
    )  # fmt: skip
    return [union(world, submaps, empty) for world in kept], report


def find_seams(
    submaps: Sequence[Submap], mapper_of_part: Callable[[Submap], Mapper], options: MappingOptions
) -> list[Seam]:
    """The seams between all submaps that share images, with what speaks against each."""
    commons = [
        find_common(a, b, submaps, options)
        for a in range(len(submaps))
        for b in range(a + 1, len(submaps))
        if len(np.intersect1d(submaps[a].registered_idx, submaps[b].registered_idx))
    ]
    known = [
        joint_covariances(submap, mapper_of_part, [common for common in commons if n in common.submaps])
        for n, submap in enumerate(submaps)
    ]
    return [
        fit_seam(common, submaps, [known[n].get(common.submaps) for n in common.submaps], options) for common in commons
    ]


def _reason_against(world: Assembly, kept: Sequence[Assembly], seams: Sequence[Seam]) -> str:
    """Why submaps that share images with others have no part in their model; empty where they share none."""
    others = {n for other in kept for n in other.members}
    for seam in seams:
        for inside, outside in (seam.submaps, seam.submaps[::-1]):
            if inside in world.members and outside in others:
                return f"submap {outside}: {seam.reason}"
    return ""
