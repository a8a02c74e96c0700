"""Draws a replay with rerun.

Entities (everything on the timeline ``step``, the photographs on ``photo`` as well)::

    world/model0/points             points with colour, as they were at the step
    world/model0/cameras/NAME       pose and frustum, from the step at which the image was registered
    photo                           the newest photograph, with keypoints, observations, residuals
    about                           the photograph in words
    plots/registered, points, error the map in numbers
    log                             decisions
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.viewer.photos import ScreenPhoto, load_screen_photo, screen_side_px
from sfmapp.viewer.replay import Replay
from sfmapp.viewer.rrd_file import recording_file
from sfmapp.viewer.stage import Stage, set_stage

APPLICATION = "sfmapp"
TIMELINE = "step"
PHOTO_TIMELINE = "photo"

_THUMBNAIL_PX = 240
# Residuals are fractions of a pixel: they are drawn this much longer.
RESIDUAL_SCALE = 20
# Length in pixels at which a residual is drawn wholly red.
_RED_RESIDUAL_PX = 2.0

# negative: in points of the screen, not in units of the scene
_LINE_WIDTH = -1.0
_BLUE, _ORANGE, _GREY = (70, 150, 255), (255, 150, 40), (120, 120, 130)
_MODEL_COLORS = (_BLUE, (90, 200, 120), (200, 120, 220), (220, 200, 80))


def write_rrd(replay: Replay, path: Path, threads: int = 1) -> None:
    """Write a recording with its blueprint. The file appears whole or not at all."""
    stage = set_stage(replay)
    with recording_file(path, APPLICATION, replay.title) as recording:
        # active, so that a layout that somebody kept for another scene does not look past this one
        recording.send_blueprint(_blueprint(replay, stage), make_active=True, make_default=True)
        photos = _load_photos(replay, threads)
        _draw_world(recording, replay, stage, photos)
        _draw_photos(recording, replay, photos)
        _draw_numbers(recording, replay)


# ---------------------------------------------------------------- three dimensions


def _draw_world(
    recording: rr.RecordingStream, replay: Replay, stage: Stage, photos: Sequence[ScreenPhoto | None]
) -> None:
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for m in range(len(replay.model_cam_from_world)):
        root = f"world/model{m}"
        recording.log(root, rr.Transform3D(translation=stage.shift[m], mat3x3=stage.rotation), static=True)
        _draw_points(recording, replay, stage, m, f"{root}/points")
        for image_idx in np.flatnonzero(replay.image_model == m).tolist():
            _draw_camera(recording, replay, stage, m, image_idx, photos[image_idx])


def _draw_points(recording: rr.RecordingStream, replay: Replay, stage: Stage, m: int, path: str) -> None:
    mine = np.flatnonzero(replay.cloud_model == m)
    spans = [slice(replay.cloud_ptr[k], replay.cloud_ptr[k + 1]) for k in mine]
    spans_final = slice(replay.model_ptr[m], replay.model_ptr[m + 1])
    xyz = np.concatenate([*(replay.cloud_xyz[s] for s in spans), replay.model_xyz[spans_final]])
    rgb = np.concatenate([*(replay.cloud_rgb[s] for s in spans), replay.model_rgb[spans_final]])
    counts = [s.stop - s.start for s in [*spans, spans_final]]
    steps = np.append(replay.cloud_step[mine], replay.step[-1])
    recording.log(path, rr.Points3D.from_fields(radii=rr.Radius.ui_points(1.8)), static=True)
    columns = rr.Points3D.columns(positions=stage.scale[m] * xyz, colors=_packed(rgb)).partition(counts)
    recording.send_columns(path, [rr.TimeColumn(TIMELINE, sequence=steps)], columns)


def _draw_camera(
    recording: rr.RecordingStream, replay: Replay, stage: Stage, m: int, image_idx: int, photo: ScreenPhoto | None
) -> None:
    path = rr.new_entity_path(["world", f"model{m}", "cameras", replay.image_names[image_idx]])
    steps, poses = _camera_path(replay, m, image_idx)
    world_from_cam = rigid3.inverse(poses)
    columns = rr.Transform3D.columns(
        translation=stage.scale[m] * world_from_cam[:, 4:], quaternion=world_from_cam[:, :4]
    )
    recording.send_columns(path, [rr.TimeColumn(TIMELINE, sequence=steps)], columns)
    # the frustum says it all; axes of no length are an error to the viewer
    recording.log(path, rr.TransformAxes3D(1e-6 * stage.frustum), static=True)
    size = replay.image_size[image_idx].astype(np.float64)
    shown = np.array(photo.thumbnail_size, np.float64) if photo else size
    fx, fy, cx, cy = replay.image_intrinsics[image_idx].astype(np.float64) * np.tile(shown / size, 2)
    # To the viewer a photograph among points without a pinhole is an error, even before the photograph is there. So the
    # pinhole is there from the beginning, too small to be seen, and stands out when the image joins.
    color = _MODEL_COLORS[m % len(_MODEL_COLORS)]
    rows = [(0, 1e-6, 0.0, color), (steps[0], 1.0, _LINE_WIDTH, _ORANGE), (steps[0] + 1, 1.0, _LINE_WIDTH, color)]
    times, lengths, widths, colors = zip(
        *(rows if steps[0] < replay.step[-1] else [rows[0], (steps[0], *rows[2][1:])]), strict=True
    )
    repeat = len(times)
    pinhole = rr.Pinhole.columns(
        image_from_camera=[[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]] * repeat, resolution=[shown] * repeat,
        camera_xyz=[rr.ViewCoordinates.RDF] * repeat, image_plane_distance=stage.frustum * np.array(lengths),
        line_width=widths, color=_packed(colors),
    )  # fmt: skip
    recording.send_columns(path, [rr.TimeColumn(TIMELINE, sequence=times)], pinhole)
    if photo:
        image = rr.EncodedImage.columns(blob=[photo.thumbnail], media_type=["image/jpeg"])
        recording.send_columns(path, [rr.TimeColumn(TIMELINE, sequence=steps[:1])], image)


def _camera_path(replay: Replay, m: int, image_idx: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Steps (K,) and poses (K, 7) of one camera, from its registration to the final model; repeats are left out."""
    rows = np.flatnonzero(
        (replay.pose_model == m)
        & (replay.pose_step >= replay.image_step[image_idx])
        & ~np.isnan(replay.pose_cam_from_world[:, image_idx, 0])
    )
    steps = np.append(replay.pose_step[rows], replay.step[-1])
    poses = np.concatenate(
        [replay.pose_cam_from_world[rows, image_idx], replay.model_cam_from_world[m, image_idx][None]]
    )
    steps[0] = replay.image_step[image_idx]
    is_new = np.append(True, (poses[1:] != poses[:-1]).any(1))
    return steps[is_new], poses[is_new].astype(np.float64)


