"""Photographs and video into cameras, points and surfaces, on an ordinary CPU, from pip alone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sfmapp.pipelines.options import Options, load_options
    from sfmapp.pipelines.reconstruct import RunResult, reconstruct
    from sfmapp.scene.camera import Camera, CameraModel
    from sfmapp.scene.reconstruction import Reconstruction

__version__ = "0.1.0"
__all__ = ["Camera", "CameraModel", "Options", "Reconstruction", "RunResult", "load_options", "reconstruct"]

_HOMES = {
    "Camera": "sfmapp.scene.camera",
    "CameraModel": "sfmapp.scene.camera",
    "Options": "sfmapp.pipelines.options",
    "Reconstruction": "sfmapp.scene.reconstruction",
    "RunResult": "sfmapp.pipelines.reconstruct",
    "load_options": "sfmapp.pipelines.options",
    "reconstruct": "sfmapp.pipelines.reconstruct",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: ``import sfmapp`` alone is instant."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value
