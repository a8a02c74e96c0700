"""Robust estimators of two views and of poses against OpenCV's USAC, pycolmap and PoseLib, on the same matches.

    SFMAPP_DATA=... python benchmarks/two_views.py      # writes results/two_views.json and results/two_views.md

Photographs: neighbouring pairs of fountain-P11, herz-jesus-P8 and lund-door, with the matches of sfmapp (ratio test,
both ways) without the lens' distortion; graf 1 to 3 for H. The truth is that of the sets: lund's is a reconstruction of
COLMAP's. An F or E is judged where it matters: matches that agree with the truth to 3 px are moved onto it, and the
estimate's Sampson distance of these exact points is the error. CPU time is of the whole process, on synthetic matches
of which half are wrong. All are given one threshold; the programs' other settings are their own.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import poselib
import pycolmap

import sfmapp
from machine import RESULTS, describe_machine
from sfmapp.adjust.linear import one_blas_thread
from sfmapp.camera.camera import Camera, pixels_to_normalized, simple_camera
from sfmapp.camera.names import CameraModel
from sfmapp.events import Events
from sfmapp.features.extract import FeatureOptions, extract_features
from sfmapp.geometry import epipolar, rigid3
from sfmapp.geometry.fundamental import refine_fundamental
from sfmapp.geometry.fundamental_refinement import polish_fundamental
from sfmapp.geometry.homography import guided_homography
from sfmapp.geometry.two_rays import move_to_meet
from sfmapp.images.folder import load_images
from sfmapp.images.image_set import ImageOptions
from sfmapp.matching.descriptors import match_sift
from sfmapp.matching.options import MatchingOptions
from sfmapp.matching.search import Ransac, find_fundamental, find_homography, find_relative_pose
from sfmapp.matching.two_view import verify_pair

SETS = ("fountain-P11", "herz-jesus-P8", "lund-door")
THRESHOLD_PX = 2.0
# medians of forty scenes differ by 5 per cent from forty to forty
NUM_SCENES, NUM_MATCHES, NOISE_PX, FOCAL = 100, 1000, 0.7, 900.0
# none of those that anything was chosen on
FIRST_SEED = 1000
Array = np.ndarray
Pair = tuple[Array, Array, Camera, Camera]


# ---------------------------------------------------------------------------------------------------- the programs


def ransac(seed: int = 0) -> Ransac:
    return Ransac(MatchingOptions().max_ransac_trials, seed)


def our_f(xy1: Array, xy2: Array, *_: Camera) -> Array | None:
    """As the main path has it."""
    found = find_fundamental(xy1, xy2, THRESHOLD_PX, ransac())
    return None if found is None else polish_fundamental(found, xy1, xy2, THRESHOLD_PX)[0]


def our_refined_f(xy1: Array, xy2: Array, *_: Camera) -> Array | None:
    f = our_f(xy1, xy2)
    if f is None:
        return None
    inlier = epipolar.sampson_errors(f, xy1, xy2) < THRESHOLD_PX**2
    return refine_fundamental(f, xy1[inlier], xy2[inlier], is_robust=True, max_iterations=10)[0]


def our_pose(xy1: Array, xy2: Array, camera1: Camera, camera2: Camera) -> Array | None:
    a, b = (pixels_to_normalized(camera, xy) for camera, xy in ((camera1, xy1), (camera2, xy2)))
    return find_relative_pose(a, b, THRESHOLD_PX * 2.0 / (camera1.focal + camera2.focal), ransac())


def our_verified(xy1: Array, xy2: Array, camera1: Camera, camera2: Camera) -> Array | None:
    """The main path's verification, which looks for F, H and E, and says what kind of pair it is."""
    options = MatchingOptions(max_error_px=THRESHOLD_PX)
    pose = verify_pair(xy1, xy2, camera1, camera2, options, ransac()).cam2_from_cam1
    return pose if np.isfinite(pose).all() else None


