"""Cameras and poses from points with known places: errors against their sigmas, and beside OpenCV and pycolmap.

    python benchmarks/known_points.py --num 500       writes results/known_points.md and .json

Pictures of 1280 x 720 with a distortion of -0.2 and 0.05, a target half as deep as wide, marks of half a pixel; wrong
marks are off by 10 to 60 pixels. Times are CPU milliseconds on one thread, the least of three rounds.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from machine import RESULTS, describe_machine
from sfmapp.calibration.locate import locate_camera
from sfmapp.calibration.target import calibrate_target
from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.errors import SfmError
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Trial = tuple[Array, Array, Array]
Answer = tuple[Array, Array] | None

SIZE, SIGMA_PX = (1280, 720), 0.5
CAMERA = Camera(CameraModel.OPENCV, *SIZE, np.array([900.0, 910.0, 630.0, 370.0, -0.2, 0.05, 0.001, -0.002]))
GUESS = np.array([[900.0, 0.0, 640.0], [0.0, 900.0, 360.0], [0.0, 0.0, 1.0]])
OPENCV_K = CAMERA.k_matrix - [[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]]
EXACT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
TURNED_DEG = 2.0
COLMAP_CAMERA = pycolmap.Camera(model="OPENCV", width=SIZE[0], height=SIZE[1], params=CAMERA.params)


def make_trial(seed: tuple[int, ...], num: int, num_wrong: int, depth: float) -> Trial:
    """Places (N, 3), marks (N, 2) and the true pose (7,)."""
    rng = np.random.default_rng(list(seed))
    while True:
        xyz = rng.uniform(-1.0, 1.0, (num, 3)) * [1.6, 1.0, depth]
        pose = rigid3.from_matrix(rigid3.exp_so3(0.5 * rng.normal(size=3)), np.array([*0.1 * rng.normal(size=2), 3.5]))
        xy = project(CAMERA, rigid3.apply(pose, xyz))
        if np.isfinite(xy).all() and (xy > 0).all() and (xy < SIZE).all():
            break
    xy = xy + SIGMA_PX * rng.normal(size=xy.shape)
    wrong, turn = rng.choice(num, num_wrong, replace=False), rng.uniform(0.0, 2.0 * np.pi, num_wrong)
    xy[wrong] += rng.uniform(10.0, 60.0, (num_wrong, 1)) * np.stack([np.cos(turn), np.sin(turn)], 1)
    return xyz, xy, pose


# -------------------------------------------------------------------------------------------------------------- cameras


def our_camera(xyz: Array, xy: Array) -> Answer:
    """Parameters (8,) and pose (7,), and the covariance (14, 14) of both; None for no answer."""
    try:
        fit = calibrate_target(xyz, xy, SIZE, camera_model=CameraModel.OPENCV)
    except SfmError:
        return None
    return np.concatenate([fit.view.camera.params, fit.view.cam_from_world]), fit.covariance


def opencv_camera(xyz: Array, xy: Array) -> Answer:
    """The same by OpenCV, which needs a guess for points in space: within two per cent of the truth."""
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    _, k, distortion, turns, shifts = cv2.calibrateCamera(
        [xyz.astype(np.float32)], [(xy - 0.5).astype(np.float32)], SIZE, GUESS.copy(), np.zeros(5), flags=flags,
        criteria=EXACT,
    )  # fmt: skip
    pose = rigid3.from_matrix(rigid3.exp_so3(turns[0].ravel()), shifts[0].ravel())
    found = [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *distortion.ravel()[:4]]
    return np.concatenate([found, pose]), np.zeros((0, 0))


# ---------------------------------------------------------------------------------------------------------------- poses


def our_pose(xyz: Array, xy: Array) -> Answer:
    """Pose (7,) and covariance (6, 6); None for no answer."""
    try:
        found = locate_camera(xyz, xy, CAMERA)
    except SfmError:
        return None
    return found.view.cam_from_world, found.covariance[-6:, -6:]


def opencv_pose(flag: int) -> Callable[[Array, Array], Answer]:
    """All points by a method of OpenCV, then its refinement."""

    def solve(xyz: Array, xy: Array) -> Answer:
        with contextlib.suppress(cv2.error):
            ok, turn, shift = cv2.solvePnP(xyz, xy - 0.5, OPENCV_K, CAMERA.params[4:], flags=flag)
            if ok:
                return _refined(xyz, xy, turn, shift)
        return None

    return solve


def opencv_ransac(xyz: Array, xy: Array) -> Answer:
    """RANSAC over P3P at 8 pixels, then its refinement on the inliers."""
    with contextlib.suppress(cv2.error):
        ok, turn, shift, inliers = cv2.solvePnPRansac(
            xyz, xy - 0.5, OPENCV_K, CAMERA.params[4:], flags=cv2.SOLVEPNP_P3P, reprojectionError=8.0,
            confidence=0.9999, iterationsCount=10_000,
        )  # fmt: skip
        if ok and inliers is not None and len(inliers) >= 4:
            return _refined(xyz[inliers[:, 0]], xy[inliers[:, 0]], turn, shift)
    return None


def _refined(xyz: Array, xy: Array, turn: Array, shift: Array) -> Answer:
    turn, shift = cv2.solvePnPRefineLM(xyz, xy - 0.5, OPENCV_K, CAMERA.params[4:], turn.copy(), shift.copy())
    return rigid3.from_matrix(rigid3.exp_so3(turn.ravel()), shift.ravel()), np.zeros((0, 0))


def colmap_pose(xyz: Array, xy: Array) -> Answer:
    """pycolmap's LO-RANSAC at 8 pixels, refined."""
    answer = pycolmap.estimate_and_refine_absolute_pose(
        xy, xyz, COLMAP_CAMERA, {"ransac": {"max_error": 8.0}}
    )  # fmt: skip
    if answer is None:
        return None
    matrix = answer["cam_from_world"].matrix()
    return rigid3.from_matrix(matrix[:, :3], matrix[:, 3]), np.zeros((0, 0))


