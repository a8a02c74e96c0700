"""Photographs under one light at a time, and where the lights were: a JSON file of ours.

    {"lit": "camera_light/", "sharpest_edge_deg": 60,
     "lights": [{"name": "left", "photographs": "left/", "position": [-1.2, -0.4, 0.1], "frame": "camera"},
                {"name": "lamp", "photographs": "lamp/", "position": [0.3, 2.0, 1.5], "frame": "world"}]}

Folders are relative to the file and hold photographs named as those of the cameras. ``lit`` has those that are lit from
the camera; without it the photographs that are carved are taken for these. Positions are in units of the world, in the
frame of the world, or in that of each camera (x to the right, y down, z ahead) for lights that stand beside a camera
before a turntable. ``sharpest_edge_deg``, if it is known, is the least interior angle of the object's edges.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.errors import InputError
from sfmapp.formats.text_input import finite_array, read_json_object

_FRAMES = ("world", "camera")
_ADVICE = '{"lights": [{"name": "left", "photographs": "left/", "position": [x, y, z], "frame": "world"}]}'


@dataclass(frozen=True)
class Light:
    """Attributes:
    name: for reports.
    photographs: folder.
    position: (3,) units of the world.
    is_with_camera: in the frame of each camera rather than the world's.
    """

    name: str
    photographs: Path
    position: NDArray[np.float64]
    is_with_camera: bool


@dataclass(frozen=True)
class LightsFile:
    """Attributes:
    lit: folder of photographs lit from the camera, None where it is not said.
    lights: one or more.
    sharpest_edge_deg: of the object, degrees; None where it is not said.
    """

    lit: Path | None
    lights: list[Light]
    sharpest_edge_deg: float | None


def read_lights(path: Path) -> LightsFile:
    """What a file says.

    Raises:
        InputError: names the file, what was expected and what was found; also for folders that are not there.
    """
    document = read_json_object(path)
    entries = document.get("lights")
    if not isinstance(entries, list) or not entries:
        raise InputError(f'{path}: expected a list of lights under "lights", found {entries!r}', f"write {_ADVICE}")
    lights = [_light(path, n, entry) for n, entry in enumerate(entries)]
    lit, edge = document.get("lit"), document.get("sharpest_edge_deg")
    if edge is not None and not (isinstance(edge, int | float) and 0.0 <= edge <= 90.0):
        raise InputError(f"{path}: sharpest_edge_deg: expected degrees from 0 to 90, found {edge!r}")
    return LightsFile(None if lit is None else _folder(path, "lit", lit), lights, None if edge is None else float(edge))


def _light(path: Path, n: int, entry: Any) -> Light:
    place = f"{path}: light {n + 1}"
    if not isinstance(entry, Mapping):
        raise InputError(f"{place}: expected an object, found {type(entry).__name__}", f"write {_ADVICE}")
    missing = [key for key in ("photographs", "position") if key not in entry]
    if missing:
        raise InputError(f'{place}: expected "{missing[0]}", found {", ".join(entry) or "nothing"}', f"write {_ADVICE}")
    frame = entry.get("frame", "world")
    if frame not in _FRAMES:
        raise InputError(f"{place}: expected a frame of {' or '.join(_FRAMES)}, found {frame!r}")
    folder = _folder(path, f"light {n + 1}", entry["photographs"])
    position = finite_array(f"{place}: position", entry["position"], (3,))
    return Light(str(entry.get("name", folder.name)), folder, position, frame == "camera")


def _folder(path: Path, what: str, value: Any) -> Path:
    folder = path.parent / value if isinstance(value, str) else None
    if folder is None or not folder.is_dir():
        raise InputError(f"{path}: {what}: expected a folder of photographs beside the file, found {value!r}")
    return folder
