"""Photographs and video into cameras, points and surfaces, on an ordinary CPU, from pip alone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sfmapp.kernel_cache import provide_kernel_cache

if TYPE_CHECKING:
    from sfmapp.camera.camera import Camera, CameraModel
    from sfmapp.pipelines.odometry.refine import RefineResult, refine
    from sfmapp.pipelines.odometry.track import TrackResult, track_sequence
    from sfmapp.pipelines.sparse.reconstruct import RunResult, reconstruct
    from sfmapp.pipelines.undistort import UndistortResult, undistort
    from sfmapp.scene.reconstruction import Reconstruction
    from sfmapp.workspace.options import Options, load_options

__version__ = "0.1.0"
__all__ = [
    "Camera",
    "CameraModel",
    "Options",
    "Reconstruction",
    "RefineResult",
    "RunResult",
    "TrackResult",
    "UndistortResult",
    "load_options",
    "reconstruct",
    "refine",
    "track_sequence",
    "undistort",
]

_HOMES = {
    "Camera": "sfmapp.camera.camera",
    "CameraModel": "sfmapp.camera.camera",
    "Options": "sfmapp.workspace.options",
    "Reconstruction": "sfmapp.scene.reconstruction",
    "RefineResult": "sfmapp.pipelines.odometry.refine",
    "RunResult": "sfmapp.pipelines.sparse.reconstruct",
    "TrackResult": "sfmapp.pipelines.odometry.track",
    "UndistortResult": "sfmapp.pipelines.undistort",
    "load_options": "sfmapp.workspace.options",
    "reconstruct": "sfmapp.pipelines.sparse.reconstruct",
    "refine": "sfmapp.pipelines.odometry.refine",
    "track_sequence": "sfmapp.pipelines.odometry.track",
    "undistort": "sfmapp.pipelines.undistort",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: ``import sfmapp`` alone is instant."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


provide_kernel_cache()
