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

from sfmapp.dense.densify import compile_kernels, densify
from sfmapp.dense.options import DenseOptions
from sfmapp.dense.scene import DenseScene, DenseView
from sfmapp.dense.selection import select_neighbors
from sfmapp.formats.colmap import read_model

MAX_NEIGHBORS = 8


def load_scene(order: dict[str, Any]) -> DenseScene:
    """Views at the working level with neighbours by their cameras; no sparse points: ours has to do without."""
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
    focal = np.array([view.k[:2].mean() for view in views])
    no_points = np.zeros((0, 3)), np.zeros(1, np.int64), np.zeros(0, np.int32)
    neighbors, _ = select_neighbors(focal, poses, *no_points, MAX_NEIGHBORS)
    return DenseScene(tuple(views), neighbors, *no_points)


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
