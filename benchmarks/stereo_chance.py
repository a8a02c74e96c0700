"""How often pairs that show the same are said not to, and pairs that do not are: the verdict of ``sfmapp stereo``.

    python benchmarks/stereo_chance.py

*True*: small photographs of the shared sets, with noise of their own in either picture, dark, and blurred; pictures
that are plain, repeat themselves, hold upright edges alone, or are noise but for a patch. *Unrelated*: the left
picture of one set and the right one of another, noise, and noise beside a photograph. All are matched as
``sfmapp stereo`` matches them, the range of disparities found by itself; the figures of every pair are in the
``.json``. The nine pairs of ``stereo.py`` are matched to 85 % and more, and of pairs beyond 30 nothing is asked.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from machine import RESULTS, describe_machine
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3
from sfmapp.scene.rig import Rig
from sfmapp.stereo.chance import LEAST_DENSITY, against_chance
from sfmapp.stereo.match import MATCHERS, match_pair
from sfmapp.stereo.options import MatcherName, StereoOptions
from sfmapp.stereo.prepare import PairCameras, prepare_pair
from sfmapp.stereo.result import RectifiedPair
from sfmapp.stereo.search_range import search_range

Grey = NDArray[np.uint8]
Floats = NDArray[np.float64]

# the longer side of photographs, pixels, and of pictures that are drawn
SMALL_PX, HEIGHT, WIDTH, SHIFT = 480, 240, 320, 14
BLURS = (0.0, 1.5, 4.0)


@dataclass(frozen=True)
class Case:
    """Two pictures of one size whose rows belong together, if anything does."""

    kind: str
    name: str
    left: Grey
    right: Grey


# -------------------------------------------------------------------------------------------------------------- pairs


def photographs(root: Path) -> Iterator[Case]:
    """Small rectified pairs: neighbours of registered photographs, a car's, boards, and of unknown cameras."""
    for name in ("fountain-P11", "herz-jesus-P8"):
        told = json.loads((root / name / "cameras.json").read_text())["cameras"]
        for one, other in itertools.pairwise(told):
            files = [root / name / each["file"] for each in (one, other)]
            yield from _rectified(name, files, _rig(one, other))
    car = root / "kitti01-stereo51"
    for left in sorted((car / "image_0").iterdir())[::10]:
        pictures = [_read(path) for path in (left, car / "image_1" / left.name)]
        yield Case("kitti01-stereo51", left.stem, pictures[0], pictures[1])
    boards = root / "opencv-doc-samples" / "calib"
    for left in sorted(boards.glob("left*.jpg"))[::2]:
        yield from _rectified("boards", [left, boards / left.name.replace("left", "right")], None)
    doors = sorted((root / "lund-door").rglob("*.[jJ][pP]*[gG]"))
    for one, other in itertools.pairwise(doors):
        yield from _rectified("lund-door", [one, other], None)


def _read(path: Path) -> Grey:
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    scale = min(1.0, SMALL_PX / max(picture.shape))
    return np.asarray(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)


def _rectified(kind: str, files: list[Path], rig: Rig | None) -> Iterator[Case]:
    left, right = (_read(path) for path in files)
    try:
        pair = prepare_pair(left, right, PairCameras(rig), ("left", "right")).pair
    except InputError:  # it was named before anything was matched
        return
    yield Case(kind, f"{files[0].stem}, {files[1].stem}", pair.left, pair.right)


def _rig(one: dict[str, Any], other: dict[str, Any]) -> Rig:
    cameras = []
    for told in (one, other):
        scale = SMALL_PX / max(told["width"], told["height"])
        k = scale * np.add(told["K"], [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        size = round(scale * told["width"]), round(scale * told["height"])
        cameras.append(Camera(CameraModel.PINHOLE, *size, np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2]])))
    poses = [rigid3.from_matrix(np.array(each["R_w2c"]), np.array(each["t_w2c"]).ravel()) for each in (one, other)]
    second = rigid3.compose(poses[1], rigid3.inverse(poses[0]))
    return Rig((cameras[0], cameras[1]), np.array([rigid3.IDENTITY, second]))


