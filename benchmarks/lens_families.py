"""Every family of lenses through the whole command line: rendered photographs, cameras, patches, undistorted pictures.

    python benchmarks/lens_families.py                    # all of them; photographs are kept in out/lens_families
    python benchmarks/lens_families.py --only FOV EUCM    # lenses of these models

Eight to twelve views of a rendered room through each lens, whose calibration is given a little off: see
benchmarks/README.md.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from machine import RESULTS, ROOT, describe_machine
from rendered_worlds.all_round import AllRoundRenderer
from rendered_worlds.rendering import Optics, Renderer, World
from rendered_worlds.worlds import gallery_world
from sfmapp.camera.camera import Camera, pixels_to_rays
from sfmapp.camera.models import PARAM_NAMES, kind_of
from sfmapp.camera.names import CameraModel
from sfmapp.evaluation.measured import run_measured
from sfmapp.evaluation.poses import evaluate_poses
from sfmapp.formats.colmap import has_model, read_model
from sfmapp.formats.ply_reader import read_ply_geometry
from sfmapp.geometry import rigid3, similarity
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.undistortion import has_distortion

Array = NDArray[np.float64]
Way = Literal["at a corner", "round about"]

NUM_VIEWS: dict[Way, int] = {"at a corner": 8, "round about": 12}
SEED = 3
# the given calibration: focal lengths this much too long, distortion this much too weak
FOCAL_OFF, DISTORTION_OFF = 1.004, 0.97
# a pixel's grid on which two lenses are compared, and the corners that are followed from one picture to the other
GRID, CORNERS = 24, 600


@dataclass(frozen=True)
class Lens:
    """A lens and how its photographs are taken.

    Attributes:
        name: of the model, with what tells it from another of the same model.
        camera: what the photographs are rendered with.
        way: a corner of the room from an arc before it, or from places all over the room, looking anywhere.
    """

    name: str
    camera: Camera
    way: Way = "at a corner"


def _lens(
    model: str, params: list[float], size: tuple[int, int] = (640, 480), way: Way = "at a corner", note: str = ""
) -> Lens:
    return Lens(model + note, Camera(CameraModel[model], *size, np.array(params)), way)


_F, _C = [430.0, 433.0], [326.0, 236.0]
_BROWN = [-0.15, 0.04, 1e-3, -8e-4]
_RATIONAL = [-0.12, 0.03, 1e-3, -8e-4, -0.004, 0.05, 0.01, 0.002]
LENSES = (
    _lens("SIMPLE_PINHOLE", [_F[0], *_C]),
    _lens("PINHOLE", [*_F, *_C]),
    _lens("PINHOLE_SKEW", [*_F, *_C, 6.0]),
    _lens("SIMPLE_RADIAL", [_F[0], *_C, -0.10]),
    _lens("RADIAL", [_F[0], *_C, -0.12, 0.03]),
    _lens("OPENCV", [*_F, *_C, *_BROWN]),
    _lens("FULL_OPENCV", [*_F, *_C, *_RATIONAL]),
    _lens("OPENCV_THIN_PRISM", [*_F, *_C, *_RATIONAL, 2e-3, -3e-4, -2e-3, 4e-4]),
    _lens("SIMPLE_DIVISION", [_F[0], *_C, -0.15]),
    _lens("DIVISION", [*_F, *_C, -0.20]),
    _lens("FOV", [360.0, 362.0, *_C, 0.9]),
    _lens("SIMPLE_FISHEYE", [300.0, *_C]),
    _lens("FISHEYE", [300.0, 302.0, *_C]),
    _lens("SIMPLE_RADIAL_FISHEYE", [300.0, *_C, -0.03]),
    _lens("RADIAL_FISHEYE", [300.0, *_C, -0.03, 0.004]),
    _lens("OPENCV_FISHEYE", [300.0, 302.0, *_C, -0.03, 0.006, -0.002, 0.0003]),
    _lens("THIN_PRISM_FISHEYE", [300.0, 302.0, *_C, -0.03, 0.006, 8e-4, -6e-4, -0.002, 0.0003, 1e-3, -8e-4]),
    _lens(
        "RAD_TAN_THIN_PRISM_FISHEYE",
        [300.0, 302.0, *_C, -0.03, 0.006, -0.002, 0.0003, 0, 0, 8e-4, -6e-4, 1e-3, -2e-4, -8e-4, 1e-4],
    ),
    _lens("EUCM", [300.0, 302.0, *_C, 0.6, 1.1]),
    # wider than the half space in front of them
    _lens("OPENCV_FISHEYE", [150.0, 151.0, 322.0, 318.0, -0.01, 0.002, 0.0, 0.0], (640, 640), "round about", ", 240°"),
    _lens("EUCM", [150.0, 151.0, 322.0, 318.0, 0.62, 1.0], (640, 640), "round about", ", 220°"),
    _lens("EQUIRECTANGULAR", [1024.0, 512.0], (1024, 512), "round about"),
)


# ------------------------------------------------------------------------------------------------ photographs and truth


def looking(center: ArrayLike, target: ArrayLike) -> Array:
    """A level pose (7,) at a place, looking at another."""
    center = np.asarray(center, np.float64)
    ahead = np.asarray(target, np.float64) - center
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    return rigid3.from_matrix(rotation, -rotation @ center)


def poses_of(way: Way) -> Array:
    """(V, 7) true poses."""
    count = NUM_VIEWS[way]
    if way == "at a corner":
        target = np.array([-1.7, 2.0, 1.2])
        turns = np.radians(np.linspace(-75.0, -15.0, count))
        heights = [0.25 * (-1) ** k for k in range(count)]
        return np.stack([
            looking(target + np.array([2.8 * np.cos(turn), 2.8 * np.sin(turn), height]), target)
            for turn, height in zip(turns, heights, strict=True)
        ])  # fmt: skip
    rng = np.random.default_rng(0xA11)
    turns = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    centers = np.stack([0.9 * np.cos(turns), 1.3 * np.sin(turns), rng.uniform(1.2, 1.7, count)], 1)
    # along the way and to its sides, up and down
    headings = turns + rng.uniform(-1.2, 1.2, count)
    rises = rng.uniform(-0.5, 0.5, count)
    return np.stack([
        looking(center, center + np.array([-np.sin(heading), np.cos(heading), rise]))
        for center, heading, rise in zip(centers, headings, rises, strict=True)
    ])  # fmt: skip


def write_photographs(lens: Lens, folder: Path, world: World) -> float:
    """Render what is not there yet; the median distance of what is seen, in metres."""
    folder.mkdir(parents=True, exist_ok=True)
    renderer = AllRoundRenderer(world, lens.camera)
    poses = poses_of(lens.way)
    for k, pose in enumerate(poses):
        path = folder / f"{k:03d}.png"
        if not path.exists():
            cv2.imwrite(str(path), renderer.photograph(pose, Optics(), [SEED, k]))
    note = folder.parent / "distance.json"
    if not note.exists():
        distance = renderer.view(poses[0])[1]
        note.write_text(json.dumps(float(np.median(distance[np.isfinite(distance)]))))
    return float(json.loads(note.read_text()))


def given(camera: Camera) -> Camera:
    """The calibration as the user has it: a little off in all but the principal point and the size."""
    off = {"focal": FOCAL_OFF, "distortion": DISTORTION_OFF}
    factors = np.array([off.get(kind_of(name), 1.0) for name in PARAM_NAMES[camera.model]])
    return camera.with_params(camera.params * factors)


# ----------------------------------------------------------------------------------------------------------- measuring


def lens_error_px(found: Camera, true: Camera) -> float:
    """Largest distance, over the picture, between what two lenses see, after the turn that brings them closest."""
    x, y = np.meshgrid(*((np.arange(GRID) + 0.5) / GRID * side for side in (true.width, true.height)))
    xy = np.stack([x.ravel(), y.ravel()], 1)
    a, b = pixels_to_rays(found, xy), pixels_to_rays(true, xy)
    valid = np.isfinite(a).all(1) & np.isfinite(b).all(1)
    a, b = a[valid], b[valid]
    u, _, vt = np.linalg.svd(b.T @ a)
    turned = a @ (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T
    return float(true.focal * np.linalg.norm(turned - b, axis=1).max())


def surface_distances(world: World, xyz: Array) -> Array:
    """(N,) distance of points to the nearest rectangle of a world."""
    best = np.full(len(xyz), np.inf)
    for origin, (right, down) in zip(world.origin, world.edges, strict=True):
        from_corner = xyz - origin
        u = np.clip(from_corner @ right / (right @ right), 0.0, 1.0)
        v = np.clip(from_corner @ down / (down @ down), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(from_corner - u[:, None] * right - v[:, None] * down, axis=1))
    return best


def cloud_errors(xyz: Array, world_from_model: Array, world: World, distance: float) -> dict[str, float]:
    """Points of a model against the true surfaces, in per cent of the distance of what is seen."""
    errors = 100.0 * surface_distances(world, similarity.apply(world_from_model, xyz)) / distance
    return {"num": len(xyz), "median_percent": float(np.median(errors)), "within_1_percent": float((errors < 1).mean())}


def straightness(pictures: Path, camera: Camera, poses: Array, world: World) -> dict[str, float]:
    """Undistorted pictures against those that the pinhole beside them takes of the world.

    Corners are followed from one to the other; what a homography, which keeps lines straight, cannot explain of their
    ways is a bend. Pixels, of the first and the middle picture.
    """
    bends: list[float] = []
    for k in (0, len(poses) // 2):
        path = pictures / f"{k:03d}.png"
        if not path.exists():
            continue
        flat = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        exact = np.clip(Renderer(world, camera).view(poses[k]).grey, 0, 255).astype(np.uint8)
        corners = cv2.goodFeaturesToTrack(exact, CORNERS, 0.02, 8)
        window = {"winSize": (15, 15), "maxLevel": 3}
        there, ok, _ = cv2.calcOpticalFlowPyrLK(exact, flat, corners, None, **window)
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(flat, exact, there, None, **window)
        kept = (ok & ok_back).ravel().astype(bool) & (np.linalg.norm((back - corners)[:, 0], axis=1) < 0.1)
        a, b = corners[kept, 0].astype(np.float64), there[kept, 0].astype(np.float64)
        plane, _ = cv2.findHomography(a, b, cv2.RANSAC, 1.0)
        moved = cv2.perspectiveTransform(a[:, None], plane)[:, 0]
        bends += np.linalg.norm(moved - b, axis=1).tolist()
    if not bends:
        return {}
    return {"num_corners": len(bends), "bend_px": float(np.quantile(bends, 0.95))}


def run(command: list[str], log: Path) -> dict[str, Any]:
    """One run of the command line, with what it cost and the end of what it said where it failed."""
    usage = run_measured([sys.executable, "-m", "sfmapp", *command, "-q"], log, env=dict(os.environ))
    values: dict[str, Any] = {"exit_code": usage.exit_code, "cpu_s": usage.cpu_s}
    if usage.exit_code:
        values["said"] = log.read_text(errors="replace").strip()[-400:]
    return values


def measure(lens: Lens, work: Path, world: World) -> dict[str, Any]:
    """All that is told about one lens."""
    folder = work / lens.name.replace(", ", "-").replace("°", "")
    distance = write_photographs(lens, folder / "images", world)
    poses, calibration = poses_of(lens.way), given(lens.camera)
    values: dict[str, Any] = {"lens": lens.name, "num_images": len(poses), "distance_m": distance}
    out, flat = folder / "out", folder / "flat"
    for old in (out, flat):
        run_measured(["rm", "-rf", str(old)], folder / "rm.log", env=dict(os.environ))
    text = ",".join(f"{value:.10g}" for value in calibration.params)
    command = ["reconstruct", str(folder / "images"), "-o", str(out), "--camera", f"{calibration.model.name},{text}"]
    values["reconstruct"] = run([*command, "--no-recording"], folder / "reconstruct.log")
    if not has_model(out / "sparse" / "0"):
        return values | {"num_registered": 0}
    model = read_model(out / "sparse" / "0")[0]
    found = model.cameras[0]
    errors = evaluate_poses(model.image_names, model.cam_from_world, [f"{k:03d}.png" for k in range(len(poses))], poses)
    values |= {
        "num_registered": int(model.is_registered.sum()),
        "num_models": sum(1 for path in (out / "sparse").iterdir() if path.is_dir()),
        "position_percent": 100.0 * float(np.sqrt(np.nanmean(errors.center_error**2))) / distance,
        "rotation_deg": float(np.nanmean(errors.rotation_error_deg)),
        "reprojection_px": median_reprojection_px(model),
        "lens_off_px": [lens_error_px(calibration, lens.camera), lens_error_px(found, lens.camera)],
        "points": cloud_errors(model.point_xyz[model.is_triangulated], errors.reference_from_estimate, world, distance),
        "behind_percent": behind_percent(model),
    }
    values["dense"] = run(["dense", str(out), "--set", "dense.level=2", "--no-recording"], folder / "dense.log")
    if values["dense"]["exit_code"] == 0:
        patches = read_ply_geometry(out / "dense" / "fused.ply").xyz
        values["patches"] = cloud_errors(patches, errors.reference_from_estimate, world, distance)
    # one picture of each photograph, which is what the straightness is measured of
    command = ["undistort", str(out), "-o", str(flat), "--front-only"]
    values["undistort"] = run(command, folder / "undistort.log")
    if values["undistort"]["exit_code"] == 0:
        values |= undistorted(flat, poses, world)
    return values


def median_reprojection_px(model: Reconstruction) -> float:
    """Over the observations."""
    return float(np.median(np.linalg.norm(model.residuals_px()[model.obs_is_inlier], axis=1)))


def behind_percent(model: Reconstruction) -> float:
    """How many observations lie behind the plane of their camera."""
    tracks, used = model.tracks, np.flatnonzero(model.obs_is_inlier)
    poses, points = model.cam_from_world[tracks.obs_image_idx[used]], model.point_xyz[tracks.obs_track_idx[used]]
    return float(100.0 * (rigid3.apply(poses, points)[:, 2] < 0).mean())


def undistorted(folder: Path, poses: Array, world: World) -> dict[str, Any]:
    """Whether pycolmap opens the folder, and how straight its pictures are."""
    import pycolmap

    theirs = pycolmap.Reconstruction(folder / "sparse" / "0")
    camera = next(iter(theirs.cameras.values()))
    flat = Camera(CameraModel.PINHOLE, camera.width, camera.height, np.array(camera.params))
    assert not has_distortion(flat)
    names = {camera.model.name for camera in theirs.cameras.values()}
    return {
        "pycolmap": {"num_images": theirs.num_reg_images(), "models": sorted(names)},
        "straight": straightness(folder / "images", flat, poses, world),
    }


# -------------------------------------------------------------------------------------------------------------- report


def rows(runs: list[dict[str, Any]]) -> Iterator[str]:
    """The table, a lens a line."""
    yield (
        "| lens | registered | position % | rotation deg | reprojection px | lens off px, given / found | points "
        "| off % | seen behind % | patches | off % | within 1 % | bend px | CPU s |"
    )
    yield "|---" * 14 + "|"
    for one in runs:
        if not one["num_registered"]:
            yield f"| {one['lens']} | 0 of {one['num_images']} |" + " - |" * 12
            continue
        off, points, patches = one["lens_off_px"], one["points"], one.get("patches")
        cells = [
            one["lens"], f"{one['num_registered']} of {one['num_images']}", f"{one['position_percent']:.3f}",
            f"{one['rotation_deg']:.3f}", f"{one['reprojection_px']:.3f}", f"{off[0]:.2f} / {off[1]:.2f}",
            str(points["num"]), f"{points['median_percent']:.2f}", f"{one['behind_percent']:.0f}",
        ]  # fmt: skip
        cells += (
            [str(patches["num"]), f"{patches['median_percent']:.2f}", f"{100 * patches['within_1_percent']:.0f}"]
            if patches
            else ["refused" if one["dense"]["exit_code"] == 3 else "none", "-", "-"]
        )
        bend = one.get("straight", {}).get("bend_px")
        cells += ["-" if bend is None else f"{bend:.2f}"]
        cells += [f"{sum(one[part]['cpu_s'] for part in ('reconstruct', 'dense', 'undistort')):.0f}"]
        yield "| " + " | ".join(cells) + " |"


def markdown(report: dict[str, Any]) -> str:
    """What is committed beside the figures."""
    head = (
        f"sfmapp {report['versions']['sfmapp']} at {report['commit']}; {report['cpu']}, {report['cores']} cores,"
        f" {report['date']}. What the columns mean is in benchmarks/README.md."
    )
    return "\n".join([head, "", *rows(report["runs"])])


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=[], metavar="MODEL", help="lenses of these models")
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "lens_families", help="folder for what is rendered")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS / "lens_families.json")
    args = parser.parse_args()
    report: dict[str, Any] = describe_machine() | {"runs": []}
    world = gallery_world(SEED)
    for lens in LENSES:
        if args.only and lens.camera.model.name not in args.only:
            continue
        report["runs"].append(measure(lens, args.work, world))
        print(list(rows(report["runs"]))[-1], flush=True)
        args.output.write_text(json.dumps(report, indent=1) + "\n")
    args.output.with_suffix(".md").write_text(markdown(report) + "\n")


if __name__ == "__main__":
    main()
