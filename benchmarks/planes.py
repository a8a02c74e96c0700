"""``sfmapp warp`` and ``sfmapp rectify`` beside OpenCV's warpPerspective: what sampling makes of a picture, and its CPU
time.

    python benchmarks/planes.py

The world is a plane of fine detail, eight times as fine as the picture of it. A picture is its mean over pixels; so is
what a perfect sampling would make of it, which is rendered from the fine plane, 16 x 16 samples a pixel. The error is
the rms difference from that, in grey levels, away from borders. OpenCV samples by lines, cubics and Lanczos's windows
of 8 x 8, none of which averages where a picture shrinks (INTER_AREA is INTER_LINEAR in warpPerspective); so it is also
given the picture shrunk by resize with INTER_AREA to the scale that it has in the middle, as one would do by hand.
CPU time is the median of seven, in turns, of the sampling alone, on one thread.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from machine import RESULTS, describe_machine
from sfmapp.planes.rectify import Area, take_plane
from sfmapp.planes.view import PlaneView, view_of_corners
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


def plane(size: tuple[int, int], seed: int) -> Pixels:
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


def measure() -> list[dict[str, Any]]:
    """Every case by every program."""
    cv2.setNumThreads(1)
    rows = []
    for seed, (name, size, corners) in enumerate(WARPS):
        view = view_of_corners(corners, size)
        fine = plane(size, seed)
        canvas = np.zeros(PHOTOGRAPH[::-1], np.uint8)
        rows += _case(f"warp, picture {name}", fine, view.homography, PHOTOGRAPH,
                      lambda picture, view=view, canvas=canvas: put_picture(picture, canvas, view)[0])  # fmt: skip
    for seed, (name, shown, corners) in enumerate(RECTIFIES, 10):
        # the photograph is the picture here, and the plane straight on the result
        inverse = PlaneView(np.linalg.inv(view_of_corners(corners, shown).homography))
        fine = plane(PHOTOGRAPH, seed)
        area = Area(0.0, 0.0, *map(float, shown), *shown)
        seen = PlaneView(np.linalg.inv(inverse.homography))
        rows += _case(f"rectify, photograph {name}", fine, inverse.homography, shown,
                      lambda picture, seen=seen, area=area: take_plane(picture, seen, area)[0])  # fmt: skip
    return rows


def _case(
    case: str, fine: Pixels, homography: Array, size: tuple[int, int], ours: Callable[[Pixels], Pixels]
) -> list[dict[str, Any]]:
    picture = mean_of(fine)
    exact = perfect(fine, homography, size)
    inside = cv2.warpPerspective(np.full(picture.shape, 255, np.uint8), shifted(homography), size) == 255
    inside = cv2.erode(inside.astype(np.uint8), np.ones((BORDER, BORDER), np.uint8), borderValue=0) > 0
    middle = homography @ [0.5 * picture.shape[1], 0.5 * picture.shape[0], 1.0]
    scale = float(np.sqrt(abs(np.linalg.det(homography) / middle[2] ** 3)))
    programs: dict[str, Callable[[], Pixels]] = {"sfmapp": lambda: ours(picture)}
    for flag in FLAGS:
        programs[f"OpenCV, {flag}"] = lambda flag=flag: by_opencv(picture, homography, size, FLAGS[flag], 1.0)
        if scale < 0.9:
            programs[f"OpenCV, area, {flag}"] = lambda flag=flag: by_opencv(
                picture, homography, size, FLAGS[flag], scale
            )
    found = {program: run() for program, run in programs.items()}
    took: dict[str, list[float]] = {program: [] for program in programs}
    for _ in range(RUNS):
        for program, run in programs.items():
            before = time.process_time()
            run()
            took[program].append(1000.0 * (time.process_time() - before))
    out = []
    for program, pixels in found.items():
        left = (pixels.astype(np.float64) - exact)[inside]
        out.append({
            "case": case, "program": program, "scale": scale, "rms": float(np.sqrt((left**2).mean())),
            "worst": float(np.percentile(np.abs(left), 99.9)), "cpu_ms": float(np.median(took[program])),
        })  # fmt: skip
        print(out[-1], file=sys.stderr)
    return out


def write(report: dict[str, Any]) -> None:
    """The table of the results."""
    machine = f"{report['date']}, commit {report['commit']}, {report['cpu']}, {report['cores']} cores."
    lines = [
        "# Planes: what sampling makes of a picture", "", machine, "",
        "| case | scale in the middle | program | rms, grey levels | 99.9 % | CPU ms |", "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in report["sampling"]:
        lines.append(
            f"| {row['case']} | {row['scale']:.2f} | {row['program']} | {row['rms']:.2f} | {row['worst']:.0f} | "
            f"{row['cpu_ms']:.1f} |"
        )
    (RESULTS / "planes.md").write_text("\n".join(lines) + "\n")
    (RESULTS / "planes.json").write_text(json.dumps(report, indent=1) + "\n")


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    write({**describe_machine(), "sampling": measure()})


if __name__ == "__main__":
    main()