# ---------------------------------------------------------------- photographs


def _load_photos(replay: Replay, threads: int) -> list[ScreenPhoto | None]:
    side = screen_side_px(len(replay.image_names))
    with ThreadPoolExecutor(max(1, threads)) as pool:
        return list(
            pool.map(
                lambda job: load_screen_photo(Path(job[0]), int(job[1]), side, min(side, _THUMBNAIL_PX)),
                zip(replay.image_paths, replay.image_orientation, strict=True),
            )
        )


def _draw_photos(recording: rr.RecordingStream, replay: Replay, photos: Sequence[ScreenPhoto | None]) -> None:
    """Registered photographs by step and by number, all others by number only."""
    fields = rr.Points2D.from_fields
    recording.log("photo/keypoints", fields(radii=rr.Radius.ui_points(1.2), colors=_GREY), static=True)
    recording.log("photo/observations", fields(radii=rr.Radius.ui_points(2.0)), static=True)
    recording.log("photo/residuals", rr.Arrows2D.from_fields(radii=rr.Radius.ui_points(0.7)), static=True)
    registered = np.flatnonzero(replay.image_step >= 0)
    registered = registered[np.argsort(replay.image_step[registered], kind="stable")]
    _draw_photo_rows(recording, replay, photos, registered, by_step=True)
    _draw_photo_rows(recording, replay, photos, np.flatnonzero(replay.image_step < 0), by_step=False)


def _draw_photo_rows(
    recording: rr.RecordingStream, replay: Replay, photos: Sequence[ScreenPhoto | None], rows: NDArray[np.int64],
    by_step: bool,
) -> None:  # fmt: skip
    if not len(rows):
        return
    times = [rr.TimeColumn(PHOTO_TIMELINE, sequence=rows)]
    if by_step:
        times.append(rr.TimeColumn(TIMELINE, sequence=replay.image_step[rows]))
    blobs = [photo.photo if (photo := photos[i]) else b"" for i in rows]
    recording.send_columns("photo", times, rr.EncodedImage.columns(blob=blobs, media_type=["image/jpeg"] * len(rows)))
    scale = np.array([_photo_scale(replay, photos[i], i) for i in rows])
    loose, loose_counts, loose_row = _rows_of(replay.keypoint_ptr, rows)
    xy = replay.keypoint_xy[loose] * scale[loose_row]
    recording.send_columns("photo/keypoints", times, rr.Points2D.columns(positions=xy).partition(loose_counts))
    seen, seen_counts, seen_row = _rows_of(replay.obs_ptr, rows)
    xy, residual = replay.obs_xy[seen] * scale[seen_row], replay.obs_residual[seen]
    colors = _residual_colors(np.linalg.norm(residual, axis=1))
    recording.send_columns(
        "photo/observations", times, rr.Points2D.columns(positions=xy, colors=colors).partition(seen_counts)
    )
    vectors = np.nan_to_num(residual * scale[seen_row] * RESIDUAL_SCALE)
    arrows = rr.Arrows2D.columns(origins=xy, vectors=vectors, colors=colors).partition(seen_counts)
    recording.send_columns("photo/residuals", times, arrows)
    texts = [_about(replay, int(i)) for i in rows]
    about = rr.TextDocument.columns(text=texts, media_type=["text/markdown"] * len(rows))
    recording.send_columns("about", times, about)


