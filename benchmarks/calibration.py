"""``sfmapp calibrate board`` against OpenCV, and its sigmas against exact ground truth.

    python benchmarks/calibration.py                     # all of it
    python benchmarks/calibration.py --only photographs  # or degraded, trials, next, refinement, ...

What each part does is in benchmarks/README.md.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from machine import RESULTS, ROOT, describe_machine

sys.path.insert(0, str(ROOT / "tests"))

from board_choices import lenses, suggested_points
from board_films import films
from board_speed import photographs_12_mp, refinement
from board_views import board_poses, board_views, render_board
from sfmapp.calibration.adjustment import Fit, TargetView, normal_at, observations_of, refine, residuals_of
from sfmapp.calibration.boards import Board, parse_board
from sfmapp.calibration.detection import detect_board
from sfmapp.calibration.planning import mean_sigma, next_views
from sfmapp.calibration.result import CameraCalibration
from sfmapp.calibration.solve import bend_basis, solve_views
from sfmapp.calibration.start import posed
from sfmapp.calibration.uncertainty import frame_covariance, image_grid, projection_covariance
from sfmapp.camera.camera import Camera, pixels_to_rays, project
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Row = dict[str, Any]

DATA = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
CHESS = parse_board("chessboard:9x6:0.025")
CHARUCO = parse_board("charuco:9x7:0.025:0.018")
SIZE = (1280, 960)
TRUE = Camera(CameraModel.OPENCV, *SIZE, np.array([1000.0, 1010.0, 630.0, 490.0, -0.2, 0.05, 1e-3, -5e-4]))


def photographs() -> list[Row]:
    """The chessboards of the OpenCV samples, both cameras: the same corners, and each with its own corners."""
    rows = []
    for side in ("left", "right"):
        ours, theirs = [], []
        for path in sorted((DATA / "opencv-doc-samples" / "calib").glob(f"{side}[0-9][0-9].jpg")):
            gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            found = detect_board(gray, CHESS)
            ours.append(TargetView(path.name, CHESS.points[found.idx], found.xy))
            # the window that OpenCV's sample has is larger than fields seen from afar: the smaller is better by half
            is_found, corners = cv2.findChessboardCorners(gray, (9, 6))
            if is_found:
                stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
                corners = cv2.cornerSubPix(gray, corners, (5, 5), (-1, -1), stop).reshape(-1, 2)
                theirs.append(TargetView(path.name, CHESS.points, corners.astype(np.float64) + 0.5))
        rms, camera = opencvs(ours, (640, 480))
        made = least_squares(ours, (640, 480))
        rows.append({
            "camera": side, "views": len(ours), "points": int(sum(len(view.xy) for view in ours)),
            "opencv_views": len(theirs), "opencv_points": int(sum(len(view.xy) for view in theirs)),
            "rms_px": made[1], "opencv_rms_px_same_points": rms,
            "largest_difference_of_parameters": float(np.abs(made[0].params / camera.params - 1.0).max()),
            "held_out_px": held_out(ours, lambda views: least_squares(views, (640, 480))[0]),
            "opencv_held_out_px_same_points": held_out(ours, lambda views: opencvs(views, (640, 480))[1]),
            "opencv_held_out_px_own_points": held_out(theirs, lambda views: opencvs(views, (640, 480))[1]),
            "opencv_rms_px_own_points": opencvs(theirs, (640, 480))[0],
        })  # fmt: skip
    return rows


def least_squares(views: list[TargetView], size: tuple[int, int]) -> tuple[Camera, float]:
    """Our camera of a model with four coefficients, a flat board, and the rms of all points that it used."""
    made = solve_views(views, size, CameraModel.OPENCV, bends=False).calibration
    return made.camera, made.rms_px


def opencvs(views: list[TargetView], size: tuple[int, int]) -> tuple[float, Camera]:
    """``cv2.calibrateCamera`` with k1, k2, p1, p2."""
    objects = [view.xyz.astype(np.float32) for view in views]
    pixels = [(view.xy - 0.5).astype(np.float32)[:, None] for view in views]
    rms, k, d, *_ = cv2.calibrateCamera(objects, pixels, size, None, None, flags=cv2.CALIB_FIX_K3)
    params = np.array([k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *d.ravel()[:4]])
    return float(rms), Camera(CameraModel.OPENCV, *size, params)


def held_out(views: list[TargetView], fit: Callable[[list[TargetView]], Camera]) -> float:
    """Rms in pixels of views under the camera of the others, one in five held out; their poses are fitted."""
    squares = []
    for fold in range(5):
        camera = fit([view for n, view in enumerate(views) if n % 5 != fold])
        for view in views[fold::5]:
            obs = observations_of([view])
            found = refine(posed(camera, [view]), obs, hold_camera=True)
            squares += (residuals_of(found, obs) ** 2).sum(1).tolist()
    return float(np.sqrt(np.mean(squares)))


def degraded() -> list[Row]:
    """Rendered boards, sharp, blurred, tilted by 60 degrees and half out of the picture: points found by both."""
    camera = Camera(CameraModel.OPENCV, 960, 720, np.array([760.0, 760.0, 480.0, 360.0, -0.2, 0.05, 1e-3, -5e-4]))
    cases = {
        "sharp": (20.0, 0.0, 0.7), "blurred, 3 px": (20.0, 0.0, 3.0), "blurred, 5 px": (20.0, 0.0, 5.0),
        "60 degrees": (60.0, 0.0, 0.7), "60 degrees, blurred 2 px": (60.0, 0.0, 2.0), "70 degrees": (70.0, 0.0, 0.7),
        "half out": (20.0, 0.5, 0.7), "half out, 45 degrees": (45.0, 0.5, 0.7),
    }  # fmt: skip
    boards = ("chessboard:9x6:0.025", "charuco:9x7:0.028:0.021", "aprilgrid:6x4:0.03:0.3", "circles:8x6:0.028")
    rows = []
    for text in boards:
        board = parse_board(text)
        for name, (tilt, shift, blur) in cases.items():
            ours, theirs, errors = 0, 0, []
            for seed in range(3):
                pose = tilted(board, camera, tilt + 2.0 * seed, shift, seed)
                gray = render_board(camera, board, pose, blur_px=blur, noise=2.0, seed=seed)
                found = detect_board(gray, board)
                ours += len(found.idx)
                theirs += opencvs_points(gray, board)
                truth = project(camera, rigid3.apply(pose, board.points))
                if len(found.idx):
                    gap = np.linalg.norm(found.xy[:, None] - truth[None], axis=2).min(1)
                    errors += gap.tolist()
            rows.append({
                "board": board.kind, "case": name, "found": ours, "opencv": theirs, "of": 3 * len(board.points),
                "error_px": float(np.sqrt(np.mean(np.square(errors)))) if errors else None,
            })  # fmt: skip
    return rows


def tilted(board: Board, camera: Camera, tilt_deg: float, shift: float, seed: int) -> Array:
    """cam_from_board of a board that is tilted and, by a share of the picture, out of it."""
    rotation = rigid3.exp_so3(np.radians([4.0 * seed, tilt_deg, 5.0 + 3.0 * seed]))
    extent = float(np.ptp(board.points[:, 0]))
    depth = 1.45 * extent * camera.focal / camera.width
    middle = board.points.mean(0)
    side = shift * depth * camera.width / camera.focal
    pose: Array = rigid3.from_matrix(rotation, np.array([side, 0.0, depth]) - rotation @ middle)
    return pose


def opencvs_points(gray: NDArray[np.uint8], board: Board) -> int:
    """Points that the best of OpenCV's finders finds."""
    size = (board.columns, board.rows)
    if board.kind == "chessboard":
        sb = cv2.findChessboardCornersSB(gray, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE)[0]
        return size[0] * size[1] if sb or cv2.findChessboardCorners(gray, size)[0] else 0
    if board.kind == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        ids = cv2.aruco.CharucoDetector(
            cv2.aruco.CharucoBoard(size, board.spacing, board.marker, dictionary)
        ).detectBoard(gray)[1]
        return 0 if ids is None else len(ids)
    if board.kind == "aprilgrid":
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = 2
        family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        ids = cv2.aruco.ArucoDetector(family, parameters).detectMarkers(gray)[1]
        return 0 if ids is None else 4 * len(ids)
    found = cv2.findCirclesGrid(gray, size, flags=cv2.CALIB_CB_SYMMETRIC_GRID)[0]
    return size[0] * size[1] if found else 0


