"""Masks found by colours that photographs share, against exact ones, and GrabCut with the true rectangle beside them.

The photographs of nerf-lego-small are put before six backgrounds, unevenly lit, with blur and noise; their alpha
channel is the truth. Rendered solids before other backgrounds chose nothing. GrabCut (OpenCV's, full size, five rounds)
is told the rectangle around the true mask, which nobody knows in practice; ours are told nothing.

    python benchmarks/masks.py [--only CASE ...]
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from cases import measure_cases
from rendered_worlds.lit_solids import around, drawn
from rendered_worlds.solids import photograph
from rendered_worlds.turntables import seen_in
from sfmapp.carve.options import MaskOptions
from sfmapp.carve.silhouettes import find_silhouettes
from sfmapp.events import Events
from sfmapp.images.image_set import ImageOptions
from sfmapp.images.load import load_images

BACKGROUNDS = {
    "blue": (70, 90, 180), "white": (235, 235, 235), "dark": (14, 14, 16), "grey": (128, 128, 128),
    "brown": (90, 70, 40), "yellow, as the object": (170, 140, 70),
}  # fmt: skip
# solids that are drawn, and whether they are painted all over or of one colour, before backgrounds that chose nothing
FRESH = {
    "drawn 61 before sand": (61, False, (200, 180, 150)), "drawn 62, painted, before clay": (62, True, (170, 140, 120)),
    "drawn 63 before olive": (63, False, (110, 115, 70)), "drawn 64, painted, before grey": (64, True, (150, 150, 150)),
    "drawn 65 before white": (65, False, (240, 240, 240)), "drawn 66, painted, before black": (66, True, (20, 18, 18)),
}  # fmt: skip
# looked at once, after which two rules were changed
LOOKED_AT = ("drawn 62, painted, before clay", "drawn 64, painted, before grey")
CASES = (*(f"lego before {name}" for name in BACKGROUNDS), *FRESH)
NUM_VIEWS, WIDTH = 8, 400
# every fifth photograph; pixels farther from the outline than this are told wrongly by more than blur
EVERY, FAR_PX = 5, 3.0


def photographs(case: str) -> tuple[dict[str, NDArray[np.uint8]], list[NDArray[np.bool_]]]:
    """Photographs by name before a background, and exact masks."""
    pictures, masks = {}, []
    rgb = FRESH[case][2] if case in FRESH else BACKGROUNDS[case.removeprefix("lego before ")]
    for seed, (color, alpha) in enumerate(rendered(case) if case in FRESH else lego()):
        rng = np.random.default_rng(seed)
        light = np.random.default_rng(7).uniform(0.75, 1.0, (4, 4)).astype(np.float32)
        light = cv2.resize(light, alpha.shape[1::-1], interpolation=cv2.INTER_CUBIC)[..., None]
        picture = color + np.array(rgb, np.float32) * light * (1.0 - alpha[..., None])
        picture = cv2.GaussianBlur(picture, (0, 0), 0.5) + rng.normal(0.0, 3.0, picture.shape)
        pictures[f"{seed:03d}.png"] = np.clip(picture.round(), 0, 255).astype(np.uint8)
        masks.append(alpha > 0.5)
    return pictures, masks


def lego() -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Grey levels (H, W, 3) before black, and shares of pixels (H, W)."""
    folder = Path(os.environ["SFMAPP_DATA"]) / "nerf-lego-small" / "images"
    for path in sorted(folder.glob("*.png"))[::EVERY]:
        rgba = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]].astype(np.float32)
        alpha = rgba[..., 3] / np.float32(255.0)
        yield rgba[..., :3] * alpha[..., None], alpha


def rendered(case: str) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """The same of a solid that is drawn."""
    seed, is_painted, _ = FRESH[case]
    rig = around(NUM_VIEWS, 3, WIDTH)
    for i in range(NUM_VIEWS):
        light, cover = seen_in(drawn(seed), rig, i, seed, is_painted=is_painted)
        shown = photograph(light / np.maximum(cover, 1e-3)[..., None], 0.0, (0,)).astype(np.float32)
        yield shown * cover[..., None], cover


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


def measured(case: str) -> dict[str, Any]:
    """A row of the table."""
    pictures, true = photographs(case)
    images, _ = load_images(pictures, ImageOptions(), Events())
    start = time.process_time()
    silhouettes, _ = find_silhouettes(images, None, MaskOptions(), Events(), threads=1)
    ours_s = time.process_time() - start
    start = time.process_time()
    peers = [by_rectangle(picture, mask) for picture, mask in zip(pictures.values(), true, strict=True)]
    peer_s = time.process_time() - start
    ours, peer = scores([s.inside for s in silhouettes], true), scores(peers, true)
    return {
        "case": case, "fresh": case in FRESH and case not in LOOKED_AT, "iou": ours[0], "least_iou": ours[1],
        "wrong_far": ours[2], "cpu_ms": 1e3 * ours_s / len(true), "peer_iou": peer[0], "peer_least_iou": peer[1],
        "peer_cpu_ms": 1e3 * peer_s / len(true),
    }  # fmt: skip


def markdown(report: dict[str, Any]) -> str:
    lines = [
        "# Masks by shared colours", "", (__doc__ or "").split("\n\n")[1].replace("\n", " "), "",
        "| case | chose | IoU, ours | GrabCut, true rectangle | wrong far from the outline | CPU ms, ours | GrabCut |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    lines += [
        f"| {r['case']} | {'no' if r['fresh'] else 'yes'} | {r['iou']:.3f} (least {r['least_iou']:.3f}) | "
        f"{r['peer_iou']:.3f} ({r['peer_least_iou']:.3f}) | {r['wrong_far']:.2%} | {r['cpu_ms']:.0f} | "
        f"{r['peer_cpu_ms']:.0f} |"
        for r in report["rows"]
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    measure_cases("masks", __doc__, CASES, lambda case: [measured(case)], markdown)
