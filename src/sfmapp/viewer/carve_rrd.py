"""A carved volume as a rerun recording.

Entities (on the timeline ``level``, but for what is there from the beginning)::

    world/scene              turned so that up is up
    world/scene/cells        the cells that stand after each level
    world/scene/surface      the coloured surface, after the last level
    world/scene/cameras      frusta of the photographs
    photographs/NAME         some of them, dim outside their silhouettes
    level                    what became of the cells of each level
    about                    the result in words
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from sfmapp.viewer.carve_replay import CarveReplay
from sfmapp.viewer.rrd_file import recording_file
from sfmapp.viewer.stage import eye_direction, frame_view, turn_to_z

APPLICATION, TIMELINE = "sfmapp carve", "level"
_SCENE, _BLUE, _LINE_WIDTH, _QUALITY = "world/scene", (70, 150, 255), -1.0, 85
# levels a second
_PLAYED = 1.0


def write_carve_rrd(replay: CarveReplay, path: Path) -> None:
    """Write a recording with its blueprint. The file appears whole or not at all."""
    with recording_file(path, APPLICATION, replay.title) as recording:
        recording.send_blueprint(_blueprint(replay), make_active=True, make_default=True)
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        recording.log(_SCENE, rr.Transform3D(mat3x3=turn_to_z(replay.up)), static=True)
        _draw_levels(recording, replay)
        recording.log("about", rr.TextDocument(replay.story, media_type="text/markdown"), static=True)
        lines = [np.stack([f[0], f[k], f[k % 4 + 1]]) for f in replay.frusta for k in range(1, 5)]
        cameras = rr.LineStrips3D(lines, colors=_BLUE, radii=_LINE_WIDTH)
        recording.log(f"{_SCENE}/cameras", cameras, static=True)
        for name, photo in zip(replay.photo_names, replay.photos, strict=True):
            picture = rr.Image(photo).compress(jpeg_quality=_QUALITY)
            recording.log(rr.new_entity_path(["photographs", name]), picture, static=True)


def _draw_levels(recording: rr.RecordingStream, replay: CarveReplay) -> None:
    for n, level in enumerate(replay.levels):
        recording.set_time(TIMELINE, sequence=level)
        corners = slice(replay.corner_ptr[n], replay.corner_ptr[n + 1])
        xyz = replay.corners[corners]
        faces = replay.faces[replay.face_ptr[n] : replay.face_ptr[n + 1]]
        # those of the first corner of each square are those of the whole of it
        normal = np.cross(xyz[1::4] - xyz[::4], xyz[2::4] - xyz[::4])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        cells = rr.Mesh3D(
            vertex_positions=xyz, triangle_indices=faces, vertex_normals=np.repeat(normal, 4, axis=0),
            vertex_colors=replay.corner_rgb[corners],
        )  # fmt: skip
        recording.log(f"{_SCENE}/cells", cells)
        recording.log("level", rr.TextDocument(replay.level_texts[n], media_type="text/markdown"))
    recording.set_time(TIMELINE, sequence=replay.levels[-1] + 1)
    recording.log(f"{_SCENE}/cells", rr.Clear(recursive=False))
    surface = rr.Mesh3D(
        vertex_positions=replay.mesh_xyz, triangle_indices=replay.mesh_faces, vertex_normals=replay.mesh_normal,
        vertex_colors=replay.mesh_rgb,
    )  # fmt: skip
    recording.log(f"{_SCENE}/surface", surface)
    recording.log("level", rr.TextDocument("The surface", media_type="text/markdown"))
    recording.reset_time()


def _blueprint(replay: CarveReplay) -> rrb.Blueprint:
    turn = turn_to_z(replay.up)
    forward = -(replay.frusta[:, 0] @ turn.T).mean(axis=0)
    # the cube that all is carved out of, the first thing to be seen
    eye, target = frame_view(replay.corners[: replay.corner_ptr[1]] @ turn.T, eye_direction(forward))
    scene = rrb.Spatial3DView(
        origin="world", name="Carved away, level by level",
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=[0.0, 0.0, 1.0]),
    )  # fmt: skip
    photos = rrb.Grid(
        *[
            rrb.Spatial2DView(origin=str(rr.new_entity_path(["photographs", name])), name=name)
            for name in replay.photo_names
        ],
        grid_columns=2,
    )
    words = rrb.Horizontal(
        rrb.TextDocumentView(origin="level", name="Level"), rrb.TextDocumentView(origin="about", name="Volume")
    )
    return rrb.Blueprint(
        rrb.Horizontal(scene, rrb.Vertical(photos, words, row_shares=[3, 2]), column_shares=[3, 2]),
        rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, fps=_PLAYED), auto_views=False,
    )  # fmt: skip
