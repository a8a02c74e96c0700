"""Hold a result against pycolmap on the same photographs and, where there is one, ground truth, in one table."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sfmapp.errors import InputError, InterruptedRunError, NoReconstructionError, SfmError
from sfmapp.evaluation.poses import PoseErrors, compare_reconstructions, evaluate_poses
from sfmapp.evaluation.report import PoseErrorSummary
from sfmapp.evaluation.second_opinion import CameraGroup, SecondOpinion, SecondOpinionOptions, ask_second_opinion
from sfmapp.events import Events
from sfmapp.formats.atomic import replaced_file
from sfmapp.formats.colmap import has_model, read_model
from sfmapp.formats.ground_truth import GroundTruth, read_ground_truth
from sfmapp.images.folder import load_images
from sfmapp.images.products import IN_MEMORY
from sfmapp.pipelines.stored_pixels import check_pixels, ground_truth_in_stored_pixels
from sfmapp.report.validation import PycolmapSide, Side, Validation
from sfmapp.reporting import Usage, to_json
from sfmapp.workspace.layout import MANIFEST, RECONSTRUCT, REPORT
from sfmapp.workspace.manifest import Manifest, read_manifest
from sfmapp.workspace.options import options_from_dict

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageOptions, ImageSet
    from sfmapp.scene.reconstruction import Reconstruction

FOLDER = "validation"


def validate(
    output: str | os.PathLike[str],
    ground_truth: str | os.PathLike[str] | None = None,
    *,
    options: SecondOpinionOptions | None = None,
    events: Events | None = None,
) -> Validation:
    """Compare the largest model of a workspace with pycolmap's on the same photographs, and both with a ground truth.

    pycolmap's result is kept in ``OUT/validation/pycolmap`` and used again while photographs and options are the same.
    ``OUT/validation/report.json`` holds the comparison.

    Args:
        output: the workspace of a run.
        ground_truth: COLMAP model, ``cameras.json`` or TUM trajectory; None: no ground truth.
        options: of pycolmap; None: its defaults, but with the camera model, the sharing and the intrinsics that the
            user gave to our run.
        events: progress and cancellation.

    Raises:
        InputError: no workspace, no ground truth, or the photographs are gone.
        NoReconstructionError: the workspace holds no model.
        InterruptedRunError: ``events`` was asked to stop.
    """
    events, folder = events or Events(), Path(output)
    manifest = read_manifest(folder, RECONSTRUCT)
    check_pixels(folder, manifest)
    model_folder = folder / "sparse" / "0"
    if not has_model(model_folder):
        raise NoReconstructionError(f"{folder} holds no model to validate", "run sfmapp reconstruct first")
    known_ground_truth = read_ground_truth(Path(ground_truth)) if ground_truth is not None else None
    model = read_model(model_folder)[0]
    image_set, image_options = _photographs(manifest, events)
    notes = _changed_photographs(manifest, image_set)
    if known_ground_truth is not None:
        known_ground_truth = _ground_truth_of_photographs(known_ground_truth, image_set, notes)
        orientations = {image.name: image.orientation for image in image_set.images}
        known_ground_truth = ground_truth_in_stored_pixels(known_ground_truth, model, orientations, notes)
    ours = _side(model, len(image_set.images), _own_usage(manifest, notes))
    opinion = _ask(image_set, image_options, folder / FOLDER / "pycolmap", options, events, notes)
    theirs: PycolmapSide | None = None
    agreement: PoseErrorSummary | None = None
    if opinion is not None:
        other = read_model(opinion.model_folder)[0] if opinion.model_folder else None
        theirs = PycolmapSide(
            **_side(other, opinion.num_images, {key: getattr(opinion, key) for key in _USAGE_KEYS}),
            phases={name: Usage(wall_s=t["wall_s"], cpu_s=t["cpu_s"]) for name, t in opinion.phases.items()},
            version=opinion.version,
            options=opinion.options,
        )
        if other is not None:
            agreement = compare_reconstructions(model, other).summary()
        if known_ground_truth is not None:
            theirs = replace(theirs, ground_truth=_against(other, known_ground_truth).summary())
    if known_ground_truth is not None:
        ours = replace(ours, ground_truth=_against(model, known_ground_truth).summary())
        notes.append(
            "centre and rotation errors after a least-squares similarity fit to the ground truth; the AUC needs no fit"
        )
    result = Validation(ours, theirs, agreement, None if ground_truth is None else os.fspath(ground_truth), notes)
    (folder / FOLDER).mkdir(exist_ok=True)
    with replaced_file(folder / FOLDER / REPORT) as beside:
        beside.write_text(to_json(result, indent=1) + "\n", encoding="utf-8")
    return result


_USAGE_KEYS = ("wall_s", "cpu_s", "peak_memory_mb")


def _photographs(manifest: Manifest, events: Events) -> tuple[ImageSet, ImageOptions]:
    """The photographs of the run, as it read them."""
    image_options = options_from_dict({"images": manifest.options.get("images", {})}).images
    if not manifest.source:
        raise InputError("run.json does not name the photographs", "run sfmapp reconstruct again")
    if manifest.source == IN_MEMORY:
        raise InputError(
            "the photographs of this run were arrays in memory, and pycolmap reads files",
            "write them as files, and run sfmapp reconstruct on their folder",
        )
    image_set = load_images(manifest.source, image_options, events)[0]
    if not image_set.images:
        raise InputError(f"{manifest.source}: the photographs of this run are gone")
    return image_set, image_options


def _changed_photographs(manifest: Manifest, image_set: ImageSet) -> list[str]:
    """A note if these are not the files that our run saw."""
    seen = manifest.inputs
    if not seen:
        return []
    # a key is the digest of the file, and what masks it
    changed = [image.name for image in image_set.images if not str(seen.get(image.name, "")).startswith(image.digest)]
    changed += sorted(set(seen) - {image.name for image in image_set.images})
    if not changed:
        return []
    return [f"{len(changed)} photographs are not what they were in our run, {changed[0]} for one: run it again"]


def _ask(
    image_set: ImageSet,
    image_options: ImageOptions,
    output: Path,
    options: SecondOpinionOptions | None,
    events: Events,
    notes: list[str],
) -> SecondOpinion | None:
    """pycolmap's opinion; None, and a note, if it fails: our own numbers are worth printing all the same."""
    assert image_set.root is not None  # photographs of a workspace are files
    if options is None:
        options = SecondOpinionOptions(
            camera_model=image_options.camera_model.name,
            fix_intrinsics=image_options.fix_intrinsics,
            mask_root=image_options.mask_path,
        )
    groups = _camera_groups(image_set, image_options)
    sharing = "cameras shared as in our run" if groups else f"camera mode {options.camera_mode} (its default)"
    notes.append(f"pycolmap ran with its defaults: extraction, exhaustive matching, mapping; {sharing}")
    if image_options.mask_path is not None:
        notes.append("pycolmap finds masks named NAME.png only, with the full name of the photograph")
    digest = hashlib.blake2b("".join(image.digest for image in image_set.images).encode(), digest_size=16)
    try:
        return ask_second_opinion(
            image_set.root,
            image_set.names,
            output,
            options,
            camera_groups=groups,
            fingerprint=digest.hexdigest(),
            events=events,
        )
    except InterruptedRunError:
        raise
    except SfmError as error:
        notes.append(f"no second opinion: {error}")
        events.warned("validate", f"no second opinion: {error}")
        return None