def trials(num: int = 500) -> list[Row]:
    """Views with noise: errors in sigmas, and how often the sigma of a projection covers its error."""
    rows = []
    for name, depth, seed in (("flat board", 0.0, 1), ("flat board, other poses", 0.0, 2), ("bent board", 0.001, 3)):
        rng = np.random.default_rng(seed)
        poses = board_poses(rng, CHESS, 10, TRUE)
        grid = image_grid(TRUE, (9, 7))
        nees, inside, covered, correlations = [], [], [], np.zeros((8, 8))
        for _ in range(num):
            made, squared, places = one_trial(poses, depth, rng, grid)
            nees.append(squared)
            inside.append(np.abs(made.camera.params - TRUE.params) < 3.0 * made.sigmas)
            covered.append(places)
            correlations += made.correlations / num
        # what numbers with these correlations do by themselves, by a million draws
        drawn = rng.multivariate_normal(np.zeros(8), correlations, 1_000_000)
        expected = float((np.abs(drawn) < 3.0).all(1).mean())
        rows.append({
            "case": name, "trials": num, "nees": float(np.mean(nees)),
            "parameters_within_3_sigma": float(np.mean(inside)),
            "trials_with_all_within_3_sigma": float(np.mean(np.all(inside, axis=1))),
            "expected_of_right_sigmas": expected, "sigma_of_that": float(np.sqrt(expected * (1.0 - expected) / num)),
            "projections_covered": float(np.mean(covered)),
        })  # fmt: skip
    return rows


