"""Objects that turn before a cluttered background that stands still, and cameras that move."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sfmapp.carve.masks_report import MasksReport
from sfmapp.carve.options import MaskOptions
from sfmapp.carve.silhouettes import Silhouette, find_silhouettes
from sfmapp.carve.still_cameras import still_groups
from sfmapp.errors import InputError, UsageError
from sfmapp.events import Events
from sfmapp.images.image_set import ImageOptions
from sfmapp.images.load import load_images

Pixels = NDArray[np.uint8]
Mask = NDArray[np.bool_]

NUM, HEIGHT, WIDTH = 12, 120, 160
AUTO = MaskOptions()


def clutter(seed: int, width: int = WIDTH) -> NDArray[np.float32]:
    """(H, W, 3) patches of all colours."""
    rng = np.random.default_rng(seed)
    color = cv2.resize(rng.uniform(20, 250, (15, width // 8, 3)), (width, HEIGHT), interpolation=cv2.INTER_LINEAR)
    return np.asarray(color, np.float32)


def object_in(k: int, num: int = NUM) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Cover (H, W) and colours (H, W, 3) of a long striped thing that turns about the middle."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    angle = 2.0 * np.pi * k / num
    across, along = (x - WIDTH / 2) / (18.0 + 22.0 * abs(np.cos(angle))), (y - HEIGHT / 2) / 34.0
    cover = np.clip(12.0 * (1.0 - np.sqrt(across**2 + along**2)) + 0.5, 0.0, 1.0)
    stripes = 0.5 + 0.5 * np.sin(3.0 * across + 2.0 * angle)
    color = np.stack([190 + 50 * stripes, 40 + 90 * stripes, 50 + 20 * along], axis=-1)
    return cover, color.astype(np.float32)


def turntable(backgrounds: list[NDArray[np.float32]]) -> tuple[list[Pixels], list[Mask]]:
    """Photographs with noise, in lamps that flicker, of a camera that is touched; what shows the object in each."""
    pictures, masks = [], []
    for k, background in enumerate(backgrounds):
        rng = np.random.default_rng([k, 3])
        cover, color = object_in(k, len(backgrounds))
        picture = color * cover[..., None] + background * (1.0 - cover[..., None])
        left, right = rng.normal(1.0, 0.03, 2)
        picture = picture * np.linspace(left, right, WIDTH)[:, None]
        move = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        move[:, 2] = rng.uniform(-0.7, 0.7, 2)
        picture, cover = (
            cv2.warpAffine(a.astype(np.float32), move, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REPLICATE)
            for a in (picture, cover)
        )
        picture = picture + rng.normal(0.0, 2.0, picture.shape)
        pictures.append(np.clip(picture.round(), 0, 255).astype(np.uint8))
        masks.append(cover > 0.5)
    return pictures, masks


def found_in(pictures: list[Pixels], options: MaskOptions = AUTO) -> tuple[list[Silhouette], MasksReport]:
    named = {f"{i:02d}.png": picture for i, picture in enumerate(pictures)}
    images, _ = load_images(named, ImageOptions(), Events())
    return find_silhouettes(images, None, options, Events())


def agreements(silhouettes: list[Silhouette], masks: list[Mask]) -> list[float]:
    return [float((s.inside & m).sum() / (s.inside | m).sum()) for s, m in zip(silhouettes, masks, strict=True)]


def moving(num: int = NUM) -> list[NDArray[np.float32]]:
    wide = clutter(1, WIDTH + 20 * num)
    return [wide[:, 20 * k : 20 * k + WIDTH] for k in range(num)]


def test_what_hides_a_still_background_is_the_object() -> None:
    pictures, masks = turntable([clutter(1)] * NUM)
    silhouettes, report = found_in(pictures)
    assert {mask.source for mask in report.masks} == {"still background"}
    assert report.color_error is None
    assert min(agreements(silhouettes, masks)) > 0.93


def test_a_camera_may_stand_in_two_places_and_one_photograph_elsewhere() -> None:
    backgrounds = [clutter(1 + k % 2) for k in range(2 * NUM)]
    backgrounds[5] = clutter(9)
    pictures, masks = turntable(backgrounds)
    groups = still_groups(pictures)
    assert groups is not None
    assert sorted(len(group) for group in groups) == [NUM - 1, NUM]
    silhouettes, report = found_in(pictures)
    assert [mask.name for mask in report.masks if mask.problem] == ["05.png"]
    assert "05.png does not show the background of the others" in report.warnings[0]
    seen = [k for k in range(2 * NUM) if k != 5]
    assert min(agreements([silhouettes[k] for k in seen], [masks[k] for k in seen])) > 0.93


def test_a_camera_that_moves_does_not_stand_still() -> None:
    assert still_groups(turntable(moving())[0]) is None
    # by a little from one photograph to the next
    wide = clutter(1, WIDTH + 120)
    slow = [wide[:, 4 * k : 4 * k + WIDTH] for k in range(30)]
    assert still_groups(turntable(slow)[0]) is None
    # before what has no detail it cannot be told, and colours do
    plain = np.full((HEIGHT, WIDTH, 3), (60.0, 80.0, 180.0), np.float32)
    assert still_groups(turntable([plain] * NUM)[0]) is None


def test_a_photograph_of_the_background(tmp_path: Path) -> None:
    path = tmp_path / "empty.png"
    cv2.imwrite(str(path), clutter(1).round().astype(np.uint8)[..., ::-1])
    options = MaskOptions(background=str(path))
    # of which four photographs are enough
    pictures, masks = turntable([clutter(1)] * 4)
    silhouettes, report = found_in(pictures, options)
    assert {mask.source for mask in report.masks} == {"still background"}
    assert min(agreements(silhouettes, masks)) > 0.93
    with pytest.raises(InputError, match=r"does not show the background|nothing is in front"):
        found_in(turntable(moving())[0], options)
    with pytest.raises(InputError, match="expected 80x60 pixels"):
        found_in([cv2.resize(picture, (80, 60)) for picture in pictures], options)
    with pytest.raises(InputError, match="expected a photograph of the background"):
        found_in(pictures, MaskOptions(background=str(tmp_path / "none.png")))
    with pytest.raises(UsageError, match="background"):
        MaskOptions(background=str(path), mask_source="alpha")
