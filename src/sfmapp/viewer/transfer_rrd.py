"""Three photographs, the lines between them and the synthesised one as a rerun recording."""

from __future__ import annotations

import colorsys
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from sfmapp.viewer.rrd_file import recording_file
from sfmapp.viewer.transfer_replay import TransferReplay

_GREY, _QUALITY = (190, 190, 190), 88


def write_transfer_rrd(replay: TransferReplay, output: Path) -> None:
    """Write the photographs with points and epipolar lines, and what was synthesised beside what was taken."""
    count = max(len(replay.points), 1)
    colors = [tuple(round(255 * v) for v in colorsys.hsv_to_rgb(k / count, 0.75, 1.0)) for k in range(count)]
    with recording_file(output, "sfmapp_transfer", replay.title) as recording:
        recording.send_blueprint(_blueprint(replay), make_active=True, make_default=True)
        recording.log("story", rr.TextDocument(replay.story, media_type="text/markdown"), static=True)
        pictures = (replay.picture1, replay.picture2, replay.picture3)
        lines = ((), (replay.lines2,), (replay.lines31, replay.lines32))
        for n, (picture, sets) in enumerate(zip(pictures, lines, strict=True), 1):
            recording.log(f"photo{n}", rr.Image(picture).compress(jpeg_quality=_QUALITY), static=True)
            at = replay.points[:, n - 1]
            recording.log(f"photo{n}/points", rr.Points2D(at, colors=colors, radii=5.0), static=True)
            for k, ends in enumerate(sets):
                inside = np.isfinite(ends).all((1, 2))
                shown = [color for color, is_in in zip(colors, inside, strict=True) if is_in]
                strips = rr.LineStrips2D(list(ends[inside]), colors=shown, radii=1.0)
                recording.log(f"photo{n}/lines{k + 1}", strips, static=True)
        if np.isfinite(replay.plane).all():
            plane = rr.LineStrips2D(list(replay.plane), colors=[_GREY], radii=3.0, labels=["trifocal plane"])
            recording.log("photo3/plane", plane, static=True)
        recording.log("synthesised", rr.Image(replay.synthesised).compress(jpeg_quality=_QUALITY), static=True)


def _blueprint(replay: TransferReplay) -> rrb.Blueprint:
    photos = [rrb.Spatial2DView(origin=f"photo{n}", name=f"{n}: {name}") for n, name in enumerate(replay.names, 1)]
    below = [
        rrb.Spatial2DView(origin="synthesised", name="synthesised in the place of 3"),
        photos[2],
        rrb.TextDocumentView(origin="story", name="How well"),
    ]
    return rrb.Blueprint(
        rrb.Vertical(rrb.Horizontal(*photos[:2]), rrb.Horizontal(*below, column_shares=[3, 3, 1])),
        rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed"), auto_views=False,
    )  # fmt: skip