# -------------------------------------------------------------------------------------------------------------- scoring


def pose_error(found: Array, pose: Array) -> Array:
    """(6,) turn and shift of ``x_cam <- exp(w) x_cam + v``."""
    turn = rigid3.log_so3(rigid3.rotation_matrix(found) @ rigid3.rotation_matrix(pose).T)
    return np.concatenate([turn, found[4:] - rigid3.exp_so3(turn) @ pose[4:]])


def timed(solve: Callable[[Array, Array], Answer], trials: list[Trial]) -> tuple[list[Answer], float]:
    """Answers, and CPU milliseconds of one: the least of three rounds."""
    solve(*trials[0][:2])
    rounds, answers = [], list[Answer]()
    for _ in range(3):
        start = time.process_time()
        answers = [solve(xyz, xy) for xyz, xy, _ in trials]
        rounds.append((time.process_time() - start) / len(trials) * 1e3)
    return answers, min(rounds)


def sigmas_hold(errors: list[Array], covariances: list[Array], degrees: float) -> dict[str, float]:
    """NEES by its degrees of freedom with the interval of 99.8 % that it should lie in, and the share within three
    sigmas; nothing of a program that has no sigmas.

    Args:
        degrees: of freedom of the residuals that the noise is found from: the squares of n errors over it follow
            n F(n, degrees), which spreads more than chi-square; of hundreds of pictures the mean is normal.
    """
    if not covariances[0].size:
        return {}
    size, num = len(errors[0]), len(errors)
    nees = sum(float(e @ np.linalg.solve(c, e)) for e, c in zip(errors, covariances, strict=True)) / (size * num)
    spread = np.sqrt(2.0 * (size + degrees - 2.0) / (size * (degrees - 4.0) * num)) if degrees > 4.0 else np.inf
    share = np.mean([np.abs(e) < 3.0 * np.sqrt(np.diag(c)) for e, c in zip(errors, covariances, strict=True)])
    low, high = 1.0 - 3.09 * float(spread), 1.0 + 3.09 * float(spread)
    return {"nees": nees, "nees_low": low, "nees_high": high, "within_3_sigmas": float(share)}


def sigmas_text(row: dict[str, Any]) -> str:
    if row.get("nees") is None:
        return " | "
    return (
        f"{row['nees']:.3f} ({row['nees_low']:.3f} to {row['nees_high']:.3f}) | {100.0 * row['within_3_sigmas']:.2f} %"
    )


def camera_rows(num_trials: int, num: int, num_wrong: int) -> list[dict[str, Any]]:
    """Ours and OpenCV's on the same pictures."""
    trials = [make_trial((1, num, num_wrong, k), num, num_wrong, 0.8) for k in range(num_trials)]
    rows = []
    for name, solve in (("sfmapp", our_camera), ("OpenCV, with a guess", opencv_camera)):
        answers, cpu_ms = timed(solve, trials)
        kept = [(a, pose) for a, (_, _, pose) in zip(answers, trials, strict=True) if a is not None]
        errors = [np.concatenate([a[0][:8] - CAMERA.params, pose_error(a[0][8:], pose)]) for a, pose in kept]
        focal = np.sqrt(np.mean([(e[:2] ** 2).mean() for e in errors]))
        worst = np.max([np.abs(e[:2]).max() for e in errors])
        center = np.sqrt(np.mean([(e[2:4] ** 2).mean() for e in errors]))
        rows.append({
            "case": f"{num} points, {num_wrong} wrong", "program": name, "answers": len(kept),
            "focal_rms_px": float(focal), "focal_worst_px": float(worst), "center_rms_px": float(center),
            **sigmas_hold(errors, [a[1] for a, _ in kept], 2 * (num - num_wrong) - 14), "cpu_ms": cpu_ms,
        })  # fmt: skip
        print(rows[-1], flush=True)
    return rows