def our_h(xy1: Array, xy2: Array, *_: Camera) -> Array | None:
    """As the main path has it: OpenCV's search."""
    return find_homography(xy1, xy2, THRESHOLD_PX, ransac())


def our_refined_h(xy1: Array, xy2: Array, *_: Camera) -> Array | None:
    found = our_h(xy1, xy2)
    if found is None:
        return None
    # the noise of both pictures is left in one: half as much again
    return guided_homography(found, xy1, xy2, 1.5 * THRESHOLD_PX)[0]


def opencv_f(xy1: Array, xy2: Array, *_: Camera) -> Array | None:
    return cv2.findFundamentalMat(xy1, xy2, cv2.USAC_MAGSAC, THRESHOLD_PX, 0.999, 5000)[0]


def opencv_pose(xy1: Array, xy2: Array, camera1: Camera, camera2: Camera) -> Array | None:
    a, b = (pixels_to_normalized(camera, xy) for camera, xy in ((camera1, xy1), (camera2, xy2)))
    scale = THRESHOLD_PX * 2.0 / (camera1.focal + camera2.focal)
    e, mask = cv2.findEssentialMat(a, b, np.eye(3), cv2.USAC_MAGSAC, 0.999, scale, 5000)
    if e is None or e.shape != (3, 3):
        return None
    _, rotation, t, _ = cv2.recoverPose(e, a, b, np.eye(3), mask=mask)
    return rigid3.from_matrix(rotation, t[:, 0])


def opencv_h(xy1: Array, xy2: Array, *_: Camera) -> Array | None:
    return cv2.findHomography(xy1, xy2, cv2.USAC_MAGSAC, THRESHOLD_PX, maxIters=5000, confidence=0.999)[0]


def colmap_options() -> Any:
    options = pycolmap.RANSACOptions()
    options.max_error, options.confidence, options.max_num_trials = THRESHOLD_PX, 0.999, 5000
    return options


def colmap_camera(camera: Camera) -> Any:
    fx, fy, cx, cy = camera.canonical[:4]
    return pycolmap.Camera(model="PINHOLE", width=camera.width, height=camera.height, params=[fx, fy, cx, cy])


def pycolmap_f(xy1: Array, xy2: Array, *_: Camera) -> Array | None:
    found = pycolmap.estimate_fundamental_matrix(xy1, xy2, colmap_options())
    return None if found is None else found["F"]


def pycolmap_pose(xy1: Array, xy2: Array, camera1: Camera, camera2: Camera) -> Array | None:
    found = pycolmap.estimate_essential_matrix(
        xy1, xy2, colmap_camera(camera1), colmap_camera(camera2), colmap_options()
    )
    if found is None:
        return None
    pose = found["cam2_from_cam1"]
    return np.concatenate([pose.rotation.quat, pose.translation])


def pycolmap_h(xy1: Array, xy2: Array, *_: Camera) -> Array | None:
    found = pycolmap.estimate_homography_matrix(xy1, xy2, colmap_options())
    return None if found is None else found["H"]


POSELIB = {"max_epipolar_error": THRESHOLD_PX, "max_reproj_error": THRESHOLD_PX, "success_prob": 0.999,
           "max_iterations": 5000}  # fmt: skip


def poselib_camera(camera: Camera) -> dict[str, Any]:
    return {"model": "PINHOLE", "width": camera.width, "height": camera.height,
            "params": camera.canonical[:4].tolist()}  # fmt: skip


def poselib_pose_of(pose: Any) -> Array:
    return rigid3.from_matrix(np.asarray(pose.R), np.asarray(pose.t))


def poselib_f(xy1: Array, xy2: Array, *_: Camera) -> Array | None:
    return poselib.estimate_fundamental(xy1, xy2, POSELIB, {})[0]


def poselib_pose(xy1: Array, xy2: Array, camera1: Camera, camera2: Camera) -> Array | None:
    found, _ = poselib.estimate_relative_pose(xy1, xy2, poselib_camera(camera1), poselib_camera(camera2), POSELIB, {})
    return poselib_pose_of(found)


