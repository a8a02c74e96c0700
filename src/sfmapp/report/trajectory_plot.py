"""A trajectory against the ground truth as a picture: from above with its error in colours, and its errors over
time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.evaluation.trajectory import AbsoluteError, Pairs, Trajectory
from sfmapp.report.drawing import Color, Drawing, colormap
from sfmapp.report.plots import ticks

Array = NDArray[np.float64]

WIDTH, HEIGHT = 2000, 1240
_MARGIN = 64.0
_LEFT = 118.0
_INK: Color = (32, 36, 42)
_DIM: Color = (104, 112, 122)
_GRID: Color = (232, 234, 237)
_FRAME: Color = (190, 195, 201)
_GROUND_TRUTH: Color = (190, 197, 206)
_GROUND_TRUTH_DARK: Color = (128, 137, 148)
_GAP: Color = (252, 228, 226)
_LINE: Color = (62, 30, 160)
_START: Color = (28, 146, 92)
_END: Color = (32, 36, 42)
# more corners than this are not to be seen on the canvas
_MAX_CORNERS = 4000
# a scale for errors begins here (metres, degrees): less is rounding
_ROUNDING = 1e-9
# a view this much wider than tall gets the whole width
_WIDE = 1.9


@dataclass(frozen=True)
class _Panel:
    """A rectangle of the page, in pixels."""

    left: float
    top: float
    right: float
    bottom: float

    @property
    def width(self) -> float:
        return self.right - self.left

    @property
    def height(self) -> float:
        return self.bottom - self.top


@dataclass(frozen=True)
class _View:
    """Two axes of the ground truth's world on a panel, to the same scale."""

    panel: _Panel
    axes: tuple[int, int]
    low: Array
    zoom: float

    def to_page(self, position: Array) -> Array:
        """(N, 2) pixels of positions (N, 3)."""
        flat = (position[:, self.axes] - self.low) * self.zoom
        return np.stack([self.panel.left + flat[:, 0], self.panel.bottom - flat[:, 1]], 1)


def write_trajectory_plot(
    path: Path, pairs: Pairs, error: AbsoluteError, ground_truth: Trajectory, title: str, facts: Sequence[str]
) -> None:
    """Draw the aligned estimate over the ground truth, and what it is off by, as a PNG.

    The view is along the axis of the ground truth's world in which it extends least. Below or beside it: distance and
    angle to the ground truth, and the coordinate along the view.

    Args:
        path: where to write.
        pairs, error: of :mod:`sfmapp.evaluation.trajectory`.
        ground_truth: all of it, the part without an estimate included.
        title, facts: the head line, and what stands below it.

    Raises:
        InputError: the file cannot be written.
    """
    page = Drawing(WIDTH, HEIGHT)
    whole = ground_truth[ground_truth.has_pose]
    shown = np.concatenate([whole.position, error.aligned.position])
    axes, across = _plane(whole.position)
    extent = np.maximum(np.ptp(shown[:, axes], axis=0), 1e-9)
    map_panel, strips = _layout(float(extent[0] / extent[1]))
    _head(page, title, facts)
    view = _fit(map_panel, shown, axes)
    _draw_view(page, view, whole, pairs, error)
    _draw_strips(page, strips, ground_truth, pairs, error, across)
    page.write_png(path)


def _plane(position: Array) -> tuple[tuple[int, int], int]:
    """The two axes of greatest extent, the lower one to the right of the page, and the third."""
    across = int(np.argmin(np.ptp(position, axis=0)))
    right, up = (axis for axis in range(3) if axis != across)
    return (right, up), across


def _layout(aspect: float) -> tuple[_Panel, list[_Panel]]:
    """Panels of the view and of the three strips: below each other beside a tall view, in a row below a wide one."""
    top, bottom, right = 214.0, HEIGHT - 74.0, WIDTH - _MARGIN
    if aspect > _WIDE:
        height = min(max((right - _MARGIN - 110) / aspect * 1.15, 300.0), 620.0)
        view = _Panel(_LEFT, top, right - 110, top + height)
        width = (right - _LEFT - 2 * 84) / 3
        lefts = [_LEFT + k * (width + 84) for k in range(3)]
        return view, [_Panel(left, view.bottom + 134, left + width, bottom) for left in lefts]
    width = min(max((bottom - top) * aspect * 1.1, 640.0), 1120.0)
    view = _Panel(_LEFT, top, _LEFT + width, bottom)
    left, gap = view.right + 220, 74.0
    height = (bottom - top - 2 * gap) / 3
    tops = [top + k * (height + gap) for k in range(3)]
    return view, [_Panel(left, y, right, y + height) for y in tops]