def pose_rows(num_trials: int, num: int, num_wrong: int, depth: float) -> list[dict[str, Any]]:
    """Ours, OpenCV's and pycolmap's on the same pictures; gross: rotations off by more than two degrees."""
    trials = [make_trial((2, num, num_wrong, int(10 * depth), k), num, num_wrong, depth) for k in range(num_trials)]
    peers: list[tuple[str, Callable[[Array, Array], Answer]]] = [("sfmapp", our_pose)]
    if num_wrong == 0:
        peers += [
            ("OpenCV EPNP", opencv_pose(cv2.SOLVEPNP_EPNP)),
            ("OpenCV SQPNP", opencv_pose(cv2.SOLVEPNP_SQPNP)),
            ("OpenCV ITERATIVE", opencv_pose(cv2.SOLVEPNP_ITERATIVE)),
        ]
    peers += [("OpenCV RANSAC", opencv_ransac), ("pycolmap", colmap_pose)]
    rows = []
    for name, solve in peers:
        answers, cpu_ms = timed(solve, trials)
        kept = [(a, pose) for a, (_, _, pose) in zip(answers, trials, strict=True) if a is not None]
        errors = [pose_error(a[0], pose) for a, pose in kept]
        good = [k for k, e in enumerate(errors) if np.degrees(np.linalg.norm(e[:3])) <= TURNED_DEG]
        turn = np.degrees(np.sqrt(np.mean([(errors[k][:3] ** 2).sum() for k in good])))
        kind = "a plane" if depth == 0.0 else "space"
        rows.append({
            "case": f"{num} points in {kind}, {num_wrong} wrong", "program": name, "good": len(good),
            "gross": len(kept) - len(good), "no_answer": num_trials - len(kept), "rotation_rms_deg": float(turn),
            **sigmas_hold([errors[k] for k in good], [kept[k][0][1] for k in good], 2 * (num - num_wrong) - 6),
            "cpu_ms": cpu_ms,
        })  # fmt: skip
        print(rows[-1], flush=True)
    return rows


def tables(report: dict[str, Any]) -> str:
    """The results for a person."""
    lines = [
        f"# Known points: {report['num']} pictures of each kind",
        "",
        "Marks of half a pixel; wrong ones are off by 10 to 60. Where nothing is wrong, OpenCV minimises the same.",
        "",
        "## Cameras from one photograph (`sfmapp calibrate target`)",
        "",
        "| target | program | answers | focal lengths, rms px | worst | principal point, rms px | NEES a number "
        "(99.8 %) | within 3 sigmas | CPU ms |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in report["cameras"]:
        lines.append(
            f"| {row['case']} | {row['program']} | {row['answers']} | {row['focal_rms_px']:.2f} | "
            f"{row['focal_worst_px']:.1f} | {row['center_rms_px']:.2f} | {sigmas_text(row)} | {row['cpu_ms']:.1f} |"
        )
    lines += [
        "",
        "## Poses of a known camera (`sfmapp locate`)",
        "",
        f"Gross: turned by more than {TURNED_DEG:g} degrees; what follows is of the others.",
        "",
        "| points | program | good | gross | no answer | rotation, rms degrees | NEES a number (99.8 %) "
        "| within 3 sigmas | CPU ms |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in report["poses"]:
        lines.append(
            f"| {row['case']} | {row['program']} | {row['good']} | {row['gross']} | {row['no_answer']} | "
            f"{row['rotation_rms_deg']:.4f} | {sigmas_text(row)} | {row['cpu_ms']:.2f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num", type=int, default=500, help="pictures of each kind")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    report = {**describe_machine(), "num": args.num, "cameras": [], "poses": []}
    for num, num_wrong in ((40, 0), (40, 4), (20, 0)):
        report["cameras"] += camera_rows(args.num, num, num_wrong)
    for num, num_wrong, depth in ((20, 0, 0.8), (20, 0, 0.0), (20, 6, 0.8), (20, 6, 0.0), (6, 0, 0.8)):
        report["poses"] += pose_rows(args.num, num, num_wrong, depth)
    (RESULTS / "known_points.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    (RESULTS / "known_points.md").write_text(tables(report), encoding="utf-8")


if __name__ == "__main__":
    main()
