"""A model seen from above, as a small SVG."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.geometry import rigid3
from sfmapp.geometry.orientation import upright_poses

if TYPE_CHECKING:
    from sfmapp.scene.reconstruction import Reconstruction

Array = NDArray[np.float64]

WIDTH, HEIGHT = 1000.0, 560.0
MAX_POINTS = 4000


def top_view_svg(model: Reconstruction, orientation: Sequence[int] | None = None, *, new: int = 0) -> str:
    """Points in their colours and cameras as triangles, seen along the mean downward direction of the images.

    Args:
        model: of I images.
        orientation: EXIF orientations of the images; None: all are upright as they are stored.
        new: how many of the last images are drawn in blue, as they came to the others later.
    """
    registered = model.registered_idx
    poses = model.cam_from_world
    if orientation is not None:
        poses = upright_poses(poses, orientation)
    rotation = rigid3.rotation_matrix(poses[registered])
    axes = ground_axes(rotation)
    centers = model.centers[registered] @ axes.T
    points_idx = np.flatnonzero(model.is_triangulated)
    points_idx = points_idx[:: max(1, len(points_idx) // MAX_POINTS)]
    points = model.point_xyz[points_idx] @ axes.T
    scale, offset = fit_page(points, centers)

    def to_page(xy: Array) -> Array:
        return np.round(xy * scale + offset, 1)

    parts = point_paths(to_page(points), model.point_rgb[points_idx])
    # 2.5 % of the width: visible, and still apart in a ring of fifty cameras
    size = 0.025 * WIDTH / abs(scale[0])
    forward, right = rotation[:, 2] @ axes.T, rotation[:, 0] @ axes.T
    for i, idx in enumerate(registered):
        corners = np.array([[0, 0], forward[i] - 0.5 * right[i], forward[i] + 0.5 * right[i]]) * size + centers[i]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in to_page(corners))
        fill = ' fill="#2f6fd1aa"' if idx >= len(model.image_names) - new else ""
        parts.append(f'<polygon points="{path}"{fill}><title>{escape(model.image_names[idx])}</title></polygon>')
    style = 'stroke-linecap="round" stroke-width="2.2" fill="#d1372c66"'
    return f'<svg viewBox="0 0 {WIDTH:.0f} {HEIGHT:.0f}" {style}>{"".join(parts)}</svg>'


def ground_axes(rotation: Array) -> Array:
    """(2, 3) right and forward, both across the mean downward direction of cameras with cam_from_world (R, 3, 3)."""
    down = rotation[:, 1].mean(0)
    # images that are turned against each other have no common downward direction: any will do
    down = down / np.linalg.norm(down) if np.linalg.norm(down) > 1e-3 else rotation[0, 1]
    forward = rotation[0, 2] - down * (rotation[0, 2] @ down)
    if np.linalg.norm(forward) < 1e-3:
        forward = rotation[0, 0] - down * (rotation[0, 0] @ down)
    forward /= np.linalg.norm(forward)
    return np.array([np.cross(down, forward), forward])


def fit_page(points: Array, centers: Array) -> tuple[Array, Array]:
    """Scale (2,) and offset (2,) that fit the cameras and all but the most distant points into the page."""
    shown = centers
    if len(points):
        shown = np.concatenate([centers, np.percentile(points, [3, 97], axis=0)])
    low, high = shown.min(0), shown.max(0)
    size = np.maximum(high - low, 1e-12 + 1e-3 * (high - low).max())
    zoom = 0.88 * min(WIDTH / size[0], HEIGHT / size[1])
    scale = np.array([zoom, -zoom])  # forward is up the page
    return scale, np.array([WIDTH, HEIGHT]) / 2 - scale * (low + high) / 2


def point_paths(xy: Array, rgb: NDArray[np.uint8]) -> list[str]:
    """Dots grouped by coarse colour: one path each, a third of the bytes of single circles."""
    inside = (xy >= 0).all(1) & (xy[:, 0] <= WIDTH) & (xy[:, 1] <= HEIGHT)
    groups: dict[tuple[Any, ...], list[str]] = defaultdict(list)
    for (x, y), color in zip(xy[inside], (rgb[inside] // 52) * 51, strict=True):
        groups[tuple(color.tolist())].append(f"M{x:g} {y:g}h0")
    return [f'<path stroke="rgb{color}" d="{"".join(dots)}"/>' for color, dots in groups.items()]
