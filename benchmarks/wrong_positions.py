"""Grossly wrong positions of photographs: are they named, or is the contradiction red, from four positions on?

    python benchmarks/wrong_positions.py        writes results/wrong_positions.json and results/wrong_positions.md

First the fit alone, of cameras known to a centimetre, by many draws; then the whole stage on the surveys of
``surveys.py``, of which only some photographs carry a position, with the shape that photographs give the model.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import surveys
from machine import RESULTS, describe_machine
from sfmapp.events import Events
from sfmapp.geometry import rigid3
from sfmapp.georeference.disagreement import find_disagreement
from sfmapp.georeference.options import GpsOptions
from sfmapp.georeference.robust_fit import robust_fit
from sfmapp.georeference.stage import georeference_models

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Receiver:
    """Standard deviations (metres) horizontally and of heights, whether positions say so, and how far off a wrong one
    lies: from once to twice ``wrong_m``, in any direction."""

    flat: float
    up: float
    is_stated: bool
    wrong_m: float


# wrong ones lie twenty sigmas off and more
RECEIVERS = {
    "phone": Receiver(3.0, 6.0, False, 300.0),
    "phone, 60 m": Receiver(3.0, 6.0, False, 60.0),
    "phone, stated": Receiver(3.0, 6.0, True, 300.0),
    "RTK": Receiver(0.02, 0.03, True, 2.0),
    "RTK, 300 m": Receiver(0.02, 0.03, True, 300.0),
}
LAYOUTS = ("line", "grid", "orbit", "street")
NUMBERS = (4, 5, 6, 8, 12, 30)
# what a guess is, metres
_GUESS = (5.0, 10.0)
OUTCOMES = ("named", "red", "missed", "lost")


def cameras(layout: str, num: int, rng: np.random.Generator) -> Array:
    """Places (n, 3) of cameras, metres."""
    along = np.arange(num)
    if layout == "line":
        return np.column_stack([100.0 * along / (num - 1), np.zeros((num, 2))]) + rng.normal(0.0, 0.5, (num, 3))
    if layout == "grid":
        side = int(np.ceil(np.sqrt(num)))
        flat = np.column_stack([along % side, along // side]) * 20.0
        return np.column_stack([flat, np.full(num, 60.0)]) + rng.normal(0.0, 1.0, (num, 3))
    if layout == "orbit":
        angle = 2 * np.pi * along / num
        around = [30 * np.cos(angle), 30 * np.sin(angle), np.where(along % 2, 12.0, 22.0)]
        return np.column_stack(around) + rng.normal(0.0, 0.5, (num, 3))
    x = 150.0 * along / (num - 1)
    return np.column_stack([x, 30.0 * np.sin(x / 45.0), 1.6 + 0.02 * x]) + rng.normal(0.0, 0.3, (num, 3))


def spoiled(places: Array, receiver: Receiver, num_wrong: int, rng: np.random.Generator) -> tuple[Array, Mask]:
    """Places as measured (n, 3), and which are wrong (n,)."""
    num = len(places)
    measured = places + rng.normal(size=(num, 3)) * [receiver.flat, receiver.flat, receiver.up]
    is_wrong = np.zeros(num, bool)
    is_wrong[rng.permutation(num)[:num_wrong]] = True
    way = rng.normal(size=(num, 3))
    way *= receiver.wrong_m * (1.0 + rng.random((num, 1))) / np.linalg.norm(way, axis=1, keepdims=True)
    measured[is_wrong] += way[is_wrong]
    return measured, is_wrong


def of_fit(layout: str, receiver: Receiver, num: int, num_wrong: int, seed: list[int]) -> str:
    """What the fit says of one draw."""
    rng = np.random.default_rng(seed)
    places = cameras(layout, num, rng)
    model = (places + rng.normal(0.0, 0.01, places.shape)) @ rigid3.exp_so3(rng.normal(size=3)).T * 0.1
    measured, is_wrong = spoiled(places, receiver, num_wrong, rng)
    flat, up = (receiver.flat, receiver.up) if receiver.is_stated else _GUESS
    is_stated = np.full(2, receiver.is_stated)
    fit = robust_fit(model, measured, np.tile([flat, flat, up], (num, 1)), is_stated)
    if fit is None:
        return "red"
    found = find_disagreement(fit, is_stated, [str(k) for k in range(num)], "the model")
    return _outcome(~fit.is_inlier, is_wrong, is_red=found is not None)


def _outcome(is_left_out: Mask, is_wrong: Mask, *, is_red: bool) -> str:
    if is_red:
        return "red"
    if (is_wrong & ~is_left_out).any():
        return "missed"
    return "lost" if (is_left_out & ~is_wrong).any() else "named"


def of_stage(kind: str, receiver: Receiver, num: int, num_wrong: int, seed: int) -> str:
    """What the stage says of a survey of which so many photographs, spread over it, carry a position."""
    survey = surveys.make_survey(kind, seed)
    image_set, _, _ = surveys.positions(survey, "rtk" if receiver.is_stated else "phone", seed)
    chosen = np.linspace(0, len(image_set.images) - 1, num).round().astype(int)
    rng = np.random.default_rng([seed, num, num_wrong])
    measured, is_wrong = spoiled(survey.truth.centers[chosen], receiver, num_wrong, rng)
    images = [replace(record, position=None) for record in image_set.images]
    for i, place in zip(chosen.tolist(), surveys.FRAME.geodetic_from_enu(measured).tolist(), strict=True):
        before = image_set.images[i].position
        assert before is not None
        stated = (receiver.flat, receiver.up) if receiver.is_stated else (None, None)
        position = replace(
            before, latitude_deg=place[0], longitude_deg=place[1], height_m=place[2], sigma_m=stated[0],
            sigma_up_m=stated[1],
        )  # fmt: skip
        images[i] = replace(images[i], position=position)
    with ThreadPoolExecutor(1) as pool:
        mapper = surveys.mapper_of(survey, pool)
        mapper.polish()
        placed = georeference_models([mapper], replace(image_set, images=tuple(images)), GpsOptions(), Events())
    rows = {row.name: row for row in placed.report.images}
    is_left_out = np.array([not rows[image_set.images[i].name].is_used for i in chosen])
    if placed.georeference is None and not placed.report.contradictions:
        return "missed" if num_wrong else "red"  # left in arbitrary units without a word against positions
    return _outcome(is_left_out, is_wrong, is_red=bool(placed.report.contradictions))


def shares(num: int) -> list[int]:
    """Numbers of wrong positions: none, one, a quarter, and the most that leave six in ten right."""
    return sorted({0, 1, round(num / 4), int(0.4 * num + 1e-9)})


def draw_fits(num_draws: int) -> list[dict[str, Any]]:
    """Outcomes of the fit alone."""
    rows = []
    for name, receiver in RECEIVERS.items():
        for num in NUMBERS:
            for num_wrong in shares(num):
                start, counts = time.process_time(), Counter[str]()
                for n, layout in enumerate(LAYOUTS):
                    own = [num, num_wrong, n, list(RECEIVERS).index(name)]
                    counts.update(of_fit(layout, receiver, num, num_wrong, [seed, *own]) for seed in range(num_draws))
                row = {"receiver": name, "positions": num, "wrong": num_wrong, **{k: counts[k] for k in OUTCOMES}}
                rows.append(row | {"cpu_s": round(time.process_time() - start, 1)})
                print(rows[-1], flush=True)
    return rows


def run_stages(num_seeds: int) -> list[dict[str, Any]]:
    """Outcomes of the whole stage."""
    rows = []
    for name in ("phone", "RTK", "RTK, 300 m"):
        for num, num_wrong in ((5, 0), (5, 1), (8, 0), (8, 1), (8, 3), (28, 0), (28, 7)):
            start = time.process_time()
            counts = Counter(
                of_stage(kind, RECEIVERS[name], num, num_wrong, seed)
                for kind in surveys.KINDS for seed in range(num_seeds)
            )  # fmt: skip
            row = {"receiver": name, "positions": num, "wrong": num_wrong, **{k: counts[k] for k in OUTCOMES}}
            rows.append(row | {"cpu_s": round(time.process_time() - start, 1)})
            print(rows[-1], flush=True)
    return rows


def write_results(fits: list[dict[str, Any]], stages: list[dict[str, Any]]) -> None:
    """The tables as JSON and as Markdown."""
    document = describe_machine() | {"fits": fits, "stages": stages}
    (RESULTS / "wrong_positions.json").write_text(json.dumps(document, indent=1) + "\n")
    lines = [
        "# Grossly wrong positions", "",
        "`benchmarks/wrong_positions.py`. Named: all wrong positions are left aside by name, and no right one. Red:",
        "the report has a contradiction. Missed: a wrong one is believed, in silence. Lost: all wrong ones are named,",
        "and a right one with them. Where none is wrong, red and lost are false alarms. Phone: sigmas of 3 and 6 m,",
        "not stated unless said; wrong ones 300 to 600 m off, or 60 to 120 m. RTK: 2 and 3 cm, stated; wrong ones 2",
        "to 4 m off, or 300 to 600 m.", "",
        "## The fit alone, lines, grids, orbits and streets of cameras known to a centimetre", "",
    ]  # fmt: skip
    for rows, title in ((fits, ""), (stages, "## The stage, on surveys of which so many photographs carry a position")):
        lines += [title, ""] if title else []
        lines += ["| receiver | positions | wrong | named | red | missed | lost |", "|---|---|---|---|---|---|---|"]
        keys = ("receiver", "positions", "wrong", *OUTCOMES)
        lines += [f"| {' | '.join(str(row[key]) for key in keys)} |" for row in rows]
        lines.append("")
    (RESULTS / "wrong_positions.md").write_text("\n".join(lines))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--draws", type=int, default=50, help="of each layout")
    parser.add_argument("--surveys", type=int, default=4, help="of each kind")
    arguments = parser.parse_args()
    write_results(draw_fits(arguments.draws), run_stages(arguments.surveys))


if __name__ == "__main__":
    main()
