"""One run of ``densify`` for benchmarks/dense.py, told by a JSON argument; prints what it took as JSON."""

from __future__ import annotations

import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.densify import compile_kernels, densify
from sfmapp.dense.options import DenseOptions
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.formats.colmap import read_model
from sfmapp.geometry import rigid3

# Views at this angle of the rays to the middle of the scene match best; narrower ones are worth less than wider ones.
BEST_ANGLE_DEG, ANGLES_DEG = 10.0, (1.5, 60.0)
MAX_NEIGHBORS = 8


def load_scene(order: dict[str, Any]) -> DenseScene:
    """Views at the working level with neighbours by angle; no sparse points: ours has to do without."""
    model = read_model(Path(order["model"]))[0]
    views = []
    for name, camera_idx, pose in zip(model.image_names, model.image_camera_idx, model.cam_from_world, strict=True):
        if np.isnan(pose).any():
            continue
        matrix = model.cameras[camera_idx].k_matrix
        k = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
        pixels = cv2.imread(str(Path(order["images"]) / name), cv2.IMREAD_UNCHANGED)
        mask = None
        if pixels.shape[2] == 4:
            alpha = pixels[..., 3:].astype(np.float32) / 255
            pixels = (pixels[..., :3] * alpha + 255 * (1 - alpha)).round().astype(np.uint8)
            mask = alpha[..., 0] > 0.5 if order["has_masks"] else None
        height, width = pixels.shape[:2]
        size = (width >> order["level"], height >> order["level"])
        if order["level"]:
            pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
            k = k * np.tile([size[0] / width, size[1] / height], 2)
        views.append(DenseView(name, np.ascontiguousarray(pixels[..., ::-1]), mask, k, pose))
    views += views[: order["repeat_views"]]
    poses = np.array([view.cam_from_world for view in views])
    empty = np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32)
    return DenseScene(tuple(views), neighbors(rigid3.center(poses), rigid3.rotation_matrix(poses)[:, 2]), *empty)


def neighbors(centers: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.int32]:
    """(V, K) views to match with, best first, -1 behind the last: by the angle at the point nearest to all axes."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    middle = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centers))
    rays = (middle - centers) / np.linalg.norm(middle - centers, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1)))
    cost = np.where(angle < BEST_ANGLE_DEG, 1.5 * (BEST_ANGLE_DEG - angle), angle - BEST_ANGLE_DEG)
    cost[(angle < ANGLES_DEG[0]) | (angle > ANGLES_DEG[1]) | (axes @ axes.T < 0.3)] = np.inf
    best = np.argsort(cost, axis=1, kind="stable")[:, :MAX_NEIGHBORS]
    return np.where(np.isfinite(np.take_along_axis(cost, best, 1)), best, -1).astype(np.int32)


def cpu_s() -> float:
    """User and system seconds of this process so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    """Run once, warm."""
    order = json.loads(sys.argv[1])
    cv2.setNumThreads(1)
    compile_kernels()
    start, start_wall = cpu_s(), time.perf_counter()
    options = DenseOptions(level=order["level"], cell_px=order["cell_px"], max_neighbors=MAX_NEIGHBORS)
    patches, _ = densify(load_scene(order), options, threads=order["threads"])
    print(json.dumps({"cpu_s": cpu_s() - start, "wall_s": time.perf_counter() - start_wall}), flush=True)
    names = ("xyz", "normal", "rgb", "score", "sigma", "size", "view_ptr", "view_idx")
    np.savez(order["output"], **{name: getattr(patches, name) for name in names})


if __name__ == "__main__":
    main()