def _rows_of(ptr: NDArray[np.int64], rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], list[int], NDArray[np.int64]]:
    """Entries of some rows of a CSR array, one after the other; how many each row has; and the row of each entry."""
    counts = ptr[rows + 1] - ptr[rows]
    entries = np.concatenate([np.zeros(0, np.int64), *(np.arange(ptr[i], ptr[i + 1]) for i in rows)])
    return entries, counts.tolist(), np.repeat(np.arange(len(rows)), counts)


def _photo_scale(replay: Replay, photo: ScreenPhoto | None, image_idx: int) -> NDArray[np.float32]:
    size = replay.image_size[image_idx].astype(np.float32)
    return (np.array(photo.size, np.float32) / size) if photo else np.ones(2, np.float32)


def _about(replay: Replay, image_idx: int) -> str:
    name = replay.image_names[image_idx]
    loose = int(replay.keypoint_ptr[image_idx + 1] - replay.keypoint_ptr[image_idx])
    model = int(replay.image_model[image_idx])
    if model < 0:
        return f"**{name}** is in no model. {loose} keypoints are shown."
    residual = replay.obs_residual[replay.obs_ptr[image_idx] : replay.obs_ptr[image_idx + 1]]
    error = float(np.median(np.linalg.norm(residual, axis=1))) if len(residual) else float("nan")
    fx = float(replay.image_intrinsics[image_idx, 0])
    return (
        f"**{name}** joined model {model} at step {replay.image_step[image_idx]}. "
        f"{len(residual)} of its keypoints see points of the final model, green to red by their residual "
        f"(median {error:.2f} px; red from {_RED_RESIDUAL_PX:g} px; drawn {RESIDUAL_SCALE} times as long), "
        f"others are grey. Focal length {fx:.1f} px."
    )


def _residual_colors(length_px: NDArray[np.float32]) -> NDArray[np.uint32]:
    t = np.clip(np.nan_to_num(length_px, nan=_RED_RESIDUAL_PX) / _RED_RESIDUAL_PX, 0, 1)
    red, green = np.clip(2 * t, 0, 1), np.clip(2 - 2 * t, 0, 1)
    return _packed(np.stack([255 * red, 60 + 160 * green, 60 * np.ones_like(t)], -1).astype(np.uint8))


def _packed(rgb: Sequence[tuple[int, int, int]] | NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Colours as rerun stores them, 0xRRGGBBAA."""
    c = np.asarray(rgb, np.uint32).reshape(-1, 3)
    return ((c[:, 0] << 24) | (c[:, 1] << 16) | (c[:, 2] << 8) | 255).astype(np.uint32)


# ---------------------------------------------------------------- numbers and words


def _draw_numbers(recording: rr.RecordingStream, replay: Replay) -> None:
    series = (
        ("registered", replay.step_registered, _BLUE, "registered images"),
        ("points", replay.step_points, (90, 200, 120), "points"),
        ("error", replay.step_error_px, _ORANGE, "mean reprojection error (px)"),
    )
    for name, values, color, label in series:
        recording.log(f"plots/{name}", rr.SeriesLines(colors=[color], names=[label], widths=[2.0]), static=True)
        keep = np.isfinite(np.asarray(values, np.float64))
        times = [rr.TimeColumn(TIMELINE, sequence=replay.step[keep])]
        recording.send_columns(f"plots/{name}", times, rr.Scalars.columns(scalars=np.asarray(values, np.float64)[keep]))
    if replay.messages:
        steps, levels, texts = zip(*replay.messages, strict=True)
        times = [rr.TimeColumn(TIMELINE, sequence=np.array(steps))]
        recording.send_columns("log", times, rr.TextLog.columns(text=list(texts), level=list(levels)))


def _blueprint(replay: Replay, stage: Stage) -> rrb.Blueprint:
    eye = rrb.EyeControls3D(position=stage.eye, look_target=stage.target, eye_up=(0.0, 0.0, 1.0))
    world = rrb.Spatial3DView(origin="world", name="Cameras and points", eye_controls=eye, line_grid=False)
    photo = rrb.Spatial2DView(origin="photo", name="Newest photograph")
    about = rrb.TextDocumentView(origin="about", name="About it")
    plots = [
        rrb.TimeSeriesView(origin=f"plots/{name}", name=label, plot_legend=rrb.PlotLegend(visible=False))
        for name, label in (("registered", "Registered images"), ("points", "Points"), ("error", "Mean error (px)"))
    ]
    log = rrb.TextLogView(
        origin="log", name="Decisions",
        columns=rrb.TextLogColumns(text_log_columns=["loglevel", "body"]),
    )  # fmt: skip
    # it opens playing, for some eight seconds, and stays at the end
    speed = rrb.TimePanel(timeline=TIMELINE, state="collapsed", fps=float(np.clip(replay.step[-1] / 8, 1, 30)))
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(world, rrb.Vertical(photo, about, row_shares=[5, 1]), column_shares=[3, 2]),
            rrb.Horizontal(*plots, log, column_shares=[1, 1, 1, 3]),
            row_shares=[3, 1],
        ),
        speed,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )
