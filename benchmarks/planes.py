"""``sfmapp warp`` and ``sfmapp rectify`` beside OpenCV's warpPerspective: what sampling makes of a picture, and its CPU
time.

    SFMAPP_DATA=... python benchmarks/planes.py

The world is a plane of fine detail, eight times as fine as the picture of it: blobs of every size with words on them,
flat shapes with sharp edges, and a photograph (of strecha-courtyard, repeated as in mirrors where it ends). A picture
is its mean over pixels; so is what a perfect sampling would make of it, which is rendered from the fine plane, 16 x 16
samples a pixel. The error is the rms difference from that, in grey levels, away from borders. OpenCV samples by lines,
cubics and Lanczos's windows of 8 x 8, none of which averages where a picture shrinks (INTER_AREA is INTER_LINEAR in
warpPerspective); so it is also given the picture shrunk by resize with INTER_AREA to the scale that it has in the
middle, as one would do by hand.
CPU time is the median of seven, in turns, of the sampling of words alone, on one thread.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from machine import RESULTS, describe_machine
from sfmapp.planes.rectify import Area, take_plane
from sfmapp.planes.view import view_of_corners
from sfmapp.planes.warp import put_picture

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]

FINE, SAMPLES, RUNS, BORDER = 8, 16, 7, 8
FLAGS = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "lanczos": cv2.INTER_LANCZOS4}
# name, size of the picture, corners in a photograph of 960 x 720
WARPS = (
    ("grows to 2.5", (320, 240), ((90, 80), (850, 60), (880, 660), (70, 620))),
    ("keeps its size", (720, 540), ((110, 90), (800, 70), (830, 640), (100, 600))),
    ("shrinks to 1 / 4", (2400, 1800), ((180, 120), (780, 100), (800, 600), (150, 560))),
    ("lies flat, 1 / 2 to 1 / 12", (2400, 1800), ((390, 300), (570, 300), (900, 640), (60, 640))),
)
PHOTOGRAPH = (960, 720)
# name, size of what is taken out of it, its corners
RECTIFIES = (
    ("keeps its size", (720, 540), ((110, 90), (800, 70), (830, 640), (100, 600))),
    ("shrinks to 1 / 4", (180, 135), ((110, 90), (800, 70), (830, 640), (100, 600))),
    ("of a plane that lies flat", (600, 450), ((390, 300), (570, 300), (900, 640), (60, 640))),
)


@dataclass(frozen=True)
class Case:
    """A picture of so many pixels, seen by a homography in a result of so many, both (width, height)."""

    name: str
    picture: tuple[int, int]
    seed: int
    homography: Array
    result: tuple[int, int]

    @property
    def scale(self) -> float:
        """Pixels of the result to one of the picture, in its middle."""
        weight = self.homography[2] @ [0.5 * self.picture[0], 0.5 * self.picture[1], 1.0]
        return float(np.sqrt(abs(np.linalg.det(self.homography) / weight**3)))


def words(size: tuple[int, int], seed: int) -> Pixels:
    """(8 h, 8 w) of a plane: blobs of every size, and words, whose edges are sharp."""
    rng = np.random.default_rng(seed)
    width, height = size[0] * FINE, size[1] * FINE
    total = np.full((height, width), 128.0, np.float32)
    for part in (4, 16, 64, 256, min(size)):
        noise = rng.normal(size=(max(2, part * height // width), part)).astype(np.float32)
        total += 22.0 * cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    out = np.clip(total, 0, 255).astype(np.uint8)
    for _ in range(60):
        place = int(rng.integers(0, width)), int(rng.integers(0, height))
        tall = float(rng.uniform(0.1, 0.8)) * FINE
        cv2.putText(out, "sampling", place, cv2.FONT_HERSHEY_SIMPLEX, tall, int(rng.integers(0, 256)), int(tall) + 1)
    return out


def shapes(size: tuple[int, int], seed: int) -> Pixels:
    """(8 h, 8 w) of a plane: triangles of one colour each, from two pixels of the picture to half of it."""
    rng = np.random.default_rng(seed)
    width, height = size[0] * FINE, size[1] * FINE
    out = np.full((height, width), 128, np.uint8)
    for n in range(1500):
        reach = 0.25 * height * (8.0 * FINE / height) ** (n / 1500.0)
        corners = rng.uniform(0.0, (width, height)) + rng.normal(size=(3, 2)) * reach
        cv2.fillConvexPoly(out, np.rint(corners).astype(np.int32), int(rng.integers(0, 256)))
    return out


def photograph(data: Path, size: tuple[int, int]) -> Pixels:
    """(8 h, 8 w) of a plane: a photograph, mirrored at its borders."""
    name = sorted((data / "strecha-courtyard-21" / "images").iterdir())[0]
    gray = np.asarray(cv2.imread(str(name), cv2.IMREAD_GRAYSCALE))
    wanted = size[1] * FINE, size[0] * FINE
    more = [(0, max(0, there - here)) for there, here in zip(wanted, gray.shape, strict=True)]
    return np.ascontiguousarray(np.pad(gray, more, mode="symmetric")[: wanted[0], : wanted[1]])


def mean_of(fine: Pixels) -> Pixels:
    """The picture: means over squares of the fine plane."""
    return np.asarray(cv2.resize(fine, None, fx=1.0 / FINE, fy=1.0 / FINE, interpolation=cv2.INTER_AREA))


def shifted(homography: Array) -> Array:
    """Of pixels whose first has its centre at (0, 0), as OpenCV counts them."""
    there = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    return np.asarray(np.linalg.inv(there) @ homography @ there)


def perfect(fine: Pixels, homography: Array, size: tuple[int, int]) -> Array:
    """(h, w) mean of the fine plane over each pixel. homography: from the picture's pixels to those of the result."""
    width, height = size
    out = np.empty((height, width))
    enlarge = np.diag([SAMPLES, SAMPLES, 1.0]) @ homography @ np.diag([1.0 / FINE, 1.0 / FINE, 1.0])
    for top in range(0, height, 60):  # in strips, which fit into memory
        tall = min(60, height - top)
        up = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, -SAMPLES * top], [0.0, 0.0, 1.0]])
        samples = cv2.warpPerspective(fine, shifted(up @ enlarge), (SAMPLES * width, SAMPLES * tall))
        out[top : top + tall] = samples.reshape(tall, SAMPLES, width, SAMPLES).mean((1, 3))
    return out