def one_trial(
    poses: Array, depth: float, rng: np.random.Generator, grid: Array
) -> tuple[CameraCalibration, float, float]:
    """The calibration, the NEES of its parameters, and the share of places whose 95 % ellipse holds the error."""
    views = board_views(TRUE, CHESS, poses, 0.25, rng, bend=depth)
    bends = [bend_basis(view, views) for view in views] if depth else None
    obs, num = observations_of(views, bends), len(TRUE.params)
    start = np.array([depth, 0.0, 0.0]) if depth else np.zeros(0)
    fit = refine(Fit(TRUE, poses, start, np.inf), obs)
    dof = 2 * len(obs.xy) - num - len(start) - 6 * len(poses)
    variance = float((residuals_of(fit, obs) ** 2).sum()) / dof
    normal = normal_at(fit, obs)
    joint = frame_covariance(normal, num, variance)
    assert joint is not None
    made = CameraCalibration(fit.camera, joint[:num, :num], "", variance**0.5, dof, frame_covariance=joint)
    error = fit.camera.params - TRUE.params
    distance = 0.4
    points = distance * pixels_to_rays(TRUE, grid)
    moved = rigid3.compose(fit.cam_from_target, rigid3.inverse(poses))
    steps = np.concatenate([rigid3.log_so3(rigid3.rotation_matrix(moved)), moved[:, 4:]], 1)
    # what a change of the board's shape moves belongs to the frame as well
    right = np.einsum("vij,vj->i", normal.own, steps)
    right += np.einsum("vbi,b->i", normal.cross[:, num:], fit.bend - start) if depth else 0.0
    motion = np.linalg.solve(normal.own.sum(0), right)
    off = project(fit.camera, points + np.cross(motion[:3], points) + motion[3:]) - grid
    squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(projection_covariance(made, grid, distance)), off)
    nees = float(error @ np.linalg.solve(made.covariance, error)) / num
    return made, nees, float((squared < chi2.ppf(0.95, 2)).mean())


