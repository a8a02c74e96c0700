"""Rigs and focal lengths without a board: errors against exact truth, OpenCV's rig beside ours on the same corners.

    python benchmarks/rigs.py                    # results/rigs.md
    python benchmarks/rigs.py --trials 20 -o /tmp/new/rigs.md

Synthetic rigs are begun with intrinsics that are 0.1 % off, at a noise of 0.05 to 0.5 px that differs from trial to
trial. NEES is the squared error in terms of the stated covariance, by its dimension: 1 where sigmas are right. Real
pairs: the thirteen of OpenCV's samples, corners of our detection for both programs, the same lens model (k1, k2, p1,
p2), Sampson errors of the same points by the same function. Focal lengths: photographs that were cut from a panorama
with a focal length of 520 px, and pairs of photographs that were calibrated by others.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import sfmapp
from machine import RESULTS, ROOT, describe_machine
from rig_scenes import FISHEYE, PINHOLE, apart_rig, errors_of, overlapping_rig, pose, views_of
from sfmapp.calibration.adjustment import TargetView
from sfmapp.calibration.boards import Board
from sfmapp.calibration.detection import detect_board
from sfmapp.calibration.epipolar_errors import epipolar_errors
from sfmapp.calibration.rig import RigCalibration, calibrate_rig
from sfmapp.calibration.rig_adjustment import RigFit, RigView
from sfmapp.calibration.solve import solve_views
from sfmapp.camera.camera import Camera
from sfmapp.camera.names import CameraModel
from sfmapp.geometry import rigid3
from sfmapp.geometry.self_calibration import (
    focal_from_fundamental,
    focal_from_homographies,
    refine_turning_camera,
)
from sfmapp.scene.rig import Rig

RIGS: dict[str, Callable[[np.random.Generator], RigFit]] = {
    "pinhole beside fisheye, 14 shots": lambda rng: overlapping_rig(rng, (PINHOLE, FISHEYE), 14),
    "three cameras, 12 shots": lambda rng: overlapping_rig(rng, (PINHOLE, FISHEYE, PINHOLE), 12),
    "back to back, two boards, 20 shots": lambda rng: apart_rig(rng, 20),
}
# matches that a pair of photographs needs for F or H
LEAST_MATCHES = 50


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=150, help="of each synthetic rig")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "rigs.md")
    arguments = parser.parse_args()
    data = Path(os.environ.get("SFMAPP_DATA", ROOT.parent / "shared" / "data"))
    report = describe_machine()
    report["synthetic"] = [trials(name, make, arguments.trials) for name, make in RIGS.items()]
    report["odd"] = odd_shots(max(arguments.trials // 5, 4))
    report["opencv"] = beside_opencv(data / "opencv-doc-samples" / "calib")
    sets = ("fountain-P11", "herz-jesus-P8")
    report["focal"] = [turning(data / "pano-sponza-rot"), *(of_pairs(data / name) for name in sets)]
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    arguments.output.with_suffix(".json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    arguments.output.write_text(tables(report), encoding="utf-8")
    print(tables(report))


def calibrated(truth: RigFit, views: list[RigView]) -> Any:
    cameras = [camera.with_params(camera.params * 1.001) for camera in truth.cameras]
    return calibrate_rig([f"cam{c}" for c in range(len(cameras))], cameras, [False] * len(cameras), views)


def trials(name: str, make: Callable[[np.random.Generator], RigFit], num: int) -> dict[str, Any]:
    """How often errors stay inside three stated sigmas, and NEES."""
    nees, outside, wrongly_odd = [], [], 0
    for seed in range(num):
        rng = np.random.default_rng(seed)
        truth = make(rng)
        found = calibrated(truth, views_of(truth, rng, rng.uniform(0.05, 0.5)))
        fit = RigFit(found.rig.cameras, found.rig.cam_from_rig, np.zeros((0, 7)), found.world_from_board)
        error = errors_of(fit, truth)
        nees.append(float(error @ np.linalg.solve(found.covariance, error)) / len(error))
        outside += (np.abs(error) > 3.0 * np.sqrt(np.diag(found.covariance))).tolist()
        wrongly_odd += len(found.odd)
    return {
        "rig": name, "trials": num, "parameters": len(outside) // num, "nees": float(np.mean(nees)),
        "nees_sigma": float(np.std(nees) / np.sqrt(num)), "inside_3_sigma": 1.0 - float(np.mean(outside)),
        "wrongly_odd": wrongly_odd,
    }  # fmt: skip


def odd_shots(num: int) -> dict[str, Any]:
    """Of two cameras, ten shots: one swapped, one in which the board moved by 1 to 5 mm and 0.1 to 0.5 degrees."""
    named = {"swapped": 0, "moved": 0}
    wrong, worst = 0, 0.0
    for seed in range(num):
        rng = np.random.default_rng(1000 + seed)
        truth = overlapping_rig(rng, (PINHOLE, PINHOLE), 10)
        views = views_of(truth, rng, 0.2)
        place = {(view.camera, view.shot): i for i, view in enumerate(views)}
        a, b = place[0, 3], place[1, 3]
        views[a], views[b] = replace(views[a], view=views[b].view), replace(views[b], view=views[a].view)
        motion = pose(np.radians(rng.uniform(0.1, 0.5)) * _unit(rng), rng.uniform(0.001, 0.005) * _unit(rng))
        late = views_of(replace(truth, rig_from_world=rigid3.compose(truth.rig_from_world, motion)), rng, 0.2)
        views[place[1, 7]] = next(view for view in late if (view.camera, view.shot) == (1, 7))
        found = calibrated(truth, views)
        reasons = {(one.camera, one.shot): one.reason for one in found.odd}
        named["swapped"] += "swapped" in reasons.pop((1, 3), "")
        named["moved"] += "moved" in reasons.pop((1, 7), "")
        wrong += len(reasons)
        fit = RigFit(found.rig.cameras, found.rig.cam_from_rig, np.zeros((0, 7)), found.world_from_board)
        error = errors_of(fit, truth)[-6:] / np.sqrt(np.diag(found.covariance)[-6:])
        worst = max(worst, float(np.abs(error).max()))
    return {"trials": num, **named, "others_named": wrong, "worst_pose_error_sigmas": worst}


def _unit(rng: np.random.Generator) -> np.ndarray:
    axis = rng.standard_normal(3)
    unit: np.ndarray = axis / np.linalg.norm(axis)
    return unit


@dataclass(frozen=True)
class Samples:
    """The thirteen stereo pairs of OpenCV's samples: corners (54, 2) by side and number, and the rig by both."""

    num: int
    corners: dict[tuple[int, int], np.ndarray]
    found: RigCalibration
    ours: Rig
    theirs: Rig


