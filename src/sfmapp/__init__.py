"""Photographs and video into cameras, points and surfaces, on an ordinary CPU, from pip alone.

Three levels. One call: ``reconstruct``, ``track_sequence``, ``densify``, ``make_mesh``, what is done with their
results, ``stitch_panorama``, ``explain_pair``, ``match_stereo``, ``carve_volume``, and what is known before:
``calibrate_board`` and its like. The stages, in memory: ``load_images``, ``extract_features``, ``match_images``,
``map_images``. The parts: ``adjust_bundle``, ``FactorGraph``, ``triangulate``, ``estimate_pose``, ``verify_pair``.

Conventions: a pose ``cam_from_world`` is a quaternion x, y, z, w and a translation, x_cam = R x_world + t, with camera
axes x right, y down, z forward. The centre of the top-left pixel is (0.5, 0.5). ``events``, ``threads`` and ``seed``
can always be left out; of these, results depend on the seed alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sfmapp.kernel_cache import provide_kernel_cache

if TYPE_CHECKING:
    from sfmapp.adjust.graph import FactorGraph
    from sfmapp.adjust.options import AdjustOptions
    from sfmapp.api.calibration import (
        calibrate_board,
        calibrate_lines,
        calibrate_rig,
        calibrate_target,
        compare_cameras,
        locate,
    )
    from sfmapp.api.geometry import adjust_bundle, estimate_pose, triangulate, verify_pair
    from sfmapp.api.images import load_images
    from sfmapp.api.jobs import (
        RunResult,
        TrackResult,
        densify,
        evaluate,
        export,
        locate_photographs,
        make_mesh,
        merge,
        plan,
        reconstruct,
        refine,
        stitch_panorama,
        track_sequence,
        undistort,
        validate,
    )
    from sfmapp.api.live import LiveOdometry
    from sfmapp.api.planes import rectify, warp_picture
    from sfmapp.api.reconstruction import Reconstruction, load
    from sfmapp.api.stages import Matcher, extract_features, map_images, match_images
    from sfmapp.api.views import explain_pair, match_stereo, reconstruct_uncalibrated, transfer_views
    from sfmapp.api.volumes import carve_volume, find_masks
    from sfmapp.camera.camera import Camera
    from sfmapp.camera.names import CameraModel
    from sfmapp.errors import (
        InputError,
        InterruptedRunError,
        NoReconstructionError,
        SfmError,
        TooFewImagesError,
        UsageError,
    )
    from sfmapp.events import Event, Events
    from sfmapp.features.extract import FeatureOptions
    from sfmapp.geometry.rigid3 import Rigid3
    from sfmapp.images.array_sequence import ArraySequence
    from sfmapp.images.image_set import ImageOptions, ImageSet, ImageSource
    from sfmapp.images.sequence import Imu
    from sfmapp.mapping.options import MappingOptions
    from sfmapp.matching.options import MatchingOptions
    from sfmapp.matching.pairs import PairOptions
    from sfmapp.scene.correspondences import Correspondences
    from sfmapp.scene.features import DescriptorMetric, Features
    from sfmapp.scene.rig import Rig
    from sfmapp.scene.tracks import Tracks
    from sfmapp.workspace.options import Options, load_options

__version__ = "0.1.0"
__all__ = [
    "AdjustOptions",
    "ArraySequence",
    "Camera",
    "CameraModel",
    "Correspondences",
    "DescriptorMetric",
    "Event",
    "Events",
    "FactorGraph",
    "FeatureOptions",
    "Features",
    "ImageOptions",
    "ImageSet",
    "ImageSource",
    "Imu",
    "InputError",
    "InterruptedRunError",
    "LiveOdometry",
    "MappingOptions",
    "Matcher",
    "MatchingOptions",
    "NoReconstructionError",
    "Options",
    "PairOptions",
    "Reconstruction",
    "Rig",
    "Rigid3",
    "RunResult",
    "SfmError",
    "TooFewImagesError",
    "TrackResult",
    "Tracks",
    "UsageError",
    "adjust_bundle",
    "calibrate_board",
    "calibrate_lines",
    "calibrate_rig",
    "calibrate_target",
    "carve_volume",
    "compare_cameras",
    "densify",
    "estimate_pose",
    "evaluate",
    "explain_pair",
    "export",
    "extract_features",
    "find_masks",
    "load",
    "load_images",
    "load_options",
    "locate",
    "locate_photographs",
    "make_mesh",
    "map_images",
    "match_images",
    "match_stereo",
    "merge",
    "plan",
    "reconstruct",
    "reconstruct_uncalibrated",
    "rectify",
    "refine",
    "stitch_panorama",
    "track_sequence",
    "transfer_views",
    "triangulate",
    "undistort",
    "validate",
    "verify_pair",
    "warp_picture",
]

_HOMES = {
    "AdjustOptions": "adjust.options",
    "ArraySequence": "images.array_sequence",
    "Camera": "camera.camera",
    "CameraModel": "camera.names",
    "Correspondences": "scene.correspondences",
    "DescriptorMetric": "scene.features",
    "Event": "events",
    "Events": "events",
    "FactorGraph": "adjust.graph",
    "FeatureOptions": "features.extract",
    "Features": "scene.features",
    "ImageOptions": "images.image_set",
    "ImageSet": "images.image_set",
    "ImageSource": "images.image_set",
    "Imu": "images.sequence",
    "InputError": "errors",
    "InterruptedRunError": "errors",
    "MappingOptions": "mapping.options",
    "Matcher": "api.stages",
    "MatchingOptions": "matching.options",
    "NoReconstructionError": "errors",
    "Options": "workspace.options",
    "PairOptions": "matching.pairs",
    "Reconstruction": "api.reconstruction",
    "Rig": "scene.rig",
    "Rigid3": "geometry.rigid3",
    "RunResult": "api.jobs",
    "SfmError": "errors",
    "TooFewImagesError": "errors",
    "TrackResult": "api.jobs",
    "Tracks": "scene.tracks",
    "UsageError": "errors",
    "adjust_bundle": "api.geometry",
    "calibrate_board": "api.calibration",
    "calibrate_lines": "api.calibration",
    "calibrate_rig": "api.calibration",
    "calibrate_target": "api.calibration",
    "carve_volume": "api.volumes",
    "compare_cameras": "api.calibration",
    "densify": "api.jobs",
    "estimate_pose": "api.geometry",
    "evaluate": "api.jobs",
    "explain_pair": "api.views",
    "find_masks": "api.volumes",
    "export": "api.jobs",
    "extract_features": "api.stages",
    "LiveOdometry": "api.live",
    "load": "api.reconstruction",
    "load_images": "api.images",
    "load_options": "workspace.options",
    "locate": "api.calibration",
    "locate_photographs": "api.jobs",
    "make_mesh": "api.jobs",
    "merge": "api.jobs",
    "plan": "api.jobs",
    "map_images": "api.stages",
    "match_images": "api.stages",
    "match_stereo": "api.views",
    "reconstruct": "api.jobs",
    "reconstruct_uncalibrated": "api.views",
    "rectify": "api.planes",
    "refine": "api.jobs",
    "stitch_panorama": "api.jobs",
    "track_sequence": "api.jobs",
    "transfer_views": "api.views",
    "triangulate": "api.geometry",
    "undistort": "api.jobs",
    "validate": "api.jobs",
    "verify_pair": "api.geometry",
    "warp_picture": "api.planes",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: ``import sfmapp`` alone is instant."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """What is promised, and no more."""
    return sorted([*__all__, "__version__"])


provide_kernel_cache()
