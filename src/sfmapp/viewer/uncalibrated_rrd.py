"""The clouds of a model without a calibration as a rerun recording."""

from __future__ import annotations

from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from sfmapp.viewer.rrd_file import recording_file
from sfmapp.viewer.uncalibrated_replay import CloudsReplay

_RED, _NAMES = (255, 85, 72), {"found": "as it was found", "mapped": "the same pixels: under a map of space"}


def write_clouds_rrd(replay: CloudsReplay, output: Path) -> None:
    """Write the projective model, its image under a map of space, and the metric one with its cameras."""
    sets = {"found": replay.found, "mapped": replay.mapped}
    if len(replay.metric):
        sets["metric"] = replay.metric
    with recording_file(output, "sfmapp_uncalibrated", replay.title) as recording:
        views = [
            rrb.Spatial3DView(origin=name, name=_NAMES.get(name, "metric"), line_grid=False) for name in sets
        ]  # fmt: skip
        blueprint = rrb.Blueprint(
            rrb.Horizontal(*views), rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"),
            rrb.TimePanel(state="collapsed"), auto_views=False,
        )  # fmt: skip
        recording.send_blueprint(blueprint, make_active=True, make_default=True)
        for name, xyz in sets.items():
            recording.log(f"{name}/points", rr.Points3D(xyz, colors=replay.rgb, radii=0.006), static=True)
        if len(replay.centers):
            recording.log("metric/cameras", rr.Points3D(replay.centers, colors=[_RED], radii=0.05), static=True)
