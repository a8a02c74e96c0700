"""What each stage of a reconstruction depends on, as hashes. A stage whose key is unchanged need not run again."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from sfmapp.workspace.keys import input_key, stage_key
from sfmapp.workspace.options import Options, options_to_dict

if TYPE_CHECKING:
    from sfmapp.formats.control_points import ControlPoints
    from sfmapp.georeference.poses.stage import PoseFile
    from sfmapp.images.image_set import ImageSet


# where the stages begin; :mod:`sfmapp.workspace.code` finds what they import
FEATURES, PAIRS, MATCHING = ("sfmapp.features.extract",), ("sfmapp.matching.pairs",), ("sfmapp.matching.stage",)
MAPPING = (
    "sfmapp.mapping.incremental", "sfmapp.formats.colmap", "sfmapp.georeference.stage",
    "sfmapp.georeference.control.stage", "sfmapp.georeference.poses.stage", "sfmapp.mapping.known_poses",
    "sfmapp.pipelines.sparse.units",
)  # fmt: skip


@dataclass(frozen=True)
class StageKeys:
    """Keys of the stages, and of what each image brings to its features.

    Attributes:
        inputs: by image name; features of an image hold as long as its entry and ``features`` do.
        features, pairs, matching, mapping: keys of the stages. Threads and ``min_registered`` are in none of them.
    """

    inputs: dict[str, str]
    features: str
    pairs: str
    matching: str
    mapping: str

    def of_features(self, name: str) -> str:
        """Key of the features of an image."""
        return f"{self.features}:{self.inputs[name]}"


def stage_keys(
    options: Options, image_set: ImageSet, control: ControlPoints | None = None, poses: PoseFile | None = None
) -> StageKeys:
    """Keys of all stages for these photographs, options, ground control points and known poses."""
    inputs = {record.name: input_key(record) for record in image_set.images}
    features = stage_key(FEATURES, options.features)
    images = [features, list(inputs.items()), options.seed]
    lenses = [[camera.model.name, camera.width, camera.height, camera.params.tolist()] for camera in image_set.cameras]
    priors = [
        [
            camera.focal_sigma, camera.focal_source, camera.is_fixed,
            None if camera.prior_covariance is None else camera.prior_covariance.tolist(),
        ]
        for camera in image_set.cameras
    ]  # fmt: skip
    whose = [record.camera_idx for record in image_set.images]
    places = [[record.timestamp, record.gps] for record in image_set.images]
    pairs = stage_key(PAIRS, options.pairs, images, places)
    matching = stage_key(MATCHING, options.matching, images, lenses, whose)
    measured = [record.position and asdict(record.position) for record in image_set.images]
    adjust = options_to_dict(options.adjust)
    world = [options_to_dict(options.gps), measured, _control_key(control), options_to_dict(options.units)]
    if poses is not None:
        world.append([options_to_dict(options.poses), poses.cam_from_world.tolist()])
    mapping = stage_key(MAPPING, options.mapping, adjust, pairs, matching, priors, world)
    return StageKeys(inputs, features, pairs, matching, mapping)


def _control_key(control: ControlPoints | None) -> list[object]:
    """What of control points decides results."""
    if control is None:
        return []
    arrays = (control.xyz, control.sigma_m, control.obs_point_idx, control.obs_image_idx, control.obs_xy,
              control.obs_sigma_px)  # fmt: skip
    return [control.crs, list(control.names), *(array.tolist() for array in arrays)]
