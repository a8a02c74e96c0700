"""Draws a dense result with rerun.

Entities (on the timeline ``wave``, but for what is there from the beginning)::

    world/scene                     turned so that up is up
    world/scene/patches/wave0, ...  the patches of one step of the timeline, in the photographs' colours; they stay
    world/scene/views, score, sigma all patches, coloured by the number of views that agree, by score, by deviation
    world/scene/mesh                the mesh, if there is one
    world/scene/cameras/NAME        pose, frustum and photograph
    plots/patches                   patches up to each wave
    about                           the result in words
    legend                          colour bars
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.viewer.cameras_rrd import BLUE, log_cameras
from sfmapp.viewer.dense_replay import DenseReplay
from sfmapp.viewer.rrd_file import recording_file
from sfmapp.viewer.stage import body_of, eye_direction, frame_view, turn_to_z

APPLICATION = "sfmapp dense"
TIMELINE = "wave"
_SCENE = "world/scene"
_PLAYED_S = 8.0
_LEGEND_PX = (520, 96)
# the eye is placed by so many of the points
_FRAMED_POINTS = 20_000
# and by the cameras, as if they were no farther from the middle than so many radii of what they look at
_CAMERA_RADII = 2.0


@dataclass(frozen=True)
class _Scale:
    """Values that colour the patches: (N,), the ends of the colour bar, and what it says."""

    name: str
    title: str
    values: NDArray[np.float64]
    low: float
    high: float
    colormap: int

    def colors(self) -> NDArray[np.uint8]:
        """(N, 3)."""
        t = (self.values - self.low) / max(self.high - self.low, 1e-12)
        index = np.rint(255 * np.clip(np.nan_to_num(t, nan=1.0), 0.0, 1.0)).astype(np.uint8)
        table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], self.colormap)[:, 0, ::-1]
        return np.asarray(table[index])


def write_dense_rrd(replay: DenseReplay, path: Path) -> None:
    """Write a recording with its blueprint. The file appears whole or not at all."""
    scales = _scales(replay)
    with recording_file(path, APPLICATION, replay.title) as recording:
        recording.send_blueprint(_blueprint(replay, scales), make_active=True, make_default=True)
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        recording.log(_SCENE, rr.Transform3D(mat3x3=turn_to_z(replay.up)), static=True)
        # axes of no length are an error to the viewer
        recording.log(_SCENE, rr.TransformAxes3D(1e-6), static=True)
        _draw_waves(recording, replay)
        for scale in scales:
            points = rr.Points3D(replay.xyz, colors=scale.colors(), radii=replay.radius)
            recording.log(f"{_SCENE}/{scale.name}", points, static=True)
        _draw_cameras(recording, replay)
        _draw_mesh(recording, replay)
        _draw_words(recording, replay, scales)


# ---------------------------------------------------------------- three dimensions


def _draw_waves(recording: rr.RecordingStream, replay: DenseReplay) -> None:
    for s, wave in enumerate(replay.step_wave.tolist()):
        mine = slice(replay.step_ptr[s], replay.step_ptr[s + 1])
        recording.set_time(TIMELINE, sequence=wave)
        points = rr.Points3D(replay.xyz[mine], colors=replay.rgb[mine], radii=replay.radius[mine])
        recording.log(f"{_SCENE}/patches/wave{wave}", points)
        recording.log("plots/patches", rr.Scalars(float(replay.step_total[s])))
    recording.reset_time()
    style = rr.SeriesLines(colors=[BLUE], names=["patches"], widths=[2.0])
    recording.log("plots/patches", style, static=True)


def _draw_cameras(recording: rr.RecordingStream, replay: DenseReplay) -> None:
    files = (replay.photo[a:b].tobytes() for a, b in itertools.pairwise(replay.photo_ptr))
    pictures = [rr.EncodedImage(contents=jpeg, media_type="image/jpeg") for jpeg in files]
    log_cameras(
        recording, replay.view_names, replay.cam_from_world, replay.view_k, replay.view_size, pictures, replay.xyz
    )


def _draw_mesh(recording: rr.RecordingStream, replay: DenseReplay) -> None:
    if not len(replay.mesh_faces):
        return
    has_texture = len(replay.mesh_uv) > 0
    mesh = rr.Mesh3D(
        vertex_positions=replay.mesh_xyz, triangle_indices=replay.mesh_faces, vertex_normals=replay.mesh_normal,
        vertex_colors=None if has_texture else replay.mesh_rgb,
        vertex_texcoords=replay.mesh_uv if has_texture else None,
        albedo_texture=replay.mesh_texture if has_texture else None,
    )  # fmt: skip
    recording.log(f"{_SCENE}/mesh", mesh, static=True)


# ---------------------------------------------------------------- numbers and words


def _scales(replay: DenseReplay) -> list[_Scale]:
    """What patches can be coloured by. All maps are even to the eye; the ends leave out the outermost values."""
    views, score = replay.num_views.astype(np.float64), replay.score.astype(np.float64)
    sigma = replay.sigma_px.astype(np.float64)
    any_there = len(views) > 0
    many = float(np.quantile(views, 0.99)) if any_there else 1.0
    low = float(np.quantile(score, 0.01)) if any_there else 0.0
    wide = float(np.nanquantile(sigma, 0.95)) if any_there and np.isfinite(sigma).any() else 1.0
    viridis, inferno = cv2.COLORMAP_VIRIDIS, cv2.COLORMAP_INFERNO
    return [
        _Scale("views", "views that agree", views, float(views.min()) if any_there else 0.0, many, viridis),
        _Scale("score", "score (correlation)", score, low, 1.0, viridis),
        _Scale("sigma", "deviation along the ray, ground pixels", sigma, 0.0, wide, inferno),
    ]


def _draw_words(recording: rr.RecordingStream, replay: DenseReplay, scales: list[_Scale]) -> None:
    recording.log("about", rr.TextDocument(_about(replay), media_type="text/markdown"), static=True)
    recording.log("legend", rr.Image(_legend(scales)), static=True)


def _about(replay: DenseReplay) -> str:
    shown, last = len(replay.xyz), int(replay.step_wave[-1]) if len(replay.step_wave) else 0
    lines = [f"**{replay.num_patches} patches** of {len(replay.view_names)} photographs, made in {last} waves."]
    if shown < replay.num_patches:
        lines.append(f"{shown} of them are shown, drawn at random; the points are larger for it.")
    if shown:
        lines.append(
            f"Medians: {np.median(replay.num_views):.0f} views agree on a patch, score {np.median(replay.score):.3f}, "
            f"deviation {np.nanmedian(replay.sigma_px):.2f} pixels of the photograph on the surface."
        )
    if len(replay.mesh_faces):
        kind = "textured" if len(replay.mesh_uv) else "coloured at its vertices"
        lines.append(f"The mesh has {len(replay.mesh_faces)} triangles and is {kind}.")
    if replay.origin.any():
        text = " ".join(f"{value:.3f}" for value in replay.origin)
        lines.append(f"Places are shown less {text}, to keep their precision.")
    lines.append("Tabs above the scene choose what is drawn; the timeline *wave* replays the growth.")
    return "\n\n".join(lines)


def _legend(scales: list[_Scale]) -> NDArray[np.uint8]:
    """(H, W, 3) RGB colour bars with their ends."""
    width, row = _LEGEND_PX
    image = np.full((row * len(scales), width, 3), 24, np.uint8)
    font, white = cv2.FontFace("sans"), (235, 235, 235)
    for s, scale in enumerate(scales):
        top, bar = row * s, width - 40
        ramp = _Scale("", "", np.linspace(scale.low, scale.high, bar), scale.low, scale.high, scale.colormap).colors()
        image[top + 36 : top + 58, 20 : 20 + bar] = ramp
        ends = [f"{value:.3g}" for value in (scale.low, scale.high)]
        cv2.putText(image, scale.title, (20, top + 26), white, font, 18)
        cv2.putText(image, ends[0], (20, top + 80), white, font, 16)
        end = cv2.getTextSize((width, row), ends[1], (0, 0), font, 16)[2]
        cv2.putText(image, ends[1], (20 + bar - int(end), top + 80), white, font, 16)
    return image


def _framed(
    centers: NDArray[np.float64], xyz: NDArray[np.float64], rotation: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N, 3) what the first view has to hold, turned upright: the surface, and cameras (V, 3) unless they are far."""
    if not len(xyz):
        return body_of(centers, xyz, rotation)
    surface = body_of(centers[:0], xyz, rotation)
    middle = np.median(surface, axis=0)
    away = centers @ rotation.T - middle
    farthest = _CAMERA_RADII * 0.5 * float(np.linalg.norm(np.ptp(surface, axis=0)))
    distance = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    return np.concatenate([surface, middle + away * np.minimum(1.0, farthest / distance)])


