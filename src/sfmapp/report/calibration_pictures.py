"""Pictures of a calibration as SVG: what is left at the points, where there were any, how sure projections are."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera

Array = NDArray[np.float64]

_WIDTH = 480.0
# cells along the width of a picture
_CELLS = 16
_STANDALONE = 'xmlns="http://www.w3.org/2000/svg" width="960"'


def _frame(camera: Camera, body: Sequence[str], *, is_file: bool = False) -> str:
    height = _WIDTH * camera.height / camera.width
    more = _STANDALONE if is_file else 'class="view"'
    border = f'<rect width="{_WIDTH}" height="{height:.1f}" fill="#8881" stroke="#8886"/>'
    return f'<svg {more} viewBox="0 0 {_WIDTH:.0f} {height:.0f}">{border}{"".join(body)}</svg>'


def _cells(camera: Camera, xy: Array) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """The cell that each pixel is in, row by row, and how many columns and rows there are."""
    rows = max(1, round(_CELLS * camera.height / camera.width))
    place = np.floor(xy * [_CELLS / camera.width, rows / camera.height]).astype(np.int64)
    c, r = np.clip(place[:, 0], 0, _CELLS - 1), np.clip(place[:, 1], 0, rows - 1)
    return r * _CELLS + c, (_CELLS, rows)


def residual_field_svg(camera: Camera, xy: Array, residuals: Array) -> str:
    """Mean residuals of points (N, 2) cell by cell, as arrows: what the lens model cannot explain points one way."""
    cell, (columns, rows) = _cells(camera, xy)
    counts = np.bincount(cell, minlength=columns * rows)
    sums = [np.bincount(cell, residuals[:, k], columns * rows) for k in range(2)]
    is_known = counts >= 3
    mean = np.stack([total[is_known] / counts[is_known] for total in sums], 1)
    r, c = np.divmod(np.flatnonzero(is_known), columns)
    middle = np.stack([(c + 0.5) * camera.width / columns, (r + 0.5) * camera.height / rows], 1)
    return arrows_svg(camera, middle, mean, "mean residual")


def arrows_svg(camera: Camera, xy: Array, arrows: Array, label: str, *, is_file: bool = False) -> str:
    """Arrows (N, 2) in pixels at pixels (N, 2), enlarged until the longest spans a cell; NaN for none."""
    length = np.hypot(arrows[:, 0], arrows[:, 1])
    largest = float(np.nanmax(length)) if np.isfinite(length).any() else 0.0
    scale = _WIDTH / camera.width
    enlarged = 0.9 * camera.width / _CELLS / largest if largest > 0 else 0.0
    body = []
    for (x, y), (dx, dy) in zip(xy, arrows, strict=True):
        if np.isfinite(dx + dy):
            path = f"M{x * scale:.1f} {y * scale:.1f}l{dx * enlarged * scale:.1f} {dy * enlarged * scale:.1f}"
            body.append(f'<circle cx="{x * scale:.1f}" cy="{y * scale:.1f}" r="1.3" fill="#4a7fd4"/>')
            body.append(f'<path d="{path}" stroke="#d1372c" stroke-width="1.3" fill="none"/>')
    body.append(_label(camera, f"{label}, largest {largest:.3g} px"))
    return _frame(camera, body, is_file=is_file)


def coverage_svg(camera: Camera, xy: Array, is_used: NDArray[np.bool_]) -> str:
    """Points (N, 2) of all views; those that were left aside in red."""
    scale = _WIDTH / camera.width
    body = [
        f'<circle cx="{x * scale:.1f}" cy="{y * scale:.1f}" r="1.4" fill="{"#2a9d4a" if used else "#d1372c"}"/>'
        for (x, y), used in zip(xy, is_used, strict=True)
    ]
    return _frame(camera, [*body, _label(camera, f"{int(is_used.sum())} points")])


def heat_svg(camera: Camera, values: Array, shape: tuple[int, int], unit: str) -> str:
    """Values (N,) of equal cells, row by row, light for small ones; each cell names its own. NaN for none."""
    scale = _WIDTH / camera.width
    width, height = camera.width * scale / shape[0], camera.height * scale / shape[1]
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    body = []
    for n, value in enumerate(values):
        if np.isfinite(value):
            share = np.log(value / low) / np.log(high / low) if high > low > 0 else 0.0
            x, y = n % shape[0] * width, n // shape[0] * height
            place = f'x="{x:.1f}" y="{y:.1f}" width="{width + 0.3:.1f}" height="{height + 0.3:.1f}"'
            color = f'fill="#d1372c" fill-opacity="{0.05 + 0.8 * share:.2f}"'
            body.append(f"<rect {place} {color}><title>{value:.3g} {escape(unit)}</title></rect>")
    return _frame(camera, [*body, _label(camera, f"{low:.3g} to {high:.3g} {unit}")])


def outlines_svg(camera: Camera, outlines: Sequence[Array], seen: Array) -> str:
    """Outlines (K, 2) of boards to be photographed, numbered, over the points (N, 2) that there are."""
    scale = _WIDTH / camera.width
    colors = ("#d1372c", "#e0a100", "#4a7fd4")
    body = [f'<circle cx="{x * scale:.1f}" cy="{y * scale:.1f}" r="1" fill="#8886"/>' for x, y in seen]
    for n, outline in enumerate(outlines):
        points = " ".join(f"{x * scale:.1f},{y * scale:.1f}" for x, y in outline)
        color, (x, y) = colors[n % len(colors)], outline.mean(0) * scale
        body.append(f'<polygon points="{points}" fill="{color}" fill-opacity=".15" stroke="{color}" stroke-width="2"/>')
        body.append(f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="middle">{n + 1}</text>')
    return _frame(camera, body)


def _label(camera: Camera, text: str) -> str:
    height = _WIDTH * camera.height / camera.width
    return f'<text x="6" y="{height - 6:.1f}" font-size="13">{escape(text)}</text>'