def calibrate_samples(folder: Path) -> Samples:
    """Find the corners, and calibrate the rig by sfmapp and by OpenCV."""
    import cv2

    board = Board("chessboard", 9, 6, 0.025)
    views, corners = [], {}
    for c, side in enumerate(("left", "right")):
        for t, path in enumerate(sorted(folder.glob(f"{side}[0-9]*.jpg"))):
            found = detect_board(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), board)
            assert len(found.idx) == len(board.points), path
            xy = found.xy[np.argsort(found.idx)]
            corners[c, t] = xy
            views.append(RigView(c, t, 0, TargetView(path.name, board.points, xy)))
    num = len(views) // 2
    alone = [
        solve_views([v.view for v in views if v.camera == c], (640, 480), CameraModel.OPENCV, bends=False).calibration
        for c in (0, 1)
    ]
    found = calibrate_rig(("left", "right"), [one.camera for one in alone], (False, False), views)
    target = [board.points.astype(np.float32)] * num
    pixels = [[(corners[c, t] - 0.5).astype(np.float32) for t in range(num)] for c in (0, 1)]
    begin = [
        cv2.calibrateCamera(target, pixels[c], (640, 480), None, None, flags=cv2.CALIB_FIX_K3)[1:3] for c in (0, 1)
    ]
    _, k1, d1, k2, d2, turn, shift, *_ = cv2.stereoCalibrate(
        target, pixels[0], pixels[1], *begin[0], *begin[1], (640, 480),
        flags=cv2.CALIB_FIX_K3 | cv2.CALIB_USE_INTRINSIC_GUESS, criteria=(3, 500, 1e-12),
    )  # fmt: skip
    their_pose = rigid3.from_matrix(turn, shift.ravel())
    theirs = Rig((_camera_of(k1, d1), _camera_of(k2, d2)), np.array([rigid3.IDENTITY, their_pose]))
    ours = Rig(found.rig.cameras, np.array([rigid3.IDENTITY, found.pairs[0].second_from_first]))
    return Samples(num, corners, found, ours, theirs)


