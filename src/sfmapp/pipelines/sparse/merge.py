"""Two finished reconstructions that share photographs, or see the same place, as one.

Features, matches and models of both are taken over into a new workspace, photographs of the one are matched with those
of the other, and mapping goes on with both models: it joins them by a similarity of shared photographs and points, and
adjusts all. What the two say of the photographs that both have must be one thing but for a similarity, and each must
still be itself in the union; otherwise they are not averaged, but kept apart and named.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError, NoReconstructionError, UsageError
from sfmapp.events import Events
from sfmapp.formats.colmap import read_model
from sfmapp.formats.database import Database
from sfmapp.geometry import rigid3, similarity
from sfmapp.georeference.sources import with_positions
from sfmapp.images.folder import load_found
from sfmapp.images.image_set import ImageRecord, ImageSet
from sfmapp.images.sources import Found
from sfmapp.mapping.report import Uncertainty
from sfmapp.pipelines.sparse.finished import (
    DATABASE,
    check_finished,
    models_of,
    names_in_database,
    uncertainty_of,
)
from sfmapp.pipelines.sparse.keys import StageKeys, stage_keys
from sfmapp.pipelines.sparse.photographs import PHOTOGRAPHS, as_before, link_photographs, with_new
from sfmapp.pipelines.sparse.reconstruct import RunResult, map_and_report
from sfmapp.pipelines.sparse.run import Before, Run
from sfmapp.pipelines.sparse.world import read_world
from sfmapp.report.model import MergedReport, ReconstructionReport
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.viewer.listener import RecordingListener
from sfmapp.workspace.layout import RECONSTRUCT
from sfmapp.workspace.manifest import Manifest, image_root, manifest_of, missing_photographs, read_manifest
from sfmapp.workspace.options import flat_options, options_from_dict
from sfmapp.workspace.usage import Stopwatch

STAGE = "merging"
# Photographs that two models share, from which on these tell whether the models are one but for a similarity.
_MIN_SHARED = 3
# A photograph is elsewhere by more than so many standard deviations of both, which are those of noise alone, and this
# share of the size of what both have, or so many degrees: as much as two models of one place do not differ by.
_OFF_SIGMAS, _OFF_SHARE, _OFF_DEG = 10.0, 0.02, 1.0
# Share of the photographs that may be elsewhere: a few may have been wrong in one of the models.
_MAX_OFF = 1 / 3
_SPARSE = ("images", "features", "matching", "mapping", "adjust", "pairs", "seed")


@dataclass(frozen=True)
class _Side:
    """One of the reconstructions.

    Attributes:
        folder, manifest, root: of it.
        names: of its photographs in the order of its database. digests: theirs.
        model, uncertainty: the largest, in its own names.
    """

    folder: Path
    manifest: Manifest
    root: Path
    names: list[str]
    digests: dict[str, str]
    model: Reconstruction
    uncertainty: Uncertainty


def merge_reconstructions(
    first: str | os.PathLike[str],
    second: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    events: Events | None = None,
    record: bool = True,
    watch: Stopwatch | None = None,
) -> RunResult:
    """Make one reconstruction of two.

    Args:
        first, second: OUT of ``sfmapp reconstruct``; neither is changed. Options, and what places the model in the
            world, are those of the first; where the second had others, these are named. Otherwise the frame is that of
            the larger one.
        output: a new folder, an empty one, or that of an earlier call.
        events, record, watch: as of :func:`sfmapp.pipelines.sparse.reconstruct.reconstruct`.

    Raises:
        UsageError: the output holds something else.
        InputError: one of them is no finished reconstruction, or its photographs are gone or have changed.
        NoReconstructionError: they disagree, or have nothing in common; what was found is in the report.
        InterruptedRunError: a stop was asked for; the same call goes on.
    """
    events, watch = events or Events(), watch or Stopwatch()
    sides = [_side(Path(folder)) for folder in (first, second)]
    if sides[0].folder.resolve() == sides[1].folder.resolve():
        raise UsageError(f"expected two reconstructions, found {sides[0].folder} twice")
    _check_output(Path(output), sides)
    options = options_from_dict(sides[0].manifest.options)
    recorder = RecordingListener() if record else None
    with Run.opened(
        RECONSTRUCT, sides[0].manifest.source, output, options, events=events, watch=watch, recorder=recorder,
        images=os.fspath(second),
    ) as run:  # fmt: skip
        run.listen(recorder)
        report = _run(run, sides)
        model, _ = read_model(run.workspace.model())
    return RunResult(model, report)


def _check_output(output: Path, sides: Sequence[_Side]) -> None:
    """Raises UsageError if the output is another reconstruction, or one of the two."""
    manifest = manifest_of(output) if output.is_dir() else None
    if manifest is not None and manifest.added != [str(sides[1].folder.absolute())]:
        raise UsageError(f"{output} holds another reconstruction", "nothing in it was touched; choose another OUT")


def _side(folder: Path) -> _Side:
    manifest = read_manifest(folder, RECONSTRUCT)
    check_finished(folder, manifest)
    root = image_root(manifest)
    if root is None:
        raise missing_photographs(folder, manifest)
    digests = {name: digest.split("+")[0] for name, digest in manifest.inputs.items()}
    return _Side(
        folder, manifest, root, names_in_database(folder), digests, models_of(folder)[0], uncertainty_of(folder)
    )


def _run(run: Run, sides: Sequence[_Side]) -> ReconstructionReport:
    first, second = sides
    root = (run.workspace.folder / PHOTOGRAPHS).absolute()
    run.workspace.note(image_root=str(root), added=[str(second.folder.absolute())])
    run.workspace.save()
    _tell_options(run, sides)
    new_name = _new_names(first, second)
    renamed = replace(second.model, image_names=[new_name[name] for name in second.model.image_names])
    off = disagreement(first.model, renamed, first.uncertainty, _renamed(second.uncertainty, new_name))
    if off is not None and off.is_refused:
        raise NoReconstructionError(
            f"{first.folder} and {second.folder} do not agree: {off.text}",
            "at least one of them is wrong: look at both, and reconstruct it anew with photographs that link its parts",
        )
    with run.stage("images"):
        records = _records(run, sides, new_name)
        run.image_set, befores = _union(sides, new_name, *records)
        run.image_set = with_positions(run.image_set, run.options.gps)
    keys = read_world(run, run.image_set)
    run.note_inputs(keys.inputs)
    known = _take_over(run, sides, new_name, befores, keys)
    run.before = Before(0, known, [first.model, renamed], is_apart=True)
    parts = [(first.folder, first.model), (second.folder, renamed)]
    run.judge = lambda models: _judge(models, parts)
    run.merged = MergedReport(
        first=str(first.folder), second=str(second.folder),
        num_shared=len(set(first.model.image_names) & set(renamed.image_names)),
        num_images=[len(first.model.image_names), len(second.model.image_names)],
        off_sigmas=None if off is None else off.sigmas,
    )  # fmt: skip
    return map_and_report(run, run.image_set, keys)


# -------------------------------------------------------------------------------------------------------- agreement


@dataclass(frozen=True)
class Disagreement:
    """How two models differ in the photographs that both have, once a similarity has been taken off.

    Attributes:
        num_shared, num_off: photographs, and how many of them are elsewhere.
        sigmas: rms of turns or shifts in the standard deviations of both, the larger one; None where these are unknown.
        worst: name of the photograph that is farthest off. share: its shift, of the size of what both have.
        turn_deg: its turn.
    """

    num_shared: int
    num_off: int
    sigmas: float | None
    worst: str
    share: float
    turn_deg: float

    @property
    def is_refused(self) -> bool:
        """Too many are elsewhere for the two to be one thing."""
        return self.num_off > _MAX_OFF * self.num_shared

    @property
    def text(self) -> str:
        """In words."""
        sigmas = "" if self.sigmas is None else f", {self.sigmas:.1f} standard deviations rms"
        return (
            f"{self.num_off} of {self.num_shared} shared photographs are elsewhere once one model is moved onto "
            f"the other{sigmas}; {self.worst} by {100 * self.share:.2g} % of their extent, {self.turn_deg:.2g} degrees"
        )


def disagreement(
    first: Reconstruction, second: Reconstruction, told: Uncertainty, other_told: Uncertainty
) -> Disagreement | None:
    """Hold two models against each other in the photographs that both have, by their names; None where these are few.

    Args:
        told, other_told: how sure the poses of the models are.
    """
    place = {name: i for i, name in enumerate(second.image_names) if second.is_registered[i]}
    shared = [i for i in first.registered_idx if first.image_names[i] in place]
    if len(shared) < _MIN_SHARED:
        return None
    names = [first.image_names[i] for i in shared]
    ours = first.cam_from_world[shared]
    theirs = second.cam_from_world[[place[name] for name in names]]
    fit = similarity.align_poses_robust(theirs, ours)
    moved = similarity.transform_poses(fit.b_from_a, theirs)
    centers = rigid3.center(ours)
    size = max(float(np.linalg.norm(np.ptp(centers, axis=0))), 1e-12)
    shift = np.linalg.norm(rigid3.center(moved) - centers, axis=1)
    turn = rigid3.rotation_angle_deg(
        rigid3.rotation_matrix(moved) @ np.swapaxes(rigid3.rotation_matrix(ours), 1, 2)
    )  # fmt: skip
    sigma = _joint_sigmas(names, (first, second), (told, other_told), fit.b_from_a[7])
    in_sigmas = None if sigma is None else np.stack([shift, turn]) / sigma / np.sqrt(3.0)
    off = (shift > _OFF_SHARE * size) | (turn > _OFF_DEG)
    if in_sigmas is not None:
        off &= in_sigmas.max(0) > _OFF_SIGMAS
    worst = int(np.argmax(shift / size + turn / 90.0))
    rms = None if in_sigmas is None else float(np.sqrt((in_sigmas**2).mean(1)).max())
    return Disagreement(len(shared), int(off.sum()), rms, names[worst], float(shift[worst]) / size, float(turn[worst]))


def _joint_sigmas(
    names: Sequence[str], models: tuple[Reconstruction, Reconstruction], told: tuple[Uncertainty, Uncertainty],
    scale: float,
) -> NDArray[np.float64] | None:  # fmt: skip
    """(2, N) standard deviations of shifts, in units of the first model, and of turns in degrees, of both together."""
    squares = np.zeros((2, len(names)))
    for model, known, unit in zip(models, told, (1.0, scale), strict=True):
        rows = known.images or {}
        if not all(name in rows for name in names):
            return None
        centers = model.centers[model.registered_idx]
        size = unit * float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
        squares[0] += [(size * rows[name].center_sigma_share) ** 2 for name in names]
        squares[1] += [rows[name].rotation_sigma_deg ** 2 for name in names]
    return np.maximum(np.sqrt(squares), 1e-12)


def _judge(models: Sequence[Reconstruction], parts: Sequence[tuple[Path, Reconstruction]]) -> None:
    """Raises NoReconstructionError where the union is none, or one of its parts has been bent to fit the other."""
    union = models[0]
    taken = {union.image_names[i] for i in union.registered_idx}
    for folder, part in parts:
        own = {part.image_names[i] for i in part.registered_idx}
        if 2 * len(own & taken) < len(own):
            raise NoReconstructionError(
                f"{folder} has no part in the model: {len(own & taken)} of its {len(own)} photographs are in it",
                "they show nothing in common, or too little: take photographs between them, and add those",
            )
        found = disagreement(part, union, Uncertainty(), Uncertainty())
        if found is not None and found.is_refused:
            raise NoReconstructionError(
                f"{folder} does not fit the other one without being bent: {found.text}",
                "at least one of them is wrong: look at both, and reconstruct it anew",
            )


# ------------------------------------------------------------------------------------------------------- taking over


def _tell_options(run: Run, sides: Sequence[_Side]) -> None:
    """Name options that the second reconstruction had and the first had not."""
    ours, theirs = (flat_options(options_from_dict(side.manifest.options)) for side in sides)
    others = [
        f"{name} = {theirs[name]} ({ours.get(name)})"
        for name in theirs
        if name.split(".")[0] in _SPARSE and theirs[name] != ours.get(name)
    ]
    if others:
        run.events.warned(
            STAGE, f"{sides[1].folder} was made with other options; those of {sides[0].folder} (in brackets) are used: "
            f"{'; '.join(others)}",
        )  # fmt: skip


def _new_names(first: _Side, second: _Side) -> dict[str, str]:
    """What photographs of the second one are called in the union: those of the same bytes as there, others by their own
    names, or after their folder where these are taken."""
    of_digest = {first.digests[name]: name for name in first.names if name in first.digests}
    taken, found = set(first.names), dict[str, str]()
    for name in second.names:
        same = of_digest.get(second.digests.get(name, ""))
        new = same or (name if name not in taken else f"{second.folder.name}/{name}")
        if same is None and new in taken:
            raise InputError(f"{second.folder}: a photograph called {new} is in both", "rename one of the folders")
        found[name] = new
        taken.add(new)
    return found


def _renamed(known: Uncertainty, new_name: dict[str, str]) -> Uncertainty:
    images = {new_name.get(name, name): sigma for name, sigma in (known.images or {}).items()}
    left_open = [new_name.get(name, name) for name in known.images_left_open]
    return replace(known, images=images or None, images_left_open=left_open)


def _records(
    run: Run, sides: Sequence[_Side], new_name: dict[str, str]
) -> tuple[dict[str, ImageRecord], ImageSet]:  # fmt: skip
    """All photographs by their names in the union, through links in the new workspace, and the set that they are."""
    first, second = sides
    root = (run.workspace.folder / PHOTOGRAPHS).absolute()
    link_photographs(root, {name: first.root / name for name in first.names})
    own = {new_name[name]: second.root / name for name in second.names if new_name[name] not in set(first.names)}
    link_photographs(root, own)
    found, report = load_found(
        f"{first.folder} and {second.folder}", Found(root, [root / name for name in (*first.names, *own)]),
        run.options.images, run.events, run.threads,
    )  # fmt: skip
    run.stages = replace(run.stages, images=report)
    records = {record.name: record for record in found.images}
    for side, names in ((first, {name: name for name in first.names}), (second, new_name)):
        for old, new in names.items():
            record = records.get(new)
            if record is None or record.digest != side.digests.get(old, record.digest):
                raise InputError(
                    f"{side.root / old}: expected it as {side.folder} was made of it, which is gone or has changed",
                    "bring it back, or reconstruct anew",
                )
    return records, found


def _union(
    sides: Sequence[_Side], new_name: dict[str, str], records: dict[str, ImageRecord], found: ImageSet
) -> tuple[ImageSet, list[ImageSet]]:
    """All photographs, those of the first one first with its cameras; and those of each as they were by themselves."""
    own = [
        [records[names.get(name, name)] for name in side.names]
        for side, names in zip(sides, ({}, new_name), strict=True)
    ]
    befores = [
        as_before(side.folder / DATABASE, side.names, those, found.cameras)
        for side, those in zip(sides, own, strict=True)
    ]
    taken, second = set(sides[0].names), befores[1]
    new = [
        (record, second.cameras[image.camera_idx])
        for record, image in zip(own[1], second.images, strict=True)
        if record.name not in taken
    ]
    union = with_new(befores[0], [record.camera_idx for record in own[0]], new)
    return replace(union, root=found.root), befores


def _take_over(
    run: Run, sides: Sequence[_Side], new_name: dict[str, str], befores: Sequence[ImageSet], keys: StageKeys
) -> NDArray[np.int32]:
    """Features and matches of both into the new database; pairs (P, 2) that were compared, i < j, sorted.

    Pairs whose photographs change their order are left to be matched again.
    """
    assert run.image_set is not None
    position = {name: i for i, name in enumerate(run.image_set.names)}
    known = np.zeros((0, 2), np.int32)
    with Database(run.workspace.database) as ours:
        ours.set_images(run.image_set.cameras, run.image_set.names, [one.camera_idx for one in run.image_set.images])
        stored = ours.feature_keys()
        for side, before, names in zip(sides, befores, ({}, new_name), strict=True):
            own = [names.get(name, name) for name in side.names]
            at = np.array([position[name] for name in own], np.int32)
            with Database(side.folder / DATABASE, read_only=True) as theirs:
                for i, key in theirs.feature_keys().items():
                    wanted = keys.of_features(own[i])
                    if key == wanted and stored.get(int(at[i])) != wanted:
                        ours.write_features(int(at[i]), theirs.read_features(i), wanted)
                        stored[int(at[i])] = wanted
                if side.manifest.stage("matching").key != stage_keys(run.options, before).matching:
                    continue
                held = [p for p, key in theirs.pair_keys().items() if key == side.manifest.stage("matching").key]
                pairs = np.array([p for p in held if at[p[0]] < at[p[1]]], np.int32).reshape(-1, 2)
                found = theirs.read_pairs(pairs)
            ours.write_pairs(replace(found, pair_image_idx=at[found.pair_image_idx]), keys.matching)
            known = np.concatenate([known, at[pairs]])
    return np.unique(known, axis=0).astype(np.int32).reshape(-1, 2)
