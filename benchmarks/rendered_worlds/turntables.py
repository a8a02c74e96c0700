"""Photographs of solids that turn before the photograph of a place, by a camera that stands still or moves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rendered_worlds.lit_solids import DISTANCE, Rig, looking_in
from rendered_worlds.solids import Lamps, Solid, photograph, render
from sfmapp.camera.camera import pixels_to_rays
from sfmapp.carve.views import View, view_of_camera
from sfmapp.geometry import rigid3

Picture = NDArray[np.float32]
Pixels = NDArray[np.uint8]
Mask = NDArray[np.bool_]

LAMPS_DEG = ((25, 10), (-35, 40), (0, 5))


@dataclass(frozen=True)
class Conditions:
    """How photographs are taken.

    Attributes:
        noise: grey levels. flicker: relative deviations of the light at the left and at the right.
        touch_px: a photograph is off by up to so much.
        shadow: share of the light that the shadow on the background lacks.
        moves: the camera moves along the background.
    """

    noise: float = 2.0
    flicker: float = 0.03
    touch_px: float = 1.0
    shadow: float = 0.3
    moves: bool = False


@dataclass(frozen=True)
class Turntable:
    """Photographs (H, W, 3), what shows the solid in each (H, W), their views, and the scene without it (H, W, 3)."""

    pictures: list[Pixels]
    masks: list[Mask]
    views: list[View]
    empty: Pixels


def turned(
    solid: Solid, num: int, width: int, backdrop: Path, seed: int, *, is_painted: bool, conditions: Conditions
) -> Turntable:
    """A solid turned all round in so many steps, seen from 20 degrees above, of one colour or painted all over."""
    rig = looking_in(np.arange(num) * 360.0 / num + 7.0, np.full(num, 20.0), LAMPS_DEG, width)
    size = (rig.camera.height, rig.camera.width)
    scale = 2 if conditions.moves else 1
    wide = read_backdrop(backdrop, (size[0] * scale, size[1] * scale))
    pictures, masks, views = [], [], []
    for i, pose in enumerate(rig.poses):
        light, cover = seen_in(solid, rig, i, seed, is_painted=is_painted)
        left = int((0.5 + 0.5 * np.sin(2.0 * np.pi * i / num)) * size[1] * 0.98) if conditions.moves else 0
        top = int(0.3 * size[0]) if conditions.moves else 0
        behind = wide[top : top + size[0], left : left + size[1]]
        picture, mask = _taken(light, cover, behind, conditions, (seed, i))
        pictures.append(picture)
        masks.append(mask)
        views.append(view_of_camera(f"v{i:03d}.png", rig.camera, pose))
    return Turntable(pictures, masks, views, photograph(wide[: size[0], : size[1]], conditions.noise, (seed, 1, 1)))


def seen_in(solid: Solid, rig: Rig, i: int, seed: int, *, is_painted: bool) -> tuple[Picture, Picture]:
    """Linear brightness (H, W, 3) of a solid before black, by its lamps, and its share of each pixel (H, W)."""
    pose = rig.poses[i]
    seen = render(solid, rig.camera, pose, Lamps(np.ascontiguousarray(rig.lamps[i]), np.full(3, DISTANCE**2 / 2)))
    color = np.random.default_rng(seed).uniform(0.35, 0.95, 3).astype(np.float32)
    if is_painted:
        height, width = seen.cover.shape
        y, x = np.indices((height, width)) + 0.5
        rays = pixels_to_rays(rig.camera, np.stack([x.ravel(), y.ravel()], axis=1)) @ rigid3.rotation_matrix(pose)
        depth = np.where(np.isfinite(seen.depth), seen.depth, 0.0).reshape(-1, 1)
        color = painted((rigid3.center(pose) + rays * depth).reshape(height, width, 3), seed)
    return (seen.light.sum(axis=0) + np.float32(0.1) * seen.cover)[..., None] * color, seen.cover


def read_backdrop(path: Path, size: tuple[int, int]) -> Picture:
    """(H, W, 3) linear brightness of the photograph of a place, cut to a size (H, W)."""
    picture = cv2.imread(str(path))[..., ::-1]
    scale = 1.02 * max(size[1] / picture.shape[1], size[0] / picture.shape[0])
    picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray((picture[: size[0], : size[1]] / 255.0) ** 2.2, np.float32)


def painted(xyz: NDArray[np.float64], seed: int) -> Picture:
    """Colours (..., 3) of a pattern of all hues at points (..., 3)."""
    rng = np.random.default_rng(seed)
    color = np.zeros(xyz.shape)
    waves, phases, hues = rng.normal(0, 5, (12, 3)), rng.uniform(0, 6.28, 12), rng.uniform(-1, 1, (12, 3))
    for wave, phase, hue in zip(waves, phases, hues, strict=True):
        color += np.sin(xyz @ wave + phase)[..., None] * hue
    return np.asarray(np.clip(0.55 + 0.18 * color, 0.1, 1.0), np.float32)


def _taken(
    light: Picture, cover: Picture, behind: Picture, conditions: Conditions, key: tuple[int, int]
) -> tuple[Pixels, Mask]:
    """A photograph of a solid before something, and what shows it."""
    rng = np.random.default_rng([*key, 9])
    height, width = cover.shape
    beside = np.array([[1.0, 0.0, 0.06 * width], [0.0, 1.0, 0.05 * height]])
    shadow = cv2.GaussianBlur(cv2.warpAffine(cover, beside, (width, height)), (0, 0), 0.02 * width)[..., None]
    picture = light + behind * (1.0 - conditions.shadow * shadow) * (1.0 - cover[..., None])
    left, right = 1.0 + conditions.flicker * rng.normal(size=2)
    picture = picture * np.linspace(left, right, width)[:, None]
    touched = np.hstack([np.eye(2), conditions.touch_px * rng.uniform(-1.0, 1.0, (2, 1))])
    picture, cover = (
        cv2.warpAffine(a.astype(np.float32), touched, (width, height), borderMode=cv2.BORDER_REPLICATE)
        for a in (picture, cover)
    )
    picture = cv2.GaussianBlur(picture, (0, 0), 0.5)
    return photograph(picture, conditions.noise, (*key, 3)), cover > 0.5
