"""How well the metres of a finished run are known, wherever it has them from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sfmapp.formats.text_input import read_json_object
from sfmapp.georeference.world_frame import read_georeference
from sfmapp.workspace.layout import MANIFEST, ODOMETRY, REPORT
from sfmapp.workspace.manifest import read_manifest

# the largest model of a run, of which this is said
_MODEL = 0


def metre_sigma_of_run(run: Path) -> float | None:
    """Standard deviation of lengths, as a share, of the model of a run that was put into the world, lies on control of
    a local frame, has its metres by known lengths, or is a track that has them; None where its unit is its own.

    Raises:
        InputError: what the run says of it is damaged.
    """
    placed = read_georeference(run)
    place = None if placed is None else placed.place_of(_MODEL)
    if place is not None:
        return place.scale_sigma_share
    if (run / MANIFEST).is_file() and (manifest := read_manifest(run)).command == ODOMETRY:
        maps = manifest.stage(ODOMETRY).maps
        return maps[_MODEL].scale_sigma if maps else None
    path = run / REPORT
    stages = read_json_object(path).get("stages") if path.is_file() else None
    if not isinstance(stages, dict):
        return None
    if (by_control := _sigma_by_control(stages.get("control"))) is not None:
        return by_control
    units = stages.get("units")
    scales = units.get("scales") if isinstance(units, dict) else None
    told = [one.get("sigma_share") for one in scales or () if isinstance(one, dict) and one.get("model") == _MODEL]
    return next((float(one) for one in told if isinstance(one, int | float)), None)


def _sigma_by_control(control: Any) -> float | None:
    """Of a model on control points that no coordinate system belongs to: what points that were left out are expected to
    be off by horizontally, over how far they are apart: somewhat more than what all together leave of the scale."""
    models = control.get("models") if isinstance(control, dict) else None
    for one in models or ():
        summary = one.get("summary")
        if one.get("model") != _MODEL or one.get("reason") or not isinstance(summary, dict):
            continue
        places = np.array([point["xyz_m"] for point in one["points"] if point["role"] == "control"])
        spread = float(np.sqrt(np.square(places - places.mean(0)).sum(1).mean())) if len(places) else 0.0
        return float(summary["expected_horizontal_m"]) / spread if spread > 0.0 else None
    return None
