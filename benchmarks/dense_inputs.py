"""Models and ground ground truths that the dense benchmark needs and the shared data do not hold."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.formats.colmap import read_model, write_model_text
from sfmapp.formats.ply import write_ply
from sfmapp.geometry import rigid3

Array = NDArray[np.float64]

NUM_POINTS = 3000
# The depth of the lego's test views is a distance along the ray of 8 (1 - v / 255): a step is 0.031.
LEGO_FAR = 8.0
LEGO_TOLERANCE = 0.04


@dataclass(frozen=True)
class Lego:
    """Attributes: model (text), ground truth (PLY), images without alpha, size: diagonal of the ground truth's bounding
    box."""

    model: Path
    ground_truth: Path
    images_on_white: Path
    size: float


def photographs_model(images: Path, work: Path) -> Path:
    """Text model of photographs with nothing known, by ``sfmapp reconstruct`` with a pinhole."""
    script = Path(sys.executable).with_name("sfmapp")
    command = [
        str(script),
        "reconstruct",
        str(images),
        "-o",
        str(work),
        "-q",
        "--camera-model",
        "PINHOLE",
        "--no-recording",
    ]
    subprocess.run(command, check=True)
    text = work / "text"
    write_model_text(text, read_model(work / "sparse" / "0")[0])
    for name in ("rigs.txt", "frames.txt"):  # the prototype is older than they are
        (text / name).unlink(missing_ok=True)
    return text


def lego_inputs(folder: Path, work: Path) -> Lego:
    """Ground truth from the depth of the test views; model of the training views with points of that ground truth, for
    the peer."""
    import cv2

    (work / "images").mkdir(parents=True)
    ground_truth = np.concatenate(list(_depth_points(folder)))
    write_ply(work / "ground_truth.ply", ground_truth, np.zeros((len(ground_truth), 3), np.uint8))
    cameras = json.loads((folder / "cameras.json").read_text())["cameras"]
    points = ground_truth[np.random.default_rng(1).permutation(len(ground_truth))[:NUM_POINTS]]
    seen = np.stack(
        [_visible(points, ground_truth, *_matrices(camera), (camera["width"], camera["height"])) for camera in cameras],
        1,
    )
    points, seen = points[seen.sum(axis=1) >= 3], seen[seen.sum(axis=1) >= 3]
    tracks: list[list[str]] = [[] for _ in points]
    lines: dict[str, list[str]] = {"cameras": [], "images": [], "points3D": []}
    for i, camera in enumerate(cameras, 1):
        name = Path(camera["file"]).name
        rgba = cv2.imread(str(folder / camera["file"]), cv2.IMREAD_UNCHANGED)
        alpha = rgba[..., 3:].astype(np.float32) / 255
        cv2.imwrite(str(work / "images" / name), (rgba[..., :3] * alpha + 255 * (1 - alpha)).round().astype(np.uint8))
        k, r, t = _matrices(camera)
        lines["cameras"].append(f"{i} PINHOLE {camera['width']} {camera['height']} "
                                f"{k[0, 0]} {k[1, 1]} {k[0, 2] + 0.5} {k[1, 2] + 0.5}")  # fmt: skip
        x, y, z, w, *shift = rigid3.from_matrix(r, t).tolist()
        mine = np.flatnonzero(seen[:, i - 1])
        lines["images"].append(" ".join(map(repr, [i, w, x, y, z, *shift, i])) + f" {name}")
        lines["images"].append(" ".join(f"0 0 {p + 1}" for p in mine))
        for place, p in enumerate(mine):
            tracks[p].append(f"{i} {place}")
    lines["points3D"] = [
        f"{p + 1} {x!r} {y!r} {z!r} 128 128 128 0 " + " ".join(track)
        for p, ((x, y, z), track) in enumerate(zip(points.tolist(), tracks, strict=True))
    ]
    (work / "model").mkdir()
    for name, rows in lines.items():
        (work / "model" / f"{name}.txt").write_text("\n".join([*rows, ""]))
    size = float(np.linalg.norm(np.ptp(ground_truth, axis=0)))
    return Lego(work / "model", work / "ground_truth.ply", work / "images", size)


def _depth_points(folder: Path) -> Iterator[Array]:
    """World points of each test view."""
    import cv2

    cameras = json.loads((folder / "test_cameras.json").read_text())["cameras"]
    maps = sorted((folder / "test_depth").iterdir())
    for i, camera in enumerate(cameras):
        path = next((folder / str(v) for key, v in camera.items() if "depth" in key), maps[i])
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        depth = depth[..., 0] if depth.ndim == 3 else depth
        k, r, t = _matrices(camera)
        v, u = np.nonzero(depth)
        rays = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones(len(u))], 1)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        yield (rays * (LEGO_FAR * (1 - depth[v, u] / 255.0))[:, None] - t) @ r


def _matrices(camera: dict[str, Any]) -> tuple[Array, Array, Array]:
    return np.array(camera["K"]), np.array(camera["R_w2c"]), np.array(camera["t_w2c"]).ravel()


def _visible(
    points: Array, ground_truth: Array, k: Array, r: Array, t: Array, size: tuple[int, int]
) -> NDArray[np.bool_]:
    """(N,) bool: in the image and not behind the true points around, splatted four pixels wide."""
    width, height = size

    def project(xyz: Array) -> tuple[NDArray[np.int64], Array]:
        cam = xyz @ r.T + t
        uv = cam[:, :2] / cam[:, 2:] * [k[0, 0], k[1, 1]] + k[:2, 2] + 0.5
        inside = (cam[:, 2] > 0) & (uv >= 0).all(axis=1) & (uv < [width, height]).all(axis=1)
        cell = (uv[:, 1] // 4).astype(np.int64) * (width // 4 + 1) + (uv[:, 0] // 4).astype(np.int64)
        return np.where(inside, cell, -1), cam[:, 2]

    nearest = np.full((width // 4 + 1) * (height // 4 + 1), np.inf)
    cell, depth = project(ground_truth)
    np.minimum.at(nearest, cell[cell >= 0], depth[cell >= 0])
    cell, depth = project(points)
    return np.asarray((cell >= 0) & (depth < nearest[cell] + LEGO_TOLERANCE))
