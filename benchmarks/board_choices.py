"""What ``sfmapp calibrate board`` chooses by itself, the views to take next and the lens model: parts of
benchmarks/calibration.py."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from machine import ROOT

sys.path.insert(0, str(ROOT / "tests"))

from board_views import board_poses, board_views
from sfmapp.calibration.adjustment import TargetView, observations_of, refine
from sfmapp.calibration.boards import Board, parse_board
from sfmapp.calibration.comparison import projection_difference
from sfmapp.calibration.planning import mean_sigma, next_views
from sfmapp.calibration.solve import Solution, solve_views
from sfmapp.calibration.uncertainty import projection_sigma
from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.errors import InputError
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Row = dict[str, Any]

SIZE = (1280, 960)
NOISE_PX = 0.2
CHESS = parse_board("chessboard:9x6:0.025")
CHARUCO = parse_board("charuco:9x7:0.025:0.018")
# a camera of each kind whose users calibrate by boards
CAMERAS = {
    "OPENCV": [1000.0, 1010.0, 630.0, 490.0, -0.2, 0.05, 1e-3, -5e-4],
    "FULL_OPENCV": [610.0, 612.0, 636.0, 486.0, 0.45, -2.4, 6e-4, -3e-4, 1.4, 0.33, -2.2, 1.3],
    "OPENCV_FISHEYE": [420.0, 425.0, 630.0, 490.0, -0.02, 0.004, -1e-3, 2e-4],
    "SIMPLE_RADIAL": [1100.0, 640.0, 480.0, -0.1],
}
# how the first photographs were taken: tilt of the board in degrees, how many, and where its middle is in the picture
STARTS = {
    "8, tilted up to 45": (45.0, 8, (0.2, 0.8)),
    "8, tilted up to 15": (15.0, 8, (0.2, 0.8)),
    "5, tilted up to 45": (45.0, 5, (0.2, 0.8)),
    "8 in the middle": (45.0, 8, (0.4, 0.6)),
    "15, tilted up to 45": (45.0, 15, (0.2, 0.8)),
}
SETS, DRAWS = 3, 3
DRAWN = (3, 6, 9, 12, 18, 24)


def suggested_points() -> list[Row]:
    """Three suggested views against three drawn as the first were, points with noise, each set solved anew.

    How fast sigma falls is its logarithm; beside it, how many drawn views come to the sigma of three suggested ones.
    """
    rows = []
    for name, params in CAMERAS.items():
        camera = Camera(CameraModel[name], *SIZE, np.array(params))
        for start, how in STARTS.items():
            sigmas = np.array([of_set(camera, how, 100 + seed) for seed in range(SETS)])
            before, after, *curve = np.exp(np.mean(np.log(sigmas), 0)).tolist()
            falling = np.minimum.accumulate([before, *curve])
            rows.append({
                "lens": name, "start": start, "sets": SETS, "before_px": before, "suggested_px": after,
                "drawn_px": curve[0],
                "times_as_fast": float(np.log(before / after) / max(np.log(before / curve[0]), 1e-3)),
                "least_times_as_fast": float(min(
                    np.log(one[0] / one[1]) / max(np.log(one[0] / one[2]), 1e-3) for one in sigmas
                )),
                "drawn_views_for_the_same": float(np.interp(-after, -falling, [0, *DRAWN])),
            })  # fmt: skip
    return rows


def of_set(camera: Camera, how: tuple[float, int, tuple[float, float]], seed: int) -> list[float]:
    """Mean sigmas of projections: of the first views, with suggested ones, and with so many drawn ones, the geometric
    mean of several draws."""
    rng = np.random.default_rng(seed)
    tilt_deg, num, places = how
    views = seen(camera, CHARUCO, drawn(rng, camera, num, tilt_deg, places), rng)
    solution = solved(camera, views)
    made = solution.calibration
    assert made.distances is not None
    distance = made.distances[1]
    before = mean_sigma(made, distance)
    poses = np.array([view.cam_from_target for view in next_views(made, solution.fit, views, CHARUCO)])

    def sigma(more: list[TargetView]) -> float:
        try:
            return mean_sigma(solved(camera, [*views, *more]).calibration, distance)
        except InputError:
            return before  # parameters are left open: nothing was won

    logs = []
    for _ in range(DRAWS):
        more = seen(camera, CHARUCO, drawn(rng, camera, DRAWN[-1], tilt_deg, places), rng)
        logs.append([np.log(sigma(more[:n])) for n in DRAWN])
    return [before, sigma(seen(camera, CHARUCO, poses, rng)), *np.exp(np.mean(logs, 0)).tolist()]


def solved(camera: Camera, views: list[TargetView]) -> Solution:
    """A calibration of the true model from views."""
    return solve_views(views, SIZE, camera.model, bends=False)


def drawn(rng: np.random.Generator, camera: Camera, num: int, tilt_deg: float, places: tuple[float, float]) -> Array:
    """(N, 7) poses of a board that somebody takes without a plan, its middle in a part of the picture."""
    found: list[Array] = []
    while len(found) < num:
        pose = board_poses(rng, CHARUCO, 1, camera, tilt_deg)[0]
        middle = project(camera, rigid3.apply(pose, CHARUCO.points.mean(0)[None]))[0] / SIZE
        if ((middle > places[0]) & (middle < places[1])).all():
            found.append(pose)
    return np.array(found)


def seen(camera: Camera, board: Board, poses: Array, rng: np.random.Generator) -> list[TargetView]:
    """The points of the board that are in the picture, with noise."""
    views = []
    for view in board_views(camera, board, poses, NOISE_PX, rng):
        with np.errstate(invalid="ignore"):
            inside = ((view.xy > 2) & (view.xy < np.array(SIZE) - 2)).all(1)
        views.append(TargetView(f"{rng.integers(10**9)}", view.xyz[inside], view.xy[inside]))
    return views


# -------------------------------------------------------------------------------------------------------- lens models

# a camera of every model that is tried
TRUTHS = {
    "SIMPLE_PINHOLE": [1000.0, 630.0, 490.0],
    "PINHOLE": [1000.0, 1015.0, 630.0, 490.0],
    "SIMPLE_RADIAL": [1000.0, 630.0, 490.0, -0.15],
    "RADIAL": [1000.0, 630.0, 490.0, -0.25, 0.1],
    "OPENCV": [1000.0, 1010.0, 630.0, 490.0, -0.2, 0.05, 1e-3, -5e-4],
    "FULL_OPENCV": CAMERAS["FULL_OPENCV"],
    "OPENCV_THIN_PRISM": [*CAMERAS["FULL_OPENCV"], 2e-3, -1e-3, -1.5e-3, 5e-4],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        420.0,
        425.0,
        630.0,
        490.0,
        -0.02,
        4e-3,
        -1e-3,
        2e-4,
        0.0,
        0.0,
        1e-3,
        -5e-4,
        8e-4,
        -2e-4,
        -6e-4,
        1e-4,
    ],
    "SIMPLE_FISHEYE": [420.0, 630.0, 490.0],
    "FISHEYE": [420.0, 428.0, 630.0, 490.0],
    "SIMPLE_RADIAL_FISHEYE": [420.0, 630.0, 490.0, -0.03],
    "RADIAL_FISHEYE": [420.0, 630.0, 490.0, -0.03, 0.006],
    "OPENCV_FISHEYE": CAMERAS["OPENCV_FISHEYE"],
    "THIN_PRISM_FISHEYE": [420.0, 425.0, 630.0, 490.0, -0.02, 4e-3, 1e-3, -5e-4, -1e-3, 2e-4, 8e-4, -6e-4],
    "FOV": [600.0, 605.0, 630.0, 490.0, 0.9],
    "SIMPLE_DIVISION": [600.0, 630.0, 490.0, -0.25],
    "DIVISION": [600.0, 605.0, 630.0, 490.0, -0.25],
    "EUCM": [450.0, 455.0, 630.0, 490.0, 0.6, 1.1],
}
# the rules were made with 200 to 202 before the eyes; the others are fresh
CHOICE_SEEDS = (*range(200, 203), *range(400, 404))


def lenses() -> list[Row]:
    """Which lens model is chosen for synthetic cameras of every kind, 15 views with noise: how far the chosen one,
    fitted to exact points of the same views, is from the true camera, in sigmas of a projection as the calibration
    says."""
    rows = []
    for name, params in TRUTHS.items():
        truth = Camera(CameraModel[name], *SIZE, np.array(params))
        chosen, off, told = [], [], []
        for seed in CHOICE_SEEDS:
            rng = np.random.default_rng(seed)
            poses = board_poses(rng, CHESS, 15, truth)
            made = solve_views(board_views(truth, CHESS, poses, NOISE_PX, rng), SIZE, bends=False)
            exact = board_views(truth, CHESS, poses, 0.0, rng)
            fit = refine(made.fit, observations_of(exact))
            xy, difference, _ = projection_difference(truth, fit.camera)
            sigma = projection_sigma(made.calibration, xy, made.calibration.distances[1])
            off.append(float(np.sqrt(np.nanmean((difference**2).sum(1) / (2.0 * sigma**2)))))
            chosen.append(made.calibration.camera.model.name)
            told.append(any("do not tell" in warning for warning in made.calibration.warnings))
        is_good = [a == name or b <= 1.0 for a, b in zip(chosen, off, strict=True)]
        rows.append({
            "truth": name, "sets": len(chosen), "chosen": ", ".join(sorted(set(chosen))),
            "true_model": sum(one == name for one in chosen), "largest_bias_sigmas": max(off),
            "within_its_sigma": sum(is_good), "of_fresh": sum(is_good[3:]),
            "biased_and_told": sum(b and not a for a, b in zip(is_good, told, strict=True)),
            "good_and_told": sum(a and b for a, b in zip(is_good, told, strict=True)),
        })  # fmt: skip
    return rows
