"""What page and recording of a pair choose to draw: some of many, spread evenly."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from sfmapp.twoview.story import Story

Array = NDArray[np.float64]


def spread(num: int, most: int) -> NDArray[np.int64]:
    """Positions of at most so many of them, at equal steps."""
    return np.unique(np.linspace(0, max(num - 1, 0), min(num, most)).astype(np.int64))


def spread_points(xy: Array, most: int) -> NDArray[np.int64]:
    """Positions of at most so many points (N, 2), each as far from those before it as there is one."""
    if not len(xy):
        return np.zeros(0, np.int64)
    chosen = [int(np.argmin(np.linalg.norm(xy - xy.mean(0), axis=1)))]
    nearest = np.linalg.norm(xy - xy[chosen[0]], axis=1)
    while len(chosen) < min(most, len(xy)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(xy - xy[chosen[-1]], axis=1))
    return np.array(chosen, np.int64)


def clip_lines(lines: Array, size: tuple[int, int]) -> Array:
    """(L, 2, 2) ends of lines (L, 3), a x + b y + c = 0, within a picture of (width, height); NaN outside."""
    out = np.full((len(lines), 2, 2), np.nan)
    width, height = size
    for k, (a, b, c) in enumerate(lines):
        ends = [(x, -(a * x + c) / b) for x in (0.0, width) if b != 0.0]
        ends += [(-(b * y + c) / a, y) for y in (0.0, height) if a != 0.0]
        slack = 1e-9 * (width + height)
        inside = [e for e in ends if -slack <= e[0] <= width + slack and -slack <= e[1] <= height + slack]
        if len(inside) >= 2:
            # through a corner there are three: the two that are farthest apart
            far = max(((p, q) for p in inside for q in inside), key=lambda pair: np.hypot(*np.subtract(*pair)))
            out[k] = far
    return out


def with_reach(story: Story) -> float:
    """How far the points of the best pose are from camera 1, all but the farthest, in baselines; at least 1.5."""
    choice = story.report.choice
    if choice is None:
        return 1.5
    points = story.points[choice.best]
    lengths = np.linalg.norm(points[np.isfinite(points).all(1)], axis=1)
    return 1.15 * max(float(np.percentile(lengths, 85)) if len(lengths) else 1.0, 1.5)
