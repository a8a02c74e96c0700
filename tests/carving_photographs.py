"""Photographs of exact solids: coverage, and colours with noise and blur before a background."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from carving_scenes import Solid, shown_depth
from sfmapp.carve.views import View

# sphere tracing along a surface takes many steps, and what it misses there is the outline
_STEPS = 600


def coverage_of(view: View, solid: Solid, finer: int = 6) -> NDArray[np.float32]:
    """(H, W) share of each pixel that shows the solid."""
    return fine_mask(view, solid, finer).reshape(view.height, finer, view.width, finer).mean(axis=(1, 3), dtype="f4")


def fine_mask(view: View, solid: Solid, finer: int) -> NDArray[np.bool_]:
    """(H finer, W finer) whether parts of pixels show the solid; only near its outline each ray is traced."""
    coarse = _shows(view, solid, 1).astype(np.uint8)
    near = cv2.dilate(coarse, np.ones((5, 5), np.uint8)) != cv2.erode(coarse, np.ones((5, 5), np.uint8))
    fine = np.repeat(np.repeat(coarse.astype(bool), finer, axis=0), finer, axis=1)
    wanted = np.repeat(np.repeat(near, finer, axis=0), finer, axis=1)
    fine[wanted] = _shows(view, solid, finer, wanted)
    return fine


def _shows(view: View, solid: Solid, finer: int, where: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
    grid = np.meshgrid(np.arange(view.width * finer), np.arange(view.height * finer))
    xy = (np.stack(grid, axis=-1) + 0.5) / finer
    if where is not None:
        return np.isfinite(shown_depth(view, solid, xy[where], steps=_STEPS))
    shown = np.isfinite(shown_depth(view, solid, xy.reshape(-1, 2), steps=_STEPS))
    return shown.reshape(view.height * finer, view.width * finer)


def photograph(coverage: NDArray[np.float32], seed: int, noise: float = 3.0, blur_px: float = 0.5) -> NDArray[np.uint8]:
    """(H, W, 3) of something orange, unevenly lit, before something blue, as a lens and a sensor see them."""
    rng = np.random.default_rng(seed)
    height, width = coverage.shape
    light = cv2.resize(rng.uniform(0.6, 1.0, (6, 8)).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    shade = np.linspace(1.0, 0.7, width, dtype=np.float32)[None, :, None]
    inside = np.array([210.0, 130.0, 50.0], np.float32) * light[..., None]
    outside = np.array([60.0, 80.0, 180.0], np.float32) * shade
    color = inside * coverage[..., None] + outside * (1.0 - coverage[..., None])
    color = cv2.GaussianBlur(color, (0, 0), blur_px) + rng.normal(0.0, noise, color.shape)
    return np.clip(color.round(), 0, 255).astype(np.uint8)
