"""Swept depth maps as a rerun recording.

Entities (on the timeline ``map``, but for what is there from the beginning)::

    world/scene                 turned so that up is up
    world/scene/maps/NAME       the points of a map, in the photograph's colours; they stay
    world/scene/sigma           all points, coloured by sigma as a share of the depth
    world/scene/occupancy       the cells that hold a feature, if there is a volume, and its box
    world/scene/cameras/NAME    pose, frustum and depth map
    shown/photograph, depth, sigma   of the newest map
    map                         what is said of it
    about                       the result in words
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from sfmapp.geometry import rigid3
from sfmapp.viewer.cameras_rrd import BLUE, LINE_WIDTH, log_cameras
from sfmapp.viewer.rrd_file import recording_file
from sfmapp.viewer.stage import body_of, eye_direction, frame_view, turn_to_z
from sfmapp.viewer.sweep_replay import SweepReplay

APPLICATION, TIMELINE = "sfmapp sweep", "map"
_SCENE = "world/scene"
_SHOWN = {"photograph": "photograph", "depth": "depth, near is red", "sigma": "sigma / depth, bright is bad"}
# the timeline takes so long, and the eye is placed by so many of the points
_PLAYED_S, _FRAMED_POINTS = 8.0, 20_000


def write_sweep_rrd(replay: SweepReplay, path: Path) -> None:
    """Write a recording with its blueprint. The file appears whole or not at all."""
    with recording_file(path, APPLICATION, replay.title) as recording:
        recording.send_blueprint(_blueprint(replay), make_active=True, make_default=True)
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        recording.log(_SCENE, rr.Transform3D(mat3x3=turn_to_z(replay.up)), static=True)
        # axes of no length are an error to the viewer
        recording.log(_SCENE, rr.TransformAxes3D(1e-6), static=True)
        recording.log("about", rr.TextDocument(replay.story, media_type="text/markdown"), static=True)
        pictures = [_picture(replay, view, 1) for view in range(len(replay.names))]
        log_cameras(recording, replay.names, replay.cam_from_world, replay.k, replay.size, pictures, replay.xyz)
        _draw_maps(recording, replay)
        points = rr.Points3D(replay.xyz, colors=replay.sigma_rgb, radii=replay.radius)
        recording.log(f"{_SCENE}/sigma", points, static=True)
        _draw_volume(recording, replay)


def _picture(replay: SweepReplay, view: int, which: int) -> rr.EncodedImage:
    part = slice(replay.jpeg_ptr[3 * view + which], replay.jpeg_ptr[3 * view + which + 1])
    return rr.EncodedImage(contents=replay.jpeg[part].tobytes(), media_type="image/jpeg")


def _draw_maps(recording: rr.RecordingStream, replay: SweepReplay) -> None:
    for view, name in enumerate(replay.names):
        recording.set_time(TIMELINE, sequence=view + 1)
        mine = slice(replay.map_ptr[view], replay.map_ptr[view + 1])
        points = rr.Points3D(replay.xyz[mine], colors=replay.rgb[mine], radii=replay.radius[mine])
        recording.log(rr.new_entity_path(["world", "scene", "maps", name]), points)
        for which, shown in enumerate(_SHOWN):
            recording.log(f"shown/{shown}", _picture(replay, view, which))
        recording.log("map", rr.TextDocument(replay.map_texts[view], media_type="text/markdown"))
    recording.reset_time()


def _draw_volume(recording: rr.RecordingStream, replay: SweepReplay) -> None:
    if not replay.cell:
        return
    box = rr.Boxes3D(mins=replay.box[:1], sizes=replay.box[1:] - replay.box[:1], radii=LINE_WIDTH, colors=BLUE)
    recording.log(f"{_SCENE}/occupancy/box", box, static=True)
    if len(replay.cell_xyz):
        cells = rr.Points3D(replay.cell_xyz, colors=replay.cell_rgb, radii=0.5 * replay.cell)
        recording.log(f"{_SCENE}/occupancy/cells", cells, static=True)


def _blueprint(replay: SweepReplay) -> rrb.Blueprint:
    turn = turn_to_z(replay.up)
    chosen = replay.xyz[:: max(1, len(replay.xyz) // _FRAMED_POINTS)].astype(np.float64)
    forward = rigid3.rotation_matrix(replay.cam_from_world)[:, 2] @ turn.T
    body = body_of(rigid3.center(replay.cam_from_world), chosen, turn)
    eye, target = frame_view(body, eye_direction(forward.mean(axis=0)))
    tabs = {"maps": "depth maps", "sigma": "sigma"} | ({"occupancy": "occupancy"} if replay.cell else {})
    views = [
        rrb.Spatial3DView(
            origin="world", contents=[f"+ {_SCENE}/{name}/**", f"+ {_SCENE}/cameras/**"], name=title,
            eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=[0.0, 0.0, 1.0]),
        )
        for name, title in tabs.items()
    ]  # fmt: skip
    pictures = [rrb.Spatial2DView(origin=f"shown/{name}", name=title) for name, title in _SHOWN.items()]
    words = rrb.Horizontal(
        rrb.TextDocumentView(origin="map", name="Map"), rrb.TextDocumentView(origin="about", name="All maps")
    )
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Tabs(*views), rrb.Vertical(*pictures, words), column_shares=[5, 2]),
        rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, fps=max(len(replay.names) / _PLAYED_S, 1.0)),
        auto_views=False,
    )  # fmt: skip