def spoilt(case: Case) -> Iterator[Case]:
    """The same with noise, dark, with a tenth of its contrast, blurred: what makes a matcher find less."""
    rng = np.random.default_rng(len(case.name))
    pictures = case.left.astype(np.float64), case.right.astype(np.float64)
    for sigma in (20.0, 40.0):
        yield _drawn(f"{case.kind}, noise {sigma:.0f}", case.name, *pictures, noise=sigma, rng=rng)
    yield _drawn(f"{case.kind}, dark", case.name, *(0.06 * one for one in pictures), noise=1.0, rng=rng)
    plain = (cv2.GaussianBlur(0.1 * one + 100.0, (0, 0), 3.0) for one in pictures)
    yield _drawn(f"{case.kind}, blurred", case.name, *plain, noise=1.0, rng=rng)


def _drawn(
    kind: str, name: str, left: Floats, right: Floats, *, noise: float, rng: np.random.Generator
) -> Case:  # fmt: skip
    pictures = [np.rint(one + noise * rng.standard_normal(one.shape)) for one in (left, right)]
    return Case(kind, name, *(np.clip(one, 0, 255).astype(np.uint8) for one in pictures))


def texture(rng: np.random.Generator, blur: float) -> Floats:
    """(HEIGHT, WIDTH + SHIFT) of deviation one."""
    drawn = rng.standard_normal((HEIGHT, WIDTH + SHIFT))
    drawn = cv2.GaussianBlur(drawn, (0, 0), blur) if blur else drawn
    return np.asarray(drawn / drawn.std(), np.float64)