def beside_opencv(folder: Path) -> dict[str, Any]:
    """The thirteen stereo pairs of OpenCV's samples."""
    samples = calibrate_samples(folder)
    num, corners, found, theirs = samples.num, samples.corners, samples.found, samples.theirs.cameras
    their_pose, pair = samples.theirs.cam_from_rig[1], found.pairs[0]
    odd = {one.shot for one in found.odd}
    believed = [t for t in range(num) if t not in odd]

    def rms(cameras: Any, second: np.ndarray, shots: list[int]) -> float:
        one, two = (np.concatenate([corners[c, t] for t in shots]) for c in (0, 1))
        return float(np.sqrt((epipolar_errors(tuple(cameras), second, one, two) ** 2).mean()))

    between = rigid3.compose(pair.second_from_first, rigid3.inverse(their_pose))
    away = np.concatenate([rigid3.log_so3(rigid3.rotation_matrix(between)), between[4:]])
    every = list(range(num))
    return {
        "pairs": num, "odd": [one.reason for one in found.odd],
        "epipolar_rms_px": {
            "believed": {"sfmapp": rms(found.rig.cameras, pair.second_from_first, believed),
                         "OpenCV": rms(theirs, their_pose, believed)},
            "all": {"sfmapp": rms(found.rig.cameras, pair.second_from_first, every),
                    "OpenCV": rms(theirs, their_pose, every)},
        },
        "widening": found.widening,
        "baseline_mm": {"sfmapp": 1e3 * pair.baseline[0], "sigma": 1e3 * pair.baseline[1],
                        "OpenCV": 1e3 * float(np.linalg.norm(their_pose[4:]))},
        "apart_in_sigmas": (away / np.sqrt(np.diag(pair.covariance))).tolist(),
    }  # fmt: skip


def _camera_of(k: np.ndarray, d: np.ndarray) -> Camera:
    values = [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *d.ravel()[:4]]
    return Camera(CameraModel.OPENCV, 640, 480, np.array(values))


# ------------------------------------------------------------------------------------------------ without a board


def matched(folder: Path, wanted: Callable[[int, int], bool]) -> tuple[list[tuple[np.ndarray, np.ndarray, Any]], Any]:
    """Verified matches of pairs of photographs, pixels, with their fundamental matrices and homographies."""
    images = sfmapp.load_images(folder / "images")
    features = sfmapp.extract_features(images)
    pairs = [(i, j) for i in range(len(features)) for j in range(i + 1, len(features)) if wanted(i, j)]
    found = sfmapp.match_images(images, features, np.array(pairs))
    out = []
    for p in range(found.num_pairs):
        matches = found.matches_of_pair(p)
        if len(matches) >= LEAST_MATCHES:
            i, j = found.pair_image_idx[p]
            ends = (features[i].keypoints[matches[:, 0], :2], features[j].keypoints[matches[:, 1], :2])
            xy1, xy2 = (end.astype(np.float64) for end in ends)
            out.append((xy1, xy2, (found.fundamental[p], found.homography[p])))
    return out, images


def turning(folder: Path) -> dict[str, Any]:
    """Photographs that were cut from a panorama: only turns."""
    pairs, _ = matched(folder, lambda i, j: j - i == 1)
    center = np.array([320.0, 240.0])
    homographies = [h for _, _, (_, h) in pairs if np.isfinite(h).all()]
    linear = focal_from_homographies(homographies, center)
    found = refine_turning_camera(linear or 640.0, center, [(a, b) for a, b, _ in pairs])
    return {
        "set": folder.name, "method": "turns", "pairs": len(pairs), "truth_px": 520.0, "linear_px": linear,
        "focal_px": found.focal, "sigma_px": found.sigma, "told": len(pairs),
    }  # fmt: skip


