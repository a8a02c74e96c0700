"""Models count in the pixels of the files, whatever their EXIF orientation; others do not, and must not be mixed up.

Others are workspaces of earlier versions, which counted in pictures turned upright, and true cameras of such pictures.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sfmapp.errors import InputError, SfmError
from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.geometry import rigid3
from sfmapp.geometry.orientation import INVERSE, MIRRORED, ROTATION_OF, upright_poses
from sfmapp.workspace.layout import REPORT
from sfmapp.workspace.manifest import Manifest, read_json, read_manifest

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sfmapp.formats.ground_truth import GroundTruth
    from sfmapp.images.image_set import ImageRecord
    from sfmapp.scene.reconstruction import Reconstruction

# what the mapping notes of its model in the manifest; earlier versions noted nothing
STORED = "stored"
# where the ground truth is of pictures that were turned, turning it back leaves this share of the rotation errors at
# most
_TURNED_SHARE = 0.2


def has_stored_pixels(manifest: Manifest) -> bool:
    """Whether the model of a reconstruction counts in the pixels of the files."""
    return manifest.stage("mapping").pixels == STORED


def noted_orientations(images: Iterable[ImageRecord]) -> dict[str, int]:
    """What a reconstruction notes in the manifest: EXIF orientation by name, of photographs that it turns."""
    return {image.name: image.orientation for image in images if image.orientation != 1}


def orientations_of(folder: Path) -> dict[str, int]:
    """EXIF orientation of the photographs of a reconstruction that it turns, by name; empty where it is not known."""
    try:
        noted = read_manifest(folder).stage("mapping").orientations
    except SfmError:
        return {}
    return dict(noted or {})


def _orientations_of_earlier_version(folder: Path) -> dict[str, int]:
    """The same of a version that noted none: its report alone tells."""
    report = read_json(folder / REPORT)
    try:
        rows = report["stages"]["images"]["images"]
        return {str(row["name"]): int(row["orientation"]) for row in rows}
    except (KeyError, TypeError, ValueError):
        return {}


def check_pixels(folder: Path, manifest: Manifest) -> None:
    """The model of a workspace has to fit its photographs as other programs read them.

    Raises:
        InputError: it was made by a version that turned pictures upright, and there were some to turn.
    """
    if has_stored_pixels(manifest):
        return
    turned = [name for name, held in _orientations_of_earlier_version(folder).items() if held != 1]
    if turned:
        raise InputError(
            f"{folder}: expected a model in the pixels of the files, found one of an earlier version of sfmapp, which "
            f"turned {len(turned)} of the photographs upright as EXIF says, {turned[0]} for one",
            f"run it again: sfmapp reconstruct {manifest.source or 'PHOTOS'} -o {folder}",
        )


def ground_truth_in_stored_pixels(
    ground_truth: GroundTruth, model: Reconstruction, orientations: Mapping[str, int], notes: list[str]
) -> GroundTruth:
    """The same cameras with axes along those of the files, if they evidently are those of pictures turned upright.

    Args:
        ground_truth: with the names of the photographs.
        model: whose errors tell.
        orientations: EXIF's, by name of the photograph.
        notes: told if the ground truth was turned.
    """
    held = [orientations.get(name, 1) for name in ground_truth.names]
    if not held or all(orientation == 1 for orientation in held):
        return ground_truth
    poses, is_mirrored = ground_truth.cam_from_world, all(orientation in MIRRORED for orientation in held)
    if is_mirrored:  # and so is the world that their model is of
        mirror = np.diag([-1.0, 1.0, 1.0])
        poses = rigid3.from_matrix(mirror @ rigid3.rotation_matrix(poses) @ mirror, poses[:, 4:] @ mirror)
    poses = upright_poses(poses, [INVERSE[ROTATION_OF[orientation]] for orientation in held])
    as_given, as_stored = (
        _rotation_error(model, ground_truth, known) for known in (ground_truth.cam_from_world, poses)
    )
    if not as_stored < _TURNED_SHARE * as_given:
        return ground_truth
    notes.append(
        "the ground truth is of pictures turned upright as EXIF says: its cameras were turned back to the "
        "pixels of the files"
        + (", and mirrored as these are" if is_mirrored else "")
        + f" (median rotation error {as_stored:.3g} degrees, as given {as_given:.3g})"
    )
    return replace(ground_truth, cam_from_world=poses)


def _rotation_error(model: Reconstruction, ground_truth: GroundTruth, poses: NDArray[np.float64]) -> float:
    """Median in degrees; NaN without two common images."""
    errors = evaluate_poses(model.image_names, model.cam_from_world, ground_truth.names, poses).rotation_error_deg
    known = errors[np.isfinite(errors)]
    return float(np.median(known)) if len(known) else np.nan