def poselib_h(xy1: Array, xy2: Array, *_: Camera) -> Array | None:
    return poselib.estimate_homography(xy1, xy2, POSELIB, {})[0]


F = {"sfmapp": our_f, "sfmapp, refined": our_refined_f, "OpenCV": opencv_f, "pycolmap": pycolmap_f,
     "PoseLib": poselib_f}  # fmt: skip
E = {
    "sfmapp": our_pose,
    "sfmapp, F E H": our_verified,
    "OpenCV": opencv_pose,
    "pycolmap": pycolmap_pose,
    "PoseLib": poselib_pose,
}
H = {
    "sfmapp": our_h,
    "sfmapp, refined": our_refined_h,
    "OpenCV": opencv_h,
    "pycolmap": pycolmap_h,
    "PoseLib": poselib_h,
}


def our_absolute(xyz: Array, xy: Array, camera: Camera) -> Array | None:
    found = sfmapp.estimate_pose(xyz, xy, camera, max_error_px=2.0 * THRESHOLD_PX, inlier_px=THRESHOLD_PX)
    pose = found.cam_from_world
    return rigid3.from_matrix(pose.rotation, pose.translation)


def opencv_absolute(xyz: Array, xy: Array, camera: Camera) -> Array | None:
    params = cv2.UsacParams()
    params.score, params.threshold, params.confidence = cv2.SCORE_METHOD_MAGSAC, THRESHOLD_PX, 0.999
    params.maxIterations, params.loMethod = 5000, cv2.LOCAL_OPTIM_SIGMA
    found = cv2.solvePnPRansac(xyz, xy, camera.k_matrix, np.zeros(4), params=params)
    return rigid3.from_matrix(cv2.Rodrigues(found[2])[0], found[3][:, 0]) if found[0] else None


def pycolmap_absolute(xyz: Array, xy: Array, camera: Camera) -> Array | None:
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac = colmap_options()
    found = pycolmap.estimate_and_refine_absolute_pose(xy, xyz, colmap_camera(camera), options)
    if found is None:
        return None
    pose = found["cam_from_world"]
    return np.concatenate([pose.rotation.quat, pose.translation])


def poselib_absolute(xyz: Array, xy: Array, camera: Camera) -> Array | None:
    return poselib_pose_of(poselib.estimate_absolute_pose(xy, xyz, poselib_camera(camera), POSELIB, {})[0])


PNP = {"sfmapp": our_absolute, "OpenCV": opencv_absolute, "pycolmap": pycolmap_absolute, "PoseLib": poselib_absolute}


# ------------------------------------------------------------------------------------------------ photographs


def sets(root: Path) -> Iterator[tuple[str, str, Pair, Array]]:
    """Name of the set, names of the pair, its matches and cameras without distortion, and the true pose."""
    for name in SETS:
        document = json.loads((root / name / "cameras.json").read_text(encoding="utf-8"))
        folder = root / name / "images"
        image_set, _ = load_images(folder, ImageOptions(), Events(), threads=2)
        features, _ = extract_features(image_set, FeatureOptions(), threads=2, events=Events())
        by_file = {Path(entry["file"]).name: entry for entry in document["cameras"]}
        entries = [by_file[record.name] for record in image_set.images]
        views = [_view(entry, record, found.keypoints[:, :2].astype(np.float64))
                 for entry, record, found in zip(entries, image_set.images, features, strict=True)]  # fmt: skip
        for i in range(len(views)):
            for j in range(i + 1, min(i + 3, len(views))):
                m = match_sift(features[i].descriptors, features[j].descriptors, 0.8, 0.7)
                pose = rigid3.compose(views[j][2], rigid3.inverse(views[i][2]))
                pose[4:] /= np.linalg.norm(pose[4:])
                xy1, xy2 = np.ascontiguousarray(views[i][1][m[:, 0]]), np.ascontiguousarray(views[j][1][m[:, 1]])
                names = f"{image_set.images[i].name}, {image_set.images[j].name}"
                yield name, names, (xy1, xy2, views[i][0], views[j][0]), pose