def _camera_groups(image_set: ImageSet, image_options: ImageOptions) -> list[CameraGroup] | None:
    """Our cameras where the user has said something about them; else None, and pycolmap decides for itself."""
    is_given = any(
        known is not None for known in (image_options.camera, image_options.camera_params, image_options.focal_px)
    )
    if image_options.camera_sharing == "auto" and not is_given and not image_options.fix_intrinsics:
        return None
    return [
        CameraGroup(
            tuple(image.name for image in image_set.images if image.camera_idx == idx),
            tuple(camera.params.tolist()) if is_given or camera.is_fixed else None,
            camera.model.name,
        )
        for idx, camera in enumerate(image_set.cameras)
    ]


def _side(model: Reconstruction | None, num_images: int, usage: Mapping[str, float | None]) -> Side:
    """Counts and errors of a model, by the same code for both, and what it took."""
    summary = model.summary() if model is not None else None
    return Side(
        registered=summary.num_registered if summary else 0,
        images=num_images,
        points=summary.num_points if summary else 0,
        track_length=summary.mean_track_length if summary else None,
        reprojection_error_px=summary.mean_reprojection_error_px if summary else None,
        wall_s=usage.get("wall_s"),
        cpu_s=usage.get("cpu_s"),
        peak_memory_mb=usage.get("peak_memory_mb"),
    )


def _own_usage(manifest: Manifest, notes: list[str]) -> Mapping[str, float | None]:
    """Time and memory of our run as the manifest tells; None where it does not."""
    run: Mapping[str, float | None] = manifest.stage("mapping").run or {}
    if any(run.get(key) is None for key in _USAGE_KEYS):
        notes.append(f"{MANIFEST} of our run does not tell its time and memory")
    return run


def _against(model: Reconstruction | None, ground_truth: GroundTruth) -> PoseErrors:
    if model is None:
        return evaluate_poses([], [], ground_truth.names, ground_truth.cam_from_world)
    return evaluate_poses(model.image_names, model.cam_from_world, ground_truth.names, ground_truth.cam_from_world)


def _ground_truth_of_photographs(ground_truth: GroundTruth, image_set: ImageSet, notes: list[str]) -> GroundTruth:
    """The entries that have a photograph, under its name: a trajectory may hold many more than were ever given."""
    names = [image.name for image in image_set.images]
    ground_truth = ground_truth.for_images(names)
    ours = set(names)
    kept = [k for k, name in enumerate(ground_truth.names) if name in ours]
    if len(kept) < len(ground_truth.names):
        notes.append(
            f"{len(ground_truth.names) - len(kept)} entries of the ground truth have no photograph and are left out"
        )
    if len(kept) < len(names):
        notes.append(f"{len(names) - len(kept)} photographs are not in the ground truth and are left out of its errors")
    return replace(
        ground_truth, names=tuple(ground_truth.names[k] for k in kept), cam_from_world=ground_truth.cam_from_world[kept]
    )
