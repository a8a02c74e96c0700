"""The story of a pair as a rerun recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.viewer.pair_replay import PairReplay
from sfmapp.viewer.rrd_file import recording_file

Array = NDArray[np.float64]

TIMELINE = "step"
_GREEN, _RED, _YELLOW, _BLUE, _ORANGE = (47, 191, 91), (229, 57, 45), (255, 210, 63), (74, 155, 255), (229, 138, 45)
_QUALITY = 85


def write_pair_rrd(replay: PairReplay, output: Path) -> None:
    """Write both photographs with keypoints and epipolar lines, the matches step by step, and the four poses."""
    with recording_file(output, "sfmapp_pair", replay.title) as recording:
        recording.send_blueprint(_blueprint(replay), make_active=True, make_default=True)
        recording.log("story", rr.TextDocument(replay.story, media_type="text/markdown"), static=True)
        _draw_photographs(recording, replay)
        _draw_matches(recording, replay)
        for n in range(len(replay.poses)):
            _draw_pose(recording, replay, n)


def _draw_photographs(recording: rr.RecordingStream, replay: PairReplay) -> None:
    count = max(len(replay.points), 1)
    colors = [_hue(k / count) for k in range(len(replay.points))]
    for n, (picture, keypoints, lines) in enumerate(
        (
            (replay.picture1, replay.keypoints1, replay.lines1),
            (replay.picture2, replay.keypoints2, replay.lines2),
        ),
        1,
    ):
        path = f"photo{n}"
        recording.log(path, rr.Image(picture).compress(jpeg_quality=_QUALITY), static=True)
        recording.log(f"{path}/keypoints", rr.Points2D(keypoints, colors=[_YELLOW], radii=1.0), static=True)
        inside = np.isfinite(lines).all((1, 2))
        shown = [color for color, is_in in zip(colors, inside, strict=True) if is_in]
        recording.log(f"{path}/lines", rr.LineStrips2D(list(lines[inside]), colors=shown, radii=1.0), static=True)
        at = replay.points[:, 2 * n - 2 : 2 * n]
        recording.log(f"{path}/points", rr.Points2D(at, colors=colors, radii=4.0), static=True)
        epipole = replay.epipoles[n - 1]
        height, width = picture.shape[:2]
        if np.isfinite(epipole).all() and (epipole > 0).all() and (epipole < [width, height]).all():
            mark = rr.Points2D([epipole], colors=[_RED], radii=7.0, labels=["epipole"])
            recording.log(f"{path}/epipole", mark, static=True)


def _draw_matches(recording: rr.RecordingStream, replay: PairReplay) -> None:
    """Both photographs in one picture, and the matches that are left after each step."""
    gap = 8
    heights, widths = zip(*(picture.shape[:2] for picture in (replay.picture1, replay.picture2)), strict=True)
    both = np.full((max(heights), widths[0] + gap + widths[1], 3), 40, np.uint8)
    both[: heights[0], : widths[0]] = replay.picture1
    both[: heights[1], widths[0] + gap :] = replay.picture2
    recording.log("matches", rr.Image(both).compress(jpeg_quality=_QUALITY), static=True)
    shift = np.array([0.0, 0.0, widths[0] + gap, 0.0])
    steps: list[tuple[Array, object]] = [(each, [_YELLOW]) for each in (replay.nearest, replay.ratio, replay.mutual)]
    steps.append((replay.mutual, np.where(replay.is_own[:, None], _GREEN, _RED).astype(np.uint8)))
    for step, (rows, colors) in enumerate(steps):
        recording.set_time(TIMELINE, sequence=step)
        strips = (rows + shift).reshape(-1, 2, 2)
        recording.log("matches/lines", rr.LineStrips2D(list(strips), colors=colors, radii=0.8))
    recording.reset_time()


def _draw_pose(recording: rr.RecordingStream, replay: PairReplay, n: int) -> None:
    path, points, in_front = f"poses/{n + 1}", replay.clouds[n], replay.in_front[n]
    recording.log(path, rr.ViewCoordinates.RDF, static=True)
    near = np.isfinite(points).all(1)
    near[near] = np.linalg.norm(points[near], axis=1) < 1.5 * replay.reach
    colors = np.where(in_front[near, None], _GREEN, _ORANGE).astype(np.uint8)
    recording.log(f"{path}/points", rr.Points3D(points[near], colors=colors, radii=0.006 * replay.reach), static=True)
    size = 0.1 * replay.reach
    corners = size * np.array([[-1, -0.75, 1.3], [1, -0.75, 1.3], [1, 0.75, 1.3], [-1, 0.75, 1.3]])
    for name, pose, color in (("camera1", rigid3.IDENTITY, _BLUE), ("camera2", replay.poses[n], _RED)):
        world = rigid3.apply(rigid3.inverse(pose), np.concatenate([np.zeros((1, 3)), corners]))
        strips = [world[[0, k, k % 4 + 1]] for k in range(1, 5)]
        drawn = rr.LineStrips3D(strips, colors=[color], radii=0.004 * replay.reach)
        recording.log(f"{path}/{name}", drawn, static=True)


def _hue(share: float) -> tuple[int, int, int]:
    import colorsys

    red, green, blue = colorsys.hsv_to_rgb(share, 0.75, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)


def _blueprint(replay: PairReplay) -> rrb.Blueprint:
    photos = [
        rrb.Spatial2DView(origin=f"photo{n}", name=f"{name}: epipolar lines") for n, name in enumerate(replay.names, 1)
    ]
    matches = rrb.Spatial2DView(origin="matches", name="Matches: move the time through the steps")
    about = rrb.TextDocumentView(origin="story", name="What kind of pair")
    reach = replay.reach
    # from behind and above, to the side: both cameras, and the points before them
    eye = rrb.EyeControls3D(
        position=(-1.5 * reach, -1.2 * reach, -1.3 * reach), look_target=(0.0, 0.0, 0.3 * reach),
        eye_up=(0.0, -1.0, 0.0),
    )  # fmt: skip
    poses = [
        rrb.Spatial3DView(origin=f"poses/{n}", name=label, eye_controls=eye, line_grid=False)
        for n, label in enumerate(replay.labels, 1)
    ]
    rows = [rrb.Horizontal(*photos), rrb.Horizontal(matches, about, column_shares=[3, 1])]
    if poses:
        rows.append(rrb.Horizontal(*poses))
    return rrb.Blueprint(
        rrb.Vertical(*rows),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", fps=1.0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )
