"""Grids of circles seen from the side: the bias of their centres, and what it does to a camera, beside OpenCV.

    python benchmarks/circle_centers.py --num 4       writes results/circle_centers.md and .json

Rendered photographs of 960 x 720 with a blur of 0.7 px and noise of 2 grey values; sets of eight views at one tilt, all
round, with four at 25 degrees that OpenCV's finder sees as well. What OpenCV does not find it is given as centres of
mass, which is what its own finder measures: `cv2.calibrateCamera` knows nothing of circles.
"""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from machine import RESULTS, ROOT, describe_machine

sys.path.insert(0, str(ROOT / "tests"))

from board_views import render_board
from sfmapp.calibration.adjustment import TargetView
from sfmapp.calibration.boards import parse_board
from sfmapp.calibration.circle_centers import disk_images, recentered
from sfmapp.calibration.detection import Detection, detect_board
from sfmapp.calibration.printing import CIRCLE_RADIUS
from sfmapp.calibration.solve import solve_views
from sfmapp.camera.camera import Camera, project
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]
Row = dict[str, Any]

SIZE = (960, 720)
CAMERA = Camera(CameraModel.OPENCV, *SIZE, np.array([760.0, 760.0, 480.0, 360.0, -0.2, 0.05, 1e-3, -5e-4]))
BOARD = parse_board("circles:8x6:0.028")
TILTS_DEG, PLAIN_DEG, NUM_TILTED, NUM_PLAIN = (25.0, 45.0, 60.0, 70.0), 25.0, 8, 4


def pose_of(tilt_deg: float, around: float, roll: float, rng: np.random.Generator) -> Array:
    """cam_from_board, as near as the whole board allows."""
    turn = rigid3.exp_so3(np.radians(tilt_deg) * np.array([np.cos(around), np.sin(around), 0.0]))
    rotation = turn @ rigid3.exp_so3(np.array([0.0, 0.0, roll]))
    extent = float(np.ptp(BOARD.points[:, 0]))
    for share in np.arange(1.3, 5.0, 0.05):
        depth = share * extent * CAMERA.focal / CAMERA.width
        shift = np.array([*rng.uniform(-0.12, 0.12, 2) * depth, depth])
        pose: Array = rigid3.from_matrix(rotation, shift - rotation @ BOARD.points.mean(0))
        xy = project(CAMERA, rigid3.apply(pose, BOARD.points))
        if np.isfinite(xy).all() and (xy > 25).all() and (xy < np.array(SIZE) - 25).all():
            return pose
    raise AssertionError("no pose shows the whole board")


def photographs(tilt_deg: float, seed: int) -> tuple[list[Detection], list[Array], int]:
    """What is found in a set of photographs, true poses, and how many boards OpenCV finds among the tilted."""
    rng = np.random.default_rng([seed, int(tilt_deg)])
    found, poses, theirs = [], [], 0
    for k in range(NUM_TILTED + NUM_PLAIN):
        is_plain = k >= NUM_TILTED
        around = 2.0 * np.pi * k / NUM_TILTED + 0.3 * is_plain
        pose = pose_of(PLAIN_DEG if is_plain else tilt_deg, around, 0.1 * k, rng)
        gray = render_board(CAMERA, BOARD, pose, blur_px=0.7, noise=2.0, seed=100 * seed + k)
        detection = detect_board(gray, BOARD)
        theirs += not is_plain and bool(cv2.findCirclesGrid(gray, (BOARD.columns, BOARD.rows))[0])
        if len(detection.idx):
            found.append(detection)
            poses.append(pose)
    return found, poses, theirs


def errors(xy: list[Array], poses: list[Array], tilted: int) -> tuple[Array, Array]:
    """Of the tilted views: errors (N, 2) of centres, and (N, 2) unit vectors along the bias of centres of mass."""
    off, along = [], []
    for points, pose in zip(xy[:tilted], poses[:tilted], strict=True):
        truth = project(CAMERA, rigid3.apply(pose, BOARD.points))
        bias = disk_images(CAMERA, pose, BOARD.points, CIRCLE_RADIUS * BOARD.spacing)[0] - truth
        # a grid of circles is numbered from either end
        near = np.linalg.norm(truth[None] - points[:, None], axis=2).argmin(1)
        off.append(points - truth[near])
        along.append(bias[near] / np.linalg.norm(bias[near], axis=1, keepdims=True))
    return np.concatenate(off), np.concatenate(along)


def row_of(name: str, tilt: float, xy: list[Array], found: list[Detection], poses: list[Array]) -> tuple[Row, Camera]:
    """A camera by some centres, what its errors are and in how many of its sigmas."""
    views = [TargetView(f"{n}", BOARD.points[one.idx], at) for n, (one, at) in enumerate(zip(found, xy, strict=True))]
    made = solve_views(views, SIZE, CAMERA.model, bends=False).calibration
    off, along = errors(xy, poses, len(found) - NUM_PLAIN)
    biased = (off * along).sum(1)
    z = (made.camera.params - CAMERA.params) / made.sigmas
    return {
        "tilt_deg": tilt, "centers": name, "rms_px": float(np.sqrt((off**2).mean())),
        "bias_px": float(biased.mean()), "bias_sigma_px": float(biased.std() / np.sqrt(len(biased))),
        "focal_error_px": float(made.camera.params[0] - CAMERA.params[0]), "worst_sigmas": float(np.abs(z).max()),
        "squared_sigmas": float((z**2).mean()),
    }, made.camera  # fmt: skip


def opencv_focal(found: list[Detection], xy: list[Array]) -> float:
    """The error of OpenCV's focal length from centres of mass."""
    places = [BOARD.points[one.idx].astype(np.float32) for one in found]
    points = [(at - 0.5).astype(np.float32) for at in xy]
    k = cv2.calibrateCamera(places, points, SIZE, None, None, flags=cv2.CALIB_FIX_K3)[1]  # type: ignore[call-overload]
    return float(k[0, 0] - CAMERA.params[0])


def trial(tilt_deg: float, seed: int) -> list[Row]:
    """Centres of mass, what the points tell of their bias, and what the camera tells, on the same photographs."""
    found, poses, theirs = photographs(tilt_deg, seed)
    marks = [one.disks for one in found if one.disks is not None]
    mass, first = [one.mass for one in marks], [one.xy for one in found]
    plain, _ = row_of("centre of mass", tilt_deg, mass, found, poses)
    plain |= {"found_by_opencv": theirs, "opencv_focal_error_px": opencv_focal(found, mass)}
    before, camera = row_of("by the points around", tilt_deg, first, found, poses)
    views = [TargetView("", BOARD.points[one.idx], one.xy) for one in found]
    after, _ = row_of("by the camera", tilt_deg, recentered(views, marks, camera), found, poses)
    return [row | {"seed": seed, "found": len(found)} for row in (plain, before, after)]


def tables(report: dict[str, Any]) -> str:
    """The results for a person."""
    lines = [
        f"# Centres of circles seen from the side: {report['num']} sets of photographs a tilt",
        "",
        f"{NUM_TILTED + NUM_PLAIN} photographs a set. Bias: mean error along what a centre of mass is off by, of the",
        "tilted views, with its sigma. In sigmas: root mean square over the eight parameters of the camera, 1 where",
        "they hold.",
        "",
        "| tilt | centres | rms px | bias px | focal length, rms px | error in sigmas, rms | worst | OpenCV: boards "
        "found of the tilted | its focal length, rms px |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for tilt in TILTS_DEG:
        for name in ("centre of mass", "by the points around", "by the camera"):
            rows = [row for row in report["rows"] if row["tilt_deg"] == tilt and row["centers"] == name]
            rms = np.sqrt(np.mean([row["rms_px"] ** 2 for row in rows]))
            bias, sigma = np.mean([row["bias_px"] for row in rows]), np.mean([row["bias_sigma_px"] for row in rows])
            focal = np.sqrt(np.mean([row["focal_error_px"] ** 2 for row in rows]))
            sigmas = np.sqrt(np.mean([row["squared_sigmas"] for row in rows]))
            theirs = " | "
            if "found_by_opencv" in rows[0]:
                seen = sum(row["found_by_opencv"] for row in rows)
                off = np.sqrt(np.mean([row["opencv_focal_error_px"] ** 2 for row in rows]))
                theirs = f"{seen} of {NUM_TILTED * len(rows)} | {off:.3f}"
            lines.append(
                f"| {tilt:.0f} | {name} | {rms:.4f} | {bias:+.4f} +- {sigma / np.sqrt(len(rows)):.4f} | {focal:.3f} | "
                f"{sigmas:.1f} | {max(row['worst_sigmas'] for row in rows):.1f} | {theirs} |"
            )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num", type=int, default=4, help="sets of photographs at each tilt")
    args = parser.parse_args()
    rows = [row for tilt in TILTS_DEG for seed in range(args.num) for row in trial(tilt, seed)]
    report = {**describe_machine(), "num": args.num, "rows": rows}
    (RESULTS / "circle_centers.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    (RESULTS / "circle_centers.md").write_text(tables(report), encoding="utf-8")


if __name__ == "__main__":
    main()
