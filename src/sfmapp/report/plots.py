"""Curves over time as small SVGs, light or dark as the page is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WIDTH, HEIGHT = 1000.0, 210.0
LEFT, RIGHT, TOP, BOTTOM = 62.0, 12.0, 14.0, 34.0
# a page shows no more than one value a pixel; of those that fall together the highest is drawn
MAX_VALUES = 1000


@dataclass(frozen=True)
class Curve:
    """One line of a plot: (N,) values, NaN where there is none, and a colour of CSS."""

    label: str
    values: Array
    color: str


def plot_svg(x: Array, curves: Sequence[Curve], gaps: Sequence[tuple[float, float]], x_label: str) -> str:
    """Curves over ascending x (N,), from zero up, with the gaps (from, to) shaded."""
    if not len(x):
        return ""
    x, curves = _thinned(x, curves)
    top = max([float(np.nanmax(c.values)) for c in curves if np.isfinite(c.values).any()], default=1.0) or 1.0
    x_ticks, y_ticks = ticks(float(x[0]), float(x[-1]), 10), ticks(0.0, top, 4)
    top = max(top, y_ticks[-1])
    span = float(x[-1] - x[0]) or 1.0

    def page_x(value: float) -> float:
        return LEFT + (value - float(x[0])) / span * (WIDTH - LEFT - RIGHT)

    def page_y(value: float) -> float:
        return HEIGHT - BOTTOM - value / top * (HEIGHT - TOP - BOTTOM)

    parts = []
    for first, last in gaps:
        low, high = page_x(first), page_x(last)
        shape = f'x="{low - 1:.1f}" y="{TOP}" width="{high - low + 2:.1f}" height="{HEIGHT - TOP - BOTTOM:.0f}"'
        parts.append(f'<rect {shape} fill="#d1372c" fill-opacity=".25"><title>gap</title></rect>')
    for tick in y_ticks:
        y = page_y(tick)
        parts.append(f'<path class="grid" d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text x="{LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{tick:g}</text>')
    for tick in x_ticks:
        parts.append(f'<text x="{page_x(tick):.1f}" y="{HEIGHT - 17}" text-anchor="middle">{tick:g}</text>')
    parts.append(f'<text x="{WIDTH - RIGHT}" y="{HEIGHT - 3}" text-anchor="end">{escape(x_label)}</text>')
    for place, curve in enumerate(curves):
        points = _path([(page_x(a), page_y(b)) for a, b in zip(x, curve.values, strict=True)])
        parts.append(f'<path d="{points}" stroke="{curve.color}" stroke-width="1.6" fill="none"/>')
        left = LEFT + 8 + 150 * place
        parts.append(f'<path d="M{left} {TOP + 4}h18" stroke="{curve.color}" stroke-width="3"/>')
        parts.append(f'<text x="{left + 24}" y="{TOP + 8}">{escape(curve.label)}</text>')
    return f'<svg class="plot" viewBox="0 0 {WIDTH:.0f} {HEIGHT:.0f}">{"".join(parts)}</svg>'


def bars_svg(edges: Sequence[float], counts: Sequence[int], x_label: str) -> str:
    """A histogram of counts (N) between ascending edges (N + 1), a third of a page wide."""
    width, height, left, bottom = 360.0, 190.0, 56.0, 36.0
    low, span = edges[0], (edges[-1] - edges[0]) or 1.0
    y_ticks = [tick for tick in ticks(0.0, float(max([*counts, 1])), 3) if tick == int(tick)]
    top = max(float(max([*counts, 1])), y_ticks[-1])

    def page_x(value: float) -> float:
        return left + (value - low) / span * (width - left - 10.0)

    def page_y(value: float) -> float:
        return height - bottom - value / top * (height - bottom - TOP)

    parts = []
    for tick in y_ticks:
        parts.append(f'<path class="grid" d="M{left} {page_y(tick):.1f}H{width - 10.0}"/>')
        parts.append(f'<text x="{left - 6}" y="{page_y(tick) + 4:.1f}" text-anchor="end">{_short(tick)}</text>')
    for first, last, count in zip(edges[:-1], edges[1:], counts, strict=True):
        x, y = page_x(first), page_y(count)
        shape = f'x="{x:.1f}" y="{y:.1f}" width="{page_x(last) - x - 1.0:.1f}" height="{page_y(0.0) - y:.1f}"'
        parts.append(f'<rect class="bar" {shape}><title>{count}</title></rect>')
    for tick in ticks(low, edges[-1], 6):
        parts.append(f'<text x="{page_x(tick):.1f}" y="{height - 20:.0f}" text-anchor="middle">{tick:g}</text>')
    parts.append(f'<text x="{width - 10}" y="{height - 4:.0f}" text-anchor="end">{escape(x_label)}</text>')
    return f'<svg class="plot" viewBox="0 0 {width:.0f} {height:.0f}">{"".join(parts)}</svg>'


def _short(count: float) -> str:
    """A round number in the fewest characters: 200k, 1.5M."""
    for factor, letter in ((1e6, "M"), (1e3, "k")):
        if count >= factor:
            return f"{count / factor:g}{letter}"
    return f"{count:g}"


def ticks(low: float, high: float, about: int) -> list[float]:
    """Round numbers from low to high, about so many: steps of 1, 2 or 5 times a power of ten."""
    span = high - low
    if not span > 0:
        return [low]
    raw = span / about
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= 0.999 * raw)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(k * step, 12) for k in range(first, last + 1)]


def _thinned(x: Array, curves: Sequence[Curve]) -> tuple[Array, list[Curve]]:
    if len(x) <= MAX_VALUES:
        return x, list(curves)
    edges = np.linspace(0, len(x), MAX_VALUES + 1).astype(np.int64)[:-1]
    thin = []
    for curve in curves:
        highest = np.fmax.reduceat(curve.values, edges)
        thin.append(Curve(curve.label, highest, curve.color))
    return x[edges], thin


def _path(points: Sequence[tuple[float, float]]) -> str:
    """Straight lines between points, interrupted where a value is missing; one that stands alone is a dot."""
    parts, is_open = [], False
    for x, y in points:
        if math.isfinite(y):
            parts.append(f"L{x:.1f} {y:.1f}" if is_open else f"M{x:.1f} {y:.1f}h0.5")
        is_open = math.isfinite(y)
    return "".join(parts)
