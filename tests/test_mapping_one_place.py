"""Photographs without depth are told for what they are."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sfmapp.errors import NoReconstructionError
from sfmapp.pipelines.odometry.track import track_sequence
from sfmapp.pipelines.sparse.reconstruct import reconstruct
from sfmapp.workspace.options import load_options

FOCAL, SIZE = 480.0, (400, 300)
MATRIX = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])


def texture(seed: int) -> np.ndarray:
    """A picture of spots of many sizes, larger than a photograph."""
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.integers(0, 256, (n, n), np.uint8), (800, 800), interpolation=cv2.INTER_CUBIC) * 1.0
              for n in (20, 60, 150)]  # fmt: skip
    return np.clip(sum(layers) / 3, 0, 255).astype(np.uint8)  # type: ignore[arg-type, return-value]


def turned(picture: np.ndarray, degrees: float, seed: int) -> np.ndarray:
    """What a camera in the middle sees after a turn about its vertical, with noise."""
    rotation, _ = cv2.Rodrigues(np.array([0.0, np.radians(degrees), 0.0]))
    wide = np.array([[FOCAL, 0, 400], [0, FOCAL, 400], [0, 0, 1]])
    seen = cv2.warpPerspective(picture, MATRIX @ rotation @ np.linalg.inv(wide), SIZE)
    return np.clip(seen + np.random.default_rng(seed).normal(0, 2, seen.shape), 0, 255).astype(np.uint8)


def write(folder: Path, pictures: list[np.ndarray]) -> Path:
    folder.mkdir()
    for k, picture in enumerate(pictures):
        assert cv2.imwrite(str(folder / f"{k:02d}.png"), picture)
    return folder


KINDS = {
    "copies": ([turned(texture(0), 0, 0)] * 4, "4 photographs show the same picture", "copies of one picture"),
    "noise": ([turned(texture(0), 0, k) for k in range(4)], "4 photographs show the same picture", "copies"),
    "a burst": ([turned(texture(0), 0.3 * k, k) for k in range(4)], "4 photographs are a burst from one place",
                "a burst holds no depth"),
    "a turn": ([turned(texture(0), 6.0 * k, k) for k in range(4)], "turning on the spot, by up to (1[0-9]|2[0-9]|6|7)",
               "turning on the spot"),
    "two places": ([turned(texture(k // 3), 0.4 * k, k) for k in range(6)], "6 photographs are of 2 places",
                   "from one place to the next"),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_the_case_is_said(tmp_path: Path, kind: str) -> None:
    pictures, message, advice = KINDS[kind]
    options = load_options(settings=["images.camera_model=PINHOLE", f"images.camera_params={FOCAL},{FOCAL},200,150"])
    with pytest.raises(NoReconstructionError, match=message) as caught:
        reconstruct(write(tmp_path / "photos", pictures), tmp_path / "out", options, record=False)
    assert advice in str(caught.value.advice)
    assert kind == "a turn" or "on the spot" not in f"{caught.value} {caught.value.advice}"


@pytest.mark.parametrize(
    ("pictures", "message"),
    [
        ([turned(texture(0), 0, 0)] * 12, "all 12 frames show the same picture"),
        ([turned(texture(0), 0, k) for k in range(12)], "the camera stands still"),
        ([turned(texture(0), 1.0 * k, k) for k in range(14)], "the camera turns on the spot"),
    ],
)
def test_a_sequence_without_depth(tmp_path: Path, pictures: list[np.ndarray], message: str) -> None:
    options = load_options(settings=[f"sequence.camera=PINHOLE,{FOCAL},{FOCAL},200,150"])
    with pytest.raises(NoReconstructionError, match=message):
        track_sequence(write(tmp_path / "frames", pictures), tmp_path / "out", options, record=False)