def drawn_pairs(seed: int) -> Iterator[Case]:
    """Pairs that show the same, and little of it."""
    rng = np.random.default_rng(seed)

    def shifted(kind: str, picture: Floats, noise: float) -> Case:
        shown = 120.0 + picture
        return _drawn(kind, f"seed {seed}", shown[:, :WIDTH], shown[:, SHIFT:], noise=noise, rng=rng)

    for blur in BLURS:
        for share in (0.01, 0.02, 0.03):
            own, other, both = (40.0 * texture(rng, blur) for _ in range(3))
            side = round((share * HEIGHT * WIDTH) ** 0.5)
            y, x = rng.integers(0, HEIGHT - side), rng.integers(SHIFT, WIDTH - side)
            own[y : y + side, x : x + side] = other[y : y + side, x : x + side] = both[y : y + side, x : x + side]
            pair = 120.0 + own[:, :WIDTH], 120.0 + other[:, SHIFT:]
            yield _drawn(f"noise of blur {blur} but for {share:.0%}", f"seed {seed}", *pair, noise=1.0, rng=rng)
    for noise in (1.0, 5.0, 10.0):
        row = np.cumsum(np.where(rng.random(WIDTH + SHIFT) < 0.03, rng.normal(0.0, 40.0, WIDTH + SHIFT), 0.0))
        edges = np.tile(np.clip(row - row.mean(), -100.0, 100.0), (HEIGHT, 1))
        yield shifted(f"upright edges, noise {noise:.0f}", edges, noise)
        tile = 40.0 * texture(rng, 2.0)[:24, :24]
        repeated = np.tile(tile, (HEIGHT // 24, WIDTH // 24 + 2))[:, : WIDTH + SHIFT]
        yield shifted(f"repeated, noise {noise:.0f}", repeated, noise)
        bars = 40.0 * np.sign(np.sin(np.arange(WIDTH + SHIFT) * (2.0 * np.pi / 20.0)))
        yield shifted(f"bars, noise {noise:.0f}", np.tile(bars, (HEIGHT, 1)), noise)
        wall = 40.0 * texture(rng, 1.5)
        wall[:80], wall[130:], wall[:, :100], wall[:, 150:] = 0.0, 0.0, 0.0, 0.0
        yield shifted(f"poster on a plain wall, noise {noise:.0f}", wall, noise)


def unrelated(photographs: list[Case]) -> Iterator[Case]:
    """The left picture of one set and the right one of another; noise; noise and a photograph."""
    sets: dict[str, list[Case]] = {}
    for case in photographs:
        sets.setdefault(case.kind, []).append(case)
    middles = [mine[len(mine) // 2] for mine in sets.values()]
    for one, other in itertools.permutations(middles, 2):
        yield _joined("two sets", one, other)
    for seed in range(6):
        rng = np.random.default_rng(100 + seed)
        for blur in BLURS:
            pair = [120.0 + 40.0 * texture(rng, blur)[:, SHIFT:] for _ in range(2)]
            yield _drawn(f"noise of blur {blur}", f"seed {seed}", pair[0], pair[1], noise=1.0, rng=rng)
        picture = cv2.resize(photographs[seed].left, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
        yield _drawn("noise and a photograph", photographs[seed].name, pair[0], picture.astype(np.float64), noise=1.0,
                     rng=rng)  # fmt: skip


def _joined(kind: str, one: Case, other: Case) -> Case:
    size = one.left.shape[1], one.left.shape[0]
    right = np.asarray(cv2.resize(other.right, size, interpolation=cv2.INTER_AREA), np.uint8)
    return Case(kind, f"{one.name} / {other.name}", one.left, right)


# ------------------------------------------------------------------------------------------------------------ verdict


def judged(case: Case, matcher: MatcherName) -> dict[str, Any]:
    """What is said of a pair, and what it is said by."""
    everywhere = np.ones(case.left.shape, np.bool_)
    pair = RectifiedPair(case.left, case.right, everywhere, everywhere)
    search, _ = search_range(pair, StereoOptions())
    options = StereoOptions(matcher=matcher, min_disparity=search[0], num_disparities=search[1])
    found = match_pair(pair, options)
    row = {"kind": case.kind, "pair": case.name, "is_named": "chance" in found.info, "density": found.density}
    if found.density < LEAST_DENSITY:
        told = against_chance(pair, found, lambda turned: MATCHERS[matcher](turned, options, search))
        row |= {"by_chance": told.by_chance, "patch": told.patch, "patch_by_chance": told.patch_by_chance}
    print(row, flush=True)
    return row


def markdown(report: dict[str, Any]) -> str:
    """The shares, and by kind the least of what tells true pairs and the most of what others have."""
    lines = ["# Pairs that do not show the same", "", f"{report['date']}, {report['commit']}, {report['cpu']}", ""]
    for group in ("true", "unrelated"):
        runs = report[group]
        named = sum(run["is_named"] for run in runs)
        lines += [f"{group.capitalize()}: {named} of {len(runs)} are said not to show the same.", ""]
    lines += ["Times chance: matched pixels, and those of the largest patch, of pairs that are asked: less than 30 %",
              "is matched; of true pairs the least of each kind, of unrelated ones the greatest.", ""]  # fmt: skip
    lines += ["| pairs | number | matched, % | asked | times chance | largest patch | said not to show the same |",
              "|---|---|---|---|---|---|---|"]  # fmt: skip
    for group, end in (("true", min), ("unrelated", max)):
        for kind in dict.fromkeys(run["kind"] for run in report[group]):
            runs = [run for run in report[group] if run["kind"] == kind]
            asked = [run for run in runs if "by_chance" in run]
            cells = [_times(asked, *keys, end) for keys in (("density", "by_chance"), ("patch", "patch_by_chance"))]
            density = f"{100 * min(run['density'] for run in runs):.0f} to {100 * max(r['density'] for r in runs):.0f}"
            named = sum(run["is_named"] for run in runs)
            counts = f"{len(runs)} | {density} | {len(asked)}"
            lines.append(f"| {group}: {kind} | {counts} | {cells[0]} | {cells[1]} | {named} |")
    return "\n".join([*lines, ""])


def _times(asked: list[dict[str, Any]], own: str, chance: str, end: Callable[[Iterable[float]], float]) -> str:
    if not asked:
        return "-"
    ratio = end(run[own] / max(run[chance], 1e-9) for run in asked)
    return "beyond 100" if ratio > 100.0 else f"{ratio:.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--matcher", default="sgm", choices=tuple(MATCHERS))
    parser.add_argument("-o", "--out", type=Path, default=RESULTS / "stereo_chance.json")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    root = Path(os.environ.get("SFMAPP_DATA", "../shared/data"))
    plain = list(photographs(root))
    cases = [case for seed in range(3) for case in drawn_pairs(seed)]
    cases += [case for one in plain[::2] for case in (one, *spoilt(one))]
    report = {**describe_machine(), "matcher": args.matcher}
    report["true"] = [judged(case, args.matcher) for case in cases]
    report["unrelated"] = [judged(case, args.matcher) for case in unrelated(plain)]
    args.out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    args.out.with_suffix(".md").write_text(markdown(report), encoding="utf-8")
    print(markdown(report))


if __name__ == "__main__":
    main()