def by_opencv(picture: Pixels, homography: Array, size: tuple[int, int], flag: int, shrink: float) -> Pixels:
    if shrink < 1.0:
        small = tuple(max(1, round(side * shrink)) for side in picture.shape[1::-1])
        homography = homography @ np.diag([picture.shape[1] / small[0], picture.shape[0] / small[1], 1.0])
        picture = np.asarray(cv2.resize(picture, small, interpolation=cv2.INTER_AREA))
    return np.asarray(cv2.warpPerspective(picture, shifted(homography), size, flags=flag))


def measure(data: Path) -> list[dict[str, Any]]:
    """Every case by every program."""
    cv2.setNumThreads(1)
    rows = []
    for seed, (name, size, corners) in enumerate(WARPS):
        view = view_of_corners(corners, size)
        canvas = np.zeros(PHOTOGRAPH[::-1], np.uint8)
        case = Case(f"warp, picture {name}", size, seed, view.homography, PHOTOGRAPH)
        rows += compare(case, data, lambda picture, view=view, canvas=canvas: put_picture(picture, canvas, view)[0])
    for seed, (name, shown, corners) in enumerate(RECTIFIES, 10):
        # the photograph is the picture here, and the plane straight on the result
        seen = view_of_corners(corners, shown)
        area = Area(0.0, 0.0, *map(float, shown), *shown)
        case = Case(f"rectify, photograph {name}", PHOTOGRAPH, seed, np.linalg.inv(seen.homography), shown)
        rows += compare(case, data, lambda picture, seen=seen, area=area: take_plane(picture, seen, area)[0])
    return rows