def of_pairs(folder: Path) -> dict[str, Any]:
    """The shared focal length of pairs of photographs, from F alone."""
    truth = json.loads((folder / "cameras.json").read_text(encoding="utf-8"))
    focal = _focal_in(truth)
    pairs, images = matched(folder, lambda i, j: j - i <= 3)
    camera = images.cameras[0]
    center = np.array([camera.width, camera.height]) / 2.0
    found = [
        one[0] for _, _, (f, _) in pairs if np.isfinite(f).all()
        and (one := focal_from_fundamental(f, center, center, max(camera.width, camera.height))) is not None
    ]  # fmt: skip
    return {
        "set": folder.name, "method": "F", "pairs": len(pairs), "told": len(found), "truth_px": focal,
        "focal_px": float(np.median(found)) if found else None,
        "sigma_px": float(1.4826 * np.median(np.abs(np.array(found) - np.median(found)))) if found else None,
    }  # fmt: skip


def _focal_in(truth: Any) -> float:
    """The first focal length in a ground truth."""
    if isinstance(truth, dict):
        if "K" in truth:
            return float(np.array(truth["K"]).ravel()[0])
        return next(v for v in (_focal_in(one) for one in truth.values()) if v > 0)
    if isinstance(truth, list) and truth and isinstance(truth[0], dict):
        return _focal_in(truth[0])
    return 0.0


def tables(report: dict[str, Any]) -> str:
    lines = ["# Rigs, and focal lengths without a board", "", f"Measured {report['date']} at {report['commit']}.", ""]
    lines += ["| synthetic rig | trials | parameters | NEES | inside 3 sigma | shots wrongly left aside |"]
    lines += ["|---|---|---|---|---|---|"]
    lines += [
        f"| {r['rig']} | {r['trials']} | {r['parameters']} | {r['nees']:.3f} +- {r['nees_sigma']:.3f} | "
        f"{100 * r['inside_3_sigma']:.2f} % | {r['wrongly_odd']} |"
        for r in report["synthetic"]
    ]
    odd, cv = report["odd"], report["opencv"]
    lines += ["", f"Two cameras, ten shots, one swapped, in one the board moved by 1 to 5 mm, {odd['trials']} trials: "
              f"{odd['swapped']} and {odd['moved']} named rightly, {odd['others_named']} others named; the pose of the "
              f"second camera off by {odd['worst_pose_error_sigmas']:.1f} sigmas at most.", ""]  # fmt: skip
    lines += [f"OpenCV's samples, {cv['pairs']} pairs, lens model OPENCV for both:", ""]
    lines += ["| epipolar rms, px | sfmapp | cv2.stereoCalibrate |", "|---|---|---|"]
    for name, text in (("believed", "pairs that sfmapp believes"), ("all", "all pairs")):
        row = cv["epipolar_rms_px"][name]
        lines.append(f"| {text} | {row['sfmapp']:.4f} | {row['OpenCV']:.4f} |")
    baseline = cv["baseline_mm"]
    apart = ", ".join(f"{value:.1f}" for value in cv["apart_in_sigmas"])
    stated = f"{baseline['sfmapp']:.3f} +- {baseline['sigma']:.3f} mm, OpenCV's {baseline['OpenCV']:.3f}"
    wider = f"which are {cv['widening']:.2f} times those of the noise"
    lines += ["", f"Baseline {stated}. R and t are apart by {apart} stated sigmas, {wider}.", ""]
    lines += [f"- {reason}" for reason in cv["odd"]] + [""]
    lines += ["| photographs | from | pairs | that tell | focal, px | sigma | truth |", "|---|---|---|---|---|---|---|"]
    for r in report["focal"]:
        found = "-" if r["focal_px"] is None else f"{r['focal_px']:.1f} | {r['sigma_px']:.1f}"
        lines.append(f"| {r['set']} | {r['method']} | {r['pairs']} | {r['told']} | {found} | {r['truth_px']:.1f} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