def _view(entry: dict[str, Any], record: Any, xy: Array) -> tuple[Camera, Array, Array]:
    """A pinhole, its pixels without distortion, and cam_from_world."""
    k = np.array(entry["K"])
    # theirs has pixel centres at whole numbers
    fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5
    pinhole = Camera(CameraModel.PINHOLE, record.width, record.height, np.array([fx, fy, cx, cy]), 1.0, "user")
    k1, k2 = (entry["dist"] or [0.0, 0.0])[:2]
    lens = Camera(CameraModel.OPENCV, record.width, record.height, np.array([fx, fy, cx, cy, k1, k2, 0.0, 0.0]))
    straight = pixels_to_normalized(lens, xy) * [fx, fy] + [cx, cy]
    return pinhole, straight, rigid3.from_matrix(np.array(entry["R_w2c"]), np.array(entry["t_w2c"]))


def photographs(root: Path) -> list[dict[str, Any]]:
    rows = []
    for name, names, (xy1, xy2, camera1, camera2), pose in sets(root):
        truth = epipolar.fundamental_from_essential(
            epipolar.essential_from_pose(pose), camera1.k_matrix, camera2.k_matrix
        )
        right = epipolar.sampson_errors(truth, xy1, xy2) < 9.0
        if right.sum() < 30:
            continue
        exact = move_to_meet(truth, xy1[right], xy2[right])
        row: dict[str, Any] = {"set": name, "pair": names, "num_matches": len(xy1), "num_right": int(right.sum())}
        for program, estimate in F.items():
            f = estimate(xy1, xy2, camera1, camera2)
            row[f"F {program}"] = _rms(f, exact)
        for program, estimate in E.items():
            found = estimate(xy1, xy2, camera1, camera2)
            f = None if found is None else epipolar.fundamental_from_essential(
                epipolar.essential_from_pose(found), camera1.k_matrix, camera2.k_matrix)  # fmt: skip
            row[f"E {program}"] = _rms(f, exact)
            row[f"R {program}"], row[f"t {program}"] = (180.0, 180.0) if found is None else _pose_errors(found, pose)
        rows.append(row)
    return rows


def _rms(f: Array | None, exact: tuple[Array, Array]) -> float:
    """Pixels, no more than 20: a failure is a failure."""
    if f is None or f.shape != (3, 3) or not np.isfinite(f).all():
        return 20.0
    return float(min(np.sqrt(np.minimum(epipolar.sampson_errors(f, *exact), 400.0).mean()), 20.0))


def _pose_errors(found: Array, pose: Array) -> tuple[float, float]:
    """Degrees of rotation, and between the directions of the baselines."""
    turn = rigid3.rotation_angle_deg(rigid3.rotation_matrix(found) @ rigid3.rotation_matrix(pose).T)
    t = found[4:] / max(float(np.linalg.norm(found[4:])), 1e-300)
    return float(turn), float(np.degrees(np.arccos(np.clip(t @ pose[4:] / np.linalg.norm(pose[4:]), -1, 1))))


def graf(root: Path) -> dict[str, float]:
    """Mean distance in pixels between where an estimate and the truth put a grid of graf 1."""
    folder = root / "opencv-doc-samples" / "homography"
    storage = cv2.FileStorage(str(folder / "H1to3p.xml"), cv2.FILE_STORAGE_READ)
    truth = storage.getNode("H13").mat()
    image_set, _ = load_images([str(folder / name) for name in ("graf1.png", "graf3.png")], ImageOptions(), Events())
    features, _ = extract_features(image_set, FeatureOptions(), threads=2, events=Events())
    m = match_sift(features[0].descriptors, features[1].descriptors, 0.8, 0.7)
    # theirs has pixel centres at whole numbers
    xy1, xy2 = (np.ascontiguousarray(f.keypoints[m[:, s], :2].astype(np.float64)) - 0.5 for s, f in enumerate(features))
    grid = np.stack(np.meshgrid(np.arange(40, 800, 40), np.arange(40, 640, 40)), -1).reshape(-1, 2).astype(np.float64)
    wanted = _mapped(truth, grid)
    seen = ((wanted > 0) & (wanted < [800, 640])).all(1)
    out = {"num_matches": float(len(m))}
    out["num_right"] = float((np.linalg.norm(_mapped(truth, xy1) - xy2, axis=1) < 3.0).sum())
    for program, estimate in H.items():
        h = estimate(xy1, xy2)
        out[program] = float(np.linalg.norm(_mapped(h, grid[seen]) - wanted[seen], axis=1).mean())
    return out


