"""A stereo pair as a rerun recording: cameras, cloud, maps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from sfmapp.viewer.rrd_file import recording_file
from sfmapp.viewer.stereo_replay import StereoReplay

_QUALITY, _BLUE, _LINE_WIDTH = 90, (70, 150, 255), -1.0
_MAPS = {
    "disparity": "disparity",
    "sigma": "sigma of disparity, bright is bad",
    "confidence": "confidence, bright is good",
}


def write_stereo_rrd(replay: StereoReplay, output: Path) -> None:
    """Write the cloud in colours of the photograph and of its sigma, both cameras with their pictures, and the maps."""
    has_points = len(replay.xyz) > 0
    with recording_file(output, "sfmapp_stereo", replay.title) as recording:
        recording.send_blueprint(_blueprint(replay), make_active=True, make_default=True)
        recording.log("story", rr.TextDocument(replay.story, media_type="text/markdown"), static=True)
        for name in _MAPS:
            picture = rr.Image(getattr(replay, name)).compress(jpeg_quality=_QUALITY)
            recording.log(f"maps/{name}", picture, static=True)
        for name, picture in (("left", replay.left), ("right", replay.right)):
            recording.log(f"photos/{name}", rr.Image(picture).compress(jpeg_quality=_QUALITY), static=True)
        if has_points:
            recording.log("scene", rr.ViewCoordinates.RDF, static=True)
            # a point is as large as the pixel that saw it
            radii = 0.6 * replay.xyz[:, 2] / replay.pinhole[0] * np.sqrt(replay.left[:, :, 0].size / len(replay.xyz))
            for name, colors in (("cloud", replay.rgb), ("sigma", replay.sigma_rgb)):
                recording.log(f"scene/{name}", rr.Points3D(replay.xyz, colors=colors, radii=radii), static=True)
            _draw_cameras(recording, replay)


def _draw_cameras(recording: rr.RecordingStream, replay: StereoReplay) -> None:
    focal, cx, cy, doffs = replay.pinhole
    length = 0.6 * replay.baseline
    for name, picture, x, shift in (("left", replay.left, 0.0, 0.0), ("right", replay.right, replay.baseline, doffs)):
        path = f"scene/cameras/{name}"
        recording.log(path, rr.Transform3D(translation=[x, 0.0, 0.0]), static=True)
        pinhole = rr.Pinhole(
            image_from_camera=[[focal, 0, cx + shift], [0, focal, cy], [0, 0, 1]],
            resolution=[picture.shape[1], picture.shape[0]], camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=length, line_width=_LINE_WIDTH, color=_BLUE,
        )  # fmt: skip
        recording.log(path, pinhole, static=True)
        recording.log(path, rr.Image(picture).compress(jpeg_quality=_QUALITY), static=True)


def _blueprint(replay: StereoReplay) -> rrb.Blueprint:
    maps = [rrb.Spatial2DView(origin=f"maps/{name}", name=title) for name, title in _MAPS.items()]
    photos = [rrb.Spatial2DView(origin=f"photos/{name}", name=name) for name in ("left", "right")]
    words = rrb.TextDocumentView(origin="story", name="How well")
    if not len(replay.xyz):
        above: rrb.Container = rrb.Horizontal(*photos, words, column_shares=[3, 3, 2])
    else:
        views = [
            rrb.Spatial3DView(
                origin="scene", contents=[f"+ scene/{name}", "+ scene/cameras/**"], name=title,
                eye_controls=_eye(replay),
            )
            for name, title in (("cloud", "cloud"), ("sigma", "sigma of depth"))
        ]  # fmt: skip
        above = rrb.Horizontal(rrb.Tabs(*views), words, column_shares=[4, 1])
    return rrb.Blueprint(
        rrb.Vertical(above, rrb.Horizontal(*maps), row_shares=[3, 2]), rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"), rrb.TimePanel(state="collapsed"), auto_views=False,
    )  # fmt: skip


def _eye(replay: StereoReplay) -> rrb.EyeControls3D:
    """From behind the cameras, beside them and a little above, so that they are seen."""
    target = np.median(replay.xyz, axis=0).astype(np.float64)
    position = target + target[2] * np.array([-0.5, -0.35, -1.25])
    return rrb.EyeControls3D(position=position, look_target=target, eye_up=[0.0, -1.0, 0.0])
