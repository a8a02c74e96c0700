"""Sigma and confidence of disparities: fitted on rendered pairs, judged on photographs with known disparities.

    python benchmarks/stereo_sigma.py                  # judges what src/sfmapp/stereo/error_table.py holds
    python benchmarks/stereo_sigma.py --fit            # fits it anew on the rendered pairs, and writes it there first

Judged as well: each rendered pair by a table of the others, and all of them by one of motorcycle and cones. Rendered
pairs are rectified as calibrations do it: rows are off by a smooth field, and for judgement disparities are too. Where
the truth is rounded (cones to quarters of a pixel, aloe to whole ones), the standard deviation of that, 0.29 of a step,
is added to both intervals; the shares without it stand beside.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import sfmapp.stereo.error_table as error_table
from machine import RESULTS, describe_machine
from rendered_worlds.worlds import gallery_world, hall_world, room_world, street_world
from sfmapp.stereo.disparity_error import RESIDUAL_SHARE, match_cues, with_residual
from sfmapp.stereo.error_table import ErrorTable
from sfmapp.stereo.match import MATCHERS, match_pair
from sfmapp.stereo.options import StereoOptions
from stereo_pairs import Shot, StereoSet, rendered_set, shared_sets, shots

Array = NDArray[np.float64]

# of the truth: steps that it is rounded to, pixels
ROUNDED = {"cones": 0.25, "aloe": 1.0}
# pixels of a set and matcher that count
PIXELS = 6_000
# of the errors, the share that is in the first bins of the score; they grow finer where matches are doubtful
EDGES = np.concatenate([np.linspace(0.0, 0.8, 13), [0.85, 0.9, 0.94, 0.97, 1.0]])
LARGEST_PX, FLOOR_PX, RIDGE = 64.0, 0.05, 1e-3
# of a spoilt map, wrong pieces: some 5 % of the picture
PIECES = 16


class Sample:
    """Pixels of one set and matcher.

    Attributes:
        cues, errors: (C, N) and (N,) pixels, of what the matcher found.
        left: (N,) of rendered pairs, what a calibration leaves of disparities; zero of photographs, whose errors have
            it in them.
        residual, step: standard deviation of what calibration leaves, and what the truth is rounded to, pixels.
    """

    def __init__(self, case: StereoSet, matcher: str, seed: int | None, *, is_spoilt: bool = False) -> None:
        self.set, self.matcher, self.is_rendered = case.name, matcher, seed is not None
        self.residual = RESIDUAL_SHARE * case.truth.shape[1]
        if seed is not None:
            case = bent(case, seed)
        low, count = case.search
        found = match_pair(case.pair, StereoOptions(matcher=matcher, min_disparity=low, num_disparities=count))
        if is_spoilt:
            found = replace(found, disparity=spoilt(found.disparity, [9, seed or 0]))
        cues, known = match_cues(case.pair, found)
        chosen = np.flatnonzero(known & np.isfinite(case.truth))
        if len(chosen) > PIXELS:
            chosen = np.random.default_rng(0).choice(chosen, PIXELS, replace=False)
        self.cues = cues.reshape(len(cues), -1)[:, chosen]
        self.errors = (found.disparity - case.truth).ravel()[chosen].astype(np.float64)
        field = (
            smooth_field(case.truth.shape, self.residual, [8, seed]) if seed is not None else np.zeros(case.truth.shape)
        )
        self.left = field.ravel()[chosen]
        self.step = ROUNDED.get(case.name, 0.0)

    @property
    def unseen(self) -> float:
        """Variance of the errors that no cue tells, squared pixels."""
        return 0.0 if self.is_rendered else self.residual**2 + self.step**2 / 12.0


def more_shots() -> list[Shot]:
    """Rendered pairs beside those of the comparison of matchers."""
    vga = (752, 480)
    return [
        Shot("room, near", room_world(3), (1.0, -1.0, 1.3), 200.0, -8.0, 0.2, 520.0, (640, 480), 0.0, (0, 112)),
        Shot("gallery, wide", gallery_world(2), (0.5, -1.0, 1.6), 20.0, -5.0, 0.25, 700.0, vga, 0.0, (0, 128)),
        Shot("street, narrow", street_world(2), (-10.0, -1.6, 1.65), 0.0, -1.0, 0.3, 719.0, (1000, 376), 0.0, (0, 96)),
        Shot("hall, far", hall_world(3), (0.0, -3.0, 1.5), 30.0, -6.0, 0.15, 800.0, vga, 0.0, (0, 64)),
    ]


def smooth_field(shape: tuple[int, ...], size: float, seed: Sequence[int]) -> NDArray[np.float32]:
    """(H, W) of normal numbers at twelve places, smooth between them."""
    drawn = np.random.default_rng(seed).normal(0.0, size, (3, 4)).astype(np.float32)
    field: NDArray[np.float32] = cv2.resize(drawn, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return field


def spoilt(disparity: NDArray[np.float32], seed: Sequence[int]) -> NDArray[np.float32]:
    """The same with smooth pieces put where nothing matches, as other matchers and worlds may have them; those of these
    rarely fit so badly, and what a bad fit means has to be learnt too."""
    rng = np.random.default_rng(seed)
    out = disparity.copy()
    for _ in range(PIECES):
        height, width = rng.integers(8, 60, 2)
        top, left = rng.integers(0, np.array(out.shape) - (height, width))
        out[top : top + height, left : left + width] += np.float32(
            rng.choice((-1.0, 1.0)) * np.exp(rng.uniform(0.0, 3.0))
        )
    return out


def bent(case: StereoSet, seed: int) -> StereoSet:
    """The same with rows of the right picture off by what a calibration leaves."""
    height, width = case.truth.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    y += smooth_field(case.truth.shape, RESIDUAL_SHARE * width, [7, seed])
    right = cv2.remap(case.pair.right, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return replace(case, pair=replace(case.pair, right=right))


def fit(samples: Sequence[Sample]) -> ErrorTable:
    """A table of samples that count the same, whatever their number of pixels."""
    cues = np.concatenate([sample.cues for sample in samples], axis=1).astype(np.float64)
    errors = np.abs(np.concatenate([sample.errors for sample in samples]))
    weight = np.concatenate([np.full(len(s.errors), 1.0 / max(len(s.errors), 1)) for s in samples])
    weight /= weight.sum()
    centers, spreads = cues.mean(1), cues.std(1)
    normal = ErrorTable(centers.tolist(), spreads.tolist(), (), (), (), (), ()).normalised(cues).T.astype(np.float64)
    first, second = np.triu_indices(normal.shape[1])
    design = np.column_stack([np.ones(len(normal)), normal, normal[:, first] * normal[:, second]])
    wanted = np.log(np.hypot(np.minimum(errors, LARGEST_PX), FLOOR_PX))
    square = (design * weight[:, None]).T @ design + RIDGE * np.eye(design.shape[1])
    weights = np.linalg.solve(square, (design * weight[:, None]).T @ wanted)
    score = design @ weights
    order = np.argsort(score)
    score, errors, weight = score[order], errors[order], weight[order]
    unseen = float(np.mean([sample.unseen for sample in samples]))
    bins = np.searchsorted(EDGES, np.cumsum(weight), side="left").clip(1, len(EDGES) - 1)
    rows = []
    for n in range(1, len(EDGES)):
        e, w = errors[bins == n], weight[bins == n]
        near, far = (
            np.sqrt(max(_quantile(e, w, share) ** 2 - factor**2 * unseen, FLOOR_PX**2))
            for share, factor in ((0.68, 1.0), (0.95, 1.96))
        )
        rows.append([np.average(score[bins == n], weights=w), near, far, w[e < 1.0].sum() / w.sum()])
    scores, sigmas, wide, confidences = np.array(rows).T
    return ErrorTable(
        centers.tolist(), spreads.tolist(), weights.tolist(), scores.tolist(),
        np.maximum.accumulate(sigmas).tolist(), np.maximum.accumulate(wide).tolist(),
        np.minimum.accumulate(confidences).tolist(),
    )  # fmt: skip


def _quantile(values: Array, weight: Array, share: float) -> float:
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order][min(int(np.searchsorted(total, share * total[-1])), len(values) - 1)])


def judge(table: ErrorTable, sample: Sample) -> dict[str, Any]:
    """Shares of the errors that are inside."""
    sigma, wide, confidence = with_residual(table.read(sample.cues), sample.residual)
    errors, rounding = np.abs(sample.errors + sample.left), sample.step**2 / 12.0
    right = errors < 1.0
    return {
        "set": sample.set, "matcher": sample.matcher, "num_pixels": len(errors),
        "inside_68": 100.0 * float((errors <= np.sqrt(sigma**2 + rounding)).mean()),
        "inside_95": 100.0 * float((errors <= np.sqrt(wide**2 + 1.96**2 * rounding)).mean()),
        "plain_68": 100.0 * float((errors <= sigma).mean()), "plain_95": 100.0 * float((errors <= wide).mean()),
        "confidence": 100.0 * float(confidence.mean()), "below_1_px": 100.0 * float(right.mean()),
        "median_sigma_px": float(np.median(sigma)), "auc": _auc(confidence, right),
    }  # fmt: skip


def _auc(confidence: NDArray[np.float32], right: NDArray[np.bool_]) -> float:
    """Chance that a right pixel is given more confidence than a wrong one."""
    num_right, num_wrong = int(right.sum()), int((~right).sum())
    if not num_right or not num_wrong:
        return float("nan")
    values, place = np.unique(confidence, return_inverse=True)
    counts = np.bincount(place, minlength=len(values))
    rank = np.cumsum(counts) - 0.5 * (counts - 1)
    return float((rank[place][right].sum() - num_right * (num_right + 1) / 2) / (num_right * num_wrong))


def write_table(table: ErrorTable, path: Path) -> None:
    """Put the table into the source, in place of the one that is there."""
    text = path.read_text(encoding="utf-8")
    lines = ["ERROR_TABLE = ErrorTable("]
    for name, values in vars(table).items():
        numbers = [f"{value:.5g}" for value in values]
        lines += [
            f"    {name}=(",
            *(f"        {', '.join(numbers[k : k + 9])}," for k in range(0, len(numbers), 9)),
            "    ),",
        ]
    head = text[: text.index("ERROR_TABLE = ")]
    path.write_text(head + "\n".join([*lines, ")  # fmt: skip", ""]), encoding="utf-8")


def markdown(report: dict[str, Any]) -> str:
    """The tables."""
    lines = ["# Sigma and confidence of disparities", "", f"{report['date']}, {report['commit']}, {report['cpu']}", ""]
    lines += [
        "Shares of true errors inside the intervals that are told, %. Asked: 60 to 76 inside 68, 92 to 97 inside 95.",
        "Where the truth is rounded, its standard deviation is added to the intervals; in brackets without. AUC: the",
        "chance that a pixel below 1 px is given more confidence than one above.", "",
    ]  # fmt: skip
    head = ("set", "matcher", "inside 68 %", "inside 95 %", "confidence %", "below 1 px %", "median sigma px", "AUC")
    for title, runs in report["runs"].items():
        lines += [f"## {title}", "", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
        for run in runs:
            inside = [f"{run[f'inside_{k}']:.1f} ({run[f'plain_{k}']:.1f})" for k in (68, 95)]
            cells = [run["set"], run["matcher"], *inside, f"{run['confidence']:.1f}", f"{run['below_1_px']:.1f}"]
            lines.append("| " + " | ".join([*cells, f"{run['median_sigma_px']:.3f}", f"{run['auc']:.3f}"]) + " |")
        lines.append("")
    return "\n".join(lines)


def _photographs(cases: Iterable[StereoSet], matchers: Sequence[str]) -> list[Sample]:
    return [Sample(case, matcher, None) for case in cases for matcher in matchers]


def _rendered(matchers: Sequence[str]) -> tuple[list[Sample], list[Sample]]:
    """Of each world and matcher what it finds; and of each world some maps that are wrong in places, for the fit."""
    found, wrong = [], []
    for seed, case in enumerate(map(rendered_set, [*shots(), *more_shots()])):
        found += [Sample(case, matcher, seed) for matcher in matchers]
        wrong.append(Sample(case, matchers[seed % len(matchers)], seed, is_spoilt=True))
        print(f"{case.name}: {', '.join(matchers)}", flush=True)
    return found, wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fit", action="store_true", help="fit the table anew, and write it into the source")
    parser.add_argument("--matchers", nargs="+", default=list(MATCHERS), help="default: all")
    parser.add_argument("-o", "--out", type=Path, default=RESULTS / "stereo_sigma.json")
    args = parser.parse_args()
    cv2.setNumThreads(2)
    worlds, wrong = _rendered(args.matchers)
    root = Path(os.environ.get("SFMAPP_DATA", "../shared/data"))
    photographs = _photographs(shared_sets(root), args.matchers)
    table = error_table.ERROR_TABLE
    if args.fit:
        table = fit([*worlds, *wrong])
        write_table(table, Path(error_table.__file__))
    runs = {"Fitted on rendered pairs, judged on photographs": [judge(table, sample) for sample in photographs]}
    of_others = {
        name: fit([one for one in [*worlds, *wrong] if one.set != name])
        for name in dict.fromkeys(sample.set for sample in worlds)
    }
    runs["Fitted on rendered pairs, each judged by the table of the others"] = [
        judge(of_others[sample.set], sample) for sample in worlds
    ]
    exact = [one for one in photographs if one.step < 0.5]  # a truth in whole pixels tells no sigma of a fifth
    if exact:
        other = fit(exact)
        runs["Fitted on motorcycle and cones, judged on rendered pairs"] = [judge(other, sample) for sample in worlds]
    report = {**describe_machine(), "runs": runs}
    args.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    args.out.with_suffix(".md").write_text(markdown(report), encoding="utf-8")
    print(markdown(report))


if __name__ == "__main__":
    main()