def compare(case: Case, data: Path, ours: Callable[[Pixels], Pixels]) -> list[dict[str, Any]]:
    """Errors on each plane, and CPU times on the first, of every program."""
    planes = {
        "words": lambda: words(case.picture, case.seed), "shapes": lambda: shapes(case.picture, case.seed),
        "photograph": lambda: photograph(data, case.picture),
    }  # fmt: skip
    rows: dict[str, dict[str, Any]] = {}
    for name, make in planes.items():
        fine = make()
        picture = mean_of(fine)
        exact = perfect(fine, case.homography, case.result)
        inside = (
            cv2.warpPerspective(np.full(picture.shape, 255, np.uint8), shifted(case.homography), case.result) == 255
        )
        inside = cv2.erode(inside.astype(np.uint8), np.ones((BORDER, BORDER), np.uint8), borderValue=0) > 0
        programs = programs_for(case, picture, ours)
        for program, run in programs.items():
            left = (run().astype(np.float64) - exact)[inside]
            row = rows.setdefault(
                program, {"case": case.name, "program": program, "scale": case.scale, "rms": {}, "worst": {}}
            )
            row["rms"][name] = float(np.sqrt((left**2).mean()))
            row["worst"][name] = float(np.percentile(np.abs(left), 99.9))
        if name == "words":
            for program, spent in cpu_times(programs).items():
                rows[program]["cpu_ms"] = spent
    for row in rows.values():
        print(row, file=sys.stderr)
    return list(rows.values())


def programs_for(case: Case, picture: Pixels, ours: Callable[[Pixels], Pixels]) -> dict[str, Callable[[], Pixels]]:
    programs: dict[str, Callable[[], Pixels]] = {"sfmapp": lambda: ours(picture)}
    for name, flag in FLAGS.items():
        shrinks = {f"OpenCV, {name}": 1.0} | ({f"OpenCV, area, {name}": case.scale} if case.scale < 0.9 else {})
        for program, shrink in shrinks.items():
            programs[program] = lambda flag=flag, shrink=shrink: by_opencv(
                picture, case.homography, case.result, flag, shrink
            )
    return programs


def cpu_times(programs: dict[str, Callable[[], Pixels]]) -> dict[str, float]:
    """Milliseconds."""
    took: dict[str, list[float]] = {program: [] for program in programs}
    for _ in range(RUNS):
        for program, run in programs.items():
            before = time.process_time()
            run()
            took[program].append(1000.0 * (time.process_time() - before))
    return {program: float(np.median(each)) for program, each in took.items()}


def write(report: dict[str, Any]) -> None:
    """The table of the results."""
    machine = f"{report['date']}, commit {report['commit']}, {report['cpu']}, {report['cores']} cores."
    lines = [
        "# Planes: what sampling makes of a picture", "", machine, "",
        "rms (and 99.9 %) in grey levels.", "",
        "| case | scale in the middle | program | words | shapes | photograph | CPU ms |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in report["sampling"]:
        errors = " | ".join(f"{rms:.2f} ({row['worst'][name]:.0f})" for name, rms in row["rms"].items())
        lines.append(f"| {row['case']} | {row['scale']:.2f} | {row['program']} | {errors} | {row['cpu_ms']:.1f} |")
    (RESULTS / "planes.md").write_text("\n".join(lines) + "\n")
    (RESULTS / "planes.json").write_text(json.dumps(report, indent=1) + "\n")


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    write({**describe_machine(), "sampling": measure(Path(os.environ["SFMAPP_DATA"]))})


if __name__ == "__main__":
    main()