def _blueprint(replay: DenseReplay, scales: list[_Scale]) -> rrb.Blueprint:
    rotation = turn_to_z(replay.up)
    centers = rigid3.center(replay.cam_from_world)
    forward = rigid3.rotation_matrix(replay.cam_from_world)[:, 2] @ rotation.T
    sample = replay.xyz[:: max(1, len(replay.xyz) // _FRAMED_POINTS)].astype(np.float64)
    eye, target = frame_view(_framed(centers, sample, rotation), eye_direction(forward.mean(0)))
    controls = rrb.EyeControls3D(position=eye, look_target=target, eye_up=(0.0, 0.0, 1.0))
    shown = [("patches", "Patch wave"), *((scale.name, f"By {scale.name}") for scale in scales)]
    shown += [("mesh", "Mesh")] if len(replay.mesh_faces) else []
    worlds = [
        rrb.Spatial3DView(
            origin="world", name=label, eye_controls=controls, line_grid=False,
            contents=[f"{_SCENE}/{name}/**", f"{_SCENE}/cameras/**", _SCENE],
        )
        for name, label in shown
    ]  # fmt: skip
    side = rrb.Vertical(
        rrb.TextDocumentView(origin="about", name="About it"),
        rrb.TimeSeriesView(origin="plots/patches", name="Patches", plot_legend=rrb.PlotLegend(visible=False)),
        rrb.Spatial2DView(origin="legend", name="Colours"),
        row_shares=[2, 2, 3],
    )
    last = float(replay.step_wave[-1]) if len(replay.step_wave) else 1.0
    fps = float(np.clip(last / _PLAYED_S, 1, 30))
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Tabs(*worlds, active_tab=0), side, column_shares=[7, 2]),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", fps=fps),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )
