"""Semi-global matching on zero-mean normalised cross-correlation (ZNCC) instead of census: what else costs could be.

Paths, levels, penalties and the choice of disparities are those of :mod:`sfmapp.stereo.semiglobal`; only the cost of
two pixels is another one, 24 (1 - ZNCC) of windows about them. That is 24 of what is not alike and up to 48, as census
has it, so the penalties mean the same.

Each pixel looks at disparities from a base of its own, so sums of windows cannot be shared between neighbours: the time
goes with the area of the window.
"""

from __future__ import annotations

import json
import os
import time
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from machine import RESULTS, describe_machine
from sfmapp.images.pixels import as_gray
from sfmapp.simd.pointers import pointer
from sfmapp.stereo.matcher import Matcher
from sfmapp.stereo.options import StereoOptions
from sfmapp.stereo.semiglobal import UNSEEN, Level
from sfmapp.stereo.semiglobal_kernels import GAP, LANES, STRIDE, Rows, Views, _smooth_costs, clear
from stereo import ours, scores
from stereo_pairs import StereoSet, shared_sets

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

SIDES = (5, 7, 9)

# of what is not alike; as many bits of 48 differ by chance
UNLIKE = 24.0
# variance that is added to that of a window, of grey values: windows of noise alone are no more alike than others
LEAST_VARIANCE = 4.0


class ZnccLevel(Level):
    """A resolution whose costs are those of windows with so many pixels a side."""

    def __init__(
        self, side: int, height: int, width: int, search: tuple[int, int], *, halve: bool = True
    ) -> None:  # fmt: skip
        super().__init__(height, width, search, halve=halve)
        self.half = side // 2
        if self.coarse is not None:
            self.coarse = ZnccLevel(side, *self.coarse.views.grey.shape, self.coarse.search, halve=False)
        self.pictures: list[Floats] = [np.empty(0, np.float32)] * 2
        self.sums: list[Floats] = [np.empty(0, np.float32)] * 2

    def _transform(self, side: int, grey: Bytes, margin: int, out: NDArray[np.uint64]) -> None:
        super()._transform(side, grey, margin, out)
        reach = self.half + (margin if side else 0)
        picture = np.ascontiguousarray(grey[:, ::-1]) if side else grey
        rim = (self.half, self.half, reach, reach)
        wide = cv2.copyMakeBorder(picture, *rim, cv2.BORDER_REPLICATE).astype(np.float32) - np.float32(128.0)
        size = (2 * self.half + 1,) * 2
        mean, square = (cv2.boxFilter(one, cv2.CV_32F, size) for one in (wide, wide * wide))
        inverse = 1.0 / np.sqrt(np.maximum(square - mean * mean, 0.0) + LEAST_VARIANCE)
        self.pictures[side] = wide
        self.sums[side] = np.ascontiguousarray(np.stack([mean, inverse])[:, self.half : -self.half])

    def fill(self, first: int, last: int, part: int) -> None:
        _fill_costs(
            self.views, np.uint8(UNSEEN), (first, last), self.raw[part], self.rows,
            tuple(self.pictures), tuple(self.sums),
        )  # fmt: skip


def match_by_zncc(left: Bytes, right: Bytes, search: tuple[int, int], side: int) -> Floats:
    """(H, W) disparities as :func:`sfmapp.stereo.matcher.match_by_sgm` finds them, by costs of another kind."""
    height, width = left.shape[:2]
    with Matcher(height, width, search) as matcher:
        level = matcher._level
        matcher._level = ZnccLevel(side, height, width, level.search)
        return matcher.match(as_gray(left), as_gray(right)).disparity.copy()


@numba.njit(cache=True, nogil=True)
def _fill_costs(
    views: Views, unseen: np.uint8, ends: tuple[int, int], raw: Bytes, rows: Rows, pictures: tuple[Floats, Floats],
    sums: tuple[Floats, Floats],
) -> None:  # fmt: skip
    """As ``fill_costs`` does."""
    (first, last), height, ring = ends, views.left.shape[0], rows.costs.shape[0]
    clear(raw)
    for y in range(max(first - 1, 0), min(first + 1, height)):
        _raw_costs(views, y, pictures, sums, raw[y % 3])
    for y in range(first, last):
        if y + 1 < height:
            _raw_costs(views, y + 1, pictures, sums, raw[(y + 1) % 3])
        _smooth_costs(views, unseen, y, raw, pointer(rows.costs[y % ring]))


@numba.njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def _raw_costs(
    views: Views, y: int, pictures: tuple[Floats, Floats], sums: tuple[Floats, Floats], out: Bytes
) -> None:  # fmt: skip
    """Of row y: 24 (1 - ZNCC) for 64 disparities of each pixel; the right picture's columns are reversed."""
    (left, right), (own, other) = pictures, sums
    height, width = views.left.shape
    half = (left.shape[0] - height) // 2
    side = 2 * half + 1
    margin = (right.shape[1] - width) // 2
    count, unlike = np.float32(side * side), np.float32(UNLIKE)
    total = np.empty(LANES, np.float32)
    for x in range(width):
        start = margin + width - 1 - x + np.int64(views.base[y, x])
        total[:] = np.float32(0.0)
        for dy in range(side):
            for dx in range(side):
                value, line = left[y + dy, x + dx], right[y + dy, start + half - dx : start + half - dx + LANES]
                for k in range(LANES):
                    total[k] += value * line[k]
        mean, inverse = own[0, y, x + half], own[1, y, x + half]
        means, inverses = other[0, y, start : start + LANES], other[1, y, start : start + LANES]
        row = out[GAP + STRIDE * x : GAP + STRIDE * x + LANES]
        for k in range(LANES):
            alike = (total[k] / count - mean * means[k]) * inverse * inverses[k]
            row[k] = np.uint8(min(max(unlike * (np.float32(1.0) - alike) + np.float32(0.5), np.float32(0.0)), 48.0))


def main() -> None:
    cv2.setNumThreads(1)
    report: dict[str, Any] = {**describe_machine(), "runs": []}
    about = f"{report['date']}, {report['commit']}, {report['cpu']}"
    lines = ["# ZNCC as the cost of semi-global matching", "", about, ""]
    lines += ["Of pixels that both cameras see; CPU ms of both threads.", ""]
    lines += ["| set | cost | density % | bad-1 | none or bad-1 | CPU |", "|---|---|---|---|---|---|"]
    for case in shared_sets(Path(os.environ.get("SFMAPP_DATA", "../shared/data"))):
        for side in (0, *SIDES):
            run = partial(by_cost, case, side)
            run()  # warms up
            start = time.process_time()
            found = scores(run(), case)
            row = {"set": case.name, "side": side, "cpu_ms": 1e3 * (time.process_time() - start), **found}
            report["runs"].append(row)
            cost = f"ZNCC of {side} px" if side else "census"
            values = [found[key] for key in ("density_visible", "bad1_answered_visible", "wrong_or_none_visible")]
            cells = " | ".join(f"{value:.2f}" for value in values)
            lines.append(f"| {case.name} | {cost} | {cells} | {row['cpu_ms']:.0f} |")
            print(lines[-1], flush=True)
    (RESULTS / "stereo_zncc.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    (RESULTS / "stereo_zncc.md").write_text("\n".join([*lines, ""]), encoding="utf-8")


def by_cost(case: StereoSet, side: int) -> Floats:
    """Disparities by windows with so many pixels a side; 0: by census."""
    if not side:
        return ours(case, StereoOptions())
    return match_by_zncc(case.pair.left, case.pair.right, case.search, side)


if __name__ == "__main__":
    main()
