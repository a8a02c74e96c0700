"""Global adjustment of a model from a perturbed start: sfmapp against pycolmap's Ceres.

Both get the same state, observations, loss, free parameters (focal length and distortion, not the principal point),
stop rule (relative decrease of the cost) and one thread, both leave the gauge free, both run warm in this process, in
turns. CPU seconds are those of the whole call, set-up included; costs come from one neutral function.

    python benchmarks/bundle_adjustment.py MODEL_FOLDER ...        COLMAP models (cameras.bin, images.bin, points3D.bin)
    python benchmarks/bundle_adjustment.py --synthetic 25 18000    images and points of a ring
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from machine import RESULTS, describe_machine
from sfmapp.adjust.options import AdjustOptions
from sfmapp.adjust.solver import adjust_bundle
from sfmapp.camera.camera import Camera, CameraModel
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.synthetic import make_scene, perturb
from sfmapp.scene.tracks import make_tracks

LOSSES = {
    "trivial": pycolmap.LossFunctionType.TRIVIAL,
    "huber": pycolmap.LossFunctionType.HUBER,
    "cauchy": pycolmap.LossFunctionType.CAUCHY,
}


def read_model(folder: Path) -> Reconstruction:
    """Poses, points and inlier observations of a COLMAP model."""
    model = pycolmap.Reconstruction(str(folder))
    cameras = sorted(model.cameras.values(), key=lambda c: c.camera_id)
    position = {c.camera_id: i for i, c in enumerate(cameras)}
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    image_position = {image.image_id: i for i, image in enumerate(images)}
    points = sorted(model.points3D.items())
    rows = [
        (t, image_position[e.image_id], e.point2D_idx, *model.images[e.image_id].points2D[e.point2D_idx].xy)
        for t, (_, point) in enumerate(points)
        for e in point.track.elements
    ]
    table = np.array(rows, np.float64).reshape(-1, 5)
    indices = table[:, :3].astype(np.int64)
    tracks = make_tracks(len(images), len(points), indices[:, 0], indices[:, 1], indices[:, 2], table[:, 3:])
    out = Reconstruction.empty(
        [Camera(CameraModel(int(c.model_id if hasattr(c, "model_id") else c.model)), c.width, c.height, c.params)
         for c in cameras],
        [image.name for image in images], np.array([position[image.camera_id] for image in images]), tracks,
    )  # fmt: skip
    for i, image in enumerate(images):
        pose = image.cam_from_world()
        out.cam_from_world[i] = np.concatenate([pose.rotation.quat, pose.translation])
    out.point_xyz[:] = np.array([point.xyz for _, point in points]).reshape(-1, 3)
    out.obs_is_inlier[:] = True
    return out


def to_pycolmap(state: Reconstruction) -> pycolmap.Reconstruction:
    """The same state for pycolmap; ids are positions plus one."""
    out = pycolmap.Reconstruction()
    for c, camera in enumerate(state.cameras):
        out.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=c + 1, model=camera.model.name, width=camera.width, height=camera.height, params=camera.params
            )
        )
    tracks = state.tracks
    place = np.empty(tracks.num_observations, np.int64)
    for i, name in enumerate(state.image_names):
        obs = tracks.observations_of_image(i)
        place[obs] = np.arange(len(obs))
        image = pycolmap.Image(
            name=name, keypoints=tracks.obs_xy[obs], camera_id=int(state.image_camera_idx[i]) + 1, image_id=i + 1
        )
        pose = state.cam_from_world[i]
        out.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:4]), pose[4:]))
    for t in range(tracks.num_tracks):
        track = pycolmap.Track()
        for o in range(tracks.track_ptr[t], tracks.track_ptr[t + 1]):
            track.add_element(int(tracks.obs_image_idx[o]) + 1, int(place[o]))
        out.add_point3D(state.point_xyz[t], track)
    return out


def from_pycolmap(model: pycolmap.Reconstruction, like: Reconstruction) -> Reconstruction:
    """A copy of ``like`` with the state of a model made by :func:`to_pycolmap`."""
    out = like.copy()
    for c, camera in enumerate(out.cameras):
        out.cameras[c] = camera.with_params(model.cameras[c + 1].params)
    for i in range(len(out.image_names)):
        pose = model.images[i + 1].cam_from_world()
        out.cam_from_world[i] = np.concatenate([pose.rotation.quat, pose.translation])
    out.point_xyz[:] = np.array([model.points3D[t + 1].xyz for t in range(out.tracks.num_tracks)])
    return out


def neutral_cost(state: Reconstruction, loss: str, scale_px: float) -> float:
    """Half the sum of rho over all observations, in numpy, from the state alone."""
    s = (state.residuals_px() ** 2).sum(1)
    a2 = scale_px**2
    if loss == "huber":
        s = np.where(s <= a2, s, 2 * np.sqrt(s * a2) - a2)
    elif loss == "cauchy":
        s = a2 * np.log1p(s / a2)
    return float(0.5 * s.sum())


def run_ceres(start: Reconstruction, loss: str, scale_px: float, tolerance: float) -> tuple[dict, Reconstruction]:
    model = to_pycolmap(start)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type, options.ceres.loss_function_scale = LOSSES[loss], scale_px
    solver = options.ceres.solver_options
    solver.num_threads, solver.function_tolerance, solver.max_num_iterations = 1, tolerance, 100
    solver.gradient_tolerance = solver.parameter_tolerance = 0.0
    config = pycolmap.BundleAdjustmentConfig()
    for i in range(len(start.image_names)):
        config.add_image(i + 1)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.UNSPECIFIED)
    cpu, wall = time.process_time(), time.perf_counter()
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    summary = adjuster.solve()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    iterations = getattr(summary, "num_iterations", None)
    ceres = getattr(summary, "ceres_summary", None)
    if iterations is None and ceres is not None:
        iterations = ceres.num_successful_steps + ceres.num_unsuccessful_steps
    return {"cpu_s": cpu, "wall_s": wall, "iterations": iterations}, from_pycolmap(model, start)


def run_sfmapp(start: Reconstruction, loss: str, scale_px: float, tolerance: float) -> tuple[dict, Reconstruction]:
    state = start.copy()
    options = AdjustOptions(
        loss=loss,
        loss_scale_px=scale_px,
        relative_cost_tolerance=tolerance,
        max_iterations=100,  # type: ignore[arg-type]
    )
    cpu, wall = time.process_time(), time.perf_counter()
    report = adjust_bundle(state, options)
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return {"cpu_s": cpu, "wall_s": wall, "iterations": report.num_iterations}, state


def compare(name: str, ground_truth: Reconstruction, args: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of the table for one model: every loss, medians over the repeats, solvers taking turns."""
    start = perturb(
        ground_truth,
        rotation_deg=0.1,
        translation_fraction=0.003,
        point_fraction=0.003,
        focal_fraction=0.02,
        seed=args.seed,
    )
    rows = []
    for loss in args.loss:
        run_sfmapp(start, loss, args.scale_px, args.tolerance)  # loads the compiled kernels
        samples: dict[str, list[dict]] = {"ceres": [], "sfmapp": []}
        cost = {}
        for _ in range(args.repeats):
            for solver, run in (("ceres", run_ceres), ("sfmapp", run_sfmapp)):
                sample, state = run(start, loss, args.scale_px, args.tolerance)
                samples[solver].append(sample)
                cost[solver] = neutral_cost(state, loss, args.scale_px)
        row: dict[str, Any] = {
            "model": name, "images": len(ground_truth.image_names),
            "observations": ground_truth.tracks.num_observations,
            "loss": loss, "start": neutral_cost(start, loss, args.scale_px),
        }  # fmt: skip
        for solver in samples:
            row[solver] = {
                "cpu_s": float(np.median([s["cpu_s"] for s in samples[solver]])),
                "wall_s": float(np.median([s["wall_s"] for s in samples[solver]])),
                "iterations": samples[solver][0]["iterations"],
                "cost": cost[solver],
            }
        row["ratio"] = row["ceres"]["cpu_s"] / row["sfmapp"]["cpu_s"]
        rows.append(row)
        print_row(row)
    return rows


def print_row(row: dict[str, Any]) -> None:
    print(f"{row['model'][:24]:24} {row['images']:5d} {row['observations']:8d} {row['loss']:8}", end="")
    for solver in ("ceres", "sfmapp"):
        r = row[solver]
        print(f" | {r['cpu_s']:8.3f} s {r['iterations'] or 0!s:>3} its  {r['cost']:13.4f}", end="")
    print(f" | {row['ratio']:5.1f}x  cost {row['sfmapp']['cost'] / row['ceres']['cost'] - 1:+.1e}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", type=Path, help="folders of COLMAP models")
    parser.add_argument("--synthetic", nargs=2, type=int, metavar=("IMAGES", "POINTS"), action="append", default=[])
    parser.add_argument("--layout", default="ring", choices=("ring", "grid", "forward"))
    parser.add_argument("--loss", nargs="+", default=["trivial"], choices=tuple(LOSSES))
    parser.add_argument("--scale-px", type=float, default=1.0, help="scale of the robust losses")
    parser.add_argument("--tolerance", type=float, default=1e-6, help="relative decrease of the cost that stops both")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "bundle_adjustment.json")
    args = parser.parse_args()
    print(
        f"{'model':24} {'imgs':>5} {'obs':>8} {'loss':8} | {'Ceres, one thread':>36} | {'sfmapp, one thread':>36} | CPU"
    )
    rows: list[dict[str, Any]] = []
    for folder in args.models:
        rows += compare("/".join(folder.resolve().parts[-2:]), read_model(folder), args)
    for images, points in args.synthetic:
        scene = make_scene(args.seed, images, points, layout=args.layout, outlier_ratio=0.0)
        rows += compare(f"synthetic {args.layout}", scene.observed, args)
    if rows:
        print(f"geometric mean of the ratios: {math.exp(np.mean([math.log(r['ratio']) for r in rows])):.1f}x")
    args.output.write_text(json.dumps(describe_machine() | {"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
