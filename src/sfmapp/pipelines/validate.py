"""Doubt a result: pycolmap on the same photographs, and the ground truth where there is one, in one table."""

from __future__ import annotations

import hashlib
import json
import os
import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sfmapp.errors import InputError, InterruptedRunError, NoReconstructionError, SfmError
from sfmapp.evaluation.poses import AUC_THRESHOLDS_DEG, PoseErrors, compare_reconstructions, evaluate_poses
from sfmapp.evaluation.second_opinion import CameraGroup, SecondOpinion, SecondOpinionOptions, ask_second_opinion
from sfmapp.events import Events
from sfmapp.formats.colmap import has_model, read_model
from sfmapp.formats.ground_truth import GroundTruth, read_ground_truth
from sfmapp.images.folder import load_images
from sfmapp.pipelines.stored_pixels import check_pixels, ground_truth_in_stored_pixels
from sfmapp.workspace.layout import RECONSTRUCT
from sfmapp.workspace.manifest import read_manifest
from sfmapp.workspace.options import options_from_dict

if TYPE_CHECKING:
    from sfmapp.images.image_set import ImageOptions, ImageSet
    from sfmapp.scene.reconstruction import Reconstruction

FOLDER = "validation"
NOT_RECORDED = "not recorded"


@dataclass(frozen=True)
class Validation:
    """Two results on the same photographs, side by side.

    Attributes:
        ours, pycolmap: ``registered``, ``images``, ``points``, ``track_length``, ``reprojection_error_px`` (mean over
            the observations, by the same code for both), ``wall_s``, ``cpu_s``, ``peak_memory_mb`` (None: not recorded)
            and, with a ground truth, ``ground_truth`` as :meth:`PoseErrors.summary` gives it. ``pycolmap`` is None if
            it failed.
        agreement: of the poses after a robust similarity fit, pycolmap being the reference; None without two models.
        ground truth: name of the ground truth, None without.
        notes: what a reader of the table has to know.
    """

    ours: dict[str, Any]
    pycolmap: dict[str, Any] | None
    agreement: dict[str, Any] | None
    ground_truth: str | None
    notes: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return asdict(self)

    def table(self) -> str:
        """The comparison as plain text, 100 columns wide unless a path is longer; no newline at its end."""
        return "\n".join(table_lines(self))


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
        ground truth: COLMAP model, ``cameras.json`` or TUM trajectory; None: no ground truth.
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
    ours = _numbers(model, len(image_set.images)) | _own_usage(folder, notes)
    opinion = _ask(image_set, image_options, folder / FOLDER / "pycolmap", options, events, notes)
    theirs, agreement = None, None
    if opinion is not None:
        other = read_model(opinion.model_folder)[0] if opinion.model_folder else None
        theirs = _numbers(other, opinion.num_images) | {k: getattr(opinion, k) for k in _USAGE_KEYS}
        theirs |= {"phases": opinion.phases, "version": opinion.version, "options": opinion.options}
        if other is not None:
            agreement = compare_reconstructions(model, other).summary()
        if known_ground_truth is not None:
            theirs["ground_truth"] = _against(other, known_ground_truth).summary()
    if known_ground_truth is not None:
        ours["ground_truth"] = _against(model, known_ground_truth).summary()
        notes.append(
            "centre and rotation errors after a least-squares similarity fit to the ground truth; the AUC needs no fit"
        )
    result = Validation(ours, theirs, agreement, None if ground_truth is None else os.fspath(ground_truth), notes)
    _write_json(folder / FOLDER / "report.json", result.to_dict())
    return result


_USAGE_KEYS = ("wall_s", "cpu_s", "peak_memory_mb")


def _photographs(manifest: dict[str, Any], events: Events) -> tuple[ImageSet, ImageOptions]:
    """The photographs of the run, as it read them."""
    image_options = options_from_dict({"images": manifest.get("options", {}).get("images", {})}).images
    if not manifest.get("source"):
        raise InputError("run.json does not name the photographs", "run sfmapp reconstruct again")
    image_set = load_images(manifest["source"], image_options, events)[0]
    if not image_set.images:
        raise InputError(f"{manifest['source']}: the photographs of this run are gone")
    return image_set, image_options


def _changed_photographs(manifest: dict[str, Any], image_set: ImageSet) -> list[str]:
    """A note if these are not the files that our run saw."""
    seen = manifest.get("inputs")
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


def _numbers(model: Reconstruction | None, num_images: int) -> dict[str, Any]:
    """Counts and errors of a model, by the same code for both."""
    summary = model.summary() if model is not None else {}
    return {
        "registered": summary.get("num_registered", 0),
        "images": num_images,
        "points": summary.get("num_points", 0),
        "track_length": summary.get("mean_track_length"),
        "reprojection_error_px": summary.get("mean_reprojection_error_px"),
    }