def suggested() -> list[Row]:
    """Three suggested views against three drawn at random, rendered, found and solved anew."""
    camera = Camera(CameraModel.OPENCV, 960, 720, np.array([760.0, 760.0, 480.0, 360.0, -0.2, 0.05, 1e-3, -5e-4]))
    rows = []
    for seed in range(5):
        rng = np.random.default_rng(60 + seed)
        poses = board_poses(rng, CHARUCO, 8, camera, 30.0)
        first = [seen(camera, pose, n) for n, pose in enumerate(poses)]
        solution = solve_views(first, (960, 720), CameraModel.OPENCV, bends=False)
        made = solution.calibration
        distance = made.distances[1] if made.distances else 0.4
        wanted = [view.cam_from_target for view in next_views(made, solution.fit, first, CHARUCO)]
        sigmas = []
        for more in (wanted, list(board_poses(rng, CHARUCO, 3, camera, 30.0))):
            added = [*first, *(seen(camera, pose, 20 + n) for n, pose in enumerate(more))]
            again = solve_views(added, (960, 720), CameraModel.OPENCV, bends=False).calibration
            sigmas.append(mean_sigma(again, distance))
        before = mean_sigma(made, distance)
        rows.append({
            "seed": seed, "before_px": before, "suggested_px": sigmas[0], "random_px": sigmas[1],
            "times_as_fast": float(np.log(before / sigmas[0]) / np.log(before / sigmas[1])),
        })  # fmt: skip
    return rows


def seen(camera: Camera, pose: Array, seed: int) -> TargetView:
    """A rendered photograph of the ChArUco board and what is found in it."""
    found = detect_board(render_board(camera, CHARUCO, pose, blur_px=0.7, noise=2.0, seed=seed), CHARUCO)
    return TargetView(f"{seed:02d}", CHARUCO.points[found.idx], found.xy)


PARTS: dict[str, Callable[[], list[Row]]] = {
    "photographs": photographs, "degraded": degraded, "trials": trials, "next": suggested,
    "next_points": suggested_points, "lenses": lenses, "films": films,
    "refinement": refinement, "photographs_12_mp": photographs_12_mp,
}  # fmt: skip


def markdown(report: dict[str, Any]) -> str:
    """A table for each part."""
    lines = [f"sfmapp {report['versions']['sfmapp']} at {report['commit']}; {report['cpu']}, {report['cores']} cores, "
             f"{report['date']}. What the columns mean is in benchmarks/README.md.\n"]  # fmt: skip
    for name in PARTS:
        rows = report.get(name)
        if rows:
            columns = list(dict.fromkeys(key for row in rows for key in row))
            lines.append(f"## {name}\n\n| {' | '.join(columns).replace('_', ' ')} |\n|{'---|' * len(columns)}")
            lines += ["| " + " | ".join(_cell(row.get(column)) for column in columns) + " |" for row in rows]
            lines.append("")
    return "\n".join(lines)


def _cell(value: Any) -> str:
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=PARTS, nargs="+", default=list(PARTS))
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "calibration.json")
    args = parser.parse_args()
    known = json.loads(args.output.read_text(encoding="utf-8")) if args.output.is_file() else {}
    report = {**known, **describe_machine()}
    for name in args.only:
        report[name] = PARTS[name]()
        print(json.dumps(report[name], indent=1), flush=True)
        args.output.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        args.output.with_suffix(".md").write_text(markdown(report), encoding="utf-8")


if __name__ == "__main__":
    main()
