"""Masks found by colours that photographs share, against exact ones, and GrabCut with the true rectangle beside them.

The photographs of nerf-lego-small are put before six backgrounds, unevenly lit, with blur and noise; their alpha
channel is the truth. GrabCut (OpenCV's, full size, five rounds) is told the rectangle around the true mask, which
nobody knows in practice; ours are told nothing.

    python benchmarks/masks.py
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from machine import RESULTS, describe_machine
from sfmapp.carve.silhouettes import MaskOptions, find_silhouettes
from sfmapp.events import Events
from sfmapp.images.image_set import ImageOptions
from sfmapp.images.load import load_images

BACKGROUNDS = {
    "blue": (70, 90, 180), "white": (235, 235, 235), "dark": (14, 14, 16), "grey": (128, 128, 128),
    "brown": (90, 70, 40), "yellow, as the object": (170, 140, 70),
}  # fmt: skip
# every fifth photograph; pixels farther from the outline than this are told wrongly by more than blur
EVERY, FAR_PX = 5, 3.0


def photographs(rgb: tuple[int, int, int]) -> tuple[dict[str, NDArray[np.uint8]], list[NDArray[np.bool_]]]:
    """Photographs by name before a background, and exact masks."""
    folder = Path(os.environ["SFMAPP_DATA"]) / "nerf-lego-small" / "images"
    pictures, masks = {}, []
    for seed, path in enumerate(sorted(folder.glob("*.png"))[::EVERY]):
        rgba = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]].astype(np.float32)
        alpha, rng = rgba[..., 3:] / 255.0, np.random.default_rng(seed)
        light = np.random.default_rng(7).uniform(0.75, 1.0, (4, 4)).astype(np.float32)
        light = cv2.resize(light, alpha.shape[1::-1], interpolation=cv2.INTER_CUBIC)[..., None]
        color = rgba[..., :3] * alpha + np.array(rgb, np.float32) * light * (1.0 - alpha)
        color = cv2.GaussianBlur(color, (0, 0), 0.5) + rng.normal(0.0, 3.0, color.shape)
        pictures[path.name] = np.clip(color.round(), 0, 255).astype(np.uint8)
        masks.append(alpha[..., 0] > 0.5)
    return pictures, masks


def scores(found: list[NDArray[np.bool_]], true: list[NDArray[np.bool_]]) -> tuple[float, float, float]:
    """Mean and least intersection over union, and share of pixels far from the outline that are told wrongly."""
    overlap = [float((a & b).sum() / (a | b).sum()) for a, b in zip(found, true, strict=True)]
    far = [np.maximum(distance_transform_edt(mask), distance_transform_edt(~mask)) > FAR_PX for mask in true]
    wrong = [float((a != b)[where].mean()) for a, b, where in zip(found, true, far, strict=True)]
    return float(np.mean(overlap)), min(overlap), float(np.mean(wrong))


def by_rectangle(picture: NDArray[np.uint8], true: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """GrabCut inside the rectangle around the true mask, 8 pixels wider."""
    rows, columns = np.nonzero(true)
    top, left = max(rows.min() - 8, 0), max(columns.min() - 8, 0)
    rectangle = (int(left), int(top), int(np.ptp(columns)) + 16, int(np.ptp(rows)) + 16)
    labels, models = np.zeros(true.shape, np.uint8), (np.zeros((1, 65)), np.zeros((1, 65)))
    cv2.setRNGSeed(0)
    cv2.grabCut(picture, labels, rectangle, *models, 5, cv2.GC_INIT_WITH_RECT)
    return np.asarray((labels & 1) > 0)


def measured(name: str, rgb: tuple[int, int, int]) -> dict[str, float | str]:
    """A row of the table."""
    pictures, true = photographs(rgb)
    images, _ = load_images(pictures, ImageOptions(), Events())
    start = time.process_time()
    silhouettes, _ = find_silhouettes(images, None, MaskOptions(), Events(), threads=1)
    ours_s = time.process_time() - start
    start = time.process_time()
    peers = [by_rectangle(picture, mask) for picture, mask in zip(pictures.values(), true, strict=True)]
    peer_s = time.process_time() - start
    ours, peer = scores([s.inside for s in silhouettes], true), scores(peers, true)
    return {
        "background": name, "iou": ours[0], "least_iou": ours[1], "wrong_far": ours[2],
        "cpu_ms": 1e3 * ours_s / len(true), "peer_iou": peer[0], "peer_least_iou": peer[1],
        "peer_cpu_ms": 1e3 * peer_s / len(true),
    }  # fmt: skip


def main() -> None:
    rows = [measured(name, rgb) for name, rgb in BACKGROUNDS.items()]
    (RESULTS / "masks.json").write_text(json.dumps({**describe_machine(), "rows": rows}, indent=1) + "\n")
    lines = [
        "# Masks by shared colours", "", (__doc__ or "").split("\n\n")[1].replace("\n", " "), "",
        "| background | IoU, ours | GrabCut, true rectangle | wrong far from the outline | "
        "CPU ms, ours | GrabCut |",
        "|---|---|---|---|---|---|",
    ]  # fmt: skip
    lines += [
        f"| {r['background']} | {r['iou']:.3f} (least {r['least_iou']:.3f}) | {r['peer_iou']:.3f} "
        f"({r['peer_least_iou']:.3f}) | {r['wrong_far']:.2%} | {r['cpu_ms']:.0f} | "
        f"{r['peer_cpu_ms']:.0f} |"
        for r in rows
    ]
    (RESULTS / "masks.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
