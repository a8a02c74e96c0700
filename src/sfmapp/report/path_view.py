"""A trajectory seen from above, as a small SVG: the path with its gaps, keyframes, points, and the ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.orientation import upright_poses
from sfmapp.report.plots import ticks
from sfmapp.report.top_view import HEIGHT, MAX_POINTS, WIDTH, fit_page, ground_axes

Array = NDArray[np.float64]

PATH_COLOR, GROUND_TRUTH_COLOR = "#2f7fe0", "#2a9d4a"
_MAX_VERTICES = 3000


@dataclass(frozen=True)
class PathScene:
    """What is drawn, all in one world.

    Attributes:
        cam_from_world: (F, 7) poses of all frames, NaN in gaps.
        keyframe_cam_from_world: (K, 7).
        point_xyz: (P, 3).
        ground_truth_centers: (T, 3) true positions in the same world; empty without ground truth.
        unit: of length, ``m`` or empty where it is arbitrary.
    """

    cam_from_world: Array
    keyframe_cam_from_world: Array
    point_xyz: Array
    ground_truth_centers: Array
    unit: str


def path_view_svg(scene: PathScene, orientation: int = 1) -> str:
    """The scene seen along the mean downward direction of the frames, the first direction of view up the page.

    Args:
        scene: what is drawn.
        orientation: EXIF orientation of the frames.
    """
    with_pose = np.isfinite(scene.cam_from_world[:, 0])
    poses = scene.cam_from_world[with_pose]
    axes = ground_axes(rigid3.rotation_matrix(upright_poses(poses, np.full(len(poses), orientation))))
    path = rigid3.center(scene.cam_from_world) @ axes.T
    ground_truth = scene.ground_truth_centers @ axes.T
    # the points may lie far beyond the path: they are the background, and get half its size on each side at most
    shown = np.concatenate([path[with_pose], ground_truth])
    points = scene.point_xyz[:: max(1, len(scene.point_xyz) // MAX_POINTS)] @ axes.T
    middle, half = (shown.max(0) + shown.min(0)) / 2, np.ptp(shown, axis=0).max() or 1.0
    points = points[(np.abs(points - middle) < half).all(1)]
    scale, offset = fit_page(points, shown)
    parts = [_dots((points * scale + offset).round(1))]
    if len(ground_truth):
        parts.append(_strip(ground_truth * scale + offset, GROUND_TRUTH_COLOR, 5, 'stroke-opacity=".55"'))
    parts.append(_strip(path * scale + offset, PATH_COLOR, 2))
    for center in (rigid3.center(scene.keyframe_cam_from_world) @ axes.T) * scale + offset:
        parts.append(f'<circle cx="{center[0]:.1f}" cy="{center[1]:.1f}" r="2.6" fill="{PATH_COLOR}"/>')
    first, last = (path[with_pose] * scale + offset)[[0, -1]]
    parts += [_label(first, "start"), _label(last, "end")]
    parts.append(_scale_bar(float(scale[0]), scene.unit))
    return f'<svg class="view" viewBox="0 0 {WIDTH:.0f} {HEIGHT:.0f}">{"".join(parts)}</svg>'


def _dots(xy: Array) -> str:
    dots = "".join(f"M{x:g} {y:g}h0" for x, y in xy)
    return (
        f'<path d="{dots}" stroke="currentColor" stroke-opacity=".35" stroke-width="1.8" stroke-linecap="round"/>'
        if dots
        else ""
    )


def _strip(xy: Array, color: str, width: float, more: str = "") -> str:
    """A line through points (N, 2); where they are NaN it is dashed from the last to the next."""
    xy = xy[:: max(1, len(xy) // _MAX_VERTICES)]
    known = np.flatnonzero(np.isfinite(xy[:, 0]))
    line, dashes = [], []
    for k, i in enumerate(known):
        x, y = xy[i]
        is_joined = k > 0 and known[k - 1] == i - 1
        line.append(f"{'L' if is_joined else 'M'}{x:.1f} {y:.1f}")
        if k > 0 and not is_joined:
            before = xy[known[k - 1]]
            dashes.append(f"M{before[0]:.1f} {before[1]:.1f}L{x:.1f} {y:.1f}")
    style = f'fill="none" stroke-linejoin="round" stroke-width="{width}" {more}'
    out = f'<path d="{"".join(line)}" stroke="{color}" {style}/>'
    return out + (f'<path d="{"".join(dashes)}" stroke="#d1372c" stroke-dasharray="4 4" {style}/>' if dashes else "")


def _label(xy: Array, text: str) -> str:
    x, y = xy
    anchor = "end" if x > WIDTH - 60 else "start"
    shift = -8 if anchor == "end" else 8
    return (
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="none" stroke="#e0a100" stroke-width="2.5"/>'
        f'<text x="{x + shift:.1f}" y="{y - 7:.1f}" text-anchor="{anchor}">{escape(text)}</text>'
    )


def _scale_bar(zoom: float, unit: str) -> str:
    """A round length of about a sixth of the page in the corner below."""
    length = ticks(0.0, WIDTH / zoom, 6)[1]
    text = f"{length:g} {unit}" if unit else f"{length:g} (unit arbitrary)"
    x, y = 20.0, HEIGHT - 18
    return (
        f'<path d="M{x} {y - 5}v5h{length * zoom:.1f}v-5" fill="none" stroke="currentColor"/>'
        f'<text x="{x}" y="{y - 10}">{escape(text)}</text>'
    )


def legend(entries: Sequence[tuple[str, str]]) -> str:
    """(colour, text) as a line of HTML."""
    spans = [f'<span style="color:{color}">\N{BLACK CIRCLE}</span> {escape(text)}' for color, text in entries]
    return f'<p class="dim">{" &nbsp; ".join(spans)}</p>'
