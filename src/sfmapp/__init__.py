"""Photographs and video into cameras, points and surfaces, on an ordinary CPU, from pip alone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sfmapp.kernel_cache import provide_kernel_cache

if TYPE_CHECKING:
    from sfmapp.camera.camera import Camera, CameraModel
    from sfmapp.pipelines.odometry import TrackResult, track_sequence
    from sfmapp.pipelines.options import Options, load_options
    from sfmapp.pipelines.reconstruct import RunResult, reconstruct
    from sfmapp.pipelines.refine import RefineResult, refine
    from sfmapp.pipelines.undistort import UndistortResult, undistort
    from sfmapp.scene.reconstruction import Reconstruction

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
    "Options": "sfmapp.pipelines.options",
    "Reconstruction": "sfmapp.scene.reconstruction",
    "RefineResult": "sfmapp.pipelines.refine",
    "RunResult": "sfmapp.pipelines.reconstruct",
    "TrackResult": "sfmapp.pipelines.odometry",
    "UndistortResult": "sfmapp.pipelines.undistort",
    "load_options": "sfmapp.pipelines.options",
    "reconstruct": "sfmapp.pipelines.reconstruct",
    "refine": "sfmapp.pipelines.refine",
    "track_sequence": "sfmapp.pipelines.odometry",
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
