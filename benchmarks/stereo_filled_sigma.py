"""Sigma and confidence of disparities that were filled in: fitted on rendered pairs, judged on others and photographs.

    python benchmarks/stereo_filled_sigma.py           # judges what src/sfmapp/stereo/filled_error.py holds
    python benchmarks/stereo_filled_sigma.py --fit     # fits it anew, and writes it there first

Rows and disparities of rendered pairs are off by what a calibration leaves, as in ``stereo_sigma.py``. Pixels count
whose disparity was searched. Worlds in which everything hides something, as in photographs of things, are half of the
fit.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import sfmapp.stereo.filled_error as filled_error
from machine import RESULTS, describe_machine
from rendered_worlds.worlds import cluttered_world, gallery_world, hall_world, room_world, street_world
from sfmapp.stereo.disparity_error import RESIDUAL_SHARE, with_residual
from sfmapp.stereo.filled_error import FilledTable, filled_cues
from sfmapp.stereo.match import match_pair
from sfmapp.stereo.options import MatcherName, StereoOptions
from stereo_pairs import Shot, StereoSet, rendered_set, shared_sets, shots
from stereo_sigma import FLOOR_PX, PIXELS, ROUNDED, bent, more_shots, smooth_field

Array = NDArray[np.float64]

MATCHERS: tuple[MatcherName, ...] = ("sgm", "window")
# steps of iterated weights, below which residuals (of logarithms) count as nothing, and how firmly weights are held
STEPS, SMALL, RIDGE = 60, 1e-3, 1e-3


class Sample:
    """Filled pixels of one set and matcher: cues (C, N), errors (N,) with what a calibration leaves, pixels; standard
    deviation of that, and what the truth is rounded to."""

    def __init__(self, case: StereoSet, matcher: MatcherName, seed: int | None) -> None:
        self.set, self.matcher = case.name, matcher
        self.residual, self.step = RESIDUAL_SHARE * case.truth.shape[1], ROUNDED.get(case.name, 0.0)
        left = np.zeros(case.truth.shape, np.float32)
        if seed is not None:
            case, left = bent(case, seed), smooth_field(case.truth.shape, self.residual, [8, seed])
        low, count = case.search
        options = StereoOptions(matcher=matcher, min_disparity=low, num_disparities=count, fill=True)
        found = match_pair(case.pair, options)
        cues, place = filled_cues(found)
        truth = case.truth.ravel()[place]
        chosen = np.flatnonzero((truth > low - 0.5) & (truth < low + count - 0.5))
        if len(chosen) > PIXELS:
            chosen = np.random.default_rng(0).choice(chosen, PIXELS, replace=False)
        self.cues, place = cues[:, chosen], place[chosen]
        self.exact = (found.disparity - case.truth).ravel()[place].astype(np.float64)
        self.errors = self.exact + left.ravel()[place]


def cluttered_shots(seeds: Sequence[int]) -> Iterator[Shot]:
    """Worlds in which everything hides something, at sizes and baselines of photographs."""
    cameras = (((741, 500), 700.0, 0.16, 112), ((450, 375), 500.0, 0.16, 80), ((1100, 900), 1200.0, 0.16, 192),
               ((752, 480), 600.0, 0.12, 80), ((640, 480), 560.0, 0.2, 112),
               ((1000, 800), 1000.0, 0.16, 160))  # fmt: skip
    for seed in seeds:
        size, focal, baseline, count = cameras[seed % len(cameras)]
        world = cluttered_world(seed)
        yield Shot(f"clutter {seed}", world, (0.0, 0.0, 1.4), 0.0, 0.0, baseline, focal, size, 0.0, (0, count))


def fresh_shots() -> Iterator[Shot]:
    """Pairs that have no part in the fit."""
    vga, wide = (752, 480), (1241, 376)
    yield Shot("room 5", room_world(5), (1.2, -1.2, 1.5), 130.0, -10.0, 0.13, 600.0, vga, 0.0, (0, 96))
    yield Shot("gallery 4", gallery_world(4), (-0.8, -1.0, 1.5), 50.0, -8.0, 0.18, 620.0, vga, 0.0, (0, 80))
    yield Shot("hall 5", hall_world(5), (1.0, -4.0, 1.7), 80.0, -7.0, 0.30, 600.0, vga, 0.0, (0, 80))
    yield Shot("street 6", street_world(6), (-18.0, -1.6, 1.65), 0.0, -1.0, 0.537, 719.0, wide, 0.0, (0, 208))
    yield from cluttered_shots(range(6, 9))


def fit(samples: Sequence[Sample]) -> FilledTable:
    """A table of samples that count the same; those of clutter together as much as all others."""
    cues = np.concatenate([sample.cues for sample in samples], axis=1)
    errors = np.abs(np.concatenate([sample.exact for sample in samples]))
    is_clutter = np.array([sample.set.startswith("clutter") for sample in samples])
    share = np.where(is_clutter, 1.0 / max(int(is_clutter.sum()), 1), 1.0 / max(int((~is_clutter).sum()), 1))
    sizes = [len(sample.exact) for sample in samples]
    weight = np.concatenate([np.full(n, s / max(n, 1)) for n, s in zip(sizes, share, strict=True)])
    weight /= weight.sum()
    frame = FilledTable(cues.mean(1).tolist(), cues.std(1).tolist(), (), (), ())
    design = frame.normalised(cues).astype(np.float64)
    logs = np.log(np.hypot(errors, FLOOR_PX))
    quantiles = [_quantile(design, logs, weight, share) for share in (0.68, 0.95)]
    odds = _logistic(design, errors < 1.0, weight)
    return FilledTable(frame.centers, frame.spreads, *(row.tolist() for row in (*quantiles, odds)))


def _quantile(design: Array, values: Array, weight: Array, share: float) -> Array:
    """Weights of a linear quantile, by least squares whose weights make absolute values of squares."""
    found = np.zeros(design.shape[1])
    held = RIDGE * np.diag([0.0] + [1.0] * (design.shape[1] - 1))
    for _ in range(STEPS):
        off = values - design @ found
        firm = weight * np.where(off > 0.0, share, 1.0 - share) / np.maximum(np.abs(off), SMALL)
        found = np.linalg.solve((design * firm[:, None]).T @ design + held, (design * firm[:, None]).T @ values)
    return found


def _logistic(design: Array, is_right: NDArray[np.bool_], weight: Array) -> Array:
    found = np.zeros(design.shape[1])
    held = RIDGE * np.diag([0.0] + [1.0] * (design.shape[1] - 1))
    for _ in range(20):
        chance = 1.0 / (1.0 + np.exp(-design @ found))
        curvature = (design * (weight * chance * (1.0 - chance))[:, None]).T @ design + held
        found += np.linalg.solve(curvature, design.T @ (weight * (is_right - chance)) - held @ found)
    return found


def judge(table: FilledTable, sample: Sample) -> dict[str, Any]:
    """Shares of the errors that are inside."""
    sigma, wide, confidence = with_residual(table.read(sample.cues), sample.residual)
    errors, rounding = np.abs(sample.errors), sample.step**2 / 12.0
    return {
        "set": sample.set, "matcher": sample.matcher, "num_pixels": len(errors),
        "inside_68": 100.0 * float((errors <= np.sqrt(sigma**2 + rounding)).mean()),
        "inside_95": 100.0 * float((errors <= np.sqrt(wide**2 + 1.96**2 * rounding)).mean()),
        "confidence": 100.0 * float(confidence.mean()), "below_1_px": 100.0 * float((errors < 1.0).mean()),
        "median_sigma_px": float(np.median(sigma)), "median_95_px": float(np.median(wide)),
    }  # fmt: skip


def write_table(table: FilledTable, path: Path) -> None:
    """Put the table into the source, in place of the one that is there."""
    text = path.read_text(encoding="utf-8")
    lines = ["FILLED_TABLE = FilledTable("]
    lines += [f"    {name}=({', '.join(f'{value:.4g}' for value in row)})," for name, row in vars(table).items()]
    path.write_text(text[: text.index("FILLED_TABLE = ")] + "\n".join([*lines, ")  # fmt: skip", ""]), encoding="utf-8")


def markdown(report: dict[str, Any]) -> str:
    """The tables."""
    lines = ["# Sigma and confidence of filled disparities", ""]
    lines += [f"{report['date']}, {report['commit']}, {report['cpu']}", ""]
    lines += ["Shares of true errors inside the intervals that are told, %.", ""]
    head = (
        "set",
        "matcher",
        "inside 68 %",
        "inside 95 %",
        "confidence %",
        "below 1 px %",
        "median sigma px",
        "of 95 %",
    )
    keys = ("inside_68", "inside_95", "confidence", "below_1_px", "median_sigma_px", "median_95_px")
    for title, runs in report["runs"].items():
        lines += [f"## {title}", "", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
        for run in runs:
            cells = [run["set"], run["matcher"], *(f"{run[key]:.{2 if key.endswith('px') else 1}f}" for key in keys)]
            lines.append("| " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fit", action="store_true", help="fit the table anew, and write it into the source")
    parser.add_argument("-o", "--out", type=Path, default=RESULTS / "stereo_filled_sigma.json")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    table = filled_error.FILLED_TABLE
    if args.fit:
        of_fit = [*shots(), *more_shots(), *cluttered_shots(range(6))]
        table = fit([Sample(case, one, n) for n, case in enumerate(map(rendered_set, of_fit)) for one in MATCHERS])
        write_table(table, Path(filled_error.__file__))
    root = Path(os.environ.get("SFMAPP_DATA", "../shared/data"))
    photographs = [Sample(case, one, None) for case in shared_sets(root) for one in MATCHERS]
    fresh = [Sample(case, one, 100 + n) for n, case in enumerate(map(rendered_set, fresh_shots())) for one in MATCHERS]
    runs = {
        "Photographs": [judge(table, sample) for sample in photographs],
        "Rendered pairs that had no part in the fit": [judge(table, sample) for sample in fresh],
    }
    report = {**describe_machine(), "runs": runs}
    args.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    args.out.with_suffix(".md").write_text(markdown(report), encoding="utf-8")
    print(markdown(report))


if __name__ == "__main__":
    main()