def _mapped(h: Array, xy: Array) -> Array:
    mapped = np.column_stack([xy, np.ones(len(xy))]) @ h.T
    return mapped[:, :2] / mapped[:, 2:]


# -------------------------------------------------------------------------------------------------- CPU time


def scenes() -> Iterator[tuple[Array, Array, Array, Array, Array, Camera, Array]]:
    """Points in space, pixels of both views with half of the matches wrong, the exact ones, camera, pose."""
    camera = simple_camera(CameraModel.PINHOLE, 1200, 900, FOCAL, 1.0, "user")
    for seed in range(FIRST_SEED, FIRST_SEED + NUM_SCENES):
        rng = np.random.default_rng(seed)
        z = rng.uniform(4, 10, NUM_MATCHES)
        xyz = np.column_stack([rng.uniform(-0.6, 0.6, NUM_MATCHES) * z, rng.uniform(-0.45, 0.45, NUM_MATCHES) * z, z])
        pose = rigid3.from_matrix(rigid3.exp_so3(rng.normal(0, 0.08, 3)), rng.normal(0, 0.7, 3))
        exact1, exact2 = _seen(xyz), _seen(rigid3.apply(pose, xyz))
        xy1, xy2 = (x + rng.normal(0, NOISE_PX, x.shape) for x in (exact1, exact2))
        wrong = rng.permutation(NUM_MATCHES) < NUM_MATCHES // 2
        xy2[wrong] = rng.uniform([0, 0], [1200, 900], (int(wrong.sum()), 2))
        yield xyz, xy1, xy2, np.column_stack([exact1, exact2])[~wrong], wrong, camera, pose


def _seen(xyz: Array) -> Array:
    return FOCAL * xyz[:, :2] / xyz[:, 2:] + [600.0, 450.0]


def planes() -> Iterator[tuple[Array, Array, Array]]:
    """Pixels of both views of a plane with half of the matches wrong, and H."""
    for seed in range(FIRST_SEED, FIRST_SEED + NUM_SCENES):
        rng = np.random.default_rng([1, seed])
        h = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]) + rng.normal(0, 1, (3, 3)) * [
            [0.1, 0.1, 30], [0.1, 0.1, 30], [1e-4, 1e-4, 0]]  # fmt: skip
        xy1 = rng.uniform([0, 0], [1200, 900], (NUM_MATCHES, 2))
        xy2 = _mapped(h, xy1) + rng.normal(0, NOISE_PX, xy1.shape)
        wrong = rng.permutation(NUM_MATCHES) < NUM_MATCHES // 2
        xy2[wrong] = rng.uniform([0, 0], [1200, 900], (int(wrong.sum()), 2))
        yield xy1 + rng.normal(0, NOISE_PX, xy1.shape), xy2, h