def _head(page: Drawing, title: str, facts: Sequence[str]) -> None:
    size = 36
    while page.text_width(title, size, 600) > WIDTH - 2 * _MARGIN and size > 18:
        size -= 1
    page.text(title, _MARGIN, 76, size, _INK, 600)
    page.text("   ·   ".join(facts), _MARGIN, 116, 21, _DIM)


# ----------------------------------------------------------------------------------------------------------- the view


def _fit(panel: _Panel, shown: Array, axes: tuple[int, int]) -> _View:
    low, high = shown[:, axes].min(0), shown[:, axes].max(0)
    # a trajectory that stays in one place is a dot in the middle of a metre
    size = np.maximum(high - low, 1e-6 * float((high - low).max()) or 1.0)
    zoom = 0.88 * min(panel.width / size[0], panel.height / size[1])
    return _View(panel, axes, (low + high) / 2 - np.array([panel.width, panel.height]) / zoom / 2, zoom)


def _draw_view(page: Drawing, view: _View, ground_truth: Trajectory, pairs: Pairs, error: AbsoluteError) -> None:
    panel = view.panel
    _view_grid(page, view)
    stride = -(-len(ground_truth) // _MAX_CORNERS)
    page.line(view.to_page(ground_truth.position[::stride]), _GROUND_TRUTH, 9)
    stride = -(-len(pairs) // _MAX_CORNERS)
    xy, errors = view.to_page(error.aligned.position[::stride]), error.translation_m[::stride]
    worst = max(float(error.translation_m.max()), _ROUNDING)
    # a gap that falls between two shown corners is one between them
    is_gap = np.maximum.reduceat(pairs.is_gap[1:], np.arange(0, len(pairs) - 1, stride))[: len(xy) - 1]
    for k in np.flatnonzero(is_gap):
        page.dashes(xy[k : k + 2], _GROUND_TRUTH_DARK, 2)
    tone = np.where(is_gap, np.nan, (errors[1:] + errors[:-1]) / 2 / worst)
    for start, end in _runs(~is_gap):
        page.colored_line(xy[start : end + 1], colormap(tone[start:end]), 4.5)
    for k in np.flatnonzero(np.append(is_gap, True) & np.insert(is_gap, 0, True)):  # a pose between two gaps
        page.disc(xy[k], 2.2, _color(errors[k] / worst))
    page.disc(xy[-1], 8, _END, (255, 255, 255))
    page.disc(xy[0], 8, _START, (255, 255, 255))
    _legend(page, panel, has_gaps=bool(is_gap.any()))
    _scale_bar(page, view, np.concatenate([xy, view.to_page(ground_truth.position)]))
    _color_bar(page, panel, worst)


def _runs(wanted: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and one past the last of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], wanted.astype(np.int8), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _color(value: float) -> Color:
    red, green, blue = colormap(np.array([value]))[0].tolist()
    return red, green, blue


def _view_grid(page: Drawing, view: _View) -> None:
    panel = view.panel
    size = np.array([panel.width, panel.height]) / view.zoom
    high = view.low + size
    # the same step on both axes: squares
    marks = ticks(0.0, float(size.max()), int(np.clip(3 * size.max() / size.min(), 8, 20)))
    step = marks[1] - marks[0]
    for k, name in enumerate("xyz"[axis] for axis in view.axes):
        values = np.arange(np.ceil(view.low[k] / step - 1e-9), np.floor(high[k] / step + 1e-9) + 1) * step
        texts = _labels(values)
        for value, text in zip(values, texts, strict=True):
            offset = (value - view.low[k]) * view.zoom
            if k == 0:
                x = panel.left + offset
                page.line(np.array([[x, panel.top], [x, panel.bottom]]), _GRID, 1.5)
                page.text(text, x, panel.bottom + 28, 19, _DIM, anchor="middle")
            else:
                y = panel.bottom - offset
                page.line(np.array([[panel.left, y], [panel.right, y]]), _GRID, 1.5)
                page.text(text, panel.left - 12, y + 7, 19, _DIM, anchor="end")
        if k == 0:
            page.text(f"{name}, m", (panel.left + panel.right) / 2, panel.bottom + 58, 20, _INK, anchor="middle")
        else:
            page.text(f"{name}, m", panel.left - 12, panel.top - 14, 20, _INK, anchor="end")
    _frame(page, panel)


def _ticks(low: float, high: float, least: int) -> Array:
    """Round numbers, at least so many of them."""
    tries = (ticks(low, high, about) for about in range(least, 6 * least))
    return np.array(next((values for values in tries if len(values) >= least), [low]))


def _labels(values: Array) -> list[str]:
    """Numbers with as many digits as tell the neighbours apart."""
    step = float(np.diff(values).min(initial=np.abs(values).max(initial=1.0)))
    digits = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    texts = [f"{value + 0.0:.{digits}f}" if digits < 5 else f"{value + 0.0:.3g}" for value in values]
    return [text.replace("-", "\N{MINUS SIGN}") for text in texts]


def _frame(page: Drawing, panel: _Panel) -> None:
    corners = [
        [panel.left, panel.top],
        [panel.right, panel.top],
        [panel.right, panel.bottom],
        [panel.left, panel.bottom],
    ]
    page.line(np.array([*corners, corners[0]]), _FRAME, 1.5)


def _legend(page: Drawing, panel: _Panel, *, has_gaps: bool) -> None:
    x, y = panel.left + 60, panel.top - 21

    def entry(text: str, sample: float) -> None:
        nonlocal x
        page.text(text, x + sample + 12, y + 7, 20, _INK)
        x += sample + 12 + page.text_width(text, 20) + 40

    page.line(np.array([[x, y], [x + 44, y]]), _GROUND_TRUTH, 9)
    entry("ground truth", 44)
    tones = np.linspace(0, 1, 45)
    page.colored_line(np.stack([x + np.arange(45.0), np.full(45, y)], 1), colormap(tones[1:]), 4.5)
    entry("estimate", 44)
    if has_gaps:
        page.dashes(np.array([[x, y], [x + 44, y]]), _GROUND_TRUTH_DARK, 2)
        entry("gap", 44)
    page.disc(np.array([x + 8, y]), 8, _START, (255, 255, 255))
    entry("start", 16)
    page.disc(np.array([x + 8, y]), 8, _END, (255, 255, 255))
    entry("end", 16)


def _scale_bar(page: Drawing, view: _View, drawn: Array) -> None:
    """A round length, in the lower or upper corner with the fewest points."""
    panel = view.panel
    longest = 0.24 * panel.width / view.zoom
    power = 10.0 ** np.floor(np.log10(longest))
    length = float(max(power * factor for factor in (1, 2, 5) if power * factor <= longest))
    width = length * view.zoom
    text = f"{length:g} m"
    boxes: list[tuple[int, int, float, float, float]] = []
    for right in (panel.right - 28, panel.left + 28 + width):
        for bottom in (panel.bottom - 26, panel.top + 58):
            left, top = right - width, bottom - 44
            margin = 16
            inside = (drawn > (left - margin, top - margin)).all(1) & (drawn < (right + margin, bottom + margin)).all(1)
            boxes.append((int(inside.sum()), len(boxes), left, right, bottom))
    _, _, left, right, bottom = min(boxes)
    page.box(left - 12, bottom - 38, right + 12, bottom + 12, (255, 255, 255))
    bar = [[left, bottom - 7], [left, bottom], [right, bottom], [right, bottom - 7]]
    page.line(np.array(bar), _INK, 2.5)
    page.text(text, (left + right) / 2, bottom - 12, 20, _INK, 500, "middle")


def _color_bar(page: Drawing, panel: _Panel, worst: float) -> None:
    left, right = panel.right + 22, panel.right + 40
    height = min(panel.height, 460.0)
    bottom = panel.bottom
    top = bottom - height
    page.gradient(round(left), round(top), round(right), round(bottom), colormap(np.linspace(0, 1, 256)))
    values = _ticks(0.0, worst, 5)
    for value, text in zip(values, _labels(values), strict=True):
        y = bottom - value / worst * height
        page.line(np.array([[right, y], [right + 6, y]]), _DIM, 1.5)
        page.text(text, right + 13, y + 7, 19, _DIM)
    page.text("error, m", left, top - 14, 20, _INK)


# --------------------------------------------------------------------------------------------------------- the strips


@dataclass(frozen=True)
class _Strip:
    """Values over time on a panel.

    Attributes:
        begin, end: of the time. low, high: of the values.
        gaps: times without an estimate, (from, to).
    """

    panel: _Panel
    begin: float
    end: float
    low: float
    high: float
    gaps: Sequence[tuple[float, float]]

    def x(self, time: Array) -> Array:
        return self.panel.left + (time - self.begin) / ((self.end - self.begin) or 1.0) * self.panel.width

    def y(self, values: Array) -> Array:
        return self.panel.bottom - (values - self.low) / (self.high - self.low) * self.panel.height

    def points(self, time: Array, values: Array, gaps: NDArray[np.bool_] | None = None) -> Array:
        """(N, 2) pixels, with a row of NaN before each gap."""
        points = np.stack([self.x(time), self.y(values)], 1)
        return points if gaps is None else np.insert(points, np.flatnonzero(gaps), np.nan, axis=0)


def _draw_strips(
    page: Drawing, panels: Sequence[_Panel], ground_truth: Trajectory, pairs: Pairs, error: AbsoluteError, across: int
) -> None:
    has_time = pairs.ground_truth.timestamps_s is not None
    moments = (
        ground_truth.timestamps_s
        if ground_truth.timestamps_s is not None
        else np.arange(len(ground_truth), dtype=np.float64)
    )
    true_time = moments[ground_truth.has_pose]
    start = float(true_time.min()) if has_time else 0.0
    time, true_time = pairs.clock - start, true_time - start
    span = float(true_time.min()), float(true_time.max())
    gaps = _gaps(time, pairs.is_gap, span)
    is_stacked, label = panels[0].left == panels[-1].left, "time, s" if has_time else "frame"
    names = "position error, m", "rotation error, degrees"
    for panel, title, values in zip(panels[:2], names, (error.translation_m, error.rotation_deg), strict=True):
        strip = _Strip(panel, *span, 0.0, 1.08 * max(float(values.max()), _ROUNDING), gaps)
        _strip_grid(page, strip, title, "" if is_stacked else label)
        page.line(strip.points(time, values, pairs.is_gap), _LINE, 2)
        rmse = float(np.sqrt((values**2).mean()))
        page.dashes(strip.points(np.array(span), np.full(2, rmse)), _DIM, 1.5)
        page.text(f"rmse {rmse:.3g}", panel.right, panel.top - 14, 20, _DIM, anchor="end")
    true, ours = ground_truth.position[ground_truth.has_pose, across], error.aligned.position[:, across]
    low, high = float(min(true.min(), ours.min())), float(max(true.max(), ours.max()))
    margin = 0.08 * (high - low) or 1.0
    strip = _Strip(panels[2], *span, low - margin, high + margin, gaps)
    _strip_grid(page, strip, f"{'xyz'[across]}, m, across the view", label)
    page.line(strip.points(true_time, true), _GROUND_TRUTH, 6)
    page.line(strip.points(time, ours, pairs.is_gap), _LINE, 2)


def _gaps(time: Array, is_gap: NDArray[np.bool_], span: tuple[float, float]) -> list[tuple[float, float]]:
    """From where to where there is no estimate, the ends of the ground truth included."""
    gaps = [(float(time[k - 1]), float(time[k])) for k in np.flatnonzero(is_gap)]
    step = 2.5 * float(np.median(np.diff(time)))
    return gaps + [(a, b) for a, b in ((span[0], float(time[0])), (float(time[-1]), span[1])) if b - a > step]


def _strip_grid(page: Drawing, strip: _Strip, title: str, label: str) -> None:
    panel = strip.panel
    for first, last in strip.gaps:
        left, right = strip.x(np.array([first, last])).tolist()
        page.box(left, panel.top, right, panel.bottom, _GAP)
    values = _ticks(strip.low, strip.high, 4)
    for y, text in zip(strip.y(values).tolist(), _labels(values), strict=True):
        page.line(np.array([[panel.left, y], [panel.right, y]]), _GRID, 1.5)
        page.text(text, panel.left - 12, y + 7, 19, _DIM, anchor="end")
    times = _ticks(strip.begin, strip.end, 5)
    for x, text in zip(strip.x(times).tolist(), _labels(times), strict=True):
        page.line(np.array([[x, panel.top], [x, panel.bottom]]), _GRID, 1.5)
        if label:
            page.text(text, x, panel.bottom + 28, 19, _DIM, anchor="middle")
    if label:
        page.text(label, (panel.left + panel.right) / 2, panel.bottom + 58, 20, _INK, anchor="middle")
    _frame(page, panel)
    page.text(title, panel.left, panel.top - 14, 20, _INK, 500)