def _own_usage(folder: Path, notes: list[str]) -> dict[str, float | None]:
    """Time and memory of our run as its report tells; None where it does not."""
    try:
        run = json.loads((folder / "report.json").read_text(encoding="utf-8")).get("run") or {}
    except (OSError, ValueError):
        run = {}
    if any(run.get(key) is None for key in _USAGE_KEYS):
        notes.append("the report of our run does not tell its time and memory")
    return {key: run.get(key) for key in _USAGE_KEYS}


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


def _write_json(path: Path, value: dict[str, Any]) -> None:
    from sfmapp.formats.atomic import replaced_file

    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced_file(path) as beside:
        beside.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


# ------------------------------------------------------------------------------------------------------------ the table


def table_lines(result: Validation) -> list[str]:
    """The comparison as lines of text: ours, pycolmap's and, where smaller is cheaper, their ratio."""
    ours, theirs = result.ours, result.pycolmap
    rows: list[tuple[str, str, str, str]] = [("", "sfmapp", "pycolmap" if theirs else "pycolmap failed", "")]

    def row(title: str, text: Any, ratio: str = "") -> None:
        rows.append((title, text(ours), text(theirs) if theirs else "-", ratio))

    row("registered images", lambda r: f"{r['registered']} of {r['images']}")
    row("points", lambda r: str(r["points"]))
    row("track length, mean", lambda r: _number(r["track_length"], ".2f"))
    row("reprojection error, mean", lambda r: _number(r["reprojection_error_px"], ".3f", " px"))
    for key, title, form, unit in (
        ("wall_s", "wall time", ".1f", " s"),
        ("cpu_s", "CPU time", ".1f", " s"),
        ("peak_memory_mb", "peak memory", ".0f", " MB"),
    ):
        row(title, lambda r, k=key, f=form, u=unit: _number(r[k], f, u, NOT_RECORDED), _ratio(ours, theirs, key))
    lines = _columns(rows)
    if result.agreement is not None:
        lines += ["", *_agreement_lines(result.agreement)]
    if result.ground_truth is not None:
        lines += [
            "",
            f"against {result.ground_truth}",
            *_columns(_ground_truth_rows(ours["ground_truth"], (theirs or {}).get("ground_truth"))),
        ]
    lines.append("")
    for note in result.notes:
        first, *more = note.splitlines()  # what pycolmap said before it fell over keeps its lines
        lines += textwrap.wrap(f"note: {first}", 100, subsequent_indent="  ", break_long_words=False)
        lines += [f"  {line}" for line in more]
    return lines


def _agreement_lines(agreement: dict[str, Any]) -> list[str]:
    common, outliers = agreement["num_common"], agreement["num_outliers"]
    if agreement["center_error"] is None:
        return [f"pose agreement: {common} common images, too few to align"]
    share, angle = agreement["center_error_share"], agreement["rotation_error_deg"]
    return [
        f"pose agreement after a similarity fit, {common} common images"
        + (f", {outliers} of them left out of the fit as outliers" if outliers else ""),
        f"  rotation   median {angle['median']:.4f} deg   worst {angle['max']:.4f} deg",
        f"  centre     median {100 * share['median']:.4f} %     worst {100 * share['max']:.4f} %   of the scene size",
    ]


def _ground_truth_rows(ours: dict[str, Any], theirs: dict[str, Any] | None) -> list[tuple[str, str, str, str]]:
    def pick(summary: dict[str, Any] | None, group: str, key: str, form: str, scale: float = 1.0) -> str:
        values = summary and summary[group]
        return _number(values[key] * scale, form) if values else "-"

    rows = []
    for title, group, key, form, scale in (
        ("centre error, mean", "center_error", "mean", ".5g", 1.0),
        ("centre error, median", "center_error", "median", ".5g", 1.0),
        ("centre error, worst", "center_error", "max", ".5g", 1.0),
        ("centre error, mean, % of scene", "center_error_share", "mean", ".4f", 100.0),
        ("rotation error, mean, deg", "rotation_error_deg", "mean", ".4f", 1.0),
        ("rotation error, worst, deg", "rotation_error_deg", "max", ".4f", 1.0),
    ):
        rows.append((title, pick(ours, group, key, form, scale), pick(theirs, group, key, form, scale), ""))
    for threshold in AUC_THRESHOLDS_DEG:
        title, key = f"AUC at {threshold:g} deg, all pairs", f"{threshold:g}"
        rows.append((title, pick(ours, "auc", key, ".4f"), pick(theirs, "auc", key, ".4f"), ""))
    return rows


def _columns(rows: Sequence[tuple[str, str, str, str]]) -> list[str]:
    return [f"{title:<32}{ours:>16}{theirs:>16}   {ratio}".rstrip() for title, ours, theirs, ratio in rows]


def _number(value: float | None, form: str, unit: str = "", missing: str = "-") -> str:
    return missing if value is None else f"{value:{form}}{unit}"


def _ratio(ours: dict[str, Any], theirs: dict[str, Any] | None, key: str) -> str:
    if theirs is None or not ours[key] or not theirs[key]:
        return ""
    return (
        f"{theirs[key] / ours[key]:.2f} x less" if theirs[key] >= ours[key] else f"{ours[key] / theirs[key]:.2f} x more"
    )