def speed() -> list[dict[str, Any]]:
    """CPU milliseconds a call and median errors, every program on the same scenes, taking turns."""
    rows = []
    every, flat = list(scenes()), list(planes())
    grid = np.stack(np.meshgrid(np.linspace(0, 1200, 9), np.linspace(0, 900, 7)), -1).reshape(-1, 2)
    tasks: list[tuple[str, str, dict[str, Callable[..., Any]], Callable[[Any, Callable[..., Any]], float], list[Any]]]
    tasks = [
        ("F", "px", F, lambda s, run: _rms(run(s[1], s[2], s[5], s[5]), (s[3][:, :2], s[3][:, 2:])), every),
        ("E", "deg", E, lambda s, run: max(_pose_errors(run(s[1], s[2], s[5], s[5]), s[6])), every),
        ("H", "px", H, lambda s, run: float(np.linalg.norm(_mapped(run(s[0], s[1]), grid) - _mapped(s[2], grid),
                                                           axis=1).mean()), flat),
        ("PnP", "deg", PNP, lambda s, run: float(rigid3.rotation_angle_deg(
            rigid3.rotation_matrix(run(s[0], s[2], s[5])) @ rigid3.rotation_matrix(s[6]).T)), every),
    ]  # fmt: skip
    for what, unit, programs, judge, cases in tasks:
        errors: dict[str, list[float]] = {name: [] for name in programs}
        spent = dict.fromkeys(programs, 0.0)
        for run in programs.values():  # kernels and libraries are loaded
            judge(cases[0], run)
        for case in cases:
            for name, run in programs.items():
                start = time.process_time()
                error = judge(case, run)
                spent[name] += time.process_time() - start
                errors[name].append(error)
        for name in programs:
            rows.append(
                {
                    "what": what,
                    "unit": unit,
                    "program": name,
                    "cpu_ms": 1e3 * spent[name] / len(cases),
                    "median_error": float(np.median(errors[name])),
                    "typical_error": float(np.exp(np.mean(np.log(errors[name])))),
                    "worst_error": float(np.max(errors[name])),
                }
            )
    return rows  # fmt: skip


# ----------------------------------------------------------------------------------------------------- results


def medians(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Of each set, by column."""
    columns = [name for name in rows[0] if name[1] == " "]
    return {
        name: {column: float(np.median([row[column] for row in rows if row["set"] == name])) for column in columns}
        for name in dict.fromkeys(row["set"] for row in rows)
    }


def write(report: dict[str, Any]) -> None:
    RESULTS.joinpath("two_views.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    lines = ["# Two views", "", f"{report['date'][:10]}, {report['commit']}", ""]
    lines += [
        "Median errors over neighbouring pairs: Sampson distance (px) of exact points, degrees of rotation and of the",
        f"direction of the baseline. {len(report['pairs'])} pairs.", "",
    ]  # fmt: skip
    for title, programs, letters in (("F", F, "F"), ("E", E, "ERt")):
        lines += [f"## {title}", "", "| set | " + " | ".join(programs) + " |", "|---" * (len(programs) + 1) + "|"]
        for name, row in report["medians"].items():
            cells = [" / ".join(f"{row[f'{letter} {program}']:.3f}" for letter in letters) for program in programs]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        lines.append("")
    found = report["graf"]
    distances = ", ".join(f"{program} {found[program]:.2f}" for program in H)
    lines += [
        "## H, graf 1 to 3", "",
        f"{found['num_right']:.0f} of {found['num_matches']:.0f} matches are on the true plane. Mean distance from the",
        f"truth over what both pictures see, px: {distances}", "",
        f"## CPU time, {NUM_MATCHES} matches, half of them wrong, {NUM_SCENES} scenes", "",
        "Typical: the geometric mean.", "",
        "| | program | CPU ms | median error | typical error | worst error |", "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in report["speed"]:
        cells = (row["what"], row["program"], f"{row['cpu_ms']:.2f}", f"{row['median_error']:.4f} {row['unit']}",
                 f"{row['typical_error']:.4f}", f"{row['worst_error']:.3f}")  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    RESULTS.joinpath("two_views.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    cv2.setNumThreads(1)
    with one_blas_thread():
        measure()


def measure() -> None:
    """Everything, into the results."""
    root = Path(os.environ["SFMAPP_DATA"])
    pairs = photographs(root)
    report = {**describe_machine(),
              "pairs": pairs, "medians": medians(pairs), "graf": graf(root), "speed": speed()}  # fmt: skip
    write(report)


if __name__ == "__main__":
    main()
